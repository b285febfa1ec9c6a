"""Headlamps and tail lamps of cars: of the object, of cars next to it, and of the car
that carries the camera.

A headlamp is a point that shines by a table of luminous intensity over angles, and
glass that glows. The intensity of one lamp, h degrees to the side and v degrees above
the horizon, follows from the angle below the cut-off, d = -0.57 - v:

    low:  (14,500 exp(-(h/5)^2/2) exp(-d/1.5) + 4,000 exp(-(h/16)^2/2) exp(-d/5))
          / (1 + exp(-d/0.08)) candela
    high: low + 45,000 exp(-(h/3.5)^2/2 - (v/1.5)^2/2)

The cut-off is level, 1 % below the horizon; a real one rises on the side of the curb.
These numbers fulfil the requirements for a lamp of class B (UN Regulation 112, sections
6.2 and 6.3). At 0.86 degrees down they are at least 5,100 cd ahead and 10,100 cd at
1.72 degrees to the side; at 1.72 degrees down at least 1,700 cd at 9 degrees to the
side; above the horizon at most 350 to 625 cd. For the high beam 40,500 cd are required.
The glass of a headlamp shines with 250 cd ahead, which is the light left above the
cut-off, and that of a tail lamp with 10 cd in red (UN Regulation 7: at least 4). This
is tested in `tests/scene/test_headlamps.py`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from advsearch.errors import InputError
from advsearch.scene.assets import (
    Float32Array,
    Float64Array,
    IntArray,
    Material,
    Mesh,
    compute_area_vectors,
    make_pose,
)
from advsearch.scene.grounds import LUMINANCE
from advsearch.scene.parts import CAMERA, BeamLamp, LampGlass, MeshPart, ScenePart
from advsearch.scene.scene_data import OBJECT, AnyScene, SceneData
from advsearch.scene.settings import LAMPS, LAMPS_OFF
from advsearch.scene.things import ThingPart, find_triangle_heights

# degrees above the horizon at which the low beam has half of its intensity below
CUT_OFF = -0.57
# tangent of the table's largest angle to the side, and its size; texels are square
TABLE_HALF_WIDTH = 1.0
ROWS = 512
COLUMNS = 896
# intensity of the glass of one headlamp ahead, and of one tail lamp behind, candela
HEADLAMP_CANDELA = 250.0
TAILLAMP_CANDELA = 10.0
WHITE, RED = (
    color / (color @ np.array(LUMINANCE))
    for color in np.array([[1.0, 0.95, 0.86], [1.0, 0.0, 0.0]])
)
"""Linear colors with a luminance of 1."""
MATERIAL_NAMES = {
    "headlamps": re.compile(r"head[ _-]?(light|lamp)", re.IGNORECASE),
    "taillamps": re.compile(r"(tail|rear)[ _-]?(light|lamp)", re.IGNORECASE),
}
"""Patterns of the names of materials of lamps in a file."""
LAMP_HEIGHTS = {"headlamps": (0.65, 0.45), "taillamps": (0.85, 0.6)}
LAMP_OFFSET = 0.36
LAMP_RADIUS = 0.07
"""Positions of lamps on a car without materials of lamps.

