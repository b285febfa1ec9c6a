"""Boxes round what a detector sees, x0, y0, x1, y1 from the top left: how far two overlap, and how they are read.

Outputs in one tensor, as YOLO's networks give them, are (A, B) for each picture: "channels first" (places are columns,
v8 to v12 and YOLO11) or "channels last" (v5 to v7, YOLOX, RT-DETR). The numbers of a place are a box (middle, width,
height), in older ones objectness, with which scores are multiplied, a score of each class, and mask coefficients.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from advsearch.models.labels import sets_of

Labels = tuple[int, ...]
Box = tuple[float, float, float, float]
Detections = Mapping[str, Tensor]
"""What is found in a picture, see `advsearch.tasks.detector_outputs`."""

FORMS = ("xyxy", "xywh", "cxcywh", "yxyx")
"""How a box may be given: corners; a corner or the middle with width and height; corners with y first."""

SMALLEST = 1e-6
"""Scores and overlaps below this, or as near to 1, count as this: log-odds of 13.8."""

AMONG = 500
"""Among how many of the best scores boxes are looked for."""

MOST = 2000
"""Most boxes of a class that are looked at in suppression, the best ones: a network that has learnt has fewer."""


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
    """Return which of boxes (D, 4) of one class, with scores (D,), are left when of those that overlap (by an
    intersection over union of `iou`) only the best one is kept (greedy suppression): their places, the best first,
    `count` at most."""
    left = scores.argsort(descending=True)
    kept: list[int] = []
    while len(left) and len(kept) < count:
        first, left = left[0], left[1:]
        kept.append(int(first))
        left = left[overlap(boxes[left], boxes[first]) < iou]
    return kept


def left_over(boxes: Tensor, scores: Tensor, iou: float) -> Tensor:
    """Return which boxes are left as by `strongest`, (D,) bool; of those beyond the best `MOST`, none is.

    Each round keeps the boxes that no better one overlaps which may still be left, and removes those that they overlap.
    """
    order = scores.argsort(descending=True)[:MOST]
    best = boxes[order]
    parts = [overlap(best, some[:, None]) >= iou for some in best.split(256)]
    over = torch.cat(parts).tril(-1)  # whether box j, which is better, overlaps box i
    undecided = torch.ones(len(best), dtype=torch.bool, device=boxes.device)
    kept = ~undecided
    while bool(undecided.any()):
        kept = kept | (undecided & ~(over & undecided).any(dim=1))
        undecided = undecided & ~kept & ~(over & kept).any(dim=1)
    left = torch.zeros(len(boxes), dtype=torch.bool, device=boxes.device)
    left[order] = kept
    return left


@dataclass(frozen=True)
class Place:
    """What is to be found in a picture, the truth of detection: indices of the right classes, and the smallest box
    round what is seen of the object, x0, y0, x1, y1 in pixels, or None. Size: (height, width) of the picture in
    pixels."""

    labels: Labels
    box: tuple[int, int, int, int] | None
    size: tuple[int, int]

    @property
    def shares(self) -> Tensor | None:
        """The box as shares of width and height, (4,)."""
        if self.box is None:
            return None
        height, width = self.size
        return torch.tensor(self.box) / torch.tensor([width, height, width, height])


def overlap_with(one: Detections, truth: Place) -> Tensor:
    """Return intersection over union with the true box, which there is, (D,)."""
    assert truth.shares is not None
    return overlap(one["boxes"], truth.shares.to(one["boxes"]))


def suppressed(one: Detections, least: float, iou: float) -> Detections:
    """Return what suppression leaves of boxes with a score of every class: the score of one that it removes is 0.

    What has a score under `least` counts for nobody and is left alone. The choice has no derivative; what is left has.
    Boxes that come with their labels are left as they are, and so are all where `iou` is 1.
    """
    if "labels" in one or iou == 1.0 or not len(one["boxes"]):
        return one
    scores, boxes = one["scores"].detach(), one["boxes"].detach()
    rows, classes = (scores >= least).nonzero(as_tuple=True)
    removed = torch.zeros_like(scores, dtype=torch.bool)
    for label in classes.unique().tolist():
        mine = rows[classes == label]
        if len(mine) > 1:
            removed[mine, label] = ~left_over(boxes[mine], scores[mine, label], iou)
    return {**one, "scores": torch.where(removed, 0.0, one["scores"])}


def listed(one: Detections, count: int, least: float, iou: float) -> list[tuple[Box, int, float]]:
    """Return the best boxes, of a class and a place one: shares of width and height, class, score."""
    boxes, scores = one["boxes"].detach(), one["scores"].detach()
    best, places = scores.flatten().topk(min(AMONG, scores.numel()))
    each = 1 if "labels" in one else scores.shape[1]
    rows = places // each
    classes = one["labels"][rows] if "labels" in one else places % each
    found: list[tuple[Box, int, float]] = []
    for label in classes[best >= least].unique().tolist():
        mine = ((classes == label) & (best >= least)).nonzero().flatten()
        for place in mine[strongest(boxes[rows[mine]], best[mine], count, iou)].tolist():
            x0, y0, x1, y1 = boxes[rows[place]].tolist()
            found.append(((x0, y0, x1, y1), label, float(best[place])))
    return sorted(found, key=lambda row: -row[2])[:count]


def log_odds(shares: Tensor) -> Tensor:
    """Return log(p / (1 - p)), with what lies outside [0, 1] taken for its end."""
    inside = shares.clamp(SMALLEST, 1.0 - SMALLEST)
    return inside.log() - torch.log1p(-inside)


def best_of(values: Tensor, among: Tensor | None = None) -> Tensor:
    """Return the largest of values (D,), or of those where `among` is true; 0 where there are none."""
    chosen = values if among is None else torch.where(among, values, 0.0)
    return torch.cat([chosen, chosen.new_zeros(1)]).amax()


# ---- how they are read -----------------------------------------------------------------------------------------------


def nowhere(boxes: Tensor) -> Tensor:
    """Whether boxes (D, 4) of any form are none: four times the same number, or one that is not finite, (D,) bool."""
    return (boxes == boxes[:, :1]).all(dim=1) | ~boxes.isfinite().all(dim=1)


def counted(one: Detections) -> Tensor:
    """Rows that say something: a box, and a number over 0 beside it, (D,) bool."""
    return ~nowhere(one["boxes"]) & (numbers_of(one) > 0.0).any(dim=1)


def numbers_of(one: Detections) -> Tensor:
    """The numbers of each box that are scores, or may be, without derivatives, (D, K)."""
    beside = (one["either"] if "either" in one else one["scores"]).detach()
    return beside if beside.ndim == 2 else beside[:, None]


def as_option(options: str) -> str:
    """Return what says options of detection, as messages name settings."""
    return f"`task='detection={{{options}}}'`"


UNITS = ("fractions", "pixels")

KNOWN = "boxes_are_corners_in_pixels"
"""The attribute of a network that says so of its boxes, which are then not guessed from what they look like."""

LOOKED_AT = 100
"""The best boxes of a picture that are looked at: what has no score says nothing."""

FRACTION, PIXEL = 1.5, 4.0
"""The largest number of a box, in the median: up to the first these are fractions of the picture, from the second on
pixels."""

BEYOND = 0.25
"""How far outside the picture the middle of a box may lie, in sides of the picture."""

ODD, USUAL = 0.5, 0.8
"""Share of boxes that are as boxes are: a reading with less is doubted, one with more is named in its place."""

NEARER = 0.1
"""How much more a box has to overlap the object in another reading for that to be named."""

FAULTS = (
    "lie far outside the picture",
    "have a right edge left of the left one, or a bottom above the top",
    "are smaller than a pixel",
)


@dataclass(frozen=True)
class Reading:
    """How boxes are read: in one of `FORMS`, one of `UNITS`, and for a model's input of a size (height, width) in
    pixels."""

    form: str
    unit: str
    size: tuple[int, int]

    def fractions(self, boxes: Tensor) -> Tensor:
        """Return boxes (D, 4) as corners in shares of width and height; differentiable."""
        height, width = self.size if self.unit == "pixels" else (1, 1)
        return corners(boxes, self.form) / boxes.new_tensor([width, height] * 2)

    def usual(self, boxes: Tensor) -> float:
        """Return the share of boxes (D, 4), D at least 1, that are as boxes are: the right way round, in the picture,
        and larger than a pixel."""
        inside, ordered, large = self._is_usual(boxes)
        return float((inside & ordered & large).float().mean())

    def _is_usual(self, boxes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        read, (height, width) = self.fractions(boxes), self.size
        middle, sides = (read[:, :2] + read[:, 2:]) / 2.0, read[:, 2:] - read[:, :2]
        inside = ((middle >= -BEYOND) & (middle <= 1.0 + BEYOND)).all(dim=1)
        return inside, (sides > 0.0).all(dim=1), (sides.abs() * sides.new_tensor([width, height]) > 1.0).any(dim=1)

    def fault(self, boxes: Tensor) -> str:
        """Return what is odd about boxes (D, 4) in this reading; empty if nothing is."""
        if not len(boxes) or self.usual(boxes) >= ODD:
            return ""
        shares = [1.0 - float(one.float().mean()) for one in self._is_usual(boxes)]
        share, fault = max(zip(shares, FAULTS, strict=True), key=lambda one: one[0])
        return f"{100.0 * share:.0f} % of them {fault}"

    def instead(self, boxes: Tensor) -> str:
        """Return which other readings would be usual ones: those that differ least in what is said."""
        others = [Reading(form, unit, self.size) for unit in UNITS for form in FORMS[:3]]
        fitting = [self.change_to(one) for one in others if one.usual(boxes) >= USUAL]
        nearest = [one for one in fitting if one.count(":") == min(two.count(":") for two in fitting)]
        return f"; {' or '.join(nearest)} would mend that" if nearest else ""

    def change_to(self, other: Reading) -> str:
        """Return what says another reading in place of this one, such as ``boxes: xywh``."""
        said = [("boxes", self.form, other.form), ("unit", self.unit, other.unit)]
        return as_option(", ".join(f"{name}: {new}" for name, old, new in said if old != new))

    def better(self, boxes: Tensor, true: Tensor, least: float) -> str:
        """Return what says the reading in which one of boxes (D, 4), those with the right name, overlaps the true box
        (4,), in shares of width and height, `NEARER` than in this one, and at `least` so."""
        every = [self, *(Reading(form, unit, self.size) for unit in UNITS for form in FORMS)]
        found = {one: float(overlap(one.fractions(boxes), true).max()) for one in every} if len(boxes) else {}
        best = max(found, key=lambda one: found[one], default=self)
        return self.change_to(best) if found and found[best] >= max(least, found[self] + NEARER) else ""


def strongest_boxes(found: Sequence[Detections]) -> Tensor:
    """Return the boxes with the best scores of each picture, as they came, without what says nothing, (D, 4)."""
    kept = []
    for one in found:
        rows, numbers = counted(one).nonzero().flatten(), numbers_of(one)
        best = numbers.amax(dim=1) if numbers.shape[1] else numbers.sum(dim=1)
        kept.append(one["boxes"].detach()[rows[best[rows].argsort(descending=True)[:LOOKED_AT]]])
    return torch.cat(kept) if kept else torch.zeros(0, 4)


def unit_in(boxes: Tensor) -> str:
    """Return which of `UNITS` boxes (D, 4) of any form are in; "" if they leave it open."""
    if not len(boxes):
        return ""
    largest = float(boxes.abs().amax(dim=1).median())
    return "fractions" if largest <= FRACTION else "pixels" if largest >= PIXEL else ""


# ---- in one tensor, as YOLO's networks give them ---------------------------------------------------------------------

HEADS = {"boxes scores": 4, "boxes objectness scores": 5}
"""What the numbers of a place are, and how many stand before the scores."""

LAYOUTS = ("channels first", "channels last")

TOLERANCE = 1e-3
"""How far outside [0, 1] a score may lie."""

_ORDER = re.compile(rf"({'|'.join(HEADS)})(?: ({'|'.join(LAYOUTS)}))?")


def names_head(order: str) -> bool:
    """Whether an order is one of `HEADS`, with one of `LAYOUTS` after it or without."""
    return _ORDER.fullmatch(order) is not None


def head_in(returned: Tensor, beside: Collection[int], classes: int, order: str = "") -> tuple[str, ...]:
    """Return the orders that an output (A, B) for one picture may have, such as "boxes scores channels first"; what is
    said of it already narrows them. Sides tell (`beside`: the channels of maps that came with it), and scores, which
    lie in [0, 1]. Raises ValueError where it has none of them; the text says what it seems to be."""
    found, outside = list[str](), ""
    for layout, length in zip(LAYOUTS, returned.shape, strict=True):
        for head, start in HEADS.items():
            name, masks = f"{head} {layout}", length - start - classes
            if order not in ("", head, name) or (masks and masks not in beside):
                continue
            scores = split(returned, classes, name, multiplied=False)[1].detach()
            far = (scores < -TOLERANCE) | (scores > 1.0 + TOLERANCE)
            if not bool((far & scores.isfinite()).any()):
                found.append(name)
            elif name == _WITH_ANGLE and not bool(far[:, :-1].any()):
                outside = f"an angle after the scores, as OBB heads have it, {_UNREAD}"
            else:
                outside = outside or (
                    f"scores from {float(scores.min()):.3g} to {float(scores.max()):.3g} if it is read as '{name}'; "
                    "expected probabilities in [0, 1]: apply a sigmoid to them"
                )
    if found == [_WITH_ANGLE] and not order:
        raise ValueError(
            f"its {5 + classes} channels may be those of an OBB head (with an angle), {_UNREAD}; if it has "
            f"objectness, say `task='detection={{order: {_WITH_ANGLE}}}'`"
        )
    if outside and not found:
        raise ValueError(f"it has {outside}")
    if not found:
        raise ValueError(_unfitting(returned, classes))
    return tuple(found)


_WITH_ANGLE = f"boxes objectness scores {LAYOUTS[0]}"
"""What a head of oriented boxes looks like: an angle after the scores makes as many numbers as objectness before."""

_UNREAD = "which are not read"


def _unfitting(returned: Tensor, classes: int) -> str:
    """What an output is that has not as many numbers as the classes ask for."""
    length, last = min(returned.shape), returned.shape[0] >= returned.shape[1]
    over = {length - 4 - classes, length - 6 if last else 0}
    of = f"{classes} class{'es' * (classes > 1)}"
    said = f"expected 4 + {classes} or 5 + {classes} numbers of a box for {of}, got {length}"
    named = [name for start in HEADS.values() for name in sets_of(length - start)]
    if named:
        return f"{said}; {' or '.join(f'`labels={name}`' for name in named)} would fit"
    if 1 in over:
        return f"{said}, as OBB heads (oriented boxes, with an angle) have it, {_UNREAD}"
    if 32 in over:
        return f"{said}, as with mask coefficients, and no prototypes (N, 32, h, w) came beside them"
    if any(one > 0 and one % 3 == 0 for one in over):
        return f"{said}, as pose heads (with keypoints) have it, {_UNREAD}; or give the `labels` of the model's classes"
    return f"{said}; give the `labels` of the model's classes"


def split(returned: Tensor, classes: int, order: str, *, multiplied: bool = True) -> tuple[Tensor, Tensor]:
    """Return the boxes (D, 4) and scores (D, classes) of an output (A, B) for one picture; differentiable. Its order
    has a layout. Unless objectness is `multiplied` with the scores, it is the first of (D, 1 + classes)."""
    places = returned.T if order.endswith(LAYOUTS[0]) else returned
    scores = places[:, 4 : 4 + classes]
    if order.startswith("boxes objectness"):
        objectness, scores = places[:, 4:5], places[:, 5 : 5 + classes]
        scores = objectness * scores if multiplied else torch.cat([objectness, scores], dim=1)
    return places[:, :4], scores
