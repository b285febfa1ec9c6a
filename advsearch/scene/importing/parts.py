"""Parts of mesh files, which all readers return: geometry, surface, normal map.

A texel of a normal map is `(n + 1) / 2` with n the unit normal in the frame (tangent,
bitangent, normal) of the surface: the tangent runs along u, and the bitangent up the
picture (glTF 2.0, section 3.9.3; others call that OpenGL's convention).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from advsearch.scene.assets import (
    BoolArray,
    Float32Array,
    Float64Array,
    IntArray,
    group_indices,
    multiply_rows,
)
from advsearch.scene.color import srgb_to_linear
from advsearch.scene.importing.files import Notes
from advsearch.scene.skeleton import Movable

# The texel of a flat normal map.
FLAT_TEXEL = np.array([0.5, 0.5, 1.0], np.float32)
MAX_NORMAL_SCALE = 100.0  # larger factors of x and y make no visible difference
# Minimum z of a normal before it is scaled to length 1: it points out of the surface.
MIN_NORMAL_Z = 0.01
# Smallest mean of blue minus red in a normal map. In a grey map of heights it is 0.
MIN_BLUENESS = 0.1
MAX_LENGTH_ERROR = 0.2  # largest error of the length of a normal in an image
MIN_NORMAL_FRACTION = 0.9  # smallest fraction of the texels within that error


def make_normal_map(picture: Float32Array, scale: float = 1.0) -> Float32Array:
    """Convert an image to a normal map whose unit normals point out of the surface.

    Args:
        picture: (H, W, 3) in [0, 1], as it is in the file.
        scale: factor of x and y, finite.

    Returns:
        (H, W, 3) texels.
    """
    clamped_scale = min(max(scale, -MAX_NORMAL_SCALE), MAX_NORMAL_SCALE)
    normals = picture * 2.0 - 1.0  # stored as (n + 1) / 2
    normals[..., :2] *= clamped_scale
    # a normal must not point into the surface
    normals[..., 2] = np.maximum(normals[..., 2], MIN_NORMAL_Z)
    return encode_normals(normals)


def has_normals(picture: Float32Array) -> bool:
    """Return whether an image (H, W, 3) has normals, and not heights, which are grey.

    Normals are mostly blue, since they point out of the surface, and have a length of
    about 1. Black texels are ignored: no face shows them.
    """
    visible_texels = picture[picture.any(axis=2)]  # not black
    if not len(visible_texels):
        return False
    normals = visible_texels * 2.0 - 1.0  # decoded from [0, 1] to [-1, 1]
    length_error = np.abs(np.linalg.norm(normals, axis=1) - 1.0)
    normal_fraction = (length_error < MAX_LENGTH_ERROR).mean()
    # blue minus red: 0 where the image is grey
    blueness = float(
        (visible_texels[:, 2] - visible_texels[:, 0]).mean(dtype=np.float64)
    )
    return blueness > MIN_BLUENESS and bool(normal_fraction > MIN_NORMAL_FRACTION)


def encode_normals(normals: npt.NDArray[np.floating]) -> Float32Array:
    """Encode normals (..., 3) of any length as texels."""
    lengths = np.linalg.norm(normals, axis=-1, keepdims=True)
    unit_normals = normals / np.maximum(lengths, 1e-12)
    return np.asarray(unit_normals * 0.5 + 0.5, dtype=np.float32)


NEUTRAL_GREY = 0.5  # display-referred grey of an object without material
# Limit of the radiance that a surface emits. A white surface in the light of a bundled
# environment has a radiance of about 1.
MAX_RADIANCE = 1e5


@dataclass(frozen=True, eq=False)
class ImportedSurface:
    """The material of a part.

    Colors are display-referred sRGB in [0, 1], and images have row 0 on top. An
    attribute is None if the file does not define it.
    """

    # (3,) base color if there is no texture; (4,) with its opacity in [0, 1]
    color: Float32Array | None = None
    # (H, W, 3) base color, or (H, W, 4) with the opacity
    texture: Float32Array | None = None
    roughness: float | None = None  # in [0, 1]
    metallic: float | None = None  # in [0, 1]
    normal_map: Float32Array | None = None  # (H, W, 3) encoded as in this module
    # (H, W, 3) linear radiance; (1, 1, 3) if it is the same everywhere
    emission: Float32Array | None = None
    name: str = ""  # name of the material in the file; "" if it has none

    @property
    def images(self) -> tuple[Float32Array, ...]:
        """The images that are looked up by texture coordinates."""
        emission = self.emission
        if emission is not None and emission.shape == (1, 1, 3):
            emission = None  # it is the same everywhere
        return tuple(
            image
            for image in (self.texture, self.normal_map, emission)
            if image is not None
        )

    def with_images(self, pictures: Iterable[Float32Array]) -> ImportedSurface:
        """Return the surface with other images, in the order of `images`.

        Their number is that of `images`. Attributes that are None stay None.
        """
        remaining = iter(pictures)
        texture = None if self.texture is None else next(remaining)
        normals = None if self.normal_map is None else next(remaining)
        # An emission that is the same everywhere is not in `images`, and stays.
        emission = next(remaining, self.emission)
        return replace(self, texture=texture, normal_map=normals, emission=emission)

    @property
    def is_transparent(self) -> bool:
        """Whether all light passes through it, everywhere."""
        color = self.color if self.texture is None else self.texture
        return color is not None and color.shape[-1] == 4 and not color[..., 3].any()

    def has_same_maps(self, other: ImportedSurface) -> bool:
        """Return whether two surfaces have equal base colors, normal maps and emission."""
        self_maps = (self.color, self.texture, self.normal_map, self.emission)
        pairs = zip(
            self_maps,
            (other.color, other.texture, other.normal_map, other.emission),
            strict=True,
        )
        return all(
            a is b or (a is not None and b is not None and np.array_equal(a, b))
            for a, b in pairs
        )


def compute_radiance(
    factor: Float64Array, picture: Float32Array | None, notes: Notes
) -> Float32Array | None:
    """Return the radiance that a surface emits, as in `ImportedSurface`.

    Args:
        factor: (3,) linear; it is cut to `MAX_RADIANCE`, with a note.
        picture: (H, W, 3) display-referred factors, or None.
        notes: notes about the file.
    """
    if factor.max() > MAX_RADIANCE:
        notes.warn(f"emission brighter than {MAX_RADIANCE:g} is cut to that")
    linear_factors = np.ones((1, 1, 3), np.float32)
    if picture is not None:
        linear_factors = srgb_to_linear(picture)
    radiance = (linear_factors * np.minimum(factor, MAX_RADIANCE)).astype(np.float32)
    return radiance if radiance.any() else None


def describe_substitute(color: Float32Array | None) -> str:
    """Describe the color that replaces a missing texture.

    Plain white is no color of a material: it only leaves a texture unchanged.
    """
    if color is None or is_plain_white(color):
        return "neutral grey"
    return f"its base colour ({', '.join(f'{channel:.2f}' for channel in color)})"


def is_plain_white(color: Float32Array) -> bool:
    """Return whether a color (3 or 4,) is white, apart from rounding."""
    return bool((color > 0.999).all())


def apply_opacity(
    color: Float32Array | None, factor: Float32Array, cutoff: float | None
) -> Float32Array | None:
    """Return a base color with its opacity.

    Cut-out texels get the color of the nearest visible one. Otherwise filtering would
    blend their color into the edges.

    Args:
        color: (..., 3 or 4) base color; None returns None.
        factor: (1,) factor of the alpha.
        cutoff: opacity from which on a texel is opaque; below it, a texel is cut out.
            None keeps partial opacity.

    Returns:
        (..., 4), or (..., 3) if it is opaque everywhere.
    """
    if color is None:
        return None
    rgb = color[..., :3]
    opacity = _compute_opacity(color, factor, cutoff)
    if opacity.min() >= 1.0:  # opaque everywhere
        return rgb
    is_cut_out = opacity[..., 0] == 0.0
    is_image = color.ndim == 3  # not a single color
    if is_image and not is_cut_out.all():
        rgb = _fill_cut_out_texels(rgb, is_cut_out)
    return np.concatenate([rgb, opacity], axis=-1)


def _compute_opacity(
    color: Float32Array, factor: Float32Array, cutoff: float | None
) -> Float32Array:
    """Return the opacity (..., 1) of a base color (..., 3 or 4); see `apply_opacity`."""
    alpha = color[..., 3:] if color.shape[-1] == 4 else np.ones_like(color[..., :1])
    opacity: Float32Array = alpha * factor
    if cutoff is not None:
        opacity = (opacity >= cutoff).astype(np.float32)
    return opacity


def _fill_cut_out_texels(rgb: Float32Array, is_cut_out: BoolArray) -> Float32Array:
    """Return colors (H, W, 3) with those of cut-out texels (H, W) from the nearest other."""
    # Imported here, since the reader of USD, a separate process, needs no scipy.
    from scipy.ndimage import distance_transform_edt

    # for each texel the rows and columns of the nearest one that is not cut out
    nearest_visible = distance_transform_edt(
        is_cut_out, return_distances=False, return_indices=True
    )
    extended: Float32Array = rgb[tuple(nearest_visible)]
    return extended


def clip_to_unit(value: float | None) -> float | None:
    """Clip a factor to [0, 1]; None and NaN become None."""
    if value is None or math.isnan(value):
        return None
    return min(max(float(value), 0.0), 1.0)


@dataclass(frozen=True, eq=False)
class ImportedPart:
    """One part of a mesh file, with the transform of its node applied.

    An attribute is None if the file does not define it.
    """

    vertices: Float64Array  # (V, 3) in the file's axes and units; may hold NaN
    faces: IntArray  # (F, 3) indices of vertices, F > 0
    # (V, 3) normals of the file, not necessarily of unit length or finite
    normals: Float64Array | None = None
    uvs: Float64Array | None = None  # (V, 2), v = 0 at the bottom row
    # (F, 3, 3) color of each corner in [0, 1], which multiplies the base color in
    # linear light
    colors: Float64Array | None = None
    surface: ImportedSurface = ImportedSurface()
    node: int = -1  # index of its node in a glTF file; -1 in other formats
    # Whether faces without normals are shaded flat; otherwise smooth normals are
    # computed.
    flat: bool = False
    # The part before joints or morph targets move it, with vertices in the same order;
    # None if nothing moves it.
    movable: Movable | None = None


def group_faces(*keys: IntArray | BoolArray) -> list[IntArray]:
    """Group faces that have the same values of all keys (F,).

    Returns the faces of each combination, in rising order.
    """
    _, group = np.unique(np.stack(keys, axis=1), axis=0, return_inverse=True)
    return group_indices(group.reshape(-1))


def select_visible_parts(parts: Sequence[ImportedPart]) -> list[ImportedPart]:
    """Return the parts that are not fully transparent, or all if that leaves none."""
    return [part for part in parts if not part.surface.is_transparent] or list(parts)


def transform_part(part: ImportedPart, matrix: Float64Array) -> ImportedPart:
    """Return a part transformed by an affine matrix (4, 4).

    If the matrix mirrors, the winding of the faces is reversed, so that their fronts
    stay outside.
    """
    if np.array_equal(matrix, np.eye(4)):
        return part
    linear = matrix[:3, :3]
    normals = part.normals
    with np.errstate(all="ignore"):
        vertices = multiply_rows(part.vertices, linear.T) + matrix[:3, 3]
        if normals is not None:
            # Normals are transformed by the matrix of cofactors: the inverse transpose
            # times the determinant, which exists also for singular matrices. Its row i
            # is the cross product of the rows i + 1 and i + 2.
            cofactors = np.cross(linear[[1, 2, 0]], linear[[2, 0, 1]])
            normals = multiply_rows(normals, cofactors.T)
    return replace_geometry(
        part, vertices, normals, is_mirrored=bool(np.linalg.det(linear) < 0.0)
    )


def replace_geometry(
    part: ImportedPart,
    vertices: Float64Array,
    normals: Float64Array | None,
    *,
    is_mirrored: bool,
) -> ImportedPart:
    """Return a part with other vertices and normals.

    Mirrored positions reverse the winding of faces, so that their fronts are inside. A
    matrix that mirrors also has cofactors that reverse normals. Both are reversed again
    here.

    Args:
        part: the part.
        vertices: (V, 3) new positions.
        normals: (V, 3) new normals, transformed by the cofactors of the matrix that
            transformed the positions; or None.
        is_mirrored: whether the new positions are mirrored.
    """
    part = replace(part, vertices=vertices, normals=normals)
    return _reverse_faces(part) if is_mirrored else part


def _reverse_faces(part: ImportedPart) -> ImportedPart:
    """Return a part with the opposite winding and normals."""
    return replace(
        part,
        faces=part.faces[:, ::-1],
        normals=None if part.normals is None else -part.normals,
        colors=None if part.colors is None else part.colors[:, ::-1],
    )


class IndexedValues(NamedTuple):
    """Values, and the indices by which the corners of triangles refer to them."""

    values: Float64Array  # (N, C) float64
    row_of_corner: IntArray  # (F, 3) int64 rows of `values`; -1 if a corner has none


def make_part_from_corners(
    triangles: IntArray,
    points: IndexedValues,
    normals: IndexedValues | None,
    uvs: IndexedValues | None,
    colors: Float64Array | None,
    surface: ImportedSurface,
    *,
    flat: bool = False,
) -> ImportedPart:
    """Return selected triangles as a part.

    Corners with the same point, normal and texture coordinate become one vertex.

    Args:
        triangles: (T,) the triangles, out of F.
        points: positions (N, 3) and their rows; every corner has one.
        normals: normals (N, 3) and their rows, or None.
        uvs: texture coordinates (N, 2) and their rows, or None.
        colors: (F, 3, 3) linear colors of the corners, or None.
        surface: surface of the part.
        flat: whether faces without normals are shaded flat.
    """
    corner_number = _number_corners(triangles, points, normals, uvs)
    # for each vertex its first corner, and for each corner its vertex
    _, first_corner, faces = np.unique(
        corner_number, return_index=True, return_inverse=True
    )

    point_rows = points.row_of_corner[triangles].reshape(-1)[first_corner]
    return ImportedPart(
        vertices=points.values[point_rows],
        faces=faces.reshape(-1, 3),
        normals=_gather_vertex_values(normals, triangles, first_corner),
        uvs=_gather_vertex_values(uvs, triangles, first_corner),
        colors=None if colors is None else colors[triangles],
        surface=surface,
        flat=flat,
    )


def _gather_vertex_values(
    indexed: IndexedValues | None, triangles: IntArray, first_corner: IntArray
) -> Float64Array | None:
    """Return values of vertices (V, C), NaN for those without one.

    The result is None if there are no values, or all vertices lack one.

    Args:
        indexed: values of the corners of all triangles, or None.
        triangles: (T,) the triangles that are selected.
        first_corner: (V,) a corner of each vertex, out of the 3 T corners.
    """
    if indexed is None:
        return None
    rows = indexed.row_of_corner[triangles].reshape(-1)[first_corner]
    if (rows < 0).all():
        return None
    return np.where(rows[:, None] >= 0, indexed.values[rows], np.nan)


def _number_corners(triangles: IntArray, *columns: IndexedValues | None) -> IntArray:
    """Return one number for each corner, which is equal for corners with equal values.

    A corner refers to each list of values by a row. The number is built from these
    rows as from digits: for points and normals it is point row * base + normal row,
    where the base is the number of rows that normals may have. Rows count from 1 here;
    0 stands for a missing value.

    Args:
        triangles: (T,) indices of the triangles.
        *columns: values of the corners, such as points and normals; None is skipped.

    Returns:
        (3 T,) numbers, corner by corner.
    """
    corner_number = np.zeros(3 * len(triangles), dtype=np.int64)
    bound = 1  # all numbers are smaller than this
    for indexed in columns:
        if indexed is None:
            continue
        base = len(indexed.values) + 1
        would_overflow = bound * base >= 2**63
        if would_overflow:
            corner_number = _renumber(corner_number)
            bound = len(corner_number)
        digit = indexed.row_of_corner[triangles].reshape(-1) + 1
        corner_number = corner_number * base + digit
        bound *= base
    return corner_number


def _renumber(numbers: IntArray) -> IntArray:
    """Replace equal numbers by equal smaller ones, which count from 0."""
    _, smaller_numbers = np.unique(numbers, return_inverse=True)
    return smaller_numbers.reshape(-1)
