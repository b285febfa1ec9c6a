"""Texture maps of an imported object, and texture coordinates that fit them.

The file's UVs and textures are used if they can be used unchanged. Otherwise the mesh is
unwrapped with xatlas, and what the file has (repeating textures, several materials,
vertex colors) is baked into one map each of color, normals and emission.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.ndimage import distance_transform_edt

from advsearch.scene.assets import Doubles, Floats, Ints, grouped
from advsearch.scene.color import linear_to_srgb, srgb_to_linear
from advsearch.scene.importing.files import Notes
from advsearch.scene.importing.geometry import Soup, connected, unit_vectors
from advsearch.scene.importing.parts import FLAT, NEUTRAL, ImportedSurface, texels_of
from advsearch.scene.importing.pictures import TEXTURE_LIMIT
from advsearch.scene.raster import doubled_areas, looked_up, pixels_in
from advsearch.scene.surface_parts import unwrapped

# Width and height, in texels, of the base color map of an object of one color.
PLAIN_SIZE = 8
BAKED_SIZE = 512  # width and height of the smallest base color map that is baked
_SLACK = 1e-4  # how far UVs may overstep [0, 1] and still be clipped
_SQUASHED = 0.05  # fraction of the surface that may have no area in UV space
_CRAMPED = 0.02  # fraction of the unit square that UVs must cover in all
_WINDOW = 1.5  # how many textures wide and high UVs may be and still keep their layout
_BORDER = 2.0  # texels outside a chart up to which it emits light: filtering needs them
_SHARED = 0.005  # fraction of the texels that may be on several faces
# How many times more texels an image may have than a baked texture without a note.
_FINER = 1.5
# Limits of the points at which a mean is sampled, and of the steps along a face's side.
_LOOKS = 1 << 18
_FINEST = 256
_FILLED = 0.5  # approximate fraction of an atlas that its charts fill


@dataclass(frozen=True, eq=False)
class SurfaceMaps:
    """The images of an object's surface; row 0 is on top, at v = 1."""

    # (H, W, 3) display-referred base color in [0, 1], or (H, W, 4) with the opacity.
    color: Floats
    normals: Floats | None = None  # (H', W', 3) as `ImportedSurface.normal_map`
    # (H", W", 3) linear radiance, or (1, 1, 3) if it is the same everywhere.
    emission: Floats | None = None


def textured(
    soup: Soup, surfaces: Sequence[ImportedSurface], notes: Notes
) -> tuple[Soup, SurfaceMaps]:
    """Give every corner of a repaired soup UVs in [0, 1], and make the maps that fit.

    The file's UVs and images are used if possible; else they are baked.

    Args:
        soup: a repaired soup.
        surfaces: the surface of each of its parts.
        notes: where it is reported why images were baked.
    """
    used_by_id = {id(surfaces[part]): surfaces[part] for part in np.unique(soup.part)}
    used = list(used_by_id.values())
    first = used[0]
    is_uniform = all(surface.same_maps(first) for surface in used)
    has_one_factor = bool((soup.colors == soup.colors[0, 0]).all())
    _, material = by_material(soup, surfaces)
    is_lit_twice = False
    if is_uniform and has_one_factor:
        if not first.pictures:
            return _without_images(soup, first, material)
        is_untinted = first.texture is None or soup.colors.min() == 1.0
        if is_untinted and np.isfinite(soup.uvs).all():
            uvs, images = _windowed(
                _into_unit_square(soup), first.pictures, first.texture
            )
            is_usable = _usable(soup, uvs)
            is_lit_twice = is_usable and _lit_twice(uvs, first, images)
            if is_usable and not is_lit_twice:
                return _with_images(soup, uvs, first.with_pictures(images))
    unwrapped_soup = unwrapped(soup, material)
    maps = baked(unwrapped_soup.uvs, soup, surfaces)
    reason = (
        "several faces share a texture that emits light; it was unwrapped anew "
        "and its texture resampled"
    )
    if not is_lit_twice:
        reason = _why(soup, used, is_uniform, has_one_factor)
    size = len(maps.color)
    ratio = _texels(soup, surfaces) / (size * size * _FILLED)
    fewer = ""
    if ratio >= _FINER:
        fewer = f", {ratio:.0f} times fewer than its pictures have there"
    notes.say(f"{reason} ({size} x {size} texels{fewer})")
    return unwrapped_soup, maps


