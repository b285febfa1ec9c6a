"""Scenes from glTF files: one node as the object, the rest as its surroundings.

``--object scene.glb#chair`` selects the node. Lengths are in object sizes: all of the
scene is moved and scaled so that the object's largest extent is 1 and the object stands
on z = 0. z is up. The axis of the file that its format defines as the front of an asset
becomes +x.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from advsearch.errors import InputError, UnknownNameError
from advsearch.scene.assets import (
    FileAxis,
    Float64Array,
    ObjectAsset,
    compute_area_vectors,
    find_footing,
)
from advsearch.scene.importing import gltf, gltf_parts
from advsearch.scene.importing.files import (
    UniqueNames,
    format_name,
    make_safe_name,
    sanitize_name,
)
from advsearch.scene.importing.geometry import MIN_DOUBLED_AREA, compute_rotation
from advsearch.scene.importing.gltf_entries import (
    GENERATOR,
    CameraEntry,
    Header,
    LightEntry,
    Perspective,
)
from advsearch.scene.importing.gltf_skeleton import iterate_node_poses
from advsearch.scene.importing.objects import find_front_axis, make_object, read_parts
from advsearch.scene.importing.parts import ImportedPart, select_visible_parts
from advsearch.scene.importing.readers import (
    GLTF_SUFFIXES,
    list_suffixes,
    read_mesh_bytes,
)
from advsearch.scene.parts import (
    PointLamp,
    PosedCamera,
    ScenePart,
    SpotLamp,
    make_mesh_part,
)
from advsearch.scene.skeleton import with_ancestors

GLTF_CAMERA_AXES = np.diag([-1.0, 1.0, -1.0])
"""Rotation (3, 3) that converts a camera's axes: a camera of glTF looks along -z with +x
to the right, ours along +z with +x to the left.
"""
MITSUBA_SUFFIX = ".xml"  # suffix of Mitsuba's scenes
LUMENS = 683.0
"""Lumens of a watt, at 555 nm. Blender's exporter multiplies the power of lights by this
factor, but not the emission of surfaces.
"""
# Limit of the distance of a light or camera in object sizes, and of the radiant
# intensity of a light.
MAX_DISTANCE = 1e12
MAX_AXIS_COSINE = 1e-3  # largest cosine of the angle between two axes of a camera
# Largest field of view of a camera along the larger side of its image, degrees.
MAX_FOV = 170.0
MAX_SURROUNDINGS = 200  # meshes and lamps around an object
RESERVED_NAMES = frozenset(("object", "environment", "ground", "camera", "orbit"))


@dataclass(frozen=True, eq=False)
class ImportedScene:
    """The content of a scene file."""

    object: ObjectAsset  # the requested node, with all its descendants
    surroundings: tuple[ScenePart, ...] = ()  # the other meshes, and lamps
    cameras: Mapping[str, PosedCamera] = field(default_factory=dict)  # cameras by name


def split_node_argument(spec: str) -> tuple[str, str | None]:
    """Split ``scene.glb#chair`` into the file and the node, None if none is named."""
    suffixes = "|".join(map(re.escape, (*GLTF_SUFFIXES, MITSUBA_SUFFIX)))
    match = re.fullmatch(rf"(.+({suffixes}))#(.*)", spec, re.IGNORECASE | re.DOTALL)
    if match is None or os.path.exists(spec):
        return spec, None
    return match[1], match[3]


