"""OWL-ViT and Grounding DINO as detectors of names that are given: tiny ones with random weights, beside the library's
own pipeline."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image
from torch import Tensor, nn

import advsearch
from advsearch import load_model
from advsearch.errors import AdvsearchError, InputError, ModelError
from advsearch.models import Model, ModelWarning
from advsearch.tasks import Detection
from small_models import SMALL_ATTACK

transformers = pytest.importorskip("transformers", reason="transformers is not installed: advsearch[hf]")

NAMES = ("mug", "coffee cup", "bowl")
WORDS = "a photo of this is the book mug cup bowl vase coffee".split()
MARKS = {"[PAD]": 0, "[UNK]": 100, "[CLS]": 101, "[SEP]": 102, ".": 1012, "?": 1029}
"""As in BERT's vocabulary: Grounding DINO knows its marks by these numbers."""
SIDES = {"OwlViT": 16, "Owlv2": 16, "GroundingDino": 64, "MMGroundingDino": 64}
OWLS, GROUNDED = ("OwlViT", "Owlv2"), ("GroundingDino", "MMGroundingDino")
SIZES = {"hidden_size": 8, "num_hidden_layers": 1, "num_attention_heads": 2, "intermediate_size": 8}
READS = {**SIZES, "vocab_size": 1040, "max_position_embeddings": 16, "pad_token_id": 0}


def tokenizer() -> Any:
    tokenizers = pytest.importorskip("tokenizers")
    known = {**MARKS, **{word: number + 1 for number, word in enumerate(WORDS)}}
    words = tokenizers.Tokenizer(tokenizers.models.WordLevel(known, unk_token="[UNK]"))
    words.pre_tokenizer = tokenizers.pre_tokenizers.BertPreTokenizer()
    words.normalizer = tokenizers.normalizers.Lowercase()
    words.post_processor = tokenizers.processors.TemplateProcessing(
        single="[CLS] $A [SEP]", special_tokens=[("[CLS]", 101), ("[SEP]", 102)]
    )
    special = {"pad_token": "[PAD]", "unk_token": "[UNK]", "cls_token": "[CLS]", "sep_token": "[SEP]"}
    return transformers.PreTrainedTokenizerFast(tokenizer_object=words, model_max_length=16, **special)


def made(family: str) -> Any:
    """A tiny network with random weights that are large enough for answers that differ, always the same."""
    if family in OWLS:
        seen = {**SIZES, "image_size": SIDES[family], "patch_size": 4}
        given: dict[str, Any] = {"vision_config": seen, "text_config": READS, "projection_dim": 8}
    else:
        swin = {"image_size": 64, "embed_dim": 8, "depths": [1, 1], "num_heads": [1, 2], "window_size": 4}
        backbone = transformers.SwinConfig(**swin, out_features=["stage1", "stage2"])
        part = {"layers": 1, "attention_heads": 2, "ffn_dim": 8}
        parts = {f"{side}_{key}": value for side in ("encoder", "decoder") for key, value in part.items()}
        text = transformers.BertConfig(**{**READS, "max_position_embeddings": 32})
        given = {"backbone_config": backbone, "text_config": text, "d_model": 32, "num_queries": 6, **parts}
        given |= {"num_feature_levels": 2, "max_text_len": 24, "decoder_layers": 2}
    network = getattr(transformers, f"{family}ForObjectDetection")(getattr(transformers, f"{family}Config")(**given))
    generator = torch.Generator().manual_seed(0)
    for parameter in network.parameters():
        if parameter.dim() > 1:
            parameter.data = torch.randn(parameter.shape, generator=generator) / parameter[0].numel() ** 0.5
        elif parameter.dim() == 0:  # else every score starts near 0
            parameter.data.zero_()
    return network.eval()


