"""Convert shapes of a Mitsuba scene to triangles, and find its haze and surfaces."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from advsearch.errors import InputError
from advsearch.scene.assets import (
    Float32Array,
    Float64Array,
    IntArray,
    Mesh,
    compute_area_vectors,
)
from advsearch.scene.color import linear_to_srgb
from advsearch.scene.mitsuba_backend.meshes import (
    FACES,
    NORMALS,
    POSITIONS,
    TEXCOORDS,
    map_inner_plugins,
    to_loadable,
)
from advsearch.scene.mitsuba_backend.variant import Plugin, mi, suppress_warnings
from advsearch.scene.parts import BASE_COLOR, HazePart, iterate_plugins


class Buffers(NamedTuple):
    """Buffers of a mesh in a Mitsuba scene."""

    vertices: Float64Array  # (V, 3)
    faces: IntArray  # (F, 3)
    normals: Float64Array | None  # (V, 3); None if the mesh has none
    uvs: Float64Array | None  # (V, 2) texture coordinates; None if the mesh has none
    attributes: dict[str, Float32Array]  # (V or F, n), by name


# texture coordinates of the corners of a face without any, as in Mitsuba
DEFAULT_FACE_UVS = ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))
ROUND_SEGMENTS = 64  # segments around a round shape
# shapes for which Mitsuba has no triangles
TESSELLATED_SHAPES = ("rectangle", "sphere", "cylinder", "disk")
# the shapes that can be the object
OBJECT_SHAPES = (*TESSELLATED_SHAPES, "cube", "obj", "ply", "serialized")
MESH_ENTRIES = frozenset(  # entries of a mesh that are no surface, light or medium
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
SHAPE_ENTRIES = MESH_ENTRIES | {
    "id",
    "radius",
    "center",
    "p0",
    "p1",
    "sampling_weight",
    "silhouette_sampling_weight",
}
"""Entries of any shape that are no surface, light or medium."""


def _load_any_buffers(shape: Mapping[str, object], name: str) -> Buffers:
    """Return the buffers of a shape, whether Mitsuba has a mesh of it or not.

    Args:
        shape: the shape's dictionary, such as `{"type": "sphere", "radius": 2.0}`.
        name: name of the object, for errors.

    Raises:
        InputError: the shape has no triangles.
    """
    kind = str(shape["type"])
    if kind not in OBJECT_SHAPES:
        raise InputError(
            f"object {name}: a {kind} cannot be moved; expected a shape "
            f"of {', '.join(OBJECT_SHAPES)}"
        )
    if kind in TESSELLATED_SHAPES:
        return _tessellate(kind, shape, name)
    return _load_buffers(shape, name)


def load_shape_mesh(shape: Mapping[str, object], name: str) -> tuple[Mesh, bool]:
    """Return the triangles of a shape in a Mitsuba scene.

    If Mitsuba has a mesh of the shape, it is loaded; other shapes are tessellated here.
    If a mesh has `face_normals`, or no normals or texture coordinates, every face gets
    vertices of its own.

    Normals are unit vectors, reversed by `flip_normals`, and faces are wound so that
    their fronts are where the normals point.

    Args:
        shape: the shape's dictionary.
        name: name of the object, for errors.

    Returns:
        The mesh, with its attributes and the file's texture coordinates, which may
        leave the unit square; and whether the file has such coordinates: otherwise they
        are `DEFAULT_FACE_UVS` on each face.

    Raises:
        InputError: the shape has no triangles, or vertices that are not finite.
    """
    buffers = _load_any_buffers(shape, name)
    _check_vertices(buffers, name)
    has_uvs = buffers.uvs is not None
    if shape.get("face_normals"):
        buffers = buffers._replace(normals=None)
    if buffers.uvs is None or buffers.normals is None:
        # Default values belong to the corners of a face. So each corner becomes a
        # vertex, with default values for what is missing.
        buffers = _separate_faces(buffers)
    normal_sign = -1.0 if shape.get("flip_normals") else 1.0
    return _make_used_mesh(buffers, normal_sign), has_uvs


def _check_vertices(buffers: Buffers, name: str) -> None:
    """Raise InputError if a mesh has vertices that are not finite."""
    if not np.isfinite(buffers.vertices).all():
        raise InputError(
            f"object {name}: expected finite vertices, got NaN or infinite ones; "
            "repair the mesh"
        )


def _make_used_mesh(buffers: Buffers, normal_sign: float) -> Mesh:
    """Return the mesh of buffers, without vertices that no face has.

    The buffers have normals, which are multiplied by `normal_sign`, and texture
    coordinates.
    """
    assert buffers.normals is not None and buffers.uvs is not None
    used_vertices, vertex_index = np.unique(buffers.faces, return_inverse=True)
    faces = vertex_index.reshape(-1, 3)
    vertices = buffers.vertices[used_vertices]
    # v points up in our meshes and down in Mitsuba's, so that it becomes 1 - v.
    uvs = buffers.uvs[used_vertices] * (1.0, -1.0) + (0.0, 1.0)
    # The normals of a face without area are NaN.
    normals = np.nan_to_num(buffers.normals)[used_vertices] * normal_sign
    if _has_opposite_winding(vertices, faces, normals):
        faces = faces[:, ::-1]
    return Mesh(
        vertices=vertices.astype(np.float32),
        faces=np.ascontiguousarray(faces, np.uint32),
        normals=normals.astype(np.float32),
        uvs=uvs.astype(np.float32),
        attributes=_select_vertices(buffers.attributes, used_vertices),
    )


def _has_opposite_winding(
    vertices: Float64Array, faces: IntArray, normals: Float64Array
) -> bool:
    """Return whether the fronts of most faces are opposite to the normals.

    The front of a face follows from the order of its corners. Mitsuba shades by the
    normals instead, for any order, so that a file may have either. The cosines between
    fronts and normals are added up over the corners of all faces, weighted by area.

    Args:
        vertices: (V, 3) positions.
        faces: (F, 3) vertices of the faces.
        normals: (V, 3) normals.
    """
    area_vectors = compute_area_vectors(vertices[faces])  # (F, 3), along the fronts
    agreement = np.einsum("fk,fck->", area_vectors, normals[faces])
    return bool(agreement < 0.0)


def _select_vertices(
    attributes: Mapping[str, Float32Array], index: IntArray
) -> dict[str, Float32Array]:
    """Return attributes with the rows of those vertices that an index selects.

    Attributes of faces ("face_...") stay as they are.
    """
    return {
        key: values[index] if key.startswith("vertex_") else values
        for key, values in attributes.items()
    }


def _separate_faces(buffers: Buffers) -> Buffers:
    """Return buffers in which every corner of a face is a vertex of its own.

    Missing normals are replaced by those of the faces, and missing texture coordinates
    by `DEFAULT_FACE_UVS`.
    """
    corners = buffers.faces.reshape(-1)
    vertices = buffers.vertices[corners]
    faces = np.arange(len(corners)).reshape(-1, 3)
    if buffers.normals is None:
        face_normals = _normalize(compute_area_vectors(vertices[faces]))
        normals = face_normals.repeat(3, axis=0)
    else:
        normals = buffers.normals[corners]
    if buffers.uvs is None:
        uvs = np.tile(DEFAULT_FACE_UVS, (len(faces), 1))
    else:
        uvs = buffers.uvs[corners]
    attributes = _select_vertices(buffers.attributes, corners)
    return Buffers(vertices, faces, normals, uvs, attributes)


def _load_buffers(shape: Mapping[str, object], name: str) -> Buffers:
    """Load a mesh with Mitsuba.

    Only entries of the geometry are loaded, without surface and light. Normals and
    texture coordinates are None if the mesh has none.

    Args:
        shape: the shape's dictionary.
        name: name of the object, for errors.

    Raises:
        InputError: Mitsuba refuses the mesh, or it has no faces.
    """
    mesh = _load_geometry(shape, name)
    parameters = mi.traverse(mesh)
    vertices = _read_buffer_rows(parameters, POSITIONS, width=3)
    faces = np.array(parameters[FACES], np.int64).reshape(-1, 3)
    if not len(faces):
        raise InputError(
            f"object {name}: expected a mesh with faces, got none; export triangles"
        )
    normals = None
    if mesh.has_vertex_normals():
        normals = _read_buffer_rows(parameters, NORMALS, width=3)
    uvs = None
    if mesh.has_vertex_texcoords():
        uvs = _read_buffer_rows(parameters, TEXCOORDS, width=2)
    attributes = _read_attributes(parameters, len(vertices), len(faces))
    return Buffers(vertices, faces, normals, uvs, attributes)


def _load_geometry(shape: Mapping[str, object], name: str) -> Any:
    """Return Mitsuba's mesh of a shape, without surface and light.

    If Mitsuba refuses it, an InputError says so.
    """
    entries = {key: value for key, value in shape.items() if key in MESH_ENTRIES}
    try:
        with suppress_warnings():
            mesh = mi.load_dict(to_loadable(entries))
    except RuntimeError as error:
        raise InputError(
            f"object {name}: Mitsuba refuses the shape: {error}; change it there"
        ) from error
    return mesh


def _read_buffer_rows(parameters: Any, key: str, width: int) -> Float64Array:
    """Return a flat buffer of a mesh as rows (n, width)."""
    return np.array(parameters[key], np.float64).reshape(-1, width)


def _read_attributes(
    parameters: Any, n_vertices: int, n_faces: int
) -> dict[str, Float32Array]:
    """Return the attributes (vertices or faces, c) of a mesh, such as colors, by name.

    Names of attributes begin with what they belong to: "vertex_color", "face_color".
    The names of Mitsuba's own arrays of vertices begin in the same manner, and are left
    out. Parameters of the mesh's surface and light have a dot in their names.
    """
    attributes: dict[str, Float32Array] = {}
    count_by_prefix = {"vertex": n_vertices, "face": n_faces}
    for key in parameters.keys():
        count = count_by_prefix.get(key.split("_")[0], 0)
        is_attribute = key not in (POSITIONS, NORMALS, TEXCOORDS) and "." not in key
        if count and is_attribute:
            values = np.array(parameters[key], np.float32)
            attributes[str(key)] = values.reshape(count, -1)
    return attributes


def _normalize(vectors: Float64Array) -> Float64Array:
    """Return vectors (n, 3) scaled to unit length; one of length 0 stays."""
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.maximum(lengths, 1e-30))


def _tessellate(kind: str, shape: Mapping[str, object], name: str) -> Buffers:
    """Make the triangles of one of `TESSELLATED_SHAPES`, with Mitsuba's texture
    coordinates.

    The shape is made as Mitsuba's unit shape first, then posed by its own numbers and
    its `to_world`. Faces without area are left out; round shapes have `ROUND_SEGMENTS`
    around.

    Args:
        kind: type of the shape, such as "sphere".
        shape: its dictionary.
        name: name of the object, for errors.

    Raises:
        InputError: its pose has a determinant of 0, so that it has no extent.
    """
    vertices, faces, normals, uvs = _make_unit_shape(kind)  # in its fields' order
    shape_pose = _compute_shape_pose(kind, shape)
    # without faces that have no area, such as those at a pole
    areas = np.linalg.norm(compute_area_vectors(vertices[faces]), axis=1)
    faces = faces[areas > 1e-9]
    matrix = get_pose(shape) @ shape_pose
    if not abs(np.linalg.det(matrix[:3, :3])) > 0.0:
        raise InputError(
            f"object {name}: expected a {kind} of some size, got one "
            "without extent; change its numbers"
        )
    posed_vertices = vertices @ matrix[:3, :3].T + matrix[:3, 3]
    # Normals are transformed by the inverse transpose. They are rows here, so that they
    # are multiplied by the inverse itself.
    posed_normals = _normalize(normals @ np.linalg.inv(matrix[:3, :3]))
    return Buffers(posed_vertices, faces, posed_normals, uvs, attributes={})


def _compute_shape_pose(kind: str, shape: Mapping[str, object]) -> Float64Array:
    """Return the pose (4, 4) of a unit shape by the shape's own numbers."""
    if kind == "cylinder":
        return _compute_cylinder_pose(shape)
    pose = np.eye(4)
    if kind == "sphere":
        pose[:3, :3] *= _get_radius(shape)
        pose[:3, 3] = np.asarray(shape.get("center", (0.0, 0.0, 0.0)), np.float64)
    return pose


