"""The exposure is metered on what the camera sees of the object, whatever that is made of."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from advsearch.engine.loading import Scene, load_scene
from advsearch.scene import library
from advsearch.scene.assets import EnvironmentAsset, Material
from advsearch.scene.description import SceneDescription, load_description
from advsearch.scene.formation import CARD_DISPLAY_VALUE, CARD_REFLECTANCE, compute_irradiance, compute_visible_normals
from advsearch.scene.renderer import Renderer
from advsearch.scene.settings import resolve_settings
from covering import once_each

GREY = 0.214
"""Reflectance of display-referred 0.5."""


def lit_from(azimuth: float, elevation: float = 15.0) -> EnvironmentAsset:
    """A map that is dark but for a lamp in one direction, degrees."""
    radiance = np.full((64, 128, 3), 0.02, np.float32)
    column = round((90.0 - azimuth) / 360.0 * 128 - 0.5) % 128
    radiance[round((90.0 - elevation) / 180.0 * 64 - 0.5), column] = 200.0
    return EnvironmentAsset("lamp", radiance)


def grey_ball(environment: EnvironmentAsset | str, **given: float) -> SceneDescription:
    """A matt grey ball, whose rendered radiance an incident meter should foretell."""
    ball = library.load_object("ball")
    matt = replace(ball, base_color=np.full((4, 4, 3), 0.5, np.float32), material=Material(1.0, 0.0, 0.0, 0.0))
    return load_description(
        matt, environment, setting_values={name.replace("__", "."): value for name, value in given.items()}
    )


def test_under_uniform_light_the_card_gets_its_level() -> None:
    scene = grey_ball(EnvironmentAsset("uniform", np.full((64, 128, 3), 2.5, np.float32)), ground__size=0.0)
    assert compute_irradiance(scene, compute_visible_normals(scene)) == pytest.approx(2.5 * math.pi, rel=0.01)
    assert scene.gain * CARD_REFLECTANCE * 2.5 == pytest.approx(CARD_DISPLAY_VALUE, rel=0.01)


@pytest.mark.parametrize(("ev", "stops"), [(14.0, 0.0), (3.0, 0.0), (14.0, -1.5)])
def test_an_exposure_value_says_which_luminance_is_white(ev: float, stops: float) -> None:
    """As docs/scenes.md has it: linear value = L / (1.2 * 2 ** ev) * 2 ** exposure, with L in cd/m2."""
    scene = load_description("car", "avenue", setting_values={"camera.ev": ev, "camera.exposure": stops})
    assert scene.environment is not None and scene.environment.candelas is not None
    white = 1.2 * 2.0**ev / 2.0**stops  # cd/m2
    assert scene.gain * white / scene.environment.candelas == pytest.approx(1.0)
    assert (ev, stops) != (14.0, 0.0) or white == pytest.approx(19661, abs=1)


@pytest.mark.parametrize(
    ("environment", "given"),
    [
        ("noon", {}), ("noon", {"camera__azimuth": 220.0}), ("low-sun", {"environment__rotation": 120.0}),
        ("kitchen", {"camera__azimuth": 130.0, "ground__size": 0.0}),
    ],
)  # fmt: skip
def test_what_is_metered_is_what_a_render_of_a_matt_ball_shows(environment: str, given: dict[str, float]) -> None:
    scene = grey_ball(environment, **given)
    render = Scene(scene).renderer("texture", resolution=32, denoise="none")
    radiance = render.radiance(render.start, seed=0, spp=32)
    y, x = torch.meshgrid(torch.arange(32) - 15.5, torch.arange(32) - 15.5, indexing="ij")
    seen = float(radiance[(x**2 + y**2) < 12.5**2].mean())
    metered = float(compute_irradiance(scene, compute_visible_normals(scene)).mean())
    assert GREY / math.pi * metered == pytest.approx(seen, rel=0.2)  # shadows and bounces take no part


def test_the_side_that_the_camera_sees_is_metered_and_not_the_light() -> None:
    azimuth = grey_ball("noon").get_number("camera.azimuth")
    front, back = (grey_ball(lit_from(azimuth + turn)) for turn in (0.0, 180.0))
    assert back.gain > 4.0 * front.gain


@pytest.mark.parametrize(
    "given",
    [
        {"camera__azimuth": 220.0, "camera__elevation": 60.0, "camera__fov": 20.0},
        {"pose__pitch": 90.0, "pose__scale": 0.5, "pose__x": 50.0},
        {"environment__rotation": 180.0, "environment__exposure": 2.0},
    ],
)
def test_a_setting_that_a_control_could_move_leaves_the_exposure_alone(given: dict[str, float]) -> None:
    assert grey_ball(lit_from(0.0), **given).gain == grey_ball(lit_from(0.0)).gain


CHANGED = {
    "camera.azimuth": 200.0, "camera.elevation": 70.0, "camera.roll": 30.0, "camera.fov": 60.0, "pose.yaw": 90.0,
    "material.roughness": 0.9,
}  # fmt: skip


@pytest.mark.medium
@once_each("parameter, size", CHANGED, [16, (12, 20)])
def test_a_setting_a_fixed_value_and_a_point_of_a_grid_are_one_picture(
    parameter: str, size: int | tuple[int, int]
) -> None:
    value, (kind, _, name) = CHANGED[parameter], parameter.partition(".")
    searched: dict[str, dict[str, object]] = {"corruption": {"severity": [0.0, 1.0]}}
    grid = {kind: {name: {"choices": [resolve_settings({})[parameter] or 0.1, value]}}}
    renders = [
        load_scene("hammer", settings={parameter: value}).renderer(searched, resolution=size),
        load_scene("hammer").renderer({kind: {name: value}, **searched}, resolution=size),
        load_scene("hammer").renderer({**grid, **searched}, resolution=size),
    ]
    with torch.no_grad():
        pictures = [render(u, seed=3, spp=1) for render, u in zip(renders, _at_second(renders), strict=True)]
    torch.testing.assert_close(pictures[1], pictures[0], rtol=0.0, atol=2e-3)
    torch.testing.assert_close(pictures[2], pictures[0], rtol=0.0, atol=2e-3)


def _at_second(renders: list[Renderer]) -> list[Tensor]:
    """The starts of two renderers, and of the third with the second option of its first coordinate."""
    return [renders[0].start, renders[1].start, torch.cat([torch.tensor([0.75]), renders[2].start[1:]])]
