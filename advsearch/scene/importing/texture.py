"""Texture maps of an imported object, and texture coordinates that fit them.

The file's UVs and textures are used if they need no change. Otherwise the mesh is
unwrapped with xatlas, and repeating textures, several materials or vertex colors are
baked into one map each of color, normals and emission.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.ndimage import distance_transform_edt

from advsearch.scene.assets import (
    BoolArray,
    Float32Array,
    Float64Array,
    IntArray,
    group_indices,
)
from advsearch.scene.color import linear_to_srgb, srgb_to_linear
from advsearch.scene.importing.files import Notes
from advsearch.scene.importing.geometry import (
    TriangleSoup,
    find_components,
    normalize_vectors,
)
from advsearch.scene.importing.parts import (
    FLAT_TEXEL,
    NEUTRAL_GREY,
    ImportedSurface,
    encode_normals,
)
from advsearch.scene.importing.pictures import TEXTURE_LIMIT
from advsearch.scene.raster import (
    compute_doubled_areas,
    look_up_texture,
    rasterize_triangles,
)
from advsearch.scene.surface_parts import unwrap

# Width and height, in texels, of the base color map of an object of one color.
PLAIN_SIZE = 8
BAKED_SIZE = 512  # width and height of the smallest base color map that is baked
_UV_TOLERANCE = 1e-4  # distance from [0, 1] up to which UVs are clipped
_MAX_SQUASHED = 0.05  # fraction of the surface that may have no area in UV space
_MIN_UV_AREA = 0.02  # smallest total area of the faces in UV space
# Largest width and height of the UVs' bounding box at which images are cropped to it,
# in widths and heights of the texture.
_MAX_WINDOW = 1.5
# Distance from a chart, in texels, up to which texels emit light, since filtering needs
# them.
_EMISSION_BORDER = 2.0
_MAX_SHARED = 0.005  # fraction of the texels that may be on several faces
# Ratio of the texels of images to those of a baked texture from which on there is a
# note.
_MAX_TEXEL_RATIO = 1.5
# Limits of the points at which a mean is sampled, and of the steps along a face's side.
_MAX_SAMPLES = 1 << 18
_MAX_STEPS = 256
_FILL_FRACTION = 0.5  # approximate fraction of an atlas that its charts fill
# Area in UV space below which a face is a point or a line.
_MIN_FACE_UV_AREA = 1e-12
SHARED_LIGHT_REASON = (
    "several faces share a texture that emits light; it was unwrapped anew "
    "and its texture resampled"
)


@dataclass(frozen=True, eq=False)
class SurfaceMaps:
    """The images of an object's surface; row 0 is on top, at v = 1."""

    # (H, W, 3) display-referred base color in [0, 1], or (H, W, 4) with the opacity.
    color: Float32Array
    normals: Float32Array | None = None  # (H', W', 3) as `ImportedSurface.normal_map`
    # (H", W", 3) linear radiance, or (1, 1, 3) if it is the same everywhere.
    emission: Float32Array | None = None


def _list_used_surfaces(
    soup: TriangleSoup, surfaces: Sequence[ImportedSurface]
) -> list[ImportedSurface]:
    """Return the distinct surfaces of parts that have faces."""
    used_by_id = {
        id(surfaces[part]): surfaces[part] for part in np.unique(soup.part_of_face)
    }
    return list(used_by_id.values())


def apply_textures(
    soup: TriangleSoup, surfaces: Sequence[ImportedSurface], notes: Notes
) -> tuple[TriangleSoup, SurfaceMaps]:
    """Give every corner of a repaired soup UVs in [0, 1], and make the maps that fit.

    The file's UVs and images are used if all faces have the same images and these can
    be used without baking; they may be cropped to the window that the UVs use.
    Otherwise the soup is unwrapped, the images are baked, and a note has the reason. A
    soup of one color gets a small plain map, and keeps its UVs if these are usable.

    Args:
        soup: a repaired soup.
        surfaces: the surface of each of its parts.
        notes: notes about the file; the reason for baking is added.

    Returns:
        The soup with its UVs, and the maps for them.
    """
    used_surfaces = _list_used_surfaces(soup, surfaces)
    first_surface = used_surfaces[0]
    is_uniform = all(surface.has_same_maps(first_surface) for surface in used_surfaces)
    # `soup.colors` are vertex colors, factors of the base color.
    has_uniform_factor = bool((soup.colors == soup.colors[0, 0]).all())
    _, material_of_face = index_materials(soup, surfaces)
    cropped = None
    if is_uniform and has_uniform_factor:
        if not first_surface.images:
            return _texture_plain(soup, first_surface, material_of_face)
        cropped = _crop_images(soup, first_surface)
    if cropped is None:
        reason = _describe_reason(soup, used_surfaces, is_uniform, has_uniform_factor)
        return _unwrap_and_bake(soup, surfaces, material_of_face, reason, notes)
    uvs, images = cropped
    if _shares_emission(uvs, first_surface, images):
        reason = SHARED_LIGHT_REASON
        return _unwrap_and_bake(soup, surfaces, material_of_face, reason, notes)
    return _texture_with_images(soup, uvs, first_surface.with_images(images))


