"""`harden` for detectors: a copy is trained on pictures that searches got wrong, with what is true in them, beside the
same scenes as they are and pictures of one's own. Losses are the network's, or a function of the caller's."""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import torch as safetensors
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm

from advsearch import seeds
from advsearch.errors import FileFormatError, InputError, ModelError
from advsearch.files import parse_json, read_text
from advsearch.models import Model
from advsearch.models.reference import copied_network
from advsearch.models.source import frozen
from advsearch.pictures import upright
from advsearch.progress import Progress
from advsearch.questions.attack.carry_out import attack_on
from advsearch.questions.attack.parts import problem_of
from advsearch.questions.harden import scenes
from advsearch.questions.harden.lessons import EXAMPLE_SPP, FOLDER, Example, examples
from advsearch.questions.harden.result import HardenConfig, TrainingRound
from advsearch.questions.harden.scenes import SceneWork
from advsearch.questions.harden.training import WEIGHTS
from advsearch.runs.directory import ARTIFACTS, RunDirectory
from advsearch.runs.files import write_bytes
from advsearch.runs.images import write_png
from advsearch.scene.formation import levels_of

Target = dict[str, Tensor]
"""What is in a picture: "boxes" (K, 4), x0, y0, x1, y1 in pixels of the network's input, and "labels" (K,) indices."""
Loss = Callable[[nn.Module, Tensor, Sequence[Target]], Tensor]
"""From a network, its input (N, ...) and what is in each picture to a number that training makes smaller."""

BATCH, WEIGHT_DECAY, LARGEST_GRADIENT_NORM = 8, 1e-4, 2.0
PARTS = (1.0, 0.8, 0.6, 0.4, 0.2)
"""Of the way from the weights that were given to the trained ones, which are judged (Wortsman et al. 2022)."""
VIEWS = 2
"""Pictures of a scene as it is beside those that were attacked, from other sides."""
SEEN = 5
"""How often an epoch looks at a picture that a search made, for each look at one as it is."""
LARGEST, LARGEST_SIDE = 256 << 20, 8192
"""Bytes of a COCO file, and pixels along a picture of it."""


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