A height is in meters above the car's lowest point, or if it is lower, the second
number, a fraction of the car's height. The offset to either side is a fraction of the
car's width, and the radius is in meters.
"""
N_SPOKES = 12  # points on the rim of such a lamp
EGO_LAMP_POSITION = (1.7, 0.62, 0.65)
"""Position of the left headlamp of the car that carries the camera: meters in front of
the camera, to the left, and above the ground.
"""
# A beam shines along its own +z; a car drives along its +x, with +z up.
BEAM_AXES = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
GLASS_MATERIAL = Material(roughness=0.06, specular=0.6)
GLASS_OFFSET = 0.004  # distance of the glass of a lamp from the car's body, meters
# distance in front of the glass at which the beam starts, so that the glass hides none
# of it, meters
BEAM_OFFSET = 5.0 * GLASS_OFFSET


def compute_candela(kind: str, h: Float64Array, v: Float64Array) -> Float64Array:
    """Return the luminous intensity of one headlamp in some directions, in candela.

    The low beam is the sum of a narrow and a wide beam. Each is a Gaussian to the
    sides, and fades exponentially from the cut-off downwards. A sigmoid darkens what is
    above the cut-off. The high beam adds a Gaussian around straight ahead.

    Args:
        kind: "low" or "high".
        h: degrees to the side, of any shape.
        v: degrees above the horizon, of the same shape.
    """
    below_cut_off = CUT_OFF - v
    # 14500 and 4000 are candela. The standard deviations to the side (5 and 16) and the
    # angles in which a beam falls by the factor e (1.5 and 5) are in degrees.
    narrow_beam = 14500.0 * np.exp(
        -((h / 5.0) ** 2) / 2.0 - below_cut_off.clip(0.0) / 1.5
    )
    wide_beam = 4000.0 * np.exp(
        -((h / 16.0) ** 2) / 2.0 - below_cut_off.clip(0.0) / 5.0
    )
    # The clip keeps `exp` from overflowing.
    low_beam = (narrow_beam + wide_beam) / (
        1.0 + np.exp(-(below_cut_off / 0.08).clip(-60.0, 60.0))
    )
    if kind != "high":
        return np.asarray(low_beam)
    high_beam = 45000.0 * np.exp(-((h / 3.5) ** 2 + (v / 1.5) ** 2) / 2.0)
    return np.asarray(low_beam + high_beam)


@lru_cache(maxsize=2)
def make_candela_table(kind: str) -> Float32Array:
    """Return the intensities (ROWS, COLUMNS) of one headlamp on a plane before it.

    Intensities are in candela, and row 0 is on top. The plane is at a distance of 1, so
    that a texel's position on it is the tangent of its angle. It reaches to
    `TABLE_HALF_WIDTH` on each side. In the outer tenth at each border the intensities
    fade to zero, so that no edge is seen.

    Args:
        kind: "low" or "high".
    """
    half_height = TABLE_HALF_WIDTH * ROWS / COLUMNS
    side_tangent, up_tangent = np.meshgrid(
        TABLE_HALF_WIDTH * (2.0 * (np.arange(COLUMNS) + 0.5) / COLUMNS - 1.0),
        half_height * (1.0 - 2.0 * (np.arange(ROWS) + 0.5) / ROWS),
    )
    candela = compute_candela(
        kind,
        np.degrees(np.arctan(side_tangent)),
        np.degrees(np.arctan2(up_tangent, np.hypot(1.0, side_tangent))),
    )
    fade = np.minimum(
        _compute_border_fade(side_tangent, TABLE_HALF_WIDTH),
        _compute_border_fade(up_tangent, half_height),
    )
    return np.asarray(candela * fade.clip(0.0, 1.0), np.float32)


def _compute_border_fade(tangent: Float64Array, half_size: float) -> Float64Array:
    """Return factors that fall to 0 in the outer tenth at each border of a table.

    Further inside they are above 1.

    Args:
        tangent: positions along one axis, from the middle of the table.
        half_size: half the width or height of the table.
    """
    # 0.2 of half the size is a tenth of the size
    return np.asarray((half_size - np.abs(tangent)) / (0.2 * half_size))


def add_lamps(scene: AnyScene) -> AnyScene:
    """Return the scene with those lamps that are on.

    The object, the things next to it and the camera's own car may carry lamps. Lamps
    that the scene has already are removed. If no lamp is on and the scene has none, the
    same scene is returned.

    Raises:
        InputError: the light of the environment has no unit, the object's size is not
            known, or a name is taken.
    """
    other_parts = tuple(
        part for part in scene.parts if not isinstance(part, (BeamLamp, LampGlass))
    )
    kind_by_lit_carrier = _find_lit_carriers(scene, other_parts)
    if not kind_by_lit_carrier:
        had_lamps = len(other_parts) < len(scene.parts)
        return replace(scene, parts=other_parts) if had_lamps else scene
    # All cars have the unit of the scene. The first is named if there is none.
    first_carrier = next(iter(kind_by_lit_carrier))
    radiance_unit = _get_radiance_unit(scene, first_carrier)
    scene = replace(scene, parts=other_parts)
    # Each car has two beams. With this weight all beams together are sampled as often
    # as the environment, which has a weight of 1.
    weight = 1.0 / (2 * len(kind_by_lit_carrier))
    lamps: list[ScenePart] = []
    for carrier, kind in kind_by_lit_carrier.items():
        lamps += _make_lamps(scene, carrier, kind, radiance_unit, weight)
    _check_lamp_names(other_parts, lamps)
    return replace(scene, parts=(*other_parts, *lamps))


def _find_lit_carriers(
    scene: SceneData, other_parts: Sequence[ScenePart]
) -> dict[str, str]:
    """Return the beam, "low" or "high", of each car whose lamps are on, by its name.

    `other_parts` are all parts but lamps.
    """
    # "off", "low" or "high" beam of each car
    kind_by_carrier = {
        OBJECT: get_lamp_kind(scene, "object.lamps"),
        CAMERA: get_lamp_kind(scene, "camera.lamps"),
    }
    for part in other_parts:
        if isinstance(part, ThingPart):
            kind_by_carrier[part.name] = part.lamps
    return {
        carrier: kind for carrier, kind in kind_by_carrier.items() if kind != LAMPS_OFF
    }


def _check_lamp_names(
    other_parts: Sequence[ScenePart], lamps: Sequence[ScenePart]
) -> None:
    """Raise InputError if another part has the name of a lamp."""
    duplicates = {part.name for part in other_parts} & {lamp.name for lamp in lamps}
    if duplicates:
        raise InputError(
            f"things: lamps of the scene are called {', '.join(sorted(duplicates))}; "
            "give yours another name="
        )


def _get_radiance_unit(scene: SceneData, carrier: str) -> float:
    """Return the luminance of a radiance of 1, cd/m2, in the scene's environment.

    Args:
        scene: the scene.
        carrier: name of a car whose lamps are on, for the message.

    Raises InputError: the environment's light has no unit, or the object's size in
    metres is not known.
    """
    setting = _name_lamp_setting(carrier)
    radiance_unit = None if scene.environment is None else scene.environment.candelas
    if radiance_unit is None:
        raise InputError(
            f"{setting}: lamps are in candela, and the brightness of this environment "
            "has no unit; use an environment of the bundled avenue, or leave the lamps "
            "off"
        )
    if scene.object.size_in_metres is None:
        raise InputError(
            f"{setting}: the positions of lamps are in metres, and the size of "
            f"{scene.object_name} is not known; give its longest side in metres, "
            "such as `size=4.5`"
        )
    return radiance_unit


def _name_lamp_setting(carrier: str) -> str:
    """Return what switches on the lamps of a car, for messages.

    Cars other than the object and the camera's own are things.
    """
    setting_by_carrier = {OBJECT: "`set` object.lamps", CAMERA: "`set` camera.lamps"}
    return setting_by_carrier.get(carrier, "things: lamps")


def get_lamp_kind(scene: SceneData, setting: str) -> str:
    """Return the value of a setting of lamps, one of `LAMPS`.

    The scene's value is the word's index; without one, lamps are off.
    """
    return LAMPS[int(scene.values.get(setting) or 0.0)]


def _make_lamps(
    scene: SceneData,
    carrier: str,
    kind: str,
    radiance_unit: float,
    weight: float,
) -> Iterable[ScenePart]:
    """Yield the lamps of one car: the glass of head- and tail lamps, and two beams.

    The camera's own car has no mesh, so that it has beams alone.

    Args:
        scene: scene in which they shine.
        carrier: the mesh that carries them, or `CAMERA`.
        kind: beam, "low" or "high".
        radiance_unit: luminance in cd/m2 of a radiance of 1 in the scene.
        weight: how often the renderer samples each beam, relative to the environment.
    """
    if carrier == CAMERA:
        positions = _compute_ego_beam_positions(scene)
    else:
        part = scene.meshes[carrier]
        units_per_metre = _compute_units_per_metre(scene, part)
        # Luminous intensity as radiance of the scene times square meters: `_make_glass`
        # divides by the area of the glass in square meters.
        front_power = HEADLAMP_CANDELA / radiance_unit * WHITE
        rear_power = TAILLAMP_CANDELA / radiance_unit * RED
        headlamp_glass = _make_glass(
            part, "headlamps", 1.0, units_per_metre, front_power
        )
        yield headlamp_glass
        yield _make_glass(part, "taillamps", -1.0, units_per_metre, rear_power)
        positions = _find_beam_positions(headlamp_glass.mesh.vertices, units_per_metre)
    yield from _make_beams(scene, carrier, kind, positions, radiance_unit, weight)


def _compute_ego_beam_positions(scene: SceneData) -> list[Float64Array]:
    """Return where the left and the right beam of the camera's own car start.

    They are in object sizes, in the coordinates of that car, see `compute_car_pose`.
    """
    left_position = np.array(EGO_LAMP_POSITION)
    right_position = left_position * [1.0, -1.0, 1.0]  # mirrored to the other side
    return [
        position / scene.size_in_metres for position in (left_position, right_position)
    ]


def _make_beams(
    scene: SceneData,
    carrier: str,
    kind: str,
    positions: Sequence[Float64Array],
    radiance_unit: float,
    weight: float,
) -> Iterable[ScenePart]:
    """Yield the left and the right beam of a car.

    Args:
        scene: scene in which they shine.
        carrier: the mesh that carries them, or `CAMERA`.
        kind: beam, "low" or "high".
        positions: where they start, in the car's coordinates.
        radiance_unit: luminance in cd/m2 of a radiance of 1 in the scene.
        weight: how often the renderer samples each beam, relative to the environment.
    """
    # A beam has its table in candela. This is its color, times the factor from candela
    # to the scene's unit, which is radiance times squared object size.
    beam_color = WHITE / (radiance_unit * scene.size_in_metres**2)
    red, green, blue = map(float, beam_color)
    for name, position in zip(("left", "right"), positions, strict=True):
        yield BeamLamp(
            name=f"{carrier}-{name}-beam",
            carrier=carrier,
            pose_on_carrier=make_pose(BEAM_AXES, position),
            table=make_candela_table(kind),
            tint=(red, green, blue),
            weight=weight,
        )


def _compute_units_per_metre(scene: SceneData, part: MeshPart) -> float:
    """Return the length of a meter in the coordinates of a car's mesh.

    The size of a car is the length of its longest side. `add_lamps` has checked that
    the object's size in meters is known.

    Args:
        scene: the scene.
        part: the scene's object, or a thing next to it.
    """
    # of the scene's object; a thing has a size of its own
    size_in_metres = scene.size_in_metres
    if isinstance(part, ThingPart):
        size_in_metres = part.size_in_metres
    longest_side = float(np.ptp(part.mesh.vertices, axis=0).max())
    return longest_side / size_in_metres


def _find_beam_positions(
    vertices: Float32Array, units_per_metre: float
) -> list[Float64Array]:
    """Return where the left and the right beam of a car start.

    The glass of both lamps is one mesh. Its vertices to the left of their mean are the
    left lamp. A beam starts `BEAM_OFFSET` in front of the middle of its lamp, so that
    the glass does not hide it. The car drives along +x.

    Args:
        vertices: (V, 3) of the glass, in the car's coordinates.
        units_per_metre: length of a metre in the car's coordinates.
    """
    positions = []
    for side in (1.0, -1.0):  # +y is left
        offset = vertices[:, 1] - vertices[:, 1].mean()
        lamp_vertices = vertices[side * offset >= 0.0]
        lower = lamp_vertices.min(axis=0)
        upper = lamp_vertices.max(axis=0)
        center_yz = (lower + upper)[1:] / 2.0
        front_x = upper[0] + BEAM_OFFSET * units_per_metre
        positions.append(np.array([front_x, *center_yz]))
    return positions


def _make_glass(
    part: MeshPart,
    lamp_type: str,
    facing: float,
    units_per_metre: float,
    power: Float64Array,
) -> LampGlass:
    """Return the glass of a car's two headlamps or tail lamps.

    If the car has a material with the name of such lamps, the glass is a copy of its
    faces, moved out along their vertices' normals. Otherwise it is two disks in front
    of the car's body. The glass moves with the car's nearest vertices.

    Args:
        part: the car.
        lamp_type: "headlamps" or "taillamps", a key of `MATERIAL_NAMES`.
        facing: 1 for lamps that shine along +x, -1 along -x.
        units_per_metre: length of a meter in the car's coordinates.
        power: (3,) radiance times square meters of one of the two lamps, for a viewer
            straight ahead.
    """
    mesh = part.mesh
    glass = _shape_glass(mesh, lamp_type, facing, units_per_metre)
    # The base color has the light's color, with 0.8 as its largest channel: no surface
    # reflects all light.
    glass_color = (0.8 * power / power.max()).astype(np.float32)
    radiance = 2.0 * power / _measure_visible_area(glass, facing, units_per_metre)
    return LampGlass(
        name=f"{part.name}-{lamp_type}",
        mesh=_make_glass_mesh(glass, mesh),
        base_color=np.tile(glass_color, (2, 2, 1)),
        material=GLASS_MATERIAL,
        emission=radiance.astype(np.float32)[None, None],
        carrier=part.name,
        vertex_of_carrier=glass.vertex_of_carrier,
        face_of_carrier=glass.face_of_carrier,
    )


def _shape_glass(
    mesh: Mesh, lamp_type: str, facing: float, units_per_metre: float
) -> _Glass:
    """Return the shape of the glass of a car's lamps; the arguments are
    `_make_glass`'s.

    `mesh` is that of the car.
    """
    named_faces = [
        faces
        for name, faces in mesh.materials.items()
        if MATERIAL_NAMES[lamp_type].search(name) and len(faces)
    ]
    if not named_faces:
        return _make_disks(mesh, lamp_type, facing, units_per_metre)
    faces = np.concatenate(named_faces)
    return _lift_faces(mesh, faces, GLASS_OFFSET * units_per_metre)


def _measure_visible_area(
    glass: _Glass, facing: float, units_per_metre: float
) -> float:
    """Return the area of glass, square meters, for a viewer straight ahead of it.

    It is that of both lamps, and at least 1e-9.
    """
    corners_in_metres = glass.vertices[glass.faces] / units_per_metre
    # (F,) square meters of each face for a viewer straight ahead, below 0 if it faces
    # the other way. An area vector is along the normal, with twice the area as length.
    facing_area = facing * compute_area_vectors(corners_in_metres)[:, 0] / 2.0
    return max(float(facing_area.clip(0.0).sum()), 1e-9)


def _make_glass_mesh(glass: _Glass, car_mesh: Mesh) -> Mesh:
    """Return the mesh of glass, with texture coordinates of its car's mesh."""
    return Mesh(
        vertices=glass.vertices.astype(np.float32),
        faces=glass.faces.astype(np.uint32),
        normals=glass.normals.astype(np.float32),
        uvs=car_mesh.uvs[glass.vertex_of_carrier],
    )


