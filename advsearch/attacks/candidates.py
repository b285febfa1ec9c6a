"""The possible results of a search.

- The best configurations (`Candidate`). They are rendered again with new seeds, because
  the largest of many noisy values is mostly a lucky one (the winner's curse).
- Many different failures (`Failures`), and how frequent failures are (`FailureRate`).
- The smallest change that makes the model fail (`Bracket`), as a scale of all budgets.
  At the upper bound of the bracket a configuration passed the trials, at its lower
  bound a search found nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from advsearch.attacks.domain import Domain
from advsearch.errors import InputError
from advsearch.statistics.intervals import CONFIDENCE
from advsearch.statistics.sequential import find_threshold

# configurations that differ by less than this in every element count as the same
# candidate (an 8-bit level is 4e-3)
SAME = 1e-4


@dataclass(frozen=True, eq=False)
class Candidate:
    """A configuration that is worth further renders.

    Attributes:
        u: (d,) the configuration.
        objective: objective of its first render. It is biased upwards, because the
            candidate was selected for this value.
        success: whether the model was wrong in the first render.
        repeat_objectives: objectives of its later renders; -inf for one that is not
            finite.
        successes: number of later renders in which the model was wrong.
    """

    u: Tensor
    objective: float
    success: bool
    repeat_objectives: tuple[float, ...] = ()
    successes: int = 0

    @property
    def mean_objective(self) -> float:
        """Mean objective of the later renders; without any, that of the first."""
        if not self.repeat_objectives:
            return self.objective
        return math.fsum(self.repeat_objectives) / len(self.repeat_objectives)

    @property
    def success_rate(self) -> float:
        """Fraction of the later renders in which the model was wrong.

        Without later renders, it is 1 or 0: whether the first one was a success.
        """
        if not self.repeat_objectives:
            return float(self.success)
        # each later render has an entry in `repeat_objectives`, a success or not
        n_later_renders = len(self.repeat_objectives)
        return self.successes / n_later_renders

    def with_repeat(self, objective: float, success: bool) -> Candidate:
        return replace(
            self,
            repeat_objectives=(*self.repeat_objectives, objective),
            successes=self.successes + success,
        )


def add_candidate(
    pool: tuple[Candidate, ...], new: Candidate, size: int
) -> tuple[Candidate, ...]:
    """Return the best `size` distinct candidates of the pool and `new`, best first.

    A success is better than none; then the larger objective is better. Both are those
    of a candidate's first render. Of two that are nearly the same configuration
    (`SAME`) only the better is stored. If exactly the same configuration is in the
    pool, `new` counts as a later render of it. The value of a later render is unbiased,
    because the configuration was not selected for it.

    Args:
        pool: candidates so far, best first, of which no two are nearly the same.
        new: candidate to add.
        size: largest number of candidates.
    """
    for old in pool:
        if torch.equal(old.u, new.u):
            return _repeat_candidate(pool, old, new)
    is_full = len(pool) >= size
    if is_full and _sort_key(new) <= _sort_key(pool[-1]):  # no better than the worst
        return pool
    similar = _find_similar(pool, new)
    if similar is not None and _sort_key(new) <= _sort_key(similar):
        return pool
    # `new` replaces a similar candidate, which is no better
    others = [candidate for candidate in pool if candidate is not similar]
    return tuple(sorted((*others, new), key=_sort_key, reverse=True)[:size])


def _repeat_candidate(
    pool: tuple[Candidate, ...], old: Candidate, new: Candidate
) -> tuple[Candidate, ...]:
    """Return the pool with `new` counted as a later render of its member `old`.

    The order stays, as it only depends on the first render.
    """
    updated = old.with_repeat(new.objective, new.success)
    return tuple(updated if candidate is old else candidate for candidate in pool)


def _find_similar(pool: tuple[Candidate, ...], new: Candidate) -> Candidate | None:
    """Return the first candidate of the pool that is nearly the same as `new`, or None.

    Two are if no element differs by `SAME` or more.
    """
    for old in pool:
        largest_difference = float((old.u - new.u).abs().amax())
        if largest_difference < SAME:
            return old
    return None


def replace_worst(
    pool: tuple[Candidate, ...], last: Candidate | None, size: int
) -> tuple[Candidate, ...]:
    """Return the pool with the last configuration of a search at its end.

    Without a last configuration, or if it is in the pool already, the pool is returned
    unchanged.

    Args:
        pool: candidates, best first.
        last: the last configuration that was evaluated, or None.
        size: largest number of candidates. If the pool has as many, its worst is left
            out.
    """
    if last is None or any(torch.equal(candidate.u, last.u) for candidate in pool):
        return pool
    return (*pool[: size - 1], last)


def select_contenders(
    pool: tuple[Candidate, ...], n_shared: int
) -> tuple[Candidate, ...]:
    """Return the best candidate so far and those that are not clearly worse, in order.

    This is a race (Maron and Moore 1994, "Hoeffding races"), with one standard error as
    the margin and not Hoeffding's much wider bound: a search only has to choose the
    better of two, not to prove it.

    Args:
        pool: the candidates.
        n_shared: number of the latest renders for which all candidates had the same
            seeds, so that they can be compared seed by seed.
    """
    # One render does not show the noise, and one candidate has no rival.
    if n_shared < 2 or len(pool) < 2:
        return pool
    leader = select_best(pool)
    return tuple(
        candidate
        for candidate in pool
        if candidate is leader or not _is_clearly_worse(candidate, leader, n_shared)
    )


def _is_clearly_worse(candidate: Candidate, leader: Candidate, n_shared: int) -> bool:
    """Return whether a candidate is clearly worse than the best one, the leader.

    It is if its success rate is not higher, and the leader's objective is larger by
    more than the standard error of the difference. Objectives are compared seed by
    seed. If a difference is not finite, no error can be computed: the candidate is
    worse exactly if its mean is not finite.

    Args:
        candidate: candidate to compare.
        leader: the best candidate so far.
        n_shared: number of the latest renders that share their seeds, at least 2.
    """
    differences = _subtract_objectives(leader, candidate, n_shared)
    if not all(map(math.isfinite, differences)):
        return not math.isfinite(candidate.mean_objective)
    mean_difference = math.fsum(differences) / n_shared
    squares = math.fsum(
        (difference - mean_difference) ** 2 for difference in differences
    )
    variance = squares / (n_shared - 1)
    standard_error = math.sqrt(variance / n_shared)
    has_higher_rate = candidate.success_rate > leader.success_rate
    return not has_higher_rate and mean_difference > standard_error


def _subtract_objectives(
    leader: Candidate, candidate: Candidate, n_shared: int
) -> list[float]:
    """Return by how much the leader's objective is larger, for each shared seed.

    Args:
        leader: one candidate.
        candidate: another one.
        n_shared: number of the latest renders that share their seeds.
    """
    objective_pairs = zip(
        leader.repeat_objectives[-n_shared:],
        candidate.repeat_objectives[-n_shared:],
        strict=True,
    )
    return [
        leader_objective - objective for leader_objective, objective in objective_pairs
    ]


def select_best(pool: tuple[Candidate, ...]) -> Candidate:
    """Return the best candidate: by success rate, then by mean objective.

    Both are computed from later renders only, because a candidate was selected for the
    value of its first one. If a candidate has no later render, the candidates are
    compared by their first renders instead.

    Args:
        pool: at least one candidate, sorted by first renders, the best first.
    """
    have_later_renders = all(candidate.repeat_objectives for candidate in pool)
    if have_later_renders:
        return max(
            pool,
            key=lambda candidate: (candidate.success_rate, candidate.mean_objective),
        )
    return pool[0]


def _sort_key(candidate: Candidate) -> tuple[bool, float]:
    """Return the key by which a pool is sorted, from a candidate's first render."""
    return candidate.success, candidate.objective


