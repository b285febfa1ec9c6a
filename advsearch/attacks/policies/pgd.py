"""Ascents along gradients: projected gradient ascent with momentum, and Adam with
projection. A gradient through a renderer has at times no useful variance, so outliers
are cut to what is usual (Zhang et al. 2020, Why are adaptive methods good for attention
models?), at the price of a bias.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass, field, replace
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from advsearch.attacks.domain import Domain, compute_half_widths
from advsearch.attacks.evaluation import (
    NO_COUNTS,
    Counts,
    Evaluated,
    Policy,
    Proposal,
    draw_seed,
    seeded,
)
from advsearch.errors import InputError

CLIP = 3.0  # what exceeds the median so many times is out of the usual
MEMORY = 15  # latest gradients whose lengths say what is usual
# the same of numbers in an l2 block, whose true gradient may be uneven: its direction
# is at stake
CLIP_L2 = 10.0
MIN_CLIPPED_SIZE = 8  # fewer numbers than this have no median to speak of


def clip_gradient(
    domain: Domain, gradient: Tensor, lengths: tuple[float, ...]
) -> tuple[Tensor, tuple[float, ...], Counts]:
    """Return a gradient (d,), finite, without outliers, the lengths of the latest ones,
    and what was an outlier.

    - In a ball of at least `MIN_CLIPPED_SIZE`, each is cut to so many medians of those
      that are not zero: `CLIP` in an l-infinity ball, where the step follows the signs,
      so that this changes how gradients are averaged and no single step; `CLIP_L2` in
      an l2 ball.
    - A gradient that is longer than `CLIP` times the median of the last `MEMORY` is
    shortened to that.
    - In a domain that is `exact` or `drawn` nothing is an outlier.
    """
    if domain.exact or domain.draws_conditions:
        return gradient, lengths, NO_COUNTS
    clipped_gradient = gradient.clone()
    has_outliers = False
    for block, part in domain.list_block_slices():
        if (
            block.norm != "box"
            and block.size >= MIN_CLIPPED_SIZE
            and bool(clipped_gradient[part].any())
        ):
            magnitudes = clipped_gradient[part].abs()
            limit = (CLIP if block.norm == "linf" else CLIP_L2) * float(
                magnitudes[magnitudes > 0].median()
            )
            if float(magnitudes.amax()) > limit:
                has_outliers = True
                clipped_gradient[part] = clipped_gradient[part].clamp(-limit, limit)
    length = float(torch.linalg.vector_norm(clipped_gradient))
    lengths = (*lengths, length)[-MEMORY:]
    median_length = sorted(lengths)[len(lengths) // 2]
    shortened = length > CLIP * median_length > 0.0
    return (
        clipped_gradient * (CLIP * median_length / length)
        if shortened
        else clipped_gradient,
        lengths,
        Counts(int(has_outliers), int(shortened)),
    )


FIRST_WINDOW = 0.22
WINDOW_DECREASE = 0.03
MIN_WINDOW_FRACTION = 0.06
"""Length of the first window, how much each next one is shorter, and the shortest, as
fractions of the steps.
"""

MIN_WINDOW = (
    3  # no window is shorter than this: two noisy values say nothing about a trend
)
# fraction of a window's steps that must improve the objective to keep the step size
# (Auto-PGD's rho)
MIN_IMPROVING_FRACTION = 0.75
# what is left of the step size at the end of a search without noise, as a fraction of
# the first
FINAL_STEP_FRACTION = 0.05
# the same as `MIN_WINDOW` without noise, where all windows have the shortest length
MIN_WINDOW_EXACT = 5
# without noise, what a window must add to the best of the one before, as a fraction of
# all that was gained
MIN_WINDOW_GAIN = 1e-3
MAX_IDLE_WINDOWS = (
    3  # windows in a row that add less, after which there is nothing to gain
)
# evaluations in a row without any gradient after which there is nothing to follow
MAX_FLAT_GRADIENTS = 5


class Peak(NamedTuple):
    """The best evaluation so far by its raw objective, and the direction in which the
    search stood to go on there.
    """

    objective: float
    u: Tensor
    direction: Tensor


@dataclass(frozen=True)
class Window:
    """The objectives since the last checkpoint, so many until the next, and the one
    before them, NaN at the start; how many exceed their predecessor; the best at the
    checkpoint, without noise of the window before it; and whether the step size was
    halved there.
    """

    length: int
    values: tuple[float, ...] = ()
    before: float = math.nan
    improved: int = 0
    best: float = -math.inf
    halved: bool = True

    def add(self, value: float) -> Window:
        last = self.values[-1] if self.values else self.before
        return replace(
            self, values=(*self.values, value), improved=self.improved + (value > last)
        )

    def stalled(self, best: float) -> bool:
        """Return whether the step size is due for halving: too few steps improved the
        objective, or the best has not moved since the last checkpoint although the step
        size was kept there (conditions 1 and 2 of Auto-PGD).
        """
        return self.improved < MIN_IMPROVING_FRACTION * len(self.values) or (
            not self.halved and best <= self.best
        )

    def lags(self, best: float) -> bool:
        """Return whether `best` beats this window by more than noise explains: by two
        of its standard deviations.
        """
        mean = sum(self.values) / len(self.values)
        spread = math.sqrt(
            sum((v - mean) ** 2 for v in self.values) / max(1, len(self.values) - 1)
        )
        return best > mean + 2.0 * spread

    def next(self, steps: int, best: float, halved: bool) -> Window:
        length = max(
            MIN_WINDOW,
            round(MIN_WINDOW_FRACTION * steps),
            self.length - max(1, round(WINDOW_DECREASE * steps)),
        )
        return Window(length, (), self.values[-1], 0, best, halved)


NO_SQUARES = torch.zeros(())


@dataclass(frozen=True, eq=False)
class Ascent:
    """Where an ascent of so many evaluations stands: u (d,) to propose next, the
    accumulated gradient (d,), of Adam its mean and the mean (d,) of squares, the step
    size, the best evaluation, evaluations so far (`count`), gradients in these means
    (`n_updates`), zero gradients in a row (`flat`), and lengths of gradients as
    `clip_gradient` wants them. PGD has besides the objective at the start, a window,
    and windows in a row that added nothing (`idle`, without noise only).
    """

    domain: Domain
    steps: int
    seed: int
    u: Tensor
    direction: Tensor
    step_size: float
    square: Tensor = NO_SQUARES
    peak: Peak | None = None
    count: int = 0
    n_updates: int = 0
    flat: int = 0
    lengths: tuple[float, ...] = ()
    counts: Counts = NO_COUNTS
    window: Window = field(default_factory=lambda: Window(MIN_WINDOW))
    first: float = math.nan
    idle: int = 0

    def decay_step_size(self, number: int) -> float:
        """Return the step size of evaluation `number` where it falls in a line."""
        return self.step_size * max(FINAL_STEP_FRACTION, 1.0 - number / self.steps)


class AscentPolicy(Policy[Ascent]):
    """A policy that follows gradients, one evaluation after the other."""

    uses_gradient: ClassVar[bool] = True

    def propose(self, state: Ascent, n: int) -> tuple[tuple[Proposal, ...], Ascent]:
        if state.flat >= MAX_FLAT_GRADIENTS or state.idle >= MAX_IDLE_WINDOWS:
            return (), state
        return (Proposal(state.u, gradient=True, step_size=self.pace(state)),), state

    def update(self, state: Ascent, evaluated: Evaluated) -> Ascent:
        ((u, evaluation),) = evaluated
        state = replace(state, count=state.count + 1)
        if not evaluation.is_finite:
            counts = state.counts + Counts(rejected=1)
            return self.retreat(
                replace(state, step_size=state.step_size / 2, counts=counts)
            )
        # without one nothing is known: go on as before
        if evaluation.gradient is not None:
            gradient, lengths, outliers = clip_gradient(
                state.domain, evaluation.gradient, state.lengths
            )
            state = replace(
                state,
                lengths=lengths,
                counts=state.counts + outliers,
                flat=state.flat + 1,
            )
            if bool(gradient.any()):
                state = replace(
                    self.learn(state, gradient),
                    n_updates=state.n_updates + 1,
                    flat=0,
                )
        if state.peak is None or evaluation.objective > state.peak.objective:
            state = replace(state, peak=Peak(evaluation.objective, u, state.direction))
        return self.step(state, u, evaluation.objective)

    def counts(self, state: Ascent) -> Counts:
        return state.counts

    @abstractmethod
    def pace(self, state: Ascent) -> float:
        """Return the step size of the next evaluation."""

    @abstractmethod
    def retreat(self, state: Ascent) -> Ascent:
        """Return the state after an objective that could not be computed; the step size
        is halved already.
        """

    @abstractmethod
    def learn(self, state: Ascent, gradient: Tensor) -> Ascent:
        """Return the state with a gradient (d,), not all zero, among those
        accumulated.
        """

    @abstractmethod
    def step(self, state: Ascent, u: Tensor, objective: float) -> Ascent:
        """Return the state with the next configuration, after u with its objective."""

    def make_range_error(self, field: str, expected: str, example: float) -> InputError:
        return InputError(
            f"{field}: expected a number in {expected}, got "
            f"{getattr(self, field)}; try {example}"
        )


@dataclass(frozen=True)
class PGD(AscentPolicy):
    """Projected gradient ascent (Madry et al. 2018) for a noisy objective.

    One step, with P the projection onto the domain and `steepest` the sign of a vector
    in an l-infinity block and the vector over its norm in an l2 or box block, scaled by
    the block's radius:

        m <- momentum * m + g / mean|g|                (MI-FGSM, Dong et al. 2018, eq. 6)
        u <- P(u + step_size * steepest(m))

    g is clipped first (see `clip_gradient`). Accumulating gradients before the sign is
    taken matters here: each comes from another seed, and the sign of one noisy gradient
    is a coin toss wherever the noise exceeds it.

    The step size is halved at checkpoints when the objective stalls, by the two
    conditions of Auto-PGD (Croce and Hein 2020, section 3.1; see `Window.stalled`).
    There we depart from Auto-PGD: it always goes on from the best configuration after
    halving; a noisy best is often only a lucky one, so we go back only if the last
    window lags behind it by two of the window's standard deviations.

    In a domain without noise (`Domain.exact`) no gradient is clipped, and the step size
    falls in a line over the planned steps, which came farther than Auto-PGD's rule at
    every budget that was tried (docs/policies/pgd.md). It is halved besides after a
    window that added less than `MIN_WINDOW_GAIN` of what the search has gained; after
    `MAX_IDLE_WINDOWS` of these in a row there is nothing more to propose. Where
    evaluations sample conditions (`Domain.draws_conditions`) the step size falls
    likewise, and windows are ignored: what one gained depends on its conditions.

    An evaluation with the objective -inf sends the search back to its best
    configuration, which is evaluated again and left with half the step size. A gradient
    of zero leaves the accumulated one in charge; if that is zero too, the step goes in
    a random direction; and after `MAX_FLAT_GRADIENTS` zero gradients in a row there is
    nothing more to propose.

    Attributes:
        step_size: the first step in units of each block's radius (epsilon; half the
            diagonal for a box), over 0, at most 2.
        momentum: weight of the past, in [0, 1).
        random_start: start from a uniform sample of the domain, not from where it
            begins.
    """

    step_size: float = 0.5
    momentum: float = 0.5
    random_start: bool = False

    name: ClassVar[str] = "pgd"

    def __post_init__(self) -> None:
        if not 0.0 < self.step_size <= 2.0:
            raise self.make_range_error(
                "step_size", "(0, 2], a fraction of epsilon", 0.5
            )
        if not 0.0 <= self.momentum < 1.0:
            raise self.make_range_error("momentum", "[0, 1)", 0.5)

    def start(self, domain: Domain, generator: torch.Generator, steps: int) -> Ascent:
        seed = draw_seed(generator)
        u = domain.sample(seeded(seed, 0))[0] if self.random_start else domain.begin
        steps = max(1, steps // (1 + domain.gradient_cost))
        min_length, window_fraction = (
            (MIN_WINDOW_EXACT, MIN_WINDOW_FRACTION)
            if domain.exact
            else (MIN_WINDOW, FIRST_WINDOW)
        )
        window = Window(max(min_length, round(window_fraction * steps)))
        return Ascent(
            domain, steps, seed, u, torch.zeros_like(u), self.step_size, window=window
        )

    def pace(self, state: Ascent) -> float:
        return (
            state.decay_step_size(state.count)
            if state.domain.exact or state.domain.draws_conditions
            else state.step_size
        )

    def retreat(self, state: Ascent) -> Ascent:
        if state.peak is None:
            return self._move_uphill(
                replace(state, direction=torch.zeros_like(state.u)), state.domain.begin
            )
        return replace(state, u=state.peak.u, direction=state.peak.direction)

    def learn(self, state: Ascent, gradient: Tensor) -> Ascent:
        # sums of huge or tiny elements stay within float32
        scaled = gradient / float(gradient.abs().amax())
        direction = (state.direction * self.momentum).add_(
            scaled, alpha=1.0 / float(scaled.abs().mean())
        )
        return replace(state, direction=direction)

    def step(self, state: Ascent, u: Tensor, objective: float) -> Ascent:
        if math.isnan(state.first):
            state = replace(state, first=objective)
        if state.domain.draws_conditions:
            return self._move_uphill(state, u)
        window = state.window.add(objective)
        peak = state.peak
        slower = replace(state, step_size=state.step_size / 2)
        if len(window.values) < window.length:
            return self._move_uphill(replace(state, window=window), u)
        # (the best of all may stem from another matrix of light transport)
        if state.domain.exact:
            best = max(window.values)
            idle = best - window.best <= MIN_WINDOW_GAIN * (best - state.first)
            state = (
                replace(slower, idle=state.idle + 1) if idle else replace(state, idle=0)
            )
            return self._move_uphill(
                replace(state, window=Window(window.length, best=best)), u
            )
        best = peak.objective if peak else -math.inf
        stalled = window.stalled(best)
        state = slower if stalled else state
        if peak is not None and stalled and window.lags(best):
            u = peak.u
            state = replace(
                state,
                direction=peak.direction,
                counts=state.counts + Counts(rejected=1),
            )
        return self._move_uphill(
            replace(state, window=window.next(state.steps, best, stalled)), u
        )

    def _move_uphill(self, state: Ascent, u: Tensor) -> Ascent:
        """Move from u along the accumulated gradient, or at random where there is
        none.
        """
        uphill = state.direction
        if not bool(uphill.any()):
            uphill = torch.randn(u.numel(), generator=seeded(state.seed, state.count))
        move = torch.add(u, state.domain.steepest(u, uphill), alpha=self.pace(state))
        return replace(state, u=state.domain.project(move))


@dataclass(frozen=True)
class Adam(AscentPolicy):
    """Adam (Kingma and Ba 2015, algorithm 1) uphill, projected onto the domain after
    every step:

        m <- beta1 m + (1 - beta1) g,   v <- beta2 v + (1 - beta2) g^2
        u <- P(u + rate * scale * m' / (sqrt(v') + tiny))
        m' = m / (1 - beta1^t),   v' = v / (1 - beta2^t)

    `scale` is half of each number's range (half of what a ball leaves), so a step means
    the same in every block. The rate falls in a line from `step_size` to a twentieth of
    it over the planned evaluations. We depart from the paper in beta2, 0.9 by default,
    since a search has tens of steps and not thousands; and in an l2 ball g^2 is the
    mean over the block, since there the best step for a constant gradient is along it
    and not along its signs.

    g is clipped first (see `pgd.clip_gradient`). An evaluation without a gradient goes
    on along m. One whose objective could not be computed sends the search back to its
    best configuration, with m = v = 0 and half the rate. While there is no gradient but
    zero the step is random; after five zero gradients in a row there is nothing more to
    propose.

    Attributes:
        step_size: the first rate, over 0, at most 2.
        beta1, beta2: in [0, 1).
    """

    step_size: float = 0.3
    beta1: float = 0.8
    beta2: float = 0.9

    name: ClassVar[str] = "adam"

    def __post_init__(self) -> None:
        if not 0.0 < self.step_size <= 2.0:
            raise self.make_range_error(
                "step_size", "(0, 2], a share of half the range", 0.3
            )
        for beta in ("beta1", "beta2"):
            if not 0.0 <= getattr(self, beta) < 1.0:
                raise self.make_range_error(beta, "[0, 1)", 0.9)

    def start(self, domain: Domain, generator: torch.Generator, steps: int) -> Ascent:
        steps = max(1, steps // (1 + domain.gradient_cost))
        zero = torch.zeros_like(domain.start)
        return Ascent(
            domain, steps, draw_seed(generator), domain.begin, zero, self.step_size
        )

    def pace(self, state: Ascent) -> float:
        return state.decay_step_size(state.count)

    def retreat(self, state: Ascent) -> Ascent:
        u = state.domain.begin if state.peak is None else state.peak.u
        return replace(
            state, u=u, direction=torch.zeros_like(u), square=NO_SQUARES, n_updates=0
        )

    def learn(self, state: Ascent, gradient: Tensor) -> Ascent:
        squares = gradient.square()
        for block, part in state.domain.list_block_slices():
            if block.norm == "l2":
                squares[part] = squares[part].mean()
        mean = torch.lerp(gradient, state.direction, self.beta1)
        return replace(
            state, direction=mean, square=torch.lerp(squares, state.square, self.beta2)
        )

    def step(self, state: Ascent, u: Tensor, objective: float) -> Ascent:
        if state.n_updates:
            mean = state.direction / (1.0 - self.beta1**state.n_updates)
            direction = mean / (
                state.square / (1.0 - self.beta2**state.n_updates)
            ).sqrt_().clamp_(min=1e-30)
        else:  # at random as long as nothing is known
            direction = torch.randn(
                u.numel(), generator=seeded(state.seed, state.count)
            ).sign_()
        # of the evaluation that this step follows
        rate = state.decay_step_size(state.count - 1)
        return replace(
            state,
            u=state.domain.project(
                torch.addcmul(
                    u, compute_half_widths(state.domain), direction, value=rate
                )
            ),
        )
