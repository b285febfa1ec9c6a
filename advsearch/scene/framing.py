"""Framing: how far from the object the camera stands where nobody says so.

The distance depends on the object, the field of view and the shape of the picture alone, never on where the camera is
moved to: a configuration is one picture, whether its azimuth is a setting, a fixed value or a point of a grid. It is
the smallest distance at which

- from the default direction the object reaches at most `FRAME_FILL` of the way to the edge of the picture,
- from every azimuth at the default elevation all of it is in the picture, so that no search turns the end of a long
  object out of it, and
- the camera stays outside the sphere around the object.

A vertex at offset `o` from the middle projects at `(o.left, o.up) / (distance - o.outwards)`, so that each vertex asks
for `distance >= o.outwards + max(|o.left| / tx, |o.up| / ty)`, where tx and ty are the tangents of half the picture.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from advsearch.scene.description import FRAME_FILL, SceneDescription
from advsearch.scene.settings import SETTINGS

Doubles = npt.NDArray[np.float64]

CLEARANCE = 0.02
"""Smallest distance, in object sizes, to the sphere around the object."""
DEFAULT_VIEW = ("camera.azimuth", "camera.elevation", "camera.roll")


def framing_distance(description: SceneDescription, fov: Tensor, aspect: float) -> Tensor:
    """Return the distance of the camera to the object's middle, () float64 in object sizes; differentiable in fov.

    Args:
        description: the scene; only its object matters.
        fov: () field of view along the larger side of the picture, degrees.
        aspect: width over height of the picture.
    """
    offsets = torch.from_numpy(description.object.mesh.vertices.astype(np.float64) - middle(description))
    azimuth, elevation, roll = (float(SETTINGS[name].default or 0.0) for name in DEFAULT_VIEW)
    offsets = offsets.to(fov.device)
    edge = _edge(description, fov, aspect)
    fits = _from_one_side(offsets, camera_axes(azimuth, elevation, roll), edge * FRAME_FILL)
    whole = _from_all_around(offsets, elevation, edge)
    return torch.maximum(fits, whole).clamp_min(float(offsets.norm(dim=1).max()) + CLEARANCE)


def filling_distance(description: SceneDescription) -> float:
    """Return the distance at which the object just fits into a square picture from where this scene's camera looks."""
    offsets = torch.from_numpy(description.object.mesh.vertices.astype(np.float64) - middle(description))
    edge = _edge(description, torch.tensor(description.number("camera.fov"), dtype=torch.float64), 1.0)
    axes = camera_axes(*(description.number(name) for name in DEFAULT_VIEW))
    return float(_from_one_side(offsets, axes, edge * FRAME_FILL))


def camera_axes(azimuth: float, elevation: float, roll: float) -> Doubles:
    """Return the unit vectors to the left and upwards in the picture and from the object to the camera: rows, (3, 3).

    Args:
        azimuth: direction of the camera around the object, degrees.
        elevation: its height above the ground plane, degrees.
        roll: rotation of the picture, counter-clockwise, degrees.
    """
    azimuth, elevation, roll = math.radians(azimuth), math.radians(elevation), math.radians(roll)
    outwards = np.array(
        [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)]
    )
    left = np.array([math.sin(azimuth), -math.cos(azimuth), 0.0])
    up = np.cross(-outwards, left)
    left, up = math.cos(roll) * left + math.sin(roll) * up, math.cos(roll) * up - math.sin(roll) * left
    return np.stack([left, up, outwards])


def middle(description: SceneDescription) -> Doubles:
    """Return what the camera looks at: the middle (3,) of the object's bounding box in its default pose."""
    vertices = description.object.mesh.vertices.astype(np.float64)
    return np.asarray((vertices.min(axis=0) + vertices.max(axis=0)) / 2.0)


def _edge(description: SceneDescription, fov: Tensor, aspect: float) -> Tensor:
    """Tangents of half the picture's width and height, (2,); of a lens, those of what it shows of a rectangle."""
    model = description.camera_model
    if model is not None and model.name:
        return torch.tensor(model.tangents, dtype=torch.float64, device=fov.device)
    return _tangents(fov, aspect)


def _tangents(fov: Tensor, aspect: float) -> Tensor:
    """Tangents of half the picture's width and height, (2,)."""
    shape = torch.tensor([min(1.0, aspect), min(1.0, 1.0 / aspect)], dtype=torch.float64, device=fov.device)
    return torch.tan(torch.deg2rad(fov.double()) / 2.0) * shape


def _from_one_side(offsets: Tensor, axes: Doubles, tangents: Tensor) -> Tensor:
    """The distance at which every vertex projects inside the tangents, from one direction."""
    left, up, outwards = offsets.matmul(torch.from_numpy(axes).T.to(offsets)).unbind(dim=1)
    return (outwards + torch.maximum(left.abs() / tangents[0], up.abs() / tangents[1])).max()


def _from_all_around(offsets: Tensor, elevation: float, tangents: Tensor) -> Tensor:
    """The distance at which every vertex projects inside the tangents, from every azimuth at one elevation.

    Seen from all around, a vertex runs through a circle of radius rho at height z: what it asks for is a sine of the
    azimuth plus a constant for each edge of the picture, whose largest value is known in closed form.
    """
    rho, z = offsets[:, :2].norm(dim=1), offsets[:, 2]
    cosine, sine = math.cos(math.radians(elevation)), math.sin(math.radians(elevation))
    across, along = 1.0 / tangents[0], 1.0 / tangents[1]
    aside = rho * torch.sqrt(across**2 + cosine**2) + z * sine
    above = rho * (cosine - sine * along).abs() + z * (sine + cosine * along)
    below = rho * (cosine + sine * along).abs() + z * (sine - cosine * along)
    return torch.stack([aside.max(), above.max(), below.max()]).max()
