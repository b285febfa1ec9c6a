"""Mounted cameras, cameras of a height, and the heights from which vehicles are seen."""

import numpy as np
import pytest
import torch

from advsearch.controls.camera import ROAD_USER_HEIGHTS, CameraControl
from advsearch.engine.loading import Scene, load_scene, scene_to_settings
from advsearch.scene.camera_entries import PRESETS
from advsearch.scene.description import SceneDescription, load_description
from advsearch.scene.geometry import camera_to_world
from advsearch.scene.grounds import make_camera_view


def lens(scene: SceneDescription, to_world: torch.Tensor | None = None) -> np.ndarray:
    """The place (3,) of the camera in metres."""
    pose = camera_to_world(scene) if to_world is None else to_world.double().numpy()
    return np.asarray(pose[:3, 3] * scene.size_in_metres)


def seen(name: str, camera: str, environment: str = "street", **said: object) -> SceneDescription:
    return load_scene(name, environment, camera=camera, **said).description  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "camera", "environment", "height"),
    [
        ("car", "dashcam", "street", 1.3), ("stop-sign", "dashcam", "street", 1.3), ("car", "robot", "street", 1.2),
        ("mug", "robot", "studio", 0.45),
    ],
)  # fmt: skip
def test_a_mounted_camera_is_as_high_as_it_is(name: str, camera: str, environment: str, height: float) -> None:
    scene = seen(name, camera, environment, **({"size": 0.1} if name == "mug" else {}))
    assert lens(scene)[2] == pytest.approx(height, abs=1e-4)
    assert scene.get_number("camera.fov") == PRESETS[camera].fov
    assert scene_to_settings(Scene(scene))["camera"] == camera
    assert "set" in scene_to_settings(Scene(scene)) and not scene.requested_values


@pytest.mark.parametrize("name", ["car", "stop-sign"])
def test_a_dashcam_is_in_the_lane_behind_a_car_and_before_a_sign(name: str) -> None:
    x, y, _ = lens(seen(name, "dashcam"))
    assert y == pytest.approx(0.0, abs=1e-4)
    assert (x < -9.0) if name == "car" else (x > 9.0)


def test_what_is_given_wins_over_a_preset() -> None:
    given = {"camera.distance": 30.0, "camera.fov": 60.0, "camera.height": 1.1, "camera.azimuth": 180.0}
    scene = seen("car", "dashcam", settings=given)
    x, _, z = lens(scene)
    assert (x > 0.0, z, scene.get_number("camera.fov")) == (True, pytest.approx(1.1, abs=1e-4), 60.0)
    assert make_camera_view(seen("car", "dashcam", settings={"camera.elevation": 10.0})).height > 2.0
    moved = Scene(seen("car", "dashcam")).with_settings({"camera.elevation": 10.0}).description
    assert lens(moved)[2] > 2.0


def test_all_that_a_dashcam_is_searched_in_keeps_its_height_and_its_lane() -> None:
    scene = seen("car", "dashcam")
    bound = CameraControl().bind(scene)
    assert {group.parameter for group in bound.groups} == {"azimuth", "distance", "fov"}
    for u in torch.rand(64, len(bound.start), generator=torch.Generator().manual_seed(0)):
        inputs = bound.inputs(u)
        x, y, z = lens(scene, inputs["camera.to_world"])
        assert z == pytest.approx(1.3, abs=1e-3)
        assert (x < -5.0, abs(y) < 11.0) == (True, True)
        assert inputs["camera.to_world"][2, 0] == pytest.approx(0.0, abs=1e-6)  # no roll
        assert 60.0 <= float(inputs["camera.fov"]) <= 90.0


def test_a_vehicle_is_seen_from_the_heights_of_road_users() -> None:
    car, mug = (CameraControl().bind(load_description(name, "street")) for name in ("car", "mug"))
    assert "elevation" in {group.parameter for group in mug.groups}
    assert {group.parameter for group in car.groups} == {
        "azimuth", "roll", "distance", "height"
    }  # fmt: skip
    scene = load_description("car", "street")
    for u in (torch.zeros(4), torch.ones(4), torch.full((4,), 0.5)):
        low, high = ROAD_USER_HEIGHTS
        assert low - 1e-3 <= lens(scene, car.inputs(u)["camera.to_world"])[2] <= high + 1e-3
    start = car.inputs(car.start)["camera.to_world"].double().numpy()
    np.testing.assert_allclose(start, camera_to_world(scene), atol=1e-5)
    free = CameraControl(elevation=[5.0, 60.0]).bind(scene)
    assert [group.parameter for group in free.groups] == ["elevation"]
