"""What a control is: a named family of scene parameters that may vary, and their map from the unit box.

A control declares its parameters as data. Bound to a scene it has a slice of u and the map from it to scene inputs, in
torch. Most controls subclass `numbers.NumberControl` (docs/controls/writing.md).
"""

from __future__ import annotations

import copy
import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, TypeGuard

import torch
from torch import Tensor

from advsearch.controls.ranges import DrawnRange, Range, is_number, read_drawn
from advsearch.copies import copied, hand_copies, is_ours
from advsearch.described import Value as Value
from advsearch.described import rounded
from advsearch.distributions import CHOICES, DISTRIBUTION, WEIGHTS, as_setting
from advsearch.errors import InputError, UnknownNameError
from advsearch.scene.description import ENVIRONMENT, OBJECT, SceneDescription, check_one_environment
from advsearch.scene.gradients import WHOLE_RANGE as WHOLE_RANGE
from advsearch.scene.gradients import Budget as Budget
from advsearch.scene.gradients import Group as Group
from advsearch.scene.parts import MeshPart, PluginPart
from advsearch.scene.settings import SETTINGS
from advsearch.scene.settings import Parameter as Parameter

if TYPE_CHECKING:
    from typing_extensions import Self

# ---------------------------------------------------------------------------------------------------------------------
# What a parameter was set to: fixed, a range to search, or a list of values to choose from (docs/controls/README.md).
#
#     pose: {yaw: [0, 360], pitch: 10, scale: {choices: [0.8, 1.0, 1.2]}}
#
# Two numbers in a list are a range; three or more, or names, are a choice. `{range: [low, high]}` and `{choices:
# [...]}` say which. Values that are drawn may have weights, or a distribution (`advsearch.controls.ranges`).
#
# Where a control leaves out a value of the clean scene that was asked for, the two contradict each other, and that is
# refused. Where it leaves out only a default, the clean scene has the nearest value that the control allows, and that
# is said: a `Moved`.

Number = float | str

LARGEST_EPSILON = 1e6  # no distance from where a control starts is larger, in whichever norm


@dataclass(frozen=True)
class Fixed:
    """One value, not searched."""

    value: Number


@dataclass(frozen=True)
class OneOf:
    """One of a few values: numbers or names."""

    values: tuple[Number, ...]


Spec = Fixed | Range | OneOf


def plain(given: object) -> object:
    """Return numbers and arrays of numpy and torch, also in a list, as Python's, and distributions as settings."""
    given = as_setting(given)
    if isinstance(given, (list, tuple)):
        return type(given)(map(plain, given))
    return given.tolist() if hasattr(given, "tolist") and hasattr(given, "dtype") else given


def read(where: str, parameter: Parameter, given: object) -> Spec:
    """Return the setting of a parameter from what was given for it.

    Args:
        where: how messages name it, e.g. "pose.yaw".
        parameter: says what is allowed.
        given: a number or a name, [low, high], a list of values, {"range": [low, high]}, {"choices": [...]}, perhaps
            with "weights", or a distribution.

    Raises:
        InputError: not such a form, or a value outside the parameter's range.
    """
    if isinstance(given, Mapping) and DISTRIBUTION in given and not parameter.options:
        return read_drawn(where, parameter, given)
    if isinstance(given, Mapping) and set(given) == {"range"} and _is_list(given["range"]) and len(given["range"]) == 2:
        given = given["range"]
    if isinstance(given, Mapping):
        if not {CHOICES} <= set(given) <= {CHOICES, WEIGHTS} or not _is_list(given[CHOICES]) or not given[CHOICES]:
            raise InputError(
                f"{where}: expected {{range: [low, high]}}, {{choices: [value, ...]}}, {{choices: [value, ...], "
                "weights: [number, ...]}}"
                + ("" if parameter.options else " or {distribution: NAME, ...}")
                + f", got {dict(given)!r}"
            )
        choices = _choices(where, [_value(where, parameter, value) for value in given[CHOICES]])
        return _weighted(where, choices, given[WEIGHTS]) if WEIGHTS in given else choices
    if not _is_list(given):
        return Fixed(_value(where, parameter, given))
    values = [_value(where, parameter, one) for one in given]  # type: ignore[attr-defined]
    if values and (parameter.options or len(values) > 2):
        return _choices(where, values)
    if len(values) != 2:
        raise InputError(f"{where}: expected a value, [low, high] or a list of values, got {given!r}")
    low, high = (float(value) for value in values)
    if low == high:
        raise InputError(f"{where}: the range [{low:g}, {high:g}] has no size; write {low:g} to fix the value")
    if low > high:
        mend = f"write [{high:g}, {low:g}]"
        if parameter.periodic and low - high < TURN:
            ends = (low - TURN, high) if low - TURN >= parameter.low else (low, high + TURN)
            mend = (
                f"write [{ends[0]:g}, {ends[1]:g}] for the {TURN - low + high:g} degrees from {low:g} through "
                f"{0 if ends[0] <= 0 else TURN:g} to {high:g}, or [{high:g}, {low:g}] for the other {low - high:g}"
            )
        raise InputError(f"{where}: the range [{low:g}, {high:g}] is reversed; {mend}")
    if parameter.log and low <= 0.0:
        raise InputError(f"{where}: expected a range over 0 (it is searched on a logarithmic scale), got {low:g}")
    return Range(low, high)


