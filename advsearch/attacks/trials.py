"""Counts of successes in trials with their intervals, and the number of samples per
pixel that trials need (docs/design.md).

Monte Carlo noise reduces the margin, and the more so the fewer samples per pixel there
are. So the margin *drifts* with the sample count. If trials have too few samples, a
failure that is caused by the noise is taken for one of the scene.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise, product
from statistics import fmean

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr, stdtrit
from torch import Tensor

from advsearch.attacks.evaluation import Evaluate, Query
from advsearch.errors import InputError
from advsearch.seeds import derive_seed
from advsearch.statistics.intervals import CONFIDENCE, clopper_pearson


@dataclass(frozen=True)
class TrialCounts:
    """The number of successes in independent trials.

    Attributes:
        n_successes: number of successes, from 0 to `n_trials`.
        n_trials: number of trials, at least 1.
        spp: samples per pixel of every trial.
        confidence: confidence of the interval. It is larger than 95 % if the trials
            might have ended at several looks.
    """

    n_successes: int
    n_trials: int
    spp: int
    confidence: float = CONFIDENCE

    @property
    def rate(self) -> float:
        return self.n_successes / self.n_trials

    @property
    def interval(self) -> tuple[float, float]:
        """Clopper and Pearson's interval of the success rate, with `confidence`."""
        return clopper_pearson(self.n_successes, self.n_trials, self.confidence)


def derive_trial_seed(seed: int, number: int) -> int:
    """Return the seed of a trial, by its number.

    Groups of trials with the same root seed have the same seeds.
    """
    return derive_seed(seed, "verification", number)


# A sample count is chosen by trying the rungs of a ladder, from the lowest on. At each
# rung a configuration is rendered several times. A *look* is a check of these renders:
# whether more samples would change the sign of the margin.

# samples per pixel of the rungs; each quarters the variance of the one before
LADDER = (4, 16, 64, 256)
# numbers of renders at a rung after which there is a look
LOOK_SIZES = (4, 8)
# largest number of renders of a look, even if there are more trials
MAX_LOOK_SIZE = 20

# (spp, seeds) -> margins in logits, one for each render
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
    return _MarginRenderer(evaluate, kind, u, n_images, draws_conditions)


@dataclass(eq=False)
class _MarginRenderer:
    """Renders a configuration and returns its margins.

    Attributes:
        evaluate: renders queries and yields their evaluations.
        kind: kind of the queries, which are numbered across all sample counts.
        u: (d,) the configuration.
        n_images: number of renders at each sample count, the first ones, whose images
            are requested.
        draws_conditions: whether each seed also samples conditions.
        n_rendered: number of renders so far, by their samples per pixel.
    """

    evaluate: Evaluate
    kind: str
    u: Tensor
    n_images: int
    draws_conditions: bool
    n_rendered: Counter[int] = field(default_factory=Counter)

    def __call__(self, spp: int, seeds: Sequence[int]) -> list[float]:
        """Return the margin of one render for each seed.

        A later call with the same `spp` continues the numbering, so that only the first
        `n_images` renders request an image.
        """
        first_render = self.n_rendered[spp]  # at this sample count
        first_query = self.n_rendered.total()  # at all sample counts
        self.n_rendered[spp] += len(seeds)
        queries = []
        for offset, seed in enumerate(seeds):
            query = self._make_margin_query(spp, seed, first_query + offset)
            includes_image = first_render + offset < self.n_images
            queries.append(replace(query, includes_image=includes_image))
        evaluations = self.evaluate(queries)
        return [-evaluation.required_judgement.score for evaluation in evaluations]

    def _make_margin_query(self, spp: int, seed: int, row_index: int) -> Query:
        """Return the query of one render, without an image."""
        return Query(
            self.u,
            seed,
            self.kind,
            row_index=row_index,
            spp=spp,
            draws_conditions=self.draws_conditions,
        )


