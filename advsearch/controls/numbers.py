"""Controls that are a handful of named numbers: each fixed, a range, or a list (see `values`).

Subclass `NumberControl`, declare the parameters, and say in `scene_inputs` what they do to the scene:

    class Exposure(NumberControl):
        kind = "exposure"
        summary = "How bright the picture is."
        parameters = (Parameter("stops", (), "stops", -10, 10, 0.0, "Over the metered exposure.", search=(-2, 2)),)

        def scene_inputs(self, values, so_far):
            return {"camera.exposure": values["stops"]}
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import Any, ClassVar

import torch
from torch import Tensor

from advsearch.controls.base import (
    NOTHING,
    WHOLE_RANGE,
    Budget,
    Control,
    Fixed,
    Group,
    Moved,
    Number,
    OneOf,
    Parameter,
    Spec,
    Value,
    apart,
    check_start,
    in_words,
    measure,
    nearest,
    option_index,
    same,
    to_unit,
    to_value,
)
from advsearch.controls.ranges import Range
from advsearch.copies import hand_copies
from advsearch.errors import InputError
from advsearch.scene.description import ENVIRONMENT

Values = Mapping[str, Tensor]
"""A configuration: parameter name to a float32 tensor of the parameter's shape; of a discrete choice, its number."""


@dataclass(frozen=True)
class Slot:
    """One parameter in a bound control: what it is set to, its numbers and where its coordinates begin."""

    parameter: Parameter
    spec: Spec
    size: int
    default: Number
    begin: int = 0

    @property
    def width(self) -> int:
        """Number of coordinates of u."""
        return 0 if isinstance(self.spec, Fixed) else 1 if isinstance(self.spec, OneOf) else self.size

    @property
    def turns(self) -> bool:
        """Whether a whole turn changes nothing."""
        return self.parameter.periodic and self.parameter.unit == "degrees"

    @property
    def periodic(self) -> bool:
        """Whether the range is a whole turn."""
        spec, parameter = self.spec, self.parameter
        return parameter.periodic and type(spec) is Range and abs(spec.high - spec.low - 360.0) < 1e-9

    def start_value(self) -> Number:
        """The default, or the nearest value that is allowed; of names, the first one that is allowed."""
        spec, default = self.spec, self.default
        if isinstance(spec, Fixed):
            return spec.value
        if isinstance(spec, Range):
            return nearest(float(default), spec.low, spec.high, turns=self.turns)
        if default in spec.values or any(isinstance(value, str) for value in (default, *spec.values)):
            return default if default in spec.values else spec.values[0]
        return min(spec.values, key=lambda value: apart(float(value), float(default), turns=self.turns))

    def start(self) -> list[float]:
        """Coordinates of that value."""
        spec, value = self.spec, self.start_value()
        if isinstance(spec, Fixed):
            return []
        if isinstance(spec, OneOf):
            return [(spec.values.index(value) + 0.5) / len(spec.values)]
        return [to_unit(spec, self.parameter.log, float(value))] * self.size


