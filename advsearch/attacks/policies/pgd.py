"""Projected gradient ascent with momentum (`PGD`), and what all gradient ascents have in
common (`AscentPolicy`). The variance of a gradient through a renderer may be very
large, so outliers are clipped (Zhang et al. 2020, "Why are adaptive methods good for
attention models?"). This introduces a bias.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass, field, replace
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from advsearch.attacks.domain import Block, Domain
from advsearch.attacks.evaluation import (
    NO_COUNTS,
    CorrectionCounts,
    Evaluated,
    Policy,
    Proposal,
    draw_seed,
    seeded,
)
from advsearch.errors import InputError

# An element of an l-infinity block is an outlier if it exceeds this many medians of the
# elements. A gradient is too long if it exceeds this many medians of the latest
# lengths.
CLIP = 3.0
MEMORY = 15  # number of the latest gradients whose lengths are compared
# The same as `CLIP` for the elements of an l2 block. It is larger, because the true
# gradient may be uneven and its direction must be preserved.
CLIP_L2 = 10.0
# smallest block whose elements are clipped: fewer elements have no meaningful median
MIN_CLIPPED_SIZE = 8


def clip_gradient(
    domain: Domain, gradient: Tensor, lengths: tuple[float, ...]
) -> tuple[Tensor, tuple[float, ...], CorrectionCounts]:
    """Clip the outliers of a gradient, which stem from the noise of a render.

    - In a norm ball of at least `MIN_CLIPPED_SIZE` elements, each element is clipped to
      a multiple of the median magnitude of the nonzero elements. The multiple is `CLIP`
      in an l-infinity ball: steps use the signs only, so clipping changes the average
      of gradients but no single step. In an l2 ball it is `CLIP_L2`.
    - Then a gradient that is longer than `CLIP` times the median of the last `MEMORY`
      lengths, this one included, is scaled down to that length.
    - If the domain `is_noise_free` or `draws_conditions`, images are predicted and not
      rendered. So gradients have no noise, and nothing is clipped.

    Args:
        domain: domain of the gradient.
        gradient: (d,), finite.
        lengths: lengths of the gradients before this one, at most `MEMORY`.

    Returns:
        The clipped gradient; the lengths, with this one's before it was scaled down;
        and the counts of outliers.
    """
    are_images_predicted = domain.is_noise_free or domain.draws_conditions
    if are_images_predicted:
        return gradient, lengths, NO_COUNTS
    clipped_gradient, has_outliers = _clip_elements(domain, gradient)
    length = float(torch.linalg.vector_norm(clipped_gradient))
    lengths = (*lengths, length)[-MEMORY:]
    max_length = _find_max_length(lengths)
    # with a median of 0 there is no usual length to compare with
    is_too_long = length > max_length and max_length > 0.0
    if is_too_long:
        clipped_gradient = clipped_gradient * (max_length / length)
    counts = CorrectionCounts(cut=int(has_outliers), shortened=int(is_too_long))
    return clipped_gradient, lengths, counts


def _clip_elements(domain: Domain, gradient: Tensor) -> tuple[Tensor, bool]:
    """Return a gradient (d,) whose elements are clipped to the limit of their block.

    The second value is whether any of them was above its limit.
    """
    clipped_gradient = gradient.clone()
    has_outliers = False
    for block, part in domain.list_block_slices():
        limit = _find_element_limit(block, gradient[part])
        if float(gradient[part].abs().amax()) > limit:
            has_outliers = True
            clipped_gradient[part] = clipped_gradient[part].clamp(-limit, limit)
    return clipped_gradient, has_outliers


def _find_max_length(lengths: tuple[float, ...]) -> float:
    """Return the largest length of a gradient, a multiple of the median of the last."""
    # if their number is even, the larger of the two in the middle
    median_length = sorted(lengths)[len(lengths) // 2]
    return CLIP * median_length


def _find_element_limit(block: Block, gradient: Tensor) -> float:
    """Return the magnitude above which an element of a block's gradient is an outlier.

    It is a multiple of the median magnitude of the elements that are not zero; infinity
    outside norm balls, in small blocks, and if all elements are zero.
    """
    has_limit = block.norm != "box" and block.size >= MIN_CLIPPED_SIZE
    if not has_limit or not bool(gradient.any()):
        return math.inf
    magnitudes = gradient.abs()
    n_medians = CLIP if block.norm == "linf" else CLIP_L2
    return n_medians * float(magnitudes[magnitudes > 0].median())


# The steps of a search are divided into windows. At the end of a window, the
# checkpoint, the step size may be halved.

FIRST_WINDOW = 0.22
WINDOW_DECREASE = 0.03
MIN_WINDOW_FRACTION = 0.06
"""Length of the first window, its decrease from one window to the next, and its lower
limit, as fractions of the steps.
"""

# Lower limit of the length of a window, in steps: two noisy values do not show a trend.
MIN_WINDOW = 3
# Fraction of a window's steps that must improve the objective. Otherwise the step size
# is halved (Auto-PGD's rho).
MIN_IMPROVING_FRACTION = 0.75
# final step size of a search without noise, as a fraction of the first
FINAL_STEP_FRACTION = 0.05
# `MIN_WINDOW` of a search without noise, in which all windows are equally long
MIN_WINDOW_EXACT = 5
# Without noise, the best objective of a window must exceed that of the window before by
# this fraction of the gain of the whole search.
MIN_WINDOW_GAIN = 1e-3
# The search ends after this many windows in a row that gain less.
MAX_IDLE_WINDOWS = 3
# The search ends after this many gradients of zero in a row.
MAX_FLAT_GRADIENTS = 5


class Peak(NamedTuple):
    """The best evaluation so far.

    Attributes:
        objective: objective of that evaluation, with its noise.
        u: (d,) its configuration.
        direction: (d,) the accumulated gradient after it.
    """

    objective: float
    u: Tensor
    direction: Tensor


@dataclass(frozen=True)
class StepWindow:
    """The evaluations between two checkpoints, at which the step size may be halved.

    Attributes:
        length: number of evaluations of the window.
        values: objectives of the evaluations so far.
        previous: objective of the evaluation before the window; NaN at the start.
        n_improved: number of evaluations whose objective exceeds the one before.
        reference_best: best objective of the search when the window began. In a domain
            without noise, best objective of the window before.
        was_halved: whether the step size was halved when the window began.
    """

    length: int
    values: tuple[float, ...] = ()
    previous: float = math.nan
    n_improved: int = 0
    reference_best: float = -math.inf
    was_halved: bool = True

    def add(self, value: float) -> StepWindow:
        last = self.values[-1] if self.values else self.previous
        n_improved = self.n_improved + 1 if value > last else self.n_improved
        return replace(self, values=(*self.values, value), n_improved=n_improved)

    def stalled(self, best: float) -> bool:
        """Return whether the step size should be halved (Auto-PGD, conditions 1 and 2).

        1. Too few steps of this window improved the objective.
        2. The best objective of the search has not grown in this window, and the step
           size was not halved just before it. (After halving, the search gets a window
           of time to improve.)

        Args:
            best: largest objective of the search so far.
        """
        has_improved_seldom = self.n_improved < MIN_IMPROVING_FRACTION * len(
            self.values
        )
        has_no_new_best = not self.was_halved and best <= self.reference_best
        return has_improved_seldom or has_no_new_best

    def is_behind(self, best: float) -> bool:
        """Return whether the window is clearly behind the best objective of the search.

        Its mean is then lower than `best` by more than noise explains: by more than two
        standard deviations of its objectives.
        """
        mean = sum(self.values) / len(self.values)
        squared_deviations = sum((value - mean) ** 2 for value in self.values)
        std = math.sqrt(squared_deviations / max(1, len(self.values) - 1))
        return best > mean + 2.0 * std

    def next(self, steps: int, best: float, halved: bool) -> StepWindow:
        """Return the window after this one, which is a little shorter.

        Args:
            steps: evaluations of the search.
            best: best objective of the search so far.
            halved: whether the step size is halved between the two windows.
        """
        decrease = max(1, round(WINDOW_DECREASE * steps))
        min_length = max(MIN_WINDOW, round(MIN_WINDOW_FRACTION * steps))
        last_value = self.values[-1]
        return StepWindow(
            length=max(min_length, self.length - decrease),
            previous=last_value,  # the first of the next window is compared with it
            reference_best=best,
            was_halved=halved,
        )


# `Ascent.mean_square` before the first gradient; it broadcasts to (d,)
NO_SQUARES = torch.zeros(())


@dataclass(frozen=True, eq=False)
class Ascent:
    """The state of an ascent.

    Attributes:
        domain: domain of the search.
        steps: planned number of evaluations.
        seed: seed of random numbers.
        u: (d,) configuration to propose next.
        direction: (d,) accumulated gradient; for Adam, the mean of gradients.
        step_size: step size before it is decayed, in units of each block's radius.
        mean_square: (d,) for Adam, the mean of squared gradients.
        peak: the best evaluation; None as long as none is finite.
        n_evaluations: number of evaluations so far.
        n_updates: number of gradients that were accumulated.
        n_flat: number of gradients of zero in a row.
        lengths: lengths of the latest gradients, see `clip_gradient`.
        counts: numbers of outliers and of rejected steps.
        window: for PGD, the current window.
        start_objective: for PGD, objective of the first evaluation; NaN before it.
        n_idle_windows: for PGD without noise, number of windows in a row that gained
            too little.
    """

    domain: Domain
    steps: int
    seed: int
    u: Tensor
    direction: Tensor
    step_size: float
    mean_square: Tensor = NO_SQUARES
    peak: Peak | None = None
    n_evaluations: int = 0
    n_updates: int = 0
    n_flat: int = 0
    lengths: tuple[float, ...] = ()
    counts: CorrectionCounts = NO_COUNTS
    window: StepWindow = field(default_factory=lambda: StepWindow(MIN_WINDOW))
    start_objective: float = math.nan
    n_idle_windows: int = 0

    def decay_step_size(self, number: int) -> float:
        """Return the step size of evaluation `number`, which falls linearly.

        It reaches the fraction `FINAL_STEP_FRACTION` of the first one at the end of the
        planned evaluations.
        """
        return self.step_size * max(FINAL_STEP_FRACTION, 1.0 - number / self.steps)


class AscentPolicy(Policy[Ascent]):
    """A policy that follows gradients, one evaluation after the other."""

    uses_gradient: ClassVar[bool] = True

    def propose(self, state: Ascent, n: int) -> tuple[tuple[Proposal, ...], Ascent]:
        """Propose the next configuration, alone and with its gradient.

        There is none after too many gradients of zero, or windows without a gain.
        """
        has_no_gradient = state.n_flat >= MAX_FLAT_GRADIENTS
        has_no_gain = state.n_idle_windows >= MAX_IDLE_WINDOWS
        if has_no_gradient or has_no_gain:
            return (), state
        proposal = Proposal(
            state.u,
            gradient=True,
            step_size=self.compute_step_size(state),  # only for the log
        )
        return (proposal,), state

    def update(self, state: Ascent, evaluated: Evaluated) -> Ascent:
        """Accumulate the gradient, store the best evaluation so far, and take a step.

        If the objective could not be computed, the step is rejected: the search goes
        back (`retreat`) with half the step size. Without a gradient, e.g. when the
        renders do not suffice for it, the step follows the accumulated one.

        Args:
            state: state of the ascent.
            evaluated: one configuration and its evaluation.
        """
        ((u, evaluation),) = evaluated
        state = replace(state, n_evaluations=state.n_evaluations + 1)
        if not evaluation.is_finite:
            counts = state.counts + CorrectionCounts(rejected=1)
            return self.retreat(
                replace(state, step_size=state.step_size / 2, counts=counts)
            )
        if evaluation.gradient is not None:
            state = self._accumulate(state, evaluation.gradient)
        if state.peak is None or evaluation.objective > state.peak.objective:
            # the direction with the gradient at u, for a later step from this peak
            state = replace(state, peak=Peak(evaluation.objective, u, state.direction))
        return self.take_step(state, u, evaluation.objective)

    def _accumulate(self, state: Ascent, gradient: Tensor) -> Ascent:
        """Return the state after accumulating a gradient (d,), without its outliers.

        A gradient of zero ("flat") is not accumulated; such gradients are counted as
        long as they follow each other.
        """
        # `lengths` are those of the latest gradients, now with this one's
        clipped_gradient, lengths, outlier_counts = clip_gradient(
            state.domain, gradient, state.lengths
        )
        state = replace(state, lengths=lengths, counts=state.counts + outlier_counts)
        if not bool(clipped_gradient.any()):
            return replace(state, n_flat=state.n_flat + 1)
        return replace(
            self.accumulate_gradient(state, clipped_gradient),
            n_updates=state.n_updates + 1,
            n_flat=0,
        )

    def counts(self, state: Ascent) -> CorrectionCounts:
        return state.counts

    @abstractmethod
    def compute_step_size(self, state: Ascent) -> float:
        """Return the step size of the next evaluation."""

    @abstractmethod
    def retreat(self, state: Ascent) -> Ascent:
        """Return the state after an objective could not be computed.

        The step size of `state` is halved already.
        """

    @abstractmethod
    def accumulate_gradient(self, state: Ascent, gradient: Tensor) -> Ascent:
        """Return the state with a gradient (d,), not all zero, accumulated."""

    @abstractmethod
    def take_step(self, state: Ascent, u: Tensor, objective: float) -> Ascent:
        """Return the state with the next configuration to propose.

        Args:
            state: state of the ascent.
            u: (d,) the configuration that was evaluated.
            objective: its objective.
        """

    def make_range_error(self, field: str, expected: str, example: float) -> InputError:
        """Return the error for a field whose value is out of range.

        Args:
            field: name of the field.
            expected: the range, e.g. "[0, 1)".
            example: a value to try.
        """
        return InputError(
            f"{field}: expected a number in {expected}, got "
            f"{getattr(self, field)}; try {example}"
        )


@dataclass(frozen=True)
class PGD(AscentPolicy):
    """Projected gradient ascent (Madry et al. 2018) for a noisy objective.

    One step, with P the projection onto the domain and `compute_steepest_step` the sign
    of a vector in an l-infinity block and the vector over its norm in an l2 or box
    block, scaled by the block's radius:

        m <- momentum * m + g / mean|g|                (MI-FGSM, Dong et al. 2018, eq.
        6) u <- P(u + step_size * steepest(m))

    g is clipped first (see `clip_gradient`). Accumulating gradients before the sign is
    taken matters here: each comes from another seed, and the sign of one noisy gradient
    is a coin toss wherever the noise exceeds it.

    The step size is halved at checkpoints when the objective stalls, by the two
    conditions of Auto-PGD (Croce and Hein 2020, section 3.1; see `StepWindow.stalled`).
    One thing differs from Auto-PGD, which always continues from the best configuration
    after halving. With noise the best is often only a lucky one. So the search returns
    to it only if the last window lags behind it by two standard deviations of the
    window.

    In a domain without noise (`Domain.is_noise_free`) no gradient is clipped, and the
    step size falls linearly over the planned steps. This reached larger objectives than
    Auto-PGD's rule at every budget that was tried (docs/policies/pgd.md). In addition
    it is halved after a window that gained less than `MIN_WINDOW_GAIN` of the gain of
    the search. After `MAX_IDLE_WINDOWS` of these in a row there is nothing more to
    propose. If evaluations sample conditions (`Domain.draws_conditions`), the step size
    falls linearly as well, but windows are not used: their gain depends on the
    conditions.

    After an objective of -inf the search returns to its best configuration, evaluates
    it again, and continues with half the step size. After a gradient of zero the step
    follows the accumulated gradient; if that is zero too, the step has a random
    direction. After `MAX_FLAT_GRADIENTS` zero gradients in a row there is nothing more
    to propose.

    Attributes:
        step_size: length of the first step, over 0 and at most 2, in units of each
            block's radius (epsilon; half the diagonal for a box).
        momentum: weight of the accumulated gradient, in [0, 1).
        random_start: whether to start from a random sample of the domain, and not at
            its initial point.
    """

    step_size: float = 0.5
    momentum: float = 0.5
    random_start: bool = False

    name: ClassVar[str] = "pgd"

    def __post_init__(self) -> None:
        """Check that all settings are within their limits."""
        if not 0.0 < self.step_size <= 2.0:
            raise self.make_range_error(
                "step_size", "(0, 2], a fraction of epsilon", example=0.5
            )
        if not 0.0 <= self.momentum < 1.0:
            raise self.make_range_error("momentum", "[0, 1)", example=0.5)

    def start(self, domain: Domain, generator: torch.Generator, steps: int) -> Ascent:
        """Start at the initial point, or at a random sample if `random_start` is set.

        The first window begins: the evaluations before the step size may be halved.

        Args:
            domain: domain of the search.
            generator: source of the seed.
            steps: renders of the search.
        """
        seed = draw_seed(generator)
        u = domain.initial_point
        if self.random_start:
            u = domain.sample(seeded(seed, 0))[0]
        # every step needs a gradient, which costs renders too
        steps = max(1, steps // (1 + domain.gradient_cost))
        return Ascent(
            domain,
            steps,
            seed,
            u,
            direction=torch.zeros_like(u),
            step_size=self.step_size,
            window=StepWindow(_choose_window_length(domain, steps)),
        )

    def compute_step_size(self, state: Ascent) -> float:
        if state.domain.is_noise_free or state.domain.draws_conditions:
            return state.decay_step_size(state.n_evaluations)
        return state.step_size

    def retreat(self, state: Ascent) -> Ascent:
        """Go back to the best configuration, and propose it again.

        Without one, as no objective could be computed so far, a random step is taken
        from the initial point.
        """
        peak = state.peak
        if peak is not None:
            return replace(state, u=peak.u, direction=peak.direction)
        # `_move_uphill` moves at random if the direction is zero
        without_direction = replace(state, direction=torch.zeros_like(state.u))
        return self._move_uphill(without_direction, state.domain.initial_point)

    def accumulate_gradient(self, state: Ascent, gradient: Tensor) -> Ascent:
        """Add a gradient, scaled to mean magnitude 1, to the decayed earlier ones."""
        # m <- momentum * m + g / mean|g|; divided by the largest element first, so that
        # the sum of huge or tiny elements stays within float32
        scaled = gradient / float(gradient.abs().amax())
        direction = (state.direction * self.momentum).add_(
            scaled, alpha=1.0 / float(scaled.abs().mean())
        )
        return replace(state, direction=direction)

    def take_step(self, state: Ascent, u: Tensor, objective: float) -> Ascent:
        """Take a step from u (d,), whose objective was evaluated.

        Steps are grouped in windows, and after each window the step size may be halved.
        If every evaluation draws other conditions, objectives can't be compared, so
        that there are no windows.
        """
        is_first = math.isnan(state.start_objective)
        if is_first:
            state = replace(state, start_objective=objective)
        if state.domain.draws_conditions:
            return self._move_uphill(state, u)
        window = state.window.add(objective)
        is_complete = len(window.values) >= window.length
        if not is_complete:
            return self._move_uphill(replace(state, window=window), u)
        if state.domain.is_noise_free:
            return self._move_uphill(self._end_exact_window(state, window), u)
        return self._end_noisy_window(state, window, u)

    def _end_exact_window(self, state: Ascent, window: StepWindow) -> Ascent:
        """End a window of a search without noise, and start one of equal length.

        The step size is halved if the best objective of the window is not clearly above
        that of the window before: the gain must exceed a fraction (`MIN_WINDOW_GAIN`)
        of the gain since the first evaluation.

        The window is not compared with the best objective of the search. During a
        search the matrix that predicts the images may be renewed, and the best may have
        been predicted by an earlier one, with another error.
        """
        best = max(window.values)
        gain = best - window.reference_best
        gain_since_start = best - state.start_objective
        next_window = StepWindow(window.length, reference_best=best)
        state = replace(state, window=next_window)
        is_idle = gain <= MIN_WINDOW_GAIN * gain_since_start
        if not is_idle:
            return replace(state, n_idle_windows=0)
        n_idle_windows = state.n_idle_windows + 1
        step_size = state.step_size / 2
        return replace(state, step_size=step_size, n_idle_windows=n_idle_windows)

    def _end_noisy_window(self, state: Ascent, window: StepWindow, u: Tensor) -> Ascent:
        """End a window of a noisy search, and take a step.

        If the objective stalled in the window, the step size is halved. If the window
        also lags behind the best evaluation of the search (the peak), the search goes
        back: the step starts at the peak, with the direction that was accumulated
        there. This is counted as one rejected step.

        Args:
            state: state of the ascent.
            window: the window that is complete.
            u: (d,) the latest configuration, from which the step starts otherwise.
        """
        peak = state.peak
        best = peak.objective if peak else -math.inf
        is_stalled = window.stalled(best)
        if is_stalled:  # the smaller step size stays, also for a step from the peak
            state = replace(state, step_size=state.step_size / 2)
        if peak is not None and is_stalled and window.is_behind(best):
            u = peak.u
            counts = state.counts + CorrectionCounts(rejected=1)
            state = replace(state, direction=peak.direction, counts=counts)
        next_window = window.next(state.steps, best, halved=is_stalled)
        return self._move_uphill(replace(state, window=next_window), u)

    def _move_uphill(self, state: Ascent, u: Tensor) -> Ascent:
        """Move from u along the accumulated gradient, or at random if that is zero."""
        uphill = state.direction
        if not bool(uphill.any()):
            uphill = torch.randn(
                u.numel(), generator=seeded(state.seed, state.n_evaluations)
            )
        moved_u = torch.add(
            u,
            state.domain.compute_steepest_step(u, uphill),
            alpha=self.compute_step_size(state),
        )
        return replace(state, u=state.domain.project(moved_u))


def _choose_window_length(domain: Domain, steps: int) -> int:
    """Return the number of evaluations of the first window of an ascent of so many
    steps.
    """
    if domain.is_noise_free:  # without noise all windows are short
        return max(MIN_WINDOW_EXACT, round(MIN_WINDOW_FRACTION * steps))
    return max(MIN_WINDOW, round(FIRST_WINDOW * steps))
