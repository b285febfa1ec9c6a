"""Boxes round what a detector sees: how far two overlap, which of many are one thing, and what a detector returns.

A box is x0, y0, x1, y1 from the top left, (..., 4). A detector's answer to one picture is a mapping with `boxes` (D, 4)
and `scores`: (D, C) of every class, or (D,) with `labels` (D,), the class of each box.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

Detections = Mapping[str, Tensor]

FORMS = ("xyxy", "xywh", "cxcywh", "yxyx")
"""How a box may be given: corners; a corner or the middle with width and height; corners with y first."""

EXPECTED = (
    "expected boxes (N, D, 4) and scores (N, D, classes); boxes (N, D, 4), labels (N, D) and scores (N, D); or for "
    "each picture a mapping with boxes (D, 4), labels (D,) and scores (D,)"
)


def overlap(boxes: Tensor, box: Tensor) -> Tensor:
    """Return intersection over union of boxes (D, 4) with one box (4,), (D,) in [0, 1]; differentiable."""
    common = _common(boxes, box)
    union = _area(boxes) + _area(box) - common
    return common / union.clamp_min(1e-12)


def share_inside(boxes: Tensor, box: Tensor) -> Tensor:
    """Return how much of each of boxes (D, 4) lies in one box (4,), (D,) in [0, 1]; differentiable."""
    return _common(boxes, box) / _area(boxes).clamp_min(1e-12)


def _common(boxes: Tensor, box: Tensor) -> Tensor:
    low = torch.maximum(boxes[..., :2], box[..., :2])
    high = torch.minimum(boxes[..., 2:], box[..., 2:])
    return (high - low).clamp_min(0.0).prod(dim=-1)


def _area(boxes: Tensor) -> Tensor:
    return (boxes[..., 2:] - boxes[..., :2]).clamp_min(0.0).prod(dim=-1)


def corners(boxes: Tensor, form: str) -> Tensor:
    """Return boxes (..., 4) of one of `FORMS` as x0, y0, x1, y1; differentiable."""
    if form == "yxyx":
        return boxes[..., [1, 0, 3, 2]]
    if form == "xyxy":
        return boxes
    start, size = boxes[..., :2], boxes[..., 2:]
    low = start - size / 2.0 if form == "cxcywh" else start
    return torch.cat([low, low + size], dim=-1)


def strongest(boxes: Tensor, scores: Tensor, count: int, iou: float) -> list[int]:
    """Return which boxes are left when of those that overlap only the best one is kept (greedy suppression).

    Args:
        boxes: (D, 4) of one class.
        scores: (D,).
        count: the most that are kept.
        iou: intersection over union from which two are the same thing.

    Returns:
        Their places, the best first.
    """
    left = scores.argsort(descending=True)
    kept: list[int] = []
    while len(left) and len(kept) < count:
        first, left = left[0], left[1:]
        kept.append(int(first))
        left = left[overlap(boxes[left], boxes[first]) < iou]
    return kept


# ---- what a detector returns ----------------------------------------------------------------------------------------


def detections_in(answer: Any, count: int, form: str) -> list[Detections]:
    """Return what a detector answered to each of `count` pictures; boxes as corners, in the unit that they came in.

    Args:
        answer: as `EXPECTED` says. A mapping or an object may hold `boxes`, `scores` and `labels` too; of three tensors
            the scores and the labels may come in either order where the labels are whole numbers.
        count: pictures.
        form: of the boxes, one of `FORMS`.

    Raises:
        ValueError: it is something else, or scores are not in [0, 1].
    """
    if isinstance(answer, (list, tuple)) and len(answer) == count and all(map(_is_one, answer)):
        found = [_one(*_parts(one)) for one in answer]
    else:
        boxes, labels, scores = _parts(answer)
        if boxes.ndim == 2 and count == 1:  # the network has dropped the batch dimension
            boxes, scores = boxes[None], scores[None]
            labels = None if labels is None else labels[None]
        if boxes.ndim != 3 or not len(boxes) == len(scores) == count:
            raise ValueError(EXPECTED)
        found = [_one(boxes[k], None if labels is None else labels[k], scores[k]) for k in range(count)]
    return [{**one, "boxes": corners(one["boxes"].float(), form)} for one in found]


def _is_one(part: Any) -> bool:
    """Whether a part of an answer is that to one picture, and not boxes or scores of all."""
    return isinstance(part, (Mapping, list, tuple)) or hasattr(part, "boxes")


def _parts(answer: Any) -> tuple[Tensor, Tensor | None, Tensor]:
    """Return boxes, labels and scores; None for labels where scores are of every class."""
    if isinstance(answer, Mapping):
        parts: Sequence[Any] = [answer.get(name) for name in ("boxes", "labels", "scores")]
    elif hasattr(answer, "boxes"):
        parts = [getattr(answer, name, None) for name in ("boxes", "labels", "scores")]
    elif isinstance(answer, (list, tuple)) and len(answer) == 2:
        parts = [answer[0], None, answer[1]]
    elif isinstance(answer, (list, tuple)) and len(answer) == 3:
        swapped = isinstance(answer[2], Tensor) and not answer[2].is_floating_point()
        parts = [answer[0], answer[2], answer[1]] if swapped else answer
    else:
        raise ValueError(EXPECTED)
    boxes, labels, scores = parts
    if not (isinstance(boxes, Tensor) and isinstance(scores, Tensor) and isinstance(labels, (Tensor, type(None)))):
        raise ValueError(EXPECTED)
    return boxes, labels, scores


def _one(boxes: Tensor, labels: Tensor | None, scores: Tensor) -> dict[str, Tensor]:
    """The detections of one picture, checked."""
    shape = scores.shape if labels is None else labels.shape
    fits = scores.ndim == 2 if labels is None else scores.ndim == 1
    if boxes.ndim != 2 or boxes.shape[1] != 4 or not fits or scores.shape != shape or len(scores) != len(boxes):
        raise ValueError(EXPECTED)
    outside = scores.detach()
    if bool(((outside < -1e-3) | (outside > 1.0 + 1e-3)).any()):
        raise ValueError("expected scores that are probabilities in [0, 1]; apply a sigmoid or a softmax to them")
    own = {"boxes": boxes, "scores": scores.float()}
    return own if labels is None else {**own, "labels": labels.long()}
