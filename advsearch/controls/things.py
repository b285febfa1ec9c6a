"""The `things` control: position, rotation and presence of the things around the object.

A thing is a further mesh of the scene, such as a car next to the object.

    position = initial position + (x, y) + away * t

`away` is the unit vector from the object to the thing, and t >= 0 is the smallest distance
at which the thing is free. It is free if its outline on the ground overlaps with no other
one: that of the object, the camera, the things that do not move, and the things before it
in the list. A convex outline that moves along a line overlaps with another one in a single
interval of t, so that t is exact. If a thing would stand in a solid of the surroundings,
such as a house or a lamp post, it is first moved back towards the object until it is out
of the solid.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from advsearch.extend import (
    Control,
    Fixed,
    InputError,
    OneOf,
    Parameter,
    Range,
    SceneDescription,
    Value,
    Values,
    assets,
    errors,
    geometry,
    parts,
)

# distance between a thing that was pushed away and the obstacle, metres
MIN_GAP = 0.01
CAMERA_CLEARANCE = 0.3
CAMERA_CLEARANCE_FRACTION = 0.05
"""Radius around the camera, in metres, in which nothing of its height may stand; and its
limit as a fraction of the camera's distance from the object.
"""
EIGHT_ANGLES = np.arange(8) * np.pi / 4.0  # corners of the camera's outline
# An absent thing is scaled by this factor, and lies this many metres under the ground.
ABSENT_SCALE = 1e-5
ABSENT_DEPTH = 0.01
_moving = partial(Parameter.moving, Parameter.ORBIT)


class Stand(NamedTuple):
    """The position of a thing, in the coordinates of the scene.

    Attributes:
        position: (2,) x and y of its center.
        height: height of its lowest point.
        push_distance: how far it was pushed away from the object to be free; negative
            if it was moved towards the object.
    """

    position: assets.Float64Array
    height: float
    push_distance: float


class ThingsControl(Control):
    """Position, rotation and presence of the things around the object.

    Attributes:
        _moved_things: names of the things that it moves, in the scene's order: those
            with a searched parameter, or one that the user set.
    """

    kind = "things"
    parameters = (
        _moving(
            "x",
            "metres",
            -1000.0,
            1000.0,
            0.0,
            "Shift forwards from its position in the scene.",
            (-2.0, 2.0),
        ),
        _moving(
            "y",
            "metres",
            -1000.0,
            1000.0,
            0.0,
            "Shift to the left from its position in the scene.",
            (-2.0, 2.0),
        ),
        _moving(
            "heading",
            "degrees",
            -3600.0,
            3600.0,
            0.0,
            "Rotation from its pose in the scene, counter-clockwise.",
            (-180.0, 180.0),
            periodic=True,
        ),
        Parameter.named(
            "presence",
            ("there", "away"),
            "there",
            "Whether it is there.",
            estimators=("differences",),
            moves_silhouettes=True,
        ),
    )

    @classmethod
    def declare_parameters(cls, settings: Iterable[str]) -> tuple[Parameter, ...]:
        """Return the parameters for all things (`x`), and those set for one (`car.x`)."""
        parameter_by_name = {parameter.name: parameter for parameter in cls.parameters}
        single = []
        for setting in settings:
            short_name = setting.rpartition(".")[2]
            names_thing = "." in setting
            if names_thing and short_name in parameter_by_name:
                single.append(replace(parameter_by_name[short_name], name=setting))
        return (*cls.parameters, *single)

    def bind_parameters(self) -> None:
        """Find which things this control moves, and check that they stand free.

        Raises:
            InputError: the scene has no things, or one overlaps with something.
            UnknownNameError: a parameter names a thing that the scene does not have.
        """
        things = self.scene.things
        self._check_things_exist()
        super().bind_parameters()
        # Other things keep their positions, unless another control moves them.
        moved = self._find_moved_things()
        self._moved_things = tuple(name for name in things if name in moved)
        self._check_things_stand_free()

    def _check_things_exist(self) -> None:
        """Check that the scene has things, and those that parameters name.

        Raises:
            InputError: the scene has no things.
            UnknownNameError: a parameter names a thing that the scene does not have.
        """
        things = self.scene.things
        if not things:
            raise InputError(
                f"`controls` {self.name}: there is no thing around the "
                "object; add `things`, such as car@6,3"
            )
        for parameter_name in self.specs:
            # "car" for "car.x", and empty for "x"
            thing = parameter_name.rpartition(".")[0]
            if thing and thing not in things:
                raise errors.UnknownNameError(
                    f"`controls` {self.name}: thing around the object", thing, things
                )

    def _find_moved_things(self) -> set[str]:
        """Return the things with a searched parameter, or one that the user set.

        A user sets "car.x" for one thing, or "x" for all of them.
        """
        moved = set()
        for slot in self.parameter_slots:
            thing, _, short_name = slot.parameter.name.rpartition(".")  # "car", "x"
            is_set = slot.parameter.name in self.specs or short_name in self.specs
            if slot.n_coordinates or is_set:
                moved.add(thing)
        return moved

    def _check_things_stand_free(self) -> None:
        """Check that the things of this control stand free in the clean scene.

        Raises:
            InputError: one overlaps with something else.
        """
        # With all parameters 0, things are present, and stand as in the scene.
        unmoved = {
            slot.parameter.name: torch.zeros(()) for slot in self.parameter_slots
        }
        for name, stand in self._compute_stands(unmoved, {}).items():
            is_pushed = bool(stand.push_distance)
            if is_pushed:
                raise InputError(
                    f"`controls` {self.name}: {name} overlaps with something "
                    "else; put it in another position"
                )

    def list_parameter_specs(self) -> Iterator[tuple[Parameter, Fixed | Range | OneOf]]:
        """Yield the parameters of each thing, named `<thing>.<parameter>`.

        A setting for one thing, such as `car.x`, takes precedence over that for all
        things, `x`.
        """
        for thing in self.scene.things:
            for parameter in map(self.resolve_parameter, self.parameters):
                name = f"{thing}.{parameter.name}"
                spec = self.specs.get(name, self.get_parameter_spec(parameter))
                yield replace(parameter, name=name), spec

    def resolve_parameter(self, parameter: Parameter) -> Parameter:
        """Return a parameter; x and y are searched in a range that fits the object.

        It is 2 metres in each direction, or the object's size if that is smaller.
        """
        if parameter.name not in ("x", "y"):
            return parameter
        # Things around a small object stand on a table with it, and should stay on it.
        object_size = self.scene.size_in_metres
        reach = min(2.0, object_size)  # metres
        return replace(parameter, search=(-reach, reach))

    @property
    def refines(self) -> frozenset[str]:
        """Scene inputs of earlier controls that this control reads.

        It changes none of them. They are listed here so that it is evaluated after the
        controls that move an obstacle or deform a mesh. The poses of the things that it
        moves are its own inputs, but other controls may deform these things.
        """
        fixed = [name for name in self.scene.things if name not in self._moved_things]
        poses = [f"{name}.to_world" for name in ("object", "camera", *fixed)]
        offsets = [f"{name}.offsets" for name in ("object", *self.scene.things)]
        return frozenset([*poses, *offsets])

    def scene_inputs(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Return the pose `<thing>.to_world` (4, 4) of each thing that it moves.

        A thing is turned about its foot and moved to its free position. An absent one
        is made tiny and put under the ground, so that the scene keeps all its meshes.
        The result is differentiable in the heading, but not in x and y, since the free
        position is found without derivatives.

        Args:
            values: values of the control, such as "car.x" and "car.heading".
            earlier_inputs: inputs of earlier controls, which may move obstacles.
        """
        return {
            f"{name}.to_world": self._compute_thing_pose(name, values, stand)
            for name, stand in self._compute_stands(values, earlier_inputs).items()
        }

    def _compute_thing_pose(self, name: str, values: Values, stand: Stand) -> Tensor:
        """Return the pose (4, 4) of a thing at its free position.

        Args:
            name: name of the thing.
            values: values of the control.
            stand: the free position.
        """
        part = self.scene.meshes[name]
        # the pose in the scene, and the point of the thing on the ground
        base = torch.from_numpy(part.to_world).to(values[f"{name}.x"])
        foot = torch.from_numpy(_find_foot(part)).to(base)
        pitch, roll = base.new_zeros(2)
        turn = geometry.make_euler_rotation(values[f"{name}.heading"], pitch, roll)
        # () index of the option of "presence": 0 for "there", 1 for "away"
        is_absent = values[f"{name}.presence"]
        if bool(is_absent):
            turn = ABSENT_SCALE * turn
        # without derivatives
        position = base.new_tensor([*stand.position, stand.height])
        absent_depth = ABSENT_DEPTH / self.scene.size_in_metres
        depth = base.new_tensor([0.0, 0.0, absent_depth]) * is_absent
        translation = position - depth - turn @ foot
        return geometry.make_affine(turn, translation) @ base

    def compute_measurements(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Value]:
        """Return the final position of each thing, as in the setting `things`.

        That is in metres from the object's center.
        """
        origin = geometry.compute_center(self.scene)[:2]
        measurements = {}
        for name, stand in self._compute_stands(values, earlier_inputs).items():
            x, y = (stand.position - origin) * self.scene.size_in_metres
            measurements[f"{name}.at_x"] = Value(value=float(x), unit="metres")
            measurements[f"{name}.at_y"] = Value(value=float(y), unit="metres")
        return measurements

    def _compute_stands(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Stand]:
        """Compute where the moved things stand, by name, without derivatives.

        They are placed one after the other, in the order of the scene, and each that is
        present is an obstacle to those after it.

        Args:
            values: values of the control, such as "car.x" and "car.heading".
            earlier_inputs: inputs of earlier controls, which may move obstacles.
        """
        scene = self.scene
        obstacles = self._list_obstacles(earlier_inputs)
        object_center = _compute_outline_center(obstacles[0])  # the object is the first
        solids = [
            solid for part in scene.surrounding_meshes.values() for solid in part.solids
        ]
        stands = {}
        for name in self._moved_things:
            footprint = _compute_footprint(scene, name, earlier_inputs)
            stand, outline = self._find_stand(
                name, values, footprint, object_center, obstacles, solids
            )
            stands[name] = stand
            # index of the option: 0 for "there", 1 for "away"
            is_present = float(values[f"{name}.presence"]) == 0.0
            if is_present:
                obstacles.append(footprint._replace(outline=outline))
        return stands

    def _list_obstacles(
        self, earlier_inputs: Mapping[str, Tensor]
    ) -> list[parts.Footprint]:
        """List the footprints that a thing must not overlap with.

        The first is that of the object, the second that of the camera, and the others
        are those of things that this control does not move. The camera's footprint is
        an octagon, so that nothing stands right in front of it. It reaches from the
        camera's height upwards by its radius: a thing below the camera is allowed.

        Args:
            earlier_inputs: inputs of earlier controls, which may have moved object and
                camera.
        """
        scene = self.scene
        object_footprint = _compute_footprint(scene, "object", earlier_inputs)
        object_center = _compute_outline_center(object_footprint)
        fixed_things = [name for name in scene.things if name not in self._moved_things]
        return [
            object_footprint,
            self._make_camera_footprint(object_center, earlier_inputs),
            *(_compute_footprint(scene, name, earlier_inputs) for name in fixed_things),
        ]

    def _make_camera_footprint(
        self, object_center: assets.Float64Array, earlier_inputs: Mapping[str, Tensor]
    ) -> parts.Footprint:
        """Return the space around the camera in which nothing may stand.

        Args:
            object_center: (2,) the object's center.
            earlier_inputs: inputs of earlier controls, which may have moved the camera.
        """
        camera = geometry.get_camera_pose(self.scene, earlier_inputs)
        camera_position = camera[:3, 3].detach().double().cpu().numpy()
        object_distance = float(np.linalg.norm(camera_position[:2] - object_center))
        clearance = min(
            CAMERA_CLEARANCE / self.scene.size_in_metres,
            CAMERA_CLEARANCE_FRACTION * object_distance,
        )
        octagon = np.stack([np.cos(EIGHT_ANGLES), np.sin(EIGHT_ANGLES)], axis=1)
        camera_height = camera_position[2]
        return parts.Footprint(
            outline=camera_position[:2] + clearance * octagon,
            lower=camera_height,
            upper=camera_height + clearance,
        )

    def _read_numbers(self, name: str, values: Values) -> list[float]:
        """Return the values of a thing in the order of `parameters`.

        They are x, y, heading, and the index of the option of "presence": 0 for "there",
        1 for "away".
        """
        return [
            float(values[f"{name}.{parameter.name}"].detach())
            for parameter in self.parameters
        ]

    def _find_stand(
        self,
        name: str,
        values: Values,
        initial_footprint: parts.Footprint,
        object_center: assets.Float64Array,
        obstacles: Sequence[parts.Footprint],
        solids: Sequence[parts.Solid],
    ) -> tuple[Stand, assets.Float64Array]:
        """Find the free position of one thing, and its outline (K, 2) there.

        A thing that would overlap with something is pushed along the line from the
        object's center through its requested position, see `_find_free_shift`. An
        absent one is not pushed.

        Args:
            name: name of the thing.
            values: values of the control.
            initial_footprint: footprint of the thing in the scene, before it is moved.
            object_center: (2,) the object's center.
            obstacles: footprints that it must not overlap with.
            solids: solids of the surroundings, such as walls.
        """
        scene = self.scene
        x, y, heading, is_absent = self._read_numbers(name, values)
        foot = _find_foot(scene.meshes[name])
        # x and y are metres from where the thing stands in the scene
        requested = foot[:2] + np.array([x, y]) / scene.size_in_metres
        # (K, 2) outline relative to its foot, about which it is turned
        outline = _rotate_outline(initial_footprint.outline - foot[:2], heading)
        direction = _normalize(requested - object_center)
        push_distance = 0.0
        if not is_absent:
            footprint = initial_footprint._replace(outline=outline + requested)
            gap = MIN_GAP / scene.size_in_metres
            push_distance = _find_free_shift(
                footprint, direction, obstacles, solids, gap
            )
        position = requested + push_distance * direction
        height = _compute_height(scene, foot, position)
        return Stand(position, height, push_distance), outline + position


