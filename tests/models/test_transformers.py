"""Networks of transformers: tiny ones with random weights, fed as the library's own pipeline feeds them."""

from __future__ import annotations

import json
import time
import types
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
from advsearch.models import Model, ModelWarning, load_model
from advsearch.models.source import Purpose
from advsearch.models.zoo import outputs
from advsearch.models.zoo.transformers import HUB_TIMEOUT
from advsearch.tasks import Detection
from advsearch.tasks.boxes import DetectionTruth
from advsearch.tasks.similarity import Similarity

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
    "without mean": ("ViTImageProcessor", {"image_std": [0.3] * 3}),
    "not rescaled": ("ViTImageProcessor", {"do_rescale": False, "image_mean": [127.5] * 3, "image_std": [60.0] * 3}),
    "another factor": (
        "ViTImageProcessor",
        {"rescale_factor": 1 / 127.5, **{f"image_{name}": [1.0] * 3 for name in ("mean", "std")}},
    ),
    "nothing normalised": ("ViTImageProcessor", {"do_normalize": False}),
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


def test_a_processor_inside_another_ones_file_is_found(tmp_path: Path) -> None:
    spec = published(tmp_path, "ViTForImageClassification", processor("ViTImageProcessor", **HALF))
    told = json.loads((tmp_path / "preprocessor_config.json").read_text())
    (tmp_path / "preprocessor_config.json").unlink()
    (tmp_path / "processor_config.json").write_text(json.dumps({"image_processor": told, "processor_class": "X"}))
    assert load_model(spec).preprocessing.std == (0.25,) * 3


def test_what_comes_without_a_processor_is_said(tmp_path: Path) -> None:
    spec = published(tmp_path, "ViTForImageClassification")
    with pytest.warns(ModelWarning, match="without an image processor: pictures are given as they are"):
        model = load_model(spec, input_size=SIDE, mean=0.5, std=0.25)
    assert (model.preprocessing.mean, model.preprocessing.std) == ((0.5,) * 3, (0.25,) * 3)


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
    with pytest.raises(InputError, match=r"std: model .* has a processor that does all of this; leave it out"):
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

    def mixed(picture: Any) -> Any:
        return np.repeat(np.asarray(picture, np.float64).mean(axis=2)[None, None], 3, axis=1)

    def patches(picture: Any) -> Any:
        return np.zeros((1, 9, 64))

    def padded(picture: Any) -> Any:
        return np.pad(bent(picture) + 1.0, ((0, 0), (0, 0), (0, 4), (0, 4)))

    def rounded(picture: Any) -> Any:
        if isinstance(picture, Tensor):
            return picture[None].sqrt()
        return np.sqrt(np.asarray(picture, np.float64).transpose(2, 0, 1)[None]).round()

    cases = (
        (bent, "something else than a gain and an offset, and lets no gradient through"),
        (mixed, "mixes the channels .* and lets no gradient through"),
        (patches, r"shape \(1, 9, 64\)"),
        (padded, "pads a square picture"),
        (rounded, "rounds or does otherwise where a gradient goes"),
    )
    for does, text in cases:

        def processed(images: Any, does: Callable[[Any], Any] = does, **_: Any) -> Any:
            return {"pixel_values": does(images)}

        given_by(monkeypatch, processed)
        with pytest.raises(ModelError, match=text):
            load_model(spec)


def test_a_size_that_a_processor_leaves_open_is_nobodys(tmp_path: Path) -> None:
    spec = published(
        tmp_path, "SegformerForSemanticSegmentation", processor("SegformerImageProcessor", do_resize=False)
    )
    model = load_model(spec, read=lambda answer, count: answer, input_size=24)
    assert model.input_size == (24, 24)
    assert model(torch.rand(1, 24, 24, 3)).shape == (1, 3, 24, 24)


