"""Convert shapes of a Mitsuba scene to triangles, and find its haze and surfaces."""

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
"""Vertices, faces, normals and texture coordinates of a mesh, and its attributes.

The attributes are (V or F, n), by their names.
"""
# texture coordinates of a face that has none, as in Mitsuba
BARE = ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))
SECTIONS = 64  # segments around a round shape
# shapes for which Mitsuba has no triangles
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
"""The same for any shape."""


def mesh_of(shape: Mapping[str, object], name: str) -> tuple[Mesh, bool]:
    """Return the triangles of a shape in a Mitsuba scene.

    Where Mitsuba has a mesh, it is Mitsuba's own; round shapes become triangles here.
    Of a mesh with `face_normals`, or without texture coordinates, every face has
    vertices of its own.

    Args:
        shape: the shape's dictionary.
        name: of the object, for errors.

    Returns:
        The mesh, with its attributes and the file's texture coordinates, which may
        leave the unit square; and whether the file has such coordinates: otherwise they
        are `BARE` on each face.

    Raises:
        InputError: the shape has no triangles, or vertices that are not finite.
    """
    kind = str(shape["type"])
    if kind not in MESHES:
        raise InputError(
            f"object {name}: a {kind} cannot be moved; expected a shape "
            f"of {', '.join(MESHES)}"
        )
    if kind in SOLIDS:
        buffers = _tessellate(kind, shape, name)
    else:
        buffers = _load_buffers(shape, name)
    vertices, faces, normals, uvs, attributes = buffers
    if not np.isfinite(vertices).all():
        raise InputError(
            f"object {name}: expected finite vertices, got NaN or "
            "infinite ones; repair the mesh"
        )

    has_uvs = uvs is not None
    is_flat = normals is None or bool(shape.get("face_normals"))
    if uvs is None or normals is None or is_flat:
        corners = faces.reshape(-1)
        attributes = _select_vertices(attributes, corners)
        vertices = vertices[corners]
        faces = np.arange(len(corners)).reshape(-1, 3)
        face_normals = _normalize(face_vectors(vertices[faces])).repeat(3, axis=0)
        if is_flat or normals is None:
            normals = face_normals
        else:
            normals = normals[corners]
        uvs = np.tile(BARE, (len(faces), 1)) if uvs is None else uvs[corners]

    used, index = np.unique(faces, return_inverse=True)
    faces = index.reshape(-1, 3)
    vertices = vertices[used]
    uvs = uvs[used] * (1.0, -1.0) + (0.0, 1.0)
    sign = -1.0 if shape.get("flip_normals") else 1.0
    normals = np.nan_to_num(normals)[used] * sign
    if np.einsum("fk,fck->", face_vectors(vertices[faces]), normals[faces]) < 0.0:
        # Mitsuba shades by the normals, in whatever order the corners of faces are
        faces = faces[:, ::-1]
    mesh = Mesh(
        vertices.astype(np.float32),
        np.ascontiguousarray(faces, np.uint32),
        normals.astype(np.float32),
        uvs.astype(np.float32),
        _select_vertices(attributes, used),
    )
    return mesh, has_uvs


def _select_vertices(
    attributes: Mapping[str, Floats], index: Ints
) -> dict[str, Floats]:
    """Return attributes in which those of vertices are selected by an index."""
    return {
        key: values[index] if key.startswith("vertex_") else values
        for key, values in attributes.items()
    }


