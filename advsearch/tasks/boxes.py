"""Functions of boxes: overlap, suppression and formats.

A box is x0, y0, x1, y1, from the top left, unless a format is stated.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

Labels = tuple[int, ...]
Box = tuple[float, float, float, float]
# The detections of one image, see `advsearch.tasks.detector_outputs`.
Detections = Mapping[str, Tensor]

FORMS = ("xyxy", "xywh", "cxcywh", "yxyx")
"""Formats of a box: two corners; the first corner, or the center, with width and
height; two corners with y first.
"""

# Probabilities are clamped to [MIN_PROBABILITY, 1 - MIN_PROBABILITY], so that log-odds
# are between -13.8 and 13.8.
MIN_PROBABILITY = 1e-6
MIN_OVERLAP = 0.1
"""Minimum intersection over union of a box that is on the object, however loosely (TIDE's
threshold of the background).
"""

MAX_CANDIDATES = 500  # number of best scores that are considered for the list of boxes

MAX_SUPPRESSED = 2000
"""Maximum number of boxes of a class that take part in suppression, those with the best
scores. A trained network has fewer.
"""


def compute_iou(boxes: Tensor, box: Tensor) -> Tensor:
    """Compute the intersection over union of boxes with one box; differentiable.

    Args:
        boxes: (D, 4), corners x0, y0, x1, y1.
        box: (4,), or any shape (..., 4) that broadcasts.

    Returns:
        (D,) in [0, 1].
    """
    intersection = _intersection_area(boxes, box)
    union = _area(boxes) + _area(box) - intersection
    return intersection / union.clamp_min(1e-12)  # 0 for boxes without an area


def compute_fraction_inside(boxes: Tensor, box: Tensor) -> Tensor:
    """Compute the fraction of each box (D, 4) that lies in one box (4,), (D,) in
    [0, 1]; differentiable.
    """
    return _intersection_area(boxes, box) / _area(boxes).clamp_min(1e-12)


def _intersection_area(boxes: Tensor, box: Tensor) -> Tensor:
    """Return the area that boxes (..., 4) have in common with others, (...)."""
    lower = torch.maximum(boxes[..., :2], box[..., :2])
    upper = torch.minimum(boxes[..., 2:], box[..., 2:])
    return (upper - lower).clamp_min(0.0).prod(dim=-1)


def _area(boxes: Tensor) -> Tensor:
    return (boxes[..., 2:] - boxes[..., :2]).clamp_min(0.0).prod(dim=-1)


def to_corners(boxes: Tensor, form: str) -> Tensor:
    """Convert boxes (..., 4) of one of `FORMS` to x0, y0, x1, y1; differentiable."""
    if form == "yxyx":
        return boxes[..., [1, 0, 3, 2]]
    if form == "xyxy":
        return boxes
    size = boxes[..., 2:]
    top_left = boxes[..., :2]
    if form == "cxcywh":  # then these two are the center
        top_left = top_left - size / 2.0
    return torch.cat([top_left, top_left + size], dim=-1)


def suppress_class(boxes: Tensor, scores: Tensor, iou: float) -> Tensor:
    """Apply greedy non-maximum suppression to the boxes of one class.

    The greedy method takes the best box, removes the boxes that it overlaps, and
    repeats this with the remaining ones. Here each round takes all boxes at once that no
    better remaining box overlaps. The greedy method would take these boxes, too: nothing
    that could remove them is left. So the result is the same, in fewer steps.

    Args:
        boxes: (D, 4).
        scores: (D,).
        iou: intersection over union from which a better box suppresses another.

    Returns:
        Which boxes survive, (D,) bool. Only the best `MAX_SUPPRESSED` boxes can.
    """
    order = scores.argsort(descending=True)[:MAX_SUPPRESSED]
    sorted_boxes = boxes[order]
    # (256, D) each: 256 boxes against all, to bound the memory of intermediate results
    overlap_chunks = [
        compute_iou(sorted_boxes, chunk[:, None]) >= iou
        for chunk in sorted_boxes.split(256)
    ]
    # Row i, column j: whether box j, which is better (j < i), overlaps box i.
    is_overlapped = torch.cat(overlap_chunks).tril(-1)
    # from the order of scores back to the order of the arguments
    result = torch.zeros(len(boxes), dtype=torch.bool, device=boxes.device)
    result[order] = _find_survivors(is_overlapped)
    return result


def _find_survivors(is_overlapped: Tensor) -> Tensor:
    """Return which of D boxes survive greedy suppression, (D,) bool, the best first.

    Args:
        is_overlapped: (D, D) bool, whether the box of a row is overlapped by that of a
            column, which is better.
    """
    n_boxes = len(is_overlapped)
    undecided = torch.ones(n_boxes, dtype=torch.bool, device=is_overlapped.device)
    survives = torch.zeros_like(undecided)
    while bool(undecided.any()):
        has_better_rival = (is_overlapped & undecided).any(dim=1)
        survives = survives | (undecided & ~has_better_rival)
        is_suppressed = (is_overlapped & survives).any(dim=1)
        undecided = undecided & ~survives & ~is_suppressed
    return survives


@dataclass(frozen=True)
class DetectionTruth:
    """The truth of detection: the object that a detector has to find in an image.

    Attributes:
        labels: indices of the right classes.
        box: the smallest box around the visible part of the object, x0, y0, x1, y1 in
            pixels; None if it is out of view.
        image_size: (height, width) of the image in pixels.
        other_boxes: boxes around the visible parts of other things of these classes.
    """

    labels: Labels
    box: tuple[int, int, int, int] | None
    image_size: tuple[int, int]
    other_boxes: tuple[tuple[int, int, int, int], ...] = ()

    @property
    def box_fractions(self) -> Tensor | None:
        """The box as fractions of the image's width and height, (4,)."""
        return None if self.box is None else self.to_fractions(self.box)

    def to_fractions(self, box: tuple[int, int, int, int]) -> Tensor:
        """Convert a box in pixels to fractions of width and height, (4,)."""
        height, width = self.image_size
        return torch.tensor(box) / torch.tensor([width, height, width, height])


