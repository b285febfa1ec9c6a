"""How often a model is right on given images, how sure it says it is, and how the two
agree.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import Tensor

from advsearch.errors import InputError

#: Pictures (N, H, W, 3), 8-bit: a tensor, an array, or a memory map that is read a
# batch at a time.
Images = Tensor | npt.NDArray[np.uint8]


@dataclass(frozen=True)
class ReliabilityBin:
    """Pictures whose confidence lies in (low, high]; `accuracy` and `confidence` are
    means, 0 where `count` is 0.
    """

    low: float
    high: float
    count: int
    accuracy: float
    confidence: float


@dataclass(frozen=True)
class Report:
    """Figures of a model on labelled images.

    Args:
        count: number of images.
        accuracy: part that is right, in [0, 1].
        per_class: accuracy per class; None for a class without images.
        confusion: (classes, classes) counts, rows are the true class.
        confidence: mean of the largest probability.
        error: expected calibration error: mean over images of |accuracy - confidence|
            of their bin (Guo et al. 2017, eq. 3).
        log_loss: mean negative log-probability of the true class, in nats.
        bins: the reliability diagram.
    """

    count: int
    accuracy: float
    per_class: tuple[float | None, ...]
    confusion: tuple[tuple[int, ...], ...]
    confidence: float
    error: float
    log_loss: float
    bins: tuple[ReliabilityBin, ...]


def as_floats(images: Images, indices: npt.NDArray[np.int64] | slice) -> Tensor:
    """Return the chosen 8-bit images as (n, H, W, 3) float32 in [0, 1]."""
    chosen: Any = (
        images[indices]
        if not isinstance(images, Tensor) or isinstance(indices, slice)
        else images[torch.as_tensor(indices)]
    )
    tensor = (
        chosen
        if isinstance(chosen, Tensor)
        else torch.from_numpy(np.ascontiguousarray(chosen))
    )
    return tensor.float().div_(255.0)


def predict(
    model: Callable[[Tensor], Tensor], images: Images, *, batch_size: int = 64
) -> Tensor:
    """Return the logits (N, classes) of 8-bit images (N, H, W, 3); `model` takes them
    as floats in [0, 1].
    """
    _check(images)
    with torch.no_grad():
        parts = [
            model(as_floats(images, slice(at, at + batch_size)))
            for at in range(0, len(images), batch_size)
        ]
    return torch.cat(parts).float()


def evaluate(
    model: Callable[[Tensor], Tensor],
    images: Images,
    labels: Sequence[int] | Tensor,
    *,
    batch_size: int = 64,
    bins: int = 15,
) -> Report:
    """Return the figures of a model on images.

    Args:
        model: a `Model`, or any function from images (n, H, W, 3) in [0, 1] to logits
            (n, classes).
        images: (N, H, W, 3), uint8.
        labels: N class indices.
        batch_size: images at once.
        bins: number of equal confidence bins.

    Raises:
        InputError: no images, wrong shape or type, or a number of labels other than N.
    """
    return report(predict(model, images, batch_size=batch_size), labels, bins=bins)


def report(logits: Tensor, labels: Sequence[int] | Tensor, *, bins: int = 15) -> Report:
    """Return the figures of logits (N, classes) against N class indices."""
    truth = _truth(logits, labels)
    classes = logits.shape[1]
    confidence, predicted = logits.softmax(dim=1).max(dim=1)
    right = (predicted == truth).double()
    confusion = torch.bincount(
        truth * classes + predicted, minlength=classes * classes
    ).view(classes, classes)
    diagram = _diagram(confidence.double(), right, bins)
    gap = sum(
        bucket.count * abs(bucket.accuracy - bucket.confidence) for bucket in diagram
    ) / len(truth)
    totals = confusion.sum(dim=1).tolist()
    hits = confusion.diagonal().tolist()
    return Report(
        count=len(truth),
        accuracy=float(right.mean()),
        per_class=tuple(
            hit / total if total else None
            for hit, total in zip(hits, totals, strict=True)
        ),
        confusion=tuple(tuple(row) for row in confusion.tolist()),
        confidence=float(confidence.mean()),
        error=gap,
        log_loss=float(F.cross_entropy(logits, truth)),
        bins=diagram,
    )


def fit_temperature(logits: Tensor, labels: Sequence[int] | Tensor) -> float:
    """Return the temperature T > 0 that minimises the log loss of `logits / T` (Guo et
    al. 2017, section 4.2).

    The log loss is convex in 1/T; its derivative is followed to its zero by bisection
    on log T within [-4, 4].
    """
    truth = _truth(logits, labels)
    values = logits.double()
    own = values.gather(1, truth[:, None])[:, 0].mean()

    def slope(log_temperature: float) -> float:
        """Derivative of the log loss with respect to 1/T: mean of E_p[z] - z_true."""
        chances = (values / math.exp(log_temperature)).softmax(dim=1)
        return float((chances * values).sum(dim=1).mean() - own)

    low = -4.0
    high = 4.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if slope(middle) > 0 else (low, middle)
    return math.exp(0.5 * (low + high))


def _diagram(
    confidence: Tensor, right: Tensor, bins: int
) -> tuple[ReliabilityBin, ...]:
    place = (confidence * bins).ceil().long().clamp(1, bins) - 1
    counts = torch.bincount(place, minlength=bins).tolist()
    hits = torch.bincount(place, weights=right, minlength=bins).tolist()
    sums = torch.bincount(place, weights=confidence, minlength=bins).tolist()
    return tuple(
        ReliabilityBin(
            i / bins,
            (i + 1) / bins,
            int(n),
            hits[i] / n if n else 0.0,
            sums[i] / n if n else 0.0,
        )
        for i, n in enumerate(counts)
    )


def _truth(logits: Tensor, labels: Sequence[int] | Tensor) -> Tensor:
    truth = torch.as_tensor(labels).long()
    if truth.dim() != 1 or len(truth) != len(logits) or not len(truth):
        raise InputError(
            f"labels: expected one class index for each of {len(logits)} "
            f"images, got {tuple(truth.shape)}"
        )
    low = int(truth.min())
    high = int(truth.max())
    if low < 0 or high >= logits.shape[1]:
        raise InputError(
            "labels: expected class indices from 0 to "
            f"{logits.shape[1] - 1}, got {low} to {high}"
        )
    return truth


def _check(images: Images) -> None:
    kind = str(images.dtype).removeprefix("torch.")
    if (
        kind != "uint8"
        or len(images.shape) != 4
        or images.shape[3] != 3
        or 0 in images.shape
    ):
        raise InputError(
            f"images: expected 8-bit images (N, H, W, 3), got {kind} of "
            f"shape {tuple(images.shape)}"
        )