def _load_buffers(shape: Mapping[str, object], name: str) -> Buffers:
    """Load a mesh with Mitsuba; `name` is that of the object, for errors."""
    entries = {key: value for key, value in shape.items() if key in OF_A_MESH}
    try:
        with fewer_warnings():
            mesh = mi.load_dict(loadable(entries))
    except RuntimeError as error:
        raise InputError(
            f"object {name}: Mitsuba refuses the shape: {error}; change it there"
        ) from error
    parameters = mi.traverse(mesh)

    def get_rows(key: str, width: int) -> Doubles:
        return np.array(parameters[key], np.float64).reshape(-1, width)

    vertices = get_rows(POSITIONS, 3)
    faces = np.array(parameters[FACES], np.int64).reshape(-1, 3)
    if not len(faces):
        raise InputError(
            f"object {name}: expected a mesh with faces, got none; export triangles"
        )
    normals = get_rows(NORMALS, 3) if mesh.has_vertex_normals() else None
    uvs = get_rows(TEXCOORDS, 2) if mesh.has_vertex_texcoords() else None
    attributes: dict[str, Floats] = {}
    counts = {"vertex": len(vertices), "face": len(faces)}
    for key in parameters.keys():
        count = counts.get(key.split("_")[0], 0)
        is_attribute = key not in (POSITIONS, NORMALS, TEXCOORDS) and "." not in key
        if count and is_attribute:
            values = np.array(parameters[key], np.float32)
            attributes[str(key)] = values.reshape(count, -1)
    return vertices, faces, normals, uvs, attributes


def _normalize(vectors: Doubles) -> Doubles:
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.maximum(lengths, 1e-30))


def _tessellate(kind: str, shape: Mapping[str, object], name: str) -> Buffers:
    """Make the triangles of one of `SOLIDS`, with Mitsuba's texture coordinates."""
    local = np.eye(4)
    turn = np.linspace(0.0, 1.0, SECTIONS + 1)
    normals = None
    if kind == "sphere":
        uvs, faces = _grid(turn, turn[::2])
        polar = np.pi * uvs[:, 1]
        vertices = np.stack(
            [*(np.sin(polar) * _circle(uvs[:, 0])), np.cos(polar)], axis=1
        )
        normals = vertices
        local[:3, :3] *= _radius_of(shape)
        local[:3, 3] = np.asarray(shape.get("center", (0.0, 0.0, 0.0)), np.float64)
    elif kind == "cylinder":  # open at both ends, as Mitsuba's
        uvs, faces = _grid(turn, np.array([0.0, 1.0]))
        vertices = np.stack([*_circle(uvs[:, 0]), uvs[:, 1]], axis=1)
        normals = vertices * (1.0, 1.0, 0.0)
        local = _cylinder_pose(shape)
    elif kind == "disk":
        uvs, faces = _grid(turn[::8], turn)
        vertices = np.stack(
            [*(uvs[:, 0] * _circle(uvs[:, 1])), np.zeros(len(uvs))], axis=1
        )
    else:
        uvs, faces = _grid(np.array([0.0, 1.0]), np.array([0.0, 1.0]))
        vertices = np.column_stack([uvs * 2.0 - 1.0, np.zeros(4)])
    if normals is None:
        normals = np.tile((0.0, 0.0, 1.0), (len(vertices), 1))
    # without faces that have no area, such as those at a pole
    faces = faces[np.linalg.norm(face_vectors(vertices[faces]), axis=1) > 1e-9]
    matrix = pose_of(shape) @ local
    if not abs(np.linalg.det(matrix[:3, :3])) > 0.0:
        raise InputError(
            f"object {name}: expected a {kind} of some size, got one "
            "without extent; change its numbers"
        )
    normals = _normalize(normals @ np.linalg.inv(matrix[:3, :3]))
    return vertices @ matrix[:3, :3].T + matrix[:3, 3], faces, normals, uvs, {}


def _radius_of(shape: Mapping[str, object]) -> float:
    return float(np.asarray(shape.get("radius", 1.0), np.float64))


