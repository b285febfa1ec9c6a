"""Objectives over label sets: values, one battery for all of them and all their forms, and a user's own function."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from itertools import product
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from advsearch import losses
from advsearch.attacks import OBJECTIVES, get_objective, margin, objective_functions
from advsearch.attacks.objective_functions import (
    MAX_LOG_ODDS,
    NEARBY,
    RELIEF,
    cross_entropy,
    dlr,
    feature_distance,
    log_odds,
    targeted_cross_entropy,
    targeted_dlr,
    targeted_log_odds,
    targeted_margin,
)
from advsearch.attacks.objectives import OBJECTIVE_KINDS, check_objective, list_requested_inputs, objective_summaries
from advsearch.engine import judging
from advsearch.errors import InputError, UnknownNameError
from advsearch.models import load_model
from advsearch.tasks import Classification
from advsearch.tasks.depth import GOALS as DEPTH_GOALS
from advsearch.tasks.detection import GOALS
from conftest import ROOT

IMAGES = torch.zeros(2, 4, 4, 3)
LOGITS = torch.tensor([[3.0, 1.0, 2.0, -1.0], [0.0, 5.0, 1.0, 4.0]])


def slope(objective: Callable[..., Tensor], logits: Tensor, labels: tuple[int, ...]) -> Tensor:
    """The gradient of an objective with respect to the logits."""
    leaf = logits.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(objective(leaf, torch.zeros(len(leaf), 4, 4, 3), labels).sum(), leaf)
    return gradient


# ---- values ---------------------------------------------------------------------------------------------------------


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


def test_log_odds_are_those_of_the_label_sets_probability() -> None:
    probability = LOGITS.softmax(dim=1)[:, [0, 2]].sum(dim=1)
    assert torch.allclose(log_odds(LOGITS, IMAGES, (0, 2)), ((1 - probability) / probability).log(), rtol=1e-5)
    assert torch.allclose(targeted_log_odds(LOGITS, IMAGES, (0, 2)), -log_odds(LOGITS, IMAGES, (0, 2)))


def test_log_odds_rank_as_cross_entropy_and_stay_near_the_margin() -> None:
    logits = 20.0 * torch.randn(500, 10, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    odds, entropy = log_odds(logits, logits, (3, 4)), cross_entropy(logits, logits, (3, 4))
    assert torch.equal(odds.argsort(), entropy.argsort())
    assert float((odds - margin(logits, logits, (3, 4))).abs().max()) <= math.log(10)


def test_cross_entropy_of_huge_logits_neither_overflows_nor_cancels() -> None:
    logits = torch.tensor([[1000.0, -1000.0], [0.0, 12.0]])
    assert torch.allclose(cross_entropy(logits, IMAGES, (1,)), torch.tensor([2000.0, math.log1p(math.exp(-12.0))]))


def test_cross_entropy_goes_on_as_its_tangent_where_the_model_is_sure() -> None:
    sure = torch.tensor([[0.0, -MAX_LOG_ODDS - 1e-3], [0.0, -MAX_LOG_ODDS + 1e-3], [0.0, 1000.0]], dtype=torch.float64)
    values = cross_entropy(sure, sure, (1,))
    assert float(values[0] - values[1]) == pytest.approx(2e-3 * math.exp(MAX_LOG_ODDS), rel=1e-3)  # no jump
    gradient = slope(cross_entropy, sure, (1,))
    assert gradient[:, 0].tolist() == pytest.approx([math.exp(MAX_LOG_ODDS)] * 3, rel=2e-3)  # no kink, and no end
    assert float(values[2]) == pytest.approx(-(1000 + MAX_LOG_ODDS) * math.exp(MAX_LOG_ODDS), rel=2e-3)


#: Worked out by hand: label 0 is right, then wrong with the label second, third and last.
RATIOS = [
    ([4.0, 3.0, 2.0, 0.0], -1.0 / 2.0),
    ([3.0, 4.0, 2.0, 0.0], 1.0 / 3.0),
    ([2.0, 4.0, 3.0, 0.0], 2.0 / 3.0),
    ([0.0, 4.0, 3.0, 2.0], 4.0 / 3.0),
]


@pytest.mark.parametrize(("logits", "expected"), RATIOS)
def test_dlr_is_the_margin_over_a_distance_between_logits(logits: list[float], expected: float) -> None:
    assert float(dlr(torch.tensor([logits]), IMAGES, (0,))) == pytest.approx(expected, rel=10 * RELIEF)


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


def test_several_right_labels_count_as_one_class_for_dlr() -> None:
    logits = torch.tensor([[9.0, 9.0, 9.0, 9.0, 3.0, 2.0, 1.0]])
    assert float(dlr(logits, IMAGES, (0, 1, 2, 3))) == pytest.approx(-6.0 / 7.0, rel=10 * RELIEF)


@pytest.mark.parametrize("function", [dlr, targeted_dlr])
@pytest.mark.parametrize(("scale", "offset"), [(1e4, 0.0), (1e-4, 0.0), (1.0, 1000.0)])
def test_dlr_knows_neither_scale_nor_offset(function: Callable[..., Tensor], scale: float, offset: float) -> None:
    logits = torch.randn(50, 8, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    expected = function(logits, logits, (2, 3))
    assert torch.allclose(function(scale * logits + offset, logits, (2, 3)), expected, rtol=1e-9)


def test_dlr_has_a_gradient_where_the_published_ratio_is_constant() -> None:
    third = torch.tensor([[2.0, 4.0, 3.0, 0.0]])
    assert slope(dlr, third, (0,))[0].tolist() == pytest.approx([-2 / 9, 1 / 9, 0.0, 1 / 9], rel=10 * RELIEF, abs=1e-6)


@pytest.mark.parametrize(("function", "setting"), [(dlr, "label"), (targeted_dlr, "target")])
def test_dlr_needs_two_classes_beside_the_label_set(function: Callable[..., Tensor], setting: str) -> None:
    message = f"at least 2 classes beside the 3 of `{setting}`, got 1; .* use `objective=margin`"
    with pytest.raises(InputError, match=message):
        function(LOGITS, IMAGES, (0, 1, 2))
    assert function(LOGITS, IMAGES, (0, 1)).shape == (2,)


# ---- the battery: every objective in every form ---------------------------------------------------------------------

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


def test_the_battery_knows_every_objective() -> None:
    known = {"margin", "log_odds", "cross_entropy", "dlr", "feature_distance", "score"}
    assert {name for name, _ in all_forms()} == known, "a new objective needs a test of its values above"
    assert set(OBJECTIVE_KINDS) - known == {*GOALS, *DEPTH_GOALS, "pixel_margin", "distance", "each"}
    assert set(OBJECTIVES) == {name for name, kind in OBJECTIVE_KINDS.items() if kind.plain is not None}
    for name, kind in OBJECTIVE_KINDS.items():
        assert kind.name == name and kind.unit and kind.summary == objective_summaries()[name]


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


@every_form_of_logits
def test_a_thousand_classes_and_almost_all_of_them_right(name: str, chosen: str) -> None:
    logits = 1e4 * torch.randn(4, 1000, generator=torch.Generator().manual_seed(7))
    objective = get_objective(name, FORMS[chosen])
    right = tuple(i for i in range(1000) if i not in (2, 4, 5))
    gradient = slope(objective, logits, right)
    assert bool(torch.isfinite(gradient).all()) and bool((gradient.abs().amax(dim=1) > 0).all())


def test_the_gradient_comes_through_a_network_that_answers_with_probabilities() -> None:
    """Log-odds of 60: the right class rounds to a probability of 1, the others to no more than 1e-26."""
    image, weight = torch.full((1, 1, 1, 3), 0.5), torch.zeros(6, 3)
    weight[:, 0] = torch.tensor([120.0, 0.0, -3.0, 1.0, 2.0, -1.0])

    class Softmax(nn.Module):
        def forward(self, x: Tensor) -> Tensor:
            return (x.flatten(1) @ weight.T).softmax(dim=1)

    with pytest.warns(UserWarning, match="returns probabilities"):
        model = load_model(Softmax(), input_size=1)
    leaf = image.clone().requires_grad_()
    logits = model(leaf)
    assert float(logits.exp()[0, 0].detach()) == 1.0
    for name in OBJECTIVES:
        value = get_objective(name)(logits, leaf, (0,))
        (gradient,) = torch.autograd.grad(value.sum(), leaf, retain_graph=True)
        assert bool(torch.isfinite(gradient).all())
        # the scale of the logits, which dlr takes out, is here the scale of the gradient
        assert name == "dlr" or float(gradient[0, 0, 0, 0]) < -1e-5


# ---- the distance of features ---------------------------------------------------------------------------------------

CLEAN = torch.tensor([3.0, 0.0, 4.0]).reshape(1, 1, 3)


def distance_of(offset: list[float], clean: Tensor = CLEAN) -> Tensor:
    objective = feature_distance(lambda images: images.flatten(1), clean)
    return objective(LOGITS[:1], (clean + torch.tensor(offset))[None], (0,))


def test_feature_distance_is_in_lengths_of_the_clean_features() -> None:
    assert float(distance_of([0.0, 0.0, 0.0])) == pytest.approx(0.0, abs=1e-9)
    assert float(distance_of([0.0, 5.0, 0.0])) == pytest.approx(1.0, abs=3 * NEARBY)
    assert float(distance_of([-3.0, 0.0, -4.0])) == pytest.approx(1.0, abs=3 * NEARBY)


def test_feature_distance_has_its_full_gradient_at_the_clean_picture() -> None:
    objective = feature_distance(lambda images: images.flatten(1), CLEAN)
    image = CLEAN[None].clone().requires_grad_()
    (gradient,) = torch.autograd.grad(objective(LOGITS[:1], image, (0,)).sum(), image)
    assert float(gradient.norm()) == pytest.approx(1 / (math.sqrt(2) * 5.0), rel=1e-4)  # the clean length is 5
    far = (CLEAN[None] + torch.tensor([0.0, 3.0, 0.0])).requires_grad_()
    (gradient,) = torch.autograd.grad(objective(LOGITS[:1], far, (0,)).sum(), far)
    assert gradient.flatten().tolist() == pytest.approx([0.0, 1 / 5.0, 0.0], abs=2 * NEARBY / 5)


def test_gradient_ascent_without_noise_leaves_the_clean_picture() -> None:
    """The features move fastest along the first axis, ten times as fast as along the others: it ends up there."""
    stretch = torch.tensor([1.0, 0.1, 0.1])
    objective = feature_distance(lambda images: images.flatten(1) * stretch, CLEAN)
    image = CLEAN[None].clone()
    for _ in range(30):
        leaf = image.clone().requires_grad_()
        (gradient,) = torch.autograd.grad(objective(LOGITS[:1], leaf, (0,)).sum(), leaf)
        image = image + 0.1 * gradient / gradient.norm()
    moved = (image - CLEAN).flatten().abs()
    assert float(moved[0]) > 2.5 and float(moved[1:].max()) < 0.5


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e10])
def test_feature_distance_does_not_know_the_scale_of_the_features(scale: float) -> None:
    objective = feature_distance(lambda images: images.flatten(1) * scale, CLEAN)
    image = (CLEAN[None] + 1.0).requires_grad_()
    value = objective(LOGITS[:1], image, (0,))
    assert float(value.detach()) == pytest.approx(math.sqrt(3.0) / 5.0, abs=3 * NEARBY)
    (gradient,) = torch.autograd.grad(value.sum(), image)
    assert float(gradient.norm()) == pytest.approx(1 / 5.0, abs=3 * NEARBY)


def test_clean_features_of_zero_have_a_length_of_1() -> None:
    assert float(distance_of([0.0, 2.0, 0.0], torch.zeros(1, 1, 3))) == pytest.approx(2.0, abs=3 * NEARBY)


def test_several_clean_renders_are_averaged() -> None:
    clean = torch.stack([CLEAN + 0.5, CLEAN - 0.5])
    objective = feature_distance(lambda images: images.flatten(1), clean)
    assert float(objective(LOGITS[:1], CLEAN[None], (0,))) == pytest.approx(0.0, abs=1e-6)


def test_feature_distance_is_the_same_every_time_and_has_a_name() -> None:
    first, second = (distance_of([0.1, 0.2, 0.3]) for _ in range(2))
    assert torch.equal(first, second)
    assert feature_distance(lambda images: images.flatten(1), CLEAN).__name__ == "feature_distance"


def test_feature_distance_refuses_what_it_cannot_measure() -> None:
    with pytest.raises(InputError, match=r"expected features of shape \(N, F\), got \(1, 1, 1, 3\)"):
        feature_distance(lambda images: images, CLEAN)
    with pytest.raises(InputError, match="expected finite features of the clean picture"):
        feature_distance(lambda images: images.flatten(1), CLEAN * math.nan)
    with pytest.raises(InputError, match="expected the model's features and a clean picture, got none"):
        get_objective("feature_distance")
    found = get_objective("feature_distance", features=lambda images: images.flatten(1), clean=CLEAN)
    assert float(found(LOGITS[:1], CLEAN[None], (0,))) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"targeted": True}, "target: expected `objective` margin or .* got feature_distance; it leads away"),
        ({"minimise": True}, "minimise: expected `objective` margin or .* it is least at the start"),
    ],
)
def test_feature_distance_knows_no_class_and_no_way_back(asked: dict[str, Any], message: str) -> None:
    check_objective("feature_distance")
    with pytest.raises(InputError, match=message):
        check_objective("feature_distance", **asked)


# ---- names, targets, and the user's own -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("labels", "message"),
    [
        ((), r"label: expected class indices from 0 to 3, got \(\)"),
        ((4,), "expected class indices from 0 to 3"),
        ((-1,), "expected class indices from 0 to 3"),
        ((0, 1, 2, 3), "holds all 4 classes, so no prediction could be wrong"),
    ],
)
@pytest.mark.parametrize("name", sorted(OBJECTIVES))
def test_a_bad_label_set_is_refused(name: str, labels: tuple[int, ...], message: str) -> None:
    with pytest.raises(InputError, match=message):
        OBJECTIVES[name](LOGITS, IMAGES, labels)


def test_a_bad_target_is_refused() -> None:
    with pytest.raises(InputError, match=r"target: expected class indices from 0 to 3, got \(9,\)"):
        get_objective("margin", Classification(target=(9,)))(LOGITS, IMAGES, (0,))
    with pytest.raises(InputError, match="minimise: expected no `target` beside it"):
        check_objective("margin", targeted=True, minimise=True)


def test_logits_without_a_batch_axis_are_refused() -> None:
    with pytest.raises(InputError, match=r"expected logits of shape \(N, classes\), got \(4,\)"):
        margin(LOGITS[0], IMAGES, (0,))


def test_unknown_objectives_name_their_neighbours() -> None:
    with pytest.raises(UnknownNameError, match="Did you mean 'margin'"):
        get_objective("margins")
    with pytest.raises(InputError, match="expected a name or a function"):
        get_objective(3.0)  # type: ignore[arg-type]
    for same in ("margin", margin):
        assert torch.equal(get_objective(same)(LOGITS, IMAGES, (0,)), margin(LOGITS, IMAGES, (0,)))


def test_forms_are_called_with_the_right_labels() -> None:
    targeted = get_objective("margin", Classification(target=(2,)))
    assert torch.equal(targeted(LOGITS, IMAGES, (0,)), targeted_margin(LOGITS, IMAGES, (2,)))
    assert torch.equal(
        get_objective(margin, Classification(target=(2,)))(LOGITS, IMAGES, (0,)), targeted(LOGITS, IMAGES, (0,))
    )
    minimised = get_objective("margin", Classification(minimise=True))
    assert torch.equal(minimised(LOGITS, IMAGES, (0,)), -margin(LOGITS, IMAGES, (0,)))


def test_a_users_function_gets_the_target_and_is_negated_too() -> None:
    def score(logits: Tensor, images: Tensor, labels: Tensor) -> Tensor:
        return logits[:, labels[0]]

    assert get_objective(score)(LOGITS, IMAGES, (0,)).tolist() == [3.0, 0.0]
    assert get_objective(score, Classification(target=(2,)))(LOGITS, IMAGES, (0,)).tolist() == [2.0, 1.0]
    assert get_objective(score, Classification(minimise=True))(LOGITS, IMAGES, (0,)).tolist() == [-3.0, 0.0]


def test_a_users_function_may_return_a_scalar_for_one_image() -> None:
    objective = get_objective(lambda logits, images, labels: logits[0, 1] + images.sum())
    assert objective(LOGITS[:1], IMAGES[:1], (0,)).tolist() == [1.0]
    assert objective(LOGITS, IMAGES, (0,)).tolist() == [1.0, 5.0], "for each of several"


LOSSES = [F.cross_entropy, nn.CrossEntropyLoss(), lambda z, x, y: F.cross_entropy(z, y), losses.cross_entropy]


@pytest.mark.parametrize("loss", LOSSES)
def test_a_loss_of_torch_is_an_objective(loss: Callable[..., Tensor]) -> None:
    """By itself, or in a function; one right answer comes as torch takes it, for each picture."""
    found = get_objective(loss)(LOGITS, IMAGES, (2,))
    assert torch.allclose(found, -LOGITS.log_softmax(dim=1)[:, 2])


def test_several_right_labels_are_a_tuple_and_no_loss_of_torch_takes_them() -> None:
    seen: list[Any] = []

    def keeps(logits: Tensor, images: Tensor, labels: Any) -> Tensor:
        seen.append(labels)
        return logits[:, 0]

    for labels in ((0, 2), (2,)):
        get_objective(keeps)(LOGITS, IMAGES, labels)
    assert seen[0] == (0, 2) and seen[1].tolist() == [2, 2] and seen[1].dtype == torch.int64
    with pytest.raises(InputError, match=r"one right label for a loss of torch, got 2 \(indices \(0, 2\)\); use"):
        get_objective(F.cross_entropy)(LOGITS, IMAGES, (0, 2))


@pytest.mark.parametrize(("named", "tuple_of"), [((0,), torch.tensor([0, 0])), ((0, 2), (0, 2))])
def test_ours_take_right_labels_in_every_form(named: tuple[int, ...], tuple_of: Any) -> None:
    for name in ("margin", "cross_entropy", "log_odds", "dlr", "targeted_margin", "targeted_dlr"):
        by_name = getattr(losses, name)(LOGITS, tuple_of)
        assert torch.equal(by_name, getattr(objective_functions, name)(LOGITS, IMAGES, named)), name
    assert torch.equal(margin(LOGITS, IMAGES, tuple_of), margin(LOGITS, IMAGES, named))


def test_rows_may_have_right_labels_of_their_own() -> None:
    assert losses.margin(LOGITS, torch.tensor([0, 1])).tolist() == [-1.0, -1.0]
    assert losses.carlini_wagner(LOGITS, torch.tensor([0, 0]), confidence=2.0).tolist() == [-1.0, 2.0]
    assert losses.targeted_carlini_wagner(LOGITS, (1,)).tolist() == [-2.0, 0.0]
    with pytest.raises(InputError, match="labels: expected 2, one for each row of logits, got 3"):
        losses.margin(LOGITS, torch.tensor([0, 1, 2]))


def test_the_losses_of_colours_are_those_of_the_print_terms() -> None:
    colors = torch.rand(2, 5, 5, 3, generator=torch.Generator().manual_seed(0))
    assert losses.total_variation(colors).tolist() == [float(judging.mean_variation(one)) for one in colors]
    assert losses.non_printability(colors).tolist() == [float(judging.printable_distance(one)) for one in colors]
    assert losses.total_variation(colors[0]).shape == (1,)
    ink = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    leaf = torch.full((1, 2, 2, 3), 0.25, requires_grad=True)
    off = losses.non_printability(leaf, ink)
    off.sum().backward()
    assert (
        float(off.detach()) == pytest.approx(0.25 * 3**0.5) and leaf.grad is not None and float(leaf.grad.min()) > 0.0
    )
    with pytest.raises(InputError, match=r"colors: expected \(N, h, w, 3\), got \(5, 3\)"):
        losses.total_variation(colors[0, 0])


def test_a_function_asks_for_more_by_name() -> None:
    def more(name: str) -> Any:
        return {"u": torch.tensor([[1.0], [2.0]]), "configuration": {"pose.yaw": torch.tensor([10.0, 20.0])}}[name]

    def asks(logits: Tensor, images: Tensor, labels: Tensor, u: Tensor, *, configuration: Any) -> Any:
        return u[:, 0] + configuration["pose.yaw"]

    assert list_requested_inputs(asks) == ("u", "configuration") and list_requested_inputs("margin") == ()
    assert get_objective(asks)(LOGITS, IMAGES, (0,), more).tolist() == [11.0, 22.0]
    one_number = get_objective(lambda z, labels, u, configuration: (u[0, 0] + configuration["pose.yaw"]).sum())
    assert one_number(LOGITS, IMAGES, (0,), more).tolist() == [11.0, 22.0], "one picture at a time"
    old = get_objective(lambda outputs, inputs, targets: inputs.sum(dim=(1, 2, 3)) + outputs[:, 0])
    assert old(LOGITS, IMAGES, (0,)).tolist() == [3.0, 0.0], "its pictures may be called so"
    with pytest.raises(InputError, match="asks for `u`, and no configuration was given"):
        get_objective(asks)(LOGITS, IMAGES, (0,))


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda z, x, y: float(z.detach().sum()), r"expected a torch tensor of shape \(2,\), got float; .*\.item\(\)"),
        (lambda z, x, y: None, "got NoneType"),
        (lambda z, x, y: z[0], r"expected one value per image, shape \(2,\), got \(4,\)"),
        (lambda z, x, y: z, r"expected one value per image, shape \(2,\), got \(2, 4\)"),
        (lambda z, x, y: z.argmax(dim=1), "expected floating-point values, got torch.int64"),
        (lambda z, x, y: z.detach().sum(dim=1), "does not depend on the output or the images differentiably"),
    ],
)
def test_a_users_mistakes_are_explained(function: object, message: str) -> None:
    objective = get_objective(function)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=message):
        objective(LOGITS.clone().requires_grad_(), IMAGES, (0,))


@pytest.mark.parametrize("function", [lambda logits, images: logits.sum(), lambda *, logits, images, labels: logits])
def test_a_function_that_cannot_take_the_arguments_is_refused_at_once(function: Callable[..., Tensor]) -> None:
    with pytest.raises(
        InputError, match=r"\(output, images, truth\) or \(output, labels\), and beside them any of u, "
    ):
        check_objective(function)


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


# ---- the page about objectives --------------------------------------------------------------------------------------

PAGE = (ROOT / "docs" / "objectives.md").read_text("utf-8")


def test_the_page_says_of_every_objective_what_the_registry_says() -> None:
    for kind in OBJECTIVE_KINDS.values():
        row = re.search(rf"^\| `{kind.name}` \| (.*?) \| (.*?) \|", PAGE, re.M)
        assert row is not None and kind.summary.startswith(row[1]) and kind.unit == row[2]
        assert f"--objective {kind.name}" in PAGE


def test_the_numbers_on_the_page_are_those_of_the_code() -> None:
    words = " ".join(PAGE.split())
    assert f"So below {MAX_LOG_ODDS:.0f} (1 - p = {math.exp(MAX_LOG_ODDS):.0e}".replace("e-07", "e-7") in words
    assert {1e-4: "A ten-thousandth of the distance"}[RELIEF] in words
    assert {1e-3: "within a thousandth of the clean length"}[NEARBY] in words
    assert f"under {math.log(2.0**-149):.0f}" in words  # the smallest float32


def test_the_python_on_the_page_runs(capsys: pytest.CaptureFixture[str]) -> None:
    names: dict[str, Any] = {}
    blocks = re.findall(r"^```python\n(.*?)^```$", PAGE, re.M | re.S)
    ran = [block for block in blocks if "advsearch.attack(" not in block]  # that one renders
    assert len(ran) == len(blocks) - 1 == 2
    for block in ran:
        exec(compile(block, "objectives.md", "exec"), names)
    assert capsys.readouterr().out == "the input of head (Linear), 192 numbers\n"
    objective = get_objective(names["like_the_other"])
    assert float(objective(torch.zeros(1, 14), names["other"][None], (0,))) == 0.0