class _UnitShape(NamedTuple):
    """The triangles of one of Mitsuba's shapes before it is posed."""

    vertices: Float64Array  # (V, 3)
    faces: IntArray  # (F, 3)
    normals: Float64Array  # (V, 3)
    uvs: Float64Array  # (V, 2) texture coordinates


def _make_unit_shape(kind: str) -> _UnitShape:
    """Return the triangles of one of `TESSELLATED_SHAPES` as Mitsuba's unit shape."""
    turns = np.linspace(0.0, 1.0, ROUND_SEGMENTS + 1)  # fractions of a full turn
    if kind == "sphere":
        return _make_unit_sphere(turns)
    if kind == "cylinder":
        return _make_unit_cylinder(turns)
    if kind == "disk":
        return _make_unit_disk(turns)
    return _make_unit_rectangle()


def _make_unit_sphere(turns: Float64Array) -> _UnitShape:
    """Return a sphere of radius 1, whose segments have borders at fractions of a turn.

    u goes around, and v from pole to pole, with half as many segments.
    """
    uvs, faces = _make_grid(turns, turns[::2])
    polar = np.pi * uvs[:, 1]
    x, y = np.sin(polar) * _compute_circle_points(uvs[:, 0])
    vertices = np.stack([x, y, np.cos(polar)], axis=1)
    return _UnitShape(vertices, faces, normals=vertices, uvs=uvs)


