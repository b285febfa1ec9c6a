"""How a detector is hardened: it is trained on pictures that searches got wrong, with what is true in them, beside the
same scenes as they are and pictures of one's own. Losses are the network's, or a function of the caller's."""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm

from advsearch import seeds
from advsearch.engine.problem import Problem
from advsearch.errors import FileFormatError, InputError, ModelError
from advsearch.files import parse_json, read_text
from advsearch.models import Model
from advsearch.models.reference import Trainable
from advsearch.pictures import upright
from advsearch.questions.attack.carry_out import attack_on, problem_of
from advsearch.questions.harden.rounds import Course, MakeOptimiser, Score, Take
from advsearch.questions.harden.scenes import SceneWork
from advsearch.runs.files import write_bytes
from advsearch.runs.images import write_png
from advsearch.scene.formation import levels_of
from advsearch.tasks import Task
from advsearch.tasks.boxes import Place
from advsearch.tasks.segmentation import Region

Target = dict[str, Tensor]
"""What is in a picture: "boxes" (K, 4), x0, y0, x1, y1 in pixels of the network's input, and "labels" (K,) indices."""
Loss = Callable[[nn.Module, Tensor, Sequence[Target]], Tensor]
"""From a network, its input (N, ...) and what is in each picture to a number that training makes smaller."""

SPP = 8  # samples a pixel of a picture
TRIALS = 6  # of a search
SIDES = 3  # from which a scene is seen as it is
SEEN = 5
"""How often an epoch looks at a picture that a search made, for each look at one as it is."""
LARGEST, LARGEST_SIDE = 256 << 20, 8192
"""Bytes of a COCO file, and pixels along a picture of it."""


class Example(NamedTuple):
    """A picture (H, W, 3) uint8, all that is in it, boxes (K, 4) in its pixels and their classes (K,), and whether a
    search has found it. What is not of one's own has the place of the thing in it, with the task that judges it."""

    levels: Tensor
    boxes: Tensor
    labels: Tensor
    task: Task | None = None
    truth: Place | Region | None = None
    found: bool = False

    @classmethod
    def of(cls, problem: Problem, seed: int, u: Tensor | None = None) -> Example:
        """Render a configuration, or the scene as it is, with the conditions that a seed draws."""
        at = problem.domain.start if u is None else u
        truth: Place | Region = problem.truth(problem.whole(at, seed))
        box = truth.box if isinstance(truth, Place) else None
        boxes = torch.tensor([box] if box else [], dtype=torch.float32).reshape(-1, 4)
        labels = torch.tensor([truth.labels[0]] * len(boxes), dtype=torch.int64)
        return cls(levels_of(problem.picture(at, seed, SPP)), boxes, labels, problem.task, truth, u is not None)

    def right(self, model: Model) -> bool:
        """Whether the model is right about it."""
        assert self.task is not None
        with torch.no_grad():
            return bool(self.task.loss(model(self.levels[None] / 255.0), self.truth)[0] <= 0.0)