def _without_images(
    soup: Soup, surface: ImportedSurface, material: Ints
) -> tuple[Soup, SurfaceMaps]:
    """Return a soup of one color with UVs, the file's if they do not overlap."""
    keeps_uvs = _usable(soup, soup.uvs) and not _overlap(soup.uvs, material)
    if keeps_uvs:
        soup_with_uvs = replace(soup, uvs=np.clip(soup.uvs, 0.0, 1.0))
    else:
        soup_with_uvs = unwrapped(soup, material)
    color = _of_one_color(soup_with_uvs, surface)
    return soup_with_uvs, SurfaceMaps(color, None, surface.emission)


def _with_images(
    soup: Soup, uvs: Doubles, surface: ImportedSurface
) -> tuple[Soup, SurfaceMaps]:
    """Return a soup with the images of its only surface, for UVs (F, 3, 2)."""
    color = surface.texture
    if color is None:
        color = _of_one_color(soup, surface)
    maps = SurfaceMaps(color, surface.normal_map, surface.emission)
    return _unmirrored(soup, np.clip(uvs, 0.0, 1.0), maps)


def by_material(
    soup: Soup, surfaces: Sequence[ImportedSurface]
) -> tuple[list[str], Ints]:
    """Return the names of materials, "" for none, and the index of each face's (F,)."""
    names = list(dict.fromkeys(surface.name for surface in surfaces))
    index_of_name = {name: index for index, name in enumerate(names)}
    index_of_part = np.array([index_of_name[surface.name] for surface in surfaces])
    return names, index_of_part[soup.part]


def _overlap(uvs: Doubles, material: Ints) -> bool:
    """Return whether faces of different materials share many texels."""
    if material.min() == material.max():
        return False
    size = BAKED_SIZE
    face, row, column, _ = pixels_in(uvs * size - 0.5, (size, size), tolerance=-1e-6)
    first_material = np.full(size * size, len(uvs))
    last_material = np.full(size * size, -1)
    np.minimum.at(first_material, row * size + column, material[face])
    np.maximum.at(last_material, row * size + column, material[face])
    n_shared = (last_material > first_material).sum()
    return bool(n_shared > _SHARED * (last_material >= 0).sum())


def _of_one_color(soup: Soup, surface: ImportedSurface) -> Floats:
    """Return a small map of the only color of a soup."""
    color = _plain(surface)
    if soup.colors.min() != 1.0:
        color = _tinted(color, soup.colors[0, 0])
    return np.full((PLAIN_SIZE, PLAIN_SIZE, len(color)), color, dtype=np.float32)


def _lit_twice(
    uvs: Doubles, surface: ImportedSurface, pictures: Sequence[Floats]
) -> bool:
    """Return whether texels that emit light are on several faces.

    Mitsuba would send light from one of them only.
    """
    if surface.emission is None or surface.emission.shape == (1, 1, 3):
        return False
    is_lit = pictures[-1].any(axis=2)
    height, width = is_lit.shape
    _, rows, columns, _ = pixels_in(
        _in_texels(uvs, (height, width)), (height, width), tolerance=-1e-6
    )
    n_faces = np.bincount(rows * width + columns, minlength=height * width)
    n_faces_if_lit = n_faces.reshape(height, width)[is_lit]
    return bool((n_faces_if_lit > 1).sum() > _SHARED * max(1, len(n_faces_if_lit)))


def _in_texels(uvs: Doubles, shape: tuple[int, int]) -> Doubles:
    """Return UVs (F, 3, 2) as columns and rows of a map of a shape (height, width)."""
    columns = uvs[:, :, 0] * shape[1] - 0.5
    rows = (1.0 - uvs[:, :, 1]) * shape[0] - 0.5
    return np.stack([columns, rows], axis=2)


