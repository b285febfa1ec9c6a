"""The `things` control: where the things beside the object stand, how they are turned,
and whether they are there.

    place = where it was put + (x, y) + away * t,    t >= 0 the least at which it stands free

`away` points from the object to the thing. Free is what overlaps with no other outline
on the ground: the object's, the camera's, those of things that stay, and those of
things before it in the list. Two convex outlines of which one moves straight on overlap
over one stretch of its way, so that t is exact. A thing that would stand in a solid of
the place, a house or a lamp post, first goes back towards the object until it is free
of it.
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

MIN_GAP = (
    0.01  # metres between a thing that was moved away and what it would have stood in
)
CAMERA_CLEARANCE = 0.3
CAMERA_CLEARANCE_FRACTION = 0.05
"""Metres around the camera that stay free of what is as high; at most that share of its
distance to the object.
"""
EIGHTHS = np.arange(8) * np.pi / 4.0
ABSENT_SCALE = (
    1e-5  # size of a thing that is away, and how many metres it lies in the ground
)
ABSENT_DEPTH = 0.01
_moving = partial(Parameter.moving, Parameter.ORBIT)


class Stand(NamedTuple):
    """Where a thing stands, in the coordinates of the scene."""

    position: assets.Float64Array  # (2,) of its center
    height: float  # of the ground there
    push_distance: float  # how far it was moved away from the object


class ThingsControl(Control):
    """Where the things beside the object stand, how they are turned, and whether they
    are there.
    """

    kind = "things"
    parameters = (
        _moving(
            "x",
            "metres",
            -1000.0,
            1000.0,
            0.0,
            "Forwards from where it was put.",
            (-2.0, 2.0),
        ),
        _moving(
            "y",
            "metres",
            -1000.0,
            1000.0,
            0.0,
            "To the left of where it was put.",
            (-2.0, 2.0),
        ),
        _moving(
            "heading",
            "degrees",
            -3600.0,
            3600.0,
            0.0,
            "Turn from how it was put, counter-clockwise.",
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
        """Return the parameters for all things, and those set for one (`person.x`)."""
        parameter_by_name = {parameter.name: parameter for parameter in cls.parameters}
        single = []
        for setting in settings:
            _, dot, short_name = setting.rpartition(".")
            if dot and short_name in parameter_by_name:
                single.append(replace(parameter_by_name[short_name], name=setting))
        return (*cls.parameters, *single)

    def fit(self) -> None:
        """Find which things this control moves, and check that they stand free.

        Raises:
            InputError: nothing stands beside the object, or a thing stands in another.
            UnknownNameError: a parameter is about a thing that the scene has not.
        """
        things = self.scene.things
        if not things:
            raise InputError(
                f"`controls` {self.name}: nothing stands beside the "
                "object; add `things`, such as car@6,3"
            )
        for parameter_name in self.specs:
            thing = parameter_name.rpartition(".")[0]
            if thing and thing not in things:
                raise errors.UnknownNameError(
                    f"`controls` {self.name}: thing beside the object", thing, things
                )
        super().fit()
        moved = set()
        for slot in self.slots:
            thing, _, short_name = slot.parameter.name.rpartition(".")
            is_set = slot.parameter.name in self.specs or short_name in self.specs
            if slot.n_coordinates or is_set:
                moved.add(thing)
        # the others stay, or another control moves them
        self._moved_things = tuple(name for name in things if name in moved)
        unmoved = {slot.parameter.name: torch.zeros(()) for slot in self.slots}
        for name, stand in self._compute_stands(unmoved, {}).items():
            if stand.push_distance:
                raise InputError(
                    f"`controls` {self.name}: {name} stands in something "
                    "else; put it elsewhere"
                )

    def list_parameter_specs(self) -> Iterator[tuple[Parameter, Fixed | Range | OneOf]]:
        """Yield the parameters of each thing, which those for all things apply to."""
        for thing in self.scene.things:
            for parameter in map(self.resolve_parameter, self.parameters):
                name = f"{thing}.{parameter.name}"
                spec = self.specs.get(name, self.get_spec(parameter))
                yield replace(parameter, name=name), spec

    def resolve_parameter(self, parameter: Parameter) -> Parameter:
        """Return a parameter, with a range of positions that is not larger than a
        table.
        """
        if parameter.name not in ("x", "y"):
            return parameter
        # beside a small thing, two metres are off its table
        reach = min(2.0, self.scene.metres)
        return replace(parameter, search=(-reach, reach))

    @property
    def refines(self) -> frozenset[str]:
        """Inputs that this control reads and does not change.

        So it comes after whatever moves what things may not stand in.
        """
        fixed = [name for name in self.scene.things if name not in self._moved_things]
        poses = [f"{name}.to_world" for name in ("object", "camera", *fixed)]
        offsets = [f"{name}.offsets" for name in ("object", *self.scene.things)]
        return frozenset([*poses, *offsets])

    def scene_inputs(
        self, values: Values, so_far: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Return the pose of each thing that this control moves."""
        inputs = {}
        for name, stand in self._compute_stands(values, so_far).items():
            part = self.scene.meshes[name]
            base = torch.from_numpy(part.to_world).to(values[f"{name}.x"])
            foot = torch.from_numpy(_foot(part)).to(base)
            turn = geometry.make_euler_rotation(
                values[f"{name}.heading"], *base.new_zeros(2)
            )
            is_absent = values[f"{name}.presence"]
            if is_absent:
                turn = ABSENT_SCALE * turn
            position = base.new_tensor([*stand.position, stand.height])
            sunk = (
                base.new_tensor([0.0, 0.0, ABSENT_DEPTH / self.scene.metres])
                * is_absent
            )
            translation = position - sunk - turn @ foot
            inputs[f"{name}.to_world"] = geometry.make_affine(turn, translation) @ base
        return inputs

    def measured(
        self, values: Values, so_far: Mapping[str, Tensor]
    ) -> dict[str, Value]:
        """Return where each thing stands in the end, as the setting `things` has it."""
        origin = geometry.compute_center(self.scene)[:2]
        measurements = {}
        for name, stand in self._compute_stands(values, so_far).items():
            x, y = (stand.position - origin) * self.scene.metres
            measurements[f"{name}.at_x"] = Value(value=float(x), unit="metres")
            measurements[f"{name}.at_y"] = Value(value=float(y), unit="metres")
        return measurements

    def _compute_stands(
        self, values: Values, so_far: Mapping[str, Tensor]
    ) -> dict[str, Stand]:
        """Compute where the things that move stand, by name; without derivatives."""
        scene = self.scene
        obstacles = self._list_obstacles(so_far)
        object_outline = obstacles[0].outline
        object_center = (object_outline.min(axis=0) + object_outline.max(axis=0)) / 2.0
        solids = [
            solid for part in scene.surrounding_meshes.values() for solid in part.solids
        ]
        stands = {}
        for name in self._moved_things:
            base = _footprint(scene, name, so_far)
            stand, outline = self._find_stand(
                name, values, base, object_center, obstacles, solids
            )
            stands[name] = stand
            if not values[f"{name}.presence"]:
                obstacles.append(parts.Footprint(outline, base.lower, base.upper))
        return stands

    def _list_obstacles(self, so_far: Mapping[str, Tensor]) -> list[parts.Footprint]:
        """List what a thing may not stand in: the object first, the camera, other
        things.

        Things that move are not among them yet.
        """
        scene = self.scene
        tested = _footprint(scene, "object", so_far)
        object_center = (tested.outline.min(axis=0) + tested.outline.max(axis=0)) / 2.0
        camera = geometry.get_camera_pose(scene, so_far)
        eye = camera[:3, 3].detach().double().cpu().numpy()
        object_distance = float(np.linalg.norm(eye[:2] - object_center))
        clearance = min(
            CAMERA_CLEARANCE / scene.metres, CAMERA_CLEARANCE_FRACTION * object_distance
        )
        circle = np.stack([np.cos(EIGHTHS), np.sin(EIGHTHS)], axis=1)
        around_camera = parts.Footprint(
            eye[:2] + clearance * circle, eye[2], eye[2] + clearance
        )
        fixed_things = [name for name in scene.things if name not in self._moved_things]
        return [
            tested,
            around_camera,
            *(_footprint(scene, name, so_far) for name in fixed_things),
        ]

    def _read_numbers(self, name: str, values: Values) -> list[float]:
        """Return the values of a thing's parameters, without derivatives."""
        return [
            float(values[f"{name}.{parameter.name}"].detach())
            for parameter in self.parameters
        ]

    def _find_stand(
        self,
        name: str,
        values: Values,
        base: parts.Footprint,
        object_center: assets.Float64Array,
        obstacles: Sequence[parts.Footprint],
        solids: Sequence[parts.Solid],
    ) -> tuple[Stand, assets.Float64Array]:
        """Find the free position of one thing, and its outline (K, 2) there.

        Args:
            name: of the thing.
            values: of the control.
            base: what the thing takes up before it is moved.
            object_center: (2,) that it is pushed away from.
            obstacles: which it may not stand in; it goes away from the object.
            solids: of the place, which it goes towards the object for.
        """
        scene = self.scene
        x, y, heading, is_absent = self._read_numbers(name, values)
        foot = _foot(scene.meshes[name])
        requested = foot[:2] + np.array([x, y]) / scene.metres
        outline = _rotate_outline(base.outline - foot[:2], heading)
        direction = _unit_direction(requested - object_center)
        pushed = 0.0
        if not is_absent:
            footprint = parts.Footprint(outline + requested, base.lower, base.upper)
            gap = MIN_GAP / scene.metres
            pushed = _find_free_shift(footprint, direction, obstacles, solids, gap)
        position = requested + pushed * direction
        height = _compute_height(scene, foot, position)
        return Stand(position, height, pushed), outline + position


