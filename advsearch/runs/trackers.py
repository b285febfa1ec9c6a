"""Send the settings of a run, and the means of its rows, to an experiment tracker:
MLflow, TensorBoard, or Weights & Biases.

A separate thread sends them, so that a slow or failing network does not delay the run.
"""

from __future__ import annotations

import importlib
import logging
import threading
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from queue import Full, Queue
from typing import Any

from advsearch.errors import InputError, UnknownNameError
from advsearch.files import JsonObject
from advsearch.runs.store import Row

PACKAGES = {"mlflow": "mlflow", "tensorboard": "tensorboard.summary", "wandb": "wandb"}
"""The module that is imported for each tracker."""
METRICS = ("objective", "score", "margin", "correct", "success", "probability")
# Maximum seconds for which the end of a run waits until all messages are sent.
MAX_CLOSE_SECONDS = 10.0
# Maximum number of messages that wait to be sent. Further ones are dropped.
MAX_QUEUED = 10_000
MAX_TEXT_LENGTH = 250
MAX_REASON_LENGTH = 300  # characters of an error in the log
_LOG = logging.getLogger("advsearch")


def check_tracker(name: str | None) -> None:
    """Check that a tracker exists and is installed; None stands for no tracker."""
    if name is None:
        return
    if name not in PACKAGES:
        raise UnknownNameError("log", name, PACKAGES)
    _import_package(name)


def _import_package(name: str) -> Any:
    """Import the package of a tracker; raise InputError if it is not installed."""
    try:
        return importlib.import_module(PACKAGES[name])
    except ImportError:
        raise InputError(
            f"log {name}: needs {name}; pip install {name}, or leave `log` out"
        ) from None


class Tracker:
    """Sends rows to a tracker, from a separate thread.

    A tracker never stops the run. If it is slow, some messages are dropped. After an
    error, nothing more is sent.

    Attributes:
        _n_correct: number of correct rows so far, by kind of row.
        _n_judged: number of rows so far that are correct or not, by kind of row.
        _queue: metrics and step of each message; None ends the thread.
    """

    def __init__(self, name: str, folder: Path, settings: JsonObject) -> None:
        """Start the thread that sends rows to the tracker.

        Args:
            name: name of the tracker.
            folder: folder of the run.
            settings: settings of the run; each is cut to `MAX_TEXT_LENGTH` characters.
        """
        self._name = name
        self._n_correct = Counter[str]()
        self._n_judged = Counter[str]()
        self._queue: Queue[tuple[MetricValues, int] | None] = Queue(MAX_QUEUED)
        setting_texts = _shorten_settings(settings)
        self._thread = threading.Thread(
            target=self._work, args=(folder, setting_texts), name=name, daemon=True
        )
        self._thread.start()

    def send_rows(self, rows: Sequence[Row]) -> None:
        """Send rows that were stored; returns at once."""
        kinds: dict[str, list[Row]] = defaultdict(list)
        for row in rows:
            kinds[row.kind].append(row)
        for kind, group in kinds.items():
            self._count_correct(kind, group)
            self._put((self._compute_metrics(kind, group), group[-1].step))

    def close(self) -> None:
        """Wait until all messages are sent, at most `MAX_CLOSE_SECONDS`.

        A second call does nothing.
        """
        self._put(None)
        self._thread.join(MAX_CLOSE_SECONDS)

    def _count_correct(self, kind: str, rows: Sequence[Row]) -> None:
        """Add rows of a kind to the counts for the accuracy."""
        is_correct = [row.correct for row in rows if row.correct is not None]
        self._n_correct[kind] += sum(is_correct)
        self._n_judged[kind] += len(is_correct)

    def _compute_metrics(self, kind: str, rows: Sequence[Row]) -> MetricValues:
        """Return metrics of rows by name, such as "search/margin".

        They are means over these rows. The accuracy is that of all rows of the kind so
        far, since a mean over few rows would jump.

        Args:
            kind: kind of the rows, with which the names begin.
            rows: rows that were stored together.
        """
        metrics = {}
        for name in METRICS:
            stored_values = [getattr(row, name) for row in rows]
            values = [float(value) for value in stored_values if value is not None]
            if values:
                metrics[f"{kind}/{name}"] = sum(values) / len(values)
        if self._n_judged[kind]:
            accuracy = self._n_correct[kind] / self._n_judged[kind]
            metrics[f"{kind}/accuracy"] = accuracy
        return metrics

    def _put(self, message: tuple[MetricValues, int] | None) -> None:
        """Queue metrics and their step for the thread; None ends the thread."""
        try:
            self._queue.put_nowait(message)
        except Full:
            return  # the tracker is slow; the rows themselves are in the run

    def _work(self, folder: Path, settings: Mapping[str, str]) -> None:
        """Send messages until None comes. This is the main function of the thread.

        Args:
            folder: folder of the run.
            settings: settings of the run as texts, by name.
        """
        try:
            log_metrics, close = _open_tracker(self._name, folder, settings)
            message = self._queue.get()
            while message is not None:
                log_metrics(*message)
                message = self._queue.get()
            close()
        except Exception as error:  # whatever a tracker does, the run goes on
            reason = str(error)[:MAX_REASON_LENGTH] or type(error).__name__
            _LOG.warning("nothing more is sent to %s: %s", self._name, reason)