def _why(
    soup: Soup, used: Sequence[ImportedSurface], uniform: bool, one_factor: bool
) -> str:
    """Return the reason why an object was baked, as a sentence for its warnings."""
    if not uniform:
        n_materials = len({surface.name or id(surface) for surface in used})
        if n_materials > 1:
            baked_things = f"the colours of its {n_materials} materials"
        else:
            baked_things = "the pictures of its material"
        return f"{baked_things} were baked into one texture"
    if not one_factor or soup.colors.min() < 1.0:
        return "its vertex or face colours were baked into a texture"
    if not np.isfinite(soup.uvs).all():
        substitute = "its normal map is left out"
        if used[0].texture is not None:
            substitute = "the texture's mean colour is used"
        return (
            "it has a texture but lacks texture coordinates; where it does, "
            f"{substitute}"
        )
    return (
        "its texture coordinates repeat or hardly use the texture; it was "
        "unwrapped "
        "anew and its texture resampled"
    )


def _plain(surface: ImportedSurface) -> Floats:
    """Return the color of a surface, or neutral grey if it has none."""
    if surface.color is None:
        return np.full(3, NEUTRAL, dtype=np.float32)
    return surface.color


def _tinted(
    color: npt.NDArray[np.floating], factor: npt.NDArray[np.floating]
) -> Floats:
    """Multiply display-referred colors (..., 3 or 4) by linear factors (..., 3).

    Opacity stays.
    """
    color = np.asarray(color, np.float32)
    product = srgb_to_linear(color[..., :3]) * factor
    return np.concatenate(
        [linear_to_srgb(product.astype(np.float32)), color[..., 3:]], axis=-1
    )


# ---- The file's UVs ----


def _usable(soup: Soup, uvs: Doubles) -> bool:
    """Return whether UVs (F, 3, 2) are in [0, 1], and neither squashed nor tiny."""
    if not np.isfinite(uvs).all() or uvs.min() < -_SLACK or uvs.max() > 1.0 + _SLACK:
        return False
    uv_area = np.abs(doubled_areas(uvs)) / 2.0
    surface_area = np.linalg.norm(soup.face_vectors(), axis=1)
    squashed_area = surface_area[uv_area < 1e-12].sum()
    return bool(
        squashed_area <= _SQUASHED * surface_area.sum() and uv_area.sum() >= _CRAMPED
    )


def _into_unit_square(soup: Soup) -> Doubles:
    """Move each chart by an integer offset so that it starts in the unit square.

    A repeating texture looks the same. Returns UVs (F, 3, 2).
    """
    flat_uvs = soup.uvs.reshape(-1, 2)
    corners = np.column_stack([soup.faces.reshape(-1), flat_uvs])
    _, vertex = np.unique(corners, axis=0, return_inverse=True)
    vertex = vertex.reshape(-1, 3)
    starts = np.concatenate([vertex[:, 0], vertex[:, 1]])
    ends = np.concatenate([vertex[:, 1], vertex[:, 2]])
    chart = connected(int(vertex.max()) + 1, starts, ends)
    low = np.full((int(chart.max()) + 1, 2), np.inf)
    np.minimum.at(low, chart[vertex.reshape(-1)], flat_uvs)
    uvs: Doubles = soup.uvs - np.floor(low + _SLACK)[chart[vertex]]
    return uvs


def _windowed(
    uvs: Doubles, pictures: Sequence[Floats], colors: Floats | None
) -> tuple[Doubles, Sequence[Floats]]:
    """Crop images to the window that UVs span; the layout of the charts stays.

    This is done if UVs overstep the unit square a little or use a corner of it. Windows
    larger than `_WINDOW` textures are left alone: there the textures repeat.

    Args:
        uvs: (F, 3, 2).
        pictures: images (H, W, C).
        colors: which of them has colors, filtered in linear light.
    """
    texel = np.max(
        [1.0 / np.array(picture.shape[1::-1]) for picture in pictures], axis=0
    )
    low = uvs.min(axis=(0, 1)) - texel
    high = uvs.max(axis=(0, 1)) + texel
    size = high - low
    is_inside = (
        low.min() >= -_SLACK - texel.max() and high.max() <= 1.0 + _SLACK + texel.max()
    )
    is_filled = is_inside and np.abs(doubled_areas(uvs)).sum() / 2.0 >= _CRAMPED
    if size.max() > _WINDOW or is_filled:
        return uvs, pictures
    cropped = []
    for picture in pictures:
        # Texels keep their size.
        shape = np.ceil(size * np.array(picture.shape[1::-1]))
        width, height = np.clip(shape, 1, TEXTURE_LIMIT).astype(int)
        columns = low[0] + (np.arange(width) + 0.5) / width * size[0]
        rows = high[1] - (np.arange(height) + 0.5) / height * size[1]
        grid = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
        look_up = filtered if picture is colors else sampled
        cropped.append(look_up(picture, grid).reshape(height, width, -1))
    return (uvs - low) / size, cropped


