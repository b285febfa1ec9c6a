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
from typing import Any, Protocol

from advsearch.errors import InputError, UnknownNameError
from advsearch.files import JsonObject
from advsearch.runs.store import Row

PACKAGES = {"mlflow": "mlflow", "tensorboard": "tensorboard.summary", "wandb": "wandb"}
"""The trackers, and what of each is imported."""

NUMBERS = ("objective", "score", "margin", "correct", "success", "probability")
"""Of a row."""

PATIENCE = 10.0
"""Seconds that the end of a run waits for what is still to be told."""

WAITING = 10_000
"""Messages that may wait; further ones are not told."""

LONGEST = 250
"""Characters of a setting."""

PROJECT = "advsearch"

_LOG = logging.getLogger("advsearch")

MetricValues = Mapping[str, float]


class Backend(Protocol):
    """One tracker with an open run."""

    def tell(self, numbers: MetricValues, step: int) -> None:
        """Tell numbers by name, of a step of their kind."""

    def close(self) -> None:
        """End the run."""


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
        self._thread = threading.Thread(
            target=self._work, args=(lambda: OPEN[name](_package(name), folder, told),), name=name, daemon=True
        )
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

    def _work(self, open_backend: Callable[[], Backend]) -> None:
        try:
            backend = open_backend()
            while (message := self._waiting.get()) is not None:
                backend.tell(*message)
            backend.close()
        except Exception as error:  # whatever a tracker does, the run goes on
            _LOG.warning("%s is told nothing more: %s", self._name, str(error)[:300] or type(error).__name__)


# ---- the trackers ---------------------------------------------------------------------------------------------------


class _Mlflow:
    def __init__(self, mlflow: Any, folder: Path, settings: Mapping[str, str]) -> None:
        self._mlflow = mlflow
        mlflow.start_run(run_name=folder.name, nested=True)
        mlflow.log_params(settings)

    def tell(self, numbers: MetricValues, step: int) -> None:
        self._mlflow.log_metrics(dict(numbers), step=step)

    def close(self) -> None:
        self._mlflow.end_run()


class _Tensorboard:
    """Event files in ``artifacts/tensorboard`` of the run; settings are in its run.yaml."""

    def __init__(self, summary: Any, folder: Path, settings: Mapping[str, str]) -> None:
        self._writer = summary.Writer(str(folder / "artifacts" / "tensorboard"))

    def tell(self, numbers: MetricValues, step: int) -> None:
        for name, value in numbers.items():
            self._writer.add_scalar(name, value, step)

    def close(self) -> None:
        self._writer.close()


class _Wandb:
    """Each kind has steps of its own, which are told as a number: its one counter only ever goes up."""

    def __init__(self, wandb: Any, folder: Path, settings: Mapping[str, str]) -> None:
        self._run = wandb.init(project=PROJECT, name=folder.name, config=dict(settings), reinit="create_new")

    def tell(self, numbers: MetricValues, step: int) -> None:
        kind = next(iter(numbers), "rows/").partition("/")[0]
        self._run.log({**numbers, f"{kind}/step": step})

    def close(self) -> None:
        self._run.finish()


OPEN: Mapping[str, Callable[[Any, Path, Mapping[str, str]], Backend]] = {
    "mlflow": _Mlflow,
    "tensorboard": _Tensorboard,
    "wandb": _Wandb,
}
"""What opens a run in each."""
