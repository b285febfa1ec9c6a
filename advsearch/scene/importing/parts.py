"""One piece of a mesh file, as the readers of all formats hand it on: its geometry,
what it looks like, its normal map.

A texel of a normal map is `(n + 1) / 2` with n the unit normal in the frame (tangent,
bitangent, normal) of the surface: the tangent runs along u, and the bitangent up the
picture (glTF 2.0, section 3.9.3; others call that OpenGL's convention).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from advsearch.scene.assets import Bools, Doubles, Floats, Ints, grouped
from advsearch.scene.color import srgb_to_linear
from advsearch.scene.importing.files import Notes
from advsearch.scene.skeleton import Movable

# the texel of a normal map that changes nothing
FLAT = np.array([0.5, 0.5, 1.0], np.float32)
LARGEST_SCALE = 100.0  # larger factors of x and y make no visible difference
# least z of a normal before it is scaled to length 1: it points out of the surface
LOWEST = 0.01
# how much bluer than red a normal map is, on average; a grey map of heights is not
BLUE = 0.1
LENGTH = 0.2
MOSTLY = 0.9
"""By how much the length of a normal in a picture is off 1 at most, and of what share
of the texels that is asked.
"""


def normal_map(picture: Floats, scale: float = 1.0) -> Floats:
    """Return a normal map (H, W, 3) with unit normals that point out of the surface, of
    a picture (H, W, 3) in [0, 1] as it is in the file and a finite factor of x and y.
    """
    factor = min(max(scale, -LARGEST_SCALE), LARGEST_SCALE)
    normals = picture * 2.0 - 1.0
    normals[..., :2] *= factor
    normals[..., 2] = np.maximum(normals[..., 2], LOWEST)
    return texels_of(normals)


def holds_normals(picture: Floats) -> bool:
    """Tell whether a picture (H, W, 3) holds normals, and not heights, which are grey;
    black is what no face shows.
    """
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


NEUTRAL = 0.5  # display-referred grey of an object without material
# largest radiance that a surface may emit; white in the light of a bundled environment
# is about 1
BRIGHTEST = 1e5


@dataclass(frozen=True, eq=False)
class ImportedSurface:
    """What a part looks like; colours are display-referred sRGB in [0, 1], and pictures
    have row 0 on top. None is what the file does not give.
    """

    # (3,) base colour where there is no texture; (4,) with its opacity in [0, 1]
    color: Floats | None = None
    # (H, W, 3) base colour, or (H, W, 4) with the opacity
    texture: Floats | None = None
    roughness: float | None = None  # in [0, 1]
    metallic: float | None = None  # in [0, 1]
    normal_map: Floats | None = None  # (H, W, 3) of this module
    # (H, W, 3) linear radiance; (1, 1, 3) where it is the same everywhere
    emission: Floats | None = None
    name: str = ""  # of the material in the file; empty where it has none

    @property
    def pictures(self) -> tuple[Floats, ...]:
        """What is looked up by texture coordinates."""
        glow = (
            None
            if self.emission is None or self.emission.shape == (1, 1, 3)
            else self.emission
        )
        return tuple(
            picture
            for picture in (self.texture, self.normal_map, glow)
            if picture is not None
        )

    def with_pictures(self, pictures: Iterable[Floats]) -> ImportedSurface:
        """Return the surface with others in the place of its `pictures`."""
        left = iter(pictures)
        texture = None if self.texture is None else next(left)
        normals = None if self.normal_map is None else next(left)
        return replace(
            self,
            texture=texture,
            normal_map=normals,
            emission=next(left, self.emission),
        )

    @property
    def clear(self) -> bool:
        """Whether all light passes through it, everywhere."""
        color = self.color if self.texture is None else self.texture
        return color is not None and color.shape[-1] == 4 and not color[..., 3].any()

    def same_maps(self, other: ImportedSurface) -> bool:
        """Tell whether two surfaces have the same base colour, normal map and emission
        everywhere.
        """
        ours = (self.color, self.texture, self.normal_map, self.emission)
        pairs = zip(
            ours,
            (other.color, other.texture, other.normal_map, other.emission),
            strict=True,
        )
        return all(
            a is b or (a is not None and b is not None and np.array_equal(a, b))
            for a, b in pairs
        )


def limited_radiance(
    factor: Doubles, picture: Floats | None, notes: Notes
) -> Floats | None:
    """Return a factor (3,) times the linear values of a picture (H, W, 3), as in
    `ImportedSurface`; a note says where that is cut to `BRIGHTEST`.
    """
    if factor.max() > BRIGHTEST:
        notes.say(f"emission brighter than {BRIGHTEST:g} is cut to that")
    linear = (
        np.ones((1, 1, 3), np.float32) if picture is None else srgb_to_linear(picture)
    )
    radiance = (linear * np.minimum(factor, BRIGHTEST)).astype(np.float32)
    return radiance if radiance.any() else None


def instead_of_texture(color: Floats | None) -> str:
    """Return what is seen where a texture is missing, in words; plain white only leaves
    a texture alone.
    """
    if color is None or (color > 0.999).all():
        return "neutral grey"
    return f"its base colour ({', '.join(f'{channel:.2f}' for channel in color)})"


def with_opacity(
    color: Floats | None, factor: Floats, cutoff: float | None
) -> Floats | None:
    """Return a base colour (..., 3 or 4), None of None, with its alpha times a factor
    (1,) as opacity, or as (..., 3) where it is opaque. What is cut out of a picture
    gets the nearest colour that is seen. From the cutoff on it is opaque, and under it
    there is nothing; None for shares in between.
    """
    # late: the reader of USD, a process of its own, needs no scipy
    from scipy.ndimage import distance_transform_edt

    if color is None:
        return None
    opacity = (
        color[..., 3:] if color.shape[-1] == 4 else np.ones_like(color[..., :1])
    ) * factor
    if cutoff is not None:
        opacity = (opacity >= cutoff).astype(np.float32)
    if opacity.min() >= 1.0:
        return color[..., :3]
    unseen = opacity[..., 0] == 0.0
    plain = color[..., :3]
    # lest the colour of what is cut out bleeds over its edges
    if color.ndim == 3 and not unseen.all():
        plain = plain[
            tuple(
                distance_transform_edt(
                    unseen, return_distances=False, return_indices=True
                )
            )
        ]
    return np.concatenate([plain, opacity], axis=-1)


def unit(value: float | None) -> float | None:
    """Clip a factor to [0, 1]; None and NaN become None."""
    return None if value is None or value != value else min(max(float(value), 0.0), 1.0)


@dataclass(frozen=True, eq=False)
class ImportedPart:
    """One piece of a mesh file, with the transform of its place in the file applied;
    None is what the file does not give.
    """

    vertices: Doubles  # (V, 3) positions in the file's axes and units; may hold NaN
    faces: Ints  # (F, 3) vertices, F > 0
    # (V, 3) of the file, not necessarily unit length or finite
    normals: Doubles | None = None
    uvs: Doubles | None = None  # (V, 2), v = 0 at the bottom row
    # (F, 3, 3) colour of each corner in [0, 1], which multiplies the base colour in
    # linear light
    colors: Doubles | None = None
    surface: ImportedSurface = ImportedSurface()
    node: int = -1  # number of its node in a glTF file; -1 in others
    # where the file gives no normals, its faces are flat; otherwise smooth normals are
    # made
    flat: bool = False
    # where something moves, the part as it is stored, its vertices in this order
    movable: Movable | None = None


def alike(*keys: Ints | Bools) -> list[Ints]:
    """Return the faces, by number, that have all of some (F,) in common: one group for
    each combination, rising.
    """
    _, kind = np.unique(np.stack(keys, axis=1), axis=0, return_inverse=True)
    return grouped(kind.reshape(-1))


def visible(parts: Sequence[ImportedPart]) -> list[ImportedPart]:
    """Return the parts through which not all light passes; all of them where that
    leaves none.
    """
    return [part for part in parts if not part.surface.clear] or list(parts)


def placed(part: ImportedPart, matrix: Doubles) -> ImportedPart:
    """Return a part moved to its place in the file by an affine transform (4, 4)."""
    if np.array_equal(matrix, np.eye(4)):
        return part
    turn = matrix[:3, :3]
    normals = part.normals
    with np.errstate(all="ignore"):
        vertices = part.vertices @ turn.T + matrix[:3, 3]
        if normals is not None:  # a normal turns with the cofactors of the matrix
            normals = normals @ np.cross(turn[[1, 2, 0]], turn[[2, 0, 1]]).T
    return put(part, vertices, normals, mirrored=bool(np.linalg.det(turn) < 0.0))


def put(
    part: ImportedPart, vertices: Doubles, normals: Doubles | None, *, mirrored: bool
) -> ImportedPart:
    """Return a part with other places and normals; a mirror turns faces over, and
    cofactors normals.
    """
    part = replace(part, vertices=vertices, normals=normals)
    if not mirrored:
        return part
    colors = None if part.colors is None else part.colors[:, ::-1]
    return replace(
        part,
        faces=part.faces[:, ::-1],
        normals=None if normals is None else -normals,
        colors=colors,
    )


class Looked(NamedTuple):
    """Values that the corners of triangles look up."""

    values: Doubles  # (N, C) float64
    at: Ints  # (F, 3) int64 rows of `values`; -1 where a corner has none


def split_at_corners(
    chosen: Ints,
    points: Looked,
    normals: Looked | None,
    uvs: Looked | None,
    colors: Doubles | None,
    surface: ImportedSurface,
    *,
    flat: bool = False,
) -> ImportedPart:
    """Return a part of chosen triangles in which corners with the same point (N, 3),
    normal (N, 3) and texture coordinate (N, 2) are one vertex; every corner has a
    point. The rest is as in `ImportedPart`, of all triangles.
    """
    key = np.zeros(3 * len(chosen), dtype=np.int64)
    most = 1
    for looked_up in filter(None, (points, normals, uvs)):
        count = len(looked_up.values) + 1
        if most * count >= 2**63:  # numbered anew, so that it does not overflow
            key = np.unique(key, return_inverse=True)[1].reshape(-1)
            most = len(key)
        key = key * count + looked_up.at[chosen].reshape(-1) + 1
        most *= count
    _, first, faces = np.unique(key, return_index=True, return_inverse=True)

    def rows(looked_up: Looked | None) -> Doubles | None:
        index = (
            np.full(1, -1)
            if looked_up is None
            else looked_up.at[chosen].reshape(-1)[first]
        )
        if looked_up is None or (index < 0).all():
            return None
        return np.where(index[:, None] >= 0, looked_up.values[index], np.nan)

    vertices = points.values[points.at[chosen].reshape(-1)[first]]
    tint = None if colors is None else colors[chosen]
    return ImportedPart(
        vertices,
        faces.reshape(-1, 3),
        rows(normals),
        rows(uvs),
        tint,
        surface,
        flat=flat,
    )
