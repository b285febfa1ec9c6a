"""How many samples per pixel a verification needs until noise no longer moves the verdict.

The rule: docs/design.md, "Verification".

Monte Carlo noise takes part of the margin away, and less of it the more samples there are. So the margin *drifts*
with the sample count, and a verification in the middle of that drift credits the scene with what the noise did.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

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
"""Renders of a configuration at each sample count."""

MarginOf = Callable[[int, int], float]
"""(spp, seed) -> margin in logits of one render."""


@dataclass(frozen=True)
class Rung:
    """The margins of one configuration at one sample count.

    Attributes:
        name: which configuration, e.g. "clean".
        spp: samples per pixel.
        mean: mean margin over the seeds.
        half_width: of the 95 % interval of the mean (Student's t).
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

        |change of the mean| + 95 % half-width of that change <= drift * |m|.

    So the change must be *shown* to be small (that it is smaller than its own uncertainty would pass any measurement
    that is noisy enough), and small against the distance to the decision at margin zero. The error still left at the
    upper rung is smaller than the change that led there, since it falls with the sample count. A margin near zero
    never settles: its verdict does depend on the noise, and `converged` says so.

    Args:
        margins: the configurations, e.g. {"clean": ..., "adversarial": ...}; each renders once per call.
        seed: root seed; every render gets another seed of the stream "sample count".
        ladder: sample counts, rising, at least one. A single one is returned as it is, unmeasured and not converged.
        seeds: renders per configuration and rung, at least 2.
        drift: see above, in (0, 1).

    Raises:
        InputError: ladder, seeds or drift out of range.
    """
    if not ladder or ladder[0] < 1 or any(b <= a for a, b in pairwise(ladder)):
        raise InputError(f"verify_spp: expected rising sample counts of at least 1, got {list(ladder)}")
    if seeds < 2 or not 0.0 < drift < 1.0:
        raise InputError(f"seeds and drift: expected at least 2 and a number in (0, 1), got {seeds} and {drift}")
    if len(ladder) == 1:
        return SampleCount(ladder[0], False, (), 0)
    table: list[Rung] = []
    below: dict[str, Rung] = {}
    for level, spp in enumerate(ladder):
        here = {}
        for name, margin_of in margins.items():
            values = [margin_of(spp, stream(seed, "sample count", level * seeds + k)) for k in range(seeds)]
            here[name] = _rung(name, spp, values, below.get(name), drift)
        table += here.values()
        if all(rung.settled for rung in here.values()):
            return SampleCount(spp, True, tuple(table), len(table) * seeds)
        below = here
    return SampleCount(ladder[-1], False, tuple(table), len(table) * seeds)


def most_samples(configurations: int, ladder: Sequence[int] = LADDER, seeds: int = SEEDS) -> int:
    """Return the samples a pixel that `choose_spp` renders in all, at most: where only the last rung settles it."""
    return configurations * seeds * sum(ladder) if len(ladder) > 1 else 0


def _rung(name: str, spp: int, values: list[float], below: Rung | None, drift: float) -> Rung:
    """Summarise the margins of one rung and compare them with the rung below."""
    count = len(values)
    mean = math.fsum(values) / count
    deviation = math.sqrt(math.fsum((v - mean) ** 2 for v in values) / (count - 1))
    half_width = float(stdtrit(count - 1, (1.0 + CONFIDENCE) / 2.0)) * deviation / math.sqrt(count)
    if below is None:
        return Rung(name, spp, mean, half_width, math.nan, False)
    change = mean - below.mean
    settled = abs(change) + math.hypot(half_width, below.half_width) <= drift * abs(mean)
    return Rung(name, spp, mean, half_width, change, settled)
