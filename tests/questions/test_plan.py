"""`plan` keeps what it has measured: stopped in any way, it goes on to the same rows."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from advsearch.cli.main import main
from advsearch.cli.output import shown_text as answer
from advsearch.engine.planning import cosine_samples, cosines
from advsearch.engine.record import Results
from advsearch.errors import InputError
from advsearch.interrupts import INTERRUPTS
from advsearch.progress import NullProgress
from advsearch.questions.plan import carry_out as planning
from advsearch.questions.plan.answer import READING, GainRow, PlanResult
from advsearch.questions.plan.carry_out import plan_from_config, quieter
from advsearch.questions.plan.settings import PlanConfig
from advsearch.runs.directory import RunDirectory
from advsearch.runs.listing import finished, listed_runs
from advsearch.runs.results.base import CosineRow, PathLength
from advsearch.runs.summary import read_result

SMALL: dict[str, Any] = {
    "object": "mug",
    "controls": {"camera.azimuth": {}, "environment.rotation": {}},
    "resolution": 16,
    "spp": 1,
    "threads": 1,
}
FORCED: dict[str, Any] = {**SMALL, "estimators": {"*": "differences"}}
"""Which estimator is best depends on the machine's time."""
LEFT = [
    *("step and samples of camera", "step and samples of environment"),
    "what can be left out",
    *("camera with denoiser none", "environment with denoiser none"),
]


