"""CLIP and SigLIP as classifiers of names that are given: tiny ones with random weights, beside the library's own."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from advsearch.models import load_model
from small_models import assert_slope, loud

transformers = pytest.importorskip("transformers", reason="transformers is not installed: advsearch[hf]")

SIDE = 16
NAMES = ("mug", "cup", "bowl", "vase")
WORDS = "a photo of this is the book bad big , . mug cup bowl vase coffee".split()
SPECIAL = ["[PAD]", "[UNK]", "[CLS]", "[SEP]"]
PICTURES = torch.rand((2, SIDE, SIDE, 3), generator=torch.Generator().manual_seed(0)).mul(255).round() / 255
SIZES = {"hidden_size": 8, "num_hidden_layers": 1, "num_attention_heads": 2, "intermediate_size": 8}
READS = {
    "vocab_size": 40,
    "max_position_embeddings": 12,
    "pad_token_id": 0,
    "bos_token_id": 2,
    "eos_token_id": 3,
    "attention_dropout": 0.5,
}
SIGLIP = pytest.mark.filterwarnings("ignore:.*scores each name independently")
pytestmark = [SIGLIP, pytest.mark.island("advsearch.models.zoo")]


def tokenizer() -> Any:
    tokenizers = pytest.importorskip("tokenizers")
    known = {word: number for number, word in enumerate([*SPECIAL, *WORDS])}
    words = tokenizers.Tokenizer(tokenizers.models.WordLevel(known, unk_token="[UNK]"))
    words.pre_tokenizer = tokenizers.pre_tokenizers.BertPreTokenizer()
    words.normalizer = tokenizers.normalizers.Lowercase()
    words.post_processor = tokenizers.processors.TemplateProcessing(
        single="[CLS] $A [SEP]", special_tokens=[("[CLS]", 2), ("[SEP]", 3)]
    )
    marks = dict(zip(("pad_token", "unk_token", "bos_token", "eos_token"), SPECIAL, strict=True))
    return transformers.PreTrainedTokenizerFast(tokenizer_object=words, model_max_length=12, **marks)


def published(folder: Path, family: str = "CLIP", *, picture: dict[str, Any] | None = None) -> str:
    """Publish a tiny network with its processor into a folder, as `save_pretrained` does."""
    seen = {"image_size": SIDE, "patch_size": 8, **SIZES, **(picture or {})}
    config = getattr(transformers, f"{family}Config")(vision_config=seen, text_config={**SIZES, **READS})
    network = loud(getattr(transformers, f"{family}Model")(config))
    network.logit_scale.data.fill_(3.0)
    if family == "Siglip":
        network.logit_bias.data.fill_(-3.0)
    network.save_pretrained(folder)
    size: dict[str, Any] = {"size": {"height": SIDE, "width": SIDE}}
    if family == "CLIP":
        size = {"size": {"shortest_edge": SIDE}, "crop_size": {"height": SIDE, "width": SIDE}}
    prepared = getattr(transformers, f"{family}ImageProcessor")(**({} if family == "Siglip2" else size))
    getattr(transformers, f"{family}Processor")(prepared, tokenizer()).save_pretrained(folder)
    return f"hf:{folder}"


def theirs(folder: Path, texts: list[str]) -> Tensor:
    """What the library says of the pictures: `logits_per_image`."""
    network = transformers.AutoModel.from_pretrained(folder).eval()
    prepared = transformers.AutoProcessor.from_pretrained(folder)
    levels = [np.asarray(one.mul(255).round(), np.uint8) for one in PICTURES]
    padding = "max_length" if isinstance(network, transformers.SiglipModel) else True
    given = prepared(text=texts, images=levels, return_tensors="pt", padding=padding)
    with torch.no_grad():
        logits: Tensor = network(**given).logits_per_image
    return logits


@pytest.mark.parametrize("family", ["CLIP", "Siglip"])
def test_logits_are_the_librarys(tmp_path: Path, family: str) -> None:
    model = load_model(published(tmp_path, family), labels="mug, cup,bowl,vase")
    asked = theirs(tmp_path, [f"a photo of a {name}" for name in NAMES])
    assert (model.labels, model.named, model.input_size) == (NAMES, True, (SIDE, SIDE))
    assert float(asked.std(dim=1).min()) > 0.01
    assert float((model(PICTURES) - asked).abs().max()) < 1e-4
    assert isinstance(model.module, nn.Module)
    assert not [key for key in model.module.state_dict() if "text" in key], "the half for texts is not kept"


@pytest.mark.medium
@pytest.mark.parametrize("family", ["CLIP", "Siglip"])
def test_prompts_are_averaged(tmp_path: Path, family: str) -> None:
    spec, prompts = published(tmp_path, family), ["a photo of a {}", "the bad {}.", "{}"]
    network = transformers.AutoModel.from_pretrained(tmp_path).eval()
    rows = []
    for prompt in prompts:
        texts = [prompt.format(name) for name in NAMES]
        padding = "max_length" if family == "Siglip" else True
        given = tokenizer()(texts, return_tensors="pt", padding=padding, return_token_type_ids=False)
        with torch.no_grad():
            row = network.get_text_features(**given).pooler_output
        rows.append(row / row.norm(dim=-1, keepdim=True))
    mean = torch.stack(rows).mean(dim=0)
    mean = mean / mean.norm(dim=-1, keepdim=True)
    for given_as in (prompts, " | ".join(prompts)):
        model = load_model(spec, labels=NAMES, prompt=given_as)
        with torch.no_grad():
            image = network.get_image_features(pixel_values=model.preprocessing(PICTURES)).pooler_output
            asked = network.logit_scale.exp() * (image / image.norm(dim=-1, keepdim=True)) @ mean.T
            asked = asked + (network.logit_bias if family == "Siglip" else 0.0)
        assert float((model(PICTURES) - asked).abs().max()) < 1e-4
    alone = load_model(spec, labels=NAMES)(PICTURES)
    assert float((alone - asked).abs().max()) > 1e-3, "one prompt says something else"


@pytest.mark.parametrize("family", ["CLIP", "Siglip"])
def test_its_gradient_is_that_of_differences(tmp_path: Path, family: str) -> None:
    model = load_model(published(tmp_path, family), labels=NAMES)
    way = torch.randn(PICTURES[0].shape, generator=torch.Generator().manual_seed(1))

    def lead(image: Tensor) -> Tensor:
        first, second, *_ = model(image)[0]
        return torch.sub(first, second)

    assert_slope(lead, PICTURES[0].mul(0.8).add(0.1), way, 2e-3, 0.02)
