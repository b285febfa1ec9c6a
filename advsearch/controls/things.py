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

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from functools import lru_cache, partial
from itertools import product
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

GAP = 0.01  # metres between a thing that was moved away and what it would have stood in
CAMERA = 0.3
NEAR = 0.05
"""Metres around the camera that stay free of what is as high; at most that share of its
distance to the object.
"""
EIGHTHS = np.arange(8) * np.pi / 4.0
AWAY = 1e-5  # size of a thing that is away, and how many metres it lies in the ground
SUNK = 0.01
_moving = partial(Parameter.moving, Parameter.ORBIT)


class Stand(NamedTuple):
    """Where a thing stands, in the coordinates of the scene."""

    place: assets.Doubles  # (2,) of its middle
    height: float  # of the ground there
    pushed: float  # how far it was moved away from the object


class ThingsControl(Control):
    """Where the things beside the object stand, how they are turned, and whether they
    are there.
    """

    kind = "things"
    parameters = (
        _moving("x", "metres", -1000.0, 1000.0, 0.0, "Forwards from where it was put.", (-2.0, 2.0)),
        _moving("y", "metres", -1000.0, 1000.0, 0.0, "To the left of where it was put.", (-2.0, 2.0)),
        _moving("heading", "degrees", -3600.0, 3600.0, 0.0, "Turn from how it was put, "
                                                            "counter-clockwise.",
                (-180.0, 180.0), periodic=True),
        Parameter.named("presence", ("there", "away"), "there", "Whether it is there.", estimators=("differences",),
                        moves_silhouettes=True),
    )  # fmt: skip

    @classmethod
    def declared(cls, settings: Iterable[str]) -> tuple[Parameter, ...]:
        """Return the parameters for all things, and those that are set for one, such as
        `person.x`.
        """
        names = {one.name: one for one in cls.parameters}
        split = [(one, one.rpartition(".")[2]) for one in settings if "." in one]
        return (
            *cls.parameters,
            *(replace(names[last], name=one) for one, last in split if last in names),
        )

    def fit(self) -> None:
        things = self.scene.things
        if not things:
            raise InputError(
                f"`controls` {self.name}: nothing stands beside the "
                "object; add `things`, such as car@6,3"
            )
        for name in (one.rpartition(".")[0] for one in self.specs):
            if name and name not in things:
                raise errors.UnknownNameError(
                    f"`controls` {self.name}: thing beside the object", name, things
                )
        super().fit()
        asked = set()
        for slot in self.slots:
            thing, _, short = slot.parameter.name.rpartition(".")
            if slot.width or slot.parameter.name in self.specs or short in self.specs:
                asked.add(thing)
        # the others stay, or another control moves them
        self._moved = tuple(name for name in things if name in asked)
        as_put = {slot.parameter.name: torch.zeros(()) for slot in self.slots}
        for name, stand in self._stands(as_put, {}).items():
            if stand.pushed:
                raise InputError(
                    f"`controls` {self.name}: {name} stands in something "
                    "else; put it elsewhere"
                )

    def laid_out(self) -> Iterator[tuple[Parameter, Fixed | Range | OneOf]]:
        for thing, parameter in product(
            self.scene.things, map(self.in_scene, self.parameters)
        ):
            asked = f"{thing}.{parameter.name}"
            yield (
                replace(parameter, name=asked),
                self.specs.get(asked, self.spec(parameter)),
            )

    def in_scene(self, parameter: Parameter) -> Parameter:
        # beside a small thing, two metres are off its table
        reach = min(2.0, self.scene.metres)
        return (
            replace(parameter, search=(-reach, reach))
            if parameter.name in ("x", "y")
            else parameter
        )

    @property
    def refines(self) -> frozenset[str]:
        """None is changed; but it comes after whatever moves what things may not stand
        in.
        """
        stay = [name for name in self.scene.things if name not in self._moved]
        poses = [f"{name}.to_world" for name in ("object", "camera", *stay)]
        return frozenset(
            [*poses, *(f"{name}.offsets" for name in ("object", *self.scene.things))]
        )

    def scene_inputs(
        self, values: Values, so_far: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        inputs = {}
        for name, stand in self._stands(values, so_far).items():
            part = self.scene.meshes[name]
            base = torch.from_numpy(part.to_world).to(values[f"{name}.x"])
            foot = torch.from_numpy(_foot(part)).to(base)
            turn = geometry.euler(values[f"{name}.heading"], *base.new_zeros(2))
            if values[f"{name}.presence"]:
                turn = AWAY * turn
            place = base.new_tensor([*stand.place, stand.height])
            sunk = (
                base.new_tensor([0.0, 0.0, SUNK / self.scene.metres])
                * values[f"{name}.presence"]
            )
            inputs[f"{name}.to_world"] = (
                geometry.affine(turn, place - sunk - turn @ foot) @ base
            )
        return inputs

    def measured(
        self, values: Values, so_far: Mapping[str, Tensor]
    ) -> dict[str, Value]:
        """Where each thing stands in the end, as `with` says places."""
        return {
            f"{name}.at_{axis}": Value(value=float(coordinate), unit="metres")
            for name, stand in self._stands(values, so_far).items()
            for axis, coordinate in zip(
                "xy",
                (stand.place - geometry.middle(self.scene)[:2]) * self.scene.metres,
                strict=True,
            )
        }

    def _stands(self, values: Values, so_far: Mapping[str, Tensor]) -> dict[str, Stand]:
        """Where the things that move stand, by name; without derivatives."""
        scene = self.scene
        metres = self.scene.metres
        thing = _footprint(scene, "object", so_far)
        eye = geometry.camera_in(scene, so_far)[:3, 3].detach().double().cpu().numpy()
        middle_of = (thing.outline.min(axis=0) + thing.outline.max(axis=0)) / 2.0
        free = min(CAMERA / metres, NEAR * float(np.linalg.norm(eye[:2] - middle_of)))
        around = eye[:2] + free * np.stack([np.cos(EIGHTHS), np.sin(EIGHTHS)], axis=1)
        others = [thing, parts.Footprint(around, eye[2], eye[2] + free)]
        others += [
            _footprint(scene, name, so_far)
            for name in scene.things
            if name not in self._moved
        ]
        solids = [solid for part in scene.around.values() for solid in part.solids]
        stands = {}
        for name in self._moved:
            x, y, heading, away = (
                float(values[f"{name}.{one.name}"].detach()) for one in self.parameters
            )
            foot = _foot(scene.meshes[name])
            base = _footprint(scene, name, so_far)
            angle = np.radians(heading)
            turn = np.array(
                [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
            )
            asked = foot[:2] + np.array([x, y]) / metres
            outline = (base.outline - foot[:2]) @ turn.T
            lift = foot[2] - scene.ground_height(foot[:2])
            here = parts.Footprint(outline + asked, base.low, base.high)
            way = asked - middle_of
            way = way / np.linalg.norm(way) if way.any() else np.array([1.0, 0.0])
            pushed = 0.0
            in_solids = (
                []
                if away
                else [geometry.blocked(here, solid.footprint, way) for solid in solids]
            )
            if any(begin < 0.0 < end for begin, end in in_solids):
                pushed = (
                    min(begin for begin, end in in_solids if begin < 0.0 < end)
                    - GAP / metres
                )
            in_others = (
                [] if away else [geometry.blocked(here, other, way) for other in others]
            )
            for begin, end in sorted(in_others + in_solids):
                if begin < pushed < end:
                    pushed = end + GAP / metres
            place = asked + pushed * way
            stands[name] = Stand(place, lift + scene.ground_height(place), pushed)
            if not away:
                others.append(parts.Footprint(outline + place, base.low, base.high))
        return stands


def _foot(part: parts.MeshPart) -> assets.Doubles:
    """Where a thing is put and turned about, (3,): the middle of its box, at the height
    of its lowest point.
    """
    low = part.mesh.vertices.min(axis=0)
    high = part.mesh.vertices.max(axis=0)
    foot = np.array([*(low[:2] + high[:2]) / 2.0, low[2]], np.float64)
    return np.asarray(part.to_world[:3, :3] @ foot + part.to_world[:3, 3])


def _footprint(
    scene: SceneDescription, name: str, so_far: Mapping[str, Tensor]
) -> parts.Footprint:
    """What a mesh takes up where the controls before have it."""
    part = scene.meshes[name]
    pose, offsets = (so_far.get(f"{name}.{one}") for one in ("to_world", "offsets"))
    if pose is None and offsets is None:
        return _as_put(part)
    vertices = part.mesh.vertices + (
        0.0 if offsets is None else offsets.detach().cpu().double().numpy()
    )
    matrix = part.to_world if pose is None else pose.detach().cpu().double().numpy()
    return geometry.footprint(vertices @ matrix[:3, :3].T + matrix[:3, 3])


@lru_cache(maxsize=256)
def _as_put(part: parts.MeshPart) -> parts.Footprint:
    return geometry.footprint(geometry.standing(part))
