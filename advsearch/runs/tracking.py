"""What is evaluated, told to MLflow, TensorBoard or Weights & Biases: settings, and the mean numbers of rows by kind. A
thread of its own tells it, so that neither a slow network nor one that fails holds up the run."""

from __future__ import annotations

import importlib
import logging
import threading
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from queue import Full, Queue
from typing import Any, NamedTuple

from advsearch.errors import InputError, UnknownNameError
from advsearch.files import JsonObject
from advsearch.runs.store import Row

PACKAGES = {"mlflow": "mlflow", "tensorboard": "tensorboard.summary", "wandb": "wandb"}
"""The trackers, and what of each is imported."""

NUMBERS = ("objective", "score", "margin", "correct", "success", "probability")

PATIENCE = 10.0  # seconds that the end of a run waits for what is still to be told
WAITING = 10_000  # messages that may wait; further ones are not told

LONGEST = 250

PROJECT = "advsearch"

_LOG = logging.getLogger("advsearch")

MetricValues = Mapping[str, float]


class Backend(NamedTuple):
    """One tracker with an open run: `tell` takes numbers by name, of a step of their kind, and `close` ends the run."""

    tell: Callable[[MetricValues, int], object]
    close: Callable[[], object]


def check_tracker(name: str | None) -> None:
    """Check that a tracker can be told, before anything is done."""
    if name is None:
        return
    if name not in PACKAGES:
        raise UnknownNameError("log", name, PACKAGES)
    _package(name)


def _package(name: str) -> Any:
    try:
        return importlib.import_module(PACKAGES[name])
    except ImportError:
        raise InputError(f"log {name}: needs {name}; pip install {name}, or leave `log` out") from None


class Tracker:
    """Tells rows to a tracker from a thread of its own."""

    def __init__(self, name: str, folder: Path, settings: JsonObject) -> None:
        self._name = name
        self._right: dict[str, list[int]] = defaultdict(lambda: [0, 0])
        self._waiting: Queue[tuple[MetricValues, int] | None] = Queue(WAITING)
        told = {key: str(value)[:LONGEST] for key, value in settings.items() if value is not None}
        self._thread = threading.Thread(target=self._work, args=(folder, told), name=name, daemon=True)
        self._thread.start()

    def rows(self, rows: Sequence[Row]) -> None:
        """Tell rows that were kept; returns at once."""
        kinds: dict[str, list[Row]] = defaultdict(list)
        for row in rows:
            kinds[row.kind].append(row)
        for kind, group in kinds.items():
            self._put((self._numbers(kind, group), group[-1].step))

    def close(self) -> None:
        """Wait, at most `PATIENCE` seconds, until all is told; a second call does nothing."""
        self._put(None)
        self._thread.join(PATIENCE)

    def _numbers(self, kind: str, rows: Sequence[Row]) -> MetricValues:
        numbers = {}
        for name in NUMBERS:
            given = [float(value) for row in rows if (value := getattr(row, name)) is not None]
            if given:
                numbers[f"{kind}/{name}"] = sum(given) / len(given)
        judged = [row.correct for row in rows if row.correct is not None]
        counts = self._right[kind]
        counts[0], counts[1] = counts[0] + sum(judged), counts[1] + len(judged)
        if counts[1]:
            numbers[f"{kind}/accuracy"] = counts[0] / counts[1]
        return numbers

    def _put(self, message: tuple[MetricValues, int] | None) -> None:
        try:
            self._waiting.put_nowait(message)
        except Full:
            return  # a tracker that is that slow is told less; the run has all of it

    def _work(self, folder: Path, settings: Mapping[str, str]) -> None:
        try:
            backend = OPEN[self._name](_package(self._name), folder, settings)
            while (message := self._waiting.get()) is not None:
                backend.tell(*message)
            backend.close()
        except Exception as error:  # whatever a tracker does, the run goes on
            _LOG.warning("%s is told nothing more: %s", self._name, str(error)[:300] or type(error).__name__)


# ---- the trackers ---------------------------------------------------------------------------------------------------


def _mlflow(mlflow: Any, folder: Path, settings: Mapping[str, str]) -> Backend:
    mlflow.start_run(run_name=folder.name, nested=True)
    mlflow.log_params(settings)

    def tell(numbers: MetricValues, step: int) -> None:
        mlflow.log_metrics(dict(numbers), step=step)

    return Backend(tell, mlflow.end_run)


def _tensorboard(summary: Any, folder: Path, settings: Mapping[str, str]) -> Backend:
    """Event files in ``artifacts/tensorboard`` of the run; settings are in its run.yaml."""
    writer = summary.Writer(str(folder / "artifacts" / "tensorboard"))

    def tell(numbers: MetricValues, step: int) -> None:
        for name, value in numbers.items():
            writer.add_scalar(name, value, step)

    return Backend(tell, writer.close)


def _wandb(wandb: Any, folder: Path, settings: Mapping[str, str]) -> Backend:
    """Each kind has steps of its own, which are told as a number: its one counter only ever goes up."""
    run = wandb.init(project=PROJECT, name=folder.name, config=dict(settings), reinit="create_new")

    def tell(numbers: MetricValues, step: int) -> None:
        kind = next(iter(numbers), "rows/").partition("/")[0]
        run.log({**numbers, f"{kind}/step": step})

    return Backend(tell, run.finish)


OPEN: Mapping[str, Callable[[Any, Path, Mapping[str, str]], Backend]] = {
    "mlflow": _mlflow,
    "tensorboard": _tensorboard,
    "wandb": _wandb,
}
