"""New texture coordinates, made with xatlas."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import xatlas
from scipy.sparse import coo_array

from advsearch.scene.assets import Doubles, Ints
from advsearch.scene.importing.geometry import Soup, connected, neighbours, unit_vectors

ATLAS_SIZE = 512
ATLAS_PADDING = 4
"""Charts are kept so many texels apart in an atlas of about `ATLAS_SIZE`: two texels in a texture of half that size."""

_SCALE = 100.0  # xatlas takes faces under about 1e-7 square units for empty
_FLUSH = 1.0 - 1.5e-4  # xatlas takes neighbours whose normals have a product over 1 - 1e-4 for one plane
_PLANE = np.cos(np.radians(10.0))  # how far the normals of what it takes for a plane may stray before it matters
_MANY = 20_000  # faces that xatlas gets at a time, about; its time grows faster than their number
_LARGE = 200_000  # faces of a mesh from which on that is felt
_PIECE = 1_500  # faces that xatlas then gets at a time, at most
_MOST_PATCHES = 10_000  # more are no surface but a heap of faces, and xatlas would take minutes over them
_SMOOTHING = 10  # rounds of averaging normals, so that noise does not fray the borders of patches


def unwrapped(soup: Soup, apart: Ints | None = None) -> Soup:
    """Return the soup with UVs from xatlas: charts that do not overlap, inside the unit square; deterministic.

    The faces of a mesh in very many pieces become triangles of one size, side by side in a grid.

    Args:
        soup: the mesh.
        apart: (F,) numbers; faces with different ones get charts of their own.
    """
    patch = _patches(soup)
    if apart is not None:
        patch = np.unique(patch * (int(apart.max()) + 1) + apart, return_inverse=True)[1].reshape(-1)
    if int(patch.max()) >= _MOST_PATCHES:
        return replace(soup, uvs=_side_by_side(len(soup.faces)))
    groups = np.split(np.argsort(patch, kind="stable"), np.cumsum(np.bincount(patch))[:-1])
    for size in (ATLAS_SIZE, 0):  # 0: one atlas, however large
        atlas = xatlas.Atlas()
        for group in groups:
            used, corners = np.unique(soup.faces[group], return_inverse=True)
            atlas.add_mesh((soup.points[used] * _SCALE).astype(np.float32), corners.reshape(-1, 3).astype(np.uint32))
        options = xatlas.PackOptions()
        options.resolution, options.padding = size, ATLAS_PADDING
        atlas.generate(xatlas.ChartOptions(), options)
        if atlas.atlas_count == 1:
            break
    result = np.empty((len(soup.faces), 3, 2))
    for number, group in enumerate(groups):
        _, corners, uvs = atlas[number]
        result[group] = np.asarray(uvs, dtype=np.float64)[np.asarray(corners)]
    # lookups repeat at the border, where xatlas keeps nothing apart
    margin = 0.5 * ATLAS_PADDING / ATLAS_SIZE
    return replace(soup, uvs=margin + (1.0 - 2.0 * margin) * np.clip(result, 0.0, 1.0))


def _side_by_side(count: int) -> Doubles:
    """Return UVs (F, 3, 2) of so many faces, two to each cell of a grid."""
    columns = int(np.ceil(np.sqrt(np.ceil(count / 2))))
    cell = np.arange(count) // 2
    corner = np.stack([cell % columns, cell // columns], axis=1)[:, None, :]
    half = np.array([[0.05, 0.05], [0.85, 0.05], [0.05, 0.85]])
    inside = np.where((np.arange(count) % 2 == 0)[:, None, None], half, 1.0 - half)
    uvs: Doubles = (corner + inside) / columns
    return uvs


def _patches(soup: Soup) -> Ints:
    """Cut a mesh that xatlas cannot unwrap well in one piece; return the patch of each face (F,), numbered from 0.

    xatlas 0.0.11 takes neighbouring faces that hardly bend for one plane. On a finely tessellated smooth surface that
    goes on from face to face around the whole object, which is then flattened like a sheet of paper; where a closed
    surface leaves no border, the process crashes. Such meshes, and large ones for the sake of speed, are cut where the
    surface turns from one of 14 directions to another.
    """
    unit: Doubles = unit_vectors(soup.face_vectors())
    left, right, _ = neighbours(soup.faces)
    f, g = left // 3, right // 3
    flush = (unit[f] * unit[g]).sum(axis=1) > _FLUSH
    plane = connected(len(unit), f[flush], g[flush])
    mean: Doubles = np.stack([np.bincount(plane, unit[:, k]) for k in range(3)], axis=1)
    straight = (unit * unit_vectors(mean)[plane]).sum(axis=1) > _PLANE
    if straight.all() and len(unit) <= _MANY:
        return np.zeros(len(unit), dtype=np.int64)
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    corners = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(-1, 3) / np.sqrt(3.0)
    facing = _smoothed(unit, f, g) @ np.concatenate([axes, corners]).T
    direction = facing.argmax(axis=1)
    same = direction[f] == direction[g]
    patch = connected(len(unit), f[same], g[same])
    if len(unit) <= _LARGE:
        return patch
    cell = _cells(soup.points[soup.faces].mean(axis=1), patch)
    near = same & (cell[f] == cell[g])
    return connected(len(unit), f[near], g[near])


def _cells(middles: Doubles, patch: Ints) -> Ints:
    """Halve patches until they are small; return the cell (F,) of each face.

    Args:
        middles: (F, 3) of faces.
        patch: (F,) of each face.
    """
    cell, count = np.zeros(len(patch), dtype=np.int64), 0
    left = np.split(np.argsort(patch, kind="stable"), np.cumsum(np.bincount(patch))[:-1])
    while left:
        group = left.pop()
        if len(group) > _PIECE:
            axis = np.ptp(middles[group], axis=0).argmax()
            order = group[np.argsort(middles[group, axis], kind="stable")]
            left += [order[: len(order) // 2], order[len(order) // 2 :]]
        else:
            cell[group], count = count, count + 1
    return cell


def _smoothed(unit: Doubles, f: Ints, g: Ints) -> Doubles:
    """Average the normals (F, 3) of faces with their neighbours', a few times."""
    count = len(unit)
    links = np.concatenate([f, g, np.arange(count)]), np.concatenate([g, f, np.arange(count)])
    average = coo_array((np.ones(len(links[0])), links), shape=(count, count)).tocsr()
    for _ in range(_SMOOTHING):
        unit = np.nan_to_num(unit_vectors(average @ unit))
    return unit
