"""Whether answers are wrong more often where something holds than where it does not: shares of many parts at once.

The interval of a difference is Newcombe's (1998, "Interval estimation for the difference between independent
proportions", Statistics in Medicine 17, method 10), made of Wilson's score intervals (1927). How likely it is by chance
comes from sharing the wrong answers out among the pictures anew: a part is compared with the part that stands out most
each time, so that looking at many parts at once is accounted for, and that neighbours are seen together (Westfall and
Young 1993, "Resampling-Based Multiple Testing", the single-step maximum). How far a part stands out is said by the
likelihood-ratio statistic of its two shares.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.special import ndtri, xlogy

from advsearch.attacks.trials import CONFIDENCE

Counts = npt.NDArray[np.int64]
Doubles = npt.NDArray[np.float64]

SHARINGS = 199
"""How often the wrong answers are shared out anew, so that no p-value is under 0.005."""

LEVEL = 0.05
"""Where no part has to do with the answers, the chance that any is told from chance."""


class PartCounts:
    """Counts of n parts over pictures: of the answers, and of the wrong ones shared out by chance.

    Args:
        parts: n.
        pictures: how many there will be.
        failures: of them, those whose answer is wrong.
        seed: of the chance.

    Attributes:
        pictures: as given.
        failures: as given.
        seen: (n,) pictures in which each part holds.
        wrong: (n,) of them, those whose answer is wrong.
        chance: (SHARINGS, n) the same for wrong answers that were shared out.
    """

    def __init__(self, parts: int, pictures: int, failures: int, seed: int) -> None:
        self.pictures, self.failures = pictures, failures
        self.seen, self.wrong = np.zeros((2, parts), np.int64)
        self.chance = np.zeros((SHARINGS, parts), np.uint32)
        self._left, self._to_go = pictures, np.full(SHARINGS, failures)
        self._random = np.random.default_rng(seed)

    def add(self, parts: Counts, failed: bool) -> None:
        """Count a picture.

        Args:
            parts: numbers of those that hold in it, each once.
            failed: whether its answer is wrong.
        """
        self.seen[parts] += 1
        self.wrong[parts] += failed
        drawn = self._random.random(SHARINGS) * self._left < self._to_go  # so each choice of pictures is equally likely
        self._left, self._to_go = self._left - 1, self._to_go - drawn
        self.chance[np.ix_(np.flatnonzero(drawn), parts)] += 1


@dataclass(frozen=True, eq=False)
class Association:
    """What n parts have to do with the answers. Numbers are NaN where a part was not compared.

    Attributes:
        compared: (n,) bool.
        difference: (n,) share of wrong answers where the part holds less that where it does not, in [-1, 1].
        low: (n,) lower end of its 95 % interval, for the part by itself.
        high: (n,) upper end.
        p: (n,) how likely it is that by chance any part stands out as far, in (0, 1].
    """

    compared: npt.NDArray[np.bool_]
    difference: Doubles
    low: Doubles
    high: Doubles
    p: Doubles

    @property
    def told(self) -> npt.NDArray[np.bool_]:
        """(n,): which parts are told from chance."""
        return np.nan_to_num(self.p, nan=1.0) <= LEVEL

    @property
    def strength(self) -> Doubles:
        """(n,) the end of the interval that is nearer to 0, without its sign; 0 where the interval contains 0."""
        return np.nan_to_num(np.maximum(np.maximum(self.low, -self.high), 0.0), nan=0.0)


def association(tally: PartCounts, some: slice, least: int) -> Association:
    """Compare the answers where each of some parts holds with those where it does not.

    Args:
        tally: of all pictures.
        some: the parts.
        least: a part is compared that holds in so many pictures and does not in as many.
    """
    seen, wrong, pictures, failures = tally.seen[some], tally.wrong[some], tally.pictures, tally.failures
    compared = (seen >= least) & (pictures - seen >= least)
    low, high, difference, p = np.full((4, len(seen)), np.nan)
    if compared.any():
        n, k = seen[compared], wrong[compared]
        difference[compared], low[compared], high[compared] = _newcombe(k, n, failures - k, pictures - n)
        own = _likelihood_ratio(k, n, failures, pictures)
        shared = (one[some][compared].astype(np.int64) for one in tally.chance)
        most = np.sort([_likelihood_ratio(one, n, failures, pictures).max() for one in shared])
        p[compared] = (1 + len(most) - np.searchsorted(most, own - 1e-9)) / (1 + len(most))
    return Association(compared, difference, low, high, p)


def _likelihood_ratio(k: Counts, n: Counts, failures: int, pictures: int) -> Doubles:
    """Twice the log of how much likelier k of n, and the rest of the failures beside them, are with shares of their own
    than with one share: 0 or more."""
    counts = (k, n - k, failures - k, pictures - n - failures + k)
    sums = (n, pictures - n, np.array(failures), np.array(pictures - failures))
    told = xlogy(pictures, pictures) + sum(xlogy(one, one) for one in counts) - sum(xlogy(one, one) for one in sums)
    result: Doubles = 2.0 * told
    return result


def _newcombe(k: Counts, n: Counts, others: Counts, rest: Counts) -> tuple[Doubles, Doubles, Doubles]:
    """The difference k / n - others / rest, and both ends of its interval."""
    (one, below, above), (two, under, over) = _wilson(k, n), _wilson(others, rest)
    difference = one - two
    low = difference - np.hypot(one - below, over - two)
    high = difference + np.hypot(above - one, two - under)
    return difference, low, high


def _wilson(k: Counts, n: Counts) -> tuple[Doubles, Doubles, Doubles]:
    """The share k / n and both ends of its score interval."""
    z, share = float(ndtri((1.0 + CONFIDENCE) / 2.0)), k / n
    middle, half = share + z * z / (2 * n), z * np.sqrt(share * (1.0 - share) / n + z * z / (4.0 * n * n))
    return share, (middle - half) / (1.0 + z * z / n), (middle + half) / (1.0 + z * z / n)
