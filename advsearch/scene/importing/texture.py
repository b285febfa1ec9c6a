"""The maps of an imported object, of its base colour and its normals, and texture
coordinates that fit them.

The file's own UVs and textures are kept where they can be used as they are. Otherwise
the mesh is unwrapped with xatlas and whatever the file has (repeating textures, several
materials, vertex colours) is baked into one texture of a kind.
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

# width and height, in texels, of the base colour map of an object of one colour
PLAIN_SIZE = 8
BAKED_SIZE = 512  # width and height of the smallest base colour map that is baked
_SLACK = 1e-4  # how far UVs may overstep [0, 1] and still be clipped
_SQUASHED = 0.05  # share of the surface that may have no area in UV space
_CRAMPED = 0.02  # share of the unit square that UVs must cover in all
_WINDOW = 1.5  # how many textures wide and high UVs may be and still keep their layout
_BORDER = 2.0  # texels outside a chart up to which it emits light: filtering needs them
# share of the texels which may lie on several faces where each should have its own
_SHARED = 0.005
# how many times more texels a picture may have than a baked texture before that is said
_FINER = 1.5
# places at which a mean is taken, and steps along the side of a face at most
_LOOKS = 1 << 18
_FINEST = 256
_FILLED = 0.5  # share of an atlas that its charts fill, about


@dataclass(frozen=True, eq=False)
class SurfaceMaps:
    """What an object looks like by its texture coordinates; row 0 is on top, at v =
    1.
    """

    # (H, W, 3) display-referred base colour in [0, 1]; (H, W, 4) with the opacity of
    # what has one
    color: Floats
    normals: Floats | None = None  # (H', W', 3) as `ImportedSurface.normal_map`
    # (H", W", 3) linear radiance; (1, 1, 3) where it is the same everywhere
    emission: Floats | None = None


def textured(
    soup: Soup, surfaces: Sequence[ImportedSurface], notes: Notes
) -> tuple[Soup, SurfaceMaps]:
    """Return a repaired soup with UVs in [0, 1] on every corner, and the maps that fit
    them and the surface of each part.
    """
    used = list(
        {
            id(surfaces[number]): surfaces[number] for number in np.unique(soup.part)
        }.values()
    )
    first = used[0]
    uniform = all(surface.same_maps(used[0]) for surface in used)
    one_factor = bool((soup.colors == soup.colors[0, 0]).all())
    colored = uniform and one_factor
    twice = False
    material = by_material(soup, surfaces)[1]
    if colored and not first.pictures:
        kept = _usable(soup, soup.uvs) and not _overlap(soup.uvs, material)
        soup = (
            replace(soup, uvs=np.clip(soup.uvs, 0.0, 1.0))
            if kept
            else unwrapped(soup, material)
        )
        return soup, SurfaceMaps(_of_one_color(soup, first), None, first.emission)
    if (
        colored
        and (first.texture is None or soup.colors.min() == 1.0)
        and np.isfinite(soup.uvs).all()
    ):
        uvs, pictures = _windowed(
            _into_unit_square(soup), first.pictures, first.texture
        )
        usable = _usable(soup, uvs)
        twice = usable and _lit_twice(uvs, first, pictures)
        if usable and not twice:
            cut = first.with_pictures(pictures)
            color = _of_one_color(soup, first) if cut.texture is None else cut.texture
            return _unmirrored(
                soup,
                np.clip(uvs, 0.0, 1.0),
                SurfaceMaps(color, cut.normal_map, cut.emission),
            )
    fresh = unwrapped(soup, material)
    maps = baked(fresh.uvs, soup, surfaces)
    shared = (
        "several faces share a texture that emits light; it was unwrapped anew "
        "and its texture resampled"
    )
    size = len(maps.color)
    why = shared if twice else _why(soup, used, uniform, one_factor)
    times = _texels(soup, surfaces) / (size * size * _FILLED)
    fewer = (
        ""
        if times < _FINER
        else (f", {times:.0f} times fewer than its pictures have there")
    )
    notes.say(f"{why} ({size} x {size} texels{fewer})")
    return fresh, maps


def by_material(
    soup: Soup, surfaces: Sequence[ImportedSurface]
) -> tuple[list[str], Ints]:
    """Return the names of materials, "" for none, and the number (F,) of each face's
    among them.
    """
    numbers = {
        name: number
        for number, name in enumerate(
            dict.fromkeys(surface.name for surface in surfaces)
        )
    }
    return list(numbers), np.array([numbers[surface.name] for surface in surfaces])[
        soup.part
    ]


def _overlap(uvs: Doubles, material: Ints) -> bool:
    if material.min() == material.max():
        return False
    side = BAKED_SIZE
    face, row, column, _ = pixels_in(uvs * side - 0.5, (side, side), tolerance=-1e-6)
    least = np.full(side * side, len(uvs))
    most = np.full(side * side, -1)
    np.minimum.at(least, row * side + column, material[face])
    np.maximum.at(most, row * side + column, material[face])
    return bool((most > least).sum() > _SHARED * (most >= 0).sum())


def _of_one_color(soup: Soup, surface: ImportedSurface) -> Floats:
    color = (
        _plain(surface)
        if soup.colors.min() == 1.0
        else _tinted(_plain(surface), soup.colors[0, 0])
    )
    return np.full((PLAIN_SIZE, PLAIN_SIZE, len(color)), color, dtype=np.float32)


def _lit_twice(
    uvs: Doubles, surface: ImportedSurface, pictures: Sequence[Floats]
) -> bool:
    """Whether a texel that emits light lies on several faces: Mitsuba would send light
    from one of them only.
    """
    if surface.emission is None or surface.emission.shape == (1, 1, 3):
        return False
    lit = pictures[-1].any(axis=2)
    height, width = lit.shape
    _, rows, columns, _ = pixels_in(
        _in_texels(uvs, (height, width)), (height, width), tolerance=-1e-6
    )
    count = np.bincount(rows * width + columns, minlength=height * width).reshape(
        height, width
    )[lit]
    return bool((count > 1).sum() > _SHARED * max(1, len(count)))


def _in_texels(uvs: Doubles, shape: tuple[int, int]) -> Doubles:
    return np.stack(
        [uvs[:, :, 0] * shape[1] - 0.5, (1.0 - uvs[:, :, 1]) * shape[0] - 0.5], axis=2
    )


def _why(
    soup: Soup, used: Sequence[ImportedSurface], uniform: bool, one_factor: bool
) -> str:
    if not uniform:
        count = len({surface.name or id(surface) for surface in used})
        what = (
            f"the colours of its {count} materials"
            if count > 1
            else "the pictures of its material"
        )
        return f"{what} were baked into one texture"
    if not one_factor or soup.colors.min() < 1.0:
        return "its vertex or face colours were baked into a texture"
    if not np.isfinite(soup.uvs).all():
        mean = (
            "the texture's mean colour is used"
            if used[0].texture is not None
            else "its normal map is left out"
        )
        return f"it has a texture but lacks texture coordinates; where it does, {mean}"
    return (
        "its texture coordinates repeat or hardly use the texture; it was "
        "unwrapped "
        "anew and its texture resampled"
    )


def _plain(surface: ImportedSurface) -> Floats:
    return (
        np.full(3, NEUTRAL, dtype=np.float32)
        if surface.color is None
        else surface.color
    )


def _tinted(
    color: npt.NDArray[np.floating], factor: npt.NDArray[np.floating]
) -> Floats:
    """Multiply display-referred colours (..., 3 or 4) by linear factors (..., 3);
    opacity stays.
    """
    color = np.asarray(color, np.float32)
    product = srgb_to_linear(color[..., :3]) * factor
    return np.concatenate(
        [linear_to_srgb(product.astype(np.float32)), color[..., 3:]], axis=-1
    )


# --- the file's UVs ----------------------------------------


def _usable(soup: Soup, uvs: Doubles) -> bool:
    if not np.isfinite(uvs).all() or uvs.min() < -_SLACK or uvs.max() > 1.0 + _SLACK:
        return False
    flat = np.abs(doubled_areas(uvs)) / 2.0
    surface = np.linalg.norm(soup.face_vectors(), axis=1)
    return bool(
        surface[flat < 1e-12].sum() <= _SQUASHED * surface.sum()
        and flat.sum() >= _CRAMPED
    )


def _into_unit_square(soup: Soup) -> Doubles:
    """Move each chart by whole textures so that it starts in the unit square; a
    repeating texture looks the same.
    """
    corners = np.column_stack([soup.faces.reshape(-1), soup.uvs.reshape(-1, 2)])
    _, vertex = np.unique(corners, axis=0, return_inverse=True)
    vertex = vertex.reshape(-1, 3)
    a = np.concatenate([vertex[:, 0], vertex[:, 1]])
    b = np.concatenate([vertex[:, 1], vertex[:, 2]])
    chart = connected(int(vertex.max()) + 1, a, b)
    low = np.full((int(chart.max()) + 1, 2), np.inf)
    np.minimum.at(low, chart[vertex.reshape(-1)], soup.uvs.reshape(-1, 2))
    moved: Doubles = soup.uvs - np.floor(low + _SLACK)[chart[vertex]]
    return moved


def _windowed(
    uvs: Doubles, pictures: Sequence[Floats], colors: Floats | None
) -> tuple[Doubles, Sequence[Floats]]:
    """Cut pictures to the window that UVs span where they overstep the unit square a
    little or use a corner of it; the layout of the charts stays. Windows larger than
    `_WINDOW` textures are left alone: there the textures repeat.
    """
    texel = np.max(
        [1.0 / np.array(picture.shape[1::-1]) for picture in pictures], axis=0
    )
    low = uvs.min(axis=(0, 1)) - texel
    high = uvs.max(axis=(0, 1)) + texel
    size = high - low
    inside = (
        low.min() >= -_SLACK - texel.max() and high.max() <= 1.0 + _SLACK + texel.max()
    )
    if size.max() > _WINDOW or (
        inside and np.abs(doubled_areas(uvs)).sum() / 2.0 >= _CRAMPED
    ):
        return uvs, pictures
    cut = []
    for picture in pictures:  # with texels of the same size
        width, height = np.clip(
            np.ceil(size * np.array(picture.shape[1::-1])), 1, TEXTURE_LIMIT
        ).astype(int)
        columns = low[0] + (np.arange(width) + 0.5) / width * size[0]
        rows = high[1] - (np.arange(height) + 0.5) / height * size[1]
        grid = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
        look_up = filtered if picture is colors else sampled
        cut.append(look_up(picture, grid).reshape(height, width, -1))
    return (uvs - low) / size, cut


# --- baking ----------------------------------------


def baked(uvs: Doubles, soup: Soup, surfaces: Sequence[ImportedSurface]) -> SurfaceMaps:
    """Paint the colours and the normals of a soup, with the file's UVs (NaN where it
    has none), and of the surface of each part into maps (N, N, ...) for new UVs (F, 3,
    2) in [0, 1] without overlaps, with room for the texels that the object shows.
    Texels outside every chart repeat the nearest one inside, so that filtering finds no
    seam.
    """
    size = BAKED_SIZE
    texels = _texels(soup, surfaces)
    while size < TEXTURE_LIMIT and size * size * _FILLED < texels:
        size *= 2
    face, rows, columns, weights = pixels_in(
        _in_texels(uvs, (size, size)), (size, size), tolerance=1e-9
    )
    bases = [
        _plain(surface) if surface.texture is None else surface.texture
        for surface in surfaces
    ]
    through = any(base.shape[-1] == 4 for base in bases)
    image = np.ones((size, size, 3 + through), np.float32)
    inside = np.zeros((size, size), np.bool_)
    bumpy = any(surface.normal_map is not None for surface in surfaces)
    glows = any(surface.emission is not None for surface in surfaces)
    normals = np.full((size, size, 3), FLAT) if bumpy else None
    emission = np.zeros((size, size, 3), np.float32) if glows else None
    factor = np.einsum("tk,tkc->tc", weights, soup.colors[face])
    for surface, here in zip(surfaces, grouped(soup.part[face]), strict=False):
        if not len(here):  # no texel at all
            continue
        y = rows[here]
        x = columns[here]
        at = np.einsum("tk,tkc->tc", weights[here], soup.uvs[face[here]])
        color = _looked_up(surface, at, soup, surfaces)
        image[y, x, : color.shape[1]] = _tinted(color, factor[here])
        if (
            normals is not None
            and surface.normal_map is not None
            and np.isfinite(at).all()
        ):
            normals[y, x] = turned(
                sampled(surface.normal_map, at), soup, uvs, face[here], weights[here]
            )
        if (
            emission is not None
            and surface.emission is not None
            and np.isfinite(at).all()
        ):
            emission[y, x] = sampled(surface.emission, at)
    inside[rows, columns] = True
    away, nearest = distance_transform_edt(~inside, return_indices=True)
    whole = tuple(nearest)
    if emission is not None:
        emission = emission[whole] * (away < _BORDER)[:, :, None]
    return SurfaceMaps(
        image[whole], None if normals is None else normals[whole], emission
    )


def _looked_up(
    surface: ImportedSurface,
    at: Doubles,
    soup: Soup,
    surfaces: Sequence[ImportedSurface],
) -> Floats:
    """Return the base colour (T, 3 or 4) of a surface at UVs (T, 2); where it has none,
    the mean over all faces that show its texture.
    """
    if surface.texture is not None and np.isfinite(at).all():
        return filtered(surface.texture, at)
    color = _plain(surface)
    if surface.texture is not None:
        mine = np.array([other.texture is surface.texture for other in surfaces])[
            soup.part
        ]
        areas = np.linalg.norm(soup.face_vectors(), axis=1)[mine]
        color = _in_display(
            mean_over(_in_linear(surface.texture), soup.uvs[mine], areas)
        )
    return np.broadcast_to(color[None], (len(at), len(color)))


def _texels(soup: Soup, surfaces: Sequence[ImportedSurface]) -> float:
    texels = 0.0
    areas = np.nan_to_num(np.abs(doubled_areas(soup.uvs)) / 2.0)
    for number, area in enumerate(np.bincount(soup.part, areas)):
        sizes = (
            picture.shape[0] * picture.shape[1] for picture in surfaces[number].pictures
        )
        texels += float(area) * max(sizes, default=0)
    return texels


def mean_over(texture: Floats, uvs: Doubles, areas: Doubles) -> Floats:
    """Return the mean (C,) float32 of a texture (H, W, C) over faces with these UVs (F,
    3, 2), NaN where one has none, and areas (F,): what none of them shows does not
    count, unless no face has both.
    """
    known = np.isfinite(uvs).all(axis=(1, 2)) & (areas > 0.0)
    if not known.any():
        return np.asarray(texture.mean(axis=(0, 1), dtype=np.float64), np.float32)
    uvs = uvs[known]
    areas = areas[known]
    steps = int(np.clip(np.sqrt(_LOOKS / len(areas)), 1, _FINEST))
    i, j = (
        index.reshape(-1) for index in np.meshgrid(np.arange(steps), np.arange(steps))
    )
    up = i + j < steps  # the two kinds of small triangles, by their middles
    down = i + j < steps - 1
    b, c = (
        np.concatenate([index[up] + 1.0 / 3.0, index[down] + 2.0 / 3.0]) / steps
        for index in (i, j)
    )
    weights = np.stack([1.0 - b - c, b, c], axis=1)
    total = np.zeros(texture.shape[2])
    for some in np.array_split(
        np.arange(len(areas)), -(-len(areas) * len(b) // _LOOKS)
    ):
        places = np.einsum("pk,fkc->fpc", weights, uvs[some]).reshape(-1, 2)
        height, width = texture.shape[:2]
        rows = (1.0 - places[:, 1]) % 1.0 * height
        columns = places[:, 0] % 1.0 * width
        texels = texture[rows.astype(int) % height, columns.astype(int) % width]
        total += areas[some] @ texels.reshape(len(some), len(b), -1).mean(
            axis=1, dtype=np.float64
        )
    return np.asarray(total / areas.sum(), np.float32)


def filtered(colors: Floats, uvs: Doubles) -> Floats:
    """Look a repeating texture of display-referred colours up with bilinear
    interpolation in linear light; what is transparent does not count. Arguments and
    result as for `sampled`.
    """
    return _in_display(sampled(_in_linear(colors), uvs))


def _in_linear(colors: Floats) -> Floats:
    """Return display-referred colours (..., 3 or 4) as linear ones, times their opacity
    where there is one.
    """
    linear = srgb_to_linear(colors[..., :3])
    return (
        linear
        if colors.shape[-1] == 3
        else np.concatenate([linear * colors[..., 3:], colors[..., 3:]], axis=-1)
    )


def _in_display(colors: Floats) -> Floats:
    linear = colors[..., :3]
    opacity = colors[..., 3:]
    if opacity.size:
        linear = linear / np.maximum(opacity, np.float32(1e-9))
    return np.concatenate([linear_to_srgb(linear), opacity], axis=-1)


def sampled(texture: Floats, uvs: Doubles) -> Floats:
    """Look a repeating texture (H, W, C) float32 up at any finite UVs (T, 2), with
    bilinear interpolation of its values, as they are: (T, C) float32.
    """
    height, width = texture.shape[:2]
    u, v = (uvs % 1.0).T  # first, since a huge number times a width is infinite
    return looked_up(texture, u * width - 0.5, (1.0 - v) * height - 0.5)


# ---- normal maps at other texture coordinates ---------------------------
#
# In a file the bitangent runs up the picture; Mitsuba's is normal x tangent, which runs
# down it where texture coordinates are mirrored.

# share of the surface whose texture coordinates may be mirrored without anything being
# done about it
FEW = 1e-3


def _unmirrored(
    soup: Soup, uvs: Doubles, maps: SurfaceMaps
) -> tuple[Soup, SurfaceMaps]:
    """Return a soup whose texture coordinates mirror no face, of such (F, 3, 2) in [0,
    1], and the maps for them; no texel is resampled. Where some faces are mirrored, the
    maps get a second half, which is the first one mirrored, and there these faces go.
    """
    soup = replace(soup, uvs=uvs)
    normals = maps.normals
    over = doubled_areas(uvs) < 0.0
    area = np.linalg.norm(soup.face_vectors(), axis=1)
    share = float(area[over].sum() / area.sum())
    if normals is None or share < FEW:
        return soup, maps
    if 1.0 - share < FEW:
        turned_over = normals * np.array([1, -1, 1], np.float32) + np.array(
            [0, 1, 0], np.float32
        )
        return soup, replace(maps, normals=turned_over)
    placed = uvs.copy()
    color = maps.color
    glow = maps.emission
    placed[over, :, 0] = 2.0 - placed[over, :, 0]
    placed[:, :, 0] /= 2.0
    other = normals[:, ::-1] * np.array([-1, 1, 1], np.float32) + np.array(
        [1, 0, 0], np.float32
    )
    if glow is not None and glow.shape != (1, 1, 3):
        glow = np.concatenate([glow, glow[:, ::-1]], axis=1)
    color = np.concatenate([color, color[:, ::-1]], axis=1)
    normals = np.concatenate([normals, other], axis=1)
    return replace(soup, uvs=placed), SurfaceMaps(color, normals, glow)


def turned(
    texels: Floats, before: Soup, after: Doubles, face: Ints, weights: Doubles
) -> Floats:
    """Return texels (T, 3) of a normal map, which lie on faces (T,) with these weights
    (T, 3) of their corners, for other texture coordinates (F, 3, 2) than those of the
    soup.
    """
    normal = unit_vectors(np.einsum("tk,tkc->tc", weights, before.normals[face]))
    old, new = (
        _tangents(soup, normal, face) for soup in (before, replace(before, uvs=after))
    )
    up = np.cross(normal, old) * np.sign(doubled_areas(before.uvs[face]))[:, None]
    x, y, z = np.moveaxis(texels.astype(np.float64) * 2.0 - 1.0, -1, 0)
    way = x[:, None] * old + y[:, None] * up
    bumps = np.stack(
        [(way * new).sum(axis=1), (way * np.cross(normal, new)).sum(axis=1), z], axis=1
    )
    return texels_of(
        np.where(np.isfinite(bumps).all(axis=1, keepdims=True), bumps, [0.0, 0.0, 1.0])
    )


def _tangents(soup: Soup, normal: Doubles, face: Ints) -> Doubles:
    """Unit directions (T, 3) along u in the plane across the normals (T, 3); NaN where
    there is none.
    """
    used, at = np.unique(face, return_inverse=True)
    a, b, c = (soup.points[soup.faces[used, k]] for k in range(3))
    uvs = soup.uvs[used]
    (_, v1) = (uvs[:, 1] - uvs[:, 0]).T
    (_, v2) = (uvs[:, 2] - uvs[:, 0]).T
    along = ((b - a) * v2[:, None] - (c - a) * v1[:, None]) * np.sign(
        doubled_areas(uvs)
    )[:, None]
    along = along[at.reshape(-1)]
    return unit_vectors(along - normal * (along * normal).sum(axis=1, keepdims=True))
