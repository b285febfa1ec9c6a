"""The `pose` control: position, rotation and size of the object or another mesh.

    world = scale * exp([rotation]) Rz(yaw) Ry(pitch) Rx(roll) (v - center), then put on
    the ground and shifted

Another mesh than the object keeps the height of its lowest point. `rotation` is a rotation
vector (axis times angle), which is applied after the angles. It has no gimbal lock, as
the angles have at a pitch of 90 degrees.
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
    """Position, rotation and size of the object."""

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
            "Rotation vector that is applied after the angles.",
            moves_silhouettes=True,
            estimators=Parameter.GEOMETRIC,
        ),
        *POSE[3:],
    )
    choices = (
        Choice(
            "on_ground",
            "yes",
            "yes: the lowest point stays at height z in any rotation; no: the centre "
            "keeps its height.",
        ),
    )

    def check_choices(self) -> None:
        choice = self.choice_values["on_ground"]
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
        # None for the object
        surrounding_mesh = self.scene.surrounding_meshes.get(mesh.name)
        base_pose, vertices, floor = _get_base_pose(mesh, surrounding_mesh)
        base_pose = base_pose.to(device)
        vertices = vertices.to(device)
        center = (vertices.amin(dim=0) + vertices.amax(dim=0)) / 2.0
        linear = _compute_linear_map(values)
        lowest = self._find_lowest(vertices - center, linear, floor - center[2])
        # The new center is `shift_and_height + level_center`: x and y are shifts of the
        # old center, and the height is absolute.
        new_height = floor + values["z"] - lowest
        shift_and_height = torch.stack([values["x"], values["y"], new_height])
        level_center = torch.cat([center[:2], center.new_zeros(1)])
        # The linear map turns about the origin, and moves the center to linear @ center.
        translation = shift_and_height - linear @ center + level_center
        return {f"{mesh.name}.to_world": make_affine(linear, translation) @ base_pose}

    def _find_lowest(
        self, offsets: Tensor, linear: Tensor, lowest_before: Tensor
    ) -> Tensor:
        """Return the height () of the lowest point relative to the center, below 0.

        Args:
            offsets: (V, 3) vertices of the mesh, from its center.
            linear: (3, 3) scale and rotation of the mesh.
            lowest_before: () height of the lowest point before the mesh is turned.
        """
        if self.choice_values["on_ground"] in ("yes", True):  # text, or a YAML boolean
            # of the turned and scaled mesh, so that its lowest point is on the floor
            # the row 2 of the linear map gives the height, z
            return (offsets @ linear[2]).amin()
        # of the mesh before, so that the center keeps its height
        return lowest_before


def _compute_linear_map(values: Values) -> Tensor:
    """Return the scale and the rotation of a pose as a matrix (3, 3)."""
    rotation = make_vector_rotation(values["rotation"]) @ make_euler_rotation(
        values["yaw"], values["pitch"], values["roll"]
    )
    return values["scale"] * rotation


@lru_cache(maxsize=16)
def _get_base_pose(
    mesh: MeshPart, surrounding_mesh: MeshPart | None
) -> tuple[Tensor, Tensor, float]:
    """Return the pose of a mesh before the control moves it.

    Args:
        mesh: mesh that is posed.
        surrounding_mesh: the same mesh in the scene as it was described, with its pose;
            None for the object, whose mesh is in the coordinates of the scene and stands
            on the height 0.

    Returns:
        The pose (4, 4) from the mesh's coordinates to the scene, its vertices (V, 3) in
        the scene, and the height of the lowest one.
    """
    if surrounding_mesh is None:
        return torch.eye(4), torch.from_numpy(mesh.mesh.vertices), 0.0
    positions = compute_base_vertices(surrounding_mesh)
    return (
        torch.from_numpy(surrounding_mesh.to_world).float(),
        torch.from_numpy(positions).float(),
        float(positions[:, 2].min()),
    )
