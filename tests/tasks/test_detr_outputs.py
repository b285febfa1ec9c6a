"""What DETR's networks answer: boxes by their middle in shares of the picture, and logits that names explain."""

import types
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from advsearch import load_model
from advsearch.errors import InputError, ModelError
from advsearch.tasks import Detection
from advsearch.tasks.boxes import DetectionTruth
from advsearch.tasks.detector_outputs import QUERIES

NAMES = ("bowl", "coffee mug", "dog")
ALONE, CHOSEN = QUERIES
TRUTH = DetectionTruth((1,), (2, 2, 30, 30), (32, 32))


class Bright(nn.Module):
    """Three queries of a little DETR: a mug in the middle of a picture that is bright there, a bowl where it is dark.

    Args:
        form: of its answer, made of logits and boxes.
        nothing: whether its last class stands for nothing.
    """

    def __init__(self, form: Callable[[Tensor, Tensor], Any], nothing: bool = True) -> None:
        super().__init__()
        self.form, self.nothing = form, nothing

    def forward(self, x: Tensor) -> Any:
        light = x[..., 8:24, 8:24].mean(dim=(1, 2, 3))[:, None] - 0.46
        rest = torch.full((len(x), 1 + self.nothing), -6.0)
        first = torch.cat([-20.0 * light, 20.0 * light, rest], dim=1)
        empty = torch.cat([torch.full((len(x), 3), -6.0), torch.full((len(x), int(self.nothing)), 6.0)], dim=1)
        box = torch.tensor([0.5, 0.5, 0.85, 0.85]).expand(len(x), 4) + 0.01 * light
        return self.form(
            torch.stack([empty, first, empty], dim=1), torch.stack([0.3 * box, box, 0.3 * box], dim=1)
        )  # fmt: skip


def of_its_authors(logits: Tensor, boxes: Tensor) -> Any:
    return {"pred_logits": logits, "pred_boxes": boxes, "aux_outputs": [{"pred_logits": logits, "pred_boxes": boxes}]}


FORMS: dict[str, Callable[[Tensor, Tensor], Any]] = {
    "DETR's own": of_its_authors,
    "mapping": lambda logits, boxes: {"logits": logits, "pred_boxes": boxes},
    "object": lambda logits, boxes: types.SimpleNamespace(logits=logits, pred_boxes=boxes),
}


@pytest.mark.parametrize("nothing", [True, False], ids=["softmax", "sigmoid"])
@pytest.mark.parametrize("form", FORMS)
def test_names_say_how_logits_are_read(form: str, nothing: bool) -> None:
    model = load_model(Bright(FORMS[form], nothing), input_size=32, task="detection", labels=NAMES)
    picture = torch.full((32, 32, 3), 0.6)
    task = Detection().on(model).after_calibration(model(picture), TRUTH)
    (found,) = task.judge(model(picture), TRUTH)
    logits = torch.tensor([-2.8, 2.8, -6.0] + [-6.0] * nothing)
    score = float(logits.softmax(dim=0)[1] if nothing else logits[1].sigmoid())
    assert found.right and found.prediction.label == "coffee mug"
    assert found.prediction.probability == pytest.approx(score)
    order = CHOSEN if nothing else ALONE
    assert task.output_remarks == (
        f"The detector's output is read as a DETR's: `task='detection={{order: {order}}}'`.",
    )
    assert not task.ambiguity_message and [one.label for one in task.predictions(model(picture), 1)[0]] == [
        "coffee mug"
    ]


def test_a_tuple_is_read_as_is_said() -> None:
    with pytest.raises(ModelError, match="boxes logits"):
        load_model(Bright(lambda logits, boxes: (logits[..., :3], boxes)), input_size=32, task="detection")
    network = Bright(lambda logits, boxes: (logits, boxes))
    task = Detection(order=CHOSEN)
    model = load_model(network, input_size=32, task=task, labels=NAMES)
    task = task.on(model)
    (found,) = task.judge(model(torch.full((32, 32, 3), 0.6)), TRUTH)
    assert found.right and not task.output_remarks
    with pytest.raises(InputError, match="3 classes"):
        Detection(order=ALONE).on(model)


@pytest.mark.parametrize("nothing", [True, False], ids=["softmax", "sigmoid"])
def test_what_is_sought_moves_as_its_gradient_says(nothing: bool) -> None:
    model = load_model(Bright(of_its_authors, nothing), input_size=32, task="detection", labels=NAMES)
    task = Detection().on(model)
    picture = torch.full((32, 32, 3), 0.5)
    step = torch.rand(picture.shape, generator=torch.Generator().manual_seed(0)) * 1e-3
    leaf = picture.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(task.score(model(leaf), TRUTH).sum(), leaf)
    seen = task.score(model(picture + step), TRUTH) - task.score(model(picture - step), TRUTH)
    assert float(seen) == pytest.approx(float((gradient * step).sum()) * 2.0, rel=1e-2) and float(seen) < -1e-3
