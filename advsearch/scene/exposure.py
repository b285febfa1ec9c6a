"""Exposure: an incident-light meter held where the camera sees the object.

A grey card is laid against every piece of the object's surface that the camera sees, and the light that arrives there
is averaged over the picture: from the environment as far as the surface faces it, and from the ground plane, which is
lit by the environment itself, from lamps, and from surroundings that emit light. What the object is made of takes no
part, so that a black object stays black; nor do shadows, which would need a render.

The meter is held with camera, pose and rotation of the environment as they are by default, and then left alone. So a
configuration has the same exposure whether its camera is a setting, a control's fixed value or a point of a grid.

    E(n) = integral over directions w of L(w) max(n . w, 0),    L(w) = albedo / pi E(up) where w ends on the ground
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from advsearch.scene.assets import Doubles, EnvironmentAsset, Floats, Ints
from advsearch.scene.color import srgb_to_linear
from advsearch.scene.geometry import NEAREST, camera_to_world, object_to_world, standing
from advsearch.scene.grounds import paved
from advsearch.scene.parts import MeshPart
from advsearch.scene.raster import doubled_normals, looked_up, pixels_in
from advsearch.scene.settings import ORBIT_CAMERA, resolve
from advsearch.scene.silhouettes import Frame

if TYPE_CHECKING:
    from advsearch.scene.description import SceneDescription

RASTER = 32
"""Pixels along the longer side of the picture in which the surface is looked at."""
ROWS = 32
"""Rows to which an environment is summed up: irradiance varies slowly."""


WHITE = 0.8
"""Reflectance of the card that is metered."""
METERED_WHITE = 0.5
"""Linear display value that it gets, on average over what the camera sees of the object."""


_NINTHS = [(a, b) for a in range(4) for b in range(4 - a)]
WITHIN = np.array([(3 * a + 1, 3 * b + 1, 10 - 3 * a - 3 * b) for a, b in _NINTHS]) / 12.0
"""Barycentric weights (10, 3) of the places of a face at which its radiance is looked up."""

MOVED = ("camera.", "pose.", "environment.")
"""Settings whose defaults are metered, by the beginning of their names: those that controls move."""


@lru_cache(maxsize=8)
def metered_gain(scene: SceneDescription) -> float:
    """Return the factor on radiance with which the metered white card gets `METERED_WHITE`.

    Where the camera sees nothing of the object, the card lies on the ground; where no light arrives the factor is 1.
    """
    default = {name: value for name, value in resolve({}).items() if name.startswith(MOVED)}
    scene = replace(scene, values={**scene.values, **default}, aspect=1.0, camera=ORBIT_CAMERA, camera_model=None)
    seen = visible_irradiance(scene)
    metered = float(irradiance(scene, np.array([[0.0, 0.0, 1.0]])).mean()) if seen is None else seen
    return METERED_WHITE * math.pi / (WHITE * metered) if metered > 0.0 else 1.0


def visible_irradiance(scene: SceneDescription) -> float | None:
    """Return the mean irradiance (mean channel) on what the camera sees of the object; None if it sees nothing."""
    normals = visible_normals(scene)
    return float(irradiance(scene, normals).mean()) if len(normals) else None


def irradiance(scene: SceneDescription, normals: Doubles) -> Doubles:
    """Return the irradiance (N, 3) on unshadowed surfaces at the middle of the object, with normals (N, 3)."""
    directions, solid, power = arriving(scene)
    upper = directions[:, 2] > 0.0
    on_ground = (power[upper] * directions[upper, 2:]).sum(axis=0)
    bounced = srgb_to_linear(np.array(scene.ground_color, np.float32)) * on_ground / math.pi
    vertices = scene.base_vertices
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2.0
    reach = np.abs(middle[:2] + directions[:, :2] * (middle[2] / np.maximum(-directions[:, 2:], 1e-9)))
    on_table = scene.photograph is None and not paved(scene)  # else the map itself says what comes from below
    hits = on_table & ~upper & (reach <= scene.number("ground.size") / 2.0).all(axis=1)
    power = np.where(hits[:, None], bounced * solid[:, None], power)
    facing = np.maximum(np.einsum("nk,wk->nw", normals, directions), 0.0)
    irradiances = np.asarray(np.einsum("nw,wc->nc", facing, power))  # no BLAS, whose last bits depend on its threads
    for lamp in scene.lamps.values():
        way, faced = lamp.lighting(middle)
        if faced.any():  # the lamps of controls are dark as they come
            length = max(float(np.linalg.norm(way)), 1e-12)
            irradiances = irradiances + np.maximum(normals @ (way / length), 0.0)[:, None] * faced
    for part in (scene.meshes[name] for name in scene.around):  # what the object emits belongs to what it is made of
        if part.emission is not None:
            ways, faced = _emitted(part, part.emission, middle)
            facing = np.maximum(np.einsum("nk,fk->nf", normals, ways), 0.0)
            irradiances = irradiances + np.einsum("nf,fc->nc", facing, faced)
    return irradiances


def arriving(scene: SceneDescription) -> tuple[Doubles, Doubles, Doubles]:
    """Return unit directions (N, 3) from which the environment lights the scene, their solid angles (N,), and radiance
    times these (N, 3)."""
    directions, solid, power = _arriving(scene.environment)
    turn = math.radians(scene.number("environment.rotation"))
    cosine, sine = math.cos(turn), math.sin(turn)
    return directions @ np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]]), solid, power


def _emitted(part: MeshPart, emission: Floats, place: Doubles) -> tuple[Doubles, Doubles]:
    """Return unit ways (F, 3) from a place (3,) to the faces of a mesh, and the irradiance (F, 3) where each is faced.

    A face is taken for a disk of its mean radiance.
    """
    corners = standing(part)[part.mesh.faces]
    area = doubled_normals(corners) / 2.0
    way = corners.mean(axis=1) - place
    far = (way * way).sum(axis=1)
    way = way / np.maximum(np.sqrt(far), 1e-12)[:, None]
    uv = np.einsum("pk,fkc->fpc", WITHIN, part.mesh.uvs[part.mesh.faces])
    height, width = emission.shape[:2]
    mean = looked_up(emission, uv[..., 0] * width - 0.5, (1.0 - uv[..., 1]) * height - 0.5).mean(axis=1)
    front = np.maximum(-(area * way).sum(axis=1), 0.0)
    return way, mean * (front / (far + np.linalg.norm(area, axis=1) / math.pi))[:, None]


def visible_normals(scene: SceneDescription) -> Doubles:
    """Return the unit normals (N, 3) of the object's surface in the pixels of a small picture, towards the camera."""
    camera = camera_to_world(scene)
    points = (scene.base_vertices - camera[:3, 3]) @ camera[:3, :3]
    faces = scene.object.mesh.faces.astype(np.int64)
    faces = faces[(points[faces][..., 2] > NEAREST).all(axis=1)]
    frame = Frame.of(scene.number("camera.fov"), scene.aspect)
    pixel = max(frame.right - frame.left, frame.high - frame.low) / RASTER
    shape = round((frame.high - frame.low) / pixel), round((frame.right - frame.left) / pixel)
    tangents = points[faces][..., :2] / points[faces][..., 2:]
    face, row, column, weights = pixels_in((tangents - (frame.left, frame.low)) / pixel - 0.5, shape)
    nearness = (weights / points[faces[face]][..., 2]).sum(axis=1)  # 1 / depth is linear in the picture
    order = np.argsort(nearness, kind="stable")
    front = np.full(shape, -1)
    front[row[order], column[order]] = order  # the nearest comes last
    seen = front[front >= 0]
    linear = object_to_world(scene)[:3, :3]
    normals = (weights[seen, :, None] * scene.object.mesh.normals[faces[face[seen]]]).sum(axis=1) @ linear.T
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    middle = points[faces[face[seen]]].mean(axis=1) @ camera[:3, :3].T
    return np.asarray(np.where((normals * middle).sum(axis=1, keepdims=True) > 0.0, -normals, normals))


