"""Searches that trace the part of the picture that can change, and paste it into a whole picture."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import advsearch
from advsearch.engine import windows
from advsearch.engine.acceptance import Deviation
from advsearch.engine.problem import Problem
from advsearch.engine.windows import Windowing, find_window
from advsearch.questions.attack.carry_out import problem_from_config
from advsearch.questions.attack.run import attack_once
from advsearch.questions.attack.settings import AttackConfig
from advsearch.scene.predictor import Refusal
from advsearch.scene.renderer import Renderer
from advsearch.scene.transport.matrix import LinearRenderer
from advsearch.scene.window import Window
from stand_ins import Impatient, rows

SMALL: dict[str, Any] = {
    "object": "mug",
    "environment": "noon",
    "controls": {"material": {"roughness": [0.1, 0.9]}},
    "resolution": 64,
    "set": {"camera.distance": 0.8},
    "spp": 4,
    "steps": 22,
    "policy": "pgd",
    "measure": "no",
    "label": "bowl",
    "minimise": True,
    "baseline": False,
    "trials": 6,
    "verify_spp": 1,
}


def make_problem(**changes: Any) -> Problem:
    config = AttackConfig(**{**SMALL, **changes})
    problem, _ = problem_from_config(config)
    problem.steps = config.steps or 0
    return problem


def cosine(first: Tensor, second: Tensor) -> float:
    return float(torch.nn.functional.cosine_similarity(first.flatten(), second.flatten(), dim=0))


def test_a_window_is_cut_out_and_pasted() -> None:
    mask = torch.zeros(10, 20, dtype=torch.bool)
    mask[3, 5] = mask[6, 11] = True
    window = Window.from_mask(mask)
    assert window == (3, 5, 4, 7) and window.area == 28
    assert window.grow(4, (10, 20)) == (0, 1, 10, 15)
    assert Window.from_mask(torch.zeros_like(mask)) is None
    pixels = torch.rand(4, 7, 3, requires_grad=True)
    image = torch.rand(10, 20, 3)
    pasted = window.paste(pixels, image)
    outside = window.make_outside_mask((10, 20))
    assert int(outside.sum()) == 200 - 28
    assert torch.equal(pasted[outside], image[outside]) and torch.equal(window.crop_image(pasted), pixels)
    assert torch.equal(window.pad(pixels, (10, 20))[outside], torch.zeros(172, 3))
    (gradient,) = torch.autograd.grad((pasted * image).sum(), pixels)
    assert torch.equal(gradient, window.crop_image(image))


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    scene = advsearch.load_scene("mug", "noon", settings={"camera.distance": 0.5})
    return scene.renderer({"texture": {"resolution": 4}}, resolution=40, denoise="none")


WINDOW = Window(8, 6, 26, 28)


def test_pixels_of_the_window_are_those_of_the_whole_picture(renderer: Renderer) -> None:
    crop = renderer.crop_to(WINDOW, renderer.start, 3, 4)
    with torch.no_grad():
        around = renderer(renderer.start, 3, 4)
        pasted = crop(renderer.start, 5, 64)
        whole = renderer(renderer.start, 6, 64)
        again = crop(renderer.start, 5, 64)
    outside = WINDOW.make_outside_mask((40, 40))
    assert torch.equal(pasted[outside], around[outside])
    noise = (renderer(renderer.start, 7, 64) - whole).detach()
    difference = WINDOW.crop_image(pasted - whole)
    assert float(difference.square().mean()) < 1.5 * float(WINDOW.crop_image(noise).square().mean())
    assert torch.equal(pasted, again)
    assert torch.equal(renderer(renderer.start, 6, 64).detach(), whole)  # the film is whole again


@pytest.mark.medium
def test_its_gradient_is_that_of_the_whole_picture_and_of_differences(renderer: Renderer) -> None:
    crop = renderer.crop_to(WINDOW, renderer.start, 3, 4)
    weights = torch.rand(40, 40, 3, generator=torch.Generator().manual_seed(0))

    def loss(image: Tensor) -> Tensor:
        return (image * weights)[~WINDOW.make_outside_mask((40, 40))].sum()

    u = 0.5 * renderer.start + 0.2
    spp = 128
    slope = crop.gradient(loss, u, 1, spp)[1]
    whole = renderer.gradient(loss, u, 2, spp)[1]
    assert cosine(slope, whole) > 0.99
    assert float(slope.norm() / whole.norm()) == pytest.approx(1.0, abs=0.03)
    direction = slope.sign() * 0.02
    with torch.no_grad():
        difference = loss(crop(u + direction, 4, spp)) - loss(crop(u - direction, 4, spp))
    assert float(difference) == pytest.approx(2.0 * float(slope @ direction), rel=0.03)


@pytest.mark.medium
def test_a_matrix_of_the_window_predicts_what_a_whole_one_does(renderer: Renderer) -> None:
    traced = renderer.copy_with(denoiser="oidn")
    crop = traced.crop_to(WINDOW, traced.start, 3, 64)
    u = (traced.start + 0.1).clamp(0.0, 1.0)
    with torch.no_grad():
        cut, whole, other = [
            predictor(u) - predictor(traced.start)
            for predictor in (
                LinearRenderer(crop, traced.start, 1), LinearRenderer(traced, traced.start, 2),
                LinearRenderer(traced, traced.start, 5),
            )
        ]  # fmt: skip
    outside = WINDOW.make_outside_mask((40, 40))
    assert not cut[outside].any()
    noise = float(WINDOW.crop_image(whole - other).square().mean())
    assert float(WINDOW.crop_image(cut - whole).square().mean()) < 2.0 * noise
    assert cosine(WINDOW.crop_image(cut), WINDOW.crop_image(whole)) > 0.99


@pytest.mark.medium
def test_the_window_is_chosen_by_what_changes_outside(monkeypatch: pytest.MonkeyPatch) -> None:
    """The error outside of the window is that of converged pictures; less is allowed, and there is no window."""
    problem = make_problem(resolution=96)
    chosen = find_window(problem)
    assert isinstance(chosen, Windowing) and chosen.window.area < windows.MAX_AREA * 96 * 96
    seen = problem.renderer.compute_object_mask(problem.domain.start)
    assert not bool(seen[chosen.window.make_outside_mask((96, 96))].any())
    assert chosen.deviation.is_accepted and chosen.deviation.levels < windows.MAX_LEVELS
    again = find_window(problem)
    assert isinstance(again, Windowing) and again.deviation == chosen.deviation
    dark = make_problem(resolution=96, controls={"texture": {"epsilon": 1.0}}, environment="studio")
    monkeypatch.setattr(windows, "MAX_LEVELS", 0.001)
    refusal = find_window(dark)
    assert isinstance(refusal, Refusal) and "levels of 255, where 0.00 would do" in str(refusal)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"controls": {"camera": {}}}, "camera shows in more than a part"),
        ({"controls": {"environment": {}}}, "environment is light"), ({"controls": {"pose": {}}}, "object moves"),
        pytest.param(
            {"controls": {"material": {}, "haze": {}}}, "there is haze",
            marks=pytest.mark.island("advsearch.controls.haze"),
        ),
        pytest.param(
            {"controls": {"lens": {}}}, "nothing that is searched needs a render",
            marks=pytest.mark.island("advsearch.controls.lens"),
        ),
        ({"steps": 15}, "pays from 16 evaluations on"),
        ({"over": ["camera"]}, "the surroundings of each picture are others"),
        ({"denoise": "none"}, "noise is part of the picture"),
        ({"set": {"camera.distance": 0.2}}, "fills much of the picture"),
    ],
)  # fmt: skip
def test_a_search_that_needs_whole_pictures_says_why(changes: dict[str, Any], reason: str) -> None:
    refusal = find_window(make_problem(**changes))
    assert isinstance(refusal, Refusal) and reason in str(refusal)


@pytest.mark.medium
def test_a_resumed_search_and_one_with_workers_have_the_same_rows(tmp_path: Path) -> None:
    """Window and surroundings are found again, also after a comparison and for the ranking."""
    settings = {**SMALL, "deterministic": True}
    whole = attack_once(AttackConfig(**settings, run=str(tmp_path / "whole"))).summary
    assert whole.transport is not None and whole.transport.method == "crop"
    assert whole.transport.window is not None and whole.transport.renewed == 1
    assert whole.renders["products"] == 0 and whole.renders["search"] > 22
    config = AttackConfig(**settings, run=str(tmp_path / "parts"))
    assert attack_once(config, progress=Impatient(22)).summary.ending == "interrupted"
    attack_once(config, resumed=tmp_path / "parts")
    assert rows(tmp_path / "parts") == rows(tmp_path / "whole")
    attack_once(AttackConfig(**settings, run=str(tmp_path / "workers"), workers=2))
    assert rows(tmp_path / "workers") == rows(tmp_path / "whole")


@pytest.mark.medium
def test_surroundings_that_change_are_rendered_again_and_then_always(monkeypatch: pytest.MonkeyPatch) -> None:
    deviations = iter([0.0, 9.0, 9.0])
    measure = windows.measure_outside

    def measure_outside(*arguments: Any) -> Deviation:
        return replace(measure(*arguments), levels=next(deviations))

    for module in ("windows", "prediction"):
        monkeypatch.setattr(f"advsearch.engine.{module}.measure_outside", measure_outside)
    summary = attack_once(AttackConfig(**{**SMALL, "steps": 44})).summary
    assert summary.transport is not None and summary.transport.renewed == 1
    assert "from evaluation 40 of the search on" in str(summary.transport.reason)