# Values out of range are rejected later, not reported by NumPy's warnings.
@np.errstate(all="ignore")
def import_scene(path: Path, node: str) -> ImportedScene:
    """Read a scene from a glTF file, with one node as the object.

    The object is repaired, normalized and textured as by `import_object`. So is every
    other node with a mesh, which keeps its position relative to the object. Point and
    spot lights of KHR_lights_punctual become lamps, directional lights distant lamps.
    Perspective cameras are returned by name. The object's warnings name all entries of
    the file that are not imported.

    Args:
        path: the .glb or .gltf file.
        node: name of the node, or of its mesh if the node has no name; "node 3" is the
            node with that index.

    Raises:
        UnknownNameError: there is no node of that name with a mesh in or below it.
        FileFormatError: the file is missing, corrupt, or has no faces.
        InputError: the geometry cannot be used; several nodes have the name; or there
            are too many other meshes and lights.
    """
    data = read_mesh_bytes(path, "scene", GLTF_SUFFIXES)
    header = gltf.read_header(path, data)
    parts, notes = read_parts(path, data)
    node_poses = dict(iterate_node_poses(header))
    # The named node with its descendants is the object; the rest surrounds it.
    object_nodes = header.find_descendants([_find_node(path, header, parts, node)])
    object_parts = [part for part in parts if part.node in object_nodes]
    lights = _find_node_lights(header, node_poses)
    n_other_meshes = len({part.node for part in parts} - object_nodes)
    _check_surroundings(path, n_other_meshes + len(lights))
    front = find_front_axis(path, header)
    # y is up in glTF. Surroundings are converted to the object's frame.
    frame = _compute_frame(object_parts, compute_rotation("y", front.axis))
    names = UniqueNames(RESERVED_NAMES)
    surroundings = _make_surrounding_meshes(
        path, header, parts, object_nodes, names, front, frame, notes
    )
    candela_per_unit = _choose_light_unit(path, header, parts, bool(lights), notes)
    surroundings += _make_lamps(
        path, header, lights, candela_per_unit, node_poses, names, frame
    )
    cameras = _make_cameras(path, header, node_poses, frame)
    notes.extend(gltf_parts.describe_changed_lights(header, path.name))
    asset = _make_node_object(path, node, object_parts, front, notes)
    return ImportedScene(asset, tuple(surroundings), cameras)


def _make_node_object(
    path: Path,
    node: str,
    parts: list[ImportedPart],
    front: FileAxis,
    notes: list[str],
) -> ObjectAsset:
    """Return the parts of a node as the object, whose name has those of file and node.

    `notes` are warnings about the file so far.
    """
    return make_object(
        parts,
        notes,
        file=path,
        name=f"{make_safe_name(path)}-{sanitize_name(node)}",
        up="y",
        front=front,
    )


def _find_node_lights(header: Header, nodes: Iterable[int]) -> dict[int, LightEntry]:
    """Return the light of each node that has one."""
    lights = {}
    for node in nodes:
        light_index = header.nodes[node].lamp
        if light_index is not None:
            lights[node] = header.lights[light_index]
    return lights


def _make_surrounding_meshes(
    path: Path,
    header: Header,
    parts: Sequence[ImportedPart],
    object_nodes: Collection[int],
    names: UniqueNames,
    front: FileAxis,
    frame: FileFrame,
    notes: list[str],
) -> list[ScenePart]:
    """Return the meshes of all nodes but those of the object.

    Args:
        path: the file, for messages.
        header: header of the file.
        parts: the parts that its nodes draw.
        object_nodes: the nodes of the object.
        names: names that are used already; those of the meshes are added.
        front: the axis of the file that is the front.
        frame: frame of the object.
        notes: warnings are added to it.
    """
    meshes: list[ScenePart] = []
    for index, name in _make_mesh_names(header, parts, names).items():
        if index not in object_nodes:
            node_parts = [part for part in parts if part.node == index]
            mesh, warnings = _make_surrounding_mesh(
                path, name, node_parts, front, frame
            )
            meshes.append(mesh)
            notes.extend(warnings)
    return meshes


def _make_lamps(
    path: Path,
    header: Header,
    lights: Mapping[int, LightEntry],
    candela_per_unit: float,
    node_poses: Mapping[int, Float64Array],
    names: UniqueNames,
    frame: FileFrame,
) -> list[ScenePart]:
    """Return the lights of nodes as lamps.

    Args:
        path: the file, for messages.
        header: header of the file.
        lights: the light of each node that has one, by the node's index.
        candela_per_unit: how many candela are one unit of radiant intensity.
        node_poses: pose (4, 4) of each node, by its index.
        names: names that are used already; those of the lamps are added.
        frame: frame of the object.

    Raises:
        InputError: a light is too far away or too bright.
    """
    lamps: list[ScenePart] = []
    for index, light in lights.items():
        name = names.make_unique(light.name or header.get_node_label(index))
        pose = node_poses[index]
        lamps.append(_make_lamp(path, name, light, candela_per_unit, pose, frame))
    return lamps


