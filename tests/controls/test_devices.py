"""What is done to a picture or a mesh is done on the device where it lies.

There need be no other device for that: `meta` has shapes without numbers, and mixes with the processor as little.
"""

from __future__ import annotations

import pytest
import torch

from advsearch.controls import make_control
from advsearch.controls.corruption.control import NAMES, corrupted
from advsearch.scene.assembly import Assembly
from advsearch.scene.description import describe
from advsearch.scene.formation import ImageFormation, to_8_bit

ELSEWHERE = torch.device("meta")
PICTURE = torch.zeros(16, 12, 3, device=ELSEWHERE)
READS = {"shot_noise", "jpeg"}
"""Corruptions that look at the numbers of a picture, of which `meta` has none."""


@pytest.mark.parametrize("severity", [0.5, 2.5])
@pytest.mark.parametrize("name", sorted(set(NAMES) - READS))
def test_a_corrupted_picture_stays_where_it_is(name: str, severity: float) -> None:
    found = corrupted(PICTURE, name, torch.tensor(severity))
    assert found.device == ELSEWHERE and found.shape == PICTURE.shape


@pytest.mark.parametrize("name", ["lens", "sensor"])
def test_a_control_of_the_picture_leaves_it_where_it_is(name: str) -> None:
    bound = make_control(name).bind(describe("mug"))
    found = bound.picture(bound.start, PICTURE)
    assert found.device == ELSEWHERE and found.shape == PICTURE.shape


def test_a_picture_is_formed_where_its_radiance_is() -> None:
    assert to_8_bit(ImageFormation().display(PICTURE)).device == ELSEWHERE


@pytest.mark.parametrize("given", [("to_world",), ("offsets",), ("to_world", "offsets")])
def test_a_mesh_moves_on_the_device_of_what_moves_it(given: tuple[str, ...]) -> None:
    scene = describe("mug")
    count = len(scene.object.mesh.vertices)
    made = {"to_world": torch.eye(4, device=ELSEWHERE), "offsets": torch.zeros(count, 3, device=ELSEWHERE)}
    found = Assembly(scene)({f"object.{name}": made[name] for name in given})
    assert {name: (one.device, one.shape) for name, one in found.items()} == {
        f"object.{name}": (ELSEWHERE, (count, 3)) for name in ("vertices", "normals")
    }
