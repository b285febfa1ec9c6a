"""Cutting patches along curves: what is carved out of a smooth surface becomes a part with an edge of its own.

A curve is where a function of the surface's points is zero. Triangles that it crosses are split there, so that the edge
is as smooth as the function and not as coarse as the grid.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from .curves import Array
from .shapes import Indices, Patch

Bools = npt.NDArray[np.bool_]

Field = Callable[[Array], Array]
"""(N, 3) points to (N,) values, positive inside; about the distance to the edge."""

SNAP = 0.1  # share of an edge within which a cut goes through the edge's end: thinner slivers are not worth a triangle


def carved(patches: Iterable[Patch], inside: Field, tag: str | None) -> list[Patch]:
    """Return patches with what lies inside as patches of their own.

    Args:
        patches: smooth surfaces, before they are placed.
        inside: where to carve.
        tag: what is carved out becomes this; None leaves it out.
    """
    found = []
    for patch in patches:
        value = _snapped(patch, inside(patch.vertices))
        if value.max() <= 0.0:
            found.append(patch)
            continue
        cut, side = _split(patch, value)
        found += [cropped(replace(cut, faces=cut.faces[~side]))] if not side.all() else []
        found += [cropped(replace(cut, faces=cut.faces[side], tag=tag))] if tag is not None and side.any() else []
    return found


def cropped(patch: Patch) -> Patch:
    """Return the patch with a chart that is as large as what its faces use of it."""
    used = patch.uvs[np.unique(patch.faces)]
    low, span = used.min(axis=0), np.ptp(used, axis=0)
    size = (patch.size[0] * float(span[0]), patch.size[1] * float(span[1]))
    uvs = np.clip((patch.uvs - low) / span, 0.0, 1.0)
    return replace(patch, uvs=uvs, size=size, rest=lambda u, v: patch.rest(low[0] + u * span[0], low[1] + v * span[1]))


def _edges(patch: Patch) -> Indices:
    """The (E, 2) edges of a patch."""
    pairs = np.concatenate([patch.faces[:, [0, 1]], patch.faces[:, [1, 2]], patch.faces[:, [2, 0]]])
    edges: Indices = np.unique(np.sort(pairs, axis=1), axis=0).astype(np.int64)
    return edges


def _snapped(patch: Patch, value: Array) -> Array:
    """The values with 0 at vertices that the curve passes closely."""
    edges = _edges(patch)
    ends = value[edges]
    crossed = ends[:, 0] * ends[:, 1] < 0.0
    share = np.abs(ends[crossed]) / np.abs(ends[crossed]).sum(axis=1, keepdims=True)
    value = value.copy()
    value[edges[crossed][share < SNAP]] = 0.0
    return value


def _split(patch: Patch, value: Array) -> tuple[Patch, Bools]:
    """The patch with its triangles split where the values change sign, and (F,) whether each face is inside."""
    edges = _edges(patch)
    crossed = edges[value[edges[:, 0]] * value[edges[:, 1]] < 0.0]
    a, b = crossed.T
    share = (value[a] / (value[a] - value[b]))[:, None]
    extra = [one[a] + share * (one[b] - one[a]) for one in (patch.vertices, patch.normals, patch.uvs)]
    extra[1] /= np.linalg.norm(extra[1], axis=1, keepdims=True)
    number = {(int(i), int(j)): len(patch.vertices) + k for k, (i, j) in enumerate(crossed)}
    faces: list[tuple[int, int, int]] = []
    side: list[bool] = []
    for face in patch.faces:
        here = value[face]
        if here.min() >= 0.0 or here.max() <= 0.0:
            faces.append(tuple(int(i) for i in face))  # type: ignore[arg-type]
            side.append(bool(here.sum() > 0.0))
            continue
        around: list[tuple[int, float]] = []  # the outline with the cuts in it
        for i in range(3):
            one, other = int(face[i]), int(face[(i + 1) % 3])
            around.append((one, float(value[one])))
            cut = number.get((min(one, other), max(one, other)))
            if cut is not None:
                around.append((cut, 0.0))
        for sign in (1.0, -1.0):
            part = [index for index, at in around if at * sign >= 0.0]
            for k in range(1, len(part) - 1):
                faces.append((part[0], part[k], part[k + 1]))
                side.append(sign > 0.0)
    before = (patch.vertices, patch.normals, patch.uvs)
    places, normals, uvs = (np.concatenate([one, more]) for one, more in zip(before, extra, strict=True))
    return replace(patch, vertices=places, normals=normals, uvs=uvs, faces=np.array(faces)), np.array(side)
