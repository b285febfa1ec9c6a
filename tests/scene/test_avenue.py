"""The avenue: a street as geometry, to scale in metres, which comes and goes with its ground."""

import numpy as np
import pytest
import torch

from advsearch.engine.loading import load_scene
from advsearch.scene.description import load_description
from advsearch.scene.grounds import LUMINANCE
from advsearch.scene.mitsuba_backend import scene as mitsuba_scene
from scenes.places.avenue import AVENUE, END, KERB, LAMP_HEIGHT, lamp_places
from scenes.places.paint import FRONTS
from scenes.places.road import KERBS


@pytest.mark.medium
@pytest.mark.parametrize("name", ["car", "stop-sign"])
def test_an_avenue_has_its_size_in_metres_whatever_stands_in_it(name: str) -> None:
    scene = load_description(name, "avenue")
    places = {one: part.mesh.vertices * scene.size_in_metres for one, part in scene.surrounding_meshes.items()}
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


@pytest.mark.medium
def test_roulette_changes_the_noise_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    images = []
    for depth in (mitsuba_scene.ROULETTE_DEPTH, mitsuba_scene.NO_ROULETTE_DEPTH):
        monkeypatch.setattr(mitsuba_scene, "ROULETTE_DEPTH", depth)
        scene = load_scene("car", "avenue", settings={"camera.distance": 12.0})
        renderer = scene.renderer(["texture"], resolution=12, denoise="none")
        assert renderer.scene.roulette_depth == depth
        images.append(renderer.radiance(renderer.start, depth, 1024).detach())
    assert torch.allclose(images[0].mean(dim=(0, 1)), images[1].mean(dim=(0, 1)), rtol=0.01)
    assert not torch.equal(images[0], images[1])


def test_lamps_shine_at_dusk_with_the_light_that_they_are_said_to_have() -> None:
    assert load_description("car", "avenue").surrounding_meshes["street-lamps"].emission is None
    night = load_description("car", "avenue-night")
    lamps, unit = night.surrounding_meshes["street-lamps"], night.environment
    assert lamps.emission is not None
    assert unit is not None
    assert unit.candelas is not None
    # a level area of A m2 that shines L cd/m2, h above: E = L A / h^2
    luminance = float(lamps.emission[0, 0] @ np.array(LUMINANCE)) * unit.candelas
    corners = lamps.mesh.vertices[lamps.mesh.faces[: len(lamps.mesh.faces)]].astype(np.float64) * night.size_in_metres
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    assert luminance * area / len(lamp_places(AVENUE.posts)) / 7.5**2 == pytest.approx(15.0, rel=0.02)
