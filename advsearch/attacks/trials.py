"""Counting successes, saying how sure the count is, and how many samples a pixel trials need (docs/design.md).

Monte Carlo noise takes part of the margin away, and less of it the more samples there are. So the margin *drifts*
with the sample count, and a verification in the middle of that drift credits the scene with what the noise did.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise, product
from statistics import fmean
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import bdtr, betaincinv, ndtr, ndtri, stdtrit
from torch import Tensor

from advsearch.attacks.evaluation import Evaluate, Query
from advsearch.errors import InputError
from advsearch.seeds import stream

CONFIDENCE = 0.95  # confidence of every interval that is printed


def clopper_pearson(successes: int, trials: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Return the exact two-sided binomial interval of a success rate.

    Of k successes, from 0 to n, in n trials, at least 1, with a = 1 - confidence in (0, 1): low solves P(X >= k | low)
    = a/2 and high P(X <= k | high) = a/2, quantiles of beta distributions: B(a/2; k, n - k + 1), exactly 0 for k = 0,
    and B(1 - a/2; k + 1, n - k), exactly 1 for k = n. The interval covers the true rate at least as often as it says,
    at every n (Clopper and Pearson 1934). Raises InputError where an argument is out of range.
    """
    if trials < 1:
        raise InputError(f"trials: expected at least 1, got {trials}")
    if not 0 <= successes <= trials:
        raise InputError(f"successes: expected a number from 0 to {trials}, got {successes}")
    if not 0.0 < confidence < 1.0:
        raise InputError(f"confidence: expected a number between 0 and 1, got {confidence}")
    tail = (1.0 - confidence) / 2.0
    low = 0.0 if successes == 0 else float(betaincinv(successes, trials - successes + 1, tail))
    high = 1.0 if successes == trials else float(betaincinv(successes + 1, trials - successes, 1.0 - tail))
    return low, high


def paired_difference(both: int, first: int, second: int, neither: int) -> tuple[float, tuple[float, float]]:
    """Return how much more often the second of two paired outcomes happens than the first, and its 95 % interval, from
    counts of pairs: both, the first alone, the second alone, neither. It comes from the Wilson intervals of both shares
    and their correlation (Newcombe 1998, "Improved confidence intervals for the difference between binomial proportions
    based on paired data", method 10)."""
    n = both + first + second + neither
    if n < 1 or min(both, first, second, neither) < 0:
        raise InputError(f"pairs: expected at least one, got {both}, {first}, {second} and {neither}")
    shares = (both + second) / n, (both + first) / n
    (low, high), (other_low, other_high) = (map(float, wilson(share, n)) for share in shares)
    spread = (both + first) * (second + neither) * (both + second) * (first + neither)
    covariance = float(both * neither - first * second)
    if covariance > 0.0:
        covariance = max(covariance - n / 2.0, 0.0)
    phi = covariance / math.sqrt(spread) if spread else 0.0
    (p, q), down = shares, (shares[0] - low, other_high - shares[1])
    up = high - shares[0], shares[1] - other_low
    below, above = (math.sqrt(max(0.0, a * a - 2 * phi * a * b + b * b)) for a, b in (down, up))
    return p - q, (max(-1.0, p - q - below), min(1.0, p - q + above))


def mcnemar(first: int, second: int) -> float:
    """Return how likely it is, in (0, 1], that of pairs in which one outcome alone happens, chance splits so many so
    unevenly: the exact, two-sided test of McNemar (1947, "Note on the sampling error of the difference between
    correlated proportions or percentages"): twice the smaller tail of the binomial distribution, as these pairs are
    throws of a fair coin where neither happens more often."""
    if min(first, second) < 0:
        raise InputError(f"pairs: expected numbers from 0, got {first} and {second}")
    return min(1.0, 2.0 * float(bdtr(min(first, second), first + second, 0.5))) if first + second else 1.0


def wilson(share: Any, n: Any) -> tuple[Any, Any]:
    """Return both ends of Wilson's score interval (1927) of shares of n, 95 %; numbers or arrays."""
    z = float(ndtri(0.5 + CONFIDENCE / 2.0))
    middle, half = share + z * z / (2 * n), z * np.sqrt(share * (1 - share) / n + z * z / (4 * n * n))
    return (middle - half) / (1 + z * z / n), (middle + half) / (1 + z * z / n)


