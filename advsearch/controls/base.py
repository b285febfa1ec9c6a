"""What a control is: a named family of scene parameters that may vary, and their map from the unit box.

A control declares its parameters as data (unit, range, default, whether periodic, differentiable, silhouette-moving)
that the command line, the documentation and the shared tests read. Bound to a scene it becomes a `BoundControl`: a
slice of
u, its budget, and the map from that slice to scene inputs, written in torch so that autograd runs through it.

A new control is one file with these two classes and one line in `advsearch.controls.CONTROLS`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, TypedDict

from torch import Tensor

from advsearch.scene.description import SceneDescription


@dataclass(frozen=True)
class Parameter:
    """One named, bounded number or tensor of a control.

    Attributes:
        name: short name; `control.name` addresses it everywhere.
        shape: of its value; () for a number, None in a place that depends on the scene or a choice.
        unit: "degrees", "object sizes", "sRGB", ..., or "1".
        low: smallest value.
        high: largest value.
        default: the value that leaves the scene as it is, in words if it depends on the scene.
        description: one sentence.
        periodic: the ends of the range are the same value.
        differentiable: a derivative exists and is computed.
        moves_silhouettes: changing it can move an outline in the picture, so interior adjoints miss a term.
    """

    name: str
    shape: tuple[int | None, ...]
    unit: str
    low: float
    high: float
    default: float | str
    description: str
    periodic: bool = False
    differentiable: bool = True
    moves_silhouettes: bool = False


@dataclass(frozen=True)
class Choice:
    """One setting of a control that is chosen, not searched (a norm, a resolution)."""

    name: str
    default: float | str | None
    description: str


@dataclass(frozen=True)
class Budget:
    """How far a control's slice of u may go from its start, inside the unit box.

    Attributes:
        norm: "linf" or "l2" for a ball around the start, "box" for the whole range.
        epsilon: radius of the ball in units of u; None for "box".
    """

    norm: str
    epsilon: float | None


class Value(TypedDict):
    """One value of a configuration as it is stored."""

    value: float | str
    unit: str


class BoundControl(ABC):
    """A control in a scene: a slice of u.

    Attributes:
        name: the instance's name.
        start: (d,) float32 in [0, 1], the value that leaves the scene as it is.
        budget: how far the slice may go.
    """

    name: str
    start: Tensor
    budget: Budget

    @abstractmethod
    def inputs(self, u: Tensor) -> dict[str, Tensor]:
        """Map a slice (d,) of u to named scene inputs, by differentiable torch operations."""

    @abstractmethod
    def describe(self, u: Tensor) -> dict[str, Value]:
        """Say a configuration in a few named values with units, small enough for one row of a table."""

    @abstractmethod
    def artifacts(self, u: Tensor) -> dict[str, Tensor]:
        """Return pictures worth keeping, by file stem: (h, w, 3) display-referred sRGB in [0, 1]."""


class Control(ABC):
    """A family of scene parameters before it meets a scene.

    Attributes:
        kind: the word for it on the command line.
        summary: one sentence.
        parameters: what may vary.
        choices: what may be chosen.
    """

    kind: ClassVar[str]
    summary: ClassVar[str]
    parameters: ClassVar[tuple[Parameter, ...]]
    choices: ClassVar[tuple[Choice, ...]]

    @abstractmethod
    def bind(self, scene: SceneDescription) -> BoundControl:
        """Fit the control to a scene.

        Raises:
            InputError: a setting of the control is impossible in this scene.
        """
