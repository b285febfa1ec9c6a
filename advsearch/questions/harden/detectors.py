"""How a detector is hardened: it is trained on pictures that searches got wrong, with
what is true in them, beside the same scenes as they are and pictures of one's own.
Losses are the network's, or a function of the caller's.
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
from advsearch.questions.harden.lessons import PICTURES
from advsearch.questions.harden.networks import Trainable
from advsearch.questions.harden.rounds import Course, MakeOptimiser, Score, Take
from advsearch.questions.harden.scenes import SceneWork

Target = dict[str, Tensor]
"""What is in a picture: "boxes" (K, 4), x0, y0, x1, y1 in pixels of the network's
input, and "labels" (K,) indices.
"""
Loss = Callable[[nn.Module, Tensor, Sequence[Target]], Tensor]
"""From a network, its input (N, ...) and what is in each picture to a number that
training makes smaller.
"""

SPP = 8  # samples a pixel of a picture
TRIALS = 6  # of a search
SIDES = 3  # from which a scene is seen as it is
# how often an epoch looks at a picture that a search made, for each look at one as it
# is
SEEN = 5
LARGEST = 256 << 20  # bytes of a COCO file, and pixels along a picture of it
LARGEST_SIDE = 8192


class Example(NamedTuple):
    """A picture (H, W, 3) uint8, all that is in it, boxes (K, 4) in its pixels and
    their classes (K,), and whether a search has found it. What is not of one's own has
    the place of the thing in it, with the task that judges it.
    """

    levels: Tensor
    boxes: Tensor
    labels: Tensor
    task: Task | None = None
    truth: Any = None  # a `Place` of detection, or a `Region` of segmentation
    found: bool = False

    @classmethod
    def of(cls, problem: Problem, seed: int, u: Tensor | None = None) -> Example:
        """Render a configuration, or the scene as it is, with the conditions that a
        seed draws.
        """
        at = problem.domain.start if u is None else u
        truth: Any = problem.truth(problem.whole(at, seed))
        box = getattr(truth, "box", None)
        boxes = torch.tensor([box] if box else [], dtype=torch.float32).reshape(-1, 4)
        labels = torch.tensor([truth.labels[0]] * len(boxes), dtype=torch.int64)
        return cls(
            color.levels_of(problem.picture(at, seed, SPP)),
            boxes,
            labels,
            problem.task,
            truth,
            u is not None,
        )

    def right(self, model: Model) -> bool:
        assert self.task is not None
        with torch.no_grad():
            return bool(
                self.task.loss(model(self.levels[None] / 255.0), self.truth)[0] <= 0.0
            )


def read_coco(folder: Path, model: Model) -> list[Example]:
    """Return the pictures of a folder as `export --format coco` writes it:
    `annotations.json` and `images/`. Categories are found among the model's labels by
    their names; what is called otherwise is left out. A FileFormatError where it is
    something else, or names files outside of it; an InputError where no category is one
    of the labels.
    """
    path = folder / "annotations.json"
    inside = (folder / "images").resolve()
    try:
        coco: Any = stored_files.parse_json(
            stored_files.read_text(path, "a COCO file", LARGEST)
        )
        known = [
            kind for kind in coco["categories"] if str(kind["name"]) in model.labels
        ]
        indices = {kind["id"]: model.labels.index(str(kind["name"])) for kind in known}
        things = defaultdict[Any, list[Any]](list)
        for thing in coco["annotations"]:
            if thing["category_id"] in indices and not thing.get("iscrowd"):
                things[thing["image_id"]].append(thing)
        if not indices:
            raise InputError(
                f"data: {path}: none of its categories is a label of model {model.name}"
            )
        examples = []
        for image in coco["images"]:
            name = Path(str(image["file_name"]))
            file = inside / name
            if (
                name.is_absolute()
                or ".." in name.parts
                or file.is_symlink()
                or inside not in file.resolve().parents
            ):
                raise errors.FileFormatError(
                    f"{path}: expected names of files in images/, got {str(name)[:100]}"
                )
            picture = torch.from_numpy(workbench.upright(file, LARGEST_SIDE))
            if picture.shape[:2] != (image["height"], image["width"]):
                raise ValueError(f"{name} of another size than it says")
            here = things[image["id"]]
            boxes = torch.tensor(
                [thing["bbox"] for thing in here], dtype=torch.float32
            ).reshape(-1, 4)
            boxes[:, 2:] += boxes[:, :2]
            labels = torch.tensor(
                [indices[thing["category_id"]] for thing in here], dtype=torch.int64
            )
            examples.append(Example(color.levels_of(picture), boxes, labels))
        return examples
    except (OSError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise errors.FileFormatError(
            f"{path}: expected COCO's JSON beside images/, got {str(error)[:120]}"
        ) from None


def own_loss(network: nn.Module, x: Tensor, targets: Sequence[Target]) -> Tensor:
    """Return the loss that a network gives in training: torchvision's of lists of
    pictures and targets, transformers' of `labels`, and any network's whose `forward`
    takes targets after its input; the sum of several. A ModelError where it gives none.
    """
    inner: Any = getattr(network, "network", network)
    returned: Any = None
    if hasattr(inner, "config"):
        sides = x.new_tensor([x.shape[-1], x.shape[-2]] * 2)
        named = []
        for target in targets:
            low, high = (target["boxes"] / sides).split(2, dim=1)
            named.append(
                {
                    "class_labels": target["labels"],
                    "boxes": torch.cat([(low + high) / 2, high - low], dim=1),
                }
            )
        returned = inner(pixel_values=x, labels=named).loss
    elif inner is not network:
        returned = inner(list(x), list(targets))
    elif len(inspect.signature(network.forward).parameters) > 1:
        returned = network(x, list(targets))
    if isinstance(returned, Mapping):
        returned = torch.stack([loss.sum() for loss in returned.values()]).sum()
    if not isinstance(returned, Tensor) or returned.numel() != 1:
        raise errors.ModelError(
            "the network returns no loss: its `forward` has to take targets after its "
            "input and return a loss or a "
            "mapping of losses; or give `loss`, a function of network, input and "
            "targets, in Python"
        )
    return returned.sum()


class DetectorCourse(Course):
    """Trains on the worst pictures that searches find for the student as it is, on the
    same scenes as they are, from other sides too, and on one's own examples; half of
    the time mirrored. Statistics of batches stay as they are.
    """

    batch = 8
    weight_decay = 1e-4
    warm_up = 0.3
    views = (SIDES, SIDES)

    def __init__(
        self, work: SceneWork, student: Trainable, optimiser: MakeOptimiser | None = None,
        own: Sequence[Example] = (), loss: Loss | None = None,
    ) -> None:  # fmt: skip
        super().__init__(work, student, optimiser, own)
        self.loss = loss or self.usual_loss()

    def usual_loss(self) -> Loss:
        return own_loss

    def draw(self, title: str, split: str, places: range) -> list[Example]:
        """Return pictures of scenes as they are, then for each control the worst that a
        search finds, wrong or not.
        """
        side = self.work.splits[split]
        controls = tuple(self.config.controls)
        model = self.student.model
        plain = list[Example]()
        worst = list[Example]()
        self.work.progress.stage(title, len(places) * len(controls))
        for number in places:
            name, scene = side.scene(number)
            for control in controls:
                seed = seeds.stream(side.seed, f"search {control}", number)
                config = self.work.attack(
                    (control,), name, seed=seed, trials=TRIALS, verify_spp=SPP
                )
                u = workbench.attack_on(config, scene, model).u
                problem = workbench.problem_of(
                    config, scene, model, differentiated=False
                )
                plain.append(Example.of(problem, seeds.stream(seed, "plain", 0)))
                worst.append(Example.of(problem, seeds.stream(seed, "worst", 0), u))
                self.work.progress.advance(1)
            around, _ = self.work.problem(side, number, controls[-1:])
            plain += [
                Example.of(around, seeds.stream(seed, "plain", view))
                for view in range(1, SIDES)
            ]
        return plain + worst

    def looks(self, item: Example) -> int:
        return SEEN if item.found else 1

    @contextmanager
    def gradients(self, new: Sequence[Example]) -> Iterator[Take]:
        network = self.student.net.train()
        for part in network.modules():
            if isinstance(part, (_BatchNorm, nn.Dropout)):
                part.eval()

        def take(batch: Sequence[Example], rng: np.random.Generator) -> None:
            inputs, targets = zip(
                *(self.shown(item, bool(rng.random() < 0.5)) for item in batch),
                strict=True,
            )
            network.zero_grad()
            self.loss(network, torch.cat(inputs), targets).backward()

        yield take
        network.eval()

    def shown(self, item: Example, mirrored: bool) -> tuple[Tensor, Target]:
        """Return what the network is given for a picture, with what is in it in pixels
        of that.
        """
        levels = item.levels
        boxes = item.boxes
        (height, width) = item.levels.shape[:2]
        if mirrored:
            levels = levels.flip(1)
            boxes = torch.stack(
                [width - boxes[:, 2], boxes[:, 1], width - boxes[:, 0], boxes[:, 3]],
                dim=1,
            )
        rows, columns = self.student.model.input_size
        scale = torch.tensor([columns / width, rows / height] * 2)
        x = self.student.model.prepared(levels[None] / 255.0)[:1]
        return x, {
            "boxes": (boxes * scale).to(x.device),
            "labels": item.labels.to(x.device),
        }

    def score(self, held_back: Sequence[Example]) -> Score:
        right = [(item.found, item.right(self.student.model)) for item in held_back]
        return Score(
            *(
                float(np.mean([known for found, known in right if found == which]))
                for which in (False, True)
            )
        )

    def save(self, run: RunDirectory, number: int, new: Sequence[Example]) -> None:
        """Write them as COCO has it, for one's own training."""
        folder = f"{PICTURES}/round-{number:03d}"
        images = []
        things = list[Any]()
        for at, (item, name) in enumerate(written(run, f"{folder}/images", new), 1):
            height, width = item.levels.shape[:2]
            images.append(
                {"id": at, "file_name": f"{name}.png", "height": height, "width": width}
            )
            for (left, top, right, bottom), label in zip(
                item.boxes.tolist(), item.labels.tolist(), strict=True
            ):
                box = [left, top, right - left, bottom - top]
                things.append({"id": len(things) + 1, "image_id": at, "category_id": label, "bbox": box,
                               "area": box[2] * box[3], "iscrowd": 0})  # fmt: skip
        if new:
            named = [
                {"id": at, "name": name}
                for at, name in enumerate(self.student.model.labels)
            ]
            coco = {"images": images, "annotations": things, "categories": named}
            run.write_file(f"{folder}/annotations.json", json.dumps(coco).encode())


