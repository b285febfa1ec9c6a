"""Import a Mitsuba scene: one shape becomes the object, all the rest its surroundings.

Lengths are in object sizes, so that everything is moved and scaled with the object, as
in `advsearch.scene.importing.scenes`. Lights whose power depends on the unit of length
are scaled with it, and media too.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from advsearch.errors import InputError, UnknownNameError
from advsearch.scene.assets import (
    FileAxis,
    Float32Array,
    Float64Array,
    Mesh,
    ObjectAsset,
    normalise_mesh,
)
from advsearch.scene.importing.files import (
    Notes,
    format_name,
    make_safe_name,
    sanitize_name,
)
from advsearch.scene.importing.geometry import join_parts, make_mesh_from_soup
from advsearch.scene.importing.parts import MAX_RADIANCE, ImportedPart, ImportedSurface
from advsearch.scene.importing.scenes import RESERVED_NAMES, ImportedScene
from advsearch.scene.importing.texture import apply_textures
from advsearch.scene.mitsuba_backend import shapes
from advsearch.scene.mitsuba_backend.meshes import map_inner_plugins, to_plain
from advsearch.scene.mitsuba_backend.variant import Plugin
from advsearch.scene.mitsuba_backend.xml_files import (
    INTEGRATOR_TYPES,
    LIGHT_TYPES,
    MEDIUM_TYPES,
    SENSOR_TYPES,
    SHAPE_TYPES,
    check_and_read_files,
    read_scene,
)
from advsearch.scene.parts import (
    HazePart,
    MediumPart,
    PluginPart,
    PosedCamera,
    ScenePart,
    iterate_plugins,
)

CAMERAS = frozenset(("perspective", "thinlens"))
PATH_INTEGRATORS = frozenset(
    ("path", "prb", "volpath", "prbvolpath", "volpathmis", "prb_projective")
)
NULL_BSDF = {"type": "null"}  # the surface of what only bounds a medium
Y_TO_Z = np.array(
    [
        [1.0, 0.0, 0.0, 0.0],
        [0.0, 0.0, -1.0, 0.0],
        [0.0, 1.0, 0.0, 0.0],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
MAX_PLUGINS = 2000  # largest number of plugins at the top of a scene
MAX_DEPTH = 6  # longest light path of ours in segments, as `scene.MAX_DEPTH`
# size of the film to which Mitsuba's `focal_length` refers, millimeters
FILM_DIAGONAL = math.hypot(36.0, 24.0)
NUMERIC_ENTRIES: Mapping[str, tuple[tuple[int, ...], str]] = {
    **dict.fromkeys(("radius", "fov", "width", "height"), ((), "a number")),
    **dict.fromkeys(
        ("center", "p0", "p1", "position", "direction"), ((3,), "three numbers")
    ),
    "to_world": ((4, 4), "a transform"),
}
"""Entries that are numbers in whatever plugin has them: their shape and description."""


def read_scene_dict(scene: Path | Mapping[str, object]) -> tuple[Plugin, list[str]]:
    """Read a scene file or a dictionary; transforms become arrays (4, 4).

    Args:
        scene: path of an XML file, or a dictionary of the type "scene".

    Returns:
        The dictionary, and warnings about its images and ignored entries.

    Raises:
        FileFormatError: the file is missing or corrupt, or it names a plugin or a file
            that may not be read.
        InputError: the dictionary is no scene, or an entry is no number.
    """
    notes: list[str] = []
    if isinstance(scene, Path):
        tree = check_and_read_files(scene, read_scene(scene), notes)
    elif scene.get("type") == "scene":
        tree = to_plain(scene)
        notes = _describe_non_plugins(scene)
    else:
        raise InputError(
            f"scene: expected a dictionary of type 'scene', got {scene.get('type')!r}"
        )
    _check_numbers(tree, str(scene) if isinstance(scene, Path) else "scene")
    return tree, notes


def _describe_non_plugins(scene: Mapping[str, object]) -> list[str]:
    """Return warnings about entries of a scene's dictionary that are no plugins."""
    return [
        f"scene: {name} is left out: expected a plugin's dictionary, got "
        f"{type(entry).__name__}"
        for name, entry in scene.items()
        if name != "type" and not isinstance(entry, Mapping)
    ]


