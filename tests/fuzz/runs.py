"""Run folders with a file that is damaged: the results, the summary, the settings."""

import io
import json
import pickle
import sqlite3
import tempfile
from contextlib import closing
from functools import cache
from pathlib import Path

import numpy as np

from advsearch.options import Value
from advsearch.runs.store import Row, Store
from advsearch.settings import HEADER
from fuzz import pictures
from fuzz.case import Case, Maker, Random
from fuzz.models import Planted
from fuzz.mutations import as_json, confused, damaged

SUMMARY = {
    "schema": 2,
    "command": "attack",
    "object": "mug",
    "controls": ["pose"],
    "ending": "interrupted",
    "clean": {"label": "mug", "successes": 0, "trials": 6},
    "verified": {"successes": 5, "trials": 6, "interval": [0.4, 1.0]},
    "seconds": {"total": 3.0},
}
SETTINGS = f"{HEADER}schema: 2\ncommand: attack\nobject: mug\ncontrols: {{pose: {{}}}}\n".encode()


@cache
def results() -> bytes:
    """Return an honest results.sqlite."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "results.sqlite"
        with Store(path) as store:
            values: dict[str, Value] = {"pose.yaw": {"value": 3.0, "unit": "degrees"}}
            store.append([Row("search", step, seed=step, objective=0.5, values=values) for step in range(40)])
        with closing(sqlite3.connect(path)) as db:
            db.execute("PRAGMA journal_mode = DELETE")  # or reading it makes a log beside it
        return path.read_bytes()


def folder(random: Random) -> Case:
    """A run folder with one bad file."""
    files = {"run.yaml": SETTINGS, "summary.json": json.dumps(SUMMARY).encode(), "results.sqlite": results()}
    name = random.choice(("results.sqlite", "results.sqlite", "summary.json", "run.yaml"))
    what, files[name] = damaged(random, files[name])
    if name == "summary.json" and random.random() < 0.7:
        what, files[name] = "confused", as_json(confused(random, SUMMARY))
    return Case(f"run: {name} {what}", "run", "run.yaml", files)


ANSWER = np.linspace(0.0, 1.0, 12, dtype=np.float32)
HEADERS = (
    b"{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000,), }",
    b"{'descr': '<f4', 'fortran_order': False, 'shape': (12L,), }",
    b"{'descr': '<f4', 'fortran_order': False, 'shape': ('''",
    b"{'descr': '<f4', 'fortran_order': False, 'shape': " + b"(" * 3000,
    b"{'descr': '<f4', 'fortran_order': False, 'shape': (-1,), }",
    b"{'descr': '|O', 'fortran_order': False, 'shape': (1,), }",
    b"{'descr': [('a', '<f4')], 'fortran_order': True, 'shape': (12,), }",
    b"{'descr': '<f4', 'fortran_order': False, 'shape': (3, 4), }",
)


def answer(random: Random) -> Case:
    """A run's answer: a damaged array, a hostile header, objects to unpickle, or an archive of arrays."""
    buffer = io.BytesIO()
    np.save(buffer, ANSWER)
    what, data = damaged(random, buffer.getvalue())
    kind = random.random()
    if kind < 0.4:
        text = random.choice(HEADERS) + b"\n"
        what, data = "header", b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + ANSWER.tobytes()
    elif kind < 0.5:
        what, data = "pickle", pickle.dumps(Planted())
    elif kind < 0.6:
        buffer = io.BytesIO()
        np.savez(buffer, u=ANSWER)
        what, data = "archive", buffer.getvalue()
    return Case(f"answer: {what}", "answer", "artifacts/adversarial.npy", {"artifacts/adversarial.npy": data})


LINE = {
    "id": "one", "environment": "park", "model": "mug", "is_correct": "True", "loss": 0.25, "prediction": [1, 0],
    "output_type": "classes", "render_args": {"rotation": 0.5, "on": True, "where": [1.0, 2.0]},
}  # fmt: skip


def threedb(random: Random) -> Case:
    """A folder of 3DB with one bad file, or an id that leads elsewhere."""
    what, picture = pictures.picture(random)
    line = {**LINE, "id": random.choice(("one", "../../outside/secret", "@OUTSIDE@/secret", "a" * 5000, 7, None))}
    if random.random() < 0.5:
        what, line = "confused", confused(random, LINE)
    files = {
        "details.log": b"\n".join([as_json(LINE), as_json(line)]),
        "class_maps.json": json.dumps(["cup", "mug"]).encode(),
        "images/one_rgb.png": picture,
    }
    if random.random() < 0.5:
        name = random.choice(("details.log", "class_maps.json"))
        what, files[name] = damaged(random, files[name])
    links = {"images/two_rgb.png": "../../outside/secret.txt"}
    return Case(f"3db: {what}", "3db", "details.log", files, links)


MAKERS: tuple[Maker, ...] = (folder, answer, threedb)
