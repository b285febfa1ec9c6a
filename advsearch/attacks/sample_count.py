"""How many samples per pixel a verification needs until noise no longer moves the verdict.

The rule: docs/design.md, "Verification".

Monte Carlo noise takes part of the margin away, and less of it the more samples there are. So the margin *drifts*
with the sample count, and a verification in the middle of that drift credits the scene with what the noise did.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, product

from scipy.special import stdtrit
from torch import Tensor

from advsearch.attacks.evaluation import Evaluate, Query
from advsearch.attacks.trials import CONFIDENCE
from advsearch.errors import InputError
from advsearch.seeds import stream

LADDER = (4, 16, 64, 256)
"""Sample counts to try; each quarters the variance of the one before."""

DRIFT = 0.5
"""The largest drift from rung to rung, its uncertainty included, as a fraction of the margin.

The drift left above the upper rung is smaller than the one that led there, so a margin that passes keeps its sign.
"""

SEEDS = 8
"""Renders of a configuration at each sample count, at most."""

LOOKS = 2
"""How often the renders of a sample count are looked at: after half of them, and after all."""

MarginsOf = Callable[[int, Sequence[int]], Sequence[float]]
"""(spp, seeds) -> margins in logits, one of each render."""


def margins_of(evaluate: Evaluate, kind: str, u: Tensor, *, sought: bool = True) -> MarginsOf:
    """Return the margins of one configuration under the conditions that the scene comes with; the rows of all sample
    counts are numbered together.

    Args:
        evaluate: answers the queries.
        kind: of the rows.
        u: (d,) the configuration.
        sought: as for `Query`.
    """
    count = 0

    def margins(spp: int, seeds: Sequence[int]) -> list[float]:
        nonlocal count
        first, count = count, count + len(seeds)
        asked = enumerate(seeds, first)
        queries = [Query(u, seed, kind, number, spp=spp, drawn=False, sought=sought) for number, seed in asked]
        return [answer.said.score for answer in evaluate(queries)]

    return margins


@dataclass(frozen=True)
class Rung:
    """The margins of one configuration at one sample count.

    Attributes:
        name: which configuration, e.g. "clean".
        spp: samples per pixel.
        mean: mean margin over the seeds.
        half_width: of the interval of the mean (Student's t) that is right in 97.5 % of all cases: after each of two
            looks, and so in 95 % after both.
        drift: mean here minus mean at the rung below; NaN at the first.
        settled: whether the drift is small enough; see `choose_spp`.
    """

    name: str
    spp: int
    mean: float
    half_width: float
    drift: float
    settled: bool


@dataclass(frozen=True)
class SampleCount:
    """The choice, and everything it rests on.

    Attributes:
        spp: samples per pixel to verify with.
        converged: whether all margins are shown to have settled there; if not, it is the last rung of the ladder.
        table: one row per configuration and rung that was measured, in this order.
        renders: renders spent.
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
    seeds: int = SEEDS,
    drift: float = DRIFT,
) -> SampleCount:
    """Climb a ladder of sample counts with each configuration until its margin no longer drifts; return the highest
    rung that one of them needed.

    A configuration has settled at a rung with mean margin m when, against the rung below,

        |change of the mean| + half-width of that change <= drift * |m|.

    So the change must be *shown* to be small (that it is smaller than its own uncertainty would pass any measurement
    that is noisy enough), and small against the distance to the decision at margin zero. The error still left at the
    upper rung is smaller than the change that led there, since it falls with the sample count: what has settled is not
    rendered at higher rungs. A margin near zero never settles: its verdict does depend on the noise, and `converged`
    says so.

    The rungs are looked at after half of the renders, and once more after all of them if that does not settle it. Each
    look has intervals of 97.5 %, so that both together are wrong in 5 % of all cases at most (Bonferroni).

    Three quarters of the samples of a whole ladder are those of its last rung. So a look that cannot settle anything,
    as far as the noise so far tells (`_may_settle`), is left out; where none is left that could, or one configuration
    has not settled, the last rung is taken as it is. That may take `converged` away, but never gives it.

    Args:
        margins: the configurations, e.g. {"adversarial": ..., "clean": ...}; each renders what it is asked for. The
            first should be the one that is least likely to settle.
        seed: root seed; every render gets another seed of the stream "sample count".
        ladder: sample counts, rising, at least one. A single one is returned as it is, unmeasured and not converged.
        seeds: renders per configuration and rung at most, at least 4.
        drift: see above, in (0, 1).

    Raises:
        InputError: ladder, seeds or drift out of range.
    """
    if not ladder or ladder[0] < 1 or any(b <= a for a, b in pairwise(ladder)):
        raise InputError(f"verify_spp: expected rising sample counts of at least 1, got {list(ladder)}")
    if seeds < 4 or not 0.0 < drift < 1.0:
        raise InputError(f"seeds and drift: expected at least 4 and a number in (0, 1), got {seeds} and {drift}")
    if len(ladder) == 1:
        return SampleCount(ladder[0], False, (), 0)
    table, renders, reached = list[Rung](), 0, 1
    for name, render in margins.items():
        values = _climbed(render, seed, ladder, seeds, drift)
        below = None
        for spp, found in zip(ladder, values, strict=False):
            below = _rung(name, spp, found, below, drift)
            table.append(below)
        renders, reached = renders + sum(map(len, values)), max(reached, len(values) - 1)
        if not table[-1].settled:
            return SampleCount(ladder[-1], False, tuple(table), renders)
    return SampleCount(ladder[reached], True, tuple(table), renders)