class _Glass(NamedTuple):
    """The shape of glass, in the coordinates of the car that carries it."""

    vertices: Float64Array  # (V, 3)
    faces: IntArray  # (F, 3)
    normals: Float64Array  # (V, 3)
    vertex_of_carrier: IntArray  # (V,) index of the car's vertex that each moves with
    face_of_carrier: IntArray  # (F,) index of the car's face that each counts as


def _lift_faces(mesh: Mesh, face: IntArray, offset: float) -> _Glass:
    """Copy faces (F,) of a car, by index, and move them out along their normals."""
    vertex, faces = np.unique(mesh.faces[face].astype(np.int64), return_inverse=True)
    normals = mesh.normals[vertex].astype(np.float64)
    vertices = mesh.vertices[vertex] + offset * normals
    return _Glass(vertices, faces.reshape(-1, 3), normals, vertex, face)


def _make_disks(
    mesh: Mesh, lamp_type: str, facing: float, units_per_metre: float
) -> _Glass:
    """Make two disks at the front or rear of a car, for lamps without a material.

    Their heights are `LAMP_HEIGHTS`, and their offsets to the sides `LAMP_OFFSET`. They
    are `GLASS_OFFSET` in front of the body. The first disk is on the left (+y).

    Args:
        mesh: mesh of the car.
        lamp_type: "headlamps" or "taillamps", a key of `LAMP_HEIGHTS`.
        facing: 1 for lamps that shine along +x, -1 along -x.
        units_per_metre: length of a metre in the car's coordinates.
    """
    # For tail lamps (`facing` -1) the car is mirrored, so that its rear faces +x.
    corners = mesh.vertices[mesh.faces].astype(np.float64) * [facing, 1.0, 1.0]
    lower = corners.min(axis=(0, 1))
    upper = corners.max(axis=(0, 1))
    width = upper[1] - lower[1]
    # A disk is at most a fifth as wide as the car.
    rim_offsets = min(LAMP_RADIUS * units_per_metre, 0.1 * width) * _make_circle(facing)
    body_height = upper[2] - lower[2]
    center_z = lower[2] + _find_lamp_height(lamp_type, body_height, units_per_metre)
    gap = GLASS_OFFSET * units_per_metre
    disks = list[Float64Array]()
    for side in (1.0, -1.0):
        center_y = (lower[1] + upper[1]) / 2.0 + side * LAMP_OFFSET * width
        center = np.array([0.0, center_y, center_z])
        disks.append(_make_disk(corners, center + rim_offsets, center, facing, gap))
    return _attach_disks(mesh, disks, facing)


