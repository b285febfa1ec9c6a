"""`attack` from Python, end to end, with a tiny model and pictures of 32 pixels."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import advsearch
from advsearch.cli.output import format_result as text_of
from advsearch.errors import InputError, RunExistsError, UnknownNameError
from advsearch.questions.attack.settings import AttackConfig
from advsearch.runs.listing import can_resume, list_runs
from advsearch.runs.store import Row, Store
from small_models import Brightness
from stand_ins import interrupted

SIZE = 32
LABELS = ("mug", "vase")
FAST: dict[str, Any] = {"resolution": (SIZE, SIZE), "steps": 6, "spp": 2, "trials": 6, "verify_spp": 4}
REPEATED: dict[str, Any] = {**FAST, "deterministic": True, "baseline": False}


def model(threshold: float) -> advsearch.Model:
    return advsearch.load_model(Brightness(threshold, SIZE // 4), labels=LABELS, input_size=SIZE, name="brightness")


@pytest.fixture(scope="module")
def scene() -> advsearch.Scene:
    return advsearch.load_scene("mug")


@pytest.fixture(scope="module")
def level(scene: advsearch.Scene) -> float:
    """What `Brightness` sees of the clean mug."""
    render = scene.renderer("texture", resolution=SIZE)
    with torch.no_grad():
        return float(render(render.start, spp=64)[SIZE // 4 : -SIZE // 4, SIZE // 4 : -SIZE // 4].mean())


@pytest.fixture(scope="module")
def whole(scene: advsearch.Scene, level: float, tmp_path_factory: pytest.TempPathFactory) -> advsearch.AttackResult:
    """A deterministic attack that nobody stopped."""
    run = tmp_path_factory.mktemp("whole") / "run"
    return advsearch.attack(scene, model(level + 0.03), run=run, **REPEATED)


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
    assert 0.0 < float((result.u - scene.renderer("texture", resolution=SIZE).start).abs().max()) <= 0.1 + 1e-6
    assert json.loads((tmp_path / "run" / "summary.json").read_text("utf-8")) == summary.to_dict()
    for name in ("clean.png", "clean.exr", "adversarial.png", "adversarial.exr", "difference.png", "search.gif"):
        assert (tmp_path / "run" / "images" / name).stat().st_size > 0, name
    for name in ("texture.png", "texture.exr", "texture-original.png"):
        assert (tmp_path / "run" / "artifacts" / name).stat().st_size > 0, name
    assert AttackConfig.from_yaml(tmp_path / "run" / "run.yaml").steps == 6
    assert (tmp_path / "run" / "report.html").is_file()


@pytest.mark.medium
def test_what_cannot_be_found_is_not_claimed(scene: advsearch.Scene) -> None:
    summary = advsearch.attack(scene, model(0.98), **FAST).summary
    assert summary.ending == "budget spent"
    assert summary.verified and summary.verified.successes == 0
    assert summary.clean.control and summary.clean.control.correct == 6


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
def test_a_stopped_run_goes_on_where_it_was(
    whole: advsearch.AttackResult, scene: advsearch.Scene, level: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        interrupted(patch, 3)
        stopped = advsearch.attack(scene, model(level + 0.03), run=tmp_path / "run", **REPEATED)
    assert stopped.summary.ending == "interrupted" and can_resume(tmp_path / "run")
    again = advsearch.attack(scene, model(level + 0.03), run=tmp_path / "run", resume=True, **REPEATED)
    assert torch.equal(again.u, whole.u) and again.summary.verified == whole.summary.verified
    assert whole.run is not None and rows_of(tmp_path / "run") == rows_of(whole.run)
    assert not can_resume(tmp_path / "run")


def rows_of(run: Path) -> list[Row]:
    """All that is stored of a run, but for times."""
    with Store(run / "results.sqlite", read_only=True) as store:
        return [dataclasses.replace(row, seconds=None, time=None) for row in store.rows()]


@pytest.mark.medium
def test_the_smallest_epsilon_is_bracketed_and_verified(scene: advsearch.Scene, level: float) -> None:
    summary = advsearch.attack(scene, model(level + 0.03), smallest=True, **FAST).summary
    bracket = summary.smallest
    assert summary.ending == "found" and summary.baseline is None
    assert bracket is not None and bracket.epsilon is not None and 0.0 < bracket.epsilon["texture"] < 0.1
    assert bracket.not_found_at is None or bracket.not_found_at["texture"] < bracket.epsilon["texture"]


@pytest.mark.medium
def test_nan_logits_during_the_search_end_it_and_are_counted(scene: advsearch.Scene, level: float) -> None:
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


def test_mistakes_are_explained_and_leave_nothing(scene: advsearch.Scene, level: float, tmp_path: Path) -> None:
    run = tmp_path / "run"
    victim = model(level)
    with pytest.raises(InputError, match="label"):
        advsearch.attack(scene, victim, label="teapot", run=run, **FAST)
    with pytest.raises(UnknownNameError, match=r"unknown policy 'pgdd'. Did you mean 'pgd'"):
        advsearch.attack(scene, victim, policy="pgdd", run=run, **FAST)
    with pytest.raises(InputError, match="step"):
        advsearch.attack(scene, victim, run=run, **{**FAST, "steps": 0})
    assert not run.exists()
    run.mkdir()
    (run / "mine.txt").write_text("keep", encoding="utf-8")
    with pytest.raises(RunExistsError, match="not empty and not a run"):
        advsearch.attack(scene, victim, run=run, **FAST)
    assert (run / "mine.txt").read_text("utf-8") == "keep"


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
    assert list_runs(tmp_path)[0].outcome == "vase, unverified"
    done = advsearch.attack(scene, wrong, **asked, resume=True)
    assert done.found and torch.equal(done.u, first.u) and list_runs(tmp_path)[0].outcome == "6/6"