@dataclass(frozen=True)
class Trials:
    """How often something happened in independent trials."""

    successes: int  # from 0 to `trials`
    trials: int  # at least 1
    spp: int  # samples per pixel of every trial
    confidence: float = CONFIDENCE  # of the interval; larger than 95 % where trials might have ended at several looks

    @property
    def rate(self) -> float:
        return self.successes / self.trials

    @property
    def interval(self) -> tuple[float, float]:
        """Interval that covers the rate in 95 % of all cases, by Clopper and Pearson."""
        return clopper_pearson(self.successes, self.trials, self.confidence)


def trial_seed(seed: int, number: int) -> int:
    """Return the seed of a trial, by its number: the same for all groups with that root."""
    return stream(seed, "verification", number)


def edge_of(beyond: Callable[[float], bool]) -> float:
    """Return where in (0, 1) a condition begins to hold, 0 or 1 where it holds everywhere or nowhere."""
    low, high = 1e-9, 1.0 - 1e-9
    if beyond(low):
        return 0.0
    if not beyond(high):
        return 1.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if beyond(middle) else (middle, high)
    return high


STAKES = np.array([1.0, 0.9, 0.75, 0.5, 0.25, 0.125, 0.0625, 0.03125])
"""Among which the capital is shared equally. Large ones decide soon where nearly all draws agree."""


@dataclass
class ConfidenceSequence:
    """Draws in [0, 1], and an interval of their mean that holds after each of them: one may stop as soon as it decides.

    Of draws x_1, x_2, ... whose mean is m, whatever was drawn before, a gambler who stakes a share c of what he has, on
    "more than m" or on "less than m", plays a fair game:

        K_t(m, c) = prod_s (1 - c + c x_s / m)       and       prod_s (1 - c + c (1 - x_s) / (1 - m))

    His capital, a mean over stakes c, exceeds 2 / a at some time with a probability of a / 2 at most (Ville 1939). So
    the m at which neither does are an interval that holds m at all times with a probability of 1 - a at least: the
    hedged capital of Waudby-Smith and Ramdas 2024, "Estimating means of bounded random variables by betting", with
    stakes that are fixed (`benchmarks/sequential.py`).

    Attributes:
        confidence: of the interval, at all times together; over 0 and under 1.
        sides: 2 of the whole interval; 1 of each end by itself, for a claim "at least so much": if it is true only
            `is_under` can be wrong, and else only `is_over`, so that each may be as often as the other says.
    """

    confidence: float = CONFIDENCE
    sides: int = 2
    _counts: Counter[float] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        if not 0.0 < self.confidence < 1.0:
            raise InputError(f"confidence: expected a number between 0 and 1, got {self.confidence}")

    def add(self, value: float) -> None:
        if not 0.0 <= value <= 1.0:
            raise InputError(f"draw: expected a number from 0 to 1, got {value}")
        self._counts[value] += 1

    @property
    def count(self) -> int:
        return self._counts.total()

    @property
    def mean(self) -> float:
        return sum(value * count for value, count in self._counts.items()) / self.count if self.count else math.nan

    def is_over(self, mean: float) -> bool:
        """Whether the true mean is shown to be over a number in (0, 1)."""
        return self._won(mean, self._counts)

    def is_under(self, mean: float) -> bool:
        """Whether the true mean is shown to be under a number in (0, 1)."""
        return self._won(1.0 - mean, {1.0 - value: count for value, count in self._counts.items()})

    @property
    def interval(self) -> tuple[float, float]:
        """Both ends of the means that are not excluded; `is_over` and `is_under` are monotone in the mean."""
        return edge_of(lambda mean: not self.is_over(mean)), edge_of(self.is_under)

    def _won(self, mean: float, counts: Mapping[float, int]) -> bool:
        return bool(capital(mean, counts) >= np.log(self.sides / (1.0 - self.confidence)))


def draws_needed(mean: float, *, confidence: float, value: float = 1.0) -> int:
    """Return how many draws, all of one value over a mean in (0, 1), show that the true one is over it, by one side of
    a `ConfidenceSequence`: no others show it sooner where the value is 1."""

    def shown(count: int) -> bool:
        return capital(mean, {value: count}) >= math.log(1.0 / (1.0 - confidence))

    high = 1
    while not shown(high):
        high *= 2
    return bisect_left(range(1, high + 1), True, key=shown) + 1


