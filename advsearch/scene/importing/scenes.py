"""Scenes from glTF files: ``--object scene.glb#chair`` takes one node as the object and the rest as its surroundings.

Lengths are in object sizes, so everything is moved and scaled with the object: its largest extent is 1, it stands on
z = 0, and z is up.
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
from advsearch.files import MESHES
from advsearch.scene.assets import Doubles, ObjectAsset
from advsearch.scene.importing import gltf, gltf_left_out
from advsearch.scene.importing.blender import read_mesh_bytes
from advsearch.scene.importing.files import Names, clean, safe_name, shown
from advsearch.scene.importing.geometry import FLAT, UPRIGHT
from advsearch.scene.importing.gltf_entries import CameraEntry, Header, LightEntry
from advsearch.scene.importing.gltf_skeleton import poses
from advsearch.scene.importing.objects import GLTF, object_of, read_parts
from advsearch.scene.importing.parts import ImportedPart, visible
from advsearch.scene.importing.usd import GENERATOR
from advsearch.scene.parts import PlacedCamera, PointLamp, ScenePart, SpotLamp, mesh_part

BEHIND = np.diag([-1.0, 1.0, -1.0])
"""Cameras of glTF look along -z with +x to the right; ours along +z with +x to the left."""
MITSUBA_FILE = ".xml"
"""Ending of Mitsuba's scenes."""
LUMENS = 683.0
"""Lumens of a watt: the eye's at 555 nm. Blender's exporter multiplies the power of lights by it, and no emission."""
FURTHEST = 1e12
"""Distance of a light or camera in object sizes, and radiant intensity of a light."""
SQUARE = 1e-3
"""Cosine of the angle between two axes of a camera, at most."""
WIDEST_VIEW = 170.0
"""Field of view of a camera along the larger side of its picture, degrees."""
MOST_SURROUNDINGS = 200
"""Meshes and lamps around an object."""
TAKEN = frozenset(("object", "environment", "ground", "camera", "orbit"))


@dataclass(frozen=True, eq=False)
class ImportedScene:
    """What a file holds.

    Attributes:
        object: the node that was asked for, with all that hangs on it.
        surroundings: meshes and lamps beside it.
        cameras: by name.
    """

    object: ObjectAsset
    surroundings: tuple[ScenePart, ...] = ()
    cameras: Mapping[str, PlacedCamera] = field(default_factory=dict)


def split_node(spec: str) -> tuple[str, str | None]:
    """Return the file and the node of ``scene.glb#chair``; None where no node is named."""
    found = re.fullmatch(
        rf"(.+({'|'.join(map(re.escape, (*GLTF, MITSUBA_FILE)))}))#(.*)", spec, re.IGNORECASE | re.DOTALL
    )
    return (found[1], found[3]) if found and not os.path.exists(spec) else (spec, None)


