"""Where the camera is, for what it must see or must not see."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from advsearch.scene.description import SceneDescription
from advsearch.scene.geometry import affine, camera_to_world

PARKED = 1e-3  # size of an occluder that is put away, behind the camera
SURROUNDINGS = ("camera.to_world", "camera.fov", "camera.shift", "camera.lens", "object.to_world", "object.offsets")
"""Inputs of other controls that an occluder goes by."""


def camera_in(scene: SceneDescription, so_far: Mapping[str, Tensor]) -> Tensor:
    """Return the pose (4, 4) of the camera where the controls before have it."""
    return so_far.get("camera.to_world", torch.from_numpy(camera_to_world(scene)))


def put_away(camera: Tensor) -> Tensor:
    """Return the pose (4, 4) of what is out of sight: tiny, behind the camera of a pose (4, 4)."""
    return affine(PARKED * torch.eye(3).to(camera), camera[:3, 3] - camera[:3, 2])
