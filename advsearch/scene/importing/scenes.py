"""Scenes from glTF files: ``--object scene.glb#chair`` takes one node as the object and
the rest as its surroundings.

Lengths are in object sizes, so everything is moved and scaled with the object: its
largest extent is 1, it stands on z = 0, and z is up. The axis of the file that its
format calls the front of an asset is +x.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from advsearch.errors import InputError, UnknownNameError
from advsearch.scene.assets import Doubles, ObjectAsset, face_vectors, footing
from advsearch.scene.importing import gltf, gltf_parts
from advsearch.scene.importing.files import Names, clean, safe_name, shown
from advsearch.scene.importing.geometry import FLAT, compute_turn
from advsearch.scene.importing.gltf_entries import (
    GENERATOR,
    CameraEntry,
    Header,
    LightEntry,
)
from advsearch.scene.importing.gltf_skeleton import poses
from advsearch.scene.importing.objects import find_front, object_of, read_parts
from advsearch.scene.importing.parts import ImportedPart, visible
from advsearch.scene.importing.readers import GLTF, list_suffixes, read_mesh_bytes
from advsearch.scene.parts import (
    PlacedCamera,
    PointLamp,
    ScenePart,
    SpotLamp,
    mesh_part,
)
from advsearch.scene.skeleton import with_above

BEHIND = np.diag([-1.0, 1.0, -1.0])
"""Cameras of glTF look along -z with +x to the right; ours along +z with +x to the
left.
"""
MITSUBA_FILE = ".xml"  # ending of Mitsuba's scenes
LUMENS = 683.0
"""Lumens of a watt: the eye's at 555 nm. Blender's exporter multiplies the power of
lights by it, and no emission.
"""
# distance of a light or camera in object sizes, and radiant intensity of a light
FURTHEST = 1e12
SQUARE = 1e-3  # cosine of the angle between two axes of a camera, at most
# field of view of a camera along the larger side of its picture, degrees
WIDEST_VIEW = 170.0
MOST_SURROUNDINGS = 200  # meshes and lamps around an object
TAKEN = frozenset(("object", "environment", "ground", "camera", "orbit"))


@dataclass(frozen=True, eq=False)
class ImportedScene:
    """What a file holds."""

    object: ObjectAsset  # the node that was asked for, with all that hangs on it
    surroundings: tuple[ScenePart, ...] = ()  # meshes and lamps beside it
    cameras: Mapping[str, PlacedCamera] = field(default_factory=dict)  # by name


def split_node(spec: str) -> tuple[str, str | None]:
    """Return the file and the node of ``scene.glb#chair``; None where no node is
    named.
    """
    endings = "|".join(map(re.escape, (*GLTF, MITSUBA_FILE)))
    found = re.fullmatch(rf"(.+({endings}))#(.*)", spec, re.IGNORECASE | re.DOTALL)
    return (found[1], found[3]) if found and not os.path.exists(spec) else (spec, None)


@np.errstate(all="ignore")  # what is out of range is refused
def import_scene(path: Path, node: str) -> ImportedScene:
    """Read a scene from a .glb or .gltf file, with the node of that name as the object:
    or of that mesh, where a node has no name; "node 3" is the one with that number.

    The object is repaired, normalised and textured as `import_object` does it; so is
    every other node with a mesh, which stays in its place beside it. Point and spot
    lights of KHR_lights_punctual become lamps, directional ones distant lamps;
    perspective cameras are kept by name. What is not carried over is among the object's
    warnings. Raises UnknownNameError: no node of that name has a mesh, or one below it.
    Raises FileFormatError: as for `import_object`. Raises InputError: as for
    `import_object`; several nodes have the name; or there is too much beside the
    object.
    """
    data = read_mesh_bytes(path, "scene", GLTF)
    header = gltf.read_header(path, data)
    parts, notes = read_parts(path, data)
    places = dict(poses(header))
    labels = {
        index: header.label(index)
        for index in sorted(with_above(header.parents, {part.node for part in parts}))
    }
    same = [
        index for index, label in labels.items() if node in (label, f"node {index}")
    ]
    if not same:
        raise UnknownNameError(
            f"node of {path.name}", node, list(dict.fromkeys(labels.values()))
        )
    if len(same) > 1:
        numbers = ", ".join(f"{path.name}#node {index}" for index in same[:10])
        raise InputError(
            f"{path}: {len(same)} nodes are called {shown(node)}; say which: {numbers}"
        )
    chosen = header.below(same)
    chosen_parts = [part for part in parts if part.node in chosen]
    others = sorted({part.node for part in parts} - chosen)
    lamps = {
        index: header.lights[lamp]
        for index in places
        if (lamp := header.nodes[index].lamp) is not None
    }
    if (count := len(others) + len(lamps)) > MOST_SURROUNDINGS:
        most = f"at most {MOST_SURROUNDINGS} meshes and lights beside the object"
        raise InputError(
            f"{path}: expected {most}, got {count}; join some of them in the file"
        )
    front = find_front(path, header)
    turn = compute_turn("y", front.axis)
    frame = _frame(chosen_parts, turn)
    names = Names(TAKEN)
    called = _mesh_names(header, parts, names)
    surroundings: list[ScenePart] = []
    for number in others:
        group = [part for part in parts if part.node == number]
        place = _frame(group, turn)
        shape = object_of(group, [], path, called[number], "y", front)
        notes.extend(shape.warnings)
        matrix = np.eye(4)
        matrix[:3, :3] *= place.size / frame.size
        matrix[:3, 3] = frame.inside(place.origin)
        surroundings.append(mesh_part(shape.name, shape, matrix, shape.material))
    unit = 1.0  # a light of USD emits radiance as its surfaces do
    why = ""
    if header.asset.generator != GENERATOR:
        unit, why = _unit_of_light(
            header,
            bool(lamps) and any(part.surface.emission is not None for part in parts),
        )
    notes.extend([f"{path.name}: {why}"] if why else [])
    for index, light in lamps.items():
        name = names.free(light.name or header.label(index))
        surroundings.append(_lamp(path, name, light, unit, places[index], frame))
    cameras = {
        name: _camera(
            path,
            name,
            header.cameras[header.nodes[index].camera or 0],
            places[index],
            frame,
        )
        for index, name in _camera_names(header, places).items()
    }
    notes.extend(gltf_parts.lights_and_cameras(header, path.name))
    whole = object_of(
        chosen_parts, notes, path, f"{safe_name(path)}-{clean(node)}", "y", front
    )
    return ImportedScene(whole, tuple(surroundings), cameras)


def node_names(path: Path) -> list[str]:
    """Return what `import_scene` takes as the object of a glTF file, several of the
    same name once. Raises FileFormatError: as for `import_object`.
    """
    header = gltf.read_header(path, read_mesh_bytes(path, "scene", GLTF))
    drawn = {index for index, node in enumerate(header.nodes) if node.mesh is not None}
    return list(
        dict.fromkeys(map(header.label, sorted(with_above(header.parents, drawn))))
    )


def _mesh_names(
    header: Header, parts: Sequence[ImportedPart], names: Names
) -> dict[int, str]:
    return {
        number: names.free(header.label(number))
        for number in sorted({part.node for part in parts})
    }


def _camera_names(header: Header, nodes: Iterable[int]) -> dict[int, str]:
    names = Names(TAKEN)
    called = {}
    for index in sorted(nodes):
        camera = header.nodes[index].camera
        if camera is not None and header.cameras[camera].perspective is not None:
            called[index] = names.free(
                header.cameras[camera].name or header.label(index)
            )
    return called


@dataclass(frozen=True)
class NodeContents:
    """A node with geometry."""

    name: str  # as `import_scene` takes it
    mesh: str  # what it is called in names of controls, beside another node
    triangles: int  # of its own mesh
    # of its bounding box in the file's axes and units, (3,)
    size: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Contents:
    """What is in a file."""

    object: ObjectAsset  # everything with geometry, as one object
    nodes: tuple[NodeContents, ...] = ()  # of a glTF file, in their order
    lights: tuple[str, ...] = ()
    cameras: tuple[str, ...] = ()


@np.errstate(all="ignore")
def contents(path: Path) -> Contents:
    """Return what is understood of a mesh or glTF file; one of Mitsuba has a function
    of that name of its own. Raises FileFormatError, InputError: as for `import_object`.
    """
    data = read_mesh_bytes(path, "object", (*list_suffixes(), MITSUBA_FILE))
    parts, notes = read_parts(path, data)
    if path.suffix.lower() not in GLTF:
        return Contents(
            object_of(parts, notes, path, safe_name(path), None, find_front(path, None))
        )
    header = gltf.read_header(path, data)
    notes += gltf_parts.lights_and_cameras(header, path.name)
    whole = object_of(
        parts, notes, path, safe_name(path), None, find_front(path, header)
    )
    nodes: dict[int, list[ImportedPart]] = {}
    for part in parts:
        nodes.setdefault(part.node, []).append(part)
    listed = []
    called = _mesh_names(header, parts, Names(TAKEN))
    for index, group in sorted(nodes.items()):
        places = np.concatenate(
            [part.vertices[part.faces].reshape(-1, 3) for part in group]
        )
        x, y, z = map(float, np.ptp(places, axis=0))
        faces = sum(len(part.faces) for part in group)
        listed.append(
            NodeContents(header.label(index), called[index], faces, (x, y, z))
        )
    lights = tuple(
        light.name or f"light {index}" for index, light in enumerate(header.lights)
    )
    cameras = _camera_names(header, dict(poses(header))).values()
    return Contents(whole, tuple(listed), lights, tuple(cameras))


@dataclass(frozen=True, eq=False)
class FileFrame:
    """How something lies in the file, turned to our axes: its own coordinates times
    `size`, plus `origin` (3,).
    """

    size: float
    origin: Doubles
    turn: Doubles  # (3, 3) from the file's axes to ours

    def inside(self, places: Doubles) -> Doubles:
        return np.asarray((places - self.origin) / self.size)


def _frame(parts: Sequence[ImportedPart], turn: Doubles) -> FileFrame:
    """The frame in which the parts have a largest extent of 1, stand on z = 0 and are
    centred in x and y.
    """
    corners = []
    for part in visible(parts):
        triangles = part.vertices[part.faces]
        area = np.linalg.norm(face_vectors(triangles), axis=1)
        extent = float(np.ptp(triangles.reshape(-1, 3), axis=0).max())
        corners.append(triangles[area > FLAT * extent**2].reshape(-1, 3))
    places = np.concatenate(corners) @ turn.T
    if (
        not np.isfinite(places).all()
        or not len(places)
        or not np.ptp(places, axis=0).max() > 0.0
    ):
        # refused with a reason when it is repaired
        return FileFrame(1.0, np.zeros(3), turn)
    origin, size = footing(places)
    return FileFrame(size, origin, turn)


def _unit_of_light(header: Header, both: bool) -> tuple[float, str]:
    """How many candela are one unit of radiance times the file's area, and what is said
    of it. Alone, lamps are in watts, as exporters have them. Beside surfaces that emit
    light, of which one nit is one unit, what a candela is decides how bright they are
    to each other.
    """
    if not both:
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


def _lamp(
    path: Path,
    name: str,
    light: LightEntry,
    unit: float,
    pose: Doubles,
    frame: FileFrame,
) -> PointLamp | SpotLamp:
    power = np.array(light.color) * light.intensity / unit
    if light.type == "directional":
        way = frame.turn @ pose[:3, 2]  # it shines along its -z
        place = gltf_parts.FAR * way / max(float(np.linalg.norm(way)), 1e-12)
        power = power * gltf_parts.FAR**2
    else:
        place = frame.inside(frame.turn @ pose[:3, 3])
        power = power / frame.size**2
    if not (np.abs([*place, *power]) <= FURTHEST).all():  # NaN is not
        raise InputError(
            f"{path}: expected the light {name} within {FURTHEST:g} object sizes, and "
            "no brighter than that, got "
            "more; correct its place or its intensity, or remove it"
        )
    x, y, z = map(float, place)
    red, green, blue = map(float, power)
    lamp = PointLamp(
        name, dark=not power.any(), position=(x, y, z), intensity=(red, green, blue)
    )
    if light.type != "spot":
        return lamp
    along = frame.turn @ -pose[:3, 2]
    across, up, ahead = map(float, along / max(float(np.linalg.norm(along)), 1e-12))
    cutoff = math.degrees(light.spot.outerConeAngle)
    beam = math.degrees(light.spot.innerConeAngle)
    return SpotLamp(
        **vars(lamp), direction=(across, up, ahead), cutoff=cutoff, beam=beam
    )


def _camera(
    path: Path, name: str, camera: CameraEntry, pose: Doubles, frame: FileFrame
) -> PlacedCamera:
    assert camera.perspective is not None
    turn = frame.turn @ pose[:3, :3] @ BEHIND
    matrix = np.eye(4)
    axes = turn / np.maximum(np.linalg.norm(turn, axis=0), 1e-12)
    matrix[:3, :3], matrix[:3, 3] = axes, frame.inside(frame.turn @ pose[:3, 3])
    # without one, that of the picture holds (section 5.13)
    ratio = camera.perspective.aspectRatio
    fov = math.degrees(
        2.0
        * math.atan(math.tan(camera.perspective.yfov / 2.0) * max(ratio or 1.0, 1.0))
    )
    mirrored = np.linalg.det(axes) < 0.0
    if not (np.abs(matrix[:3, 3]) <= FURTHEST).all():  # NaN is not
        problem = f"within {FURTHEST:g} object sizes, got more; correct its place"
    elif not np.allclose(np.linalg.norm(axes, axis=0), 1.0):
        problem = (
            "to look somewhere, got axes without length; correct the scale of its node"
        )
    elif not np.allclose(axes.T @ axes, np.eye(3), atol=SQUARE) or mirrored:
        got = "mirrored" if mirrored else "sheared"
        advice = "apply the scale of the nodes above it (in Blender Ctrl A)"
        problem = f"under nodes that turn, move and scale it, got {got} axes; {advice}"
    elif not 0.0 < fov <= WIDEST_VIEW:
        problem = (
            f"with a field of view up to {WIDEST_VIEW:g} degrees, got "
            f"{fov:.4g}; "
            "correct it"
        )
    else:
        return PlacedCamera(matrix, fov, upright=ratio is None)
    raise InputError(f"{path}: expected the camera {name} {problem}, or remove it")
