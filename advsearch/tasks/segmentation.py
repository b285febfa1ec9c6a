"""Semantic segmentation: whether a model gives the object's pixels a right class."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from advsearch.extend import tasks

EXPECTED = (
    "expected logits (N, classes, height, width), or a mapping with these "
    "under "
    "'out' or 'logits'"
)

LEAST_ACCURACY = 0.1  # fraction of the object's pixels from which on it is seen in part

Lead = Callable[[Tensor, tasks.Labels], Tensor]


@dataclass(frozen=True)
class Region:
    """What is to be segmented in a picture, the truth of segmentation: indices of the
    right classes, and (H, W) bool, the pixels in which the object is seen.
    """

    labels: tasks.Labels
    mask: Tensor

    def at(self, size: tuple[int, int]) -> Tensor:
        """Return the mask at the size of an output, (h, w) bool: a pixel of which at
        least half is the object's. Where none is, those that have a part of it.
        """
        if self.mask.shape == size:
            return self.mask
        shares = F.interpolate(self.mask[None, None].float(), size=size, mode="area")[
            0, 0
        ]
        half = shares >= 0.5
        return half if bool(half.any()) else shares > 0.0


@dataclass(frozen=True, kw_only=True)
class Segmentation(tasks.ClassTask):
    """A model gives at least `accuracy` of the object's pixels a right class. Pixels
    beside the object don't count.

    Where the object is not seen at all there is nothing to segment, and every prediction is right. Raises InputError:
    `accuracy` is no share between 0 and 1.
    """

    name = "segmentation"
    objective = "pixel_margin"
    varies = True

    accuracy: float = 0.5

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_numbers(
            lambda value: 0.0 < value <= 1.0, "a number over 0, up to 1", "accuracy"
        )

    def read(self, returned: Any, count: int) -> Tensor:
        """Return the logits (N, classes, h, w) in what a network returned. Raises
        ValueError: there are none.
        """
        if isinstance(returned, Mapping):
            returned = returned.get("out", returned.get("logits"))
        elif hasattr(returned, "logits"):
            returned = returned.logits
        elif isinstance(returned, (list, tuple)) and returned:
            returned = returned[0]
        if (
            not isinstance(returned, Tensor)
            or returned.ndim != 4
            or len(returned) != count
            or returned.shape[1] < 2
        ):
            raise ValueError(EXPECTED)
        return returned.float()

    def classes_in(self, output: Tensor) -> int:
        return output.shape[1]

    def truth(self, facts: tasks.Facts) -> Region:
        return Region(self.right_classes(facts), facts.mask)

    def truth_names(self, truth: Region) -> tuple[str, ...]:
        return self.names(truth.labels)

    def loss(self, output: Tensor, truth: Region) -> Tensor:
        """Return, in logits (N,), the wrong classes' lead at the pixel that decides:
        over 0 where too few are right. Of the object's pixels in the order of that lead
        it is the one at which `accuracy` of them is reached.
        """
        return self._deciding(output, truth, tasks.wrong_lead, truth.labels)

    def score(self, output: Tensor, truth: Region) -> Tensor:
        """See `Task.score`; with a target, enough of the object's pixels have to be
        given that.
        """
        if self.target is None:
            return super().score(output, truth)
        return -self._deciding(
            output,
            truth,
            lambda logits, labels: -tasks.target_lead(logits, labels),
            self.target,
        )

    def pixel_margin(self, output: Tensor, truth: Region) -> Tensor:
        """Return the mean over the object's pixels of what is sought: the lead of wrong
        classes, or of the target's. In logits, (N,). Every pixel has a derivative, and
        not the deciding one alone as in `loss`.
        """
        pixels = self._pixels(output, truth)
        if pixels is None:
            return output.sum(dim=(1, 2, 3)) * 0.0 - 1.0
        lead = (
            tasks.wrong_lead(pixels, truth.labels)
            if self.target is None
            else tasks.target_lead(pixels, self.target)
        )
        mean = lead.reshape(len(output), -1).mean(dim=1)
        return -mean if self.minimise else mean

    def _deciding(
        self, output: Tensor, truth: Region, lead: Lead, labels: tasks.Labels
    ) -> Tensor:
        """The lead at the pixel at which `accuracy` of them is reached, (N,)."""
        pixels = self._pixels(output, truth)
        if pixels is None:
            return output.sum(dim=(1, 2, 3)) * 0.0 - 1.0
        values = lead(pixels, labels).reshape(len(output), -1)
        deciding = values.kthvalue(
            math.ceil(self.accuracy * values.shape[1]), dim=1
        ).values
        return torch.where(values.isfinite().all(dim=1), deciding, math.nan)

    @staticmethod
    def _pixels(output: Tensor, truth: Region) -> Tensor | None:
        """The logits of the object's pixels, picture by picture, (N * P, classes); None
        where it is not seen.
        """
        mask = truth.at((output.shape[2], output.shape[3])).to(output.device)
        chosen = output.permute(0, 2, 3, 1)[:, mask]
        return chosen.reshape(-1, output.shape[1]) if chosen.shape[1] else None

    def predictions(
        self, output: Tensor, count: int = 1
    ) -> list[tuple[tasks.Prediction, ...]]:
        """Return the things that most pixels of each picture are given, with the shares
        that they have.
        """
        found = []
        for one in output.detach():
            said = one[:, (one.isfinite() | (one == -math.inf)).all(dim=0)].argmax(
                dim=0
            )
            counts = said.bincount(minlength=len(one))
            counts[list(self.nothing)] = 0
            shares, indices = counts.topk(min(count, len(one)))
            rows = zip(indices.tolist(), shares.tolist(), strict=True)
            listed = tuple(
                tasks.Prediction(self.name_of(i), i, n / one[0].numel())
                for i, n in rows
                if n
            )
            found.append(
                listed
                or (tasks.Prediction("nothing" if len(said) else tasks.NOT_A_NUMBER),)
            )
        return found

    def said(
        self, output: Tensor, truth: Region, margins: Sequence[float]
    ) -> list[tasks.Said]:
        """See `Task.said`. The prediction is the class of most of the object's pixels;
        a wrong one where too few are right, and where most of these are background "no
        bottle", or "bottle in part" from `LEAST_ACCURACY` on. Its probability is the
        share of the object's pixels that are right. Beside it stand the outcome, shares
        of the pixels by class, and the overlap.
        """
        found: list[tasks.Said] = []
        mask = truth.at((output.shape[2], output.shape[3])).to(output.device)
        for logits, margin in zip(output, margins, strict=True):
            pixels = self._pixels(logits[None], truth)
            if pixels is None:
                found.append((tasks.Prediction(tasks.OUT_OF_VIEW), None))
                continue
            right = margin >= 0.0
            hits = self._correct(logits, truth)
            counts = pixels.argmax(dim=1).bincount(minlength=pixels.shape[1])
            first = int(
                counts.masked_fill(
                    tasks.members(pixels, truth.labels) != right, -1
                ).argmax()
            )
            accuracy = float(hits[mask].float().mean())
            overlap = float((hits & mask).sum() / (hits | mask).sum())
            said = tasks.Prediction(self.name_of(first), first, accuracy)
            outcome = tasks.Outcome.FOUND if right else tasks.Outcome.WRONG_CLASS
            if not right and first in self.nothing:
                name = self.name_of(truth.labels[0])
                is_partly_right = accuracy >= LEAST_ACCURACY
                outcome = (
                    tasks.Outcome.LOOSE if is_partly_right else tasks.Outcome.MISSED
                )
                said = tasks.Prediction(
                    f"{name} in part" if is_partly_right else f"{tasks.NO}{name}",
                    None,
                    accuracy,
                )
            shares = {
                self.name_of(i): round(n / len(pixels), 4)
                for i, n in enumerate(counts.tolist())
                if n
            }
            numbers = {"accuracy": round(accuracy, 4), "iou": round(overlap, 4)}
            found.append(
                (said, {tasks.OUTCOME: outcome.value, **numbers, "pixels": shares})
            )
        return found

    @staticmethod
    def _correct(logits: Tensor, truth: Region) -> Tensor:
        """Where the output (C, h, w) is a right class, (h, w) bool; a tie is right, NaN
        is not.
        """
        classes = logits.shape[0]
        return (
            tasks.wrong_lead(logits.permute(1, 2, 0).reshape(-1, classes), truth.labels)
            <= 0.0
        ).reshape(logits.shape[1:])

    def marks(self, output: Tensor, truth: Region) -> list[list[tasks.Mark]]:
        """See `Task.marks`: the object, and the pixels that are given a right class."""
        name = " or ".join(self.names(truth.labels))
        true = tasks.Mark(name, True, mask=truth.mask)
        return [
            [true, tasks.Mark(name, False, mask=self._correct(one, truth))]
            for one in output.detach()
        ]
