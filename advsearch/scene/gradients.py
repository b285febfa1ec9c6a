"""The gradient plan: how the derivative of every coordinate of u is obtained.

See docs/gradients.md. A control's groups of coordinates declare which estimators are
valid for them. If only one is, the plan uses it; if several are, it uses the first,
until a measurement on the actual scene (`advsearch.engine.gradients.planning`) shows
which has the smallest variance x time. Any of them can be forced by name.
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
DIFFERENCE_ESTIMATORS = frozenset({"differences", "secant"})


@dataclass(frozen=True)
class Budget:
    """How far a group of u may go from its start, inside the unit box.

    A ball of the norm, as a rule; "box" is the whole unit box.
    """

    norm: str  # "linf" or "l2", or "box" for everywhere
    epsilon: float | None  # radius of the norm's ball in units of u; None for "box"


FULL_RANGE = Budget("box", None)


@dataclass(frozen=True)
class Group:
    """Neighbouring coordinates with one budget that are differentiated alike.

    A control sets the first seven fields; the space in which it lies the control's name
    and where it begins; a `GradientPlan` how it is differentiated.
    """

    parameter: str  # name of the parameter behind them
    size: int  # number of coordinates
    # estimators, preferred first; empty for a discrete choice, which has no derivative
    valid: tuple[str, ...]
    budget: Budget = FULL_RANGE  # how far they may go
    periodic: bool = False  # 0 and 1 are the same value
    # number of options of a discrete choice; 0 for a continuous parameter
    options: int = 0
    setting: str = ""  # name of the scene's setting for the same value; may be empty
    control: str = ""  # name of the control
    begin: int = 0  # first coordinate in u
    estimator: str = "none"  # the one that is used
    step: float = 0.0  # half-width of a difference in u; 0 where none is taken
    # The difference in u that moves the fastest outline by a pixel; that of the group
    # where nothing moves.
    pixel_step: float = 0.0
    reason: str = ""  # why this estimator is used, as a text
    # the caller named the estimator, or nobody uses the derivative: it is not compared
    is_forced: bool = False
    # variance x time of each valid one, where measured
    estimator_costs: Mapping[str, float] = field(default_factory=dict)

    @property
    def coordinates(self) -> slice:
        """The group's coordinates in u."""
        return slice(self.begin, self.begin + self.size)

    @cached_property
    def name(self) -> str:
        """Control and parameter."""
        return f"{self.control}.{self.parameter}"

    @property
    def step_reason(self) -> str:
        """Why the step has its width, as a text; empty without differences."""
        if self.estimator not in DIFFERENCE_ESTIMATORS:
            return ""
        if self.step == self.pixel_step:
            # Also the reason of a default step, where no outline moves.
            return "it moves an outline by a pixel, or moves none"
        return (
            f"{self.step / self.pixel_step:.2g} times as wide as moves an outline by a "
            "pixel, so that a search can follow"
        )

    @property
    def renders(self) -> int:
        """Primal renders that one gradient of this group takes."""
        return 2 * self.size if self.estimator in DIFFERENCE_ESTIMATORS else 0


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
ADJOINT_ESTIMATORS = frozenset({"adjoint", "material"})
ALL_GROUPS = "*"  # the name by which an estimator is forced for all groups
# they need nothing but renders: right for any continuous coordinate
ALWAYS_VALID_ESTIMATORS = ("differences", "secant", "none")
# number of coordinates above which differences are not compared with an adjoint: they
# take two renders for each coordinate
MAX_COMPARED_SIZE = 16
DEFAULT_STEP = 0.05
TURN_STEP = 0.005
"""Half-widths of differences in u for coordinates that move nothing in the image.

The first is that of a range, the second that of a full turn.
"""
# motion of the fastest point of an outline in half a difference (docs/gradients.md,
# "The estimators")
DEFAULT_PIXELS = 1.0
MIN_SPEED = 1e-3  # smallest speed that counts as motion, pixels per unit of u
STEP_RANGE = (1e-6, 0.15)  # smallest and largest step in u