def test_it_segments(tmp_path: Path) -> None:
    spec = published(tmp_path, "SegformerForSemanticSegmentation", processor("SegformerImageProcessor"))
    assert load_model(spec, read=lambda answer, count: answer)(PICTURES).shape == (2, 3, SIDE, SIDE)


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
    model = load_model(Asked(network), input_size=SIDE, labels=NAMES, read=Detection(iou=0.5).reader)
    task = Detection(suppression=1.0, confidence=1e-6).on(model)
    with torch.no_grad():
        answer = network(pixel_values=PICTURES[:1].permute(0, 3, 1, 2))
        theirs = prepared.post_process_object_detection(answer, threshold=0.0, target_sizes=[(SIDE, SIDE)])[0]
    ours: Any = task.judge(model(PICTURES[:1]), DetectionTruth((0,), (0, 0, SIDE, SIDE), (SIDE, SIDE)))[0].payload
    best = int(theirs["scores"].argmax())
    (found,) = [one for one in ours["found"] if one["score"] == round(float(theirs["scores"][best]), 3)]
    assert found["label"] == NAMES[int(theirs["labels"][best])]
    assert found["box"] == [pytest.approx(x, abs=0.06) for x in theirs["boxes"][best].tolist()]


def test_names_that_are_no_heads_at_the_end(tmp_path: Path) -> None:
    spec = published(
        tmp_path, "DeiTForImageClassificationWithTeacher", processor("DeiTImageProcessor", do_center_crop=False)
    )
    assert load_model(spec).labels == NAMES


def test_numbered_labels_are_no_names(tmp_path: Path) -> None:
    more = {"id2label": {k: f"LABEL_{k}" for k in range(3)}}
    model = load_model(published(tmp_path, "ViTForImageClassification", processor("ViTImageProcessor"), **more))
    assert not model.named and model.labels == ("class 0", "class 1", "class 2")


def test_weights_that_are_not_there_are_refused(tmp_path: Path) -> None:
    spec = published(tmp_path, "ViTForImageClassification", processor("ViTImageProcessor"))
    file = tmp_path / "model.safetensors"
    save_file({k: v for k, v in load_file(file).items() if "classifier" not in k}, file, metadata={"format": "pt"})
    with pytest.raises(ModelError, match=r"lack 2 of the network's weights \(classifier.bias, classifier.weight\)"):
        load_model(spec)


def test_other_kinds_are_named(tmp_path: Path) -> None:
    spec = published(tmp_path, "ViTForMaskedImageModeling", processor("ViTImageProcessor"))
    with pytest.raises(ModelError, match="is a ViTForMaskedImageModeling; expected one whose name has ForImage"):
        load_model(spec)


@pytest.mark.parametrize("spec", ["hf:./nowhere", "hf:/no/where", "hf:a/b/c"])
def test_a_folder_that_is_not_there_is_no_repository(spec: str) -> None:
    with pytest.raises(ModelError, match="no such folder; a repository is written hf:OWNER/NAME"):
        load_model(spec)


def test_a_folder_with_nearly_that_name_is_meant(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def away(*_: object, **__: object) -> None:
        raise OSError("We couldn't connect to the hub")

    (tmp_path / "some" / "folder").mkdir(parents=True)
    (tmp_path / "some" / "model.safetensors").touch()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ModelError, match=r"no such folder \(did you mean 'hf:some/folder'\?\); a repository is"):
        load_model("hf:./some/folderr")
    monkeypatch.setattr(transformers.utils, "cached_file", away)
    meant = r"some/folderr is no folder here \(did you mean 'hf:some/folder'\?\), and no repository of that name"
    with pytest.raises(ModelError, match=meant):
        load_model("hf:some/folderr")
    with pytest.raises(ModelError, match=r"model hf:another: another is no folder here, and no repository .*connect"):
        load_model("hf:another")
    with pytest.raises(ModelError, match="is a file; give the folder in which it is"):
        load_model("hf:some/model.safetensors")


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
    with pytest.raises(
        ModelError, match=r"in the cache \(did you mean 'hf:owner/good'\?\).*Check the name and the net"
    ):
        load_model("hf:owner/goood")
    assert asked == [HUB_TIMEOUT]