def _find_node(
    path: Path, header: Header, parts: Sequence[ImportedPart], name: str
) -> int:
    """Return the index of the node with a name that draws geometry.

    A node is a candidate if it or one of its descendants draws a part.

    Args:
        path: the file, for messages.
        header: header of the file.
        parts: the parts that its nodes draw.
        name: name of the node, or "node 3" for the one with that index.

    Raises:
        UnknownNameError: no candidate has the name.
        InputError: several candidates have the name.
    """
    drawing_nodes = {part.node for part in parts}
    candidates = sorted(with_ancestors(header.parent_of_node, drawing_nodes))
    labels = {index: header.get_node_label(index) for index in candidates}
    matches = [
        index for index, label in labels.items() if name in (label, f"node {index}")
    ]
    if not matches:
        known_names = list(dict.fromkeys(labels.values()))
        raise UnknownNameError(f"node of {path.name}", name, known_names)
    if len(matches) > 1:
        raise _make_ambiguous_node_error(path, name, matches)
    return matches[0]


def _make_ambiguous_node_error(
    path: Path, name: str, matches: Sequence[int]
) -> InputError:
    """Return the error for a name that several nodes have, which are listed."""
    choices = ", ".join(f"{path.name}#node {index}" for index in matches[:10])
    return InputError(
        f"{path}: {len(matches)} nodes have the name {format_name(name)}; choose "
        f"one of {choices}"
    )


def _check_surroundings(path: Path, count: int) -> None:
    """Raise InputError if there are more than `MAX_SURROUNDINGS` meshes and lamps."""
    if count > MAX_SURROUNDINGS:
        limit = f"at most {MAX_SURROUNDINGS} meshes and lights around the object"
        raise InputError(
            f"{path}: expected {limit}, got {count}; join some of them in the file"
        )


def _make_surrounding_mesh(
    path: Path,
    name: str,
    parts: list[ImportedPart],
    front: FileAxis,
    object_frame: FileFrame,
) -> tuple[ScenePart, tuple[str, ...]]:
    """Return one node's parts as a scene part around the object, and the warnings.

    The shape is normalized as an object is. Its pose restores its position and size
    relative to the object.

    Args:
        path: the file, for messages.
        name: name of the part.
        parts: the parts that the node draws.
        front: the axis of the file that is the front.
        object_frame: frame of the object.
    """
    frame = _compute_frame(parts, object_frame.rotation)
    shape = make_object(parts, notes=[], file=path, name=name, up="y", front=front)
    # Both meshes are normalised to an extent of 1. The scale restores the ratio of
    # their sizes in the file.
    mesh_to_object = np.eye(4)
    mesh_to_object[:3, :3] *= frame.size / object_frame.size
    mesh_to_object[:3, 3] = object_frame.to_frame(frame.origin)
    part = make_mesh_part(shape.name, shape, mesh_to_object, shape.material)
    return part, shape.warnings


def list_node_names(path: Path) -> list[str]:
    """Return the node names that `import_scene` accepts for a glTF file.

    Nodes are listed if they or their descendants have a mesh. A name that several nodes
    have is listed once.

    Raises:
        FileFormatError: the file is missing, corrupt, or no glTF.
    """
    header = gltf.read_header(path, read_mesh_bytes(path, "scene", GLTF_SUFFIXES))
    with_mesh = {
        index for index, node in enumerate(header.nodes) if node.mesh is not None
    }
    candidates = sorted(with_ancestors(header.parent_of_node, with_mesh))
    return list(dict.fromkeys(map(header.get_node_label, candidates)))


def _make_mesh_names(
    header: Header, parts: Sequence[ImportedPart], names: UniqueNames
) -> dict[int, str]:
    """Return a unique name for each node with parts, by the node's index."""
    nodes = sorted({part.node for part in parts})
    return {node: names.make_unique(header.get_node_label(node)) for node in nodes}


