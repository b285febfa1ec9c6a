"""Scenes from glTF files: one node as the object, the rest as its surroundings.

``--object scene.glb#chair`` selects the node. Lengths are in object sizes, so
everything is moved and scaled with the object: its largest extent is 1, it stands on z
= 0, and z is up. The axis of the file that its format calls the front of an asset is
+x.
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
)
from advsearch.scene.importing.gltf_skeleton import iterate_poses
from advsearch.scene.importing.objects import find_front, make_object, read_parts
from advsearch.scene.importing.parts import ImportedPart, select_visible
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
"""Rotation (3, 3) between the axes of cameras: glTF's look along -z with +x to the
right, ours along +z with +x to the left.
"""
MITSUBA_SUFFIX = ".xml"  # suffix of Mitsuba's scenes
LUMENS = 683.0
"""Lumens of a watt, at 555 nm. Blender's exporter multiplies the power of lights by it,
but no emission.
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


def split_node(spec: str) -> tuple[str, str | None]:
    """Split ``scene.glb#chair`` into the file and the node, None if none is named."""
    suffixes = "|".join(map(re.escape, (*GLTF_SUFFIXES, MITSUBA_SUFFIX)))
    match = re.fullmatch(rf"(.+({suffixes}))#(.*)", spec, re.IGNORECASE | re.DOTALL)
    if match is None or os.path.exists(spec):
        return spec, None
    return match[1], match[3]


@np.errstate(all="ignore")  # values out of range are rejected
def import_scene(path: Path, node: str) -> ImportedScene:
    """Read a scene from a glTF file, with one node as the object.

    The object is repaired, normalised and textured as by `import_object`; so is every
    other node with a mesh, which stays in its position around it. Point and spot lights
    of KHR_lights_punctual become lamps, directional ones distant lamps; perspective
    cameras are kept by name. The object's warnings name what is not imported.

    Args:
        path: the .glb or .gltf file.
        node: name of the node, or of its mesh if the node has no name; "node 3" is the
            node with that index.

    Raises:
        UnknownNameError: no node of that name has a mesh, or one below it.
        FileFormatError: the file is missing, corrupt, or has no faces.
        InputError: the geometry cannot be used; several nodes have the name; or there
            are too many other meshes and lights.
    """
    data = read_mesh_bytes(path, "scene", GLTF_SUFFIXES)
    header = gltf.read_header(path, data)
    parts, notes = read_parts(path, data)
    node_poses = dict(iterate_poses(header))
    # the named node with all below it is the object; the rest surrounds it
    object_nodes = header.find_descendants([_find_node(path, header, parts, node)])
    object_parts = [part for part in parts if part.node in object_nodes]
    lights = _find_node_lights(header, node_poses)
    n_other_meshes = len({part.node for part in parts} - object_nodes)
    _check_surroundings(path, n_other_meshes + len(lights))
    front = find_front(path, header)
    # y is up in glTF. Everything around the object is put into the object's frame.
    frame = _compute_frame(object_parts, compute_rotation("y", front.axis))
    names = UniqueNames(RESERVED_NAMES)
    surroundings = _make_surrounding_meshes(
        path, header, parts, object_nodes, names, front, frame, notes
    )
    candela_per_unit, unit_note = _find_light_unit(header, parts, bool(lights))
    if unit_note:
        notes.append(f"{path.name}: {unit_note}")
    surroundings += _make_lamps(
        path, header, lights, candela_per_unit, node_poses, names, frame
    )
    cameras = _make_cameras(path, header, node_poses, frame)
    notes.extend(gltf_parts.describe_changed_lights(header, path.name))
    asset = make_object(
        object_parts,
        notes,
        file=path,
        name=f"{make_safe_name(path)}-{sanitize_name(node)}",
        up="y",
        front=front,
    )
    return ImportedScene(asset, tuple(surroundings), cameras)


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
        parts: what its nodes draw.
        object_nodes: the nodes of the object.
        names: names that are taken; those of the meshes are added.
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
        names: names that are taken; those of the lamps are added.
        frame: frame of the object.

    Raises:
        InputError: a light is too far away or too bright.
    """
    lamps: list[ScenePart] = []
    for index, light in lights.items():
        name = names.make_unique(light.name or header.get_label(index))
        pose = node_poses[index]
        lamps.append(_make_lamp(path, name, light, candela_per_unit, pose, frame))
    return lamps


def _find_node(
    path: Path, header: Header, parts: Sequence[ImportedPart], name: str
) -> int:
    """Return the index of the node with a name that draws geometry.

    A node counts if it or one of its descendants draws something.

    Args:
        path: the file, for messages.
        header: header of the file.
        parts: what its nodes draw.
        name: name of the node, or "node 3" for the one with that index.

    Raises:
        UnknownNameError: there is none.
        InputError: there are several.
    """
    candidates = sorted(with_ancestors(header.parents, {part.node for part in parts}))
    labels = {index: header.get_label(index) for index in candidates}
    matches = [
        index for index, label in labels.items() if name in (label, f"node {index}")
    ]
    if not matches:
        known_names = list(dict.fromkeys(labels.values()))
        raise UnknownNameError(f"node of {path.name}", name, known_names)
    if len(matches) > 1:
        choices = ", ".join(f"{path.name}#node {index}" for index in matches[:10])
        raise InputError(
            f"{path}: {len(matches)} nodes are called {format_name(name)}; say which: "
            f"{choices}"
        )
    return matches[0]


def _check_surroundings(path: Path, count: int) -> None:
    """Raise InputError if there are more than `MAX_SURROUNDINGS` meshes and lamps."""
    if count > MAX_SURROUNDINGS:
        limit = f"at most {MAX_SURROUNDINGS} meshes and lights beside the object"
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

    The shape is normalised as an object is; its pose puts it back to where it was, with
    the size that it had relative to the object.

    Args:
        path: the file, for messages.
        name: name of the part.
        parts: what the node draws.
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
    return make_mesh_part(
        shape.name, shape, mesh_to_object, shape.material
    ), shape.warnings


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
    candidates = sorted(with_ancestors(header.parents, with_mesh))
    return list(dict.fromkeys(map(header.get_label, candidates)))


def _make_mesh_names(
    header: Header, parts: Sequence[ImportedPart], names: UniqueNames
) -> dict[int, str]:
    """Return a unique name for each node with parts, by the node's index."""
    nodes = sorted({part.node for part in parts})
    return {node: names.make_unique(header.get_label(node)) for node in nodes}