@dataclass(frozen=True)
class Rung:
    """The margins of one configuration at one sample count.

    Attributes:
        name: name of the configuration.
        spp: samples per pixel.
        mean: mean of the margins.
        half_width: distance from the mean to its one-sided 95 % bound (Student's t).
            The 5 % are those of all looks together.
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

    - m;
    - m + (m - m'), the margin if more samples changed it as much again as the step from
      the rung below did. The remaining error falls with the sample count, so it is
      smaller than that;
    - every single render at the rung.

    In general m must exceed the uncertainty of a single render, because a trial that
    follows is a single render. If there are as many renders as trials to come, m must
    only exceed its own standard error.

    A margin at zero never settles: its verdict depends on the noise. About 5 % of the
    hardest cases settle with the wrong sign (`benchmarks/verdicts.py`: 5.1 %), and
    fewer of all others.
    At each rung there are several looks, after more and more renders. The 5 % are
    divided equally among them (Bonferroni). A look is skipped if it cannot show that
    the margin has settled, according to the noise so far (`_may_settle`). If one
    configuration does not settle, the last rung is returned, with `converged` False.

    These renders must not be used as trials, because the rung is chosen by their
    agreement. So trials have other seeds (`run_trials`). With the same seeds, a claim
    that holds in only 75 % of renders would be confirmed in 5.9 % of all cases, and not
    in 2.2 %.

    Args:
        margins: for each configuration, e.g. "adversarial" and "clean", a function
            that renders it (`make_margin_function`). The first should be the one that
            is least likely to settle, as the others are then not rendered.
        seed: root seed.
        ladder: sample counts, rising. A single one is returned unmeasured.
        trials: number of trials that will follow under the same conditions; 0 if the
            trials are of another kind. If it is not too large, there is one more look
            after this many renders (`list_look_sizes`).

    Raises:
        InputError: the ladder is empty, not rising, or has a count below 1.
    """
    _check_ladder(ladder)
    if len(ladder) == 1:
        return SampleCount(ladder[0], converged=False, table=(), renders=0)
    table = list[Rung]()
    n_renders = 0
    # Nothing settles at the rung with index 0, which has none below.
    highest_rung = 1
    look_sizes = list_look_sizes(trials)
    for name, render in margins.items():
        # for each rung that was rendered, which are the first ones of the ladder
        margins_of_rungs = _climb_ladder(render, seed, ladder, look_sizes, trials)
        table += _summarize_rungs(name, ladder, margins_of_rungs, trials)
        n_renders += sum(map(len, margins_of_rungs))
        if not table[-1].is_settled:
            return SampleCount(ladder[-1], False, tuple(table), n_renders)
        highest_rung = max(highest_rung, len(margins_of_rungs) - 1)
    return SampleCount(ladder[highest_rung], True, tuple(table), n_renders)


def _check_ladder(ladder: Sequence[int]) -> None:
    """Raise InputError if a ladder is empty, not rising, or has a count below 1."""
    if not ladder or ladder[0] < 1 or any(b <= a for a, b in pairwise(ladder)):
        raise InputError(
            "verify_spp: expected rising sample counts of at least 1, "
            f"got {list(ladder)}"
        )


