"""What a control is: a named family of scene parameters that may vary, and their map
from the unit box.

A control declares its parameters as data. Bound to a scene it has a slice of u and the
map from it to scene inputs, in torch. Most are a handful of named numbers, each fixed,
a range, or a list: they declare the parameters, and say in `scene_inputs` what they do
to the scene (docs/controls/writing.md):

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
from advsearch.copies import copy_value, hand_copies, is_ours
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

# no distance from where a control starts is larger, in whichever norm
MAX_EPSILON = 1e6

# Where a control leaves out a value of the clean scene that was asked for, the two
# contradict each other, and that is refused. Where it leaves out only a default, the
# clean scene has the nearest value that the control allows, and that is said: a
# `AdjustedDefault`.


@dataclass(frozen=True)
class AdjustedDefault:
    """A value of the clean scene that a control had to adjust, unrequested.

    Attributes:
        control: name of the control.
        parameter: parameter that was adjusted (``pose.yaw``, ``ground.size``,
            ``environment``).
        unit: unit of the values; "name" of names.
        scene: the value that the scene was described with.
        used: the value that is used instead.
    """

    control: str
    parameter: str
    unit: str
    scene: ParameterValue
    used: ParameterValue


def describe_adjusted_defaults(adjusted: Sequence[AdjustedDefault]) -> list[str]:
    """Return one sentence a control about the values that had to be adjusted."""
    result = []
    for control, values in groupby(adjusted, key=lambda value: value.control):
        adjustments = " and ".join(map(_describe_adjustment, values))
        result.append(
            f"The clean scene has {adjustments}, which the control {control} leaves "
            "out."
        )
    return result


def _describe_adjustment(value: AdjustedDefault) -> str:
    """Return a clause such as "pose.yaw 10 degrees instead of 0"."""
    unit = f" {value.unit}"
    if value.unit in ("1", "name") or isinstance(value.used, str):
        unit = ""
    used = value.used if isinstance(value.used, str) else format_rounded(value.used)
    scene = value.scene if isinstance(value.scene, str) else format_rounded(value.scene)
    if used == scene:
        used = format_value(value.used)
        scene = format_value(value.scene)
    return f"{value.parameter} {used}{unit} instead of {scene}"


def list_replaced_settings(
    control: str, before: SceneDescription, after: SceneDescription
) -> Iterator[AdjustedDefault]:
    """Yield the default values of a scene that a control has replaced.

    They are the environment, and settings such as "ground.size" that differ between
    both scenes.

    Args:
        control: name of the control, for messages.
        before: scene before the control has prepared it.
        after: scene that the control returned.

    Raises:
        InputError: a replaced value was set by the user, so it is no default.
    """
    environment = _find_replaced_environment(control, before, after)
    if environment is not None:
        yield environment
    for name, value in after.values.items():
        value_before = before.values[name]
        if value is None or value_before is None or is_same_value(value, value_before):
            continue
        if name in before.requested:
            raise InputError(
                f"`set` {name}={format_value(value_before)} and `controls` {control} "
                "contradict each "
                "other: the control makes it "
                f"{format_rounded(value)}; change one of the two, or leave one out"
            )
        yield AdjustedDefault(control, name, SETTINGS[name].unit, value_before, value)


def _find_replaced_environment(
    control: str, before: SceneDescription, after: SceneDescription
) -> AdjustedDefault | None:
    """Return the environment that a control has replaced in a scene, or None.

    It is also None if the new scene names the new environment in its
    `environment_spec`: then the environment is not an adjusted default.

    Args:
        control: name of the control, for messages.
        before: scene before the control has prepared it.
        after: scene that the control returned.

    Raises:
        InputError: the user set the environment that was replaced.
    """
    if after.environment is None or after.environment is before.environment:
        return None
    check_single_environment(after.parts, f"`controls` {control}")
    if ENVIRONMENT in before.requested:
        raise InputError(
            f"`environment={before.environment_spec}` and `controls` {control} "
            "contradict each other: the control "
            f"puts {after.environment.name} in its place; leave one of the two out"
        )
    if after.environment_spec != before.environment_spec:
        return None
    return AdjustedDefault(
        control, ENVIRONMENT, "name", before.environment_spec, after.environment.name
    )


NO_INPUTS: Mapping[str, Tensor] = MappingProxyType({})  # no scene inputs yet


@dataclass(frozen=True)
class Choice:
    """One setting of a control that is chosen, not searched (a norm, a resolution).

    Attributes:
        name: short name.
        default: what it is when nothing is said.
        description: one sentence.
        run_setting: the setting of a whole run that says it for all controls
            ("epsilon"), unless the control itself says something else; empty if there
            is none.
        bounds: the parameter that it says something about; empty if it counts always.
            Where that parameter is not searched, the control does not take the setting.
        fixes: the parameter that is not searched where this is chosen; empty if there
            is none.
        options: the names that can be chosen; empty for anything else.
        integer_bounds: the smallest and the largest whole number that can be chosen, or None.
        max_value: the largest number that can be chosen, all over 0; None for anything else.
        signed: numbers down to minus `max_value` can be chosen, too.
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
        expected = self._describe_expected()
        if expected is not None and not self._is_valid(value):
            raise InputError(
                f"{control}.{self.name}: expected {expected}, got {value!r}"
            )

    def _describe_expected(self) -> str | None:
        """Return a phrase about what can be chosen; None if anything can."""
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
        """Return whether a number can be chosen where numbers can be."""
        if self.integer_bounds is not None:
            low, high = self.integer_bounds
            return low <= value <= high and value == int(value)
        if self.max_value is None:
            return True
        return (
            abs(value) <= self.max_value
            if self.signed
            else 0.0 < value <= self.max_value
        )


