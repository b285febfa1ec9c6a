"""Objectives over label sets: values, one battery for all of them and all their forms, and a user's own function."""

import math
from collections.abc import Callable
from itertools import product

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from advsearch import losses
from advsearch.attacks import OBJECTIVES, get_objective, margin
from advsearch.attacks.objective_functions import (
    MAX_LOG_ODDS,
    NEARBY,
    RELIEF,
    cross_entropy,
    dlr,
    feature_distance,
    targeted_cross_entropy,
    targeted_dlr,
    targeted_margin,
)
from advsearch.attacks.objectives import OBJECTIVE_KINDS
from advsearch.tasks import Classification

IMAGES = torch.zeros(2, 4, 4, 3)
LOGITS = torch.tensor([[3.0, 1.0, 2.0, -1.0], [0.0, 5.0, 1.0, 4.0]])


def slope(objective: Callable[..., Tensor], logits: Tensor, labels: tuple[int, ...]) -> Tensor:
    """The gradient of an objective with respect to the logits."""
    leaf = logits.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(objective(leaf, torch.zeros(len(leaf), 4, 4, 3), labels).sum(), leaf)
    return gradient


def test_margin_is_the_best_wrong_logit_minus_the_best_right_one() -> None:
    assert torch.allclose(margin(LOGITS, IMAGES, (0,)), torch.tensor([-1.0, 5.0]))
    assert torch.allclose(margin(LOGITS, IMAGES, (0, 2)), torch.tensor([-2.0, 4.0]))
    assert torch.allclose(margin(LOGITS, IMAGES, (1, 3)), torch.tensor([2.0, -4.0]))


def test_targeted_margin_is_over_0_exactly_where_the_answer_is_in_the_target() -> None:
    assert torch.allclose(targeted_margin(LOGITS, IMAGES, (1,)), torch.tensor([-2.0, 1.0]))
    assert torch.allclose(targeted_margin(LOGITS, IMAGES, (1, 2)), torch.tensor([-1.0, 1.0]))
    logits = torch.randn(500, 6, generator=torch.Generator().manual_seed(0))
    hit = torch.isin(logits.argmax(dim=1), torch.tensor([2, 5]))
    assert torch.equal(targeted_margin(logits, logits, (2, 5)) > 0, hit)


def test_cross_entropy_is_minus_log_of_the_label_sets_probability() -> None:
    probability = LOGITS.softmax(dim=1)[:, [0, 2]].sum(dim=1)
    assert torch.allclose(cross_entropy(LOGITS, IMAGES, (0, 2)), -probability.log(), rtol=1e-5)
    assert torch.allclose(targeted_cross_entropy(LOGITS, IMAGES, (0, 2)), probability.log(), rtol=1e-5)


def test_cross_entropy_goes_on_as_its_tangent_where_the_model_is_sure() -> None:
    sure = torch.tensor([[0.0, -MAX_LOG_ODDS - 1e-3], [0.0, -MAX_LOG_ODDS + 1e-3], [0.0, 1000.0]], dtype=torch.float64)
    values = cross_entropy(sure, sure, (1,))
    assert float(values[0] - values[1]) == pytest.approx(2e-3 * math.exp(MAX_LOG_ODDS), rel=1e-3)  # no jump
    gradient = slope(cross_entropy, sure, (1,))
    assert gradient[:, 0].tolist() == pytest.approx([math.exp(MAX_LOG_ODDS)] * 3, rel=2e-3)  # no kink, and no end
    assert float(values[2]) == pytest.approx(-(1000 + MAX_LOG_ODDS) * math.exp(MAX_LOG_ODDS), rel=2e-3)