def capital(mean: float, counts: Mapping[float, int]) -> float:
    """Return the logarithm of what the bets on "more than `mean`" have made of 1, -inf where all is lost."""
    return log_capital(mean, np.array(list(counts), dtype=np.float64), np.array(list(counts.values())))


def log_capital(mean: float, values: npt.NDArray[Any], times: npt.NDArray[Any]) -> float:
    """Return the same of draws (n,) in [0, 1], so many `times` each."""
    with np.errstate(divide="ignore"):
        won = np.log(np.maximum(1.0 - STAKES + STAKES * (values / mean)[:, None], 0.0))
        total = (times[:, None] * won).sum(axis=0)
    return float(np.logaddexp.reduce(total) - np.log(len(STAKES)))


LADDER = (4, 16, 64, 256)  # sample counts to try; each quarters the variance of the one before
LOOKS = (4, 8)  # renders of a configuration at each sample count after which one looks at them
MOST_LOOKED_AT = 20  # renders of a sample count of which no more are made to look at, though there be more trials

MarginsOf = Callable[[int, Sequence[int]], Sequence[float]]  # (spp, seeds) -> margins in logits, one of each render


def margins_of(evaluate: Evaluate, kind: str, u: Tensor, *, keep: int = 0, drawn: bool = False) -> MarginsOf:
    """Return the margins of one configuration, its scores with their sign turned, under the conditions that the scene
    comes with, or under those `drawn` by the seeds; the rows of all sample counts are numbered together, and the first
    `keep` pictures of each are wanted."""
    made = Counter[int]()

    def margins(spp: int, seeds: Sequence[int]) -> list[float]:
        numbers = range(made[spp], made[spp] + len(seeds))
        asked = enumerate(zip(seeds, numbers, strict=True), made.total())
        made[spp] += len(seeds)
        queries = [Query(u, seed, kind, row, spp=spp, drawn=drawn, keep=number < keep) for row, (seed, number) in asked]
        return [-evaluation.said.score for evaluation in evaluate(queries)]

    return margins


@dataclass(frozen=True)
class Rung:
    """The margins of one configuration at one sample count: their mean, how far it may lie on the other side of the
    true one (Student's t) in 5 % of all cases, after all looks together, its drift from the rung below, NaN at the
    first, and whether more samples would leave it on its side of zero; see `choose_spp`."""

    name: str
    spp: int
    mean: float
    half_width: float
    drift: float
    settled: bool


@dataclass(frozen=True)
class SampleCount:
    """The samples a pixel to verify with; whether all margins are shown to stay on their sides (if not, it is the last
    rung of the ladder); a row for each configuration and rung that was measured, in this order; and renders spent."""

    spp: int
    converged: bool
    table: tuple[Rung, ...]
    renders: int


