"""Use models of MAITE (https://mit-ll-ai-technology.github.io/maite), and make datasets
for it.

    from advsearch import maite

    model = maite.load_model(theirs, input_size=224, value_range=(0, 1))
    advsearch.attack("mug", model, controls="camera", label="coffee mug,cup")
    scenes = maite.Scenes("mug", "camera", 100, labels=model.labels)
    maite_tasks.evaluate(model=theirs, dataset=scenes)

The protocols are duck types, so nothing of MAITE is imported.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import torch
from torch import Tensor, nn

from advsearch import models
from advsearch.engine import loading
from advsearch.engine.judging import make_domain
from advsearch.errors import InputError
from advsearch.models.labels import find_label_set
from advsearch.scene.color import round_to_8_bit
from advsearch.scene.outlines import VisibleMesh, find_visible_meshes
from advsearch.tasks import make_task

if TYPE_CHECKING:
    from advsearch.engine.loading import Controls, Scene

__all__ = ["Detections", "Scenes", "load_model"]


class _MaiteNetwork(nn.Module):
    """A model of MAITE with the interface of torchvision's models."""

    def __init__(self, model: Any, task: str) -> None:
        super().__init__()
        self.model = model
        self.task = task
        if isinstance(model, nn.Module):
            model.eval()

    def forward(self, images: Tensor) -> Any:
        """Run the model on images (N, 3, H, W).

        Returns:
            Scores (N, classes); for detection a list with a mapping for each image, of
            "boxes", "labels" and "scores".
        """
        targets = list(self.model(list(images)))
        if len(targets) != len(images):
            raise InputError(
                f"MAITE model: expected a target for each of {len(images)} images, got "
                f"{len(targets)}"
            )
        if self.task == "classification":
            return torch.stack([torch.as_tensor(scores).float() for scores in targets])
        return [_to_detections(target) for target in targets]


def _to_detections(target: Any) -> dict[str, Tensor]:
    """Convert an `ObjectDetectionTarget` to a mapping of torchvision's detectors.

    It has boxes (n, 4), labels (n,) and scores (n,).
    """
    scores = _get_best_scores(torch.as_tensor(target.scores).float())
    boxes = torch.as_tensor(target.boxes).float().reshape(-1, 4)
    return {
        "boxes": boxes,
        "labels": torch.as_tensor(target.labels).long(),
        "scores": scores,
    }


def _get_best_scores(scores: Tensor) -> Tensor:
    """Return the score (n,) of each detection, from scores (n,) or (n, classes)."""
    if scores.ndim != 2:
        return scores
    # `labels` has the class with the best score
    has_classes = scores.shape[1] > 0
    if has_classes:
        return scores.amax(dim=1)
    return scores.new_zeros(len(scores))  # `amax` would fail


def load_model(
    model: Any,
    *,
    input_size: int | tuple[int, int],
    task: str = "classification",
    labels: Any = None,
    **options: Any,
) -> models.Model:
    """Convert an image classifier or an object detector of MAITE to a `Model`.

    The MAITE model is called with a list of images, float32 tensors (3, H, W). It does
    not state the size and the range of values of its images, so pass `input_size` and
    `value_range`. If its output is not a tensor with a graph back to the images, only
    searches without gradients work (`policy="random"`, `"cmaes"`).

    Args:
        model: MAITE model. It returns for each image its scores (classes,), or an
            `ObjectDetectionTarget`.
        input_size: width and height, or (height, width), in pixels.
        task: "classification" or "detection".
        labels: names of the classes by index; None for `index2label` of its metadata.
        options: other options of `advsearch.load_model`, such as `value_range` and
            `mean`.

    Raises:
        InputError: the task is another one.
    """
    _check_task_of_maite(task)
    metadata = getattr(model, "metadata", {})
    if labels is None:
        labels = _list_class_labels(metadata)
    default_name = str(metadata.get("id", type(model).__name__))
    name = options.pop("name", default_name)
    return models.load_model(
        _MaiteNetwork(model, task),
        task=make_task(task),
        input_size=input_size,
        labels=labels,
        name=name,
        **options,
    )


def _list_class_labels(metadata: Any) -> list[Any] | None:
    """Return the names of classes in the metadata of a model by index; None if none.

    Indices without a label get a placeholder.
    """
    index2label = metadata.get("index2label")
    if not index2label:
        return None
    n_labels = max(index2label) + 1
    return [index2label.get(index, f"class {index}") for index in range(n_labels)]


@dataclass(frozen=True, eq=False)
class Detections:
    """The ground truth of an image, as MAITE's `ObjectDetectionTarget`."""

    boxes: Tensor  # (D, 4) float32: x0, y0, x1, y1 in pixels
    labels: Tensor  # (D,) int64
    scores: Tensor  # (D,) float32, 1


