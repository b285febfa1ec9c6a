"""One piece of a mesh file, as the readers of all formats hand it on: its geometry, what it looks like, its normal map.

A texel of a normal map is `(n + 1) / 2` with n the unit normal in the frame (tangent, bitangent, normal) of the
surface: the tangent runs along u, and the bitangent up the picture (glTF 2.0, section 3.9.3; others call that OpenGL's
convention).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.ndimage import distance_transform_edt

from advsearch.scene.assets import Doubles, Floats, Ints
from advsearch.scene.color import srgb_to_linear
from advsearch.scene.skeleton import Movable

FLAT = np.array([0.5, 0.5, 1.0], np.float32)
"""The texel of a normal map that changes nothing."""
LARGEST_SCALE = 100.0
"""Larger factors of x and y make no visible difference."""
LOWEST = 0.01
"""Least z of a normal before it is scaled to length 1: it points out of the surface."""
BLUE = 0.1
"""How much bluer than red a normal map is, on average; a grey map of heights is not."""
LENGTH, MOSTLY = 0.2, 0.9
"""By how much the length of a normal in a picture is off 1 at most, and of what share of the texels that is asked."""


def normal_map(picture: Floats, scale: float = 1.0) -> Floats:
    """Return a normal map (H, W, 3) with unit normals that point out of the surface.

    Args:
        picture: (H, W, 3) in [0, 1], its values as they are in the file.
        scale: factor of x and y, finite.
    """
    factor = min(max(scale, -LARGEST_SCALE), LARGEST_SCALE)
    normals = picture * 2.0 - 1.0
    normals[..., :2] *= factor
    normals[..., 2] = np.maximum(normals[..., 2], LOWEST)
    return texels_of(normals)


def holds_normals(picture: Floats) -> bool:
    """Tell whether a picture (H, W, 3) holds normals, and not heights, which are grey; black is what no face shows."""
    used = picture[picture.any(axis=2)]
    if not len(used):
        return False
    off = np.abs(np.linalg.norm(used * 2.0 - 1.0, axis=1) - 1.0)
    blue = float((used[:, 2] - used[:, 0]).mean(dtype=np.float64))
    return blue > BLUE and bool((off < LENGTH).mean() > MOSTLY)


def texels_of(normals: npt.NDArray[np.floating]) -> Floats:
    """Return normals (..., 3) of any length as texels."""
    unit = normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    return np.asarray(unit * 0.5 + 0.5, dtype=np.float32)


NEUTRAL = 0.5
"""Display-referred grey of an object without material."""


BRIGHTEST = 1e5
"""Largest radiance that a surface may emit; white in the light of a bundled environment is about 1."""


@dataclass(frozen=True, eq=False)
class ImportedSurface:
    """What a part looks like; every colour is display-referred sRGB in [0, 1].

    Attributes:
        color: (3,) float32 base colour where there is no texture; None when the file gives none. Where light passes
            through the part, (4,) with its opacity in [0, 1].
        texture: (H, W, 3) float32 base colour, row 0 on top, or (H, W, 4) with the opacity; or None.
        roughness: in [0, 1], or None when the file gives none.
        metallic: in [0, 1], or None when the file gives none.
        normal_map: (H, W, 3) float32 of this module, row 0 on top; or None.
        emission: (H, W, 3) float32 linear radiance, row 0 on top; (1, 1, 3) where it is the same everywhere, None where
            there is none.
        name: of the material in the file; empty where it has none.
    """

    color: Floats | None = None
    texture: Floats | None = None
    roughness: float | None = None
    metallic: float | None = None
    normal_map: Floats | None = None
    emission: Floats | None = None
    name: str = ""

    @property
    def pictures(self) -> tuple[Floats, ...]:
        """What is looked up by texture coordinates."""
        glow = None if self.emission is None or self.emission.shape == (1, 1, 3) else self.emission
        return tuple(one for one in (self.texture, self.normal_map, glow) if one is not None)

    @property
    def clear(self) -> bool:
        """Whether all light passes through it, everywhere."""
        color = self.color if self.texture is None else self.texture
        return color is not None and color.shape[-1] == 4 and not color[..., 3].any()

    def same_maps(self, other: ImportedSurface) -> bool:
        """Tell whether two surfaces have the same base colour, normal map and emission everywhere."""
        ours = (self.color, self.texture, self.normal_map, self.emission)
        pairs = zip(ours, (other.color, other.texture, other.normal_map, other.emission), strict=True)
        return all(a is b or (a is not None and b is not None and np.array_equal(a, b)) for a, b in pairs)


def limited_radiance(factor: Doubles, picture: Floats | None = None) -> tuple[Floats | None, str | None]:
    """Return a factor (3,) times the linear values of a picture (H, W, 3), as in `ImportedSurface`, and a warning where
    that is cut to `BRIGHTEST`."""
    cut = f"emission brighter than {BRIGHTEST:g} is cut to that" if factor.max() > BRIGHTEST else None
    linear = np.ones((1, 1, 3), np.float32) if picture is None else srgb_to_linear(picture)
    found = (linear * np.minimum(factor, BRIGHTEST)).astype(np.float32)
    return (found if found.any() else None), cut


def with_opacity(color: Floats | None, factor: Floats, cutoff: float | None) -> Floats | None:
    """Return a base colour (..., 3 or 4) with its opacity, or as (..., 3) where it is opaque.

    What is cut out of a picture gets the nearest colour that is seen.

    Args:
        color: with or without alpha; None stays None.
        factor: (1,) of alpha.
        cutoff: the alpha from which it is opaque, and under which there is nothing; None for shares in between.
    """
    if color is None:
        return None
    opacity = (color[..., 3:] if color.shape[-1] == 4 else np.ones_like(color[..., :1])) * factor
    if cutoff is not None:
        opacity = (opacity >= cutoff).astype(np.float32)
    if opacity.min() >= 1.0:
        return color[..., :3]
    unseen = opacity[..., 0] == 0.0
    plain = color[..., :3]
    if color.ndim == 3 and not unseen.all():  # lest the colour of what is cut out bleeds over its edges
        plain = plain[tuple(distance_transform_edt(unseen, return_distances=False, return_indices=True))]
    return np.concatenate([plain, opacity], axis=-1)


def unit(value: float | None) -> float | None:
    """Clip a factor to [0, 1]; None and NaN become None."""
    return None if value is None or value != value else min(max(float(value), 0.0), 1.0)


@dataclass(frozen=True, eq=False)
class ImportedPart:
    """One piece of a mesh file, with the transform of its place in the file applied.

    Attributes:
        vertices: (V, 3) float64 positions in the file's axes and units; may hold NaN.
        faces: (F, 3) int64 vertex indices, F > 0.
        normals: (V, 3) float64 of the file, not necessarily unit length or finite; None when the file gives none.
        uvs: (V, 2) float64 of the file, v = 0 at the bottom row; None when the file gives none.
        colors: (F, 3, 3) float64 linear colour of each corner in [0, 1], which multiplies the base colour in linear
            light; None when the file gives none.
        surface: the part's material.
        node: number of its node in a glTF file; -1 in others.
        flat: where the file gives no normals, its faces are flat; otherwise smooth normals are made.
        movable: of a glTF file in which something moves, the part as it is stored, with its vertices in this order.
    """

    vertices: Doubles
    faces: Ints
    normals: Doubles | None
    uvs: Doubles | None
    colors: Doubles | None
    surface: ImportedSurface
    node: int = -1
    flat: bool = False
    movable: Movable | None = None


def visible(parts: Sequence[ImportedPart]) -> list[ImportedPart]:
    """Return the parts through which not all light passes; all of them where that leaves none."""
    return [part for part in parts if not part.surface.clear] or list(parts)


def placed(part: ImportedPart, matrix: Doubles) -> ImportedPart:
    """Return a part moved to its place in the file by an affine transform (4, 4)."""
    if np.array_equal(matrix, np.eye(4)):
        return part
    turn, normals = matrix[:3, :3], part.normals
    with np.errstate(all="ignore"):
        vertices = part.vertices @ turn.T + matrix[:3, 3]
        if normals is not None:  # a normal turns with the cofactors of the matrix
            normals = normals @ np.cross(turn[[1, 2, 0]], turn[[2, 0, 1]]).T
    if not np.linalg.det(turn) < 0.0:
        return replace(part, vertices=vertices, normals=normals)
    colors = None if part.colors is None else part.colors[:, ::-1]  # a mirror turns faces over, and cofactors normals
    return replace(
        part, vertices=vertices, faces=part.faces[:, ::-1], normals=None if normals is None else -normals, colors=colors
    )


@dataclass(frozen=True, eq=False)
class Looked:
    """Values that the corners of triangles look up.

    Attributes:
        values: (N, C) float64.
        index: (F, 3) int64 rows of `values`; -1 where a corner has none.
    """

    values: Doubles
    index: Ints

    def at(self, chosen: Ints) -> Looked | None:
        """Return the values of some triangles (f,); None where these have none at all."""
        index = self.index[chosen]
        return Looked(self.values, index) if (index >= 0).any() else None


def split_at_corners(
    points: Looked,
    normals: Looked | None,
    uvs: Looked | None,
    colors: Doubles | None,
    surface: ImportedSurface,
    *,
    flat: bool = False,
) -> ImportedPart:
    """Return a part in which corners with the same point, normal and texture coordinate are one vertex.

    Args:
        points: (N, 3) positions, and one for every corner.
        normals: (N, 3), or None.
        uvs: (N, 2), or None.
        colors: as in `ImportedPart`.
        surface: of the part.
        flat: as in `ImportedPart`.
    """
    given = [one for one in (points, normals, uvs) if one is not None]
    key, most = np.zeros(points.index.size, dtype=np.int64), 1
    for one in given:
        if most * (len(one.values) + 1) >= 2**63:  # numbered anew, so that it does not overflow
            key = np.unique(key, return_inverse=True)[1].reshape(-1)
            most = len(key)
        key = key * (len(one.values) + 1) + one.index.reshape(-1) + 1
        most *= len(one.values) + 1
    _, first, faces = np.unique(key, return_index=True, return_inverse=True)

    def rows(one: Looked | None) -> Doubles | None:
        if one is None:
            return None
        index = one.index.reshape(-1)[first]
        return np.where(index[:, None] >= 0, one.values[index], np.nan)

    vertices = points.values[points.index.reshape(-1)[first]]
    return ImportedPart(vertices, faces.reshape(-1, 3), rows(normals), rows(uvs), colors, surface, flat=flat)