def _check_numbers(plugin: Mapping[str, object], where: str) -> None:
    """Check that the entries of a plugin that we read ourselves are numbers.

    They are those of `NUMERIC_ENTRIES`; Mitsuba checks all others. Inner plugins are
    checked too.

    Args:
        plugin: the plugin's dictionary.
        where: beginning of error messages.

    Raises:
        InputError: an entry is no number, or not of the right shape.
    """
    for key, value in plugin.items():
        # A color such as {"type": "rgb", "value": ...} is a value here, and no plugin.
        # So is a dictionary without a type, which is rejected below as a number.
        is_plugin = isinstance(value, Mapping) and value.get("type", "rgb") not in (
            "rgb",
            "spectrum",
        )
        if isinstance(value, Mapping) and is_plugin:
            # Errors name the plugin at the top of the scene.
            inner_where = where
            if plugin["type"] == "scene":
                inner_where = f"{where}: {format_name(key, quoted=False)}"
            _check_numbers(value, inner_where)
        elif key in NUMERIC_ENTRIES:
            _check_numeric_entry(key, value, plugin["type"], where)


def _check_numeric_entry(key: str, value: object, kind: object, where: str) -> None:
    """Check that an entry of `NUMERIC_ENTRIES` is numbers of the right shape.

    Args:
        key: key of the entry.
        value: its value.
        kind: type of its plugin, for errors.
        where: beginning of error messages.
    """
    shape, expected = NUMERIC_ENTRIES[key]
    try:
        is_valid = np.asarray(value, np.float64).shape == shape
    except (TypeError, ValueError):
        is_valid = False
    if not is_valid:
        raise InputError(
            f"{where}: expected {expected} as {key} of its {kind}, "
            f"got {format_name(str(value))}"
        )


@dataclass(frozen=True)
class PluginContents:
    """What is in a Mitsuba scene, by id."""

    objects: tuple[str, ...]  # shapes that can be the object
    unchanged: Mapping[str, str]  # the plugin's name of what stays as it is
    lights: tuple[str, ...]  # what emits light
    cameras: tuple[str, ...]  # sensors that can be used


def read_contents(path: Path) -> PluginContents:
    """Return the objects, cameras, lights and other plugins of a scene file.

    Raises:
        FileFormatError: the file is missing or corrupt, or it names a plugin or a file
            that may not be read.
        InputError: an entry of a plugin is no number.
    """
    named = dict(_list_plugins(read_scene_dict(path)[0]))
    type_by_name = {name: str(plugin["type"]) for name, plugin in named.items()}
    objects = tuple(
        name
        for name, kind in type_by_name.items()
        if kind in shapes.OBJECT_SHAPES and named[name].get("bsdf") != NULL_BSDF
    )
    cameras = tuple(name for name, kind in type_by_name.items() if kind in CAMERAS)
    unchanged = _select_unchanged(type_by_name, {*objects, *cameras})
    lights = tuple(name for name, plugin in named.items() if _emits_light(plugin))
    return PluginContents(
        objects=objects,
        unchanged=unchanged,
        lights=lights,
        cameras=tuple(map(_rename_reserved, cameras)),
    )


def _select_unchanged(
    type_by_name: Mapping[str, str], known_names: Collection[str]
) -> dict[str, str]:
    """Return the types of plugins that stay unchanged, without those of known names.

    Integrators and sensors are replaced by our own; sensors that can be used also give
    these their poses.
    """
    replaced_types = INTEGRATOR_TYPES | SENSOR_TYPES
    return {
        name: kind
        for name, kind in type_by_name.items()
        if name not in known_names and kind not in replaced_types
    }


def _rename_reserved(name: str) -> str:
    """Return a name that is not one of `RESERVED_NAMES`."""
    return f"{name}-2" if name in RESERVED_NAMES else name


def _emits_light(plugin: Mapping[str, object]) -> bool:
    """Return whether a plugin, or one in it, is a light."""
    return any(inner.get("type") in LIGHT_TYPES for inner in iterate_plugins(plugin))


def import_mitsuba_scene(
    scene: Path | Mapping[str, object], object_id: str
) -> ImportedScene:
    """Import a Mitsuba scene, an XML file or a dictionary as Mitsuba's loader takes it.

    The shape becomes a mesh with its own kind of surface, whose base color, where it
    has one, becomes a texture. Everything else stays as it is, under its own name.
    Perspective sensors become cameras. Integrator, sampler and film are those of
    advsearch. What is left out is among the object's warnings.

    Args:
        scene: path of the file, or the dictionary.
        object_id: id of the shape that is the object. If no shape has it, a similar id
            counts, see `_find_shape`: "largebox" means "large-box".

    Raises:
        UnknownNameError: it has no such shape.
        FileFormatError: the file is missing or corrupt, or it names a plugin or a file
            that may not be read.
        InputError: the shape is no mesh and cannot be made one, or the scene is too
            large.
    """
    tree, notes = read_scene_dict(scene)
    where = scene.name if isinstance(scene, Path) else "scene"
    plugins = dict(_list_plugins(tree))
    object_id = _find_shape(plugins, object_id, where)
    _check_plugin_count(plugins, where)
    shape = _load_object_shape(plugins, object_id)
    frame = _ObjectFrame(shape.mesh, object_id, z_up=_is_z_up(plugins))
    # A haze replaces the plugins that it is made of.
    haze, haze_names = _find_haze_and_names(plugins, frame)
    clauses = shape.describe_changes(tree, hazy=haze is not None)
    notes += [f"{where}: {clause}" for clause in clauses]
    source = scene if isinstance(scene, Path) else Path("scene.xml")
    asset = shape.make_asset(frame, source, where, notes)
    surroundings: list[ScenePart] = [] if haze is None else [haze]
    surroundings += _import_surroundings(plugins, {object_id, *haze_names}, frame)
    cameras = _import_cameras(plugins, frame)
    return ImportedScene(asset, tuple(surroundings), cameras)