def _make_camera_names(header: Header, nodes: Iterable[int]) -> dict[int, str]:
    """Return a unique name for each node with a perspective camera, by index."""
    names = UniqueNames(RESERVED_NAMES)
    name_of_node = {}
    for index in sorted(nodes):
        camera = header.nodes[index].camera
        if camera is not None and header.cameras[camera].perspective is not None:
            label = header.cameras[camera].name or header.get_label(index)
            name_of_node[index] = names.make_unique(label)
    return name_of_node


@dataclass(frozen=True)
class NodeContents:
    """A node with geometry."""

    name: str  # name that `import_scene` accepts
    mesh_name: str  # its name in controls if another node is the object
    triangles: int  # number of them in its own mesh
    # Bounding box in the file's axes and units, (3,).
    size: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Contents:
    """What can be imported from a file."""

    object: ObjectAsset  # everything with geometry, as one object
    nodes: tuple[NodeContents, ...] = ()  # nodes of a glTF file, in their order
    lights: tuple[str, ...] = ()
    cameras: tuple[str, ...] = ()


def _group_by_node(parts: Iterable[ImportedPart]) -> dict[int, list[ImportedPart]]:
    """Return the parts that each node draws."""
    parts_of_node: dict[int, list[ImportedPart]] = {}
    for part in parts:
        parts_of_node.setdefault(part.node, []).append(part)
    return parts_of_node


