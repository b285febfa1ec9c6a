"""Shapes of a Mitsuba scene as triangles, and those that make up its haze."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from advsearch.errors import InputError
from advsearch.scene.assets import Doubles, Floats, Ints, Mesh
from advsearch.scene.mitsuba_backend.meshes import FACES, NORMALS, POSITIONS, TEXCOORDS, loadable
from advsearch.scene.mitsuba_backend.variant import fewer_warnings, mi
from advsearch.scene.parts import HazePart
from advsearch.scene.raster import doubled_normals

Buffers = tuple[Doubles, Ints, Doubles | None, Doubles | None, dict[str, Floats]]
"""Vertices, faces, normals and texture coordinates of a mesh, and its attributes, (V or F, n) by their names."""

BARE = ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))
"""Texture coordinates of a face that has none, as Mitsuba takes them."""
SECTIONS = 64
"""Sides of a round shape."""
SOLIDS = ("rectangle", "sphere", "cylinder", "disk")
"""Shapes of which Mitsuba has no triangles."""
MESHES = (*SOLIDS, "cube", "obj", "ply", "serialized")
"""The shapes that can be the object."""
OF_A_MESH = frozenset(
    ("type", "filename", "to_world", "face_normals", "flip_tex_coords", "flip_normals", "shape_index")
)
"""Entries of a mesh that are no surface, light or medium."""
OF_A_SHAPE = OF_A_MESH | {"id", "radius", "center", "p0", "p1", "sampling_weight", "silhouette_sampling_weight"}
"""The same of any shape."""


@dataclass(frozen=True, eq=False)
class ShapeMesh:
    """The triangles of a shape in its scene, as Mitsuba has them, with the file's own texture coordinates, which may
    leave the unit square, and attributes; and whether it has such coordinates: else they are `BARE` on each face."""

    mesh: Mesh
    uv: bool = True


def mesh_of(shape: Mapping[str, object], name: str) -> ShapeMesh:
    """Return the triangles of a shape's dictionary; its name is for errors.

    Where Mitsuba has a mesh, it is Mitsuba's own; round shapes become triangles here. Of a mesh with `face_normals`, or
    without texture coordinates, every face has vertices of its own.

    Raises:
        InputError: it has none.
    """
    kind = str(shape["type"])
    if kind not in MESHES:
        raise InputError(f"object {name}: a {kind} cannot be moved; expected a shape of {', '.join(MESHES)}")
    vertices, faces, normals, uvs, attributes = _solid(kind, shape, name) if kind in SOLIDS else _loaded(shape, name)
    if not np.isfinite(vertices).all():
        raise InputError(f"object {name}: expected finite vertices, got NaN or infinite ones; repair the mesh")
    own_uvs, flat = uvs is not None, normals is None or bool(shape.get("face_normals"))
    if uvs is None or normals is None or flat:
        corners = faces.reshape(-1)
        attributes = _of(corners, attributes)
        vertices, faces = vertices[corners], np.arange(len(corners)).reshape(-1, 3)
        faced = _unit(doubled_normals(vertices[faces])).repeat(3, axis=0)
        normals = faced if flat or normals is None else normals[corners]
        uvs = np.tile(BARE, (len(faces), 1)) if uvs is None else uvs[corners]
    used, index = np.unique(faces, return_inverse=True)
    faces = index.reshape(-1, 3)
    vertices, uvs = vertices[used], uvs[used] * (1.0, -1.0) + (0.0, 1.0)
    normals = np.nan_to_num(normals)[used] * (-1.0 if shape.get("flip_normals") else 1.0)
    if np.einsum("fk,fck->", doubled_normals(vertices[faces]), normals[faces]) < 0.0:
        faces = faces[:, ::-1]  # Mitsuba shades by the normals, whichever way faces are wound
    places, facing, texture = (values.astype(np.float32) for values in (vertices, normals, uvs))
    made = Mesh(places, np.ascontiguousarray(faces, np.uint32), facing, texture, _of(used, attributes))
    return ShapeMesh(made, own_uvs)


def _of(vertices: Ints, attributes: Mapping[str, Floats]) -> dict[str, Floats]:
    """The attributes of some of the vertices, in their order, and of all faces."""
    return {key: values[vertices] if key.startswith("vertex_") else values for key, values in attributes.items()}


def _loaded(shape: Mapping[str, object], name: str) -> Buffers:
    """Return what Mitsuba reads of a mesh."""
    try:
        with fewer_warnings():
            loaded = mi.load_dict(loadable({key: value for key, value in shape.items() if key in OF_A_MESH}))
    except RuntimeError as error:
        raise InputError(f"object {name}: Mitsuba refuses the shape: {error}; change it there") from error
    parameters = mi.traverse(loaded)

    def rows(key: str, width: int) -> Doubles:
        return np.array(parameters[key], np.float64).reshape(-1, width)

    vertices, faces = rows(POSITIONS, 3), np.array(parameters[FACES], np.int64).reshape(-1, 3)
    if not len(faces):
        raise InputError(f"object {name}: expected a mesh with faces, got none; export triangles")
    normals = rows(NORMALS, 3) if loaded.has_vertex_normals() else None
    uvs = rows(TEXCOORDS, 2) if loaded.has_vertex_texcoords() else None
    attributes: dict[str, Floats] = {}
    for key in parameters.keys():
        count = {"vertex": len(vertices), "face": len(faces)}.get(key.split("_")[0], 0)
        if count and key not in (POSITIONS, NORMALS, TEXCOORDS) and "." not in key:
            attributes[str(key)] = np.array(parameters[key], np.float32).reshape(count, -1)
    return vertices, faces, normals, uvs, attributes


def _unit(vectors: Doubles) -> Doubles:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-30))


def _solid(kind: str, shape: Mapping[str, object], name: str) -> Buffers:
    """The same of a shape of which Mitsuba has no triangles."""
    local = np.eye(4)
    turn = np.linspace(0.0, 1.0, SECTIONS + 1)
    normals = None
    if kind == "sphere":
        uvs, faces = _grid(turn, turn[::2])
        down = np.pi * uvs[:, 1]
        vertices = normals = np.stack([*(np.sin(down) * _circle(uvs[:, 0])), np.cos(down)], axis=1)
        local[:3, :3] *= _number(shape.get("radius", 1.0))
        local[:3, 3] = np.asarray(shape.get("center", (0.0, 0.0, 0.0)), dtype=np.float64)
    elif kind == "cylinder":  # open at both ends, as Mitsuba's
        uvs, faces = _grid(turn, np.array([0.0, 1.0]))
        vertices = np.stack([*_circle(uvs[:, 0]), uvs[:, 1]], axis=1)
        normals = vertices * (1.0, 1.0, 0.0)
        local = _along(shape)
    elif kind == "disk":
        uvs, faces = _grid(turn[::8], turn)
        vertices = np.stack([*(uvs[:, 0] * _circle(uvs[:, 1])), np.zeros(len(uvs))], axis=1)
    else:
        uvs, faces = _grid(np.array([0.0, 1.0]), np.array([0.0, 1.0]))
        vertices = np.column_stack([uvs * 2.0 - 1.0, np.zeros(4)])
    normals = np.tile((0.0, 0.0, 1.0), (len(vertices), 1)) if normals is None else normals
    faces = faces[np.linalg.norm(doubled_normals(vertices[faces]), axis=1) > 1e-9]
    matrix = pose_of(shape) @ local
    if not abs(np.linalg.det(matrix[:3, :3])) > 0.0:
        raise InputError(f"object {name}: expected a {kind} of some size, got one without extent; change its numbers")
    normals = _unit(normals @ np.linalg.inv(matrix[:3, :3]))
    return vertices @ matrix[:3, :3].T + matrix[:3, 3], faces, normals, uvs, {}


def _grid(u: Doubles, v: Doubles) -> tuple[Doubles, Ints]:
    """The points (N, 2) of a grid of texture coordinates, and its triangles (F, 3)."""
    points = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    first = (np.arange(len(v) - 1)[:, None] * len(u) + np.arange(len(u) - 1)).reshape(-1)
    above = first + len(u)
    lower, upper = np.stack([first, first + 1, above + 1], axis=1), np.stack([first, above + 1, above], axis=1)
    return points, np.concatenate([lower, upper])


def _circle(share: Doubles) -> Doubles:
    """Points (2, N) of the unit circle, at shares (N,) of a whole turn."""
    return np.asarray([np.cos(2.0 * np.pi * share), np.sin(2.0 * np.pi * share)])


def _along(shape: Mapping[str, object]) -> Doubles:
    """The transform (4, 4) of a cylinder between its two points; around it as Mitsuba's (Duff et al. 2017)."""
    low = np.asarray(shape.get("p0", (0.0, 0.0, 0.0)), dtype=np.float64)
    high = np.asarray(shape.get("p1", (0.0, 0.0, 1.0)), dtype=np.float64)
    length = float(np.linalg.norm(high - low))
    x, y, z = along = (high - low) / max(length, 1e-30)
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    aside = np.array([1.0 + sign * x * x * a, sign * x * y * a, -sign * x])
    across = np.array([x * y * a, sign + y * y * a, -y])
    radius = _number(shape.get("radius", 1.0))
    own = np.eye(4)
    own[:3] = np.stack([aside * radius, across * radius, along * length, low], axis=1)
    return own


