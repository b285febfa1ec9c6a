"""What a control is: a named family of scene parameters that may vary, and their map from the unit box.

A control declares its parameters as data (unit, range, default, whether periodic, differentiable, silhouette-moving)
that the command line, the documentation, the gradient plan and the shared tests read. Bound to a scene it becomes a
`BoundControl`: a slice of u, its budgets, and the map from that slice to scene inputs, written in torch so that
autograd runs through it.

Most controls are a handful of numbers: those subclass `advsearch.controls.numbers.NumberControl` and are one small
file. `docs/controls/writing.md` has a worked example.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar, TypedDict

import torch
from torch import Tensor

from advsearch.controls.clean import Moved
from advsearch.scene.description import SceneDescription
from advsearch.scene.gradients.group import WHOLE_RANGE as WHOLE_RANGE
from advsearch.scene.gradients.group import Budget as Budget
from advsearch.scene.gradients.group import Group as Group
from advsearch.scene.parameters import Parameter as Parameter

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
        bounds: the parameter that it says something about, which is not searched unless asked for; empty if it counts
            always. Where that parameter is not given, the control does not take the setting.
    """

    name: str
    default: float | str | None
    description: str
    run_setting: str = ""
    bounds: str = ""


class Value(TypedDict):
    """One value of a configuration as it is stored."""

    value: float | str
    unit: str


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

    @property
    def budget(self) -> Budget:
        """The budget of the whole slice: that of its largest group."""
        return max(self.groups, key=lambda group: group.size).budget if self.groups else WHOLE_RANGE

    @abstractmethod
    def inputs(self, u: Tensor, so_far: Mapping[str, Tensor] = NOTHING) -> dict[str, Tensor]:
        """Map a slice (d,) of u to named scene inputs, by differentiable torch operations.

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
        name: the instance's name; `kind` unless said otherwise.
    """

    kind: ClassVar[str]
    summary: ClassVar[str]
    parameters: ClassVar[tuple[Parameter, ...]]
    choices: ClassVar[tuple[Choice, ...]]
    name: str

    @classmethod
    def setting(cls, parameter: Parameter) -> str:
        """Return the name of the scene's setting that says the same as a parameter, whether or not there is one."""
        return f"{cls.kind}.{parameter.name}"

    def settings(self) -> dict[str, object]:
        """Return what `make_control` needs to make an equal instance, as JSON values."""
        named = {} if self.name == self.kind else {"kind": self.kind}
        return {**named, **{choice.name: getattr(self, choice.name) for choice in self.choices}}

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


def scalar(value: float) -> Tensor:
    """Return a number as a float32 tensor without dimensions."""
    return torch.tensor(value, dtype=torch.float32)
