"""The base colour map of an imported object, and texture coordinates that fit it.

The file's own UVs and texture are kept where they can be used as they are. Otherwise the mesh is unwrapped with xatlas
and whatever colours the file has (repeating textures, several materials, vertex colours) are baked into one texture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_array, csgraph

from advsearch.scene.color import linear_to_srgb, srgb_to_linear
from advsearch.scene.importing.geometry import Array, Soup
from advsearch.scene.importing.images import TEXTURE_LIMIT
from advsearch.scene.importing.surfaces import NEUTRAL, ImportedSurface
from advsearch.scene.importing.unwrap import unwrapped
from advsearch.scene.raster import doubled_areas, pixels_in
from advsearch.scene.surface_map import looked_up

Floats = npt.NDArray[np.float32]

PLAIN_SIZE = 8
"""Width and height, in texels, of the base colour map of an object of one colour."""

BAKED_SIZE = 512
"""Width and height of the smallest base colour map that is baked."""

_SLACK = 1e-4  # how far UVs may overstep [0, 1] and still be clipped
_SQUASHED = 0.05  # share of the surface that may have no area in UV space
_CRAMPED = 0.02  # share of the unit square that UVs must cover in all
_WINDOW = 1.5  # how many textures wide and high UVs may be and still keep their layout
_FILLED = 0.5  # share of an atlas that its charts fill, about


def textured(soup: Soup, surfaces: Sequence[ImportedSurface]) -> tuple[Soup, Floats, list[str]]:
    """Return the soup with UVs in [0, 1] on every corner, the base colour map that fits them, and the warnings.

    Args:
        soup: repaired geometry.
        surfaces: the surface of each part.

    Returns:
        The soup, a (H, W, 3) float32 display-referred map in [0, 1] with row 0 on top, (H, W, 4) with the opacity where
        light passes through a part, and sentences.
    """
    used = [surfaces[number] for number in np.unique(soup.part)]
    uniform = all(surface.same_color(used[0]) for surface in used)
    colored = uniform and _one_factor(soup)
    texture = used[0].texture
    if colored and texture is None:
        color = _plain(used[0]) if soup.colors.min() == 1.0 else _tinted(_plain(used[0]), soup.colors[0, 0])
        kept = _usable(soup, soup.uvs)
        soup = replace(soup, uvs=np.clip(soup.uvs, 0.0, 1.0)) if kept else unwrapped(soup)
        return soup, np.full((PLAIN_SIZE, PLAIN_SIZE, len(color)), color, dtype=np.float32), []
    if colored and texture is not None and soup.colors.min() == 1.0 and np.isfinite(soup.uvs).all():
        uvs, texture = _windowed(_into_unit_square(soup), texture)
        if _usable(soup, uvs):
            return replace(soup, uvs=np.clip(uvs, 0.0, 1.0)), texture, []
    fresh = unwrapped(soup)
    return fresh, baked(fresh.uvs, soup, surfaces), [_why(soup, used, uniform)]


def _why(soup: Soup, used: Sequence[ImportedSurface], uniform: bool) -> str:
    """Return the sentence that says why the object was unwrapped anew."""
    if not uniform:
        return f"the colours of its {len(used)} parts were baked into one texture"
    if not _one_factor(soup) or soup.colors.min() < 1.0:
        return "its vertex or face colours were baked into a texture"
    if not np.isfinite(soup.uvs).all():
        return "it has a texture but lacks texture coordinates; where it does, the texture's mean colour is used"
    return "its texture coordinates repeat or hardly use the texture; it was unwrapped anew and its texture resampled"


def _one_factor(soup: Soup) -> bool:
    """Tell whether the same colour factor holds everywhere."""
    return bool((soup.colors == soup.colors[0, 0]).all())


def _plain(surface: ImportedSurface) -> Floats:
    """Return the base colour of a surface without texture, (3 or 4,) display-referred."""
    return np.full(3, NEUTRAL, dtype=np.float32) if surface.color is None else surface.color


def _tinted(color: npt.NDArray[np.floating], factor: npt.NDArray[np.floating]) -> Floats:
    """Multiply display-referred colours (..., 3 or 4) by factors (..., 3) in linear light; opacity stays."""
    color = np.asarray(color, np.float32)
    product = srgb_to_linear(color[..., :3]) * srgb_to_linear(np.asarray(factor, np.float32))
    return np.concatenate([linear_to_srgb(product.astype(np.float32)), color[..., 3:]], axis=-1)


# --- the file's UVs ----------------------------------------


def _usable(soup: Soup, uvs: Array) -> bool:
    """Tell whether UVs are known, inside the unit square, not squashed to lines, and use the square."""
    if not np.isfinite(uvs).all() or uvs.min() < -_SLACK or uvs.max() > 1.0 + _SLACK:
        return False
    flat, surface = np.abs(doubled_areas(uvs)) / 2.0, np.linalg.norm(soup.face_vectors(), axis=1)
    return bool(surface[flat < 1e-12].sum() <= _SQUASHED * surface.sum() and flat.sum() >= _CRAMPED)


def _into_unit_square(soup: Soup) -> Array:
    """Move each chart by whole textures so that it starts in the unit square; a repeating texture looks the same."""
    corners = np.column_stack([soup.faces.reshape(-1), soup.uvs.reshape(-1, 2)])
    _, vertex = np.unique(corners, axis=0, return_inverse=True)
    vertex = vertex.reshape(-1, 3)
    a, b = np.concatenate([vertex[:, 0], vertex[:, 1]]), np.concatenate([vertex[:, 1], vertex[:, 2]])
    graph = coo_array((np.ones(len(a), np.int8), (a, b)), shape=(int(vertex.max()) + 1,) * 2)
    charts, chart = csgraph.connected_components(graph, directed=False)
    low = np.full((charts, 2), np.inf)
    np.minimum.at(low, chart[vertex.reshape(-1)], soup.uvs.reshape(-1, 2))
    moved: Array = soup.uvs - np.floor(low + _SLACK)[chart[vertex]]
    return moved


def _windowed(uvs: Array, texture: Floats) -> tuple[Array, Floats]:
    """Cut the texture to the window that UVs span where they overstep the unit square a little or use a corner of it.

    The layout of the charts stays. Windows larger than `_WINDOW` textures are left alone: there the texture repeats.

    Returns:
        The UVs and the texture, unchanged or both made to fit the window.
    """
    texel = 1.0 / np.array(texture.shape[1::-1])
    low, high = uvs.min(axis=(0, 1)) - texel, uvs.max(axis=(0, 1)) + texel
    size = high - low
    inside = low.min() >= -_SLACK - texel.max() and high.max() <= 1.0 + _SLACK + texel.max()
    if size.max() > _WINDOW or (inside and np.abs(doubled_areas(uvs)).sum() / 2.0 >= _CRAMPED):
        return uvs, texture
    width, height = np.clip(np.ceil(size / texel), 1, TEXTURE_LIMIT).astype(int)
    columns = low[0] + (np.arange(width) + 0.5) / width * size[0]
    rows = high[1] - (np.arange(height) + 0.5) / height * size[1]
    grid = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    return (uvs - low) / size, sampled(texture, grid).reshape(height, width, -1)


# --- baking ----------------------------------------


def baked(uvs: Array, soup: Soup, surfaces: Sequence[ImportedSurface]) -> Floats:
    """Paint the colours of a soup into a texture for new UVs.

    Args:
        uvs: (F, 3, 2) new UVs in [0, 1], without overlaps.
        soup: the geometry with the file's UVs (NaN where it has none) and colour factors.
        surfaces: the surface of each part.

    Returns:
        (N, N, 3 or 4) float32 display-referred map. Texels outside every chart repeat the nearest one inside, so that
        filtering finds no seam.
    """
    size = _baked_size(soup, surfaces)
    corners = np.stack([uvs[:, :, 0] * size - 0.5, (1.0 - uvs[:, :, 1]) * size - 0.5], axis=2)
    face, rows, columns, weights = pixels_in(corners, (size, size), tolerance=1e-9)
    through = any(_channels(one) == 4 for one in surfaces)
    image, inside = np.ones((size, size, 3 + through), np.float32), np.zeros((size, size), np.bool_)
    factor = np.einsum("tk,tkc->tc", weights, soup.colors[face])
    part = soup.part[face]
    order = np.argsort(part, kind="stable")
    for here in np.split(order, np.flatnonzero(np.diff(part[order])) + 1):
        if not len(here):  # no texel at all
            continue
        number = int(part[here[0]])
        surface, at = surfaces[number], np.einsum("tk,tkc->tc", weights[here], soup.uvs[face[here]])
        if surface.texture is None or not np.isfinite(at).all():
            color: Floats = _plain(surface)[None] if surface.texture is None else _mean(surface.texture)
            color = np.broadcast_to(color, (len(at), color.shape[1]))
        else:
            color = sampled(surface.texture, at)
        image[rows[here], columns[here], : color.shape[1]] = _tinted(color, factor[here])
    inside[rows, columns] = True
    nearest = distance_transform_edt(~inside, return_distances=False, return_indices=True)
    return np.ascontiguousarray(image[nearest[0], nearest[1]])


def _channels(surface: ImportedSurface) -> int:
    """Return how many channels its base colour has: 3, or 4 with opacity."""
    return int((_plain(surface) if surface.texture is None else surface.texture).shape[-1])


def _baked_size(soup: Soup, surfaces: Sequence[ImportedSurface]) -> int:
    """Return a power of two, `BAKED_SIZE` to `TEXTURE_LIMIT`, that has room for the texels that the object shows."""
    texels, areas = 0.0, np.nan_to_num(np.abs(doubled_areas(soup.uvs)) / 2.0)
    for number, area in enumerate(np.bincount(soup.part, areas)):
        texture = surfaces[number].texture
        if texture is not None:
            texels += float(area) * texture.shape[0] * texture.shape[1]
    size = BAKED_SIZE
    while size < TEXTURE_LIMIT and size * size * _FILLED < texels:
        size *= 2
    return size


def _mean(texture: Floats) -> Floats:
    """Return the mean colour (1, 3 or 4) of a texture, taken in linear light."""
    mean: Floats = srgb_to_linear(texture[:, :, :3]).mean(axis=(0, 1), dtype=np.float64).astype(np.float32)
    return np.concatenate([linear_to_srgb(mean), texture[:, :, 3:].mean(axis=(0, 1))])[None]


def sampled(texture: Floats, uvs: Array) -> Floats:
    """Look a repeating texture up with bilinear interpolation of its display-referred values.

    Args:
        texture: (H, W, C) float32, row 0 on top.
        uvs: (T, 2), any finite values; v = 0 is the bottom.

    Returns:
        (T, C) float32.
    """
    height, width = texture.shape[:2]
    u, v = (uvs % 1.0).T  # first, since a huge number times a width is infinite
    return looked_up(texture, u * width - 0.5, (1.0 - v) * height - 0.5)