@np.errstate(all="ignore")  # what is out of range is refused
def import_scene(path: Path, node: str) -> ImportedScene:
    """Read a scene from a .glb or .gltf file.

    The object is repaired, normalised and textured as `import_object` does it; so is every other node with a mesh,
    which stays in its place beside it. Point and spot lights of KHR_lights_punctual become lamps, directional
    ones distant lamps; perspective cameras are kept by name. What is not carried over is among the object's
    warnings.

    Args:
        path: of the file.
        node: name of the object's node, or of its mesh where the node has none; "node 3" is the one with that number.

    Raises:
        UnknownNameError: no node of that name has a mesh, or one below it.
        FileFormatError: as for `import_object`.
        InputError: as for `import_object`; several nodes have the name; or there is too much beside the object.
    """
    data = read_mesh_bytes(path, "scene", GLTF)
    header = gltf.read_header(path, data)
    parts, notes = read_parts(path, data)
    places = dict(poses(header))
    chosen = _below(header, _named(path, header, node, {part.node for part in parts}))
    chosen_parts = [part for part in parts if part.node in chosen]
    others = sorted({part.node for part in parts} - chosen)
    lamps = [index for index in places if header.nodes[index].lamp is not None]
    if len(others) + len(lamps) > MOST_SURROUNDINGS:
        raise InputError(
            f"{path}: expected at most {MOST_SURROUNDINGS} meshes and lights beside the object, got "
            f"{len(others) + len(lamps)}; join some of them in the file"
        )
    frame, names = _frame(chosen_parts), Names(TAKEN)
    called = _mesh_names(header, parts, names)
    surroundings: list[ScenePart] = []
    for number in others:
        group = [part for part in parts if part.node == number]
        name, place = called[number], _frame(group)
        made = object_of(group, [], path, name, "y")
        notes.extend(made.warnings)
        matrix = np.eye(4)
        matrix[:3, :3] *= place.size / frame.size
        matrix[:3, 3] = frame.inside(place.origin)
        surroundings.append(mesh_part(name, made, matrix, made.material))
    lit = [header.lights[header.nodes[index].lamp or 0] for index in lamps]
    glows = any(part.surface.emission is not None for part in parts)
    unit, told = _unit_of_light(header, bool(lit) and glows)
    notes.extend([f"{path.name}: {told}"] if told else [])
    for index, light in zip(lamps, lit, strict=True):
        lamp = _lamp(names.free(light.name or header.label(index)), light, unit, places[index], frame)
        _check_lamp(path, lamp)
        surroundings.append(lamp)
    cameras = {
        name: _camera(header.cameras[header.nodes[index].camera or 0], places[index], frame)
        for index, name in _camera_names(header, places).items()
    }
    for name, camera in cameras.items():
        _check_camera(path, name, camera)
    notes.extend(_changed(path, header))
    return ImportedScene(
        object_of(chosen_parts, notes, path, f"{safe_name(path)}-{clean(node)}", "y"), tuple(surroundings), cameras
    )


def node_names(path: Path) -> list[str]:
    """Return what `import_scene` takes as the object of a glTF file, several of the same name once.

    Raises:
        FileFormatError: as for `import_object`.
    """
    header = gltf.read_header(path, read_mesh_bytes(path, "scene", GLTF))
    drawn = {index for index, node in enumerate(header.nodes) if node.mesh is not None}
    return list(dict.fromkeys(map(header.label, sorted(_above(header, drawn)))))


def _mesh_names(header: Header, parts: Sequence[ImportedPart], names: Names) -> dict[int, str]:
    """Names of the nodes with geometry by number, the same whichever of them is the object."""
    return {number: names.free(header.label(number)) for number in sorted({part.node for part in parts})}


def _camera_names(header: Header, nodes: Iterable[int]) -> dict[int, str]:
    """Names of the cameras with perspective, by the number of their node."""
    names, found = Names(TAKEN), {}
    for index in sorted(nodes):
        camera = header.nodes[index].camera
        if camera is not None and header.cameras[camera].perspective is not None:
            found[index] = names.free(header.cameras[camera].name or header.label(index))
    return found


@dataclass(frozen=True)
class NodeContents:
    """A node with geometry.

    Attributes:
        name: as `import_scene` takes it.
        mesh: what it is called in names of controls, beside another node.
        triangles: of its own mesh.
        size: of its bounding box in the file's axes and units, (3,).
    """

    name: str
    mesh: str
    triangles: int
    size: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Contents:
    """What is in a file.

    Attributes:
        object: everything with geometry, as one object.
        nodes: of a glTF file, in their order.
        lights, cameras: names.
    """

    object: ObjectAsset
    nodes: tuple[NodeContents, ...] = ()
    lights: tuple[str, ...] = ()
    cameras: tuple[str, ...] = ()


