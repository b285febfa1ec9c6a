"""How settings pose meshes: matrices (4, 4) in numpy, column vectors, z up."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from advsearch.scene.assets import Float64Array, make_pose
from advsearch.scene.parts import MeshPart
from advsearch.scene.settings import POSE


def make_rotation(yaw: float, pitch: float, roll: float) -> Float64Array:
    """Return `Rz(yaw) Ry(pitch) Rx(roll)`, angles in degrees, as a (3, 3) matrix.

    It rotates first about x by the roll, then about y by the pitch, then about z by the
    yaw.
    """
    # cosine and sine of each
    (cz, sz), (cy, sy), (cx, sx) = (
        (math.cos(math.radians(a)), math.sin(math.radians(a)))
        for a in (yaw, pitch, roll)
    )
    rz = np.array([[cz, -sz, 0.0], [sz, cz, 0.0], [0.0, 0.0, 1.0]])
    ry = np.array([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]])
    rx = np.array([[1.0, 0.0, 0.0], [0.0, cx, -sx], [0.0, sx, cx]])
    return np.asarray(rz @ ry @ rx)


def apply_settings(part: MeshPart, values: Mapping[str, float | None]) -> MeshPart:
    """Return a mesh around the object with its settings applied.

    Settings such as `pose:NAME.yaw` pose it about its own middle, and its lowest point
    stays at the same height. Settings such as `material:NAME.roughness` change its
    material. Without settings of its own the mesh stays as it is.

    Args:
        part: the mesh.
        values: all settings of the scene by name.
    """
    user_parameters = _select_pose(part.name, values)
    if user_parameters:
        defaults = {parameter.name: float(parameter.default) for parameter in POSE}
        # The pose is that of the vertices in the world, so that it follows `to_world`.
        positions = compute_base_vertices(part)
        floor = float(positions[:, 2].min())
        pose = compute_pose(positions, floor, {**defaults, **user_parameters})
        part = replace(part, to_world=pose @ part.to_world)
    return replace(
        part, material=part.material.with_values(values, f"material:{part.name}.")
    )


def _select_pose(name: str, values: Mapping[str, float | None]) -> dict[str, float]:
    """Return the parameters of the pose of the mesh with a name that settings state."""
    user_parameters = {}
    for parameter in POSE:
        value = values.get(f"pose:{name}.{parameter.name}")
        if value is not None:
            user_parameters[parameter.name] = value
    return user_parameters


def compute_base_vertices(part: MeshPart) -> Float64Array:
    """Return where the vertices (V, 3) of a mesh are in its base pose."""
    return np.asarray(
        part.mesh.vertices.astype(np.float64) @ part.to_world[:3, :3].T
        + part.to_world[:3, 3]
    )


def compute_pose(
    positions: Float64Array, floor: float, parameters: Mapping[str, float]
) -> Float64Array:
    """Return the pose (4, 4) that parameters of `settings.POSE` give to vertices.

    It scales and rotates the vertices about the middle of their bounding box. Then it
    moves them up or down until the lowest is at the height `floor`, and shifts them by
    x, y and z. Without the shift the middle stays above the same point of the ground.

    Args:
        positions: (V, 3) positions of the vertices.
        floor: height of what they stand on.
        parameters: "scale", "yaw", "pitch" and "roll" in degrees, "x", "y" and "z".
    """
    center = (positions.min(axis=0) + positions.max(axis=0)) / 2.0
    linear = parameters["scale"] * make_rotation(
        parameters["yaw"], parameters["pitch"], parameters["roll"]
    )
    # height of the lowest vertex relative to the middle, below 0
    lowest = float(((positions - center) @ linear.T)[:, 2].min())
    # `- linear @ center` moves the middle to the origin. From there the height puts the
    # lowest vertex on the floor, and the shift is added.
    translation = (
        np.array([parameters["x"], parameters["y"], floor + parameters["z"] - lowest])
        - linear @ center
    )
    # In x and y the middle goes back to its old position, plus the shift.
    translation[:2] += center[:2]
    return make_pose(linear, translation)
