"""Normal maps on a mesh: taking them to other texture coordinates.

In a file the bitangent runs up the picture; Mitsuba's is normal x tangent, which runs down it where texture coordinates
are mirrored.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from advsearch.scene.importing.geometry import Array, Bools, Ints, Soup, unit_vectors
from advsearch.scene.importing.normal_maps import texels_of
from advsearch.scene.raster import doubled_areas

Floats = npt.NDArray[np.float32]

FEW = 1e-3
"""Share of the surface whose texture coordinates may be mirrored without anything being done about it."""


def mirrored(soup: Soup, uvs: Array) -> Bools:
    """Return (F,) which faces have their texture mirrored; where these, or the others, are `FEW`, none or all have."""
    turned = doubled_areas(uvs) < 0.0
    area = np.linalg.norm(soup.face_vectors(), axis=1)
    share = float(area[turned].sum() / area.sum())
    return np.full(len(turned), share > 0.5) if min(share, 1.0 - share) < FEW else turned


def unmirrored(
    uvs: Array, over: Bools, color: Floats, normals: Floats, emission: Floats | None
) -> tuple[Array, tuple[Floats, Floats, Floats | None]]:
    """Return texture coordinates that mirror no face, and the maps for them; no texel is resampled.

    The maps get a second half, which is the first one mirrored, and there the faces go.

    Args:
        uvs: (F, 3, 2) in [0, 1].
        over: (F,) the mirrored faces, as `mirrored` gives them.
        color: (H, W, C).
        normals: (H', W', 3), a normal map.
        emission: (H", W", 3); None where there is none.
    """
    if not over.any():
        return uvs, (color, normals, emission)
    if over.all():
        return uvs, (color, normals * np.array([1, -1, 1], np.float32) + np.array([0, 1, 0], np.float32), emission)
    placed = uvs.copy()
    placed[over, :, 0] = 2.0 - placed[over, :, 0]
    placed[:, :, 0] /= 2.0
    other = normals[:, ::-1] * np.array([-1, 1, 1], np.float32) + np.array([1, 0, 0], np.float32)
    glow = emission if emission is None or emission.shape == (1, 1, 3) else _beside(emission, emission[:, ::-1])
    return placed, (_beside(color, color[:, ::-1]), _beside(normals, other), glow)


def _beside(left: Floats, right: Floats) -> Floats:
    return np.concatenate([left, right], axis=1)


def turned(texels: Floats, before: Soup, after: Array, face: Ints, weights: Array) -> Floats:
    """Return texels of a normal map for other texture coordinates.

    Args:
        texels: (T, 3) as they are for the coordinates of the soup.
        before: with these.
        after: (F, 3, 2) the other ones.
        face: (T,) on which each lies.
        weights: (T, 3) where on it.
    """
    normal = unit_vectors(np.einsum("tk,tkc->tc", weights, before.normals[face]))
    old, new = (_tangents(one, normal, face) for one in (before, replace(before, uvs=after)))
    up = np.cross(normal, old) * np.sign(doubled_areas(before.uvs[face]))[:, None]
    x, y, z = np.moveaxis(texels.astype(np.float64) * 2.0 - 1.0, -1, 0)
    way = x[:, None] * old + y[:, None] * up
    found = np.stack([(way * new).sum(axis=1), (way * np.cross(normal, new)).sum(axis=1), z], axis=1)
    return texels_of(np.where(np.isfinite(found).all(axis=1, keepdims=True), found, [0.0, 0.0, 1.0]))


def _tangents(soup: Soup, normal: Array, face: Ints) -> Array:
    """Unit directions (T, 3) along u in the plane across the normals (T, 3); NaN where there is none."""
    used, at = np.unique(face, return_inverse=True)
    a, b, c = (soup.points[soup.faces[used, k]] for k in range(3))
    uvs = soup.uvs[used]
    (_, v1), (_, v2) = (uvs[:, 1] - uvs[:, 0]).T, (uvs[:, 2] - uvs[:, 0]).T
    along = ((b - a) * v2[:, None] - (c - a) * v1[:, None]) * np.sign(doubled_areas(uvs))[:, None]
    along = along[at.reshape(-1)]
    return unit_vectors(along - normal * (along * normal).sum(axis=1, keepdims=True))
