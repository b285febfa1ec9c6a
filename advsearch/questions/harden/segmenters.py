"""How a segmenter is hardened: as a detector is, with a class for each pixel in the place of boxes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from advsearch.models.reference import Trainable
from advsearch.questions.harden.detectors import DetectorCourse, Example, Loss, Target
from advsearch.questions.harden.rounds import MakeOptimiser
from advsearch.questions.harden.scenes import SceneWork
from advsearch.runs.images import write_png
from advsearch.tasks import make_task
from advsearch.tasks.segmentation import Region, Segmentation


class SegmenterCourse(DetectorCourse):
    """A picture teaches that the object's pixels are of its class, and all others of that which the model gave them
    before it was trained: what they are is not known, and they are to stay."""

    def __init__(
        self, work: SceneWork, student: Trainable, optimiser: MakeOptimiser | None = None, loss: Loss | None = None
    ) -> None:
        task: Any = make_task(work.config.task)
        super().__init__(work, student, optimiser, (), loss or PixelLoss(task))

    def shown(self, item: Example, mirrored: bool) -> tuple[Tensor, Target]:
        """Return what the network is given for a picture, with "classes" (h, w) int64 and whether a pixel is the
        "object" (h, w), at the size of its output."""
        region: Any = item.truth
        assert isinstance(region, Region)
        levels = item.levels.flip(1) if mirrored else item.levels
        with torch.no_grad():
            classes = self.work.model(levels[None] / 255.0)[0].argmax(dim=0)
        there = region.at((classes.shape[0], classes.shape[1])).to(classes.device)
        there = there.flip(1) if mirrored else there
        x = self.student.model.prepared(levels[None] / 255.0)[:1]
        return x, {"classes": torch.where(there, region.labels[0], classes).to(x.device), "object": there.to(x.device)}

    def save(self, folder: Path, number: int, new: Sequence[Example]) -> None:
        """Write the pictures, each with the mask of its object."""
        place = folder / f"round-{number:03d}"
        for at, item in enumerate(new, 1):
            place.mkdir(parents=True, exist_ok=True)
            region: Any = item.truth
            name = f"{at:05d}-{'worst' if item.found else 'plain'}"
            write_png(place / f"{name}.png", item.levels / 255.0)
            write_png(place / f"{name}-mask.png", region.mask[..., None].float().expand(-1, -1, 3))


class PixelLoss:
    """The loss of a network that returns one (transformers' of `labels`), else the cross-entropy of its logits: half
    for the object, which may be small, and half for the rest."""

    def __init__(self, task: Segmentation) -> None:
        self.task = task

    def __call__(self, network: nn.Module, x: Tensor, targets: Sequence[Target]) -> Tensor:
        classes, objects = (torch.stack([one[name] for one in targets]) for name in ("classes", "object"))
        inner: Any = getattr(network, "network", network)
        if hasattr(inner, "config"):
            given: Tensor = inner(pixel_values=x, labels=classes).loss
            return given
        logits = self.task.read(network(x), len(x))
        each = F.cross_entropy(logits, classes, reduction="none")
        return 0.5 * sum((each[part].mean() for part in (objects, ~objects) if bool(part.any())), each.sum() * 0.0)