@dataclass(frozen=True, eq=False)
class _ObjectShape:
    """The shape of a scene that becomes the object."""

    name: str  # its id
    plugin: Mapping[str, object]  # its dictionary
    surface: shapes.ShapeSurface
    mesh: Mesh  # in the scene's coordinates
    has_uvs: bool  # whether the file has texture coordinates of it

    def describe_changes(self, tree: Mapping[str, object], *, hazy: bool) -> list[str]:
        """Return clauses about what of a scene and this shape is not as in the file.

        `hazy` is whether the medium that cameras stand in is rendered, as a haze.
        """
        lit = _find_radiance(self.plugin) is not None
        return [
            *_describe_left_out(tree, self.plugin, hazy=hazy, lit=lit),
            *self.surface.notes,
            *_describe_missing_attributes(self.surface.plugin, self.mesh),
        ]

    def make_asset(
        self, frame: _ObjectFrame, source: Path, where: str, notes: list[str]
    ) -> ObjectAsset:
        """Make the object.

        Args:
            frame: its coordinates.
            source: path of the scene.
            where: the scene, for errors.
            notes: warnings about the import.
        """
        mesh, base_color = _paint(
            _make_upright(self.mesh, frame.rotation),
            has_uvs=self.has_uvs,
            surface=self.surface,
            kind=str(self.plugin["type"]),
            where=where,
        )
        return ObjectAsset(
            name=f"{make_safe_name(source)}-{sanitize_name(self.name)}",
            mesh=normalise_mesh(mesh),
            base_color=base_color,
            source=str(source),
            warnings=tuple(notes),
            up=FileAxis("z"),
            surface=self.surface.plugin,
            emission=_find_radiance(self.plugin),
            extent=frame.size,
        )


def _load_object_shape(
    plugins: Mapping[str, Mapping[str, object]], name: str
) -> _ObjectShape:
    """Load the shape with an id, and read its surface."""
    plugin = plugins[name]
    surface = shapes.read_surface(_find_surface(plugin, plugins))
    mesh, has_uvs = shapes.load_shape_mesh(plugin, name)
    return _ObjectShape(name, plugin, surface, mesh, has_uvs)


def _check_plugin_count(plugins: Collection[str], where: str) -> None:
    """Raise InputError if a scene has too many plugins at its top."""
    if len(plugins) > MAX_PLUGINS:
        raise InputError(
            f"{where}: expected at most {MAX_PLUGINS} plugins at the top, "
            f"got {len(plugins)}; join meshes"
        )


def _find_haze_and_names(
    plugins: Mapping[str, Mapping[str, object]], frame: _ObjectFrame
) -> tuple[HazePart | None, frozenset[str]]:
    """Return the haze of a scene, and the names of the plugins that it replaces.

    These are a ball and the medium in it.
    """
    haze_and_names = shapes.find_haze(plugins, frame.matrix)
    return (None, frozenset()) if haze_and_names is None else haze_and_names


def _import_cameras(
    plugins: Mapping[str, Mapping[str, object]], frame: _ObjectFrame
) -> dict[str, PosedCamera]:
    """Return the cameras of a scene by name, in the object's coordinates."""
    return {
        _rename_reserved(name): _import_camera(plugin, frame)
        for name, plugin in plugins.items()
        if plugin["type"] in CAMERAS
    }


def _make_upright(mesh: Mesh, rotation: Float64Array) -> Mesh:
    """Return a mesh turned by a rotation (3, 3) from scene coordinates to z up."""
    matrix = rotation.astype(np.float32).T
    return replace(mesh, vertices=mesh.vertices @ matrix, normals=mesh.normals @ matrix)