def test_dlr_is_the_published_ratio_where_the_model_is_right() -> None:
    logits = 5.0 * torch.randn(400, 12, generator=torch.Generator().manual_seed(1))
    right = logits.argmax(dim=1)
    for row, label in zip(logits, right.tolist(), strict=True):
        first, second, third = row.sort(descending=True).values[:3]
        published = -(first - second) / (first - third)
        ours = dlr(row[None], IMAGES, (label,))
        # what RELIEF adds counts for more where three logits are close together
        spread = RELIEF * float((row.max() - row.min()) / (first - third))
        assert float(ours) == pytest.approx(float(published), rel=2 * spread)


def test_targeted_dlr_is_the_published_ratio_where_the_right_label_leads() -> None:
    logits = torch.tensor([[9.0, 6.0, 5.0, 3.0, 1.0]])
    for target, published in ((1, -(9 - 6) / (9 - 4)), (4, -(9 - 1) / (9 - 4))):
        assert float(targeted_dlr(logits, IMAGES, (target,))) == pytest.approx(published, rel=10 * RELIEF)
    led_by_a_third = torch.tensor([[5.0, 6.0, 9.0, 3.0, 1.0]])
    assert float(targeted_dlr(led_by_a_third, IMAGES, (1,))) < 0  # published: over 0, since 1 beats 0


FORMS = {
    "plain": Classification(),
    "targeted": Classification(target=(2, 4)),
    "minimised": Classification(minimise=True),
}
RIGHT = (0, 3)
LARGE = (1.0, 1e3, 1e4)

