"""The gradient plan: how the derivative of every coordinate of u is obtained
(docs/gradients.md).

A control's groups of coordinates declare which estimators are valid for them. Where
only one is, the plan takes it; where several are, it takes the first, until a
measurement on the actual scene (`advsearch.engine.gradients.planning`) says which has
the least variance x time. Any of them can be forced by name.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, wraps
from typing import Any

import torch
from torch import Tensor

from advsearch.errors import InputError, UnknownNameError

# estimators that take primal renders
BY_DIFFERENCES = frozenset({"differences", "secant"})


@dataclass(frozen=True)
class Budget:
    """How far a group of u may go from its start, inside the unit box: within a ball of
    radius `epsilon` in units of u, by the norm "linf" or "l2"; or everywhere, "box",
    with None.
    """

    norm: str
    epsilon: float | None


WHOLE_RANGE = Budget("box", None)


@dataclass(frozen=True)
class Group:
    """Neighbouring coordinates with one budget and one way to be differentiated. A
    control says the first seven; the space in which it lies, whose it is and where it
    begins; a `GradientPlan`, how it is differentiated.
    """

    parameter: str  # name of the parameter behind them
    size: int  # number of coordinates
    # estimators, preferred first; empty for a discrete choice, which has no derivative
    valid: tuple[str, ...]
    budget: Budget = WHOLE_RANGE  # how far they may go
    periodic: bool = False  # 0 and 1 are the same value
    # number of options of a discrete choice; 0 for a continuous parameter
    options: int = 0
    setting: str = ""  # name of the scene's setting that says the same; may be empty
    control: str = ""  # name of the control
    begin: int = 0  # first coordinate in u
    estimator: str = "none"  # the one that is taken
    step: float = 0.0  # half-width of a difference in u; 0 where none is taken
    # that over which the fastest outline moves by a pixel; that of the group where
    # nothing moves
    pixel: float = 0.0
    reason: str = ""  # why this estimator, in words
    # the caller named the estimator, or nobody uses the derivative: it is not compared
    is_forced: bool = False
    # variance x time of each valid one, where measured
    measured: Mapping[str, float] = field(default_factory=dict)

    @property
    def coordinates(self) -> slice:
        return slice(self.begin, self.begin + self.size)

    @cached_property
    def name(self) -> str:
        return f"{self.control}.{self.parameter}"

    @property
    def step_reason(self) -> str:
        """Why the step is as wide as it is, in words; empty where none is taken."""
        if self.estimator not in BY_DIFFERENCES:
            return ""
        if self.step == self.pixel:
            return "an outline moves by a pixel, or nothing moves"
        return (
            f"{self.step / self.pixel:.2g} times as wide as moves an outline by a "
            "pixel, so that a search can follow"
        )

    @property
    def renders(self) -> int:
        """Primal renders that one gradient of this group takes."""
        return 2 * self.size if self.estimator in BY_DIFFERENCES else 0


ESTIMATORS: Mapping[str, str] = {
    "adjoint": "interior adjoint (path replay); right for what moves no outline: "
    "textures, colours, lights' power",
    "material": "adjoint in material form: follows the moving surface, with boundary "
    "terms; any number of coordinates",
    "differences": "central differences of the picture with common random numbers; two "
    "renders for each coordinate",
    "secant": "central differences of the loss itself; as many renders, and smooths a "
    "rough loss over the step",
    "image": "torch autograd on the picture; no render",
    "none": "no derivative: a discrete choice, or switched off",
}
"""Every estimator by the name that forces it."""
BY_ADJOINT = frozenset({"adjoint", "material"})
# they need nothing but renders: right for any continuous coordinate
ALWAYS_VALID = ("differences", "secant", "none")
# coordinates over which differences are not compared with an adjoint: one by one they
# take too many renders
MANY = 16
DEFAULT_STEP = 0.05
TURN_STEP = 0.005
"""Half of a difference's width in u, for coordinates that move nothing in the picture:
of a range, of a full turn.
"""
# of the fastest point of an outline in half a difference (docs/gradients.md, "The
# estimators")
DEFAULT_PIXELS = 1.0
STEP_RANGE = (1e-6, 0.15)  # smallest and largest step in u


def steps_for(speeds: Tensor) -> Tensor:
    """Return half-widths of differences in u over which outlines of such speeds, pixels
    a unit, move by a pixel.
    """
    moved = torch.where(
        speeds > 1e-3,
        DEFAULT_PIXELS / speeds.clamp_min(1e-3),
        torch.full_like(speeds, DEFAULT_STEP),
    )
    return moved.clamp(*STEP_RANGE)


SEARCH_STEP = 0.03
"""Smallest step in u of one number that moves outlines. Over a pixel a classifier's
loss is rough: what it does over the 2 to 5 % of a range that a search goes at a time
has another sign as often as not, and more noise hides it. `benchmarks/gradients.py
--steps` shows that, and that 3 % is enough.
"""
SEARCH_SHARE = 0.4
"""Share of the picture that such a step moves the fastest outline over at most: of an
endless range, 3 % would move all things out of sight.
"""
STORED = (
    "control",
    "parameter",
    "size",
    "estimator",
    "valid",
    "step",
    "step_reason",
    "reason",
)
"""What a run stores of one group of coordinates; see `Group`."""
# what of it a plan for the same space takes over
CHOSEN = ("estimator", "step", "reason")


@dataclass(frozen=True)
class GradientPlan:
    """How the gradient of a whole space is obtained: every group of every control, in
    the order of u, and the samples a pixel of differences; None takes the primal's.
    """

    groups: tuple[Group, ...]
    spp: int | None = None

    def having(self, *estimators: str) -> tuple[Group, ...]:
        """Return the groups that use one of these estimators."""
        return tuple(group for group in self.groups if group.estimator in estimators)

    @property
    def renders(self) -> int:
        """Primal renders of one gradient, adjoints not counted."""
        return sum(group.renders for group in self.groups)

    @cached_property
    def through(self) -> Tensor:
        """(d,) float32: 1 for coordinates whose derivative runs back through scene
        inputs or the picture.
        """
        mask = torch.zeros(sum(group.size for group in self.groups))
        for group in self.having(*BY_ADJOINT, "image"):
            mask[group.coordinates] = 1.0
        return mask

    def with_estimator(self, names: Mapping[str, str], reason: str) -> GradientPlan:
        """Return the plan with the estimators of some groups forced, by
        `control.parameter`.
        """
        chosen = {
            name: {"estimator": estimator, "reason": reason, "is_forced": True}
            for name, estimator in names.items()
        }
        return self._changed(lambda group: chosen.get(group.name, {}))

    def with_steps(self, factor: float) -> GradientPlan:
        """Return the plan with every step multiplied by a factor, within
        `STEP_RANGE`.
        """
        low, high = STEP_RANGE
        return self._changed(
            lambda group: {"step": min(high, max(low, group.step * factor))}
        )

    def at_a_pixel(self) -> GradientPlan:
        """Return the plan with steps over which outlines move by a pixel: for smooth
        losses, which bend over more.
        """
        return self._changed(lambda group: {"step": group.pixel})

    def _changed(self, change: Callable[[Group], dict[str, Any]]) -> GradientPlan:
        return replace(
            self, groups=tuple(replace(group, **change(group)) for group in self.groups)
        )

    def restored(self, stored: Mapping[str, Any]) -> GradientPlan:
        """Return the plan with the choices that `to_dict` has stored of a plan for the
        same space.
        """
        kept = {
            f"{group['control']}.{group['parameter']}": {
                name: group[name] for name in CHOSEN
            }
            | {"measured": group["variance_x_seconds"]}
            for group in stored["groups"]
        }
        return replace(self._changed(lambda group: kept[group.name]), spp=stored["spp"])

    def to_dict(self) -> dict[str, Any]:
        """Return what a run stores of the plan: its renders, and `STORED` and the
        measurements of each group.
        """
        groups = [
            {
                **{name: getattr(group, name) for name in STORED},
                "valid": list(group.valid),
            }
            | {"variance_x_seconds": dict(group.measured)}
            for group in self.groups
        ]
        return {"renders_per_gradient": self.renders, "spp": self.spp, "groups": groups}


def compared(valid: Sequence[str], size: int) -> tuple[str, ...]:
    """Return which of the estimators that are valid for `size` coordinates are worth a
    measurement.
    """
    adjoints = tuple(estimator for estimator in valid if estimator in BY_ADJOINT)
    return adjoints if adjoints and size > MANY else tuple(valid)


def first_plan(
    groups: Sequence[Group],
    steps: Tensor,
    forced: Mapping[str, str] | None = None,
    spp: int | None = None,
    across: float = math.inf,
) -> GradientPlan:
    """Return the plan before anything was measured: each group's preferred estimator,
    or the one `forced` on it by "control.parameter", "control", or "*" for all where it
    is valid; with (d,) half-widths of differences in u over which outlines move by a
    pixel, samples a pixel of differences, and pixels of the longer side of the picture.
    Raises InputError: an estimator is unknown, or not valid where it was forced by
    name.
    """
    forced = dict(forced or {})
    names = {key for group in groups for key in (group.name, group.control)}
    for name, estimator in forced.items():
        if estimator not in ESTIMATORS:
            raise UnknownNameError(
                "estimator" if name == "*" else f"estimator for {name}",
                estimator,
                ESTIMATORS,
            )
    for name in forced:
        if name != "*" and name not in names:
            raise UnknownNameError("control in `estimators`", name, sorted(names))
    return GradientPlan(
        tuple(_first(group, steps, forced, across) for group in groups), spp
    )


def _first(
    group: Group, steps: Tensor, forced: Mapping[str, str], across: float
) -> Group:
    pixel = float(steps[group.coordinates].min()) if group.size else 0.0
    outline = group.size == 1 and not {"adjoint", "image"} & {*group.valid}
    step = (
        max(pixel, min(SEARCH_STEP, SEARCH_SHARE * across * pixel))
        if outline
        else pixel
    )
    group = replace(group, pixel=pixel)
    if not group.valid:
        return replace(
            group, estimator="none", reason="a discrete choice has no derivative"
        )
    wanted = forced.get(group.name) or forced.get(group.control)
    if wanted is not None:
        if wanted not in group.valid and wanted not in ALWAYS_VALID:
            raise InputError(
                f"`estimators` {group.name}={wanted}: not valid there; expected one of "
                f"{', '.join(dict.fromkeys((*group.valid, *ALWAYS_VALID)))}"
            )
        return replace(
            group, estimator=wanted, step=step, reason="forced by name", is_forced=True
        )
    everywhere = forced.get("*", "")
    if everywhere in group.valid or (
        everywhere in ALWAYS_VALID and "image" not in group.valid
    ):
        return replace(
            group,
            estimator=everywhere,
            step=step,
            reason="forced for all",
            is_forced=True,
        )
    only = len(group.valid) == 1
    reason = (
        "the only valid estimator"
        if only
        else f"preferred among {', '.join(group.valid)}; not measured"
    )
    return replace(group, estimator=group.valid[0], step=step, reason=reason)


# ---- no second derivatives
# -------------------------------------------------------------------------------------------

Backward = Callable[[Any, Tensor], tuple[Tensor | None, ...]]


def first_order(backward: Backward) -> Backward:
    """Have what an autograd function's backward pass returns refuse to be
    differentiated again. Torch's own `once_differentiable` refuses only where the
    engine runs its node: `torch.autograd.grad` and `functional.hessian` leave that out,
    and a part of the derivative with it.
    """

    @wraps(backward)
    def once(ctx: Any, cotangent: Tensor) -> tuple[Tensor | None, ...]:
        with torch.no_grad():
            derivatives = backward(ctx, cotangent)
        if not torch.is_grad_enabled():
            return derivatives
        of = (cotangent, *ctx.saved_tensors)
        return tuple(
            value if value is None or value is cotangent else _Once.apply(value, *of)  # type: ignore[no-untyped-call]
            for value in derivatives
        )

    return once


class _Once(torch.autograd.Function):
    """A derivative, as something that depends on what it is taken at and cannot be
    differentiated.
    """

    @staticmethod
    def forward(ctx: Any, derivative: Tensor, *of: Tensor) -> Tensor:
        return derivative.view_as(derivative)

    @staticmethod
    def backward(ctx: Any, cotangent: Tensor) -> tuple[Tensor | None, ...]:
        raise NotImplementedError(
            "render: it has first derivatives only, since light is differentiated by "
            "an adjoint or by differences; "
            "leave out what needs a second one (a Hessian, a gradient penalty), or "
            "take differences of gradients"
        )