def _make_unit_cylinder(turns: Float64Array) -> _UnitShape:
    """Return a cylinder of radius and height 1, open at both ends, as Mitsuba's.

    u goes around, with segments that have borders at fractions of a turn, and v along
    the axis.
    """
    uvs, faces = _make_grid(turns, np.array([0.0, 1.0]))
    x, y = _compute_circle_points(uvs[:, 0])
    vertices = np.stack([x, y, uvs[:, 1]], axis=1)
    return _UnitShape(vertices, faces, normals=vertices * (1.0, 1.0, 0.0), uvs=uvs)


def _make_unit_disk(turns: Float64Array) -> _UnitShape:
    """Return a disk of radius 1, whose segments have borders at fractions of a turn.

    v goes around. u is the radius, along which the disk is flat: an eighth of the
    segments is enough.
    """
    uvs, faces = _make_grid(turns[::8], turns)
    x, y = uvs[:, 0] * _compute_circle_points(uvs[:, 1])
    vertices = np.stack([x, y, np.zeros(len(uvs))], axis=1)
    return _UnitShape(vertices, faces, _make_upward_normals(vertices), uvs)


def _make_unit_rectangle() -> _UnitShape:
    """Return a square from -1 to 1 along x and y."""
    uvs, faces = _make_grid(np.array([0.0, 1.0]), np.array([0.0, 1.0]))
    vertices = np.column_stack([uvs * 2.0 - 1.0, np.zeros(4)])
    return _UnitShape(vertices, faces, _make_upward_normals(vertices), uvs)