def _make_camera_names(header: Header, nodes: Iterable[int]) -> dict[int, str]:
    """Return a unique name for each node with a perspective camera, by index."""
    names = UniqueNames(RESERVED_NAMES)
    name_of_node = {}
    for index in sorted(nodes):
        camera = header.nodes[index].camera
        if camera is not None and header.cameras[camera].perspective is not None:
            label = header.cameras[camera].name or header.get_node_label(index)
            name_of_node[index] = names.make_unique(label)
    return name_of_node


@dataclass(frozen=True)
class NodeContents:
    """A node with geometry."""

    name: str  # name that `import_scene` accepts
    mesh_name: str  # name of its mesh in controls if another node is the object
    triangles: int  # number of triangles of its own mesh
    # Bounding box in the file's axes and units, (3,).
    size: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class FileContents:
    """The contents of a file that can be imported."""

    object: ObjectAsset  # all geometry of the file, as one object
    nodes: tuple[NodeContents, ...] = ()  # nodes of a glTF file, in their order
    lights: tuple[str, ...] = ()
    cameras: tuple[str, ...] = ()


def _group_by_node(parts: Iterable[ImportedPart]) -> dict[int, list[ImportedPart]]:
    """Return the parts that each node draws."""
    parts_of_node: dict[int, list[ImportedPart]] = {}
    for part in parts:
        parts_of_node.setdefault(part.node, []).append(part)
    return parts_of_node


# Values out of range are rejected later, not reported by NumPy's warnings.
@np.errstate(all="ignore")
def read_file_contents(path: Path) -> FileContents:
    """Return the contents of a mesh or glTF file that can be imported.

    The contents of Mitsuba's files are read by `scene_files.read_contents`.

    Raises:
        FileFormatError: the file is missing, of another kind, corrupt, or has no faces.
        InputError: the geometry cannot be used, such as vertices that all coincide.
    """
    # Errors about an unknown suffix also list the one of Mitsuba's files.
    data = read_mesh_bytes(path, "object", (*list_suffixes(), MITSUBA_SUFFIX))
    parts, notes = read_parts(path, data)
    if path.suffix.lower() not in GLTF_SUFFIXES:
        # The axis that points up is guessed from the shape.
        return FileContents(_make_full_object(path, parts, notes, header=None))
    header = gltf.read_header(path, data)
    notes += gltf_parts.describe_changed_lights(header, path.name)
    asset = _make_full_object(path, parts, notes, header)
    light_names = tuple(
        light.name or f"light {index}" for index, light in enumerate(header.lights)
    )
    node_poses = dict(iterate_node_poses(header))
    camera_names = tuple(_make_camera_names(header, node_poses).values())
    nodes = _measure_nodes(header, parts)
    return FileContents(asset, nodes, light_names, camera_names)


def _make_full_object(
    path: Path, parts: list[ImportedPart], notes: list[str], header: Header | None
) -> ObjectAsset:
    """Return all parts of a file as one object; y is up in glTF, which has a header."""
    return make_object(
        parts,
        notes,
        file=path,
        name=make_safe_name(path),
        up=None if header is None else "y",
        front=find_front_axis(path, header),
    )


def _measure_nodes(
    header: Header, parts: Sequence[ImportedPart]
) -> tuple[NodeContents, ...]:
    """Return the contents of the nodes with parts, in their order."""
    parts_of_node = _group_by_node(parts)
    mesh_names = _make_mesh_names(header, parts, UniqueNames(RESERVED_NAMES))
    return tuple(
        _measure_node(
            header.get_node_label(index), mesh_names[index], parts_of_node[index]
        )
        for index in sorted(parts_of_node)
    )


def _measure_node(
    name: str, mesh_name: str, parts: Sequence[ImportedPart]
) -> NodeContents:
    """Measure the parts of one node."""
    points = np.concatenate(
        [part.vertices[part.faces].reshape(-1, 3) for part in parts]
    )
    x, y, z = map(float, np.ptp(points, axis=0))
    n_faces = sum(len(part.faces) for part in parts)
    return NodeContents(name, mesh_name, n_faces, (x, y, z))