def compute_iou_with_truth(detections: Detections, truth: DetectionTruth) -> Tensor:
    """Compute the intersection over union with the true box, which must exist, (D,)."""
    assert truth.box_fractions is not None
    boxes = detections["boxes"]
    return compute_iou(boxes, truth.box_fractions.to(boxes))


def suppress_overlapping_boxes(
    detections: Detections, min_score: float, iou: float
) -> Detections:
    """Set the scores of suppressed boxes to 0, class by class.

    The choice of boxes is not differentiable, but the scores that remain are. Boxes
    with labels are returned unchanged: networks return them after suppression.

    Args:
        detections: detections of one image, with a score of every class.
        min_score: minimum score of a box that takes part.
        iou: intersection over union from which boxes are duplicates; 1 disables
            suppression.
    """
    is_disabled = iou == 1.0
    if "labels" in detections or is_disabled or not len(detections["boxes"]):
        return detections
    scores = detections["scores"].detach()
    boxes = detections["boxes"].detach()
    rows, classes = (scores >= min_score).nonzero(as_tuple=True)
    is_suppressed = torch.zeros_like(scores, dtype=torch.bool)
    for label in classes.unique().tolist():
        class_rows = rows[classes == label]
        if len(class_rows) > 1:
            survives = suppress_class(boxes[class_rows], scores[class_rows, label], iou)
            is_suppressed[class_rows, label] = ~survives
    remaining_scores = torch.where(is_suppressed, 0.0, detections["scores"])
    return {**detections, "scores": remaining_scores}