EXTREMES = {
    "all equal": [0.0] * 6,
    "a tie at the top": [5.0, 5.0, 0.0, 1.0, 2.0, 3.0],
    "a tie of the wrong": [5.0, 3.0, 3.0, 0.0, 3.0, 3.0],
    "a tie of the right": [5.0, 3.0, 1.0, 5.0, 0.0, 2.0],
    "sure and right": [10.0, 1.0, 0.0, -2.0, 2.0, 3.0],
    "sure and wrong": [0.0, 10.0, 1.0, -2.0, 2.0, 3.0],
    "sure of the target": [0.0, 1.0, 10.0, -2.0, 2.0, 3.0],
    "all others tied": [10.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    "a tie above the target": [5.0, 5.0, 0.0, 5.0, 0.0, 5.0],
}


def form(name: str, chosen: str) -> Callable[[Tensor, tuple[int, ...]], Tensor]:
    """An objective as a function of logits, whatever it is made from: pictures stand in for the features."""
    if OBJECTIVE_KINDS[name].needs_features:
        objective = feature_distance(lambda images: images.flatten(1), torch.arange(6.0).reshape(1, 1, 2, 3))
        return lambda logits, labels: objective(logits, logits.reshape(-1, 1, 2, 3), labels)
    found = get_objective(name, FORMS[chosen])
    return lambda logits, labels: found(logits, torch.zeros(len(logits), 1, 2, 3), labels)


def all_forms() -> list[tuple[str, str]]:
    return [
        (name, chosen)
        for name, kind in OBJECTIVE_KINDS.items()
        if kind.task in (None, "classification")  # those of other tasks: tests/tasks
        for chosen in FORMS
        if chosen == "plain" or not kind.needs_features
    ]


every_form = pytest.mark.parametrize(("name", "chosen"), all_forms())
every_form_of_logits = pytest.mark.parametrize(("name", "chosen"), [one for one in all_forms() if one[0] in OBJECTIVES])


@every_form
def test_the_gradient_neither_vanishes_nor_overflows(name: str, chosen: str) -> None:
    objective = form(name, chosen)
    for scale, extreme, right in product(LARGE, EXTREMES, (RIGHT, (0,))):
        logits = (scale * torch.tensor([EXTREMES[extreme]])).requires_grad_()
        values = objective(logits, right)
        assert values.shape == (1,) and values.dtype == torch.float32
        assert bool(torch.isfinite(values).all())
        (gradient,) = torch.autograd.grad(values.sum(), logits)
        assert bool(torch.isfinite(gradient).all())
        largest = float(gradient.abs().max()) * (scale if name == "dlr" else 1.0)  # of a ratio it falls with the scale
        assert largest > (1e-7 if name == "cross_entropy" else 1e-2)


@every_form
@pytest.mark.parametrize("scale", LARGE)
def test_a_step_along_the_gradient_raises_the_value(name: str, chosen: str, scale: float) -> None:
    logits = scale * torch.randn(200, 6, generator=torch.Generator().manual_seed(3))
    objective = form(name, chosen)
    leaf = logits.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(objective(leaf, RIGHT).sum(), leaf)
    step = 1e-3 * scale * gradient / gradient.norm(dim=1, keepdim=True)
    with torch.no_grad():
        before, after = objective(logits, RIGHT), objective(logits + step, RIGHT)
    assert bool((after > before).all())


@every_form_of_logits
def test_the_gradient_is_that_of_a_central_difference(name: str, chosen: str) -> None:
    objective = form(name, chosen)
    logits = torch.randn(7, 6, generator=torch.Generator().manual_seed(4), dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(lambda z: objective(z, RIGHT), (logits,))


@every_form
def test_images_of_a_batch_do_not_know_of_each_other(name: str, chosen: str) -> None:
    logits = torch.randn(9, 6, generator=torch.Generator().manual_seed(5))
    objective = form(name, chosen)
    one_by_one = torch.cat([objective(row[None], RIGHT) for row in logits])
    assert torch.allclose(objective(logits, RIGHT), one_by_one, rtol=1e-6)


@every_form
def test_nan_stays_nan_and_with_its_image(name: str, chosen: str) -> None:
    logits = torch.randn(3, 6, generator=torch.Generator().manual_seed(6))
    logits[1] = math.nan
    values = form(name, chosen)(logits, RIGHT)
    assert torch.isnan(values).tolist() == [False, True, False]


CLEAN = torch.tensor([3.0, 0.0, 4.0]).reshape(1, 1, 3)


def test_feature_distance_has_its_full_gradient_at_the_clean_picture() -> None:
    objective = feature_distance(lambda images: images.flatten(1), CLEAN)
    image = CLEAN[None].clone().requires_grad_()
    (gradient,) = torch.autograd.grad(objective(LOGITS[:1], image, (0,)).sum(), image)
    assert float(gradient.norm()) == pytest.approx(1 / (math.sqrt(2) * 5.0), rel=1e-4)  # the clean length is 5
    far = (CLEAN[None] + torch.tensor([0.0, 3.0, 0.0])).requires_grad_()
    (gradient,) = torch.autograd.grad(objective(LOGITS[:1], far, (0,)).sum(), far)
    assert gradient.flatten().tolist() == pytest.approx([0.0, 1 / 5.0, 0.0], abs=2 * NEARBY / 5)


def test_a_users_function_gets_the_target_and_is_negated_too() -> None:
    def score(logits: Tensor, images: Tensor, labels: Tensor) -> Tensor:
        return logits[:, labels[0]]

    assert get_objective(score)(LOGITS, IMAGES, (0,)).tolist() == [3.0, 0.0]
    assert get_objective(score, Classification(target=(2,)))(LOGITS, IMAGES, (0,)).tolist() == [2.0, 1.0]
    assert get_objective(score, Classification(minimise=True))(LOGITS, IMAGES, (0,)).tolist() == [-3.0, 0.0]


LOSSES = [F.cross_entropy, nn.CrossEntropyLoss(), lambda z, x, y: F.cross_entropy(z, y), losses.cross_entropy]


@pytest.mark.parametrize("loss", LOSSES)
def test_a_loss_of_torch_is_an_objective(loss: Callable[..., Tensor]) -> None:
    """By itself, or in a function; one right answer comes as torch takes it, for each picture."""
    found = get_objective(loss)(LOGITS, IMAGES, (2,))
    assert torch.allclose(found, -LOGITS.log_softmax(dim=1)[:, 2])
