"""What an attack may spend: renders, by what they are for, and what is measured before the search."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from advsearch.attacks.sample_count import LADDER
from advsearch.scene.formation import next_count


@dataclass(frozen=True)
class RenderBudget:
    """How many renders an attack may spend, and on what.

    Attributes:
        steps: evaluations of each search, before its ranking.
        seconds: after which the search stops; None for no limit.
        close_looks: further renders of each of a search's best configurations, at most, while it is close between them.
        baseline: whether a random search with as many renders runs beside it.
        smallest: whether the smallest epsilon is sought, in several searches.
        trials: fresh renders of each group in the verification.
        ladder: samples a pixel that the verification climbs; a single count is taken as it is.
        average: random configurations of the space that are tried, to say how often the model is wrong on average.
    """

    steps: int = 0
    seconds: float | None = None
    close_looks: int = 0
    baseline: bool = False
    smallest: bool = False
    trials: int = 0
    ladder: Sequence[int] = LADDER
    average: int = 0


@dataclass(frozen=True)
class Preparation:
    """What is measured before a search.

    Attributes:
        measure: "no", "quick" to compare the valid estimators of each derivative, "full" to choose step and samples
            too.
        specialise: whether what the search does not need is left out.
        counted: whether estimators are compared by counted costs and not by seconds, so that a run can be repeated.
        chosen_spp: whether "full" may take other samples a pixel than were asked for.
    """

    measure: Literal["no", "quick", "full"] = "quick"
    specialise: bool = True
    counted: bool = False
    chosen_spp: bool = True


def verification_ladder(sampler: str, asked: int | None) -> Sequence[int]:
    """Return the sample counts that a verification climbs, as a sampler has them.

    Args:
        sampler: of pixels.
        asked: the only count, if one was asked for.
    """
    return LADDER if asked is None else (next_count(sampler, asked),)