# No estimate is made from fewer effective failures than this.
MIN_EFFECTIVE_FAILURES = 10.0
# number of sizes of a bet, 1, 1/2, 1/4, ...; the capital is divided equally among them
N_BETS = 8


@dataclass(frozen=True)
class FailureRate:
    """The fraction of configurations, uniform in the budget, at which a single render
    of the search is a failure of the model.

    Attributes:
        estimate: mean of the weighted samples; None if `effective` is less than
            `MIN_EFFECTIVE_FAILURES`, or a sample could not be evaluated.
        interval: covers the rate with a probability of at least 95 %, however the
            samples were adapted and whenever one stops.
        effective: number of failures of equal weight that would be worth as much: (sum
            w)^2 / sum w^2 (Kish 1965).
        draws: number of samples.
    """

    estimate: float | None
    interval: tuple[float, float]
    effective: float
    draws: int


def estimate_failure_rate(
    weights: Tensor, bounds: Tensor, failed: Tensor, unknown: Tensor
) -> FailureRate:
    """Estimate the failure rate of uniform configurations from adaptive samples.

    Sample t comes from a density q_t that may depend on all samples before it. Its
    weight is w_t = 1 / q_t, relative to the uniform density. Let x_t be w_t if the
    sample failed, otherwise 0. Given the samples before, the mean of x_t is the rate p.
    Let b_t be an upper bound of the weights that q_t can give.

    Args:
        weights: (n,) w_t, over 0; n is at least 1.
        bounds: (n,) b_t, at least 1 and at least w_t, known before sample t.
        failed: (n,) bool, whether the model was wrong at a sample.
        unknown: (n,) bool, whether a sample could not be evaluated. The interval holds
            whether these failed or not.
    """
    weights = weights.double()
    # The lower bound of the rate assumes that no unknown sample failed, the upper bound
    # that all of them did. Each has its own x_t.
    x_if_unknown_pass = weights * (failed & ~unknown)
    x_if_unknown_fail = weights * (failed | unknown)
    n_samples = len(weights)
    effective = _count_effective_failures(x_if_unknown_pass)
    estimate = None
    if effective >= MIN_EFFECTIVE_FAILURES and not bool(unknown.any()):
        mean = float(x_if_unknown_pass.sum()) / n_samples
        estimate = min(1.0, mean)  # by chance the mean may exceed 1; a rate can't
    interval = _bound_failure_rate(
        x_if_unknown_pass, x_if_unknown_fail, bounds.double()
    )
    return FailureRate(estimate, interval, effective, draws=n_samples)