def _choices(where: str, values: Sequence[Number]) -> OneOf:
    """The values, of which none may come twice: it would be drawn twice as often."""
    twice = [value for value, count in Counter(values).items() if count > 1]
    if twice:
        raise InputError(f"{where}: expected different choices, got {shown(twice[0])} twice; leave one of them out")
    return OneOf(tuple(values))


MOST_SHARES = 1000  # equal shares of probability that weights are rounded to, at most


def _weighted(where: str, choice: OneOf, weights: object) -> OneOf:
    """A choice that has each value as often as its weight says, so that equal shares of u draw it so."""
    values = choice.values
    given = list(weights) if isinstance(weights, (list, tuple)) else []
    numbers = [one for one in given if is_number(one) and one >= 0.0]
    if not len(numbers) == len(given) == len(values) or not sum(numbers):
        raise InputError(
            f"{where}: expected a weight of at least 0 for each of {len(values)} values, and one over 0, got "
            f"{weights!r:.80}"
        )
    shares = [one / sum(numbers) for one in numbers]
    exact = (n for n in range(1, MOST_SHARES) if all(abs(n * one - round(n * one)) < 1e-9 for one in shares))
    count = next(exact, MOST_SHARES)
    ends = [0, *(round(count * sum(shares[: number + 1])) for number in range(len(shares)))]
    counts = [high - low for low, high in pairwise(ends)]
    lost = [value for value, number, one in zip(values, counts, shares, strict=True) if one and not number]
    if lost:
        raise InputError(f"{where}: {shown(lost[0])} has less than a {MOST_SHARES}th of the weight; leave it out")
    return OneOf(tuple(value for value, number in zip(values, counts, strict=True) for _ in range(number)))


def by_distribution(spec: Spec) -> bool:
    """Return whether a spec says how likely each value is."""
    return isinstance(spec, DrawnRange) or (isinstance(spec, OneOf) and len({*spec.values}) < len(spec.values))


def _is_list(given: object) -> bool:
    return isinstance(given, Sequence) and not isinstance(given, (str, bytes))


def _value(where: str, parameter: Parameter, given: object) -> Number:
    if parameter.options:
        if not isinstance(given, str):
            raise InputError(f"{where}: expected one of {', '.join(parameter.options)}, got {given!r}")
        if given not in parameter.options:
            raise UnknownNameError(where, given, parameter.options)
        return given
    if parameter.unit == "name" and isinstance(given, str) and given.strip():
        return given
    if isinstance(given, bool) or not isinstance(given, (int, float)):
        raise InputError(f"{where}: expected a number in {parameter.unit}, got {given!r}")
    if not (is_number(given) and parameter.low <= given <= parameter.high):
        raise InputError(
            f"{where}: expected a number from {parameter.low:g} to {parameter.high:g} ({parameter.unit}), "
            f"got {shown(given)}"
        )
    return float(given)


def is_whole(given: object, low: int, high: int) -> TypeGuard[float]:
    """Return whether it is a whole number from `low` to `high`."""
    return is_number(given) and low <= given <= high and given == int(given)


def in_words(spec: Spec) -> str:
    """Say what a parameter is set to: ``10``, ``from 5 to 30``, ``one of noon, kitchen``."""
    if isinstance(spec, Range):
        return f"from {spec.low:g} to {spec.high:g}"
    values = (spec.value,) if isinstance(spec, Fixed) else dict.fromkeys(spec.values)
    written = ", ".join(map(shown, values))
    return written if isinstance(spec, Fixed) else f"one of {written}"


