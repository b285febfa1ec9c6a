"""Depth Anything and its like: tiny ones with random weights, beside the library's own post-processing."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from advsearch import load_model
from advsearch.tasks.depth import DISPARITY, METRIC, Depth, DepthTruth
from small_models import assert_slope

pytestmark = pytest.mark.island("advsearch.tasks.depth")

transformers = pytest.importorskip("transformers", reason="transformers is not installed: advsearch[hf]")

SIDE = 32
PICTURE = torch.rand((SIDE, SIDE, 3), generator=torch.Generator().manual_seed(0)).mul(255).round() / 255
VIT = {"hidden_size": 8, "num_attention_heads": 2, "image_size": SIDE, "patch_size": 8}
NECK = {"neck_hidden_sizes": [8] * 4, "fusion_hidden_size": 8}
STAGES = {"num_hidden_layers": 4, "out_indices": [1, 2, 3, 4], "reshape_hidden_states": False}


def made(family: str) -> Any:
    """A tiny network with random weights."""
    if family.startswith("DepthAnything"):
        body = transformers.Dinov2Config(**VIT, **STAGES, mlp_ratio=1)
        kind = "metric" if family.endswith("metric") else "relative"
        config = transformers.DepthAnythingConfig(
            backbone_config=body, patch_size=8, reassemble_hidden_size=8, head_hidden_size=8, max_depth=3, **NECK,
            depth_estimation_type=kind,
        )  # fmt: skip
        network = transformers.DepthAnythingForDepthEstimation(config)
    elif family == "DPT":
        config = transformers.DPTConfig(
            **VIT, **NECK, num_hidden_layers=4, intermediate_size=8, backbone_out_indices=[0, 1, 2, 3]
        )
        network = transformers.DPTForDepthEstimation(config)
    elif family == "GLPN":
        config = transformers.GLPNConfig(
            depths=[1] * 4, hidden_sizes=[8] * 4, num_attention_heads=[1] * 4, mlp_ratios=[1] * 4, decoder_hidden_size=8
        )
        network = transformers.GLPNForDepthEstimation(config)
    else:
        body = transformers.BeitConfig(**VIT, **STAGES, intermediate_size=8, use_relative_position_bias=True)
        config = transformers.ZoeDepthConfig(
            backbone_config=body, **NECK, bottleneck_features=8, num_relative_features=8, bin_embedding_dim=8,
            num_attractors=[2, 2, 2, 1], bin_configurations=[{"n_bins": 8, "min_depth": 0.1, "max_depth": 3.0}],
        )  # fmt: skip
        network = transformers.ZoeDepthForDepthEstimation(config)
    generator, size = torch.Generator().manual_seed(0), 0.2 if family == "ZoeDepth" else 0.3
    for name, parameter in network.named_parameters():  # answers that differ, and are no zero after a ReLU
        if parameter.dim() > 1:
            parameter.data = torch.randn(parameter.shape, generator=generator) * size
        elif "head" in name and name.endswith("bias"):
            parameter.data.fill_(1.0)
    return network


def published(folder: Path, family: str) -> str:
    """Publish it with an image processor that gives it pictures of `SIDE`."""
    made(family).save_pretrained(folder)
    size: dict[str, Any] = {"size": {"height": SIDE, "width": SIDE}}
    name, settings = {"GLPN": ("GLPN", {}), "ZoeDepth": ("ZoeDepth", {**size, "ensure_multiple_of": 8})}.get(
        family, ("DPT", size)
    )
    getattr(transformers, f"{name}ImageProcessor")(**settings).save_pretrained(folder)
    return f"hf:{folder}"


@pytest.mark.island("advsearch.models.zoo")
@pytest.mark.medium
@pytest.mark.parametrize(
    ("family", "kind"),
    [("DepthAnything", DISPARITY), ("DepthAnything metric", METRIC), ("DPT", DISPARITY), ("GLPN", METRIC)],
)
def test_maps_are_the_librarys(tmp_path: Path, family: str, kind: str) -> None:
    """Of a saved picture."""
    spec = published(tmp_path, family)
    model = load_model(spec, task="depth", input_size=SIDE if family == "GLPN" else None)
    Image.fromarray(np.asarray(PICTURE.mul(255).round(), np.uint8)).save(tmp_path / "seen.png")
    ours = model(PICTURE)[0]
    prepared = transformers.AutoImageProcessor.from_pretrained(tmp_path)
    network = transformers.AutoModelForDepthEstimation.from_pretrained(tmp_path).eval()
    with torch.no_grad():
        answer = network(**prepared(images=Image.open(tmp_path / "seen.png"), return_tensors="pt"))
    (theirs,) = prepared.post_process_depth_estimation(answer, [(SIDE, SIDE)])
    asked: Tensor = theirs["predicted_depth"]
    assert list(ours) == [kind] and model.input_size == (SIDE, SIDE) and asked.shape == (SIDE, SIDE)
    assert float(asked.std()) > 1e-3
    at_size = torch.nn.functional.interpolate(ours[kind][None, None], size=SIDE, mode="bicubic")[0, 0]
    assert float((at_size - asked).abs().max()) < 1e-4 * max(1.0, float(asked.abs().max()))


@pytest.mark.island("advsearch.models.zoo")
def test_the_gradient_of_a_network_agrees_with_differences(tmp_path: Path) -> None:
    model: Any = load_model(published(tmp_path, "DepthAnything"), task="depth")
    mask = torch.zeros(SIDE, SIDE).bool()
    mask[8:24, 8:24] = True
    truth = DepthTruth(
        mask, torch.linspace(2.0, 4.0, SIDE, dtype=torch.float64)[:, None].expand(SIDE, SIDE) - 0.5 * mask
    )
    network, task = model.module.double(), Depth()
    generator = torch.Generator().manual_seed(1)
    way = torch.randn((1, 3, SIDE, SIDE), generator=generator, dtype=torch.float64)
    at = PICTURE.permute(2, 0, 1)[None].double()

    def value(x: Tensor) -> Tensor:
        return task.loss([{kind: one[0]} for kind, one in network(x).items()], truth).sum()

    assert abs(assert_slope(value, at, way, 1e-6, 1e-3)) > 1e-6
