"""The smallest change that flips the answer: the least epsilon, bracketed from both sides.

A scale s in (0, 1] multiplies every budget of a domain at once. The answer is a bracket [low, high]: at `high` a
configuration passed the trials; at `low` a whole search found none that did. The upper end is a fact; the lower one is
only as good as the search.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from torch import Tensor

from advsearch.attacks.domain import Domain
from advsearch.errors import InputError

RATIO = 1.05
"""The bracket is closed once high / low is at most this."""

SMALLEST_SCALE = 1e-3
"""No smaller scale than this is tried."""

ROUNDS = 12
"""Searches at most."""

ATTEMPTS = 6
"""Steps outwards that the confirmation of the upper end takes at most."""

SHORTENED = 1.0 + (RATIO - 1.0) / 5.0
"""An answer's length is bisected until the ends are within this: a fifth of the bracket's ratio."""

MOST_CHECKS = 1 + math.ceil(math.log2(math.log(1.0 / SMALLEST_SCALE) / math.log(SHORTENED)))
"""Configurations that go through the trials after a search, at most: its answer, and those of the bisection."""

Search = Callable[[Domain, int], Tensor]
"""(domain, round) -> the best configuration a search finds there; round numbers its seeds."""

Passes = Callable[[Tensor, int], bool]
"""(u, check) -> whether a configuration passes the trials; check numbers its seeds."""


Likely = Callable[[Tensor], bool]
"""u -> whether a configuration would probably pass: a guess that costs next to nothing."""


@dataclass(frozen=True, eq=False)
class Bracket:
    """Where the smallest scale lies.

    Attributes:
        low: at this scale a search found nothing; 0 where none has failed.
        high: at this scale `u` passes; infinity where nothing passed at all.
        u: (d,) a configuration within `high`; None where nothing passed.
        searches: how many were run.
        checks: how often a configuration went through the trials.
        found_by: number of the search that found `u`, or the longer change that it is the end of.
        confirmed: whether `u` has passed again, with new seeds (see `confirmed`).
    """

    low: float
    high: float
    u: Tensor | None
    searches: int
    checks: int
    found_by: int = 0
    confirmed: bool = False

    @property
    def closed(self) -> bool:
        """Whether high is within `RATIO` of low."""
        return self.u is not None and self.high <= RATIO * (1.0 + 1e-9) * self.low


def scaled(domain: Domain, scale: float) -> Domain:
    """Return the domain with every budget multiplied by `scale`, in (0, 1].

    Raises:
        InputError: a block has bounds and no budget, so that there is nothing to scale.
    """
    names = (block.name.partition(".")[0] for block in domain.blocks if block.epsilon is None)
    bare = [name or "a block" for name in dict.fromkeys(names)]
    if bare:
        raise InputError(
            f"smallest: expected controls with a budget (texture, geometry, patch, ...), got {', '.join(bare)}, "
            "whose parameters have ranges and no epsilon; leave it out"
        )
    blocks = tuple(replace(block, epsilon=float(block.epsilon or 0.0) * scale) for block in domain.blocks)
    return replace(domain, blocks=blocks)


def shrunk(domain: Domain, u: Tensor, scale: float) -> Tensor:
    """Return the configuration moved towards the start, its change multiplied by `scale`."""
    return domain.project(domain.start + scale * (u - domain.start))


def smallest(search: Search, passes: Passes, domain: Domain, likely: Likely | None = None) -> Bracket:
    """Bracket the smallest scale of the domain's budgets at which a configuration passes.

    1. A search in the whole budget. If its answer fails the trials, there is nothing to shrink.
    2. The answer is moved towards the start, by bisection in the logarithm of its length, to the shortest that passes:
       a handful of trials, no search.
    3. A search at half the scale reached, then at the geometric mean of the bracket's ends; each answer that passes is
       shortened as in 2, each that fails raises the lower end; until it is closed or `ROUNDS` searches are done.

    For a linear model and a gradient policy the first search points the right way and 2 ends within its own step of the
    optimum, so that the result is within `RATIO` of the closed form.

    Args:
        search: finds the best configuration of a domain.
        passes: verifies one.
        domain: the largest budget.
        likely: says where 2 begins, and from where it goes on in growing steps; None to bisect from the whole length.

    Returns:
        The bracket; not `closed` if the searches did not suffice.
    """
    u = search(domain, 0)
    state = Bracket(0.0, math.inf, None, 1, 1)
    if not passes(u, 0):
        return replace(state, low=1.0)
    state = _shorten(replace(state, high=1.0, u=u), passes, domain, likely)
    while state.searches < ROUNDS and state.high > RATIO * state.low and state.high > SMALLEST_SCALE:
        floor = state.high / 2.0 if state.low == 0.0 else math.sqrt(state.low * state.high)
        scale = max(floor, state.high / RATIO if state.high <= RATIO**2 * state.low else floor)
        inside = scaled(domain, scale)
        u = search(inside, state.searches)
        passed = passes(u, state.checks)
        state = replace(state, searches=state.searches + 1, checks=state.checks + 1)
        if passed:
            state = replace(state, high=scale, u=u, found_by=state.searches - 1)
            state = _shorten(state, passes, domain, likely)
        else:
            state = replace(state, low=scale)
    return state


def confirmed(bracket: Bracket, passes: Passes, domain: Domain, *, times: int = 2, attempts: int = ATTEMPTS) -> Bracket:
    """Return the bracket with its upper end moved out until the configuration there passes several times in a row.

    What lies exactly on the edge passes its trials by chance, and the one that was chosen among many passed by luck. So
    it is tried again with new seeds; where it fails, the change grows by a fortieth.

    Args:
        bracket: as `smallest` returns it.
        passes: verifies a configuration.
        domain: the largest budget.
        times: in a row.
        attempts: steps outwards at most; what the last one leads to is returned untried, and not `confirmed`.
    """
    if bracket.u is None:
        return bracket
    edge, reached, at = bracket.u, bracket.high, 1.0
    for _ in range(attempts):
        if all(passes(bracket.u, bracket.checks + again) for again in range(times)):
            return replace(bracket, checks=bracket.checks + times, confirmed=True)
        at *= math.sqrt(RATIO)
        high = min(1.0, reached * at)
        farther = scaled(domain, high).project(domain.start + at * (edge - domain.start))
        bracket = replace(bracket, high=high, u=farther, checks=bracket.checks + times)
    return bracket


def _shorten(state: Bracket, passes: Passes, domain: Domain, likely: Likely | None) -> Bracket:
    """Bisect the length of the configuration until the ends are within `SHORTENED`.

    With a guess it is tried there first, and then farther and farther from there, but never beyond the middle.
    """
    if state.u is None:
        raise RuntimeError("there is no configuration to shorten")
    longest, length, low = state.u, state.high, max(state.low, SMALLEST_SCALE * state.high)

    def at(scale: float) -> Tensor:
        return shrunk(scaled(domain, scale), longest, scale / length)

    best, high, checks = state.u, length, state.checks
    middle, stride = math.sqrt(high * low), math.inf
    if likely is not None:
        middle, stride = _crossing(lambda scale: likely(at(scale)), low, high), SHORTENED
    while high > SHORTENED * low:
        shorter = at(middle)
        if passes(shorter, checks):
            best, high = shorter, middle
            middle = max(math.sqrt(high * low), high / stride)
        else:
            low = middle
            middle = min(math.sqrt(high * low), low * stride)
        stride, checks = stride * stride, checks + 1
    return replace(state, high=high, u=best, checks=checks)


def _crossing(likely: Callable[[float], bool], low: float, high: float) -> float:
    """Return the shortest length in (low, high) of which a guess says that it passes, to within `SHORTENED`."""
    while high > SHORTENED * low:
        middle = math.sqrt(high * low)
        low, high = (low, middle) if likely(middle) else (middle, high)
    return math.sqrt(high * low)