@dataclass(frozen=True, eq=False)
class FileFrame:
    """The position and size of an object in a file.

    A point of the file, rotated to our axes, is `size` times the point in the frame,
    plus `origin` (3,).
    """

    size: float
    origin: Float64Array
    rotation: Float64Array  # (3, 3) from the file's axes to ours

    def to_frame(self, points: Float64Array) -> Float64Array:
        """Return points (..., 3) of the file, in our axes, in this frame."""
        return np.asarray((points - self.origin) / self.size)


def _compute_frame(parts: Sequence[ImportedPart], turn: Float64Array) -> FileFrame:
    """Return the frame in which parts have extent 1, stand on z = 0 and are centered.

    The largest extent becomes 1, and parts are centered in x and y. Faces that are not
    visible, or have no area, do not count: the repair of the geometry removes them.

    Args:
        parts: the parts.
        turn: rotation (3, 3) from the file's axes to ours.
    """
    face_corners = map(_find_visible_corners, select_visible_parts(parts))
    points = np.concatenate(list(face_corners)) @ turn.T
    is_valid = (
        np.isfinite(points).all() and len(points) and np.ptp(points, axis=0).max() > 0.0
    )
    if not is_valid:
        # The frame is not used: `make_object` raises an error with the reason.
        return FileFrame(size=1.0, origin=np.zeros(3), rotation=turn)
    origin, size = find_footing(points)
    return FileFrame(size=size, origin=origin, rotation=turn)


def _find_visible_corners(part: ImportedPart) -> Float64Array:
    """Return the corners (3 F, 3) of the faces of a part that have an area."""
    triangles = part.vertices[part.faces]
    doubled_area = np.linalg.norm(compute_area_vectors(triangles), axis=1)
    extent = float(np.ptp(triangles.reshape(-1, 3), axis=0).max())
    has_area = doubled_area > MIN_DOUBLED_AREA * extent**2
    corners: Float64Array = triangles[has_area].reshape(-1, 3)
    return corners


def _choose_light_unit(
    path: Path,
    header: Header,
    parts: Sequence[ImportedPart],
    has_lights: bool,
    notes: list[str],
) -> float:
    """Return how many candela are one unit of radiant intensity, which may be noted.

    The arguments are those of `_find_light_unit`, and warnings about the file `path`.
    """
    candela_per_unit, unit_note = _find_light_unit(header, parts, has_lights)
    if unit_note:
        notes.append(f"{path.name}: {unit_note}")
    return candela_per_unit


def _find_light_unit(
    header: Header, parts: Sequence[ImportedPart], has_lights: bool
) -> tuple[float, str]:
    """Return how many candela are one unit of radiant intensity, and a note on it.

    glTF states lamps in candela, and surfaces in nit (candela per square meter). A nit
    is one unit of radiance here. The unit of lamps depends on the file:

    - Only lamps emit light: `LUMENS` candela are one unit, since exporters multiply the
      watts of lamps by `LUMENS`.
    - Surfaces emit light, too: one candela is one unit, as glTF defines it, so that
      lamps have the right brightness in comparison with surfaces.
    - The same, but Blender wrote the file: `LUMENS` candela are one unit, since it
      multiplies lamps by `LUMENS`, but not surfaces.

    Args:
        header: header of the file.
        parts: the parts that its nodes draw.
        has_lights: whether it has lamps.

    Returns:
        The candela of one unit; and a sentence for the warnings, or "".
    """
    if header.asset.generator == GENERATOR:
        # A light of USD emits radiance, as its surfaces do.
        return 1.0, ""
    has_emission = any(part.surface.emission is not None for part in parts)
    if not has_lights or not has_emission:
        return LUMENS, ""
    if "blender" in str(header.asset.generator).lower():
        return LUMENS, (
            "it has lights and surfaces that emit light, and Blender exports lights 683 "
            "times too bright in comparison with surfaces; here both are as bright as "
            "Blender shows them"
        )
    return 1.0, (
        "it has lights and surfaces that emit light: their units are candela and nit, "
        "as glTF defines them"
    )