def published(folder: Path, family: str) -> str:
    """Publish a tiny network with its processor into a folder, as `save_pretrained` does."""
    made(family).save_pretrained(folder)
    side = SIDES[family]
    size: dict[str, Any] = {"size": {"height": side, "width": side}}
    if family == "OwlViT":
        size |= {"crop_size": size["size"]}
    kind = "GroundingDino" if family in GROUNDED else family
    picture = getattr(transformers, f"{kind}ImageProcessor")(**size)
    getattr(transformers, f"{kind}Processor")(picture, tokenizer()).save_pretrained(folder)
    return f"hf:{folder}"


def picture_of(side: int, folder: Path) -> tuple[Any, Tensor]:
    """A picture of noise as its file has it, and as a model is given it."""
    levels = torch.rand((side, side, 3), generator=torch.Generator().manual_seed(0)).mul(255).round().byte()
    Image.fromarray(levels.numpy()).save(folder / "picture.png")
    with Image.open(folder / "picture.png") as picture:
        return picture.copy(), levels[None] / 255.0


def theirs(folder: Path, picture: Any, texts: Any) -> tuple[Any, Any]:
    """What the library says of a picture, box by box, and what its network answered."""
    network = transformers.AutoModelForZeroShotObjectDetection.from_pretrained(folder).eval()
    prepared = transformers.AutoProcessor.from_pretrained(folder)
    given = prepared(images=picture, text=[texts], return_tensors="pt")
    with torch.no_grad():
        answer = network(**given)
    read = {"threshold": -1.0, "target_sizes": [picture.size[::-1]]}
    if "text_threshold" in prepared.post_process_grounded_object_detection.__code__.co_varnames:
        read["text_threshold"] = 0.0
    return prepared.post_process_grounded_object_detection(answer, **read)[0], (given, answer)


@pytest.mark.parametrize("family", OWLS)
def test_an_owl_says_what_its_library_says(tmp_path: Path, family: str) -> None:
    model = load_model(published(tmp_path, family), labels=NAMES, task="detection")
    side = SIDES[family]
    picture, image = picture_of(side, tmp_path)
    boxes, scores = both(model, image)
    asked, _ = theirs(tmp_path, picture, [f"a photo of a {name}" for name in NAMES])
    assert (model.labels, model.named, model.input_size) == (NAMES, True, (side, side))
    assert scores.shape == (16, 3) and float(scores.std()) > 0.01
    assert float((boxes - asked["boxes"]).abs().max()) < 1e-4 * side
    assert float((scores.amax(dim=1) - asked["scores"]).abs().max()) < 1e-4
    assert scores.argmax(dim=1).tolist() == asked["labels"].tolist()
    assert isinstance(model.module, nn.Module)
    assert not [key for key in model.module.state_dict() if "text" in key], "the half for texts is not kept"


def both(model: Model, image: Tensor) -> tuple[Tensor, Tensor]:
    (answer,) = model(image)
    return answer["boxes"], answer["scores"]


@pytest.mark.medium
@pytest.mark.parametrize("family", GROUNDED)
def test_a_grounded_one_says_what_its_library_says(tmp_path: Path, family: str) -> None:
    """The library's score of a box is the largest of all tokens, full stops and ends too; a name's is of its own."""
    model = load_model(published(tmp_path, family), labels=NAMES, task="detection")
    side = SIDES[family]
    picture, image = picture_of(side, tmp_path)
    boxes, scores = both(model, image)
    asked, (given, answer) = theirs(tmp_path, picture, list(NAMES))
    assert (model.labels, model.input_size) == (NAMES, (side, side))
    assert scores.shape == (6, 3) and float(scores.std()) > 0.01
    assert float((boxes - asked["boxes"]).abs().max()) < 1e-4 * side
    known = [tokenizer().decode([one]) for one in given["input_ids"][0].tolist()]
    assert known == ["[CLS]", "mug", ".", "coffee", "cup", ".", "bowl", ".", "[SEP]"]
    each = answer.logits[0].sigmoid()
    own = torch.stack([each[:, 1], each[:, 3:5].amax(dim=1), each[:, 6]], dim=1)
    assert float((scores - own).abs().max()) < 1e-4
    best = each.argmax(dim=1)
    of_names = (best[:, None] == torch.tensor([1, 3, 4, 6])).any(dim=1)
    assert bool(of_names.any()), "the library's score is one of a name's, in one box at least"
    assert float((scores.amax(dim=1) - asked["scores"])[of_names].abs().max()) < 1e-4