# ---- Baking ----


def baked(uvs: Doubles, soup: Soup, surfaces: Sequence[ImportedSurface]) -> SurfaceMaps:
    """Bake the colors, normals and emission of a soup into maps for new UVs.

    Texels outside every chart repeat the nearest one inside, so that filtering finds no
    seam.

    Args:
        uvs: (F, 3, 2) new UVs in [0, 1] without overlaps.
        soup: the object, with the file's UVs (NaN if it has none).
        surfaces: the surface of each part.

    Returns:
        Maps (N, N, ...) with room for the texels that the object shows.
    """
    size = BAKED_SIZE
    texels = _texels(soup, surfaces)
    while size < TEXTURE_LIMIT and size * size * _FILLED < texels:
        size *= 2
    pixels = pixels_in(_in_texels(uvs, (size, size)), (size, size), tolerance=1e-9)
    face, rows, columns, weights = pixels
    has_opacity = any(_plain_or_texture(surface).shape[-1] == 4 for surface in surfaces)
    color = np.ones((size, size, 3 + has_opacity), np.float32)
    normals = None
    if any(surface.normal_map is not None for surface in surfaces):
        normals = np.full((size, size, 3), FLAT)
    emission = None
    if any(surface.emission is not None for surface in surfaces):
        emission = np.zeros((size, size, 3), np.float32)
    factor = np.einsum("tk,tkc->tc", weights, soup.colors[face])
    for surface, texel in zip(surfaces, grouped(soup.part[face]), strict=False):
        if not len(texel):
            continue
        y = rows[texel]
        x = columns[texel]
        file_uvs = np.einsum("tk,tkc->tc", weights[texel], soup.uvs[face[texel]])
        texel_color = _looked_up(surface, file_uvs, soup, surfaces)
        color[y, x, : texel_color.shape[1]] = _tinted(texel_color, factor[texel])
        if not np.isfinite(file_uvs).all():
            continue
        if normals is not None and surface.normal_map is not None:
            normals[y, x] = turned(
                sampled(surface.normal_map, file_uvs),
                soup,
                uvs,
                face[texel],
                weights[texel],
            )
        if emission is not None and surface.emission is not None:
            emission[y, x] = sampled(surface.emission, file_uvs)
    is_inside = np.zeros((size, size), np.bool_)
    is_inside[rows, columns] = True
    return _fill_gaps(SurfaceMaps(color, normals, emission), is_inside)


def _plain_or_texture(surface: ImportedSurface) -> Floats:
    """Return the base color of a surface: its texture (H, W, C), or its color (C,)."""
    return _plain(surface) if surface.texture is None else surface.texture


def _fill_gaps(maps: SurfaceMaps, is_inside: npt.NDArray[np.bool_]) -> SurfaceMaps:
    """Give texels outside of all charts the values of the nearest texel inside.

    They emit light only close to a chart.
    """
    distance, nearest = distance_transform_edt(~is_inside, return_indices=True)
    nearest_texel = tuple(nearest)
    normals = maps.normals
    if normals is not None:
        normals = normals[nearest_texel]
    emission = maps.emission
    if emission is not None:
        emission = emission[nearest_texel] * (distance < _BORDER)[:, :, None]
    return SurfaceMaps(maps.color[nearest_texel], normals, emission)


