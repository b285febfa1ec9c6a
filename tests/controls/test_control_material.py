"""The material control: patterns without seams, named materials with numbers of their own, sound derivatives."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

import advsearch
from advsearch.controls.material import (
    PATTERNS,
    SURFACE_PARAMETERS,
    TILE_SIDE,
    MaterialControl,
    make_covering,
    make_tile,
)
from advsearch.scene.assets import Material
from advsearch.scene.color import srgb_to_linear
from advsearch.scene.description import SceneDescription
from advsearch.scene.mitsuba_backend.meshes import make_principled, to_loadable
from advsearch.scene.mitsuba_backend.parts import IDLE_LOBES, translate_mesh, translate_part
from advsearch.scene.mitsuba_backend.variant import mi
from advsearch.scene.parts import PluginNumber, PluginNumbers
from advsearch.scene.raster import rasterize_charts

BASE_COLOR = "object.base_color"

AGREEMENT = 0.15
"""Relative difference allowed between a 64-sample adjoint and a 64-sample difference of a smooth weight."""


@pytest.mark.medium
@pytest.mark.parametrize("name", PATTERNS)
def test_a_tile_continues_across_its_edges(name: str) -> None:
    texels = make_tile(name)
    assert texels.shape == (TILE_SIDE, TILE_SIDE, 3) and texels.dtype == np.float32
    assert 0.0 <= float(texels.min()) and float(texels.max()) <= 1.0
    for axis in (0, 1):
        steps = np.abs(np.diff(texels, axis=axis)).mean(axis=(1 - axis, 2))
        wrap = np.abs(np.take(texels, 0, axis) - np.take(texels, -1, axis)).mean()
        assert wrap <= max(2.0 * float(steps.mean()), 1.2 * float(steps.max())), (name, axis)


def test_a_pattern_has_one_scale_on_the_object_whatever_its_charts(scene: SceneDescription) -> None:
    """Texels that lie far apart in the texture and at one place on the object have one colour."""
    mesh = scene.object.mesh
    texels = make_covering(mesh, "checker", 128)
    charts = rasterize_charts(mesh, 128)
    positions, normals = charts.compute_positions(), charts.compute_normals()
    flat = np.abs(normals[..., 2]) > 0.98  # seen from above only: the floor, the foot
    cell = PATTERNS["checker"].tile_size / 4.0
    inside = (np.abs(positions[..., :2] / cell % 1.0 - 0.5) < 0.4).all(axis=-1) & flat
    odd = (np.floor(positions[..., 0] / cell) + np.floor(-positions[..., 1] / cell)) % 2.0
    assert inside.sum() > 100
    expected = np.where(odd[inside] > 0.5, make_tile("checker").min(), make_tile("checker").max())
    assert np.abs(texels[inside][:, 0] - expected).max() < 0.05


def searched(*names: str) -> MaterialControl:
    """A control over whole ranges."""
    ranges: dict[str, Any] = {name: [0, 1] for name in names}
    return MaterialControl(**ranges)


def test_the_start_is_the_objects_own_surface(scene: SceneDescription) -> None:
    bound = MaterialControl().bind(scene)
    inputs = bound.inputs(bound.start)
    for name in SURFACE_PARAMETERS:
        assert float(inputs[f"object.{name}"]) == pytest.approx(getattr(scene.material, name), abs=1e-3)
    torch.testing.assert_close(inputs[BASE_COLOR], srgb_to_linear(torch.from_numpy(scene.object.base_color)))


def test_a_tint_multiplies_reflectance_and_lies_over_a_searched_texture(scene: SceneDescription) -> None:
    bound = MaterialControl(red=0.5, green=[0, 1], blue=1.0).bind(scene)
    before = torch.rand(8, 8, 3)
    tinted = bound.inputs(torch.tensor([0.25]), {BASE_COLOR: before})[BASE_COLOR]
    factor = srgb_to_linear(torch.tensor([0.5, 0.25, 1.0]))
    torch.testing.assert_close(tinted, before * factor)
    assert BASE_COLOR in bound.refines


@pytest.mark.medium
def test_a_named_material_brings_its_numbers_and_given_ones_win(scene: SceneDescription) -> None:
    names = ["own", "steel"]
    bound = MaterialControl(which=names, roughness=0.77).bind(scene)
    assert float(bound.start) == 0.25
    own, steel = (bound.inputs(torch.tensor([share])) for share in (0.25, 0.75))
    assert float(own["object.metallic"]) == scene.material.metallic and float(steel["object.metallic"]) == 1.0
    assert float(own["object.roughness"]) == float(steel["object.roughness"]) == pytest.approx(0.77)
    assert not torch.equal(own[BASE_COLOR].mean(), steel[BASE_COLOR].mean())
    assert bound.describe(torch.tensor([0.75]))["material.which"] == {"value": "steel", "unit": "name"}


def test_a_base_colour_is_rendered_as_linear_reflectance(scene: SceneDescription) -> None:
    """By IEC 61966-2-1, half of the range of sRGB is a reflectance of 0.2140."""
    part = replace(scene.meshes["object"], base_color=np.full((1, 1, 3), 0.5, np.float32))
    texels = np.array(make_principled(part)["bsdf"]["base_color"]["bitmap"])
    np.testing.assert_allclose(texels, 0.2140, atol=1e-4)


def test_every_way_into_a_number_has_the_same_guard(scene: SceneDescription) -> None:
    """At a specular of exactly 0 Mitsuba's metal is black, and at a metallic of exactly 1 an adjoint has the wrong
    sign: searched, fixed, of a named material, and of a surface in Mitsuba's own words."""
    part = replace(scene.meshes["object"], material=Material(metallic=1.0, specular=0.0, clearcoat=0.0))
    fixed = make_principled(part)["bsdf"]
    assert (fixed["metallic"], fixed["specular"]) == (0.999, 1e-3) and "clearcoat" not in fixed
    searched = {one.name: one for one in translate_mesh(part).inputs}
    by_key = PluginNumber("object.bsdf.brdf_0.specular", (0.5,), "mitsuba.specular")
    searched |= {one.name: one for one in translate_part(PluginNumbers("mitsuba", (by_key,))).inputs}
    for name, value, rendered in (
        ("object.metallic", 1.0, 0.999),
        ("object.specular", 0.0, 1e-3),
        ("object.clearcoat", 0.0, 1e-4),
        ("object.roughness", 0.0, 0.0),
        ("mitsuba.specular", 0.0, 1e-3),
    ):
        assert float(searched[name].to_rendered(torch.tensor([value]))) == pytest.approx(rendered)
    own = to_loadable({"type": "twosided", "bsdf": {"type": "principled", "specular": 0.0, "metallic": 1.0}})["bsdf"]
    assert own["specular"] == 1e-3
    assert to_loadable({"type": "principled", "eta": 1})["eta"] == 1.001
    assert to_loadable({"type": "roughplastic", "specular": 0.0})["specular"] == 0.0