def gains() -> list[GainRow]:
    """Rows of what is left out, whose measurement takes long and is tested elsewhere."""
    row = {"item": "tracing", "what": "tracing", "gain": 2.0, "seconds": 1.0, "safe": True}
    return [GainRow.of({**row, "picture_difference": 0.0, "gradient_difference": 0.0})]


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few samples: what is measured says little, but it is measured by the same means."""
    for function in (cosines, cosine_samples):
        monkeypatch.setattr(planning, function.__name__, partial(function, counts=(2,)))
    monkeypatch.setattr("advsearch.engine.planning.FACTORS", (1.0, 3.0))
    monkeypatch.setattr("advsearch.engine.planning.CONVERGED", 2)
    monkeypatch.setattr("advsearch.engine.planning.AGAIN", 2)
    monkeypatch.setattr(INTERRUPTS, "count", 0)
    monkeypatch.setattr(planning, "measured_gains", lambda *_, **__: gains())
    length = PathLength(depth=3, full=6, cuts=[], configurations=1, reason="few")
    monkeypatch.setattr(planning, "bounces_of", lambda *_, **__: length)


def timeless(result: PlanResult) -> dict[str, Any]:
    """The result without times, what they decide, and its place."""

    def without(value: Any) -> Any:
        if isinstance(value, dict):
            return {name: without(one) for name, one in value.items() if name not in ("seconds", "run")}
        return [without(one) for one in value] if isinstance(value, list) else value

    kept: dict[str, Any] = without(result.to_dict())
    del kept["denoise"]
    return kept


def kept(folder: Path) -> PlanResult:
    """What a run keeps."""
    result = read_result(folder)
    assert isinstance(result, PlanResult)
    return result


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


def test_a_plan_that_is_stopped_anywhere_goes_on_to_the_same_result(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = plan_from_config(PlanConfig(**FORCED, run=str(tmp_path / "whole")))
    assert whole.ending == "done" and whole.not_measured == [] and finished(tmp_path / "whole")
    assert whole.gains and whole.bounces is not None and {row.denoise for row in whole.cosines} == {"oidn", "none"}
    config, folder, before = PlanConfig(**FORCED, run=str(tmp_path / "run")), tmp_path / "run", 0
    stops = (Stop(1), Stop(2), Stop(stage="saves"), Stop(stage="denoiser none"))
    for number, stop in enumerate(stops):
        stopped = plan_from_config(config, progress=stop, resumed=folder if number else None)
        assert stopped.ending == "interrupted" and not finished(folder)
        assert len(stopped.cosines) > before or stopped.bounces is not None
        assert timeless(kept(folder)) == timeless(stopped)
        before = len(stopped.cosines)
        if number == 0:
            assert stopped.not_measured == LEFT and before == 1
            assert "Not measured, it was stopped\nstep and samples of camera\n" in answer(stopped)
            assert listed_runs(tmp_path)[0].state == "stopped"
    INTERRUPTS.count = 0
    assert main(["resume", str(folder), "--json", "--quiet"]) == 0
    resumed = PlanResult.of(json.loads(capsys.readouterr().out))
    assert timeless(resumed) == timeless(whole) == timeless(kept(folder)) and finished(folder)
    assert main(["show", str(folder)]) == 0
    assert READING in capsys.readouterr().out


def test_seconds_end_a_plan_and_may_be_changed_before_it_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, sittings = tmp_path / "run", list[Results]()

    def results(memory: Any, seconds: float | None) -> Results:
        sittings.append(Results(memory, seconds))
        return sittings[-1]

    monkeypatch.setattr(planning, "Results", results)
    cut = plan_from_config(PlanConfig(**SMALL, seconds=1e-9, run=str(folder)))
    assert cut.ending == "out of time" and not cut.cosines and cut.not_measured == ["ways to differentiate", *LEFT]
    assert "Not measured, the time was up\nways to differentiate\n" in answer(cut)
    assert main(["resume", str(folder), "--quiet"]) == 0  # one gradient is taken, whatever the time
    assert f"Go on with: advsearch resume {folder}\n" in capsys.readouterr().out
    assert [one.made for one in sittings] == [1, 1]
    assert main(["resume", str(folder), "seconds=3600", "--quiet"]) == 0
    assert kept(folder).ending == "done" and kept(folder).command_line == cut.command_line.replace("1e-09", "3600")
    other = tmp_path / "other"
    plan_from_config(PlanConfig(**SMALL, seconds=1e-9, run=str(other)))
    assert main(["resume", str(other), "seed=1"]) == 2
    assert "seed was 0 and is 1 now" in capsys.readouterr().err


@pytest.mark.slow
def test_a_kill_leaves_the_rows_that_were_told(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    words = "plan --object mug --control camera.azimuth --denoise none --resolution 16 --spp 1 --threads 1 --run"
    child = subprocess.Popen(
        [sys.executable, "-m", "advsearch", *words.split(), str(folder)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert child.stderr is not None
    for line in child.stderr:
        if "has a cosine of" in line:
            child.kill()
            break
    child.communicate(timeout=120)
    killed = kept(folder)
    assert killed.ending == "interrupted" and killed.cosines and "what can be left out" in killed.not_measured


def test_a_run_that_goes_on_is_not_removed_when_that_fails(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with RunDirectory.create_for(PlanConfig(**SMALL, run=str(folder))):
        pass  # a kill before anything was measured
    with pytest.raises(RuntimeError):
        plan_from_config(PlanConfig(**SMALL), progress=Stop(stage="loading"), resumed=folder)
    assert (folder / "run.yaml").is_file()
    with pytest.raises(InputError), RunDirectory.create_for(PlanConfig(**SMALL, run=str(tmp_path / "new"))):
        raise InputError("")
    assert not (tmp_path / "new").exists()


def test_a_summary_keeps_its_rows_when_reading_them_back_is_interrupted(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    before = plan_from_config(PlanConfig(**FORCED, run=str(folder)), progress=Stop(3))
    assert len(before.cosines) == 3
    again = plan_from_config(PlanConfig(**FORCED), progress=Stop(1), resumed=folder)
    assert timeless(again) == timeless(before) == timeless(kept(folder))


def test_nothing_is_said_of_a_denoiser_that_was_not_measured() -> None:
    row: dict[str, Any] = {"control": "pose", "factor": 1.0, "spp": 8, "converged": 1.0, "status": "ok"}
    rows: Sequence[CosineRow] = [CosineRow.of({**row, "denoise": "oidn", "cosine": 0.95, "seconds": 2.0})]
    other = [CosineRow.of({**row, "denoise": "none", "cosine": 0.93, "seconds": 1.0})]
    said: Callable[..., str] = lambda **tables: quieter(tables, "oidn").reason  # noqa: E731
    assert quieter({"oidn": rows, "none": []}, "oidn").advised == "oidn"
    assert said(oidn=rows, none=[]) == "the other one was not measured"
    assert quieter({"oidn": rows, "none": other}, "oidn").advised == "none"
