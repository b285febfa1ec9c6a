"""Whatever code of others is handed, it may destroy: nothing that it writes into is looked at again."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from advsearch.attacks import Domain, Evaluation, get_objective
from advsearch.engine.judging import judge_images
from advsearch.models import Model, Preprocessing
from advsearch.tasks import Classification

LOGITS = torch.tensor([[3.0, 1.0, 0.0], [0.5, 2.0, 0.0]])
PICTURES = torch.rand(2, 4, 4, 3, generator=torch.Generator().manual_seed(0))
TASK = replace(Classification(), labels=("mug", "bowl", "vase"))


def destroy(value: Any) -> None:
    """Write into every tensor and array of a value, and empty its lists and mappings."""
    if isinstance(value, Tensor):
        with torch.no_grad():
            value.fill_(7)
    elif isinstance(value, np.ndarray):
        value[...] = 7
    elif isinstance(value, (list, dict)):
        for one in [*(value.values() if isinstance(value, dict) else value)]:
            destroy(one)
        value.clear()
    elif isinstance(value, tuple):
        for one in value:
            destroy(one)
    elif isinstance(value, (SimpleNamespace, Evaluation, Domain)):
        destroy({**vars(value)})


def test_a_loss_that_masks_logits_in_place_changes_no_verdict() -> None:
    def masks(logits: Tensor, images: Tensor, labels: Tensor, u: Tensor) -> Tensor:
        right = torch.stack([row[label] * 1.0 for row, label in zip(logits.clone(), labels.tolist(), strict=True)])
        value = logits.scatter_(1, labels[:, None].clone(), -1e4).amax(dim=1) - right
        destroy([images, labels, u])
        return value

    output, u = LOGITS.clone().requires_grad_(), torch.rand(2, 5)
    images, kept = PICTURES.clone(), u.clone()
    values = get_objective(masks, TASK)(output, images, (0,), {"u": u}.__getitem__)
    (slope,) = torch.autograd.grad(values.sum(), output)
    assert torch.equal(values, TASK.loss(LOGITS, (0,)))
    assert torch.equal(slope, torch.tensor([[-1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]]))
    assert torch.equal(output, LOGITS) and torch.equal(images, PICTURES) and torch.equal(u, kept)


def test_a_metric_that_destroys_what_it_gets_changes_no_other() -> None:
    def first(image: Tensor, output: Tensor, truth: Tensor) -> float:
        destroy([image, output, truth])
        return 0.0

    def second(image: Tensor, output: Tensor, truth: Tensor) -> dict[str, Tensor]:
        return {"output": output.sum(), "image": image.sum(), "truth": truth}

    output, pictures = LOGITS.clone(), PICTURES.clone()
    said = judge_images(TASK, output, pictures, [(1,)], {"first": first, "second": second})
    assert [one.metrics for one in said] == [
        {"first": 0.0, "second.output": float(row.sum()), "second.image": float(picture.sum()), "second.truth": 1.0}
        for row, picture in zip(LOGITS, PICTURES, strict=True)
    ]
    assert torch.equal(output, LOGITS) and torch.equal(pictures, PICTURES)


class Writing(nn.Module):
    """A network that normalises in place, and answers into the same memory each time."""

    def __init__(self) -> None:
        super().__init__()
        self.answer = torch.empty(1, 2)

    def forward(self, x: Tensor) -> Tensor:
        x.sub_(0.5)
        self.answer = self.answer if not x.requires_grad else torch.empty(1, 2)
        return self.answer.copy_(torch.stack([x.sum(), -x.sum()])[None])


@pytest.mark.parametrize("layout", ["NHWC", "NCHW"])
@pytest.mark.parametrize("processor", [None, lambda x: x.sub_(0.5).div_(0.5)])
def test_a_network_that_writes_into_its_input_changes_no_picture(layout: str, processor: Any) -> None:
    preprocessing = Preprocessing((4, 4), layout=layout, processor=processor)
    model = Model(Writing(), "writing", ("a", "b"), preprocessing, batch_limits=(1, 1))
    pictures = PICTURES.clone()
    output = model(pictures)
    assert torch.equal(pictures, PICTURES)
    assert not torch.equal(output[0], output[1])
    first = model(pictures[:1])
    kept = first.clone()
    model(pictures[1:])
    assert torch.equal(first, kept) and torch.equal(first[0], output[0])
