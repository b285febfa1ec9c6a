"""Basis pictures of lights: what counts as light, their sums against traced pictures, and searches over light."""

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import advsearch
from advsearch.engine import acceptance
from advsearch.engine import transport as searching
from advsearch.scene.renderer import Renderer
from advsearch.scene.transport import lights
from advsearch.scene.transport.lights import BasisRenderer, find_light_groups
from small_models import levels
from stand_ins import Impatient, rows

SIZE = 32
LAMP: dict[str, Any] = {"light": {"power": [0, 12], "red": [0.5, 1.0]}, "environment": {"exposure": [-1, 1]}}


def rendered_by(controls: Any, **options: Any) -> Renderer:
    return advsearch.load_scene("mug").renderer(controls, resolution=SIZE, **options)


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return rendered_by(LAMP)


@pytest.fixture(scope="module")
def predicted(renderer: Renderer) -> BasisRenderer:
    return BasisRenderer(renderer, renderer.start, seed=1)


def off(renderer: Renderer, predicted: BasisRenderer, u: Tensor) -> tuple[float, float]:
    """How far a predicted picture is from traced ones, and how far two of these lie apart."""
    with torch.no_grad():
        one, other = (renderer(u, seed=seed, spp=256) for seed in (11, 12))
        return levels(predicted(u), (one + other) / 2.0), levels(one, other)


@pytest.mark.medium
@pytest.mark.parametrize(
    ("controls", "light", "more"),
    [
        (LAMP, {"light.power", "light.red", "environment.exposure"}, set()),
        ({"light": {"power": [0, 9], "size": [0.1, 0.2], "x": [0, 1]}}, {"light.power"}, {"light.size", "light.x"}),
        (
            {"environment": {"rotation": [0, 90], "tint_red": [0, 2]}}, {"environment.tint_red"},
            {"environment.rotation"},
        ),
        ({"environment": {"harmonics": [-1, 1]}}, {"environment.harmonics"}, set()),
        ({"camera": {"exposure": [-1, 1], "fov": [30, 40]}}, {"camera.exposure"}, {"camera.fov"}),
        ({"texture": {"resolution": 4}, "lens": {"dots": 1}}, {"lens.x", "lens.opacity"}, {"texture.texels"}),
    ],
)  # fmt: skip
def test_what_is_light(controls: Any, light: set[str], more: set[str]) -> None:
    made = rendered_by(controls)
    found = find_light_groups(made)
    names = {group.name for group in made.plan.groups}
    assert light <= found.inputs_by_group.keys() and not more & found.inputs_by_group.keys()
    assert light | more <= names
    assert bool(found.harmonic_groups) == ("environment.harmonics" in light)


@pytest.mark.medium
@pytest.mark.parametrize("place", [(0.5, 0.6, 0.5), (0.0, 1.0, 0.9), (1.0, 0.4, 0.1)])
def test_a_sum_of_basis_pictures_is_the_traced_picture(
    renderer: Renderer, predicted: BasisRenderer, place: tuple[float, ...]
) -> None:
    """As near as two traced ones are to each other; and far from that of the start."""
    u = torch.tensor(place)
    found, noise = off(renderer, predicted, u)
    assert found < 1.6 * noise
    assert levels(predicted(u), predicted(renderer.start)) > 3.0 * noise


def test_its_derivative_is_that_of_its_pictures(predicted: BasisRenderer) -> None:
    u, step = torch.tensor([0.4, 0.1, 0.4]), 0.01

    def loss(picture: Tensor) -> Tensor:
        return picture.square().mean()

    _, slope = predicted.renderer.gradient(loss, u, seed=0, spp=1)
    for number in range(3):
        ends = []
        for side in (-step, step):
            at = u.clone()
            at[number] += side
            ends.append(float(loss(predicted(at))))
        assert float(slope[number]) == pytest.approx((ends[1] - ends[0]) / (2.0 * step), rel=0.05, abs=1e-4)