def _number(value: object) -> float:
    return float(np.asarray(value, dtype=np.float64))


def pose_of(plugin: Mapping[str, object]) -> Doubles:
    """Return the pose (4, 4) of a plugin."""
    return np.asarray(plugin.get("to_world", np.eye(4)), dtype=np.float64)


Plugins = Mapping[str, Mapping[str, object]]

MOST, DARKEST = 2.0, 1e-3
"""Of a haze: the largest extinction per object size, and the least share of the light that is scattered."""
OFF = 0.05
"""By what share of its radius the ball's middle may lie beside the object's; its edge is in the far background."""

_OF_BALL = {"type", "id", "radius", "center", "to_world", "bsdf", "interior"}
_OF_MEDIUM = {"type", "id", "sigma_t", "albedo", "scale", "phase"}


def haze_in(named: Plugins, matrix: Doubles) -> tuple[HazePart, frozenset[str]] | None:
    """Return the haze of a scene's plugins and the names of those that it is made of; None where there is none.
    `matrix` (4, 4) goes from the scene to the object's coordinates, with one scale for all directions.

    It is one grey medium in a ball that the camera stands in: Mitsuba's `prbvolpath` sees nothing of it up to the first
    surface, so such a scene is rendered as one with a `HazePart`. All other media stay as they are.
    """
    inside = {_reference(plugin.get("medium")) for plugin in named.values()} - {None}
    spheres = {name: plugin for name, plugin in named.items() if plugin["type"] == "sphere"}
    balls = [name for name, sphere in spheres.items() if _reference(sphere.get("interior")) in inside]
    media = [name for name, plugin in named.items() if plugin["type"] in ("homogeneous", "heterogeneous")]
    if len(inside) != 1 or len(balls) != 1 or len(media) != 1:
        return None
    ball, medium = named[balls[0]], named[media[0]]
    bsdf, phase = ball.get("bsdf"), medium.get("phase", {"type": "isotropic"})
    plain = set(ball) <= _OF_BALL and set(medium) <= _OF_MEDIUM and medium["type"] == "homogeneous"
    if not plain or bsdf != {"type": "null"} or phase != {"type": "isotropic"} or inside != {media[0]}:
        return None
    across, middle = _numbers(ball.get("radius", 1.0)), _numbers(ball.get("center", np.zeros(3)))
    density, albedo = _numbers(medium.get("sigma_t", 1.0)), _numbers(medium.get("albedo", 0.75))
    scale = _numbers(medium.get("scale", 1.0))
    pose = matrix @ pose_of(ball)
    place = pose @ np.append(np.broadcast_to(middle, (3,)), 1.0)
    radius = float(across[0]) * float(np.cbrt(abs(np.linalg.det(pose[:3, :3]))))
    size = float(np.cbrt(abs(np.linalg.det(matrix[:3, :3]))))
    extinction, (red, green, blue) = density * scale / size, np.broadcast_to(albedo, (3,)).tolist()
    grey = 0.0 < float(extinction.min()) == float(extinction.max()) <= MOST
    if not (grey and DARKEST <= min(red, green, blue) and max(red, green, blue) <= 1.0):
        return None
    if not (radius > 0.0 and float(np.linalg.norm(place[:3])) <= OFF * radius):
        return None
    return HazePart(balls[0], radius, float(extinction[0]), (red, green, blue)), frozenset((balls[0], media[0]))


def _reference(plugin: object) -> str | None:
    return str(plugin["id"]) if isinstance(plugin, Mapping) and plugin.get("type") == "ref" else None


def _numbers(value: object) -> Doubles:
    """Return a number (1,), or the three of a colour; NaN of anything else."""
    if isinstance(value, Mapping):
        plain = value.get("type") in ("rgb", "uniform") and set(value) <= {"type", "value"}
        value = value.get("value") if plain else None
    try:
        numbers = np.atleast_1d(np.asarray(value, np.float64))
    except (TypeError, ValueError):
        return np.full(1, np.nan)
    return numbers if numbers.shape in ((1,), (3,)) and np.isfinite(numbers).all() else np.full(1, np.nan)
