"""Things next to the object, at requested positions on the ground.

    car@12,3.5,heading=180; person@6,-2; bike.glb@3,1,size=1.8,label=bicycle

Positions are in meters from the position of the object without a shift: x forwards, in
the direction that the object faces, and y to its left. A heading is in degrees
counterclockwise, seen from above; at 0 a thing faces in the same direction as the
object.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np

from advsearch.errors import InputError, UnknownNameError
from advsearch.scene.assets import (
    MAX_METRES,
    MIN_METRES,
    Float64Array,
    ObjectAsset,
    describe_size_doubts,
    find_footing,
    make_pose,
    with_size,
)
from advsearch.scene.geometry import (
    compute_base_vertices,
    compute_center,
    compute_footprint,
    is_overlapping,
    make_rotation,
)
from advsearch.scene.grounds import has_lanes
from advsearch.scene.importing.files import make_safe_name
from advsearch.scene.parts import Footprint, MeshPart, make_mesh_part
from advsearch.scene.scene_data import AnyScene, SceneData
from advsearch.scene.settings import LAMPS, LAMPS_OFF

MAX_DISTANCE = 1000.0  # how far from the object a thing may stand, metres
MAX_HEADING = 3600.0  # limit of a heading, degrees
MAX_THINGS = 64  # things beside an object
EYE_SIZE = 1e-3  # half the width of the box that represents a camera, object sizes
OPTIONS = ("heading", "size", "name", "label", "lamps", "facing")
GROUND_NAMES = ("road", "floor")  # names of the ground of bundled places
ALL_THINGS = "all"  # name that means the object and all things next to it
# what a thing can't be called
RESERVED_NAMES = (
    "object",
    "environment",
    "ground",
    "camera",
    *GROUND_NAMES,
    ALL_THINGS,
)


@dataclass(frozen=True)
class RequestedThing:
    """A thing as it is asked for."""

    object_spec: str  # a bundled object, or a mesh file
    x: float  # metres
    y: float
    heading: float = 0.0  # degrees
    size: float | None = None  # its longest side in metres; None for its own
    name: str = ""  # what it is called in the scene
    # what a model should call it; None for what the object of that name is called
    label: str | None = None
    lamps: str = LAMPS_OFF  # one of `settings.LAMPS`, of a car
    # the axis of its file that is its front; None for what its format says
    facing: str | None = None


@dataclass(frozen=True, eq=False)
class ThingPart(MeshPart):
    """A thing next to the object."""

    size_in_metres: float = 1.0  # its longest side
    lamps: str = LAMPS_OFF  # which it has on


def parse_things(things_spec: str | None) -> tuple[RequestedThing, ...]:
    """Parse the setting that names things next to the object.

    Things are separated by semicolons, as in "car@12,3.5,heading=180; person@4,-2". If
    the name of a thing is taken, a number is added to it ("car-2"), unless the user has
    chosen it with `name=`.

    Args:
        things_spec: the setting; None or empty for no things.

    Raises:
        InputError: a thing is not written so, a chosen name is taken, or there are more
            than `MAX_THINGS`.
    """
    things: list[RequestedThing] = []
    for part in filter(None, map(str.strip, (things_spec or "").split(";"))):
        used_names = [*RESERVED_NAMES, *(other.name for other in things)]
        things.append(_parse_unique_thing(part, used_names))
    if len(things) > MAX_THINGS:
        raise InputError(f"things: expected at most {MAX_THINGS}, got {len(things)}")
    return tuple(things)


def _parse_unique_thing(part: str, used_names: Sequence[str]) -> RequestedThing:
    """Parse one thing, with a number added to its name if that is used.

    Raises:
        InputError: the thing is not written as `_parse_thing` expects, or the user has
            chosen a name that is used.
    """
    thing = _parse_thing(part)
    has_chosen_name = "name=" in part
    if thing.name in used_names and has_chosen_name:
        raise InputError(
            f"things: {part}: another thing of the scene is called "
            f"{thing.name}; choose another name"
        )
    return replace(thing, name=_find_unused_name(thing.name, used_names))


def _find_unused_name(name: str, used_names: Sequence[str]) -> str:
    """Return a name, with a number if it is used: car, car-2, car-3.

    Each number replaces the one before. So a name that ends in "-1", as that of the
    file "car-1.glb", is followed by "car-2".
    """
    number = 2
    while name in used_names:
        plain_name = name.removesuffix(f"-{number - 1}")
        name = f"{plain_name}-{number}"
        number += 1
    return name


def _parse_thing(part: str) -> RequestedThing:
    """Parse one thing, such as "car@12,3.5,heading=180".

    Before the @ is the name or file of its object; behind it are x and y in metres, and
    options: heading, size, name, label, lamps and facing. Without `name=` the thing is
    named after its object.

    Raises InputError, UnknownNameError: it is not written so, or a number or an option
    is not valid.
    """
    object_spec, words = _split_thing(part)
    options = _parse_options(part, words[2:])
    x = _parse_number(part, "x", words[0], -MAX_DISTANCE, MAX_DISTANCE)
    y = _parse_number(part, "y", words[1], -MAX_DISTANCE, MAX_DISTANCE)
    heading_text = options.get("heading", "0.0")
    heading = _parse_number(part, "heading", heading_text, -MAX_HEADING, MAX_HEADING)
    # Without `name=` the file's name counts, without what is behind a #, which names a
    # part of the file, as in scene.glb#chair.
    name = make_safe_name(Path(options.get("name") or object_spec.partition("#")[0]))
    return RequestedThing(
        object_spec=object_spec,
        x=x,
        y=y,
        heading=heading,
        size=_parse_size(part, options),
        name=name,
        label=options.get("label"),
        lamps=options.get("lamps", LAMPS_OFF),
        facing=options.get("facing"),
    )


def _parse_size(part: str, options: Mapping[str, str]) -> float | None:
    """Return the size of a thing in metres; None if its options have none."""
    if "size" not in options:
        return None
    return _parse_number(part, "size", options["size"], MIN_METRES, MAX_METRES)


def _split_thing(part: str) -> tuple[str, list[str]]:
    """Split a thing into its object, and the words X, Y and options behind the @.

    Raises InputError: it is not written so.
    """
    object_spec, separator, rest = part.rpartition("@")
    object_spec = object_spec.strip()
    # X, Y, and then options such as heading=180
    words = [word.strip() for word in rest.split(",")]
    has_position = bool(separator) and len(words) >= 2
    has_options = all("=" in word for word in words[2:])
    if not (object_spec and has_position and has_options):
        raise InputError(
            "things: expected WHAT@X,Y in metres, such as car@12,3.5,heading=180, got "
            f"{part!r}"
        )
    return object_spec, words


def _parse_options(part: str, words: Iterable[str]) -> dict[str, str]:
    """Return the options of a thing, words such as heading=180, by name.

    The value of `lamps` is checked here; the caller converts and checks the numbers. If
    an option is repeated, the last one counts.

    Args:
        part: text of the thing, for messages.
        words: its options, such as "heading=180".

    Raises UnknownNameError: there is no such option, or no such value for its lamps.
    """
    options: dict[str, str] = {}
    for word in words:
        name, _, value = word.partition("=")
        options[name] = value
    for name in options:
        if name not in OPTIONS:
            raise UnknownNameError(f"option of things {part!r}:", name, OPTIONS)
    lamps = options.get("lamps", LAMPS_OFF)
    if lamps not in LAMPS:
        raise UnknownNameError(f"lamps of things {part!r}:", lamps, LAMPS)
    return options


def _parse_number(part: str, name: str, text: str, low: float, high: float) -> float:
    """Read one number of a thing. Raises InputError: it is none, or out of range."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not low <= value <= high:
        raise InputError(
            f"things: {part}: {name}: expected a number from {low:g} to "
            f"{high:g}, got {text!r}"
        )
    return value