def _looked_up(
    surface: ImportedSurface,
    uvs: Doubles,
    soup: Soup,
    surfaces: Sequence[ImportedSurface],
) -> Floats:
    """Return the base color (T, 3 or 4) of a surface at UVs (T, 2).

    If UVs are missing, it is the mean over all faces that show its texture.
    """
    if surface.texture is not None and np.isfinite(uvs).all():
        return filtered(surface.texture, uvs)
    color = _plain(surface)
    if surface.texture is not None:
        shows_texture = [other.texture is surface.texture for other in surfaces]
        is_selected = np.array(shows_texture)[soup.part]
        areas = np.linalg.norm(soup.face_vectors(), axis=1)[is_selected]
        mean = mean_over(_in_linear(surface.texture), soup.uvs[is_selected], areas)
        color = _in_display(mean)
    return np.broadcast_to(color[None], (len(uvs), len(color)))


def _texels(soup: Soup, surfaces: Sequence[ImportedSurface]) -> float:
    """Return how many texels of the file's images an object shows."""
    n_texels = 0.0
    uv_areas = np.nan_to_num(np.abs(doubled_areas(soup.uvs)) / 2.0)
    for part, area in enumerate(np.bincount(soup.part, uv_areas)):
        sizes = (
            picture.shape[0] * picture.shape[1] for picture in surfaces[part].pictures
        )
        n_texels += float(area) * max(sizes, default=0)
    return n_texels


