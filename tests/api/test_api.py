"""`attack` from Python, end to end, with a tiny model and pictures of 32 pixels."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

import advsearch
from advsearch.cli.output import format_result as text_of
from advsearch.errors import InputError, RunExistsError, UnknownNameError
from advsearch.progress import NullProgress
from advsearch.questions.attack.carry_out import problem_from_config
from advsearch.questions.attack.settings import AttackConfig
from advsearch.runs.listing import can_resume, list_runs
from advsearch.runs.store import Row, Store
from covering import only
from stand_ins import interrupted

SIZE = 32
LABELS = ("mug", "vase")
FAST: dict[str, Any] = {"resolution": (SIZE, SIZE), "steps": 6, "spp": 2, "trials": 6, "verify_spp": 4}


class Brightness(nn.Module):
    """Says "mug" while the middle of the picture is darker than a threshold: an easy victim with a known weakness."""

    def __init__(self, threshold: float, slope: float = 40.0) -> None:
        super().__init__()
        self.threshold, self.slope = threshold, slope

    def forward(self, images: Tensor) -> Tensor:
        middle = images[:, :, SIZE // 4 : -SIZE // 4, SIZE // 4 : -SIZE // 4].mean(dim=(1, 2, 3))
        score = self.slope * (middle - self.threshold)
        return torch.stack([-score, score], dim=1)


def model(threshold: float) -> advsearch.Model:
    return advsearch.load_model(Brightness(threshold), labels=LABELS, input_size=SIZE, name="brightness")


@pytest.fixture(scope="module")
def scene() -> advsearch.Scene:
    return advsearch.load_scene("mug")


@pytest.fixture(scope="module")
def level(scene: advsearch.Scene) -> float:
    """What `Brightness` sees of the clean mug."""
    render = scene.renderer("texture", resolution=SIZE)
    with torch.no_grad():
        return float(render(render.start, spp=64)[SIZE // 4 : -SIZE // 4, SIZE // 4 : -SIZE // 4].mean())


@pytest.mark.medium
def test_a_weakness_is_found_verified_and_kept(scene: advsearch.Scene, level: float, tmp_path: Path) -> None:
    result = advsearch.attack(scene, model(level + 0.03), run=tmp_path / "run", **FAST)
    summary = result.summary
    assert result.found and summary.ending == "found"
    assert summary.verified and summary.clean.control and summary.adversarial and summary.baseline
    assert summary.verified.successes == summary.verified.trials == 6
    assert summary.clean.control.correct == 6 and summary.clean.label == "mug"
    assert summary.adversarial.label == "vase" and summary.verified.labels == {"vase": 6}
    assert summary.renders["search"] == summary.baseline.renders
    assert json.loads((tmp_path / "run" / "summary.json").read_text("utf-8")) == summary.to_dict()
    for name in ("clean.png", "clean.exr", "adversarial.png", "adversarial.exr", "difference.png", "search.gif"):
        assert (tmp_path / "run" / "images" / name).stat().st_size > 0, name
    for name in ("texture.png", "texture.exr", "texture-original.png"):
        assert (tmp_path / "run" / "artifacts" / name).stat().st_size > 0, name
    assert AttackConfig.from_yaml(tmp_path / "run" / "run.yaml").steps == 6
    assert (tmp_path / "run" / "report.html").is_file()


@pytest.mark.medium
def test_the_result_stays_in_its_budget_and_beats_its_start(scene: advsearch.Scene, level: float) -> None:
    result = advsearch.attack(
        scene, model(level + 0.03), controls={"texture": {"epsilon": 0.05}}, baseline=False, **FAST
    )
    start = scene.renderer("texture", resolution=SIZE).start
    assert float((result.u - start).abs().max()) <= 0.05 + 1e-6
    assert float(result.u.min()) >= 0.0 and float(result.u.max()) <= 1.0
    assert float(result.adversarial.mean()) > float(result.clean.mean())
    assert result.run is None and result.summary.baseline is None


@pytest.mark.medium
def test_an_l2_budget_is_kept(scene: advsearch.Scene, level: float) -> None:
    controls = {"texture": {"epsilon": 3.0, "norm": "l2", "resolution": 32}}
    result = advsearch.attack(scene, model(level + 0.03), controls=controls, baseline=False, **FAST)
    start = scene.renderer(controls, resolution=SIZE).start
    assert 2.9 <= float((result.u - start).norm()) <= 3.0 + 1e-4


def test_a_start_that_is_already_wrong_is_said_and_not_counted(scene: advsearch.Scene, level: float) -> None:
    result = advsearch.attack(scene, model(level - 0.1), **FAST)
    summary = result.summary
    assert summary.ending == "already wrong" and not result.found
    assert summary.verified is None and summary.adversarial is None
    assert summary.clean.label == "vase" and summary.clean.control and summary.clean.control.correct == 0
    assert summary.renders["search"] == summary.renders["gradient"] == 0


@pytest.mark.medium
def test_what_cannot_be_found_is_not_claimed(scene: advsearch.Scene) -> None:
    summary = advsearch.attack(scene, model(0.98), **FAST).summary
    assert summary.ending == "budget spent"
    assert summary.verified and summary.verified.successes == 0
    assert summary.clean.control and summary.clean.control.correct == 6


@pytest.mark.medium
def test_the_same_seed_gives_the_same_numbers_when_deterministic(scene: advsearch.Scene, level: float) -> None:
    runs = [
        advsearch.attack(scene, model(level + 0.03), deterministic=True, baseline=False, **FAST).u for _ in range(2)
    ]
    assert torch.equal(*runs)


@pytest.mark.medium
def test_a_custom_objective_is_an_ordinary_function(scene: advsearch.Scene, level: float) -> None:
    seen: list[tuple[torch.Size, torch.Size, list[int]]] = []

    def darkest(logits: Tensor, images: Tensor, labels: Tensor) -> Tensor:
        seen.append((logits.shape, images.shape, labels.tolist()))
        return -images.mean(dim=(1, 2, 3))

    result = advsearch.attack(scene, model(level + 0.03), objective=darkest, baseline=False, **FAST)
    assert seen[0] == ((1, 2), (1, SIZE, SIZE, 3), [0])
    assert float(result.adversarial.mean()) < float(result.clean.mean())
    assert result.summary.objective == "darkest"


def test_render_runs_in_ordinary_autograd(scene: advsearch.Scene, level: float) -> None:
    """The example of the README."""
    render = scene.renderer(["texture"], resolution=SIZE)
    u = render.start.clone().requires_grad_()
    model(level)(render(u, seed=0, spp=4))[0, 0].backward()
    assert u.grad is not None and float(u.grad.abs().sum()) > 0.0


@pytest.mark.medium
def test_ctrl_c_keeps_the_run_so_far(
    scene: advsearch.Scene, level: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    interrupted(monkeypatch, 3)
    result = advsearch.attack(scene, model(level + 0.03), run=tmp_path / "run", **FAST)
    assert result.summary.ending == "interrupted" and result.summary.verified is None
    assert json.loads((tmp_path / "run" / "summary.json").read_text("utf-8"))["ending"] == "interrupted"
    assert result.summary.steps == 3


@pytest.mark.medium
def test_a_stopped_run_goes_on_where_it_was(
    scene: advsearch.Scene, level: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = {**FAST, "deterministic": True, "baseline": False}
    whole = advsearch.attack(scene, model(level + 0.03), run=tmp_path / "whole", **options)
    with monkeypatch.context() as patch:
        interrupted(patch, 3)
        stopped = advsearch.attack(scene, model(level + 0.03), run=tmp_path / "run", **options)
    assert stopped.summary.ending == "interrupted" and can_resume(tmp_path / "run")
    again = advsearch.attack(scene, model(level + 0.03), run=tmp_path / "run", resume=True, **options)
    assert torch.equal(again.u, whole.u) and again.summary.verified == whole.summary.verified
    assert rows_of(tmp_path / "run") == rows_of(tmp_path / "whole")
    assert not can_resume(tmp_path / "run")


def rows_of(run: Path) -> list[Row]:
    """All that is stored of a run, but for times."""
    with Store(run / "results.sqlite", read_only=True) as store:
        return [dataclasses.replace(row, seconds=None, time=None) for row in store.rows()]


@pytest.mark.medium
def test_a_target_and_the_average_are_in_the_summary(scene: advsearch.Scene, level: float) -> None:
    result = advsearch.attack(scene, model(level + 0.03), target="vase", average=5, baseline=False, **FAST)
    summary = result.summary
    assert (summary.goal, summary.target, summary.ending) == ("a target answer", ["vase"], "found")
    average = summary.average
    assert average is not None and average.configurations == 5 and 0 <= average.correct <= 5
    assert average.accuracy == average.correct / 5 and len(average.interval) == 2
    assert average.margin >= average.worst_margin


@pytest.mark.medium
def test_the_smallest_epsilon_is_bracketed_and_verified(scene: advsearch.Scene, level: float) -> None:
    summary = advsearch.attack(scene, model(level + 0.03), smallest=True, **FAST).summary
    bracket = summary.smallest
    assert summary.ending == "found" and summary.baseline is None
    assert bracket is not None and bracket.epsilon is not None and 0.0 < bracket.epsilon["texture"] < 0.1
    assert bracket.not_found_at is None or bracket.not_found_at["texture"] < bracket.epsilon["texture"]


@pytest.mark.medium
def test_conditions_are_other_ones_in_every_trial_and_the_same_for_both_groups(
    scene: advsearch.Scene, level: float, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    summary = advsearch.attack(scene, model(level + 0.1), over=["camera"], draws=2, run=run, **FAST).summary
    assert summary.over == ["camera"] and summary.controls == ["texture"]
    with Store(run / "results.sqlite", read_only=True) as store:
        clean, adversarial = (
            [row.values["camera.azimuth"]["value"] for row in store.rows(kind)] for kind in ("control", "verification")
        )
    assert len(set(clean)) == 6
    assert adversarial in ([], clean)  # nothing, if the clean scene is wrong in half of them


@pytest.mark.medium
def test_over_conditions_caption_and_payload_are_of_the_picture_and_labels_of_the_trials_that_count(
    scene: advsearch.Scene, level: float, tmp_path: Path
) -> None:
    """Each trial sees another exposure, so that the model answers each with another probability, and some clean ones
    wrongly."""
    over = {"camera": {"exposure": [-1.5, 0.2]}}
    fast = {**FAST, "trials": 24}
    result = advsearch.attack(scene, model(level - 0.01), over=over, draws=2, epsilon=0.5, run=tmp_path / "run", **fast)
    summary = result.summary
    assert summary.verified and summary.clean.control and summary.adversarial
    assert 12 <= summary.clean.control.correct < 24, "some, and not all, trials have to count"
    assert summary.verified.trials == summary.clean.control.correct
    assert sum(summary.verified.labels.values()) == summary.verified.successes <= summary.verified.trials
    assert list(summary.conditions) == ["camera.exposure"]
    drawn = summary.conditions["camera.exposure"]
    assert drawn.unit == "stops" and (drawn.low, drawn.high) == pytest.approx((-1.5, 0.2))
    trial = summary.clean.trial
    assert trial is not None and trial == summary.adversarial.trial
    with Store(tmp_path / "run" / "results.sqlite", read_only=True) as store:
        rows = {kind: {row.step: row for row in store.rows(kind)} for kind in ("control", "verification")}
    for kind, said, picture in (
        ("control", summary.clean, result.clean),
        ("verification", summary.adversarial, result.adversarial),
    ):
        with torch.no_grad():
            shares = model(level - 0.01)(picture).softmax(dim=-1).flatten()
        assert said.probability == pytest.approx(float(shares.max()), abs=1e-6), "the caption is of the picture"
        row = rows[kind][trial]
        assert row.label == said.label and row.probability == pytest.approx(said.probability, abs=1e-6)
    assert len({round(row.probability or 0.0, 6) for row in rows["control"].values()}) > 12


@pytest.mark.medium
def test_nan_logits_during_the_search_end_it_and_are_counted(
    scene: advsearch.Scene, level: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Fails(Brightness):
        calls = 0

        def forward(self, images: Tensor) -> Tensor:
            Fails.calls += 1
            logits = super().forward(images)
            return logits * math.nan if images.requires_grad else logits

    victim = advsearch.load_model(Fails(level + 0.03), labels=LABELS, input_size=SIZE)
    summary = advsearch.attack(scene, victim, baseline=False, **FAST).summary
    assert summary.ending == "non-finite objective"
    assert summary.non_finite.objectives == 3


WAYS: dict[str, dict[str, Any]] = {
    "rendered": {"specialise": False},
    "matrix": {},
    "bank": {"over": "environment", "draws": 2},
    "surface light": {"over": "camera", "draws": 2},
}


@pytest.mark.parametrize("way", only(["matrix"], WAYS))
def test_a_gradient_that_is_not_finite_is_told_whatever_makes_the_pictures(level: float, way: str) -> None:
    class Slopeless(Brightness):
        def forward(self, images: Tensor) -> Tensor:
            logits = super().forward(images)
            return logits + (logits - logits.detach()).abs().sqrt()  # adds 0, and NaN to the derivative

    victim = advsearch.load_model(Slopeless(level + 0.03), labels=LABELS, input_size=SIZE)
    told = advsearch.attack(
        "mug", victim, label="mug", controls={"texture": {"resolution": 8}}, resolution=SIZE, steps=16, trials=6,
        verify_spp=4, baseline=False, policy="pgd", **WAYS[way],
    ).summary  # fmt: skip
    assert (told.transport is not None and told.transport.used) == (way != "rendered")
    assert any("not finite and were set to 0" in one for one in told.warnings), told.warnings


@pytest.mark.medium
def test_rows_keep_what_is_right_apart_from_what_the_attack_wants(
    scene: advsearch.Scene, level: float, tmp_path: Path
) -> None:
    asked: dict[str, Any] = {**FAST, "baseline": False, "minimise": True}
    advsearch.attack(scene, model(level - 0.01), run=tmp_path / "run", **asked)
    with Store(tmp_path / "run" / "results.sqlite", read_only=True) as store:
        rows = list(store.rows())
    assert {row.kind for row in rows} >= {"search", "control"}
    for row in rows:
        assert row.margin is not None and row.objective is not None
        assert row.correct == (row.label == "mug") == (row.margin >= 0.0)
        assert row.success == (row.margin > 0.0), "an attack that minimises wants right answers"
        assert row.kind.startswith("search") or row.objective == row.margin


def test_mistakes_are_explained_and_leave_nothing(scene: advsearch.Scene, level: float, tmp_path: Path) -> None:
    run = tmp_path / "run"
    victim = model(level)
    with pytest.raises(InputError, match="label"):
        advsearch.attack(scene, victim, label="teapot", run=run, **FAST)
    with pytest.raises(InputError, match=r"the label of teapot itself does not fit the model .* calls a clean picture"):
        advsearch.attack("teapot", victim, run=run, **FAST)
    with pytest.raises(UnknownNameError, match=r"unknown policy 'pgdd'. Did you mean 'pgd'"):
        advsearch.attack(scene, victim, policy="pgdd", run=run, **FAST)
    with pytest.raises(UnknownNameError, match=r"unknown objective 'margine'. Did you mean 'margin'"):
        advsearch.attack(scene, victim, objective="margine", run=run, **FAST)
    with pytest.raises(UnknownNameError, match=r"unknown control 'textures'. Did you mean 'texture'"):
        advsearch.attack(scene, victim, controls=["textures"], run=run, **FAST)
    with pytest.raises(InputError, match="step"):
        advsearch.attack(scene, victim, run=run, **{**FAST, "steps": 0})
    assert not run.exists()
    run.mkdir()
    (run / "mine.txt").write_text("keep", encoding="utf-8")
    with pytest.raises(RunExistsError, match="not empty and not a run"):
        advsearch.attack(scene, victim, run=run, **FAST)
    assert (run / "mine.txt").read_text("utf-8") == "keep"


@pytest.mark.medium
def test_auto_takes_half_of_the_samples_and_looks_again_where_it_is_close(
    scene: advsearch.Scene, level: float, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    more: dict[str, Any] = {**FAST, "spp": "auto", "steps": 12, "policy": "random", "run": run}
    summary = advsearch.attack(scene, model(level + 0.03), **more).summary
    with Store(run / "results.sqlite", read_only=True) as store:
        rows = list(store.rows("search"))
    looks = [row for row in rows if row.step >= summary.steps]
    assert len(rows) - len(looks) == 12 and {row.spp for row in rows} == {4}
    assert 8 <= len(looks) <= 4 * (2 + 4) and len(rows) == summary.renders["search"]


@pytest.mark.parametrize(
    ("asked", "steps", "draws"),
    [
        ({"controls": "texture"}, 40, 1),
        ({"controls": "texture", "over": "camera"}, 300, 8),
        ({"controls": "texture", "over": "camera", "specialise": False}, 150, 4),
        ({"controls": "texture", "over": "haze"}, 150, 4),
        ({"controls": "pose", "over": "camera"}, 40, 4),
        ({"controls": "pose", "over": "camera", "steps": 7}, 7, 4),
        ({"controls": "texture", "over": "camera", "draws": 3}, 300, 3),
    ],
)
def test_a_search_is_as_long_as_what_is_asked_needs(asked: dict[str, Any], steps: int, draws: int) -> None:
    config = AttackConfig(object="mug", resolution=8, threads=1, **asked)
    problem, _ = problem_from_config(config)
    assert (problem.steps, problem.n_draws) == (steps, draws)


@pytest.mark.medium
def test_a_search_over_conditions_says_how_long_it_is(scene: advsearch.Scene, level: float) -> None:
    told: list[str] = []

    class Told(NullProgress):
        def message(self, text: str) -> None:
            told.append(text)

    small: dict[str, Any] = {**FAST, "resolution": (8, 8), "baseline": False, "trials": 6, "controls": "pose"}
    asked = {**small, "over": {"light": {"power": [0, 1]}}, "steps": 2}
    advsearch.attack(scene, model(level + 0.02), **asked, progress=Told())
    assert any(
        text.startswith("One configuration for many conditions: 2 steps, each over 4 conditions; `steps`")
        for text in told
    )
    told.clear()
    advsearch.attack(scene, model(level + 0.02), **asked, draws=1, progress=Told())
    assert not any("many conditions" in text for text in told)


@pytest.mark.medium
def test_a_configuration_whose_check_is_interrupted_is_told_and_verified_later(
    scene: advsearch.Scene, level: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, wrong = tmp_path / "run", model(level + 0.02)
    asked: dict[str, Any] = {**FAST, "controls": {"light": {"power": [0, 40]}}, "baseline": False, "run": run}

    def stopped(*_: Any, **__: Any) -> Any:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("advsearch.engine.verifier.choose_spp", stopped)
        first = advsearch.attack(scene, wrong, **asked)
    said = "What was found so far is not verified: the model calls this mug a vase."
    assert first.summary.ending == "interrupted" and first.summary.verified is None and first.search is not None
    assert said in text_of(first.summary) and said in (run / "report.html").read_text()
    assert "advsearch resume" in (run / "report.html").read_text()
    assert list_runs(tmp_path)[0].answer == "vase, unverified"
    done = advsearch.attack(scene, wrong, **asked, resume=True)
    assert done.found and torch.equal(done.u, first.u) and list_runs(tmp_path)[0].answer == "6/6"