def to_value(spec: Range, log: bool, u: Tensor) -> Tensor:
    """Map coordinates in [0, 1] to values of a range; differentiable."""
    if isinstance(spec, DrawnRange):
        return spec.at(u)
    if log:
        return torch.exp(torch.lerp(torch.full_like(u, math.log(spec.low)), torch.full_like(u, math.log(spec.high)), u))
    return spec.low + (spec.high - spec.low) * u


def to_unit(spec: Range, log: bool, value: float) -> float:
    """Map a value to its coordinate, clipped to [0, 1]."""
    if isinstance(spec, DrawnRange):
        return spec.coordinate(value)
    if log:
        value = max(value, 1e-30)
        share = (math.log(value) - math.log(spec.low)) / (math.log(spec.high) - math.log(spec.low))
    else:
        share = (value - spec.low) / (spec.high - spec.low)
    return min(1.0, max(0.0, share))


def option_index(count: int, u: Tensor) -> int:
    """Return which of `count` options a coordinate chooses: equal shares of [0, 1]."""
    return min(count - 1, max(0, int(float(u.detach()) * count)))


TURN = 360.0
CLOSE = 1e-6  # relative difference up to which two values are the same


@dataclass(frozen=True)
class Moved:
    """A value of the clean scene that a control leaves out, although nobody asked for it: that of a parameter
    (``pose.yaw``, ``ground.size``, ``environment``), in a unit ("name" of names), as the scene described it, and the
    one that is used instead."""

    control: str
    parameter: str
    unit: str
    scene: Number
    used: Number


def sentences(moved: Sequence[Moved]) -> list[str]:
    """Return what is said of the values that had to move: one sentence a control."""
    return [
        f"The clean scene has {' and '.join(map(_instead, several))}, which the control {control} leaves out."
        for control, several in groupby(moved, key=lambda one: one.control)
    ]


def check_prepared(control: str, before: SceneDescription, after: SceneDescription) -> Iterator[Moved]:
    """Yield what a control has replaced in a scene by what it needs there, and nobody has described. Raises InputError
    where it was asked for."""
    if after.environment is not None and after.environment is not before.environment:
        check_one_environment(after.parts, f"`controls` {control}")
        if ENVIRONMENT in before.given:
            raise InputError(
                f"`environment={before.environment_spec}` and `controls` {control} contradict each other: the control "
                f"puts {after.environment.name} in its place; leave one of the two out"
            )
        if after.environment_spec == before.environment_spec:
            yield Moved(control, ENVIRONMENT, "name", before.environment_spec, after.environment.name)
    for name, value in after.values.items():
        scene = before.values[name]
        if value is None or scene is None or same(value, scene):
            continue
        if name in before.given:
            raise InputError(
                f"`set` {name}={shown(scene)} and `controls` {control} contradict each other: the control makes it "
                f"{rounded(value)}; change one of the two, or leave one out"
            )
        yield Moved(control, name, SETTINGS[name].unit, scene, value)


def check_start(
    control: str, parameter: str, allowed: str, setting: str, scene: SceneDescription, wanted: Number
) -> None:
    """Raise InputError where a value `wanted` of a control's parameter, which is outside what is `allowed` (in words)
    and so cannot be that of the clean scene, was asked for in the scene's `setting` that says the same."""
    if setting in scene.given:
        asked = f"`environment={scene.environment_spec}`"
        if setting != ENVIRONMENT:
            asked = f"`set` {setting}={shown(scene.number(setting))}"
        raise InputError(
            f"{asked} and `controls` {control} contradict each other: {control}.{parameter} is {allowed}, which leaves "
            f"{shown(wanted)} out; change one of the two, or leave one out"
        )


def same(one: Number, other: Number, *, turns: bool = False) -> bool:
    """Whether two values are the same, up to a rounding error and, of an angle that turns, up to whole turns."""
    if isinstance(one, str) or isinstance(other, str):
        return one == other
    return apart(one, other, turns=turns) <= CLOSE * max(1.0, abs(one), abs(other))


def apart(one: float, other: float, *, turns: bool = False) -> float:
    """How far two numbers are from each other; angles that turn, the nearer way around."""
    return abs(math.remainder(one - other, TURN) if turns else one - other)


