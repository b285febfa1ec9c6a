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

    successes: int  # successes from 0 to `trials`
    trials: int  # trials at least 1
    spp: int  # samples per pixel of every trial
    # Confidence of the interval; larger than 95 % where trials might have ended at
    # several looks.
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
    """Return the seed of a trial by its number. Groups of trials with the same root
    seed have the same seeds.
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
    """Return a function that renders a configuration and returns its margins.

    The function takes samples per pixel and seeds, and returns one margin per seed. A
    margin is the negative of the task's score, so it is over 0 if the model is right.

    Args:
        evaluate: renders queries and yields their evaluations.
        kind: kind of the queries, which are numbered across all sample counts.
        u: (d,) the configuration.
        n_images: number of renders at each sample count, the first ones, whose images
            are requested.
        draws_conditions: whether each seed also samples conditions (e.g. the weather);
            otherwise the scene's own conditions hold.
    """
    n_rendered = Counter[int]()

    def margins(spp: int, seeds: Sequence[int]) -> list[float]:
        """Return the margin of one render for each seed.

        Calls are counted in `n_rendered`: a later call with the same `spp` continues
        the numbering, so that only the first `n_images` renders request an image.
        """
        first_render = n_rendered[spp]  # at this sample count
        first_query = n_rendered.total()  # at all sample counts
        n_rendered[spp] += len(seeds)
        queries = [
            Query(
                u,
                seed,
                kind,
                index=first_query + offset,
                spp=spp,
                draws_conditions=draws_conditions,
                with_image=first_render + offset < n_images,
            )
            for offset, seed in enumerate(seeds)
        ]
        return [
            -evaluation.required_judgement.score for evaluation in evaluate(queries)
        ]

    return margins


@dataclass(frozen=True)
class Rung:
    """The margins of one configuration at one sample count.

    Attributes:
        name: name of the configuration.
        spp: samples per pixel.
        mean: mean of the margins.
        half_width: half width of the one-sided 95 % interval of the mean (Student's t),
            all looks together.
        drift: difference of the mean from that of the rung below; NaN at the first.
        is_settled: whether more samples would not change the sign of the mean; see
            `choose_spp`.
    """

    name: str
    spp: int
    mean: float
    half_width: float
    drift: float
    is_settled: bool


@dataclass(frozen=True)
class SampleCount:
    """The number of samples per pixel to verify with.

    Attributes:
        spp: samples per pixel.
        converged: whether all margins have settled; if not, `spp` is the last rung of
            the ladder.
        table: a row for each configuration and rung that was measured, in this order.
        renders: renders that the measurement took.
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
    """Choose a sample count at which more samples would not change the verdict.

    Each configuration is rendered at rising sample counts, the rungs of a ladder, until
    it has settled. The highest rung that one of them needed is returned.

    The verdict depends on the sign of the margin. Let m be the mean margin at a rung
    and m' the one at the rung below. The configuration has settled if all of these have
    the same sign, with 95 % confidence:

    - m,
    - m + (m - m'), the margin if more samples changed it as much again as the step from
      the rung below did. The remaining error falls with the sample count, so it is
      smaller than that,
    - every single render at the rung. Unless these are as many as the trials to come,
      m must even exceed the uncertainty of a single render.

    A margin at zero never settles: its verdict depends on the noise. About 5 % settle
    with the wrong sign at most: 5.1 % of the hardest cases (`benchmarks/verdicts.py`).
    A rung is checked after some renders and again after more; the 5 % are divided
    equally among these looks (Bonferroni). A look that cannot settle anything, judging
    by the noise so far (`_may_settle`), is skipped. If one configuration does not
    settle, the last rung is returned, with `converged` False.

    These renders must not be used as trials, because a rung is chosen where they
    agree: trials have other seeds (`run_trials`). If they were, a claim that holds in
    75 % of renders would be `found` in 5.9 % of all cases and not in 2.2 %.

    Args:
        margins: for each configuration, e.g. "adversarial" and "clean", a function
            that renders it (`make_margin_function`). The first should be the one that
            is least likely to settle, as the others are then not rendered.
        seed: root seed.
        ladder: sample counts, rising, at least one, or InputError. A single one is
            returned unmeasured.
        trials: number of trials that will follow under the same conditions; 0 if the
            trials are of another kind. There is one more look after so many renders,
            the last one, which takes the standard error of m, not the deviation of a
            single render.
    """
    if not ladder or ladder[0] < 1 or any(b <= a for a, b in pairwise(ladder)):
        raise InputError(
            "verify_spp: expected rising sample counts of at least 1, "
            f"got {list(ladder)}"
        )
    if len(ladder) == 1:
        return SampleCount(ladder[0], False, (), 0)
    table = list[Rung]()
    n_renders = 0
    highest_rung = 1  # index; nothing settles at the first rung, which has none below
    look_sizes = list_look_sizes(trials)
    for name, render in margins.items():
        margins_of_rungs = _climb_ladder(render, seed, ladder, look_sizes, trials)
        below: list[float] = []  # margins of the rung before
        # only the rungs that were rendered, from the first on
        for spp, at_rung in zip(ladder, margins_of_rungs, strict=False):
            table.append(
                _summarize_rung(name, spp, at_rung, below, len(look_sizes), trials)
            )
            below = at_rung
        n_renders += sum(map(len, margins_of_rungs))
        highest_rung = max(highest_rung, len(margins_of_rungs) - 1)
        if not table[-1].is_settled:
            return SampleCount(ladder[-1], False, tuple(table), n_renders)
    return SampleCount(ladder[highest_rung], True, tuple(table), n_renders)


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
        name: name of the configuration.
        spp: samples per pixel.
        at_rung: margins of the rung.
        below: margins of the rung below; empty at the first.
        looks: number of looks at a rung.
        trials: trials that will follow; 0 if other trials follow.
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
    look_sizes: Sequence[int],
    trials: int,
) -> list[list[float]]:
    """Return the margins of one configuration at each rung that was rendered.

    It ends at the rung at which the configuration settles, or when no later look can
    settle it. A look renders what is still missing at its rung and at the rung below,
    with the same seeds at both.

    Args:
        margins: renders the configuration; (spp, seeds) to margins.
        seed: root seed.
        ladder: samples per pixel of the rungs, ascending.
        look_sizes: renders of a rung after which one looks, ascending.
        trials: trials that will follow; 0 if other trials follow.
    """
    margins_of_rungs: list[list[float]] = [[] for _ in ladder]
    n_looks = len(look_sizes)
    # (index of the rung, renders there), in the order in which one looks
    all_looks = list(product(range(1, len(ladder)), look_sizes))
    for look_index, (level, count) in enumerate(all_looks):
        # at this look, or at a later one
        may_settle_yet = any(
            _may_settle(margins_of_rungs, ladder, *level_and_count, n_looks)
            for level_and_count in all_looks[look_index:]
        )
        if not may_settle_yet:
            break
        if not _may_settle(margins_of_rungs, ladder, level, count, n_looks):
            continue
        for rung in (level - 1, level):
            seeds = [stream(seed, "sample count", number) for number in range(count)]
            new_seeds = seeds[len(margins_of_rungs[rung]) :]
            if new_seeds:
                margins_of_rungs[rung] += margins(ladder[rung], new_seeds)
        if _is_settled(
            margins_of_rungs[level], margins_of_rungs[level - 1], n_looks, trials
        ):
            break
    return [rendered for rendered in margins_of_rungs if rendered]