def _cylinder_pose(shape: Mapping[str, object]) -> Doubles:
    """Return the (4, 4) pose of the unit cylinder along z that is a given cylinder."""
    start = np.asarray(shape.get("p0", (0.0, 0.0, 0.0)), np.float64)
    end = np.asarray(shape.get("p1", (0.0, 0.0, 1.0)), np.float64)
    radius = _radius_of(shape)
    length = float(np.linalg.norm(end - start))
    axis = (end - start) / max(length, 1e-30)
    x, y, z = axis
    sign = np.copysign(1.0, z)
    # axes as in Mitsuba's `coordinate_system` (Duff et al. 2017), which has float32
    # alone
    a = -1.0 / (sign + z)
    first = np.array([1.0 + sign * x * x * a, sign * x * y * a, -sign * x])
    second = np.array([x * y * a, sign + y * y * a, -y])
    pose = np.eye(4)
    pose[:3] = np.stack([first * radius, second * radius, axis * length, start], axis=1)
    return pose


def _grid(u: Doubles, v: Doubles) -> tuple[Doubles, Ints]:
    """Return the points (n, 2) of a grid and its triangles (m, 3)."""
    points = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    row_starts = np.arange(len(v) - 1)[:, None] * len(u)
    first = (row_starts + np.arange(len(u) - 1)).reshape(-1)
    above = first + len(u)
    lower = np.stack([first, first + 1, above + 1], axis=1)
    upper = np.stack([first, above + 1, above], axis=1)
    return points, np.concatenate([lower, upper])


def _circle(turn: Doubles) -> Doubles:
    """Return x and y on the unit circle, for fractions of a turn."""
    return np.asarray([np.cos(2.0 * np.pi * turn), np.sin(2.0 * np.pi * turn)])


def pose_of(plugin: Mapping[str, object]) -> Doubles:
    """Return the pose (4, 4) of a plugin."""
    return np.asarray(plugin.get("to_world", np.eye(4)), dtype=np.float64)


Plugins = Mapping[str, Mapping[str, object]]
MOST = 2.0  # largest extinction of a haze per object size
DARKEST = 1e-3  # smallest albedo of a haze
# largest distance of the ball's center from the object's, in radii; its edge is far off
OFF = 0.05
_OF_BALL = {"type", "id", "radius", "center", "to_world", "bsdf", "interior"}
_OF_MEDIUM = {"type", "id", "sigma_t", "albedo", "scale", "phase"}


def haze_in(named: Plugins, matrix: Doubles) -> tuple[HazePart, frozenset[str]] | None:
    """Find the haze of a scene.

    It is one grey medium in a ball that the camera stands in: Mitsuba's `prbvolpath`
    sees nothing of it up to the first surface, so such a scene is rendered as one with
    a `HazePart`. All other media stay as they are.

    Args:
        named: the scene's plugins by name.
        matrix: (4, 4) from the scene to the object's coordinates, with one scale for
            all directions.

    Returns:
        The haze and the names of the plugins that it is made of; None if there is none.
    """
    names = _find_haze_plugins(named)
    if names is None:
        return None
    ball_name, medium_name = names
    ball = named[ball_name]
    medium = named[medium_name]
    pose = matrix @ pose_of(ball)
    center = pose @ np.append(
        np.broadcast_to(_numbers(ball.get("center", np.zeros(3))), (3,)), 1.0
    )
    scene_radius = float(_numbers(ball.get("radius", 1.0))[0])
    radius = scene_radius * float(np.cbrt(abs(np.linalg.det(pose[:3, :3]))))
    if not (radius > 0.0 and float(np.linalg.norm(center[:3])) <= OFF * radius):
        return None

    density = _numbers(medium.get("sigma_t", 1.0))
    scale = _numbers(medium.get("scale", 1.0))
    object_size = float(np.cbrt(abs(np.linalg.det(matrix[:3, :3]))))
    extinction = density * scale / object_size
    is_grey = 0.0 < float(extinction.min()) == float(extinction.max()) <= MOST
    albedo = np.broadcast_to(_numbers(medium.get("albedo", 0.75)), (3,)).tolist()
    if not (is_grey and DARKEST <= min(albedo) and max(albedo) <= 1.0):
        return None
    red, green, blue = albedo
    haze = HazePart(ball_name, radius, float(extinction[0]), (red, green, blue))
    return haze, frozenset((ball_name, medium_name))