def nearest(value: float, low: float, high: float, *, turns: bool = False) -> float:
    """Return the value in a range that is nearest to one, of an angle that turns the nearest way around."""
    if turns:
        value = low + (value - low) % TURN
        if value > high and value - high > low + TURN - value:
            value = low
    return min(max(value, low), high)


def shown(value: Number) -> str:
    """A value as it is written."""
    if isinstance(value, int) and not is_number(value):
        return f"a whole number of {value.bit_length()} bits"
    return value if isinstance(value, str) else f"{value:g}"


def _instead(one: Moved) -> str:
    unit = "" if one.unit in ("1", "name") or isinstance(one.used, str) else f" {one.unit}"
    short = [value if isinstance(value, str) else rounded(value) for value in (one.used, one.scene)]
    used, scene = short if short[0] != short[1] else (shown(one.used), shown(one.scene))
    return f"{one.parameter} {used}{unit} instead of {scene}"


NOTHING: Mapping[str, Tensor] = MappingProxyType({})
"""No scene inputs yet."""


@dataclass(frozen=True)
class Choice:
    """One setting of a control that is chosen, not searched (a norm, a resolution).

    Attributes:
        name: short name.
        default: what it is when nothing is said.
        description: one sentence.
        run_setting: the setting of a whole run that says it for all controls ("epsilon"), unless the control itself
            says something else; empty if there is none.
        bounds: the parameter that it says something about; empty if it counts always. Where that parameter is not
            searched, the control does not take the setting.
        fixes: the parameter that is not searched where this is chosen; empty if there is none.
        options: the names that can be chosen; empty for anything else.
        whole: the smallest and the largest whole number that can be chosen, or None.
        most: the largest number that can be chosen, all over 0; None for anything else.
    """

    name: str
    default: float | str | None
    description: str
    run_setting: str = ""
    bounds: str = ""
    fixes: str = ""
    options: tuple[str, ...] = ()
    whole: tuple[int, int] | None = None
    most: float | None = None

    def check(self, control: str, given: object) -> None:
        """Check what was chosen in an instance of a control; None is fine where it is the default.

        Raises:
            InputError: it cannot be chosen.
        """
        allowed, fits = "", True
        if self.options:
            allowed, fits = f"one of {', '.join(self.options)}", given in self.options
        elif self.whole is not None:
            allowed, fits = "a whole number from {} to {}".format(*self.whole), is_whole(given, *self.whole)
        elif self.most is not None:
            allowed, fits = f"a number over 0 and up to {self.most:g}", is_number(given) and 0.0 < given <= self.most
        if not fits and not (given is None and self.default is None):
            raise InputError(f"{control}.{self.name}: expected {allowed}, got {given!r}")


