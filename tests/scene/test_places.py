"""The crossing, the car park and the room: places as geometry, made of the avenue's parts or as it is."""

import numpy as np
import pytest
import torch

from advsearch.engine.loading import load_scene
from advsearch.scene.description import SceneDescription, load_description
from advsearch.scene.geometry import compute_base_vertices, compute_footprint
from advsearch.scene.grounds import LUMINANCE, is_enclosed, is_paved
from scenes.places import room

pytestmark = [pytest.mark.usefixtures("two_threads"), pytest.mark.medium]

PLACES = {"avenue": "car", "crossing": "car", "car-park": "car", "room": "mug"}
"""Environments, and what stands in them."""


def metres(scene: SceneDescription) -> dict[str, np.ndarray]:
    return {name: compute_base_vertices(part) * scene.size_in_metres for name, part in scene.surrounding_meshes.items()}


@pytest.mark.parametrize("place", PLACES)
def test_a_place_comes_with_its_environment_and_its_faces_look_outwards(place: str) -> None:
    scene = load_description(PLACES[place], place)
    assert (
        all(part.is_laid_ground for part in scene.surrounding_meshes.values())
        and is_paved(scene)
        and is_enclosed(scene)
    )
    assert not load_description(PLACES[place], place, setting_values={"ground.size": 0.0}).surrounding_meshes
    for name, part in scene.surrounding_meshes.items():
        corners = part.mesh.vertices.astype(np.float64)[part.mesh.faces]
        faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        agree = (faces * part.mesh.normals[part.mesh.faces].mean(axis=1)).sum(axis=1) >= 0.0
        assert agree.mean() > 0.97, name
        assert np.isfinite(part.mesh.uvs).all() and part.base_color.min() >= 0.0 and part.base_color.max() <= 1.0


@pytest.mark.parametrize("place", PLACES)
def test_nothing_stands_where_the_object_is(place: str) -> None:
    scene = load_description(PLACES[place], place)
    thing, low = compute_footprint(scene.base_vertices * scene.size_in_metres), -0.001
    ground = ("road", "floor", "plain")
    for name, part in scene.surrounding_meshes.items():
        if name in ground:
            continue
        corners = (compute_base_vertices(part) * scene.size_in_metres)[part.mesh.faces.astype(np.int64)]
        near = (corners.min(axis=1)[:, :2] < thing.outline.max(axis=0)) & (
            corners.max(axis=1)[:, :2] > thing.outline.min(axis=0)
        )
        upright = (corners[..., 2].max(axis=1) > 0.01) & (corners[..., 2].min(axis=1) < thing.upper)
        assert not (near.all(axis=1) & upright).any() or name in ("walls", "lamp", "trees"), name
    assert low < thing.lower < 0.01


@pytest.mark.parametrize(
    ("environment", "shining", "luminance"), [("room", "window", None), ("room-evening", "lamp", room.SHADE)]
)
def test_by_day_the_window_lights_the_room_and_in_the_evening_the_lamp(
    environment: str, shining: str, luminance: float | None
) -> None:
    scene = load_description("mug", environment)
    unit = scene.environment
    assert unit is not None and unit.candelas is not None
    means = {
        name: float((part.emission.mean(axis=(0, 1)) @ np.array(LUMINANCE)) * unit.candelas)
        for name, part in scene.surrounding_meshes.items()
        if part.emission is not None
    }
    assert max(means, key=lambda name: means[name]) == shining
    if luminance is not None:
        assert means["lamp"] == pytest.approx(0.845 * luminance, rel=0.02)  # of its colour
    renderer = load_scene("mug", environment, settings={"camera.distance": 0.5}).renderer(["pose"], resolution=24)
    with torch.no_grad():
        picture = renderer(renderer.start, 0, 16)
    assert 0.15 < float(picture.mean()) < 0.75 and float((picture > 0.99).float().mean()) < 0.1