def _make_upward_normals(vertices: Float64Array) -> Float64Array:
    """Return the normal +z for each of the vertices (V, 3) of a flat shape."""
    return np.tile((0.0, 0.0, 1.0), (len(vertices), 1))


def _get_radius(shape: Mapping[str, object]) -> float:
    """Return the radius that a shape states; Mitsuba's default is 1."""
    return float(np.asarray(shape.get("radius", 1.0), np.float64))


def _compute_cylinder_pose(shape: Mapping[str, object]) -> Float64Array:
    """Return the pose (4, 4) that makes the unit cylinder along z the cylinder of a
    shape.

    The shape has `radius`, and goes from `p0` to `p1`.
    """
    start = np.asarray(shape.get("p0", (0.0, 0.0, 0.0)), np.float64)
    end = np.asarray(shape.get("p1", (0.0, 0.0, 1.0)), np.float64)
    radius = _get_radius(shape)
    length = float(np.linalg.norm(end - start))
    axis = (end - start) / max(length, 1e-30)  # not by 0
    x_axis, y_axis = _compute_perpendicular_axes(axis)
    pose = np.eye(4)
    pose[:3] = np.stack(
        [x_axis * radius, y_axis * radius, axis * length, start], axis=1
    )
    return pose


def _compute_perpendicular_axes(
    axis: Float64Array,
) -> tuple[Float64Array, Float64Array]:
    """Return two unit vectors (3,) perpendicular to an axis and to each other.

    They are those of Mitsuba's `coordinate_system` (Duff et al. 2017), which is not
    called because it computes in float32.
    """
    x, y, z = axis
    # The sign keeps the divisor away from 0.
    sign = np.copysign(1.0, z)
    factor = -1.0 / (sign + z)
    x_axis = np.array([1.0 + sign * x * x * factor, sign * x * y * factor, -sign * x])
    y_axis = np.array([x * y * factor, sign + y * y * factor, -y])
    return x_axis, y_axis


def _make_grid(u: Float64Array, v: Float64Array) -> tuple[Float64Array, IntArray]:
    """Return the points (n, 2) of a grid and its triangles (m, 3).

    Each cell of the grid is cut into two triangles. Their corners are in
    counterclockwise order, with u to the right and v up.

    Args:
        u: coordinates of the points in each row.
        v: coordinate of each row.
    """
    points = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    row_starts = np.arange(len(v) - 1)[:, None] * len(u)
    # index of the point at the corner of each cell with the smallest u and v
    corner = (row_starts + np.arange(len(u) - 1)).reshape(-1)
    corner_above = corner + len(u)  # in the next row
    lower = np.stack([corner, corner + 1, corner_above + 1], axis=1)
    upper = np.stack([corner, corner_above + 1, corner_above], axis=1)
    return points, np.concatenate([lower, upper])


def _compute_circle_points(turns: Float64Array) -> Float64Array:
    """Return x and y (2, n) on the unit circle, for fractions (n,) of a turn."""
    return np.asarray([np.cos(2.0 * np.pi * turns), np.sin(2.0 * np.pi * turns)])


def get_pose(plugin: Mapping[str, object]) -> Float64Array:
    """Return the pose (4, 4) of a plugin."""
    return np.asarray(plugin.get("to_world", np.eye(4)), dtype=np.float64)


Plugins = Mapping[str, Mapping[str, object]]
MAX_EXTINCTION = 2.0  # largest extinction of a haze per object size
MIN_ALBEDO = 1e-3  # smallest albedo of a haze
# largest distance of the ball's center from the object's, in radii; its edge is far off
MAX_CENTER_OFFSET = 0.05
_OF_BALL = {"type", "id", "radius", "center", "to_world", "bsdf", "interior"}
_OF_MEDIUM = {"type", "id", "sigma_t", "albedo", "scale", "phase"}
_UNIFORM_OR_GRID_MEDIA = ("homogeneous", "heterogeneous")


def find_haze(
    named: Plugins, matrix: Float64Array
) -> tuple[HazePart, frozenset[str]] | None:
    """Find the haze of a scene.

    A haze is one grey medium in a ball that the camera stands in: the camera names it
    as its medium. Mitsuba's `prbvolpath` does not see it between the camera and the
    first surface, so our own integrator renders it, from a `HazePart`. All other media
    stay as they are.

    Args:
        named: the scene's plugins by name.
        matrix: (4, 4) from the scene to the object's coordinates, with one scale for
            all directions.

    Returns:
        The haze and the names of the plugins that it is made of; None if there is none,
        or if it cannot be rendered as one: not grey, out of range, or a ball whose
        center is not near the object's.
    """
    names = _find_haze_plugins(named)
    if names is None:
        return None
    ball_name, medium_name = names
    radius = _measure_haze_ball(named[ball_name], matrix)
    if radius is None:
        return None
    coefficients = _read_haze_medium(named[medium_name], matrix)
    if coefficients is None:
        return None
    extinction, albedo = coefficients
    haze = HazePart(ball_name, radius, extinction, albedo)
    return haze, frozenset((ball_name, medium_name))