def _shorten_settings(settings: JsonObject) -> dict[str, str]:
    """Return settings as texts of at most `MAX_TEXT_LENGTH` characters, without None."""
    return {
        key: str(value)[:MAX_TEXT_LENGTH]
        for key, value in settings.items()
        if value is not None
    }


def _open_tracker(
    name: str, folder: Path, settings: Mapping[str, str]
) -> tuple[LogMetrics, Callable[[], object]]:
    """Open a run of a tracker.

    Args:
        name: "mlflow", "tensorboard" or "wandb".
        folder: folder of our run, whose name the tracker's run gets.
        settings: settings of the run as texts, by name.

    Returns:
        A function that sends metrics by name with their step, and a function that ends
        the tracker's run.
    """
    package = _import_package(name)  # `mlflow`, `wandb` or `tensorboard.summary`
    if name == "mlflow":
        package.start_run(run_name=folder.name, nested=True)
        package.log_params(settings)
        return partial(_log_to_mlflow, package), package.end_run
    # The settings are not sent to TensorBoard: its files are in the folder of the run,
    # where run.yaml has them.
    if name == "tensorboard":
        writer = package.Writer(str(folder / "artifacts" / "tensorboard"))
        return partial(_log_to_tensorboard, writer), writer.close
    run = package.init(
        project="advsearch",
        name=folder.name,
        config=dict(settings),
        reinit="create_new",
    )
    return partial(_log_to_wandb, run), run.finish


def _log_to_mlflow(package: Any, numbers: MetricValues, step: int) -> None:
    """Send metrics with their step to MLflow; `package` is its module."""
    package.log_metrics(dict(numbers), step=step)


def _log_to_tensorboard(writer: Any, numbers: MetricValues, step: int) -> None:
    """Send metrics with their step to TensorBoard, by its writer."""
    for metric, value in numbers.items():
        writer.add_scalar(metric, value, step)


def _log_to_wandb(run: Any, numbers: MetricValues, step: int) -> None:
    """Send metrics with their step to Weights & Biases, into one of its runs."""
    # The step of wandb itself may never decrease, but the steps of each kind of
    # rows begin at 0. So the step is sent as a metric of its own, such as
    # "search/step" with the metric "search/margin".
    first_metric = next(iter(numbers), "rows/")  # "rows/" if there are no metrics
    kind = first_metric.partition("/")[0]
    run.log({**numbers, f"{kind}/step": step})


MetricValues = Mapping[str, float]
# sends metrics by name with their step
LogMetrics = Callable[[MetricValues, int], object]