def _find_shape(
    named: Mapping[str, Mapping[str, object]], object_id: str, where: str
) -> str:
    """Return the id of the shape that a user names.

    If no shape has that id, it is the only one whose id has the same letters and
    digits, in any case: "largebox" means "large-box".

    Args:
        named: the scene's plugins by name.
        object_id: the name.
        where: the scene, for errors.

    Raises:
        UnknownNameError: there is no such shape, or several.
    """

    def simplify(name: str) -> str:
        """Return the letters and digits of a name, without case."""
        return "".join(filter(str.isalnum, name.casefold()))

    ids = [name for name, plugin in named.items() if plugin["type"] in SHAPE_TYPES]
    if object_id in ids:
        return object_id
    similar = [name for name in ids if simplify(name) == simplify(object_id)]
    if len(similar) != 1:
        raise UnknownNameError(f"shape of {where}", object_id, ids)
    return similar[0]


def _is_z_up(named: Mapping[str, Mapping[str, object]]) -> bool:
    """Return whether z is the upward axis of a scene, and not y.

    The first camera with a pose decides: z is up if the camera's own upward axis is
    nearer to z than to y. Without such a camera y is up, as usual in Mitsuba.
    """
    posed_sensors = [
        plugin
        for plugin in named.values()
        if plugin["type"] in SENSOR_TYPES and "to_world" in plugin
    ]
    if not posed_sensors:
        return False
    # A camera's own upward axis is its y axis, the second column.
    upwards = abs(shapes.get_pose(posed_sensors[0])[:3, 1])
    return bool(upwards[2] > upwards[1])


def _import_surroundings(
    named: Mapping[str, Mapping[str, object]],
    used: Collection[str],
    frame: _ObjectFrame,
) -> Iterator[ScenePart]:
    """Yield all plugins that stay as they are, in the object's coordinates.

    Integrators and sensors are left out.

    Args:
        named: the scene's plugins by name.
        used: names of the plugins that became the object or the haze.
        frame: the object's coordinates.
    """
    replaced_types = INTEGRATOR_TYPES | SENSOR_TYPES
    for name, plugin in named.items():
        if name in used or plugin["type"] in replaced_types:
            continue
        yield _import_plugin(name, plugin, frame)


def _import_plugin(
    name: str, plugin: Mapping[str, object], frame: _ObjectFrame
) -> ScenePart:
    """Return a plugin of a scene as a part, in the object's coordinates."""
    moved_plugin = _rename_references(frame.move_plugin(plugin))
    inner_types = (inner.get("type") for inner in iterate_plugins(moved_plugin))
    has_medium = any(inner_type in MEDIUM_TYPES for inner_type in inner_types)
    part_type = MediumPart if has_medium else PluginPart
    return part_type(
        _rename_reserved(name),
        plugin=moved_plugin,
        emits_light=_emits_light(moved_plugin),
    )


def _paint(
    mesh: Mesh, has_uvs: bool, surface: shapes.ShapeSurface, kind: str, where: str
) -> tuple[Mesh, Float32Array]:
    """Return a mesh with texture coordinates for its base color, and that base color.

    A mesh keeps its texture coordinates if its surface has a texture or anything else
    that depends on them; the base color's transform is applied to them. A shape of one
    color may get new ones, since a texture that is searched needs different coordinates
    at different points. On a cube, for example, all sides have the same.

    Args:
        mesh: mesh of the shape.
        has_uvs: whether the file has texture coordinates.
        surface: surface of the shape.
        kind: Mitsuba's type of the shape.
        where: the scene, for errors.
    """
    if surface.is_textured or surface.is_bound:
        return replace(
            mesh, uvs=_apply_uv_matrix(mesh.uvs, surface.to_uv)
        ), surface.base_color
    # On these shapes several points have the same texture coordinates.
    has_shared_uvs = kind in ("cube", "sphere", "cylinder", "disk")
    keeps_uvs = has_uvs and not has_shared_uvs
    return _paint_evenly(mesh, surface.base_color[0, 0], keeps_uvs, where)


def _apply_uv_matrix(uvs: Float32Array, to_uv: Float64Array) -> Float32Array:
    """Return texture coordinates (V, 2) under a transform (3, 3) of Mitsuba's.

    It is applied to Mitsuba's v, which points down (1 - v).
    """
    mitsuba_uvs = uvs * (1.0, -1.0) + (0.0, 1.0)
    mitsuba_uvs = mitsuba_uvs @ to_uv[:2, :2].T + to_uv[:2, 2]
    moved_uvs: Float32Array = (mitsuba_uvs * (1.0, -1.0) + (0.0, 1.0)).astype(
        np.float32
    )
    return moved_uvs