def _summarize_rungs(
    name: str,
    ladder: Sequence[int],
    margins_of_rungs: Sequence[Sequence[float]],
    trials: int,
) -> list[Rung]:
    """Return a row for each sample count at which a configuration was rendered.

    Args:
        name: name of the configuration.
        ladder: sample counts; those that were rendered are the first ones.
        margins_of_rungs: margins at each of these.
        trials: number of trials that will follow, see `_is_settled`.
    """
    n_looks = len(list_look_sizes(trials))
    rows = []
    below: Sequence[float] = ()  # margins of the rung below; the first has none
    for spp, at_rung in zip(ladder, margins_of_rungs, strict=False):
        rows.append(_summarize_rung(name, spp, at_rung, below, n_looks, trials))
        below = at_rung
    return rows


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
        trials: number of trials that will follow, see `_is_settled`.
    """
    mean = fmean(at_rung)
    # distance of the mean from its one-sided confidence bound
    quantile = _compute_quantile(len(at_rung), looks)
    half_width = quantile * _compute_deviation(at_rung) / math.sqrt(len(at_rung))
    is_first_rung = not below
    if is_first_rung:
        return Rung(name, spp, mean, half_width, drift=math.nan, is_settled=False)
    is_settled = _is_settled(at_rung, below, looks, trials)
    drift = mean - fmean(below)
    return Rung(name, spp, mean, half_width, drift, is_settled)


def _climb_ladder(
    margins: MarginsOf,
    seed: int,
    ladder: Sequence[int],
    look_sizes: Sequence[int],
    trials: int,
) -> list[list[float]]:
    """Return the margins of one configuration at each rung that was rendered.

    Looks are made at rising rungs, and at each rung after more and more renders. A look
    that cannot show that the configuration has settled is skipped. Looks end when it
    has settled, or when none of the remaining ones can show that it has. A look needs
    `count` renders at its rung and at the rung below, with the same seeds at both, and
    renders those that are missing.

    Args:
        margins: function from (spp, seeds) to margins, which renders the configuration.
        seed: root seed.
        ladder: samples per pixel of the rungs, ascending.
        look_sizes: numbers of renders at a rung after which there is a look, ascending.
        trials: number of trials that will follow, as in `choose_spp`.
    """
    margins_of_rungs: list[list[float]] = [[] for _ in ladder]
    n_looks = len(look_sizes)  # at each rung
    for rung, count in _iterate_promising_looks(margins_of_rungs, ladder, look_sizes):
        seeds = _derive_look_seeds(seed, count)
        for index in (rung - 1, rung):
            _render_missing(margins_of_rungs[index], margins, ladder[index], seeds)
        at_rung = margins_of_rungs[rung]
        if _is_settled(at_rung, margins_of_rungs[rung - 1], n_looks, trials):
            break
    return [margins_of_rung for margins_of_rung in margins_of_rungs if margins_of_rung]


def _iterate_promising_looks(
    margins_of_rungs: Sequence[list[float]],
    ladder: Sequence[int],
    look_sizes: Sequence[int],
) -> Iterator[tuple[int, int]]:
    """Yield the looks that may show that a configuration has settled.

    Whether a look may show it depends on the margins at the moment when the look is
    requested. The iteration ends when no remaining look may.

    Args:
        margins_of_rungs: margins at each rung; the caller adds new ones meanwhile.
        ladder: samples per pixel of the rungs, ascending.
        look_sizes: numbers of renders at a rung after which there is a look, ascending.

    Yields:
        The index of the rung, and the number of renders there.
    """
    n_looks = len(look_sizes)
    may_settle = partial(_may_settle, margins_of_rungs, ladder, n_looks)
    looks = list(product(range(1, len(ladder)), look_sizes))  # none at the first rung
    for look_index, (rung, count) in enumerate(looks):
        remaining_looks = looks[look_index:]  # including this one
        if not any(may_settle(*look) for look in remaining_looks):
            return
        if may_settle(rung, count):
            yield rung, count


def _derive_look_seeds(seed: int, count: int) -> list[int]:
    """Return the seeds of the first renders at a rung, the same at all rungs."""
    return [derive_seed(seed, "sample count", number) for number in range(count)]


def _is_settled(
    at_rung: Sequence[float], below: Sequence[float], looks: int, trials: int
) -> bool:
    """Return whether more samples would not change the sign of the margin.

    The mean, the mean extrapolated to more samples, and every single render have to be
    on the same side of zero (`choose_spp`).

    Args:
        at_rung: margins of a rung.
        below: margins of the rung below.
        looks: number of looks. The probability of an error, 5 %, is divided equally
            among them.
        trials: number of trials that will follow, as in `choose_spp`.
    """
    mean = fmean(at_rung)
    # The rung below may have more renders, from an earlier look there.
    count = min(len(at_rung), len(below))
    # the mean if more samples changed it as much again as the step from below did
    extrapolated = 2.0 * mean - fmean(below)
    sign = math.copysign(1.0, mean)
    quantile = _compute_quantile(count, looks)
    mean_error = _compute_mean_error(at_rung, count, trials)
    is_mean_sure = sign * mean > quantile * mean_error
    extrapolated_error = _compute_extrapolated_error(at_rung, below, count)
    is_extrapolated_sure = sign * extrapolated > quantile * extrapolated_error
    is_sign_constant = all(sign * value > 0.0 for value in at_rung)
    return is_mean_sure and is_extrapolated_sure and is_sign_constant


def _compute_mean_error(at_rung: Sequence[float], count: int, trials: int) -> float:
    """Return the error that the mean margin of a rung has to exceed.

    With fewer renders than trials, that is the deviation of a single render, so that
    the other trials are on the same side, too. With as many renders as trials, the
    standard error of the mean suffices.
    """
    deviation = _compute_deviation(at_rung)
    are_as_many_as_trials = count == trials
    return deviation / math.sqrt(count) if are_as_many_as_trials else deviation


def _compute_extrapolated_error(
    at_rung: Sequence[float], below: Sequence[float], count: int
) -> float:
    """Return the standard error of 2 m - m', with the mean margins of a rung and of the
    rung below, from `count` renders at each.
    """
    deviation = _compute_deviation(at_rung)
    single_render_error = math.hypot(2.0 * deviation, _compute_deviation(below))
    return single_render_error / math.sqrt(count)


def _render_missing(
    rendered: list[float], margins: MarginsOf, spp: int, seeds: Sequence[int]
) -> None:
    """Render a configuration at one rung with the seeds that are missing there.

    Args:
        rendered: margins of the rung, for the first seeds; new ones are appended.
        margins: function from (spp, seeds) to margins, which renders the configuration.
        spp: samples per pixel of the rung.
        seeds: all seeds, in order.
    """
    new_seeds = seeds[len(rendered) :]
    if new_seeds:
        rendered += margins(spp, new_seeds)


def _may_settle(
    values: Sequence[list[float]],
    ladder: Sequence[int],
    looks: int,
    rung: int,
    count: int,
) -> bool:
    """Return whether `count` renders at a rung may show that the margin has settled.

    This is an optimistic forecast from the renders so far. The largest mean to be
    expected at the rung is compared with the smallest one that could settle there.

    If margins at the rung have both signs, it cannot settle.

    Args:
        values: margins of each rung; an empty list if it was not rendered.
        ladder: samples per pixel of the rungs.
        looks: number of looks. The probability of an error, 5 %, is divided equally
            among them.
        rung: index of the rung in `ladder`.
        count: number of renders at the rung that the look would use.
    """
    rendered_rungs = [index for index in range(rung + 1) if values[index]]
    if not rendered_rungs:
        return True  # nothing is known yet
    if _have_both_signs(values[rung]):
        return False
    # The first look renders its rung and the one below, so that two are rendered now.
    last_rung = rendered_rungs[-1]
    max_mean = _forecast_mean(values[last_rung], values[rendered_rungs[-2]])
    error = _forecast_error(values, ladder, last_rung, rung)
    quantile = _compute_quantile(count, looks)
    min_mean = error * quantile / math.sqrt(count)
    return min_mean <= max_mean


def _have_both_signs(margins: Sequence[float]) -> bool:
    """Return whether some margins are at least 0 and some at most 0; False for none."""
    return bool(margins) and min(margins) <= 0.0 <= max(margins)


def _forecast_mean(
    last_values: Sequence[float], values_below: Sequence[float]
) -> float:
    """Return the largest magnitude of a mean margin to be expected at a later rung.

    It is the mean at the last rendered rung, plus its standard error, plus as much
    again as it changed from the rung below.
    """
    mean = fmean(last_values)
    drift = abs(mean - fmean(values_below))
    standard_error = _compute_deviation(last_values) / math.sqrt(len(last_values))
    return abs(mean) + drift + standard_error


def _forecast_error(
    values: Sequence[list[float]], ladder: Sequence[int], last_rung: int, rung: int
) -> float:
    """Return the standard deviation of 2 m - m' for a single render of each.

    Let m be the mean at the rung, and m' the one at the rung below. To settle, 2 m - m'
    has to exceed its error (`_is_settled`). It is assumed here that m = m', so that m
    has to exceed the error. The arguments are those of `_estimate_deviation`.
    """
    return math.hypot(
        2.0 * _estimate_deviation(values, ladder, last_rung, rung),
        _estimate_deviation(values, ladder, last_rung, rung - 1),
    )


def _estimate_deviation(
    values: Sequence[list[float]], ladder: Sequence[int], last_rung: int, rung: int
) -> float:
    """Return the standard deviation of the margins of a rung, rendered or not.

    At a rung that was not rendered, it is estimated from the last rendered one: it
    falls with the square root of the samples.

    Args:
        values: margins of each rung; an empty list if it was not rendered.
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
    """Return the numbers of renders at a rung after which there is a look, ascending.

    They are `LOOK_SIZES`, and the number of trials if it is above these but not above
    `MAX_LOOK_SIZE`.
    """
    if LOOK_SIZES[-1] < trials <= MAX_LOOK_SIZE:
        return (*LOOK_SIZES, trials)
    return LOOK_SIZES


