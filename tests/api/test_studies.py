"""Curves, gaps and regions: their accounting with stand-ins for attacks, and one small region and one search over
conditions that are rendered."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import advsearch
import samples
from advsearch.cli.main import main
from advsearch.cli.output import format_result as region_text
from advsearch.cli.output import format_result as text_of
from advsearch.engine.transport import CleanMatrix
from advsearch.errors import InputError, UnknownNameError
from advsearch.experiment import RunContext, run_and_save, run_experiment
from advsearch.questions.attack import studies
from advsearch.questions.attack.display import make_attack_claims
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.attack.studies import curve
from advsearch.questions.attack.summary import AttackSummary
from advsearch.questions.region import boxes, growing, region
from advsearch.questions.region.result import RegionConfig
from advsearch.runs.directory import RunDirectory
from advsearch.runs.listing import is_finished, list_runs
from advsearch.runs.summary import read_result
from samples import ATTACK, AVERAGE, rated
from samples import attack as attacked

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


@pytest.mark.medium
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
    assert (Path("runs/study/images") / "attack.svg").is_file()
    assert json.loads(Path("runs/study/summary.json").read_text())["curve"] == summary.to_dict()["curve"]
    assert "2/4" in text_of(summary) and "already wrong" in text_of(summary)


def test_a_label_for_several_objects_says_whose_own_it_is_not(asked: list[AttackConfig]) -> None:
    summary = run_and_save(curve, RunContext(AttackConfig(object="mug,bowl", label="mug", run="curve")))
    assert any("also for bowl (its own is 'bowl')" in text for text in summary.warnings)


@pytest.mark.parametrize("several", [{"object": "mug,bowl"}, {"object": "mug", "epsilon": (0.1, 0.2)}])
def test_an_attack_on_several_objects_or_epsilons_is_a_curve(
    several: dict[str, Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    run = str(tmp_path / "it")
    monkeypatch.setattr(
        "advsearch.questions.attack.studies.curve", lambda asked: samples.curve(run=str(asked.run.path))
    )
    assert run_experiment(AttackConfig(**several, run=run)) == samples.curve(run=run)


def test_several_objects_and_one_budget_make_one_row_each(asked: list[AttackConfig]) -> None:
    summary = run_and_save(curve, RunContext(AttackConfig(object="mug,pan", run="study")))
    assert [row.ending for row in summary.table] == ["found", "budget spent"]
    assert [one.robust for one in summary.curve] == [1] and len(asked) == 2


@pytest.mark.medium
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
    summary = run_and_save(curve, RunContext(config, resumed=Path("runs/study")))
    assert [row.object for row in summary.table] == ["mug", "bowl", "vase", "pan"]
    assert len(asked) == 4, "two before the stop, two after it"
    assert "45/50 (90 %)" in text_of(summary) and "20/20" in text_of(summary)


@pytest.mark.medium
def test_the_average_stands_beside_the_worst_case_of_each_object(asked: list[AttackConfig]) -> None:
    summary = run_and_save(curve, RunContext(AttackConfig(object="mug,bowl", average=50, run="study")))
    assert [one.average for one in asked] == [50, 50]
    assert [row.average and row.average.correct for row in summary.table] == [45, 45]
    text = text_of(summary)
    assert "right on average" in text and len(re.findall(r"45/50 \(90 %\) +78-97 %", text)) == 2
    named = [claim.statement for claim in make_attack_claims(summary) if "drawn by chance" in claim.statement]
    assert [text.partition(":")[0] for text in named] == ["mug", "bowl"]


# ---- rendered -------------------------------------------------------------------------------------------------------

SMALL: dict[str, Any] = {"object": "mug", "resolution": 16, "denoise": "none"}


@pytest.mark.medium
def test_a_region_is_told_in_the_units_of_its_parameters(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(boxes, "MAX_PROBED", 20)
    config = RegionConfig(
        **SMALL, controls={"pose": {"yaw": [10, 50], "pitch": 0, "roll": 0, "x": 0, "z": 0}, "camera.elevation": {}},
        vary="pose.yaw,camera.elevation", samples=8, map=2, verify_spp=2, run=str(tmp_path / "run"),
    )  # fmt: skip
    try:
        result = region.run(config)
    except InputError as error:  # sixteen pixels may leave the verdict to the noise, which is said
        assert "depends on the noise" in str(error)
        return
    assert result.box and result.map and result.volume is not None and result.same is not None
    yaw, elevation = result.box
    assert (yaw.name, yaw.unit) == ("pose.yaw", "degrees") and 10 <= yaw.low <= yaw.centre <= yaw.high <= 50
    assert elevation.unit == "degrees" and 0.0 <= result.volume <= 1.0
    assert result.samples == 8 and result.same <= 8 and len(result.map.margins) == 2
    assert (tmp_path / "run" / "images" / "map.png").is_file()
    assert "fresh samples of this box" in region_text(result)
    assert read_result(tmp_path / "run").to_dict() == result.to_dict()


def test_a_region_that_is_interrupted_says_how_to_go_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(*_: Any, **__: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(boxes, "grow_box", stopped)
    monkeypatch.setattr(
        growing,
        "find_verdict",
        lambda verifier, centre: next(verifier.try_configurations("centre", {0: centre})).success,
    )
    folder = tmp_path / "run"
    flags = (
        f"region --object mug --control pose.yaw --resolution 16 --denoise none --verify-spp 2 --run {folder} --quiet"
    )
    assert main(flags.split()) == 130
    said = capsys.readouterr().out
    assert said.startswith("Stopped before the box was known.") and "renders       1\n" in said
    assert said.endswith(f"Go on with: advsearch resume {folder}\n")
    assert main(["show", str(folder)]) == 0 and capsys.readouterr().out == said
    assert not is_finished(folder) and list_runs(tmp_path)[0].state == "stopped"


@pytest.mark.parametrize(
    ("more", "error", "message"),
    [
        ({"vary": "pose.yawn"}, UnknownNameError, "unknown parameter in `vary` 'pose.yawn'. Did you mean 'pose.yaw'"),
        ({"map": 4, "vary": "pose.yaw"}, InputError, "map: expected two parameters in `vary`, got 1"),
        ({"controls": {"texture": {"resolution": 4}}}, InputError, "vary: expected 1 to 8 parameters, got "),
    ],
)
def test_a_region_refuses_what_does_not_fit(more: dict[str, Any], error: Any, message: str, tmp_path: Path) -> None:
    with pytest.raises(error, match=message):
        region.run(RegionConfig(**{**SMALL, "controls": "pose", **more, "run": str(tmp_path / "run")}))
    assert not (tmp_path / "run").exists()


@pytest.mark.medium
def test_one_texture_for_many_conditions(tmp_path: Path) -> None:
    names = advsearch.load_model("reference").labels
    result = advsearch.attack(
        "mug", label=[name for name in names if name != "lamp"],  # at 16 pixels a mug is none
        controls={"texture": {"resolution": 4}}, over=["camera.azimuth"], resolution=16, denoise="none", steps=3,
        draws=2, trials=6, verify_spp=2, average=3, baseline=False, run=tmp_path / "run",
    )  # fmt: skip
    summary = result.summary
    assert summary.over == ["camera"] and summary.controls == ["texture"]
    assert summary.configuration and all(name.startswith("texture") for name in summary.configuration)
    assert summary.verified is None or summary.verified.trials <= 6
    with RunDirectory.resume(tmp_path / "run") as run:
        trials = list(run.store.rows("control"))
        searched = list(run.store.rows("search"))
    azimuths = {json.dumps(row.values["camera.azimuth"]) for row in trials}
    assert len(azimuths) == 6, "every trial has conditions of its own"
    assert all("camera.azimuth" not in row.values for row in searched)
