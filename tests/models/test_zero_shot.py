"""CLIP and SigLIP as classifiers of names that are given: tiny ones with random weights, beside the library's own."""

from __future__ import annotations

from functools import wraps
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

import advsearch
from advsearch.errors import AdvsearchError, FileFormatError, InputError, ModelError
from advsearch.models import Model, ModelWarning, load_model
from advsearch.models.labels import read_labels
from advsearch.tasks.depth import Depth
from small_models import SMALL_ATTACK

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
SIGMOID = "judges each name by itself, with a sigmoid of its logit: the scores that are shown are a softmax over the"
SIGLIP = pytest.mark.filterwarnings("ignore:.*judges each name by itself")


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


def loud(network: Any) -> Any:
    """The network with random weights that are large enough for answers that differ, always the same."""
    generator = torch.Generator().manual_seed(0)
    for name, parameter in network.named_parameters():
        if parameter.dim() > 1 or "embedding" in name:
            parameter.data = torch.randn(parameter.shape, generator=generator) * 0.3
    return network


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


@SIGLIP
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
@pytest.mark.parametrize("family", ["AltCLIP", "ChineseCLIP", "Align"])
def test_other_pairs_are_read_likewise(tmp_path: Path, family: str) -> None:
    """Whatever has two such halves is compared with the library's own score when it is loaded."""
    texts = [f"a photo of a {name}" for name in NAMES]
    side = 64 if family == "Align" else SIDE
    seen: dict[str, Any] = {"image_size": SIDE, "patch_size": 8, **SIZES}
    reads: dict[str, Any] = {**SIZES, **READS, "max_position_embeddings": 20}
    if family == "Align":
        seen = {"width_coefficient": 0.1, "depth_coefficient": 0.1, "image_size": side, "hidden_dim": 8}
    config = getattr(transformers, f"{family}Config")(
        vision_config=seen, text_config=reads, projection_dim=32 if family == "Align" else 8
    )
    network = loud(getattr(transformers, f"{family}Model")(config)).eval()
    network.save_pretrained(tmp_path)
    tokenizer().save_pretrained(tmp_path)
    transformers.ViTImageProcessor(size={"height": side, "width": side}).save_pretrained(tmp_path)
    model = load_model(f"hf:{tmp_path}", labels=NAMES)
    network = transformers.AutoModel.from_pretrained(tmp_path).eval()
    given = tokenizer()(texts, return_tensors="pt", padding=True, return_token_type_ids=False)
    with torch.no_grad():
        asked = network(pixel_values=model.preprocessing(PICTURES), **given).logits_per_image
    assert float((model(PICTURES) - asked).abs().max()) < 1e-4


@pytest.mark.medium
@SIGLIP
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


