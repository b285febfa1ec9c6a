"""The archive of different failures: what it keeps, over which parameters, and how many cells it fills."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import pytest
import torch
from torch import Tensor

from advsearch.attacks import Block, Domain, Evaluation, Query, make_policy, search
from advsearch.attacks.policies.archive import ArchiveState, MapElites

pytestmark = pytest.mark.island("advsearch.attacks.policies.archive")

SIDE = 10
"""Cells over each of the first two numbers."""


def failing_cells(scene: str, policy: str, renders: int, noise: float, seed: int) -> set[tuple[int, int]]:
    """Return the cells of the first two numbers in which a search evaluates a configuration that is wrong.

    Args:
        scene: one of `SCENES`.
        policy: its name.
        renders: steps of the search.
        noise: of the objective, as a share of its deviation over the space.
        seed: of the search and of the noise.
    """
    domain, margin = SCENES[scene]
    sample = domain.sample(torch.Generator().manual_seed(99), 300)
    spread = float(torch.tensor([margin(u) for u in sample]).std())
    cells = set()

    def evaluate(query: Query) -> Evaluation:
        generator = torch.Generator().manual_seed(100_003 * seed + query.row_index)
        exact = margin(query.u)
        if exact > 0.0:
            first, second = (min(int(SIDE * float(value)), SIDE - 1) for value in query.u[:2])
            cells.add((first, second))
        noisy = exact + noise * spread * float(torch.randn(1, generator=generator))
        return Evaluation(noisy, None, noisy > 0.0)

    search(partial(map, evaluate), domain, make_policy(policy), steps=renders, seed=seed, candidates=0)
    return cells


def ball(u: Tensor) -> float:
    """Over 0 near a point of the last four numbers that moves with the first two."""
    center = 0.5 + 0.2 * torch.stack([u[0] - 0.5, u[1] - 0.5, 0.5 - u[0], u[0] - u[1]])
    return 0.25 - float((u[2:] - center).norm())


def corner(u: Tensor) -> float:
    """Over 0 where the last four numbers are large."""
    return float(u[2:].min()) - 0.65 - 0.1 * math.sin(6.0 * float(u[0])) * math.cos(4.0 * float(u[1]))


def choice(u: Tensor) -> float:
    """Over 0 under the third of six options, where two numbers lie in a band."""
    distance = abs(float(u[3]) - 0.3 - 0.4 * float(u[0])) + abs(float(u[4]) - 0.7 + 0.4 * float(u[1]))
    return 0.25 - distance - (0.0 if int(6 * float(u[2])) == 2 else 1.0)


BOX = Domain(torch.full((6,), 0.2), tuple(Block(1, name=f"number {k}") for k in range(6)))
MIXED = Domain(
    torch.full((5,), 0.25), tuple(Block(1, name=f"number {k}", n_options=6 if k == 2 else 0) for k in range(5))
)
SCENES: dict[str, tuple[Domain, Callable[[Tensor], float]]] = {
    "ball": (BOX, ball),
    "corner": (BOX, corner),
    "choice": (MIXED, choice),
}
"""Closed forms whose failures are rare: beside the two numbers of a cell the others have to be right."""


@pytest.mark.medium
@pytest.mark.parametrize("scene", ["ball", "corner", "choice"])
def test_three_times_as_many_cells_fail_as_in_random_search(scene: str) -> None:
    ours, theirs = (len(failing_cells(scene, policy, 300, 0.2, 3)) for policy in ("archive", "random"))
    assert theirs > 0 and ours >= 3 * max(theirs, 10)


def test_a_cell_keeps_the_largest_objective_and_nothing_that_could_not_be_evaluated() -> None:
    domain = Domain(torch.tensor([0.5, 0.5]), (Block(1, name="a"), Block(1, name="b")))
    policy = MapElites(over="a", cells=2, population=4)
    state = policy.start(domain, torch.Generator().manual_seed(0), 100)
    points = [torch.tensor(point) for point in ([0.1, 0.2], [0.2, 0.9], [0.3, 0.4], [0.8, 0.8])]
    values = [1.0, 3.0, -math.inf, -math.inf]
    state = ArchiveState(**{**vars(state), "points": torch.stack(points)})
    told = [(u, Evaluation(value, None, value > 2.0)) for u, value in zip(points, values, strict=True)]
    kept = policy.update(state, told).archive.data()
    assert kept["objective"].tolist() == [3.0]
    assert kept["wrong"].tolist() == [True]
    assert kept["solution"][0].tolist() == pytest.approx([0.2, 0.9])


def test_failing_cells_are_told_with_their_ends_and_those_of_a_generation_that_is_not_whole() -> None:
    domain = Domain(torch.tensor([0.5, 0.5]), (Block(1, name="a"), Block(1, name="b", n_options=2)))
    policy = MapElites(over="a,b", cells=4, population=5)
    state = policy.start(domain, torch.Generator().manual_seed(0), 100)
    points = [torch.tensor(point) for point in ([0.1, 0.25], [0.2, 0.25], [0.3, 0.25], [0.8, 0.75])]
    state = replace(state, points=torch.stack([*points, points[0]]))
    told = [(u, Evaluation(v, None, v > 1.5)) for u, v in zip(points, [2.0, 3.0, 1.0, 4.0], strict=True)]
    known = policy.failures(policy.update(state, told))
    assert (known.cell_parameter_indices, known.n_failures, known.n_visited, known.n_cells) == ((0, 1), 2, 3, 8)
    assert [one.objective for one in known.examples] == [4.0, 3.0]
    assert known.examples[1].u.tolist() == pytest.approx([0.2, 0.25])
    assert [one.ranges for one in known.examples] == [{0: (0.75, 1.0), 1: (0.5, 1.0)}, {0: (0.0, 0.25), 1: (0.0, 0.5)}]
