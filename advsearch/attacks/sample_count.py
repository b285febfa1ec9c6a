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

MarginOf = Callable[[int, int], float]
"""(spp, seed) -> margin in logits of one render."""


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
        converged: whether the margins had settled there; False means that the ladder ended first.
        table: one row per configuration and rung, in the order of measurement.
        renders: renders spent.
    """

    spp: int
    converged: bool
    table: tuple[Rung, ...]
    renders: int


def choose_spp(
    margins: Mapping[str, MarginOf],
    *,
    seed: int,
    ladder: Sequence[int] = LADDER,
    seeds: int = SEEDS,
    drift: float = DRIFT,
) -> SampleCount:
    """Climb a ladder of sample counts until no configuration's margin drifts, and return the rung reached.

    A configuration has settled at a rung with mean margin m when, against the rung below,

        |change of the mean| + half-width of that change <= drift * |m|.

    So the change must be *shown* to be small (that it is smaller than its own uncertainty would pass any measurement
    that is noisy enough), and small against the distance to the decision at margin zero. The error still left at the
    upper rung is smaller than the change that led there, since it falls with the sample count. A margin near zero
    never settles: its verdict does depend on the noise, and `converged` says so.

    The rungs are looked at after half of the renders, and once more after all of them if that does not settle it. Each
    look has intervals of 97.5 %, so that both together are wrong in 5 % of all cases at most (Bonferroni).

    Args:
        margins: the configurations, e.g. {"clean": ..., "adversarial": ...}; each renders once per call.
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
    values: dict[tuple[str, int], list[float]] = {(name, level): [] for name in margins for level in range(len(ladder))}

    def rung(name: str, level: int, count: int) -> Rung:
        """The summary of at least so many renders."""
        found = values[name, level]
        for number in range(len(found), count):
            found.append(margins[name](ladder[level], stream(seed, "sample count", level * seeds + number)))
        below = _rung(name, ladder[level - 1], values[name, level - 1], None, drift) if level else None
        return _rung(name, ladder[level], found, below, drift)

    for level, count in product(range(1, len(ladder)), (seeds // LOOKS, seeds)):
        two = [[rung(name, one, count) for name in margins] for one in (level - 1, level)]
        settled = all(one.settled for one in two[1])
        if settled:
            break
    reached = [rung(name, one, 0) for one in range(level + 1) for name in margins]
    return SampleCount(ladder[level], settled, tuple(reached), sum(map(len, values.values())))


def most_samples(configurations: int, ladder: Sequence[int] = LADDER, seeds: int = SEEDS) -> int:
    """Return the samples a pixel that `choose_spp` renders in all, at most: where only the last rung settles it."""
    return configurations * seeds * sum(ladder) if len(ladder) > 1 else 0


def _rung(name: str, spp: int, values: list[float], below: Rung | None, drift: float) -> Rung:
    """Summarise the margins of one rung and compare them with the rung below."""
    count = len(values)
    mean = math.fsum(values) / count
    deviation = math.sqrt(math.fsum((v - mean) ** 2 for v in values) / (count - 1))
    tail = (1.0 - CONFIDENCE) / LOOKS / 2.0
    half_width = float(stdtrit(count - 1, 1.0 - tail)) * deviation / math.sqrt(count)
    if below is None:
        return Rung(name, spp, mean, half_width, math.nan, False)
    change = mean - below.mean
    settled = abs(change) + math.hypot(half_width, below.half_width) <= drift * abs(mean)
    return Rung(name, spp, mean, half_width, change, settled)
