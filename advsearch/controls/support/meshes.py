"""Meshes that controls make."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from advsearch.scene.assets import Mesh


@lru_cache(maxsize=8)
def polygon(corners: int) -> Mesh:
    """Return a regular polygon of radius 1 in the plane z = 0 that faces +z: its middle, then its corners."""
    turns = 2.0 * np.pi * np.arange(corners) / corners
    rim = np.stack([np.cos(turns), np.sin(turns), np.zeros(corners)], axis=1)
    vertices = np.concatenate([np.zeros((1, 3)), rim]).astype(np.float32)
    first = np.arange(corners)
    faces = np.stack([np.zeros(corners, np.int64), first + 1, (first + 1) % corners + 1], axis=1).astype(np.uint32)
    normals = np.tile(np.array([0.0, 0.0, 1.0], dtype=np.float32), (corners + 1, 1))
    return Mesh(vertices, faces, normals, vertices[:, :2] / 2.0 + np.float32(0.5))


def sphere(rows: int, columns: int) -> Mesh:
    """Return a sphere of diameter 1 around the origin: `rows` bands from pole to pole, 2 (rows - 1) columns faces."""
    v, u = (
        one.ravel() for one in np.meshgrid(np.linspace(0, 1, rows + 1), np.linspace(0, 1, columns + 1), indexing="ij")
    )
    theta, phi = math.pi * (1.0 - v), 2.0 * math.pi * u
    normals = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=1)
    corner = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)[None, :]).ravel()
    above = corner + columns + 1
    lower, upper = np.stack([corner, corner + 1, above + 1], 1), np.stack([corner, above + 1, above], 1)
    faces = np.concatenate([lower[columns:], upper[:-columns]])  # without those that are points at the poles
    vertices, outwards, uvs = (one.astype(np.float32) for one in (0.5 * normals, normals, np.stack([u, v], axis=1)))
    return Mesh(vertices, faces.astype(np.uint32), outwards, uvs)