def list_boxes(
    detections: Detections, count: int, min_score: float, iou: float
) -> list[tuple[Box, int, float]]:
    """List the best boxes of an image after suppression, by falling score.

    Args:
        detections: detections of one image, boxes in fractions of width and height.
        count: maximum number of boxes.
        min_score: minimum score.
        iou: intersection over union from which boxes of a class are duplicates.

    Returns:
        Tuples of box, class and score.
    """
    rows, classes, scores = _top_scores(detections)
    boxes = detections["boxes"].detach()[rows]
    results: list[tuple[Box, int, float]] = []
    for label in classes[scores >= min_score].unique().tolist():
        is_candidate = (classes == label) & (scores >= min_score)
        candidates = is_candidate.nonzero().flatten()
        survives = suppress_class(boxes[candidates], scores[candidates], iou)
        # The scores are sorted, so the first are the best.
        for index in candidates[survives][:count].tolist():
            x0, y0, x1, y1 = boxes[index].tolist()
            results.append(((x0, y0, x1, y1), label, float(scores[index])))
    return sorted(results, key=lambda result: -result[2])[:count]


def _top_scores(detections: Detections) -> tuple[Tensor, Tensor, Tensor]:
    """Return the best scores of an image in descending order, with box and class.

    A box with a score for every class may occur several times.

    Returns:
        Indices of boxes, indices of classes, and scores, (K,) each; K is at most
        `MAX_CANDIDATES`.
    """
    scores = detections["scores"].detach()
    top_scores, flat_index = scores.flatten().topk(min(MAX_CANDIDATES, scores.numel()))
    if "labels" in detections:
        return flat_index, detections["labels"][flat_index], top_scores
    n_classes = scores.shape[1]
    return flat_index // n_classes, flat_index % n_classes, top_scores


def compute_log_odds(probabilities: Tensor) -> Tensor:
    """Compute log(p / (1 - p)), with p clamped as for `MIN_PROBABILITY`."""
    clamped = probabilities.clamp(MIN_PROBABILITY, 1.0 - MIN_PROBABILITY)
    return clamped.log() - torch.log1p(-clamped)