def test_it_never_unpickles(tmp_path: Path) -> None:
    spec = published(tmp_path, "ViTForImageClassification", processor("ViTImageProcessor"))
    torch.save(load_file(tmp_path / "model.safetensors"), tmp_path / "pytorch_model.bin")
    (tmp_path / "model.safetensors").unlink()
    with pytest.raises(ModelError, match=r"cannot be fetched or read"):
        load_model(spec)


# ---------------------------------------------------------------------------------------------------------------------
# given from Python


def test_a_network_from_python_is_fed_as_where_it_came_from_says(tmp_path: Path) -> None:
    published(tmp_path, "ViTForImageClassification", processor("ViTImageProcessor", **HALF))
    network = transformers.AutoModelForImageClassification.from_pretrained(tmp_path)
    model = load_model(network)
    assert (model.labels, model.preprocessing.std, model.input_size) == (NAMES, (0.25,) * 3, (SIDE, SIDE))


def test_a_network_that_was_made_in_python_says_that_nothing_is_normalised() -> None:
    config = transformers.ViTConfig(
        hidden_size=8, num_hidden_layers=1, num_attention_heads=2, intermediate_size=8, image_size=SIDE, patch_size=8
    )
    with pytest.warns(ModelWarning, match="model ViTForImageClassification comes without an image processor"):
        model = load_model(transformers.ViTForImageClassification(config), input_size=SIDE)
    assert model.labels[:1] == ("class 0",)


class OfTimm(nn.Module):
    """What timm gives its networks."""

    def __init__(self, classes: int = 3) -> None:
        super().__init__()
        self.num_classes, self.pretrained_cfg = classes, {"label_names": list(NAMES)}
        self.head = nn.Linear(3, max(classes, 8))

    def forward_features(self, x: Tensor) -> Tensor:
        return x.mean(dim=(2, 3))

    def forward_head(self, x: Tensor, pre_logits: bool = False) -> Tensor:
        return x if pre_logits else self.head(x)

    def forward(self, x: Tensor) -> Tensor:
        answer = self.forward_head(self.forward_features(x))
        return answer[:, : self.num_classes] if self.num_classes else answer


@pytest.fixture
def timm(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """A stand-in for timm; the list has what networks were made."""
    made: list[str] = []

    def create_model(name: str, **_: Any) -> nn.Module:
        made.append(name)
        return OfTimm()

    asked = {"input_size": (3, SIDE, SIDE), "mean": (0.4,) * 3, "std": (0.2,) * 3}
    data = types.SimpleNamespace(resolve_model_data_config=lambda _: asked, infer_imagenet_subset=lambda _: None)
    stand_in = types.SimpleNamespace(create_model=create_model, data=data)
    monkeypatch.setitem(__import__("sys").modules, "timm", stand_in)
    return made


def test_a_repository_of_timm_goes_to_timm(tmp_path: Path, timm: list[str]) -> None:
    (tmp_path / "config.json").write_text(json.dumps({"model_type": "timm_wrapper", "architecture": "resnet18"}))
    model = load_model(f"hf:{tmp_path}")
    assert timm == [f"local-dir:{tmp_path}"]
    assert (model.labels, model.preprocessing.std, model.input_size) == (NAMES, (0.2,) * 3, (SIDE, SIDE))


def test_a_network_of_timm_from_python_brings_its_own(timm: list[str]) -> None:
    model = load_model(OfTimm())
    assert (model.labels, model.preprocessing.mean, model.input_size) == (NAMES, (0.4,) * 3, (SIDE, SIDE))
    with pytest.raises(ModelError, match=r"is a network without a head \(num_classes is 0\), .* use `task=similarity`"):
        load_model(OfTimm(0))
    assert load_model(OfTimm(0), task=Similarity())(PICTURES).shape == (2, 8)
    before = load_model(OfTimm(), task=Similarity())
    assert before.labels == ()
    torch.testing.assert_close(before(PICTURES), (PICTURES.mean(dim=(1, 2)) - 0.4) / 0.2)
    assert timm == [] and outputs.find_timm_source(nn.Linear(3, 3), Purpose()) is None
