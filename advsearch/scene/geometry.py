"""Where things stand: the object's pose and the camera's place, as 4 x 4 matrices in numpy (column vectors, z up)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import torch

from advsearch.scene.description import ORBIT_CAMERA, SceneDescription
from advsearch.scene.framing import camera_axes, framing_distance, middle
from advsearch.scene.parts import MeshPart
from advsearch.scene.settings import POSE

Doubles = npt.NDArray[np.float64]


def rotation(yaw: float, pitch: float, roll: float) -> Doubles:
    """Return `Rz(yaw) Ry(pitch) Rx(roll)`, angles in degrees, as a (3, 3) matrix."""
    (cz, sz), (cy, sy), (cx, sx) = ((math.cos(math.radians(a)), math.sin(math.radians(a))) for a in (yaw, pitch, roll))
    rz = np.array([[cz, -sz, 0.0], [sz, cz, 0.0], [0.0, 0.0, 1.0]])
    ry = np.array([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]])
    rx = np.array([[1.0, 0.0, 0.0], [0.0, cx, -sx], [0.0, sx, cx]])
    return np.asarray(rz @ ry @ rx)


def affine(linear: torch.Tensor, place: torch.Tensor) -> torch.Tensor:
    """Return the pose (4, 4) `linear @ v + place` of a (3, 3) matrix and a place (3,); differentiable."""
    top = torch.cat([linear, place[:, None]], dim=1)
    return torch.cat([top, torch.tensor([[0.0, 0.0, 0.0, 1.0]]).to(linear)])


def object_to_world(description: SceneDescription) -> Doubles:
    """Return the object's pose: scale and rotate about the middle of its bounding box, keep it on the ground, shift.

    "On the ground" means that the lowest vertex is at z = 0 before `pose.z` is added, whatever the rotation.
    """
    vertices = description.object.mesh.vertices.astype(np.float64)
    return _posed(vertices, 0.0, {one.name: description.number(f"pose.{one.name}") for one in POSE})


def moved_part(part: MeshPart, values: Mapping[str, float | None]) -> MeshPart:
    """Return a mesh around the object as the settings have it: posed about its own middle, where it stands.

    Args:
        part: as it came.
        values: every setting of the scene; those of the mesh are `pose:NAME.yaw` and so on.
    """
    pose = {one.name: value for one in POSE if (value := values.get(f"pose:{part.name}.{one.name}")) is not None}
    if pose:
        places = standing(part)
        pose = {**{one.name: float(one.default) for one in POSE}, **pose}
        part = replace(part, to_world=_posed(places, float(places[:, 2].min()), pose) @ part.to_world)
    return replace(part, material=part.material.with_values(values, f"material:{part.name}."))


def standing(part: MeshPart) -> Doubles:
    """Return where the vertices (V, 3) of a mesh are in its base pose."""
    return np.asarray(part.mesh.vertices.astype(np.float64) @ part.to_world[:3, :3].T + part.to_world[:3, 3])


def _posed(places: Doubles, floor: float, pose: Mapping[str, float]) -> Doubles:
    """Scale and rotate about the middle of the bounding box, put the lowest vertex at `floor`, shift.

    Args:
        places: (V, 3) before.
        floor: where the lowest vertex comes to be before `z` is added.
        pose: parameters of `settings.POSE` by name.
    """
    middle = (places.min(axis=0) + places.max(axis=0)) / 2.0
    linear = pose["scale"] * rotation(pose["yaw"], pose["pitch"], pose["roll"])
    lowest = float(((places - middle) @ linear.T)[:, 2].min())
    matrix = np.eye(4)
    matrix[:3, :3] = linear
    matrix[:3, 3] = np.array([pose["x"], pose["y"], floor + pose["z"] - lowest]) - linear @ middle
    matrix[:2, 3] += middle[:2]
    return matrix


def camera_to_world(description: SceneDescription, aspect: float | None = None) -> Doubles:
    """Return the pose of the camera in use: by default on an orbit around the middle of the object, looking at it.

    The camera looks along its own +z with +y up and +x to the left, as Mitsuba's sensors do. It frames the object in
    its default pose, so that a shifted or scaled object moves in the picture.

    Args:
        description: the scene.
        aspect: width over height of the picture; None takes the description's.
    """
    if description.camera != ORBIT_CAMERA:
        return description.cameras[description.camera].to_world
    aspect = description.aspect if aspect is None else aspect
    number = description.number
    axes = camera_axes(number("camera.azimuth"), number("camera.elevation"), number("camera.roll"))
    asked = description.values["camera.distance"]
    distance = 0.0 if asked is None else asked / description.metres
    if asked is None:
        distance = float(framing_distance(description, torch.tensor(number("camera.fov"), dtype=torch.float64), aspect))
    matrix = np.eye(4)
    matrix[:3, 0], matrix[:3, 1], matrix[:3, 2] = axes[0], axes[1], -axes[2]
    matrix[:3, 3] = middle(description) + distance * axes[2]
    return matrix