def choose_spp(
    margins: Mapping[str, MarginsOf], *, seed: int, ladder: Sequence[int] = LADDER, trials: int = 0
) -> SampleCount:
    """Climb a ladder of sample counts with each configuration until more of them would not change the verdict; return
    the highest rung that one of them needed.

    A verdict asks on which side of zero the margin is. A configuration has settled at a rung, with the mean margin m
    there and m' at the rung below, when on that side, with all of their uncertainty, are

    - m,
    - m + (m - m'), where the margin would be if noise took once more as much as it took from the rung below to here:
      the error that is left falls with the sample count, so it is smaller than the change that led here,
    - every single render of the rung; and, where these are fewer than the trials, m even with the deviation of one.

    A margin at zero never settles: its verdict depends on the noise. About 5 % settle on the wrong side at most: 5.1 %
    of those that are hardest to tell (`benchmarks/verdicts.py`). A rung is looked at after some of the renders, and
    again after more, and each look has its share of the 5 % (Bonferroni). A look that cannot settle anything, as far as
    the noise so far tells (`_may_settle`), is left out; where none is left that could, or one configuration has not
    settled, the last rung, which has three quarters of all samples, is taken as it is and not `converged`.

    A rung is chosen because its renders agree, so they are no trials: those have seeds of their own (`run_trials`).
    Counted among them, they would make what holds in 75 % `found` in 5.9 % of all cases in place of 2.2 %.

    Args:
        margins: the configurations, e.g. {"adversarial": ..., "clean": ...}; each renders what it is asked for. The
            first should be the one that is least likely to settle.
        seed: root seed.
        ladder: sample counts, rising, at least one, or InputError. A single one is returned unmeasured.
        trials: that will follow under the same conditions. So many renders are one more look, the last one, at which
            only the mean and every single render have to be on one side; 0 where other trials follow.
    """
    if not ladder or ladder[0] < 1 or any(b <= a for a, b in pairwise(ladder)):
        raise InputError(f"verify_spp: expected rising sample counts of at least 1, got {list(ladder)}")
    if len(ladder) == 1:
        return SampleCount(ladder[0], False, (), 0)
    table, renders, reached, looks = list[Rung](), 0, 1, looks_of(trials)
    for name, render in margins.items():
        values = _climbed(render, seed, ladder, looks, trials)
        below: list[float] = []
        for spp, here in zip(ladder, values, strict=False):
            half_width = _quantile(len(here), len(looks)) * _deviation(here) / math.sqrt(len(here))
            drift = fmean(here) - fmean(below) if below else math.nan
            settled = bool(below) and _settled(here, below, len(looks), trials)
            table.append(Rung(name, spp, fmean(here), half_width, drift, settled))
            below = here
        renders, reached = renders + sum(map(len, values)), max(reached, len(values) - 1)
        if not table[-1].settled:
            return SampleCount(ladder[-1], False, tuple(table), renders)
    return SampleCount(ladder[reached], True, tuple(table), renders)


def _climbed(
    margins: MarginsOf, seed: int, ladder: Sequence[int], looks: Sequence[int], trials: int
) -> list[list[float]]:
    """Return the margins of one configuration at each rung, up to that at which it settles or none above can."""
    values: list[list[float]] = [[] for _ in ladder]
    places = list(product(range(1, len(ladder)), looks))
    for number, (level, count) in enumerate(places):
        if not any(_may_settle(values, ladder, *later, len(looks)) for later in places[number:]):
            break
        if not _may_settle(values, ladder, level, count, len(looks)):
            continue
        for rung in (level - 1, level):
            if new := [stream(seed, "sample count", number) for number in range(len(values[rung]), count)]:
                values[rung] += margins(ladder[rung], new)
        if _settled(values[level], values[level - 1], len(looks), trials):
            break
    return [measured for measured in values if measured]


def _settled(here: Sequence[float], below: Sequence[float], looks: int, trials: int) -> bool:
    """Whether the margins of a rung and of the one below show that more samples change nothing; see `choose_spp`."""
    mean, count, one = fmean(here), min(len(here), len(below)), _deviation(here)
    ahead, ahead_error = 2.0 * mean - fmean(below), math.hypot(2.0 * one, _deviation(below)) / math.sqrt(count)
    side, quantile = math.copysign(1.0, mean), _quantile(count, looks)
    error = one / math.sqrt(count) if count == trials else one
    far = side * mean > quantile * error and side * ahead > quantile * ahead_error
    return far and all(side * value > 0.0 for value in here)


def _may_settle(values: Sequence[list[float]], ladder: Sequence[int], level: int, count: int, looks: int) -> bool:
    """Whether so many renders at a rung may show that the margin has settled there, by what has been rendered.

    The mean may be off by its standard error, and may move on by as much as it has moved before. Deviations stay; at
    rungs that were not rendered they fall with the root of the samples.
    """
    known = [rung for rung in range(level + 1) if values[rung]]
    if not known:
        return True
    if values[level] and min(values[level]) <= 0.0 <= max(values[level]):
        return False
    best, mean = values[known[-1]], fmean(values[known[-1]])
    largest = abs(mean) + abs(mean - fmean(values[known[-2]])) + _deviation(best) / math.sqrt(len(best))
    below, here = (
        _deviation(values[rung]) if values[rung] else _deviation(best) * math.sqrt(ladder[known[-1]] / ladder[rung])
        for rung in (level - 1, level)
    )
    return math.hypot(2.0 * here, below) * _quantile(count, looks) / math.sqrt(count) <= largest


def looks_of(trials: int = 0) -> tuple[int, ...]:
    """Return after how many renders of a rung one looks, see `choose_spp`."""
    return (*LOOKS, trials) if LOOKS[-1] < trials <= MOST_LOOKED_AT else LOOKS


