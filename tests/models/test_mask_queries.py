"""Mask2Former and its like as segmenters: tiny ones with random weights, beside the library's own post-processing."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from advsearch import load_model
from advsearch.tasks.segmentation import Segmentation, SegmentationTruth
from small_models import assert_slope

transformers = pytest.importorskip("transformers", reason="transformers is not installed: advsearch[hf]")

SIDE = 64
NAMES = ("mug", "bowl", "vase")
PICTURE = torch.rand((SIDE, SIDE, 3), generator=torch.Generator().manual_seed(0)).mul(255).round() / 255
WARNED = pytest.mark.filterwarnings("ignore:.*margins are logarithms of a ratio of scores")
pytestmark = [WARNED, pytest.mark.island("advsearch.tasks.segmentation")]
ROUNDED = pytest.mark.filterwarnings("ignore:.*sees an image differently in a batch")
"""Of a grey picture group normalisation divides rounding by next to nothing, which random weights make much of."""
SWIN = {"image_size": SIDE, "patch_size": 4, "embed_dim": 4, "depths": [1] * 4, "num_heads": [1] * 4, "window_size": 2}
SIZES: dict[str, dict[str, Any]] = {
    "Mask2Former": {
        "feature_size": 32, "mask_feature_size": 32, "hidden_dim": 32, "encoder_feedforward_dim": 8,
        "encoder_layers": 1, "decoder_layers": 2, "num_attention_heads": 2, "dim_feedforward": 8, "num_queries": 5,
    },
    "MaskFormer": {"fpn_feature_size": 32, "mask_feature_size": 8},
    "OneFormer": {
        "conv_dim": 32, "mask_dim": 32, "hidden_dim": 32, "encoder_feedforward_dim": 8, "encoder_layers": 1,
        "decoder_layers": 2, "num_attention_heads": 2, "dim_feedforward": 8, "num_queries": 5, "query_dec_layers": 1,
        "task_seq_len": 9, "norm": "",
    },
    "Eomt": {
        "hidden_size": 8, "num_hidden_layers": 2, "num_attention_heads": 2, "image_size": SIDE, "patch_size": 8,
        "num_upscale_blocks": 1, "num_blocks": 1, "num_queries": 5,
    },
}  # fmt: skip
"""What makes a family tiny."""


def tokenizer() -> Any:
    tokenizers = pytest.importorskip("tokenizers")
    known = {word: number for number, word in enumerate(["[PAD]", "[UNK]", "the", "task", "is", "semantic"])}
    words = tokenizers.Tokenizer(tokenizers.models.WordLevel(known, unk_token="[UNK]"))
    words.pre_tokenizer = tokenizers.pre_tokenizers.Whitespace()
    return transformers.PreTrainedTokenizerFast(tokenizer_object=words, pad_token="[PAD]", unk_token="[UNK]")


def published(folder: Path, family: str) -> str:
    """Publish a tiny network with random weights and its processor into a folder, as `save_pretrained` does."""
    sizes, size = dict(SIZES[family]), {"height": SIDE, "width": SIDE}
    if family == "MaskFormer":
        sizes["backbone_config"] = transformers.MaskFormerSwinConfig(
            **SWIN, out_features=[f"stage{k}" for k in (1, 2, 3, 4)]
        )
        sizes["decoder_config"] = transformers.DetrConfig(
            d_model=8, encoder_layers=1, decoder_layers=1, encoder_ffn_dim=8, decoder_ffn_dim=8, num_queries=5,
            encoder_attention_heads=2, decoder_attention_heads=2,
        )  # fmt: skip
    elif family != "Eomt":
        sizes["backbone_config"] = transformers.SwinConfig(**SWIN, out_features=[f"stage{k}" for k in (1, 2, 3, 4)])
    told: dict[str, Any] = {"size": size}
    if family == "Eomt":
        told = {"size": {"shortest_edge": SIDE, "longest_edge": None}, "do_split_image": True}
    if family == "OneFormer":
        info = {str(k): {"name": name, "isthing": 1} for k, name in enumerate(NAMES)}
        (folder / "info.json").write_text(json.dumps(info))
        told |= {"repo_path": str(folder), "class_info_file": "info.json", "num_text": 2}
        tokenizer().save_pretrained(folder)
    config = getattr(transformers, f"{family}Config")(**sizes, id2label=dict(enumerate(NAMES)))
    head = "Instance" if family == "MaskFormer" else "Universal"
    network = getattr(transformers, f"{family}For{head}Segmentation")(config)
    generator = torch.Generator().manual_seed(0)
    for name, parameter in network.named_parameters():  # answers that differ
        if parameter.dim() > 1:
            scale = 3.0 if "quer" in name else 0.3
            parameter.data = scale * torch.randn(parameter.shape, generator=generator)
    network.save_pretrained(folder)
    getattr(transformers, f"{family}ImageProcessor")(**told).save_pretrained(folder)
    return f"hf:{folder}"


@pytest.mark.island("advsearch.models.zoo")
@pytest.mark.medium
@ROUNDED
@pytest.mark.parametrize("family", SIZES)
def test_pixels_have_the_librarys_scores(tmp_path: Path, family: str) -> None:
    """Of a saved picture, by the library's processor, network and post-processing."""
    model = load_model(published(tmp_path, family), task="segmentation")
    Image.fromarray(np.asarray(PICTURE.mul(255).round(), np.uint8)).save(tmp_path / "seen.png")
    seen = Image.open(tmp_path / "seen.png")
    prepared = transformers.AutoImageProcessor.from_pretrained(tmp_path)
    given = prepared(images=seen, return_tensors="pt")
    asked = {"pixel_values": given["pixel_values"]}
    if family == "OneFormer":
        spoken = transformers.OneFormerProcessor(prepared, tokenizer(), task_seq_length=9)
        asked["task_inputs"] = spoken(images=seen, task_inputs=["semantic"], return_tensors="pt")["task_inputs"]
    with torch.no_grad():
        answer = transformers.AutoModelForUniversalSegmentation.from_pretrained(tmp_path).eval()(**asked)
    if family == "Eomt":
        answer.patch_offsets = given["patch_offsets"]
    (theirs,) = prepared.post_process_semantic_segmentation(
        answer, target_sizes=[(SIDE, SIDE)], return_segmentation_scores=True
    )
    ours = model(PICTURE)[0]
    assert (model.labels, model.input_size, ours.shape) == (NAMES, (SIDE, SIDE), (3, SIDE, SIDE))
    assert float((ours.exp() - theirs.segmentation_scores).abs().max()) < 1e-4
    assert ours.argmax(dim=0).equal(theirs.segmentation) and float(ours.std()) > 0.01


@pytest.mark.island("advsearch.models.zoo")
def test_the_gradient_agrees_with_differences(tmp_path: Path) -> None:
    """Along a direction, of MaskFormer: the attention of the others has thresholds."""
    model: Any = load_model(published(tmp_path, "MaskFormer"), task="segmentation")
    network = model.module.double()
    task, truth = Segmentation(labels=NAMES), SegmentationTruth((0,), torch.ones(SIDE, SIDE).bool())
    way = torch.randn((1, 3, SIDE, SIDE), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    at = PICTURE.permute(2, 0, 1)[None].double()

    def value(x: torch.Tensor) -> torch.Tensor:
        return task.pixel_margin(network(x), truth).sum()

    assert_slope(value, at, way, 1e-3, 1e-2)