def add_things(
    scene: AnyScene,
    things_spec: str | None,
    load: Callable[[str, str | None], ObjectAsset],
) -> AnyScene:
    """Return the scene with the things next to its object that a setting names.

    Args:
        scene: scene with the object.
        things_spec: the setting, such as "car@12,3.5,heading=180"; None for no things.
        load: loads an object. Its arguments are a name or a file, and the axis of the
            file that is the object's front; None for the usual one of its format.

    Raises:
        InputError: the text is invalid, a name is taken, or sizes in metres are not
            known.
        UnknownNameError: there is no such object.
    """
    requested = parse_things(things_spec)
    if not requested:
        return scene
    _check_object_size(scene)
    things = [_make_thing(scene, thing, load) for thing in requested]
    parts = [part for part, _ in things]
    remarks = [remark for _, thing_remarks in things for remark in thing_remarks]
    # `things_spec` is a string here: None has no requested things.
    scene = replace(scene, parts=(*scene.parts, *parts), things_spec=things_spec or "")
    # Overlaps are found in the scene with the things.
    remarks += _list_overlap_remarks(scene)
    return replace(scene, remarks=(*scene.remarks, *remarks))


def _check_object_size(scene: SceneData) -> None:
    """Check that the size of the object is known, as positions are in metres from it.

    Raises:
        InputError: it is not known.
    """
    if scene.object.size_in_metres is None:
        raise InputError(
            f"things: their positions are in metres from {scene.object_name}, whose "
            "size is not known; give its longest side in metres, such as `size=0.1`"
        )


