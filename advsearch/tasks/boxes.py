"""Boxes round what a detector sees, x0, y0, x1, y1 from the top left: how far two
overlap, and how they are read.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

Labels = tuple[int, ...]
Box = tuple[float, float, float, float]
# what is found in a picture, see `advsearch.tasks.detector_outputs`
Detections = Mapping[str, Tensor]

FORMS = ("xyxy", "xywh", "cxcywh", "yxyx")
"""How a box may be given: corners; a corner or the middle with width and height;
corners with y first.
"""

# scores and overlaps below this, or as near to 1, count as this: log-odds of 13.8
SMALLEST = 1e-6
LEAST_OVERLAP = 0.1
"""Least intersection over union of a box that is on the object at all (TIDE's threshold
of the background).
"""

AMONG = 500  # among how many of the best scores boxes are looked for

MOST = 2000
"""Most boxes of a class that are looked at in suppression, the best ones: a network
that has learnt has fewer.
"""


def overlap(boxes: Tensor, box: Tensor) -> Tensor:
    """Return intersection over union of boxes (D, 4) with one box (4,), (D,) in [0, 1];
    differentiable.
    """
    common = _common(boxes, box)
    return common / (_area(boxes) + _area(box) - common).clamp_min(1e-12)


def share_inside(boxes: Tensor, box: Tensor) -> Tensor:
    """Return how much of each of boxes (D, 4) lies in one box (4,), (D,) in [0, 1];
    differentiable.
    """
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
    start = boxes[..., :2]
    size = boxes[..., 2:]
    low = start - size / 2.0 if form == "cxcywh" else start
    return torch.cat([low, low + size], dim=-1)


def left_over(boxes: Tensor, scores: Tensor, iou: float) -> Tensor:
    """Return which of boxes (D, 4) of one class, with scores (D,), are left when of
    those that overlap (by an intersection over union of `iou`) only the best one is
    kept (greedy suppression), (D,) bool; of those beyond the best `MOST`, none is.

    Each round keeps the boxes that no better one overlaps which may still be left, and
    removes those that they overlap.
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
    """What is to be found in a picture, the truth of detection: indices of the right
    classes, and the smallest box round what is seen of the object, x0, y0, x1, y1 in
    pixels, or None. Size: (height, width) of the picture in pixels. And the boxes round
    what is seen of other things with one of these classes.
    """

    labels: Labels
    box: tuple[int, int, int, int] | None
    size: tuple[int, int]
    others: tuple[tuple[int, int, int, int], ...] = ()

    @property
    def shares(self) -> Tensor | None:
        """The box as shares of width and height, (4,)."""
        return None if self.box is None else self.fractions_of(self.box)

    def fractions_of(self, box: tuple[int, int, int, int]) -> Tensor:
        """Return a box in pixels as fractions of width and height, (4,)."""
        height, width = self.size
        return torch.tensor(box) / torch.tensor([width, height, width, height])


def overlap_with(one: Detections, truth: Place) -> Tensor:
    """Return intersection over union with the true box, which there is, (D,)."""
    assert truth.shares is not None
    return overlap(one["boxes"], truth.shares.to(one["boxes"]))


def suppressed(one: Detections, least: float, iou: float) -> Detections:
    """Return what suppression leaves of boxes with a score of every class: the score of
    one that it removes is 0. What has a score under `least` counts for nobody and is
    left alone. The choice has no derivative; what is left has. Boxes that come with
    their labels are left as they are, and so are all where `iou` is 1.
    """
    if "labels" in one or iou == 1.0 or not len(one["boxes"]):
        return one
    scores = one["scores"].detach()
    boxes = one["boxes"].detach()
    rows, classes = (scores >= least).nonzero(as_tuple=True)
    removed = torch.zeros_like(scores, dtype=torch.bool)
    for label in classes.unique().tolist():
        mine = rows[classes == label]
        if len(mine) > 1:
            removed[mine, label] = ~left_over(boxes[mine], scores[mine, label], iou)
    return {**one, "scores": torch.where(removed, 0.0, one["scores"])}


