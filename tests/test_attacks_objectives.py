"""Objectives over label sets: values, gradients, extreme logits, and a user's own function with its mistakes."""

from __future__ import annotations

import math

import pytest
import torch

from advsearch.attacks import OBJECTIVES, Evaluation, get_objective, margin, stop_at_margin, succeeded
from advsearch.attacks.objectives import cross_entropy
from advsearch.errors import InputError, UnknownNameError

IMAGES = torch.zeros(2, 4, 4, 3)
LOGITS = torch.tensor([[3.0, 1.0, 2.0, -1.0], [0.0, 5.0, 1.0, 4.0]])


def test_margin_is_the_best_wrong_logit_minus_the_best_right_one() -> None:
    assert torch.allclose(margin(LOGITS, IMAGES, (0,)), torch.tensor([-1.0, 5.0]))
    assert torch.allclose(margin(LOGITS, IMAGES, (0, 2)), torch.tensor([-2.0, 4.0]))
    assert torch.allclose(margin(LOGITS, IMAGES, (1, 3)), torch.tensor([2.0, -4.0]))


def test_cross_entropy_is_minus_log_of_the_label_sets_probability() -> None:
    expected = -LOGITS.softmax(dim=1)[:, [0, 2]].sum(dim=1).log()
    assert torch.allclose(cross_entropy(LOGITS, IMAGES, (0, 2)), expected, rtol=1e-5)


def test_success_follows_the_label_set_alone() -> None:
    assert succeeded(LOGITS, (0,)).tolist() == [False, True]
    assert succeeded(LOGITS, (0, 1)).tolist() == [False, False]
    tie_and_nan = torch.tensor([[1.0, 1.0], [math.nan, 0.0]])
    assert succeeded(tie_and_nan, (0,)).tolist() == [False, False]


@pytest.mark.parametrize("name", sorted(OBJECTIVES))
@pytest.mark.parametrize("scale", [1.0, 1e3])
def test_every_objective_is_finite_per_image_and_grows_with_a_wrong_logit(name: str, scale: float) -> None:
    logits = (LOGITS * scale).clone().requires_grad_()
    values = OBJECTIVES[name](logits, IMAGES, (1, 3))
    assert values.shape == (2,)
    assert values.dtype == torch.float32
    assert bool(torch.isfinite(values).all())
    (gradient,) = torch.autograd.grad(values.sum(), logits)
    assert bool(torch.isfinite(gradient).all())
    wrong, right = [0, 2], [1, 3]
    assert bool((gradient[:, wrong] >= 0).all())
    assert bool((gradient[:, right] <= 0).all())
    assert float(gradient[0].abs().sum()) == pytest.approx(2.0, abs=0.4)  # the misread image pulls at full strength


@pytest.mark.parametrize("name", sorted(OBJECTIVES))
def test_every_objective_has_the_gradient_of_a_central_difference(name: str) -> None:
    logits = LOGITS.double().requires_grad_()
    assert torch.autograd.gradcheck(lambda z: OBJECTIVES[name](z, IMAGES, (0, 2)), (logits,))


def test_the_battery_knows_every_objective() -> None:
    assert set(OBJECTIVES) == {"margin", "cross_entropy"}, "a new objective needs a test of its values above"


def test_cross_entropy_of_huge_logits_neither_overflows_nor_cancels() -> None:
    logits = torch.tensor([[1000.0, -1000.0], [0.0, 12.0]])
    assert torch.allclose(cross_entropy(logits, IMAGES, (1,)), torch.tensor([2000.0, math.log1p(math.exp(-12.0))]))


def test_margin_keeps_its_gradient_where_the_model_is_certain() -> None:
    logits = torch.tensor([[1000.0, 0.0]], requires_grad=True)
    (gradient,) = torch.autograd.grad(margin(logits, IMAGES[:1], (0,)).sum(), logits)
    assert gradient.tolist() == [[-1.0, 1.0]]


@pytest.mark.parametrize(
    ("labels", "message"),
    [
        ((), r"--label: expected class indices from 0 to 3, got \(\)"),
        ((4,), "expected class indices from 0 to 3"),
        ((-1,), "expected class indices from 0 to 3"),
        ((0, 1, 2, 3), "holds all 4 classes"),
    ],
)
def test_a_bad_label_set_is_refused(labels: tuple[int, ...], message: str) -> None:
    with pytest.raises(InputError, match=message):
        margin(LOGITS, IMAGES, labels)


def test_logits_without_a_batch_axis_are_refused() -> None:
    with pytest.raises(InputError, match=r"expected logits of shape \(N, classes\), got \(4,\)"):
        margin(LOGITS[0], IMAGES, (0,))


def test_unknown_objectives_name_their_neighbours() -> None:
    with pytest.raises(UnknownNameError, match="Did you mean 'margin'"):
        get_objective("margins")
    with pytest.raises(InputError, match="expected a name or a function"):
        get_objective(3.0)  # type: ignore[arg-type]
    assert get_objective("margin") is margin
    assert get_objective(margin) is margin


def test_a_users_function_may_return_a_scalar_for_one_image() -> None:
    objective = get_objective(lambda logits, images, labels: logits[0, 1] + images.sum())
    assert objective(LOGITS[:1], IMAGES[:1], (0,)).tolist() == [1.0]


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda z, x, y: float(z.detach().sum()), r"expected a torch tensor of shape \(2,\), got float; .*\.item\(\)"),
        (lambda z, x, y: None, "got NoneType"),
        (lambda z, x, y: z.sum(), r"expected one value per image, shape \(2,\), got \(\)"),
        (lambda z, x, y: z, r"expected one value per image, shape \(2,\), got \(2, 4\)"),
        (lambda z, x, y: z.argmax(dim=1), "expected floating-point values, got torch.int64"),
        (lambda z, x, y: z.detach().sum(dim=1), "does not depend on logits or images differentiably"),
    ],
)
def test_a_users_mistakes_are_explained(function: object, message: str) -> None:
    objective = get_objective(function)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=message):
        objective(LOGITS.clone().requires_grad_(), IMAGES, (0,))


def test_a_detached_objective_is_allowed_where_no_gradient_is_wanted() -> None:
    objective = get_objective(lambda z, x, y: z.detach().sum(dim=1))
    with torch.no_grad():
        assert objective(LOGITS.clone().requires_grad_(), IMAGES, (0,)).shape == (2,)
    assert objective(LOGITS, IMAGES, (0,)).shape == (2,)


def test_what_a_users_function_raises_passes_through() -> None:
    def broken(logits: object, images: object, labels: object) -> torch.Tensor:
        raise ZeroDivisionError("mine")

    with pytest.raises(ZeroDivisionError, match="mine"):
        get_objective(broken)(LOGITS, IMAGES, (0,))


def test_stop_at_margin_looks_at_the_logits_not_at_the_objective() -> None:
    stop = stop_at_margin(1.5, (0,))
    assert stop(Evaluation(-99.0, None, torch.tensor([0.0, 2.0]), True))
    assert not stop(Evaluation(99.0, None, torch.tensor([0.0, 1.0]), True))
