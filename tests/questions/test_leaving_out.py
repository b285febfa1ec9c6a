"""What searches leave out changes neither pictures nor gradients, and bounces only within a bound."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch

from advsearch import load_scene
from advsearch.attacks import Query
from advsearch.controls import CameraControl, LightControl, MaterialControl, TextureControl
from advsearch.engine.gradients import find_interior_point, make_smooth_loss, planning
from advsearch.engine.gradients.planning import MAX_CHANGE, measure_path_length
from advsearch.questions.attack.carry_out import problem_from_config
from advsearch.questions.attack.settings import AttackConfig
from advsearch.scene.formation import ALL_OMISSIONS, NO_OMISSIONS
from advsearch.scene.renderer import Renderer

pytestmark = pytest.mark.medium

SIZE = 40


def made(controls: Any, object: str = "mug", environment: str = "studio", denoiser: str = "none") -> Renderer:
    return load_scene(object, environment).renderer(controls, resolution=SIZE, denoise=denoiser)


def test_nothing_that_is_left_out_changes_a_picture_or_a_gradient() -> None:
    renderer = made("texture")
    loss, u = make_smooth_loss((SIZE, SIZE)), find_interior_point(renderer)
    full = renderer.copy_with(renderer.scene.copy_with(leave_out=NO_OMISSIONS))
    with torch.no_grad():
        noise = (renderer(u, 100, 4) - renderer(u, 101, 4)).norm()
        for seed in range(3):  # the second is replayed where the first was recorded
            assert (full(u, seed, 4) - renderer(u, seed, 4)).norm() <= 0.01 * noise
    mine, theirs = (one.gradient(loss, u, 5, 4)[1] for one in (renderer, full))
    assert mine.norm() > 0.0
    assert (mine - theirs).norm() <= 0.01 * mine.norm()


def test_bounces_are_cut_where_they_are_dark_and_not_where_they_are_seen() -> None:
    dark, light = made("texture", "bottle", "noon"), made("texture", "mug", "studio")
    cut = measure_path_length(dark, [dark.start], seed=0, spp=4)
    assert cut.depth < cut.full == dark.scene.max_depth
    kept = {one.depth: one for one in cut.cuts}
    assert kept[cut.depth].levels <= MAX_CHANGE < kept[cut.depth - 1].levels
    assert "segments leave out" in cut.reason
    seen = measure_path_length(light, [light.start], seed=0, spp=4)
    assert seen.depth > cut.depth and seen.cuts[-1].levels > MAX_CHANGE
    assert dark.scene.current_max_depth == dark.scene.max_depth


def test_bounces_are_not_cut_where_a_picture_is_not_finite(monkeypatch: pytest.MonkeyPatch) -> None:
    changes = iter([0.0, math.nan, 0.0])
    monkeypatch.setattr(planning, "_compare_depths", lambda *_: (0.0, next(changes)))
    renderer = made("texture")
    path_length = measure_path_length(renderer, [renderer.start] * 3, seed=0, spp=1)
    assert path_length.depth == path_length.full and math.isnan(path_length.cuts[0].levels)


def test_searches_cut_paths_and_verifications_do_not() -> None:
    config = AttackConfig(object="bowl", controls={"texture": {}}, denoise="none", resolution=(SIZE, SIZE))
    problem, _ = problem_from_config(config)
    start = problem.domain.start
    seen: list[torch.Tensor] = []
    searched, tried = Query(start, 0, phase="search", includes_image=True), Query(start, 3, spp=8)
    trial = problem.evaluate(tried)
    for depth, gradient in ((None, False), (2, False), (2, True)):
        problem.search_depth = depth
        picture = problem.evaluate(replace(searched, gradient=gradient)).picture
        assert picture is not None
        seen.append(picture)
    assert seen[1].mean() < seen[0].mean() - 0.005 and torch.equal(seen[1], seen[2])
    assert problem.evaluate(tried).required_judgement == trial.required_judgement


def two_lamps(power: float) -> Renderer:
    """The mug in the studio with a lamp, and another of some power."""
    lamps = [LightControl(name="key", type="point", power=6.0), LightControl(name="fill", type="area", power=power)]
    return load_scene("mug").renderer([TextureControl(resolution=16), *lamps], resolution=SIZE, denoise="none")


def test_dark_lamps_get_no_samples_and_change_nothing_but_noise() -> None:
    renderer = two_lamps(0.0)
    full = renderer.copy_with(renderer.scene.copy_with(leave_out=ALL_OMISSIONS - {"emitters"}))
    with torch.no_grad():
        mine, theirs = (torch.stack([one(renderer.start, seed, 16) for seed in range(12)]) for one in (renderer, full))
    noise, other = float(mine.var(0).mean()), float(theirs.var(0).mean())
    assert 1.2 * noise < other
    assert float((mine.mean(0) - theirs.mean(0)).square().mean()) < 1.5 * (noise + other) / 12


NUMBERS = ("roughness", "metallic", "specular", "clearcoat")


@pytest.mark.parametrize("values", [(1.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 1.0)])
def test_a_material_looks_the_same_however_its_numbers_come_and_whatever_is_left_out(values: Any) -> None:
    """Fixed, searched, and searched from the other ends, at both ends of every number."""
    ends = dict(zip(NUMBERS, values, strict=True))
    searched = MaterialControl(**{name: [0.0, 1.0] for name in NUMBERS})
    other = {name: 1.0 - value for name, value in ends.items()}
    pictures = []
    for control, start in ((CameraControl(exposure=[0, 1]), ends), (searched, ends), (searched, other)):
        settings = {f"material.{name}": value for name, value in start.items()}
        renderer = load_scene("ball", "studio", settings=settings).renderer([control], resolution=24, denoise="none")
        u = torch.tensor(list(ends.values())) if control is searched else renderer.start
        with torch.no_grad():
            pictures += [
                renderer(u, 3, 16),
                renderer.copy_with(renderer.scene.copy_with(leave_out=NO_OMISSIONS))(u, 3, 16),
            ]
    assert max(float((one - pictures[0]).abs().mean()) for one in pictures) < 1e-3
