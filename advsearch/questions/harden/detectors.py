"""Train detectors and segmenters on adversarial, plain and custom images.

The loss is that of the network, or a function that the caller passes.
"""

from __future__ import annotations

import inspect
import json
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm

from advsearch.extend import (
    InputError,
    Model,
    Problem,
    RunDirectory,
    Task,
    color,
    errors,
    seeds,
    stored_files,
    workbench,
)
from advsearch.questions.harden.lessons import IMAGE_DIRECTORY
from advsearch.questions.harden.networks import Trainable
from advsearch.questions.harden.rounds import (
    ComputeGradient,
    MakeOptimizer,
    Score,
    Trainer,
)
from advsearch.questions.harden.scenes import SceneJobs

Target = dict[str, Tensor]
"""Ground truth of an image. For a detector: "boxes" (K, 4), x0, y0, x1, y1 in pixels of
the network's input, and "labels" (K,), indices.
"""
Loss = Callable[[nn.Module, Tensor, Sequence[Target]], Tensor]
"""Takes a network, its input (N, ...) and the target of each image; returns a number
that training makes smaller.
"""

SPP = 8
"""Samples per pixel of all images."""
TRIALS = 6
"""Trials that verify what a search found."""
N_VIEWS = 3
"""Views of a plain scene."""
WORST_USES_PER_EPOCH = 5
"""How often an epoch uses an adversarial image; it uses a plain one once."""
MAX_BYTES = 256 << 20
"""Maximum size of a COCO file."""
MAX_SIZE = 8192
"""Maximum width and height of an image of a COCO file, in pixels."""


class Example(NamedTuple):
    """An image with its ground truth.

    Attributes:
        image_uint8: the image (H, W, 3) uint8.
        boxes: (K, 4), x0, y0, x1, y1 in pixels.
        labels: indices of the boxes' classes (K,).
        task: evaluates predictions of a rendered image; None for a custom image.
        truth: ground truth for the task: a `Place` of detection, or a `Region` of
            segmentation.
        is_adversarial: whether a search has found it.
    """

    image_uint8: Tensor
    boxes: Tensor
    labels: Tensor
    task: Task | None = None
    truth: Any = None
    is_adversarial: bool = False

    @classmethod
    def render(cls, problem: Problem, seed: int, u: Tensor | None = None) -> Example:
        """Render a configuration, or the plain scene, under conditions of a seed.

        Args:
            problem: problem of the scene.
            seed: seed of the conditions and the noise.
            u: (d,) the configuration that a search has found; None for the plain scene.
        """
        configuration = problem.domain.start if u is None else u
        truth: Any = problem.find_truth(
            problem.make_full_configuration(configuration, seed)
        )
        boxes, labels = _make_box_tensors(truth)
        return cls(
            image_uint8=color.to_uint8(problem.picture(configuration, seed, SPP)),
            boxes=boxes,
            labels=labels,
            task=problem.task,
            truth=truth,
            is_adversarial=u is not None,
        )

    def is_right(self, model: Model) -> bool:
        """Return whether a model is right about a rendered image."""
        assert self.task is not None
        with torch.no_grad():
            output = model(self.image_uint8[None] / 255.0)
            return bool(self.task.loss(output, self.truth)[0] <= 0.0)


def _make_box_tensors(truth: Any) -> tuple[Tensor, Tensor]:
    """Return the box (1, 4) of a ground truth, and its label (1,).

    Both are empty in segmentation, or if the object is out of view.
    """
    box = getattr(truth, "box", None)
    if not box:
        empty_boxes = torch.zeros(0, 4, dtype=torch.float32)
        return empty_boxes, torch.zeros(0, dtype=torch.int64)
    boxes = torch.tensor([box], dtype=torch.float32)
    # If several labels are right, training uses the first.
    return boxes, torch.tensor([truth.labels[0]], dtype=torch.int64)