class Scenes:
    """A dataset of MAITE with images of a scene, whose controls are sampled at random.

    Item k is an image (3, H, W) float32, sRGB in [0, 1] rounded to 8 bits; its target;
    and its metadata: `id`, and the configuration by parameter. The target is one-hot
    (classes,) for classification. For detection it is the `Detections` of the visible
    objects whose names are among the labels. An item is rendered on access, and is the
    same every time.

    Args:
        scene: scene from `load_scene`, or the name or the file of its object.
        controls: controls whose parameters are sampled uniformly in their ranges.
        count: number of images.
        labels: names of the classes, in the order of the model's outputs.
        label: name of the right class; None for the label of the object.
        task: "classification" or "detection".
        resolution: side, or (height, width), in pixels.
        spp: samples per pixel.
        seed: seed of configurations and noise.

    Raises:
        InputError: no class has the name of the object, or an argument is out of range.
    """

    def __init__(
        self,
        scene: Scene | str | Path,
        controls: Controls,
        count: int,
        *,
        labels: Sequence[str],
        label: str | None = None,
        task: str = "classification",
        resolution: int | tuple[int, int] = loading.DEFAULT_RESOLUTION,
        spp: int = 64,
        seed: int = 0,
    ) -> None:
        """Sample `count` configurations of the controls.

        Args:
            scene: the scene, or its name or file.
            controls: controls whose parameters are sampled.
            count: number of images.
            labels: names of the classes by index.
            label: name of the object's class; None for that of the scene's object.
            task: "classification" or "detection".
            resolution: size of the images in pixels, or (height, width).
            spp: samples per pixel.
            seed: seed of the sampled configurations.

        Raises:
            InputError: the task is another one, or `count` is less than 1.
        """
        _check_scenes_arguments(task, count)
        if not isinstance(scene, loading.Scene):
            scene = loading.load_scene(scene)
        self.renderer = scene.renderer(controls, resolution=resolution, seed=seed)
        self.labels = tuple(labels)
        self.task = task
        self.spp = spp
        self.seed = seed
        description, _filter = self.renderer.scene.description_and_filter
        object_label = description.object.label or description.object_name
        # the classes that count as right for the object
        self.right = find_label_set(label or object_label, self.labels)
        self.space = cast("Any", self.renderer.space)
        # The domain has the ranges of all parameters; a configuration is a point in it.
        domain = make_domain(self.space.controls)
        self.configurations = domain.sample(torch.Generator().manual_seed(seed), count)
        self.metadata = {
            "id": f"advsearch-{description.object_name}-{seed}",
            "index2label": dict(enumerate(self.labels)),
        }

    def __len__(self) -> int:
        return len(self.configurations)

    def __getitem__(
        self, number: int
    ) -> tuple[Tensor, Tensor | Detections, dict[str, Any]]:
        """Render the image of a configuration, as data sets of MAITE return it.

        Args:
            number: index of the configuration; negative ones count from the end.

        Returns:
            The image (3, H, W) in [0, 1], its target, and metadata: its id and the
            values of the parameters.
        """
        # A range handles negative numbers, and raises IndexError after the last image,
        # which ends a loop over the images.
        index = range(len(self))[number]
        u = self.configurations[index]
        with torch.no_grad():
            image = round_to_8_bit(self.renderer(u, seed=index, spp=self.spp))
        values = self.space.describe(u)
        metadata = {
            "id": index,
            **{name: value["value"] for name, value in values.items()},
        }
        return image.permute(2, 0, 1).contiguous(), self._make_target(u), metadata

    def _make_target(self, u: Tensor) -> Tensor | Detections:
        """Return the target of the image of a configuration u (d,).

        For classification it is a one-hot vector of the right class. For detection it
        has the boxes, classes and scores (all 1) of the visible objects; objects of
        none of the classes are left out.
        """
        right_class = self.right.indices[0]  # the first, if several are right
        if self.task == "classification":
            one_hot = nn.functional.one_hot(torch.tensor(right_class), len(self.labels))
            return one_hot.float()
        return self._make_detections(u, right_class)

    def _make_detections(self, u: Tensor, right_class: int) -> Detections:
        """Return the visible objects in the image of a configuration u (d,).

        Args:
            u: the configuration.
            right_class: index of the class of the scene's object.
        """
        boxes = []
        classes = []
        for thing in find_visible_meshes(self.renderer, u):
            is_object = thing.name == "object"
            class_id = right_class if is_object else self._find_class(thing)
            if class_id is not None:
                boxes.append(thing.box)
                classes.append(class_id)
        return Detections(
            torch.tensor(boxes, dtype=torch.float32).reshape(-1, 4),
            torch.tensor(classes, dtype=torch.int64),
            torch.ones(len(boxes)),
        )

    def _find_class(self, thing: VisibleMesh) -> int | None:
        """Return the class of an additional object of the scene; None if there is none.

        Its name is the label of its mesh, or else the name of the mesh.
        """
        description, _filter = self.renderer.scene.description_and_filter
        name = description.meshes[thing.name].label or thing.name
        try:
            return find_label_set(name, self.labels).indices[0]
        except InputError:
            return None


def _check_scenes_arguments(task: str, count: int) -> None:
    """Check the task and the number of images of a dataset.

    Raises:
        InputError: the task is another one, or `count` is less than 1.
    """
    _check_task_of_maite(task)
    if count < 1:
        raise InputError(f"count: expected a whole number from 1, got {count}")


def _check_task_of_maite(task: str) -> None:
    """Check that MAITE has a protocol for a task.

    Raises:
        InputError: it has none.
    """
    if task not in ("classification", "detection"):
        raise InputError(
            "task: expected classification or detection, which MAITE has protocols of, "
            f"got {task!r}"
        )
