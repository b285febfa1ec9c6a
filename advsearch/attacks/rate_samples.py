"""How many samples a pixel trials over many conditions need (docs/design.md).

What is verified there is a rate: the share of conditions under which the model is wrong. A condition whose margin is
near zero comes out one way or the other by noise, however many samples there are, and as often one way as the other. So
only what noise does to the margins on average counts, and the share of conditions which that carries over zero.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr, stdtrit

from advsearch.attacks.trials import CONFIDENCE, LADDER, MarginsOf, Rung, SampleCount
from advsearch.seeds import stream

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