def _unwrap_and_bake(
    soup: TriangleSoup,
    surfaces: Sequence[ImportedSurface],
    material_of_face: IntArray,
    reason: str,
    notes: Notes,
) -> tuple[TriangleSoup, SurfaceMaps]:
    """Return a soup with new UVs, and the maps that are baked for it.

    Args:
        soup: the object.
        surfaces: the surface of each of its parts.
        material_of_face: (F,) index of each face's material.
        reason: why it is baked, for the note.
        notes: notes about the file.
    """
    unwrapped_soup = unwrap(soup, material_of_face)
    maps = bake(unwrapped_soup.uvs, soup, surfaces)
    notes.warn(f"{reason} ({_describe_size(len(maps.color), soup, surfaces)})")
    return unwrapped_soup, maps


def _describe_size(
    size: int, soup: TriangleSoup, surfaces: Sequence[ImportedSurface]
) -> str:
    """Describe the size of baked maps, and how much coarser they are than the images."""
    ratio = _count_texels(soup, surfaces) / (size * size * _FILL_FRACTION)
    ratio_text = ""
    if ratio >= _MAX_TEXEL_RATIO:
        ratio_text = f", {ratio:.0f} times fewer than its pictures have there"
    return f"{size} x {size} texels{ratio_text}"


def _texture_plain(
    soup: TriangleSoup, surface: ImportedSurface, material: IntArray
) -> tuple[TriangleSoup, SurfaceMaps]:
    """Return a soup of one color with UVs, and a plain map for it.

    The UVs are those of the file if they are usable and faces of different materials do
    not share texels; otherwise the soup is unwrapped.

    Args:
        soup: the object.
        surface: its only surface, which has no images.
        material: (F,) index of each face's material.
    """
    keeps_uvs = _is_usable(soup, soup.uvs) and not _has_overlap(soup.uvs, material)
    if keeps_uvs:
        soup_with_uvs = replace(soup, uvs=np.clip(soup.uvs, 0.0, 1.0))
    else:
        soup_with_uvs = unwrap(soup, material)
    color = _make_plain_map(soup_with_uvs, surface)
    return soup_with_uvs, SurfaceMaps(
        color=color, normals=None, emission=surface.emission
    )


def _texture_with_images(
    soup: TriangleSoup, uvs: Float64Array, surface: ImportedSurface
) -> tuple[TriangleSoup, SurfaceMaps]:
    """Return a soup with the images of its only surface, for UVs (F, 3, 2)."""
    color = surface.texture
    if color is None:
        color = _make_plain_map(soup, surface)
    maps = SurfaceMaps(color, surface.normal_map, surface.emission)
    return _unmirror(soup, np.clip(uvs, 0.0, 1.0), maps)


def index_materials(
    soup: TriangleSoup, surfaces: Sequence[ImportedSurface]
) -> tuple[list[str], IntArray]:
    """Return the names of materials, "" for none, and the index of each face's (F,)."""
    names = list(dict.fromkeys(surface.name for surface in surfaces))
    index_of_name = {name: index for index, name in enumerate(names)}
    index_of_part = np.array([index_of_name[surface.name] for surface in surfaces])
    return names, index_of_part[soup.part_of_face]


def _has_overlap(uvs: Float64Array, material: IntArray) -> bool:
    """Return whether faces of different materials share many texels.

    They share many if it is more than the fraction `_MAX_SHARED` of the texels that
    faces cover, in a map with a width and height of `BAKED_SIZE` texels.

    Args:
        uvs: (F, 3, 2) texture coordinates of the faces.
        material: (F,) index of each face's material.
    """
    if material.min() == material.max():
        return False
    size = BAKED_SIZE
    # The negative tolerance leaves out texels on the border of a face, which neighbours
    # share.
    texels = uvs * size - 0.5
    face, row, column, _ = rasterize_triangles(texels, (size, size), tolerance=-1e-6)
    # Smallest and largest material on each texel: if they differ, it is shared. Texels
    # without a face have a largest one of -1.
    texel = row * size + column
    first_material = np.full(size * size, len(uvs))  # more than any index
    last_material = np.full(size * size, -1)
    np.minimum.at(first_material, texel, material[face])
    np.maximum.at(last_material, texel, material[face])
    n_shared = (last_material > first_material).sum()
    return bool(n_shared > _MAX_SHARED * (last_material >= 0).sum())


def _make_plain_map(soup: TriangleSoup, surface: ImportedSurface) -> Float32Array:
    """Return a small map of the only color of a soup."""
    color = _get_plain_color(surface)
    if soup.colors.min() != 1.0:
        color = _tint(color, soup.colors[0, 0])
    return np.full((PLAIN_SIZE, PLAIN_SIZE, len(color)), color, dtype=np.float32)


def _shares_emission(
    uvs: Float64Array, surface: ImportedSurface, pictures: Sequence[Float32Array]
) -> bool:
    """Return whether several faces share texels that emit light.

    Mitsuba would send light from only one of these faces. A fraction of up to
    `_MAX_SHARED` of the lit texels may be on several faces. An emission that is the
    same everywhere has no texels to share.

    Args:
        uvs: (F, 3, 2).
        surface: the only surface.
        pictures: its images for these UVs, the last of which is the emission.
    """
    if surface.emission is None or surface.emission.shape == (1, 1, 3):
        return False
    is_lit = pictures[-1].any(axis=2)
    height, width = is_lit.shape
    # The negative tolerance leaves out texels on the border of a face, which neighbours
    # share.
    _, rows, columns, _ = rasterize_triangles(
        _to_texels(uvs, (height, width)), (height, width), tolerance=-1e-6
    )
    n_faces = np.bincount(rows * width + columns, minlength=height * width)
    n_faces_if_lit = n_faces.reshape(height, width)[is_lit]
    return bool((n_faces_if_lit > 1).sum() > _MAX_SHARED * max(1, len(n_faces_if_lit)))


