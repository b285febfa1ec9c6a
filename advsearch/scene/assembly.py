"""From what controls say to what Mitsuba takes: poses and displacements to vertices, environments to padded maps.

Controls speak of an object's pose (`NAME.to_world`) and shape (`NAME.offsets`) separately, so that they compose;
Mitsuba takes world-space vertices and normals. Everything here is torch, so gradients of vertices reach both.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from advsearch.scene.assets import Mesh
from advsearch.scene.description import SceneDescription

ON_PICTURE = frozenset({"backdrop.color", "camera.exposure"})
"""Inputs that Mitsuba never sees: the renderer applies them to radiance."""


class MovingMesh:
    """One mesh whose vertices and normals follow a pose and a displacement.

    Args:
        mesh: in its own coordinates.
        to_world: (4, 4) its base pose.
    """

    def __init__(self, mesh: Mesh, to_world: np.ndarray) -> None:
        self._mesh = mesh
        self.vertices = torch.from_numpy(mesh.vertices.astype(np.float32))
        self.normals = torch.from_numpy(mesh.normals.astype(np.float32))
        self.to_world = torch.from_numpy(to_world.astype(np.float32))

    def place(self, to_world: Tensor | None, offsets: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return world-space vertices and unit normals, both (V, 3).

        Args:
            to_world: (4, 4) an invertible affine map, or None for the base pose.
            offsets: (V, 3) displacement in mesh coordinates, or None.
        """
        given = to_world if to_world is not None else offsets
        device = self.vertices.device if given is None else given.device
        matrix = self.to_world.to(device) if to_world is None else to_world
        vertices, normals = self.vertices.to(device), self.normals.to(device)
        if offsets is not None:
            vertices = vertices + offsets
            normals = self._turned(offsets)
        moved = vertices @ matrix[:3, :3].T + matrix[:3, 3]
        turned = normals @ torch.linalg.inv(matrix[:3, :3])
        return moved, turned / turned.norm(dim=1, keepdim=True).clamp_min(1e-12)

    def _turned(self, offsets: Tensor) -> Tensor:
        """Shading normals of the displaced mesh.

        Area-weighted normals over vertices that share place and normal (so that creases stay creases) are worked out
        for the displaced and for the original mesh; their difference is added to the author's normals.
        """
        device = offsets.device
        displaced = self._area_normals(self.vertices.to(device) + offsets)
        return self.normals.to(device) + (displaced - self._original_area_normals.to(device))

    def _area_normals(self, vertices: Tensor) -> Tensor:
        faces, groups = self._faces.to(vertices.device), self._groups.to(vertices.device)
        first, second, third = (vertices.index_select(0, faces[:, corner]) for corner in range(3))
        normals = torch.linalg.cross(second - first, third - first)
        summed = vertices.new_zeros(self._group_count, 3).index_add(
            0, groups[faces].T.reshape(-1), normals.repeat(3, 1)
        )
        found = summed[groups]
        return found / (found.square().sum(dim=1, keepdim=True) + 1e-24).sqrt()

    @cached_property
    def _original_area_normals(self) -> Tensor:
        return self._area_normals(self.vertices)

    @cached_property
    def _faces(self) -> Tensor:
        return torch.from_numpy(self._mesh.faces.astype(np.int64))

    @cached_property
    def _groups(self) -> Tensor:
        rounded = np.round(np.concatenate([self._mesh.vertices * 1e5, self._mesh.normals * 1e3], axis=1))
        return torch.from_numpy(np.unique(rounded, axis=0, return_inverse=True)[1].reshape(-1).astype(np.int64))

    @cached_property
    def _group_count(self) -> int:
        return int(self._groups.max()) + 1


class Assembly:
    """Turns the inputs of a space into those of `MitsubaScene`.

    Args:
        description: the scene with all its parts.
    """

    def __init__(self, description: SceneDescription) -> None:
        self.meshes = {name: MovingMesh(part.mesh, part.to_world) for name, part in description.meshes.items()}
        self._photograph = description.photograph

    def __call__(self, inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the inputs with poses, displacements and maps worked out; differentiable torch operations."""
        found = dict(inputs)
        for name, mesh in self.meshes.items():
            to_world, offsets = found.pop(f"{name}.to_world", None), found.pop(f"{name}.offsets", None)
            if to_world is not None or offsets is not None:
                found[f"{name}.vertices"], found[f"{name}.normals"] = mesh.place(to_world, offsets)
        if "camera.shift" in found:
            shift = found.pop("camera.shift")
            found["camera.shift_x"], found["camera.shift_y"] = shift[:1], shift[1:]
        if "environment.data" in found:
            data = found.pop("environment.data")
            if self._photograph is not None:
                found["ground.reflectance"] = self._photograph.reflectance(data)
            found["environment.padded"] = torch.cat([data[:, -1:], data, data[:, :1]], dim=1)
        return found