def most_samples(configurations: int, ladder: Sequence[int] = LADDER, trials: int = 0) -> int:
    """Return the samples a pixel that `choose_spp` renders in all, at most: where only the last rung settles it."""
    return configurations * looks_of(trials)[-1] * sum(ladder) if len(ladder) > 1 else 0


def _deviation(values: Sequence[float]) -> float:
    mean = fmean(values)
    return math.sqrt(math.fsum((v - mean) ** 2 for v in values) / (len(values) - 1))


def _quantile(count: int, looks: int) -> float:
    """Of Student's t, for one end of the interval of a mean of so many values at one of the looks."""
    return float(stdtrit(count - 1, 1.0 - (1.0 - CONFIDENCE) / looks))


# ---------------------------------------------------------------------------------------------------------------------
# How many samples a pixel trials over many conditions need: of a rate (docs/design.md).

CONDITIONS = 30  # conditions under which each configuration is rendered at each sample count
MOVED = 0.05  # share of the conditions that more samples may carry over zero
OVER_LADDER = LADDER[:3]  # sample counts to try
MOST_TIMES = 2  # samples of a check over those of the searches, at most, beyond the second rung

Floats = npt.NDArray[np.float64]


def affordable(ladder: Sequence[int], pictures: int, searched: int) -> Sequence[int]:
    """Return the rungs at which so many pictures take at most `MOST_TIMES` the samples of the searches, and the first
    two in any case."""
    return [spp for place, spp in enumerate(ladder) if place < 2 or pictures * spp <= MOST_TIMES * searched]


def choose_rate_spp(margins: Mapping[str, MarginsOf], *, seed: int, ladder: Sequence[int] = OVER_LADDER) -> SampleCount:
    """Climb a ladder of sample counts until more of them would leave the share of conditions with a margin below
    zero where it is, of each configuration; return the highest rung that one of them needed.

    Each is rendered under the same `CONDITIONS` at a rung and at the one below. It has settled where the mean change of
    the margin, taken once more and at either end of its 95 % interval (Student's t), would carry at most `MOVED` of the
    conditions over zero (`moved`). The error that is left falls with the sample count, so it is smaller than the change
    that led here (`benchmarks/verdicts.py` has how far the rate is off then). No render of it is a trial. Arguments are
    as of `choose_spp`; conditions are drawn by the seeds.
    """
    if len(ladder) == 1:
        return SampleCount(ladder[0], False, (), 0)
    table, reached = list[Rung](), 1
    seeds = [stream(seed, "sample count", number) for number in range(CONDITIONS)]
    for name, render in margins.items():
        below: Floats | None = None
        for place, spp in enumerate(ladder):
            here = np.array(render(spp, seeds), dtype=np.float64)
            half = stdtrit(len(here) - 1, CONFIDENCE) * here.std(ddof=1) / math.sqrt(len(here))
            drift = math.nan if below is None else float(here.mean() - below.mean())
            settled = below is not None and moved(here, below) <= MOVED
            table.append(Rung(name, spp, float(here.mean()), float(half), drift, settled))
            if settled:
                reached = max(reached, place)
                break
            below = here
        else:
            return SampleCount(ladder[-1], False, tuple(table), CONDITIONS * len(table))
    return SampleCount(ladder[reached], True, tuple(table), CONDITIONS * len(table))


def moved(here: Floats, below: Floats) -> float:
    """Return the share of conditions that the mean change of the margins (n,) from one rung to the next, taken once
    more, would carry over zero at most; NaN where a margin is no number. The margins are smoothed by normal kernels of
    Silverman's width."""
    change, width = here - below, 0.9 * here.std(ddof=1) * len(here) ** -0.2
    if not np.isfinite(change).all():
        return math.nan
    half = stdtrit(len(here) - 1, 0.5 + CONFIDENCE / 2.0) * change.std(ddof=1) / math.sqrt(len(here))
    ends = np.array([0.0, change.mean() - half, change.mean() + half])[:, None]
    shares = ndtr((here + ends) / max(width, 1e-12)).mean(axis=1)
    return float(np.abs(shares[1:] - shares[0]).max())


