"""LLaVA, Qwen-VL and their like as classifiers of names: tiny ones with random weights, beside the library's own."""

import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import advsearch
from advsearch.errors import ModelError
from advsearch.models import Model, load_model
from advsearch.models.zoo import transformers as own
from small_models import loud

pytestmark = pytest.mark.island("advsearch.models.zoo")

transformers = pytest.importorskip("transformers", reason="transformers is not installed: advsearch[hf]")

TORCHVISION = importlib.util.find_spec("torchvision") is not None
NAMES = ("mug", "coffee mug", "cup", "tea cup", "tea bowl")
QUESTION = "what is on the table ?"
MARKS = ["<image>", "<|vision_start|>", "<|vision_end|>", "<|image_pad|>", "<|video_pad|>"]
SPECIAL = ["[PAD]", "[UNK]", "<s>", "</s>", *MARKS]
WORDS = "user assistant what is on the this table ? : mug cup bowl tea coffee answer with its name only .".split()
KNOWN = {word: number for number, word in enumerate([*SPECIAL, *WORDS])}
SIZES = {"hidden_size": 16, "num_hidden_layers": 2, "num_attention_heads": 2, "intermediate_size": 16}
READS = {
    **SIZES,
    "num_key_value_heads": 1,
    "vocab_size": 48,
    "max_position_embeddings": 64,
    "pad_token_id": 0,
    "bos_token_id": 2,
    "eos_token_id": 3,
}
TEMPLATE = (
    "{% for message in messages %}{{ message.role }} : {% for part in message.content %}"
    "{% if part.type == 'image' %}PICTURE{% else %}{{ part.text }}{% endif %}{% endfor %} {% endfor %}"
    "{% if add_generation_prompt %}assistant :{% endif %}"
)


def tokenizer(**more: Any) -> Any:
    tokenizers = pytest.importorskip("tokenizers")
    words = tokenizers.Tokenizer(tokenizers.models.WordLevel(KNOWN, unk_token="[UNK]"))
    words.pre_tokenizer = tokenizers.pre_tokenizers.BertPreTokenizer()
    marks = dict(zip(("pad_token", "unk_token", "bos_token", "eos_token"), SPECIAL, strict=False))
    return transformers.PreTrainedTokenizerFast(
        tokenizer_object=words, additional_special_tokens=MARKS, **marks, **more
    )


def llava(template: str | None = TEMPLATE) -> tuple[Any, Any]:
    seen = transformers.CLIPVisionConfig(image_size=16, patch_size=8, **SIZES)
    config = transformers.LlavaConfig(
        vision_config=seen, text_config=transformers.LlamaConfig(**READS), image_token_index=KNOWN["<image>"]
    )
    processor = transformers.LlavaProcessor(
        transformers.CLIPImageProcessor(size={"shortest_edge": 16}, crop_size={"height": 16, "width": 16}),
        tokenizer(extra_special_tokens={"image_token": "<image>"}),
        patch_size=8,
        vision_feature_select_strategy="default",
        num_additional_image_tokens=1,
        chat_template=template and template.replace("PICTURE", "<image>"),
    )
    return transformers.LlavaForConditionalGeneration(config), processor


def qwen_config() -> Any:
    seen = {"depth": 2, "hidden_size": 16, "num_heads": 2, "intermediate_size": 16, "out_hidden_size": 16}
    turned = {"rope_type": "default", "mrope_section": [1, 1, 2]}
    ends = {f"vision_{end}_token_id": KNOWN[f"<|vision_{end}|>"] for end in ("start", "end")}
    return transformers.Qwen2_5_VLConfig(
        vision_config=seen,
        text_config={**READS, "rope_parameters": turned},
        image_token_id=KNOWN["<|image_pad|>"],
        video_token_id=KNOWN["<|video_pad|>"],
        **ends,
    )


