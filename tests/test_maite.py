"""Models and datasets of MAITE; with the package itself where it is installed."""

from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from torch import Tensor

import advsearch
from advsearch import maite

LABELS = {0: "mug", 1: "bowl"}


class Shade:
    """As MAITE has an image classifier: bright is a mug, dark a bowl."""

    metadata: ClassVar[dict[str, Any]] = {"id": "shade", "index2label": LABELS}

    def __call__(self, images: Any) -> list[Tensor]:
        assert all(image.shape[0] == 3 for image in images)
        return [torch.stack([4.0 * image.mean(), 2.0 * torch.ones(())]) for image in images]


class Boxes:
    """As MAITE has an object detector; with scores of every class, as arrays."""

    metadata: ClassVar[dict[str, Any]] = {"id": "boxes", "index2label": LABELS}

    def __call__(self, images: Any) -> list[SimpleNamespace]:
        found = SimpleNamespace(
            boxes=np.array([[2.0, 2.0, 30.0, 30.0]]), labels=np.array([0]), scores=np.array([[0.9, 0.1]])
        )
        return [found for _ in images]


def test_a_classifier_is_a_model_with_gradients() -> None:
    model = maite.load_model(Shade(), input_size=16)
    assert (model.name, model.labels, model.differentiable) == ("shade", ("mug", "bowl"), True)
    image = torch.full((16, 16, 3), 0.25, requires_grad=True)
    (output,) = model(image)
    assert output.tolist() == [1.0, 2.0]
    (gradient,) = torch.autograd.grad(output[0], image)
    assert float(gradient.sum()) == pytest.approx(4.0)


@pytest.mark.medium
def test_a_detector_is_a_model_of_detection() -> None:
    with pytest.warns(UserWarning, match="boxes"):
        model = maite.load_model(Boxes(), input_size=32, task="detection")
    swept = advsearch.sweep("mug", model, task="detection", controls="camera", samples=2, trials=0, spp=2)
    assert swept.summary.model == "boxes" and all("mug" in str(row.label) for row in swept.rows())


@pytest.mark.medium
def test_scenes_are_a_dataset() -> None:
    scenes = maite.Scenes("mug", "camera", 2, labels=("bowl", "mug"), resolution=16, spp=2)
    (image, target, first), (other, _, second) = (scenes[place] for place in range(len(scenes)))
    assert len(scenes) == 2 and image.shape == (3, 16, 16) and image.dtype == torch.float32
    assert torch.equal(image, (255 * image).round() / 255) and not torch.equal(image, other)
    assert isinstance(target, Tensor) and target.tolist() == [0.0, 1.0]
    assert (first["id"], second["id"]) == (0, 1) and first["camera.azimuth"] != second["camera.azimuth"]
    again = maite.Scenes("mug", "camera", 2, labels=("bowl", "mug"), resolution=16, spp=2)
    assert torch.equal(again[1][0], other) and torch.equal(again[-1][0], other)


@pytest.mark.medium
def test_boxes_are_those_of_the_object() -> None:
    scenes = maite.Scenes("mug", "pose.yaw", 1, labels=("bowl", "mug"), task="detection", resolution=16, spp=2)
    _, target, _ = scenes[0]
    rows, columns = np.nonzero(scenes.renderer.compute_object_mask(scenes.configurations[0]).numpy())
    assert isinstance(target, maite.Detections) and target.labels.tolist() == [1] and target.scores.tolist() == [1.0]
    assert target.boxes.tolist() == [[columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]]


@pytest.mark.medium
def test_the_package_itself_takes_them() -> None:
    tasks = pytest.importorskip("maite.tasks")
    classification = pytest.importorskip("maite.protocols.image_classification")
    detection = pytest.importorskip("maite.protocols.object_detection")
    scenes = maite.Scenes("mug", "camera", 3, labels=("mug", "bowl"), resolution=16, spp=2)
    assert isinstance(scenes, classification.Dataset) and isinstance(Shade(), classification.Model)
    predictions, _ = tasks.predict(model=Shade(), dataset=scenes, batch_size=2)
    said = [scores for batch in predictions for scores in batch]
    assert [float(one[0]) for one in said] == pytest.approx([4.0 * float(image.mean()) for image, _, _ in scenes])
    boxes = maite.Scenes("mug", "camera", 1, labels=("mug", "bowl"), task="detection", resolution=16, spp=2)
    assert isinstance(boxes[0][1], detection.ObjectDetectionTarget.__origin__) and isinstance(Boxes(), detection.Model)