def _count_effective_failures(x: Tensor) -> float:
    """Return the number of equally weighted failures that are worth as much.

    It is (sum x)^2 / sum x^2 (Kish 1965).

    Args:
        x: (n,) weights of the samples that failed, and 0 for all others.
    """
    total = float(x.sum())
    return total**2 / float(x.square().sum()) if total else 0.0


def _bound_failure_rate(
    x_if_unknown_pass: Tensor, x_if_unknown_fail: Tensor, bounds: Tensor
) -> tuple[float, float]:
    """Return a 95 % interval of a failure rate p, the mean of x_t over samples t.

    The interval is by betting (Waudby-Smith and Ramdas 2024, "Estimating means of
    bounded random variables by betting"). For each p in [0, 1], one gambler bets that
    the rate is over p, another one that it is under p. Both bet the fraction c of their
    capital on each sample. The capital starts at 1. After all samples it is

        prod_t (1 - c + c x_t / p)               for the bet that the rate is over p;
        prod_t (1 + c (p - x_t) / (b_t - p))     for the bet that it is under p.

    If the rate is p, both bets are fair. Then the mean of the capital over several c
    exceeds 40 with a probability of at most 1 / 40 (Ville 1939), for either bet. That
    is 0.05 for both together. So the values of p at which neither bet exceeds this
    limit are a 95 % interval. The first capital
    falls with p and the second grows, so the interval has one lower and one upper end.

    Args:
        x_if_unknown_pass: (n,) x_t for the lower end of the interval.
        x_if_unknown_fail: (n,) x_t for the upper end.
        bounds: (n,) b_t, at least 1 and at least x_t, known before sample t.
    """
    # The interval begins where the bets on a larger rate have no longer won, and ends
    # where the bets on a smaller one begin to win.
    # `find_threshold` returns where a condition on p begins to hold. It tries only p
    # between 0 and 1, exclusive, so that neither p nor `bounds - p` is 0.
    lower = find_threshold(lambda p: not _have_won_over(p, x_if_unknown_pass))
    upper = find_threshold(lambda p: _have_won_under(p, x_if_unknown_fail, bounds))
    return lower, upper