@dataclass(frozen=True, eq=False)
class Student:
    """A copy of a detector that is trained, and the model that asks the same weights."""

    network: nn.Module
    model: Model
    loss: Loss

    @classmethod
    def of(cls, model: Model, loss: Loss | None) -> Student:
        """Return a copy to train; a ModelError where it has no weights."""
        network = copied_network(model).requires_grad_(True)
        if not list(network.parameters()):
            raise ModelError(f"model {model.name}: has no parameters to train")
        return cls(network, replace(model, module=frozen(network, model.name)), loss or own_loss)

    def fit(
        self, examples: Sequence[Example], epochs: int, rate: float, seed: int,
        optimiser: Any = None, tick: Callable[[], None] = lambda: None,
    ) -> None:  # fmt: skip
        """Train on examples, half of the time mirrored. Statistics of batches stay as they are."""
        network, rng = self.network.train(), np.random.default_rng(seed)
        for part in network.modules():
            if isinstance(part, (_BatchNorm, nn.Dropout)):
                part.eval()
        parameters = list(network.parameters())
        usual = torch.optim.AdamW(parameters, lr=rate, weight_decay=WEIGHT_DECAY)
        moved = usual if optimiser is None else optimiser(parameters)
        highest = [float(group["lr"]) for group in moved.param_groups]
        steps = epochs * -(-len(examples) // BATCH)
        rates = torch.optim.lr_scheduler.OneCycleLR(moved, highest, total_steps=steps + 1, cycle_momentum=False)
        for _ in range(epochs):
            order = rng.permutation(len(examples))
            for begin in range(0, len(order), BATCH):
                batch = [self._input(examples[place], bool(rng.random() < 0.5)) for place in order[begin:][:BATCH]]
                moved.zero_grad()
                loss = self.loss(network, torch.cat([x for x, _ in batch]), [target for _, target in batch])
                loss.backward()
                nn.utils.clip_grad_norm_(parameters, LARGEST_GRADIENT_NORM)
                moved.step()
                rates.step()
                tick()
        network.eval()

    def _input(self, one: Example, mirrored: bool) -> tuple[Tensor, Target]:
        """What the network is given for a picture, with what is in it in pixels of that."""
        levels, boxes, (height, width) = one.levels, one.boxes, one.levels.shape[:2]
        if mirrored:
            levels = levels.flip(1)
            boxes = torch.stack([width - boxes[:, 2], boxes[:, 1], width - boxes[:, 0], boxes[:, 3]], dim=1)
        rows, columns = self.model.input_size
        scale = torch.tensor([columns / width, rows / height] * 2)
        x = self.model.prepared(levels[None] / 255.0)[:1]
        return x, {"boxes": (boxes * scale).to(x.device), "labels": one.labels.to(x.device)}


class DetectorRounds:
    """The rounds of a run: searches in scenes of the training, a training on what they found, and the choice of
    weights by scenes that were not trained on."""

    def __init__(
        self, run: RunDirectory, work: SceneWork, student: Student, own: Sequence[Example], optimiser: Any,
        progress: Progress,
    ) -> None:  # fmt: skip
        self.run, self.work, self.student, self.own, self.optimiser = run, work, student, own, optimiser
        self.progress, self.config, self.done, self.best = progress, work.config, list[TrainingRound](), 0
        self.given = {name: one.clone() for name, one in student.network.state_dict().items()}
        self.judged = max(1, -(-self.config.scenes // 3))

    @staticmethod
    def right_share(model: Model, chosen: Sequence[Example]) -> float:
        """Return the share of pictures that a model has right."""
        return sum(one.right(model) for one in chosen) / len(chosen)

    def carry_out(self) -> None:
        """Train; the student has the best weights afterwards, which the run keeps. A run that goes on trains anew."""
        pool, kept = list[Example](self.own), self.given
        self.done.clear()
        self.student.network.load_state_dict(kept)
        plain, worst = self.found(scenes.VALIDATION, range(self.judged), "searching in scenes to choose weights by")
        clean = self.right_share(self.student.model, plain)
        self._note(0, 0.0, clean, self.right_share(self.student.model, worst))
        for number in range(1, self.config.rounds + 1):
            places = range((number - 1) * self.config.scenes, number * self.config.scenes)
            new, failures = self.found(scenes.TRAINING, places, f"round {number}: searching in scenes")
            self._save_pictures(FOLDER, number, new, failures)
            pool += [*new, *failures * SEEN]
            self.progress.stage(f"round {number}: training", self.config.epochs * -(-len(pool) // BATCH))
            seed = seeds.stream(self.config.seed, "order", number)
            self.student.fit(
                pool, self.config.epochs, self.config.rate, seed, self.optimiser, lambda: self.progress.advance(1)
            )
            learned = {name: one.clone() for name, one in self.student.network.state_dict().items()}
            scored = dict[float, tuple[float, float]]()
            for part in PARTS:
                self._take(learned, part)
                scored[part] = self.right_share(self.student.model, plain), self.right_share(self.student.model, worst)
            allowed = [part for part in PARTS if scored[part][0] >= clean - self.config.clean_loss - 1e-9]
            part = max(allowed or PARTS, key=lambda part: (scored[part][1 if allowed else 0], part))
            self._take(learned, part)
            self._note(len(pool), part, *scored[part])
            if allowed and self.done[-1].robust >= self.done[self.best].robust:
                self.best, kept = number, {name: one.clone() for name, one in self.student.network.state_dict().items()}
        self.student.network.load_state_dict(kept)
        state = {name: one.contiguous() for name, one in kept.items()}
        write_bytes(self.run.path / ARTIFACTS / WEIGHTS, safetensors.save(state))

    def found(self, side: str, places: Sequence[int], title: str) -> tuple[list[Example], list[Example]]:
        """Return pictures of scenes as they are, and the worst that a search finds for the student over each control,
        whether or not the student is wrong about it."""
        self.progress.stage(title, len(places) * len(self.config.controls))
        plain, worst = list[Example](), list[Example]()
        for number in places:
            name, scene = self.work.splits[side].scene(number)
            for control in self.config.controls:
                seed = seeds.stream(self.work.splits[side].seed, f"search {control}", number)
                config = self.work.attack((control,), name, seed=seed, trials=6, verify_spp=EXAMPLE_SPP)
                searched = attack_on(config, scene, self.student.model)
                problem = problem_of(config, scene, self.student.model, differentiated=False)
                plain += examples(problem, seed, range(1))
                worst += [Example.of(problem, searched.u, seeds.stream(seed, "worst", 0))]
                self.progress.advance(1)
            around, _ = self.work.problem(self.work.splits[side], number, (control,))
            plain += examples(around, seed, range(1, 1 + VIEWS))
        return plain, worst

    def _take(self, learned: Mapping[str, Tensor], part: float) -> None:
        mixed = {
            name: torch.lerp(self.given[name], one, part) if one.is_floating_point() else one
            for name, one in learned.items()
        }
        self.student.network.load_state_dict(mixed)

    def _note(self, lessons: int, part: float, clean: float, robust: float) -> None:
        self.done.append(TrainingRound(lessons=lessons, part=part, clean=clean, robust=robust, kept=False))

    def _save_pictures(self, folder: str, number: int, plain: Sequence[Example], worst: Sequence[Example]) -> None:
        """Keep what a round was trained on as COCO has it, for one's own training."""
        place, images, things = self.run.path / ARTIFACTS / folder / f"round-{number:03d}", [], list[Any]()
        for at, one in enumerate([*plain, *worst], 1):
            name = f"{at:05d}-{'plain' if at <= len(plain) else 'worst'}.png"
            (place / "images").mkdir(parents=True, exist_ok=True)
            write_png(place / "images" / name, one.levels / 255.0)
            height, width = one.levels.shape[:2]
            images.append({"id": at, "file_name": name, "height": height, "width": width})
            for (left, top, right, bottom), label in zip(one.boxes.tolist(), one.labels.tolist(), strict=True):
                box = [left, top, right - left, bottom - top]
                things.append({"id": len(things) + 1, "image_id": at, "category_id": label, "bbox": box,
                               "area": box[2] * box[3], "iscrowd": 0})  # fmt: skip
        named = [{"id": at, "name": name} for at, name in enumerate(self.student.model.labels)]
        told = {"images": images, "annotations": things, "categories": named}
        write_bytes(place / "annotations.json", json.dumps(told).encode())


def check_detector(config: HardenConfig, beside: object) -> None:
    """Refuse, by an InputError, settings that a detector is not trained by."""
    if beside is not None:
        raise InputError("beside: is of classifiers; give a detector a COCO folder as `data`")
    if config.layers != "all":
        raise InputError("layers: expected all of a detector; leave it out")
