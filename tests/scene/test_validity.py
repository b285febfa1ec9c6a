"""How far a street's picture and a photograph fit the ground before them: the formula, against rendered pictures."""

import math
from dataclasses import replace

import numpy as np
import pytest

from advsearch.engine.loading import Scene, fit_camera, load_scene
from advsearch.scene.assets import EnvironmentAsset
from advsearch.scene.description import SceneDescription, load_description
from advsearch.scene.grounds import (
    Surroundings,
    find_surroundings,
    find_valid_range,
    list_view_remarks,
    make_camera_view,
)
from advsearch.scene.library import load_environment, load_object
from scenes.places.road import EDGES, EYE

SIDE = 96
FAR_SIDE = 90.0
"""The azimuth of a camera that stands at +y."""


def street(away: float, height: float, azimuth: float = FAR_SIDE, **given: float) -> Scene:
    """The car, which stands in the street with black ground and white houses."""
    rows, columns = (320, 640)
    elevation = math.pi * (0.5 - (np.arange(rows) + 0.5) / rows)[:, None]
    around = math.pi * (0.5 - 2.0 * (np.arange(columns) + 0.5)[None] / columns)
    across = np.abs(np.sin(around)) * np.cos(elevation) + 0.0 * around
    # the two fronts are 12 m away here, so that either half of the map is right for a camera at +y or at -y
    houses = np.where(across > 1e-6, EYE + 12.0 / np.maximum(across, 1e-6) * np.sin(elevation), -1.0) > 0.0
    coded = np.repeat(np.where(houses, 1.0, 0.0)[..., None], 3, axis=2).astype(np.float32)
    lit = replace(load_environment("street"), radiance=coded)
    middle = 0.73  # metres, of the car
    up = math.degrees(math.asin((height - middle) / away))
    settings = {"camera.azimuth": azimuth, "camera.distance": away, "camera.elevation": up, **given}
    return load_scene("car", lit, settings=settings)


def seen(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Where houses are seen (H, W), and where the road or the car is; row 0 on top."""
    renderer = scene.renderer({"texture": {}}, resolution=SIDE, denoise="none")
    u = renderer.start
    surfaces = renderer.find_surfaces(u)
    picture = renderer.radiance(u, 0, 16)
    things = np.isfinite(surfaces.depth.numpy())
    return (picture.mean(dim=-1).numpy() > 0.5) & ~things, things


def depression(scene: Scene) -> float:
    """Degrees below the horizon at which houses begin in the middle of the picture."""
    houses, _ = seen(scene)
    view = make_camera_view(fit_camera(scene.description, SIDE))
    row = SIDE - int(np.argmax(houses[::-1, 3]))  # the lowest of the first columns, beside the car
    half = math.radians(scene.description.get_number("camera.fov")) / 2.0
    slope = (2.0 * row / SIDE - 1.0) * math.tan(half)
    return view.lower_angle - math.degrees(half) + math.degrees(math.atan(slope))


@pytest.mark.medium
@pytest.mark.parametrize("away", [6.0, 12.0, 24.0])
def test_houses_are_as_much_too_large_as_the_formula_says(away: float) -> None:
    shown = math.tan(math.radians(depression(street(away, EYE, **{"ground.size": 0.0}))))
    true = EYE / (away + 12.0)
    assert shown / true == pytest.approx(1.0 + away / 12.0, rel=0.08)


@pytest.mark.medium
@pytest.mark.parametrize("height", [1.5, 3.0, 4.5])
def test_houses_are_as_much_too_high_as_the_formula_says(height: float) -> None:
    shown = math.tan(math.radians(depression(street(8.0, height, **{"ground.size": 0.0, "camera.fov": 60.0}))))
    assert (height / 12.0) / shown == pytest.approx(height / EYE, rel=0.08)


@pytest.mark.medium
@pytest.mark.parametrize("side", [90.0, 270.0])
def test_the_road_ends_in_sight_where_the_formula_says(side: float) -> None:
    scene = street(10.0, 1.6, side).description
    border = EDGES[1] if side == 90.0 else -EDGES[0]
    limit = border + 1.6 / math.tan(math.radians(make_camera_view(fit_camera(scene, SIDE)).lower_angle))
    free = replace(find_surroundings(scene) or Surroundings(1.0, 1.0, 1.0), nearest_distance=math.inf)
    assert find_valid_range(free, make_camera_view(scene))[0] == pytest.approx(limit, rel=0.02)
    _, inside = seen(street(limit - 1.0, 1.6, side))
    _, outside = seen(street(limit + 1.0, 1.6, side))
    assert inside[-1].all()
    assert not outside[-1].any()


@pytest.mark.medium
def test_from_60_m_the_houses_stand_below_the_road() -> None:
    def below(away: float) -> bool:
        houses, things = seen(street(away, 1.6))
        return bool(houses[:, 3].any()) and int(np.flatnonzero(houses[:, 3]).max()) > int(
            np.flatnonzero(things[:, 3]).max()
        )

    assert not below(11.5)
    assert below(60.0)
    assert (
        find_valid_range(
            find_surroundings(street(60.0, 1.6).description),  # type: ignore[arg-type]
            make_camera_view(street(60.0, 1.6).description),
        )[0]
        < 20.0
    )


def photographed(height: float | None = None, radius: float | None = None, **said: float) -> SceneDescription:
    given = {"ground.height": height, "ground.radius": radius}
    lit = EnvironmentAsset("hall", np.ones((8, 16, 3), np.float32), photographed=True)
    loose = replace(load_object("mug"), size_in_metres=None)
    return load_description(
        loose,
        lit,
        setting_values={name: one for name, one in given.items() if one is not None},
        **said,  # type: ignore[arg-type]
    )


def test_a_photograph_fits_by_its_height_and_its_empty_floor() -> None:
    for scene, far, high in (
        (photographed(size=0.1), 8.0, 3.2),
        (photographed(2.0, size=0.1), 10.0, 4.0),
        (photographed(2.0, 3.0, size=0.1), 3.0, 4.0),
        (photographed(), 15.0, 6.0),
    ):
        assert find_valid_range(find_surroundings(scene), make_camera_view(scene)) == pytest.approx((far, high))  # type: ignore[arg-type]
        assert not list_view_remarks(scene, [make_camera_view(scene)])
    away = replace(photographed(size=0.1), values={**photographed(size=0.1).values, "camera.distance": 9.0})
    assert (
        "a picture, which fits a camera up to 8 m away and 3.2 m high; the camera is 8."
        in list_view_remarks(away, [make_camera_view(away)])[0]
    )
