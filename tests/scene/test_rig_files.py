"""Rigs from files of others: their axes against poses by hand, and what is refused."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from advsearch.errors import FileFormatError
from advsearch.scene.rig import RigCamera, read_rig

BY_HAND = "cameras: [{}, {place: [0.6, 0, 0]}, {place: [0, -0.5, 0.1], turn: [90, 0, 0]}, {turn: [0, 30, 0]}]"
"""0.6 to the right; 0.5 above, 0.1 ahead and turned to the right; turned up."""
S, C = np.sin(np.deg2rad(30.0)), np.cos(np.deg2rad(30.0))
OPENGL = [
    np.eye(4).tolist(),
    [[1, 0, 0, 0.6], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
    [[0, 0, -1, 0], [0, 1, 0, 0.5], [1, 0, 0, -0.1], [0, 0, 0, 1]],  # its back (z) is to the left of the first
    [[1, 0, 0, 0], [0, C, -S, 0], [0, S, C, 0], [0, 0, 0, 1]],  # its back is down, and behind
]
HALF = np.sqrt(0.5)
IMAGES = [  # from the world to the camera: the world's origin is at t
    "1 1 0 0 0 0 0 0 1 a.png",
    "4 1 0 0 0 -0.6 0 0 1 b.png",
    f"5 {HALF} 0 {-HALF} 0 0.1 0.5 0 1 with a space.png",  # the first's middle: 0.1 to its right, 0.5 below
    f"9 {np.cos(np.deg2rad(15.0))} {-np.sin(np.deg2rad(15.0))} 0 0 0 0 0 1 d.png",
]
SHARED = {"camera_model": "OPENCV", "fl_x": 30.0, "fl_y": 30.0, "cx": 16.0, "cy": 12.0, "w": 32, "h": 24}


def written(folder: Path, name: str, text: str) -> str:
    (folder / name).write_text(text)
    return str(folder / name)


def transforms(folder: Path, **more: Any) -> str:
    frames = [{"file_path": f"{k}.png", "transform_matrix": one} for k, one in enumerate(OPENGL)]
    return written(folder, "transforms.json", json.dumps({**SHARED, "frames": frames, **more}))


def images(folder: Path, lines: list[str] | None = None, points: str = "1.5 2.5 7 3 4 -1") -> str:
    written(folder, "cameras.txt", "# a comment\n1 PINHOLE 32 24 30 30 16 12\n2 SIMPLE_RADIAL 32 24 30 16 12 0.1\n")
    text = "# IMAGE_ID, ...\n" + "".join(f"{line}\n{points}\n" for line in (IMAGES if lines is None else lines))
    return written(folder, "images.txt", text)


def wanted(folder: Path) -> list[RigCamera]:
    return list(read_rig(written(folder, "rig.yaml", BY_HAND)))


@pytest.mark.parametrize("points", ["1.5 2.5 7 3 4 -1", ""])
def test_poses_of_others_are_those_by_hand(tmp_path: Path, points: str) -> None:
    for found in (read_rig(transforms(tmp_path) + "#0,1,2,3"), read_rig(images(tmp_path, points=points))):
        assert len(found) == 4 and all(
            one.camera_model is not None and one.camera_model.calibrated_shape == (24, 32) for one in found
        )
        for mount, by_hand in zip(found, wanted(tmp_path), strict=True):
            np.testing.assert_allclose(mount.pose, by_hand.pose, atol=1e-9)


def test_some_of_the_cameras_are_seen_from_the_first_of_them(tmp_path: Path) -> None:
    mounts = wanted(tmp_path)
    step = np.linalg.inv(mounts[2].pose) @ mounts[1].pose
    for found in (read_rig(transforms(tmp_path) + "#2,1"), read_rig(images(tmp_path) + "#5,4")):
        np.testing.assert_allclose(found[0].pose, np.eye(4), atol=1e-12)
        np.testing.assert_allclose(found[1].pose, step, atol=1e-9)
    assert [one.name for one in read_rig(images(tmp_path) + "#5,4")] == ["5", "4"]
    assert read_rig(transforms(tmp_path) + "#2") == () == read_rig(transforms(tmp_path))  # a lens, not a rig


@pytest.mark.parametrize(
    "lines",
    [
        IMAGES[:1], [f"{k} 1 0 0 0 0 0 0 1 a.png" for k in range(33)], [IMAGES[0], IMAGES[0]],
        [IMAGES[0], "2 1 0 0 0 0 0 1 b.png"], [IMAGES[0], "2 2 0 0 0 0 0 0 1 b.png"],
        [IMAGES[0], "2 1 0 0 0 nan 0 0 1 b.png"], [IMAGES[0], "2 1 0 0 0 0 0 0 3 b.png"],
    ],
)  # fmt: skip
def test_images_that_are_no_rig_are_refused(tmp_path: Path, lines: list[str]) -> None:
    with pytest.raises(FileFormatError, match=r"images\.txt|cameras\.txt"):
        read_rig(images(tmp_path, lines))


@pytest.mark.parametrize(
    ("which", "more"),
    [
        ("0,7", {}),
        ("0,0", {}),
        ("0,1", {"frames": [{}, {}]}),
        ("0,1", {"frames": [{"transform_matrix": (2 * np.eye(4)).tolist()}] * 2}),
        ("0,1", {"frames": [{"transform_matrix": np.diag([1, 1, -1, 1]).tolist()}] * 2}),
        ("0,1", {"frames": [{"transform_matrix": [[float("nan")] * 4] * 4}] * 2}),
        ("0,1", {"camera_model": "FOV"}),
    ],
)
def test_transforms_that_are_no_rig_are_refused(tmp_path: Path, which: str, more: Any) -> None:
    with pytest.raises(FileFormatError, match=r"transforms\.json"):
        read_rig(f"{transforms(tmp_path, **more)}#{which}")