def _find_haze_plugins(named: Plugins) -> tuple[str, str] | None:
    """Return the names of the ball and of the medium of a haze; None without one.

    The only medium of the scene is homogeneous and isotropic, cameras stand in it, and
    a single sphere with no surface is filled with it.
    """
    camera_media = {_reference(plugin.get("medium")) for plugin in named.values()}
    camera_media.discard(None)
    balls = [
        name
        for name, plugin in named.items()
        if plugin["type"] == "sphere"
        and _reference(plugin.get("interior")) in camera_media
    ]
    media = [
        name
        for name, plugin in named.items()
        if plugin["type"] in ("homogeneous", "heterogeneous")
    ]
    if len(camera_media) != 1 or len(balls) != 1 or len(media) != 1:
        return None
    ball = named[balls[0]]
    medium = named[media[0]]
    isotropic = {"type": "isotropic"}
    is_haze = (
        set(ball) <= _OF_BALL
        and set(medium) <= _OF_MEDIUM
        and medium["type"] == "homogeneous"
        and ball.get("bsdf") == {"type": "null"}
        and medium.get("phase", isotropic) == isotropic
        and camera_media == {media[0]}
    )
    return (balls[0], media[0]) if is_haze else None


def _reference(plugin: object) -> str | None:
    """Return the id that a reference names; None for anything else."""
    if isinstance(plugin, Mapping) and plugin.get("type") == "ref":
        return str(plugin["id"])
    return None


def _numbers(value: object) -> Doubles:
    """Return a number (1,), or the three of a color; NaN for anything else."""
    if isinstance(value, Mapping):
        is_constant = value.get("type") in ("rgb", "uniform", "spectrum", "srgb")
        value = value.get("value") if is_constant else None
    if isinstance(value, (str, bool)):
        value = None
    try:
        numbers = np.atleast_1d(np.asarray(value, np.float64))
    except (TypeError, ValueError):  # such as pairs of wavelength and value
        return np.full(1, np.nan)
    if numbers.shape in ((1,), (3,)) and np.isfinite(numbers).all():
        return numbers
    return np.full(1, np.nan)


# ---- The surface of a Mitsuba shape: its base color, which is searched; all the rest
# stays as it is

COLORS = {  # surfaces with a base color, and its name there
    "diffuse": "reflectance",
    "principled": "base_color",
    "principledthin": "base_color",
    "plastic": "diffuse_reflectance",
    "roughplastic": "diffuse_reflectance",
    "pplastic": "diffuse_reflectance",
}
GREY = 0.5  # reflectance of a surface that states none: Mitsuba's default
PLAIN_SIZE = 8  # width and height of a base color that is the same everywhere
# smallest width and height of a base color whose texels are not interpolated: smaller
# ones are repeated
SHARP_SIZE = 256
# looked up by texture coordinates, after a transform of their own
PLACED = frozenset(("bitmap", "checkerboard"))
BOUND = PLACED | {"mesh_attribute", "normalmap", "bumpmap", "hair"}
"""Plugins that look different with other texture coordinates, or without attributes."""
# entries of surfaces that look different along u and v
ANISOTROPIC = frozenset(("alpha_u", "alpha_v", "anisotropic"))
OF_THE_PICTURE = frozenset(
    ("type", "id", "bitmap", "filename", "raw", "format", "to_uv")
)
"""Entries of a bitmap that have been used once its pixels are read."""


@dataclass(frozen=True, eq=False)
class ShapeSurface:
    """The surface of a shape, with its base color taken out."""

    # its dictionary, with `{"type": BASE_COLOR}` and how the texture is looked up
    # (`wrap_mode`, `filter_type`) in the place of the base color, if it has one
    plugin: Plugin
    # (H, W, 3) float32 display-referred, row 0 on top; `GREY` if it has no base color
    base_color: Floats
    picture: bool  # whether the base color varies over the surface
    # (3, 3) from the mesh's texture coordinates to those of the base color and of
    # `plugin`, v downwards
    to_uv: Doubles
    bound: bool  # the mesh must keep its own texture coordinates and attributes
    notes: tuple[str, ...]  # clauses about what is not as in the scene


