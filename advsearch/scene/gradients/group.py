"""A group of coordinates of u: what a control says of it, and how a plan differentiates it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

BY_DIFFERENCES = frozenset({"differences", "secant"})
"""Estimators that take primal renders."""


@dataclass(frozen=True)
class Budget:
    """How far a group of u may go from its start, inside the unit box.

    Attributes:
        norm: "linf" or "l2" for a ball around the start, "box" for the whole range.
        epsilon: radius of the ball in units of u; None for "box".
    """

    norm: str
    epsilon: float | None


WHOLE_RANGE = Budget("box", None)


@dataclass(frozen=True)
class Group:
    """Neighbouring coordinates with one budget and one way to be differentiated.

    A control says the first seven; the space in which it lies, whose it is and where it begins; a `GradientPlan`, how
    it is differentiated.

    Attributes:
        parameter: name of the parameter behind them.
        size: number of coordinates.
        valid: the valid estimators (keys of `plan.ESTIMATORS`), preferred first; empty for a discrete choice, which has
            no derivative.
        budget: how far they may go.
        periodic: 0 and 1 are the same value.
        options: number of options of a discrete choice; 0 for a continuous parameter.
        setting: name of the scene's setting that says the same; may be empty.
        control: name of the control.
        begin: first coordinate in u.
        estimator: the one that is taken.
        step: half-width of a difference in u; 0 where none is taken.
        pixel: that half-width over which the fastest outline moves by a pixel; that of the group where nothing moves.
        reason: why this estimator, in words.
        measured: what a measurement found for each valid estimator: variance x time, if one was made.
    """

    parameter: str
    size: int
    valid: tuple[str, ...]
    budget: Budget = WHOLE_RANGE
    periodic: bool = False
    options: int = 0
    setting: str = ""
    control: str = ""
    begin: int = 0
    estimator: str = "none"
    step: float = 0.0
    pixel: float = 0.0
    reason: str = ""
    measured: Mapping[str, float] = field(default_factory=dict)

    @property
    def coordinates(self) -> slice:
        """Where the group lies in u."""
        return slice(self.begin, self.begin + self.size)

    @property
    def name(self) -> str:
        """`control.parameter`."""
        return f"{self.control}.{self.parameter}"

    @property
    def step_reason(self) -> str:
        """Why the step is as wide as it is, in words; empty where none is taken."""
        if self.estimator not in BY_DIFFERENCES:
            return ""
        if self.step == self.pixel:
            return "an outline moves by a pixel, or nothing moves"
        return f"{self.step / self.pixel:.2g} times as wide as moves an outline by a pixel, so that a search can follow"

    @property
    def renders(self) -> int:
        """Primal renders that one gradient of this group takes."""
        return 2 * self.size if self.estimator in BY_DIFFERENCES else 0