def read_coco(directory: Path, model: Model) -> list[Example]:
    """Read the images of a directory that `export --format coco` has written.

    It has `annotations.json` and `images/`. Categories that are no label of the model
    are left out.

    The file is not trusted: its size is limited, and names that lead outside of
    `images/` are rejected.

    Args:
        directory: the directory.
        model: model whose labels are used.

    Raises:
        FileFormatError: the directory has no such files, or they name images outside of
            it.
        InputError: no category is a label of the model.
    """
    path = directory / "annotations.json"
    image_directory = (directory / "images").resolve()
    try:
        return _read_coco_examples(path, image_directory, model)
    except (OSError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise errors.FileFormatError(
            f"{path}: expected COCO's JSON and a folder images/, got {str(error)[:120]}"
        ) from None


def _read_coco_examples(
    path: Path, image_directory: Path, model: Model
) -> list[Example]:
    """Read the images that a COCO file lists, with the boxes of the model's labels.

    Errors of a malformed file are those of Python.

    Args:
        path: the COCO file.
        image_directory: directory of the images, resolved.
        model: model whose labels are used.
    """
    coco: Any = stored_files.parse_json(
        stored_files.read_text(path, "a COCO file", MAX_BYTES)
    )
    label_of_category = _match_categories(coco, model)
    annotations_of_image = _group_annotations(coco, label_of_category)
    if not label_of_category:
        raise InputError(
            f"data: {path}: none of its categories is a label of model {model.name}"
        )
    examples = []
    for image in coco["images"]:
        file = _locate_image(image_directory, str(image["file_name"]), path)
        image_uint8 = _read_levels(file, image)
        boxes, labels = _read_boxes(annotations_of_image, image, label_of_category)
        examples.append(Example(image_uint8=image_uint8, boxes=boxes, labels=labels))
    return examples


def _match_categories(coco: Any, model: Model) -> dict[Any, int]:
    """Return the index of the model's label by COCO's category, for known labels."""
    return {
        category["id"]: model.labels.index(str(category["name"]))
        for category in coco["categories"]
        if str(category["name"]) in model.labels
    }


def _read_levels(file: Path, image: Mapping[str, Any]) -> Tensor:
    """Read an image (H, W, 3) uint8.

    Args:
        file: the file of the image.
        image: COCO's description of the image.

    Raises:
        ValueError: it has another size than the description.
    """
    pixels = torch.from_numpy(workbench.load_upright(file, MAX_SIZE))
    if pixels.shape[:2] != (image["height"], image["width"]):
        raise ValueError(f"{image['file_name']} with another size than is stated")
    return color.to_uint8(pixels)


def _group_annotations(
    coco: Any, label_of_category: Mapping[Any, int]
) -> defaultdict[Any, list[Any]]:
    """Return the annotations of known categories by the image that they belong to."""
    annotations_of_image = defaultdict[Any, list[Any]](list)
    for annotation in coco["annotations"]:
        is_known = annotation["category_id"] in label_of_category
        # The box of a crowd is not that of a single thing.
        if is_known and not annotation.get("iscrowd"):
            annotations_of_image[annotation["image_id"]].append(annotation)
    return annotations_of_image


def _read_boxes(
    annotations_of_image: Mapping[Any, Sequence[Any]],
    image: Mapping[str, Any],
    label_of_category: Mapping[Any, int],
) -> tuple[Tensor, Tensor]:
    """Return the boxes (n, 4), x0, y0, x1, y1, and the labels (n,) of an image.

    Args:
        annotations_of_image: COCO's annotations by the `id` of their image.
        image: COCO's description of the image.
        label_of_category: index of the model's label by COCO's category.
    """
    annotations = annotations_of_image[image["id"]]
    boxes = torch.tensor(
        [annotation["bbox"] for annotation in annotations], dtype=torch.float32
    ).reshape(-1, 4)
    boxes[:, 2:] += boxes[:, :2]  # COCO has the width and the height of a box
    labels = torch.tensor(
        [label_of_category[annotation["category_id"]] for annotation in annotations],
        dtype=torch.int64,
    )
    return boxes, labels


def _locate_image(directory: Path, name: str, coco_file: Path) -> Path:
    """Return the path of an image that a COCO file names.

    Args:
        directory: directory of the images, resolved.
        name: name in the file, which is not trusted.
        coco_file: path of the COCO file, for messages.

    Raises:
        FileFormatError: it is outside of the directory.
    """
    relative_path = Path(name)
    file = directory / relative_path
    names_other_directory = relative_path.is_absolute() or ".." in relative_path.parts
    # A link may lead outside of the directory.
    if (
        names_other_directory
        or file.is_symlink()
        or directory not in file.resolve().parents
    ):
        raise errors.FileFormatError(
            f"{coco_file}: expected names of files in images/, got "
            f"{str(relative_path)[:100]}"
        )
    return file


def compute_network_loss(
    network: nn.Module, x: Tensor, targets: Sequence[Target]
) -> Tensor:
    """Return the loss that a network computes itself in training.

    How it is called depends on the network. Networks of torchvision take lists of
    images and targets, those of transformers take `labels`; any other network's
    `forward` takes targets after its input. If it returns a mapping of several losses,
    they are summed.

    Args:
        network: network in training mode.
        x: the network's input (N, 3, H, W).
        targets: the ground truth of each image.

    Raises:
        ModelError: the network returns no loss.
    """
    loss = _call_in_training(network, x, targets)
    if isinstance(loss, Mapping):
        # `sum` makes a scalar of each loss, which may have shape () or (1,).
        loss = torch.stack([part.sum() for part in loss.values()]).sum()
    if not isinstance(loss, Tensor) or loss.numel() != 1:
        raise errors.ModelError(
            "the network returns no loss: its `forward` has to take targets after its "
            "input and return a loss or a mapping of losses; or pass `loss`, a function "
            "of network, input and targets, in Python"
        )
    # The sum of a single element: a scalar, which `backward` needs.
    return loss.sum()


def _call_in_training(network: nn.Module, x: Tensor, targets: Sequence[Target]) -> Any:
    """Return what a network returns if it gets targets; None if it takes none.

    Args:
        network: network in training mode.
        x: the network's input (N, 3, H, W).
        targets: the ground truth of each image.
    """
    # `advsearch` wraps networks of both libraries: `inner` is the original network.
    inner: Any = getattr(network, "network", network)
    is_of_transformers = hasattr(inner, "config")
    if is_of_transformers:
        return inner(pixel_values=x, labels=_transformers_labels(x, targets)).loss
    is_wrapped = inner is not network
    if is_wrapped:  # a network of torchvision
        return inner(list(x), list(targets))
    if _takes_targets(network):
        return network(x, list(targets))
    return None


def _takes_targets(network: nn.Module) -> bool:
    """Return whether a network's `forward` takes more than its input."""
    return len(inspect.signature(network.forward).parameters) > 1


def _transformers_labels(
    x: Tensor, targets: Sequence[Target]
) -> list[dict[str, Tensor]]:
    """Return targets as transformers' detectors take them.

    Boxes have a center and a size, as fractions of the input's size.
    """
    height, width = x.shape[-2:]
    size = x.new_tensor([width, height, width, height])
    labels = []
    for target in targets:
        lower, upper = (target["boxes"] / size).split(2, dim=1)
        boxes = torch.cat([(lower + upper) / 2, upper - lower], dim=1)
        labels.append({"class_labels": target["labels"], "boxes": boxes})
    return labels


class DetectorTrainer(Trainer):
    """Train a detector on adversarial images, plain images and custom examples.

    Searches attack the student as it is at the start of the round. Images are mirrored
    half of the time. Statistics of batch normalization are not updated.
    """

    batch_size = 8
    weight_decay = 1e-4
    warm_up_fraction = 0.3
    n_views = (N_VIEWS, N_VIEWS)

    def __init__(
        self,
        work: SceneJobs,
        student: Trainable,
        optimiser: MakeOptimizer | None = None,
        custom_items: Sequence[Example] = (),
        loss: Loss | None = None,
    ) -> None:
        """Set up the trainer.

        Args:
            work: samples scenes of the run.
            student: the copy of the network that is trained.
            optimiser: function from a list of parameters to an optimizer; None for
                AdamW.
            custom_items: the user's own images, which each round trains on.
            loss: training loss; None for that of `default_loss`.
        """
        super().__init__(work, student, optimiser, custom_items)
        self.loss = loss or self.default_loss()

    def default_loss(self) -> Loss:
        """Return the loss that is used if the caller passes none."""
        return compute_network_loss

    def sample_items(
        self, title: str, split: str, scene_numbers: range
    ) -> list[Example]:
        """Return plain images of scenes, then the worst image that each search finds.

        There is a search for each control. Its worst image is used whether the
        prediction is wrong or not.

        Args:
            title: title of the stage that the progress reports.
            split: name of the split that the scenes belong to.
            scene_numbers: numbers of the scenes.
        """
        controls = tuple(self.config.controls)
        plain = list[Example]()
        worst = list[Example]()
        self.scene_jobs.progress.stage(title, len(scene_numbers) * len(controls))
        for number in scene_numbers:
            for plain_image, worst_image in self._attack_by_control(split, number):
                plain.append(plain_image)
                worst.append(worst_image)
            plain += self._render_further_views(split, number, controls[-1])
        return plain + worst

    def _attack_by_control(
        self, split: str, number: int
    ) -> list[tuple[Example, Example]]:
        """Attack a scene with each control; return a plain and the worst image of each.

        Args:
            split: name of the split that the scene belongs to.
            number: number of the scene.
        """
        scene_split = self.scene_jobs.splits[split]
        name, scene = scene_split.load_scene(number)
        image_pairs = []
        for control in self.config.controls:
            # The seed is derived from control and scene number, so that a run that
            # continues, or one with other controls, samples the same.
            seed = seeds.derive_seed(scene_split.seed, f"search {control}", number)
            image_pairs.append(self._attack(scene, name, control, seed))
            self.scene_jobs.progress.advance(1)
        return image_pairs

    def _render_further_views(
        self, split: str, number: int, control: str
    ) -> list[Example]:
        """Return plain images of further views of a scene.

        `_attack` has rendered the first view. What is not searched varies at random from
        view to view, such as the camera.

        Args:
            split: name of the split that the scene belongs to.
            number: number of the scene.
            control: any searched control, which a problem needs; plain images do not
                change it.
        """
        scene_split = self.scene_jobs.splits[split]
        problem, _ = self.scene_jobs.make_problem(scene_split, number, (control,))
        # the same seed as in `_attack_by_control`
        seed = seeds.derive_seed(scene_split.seed, f"search {control}", number)
        return [
            Example.render(problem, seeds.derive_seed(seed, "plain", view))
            for view in range(1, N_VIEWS)
        ]

    def _attack(
        self, scene: workbench.Scene, name: str, control: str, seed: int
    ) -> tuple[Example, Example]:
        """Attack the student in a scene; return a plain image and the worst one.

        The worst image is that of the search's best configuration, even if the model is
        right about it.

        Args:
            scene: scene to attack.
            name: name of its object.
            control: control that is searched.
            seed: seed of the search and of the conditions of both images.
        """
        model = self.student.model
        config = self.scene_jobs.make_attack_config(
            (control,), name, seed=seed, trials=TRIALS, verify_spp=SPP
        )
        u = workbench.attack_on(config, scene, model).u
        # a problem that only renders, without derivatives
        problem = workbench.make_problem_on(config, scene, model, differentiated=False)
        plain = Example.render(problem, seeds.derive_seed(seed, "plain", 0))
        worst = Example.render(problem, seeds.derive_seed(seed, "worst", 0), u)
        return plain, worst

    def uses_per_epoch(self, item: Example) -> int:
        """Return how often an epoch uses an image, more often an adversarial one."""
        return WORST_USES_PER_EPOCH if item.is_adversarial else 1

    @contextmanager
    def open_gradient_context(
        self, new: Sequence[Example]
    ) -> Iterator[ComputeGradient]:
        """Put the network into training mode while gradients are computed.

        Many detectors return losses only in training mode. Batch normalization and
        dropout stay in evaluation mode, as batches are too small for statistics.
        Afterwards the full network is in evaluation mode again.

        Args:
            new: new items of the round; not used here.
        """
        network = self.student.network.train()
        for module in network.modules():
            if isinstance(module, (_BatchNorm, nn.Dropout)):
                module.eval()
        yield partial(self._compute_batch_gradient, network)
        network.eval()

    def _compute_batch_gradient(
        self, network: nn.Module, batch: Sequence[Example], rng: np.random.Generator
    ) -> None:
        """Compute the gradient of a batch, half of it mirrored at random.

        Args:
            network: network in training mode, whose parameters get the gradient.
            batch: images with their ground truth.
            rng: decides which images are mirrored.
        """
        inputs = list[Tensor]()
        targets = list[Target]()
        for item in batch:
            is_mirrored = bool(rng.random() < 0.5)
            x, target = self.make_input(item, is_mirrored)
            inputs.append(x)
            targets.append(target)
        network.zero_grad()
        self.loss(network, torch.cat(inputs), targets).backward()

    def make_input(self, item: Example, is_mirrored: bool) -> tuple[Tensor, Target]:
        """Return the network's input (1, ...) for an image, and its target.

        The target has "boxes" (K, 4), x0, y0, x1, y1 in pixels of the input, and
        "labels" (K,).

        Args:
            item: the image and its boxes.
            is_mirrored: whether image and boxes are mirrored.
        """
        levels = item.image_uint8
        boxes = item.boxes
        height, width = item.image_uint8.shape[:2]
        if is_mirrored:
            levels = levels.flip(1)
            boxes = _mirror_boxes(boxes, width)
        # The image is resized to the network's input size, and boxes with it.
        input_height, input_width = self.student.model.input_size
        scale = torch.tensor([input_width / width, input_height / height] * 2)
        x = _prepare_single(self.student.model, levels)
        return x, {
            "boxes": (boxes * scale).to(x.device),
            "labels": item.labels.to(x.device),
        }

    def evaluate_student(self, validation_items: Sequence[Example]) -> Score:
        """Evaluate the student on plain and on adversarial images."""
        plain = []
        worst = []
        for item in validation_items:
            is_right = item.is_right(self.student.model)
            if item.is_adversarial:
                worst.append(is_right)
            else:
                plain.append(is_right)
        return Score(float(np.mean(plain)), float(np.mean(worst)))

    def save_images(
        self, run: RunDirectory, number: int, new: Sequence[Example]
    ) -> None:
        """Write the images of a round in COCO's format.

        Args:
            run: run directory that gets the files.
            number: number of the round.
            new: new items of the round.
        """
        directory = f"{IMAGE_DIRECTORY}/round-{number:03d}"
        images = []
        annotations = list[dict[str, Any]]()
        # Each image is written before it is yielded.
        written_items = write_images(run, f"{directory}/images", new)
        for image_id, (item, name) in enumerate(written_items, start=1):
            images.append(_make_image_entry(image_id, name, item))
            annotations += _annotate_image(item, image_id, len(annotations) + 1)
        if new:
            coco = self._make_coco(images, annotations)
            run.write_file(f"{directory}/annotations.json", json.dumps(coco).encode())

    def _make_coco(
        self, images: Sequence[object], annotations: Sequence[object]
    ) -> dict[str, object]:
        """Return the content of `annotations.json`."""
        categories = [
            {"id": index, "name": label}
            for index, label in enumerate(self.student.model.labels)
        ]
        return {
            "images": images,
            "annotations": annotations,
            "categories": categories,
        }


def _prepare_single(model: Model, levels: Tensor) -> Tensor:
    """Return the network's input (1, ...) for an image (H, W, 3) uint8."""
    # `prepare` fills the batch up to the model's minimum size with copies.
    batch = model.prepare(levels[None] / 255.0)
    return batch[:1]


def _mirror_boxes(boxes: Tensor, width: int) -> Tensor:
    """Return the boxes (K, 4), x0, y0, x1, y1 in pixels, of a mirrored image.

    A mirrored point has x' = width - x, so that the right edge becomes the left one.
    """
    x0, y0, x1, y1 = boxes.unbind(dim=1)
    return torch.stack([width - x1, y0, width - x0, y1], dim=1)


def _make_image_entry(image_id: int, name: str, item: Example) -> dict[str, object]:
    """Return COCO's description of an image.

    Args:
        image_id: number of the image in the file.
        name: name of its file, without ".png".
        item: the image.
    """
    height, width = item.image_uint8.shape[:2]
    return {
        "id": image_id,
        "file_name": f"{name}.png",
        "height": height,
        "width": width,
    }


def _annotate_image(
    item: Example, image_id: int, first_annotation_id: int
) -> list[dict[str, Any]]:
    """Return the annotations of all boxes of an image in COCO's format.

    Args:
        item: the image and its boxes.
        image_id: number of the image in the file.
        first_annotation_id: number of the first annotation; the others follow.
    """
    boxes_and_labels = zip(item.boxes.tolist(), item.labels.tolist(), strict=True)
    return [
        _annotate(annotation_id, image_id, box, label)
        for annotation_id, (box, label) in enumerate(
            boxes_and_labels, start=first_annotation_id
        )
    ]


def _annotate(
    annotation_id: int, image_id: int, box: Sequence[float], label: int
) -> dict[str, Any]:
    """Return the annotation of a box in COCO's format: corner, width and height.

    Args:
        annotation_id: number of the annotation in the file.
        image_id: number of the image in the file.
        box: x0, y0, x1, y1 in pixels.
        label: index of the class.
    """
    left, top, right, bottom = box
    width = right - left
    height = bottom - top
    return {
        "id": annotation_id,
        "image_id": image_id,
        "category_id": label,
        "bbox": [left, top, width, height],
        "area": width * height,
        "iscrowd": 0,
    }


def write_images(
    run: RunDirectory, directory: str, items: Sequence[Example]
) -> Iterator[tuple[Example, str]]:
    """Write the images of items into a directory of the run.

    Yields:
        Each item with the name of its image, without ".png".

    Args:
        run: run directory.
        directory: directory of the images inside the run.
        items: items with their images.
    """
    for number, item in enumerate(items, start=1):
        (run.path / directory).mkdir(parents=True, exist_ok=True)
        name = f"{number:05d}-{'worst' if item.is_adversarial else 'plain'}"
        run.save_image(name, item.image_uint8 / 255.0, directory)
        yield item, name


# ---- segmenters
# ----------------------------------------------------------------------------------


class SegmenterTrainer(DetectorTrainer):
    """Train a segmenter on adversarial and plain images.

    The target of the object's pixels is the object's class. The target of all other
    pixels is what the original model predicts, since their ground truth is not known.
    """

    def default_loss(self) -> Loss:
        """Return the loss that is used if the caller passes none."""
        task = workbench.make_task(self.config.task)
        return partial(compute_pixel_loss, task)

    def make_input(self, item: Example, is_mirrored: bool) -> tuple[Tensor, Target]:
        """Return the network's input for an image, and the target of its pixels.

        The target has "classes" (h, w) int64 and "object" (h, w) bool at the size of
        the network's output. Outside of the object, classes are those that the original
        model predicts.

        Args:
            item: item with a `Region` as truth.
            is_mirrored: whether image and target are mirrored.
        """
        region: Any = item.truth
        levels = item.image_uint8.flip(1) if is_mirrored else item.image_uint8
        original_classes = self._predict_original_classes(levels)
        output_size = tuple(original_classes.shape)
        is_object = region.resize_mask(output_size).to(original_classes.device)
        if is_mirrored:
            is_object = is_object.flip(1)
        x = _prepare_single(self.student.model, levels)
        object_class = region.labels[0]  # if several are right, training uses the first
        classes = torch.where(is_object, object_class, original_classes)
        return x, {
            "classes": classes.to(x.device),
            "object": is_object.to(x.device),
        }

    def _predict_original_classes(self, levels: Tensor) -> Tensor:
        """Return the classes (h, w) int64 that the original model predicts.

        Args:
            levels: image (H, W, 3) uint8.
        """
        with torch.no_grad():
            original_output = self.scene_jobs.model(levels[None] / 255.0)
        classes: Tensor = original_output[0].argmax(dim=0)
        return classes

    def save_images(
        self, run: RunDirectory, number: int, new: Sequence[Example]
    ) -> None:
        """Write the images of a round, and the masks of their objects."""
        directory = f"{IMAGE_DIRECTORY}/round-{number:03d}"
        for item, name in write_images(run, directory, new):
            mask = item.truth.mask[..., None].float().expand(-1, -1, 3)
            run.save_image(f"{name}-mask", mask, directory)


def compute_pixel_loss(
    task: Task, network: nn.Module, x: Tensor, targets: Sequence[Target]
) -> Tensor:
    """Return the loss of a segmenter.

    Networks of transformers compute it from `labels`. For other networks the loss is
    (mean cross-entropy of the object's pixels + mean cross-entropy of all other pixels)
    / 2, over all images. So the object counts as much as the rest, however small it is.
    A mean over no pixels is 0.

    Args:
        task: reads the network's output.
        network: network in training mode.
        x: the network's input.
        targets: for each image, "classes" (h, w) int64, the right class of each pixel,
            and "object" (h, w) bool, the object's pixels.
    """
    classes = torch.stack([target["classes"] for target in targets])
    is_object = torch.stack([target["object"] for target in targets])
    # the network inside of a wrapper of advsearch, or else the network itself
    inner: Any = getattr(network, "network", network)
    if hasattr(inner, "config"):  # a network of transformers
        loss: Tensor = inner(pixel_values=x, labels=classes).loss
        return loss
    logits = task.read(network(x), len(x))
    pixel_losses = F.cross_entropy(logits, classes, reduction="none")
    return _average_object_and_rest(pixel_losses, is_object)


def _average_object_and_rest(pixel_losses: Tensor, is_object: Tensor) -> Tensor:
    """Return half the mean loss of the object's pixels plus half that of the others.

    Args:
        pixel_losses: loss of each pixel (N, h, w).
        is_object: the object's pixels (N, h, w) bool.
    """
    # starts with zero, with a graph to all parameters even if there are no pixels
    total = pixel_losses.sum() * 0.0
    for mask in (is_object, ~is_object):
        if bool(mask.any()):
            total = total + pixel_losses[mask].mean()
    return 0.5 * total