def qwen() -> tuple[Any, Any]:
    processor = transformers.Qwen2_5_VLProcessor(
        transformers.Qwen2VLImageProcessor(min_pixels=28 * 28, max_pixels=56 * 56),
        tokenizer(),
        transformers.Qwen2VLVideoProcessor(),
        chat_template=TEMPLATE.replace("PICTURE", "<|vision_start|><|image_pad|><|vision_end|>"),
    )
    return transformers.Qwen2_5_VLForConditionalGeneration(qwen_config()), processor


def published(folder: Path, made: tuple[Any, Any], dtype: torch.dtype = torch.float32) -> str:
    """Publish a tiny network with its processor into a folder, as `save_pretrained` does."""
    network, processor = made
    loud(network).to(dtype).save_pretrained(folder)
    processor.save_pretrained(folder)
    return f"hf:{folder}"


def levels(model: Model) -> Any:
    """A picture of noise in 8 bits, (H, W, 3), as a PNG keeps it."""
    return np.random.default_rng(0).integers(0, 256, (*model.input_size, 3), np.uint8)


def shown(model: Model) -> Tensor:
    """What a model says of that picture, (1, names)."""
    answer: Tensor = model(torch.from_numpy(levels(model)).float() / 255.0)
    return answer


def theirs(folder: Path, picture: Any, question: str = QUESTION) -> Tensor:
    """The log-likelihood of each name by the library alone: each whole text is read from its beginning."""
    network = transformers.AutoModelForImageTextToText.from_pretrained(folder).eval()
    processor = transformers.AutoProcessor.from_pretrained(folder)
    parts = [{"type": "image"}, {"type": "text", "text": question}]
    text = f"<image>{question}"
    if processor.chat_template:
        text = processor.apply_chat_template([{"role": "user", "content": parts}], add_generation_prompt=True)
    found = []
    for name in NAMES:
        given = processor(images=[picture], text=[f"{text} {name}"], return_tensors="pt")
        words = len(name.split())
        with torch.no_grad():
            likely = network(**given).logits[0, -words - 1 : -1].float().log_softmax(dim=-1)
        found.append(likely.gather(1, given["input_ids"][0, -words:, None]).sum())
    return torch.stack(found)


def loaded(folder: Path, family: str, **more: Any) -> Model:
    """A model of a family; Qwen's is shown 56 x 56 pixels, which its processor leaves as they are."""
    if family == "qwen":
        if not TORCHVISION:
            pytest.skip("the library's processor of Qwen-VL needs torchvision")
        more = {"input_size": 56, **more}
    made: dict[str, Callable[[], tuple[Any, Any]]]
    made = {"llava": llava, "qwen": qwen, "no template": lambda: llava(None)}
    return load_model(published(folder, made[family]()), labels=NAMES, prompt=QUESTION, **more)


@pytest.mark.medium
@pytest.mark.parametrize("family", ["llava", "qwen", "no template"])
def test_scores_are_the_librarys_log_likelihoods(tmp_path: Path, family: str) -> None:
    model = loaded(tmp_path, family)
    asked = theirs(tmp_path, levels(model))
    assert (model.labels, model.named, model.batch_limits) == (NAMES, True, (1, 1))
    assert float(asked.std()) > 0.5
    assert float((shown(model)[0] - asked).abs().max()) < 1e-4


