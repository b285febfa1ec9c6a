"""Budgets: projections are exact, samples stay inside, and bad budgets are refused by name."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from advsearch.attacks.domain import TOLERANCE, Block, Domain, option_center, project_l2_box
from advsearch.errors import InputError

QP_TOLERANCE = 2e-5  # SLSQP stops here; the projection itself is exact to float32
ROUNDING = 2e-7  # a few units in the last place of values up to 1


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def ball(norm: str, epsilon: float, start: torch.Tensor) -> Domain:
    return Domain(start, (Block(start.numel(), norm, epsilon),))  # type: ignore[arg-type]


def brute_force(u: np.ndarray, centre: np.ndarray, radius: float) -> np.ndarray:
    """The projection onto ball and box as a quadratic program, solved by scipy."""
    answer = minimize(
        lambda p: ((p - u) ** 2).sum(),
        centre,
        jac=lambda p: 2 * (p - u),
        bounds=[(0.0, 1.0)] * len(u),
        constraints={
            "type": "ineq",
            "fun": lambda p: radius**2 - ((p - centre) ** 2).sum(),
            "jac": lambda p: -2 * (p - centre),
        },
        method="SLSQP",
        options={"ftol": 1e-12, "maxiter": 500},
    )
    return np.asarray(answer.x)


@pytest.mark.parametrize("seed", range(12))
def test_l2_projection_equals_a_quadratic_program(seed: int) -> None:
    rng = np.random.default_rng(seed)
    d = int(rng.integers(2, 7))
    centre = rng.random(d)
    centre[0] = seed % 2  # on a bound
    u = centre + rng.normal(size=d) * rng.choice([0.3, 1.0, 5.0])
    radius = float(rng.choice([0.05, 0.3, 1.0]))
    ours = project_l2_box(torch.tensor(u, dtype=torch.float32), torch.tensor(centre, dtype=torch.float32), radius)
    theirs = brute_force(u, centre, radius)
    assert np.linalg.norm(ours.numpy() - u) <= np.linalg.norm(theirs - u) + QP_TOLERANCE
    np.testing.assert_allclose(ours.numpy(), theirs, atol=2e-3)
    assert np.linalg.norm(ours.numpy() - centre) <= radius * (1 + 1e-5)


@pytest.mark.parametrize("norm", ["linf", "l2"])
def test_points_inside_come_back_bit_for_bit(norm: str) -> None:
    domain = ball(norm, 0.2, torch.full((50,), 0.5))
    u = domain.start + 0.02 * torch.randn(50, generator=generator())
    assert torch.equal(domain.project(u), u)


@pytest.mark.parametrize("norm", ["linf", "l2"])
def test_points_on_the_edge_stay_and_points_outside_land_on_it(norm: str) -> None:
    start = torch.full((4,), 0.5)
    domain = ball(norm, 0.2, start)
    edge = start + (torch.full((4,), 0.2) if norm == "linf" else torch.full((4,), 0.1))
    assert torch.allclose(domain.project(edge), edge, atol=1e-7)
    outside = start + 7 * (edge - start)
    assert torch.allclose(domain.project(outside), edge, atol=1e-6)


def test_linf_projection_is_a_clip_of_ball_and_box() -> None:
    domain = ball("linf", 0.2, torch.tensor([0.1, 0.5, 1.0]))
    projected = domain.project(torch.tensor([-3.0, 9.0, 1.1]))
    assert torch.allclose(projected, torch.tensor([0.0, 0.7, 1.0]))


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 10_000),
    st.integers(1, 40),
    st.floats(1e-3, 3.0),
    st.floats(1e-3, 100.0),
    st.sampled_from(["linf", "l2"]),
)
def test_projection_lies_inside_is_idempotent_and_nonexpansive(
    seed: int, d: int, epsilon: float, scale: float, norm: str
) -> None:
    rng = generator(seed)
    domain = ball(norm, epsilon, torch.rand(d, generator=rng))
    u, v = (domain.start + scale * torch.randn(d, generator=rng) for _ in range(2))
    p, q = domain.project(u), domain.project(v)
    assert domain.contains(p)
    assert torch.allclose(domain.project(p), p, rtol=0.0, atol=ROUNDING)
    assert float((p - q).norm()) <= float((u - v).norm()) * (1 + 1e-5) + 1e-6


def test_blocks_are_projected_each_in_its_own_norm() -> None:
    start = torch.full((7,), 0.5)
    blocks = (Block(2, "linf", 0.1), Block(3, "l2", 0.1), Block(2, "box", low=0.25, high=0.75))
    p = Domain(start, blocks).project(torch.tensor([9.0, 0.5, 0.5, 9.0, 0.5, 9.0, 0.3]))
    assert torch.allclose(p, torch.tensor([0.6, 0.5, 0.5, 0.6, 0.5, 0.75, 0.3]), atol=1e-6)


def test_a_periodic_block_wraps_around() -> None:
    domain = Domain(torch.tensor([0.9, 0.5]), (Block(2, periodic=True),))
    assert torch.allclose(domain.project(torch.tensor([1.25, -0.25])), torch.tensor([0.25, 0.75]))
    assert torch.equal(domain.project(torch.tensor([1.0, 0.0])), torch.tensor([1.0, 0.0]))


def test_a_discrete_choice_is_sampled_at_the_middle_of_its_options_and_has_no_uphill() -> None:
    domain = Domain(torch.tensor([0.5, 0.4]), (Block(1, n_options=3), Block(1)))
    values = domain.sample(generator(), 3000)[:, 0]
    options, counts = values.unique(return_counts=True)
    assert torch.allclose(options, torch.tensor([1 / 6, 0.5, 5 / 6]))
    assert int(counts.min()) > 900
    assert domain.compute_steepest_step(domain.start, torch.ones(2)).tolist() == [0.0, 0.5]
    u = torch.tensor([0.4, 0.4])
    assert torch.equal(domain.project(u), u)  # nothing snaps
    assert domain.project(torch.tensor([1.4, 0.4]))[0] == 1.0


def test_the_last_option_ends_at_one() -> None:
    assert option_center(torch.tensor([0.0, 0.24, 0.26, 0.99, 1.0]), 4).tolist() == [
        0.125, 0.125, 0.375, 0.875, 0.875,
    ]  # fmt: skip


def test_a_reach_shortens_the_step_in_a_box() -> None:
    domain = Domain(torch.full((4,), 0.5), (Block(4, unit_step_length=0.03),))
    assert float(domain.compute_steepest_step(domain.start, torch.ones(4)).norm()) == pytest.approx(0.03)


@pytest.mark.parametrize("extreme", [False, True])
@pytest.mark.parametrize("norm", ["linf", "l2", "box"])
def test_samples_lie_inside_and_repeat_with_the_seed(norm: str, extreme: bool) -> None:
    start = torch.rand(300, generator=generator(5))
    domain = Domain(start, (Block(300, norm, None if norm == "box" else 0.3),))  # type: ignore[arg-type]
    samples = domain.sample(generator(1), 8, extreme=extreme)
    assert samples.shape == (8, 300)
    assert samples.dtype == torch.float32
    assert all(domain.contains(u) for u in samples)
    assert torch.equal(samples, domain.sample(generator(1), 8, extreme=extreme))
    assert not torch.equal(samples[0], samples[1])


def test_extreme_samples_sit_at_the_extremes() -> None:
    start = torch.rand(400, generator=generator(5))
    corner = (linf := ball("linf", 0.2, start)).sample(generator(), extreme=True)[0]
    assert bool(((corner == linf.lower_bounds) | (corner == linf.upper_bounds)).all())
    assert 120 < int((corner == linf.upper_bounds).sum()) < 280  # signs are balanced
    surface = ball("l2", 0.7, start).sample(generator(), extreme=True)[0]
    assert float((surface - start).norm()) == pytest.approx(0.7, rel=1e-5)


def test_interior_samples_are_uniform_in_the_box_that_is_left() -> None:
    domain = ball("linf", 0.2, torch.tensor([0.1]))
    values = domain.sample(generator(), 4000)[:, 0]
    assert values.min() >= 0.0
    assert values.max() <= 0.3001
    assert float(values.mean()) == pytest.approx(0.15, abs=0.01)


def test_l2_samples_fill_the_ball_uniformly() -> None:
    domain = ball("l2", 0.4, torch.full((3,), 0.5))
    radii = (domain.sample(generator(), 3000) - 0.5).norm(dim=1) / 0.4
    assert float((radii**3).mean()) == pytest.approx(0.5, abs=0.02)  # r^d is uniform in [0, 1]


def test_contains_knows_outside_nan_and_wrong_shapes() -> None:
    domain = ball("l2", 0.2, torch.full((4,), 0.5))
    assert domain.contains(domain.start)
    assert not domain.contains(domain.start + 0.11)  # norm 0.22
    assert domain.contains(domain.start + 0.11, tolerance=0.03)
    assert not domain.contains(torch.full((4,), math.nan))
    assert not domain.contains(torch.tensor([0.5, 0.5, 0.5, math.nan]))
    assert not domain.contains(torch.tensor([0.5, 0.5, 0.5, math.inf]))
    assert not domain.contains(torch.full((5,), 0.5))


@pytest.mark.parametrize("norm", ["linf", "l2", "box"])
def test_the_steepest_step_beats_random_steps_of_its_length(norm: str) -> None:
    domain = Domain(torch.full((6,), 0.5), (Block(6, norm, None if norm == "box" else 0.1),))  # type: ignore[arg-type]
    gradient = torch.randn(6, generator=generator())
    step = domain.compute_steepest_step(domain.start, gradient)
    radius = domain.blocks[0].radius
    order = math.inf if norm == "linf" else 2
    assert float(torch.linalg.vector_norm(step, ord=order)) == pytest.approx(radius, rel=1e-5)
    others = torch.randn(200, 6, generator=generator(1))
    others *= radius / torch.linalg.vector_norm(others, ord=order, dim=1, keepdim=True)
    assert float(gradient @ step) >= float((others @ gradient).max())


def test_the_steepest_step_survives_zero_huge_and_tiny_gradients() -> None:
    for norm in ("linf", "l2"):
        domain = ball(norm, 0.1, torch.full((3,), 0.5))
        assert torch.equal(domain.compute_steepest_step(domain.start, torch.zeros(3)), torch.zeros(3))
        for scale in (1e38, 1e-37):
            step = domain.compute_steepest_step(domain.start, torch.tensor([scale, 0.0, 0.0]))
            assert torch.allclose(step, torch.tensor([0.1, 0.0, 0.0]))


def test_a_box_step_does_not_push_against_a_bound() -> None:
    domain = Domain(torch.tensor([1.0, 0.5]), (Block(2),))
    step = domain.compute_steepest_step(domain.start, torch.tensor([100.0, 1.0]))
    assert step[0] == 0.0
    assert float(step[1]) == pytest.approx(domain.blocks[0].radius)


@pytest.mark.parametrize("epsilon", [0.0, -0.1, math.nan, math.inf, None])
@pytest.mark.parametrize("norm", ["linf", "l2"])
def test_a_bad_epsilon_names_the_flag(norm: str, epsilon: float | None) -> None:
    with pytest.raises(InputError, match=r"`epsilon` of 'texture': expected a finite number over 0 .* got"):
        Block(3, norm, epsilon, name="texture")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Block(0), "expected a size of at least 1, got 0"),
        (lambda: Block(3, "l1", 0.1), "`norm`: expected one of linf, l2, box, got 'l1'"),  # type: ignore[arg-type]
        (lambda: Block(3, "box", 0.1), "has bounds and no norm budget; leave `epsilon` out"),
        (lambda: Block(3, low=0.5, high=0.5), r"expected 0 <= low < high <= 1, got \[0.5, 0.5\]"),
        (lambda: Block(3, "linf", 0.1, periodic=True), "a periodic block cannot have a norm budget"),
        (lambda: Block(2, n_options=3), "expected a discrete choice to have at least one option, size 1, norm 'box'"),
        (lambda: Block(1, n_options=-1), "expected a discrete choice to have at least one option"),
        (lambda: Block(1, periodic=True, n_options=3), "expected a discrete choice"),
        (lambda: Block(1, high=0.5, n_options=3), "expected a discrete choice"),
        (
            lambda: Block(2, "linf", 0.1, unit_step_length=0.1),
            "expected a reach over 0 and norm 'box', got 0.1 and 'linf'",
        ),
        (lambda: Block(2, unit_step_length=0.0), "expected a reach over 0 and norm 'box', got 0.0"),
        (lambda: Domain(torch.zeros(2), (Block(2),), gradient_cost=-1), "gradient_cost: expected at least 0, got -1"),
        (lambda: Domain(torch.zeros(3), (Block(2),)), r"expected shape \(2,\), the sum of the blocks, got \(3,\)"),
        (lambda: Domain(torch.tensor([0.0, 1.5]), (Block(2),)), r"expected values in \[0.0, 1.0\], got 0 to 1.5"),
        (lambda: Domain(torch.tensor([0.0, math.nan]), (Block(2),)), "start: found NaN or infinite values"),
    ],
)
def test_bad_blocks_and_starts_are_refused(make: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        make()  # type: ignore[operator]


def test_the_start_is_copied_and_kept_in_float32() -> None:
    start = torch.full((2,), 0.5, dtype=torch.float64)
    domain = Domain(start, (Block(2, "linf", 0.1),))
    start[0] = 0.9
    assert domain.start.dtype == torch.float32
    assert torch.equal(domain.start, torch.full((2,), 0.5))


def test_a_large_l2_projection_is_exact() -> None:
    d = 200_000  # several chunks, sums of many terms
    start = torch.rand(d, generator=generator())
    domain = ball("l2", 20.0, start)
    u = start + 0.3 * torch.randn(d, generator=generator(1))
    projected = domain.project(u)
    assert domain.violation(projected) <= TOLERANCE
    assert float((projected - start).double().norm()) == pytest.approx(20.0, rel=1e-6)
    free = (projected > 0) & (projected < 1)
    t = (projected - start)[free].double() / (u - start)[free].double()
    assert float(t.median()) == pytest.approx(float(t.mean()), rel=1e-3)  # one multiplier for all that is free
    bound = ~free
    reach = (start + float(t.median()) * (u - start))[bound]
    assert bool(((reach <= 1e-6) | (reach >= 1 - 1e-6)).all())  # what is clipped would have gone past its bound
