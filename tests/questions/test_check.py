"""`check` keeps what it has measured: stopped in any way, it goes on to the same rows."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

import advsearch
from advsearch.cli.main import main
from advsearch.engine.gradients import planning
from advsearch.engine.gradients.planning import count_cosine_samples, measure_cosines
from advsearch.errors import InputError
from advsearch.experiment import RunContext
from advsearch.interrupts import INTERRUPTS
from advsearch.progress import NullProgress
from advsearch.questions.check import carry_out as checking
from advsearch.questions.check import check
from advsearch.questions.check import result as words
from advsearch.questions.check.result import CheckConfig, CheckedRow, CheckResult, GainRow
from advsearch.runs.directory import RunDirectory
from advsearch.runs.listing import is_finished, list_runs
from advsearch.runs.measurements import Measurements, OutOfTime
from advsearch.runs.results import PathLength, Result
from advsearch.runs.summary import read_result

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


@pytest.mark.medium
@pytest.mark.slow
def test_ctrl_c_leaves_rows_and_resume_ends_with_the_same(
    tmp_path: Path, whole: CheckResult, capfd: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "run"
    words = [sys.executable, "-m", "advsearch", *FLAGS.split(), "--threads", "1", "--run", str(folder)]
    child = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path)
    assert child.stderr is not None
    for line in child.stderr:
        if "camera.azimuth by" in line:  # the first row
            os.kill(child.pid, signal.SIGINT)
            break
    said, _ = child.communicate(timeout=600)
    assert child.returncode == 130
    assert "Stopped after 0 of 1 parts" in said and said.endswith(f"Go on with: advsearch resume {folder}\n")
    stopped = kept(folder)
    assert stopped.ending == "interrupted" and 1 <= len(stopped.rows) < len(whole.rows)
    assert values(stopped) == values(whole)[: len(stopped.rows)]
    assert list_runs(tmp_path)[0].state == "stopped"
    main(["resume", str(folder), "--json"])
    answer = CheckResult.of(json.loads(capfd.readouterr().out))
    assert answer.ending == "done" and values(answer) == values(whole)
    assert is_finished(folder) and kept(folder).to_dict() == answer.to_dict()


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
def test_a_summary_never_forgets_what_an_earlier_one_had(
    tmp_path: Path, whole: CheckResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    both = [checking.CheckedPart(number, CheckConfig(**SMALL), "linear") for number in (1, 2)]
    told: list[int] = []

    def measured(sitting: checking.GradientCheck, part: checking.CheckedPart, title: str) -> Iterator[CheckedRow]:
        for number, row in enumerate(whole.rows):
            sitting.measurements.get(f"{part.key} {number}", row.to_dict)
            yield row

    monkeypatch.setattr(checking, "list_parts", lambda *_: both)
    monkeypatch.setattr(checking.GradientCheck, "_measure_linear", measured)
    write = RunDirectory.write_summary

    def written(run: RunDirectory, answer: CheckResult) -> Path:
        told.append(len(answer.rows))
        return write(run, answer)

    monkeypatch.setattr(RunDirectory, "write_summary", written)
    config, count = CheckConfig(**SMALL, run=str(tmp_path / "run")), len(whole.rows)
    check.run(config)
    assert told == [*range(1, 2 * count + 1), 2 * count]
    told.clear()
    check.run(config, resumed=tmp_path / "run")
    assert told == [2 * count]


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
    assert values(check.run(config, resumed=folder)) == values(whole) and is_finished(folder)
    assert main(["show", str(folder)]) == 0
    assert words.READING in capsys.readouterr().out


def test_what_is_stored_is_not_measured_again(tmp_path: Path) -> None:
    config = CheckConfig(**SMALL, run=str(tmp_path / "run"))
    with RunContext(config) as context:
        results = context.open_measurements()
        assert results.get("a", lambda: {"x": (0.1 + 0.2, float("inf"))}) == {"x": [0.1 + 0.2, float("inf")]}
        assert results.get("a", lambda: pytest.fail("measured again")) == {"x": [0.1 + 0.2, float("inf")]}
    with RunContext(config, resumed=tmp_path / "run") as context:
        late = context.open_measurements(seconds=0.0)
        assert late.get("a", lambda: pytest.fail("measured again")) == {"x": [0.1 + 0.2, float("inf")]}
        assert late.get("b", lambda: 1) == 1  # a sitting always gets on
        with pytest.raises(OutOfTime):
            late.get("c", lambda: 1)


def test_a_finished_part_is_not_even_loaded(whole: CheckResult, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("advsearch.api.workbench.problem_from_config", lambda *_, **__: pytest.fail("loaded"))
    begun = time.process_time()
    again = check.run(CheckConfig(**SMALL, run=whole.run), resumed=Path(str(whole.run)))
    assert values(again) == values(whole) and time.process_time() - begun < 20.0


def test_all_goes_through_every_control_on_three_scenes() -> None:
    parts = checking.list_parts(CheckConfig(all=True))
    assert [part.number for part in parts] == list(range(1, len(parts) + 1))
    assert {part.config.object for part in parts} == {"mug", "bowl", "bottle"} and len(parts) > 80


# ---- the plan of a search -------------------------------------------------------------------------------------------

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
            INTERRUPTS.count += 1
            raise RuntimeError("what Dr.Jit makes of a KeyboardInterrupt")


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few samples: what is measured says little, but it is measured by the same means."""
    for function in (measure_cosines, count_cosine_samples):
        monkeypatch.setattr(planning, function.__name__, partial(function, counts=(2,)))
    for name, value in {"FACTORS": (1.0, 3.0), "CONVERGED_SPP": 2, "CONVERGED_SPP_FACTOR": 2}.items():
        monkeypatch.setattr(planning, name, value)
    monkeypatch.setattr(INTERRUPTS, "count", 0)
    row = {"item": "tracing", "what": "tracing", "time_gain": 2.0, "seconds": 1.0, "safe": True}
    gain = GainRow.of({**row, "picture_difference": 0.0, "gradient_difference": 0.0})
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
        stopped = check.run(config, progress=stop, resumed=folder if number else None)
        assert stopped.ending == "interrupted" and not is_finished(folder)
        assert len(stopped.rows) > before or stopped.bounces is not None
        assert timeless(kept(folder)) == timeless(stopped)
        before = len(stopped.rows)
    INTERRUPTS.count = 0
    assert main(["resume", str(folder), "--json", "--quiet"]) in (0, 3)
    resumed = CheckResult.of(json.loads(capsys.readouterr().out))
    assert timeless(resumed) == timeless(whole) == timeless(kept(folder)) and is_finished(folder)
    assert main(["show", str(folder)]) == 0
    text = capsys.readouterr().out
    assert "How a search gets its derivatives" in text and "What that saves" in text