def _find_lamp_height(
    lamp_type: str, body_height: float, units_per_metre: float
) -> float:
    """Return the height of lamps above a car's lowest point, in the car's coordinates.

    Args:
        lamp_type: "headlamps" or "taillamps", a key of `LAMP_HEIGHTS`.
        body_height: height of the car.
        units_per_metre: length of a metre.
    """
    metres, fraction_of_body = LAMP_HEIGHTS[lamp_type]
    return min(metres * units_per_metre, fraction_of_body * body_height)


def _make_disk(
    corners: Float64Array,
    rim: Float64Array,
    center: Float64Array,
    facing: float,
    gap: float,
) -> Float64Array:
    """Return the vertices of a disk in front of a car's body: its center, then its rim.

    Args:
        corners: (F, 3, 3) of the car's faces, mirrored for tail lamps.
        rim, center: (N, 3) and (3,) points of the disk, at x = 0 until it is moved.
        facing: 1 for lamps that shine along +x, -1 along -x.
        gap: distance in front of the body.
    """
    disk_vertices = np.concatenate([[center], rim])
    foremost = corners[..., 0].max()
    body_x = _find_foremost_x(corners, disk_vertices, default=foremost)
    # `facing` mirrors the disks of tail lamps back to the rear.
    disk_vertices[:, 0] = facing * (body_x + gap)
    return disk_vertices