@np.errstate(all="ignore")
def contents(path: Path) -> Contents:
    """Return what is understood of a mesh or glTF file; one of Mitsuba has a function of that name of its own.

    Raises:
        FileFormatError, InputError: as for `import_object`.
    """
    data = read_mesh_bytes(path, "object", (*MESHES, MITSUBA_FILE))
    parts, notes = read_parts(path, data)
    if path.suffix.lower() not in GLTF:
        return Contents(object_of(parts, notes, path, safe_name(path), None))
    header = gltf.read_header(path, data)
    whole = object_of(parts, [*notes, *_changed(path, header)], path, safe_name(path), None)
    nodes: dict[int, list[ImportedPart]] = {}
    for part in parts:
        nodes.setdefault(part.node, []).append(part)
    listed, called = [], _mesh_names(header, parts, Names(TAKEN))
    for index, group in sorted(nodes.items()):
        places = np.concatenate([part.vertices[part.faces].reshape(-1, 3) for part in group])
        x, y, z = map(float, np.ptp(places, axis=0))
        listed.append(NodeContents(header.label(index), called[index], sum(len(one.faces) for one in group), (x, y, z)))
    lights = tuple(light.name or f"light {index}" for index, light in enumerate(header.lights))
    cameras = _camera_names(header, dict(poses(header))).values()
    return Contents(whole, tuple(listed), lights, tuple(cameras))


@dataclass(frozen=True, eq=False)
class FileFrame:
    """How something lies in the file, z up: its own coordinates times `size`, plus `origin` (3,)."""

    size: float
    origin: Doubles

    def inside(self, places: Doubles) -> Doubles:
        """Return places (..., 3) of the file, z up, in its own coordinates."""
        return np.asarray((places - self.origin) / self.size)


def _frame(parts: Sequence[ImportedPart]) -> FileFrame:
    """The frame in which the parts have a largest extent of 1, stand on z = 0 and are centred in x and y."""
    corners = []
    for part in visible(parts):
        triangles = part.vertices[part.faces]
        area = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
        extent = float(np.ptp(triangles.reshape(-1, 3), axis=0).max())
        corners.append(triangles[area > FLAT * extent**2].reshape(-1, 3))
    places = np.concatenate(corners) @ UPRIGHT.T
    if not np.isfinite(places).all() or not len(places) or not np.ptp(places, axis=0).max() > 0.0:
        return FileFrame(1.0, np.zeros(3))  # refused with a reason when it is repaired
    low, high = places.min(axis=0), places.max(axis=0)
    return FileFrame(float((high - low).max()), np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]]))


def _named(path: Path, header: Header, name: str, with_mesh: set[int]) -> int:
    """The number of the node of that name which has a mesh, or one below it."""
    labels = {index: header.label(index) for index in sorted(_above(header, with_mesh))}
    found = [index for index, label in labels.items() if name in (label, f"node {index}")]
    if not found:
        raise UnknownNameError(f"node of {path.name}", name, list(dict.fromkeys(labels.values())))
    if len(found) > 1:
        numbers = ", ".join(f"{path.name}#node {index}" for index in found[:10])
        raise InputError(f"{path}: {len(found)} nodes are called {shown(name)}; say which: {numbers}")
    return found[0]


def _below(header: Header, index: int) -> set[int]:
    """A node and all that hangs on it."""
    return _reached({index}, [node.children for node in header.nodes])


def _above(header: Header, nodes: set[int]) -> set[int]:
    """Nodes, and all on which they hang."""
    parents: list[list[int]] = [[] for _ in header.nodes]
    for index, node in enumerate(header.nodes):
        for child in node.children:
            parents[child].append(index)
    return _reached(nodes, parents)


def _reached(begin: set[int], steps: Sequence[Sequence[int]]) -> set[int]:
    """The nodes to which steps lead from others, and these."""
    found, left = set(begin), list(begin)
    while left:
        new = [one for one in steps[left.pop()] if one not in found]
        found.update(new)
        left += new
    return found


def _unit_of_light(header: Header, both: bool) -> tuple[float, str | None]:
    """How many candela are one unit of radiance times the file's area, and what is said of it.

    Alone, lamps are in watts, as exporters have them. Beside surfaces that emit light, of which one nit is one unit,
    what a candela is decides how bright they are to each other.
    """
    if header.asset.generator == GENERATOR:
        return 1.0, None  # a light of USD emits radiance as its surfaces do
    if not both:
        return LUMENS, None
    if "blender" in str(header.asset.generator).lower():
        return LUMENS, (
            "it has lights beside surfaces that emit light, and is Blender's, which exports lights 683 times as bright "
            "beside them as it shows them: they are as Blender shows them"
        )
    return 1.0, "it has lights beside surfaces that emit light: they are taken as candela and nit, as glTF defines them"


