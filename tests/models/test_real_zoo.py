"""Networks of torchvision and timm with the libraries themselves, which need another torch: `make test-zoo`."""

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
    with pytest.raises(ModelError, match="task=detection"):
        load_model(network)
    model = load_model(f"torchvision:{name}@{saved(network, tmp_path)}", task="detection", input_size=160)
    assert model.labels[:2] == ("__background__", "person") and len(model.labels) == 91
    with torch.no_grad():
        (theirs,) = network([PICTURE.permute(2, 0, 1)])
        (ours,) = model(PICTURE)
    assert len(theirs["scores"]) and torch.equal(ours["labels"], theirs["labels"])
    assert float((ours["boxes"] - theirs["boxes"]).abs().max()) < 1e-3


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
    with pytest.raises(ModelError, match="task=similarity"):
        load_model(timm.create_model("test_vit", num_classes=0))
