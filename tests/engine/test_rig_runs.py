"""Runs of a rig: killed within a configuration and resumed, shared by workers, judged by boxes, bounded in memory."""

import math
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch
from test_rigs import RING, rig
from torch import Tensor, nn

import advsearch
from advsearch.cli.main import main
from advsearch.models import load_model
from advsearch.runs.store import NAME, Store
from advsearch.scene.geometry import camera_to_world, compute_center, compute_object_to_world
from advsearch.tasks import make_task
from conftest import ROOT

PAIR = "cameras: [{name: left}, {name: right, place: [0.6, 0, 0], turn: [-10, 2, 15], fov: 50}]"
SWEEP = ["sweep", "--grid", "pose.yaw=0:360:4", "--batch", "1", "--trials", "0"]
ATTACK = ["attack", "--control", "light", "--policy", "random", "--steps", "3", "--trials", "6", "--verify-spp", "2"]
RIG = ["--object", "mug", "--task", "rig={rule: vote}", "--resolution", "16", "--spp", "1", "--quiet"]

KILLED = """
import os, signal, sys
from advsearch.cli.main import main
from advsearch.errors import InputError
from advsearch.scene.renderer import Renderer
whole, pictures, last = Renderer.finish_image, 0, int(sys.argv[1])
def view(self, *words, **more):
    global pictures
    pictures += 1
    if pictures == last:
        os.kill(os.getpid(), signal.SIGKILL)
    return whole(self, *words, **more)
Renderer.finish_image = view
sys.exit(main(sys.argv[2:]))
"""


def rows(run: Path) -> list[dict[str, Any]]:
    with Store(run / NAME, read_only=True) as store:
        return [{**vars(row), "seconds": None, "time": None} for row in store.rows()]


@pytest.mark.medium
@pytest.mark.parametrize(("words", "last"), [pytest.param(SWEEP, 6, marks=pytest.mark.slow), (ATTACK, 14)])
def test_killed_between_two_cameras_it_ends_with_the_same_rows(tmp_path: Path, words: list[str], last: int) -> None:
    words = [*words, *RIG, "--camera", rig(tmp_path, PAIR)]
    assert main([*words, "--run", str(tmp_path / "whole")]) == 0
    command = [sys.executable, "-c", KILLED, str(last), *words, "--run", str(tmp_path / "killed")]
    killed = subprocess.run(command, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, check=False)
    assert killed.returncode == -signal.SIGKILL
    assert 0 < len(rows(tmp_path / "killed")) < len(rows(tmp_path / "whole"))
    assert main(["resume", str(tmp_path / "killed"), "--quiet"]) == 0
    assert rows(tmp_path / "killed") == rows(tmp_path / "whole")


@pytest.mark.slow
def test_two_workers_have_the_rows_of_none(tmp_path: Path) -> None:
    words = [*SWEEP, *RIG, "--camera", rig(tmp_path, PAIR)]
    assert main([*words, "--run", str(tmp_path / "alone")]) == 0
    assert main([*words, "--run", str(tmp_path / "shared"), "--workers", "2"]) == 0
    found = rows(tmp_path / "alone")
    assert len(found) == 4 and len(found[0]["payload"]["pictures"]) == 2
    assert rows(tmp_path / "shared") == found


class Everywhere(nn.Module):
    """A detector that finds a mug in the whole of every picture."""

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        height, width = images.shape[2:]
        box = images.new_tensor([[0.0, 0.0, width, height]]).expand(len(images), 1, 4)
        mug = 0.9 - 0.1 * images.mean(dim=(1, 2, 3))
        return box, torch.stack([mug, 0.0 * mug], dim=1)[:, None]


def projected(points: npt.NDArray[Any], pose: npt.NDArray[Any], fov: float, side: int) -> npt.NDArray[Any]:
    """The box around points (n, 3) that a pinhole at a pose sees, x0, y0, x1, y1 in pixels: x to the left, y up."""
    seen = (points - pose[:3, 3]) @ pose[:3, :3]
    shares = seen[:, :2] / seen[:, 2:] / math.tan(math.radians(fov) / 2.0)
    pixels = (1.0 - shares) * side / 2.0
    return np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])