def max_or_zero(values: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the largest of values (D,), or of those where `mask` (D,) is true; 0 if
    there are none.
    """
    candidates = values if mask is None else torch.where(mask, values, 0.0)
    return torch.cat([candidates, candidates.new_zeros(1)]).amax()


# ---- formats ----


def are_invalid(boxes: Tensor) -> Tensor:
    """Return whether boxes (D, 4) of any format are invalid, (D,) bool.

    A box is invalid if its four numbers are equal, or one is not finite.
    """
    return (boxes == boxes[:, :1]).all(dim=1) | ~boxes.isfinite().all(dim=1)


def are_counted_boxes(detections: Detections) -> Tensor:
    """Return which rows count as boxes, (D,) bool.

    A row counts if it has a valid box and any number over 0 that is or may be a score.
    """
    has_number = (get_possible_scores(detections) > 0.0).any(dim=1)
    return ~are_invalid(detections["boxes"]) & has_number


def get_possible_scores(detections: Detections) -> Tensor:
    """Return the numbers of each box that are or may be scores, detached, (D, K).

    These are K = classes scores; for boxes with labels K = 1 score; or if it is unknown
    which of two numbers ("score_or_label") is the score, both of them, K = 2.
    """
    if "score_or_label" in detections:
        values = detections["score_or_label"].detach()
    else:
        values = detections["scores"].detach()
    return values if values.ndim == 2 else values[:, None]


def format_detection_option(options: str) -> str:
    """Return options of detection as messages name settings."""
    return f"`task='detection={{{options}}}'`"


UNITS = ("fractions", "pixels")

DECLARED_FORMAT_ATTRIBUTE = "boxes_are_corners_in_pixels"
"""Attribute by which a network declares the format of its boxes. Then the format is not
inferred.
"""

# number of best boxes of an image from which the format is inferred
MAX_FORMAT_BOXES = 100

MAX_FRACTION = 1.5
MIN_PIXELS = 4.0
"""Limits of the median of the boxes' largest coordinates: up to `MAX_FRACTION` they are
taken as fractions of the image, from `MIN_PIXELS` on as pixels.
"""

# largest distance of a box's center from the image, as a fraction of the image's width or
# height
MAX_CENTER_OVERSHOOT = 0.25

DOUBTFUL_FRACTION = 0.5
PLAUSIBLE_FRACTION = 0.8
"""Fractions of plausible boxes: a format with less than the first is doubtful, and one
with at least the second is suggested instead.
"""

# increase of the best overlap with the object from which another format is suggested
MIN_IOU_GAIN = 0.1


@dataclass(frozen=True)
class BoxFormat:
    """The format of a box: the meaning of its four numbers.

    Attributes:
        box_layout: one of `FORMS`.
        unit: one of `UNITS`.
        input_size: (height, width) of the model's input, in pixels.
    """

    box_layout: str
    unit: str
    input_size: tuple[int, int]

    def to_fractions(self, boxes: Tensor) -> Tensor:
        """Convert boxes (D, 4) to corners in fractions of width and height;
        differentiable.
        """
        height, width = self.input_size if self.unit == "pixels" else (1, 1)
        return to_corners(boxes, self.box_layout) / boxes.new_tensor(
            [width, height] * 2
        )

    def find_faults(self, boxes: Tensor) -> dict[str, Tensor]:
        """Find which of boxes (D, 4) are implausible in this format.

        Returns:
            For each fault, described by a verb phrase, whether each box has it, (D,) bool.
        """
        fractions = self.to_fractions(boxes)
        height, width = self.input_size
        center = (fractions[:, :2] + fractions[:, 2:]) / 2.0
        box_size = fractions[:, 2:] - fractions[:, :2]
        size_in_pixels = box_size.abs() * box_size.new_tensor([width, height])
        # These are false for NaN, and negated below: a box of NaN has every fault.
        is_near_image = (center >= -MAX_CENTER_OVERSHOOT) & (
            center <= 1.0 + MAX_CENTER_OVERSHOOT
        )
        has_positive_size = (box_size > 0.0).all(dim=1)
        # A thin object may be narrower than a pixel in one direction.
        has_a_pixel = (size_in_pixels > 1.0).any(dim=1)
        return {
            "lie far outside the picture": ~is_near_image.all(dim=1),
            "have a right edge left of the left one, or a bottom above the top": (
                ~has_positive_size
            ),
            "are smaller than a pixel": ~has_a_pixel,
        }

    def compute_plausible_fraction(self, boxes: Tensor) -> float:
        """Compute the fraction of boxes (D, 4), D at least 1, that are plausible."""
        has_fault = torch.stack([*self.find_faults(boxes).values()])
        return float((~has_fault).all(dim=0).float().mean())

    def describe_fault(self, boxes: Tensor) -> str:
        """Describe the most frequent fault of boxes (D, 4), such as "90 % of them ...".

        The text is empty if most boxes are plausible, or there are none.
        """
        if (
            not len(boxes)
            or self.compute_plausible_fraction(boxes) >= DOUBTFUL_FRACTION
        ):
            return ""
        fraction_by_fault = {}
        # by phrase, such as "are smaller than a pixel"
        for fault, is_faulty in self.find_faults(boxes).items():
            fraction_without = float((~is_faulty).float().mean())
            fraction_by_fault[fault] = 1.0 - fraction_without
        worst = max(fraction_by_fault, key=fraction_by_fault.__getitem__)
        return f"{100.0 * fraction_by_fault[worst]:.0f} % of them {worst}"

    def suggest_plausible_formats(self, boxes: Tensor) -> str:
        """Suggest options that make implausible boxes (D, 4) plausible.

        The text is the end of a message, and empty if no format helps. If several
        formats help, those that differ from this one in the fewest options are
        suggested.
        """
        plausible = [
            alternative
            for alternative in self._list_formats()
            # With swapped axes, a plausible box is still plausible. So "yxyx" can't be
            # distinguished from "xyxy", and is not suggested.
            if alternative.box_layout != "yxyx"
            and alternative.compute_plausible_fraction(boxes) >= PLAUSIBLE_FRACTION
        ]
        if not plausible:
            return ""
        min_changes = min(map(self._count_different_options, plausible))
        suggestions = [
            self.format_change_to(alternative)
            for alternative in plausible
            if self._count_different_options(alternative) == min_changes
        ]
        return f"; {' or '.join(suggestions)} would mend that"

    def _list_formats(self) -> list[BoxFormat]:
        """Return all formats of boxes in an image of this size."""
        return [
            BoxFormat(form, unit, self.input_size) for unit in UNITS for form in FORMS
        ]

    def _count_different_options(self, other: BoxFormat) -> int:
        """Count the options in which another format differs from this one."""
        return (other.box_layout != self.box_layout) + (other.unit != self.unit)

    def format_change_to(self, other: BoxFormat) -> str:
        """Return the options that select another format, such as ``boxes: xywh``."""
        options = []
        if other.box_layout != self.box_layout:
            options.append(f"boxes: {other.box_layout}")
        if other.unit != self.unit:
            options.append(f"unit: {other.unit}")
        return format_detection_option(", ".join(options))

    def suggest_better_format(
        self, boxes: Tensor, true_box: Tensor, min_iou: float
    ) -> str:
        """Suggest a format in which one of the boxes fits the true box much better.

        In that format the best intersection over union has to reach `min_iou`, and has
        to exceed the best one in this format by `MIN_IOU_GAIN`. The text is empty if
        there is no such format.

        Args:
            boxes: boxes of a right class, (D, 4), in the units of the output.
            true_box: the true box (4,) in fractions of width and height.
            min_iou: minimum intersection over union in the suggested format.
        """
        if not len(boxes):
            return ""
        # `max` returns the first of several best formats, so this one is the first. (It
        # is among the others again, as an equal key.)
        candidates = [self, *self._list_formats()]
        best_overlap = {
            candidate: float(compute_iou(candidate.to_fractions(boxes), true_box).max())
            for candidate in candidates
        }
        best = max(best_overlap, key=best_overlap.__getitem__)
        if best_overlap[best] >= max(min_iou, best_overlap[self] + MIN_IOU_GAIN):
            return self.format_change_to(best)
        return ""


def select_best_boxes(images: Sequence[Detections]) -> Tensor:
    """Return the boxes with the best scores of each image, in the format of the
    output, (D, 4).

    Invalid boxes and those without a score over 0 are left out (`are_counted_boxes`).
    """
    boxes_of_images = []
    for detections in images:
        rows = are_counted_boxes(detections).nonzero().flatten()
        numbers = get_possible_scores(detections)
        # An output without classes has no scores, and `amax` of nothing fails.
        has_scores = numbers.shape[1] > 0
        best_score = numbers.new_zeros(len(numbers))
        if has_scores:
            best_score = numbers.amax(dim=1)
        by_score = best_score[rows].argsort(descending=True)
        best_rows = rows[by_score[:MAX_FORMAT_BOXES]]
        boxes_of_images.append(detections["boxes"].detach()[best_rows])
    return torch.cat(boxes_of_images) if boxes_of_images else torch.zeros(0, 4)


def infer_unit(boxes: Tensor) -> str:
    """Infer the unit of boxes (D, 4) in any format, one of `UNITS`; "" if unclear."""
    if not len(boxes):
        return ""
    # The largest number of a box is about the same in all formats: a corner, or a center.
    typical_coordinate = float(boxes.abs().amax(dim=1).median())
    if typical_coordinate <= MAX_FRACTION:
        return "fractions"
    if typical_coordinate >= MIN_PIXELS:
        return "pixels"
    return ""