def _normalize_axis(axis: Float64Array) -> tuple[float, float, float]:
    """Return the unit vector of an axis (3,); zeros for zeros."""
    x, y, z = map(float, axis / max(float(np.linalg.norm(axis)), 1e-12))
    return x, y, z


def _make_lamp(
    path: Path,
    name: str,
    light: LightEntry,
    candela_per_unit: float,
    pose: Float64Array,
    frame: FileFrame,
) -> PointLamp | SpotLamp:
    """Return a light of a file as a lamp.

    Args:
        path: the file, for messages.
        name: name of the lamp.
        light: its entry in the header.
        candela_per_unit: how many candela are one unit of radiant intensity.
        pose: pose (4, 4) of its node.
        frame: frame of the object.

    Raises:
        InputError: it is too far away or too bright.
    """
    position, intensity = _position_light(light, candela_per_unit, pose, frame)
    _check_light(path, name, position, intensity)
    lamp = _make_point_lamp(name, position, intensity)
    if light.type != "spot":
        return lamp
    return SpotLamp(
        **vars(lamp),  # a spot light has all fields of a point light
        direction=_normalize_axis(frame.rotation @ -pose[:3, 2]),
        cutoff=math.degrees(light.spot.outerConeAngle),
        beam=math.degrees(light.spot.innerConeAngle),
    )


def _make_point_lamp(
    name: str, position: Float64Array, intensity: Float64Array
) -> PointLamp:
    """Return a lamp at a position (3,) with a radiant intensity (3,)."""
    x, y, z = map(float, position)
    red, green, blue = map(float, intensity)
    is_dark = not intensity.any()
    return PointLamp(
        name, dark=is_dark, position=(x, y, z), intensity=(red, green, blue)
    )


def _check_light(
    path: Path, name: str, position: Float64Array, intensity: Float64Array
) -> None:
    """Raise InputError if a light is too far away or too bright."""
    # `MAX_DISTANCE` is also the limit of intensities. NaN is out of range.
    is_in_range = np.abs([*position, *intensity]) <= MAX_DISTANCE
    if not is_in_range.all():
        raise InputError(
            f"{path}: expected the light {name} within {MAX_DISTANCE:g} object sizes, "
            f"and with an intensity of at most {MAX_DISTANCE:g}, got more; correct its "
            "position or its intensity, or remove it"
        )


def _position_light(
    light: LightEntry,
    candela_per_unit: float,
    pose: Float64Array,
    frame: FileFrame,
) -> tuple[Float64Array, Float64Array]:
    """Return the position (3,) of a light and its radiant intensity (3,).

    A directional light is stated in lux. It becomes a lamp so far away that its rays
    are almost parallel. Its intensity is lux times squared distance, so that it causes
    the same lux at the object. Other lights are scaled with the object, whose size
    becomes 1. Their intensity is divided by the squared size, so that they light it as
    before.

    Args:
        light: its entry in the header.
        candela_per_unit: how many candela are one unit of radiant intensity.
        pose: pose (4, 4) of its node.
        frame: frame of the object.
    """
    intensity = np.array(light.color) * light.intensity / candela_per_unit
    if light.type == "directional":
        # It shines along its -z, so that it is in the direction of its z.
        direction = frame.rotation @ pose[:3, 2]
        length = max(float(np.linalg.norm(direction)), 1e-12)  # not 0
        position = gltf_parts.DIRECTIONAL_LIGHT_DISTANCE * direction / length
        intensity = intensity * gltf_parts.DIRECTIONAL_LIGHT_DISTANCE**2
        return position, intensity
    position = frame.to_frame(frame.rotation @ pose[:3, 3])
    return position, intensity / frame.size**2


def _make_cameras(
    path: Path, header: Header, node_poses: Mapping[int, Float64Array], frame: FileFrame
) -> dict[str, PosedCamera]:
    """Return the perspective cameras of a file by name.

    Raises InputError as `_make_camera`.
    """
    cameras = {}
    for index, name in _make_camera_names(header, node_poses).items():
        camera_index = header.nodes[index].camera
        assert camera_index is not None  # for mypy: only nodes with a camera are named
        camera = header.cameras[camera_index]
        cameras[name] = _make_camera(path, name, camera, node_poses[index], frame)
    return cameras