def _measure_haze_ball(
    ball: Mapping[str, object], matrix: Float64Array
) -> float | None:
    """Return the radius of a haze's ball, in object sizes.

    The result is None if the ball's center is not near the object's.

    Args:
        ball: the ball's dictionary.
        matrix: (4, 4) from the scene to the object's coordinates, with one scale for
            all directions.
    """
    pose = matrix @ get_pose(ball)
    # Numbers that are not understood are NaN here, for which the comparisons below are
    # false.
    ball_center = np.broadcast_to(_parse_numbers(ball.get("center", np.zeros(3))), (3,))
    center = pose @ np.append(ball_center, 1.0)
    scene_radius = float(_parse_numbers(ball.get("radius", 1.0))[0])
    # the cube root of the determinant is the scale of lengths
    radius = scene_radius * float(np.cbrt(abs(np.linalg.det(pose[:3, :3]))))
    # Our haze is a ball around the object, which is at the origin of these coordinates.
    is_centered = float(np.linalg.norm(center[:3])) <= MAX_CENTER_OFFSET * radius
    return radius if radius > 0.0 and is_centered else None


def _read_haze_medium(
    medium: Mapping[str, object], matrix: Float64Array
) -> tuple[float, tuple[float, float, float]] | None:
    """Return the extinction, per object size, and the albedo (RGB) of a medium.

    The result is None if the medium is not grey, or out of range. Numbers that are not
    understood are NaN, for which all comparisons are false.

    Args:
        medium: the medium's dictionary.
        matrix: (4, 4) from the scene to the object's coordinates, with one scale for
            all directions.
    """
    density = _parse_numbers(medium.get("sigma_t", 1.0))
    scale = _parse_numbers(medium.get("scale", 1.0))
    # `matrix` multiplies lengths by the cube root of its determinant. The extinction is
    # per length, so that it is divided by that.
    length_scale = float(np.cbrt(abs(np.linalg.det(matrix[:3, :3]))))
    extinction = density * scale / length_scale
    # A color has three values, which are equal if it is grey. NaN is not equal to
    # itself.
    is_grey = float(extinction.min()) == float(extinction.max())
    is_in_range = 0.0 < float(extinction.min()) <= MAX_EXTINCTION
    albedo = np.broadcast_to(_parse_numbers(medium.get("albedo", 0.75)), (3,)).tolist()
    has_albedo = MIN_ALBEDO <= min(albedo) and max(albedo) <= 1.0
    if not (is_grey and is_in_range and has_albedo):
        return None
    red, green, blue = albedo
    return float(extinction[0]), (red, green, blue)


def _find_haze_plugins(named: Plugins) -> tuple[str, str] | None:
    """Return the names of the ball and of the medium of a haze; None without one.

    The scene has a haze if its only medium is homogeneous and isotropic, if cameras
    stand in that medium, and if it fills a single sphere without a surface. The ball
    and the medium may have only the entries in `_OF_BALL` and `_OF_MEDIUM`: a haze has
    no others.
    """
    # Of all plugins only cameras have an entry "medium", the one that they stand in.
    camera_media = {_get_reference(plugin.get("medium")) for plugin in named.values()}
    camera_media.discard(None)
    ball_names = _find_filled_balls(named, camera_media)
    medium_names = _list_media(named)
    is_single_haze = len(camera_media) == len(ball_names) == len(medium_names) == 1
    if not is_single_haze:
        return None
    (ball_name,) = ball_names
    (medium_name,) = medium_names
    is_plain = _is_plain_ball(named[ball_name]) and _is_plain_medium(named[medium_name])
    if not (is_plain and camera_media == {medium_name}):
        return None
    return ball_name, medium_name


def _list_media(named: Plugins) -> list[str]:
    """Return the names of the media of a scene."""
    return [
        name
        for name, plugin in named.items()
        if plugin["type"] in _UNIFORM_OR_GRID_MEDIA
    ]


def _find_filled_balls(named: Plugins, media: Collection[str | None]) -> list[str]:
    """Return the names of spheres that are filled with one of some media."""
    return [
        name
        for name, plugin in named.items()
        if plugin["type"] == "sphere"
        and _get_reference(plugin.get("interior")) in media
    ]


def _is_plain_ball(ball: Mapping[str, object]) -> bool:
    """Return whether a ball has no surface, and no entry that a haze has not."""
    return set(ball) <= _OF_BALL and ball.get("bsdf") == {"type": "null"}


def _is_plain_medium(medium: Mapping[str, object]) -> bool:
    """Return whether a medium is homogeneous and isotropic, and has no other entry."""
    isotropic_phase = {"type": "isotropic"}
    return (
        set(medium) <= _OF_MEDIUM
        and medium["type"] == "homogeneous"
        and medium.get("phase", isotropic_phase) == isotropic_phase
    )


def _get_reference(plugin: object) -> str | None:
    """Return the id that a reference names; None for anything else."""
    if isinstance(plugin, Mapping) and plugin.get("type") == "ref":
        return str(plugin["id"])
    return None


