"""torch's global switches, turned by the code of users: they stay with their network, and break nothing of ours."""

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

import advsearch
from advsearch.models import load_model
from advsearch.trust.code import allow_code
from advsearch.trust.foreign_code import DEFAULT_TORCH_STATE, TorchState, use_default_torch_state

TURNED = {
    "type": TorchState(dtype=torch.float64),
    "gradients": TorchState(gradients=False),
    "deterministic": TorchState(deterministic=2),
    "anomalies": TorchState(anomalies=True),
    "all": TorchState(torch.float64, DEFAULT_TORCH_STATE.device, gradients=False, deterministic=2, anomalies=True),
}


@pytest.fixture(autouse=True)
def turned_back() -> Iterator[None]:
    yield
    DEFAULT_TORCH_STATE.apply()


class OfItsType(nn.Module):
    """A classifier that makes tensors of the type that its code has chosen, and may switch gradients off."""

    def __init__(self, *, forgets: bool = False) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.pooled, self.last, self.forgets = nn.AdaptiveAvgPool2d(4), nn.Linear(48, 3), forgets

    def forward(self, x: Tensor) -> Tensor:
        answer: Tensor = 20.0 * self.last(self.pooled(x).flatten(1)) @ torch.eye(3)
        if self.forgets:
            torch.set_grad_enabled(False)
        return answer


@pytest.mark.parametrize("turned", TURNED)
def test_a_model_is_loaded_and_asked_whatever_is_turned(turned: str) -> None:
    theirs = TURNED[turned]
    theirs.apply()
    model = load_model(OfItsType(), input_size=16)
    assert TorchState.read_current() == theirs, "as they were"
    assert model.differentiable and model.dtype == theirs.dtype
    with use_default_torch_state():
        picture = torch.full((16, 16, 3), 0.5, requires_grad=True)
        logits = model(picture)
        (gradient,) = torch.autograd.grad(logits.max(), picture)
        assert (
            logits.dtype == gradient.dtype == torch.float32
            and bool(gradient.any())
            and TorchState.read_current() == DEFAULT_TORCH_STATE
        )
    assert TorchState.read_current() == theirs


def test_a_network_that_switches_gradients_off_as_it_runs_does_so_for_itself() -> None:
    model = load_model(OfItsType(forgets=True), input_size=16)
    model(torch.zeros(16, 16, 3))
    assert torch.is_grad_enabled() and model.differentiable


@pytest.mark.medium
def test_a_scene_is_rendered_and_searched_whatever_is_turned() -> None:
    TURNED["all"].apply()
    network = OfItsType()
    with torch.no_grad():
        network.last.bias[0] += 5.0
    named = load_model(network, input_size=16, labels=["mug", "bowl", "vase"])
    assert advsearch.render("mug", named, spp=1).views[0].predictions[0].label == "mug"
    result = advsearch.attack("mug", named, steps=2, spp=1, trials=6, verify_spp=1, baseline=False)
    assert TorchState.read_current() == TURNED["all"]
    assert result.summary.ending == "budget spent" and result.summary.renders["gradient"] > 0


def test_what_the_code_of_a_network_turns_stays_with_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "turning_nets.py").write_text(
        "import torch\ntorch.set_default_dtype(torch.float64)\ntorch.set_grad_enabled(False)\n"
        f"import sys; sys.path.append({str(Path(__file__).parent)!r})\nfrom test_switches import OfItsType\n"
        "def make():\n    return OfItsType()\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    allow_code("turning_nets:make")
    model = load_model("turning_nets:make", input_size=16)
    assert TorchState.read_current() == DEFAULT_TORCH_STATE and model.dtype == torch.float64 and model.differentiable
    assert model(torch.zeros(16, 16, 3)).dtype == torch.float32 and TorchState.read_current() == DEFAULT_TORCH_STATE
