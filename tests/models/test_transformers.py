"""Networks of transformers: tiny ones with random weights, fed as the library's own pipeline feeds them."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from advsearch.errors import InputError, ModelError
from advsearch.models import Model, load_model
from advsearch.models.zoo.transformers import HUB_TIMEOUT
from advsearch.tasks import Detection
from advsearch.tasks.boxes import DetectionTruth

pytestmark = pytest.mark.island("advsearch.models.zoo")

transformers = pytest.importorskip("transformers", reason="transformers is not installed: advsearch[hf]")
huggingface_hub = pytest.importorskip("huggingface_hub")

NAMES = ("mug", "bowl", "vase")
SIDE = 16
PICTURES = torch.rand((2, SIDE, SIDE, 3), generator=torch.Generator().manual_seed(0)).mul(255).round() / 255
HALF = {"image_mean": [0.5] * 3, "image_std": [0.25] * 3}
SIZE = {"size": {"height": SIDE, "width": SIDE}}


def published(folder: Path, architecture: str, prepared: Any = None, **more: Any) -> str:
    """Publish a tiny network into a folder, as `save_pretrained` does, with an image processor if one is given."""
    sizes: dict[str, Any] = {"hidden_size": 8, "num_hidden_layers": 1, "num_attention_heads": 2, "intermediate_size": 8}
    if "Segformer" in architecture:
        sizes = {"num_encoder_blocks": 1, "depths": [1], "sr_ratios": [1], "hidden_sizes": [8], "strides": [2]}
        sizes |= {"num_attention_heads": [1], "patch_sizes": [3], "mlp_ratios": [1], "decoder_hidden_size": 8}
    else:
        sizes |= {"image_size": SIDE, "patch_size": 8}
    family = architecture.partition("For")[0]
    more = {"id2label": dict(enumerate(NAMES)), **sizes, **more}
    torch.manual_seed(0)
    network = getattr(transformers, architecture)(getattr(transformers, f"{family}Config")(**more))
    for parameter in network.parameters():  # answers that differ
        if parameter.dim() > 1:
            nn.init.normal_(parameter, std=0.3)
    network.save_pretrained(folder)
    if prepared is not None:
        prepared.save_pretrained(folder)
    return f"hf:{folder}"


def processor(name: str, **settings: Any) -> Any:
    """A processor of the library that resizes to the size of the tiny networks."""
    return getattr(transformers, name)(**{**SIZE, **settings})


CROP = {"crop_size": {"height": SIDE, "width": SIDE}}
PROCESSORS: dict[str, tuple[str, dict[str, Any]]] = {
    "as usual": ("ViTImageProcessor", HALF),
    "not rescaled": ("ViTImageProcessor", {"do_rescale": False, "image_mean": [127.5] * 3, "image_std": [60.0] * 3}),
    "blue first": ("MobileViTImageProcessor", {"size": {"shortest_edge": 18}, **CROP}),
    "normalised twice": ("EfficientNetImageProcessor", {"include_top": True, **HALF}),
    "cropped": ("CLIPImageProcessor", {"size": {"shortest_edge": 20}, **CROP}),
}


@pytest.mark.parametrize("which", PROCESSORS)
def test_pictures_arrive_as_the_processor_gives_them(tmp_path: Path, which: str) -> None:
    """At the network's own size nothing is resized or cropped: what is left has to be the same."""
    name, settings = PROCESSORS[which]
    spec = published(tmp_path, "ViTForImageClassification", processor(name, **settings))
    model = load_model(spec)
    assert (model.labels, model.input_size) == (NAMES, (SIDE, SIDE))
    theirs = transformers.AutoImageProcessor.from_pretrained(tmp_path)
    levels = [np.asarray(one.mul(255).round(), np.uint8) for one in PICTURES]
    kept = {"do_resize": False} | ({"do_center_crop": False} if "crop_size" in settings else {})
    asked = torch.from_numpy(np.stack(theirs(images=levels, return_tensors="np", **kept)["pixel_values"]))
    scale = float(asked.abs().max())
    assert float((model.preprocessing(PICTURES) - asked).abs().max()) < 2e-6 * scale
    network = transformers.AutoModelForImageClassification.from_pretrained(tmp_path).eval()
    with torch.no_grad():
        logits = network(pixel_values=asked).logits
        assert float(logits.std()) > 0.05
        assert float((model(PICTURES) - logits).abs().max()) < 1e-4


