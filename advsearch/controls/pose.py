"""The `pose` control: where the object or another mesh stands, how it is turned, and
how large it is.

    world = scale * exp([rotation]) Rz(yaw) Ry(pitch) Rx(roll) (v - middle), then put on
    the ground and shifted

A mesh around the object is put back on the height at which it stood, and shifted from
there. `rotation` is a rotation vector (axis times angle) on top of the angles, which
lock at a pitch of 90 degrees.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

import torch
from torch import Tensor

from advsearch.controls.base import Choice, Control, Values
from advsearch.errors import InputError
from advsearch.scene.geometry import (
    compute_base_vertices,
    make_affine,
    make_euler_rotation,
    make_vector_rotation,
)
from advsearch.scene.parts import MeshPart
from advsearch.scene.settings import POSE, Parameter


class PoseControl(Control):
    """Where the object stands, how it is turned, and how large it is."""

    kind = "pose"
    targets_mesh = True
    parameters = (
        *POSE[:3],
        Parameter(
            "rotation",
            (3,),
            "degrees",
            -180.0,
            180.0,
            0.0,
            "Rotation vector on top of the angles.",
            moves_silhouettes=True,
            estimators=Parameter.GEOMETRIC,
        ),
        *POSE[3:],
    )
    choices = (
        Choice(
            "on_ground",
            "yes",
            "yes: the lowest point stays at height z however it "
            "turns; no: its middle stays.",
        ),
    )

    def check_choices(self) -> None:
        choice = self.chosen["on_ground"]
        if choice not in ("yes", "no", True, False):
            raise InputError(
                f"{self.name}.on_ground: expected yes or no, got {choice!r}"
            )

    def scene_inputs(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Return the pose (4, 4) of the mesh, scaled and turned about its center.

        With `on_ground`, the lowest point of the turned mesh stays at its former
        height, plus z. Otherwise the center stays at its former height, plus z.
        """
        mesh = self.get_mesh(self.scene)
        device = values["scale"].device
        base, vertices, floor = _get_base_pose(
            mesh, self.scene.surrounding_meshes.get(mesh.name)
        )
        base = base.to(device)
        vertices = vertices.to(device)
        center = (vertices.amin(dim=0) + vertices.amax(dim=0)) / 2.0
        rotation = make_vector_rotation(values["rotation"]) @ make_euler_rotation(
            values["yaw"], values["pitch"], values["roll"]
        )
        linear = values["scale"] * rotation
        # height of the lowest point over the center, negative
        if self.chosen["on_ground"] in ("yes", True):
            # that of the turned and scaled mesh: its lowest point is put on the floor
            lowest = ((vertices - center) @ linear[2]).amin()
        else:
            # that of the mesh as it was: the center keeps its height
            lowest = floor - center[2]
        center_height = floor + values["z"] - lowest
        # x and y are shifts of the center; its height is absolute.
        shift = torch.stack([values["x"], values["y"], center_height])
        level_center = torch.cat([center[:2], center.new_zeros(1)])
        translation = shift - linear @ center + level_center
        return {f"{mesh.name}.to_world": make_affine(linear, translation) @ base}


@lru_cache(maxsize=16)
def _get_base_pose(
    mesh: MeshPart, surrounding: MeshPart | None
) -> tuple[Tensor, Tensor, float]:
    """Return where a mesh is before it is posed.

    Args:
        mesh: mesh that is posed.
        surrounding: the mesh as the scene came with it; None for the object, whose own
            coordinates are those of the scene.

    Returns:
        The pose (4, 4) from its own coordinates, its vertices (V, 3) in the scene, and
        their lowest height.
    """
    if surrounding is None:
        return torch.eye(4), torch.from_numpy(mesh.mesh.vertices), 0.0
    positions = compute_base_vertices(surrounding)
    return (
        torch.from_numpy(surrounding.to_world).float(),
        torch.from_numpy(positions).float(),
        float(positions[:, 2].min()),
    )