def _to_texels(uvs: Float64Array, shape: tuple[int, int]) -> Float64Array:
    """Return UVs (F, 3, 2) as columns and rows of a map of a shape (height, width)."""
    columns = uvs[:, :, 0] * shape[1] - 0.5
    rows = (1.0 - uvs[:, :, 1]) * shape[0] - 0.5
    return np.stack([columns, rows], axis=2)


def _describe_reason(
    soup: TriangleSoup,
    used: Sequence[ImportedSurface],
    is_uniform: bool,
    has_uniform_factor: bool,
) -> str:
    """Return the reason why an object was baked, as a sentence for its warnings.

    The reasons are tried in this order: several materials or images, colors of
    vertices, missing texture coordinates, unusable texture coordinates.

    Args:
        soup: the object.
        used: the surfaces that have faces.
        is_uniform: whether all of these have the same images and colors.
        has_uniform_factor: whether vertex colors are the same everywhere.
    """
    if not is_uniform:
        return f"{_describe_materials(used)} were baked into one texture"
    is_tinted = soup.colors.min() < 1.0
    if not has_uniform_factor or is_tinted:
        return "its vertex or face colours were baked into a texture"
    if not np.isfinite(soup.uvs).all():
        return _describe_missing_uvs(used[0])
    return (
        "its texture coordinates repeat or hardly use the texture; it was unwrapped "
        "anew and its texture resampled"
    )


def _describe_materials(used: Sequence[ImportedSurface]) -> str:
    """Describe what of an object's surfaces is baked, as the subject of a sentence."""
    # Materials without a name are different if they are different objects.
    n_materials = len({surface.name or id(surface) for surface in used})
    if n_materials > 1:
        return f"the colours of its {n_materials} materials"
    return "the pictures of its material"


def _describe_missing_uvs(surface: ImportedSurface) -> str:
    """Return the sentence about an object with one surface that lacks UVs."""
    substitute = "its normal map is left out"
    if surface.texture is not None:
        substitute = "the texture's mean colour is used"
    return (
        "it has a texture, but lacks texture coordinates; where they are missing, "
        f"{substitute}"
    )


def _get_plain_color(surface: ImportedSurface) -> Float32Array:
    """Return the color of a surface, or neutral grey if it has none."""
    if surface.color is None:
        return np.full(3, NEUTRAL_GREY, dtype=np.float32)
    return surface.color


def _tint(
    color: npt.NDArray[np.floating], factor: npt.NDArray[np.floating]
) -> Float32Array:
    """Multiply display-referred colors (..., 3 or 4) by linear factors (..., 3).

    Opacity stays.
    """
    color = np.asarray(color, np.float32)
    product = srgb_to_linear(color[..., :3]) * factor
    return np.concatenate(
        [linear_to_srgb(product.astype(np.float32)), color[..., 3:]], axis=-1
    )


# ---- The file's UVs ----


def _is_usable(soup: TriangleSoup, uvs: Float64Array) -> bool:
    """Return whether UVs (F, 3, 2) are in [0, 1], and neither squashed nor tiny.

    At most the fraction `_MAX_SQUASHED` of the surface may have no area in UV space,
    and all faces together must cover at least the area `_MIN_UV_AREA` there.
    """
    if (
        not np.isfinite(uvs).all()
        or uvs.min() < -_UV_TOLERANCE
        or uvs.max() > 1.0 + _UV_TOLERANCE
    ):
        return False
    uv_area = np.abs(compute_doubled_areas(uvs)) / 2.0
    surface_area = np.linalg.norm(soup.compute_area_vectors(), axis=1)
    squashed_area = surface_area[uv_area < _MIN_FACE_UV_AREA].sum()
    return bool(
        squashed_area <= _MAX_SQUASHED * surface_area.sum()
        and uv_area.sum() >= _MIN_UV_AREA
    )


def _move_into_unit_square(soup: TriangleSoup) -> Float64Array:
    """Move each chart by an integer offset so that it starts in the unit square.

    The lower corner of each chart's bounding box ends up in [0, 1). As the texture
    repeats, this changes nothing visible. A chart is a set of faces that are connected
    by corners with the same point and the same UV.

    Returns:
        The moved UVs (F, 3, 2).
    """
    flat_uvs = soup.uvs.reshape(-1, 2)
    # Corners with the same point and UV are one vertex of a graph, whose edges are the
    # sides of faces; a chart is a component.
    corners = np.column_stack([soup.faces.reshape(-1), flat_uvs])
    _, vertex = np.unique(corners, axis=0, return_inverse=True)
    vertex = vertex.reshape(-1, 3)
    starts = np.concatenate([vertex[:, 0], vertex[:, 1]])
    ends = np.concatenate([vertex[:, 1], vertex[:, 2]])
    chart = find_components(int(vertex.max()) + 1, starts, ends)
    # (charts, 2) the smallest u and v of each chart
    chart_corner = np.full((int(chart.max()) + 1, 2), np.inf)
    np.minimum.at(chart_corner, chart[vertex.reshape(-1)], flat_uvs)
    # A chart that begins just below an integer, by rounding, must not be moved to the
    # end of the unit square. With the tolerance it begins just below 0, and is clipped
    # later.
    chart_offset = np.floor(chart_corner + _UV_TOLERANCE)
    uvs: Float64Array = soup.uvs - chart_offset[chart[vertex]]
    return uvs