def _paint_evenly(
    mesh: Mesh, color: Float32Array, keeps_uvs: bool, where: str
) -> tuple[Mesh, Float32Array]:
    """Return a mesh of one color (3,) with a texture of it.

    The functions of mesh import make new texture coordinates, unless the mesh keeps
    its.
    """
    surface_color = ImportedSurface(color=color)
    part = ImportedPart(
        vertices=mesh.vertices.astype(np.float64),
        faces=mesh.faces.astype(np.int64),
        normals=mesh.normals.astype(np.float64),
        uvs=mesh.uvs.astype(np.float64) if keeps_uvs else None,
        surface=surface_color,
    )
    part_soup = join_parts([part], where, np.eye(3))
    soup, maps = apply_textures(part_soup, [surface_color], Notes(where))
    textured_mesh, *_others = make_mesh_from_soup(soup)
    return textured_mesh, maps.color


def _list_plugins(
    tree: Mapping[str, object],
) -> Iterator[tuple[str, Mapping[str, object]]]:
    """Return the plugins at the top of a scene, by name."""
    return (
        (name, entry)
        for name, entry in tree.items()
        if isinstance(entry, Mapping) and "type" in entry
    )


def _rename_references(plugin: Mapping[str, object]) -> Plugin:
    """Return a plugin whose references have the names of `_rename_reserved`."""
    entries = map_inner_plugins(plugin, _rename_references)
    if entries["type"] == "ref" and entries["id"] in RESERVED_NAMES:
        entries["id"] = f"{entries['id']}-2"
    return entries


def _find_surface(
    shape: Mapping[str, object], named: Mapping[str, Mapping[str, object]]
) -> Mapping[str, object]:
    """Return the surface of a shape, with its references replaced by what they refer
    to.

    It is the shape's first inner plugin that is neither a light nor a medium; without
    one, Mitsuba's default.

    Args:
        shape: the shape's dictionary.
        named: the scene's plugins by name.

    Raises:
        UnknownNameError: a reference leads nowhere, or in a circle.
        InputError: the surface has too many plugins.
    """
    references = _SurfaceReferences(named)
    inner_plugins = (entry for entry in shape.values() if isinstance(entry, Mapping))
    for plugin in inner_plugins:
        if plugin["type"] not in LIGHT_TYPES | MEDIUM_TYPES:
            return references.resolve(plugin, 0)
    return {"type": "diffuse"}


class _SurfaceReferences:
    """Replaces the references in one surface by the plugins to which they refer.

    Args:
        named: the scene's plugins by name.
    """

    def __init__(self, named: Mapping[str, Mapping[str, object]]) -> None:
        """Begin with no plugins resolved."""
        self._named = named
        self._n_plugins = 0  # how many have been resolved

    def resolve(self, plugin: Mapping[str, object], depth: int) -> Mapping[str, object]:
        """Return a plugin with the references in it resolved.

        `depth` counts the references on the way from the shape to this plugin.
        """
        self._n_plugins += 1
        if self._n_plugins > MAX_PLUGINS:
            raise InputError(
                f"object: expected a surface of at most {MAX_PLUGINS} "
                "plugins, got more; make it simpler"
            )
        if plugin["type"] == "ref":
            target = self._look_up(str(plugin["id"]), depth)
            return self.resolve(target, depth + 1)
        return map_inner_plugins(plugin, lambda inner: self.resolve(inner, depth))

    def _look_up(self, name: str, depth: int) -> Mapping[str, object]:
        """Return the plugin with a name; `depth` is that of `resolve`."""
        # more references than plugins: they go in a circle
        if name not in self._named or depth > len(self._named):
            raise UnknownNameError("material of the scene", name, list(self._named))
        return self._named[name]


def _find_radiance(shape: Mapping[str, object]) -> Float32Array | None:
    """Return the radiance (1, 1, 3) of a shape that emits evenly; None for any other.

    It emits evenly if its area light has a constant radiance, of at most
    `MAX_RADIANCE`, and no other entries.
    """
    for inner in shape.values():
        if not isinstance(inner, Mapping) or inner["type"] != "area":
            continue
        if not set(inner) <= {"type", "id", "radiance"}:
            continue
        radiance = shapes.parse_constant_color(inner.get("radiance"))
        if radiance is None:
            continue
        if radiance.min() >= 0.0 and 0.0 < radiance.max() <= MAX_RADIANCE:
            return radiance.reshape(1, 1, 3)
    return None


def _describe_missing_attributes(
    surface: Mapping[str, object], mesh: Mesh
) -> Iterator[str]:
    """Yield clauses about attributes that a surface uses and the mesh has not."""
    for plugin in iterate_plugins(surface):
        name = plugin.get("name")
        if plugin["type"] == "mesh_attribute" and name not in mesh.attributes:
            available = ", ".join(sorted(mesh.attributes)) or "none"
            yield (
                f"the mesh has no attribute {format_name(str(name))} (it has "
                f"{available}), so that is black"
            )


