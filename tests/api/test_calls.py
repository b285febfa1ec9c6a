"""What a call from Python gives: keywords of other libraries, and values of wrong types."""

import inspect
from functools import partial
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import nn

import advsearch
from advsearch import losses
from advsearch.controls import NumberControl, Parameter, compose_space
from advsearch.engine.loading import load_scene
from advsearch.errors import InputError

FUNCTIONS = [name for name in advsearch.__all__ if inspect.isfunction(getattr(advsearch, name))]


@pytest.mark.parametrize("name", [name for name in FUNCTIONS if name != "load_run"])
@pytest.mark.parametrize("run", [False, True, 3, [], b"x", " "])
def test_a_run_is_a_name_or_a_folder(name: str, run: Any) -> None:
    if "run" in inspect.signature(getattr(advsearch, name)).parameters:
        with pytest.raises(InputError, match="run"):
            getattr(advsearch, name)(*(["mug"] if name in ("attack", "sweep") else []), run=run)


@pytest.mark.parametrize(
    "loss", [F.cross_entropy, F.nll_loss, nn.CrossEntropyLoss(), partial(F.cross_entropy, reduction="none")]
)
def test_a_loss_of_torch_that_leads_away_from_the_target_is_refused(loss: Any) -> None:
    with pytest.raises(InputError, match="objective"):
        losses.check_direction(loss, targeted=True)
    losses.check_direction(loss, targeted=False)
    losses.check_direction(lambda logits, labels: -loss(logits, labels), targeted=True)


class Sets(NumberControl):
    """Sets one input of the scene."""

    kind = "sets"
    summary = "Sets one input."
    parameters = (Parameter("amount", (), "1", 0.0, 1.0, 0.0, "How much.", search=(0.0, 1.0)),)
    made: Any = None

    def scene_inputs(self, values: Any, earlier_inputs: Any) -> Any:
        return self.made


@pytest.mark.parametrize(
    ("made", "message"),
    [
        ({"object.base_color": torch.full((4, 4, 3), 1.5)}, "object.base_color: expected values from 0 to 1 .*got 1.5"),
        ({"object.base_color": torch.full((4, 4, 3), torch.nan)}, "object.base_color: expected values from 0 to 1"),
        ({"object.base_color": torch.zeros(4, 4)}, r"object.base_color: expected shape \(N, N, 3\), got \(4, 4\)"),
        ({"object.base_color": torch.zeros(4, 4, 3, dtype=torch.uint8)}, "expected a tensor .* got torch.uint8"),
        (torch.zeros(3), "expected scene inputs by name, got Tensor"),
    ],
)  # fmt: skip
def test_inputs_of_ones_own_control_that_cannot_be_are_refused(made: Any, message: str) -> None:
    control = Sets(amount=[0, 1])
    control.made = made
    space = compose_space((control,), load_scene("mug").description)
    with pytest.raises(InputError, match=f"`controls` sets: .*{message}"):
        space.inputs(space.start)