def _parse_numbers(value: object) -> Float64Array:
    """Return a number (1,), or the three of a color; NaN (1,) for anything else.

    A color may be a plugin, such as `{"type": "rgb", "value": [0.1, 0.2, 0.3]}`.
    """
    not_understood = np.full(1, np.nan)
    value = _unwrap_constant(value)  # None, of another plugin, becomes NaN below
    # NumPy would convert a string or a bool to a number
    if isinstance(value, (str, bool)):
        return not_understood
    try:
        numbers = np.atleast_1d(np.asarray(value, np.float64))
    except (TypeError, ValueError):  # such as pairs of wavelength and value
        return not_understood
    is_number_or_color = numbers.shape in ((1,), (3,))
    if is_number_or_color and np.isfinite(numbers).all():
        return numbers
    return not_understood


def _unwrap_constant(value: object) -> object:
    """Return the value of a plugin that is one color; of any other plugin, None.

    What is no plugin is returned as it is.
    """
    if not isinstance(value, Mapping):
        return value
    is_constant = value.get("type") in ("rgb", "uniform", "spectrum", "srgb")
    return value.get("value") if is_constant else None


# ---- The surface of a Mitsuba shape: its base color, which is searched; all the rest
# stays as it is

BASE_COLOR_KEYS = {  # surfaces with a base color, and its name there
    "diffuse": "reflectance",
    "principled": "base_color",
    "principledthin": "base_color",
    "plastic": "diffuse_reflectance",
    "roughplastic": "diffuse_reflectance",
    "pplastic": "diffuse_reflectance",
}
DEFAULT_REFLECTANCE = (
    0.5  # reflectance of a surface that states none: Mitsuba's default
)
CONSTANT_SIZE = 8  # width and height of a base color that is the same everywhere
# smallest width and height of a base color whose texels are not interpolated: smaller
# ones are repeated
MIN_NEAREST_SIZE = 256
# looked up by texture coordinates, after a transform of their own
UV_TEXTURES = frozenset(("bitmap", "checkerboard"))
MESH_BOUND_PLUGINS = UV_TEXTURES | {"mesh_attribute", "normalmap", "bumpmap", "hair"}
"""Plugins that look different with other texture coordinates, or without attributes."""
# entries of surfaces that look different along u and v
ANISOTROPIC_ENTRIES = frozenset(("alpha_u", "alpha_v", "anisotropic"))
IMAGE_ENTRIES = frozenset(
    ("type", "id", "bitmap", "filename", "raw", "format", "to_uv")
)
"""Entries of a bitmap that have been used once its pixels are read."""


@dataclass(frozen=True, eq=False)
class ShapeSurface:
    """Surface of a shape, separated from its base color."""

    # Dictionary of the surface. The base color, if there is one, is replaced by
    # `{"type": BASE_COLOR}` with the options of its look-up (`wrap_mode`,
    # `filter_type`).
    plugin: Plugin
    # (H, W, 3) float32 display-referred, row 0 on top; `DEFAULT_REFLECTANCE` if the
    # surface has no base color
    base_color: Float32Array
    is_textured: bool  # whether the base color varies over the surface
    # (3, 3) from the mesh's texture coordinates to those of the base color and of
    # `plugin`, v downwards
    to_uv: Float64Array
    # whether the surface would look different on a mesh with other texture coordinates
    # or attributes
    is_bound: bool
    notes: tuple[str, ...]  # clauses about differences from the scene


class _Color(NamedTuple):
    """A base color."""

    linear: Float32Array  # (H, W, 3)
    options: Plugin  # entries that control the look-up, such as "wrap_mode"
    to_uv: object = None  # its own transform of texture coordinates


def read_surface(bsdf: Mapping[str, object]) -> ShapeSurface:
    """Take the first base color out of a surface: a color, a bitmap or a checkerboard.

    If the base color has a transform of texture coordinates, it is applied to the
    mesh. All other textures of the surface then undo it first, so that they look the
    same as before. A base color is cut to [0, 1], and a surface without one is grey;
    the result's notes say so.
    """
    surface, color = _take_base_color(bsdf)
    linear = _make_default_color() if color is None else color.linear
    transform = None if color is None else color.to_uv
    is_bound = _is_mesh_bound(surface)
    notes = _describe_surface(surface, linear)
    surface, to_uv = _apply_uv_transform(surface, transform)
    return ShapeSurface(
        plugin=surface,
        base_color=linear_to_srgb(np.clip(linear, 0.0, 1.0)),
        is_textured=not _is_constant_color(linear),
        to_uv=to_uv,
        is_bound=is_bound,
        notes=tuple(notes),
    )


def _make_default_color() -> Float32Array:
    """Return the base color (H, W, 3) of a surface that has none: grey."""
    size = (CONSTANT_SIZE, CONSTANT_SIZE, 3)
    return np.full(size, DEFAULT_REFLECTANCE, np.float32)


def _is_constant_color(linear: Float32Array) -> bool:
    """Return whether a base color (H, W, 3) is a constant and no texture.

    `_parse_base_color` gives a constant color one size. A larger image is a texture,
    even if all its texels are equal.
    """
    has_constant_size = linear.shape[:2] == (CONSTANT_SIZE, CONSTANT_SIZE)
    varies = bool(np.ptp(linear, axis=(0, 1)).any())
    return has_constant_size and not varies