@pytest.mark.medium
@pytest.mark.parametrize("text", [RING, "cameras: [{}, {place: [0.02, 0, 0], turn: [-3, 2, 15], fov: 60}]"])
def test_every_picture_has_the_box_of_an_independent_projection(tmp_path: Path, text: str) -> None:
    side, file = 64, rig(tmp_path, text)
    model = advsearch.load_model(Everywhere(), labels=("mug", "dog"), input_size=side, task="detection")
    swept = advsearch.sweep(
        "mug", model, grid={"pose.yaw": [0, 50]}, camera=file, trials=0, spp=1, denoise="none", resolution=side,
        task={"name": "rig", "task": {"name": "detection", "unit": "pixels", "boxes": "xyxy", "iou": 0.1}},
    )  # fmt: skip
    scene = advsearch.load_scene("mug", camera=file).description
    vertices = scene.object.mesh.vertices.astype(np.float64)
    centre, metres, fov = compute_center(scene), scene.size_in_metres, scene.get_number("camera.fov")
    for row, yaw in zip(swept.rows(), (0.0, 50.0), strict=True):
        payload: Any = row.payload
        assert row.correct and len(payload["pictures"]) == len(scene.rig)
        to_world = compute_object_to_world(scene.with_values(pose__yaw=yaw))
        points = vertices @ to_world[:3, :3].T + to_world[:3, 3]
        for number, picture in enumerate(payload["pictures"]):
            pose, seen_fov = camera_to_world(scene), fov
            if text == RING:
                angle = math.radians(90.0 * number)
                turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
                pose[:2] = turn @ pose[:2]
                pose[:2, 3] += centre[:2] - turn @ centre[:2]
            elif number:
                yaw_, pitch, roll = (math.radians(one) for one in (-3.0, 2.0, 15.0))
                left, up, ahead, place = pose[:3, :3].T[0], pose[:3, 1], pose[:3, 2], pose[:3, 3]
                place = place - left * 0.02 / metres
                ahead, left = (  # to the right by a positive yaw
                    ahead * math.cos(yaw_) - left * math.sin(yaw_), left * math.cos(yaw_) + ahead * math.sin(yaw_)
                )  # fmt: skip
                ahead, up = (
                    ahead * math.cos(pitch) + up * math.sin(pitch),
                    up * math.cos(pitch) - ahead * math.sin(pitch),
                )
                right = -left  # about its own axis: from the right towards what is below
                right, down = (
                    right * math.cos(roll) - up * math.sin(roll),
                    -up * math.cos(roll) - right * math.sin(roll),
                )
                pose, seen_fov = np.eye(4), 60.0
                pose[:3] = np.stack([-right, -down, ahead, place], axis=1)
            box = projected(points, pose, seen_fov, side)
            assert np.abs(np.array(picture["payload"]["box"]) - box).max() <= 1.0, (number, box, picture)


class Finds(nn.Module):
    """A detector with a convolution, a batch norm and boxes that depend on the picture; it counts them."""

    def __init__(self) -> None:
        super().__init__()
        self.see = nn.Sequential(nn.Conv2d(3, 8, 3, padding=1), nn.BatchNorm2d(8), nn.ReLU(), nn.Conv2d(8, 5, 1))
        self.most = 0

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        self.most = max(self.most, len(images))
        found = self.see(images).mean(dim=(2, 3))
        return found[:, None, :4].sigmoid(), torch.stack([found[:, 4], -found[:, 4]], dim=1)[:, None].sigmoid()


def test_a_gradient_keeps_no_more_of_sixteen_cameras_than_of_four() -> None:
    """But for their pictures; and it is the same."""
    torch.manual_seed(0)
    side = 24
    model = load_model(Finds(), labels=("mug", "dog"), input_size=side, task=make_task("detection"))
    network: Any = model.module
    picture = torch.rand(side, 16 * side, 3, dtype=torch.float32, requires_grad=True)
    kept = [0]

    def pack(one: Tensor) -> Tensor:
        kept[0] += one.nelement() * 4
        return one

    def slope(cameras: int) -> tuple[Tensor, int, int]:
        seen, kept[0], network.most = picture[:, : cameras * side], 0, 0
        with torch.autograd.graph.saved_tensors_hooks(pack, lambda one: one):
            (found,) = replace(model, cameras=cameras)(seen)
            value = sum(
                ((one[0]["boxes"].sum() + one[0]["scores"][:, 0].sum()) * (1 + k) for k, one in enumerate(found))
            )
        (gradient,) = torch.autograd.grad(value, picture)
        return gradient, kept[0], network.most

    few, less, _ = slope(4)
    many, more, most = slope(16)
    torch.testing.assert_close(many[:, : 4 * side], few[:, : 4 * side], atol=1e-9, rtol=1e-4)
    assert bool((many.abs().amax(dim=(0, 2)) > 0).all()) and most == 4
    assert more <= 16 * side * side * 3 * 4 < less, (less, more)
