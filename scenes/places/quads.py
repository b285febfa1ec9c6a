"""Meshes of many flat quadrilaterals, collected by the thousand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from advsearch.scene.assets import BoolArray, Float64Array, Mesh

FRONT = "front"
SIDES = "sides"
TOP = "top"
BOTTOM = "bottom"
# faces of a box that stands at a wall: all but its back
SHOWN = (FRONT, SIDES, TOP, BOTTOM)
# cosine between a surface that snow stays on and the level, at the least: 70 degrees
SLOPE = 0.35


@dataclass(frozen=True)
class Wall:
    """A wall's own coordinates: along it, out of it, and up, in metres from its origin
    (3,); `out` (3,) is the level unit vector that it faces.
    """

    origin: tuple[float, float, float]
    out: tuple[float, float, float]

    def world(
        self, along: Float64Array, out: Float64Array, up: Float64Array
    ) -> Float64Array:
        """Return places (..., 3) from coordinates of the wall; seen from outside,
        `along` runs to the right.
        """
        away = np.array(self.out)
        right = np.array([-away[1], away[0], 0.0])
        along, out, up = np.broadcast_arrays(along, out, up)
        return np.asarray(
            np.array(self.origin)
            + along[..., None] * right
            + out[..., None] * away
            + up[..., None] * [0.0, 0.0, 1.0]
        )


@dataclass(eq=False)
class Quads:
    """Quadrilaterals, counter-clockwise seen from outside, with texture coordinates."""

    corners: list[Float64Array] = field(default_factory=list)
    uvs: list[Float64Array] = field(default_factory=list)
    normals: list[Float64Array] = field(default_factory=list)

    def add(
        self,
        corners: Float64Array,
        uvs: Float64Array,
        normals: Float64Array | None = None,
    ) -> None:
        """Add (N, 4, 3) corners with (N, 4, 2) texture coordinates and, unless they are
        flat, (N, 4, 3) normals.
        """
        self.corners.append(corners)
        self.uvs.append(np.broadcast_to(uvs, (*corners.shape[:2], 2)))
        self.normals.append(np.zeros_like(corners) if normals is None else normals)

    def at(
        self,
        frame: Wall,
        along: Float64Array,
        out: Float64Array,
        up: Float64Array,
        uvs: Float64Array,
        turn: int = 1,
    ) -> None:
        """Add quadrilaterals by a wall's coordinates (N, 4), in the other order where
        `turn` is -1; (N, 4, 2) uvs.
        """
        self.add(frame.world(along, out, up)[:, ::turn], uvs[:, ::turn])

    def level(
        self,
        x: tuple[float, float],
        y: tuple[float, float],
        z: float,
        uvs: Float64Array,
        up: int = 1,
    ) -> None:
        """Add a level rectangle, which faces up, or down where `up` is -1; texture
        coordinates (4, 2) of its corners, counter-clockwise from the least x and y.
        """
        corners = np.array(
            [[(x[0], y[0], z), (x[1], y[0], z), (x[1], y[1], z), (x[0], y[1], z)]]
        )
        self.add(corners[:, ::up], uvs[None, ::up])

    def wall(
        self,
        frame: Wall,
        rows: Float64Array,
        out: Float64Array | float,
        uvs: Float64Array,
    ) -> None:
        """Add upright rectangles (N, 4) at a wall: left, right, low and high, so far
        out of it (N,), with texture coordinates (N, 4) of the same order.
        """
        along, up = np.moveaxis(_around(rows), -1, 0)
        self.at(frame, along, np.reshape(out, (-1, 1)), up, _around(uvs))

    def boxes(
        self,
        frame: Wall,
        rows: Float64Array,
        uvs: Float64Array,
        faces: Sequence[str] = SHOWN,
    ) -> None:
        """Add boxes (N, 6) at a wall: left, right, back, front, low, high, with texture
        coordinates (N, 4) as of `wall` for the front, of which the other faces show a
        part; only some faces are there.
        """
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
        """Return those that do not face up, and add the others, which snow lies on, to
        `fallen`.
        """
        bare = Quads()
        for corners, uvs, normals in zip(
            self.corners, self.uvs, self.normals, strict=True
        ):
            across = np.cross(
                corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]
            )
            shaded: BoolArray = np.asarray(normals.any(axis=(1, 2)))
            faced = np.where(shaded[:, None], normals.mean(axis=1), across)
            lies = faced[:, 2] > SLOPE * np.linalg.norm(faced, axis=1)
            bare.add(corners[~lies], uvs[~lies], normals[~lies])
            fallen.add(corners[lies], uvs[lies], normals[lies])
        return bare

    def mesh(self) -> Mesh:
        """Return all of them as one mesh."""
        corners, uvs, normals = (
            np.concatenate(part) for part in (self.corners, self.uvs, self.normals)
        )
        across = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
        across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
        normals = np.where(
            (np.abs(normals).sum(axis=(1, 2)) > 0.0)[:, None, None],
            normals,
            across[:, None],
        )
        first = 4 * np.arange(len(corners))[:, None]
        return Mesh(
            corners.reshape(-1, 3).astype(np.float32),
            np.concatenate(
                [first + np.array(three) for three in ((0, 1, 2), (0, 2, 3))]
            ).astype(np.uint32),
            normals.reshape(-1, 3).astype(np.float32),
            uvs.reshape(-1, 2).astype(np.float32),
        )


def _around(uvs: Float64Array) -> Float64Array:
    """(N, 4, 2) the corners of rectangles (N, 4) of texture coordinates: left, right,
    low, high.
    """
    left, right, low, high = np.atleast_2d(uvs).T
    return np.stack(
        [
            np.stack([left, right, right, left], axis=1),
            np.stack([low, low, high, high], axis=1),
        ],
        axis=-1,
    )