def count_max_samples(
    configurations: int, ladder: Sequence[int] = LADDER, trials: int = 0
) -> int:
    """Return the maximum number of samples per pixel that `choose_spp` renders in all.

    It is reached if only the last look at the last rung settles every configuration. A
    single sample count is chosen without any render.
    """
    if len(ladder) == 1:
        return 0
    max_renders_of_rung = list_look_sizes(trials)[-1]  # of one configuration
    return configurations * max_renders_of_rung * sum(ladder)


def _compute_deviation(values: Sequence[float]) -> float:
    """Return the standard deviation of a sample."""
    mean = fmean(values)
    squares = math.fsum((value - mean) ** 2 for value in values)
    return math.sqrt(squares / (len(values) - 1))


def _compute_quantile(count: int, looks: int) -> float:
    """Return the quantile of Student's t for the one-sided bound of a mean.

    It is one-sided, since a margin can only settle on the side of zero where its mean
    is. So the 5 % lie on one side, and are divided equally among the looks.

    Args:
        count: number of values.
        looks: number of looks.
    """
    error_per_look = (1.0 - CONFIDENCE) / looks
    return float(stdtrit(count - 1, 1.0 - error_per_look))


# ---- sample counts of trials over many conditions
# The number of samples per pixel that the rate of such trials needs (docs/design.md).