def _describe_left_out(
    tree: Mapping[str, object], shape: Mapping[str, object], *, hazy: bool, lit: bool
) -> Iterator[str]:
    """Yield clauses about what is not as it is in the file.

    Args:
        tree: the scene.
        shape: the shape that becomes the object.
        hazy: whether the medium that cameras stand in is rendered, as a haze.
        lit: whether the object keeps the light that it emits.
    """
    for name, plugin in _list_plugins(tree):
        if plugin["type"] in INTEGRATOR_TYPES:
            yield from _describe_integrator(name, plugin)
        elif plugin["type"] in SENSOR_TYPES:
            yield from _describe_sensor(name, plugin, hazy=hazy)
    yield from _describe_left_out_of_object(shape, lit=lit)


def _describe_left_out_of_object(
    shape: Mapping[str, object], *, lit: bool
) -> Iterator[str]:
    """Yield clauses about entries of the object's shape that are left out.

    `lit` is whether the object keeps the light that it emits.
    """
    for key, inner in shape.items():
        if not isinstance(inner, Mapping):
            if key not in shapes.SHAPE_ENTRIES:
                yield (
                    f"the object's {format_name(key)} is left out: a {shape['type']} "
                    "has none"
                )
            continue
        if inner["type"] in LIGHT_TYPES and not lit:
            yield "the object's own light is left out"
        if inner["type"] in MEDIUM_TYPES:
            yield "the medium in the object is left out"


def _describe_integrator(name: str, plugin: Mapping[str, object]) -> Iterator[str]:
    """Yield clauses about settings of an integrator that ours does not have."""
    kind = plugin["type"]
    if kind not in PATH_INTEGRATORS:
        yield (
            f"the integrator {name} is left out: a {kind}; light takes all paths of up "
            f"to {MAX_DEPTH} segments"
        )
        return
    if plugin.get("hide_emitters"):
        yield f"hide_emitters of the integrator {name} is left out: lights are seen"
    depth = plugin.get("max_depth", -1)  # -1, Mitsuba's default, is no limit
    if isinstance(depth, int) and 0 <= depth < MAX_DEPTH:
        yield (
            f"the integrator's max_depth of {depth} is left out: light takes all "
            f"paths of up to {MAX_DEPTH} segments"
        )


def _describe_sensor(
    name: str, plugin: Mapping[str, object], *, hazy: bool
) -> Iterator[str]:
    """Yield clauses about what of a sensor is left out.

    Args:
        name: name of the sensor.
        plugin: its dictionary.
        hazy: whether the medium that it stands in is rendered, as a haze.
    """
    kind = plugin["type"]
    if kind not in CAMERAS:
        yield f"the sensor {name} is left out: a {kind}"
    elif kind == "thinlens":
        yield f"the sensor {name} is sharp at all distances: its lens is left out"
    films = [inner for inner in plugin.values() if isinstance(inner, Mapping)]
    if any(str(key).startswith("crop") for film in films for key in film):
        yield f"the crop of the film of {name} is left out: the whole picture is seen"
    if "medium" in plugin and not hazy:
        yield (f"the sensor {name} sees nothing of its medium up to the first surface")
    if any("principal_point" in key for key in plugin):
        yield (
            f"the sensor {name} looks along its middle: its principal point is left out"
        )