@SIGLIP
@pytest.mark.parametrize("family", ["CLIP", "Siglip"])
def test_its_gradient_is_that_of_differences(tmp_path: Path, family: str) -> None:
    model = load_model(published(tmp_path, family), labels=NAMES)
    image = PICTURES[0].mul(0.8).add(0.1).requires_grad_()
    gradient = torch.autograd.grad(_lead(model, image), image)[0]
    way = torch.randn(image.shape, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        seen = (_lead(model, image + 2e-3 * way) - _lead(model, image - 2e-3 * way)) / 4e-3
    assert float(seen) == pytest.approx(float((gradient * way).sum()), rel=0.02)


def _lead(model: Model, image: Tensor) -> Tensor:
    logits = model(image)[0]
    lead: Tensor = logits[0] - logits[1]
    return lead


def test_scores_of_a_sigmoid_are_said_to_be_such(tmp_path: Path) -> None:
    with pytest.warns(ModelWarning, match=SIGMOID):
        load_model(published(tmp_path, "Siglip"), labels=NAMES)


def test_of_synonyms_the_first_is_read(tmp_path: Path) -> None:
    spec = published(tmp_path)
    model = load_model(spec, labels=["mug, coffee mug", "cup", "bowl, book", "bowl, vase"], prompt="{}")
    asked = theirs(tmp_path, ["mug", "cup", "bowl, book", "bowl, vase"])
    assert float((model(PICTURES) - asked).abs().max()) < 1e-4
    assert model.label_set("coffee mug").indices == (0,)


def test_many_names_are_read_in_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = published(tmp_path)
    together = load_model(spec, labels=NAMES)(PICTURES)
    monkeypatch.setattr("advsearch.models.zoo.zero_shot.TEXT_BATCH_SIZE", 3)
    assert float((load_model(spec, labels=NAMES)(PICTURES) - together).abs().max()) < 1e-4
    with pytest.warns(ModelWarning, match=r"reads 'airplane' \(#0\) and 'automobile' \(#1\) as the same"):
        assert load_model(spec, labels="cifar10").labels == read_labels("cifar10")


def test_a_network_from_python_brings_its_tokenizer(tmp_path: Path) -> None:
    published(tmp_path)
    network = transformers.CLIPModel.from_pretrained(tmp_path).train()
    model = load_model(network, labels=NAMES)
    assert float((model(PICTURES) - load_model(f"hf:{tmp_path}", labels=NAMES)(PICTURES)).abs().max()) < 1e-5
    assert network.text_model is not None and network.training, "the caller's network is left as it is"
    made = transformers.CLIPModel(transformers.CLIPConfig(vision_config=SIZES, text_config=SIZES))
    with pytest.warns(ModelWarning, match=r"reads 'mug' \(#0\) and 'mug' \(#2\) as the same text"):
        load_model(network, labels=["mug", "cup", "mug", "bowl"])
    with pytest.raises(ModelError, match="Give a repository, or a folder, in which it is beside the network"):
        load_model(made, labels=NAMES)


WRONG: dict[str, tuple[dict[str, Any], type[AdvsearchError], str]] = {
    "no names": ({}, InputError, "has no classes of its own: name them, .* such as `labels=mug,cup,bowl`"),
    "another task": ({"task": Depth()}, ModelError, "cannot do task depth; use `task=classification`"),
    "one name": ({"labels": ["mug"]}, InputError, "expected two names at least, .* got 'mug'"),
    "one word": ({"labels": "mug"}, FileFormatError, "label file mug: .*, and several names have commas between them"),
    "no such file": ({"labels": "a,b.json"}, FileFormatError, r"label file a,b\.json: cannot be read"),
    "an empty name": ({"labels": "mug,,cup"}, InputError, "labels: expected a name .* for class 1, got ''"),
    "no place": ({"labels": NAMES, "prompt": "a photo"}, InputError, "prompt: expected a text with {} where the name"),
    "one no place": ({"labels": NAMES, "prompt": "a {}|b"}, InputError, "prompt: expected a text .* got 'b'"),
    "no prompt": ({"labels": NAMES, "prompt": []}, InputError, "prompt: expected a text, such as"),
    "too long": ({"labels": NAMES, "prompt": "a {}" + " a" * 12}, InputError, "at most 12 tokens, got 16: 'a mug a a"),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_wrong_uses_are_refused(tmp_path: Path, wrong: str) -> None:
    given, error, text = WRONG[wrong]
    with pytest.raises(error, match=text):
        load_model(published(tmp_path), **given)


def test_patches_are_refused(tmp_path: Path) -> None:
    spec = published(tmp_path, "Siglip2", picture={"num_patches": 4})
    with pytest.raises(ModelError, match=r"takes patches of pictures of any size \(NaFlex\)"):
        load_model(spec, labels=NAMES)


def test_repositories_of_open_clip_are_refused(tmp_path: Path) -> None:
    (tmp_path / "open_clip_config.json").write_text("{}")
    with pytest.raises(ModelError, match="is a repository of open_clip, which transformers can't read; give the netw"):
        load_model(f"hf:{tmp_path}", labels=NAMES)


def test_scores_of_another_kind_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = published(tmp_path)
    forward = transformers.CLIPModel.forward

    @wraps(forward)
    def moved(network: Any, **given: Any) -> Any:
        answer = forward(network, **given)
        answer.logits_per_image = answer.logits_per_image + 1.0
        return answer

    monkeypatch.setattr(transformers.CLIPModel, "forward", moved)
    with pytest.raises(ModelError, match="is a CLIPModel, whose scores are no scaled cosine"):
        load_model(spec, labels=NAMES)


@pytest.mark.medium
def test_it_is_attacked_by_name(tmp_path: Path) -> None:
    given: dict[str, Any] = {"labels": list(NAMES), "prompt": ["a photo of a {}", "the {}"], "label": "mug,cup"}
    result = advsearch.attack(
        "mug",
        published(tmp_path / "clip"),
        **given,
        policy="random",
        **SMALL_ATTACK,
        run=tmp_path / "run",
    )
    assert result.summary.ending in ("found", "budget spent"), "the clean picture is right, and the answer was judged"
    assert len(list(result.rows("verification"))) == 6
    kept = (tmp_path / "run" / "run.yaml").read_text()
    assert "labels: mug,cup,bowl,vase" in kept and "prompt: a photo of a {} | the {}" in kept