def _have_won_over(p: float, x: Tensor) -> bool:
    """Return whether the bets that the rate is over p have won, from x_t (n,)."""
    bet_sizes = _make_bet_sizes()
    # A bet of the whole capital (c = 1) is lost at the first sample without a
    # failure. Its logarithm is -inf, which adds nothing to the sum of `_exceed_limit`.
    factors = 1.0 - bet_sizes + bet_sizes * x / p  # (bets, n)
    return _exceed_limit(torch.log(factors).sum(dim=1))


def _have_won_under(p: float, x: Tensor, bounds: Tensor) -> bool:
    """Return whether the bets that the rate is under p have won, from x_t and b_t."""
    gains = _make_bet_sizes() * (p - x) / (bounds - p)  # (bets, n)
    return _exceed_limit(torch.log1p(gains).sum(dim=1))


def _make_bet_sizes() -> Tensor:
    """Return the fractions of the capital that are bet, c: 1, 1/2, 1/4, ...; (bets, 1)
    float64.
    """
    bet_sizes: Tensor = 0.5 ** torch.arange(N_BETS, dtype=torch.float64)[:, None]
    return bet_sizes


def _exceed_limit(log_capital: Tensor) -> bool:
    """Return whether the mean capital of the bets is at least 40 = 2 / 0.05.

    Args:
        log_capital: (bets,) logarithm of each bet's capital after all samples.
    """
    # `logsumexp` gives the logarithm of the sum over all bets, which is `N_BETS` times
    # the mean.
    log_limit = math.log(2.0 / (1.0 - CONFIDENCE)) + math.log(N_BETS)
    return float(log_capital.logsumexp(dim=0)) >= log_limit


MAX_FAILURES = 24  # maximum number of failures in a result


@dataclass(frozen=True, eq=False)
class FoundFailure:
    """A failure that a search claims, and the similar ones that it represents.

    Attributes:
        u: (d,) the configuration.
        objective: objective of its single render, biased upwards.
        ranges: (low, high) of each parameter over the failures that it represents, by
            index in u.
    """

    u: Tensor
    objective: float
    ranges: dict[int, tuple[float, float]]


@dataclass(frozen=True, eq=False)
class Failures:
    """The different failures that a search has met.

    A policy may divide the domain into cells, which are counted; otherwise samples are.

    Attributes:
        examples: at most `MAX_FAILURES` failures.
        cell_parameter_indices: indices in u of the parameters that span the cells.
        n_failures: number of cells, or samples, with a failure.
        n_visited: number of cells, or samples, that were evaluated.
        n_cells: number of cells of the domain; None without cells.
        failure_rate: fraction of all configurations that fail; None if it was not
            estimated.
    """

    examples: tuple[FoundFailure, ...]
    cell_parameter_indices: tuple[int, ...]
    n_failures: int
    n_visited: int
    n_cells: int | None
    failure_rate: FailureRate | None = None


def select_diverse(
    points: Tensor,
    objectives: Sequence[float],
    is_periodic: Tensor,
    is_discrete: Tensor,
    limit: int = MAX_FAILURES,
) -> list[int]:
    """Return the indices of points that differ most from each other, the worst first.

    The first is the point with the largest objective. Each next one is the point that
    is farthest from its nearest selected point; of equally far ones, the one with the
    larger objective. This is the greedy choice of k centers (Gonzalez 1985, "Clustering
    to minimize the maximum intercluster distance"): the largest distance of any point
    from a center is at most twice the smallest possible.

    Args:
        points: (n, k), each value a fraction of its range.
        objectives: objectives of the points; the larger, the worse for the model.
        is_periodic: (k,) bool, whether 0 and 1 are the same value, as for an angle.
        is_discrete: (k,) bool, whether it is a discrete choice; different options have
            the distance 1.
        limit: maximum number of indices.
    """
    # the worst first: `argmax` below returns the first of equally far points
    order = sorted(range(len(points)), key=lambda index: -objectives[index])
    ordered_points = points[order].double()
    # (n,) distance to the nearest selected point; infinite before there is one
    nearest_distance = torch.full((len(points),), torch.inf, dtype=torch.float64)
    selected = list[int]()
    for _ in range(min(limit, len(points))):
        farthest = int(nearest_distance.argmax())
        selected.append(farthest)
        difference = (ordered_points - ordered_points[farthest]).abs()
        distance = _compute_length(difference, is_periodic, is_discrete)
        nearest_distance = torch.minimum(nearest_distance, distance)
        nearest_distance[selected] = -1.0  # below every distance: never selected again
    return [order[rank] for rank in selected]