def _crop_images(
    soup: TriangleSoup, surface: ImportedSurface
) -> tuple[Float64Array, Sequence[Float32Array]] | None:
    """Return the file's UVs (F, 3, 2) moved into [0, 1], and the images for them.

    The result is None if vertex colors change the texture, if faces lack UVs, or if the
    UVs are unusable.

    Args:
        soup: the object.
        surface: surface of all faces, which has images.
    """
    is_untinted = surface.texture is None or soup.colors.min() == 1.0
    if not is_untinted or not np.isfinite(soup.uvs).all():
        return None
    uvs, images = _crop_to_window(
        _move_into_unit_square(soup), pictures=surface.images, colors=surface.texture
    )
    return (uvs, images) if _is_usable(soup, uvs) else None


def _crop_to_window(
    uvs: Float64Array, pictures: Sequence[Float32Array], colors: Float32Array | None
) -> tuple[Float64Array, Sequence[Float32Array]]:
    """Crop images to the window that UVs span; the layout of the charts stays.

    The window is the bounding box of the UVs, one texel wider on each side, so that
    filtering finds the neighbors of its texels. Images are cropped if UVs overstep the
    unit square, or use only a small part of it. Then they are resampled at texels of
    about the same size. Images stay as they are if UVs are inside and fill enough of
    the square, or if the window is larger than `_MAX_WINDOW`, since textures repeat
    there.

    Args:
        uvs: (F, 3, 2).
        pictures: images (H, W, C).
        colors: the image with colors, which is filtered in linear light; None if there
            is none.

    Returns:
        UVs relative to the window, and the images of it; or both as they were.
    """
    # (2,) width and height of a texel of the coarsest image, in texture coordinates
    largest_texel = np.max([1.0 / _get_size(picture) for picture in pictures], axis=0)
    window_lower = uvs.min(axis=(0, 1)) - largest_texel
    window_upper = uvs.max(axis=(0, 1)) + largest_texel
    window_size = window_upper - window_lower
    fills_square = _fills_square(uvs, window_lower, window_upper, largest_texel.max())
    if window_size.max() > _MAX_WINDOW or fills_square:
        return uvs, pictures
    cropped = [
        _crop_image(picture, window_lower, window_upper, is_color=picture is colors)
        for picture in pictures
    ]
    return (uvs - window_lower) / window_size, cropped


def _fills_square(
    uvs: Float64Array,
    window_lower: Float64Array,
    window_upper: Float64Array,
    tolerance: float,
) -> bool:
    """Return whether UVs are inside of the unit square, and use enough of it.

    Args:
        uvs: (F, 3, 2).
        window_lower, window_upper: (2,) corners of the window.
        tolerance: by how much the window is larger than the UVs.
    """
    is_inside = (
        window_lower.min() >= -_UV_TOLERANCE - tolerance
        and window_upper.max() <= 1.0 + _UV_TOLERANCE + tolerance
    )
    uv_area = np.abs(compute_doubled_areas(uvs)).sum() / 2.0
    return bool(is_inside and uv_area >= _MIN_UV_AREA)


def _get_size(picture: Float32Array) -> IntArray:
    """Return the width and height (2,) of an image (H, W, C)."""
    height, width = picture.shape[:2]
    return np.array([width, height])


def _crop_image(
    picture: Float32Array,
    window_lower: Float64Array,
    window_upper: Float64Array,
    *,
    is_color: bool,
) -> Float32Array:
    """Return the image of a window, with at most `TEXTURE_LIMIT` texels a side.

    Unless they are limited, texels keep about their size.

    Args:
        picture: (H, W, C) image, which repeats.
        window_lower: (2,) smallest u and v of the window.
        window_upper: (2,) largest u and v of the window.
        is_color: whether it has colors, which are filtered in linear light.
    """
    window_size = window_upper - window_lower
    exact_size = np.ceil(window_size * _get_size(picture))
    width, height = np.clip(exact_size, 1, TEXTURE_LIMIT).astype(int)
    # u of the columns, and v of the rows from the top (the largest v) down
    columns = window_lower[0] + (np.arange(width) + 0.5) / width * window_size[0]
    rows = window_upper[1] - (np.arange(height) + 0.5) / height * window_size[1]
    grid = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    look_up = sample_colors if is_color else sample_texture
    return look_up(picture, grid).reshape(height, width, -1)


# ---- Baking ----


def _choose_size(n_texels: float) -> int:
    """Return the width of square maps with room for a number of texels.

    It is `BAKED_SIZE`, doubled until there is enough room, but at most `TEXTURE_LIMIT`.
    Charts fill only the fraction `_FILL_FRACTION` of a map.
    """
    size = BAKED_SIZE
    while size < TEXTURE_LIMIT and size * size * _FILL_FRACTION < n_texels:
        size *= 2
    return size