def read_coco(folder: Path, model: Model) -> list[Example]:
    """Return the pictures of a folder as `export --format coco` writes it: `annotations.json` and `images/`. Categories
    are found among the model's labels by their names; what is called otherwise is left out.

    Raises:
        FileFormatError: the folder is something else, or names files outside of it.
        InputError: no category is one of the model's labels.
    """
    path, inside = folder / "annotations.json", (folder / "images").resolve()
    try:
        told: Any = parse_json(read_text(path, "a COCO file", LARGEST))
        indices = dict[Any, int]()
        for one in told["categories"]:
            if str(one["name"]) in model.labels:
                indices[one["id"]] = model.labels.index(str(one["name"]))
        things: dict[Any, list[Any]] = {}
        for one in told["annotations"]:
            if one["category_id"] in indices and not one.get("iscrowd"):
                things.setdefault(one["image_id"], []).append(one)
        if not indices:
            raise InputError(f"data: {path}: none of its categories is a label of model {model.name}")
        found = []
        for image in told["images"]:
            name = Path(str(image["file_name"]))
            file = inside / name
            if name.is_absolute() or ".." in name.parts or file.is_symlink() or inside not in file.resolve().parents:
                raise FileFormatError(f"{path}: expected names of files in images/, got {str(name)[:100]}")
            picture = torch.from_numpy(upright(file, LARGEST_SIDE))
            if picture.shape[:2] != (image["height"], image["width"]):
                raise ValueError(f"{name} of another size than it says")
            here = things.get(image["id"], [])
            boxes = torch.tensor([one["bbox"] for one in here], dtype=torch.float32).reshape(-1, 4)
            boxes = torch.cat([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]], dim=1)
            labels = torch.tensor([indices[one["category_id"]] for one in here], dtype=torch.int64)
            found.append(Example(levels_of(picture), boxes, labels))
        return found
    except (OSError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise FileFormatError(f"{path}: expected COCO's JSON beside images/, got {str(error)[:120]}") from None


def own_loss(network: nn.Module, x: Tensor, targets: Sequence[Target]) -> Tensor:
    """Return the loss that a network gives in training: torchvision's of lists of pictures and targets, transformers'
    of `labels`, and any network's whose `forward` takes targets after its input; the sum of several.

    Raises:
        ModelError: it gives none.
    """
    inner: Any = getattr(network, "network", network)
    if hasattr(inner, "config"):
        sides = x.new_tensor([x.shape[-1], x.shape[-2]] * 2)
        shares = [one["boxes"] / sides for one in targets]
        boxes = [torch.cat([(one[:, :2] + one[:, 2:]) / 2, one[:, 2:] - one[:, :2]], dim=1) for one in shares]
        named = [{"class_labels": one["labels"], "boxes": of} for one, of in zip(targets, boxes, strict=True)]
        returned: Any = inner(pixel_values=x, labels=named).loss
    elif inner is not network:
        returned = inner(list(x), list(targets))
    elif len(inspect.signature(network.forward).parameters) > 1:
        returned = network(x, list(targets))
    else:
        returned = None
    if isinstance(returned, Mapping):
        returned = torch.stack([one.sum() for one in returned.values()]).sum()
    if not isinstance(returned, Tensor) or returned.numel() != 1:
        raise ModelError(
            "the network returns no loss: its `forward` has to take targets after its input and return a loss or a "
            "mapping of losses; or give `loss`, a function of network, input and targets, in Python"
        )
    return returned.sum()


class DetectorCourse(Course[Example]):
    """Trains on the worst pictures that searches find for the student as it is, on the same scenes as they are, from
    there and from other sides, and on examples of one's own; half of the time mirrored. Statistics of batches stay as
    they are."""

    batch, weight_decay, warm_up, views = 8, 1e-4, 0.3, (SIDES, SIDES)

    def __init__(
        self, work: SceneWork, student: Trainable, optimiser: MakeOptimiser | None = None,
        own: Sequence[Example] = (), loss: Loss | None = None,
    ) -> None:  # fmt: skip
        super().__init__(work, student, optimiser, own)
        self.loss = loss or own_loss

    def draw(self, title: str, split: str, places: Sequence[int]) -> list[Example]:
        """Return pictures of scenes as they are, then the worst that a search finds over each control, whether or not
        the student is wrong about it."""
        side, controls, progress = self.work.splits[split], tuple(self.config.controls), self.work.progress
        plain, worst = list[Example](), list[Example]()
        progress.stage(title, len(places) * len(controls))
        for number in places:
            name, scene = side.scene(number)
            for control in controls:
                seed = seeds.stream(side.seed, f"search {control}", number)
                config = self.work.attack((control,), name, seed=seed, trials=TRIALS, verify_spp=SPP)
                searched = attack_on(config, scene, self.student.model)
                problem = problem_of(config, scene, self.student.model, differentiated=False)
                plain.append(Example.of(problem, seeds.stream(seed, "plain", 0)))
                worst.append(Example.of(problem, seeds.stream(seed, "worst", 0), searched.u))
                progress.advance(1)
            around, _ = self.work.problem(side, number, controls[-1:])
            plain += [Example.of(around, seeds.stream(seed, "plain", view)) for view in range(1, SIDES)]
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
            shown = [self.shown(item, bool(rng.random() < 0.5)) for item in batch]
            network.zero_grad()
            self.loss(network, torch.cat([x for x, _ in shown]), [target for _, target in shown]).backward()

        yield take
        network.eval()

    def shown(self, item: Example, mirrored: bool) -> tuple[Tensor, Target]:
        """Return what the network is given for a picture, with what is in it in pixels of that."""
        levels, boxes, (height, width) = item.levels, item.boxes, item.levels.shape[:2]
        if mirrored:
            levels = levels.flip(1)
            boxes = torch.stack([width - boxes[:, 2], boxes[:, 1], width - boxes[:, 0], boxes[:, 3]], dim=1)
        rows, columns = self.student.model.input_size
        scale = torch.tensor([columns / width, rows / height] * 2)
        x = self.student.model.prepared(levels[None] / 255.0)[:1]
        return x, {"boxes": (boxes * scale).to(x.device), "labels": item.labels.to(x.device)}

    def score(self, held_back: Sequence[Example]) -> Score:
        right = [(item.found, item.right(self.student.model)) for item in held_back]
        return Score(*(float(np.mean([known for found, known in right if found == which])) for which in (False, True)))

    def save(self, folder: Path, number: int, new: Sequence[Example]) -> None:
        """Write them as COCO has it, for one's own training."""
        place, images, things = folder / f"round-{number:03d}", [], list[Any]()
        for at, item in enumerate(new, 1):
            name, (height, width) = f"{at:05d}-{'worst' if item.found else 'plain'}.png", item.levels.shape[:2]
            (place / "images").mkdir(parents=True, exist_ok=True)
            write_png(place / "images" / name, item.levels / 255.0)
            images.append({"id": at, "file_name": name, "height": height, "width": width})
            for (left, top, right, bottom), label in zip(item.boxes.tolist(), item.labels.tolist(), strict=True):
                box = [left, top, right - left, bottom - top]
                things.append({"id": len(things) + 1, "image_id": at, "category_id": label, "bbox": box,
                               "area": box[2] * box[3], "iscrowd": 0})  # fmt: skip
        if new:
            named = [{"id": at, "name": name} for at, name in enumerate(self.student.model.labels)]
            told = {"images": images, "annotations": things, "categories": named}
            write_bytes(place / "annotations.json", json.dumps(told).encode())
