"""Run folders that somebody else made: whole ones, in which rows, settings, pictures or links are hostile."""

import json
import random as chance
import sqlite3
import tempfile
from collections.abc import Callable
from contextlib import closing
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Any

import yaml

from advsearch.options import Value
from advsearch.questions.attack.settings import AttackConfig
from advsearch.runs.directory import PARTS, RunDirectory
from advsearch.runs.store import Row
from advsearch.runs.summary import read_result
from advsearch.viewer.pages import write_page
from fuzz import pictures
from fuzz.case import Case, Maker, Random
from fuzz.mutations import VALUES, as_json, confused, damaged
from samples import attack, curve, keep_object, make_run
from stored_sweeps import make_sweep

BOXES = {"box": [1.0, 2.0, 9.0, 9.0], "found": [{"label": "mug", "box": [1.0, 2.0, 8.0, 9.0], "score": 0.5}]}
TYPES: tuple[Any, ...] = (
    *("NULL", "''", "'x'", "x'00ff'", "-1", "1e999", "-1e999", "9223372036854775807", "1.5", "'\x1b[31m'"),
    *("replace(hex(zeroblob(5000)), '0', '[')", "'{\"a\": NaN}'", "'{\"a\": 1e999}'", "'[1]'", "'{}'", "'null'"),
)
"""What stands in place of a column's value, in SQL."""

COLUMNS = (
    *("kind", "step", "seed", "spp", "objective", "score", "success", "correct", "margin", "label", "label_index"),
    *("probability", "payload_json", "values_json", "seconds", "renders", "phase", "metrics_json", "machine", "time"),
)


def _study(path: Path) -> None:
    with RunDirectory.create_for(AttackConfig(object="mug", run=str(path))) as run:
        run.write_summary(curve())
    for name in curve().parts:
        part = make_run(path / PARTS / name)
        write_page(part, read_result(part))
    write_page(path, read_result(path))


def _attack(path: Path) -> None:
    make_run(path, attack(run="runs/it", configuration={"pose.yaw": {"value": 3.0, "unit": "degrees"}}))
    keep_object(path)
    write_page(path, read_result(path))


def _long_sweep(path: Path) -> None:
    """One with rows enough to be explained."""
    make_sweep(path, keep="all")
    generator = chance.Random(0)
    counts = {"configurations": 160, "planned": 160, "correct": 90}
    with RunDirectory.resume(path) as run:
        run.write_summary(read_result(path).model_copy(update=counts))
        for step in range(24, 160):
            yaw, power = generator.uniform(0, 90), generator.uniform(0.5, 2)
            values: dict[str, Value] = {
                "environment": {"value": "noon", "unit": ""}, "model": {"value": "reference", "unit": ""},
                "pose.yaw": {"value": yaw, "unit": "degrees"}, "camera.elevation": {"value": 10.0, "unit": "degrees"},
                "light.power": {"value": power, "unit": "1"},
            }  # fmt: skip
            wrong = yaw > 45
            run.append_rows(
                Row("sweep", step, correct=not wrong, margin=1.0 if wrong else -1.0, label="mug", values=values)
            )


MADE: dict[str, Callable[[Path], object]] = {
    "attack": _attack,
    "study": _study,
    "sweep": _long_sweep,
    "detection": lambda path: make_sweep(path, keep="wrong", payload=BOXES),  # type: ignore[arg-type]
}
"""Runs as advsearch writes them, by kind."""


@cache
def honest() -> dict[str, dict[str, bytes]]:
    """Return the files of each run, by their paths in it."""
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        for kind, make in MADE.items():
            path = Path(folder) / kind
            make(path)
            for database in path.rglob("results.sqlite"):
                with closing(sqlite3.connect(database)) as db:
                    db.execute("PRAGMA journal_mode = DELETE")  # or reading it makes a log beside it
            files = (one for one in sorted(path.rglob("*")) if one.is_file() and one.name != ".lock")
            found[kind] = {one.relative_to(path).as_posix(): one.read_bytes() for one in files}
    return found


def plant(outside: Path) -> None:
    """Write the same runs where no run may lead to."""
    for kind, files in honest().items():
        for name, data in files.items():
            (outside / kind / name).parent.mkdir(parents=True, exist_ok=True)
            (outside / kind / name).write_bytes(data)