def _make_thing(
    scene: SceneData,
    thing: RequestedThing,
    load: Callable[[str, str | None], ObjectAsset],
) -> tuple[ThingPart, list[str]]:
    """Return a thing that stands in a scene, and remarks on it.

    Args:
        scene: the scene.
        thing: what the user has requested.
        load: loads an object by its name or file, and the axis that is its front.

    Raises:
        InputError: its size in metres is not known, or its name is taken.
    """
    asset, metres = _load_sized_asset(thing, load)
    name = thing.name
    if name in {part.name for part in scene.parts}:
        raise InputError(
            f"things: something of the scene is called {name} already; add name=NAME "
            "to it"
        )
    pose = _compute_pose(scene, asset, thing, metres)
    part = make_mesh_part(name, asset, pose, asset.material)
    # all fields of the mesh's part, with the label of the thing if it has one
    fields = {**vars(part), "label": thing.label or asset.label}
    thing_part = ThingPart(**fields, size_in_metres=metres, lamps=thing.lamps)
    return thing_part, _list_thing_remarks(scene, thing, asset)


def _load_sized_asset(
    thing: RequestedThing, load: Callable[[str, str | None], ObjectAsset]
) -> tuple[ObjectAsset, float]:
    """Load the object of a thing, and return it with its longest side in metres.

    Args:
        thing: what the user has requested.
        load: loads an object by its name or file, and the axis that is its front.

    Raises:
        InputError: its size in metres is not known.
    """
    object_spec = thing.object_spec
    asset = with_size(load(object_spec, thing.facing), thing.size, unit=None)
    if asset.size_in_metres is None:
        example = f"{object_spec}@{thing.x:g},{thing.y:g},size=METRES"
        raise InputError(
            f"things: the size of {object_spec} in metres is not known; say it: "
            f"{example}"
        )
    return asset, asset.size_in_metres


def _list_thing_remarks(
    scene: SceneData, thing: RequestedThing, asset: ObjectAsset
) -> list[str]:
    """Return notes on a thing's file, and doubts about its size and its front.

    That its front was guessed matters if the ground has lanes.

    Args:
        scene: the scene.
        thing: what the user has requested.
        asset: the thing's object.
    """
    remarks = [
        *asset.notes,
        *describe_size_doubts(
            asset, has_user_size=thing.size is not None, needs_metres=True
        ),
    ]
    if asset.front is not None and asset.front.reason and has_lanes(scene):
        remarks.append(asset.front.reason)
    return remarks


def _list_overlap_remarks(scene: SceneData) -> list[str]:
    """Return a remark on each pair of the object and the things that overlaps.

    Two of them overlap if their convex outlines, seen from above, do and they have some
    height in common.
    """
    footprints = {"the object": compute_footprint(scene.base_vertices)} | {
        name: compute_footprint(compute_base_vertices(part))
        for name, part in scene.meshes.items()
        if isinstance(part, ThingPart)
    }
    return [
        f"{name[0].upper()}{name[1:]} and {other_name} stand in each other: their "
        "outlines on the ground overlap."
        for name, other_name in combinations(footprints, 2)
        if is_overlapping(footprints[name], footprints[other_name])
    ]


def _compute_pose(
    scene: SceneData,
    asset: ObjectAsset,
    requested: RequestedThing,
    metres: float,
) -> Float64Array:
    """Return the pose (4, 4) of a thing on the ground where it is requested.

    Args:
        scene: scene with the object, whose size is the unit of lengths.
        asset: the thing's object.
        requested: position in metres from the object, and heading in degrees.
        metres: longest side of the thing in metres.
    """
    # the point of the mesh that is put on the ground, and its longest side
    foot_point, extent = find_footing(asset.mesh.vertices.astype(np.float64))
    scale = metres / scene.size_in_metres / extent
    scaled_rotation = scale * make_rotation(requested.heading, 0.0, 0.0)
    offset = np.array([requested.x, requested.y]) / scene.size_in_metres
    position = compute_center(scene)[:2] + offset
    stand_point = np.array([*position, find_ground_height(scene, position)])
    return make_pose(scaled_rotation, stand_point - scaled_rotation @ foot_point)


def find_ground_height(scene: SceneData, position: Float64Array) -> float:
    """Return the height of the ground at a position (2,), in object sizes.

    The ground is the highest of the meshes on which things stand: a road, a pavement, a
    table or a floor. The height is 0 if there is none.
    """
    ground = (part for part in scene.surrounding_meshes.values() if part.is_ground)
    triangles = (
        compute_base_vertices(part)[part.mesh.faces.astype(np.int64)] for part in ground
    )
    return max(
        (
            height
            for corners in triangles
            for height in find_triangle_heights(corners, position)
        ),
        default=0.0,
    )


