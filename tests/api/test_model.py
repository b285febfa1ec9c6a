"""`advsearch.load_model`: a task may be named."""

from __future__ import annotations

import pytest
import torch

import advsearch
from advsearch.errors import UnknownNameError
from small_models import SIDE, Finder, Painter


@pytest.mark.parametrize("task", ["detection", {"name": "detection", "confidence": 0.3}])
def test_a_task_says_how_outputs_are_read(task: object) -> None:
    model = advsearch.load_model(Finder(), task=task, labels=["cup", "bowl", "dog"], input_size=SIDE)  # type: ignore[arg-type]
    (found,) = model(torch.rand(1, SIDE, SIDE, 3))
    assert {"boxes", "scores"} <= set(found)
    pixels = advsearch.load_model(Painter(), task="segmentation", input_size=SIDE)
    assert pixels.read is not None


def test_a_task_that_is_not_there_is_named() -> None:
    with pytest.raises(UnknownNameError, match="detection"):
        advsearch.load_model(Finder(), task="detektion")
