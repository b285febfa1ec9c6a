"""Shapes of a Mitsuba scene as triangles, and those that make up its haze."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from advsearch.errors import InputError
from advsearch.scene.assets import Doubles, Floats, Ints, Mesh, face_vectors
from advsearch.scene.color import linear_to_srgb
from advsearch.scene.mitsuba_backend.meshes import (
    FACES,
    NORMALS,
    POSITIONS,
    TEXCOORDS,
    loadable,
    with_inner,
)
from advsearch.scene.mitsuba_backend.variant import Plugin, fewer_warnings, mi
from advsearch.scene.parts import BASE_COLOR, HazePart, plugins_in

Buffers = tuple[Doubles, Ints, Doubles | None, Doubles | None, dict[str, Floats]]
"""Vertices, faces, normals and texture coordinates of a mesh, and its attributes, (V or
F, n) by their names.
"""
# texture coordinates of a face that has none, as Mitsuba takes them
BARE = ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))
SECTIONS = 64  # sides of a round shape
# shapes of which Mitsuba has no triangles
SOLIDS = ("rectangle", "sphere", "cylinder", "disk")
# the shapes that can be the object
MESHES = (*SOLIDS, "cube", "obj", "ply", "serialized")
OF_A_MESH = frozenset(  # entries of a mesh that are no surface, light or medium
    (
        "type",
        "filename",
        "to_world",
        "face_normals",
        "flip_tex_coords",
        "flip_normals",
        "shape_index",
    )
)
OF_A_SHAPE = OF_A_MESH | {
    "id",
    "radius",
    "center",
    "p0",
    "p1",
    "sampling_weight",
    "silhouette_sampling_weight",
}
"""The same of any shape."""


def mesh_of(shape: Mapping[str, object], name: str) -> tuple[Mesh, bool]:
    """Return the triangles of a shape's dictionary in its scene, with the file's own
    texture coordinates, which may leave the unit square, and attributes; and whether it
    has such coordinates: else they are `BARE` on each face. Its name is for errors.

    Where Mitsuba has a mesh, it is Mitsuba's own; round shapes become triangles here.
    Of a mesh with `face_normals`, or without texture coordinates, every face has
    vertices of its own. A shape without triangles is refused.
    """
    kind = str(shape["type"])
    if kind not in MESHES:
        raise InputError(
            f"object {name}: a {kind} cannot be moved; expected a shape "
            f"of {', '.join(MESHES)}"
        )
    vertices, faces, normals, uvs, attributes = (
        _solid(kind, shape, name) if kind in SOLIDS else _loaded(shape, name)
    )
    if not np.isfinite(vertices).all():
        raise InputError(
            f"object {name}: expected finite vertices, got NaN or "
            "infinite ones; repair the mesh"
        )

    def of(some: Ints) -> dict[str, Floats]:
        return {
            key: values[some] if key.startswith("vertex_") else values
            for key, values in attributes.items()
        }

    own_uvs = uvs is not None
    flat = normals is None or bool(shape.get("face_normals"))
    if uvs is None or normals is None or flat:
        corners = faces.reshape(-1)
        attributes = of(corners)
        vertices = vertices[corners]
        faces = np.arange(len(corners)).reshape(-1, 3)
        faced = _unit(face_vectors(vertices[faces])).repeat(3, axis=0)
        normals = faced if flat or normals is None else normals[corners]
        uvs = np.tile(BARE, (len(faces), 1)) if uvs is None else uvs[corners]
    used, index = np.unique(faces, return_inverse=True)
    faces = index.reshape(-1, 3)
    vertices = vertices[used]
    uvs = uvs[used] * (1.0, -1.0) + (0.0, 1.0)
    normals = np.nan_to_num(normals)[used] * (
        -1.0 if shape.get("flip_normals") else 1.0
    )
    if np.einsum("fk,fck->", face_vectors(vertices[faces]), normals[faces]) < 0.0:
        # Mitsuba shades by the normals, whichever way faces are wound
        faces = faces[:, ::-1]
    places, facing, texture = (
        values.astype(np.float32) for values in (vertices, normals, uvs)
    )
    return Mesh(
        places, np.ascontiguousarray(faces, np.uint32), facing, texture, of(used)
    ), own_uvs


def _loaded(shape: Mapping[str, object], name: str) -> Buffers:
    try:
        with fewer_warnings():
            loaded = mi.load_dict(
                loadable(
                    {key: value for key, value in shape.items() if key in OF_A_MESH}
                )
            )
    except RuntimeError as error:
        raise InputError(
            f"object {name}: Mitsuba refuses the shape: {error}; change it there"
        ) from error
    parameters = mi.traverse(loaded)

    def rows(key: str, width: int) -> Doubles:
        return np.array(parameters[key], np.float64).reshape(-1, width)

    vertices = rows(POSITIONS, 3)
    faces = np.array(parameters[FACES], np.int64).reshape(-1, 3)
    if not len(faces):
        raise InputError(
            f"object {name}: expected a mesh with faces, got none; export triangles"
        )
    normals = rows(NORMALS, 3) if loaded.has_vertex_normals() else None
    uvs = rows(TEXCOORDS, 2) if loaded.has_vertex_texcoords() else None
    attributes: dict[str, Floats] = {}
    for key in parameters.keys():
        count = {"vertex": len(vertices), "face": len(faces)}.get(key.split("_")[0], 0)
        if count and key not in (POSITIONS, NORMALS, TEXCOORDS) and "." not in key:
            attributes[str(key)] = np.array(parameters[key], np.float32).reshape(
                count, -1
            )
    return vertices, faces, normals, uvs, attributes


def _unit(vectors: Doubles) -> Doubles:
    return np.asarray(
        vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-30)
    )


def _solid(kind: str, shape: Mapping[str, object], name: str) -> Buffers:
    local = np.eye(4)
    radius = float(np.asarray(shape.get("radius", 1.0), np.float64))
    turn = np.linspace(0.0, 1.0, SECTIONS + 1)
    normals = None
    if kind == "sphere":
        uvs, faces = _grid(turn, turn[::2])
        down = np.pi * uvs[:, 1]
        vertices = normals = np.stack(
            [*(np.sin(down) * _circle(uvs[:, 0])), np.cos(down)], axis=1
        )
        local[:3, :3] *= radius
        local[:3, 3] = np.asarray(shape.get("center", (0.0, 0.0, 0.0)), np.float64)
    elif kind == "cylinder":  # open at both ends, as Mitsuba's
        uvs, faces = _grid(turn, np.array([0.0, 1.0]))
        vertices = np.stack([*_circle(uvs[:, 0]), uvs[:, 1]], axis=1)
        normals = vertices * (1.0, 1.0, 0.0)
        low, high = (
            np.asarray(shape.get(end, (0.0, 0.0, z)), np.float64)
            for end, z in (("p0", 0.0), ("p1", 1.0))
        )
        length = float(np.linalg.norm(high - low))
        x, y, z = along = (high - low) / max(length, 1e-30)
        sign = np.copysign(1.0, z)
        # axes as of Mitsuba's `coordinate_system` (Duff et al. 2017), which has float32
        # alone
        a = -1.0 / (sign + z)
        aside = np.array([1.0 + sign * x * x * a, sign * x * y * a, -sign * x])
        across = np.array([x * y * a, sign + y * y * a, -y])
        local[:3] = np.stack(
            [aside * radius, across * radius, along * length, low], axis=1
        )
    elif kind == "disk":
        uvs, faces = _grid(turn[::8], turn)
        vertices = np.stack(
            [*(uvs[:, 0] * _circle(uvs[:, 1])), np.zeros(len(uvs))], axis=1
        )
    else:
        uvs, faces = _grid(np.array([0.0, 1.0]), np.array([0.0, 1.0]))
        vertices = np.column_stack([uvs * 2.0 - 1.0, np.zeros(4)])
    normals = (
        np.tile((0.0, 0.0, 1.0), (len(vertices), 1)) if normals is None else normals
    )
    faces = faces[np.linalg.norm(face_vectors(vertices[faces]), axis=1) > 1e-9]
    matrix = pose_of(shape) @ local
    if not abs(np.linalg.det(matrix[:3, :3])) > 0.0:
        raise InputError(
            f"object {name}: expected a {kind} of some size, got one "
            "without extent; change its numbers"
        )
    normals = _unit(normals @ np.linalg.inv(matrix[:3, :3]))
    return vertices @ matrix[:3, :3].T + matrix[:3, 3], faces, normals, uvs, {}


def _grid(u: Doubles, v: Doubles) -> tuple[Doubles, Ints]:
    points = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    first = (np.arange(len(v) - 1)[:, None] * len(u) + np.arange(len(u) - 1)).reshape(
        -1
    )
    above = first + len(u)
    lower = np.stack([first, first + 1, above + 1], axis=1)
    upper = np.stack([first, above + 1, above], axis=1)
    return points, np.concatenate([lower, upper])


def _circle(share: Doubles) -> Doubles:
    return np.asarray([np.cos(2.0 * np.pi * share), np.sin(2.0 * np.pi * share)])


def pose_of(plugin: Mapping[str, object]) -> Doubles:
    return np.asarray(plugin.get("to_world", np.eye(4)), dtype=np.float64)


Plugins = Mapping[str, Mapping[str, object]]
# of a haze: largest extinction per object size, and least share of light scattered
MOST = 2.0
DARKEST = 1e-3
# share of its radius by which the ball's middle may lie beside the object's; its edge
# is far off
OFF = 0.05
_OF_BALL = {"type", "id", "radius", "center", "to_world", "bsdf", "interior"}
_OF_MEDIUM = {"type", "id", "sigma_t", "albedo", "scale", "phase"}


def haze_in(named: Plugins, matrix: Doubles) -> tuple[HazePart, frozenset[str]] | None:
    """Return the haze of a scene's plugins and the names of those that it is made of;
    None where there is none. `matrix` (4, 4) goes from the scene to the object's
    coordinates, with one scale for all directions.

    It is one grey medium in a ball that the camera stands in: Mitsuba's `prbvolpath`
    sees nothing of it up to the first surface, so such a scene is rendered as one with
    a `HazePart`. All other media stay as they are.
    """
    inside = {_reference(plugin.get("medium")) for plugin in named.values()} - {None}
    spheres = {
        name: plugin for name, plugin in named.items() if plugin["type"] == "sphere"
    }
    balls = [
        name
        for name, sphere in spheres.items()
        if _reference(sphere.get("interior")) in inside
    ]
    media = [
        name
        for name, plugin in named.items()
        if plugin["type"] in ("homogeneous", "heterogeneous")
    ]
    if len(inside) != 1 or len(balls) != 1 or len(media) != 1:
        return None
    ball = named[balls[0]]
    medium = named[media[0]]
    bsdf = ball.get("bsdf")
    phase = medium.get("phase", {"type": "isotropic"})
    plain = (
        set(ball) <= _OF_BALL
        and set(medium) <= _OF_MEDIUM
        and medium["type"] == "homogeneous"
    )
    if (
        not plain
        or bsdf != {"type": "null"}
        or phase != {"type": "isotropic"}
        or inside != {media[0]}
    ):
        return None
    across = _numbers(ball.get("radius", 1.0))
    middle = _numbers(ball.get("center", np.zeros(3)))
    density = _numbers(medium.get("sigma_t", 1.0))
    albedo = _numbers(medium.get("albedo", 0.75))
    scale = _numbers(medium.get("scale", 1.0))
    pose = matrix @ pose_of(ball)
    place = pose @ np.append(np.broadcast_to(middle, (3,)), 1.0)
    radius = float(across[0]) * float(np.cbrt(abs(np.linalg.det(pose[:3, :3]))))
    size = float(np.cbrt(abs(np.linalg.det(matrix[:3, :3]))))
    extinction = density * scale / size
    (red, green, blue) = np.broadcast_to(albedo, (3,)).tolist()
    grey = 0.0 < float(extinction.min()) == float(extinction.max()) <= MOST
    if not (grey and DARKEST <= min(red, green, blue) and max(red, green, blue) <= 1.0):
        return None
    if not (radius > 0.0 and float(np.linalg.norm(place[:3])) <= OFF * radius):
        return None
    return HazePart(
        balls[0], radius, float(extinction[0]), (red, green, blue)
    ), frozenset((balls[0], media[0]))


def _reference(plugin: object) -> str | None:
    return (
        str(plugin["id"])
        if isinstance(plugin, Mapping) and plugin.get("type") == "ref"
        else None
    )


def _numbers(value: object) -> Doubles:
    """Return a number (1,), or the three of a colour; NaN of anything else."""
    if isinstance(value, Mapping):
        value = (
            value.get("value")
            if value.get("type") in ("rgb", "uniform", "spectrum", "srgb")
            else None
        )
    try:
        numbers = np.atleast_1d(
            np.asarray(None if isinstance(value, (str, bool)) else value, np.float64)
        )
    except (TypeError, ValueError):  # such as pairs of wavelength and value
        return np.full(1, np.nan)
    return (
        numbers
        if numbers.shape in ((1,), (3,)) and np.isfinite(numbers).all()
        else np.full(1, np.nan)
    )


# ---- The surface of a Mitsuba shape: its base colour, which is searched, and all the
# rest as it is ------------------

COLORS = {  # surfaces with a base colour, and its name there
    "diffuse": "reflectance", "principled": "base_color", "principledthin": "base_color",
    "plastic": "diffuse_reflectance", "roughplastic": "diffuse_reflectance", "pplastic": "diffuse_reflectance",
}  # fmt: skip
GREY = 0.5  # reflectance where a surface says none: Mitsuba's default
PLAIN_SIZE = 8  # texels of each side of a base colour that is the same everywhere
# smallest side of a base colour whose texels are not interpolated: smaller ones are
# repeated
SHARP_SIZE = 256
# looked up by texture coordinates, after a transform of their own
PLACED = frozenset(("bitmap", "checkerboard"))
BOUND = PLACED | {"mesh_attribute", "normalmap", "bumpmap", "hair"}
"""What shows something else on a mesh with other texture coordinates, or without its
attributes.
"""
# numbers of what looks different along u and v
ANISOTROPIC = frozenset(("alpha_u", "alpha_v", "anisotropic"))
OF_THE_PICTURE = frozenset(
    ("type", "id", "bitmap", "filename", "raw", "format", "to_uv")
)
"""Entries of a bitmap that the picture itself has, once it is read."""


@dataclass(frozen=True, eq=False)
class ShapeSurface:
    """What a shape looks like."""

    # its dictionary, with `{"type": BASE_COLOR}` and how the texture is looked up
    # (`wrap_mode`, `filter_type`) in the place of the base colour, if it has such a
    # place
    plugin: Plugin
    # (H, W, 3) float32 display-referred, row 0 on top; `GREY` where there is no place
    # for one
    base_color: Floats
    picture: bool  # it differs from place to place
    # (3, 3) from the mesh's texture coordinates to those of the base colour and of
    # `plugin`, v downwards
    to_uv: Doubles
    bound: bool  # the mesh must keep its own texture coordinates and attributes
    notes: tuple[str, ...]  # clauses about what is not as in the scene


class _Color(NamedTuple):
    """A base colour."""

    linear: Floats  # (H, W, 3)
    options: Plugin  # how it is looked up
    to_uv: object = None  # its own transform of texture coordinates


def surface_of(bsdf: Mapping[str, object]) -> ShapeSurface:
    """Take the first base colour out of a surface that is a colour, a picture or a
    checkerboard.

    Whatever else is looked up by texture coordinates stays in its place: where the base
    colour has a transform of its own, the others get the inverse before theirs.
    """
    base: _Color | None = None

    def without(plugin: Mapping[str, object]) -> Plugin:
        nonlocal base
        key = COLORS.get(str(plugin["type"]))
        color = (
            None if key is None or base is not None else _color(plugin.get(key, GREY))
        )
        if key is not None and color is not None:
            base = color
            plugin = {**plugin, key: {"type": BASE_COLOR, **color.options}}
        return with_inner(plugin, without)

    surface = without(bsdf)
    linear, _, placed = base or _Color(
        np.full((PLAIN_SIZE, PLAIN_SIZE, 3), GREY, np.float32), {}
    )
    notes = []
    plugins = list(plugins_in(surface))
    types = {str(plugin["type"]) for plugin in plugins}
    if BASE_COLOR not in types:
        kinds = sorted(types & {"mesh_attribute", "volume"})
        why = (
            f"its colour is a {kinds[0]}"
            if kinds
            else (f"a {surface['type']} has none")
        )
        notes.append(
            f"it has no base colour that can be searched ({why}): not for "
            "texture, patch and material"
        )
    if not (linear.min() >= 0.0 and linear.max() <= 1.0 + 1e-4):
        notes.append("its base colour is cut to reflectances from 0 to 1")
    picture = linear.shape[:2] != (PLAIN_SIZE, PLAIN_SIZE) or bool(
        np.ptp(linear, axis=(0, 1)).any()
    )
    bound = any(
        plugin["type"] in BOUND or ANISOTROPIC & set(plugin) for plugin in plugins
    )
    to_uv = np.eye(3) if placed is None else uv_matrix(placed)
    # The mesh's texture coordinates can be transformed where that can be undone, and
    # the tangents along u stay
    tangents = types & {"normalmap", "hair"} or any(
        ANISOTROPIC & set(plugin) for plugin in plugins
    )
    stays = not tangents or (to_uv[1, 0] == 0.0 and to_uv[0, 0] > 0.0)
    if not (abs(np.linalg.det(to_uv)) > 1e-12 and stays):
        surface = _with_transform(surface, to_uv, BASE_COLOR)
        to_uv = np.eye(3)
    elif not np.array_equal(to_uv, np.eye(3)):
        surface = _with_transform(
            surface, np.asarray(np.linalg.inv(to_uv), np.float64), *PLACED
        )
    base_color = linear_to_srgb(np.clip(linear, 0.0, 1.0))
    return ShapeSurface(surface, base_color, picture, to_uv, bound, tuple(notes))


def _with_transform(
    plugin: Mapping[str, object], before: Doubles, *kinds: str
) -> Plugin:
    """Return a plugin whose textures of some kinds take texture coordinates after a
    transform (3, 3) as well.
    """
    moved = with_inner(plugin, lambda inner: _with_transform(inner, before, *kinds))
    if moved["type"] in kinds:
        whole = np.eye(4)
        whole[np.ix_((0, 1, 3), (0, 1, 3))] = (
            uv_matrix(plugin.get("to_uv", np.eye(3))) @ before
        )
        moved["to_uv"] = whole
    return moved


def uv_matrix(value: object) -> Doubles:
    """Return a transform of texture coordinates (3, 3), of one with (4, 4) what Mitsuba
    takes of it.
    """
    matrix = np.asarray(value, dtype=np.float64)
    return matrix if matrix.shape == (3, 3) else matrix[np.ix_((0, 1, 3), (0, 1, 3))]


def _color(value: object) -> _Color | None:
    plain = constant(value)
    if plain is not None:
        return _Color(np.broadcast_to(plain, (PLAIN_SIZE, PLAIN_SIZE, 3)), {})
    if not isinstance(value, Mapping):
        return None
    if value["type"] == "checkerboard":
        dark = constant(value.get("color0", 0.4))
        light = constant(value.get("color1", 0.2))
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
    """Repeat texels so that none is blurred where a control takes the picture in its
    own size.
    """
    down, across = (-(-SHARP_SIZE // side) for side in picture.shape[:2])
    return picture.repeat(down, axis=0).repeat(across, axis=1)


def _pixels(value: Mapping[str, object]) -> Floats | None:
    """The linear values (H, W, 3) of a bitmap; None where it is none that is read
    here.
    """
    picture = value.get("bitmap")
    if isinstance(picture, np.ndarray):
        picture = picture[:, :, None] if picture.ndim == 2 else picture
        picture = picture[:, :, :1] if picture.shape[2] == 2 else picture[:, :, :3]
        return np.broadcast_to(picture, (*picture.shape[:2], 3)).astype(np.float32)
    if picture is None and "filename" not in value:
        return None
    try:
        bitmap = (
            mi.Bitmap(str(value["filename"])) if picture is None else mi.Bitmap(picture)
        )
    except (RuntimeError, TypeError):
        return None  # Mitsuba says why, once it is asked for the scene
    if value.get("raw"):
        bitmap.set_srgb_gamma(False)
    return np.array(
        bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False),
        dtype=np.float32,
    )


def constant(value: object) -> Floats | None:
    """A colour (3,) that is the same everywhere; None of anything else."""
    numbers = _numbers(value)
    return (
        None
        if np.isnan(numbers).any()
        else np.broadcast_to(numbers, (3,)).astype(np.float32)
    )