def bake(
    uvs: Float64Array, soup: TriangleSoup, surfaces: Sequence[ImportedSurface]
) -> SurfaceMaps:
    """Bake the colors, normals and emission of a soup into maps for new UVs.

    Texels outside of charts repeat the nearest one inside, so that filtering causes no
    seam. Faces without UVs in the file get the mean color of their texture, and neither
    bumps nor emission.

    Args:
        uvs: (F, 3, 2) new UVs in [0, 1] without overlaps.
        soup: the object, with the file's UVs (NaN if it has none).
        surfaces: the surface of each part.

    Returns:
        Maps (N, N, ...) with room for the texels that the object shows.
    """
    size = _choose_size(_count_texels(soup, surfaces))
    texels = _rasterize(uvs, size)
    maps = _make_blank_maps(surfaces, size)
    # (T, 3) factor of the base color at each texel
    factor = texels.interpolate(soup.colors)
    # the texels of each part, up to the last one that has any
    texels_of_part = group_indices(soup.part_of_face[texels.face])
    for surface, index in zip(surfaces, texels_of_part, strict=False):
        if not len(index):
            continue
        part_texels = texels.select(index)
        file_uvs = part_texels.interpolate(soup.uvs)
        color = _sample_base_color(surface, file_uvs, soup, surfaces)
        _put_colors(maps.color, part_texels, _tint(color, factor[index]))
        if np.isfinite(file_uvs).all():
            _bake_bumps_and_emission(maps, surface, part_texels, file_uvs, soup, uvs)
    return _fill_gaps(maps, texels.make_mask(size))


def _put_colors(color_map: Float32Array, texels: _Texels, colors: Float32Array) -> None:
    """Put colors (T, C) into texels of a map (N, N, C or 4), whose opacity may stay."""
    color_map[texels.row, texels.column, : colors.shape[1]] = colors


def _rasterize(uvs: Float64Array, size: int) -> _Texels:
    """Return the texels of a square map that faces with UVs (F, 3, 2) cover."""
    corners = _to_texels(uvs, (size, size))
    return _Texels(*rasterize_triangles(corners, (size, size), tolerance=1e-9))


def _bake_bumps_and_emission(
    maps: SurfaceMaps,
    surface: ImportedSurface,
    texels: _Texels,
    file_uvs: Float64Array,
    soup: TriangleSoup,
    uvs: Float64Array,
) -> None:
    """Fill in the normals and the emission of a part, if it has any.

    Args:
        maps: the maps of the object.
        surface: the surface of the part.
        texels: the texels that the part covers.
        file_uvs: (T, 2) UVs of the file at these texels.
        soup: the object.
        uvs: (F, 3, 2) new UVs of its faces.
    """
    y = texels.row
    x = texels.column
    if maps.normals is not None and surface.normal_map is not None:
        colors = sample_texture(surface.normal_map, file_uvs)
        maps.normals[y, x] = convert_normals(
            colors, soup, uvs, texels.face, texels.weights
        )
    if maps.emission is not None and surface.emission is not None:
        maps.emission[y, x] = sample_texture(surface.emission, file_uvs)


class _Texels(NamedTuple):
    """Texels (T,) of a map that faces cover, as `rasterize_triangles` returns them.

    Attributes:
        face: (T,) index of the face on each texel.
        row: (T,) row of each texel.
        column: (T,) column of each texel.
        weights: (T, 3) barycentric weights of the corners of its face.
    """

    face: IntArray
    row: IntArray
    column: IntArray
    weights: Float64Array

    def select(self, index: IntArray) -> _Texels:
        """Return some of the texels."""
        return _Texels(
            self.face[index], self.row[index], self.column[index], self.weights[index]
        )

    def interpolate(self, values: Float64Array) -> Float64Array:
        """Return values (F, 3, C) of corners at the texels, (T, C)."""
        return np.asarray(np.einsum("tk,tkc->tc", self.weights, values[self.face]))

    def make_mask(self, size: int) -> BoolArray:
        """Return which texels (size, size) of a square map these are."""
        is_covered = np.zeros((size, size), np.bool_)
        is_covered[self.row, self.column] = True
        return is_covered


def _make_blank_maps(surfaces: Sequence[ImportedSurface], size: int) -> SurfaceMaps:
    """Return the blank maps (N, N, ...) that surfaces need.

    Colors are white and opaque, normals flat, and the emission black. The color has a
    fourth channel if a surface has an opacity.
    """
    has_opacity = any(_get_base_color(surface).shape[-1] == 4 for surface in surfaces)
    n_channels = 4 if has_opacity else 3
    color = np.ones((size, size, n_channels), np.float32)
    normals = None
    if any(surface.normal_map is not None for surface in surfaces):
        normals = np.full((size, size, 3), FLAT_TEXEL)
    emission = None
    if any(surface.emission is not None for surface in surfaces):
        emission = np.zeros((size, size, 3), np.float32)
    return SurfaceMaps(color, normals, emission)


def _get_base_color(surface: ImportedSurface) -> Float32Array:
    """Return the base color of a surface: its texture (H, W, C), or its color (C,)."""
    return _get_plain_color(surface) if surface.texture is None else surface.texture


def _fill_gaps(maps: SurfaceMaps, is_inside: npt.NDArray[np.bool_]) -> SurfaceMaps:
    """Give texels outside of all charts the values of the nearest texel inside.

    Such texels emit light only close to a chart, where filtering needs it: further away
    the renderer would sample light from texels that no face shows.
    """
    # A texel inside is its own nearest one, at the distance 0.
    distance, nearest = distance_transform_edt(~is_inside, return_indices=True)
    nearest_texel = tuple(nearest)  # rows and columns, each (H, W)
    normals = maps.normals
    if normals is not None:
        normals = normals[nearest_texel]
    emission = maps.emission
    if emission is not None:
        is_near_chart = distance < _EMISSION_BORDER
        emission = emission[nearest_texel] * is_near_chart[:, :, None]
    return SurfaceMaps(maps.color[nearest_texel], normals, emission)


