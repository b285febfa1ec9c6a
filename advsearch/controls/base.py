"""What a control is: a named family of scene parameters that may vary, and their map from the unit box.

A control declares its parameters as data. Bound to a scene it has a slice of u and the map from it to scene inputs, in
torch. Most controls subclass `numbers.NumberControl` (docs/controls/writing.md).
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar

from torch import Tensor

from advsearch.controls.ranges import is_number
from advsearch.controls.values import Fixed, Moved, is_whole, plain, read
from advsearch.copies import copied, hand_copies, is_ours
from advsearch.described import Value as Value
from advsearch.distributions import as_setting
from advsearch.errors import InputError, UnknownNameError
from advsearch.scene.description import OBJECT, SceneDescription
from advsearch.scene.gradients import WHOLE_RANGE as WHOLE_RANGE
from advsearch.scene.gradients import Budget as Budget
from advsearch.scene.gradients import Group as Group
from advsearch.scene.parts import MeshPart, PluginPart
from advsearch.scene.settings import Parameter as Parameter

if TYPE_CHECKING:
    from typing_extensions import Self

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
    """Seconds that the shutter is open, and that the rows of a picture are read in; see `advsearch.scene.moments`."""

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