Values = Mapping[str, Tensor]
"""A configuration: parameter name to a float32 tensor of the parameter's shape; of a
discrete choice, its number.
"""


class Control:
    """A family of scene parameters.

    `bind` returns a copy with a scene, which has a slice of u and maps it to inputs.

    It is made of named numbers and choices. Once one parameter is given a range or a
    list, only those given so are searched; otherwise each parameter is searched over
    its own `search` range, if it has one. Of a picture among the parameters, the
    numbers are not said one by one.

    Args:
        name: the instance's name; the kind unless given.
        **to_settings: a value for any parameter (fixed, range or list) or choice, by name.

    Attributes:
        kind: the word for it on the command line.
        summary: one sentence; of a class that says none, the first of its docstring.
        parameters: what may vary.
        choices: what may be chosen.
        targets_mesh: it is about one mesh, and may be about another than the object: the
            name of that is then `KIND:MESH`.
        strength_parameter: the parameter whose value in the scene as it was described means that
            the rest of the control does not show: the power of a lamp, say. None where
            the scene has all parameters of itself.
        instance_parameters: the parameters of this instance: `declare_parameters` of
            its settings.
        chosen: what is chosen, by name; the default where nothing was said.
        specs: what parameters were set to, of those that were given.
        has_requested_search: whether a parameter was given a range or a list.
        scene: once bound, the scene that all controls of the space have prepared.
        start: once bound, (d,) float32 in [0, 1], the value that leaves the scene as it
            is.
        groups: once bound, the coordinates of the slice in order; their sizes add up to
            d.
        slots: once bound, each parameter with what it is set to, in the order of its
            coordinates; none where its coordinates are no parameters one by one.
        adjusted_defaults: once bound, values of the clean scene that the start has not,
            because the control leaves them out.
        refines: the scene inputs that it takes from the controls before it, and may
            change (a patch on a texture).
        on_top: what it refines lies over what all other controls make of it, whatever
            the order in which they were asked for (a patch on any material).
        exposure: seconds that the shutter is open, and that the rows of a picture are
            read in, below 0 from the bottom; see `advsearch.scene.formation`.
        flashes: how often a second it changes its light at most.
        travels: whether it moves something along a path; it has `seconds` and
            `distances()` then, and its parameter `PATH_PARAMETER` says which path is
            taken where there are several.
        competes_with_ambient: whether it throws light that ambient light weakens, see
            `ambient`.
        photograph_refusal: why it would not be true of a scene that is rendered into a
            photograph; empty if it is.

    Raises:
        UnknownNameError: no such parameter or choice.
        InputError: a value is out of range.
    """

    # the parameter that says which of several paths is taken
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
    slots: tuple[Slot, ...] = ()
    adjusted_defaults: tuple[AdjustedDefault, ...] = ()
    exposure: tuple[float, float] = (0.0, 0.0)
    flashes: float = 0.0

    def __init_subclass__(cls, **more: Any) -> None:
        super().__init_subclass__(**more)
        names = [method.__name__ for method in METHODS_WITH_COPIES]
        hand_copies(cls, **dict.fromkeys(names, slice(None)))
        if "summary" not in vars(cls) and cls.__doc__:
            cls.summary = " ".join(cls.__doc__.partition("\n\n")[0].split())

    def __init__(self, name: str | None = None, **settings: object) -> None:
        """Read and check the settings of a control, without a scene.

        Args:
            name: name of this instance; by default its kind, e.g. "pose".
            **settings: value, range or list of values of each parameter, and values of
                choices. None counts as left out.

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
        # A setting of None counts as left out.
        self._settings: dict[str, Any] = {
            setting: to_plain_value(value)
            for setting, value in settings.items()
            if value is not None
        }
        self.chosen: dict[str, Any] = {
            choice.name: self._settings.get(choice.name, choice.default)
            for choice in self.choices
        }
        for choice in self.choices:
            choice.check(self.name, self.chosen[choice.name])
        self.check_choices()
        self.specs = self._parse_specs()
        self.has_requested_search = any(
            not isinstance(spec, Fixed) for spec in self.specs.values()
        )

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
        """Return what parameters are set to, by name; only of those with a setting."""
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

        They are those of the class. Subclasses add parameters that settings name.
        `settings` are the names, or a mapping that has the values too.
        """
        return cls.parameters

    def check_choices(self) -> None:
        """Check the values of the choices, `self.chosen`, in ways of a subclass.

        For example, two choices may exclude each other. By default nothing is checked.

        Raises:
            InputError: a choice is out of range.
        """

    def to_settings(self) -> dict[str, object]:
        """Return what `make_control` needs to make an equal instance, as JSON
        values.
        """
        if self.name == self.kind:
            return dict(self._settings)
        return {"kind": self.kind, **self._settings}

    @property
    def mesh(self) -> str:
        """Name of the mesh that it is about.

        It stands behind the colon of the control's name; by default it is the object.
        """
        return (self.name.partition(":")[2] if self.targets_mesh else "") or OBJECT

    @property
    def file_name(self) -> str:
        """Its name as it stands in names of files."""
        return to_file_name(self.name)

    def get_mesh(self, scene: SceneDescription) -> MeshPart:
        """Return the mesh of a scene that the control acts on, e.g. "chair".

        Raises:
            UnknownNameError: the scene has no such mesh.
            InputError: it belongs to the surroundings of a Mitsuba scene, which can't
                be changed by this control.
        """
        mesh = self.mesh
        if mesh in scene.meshes:
            return scene.meshes[mesh]
        if any(
            part.name == mesh for part in scene.parts if isinstance(part, PluginPart)
        ):
            raise InputError(
                f"`controls` {self.name}: {mesh} is around the object in a Mitsuba "
                "scene, and stays as it is; "
                "make it the object, or vary its numbers by Mitsuba's names, "
                f"mitsuba:{mesh}.KEY=[low, high]"
            )
        raise UnknownNameError(
            "mesh of the scene",
            mesh,
            scene.meshes,
            f"It stands in `controls` {self.name}.",
        )

    def setting_name(self, parameter: Parameter) -> str:
        """Return the name of a parameter among the scene's settings.

        Whether or not the scene has it.
        """
        return f"{self.kind if self.mesh == OBJECT else self.name}.{parameter.name}"

    def select_form(self, forms: Sequence[str]) -> str:
        """Return the form in which a control acts, such as "palette" for `texture`.

        Each form has one parameter. The user requests a form by the setting `form`, or
        by setting its parameter to its full range.

        Args:
            forms: names of the forms, in the order of their parameters; the first is
                the default.

        Raises:
            InputError: two forms are requested, or a parameter is set to a narrower
                range than its full one.
            UnknownNameError: there is no such form.
        """
        requested = []
        for parameter, form in zip(self.parameters, forms, strict=True):
            value = self._settings.get(parameter.name)
            if value is None:
                continue
            full_range = [parameter.low, parameter.high]
            if value not in (full_range, tuple(full_range)):
                raise InputError(
                    f"{self.name}.{parameter.name}: expected no value but "
                    f"[{parameter.low:g}, {parameter.high:g}], got "
                    f"{value!r}; set how far it may go with {self.name}.epsilon"
                )
            requested.append(form)
        if "form" in self._settings:
            form = str(self._settings["form"])
            requested.append(form)
            if form not in forms:
                raise UnknownNameError(f"{self.name}.form", form, forms)
        if len(set(requested)) > 1:
            raise InputError(
                f"{self.name}.form: expected one form, got {', '.join(requested)}"
            )
        return requested[0] if requested else forms[0]

    def list_allowed_values(
        self, parameter: str, *defaults: ParameterValue
    ) -> tuple[ParameterValue, ...]:
        """Return the values that a parameter may have, if they can be listed.

        Args:
            parameter: name of the parameter.
            *defaults: returned if it was not set, or was set to a range.
        """
        spec = self.specs.get(parameter)
        if isinstance(spec, OneOf):
            return spec.values
        if isinstance(spec, Fixed):
            return (spec.value,)
        return defaults

    def is_searched(self, parameter: str) -> bool:
        """Return whether a parameter with a range of its own is among what is
        searched.
        """
        if parameter in self.specs:
            return not isinstance(self.specs[parameter], Fixed)
        return not self.has_requested_search

    # ---- in a scene

    def prepare(self, scene: SceneDescription) -> SceneDescription:
        """Return the scene with the parts that this control needs (a light, a medium).

        By default it is unchanged.

        Raises:
            InputError: the control does not fit the scene.
        """
        return scene

    def with_scene(self, scene: SceneDescription) -> Self:
        """Return a copy that has a scene, without a slice of u yet."""
        in_scene = copy.copy(self)
        in_scene.scene = scene if is_ours(type(self)) else copy_value(scene)
        return in_scene

    def bind(self, scene: SceneDescription) -> Self:
        """Return a copy that is bound to a scene, which all controls have prepared.

        Raises:
            InputError: a setting of the control is impossible in this scene.
        """
        bound = self.with_scene(scene)
        bound.fit()
        return bound

    def fit(self) -> None:
        """Set `slots`, `start`, `groups` and `adjusted_defaults` for `self.scene`.

        A slot is the place of one parameter in the control's slice of u; a fixed one
        has no coordinates. A group has the coordinates of one searched parameter.

        Raises:
            InputError: a setting of the control is impossible in this scene.
        """
        slots = list[Slot]()
        begin = 0
        for parameter, spec in self.list_parameter_specs():
            slot = Slot(parameter, spec, begin)
            slots.append(slot)
            begin += slot.n_coordinates
        self.slots = tuple(slots)
        self.adjusted_defaults = tuple(self._list_adjusted_defaults())
        self.start = torch.tensor(
            [coordinate for slot in slots for coordinate in slot.start_coordinates()],
            dtype=torch.float32,
        )
        self.groups = tuple(self._group(slot) for slot in slots if slot.n_coordinates)
        # For `values`: the lower bound and the width of the range of each coordinate,
        # (d,) each. All coordinates of a slot have the same range; a slot without one
        # gets a range that is not used.
        ranges = [
            slot.spec if isinstance(slot.spec, Range) else Range(0.0, 1.0)
            for slot in slots
        ]
        low_and_span = torch.tensor(
            [(spec.low, spec.high - spec.low) for spec in ranges], dtype=torch.float64
        ).reshape(-1, 2)
        counts = torch.tensor([slot.n_coordinates for slot in slots], dtype=torch.long)
        self._low, self._span = low_and_span.T.repeat_interleave(counts, dim=1)

    def resolve_parameter(self, parameter: Parameter) -> Parameter:
        """Return a parameter as this scene has it.

        Its default is its value in the unchanged scene. A control may also give it the
        search range, unit, shape and estimators that it has there.
        """
        value = self.scene.values.get(self.setting_name(parameter))
        return parameter if value is None else replace(parameter, default=value)

    def get_clean_value(self, name: str) -> ParameterValue:
        """Return the value of a parameter in the unchanged scene."""
        return next(
            self.resolve_parameter(parameter).default
            for parameter in self.instance_parameters
            if parameter.name == name
        )

    def get_scene_value(self, parameter: Parameter) -> ParameterValue:
        """Return the value of a parameter in the scene as it was described.

        That is its default, unless that changes the scene. The parameter is as
        `resolve_parameter` returned it.
        """
        return parameter.default

    def get_spec(self, parameter: Parameter) -> Spec:
        """Return what a parameter is set to: a value, a range or a list of values.

        A parameter that the user did not set is searched over its default range. But it
        is fixed at its default if it has no such range, or if the user gave another
        parameter a range.

        Args:
            parameter: parameter with its range in the scene (`resolve_parameter`).
        """
        if parameter.name in self.specs:
            return self.specs[parameter.name]
        if self.has_requested_search or parameter.search is None:
            return Fixed(parameter.default)
        if parameter.options:
            return OneOf(parameter.options)
        return Range(*parameter.search)

    def get_budget(self, parameter: Parameter) -> Budget:
        """Return how far a searched parameter may go: by default its whole range."""
        return FULL_RANGE

    def list_parameter_specs(self) -> Iterator[tuple[Parameter, Spec]]:
        """Yield the parameters in the order of their coordinates, with their specs."""
        for parameter in map(self.resolve_parameter, self.instance_parameters):
            yield parameter, self.get_spec(parameter)

    def must_match_scene(self, parameter: Parameter, spec: Spec) -> bool:
        """Return whether the start has to have the clean scene's value of a parameter.

        By default always.
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
        self.adjusted_defaults = (
            *self.adjusted_defaults,
            AdjustedDefault(
                self.name,
                f"{self.name}.{parameter.name}",
                parameter.unit,
                scene_value,
                used_value,
            ),
        )

    def _list_adjusted_defaults(self) -> Iterator[AdjustedDefault]:
        """Yield the parameters whose start differs from the value in the clean scene.

        Parameters that the user fixed are left out. If the control has an `amount`,
        such as the density of a haze, only that is compared: at the amount of the clean
        scene, its other parameters have no effect.

        Raises:
            InputError: the user set the scene's value, and the range excludes it.
        """
        for slot in self.slots:
            parameter = slot.parameter
            if not self.must_match_scene(parameter, slot.spec):
                continue
            scene_value = self.get_scene_value(parameter)
            used = slot.start_value()
            hides_others = self.strength_parameter not in (None, parameter.name)
            if hides_others or is_same_value(used, scene_value, is_angle=slot.is_angle):
                continue
            # the scene's setting that has the same meaning
            setting = self.setting_name(parameter)
            label = f"{self.name}.{parameter.name}"
            if setting in self.scene.requested:
                raise InputError(
                    f"{self._quote_setting(setting)} and `controls` {self.name} "
                    "contradict "
                    f"each other: {label} is {slot.spec}, "
                    f"which leaves {format_value(scene_value)} out; change one of the "
                    "two, or "
                    "leave one out"
                )
            is_fixed_by_user = isinstance(self.specs.get(parameter.name), Fixed)
            if not is_fixed_by_user:
                yield AdjustedDefault(
                    self.name,
                    setting if setting == ENVIRONMENT else label,
                    "name" if parameter.options else parameter.unit,
                    scene_value,
                    used,
                )

    def _quote_setting(self, setting: str) -> str:
        """Return how a setting of the scene is written, with its value."""
        if setting == ENVIRONMENT:
            return f"`environment={self.scene.environment_spec}`"
        return f"`set` {setting}={format_value(self.scene.get_number(setting))}"

    def _group(self, slot: Slot) -> Group:
        """Return the group of coordinates of a searched parameter.

        A list of values gets no gradient estimators, since it has no derivative.

        Args:
            slot: the parameter's place in u.

        Raises:
            InputError: a parameter with a norm budget was given a distribution.
        """
        parameter = slot.parameter
        name = parameter.name
        spec = slot.spec
        setting = self.setting_name(parameter)
        if isinstance(spec, OneOf):
            return Group(
                name, slot.n_coordinates, (), options=len(spec.values), setting=setting
            )
        budget = self.get_budget(parameter)
        is_distribution = type(spec) is not Range  # a subclass of it
        if is_distribution and budget != FULL_RANGE:
            raise InputError(
                f"{self.name}.{name}: it has a ball and no distribution; give it a "
                "range"
            )
        return Group(
            name,
            slot.n_coordinates,
            parameter.estimators,
            budget,
            periodic=slot.is_full_turn,
            setting=setting,
        )

    @property
    def ambient(self) -> float | None:
        """Lux of ambient light beside the light that it throws.

        None where there is none, or where it is searched.
        """
        return None

    def scale_ambient(self, factor: float) -> Self:
        """Return the bound control with its ambient light scaled by a factor."""
        return self

    def advance_time(self, seconds: float) -> Control:
        """Return the control at a later time; itself if it does not depend on time."""
        return self

    @property
    def budget(self) -> Budget:
        """The budget of the slice of u: that of its largest group."""
        if not self.groups:
            return FULL_RANGE
        return max(self.groups, key=lambda group: group.size).budget

    @property
    def refines(self) -> frozenset[str]:
        """See the class; a plain attribute will do."""
        return frozenset()

    # ---- at a configuration

    def values(self, u: Tensor) -> dict[str, Tensor]:
        """Return the value of every parameter, fixed ones too.

        Args:
            u: (d,) the control's slice of a configuration, in [0, 1].

        Returns:
            By name, float32 of the parameter's shape and in its unit. For a parameter
            with named options it is the index of the option.
        """
        values: dict[str, Tensor] = {}
        if not self.slots:
            return values
        # All coordinates are interpolated linearly at once, which is fast. Those with a
        # logarithmic scale or a distribution are interpolated again below.
        linear = self._low.to(u) + self._span.to(u) * u
        for slot in self.slots:
            parameter = slot.parameter
            spec = slot.spec
            if isinstance(spec, Range):
                coordinates = slice(slot.offset, slot.offset + slot.n_values)
                is_distribution = type(spec) is not Range  # a subclass of it
                if parameter.log or is_distribution:
                    value = spec.interpolate(u[coordinates], log=parameter.log)
                else:
                    value = linear[coordinates]
                values[parameter.name] = value if parameter.shape else value.reshape(())
                continue
            if isinstance(spec, Fixed):
                constant = spec.value
            else:
                constant = spec.select(u[slot.offset])
            values[parameter.name] = _to_tensor(constant, slot, u.device)
        return values

    def scene_inputs(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Return the scene inputs that the values set, by name; differentiable.

        None by default: subclasses that act on the scene override it, and those that
        act on the finished image override `on_picture`. `earlier_inputs` is as for
        `inputs`.
        """
        return {}

    def inputs(
        self, u: Tensor, earlier_inputs: Mapping[str, Tensor] = NO_INPUTS
    ) -> dict[str, Tensor]:
        """Map a slice of u to scene inputs by name.

        By differentiable torch operations, on the device of u.

        Args:
            u: (d,) in [0, 1].
            earlier_inputs: inputs of the controls before this one; only names in `refines`
                may be returned again.
        """
        return self.scene_inputs(self.values(u), earlier_inputs)

    def on_picture(self, values: Values, image: Tensor) -> Tensor:
        """Return what the values make of the finished image; see `apply_to_image`."""
        return image

    def apply_to_image(self, u: Tensor, image: Tensor) -> Tensor:
        """Change the finished image, (H, W, 3) display-referred sRGB in [0, 1].

        Differentiable in both arguments.
        """
        # many do nothing to the image: their values are not worked out again
        if type(self).on_picture is Control.on_picture:
            return image
        return self.on_picture(self.values(u), image)

    def compute_measurements(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Value]:
        """Return further values to store, by name without the instance's."""
        return {}

    def describe(
        self, u: Tensor, earlier_inputs: Mapping[str, Tensor] = NO_INPUTS
    ) -> dict[str, Value]:
        """Describe a configuration by a few named values with units.

        They are the parameters that are not fixed, except images, and the values of
        `measured`. Names are `<control>.<parameter>`, such as "pose.yaw", with an index
        for an element of a vector.

        Args:
            u: (d,) the control's slice of a configuration, in [0, 1].
            earlier_inputs: inputs of the controls that are evaluated before this one.
        """
        values = self.values(u.detach())
        described: dict[str, Value] = {}
        for slot in self.slots:
            parameter = slot.parameter
            is_image = len(parameter.shape) > 1
            if isinstance(slot.spec, Fixed) or is_image:
                continue
            value = values[parameter.name]
            name = f"{self.name}.{parameter.name}"
            if parameter.options:
                option = parameter.options[int(value)]
                described[name] = {"value": option, "unit": "name"}
            elif value.ndim == 0:
                described[name] = make_value(value, parameter.unit)
            else:
                for index, number in enumerate(value):
                    described[f"{name}.{index}"] = make_value(number, parameter.unit)
        for name, measurement in self.compute_measurements(
            values, earlier_inputs
        ).items():
            described[f"{self.name}.{name}"] = measurement
        return described

    def get_numeric_values(self, u: Tensor) -> Mapping[str, Tensor]:
        """Return the numeric parameters of a configuration, by name.

        Parameters with named options, and images, are left out. Each value is (k,) or
        (), in the parameter's unit, and differentiable in u (d,).
        """
        values = self.values(u)
        numbers = {}
        for slot in self.slots:
            parameter = slot.parameter
            if not parameter.options and len(parameter.shape) < 2:
                numbers[parameter.name] = values[parameter.name]
        return numbers

    def get_printable_colors(self, u: Tensor) -> Tensor | None:
        """Return the searched colors that a printer would print; None without any.

        Returns:
            (h, w, 3) display-referred sRGB in [0, 1], differentiable in u. Where
                only some are searched (h, w, 4), with 1 for these and 0 for others.
        """
        return None

    def make_artifact_images(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Return images to store with a result, by file stem; none by default.

        Each is (h, w, 3), display-referred sRGB in [0, 1].
        """
        return {}

    def get_artifact_images(
        self, u: Tensor, earlier_inputs: Mapping[str, Tensor] = NO_INPUTS
    ) -> dict[str, Tensor]:
        """Return images to store with a result, by file stem, such as a texture.

        A subclass provides them by `kept_pictures`.

        Args:
            u: (d,) the control's slice of a configuration, in [0, 1].
            earlier_inputs: inputs of the controls that are evaluated before this one.

        Returns:
            Images (h, w, 3), display-referred sRGB in [0, 1].
        """
        return self.make_artifact_images(self.values(u.detach()), earlier_inputs)

    def make_artifact_files(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, bytes]:
        """Return other files to store with a result, by name with suffix."""
        return {}

    def get_artifact_files(
        self, u: Tensor, earlier_inputs: Mapping[str, Tensor] = NO_INPUTS
    ) -> dict[str, bytes]:
        """Return other files to store with a result, by name with suffix.

        A file may be a mesh as PLY. A subclass provides them by `kept_files`.

        Args:
            u: (d,) the control's slice of a configuration, in [0, 1].
            earlier_inputs: inputs of the controls that are evaluated before this one.
        """
        return self.make_artifact_files(self.values(u.detach()), earlier_inputs)


NumberControl = Control  # its name in packages that add controls


def _to_tensor(constant: ParameterValue, slot: Slot, device: torch.device) -> Tensor:
    """Return a fixed value as a tensor of the shape of its parameter.

    A name becomes its index among the parameter's options.
    """
    if isinstance(constant, str):
        return torch.full(
            (),
            float(slot.parameter.options.index(constant)),
            dtype=torch.float32,
            device=device,
        )
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
"""Methods of controls that get copies of tensors in controls of another package."""


def make_value(value: Tensor | float, unit: str) -> Value:
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
        f"{name}.linf": make_value(change.abs().max(), "sRGB"),
        f"{name}.rms": make_value(root_mean_square, "sRGB"),
    }


def to_file_name(name: str) -> str:
    """Return a control's name as file names have it: texture@chair of texture:chair."""
    return name.replace(":", "@")