def _compute_outline_center(footprint: parts.Footprint) -> assets.Float64Array:
    """Return the center (2,) of the bounding box of a footprint's outline."""
    outline = footprint.outline
    center: assets.Float64Array = (outline.min(axis=0) + outline.max(axis=0)) / 2.0
    return center


def _rotate_outline(
    outline: assets.Float64Array, degrees: float
) -> assets.Float64Array:
    """Turn corners (K, 2) about the origin, counter-clockwise."""
    angle = np.radians(degrees)
    rotation = np.array(
        [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    )
    return np.asarray(outline @ rotation.T)


def _normalize(vector: assets.Float64Array) -> assets.Float64Array:
    """Return a vector (2,) scaled to length 1; (1, 0) if its length is 0."""
    if not vector.any():
        return np.array([1.0, 0.0])
    return np.asarray(vector / np.linalg.norm(vector))


def _find_free_shift(
    footprint: parts.Footprint,
    direction: assets.Float64Array,
    obstacles: Sequence[parts.Footprint],
    solids: Sequence[parts.Solid],
    gap: float,
) -> float:
    """Find how far a thing has to be shifted along a direction to stand free.

    If it overlaps with solids (e.g. walls) at its requested position, it is first moved
    backwards, towards the object, to just before the first of these. If it overlaps with
    something there, it is moved forwards past each solid or obstacle that it overlaps
    with, in their order along the direction.

    Args:
        footprint: footprint of the thing at the requested position.
        direction: (2,) unit vector away from the object.
        obstacles: footprints that it must not overlap with.
        solids: solids of the surroundings, which it must not overlap with either.
        gap: distance from obstacles and solids that is left free.

    Returns:
        The shift, in scene units; negative if it is backwards.
    """
    # (begin, end) of the interval of shifts at which it overlaps with each
    solid_footprints = [solid.footprint for solid in solids]
    solid_intervals = _find_overlaps(footprint, solid_footprints, direction)
    obstacle_intervals = _find_overlaps(footprint, obstacles, direction)
    shift = _find_shift_before_solids(solid_intervals, gap)
    # In ascending order of their begins: after a shift past an obstacle, the thing can
    # only overlap with those that begin later.
    for begin, end in sorted(obstacle_intervals + solid_intervals):
        if begin < shift < end:
            shift = end + gap
    return shift


def _find_shift_before_solids(
    solid_intervals: Iterable[tuple[float, float]], gap: float
) -> float:
    """Return the shift that moves a thing backwards to just before the first solid.

    Args:
        solid_intervals: (begin, end) of the interval of shifts at which the thing
            overlaps with each solid; the shift is 0 if no interval has 0 inside.
        gap: distance from the solid that is left free.
    """
    # begins of the solids that it overlaps with at the shift 0
    solid_begins = [begin for begin, end in solid_intervals if begin < 0.0 < end]
    return min(solid_begins) - gap if solid_begins else 0.0


def _find_overlaps(
    footprint: parts.Footprint,
    others: Sequence[parts.Footprint],
    direction: assets.Float64Array,
) -> list[tuple[float, float]]:
    """Return the interval of shifts at which a footprint overlaps with each other one.

    The shifts are along a direction (2,), in scene units.
    """
    return [
        geometry.find_overlap_interval(footprint, other, direction) for other in others
    ]


def _compute_height(
    scene: SceneDescription,
    foot: assets.Float64Array,
    position: assets.Float64Array,
) -> float:
    """Return the height (z) of a thing's foot after it was moved over the ground.

    The thing keeps its height above the ground, which need not be flat.

    Args:
        scene: scene with the ground.
        foot: (3,) foot of the thing before.
        position: (2,) new position.
    """
    height_above_ground = foot[2] - scene.get_ground_height(foot[:2])
    height: float = height_above_ground + scene.get_ground_height(position)
    return height


def _find_foot(part: parts.MeshPart) -> assets.Float64Array:
    """Return the point (3,) that a thing is placed by and turned about.

    It is the center of its bounding box, at the height of its lowest point.
    """
    low = part.mesh.vertices.min(axis=0)
    high = part.mesh.vertices.max(axis=0)
    foot = np.array([*(low[:2] + high[:2]) / 2.0, low[2]], np.float64)
    return np.asarray(part.to_world[:3, :3] @ foot + part.to_world[:3, 3])


def _compute_footprint(
    scene: SceneDescription, name: str, earlier_inputs: Mapping[str, Tensor]
) -> parts.Footprint:
    """Return the footprint of a mesh on the ground, after the earlier controls.

    Args:
        scene: the scene.
        name: name of the mesh.
        earlier_inputs: inputs of earlier controls. They may have the mesh's pose
            `<name>.to_world` (4, 4) and offsets of its vertices (N, 3). Those of the
            scene replace missing ones.
    """
    part = scene.meshes[name]
    pose = earlier_inputs.get(f"{name}.to_world")
    offsets = earlier_inputs.get(f"{name}.offsets")
    if pose is None and offsets is None:
        return _compute_initial_footprint(part)
    vertices: assets.Float32Array | assets.Float64Array = part.mesh.vertices
    if offsets is not None:
        vertices = vertices + _to_float64_array(offsets)
    to_world = part.to_world if pose is None else _to_float64_array(pose)
    rotation = to_world[:3, :3]
    translation = to_world[:3, 3]
    return geometry.compute_footprint(vertices @ rotation.T + translation)


def _to_float64_array(tensor: Tensor) -> assets.Float64Array:
    """Return a tensor as an array of double precision, without derivatives."""
    array: assets.Float64Array = tensor.detach().cpu().double().numpy()
    return array


@lru_cache(maxsize=256)
def _compute_initial_footprint(part: parts.MeshPart) -> parts.Footprint:
    return geometry.compute_footprint(geometry.compute_base_vertices(part))
