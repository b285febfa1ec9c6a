"""Gradients that are those of the answers where torch, or a network, would give others."""

import warnings
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from advsearch import load_model
from advsearch.models import Model, ModelWarning

SIDE = 8
PICTURE = torch.rand((1, SIDE, SIDE, 3), generator=torch.Generator().manual_seed(0)).mul(0.8).add(0.1)


class Tokens(nn.Module):
    """Convolution, batch norm and a transformer's tokens, as hybrids have them."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.begin, self.norm = nn.Conv2d(3, 6, 3, stride=2), nn.BatchNorm2d(6)
        self.order, self.end = nn.LayerNorm(6), nn.Linear(6, 4)
        self.norm.register_buffer("running_var", torch.linspace(0.1, 2.0, 6))

    def forward(self, images: Tensor) -> Tensor:
        tokens = self.norm(self.begin(images)).flatten(2).transpose(1, 2)
        scores: Tensor = self.end(self.order(tokens).square()).mean(dim=1)
        return scores


@pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")
@pytest.mark.parametrize("kind", ["module", "export", "script"])
def test_batch_norm_before_a_transformer_has_its_gradient(kind: str, tmp_path: Path) -> None:
    """torch itself reads the gradient of a single picture there in a wrong order."""
    network, images = Tokens().eval(), torch.zeros(2, 3, SIDE, SIDE)
    path = tmp_path / "net.pt2"
    if kind == "export":
        batch = {0: torch.export.Dim("batch", min=1, max=8)}
        torch.export.save(torch.export.export(network, (images,), dynamic_shapes=(batch,)), path)
    elif kind == "script":
        path = tmp_path / "net.ts"
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # newer versions of torch deprecate it
            torch.jit.save(torch.jit.trace(network, images), path)
    with warnings.catch_warnings():
        warnings.simplefilter("error", ModelWarning)
        model = load_model(network if kind == "module" else path, input_size=SIDE)
    assert _told(model) == pytest.approx(_seen(model), rel=0.01)


@pytest.mark.medium
def test_rt_detr_has_its_gradient() -> None:
    """It chooses queries by the scores of its encoder, which come from a batch norm and a transformer, and detaches
    them."""
    transformers = pytest.importorskip("transformers", reason="transformers is not installed: advsearch[hf]")
    torch.manual_seed(1)
    layers = {"embedding_size": 8, "hidden_sizes": [8, 8, 8, 8], "depths": [1, 1, 1, 1], "layer_type": "basic"}
    backbone = transformers.RTDetrResNetConfig(**layers, out_features=["stage2", "stage3", "stage4"])
    sizes = {f"{part}_ffn_dim": 8 for part in ("encoder", "decoder")} | {"encoder_hidden_dim": 8, "d_model": 8}
    sizes |= {f"{part}_attention_heads": 2 for part in ("encoder", "decoder")} | {"decoder_layers": 2, "num_queries": 4}
    channels = {"encoder_in_channels": [8] * 3, "decoder_in_channels": [8] * 3}
    config = transformers.RTDetrConfig(backbone_config=backbone, **sizes, **channels, id2label={0: "mug", 1: "cup"})
    network = transformers.RTDetrForObjectDetection(config).eval()
    for parameter in network.parameters():
        if parameter.dim() > 1:
            nn.init.normal_(parameter, std=parameter[0].numel() ** -0.5)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", "the gradient of model")
        warnings.filterwarnings("ignore", ".*without an image processor")
        model = load_model(network.double(), input_size=64, task="detection")
    picture = torch.rand((1, 64, 64, 3), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert model.attached
    assert _told(model, picture) == pytest.approx(_seen(model, picture, 1e-4), rel=0.05)


def _value(model: Model, picture: Tensor) -> Tensor:
    """One number that takes all answers in, in the type of the network."""
    output = model.run_network(model.preprocessing(picture))
    parts = [output] if isinstance(output, Tensor) else list(output[0].values())
    values = torch.cat([one.flatten().double() for one in parts])
    return (values * torch.linspace(-1.0, 1.0, len(values), dtype=values.dtype)).sum()


def _way(picture: Tensor) -> Tensor:
    return torch.randn(picture.shape, generator=torch.Generator().manual_seed(1)).to(picture.dtype)


def _told(model: Model, picture: Tensor = PICTURE) -> float:
    leaf = picture.clone().requires_grad_()
    return float((torch.autograd.grad(_value(model, leaf), leaf)[0] * _way(picture)).sum())


def _seen(model: Model, picture: Tensor = PICTURE, size: float = 2e-3) -> float:
    with torch.no_grad():
        ends = [_value(model, picture + sign * size * _way(picture)) for sign in (1.0, -1.0)]
    return float(ends[0] - ends[1]) / (2.0 * size)
