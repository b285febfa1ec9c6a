"""The policies `grid` and `sobol`: which points they take, in which order, and what they refuse."""

import math
from functools import partial
from typing import Any

import pytest
import torch
from torch import Tensor

from advsearch.attacks import (
    Block,
    Domain,
    Ending,
    Evaluation,
    Grid,
    Policy,
    Query,
    SearchResult,
    search,
    seeded,
)
from advsearch.errors import InputError


def flat(query: Query) -> Evaluation:
    return Evaluation(0.0, None, False)


def points(policy: Policy[Any], domain: Domain, steps: int, seed: int = 0) -> tuple[Tensor, SearchResult]:
    seen: list[Tensor] = []
    result = search(
        partial(map, flat),
        domain,
        policy,
        steps=steps,
        seed=seed,
        candidates=0,
        on_step=lambda record, u, evaluation: seen.append(u),
    )
    return torch.stack(seen), result


def test_a_grid_is_full_and_each_point_comes_once() -> None:
    domain = Domain(torch.tensor([0.5, 0.5, 0.1]), (Block(1, low=0.2, high=0.8), Block(1), Block(1, n_options=3)))
    seen, result = points(Grid(), domain, 40)
    assert result.stopped is Ending.STALLED
    assert len(seen) == 36  # 4 x 3 x 3; 5 x 3 x 3 and 4 x 4 x 3 are over 40
    assert len({tuple(u) for u in seen.tolist()}) == 36
    assert sorted(set(seen[:, 0].tolist())) == pytest.approx([0.2, 0.4, 0.6, 0.8])
    assert sorted(set(seen[:, 1].tolist())) == pytest.approx([0.0, 0.5, 1.0])
    assert sorted(set(seen[:, 2].tolist())) == pytest.approx([1 / 6, 0.5, 5 / 6])


def test_an_angle_does_not_repeat_its_end() -> None:
    domain = Domain(torch.tensor([0.5]), (Block(1, periodic=True),))
    seen, _ = points(Grid(), domain, 8)
    assert sorted(seen[:, 0].tolist()) == pytest.approx([k / 8 for k in range(8)])


def test_points_come_coarse_to_fine() -> None:
    line, _ = points(Grid(points=9), Domain(torch.tensor([0.5]), (Block(1),)), 9)
    assert line[:, 0].tolist() == pytest.approx([0.0, 1.0, 0.5, 0.25, 0.75, 0.125, 0.375, 0.625, 0.875])
    square, _ = points(Grid(points=5), Domain(torch.full((2,), 0.5), (Block(2),)), 25)
    assert {tuple(u) for u in square[:4].tolist()} == {(0, 0), (0, 1), (1, 0), (1, 1)}
    assert {tuple(u) for u in square[4:9].tolist()} == {(0, 0.5), (1, 0.5), (0.5, 0), (0.5, 1), (0.5, 0.5)}
    angle, _ = points(Grid(points=4), Domain(torch.tensor([0.5]), (Block(1, periodic=True),)), 4)
    assert angle[:, 0].tolist() == [0.0, 0.5, 0.25, 0.75]


def test_a_grid_in_a_ball() -> None:
    """An l-infinity ball is a box; the corners of the cube around an l2 ball are projected onto it."""
    cube, _ = points(Grid(), Domain(torch.full((3,), 0.5), (Block(3, "linf", 0.1),)), 8)
    assert sorted(set(cube.flatten().tolist())) == pytest.approx([0.4, 0.6])
    domain = Domain(torch.full((2,), 0.5), (Block(2, "l2", 0.1),))
    ball, _ = points(Grid(points=3), domain, 9)
    assert len({tuple(u) for u in ball.tolist()}) == 9
    lengths = (ball - 0.5).norm(dim=1)
    assert sorted(lengths.tolist()) == pytest.approx([0.0] + [0.1] * 8, abs=1e-6)


def test_a_grid_of_given_size_and_a_grid_that_does_not_fit() -> None:
    domain = Domain(torch.full((18,), 0.5), (Block(8, "linf", 0.1), Block(10)))
    with pytest.raises(InputError, match="262144 renders"):
        points(Grid(), domain, 40)
    with pytest.raises(InputError, match="are billions of renders"):
        points(Grid(), Domain(torch.full((50_000,), 0.5), (Block(50_000, "linf", 0.1),)), 40)
    with pytest.raises(InputError, match="32 renders"):
        points(Grid(), Domain(torch.full((3,), 0.5), (Block(2), Block(1, n_options=8))), 31)
    with pytest.raises(InputError, match="25 renders"):
        points(Grid(points=5), Domain(torch.full((2,), 0.5), (Block(2),)), 24)
    with pytest.raises(InputError, match="points"):
        Grid(points=1)


@pytest.mark.island("advsearch.attacks.policies.sobol")
@pytest.mark.parametrize("d", [1, 2, 3])
def test_an_l2_ball_is_filled_evenly(d: int) -> None:
    """The radius to the power d is uniform, and the mean direction is nothing."""
    from advsearch.attacks import Sobol

    domain = Domain(torch.full((d,), 0.5), (Block(d, "l2", 0.1),))
    seen, _ = points(Sobol(), domain, 1024)
    share = ((seen - 0.5).norm(dim=1) / 0.1) ** d
    assert torch.quantile(share, torch.tensor([0.1, 0.5, 0.9])).tolist() == pytest.approx([0.1, 0.5, 0.9], abs=0.03)
    assert float((seen - 0.5).mean(dim=0).abs().max()) < 0.002
    angles = sum(bool(u[0] > 0.5) for u in seen)
    assert abs(angles - 512) < 16


@pytest.mark.island("advsearch.attacks.policies.sobol")
def test_sobol_beats_random_in_two_dimensions() -> None:
    """The largest empty disc is smaller: the worst of 500 places is nearer to one of 64 points."""
    from advsearch.attacks import Random, Sobol

    domain = Domain(torch.full((2,), 0.5), (Block(2),))
    places = torch.rand(500, 2, generator=seeded(0, 0))

    def gap(policy: Policy[Any]) -> float:
        return sum(float(torch.cdist(places, points(policy, domain, 64, s)[0]).amin(1).max()) for s in range(5)) / 5

    assert gap(Sobol()) < 0.85 * gap(Random())
    assert math.isfinite(gap(Sobol()))
