"""Named parts of a scene other than its environment map, as data: meshes, lamps and
haze; and cameras.

A part states its properties and which scene inputs it takes: torch tensors with our own
names. `mitsuba_backend` translates it. A new kind of part is a subclass, with a
translation registered by `mitsuba_backend.parts.translate_part.register`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields
from functools import lru_cache
from typing import ClassVar

import numpy as np

from advsearch.scene.assets import (
    Float32Array,
    Float64Array,
    IntArray,
    Material,
    Mesh,
    Shape,
    make_pose,
)
from advsearch.scene.footprint import Footprint as Footprint
from advsearch.scene.footprint import Solid as Solid
from advsearch.scene.places.schema import PlaceFile

Triple = tuple[float, float, float]
# the type that stands for the texture in a surface in Mitsuba's words
BASE_COLOR = "base color"
# name of the input () that is the index of the photograph of a folder
PHOTOGRAPH_INPUT = "backdrop.which"


def iterate_plugins(plugin: Mapping[str, object]) -> Iterator[Mapping[str, object]]:
    """Yield a plugin's dictionary and all within it."""
    yield plugin
    for inner in plugin.values():
        if isinstance(inner, Mapping):
            yield from iterate_plugins(inner)


@dataclass(frozen=True, eq=False)
class ScenePart:
    """Something in a scene."""

    name: str  # unique in the scene; begins the names of its inputs
    volumetric: ClassVar[bool] = False  # needs an integrator that handles media


@dataclass(frozen=True, eq=False)
class MeshPart(Shape, ScenePart):
    """A shape in the scene; "object" is the object itself.

    Takes `NAME.vertices` and `NAME.normals` (V, 3) in world space, `NAME.base_color`
    (h, w, 3) linear reflectance with row 0 at v = 1, and `NAME.roughness`, `.metallic`,
    `.specular`, `.clearcoat` (1,) in [0, 1], but for what a `surface` lacks of these;
    where it emits light, `NAME.radiance`, linear, (3,) or (h, w, 3). `NAME.to_world`
    (4, 4) and `NAME.offsets` (V, 3) are turned into vertices and normals by
    `advsearch.scene.assembly`.
    """

    # (4, 4) base pose
    to_world: Float64Array = field(default_factory=lambda: np.eye(4))
    # place that the mesh belongs to; it is removed with the place
    place: Place | None = None
    is_ground: bool = False  # whether it is the part of a place on which things stand
    # Solids of a place, in object sizes: nothing else can be inside them.
    solids: tuple[Solid, ...] = ()

    @property
    def is_laid_ground(self) -> bool:
        """Whether it belongs to the ground that the scene has by itself."""
        return self.place is not None


@dataclass(frozen=True, eq=False)
class Place:
    """A place with one of its variants."""

    name: str
    file: PlaceFile
    parts: tuple[MeshPart, ...]  # parts in metres; what they emit is in cd/m2
    notes: tuple[str, ...] = ()  # what was left out, one sentence each


@dataclass(frozen=True, eq=False)
class LampGlass(MeshPart):
    """The glass of a car's lamps, which shines.

    It stands in the car's own coordinates, and belongs to it: to the mesh that carries
    it, with whose vertices (V,) its own go, and on whose faces (F,) its own lie.
    """

    carrier: str = ""
    vertex_of_carrier: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    face_of_carrier: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))


def make_mesh_part(
    name: str, shape: Shape, to_world: Float64Array, material: Material
) -> MeshPart:
    """Return a shape as a part of a scene.

    Name and material replace the shape's own; `to_world` (4, 4) is its base pose.
    """
    shape_fields = {
        shape_field.name: getattr(shape, shape_field.name)
        for shape_field in fields(Shape)
    }
    return MeshPart(
        **{**shape_fields, "name": name, "material": material}, to_world=to_world
    )


@dataclass(frozen=True, eq=False)
class _Point(ScenePart):
    """A lamp without size, which the camera does not see."""

    dark: bool = False  # its intensity stays 0
    position: Triple = (0.0, 0.0, 2.0)  # base value, object sizes
    # base value, linear radiant intensity for each colour channel
    intensity: Triple = (0.0, 0.0, 0.0)

    def compute_lighting(
        self, position: Float64Array
    ) -> tuple[Float64Array, Float64Array]:
        """Return the vector (3,) from a position to the lamp, and its irradiance (3,).

        The irradiance is that of a surface that faces the lamp, for the base values of
        the lamp's position and intensity.
        """
        to_lamp = np.array(self.position) - position
        return to_lamp, np.array(self.intensity) / max(float(to_lamp @ to_lamp), 1e-12)