class _Color(NamedTuple):
    """A base color."""

    linear: Floats  # (H, W, 3)
    options: Plugin  # how it is looked up
    to_uv: object = None  # its own transform of texture coordinates


def surface_of(bsdf: Mapping[str, object]) -> ShapeSurface:
    """Take the first base color out of a surface: a color, a bitmap or a checkerboard.

    Whatever else is looked up by texture coordinates stays as it is: where the base
    color has a transform of its own, the others get the inverse before theirs.
    """
    surface, color = _take_base_color(bsdf)
    if color is None:
        grey = np.full((PLAIN_SIZE, PLAIN_SIZE, 3), GREY, np.float32)
        color = _Color(grey, {})
    linear = color.linear
    is_constant = linear.shape[:2] == (PLAIN_SIZE, PLAIN_SIZE) and not bool(
        np.ptp(linear, axis=(0, 1)).any()
    )
    is_bound = any(
        plugin["type"] in BOUND or ANISOTROPIC & set(plugin)
        for plugin in plugins_in(surface)
    )
    notes = _surface_notes(surface, linear)
    surface, to_uv = _apply_uv_transform(surface, color.to_uv)
    return ShapeSurface(
        plugin=surface,
        base_color=linear_to_srgb(np.clip(linear, 0.0, 1.0)),
        picture=not is_constant,
        to_uv=to_uv,
        bound=is_bound,
        notes=tuple(notes),
    )


def _take_base_color(bsdf: Mapping[str, object]) -> tuple[Plugin, _Color | None]:
    """Return a surface with `BASE_COLOR` in the place of its first base color, and it."""
    base: _Color | None = None

    def replace_color(plugin: Mapping[str, object]) -> Plugin:
        nonlocal base
        key = COLORS.get(str(plugin["type"]))
        if key is not None and base is None:
            base = _color(plugin.get(key, GREY))
            if base is not None:
                plugin = {**plugin, key: {"type": BASE_COLOR, **base.options}}
        return with_inner(plugin, replace_color)

    return replace_color(bsdf), base


def _surface_notes(surface: Plugin, linear: Floats) -> list[str]:
    """Return clauses about what of a surface is not as in the scene."""
    notes = []
    types = {str(plugin["type"]) for plugin in plugins_in(surface)}
    if BASE_COLOR not in types:
        kinds = sorted(types & {"mesh_attribute", "volume"})
        if kinds:
            reason = f"its colour is a {kinds[0]}"
        else:
            reason = f"a {surface['type']} has none"
        notes.append(
            f"it has no base colour that can be searched ({reason}): not for "
            "texture, patch and material"
        )
    if not (linear.min() >= 0.0 and linear.max() <= 1.0 + 1e-4):
        notes.append("its base colour is cut to reflectances from 0 to 1")
    return notes


def _apply_uv_transform(surface: Plugin, transform: object) -> tuple[Plugin, Doubles]:
    """Apply a base color's transform of texture coordinates.

    The mesh's texture coordinates can be transformed where that can be undone, and
    where tangents along u stay as they are. Otherwise the base color keeps its
    transform.

    Returns:
        The surface with changed transforms, and the (3, 3) transform of the mesh's
        texture coordinates.
    """
    to_uv = np.eye(3) if transform is None else uv_matrix(transform)
    uses_tangents = any(
        plugin["type"] in ("normalmap", "hair") or ANISOTROPIC & set(plugin)
        for plugin in plugins_in(surface)
    )
    keeps_tangents = to_uv[1, 0] == 0.0 and to_uv[0, 0] > 0.0
    is_invertible = abs(np.linalg.det(to_uv)) > 1e-12
    if not is_invertible or (uses_tangents and not keeps_tangents):
        return _with_transform(surface, to_uv, BASE_COLOR), np.eye(3)
    if not np.array_equal(to_uv, np.eye(3)):
        inverse = np.asarray(np.linalg.inv(to_uv), np.float64)
        surface = _with_transform(surface, inverse, *PLACED)
    return surface, to_uv