def find_triangle_heights(corners: Float64Array, position: Float64Array) -> list[float]:
    """Return the heights at which a vertical line meets triangles.

    A triangle counts if the line's point is inside it or on its border, seen from
    above. A vertical triangle does not count.

    Args:
        corners: (F, 3, 3) corners of the triangles.
        position: (2,) x and y of the line.
    """
    a, b, c = np.moveaxis(corners, 1, 0)
    # The point makes a triangle with each side; the areas, signed and seen from above.
    # Divided by their sum they are the weights of the opposite corners a, b and c.
    doubled_areas = [
        (end[:, 0] - start[:, 0]) * (position[1] - start[:, 1])
        - (end[:, 1] - start[:, 1]) * (position[0] - start[:, 0])
        for start, end in ((b, c), (c, a), (a, b))
    ]
    total_area = doubled_areas[0] + doubled_areas[1] + doubled_areas[2]
    # NaN, for which comparisons are false, for a triangle that stands upright
    divisor = np.where(np.abs(total_area) > 1e-12, total_area, np.nan)
    barycentric = np.stack(doubled_areas) / divisor
    contains_point = (barycentric >= 0.0).all(axis=0)
    plane_heights = (barycentric * [a[:, 2], b[:, 2], c[:, 2]]).sum(axis=0)
    heights: list[float] = plane_heights[contains_point].tolist()
    return heights


def find_overlapping_solid(scene: SceneData, footprint: Footprint) -> str | None:
    """Return the solid of the scene that a footprint overlaps, such as "a house".

    None where it stands free.
    """
    for part in scene.surrounding_meshes.values():
        for solid in part.solids:
            if is_overlapping(solid.footprint, footprint):
                return solid.name
    return None


def add_solid_remarks(scene: AnyScene) -> AnyScene:
    """Return the scene with a remark if its object or a thing is inside a solid.

    Solids are parts of the place, such as houses, in which nothing can stand. If the
    place has none, the scene is returned as it is.
    """
    if not any(part.solids for part in scene.surrounding_meshes.values()):
        return scene
    footprints = {"the object": compute_footprint(scene.base_vertices)}
    footprints |= {
        part.name: compute_footprint(compute_base_vertices(scene.meshes[part.name]))
        for part in scene.parts
        if isinstance(part, ThingPart)
    }
    remarks = _list_solid_remarks(scene, footprints)
    return replace(scene, remarks=(*scene.remarks, *remarks))


def _list_solid_remarks(
    scene: SceneData, footprints: Mapping[str, Footprint]
) -> list[str]:
    """Return a remark on each footprint that overlaps a solid of the place, by name."""
    remarks = list[str]()
    for name, outline in footprints.items():
        solid = find_overlapping_solid(scene, outline)
        if solid is not None:
            remarks.append(
                f"{name[0].upper()}{name[1:]} stands in {solid} of the "
                "place around it: put it elsewhere."
            )
    return remarks


def list_camera_remarks(
    scene: SceneData, eyes: Sequence[Float64Array]
) -> tuple[str, ...]:
    """Return a remark if cameras are inside a solid of the place, such as a house.

    The result is empty if none is.

    Args:
        scene: the scene.
        eyes: positions (3,) of the cameras in metres, at least one.
    """
    solids_of_eyes = [_find_solid_at(scene, eye) for eye in eyes]
    solid_names = [solid for solid in solids_of_eyes if solid is not None]
    if not solid_names:
        return ()
    return (_describe_hidden_views(solid_names, len(eyes)),)


def _describe_hidden_views(solid_names: Sequence[str], n_views: int) -> str:
    """Describe in which of the views the camera is inside a solid of the place.

    Args:
        solid_names: the solid of each such view.
        n_views: number of all views.
    """
    if n_views == 1:
        return (
            f"The camera is inside {solid_names[0]} of the place: it sees no object "
            "from there; move it."
        )
    solids = " or ".join(dict.fromkeys(solid_names))
    percentage = 100.0 * len(solid_names) / n_views
    return (
        f"The camera is inside {solids} of the place in {percentage:.0f} % of the "
        "views: it sees no object from there; narrow where it goes."
    )


def _find_solid_at(scene: SceneData, eye: Float64Array) -> str | None:
    """Return the solid of the place that a camera is inside; None if it is free.

    Args:
        scene: the scene.
        eye: position (3,) of the camera in metres.
    """
    # Overlap is defined for footprints. So the camera is a tiny square, whose
    # corners are on the axes. Lengths of the scene are in object sizes.
    x, y, z = eye / scene.size_in_metres
    corners = np.array(
        [(x - EYE_SIZE, y), (x, y - EYE_SIZE), (x + EYE_SIZE, y), (x, y + EYE_SIZE)]
    )
    return find_overlapping_solid(scene, Footprint(corners, z - EYE_SIZE, z + EYE_SIZE))
