"""Meshes of many flat quadrilaterals, collected by the thousand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from advsearch.scene.assets import Bools, Doubles, Floats, Material, Mesh
from advsearch.scene.color import linear_to_srgb
from advsearch.scene.parts import MeshPart

FRONT, SIDES, TOP, BOTTOM = "front", "sides", "top", "bottom"
SHOWN = (FRONT, SIDES, TOP, BOTTOM)  # faces of a box that stands at a wall: all but its back
SLOPE = 0.35  # cosine between a surface that snow stays on and the level, at the least: 70 degrees


@dataclass(frozen=True)
class Wall:
    """A wall's own coordinates: along it, out of it, and up, in metres from its origin (3,); `out` (3,) is the level
    unit vector that it faces."""

    origin: tuple[float, float, float]
    out: tuple[float, float, float]

    def world(self, along: Doubles, out: Doubles, up: Doubles) -> Doubles:
        """Return places (..., 3) from coordinates of the wall; seen from outside, `along` runs to the right."""
        away = np.array(self.out)
        right = np.array([-away[1], away[0], 0.0])
        along, out, up = np.broadcast_arrays(along, out, up)
        return np.asarray(
            np.array(self.origin) + along[..., None] * right + out[..., None] * away + up[..., None] * [0.0, 0.0, 1.0]
        )


@dataclass(eq=False)
class Quads:
    """Quadrilaterals, counter-clockwise seen from outside, with texture coordinates."""

    corners: list[Doubles] = field(default_factory=list)
    uvs: list[Doubles] = field(default_factory=list)
    normals: list[Doubles] = field(default_factory=list)

    def add(self, corners: Doubles, uvs: Doubles, normals: Doubles | None = None) -> None:
        """Add (N, 4, 3) corners with (N, 4, 2) texture coordinates and, unless they are flat, (N, 4, 3) normals."""
        self.corners.append(corners)
        self.uvs.append(np.broadcast_to(uvs, (*corners.shape[:2], 2)))
        self.normals.append(np.zeros_like(corners) if normals is None else normals)

    def at(self, frame: Wall, along: Doubles, out: Doubles, up: Doubles, uvs: Doubles, turn: int = 1) -> None:
        """Add quadrilaterals by a wall's coordinates (N, 4), in the other order where `turn` is -1; (N, 4, 2) uvs."""
        self.add(frame.world(along, out, up)[:, ::turn], uvs[:, ::turn])

    def level(self, x: tuple[float, float], y: tuple[float, float], z: float, uvs: Doubles, up: int = 1) -> None:
        """Add a level rectangle, which faces up, or down where `up` is -1; texture coordinates (4, 2) of its corners,
        counter-clockwise from the least x and y."""
        corners = np.array([[(x[0], y[0], z), (x[1], y[0], z), (x[1], y[1], z), (x[0], y[1], z)]])
        self.add(corners[:, ::up], uvs[None, ::up])

    def wall(self, frame: Wall, rows: Doubles, out: Doubles | float, uvs: Doubles) -> None:
        """Add upright rectangles (N, 4) at a wall: left, right, low and high, so far out of it (N,), with texture
        coordinates (N, 4) of the same order."""
        along, up = np.moveaxis(_around(rows), -1, 0)
        self.at(frame, along, np.reshape(out, (-1, 1)), up, _around(uvs))

    def boxes(self, frame: Wall, rows: Doubles, uvs: Doubles, faces: Sequence[str] = SHOWN) -> None:
        """Add boxes (N, 6) at a wall: left, right, back, front, low, high, with texture coordinates (N, 4) as of `wall`
        for the front, of which the other faces show a part; only some faces are there."""
        left, right, _, front, low, high = rows.T
        shown = _around(uvs)
        if FRONT in faces:
            self.wall(frame, rows[:, [0, 1, 4, 5]], front, uvs)
        along, out = np.moveaxis(_around(rows[:, [0, 1, 3, 2]]), -1, 0)
        for face, up, turn in ((TOP, high, 1), (BOTTOM, low, -1)):
            if face in faces:
                self.at(frame, along, out, up[:, None], shown, turn)
        out, up = np.moveaxis(_around(rows[:, [3, 2, 4, 5]]), -1, 0)
        narrow = shown * [0.15, 1.0] + shown[:, :1] * [0.85, 0.0]
        for side, turn in ((left, -1), (right, 1)):
            if SIDES in faces:
                self.at(frame, side[:, None], out, up, narrow, turn)

    def swept(self, fallen: Quads) -> Quads:
        """Return those that do not face up, and add the others, which snow lies on, to `fallen`."""
        bare = Quads()
        for corners, uvs, normals in zip(self.corners, self.uvs, self.normals, strict=True):
            across = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
            shaded: Bools = np.asarray(normals.any(axis=(1, 2)))
            faced = np.where(shaded[:, None], normals.mean(axis=1), across)
            lies = faced[:, 2] > SLOPE * np.linalg.norm(faced, axis=1)
            bare.add(corners[~lies], uvs[~lies], normals[~lies])
            fallen.add(corners[lies], 0.0 * uvs[lies] + 0.5, normals[lies])
        return bare

    def mesh(self, metres: float) -> Mesh:
        """Return all of them as one mesh, in units of `metres`."""
        corners, uvs, normals = (np.concatenate(part) for part in (self.corners, self.uvs, self.normals))
        across = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
        across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
        normals = np.where((np.abs(normals).sum(axis=(1, 2)) > 0.0)[:, None, None], normals, across[:, None])
        first = 4 * np.arange(len(corners))[:, None]
        return Mesh(
            (corners.reshape(-1, 3) / metres).astype(np.float32),
            np.concatenate([first + np.array(three) for three in ((0, 1, 2), (0, 2, 3))]).astype(np.uint32),
            normals.reshape(-1, 3).astype(np.float32),
            uvs.reshape(-1, 2).astype(np.float32),
        )


