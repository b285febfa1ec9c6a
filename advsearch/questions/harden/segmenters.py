"""How a segmenter is hardened: as a detector is, with a class for each pixel in the place of boxes."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from advsearch.questions.harden.detectors import DetectorCourse, Example, Loss, Target, written
from advsearch.runs.images import write_png
from advsearch.tasks import make_task
from advsearch.tasks.segmentation import Segmentation


class SegmenterCourse(DetectorCourse):
    """A picture teaches that the object's pixels are of its class, and all others of that which the model gave them
    before it was trained: what they are is not known, and they are to stay."""

    def usual_loss(self) -> Loss:
        task: Any = make_task(self.config.task)
        return partial(pixel_loss, task)

    def shown(self, item: Example, mirrored: bool) -> tuple[Tensor, Target]:
        """Return the network's input, and "classes" (h, w) int64 and "object" (h, w) at the size of its output."""
        region: Any = item.truth
        levels = item.levels.flip(1) if mirrored else item.levels
        with torch.no_grad():
            classes = self.work.model(levels[None] / 255.0)[0].argmax(dim=0)
        there = region.at(tuple(classes.shape)).to(classes.device)
        there = there.flip(1) if mirrored else there
        x = self.student.model.prepared(levels[None] / 255.0)[:1]
        return x, {"classes": torch.where(there, region.labels[0], classes).to(x.device), "object": there.to(x.device)}

    def save(self, folder: Path, number: int, new: Sequence[Example]) -> None:
        for item, file in written(folder / f"round-{number:03d}", new):
            region: Any = item.truth
            mask = region.mask[..., None].float().expand(-1, -1, 3)
            write_png(file.with_name(f"{file.stem}-mask.png"), mask)


def pixel_loss(task: Segmentation, network: nn.Module, x: Tensor, targets: Sequence[Target]) -> Tensor:
    """Return a network's own loss (transformers' of `labels`), else the cross-entropy, half of it for the object."""
    classes, objects = (torch.stack([target[name] for target in targets]) for name in ("classes", "object"))
    inner: Any = getattr(network, "network", network)
    if hasattr(inner, "config"):
        loss: Tensor = inner(pixel_values=x, labels=classes).loss
        return loss
    each = F.cross_entropy(task.read(network(x), len(x)), classes, reduction="none")
    return 0.5 * sum((each[part].mean() for part in (objects, ~objects) if bool(part.any())), each.sum() * 0.0)
