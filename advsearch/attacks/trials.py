"""Counting successes, saying how sure the count is, and how many samples a pixel trials
need (docs/design.md).

Monte Carlo noise takes part of the margin away, and less of it the more samples there
are. So the margin *drifts* with the sample count, and a verification in the middle of
that drift credits the scene with what the noise did.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from statistics import fmean

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr, stdtrit
from torch import Tensor

from advsearch.attacks.evaluation import Evaluate, Query
from advsearch.errors import InputError
from advsearch.seeds import stream
from advsearch.statistics.intervals import CONFIDENCE, clopper_pearson


@dataclass(frozen=True)
class Trials:
    """How often something happened in independent trials."""

    successes: int  # from 0 to `trials`
    trials: int  # at least 1
    spp: int  # samples per pixel of every trial
    # of the interval; larger than 95 % where trials might have ended at several looks
    confidence: float = CONFIDENCE

    @property
    def rate(self) -> float:
        return self.successes / self.trials

    @property
    def interval(self) -> tuple[float, float]:
        """Interval that covers the rate in 95 % of all cases, by Clopper and
        Pearson.
        """
        return clopper_pearson(self.successes, self.trials, self.confidence)


def derive_trial_seed(seed: int, number: int) -> int:
    """Return the seed of a trial, by its number: the same for all groups with that
    root.
    """
    return stream(seed, "verification", number)


# sample counts to try; each quarters the variance of the one before
LADDER = (4, 16, 64, 256)
# renders of a configuration at each sample count after which one looks at them
LOOK_SIZES = (4, 8)
# renders of a sample count of which no more are made to look at, though there be more
# trials
MAX_LOOK_SIZE = 20

# (spp, seeds) -> margins in logits, one of each render
MarginsOf = Callable[[int, Sequence[int]], Sequence[float]]


def make_margin_function(
    evaluate: Evaluate,
    kind: str,
    u: Tensor,
    *,
    n_images: int = 0,
    draws_conditions: bool = False,
) -> MarginsOf:
    """Return the margins of one configuration, its scores with their sign turned, under
    the conditions that the scene comes with, or under those `draws_conditions` by the
    seeds; the rows of all sample counts are numbered together, and the first `n_images`
    pictures of each are wanted.
    """
    n_rendered = Counter[int]()

    def margins(spp: int, seeds: Sequence[int]) -> list[float]:
        numbers = range(n_rendered[spp], n_rendered[spp] + len(seeds))
        rows = enumerate(zip(seeds, numbers, strict=True), n_rendered.total())
        n_rendered[spp] += len(seeds)
        queries = [
            Query(
                u,
                seed,
                kind,
                row,
                spp=spp,
                draws_conditions=draws_conditions,
                with_image=number < n_images,
            )
            for row, (seed, number) in rows
        ]
        return [
            -evaluation.required_judgement.score for evaluation in evaluate(queries)
        ]

    return margins


@dataclass(frozen=True)
class Rung:
    """The margins of one configuration at one sample count: their mean, how far it may
    lie on the other side of the true one (Student's t) in 5 % of all cases, after all
    looks together, its drift from the rung below, NaN at the first, and whether more
    samples would leave it on its side of zero; see `choose_spp`.
    """

    name: str
    spp: int
    mean: float
    half_width: float
    drift: float
    is_settled: bool


@dataclass(frozen=True)
class SampleCount:
    """The samples a pixel to verify with; whether all margins are shown to stay on
    their sides (if not, it is the last rung of the ladder); a row for each
    configuration and rung that was measured, in this order; and renders spent.
    """

    spp: int
    converged: bool
    table: tuple[Rung, ...]
    renders: int


def choose_spp(
    margins: Mapping[str, MarginsOf],
    *,
    seed: int,
    ladder: Sequence[int] = LADDER,
    trials: int = 0,
) -> SampleCount:
    """Climb a ladder of sample counts with each configuration until more of them would
    not change the verdict; return the highest rung that one of them needed.

    A verdict asks on which side of zero the margin is. A configuration has settled at a
    rung, with the mean margin m there and m' at the rung below, when on that side, with
    all of their uncertainty, are

    - m,
    - m + (m - m'), where the margin would be if noise took once more as much as it took
      from the rung below to here: the error that is left falls with the sample count,
      so it is smaller than the change that led here,
    - every single render of the rung; and, where these are fewer than the trials, m
    even with the deviation of one.

    A margin at zero never settles: its verdict depends on the noise. About 5 % settle
    on the wrong side at most: 5.1 % of those that are hardest to tell
    (`benchmarks/verdicts.py`). A rung is looked at after some of the renders, and again
    after more, and each look has its share of the 5 % (Bonferroni). A look that cannot
    settle anything, as far as the noise so far tells (`_may_settle`), is left out;
    where none is left that could, or one configuration has not settled, the last rung,
    which has three quarters of all samples, is taken as it is and not `converged`.

    A rung is chosen because its renders agree, so they are no trials: those have seeds
    of their own (`run_trials`). Counted among them, they would make what holds in 75 %
    `found` in 5.9 % of all cases in place of 2.2 %.

    Args:
        margins: the configurations, e.g. {"adversarial": ..., "clean": ...}; each
            renders what it is asked for. The first should be the one that is least
            likely to settle.
        seed: root seed.
        ladder: sample counts, rising, at least one, or InputError. A single one is
            returned unmeasured.
        trials: that will follow under the same conditions. So many renders are one more
            look, the last one, at which only the mean and every single render have to
            be on one side; 0 where other trials follow.
    """
    if not ladder or ladder[0] < 1 or any(b <= a for a, b in pairwise(ladder)):
        raise InputError(
            "verify_spp: expected rising sample counts of at least 1, "
            f"got {list(ladder)}"
        )
    if len(ladder) == 1:
        return SampleCount(ladder[0], False, (), 0)
    table = list[Rung]()
    renders = 0
    reached = 1
    looks = list_look_sizes(trials)
    for name, render in margins.items():
        margins_of_rungs = _climb_ladder(render, seed, ladder, looks, trials)
        below: list[float] = []
        for spp, at_rung in zip(ladder, margins_of_rungs, strict=False):
            table.append(_summarize_rung(name, spp, at_rung, below, len(looks), trials))
            below = at_rung
        renders = renders + sum(map(len, margins_of_rungs))
        reached = max(reached, len(margins_of_rungs) - 1)
        if not table[-1].is_settled:
            return SampleCount(ladder[-1], False, tuple(table), renders)
    return SampleCount(ladder[reached], True, tuple(table), renders)


def _summarize_rung(
    name: str,
    spp: int,
    at_rung: Sequence[float],
    below: Sequence[float],
    looks: int,
    trials: int,
) -> Rung:
    """Return the row of a configuration at one sample count.

    Args:
        name: of the configuration.
        spp: samples per pixel.
        at_rung: margins of the rung.
        below: margins of the rung below; empty at the first.
        looks: how often one looks.
        trials: that will follow; 0 where other trials follow.
    """
    mean = fmean(at_rung)
    half_width = (
        _compute_quantile(len(at_rung), looks)
        * _compute_deviation(at_rung)
        / math.sqrt(len(at_rung))
    )
    if not below:
        return Rung(name, spp, mean, half_width, math.nan, False)
    is_settled = _is_settled(at_rung, below, looks, trials)
    return Rung(name, spp, mean, half_width, mean - fmean(below), is_settled)


def _climb_ladder(
    margins: MarginsOf,
    seed: int,
    ladder: Sequence[int],
    looks: Sequence[int],
    trials: int,
) -> list[list[float]]:
    """Return the margins of one configuration at each rung, up to that at which it
    settles or none above can.
    """
    values: list[list[float]] = [[] for _ in ladder]
    looks_at_rungs = list(product(range(1, len(ladder)), looks))
    for number, (level, count) in enumerate(looks_at_rungs):
        if not any(
            _may_settle(values, ladder, *later, len(looks))
            for later in looks_at_rungs[number:]
        ):
            break
        if not _may_settle(values, ladder, level, count, len(looks)):
            continue
        for rung in (level - 1, level):
            if new := [
                stream(seed, "sample count", number)
                for number in range(len(values[rung]), count)
            ]:
                values[rung] += margins(ladder[rung], new)
        if _is_settled(values[level], values[level - 1], len(looks), trials):
            break
    return [measured for measured in values if measured]


def _is_settled(
    at_rung: Sequence[float], below: Sequence[float], looks: int, trials: int
) -> bool:
    """Return whether more samples would not change the sign of the margin.

    See `choose_spp` for the three conditions.

    Args:
        at_rung: margins of a rung.
        below: margins of the rung below.
        looks: how often one looks, which share the 5 %.
        trials: that will follow; 0 where other trials follow.
    """
    mean = fmean(at_rung)
    count = min(len(at_rung), len(below))
    deviation = _compute_deviation(at_rung)
    # the mean if the rest of the noise changed it as much as the step from below did
    extrapolated = 2.0 * mean - fmean(below)
    extrapolated_error = math.hypot(
        2.0 * deviation, _compute_deviation(below)
    ) / math.sqrt(count)
    sign = math.copysign(1.0, mean)
    quantile = _compute_quantile(count, looks)
    error = deviation / math.sqrt(count) if count == trials else deviation
    is_mean_sure = sign * mean > quantile * error
    is_extrapolated_sure = sign * extrapolated > quantile * extrapolated_error
    is_sign_constant = all(sign * value > 0.0 for value in at_rung)
    return is_mean_sure and is_extrapolated_sure and is_sign_constant


def _may_settle(
    values: Sequence[list[float]],
    ladder: Sequence[int],
    level: int,
    count: int,
    looks: int,
) -> bool:
    """Return whether `count` renders at a rung may show that the margin has settled.

    The mean may be off by its standard error, and may move on by as much as it has
    moved before. Deviations stay; at rungs that were not rendered they fall with the
    root of the samples.
    """
    rendered_rungs = [rung for rung in range(level + 1) if values[rung]]
    if not rendered_rungs:
        return True
    if values[level] and min(values[level]) <= 0.0 <= max(values[level]):
        return False
    last_rung = rendered_rungs[-1]
    last_values = values[last_rung]
    mean = fmean(last_values)
    drift = abs(mean - fmean(values[rendered_rungs[-2]]))
    standard_error = _compute_deviation(last_values) / math.sqrt(len(last_values))
    max_mean = abs(mean) + drift + standard_error

    def estimate_deviation(rung: int) -> float:
        if values[rung]:
            return _compute_deviation(values[rung])
        return _compute_deviation(last_values) * math.sqrt(
            ladder[last_rung] / ladder[rung]
        )

    error = math.hypot(2.0 * estimate_deviation(level), estimate_deviation(level - 1))
    return error * _compute_quantile(count, looks) / math.sqrt(count) <= max_mean


def list_look_sizes(trials: int = 0) -> tuple[int, ...]:
    """Return after how many renders of a rung one looks, see `choose_spp`."""
    return (
        (*LOOK_SIZES, trials)
        if LOOK_SIZES[-1] < trials <= MAX_LOOK_SIZE
        else LOOK_SIZES
    )


def count_max_samples(
    configurations: int, ladder: Sequence[int] = LADDER, trials: int = 0
) -> int:
    """Return the samples a pixel that `choose_spp` renders in all, at most: where only
    the last rung settles it.
    """
    return (
        configurations * list_look_sizes(trials)[-1] * sum(ladder)
        if len(ladder) > 1
        else 0
    )


def _compute_deviation(values: Sequence[float]) -> float:
    """Return the standard deviation of a sample."""
    mean = fmean(values)
    squares = math.fsum((value - mean) ** 2 for value in values)
    return math.sqrt(squares / (len(values) - 1))


def _compute_quantile(count: int, looks: int) -> float:
    """Of Student's t, for one end of the interval of a mean of so many values at one of
    the looks.
    """
    return float(stdtrit(count - 1, 1.0 - (1.0 - CONFIDENCE) / looks))


# ---- sample counts of trials over many conditions
# How many samples per pixel the rate of such trials needs (docs/design.md).

# conditions under which each configuration is rendered at each sample count
N_CONDITIONS = 30
MAX_MOVED_FRACTION = (
    0.05  # share of the conditions that more samples may carry over zero
)
OVER_LADDER = LADDER[:3]  # sample counts to try
# samples of a check over those of the searches, at most, beyond the second rung
MAX_SAMPLE_RATIO = 2

FloatArray = npt.NDArray[np.float64]


def limit_ladder(
    ladder: Sequence[int], n_images: int, search_samples: int
) -> Sequence[int]:
    """Return the sample counts of a ladder that a check can afford.

    Its images take at most `MAX_SAMPLE_RATIO` the samples of the searches; the first
    two counts are returned in any case.
    """
    return [
        spp
        for index, spp in enumerate(ladder)
        if index < 2 or n_images * spp <= MAX_SAMPLE_RATIO * search_samples
    ]


def choose_rate_spp(
    margins: Mapping[str, MarginsOf], *, seed: int, ladder: Sequence[int] = OVER_LADDER
) -> SampleCount:
    """Climb a ladder of sample counts until more of them would leave the share of
    conditions with a margin below zero where it is, of each configuration; return the
    highest rung that one of them needed.

    Each is rendered under the same `N_CONDITIONS` at a rung and at the one below. It
    has settled where the mean change of the margin, taken once more and at either end
    of its 95 % interval (Student's t), would carry at most `MAX_MOVED_FRACTION` of the
    conditions over zero (`estimate_moved_fraction`). The error that is left falls with
    the sample count, so it is smaller than the change that led here
    (`benchmarks/verdicts.py` has how far the rate is off then). No render of it is a
    trial. Arguments are as of `choose_spp`; conditions are sampled by the seeds.
    """
    if len(ladder) == 1:
        return SampleCount(ladder[0], False, (), 0)
    table = list[Rung]()
    reached = 1
    seeds = [stream(seed, "sample count", number) for number in range(N_CONDITIONS)]
    for name, render in margins.items():
        margins_below: FloatArray | None = None
        for index, spp in enumerate(ladder):
            margins_at_rung = np.array(render(spp, seeds), dtype=np.float64)
            half_width = (
                stdtrit(len(margins_at_rung) - 1, CONFIDENCE)
                * margins_at_rung.std(ddof=1)
                / math.sqrt(len(margins_at_rung))
            )
            drift = (
                math.nan
                if margins_below is None
                else float(margins_at_rung.mean() - margins_below.mean())
            )
            settled = (
                margins_below is not None
                and estimate_moved_fraction(margins_at_rung, margins_below)
                <= MAX_MOVED_FRACTION
            )
            table.append(
                Rung(
                    name,
                    spp,
                    float(margins_at_rung.mean()),
                    float(half_width),
                    drift,
                    settled,
                )
            )
            if settled:
                reached = max(reached, index)
                break
            margins_below = margins_at_rung
        else:
            return SampleCount(
                ladder[-1], False, tuple(table), N_CONDITIONS * len(table)
            )
    return SampleCount(ladder[reached], True, tuple(table), N_CONDITIONS * len(table))


def estimate_moved_fraction(at_rung: FloatArray, below: FloatArray) -> float:
    """Return the fraction of conditions that more samples may carry over zero.

    The mean change of the margins (n,) from one rung to the next is taken once more.
    The margins are smoothed by normal kernels of Silverman's width. NaN where a margin
    is no number.
    """
    change = at_rung - below
    width = 0.9 * at_rung.std(ddof=1) * len(at_rung) ** -0.2
    if not np.isfinite(change).all():
        return math.nan
    quantile = stdtrit(len(at_rung) - 1, 0.5 + CONFIDENCE / 2.0)
    half_width = quantile * change.std(ddof=1) / math.sqrt(len(at_rung))
    mean_change = change.mean()
    shifts = np.array([0.0, mean_change - half_width, mean_change + half_width])
    fractions = ndtr((at_rung + shifts[:, None]) / max(width, 1e-12)).mean(axis=1)
    return float(np.abs(fractions[1:] - fractions[0]).max())