def _around(uvs: Doubles) -> Doubles:
    """(N, 4, 2) the corners of rectangles (N, 4) of texture coordinates: left, right, low, high."""
    left, right, low, high = np.atleast_2d(uvs).T
    return np.stack([np.stack([left, right, right, left], axis=1), np.stack([low, low, high, high], axis=1)], axis=-1)


# ---------------------------------------------------------------------------------------------------------------------
# The road: asphalt with markings between two pavements, dry or wet.
#
# Lengths are metres. It runs along x; the object stands in the lane of those who drive towards +x, on the right. Beyond
# the pavements, and far ahead, the environment's map is seen.

ROAD = "road"  # name of the mesh: asphalt with markings between two pavements, dry or wet
FLOOR = "floor"  # name of the mesh that things stand on in a room: its floor and the top of its table
LAID = (ROAD, FLOOR)
KERBS = (-2.3, 5.8)  # where the road ends on the right and on the left
EDGES = (-10.0, 13.6)  # where the pavements end: a multiple of their slabs
EYE, FRONTS, STREET_ENDS = 1.5, (-12.0, 15.6), 170.0
"""Of the streets' maps: the height above the road that they are seen from, where the fronts of the houses stand on the
right and on the left, and how far the street goes on."""
PERIOD = 12.0  # the pattern repeats along the road
LENGTH = 120.0
TEXEL = 0.02
DRY, WET = Material(roughness=0.9, specular=0.3), Material(roughness=0.16, specular=0.5)
WETNESS = 0.45
"""How dark wet asphalt is beside dry asphalt (Jensen et al. 1999, Rendering of Wet Materials: about a half)."""


