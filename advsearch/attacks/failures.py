"""Many different failures: what a search may answer with beside the one worst configuration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from advsearch.attacks.failure_share import FailureShare

MOST = 24
"""Failures that an answer lists, at most."""


@dataclass(frozen=True, eq=False)
class FoundFailure:
    """A configuration that a search claims to be a success, and stands for others near it.

    Attributes:
        u: (d,) float32.
        objective: that of its one render; biased upwards where it is the largest of many.
        ranges: by position in u the low and the high end of where the others lie, in u.
    """

    u: Tensor
    objective: float
    ranges: dict[int, tuple[float, float]]


@dataclass(frozen=True, eq=False)
class Failures:
    """What a search knows of different failures.

    Attributes:
        listed: at most `MOST`.
        over: positions in u of what tells cells apart; none where there are no cells.
        found: how many failing cells there are; without cells, failing draws.
        seen: how many cells, or draws, were looked at, failing or not.
        places: how many cells there are; None without cells.
        share: how large a part of all configurations fails, where that can be told.
    """

    listed: tuple[FoundFailure, ...]
    over: tuple[int, ...]
    found: int
    seen: int
    places: int | None
    share: FailureShare | None = None


def most_different(at: Tensor, worst: Sequence[float], around: Tensor, apart: Tensor, most: int = MOST) -> list[int]:
    """Return which to list: the worst first, then each time the one that is farthest from all before it.

    That is the greedy choice of k centres, whose largest distance is at most twice the least possible (Gonzalez 1985,
    "Clustering to minimize the maximum intercluster distance"). Of equals the worse one goes first.

    Args:
        at: (n, k) where they are, in shares of each range.
        worst: (n,) objectives.
        around: (k,) bool: ranges whose ends are the same place.
        apart: (k,) bool: discrete choices, where different is 1 apart.
        most: how many to return at most.
    """
    order = sorted(range(len(at)), key=lambda number: -worst[number])
    at = at[order].double()
    nearest, picked = torch.full((len(at),), torch.inf, dtype=torch.float64), list[int]()
    for _ in range(min(most, len(at))):
        chosen = int(nearest.argmax())
        picked.append(chosen)
        away = (at - at[chosen]).abs()
        away = torch.where(around, torch.minimum(away, 1.0 - away), away)
        away = torch.where(apart, (away > 0.0).double(), away)
        nearest = torch.minimum(nearest, away.norm(dim=1))
        nearest[picked] = -1.0
    return [order[number] for number in picked]
