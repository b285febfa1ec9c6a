"""Networks that no task can judge as they are: each is refused in a sentence that says what it is, and the way on."""

from typing import Any

import pytest
import torch
from torch import Tensor, nn

from advsearch import load_model
from advsearch.errors import ModelError


class Answers(nn.Module):
    """Answers with what `form` makes of logits of each pixel (N, 4, H, W)."""

    def __init__(self, form: Any) -> None:
        super().__init__()
        self.form, self.pixels = form, nn.Conv2d(3, 4, 1)

    def forward(self, x: Tensor) -> Any:
        return self.form(self.pixels(x))


@pytest.mark.parametrize(
    "task",
    ["classification", pytest.param("segmentation", marks=pytest.mark.island("advsearch.tasks.segmentation"))],
)
@pytest.mark.parametrize(
    "form",
    [lambda pixels: pixels.argmax(dim=1), lambda pixels: {"logits": pixels.argmax(dim=1).int()}],
    ids=["pixels", "logits"],
)
def test_chosen_classes_are_no_scores(form: Any, task: str) -> None:
    with pytest.raises(ModelError, match="argmax"):
        load_model(Answers(form), input_size=8, task=task)


def test_layers_without_weights_are_named() -> None:
    network = nn.Sequential(nn.Flatten(), nn.Sequential(nn.ReLU(), nn.LazyLinear(3)))
    with pytest.raises(ModelError, match="LazyLinear"):
        load_model(network, input_size=8)
    network(torch.zeros(1, 3, 8, 8))
    assert load_model(network, input_size=8).classes == 3


class InTraining(nn.Module):
    """Cannot be asked without the right answers."""

    def forward(self, x: Tensor, targets: Tensor) -> Tensor:
        return x


class ToldInTraining(nn.Module):
    """Says itself that it cannot."""

    def forward(self, x: Tensor, targets: Tensor | None = None, weight: float = 1.0) -> Tensor:
        raise ValueError("targets should be passed, a weight too")


@pytest.mark.parametrize("network", [InTraining(), ToldInTraining()])
def test_what_is_wanted_beside_pictures_is_named(network: nn.Module) -> None:
    with pytest.raises(ModelError, match="targets"):
        load_model(network, input_size=8)
