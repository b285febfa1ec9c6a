"""Several cameras, one verdict: where they look, rules by hand, and attacks on a network that takes all pictures."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from torch import Tensor, nn

import advsearch
from advsearch.models.all_at_once import AllAtOnce
from advsearch.scene.geometry import camera_to_world, make_rotation
from advsearch.scene.rig import read_rig
from advsearch.tasks import make_task

RING = "cameras: [{name: front}, {around: 90}, {around: 180}, {around: 270}]"
STEREO = "cameras: [{name: left}, {name: right, place: [0.6, 0, 0]}]"
CAMERA = {"camera_model": "pinhole", "intrinsics": [30.0, 30.0, 16.0, 16.0], "resolution": [32, 32]}
STEPS = "  T_cn_cnm1: [[1, 0, 0, -0.6], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"
SMALL: dict[str, Any] = {"environment": "street", "resolution": 24, "spp": 2, "verify_spp": 4, "denoise": "none"}


class Blue(nn.Module):
    """Says "car" where all pictures (N, K, 3, H, W) together are bluer than red."""

    def forward(self, pictures: Tensor) -> Tensor:
        assert pictures.ndim == 5
        blue = (pictures[:, :, 2] - pictures[:, :, 0]).mean(dim=(1, 2, 3))
        score = 60.0 * (blue - 0.06)
        return torch.stack([score, -score], dim=1)


class EachBlue(nn.Module):
    """The same of single pictures."""

    def forward(self, pictures: Tensor) -> Tensor:
        assert pictures.ndim == 4
        return cast(Tensor, Blue()(pictures[:, None]))


def rig(folder: Path, text: str) -> str:
    (folder / "rig.yaml").write_text(text)
    return str(folder / "rig.yaml")


def camchain(folder: Path) -> str:
    lines = [f"cam{number}:" for number in range(2)]
    text = ""
    for number, line in enumerate(lines):
        text += line + "\n"
        for name, value in CAMERA.items():
            text += f"  {name}: {value}\n"
        text += f"  distortion_model: radtan\n  distortion_coeffs: [{-0.1 * number}, 0.0, 0.0, 0.0]\n"
        text += STEPS + "\n" if number else ""
    return rig(folder, text)


@pytest.mark.medium
@pytest.mark.parametrize("kind", ["list", "camchain"])
def test_each_camera_takes_the_picture_that_it_takes_alone(tmp_path: Path, kind: str) -> None:
    """The first bit for bit; the second as a camera of the same pose in a scene of its own."""
    file = rig(tmp_path, STEREO) if kind == "list" else camchain(tmp_path)
    both = advsearch.load_scene("car", "street", camera=file).renderer(["light"], resolution=32, denoise="none")
    alone = None if kind == "list" else f"{file}#cam0"
    first = advsearch.load_scene("car", "street", camera=alone).renderer(["light"], resolution=32, denoise="none")
    with torch.no_grad():
        seen, own = both(both.start, 3, 4), first(first.start, 3, 4)
    assert seen.shape == (32, 64, 3)
    torch.testing.assert_close(seen[:, :32], own, atol=0.0, rtol=0.0)
    assert float((seen[:, 32:] - own).abs().mean()) > 0.02
    description = both.scene.description_and_filter[0]
    base = torch.from_numpy(camera_to_world(description)).float()
    pose = description.rig[1].make_inputs({}, base, torch.zeros(3), description.size_in_metres)["camera.to_world"]
    shift = (pose[:3, 3] - base[:3, 3]) * description.size_in_metres
    torch.testing.assert_close(shift, -0.6 * base[:3, 0], atol=1e-5, rtol=0.0)  # 0.6 m to the right: +x is to the left
    torch.testing.assert_close(pose[:3, :3], base[:3, :3], atol=1e-6, rtol=0.0)


@pytest.mark.medium
@pytest.mark.parametrize(
    ("rule", "right"), [("any", [1, 1, 1, 0]), ("all", [1, 0, 0, 0]), ("vote", [1, 1, 0, 0]), ("mean", [1, 1, 0, 0])]
)
def test_rules_are_those_worked_out_by_hand(rule: str, right: list[int]) -> None:
    """Of three pictures, 3, 2, 1 and 0 are right, each by the same margin; a target is reached by the same rule."""
    model = advsearch.load_model(EachBlue(), labels=("car", "road"), input_size=8)
    task = make_task({"name": "rig", "rule": rule}).on(replace(model, cameras=3))
    sides = [[1, 1, 1], [1, 1, -1], [1, -1, -1], [-1, -1, -1]]
    output = [tuple(torch.tensor([[2.0 * side, 0.0]]) for side in row) for row in sides]
    said = task.judge(output, ((0,), (0,), (0,)))
    assert [int(one.right) for one in said] == right
    assert [int(one.success) for one in said] == [1 - one for one in right]
    aimed = make_task({"name": "rig", "rule": rule}).on(replace(model, cameras=3), target="road")
    reached = [int(one.success) for one in aimed.judge(output, ((0,), (0,), (0,)))]
    assert reached == right[::-1]


@pytest.mark.medium
@pytest.mark.parametrize("text", [STEREO, RING])
def test_an_attack_on_a_network_that_takes_all_pictures_is_found_and_verified(tmp_path: Path, text: str) -> None:
    file = rig(tmp_path, text)
    cameras = len(read_rig(file))
    network = AllAtOnce(Blue(), cameras, "NKCHW")
    model = advsearch.load_model(network, labels=("car", "road"), input_size=24, name="blue")
    found = advsearch.attack(
        "car", model, camera=file, task="rig", controls="texture", epsilon=0.4, steps=6, trials=6, policy="pgd",
        baseline=False, run=tmp_path / "run", **SMALL,
    )  # fmt: skip
    assert found.summary.ending == "found", found.summary
    assert tuple(found.adversarial.shape) == (24, 24 * cameras, 3)
    kept = found.summary.adversarial
    assert kept is not None and isinstance(kept.payload, dict)
    assert len(cast("list[object]", kept.payload["pictures"])) == cameras


@pytest.mark.medium
def test_a_sweep_judges_each_picture_and_the_rig_by_its_rule(tmp_path: Path) -> None:
    model = advsearch.load_model(EachBlue(), labels=("car", "road"), input_size=24, name="blue")
    file, rights = rig(tmp_path, "cameras: [{}, {turn: [180, 0, 0]}]"), {}
    for rule in ("any", "all"):
        swept = advsearch.sweep(
            "car", model, grid={"camera.azimuth": "0:360:4"}, camera=file, task={"name": "rig", "rule": rule}, trials=0,
            environment="street", resolution=24, spp=2, denoise="none",
        )  # fmt: skip
        rights[rule] = swept.summary.correct
    assert rights["any"] == 4 > rights["all"]  # the second looks away from the car


def transforms(folder: Path, factor: float, **entries: object) -> str:
    """Three frames, the second 0.3 m to the right of the first, the third turned; positions times a scale."""
    frames = []
    for place, degrees in (([1.0, 2.0, 3.0], 0.0), ([1.3, 2.0, 3.0], 0.0), ([1.6, 2.0, 2.8], 8.0)):
        pose = np.eye(4)
        pose[:3, :3] = make_rotation(0.0, degrees, 0.0)
        pose[:3, 3] = factor * np.array(place)
        frames.append({"file_path": "a.png", "transform_matrix": pose.tolist()})
    lens = {"camera_model": "OPENCV", "fl_x": 30.0, "fl_y": 30.0, "cx": 16.0, "cy": 16.0, "w": 32, "h": 32}
    (folder / "transforms.json").write_text(json.dumps({**lens, **entries, "frames": frames}))
    return f"{folder / 'transforms.json'}#0,1,2"


HALF_AND_TURNED = [[0.0, 0.5, 0.0, 9.0], [-0.5, 0.0, 0.0, 8.0], [0.0, 0.0, 0.5, 7.0]]


@pytest.mark.parametrize(
    ("scale", "entries"),
    [
        (1.0, {}),
        (0.5, {"applied_scale": 0.5}),
        (0.25, {"applied_scale": 0.5, "applied_transform": HALF_AND_TURNED}),
        (1.0, {"scale": 0.33, "offset": [0.5, 0.5, 0.5], "aabb_scale": 4}),  # what Instant NGP does when it reads it
    ],
)
def test_frames_of_nerfstudio_are_as_far_apart_as_before_they_were_scaled(
    tmp_path: Path, scale: float, entries: dict[str, object]
) -> None:
    mounts = read_rig(transforms(tmp_path, scale, **entries))
    np.testing.assert_allclose(mounts[1].pose[:3, 3], [0.3, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(mounts[2].pose[:3, 3], [0.6, 0.0, 0.2], atol=1e-9)
    assert mounts[0].camera_model is not None and not mounts[0].camera_model.reading_notes