def _is_mesh_bound(surface: Plugin) -> bool:
    """Return whether a surface depends on texture coordinates or attributes of the
    mesh.

    The base color is not counted.
    """
    return any(
        plugin["type"] in MESH_BOUND_PLUGINS or ANISOTROPIC_ENTRIES & set(plugin)
        for plugin in iterate_plugins(surface)
    )


def _take_base_color(bsdf: Mapping[str, object]) -> tuple[Plugin, _Color | None]:
    """Replace the first base color of a surface by the placeholder `BASE_COLOR`.

    The first is that of the outermost plugin which has one.

    Returns:
        The surface with the placeholder, and the base color; None if there is none.
    """
    base: _Color | None = None

    def replace_color(plugin: Mapping[str, object]) -> Plugin:
        """Return a plugin, and store and replace its base color if it is the first."""
        nonlocal base
        key = BASE_COLOR_KEYS.get(str(plugin["type"]))
        if key is not None and base is None:
            # None for a color that cannot be read; then the search goes on
            base = _parse_base_color(plugin.get(key, DEFAULT_REFLECTANCE))
            if base is not None:
                plugin = {**plugin, key: {"type": BASE_COLOR, **base.options}}
        return map_inner_plugins(plugin, replace_color)

    return replace_color(bsdf), base


def _describe_surface(surface: Plugin, linear: Float32Array) -> list[str]:
    """Return clauses about how a surface differs from the one in the scene.

    Args:
        surface: the surface, with the placeholder `BASE_COLOR` if it has a base color.
        linear: linear values of its base color, of any shape.
    """
    clauses = []
    types = {str(plugin["type"]) for plugin in iterate_plugins(surface)}
    if BASE_COLOR not in types:
        reason = _explain_missing_color(surface, types)
        clauses.append(
            f"it has no base color that can be searched ({reason}), so that the "
            "controls texture, patch and material cannot be used on it"
        )
    # with a tolerance for rounding; NaN is out of range too
    if not (linear.min() >= 0.0 and linear.max() <= 1.0 + 1e-4):
        clauses.append("its base color is clipped to reflectances from 0 to 1")
    return clauses


def _explain_missing_color(surface: Plugin, types: set[str]) -> str:
    """Return why a surface has no base color that can be searched, as a clause.

    `types` are those of the surface and of all plugins in it.
    """
    unsupported_colors = sorted(types & {"mesh_attribute", "volume"})
    if unsupported_colors:
        return f"its color is a {unsupported_colors[0]}"
    return f"a {surface['type']} has none"


def _apply_uv_transform(
    surface: Plugin, transform: object
) -> tuple[Plugin, Float64Array]:
    """Apply a base color's transform of texture coordinates to those of the mesh.

    Then the base color, which is searched, needs no transform. All other textures of
    the surface undo it first, by its inverse, so that they look the same. That is
    possible only if the transform has an inverse. If the surface uses tangents along u,
    their direction must also stay the same. Otherwise the base color keeps its
    transform, and the mesh is not changed.

    Args:
        surface: the surface, with the placeholder of the base color.
        transform: the base color's `to_uv`, (3, 3) or (4, 4); None if it has none.

    Returns:
        The surface with changed transforms, and the (3, 3) transform of the mesh's
        texture coordinates.
    """
    to_uv = np.eye(3) if transform is None else to_uv_matrix(transform)
    uses_tangents = _has_tangents(surface)
    # A step along u must remain one along u, in the same direction: it must not change
    # v, and the new u must grow with the old one.
    keeps_tangents = to_uv[1, 0] == 0.0 and to_uv[0, 0] > 0.0
    is_invertible = abs(np.linalg.det(to_uv)) > 1e-12
    if not is_invertible or (uses_tangents and not keeps_tangents):
        return _with_transform(surface, to_uv, BASE_COLOR), np.eye(3)
    if not np.array_equal(to_uv, np.eye(3)):
        inverse = np.asarray(np.linalg.inv(to_uv), np.float64)
        # all textures but the base color, whose placeholder is none of these types
        surface = _with_transform(surface, inverse, *UV_TEXTURES)
    return surface, to_uv


def _has_tangents(surface: Plugin) -> bool:
    """Return whether a surface looks different with other tangents along u."""
    return any(
        plugin["type"] in ("normalmap", "hair") or ANISOTROPIC_ENTRIES & set(plugin)
        for plugin in iterate_plugins(surface)
    )


def _with_transform(
    plugin: Mapping[str, object], before: Float64Array, *kinds: str
) -> Plugin:
    """Return a plugin in which textures of some kinds get a transform of coordinates.

    Inner plugins are changed too, at any depth.

    Args:
        plugin: the plugin.
        before: (3, 3) transform that is applied before the texture's own one.
        kinds: types of the textures that are changed, such as "bitmap".
    """
    changed = map_inner_plugins(
        plugin, lambda inner: _with_transform(inner, before, *kinds)
    )
    if changed["type"] in kinds:
        transform = np.eye(4)
        # (3, 3) into Mitsuba's (4, 4), whose third axis is not used
        transform[np.ix_((0, 1, 3), (0, 1, 3))] = (
            to_uv_matrix(plugin.get("to_uv", np.eye(3))) @ before
        )
        changed["to_uv"] = transform
    return changed


