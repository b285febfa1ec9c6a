"""Headlamps and tail lamps of cars: the object's own, those of cars beside it, and
those of the car behind the camera.

A headlamp is a point that shines by a table of luminous intensity over angles, and
glass that glows. Of one lamp, at h degrees aside and v above the horizon, with d =
-0.57 - v, the angle below the cut-off:

    low:  (14,500 exp(-(h/5)^2/2) exp(-d/1.5) + 4,000 exp(-(h/16)^2/2) exp(-d/5)) / (1 + exp(-d/0.08))      candela
    high: low + 45,000 exp(-(h/3.5)^2/2 - (v/1.5)^2/2)

The cut-off is level, 1 % below the horizon; a real one rises on the side of the kerb.
These numbers fulfil what a lamp of class B has to (UN Regulation 112, section 6.2 and
6.3): at 0.86 degrees down at least 5,100 cd ahead and 10,100 at
1.72 aside, at 1.72 down at least 1,700 at 9 aside, above the horizon at most 350 to 625, of the high beam 40,500. The
glass of a headlamp shines 250 cd ahead, which is what is left above the cut-off, and
that of a tail lamp 10 cd in red (UN Regulation 7: from 4).
`tests/scene/test_headlamps.py` holds them to these.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from advsearch.errors import InputError
from advsearch.scene.assets import (
    Doubles,
    Floats,
    Ints,
    Material,
    Mesh,
    face_vectors,
    pose_of,
)
from advsearch.scene.grounds import LUMINANCE
from advsearch.scene.parts import CAMERA, BeamLamp, LampGlass, MeshPart, ScenePart
from advsearch.scene.settings import LAMPS
from advsearch.scene.things import ThingPart, heights_over

if TYPE_CHECKING:
    from advsearch.scene.description import SceneDescription

# degrees above the horizon at which the low beam has half of what it has below
CUT_OFF = -0.57
# tangent of the table's angle to either side, and its size; texels are square
SIDES = 1.0
ROWS = 512
COLUMNS = 896
# candela ahead of the glass of one headlamp, and behind that of one tail lamp
GLASS = 250.0
REAR = 10.0
WHITE, RED = (
    color / (color @ np.array(LUMINANCE))
    for color in np.array([[1.0, 0.95, 0.86], [1.0, 0.0, 0.0]])
)
"""Linear colours with a luminance of 1."""
NAMED = {
    "headlamps": re.compile(r"head[ _-]?(light|lamp)", re.IGNORECASE),
    "taillamps": re.compile(r"(tail|rear)[ _-]?(light|lamp)", re.IGNORECASE),
}
"""What the materials of lamps are called in a file."""
HEIGHTS = {"headlamps": (0.65, 0.45), "taillamps": (0.85, 0.6)}
ASIDE = 0.36
RADIUS = 0.07
"""Where a car has lamps whose file names none: metres above its foot, or that share of
its height where it is lower; to either side, as a share of its width; and how large
they are, metres.
"""
SPOKES = 12
EGO = (1.7, 0.62, 0.65)
"""Where the headlamps of the camera's own car are: metres before the camera, to either
side, above the ground.
"""
CLEAR = Material(roughness=0.06, specular=0.6)
OUT = 0.004  # how far glass stands out from what it lies on, metres


def candela(kind: str, h: Doubles, v: Doubles) -> Doubles:
    """Return the luminous intensity of one headlamp, "low" or "high", at degrees aside
    and up; see above.
    """
    below = CUT_OFF - v
    spot = 14500.0 * np.exp(-((h / 5.0) ** 2) / 2.0 - below.clip(0.0) / 1.5)
    flood = 4000.0 * np.exp(-((h / 16.0) ** 2) / 2.0 - below.clip(0.0) / 5.0)
    low = (spot + flood) / (1.0 + np.exp(-(below / 0.08).clip(-60.0, 60.0)))
    high = (
        45000.0 * np.exp(-((h / 3.5) ** 2 + (v / 1.5) ** 2) / 2.0)
        if kind == "high"
        else 0.0
    )
    return np.asarray(low + high)


@lru_cache(maxsize=2)
def table(kind: str) -> Floats:
    """Return the intensities (ROWS, COLUMNS) of one headlamp on a plane before it,
    candela; row 0 on top.
    """
    up = SIDES * ROWS / COLUMNS
    aside, above = np.meshgrid(
        SIDES * (2.0 * (np.arange(COLUMNS) + 0.5) / COLUMNS - 1.0),
        up * (1.0 - 2.0 * (np.arange(ROWS) + 0.5) / ROWS),
    )
    values = candela(
        kind,
        np.degrees(np.arctan(aside)),
        np.degrees(np.arctan2(above, np.hypot(1.0, aside))),
    )
    border = np.minimum(
        (SIDES - np.abs(aside)) / (0.2 * SIDES), (up - np.abs(above)) / (0.2 * up)
    )
    return np.asarray(values * border.clip(0.0, 1.0), np.float32)


def with_lamps(scene: SceneDescription) -> SceneDescription:
    """Return the scene with the lamps that its object, its things and its camera's car
    have on, and no others. Raises InputError: the light of the environment has no unit,
    the object's size is not known, or a name is taken.
    """
    others = tuple(
        part for part in scene.parts if not isinstance(part, (BeamLamp, LampGlass))
    )
    asked = {
        "object": chosen(scene, "object.lamps"),
        CAMERA: chosen(scene, "camera.lamps"),
    }
    asked |= {part.name: part.lamps for part in others if isinstance(part, ThingPart)}
    asked = {carrier: kind for carrier, kind in asked.items() if kind != LAMPS[0]}
    if not asked:
        return (
            scene if len(others) == len(scene.parts) else replace(scene, parts=others)
        )
    unit = None if scene.environment is None else scene.environment.candelas
    who = {"object": "`set` object.lamps", CAMERA: "`set` camera.lamps"}.get(
        next(iter(asked)), "things: lamps"
    )
    if unit is None:
        raise InputError(
            f"{who}: lamps are in candela, and the brightness of this environment has "
            "no unit; take one of the avenue, "
            "or leave the lamps off"
        )
    if scene.object.metres is None:
        raise InputError(
            f"{who}: lamps are so many metres apart, and how large {scene.object_name} "
            "is is not known; give its "
            "longest side in metres, such as `size=4.5`"
        )
    scene = replace(scene, parts=others)
    made: list[ScenePart] = []
    for carrier, kind in asked.items():
        made += _lamps_of(scene, carrier, kind, unit, 1.0 / (2 * len(asked)))
    taken = {part.name for part in others} & {part.name for part in made}
    if taken:
        raise InputError(
            "things: lamps of the scene are called "
            f"{', '.join(sorted(taken))}; give yours another name="
        )
    return replace(scene, parts=(*others, *made))


def chosen(scene: SceneDescription, setting: str) -> str:
    """Return the word that a setting of lamps has."""
    return LAMPS[int(scene.values.get(setting) or 0.0)]


def _lamps_of(
    scene: SceneDescription, carrier: str, kind: str, unit: float, weight: float
) -> Iterable[ScenePart]:
    sides = (1.0, -1.0)
    if carrier == CAMERA:
        places = [
            np.array([EGO[0], side * EGO[1], EGO[2]]) / scene.metres for side in sides
        ]
    else:
        part = scene.meshes[carrier]
        metres = part.metres if isinstance(part, ThingPart) else scene.metres
        # a metre in its coordinates
        step = float(np.ptp(part.mesh.vertices, axis=0).max()) / metres
        front = _glass(part, "headlamps", 1.0, step, GLASS / unit * WHITE)
        yield from (front, _glass(part, "taillamps", -1.0, step, REAR / unit * RED))
        vertices = front.mesh.vertices
        places = []
        for side in sides:
            lamp = vertices[side * (vertices[:, 1] - vertices[:, 1].mean()) >= 0.0]
            low = lamp.min(axis=0)
            high = lamp.max(axis=0)
            places.append(
                np.array([high[0] + 5.0 * OUT * step, *(low + high)[1:] / 2.0])
            )
    red, green, blue = map(float, WHITE / (unit * scene.metres**2))
    for name, place in zip(("left", "right"), places, strict=True):
        seat = pose_of([(0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)], place)
        yield BeamLamp(
            f"{carrier}-{name}-beam",
            carrier,
            seat,
            table(kind),
            (red, green, blue),
            weight,
        )


def _glass(
    part: MeshPart, where: str, ahead: float, step: float, power: Doubles
) -> LampGlass:
    """The glass of a car's two headlamps or tail lamps (`where`, of `NAMED`), which
    shine along its x axis by `ahead`: the faces of a material that is called so, or
    else two disks before what is foremost there; `step` is a metre in the car's
    coordinates, `power` (3,) the radiance times square metres that each of the two
    sends there.
    """
    mesh = part.mesh
    named = [
        faces
        for name, faces in mesh.materials.items()
        if NAMED[where].search(name) and len(faces)
    ]
    if named:
        lies_on = np.concatenate(named)
        follows, faces = np.unique(
            mesh.faces[lies_on].astype(np.int64), return_inverse=True
        )
        faces = faces.reshape(-1, 3)
        normals = mesh.normals[follows].astype(np.float64)
        vertices = mesh.vertices[follows] + OUT * step * normals
    else:
        vertices, faces = _disks(mesh, where, ahead, step)
        normals = np.tile([[ahead, 0.0, 0.0]], (len(vertices), 1))
        follows = cKDTree(mesh.vertices).query(vertices)[1]
        lies_on = cKDTree(mesh.vertices[mesh.faces].mean(axis=1)).query(
            vertices[faces].mean(axis=1)
        )[1]
    corners = vertices[faces] / step
    across = ahead * face_vectors(corners)[:, 0] / 2.0
    shape = (
        vertices.astype(np.float32),
        faces.astype(np.uint32),
        normals.astype(np.float32),
        mesh.uvs[follows],
    )
    radiance = 2.0 * power / max(float(across.clip(0.0).sum()), 1e-9)
    return LampGlass(
        name=f"{part.name}-{where}",
        mesh=Mesh(*shape),
        base_color=np.tile((0.8 * power / power.max()).astype(np.float32), (2, 2, 1)),
        material=CLEAR,
        emission=radiance.astype(np.float32)[None, None],
        carrier=part.name,
        follows=follows,
        lies_on=lies_on,
    )


def _disks(mesh: Mesh, where: str, ahead: float, step: float) -> tuple[Doubles, Ints]:
    corners = mesh.vertices[mesh.faces].astype(np.float64) * [ahead, 1.0, 1.0]
    low = corners.min(axis=(0, 1))
    high = corners.max(axis=(0, 1))
    (height, share) = HEIGHTS[where]
    wide = high[1] - low[1]
    turn = ahead * np.linspace(0.0, 2.0 * np.pi, SPOKES, endpoint=False)
    rim = min(RADIUS * step, 0.1 * wide) * np.stack(
        [0.0 * turn, np.cos(turn), np.sin(turn)], axis=1
    )
    vertices = list[Doubles]()
    faces = list[Ints]()
    for side in (1.0, -1.0):
        middle = np.array([0.0, (low[1] + high[1]) / 2.0 + side * ASIDE * wide, low[2]])
        middle[2] += min(height * step, share * (high[2] - low[2]))
        disk = np.concatenate([[middle], middle + rim])
        beside = (corners.min(axis=1) > disk.max(axis=0)) | (
            corners.max(axis=1) < disk.min(axis=0)
        )
        near = corners[~beside[:, 1:].any(axis=1)][:, :, [1, 2, 0]]
        foremost = max(
            (x for place in disk[:, 1:] for x in heights_over(near, place)),
            default=high[0],
        )
        disk[:, 0] = ahead * (foremost + OUT * step)
        spokes = np.arange(SPOKES)
        faces.append(
            len(vertices) * len(disk)
            + np.stack([0 * spokes, 1 + spokes, 1 + (spokes + 1) % SPOKES], axis=1)
        )
        vertices.append(disk)
    return np.concatenate(vertices), np.concatenate(faces)