def _compute_length(
    difference: Tensor, is_periodic: Tensor, is_discrete: Tensor
) -> Tensor:
    """Return the lengths (n,) of absolute differences (n, k) in fractions of a range.

    Args:
        difference: (n, k) absolute differences of two values, each in [0, 1].
        is_periodic: (k,) bool, whether 0 and 1 are the same value.
        is_discrete: (k,) bool, whether all different values have the distance 1.
    """
    # around a circle of length 1, the shorter of both directions
    wrapped_difference = torch.minimum(difference, 1.0 - difference)
    difference = torch.where(is_periodic, wrapped_difference, difference)
    difference = torch.where(is_discrete, (difference > 0.0).double(), difference)
    length: Tensor = difference.norm(dim=1)
    return length


# The bracket of the smallest change is closed once high / low is at most this.
RATIO = 1.05
SMALLEST_SCALE = 1e-3  # no smaller scale than this is tried

MAX_SEARCHES = 12

MAX_CONFIRMATIONS = 6  # steps outwards of `confirm_bracket`

LENGTH_RATIO = 1.0 + (RATIO - 1.0) / 5.0
"""Ratio of the bounds at which the bisection of a configuration's length ends. It is
1.01, five times closer to 1 than `RATIO`.
"""

MAX_CHECKS = 1 + math.ceil(
    math.log2(math.log(1.0 / SMALLEST_SCALE) / math.log(LENGTH_RATIO))
)
"""Maximum number of configurations that go through the trials after a search: its best
one, and those of the bisection.
"""

Search = Callable[[Domain, int], Tensor]
"""(domain, round) -> the best configuration that a search finds in the domain. Its
seeds depend on the round.
"""

Passes = Callable[[Tensor, int], bool]
"""(u, check) -> whether a configuration passes the trials. Their seeds depend on the
index of the check.
"""

Guess = Callable[[Tensor], bool]
"""u -> whether a configuration would probably pass. It is predicted without trials."""


@dataclass(frozen=True, eq=False)
class Bracket:
    """The bounds of the smallest scale.

    Attributes:
        largest_failing_scale: largest scale at which a search found nothing; 0 if none
            has failed.
        smallest_passing_scale: smallest scale at which a configuration passed; infinity
            if none did.
        u: (d,) the configuration at `smallest_passing_scale`; None if there is none.
        searches: number of searches so far.
        n_checks: number of configurations that went through the trials so far.
        found_by: index of the search that found `u`, before it was shortened.
        confirmed: whether `u` has passed again with new seeds (`confirm_bracket`).
    """

    largest_failing_scale: float
    smallest_passing_scale: float
    u: Tensor | None
    searches: int
    n_checks: int
    found_by: int = 0
    confirmed: bool = False

    @property
    def is_closed(self) -> bool:
        """Whether the smallest passing scale is within `RATIO` of the largest failing.

        False if no configuration passed.
        """
        return (
            self.u is not None
            # the 1e-9 is for rounding
            and self.smallest_passing_scale
            <= RATIO * (1.0 + 1e-9) * self.largest_failing_scale
        )