class PointLamp(_Point):
    """A point that shines equally in all directions.

    Takes `NAME.position` (3,) in object sizes and `NAME.intensity` (3,) linear radiant
    intensity. The interior adjoint is right for the intensity; for a position Mitsuba
    raises.
    """


MAX_SPOT_ANGLE = 89.9  # angles of a spot's edge, degrees
MIN_SPOT_ANGLE = 0.1
MAX_BEAM_FRACTION = (
    0.99  # largest share of that angle at which the light begins to fall off
)


@dataclass(frozen=True, eq=False)
class SpotLamp(_Point):
    """A point that shines in a cone, as Mitsuba's `spot`.

    Up to `beam` from its axis it shines evenly, and from there to `cutoff` its
    intensity, which is that on the axis, falls off linearly with the angle. Takes
    `NAME.intensity` (3,) linear radiant intensity, for which the interior adjoint is
    right.
    """

    # unit vector along its axis; z down where that is 0
    direction: Triple = (0.0, 0.0, -1.0)
    # angle from the axis beyond which it is dark, degrees; taken to `MIN_SPOT_ANGLE` to
    # `MAX_SPOT_ANGLE`
    cutoff: float = 45.0
    # angle up to which it shines fully, degrees; taken to at most `MAX_BEAM_FRACTION`
    # of the other one
    beam: float = 0.0

    @property
    def cone(self) -> tuple[float, float]:
        """Cutoff and beam in degrees, as far as Mitsuba can have them."""
        cutoff = min(max(self.cutoff, MIN_SPOT_ANGLE), MAX_SPOT_ANGLE)
        return cutoff, min(self.beam, MAX_BEAM_FRACTION * cutoff)

    @property
    def to_world(self) -> Float64Array:
        """(4, 4) pose of the lamp, which shines along its own +z.

        The cone is round, so that any rotation about that axis will do.
        """
        forward = (
            np.array(self.direction)
            if any(self.direction)
            else np.array([0.0, 0.0, -1.0])
        )
        # The cross product with the axis of the world that is least parallel to the
        # direction: with a parallel one it would be 0.
        right = np.cross(np.eye(3)[np.abs(forward).argmin()], forward)
        right /= np.linalg.norm(right)
        return make_pose(
            np.stack([right, np.cross(forward, right), forward], axis=1), self.position
        )

    def compute_lighting(
        self, position: Float64Array
    ) -> tuple[Float64Array, Float64Array]:
        """Return the vector (3,) from a position to the lamp, and its irradiance (3,).

        The irradiance is that of a surface that faces the lamp.
        """
        to_lamp, irradiance = super().compute_lighting(position)
        # Degrees from the axis: full light up to `beam`, falling to none at `cutoff`.
        cutoff, beam = self.cone
        distance = max(float(np.linalg.norm(to_lamp)), 1e-12)
        # The lamp shines along its z, and `-to_lamp` points from it to the position.
        cosine = -to_lamp @ self.to_world[:3, 2] / distance
        angle = math.degrees(math.acos(min(max(float(cosine), -1.0), 1.0)))
        fraction = min(max((cutoff - angle) / (cutoff - beam), 0.0), 1.0)
        return to_lamp, irradiance * fraction


@dataclass(frozen=True, eq=False)
class BallLamp(ScenePart):
    """A ball that shines outwards with the same radiance everywhere.

    The camera sees it where it is in view.

    A ball needs no orientation, and the cone under which it is seen is sampled: as
    quiet as a disk, and simpler. Light of others passes through it, so that a lamp of
    power 0 changes nothing, wherever it stands.

    Takes `NAME.ball` (4, 4), the pose of the unit ball (a shift and one scale for all
    axes), and `NAME.radiance` (3,) linear radiance. The interior adjoint is right for
    the radiance; for the pose it is silently 0.
    """

    dark: bool = False  # its radiance stays 0
    center: Triple = (0.0, 0.0, 2.0)  # base value of the ball's middle, object sizes
    radius: float = 0.1  # base value, object sizes
    radiance: Triple = (0.0, 0.0, 0.0)  # base value, linear, for each colour channel

    def compute_lighting(
        self, position: Float64Array
    ) -> tuple[Float64Array, Float64Array]:
        """Return the vector (3,) from a position to the lamp, and its irradiance (3,).

        The irradiance of a uniform ball is `pi L r^2 / d^2` (see the `light` control).
        """
        red, green, blue = (
            math.pi * self.radius**2 * channel for channel in self.radiance
        )
        return PointLamp(
            self.name, position=self.center, intensity=(red, green, blue)
        ).compute_lighting(position)