@pytest.mark.medium
@pytest.mark.parametrize("family", OWLS)
def test_prompts_are_averaged(tmp_path: Path, family: str) -> None:
    spec, prompts = published(tmp_path, family), ["a photo of a {}", "this is the {}"]
    network = transformers.AutoModelForZeroShotObjectDetection.from_pretrained(tmp_path).eval()
    picture, image = picture_of(SIDES[family], tmp_path)
    rows = []
    for prompt in prompts:
        _, (_, answer) = theirs(tmp_path, picture, [prompt.format(name) for name in NAMES])
        rows.append(answer.text_embeds[0])
    mean = nn.functional.normalize(torch.stack(rows).mean(dim=0), dim=-1)
    features = answer.image_embeds.flatten(1, 2)
    with torch.no_grad():
        asked = network.class_predictor(features, mean[None], None)[0].sigmoid()[0]
    for given in (prompts, " | ".join(prompts)):
        _, scores = both(load_model(spec, labels=NAMES, prompt=given, task="detection"), image)
        assert float((scores - asked).abs().max()) < 1e-4
    _, alone = both(load_model(spec, labels=NAMES, task="detection"), image)
    assert float((alone - asked).abs().max()) > 1e-3, "one prompt says something else"


@pytest.mark.medium
def test_a_prompt_goes_round_each_name_of_one_text(tmp_path: Path) -> None:
    spec = published(tmp_path, "GroundingDino")
    picture, image = picture_of(SIDES["GroundingDino"], tmp_path)
    _, scores = both(load_model(spec, labels=NAMES[:2], prompt="the {}", task="detection"), image)
    _, (given, answer) = theirs(tmp_path, picture, ["the mug", "the coffee cup"])
    each = answer.logits[0].sigmoid()
    assert len(given["input_ids"][0]) == 9
    assert float((scores - torch.stack([each[:, 1:3].amax(1), each[:, 4:7].amax(1)], dim=1)).abs().max()) < 1e-4


@pytest.mark.medium
@pytest.mark.parametrize("family", [*OWLS, *GROUNDED])
def test_its_gradient_is_that_of_differences(tmp_path: Path, family: str) -> None:
    """Of scores and boxes; Grounding DINO is kept from cutting its queries off from the picture."""
    model = load_model(published(tmp_path, family), labels=NAMES, task="detection")
    assert model.attached is (family in GROUNDED)
    _, image = picture_of(SIDES[family], tmp_path)
    image = image.mul(0.8).add(0.1).double().requires_grad_()
    model.module.double()  # type: ignore[attr-defined]
    way = torch.randn(image.shape, generator=torch.Generator().manual_seed(1)).double()

    def value(given: Tensor) -> Tensor:
        boxes, scores = model.run_network(model.preprocessing(given), raw=True)
        total: Tensor = scores[0, :, 0].logit().sum() + boxes[0].mean()
        return total

    gradient = torch.autograd.grad(value(image), image)[0]
    with torch.no_grad():
        seen = (value(image + 1e-5 * way) - value(image - 1e-5 * way)) / 2e-5
    assert float(seen) == pytest.approx(float((gradient * way).sum()), rel=0.01)