class NumberControl(Control):
    """A control made of named numbers and choices.

    Once one parameter is given a range or a list, only those given so are searched; otherwise each parameter is
    searched over its own `search` range, if it has one. Of a picture among the parameters, the numbers are not said one
    by one.

    Attributes:
        slots: once bound, each parameter with what it is set to, in the order of its coordinates.
    """

    slots: tuple[Slot, ...]
    amount: ClassVar[str | None] = None
    """The parameter whose value in the scene as it was described means that the rest of the control does not show: the
    power of a lamp, say. None where the scene has all parameters of itself."""

    def __init_subclass__(cls, **more: Any) -> None:
        super().__init_subclass__(**more)
        asked = ("scene_inputs", "on_picture", "measured", "kept_pictures", "kept_files")
        hand_copies(cls, **dict.fromkeys(asked, slice(None)))

    def allowed(self, parameter: str, *otherwise: Number) -> tuple[Number, ...]:
        """Return the values, one by one, that a parameter was set to; others where nothing was said of it."""
        spec = self.specs.get(parameter)
        return spec.values if isinstance(spec, OneOf) else (spec.value,) if isinstance(spec, Fixed) else otherwise

    def named(self, parameter: str) -> Parameter:
        """Return its parameter of a name."""
        return next(declared for declared in self.own if declared.name == parameter)

    def searches(self, parameter: str) -> bool:
        """Return whether a parameter with a range of its own is among what is searched."""
        return not isinstance(self.specs[parameter], Fixed) if parameter in self.specs else not self.asked

    # ---- what a subclass says, in `self.scene` ----------------------------------------------------------------------

    def in_scene(self, parameter: Parameter) -> Parameter:
        """Return a parameter as this scene has it, where its unit depends on that."""
        return parameter

    def default(self, parameter: Parameter) -> Number:
        """Return a parameter's value in the unchanged scene: the setting of that name, or else its own default."""
        value = self.scene.values.get(self.setting(parameter))
        return parameter.default if value is None else value

    def unchanged(self, parameter: Parameter) -> Number:
        """Return a parameter's value in the scene as it was described: the default, unless that changes the scene."""
        return self.default(parameter)

    def size(self, parameter: Parameter) -> int:
        """Return how many numbers a parameter has: by default the product of its shape."""
        return math.prod(side or 1 for side in parameter.shape)

    def search_range(self, parameter: Parameter) -> tuple[float, float] | None:
        """Return the range searched when nothing is said about a parameter, or None to leave it at its default."""
        return parameter.search

    def budget_of(self, parameter: Parameter) -> Budget:
        """Return how far a searched parameter may go: by default its whole range."""
        return WHOLE_RANGE

    def estimators(self, parameter: Parameter) -> tuple[str, ...]:
        """Return the valid estimators of a parameter in this scene, preferred first."""
        return parameter.estimators

    def scene_inputs(self, values: Values, so_far: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return what the values do to the scene; differentiable torch operations."""
        return {}

    def on_picture(self, values: Values, image: Tensor) -> Tensor:
        """Return what the values make of the finished picture (H, W, 3) sRGB; differentiable in both."""
        return image

    def measured(self, values: Values, so_far: Mapping[str, Tensor]) -> dict[str, Value]:
        """Return further values worth storing with a configuration, by name without the instance's."""
        return {}

    def kept_pictures(self, values: Values, so_far: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return pictures worth keeping, by file stem: (h, w, 3) sRGB in [0, 1]."""
        return {}

    def kept_files(self, values: Values, so_far: Mapping[str, Tensor]) -> dict[str, bytes]:
        """Return other files worth keeping, by name with ending."""
        return {}

    # ---- what it makes of it ----------------------------------------------------------------------------------------

    def fit(self) -> None:
        slots = [*self.laid_out()]
        begins = accumulate((slot.width for slot in slots), initial=0)
        self.slots = tuple(replace(slot, begin=begin) for slot, begin in zip(slots, begins, strict=False))
        self.moved = tuple(self.left_out(self.slots))
        self.start = torch.tensor([share for slot in self.slots for share in slot.start()], dtype=torch.float32)
        self.groups = tuple(self._group(slot) for slot in self.slots if slot.width)
        ranges = [slot.spec if isinstance(slot.spec, Range) else Range(0.0, 1.0) for slot in slots]
        ends = torch.tensor([(spec.low, spec.high - spec.low) for spec in ranges], dtype=torch.float64).reshape(-1, 2)
        self._low, self._span = ends.T.repeat_interleave(torch.tensor([slot.width for slot in slots]), dim=1)

    def laid_out(self) -> Iterator[Slot]:
        """Yield the parameters in the order of their coordinates."""
        for parameter in self.own:
            value = self.default(parameter)
            yield Slot(self.in_scene(parameter), self.spec(parameter, value), self.size(parameter), value)

    def spec(self, parameter: Parameter, value: Number) -> Spec:
        """Return what a parameter is set to where its value in the unchanged scene is `value`."""
        if parameter.name in self.specs:
            return self.specs[parameter.name]
        wanted = None if self.asked else self.search_range(parameter)
        if wanted is None:
            return Fixed(value)
        return OneOf(parameter.options) if parameter.options else Range(*wanted)

    def left_out(self, slots: Sequence[Slot]) -> Iterator[Moved]:
        """Yield the values of the clean scene that the start has not.

        Raises:
            InputError: one of them was asked for.
        """
        for slot in slots:
            parameter = slot.parameter
            if self.amount not in (None, parameter.name):
                continue
            wanted, used = self.unchanged(parameter), slot.start_value()
            if same(used, wanted, turns=slot.turns):
                continue
            setting = self.setting(parameter)
            check_start(self.name, parameter.name, in_words(slot.spec), setting, self.scene, wanted)
            if not isinstance(self.specs.get(parameter.name), Fixed):
                address = setting if setting == ENVIRONMENT else f"{self.name}.{parameter.name}"
                yield Moved(self.name, address, "name" if parameter.options else parameter.unit, wanted, used)

    def _group(self, slot: Slot) -> Group:
        parameter, spec = slot.parameter, slot.spec
        options = len(spec.values) if isinstance(spec, OneOf) else 0
        budget = WHOLE_RANGE if options else self.budget_of(parameter)
        if type(spec) not in (OneOf, Range) and budget != WHOLE_RANGE:
            raise InputError(f"{self.name}.{parameter.name}: it has a ball and no distribution; give it a range")
        valid, setting = () if options else self.estimators(parameter), self.setting(parameter)
        return Group(
            parameter.name, slot.width, valid, budget, periodic=slot.periodic, options=options, setting=setting
        )

    def values(self, u: Tensor) -> dict[str, Tensor]:
        """Return every parameter's value at a slice of u: float32 of the parameter's shape, or the number of an option.
        Fixed ones are there too.
        """
        values: dict[str, Tensor] = {}
        every = self._low.to(u) + self._span.to(u) * u  # at once, but for what is searched on a logarithmic scale
        for slot in self.slots:
            parameter, spec, place = slot.parameter, slot.spec, slice(slot.begin, slot.begin + slot.size)
            if isinstance(spec, Range):
                mapped = parameter.log or type(spec) is not Range
                value = to_value(spec, log=parameter.log, u=u[place]) if mapped else every[place]
                values[parameter.name] = value if parameter.shape else value.reshape(())
                continue
            one = spec.value if isinstance(spec, Fixed) else spec.values[option_index(len(spec.values), u[slot.begin])]
            shape = (slot.size,) if parameter.shape and not isinstance(one, str) else ()
            number = parameter.options.index(one) if isinstance(one, str) else one
            values[parameter.name] = torch.full(shape, float(number), dtype=torch.float32, device=u.device)
        return values

    def numbers(self, u: Tensor) -> Mapping[str, Tensor]:
        values = self.values(u)
        others = (slot.parameter for slot in self.slots)
        return {one.name: values[one.name] for one in others if not one.options and len(one.shape) < 2}

    def inputs(self, u: Tensor, so_far: Mapping[str, Tensor] = NOTHING) -> dict[str, Tensor]:
        return self.scene_inputs(self.values(u), so_far)

    def picture(self, u: Tensor, image: Tensor) -> Tensor:
        # many do nothing to the picture: their values are not worked out again
        return image if type(self).on_picture is NumberControl.on_picture else self.on_picture(self.values(u), image)

    def describe(self, u: Tensor, so_far: Mapping[str, Tensor] = NOTHING) -> dict[str, Value]:
        values = self.values(u.detach())
        described: dict[str, Value] = {}
        for slot in self.slots:
            parameter, value = slot.parameter, values[slot.parameter.name]
            if isinstance(slot.spec, Fixed) or len(parameter.shape) > 1:
                continue
            name = f"{self.name}.{parameter.name}"
            if parameter.options:
                described[name] = {"value": parameter.options[int(value)], "unit": "name"}
            elif value.ndim == 0:
                described[name] = measure(value, parameter.unit)
            else:
                described |= {f"{name}.{k}": measure(number, parameter.unit) for k, number in enumerate(value)}
        return described | {f"{self.name}.{name}": value for name, value in self.measured(values, so_far).items()}

    def artifacts(self, u: Tensor, so_far: Mapping[str, Tensor] = NOTHING) -> dict[str, Tensor]:
        return self.kept_pictures(self.values(u.detach()), so_far)

    def files(self, u: Tensor, so_far: Mapping[str, Tensor] = NOTHING) -> dict[str, bytes]:
        return self.kept_files(self.values(u.detach()), so_far)