def written(
    run: RunDirectory, folder: str, items: Sequence[Example]
) -> Iterator[tuple[Example, str]]:
    """Write the picture of each item into a folder of the run, and yield it with the
    name of that, without ".png".
    """
    for number, item in enumerate(items, 1):
        (run.path / folder).mkdir(parents=True, exist_ok=True)
        name = f"{number:05d}-{'worst' if item.found else 'plain'}"
        run.save_image(name, item.levels / 255.0, folder)
        yield item, name


# ---- How a segmenter is hardened: as a detector is, with a class for each pixel in the
# place of boxes ---------------


class SegmenterCourse(DetectorCourse):
    """A picture teaches that the object's pixels are of its class, and all others of
    that which the model gave them before it was trained: what they are is not known,
    and they are to stay.
    """

    def usual_loss(self) -> Loss:
        task = workbench.make_task(self.config.task)
        return partial(pixel_loss, task)

    def shown(self, item: Example, mirrored: bool) -> tuple[Tensor, Target]:
        """Return the network's input, and "classes" (h, w) int64 and "object" (h, w) at
        the size of its output.
        """
        region: Any = item.truth
        levels = item.levels.flip(1) if mirrored else item.levels
        with torch.no_grad():
            classes = self.work.model(levels[None] / 255.0)[0].argmax(dim=0)
        there = region.at(tuple(classes.shape)).to(classes.device)
        there = there.flip(1) if mirrored else there
        x = self.student.model.prepared(levels[None] / 255.0)[:1]
        return x, {
            "classes": torch.where(there, region.labels[0], classes).to(x.device),
            "object": there.to(x.device),
        }

    def save(self, run: RunDirectory, number: int, new: Sequence[Example]) -> None:
        folder = f"{PICTURES}/round-{number:03d}"
        for item, name in written(run, folder, new):
            mask = item.truth.mask[..., None].float().expand(-1, -1, 3)
            run.save_image(f"{name}-mask", mask, folder)


def pixel_loss(
    task: Task, network: nn.Module, x: Tensor, targets: Sequence[Target]
) -> Tensor:
    """Return a network's own loss (transformers' of `labels`), else the cross-entropy,
    half of it for the object.
    """
    classes, objects = (
        torch.stack([target[name] for target in targets])
        for name in ("classes", "object")
    )
    inner: Any = getattr(network, "network", network)
    if hasattr(inner, "config"):
        loss: Tensor = inner(pixel_values=x, labels=classes).loss
        return loss
    each = F.cross_entropy(task.read(network(x), len(x)), classes, reduction="none")
    return 0.5 * sum(
        (each[part].mean() for part in (objects, ~objects) if bool(part.any())),
        each.sum() * 0.0,
    )
