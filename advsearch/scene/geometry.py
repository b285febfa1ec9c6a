"""Where things stand: the object's pose and the camera's place, as 4 x 4 matrices in numpy (column vectors, z up)."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from advsearch.scene.description import FRAME_FILL, SceneDescription

Doubles = npt.NDArray[np.float64]


def rotation(yaw: float, pitch: float, roll: float) -> Doubles:
    """Return `Rz(yaw) Ry(pitch) Rx(roll)`, angles in degrees, as a (3, 3) matrix."""
    (cz, sz), (cy, sy), (cx, sx) = ((math.cos(math.radians(a)), math.sin(math.radians(a))) for a in (yaw, pitch, roll))
    rz = np.array([[cz, -sz, 0.0], [sz, cz, 0.0], [0.0, 0.0, 1.0]])
    ry = np.array([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]])
    rx = np.array([[1.0, 0.0, 0.0], [0.0, cx, -sx], [0.0, sx, cx]])
    return np.asarray(rz @ ry @ rx)


def object_to_world(description: SceneDescription) -> Doubles:
    """Return the object's pose: scale and rotate about the middle of its bounding box, keep it on the ground, shift.

    "On the ground" means that the lowest vertex is at z = 0 before `pose.z` is added, whatever the rotation.
    """
    number = description.number
    vertices = description.object.mesh.vertices.astype(np.float64)
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2.0
    linear = number("pose.scale") * rotation(number("pose.yaw"), number("pose.pitch"), number("pose.roll"))
    lowest = float(((vertices - middle) @ linear.T)[:, 2].min())
    matrix = np.eye(4)
    matrix[:3, :3] = linear
    matrix[:3, 3] = np.array([number("pose.x"), number("pose.y"), number("pose.z") - lowest]) - linear @ middle
    matrix[:2, 3] += middle[:2]
    return matrix


def camera_to_world(description: SceneDescription, aspect: float | None = None) -> Doubles:
    """Return the camera's pose: on an orbit around the middle of the object in its default pose, looking at it.

    The camera looks along its own +z with +y up and +x to the left, as Mitsuba's sensors do. It frames the object in
    its default pose, so that a shifted or scaled object moves in the picture.

    Args:
        description: the scene.
        aspect: width over height of the picture; None takes the description's.
    """
    aspect = description.aspect if aspect is None else aspect
    number = description.number
    vertices = description.object.mesh.vertices.astype(np.float64)
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2.0
    azimuth, elevation = math.radians(number("camera.azimuth")), math.radians(number("camera.elevation"))
    outwards = np.array(
        [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)]
    )
    forward = -outwards
    left = np.array([math.sin(azimuth), -math.cos(azimuth), 0.0])
    up = np.cross(forward, left)
    roll = math.radians(number("camera.roll"))
    left, up = math.cos(roll) * left + math.sin(roll) * up, math.cos(roll) * up - math.sin(roll) * left
    distance = description.values["camera.distance"]
    if distance is None:
        distance = fitting_distance(vertices - middle, left, up, outwards, number("camera.fov"), aspect)
    matrix = np.eye(4)
    matrix[:3, 0], matrix[:3, 1], matrix[:3, 2] = left, up, forward
    matrix[:3, 3] = middle + distance * outwards
    return matrix


def fitting_distance(
    offsets: Doubles, left: Doubles, up: Doubles, outwards: Doubles, fov: float, aspect: float = 1.0
) -> float:
    """Smallest distance at which every vertex projects inside `FRAME_FILL` of the picture.

    A vertex at offset `o` from the middle projects at `(o.left, o.up) / (distance - o.outwards)`, so that each vertex
    asks for `distance >= o.outwards + max(|o.left| / tx, |o.up| / ty)`; the largest of these is the answer.

    Args:
        offsets: (V, 3) vertices minus the point that the camera looks at.
        left: (3,) unit vector to the left in the picture.
        up: (3,) unit vector upwards in the picture.
        outwards: (3,) unit vector from the object to the camera.
        fov: field of view along the larger side, degrees.
        aspect: width over height of the picture.
    """
    larger = math.tan(math.radians(fov) / 2.0) * FRAME_FILL
    tangent_x, tangent_y = larger * min(1.0, aspect), larger * min(1.0, 1.0 / aspect)
    needed = np.maximum(np.abs(offsets @ left) / tangent_x, np.abs(offsets @ up) / tangent_y) + offsets @ outwards
    return float(needed.max())