def _attach_disks(mesh: Mesh, disks: Sequence[Float64Array], facing: float) -> _Glass:
    """Return two disks as glass that is carried by a car.

    Each point belongs to the nearest vertex of the car, and each face to the face
    with the nearest center.

    Args:
        mesh: mesh of the car.
        disks: vertices (1 + `N_SPOKES`, 3) of each disk: its center, then its rim.
        facing: 1 for disks whose front is towards +x, -1 towards -x.
    """
    vertices = np.concatenate(disks)
    disk_faces = _make_disk_faces()
    # The vertices of the second disk follow those of the first.
    faces = np.concatenate([disk_faces, (1 + N_SPOKES) + disk_faces])
    normals = np.tile([[facing, 0.0, 0.0]], (len(vertices), 1))
    car_face_centers = mesh.vertices[mesh.faces].mean(axis=1)
    disk_face_centers = vertices[faces].mean(axis=1)
    return _Glass(
        vertices,
        faces,
        normals,
        vertex_of_carrier=_find_nearest_indices(vertices, mesh.vertices),
        face_of_carrier=_find_nearest_indices(disk_face_centers, car_face_centers),
    )


def _find_nearest_indices(
    queries: Float64Array, points: Float32Array | Float64Array
) -> IntArray:
    """Return for each of (N, 3) queries the index (N,) of the nearest of some points.

    `points` are (M, 3).
    """
    _distances, indices = cKDTree(points).query(queries)
    return np.asarray(indices)


