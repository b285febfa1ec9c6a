"""The avenue: a street as geometry, to scale in metres, which comes and goes with its ground."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from advsearch.engine.loading import load_scene
from advsearch.errors import InputError
from advsearch.scene.description import SceneDescription, load_description
from advsearch.scene.grounds import LUMINANCE, is_enclosed, is_paved
from advsearch.scene.things import find_ground_height
from scenes.places.avenue import AVENUE, END, KERB, LAMP_HEIGHT, lamp_places
from scenes.places.paint import FRONTS
from scenes.places.quads import SHOWN, Quads, Wall
from scenes.places.road import KERBS


def laid(scene: SceneDescription) -> set[str]:
    return {name for name, part in scene.surrounding_meshes.items() if part.is_laid_ground}


def test_kerbs_are_as_high_as_the_page_says() -> None:
    """12 cm, docs/scenes.md: a pavement lies that much above the road."""
    scene = load_description("car", "avenue")
    heights = [find_ground_height(scene, np.array([0.0, y]) / scene.metres) * scene.metres for y in (0.0, -4.0, 8.0)]
    assert heights == pytest.approx([0.0, 0.12, 0.12], abs=1e-4)


@pytest.mark.medium
def test_an_avenue_comes_and_goes_with_its_ground() -> None:
    scene = load_scene("car", "avenue")
    assert {"road", "houses", "trees", "posts"} <= laid(scene.description)
    assert is_paved(scene.description)
    assert is_enclosed(scene.description)
    assert laid(scene.with_settings({"ground.kind": "road"}).description) == {"road"}
    assert not laid(scene.with_settings({"ground.size": 0.0}).description)
    assert not is_enclosed(load_description("car", "street"))
    assert is_enclosed(load_description("mug", "noon", setting_values={"ground.kind": "avenue"}))


@pytest.mark.medium
@pytest.mark.parametrize("name", ["car", "stop-sign"])
def test_an_avenue_has_its_size_in_metres_whatever_stands_in_it(name: str) -> None:
    scene = load_description(name, "avenue")
    places = {one: part.mesh.vertices * scene.metres for one, part in scene.surrounding_meshes.items()}
    assert np.ptp(places["road"][:, 0]) > 2 * END
    assert places["houses"][:, 2].max() < 25.0
    assert places["houses"][:, 2].min() == pytest.approx(KERB, abs=1e-4)
    assert places["posts"][:, 2].max() == pytest.approx(KERB + LAMP_HEIGHT, abs=0.15)
    assert places["road"][:, 2].max() == pytest.approx(KERB, abs=1e-4)
    inside = places["houses"][np.abs(places["houses"][:, 0]) < 100.0][:, 1]
    assert not ((inside > FRONTS[0] + 1.5) & (inside < FRONTS[1] - 1.5)).any(), "something of a house is in the street"
    lamps = lamp_places(AVENUE.posts)
    assert ((lamps[:, 1] > KERBS[0]) & (lamps[:, 1] < KERBS[1])).all()
    assert (np.hypot(lamps[:, 0], lamps[:, 1]) > 10.0).all(), "a lamp in the way of a camera around the object"


@pytest.mark.medium
def test_what_stands_in_an_avenue_faces_outwards_and_rests_on_the_ground() -> None:
    for part in load_description("car", "avenue").surrounding_meshes.values():
        corners = part.mesh.vertices.astype(np.float64)[part.mesh.faces]
        faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        agree = (faces * part.mesh.normals[part.mesh.faces].mean(axis=1)).sum(axis=1) >= 0.0
        assert agree.mean() > 0.97, part.name
        np.testing.assert_allclose(np.linalg.norm(part.mesh.normals, axis=1), 1.0, atol=1e-4)


@pytest.mark.medium
def test_snow_lies_on_what_faces_up_and_on_nothing_else() -> None:
    dry, snow = (load_description("car", name).surrounding_meshes for name in ("avenue", "avenue-snow"))
    assert set(snow) - set(dry) == {"snow"}
    corners = snow["snow"].mesh.vertices.astype(np.float64)[snow["snow"].mesh.faces]
    assert (snow["snow"].mesh.normals[snow["snow"].mesh.faces].mean(axis=1)[:, 2] > 0.0).all()
    assert corners[..., 2].max() > 5.0, "roofs are white"
    names = ("houses", "trees", "posts")
    assert len(corners) == sum(len(dry[name].mesh.faces) - len(snow[name].mesh.faces) for name in names)
    assert all(np.array_equal(dry[name].mesh.vertices, snow[name].mesh.vertices) for name in ("windows", "shops"))
    base = snow["road"].base_color
    rows = np.round((FRONTS[1] - np.array([-8.0, 1.75, 0.75])) / 0.03).astype(int)  # pavement, middle of road, wheels
    pavement, middle, track = (float(base[row - 1 : row + 2].mean()) for row in rows)
    assert pavement > 0.85 > middle > 0.6 > 0.45 > track


def test_boxes_at_a_wall_face_outwards() -> None:
    frame, quads = Wall((1.0, 2.0, 0.0), (-1.0, 0.0, 0.0)), Quads()
    quads.boxes(frame, np.array([[0.0, 2.0, 0.0, 0.5, 1.0, 1.3]]), np.array([[0.0, 1.0, 0.0, 1.0]]), SHOWN)
    mesh = quads.mesh()
    middle = mesh.vertices.mean(axis=0)
    away = mesh.vertices[mesh.faces].mean(axis=1) - middle
    assert ((mesh.normals[mesh.faces[:, 0]] * away).sum(axis=1) > 0.0).all()


@pytest.mark.medium
def test_the_horizon_is_closed_and_the_road_reaches_far() -> None:
    given = {"camera.azimuth": 0.0, "camera.elevation": 0.5, "camera.distance": 100.0}
    renderer = load_scene("car", "avenue", settings=given).renderer(["pose"], resolution=33, denoise="none")
    seen = renderer.surfaces(renderer.start)
    assert not bool((seen.id[17:] == 0).any()), "sky below the horizon"
    assert float(seen.depth[-1].max()) < 20.0  # metres


@pytest.mark.slow
def test_a_gradient_among_houses_is_that_of_differences() -> None:
    scene = load_scene("car", "avenue", settings={"camera.distance": 12.0})
    renderer = scene.renderer(["texture"], resolution=16, denoise="none")
    at = 0.1 + 0.8 * renderer.start  # nothing is clamped
    _, slope = renderer.gradient(torch.mean, at, 0, 1024)
    for group in renderer.space.groups:
        step = torch.zeros_like(at)
        step[group.coordinates] = 0.05
        with torch.no_grad():
            high, low = (renderer(at + way * step, 1, 4096).mean() for way in (1.0, -1.0))
        assert float(slope[group.coordinates].sum()) == pytest.approx(float(high - low) / 0.1, rel=0.1), group.name


def test_lamps_shine_at_dusk_with_the_light_that_they_are_said_to_have() -> None:
    assert load_description("car", "avenue").surrounding_meshes["street-lamps"].emission is None
    night = load_description("car", "avenue-night")
    lamps, unit = night.surrounding_meshes["street-lamps"], night.environment
    assert lamps.emission is not None
    assert unit is not None
    assert unit.candelas is not None
    # a level area of A m2 that shines L cd/m2, h above: E = L A / h^2
    luminance = float(lamps.emission[0, 0] @ np.array(LUMINANCE)) * unit.candelas
    corners = lamps.mesh.vertices[lamps.mesh.faces[: len(lamps.mesh.faces)]].astype(np.float64) * night.metres
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    assert luminance * area / len(lamp_places(AVENUE.posts)) / 7.5**2 == pytest.approx(15.0, rel=0.02)


def test_an_absolute_exposure_shows_night_as_night() -> None:
    day, night = (
        load_description("car", name, setting_values={"camera.ev": 14.0}) for name in ("avenue", "avenue-night")
    )
    assert day.environment is not None
    assert day.gain == pytest.approx(day.environment.candelas / (1.2 * 2.0**14))  # type: ignore[operator]
    assert night.gain < 1e-3 * day.gain
    with pytest.raises(InputError, match=r"camera.ev: the brightness of this environment has no unit"):
        _ = load_description("car", "street", setting_values={"camera.ev": 14.0}).gain
