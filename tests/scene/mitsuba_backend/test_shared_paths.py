"""Images of one seed that share the light paths which meet nothing of what is searched."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

import advsearch
from advsearch.questions.attack.carry_out import problem_from_config
from advsearch.questions.attack.settings import AttackConfig
from advsearch.scene.mitsuba_backend.scene import NO_ROULETTE_DEPTH
from advsearch.scene.mitsuba_backend.shared_paths import SharedPaths
from advsearch.scene.mitsuba_backend.variant import dr, import_mitsuba, mi
from advsearch.scene.renderer import Renderer
from advsearch.scene.transport.matrix import LinearRenderer


@pytest.mark.medium
@pytest.mark.parametrize(("kind", "spp"), [("multijitter", 6), ("multijitter", 16), ("independent", 4)])
def test_each_sample_has_the_random_numbers_that_mitsuba_gives_it(kind: str, spp: int) -> None:
    import_mitsuba()
    from advsearch.scene.mitsuba_backend.paths import PathSamples

    count = 30 * spp
    sampler = mi.load_dict({"type": kind, "sample_count": spp})
    sampler.set_samples_per_wavefront(spp)
    sampler.seed(7, count)
    chosen = mi.UInt32([5, 11, count - 1])
    numbers = PathSamples(mi.UInt32(7), chosen, spp, kind == "multijitter")
    for draw in ("next_1d", "next_2d", "next_1d", "next_2d"):
        expected = getattr(sampler, draw)()
        drawn = getattr(numbers, draw)()
        expected = dr.gather(type(drawn), expected, chosen)
        assert dr.all(drawn == expected, axis=None), draw


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    scene = advsearch.load_scene("mug", "room")
    return scene.renderer({"texture": {"resolution": 4}}, resolution=16, denoise="none")


def change_texture(renderer: Renderer) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.rand(len(renderer.start), generator=generator)


@pytest.mark.medium
def test_images_are_those_that_mitsuba_traces_in_full(renderer: Renderer) -> None:
    shared = SharedPaths(renderer.scene, ["object.base_color"])
    changed = change_texture(renderer)
    for u in (renderer.start, changed, renderer.start):  # the first is traced in full
        full = renderer(u, 3, 4)
        with renderer.share_paths(shared):
            assert torch.allclose(renderer(u, 3, 4), full, atol=1e-5)
    assert not torch.allclose(renderer(changed, 3, 4), renderer(renderer.start, 3, 4), atol=0.1)
    guides = renderer.scene.render_images({}, {"path": 3, "guides": 3}, 4)
    for image, expected in zip(shared.render_images({}, {"path": 3, "guides": 9}, 4), guides, strict=True):
        assert torch.allclose(image, expected, atol=1e-5)


@pytest.mark.medium
def test_an_image_is_the_same_whatever_was_rendered_before(renderer: Renderer) -> None:
    changed = change_texture(renderer)
    inputs = renderer.compute_scene_inputs(changed)
    shared = SharedPaths(renderer.scene, ["object.base_color"])
    shared.render_images({}, {"path": 5}, 4)
    (after_another,) = shared.render_images(inputs, {"path": 5}, 4)
    (first,) = SharedPaths(renderer.scene, ["object.base_color"]).render_images(inputs, {"path": 5}, 4)
    assert torch.equal(first, after_another)
    # the floor may not change: nothing is shared with what was rendered before
    floor = {"floor.base_color": 0.5 * renderer.scene.get_base_value("floor.base_color")}
    (darker,) = shared.render_images(inputs | floor, {"path": 5}, 4)
    expected = renderer.scene.render_radiance(inputs | floor, 5, 4)
    assert torch.allclose(darker, expected, atol=1e-5) and not torch.allclose(darker, first, atol=1e-2)


@pytest.mark.medium
@pytest.mark.parametrize(
    ("changes", "shares"),
    [
        ({}, True),
        ({"specialise": False}, False),
        ({"environment": "noon"}, False),
        ({"controls": {"pose": {"yaw": [0, 90]}}}, False),
        ({"controls": {"texture": {}}, "over": {"camera": {"azimuth": [0, 90]}}}, False),
    ],
)
def test_trials_share_paths_where_only_surfaces_change(changes: dict[str, Any], shares: bool) -> None:
    settings = {"object": "mug", "environment": "room", "controls": {"texture": {}}, "resolution": 16}
    problem, _ = problem_from_config(AttackConfig(**{**settings, **changes}))
    assert (problem.shared_paths is not None) == shares


@pytest.mark.medium
def test_roulette_leaves_matrices_as_they_are_on_average(renderer: Renderer, monkeypatch: pytest.MonkeyPatch) -> None:
    lighter = renderer.compute_scene_inputs((renderer.start + 0.2).clamp(0.0, 1.0))

    def predict_mean(seed: int) -> Tensor:
        matrix = LinearRenderer(renderer, renderer.start, seed, spp=64)
        return matrix.predict_radiance(lighter).mean(dim=(0, 1))

    with_roulette = predict_mean(1)
    monkeypatch.setattr(renderer.scene, "roulette_depth", NO_ROULETTE_DEPTH)
    assert torch.allclose(with_roulette, predict_mean(2), rtol=0.03)