def listed(
    one: Detections, count: int, least: float, iou: float
) -> list[tuple[Box, int, float]]:
    """Return the best boxes, of a class and a place one: shares of width and height,
    class, score.
    """
    boxes = one["boxes"].detach()
    scores = one["scores"].detach()
    best, places = scores.flatten().topk(min(AMONG, scores.numel()))
    each = 1 if "labels" in one else scores.shape[1]
    rows = places // each
    classes = one["labels"][rows] if "labels" in one else places % each
    found: list[tuple[Box, int, float]] = []
    for label in classes[best >= least].unique().tolist():
        mine = ((classes == label) & (best >= least)).nonzero().flatten()
        # the best are first
        for place in mine[left_over(boxes[rows[mine]], best[mine], iou)][
            :count
        ].tolist():
            x0, y0, x1, y1 = boxes[rows[place]].tolist()
            found.append(((x0, y0, x1, y1), label, float(best[place])))
    return sorted(found, key=lambda row: -row[2])[:count]


def log_odds(shares: Tensor) -> Tensor:
    """Return log(p / (1 - p)), with what lies outside [0, 1] taken for its end."""
    inside = shares.clamp(SMALLEST, 1.0 - SMALLEST)
    return inside.log() - torch.log1p(-inside)


def best_of(values: Tensor, among: Tensor | None = None) -> Tensor:
    """Return the largest of values (D,), or of those where `among` is true; 0 where
    there are none.
    """
    chosen = values if among is None else torch.where(among, values, 0.0)
    return torch.cat([chosen, chosen.new_zeros(1)]).amax()


# ---- how they are read
# -----------------------------------------------------------------------------------------------


def nowhere(boxes: Tensor) -> Tensor:
    """Whether boxes (D, 4) of any form are none: four times the same number, or one
    that is not finite, (D,) bool.
    """
    return (boxes == boxes[:, :1]).all(dim=1) | ~boxes.isfinite().all(dim=1)


def counted(one: Detections) -> Tensor:
    """Rows that say something: a box, and a number over 0 beside it, (D,) bool."""
    return ~nowhere(one["boxes"]) & (numbers_of(one) > 0.0).any(dim=1)


def numbers_of(one: Detections) -> Tensor:
    """The numbers of each box that are scores, or may be, without derivatives, (D,
    K).
    """
    beside = (one["either"] if "either" in one else one["scores"]).detach()
    return beside if beside.ndim == 2 else beside[:, None]


def as_option(options: str) -> str:
    """Return what says options of detection, as messages name settings."""
    return f"`task='detection={{{options}}}'`"


UNITS = ("fractions", "pixels")

KNOWN = "boxes_are_corners_in_pixels"
"""The attribute of a network that says so of its boxes, which are then not guessed from
what they look like.
"""

# the best boxes of a picture that are looked at: what has no score says nothing
LOOKED_AT = 100

FRACTION = 1.5
PIXEL = 4.0
"""The largest number of a box, in the median: up to the first these are fractions of
the picture, from the second on pixels.
"""

# how far outside the picture the middle of a box may lie, in sides of the picture
BEYOND = 0.25

ODD = 0.5
USUAL = 0.8
"""Share of boxes that are as boxes are: a reading with less is doubted, one with more
is named in its place.
"""

# how much more a box has to overlap the object in another reading for that to be named
NEARER = 0.1


