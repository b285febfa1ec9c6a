"""Axes of a grid: which parameter they move, and over which values.

An axis makes its parameter a discrete choice among its values, so a point of the grid is a point of an ordinary space.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import ndtri
from torch import Tensor

from advsearch.attacks import Block, Domain
from advsearch.attacks.domain import Draws, Product
from advsearch.controls import (
    CONTROLS,
    Control,
    Parameter,
    Space,
    check_instance,
    instance_of,
    unknown_control,
)
from advsearch.controls.base import Value
from advsearch.controls.ranges import Fixed, Number, OneOf, Range, read
from advsearch.errors import InputError, UnknownNameError
from advsearch.options import BY_KEY
from advsearch.runs.results import VariedValue
from advsearch.runs.tables import Units
from advsearch.scene.description import ENVIRONMENT, SceneDescription

MOST_VALUES = 100_000  # values of one axis, at most; more are for draws
TURN = 360.0  # degrees after which a periodic parameter is the same again

_OUTER = {"object": "`object` mug,bowl", "environment": "`environment` studio,noon", "model": "`model` a.pt2,b.pt2"}


@dataclass(frozen=True)
class Axis:
    """One parameter and its values. The instance has the name of its kind unless said otherwise."""

    control: str
    instance: str
    parameter: Parameter
    values: tuple[Number, ...]

    @property
    def name(self) -> str:
        """How it is stored: ``pose.yaw``, or ``key.power`` of a light called key."""
        return f"{self.instance}.{self.parameter.name}"

    @property
    def is_time(self) -> bool:
        return (self.control, self.parameter.name) == ("path", "time")

    @property
    def unit(self) -> str:
        return "name" if self.parameter.options else self.parameter.unit


# ---- reading --------------------------------------------------------------------------------------------------------


def read_axes(grid: Mapping[str, object], controls: Sequence[Control]) -> tuple[Axis, ...]:
    """Return the axes of a grid beside the controls that are drawn by chance: name to values, ``"FIRST:LAST:COUNT"`` or
    a list. A name is KIND.PARAMETER, INSTANCE.PARAMETER of one of `controls`, KIND:INSTANCE.PARAMETER, or mitsuba:KEY.
    """
    instances = {control.name: control for control in controls}
    axes: dict[str, Axis] = {}
    for name, given in grid.items():
        axis = _read_axis(name, given, instances)
        if axis.name in axes:
            raise InputError(f"`grid` {name}: {axis.name} is given twice; leave one of the two out")
        drawn = instances.get(axis.instance)
        if drawn is not None and axis.parameter.name in drawn.specs:
            raise InputError(
                f"`grid` {name}: `controls` {axis.instance} sets {axis.parameter.name} too; leave it out of one "
                "of the two"
            )
        axes[axis.name] = axis
    return tuple(axes.values())


def _read_axis(name: str, given: Any, instances: Mapping[str, Control]) -> Axis:
    head, dot, rest = name.partition(".")
    parameter_name, colon, late = rest.partition(":")
    kind, early_colon, early = head.partition(":")
    instance = head if head in instances else instance_of(kind, late or early)
    if head in _OUTER and not dot:
        raise InputError(f"`grid` {name}: several of them are given as a list: {_OUTER[head]}")
    control: Any = type(instances[instance]) if instance in instances else CONTROLS.get(kind)
    if control is None:
        hint = f"It stands in `grid` {name}; write `grid` CONTROL.PARAMETER=VALUES, such as pose.yaw=0:360:24."
        raise unknown_control(kind, hint, instances)
    if kind == BY_KEY:  # the scene names the parameter, and says later whether there is such a one
        key = name.partition(":")[2]
        if not key:
            raise InputError(f"`grid` {name}: expected Mitsuba's name and values, as in {BY_KEY}:KEY=FIRST:LAST:COUNT")
        (parameter,) = control.declared([key])
        return Axis(BY_KEY, BY_KEY, parameter, axis_values(f"`grid` {name}", parameter, given))
    there = instances[instance].own if instance in instances else ()
    own = {parameter.name: parameter for parameter in (*control.declared({parameter_name: given}), *there)}
    if not parameter_name:
        raise InputError(f"`grid` {name}: expected CONTROL.PARAMETER, got no parameter; choose one of {', '.join(own)}")
    check_instance(f"`grid` {name}", late or early, colon or early_colon)
    if parameter_name not in own:
        raise UnknownNameError(f"parameter of control {control.kind}", parameter_name, list(own), f"In `grid` {name}.")
    parameter = own[parameter_name]
    pictures = any(len(declared.shape) > 1 for declared in control.parameters)
    if pictures or parameter.shape != ():
        raise InputError(
            f"`grid` {name}: expected a parameter that is one number or name, got one that is many numbers; draw it "
            f"by chance with `controls` {instance} `samples=100`"
        )
    return Axis(control.kind, instance, parameter, axis_values(f"`grid` {name}", parameter, given))


def axis_values(where: str, parameter: Parameter, given: Any) -> tuple[Number, ...]:
    """Return the values of an axis, checked, from a text, a value, or a list; errors name `where`.
    ``"FIRST:LAST:COUNT"`` is COUNT values evenly spaced from FIRST to LAST, both included; of a periodic parameter over
    a whole turn, LAST would repeat FIRST and is left out."""
    values: Sequence[Any] = given if isinstance(given, (list, tuple)) else [given]
    if isinstance(given, str) and ":" in given and not parameter.options:
        values = _spaced(where, parameter, given)
    if not values:
        raise InputError(f"{where}: expected at least one value, got none; write FIRST:LAST:COUNT or a list")
    if len(values) > MOST_VALUES:
        raise InputError(_too_many(where, len(values)))
    plain = [one.item() if hasattr(one, "item") else one for one in values]
    spec = read(where, parameter, {"choices": plain})
    assert isinstance(spec, OneOf)
    _check_different(where, parameter, spec.values)
    return spec.values


def _spaced(where: str, parameter: Parameter, text: str) -> list[float]:
    expected = f"{where}: expected FIRST:LAST:COUNT such as 0:360:24, or values separated by commas, got {text!r}"
    parts = text.split(":")
    if len(parts) != 3:
        raise InputError(expected)
    try:
        first, last, count = float(parts[0]), float(parts[1]), int(parts[2])
    except ValueError:
        raise InputError(f"{expected}; FIRST and LAST are numbers and COUNT is a whole number") from None
    if not (math.isfinite(first) and math.isfinite(last)):
        raise InputError(f"{expected}; FIRST and LAST have to be finite")
    if count < 1:
        raise InputError(f"{where}: expected a COUNT of at least 1, got {count} in {text!r}")
    if count > MOST_VALUES:
        raise InputError(_too_many(where, count))
    if last < first:
        raise InputError(f"{where}: the range {text!r} is reversed; write {last:g}:{first:g}:{count}")
    if first == last and count > 1:
        raise InputError(f"{where}: FIRST and LAST are the same in {text!r}; write {first:g} for the one value")
    turns = parameter.periodic and parameter.unit == "degrees"
    if turns and last - first > TURN:
        raise InputError(
            f"{where}: {text!r} is more than a whole turn, so that values would repeat; write "
            f"{first:g}:{first + TURN:g}:{count}"
        )
    whole = turns and last - first == TURN
    return [float(value) for value in np.linspace(first, last, count, endpoint=not whole)]


def _too_many(where: str, count: int) -> str:
    return (
        f"{where}: expected at most {MOST_VALUES} values on an axis, got {count}; draw the parameter by chance "
        "instead, with `controls` and `samples`"
    )


def _check_different(where: str, parameter: Parameter, values: Sequence[Number]) -> None:
    seen: dict[Number, Number] = {}
    for value in values:
        same = value
        if parameter.periodic and parameter.unit == "degrees" and not isinstance(value, str):
            same = round(value % TURN, 9) % TURN
        if same in seen:
            first, again = seen[same], value
            what = f"{_said(again)} twice" if first == again else f"{_said(first)} and {_said(again)}, the same angle"
            raise InputError(f"{where}: expected different values, got {what}; leave one of them out")
        seen[same] = value
    if parameter.options or any(isinstance(value, str) for value in values):
        return
    singles = sorted(np.float32(value) for value in values)
    if any(low == high for low, high in pairwise(singles)):
        raise InputError(
            f"{where}: expected values that differ in single precision, which scenes have; space them wider"
        )


def _said(value: Number) -> str:
    return value if isinstance(value, str) else f"{value:g}"


# ---- putting them into controls -------------------------------------------------------------------------------------


def on_grid(controls: Sequence[Control], axes: Sequence[Axis], scene: SceneDescription) -> tuple[Control, ...]:
    """Return the controls with the axes among their parameters as discrete choices.

    The other parameters of a control that is drawn keep being drawn; those of one that is only in the grid stay as the
    scene has them.
    """
    on = {control.name: control for control in controls}
    for instance in dict.fromkeys(axis.instance for axis in axes):
        own = [axis for axis in axes if axis.instance == instance]
        drawn = on.get(instance)
        kind: Any = CONTROLS[own[0].control] if drawn is None else type(drawn)
        given = {} if drawn is None else _ranges(drawn, scene)
        given |= {axis.parameter.name: {"choices": list(axis.values)} for axis in own}
        on[instance] = kind(name=instance, **given)
    return tuple(on.values())


def _ranges(control: Control, scene: SceneDescription) -> dict[str, object]:
    """Settings of a control with the ranges spelled out that it has by default."""
    given = {name: value for name, value in control.settings().items() if name not in ("kind", "name")}
    if control.asked:
        return given
    there = control.within(scene)
    for parameter in map(there.in_scene, control.parameters):
        if parameter.name not in control.specs and parameter.search is not None:
            options, reach = parameter.options, parameter.search
            given[parameter.name] = {"choices": list(options)} if options else list(reach)
    return given


# ---------------------------------------------------------------------------------------------------------------------
# From the number of a picture to its configuration and what is stored of it: arithmetic, nothing is kept. Every
# picture has a draw of its own, so that pictures are independent; only pairs without and with an adversarial scene have
# the same ones.

MOST_PARTS, FEWEST_PARTS = 10, 2
LEAST_IN_A_CELL = 5
"""Draws that a cell of the map over two drawn parameters has on average, at least, where there are enough."""

MOST_QUASI = 64  # numbers of a group up to which Sobol points are used; more (a texture) are drawn pseudo-randomly
MOST_BINNED = 4  # numbers of a parameter up to which the table shows them
MOST_KEPT = 4096  # descriptions of controls that are kept for points of the grid

Doubles = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Picks:
    """Neighbouring pictures of a scene: the number of the first in the whole sweep; of each, its place on every axis of
    the grid, and shares (n, k) float64 in [0, 1], the coordinates drawn for small parameters."""

    number: int
    digits: list[tuple[int, ...]]
    shares: Doubles


@dataclass(frozen=True)
class Drawn:
    """A drawn number, as the table shows it: its column of `Picks.shares`, and what equal parts of [0, 1] stand for:
    pairs of ends, or values of a list; if `settled`, in every scene. Where values have weights, `shares` says which
    part each of more equal shares stands for."""

    name: str
    unit: str
    column: int
    parts: tuple[Any, ...]
    settled: bool = True
    shares: tuple[int, ...] = ()

    @property
    def varied(self) -> VariedValue:
        ends = [end for part in self.parts if isinstance(part, list) for end in part]
        if ends:
            return VariedValue(unit=self.unit, low=min(ends), high=max(ends))
        return VariedValue(unit=self.unit, names=[str(one) for one in self.parts])

    @property
    def edges(self) -> list[float] | None:
        """The ends of the parts, ascending; None of a list."""
        if not self.settled or not all(isinstance(part, list) for part in self.parts):
            return None
        return sorted({end for part in self.parts for end in part})


def parts_of_ranges(pictures: int) -> int:
    """Return into how many equal parts table, map and page cut the range of a drawn parameter, by the pictures of the
    whole sweep."""
    return min(max(FEWEST_PARTS, math.isqrt(pictures // LEAST_IN_A_CELL)), MOST_PARTS)


class Points:
    """The configurations of one scene `among` several, so many samples at each point of the grid, from a start that is
    the scene as it is. After so many scenes the draws come again, so that what is compared has the same; 0 for never.
    `drawn` is what the table shows of the draws, in `parts` of each range; `drawn_numbers` is the same for all scenes.
    """

    def __init__(
        self,
        space: Space,
        domain: Domain,
        axes: Sequence[Axis],
        samples: int,
        sampler: str,
        seed: int,
        scenes: int = 0,
        among: int = 1,
    ) -> None:
        self.grid = Product(tuple(len(axis.values) for axis in axes))
        self.samples, self.count = samples, self.grid.count * samples
        self.parts = parts_of_ranges(self.count * among)
        frames = next((place for place, axis in enumerate(axes) if axis.is_time), None)
        self.units = Units(self.grid.sizes, frames, samples, again=scenes * self.count)
        self.space, self._axes = space, tuple(axes)
        self._start = domain.start.numpy().astype(np.float64)
        self._lower, self._upper = domain.lower.numpy(), domain.upper.numpy()
        self._places: list[tuple[int, int, int]] = []
        self._small: list[tuple[Block, slice, slice]] = []
        self._large: list[tuple[Block, slice, slice]] = []
        number_of, drawn = {axis.name: number for number, axis in enumerate(axes)}, list[Drawn]()
        controls = {control.name: control for control in space.controls}
        for group, (block, part) in zip(space.groups, domain.parts(), strict=True):
            control = controls[group.control]
            if group.name in number_of:
                number = number_of[group.name]
                self._places.append((part.start, number, self.grid.sizes[number]))
                continue
            into = self._small if block.size <= MOST_QUASI else self._large
            first = into[-1][2].stop if into else 0
            into.append((block, part, slice(first, first + block.size + (block.norm == "l2"))))
            if block.size <= MOST_BINNED and block.norm != "l2" and control.slots:
                drawn += self._shown(control, group.parameter, block, part, first)
        self.drawn = tuple(drawn)
        small, large = (chosen[-1][2].stop if chosen else 0 for chosen in (self._small, self._large))
        self._columns = [one.column for one in self.drawn]
        self._sizes = np.array([len(one.shares or one.parts) for one in self.drawn], dtype=np.int64)
        self._draws = Draws(small, sampler, seed)
        self._noise = Draws(large, "random", seed, "large draws")
        self.drawn_numbers = (small, tuple((one.name, one.column, len(one.parts)) for one in self.drawn))
        self._described: dict[tuple[object, ...], Mapping[str, Value]] = {}

    def _shown(self, control: Control, name: str, block: Block, part: slice, first: int) -> list[Drawn]:
        parameter, spec = _spec(control, name)
        full = f"{control.name}.{name}"
        if isinstance(spec, OneOf):
            values = tuple(dict.fromkeys(spec.values))
            shares = () if values == spec.values else tuple(map(values.index, spec.values))
            return [Drawn(full, _unit(parameter), first, values, shares=shares)]
        found = []
        for number in range(block.size):
            low, high = (float(ends[part.start + number]) for ends in (self._lower, self._upper))
            places = torch.linspace(low, high, self.parts + 1, dtype=torch.float64)
            edges = spec.at(places, log=parameter.log).tolist()
            parts = tuple([edges[k], edges[k + 1]] for k in range(self.parts))
            found.append(Drawn(full + (f".{number}" if parameter.shape else ""), parameter.unit, first + number, parts))
        return found

    # ---- from numbers to configurations -----------------------------------------------------------------------------

    def picks(self, first: int, count: int, before: int = 0) -> Picks:
        """Return the pictures from number `first` of the scene on; `before` is how many the scenes before it have."""
        digits = [self.grid.digits(number // self.samples) for number in range(first, first + count)]
        return Picks(before + first, digits, self._drawn(self._draws, before + first, count))

    def parts_of(self, first: int, count: int) -> NDArray[np.int64]:
        """Return in which part of each of the `drawn` numbers neighbouring pictures of a scene lie, (count, k), by the
        number of the first in the whole sweep."""
        shares = self._drawn(self._draws, first, count)
        parts = np.minimum((shares[:, self._columns] * self._sizes).astype(np.int64), self._sizes - 1)
        for number, one in enumerate(self.drawn):
            if one.shares:
                parts[:, number] = np.take(one.shares, parts[:, number])
        return parts

    @property
    def draws(self) -> bool:
        """Whether anything is drawn: not where controls have all from the grid, as a path its time."""
        return self._draws.dimensions + self._noise.dimensions > 0

    def noise(self, number: int) -> int:
        """Return the number of the noise of the picture with this number in the whole sweep."""
        return number % self.units.again if self.units.again else number

    def _drawn(self, draws: Draws, first: int, count: int) -> Doubles:
        """The draws of neighbouring pictures of the whole sweep."""
        if self.units.frames is None:
            return draws.points(self.units.draw(first), count)
        each = [draws.points(self.units.draw(number), 1) for number in range(first, first + count)]
        return np.concatenate(each) if each else draws.points(0, 0)

    def configurations(self, picks: Picks) -> Tensor:
        u = np.repeat(self._start[None], len(picks.digits), axis=0)
        for column, number, size in self._places:
            u[:, column] = [(digits[number] + 0.5) / size for digits in picks.digits]
        for block, part, columns in self._small:
            u[:, part] = self._placed(block, part, picks.shares[:, columns])
        if self._large:
            noise = self._drawn(self._noise, picks.number, len(picks.digits))
            for block, part, columns in self._large:
                u[:, part] = self._placed(block, part, noise[:, columns])
        return torch.from_numpy(np.clip(u.astype(np.float32), self._lower, self._upper))

    def _placed(self, block: Block, part: slice, shares: Doubles) -> Doubles:
        """Coordinates inside the budget from uniform shares: uniform in the box, or in the ball (Muller 1959)."""
        if block.options:
            return np.asarray((np.minimum(np.floor(shares * block.options), block.options - 1) + 0.5) / block.options)
        if block.norm != "l2" or block.epsilon is None:
            low, high = self._lower[part].astype(np.float64), self._upper[part].astype(np.float64)
            return np.asarray(low + (high - low) * shares)
        direction = ndtri(np.clip(shares[:, :-1], 1e-12, 1.0 - 1e-12))
        length = block.epsilon * shares[:, -1:] ** (1.0 / block.size)
        norm = np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-30)
        return np.asarray(self._start[part] + direction * (length / norm))

    @property
    def environment(self) -> str | None:
        """What lights all pictures in the place of the scene's environment; None if that does, or if it varies."""
        varies = any(group.setting == ENVIRONMENT for group in self.space.groups)
        return None if varies else self.space.environment

    def values(self, u: Tensor, picks: Picks) -> list[dict[str, Value]]:
        """Return what is stored of the pictures: parameter to value and unit, as `Space.describe` says it. One of the
        grid has the value that was listed, not what single precision makes of it."""
        rows: list[dict[str, Value]] = [{} for _ in picks.digits]
        for control, own in zip(self.space.controls, u.split(self.space.sizes, dim=1), strict=True):
            if (type(control).describe, type(control).measured) == (Control.describe, Control.measured):
                for name, column in self._by_column(control, own, picks):
                    for row, value in zip(rows, column, strict=True):
                        row[name] = value
            else:
                for row, whole, part, digits in zip(rows, u, own, picks.digits, strict=True):
                    row |= self._description(control, whole, part, digits)
        return rows

    def _by_column(self, control: Control, own: Tensor, picks: Picks) -> Iterator[tuple[str, list[Value]]]:
        """Values of all configurations at once, parameter by parameter; the same numbers as `describe`."""
        axes, begin = {axis.name: (number, axis) for number, axis in enumerate(self._axes)}, 0
        for group in control.groups:
            name, columns = f"{control.name}.{group.parameter}", own[:, begin : begin + group.size].T
            begin += group.size
            if name in axes:
                number, axis = axes[name]
                yield name, [{"value": axis.values[digits[number]], "unit": axis.unit} for digits in picks.digits]
                continue
            parameter, spec = _spec(control, group.parameter)
            for number, column in enumerate(columns):
                full, values = name, list[Any]()
                if isinstance(spec, OneOf):
                    count = len(spec.values)
                    values = [spec.values[min(count - 1, int(share * count))] for share in column.tolist()]
                else:
                    values = spec.at(column, log=parameter.log).tolist()
                    full += f".{number}" if parameter.shape else ""
                yield full, [{"value": value, "unit": _unit(parameter)} for value in values]

    def _description(
        self, control: Control, whole: Tensor, own: Tensor, digits: tuple[int, ...]
    ) -> Mapping[str, Value]:
        """What the control itself says of one configuration; kept for the next time if axes are all that it depends
        on."""
        listed = [(axis, digits[number]) for number, axis in enumerate(self._axes) if axis.instance == control.name]
        key = (control.name, *(place for _, place in listed))
        if key in self._described:
            return self._described[key]
        said = dict(self.space.describe(whole, (control,)) if control.refines else control.describe(own))
        for axis, place in listed:
            said[axis.name] = {"value": axis.values[place], "unit": axis.unit}
        if not control.refines and len(listed) == len(control.groups) and len(self._described) < MOST_KEPT:
            self._described[key] = said
        return said


def _unit(parameter: Parameter) -> str:
    return "name" if parameter.options else parameter.unit


def _spec(bound: Control, name: str) -> tuple[Parameter, Range | OneOf]:
    slot = next(slot for slot in bound.slots if slot.parameter.name == name)
    assert not isinstance(slot.spec, Fixed)
    return slot.parameter, slot.spec
