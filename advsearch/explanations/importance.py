"""Which factors decide, and which of them together: Sobol indices of the probability of a right answer.

Indices need configurations of a design of their own (Saltelli 2010), which a sweep has not. So they are those of a
forest that was fitted to the rows; `explained` says on other rows how much of the answers' variance it accounts for,
and where that is next to nothing no index is given. The indices and their intervals are SALib's (Herman and Usher
2017); the intervals are those of the design, not of the forest.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from advsearch import seeds
from advsearch.explanations.libraries import library
from advsearch.explanations.observations import Numbers, Observations

BASE_POINTS = 512
"""Base points of the design, a power of two; each factor adds twice as many."""
TREES, LEAF = 64, 10
LEAST_EXPLAINED = 0.02
MOST_FACTORS = 24
"""With more, the rows have to be read by the rules alone."""


@dataclass(frozen=True)
class FactorWeight:
    """What one factor, or two together, decide.

    Attributes:
        places: numbers of the factors.
        share: of the variance of the probability: by one factor alone, or by two beyond what each does alone.
        total: of one factor with everything that it does together with others; NaN for two.
        half_width: of the 95 % interval of `share`.
        total_half_width: of that of `total`; NaN for two.
    """

    places: tuple[int, ...]
    share: float
    total: float
    half_width: float
    total_half_width: float


@dataclass(frozen=True)
class Importance:
    """How much each factor decides.

    Attributes:
        explained: share of the variance of the answers that the forest accounts for, on rows that it was not fitted to.
        weights: single factors by falling total, then pairs by falling share; empty where too little is explained.
    """

    explained: float
    weights: tuple[FactorWeight, ...]


def find_importance(choosing: Observations, counting: Observations, seed: int) -> Importance | None:
    """Return which factors decide; None where the answers are all the same or there are too many factors.

    Args:
        choosing: rows that the forest is fitted to.
        counting: rows that say how good it is.
        seed: of forest and design.

    Raises:
        InputError: scikit-learn or SALib is missing.
    """
    factors = choosing.factors
    if len(set(choosing.right.tolist())) < 2 or len(set(counting.right.tolist())) < 2 or len(factors) > MOST_FACTORS:
        return None
    number = seeds.stream(seed, "importance") % 2**32
    forest = library("sklearn.ensemble").RandomForestRegressor(TREES, min_samples_leaf=LEAF, random_state=number)
    forest.fit(_columns(choosing.values, choosing), choosing.right.astype(float))
    off = counting.right - forest.predict(_columns(counting.values, choosing))
    explained = 1.0 - float((off**2).mean()) / float(counting.right.var())
    if explained < LEAST_EXPLAINED or len(factors) < 2:
        return Importance(explained, ())
    problem = {
        "num_vars": len(factors),
        "names": [one.name for one in factors],
        "bounds": [[0.0, 1.0]] * len(factors),
    }
    design = library("SALib.sample.sobol").sample(problem, BASE_POINTS, seed=number)
    values = np.stack([_spread(choosing, place, design[:, place]) for place in range(len(factors))], axis=1)
    found = library("SALib.analyze.sobol").analyze(
        problem, forest.predict(_columns(values, choosing)), seed=number, print_to_console=False
    )
    alone = [
        FactorWeight((k,), *(float(found[name][k]) for name in ("S1", "ST", "S1_conf", "ST_conf")))
        for k in range(len(factors))
    ]
    pairs = [
        FactorWeight((i, j), float(found["S2"][i, j]), np.nan, float(found["S2_conf"][i, j]), np.nan)
        for i, j in combinations(range(len(factors)), 2)
    ]
    shown = [one for one in pairs if one.share > max(one.half_width, LEAST_EXPLAINED)]
    return Importance(
        explained, (*sorted(alone, key=lambda one: -one.total), *sorted(shown, key=lambda one: -one.share))
    )


def _spread(found: Observations, place: int, uniform: Numbers) -> Numbers:
    """Return uniform numbers (n,) in [0, 1] as values that a factor took, each as often as it did."""
    column: Numbers = np.sort(found.values[:, place])[np.minimum((uniform * len(found)).astype(int), len(found) - 1)]
    return column


def _columns(values: Numbers, like: Observations) -> Numbers:
    """The columns that the forest is given: one for each option of a factor with options."""
    columns: list[Numbers] = []
    for place, factor in enumerate(like.factors):
        column = values[:, place]
        columns += [(column == one).astype(np.float64) for one in range(len(factor.options))] or [column]
    return np.stack(columns, axis=1)