def _sample_base_color(
    surface: ImportedSurface,
    uvs: Float64Array,
    soup: TriangleSoup,
    surfaces: Sequence[ImportedSurface],
) -> Float32Array:
    """Return the base color (T, 3 or 4) of a surface at UVs (T, 2).

    The color is display-referred. If some UVs are missing (NaN), it is the same for
    all: the mean of the texture over the faces of the soup that show it.

    Args:
        surface: the surface.
        uvs: (T, 2) texture coordinates of the file.
        soup: the object.
        surfaces: the surfaces of its parts.
    """
    if surface.texture is not None and np.isfinite(uvs).all():
        return sample_colors(surface.texture, uvs)
    if surface.texture is None:
        color = _get_plain_color(surface)
    else:
        color = _compute_mean_color(surface.texture, soup, surfaces)
    return np.broadcast_to(color[None], (len(uvs), len(color)))


def _compute_mean_color(
    texture: Float32Array, soup: TriangleSoup, surfaces: Sequence[ImportedSurface]
) -> Float32Array:
    """Return the mean color (3 or 4,) of a texture over the faces that show it.

    Args:
        texture: (H, W, 3 or 4), display-referred as the result.
        soup: the object.
        surfaces: the surfaces of its parts, several of which may have the texture.
    """
    shows_texture = [surface.texture is texture for surface in surfaces]
    is_selected = np.array(shows_texture)[soup.part_of_face]
    areas = np.linalg.norm(soup.compute_area_vectors(), axis=1)[is_selected]
    mean = average_over_faces(_to_linear(texture), soup.uvs[is_selected], areas)
    return _to_display(mean)


def _count_texels(soup: TriangleSoup, surfaces: Sequence[ImportedSurface]) -> float:
    """Return how many texels of the file's images an object shows.

    For a part this is the area of its UVs times the number of texels of its largest
    image. Texels of an image that repeats are counted at each repeat.
    """
    n_texels = 0.0
    uv_areas = np.nan_to_num(np.abs(compute_doubled_areas(soup.uvs)) / 2.0)
    for part, area in enumerate(np.bincount(soup.part_of_face, uv_areas)):
        sizes = (image.shape[0] * image.shape[1] for image in surfaces[part].images)
        n_texels += float(area) * max(sizes, default=0)
    return n_texels


def _sample_nearest(texture: Float32Array, uvs: Float64Array) -> Float32Array:
    """Return the texels (N, C) of a repeating texture that UVs (N, 2) are in.

    The last modulo keeps 1.0, to which a tiny negative number is rounded, inside.
    """
    height, width = texture.shape[:2]
    rows = (1.0 - uvs[:, 1]) % 1.0 * height
    columns = uvs[:, 0] % 1.0 * width
    texels: Float32Array = texture[
        rows.astype(int) % height, columns.astype(int) % width
    ]
    return texels