def test_a_network_from_python_brings_its_tokenizer(tmp_path: Path) -> None:
    published(tmp_path, "Owlv2")
    network = transformers.Owlv2ForObjectDetection.from_pretrained(tmp_path).train()
    _, image = picture_of(16, tmp_path)
    ours = both(load_model(network, labels=["mug"], task="detection"), image)
    theirs = both(load_model(f"hf:{tmp_path}", labels=["mug"], task="detection"), image)
    assert float((ours[1] - theirs[1]).abs().max()) < 1e-5 and ours[1].shape == (16, 1)
    assert network.owlv2.text_model is not None and network.training, "the caller's network is left as it is"


DETECTS: dict[str, Any] = {"labels": NAMES, "task": "detection"}
WRONG: dict[str, tuple[str, dict[str, Any], type[AdvsearchError], str]] = {
    "no names": ("Owlv2", {"task": "detection"}, InputError, "finds what it is told to and has no classes of its own"),
    "a classifier": ("Owlv2", {}, ModelError, "cannot do task classification; use `task=detection`"),
    "a segmenter": (
        "OwlViT",
        {"labels": NAMES, "task": "segmentation"},
        ModelError,
        "finds what it is told to and cannot do task segmentation; use `task=detection`",
    ),
    "no place": ("Owlv2", {**DETECTS, "prompt": "a photo"}, InputError, "prompt: expected a text with {} where the"),
    "too long": ("OwlViT", {**DETECTS, "prompt": "a {}" + " a" * 14}, InputError, "at most 16 tokens, got 18: 'a mug"),
    "several prompts": (
        "GroundingDino",
        {**DETECTS, "prompt": "a {} | the {}"},
        InputError,
        "reads all names in one text, in which several prompts can't be averaged; give one, or none",
    ),
    "full stops": (
        "GroundingDino",
        {**DETECTS, "labels": ["mug", "cup. bowl"]},
        InputError,
        "in which these 2 are 3; leave . and [?] out of names and prompt",
    ),
    "too many": (
        "MMGroundingDino",
        {**DETECTS, "labels": [f"bowl {'the ' * number}" for number in range(1, 7)]},
        InputError,
        "reads a text of at most 24 tokens, and the names take 35; give fewer",
    ),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_wrong_uses_are_refused(tmp_path: Path, wrong: str) -> None:
    family, given, error, text = WRONG[wrong]
    with pytest.raises(error, match=text):
        load_model(published(tmp_path, family), **given)


def test_what_its_boxes_are_is_known(tmp_path: Path) -> None:
    """They are not guessed from what they look like: here they are smaller than a pixel, and wrong."""
    model = load_model(published(tmp_path, "Owlv2"), labels=NAMES, task="detection")
    task = Detection().on(model)
    tiny: Any = [{"boxes": torch.tensor([[0.2, 0.2, 0.4, 0.9]]), "scores": torch.tensor([[0.9, 0.1, 0.1]])}]
    assert not task.calibrates and task.after_calibration(tiny, None).inferred_unit == "pixels"
    assert Detection(boxes="xywh").on(model).calibrates, "what is said counts, and is compared"


def test_names_that_are_the_same_text_are_said(tmp_path: Path) -> None:
    with pytest.warns(ModelWarning, match=r"reads 'mug' \(#0\) and 'Mug' \(#1\) as the same text"):
        load_model(published(tmp_path, "Owlv2"), labels=["mug", "Mug"], task="detection")


@pytest.mark.medium
@pytest.mark.parametrize("family", ["Owlv2", "GroundingDino"])
def test_it_is_attacked_by_name(tmp_path: Path, family: str) -> None:
    result = advsearch.attack(
        "mug",
        published(tmp_path / "net", family),
        labels=list(NAMES),
        label="mug",
        task={"name": "detection", "confidence": 0.001, "iou": 0.0001},
        objective="vanish",
        policy="random",
        **SMALL_ATTACK,
        run=tmp_path / "run",
    )
    assert result.summary.ending != "already wrong", "the clean picture is right, and the answer was judged"
    assert len(list(result.rows("verification"))) == 6
    assert "labels: mug,coffee cup,bowl" in (tmp_path / "run" / "run.yaml").read_text()
