"""What a case of the stability suite is, and what running it says. Data only; no torch, no renderer."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from advsearch.attacks import Block, Domain, Evaluation, Query

OK, FELL_SHORT = "ok", "fell short"


@dataclass(frozen=True)
class Check:
    """One number that decides, and the range that it has to be in (both ends included; NaN is in no range).

    Attributes:
        what: what was measured, with its unit.
        value: the number.
        least, most: the range.
    """

    what: str
    value: float
    least: float = -math.inf
    most: float = math.inf

    @property
    def ok(self) -> bool:
        """Whether the number is in its range."""
        return self.least <= self.value <= self.most

    def __str__(self) -> str:
        ends = [
            f"{sign} {end:.4g}"
            for sign, end in (("at least", self.least), ("at most", self.most))
            if not math.isinf(end) and self.least != self.most
        ]
        wanted = f"exactly {self.most:.4g}" if self.least == self.most else " and ".join(ends)
        return f"{self.what}: {self.value:.4g}" + (f" (expected {wanted})" if wanted else "")


def holds(what: str, truth: bool) -> Check:
    """Return the check that something is true: 1, else 0."""
    return Check(what, float(truth), 1.0, 1.0)


@dataclass(frozen=True)
class Outcome:
    """What a case found.

    Attributes:
        checks: the numbers that decide.
        finite: every picture and every gradient was finite, and none had to be made so.
        relative_error: of a gradient (or of what the case is about) against the reference; None where there is none.
        ending: how the case's search ended, "refused" where the input was, or empty.
        measured: further numbers that are worth printing.
        rule: what handled it, where that is known only afterwards; empty for the case's own.
    """

    checks: tuple[Check, ...]
    finite: bool = True
    relative_error: float | None = None
    ending: str = ""
    measured: Mapping[str, float] = field(default_factory=dict)
    rule: str = ""

    @property
    def status(self) -> str:
        """`OK` where everything was finite and every check holds."""
        return OK if self.finite and all(check.ok for check in self.checks) else FELL_SHORT

    @property
    def decides(self) -> str:
        """The number that decides: of the first check that fails, else of the last one."""
        bad = [check for check in self.checks if not check.ok]
        if not self.finite and not bad:
            return "NaN or infinite values"
        deciding = bad or list(self.checks[-1:])
        return str(deciding[0]) if deciding else ""


Find = Callable[[], Outcome]


@dataclass(frozen=True)
class Case:
    """One extreme.

    Attributes:
        name: unique; what `--case` takes.
        group: name of its group.
        holds: what must hold, in a sentence.
        rule: what handles it.
        control: the controls that it moves; empty where there is no scene.
        cheap: takes about a second or less on two quiet cores, so the tests run it every time.
        find: does it.
    """

    name: str
    group: str
    holds: str
    rule: str
    control: str
    cheap: bool
    find: Find


@dataclass(frozen=True)
class CaseGroup:
    """Cases about one thing, in the order in which they run.

    Attributes:
        name: what `--group` takes.
        cases: those that `case` has added.
    """

    name: str
    cases: list[Case] = field(default_factory=list)

    def case(
        self, name: str, holds: str, rule: str, control: str = "", *, cheap: bool = True
    ) -> Callable[[Find], Find]:
        """Make a function a case of the group; arguments as the attributes of `Case`."""

        def added(find: Find) -> Find:
            self.cases.append(Case(name, self.name, holds, rule, control, cheap, find))
            return find

        return added


Value = Callable[[Tensor], Tensor]
"""From (d,) float64 in [0, 1] to a number with a graph; the larger the better."""
Disturb = Callable[[Tensor, int], Tensor]
"""From a gradient (d,) float32 and the number of its evaluation to the gradient that the policy sees."""


@dataclass
class Toy:
    """An objective without a renderer, as a search wants it.

    Attributes:
        value: the objective.
        domain: where.
        scale: factor on the objective, as if it were in other units.
        disturb: what becomes of gradients.
        broken: numbers of evaluations whose objective is NaN, as is their gradient.
        threshold: an objective over it is a success.
    """

    value: Value
    domain: Domain
    scale: float = 1.0
    disturb: Disturb | None = None
    broken: frozenset[int] = frozenset()
    threshold: float = math.inf

    def __call__(self, query: Query) -> Evaluation:
        """Answer a query; gradients cost nothing."""
        at = query.u.detach().double().requires_grad_()
        value = self.scale * self.value(at)
        slope = None
        if query.gradient:
            (slope,) = torch.autograd.grad(value, at)
            slope = slope.float()
            if self.disturb is not None:
                slope = self.disturb(slope, query.number)
        objective = float(value.detach())
        if query.number in self.broken:
            objective = math.nan
            slope = None if slope is None else torch.full_like(slope, math.nan)
        return Evaluation(objective, slope, objective > self.threshold, cost=query.samples)


def box_domain(start: Sequence[float]) -> Domain:
    """Return a box in which every number is a block of its own, as parameters of controls are."""
    return Domain(torch.tensor(start), tuple(Block(1, name=f"number {i}") for i in range(len(start))))


def quadratic(peak: Sequence[float], curvatures: Sequence[float]) -> Value:
    """Return minus half the sum of curvature x squared distance from the peak."""
    middle, weights = torch.tensor(peak, dtype=torch.float64), torch.tensor(curvatures, dtype=torch.float64)
    return lambda u: -0.5 * (weights * (u - middle).square()).sum()


def valley(u: Tensor) -> Tensor:
    """Rosenbrock's curved valley (1960), turned over: 0 at its peak u = (0.75, 0.75), condition number there 2508.

    x = 4 u - 2, value = -(100 (x_2 - x_1^2)^2 + (1 - x_1)^2).
    """
    x, y = 4.0 * u[0] - 2.0, 4.0 * u[1] - 2.0
    return -(100.0 * (y - x.square()).square() + (1.0 - x).square())


def hessian(value: Callable[[Tensor], float], u: Tensor, directions: Tensor, steps: Sequence[float]) -> Tensor:
    """Estimate second derivatives by differences.

    Args:
        value: the objective; with common random numbers where it is noisy.
        u: (d,) where.
        directions: (k, d).
        steps: k half-widths.

    Returns:
        (k, k) float64, symmetric: second derivatives along the directions.
    """
    moves = [step * direction for step, direction in zip(steps, directions, strict=True)]
    here, found = value(u), torch.zeros(len(moves), len(moves), dtype=torch.float64)
    for i, one in enumerate(moves):
        found[i, i] = (value(u + one) - 2.0 * here + value(u - one)) / steps[i] ** 2
        for j, other in enumerate(moves[:i]):
            crossed = value(u + one + other) - value(u + one - other) - value(u - one + other) + value(u - one - other)
            found[i, j] = found[j, i] = crossed / (4.0 * steps[i] * steps[j])
    return found


def condition_number(second: Tensor) -> float:
    """Return the largest over the smallest absolute eigenvalue of a symmetric matrix (k, k); infinite if that is 0."""
    sizes = torch.linalg.eigvalsh(second.double()).abs()
    return float(sizes.max() / sizes.min()) if float(sizes.min()) > 0.0 else math.inf
