"""Settings, poses and cameras, without Mitsuba."""

import numpy as np
import pytest

from advsearch.scene.description import SceneDescription, load_description
from advsearch.scene.geometry import FRAME_FILL, camera_to_world, compute_object_to_world, make_rotation


def projected(description: SceneDescription) -> np.ndarray:
    """Vertices in units of half the picture, and their depth, by an independent pinhole projection."""
    camera = camera_to_world(description)
    world = (
        description.object.mesh.vertices @ compute_object_to_world(description)[:3, :3].T
        + compute_object_to_world(description)[:3, 3]
    )
    local = (world - camera[:3, 3]) @ camera[:3, :3]
    half = np.tan(np.radians(description.get_number("camera.fov")) / 2)
    return np.column_stack([local[:, :2] / local[:, 2:3] / half, local[:, 2]])


@pytest.mark.parametrize("name", ["mug", "bowl", "lamp", "wine-glass"])
@pytest.mark.parametrize("fov", [20.0, 35.0, 60.0])
def test_the_default_camera_frames_the_whole_object_and_fills_the_frame(name: str, fov: float) -> None:
    points = projected(load_description(name, setting_values={"camera.fov": fov}))
    assert points[:, 2].min() > 0.0
    assert np.abs(points[:, :2]).max() == pytest.approx(FRAME_FILL, abs=1e-3)


@pytest.mark.medium
@pytest.mark.parametrize("name", ["mug", "banana", "hammer", "chair", "teapot"])
def test_no_azimuth_takes_any_of_the_object_out_of_the_picture(name: str) -> None:
    reached = [
        np.abs(projected(load_description(name, setting_values={"camera.azimuth": float(azimuth)}))[:, :2]).max()
        for azimuth in range(0, 360, 5)
    ]
    assert max(reached) <= 1.0 + 1e-6
    assert max(reached) > 0.98 or np.abs(projected(load_description(name))[:, :2]).max() == pytest.approx(FRAME_FILL)


def test_a_camera_at_azimuth_zero_and_no_elevation_looks_from_plus_x_with_z_up() -> None:
    camera = camera_to_world(load_description("mug", setting_values={"camera.azimuth": 0.0, "camera.elevation": 0.0}))
    assert np.allclose(camera[:3, 2], [-1, 0, 0]) and np.allclose(camera[:3, 1], [0, 0, 1])
    assert camera[0, 3] > 0 and np.linalg.det(camera[:3, :3]) == pytest.approx(1.0)


def test_a_rolled_camera_turns_the_picture_and_nothing_else() -> None:
    plain, rolled = (
        camera_to_world(load_description("ball", setting_values={"camera.roll": roll})) for roll in (0.0, 90.0)
    )
    assert np.allclose(rolled[:3, 2], plain[:3, 2])
    assert np.allclose(np.abs(rolled[:3, 0] @ plain[:3, 1]), 1.0)


@pytest.mark.parametrize("pose", [{}, {"pose.pitch": 35.0}, {"pose.roll": 90.0, "pose.scale": 2.0}])
def test_an_object_stands_on_the_ground_in_every_pose(pose: dict[str, float]) -> None:
    description = load_description("mug", setting_values=pose)
    matrix = compute_object_to_world(description)
    heights = description.object.mesh.vertices @ matrix[2, :3] + matrix[2, 3]
    assert heights.min() == pytest.approx(0.0, abs=1e-6)


def test_rotations_turn_yaw_counter_clockwise_seen_from_above() -> None:
    assert np.allclose(make_rotation(90.0, 0.0, 0.0) @ [1, 0, 0], [0, 1, 0])