def _is_settled(
    at_rung: Sequence[float], below: Sequence[float], looks: int, trials: int
) -> bool:
    """Return whether more samples would not change the sign of the margin.

    The mean, the mean extrapolated to more samples, and every single render have to be
    on the same side of zero (`choose_spp`).

    Args:
        at_rung: margins of a rung.
        below: margins of the rung below.
        looks: number of looks, which share the 5 %.
        trials: trials that will follow; 0 if other trials follow.
    """
    mean = fmean(at_rung)
    # An earlier look may have rendered more at the rung below.
    count = min(len(at_rung), len(below))
    deviation = _compute_deviation(at_rung)
    # m + (m - m'), with the mean m at the rung and m' below: the mean if the rest of the
    # noise changed it as much as the step from below did
    extrapolated = 2.0 * mean - fmean(below)
    # standard error of 2 m - m'
    extrapolated_error = math.hypot(
        2.0 * deviation, _compute_deviation(below)
    ) / math.sqrt(count)
    # The trials that follow are judged by the mean of as many renders as these: its
    # standard error counts. Otherwise each single one has to be on the same side.
    has_renders_of_trials = count == trials
    error = deviation / math.sqrt(count) if has_renders_of_trials else deviation
    sign = math.copysign(1.0, mean)
    quantile = _compute_quantile(count, looks)
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

    This is an optimistic forecast from the renders so far: the mean may be farther from
    zero by its standard error, and by as much again as it changed over the last rung.
    Standard deviations are assumed to stay as they are, and at rungs that were not
    rendered to fall with the square root of the samples. If margins at the rung have
    both signs, it cannot settle.

    Args:
        values: margins of each rung; an empty list if it was not rendered.
        ladder: samples per pixel of the rungs.
        level: index of the rung in `ladder`.
        count: number of renders at the rung that the look would use.
        looks: number of looks, which share the 5 %.
    """
    rendered_rungs = [rung for rung in range(level + 1) if values[rung]]
    if not rendered_rungs:
        return True  # nothing is known yet
    if values[level] and min(values[level]) <= 0.0 <= max(values[level]):
        return False
    last_rung = rendered_rungs[-1]
    last_values = values[last_rung]
    mean = fmean(last_values)
    # the first look renders two rungs, so that there is one before the last
    drift = abs(mean - fmean(values[rendered_rungs[-2]]))
    standard_error = _compute_deviation(last_values) / math.sqrt(len(last_values))
    max_mean = abs(mean) + drift + standard_error
    # 2 m - m' has to differ from zero (`_is_settled`), with the mean m at the rung and
    # m' below. Its deviation, for a single render of each:
    deviation = math.hypot(
        2.0 * _estimate_deviation(values, ladder, last_rung, level),
        _estimate_deviation(values, ladder, last_rung, level - 1),
    )
    min_mean = deviation * _compute_quantile(count, looks) / math.sqrt(count)
    return min_mean <= max_mean


def _estimate_deviation(
    values: Sequence[list[float]], ladder: Sequence[int], last_rung: int, rung: int
) -> float:
    """Return the standard deviation of the margins of a rung, rendered or not.

    At a rung that was not rendered, it is that of the last rendered one, which falls
    with the root of the samples.

    Args:
        values: margins of each rung; empty of one that was not rendered.
        ladder: samples per pixel of the rungs.
        last_rung: index of the last rung that was rendered.
        rung: index of the rung.
    """
    if values[rung]:
        return _compute_deviation(values[rung])
    return _compute_deviation(values[last_rung]) * math.sqrt(
        ladder[last_rung] / ladder[rung]
    )


def list_look_sizes(trials: int = 0) -> tuple[int, ...]:
    """Return after how many renders at a sample count one looks whether the margin has
    settled (`choose_spp`).

    The number of trials is one more look if it is above the others, but not too large.
    """
    if LOOK_SIZES[-1] < trials <= MAX_LOOK_SIZE:
        return (*LOOK_SIZES, trials)
    return LOOK_SIZES


def count_max_samples(
    configurations: int, ladder: Sequence[int] = LADDER, trials: int = 0
) -> int:
    """Return the maximum number of samples per pixel that `choose_spp` renders in all.

    It is reached if only the last look at the last rung settles every configuration.
    """
    if len(ladder) == 1:
        return 0
    return configurations * list_look_sizes(trials)[-1] * sum(ladder)


def _compute_deviation(values: Sequence[float]) -> float:
    """Return the standard deviation of a sample."""
    mean = fmean(values)
    squares = math.fsum((value - mean) ** 2 for value in values)
    return math.sqrt(squares / (len(values) - 1))


def _compute_quantile(count: int, looks: int) -> float:
    """Return the quantile of Student's t for one bound of the interval of a mean.

    Args:
        count: number of values.
        looks: number of looks, which share the 5 % equally.
    """
    return float(stdtrit(count - 1, 1.0 - (1.0 - CONFIDENCE) / looks))


# ---- sample counts of trials over many conditions
# How many samples per pixel the rate of such trials needs (docs/design.md).

# conditions under which each configuration is rendered at each sample count
N_CONDITIONS = 30
# fraction of the conditions whose margin more samples may carry over zero
MAX_MOVED_FRACTION = 0.05
OVER_LADDER = LADDER[:3]  # sample counts to try
# limit of the samples of a check beyond the second rung, as a multiple of those of the
# searches
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
    """Choose a sample count at which more samples would not change a failure rate.

    The rate is the fraction of conditions (e.g. weather) with a margin below zero,
    where the model is wrong. Each configuration is rendered at rising sample counts,
    the rungs of a ladder, until it has settled. The highest rung that one of them
    needed is returned.

    A configuration is rendered under the same `N_CONDITIONS` conditions at each rung.
    Suppose that more samples changed all margins by the mean change from the rung
    below, at either bound of its 95 % interval (Student's t). The configuration has
    settled if this would move at most `MAX_MOVED_FRACTION` of the conditions across
    zero (`estimate_moved_fraction`). The remaining error falls with the sample count,
    so it is smaller than that change. `benchmarks/verdicts.py` measures the error of
    the rate. These renders are not used as trials.

    Args:
        margins: for each configuration, by name, a function that renders it
            (`make_margin_function`); its seeds also sample the conditions.
        seed: root seed.
        ladder: sample counts, ascending. A single one is returned unmeasured.
    """
    if len(ladder) == 1:
        return SampleCount(ladder[0], False, (), 0)
    table = list[Rung]()
    # index; nothing settles at the first rung, which has none below
    highest_rung = 1
    seeds = [stream(seed, "sample count", number) for number in range(N_CONDITIONS)]
    for name, render in margins.items():
        rungs = _climb_until_settled(name, render, seeds, ladder)
        table += rungs
        if not rungs[-1].is_settled:
            return SampleCount(
                ladder[-1], False, tuple(table), N_CONDITIONS * len(table)
            )
        highest_rung = max(highest_rung, len(rungs) - 1)
    return SampleCount(
        ladder[highest_rung], True, tuple(table), N_CONDITIONS * len(table)
    )


def _climb_until_settled(
    name: str, render: MarginsOf, seeds: Sequence[int], ladder: Sequence[int]
) -> list[Rung]:
    """Render a configuration at rising sample counts until it has settled.

    Args:
        name: name of the configuration.
        render: renders it; (spp, seeds) to margins.
        seeds: one for each condition, the same at all sample counts.
        ladder: sample counts, ascending.

    Returns:
        The rungs that were rendered; the last one may have not settled.
    """
    rungs = list[Rung]()
    below: FloatArray | None = None
    for spp in ladder:
        at_rung = np.array(render(spp, seeds), dtype=np.float64)
        rungs.append(_summarize_conditions(name, spp, at_rung, below))
        if rungs[-1].is_settled:
            break
        below = at_rung
    return rungs


def _summarize_conditions(
    name: str, spp: int, at_rung: FloatArray, below: FloatArray | None
) -> Rung:
    """Return the row of a configuration under many conditions at one sample count.

    Args:
        name: name of the configuration.
        spp: samples per pixel.
        at_rung: (n,) margins of the rung, by condition.
        below: (n,) margins of the rung below; None at the first.
    """
    quantile = stdtrit(len(at_rung) - 1, CONFIDENCE)  # Student's t, one-sided
    half_width = quantile * at_rung.std(ddof=1) / math.sqrt(len(at_rung))
    drift = math.nan
    is_settled = False
    if below is not None:
        drift = float(at_rung.mean() - below.mean())
        is_settled = estimate_moved_fraction(at_rung, below) <= MAX_MOVED_FRACTION
    mean = float(at_rung.mean())
    return Rung(name, spp, mean, float(half_width), drift, is_settled)


def estimate_moved_fraction(at_rung: FloatArray, below: FloatArray) -> float:
    """Return the fraction of conditions whose margin more samples may carry over zero.

    It is supposed that more samples change all margins by the mean change from the rung
    below, at either bound of its 95 % interval. The bound that moves more conditions
    across zero counts. The distribution of margins is smoothed by normal kernels. NaN
    if a margin is not finite.

    Args:
        at_rung: (n,) margins at one sample count, by condition.
        below: (n,) margins at the sample count before.
    """
    change = at_rung - below
    # standard deviation of the kernels, by Silverman's rule of thumb
    width = 0.9 * at_rung.std(ddof=1) * len(at_rung) ** -0.2
    if not np.isfinite(change).all():
        return math.nan
    quantile = stdtrit(len(at_rung) - 1, 0.5 + CONFIDENCE / 2.0)
    half_width = quantile * change.std(ddof=1) / math.sqrt(len(at_rung))
    mean_change = change.mean()
    # no shift, for comparison, and both bounds of the mean change
    shifts = np.array([0.0, mean_change - half_width, mean_change + half_width])
    # smoothed fraction of conditions with a margin over zero, by shift (3,); the width
    # is 0 if all margins are equal
    fractions = ndtr((at_rung + shifts[:, None]) / max(width, 1e-12)).mean(axis=1)
    return float(np.abs(fractions[1:] - fractions[0]).max())