class Weighs(transformers.BaseImageProcessor):  # type: ignore[misc,name-defined]
    """Resizes, bends values and mixes channels, with torch throughout."""

    do_resize = True
    weights = ((0.6, 0.3, 0.1), (0.2, 0.7, 0.1), (0.1, 0.2, 0.7))

    def __call__(self, images: Any, return_tensors: str, do_resize: bool = True) -> Any:
        x = images if isinstance(images, Tensor) else torch.from_numpy(np.array(images)).movedim(-1, 0).float()
        if do_resize:
            x = nn.functional.interpolate(x[None], (SIDE, SIDE), mode="bilinear", antialias=True)[0]
        x = torch.einsum("kc,chw->khw", torch.tensor(self.weights), (x / 255.0) ** 1.5) - 0.4
        return transformers.BatchFeature({"pixel_values": x[None]}, tensor_type=return_tensors)


def given_by(monkeypatch: pytest.MonkeyPatch, processor: Any) -> None:
    monkeypatch.setattr(transformers.AutoImageProcessor, "from_pretrained", lambda *_, **__: processor)


def test_a_processor_that_is_no_gain_and_offset_is_called(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec, processor_ = published(tmp_path, "ViTForImageClassification", processor("ViTImageProcessor")), Weighs()
    given_by(monkeypatch, processor_)
    model = load_model(spec)
    assert model.input_size == (SIDE, SIDE) and model.preprocessing.processor is not None
    network = transformers.AutoModelForImageClassification.from_pretrained(tmp_path)
    library = transformers.pipeline("image-classification", model=network, image_processor=processor_)
    for one in PICTURES:
        Image.fromarray(np.asarray(one.mul(255).round(), np.uint8)).save(tmp_path / "one.png")
        theirs = {found["label"]: found["score"] for found in library(str(tmp_path / "one.png"))}
        ours = dict(zip(NAMES, model(one)[0].softmax(dim=0).tolist(), strict=True))
        assert ours == pytest.approx(theirs, abs=1e-4) and max(ours.values()) < 0.99
    assert_gradient(model)
    with pytest.raises(InputError, match="std"):
        load_model(spec, std=0.5)


def assert_gradient(model: Model) -> None:
    """A step along the gradient changes the answer as the gradient says."""
    x = PICTURES[:1].clone().requires_grad_()
    gradient = torch.autograd.grad(model(x)[0, 0], x)[0]
    step = 1e-3 * gradient / gradient.abs().max()
    with torch.no_grad():
        seen = (model(x + step)[0, 0] - model(x - step)[0, 0]) / 2.0
    assert float(seen) == pytest.approx(float((gradient * step).sum()), rel=0.01)


def test_a_processor_that_can_be_neither_measured_nor_called_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = published(tmp_path, "ViTForImageClassification", processor("ViTImageProcessor"))

    def bent(picture: Any) -> Any:
        return (np.asarray(picture, np.float64).transpose(2, 0, 1)[None] / 255) ** 2.2

    def padded(picture: Any) -> Any:
        return np.pad(bent(picture) + 1.0, ((0, 0), (0, 0), (0, 4), (0, 4)))

    cases = ((bent, "gradient"), (padded, "pads"))
    for does, text in cases:

        def processed(images: Any, does: Callable[[Any], Any] = does, **_: Any) -> Any:
            return {"pixel_values": does(images)}

        given_by(monkeypatch, processed)
        with pytest.raises(ModelError, match=text):
            load_model(spec)


def test_it_finds_objects(tmp_path: Path) -> None:
    more = {"image_size": [SIDE, SIDE], "num_detection_tokens": 5}
    model = load_model(
        published(tmp_path, "YolosForObjectDetection", processor("ViTImageProcessor"), **more),
        read=lambda answer, count: list(zip(*answer, strict=True)),
    )
    boxes, scores = model(PICTURES)[0]
    assert boxes.shape == (5, 4)
    assert bool((boxes[:, :2] <= boxes[:, 2:]).all())
    assert scores.shape == (5, 3)
    assert 0.0 <= float(scores.min()) <= float(scores.max()) <= 1.0


class Asked(nn.Module):
    """A network of transformers in a module of one's own, which answers with the library's own output."""

    def __init__(self, network: Any) -> None:
        super().__init__()
        self.network = network

    def forward(self, x: Tensor) -> Any:
        return self.network(pixel_values=x)


def test_the_output_of_a_detector_is_read_as_the_library_reads_it(tmp_path: Path) -> None:
    more = {"image_size": [SIDE, SIDE], "num_detection_tokens": 5}
    prepared = processor("YolosImageProcessor")
    published(tmp_path, "YolosForObjectDetection", prepared, **more)
    network = transformers.YolosForObjectDetection.from_pretrained(tmp_path)
    model = load_model(Asked(network), input_size=SIDE, labels=NAMES, read=Detection(iou=0.5).output_reader)
    task = Detection(suppression=1.0, confidence=1e-6).on(model)
    with torch.no_grad():
        answer = network(pixel_values=PICTURES[:1].permute(0, 3, 1, 2))
        theirs = prepared.post_process_object_detection(answer, threshold=0.0, target_sizes=[(SIDE, SIDE)])[0]
    ours: Any = task.judge(model(PICTURES[:1]), DetectionTruth((0,), (0, 0, SIDE, SIDE), (SIDE, SIDE)))[0].payload
    best = int(theirs["scores"].argmax())
    (found,) = [one for one in ours["found"] if one["score"] == round(float(theirs["scores"][best]), 3)]
    assert found["label"] == NAMES[int(theirs["labels"][best])]
    assert found["box"] == [pytest.approx(x, abs=0.06) for x in theirs["boxes"][best].tolist()]


def test_weights_that_are_not_there_are_refused(tmp_path: Path) -> None:
    spec = published(tmp_path, "ViTForImageClassification", processor("ViTImageProcessor"))
    file = tmp_path / "model.safetensors"
    save_file({k: v for k, v in load_file(file).items() if "classifier" not in k}, file, metadata={"format": "pt"})
    with pytest.raises(ModelError, match=r"classifier\.bias"):
        load_model(spec)


def test_a_hub_out_of_reach_is_asked_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its client would try each of several files six times, which takes a minute."""
    asked: list[float] = []

    def out_of_reach(url: str, timeout: float) -> None:
        asked.append(timeout)
        raise ConnectionError("Name or service not known")

    (tmp_path / "models--owner--good").mkdir()
    monkeypatch.setattr(huggingface_hub, "get_hf_file_metadata", out_of_reach)
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path))
    monkeypatch.setattr(time, "sleep", lambda seconds: pytest.fail("the hub is asked again"))
    with pytest.raises(ModelError, match="hf:owner/good"):
        load_model("hf:owner/goood")
    assert asked == [HUB_TIMEOUT]


def test_it_never_unpickles(tmp_path: Path) -> None:
    spec = published(tmp_path, "ViTForImageClassification", processor("ViTImageProcessor"))
    torch.save(load_file(tmp_path / "model.safetensors"), tmp_path / "pytorch_model.bin")
    (tmp_path / "model.safetensors").unlink()
    with pytest.raises(ModelError, match=r"cannot be fetched or read"):
        load_model(spec)