def test_equal_numbers_of_a_surface_stay_two(scene: SceneDescription) -> None:
    """Mitsuba makes them one where it may, so that both would change."""
    made = translate_mesh(replace(scene.meshes["object"], material=Material()), IDLE_LOBES).plugins["object"]
    keys = mi.traverse(made).keys()
    assert [one for one in ("clearcoat", "sheen") if not any(key.endswith(f".{one}.value") for key in keys)] == []


@pytest.mark.medium
@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("roughness", 0.3), pytest.param("metallic", 0.4, marks=pytest.mark.slow),
        pytest.param("specular", 0.5, marks=pytest.mark.slow), ("green", 0.6),
    ],
)  # fmt: skip
def test_the_adjoint_agrees_with_differences(name: str, value: float) -> None:
    material = searched(name)
    render = advsearch.load_scene("mug").renderer([material], resolution=32, denoise="none")
    assert render.plan.groups[0].estimator == "adjoint"
    weight = torch.ones(32, 32, 3)
    weight[16:] = -0.3
    u = torch.tensor([value], requires_grad=True)
    samples = [torch.autograd.grad((render(u, s, 64) * weight).sum(), u)[0] for s in range(6)]
    with torch.no_grad():
        ends = [sum(float((render(u + h, s, 1024) * weight).sum()) for s in range(2)) / 2.0 for h in (0.06, -0.06)]
    expected = (ends[0] - ends[1]) / 0.12
    assert float(torch.stack(samples).mean()) == pytest.approx(expected, rel=AGREEMENT)
