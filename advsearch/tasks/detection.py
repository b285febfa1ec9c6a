"""Object detection: whether a model finds the object, by a box where it is and the
right name.

Boxes with a score of every class are suppressed class by class (greedily) before
anybody sees one. The object is found by a right box that is left, and has vanished
where there was none before either; a box that is a success is one that is left. Boxes
that come with their labels count as they are. Scores p are compared as log-odds, log(p
/ (1 - p)).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from advsearch.errors import InputError
from advsearch.files import JsonValue
from advsearch.models import Model
from advsearch.models.labels import names_nothing
from advsearch.options import FROM_RUN, NOT_A_NUMBER, OUT_OF_VIEW, OUTCOME, Outcome
from advsearch.tasks import detector_outputs as outputs
from advsearch.tasks.base import Facts, Mark, Prediction, Said
from advsearch.tasks.boxes import (
    FORMS,
    KNOWN,
    LEAST_OVERLAP,
    SMALLEST,
    UNITS,
    Detections,
    Place,
    Reading,
    as_option,
    best_of,
    listed,
    log_odds,
    numbers_of,
    overlap,
    overlap_with,
    share_inside,
    strongest_boxes,
    suppressed,
    unit_in,
)
from advsearch.tasks.classification import NO, ClassTask, Labels
from advsearch.tasks.detector_outputs import (
    ASK_ORDER,
    HEADS,
    LAYOUTS,
    QUERIES,
    TOLD_BY_CLASSES,
)

GOALS = {
    "vanish": "no right box is found where the object is",
    "mislabel": "a box where the object is has a wrong name, and none the right one",
    "displace": "boxes with the right name are found, and none of them fits the "
    "object: they are loose or elsewhere",
    "create": "a box is found where nothing is",
}
"""What an attack may be after, by the name of the objective."""

MOST = 8
LEAST = 0.1
"""Most boxes that are kept of a picture; the least score of one, and of one that is
suppressed.
"""

# fraction of a box from which on it is on the object, however little it overlaps
ON_IT = 0.5

LABELS = {
    Outcome.LOOSE: "{} in a loose box",
    Outcome.PHANTOM: "{} elsewhere",
    Outcome.MISSED: f"{NO}{{}}",
}
"""What a prediction is called by its outcome and class; by its class alone where it is
not here.
"""


@dataclass(frozen=True)
class Finding:
    """What becomes of the object in the boxes of a picture.

    Attributes:
        outcome: None where nothing of the object is to be seen, and nothing is found
            either.
        index: of the class that it is about: the one that is found, or the right one.
        score: of the box that decides; None where that is no number.
        iou: intersection over union of that box with the true one; None where there is
            no box, or no true one.
    """

    outcome: Outcome | None
    index: int
    score: float | None = None
    iou: float | None = None


@dataclass(frozen=True, kw_only=True)
class Detection(ClassTask):
    """A model finds the object: one of its boxes has a right name, a score of
    `confidence` and overlaps the true box.

    Where the object is not seen at all there is nothing to find, and every prediction
    is right.

    Args:
        iou: least intersection over union with the true box.
        confidence: least score of a box that counts.
        boxes: how the model gives a box, one of `FORMS`; "" for xyxy, of YOLO's heads
            cxcywh.
        suppression: intersection over union from which two boxes of a class are one
            thing, of which the better one is left; 1 where a model's own boxes should
            all count.
        unit: of these numbers: "fractions" of the picture's sides, or "pixels" of the
            model's input; "" for what the boxes in a picture of noise look like, or in
            a clean picture of the scene where it finds none in noise.
        order: of outputs without names, or of the columns of rows: "boxes labels
            scores", say, with "batch" for the number of the picture; of YOLO's heads
            "boxes scores" or "boxes objectness scores", with "channels first" or
            "channels last" after it; of DETR's "boxes logits", or "boxes logits
            nothing" where the last class is no thing; "" for what types and numbers
            show.
        seek: what an attack is after, one of `GOALS`.

    Raises:
        InputError: a value that is none of these.
    """

    name = "detection"
    varies = True

    iou: float = 0.5
    confidence: float = 0.5
    suppression: float = 0.5
    boxes: str = ""
    unit: str = ""
    order: str = ""
    seek: str = "vanish"
    # of the model, (height, width) in pixels
    input_size: tuple[int, int] = field(default=(1, 1), metadata=FROM_RUN)
    # what the model's own outputs show; "" where not yet
    seen_unit: str = field(default="", metadata=FROM_RUN)
    seen_order: str = field(default="", metadata=FROM_RUN)
    # only numbers tell scores from classes in its outputs
    undecided: bool = field(default=False, metadata=FROM_RUN)
    # (A, B) of what is read as a YOLO's head
    shape: tuple[int, ...] | None = field(default=None, metadata=FROM_RUN)
    # mask coefficients stand in its outputs, and are left out
    masks: bool = field(default=False, metadata=FROM_RUN)
    # its network says what its boxes are, see `KNOWN`
    told: bool = field(default=False, metadata=FROM_RUN)
    # a row of NaN says that nothing is found
    fills_with_nan: bool = field(default=False, metadata=FROM_RUN)
    doubts: str = field(default="", metadata=FROM_RUN)  # what is odd about its boxes

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_numbers(
            lambda value: 0.0 < value < 1.0,
            "a number between 0 and 1",
            "iou",
            "confidence",
        )
        self.check_numbers(
            lambda value: 0.0 < value <= 1.0, "a number over 0, up to 1", "suppression"
        )
        try:
            outputs.checked_order(self.order or outputs.ORDERS[0])
        except ValueError as error:
            raise InputError(f"task detection: order: {error}") from None
        for name, known in (
            ("boxes", ("", *FORMS)),
            ("unit", ("", *UNITS)),
            ("seek", tuple(GOALS)),
        ):
            if getattr(self, name) not in known:
                expected = ", ".join(filter(None, known))
                raise InputError(
                    f"task detection: {name}: expected one of {expected}, "
                    f"got {getattr(self, name)!r}"
                )
        if self.target is not None and self.seek not in ("mislabel", "create"):
            raise InputError(
                f"target: {self.seek} has none; add `objective` mislabel or create"
            )
        if self.minimise and self.seek != "vanish":
            raise InputError(
                "minimise: expected `objective` vanish, whose opposite "
                f"is to be found, got {self.seek}"
            )

    def on(
        self, model: Model, *, target: str | None = None, minimise: bool = False
    ) -> Detection:
        found = super().on(model, target=target, minimise=minimise)
        with torch.no_grad():
            noise = torch.rand(
                (1, *model.input_size, 3), generator=torch.Generator().manual_seed(0)
            )
            output = model(noise)
        blank = any("blank" in one for one in output)
        told = not (self.boxes or self.unit) and getattr(model.module, KNOWN, False)
        return replace(
            found, input_size=model.input_size, fills_with_nan=blank, told=told
        )._having_seen(output)

    @property
    def calibrates(self) -> bool:
        return not (self.told or (self.boxes and self.unit)) or (
            self.undecided and not self.order
        )

    def after_calibration(
        self, output: Sequence[Detections], truth: Place | None
    ) -> Detection:
        found = self._having_seen(output)
        output = found._boxed(output)
        reading = found._reading
        if truth is not None and truth.shares is not None:
            each = [
                (one["boxes"], found._of(one, truth.labels))
                for one in found._settled(output)
            ]
            right = torch.cat([raw[score >= LEAST] for raw, score in each])
            if len(right):
                better = reading.better(right, truth.shares, self.iou)
                said = (
                    f"one of them is nearer to the object with {better}"
                    if better
                    else reading.fault(right)
                )
                return replace(found, doubts=said)
        boxes = strongest_boxes(output)
        return replace(
            found,
            doubts=reading.fault(boxes)
            and f"{reading.fault(boxes)}{reading.instead(boxes)}",
        )

    def _having_seen(self, output: Sequence[Detections]) -> Detection:
        """The task with what an output of its model shows of orders and units."""
        grids = [one["raw"] for one in output if "raw" in one]
        last = (
            any("logits" in one for one in output)
            and self.named
            and names_nothing(self.labels[-1])
        )
        head = self._head or (QUERIES[1] if last else "")
        try:
            order = outputs.order_in(
                output, len(self.labels) if self.named else None, head
            )
        except ValueError as error:
            what = f"the model's output is {tuple(grids[0].shape)}: " if grids else ""
            asked = f"; {ASK_ORDER}" if any("either" in one for one in output) else ""
            raise InputError(f"task detection: {what}{error}{asked}") from None
        # mask coefficients stand beside the scores of a picture's boxes
        masks = any("beside" in one and "raw" not in one for one in output)
        if grids:
            length = grids[0].shape[0 if order.endswith(LAYOUTS[0]) else 1]
            masks |= length > len(self.labels) + next(
                start for head, start in HEADS.items() if order.startswith(head)
            )
        found = replace(
            self,
            seen_order=order or self.seen_order,
            undecided=self.undecided or any("either" in one for one in output),
            shape=tuple(grids[0].shape) if grids else self.shape,
            masks=self.masks or masks,
        )
        boxed = found._boxed(output)
        return replace(
            found,
            seen_unit=UNITS[1]
            if self.told
            else unit_in(strongest_boxes(boxed)) or self.seen_unit,
            fills_with_nan=self.fills_with_nan
            or any("blank" in one and len(one["boxes"]) for one in boxed),
        )

    def _boxed(self, output: Sequence[Detections]) -> Sequence[Detections]:
        """What the model returned, with the boxes of YOLO's heads and the scores of
        DETR's found.
        """
        return (
            self._settled(output)
            if any("raw" in one or "logits" in one for one in output)
            else output
        )

    @property
    def ambiguities(self) -> str:
        if self.undecided and not (self.order or self.seen_order):
            return (
                "order: expected what tells scores from classes, and no output of "
                f"the model does; {ASK_ORDER}"
            )
        if not (self.unit or self.seen_unit):
            return (
                "unit: expected the unit of the model's boxes, and it finds nothing in "
                "noise and in the clean scene "
                f"that shows it; say {as_option('unit: fractions')} or "
                f"{as_option('unit: pixels')}, and `boxes` too "
                "unless they are x0, y0, x1, y1"
            )
        return ""

    @property
    def remarks(self) -> tuple[str, ...]:
        said = []
        order = as_option(f"order: {self.seen_order}")
        if self.shape and not self.order:
            said.append(
                f"The detector's output of {self.shape} is read as a YOLO's: {order}."
            )
        if self.seen_order in QUERIES and not self.order:
            said.append(f"The detector's output is read as a DETR's: {order}.")
        if self.masks:
            said.append(
                "The detector's masks are left out: its boxes and scores are read."
            )
        if self.undecided and self.seen_order and not self.order:
            told = (
                "Scores and classes of the detector's boxes are told apart by "
                "their "
                "values"
            )
            said.append(f"{told}: they are read as {order}.")
        if self.doubts:
            said.append(f"The detector's boxes may be read wrongly: {self.doubts}.")
        return tuple(said)

    @property
    def _reading(self) -> Reading:
        form = self.boxes or (
            "cxcywh" if (self._head or self.seen_order) in TOLD_BY_CLASSES else FORMS[0]
        )
        return Reading(form, self.unit or self.seen_unit or UNITS[1], self.input_size)

    @property
    def _head(self) -> str:
        """The head of `HEADS`, or the one of `QUERIES`, that `order` says; "" where it
        says none.
        """
        order = " ".join(outputs.checked_order(self.order)) if self.order else ""
        return order if order in TOLD_BY_CLASSES else ""

    def seeking(self, objective: str) -> Detection:
        return replace(self, seek=objective) if objective in GOALS else self

    def read(self, prediction: Any, count: int) -> list[Detections]:
        return outputs.detections_in(prediction, count, self.order)

    def classes_in(self, output: Sequence[Detections]) -> int | None:
        scores = output[0].get("scores")
        return scores.shape[1] if scores is not None and scores.ndim == 2 else None

    def truth(self, facts: Facts) -> Place:
        height, width = facts.mask.shape
        right = self.right_classes(facts)
        others = [other.box for other in facts.others if self._has_class(other, right)]
        return Place(
            right,
            facts.box,
            (height, width),
            tuple(box for box in others if box is not None),
        )

    def _has_class(self, facts: Facts, classes: Labels) -> bool:
        """Whether a thing's own label is one of some classes of the model."""
        try:
            return not set(classes).isdisjoint(self.right_classes(facts))
        except InputError:  # it has no label, or none that the model knows
            return False

    def truth_names(self, truth: Place) -> tuple[str, ...]:
        return self.names(truth.labels)

    # ---- scores
    # -----------------------------------------------------------------------------------------------------

    def loss(self, output: Sequence[Detections], truth: Place) -> Tensor:
        """Return how far the best right box stays below `confidence`, in log-odds,
        (N,). Of `create`: how far the best box where nothing is stands above it.
        """
        wrong = self._create if self.seek == "create" else self._vanish
        return self._each(output, truth, lambda one: wrong(self._left(one), truth))

    def score(self, output: Sequence[Detections], truth: Place) -> Tensor:
        """Return how near each of N outputs is to what is sought, (N,), in log-odds:
        over 0 where it is a success.
        """
        if self.minimise:
            return -self.loss(output, truth)
        reach: Callable[[Detections, Place], Tensor] = getattr(self, f"_{self.seek}")
        return self._each(output, truth, lambda one: reach(one, truth))

    def _each(
        self,
        output: Sequence[Detections],
        truth: Place,
        value: Callable[[Detections], Tensor],
    ) -> Tensor:
        """A value of each picture, (N,); NaN where a number that counts is none, -1
        where there is nothing to find.
        """
        hidden = truth.box is None and self.seek != "create"
        return torch.stack([
            one["scores"].sum() * math.nan if self._broken(one)
            else one["scores"].sum() * 0.0 - 1.0 if hidden
            else value(one)
            for one in self._read(output)
        ])  # fmt: skip

    def _vanish(self, one: Detections, truth: Place) -> Tensor:
        return self._bar - log_odds(
            best_of(self._of(one, truth.labels), self._at(one, truth))
        )

    def _mislabel(self, one: Detections, truth: Place) -> Tensor:
        called = (
            log_odds(
                best_of(
                    self._rivals(self._left(one), truth.labels), self._at(one, truth)
                )
            )
            - self._bar
        )
        return torch.minimum(self._vanish(one, truth), called)

    def _displace(self, one: Detections, truth: Place) -> Tensor:
        """The lesser of two: how far the best overlap of a box that counts is under
        `iou`, and that some box counts. The first is in units in which a small step
        from `iou` is as long as one in log-odds.
        """
        scores = self._of(one, truth.labels)
        sure = log_odds(best_of(scores)) - self._bar
        away = (
            self.iou - best_of(overlap_with(one, truth), scores >= self.confidence)
        ) / (self.iou * (1.0 - self.iou))
        return torch.minimum(away, sure)

    def _create(self, one: Detections, truth: Place) -> Tensor:
        return log_odds(best_of(self._as_phantoms(self._left(one), truth))) - self._bar

    def _at(self, one: Detections, truth: Place) -> Tensor:
        """Which boxes are where the object is, (D,) bool."""
        return overlap_with(one, truth) >= self.iou

    @property
    def _bar(self) -> float:
        return math.log(self.confidence / (1.0 - self.confidence))

    # ---- boxes and scores of one picture
    # ----------------------------------------------------------------------------

    def _settled(self, output: Sequence[Detections]) -> list[Detections]:
        """What the model returned, with scores and classes told apart, boxes as they
        came.
        """
        try:
            return [
                outputs.settled(one, self.seen_order, len(self.labels) or None)
                for one in output
            ]
        except ValueError as error:
            raise InputError(f"task detection: {error}") from None

    def _read(self, output: Sequence[Detections]) -> list[Detections]:
        """What the model returned, with boxes as shares of the picture; what names no
        thing has a score of 0.
        """
        found = list[Detections]()
        reading = self._reading
        nothing = torch.tensor(self.nothing, dtype=torch.long)
        for one in self._settled(output):
            boxes = reading.fractions(one["boxes"])
            scores = one["scores"]
            if "labels" in one:
                scores = scores.masked_fill(
                    torch.isin(one["labels"], nothing.to(scores.device)), 0.0
                )
            elif len(nothing):
                scores = scores.index_fill(1, nothing.to(scores.device), 0.0)
            read = {**one, "boxes": boxes, "scores": scores}
            there = boxes.detach().isfinite().all(dim=1) | ~(
                numbers_of(read) < self._least
            ).all(dim=1)
            if not bool(there.all()):
                read = {
                    name: part if name == "blank" else part[there]
                    for name, part in read.items()
                }
            found.append(read)
        return found

    @property
    def _least(self) -> float:
        return min(LEAST, self.confidence)

    def _broken(self, one: Detections) -> bool:
        """Whether a score, or the place of what has one, is not a number; or all rows
        are NaN that do not fill up.
        """
        blank = "blank" in one and not len(one["boxes"]) and not self.fills_with_nan
        return blank or not all(
            bool(one[name].detach().isfinite().all()) for name in ("boxes", "scores")
        )

    def _left(self, one: Detections) -> Detections:
        return suppressed(one, self._least, self.suppression)

    def _elsewhere(self, one: Detections, truth: Place) -> Tensor:
        """Boxes of which most is not on the object, and that do not frame it, (D,)
        bool.
        """
        if truth.shares is None:
            return torch.ones(
                len(one["boxes"]), dtype=torch.bool, device=one["boxes"].device
            )
        return (
            share_inside(one["boxes"], truth.shares.to(one["boxes"])) < ON_IT
        ) & ~self._at(one, truth)

    @staticmethod
    def _lie_on(boxes: Tensor, true: Tensor) -> Tensor:
        """Find boxes (D, 4) that are on what has a true box (4,), however loosely, (D,)
        bool.
        """
        return (overlap(boxes, true) >= LEAST_OVERLAP) | (
            share_inside(boxes, true) >= ON_IT
        )

    def _loosely(self, one: Detections, truth: Place) -> Tensor:
        """Boxes on the object that fit no other thing of its class better, (D,)
        bool.
        """
        boxes = one["boxes"]
        true = truth.shares
        assert true is not None
        on_it = self._lie_on(boxes, true.to(boxes))
        for other in truth.others:
            on_it = on_it & (
                overlap_with(one, truth)
                >= overlap(boxes, truth.fractions_of(other).to(boxes))
            )
        return on_it

    def _away(self, one: Detections, truth: Place) -> Tensor:
        """Boxes that are neither on the object nor on another thing of its class, (D,)
        bool.
        """
        boxes = one["boxes"]
        away = torch.ones(len(boxes), dtype=torch.bool, device=boxes.device)
        for true in [*([] if truth.box is None else [truth.box]), *truth.others]:
            away = away & ~self._lie_on(boxes, truth.fractions_of(true).to(boxes))
        return away

    def _as_phantoms(self, one: Detections, truth: Place) -> Tensor:
        """The score of each box as one where nothing is, (D,): of a class that is
        sought, or any. A loose box of the object's own class is none.
        """
        if self.target is not None:
            sought = set(self.target)
            own = self._of(one, tuple(sorted(sought & set(truth.labels))))
            different = self._of(one, tuple(sorted(sought - set(truth.labels))))
        else:
            own = self._of(one, truth.labels)
            different = self._rivals(one, truth.labels)
        own = torch.where(self._away(one, truth), own, 0.0)
        return torch.maximum(
            own, torch.where(self._elsewhere(one, truth), different, 0.0)
        )

    @staticmethod
    def _of(one: Detections, labels: Labels) -> Tensor:
        """The score of a class among these for each box, (D,)."""
        scores = one["scores"]
        if "labels" not in one:
            return (
                scores[:, list(labels)].amax(dim=1)
                if len(scores) and labels
                else scores.sum(dim=1) * 0.0
            )
        return scores * torch.isin(
            one["labels"], torch.tensor(labels, device=scores.device)
        )

    def _rivals(self, one: Detections, labels: Labels) -> Tensor:
        """The score of a class that is none of these, or of those that are sought, for
        each box, (D,).
        """
        if self.target is not None:
            return self._of(one, self.target)
        if "labels" in one:
            return one["scores"] - self._of(one, labels)
        return self._of(
            one, tuple(sorted(set(range(one["scores"].shape[1])) - set(labels)))
        )

    # ---- in words
    # ---------------------------------------------------------------------------------------------------

    def predictions(
        self, output: Sequence[Detections], count: int = 1
    ) -> list[tuple[Prediction, ...]]:
        found = []
        for one in self._read(output):
            broken = self._broken(one)
            boxes = [] if broken else listed(one, count, SMALLEST, self.suppression)
            said = tuple(
                Prediction(self.name_of(label), label, score)
                for _, label, score in boxes
            )
            found.append(said or (Prediction(NOT_A_NUMBER if broken else "nothing"),))
        return found

    def said(
        self, output: Sequence[Detections], truth: Place, margins: Sequence[float]
    ) -> list[Said]:
        """See `Task.said`; the prediction is what the model says of the object, the
        payload its boxes in pixels.
        """
        height, width = truth.size
        found: list[Said] = []
        for one in self._read(output):
            boxes: list[JsonValue] = [
                {
                    "box": [
                        round(share * side, 1)
                        for share, side in zip(box, [width, height] * 2, strict=True)
                    ],
                    "label": self.name_of(label),
                    "score": round(score, 3),
                }
                for box, label, score in listed(
                    one, MOST, self._least, self.suppression
                )
            ]
            finding = self._find(self._left(one), truth)
            payload: dict[str, JsonValue] = {
                "box": None if truth.box is None else list(truth.box),
                "found": boxes,
            }
            if finding.outcome is not None:
                iou = None if finding.iou is None else round(finding.iou, 3)
                payload |= {
                    OUTCOME: finding.outcome.value,
                    "class": self.name_of(finding.index),
                    "iou": iou,
                }
            found.append((self._prediction(finding, truth), payload))
        return found

    def _find(self, one: Detections, truth: Place) -> Finding:
        """Decide what becomes of the object in boxes that suppression has left."""
        right_score = self._of(one, truth.labels)
        away = self._away(one, truth)
        if self.seek == "create" and float(self._create(one, truth)) > 0.0:
            phantom_score = self._as_phantoms(one, truth)
            return self._decided(
                Outcome.PHANTOM, one, phantom_score, phantom_score > 0.0, truth
            )
        if truth.box is None:
            if (
                self.seek != "create"
                and float(best_of(right_score, away)) >= self.confidence
            ):
                return self._decided(Outcome.PHANTOM, one, right_score, away, truth)
            return Finding(None, truth.labels[0])
        at = self._at(one, truth)
        candidates = (
            (Outcome.FOUND, right_score, at),
            (Outcome.WRONG_CLASS, self._rivals(one, truth.labels), at),
            (Outcome.LOOSE, right_score, self._loosely(one, truth) & ~at),
            (Outcome.PHANTOM, right_score, away),
        )
        for outcome, score, among in candidates:
            if float(best_of(score, among)) >= self.confidence:
                return self._decided(outcome, one, score, among, truth)
        best = float(best_of(right_score, at))
        return Finding(
            Outcome.MISSED, truth.labels[0], best if math.isfinite(best) else None
        )

    @staticmethod
    def _decided(
        outcome: Outcome, one: Detections, scores: Tensor, among: Tensor, truth: Place
    ) -> Finding:
        """The outcome that the best box among some decides."""
        place = int(torch.where(among, scores, -1.0).argmax())
        score = float(scores[place])
        index = int(
            one["labels"][place]
            if "labels" in one
            else (one["scores"][place] == score).nonzero()[0]
        )
        iou = None if truth.box is None else float(overlap_with(one, truth)[place])
        return Finding(outcome, index, score, iou)

    def _prediction(self, finding: Finding, truth: Place) -> Prediction:
        """What a model says of the object, with the score of the box that says so."""
        name = self.name_of(finding.index)
        if finding.outcome is None or (truth.box is None and self.seek != "create"):
            return Prediction(OUT_OF_VIEW)
        if finding.outcome in LABELS:
            return Prediction(LABELS[finding.outcome].format(name), None, finding.score)
        return Prediction(name, finding.index, finding.score)

    def marks(self, output: Sequence[Detections], truth: Place) -> list[list[Mark]]:
        """See `Task.marks`: the true box, and every box with a score of
        `confidence`.
        """
        height, width = truth.size
        true = (
            []
            if truth.box is None
            else [Mark(" or ".join(self.names(truth.labels)), True, box=truth.box)]
        )
        return [
            true + [
                Mark(f"{self.name_of(label)} {score:.2f}", False, box=(a * width, b * height, c * width, d * height))
                for (a, b, c, d), label, score
                in ([] if self._broken(one) else listed(one, MOST, self.confidence, self.suppression))
            ]
            for one in self._read(output)
        ]  # fmt: skip