def mean_over(texture: Floats, uvs: Doubles, areas: Doubles) -> Floats:
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
    steps = int(np.clip(np.sqrt(_LOOKS / len(areas)), 1, _FINEST))
    weights = _sample_weights(steps)
    height, width = texture.shape[:2]
    total = np.zeros(texture.shape[2])
    n_batches = -(-len(areas) * len(weights) // _LOOKS)
    for batch in np.array_split(np.arange(len(areas)), n_batches):
        points = np.einsum("pk,fkc->fpc", weights, uvs[batch]).reshape(-1, 2)
        rows = (1.0 - points[:, 1]) % 1.0 * height
        columns = points[:, 0] % 1.0 * width
        texels = texture[rows.astype(int) % height, columns.astype(int) % width]
        face_means = texels.reshape(len(batch), len(weights), -1).mean(
            axis=1, dtype=np.float64
        )
        total += areas[batch] @ face_means
    return np.asarray(total / areas.sum(), np.float32)


def _sample_weights(steps: int) -> Doubles:
    """Return barycentric weights (P, 3) of the centers of small triangles.

    A triangle is divided into steps**2 equal ones, some of which point up and some
    down.
    """
    grid_i, grid_j = np.meshgrid(np.arange(steps), np.arange(steps))
    i = grid_i.reshape(-1)
    j = grid_j.reshape(-1)
    is_up = i + j < steps
    is_down = i + j < steps - 1
    b, c = (
        np.concatenate([index[is_up] + 1.0 / 3.0, index[is_down] + 2.0 / 3.0]) / steps
        for index in (i, j)
    )
    return np.stack([1.0 - b - c, b, c], axis=1)


def filtered(colors: Floats, uvs: Doubles) -> Floats:
    """Sample a repeating texture of display-referred colors in linear light.

    Interpolation is bilinear; what is transparent does not count. Arguments and result
    are those of `sampled`.
    """
    return _in_display(sampled(_in_linear(colors), uvs))


def _in_linear(colors: Floats) -> Floats:
    """Return display-referred colors (..., 3 or 4) as linear, premultiplied ones."""
    linear = srgb_to_linear(colors[..., :3])
    if colors.shape[-1] == 3:
        return linear
    opacity = colors[..., 3:]
    return np.concatenate([linear * opacity, opacity], axis=-1)


def _in_display(colors: Floats) -> Floats:
    """Return linear, premultiplied colors (..., 3 or 4) as display-referred ones."""
    linear = colors[..., :3]
    opacity = colors[..., 3:]
    if opacity.size:
        linear = linear / np.maximum(opacity, np.float32(1e-9))
    return np.concatenate([linear_to_srgb(linear), opacity], axis=-1)


def sampled(texture: Floats, uvs: Doubles) -> Floats:
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
    return looked_up(texture, u * width - 0.5, (1.0 - v) * height - 0.5)


# ---- Normal maps at other texture coordinates ----
#
# In a file the bitangent points up the image; Mitsuba's is normal x tangent, which
# points down it where texture coordinates are mirrored.

# Fraction of the surface whose mirrored texture coordinates are ignored.
FEW = 1e-3


def _unmirrored(
    soup: Soup, uvs: Doubles, maps: SurfaceMaps
) -> tuple[Soup, SurfaceMaps]:
    """Return a soup whose UVs mirror no face, and the maps for it.

    No texel is resampled. If some faces are mirrored, the maps get a second half, which
    is the first one mirrored, and these faces are moved there.

    Args:
        soup: the object.
        uvs: (F, 3, 2) in [0, 1].
        maps: maps for these UVs.
    """
    soup = replace(soup, uvs=uvs)
    normals = maps.normals
    is_mirrored = doubled_areas(uvs) < 0.0
    area = np.linalg.norm(soup.face_vectors(), axis=1)
    mirrored_fraction = float(area[is_mirrored].sum() / area.sum())
    if normals is None or mirrored_fraction < FEW:
        return soup, maps
    if 1.0 - mirrored_fraction < FEW:
        flipped = normals * np.array([1, -1, 1], np.float32) + np.array(
            [0, 1, 0], np.float32
        )
        return soup, replace(maps, normals=flipped)
    new_uvs = uvs.copy()
    new_uvs[is_mirrored, :, 0] = 2.0 - new_uvs[is_mirrored, :, 0]
    new_uvs[:, :, 0] /= 2.0
    mirrored_normals = normals[:, ::-1] * np.array([-1, 1, 1], np.float32) + np.array(
        [1, 0, 0], np.float32
    )
    emission = maps.emission
    if emission is not None and emission.shape != (1, 1, 3):
        emission = np.concatenate([emission, emission[:, ::-1]], axis=1)
    color = np.concatenate([maps.color, maps.color[:, ::-1]], axis=1)
    normals = np.concatenate([normals, mirrored_normals], axis=1)
    return replace(soup, uvs=new_uvs), SurfaceMaps(color, normals, emission)


def turned(
    texels: Floats, before: Soup, after: Doubles, face: Ints, weights: Doubles
) -> Floats:
    """Convert texels of a normal map from the tangents of old UVs to those of new UVs.

    Args:
        texels: (T, 3) of the normal map.
        before: the object with the old UVs.
        after: (F, 3, 2) the new UVs.
        face: (T,) the face that each texel is on.
        weights: (T, 3) barycentric weights of its corners.
    """
    normal = unit_vectors(np.einsum("tk,tkc->tc", weights, before.normals[face]))
    old_tangent = _tangents(before, normal, face)
    new_tangent = _tangents(replace(before, uvs=after), normal, face)
    handedness = np.sign(doubled_areas(before.uvs[face]))[:, None]
    old_bitangent = np.cross(normal, old_tangent) * handedness
    x, y, z = np.moveaxis(texels.astype(np.float64) * 2.0 - 1.0, -1, 0)
    in_plane = x[:, None] * old_tangent + y[:, None] * old_bitangent
    new_x = (in_plane * new_tangent).sum(axis=1)
    new_y = (in_plane * np.cross(normal, new_tangent)).sum(axis=1)
    bumps = np.stack([new_x, new_y, z], axis=1)
    is_valid = np.isfinite(bumps).all(axis=1, keepdims=True)
    return texels_of(np.where(is_valid, bumps, [0.0, 0.0, 1.0]))


def _tangents(soup: Soup, normal: Doubles, face: Ints) -> Doubles:
    """Return unit tangents (T, 3) along u on faces (T,), orthogonal to normals (T, 3).

    They are NaN where UVs have no area.
    """
    used, index = np.unique(face, return_inverse=True)
    a, b, c = (soup.points[soup.faces[used, k]] for k in range(3))
    uvs = soup.uvs[used]
    (_, v1) = (uvs[:, 1] - uvs[:, 0]).T
    (_, v2) = (uvs[:, 2] - uvs[:, 0]).T
    handedness = np.sign(doubled_areas(uvs))[:, None]
    tangent = ((b - a) * v2[:, None] - (c - a) * v1[:, None]) * handedness
    tangent = tangent[index.reshape(-1)]
    along_normal = normal * (tangent * normal).sum(axis=1, keepdims=True)
    return unit_vectors(tangent - along_normal)
