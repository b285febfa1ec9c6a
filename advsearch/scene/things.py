"""Things beside the object, which stand on the ground with it where they were asked for.

    car@12,3.5,heading=180; person@6,-2; bike.glb@3,1,size=1.8,label=bicycle

Places are in metres from where the object stands by itself: x forwards, the way that the object faces, and y to its
left. A heading is in degrees counter-clockwise, seen from above; at 0 a thing faces where the object does.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.spatial import ConvexHull

from advsearch.errors import InputError, UnknownNameError
from advsearch.scene.assets import Doubles, ObjectAsset
from advsearch.scene.geometry import middle, rotation, standing
from advsearch.scene.importing.files import safe_name
from advsearch.scene.parts import MeshPart, mesh_part
from advsearch.scene.places.road import LAID
from advsearch.scene.settings import LAMPS
from advsearch.scene.sizes import LARGEST, SMALLEST, doubts, sized

if TYPE_CHECKING:
    from advsearch.scene.description import SceneDescription

FARTHEST = 1000.0
"""How far from the object a thing may stand, metres."""
MOST = 64
"""Things beside an object."""
OPTIONS = ("heading", "size", "name", "label", "lamps")
ALL = "all"
"""What stands for the object and every thing beside it."""
TAKEN = ("object", "environment", "ground", "camera", *LAID, ALL)
"""What a thing can't be called."""


@dataclass(frozen=True)
class AskedThing:
    """A thing as it is asked for.

    Attributes:
        what: a bundled object, or a mesh file.
        x, y: where it stands, metres.
        heading: degrees.
        size: its longest side in metres; None for its own.
        name: what it is called in the scene.
        label: what a model should call it; None for what the object of that name is called.
        lamps: one of `settings.LAMPS`, of a car.
    """

    what: str
    x: float
    y: float
    heading: float = 0.0
    size: float | None = None
    name: str = ""
    label: str | None = None
    lamps: str = LAMPS[0]


@dataclass(frozen=True, eq=False)
class ThingPart(MeshPart):
    """A thing beside the object.

    Attributes:
        metres: its longest side.
        lamps: which it has on.
    """

    metres: float = 1.0
    lamps: str = LAMPS[0]


def asked_things(text: str | None) -> tuple[AskedThing, ...]:
    """Read things that are asked for in one text, see above.

    Raises:
        InputError: it says something else.
    """
    found: list[AskedThing] = []
    for part in filter(None, map(str.strip, (text or "").split(";"))):
        one = _asked(part)
        taken = [*TAKEN, *(other.name for other in found)]
        if one.name in taken and "name=" in part:
            raise InputError(f"things: {part}: another thing of the scene is called {one.name}; choose another name")
        number = 2
        while one.name in taken:
            one = replace(one, name=f"{one.name.removesuffix(f'-{number - 1}')}-{number}")
            number += 1
        found.append(one)
    if len(found) > MOST:
        raise InputError(f"things: expected at most {MOST}, got {len(found)}")
    return tuple(found)


def _asked(part: str) -> AskedThing:
    what, at, rest = part.rpartition("@")
    words = [one.strip() for one in rest.split(",")]
    options = dict(one.partition("=")[::2] for one in words[2:])
    if not at or not what.strip() or len(words) < 2 or any("=" not in one for one in words[2:]):
        raise InputError(f"things: expected WHAT@X,Y in metres, such as car@12,3.5,heading=180, got {part!r}")
    for name in options:
        if name not in OPTIONS:
            raise UnknownNameError(f"option of things {part!r}:", name, OPTIONS)
    lamps = options.get("lamps", LAMPS[0])
    if lamps not in LAMPS:
        raise UnknownNameError(f"lamps of things {part!r}:", lamps, LAMPS)
    x, y = (_number(part, name, one, -FARTHEST, FARTHEST) for name, one in zip("xy", words, strict=False))
    heading = _number(part, "heading", options["heading"], -3600.0, 3600.0) if "heading" in options else 0.0
    size = _number(part, "size", options["size"], SMALLEST, LARGEST) if "size" in options else None
    name = safe_name(Path(options.get("name") or what.strip().partition("#")[0]))
    return AskedThing(what.strip(), x, y, heading, size, name, options.get("label"), lamps)


def _number(part: str, name: str, text: str, low: float, high: float) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not low <= value <= high:
        raise InputError(f"things: {part}: {name}: expected a number from {low:g} to {high:g}, got {text!r}")
    return value