def scale_domain(domain: Domain, scale: float) -> Domain:
    """Return the domain with every budget multiplied by a factor.

    Args:
        domain: domain whose blocks are all norm balls, with an epsilon.
        scale: factor of every epsilon, in (0, 1].

    Raises:
        InputError: a block has a range and no epsilon.
    """
    _check_all_have_budgets(domain)
    scaled_blocks = []
    for block in domain.blocks:
        assert block.epsilon is not None
        scaled_blocks.append(replace(block, epsilon=block.epsilon * scale))
    return replace(domain, blocks=tuple(scaled_blocks))


def _check_all_have_budgets(domain: Domain) -> None:
    """Raise InputError if a block has a range and no epsilon."""
    # "pose.yaw", the name of a block, belongs to the control "pose"
    controls_without_budget = [
        block.name.partition(".")[0] for block in domain.blocks if block.epsilon is None
    ]
    if controls_without_budget:
        names = [name or "a block" for name in dict.fromkeys(controls_without_budget)]
        raise InputError(
            "smallest: expected controls with a budget (texture, geometry, patch, "
            f"...), got {', '.join(names)}, "
            "whose parameters have ranges and no epsilon; leave it out"
        )


def shrink_towards_start(domain: Domain, u: Tensor, scale: float) -> Tensor:
    """Return the configuration moved towards the start, its change multiplied by
    `scale`.
    """
    return domain.project(domain.start + scale * (u - domain.start))


def find_smallest_change(
    search: Search, passes: Passes, domain: Domain, likely: Guess | None = None
) -> Bracket:
    """Bracket the smallest change with which a configuration passes its trials.

    A configuration passes if the model fails in enough of its trials. The change is
    measured as a scale of the domain's budgets: 1 means the full budgets.

    1. Search in the full budgets. If the result does not pass, there is nothing to
       shrink.
    2. Move the configuration towards the start (the clean configuration), by bisection
       of the logarithm of its length, to the shortest that passes. This takes a few
       trials and no search.
    3. Search again at half the scale reached so far; later at the geometric mean of the
       bracket's bounds. A configuration that passes is shortened as in 2. One that does
       not pass raises the lower bound. This ends when the bracket is closed, or after
       `MAX_SEARCHES`.

    For a linear model and a gradient policy, the first search finds the right direction
    and step 2 the right length, so that the result is within `RATIO` of the closed
    form.

    Args:
        search: returns the best configuration (d,) that it finds in a domain.
        passes: runs the trials of a configuration; returns whether it passes.
        domain: domain with the full budgets.
        likely: predicts cheaply whether a configuration would pass. The bisection of
            step 2 begins at the length that this predicts to be the shortest. None to
            bisect from the full length.

    Returns:
        The bracket. It is not `is_closed` if the searches did not suffice. If nothing
        passed in the full budgets, its `largest_failing_scale` is 1 and its `u` None.
    """
    full_u = search(domain, 0)  # the best configuration in the full budgets
    # Nothing is known to pass yet. The counts include the search above and the check
    # below.
    bracket = Bracket(0.0, math.inf, u=None, searches=1, n_checks=1)
    if not passes(full_u, 0):  # the check with the index 0
        return replace(bracket, largest_failing_scale=1.0)
    bracket = _shorten(bracket, full_u, 1.0, passes, domain, likely)
    while _is_worth_a_search(bracket):
        bracket = _search_again(bracket, search, passes, domain, likely)
    return bracket


def _is_worth_a_search(bracket: Bracket) -> bool:
    """Return whether one more search may narrow the bracket, and may be made."""
    is_open = bracket.smallest_passing_scale > RATIO * bracket.largest_failing_scale
    return (
        bracket.searches < MAX_SEARCHES
        and is_open
        and bracket.smallest_passing_scale > SMALLEST_SCALE
    )


def _search_again(
    bracket: Bracket,
    search: Search,
    passes: Passes,
    domain: Domain,
    likely: Guess | None,
) -> Bracket:
    """Search once more inside the bracket, and return the bracket with the result.

    The arguments are those of `find_smallest_change`.
    """
    scale = _choose_next_scale(bracket)
    # The counts so far are the indices of the next search and the next check.
    search_index = bracket.searches
    check_index = bracket.n_checks
    u = search(scale_domain(domain, scale), search_index)
    has_passed = passes(u, check_index)
    bracket = replace(bracket, searches=search_index + 1, n_checks=check_index + 1)
    if not has_passed:
        # This search found nothing at `scale`, so nothing smaller is expected.
        return replace(bracket, largest_failing_scale=scale)
    bracket = replace(bracket, found_by=search_index)
    return _shorten(bracket, u, scale, passes, domain, likely)