# ---------------------------------------------------------------------------------------------------------------------
# Shares of predictions that are not independent: frames of a drive, and what several models say of a picture, share
# one draw. What was drawn, the *unit*, is independent of others, so that intervals and tests are over units.
#
# All units weigh the same, however many predictions each has: the share is the mean over units of the share of each,
# mean_u k_u / o_u of units with o_u predictions of which k_u count. (Pooled, sum k_u / sum o_u, a drive would weigh as
# much as it has frames in view. That share has no interval without a bound on o_u, and the largest o_u that was seen is
# none.) So each unit is one draw in [0, 1], and with m for the true mean, who stakes a share c of what he has, at each
# unit, on "more than m" wins nothing on average:
#
#     K(m, c) = prod_u (1 - c + c k_u / (o_u m))
#
# So K exceeds 2 / a with a probability of a / 2 at most (Markov), whatever units are like and however few there are,
# also where each has a share of its own (the product's mean is at most 1, by the inequality of the means). These are
# the bets of `ConfidenceSequence`, whose stakes they take. Where each unit has one prediction, the exact tests
# of independent ones are taken, which are sharper: Clopper and Pearson, Newcombe, McNemar.

Numbers = npt.NDArray[np.float64]
Units = npt.NDArray[np.int64]


def per_unit(values: npt.ArrayLike, units: Units) -> Numbers:
    """Return the sums (m,) of values (n,) over each of the units that the rows (n,) belong to, in their order."""
    _, places = np.unique(units, return_inverse=True)
    return np.bincount(places.reshape(-1), np.asarray(values, dtype=np.float64)).astype(np.float64)


def mean_share(counted: npt.ArrayLike, of: npt.ArrayLike) -> float:
    """Return the mean over units of the share of each: `counted` (n,) of the predictions `of` (n,) of a unit; units
    without predictions are left out. NaN without any."""
    k, o = np.asarray(counted, dtype=np.float64), np.asarray(of, dtype=np.float64)
    k, o = k[o > 0.0], o[o > 0.0]
    if not len(o):
        return math.nan
    if o.min() == o.max():
        return float(k.sum() / o.sum())
    return float((k / o).mean())