@dataclass(frozen=True)
class Reading:
    """How boxes are read: in one of `FORMS`, one of `UNITS`, and for a model's input of
    a size (height, width) in pixels.
    """

    form: str
    unit: str
    size: tuple[int, int]

    def fractions(self, boxes: Tensor) -> Tensor:
        """Return boxes (D, 4) as corners in shares of width and height;
        differentiable.
        """
        height, width = self.size if self.unit == "pixels" else (1, 1)
        return corners(boxes, self.form) / boxes.new_tensor([width, height] * 2)

    def faults(self, boxes: Tensor) -> dict[str, Tensor]:
        """Return what is odd about which of boxes (D, 4) in this reading, (D,) bool
        each.
        """
        read = self.fractions(boxes)
        (height, width) = self.size
        middle = (read[:, :2] + read[:, 2:]) / 2.0
        sides = read[:, 2:] - read[:, :2]
        return {
            "lie far outside the picture": ~(
                (middle >= -BEYOND) & (middle <= 1.0 + BEYOND)
            ).all(dim=1),
            "have a right edge left of the left one, or a bottom above the top": ~(
                sides > 0.0
            ).all(dim=1),
            "are smaller than a pixel": ~(
                sides.abs() * sides.new_tensor([width, height]) > 1.0
            ).any(dim=1),
        }

    def usual(self, boxes: Tensor) -> float:
        """Return the share of boxes (D, 4), D at least 1, about which nothing is
        odd.
        """
        return float(
            (~torch.stack([*self.faults(boxes).values()])).all(dim=0).float().mean()
        )

    def fault(self, boxes: Tensor) -> str:
        """Return what is odd about most boxes (D, 4) in this reading; empty if nothing
        is.
        """
        if not len(boxes) or self.usual(boxes) >= ODD:
            return ""
        shares = {
            fault: 1.0 - float((~odd).float().mean())
            for fault, odd in self.faults(boxes).items()
        }
        worst = max(shares, key=shares.__getitem__)
        return f"{100.0 * shares[worst]:.0f} % of them {worst}"

    def instead(self, boxes: Tensor) -> str:
        """Return which other readings would be usual ones: those that differ least in
        what is said.
        """
        others = [
            Reading(form, unit, self.size) for unit in UNITS for form in FORMS[:3]
        ]
        fitting = [self.change_to(one) for one in others if one.usual(boxes) >= USUAL]
        nearest = [
            one
            for one in fitting
            if one.count(":") == min(two.count(":") for two in fitting)
        ]
        return f"; {' or '.join(nearest)} would mend that" if nearest else ""

    def change_to(self, other: Reading) -> str:
        """Return what says another reading in place of this one, such as ``boxes:
        xywh``.
        """
        said = [("boxes", self.form, other.form), ("unit", self.unit, other.unit)]
        return as_option(
            ", ".join(f"{name}: {new}" for name, old, new in said if old != new)
        )

    def better(self, boxes: Tensor, true: Tensor, least: float) -> str:
        """Return what says the reading in which one of boxes (D, 4), those with the
        right name, overlaps the true box (4,), in shares of width and height, `NEARER`
        than in this one, and at `least` so.
        """
        if not len(boxes):
            return ""
        every = [
            self,
            *(Reading(form, unit, self.size) for unit in UNITS for form in FORMS),
        ]
        overlaps = {
            one: float(overlap(one.fractions(boxes), true).max()) for one in every
        }
        best = max(overlaps, key=overlaps.__getitem__)
        return (
            self.change_to(best)
            if overlaps[best] >= max(least, overlaps[self] + NEARER)
            else ""
        )


def strongest_boxes(found: Sequence[Detections]) -> Tensor:
    """Return the boxes with the best scores of each picture, as they came, without what
    says nothing, (D, 4).
    """
    kept = []
    for one in found:
        rows = counted(one).nonzero().flatten()
        numbers = numbers_of(one)
        best = numbers.amax(dim=1) if numbers.shape[1] else numbers.sum(dim=1)
        kept.append(
            one["boxes"].detach()[rows[best[rows].argsort(descending=True)[:LOOKED_AT]]]
        )
    return torch.cat(kept) if kept else torch.zeros(0, 4)


def unit_in(boxes: Tensor) -> str:
    """Return which of `UNITS` boxes (D, 4) of any form are in; "" if they leave it
    open.
    """
    if not len(boxes):
        return ""
    largest = float(boxes.abs().amax(dim=1).median())
    return "fractions" if largest <= FRACTION else "pixels" if largest >= PIXEL else ""