@pytest.mark.medium
def test_harmonics_are_predicted_while_the_map_is_above_zero() -> None:
    made = rendered_by({"environment": {"harmonics": [-1, 1]}})
    basis = BasisRenderer(made, made.start, seed=1)
    brighter = made.start.clone()
    brighter[:3] += 0.1  # the same light from everywhere
    found, noise = off(made, basis, brighter)
    assert basis.n_traced_images == 10 and found < 1.6 * noise
    assert levels(basis(brighter), basis(made.start)) > 3.0 * noise


@pytest.mark.medium
def test_texture_and_light_are_predicted_together() -> None:
    """To first order in the texture under any light: the lamp that goes on shows the change that was made in its
    dark."""
    made = rendered_by({"light": {"power": [0, 12]}, "texture": {"resolution": 8}})
    basis = BasisRenderer(made, made.start, seed=1)
    changed = (made.start + 0.1).clamp(0.0, 1.0)
    changed[0] = 0.7
    lit = made.start.clone()
    lit[0] = 0.7
    with torch.no_grad():
        traced = made(changed, seed=5, spp=256) - made(lit, seed=5, spp=256)
        assert levels(basis(changed) - basis(lit), traced) < 0.35 * levels(traced, torch.zeros_like(traced))
    assert basis.n_traced_images == 2 and basis.n_entries > 0


@pytest.mark.parametrize(
    ("controls", "options", "can_predict"),
    [
        ({"light": {"power": [0, 12]}}, {}, True), ({"camera": {"exposure": [-1, 1]}}, {}, True),
        ({"light": {"power": [0, 12]}}, {"estimators": {"light": "adjoint"}}, False), ({"light": {}}, {}, False),
        ({"light": {"power": [0, 12]}}, {"denoise": "none"}, False),
    ],
)  # fmt: skip
def test_where_light_can_be_predicted(controls: Any, options: dict[str, Any], can_predict: bool) -> None:
    assert (lights.find_refusal(rendered_by(controls, **options)) is None) == can_predict


SEARCH: dict[str, Any] = {
    "controls": {"light": {"power": [0, 12]}},
    "resolution": SIZE,
    "trials": 6,
    "steps": 18,
    "verify_spp": 8,
    "baseline": False,
}


@pytest.mark.medium
def test_a_search_over_light_renders_its_basis_and_its_comparisons(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(searching, "COMPARISON_INTERVAL", 8)
    for name in ("MIN_ALLOWED_LEVELS", "MAX_MARGIN_BIAS"):
        monkeypatch.setattr(acceptance, name, 50.0)
    found = advsearch.attack("mug", run=None, **SEARCH).summary
    told, renders = found.transport, found.renders
    assert told is not None and told.used and told.reason is None and told.entries == 0 and told.bytes
    assert told.error is not None and told.error.levels < 8.0
    assert renders["products"] == 18 and renders["search"] == 2 + 2 * 2 * 3 + 8  # basis, comparisons, ranking


@pytest.mark.medium
@pytest.mark.slow
def test_a_prediction_that_is_off_ends_in_rendering_and_goes_on_so(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Also in a run that was stopped after that."""
    monkeypatch.setattr(searching, "COMPARISON_INTERVAL", 6)
    off = acceptance.Deviation(9.0, 0.0, 2.0, n_traced=6)
    monkeypatch.setattr(searching, "compare_views", lambda view: off)
    settings = {**SEARCH, "deterministic": True}
    whole = advsearch.attack("mug", run=tmp_path / "whole", **settings).summary
    assert whole.transport is not None and "from evaluation 6" in str(whole.transport.reason)
    assert whole.renders["products"] == 6
    stopped = advsearch.attack("mug", run=tmp_path / "parts", progress=Impatient(9), **settings)
    assert stopped.summary.ending == "interrupted"
    advsearch.attack("mug", run=tmp_path / "parts", resume=True, **settings)
    assert rows(tmp_path / "parts") == rows(tmp_path / "whole")