def compute_steps(speeds: Tensor) -> Tensor:
    """Return half-widths of differences in u over which outlines move by a pixel.

    The speeds of the outlines are in pixels per unit of u. Speeds up to `MIN_SPEED`
    count as no motion, for which the step is `DEFAULT_STEP`. All steps are within
    `STEP_RANGE`.
    """
    steps = torch.where(
        speeds > MIN_SPEED,
        DEFAULT_PIXELS / speeds.clamp_min(MIN_SPEED),
        torch.full_like(speeds, DEFAULT_STEP),
    )
    return steps.clamp(*STEP_RANGE)


SEARCH_STEP = 0.03
"""Smallest step in u of a single coordinate that moves outlines.

Over a pixel a classifier's loss is rough: its change over the 2 to 5 % of a range that
a search goes at a time has another sign as often as not, and more noise hides it.
`benchmarks/gradients.py --steps` shows that, and that 3 % is enough.
"""
SEARCH_FRACTION = 0.4
"""Largest fraction of the image over which such a step moves the fastest outline.

Of an endless range, 3 % would move all objects out of the frame.
"""
STORED_FIELDS = (
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
# fields that a plan for the same space copies
RESTORED_FIELDS = ("estimator", "step", "reason")


@dataclass(frozen=True)
class GradientPlan:
    """How the gradient of a full space is obtained."""

    groups: tuple[Group, ...]  # groups of all controls, in the order of u
    spp: int | None = None  # samples per pixel of differences; None is the primal's

    def select_groups(self, *estimators: str) -> tuple[Group, ...]:
        """Return the groups that use one of these estimators."""
        return tuple(group for group in self.groups if group.estimator in estimators)

    @property
    def renders(self) -> int:
        """Primal renders of one gradient, adjoints not counted."""
        return sum(group.renders for group in self.groups)

    @cached_property
    def autograd_mask(self) -> Tensor:
        """(d,) float32 mask of coordinates that are differentiated by autograd.

        It is 1 where the derivative runs back through scene inputs or the image.
        """
        mask = torch.zeros(sum(group.size for group in self.groups))
        for group in self.select_groups(*ADJOINT_ESTIMATORS, "image"):
            mask[group.coordinates] = 1.0
        return mask

    def force_estimators(self, names: Mapping[str, str], reason: str) -> GradientPlan:
        """Return the plan with the estimators of some groups forced.

        The names are those of estimators by `control.parameter`.
        """
        changes = {
            name: {"estimator": estimator, "reason": reason, "is_forced": True}
            for name, estimator in names.items()
        }
        return self._change_groups(lambda group: changes.get(group.name, {}))

    def scale_steps(self, factor: float) -> GradientPlan:
        """Return the plan with steps multiplied by a factor, within `STEP_RANGE`."""
        min_step, max_step = STEP_RANGE
        return self._change_groups(
            lambda group: {"step": min(max_step, max(min_step, group.step * factor))}
        )

    def with_pixel_steps(self) -> GradientPlan:
        """Return the plan with steps over which outlines move by a pixel.

        They are for smooth losses, which bend over wider ones.
        """
        return self._change_groups(lambda group: {"step": group.pixel_step})

    def _change_groups(self, change: Callable[[Group], dict[str, Any]]) -> GradientPlan:
        """Return the plan with fields of each group replaced."""
        groups = tuple(replace(group, **change(group)) for group in self.groups)
        return replace(self, groups=groups)

    def restore(self, stored: Mapping[str, Any]) -> GradientPlan:
        """Return the plan with the choices of another plan for the same space.

        Each group gets the other's `RESTORED_FIELDS` and measurements, and the plan its
        samples per pixel. `stored` is what the other's `to_dict` has returned.
        """
        changes: dict[str, dict[str, Any]] = {}
        for group in stored["groups"]:
            change = {name: group[name] for name in RESTORED_FIELDS}
            change["estimator_costs"] = group["variance_x_seconds"]
            group_name = f"{group['control']}.{group['parameter']}"  # as `Group.name`
            changes[group_name] = change
        plan = self._change_groups(lambda group: changes[group.name])
        return replace(plan, spp=stored["spp"])

    def to_dict(self) -> dict[str, Any]:
        """Return what a run stores of the plan.

        It has its renders, and of each group `STORED_FIELDS` and the measurements.
        """
        groups = []
        for group in self.groups:
            entries = {name: getattr(group, name) for name in STORED_FIELDS}
            entries["valid"] = list(group.valid)
            # the costs by the name of their unit
            entries["variance_x_seconds"] = dict(group.estimator_costs)
            groups.append(entries)
        return {"renders_per_gradient": self.renders, "spp": self.spp, "groups": groups}


def select_compared(valid: Sequence[str], size: int) -> tuple[str, ...]:
    """Return which of the valid estimators of a group are worth a measurement.

    Differences take two renders for each of the group's `size` coordinates; an adjoint
    takes one for all of them. So a group with more than `MAX_COMPARED_SIZE` coordinates
    is measured with adjoints alone, if one is valid.
    """
    adjoints = tuple(
        estimator for estimator in valid if estimator in ADJOINT_ESTIMATORS
    )
    if adjoints and size > MAX_COMPARED_SIZE:
        return adjoints
    return tuple(valid)


def make_first_plan(
    groups: Sequence[Group],
    steps: Tensor,
    forced: Mapping[str, str] | None = None,
    spp: int | None = None,
    image_size: float = math.inf,
) -> GradientPlan:
    """Return the plan of derivatives before anything was measured.

    Each group of coordinates has its preferred estimator, or the one that is forced.

    Args:
        groups: groups of the space.
        steps: (d,) half-widths of differences in u over which outlines move by a pixel.
        forced: estimators by "control.parameter", "control", or "*" for all groups
            where it is valid.
        spp: samples per pixel of differences.
        image_size: pixels of the longer side of the image, which limits steps.

    Raises:
        InputError: an estimator is unknown, or not valid where it was forced by name.
    """
    forced = dict(forced or {})
    known_names = {name for group in groups for name in (group.name, group.control)}
    for name, estimator in forced.items():
        if estimator not in ESTIMATORS:
            kind = "estimator" if name == ALL_GROUPS else f"estimator for {name}"
            raise UnknownNameError(kind, estimator, ESTIMATORS)
    for name in forced:
        if name not in (ALL_GROUPS, *known_names):
            raise UnknownNameError("control in `estimators`", name, sorted(known_names))
    return GradientPlan(
        tuple(_plan_group(group, steps, forced, image_size) for group in groups), spp
    )


def _plan_group(
    group: Group, steps: Tensor, forced: Mapping[str, str], image_size: float
) -> Group:
    """Return a group with its preferred or forced estimator.

    An estimator forced for the group ("pose.yaw") wins over one for its control
    ("pose"), and that over one for all groups ("*"). If it is not valid for the group,
    one for all groups is ignored, and one of the other two raises an InputError.

    Args:
        group: the group; its valid estimators are in order of preference.
        steps: (d,) half-widths of differences in u over which outlines move by a pixel.
        forced: estimators by the name of a group, of a control, or "*".
        image_size: pixels of the longer side of the image.
    """
    # The step over which the fastest coordinate of the group moves an outline by a
    # pixel. A group without coordinates has no step.
    pixel_step = float(steps[group.coordinates].min()) if group.size else 0.0
    group = replace(group, pixel_step=pixel_step)
    if not group.valid:
        return replace(
            group, estimator="none", reason="a discrete choice has no derivative"
        )
    group = replace(group, step=_choose_step(group, image_size))
    forced_by_name = forced.get(group.name) or forced.get(group.control)
    if forced_by_name is not None:
        _check_is_valid(group, forced_by_name)
        return replace(
            group, estimator=forced_by_name, reason="forced by name", is_forced=True
        )
    forced_for_all = forced.get(ALL_GROUPS)
    # Some estimators are valid for every group, and are not listed in `valid`. They are
    # not forced on a group that only changes the finished image ("image"), whose
    # derivative needs no render.
    is_always_valid = (
        forced_for_all in ALWAYS_VALID_ESTIMATORS and "image" not in group.valid
    )
    if forced_for_all is not None and (
        forced_for_all in group.valid or is_always_valid
    ):
        return replace(
            group, estimator=forced_for_all, reason="forced for all", is_forced=True
        )
    reason = "the only valid estimator"
    if len(group.valid) > 1:
        reason = f"preferred among {', '.join(group.valid)}; not measured"
    return replace(group, estimator=group.valid[0], reason=reason)


def _choose_step(group: Group, image_size: float) -> float:
    """Return the half-width of a group's differences in u.

    It is `Group.pixel_step`, over which an outline moves by a pixel. A single
    coordinate that moves outlines has a wider one, `SEARCH_STEP`, as long as that moves
    them by no more than `SEARCH_FRACTION` of the image, whose longer side has
    `image_size` pixels.
    """
    # These two estimators are valid only for groups that move no outline.
    moves_no_outline = bool({"adjoint", "image"} & {*group.valid})
    if group.size != 1 or moves_no_outline:
        return group.pixel_step
    widest_step = SEARCH_FRACTION * image_size * group.pixel_step
    return max(group.pixel_step, min(SEARCH_STEP, widest_step))


def _check_is_valid(group: Group, estimator: str) -> None:
    """Raise InputError if an estimator that is forced for a group is not valid there.

    Those that need nothing but renders are valid for every group.
    """
    allowed = dict.fromkeys((*group.valid, *ALWAYS_VALID_ESTIMATORS))
    if estimator not in allowed:
        raise InputError(
            f"`estimators` {group.name}={estimator}: not valid there; expected one "
            f"of {', '.join(allowed)}"
        )


# ---- no second derivatives

Backward = Callable[[Any, Tensor], tuple[Tensor | None, ...]]


def forbid_second_derivatives(backward: Backward) -> Backward:
    """Return a backward pass whose results raise an error if they are differentiated.

    Torch's own `once_differentiable` does not suffice. It raises an error only if the
    second backward pass visits its node in the graph. `torch.autograd.grad` visits only
    nodes on the way to the requested inputs: it may leave that node out, and return a
    second derivative in which a part is missing.
    """

    @wraps(backward)
    def once(ctx: Any, cotangent: Tensor) -> tuple[Tensor | None, ...]:
        """Return the derivatives, guarded if another backward pass may follow."""
        with torch.no_grad():
            derivatives = backward(ctx, cotangent)
        # gradients are enabled here only with `create_graph`, for a second derivative
        if not torch.is_grad_enabled():
            return derivatives
        # A guarded value depends, for autograd, on all that the derivative depends on:
        # differentiating it again reaches the guard, which raises the error.
        arguments = (cotangent, *ctx.saved_tensors)
        guarded = []
        for value in derivatives:
            # An identity returns the cotangent itself, whose derivative is right.
            if value is not None and value is not cotangent:
                value = _OnceDifferentiable.apply(value, *arguments)  # type: ignore[no-untyped-call]
            guarded.append(value)
        return tuple(guarded)

    return once


class _OnceDifferentiable(torch.autograd.Function):
    """A derivative that depends on its arguments and cannot be differentiated."""

    @staticmethod
    def forward(ctx: Any, derivative: Tensor, *arguments: Tensor) -> Tensor:
        return derivative.view_as(derivative)

    @staticmethod
    def backward(ctx: Any, cotangent: Tensor) -> tuple[Tensor | None, ...]:
        raise NotImplementedError(
            "render: it has first derivatives only, since light is differentiated by "
            "an adjoint or by differences; leave out what needs a second one (a "
            "Hessian, a gradient penalty), or take differences of gradients"
        )