@np.errstate(all="ignore")
def list_contents(path: Path) -> Contents:
    """Return what can be imported from a mesh or glTF file.

    For Mitsuba's files see `scene_files.read_contents`.

    Raises:
        FileFormatError: the file is missing, of another kind, corrupt, or has no faces.
        InputError: the geometry cannot be used, such as vertices that all coincide.
    """
    data = read_mesh_bytes(path, "object", (*list_suffixes(), MITSUBA_SUFFIX))
    parts, notes = read_parts(path, data)
    name = make_safe_name(path)
    if path.suffix.lower() not in GLTF_SUFFIXES:
        front = find_front(path, None)
        return Contents(
            make_object(parts, notes, file=path, name=name, up=None, front=front)
        )
    header = gltf.read_header(path, data)
    notes += gltf_parts.describe_changed_lights(header, path.name)
    asset = make_object(
        parts, notes, file=path, name=name, up="y", front=find_front(path, header)
    )
    parts_of_node = _group_by_node(parts)
    mesh_names = _make_mesh_names(header, parts, UniqueNames(RESERVED_NAMES))
    nodes = [
        _measure_node(header.get_label(index), mesh_names[index], parts_of_node[index])
        for index in sorted(parts_of_node)
    ]
    lights = tuple(
        light.name or f"light {index}" for index, light in enumerate(header.lights)
    )
    cameras = tuple(_make_camera_names(header, dict(iterate_poses(header))).values())
    return Contents(asset, tuple(nodes), lights, cameras)


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
    """The position and size of something in a file.

    A point of the file, turned to our axes, is `size` times the point in the frame,
    plus `origin` (3,).
    """

    size: float
    origin: Float64Array
    rotation: Float64Array  # (3, 3) from the file's axes to ours

    def to_frame(self, points: Float64Array) -> Float64Array:
        """Return points (..., 3) of the file, in our axes, in this frame."""
        return np.asarray((points - self.origin) / self.size)


def _compute_frame(parts: Sequence[ImportedPart], turn: Float64Array) -> FileFrame:
    """Return the frame in which parts have extent 1, stand on z = 0 and are centred.

    The largest extent becomes 1, and parts are centred in x and y. Only visible faces
    with an area count, since the repair of the geometry removes all others.

    Args:
        parts: the parts.
        turn: rotation (3, 3) from the file's axes to ours.
    """
    face_corners = []
    for part in select_visible(parts):
        triangles = part.vertices[part.faces]
        area = np.linalg.norm(compute_area_vectors(triangles), axis=1)
        extent = float(np.ptp(triangles.reshape(-1, 3), axis=0).max())
        face_corners.append(
            triangles[area > MIN_DOUBLED_AREA * extent**2].reshape(-1, 3)
        )
    points = np.concatenate(face_corners) @ turn.T
    is_valid = (
        np.isfinite(points).all() and len(points) and np.ptp(points, axis=0).max() > 0.0
    )
    if not is_valid:
        # The repair of the geometry rejects it with a reason.
        return FileFrame(1.0, np.zeros(3), turn)
    origin, size = find_footing(points)
    return FileFrame(size, origin, turn)


