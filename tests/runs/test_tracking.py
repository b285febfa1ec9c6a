"""What is evaluated, told to other programs: by stand-ins of their packages, which keep what they are told."""

import logging
import sys
import threading
import types
from pathlib import Path
from typing import Any

import pytest

from advsearch.questions.attack.settings import AttackConfig
from advsearch.runs import trackers
from advsearch.runs.directory import RunDirectory
from advsearch.runs.store import Row

Told = list[tuple[Any, ...]]


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch) -> Told:
    """What stand-ins of the three packages were told, in order; mlflow's runs belong to a thread, as the real one's."""
    calls: Told = []

    def note(name: str) -> Any:
        return lambda *args, **kwargs: calls.append((name, *args, *sorted(kwargs.items())))

    class Writer:
        def __init__(self, folder: str) -> None:
            calls.append(("open", folder))
            self.add_scalar, self.close = note("scalar"), note("close")

    wandb_run = types.SimpleNamespace(log=note("log"), finish=note("finish"))

    def init(**given: Any) -> Any:
        calls.append(("init", given["name"], given["config"]["object"]))
        return wandb_run

    names = ("start_run", "log_params", "log_metrics", "end_run")
    for name, module in {
        "mlflow": types.SimpleNamespace(**{one: note(one) for one in names}),
        "tensorboard.summary": types.SimpleNamespace(Writer=Writer),
        "wandb": types.SimpleNamespace(init=init),
    }.items():
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setitem(sys.modules, "tensorboard", types.SimpleNamespace())
    return calls


ROWS = (
    Row("search", 0, objective=1.0, success=False),
    Row("search", 1, objective=2.0, success=True),
    Row("baseline", 0, objective=-1.0),
)


def run_of(path: Path, log: str) -> None:
    """An attack that keeps three rows."""
    with RunDirectory.open(AttackConfig(object="mug", run=str(path), log=log)) as run:
        for row in ROWS:
            run.append_rows(row)


def test_tensorboard_is_told(tmp_path: Path, told: Told) -> None:
    run_of(tmp_path / "run", "tensorboard")
    assert told == [
        ("open", str(tmp_path / "run/artifacts/tensorboard")),
        ("scalar", "search/objective", 1.0, 0),
        ("scalar", "search/success", 0.0, 0),
        ("scalar", "search/objective", 2.0, 1),
        ("scalar", "search/success", 1.0, 1),
        ("scalar", "baseline/objective", -1.0, 0),
        ("close",),
    ]


def test_mlflow_is_told(tmp_path: Path, told: Told) -> None:
    run_of(tmp_path / "run", "mlflow")
    assert told[0] == ("start_run", ("nested", True), ("run_name", "run"))
    assert told[1][1]["object"] == "mug"
    assert told[2:] == [
        ("log_metrics", {"search/objective": 1.0, "search/success": 0.0}, ("step", 0)),
        ("log_metrics", {"search/objective": 2.0, "search/success": 1.0}, ("step", 1)),
        ("log_metrics", {"baseline/objective": -1.0}, ("step", 0)),
        ("end_run",),
    ]


def test_wandb_is_told(tmp_path: Path, told: Told) -> None:
    run_of(tmp_path / "run", "wandb")
    assert told == [
        ("init", "run", "mug"),
        ("log", {"search/objective": 1.0, "search/success": 0.0, "search/step": 0}),
        ("log", {"search/objective": 2.0, "search/success": 1.0, "search/step": 1}),
        ("log", {"baseline/objective": -1.0, "baseline/step": 0}),
        ("finish",),
    ]


@pytest.mark.parametrize("when", ["start_run", "log_metrics", "end_run"])
def test_a_tracker_that_fails_does_not_stop_a_run(
    tmp_path: Path, told: Told, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, when: str
) -> None:
    def fail(*args: Any, **kwargs: Any) -> None:
        raise ConnectionError("no network")

    monkeypatch.setattr(sys.modules["mlflow"], when, fail)
    with caplog.at_level(logging.WARNING, "advsearch"):
        run_of(tmp_path / "run", "mlflow")
    assert caplog.messages == ["nothing more is sent to mlflow: no network"]
    with RunDirectory.resume(tmp_path / "run") as run:
        assert run.store.count_rows() == 3


def test_a_tracker_that_hangs_does_not_hold_a_run_up(
    tmp_path: Path, told: Told, monkeypatch: pytest.MonkeyPatch
) -> None:
    ended = threading.Event()
    monkeypatch.setattr(sys.modules["mlflow"], "log_metrics", lambda *args, **kwargs: ended.wait(30))
    monkeypatch.setattr(trackers, "MAX_CLOSE_SECONDS", 0.05)
    run_of(tmp_path / "run", "mlflow")
    assert ("end_run",) not in told
    ended.set()