def to_uv_matrix(value: object) -> Float64Array:
    """Return a transform of texture coordinates (3, 3).

    Of one with (4, 4) it is what Mitsuba takes: the rows and columns of x, y and 1.
    """
    matrix = np.asarray(value, dtype=np.float64)
    return matrix if matrix.shape == (3, 3) else matrix[np.ix_((0, 1, 3), (0, 1, 3))]


def _parse_base_color(value: object) -> _Color | None:
    """Return a color, a checkerboard or a bitmap as a base color; else None."""
    constant = parse_constant_color(value)
    if constant is not None:
        size = (CONSTANT_SIZE, CONSTANT_SIZE, 3)
        return _Color(linear=np.broadcast_to(constant, size), options={})
    if not isinstance(value, Mapping):
        return None
    if value["type"] == "checkerboard":
        return _parse_checkerboard(value)
    return _parse_bitmap(value) if value["type"] == "bitmap" else None


def _parse_bitmap(value: Mapping[str, object]) -> _Color | None:
    """Return a bitmap as a base color; None if it cannot be read here."""
    pixels = _read_pixels(value)
    if pixels is None:
        return None
    # What is left is how the image is looked up. `IMAGE_ENTRIES` also has `to_uv`,
    # which is a field of its own.
    options = {key: entry for key, entry in value.items() if key not in IMAGE_ENTRIES}
    if options.get("filter_type") == "nearest":
        pixels = _repeat_texels(pixels)  # so that its texels stay sharp
    return _Color(linear=pixels, options=options, to_uv=value.get("to_uv"))


def _parse_checkerboard(plugin: Mapping[str, object]) -> _Color | None:
    """Return a checkerboard as a base color; None if its fields are textures.

    It is a texture of 2 x 2 texels that are not interpolated. The result is also None
    for a plugin with entries that are not known here.
    """
    # the defaults are Mitsuba's
    first_color = parse_constant_color(plugin.get("color0", 0.4))
    second_color = parse_constant_color(plugin.get("color1", 0.2))
    unknown = set(plugin) - {"type", "id", "color0", "color1", "to_uv"}
    if first_color is None or second_color is None or unknown:
        return None
    # Rows are along Mitsuba's v. The first color is where u and v are both in the lower
    # half or both in the upper half.
    checkerboard = np.array(
        [[first_color, second_color], [second_color, first_color]], np.float32
    )
    return _Color(
        linear=_repeat_texels(checkerboard),
        options={"filter_type": "nearest"},
        to_uv=plugin.get("to_uv"),
    )


def _repeat_texels(texture: Float32Array) -> Float32Array:
    """Enlarge a texture by repeating texels, to at least `MIN_NEAREST_SIZE` a side.

    It is for textures that are not interpolated. A control that changes the texture may
    interpolate it. In the larger texture, that blurs only the borders of the texels.
    """
    # twice negated, so that the quotients are rounded up
    row_repeats, column_repeats = (
        -(-MIN_NEAREST_SIZE // size) for size in texture.shape[:2]
    )
    return texture.repeat(row_repeats, axis=0).repeat(column_repeats, axis=1)


def _read_pixels(value: Mapping[str, object]) -> Float32Array | None:
    """Return the linear values (H, W, 3) of a bitmap; None if it cannot be read here.

    An array holds linear values already; its alpha is left out. A file or one of
    Mitsuba's bitmaps is converted from sRGB, unless it is raw.

    Args:
        value: dictionary of the bitmap plugin.
    """
    image = value.get("bitmap")
    if isinstance(image, np.ndarray):
        return _expand_to_rgb(image)
    if image is None and "filename" not in value:
        return None
    try:
        bitmap = mi.Bitmap(str(value["filename"]) if image is None else image)
    except (RuntimeError, TypeError):
        return None  # Mitsuba gives the reason when the scene is loaded
    if value.get("raw"):  # its values are taken as linear
        bitmap.set_srgb_gamma(False)
    return np.array(
        bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False),
        dtype=np.float32,
    )


def _expand_to_rgb(image: np.ndarray[Any, Any]) -> Float32Array:
    """Return an image (H, W) or (H, W, channels) as (H, W, 3), without its alpha."""
    if image.ndim == 2:  # grey
        image = image[:, :, None]
    # without alpha, the second or the fourth channel
    image = image[:, :, :1] if image.shape[2] == 2 else image[:, :, :3]
    return np.broadcast_to(image, (*image.shape[:2], 3)).astype(np.float32)


def parse_constant_color(value: object) -> Float32Array | None:
    """Return a color (3,) that is the same everywhere; None for anything else."""
    numbers = _parse_numbers(value)
    if np.isnan(numbers).any():
        return None
    return np.broadcast_to(numbers, (3,)).astype(np.float32)
