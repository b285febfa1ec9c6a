"""How many bounces of light the search of a problem renders."""

from __future__ import annotations

from collections.abc import Callable

import torch

from advsearch import seeds
from advsearch.engine.path_length import SHORTEST, measured_bounces
from advsearch.engine.problem import Problem
from advsearch.runs.results.derivatives import PathLength

DRAWS = 2
"""Configurations, beside the clean one, that the measurement looks at."""
SPP = 4
"""Samples a pixel: the same paths are compared, so that few are enough."""
WORTH = 200
"""Renders of a search from which the measurement pays; each path length costs a compilation."""


def most_pictures(problem: Problem) -> int:
    """Return how many pictures `bounces_of` renders at most."""
    return (1 + DRAWS) * 2 * (1 + problem.renderer.scene.max_depth - SHORTEST)


def bounces_of(problem: Problem, seed: int, tick: Callable[[], None] = lambda: None) -> PathLength:
    """Measure the bounces that a problem's search needs, over its clean configuration and random ones of its space.

    Args:
        problem: whose scene and space.
        seed: root of the noise and of the draws.
        tick: called after each picture.
    """
    drawn = [
        problem.domain.sample(torch.Generator().manual_seed(seeds.stream(seed, "bounces", number)))[0]
        for number in range(DRAWS)
    ]
    conditions = [seeds.stream(seed, "conditions of bounces", number) for number in range(DRAWS)]
    wholes = [problem.whole(problem.domain.start)]
    wholes += [problem.whole(u, draw) for u, draw in zip(drawn, conditions, strict=True)]
    return measured_bounces(problem.renderer, wholes, seed=seeds.stream(seed, "bounces"), spp=SPP, tick=tick)
