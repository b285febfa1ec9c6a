"""What a search may end with: the few best configurations, rendered again with seeds it
has not used, as the largest of many noisy values is mostly a lucky one (the winner's
curse); many different failures; and the smallest change, a bracket of scales of all
budgets, whose upper end passed the trials, and at whose lower end a search found
nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from advsearch.attacks.domain import Domain
from advsearch.errors import InputError
from advsearch.statistics.intervals import CONFIDENCE
from advsearch.statistics.sequential import find_threshold

# configurations that differ by less than this in every element are one candidate (an
# 8-bit level is 4e-3)
SAME = 1e-4


@dataclass(frozen=True, eq=False)
class Candidate:
    """A configuration (d,) worth a second look: the objective (biased upwards) and
    success of the render that admitted it, the objectives of its renders since then,
    -inf where not finite, and how many were a success.
    """

    u: Tensor
    objective: float
    success: bool
    repeat_objectives: tuple[float, ...] = ()
    successes: int = 0

    @property
    def mean_objective(self) -> float:
        """Mean objective of the new renders; the raw one if there are none."""
        return (
            math.fsum(self.repeat_objectives) / len(self.repeat_objectives)
            if self.repeat_objectives
            else self.objective
        )

    @property
    def success_rate(self) -> float:
        return (
            self.successes / len(self.repeat_objectives)
            if self.repeat_objectives
            else float(self.success)
        )

    def with_repeat(self, objective: float, success: bool) -> Candidate:
        return replace(
            self,
            repeat_objectives=(*self.repeat_objectives, objective),
            successes=self.successes + success,
        )


def add_candidate(
    pool: tuple[Candidate, ...], new: Candidate, size: int
) -> tuple[Candidate, ...]:
    """Return the pool with `new` in it if it belongs to the best `size` distinct ones,
    best first.

    A success beats what is none, then the objective counts; of two that are nearly the
    same configuration the better stays. One that is in the pool exactly as it is gets
    another look by it, as unbiased as those of the ranking.
    """
    for old in pool:
        if torch.equal(old.u, new.u):
            updated = old.with_repeat(new.objective, new.success)
            return tuple(
                updated if candidate is old else candidate for candidate in pool
            )
    if len(pool) >= size and _sort_key(new) <= _sort_key(pool[-1]):
        return pool
    for old in pool:
        if float((old.u - new.u).abs().amax()) < SAME:
            if _sort_key(new) <= _sort_key(old):
                return pool
            pool = tuple(candidate for candidate in pool if candidate is not old)
            break
    return tuple(sorted((*pool, new), key=_sort_key, reverse=True)[:size])


def replace_worst(
    pool: tuple[Candidate, ...], last: Candidate | None, size: int
) -> tuple[Candidate, ...]:
    """Return the pool, of at most `size`, with the last configuration of a search in
    it, if need be for its worst.
    """
    if last is None or any(torch.equal(candidate.u, last.u) for candidate in pool):
        return pool
    return (*pool[: size - 1], last)


def select_contenders(
    pool: tuple[Candidate, ...], shared: int
) -> tuple[Candidate, ...]:
    """Return the winner so far and those that are not clearly worse, in their order:
    the mean of their differences from the winner, seed by seed, in the last `shared`
    renders, is larger than the standard error of that mean, and their success rate is
    no higher. (The race of Maron and Moore 1994, with normal intervals of one deviation
    in place of Hoeffding's: a search needs the better of two, not a proof.)
    """
    if shared < 2 or len(pool) < 2:
        return pool
    leader = select_best(pool)

    def is_worse(candidate: Candidate) -> bool:
        differences = [
            a - b
            for a, b in zip(
                leader.repeat_objectives[-shared:],
                candidate.repeat_objectives[-shared:],
                strict=True,
            )
        ]
        if not all(map(math.isfinite, differences)):
            return not math.isfinite(candidate.mean_objective)
        mean = math.fsum(differences) / shared
        variance = math.fsum((difference - mean) ** 2 for difference in differences) / (
            shared - 1
        )
        return candidate.success_rate <= leader.success_rate and mean > math.sqrt(
            variance / shared
        )

    return tuple(
        candidate
        for candidate in pool
        if candidate is leader or not is_worse(candidate)
    )


def select_best(pool: tuple[Candidate, ...]) -> Candidate:
    """Return the best candidate: by success rate, then by mean objective.

    Only new renders count, if all candidates have some.
    """
    if all(candidate.repeat_objectives for candidate in pool):
        return max(
            pool,
            key=lambda candidate: (candidate.success_rate, candidate.mean_objective),
        )
    return pool[0]


def _sort_key(candidate: Candidate) -> tuple[bool, float]:
    return candidate.success, candidate.objective


# with fewer failures than so many, each of equal weight, no estimate is stated
MIN_EFFECTIVE_FAILURES = 10.0
# sizes of a bet, each half of the one before; the capital is shared equally among them
N_BETS = 8


@dataclass(frozen=True)
class FailureRate:
    """The share of configurations, drawn evenly from the budget, in which one render of
    the search is a success: the mean of the weighted draws (None where `effective` is
    under `MIN_EFFECTIVE_FAILURES`, or a draw could not be evaluated); an interval that
    covers the share in 95 % at least, however the draws were adapted, at any number of
    them; and how many failures of equal weight would be worth as much: (sum w)^2 / sum
    w^2 (Kish 1965).
    """

    estimate: float | None
    interval: tuple[float, float]
    effective: float
    draws: int


def estimate_failure_rate(
    weights: Tensor, bounds: Tensor, failed: Tensor, unknown: Tensor
) -> FailureRate:
    """Return what draws from changing densities say of the share of failures under the
    even one.

    Draw t comes from a density q_t that may depend on all draws before it; x_t = w_t
    [failed], w_t = 1 / q_t relative to the even density, has the share p as its mean
    given these. Bets on the difference are fair games if the share is p: the capital of

        prod_t (1 - c + c x_t / p)
        prod_t (1 + c (p - x_t) / (b_t - p)),  b_t the largest weight that q_t gives,

    a mean over bets c, exceeds 2 / 0.05 with a probability of 0.025 at most (Ville
    1939), so the p at which neither does are a 95 % interval (Waudby-Smith and Ramdas
    2024, "Estimating means of bounded random variables by betting"). Both are monotone
    in p.

    All are (n,), n at least 1: w_t over 0; b_t, at least 1 and w_t, known before draw
    t; whether it failed; and whether it is unknown, as it could not be evaluated: the
    interval holds whatever these are.
    """
    weights = weights.double()
    bounds = bounds.double()
    low = weights * (failed & ~unknown)
    high = weights * (failed | unknown)
    sizes = 0.5 ** torch.arange(N_BETS, dtype=torch.float64)[:, None]
    limit = math.log(2.0 / (1.0 - CONFIDENCE)) + math.log(N_BETS)

    def against_low(p: float) -> bool:
        return (
            float(torch.log(1.0 - sizes + sizes * low / p).sum(dim=1).logsumexp(dim=0))
            >= limit
        )

    def against_high(p: float) -> bool:
        return (
            float(
                torch.log1p(sizes * (p - high) / (bounds - p))
                .sum(dim=1)
                .logsumexp(dim=0)
            )
            >= limit
        )

    total = float(low.sum())
    effective = total**2 / float(low.square().sum()) if total else 0.0
    stated = effective >= MIN_EFFECTIVE_FAILURES and not bool(unknown.any())
    ends = find_threshold(lambda p: not against_low(p)), find_threshold(against_high)
    return FailureRate(
        min(1.0, total / len(low)) if stated else None, ends, effective, len(low)
    )


MOST = 24  # failures that a result lists, at most


@dataclass(frozen=True, eq=False)
class FoundFailure:
    """A configuration (d,) that a search claims to be a success, the objective of its
    one render, biased upwards, and where the others lie that it stands for: both ends
    in u, by position.
    """

    u: Tensor
    objective: float
    ranges: dict[int, tuple[float, float]]


@dataclass(frozen=True, eq=False)
class Failures:
    """What a search knows of different failures: at most `MOST` of them; the positions
    in u of what tells cells apart; how many cells fail, were seen and are there
    (without cells, draws, and None); and how large a part of all configurations fails,
    where that can be told.
    """

    examples: tuple[FoundFailure, ...]
    over: tuple[int, ...]
    n_failures: int
    n_visited: int
    n_cells: int | None
    failure_rate: FailureRate | None = None


def select_diverse(
    points: Tensor,
    objectives: Sequence[float],
    is_periodic: Tensor,
    is_discrete: Tensor,
    limit: int = MOST,
) -> list[int]:
    """Return the indices of points that differ most, the worst first.

    After the worst, each is the farthest from all before it; of equally far points the
    worse goes first. This is the greedy choice of k centers, whose largest distance is
    at most twice the smallest possible (Gonzalez 1985, "Clustering to minimize the
    maximum intercluster distance").

    Args:
        points: (n, k), in fractions of each range.
        objectives: of the points; the larger the worse.
        is_periodic: (k,) bool, ranges whose bounds are the same value.
        is_discrete: (k,) bool, discrete choices: different options lie 1 apart.
        limit: maximum number of indices.
    """
    order = sorted(range(len(points)), key=lambda number: -objectives[number])
    points = points[order].double()
    nearest_distance = torch.full((len(points),), torch.inf, dtype=torch.float64)
    selected = list[int]()
    for _ in range(min(limit, len(points))):
        farthest = int(nearest_distance.argmax())
        selected.append(farthest)
        distance_to_chosen = (points - points[farthest]).abs()
        distance_to_chosen = torch.where(
            is_periodic,
            torch.minimum(distance_to_chosen, 1.0 - distance_to_chosen),
            distance_to_chosen,
        )
        distance_to_chosen = torch.where(
            is_discrete, (distance_to_chosen > 0.0).double(), distance_to_chosen
        )
        nearest_distance = torch.minimum(
            nearest_distance, distance_to_chosen.norm(dim=1)
        )
        nearest_distance[selected] = -1.0
    return [order[number] for number in selected]


RATIO = 1.05  # the bracket is closed once high / low is at most this
SMALLEST_SCALE = 1e-3  # no smaller scale than this is tried

MAX_SEARCHES = 12

MAX_CONFIRMATIONS = (
    6  # steps outwards that the confirmation of the upper end takes at most
)

LENGTH_RATIO = 1.0 + (RATIO - 1.0) / 5.0
"""A configuration's length is bisected until the ends are within this: a fifth of the
bracket's ratio.
"""

MAX_CHECKS = 1 + math.ceil(
    math.log2(math.log(1.0 / SMALLEST_SCALE) / math.log(LENGTH_RATIO))
)
"""Configurations that go through the trials after a search, at most: what it found, and
those of the bisection.
"""

Search = Callable[[Domain, int], Tensor]
"""(domain, round) -> the best configuration a search finds there; round numbers its
seeds.
"""

Passes = Callable[[Tensor, int], bool]
"""(u, check) -> whether a configuration passes the trials; check numbers its seeds."""

Guess = Callable[[Tensor], bool]
"""u -> whether a configuration would probably pass: a guess that costs next to
nothing.
"""


@dataclass(frozen=True, eq=False)
class Bracket:
    """Where the smallest scale lies: a search found nothing at `low` (0 where none has
    failed), and `u` (d,) passes at `high`, infinity where nothing did; of the search
    `found_by`; if `confirm_bracket` it has passed again with new seeds.
    """

    low: float
    high: float
    u: Tensor | None
    searches: int
    checks: int
    found_by: int = 0
    confirmed: bool = False

    @property
    def is_closed(self) -> bool:
        """Whether high is within `RATIO` of low."""
        return self.u is not None and self.high <= RATIO * (1.0 + 1e-9) * self.low


def scale_domain(domain: Domain, scale: float) -> Domain:
    """Return the domain with every budget multiplied by `scale`, in (0, 1]."""
    names = (
        block.name.partition(".")[0] for block in domain.blocks if block.epsilon is None
    )
    if bare := [name or "a block" for name in dict.fromkeys(names)]:
        raise InputError(
            "smallest: expected controls with a budget (texture, geometry, patch, "
            f"...), got {', '.join(bare)}, "
            "whose parameters have ranges and no epsilon; leave it out"
        )
    blocks = tuple(
        replace(block, epsilon=float(block.epsilon or 0.0) * scale)
        for block in domain.blocks
    )
    return replace(domain, blocks=blocks)


def shrink_towards_start(domain: Domain, u: Tensor, scale: float) -> Tensor:
    """Return the configuration moved towards the start, its change multiplied by
    `scale`.
    """
    return domain.project(domain.start + scale * (u - domain.start))


def find_smallest_change(
    search: Search, passes: Passes, domain: Domain, likely: Guess | None = None
) -> Bracket:
    """Bracket the smallest scale of the domain's budgets at which a configuration
    passes.

    1. A search in the whole budget. If what it finds fails the trials, there is nothing
    to shrink.
    2. The configuration is moved towards the start, by bisection in the logarithm of
       its length, to the shortest that passes: a handful of trials, no search.
    3. A search at half the scale reached, then at the geometric mean of the bracket's
       ends; each configuration that passes is shortened as in 2, each that fails raises
       the lower end; until it is closed, or after `MAX_SEARCHES`.

    For a linear model and a gradient policy the first search points the right way and 2
    ends within its own step of the optimum, so that the result is within `RATIO` of the
    closed form.

    `likely` says where 2 begins, and from where it goes on in growing steps; None to
    bisect from the whole length. The bracket is not `closed` if the searches did not
    suffice.
    """
    u = search(domain, 0)
    state = Bracket(0.0, math.inf, None, 1, 1)
    if not passes(u, 0):
        return replace(state, low=1.0)
    state = _shorten(state, u, 1.0, passes, domain, likely)
    while (
        state.searches < MAX_SEARCHES
        and state.high > RATIO * state.low
        and state.high > SMALLEST_SCALE
    ):
        scale = (
            state.high / 2.0 if state.low == 0.0 else math.sqrt(state.low * state.high)
        )
        if state.high <= RATIO**2 * state.low:
            scale = max(scale, state.high / RATIO)
        u = search(scale_domain(domain, scale), state.searches)
        has_passed = passes(u, state.checks)
        if has_passed:
            state = replace(state, found_by=state.searches)
        state = replace(state, searches=state.searches + 1, checks=state.checks + 1)
        state = (
            _shorten(state, u, scale, passes, domain, likely)
            if has_passed
            else replace(state, low=scale)
        )
    return state


def confirm_bracket(
    bracket: Bracket, passes: Passes, domain: Domain, *, times: int = 2
) -> Bracket:
    """Return the bracket with its upper end moved out until the configuration there
    passes so many times in a row: what lies exactly on the edge passes its trials by
    chance. So it is tried again with new seeds; where it fails, the change grows by a
    fortieth, in `MAX_CONFIRMATIONS`, the last of which is returned untried.
    """
    if bracket.u is None:
        return bracket
    shortest_u = bracket.u
    shortest_scale = bracket.high
    growth = 1.0
    for _ in range(MAX_CONFIRMATIONS):
        if all(passes(bracket.u, bracket.checks + repeat) for repeat in range(times)):
            return replace(bracket, checks=bracket.checks + times, confirmed=True)
        growth *= math.sqrt(RATIO)
        scale = min(1.0, shortest_scale * growth)
        grown_u = scale_domain(domain, scale).project(
            domain.start + growth * (shortest_u - domain.start)
        )
        bracket = replace(bracket, high=scale, u=grown_u, checks=bracket.checks + times)
    return bracket


def _shorten(
    state: Bracket,
    u: Tensor,
    length: float,
    passes: Passes,
    domain: Domain,
    likely: Guess | None,
) -> Bracket:
    """Bisect the length of a configuration that passes.

    It ends when the bounds are within `LENGTH_RATIO` of each other. With `likely`, the
    first length tried is the shortest that it takes for passing; steps from there grow,
    but never beyond the middle of the bounds.
    """
    low = max(state.low, SMALLEST_SCALE * length)
    high = length
    shortest_u = u
    checks = state.checks

    def shrink_to(scale: float) -> Tensor:
        """Return the configuration at a scale of the budgets."""
        return shrink_towards_start(scale_domain(domain, scale), u, scale / length)

    middle = math.sqrt(high * low)
    stride = math.inf
    if likely is not None:
        guess_low = low
        guess_high = high
        stride = LENGTH_RATIO
        while guess_high > LENGTH_RATIO * guess_low:
            middle = math.sqrt(guess_high * guess_low)
            guess_low, guess_high = (
                (guess_low, middle)
                if likely(shrink_to(middle))
                else (middle, guess_high)
            )
        middle = math.sqrt(guess_high * guess_low)
    while high > LENGTH_RATIO * low:
        shorter_u = shrink_to(middle)
        if passes(shorter_u, checks):
            shortest_u = shorter_u
            high = middle
            middle = max(math.sqrt(high * low), high / stride)
        else:
            low = middle
            middle = min(math.sqrt(high * low), low * stride)
        stride = stride * stride
        checks = checks + 1
    return replace(state, high=high, u=shortest_u, checks=checks)
