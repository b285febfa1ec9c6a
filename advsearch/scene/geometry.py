"""Where things stand: the object's pose and the camera's place, as 4 x 4 matrices in numpy (column vectors, z up).

Framing is how far from the object the camera stands where nobody says so. The distance depends on the object, the field
of view and the shape of the picture alone, never on where the camera is moved to: a configuration is one picture,
whether its azimuth is a setting, a fixed value or a point of a grid. It is the smallest distance at which

- from the default direction the object reaches at most `FRAME_FILL` of the way to the edge of the picture,
- from every azimuth at the default elevation all of it is in the picture, so that no search turns the end of a long
  object out of it, and
- the camera stays outside the sphere around the object.

A vertex at offset `o` from the middle projects at `(o.left, o.up) / (distance - o.outwards)`, so that each vertex asks
for `distance >= o.outwards + max(|o.left| / tx, |o.up| / ty)`, where tx and ty are the tangents of half the picture.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from advsearch.scene.assets import Doubles, pose_of
from advsearch.scene.parts import MeshPart
from advsearch.scene.settings import ORBIT_CAMERA, POSE, SETTINGS

if TYPE_CHECKING:
    from advsearch.scene.description import SceneDescription

FRAME_FILL = 0.86  # share of the picture's half-width that the object may reach when the distance is worked out
CLEARANCE = 0.02  # smallest distance, in object sizes, to the sphere around the object
STEEPEST = math.sin(math.radians(89.0))  # sine of the largest elevation, for a height that would need a steeper one
NEAREST = 1e-3  # depth up to which points have no place in the picture
DEFAULT_VIEW = ("camera.azimuth", "camera.elevation", "camera.roll")


def framing_distance(description: SceneDescription, fov: Tensor, aspect: float) -> Tensor:
    """Return the distance of the camera to the middle of a scene's object, () float64 in object sizes, for a field of
    view () along the larger side of the picture, degrees, and its width over height; differentiable in the first."""
    offsets = torch.from_numpy(description.object.mesh.vertices.astype(np.float64) - middle(description)).to(fov.device)
    model = description.camera_model
    if model is not None and model.name:  # of what it shows, a rectangle
        edge = torch.tensor(model.tangents, dtype=torch.float64, device=fov.device)
    else:
        shape = torch.tensor([min(1.0, aspect), min(1.0, 1.0 / aspect)], dtype=torch.float64, device=fov.device)
        edge = torch.tan(torch.deg2rad(fov.double()) / 2.0) * shape
    azimuth, elevation, roll = (float(SETTINGS[name].default or 0.0) for name in DEFAULT_VIEW)
    axes = torch.from_numpy(camera_axes(azimuth, elevation, roll)).T.to(offsets)
    (left, up, outwards), (wide, high) = offsets.matmul(axes).unbind(dim=1), edge * FRAME_FILL
    fits = (outwards + torch.maximum(left.abs() / wide, up.abs() / high)).max()
    whole = _from_all_around(offsets, elevation, edge)
    return torch.maximum(fits, whole).clamp_min(float(offsets.norm(dim=1).max()) + CLEARANCE)


def camera_axes(azimuth: float, elevation: float, roll: float) -> Doubles:
    """Return the unit vectors to the left and upwards in the picture and from the object to the camera: rows, (3, 3);
    for the camera's direction around the object, its height above the ground plane, and the picture's rotation,
    counter-clockwise, all in degrees."""
    azimuth, elevation, roll = math.radians(azimuth), math.radians(elevation), math.radians(roll)
    level, up = math.cos(elevation), math.sin(elevation)
    outwards = np.array([level * math.cos(azimuth), level * math.sin(azimuth), up])
    left = np.array([math.sin(azimuth), -math.cos(azimuth), 0.0])
    upright = np.cross(-outwards, left)
    turned = math.cos(roll) * left + math.sin(roll) * upright, math.cos(roll) * upright - math.sin(roll) * left
    return np.stack([*turned, outwards])


def middle(description: SceneDescription) -> Doubles:
    """Return what the camera looks at: the middle (3,) of the object's bounding box in its default pose."""
    vertices = description.object.mesh.vertices.astype(np.float64)
    return np.asarray((vertices.min(axis=0) + vertices.max(axis=0)) / 2.0)