def _choose_next_scale(bracket: Bracket) -> float:
    """Return the scale of the budgets at which to search next, inside the bracket.

    It is the geometric mean of both bounds, or half the upper one if no search has
    failed yet.
    """
    has_failed_search = bracket.largest_failing_scale > 0.0
    if not has_failed_search:
        return bracket.smallest_passing_scale / 2.0
    scale = math.sqrt(bracket.largest_failing_scale * bracket.smallest_passing_scale)
    # If the next search finds nothing, its scale becomes the lower bound. With bounds
    # this close, that closes the bracket. `max` ensures this against rounding.
    can_close = (
        bracket.smallest_passing_scale <= RATIO**2 * bracket.largest_failing_scale
    )
    if can_close:
        scale = max(scale, bracket.smallest_passing_scale / RATIO)
    return scale


def confirm_bracket(
    bracket: Bracket, passes: Passes, domain: Domain, *, times: int = 2
) -> Bracket:
    """Enlarge the change at the bracket's upper bound until it passes reliably.

    A configuration exactly at the limit passes its trials by chance. So it is tried
    with new seeds. If it does not pass, its change is made 2.5 % longer, which is half
    of `RATIO` on a logarithmic scale, and it is tried again. After `MAX_CONFIRMATIONS`
    failed attempts the bracket is returned unconfirmed. Its configuration was made
    longer after the last attempt, and was not tried.

    Args:
        bracket: result of `find_smallest_change`. If it has no configuration (`u`), it
            is returned unchanged.
        passes: runs the trials of a configuration; returns whether it passes.
        domain: domain with the full budgets; the scale never exceeds 1.
        times: how many times in a row the configuration has to pass.
    """
    if bracket.u is None:
        return bracket
    shortest = bracket
    growth = 1.0  # factor of the change since the shortest that passed
    for _ in range(MAX_CONFIRMATIONS):
        # The seeds of a check's trials follow from its index. Every attempt takes
        # `times` new indices, even if it ends at the first failure.
        next_check = bracket.n_checks + times
        check_indices = range(bracket.n_checks, next_check)
        assert bracket.u is not None
        if all(passes(bracket.u, check_index) for check_index in check_indices):
            return replace(bracket, n_checks=next_check, confirmed=True)
        growth *= math.sqrt(RATIO)  # the 2.5 %
        grown = _grow(shortest, growth, domain)
        bracket = replace(grown, n_checks=next_check)
    return bracket


def _grow(bracket: Bracket, growth: float, domain: Domain) -> Bracket:
    """Return the bracket with its configuration's change multiplied by `growth`.

    Args:
        bracket: bracket that has a configuration.
        growth: factor of the change, at least 1.
        domain: domain with the full budgets; the scale never exceeds 1.
    """
    assert bracket.u is not None
    scale = min(1.0, bracket.smallest_passing_scale * growth)
    change = bracket.u - domain.start
    grown_u = scale_domain(domain, scale).project(domain.start + growth * change)
    return replace(bracket, smallest_passing_scale=scale, u=grown_u)