def reflectance(x: Doubles, y: Doubles, grain: Doubles | None = None) -> Doubles:
    """Return the linear reflectance (N, 3) of the ground at x along the road and y across; `grain` makes it uneven."""
    grain = np.zeros_like(x) if grain is None else grain
    wheels = np.exp(-(((np.abs(y) - 0.75) / 0.3) ** 2)) + np.exp(-(((np.abs(y - 3.5) - 0.75) / 0.3) ** 2))
    value = 0.085 * (1.0 - 0.12 * wheels) * (1.0 + grain)
    color = value[:, None] * np.array([1.0, 0.99, 0.97])
    dashed = (np.abs(y - 1.75) < 0.07) & (x % 6.0 < 3.0)
    solid = (np.abs(y - KERBS[0] - 0.45) < 0.06) | (np.abs(y - KERBS[1] + 0.45) < 0.06)
    worn = (0.55 * (1.0 + 0.5 * grain))[:, None] * np.array([1.0, 0.99, 0.95])
    color = np.where((dashed | solid)[:, None], worn, color)
    off = np.maximum(KERBS[0] - y, y - KERBS[1])
    joint = (np.minimum(x % 0.6, (y + 10.0) % 0.4) < 0.016)[:, None]
    slabs = (0.3 * (1.0 + 0.35 * grain))[:, None] * np.array([1.0, 0.97, 0.92]) * np.where(joint, 0.6, 1.0)
    kerb = (0.38 * (1.0 + 0.3 * grain))[:, None] * np.where((x % 1.0 < 0.02)[:, None], 0.6, np.ones(3))
    shade: Doubles = np.where((off > 0.0)[:, None], np.where((off > 0.16)[:, None], slabs, kerb), color)
    return np.where((np.abs(off) < 0.012)[:, None], 0.05, shade)


@lru_cache(maxsize=4)
def road(wet: bool, metres: float) -> MeshPart:
    """Return the road, dark and reflecting where it is wet; `metres` are those of one object size."""
    corners = np.array([[-1.0, EDGES[0]], [1.0, EDGES[0]], [1.0, EDGES[1]], [-1.0, EDGES[1]]])
    places = corners * np.array([LENGTH / 2, 1.0])
    uvs = np.stack([places[:, 0] / PERIOD, (places[:, 1] - EDGES[0]) / (EDGES[1] - EDGES[0])], axis=1)
    mesh = Mesh(
        np.concatenate([places, np.zeros((4, 1))], axis=1).astype(np.float32) / np.float32(metres),
        np.array([[0, 1, 2], [0, 2, 3]], np.uint32),
        np.tile(np.array([[0, 0, 1]], np.float32), (4, 1)),
        uvs.astype(np.float32),
    )
    return MeshPart(ROAD, mesh, _texture(wet), WET if wet else DRY, laid=True)


@lru_cache(maxsize=2)
def _texture(wet: bool) -> Floats:
    """One period of the road, (h, w, 3) display-referred, multiples of 1/255, row 0 on the left."""
    from scipy.ndimage import uniform_filter  # few scenes have this road

    width, height = round(PERIOD / TEXEL), round((EDGES[1] - EDGES[0]) / TEXEL)
    fine = np.random.Generator(np.random.PCG64(7)).random((height, width))
    grain = np.zeros_like(fine)
    for share, side in ((0.9, 3), (0.8, 25)):  # means over squares of texels, stretched to the spread of one texel's
        blurred = uniform_filter(fine, side, mode="wrap")
        grain += share * 0.12 * (blurred - blurred.mean()) / blurred.std()
    x, y = np.meshgrid((np.arange(width) + 0.5) * TEXEL, EDGES[1] - (np.arange(height) + 0.5) * TEXEL)
    linear = reflectance(x.ravel(), y.ravel(), grain.ravel()).reshape(height, width, 3) * (WETNESS if wet else 1.0)
    return shown(np.round(linear, 5).astype(np.float32))


def shown(linear: Floats) -> Floats:
    """Return linear values as display-referred multiples of 1/255."""
    return np.asarray(np.round(linear_to_srgb(linear) * np.float32(255.0)) / np.float32(255.0), np.float32)