class _ObjectFrame:
    """The object's coordinates: z up, standing on z = 0, with a largest extent of 1.

    Attributes:
        rotation: (3, 3) rotation from the scene's coordinates to z up.
        size: largest extent in the scene's units.
        matrix: (4, 4) from the scene's coordinates to the object's.
    """

    def __init__(self, mesh: Mesh, name: str, *, z_up: bool) -> None:
        """Measure a mesh in the scene's coordinates, which becomes the object.

        Args:
            mesh: the mesh, in the scene's coordinates.
            name: name of the object, for errors.
            z_up: whether the scene's z axis points up; otherwise it is y.

        Raises:
            InputError: the mesh has no extent.
        """
        to_z_up = np.eye(4) if z_up else Y_TO_Z
        vertices = mesh.vertices.astype(np.float64) @ to_z_up[:3, :3].T
        lower = vertices.min(axis=0)
        upper = vertices.max(axis=0)
        self.rotation = to_z_up[:3, :3]
        self.size = float((upper - lower).max())
        if not (math.isfinite(self.size) and self.size > 0.0):
            raise InputError(
                f"object {name}: expected a shape of some size, got one of {self.size}"
            )
        # The last factor is applied first: z up, then centered on the ground, then
        # scaled to the extent 1.
        scaling = np.diag([1.0 / self.size] * 3 + [1.0])
        self.matrix = scaling @ _make_centering(lower, upper) @ to_z_up

    def move_plugin(
        self, plugin: Mapping[str, object], *, at_top: bool = True
    ) -> Plugin:
        """Return a plugin of the scene in the object's coordinates.

        Shapes and lamps are moved and scaled, distant lights are only rotated, and the
        density of media is scaled. All other plugins stay as they are.

        Args:
            plugin: its dictionary.
            at_top: whether it is at the top of the scene; inside another plugin only
                media and volumes change.
        """
        if at_top and plugin["type"] == "merge":
            # It has no pose: each shape in it is moved, as at the top of the scene.
            return map_inner_plugins(plugin, self.move_plugin)
        if at_top:
            entries = self._move_entries(plugin)
        else:
            entries = self._scale_medium(plugin)
        return map_inner_plugins(
            entries, lambda inner: self.move_plugin(inner, at_top=False)
        )

    def _move_entries(self, plugin: Mapping[str, object]) -> Plugin:
        """Return a plugin at the top of the scene, moved without those inside of it."""
        kind = plugin["type"]
        if kind in SHAPE_TYPES - {"shapegroup"}:
            return self._with_pose(plugin)
        if kind in ("constant", "envmap", "sunsky", "timed_sunsky", "directional"):
            return self._move_distant_light(plugin)
        if kind in ("point", "spot", "projector"):
            return self._move_lamp(plugin)
        return self._scale_medium(plugin)

    def _scale_medium(self, plugin: Mapping[str, object]) -> Plugin:
        """Return a plugin in the object's coordinates if it is a medium or a volume.

        Any other plugin stays as it is.
        """
        kind = plugin["type"]
        if kind in MEDIUM_TYPES:
            # density is per length, and the object's unit of length is `size` times as
            # long as the scene's
            scale = float(np.asarray(plugin.get("scale", 1.0)))
            return {**plugin, "scale": scale * self.size}
        if kind in ("gridvolume", "constvolume"):
            return self._with_pose(plugin)
        return dict(plugin)

    def _with_pose(self, plugin: Mapping[str, object]) -> Plugin:
        """Return a plugin whose `to_world` leads to the object's coordinates."""
        return {**plugin, "to_world": self.matrix @ shapes.get_pose(plugin)}

    def _move_distant_light(self, plugin: Mapping[str, object]) -> Plugin:
        """Rotate a light that is infinitely far."""
        entries = dict(plugin)
        if "direction" in entries:
            direction = np.asarray(entries["direction"], dtype=np.float64)
            entries["direction"] = (self.rotation @ direction).tolist()
        elif plugin["type"] != "constant":
            rotation = np.eye(4)
            rotation[:3, :3] = self.rotation
            entries["to_world"] = rotation @ shapes.get_pose(plugin)
        return entries

    def _move_lamp(self, plugin: Mapping[str, object]) -> Plugin:
        """Return a lamp in the object's coordinates, with its power scaled.

        Lengths are divided by the object's size. The intensity of a lamp is an
        irradiance times a squared length, so it is divided by the squared size. The
        irradiance of a projector is that at a distance of 1, which is another distance
        now: it is divided by the squared size, too.
        """
        kind = str(plugin["type"])
        entries = dict(plugin)
        if "position" in entries:
            position = np.asarray(entries["position"], dtype=np.float64)
            # rotates, scales and shifts the position
            moved = self.matrix[:3, :3] @ position + self.matrix[:3, 3]
            entries["position"] = moved.tolist()
        else:  # the lamp has a pose
            entries = self._with_pose(plugin)
        power = "irradiance" if kind == "projector" else "intensity"
        entries[power] = _scale_power(entries.get(power, 1.0), self.size**-2, kind)
        return entries


def _make_centering(lower: Float64Array, upper: Float64Array) -> Float64Array:
    """Return the translation (4, 4) that centers a box on the ground, z = 0.

    The box goes from one corner (3,) to the other.
    """
    translation = np.eye(4)
    translation[:3, 3] = (
        -(lower[0] + upper[0]) / 2,
        -(lower[1] + upper[1]) / 2,
        -lower[2],
    )
    return translation


def _scale_power(value: object, factor: float, kind: str) -> object:
    """Multiply a light's power in any form that Mitsuba takes.

    Args:
        value: the power: a number, or the dictionary of a spectrum or a bitmap.
        factor: the factor.
        kind: type of the light, for errors.

    Raises:
        InputError: the power is of another form.
    """
    if isinstance(value, (int, float)):
        return float(value) * factor
    if isinstance(value, Mapping):
        scaled = _scale_spectrum(value, factor)
        if scaled is not None:
            return scaled
    raise InputError(
        f"{kind} light: expected a power as a number, rgb or spectrum; "
        "change it in the scene"
    )