def _find_light_unit(
    header: Header, parts: Sequence[ImportedPart], has_lights: bool
) -> tuple[float, str]:
    """Return how many candela are one unit of radiant intensity, and a note on it.

    glTF states lamps in candela and surfaces in nit (candela per square metre); a nit
    of a surface is one unit here. Exporters write watts times `LUMENS` for lamps. So if
    there are only lamps, `LUMENS` candela are one unit. If surfaces emit light too, the
    ratio of both counts: it is that of glTF, or in Blender's files the one that Blender
    shows.

    Args:
        header: header of the file.
        parts: what its nodes draw.
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
            "it has lights beside surfaces that emit light, and is Blender's, which "
            "exports lights 683 times as bright "
            "beside them as it shows them: they are as Blender shows them"
        )
    return 1.0, (
        "it has lights beside surfaces that emit light: they are taken as "
        "candela and nit, as glTF defines them"
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
    # one limit for distances and intensities; NaN is out of range
    is_in_range = np.abs([*position, *intensity]) <= MAX_DISTANCE
    if not is_in_range.all():
        raise InputError(
            f"{path}: expected the light {name} within {MAX_DISTANCE:g} object sizes, "
            "and "
            "no brighter than that, got "
            "more; correct its place or its intensity, or remove it"
        )
    x, y, z = map(float, position)
    red, green, blue = map(float, intensity)
    lamp = PointLamp(
        name, dark=not intensity.any(), position=(x, y, z), intensity=(red, green, blue)
    )
    if light.type != "spot":
        return lamp
    return SpotLamp(
        **vars(lamp),
        direction=_normalize_axis(frame.rotation @ -pose[:3, 2]),
        cutoff=math.degrees(light.spot.outerConeAngle),
        beam=math.degrees(light.spot.innerConeAngle),
    )


def _position_light(
    light: LightEntry,
    candela_per_unit: float,
    pose: Float64Array,
    frame: FileFrame,
) -> tuple[Float64Array, Float64Array]:
    """Return the position (3,) of a light and its radiant intensity (3,).

    A directional light is stated in lux. It becomes a lamp so far away that its rays
    are almost parallel. With the intensity lux times squared distance, it causes the
    same lux at the object. For other lights, lengths are divided by the object's size,
    so intensities are divided by its square.

    Args:
        light: its entry in the header.
        candela_per_unit: how many candela are one unit of radiant intensity.
        pose: pose (4, 4) of its node.
        frame: frame of the object.
    """
    intensity = np.array(light.color) * light.intensity / candela_per_unit
    if light.type == "directional":
        direction = frame.rotation @ pose[:3, 2]  # it shines along its -z
        length = max(float(np.linalg.norm(direction)), 1e-12)  # not 0
        position = gltf_parts.DIRECTIONAL_LIGHT_DISTANCE * direction / length
        intensity = intensity * gltf_parts.DIRECTIONAL_LIGHT_DISTANCE**2
        return position, intensity
    position = frame.to_frame(frame.rotation @ pose[:3, 3])
    return position, intensity / frame.size**2


def _make_cameras(
    path: Path, header: Header, node_poses: Mapping[int, Float64Array], frame: FileFrame
) -> dict[str, PosedCamera]:
    """Return the perspective cameras of a file by name; errors as for each."""
    cameras = {}
    for index, name in _make_camera_names(header, node_poses).items():
        camera = header.cameras[header.nodes[index].camera or 0]
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
    # The columns are the camera's axes in our coordinates. The scale of its node has no
    # effect, so they are made unit vectors.
    axes = frame.rotation @ pose[:3, :3] @ GLTF_CAMERA_AXES
    axes = axes / np.maximum(np.linalg.norm(axes, axis=0), 1e-12)
    matrix = np.eye(4)
    matrix[:3, :3] = axes
    matrix[:3, 3] = frame.to_frame(frame.rotation @ pose[:3, 3])
    # `yfov` is along the height. In a wide image the larger side is the width, with a
    # tangent larger by the aspect ratio. If the file states none, it is that of the
    # rendered image (section 5.13), for which `upright` tells that `fov` is the
    # height's.
    aspect_ratio = camera.perspective.aspectRatio
    half_tangent = math.tan(camera.perspective.yfov / 2.0)
    fov = math.degrees(2.0 * math.atan(half_tangent * max(aspect_ratio or 1.0, 1.0)))
    problem = _find_camera_problem(matrix, fov)
    if problem:
        raise InputError(f"{path}: expected the camera {name} {problem}, or remove it")
    return PosedCamera(matrix, fov, upright=aspect_ratio is None)


def _find_camera_problem(matrix: Float64Array, fov: float) -> str | None:
    """Return why a camera cannot be imported, as the end of a message, or None.

    Args:
        matrix: (4, 4) its pose, with unit vectors as axes.
        fov: its field of view in degrees.
    """
    axes = matrix[:3, :3]
    if not (np.abs(matrix[:3, 3]) <= MAX_DISTANCE).all():  # NaN is not
        return f"within {MAX_DISTANCE:g} object sizes, got more; correct its place"
    if not np.allclose(np.linalg.norm(axes, axis=0), 1.0):
        return (
            "to look somewhere, got axes without length; correct the scale of its node"
        )
    is_mirrored = np.linalg.det(axes) < 0.0
    is_rectangular = np.allclose(axes.T @ axes, np.eye(3), atol=MAX_AXIS_COSINE)
    if is_mirrored or not is_rectangular:
        got = "mirrored" if is_mirrored else "sheared"
        advice = "apply the scale of the nodes above it (in Blender Ctrl A)"
        return f"under nodes that turn, move and scale it, got {got} axes; {advice}"
    if not 0.0 < fov <= MAX_FOV:
        return (
            f"with a field of view up to {MAX_FOV:g} degrees, got {fov:.4g}; correct it"
        )
    return None
