"""Curves and regions: their accounting with stand-ins for attacks, and one small region that is rendered."""

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from advsearch.engine.prediction import CleanMatrix
from advsearch.experiment import RunContext, run_and_save
from advsearch.questions.attack import studies
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.attack.studies import curve
from advsearch.questions.attack.summary import AttackSummary
from advsearch.runs.directory import RunDirectory
from samples import ATTACK, AVERAGE, rated
from samples import attack as attacked

pytestmark = pytest.mark.medium

FLIPS = {"mug": 0.02, "bowl": 0.1, "vase": 0.0, "pan": 9.0}
"""The epsilon at which each object flips; 0: it is wrong already."""


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[AttackConfig]:
    """Attacks that were carried out; their stand-in leaves a run with a summary."""
    monkeypatch.chdir(tmp_path)
    done: list[AttackConfig] = []

    def attack(config: AttackConfig, *, progress: Any, clean: CleanMatrix | None = None) -> Any:
        done.append(config)
        with RunDirectory.create(config.run, overwrite=config.overwrite, config=config) as run:
            summary = summary_of(config, str(run.path))
            run.write_summary(summary)
        return SimpleNamespace(summary=summary)

    monkeypatch.setattr(studies, "attack_once", attack)
    return done


def summary_of(config: AttackConfig, run: str) -> AttackSummary:
    epsilon, flips = config.epsilon if isinstance(config.epsilon, float) else 0.1, FLIPS[config.object]
    ending = "already wrong" if flips == 0.0 else "found" if flips <= epsilon else "budget spent"
    control = {"correct": 0 if flips == 0.0 else 20, "trials": 20, "rate": float(flips > 0.0), "interval": [0.8, 1.0]}
    return attacked(
        run=run,
        ending=ending,
        epsilon=epsilon,
        clean={**ATTACK["clean"], "control": control},
        verified=None if flips == 0.0 else rated(20 * (ending == "found")),
        average={**AVERAGE, "configurations": 50, "correct": 45, "accuracy": 0.9, "interval": [0.78, 0.97]},
    )


def test_a_curve_counts_robust_objects_at_each_epsilon(asked: list[AttackConfig]) -> None:
    config = AttackConfig(object="mug,bowl,vase,pan", epsilon="0.1,0.01,0.05", run="study")
    summary = run_and_save(curve, RunContext(config))
    told = [(one.epsilon, one.robust, one.found, one.already_wrong) for one in summary.curve]
    assert told == [(0.01, 3, 0, 1), (0.05, 2, 1, 1), (0.1, 1, 2, 1)]
    low, high = summary.curve[1].interval
    assert summary.curve[1].accuracy == 0.5 and 0.06 < low < 0.07 and 0.93 < high < 0.94
    assert [row.flips_at for row in summary.table] == [0.05, 0.1, None, None]
    tried = [(one.object, one.epsilon) for one in asked]  # none beyond the epsilon at which an object flips
    assert tried == [
        ("mug", 0.01), ("mug", 0.05), ("bowl", 0.01), ("bowl", 0.05), ("bowl", 0.1), ("vase", 0.01),
        ("pan", 0.01), ("pan", 0.05), ("pan", 0.1),
    ]  # fmt: skip
    assert json.loads(Path("runs/study/summary.json").read_text())["curve"] == summary.to_dict()["curve"]


def test_a_study_goes_on_with_the_part_at_which_it_was_stopped(
    asked: list[AttackConfig], monkeypatch: pytest.MonkeyPatch
) -> None:
    config = AttackConfig(object="mug,bowl,vase,pan", average=50, run="study")
    carry_out: Callable[..., Any] = vars(studies)["attack_once"]  # the stand-in

    def stopped(config: AttackConfig, *, progress: Any, clean: CleanMatrix | None = None) -> Any:
        if len(asked) == 2:
            raise KeyboardInterrupt
        return carry_out(config, progress=progress)

    monkeypatch.setattr(studies, "attack_once", stopped)
    with pytest.raises(KeyboardInterrupt):
        run_and_save(curve, RunContext(config))
    assert Path("runs/study/parts/00-mug/summary.json").is_file()
    monkeypatch.setattr(studies, "attack_once", carry_out)
    summary = run_and_save(curve, RunContext(config, resumed_directory=Path("runs/study")))
    assert [row.object for row in summary.table] == ["mug", "bowl", "vase", "pan"]
    assert len(asked) == 4, "two before the stop, two after it"
