"""Boxes round what a detector sees: how far two overlap, and which of many are one thing.

A box is x0, y0, x1, y1 from the top left, (..., 4).
"""

from __future__ import annotations

import torch
from torch import Tensor

FORMS = ("xyxy", "xywh", "cxcywh", "yxyx")
"""How a box may be given: corners; a corner or the middle with width and height; corners with y first."""


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