@pytest.mark.parametrize("family", ["llava", "qwen"])
def test_its_gradient_is_that_of_differences(tmp_path: Path, family: str) -> None:
    model = loaded(tmp_path, family)
    weights = torch.linspace(-1.0, 1.0, len(NAMES))
    image = (torch.from_numpy(levels(model)).float() / 255.0 * 0.8 + 0.1).requires_grad_()
    gradient = torch.autograd.grad((model(image)[0] * weights).sum(), image)[0]
    way = torch.randn(image.shape, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        ends = [(model(image + size * way)[0] * weights).sum() for size in (2e-3, -2e-3)]
    assert float(ends[0] - ends[1]) / 4e-3 == pytest.approx(float((gradient * way).sum()), rel=0.02)


@pytest.mark.filterwarnings("ignore:__array__ implementation")
def test_a_prompt_that_is_read_both_ways_does_not_see_the_name(tmp_path: Path) -> None:
    """PaliGemma reads picture and prompt in both directions, and what is said after them in one."""
    config = transformers.PaliGemmaConfig(
        vision_config={"image_size": 16, "patch_size": 8, **SIZES},
        text_config={"model_type": "gemma", "head_dim": 8, **READS},
        image_token_index=KNOWN["<image>"],
        projection_dim=16,
        hidden_size=16,
        vocab_size=READS["vocab_size"],
    )
    prepared = transformers.SiglipImageProcessor(size={"height": 16, "width": 16})
    prepared.image_seq_length = 4
    words = tokenizer(extra_special_tokens={"image_token": "<image>"})
    words.add_tokens = lambda names: 0  # of places, a thousand of them
    processor = transformers.PaliGemmaProcessor(prepared, words)
    network = transformers.PaliGemmaForConditionalGeneration(config)
    model = load_model(published(tmp_path, (network, processor)), labels=NAMES, prompt=QUESTION)
    network.eval()
    for number, name in enumerate(NAMES):
        given = processor(images=[levels(model)], text=[f"<image>{QUESTION}"], suffix=[name], return_tensors="pt")
        told = {key: value[:, :-1] if value.ndim == 2 else value for key, value in given.items() if key != "labels"}
        count = len(name.split())
        with torch.no_grad():
            likely = network(**told).logits[0, -count - 1 : -1].log_softmax(dim=-1)
        asked = float(likely.gather(1, told["input_ids"][0, -count:, None]).sum())
        assert float(shown(model)[0, number]) == pytest.approx(asked, abs=1e-4)


def spoken(folder: Path, picture: Any, count: int) -> str:
    """What the library's own greedy decoding says of a picture."""
    network = transformers.AutoModelForImageTextToText.from_pretrained(folder).eval()
    processor = transformers.AutoProcessor.from_pretrained(folder)
    parts = [{"type": "image"}, {"type": "text", "text": QUESTION}]
    text = processor.apply_chat_template([{"role": "user", "content": parts}], add_generation_prompt=True)
    given = processor(images=[picture], text=[text], return_tensors="pt")
    tokens = network.generate(**given, do_sample=False, max_new_tokens=count)[0, given["input_ids"].shape[1] :]
    said: str = processor.decode(tokens, skip_special_tokens=True)
    return said


@pytest.mark.medium
@pytest.mark.parametrize("family", ["llava", "qwen"])
def test_a_free_answer_is_the_librarys(tmp_path: Path, family: str) -> None:
    if family == "qwen" and not TORCHVISION:
        pytest.skip("the library's processor of Qwen-VL needs torchvision")
    spec = published(tmp_path, llava() if family == "llava" else qwen())
    model = advsearch.load_model(
        spec, task={"name": "answer", "tokens": 6}, prompt=QUESTION, input_size=16 if family == "llava" else 56
    )
    (said,) = model(torch.from_numpy(levels(model)).float() / 255.0)
    assert said["text"] == spoken(tmp_path, levels(model), 6) != ""
    assert said["logits"].shape[1:] == (READS["vocab_size"],) and said["begins"]("mug") == [KNOWN["mug"]]


def test_weights_larger_than_the_memory_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = published(tmp_path / "net", llava())
    told = tmp_path / "meminfo"
    told.write_text("MemTotal: 99 kB\nMemAvailable: 10 kB\nSwapFree: 2 kB\n")
    monkeypatch.setattr(own, "MEMORY_FILE", told)
    with pytest.raises(ModelError, match=r"its weights take 5.*e-05 GB, and 1.23e-05 GB of memory are free"):
        load_model(spec, labels=NAMES)
