"""Networks of torchvision and timm with the libraries themselves, which need another torch: `make test-zoo`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import save_file
from torch import Tensor, nn

from advsearch import load_model
from advsearch.errors import ModelError
from advsearch.models import Model

WHY = "is not installed, since it needs another torch: make test-zoo"
LEVELS = np.random.default_rng(0).integers(0, 256, (160, 160, 3), np.uint8)
PICTURE = torch.from_numpy(LEVELS).float() / 255.0


@pytest.fixture
def torchvision() -> Any:
    return pytest.importorskip("torchvision", reason=f"torchvision {WHY}")


@pytest.fixture
def timm() -> Any:
    return pytest.importorskip("timm", reason=f"timm {WHY}")


def stirred(network: Any) -> Any:
    """The network with answers that differ, in evaluation mode."""
    torch.manual_seed(0)
    for parameter in network.parameters():
        if parameter.dim() > 1:
            nn.init.kaiming_normal_(parameter)
    return network.eval()


def saved(network: nn.Module, folder: Path) -> Path:
    save_file({key: weights.contiguous() for key, weights in network.state_dict().items()}, folder / "net.safetensors")
    return folder / "net.safetensors"


def assert_same(ours: Tensor, theirs: Tensor) -> None:
    assert float(theirs.std()) > 1e-3 and float((ours - theirs).abs().max()) < 1e-4 * float(theirs.abs().max())


def assert_gradient(model: Model) -> None:
    """A step along the gradient changes the answer as the gradient says."""
    leaf = PICTURE.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(model(leaf)[0, 0], leaf)
    step = 1e-3 * gradient / gradient.abs().max()
    with torch.no_grad():
        seen = (model(PICTURE + step)[0, 0] - model(PICTURE - step)[0, 0]) / 2.0
    assert float(seen) == pytest.approx(float((gradient * step).sum()), rel=0.1)


# ---------------------------------------------------------------------------------------------------------------------
# torchvision


def test_a_classifier_is_fed_as_its_weights_say(torchvision: Any, tmp_path: Path) -> None:
    models, name = torchvision.models, "squeezenet1_1"
    network = stirred(models.get_model(name, weights=None))
    model = load_model(f"torchvision:{name}@{saved(network, tmp_path)}")
    assert model.input_size == (224, 224) and model.labels[:2] == ("tench", "goldfish") and len(model.labels) == 1000
    prepare = models.get_model_weights(name).DEFAULT.transforms()
    picture = Image.fromarray(LEVELS).resize((224, 224))
    prepare.resize_size = [224]
    with torch.no_grad():
        assert_same(model(torch.from_numpy(np.array(picture)).float() / 255.0), network(prepare(picture)[None]))


def test_a_segmenter_answers_for_each_pixel(torchvision: Any, tmp_path: Path) -> None:
    models, name = torchvision.models, "lraspp_mobilenet_v3_large"
    network = stirred(models.get_model(name, weights=None, weights_backbone=None))
    model = load_model(f"torchvision:{name}@{saved(network, tmp_path)}", task="segmentation", input_size=160)
    assert model.labels[:2] == ("__background__", "aeroplane")
    with torch.no_grad():
        normal = torchvision.transforms.functional.normalize(
            PICTURE.permute(2, 0, 1)[None], [0.485, 0.456, 0.406], [0.229, 0.224, 0.225]
        )
        assert_same(model(PICTURE), network(normal)["out"])


def test_a_detector_finds_what_it_finds_by_itself(torchvision: Any, tmp_path: Path) -> None:
    models, name = torchvision.models, "ssdlite320_mobilenet_v3_large"
    network = models.get_model(name, weights=None, weights_backbone=None).eval()
    with pytest.raises(ModelError, match="boxes are what a detector gives: use `task=detection`"):
        load_model(network)
    model = load_model(f"torchvision:{name}@{saved(network, tmp_path)}", task="detection", input_size=160)
    assert model.labels[:2] == ("__background__", "person") and len(model.labels) == 91
    with torch.no_grad():
        (theirs,) = network([PICTURE.permute(2, 0, 1)])
        (ours,) = model(PICTURE)
    assert len(theirs["scores"]) and torch.equal(ours["labels"], theirs["labels"])
    assert float((ours["boxes"] - theirs["boxes"]).abs().max()) < 1e-3


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("r3d_18", "is made for videos"),
        ("raft_small", "compares two pictures of a video"),
        ("quantized_resnet18", "is quantised: .* name torchvision:resnet18, which it was made of"),
    ],
)
def test_what_is_beside_is_named(torchvision: Any, name: str, text: str) -> None:
    with pytest.raises(ModelError, match=f"model torchvision:{name}: {text}"):
        load_model(f"torchvision:{name}")


# ---------------------------------------------------------------------------------------------------------------------
# timm


def theirs(timm: Any, network: nn.Module) -> Tensor:
    """What timm's own pipeline answers to the picture, at the size that its network takes."""
    asked = timm.data.resolve_model_data_config(network)
    assert asked["input_size"] == (3, 160, 160)
    prepare = timm.data.create_transform(**{**asked, "crop_pct": 1.0})
    with torch.no_grad():
        answer: Tensor = network(prepare(Image.fromarray(LEVELS))[None])
    return answer


