"""Semantic segmentation: how many of the object's pixels a model gets right."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn

from advsearch.attacks.objectives import get_objective
from advsearch.errors import InputError, ModelError
from advsearch.models import load_model
from advsearch.options import NOT_A_NUMBER
from advsearch.tasks import Facts, Prediction, Sight
from advsearch.tasks.segmentation import Segmentation, SegmentationTruth

pytestmark = pytest.mark.island("advsearch.tasks.segmentation")

NAMES = ("background", "bottle", "chair")
TASK = Segmentation(labels=NAMES)
MASK = torch.tensor([[0, 1, 1, 0], [0, 1, 1, 0]]).bool()
TRUTH = SegmentationTruth((1,), MASK)


def of(*classes: list[int], sure: float = 2.0) -> Tensor:
    """Logits (1, 3, h, w) of which those of the given classes lead by `sure`."""
    return sure * nn.functional.one_hot(torch.tensor(classes), 3).permute(2, 0, 1)[None].float()


ALL, HALF, QUARTER = of([0, 1, 1, 0], [0, 1, 1, 0]), of([0, 1, 0, 0], [0, 2, 1, 0]), of([1, 1, 0, 1], [1, 2, 2, 1])


@pytest.mark.parametrize(
    ("output", "accuracy", "right", "answer"),
    [
        (ALL, 0.5, True, Prediction("bottle", 1, 1.0)), (HALF, 0.5, True, Prediction("bottle", 1, 0.5)),
        (HALF, 0.51, False, Prediction("bottle in part", None, 0.5)),
        (QUARTER, 0.5, False, Prediction("chair", 2, 0.25)),
        (HALF, 1.0, False, Prediction("bottle in part", None, 0.5)),
    ],
)  # fmt: skip
def test_enough_of_the_objects_pixels_have_to_be_right(
    output: Tensor, accuracy: float, right: bool, answer: Prediction
) -> None:
    task = replace(TASK, accuracy=accuracy)
    (found,) = task.judge(output, TRUTH)
    assert found.margin == 0.0 or found.prediction.label == answer.label
    assert found.right is right and (found.margin >= 0.0) is right and found.success is not right
    assert (found.prediction.index, found.prediction.probability) == (
        answer.index,
        answer.probability,
    ) or found.margin == 0.0
    assert abs(found.margin) in (0.0, 2.0)


def test_the_objective_has_a_derivative_at_every_pixel_of_the_object() -> None:
    output = ALL.clone().requires_grad_()
    values = get_objective("pixel_margin", TASK)(output, torch.zeros(1, 2, 4, 3), TRUTH)
    values.sum().backward()
    assert output.grad is not None and output.grad[0].abs().amax(dim=0).gt(0.0).equal(MASK)
    assert TASK.objective == "pixel_margin"
    assert float(get_objective("pixel_margin", replace(TASK, minimise=True))(ALL, ALL, TRUTH)) == 2.0
    (deciding,) = torch.autograd.grad(TASK.loss(output, TRUTH).sum(), output)
    assert int(deciding[0].abs().amax(dim=0).gt(0.0).sum()) == 1


def test_a_target_has_to_get_enough_of_the_pixels() -> None:
    chair = replace(TASK, target=(2,), accuracy=0.5)
    assert not chair.judge(HALF, TRUTH)[0].success and chair.judge(QUARTER, TRUTH)[0].success
    assert float(chair.pixel_margin(QUARTER, TRUTH)) == 0.0 and float(chair.pixel_margin(ALL, TRUTH)) == -2.0
    assert chair.target_names == ("chair",) and chair.success_description == "a target answer"
    easier = replace(TASK, minimise=True)
    assert easier.judge(ALL, TRUTH)[0].success and not easier.judge(QUARTER, TRUTH)[0].success


def test_where_nothing_of_the_object_is_seen_nothing_is_wrong() -> None:
    output = QUARTER.clone().requires_grad_()
    (found,) = TASK.judge(output, SegmentationTruth((1,), torch.zeros_like(MASK)))
    assert found.right and found.prediction == Prediction("out of view") and found.payload is None
    assert TASK.pixel_margin(output, SegmentationTruth((1,), torch.zeros_like(MASK))).requires_grad


def test_predictions_are_the_classes_of_most_pixels() -> None:
    assert TASK.predictions(ALL, 5) == [(Prediction("bottle", 1, 0.5),)], "background is none"
    assert replace(TASK, target=(0,)).predictions(ALL, 5) == [
        (Prediction("background", 0, 0.5), Prediction("bottle", 1, 0.5))
    ]
    true, said = TASK.marks(QUARTER, TRUTH)[0]
    assert true.true and true.mask is MASK and not said.true and said.mask is not None
    assert said.mask.int().tolist() == [[1, 1, 0, 1], [1, 0, 0, 1]]


class Mapped(nn.Module):
    """As torchvision's segmenters: a mapping with `out`."""

    def forward(self, x: Tensor) -> dict[str, Tensor]:
        return {"out": x, "aux": 0.0 * x}


class Logits:
    """An answer with a name, as transformers returns it."""

    logits = ALL


def test_a_task_learns_names_from_its_model() -> None:
    model = load_model(Mapped(), input_size=4, read=Segmentation().output_reader, labels=NAMES)
    task = Segmentation().on(model, target="chair")
    assert (task.labels, task.target) == (NAMES, (2,)) and model.differentiable
    facts = Facts(
        "bottle", None, "bottle", compute_sight=lambda: Sight(MASK, torch.ones(MASK.shape), torch.ones(MASK.shape))
    )
    truth = task.truth(facts)
    assert truth.labels == TRUTH.labels and torch.equal(truth.mask, TRUTH.mask)
    assert task.truth_names(TRUTH) == ("bottle",)
    with pytest.raises(InputError, match="target"):
        Segmentation().on(model, target="table")
    with pytest.raises(InputError, match="target"):
        task.check(Facts("bottle", "chair"))
    with pytest.raises(ModelError, match=r"\(N, classes, height, width\)"):
        load_model(nn.Sequential(nn.Flatten(), nn.Linear(48, 3)), input_size=4, read=Segmentation().output_reader)


def test_pixels_that_are_not_numbers_are_no_output() -> None:
    broken = ALL.clone()
    broken[0, 1, 1, 1] = math.nan
    for output in (broken, torch.full_like(ALL, math.nan), torch.where(broken.isnan(), math.inf, broken)):
        (found,) = TASK.judge(output, TRUTH)
        assert (
            found.prediction == Prediction(NOT_A_NUMBER)
            and found.is_non_finite
            and not found.right
            and not found.success
        )
    assert TASK.predictions(torch.full_like(ALL, math.nan)) == [(Prediction(NOT_A_NUMBER),)]
    assert TASK.predictions(torch.zeros_like(ALL)) == [(Prediction("nothing"),)], "background everywhere"