def _case(kind: str, what: str, files: dict[str, bytes], **more: Any) -> Case:
    return Case(f"{kind} run: {what}", f"whole {kind}", "run.yaml", files, **more)


def rows(random: Random) -> Case:
    """A run whose database has other values than a run's."""
    kind = random.choice(list(MADE))
    files, whats = dict(honest()[kind]), []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "results.sqlite"
        path.write_bytes(files["results.sqlite"])
        with closing(sqlite3.connect(path)) as db:
            for _ in range(random.choice((1, 1, 2))):
                whats.append(_changed(random, db))
            db.commit()
        files["results.sqlite"] = path.read_bytes()
    return _case(kind, f"rows {', '.join(whats)}", files)


def _changed(random: Random, db: sqlite3.Connection) -> str:
    """Change some rows, or a note, and say what."""
    every = random.choice(("", f" WHERE id % 7 = {random.randrange(7)}"))
    column = random.choice(COLUMNS)
    if random.random() < 0.15:
        db.execute("DELETE FROM evaluations" + every)
        return "gone"
    if random.random() < 0.15:
        key = random.choice([key for (key,) in db.execute("SELECT key FROM meta")])
        value = as_json(random.choice(VALUES)).decode()
        db.execute("UPDATE meta SET value = ? WHERE key = ?", (value, key))
        return f"note {key}"
    if column.endswith("_json") and random.random() < 0.7:
        told = db.execute(f"SELECT {column} FROM evaluations WHERE json_valid({column}) LIMIT 1").fetchone()
        value = as_json(confused(random, json.loads(told[0]) if told else {"a": 1.0})).decode()
        db.execute(f"UPDATE OR IGNORE evaluations SET {column} = ?{every}", (value,))
        return f"{column} confused"
    value = random.choice(TYPES)
    try:
        db.execute(f"UPDATE OR IGNORE evaluations SET {column} = {value}{every}")
    except sqlite3.IntegrityError:
        return "nothing"
    return f"{column} = {value[:20]!r}"


def contents(random: Random) -> Case:
    """A run with a summary, settings, a picture, a page or another file that is damaged or another one."""
    kind = random.choice(list(MADE))
    files = dict(honest()[kind])
    told = [one for one in files if one.endswith(("summary.json", "run.yaml"))]
    name = random.choice([*told, *(one for one in files if random.random() < 0.2)])
    if random.random() < 0.7 and name.endswith("summary.json"):
        what, files[name] = "confused", as_json(confused(random, json.loads(files[name])))
    elif random.random() < 0.7 and name.endswith("run.yaml"):
        head, settings = files[name].decode().partition("\n")[0], yaml.safe_load(files[name])
        what, files[name] = "confused", f"{head}\n{yaml.safe_dump(confused(random, settings))}".encode()
    elif random.random() < 0.4 and name.endswith((".png", ".jpg", ".gif")):
        what, files[name] = pictures.picture(random)
    elif random.random() < 0.2:
        what, files[name] = "exchanged", files[random.choice(list(files))]
    else:
        what, files[name] = damaged(random, files[name])
    return _case(kind, f"{PurePosixPath(name).name} {what}", files)


def links(random: Random) -> Case:
    """A run in which a file or a folder is a link, or a pipe; what it leads to is as good as what was there."""
    kind = random.choice(list(MADE))
    files = dict(honest()[kind])
    folders = {str(one) for name in files for one in PurePosixPath(name).parents} - {"."}
    name = random.choice([*files, *folders, *folders])
    files = {one: data for one, data in files.items() if one != name and not one.startswith(f"{name}/")}
    up = "../" * len(PurePosixPath(name).parts)
    outside = f"outside/{kind}/{name}"
    leads = {
        "away": {name: up + outside},
        "in a chain": {name: f"{up[3:]}hop", "hop": f"../{outside}"},
        "to itself": {name: PurePosixPath(name).name},
        "to the folder above": {name: ".."},
        "to the settings": {name: f"{up[3:]}run.yaml"},
    }
    if random.random() < 0.1:
        return _case(kind, f"{name} a pipe", files, pipes=(name,))
    how = random.choice(list(leads))
    return _case(kind, f"{name} links {how}", files, links=leads[how])


MAKERS: tuple[Maker, ...] = (rows, contents, links)