def _rotate_outline(
    outline: assets.Float64Array, degrees: float
) -> assets.Float64Array:
    """Turn corners (K, 2) about the origin, counter-clockwise."""
    angle = np.radians(degrees)
    rotation = np.array(
        [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    )
    return np.asarray(outline @ rotation.T)


def _unit_direction(vector: assets.Float64Array) -> assets.Float64Array:
    """Return the direction (2,) of a vector; +x for one of length 0."""
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
    """Find how far something is shifted along a direction so that it stands free.

    Args:
        footprint: what it takes up where it was put.
        direction: (2,) unit vector away from the object.
        obstacles: which it goes forwards for, along the direction.
        solids: which it first goes backwards for, where it stands in one.
        gap: that stays free.
    """
    in_solids = [
        geometry.find_overlap_interval(footprint, solid.footprint, direction)
        for solid in solids
    ]
    in_obstacles = [
        geometry.find_overlap_interval(footprint, obstacle, direction)
        for obstacle in obstacles
    ]
    shift = 0.0
    solid_begins = [begin for begin, end in in_solids if begin < 0.0 < end]
    if solid_begins:
        shift = min(solid_begins) - gap
    for begin, end in sorted(in_obstacles + in_solids):
        if begin < shift < end:
            shift = end + gap
    return shift


def _compute_height(
    scene: SceneDescription,
    foot: assets.Float64Array,
    position: assets.Float64Array,
) -> float:
    """Return the height at a position (2,) of a thing that is as far above the ground
    there.

    `foot` is the point (3,) that it stands at so far.
    """
    height_above_ground = foot[2] - scene.get_ground_height(foot[:2])
    height: float = height_above_ground + scene.get_ground_height(position)
    return height


def _foot(part: parts.MeshPart) -> assets.Float64Array:
    """Return the point (3,) that a thing is put at and turned about.

    It is the center of its box, at the height of its lowest point.
    """
    low = part.mesh.vertices.min(axis=0)
    high = part.mesh.vertices.max(axis=0)
    foot = np.array([*(low[:2] + high[:2]) / 2.0, low[2]], np.float64)
    return np.asarray(part.to_world[:3, :3] @ foot + part.to_world[:3, 3])


def _footprint(
    scene: SceneDescription, name: str, so_far: Mapping[str, Tensor]
) -> parts.Footprint:
    """Return what a mesh takes up where the controls before have put it."""
    part = scene.meshes[name]
    pose = so_far.get(f"{name}.to_world")
    offsets = so_far.get(f"{name}.offsets")
    if pose is None and offsets is None:
        return _initial_footprint(part)
    vertices = part.mesh.vertices + 0.0
    if offsets is not None:
        vertices = part.mesh.vertices + offsets.detach().cpu().double().numpy()
    matrix = part.to_world
    if pose is not None:
        matrix = pose.detach().cpu().double().numpy()
    return geometry.compute_footprint(vertices @ matrix[:3, :3].T + matrix[:3, 3])


@lru_cache(maxsize=256)
def _initial_footprint(part: parts.MeshPart) -> parts.Footprint:
    return geometry.compute_footprint(geometry.compute_base_vertices(part))
