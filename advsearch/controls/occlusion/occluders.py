"""Things to put between the camera and the object: a card, a sphere, bundled objects, meshes from files."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from advsearch.files import reading
from advsearch.scene import library
from advsearch.scene.assets import Material, Mesh, ObjectAsset, normalised
from advsearch.scene.importing.objects import import_object

MADE = ("card", "sphere")


@cache
def loaded(spec: str) -> ObjectAsset:
    """Return a bundled object or one from a mesh file, its largest extent 1, centred on the origin.

    Raises:
        InputError: there is no such object, or the file cannot be used.
    """
    is_file = "/" in spec or "\\" in spec or Path(spec).suffix != ""
    with reading(spec):
        return centred(import_object(Path(spec)) if is_file else library.load_object(spec))


def centred(asset: ObjectAsset) -> ObjectAsset:
    """Return an object with its largest extent 1 and the middle of its bounding box at the origin."""
    mesh = normalised(asset.mesh)
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    return replace(asset, mesh=replace(mesh, vertices=(mesh.vertices - (low + high) / 2.0).astype(np.float32)))


@cache
def made(name: str) -> ObjectAsset:
    """Return one of the occluders made here, one object size large around the origin: "card" or "sphere"."""
    generator = np.random.Generator(np.random.PCG64(7))
    if name == "card":
        texels = np.array([0.70, 0.53, 0.36]) + generator.normal(0.0, 0.012, (64, 64, 1)) * np.ones(3)
        texels += 0.012 * np.sin(np.arange(64) * math.pi / 2.0)[:, None, None]  # the flutes under the paper
        return ObjectAsset(name, _card(), texels.clip(0.0, 1.0).astype(np.float32), Material(roughness=0.9))
    grey = np.full((4, 4, 3), 0.5, dtype=np.float32)
    return ObjectAsset(name, sphere(24, 48), grey, Material(roughness=0.6))


def _card() -> Mesh:
    """A square in the y-z plane that faces +x."""
    uvs = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)], dtype=np.float32)
    vertices = np.concatenate([np.zeros((4, 1)), uvs - 0.5], axis=1).astype(np.float32)
    normals = np.tile(np.array([1.0, 0.0, 0.0], dtype=np.float32), (4, 1))
    return Mesh(vertices, np.array([(0, 1, 2), (0, 2, 3)], dtype=np.uint32), normals, uvs)


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
    return Mesh(
        (0.5 * normals).astype(np.float32),
        faces.astype(np.uint32),
        normals.astype(np.float32),
        np.stack([u, v], axis=1).astype(np.float32),
    )