# number of conditions under which each configuration is rendered at each sample count
N_CONDITIONS = 30
# A configuration has settled if more samples would change the sign of the margin in at
# most this fraction of the conditions.
MAX_MOVED_FRACTION = 0.05
OVER_LADDER = LADDER[:3]  # samples per pixel of the rungs
# Limit of the samples of a check, as a multiple of those of the searches. It does not
# apply to the first two rungs.
MAX_SAMPLE_RATIO = 2

FloatArray = npt.NDArray[np.float64]


def limit_ladder(
    ladder: Sequence[int], n_images: int, search_samples: int
) -> Sequence[int]:
    """Return the sample counts of a ladder that a check can afford.

    The images of the check may take `MAX_SAMPLE_RATIO` times the samples of the
    searches. The first two counts are returned in any case, as margins have to be
    compared at two.
    """
    max_samples = MAX_SAMPLE_RATIO * search_samples
    return [
        spp
        for index, spp in enumerate(ladder)
        if index < 2 or n_images * spp <= max_samples
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
    The mean change of the margins from the rung below has a 95 % interval (Student's
    t). It is assumed that more samples would change all margins once more, by one of
    the bounds of this interval: the one that changes more signs. The configuration has
    settled if this changes the sign in at most `MAX_MOVED_FRACTION` of the conditions
    (`estimate_moved_fraction`). The remaining error falls with the sample count, so the
    true change is smaller. `benchmarks/verdicts.py` measures the error of the rate.
    These renders are not used as trials.

    Args:
        margins: for each configuration, by name, a function that renders it
            (`make_margin_function`); its seeds also sample the conditions.
        seed: root seed.
        ladder: sample counts, ascending. A single one is returned unmeasured.
    """
    if len(ladder) == 1:
        return SampleCount(ladder[0], converged=False, table=(), renders=0)
    table = list[Rung]()
    # Nothing settles at the rung with index 0, which has none below.
    highest_rung = 1
    seeds = _derive_look_seeds(seed, N_CONDITIONS)
    for name, render in margins.items():
        rungs = _climb_until_settled(name, render, seeds, ladder)
        table += rungs
        if not rungs[-1].is_settled:
            return _count_rate_samples(ladder[-1], table, converged=False)
        highest_rung = max(highest_rung, len(rungs) - 1)
    return _count_rate_samples(ladder[highest_rung], table, converged=True)


def _count_rate_samples(
    spp: int, table: Sequence[Rung], *, converged: bool
) -> SampleCount:
    """Return a sample count for a failure rate, with the rows that it was chosen by."""
    # each row has one render under each condition
    renders = N_CONDITIONS * len(table)
    return SampleCount(spp, converged, tuple(table), renders)


def _climb_until_settled(
    name: str, render: MarginsOf, seeds: Sequence[int], ladder: Sequence[int]
) -> list[Rung]:
    """Render a configuration at rising sample counts until it has settled.

    Args:
        name: name of the configuration.
        render: function from (spp, seeds) to margins, one for each seed.
        seeds: one for each condition, the same at all sample counts.
        ladder: sample counts, ascending.

    Returns:
        A row for each sample count that was rendered. The configuration may have not
        settled at the last one.
    """
    rungs = list[Rung]()
    below: FloatArray | None = None  # margins of the rung below
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
    # `Rung.half_width` is the distance of the mean from its one-sided confidence bound
    quantile = stdtrit(len(at_rung) - 1, CONFIDENCE)
    half_width = quantile * at_rung.std(ddof=1) / math.sqrt(len(at_rung))
    drift = math.nan
    is_settled = False
    if below is not None:
        drift = float(at_rung.mean() - below.mean())
        # few margins would change their sign with more samples
        is_settled = estimate_moved_fraction(at_rung, below) <= MAX_MOVED_FRACTION
    mean = float(at_rung.mean())
    return Rung(name, spp, mean, float(half_width), drift, is_settled)


def estimate_moved_fraction(at_rung: FloatArray, below: FloatArray) -> float:
    """Return the fraction of conditions whose margin may change sign with more samples.

    It is assumed that more samples change all margins by the mean change from the rung
    below. This change has a 95 % interval; of its bounds, the one that changes more
    signs is taken. The distribution of margins is smoothed by normal kernels. NaN if a
    margin is not finite.

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