@pytest.mark.medium
@pytest.mark.usefixtures("quick")
def test_a_summary_keeps_its_rows_when_reading_them_back_is_interrupted(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    before = check.run(CheckConfig(**PLANNED, run=str(folder)), progress=Stop(3))
    assert len(before.rows) == 3
    again = check.run(CheckConfig(**PLANNED), progress=Stop(1), resumed=folder)
    assert timeless(again) == timeless(before) == timeless(kept(folder))


def test_a_run_that_goes_on_is_not_removed_when_that_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(INTERRUPTS, "count", 0)
    folder = tmp_path / "run"
    with RunDirectory.create_for(CheckConfig(**SMALL, run=str(folder))):
        pass  # a kill before anything was measured
    with pytest.raises(RuntimeError):
        check.run(CheckConfig(**SMALL), progress=Stop(stage="loading"), resumed=folder)
    assert (folder / "run.yaml").is_file()
    with pytest.raises(InputError), RunDirectory.create_for(CheckConfig(**SMALL, run=str(tmp_path / "new"))):
        raise InputError("")
    assert not (tmp_path / "new").exists()


def test_plan_says_what_took_its_place(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", "--object", "mug"]) == 2
    assert "`plan` is a part of `check` now: use advsearch check --loss model" in capsys.readouterr().err
    with pytest.raises(AttributeError, match="part of `check` now"):
        getattr(advsearch, "plan")  # noqa: B009