def _with_transform(
    plugin: Mapping[str, object], before: Doubles, *kinds: str
) -> Plugin:
    """Return a plugin whose textures of some kinds have one more transform (3, 3).

    Texture coordinates go through it before the texture's own.
    """
    changed = with_inner(plugin, lambda inner: _with_transform(inner, before, *kinds))
    if changed["type"] in kinds:
        transform = np.eye(4)
        transform[np.ix_((0, 1, 3), (0, 1, 3))] = (
            uv_matrix(plugin.get("to_uv", np.eye(3))) @ before
        )
        changed["to_uv"] = transform
    return changed


def uv_matrix(value: object) -> Doubles:
    """Return a transform of texture coordinates (3, 3).

    Of one with (4, 4) it is what Mitsuba takes.
    """
    matrix = np.asarray(value, dtype=np.float64)
    return matrix if matrix.shape == (3, 3) else matrix[np.ix_((0, 1, 3), (0, 1, 3))]


def _color(value: object) -> _Color | None:
    """Return a color, a checkerboard or a bitmap as a base color; None of all else."""
    same_everywhere = constant(value)
    if same_everywhere is not None:
        size = (PLAIN_SIZE, PLAIN_SIZE, 3)
        return _Color(np.broadcast_to(same_everywhere, size), {})
    if not isinstance(value, Mapping):
        return None
    if value["type"] == "checkerboard":
        dark = constant(value.get("color0", 0.4))
        light = constant(value.get("color1", 0.2))
        unknown = set(value) - {"type", "id", "color0", "color1", "to_uv"}
        if dark is None or light is None or unknown:
            return None
        board = np.array([[dark, light], [light, dark]], np.float32)
        return _Color(
            _repeat_texels(board), {"filter_type": "nearest"}, value.get("to_uv")
        )
    pixels = _pixels(value) if value["type"] == "bitmap" else None
    if pixels is None:
        return None
    options = {key: entry for key, entry in value.items() if key not in OF_THE_PICTURE}
    if options.get("filter_type") == "nearest":
        pixels = _repeat_texels(pixels)
    return _Color(pixels, options, value.get("to_uv"))


def _repeat_texels(texture: Floats) -> Floats:
    """Repeat texels so that none is blurred where a control keeps the texture's size."""
    down, across = (-(-SHARP_SIZE // size) for size in texture.shape[:2])
    return texture.repeat(down, axis=0).repeat(across, axis=1)


def _pixels(value: Mapping[str, object]) -> Floats | None:
    """Return the linear values (H, W, 3) of a bitmap; None if it cannot be read here."""
    image = value.get("bitmap")
    if isinstance(image, np.ndarray):
        if image.ndim == 2:
            image = image[:, :, None]
        image = image[:, :, :1] if image.shape[2] == 2 else image[:, :, :3]
        return np.broadcast_to(image, (*image.shape[:2], 3)).astype(np.float32)
    if image is None and "filename" not in value:
        return None
    try:
        bitmap = mi.Bitmap(str(value["filename"]) if image is None else image)
    except (RuntimeError, TypeError):
        return None  # Mitsuba gives the reason when the scene is loaded
    if value.get("raw"):
        bitmap.set_srgb_gamma(False)
    return np.array(
        bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False),
        dtype=np.float32,
    )


def constant(value: object) -> Floats | None:
    """Return a color (3,) that is the same everywhere; None for anything else."""
    numbers = _numbers(value)
    if np.isnan(numbers).any():
        return None
    return np.broadcast_to(numbers, (3,)).astype(np.float32)