def share_interval(counted: npt.ArrayLike, of: npt.ArrayLike, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Return the interval of the mean over units of the share of each (`mean_share`), whatever the number of units.
    Each has predictions, (n,) from 0, and one of them some; `counted` are (n,) from 0 to `of`; the confidence is
    between 0 and 1."""
    k, o = np.asarray(counted, dtype=np.float64), np.asarray(of, dtype=np.float64)
    if k.shape != o.shape or not o.size or o.max() <= 0 or (k < 0).any() or (k > o).any():
        raise InputError("share: expected counts from 0 to the predictions of each unit, and one prediction at least")
    if o.max() == 1.0:
        return clopper_pearson(round(k.sum()), round(o.sum()), confidence)
    return _by_bets(k[o > 0.0] / o[o > 0.0], confidence)


def _by_bets(shares: Numbers, confidence: float) -> tuple[float, float]:
    """Return the interval of the mean of independent draws (n,) in [0, 1]."""
    values, times = np.unique(shares, return_counts=True)
    least = np.log(2.0 / (1.0 - confidence))
    low = edge_of(lambda mean: log_capital(mean, values, times) < least)
    return low, edge_of(lambda mean: log_capital(1.0 - mean, 1.0 - values, times) >= least)


def mean_interval(values: npt.ArrayLike, low: float, high: float) -> tuple[float, float]:
    """Return the 95 % interval of the mean of independent numbers (n,) in a range that is known beforehand: from the
    plan, never from the numbers."""
    numbers = np.asarray(values, dtype=np.float64)
    if high <= low:
        return low, low
    first, last = _by_bets(np.clip((numbers - low) / (high - low), 0.0, 1.0), CONFIDENCE)
    return low + (high - low) * first, low + (high - low) * last


def most_shown(units: int) -> float:
    """Return the lower end of a share's 95 % interval where so many units are right throughout: the most to show."""
    return _by_bets(np.ones(units), CONFIDENCE)[0]


def paired_by_unit(first: Any, second: Any, units: Units) -> tuple[float, tuple[float, float], float]:
    """Return how much more often the second of two outcomes (n,) happens than the first, the 95 % interval of that, and
    how likely it is that chance parts them as far where neither happens more often, in (0, 1]; rows (n,) of one unit
    are not independent, and all units weigh the same (`mean_share`). The interval is without 0 where that is at most
    0.05."""
    first, second = np.asarray(first, dtype=bool), np.asarray(second, dtype=bool)
    if len(np.unique(units)) == len(units):
        both, lost, won = (first & second).sum(), (first & ~second).sum(), (~first & second).sum()
        counts = int(both), int(lost), int(won), len(first) - int(both + lost + won)
        return *paired_difference(*counts), mcnemar(counts[1], counts[2])
    of = per_unit(np.ones(len(first)), units)
    ahead = per_unit((1.0 + second - 1.0 * first) / 2.0, units)
    low, high = _by_bets(ahead / of, CONFIDENCE)
    once = np.ones(len(of))
    most_won = max(log_capital(0.5, ahead / of, once), log_capital(0.5, 1.0 - ahead / of, once))
    difference = mean_share(per_unit(second, units), of) - mean_share(per_unit(first, units), of)
    return difference, (2 * low - 1, 2 * high - 1), float(min(1.0, 2.0 * np.exp(-most_won)))


SHARES = np.linspace(0.0, 1.0, 402)[1:-1]  # of right predictions on both sides, at which two shares are compared
EXCHANGES = 9_999  # how often units are dealt out anew, so that no probability is under 0.0001


def fewer_by_chance(
    inside: npt.ArrayLike, of: npt.ArrayLike, beside: npt.ArrayLike, rest: npt.ArrayLike, times: float = 1.0
) -> float:
    """Return how likely it is, in (0, 1], that so few predictions or fewer are right on one side of a rule, if as many
    are right on the other.

    Where each unit has one prediction that is Fisher's exact test, one-sided. Where all units have as many and lie on
    one side each, units are dealt out to the sides anew. Elsewhere, where the rule cuts through units or some have more
    predictions than others, it is one over the least that bets on "fewer here than m, more there" have made of 1, of
    all m: a bound, also where sides of a unit are alike. All units of a side weigh the same (`mean_share`).

    Args:
        inside, of: (n,) of each unit, right predictions and predictions under the rule.
        beside, rest: (n,) those elsewhere.
        times: how many times there are each of these units.
    """
    k, a, r, b = (np.asarray(counts, dtype=np.float64) for counts in (inside, of, beside, rest))
    if not a.any() or not b.any():
        return 1.0
    if (a + b).max() == 1.0:
        from scipy.stats import hypergeom  # takes half a second, and a search needs none of it

        here, there, right, others = (round(times * float(counts.sum())) for counts in (k, a, r, b))

        return float(hypergeom.cdf(here, there + others, here + right, there))
    is_cut = bool(((a > 0.0) & (b > 0.0)).any())
    if not is_cut and len(np.unique(a + b)) == 1:
        values, copies = np.unique(k + r, return_counts=True)
        copies, dealt = np.round(times * copies).astype(np.int64), round(times * float((a > 0).sum()))
        rng = np.random.default_rng(0)
        drawn = rng.multivariate_hypergeometric(copies, min(dealt, int(copies.sum())), EXCHANGES, method="marginals")
        return float((1 + (drawn @ values <= times * k.sum() + 1e-9).sum()) / (1 + EXCHANGES))
    # What a unit wins or loses on each side; half is staked on each where a unit can have both.
    wrong_here = np.divide(a - k, a, out=np.zeros_like(a), where=a > 0.0)
    right_there = np.divide(r, b, out=np.zeros_like(b), where=b > 0.0)
    rows, copies = np.unique(np.stack([wrong_here, a > 0.0, right_there, b > 0.0], axis=1), axis=0, return_counts=True)
    wrong, is_here, right, is_there = (column[:, None] for column in rows.T)
    bets = (0.5 if is_cut else 1.0) * (wrong / (1.0 - SHARES) - is_here + right / SHARES - is_there)
    with np.errstate(divide="ignore"):
        won = [times * (copies[:, None] * np.log(np.maximum(1.0 + stake * bets, 0.0))).sum(axis=0) for stake in STAKES]
    least = (np.logaddexp.reduce(won, axis=0) - np.log(len(STAKES))).min()
    return float(min(1.0, np.exp(-least)))
