"""The surface of a Mitsuba shape: its base colour, which is searched, and all the rest as it is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from advsearch.scene.assets import Doubles, Floats
from advsearch.scene.color import linear_to_srgb
from advsearch.scene.mitsuba_backend.meshes import with_inner
from advsearch.scene.mitsuba_backend.variant import Plugin, mi
from advsearch.scene.parts import BASE_COLOR, plugins_in

COLORS = {
    "diffuse": "reflectance",
    "principled": "base_color",
    "principledthin": "base_color",
    "plastic": "diffuse_reflectance",
    "roughplastic": "diffuse_reflectance",
    "pplastic": "diffuse_reflectance",
}
"""Surfaces with a base colour, and its name there."""
GREY = 0.5
"""Reflectance where a surface says none: Mitsuba's default."""
PLAIN_SIZE = 8
"""Texels of each side of a base colour that is the same everywhere."""
SHARP_SIZE = 256
"""Smallest side of a base colour whose texels are not interpolated: smaller ones are repeated."""
PLACED = frozenset(("bitmap", "checkerboard"))
"""Textures that are looked up by texture coordinates, after a transform of their own."""
BOUND = PLACED | {"mesh_attribute", "normalmap", "bumpmap", "hair"}
"""What shows something else on a mesh with other texture coordinates, or without its attributes."""
ANISOTROPIC = frozenset(("alpha_u", "alpha_v", "anisotropic"))
"""Numbers of surfaces that look different along u and along v."""
OF_THE_PICTURE = frozenset(("type", "id", "bitmap", "filename", "raw", "format", "to_uv"))
"""Entries of a bitmap that the picture itself has, once it is read."""


@dataclass(frozen=True, eq=False)
class ShapeSurface:
    """What a shape looks like.

    Attributes:
        plugin: its dictionary, with `{"type": BASE_COLOR}` and how the texture is looked up (`wrap_mode`,
            `filter_type`) in the place of the base colour, if it has such a place.
        base_color: (H, W, 3) float32 display-referred, row 0 on top; `GREY` where there is no place for one.
        picture: it differs from place to place.
        to_uv: (3, 3) from the mesh's texture coordinates to those of the base colour and of `plugin`, v downwards.
        bound: the mesh must keep its own texture coordinates and attributes.
        notes: clauses about what is not as in the scene.
    """

    plugin: Plugin
    base_color: Floats
    picture: bool
    to_uv: Doubles
    bound: bool
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Color:
    """A base colour: linear (H, W, 3), and the entries that say how it is looked up."""

    linear: Floats
    options: Plugin
    to_uv: object = None


def surface_of(bsdf: Mapping[str, object]) -> ShapeSurface:
    """Take the first base colour out of a surface that is a colour, a picture or a checkerboard.

    Whatever else is looked up by texture coordinates stays in its place: where the base colour has a transform of its
    own, the others get the inverse before theirs.
    """
    base: _Color | None = None

    def without(plugin: Mapping[str, object]) -> Plugin:
        nonlocal base
        key = COLORS.get(str(plugin["type"]))
        color = None if key is None or base is not None else _color(plugin.get(key, GREY))
        if key is not None and color is not None:
            base, plugin = color, {**plugin, key: {"type": BASE_COLOR, **color.options}}
        return with_inner(plugin, without)

    surface = without(bsdf)
    color = base or _Color(np.full((PLAIN_SIZE, PLAIN_SIZE, 3), GREY, np.float32), {})
    notes, plugins = [], list(plugins_in(surface))
    types = {str(plugin["type"]) for plugin in plugins}
    if BASE_COLOR not in types:
        kinds = sorted(types & {"mesh_attribute", "volume"})
        why = f"its colour is a {kinds[0]}" if kinds else f"a {surface['type']} has none"
        notes.append(f"it has no base colour that can be searched ({why}): not for texture, patch and material")
    if not (color.linear.min() >= 0.0 and color.linear.max() <= 1.0 + 1e-4):
        notes.append("its base colour is cut to reflectances from 0 to 1")
    picture = color.linear.shape[:2] != (PLAIN_SIZE, PLAIN_SIZE) or bool(np.ptp(color.linear, axis=(0, 1)).any())
    bound = any(plugin["type"] in BOUND or ANISOTROPIC & set(plugin) for plugin in plugins)
    to_uv = np.eye(3) if color.to_uv is None else uv_matrix(color.to_uv)
    # The mesh's texture coordinates can be transformed where that can be undone, and the tangents along u stay
    tangents = types & {"normalmap", "hair"} or any(ANISOTROPIC & set(plugin) for plugin in plugins)
    stays = not tangents or (to_uv[1, 0] == 0.0 and to_uv[0, 0] > 0.0)
    if not (abs(np.linalg.det(to_uv)) > 1e-12 and stays):
        surface, to_uv = _with_transform(surface, to_uv, BASE_COLOR), np.eye(3)
    elif not np.array_equal(to_uv, np.eye(3)):
        surface = _with_transform(surface, np.asarray(np.linalg.inv(to_uv), np.float64), *PLACED)
    base_color = linear_to_srgb(np.clip(color.linear, 0.0, 1.0))
    return ShapeSurface(surface, base_color, picture, to_uv, bound, tuple(notes))