def _lamp(name: str, light: LightEntry, unit: float, pose: Doubles, frame: FileFrame) -> PointLamp | SpotLamp:
    """A light at its place; light falls off with the square of the distance in object sizes as it does in the file."""
    power = np.array(light.color) * light.intensity / unit
    if light.type == "directional":
        way = UPRIGHT @ pose[:3, 2]  # it shines along its -z
        place, power = gltf_left_out.FAR * way / max(float(np.linalg.norm(way)), 1e-12), power * gltf_left_out.FAR**2
    else:
        place, power = frame.inside(UPRIGHT @ pose[:3, 3]), power / frame.size**2
    x, y, z = map(float, place)
    red, green, blue = map(float, power)
    if light.type != "spot":
        return PointLamp(name, dark=not power.any(), position=(x, y, z), intensity=(red, green, blue))
    along = UPRIGHT @ -pose[:3, 2]
    across, up, ahead = map(float, along / max(float(np.linalg.norm(along)), 1e-12))
    return SpotLamp(
        name,
        dark=not power.any(),
        position=(x, y, z),
        direction=(across, up, ahead),
        intensity=(red, green, blue),
        cutoff=math.degrees(light.spot.outerConeAngle),
        beam=math.degrees(light.spot.innerConeAngle),
    )


def _changed(path: Path, header: Header) -> list[str]:
    return [path.name + what for what in gltf_left_out.lights_and_cameras(header)]


def _check_lamp(path: Path, lamp: PointLamp | SpotLamp) -> None:
    """Refuse places and powers that are no numbers, or too large for the renderer's."""
    if not all(abs(one) <= FURTHEST for one in (*lamp.position, *lamp.intensity)):  # NaN is not
        raise InputError(
            f"{path}: expected the light {lamp.name} within {FURTHEST:g} object sizes, and no brighter than that, got "
            "more; correct its place or its intensity, or remove it"
        )


def _check_camera(path: Path, name: str, camera: PlacedCamera) -> None:
    """Refuse a place that is no number or too large, axes that are none, and fields of view that a plane has not."""
    if not all(abs(one) <= FURTHEST for one in camera.to_world[:3, 3]):
        raise InputError(
            f"{path}: expected the camera {name} within {FURTHEST:g} object sizes, got more; correct its place, or "
            "remove it"
        )
    axes = camera.to_world[:3, :3]
    if not np.allclose(np.linalg.norm(axes, axis=0), 1.0):
        raise InputError(
            f"{path}: expected the camera {name} to look somewhere, got axes without length; correct the scale of its "
            "node, or remove it"
        )
    if not np.allclose(axes.T @ axes, np.eye(3), atol=SQUARE) or np.linalg.det(axes) < 0.0:
        what = "mirrored" if np.linalg.det(axes) < 0.0 else "sheared"
        raise InputError(
            f"{path}: expected the camera {name} under nodes that turn, move and scale it, got {what} axes; apply the "
            "scale of the nodes above it (in Blender Ctrl A), or remove it"
        )
    if not 0.0 < camera.fov <= WIDEST_VIEW:
        raise InputError(
            f"{path}: expected the camera {name} with a field of view up to {WIDEST_VIEW:g} degrees, got "
            f"{camera.fov:.4g}; correct it, or remove it"
        )


def _camera(camera: CameraEntry, pose: Doubles, frame: FileFrame) -> PlacedCamera:
    assert camera.perspective is not None
    turn = UPRIGHT @ pose[:3, :3] @ BEHIND
    matrix = np.eye(4)
    matrix[:3, :3] = turn / np.maximum(np.linalg.norm(turn, axis=0), 1e-12)
    matrix[:3, 3] = frame.inside(UPRIGHT @ pose[:3, 3])
    ratio = camera.perspective.aspectRatio  # without one, that of the picture holds (section 5.13)
    half = math.tan(camera.perspective.yfov / 2.0) * max(ratio or 1.0, 1.0)
    return PlacedCamera(matrix, math.degrees(2.0 * math.atan(half)), upright=ratio is None)
