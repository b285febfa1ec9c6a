"""`check` keeps what it has measured: stopped in any way, it goes on to the same rows."""

import json
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from advsearch.cli.main import main
from advsearch.engine.gradients import planning
from advsearch.engine.gradients.planning import count_cosine_samples, measure_cosines
from advsearch.experiment import RunContext
from advsearch.interrupts import INTERRUPTS
from advsearch.progress import NullProgress
from advsearch.questions.check import carry_out as checking
from advsearch.questions.check import check
from advsearch.questions.check import result as words
from advsearch.questions.check.result import CheckConfig, CheckResult, GainRow
from advsearch.runs.listing import is_finished
from advsearch.runs.measurements import Measurements
from advsearch.runs.results import PathLength, Result
from advsearch.runs.summary import read_result

pytestmark = pytest.mark.island("advsearch.questions.check")

FLAGS = "check --object mug --control camera.azimuth,environment.rotation --loss linear --resolution 16 --spp 1"
SMALL: dict[str, Any] = {
    "object": "mug",
    "controls": {"camera.azimuth": {}, "environment.rotation": {}},
    "loss": "linear",
    "resolution": 16,
    "spp": 1,
    "threads": 1,
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> CheckResult:
    """The summary of a check that nobody disturbed."""
    run = tmp_path_factory.mktemp("whole") / "run"
    return check.run(CheckConfig(**SMALL, run=str(run)))


def values(result: Result) -> list[dict[str, Any]]:
    """The rows without their times."""
    found: Any = result.to_dict()
    return [{name: value for name, value in row.items() if name != "seconds"} for row in found["rows"]]


def kept(folder: Path) -> CheckResult:
    """What a run keeps."""
    result = read_result(folder)
    assert isinstance(result, CheckResult)
    return result


@pytest.mark.slow
def test_a_kill_leaves_the_rows_that_were_told(tmp_path: Path, whole: CheckResult) -> None:
    folder = tmp_path / "run"
    words = [sys.executable, "-m", "advsearch", *FLAGS.split(), "--threads", "1", "--run", str(folder)]
    child = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, cwd=tmp_path)
    assert child.stderr is not None
    for line in child.stderr:
        if "camera.azimuth by" in line:  # the first row
            child.kill()
            break
    child.communicate(timeout=600)
    killed = kept(folder)
    assert killed.ending == "interrupted" and (killed.measured, killed.planned) == (0, 1)
    assert 1 <= len(killed.rows) < len(whole.rows) and values(killed) == values(whole)[: len(killed.rows)]


@pytest.mark.medium
def test_seconds_end_a_check_and_resume_goes_on_for_as_long_again(
    tmp_path: Path, whole: CheckResult, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "run"
    config = CheckConfig(**SMALL, seconds=0.001, run=str(folder))
    summary = check.run(config)
    assert summary.ending == "out of time" and not is_finished(folder)
    # a sitting that is longer
    monkeypatch.setattr(RunContext, "open_measurements", lambda context, seconds=None: Measurements(context))
    assert values(check.run(config, resumed_directory=folder)) == values(whole) and is_finished(folder)
    assert main(["show", str(folder)]) == 0
    assert words.READING in capsys.readouterr().out


PLANNED: dict[str, Any] = {
    **SMALL,
    "loss": "model",
    "estimators": {"*": "differences"},
    "controls": {"camera.azimuth": {}, "environment.rotation": {}},
}


class Stop(NullProgress):
    """A watcher that presses Ctrl-C when so many messages have come, or at the stage with a name."""

    def __init__(self, messages: int = -1, stage: str = "") -> None:
        self.left, self.at = messages, stage

    def message(self, text: str) -> None:
        self.left -= 1
        if self.left == 0:
            raise KeyboardInterrupt

    def stage(self, name: str, total: int | None = None, *, hint: str = "", at_most: bool = False) -> None:
        if self.at and self.at in name:
            INTERRUPTS.n_received += 1
            raise RuntimeError("what Dr.Jit makes of a KeyboardInterrupt")


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few samples: what is measured says little, but it is measured by the same means."""
    for function in (measure_cosines, count_cosine_samples):
        monkeypatch.setattr(planning, function.__name__, partial(function, counts=(2,)))
    for name, value in {"FACTORS": (1.0, 3.0), "CONVERGED_SPP": 2, "CONVERGED_SPP_FACTOR": 2}.items():
        monkeypatch.setattr(planning, name, value)
    monkeypatch.setattr(INTERRUPTS, "n_received", 0)
    row = {"item": "tracing", "what": "tracing", "time_gain": 2.0, "seconds": 1.0, "safe": True}
    gain = GainRow.from_values({**row, "picture_difference": 0.0, "gradient_difference": 0.0})
    monkeypatch.setattr(checking, "measure_gains", lambda *_, **__: [gain])
    length = PathLength(depth=3, full=6, cuts=[], configurations=1, reason="few")
    monkeypatch.setattr(planning, "measure_problem_bounces", lambda *_, **__: length)


def timeless(result: CheckResult) -> dict[str, Any]:
    """The result without times and its place."""

    def without(value: Any) -> Any:
        if isinstance(value, dict):
            return {
                name: without(inner) for name, inner in value.items() if name not in ("seconds", "run", "command_line")
            }
        return [without(inner) for inner in value] if isinstance(value, list) else value

    cleaned: dict[str, Any] = without(result.to_dict())
    return cleaned


@pytest.mark.medium
@pytest.mark.usefixtures("quick")
def test_a_check_that_is_stopped_anywhere_goes_on_to_the_same_plan(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = check.run(CheckConfig(**PLANNED, run=str(tmp_path / "whole")))
    assert whole.ending == "done" and is_finished(tmp_path / "whole")
    assert whole.gains and whole.bounces is not None and whole.plan is not None and whole.plan.left_out
    config, folder, before = CheckConfig(**PLANNED, run=str(tmp_path / "run")), tmp_path / "run", 0
    for number, stop in enumerate((Stop(1), Stop(2), Stop(stage="saves"), Stop(stage="gradients for camera"))):
        stopped = check.run(config, progress=stop, resumed_directory=folder if number else None)
        assert stopped.ending == "interrupted" and not is_finished(folder)
        assert len(stopped.rows) > before or stopped.bounces is not None
        assert timeless(kept(folder)) == timeless(stopped)
        before = len(stopped.rows)
    INTERRUPTS.n_received = 0
    assert main(["resume", str(folder), "--json", "--quiet"]) in (0, 3)
    resumed = CheckResult.from_values(json.loads(capsys.readouterr().out))
    assert timeless(resumed) == timeless(whole) == timeless(kept(folder)) and is_finished(folder)