def _scale_spectrum(value: Mapping[str, object], factor: float) -> Plugin | None:
    """Multiply a spectrum's or a bitmap's values; None if it is of another kind.

    The value may be one number, three numbers, or pairs of wavelength and amount.
    Lights with a fixed spectrum (d65, blackbody) have an entry `scale`, which is
    multiplied instead.

    Args:
        value: the dictionary of the spectrum or the bitmap.
        factor: the factor.
    """
    kind = value["type"]
    inner = value.get("value")
    bitmap = value.get("bitmap")
    is_constant = kind in ("rgb", "uniform", "srgb", "spectrum")
    if is_constant and isinstance(inner, (int, float)):
        return {**value, "value": float(inner) * factor}
    if kind == "rgb" and inner is not None:
        values = np.asarray(inner, dtype=np.float64) * factor
        return {**value, "value": values.tolist()}
    if kind == "spectrum" and isinstance(inner, (list, tuple)):
        pairs = [(wavelength, amount * factor) for wavelength, amount in inner]
        return {**value, "value": pairs}
    if kind in ("d65", "blackbody"):
        scale = float(np.asarray(value.get("scale", 1.0)))
        return {**value, "scale": scale * factor}
    if kind == "bitmap" and isinstance(bitmap, np.ndarray):
        return {**value, "bitmap": np.asarray(bitmap) * np.float32(factor)}
    return None


def _read_film_size(film: Mapping[str, object]) -> tuple[float, float]:
    """Return the width and height of a film in pixels, by default Mitsuba's.

    Raises InputError if it has less than one pixel.
    """
    width = float(np.asarray(film.get("width", 768)))
    height = float(np.asarray(film.get("height", 576)))
    if not min(width, height) >= 1.0:
        raise InputError(
            f"camera: expected a film of at least 1 x 1 pixels, got {width:g} x "
            f"{height:g}"
        )
    return width, height


def _import_camera(sensor: Mapping[str, object], frame: _ObjectFrame) -> PosedCamera:
    """Return a sensor's pose and field of view along the larger side.

    Args:
        sensor: the sensor's dictionary.
        frame: the object's coordinates.
    """
    matrix = frame.matrix @ shapes.get_pose(sensor)
    # Columns of length 1: a camera has no scale.
    matrix[:3, :3] /= np.maximum(np.linalg.norm(matrix[:3, :3], axis=0), 1e-12)
    entries = [entry for entry in sensor.values() if isinstance(entry, Mapping)]
    # types of films are "hdrfilm" and "specfilm"
    film = next((plugin for plugin in entries if "film" in str(plugin["type"])), {})
    width, height = _read_film_size(film)
    fov = _compute_larger_fov(sensor, width, height)
    return PosedCamera(matrix, fov)


def _compute_larger_fov(
    sensor: Mapping[str, object], width: float, height: float
) -> float:
    """Return a sensor's field of view along the larger side of its film, in degrees.

    The sensor's own field of view is along the axis that it states; that of a focal
    length is along the film's diagonal. The tangent of half the field of view is
    proportional to the film's length along the axis, by which it is converted.
    """
    axis = str(sensor.get("fov_axis", "x"))
    fov = float(np.asarray(sensor.get("fov", 0.0)))
    has_no_fov = fov == 0.0
    if has_no_fov:  # the sensor states a focal length, or nothing
        axis = "diagonal"
        fov = _compute_diagonal_fov(str(sensor.get("focal_length", "50mm")))
    axis_length = _measure_film_axis(axis, width, height)
    half_tangent = math.tan(math.radians(fov) / 2.0) * max(width, height) / axis_length
    return 2.0 * math.degrees(math.atan(half_tangent))


def _measure_film_axis(axis: str, width: float, height: float) -> float:
    """Return the length of a film along an axis by Mitsuba's name of it."""
    length_of_axis = {
        "x": width,
        "y": height,
        "diagonal": math.hypot(width, height),
        "larger": max(width, height),
        "smaller": min(width, height),
    }
    return length_of_axis.get(axis, width)  # an unknown axis counts as x


def _compute_diagonal_fov(text: str) -> float:
    """Return the diagonal field of view in degrees of a focal length such as "50mm"."""
    length = 0.0
    with contextlib.suppress(ValueError):
        length = float(text.removesuffix("mm"))
    if not length > 0.0:
        raise InputError(
            f"focal_length: expected millimetres, such as 50mm, got {text!r}"
        )
    return 2.0 * math.degrees(math.atan(FILM_DIAGONAL / (2.0 * length)))