CAMERA = "camera"  # what carries the lamps of the car that the camera is in


@dataclass(frozen=True, eq=False)
class BeamLamp(ScenePart):
    """A point on a mesh, or before the camera, that shines by a table, like a headlamp.

    The camera does not see it. Takes `NAME.to_world` (4, 4), its pose, which it has
    once what carries it stands there; its brightness stays.
    """

    carrier: str  # the mesh that carries it, or `CAMERA`
    # (4, 4) its pose in what carries it (see `compute_carried_pose`): it shines along
    # its +z and has +y up
    pose_on_carrier: Float64Array
    # (h, w) intensities on a plane before it, row 0 on top, as far as tangents of 1 to
    # either side
    table: Float32Array
    tint: Triple  # radiant intensity for each colour channel where the table has 1
    # how often its light is sampled, where that of the environment has 1
    weight: float = 1.0
    to_world: Float64Array = field(default_factory=lambda: np.eye(4))
    dark: ClassVar[bool] = False

    def compute_lighting(
        self, position: Float64Array
    ) -> tuple[Float64Array, Float64Array]:
        """Return the vector (3,) from a position to the lamp, and its irradiance (3,).

        The irradiance is that of a surface that faces the lamp: the intensity in its
        direction, which the table has, divided by the squared distance. It is 0 behind
        the lamp and outside of the table.

        Args:
            position: (3,) in world space.
        """
        to_lamp = self.to_world[:3, 3] - position
        # the position in the lamp's axes: x to the table's right, y up, z ahead
        x, y, z = -to_lamp @ self.to_world[:3, :3]
        height, width = self.table.shape
        # tangents from -1 to 1 over the width; texels are square, row 0 is on top
        column = math.floor((x / max(z, 1e-9) + 1.0) / 2.0 * width)
        row = math.floor((1.0 - y / max(z, 1e-9) * width / height) / 2.0 * height)
        if z <= 0.0 or not (0 <= column < width and 0 <= row < height):
            return to_lamp, np.zeros(3)
        return to_lamp, self.table[row, column] * np.array(self.tint) / max(
            float(to_lamp @ to_lamp), 1e-12
        )


Lamp = PointLamp | SpotLamp | BallLamp | BeamLamp
# what the name of an input ends in that is the picture of a projector
PATTERN_SUFFIX = ".pattern"


@dataclass(frozen=True, eq=False)
class ProjectorPart(ScenePart):
    """A projector, as Mitsuba's `projector`.

    A point that throws a picture, and that the camera does not see. Takes `NAME.pose`
    (4, 4), as a camera's, and `NAME.pattern` (h, w, 3): what a white matt screen shows
    that faces it at distance 1, linear radiance. The interior adjoint is right for the
    pattern.
    """

    fov: float = 30.0  # angle of the picture's width, degrees
    sides: tuple[int, int] = (2, 2)  # rows and columns of the picture

    @property
    def aspect(self) -> float:
        """Width over height of the picture."""
        return self.sides[1] / self.sides[0]

    @property
    def area(self) -> float:
        """What it covers of a screen at distance 1."""
        return 4.0 * math.tan(math.radians(self.fov) / 2.0) ** 2 / self.aspect


@dataclass(frozen=True, eq=False)
class PosedCamera:
    """A camera with a pose of its own."""

    # (4, 4) its pose: it looks along its own +z with +y up and +x to the left
    to_world: Float64Array
    # field of view along the larger side of the picture, or if `upright` along its
    # height, degrees
    fov: float
    # whether it is the height that it is along, whatever the picture's shape
    upright: bool = False

    def compute_larger_fov(self, aspect: float) -> float:
        """Return the field of view, degrees, along the larger side of an image.

        `aspect` is its width over its height.
        """
        is_along_smaller_side = self.upright and aspect > 1.0
        if not is_along_smaller_side:
            return self.fov
        # from the height to the width: the tangents are in proportion to the sides
        return math.degrees(
            2.0 * math.atan(math.tan(math.radians(self.fov) / 2.0) * aspect)
        )