def _from_all_around(offsets: Tensor, elevation: float, tangents: Tensor) -> Tensor:
    """The distance at which every vertex projects inside the tangents, from every azimuth at one elevation. Seen from
    all around, a vertex runs through a circle of radius rho at height z: what it asks for is a sine of the azimuth plus
    a constant for each edge of the picture, whose largest value is known in closed form."""
    rho, z = offsets[:, :2].norm(dim=1), offsets[:, 2]
    cosine, sine = math.cos(math.radians(elevation)), math.sin(math.radians(elevation))
    across, along = 1.0 / tangents[0], 1.0 / tangents[1]
    aside = rho * torch.sqrt(across**2 + cosine**2) + z * sine
    above = rho * (cosine - sine * along).abs() + z * (sine + cosine * along)
    below = rho * (cosine + sine * along).abs() + z * (sine - cosine * along)
    return torch.stack([aside.max(), above.max(), below.max()]).max()


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
    "On the ground" means that the lowest vertex is at z = 0 before `pose.z` is added, whatever the rotation."""
    vertices = description.object.mesh.vertices.astype(np.float64)
    pose = {parameter.name: description.number(f"pose.{parameter.name}") for parameter in POSE}
    return _posed(vertices, 0.0, pose)


def moved_part(part: MeshPart, values: Mapping[str, float | None]) -> MeshPart:
    """Return a mesh around the object, as it came, as the settings have it: posed about its own middle, where it
    stands, by those that are called `pose:NAME.yaw` and so on."""
    pose = {own.name: value for own in POSE if (value := values.get(f"pose:{part.name}.{own.name}")) is not None}
    if pose:
        places, pose = standing(part), {**{own.name: float(own.default) for own in POSE}, **pose}
        part = replace(part, to_world=_posed(places, float(places[:, 2].min()), pose) @ part.to_world)
    return replace(part, material=part.material.with_values(values, f"material:{part.name}."))


def standing(part: MeshPart) -> Doubles:
    """Return where the vertices (V, 3) of a mesh are in its base pose."""
    return np.asarray(part.mesh.vertices.astype(np.float64) @ part.to_world[:3, :3].T + part.to_world[:3, 3])


def _posed(places: Doubles, floor: float, pose: Mapping[str, float]) -> Doubles:
    """Scale and rotate places (V, 3) about the middle of their bounding box by parameters of `settings.POSE`, put the
    lowest at `floor`, and shift; returns (4, 4)."""
    middle = (places.min(axis=0) + places.max(axis=0)) / 2.0
    linear = pose["scale"] * rotation(pose["yaw"], pose["pitch"], pose["roll"])
    lowest = float(((places - middle) @ linear.T)[:, 2].min())
    place = np.array([pose["x"], pose["y"], floor + pose["z"] - lowest]) - linear @ middle
    place[:2] += middle[:2]
    return pose_of(linear, place)


def camera_to_world(description: SceneDescription, aspect: float | None = None) -> Doubles:
    """Return the pose of the camera in use, for a picture of an aspect (width over height; None for the description's):
    by default on an orbit around the middle of the object, looking at it. The camera looks along its own +z with +y up
    and +x to the left, as Mitsuba's sensors do. It frames the object in its default pose, so that a shifted or scaled
    object moves in the picture."""
    if description.camera != ORBIT_CAMERA:
        return description.cameras[description.camera].to_world
    aspect = description.aspect if aspect is None else aspect
    number = description.number
    if (asked := description.values["camera.distance"]) is not None:
        distance = asked / description.metres
    else:
        distance = float(framing_distance(description, torch.tensor(number("camera.fov"), dtype=torch.float64), aspect))
    elevation, height = number("camera.elevation"), description.values.get("camera.height")
    if height is not None:
        above = (height / description.metres - float(middle(description)[2])) / distance
        elevation = math.degrees(math.asin(min(max(above, -STEEPEST), STEEPEST)))
    azimuth = description.azimuth_zero + number("camera.azimuth")
    axes = camera_axes(azimuth, elevation, number("camera.roll"))
    return pose_of(np.stack([axes[0], axes[1], -axes[2]], axis=1), middle(description) + distance * axes[2])


def projected(
    description: SceneDescription, inputs: Mapping[str, Tensor], points: Tensor, size: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """Return where points (N, 3) float64 in the camera's coordinates are seen by scene inputs, (N, 2) pixels to the
    right and down from the middle of a picture of a size (height, width), and which are before the camera, (N,) bool.
    """
    sides = torch.tensor(size[::-1], dtype=torch.float64)
    points = points * torch.tensor([-1.0, -1.0, 1.0]).to(points)  # to the right, down and ahead
    if (model := description.camera_model) is not None:
        model = model.with_numbers(inputs["camera.lens"].detach()) if "camera.lens" in inputs else model
        places, seen = model.project(points)
        return (places - 0.5) * sides, seen
    fov = inputs.get("camera.fov", torch.tensor(description.number("camera.fov"))).double().reshape(())
    focal, depth = max(size) / 2.0 / torch.tan(torch.deg2rad(fov) / 2.0), points[:, 2]
    places = focal * points[:, :2] / depth.clamp_min(NEAREST)[:, None]
    for axis, name in enumerate(("camera.shift_x", "camera.shift_y")):
        if name in inputs:
            places[:, axis] -= sides[axis] * inputs[name].double().reshape(())
    return places, depth > NEAREST


def seated(carrier: Tensor, seat: Tensor) -> Tensor:
    """Return the rigid pose (4, 4) of what sits at a seat (4, 4) on a carrier (4, 4), which may be scaled."""
    scale = torch.linalg.det(carrier[:3, :3]).abs() ** (1.0 / 3.0)
    return affine(carrier[:3, :3] / scale @ seat[:3, :3], carrier[:3, :3] @ seat[:3, 3] + carrier[:3, 3])


def driving(camera: Tensor) -> Tensor:
    """Return the pose (4, 4) of a car that a camera with the pose (4, 4) looks ahead from: level, with its +x ahead,
    on the ground below the camera; differentiable."""
    ahead = camera[:2, 2] / camera[:2, 2].norm().clamp_min(1e-6)
    none, along = torch.zeros_like(ahead[0]), torch.ones_like(ahead[0])
    axes = torch.stack([ahead[0], -ahead[1], none, ahead[1], ahead[0], none, none, none, along]).reshape(3, 3)
    return affine(axes, torch.cat([camera[:2, 3], none[None]]))


@lru_cache(maxsize=4)
def real_harmonics(height: int, width: int) -> Tensor:
    """Return the nine real spherical harmonics of degrees 0 to 2 over a map of equal angles: (height, width, 9). Each
    has root mean square 1 over the sphere (Ramamoorthi and Hanrahan 2001, section 3)."""
    theta = (torch.arange(height) + 0.5) * math.pi / height
    phi = (torch.arange(width) + 0.5) * 2.0 * math.pi / width
    x = theta.sin()[:, None] * phi.cos()[None]
    y = theta.sin()[:, None] * phi.sin()[None]
    z = theta.cos()[:, None].expand(height, width)
    root3, root15, root5 = math.sqrt(3.0), math.sqrt(15.0), math.sqrt(5.0)
    first = [torch.ones_like(z), root3 * y, root3 * z, root3 * x]
    second = [root15 * x * y, root15 * y * z, root5 / 2.0 * (3.0 * z * z - 1.0), root15 * x * z]
    return torch.stack([*first, *second, root15 / 2.0 * (x * x - y * y)], dim=-1)