def with_things(scene: SceneDescription, text: str | None, load: Callable[[str], ObjectAsset]) -> SceneDescription:
    """Return the scene with things beside its object; what stands in another one is said in its remarks.

    Args:
        scene: with its object.
        text: what is asked for.
        load: from the name or the file of an object to the object.

    Raises:
        UnknownNameError: there is no such object.
        InputError: the text says something else, a name is taken, or sizes in metres are not known.
    """
    asked = asked_things(text)
    if not asked:
        return scene
    if scene.object.metres is None:
        raise InputError(
            f"things: they stand in metres beside {scene.object_name}, whose size in metres is not known; say it: its "
            "longest side, such as `size=0.1`"
        )
    parts, remarks = list[ThingPart](), list[str]()
    for one in asked:
        asset = sized(load(one.what), one.size, None)
        if asset.metres is None:
            raise InputError(
                f"things: the size of {one.what} in metres is not known; say it: "
                f"{one.what}@{one.x:g},{one.y:g},size=METRES"
            )
        if one.name in {part.name for part in scene.parts}:
            raise InputError(f"things: something of the scene is called {one.name} already; add name=NAME to it")
        part = mesh_part(one.name, asset, _pose(scene, asset, one, asset.metres), asset.material)
        parts.append(
            ThingPart(**{**vars(part), "label": one.label or asset.label}, metres=asset.metres, lamps=one.lamps)
        )
        remarks += [*asset.notes, *doubts(asset, asked=one.size is not None, laid=True)]
    scene = replace(scene, parts=(*scene.parts, *parts), things_spec=text or "")
    return replace(scene, remarks=(*scene.remarks, *remarks, *_meeting(scene)))


def _pose(scene: SceneDescription, asset: ObjectAsset, asked: AskedThing, metres: float) -> Doubles:
    vertices = asset.mesh.vertices.astype(np.float64)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    linear = metres / scene.metres / float((high - low).max()) * rotation(asked.heading, 0.0, 0.0)
    foot = np.array([*(low[:2] + high[:2]) / 2.0, low[2]])
    matrix = np.eye(4)
    matrix[:3, :3] = linear
    place = middle(scene)[:2] + np.array([asked.x, asked.y]) / scene.metres
    matrix[:3, 3] = np.array([*place, ground_height(scene, place)]) - linear @ foot
    return matrix


def ground_height(scene: SceneDescription, place: Doubles) -> float:
    """Return how high the ground lies at a place (2,), object sizes: that of the road, with its pavements, of a room's
    table or floor, or 0."""
    heights = list[float]()
    for part in (one for name, one in scene.around.items() if name in LAID):
        heights += heights_over(standing(part)[part.mesh.faces.astype(np.int64)], place)
    return max(heights, default=0.0)


def heights_over(corners: Doubles, place: Doubles) -> list[float]:
    """Return how high the triangles (F, 3 corners, 3) lie that are above or below a place (2,)."""
    a, b, c = np.moveaxis(corners, 1, 0)
    sides = [
        (end[:, 0] - begin[:, 0]) * (place[1] - begin[:, 1]) - (end[:, 1] - begin[:, 1]) * (place[0] - begin[:, 0])
        for begin, end in ((b, c), (c, a), (a, b))
    ]
    whole = sides[0] + sides[1] + sides[2]
    shares = np.stack(sides) / np.where(np.abs(whole) > 1e-12, whole, np.nan)
    under = (shares >= 0.0).all(axis=0)
    heights: list[float] = (shares * [a[:, 2], b[:, 2], c[:, 2]]).sum(axis=0)[under].tolist()
    return heights


def _meeting(scene: SceneDescription) -> list[str]:
    """Sentences about things that stand in each other: convex outlines on the ground that overlap."""
    places = {"the object": footprint(scene.base_vertices)} | {
        name: footprint(standing(part)) for name, part in scene.meshes.items() if isinstance(part, ThingPart)
    }
    return [
        f"{one[0].upper()}{one[1:]} and {other} stand in each other: their outlines on the ground overlap."
        for one, other in combinations(places, 2)
        if overlapping(places[one], places[other])
    ]


class Footprint(NamedTuple):
    """What something takes up: its convex outline on the ground, corners (K, 2), and between which heights."""

    outline: Doubles
    low: float
    high: float


def footprint(points: Doubles) -> Footprint:
    """Return what a cloud of points (N, 3) takes up."""
    corners = ConvexHull(points[:, :2], qhull_options="QJ").vertices
    return Footprint(points[corners, :2], float(points[:, 2].min()), float(points[:, 2].max()))


def overlapping(one: Footprint, other: Footprint) -> bool:
    """Return whether two outlines overlap, at heights that both have."""
    begin, end = blocked(one, other, np.array([1.0, 0.0]))
    return begin < 0.0 < end


def blocked(one: Footprint, other: Footprint, way: Doubles) -> tuple[float, float]:
    """Return from where to where one thing overlaps with another as it is shifted along a way (2,), in lengths of that;
    (inf, -inf) where it never does. By separating axes (Ericson 2005, Real-Time Collision Detection, section 5.2.1),
    each of which says so of a stretch."""
    if min(one.high, other.high) <= max(one.low, other.low):
        return math.inf, -math.inf
    edges = np.concatenate([np.roll(points, -1, axis=0) - points for points in (one.outline, other.outline)])
    across = np.stack([edges[:, 1], -edges[:, 0]], axis=1)[edges.any(axis=1)]
    first, second, speed = one.outline @ across.T, other.outline @ across.T, across @ way
    reach = np.stack([second.min(axis=0) - first.max(axis=0), second.max(axis=0) - first.min(axis=0)])
    still = speed == 0.0
    if (still & ((reach[0] >= 0.0) | (reach[1] <= 0.0))).any():
        return math.inf, -math.inf
    stretches = np.sort(reach[:, ~still] / speed[~still], axis=0)
    begin, end = float(stretches[0].max()), float(stretches[1].min())
    return (begin, end) if begin < end else (math.inf, -math.inf)