def _make_circle(facing: float) -> Float64Array:
    """Return points (N, 3) on a unit circle in the plane x = 0.

    They go round so that the disk's front faces along x by `facing`, 1 or -1.
    """
    angle = facing * np.linspace(0.0, 2.0 * np.pi, N_SPOKES, endpoint=False)
    return np.stack([0.0 * angle, np.cos(angle), np.sin(angle)], axis=1)


def _make_disk_faces() -> IntArray:
    """Return the faces (N, 3) of a disk, whose first vertex is the center."""
    spoke = np.arange(N_SPOKES)
    return np.stack([0 * spoke, 1 + spoke, 1 + (spoke + 1) % N_SPOKES], axis=1)


def _find_foremost_x(
    corners: Float64Array, disk: Float64Array, default: float
) -> float:
    """Return the largest x at which a line through a disk's vertex meets a face.

    The lines are along x, so that a disk at this x is in front of the car's body.

    Args:
        corners: (F, 3, 3) corners of the faces.
        disk: (V, 3) vertices of the disk, whose x does not count.
        default: result if no such line meets a face.
    """
    # (F, 3): for each axis, whether the bounds of face and disk do not overlap
    is_disjoint = (corners.min(axis=1) > disk.max(axis=0)) | (
        corners.max(axis=1) < disk.min(axis=0)
    )
    # The lines are along x, so that only y and z have to overlap.
    may_meet = ~is_disjoint[:, 1:].any(axis=1)
    # `find_triangle_heights` finds heights z over points (x, y). With the axes in the
    # order y, z, x it finds x over points (y, z).
    corners_yzx = corners[may_meet][:, :, [1, 2, 0]]
    disk_yz = disk[:, 1:]
    met_x = [x for point in disk_yz for x in find_triangle_heights(corners_yzx, point)]
    return max(met_x, default=default)
