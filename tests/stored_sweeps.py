"""Sweeps without a renderer, for tests of what shows them."""

import itertools
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from advsearch.files import JsonValue
from advsearch.options import Value
from advsearch.questions.sweep.page import write_sweep_page
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.rules import make_table
from advsearch.runs.directory import RunDirectory
from advsearch.runs.store import NAME, Row, Store
from advsearch.viewer import thumbnails
from advsearch.viewer.server import Dashboard
from samples import sweep

YAWS, ELEVATIONS, ENVIRONMENTS = (0.0, 45.0, 90.0), (10.0, 40.0), ("noon", "studio")


def rows_of(run: Path) -> list[Row]:
    """The rows of a sweep, as its store has them."""
    with Store(run / NAME, read_only=True) as store:
        return list(store.rows("sweep"))


def all_rows(run: Path) -> list[dict[str, Any]]:
    """All rows of a run, but for times."""
    with Store(run / NAME, read_only=True) as store:
        return [{**vars(row), "seconds": None, "time": None} for row in store.rows()]


def described(value: float | str, unit: str = "") -> Value:
    """A value as a row has it."""
    return {"value": value, "unit": unit}


def make_sweep(
    path: Path,
    *,
    keep: str = "none",
    label: str = "mug",
    ended: bool = True,
    environments: Sequence[str] = ENVIRONMENTS,
    payload: JsonValue = None,
    **summarised: Any,
) -> Path:
    """Make the run of a sweep of 24 configurations, wrong at noon from 40 degrees, and return its folder."""
    config = SweepConfig(object="mug", run=str(path), grid={"pose.yaw": list(YAWS)}, keep_pictures=keep)
    points = list(itertools.product(environments, YAWS, ELEVATIONS, (0.5, 0.75)))
    with RunDirectory.create_for(config) as run:
        rows = []
        for step, (environment, yaw, elevation, power) in enumerate(points):
            wrong = environment == "noon" and elevation > 30
            values: dict[str, Value] = {
                "environment": described(environment),
                "model": described("reference"),
                "pose.yaw": described(yaw, "degrees"),
                "camera.elevation": described(elevation, "degrees"),
                "light.power": described(power + step / 1000, "1"),
            }
            rows.append(
                Row("sweep", step, correct=not wrong, margin=-2.0 - step / 100 if wrong else 3.0, probability=0.9,
                    label="cup" if wrong else label, values=values, payload=payload)
            )  # fmt: skip
            if keep == "all" or (keep == "wrong" and wrong):
                picture = np.full((16, 16, 3), step / len(points), np.float32)
                thumbnails.write_thumbnail(run.path, step, thumbnails.make_thumbnail(picture))
        run.append_rows(*rows)
        if ended:
            right = sum(bool(one.correct) for one in rows)
            counts = {
                "configurations": len(rows),
                "correct": right,
                "accuracy": right / len(rows),
                "interval": (0.5, 0.9),
            }
            axis = {"axis": "pose.yaw", "unit": "degrees", "value": 45.0, **counts}
            summary = sweep(**counts, planned=len(rows), run=str(path), **{"axes": [axis], **summarised})
            run.write_summary(summary)
            write_sweep_page(run.path, summary)
    return path


@contextmanager
def serving(
    *runs: Path, host: str = "127.0.0.1", https: bool = False, photographs: object | None = None
) -> Iterator[Dashboard]:
    """A server of these runs, for as long as the block."""
    pages = None
    if photographs is not None:
        from advsearch.questions.photographs.pages import PhotographPages

        pages = PhotographPages(photographs)
    server = Dashboard(runs, host, 0, https=https, photographs=pages)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def seen(values: Mapping[str, Any], right: Any, units: Any = None, of: Mapping[str, str] | None = None) -> pd.DataFrame:
    """Rows that have some numbers and names as a table for rules, each a unit unless said otherwise; `of` has what the
    numbers are in, such as degrees."""
    columns = {name: pd.Series(one) for name, one in values.items()}
    columns = {name: one if one.dtype.kind == "f" else one.astype("category") for name, one in columns.items()}
    rows = pd.DataFrame({**columns, "correct": right, "unit": np.arange(len(right)) if units is None else units})
    rows.attrs["units"] = {**dict.fromkeys(values, ""), **(of or {})}
    return make_table(rows, values)