def _climbed(margins: MarginsOf, seed: int, ladder: Sequence[int], seeds: int, drift: float) -> list[list[float]]:
    """Return the margins of one configuration at each rung, up to that at which it settles or beyond which none can
    settle it."""
    values: list[list[float]] = [[] for _ in ladder]
    looks = list(product(range(1, len(ladder)), (seeds // LOOKS, seeds)))
    for number, (level, count) in enumerate(looks):
        if not any(_may_settle(values, ladder, *later, drift) for later in looks[number:]):
            break
        if not _may_settle(values, ladder, level, count, drift):
            continue
        for one in (level - 1, level):
            new = range(one * seeds + len(values[one]), one * seeds + count)
            values[one] += margins(ladder[one], [stream(seed, "sample count", number) for number in new])
        if _rung("", 0, values[level], _rung("", 0, values[level - 1], None, drift), drift).settled:
            break
    return [found for found in values if found]


def _may_settle(values: Sequence[list[float]], ladder: Sequence[int], level: int, count: int, drift: float) -> bool:
    """Whether so many renders at a rung may show that the margin has settled there, by what has been rendered.

    The mean may be off by its standard error, and may move on by as much as it has moved before. Deviations stay; at
    rungs that were not rendered they fall with the root of the samples.
    """
    known = [one for one in range(level + 1) if values[one]]
    if not known:
        return True
    best, mean = values[known[-1]], {one: math.fsum(values[one]) / len(values[one]) for one in known}
    moved = abs(mean[known[-1]] - mean[known[-2]])
    largest = abs(mean[known[-1]]) + moved + _deviation(best) / math.sqrt(len(best))
    deviations = [
        _deviation(values[one]) if values[one] else _deviation(best) * math.sqrt(ladder[known[-1]] / ladder[one])
        for one in (level - 1, level)
    ]
    return math.hypot(*deviations) * _quantile(count) / math.sqrt(count) <= drift * largest


def most_samples(configurations: int, ladder: Sequence[int] = LADDER, seeds: int = SEEDS) -> int:
    """Return the samples a pixel that `choose_spp` renders in all, at most: where only the last rung settles it."""
    return configurations * seeds * sum(ladder) if len(ladder) > 1 else 0


def _rung(name: str, spp: int, values: list[float], below: Rung | None, drift: float) -> Rung:
    """Summarise the margins of one rung and compare them with the rung below."""
    count = len(values)
    mean = math.fsum(values) / count
    half_width = _quantile(count) * _deviation(values) / math.sqrt(count)
    if below is None:
        return Rung(name, spp, mean, half_width, math.nan, False)
    change = mean - below.mean
    settled = abs(change) + math.hypot(half_width, below.half_width) <= drift * abs(mean)
    return Rung(name, spp, mean, half_width, change, settled)


def _deviation(values: Sequence[float]) -> float:
    """The standard deviation of what these were drawn from."""
    mean = math.fsum(values) / len(values)
    return math.sqrt(math.fsum((v - mean) ** 2 for v in values) / (len(values) - 1))


def _quantile(count: int) -> float:
    """Of Student's t, for the interval of a mean of so many values at one of the looks."""
    return float(stdtrit(count - 1, 1.0 - (1.0 - CONFIDENCE) / LOOKS / 2.0))
