"""What a control is: a named family of scene parameters that may vary, and their map from the unit box.

A control declares its parameters as data. Bound to a scene it becomes a `BoundControl`: a slice of u and the map from
it to scene inputs, in torch. Most controls subclass `numbers.NumberControl` (docs/controls/writing.md).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar

from torch import Tensor

from advsearch.controls.ranges import is_number
from advsearch.controls.values import Moved, is_whole
from advsearch.copies import hand_copies
from advsearch.described import Value as Value
from advsearch.errors import InputError, UnknownNameError
from advsearch.scene.description import OBJECT, SceneDescription
from advsearch.scene.gradients import WHOLE_RANGE as WHOLE_RANGE
from advsearch.scene.gradients import Budget as Budget
from advsearch.scene.gradients import Group as Group
from advsearch.scene.parts import MeshPart, PluginPart
from advsearch.scene.settings import Parameter as Parameter

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


class BoundControl(ABC):
    """A control in a scene: a slice of u.

    Attributes:
        name: the instance's name.
        start: (d,) float32 in [0, 1], the value that leaves the scene as it is.
        groups: the coordinates of the slice in order; their sizes add up to d.
        moved: values of the clean scene that the start has not, because the control leaves them out.
        refines: the scene inputs that this control takes from the ones before it, and may change (a patch on a
            texture).
        on_top: what it refines lies over what all other controls make of it, whatever the order in which they were
            asked for (a patch on any material).
    """

    name: str
    start: Tensor
    groups: tuple[Group, ...]
    moved: tuple[Moved, ...] = ()
    refines: frozenset[str] = frozenset()
    on_top: bool = False

    def __init_subclass__(cls, **more: Any) -> None:
        super().__init_subclass__(**more)
        asked = ("inputs", "picture", "describe", "artifacts", "printed", "numbers", "files")
        hand_copies(cls, **dict.fromkeys(asked, slice(None)))

    @property
    def budget(self) -> Budget:
        """The budget of the whole slice: that of its largest group."""
        return max(self.groups, key=lambda group: group.size).budget if self.groups else WHOLE_RANGE

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


class Control(ABC):
    """A family of scene parameters before it meets a scene.

    Attributes:
        kind: the word for it on the command line.
        summary: one sentence.
        parameters: what may vary.
        choices: what may be chosen.
        of_a_mesh: it is about one mesh, and may be about another than the object: the name of that is then `KIND:MESH`.
        name: the instance's name; `kind` unless said otherwise.
    """

    kind: ClassVar[str]
    summary: ClassVar[str]
    parameters: ClassVar[tuple[Parameter, ...]]
    choices: ClassVar[tuple[Choice, ...]]
    of_a_mesh: ClassVar[bool] = False
    name: str

    def __init_subclass__(cls, **more: Any) -> None:
        super().__init_subclass__(**more)
        hand_copies(cls, prepare=slice(None), bind=slice(None))

    @classmethod
    def declared(cls, settings: Iterable[str]) -> tuple[Parameter, ...]:
        """Return the parameters of an instance that is given some settings: those of the class, unless the scene or the
        settings name them.

        Args:
            settings: names of what is given, perhaps with the values.
        """
        return cls.parameters

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

    def settings(self) -> dict[str, object]:
        """Return what `make_control` needs to make an equal instance, as JSON values."""
        named = {} if self.name == self.kind else {"kind": self.kind}
        return {**named, **{choice.name: getattr(self, choice.name) for choice in self.choices}}

    def chosen_form(self, forms: Sequence[str], form: str | None) -> str:
        """Return which form of itself a control takes, where each of its parameters stands for one.

        Args:
            forms: the forms, in the order of the parameters; the first is the default.
            form: the one that was asked for by name, or None.

        Raises:
            InputError: two forms are asked for, or a parameter was given a range of its own.
            UnknownNameError: there is no such form.
        """
        named = []
        for one, stands_for in zip(self.parameters, forms, strict=True):
            given = getattr(self, one.name)
            if given not in (None, [one.low, one.high], (one.low, one.high)):
                raise InputError(
                    f"{self.name}.{one.name}: expected no value but [{one.low:g}, {one.high:g}], got {given!r}; "
                    f"set how far it may go with {self.name}.epsilon"
                )
            named += [] if given is None else [stands_for]
        if form is not None and form not in forms:
            raise UnknownNameError(f"{self.name}.form", str(form), forms)
        if len({*named, *([form] if form else [])}) > 1:
            raise InputError(f"{self.name}.form: expected one form, got {', '.join([*named, form or ''])}")
        return form or (named[0] if named else forms[0])

    def prepare(self, scene: SceneDescription) -> SceneDescription:
        """Return the scene with whatever this control needs to be in it (a light, a medium); by default unchanged.

        Raises:
            InputError: the scene cannot take it.
        """
        return scene

    @abstractmethod
    def bind(self, scene: SceneDescription) -> BoundControl:
        """Fit the control to a scene that all controls of the space have prepared.

        Raises:
            InputError: a setting of the control is impossible in this scene.
        """