def test_a_network_of_timm_is_fed_as_timm_says(timm: Any, tmp_path: Path) -> None:
    network = stirred(timm.create_model("test_vit"))
    for model in (load_model(network), load_model(f"timm:test_vit@{saved(network, tmp_path)}")):
        assert model.labels[0] == "tench, Tinca tinca"
        assert_same(model(PICTURE), theirs(timm, network))
    assert_gradient(model)
    with pytest.raises(ModelError, match=r"without a head \(num_classes is 0\), .* use `task=similarity`"):
        load_model(timm.create_model("test_vit", num_classes=0))


NAMES = ["mug", "bowl", "vase"]


def test_a_repository_of_timm_goes_to_timm(timm: Any, tmp_path: Path) -> None:
    pytest.importorskip("transformers")
    network = stirred(timm.create_model("test_vit", num_classes=3))
    timm.models.save_for_hf(network, tmp_path, model_config={"label_names": NAMES}, safe_serialization=True)
    model = load_model(f"hf:{tmp_path}")
    assert model.labels == tuple(NAMES)
    assert_same(model(PICTURE), theirs(timm, network))


def test_a_network_of_timm_inside_one_of_transformers(timm: Any, tmp_path: Path) -> None:
    transformers = pytest.importorskip("transformers")
    told = timm.create_model("test_vit").pretrained_cfg | {"mean": (0.1,) * 3, "std": (0.3,) * 3}
    config = transformers.TimmWrapperConfig(
        architecture="test_vit", num_labels=3, pretrained_cfg=told, id2label=dict(enumerate(NAMES))
    )
    network = transformers.TimmWrapperForImageClassification(config)
    stirred(network).save_pretrained(tmp_path)
    normal = ((PICTURE - 0.1) / 0.3).permute(2, 0, 1)[None]
    for model in (load_model(network), load_model(f"hf:{tmp_path}")):
        assert model.labels == tuple(NAMES) and model.input_size == (160, 160)
        with torch.no_grad():
            assert_same(model(PICTURE), network(pixel_values=normal).logits)


# ---------------------------------------------------------------------------------------------------------------------
# processors of transformers that work with torchvision


def test_a_processor_of_torchvision_is_called(
    torchvision: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    transformers = pytest.importorskip("transformers")

    class Bends(transformers.ViTImageProcessor):  # type: ignore[misc,name-defined]
        """Resizes and rescales as others do, and bends values and mixes channels where these are normalised."""

        def rescale_and_normalize(self, images: Tensor, *settings: Any, **more: Any) -> Tensor:
            done = super().rescale_and_normalize(images, *settings, **more)
            return torch.tanh(done + 0.3 * done.flip(1))

    prepared = Bends(size={"height": 16, "width": 16}, image_mean=[0.5] * 3, image_std=[0.25] * 3)
    config = transformers.ViTConfig(
        hidden_size=8, num_hidden_layers=1, num_attention_heads=2, intermediate_size=8, image_size=16, patch_size=8,
        id2label=dict(enumerate(NAMES)),
    )  # fmt: skip
    network = stirred(transformers.ViTForImageClassification(config))
    network.save_pretrained(tmp_path)
    prepared.save_pretrained(tmp_path)
    monkeypatch.setattr(transformers.AutoImageProcessor, "from_pretrained", lambda *_, **__: prepared)
    model = load_model(f"hf:{tmp_path}")
    assert model.preprocessing.processor is not None and model.input_size == (16, 16)
    small = LEVELS[:16, :16]
    library = transformers.pipeline("image-classification", model=network, image_processor=prepared)
    scores = {one["label"]: one["score"] for one in library(Image.fromarray(small))}
    ours = dict(zip(NAMES, model(torch.from_numpy(small) / 255.0)[0].softmax(dim=0).tolist(), strict=True))
    assert ours == pytest.approx(scores, abs=1e-4)
    assert_gradient(model)
