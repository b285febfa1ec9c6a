"""A shape of a Mitsuba scene as the object, and all the rest around it as it is.

Lengths are in object sizes, so that everything is moved and scaled with the object, as
in `advsearch.scene.importing.scenes`. Lights whose power is a quantity of lengths are
scaled with it, and media too.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from advsearch.errors import InputError, UnknownNameError
from advsearch.scene.assets import FileAxis, Floats, Mesh, ObjectAsset, normalised
from advsearch.scene.importing.files import Notes, clean, safe_name, shown
from advsearch.scene.importing.geometry import assemble, join
from advsearch.scene.importing.parts import BRIGHTEST, ImportedPart, ImportedSurface
from advsearch.scene.importing.scenes import TAKEN, ImportedScene
from advsearch.scene.importing.texture import textured
from advsearch.scene.mitsuba_backend import shapes
from advsearch.scene.mitsuba_backend.meshes import plain, with_inner
from advsearch.scene.mitsuba_backend.variant import Plugin
from advsearch.scene.mitsuba_backend.xml_files import (
    INTEGRATORS,
    LIGHTS,
    MEDIA,
    SENSORS,
    SHAPES,
    read_scene,
    trusted,
)
from advsearch.scene.parts import (
    MediumPart,
    PlacedCamera,
    PluginPart,
    ScenePart,
    plugins_in,
)

CAMERAS = frozenset(("perspective", "thinlens"))
NOTHING = {"type": "null"}  # the surface of what only bounds a medium
Y_TO_Z = np.array(
    [
        [1.0, 0.0, 0.0, 0.0],
        [0.0, 0.0, -1.0, 0.0],
        [0.0, 1.0, 0.0, 0.0],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
MOST_PARTS = 2000  # plugins at the top of a scene
# of the film of which Mitsuba's `focal_length` speaks, millimetres
DIAGONAL = math.hypot(36.0, 24.0)
NUMBERS: Mapping[str, tuple[tuple[int, ...], str]] = {
    **dict.fromkeys(("radius", "fov", "width", "height"), ((), "a number")),
    **dict.fromkeys(
        ("center", "p0", "p1", "position", "direction"), ((3,), "three numbers")
    ),
    "to_world": ((4, 4), "a transform"),
}
"""Entries that are numbers in whatever plugin has them, their shape, and what they are
in words.
"""


def read_tree(scene: Path | Mapping[str, object]) -> tuple[Plugin, list[str]]:
    """Return a scene file's dictionary, or a caller's own, with arrays for transforms;
    and warnings about its pictures.

    Raises:
        FileFormatError: as for `read_scene` and `trusted`.
        InputError: no scene.
    """
    notes: list[str] = []
    if isinstance(scene, Path):
        tree = trusted(scene, read_scene(scene), notes)
    elif scene.get("type") == "scene":
        tree = plain(scene)
        notes = [
            f"scene: {name} is left out: expected a plugin's dictionary, got "
            f"{type(entry).__name__}"
            for name, entry in scene.items()
            if name != "type" and not isinstance(entry, Mapping)
        ]
    else:
        raise InputError(
            f"scene: expected a dictionary of type 'scene', got {scene.get('type')!r}"
        )
    _check_numbers(tree, str(scene) if isinstance(scene, Path) else "scene")
    return tree, notes


def _check_numbers(plugin: Mapping[str, object], where: str) -> None:
    """Check that numbers stand where they are read here; what else a plugin has is for
    Mitsuba to refuse.
    """
    for key, value in plugin.items():
        # of whatever name
        if isinstance(value, Mapping) and value.get("type", "rgb") not in (
            "rgb",
            "spectrum",
        ):
            _check_numbers(
                value,
                where
                if plugin["type"] != "scene"
                else f"{where}: {shown(key, quoted=False)}",
            )
        elif key in NUMBERS:
            shape, expected = NUMBERS[key]
            try:
                right = np.asarray(value, np.float64).shape == shape
            except (TypeError, ValueError):
                right = False
            if not right:
                raise InputError(
                    f"{where}: expected {expected} as {key} of its {plugin['type']}, "
                    f"got {shown(str(value))}"
                )


@dataclass(frozen=True)
class PluginContents:
    """What is in a Mitsuba scene, by id: shapes that can be the object; of the rest,
    which stays as it is, its plugin's name; what shines; and sensors that can be looked
    through.
    """

    objects: tuple[str, ...]
    kept: Mapping[str, str]
    lights: tuple[str, ...]
    cameras: tuple[str, ...]


def contents(path: Path) -> PluginContents:
    """Return what is understood of a scene file; it is refused as of `read_tree`."""
    named = dict(_plugins(read_tree(path)[0]))
    kinds = {name: str(plugin["type"]) for name, plugin in named.items()}
    objects = tuple(
        name
        for name, kind in kinds.items()
        if kind in shapes.MESHES and named[name].get("bsdf") != NOTHING
    )
    cameras = tuple(name for name, kind in kinds.items() if kind in CAMERAS)
    known = {*objects, *cameras}
    unkept = INTEGRATORS | SENSORS
    kept = {
        name: kind
        for name, kind in kinds.items()
        if name not in known and kind not in unkept
    }
    lights = tuple(name for name, plugin in named.items() if _shines(plugin))
    return PluginContents(objects, kept, lights, tuple(map(_free, cameras)))


def _free(name: str) -> str:
    return f"{name}-2" if name in TAKEN else name


def _shines(plugin: Mapping[str, object]) -> bool:
    return any(inner.get("type") in LIGHTS for inner in plugins_in(plugin))


def import_plugins(scene: Path | Mapping[str, object], wanted: str) -> ImportedScene:
    """Read a Mitsuba scene, an XML file or a dictionary as Mitsuba's loader takes it.

    The shape becomes a mesh with its own kind of surface, whose base colour, where it
    has one, becomes a texture. Everything else stays as it is, under its own name.
    Perspective sensors become cameras. Integrator, sampler and film are those of the
    house. What is left out is among the object's warnings.

    Args:
        wanted: id of the shape that is the object; where there is none, the only one
            that differs in nothing but case and signs ("largebox" means "large-box", as
            Mitsuba's own writer calls it).

    Raises:
        UnknownNameError: it has no such shape.
        FileFormatError: as for `read_tree`.
        InputError: the shape is no mesh and cannot be made one, or the scene is too
            large.
    """
    tree, notes = read_tree(scene)
    where = scene.name if isinstance(scene, Path) else "scene"
    named = dict(_plugins(tree))
    ids = [name for name, plugin in named.items() if plugin["type"] in SHAPES]
    letters = {
        name: "".join(filter(str.isalnum, name.casefold())) for name in (*ids, wanted)
    }
    alike = [name for name in ids if letters[name] == letters[wanted]]
    if wanted not in ids and len(alike) == 1:
        wanted = alike[0]
    if wanted not in ids:
        raise UnknownNameError(f"shape of {where}", wanted, ids)
    if len(named) > MOST_PARTS:
        raise InputError(
            f"{where}: expected at most {MOST_PARTS} plugins at the top, "
            f"got {len(named)}; join meshes"
        )
    shape = named[wanted]
    surface = shapes.surface_of(_bsdf(shape, named))
    (mesh, own_uvs) = shapes.mesh_of(shape, wanted)
    placed = [
        plugin
        for plugin in named.values()
        if plugin["type"] in SENSORS and "to_world" in plugin
    ]
    # of the first camera's side
    upper = (
        abs(shapes.pose_of(placed[0])[:3, 1]) if placed else np.array([0.0, 1.0, 0.0])
    )
    frame = _ObjectFrame(mesh, wanted, z_up=bool(upper[2] > upper[1]))
    haze, used = shapes.haze_in(named, frame.matrix) or (None, frozenset[str]())
    light = _light(shape)
    left_out = _left_out(tree, shape, hazy=haze is not None, lit=light is not None)
    missing = _missing_attributes(surface.plugin, mesh)
    notes += [f"{where}: {clause}" for clause in (*left_out, *surface.notes, *missing)]
    source = scene if isinstance(scene, Path) else Path("scene.xml")
    turn = frame.turn.astype(np.float32)
    # z up
    mesh = replace(mesh, vertices=mesh.vertices @ turn.T, normals=mesh.normals @ turn.T)
    mesh, base_color = _painted(mesh, own_uvs, surface, str(shape["type"]), where)
    made = ObjectAsset(
        name=f"{safe_name(source)}-{clean(wanted)}", mesh=normalised(mesh), base_color=base_color, source=str(source),
        warnings=tuple(notes), up=FileAxis("z"), surface=surface.plugin, emission=light, extent=frame.size,
    )  # fmt: skip
    around: list[ScenePart] = [] if haze is None else [haze]
    cameras: dict[str, PlacedCamera] = {}
    for name, plugin in named.items():
        if plugin["type"] in CAMERAS:
            cameras[_free(name)] = _camera(plugin, frame)
        elif (
            name != wanted
            and name not in used
            and plugin["type"] not in INTEGRATORS | SENSORS
        ):
            kept = _renamed(frame.moved(plugin))
            holds = (
                MediumPart
                if any(inner.get("type") in MEDIA for inner in plugins_in(kept))
                else PluginPart
            )
            around.append(holds(_free(name), kept, _shines(kept)))
    return ImportedScene(made, tuple(around), cameras)


def _painted(
    mesh: Mesh, own_uvs: bool, surface: shapes.ShapeSurface, kind: str, where: str
) -> tuple[Mesh, Floats]:
    """Return a shape's mesh with texture coordinates for its base colour, and that.

    Where anything is looked up by the mesh's own, or by its attributes, they stay. A
    shape of one colour gets new ones where its own do not tell its places apart, as on
    a cube.
    """
    if surface.picture or surface.bound:
        down = mesh.uvs * (1.0, -1.0) + (0.0, 1.0)
        down = down @ surface.to_uv[:2, :2].T + surface.to_uv[:2, 2]
        return replace(
            mesh, uvs=(down * (1.0, -1.0) + (0.0, 1.0)).astype(np.float32)
        ), surface.base_color
    own_uvs &= kind not in ("cube", "sphere", "cylinder", "disk")
    vertices, normals, uvs = (
        values.astype(np.float64) for values in (mesh.vertices, mesh.normals, mesh.uvs)
    )
    color = ImportedSurface(color=surface.base_color[0, 0])
    part = ImportedPart(
        vertices,
        mesh.faces.astype(np.int64),
        normals,
        uvs if own_uvs else None,
        None,
        color,
    )
    soup, maps = textured(join([part], where, np.eye(3)), [color], Notes(where))
    return assemble(soup)[0], maps.color


def _plugins(tree: Mapping[str, object]) -> Iterator[tuple[str, Mapping[str, object]]]:
    return (
        (name, one)
        for name, one in tree.items()
        if isinstance(one, Mapping) and "type" in one
    )


def _renamed(plugin: Mapping[str, object]) -> Plugin:
    """A plugin whose references have the names that the house left free."""
    entries = with_inner(plugin, _renamed)
    if entries["type"] == "ref" and entries["id"] in TAKEN:
        entries["id"] = f"{entries['id']}-2"
    return entries


def _bsdf(
    shape: Mapping[str, object], named: Mapping[str, Mapping[str, object]]
) -> Mapping[str, object]:
    """The surface of a shape with what it refers to in its place; Mitsuba's default
    where it has none.
    """

    count = 0

    def whole(plugin: Mapping[str, object], depth: int) -> Mapping[str, object]:
        nonlocal count
        count += 1
        if count > MOST_PARTS:
            raise InputError(
                f"object: expected a surface of at most {MOST_PARTS} "
                "plugins, got more; make it simpler"
            )
        if plugin["type"] == "ref":
            name = str(plugin["id"])
            if name not in named or depth > len(named):
                raise UnknownNameError("material of the scene", name, list(named))
            return whole(named[name], depth + 1)
        return with_inner(plugin, lambda inner: whole(inner, depth))

    for inner in shape.values():
        if isinstance(inner, Mapping) and inner["type"] not in LIGHTS | MEDIA:
            return whole(inner, 0)
    return {"type": "diffuse"}


def _light(shape: Mapping[str, object]) -> Floats | None:
    """The radiance (1, 1, 3) of a shape that shines evenly; None of any other."""
    for inner in shape.values():
        if (
            isinstance(inner, Mapping)
            and inner["type"] == "area"
            and set(inner) <= {"type", "id", "radiance"}
        ):
            radiance = shapes.constant(inner.get("radiance"))
            if (
                radiance is not None
                and 0.0 < radiance.max() <= BRIGHTEST
                and radiance.min() >= 0.0
            ):
                return radiance.reshape(1, 1, 3)
    return None


def _missing_attributes(surface: Mapping[str, object], mesh: Mesh) -> Iterator[str]:
    """Sentences about attributes that a surface shows and the mesh has not."""
    for plugin in plugins_in(surface):
        name = plugin.get("name")
        if plugin["type"] == "mesh_attribute" and name not in mesh.attributes:
            there = ", ".join(sorted(mesh.attributes)) or "none"
            yield (
                f"the mesh has no attribute {shown(str(name))} (it has {there}), so "
                "that is black"
            )


def _left_out(
    tree: Mapping[str, object], shape: Mapping[str, object], *, hazy: bool, lit: bool
) -> Iterator[str]:
    """Sentences about what is not as it is in the file; `hazy`: the camera's medium is
    the scene's haze, `lit`: the object keeps its light.
    """
    for name, plugin in _plugins(tree):
        kind = plugin["type"]
        if kind in SENSORS - CAMERAS:
            yield f"the sensor {name} is left out: a {kind}"
        elif kind == "thinlens":
            yield f"the sensor {name} is sharp at all distances: its lens is left out"
        elif kind in INTEGRATORS - {
            "path",
            "prb",
            "volpath",
            "prbvolpath",
            "volpathmis",
            "prb_projective",
        }:
            yield (
                f"the integrator {name} is left out: a {kind}; light takes all "
                "paths "
                "of up to 6 segments"
            )
        elif kind in INTEGRATORS:
            if plugin.get("hide_emitters"):
                yield (
                    f"hide_emitters of the integrator {name} is left out: lights "
                    "are "
                    "seen"
                )
            depth = plugin.get("max_depth", -1)
            if isinstance(depth, int) and 0 <= depth < 6:
                yield (
                    f"the integrator's max_depth of {depth} is left out: light "
                    "takes "
                    "all paths of up to 6 segments"
                )
        if kind in SENSORS:
            films = [inner for inner in plugin.values() if isinstance(inner, Mapping)]
            if any(str(key).startswith("crop") for film in films for key in film):
                yield (
                    f"the crop of the film of {name} is left out: the whole picture "
                    "is seen"
                )
            if "medium" in plugin and not hazy:
                yield (
                    f"the sensor {name} sees nothing of its medium up to the first "
                    "surface"
                )
            if any("principal_point" in key for key in plugin):
                yield (
                    f"the sensor {name} looks along its middle: its principal point "
                    "is left out"
                )
    for key, inner in shape.items():
        if not isinstance(inner, Mapping) and key not in shapes.OF_A_SHAPE:
            yield f"the object's {shown(key)} is left out: a {shape['type']} has none"
        if isinstance(inner, Mapping) and inner["type"] in LIGHTS and not lit:
            yield "the object's own light is left out"
        if isinstance(inner, Mapping) and inner["type"] in MEDIA:
            yield "the medium in the object is left out"


class _ObjectFrame:
    """From the scene's coordinates to the object's: z up, standing on z = 0, a largest
    extent of 1.
    """

    def __init__(self, mesh: Mesh, name: str, *, z_up: bool) -> None:
        turn = np.eye(4) if z_up else Y_TO_Z
        places = mesh.vertices.astype(np.float64) @ turn[:3, :3].T
        low = places.min(axis=0)
        high = places.max(axis=0)
        self.turn = turn[:3, :3]
        self.size = float((high - low).max())
        if not (math.isfinite(self.size) and self.size > 0.0):
            raise InputError(
                f"object {name}: expected a shape of some size, got one of {self.size}"
            )
        move = np.eye(4)
        move[:3, 3] = (-(low[0] + high[0]) / 2, -(low[1] + high[1]) / 2, -low[2])
        self.matrix = np.diag([1.0 / self.size] * 3 + [1.0]) @ move @ turn

    def moved(self, plugin: Mapping[str, object], *, top: bool = True) -> Plugin:
        """Return a plugin at the top of a scene, or within another, in its place; media
        are scaled everywhere.
        """
        kind = plugin["type"]
        entries = dict(plugin)
        if kind in MEDIA:
            entries["scale"] = float(np.asarray(entries.get("scale", 1.0))) * self.size
        elif kind in ("gridvolume", "constvolume"):
            entries["to_world"] = self.matrix @ shapes.pose_of(plugin)
        elif not top:
            pass
        elif kind == "merge":
            return with_inner(entries, self.moved)
        elif kind in SHAPES - {"shapegroup"}:
            entries["to_world"] = self.matrix @ shapes.pose_of(plugin)
        elif kind in ("constant", "envmap", "sunsky", "timed_sunsky", "directional"):
            turn = np.eye(4)
            turn[:3, :3] = self.turn
            if "direction" in entries:
                entries["direction"] = (
                    self.turn @ np.asarray(entries["direction"], dtype=np.float64)
                ).tolist()
            elif kind != "constant":
                entries["to_world"] = turn @ shapes.pose_of(plugin)
        elif kind in ("point", "spot", "projector"):
            if "position" in entries:
                place = np.asarray(entries["position"], dtype=np.float64)
                entries["position"] = (
                    self.matrix[:3, :3] @ place + self.matrix[:3, 3]
                ).tolist()
            else:
                entries["to_world"] = self.matrix @ shapes.pose_of(plugin)
            power = "irradiance" if kind == "projector" else "intensity"
            entries[power] = _times(entries.get(power, 1.0), self.size**-2, str(kind))
        return with_inner(entries, lambda inner: self.moved(inner, top=False))


def _times(value: object, factor: float, kind: str) -> object:
    if isinstance(value, (int, float)):
        return float(value) * factor
    if isinstance(value, Mapping):
        light = value["type"]
        inner = value.get("value")
        if light in ("rgb", "uniform", "srgb", "spectrum") and isinstance(
            inner, (int, float)
        ):
            return {**value, "value": float(inner) * factor}
        if light == "rgb" and inner is not None:
            return {
                **value,
                "value": (np.asarray(inner, dtype=np.float64) * factor).tolist(),
            }
        if light == "spectrum" and isinstance(inner, (list, tuple)):
            return {
                **value,
                "value": [(length, amount * factor) for length, amount in inner],
            }
        if light in ("d65", "blackbody"):
            return {
                **value,
                "scale": float(np.asarray(value.get("scale", 1.0))) * factor,
            }
        if light == "bitmap" and isinstance(value.get("bitmap"), np.ndarray):
            return {**value, "bitmap": np.asarray(value["bitmap"]) * np.float32(factor)}
    raise InputError(
        f"{kind} light: expected a power as a number, rgb or spectrum; "
        "change it in the scene"
    )


def _camera(sensor: Mapping[str, object], frame: _ObjectFrame) -> PlacedCamera:
    matrix = frame.matrix @ shapes.pose_of(sensor)
    matrix[:3, :3] /= np.maximum(np.linalg.norm(matrix[:3, :3], axis=0), 1e-12)
    inner = [entry for entry in sensor.values() if isinstance(entry, Mapping)]
    film = next((plugin for plugin in inner if "film" in str(plugin["type"])), {})
    width, height = (
        float(np.asarray(film.get(side, other)))
        for side, other in (("width", 768), ("height", 576))
    )
    if not min(width, height) >= 1.0:
        raise InputError(
            "camera: expected a film of at least 1 x 1 pixels, got "
            f"{width:g} x {height:g}"
        )
    axis = str(sensor.get("fov_axis", "x"))
    degrees = float(np.asarray(sensor.get("fov", 0.0)))
    if not degrees:
        text = str(sensor.get("focal_length", "50mm"))
        length = 0.0
        with contextlib.suppress(ValueError):
            length = float(text.removesuffix("mm"))
        if not length > 0.0:
            raise InputError(
                f"focal_length: expected millimetres, such as 50mm, got {text!r}"
            )
        axis = "diagonal"
        degrees = 2.0 * math.degrees(math.atan(DIAGONAL / (2.0 * length)))
    larger = max(width, height)
    smaller = min(width, height)
    across = {
        "x": width,
        "y": height,
        "diagonal": math.hypot(width, height),
        "larger": larger,
        "smaller": smaller,
    }
    half = math.tan(math.radians(degrees) / 2.0) * larger / across.get(axis, width)
    return PlacedCamera(matrix, 2.0 * math.degrees(math.atan(half)))
