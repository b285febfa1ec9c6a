"""The base class of controls.

A control is a named family of scene parameters, such as the object's pose. A
configuration is a vector u in the unit box [0, 1]^d. Each control reads a slice of u
and maps it to scene inputs, by differentiable torch operations.

Most controls declare a few named numbers. The user fixes each of them, or sets a range
or a list of values. The method `scene_inputs` defines their effect on the scene
(docs/controls/writing.md):

    class Exposure(Control):
        kind = "exposure"
        summary = "How bright the image is."
        parameters = (
            Parameter(
                "stops", (), "stops", -10, 10, 0.0, "Over the metered exposure.",
                search=(-2, 2),
            ),
        )

        def scene_inputs(self, values, earlier_inputs):
            return {"camera.exposure": values["stops"]}
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor

from advsearch.controls.ranges import (
    Fixed,
    OneOf,
    ParameterValue,
    Range,
    Slot,
    Spec,
    format_value,
    is_same_value,
    parse_spec,
    to_plain_value,
)
from advsearch.copies import copy_method_arguments, copy_value, is_package_class
from advsearch.distributions import distribution_to_setting
from advsearch.errors import InputError, UnknownNameError
from advsearch.options import Value as Value
from advsearch.options import format_rounded
from advsearch.scene.description import (
    ENVIRONMENT,
    OBJECT,
    SceneDescription,
    check_single_environment,
)
from advsearch.scene.gradients import FULL_RANGE as FULL_RANGE
from advsearch.scene.gradients import Budget as Budget
from advsearch.scene.gradients import Group as Group
from advsearch.scene.parts import MeshPart, PluginPart
from advsearch.scene.settings import SETTINGS
from advsearch.scene.settings import Parameter as Parameter

if TYPE_CHECKING:
    from typing_extensions import Self

# upper bound of every `epsilon`, the largest distance from the start, in any norm
MAX_EPSILON = 1e6

# The range of a control may exclude a value of the clean scene. If the user set that
# value, the two settings contradict each other, which is an error. If it is only a
# default, the clean scene gets the nearest value in the range, and the change is
# reported as an `AdjustedDefault`.


@dataclass(frozen=True)
class AdjustedDefault:
    """A default value of the clean scene that a control had to adjust.

    Attributes:
        control_name: name of the control.
        parameter_name: parameter that was adjusted (``pose.yaw``, ``ground.size``,
            ``environment``).
        unit: unit of the values; "name" for names.
        scene_value: value in the scene as it was described.
        used_value: the value that is used instead.
    """

    control_name: str
    parameter_name: str
    unit: str
    scene_value: ParameterValue
    used_value: ParameterValue


def describe_adjusted_defaults(adjusted: Sequence[AdjustedDefault]) -> list[str]:
    """Return a sentence for each control about the values that it adjusted.

    For example "The clean scene has pose.yaw 10 degrees instead of 0, which the control
    pose leaves out.": the range of `pose` leaves out 0.

    Args:
        adjusted: adjusted values; those of the same control follow each other.
    """
    sentences = []
    for control, values in groupby(adjusted, key=lambda value: value.control_name):
        adjustments = " and ".join(map(_describe_adjustment, values))
        sentences.append(
            f"The clean scene has {adjustments}, which the control {control} leaves "
            "out."
        )
    return sentences


def _describe_adjustment(value: AdjustedDefault) -> str:
    """Return a clause such as "pose.yaw 10 degrees instead of 0"."""
    unit = f" {value.unit}"
    if value.unit in ("1", "name") or isinstance(value.used_value, str):
        unit = ""
    used = _format_briefly(value.used_value)
    scene = _format_briefly(value.scene_value)
    if used == scene:  # the values differ by less than the rounding: show more digits
        used = format_value(value.used_value)
        scene = format_value(value.scene_value)
    return f"{value.parameter_name} {used}{unit} instead of {scene}"


def _format_briefly(value: ParameterValue) -> str:
    """Return a value as text, a number with few digits."""
    return value if isinstance(value, str) else format_rounded(value)


def find_replaced_defaults(
    control: str, before: SceneDescription, after: SceneDescription
) -> Iterator[AdjustedDefault]:
    """Yield the default values of a scene that a control has replaced.

    They are the environment, and settings such as "ground.size" that differ between
    both scenes. A value that the user set must not be replaced.

    Args:
        control: name of the control, for messages.
        before: scene before the control has prepared it.
        after: scene that the control returned.

    Raises:
        InputError: the control replaced a value that the user set.
    """
    environment = _find_replaced_environment(control, before, after)
    if environment is not None:
        yield environment
    for name, value in after.values.items():
        value_before = before.values[name]
        # None is a default that the scene computes: it has no value to compare.
        if value is None or value_before is None or is_same_value(value, value_before):
            continue
        _check_is_default(control, name, before, value)
        yield AdjustedDefault(control, name, SETTINGS[name].unit, value_before, value)


def _check_is_default(
    control: str, name: str, before: SceneDescription, new_value: float
) -> None:
    """Raise InputError if the user set a value of a scene that a control replaces.

    Args:
        control: name of the control.
        name: name of the setting, such as "ground.size".
        before: scene before the control has prepared it.
        new_value: value by the control.
    """
    if name in before.requested:
        value_before = before.values[name]
        assert value_before is not None  # the caller skips those without a value
        raise InputError(
            f"`set` {name}={format_value(value_before)} and `controls` {control} "
            "contradict each "
            "other: the control makes it "
            f"{format_rounded(new_value)}; change one of the two, or leave one out"
        )


def _find_replaced_environment(
    control: str, before: SceneDescription, after: SceneDescription
) -> AdjustedDefault | None:
    """Return the environment that a control has replaced in a scene, or None.

    Args:
        control: name of the control, for messages.
        before: scene before the control has prepared it.
        after: scene that the control returned.

    Raises:
        InputError: the user set the environment that was replaced; or a part of the
            scene is an environment too.
    """
    if after.environment is None or after.environment is before.environment:
        return None
    check_single_environment(after.parts, f"`controls` {control}")
    _check_environment_is_default(control, before, after.environment.name)
    # If the control has recorded the new name in the scene, `compose_space` reads it
    # there, and no adjusted default is needed.
    if after.environment_spec != before.environment_spec:
        return None
    return AdjustedDefault(
        control, ENVIRONMENT, "name", before.environment_spec, after.environment.name
    )


def _check_environment_is_default(
    control: str, before: SceneDescription, new_name: str
) -> None:
    """Raise InputError if the user set the environment that a control replaces.

    Args:
        control: name of the control.
        before: scene before the control has prepared it.
        new_name: name of the new environment.
    """
    if ENVIRONMENT in before.requested:
        raise InputError(
            f"`environment={before.environment_spec}` and `controls` {control} "
            "contradict each other: the control "
            f"puts {new_name} in its place; leave one of the two out"
        )


NO_INPUTS: Mapping[str, Tensor] = MappingProxyType({})  # no scene inputs yet


@dataclass(frozen=True)
class Choice:
    """A setting of a control that is not searched, such as a norm or a resolution.

    If neither `options`, `integer_bounds` nor `max_value` is set, any value is allowed,
    and `Control.check_choices` should check it.

    Attributes:
        name: name of the setting, without that of the control.
        default: value that is used if the user sets none.
        description: one sentence for the user.
        run_setting: setting of a run that sets this choice for all its controls, such
            as "epsilon". A value that the user sets in the control itself takes
            precedence. Empty if there is no such setting.
        bounds: name of the parameter that this choice limits. The choice has no effect
            if that parameter is not searched. Empty if it always has an effect.
        fixes: name of the parameter that is not searched if this choice is set. Empty
            if there is none.
        options: allowed names. Empty if the value is no name.
        integer_bounds: smallest and largest allowed integer. None if the value need
            not be an integer.
        max_value: largest allowed number. Numbers have to be positive, unless `signed`
            is true. None if the value is not limited by it.
        signed: whether numbers from ``-max_value`` to `max_value` are allowed,
            including 0.
    """

    name: str
    default: float | str | None
    description: str
    run_setting: str = ""
    bounds: str = ""
    fixes: str = ""
    options: tuple[str, ...] = ()
    integer_bounds: tuple[int, int] | None = None
    max_value: float | None = None
    signed: bool = False

    def check(self, control: str, value: object) -> None:
        """Check a value of this choice.

        Args:
            control: name of the control, for messages.
            value: what the user set; None is allowed if it is the default.

        Raises:
            InputError: the value is not allowed.
        """
        if value is None and self.default is None:
            return
        expected = self._describe_expected()  # None if any value is allowed
        if expected is not None and not self._is_valid(value):
            raise InputError(
                f"{control}.{self.name}: expected {expected}, got {value!r}"
            )

    def _describe_expected(self) -> str | None:
        """Return a phrase about the allowed values; None if any value is allowed.

        For example "a whole number from 1 to 64".
        """
        if self.options:
            return f"one of {', '.join(self.options)}"
        if self.integer_bounds is not None:
            low, high = self.integer_bounds
            return f"a whole number from {low} to {high}"
        if self.max_value is None:
            return None
        if self.signed:
            return f"a number from {-self.max_value:g} to {self.max_value:g}"
        return f"a number over 0 and up to {self.max_value:g}"

    def _is_valid(self, value: object) -> bool:
        """Return whether a value is among those of `_describe_expected`."""
        if self.options:
            return value in self.options
        return Parameter.is_number(value) and self._is_in_bounds(value)

    def _is_in_bounds(self, value: float) -> bool:
        """Return whether a number meets `integer_bounds`, or `max_value` and `signed`.

        Without either any number does.
        """
        if self.integer_bounds is not None:
            low, high = self.integer_bounds
            return low <= value <= high and value == int(value)
        if self.max_value is None:
            return True
        if self.signed:
            return abs(value) <= self.max_value
        return 0.0 < value <= self.max_value


Values = Mapping[str, Tensor]
"""The value of each parameter of a control, by the parameter's name.