def _with_transform(plugin: Mapping[str, object], before: Doubles, *kinds: str) -> Plugin:
    """Return a plugin whose textures of some kinds take texture coordinates after a transform (3, 3) as well."""
    moved = with_inner(plugin, lambda inner: _with_transform(inner, before, *kinds))
    if moved["type"] in kinds:
        whole = np.eye(4)
        whole[np.ix_((0, 1, 3), (0, 1, 3))] = uv_matrix(plugin.get("to_uv", np.eye(3))) @ before
        moved["to_uv"] = whole
    return moved


def uv_matrix(value: object) -> Doubles:
    """Return a transform of texture coordinates (3, 3), of one with (4, 4) what Mitsuba takes of it."""
    matrix = np.asarray(value, dtype=np.float64)
    return matrix if matrix.shape == (3, 3) else matrix[np.ix_((0, 1, 3), (0, 1, 3))]


def _color(value: object) -> _Color | None:
    """A constant, a picture or a checkerboard as a base colour."""
    plain = constant(value)
    if plain is not None:
        return _Color(np.broadcast_to(plain, (PLAIN_SIZE, PLAIN_SIZE, 3)), {})
    if not isinstance(value, Mapping):
        return None
    if value["type"] == "checkerboard":
        dark, light = constant(value.get("color0", 0.4)), constant(value.get("color1", 0.2))
        rest = set(value) - {"type", "id", "color0", "color1", "to_uv"}
        if dark is None or light is None or rest:
            return None
        board = np.array([[dark, light], [light, dark]], np.float32)
        return _Color(_repeated(board), {"filter_type": "nearest"}, value.get("to_uv"))
    picture = _pixels(value) if value["type"] == "bitmap" else None
    if picture is None:
        return None
    options = {key: entry for key, entry in value.items() if key not in OF_THE_PICTURE}
    sharp = options.get("filter_type") == "nearest"
    return _Color(_repeated(picture) if sharp else picture, options, value.get("to_uv"))


def _repeated(picture: Floats) -> Floats:
    """Repeat texels so that none is blurred where a control takes the picture in its own size."""
    down, across = (-(-SHARP_SIZE // side) for side in picture.shape[:2])
    return picture.repeat(down, axis=0).repeat(across, axis=1)


def _pixels(value: Mapping[str, object]) -> Floats | None:
    """The linear values (H, W, 3) of a bitmap; None where it is none that is read here."""
    picture = value.get("bitmap")
    if isinstance(picture, np.ndarray):
        picture = picture[:, :, None] if picture.ndim == 2 else picture
        picture = picture[:, :, :1] if picture.shape[2] == 2 else picture[:, :, :3]
        return np.broadcast_to(picture, (*picture.shape[:2], 3)).astype(np.float32)
    if picture is None and "filename" not in value:
        return None
    try:
        bitmap = mi.Bitmap(str(value["filename"])) if picture is None else mi.Bitmap(picture)
    except (RuntimeError, TypeError):
        return None  # Mitsuba says why, once it is asked for the scene
    if value.get("raw"):
        bitmap.set_srgb_gamma(False)
    return np.array(bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False), dtype=np.float32)


def constant(value: object) -> Floats | None:
    """A colour (3,) that is the same everywhere; None of anything else."""
    if isinstance(value, Mapping):
        value = value.get("value") if value["type"] in ("rgb", "uniform", "spectrum", "srgb") else None
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        value = [float(value)] * 3
    if not isinstance(value, (list, tuple, np.ndarray)) or np.shape(value) != (3,):
        return None
    try:
        return np.array(value, dtype=np.float32)
    except (TypeError, ValueError):  # pairs of wavelength and value
        return None