def _make_camera(
    path: Path, name: str, camera: CameraEntry, pose: Float64Array, frame: FileFrame
) -> PosedCamera:
    """Return a perspective camera of a file.

    Args:
        path: the file, for messages.
        name: name of the camera.
        camera: its entry in the header.
        pose: pose (4, 4) of its node.
        frame: frame of the object.

    Raises:
        InputError: it is too far away, has a singular or sheared pose, or too wide a
            field of view.
    """
    assert camera.perspective is not None
    matrix = _compute_camera_pose(pose, frame)
    fov = _compute_fov_degrees(camera.perspective)
    problem = _find_camera_problem(matrix, fov)
    if problem:
        raise InputError(f"{path}: expected the camera {name} {problem}, or remove it")
    return PosedCamera(matrix, fov, upright=camera.perspective.aspectRatio is None)


def _compute_camera_pose(pose: Float64Array, frame: FileFrame) -> Float64Array:
    """Return the pose (4, 4) of a camera in a frame, from the pose of its node in the file.

    The first three columns are the camera's axes, as unit vectors: the scale of its
    node has no effect.
    """
    axes = frame.rotation @ pose[:3, :3] @ GLTF_CAMERA_AXES
    axes = axes / np.maximum(np.linalg.norm(axes, axis=0), 1e-12)
    matrix = np.eye(4)
    matrix[:3, :3] = axes
    # `to_frame` moves and scales points that are rotated to our axes already.
    matrix[:3, 3] = frame.to_frame(frame.rotation @ pose[:3, 3])
    return matrix


def _compute_fov_degrees(perspective: Perspective) -> float:
    """Return the field of view of a camera along the larger side of its image, degrees.

    `yfov` is the field of view along the height. In a wide image the larger side is the
    width, whose tangent is larger by the aspect ratio. If the file has no aspect ratio,
    that of the rendered image is used (glTF 2.0, section 5.13). It is not known here,
    so that the result is along the height.
    """
    aspect_ratio = perspective.aspectRatio
    larger_side_ratio = 1.0 if aspect_ratio is None else max(aspect_ratio, 1.0)
    half_tangent = math.tan(perspective.yfov / 2.0)
    return math.degrees(2.0 * math.atan(half_tangent * larger_side_ratio))


def _find_camera_problem(matrix: Float64Array, fov: float) -> str | None:
    """Return why a camera cannot be imported; None if it can be.

    The text continues a message that begins with "expected the camera NAME", such as
    "within 5 object sizes, got more; correct its position".

    Args:
        matrix: (4, 4) its pose, with unit vectors as axes.
        fov: its field of view in degrees.
    """
    is_near = (np.abs(matrix[:3, 3]) <= MAX_DISTANCE).all()  # False for NaN
    if not is_near:
        return f"within {MAX_DISTANCE:g} object sizes, got more; correct its position"
    axes_problem = _find_axes_problem(matrix[:3, :3])
    if axes_problem is not None:
        return axes_problem
    if not 0.0 < fov <= MAX_FOV:
        return (
            f"with a field of view up to {MAX_FOV:g} degrees, got {fov:.4g}; correct it"
        )
    return None


def _find_axes_problem(axes: Float64Array) -> str | None:
    """Return what is wrong with the axes of a camera, the columns (3, 3), or None."""
    if not np.allclose(np.linalg.norm(axes, axis=0), 1.0):
        return (
            "to have a direction, got axes without length; correct the scale of its "
            "node"
        )
    is_mirrored = np.linalg.det(axes) < 0.0
    is_rectangular = np.allclose(axes.T @ axes, np.eye(3), atol=MAX_AXIS_COSINE)
    if is_mirrored or not is_rectangular:
        got = "mirrored" if is_mirrored else "sheared"
        advice = "apply the scale of the nodes above it (in Blender Ctrl A)"
        return (
            f"under nodes that only rotate, move and scale it, got {got} axes; {advice}"
        )
    return None