def _shorten(
    bracket: Bracket,
    u: Tensor,
    length: float,
    passes: Passes,
    domain: Domain,
    likely: Guess | None,
) -> Bracket:
    """Move a configuration towards the start as far as it still passes its trials.

    A length is the scale of the budgets that a configuration needs. It is found by
    bisection (`_LengthBisection`).

    Args:
        bracket: bracket so far. No length below its largest failing scale is tried,
            because a search found nothing there.
        u: (d,) a configuration that passes.
        length: length of u.
        passes: runs the trials of a configuration; returns whether it passes.
        domain: domain with the full budgets.
        likely: predicts cheaply whether a configuration passes; None to bisect from the
            first trial on.

    Returns:
        The bracket with the shortest configuration that passed at its upper bound.
    """
    shrink_to = partial(_shrink_to_length, domain, u, length)
    low = max(bracket.largest_failing_scale, SMALLEST_SCALE * length)
    bisection = _LengthBisection.start_between(low, length, likely, shrink_to)
    bracket = replace(bracket, u=u)
    while not bisection.is_done:
        shorter_u = shrink_to(bisection.trial_length)
        has_passed = passes(shorter_u, bracket.n_checks)
        bracket = replace(bracket, n_checks=bracket.n_checks + 1)
        if has_passed:
            bracket = replace(bracket, u=shorter_u)
        bisection.add_trial(has_passed)
    return replace(bracket, smallest_passing_scale=bisection.high)


def _shrink_to_length(
    domain: Domain, u: Tensor, length: float, new_length: float
) -> Tensor:
    """Return a configuration of one length moved towards the start, to another one.

    Args:
        domain: domain with the full budgets.
        u: (d,) the configuration.
        length: scale of the budgets that it needs.
        new_length: scale of the budgets that the result needs.
    """
    scaled_domain = scale_domain(domain, new_length)
    return shrink_towards_start(scaled_domain, u, new_length / length)


@dataclass
class _LengthBisection:
    """A bisection of the logarithm of the shortest length that passes its trials.

    Without a prediction of the shortest length it is plain bisection: each trial is at
    the geometric mean of the bounds. With one, the first trial is at the predicted
    length. The prediction is nearly right, so the next trial is only a factor of
    `LENGTH_RATIO` away. The factor is squared after each trial, until a step of
    bisection is shorter.

    Attributes:
        low: length at which nothing passes, or which is not tried.
        high: shortest length so far that passed.
        trial_length: length to try next.
        max_step_factor: largest ratio of the next trial's length to that of this one.
    """

    low: float
    high: float
    trial_length: float
    max_step_factor: float

    @classmethod
    def start_between(
        cls,
        low: float,
        high: float,
        likely: Guess | None,
        shrink_to: Callable[[float], Tensor],
    ) -> _LengthBisection:
        """Return a bisection between two lengths, before its first trial.

        Args:
            low, high: bounds of the length, over 0.
            likely: predicts whether a configuration would pass; None for plain
                bisection.
            shrink_to: returns the configuration (d,) of a length.
        """
        if likely is None:
            # plain bisection; the square of infinity is infinite, too
            return cls(low, high, math.sqrt(high * low), math.inf)
        trial_length = _guess_shortest(likely, shrink_to, low, high)
        return cls(low, high, trial_length, LENGTH_RATIO)

    @property
    def is_done(self) -> bool:
        """Whether the bounds are within `LENGTH_RATIO` of each other."""
        return not self.high > LENGTH_RATIO * self.low

    def add_trial(self, has_passed: bool) -> None:
        """Move a bound to the length that was tried, and choose the next length."""
        if has_passed:
            self.high = self.trial_length
            geometric_mean = math.sqrt(self.high * self.low)
            self.trial_length = max(geometric_mean, self.high / self.max_step_factor)
        else:
            self.low = self.trial_length
            geometric_mean = math.sqrt(self.high * self.low)
            self.trial_length = min(geometric_mean, self.low * self.max_step_factor)
        # not `**`, which raises OverflowError for large numbers
        self.max_step_factor = self.max_step_factor * self.max_step_factor


def _guess_shortest(
    likely: Guess, shrink_to: Callable[[float], Tensor], low: float, high: float
) -> float:
    """Return about the shortest length between two bounds that is likely to pass.

    It is found by bisection of its logarithm, without trials.

    Args:
        likely: predicts whether a configuration would pass.
        shrink_to: returns the configuration (d,) of a length.
        low, high: bounds of the length, over 0.
    """
    while high > LENGTH_RATIO * low:
        middle = math.sqrt(high * low)
        if likely(shrink_to(middle)):
            high = middle
        else:
            low = middle
    return math.sqrt(high * low)