@lru_cache(maxsize=8)
def _arriving(environment: EnvironmentAsset | None) -> tuple[Doubles, Doubles, Doubles]:
    """Unit directions (N, 3) of a coarse map's texels, z up; their solid angles (N,); radiance times these (N, 3)."""
    if environment is None:
        return np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3))
    height, width = environment.radiance.shape[:2]
    rows, columns = _edges(height, ROWS), _edges(width, 2 * ROWS)
    polar = np.clip((np.arange(height + 1) - 0.5) / (height - 1), 0.0, 1.0) * math.pi  # rows 0 and -1 are the poles
    solid = -np.diff(np.cos(polar)) * (2.0 * math.pi / width)
    fine = np.concatenate([environment.radiance, np.ones((height, width, 1))], axis=2) * solid[:, None, None]
    summed = np.add.reduceat(np.add.reduceat(fine, rows, axis=0), columns, axis=1).reshape(-1, 4)
    ends_r, ends_c = np.append(rows[1:], height), np.append(columns[1:], width)
    theta = (rows + ends_r - 1) * (0.5 * math.pi / (height - 1))
    azimuth = 0.5 * math.pi - (columns + ends_c) * (math.pi / width)
    directions = np.stack(
        [
            np.sin(theta)[:, None] * np.cos(azimuth),
            np.sin(theta)[:, None] * np.sin(azimuth),
            np.broadcast_to(np.cos(theta)[:, None], (len(rows), len(columns))),
        ],
        axis=-1,
    )
    return directions.reshape(-1, 3), summed[:, 3], summed[:, :3]


def _edges(size: int, count: int) -> Ints:
    return np.unique(np.linspace(0, size, min(count, size) + 1).astype(np.int64)[:-1])
