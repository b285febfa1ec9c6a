"""Axes of a grid, and the configurations of a sweep.

An axis makes its parameter a discrete choice among its values, so a point of the grid
is a point of the space of controls like any other.

A configuration follows from the number of its image by arithmetic; nothing is stored.
Images have different draws, so that they are independent, with three exceptions: an
image with an adversarial scene has the draw of the one without it; the frames of a
drive share one draw; and so do the samples of a grid point if nothing is sampled
(`runs.tables.Units`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import ndtri
from torch import Tensor

from advsearch import controls as families
from advsearch.attacks import Block, Domain
from advsearch.attacks.domain import ProductIndex, SampleSequence
from advsearch.controls import CONTROLS, Control, Parameter, Space
from advsearch.controls.base import Value
from advsearch.controls.ranges import Fixed, OneOf, ParameterValue, Range, parse_spec
from advsearch.errors import InputError, UnknownNameError
from advsearch.options import MITSUBA_CONTROL
from advsearch.runs.results import VariedValue
from advsearch.runs.tables import Units
from advsearch.scene.description import ENVIRONMENT, SceneDescription

MAX_AXIS_VALUES = 100_000
FULL_TURN = 360.0  # degrees after which a periodic parameter repeats
MAX_RANGE_PARTS = 10
MIN_RANGE_PARTS = 2
MIN_CELL_DRAWS = 5
"""A cell of the map over two sampled parameters has at least this many draws on
average, if the sweep has enough images.
"""
# numbers of a group up to which Sobol points are used; larger ones (a texture) are
# sampled pseudo-randomly
MAX_SOBOL_SIZE = 64
MAX_TABLE_COMPONENTS = 4  # of a parameter, up to which the table shows them
MAX_CACHED_DESCRIPTIONS = 4096  # of controls at points of the grid
Float64Array = NDArray[np.float64]
# These settings take several values themselves, written as here; they are no axes.
_LISTED_SETTINGS = {
    "object": "`object` mug,bowl",
    "environment": "`environment` studio,noon",
    "model": "`model` a.pt2,b.pt2",
}


@dataclass(frozen=True)
class Axis:
    """A parameter and its values.

    Attributes:
        control_kind: kind of the control.
        control_name: name of the control; that of its kind unless it has another.
        parameter: the parameter that varies.
        values: numbers or names.
    """

    control_kind: str
    control_name: str
    parameter: Parameter
    values: tuple[ParameterValue, ...]

    @property
    def name(self) -> str:
        """The stored name: ``pose.yaw``, or ``key.power`` of a light named key."""
        return f"{self.control_name}.{self.parameter.name}"

    @property
    def is_time(self) -> bool:
        """Whether the values are times of the frames of a path."""
        return (self.control_kind, self.parameter.name) == ("path", "time")

    @property
    def unit(self) -> str:
        return _stored_unit(self.parameter)


def parse_axes(
    grid: Mapping[str, object], controls: Sequence[Control]
) -> tuple[Axis, ...]:
    """Parse the axes of a grid.

    Args:
        grid: parameter to values, ``"FIRST:LAST:COUNT"`` or a list. A parameter is
            KIND.PARAMETER, INSTANCE.PARAMETER of one of `controls`,
            KIND:INSTANCE.PARAMETER, or mitsuba:KEY.
        controls: the controls that are sampled.

    Raises:
        InputError, UnknownNameError: a name or its values cannot be used, or a
            parameter is set twice.
    """
    instances = {control.name: control for control in controls}
    axes: dict[str, Axis] = {}
    for name, values in grid.items():
        axis = _parse_axis(name, values, instances)
        _check_not_repeated(name, axis, axes)
        _check_not_sampled(name, axis, instances)
        axes[axis.name] = axis
    return tuple(axes.values())


def _check_not_repeated(name: str, axis: Axis, axes: Mapping[str, Axis]) -> None:
    """Raise an error if an earlier axis varies the same parameter.

    Args:
        name: name of the axis, as the user wrote it.
        axis: the axis.
        axes: the earlier axes by their stored name.
    """
    if axis.name in axes:
        raise InputError(
            f"`grid` {name}: {axis.name} is given twice; leave one of the two out"
        )


def _check_not_sampled(name: str, axis: Axis, instances: Mapping[str, Control]) -> None:
    """Raise an error if a sampled control sets the parameter of an axis, too.

    Args:
        name: name of the axis, as the user wrote it.
        axis: the axis.
        instances: the sampled controls by name.
    """
    sampled = instances.get(axis.control_name)
    if sampled is not None and axis.parameter.name in sampled.specs:
        raise InputError(
            f"`grid` {name}: `controls` {axis.control_name} sets {axis.parameter.name} "
            "too; leave it out of one "
            "of the two"
        )


def _parse_axis(name: str, values: Any, instances: Mapping[str, Control]) -> Axis:
    """Parse one axis of a grid, such as ``pose.yaw=0:360:24``.

    Args:
        name: name of the parameter, as the user wrote it: KIND.PARAMETER,
            INSTANCE.PARAMETER, KIND:INSTANCE.PARAMETER, or mitsuba:KEY.
        values: values of the parameter, a string or a list.
        instances: the sampled controls by name.

    Raises:
        InputError, UnknownNameError: the name or the values cannot be used.
    """
    where = f"`grid` {name}"
    _check_no_listed_setting(where, name)
    kind, parameter_name, colon_instance = _split_axis_name(name)
    instance = name.partition(".")[0]  # if the name is INSTANCE.PARAMETER
    if instance not in instances:
        instance = families.make_instance_name(kind, colon_instance or "")
    control = _find_control(instances, kind, instance, where)
    if kind == MITSUBA_CONTROL:
        # mitsuba:KEY, and a key may itself contain dots and colons
        return _parse_key_axis(name, values, control)

    parameters = _find_parameters(values, instances, control, parameter_name, instance)
    parameter = _select_parameter(
        where, parameters, parameter_name, colon_instance, control.kind
    )
    _check_scalar(where, control, parameter, instance)
    return Axis(
        control_kind=control.kind,
        control_name=instance,
        parameter=parameter,
        values=parse_axis_values(where, parameter, values),
    )


def _check_no_listed_setting(where: str, name: str) -> None:
    """Raise an error if an axis has the name of a setting that takes several values.

    Such a setting, "model" say, is no control.

    Args:
        where: the axis, as messages name it.
        name: name of the axis.
    """
    if name in _LISTED_SETTINGS:
        raise InputError(
            f"{where}: several of them are given as a list: {_LISTED_SETTINGS[name]}"
        )


def _select_parameter(
    where: str,
    parameters: Mapping[str, Any],
    parameter_name: str,
    colon_instance: str | None,
    kind: str,
) -> Any:
    """Return the parameter that the name of an axis states.

    Args:
        where: the axis, as messages name it.
        parameters: the parameters of the control by name.
        parameter_name: the parameter in the name; empty without one.
        colon_instance: the instance after a colon in the name; None without one.
        kind: kind of the control.

    Raises:
        InputError, UnknownNameError: there is no such parameter, or no instance after
            the colon.
    """
    if not parameter_name:
        raise InputError(
            f"{where}: expected CONTROL.PARAMETER, got no parameter; "
            f"choose one of {', '.join(parameters)}"
        )
    if colon_instance is not None:
        families.check_instance_name(where, colon_instance)  # raises if it is empty
    if parameter_name not in parameters:
        what = f"parameter of control {kind}"
        hint = f"In {where}."
        raise UnknownNameError(what, parameter_name, list(parameters), hint)
    return parameters[parameter_name]


def _split_axis_name(name: str) -> tuple[str, str, str | None]:
    """Return kind, parameter and instance in the name of an axis.

    The instance follows a colon after the kind, as in KIND:INSTANCE.PARAMETER, or after
    the parameter, as in KIND.PARAMETER:INSTANCE. It is None if there is no colon.
    """
    control_name, _, rest = name.partition(".")
    kind, kind_colon, kind_instance = control_name.partition(":")
    parameter_name, parameter_colon, parameter_instance = rest.partition(":")
    if not kind_colon and not parameter_colon:
        return kind, parameter_name, None
    return kind, parameter_name, parameter_instance or kind_instance


def _find_control(
    instances: Mapping[str, Control], kind: str, instance: str, where: str
) -> Any:
    """Return the class of a control: that of the instance, else that of the kind.

    Args:
        instances: the sampled controls by name.
        kind: kind of the control, such as "light".
        instance: name of the control, such as "key".
        where: the axis, as messages name it.

    Raises:
        UnknownNameError: no control has this name or kind.
    """
    control: Any = CONTROLS.get(kind)
    if instance in instances:
        control = type(instances[instance])
    if control is None:
        hint = (
            f"It stands in {where}; write `grid` CONTROL.PARAMETER=VALUES, such as "
            "pose.yaw=0:360:24."
        )
        raise families.make_unknown_control_error(kind, hint, instances)
    return control


def _find_parameters(
    values: Any,
    instances: Mapping[str, Control],
    control: Any,
    parameter_name: str,
    instance: str,
) -> dict[str, Any]:
    """Return the parameters of a control by name.

    Args:
        values: values of the axis; some classes declare a parameter by its values.
        instances: the sampled controls by name.
        control: the class of the control, a subclass of `Control`.
        parameter_name: parameter name of the axis.
        instance: name of the control. If it is one of `instances`, it may have
            parameters in addition to those of its class; these are returned, too.
    """
    declared = [*control.declare_parameters({parameter_name: values})]
    if instance in instances:
        declared += instances[instance].instance_parameters
    return {parameter.name: parameter for parameter in declared}


def _parse_key_axis(name: str, values: Any, control: Any) -> Axis:
    """Parse an axis over one of Mitsuba's own parameters.

    Whether the scene has such a parameter is checked later, when the scene is loaded.

    Args:
        name: name of the axis, such as ``mitsuba:mug.bsdf.reflectance``.
        values: values of the parameter, a string or a list.
        control: class of the control for Mitsuba's parameters.
    """
    where = f"`grid` {name}"
    key = name.partition(":")[2]
    if not key:
        raise InputError(
            f"{where}: expected Mitsuba's name and values, as in "
            f"{MITSUBA_CONTROL}:KEY=FIRST:LAST:COUNT"
        )
    (parameter,) = control.declare_parameters([key])
    return Axis(
        control_kind=MITSUBA_CONTROL,
        control_name=MITSUBA_CONTROL,  # there is only one
        parameter=parameter,
        values=parse_axis_values(where, parameter, values),
    )


def _check_scalar(
    where: str, control: Any, parameter: Parameter, instance: str
) -> None:
    """Check that a parameter is a single value, as an axis needs it.

    Args:
        where: the axis, as messages name it.
        control: class of the control.
        parameter: the parameter of the axis.
        instance: name of the control, for the message.

    Raises:
        InputError: the parameter has several numbers, or the control has an image (a
            texture) among its parameters.
    """
    has_images = any(len(declared.shape) > 1 for declared in control.parameters)
    if has_images or parameter.shape != ():
        raise InputError(
            f"{where}: expected a parameter that is one number or name, got one that "
            f"is many numbers; draw it by chance with `controls` {instance} `samples=100`"
        )


def parse_axis_values(
    where: str, parameter: Parameter, raw_values: Any
) -> tuple[ParameterValue, ...]:
    """Parse and check the values of an axis.

    ``"FIRST:LAST:COUNT"`` stands for COUNT evenly spaced values from FIRST to LAST,
    both included. If it is a full turn of an angle, such as 0:360:24, LAST would repeat
    FIRST, and is left out.

    Args:
        where: how messages name the axis.
        parameter: the parameter that varies.
        raw_values: a string, a value, or a list.

    Raises:
        InputError: they are no values of the parameter, or not different.
    """
    is_angle = parameter.periodic and parameter.unit == "degrees"
    values = _list_raw_values(where, parameter, raw_values, is_angle)
    _check_any_values(where, values)
    _check_count(where, len(values))
    # NumPy's scalars (they have `item`) become Python's.
    choices = [value.item() if hasattr(value, "item") else value for value in values]
    spec = parse_spec(where, parameter, {"choices": choices})
    assert isinstance(spec, OneOf)  # it is what choices are parsed to
    _check_distinct(where, spec.values, is_angle)
    _check_number_precision(where, parameter, spec.values)
    return spec.values


def _check_any_values(where: str, values: Sequence[Any]) -> None:
    """Raise an error if an axis, `where` in the message, has no values."""
    if not values:
        raise InputError(
            f"{where}: expected at least one value, got none; write "
            "FIRST:LAST:COUNT or a list"
        )


def _list_raw_values(
    where: str, parameter: Parameter, raw_values: Any, is_angle: bool
) -> Sequence[Any]:
    """Return the values of an axis as a list, a range as its values.

    Args:
        where: how messages name the axis.
        parameter: the parameter that varies.
        raw_values: a string, a value, or a list.
        is_angle: whether the values are angles in degrees.
    """
    # The name of an option may itself have a colon, so that it is no range.
    can_be_range = not parameter.options
    if isinstance(raw_values, str) and ":" in raw_values and can_be_range:
        return _parse_range(where, raw_values, is_angle)
    if isinstance(raw_values, (list, tuple)):
        return raw_values
    return [raw_values]


def _check_distinct(
    where: str, values: Sequence[ParameterValue], is_angle: bool
) -> None:
    """Check that no value comes twice, and no angle in two forms, such as 0 and 360.

    Args:
        where: the axis, as messages name it.
        values: values of the axis.
        is_angle: whether they are angles in degrees, which repeat after a full turn.

    Raises:
        InputError: two values are the same.
    """
    value_of_key: dict[ParameterValue, ParameterValue] = {}
    for value in values:
        key = _to_angle_key(value) if is_angle else value
        if key not in value_of_key:
            value_of_key[key] = value
            continue
        repeated = _describe_repetition(value_of_key[key], value)
        raise InputError(
            f"{where}: expected different values, got {repeated}; leave one of them out"
        )


def _to_angle_key(value: ParameterValue) -> ParameterValue:
    """Return an angle in degrees, in [0, 360) and rounded; names as they are."""
    if isinstance(value, str):
        return value
    # 9 decimals: angles that differ by float64 rounding alone are the same. Rounding may
    # give 360, which is the angle 0: so the second `%`.
    return round(value % FULL_TURN, 9) % FULL_TURN


def _describe_repetition(earlier: ParameterValue, value: ParameterValue) -> str:
    """Return what comes twice: a value, or an angle in two forms."""
    if earlier == value:
        return f"{_format_value(value)} twice"
    return f"{_format_value(earlier)} and {_format_value(value)}, the same angle"


def _check_number_precision(
    where: str, parameter: Parameter, values: Sequence[Any]
) -> None:
    """Check that numbers differ in single precision, which scenes have.

    Args:
        where: the axis, as messages name it.
        parameter: the parameter that varies.
        values: values of the axis; names are not checked.
    """
    has_names = any(isinstance(value, str) for value in values)
    if parameter.options or has_names:
        return
    singles = sorted(np.float32(value) for value in values)
    if any(lower == upper for lower, upper in pairwise(singles)):
        raise InputError(
            f"{where}: expected values that differ in single precision, which "
            "scenes have; space them wider"
        )


def _format_value(value: ParameterValue) -> str:
    """Return a value as an error message has it."""
    return value if isinstance(value, str) else f"{value:g}"


def _parse_range(where: str, text: str, is_angle: bool) -> list[float]:
    """Return the values of a range ``FIRST:LAST:COUNT``, evenly spaced.

    Args:
        where: the axis, as messages name it.
        text: the range, such as "0:360:24".
        is_angle: whether the values are angles in degrees. Then a range over a full
            turn leaves LAST out, since it would repeat FIRST.

    Raises:
        InputError: the text is no such range.
    """
    numbers = _parse_range_numbers(where, text)
    if numbers.n_values < 1:
        raise InputError(
            f"{where}: expected a COUNT of at least 1, got {numbers.n_values} in {text!r}"
        )
    _check_count(where, numbers.n_values)
    _check_bounds(where, text, numbers, is_angle=is_angle)
    first, last, count = numbers
    is_full_turn = is_angle and last - first == FULL_TURN
    values = np.linspace(first, last, count, endpoint=not is_full_turn)
    return [float(value) for value in values]


class _RangeNumbers(NamedTuple):
    """The numbers of a range ``FIRST:LAST:COUNT``."""

    first: float
    last: float
    n_values: int


def _parse_range_numbers(where: str, text: str) -> _RangeNumbers:
    """Read the numbers of a range ``FIRST:LAST:COUNT``.

    Raises:
        InputError: the text is no such range, or FIRST or LAST is infinite.
    """
    expected = (
        f"{where}: expected FIRST:LAST:COUNT such as 0:360:24, or values "
        f"separated by commas, got {text!r}"
    )
    fields = text.split(":")
    if len(fields) != 3:
        raise InputError(expected)
    try:
        first = float(fields[0])
        last = float(fields[1])
        count = int(fields[2])
    except ValueError:
        raise InputError(
            f"{expected}; FIRST and LAST are numbers and COUNT is a whole number"
        ) from None
    if not (math.isfinite(first) and math.isfinite(last)):
        raise InputError(f"{expected}; FIRST and LAST have to be finite")
    return _RangeNumbers(first, last, count)


def _check_bounds(
    where: str, text: str, numbers: _RangeNumbers, *, is_angle: bool
) -> None:
    """Check that a range FIRST:LAST:COUNT has different values in ascending order.

    Args:
        where: name of the axis in messages.
        text: the range as the user wrote it.
        numbers: its numbers.
        is_angle: whether the values are angles, which repeat after a full turn.

    Raises:
        InputError: it has not; the message has the range to write instead.
    """
    first, last, count = numbers
    if last < first:
        raise InputError(
            f"{where}: the range {text!r} is reversed; write {last:g}:{first:g}:{count}"
        )
    if first == last and count > 1:
        raise InputError(
            f"{where}: FIRST and LAST are the same in {text!r}; write "
            f"{first:g} for the one value"
        )
    if is_angle and last - first > FULL_TURN:
        raise InputError(
            f"{where}: {text!r} is more than a whole turn, so that values would "
            "repeat; write "
            f"{first:g}:{first + FULL_TURN:g}:{count}"
        )


def _check_count(where: str, count: int) -> None:
    """Check that an axis does not have too many values."""
    if count > MAX_AXIS_VALUES:
        raise InputError(
            f"{where}: expected at most {MAX_AXIS_VALUES} values on an axis, got "
            f"{count}; draw the parameter by chance instead, with `controls` and "
            "`samples`"
        )


def add_grid_axes(
    controls: Sequence[Control], axes: Sequence[Axis], scene: SceneDescription
) -> tuple[Control, ...]:
    """Return the controls, where parameters on an axis are choices among its values.

    A control may be sampled and also have a parameter on an axis: then its other
    parameters stay sampled. If a control is only in the grid, its other parameters keep
    the values of the scene.

    Args:
        controls: controls that are sampled.
        axes: axes of the grid.
        scene: the scene, which decides the default ranges of a control.
    """
    control_by_name = {control.name: control for control in controls}
    # Axes of one control have the same `control_name`.
    for instance in dict.fromkeys(axis.control_name for axis in axes):
        instance_axes = [axis for axis in axes if axis.control_name == instance]
        sampled = control_by_name.get(instance)
        control_by_name[instance] = _make_grid_control(sampled, instance_axes, scene)
    return tuple(control_by_name.values())


def _make_grid_control(
    sampled: Control | None, axes: Sequence[Axis], scene: SceneDescription
) -> Control:
    """Return a control whose parameters on axes are choices among their values.

    Args:
        sampled: the control, if it is sampled; None if it is only in the grid.
        axes: its axes, at least one.
        scene: the scene, which decides its default ranges.
    """
    if sampled is None:
        # Any: the type of `CONTROLS` does not have the arguments of its classes.
        control_type: Any = CONTROLS[axes[0].control_kind]
        settings = dict[str, object]()
    else:
        control_type = type(sampled)
        settings = _sampled_settings(sampled, scene)
    for axis in axes:
        settings[axis.parameter.name] = {"choices": list(axis.values)}
    control: Control = control_type(name=axes[0].control_name, **settings)
    return control


def _sampled_settings(control: Control, scene: SceneDescription) -> dict[str, object]:
    """Return the settings of a sampled control, with its default ranges stated.

    If no parameter of a control has a stated range, all of them are sampled in their
    default ranges. If one has, only those with stated ranges are sampled. An axis of
    the grid will state a range of one parameter. The default ranges of the others are
    stated here, so that these still vary.
    """
    # Kind and name are no parameters: the class and the instance state them.
    settings: dict[str, object] = {
        name: value
        for name, value in control.to_settings().items()
        if name not in ("kind", "name")
    }
    if control.has_requested_range:
        return settings  # the user stated its ranges: no default ones
    return settings | _state_default_ranges(control, scene)


def _state_default_ranges(
    control: Control, scene: SceneDescription
) -> dict[str, object]:
    """Return the default ranges of a control as settings, without stated parameters.

    Args:
        control: the control.
        scene: the scene, which decides the ranges.
    """
    settings = dict[str, object]()
    resolve_in_scene = control.with_scene(scene).resolve_parameter
    for parameter in map(resolve_in_scene, control.parameters):
        is_stated = parameter.name in control.specs
        if is_stated or parameter.search is None:
            continue
        if parameter.options:
            settings[parameter.name] = {"choices": list(parameter.options)}
        else:
            settings[parameter.name] = list(parameter.search)
    return settings


@dataclass(frozen=True)
class SampledNumber:
    """A sampled number, with the parts of its range by which tables count predictions.

    Its draws are in [0, 1]. This interval is divided into equally long bins, usually
    one for each part. If options of a choice have weights, an option has as many bins
    as its weight.

    Attributes:
        name: name of the parameter, with the index of a component.
        unit: unit of the values.
        draw_column: its column among the draws.
        range_parts: parts of the range as lists [lower, upper], or the options of a choice.
        same_in_all_scenes: whether `range_parts` are the same in every scene.
        part_of_bin: for each bin the index of its part, if options have weights; else
            empty, and each part has one bin.
    """

    name: str
    unit: str
    draw_column: int
    range_parts: tuple[Any, ...]
    same_in_all_scenes: bool = True
    part_of_bin: tuple[int, ...] = ()

    @property
    def varied_value(self) -> VariedValue:
        """The range or the options that the value was sampled from."""
        bounds = list[float]()
        for part in self.range_parts:
            if isinstance(part, list):  # [lower, upper]; else it is an option
                bounds += part
        if bounds:
            return VariedValue(unit=self.unit, low=min(bounds), high=max(bounds))
        return VariedValue(
            unit=self.unit, names=[str(part) for part in self.range_parts]
        )

    @property
    def part_bounds(self) -> list[float] | None:
        """The bounds of the parts, ascending.

        None for a choice, and for parts that differ between scenes.
        """
        are_ranges = all(isinstance(part, list) for part in self.range_parts)
        if not self.same_in_all_scenes or not are_ranges:
            return None
        return sorted({bound for part in self.range_parts for bound in part})


def choose_n_parts(n_images: int) -> int:
    """Return the number of parts into which tables divide the range of a parameter.

    It is the largest number for which a map over two parameters, with that many parts
    each, has `MIN_CELL_DRAWS` draws in a cell on average; but between `MIN_RANGE_PARTS`
    and `MAX_RANGE_PARTS`.

    Args:
        n_images: images of the full sweep.
    """
    parts = math.isqrt(n_images // MIN_CELL_DRAWS)
    return min(max(MIN_RANGE_PARTS, parts), MAX_RANGE_PARTS)


class _SampledBlock(NamedTuple):
    """A block of coordinates that is sampled.

    Attributes:
        control: name of the control.
        parameter: name of its parameter whose coordinates these are.
        block: norm and budget of the coordinates.
        coordinates: their columns in a configuration.
        columns: their columns among the draws. A ball has one column more than
            coordinates, for the length.
    """

    control: str
    parameter: str
    block: Block
    coordinates: slice
    columns: slice


class _GridCoordinate(NamedTuple):
    """A coordinate whose values are those of an axis.

    Attributes:
        column: its index in a configuration.
        axis: the index of the axis.
    """

    column: int
    axis: int


class SceneConfigurations:
    """The configurations of one scene of a sweep.

    Images are numbered with the points of the grid, its last axis fastest, then the
    samples at each point.

    Args:
        space: the controls, bound to the scene; it starts from the scene as it is.
        domain: the budgets of the controls.
        axes: axes of the grid.
        samples: number of samples at each point of the grid.
        sampler: how the draws are made, "sobol" or "random".
        seed: seed of the draws.
        repeat_after_scenes: number of scenes after which the draws repeat, so that
            scenes that are compared have the same ones; 0 if they never repeat.
        n_scenes: number of scenes of the sweep.
        n_photographs: number of photographs in the folder of photographs; 1 without
            one. The sweep then has a scene for each photograph.

    Attributes:
        n_images: number of images of the scene.
        parts_per_range: number of parts into which tables divide the range of a sampled
            number.
        sampled_numbers: the sampled numbers that tables count by.
        sampled_layout: describes which numbers are sampled: the number of draws of
            small blocks, and name, column and number of parts of each sampled number.
        is_sampled: whether anything is sampled. A control may have all its values from
            the grid, as a path has its time.
        independent_units: maps images to draws.
    """

    def __init__(
        self,
        space: Space,
        domain: Domain,
        axes: Sequence[Axis],
        samples: int,
        sampler: str,
        seed: int,
        repeat_after_scenes: int = 0,
        n_scenes: int = 1,
        n_photographs: int = 1,
    ) -> None:
        """Assign every coordinate to an axis or to draws; arguments: see the class."""
        # Attributes are set in the order in which the methods below need them.
        self.grid = ProductIndex(tuple(len(axis.values) for axis in axes))
        self.samples_per_grid_point = samples
        self.n_images = self.grid.count * samples
        self.parts_per_range = choose_n_parts(self.n_images * n_scenes)
        self.space = space
        self._start = domain.start.numpy().astype(np.float64)
        self._lower = domain.lower_bounds.numpy()
        self._upper = domain.upper_bounds.numpy()
        self._axes = {axis.name: (index, axis) for index, axis in enumerate(axes)}
        self._assign_blocks(domain)
        self._prepare_draws(sampler, seed)
        self.independent_units = self._make_units(
            axes,
            images_until_repeat=repeat_after_scenes * self.n_images,
            n_photographs=n_photographs,
        )
        self._description_cache: dict[tuple[object, ...], Mapping[str, Value]] = {}

    def _prepare_draws(self, sampler: str, seed: int) -> None:
        """Set what is sampled, and the sequences of the draws.

        Args:
            sampler: how the draws of small blocks are made, "sobol" or "random".
            seed: seed of the draws.
        """
        self.sampled_numbers = tuple(self._list_sampled_numbers())
        n_small = _count_columns(self._small_blocks)
        n_large = _count_columns(self._large_blocks)
        self._small_draws = SampleSequence(n_small, sampler, seed)
        self._large_draws = SampleSequence(n_large, "random", seed, "large draws")
        self.is_sampled = n_small + n_large > 0
        self.sampled_layout = (n_small, self._list_sampled_layout())
        # Column of each sampled number among the draws, and number of equal bins of
        # [0, 1]: a part of its range has one bin, an option with a weight several.
        self._columns = [number.draw_column for number in self.sampled_numbers]
        n_bins = [
            len(number.part_of_bin or number.range_parts)
            for number in self.sampled_numbers
        ]
        self._n_bins = np.array(n_bins, dtype=np.int64)

    def _list_sampled_layout(self) -> tuple[tuple[str, int, int], ...]:
        """Return name, column and number of parts of each sampled number.

        If two scenes have the same layout, their draws can be counted together.
        """
        return tuple(
            (number.name, number.draw_column, len(number.range_parts))
            for number in self.sampled_numbers
        )

    def _make_units(
        self, axes: Sequence[Axis], *, images_until_repeat: int, n_photographs: int
    ) -> Units:
        """Return which images belong to one independent unit, such as a drive.

        Args:
            axes: axes of the grid; images along an axis of time are frames of a drive.
            images_until_repeat: number of images after which the draws repeat; 0 if
                they never repeat.
            n_photographs: number of photographs in the folder of photographs; 1 without
                one.
        """
        # If nothing is sampled, the images of a grid point differ only in noise.
        n_draws = self.samples_per_grid_point if self.is_sampled else 1
        images_per_draw = self.samples_per_grid_point // n_draws
        time_axes = [index for index, axis in enumerate(axes) if axis.is_time]
        # `Units` uses the number of images per scene only with photographs.
        images_per_scene = self.n_images if n_photographs > 1 else 1
        return Units(
            self.grid.sizes,
            frames=time_axes[0] if time_axes else None,
            samples=n_draws,
            again=images_until_repeat,
            noise=images_per_draw,
            photographs=n_photographs,
            scene=images_per_scene,
        )

    def _assign_blocks(self, domain: Domain) -> None:
        """Decide for each block of coordinates where its values come from.

        If the parameter of a block is an axis of the grid, its values come from the
        axis. Otherwise they come from columns of the draws: one for each coordinate,
        and for a ball (L2 norm) one more for the length.

        Args:
            domain: the blocks of all controls, with their norms and budgets.
        """
        # A block is the coordinates of one parameter. Small blocks share the sequence
        # of the sampler. Large ones have random draws, since Sobol sequences are for
        # few dimensions.
        self._grid_coordinates: list[_GridCoordinate] = []
        self._small_blocks: list[_SampledBlock] = []
        self._large_blocks: list[_SampledBlock] = []
        block_slices = domain.list_block_slices()
        for group, (block, coordinates) in zip(
            self.space.groups, block_slices, strict=True
        ):
            if group.name in self._axes:
                axis_index, _ = self._axes[group.name]
                grid_coordinate = _GridCoordinate(coordinates.start, axis_index)
                self._grid_coordinates.append(grid_coordinate)
                continue
            is_small = block.size <= MAX_SOBOL_SIZE
            blocks = self._small_blocks if is_small else self._large_blocks
            columns = _find_free_columns(blocks, block)
            sampled = _SampledBlock(
                group.control, group.parameter, block, coordinates, columns
            )
            blocks.append(sampled)

    def _list_sampled_numbers(self) -> Iterator[SampledNumber]:
        """Yield the sampled numbers that tables count by.

        They are those of parameters with few components and a known range.
        """
        controls = {control.name: control for control in self.space.controls}
        # A parameter with few components is a small block.
        for sampled in self._small_blocks:
            control = controls[sampled.control]
            # A component of a ball has no range of its own. Without slots, a control
            # declares no ranges.
            is_ball = sampled.block.norm == "l2"
            has_ranges = bool(control.parameter_slots) and not is_ball
            if has_ranges and sampled.block.size <= MAX_TABLE_COMPONENTS:
                yield from self._describe_sampled(
                    control,
                    sampled.parameter,
                    sampled.coordinates,
                    sampled.columns.start,
                )

    def _describe_sampled(
        self, control: Control, name: str, coordinates: slice, first_column: int
    ) -> Iterator[SampledNumber]:
        """Yield the sampled numbers of a parameter.

        A choice is one number; a vector has one for each component.

        Args:
            control: bound to the scene.
            name: name of its parameter.
            coordinates: coordinates of the parameter in a configuration.
            first_column: index of its first column among the draws.
        """
        parameter, spec = _find_spec(control, name)
        full_name = f"{control.name}.{name}"
        if isinstance(spec, OneOf):
            unit = _stored_unit(parameter)
            yield _make_sampled_choice(full_name, unit, spec, first_column)
            return
        is_vector = bool(parameter.shape)
        coordinate_indices = range(coordinates.start, coordinates.stop)
        for component, coordinate in enumerate(coordinate_indices):
            suffix = f".{component}" if is_vector else ""
            yield SampledNumber(
                name=full_name + suffix,
                unit=parameter.unit,
                draw_column=first_column + component,
                range_parts=self._divide_range(coordinate, spec, log=parameter.log),
            )

    def _divide_range(
        self, column: int, spec: Any, *, log: bool
    ) -> tuple[list[float], ...]:
        """Cut the range of a coordinate into parts, and return the bounds of each.

        The parts are equal in the coordinate; the bounds are values of the parameter.

        Args:
            column: index of the coordinate in a configuration.
            spec: range of the parameter.
            log: whether the parameter is logarithmic.
        """
        edges = torch.linspace(
            float(self._lower[column]),
            float(self._upper[column]),
            self.parts_per_range + 1,
            dtype=torch.float64,
        )
        edge_values: list[float] = spec.interpolate(edges, log=log).tolist()
        return tuple(map(list, pairwise(edge_values)))

    def find_parts(self, first: int, count: int) -> NDArray[np.int64]:
        """Return the index of the part that each of k sampled numbers is in, by image.

        Args:
            first: number of the first image in the full sweep.
            count: number of consecutive images of one scene.

        Returns:
            (count, k) indices among `range_parts` of each of `sampled_numbers`.
        """
        draws = self._sample(self._small_draws, first, count)[:, self._columns]
        # [0, 1] is divided into equal bins for each number: find the bin of each draw.
        bins = (draws * self._n_bins).astype(np.int64)
        bins = np.minimum(bins, self._n_bins - 1)  # a draw of 1 is in the last
        # Usually a bin is a part. An option with a weight has several bins: there the
        # part of each bin is looked up.
        parts: NDArray[np.int64] = bins.copy()
        for column, number in enumerate(self.sampled_numbers):
            if number.part_of_bin:
                parts[:, column] = np.take(number.part_of_bin, bins[:, column])
        return parts

    def find_noise_index(self, number: int) -> int:
        """Return the index of the noise seed of an image, by its number in the sweep.

        In a comparison, the images with the adversarial scene repeat the draws of those
        without it. They have the same noise, too, so that only the scene differs.
        """
        n_clean_images = self.independent_units.again  # 0 without a comparison
        return number % n_clean_images if n_clean_images else number

    def _sample(self, draws: SampleSequence, first: int, count: int) -> Float64Array:
        """Return the draws (count, k) of consecutive images.

        Consecutive images have consecutive draws, except in a sweep over frames, in
        which all frames of a drive have the same draw.

        Args:
            draws: draws of k numbers.
            first: number of the first image in the full sweep.
            count: number of images.
        """
        units = self.independent_units  # maps the number of an image to its draw
        if count == 0:
            return draws.points(0, 0)
        if units.frames is None:
            return draws.points(units.find_draw(first), count)
        image_numbers = range(first, first + count)
        return np.concatenate(
            [draws.points(units.find_draw(number), 1) for number in image_numbers]
        )

    def _axis_indices(self, first: int, count: int) -> tuple[NDArray[np.intp], ...]:
        """Return the indices (count,) of consecutive images on each axis.

        Args:
            first: number of the first image in the scene.
            count: number of images.
        """
        if not self._axes:
            return ()
        grid_points = np.arange(first, first + count) // self.samples_per_grid_point
        return np.unravel_index(grid_points, self.grid.sizes)

    def make_configurations(self, first: int, count: int, before: int = 0) -> Tensor:
        """Return the configurations (count, d) float32 of consecutive images.

        Args:
            first: number of the first image in the scene.
            count: number of images.
            before: number of images of the scenes before this one, which use the draws
                before those of this scene. The grid starts anew in every scene.
        """
        u = np.repeat(self._start[None], count, axis=0)
        indices = self._axis_indices(first, count)
        for column, axis in self._grid_coordinates:
            # The coordinate of a choice is the center of its part of [0, 1].
            u[:, column] = (indices[axis] + 0.5) / self.grid.sizes[axis]
        first_in_sweep = before + first
        self._fill_sampled(u, self._small_draws, self._small_blocks, first_in_sweep)
        self._fill_sampled(u, self._large_draws, self._large_blocks, first_in_sweep)
        bounded = np.clip(u.astype(np.float32), self._lower, self._upper)
        return torch.from_numpy(bounded)

    def _fill_sampled(
        self,
        u: Float64Array,
        draws: SampleSequence,
        blocks: Sequence[_SampledBlock],
        first: int,
    ) -> None:
        """Write the coordinates of sampled blocks into configurations.

        Args:
            u: (n, d) configurations of consecutive images, which are changed.
            draws: draws of the blocks.
            blocks: the blocks.
            first: number of the first image in the full sweep.
        """
        if not blocks:
            return
        samples = self._sample(draws, first, len(u))
        for sampled in blocks:
            uniform = samples[:, sampled.columns]
            u[:, sampled.coordinates] = self._transform(sampled, uniform)

    def _transform(self, sampled: _SampledBlock, uniform: Float64Array) -> Float64Array:
        """Return coordinates inside the budget of a block from uniform numbers.

        The coordinates are uniform in the box, or in the ball around the start, or among
        the options of a choice.

        Args:
            sampled: the block, of k coordinates.
            uniform: (n, k) in [0, 1]; of a ball (n, k + 1), with that of the length
                last.

        Returns:
            (n, k).
        """
        block = sampled.block
        if block.n_options:
            return _map_to_options(uniform, block.n_options)
        # Only a ball has an epsilon; the type checker needs the second condition.
        if block.norm == "l2" and block.epsilon is not None:
            center = self._start[sampled.coordinates]
            return _map_to_ball(center, block.epsilon, uniform)
        lower = self._lower[sampled.coordinates].astype(np.float64)
        upper = self._upper[sampled.coordinates].astype(np.float64)
        return np.asarray(lower + (upper - lower) * uniform)

    @property
    def environment(self) -> str | None:
        """The environment that a control fixes for all images, such as "noon".

        None if that of the scene lights them, or if the environment varies.
        """
        # A group is the coordinates of one parameter.
        varies = any(group.setting == ENVIRONMENT for group in self.space.groups)
        return None if varies else self.space.environment_name

    def describe_images(self, u: Tensor, first_image: int) -> list[dict[str, Value]]:
        """Return the stored values of consecutive images: parameter to value and unit.

        They are what `Space.describe` returns, with one exception: a parameter of the
        grid has the value that the user listed, not its float32 rounding.

        Args:
            u: (n, d) configurations.
            first_image: number of the first image in the scene.
        """
        rows = [dict[str, Value]() for _ in u]
        indices = self._axis_indices(first_image, len(u))
        coordinates = u.split(self.space.coordinate_counts, dim=1)
        for control, control_u in zip(self.space.controls, coordinates, strict=True):
            if _is_described_by_base(control):
                # all images at once, which is sixty times as fast
                columns = self._describe_columns(control, control_u, indices)
                _add_columns(rows, columns)
                continue
            for image, row in enumerate(rows):
                points = self._find_axis_points(control, indices, image)
                row |= self._describe_control(
                    control, u[image], control_u[image], points
                )
        return rows

    def _find_axis_points(
        self, control: Control, indices: Sequence[NDArray[np.intp]], image: int
    ) -> list[tuple[Axis, int]]:
        """Return the axes of a control, with the index of the value in an image.

        Args:
            control: the control.
            indices: for each axis of the grid, the (n,) indices of the values of n
                images.
            image: index of the image among these.
        """
        return [
            (axis, int(indices[axis_index][image]))
            for axis_index, axis in self._axes.values()
            if axis.control_name == control.name
        ]

    def _describe_control(
        self,
        control: Control,
        u: Tensor,
        control_u: Tensor,
        axis_points: Sequence[tuple[Axis, int]],
    ) -> Mapping[str, Value]:
        """Return the stored values of a control in one image.

        They are cached if they follow from the grid alone.

        Args:
            control: the control, with a `describe` of its own.
            u: (d,) the full configuration.
            control_u: (k,) the coordinates of the control in `u`.
            axis_points: the axes of the control, with the index of the value of each.
        """
        # Only descriptions that follow from these indices are cached.
        key = (control.name, *(index for _, index in axis_points))
        cached = self._description_cache.get(key)
        if cached is not None:
            return cached
        description = self._describe_alone(control, u, control_u)
        for axis, index in axis_points:
            description[axis.name] = {"value": axis.values[index], "unit": axis.unit}
        if self._can_cache(control, n_axes=len(axis_points)):
            self._description_cache[key] = description
        return description

    def _can_cache(self, control: Control, *, n_axes: int) -> bool:
        """Return whether the values of a control follow from axes, and the cache has room.

        Args:
            control: the control.
            n_axes: number of its parameters that are axes of the grid.
        """
        # A control has a group for each of its parameters.
        are_all_on_axes = n_axes == len(control.groups)
        follows_from_axes = are_all_on_axes and not control.refines
        has_room = len(self._description_cache) < MAX_CACHED_DESCRIPTIONS
        return follows_from_axes and has_room

    def _describe_alone(
        self, control: Control, u: Tensor, control_u: Tensor
    ) -> dict[str, Value]:
        """Return the values of a control; see `_describe_control` for the arguments."""
        if control.refines:  # it depends on other controls, and so needs all of u
            return dict(self.space.describe(u, (control,)))
        return dict(control.describe(control_u))

    def _describe_columns(
        self,
        control: Control,
        coordinates: Tensor,
        indices: Sequence[NDArray[np.intp]],
    ) -> Iterator[tuple[str, str, list[Any]]]:
        """Yield name, unit and values (n,) of each parameter of a control.

        The values are the same that `Control.describe` returns for each configuration,
        but all n configurations are converted at once.

        Args:
            control: a control that does not override `Control.describe`.
            coordinates: (n, k) coordinates of the control.
            indices: for each axis of the grid, the (n,) indices of the values.
        """
        begin = 0
        for group in control.groups:  # a group is the coordinates of one parameter
            name = f"{control.name}.{group.parameter}"
            columns = coordinates[:, begin : begin + group.size].T
            begin += group.size
            if name in self._axes:
                axis_index, axis = self._axes[name]
                points = indices[axis_index].tolist()
                yield name, axis.unit, [axis.values[point] for point in points]
            else:
                yield from _describe_components(control, group.parameter, columns)


def _describe_components(
    control: Control, parameter_name: str, columns: Tensor
) -> Iterator[tuple[str, str, list[Any]]]:
    """Yield name, unit and values (n,) of each component of a sampled parameter.

    Args:
        control: the control, bound to the scene.
        parameter_name: name of its parameter.
        columns: (k, n) coordinates of the k components.
    """
    name = f"{control.name}.{parameter_name}"
    parameter, spec = _find_spec(control, parameter_name)
    unit = _stored_unit(parameter)
    for component, column in enumerate(columns):
        if isinstance(spec, OneOf):  # a choice has a single coordinate
            yield name, unit, _select_options(spec, column)
            continue
        suffix = f".{component}" if parameter.shape else ""
        values = spec.interpolate(column, log=parameter.log).tolist()
        yield name + suffix, unit, values


def _add_columns(
    rows: Sequence[dict[str, Value]], columns: Iterable[tuple[str, str, list[Any]]]
) -> None:
    """Add columns of values to the rows.

    Args:
        rows: rows of n images, which are changed.
        columns: name, unit and values (n,) of each column.
    """
    for name, unit, values in columns:
        for row, value in zip(rows, values, strict=True):
            row[name] = {"value": value, "unit": unit}


def _make_sampled_choice(
    name: str, unit: str, spec: OneOf, draw_column: int
) -> SampledNumber:
    """Return the sampled number that chooses among options.

    Args:
        name: name of the parameter.
        unit: unit of the values.
        spec: the options.
        draw_column: its column among the draws.
    """
    options = tuple(dict.fromkeys(spec.values))
    # An option with a weight is in `spec.values` several times.
    has_weights = options != spec.values
    part_of_bin: tuple[int, ...] = ()
    if has_weights:
        part_of_bin = tuple(map(options.index, spec.values))
    return SampledNumber(
        name=name,
        unit=unit,
        draw_column=draw_column,
        range_parts=options,
        part_of_bin=part_of_bin,
    )


def _map_to_options(uniform: Float64Array, n_options: int) -> Float64Array:
    """Return the coordinates (n, 1) of options from uniform numbers (n, 1).

    A choice of n options cuts [0, 1] into n equal parts; the coordinate of an option is
    the center of its part.
    """
    # a uniform number of exactly 1 belongs to the last option
    option = np.minimum(np.floor(uniform * n_options), n_options - 1)
    return np.asarray((option + 0.5) / n_options)


MIN_UNIFORM = 1e-12  # uniform numbers are kept this far from 0 and 1
MIN_NORM = 1e-30  # smallest divisor of a direction


def _map_to_ball(
    center: Float64Array, radius: float, uniform: Float64Array
) -> Float64Array:
    """Return points (n, k) that are uniform in a ball, from uniform numbers.

    They are a direction from k normal numbers, times a length (Muller 1959).

    Args:
        center: (k,) center of the ball.
        radius: its radius.
        uniform: (n, k + 1) in [0, 1], with that of the length last.
    """
    # Normal numbers, by the inverse distribution; 0 and 1 would give infinities.
    direction = ndtri(np.clip(uniform[:, :-1], MIN_UNIFORM, 1.0 - MIN_UNIFORM))
    # The volume within a length r grows as r^k: r is the root of a uniform number.
    length = radius * uniform[:, -1:] ** (1.0 / len(center))
    # no division by 0, where all numbers are 0.5
    norm = np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), MIN_NORM)
    return np.asarray(center + direction * (length / norm))


def _find_free_columns(blocks: Sequence[_SampledBlock], block: Block) -> slice:
    """Return the columns of the draws of a block, right after those of other blocks."""
    first_column = _count_columns(blocks)
    n_columns = block.size + 1 if block.norm == "l2" else block.size
    return slice(first_column, first_column + n_columns)


def _select_options(spec: OneOf, column: Tensor) -> list[Any]:
    """Return the options that coordinates (n,) in [0, 1] stand for."""
    count = len(spec.values)
    return [
        spec.values[min(count - 1, int(coordinate * count))]
        for coordinate in column.tolist()
    ]


def _is_described_by_base(control: Control) -> bool:
    """Return whether a control describes its values as the base class does."""
    control_type = type(control)
    return (
        control_type.describe == Control.describe
        and control_type.compute_measurements == Control.compute_measurements
    )


def _count_columns(blocks: Sequence[_SampledBlock]) -> int:
    """Return how many columns the draws of blocks have; the last block has the last."""
    return blocks[-1].columns.stop if blocks else 0


def _stored_unit(parameter: Parameter) -> str:
    """Return the unit that is stored with a value; the unit of an option is "name"."""
    return "name" if parameter.options else parameter.unit


def _find_spec(bound: Control, name: str) -> tuple[Parameter, Range | OneOf]:
    """Return a parameter of a bound control, and the range that it varies over."""
    slot = next(slot for slot in bound.parameter_slots if slot.parameter.name == name)
    assert not isinstance(slot.parameter_spec, Fixed)
    return slot.parameter, slot.parameter_spec