@dataclass(frozen=True, eq=False)
class HazePart(ScenePart):
    """One grey medium in a ball around the origin that camera and object stand in.

    It scatters evenly in all directions. Takes `NAME.density` (1,), the extinction per
    object size, and `NAME.albedo` (3,), the share of the light that is scattered and
    not absorbed.
    """

    radius: float  # radius of the ball that it fills, object sizes
    density: float = 0.0  # density by itself; none by default, for a control to fill
    albedo: tuple[float, float, float] = (1.0, 1.0, 1.0)
    volumetric: ClassVar[bool] = True


@dataclass(frozen=True)
class PluginNumber:
    """A number or a colour in Mitsuba, by Mitsuba's own name."""

    key: str  # key that name: "red.reflectance.value"
    values: tuple[float, ...]  # its one or three numbers in the scene as it is
    input: str  # the scene input that sets it
    # valid estimators of its derivative, the preferred one first
    valid: tuple[str, ...] = ("differences",)
    # whether it is a plain number in Mitsuba, a constant of the compiled kernels: after
    # a change they are recorded again
    plain: bool = False


@dataclass(frozen=True, eq=False)
class PluginNumbers(ScenePart):
    """Numbers and colours of what is in the scene already.

    Takes their inputs, which begin with `NAME.`.
    """

    numbers: tuple[PluginNumber, ...] = ()  # some of the scene


@dataclass(frozen=True, eq=False)
class PluginPart(ScenePart):
    """A shape, light or material of a Mitsuba scene as it is."""

    # transforms are (4, 4) arrays, pictures (H, W, C) ones
    plugin: Mapping[str, object] = field(default_factory=dict)
    emits_light: bool = False  # it sends out light


@dataclass(frozen=True, eq=False)
class MediumPart(PluginPart):
    """One that holds a medium."""

    volumetric: ClassVar[bool] = True


@lru_cache(maxsize=8)
def make_polygon(corners: int) -> Mesh:
    """Return a regular polygon of radius 1 in the plane z = 0 that faces +z.

    Vertices are its middle, then its corners; each side is one face with the middle.
    Texture coordinates are the unit square around it.
    """
    angles = 2.0 * np.pi * np.arange(corners) / corners
    corner_points = np.stack(
        [np.cos(angles), np.sin(angles), np.zeros(corners)], axis=1
    )
    vertices = np.concatenate([np.zeros((1, 3)), corner_points]).astype(np.float32)
    corner = np.arange(corners)
    faces = np.stack(
        [np.zeros(corners, np.int64), corner + 1, (corner + 1) % corners + 1], axis=1
    ).astype(np.uint32)
    normals = np.tile(np.array([0.0, 0.0, 1.0], dtype=np.float32), (corners + 1, 1))
    return Mesh(vertices, faces, normals, vertices[:, :2] / 2.0 + np.float32(0.5))


def make_sphere(rows: int, columns: int) -> Mesh:
    """Return a sphere of diameter 1 around the origin.

    A grid of `rows` bands from pole to pole and `columns` around divides it into cells.
    A cell has two faces, but only one at a pole, where the other would have no area. So
    there are 2 (rows - 1) columns faces. The texture coordinate v is 1 at the top, and
    u goes around from +x to +y. Vertices are in rows from the bottom, with columns + 1
    in each: the first and the last are at one position, where u is 0 and 1.
    """
    v_steps = np.linspace(0, 1, rows + 1)
    u_steps = np.linspace(0, 1, columns + 1)
    v_grid, u_grid = np.meshgrid(v_steps, u_steps, indexing="ij")
    v = v_grid.ravel()
    u = u_grid.ravel()
    theta = math.pi * (1.0 - v)
    phi = 2.0 * math.pi * u
    normals = np.stack(
        [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)],
        axis=1,
    )
    uvs = np.stack([u, v], axis=1)
    return Mesh(
        vertices=(0.5 * normals).astype(np.float32),
        faces=_make_sphere_faces(rows, columns).astype(np.uint32),
        normals=normals.astype(np.float32),
        uvs=uvs.astype(np.float32),
    )


def _make_sphere_faces(rows: int, columns: int) -> IntArray:
    """Return the faces (F, 3) of a sphere of cells, see `make_sphere`."""
    # the vertex at the lower left corner of each cell, and the one above it
    corner = (
        np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)[None, :]
    ).ravel()
    above = corner + columns + 1
    lower = np.stack([corner, corner + 1, above + 1], 1)
    upper = np.stack([corner, above + 1, above], 1)
    # without the lower faces of the first row and the upper faces of the last one, two
    # of whose corners are at a pole
    faces = np.concatenate([lower[columns:], upper[:-columns]])
    return np.asarray(faces, np.int64)
