"""OWL-ViT and Grounding DINO as detectors of names that are given: tiny ones with random weights, beside the library's
own pipeline."""

from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image
from torch import Tensor, nn

import advsearch
from advsearch import load_model
from advsearch.models import Model
from small_models import SMALL_ATTACK, assert_slope

pytestmark = pytest.mark.island("advsearch.models.zoo")

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
@pytest.mark.parametrize("family", [*OWLS, *GROUNDED])
def test_its_gradient_is_that_of_differences(tmp_path: Path, family: str) -> None:
    """Of scores and boxes; Grounding DINO is kept from cutting its queries off from the picture."""
    model = load_model(published(tmp_path, family), labels=NAMES, task="detection")
    assert model.attached is (family in GROUNDED)
    _, image = picture_of(SIDES[family], tmp_path)
    image = image.mul(0.8).add(0.1).double()
    model.module.double()  # type: ignore[attr-defined]
    way = torch.randn(image.shape, generator=torch.Generator().manual_seed(1)).double()

    def value(given: Tensor) -> Tensor:
        boxes, scores = model.run_network(model.preprocessing(given), raw=True)
        total: Tensor = scores[0, :, 0].logit().sum() + boxes[0].mean()
        return total

    assert_slope(value, image, way, 1e-5, 0.01)


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