def average_over_faces(
    texture: Float32Array, uvs: Float64Array, areas: Float64Array
) -> Float32Array:
    """Return the mean of a texture over faces, weighted by their areas.

    Each face is sampled at the centers of equal small triangles.

    Args:
        texture: (H, W, C).
        uvs: (F, 3, 2), NaN if a face has none.
        areas: (F,).

    Returns:
        (C,) float32. If no face has both UVs and an area, the mean of the texture.
    """
    is_known = np.isfinite(uvs).all(axis=(1, 2)) & (areas > 0.0)
    if not is_known.any():
        return np.asarray(texture.mean(axis=(0, 1), dtype=np.float64), np.float32)
    uvs = uvs[is_known]
    areas = areas[is_known]
    # the finest division whose samples, n_steps^2 for each face, are within the limit
    n_steps = int(np.clip(np.sqrt(_MAX_SAMPLES / len(areas)), 1, _MAX_STEPS))
    weights = _compute_sample_weights(n_steps)
    weighted_sum = np.zeros(texture.shape[2])
    # In batches, so that memory is bounded. The number of batches is rounded up.
    n_samples = len(areas) * len(weights)
    n_batches = -(-n_samples // _MAX_SAMPLES)
    for batch in np.array_split(np.arange(len(areas)), n_batches):
        face_means = _average_each_face(texture, uvs[batch], weights)
        weighted_sum += areas[batch] @ face_means
    return np.asarray(weighted_sum / areas.sum(), np.float32)


def _average_each_face(
    texture: Float32Array, uvs: Float64Array, weights: Float64Array
) -> Float64Array:
    """Return the mean (F, C) of a texture over each of some faces.

    Args:
        texture: (H, W, C).
        uvs: (F, 3, 2).
        weights: (P, 3) barycentric weights of the samples.
    """
    sample_uvs = np.einsum("pk,fkc->fpc", weights, uvs).reshape(-1, 2)
    texels = _sample_nearest(texture, sample_uvs)
    samples = texels.reshape(len(uvs), len(weights), -1)
    means: Float64Array = samples.mean(axis=1, dtype=np.float64)
    return means


def _compute_sample_weights(steps: int) -> Float64Array:
    """Return barycentric weights (P, 3) of points evenly spread over a triangle.

    Each side is cut into `steps` parts, which divides the triangle into steps**2 equal
    small triangles. The points are the centers of these. Small triangles point up, like
    the large one, or down. Both kinds begin at grid points (i, j), counted in steps
    along two sides. The center of one that points up is at (i + 1/3, j + 1/3), and the
    center of one that points down at (i + 2/3, j + 2/3).
    """
    grid_i, grid_j = np.meshgrid(np.arange(steps), np.arange(steps))
    i = grid_i.reshape(-1)
    j = grid_j.reshape(-1)
    # grid points at which a small triangle of either kind begins within the large one
    is_up = i + j < steps
    is_down = i + j < steps - 1
    center_i = np.concatenate([i[is_up] + 1.0 / 3.0, i[is_down] + 2.0 / 3.0])
    center_j = np.concatenate([j[is_up] + 1.0 / 3.0, j[is_down] + 2.0 / 3.0])
    # As fractions of a side these are the weights of the second and the third corner.
    weight_b = center_i / steps
    weight_c = center_j / steps
    return np.stack([1.0 - weight_b - weight_c, weight_b, weight_c], axis=1)


def sample_colors(colors: Float32Array, uvs: Float64Array) -> Float32Array:
    """Sample a repeating texture of display-referred colors in linear light.

    Interpolation is bilinear. Colors are weighted by their opacity, so that transparent
    texels have no weight.

    Args:
        colors: (H, W, 3 or 4) display-referred colors, perhaps with opacity.
        uvs: (T, 2), finite.

    Returns:
        (T, 3 or 4) display-referred float32.
    """
    return _to_display(sample_texture(_to_linear(colors), uvs))


def _to_linear(colors: Float32Array) -> Float32Array:
    """Return display-referred colors (..., 3 or 4) as linear, premultiplied ones."""
    linear = srgb_to_linear(colors[..., :3])
    if colors.shape[-1] == 3:
        return linear
    opacity = colors[..., 3:]
    return np.concatenate([linear * opacity, opacity], axis=-1)


def _to_display(colors: Float32Array) -> Float32Array:
    """Return linear, premultiplied colors (..., 3 or 4) as display-referred ones."""
    linear = colors[..., :3]
    opacity = colors[..., 3:]
    if opacity.size:
        linear = linear / np.maximum(opacity, np.float32(1e-9))
    return np.concatenate([linear_to_srgb(linear), opacity], axis=-1)


def sample_texture(texture: Float32Array, uvs: Float64Array) -> Float32Array:
    """Sample a repeating texture with bilinear interpolation of its values.

    Args:
        texture: (H, W, C) float32.
        uvs: (T, 2), finite.

    Returns:
        (T, C) float32.
    """
    height, width = texture.shape[:2]
    # Modulo comes first, since a huge number times a width is infinite.
    u, v = (uvs % 1.0).T
    # Texel centers are at integers, and row 0 is at the top, where v is 1.
    return look_up_texture(texture, u * width - 0.5, (1.0 - v) * height - 0.5)


# ---- Normal maps at other texture coordinates ----
#
# In a file the bitangent points up the image; Mitsuba's is normal x tangent, which
# points down it where texture coordinates are mirrored.

# Fraction of the surface whose mirrored texture coordinates are ignored.
MIN_MIRRORED_FRACTION = 1e-3


def _unmirror(
    soup: TriangleSoup, uvs: Float64Array, maps: SurfaceMaps
) -> tuple[TriangleSoup, SurfaceMaps]:
    """Return a soup whose UVs mirror no face, and the maps for it.

    A face is mirrored if its UVs run clockwise. There the renderer's bitangent is the
    opposite of the file's, which matters only for a normal map. If (almost) all faces
    are mirrored, the y of the normals is reversed. If only some are, the maps are
    doubled in width: the right half is a mirrored copy of the left one, and the
    mirrored faces are moved there. No texel is resampled.

    Args:
        soup: the object.
        uvs: (F, 3, 2) in [0, 1].
        maps: maps for these UVs.
    """
    soup = replace(soup, uvs=uvs)
    is_mirrored = compute_doubled_areas(uvs) < 0.0
    area = np.linalg.norm(soup.compute_area_vectors(), axis=1)
    mirrored_fraction = float(area[is_mirrored].sum() / area.sum())
    if maps.normals is None or mirrored_fraction < MIN_MIRRORED_FRACTION:
        return soup, maps
    if 1.0 - mirrored_fraction < MIN_MIRRORED_FRACTION:  # (almost) all are mirrored
        reversed_normals = _reverse_component(maps.normals, component=1)
        return soup, replace(maps, normals=reversed_normals)
    new_uvs = _move_to_right_half(uvs, is_mirrored)
    return replace(soup, uvs=new_uvs), _double_maps(maps, maps.normals)


def _move_to_right_half(uvs: Float64Array, is_mirrored: BoolArray) -> Float64Array:
    """Return UVs (F, 3, 2) in a map of twice the width, mirrored faces in its right half.

    In units of the old width, the right half is from 1 to 2, and its u runs backwards.
    Then both halves are scaled to [0, 1].
    """
    new_uvs: Float64Array = uvs.copy()
    new_uvs[is_mirrored, :, 0] = 2.0 - new_uvs[is_mirrored, :, 0]
    new_uvs[:, :, 0] /= 2.0
    return new_uvs


def _double_maps(maps: SurfaceMaps, normals: Float32Array) -> SurfaceMaps:
    """Return maps of twice the width, whose right half is a mirrored copy of the left.

    `normals` (H, W, 3) are those of the maps.
    """
    # u runs the other way in the right half, so that the normals' x is reversed.
    mirrored_normals = _reverse_component(normals[:, ::-1], component=0)
    emission = maps.emission
    # An emission of a single texel is the same everywhere, and is not doubled.
    if emission is not None and emission.shape != (1, 1, 3):
        emission = np.concatenate([emission, emission[:, ::-1]], axis=1)
    color = np.concatenate([maps.color, maps.color[:, ::-1]], axis=1)
    normals = np.concatenate([normals, mirrored_normals], axis=1)
    return SurfaceMaps(color, normals, emission)


def _reverse_component(normals: Float32Array, component: int) -> Float32Array:
    """Return a normal map (H, W, 3) with x (0) or y (1) of its normals reversed.

    A component n is stored as (n + 1) / 2, so that its texels t become 1 - t.
    """
    factor = np.ones(3, np.float32)
    factor[component] = -1.0
    offset = np.zeros(3, np.float32)
    offset[component] = 1.0
    return normals * factor + offset


def convert_normals(
    texels: Float32Array,
    old_soup: TriangleSoup,
    new_uvs: Float64Array,
    face: IntArray,
    weights: Float64Array,
) -> Float32Array:
    """Convert texels of a normal map from the tangents of old UVs to those of new UVs.

    A texel stores a normal's components n along tangent, bitangent and surface normal
    as (n + 1) / 2. The first two are rotated within the surface, and the third stays. A
    normal on a face without area in UV space cannot be converted, and becomes (0, 0,
    1).

    Args:
        texels: (T, 3) of the normal map.
        old_soup: the object with the old UVs.
        new_uvs: (F, 3, 2) the new UVs.
        face: (T,) the face that each texel is on.
        weights: (T, 3) barycentric weights of its corners.

    Returns:
        (T, 3) texels.
    """
    normal = normalize_vectors(np.einsum("tk,tkc->tc", weights, old_soup.normals[face]))
    old_tangent = _compute_tangents(old_soup, normal, face)
    new_tangent = _compute_tangents(replace(old_soup, uvs=new_uvs), normal, face)
    old_bitangent = _compute_file_bitangents(old_soup, normal, old_tangent, face)
    new_bitangent = np.cross(normal, new_tangent)
    x, y, z = np.moveaxis(texels.astype(np.float64) * 2.0 - 1.0, -1, 0)  # decoded
    in_plane = x[:, None] * old_tangent + y[:, None] * old_bitangent
    new_x = (in_plane * new_tangent).sum(axis=1)
    new_y = (in_plane * new_bitangent).sum(axis=1)
    bumps = np.stack([new_x, new_y, z], axis=1)
    # Tangents are NaN on faces without area in UV space.
    is_valid = np.isfinite(bumps).all(axis=1, keepdims=True)
    return encode_normals(np.where(is_valid, bumps, [0.0, 0.0, 1.0]))


def _compute_file_bitangents(
    soup: TriangleSoup, normal: Float64Array, tangent: Float64Array, face: IntArray
) -> Float64Array:
    """Return the bitangents (T, 3) of a file, which point up the image.

    They are normal x tangent, or the opposite where UVs are mirrored. For the renderer,
    bitangents are always normal x tangent.

    Args:
        soup: the object, with the file's UVs.
        normal, tangent: (T, 3) unit vectors.
        face: (T,) index of a face for each.
    """
    mirror_sign = np.sign(compute_doubled_areas(soup.uvs[face]))[:, None]
    bitangent: Float64Array = np.cross(normal, tangent) * mirror_sign
    return bitangent


def _compute_tangents(
    soup: TriangleSoup, normal: Float64Array, face: IntArray
) -> Float64Array:
    """Return unit tangents (T, 3) along u on faces (T,), orthogonal to normals (T, 3).

    A tangent is the direction on the face in which u grows and v is constant, minus its
    component along the normal. It is NaN where UVs have no area, since a vector of
    length 0 has no direction.

    For a face with corners a, b, c, and UVs (u1, v1) of b and (u2, v2) of c relative to
    those of a, the derivative of the position by u is

        ((b - a) v2 - (c - a) v1) / (u1 v2 - u2 v1)

    Only the sign of the divisor, the doubled area in UV space, affects the direction.

    Args:
        soup: the object, with the UVs.
        normal: (T, 3) unit normals.
        face: (T,) index of a face for each.
    """
    used_faces, used_index = np.unique(face, return_inverse=True)
    a, b, c = (soup.points[soup.faces[used_faces, k]] for k in range(3))
    uvs = soup.uvs[used_faces]
    v = uvs[:, :, 1]
    v1 = v[:, 1] - v[:, 0]
    v2 = v[:, 2] - v[:, 0]
    area_sign = np.sign(compute_doubled_areas(uvs))[:, None]
    tangent = ((b - a) * v2[:, None] - (c - a) * v1[:, None]) * area_sign
    tangent = tangent[used_index.reshape(-1)]
    along_normal = normal * (tangent * normal).sum(axis=1, keepdims=True)
    return normalize_vectors(tangent - along_normal)