A value is a float32 tensor of the parameter's shape. For a parameter with named options
it is the index of the option.
"""


class Control:
    """Base class for all controls: a family of scene parameters.

    Your controls should subclass this class and define `kind`, `parameters` and
    `scene_inputs`.

    A control has parameters, which can be searched, and choices, which can't. If the
    user sets a range or a list of values for any parameter, only such parameters are
    searched. Otherwise every parameter with a `search` range is searched over that.
    `bind` returns a copy of the control for a scene, which maps a slice of u to scene
    inputs.

    Attributes:
        kind: name of the control on the command line.
        summary: one sentence for the user. The first paragraph of the class docstring
            by default.
        parameters: parameters that can be searched.
        choices: settings that are not searched.
        targets_mesh: whether the control acts on one mesh, which can be another mesh
            than the object under test. The control of such a mesh is named
            ``KIND:MESH``.
        strength_parameter: name of the parameter that switches the control off, such
            as the power of a lamp: at its value in the clean scene, the other
            parameters have no effect. None if there is no such parameter.
        instance_parameters: parameters of this instance, as `declare_parameters`
            returns them for its settings.
        choice_values: value of each choice, by name.
        specs: fixed value, range or list of values of each parameter that the user
            set, by name.
        has_requested_range: whether the user set a range or a list of values for any
            parameter.
        scene: scene after all controls have prepared it. Set by `bind`.
        start: (d,) float32 in [0, 1], the configuration that leaves the scene
            unchanged. Set by `bind`.
        groups: groups of coordinates that are differentiated alike, in the order of
            the coordinates. Their sizes add up to d. Set by `bind`.
        parameter_slots: each parameter with its spec and the offset of its coordinates, in the
            order of the coordinates. Empty if coordinates are not single parameters,
            such as pixels. Set by `bind`.
        adjusted_defaults: default values of the clean scene that the ranges exclude.
            The start has the nearest allowed values instead. Set by `bind`.
        refines: names of scene inputs of earlier controls that this control reads and
            may change. For example, a patch changes the texture that a material
            control has set.
        on_top: whether this control is evaluated after all others that refine the same
            input, in whichever order the user names them. For example, a patch lies on
            any material.
        exposure: seconds during which the shutter is open, and seconds in which all
            rows of an image are read out, negative if the lowest row is read first. See
            `advsearch.scene.formation`.
        flashes: largest number of times per second that the control changes its light.
        travels: whether the control moves something along a path. It then has the
            attribute `seconds` and the method `distances`.
        PATH_PARAMETER: name of the parameter that selects one of several paths, if the
            control travels.
        competes_with_ambient: whether the control adds light that is less visible in
            brighter ambient light. See `ambient_lux`.
        photograph_refusal: reason why the control can't be used if the scene is
            rendered into a photograph. Empty if it can.
    """

    PATH_PARAMETER: ClassVar[str] = "way"
    kind: ClassVar[str]
    summary: ClassVar[str]
    parameters: ClassVar[tuple[Parameter, ...]]
    choices: ClassVar[tuple[Choice, ...]] = ()
    targets_mesh: ClassVar[bool] = False
    travels: ClassVar[bool] = False
    competes_with_ambient: ClassVar[bool] = False
    strength_parameter: ClassVar[str | None] = None
    photograph_refusal: ClassVar[str] = ""
    on_top: bool = False
    name: str
    scene: SceneDescription
    start: Tensor
    groups: tuple[Group, ...]
    parameter_slots: tuple[Slot, ...] = ()
    adjusted_defaults: tuple[AdjustedDefault, ...] = ()
    exposure: tuple[float, float] = (0.0, 0.0)
    flashes: float = 0.0

    def __init_subclass__(cls, **more: Any) -> None:
        """Make the methods of a user's subclass get copies of tensors; set `summary`.

        Without a `summary`, the first paragraph of the docstring of the class is used.
        """
        super().__init_subclass__(**more)
        names = [method.__name__ for method in METHODS_WITH_COPIES]
        all_arguments = slice(None)
        copy_method_arguments(cls, **dict.fromkeys(names, all_arguments))
        if "summary" not in vars(cls) and cls.__doc__:
            first_paragraph = cls.__doc__.partition("\n\n")[0]
            cls.summary = " ".join(first_paragraph.split())

    def __init__(self, name: str | None = None, **settings: object) -> None:
        """Read and check the settings of a control, without a scene.

        Args:
            name: name of this instance; by default its kind, e.g. "pose".
            **settings: value, range or list of values of each parameter, and values of
                choices. A setting of None counts as left out, but must have a valid
                name.

        Raises:
            InputError: a setting is out of range or of a wrong form.
            UnknownNameError: there is no such setting.
        """
        self.name = name or self.kind
        settings = {
            setting: distribution_to_setting(value)
            for setting, value in settings.items()
        }
        self.instance_parameters = self.declare_parameters(settings)
        self._check_setting_names(settings)
        self._settings = _list_stated_settings(settings)
        self.choice_values: dict[str, Any] = self._collect_choice_values()
        self.check_choices()
        self.specs = self._parse_specs()
        self.has_requested_range = any(
            not isinstance(spec, Fixed) for spec in self.specs.values()
        )

    def _collect_choice_values(self) -> dict[str, Any]:
        """Return the value of each choice by name, set by the user or the default.

        Raises:
            InputError: a value is not allowed.
        """
        values = {
            choice.name: self._settings.get(choice.name, choice.default)
            for choice in self.choices
        }
        for choice in self.choices:
            choice.check(self.name, values[choice.name])
        return values

    def _check_setting_names(self, settings: Iterable[str]) -> None:
        """Raise UnknownNameError for a setting that is no parameter and no choice."""
        parameter_names = [parameter.name for parameter in self.instance_parameters]
        known = parameter_names + [choice.name for choice in self.choices]
        for setting in settings:
            if setting not in known:
                raise UnknownNameError(
                    f"setting of control {self.kind}", setting, known
                )

    def _parse_specs(self) -> dict[str, Spec]:
        """Return the fixed value, range or list of each parameter that the user set."""
        specs: dict[str, Spec] = {}
        for parameter in self.instance_parameters:
            name = parameter.name
            if name in self._settings:
                specs[name] = parse_spec(
                    f"{self.name}.{name}", parameter, self._settings[name]
                )
        return specs

    @classmethod
    def declare_parameters(cls, settings: Iterable[str]) -> tuple[Parameter, ...]:
        """Return the parameters of an instance with some settings.

        By default they are the parameters of the class. A subclass whose parameters
        depend on the user's settings can override this method, for example if the names
        of the settings are those of joints.

        Args:
            settings: names of the settings, or a mapping from names to values.
        """
        return cls.parameters

    @staticmethod
    def list_allowed_names(settings: object, parameter: str) -> list[str]:
        """Return the names that settings allow for a parameter, for `declare_parameters`.

        A parameter may be set to a name, a list of names, or {"choices": [...]}. Values
        that are no strings are left out.

        Args:
            settings: settings of a control; if they are no mapping, the result is empty.
            parameter: name of the parameter.
        """
        setting = settings.get(parameter) if isinstance(settings, Mapping) else None
        if isinstance(setting, Mapping):
            setting = setting.get("choices")
        names: Sequence[object] = [setting]
        if isinstance(setting, Sequence) and not isinstance(setting, str):
            names = setting
        return [name for name in names if isinstance(name, str)]

    def check_choices(self) -> None:
        """Check the values of the choices together; they are in `self.choice_values`.

        Does nothing by default. `Choice.check` has checked each value by itself.
        Subclasses override this for the rest, such as choices that exclude each other.

        Raises:
            InputError: the value of a choice is not allowed.
        """

    def to_settings(self) -> dict[str, object]:
        """Return JSON values from which `make_control` makes an equal instance."""
        if self.name == self.kind:
            return dict(self._settings)
        return {"kind": self.kind, **self._settings}

    @property
    def mesh_name(self) -> str:
        """Name of the mesh that the control acts on.

        It is "chair" for the control "pose:chair", and "object" for "pose" and for every
        control whose kind does not act on a mesh, such as "light:key".
        """
        name_after_colon = self.name.partition(":")[2]
        if not self.targets_mesh or not name_after_colon:
            return OBJECT
        return name_after_colon

    @property
    def name_in_files(self) -> str:
        """Name of the control in file names, which have no colon."""
        return to_file_name(self.name)

    def get_mesh(self, scene: SceneDescription) -> MeshPart:
        """Return the mesh of a scene that the control acts on, e.g. "chair".

        Raises:
            UnknownNameError: the scene has no such mesh.
            InputError: the mesh belongs to the surroundings of a Mitsuba scene, which
                this control can't change.
        """
        name = self.mesh_name
        if name in scene.meshes:
            return scene.meshes[name]
        plugin_parts = [part for part in scene.parts if isinstance(part, PluginPart)]
        if any(part.name == name for part in plugin_parts):
            raise self._make_surroundings_error(name)
        hint = f"It stands in `controls` {self.name}."
        raise UnknownNameError("mesh of the scene", name, scene.meshes, hint)

    def _make_surroundings_error(self, mesh: str) -> InputError:
        """Return the error for a mesh around the object in a Mitsuba scene."""
        return InputError(
            f"`controls` {self.name}: {mesh} is around the object in a Mitsuba "
            "scene, and stays as it is; "
            "make it the object, or vary its numbers by Mitsuba's names, "
            f"mitsuba:{mesh}.KEY=[low, high]"
        )

    def get_setting_name(self, parameter: Parameter) -> str:
        """Return the name that a parameter would have among the scene's settings.

        For example "pose.yaw". There need not be such a setting.
        """
        prefix = self.kind if self.mesh_name == OBJECT else self.name
        return f"{prefix}.{parameter.name}"

    def select_form(self, forms: Sequence[str]) -> str:
        """Return the form in which a control acts, such as "palette" for `texture`.

        Each form has one parameter. The user requests a form by the setting `form`, or
        by setting the form's parameter to its full range, e.g. ``texels: [0, 1]``. Any
        other range is an error: the setting `epsilon`, not a range, limits how far the
        parameter may go.

        Args:
            forms: name of the form of each parameter of the class, in the order of
                `parameters`; the first is the default.

        Raises:
            InputError: two forms are requested, or a parameter is set to something
                else than its full range.
            UnknownNameError: there is no such form.
        """
        requested = []
        for parameter, form in zip(self.parameters, forms, strict=True):
            if self._settings.get(parameter.name) is not None:
                self._check_is_full_range(parameter)
                requested.append(form)
        if "form" in self._settings:
            requested.append(self._read_form(forms))
        if len(set(requested)) > 1:
            raise InputError(
                f"{self.name}.form: expected one form, got {', '.join(requested)}"
            )
        return requested[0] if requested else forms[0]

    def _read_form(self, forms: Sequence[str]) -> str:
        """Return the setting `form`; raise UnknownNameError if it is none of the forms."""
        form = str(self._settings["form"])
        if form not in forms:
            raise UnknownNameError(f"{self.name}.form", form, forms)
        return form

    def _check_is_full_range(self, parameter: Parameter) -> None:
        """Raise InputError if a parameter is set to less than its full range."""
        value = self._settings[parameter.name]
        full_range = [parameter.low, parameter.high]
        if value not in (full_range, tuple(full_range)):
            raise InputError(
                f"{self.name}.{parameter.name}: expected no value but "
                f"[{parameter.low:g}, {parameter.high:g}], got "
                f"{value!r}; set how far it may go with {self.name}.epsilon"
            )

    def list_allowed_values(
        self, parameter: str, *defaults: ParameterValue
    ) -> tuple[ParameterValue, ...]:
        """Return the values that a parameter may have, if they can be listed.

        Args:
            parameter: name of the parameter.
            *defaults: values that are returned if the user did not set the parameter,
                or set it to a range.
        """
        spec = self.specs.get(parameter)
        if isinstance(spec, OneOf):
            return spec.values
        if isinstance(spec, Fixed):
            return (spec.value,)
        return defaults

    def is_searched(self, parameter: str) -> bool:
        """Return whether a parameter is searched, if it has a default search range."""
        if parameter in self.specs:
            return not isinstance(self.specs[parameter], Fixed)
        return not self.has_requested_range

    # ---- in a scene

    def prepare(self, scene: SceneDescription) -> SceneDescription:
        """Return the scene with the parts that this control needs, such as a lamp.

        Returns the scene unchanged by default.

        Raises:
            InputError: the control does not fit the scene.
        """
        return scene

    def with_scene(self, scene: SceneDescription) -> Self:
        """Return a copy with a scene, which is not bound to it yet (see `bind`)."""
        in_scene = copy.copy(self)
        in_scene.scene = scene if is_package_class(type(self)) else copy_value(scene)
        return in_scene

    def bind(self, scene: SceneDescription) -> Self:
        """Return a copy that is bound to a scene, which all controls have prepared.

        Raises:
            InputError: a setting of the control is impossible in this scene.
        """
        bound = self.with_scene(scene)
        bound.bind_parameters()
        return bound

    def bind_parameters(self) -> None:
        """Set the slots, start, groups and adjusted defaults for `self.scene`.

        A slot is a parameter with the position of its coordinates in the control's
        slice of u; a fixed parameter has no coordinates. A group has the coordinates of
        one searched parameter.

        Raises:
            InputError: a setting of the control is impossible in this scene.
        """
        slots = self._make_slots()
        self.parameter_slots = tuple(slots)
        self.adjusted_defaults = tuple(self._list_adjusted_defaults())
        start_coordinates = [
            coordinate for slot in slots for coordinate in slot.get_start_coordinates()
        ]
        self.start = torch.tensor(start_coordinates, dtype=torch.float32)
        self.groups = tuple(
            self._make_group(slot) for slot in slots if slot.n_coordinates
        )
        low_and_span = _compute_low_and_span(slots)
        self._low = low_and_span[:, 0].contiguous()
        self._span = low_and_span[:, 1].contiguous()

    def _make_slots(self) -> list[Slot]:
        """Return each parameter with the offset of its coordinates."""
        slots = list[Slot]()
        begin = 0
        for parameter, spec in self.list_parameter_specs():
            slot = Slot(parameter, spec, begin)
            slots.append(slot)
            begin += slot.n_coordinates
        return slots

    def resolve_parameter(self, parameter: Parameter) -> Parameter:
        """Return a parameter with its value in the unchanged scene as the default.

        Subclasses can also adapt its search range, unit, shape and estimators to the
        scene.
        """
        value = self.scene.values.get(self.get_setting_name(parameter))
        return parameter if value is None else replace(parameter, default=value)

    def get_clean_value(self, name: str) -> ParameterValue:
        """Return the value of a parameter in the unchanged scene."""
        return next(
            self.resolve_parameter(parameter).default
            for parameter in self.instance_parameters
            if parameter.name == name
        )

    def get_value_without_control(self, parameter: Parameter) -> ParameterValue:
        """Return the value of a parameter in the scene as it was described.

        By default it is the parameter's default. Subclasses override this if that
        changes the scene: a scene without a lamp has a lamp of power 0, but the default
        power of a lamp whose color is searched is not 0.

        Args:
            parameter: parameter as `resolve_parameter` returned it.
        """
        return parameter.default

    def get_parameter_spec(self, parameter: Parameter) -> Spec:
        """Return the spec of a parameter: a fixed value, a range or a list of values.

        A parameter that the user did not set is searched over its default range. But it
        is fixed at its default value if it has no such range, or if the user set a
        range for another parameter.

        Args:
            parameter: parameter with its range in the scene (`resolve_parameter`).
        """
        if parameter.name in self.specs:
            return self.specs[parameter.name]
        if self.has_requested_range or parameter.search is None:
            return Fixed(parameter.default)
        if parameter.options:
            return OneOf(parameter.options)
        return Range(*parameter.search)

    def get_budget(self, parameter: Parameter) -> Budget:
        """Return how far a searched parameter may go: its full range by default."""
        return FULL_RANGE

    def list_parameter_specs(self) -> Iterator[tuple[Parameter, Spec]]:
        """Yield the parameters in the order of their coordinates, with their specs."""
        for parameter in map(self.resolve_parameter, self.instance_parameters):
            yield parameter, self.get_parameter_spec(parameter)

    def must_start_at_clean_value(self, parameter: Parameter, spec: Spec) -> bool:
        """Return whether the start should have the clean scene's value of a parameter.

        True by default. If it is false, a start with another value is not reported as
        an adjusted default.
        """
        return True

    def record_adjusted_default(
        self,
        parameter: Parameter,
        scene_value: ParameterValue,
        used_value: ParameterValue,
    ) -> None:
        """Record that the search starts at another value than the clean scene has.

        Args:
            parameter: the parameter.
            scene_value: its value in the clean scene.
            used_value: its value at the start of the search.
        """
        label = f"{self.name}.{parameter.name}"
        adjusted = AdjustedDefault(
            self.name, label, parameter.unit, scene_value, used_value
        )
        self.adjusted_defaults = (*self.adjusted_defaults, adjusted)

    def _list_adjusted_defaults(self) -> Iterator[AdjustedDefault]:
        """Yield the parameters whose start differs from the value in the clean scene.

        Parameters that the user fixed in the control are left out. If the control has a
        `strength_parameter`, such as the density of a haze, only that is compared: at
        its value in the clean scene, the other parameters have no effect.

        Raises:
            InputError: the user set the value in the scene, and the control does not
                allow that value.
        """
        for slot in self.parameter_slots:
            adjusted = self._find_adjusted_default(slot)
            if adjusted is not None:
                yield adjusted

    def _find_adjusted_default(self, slot: Slot) -> AdjustedDefault | None:
        """Return the adjusted default of a parameter; None if it is not adjusted."""
        parameter = slot.parameter
        if not self.must_start_at_clean_value(parameter, slot.parameter_spec):
            return None
        scene_value = self.get_value_without_control(parameter)
        used = slot.get_start_value()
        if self._depends_on_strength(parameter):
            return None
        if is_same_value(used, scene_value, is_angle=slot.is_angle):
            return None
        self._check_allows_scene_value(slot, scene_value)
        is_fixed_by_user = isinstance(self.specs.get(parameter.name), Fixed)
        if is_fixed_by_user:
            return None
        return self._make_adjusted_default(parameter, scene_value, used)

    def _make_adjusted_default(
        self, parameter: Parameter, scene_value: ParameterValue, used: ParameterValue
    ) -> AdjustedDefault:
        """Return the record of a parameter that starts at another value than the scene's.

        Args:
            parameter: the parameter.
            scene_value: its value in the scene, without the control.
            used: the value that it starts at.
        """
        return AdjustedDefault(
            control_name=self.name,
            parameter_name=self._get_reported_name(parameter),
            unit="name" if parameter.options else parameter.unit,
            scene_value=scene_value,
            used_value=used,
        )

    def _depends_on_strength(self, parameter: Parameter) -> bool:
        """Return whether a parameter only has an effect if another one has strength."""
        # Without its strength, the control has no effect, whatever this parameter is.
        return (
            self.strength_parameter is not None
            and parameter.name != self.strength_parameter
        )

    def _check_allows_scene_value(
        self, slot: Slot, scene_value: ParameterValue
    ) -> None:
        """Raise InputError if the user set a scene's value that a control excludes."""
        setting = self.get_setting_name(slot.parameter)
        if setting in self.scene.requested:
            label = f"{self.name}.{slot.parameter.name}"
            raise InputError(
                f"{self._quote_setting(setting)} and `controls` {self.name} "
                "contradict "
                f"each other: {label} is {slot.parameter_spec}, "
                f"which leaves {format_value(scene_value)} out; change one of the "
                "two, or "
                "leave one out"
            )

    def _get_reported_name(self, parameter: Parameter) -> str:
        """Return the name of a parameter in an `AdjustedDefault`, such as "pose.yaw".

        The environment is one value, which several controls may replace: it has the
        same name in all of them.
        """
        setting = self.get_setting_name(parameter)
        return setting if setting == ENVIRONMENT else f"{self.name}.{parameter.name}"

    def _quote_setting(self, setting: str) -> str:
        """Return how the user writes a setting of the scene, with its value."""
        if setting == ENVIRONMENT:
            return f"`environment={self.scene.environment_spec}`"
        return f"`set` {setting}={format_value(self.scene.get_number(setting))}"

    def _make_group(self, slot: Slot) -> Group:
        """Return the group of coordinates of a searched parameter.

        A list of values gets no gradient estimators, since it has no derivative.

        Args:
            slot: the parameter with its spec.

        Raises:
            InputError: the user set a distribution for a parameter that is searched
                in the ball of a norm.
        """
        parameter = slot.parameter
        name = parameter.name
        spec = slot.parameter_spec
        setting = self.get_setting_name(parameter)
        if isinstance(spec, OneOf):
            return Group(
                name,
                slot.n_coordinates,
                valid=(),
                options=len(spec.values),
                setting=setting,
            )
        budget = self.get_budget(parameter)
        self._check_has_no_distribution(name, spec, budget)
        return Group(
            name,
            slot.n_coordinates,
            parameter.estimators,
            budget,
            periodic=slot.is_full_turn,
            setting=setting,
        )

    def _check_has_no_distribution(
        self, parameter: str, spec: Spec, budget: Budget
    ) -> None:
        """Raise InputError for a distribution in the ball of a norm."""
        # A distribution is a subclass of `Range`.
        is_distribution = type(spec) is not Range
        is_limited_by_norm = budget != FULL_RANGE
        if is_distribution and is_limited_by_norm:
            raise InputError(
                f"{self.name}.{parameter}: expected a range, got a distribution; its "
                "values are limited by a norm (epsilon)"
            )

    @property
    def ambient_lux(self) -> float | None:
        """Ambient light in lux, in addition to the light of this control.

        None if there is none, or if it is searched.
        """
        return None

    def scale_ambient(self, factor: float) -> Self:
        """Return the bound control with its ambient light scaled by a factor."""
        return self

    def advance_time(self, seconds: float) -> Control:
        """Return the control at a later time; itself if it does not depend on time."""
        return self

    @property
    def largest_group_budget(self) -> Budget:
        """Budget of the largest group of coordinates, which stands for all of them."""
        if not self.groups:
            return FULL_RANGE
        return max(self.groups, key=lambda group: group.size).budget

    @property
    def refines(self) -> frozenset[str]:
        """Names of the earlier controls' scene inputs that this control may change.

        A subclass can define a class attribute instead.
        """
        return frozenset()

    # ---- at a configuration

    def compute_values(self, u: Tensor) -> dict[str, Tensor]:
        """Return the value of every parameter, fixed ones too.

        Args:
            u: (d,) the control's slice of a configuration, in [0, 1].

        Returns:
            By name, float32 of the parameter's shape and in its unit. For a parameter
            with named options it is the index of the option.
        """
        values: dict[str, Tensor] = {}
        if not self.parameter_slots:
            return values
        # All coordinates are interpolated linearly at once, which is fast. Those with a
        # logarithmic scale or a distribution are interpolated again.
        linear = self._low.to(u) + self._span.to(u) * u
        for slot in self.parameter_slots:
            name = slot.parameter.name
            values[name] = _compute_slot_value(slot, u, linear)
        return values

    def scene_inputs(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Return the scene inputs that the values set, by name.

        Returns no inputs by default. Subclasses that act on the scene override it,
        by differentiable torch operations. Those that act on the finished image instead
        override `on_picture`, which `apply_to_image` calls.

        Args:
            values: value of each parameter, by name.
            earlier_inputs: inputs of the controls before this one. Only names in
                `refines` may be returned again.
        """
        return {}

    def inputs(
        self, u: Tensor, earlier_inputs: Mapping[str, Tensor] = NO_INPUTS
    ) -> dict[str, Tensor]:
        """Map a slice of u to scene inputs by name.

        The map is differentiable, and its results are on the device of u.

        Args:
            u: (d,) the control's slice of a configuration, in [0, 1].
            earlier_inputs: inputs of the controls before this one. Only names in
                `refines` may be returned again.
        """
        return self.scene_inputs(self.compute_values(u), earlier_inputs)

    def on_picture(self, values: Values, image: Tensor) -> Tensor:
        """Return the finished image as the values change it.

        Returns the image unchanged by default. Subclasses that act on the image override
        it, by differentiable torch operations.

        Args:
            values: value of each parameter, by name.
            image: (H, W, 3) display-referred sRGB in [0, 1].
        """
        return image

    def apply_to_image(self, u: Tensor, image: Tensor) -> Tensor:
        """Return the finished image as a configuration changes it.

        The result is differentiable in both arguments.

        Args:
            u: (d,) the control's slice of a configuration, in [0, 1].
            image: (H, W, 3) display-referred sRGB in [0, 1].
        """
        # Most controls leave the image unchanged, so that their values are not needed.
        if type(self).on_picture is Control.on_picture:
            return image
        return self.on_picture(self.compute_values(u), image)

    def compute_measurements(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Value]:
        """Return further values to store with a configuration; none by default.

        Args:
            values: value of each parameter, by name.
            earlier_inputs: inputs of the controls before this one.

        Returns:
            Values with their units (see `make_value_with_unit`), by name without that of
            the control.
        """
        return {}

    def describe(
        self, u: Tensor, earlier_inputs: Mapping[str, Tensor] = NO_INPUTS
    ) -> dict[str, Value]:
        """Describe a configuration by a few named values with units.

        They are the parameters that are not fixed, except images, and the values of
        `compute_measurements`. Names are `<control>.<parameter>`, such as "pose.yaw";
        elements of a vector have an index, such as "pose.rotation.0".

        Args:
            u: (d,) the control's slice of a configuration, in [0, 1].
            earlier_inputs: inputs of the controls that are evaluated before this one.
        """
        values = self.compute_values(u.detach())
        described: dict[str, Value] = {}
        for slot in self.parameter_slots:
            parameter = slot.parameter
            if not _is_described(slot):
                continue
            name = f"{self.name}.{parameter.name}"
            described |= _describe_value(name, parameter, values[parameter.name])
        measurements = self.compute_measurements(values, earlier_inputs)
        for name, measurement in measurements.items():
            described[f"{self.name}.{name}"] = measurement
        return described

    def get_numeric_values(self, u: Tensor) -> Mapping[str, Tensor]:
        """Return the numeric parameters of a configuration, by name.

        Parameters with named options, and images, are left out. Each value is (k,) or
        (), in the parameter's unit, and differentiable in u (d,).
        """
        values = self.compute_values(u)
        numbers = {}
        for slot in self.parameter_slots:
            parameter = slot.parameter
            if not parameter.options and len(parameter.shape) < 2:
                numbers[parameter.name] = values[parameter.name]
        return numbers

    def get_printable_colors(self, u: Tensor) -> Tensor | None:
        """Return the searched colors that would have to be printed; None without any.

        Returns:
            (h, w, 3) display-referred sRGB in [0, 1], differentiable in u. If only some
            colors are searched, (h, w, 4), where the fourth channel is 1 for those and
            0 for the others.
        """
        return None

    def make_artifact_images(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Return images to store with a result; none by default.

        Args:
            values: value of each parameter, by name.
            earlier_inputs: inputs of the controls before this one.

        Returns:
            Images (h, w, 3), display-referred sRGB in [0, 1], by file name without
            suffix.
        """
        return {}

    def get_artifact_images(
        self, u: Tensor, earlier_inputs: Mapping[str, Tensor] = NO_INPUTS
    ) -> dict[str, Tensor]:
        """Return images to store with a result, such as a texture.

        A subclass provides them by `make_artifact_images`.

        Args:
            u: (d,) the control's slice of a configuration, in [0, 1].
            earlier_inputs: inputs of the controls that are evaluated before this one.

        Returns:
            Images (h, w, 3), display-referred sRGB in [0, 1], by file name without
            suffix.
        """
        return self.make_artifact_images(
            self.compute_values(u.detach()), earlier_inputs
        )

    def make_artifact_files(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, bytes]:
        """Return other files to store with a result; none by default.

        Args:
            values: value of each parameter, by name.
            earlier_inputs: inputs of the controls before this one.

        Returns:
            Content of each file, by file name with suffix.
        """
        return {}

    def get_artifact_files(
        self, u: Tensor, earlier_inputs: Mapping[str, Tensor] = NO_INPUTS
    ) -> dict[str, bytes]:
        """Return other files to store with a result, such as a mesh as PLY.

        A subclass provides them by `make_artifact_files`.

        Args:
            u: (d,) the control's slice of a configuration, in [0, 1].
            earlier_inputs: inputs of the controls that are evaluated before this one.

        Returns:
            Content of each file, by file name with suffix.
        """
        return self.make_artifact_files(self.compute_values(u.detach()), earlier_inputs)


NumberControl = Control  # alias for packages that add controls


def _compute_low_and_span(slots: Sequence[Slot]) -> Tensor:
    """Return lower bound and width of the range of each coordinate, (d, 2) float64.

    All coordinates of a slot have the same range. A slot that is fixed, or has a list of
    values, has no range. `Control.compute_values` never reads the numbers of its
    placeholder.
    """
    placeholder = Range(0.0, 1.0)
    ranges = [
        slot.parameter_spec if isinstance(slot.parameter_spec, Range) else placeholder
        for slot in slots
    ]
    low_and_span_of_slot = torch.tensor(
        [(spec.low, spec.high - spec.low) for spec in ranges], dtype=torch.float64
    ).reshape(-1, 2)
    counts = torch.tensor([slot.n_coordinates for slot in slots], dtype=torch.long)
    # the row of a slot for each of its coordinates
    return low_and_span_of_slot.repeat_interleave(counts, dim=0)


def _list_stated_settings(settings: Mapping[str, object]) -> dict[str, Any]:
    """Return the settings that are not None, as plain values of Python."""
    return {
        setting: to_plain_value(value)
        for setting, value in settings.items()
        if value is not None
    }


def _compute_slot_value(slot: Slot, u: Tensor, linear: Tensor) -> Tensor:
    """Return the value of a parameter, of the parameter's shape.

    Args:
        slot: the parameter with its spec and its coordinates.
        u: (d,) the control's slice of a configuration.
        linear: (d,) the same, interpolated linearly between the bounds.
    """
    spec = slot.parameter_spec
    if isinstance(spec, Range):
        return _interpolate_slot(slot, spec, u, linear)
    if isinstance(spec, Fixed):
        return _to_tensor(spec.value, slot, u.device)
    # a list of values, `OneOf`, which has one coordinate
    selected = spec.select_value(u[slot.coordinate_offset])
    return _to_tensor(selected, slot, u.device)


def _interpolate_slot(slot: Slot, spec: Range, u: Tensor, linear: Tensor) -> Tensor:
    """Return the value of a parameter that has a range, of the parameter's shape.

    Args:
        slot: the parameter with its coordinates.
        spec: its range.
        u: (d,) the control's slice of a configuration.
        linear: (d,) the same, interpolated linearly between the bounds.
    """
    parameter = slot.parameter
    end = slot.coordinate_offset + slot.n_values
    coordinates = slice(slot.coordinate_offset, end)
    # A distribution is a subclass of `Range`.
    is_distribution = type(spec) is not Range
    if parameter.log or is_distribution:
        value = spec.interpolate(u[coordinates], log=parameter.log)
    else:
        value = linear[coordinates]
    return value if parameter.shape else value.reshape(())


def _is_described(slot: Slot) -> bool:
    """Return whether a parameter is listed in results: not fixed, and no image."""
    is_image = len(slot.parameter.shape) > 1  # numbers have (), vectors (k,)
    return not isinstance(slot.parameter_spec, Fixed) and not is_image


def _describe_value(name: str, parameter: Parameter, value: Tensor) -> dict[str, Value]:
    """Describe the value of a parameter; the elements of a vector have an index."""
    if parameter.options:
        # The value is the index of an option.
        option = parameter.options[int(value)]
        return {name: {"value": option, "unit": "name"}}
    if value.ndim == 0:
        return {name: make_value_with_unit(value, parameter.unit)}
    return {
        f"{name}.{index}": make_value_with_unit(number, parameter.unit)
        for index, number in enumerate(value)
    }


def _to_tensor(constant: ParameterValue, slot: Slot, device: torch.device) -> Tensor:
    """Return a fixed value as a tensor of the shape of its parameter.

    A name becomes its index among the parameter's options.

    Args:
        constant: the value; all elements of a vector have it.
        slot: the parameter with its spec.
        device: device of the tensor.
    """
    if isinstance(constant, str):
        return torch.full(
            (),
            float(slot.parameter.options.index(constant)),
            dtype=torch.float32,
            device=device,
        )
    # The values of a vector or an array are a flat vector, like its coordinates.
    shape = (slot.n_values,) if slot.parameter.shape else ()
    return torch.full(shape, float(constant), dtype=torch.float32, device=device)


METHODS_WITH_COPIES = (
    Control.prepare,
    Control.bind,
    Control.inputs,
    Control.apply_to_image,
    Control.describe,
    Control.get_artifact_images,
    Control.get_printable_colors,
    Control.get_numeric_values,
    Control.get_artifact_files,
    Control.scene_inputs,
    Control.on_picture,
    Control.compute_measurements,
    Control.make_artifact_images,
    Control.make_artifact_files,
)
"""Methods that get copies of their tensors if another package defines the control.

So such a control can't change the tensors of the caller in place.
"""


def make_value_with_unit(value: Tensor | float, unit: str) -> Value:
    """Return a number and its unit, as configurations are described."""
    return {"value": float(value), "unit": unit}


def describe_color_change(name: str, change: Tensor) -> dict[str, Value]:
    """Describe a change of searched colors by its maximum and its root mean square.

    Args:
        name: name of the control.
        change: tensor of any shape, in display-referred sRGB.
    """
    root_mean_square = change.square().mean().sqrt()
    return {
        f"{name}.linf": make_value_with_unit(change.abs().max(), "sRGB"),
        f"{name}.rms": make_value_with_unit(root_mean_square, "sRGB"),
    }


def to_file_name(name: str) -> str:
    """Return a control's name for file names: "texture@chair" for "texture:chair"."""
    return name.replace(":", "@")
