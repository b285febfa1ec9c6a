"""The road under things of the street, what distances mean for what has a size, and surfaces of several materials."""

import numpy as np
import pytest
import torch

from advsearch.controls.camera import CameraControl
from advsearch.controls.texture import TextureControl
from advsearch.engine.loading import load_scene
from advsearch.errors import InputError
from advsearch.scene.description import load_description
from advsearch.scene.geometry import camera_to_world
from advsearch.scene.grounds import is_paved
from advsearch.scene.raster import find_exclusive_texels

SIZE = 16


@pytest.mark.medium
def test_a_street_brings_its_road_and_a_table_takes_its_place() -> None:
    street = load_scene("car", "street")
    assert is_paved(street.description)
    assert not is_paved(load_scene("car", "noon").description)
    for given in ({"ground.kind": "table"}, {"ground.size": 2.0}, {"ground.size": 0.0}, {"ground.red": 0.5}):
        assert not is_paved(street.with_settings(given).description), given
        assert not is_paved(load_description("car", "street", setting_values=given)), given
    assert is_paved(load_scene("mug", "noon", settings={"ground.kind": "road"}).description)
    with pytest.raises(InputError, match=r"ground\.kind=wet-road"):
        load_description("car", "street", setting_values={"ground.kind": "wet-road", "ground.red": 0.5})


@pytest.mark.parametrize(("name", "metres"), [("car", 4.3), ("chair", 0.92)])
def test_distances_are_in_metres_where_the_object_has_a_size(name: str, metres: float) -> None:
    scene = load_description(name, setting_values={"camera.distance": 10.0})
    middle = (scene.object.mesh.vertices.min(axis=0) + scene.object.mesh.vertices.max(axis=0)) / 2.0
    away = float(np.linalg.norm(camera_to_world(scene)[:3, 3] - middle))
    assert away == pytest.approx(10.0 / metres, rel=0.01)
    bound = CameraControl(distance=[10.0, 30.0], azimuth=[0, 90]).bind(load_description(name))
    u = torch.tensor([0.0] * len(bound.start))
    said = bound.describe(u)["camera.distance"]
    assert said == {"value": pytest.approx(10.0), "unit": "metres"}
    place = bound.inputs(u)["camera.to_world"][:3, 3].numpy()
    assert float(np.linalg.norm(place - middle)) == pytest.approx(10.0 / metres, rel=0.01)


def test_an_object_of_several_materials_keeps_its_finishes() -> None:
    car = load_scene("car", "street").description
    assert car.object.surface is not None
    rough = car.object.surface["bsdf"]["roughness"]["bitmap"]  # type: ignore[index]
    values = {round(float(one), 3) for one in np.unique(rough)}
    assert values == {round(one.roughness, 3) for one in car.object.finishes.values()}
    with pytest.raises(InputError, match=r"material\.roughness"):
        load_description("car", setting_values={"material.roughness": 0.1})


def test_only_the_paint_is_painted() -> None:
    scene = load_description("car")
    bound = TextureControl(materials="paint", epsilon=0.3).bind(scene)
    before, after = (bound.inputs(u)["object.base_color"] for u in (bound.start, (bound.start + 0.3).clamp(0.0, 1.0)))
    moved = ((after - before).abs().amax(dim=2) > 0.01).numpy()
    mesh, shape = scene.object.mesh, (moved.shape[0], moved.shape[1])
    paint, _ = find_exclusive_texels(mesh, mesh.materials["paint"], shape)
    glass, _ = find_exclusive_texels(mesh, mesh.materials["glass"], shape)
    assert moved[paint].mean() > 0.99
    assert not moved[glass].any()