class Control(ABC):
    """A family of scene parameters. `bind` returns a copy with a scene, which has a slice of u and maps it to inputs.

    Args:
        name: the instance's name; the kind unless given.
        **settings: a value for any parameter (fixed, range or list) or choice, by name.

    Attributes:
        kind: the word for it on the command line.
        summary: one sentence.
        parameters: what may vary.
        choices: what may be chosen.
        of_a_mesh: it is about one mesh, and may be about another than the object: the name of that is then `KIND:MESH`.
        own: the parameters of this instance: `declared` of its settings.
        chosen: what is chosen, by name; the default where nothing was said.
        specs: what parameters were set to, of those that were given.
        asked: whether a parameter was given a range or a list.
        scene: once bound, the scene that all controls of the space have prepared.
        start: once bound, (d,) float32 in [0, 1], the value that leaves the scene as it is.
        groups: once bound, the coordinates of the slice in order; their sizes add up to d.
        moved: once bound, values of the clean scene that the start has not, because the control leaves them out.
        refines: the scene inputs that it takes from the controls before it, and may change (a patch on a texture).
        on_top: what it refines lies over what all other controls make of it, whatever the order in which they were
            asked for (a patch on any material).

    Raises:
        UnknownNameError: no such parameter or choice.
        InputError: a value is out of range.
    """

    kind: ClassVar[str]
    summary: ClassVar[str]
    parameters: ClassVar[tuple[Parameter, ...]]
    choices: ClassVar[tuple[Choice, ...]] = ()
    of_a_mesh: ClassVar[bool] = False
    on_top: bool = False
    name: str
    scene: SceneDescription
    start: Tensor
    groups: tuple[Group, ...]
    moved: tuple[Moved, ...] = ()

    def __init_subclass__(cls, **more: Any) -> None:
        super().__init_subclass__(**more)
        asked = ("prepare", "bind", "inputs", "picture", "describe", "artifacts", "printed", "numbers", "files")
        hand_copies(cls, **dict.fromkeys(asked, slice(None)))

    def __init__(self, name: str | None = None, **settings: object) -> None:
        self.name = name or self.kind
        settings = {setting: as_setting(value) for setting, value in settings.items()}
        self.own = self.declared(settings)
        known = [parameter.name for parameter in self.own] + [choice.name for choice in self.choices]
        for setting in settings:
            if setting not in known:
                raise UnknownNameError(f"setting of control {self.kind}", setting, known)
        given = {setting: plain(value) for setting, value in settings.items() if value is not None}
        self._given: dict[str, Any] = given
        self.chosen: dict[str, Any] = {choice.name: given.get(choice.name, choice.default) for choice in self.choices}
        for choice in self.choices:
            choice.check(self.name, self.chosen[choice.name])
        self.check_choices()
        self.specs = {
            parameter.name: read(f"{self.name}.{parameter.name}", parameter, given[parameter.name])
            for parameter in self.own
            if parameter.name in given
        }
        self.asked = any(not isinstance(spec, Fixed) for spec in self.specs.values())

    @classmethod
    def declared(cls, settings: Iterable[str]) -> tuple[Parameter, ...]:
        """Return the parameters of an instance that is given some settings: those of the class, unless the scene or the
        settings name them.

        Args:
            settings: names of what is given, perhaps with the values.
        """
        return cls.parameters

    def check_choices(self) -> None:  # noqa: B027
        """Check what the choices' own declarations do not say of `self.chosen`; by default nothing.

        Raises:
            InputError: a choice is out of range.
        """

    def settings(self) -> dict[str, object]:
        """Return what `make_control` needs to make an equal instance, as JSON values."""
        return {"kind": self.kind, **self._given} if self.name != self.kind else dict(self._given)

    @property
    def mesh(self) -> str:
        """Name of the mesh that it is about: the one behind the colon of its name, or else the object."""
        return (self.name.partition(":")[2] if self.of_a_mesh else "") or OBJECT

    def mesh_in(self, scene: SceneDescription) -> MeshPart:
        """Return that mesh in a scene.

        Raises:
            UnknownNameError: there is none of that name.
        """
        mesh = self.mesh
        if mesh in scene.meshes:
            return scene.meshes[mesh]
        if any(one.name == mesh for one in scene.parts if isinstance(one, PluginPart)):
            raise InputError(
                f"`controls` {self.name}: {mesh} is around the object in a Mitsuba scene, and stays as it is; "
                f"make it the object, or vary its numbers by Mitsuba's names, mitsuba:{mesh}.KEY=[low, high]"
            )
        raise UnknownNameError("mesh of the scene", mesh, scene.meshes, f"It stands in `controls` {self.name}.")

    def setting(self, parameter: Parameter) -> str:
        """Return the name of the scene's setting that says the same as a parameter, whether or not there is one."""
        return f"{self.kind if self.mesh == OBJECT else self.name}.{parameter.name}"

    def chosen_form(self, forms: Sequence[str]) -> str:
        """Return which form of itself a control takes, where each of its parameters stands for one, and the choice
        `form` for any.

        Args:
            forms: the forms, in the order of the parameters; the first is the default.

        Raises:
            InputError: two forms are asked for, or a parameter was given a range of its own.
            UnknownNameError: there is no such form.
        """
        asked = []
        for parameter, form in zip(self.parameters, forms, strict=True):
            chosen = self._given.get(parameter.name)
            if chosen not in (None, [parameter.low, parameter.high], (parameter.low, parameter.high)):
                raise InputError(
                    f"{self.name}.{parameter.name}: expected no value but [{parameter.low:g}, {parameter.high:g}], got "
                    f"{chosen!r}; set how far it may go with {self.name}.epsilon"
                )
            asked += [] if chosen is None else [form]
        if "form" in self._given:
            asked.append(str(self._given["form"]))
            if asked[-1] not in forms:
                raise UnknownNameError(f"{self.name}.form", asked[-1], forms)
        if len(set(asked)) > 1:
            raise InputError(f"{self.name}.form: expected one form, got {', '.join(asked)}")
        return asked[0] if asked else forms[0]

    # ---- in a scene -------------------------------------------------------------------------------------------------

    def prepare(self, scene: SceneDescription) -> SceneDescription:
        """Return the scene with whatever this control needs to be in it (a light, a medium); by default unchanged.

        Raises:
            InputError: the scene cannot take it.
        """
        return scene

    def within(self, scene: SceneDescription) -> Self:
        """Return a copy that has a scene, without a slice of u yet."""
        there = copy.copy(self)
        there.scene = scene if is_ours(type(self)) else copied(scene)
        return there

    def bind(self, scene: SceneDescription) -> Self:
        """Return a copy that is fit to a scene that all controls of the space have prepared.

        Raises:
            InputError: a setting of the control is impossible in this scene.
        """
        bound = self.within(scene)
        bound.fit()
        return bound

    @abstractmethod
    def fit(self) -> None:
        """Set `start` and `groups`, and `moved` where there is something to say, for `self.scene`.

        Raises:
            InputError: a setting of the control is impossible in this scene.
        """

    exposure: tuple[float, float] = (0.0, 0.0)
    """Seconds that the shutter is open, and that the rows of a picture are read in; see `advsearch.scene.formation`."""

    flashes: float = 0.0
    """How often a second it changes its light at most."""

    def later(self, seconds: float) -> Control:
        """Return the bound control as it is so many seconds later, where it knows a time; else itself."""
        return self

    @property
    def budget(self) -> Budget:
        """The budget of the whole slice: that of its largest group."""
        return max(self.groups, key=lambda group: group.size).budget if self.groups else WHOLE_RANGE

    @property
    def refines(self) -> frozenset[str]:
        """See the class; a plain attribute will do."""
        return frozenset()

    @abstractmethod
    def inputs(self, u: Tensor, so_far: Mapping[str, Tensor] = NOTHING) -> dict[str, Tensor]:
        """Map a slice (d,) of u to named scene inputs, by differentiable torch operations, on the device of u.

        Args:
            u: (d,) in [0, 1].
            so_far: inputs of the controls before this one; only names in `refines` may be returned again.
        """

    def picture(self, u: Tensor, image: Tensor) -> Tensor:
        """Change the finished picture (H, W, 3), display-referred sRGB in [0, 1]; differentiable in both arguments."""
        return image

    @abstractmethod
    def describe(self, u: Tensor, so_far: Mapping[str, Tensor] = NOTHING) -> dict[str, Value]:
        """Say a configuration in a few named values with units, small enough for one row of a table.

        It is a function of its arguments alone; arguments as for `inputs`.
        """

    def artifacts(self, u: Tensor, so_far: Mapping[str, Tensor] = NOTHING) -> dict[str, Tensor]:
        """Return pictures worth keeping, by file stem: (h, w, 3) display-referred sRGB in [0, 1]; see `describe`."""
        return {}

    def printed(self, u: Tensor) -> Tensor | None:
        """Return the searched colours that a printer would print, (h, w, 3) display-referred sRGB in [0, 1], as a
        differentiable function of u; where only some are searched (h, w, 4), with 1 for these and 0 for others; None
        without."""
        return None

    def numbers(self, u: Tensor) -> Mapping[str, Tensor]:
        """Return the numbers of the configuration by parameter, in its unit, (k,) or without dimensions, as
        differentiable functions of u; names have none."""
        return {}

    def files(self, u: Tensor, so_far: Mapping[str, Tensor] = NOTHING) -> dict[str, bytes]:
        """Return other files worth keeping, by name with ending: a mesh as PLY, say; see `describe`."""
        return {}


def number(
    estimators: tuple[str, ...], name: str, unit: str, low: float, high: float, default: float | str, text: str,
    search: tuple[float, float] | None = None, *, periodic: bool = False, log: bool = False,
) -> Parameter:  # fmt: skip
    """Return a number that moves no outlines; see `advsearch.scene.settings.moving` for one that does."""
    return Parameter(name, (), unit, low, high, default, text, periodic, False, search, log, estimators=estimators)


def measure(value: Tensor | float, unit: str) -> Value:
    """Return a number and its unit, as configurations are described."""
    return {"value": float(value), "unit": unit}


def change_in_colour(name: str, change: Tensor) -> dict[str, Value]:
    """Say a change of searched colours, display-referred: the largest, and the root of the mean square."""
    root_mean_square = change.square().mean().sqrt()
    return {f"{name}.linf": measure(change.abs().max(), "sRGB"), f"{name}.rms": measure(root_mean_square, "sRGB")}
