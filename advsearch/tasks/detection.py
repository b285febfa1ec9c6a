"""Object detection: whether a model finds the object, by a box where it is and the right name.

A model that gives a score of every class for each box has not suppressed those that overlap, which is done class by
class (greedily) before anybody sees a box. What counts here holds before and after that: the object is found by a right
box that is left, and has vanished where there was none before either; a box that is a success is one that is left. So a
right box beside a better one of its class that is not where the object is makes an answer neither right nor a success.
Boxes that come with their labels count as they are. Scores p are compared as log-odds, log(p / (1 - p)).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from advsearch.described import NOT_A_NUMBER
from advsearch.errors import InputError
from advsearch.files import JsonValue
from advsearch.models import Model
from advsearch.models.labels import names_nothing
from advsearch.options import FROM_RUN
from advsearch.tasks.base import Answer, Facts, Judgement, Mark
from advsearch.tasks.boxes import (
    FORMS,
    HEADS,
    KNOWN,
    LAYOUTS,
    UNITS,
    Reading,
    left_over,
    names_head,
    overlap,
    share_inside,
    strongest,
    strongest_boxes,
    unit_in,
)
from advsearch.tasks.classification import NO, ClassTask, Labels
from advsearch.tasks.detector_answers import (
    ORDERS,
    QUERIES,
    Detections,
    as_option,
    ask_order,
    checked_order,
    detections_in,
    numbers_of,
    order_in,
    settled,
)

GOALS = {
    "vanish": "no right box is found where the object is",
    "mislabel": "a box where the object is has a wrong name, and none the right one",
    "displace": "boxes with the right name are found, and none of them where the object is",
    "create": "a box is found where nothing is",
}
"""What an attack may be after, by the name of the objective."""

SMALLEST = 1e-6
"""Scores and overlaps below this, or as near to 1, count as this: log-odds of 13.8."""
MOST, LEAST, LOOKED_AT = 8, 0.1, 500
"""Most boxes that are kept of a picture; the least score of one, and of one that is suppressed; and among how many of
the best scores they are looked for."""

Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class Place:
    """What is to be found in a picture: the truth of detection.

    Attributes:
        labels: indices of the right classes.
        box: smallest box round what is seen of the object, x0, y0, x1, y1 in pixels; None where nothing is.
        size: (height, width) of the picture in pixels.
    """

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


@dataclass(frozen=True, kw_only=True)
class Detection(ClassTask):
    """A model finds the object: one of its boxes has a right name, a score of `confidence` and overlaps the true box.

    Where the object is not seen at all there is nothing to find, and every answer is right.

    Args:
        iou: least intersection over union with the true box.
        confidence: least score of a box that counts.
        boxes: how the model gives a box, one of `FORMS`; "" for xyxy, of YOLO's heads cxcywh.
        suppression: intersection over union from which two boxes of a class are one thing, of which the better one is
            left; 1 where a model's own boxes should all count.
        unit: of these numbers: "fractions" of the picture's sides, or "pixels" of the model's input; "" for what the
            boxes in a picture of noise look like, or in a clean picture of the scene where it finds none in noise.
        order: of outputs without names, or of the columns of rows: "boxes labels scores", say, with "batch" for the
            number of the picture; of YOLO's heads "boxes scores" or "boxes objectness scores", with "channels first" or
            "channels last" after it; of DETR's "boxes logits", or "boxes logits nothing" where the last class is no
            thing; "" for what types and numbers show.
        seek: what an attack is after, one of `GOALS`.
        input_size: (height, width) of the model's input in pixels.
        seen_unit, seen_order: what the model's own answers show; "" where they have not yet.
        undecided: whether only numbers tell scores from classes in its answers.
        shape: (A, B) of an answer that is read as a YOLO's head; None of others.
        masks: whether mask coefficients stand in its answers, which are left out.
        told: whether its network says that its boxes are corners in pixels, as those of libraries do (`KNOWN`).
        fills_with_nan: whether rows of NaN stand where nothing is found, and not for an answer that is not a number.
        doubts: what is odd about these.

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
    input_size: tuple[int, int] = field(default=(1, 1), metadata=FROM_RUN)
    seen_unit: str = field(default="", metadata=FROM_RUN)
    seen_order: str = field(default="", metadata=FROM_RUN)
    undecided: bool = field(default=False, metadata=FROM_RUN)
    shape: tuple[int, ...] | None = field(default=None, metadata=FROM_RUN)
    masks: bool = field(default=False, metadata=FROM_RUN)
    told: bool = field(default=False, metadata=FROM_RUN)
    fills_with_nan: bool = field(default=False, metadata=FROM_RUN)
    doubts: str = field(default="", metadata=FROM_RUN)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("iou", "confidence"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0.0 < value < 1.0:
                raise InputError(f"task detection: {name}: expected a number between 0 and 1, got {value!r}")
        if isinstance(self.suppression, bool) or not 0.0 < self.suppression <= 1.0:
            raise InputError(
                f"task detection: suppression: expected a number over 0, up to 1, got {self.suppression!r}"
            )
        try:
            checked_order(self.order or ORDERS[0])
        except ValueError as error:
            raise InputError(f"task detection: order: {error}") from None
        for name, known in (("boxes", ("", *FORMS)), ("unit", ("", *UNITS)), ("seek", tuple(GOALS))):
            if getattr(self, name) not in known:
                expected = ", ".join(filter(None, known))
                raise InputError(f"task detection: {name}: expected one of {expected}, got {getattr(self, name)!r}")
        if self.target is not None and self.seek not in ("mislabel", "create"):
            raise InputError(f"target: {self.seek} has none; add `objective` mislabel or create")
        if self.minimise and self.seek != "vanish":
            raise InputError(f"minimise: expected `objective` vanish, whose opposite is to be found, got {self.seek}")

    def on(self, model: Model, *, target: str | None = None, minimise: bool = False) -> Detection:
        found = super().on(model, target=target, minimise=minimise)
        with torch.no_grad():
            noise = torch.rand((1, *model.input_size, 3), generator=torch.Generator().manual_seed(0))
            output = model(noise)
        blank = any("blank" in one for one in output)
        told = not (self.boxes or self.unit) and getattr(model.module, KNOWN, False)
        return replace(found, input_size=model.input_size, fills_with_nan=blank, told=told)._having_seen(output)

    @property
    def looks(self) -> bool:
        """See `Task.looks`: unless all is said already, boxes are compared with the true one."""
        return not (self.told or (self.boxes and self.unit)) or (self.undecided and not self.order)

    def seeing(self, output: Sequence[Detections], truth: Place | None) -> Detection:
        found = self._having_seen(output)
        output = found._boxed(output)
        reading, right = found._reading, strongest_boxes(output)[:0]
        if truth is not None and truth.shares is not None:
            each = [(one["boxes"], found._of(one, truth.labels)) for one in found._settled(output)]
            right = torch.cat([raw[score >= LEAST] for raw, score in each])
        if len(right) and truth is not None and truth.shares is not None:
            better = reading.better(right, truth.shares, self.iou)
            doubts = f"one of them is nearer to the object with {better}" if better else reading.fault(right)
        else:
            boxes = strongest_boxes(output)
            doubts = reading.fault(boxes) and f"{reading.fault(boxes)}{reading.instead(boxes)}"
        return replace(found, doubts=doubts)

    def _having_seen(self, output: Sequence[Detections]) -> Detection:
        """The task with what an answer of its model shows of orders and units."""
        grids = [one["raw"] for one in output if "raw" in one]
        last = any("logits" in one for one in output) and self.named and names_nothing(self.labels[-1])
        try:
            order = order_in(
                output, len(self.labels) if self.named else None, self._head or (QUERIES[1] if last else "")
            )
        except ValueError as error:
            what = f"the model's answer is {tuple(grids[0].shape)}: " if grids else ""
            asked = f"; {ask_order()}" if any("either" in one for one in output) else ""
            raise InputError(f"task detection: {what}{error}{asked}") from None
        found = replace(
            self,
            seen_order=order or self.seen_order,
            undecided=self.undecided or any("either" in one for one in output),
            shape=tuple(grids[0].shape) if grids else self.shape,
            masks=self.masks or any(self._has_masks(one, order) for one in output),
        )
        boxed = found._boxed(output)
        return replace(
            found,
            seen_unit=UNITS[1] if self.told else unit_in(strongest_boxes(boxed)) or self.seen_unit,
            fills_with_nan=self.fills_with_nan or any("blank" in one and len(one["boxes"]) for one in boxed),
        )

    def _has_masks(self, one: Detections, order: str) -> bool:
        """Whether what stands beside the scores of a picture's boxes are mask coefficients."""
        if "raw" not in one:
            return "beside" in one
        length = one["raw"].shape[0 if order.endswith(LAYOUTS[0]) else 1]
        return length > len(self.labels) + next(start for head, start in HEADS.items() if order.startswith(head))

    def _boxed(self, output: Sequence[Detections]) -> Sequence[Detections]:
        """What the model answered, with the boxes of YOLO's heads and the scores of DETR's found."""
        return self._settled(output) if any("raw" in one or "logits" in one for one in output) else output

    @property
    def unsaid(self) -> str:
        if self.undecided and not (self.order or self.seen_order):
            return f"order: expected what tells scores from classes, and no answer of the model does; {ask_order()}"
        if not (self.unit or self.seen_unit):
            return (
                "unit: expected the unit of the model's boxes, and it finds nothing in noise and in the clean scene "
                f"that shows it; say {as_option('unit: fractions')} or {as_option('unit: pixels')}, and `boxes` too "
                "unless they are x0, y0, x1, y1"
            )
        return ""

    @property
    def remarks(self) -> tuple[str, ...]:
        said = []
        if self.shape and not self.order:
            said.append(
                f"The detector's answer of {self.shape} is read as a YOLO's: {as_option(f'order: {self.seen_order}')}."
            )
        if self.seen_order in QUERIES and not self.order:
            said.append(f"The detector's answer is read as a DETR's: {as_option(f'order: {self.seen_order}')}.")
        if self.masks:
            said.append("The detector's masks are left out: its boxes and scores are read.")
        if self.undecided and self.seen_order and not self.order:
            said.append(
                "Scores and classes of the detector's boxes are told apart by their values: they are read as "
                f"{as_option(f'order: {self.seen_order}')}."
            )
        if self.doubts:
            said.append(f"The detector's boxes may be read wrongly: {self.doubts}.")
        return tuple(said)

    @property
    def _reading(self) -> Reading:
        middle = self._told_by_classes(self._head or self.seen_order)
        return Reading(
            self.boxes or ("cxcywh" if middle else FORMS[0]), self.unit or self.seen_unit or UNITS[1], self.input_size
        )

    @property
    def _head(self) -> str:
        """The head of `boxes.HEADS`, or the one of `QUERIES`, that `order` says; "" where it says none."""
        order = " ".join(checked_order(self.order)) if self.order else ""
        return order if self._told_by_classes(order) else ""

    @staticmethod
    def _told_by_classes(order: str) -> bool:
        """Whether an order is of answers that the number of classes explains; their boxes have a middle and sides."""
        return names_head(order) or order in QUERIES

    def seeking(self, objective: str) -> Detection:
        """See `Task.seeking`: the objectives of detection say what counts as success."""
        return replace(self, seek=objective) if objective in GOALS else self

    def read(self, answer: Any, count: int) -> list[Detections]:
        """See `Task.read`: what `advsearch.tasks.detector_answers.detections_in` takes."""
        return detections_in(answer, count, self.order)

    def classes_in(self, output: Sequence[Detections]) -> int | None:
        """Return how many classes each box has a score of."""
        scores = output[0].get("scores")
        return scores.shape[1] if scores is not None and scores.ndim == 2 else None

    def check(self, facts: Facts) -> None:
        """See `Task.check`: the model must have such a class."""
        self.right_classes(facts)

    def truth(self, facts: Facts) -> Place:
        """Return what is to be found, and where it is seen."""
        height, width = facts.mask.shape
        return Place(self.right_classes(facts), facts.box, (height, width))

    def truth_names(self, truth: Place) -> tuple[str, ...]:
        """Return the right names."""
        return self.names(truth.labels)

    # ---- scores -----------------------------------------------------------------------------------------------------

    def margin(self, output: Sequence[Detections], truth: Place) -> Tensor:
        """Return how far the best right box stays below `confidence`, in log-odds, (N,).

        Of `create`: how far the best box where nothing is stands above it.
        """
        wrong = self._created if self.seek == "create" else self._missed
        return self._each(output, lambda one: wrong(self._left(one), truth))

    def score(self, output: Sequence[Detections], truth: Place) -> Tensor:
        """Return how near each of N outputs is to what is sought, (N,), in log-odds: over 0 where it is a success."""
        if self.minimise:
            return -self.margin(output, truth)
        reach = {
            "vanish": self._missed,
            "mislabel": self._mislabelled,
            "displace": self._displaced,
            "create": self._created,
        }[self.seek]
        return self._each(output, lambda one: reach(one, truth))

    def _each(self, output: Sequence[Detections], value: Callable[[Detections], Tensor]) -> Tensor:
        """A value of each picture, (N,); NaN where a number that counts is none."""
        read = self._read(output)
        return torch.stack([one["scores"].sum() * math.nan if self._broken(one) else value(one) for one in read])

    def _missed(self, one: Detections, truth: Place) -> Tensor:
        at = self._overlap(one, truth)
        if at is None:
            return one["scores"].sum() * 0.0 - 1.0
        return self._bar - log_odds(_best(self._of(one, truth.labels), at >= self.iou))

    def _mislabelled(self, one: Detections, truth: Place) -> Tensor:
        missed, at = self._missed(one, truth), self._overlap(one, truth)
        if at is None:
            return missed
        called = log_odds(_best(self._rivals(self._left(one), truth.labels), at >= self.iou)) - self._bar
        return torch.minimum(missed, called)

    def _displaced(self, one: Detections, truth: Place) -> Tensor:
        """The lesser of two: how far the best overlap of a box that counts is under `iou`, and that some box counts.

        The first is in units in which a small step from `iou` is as long as one in log-odds.
        """
        at, scores = self._overlap(one, truth), self._of(one, truth.labels)
        if at is None:
            return one["scores"].sum() * 0.0 - 1.0
        sure = log_odds(_best(scores)) - self._bar
        away = (self.iou - _best(at, scores >= self.confidence)) / (self.iou * (1.0 - self.iou))
        return torch.minimum(away, sure)

    def _created(self, one: Detections, truth: Place) -> Tensor:
        return log_odds(_best(self._sought(self._left(one)), self._elsewhere(one, truth))) - self._bar

    @property
    def _bar(self) -> float:
        return math.log(self.confidence / (1.0 - self.confidence))

    # ---- boxes and scores of one picture ----------------------------------------------------------------------------

    def _settled(self, output: Sequence[Detections]) -> list[Detections]:
        """What the model answered, with scores and classes told apart, boxes as they came."""
        try:
            return [settled(one, self.seen_order, len(self.labels) or None) for one in output]
        except ValueError as error:
            raise InputError(f"task detection: {error}") from None

    def _read(self, output: Sequence[Detections]) -> list[Detections]:
        """What the model answered, with boxes as shares of the picture; what names no thing has a score of 0."""
        found, reading = list[Detections](), self._reading
        nothing = torch.tensor(self.nothing, dtype=torch.long)
        for one in self._settled(output):
            boxes, scores = reading.fractions(one["boxes"]), one["scores"]
            if "labels" in one:
                scores = scores.masked_fill(torch.isin(one["labels"], nothing.to(scores.device)), 0.0)
            elif len(nothing):
                scores = scores.index_fill(1, nothing.to(scores.device), 0.0)
            read = {**one, "boxes": boxes, "scores": scores}
            there = boxes.detach().isfinite().all(dim=1) | ~(numbers_of(read) < self._least).all(dim=1)
            if not bool(there.all()):
                read = {name: part if name == "blank" else part[there] for name, part in read.items()}
            found.append(read)
        return found

    @property
    def _least(self) -> float:
        """The least score of a box that anybody looks at."""
        return min(LEAST, self.confidence)

    def _broken(self, one: Detections) -> bool:
        """Whether a score, or the place of what has one, is not a number; or all rows are NaN that do not fill up."""
        blank = "blank" in one and not len(one["boxes"]) and not self.fills_with_nan
        return blank or not all(bool(one[name].detach().isfinite().all()) for name in ("boxes", "scores"))

    def _left(self, one: Detections) -> Detections:
        """What suppression leaves of boxes with a score of every class: the score of one that it removes is 0.

        What has a score under `LEAST`, or under `confidence` if that is less, counts for nobody and is left alone. The
        choice has no derivative; what is left has.
        """
        if "labels" in one or self.suppression == 1.0 or not len(one["boxes"]):
            return one
        scores, boxes = one["scores"].detach(), one["boxes"].detach()
        rows, classes = (scores >= self._least).nonzero(as_tuple=True)
        removed = torch.zeros_like(scores, dtype=torch.bool)
        for label in classes.unique().tolist():
            mine = rows[classes == label]
            if len(mine) > 1:
                removed[mine, label] = ~left_over(boxes[mine], scores[mine, label], self.suppression)
        return {**one, "scores": torch.where(removed, 0.0, one["scores"])}

    def _overlap(self, one: Detections, truth: Place) -> Tensor | None:
        """Intersection over union with the true box, (D,); None where the object is not seen."""
        shares = truth.shares
        return None if shares is None else overlap(one["boxes"], shares.to(one["boxes"]))

    def _elsewhere(self, one: Detections, truth: Place) -> Tensor:
        """Boxes of which most is not on the object, and that do not frame it, (D,) bool."""
        shares = truth.shares
        if shares is None:
            return torch.ones(len(one["boxes"]), dtype=torch.bool, device=one["boxes"].device)
        boxes, place = one["boxes"], shares.to(one["boxes"])
        return (share_inside(boxes, place) < 0.5) & (overlap(boxes, place) < self.iou)

    @staticmethod
    def _of(one: Detections, labels: Labels) -> Tensor:
        """The score of a class among these for each box, (D,)."""
        scores = one["scores"]
        if "labels" not in one:
            return scores[:, list(labels)].amax(dim=1) if len(scores) else scores.sum(dim=1)
        return scores * torch.isin(one["labels"], torch.tensor(labels, device=scores.device))

    def _rivals(self, one: Detections, labels: Labels) -> Tensor:
        """The score of another class, or of those that are sought, for each box, (D,)."""
        if self.target is not None:
            return self._of(one, self.target)
        if "labels" in one:
            return one["scores"] - self._of(one, labels)
        return self._of(one, tuple(sorted(set(range(one["scores"].shape[1])) - set(labels))))

    def _sought(self, one: Detections) -> Tensor:
        """The score of any class, or of those that are sought, for each box, (D,)."""
        return self._rivals(one, ())

    # ---- in words ---------------------------------------------------------------------------------------------------

    def answers(self, output: Sequence[Detections], count: int = 1) -> list[tuple[Answer, ...]]:
        """Return the names of the best boxes of each picture with their scores; of boxes that overlap, the best one."""
        found = []
        for one in self._read(output):
            rows = [] if self._broken(one) else self._listed(one, count, SMALLEST)
            listed = [Answer(self.name_of(label), label, score) for _, label, score in rows]
            found.append(tuple(listed) or (Answer(NOT_A_NUMBER if self._broken(one) else "nothing"),))
        return found

    def judge(self, output: Sequence[Detections], truth: Place) -> list[Judgement]:
        """See `Task.judge`; the answer is what the model says of the object, the payload its boxes in pixels."""
        with torch.no_grad():
            scores, margins = self.score(output, truth).tolist(), self.margin(output, truth).tolist()
            return [
                Judgement.of(score, margin, *self._said(one, truth))
                for score, margin, one in zip(scores, margins, self._read(output), strict=True)
            ]

    def _said(self, one: Detections, truth: Place) -> tuple[Answer, JsonValue]:
        if self._broken(one):
            return Answer(NOT_A_NUMBER), None
        return self._answer(self._left(one), truth), self._payload(one, truth)

    def _answer(self, one: Detections, truth: Place) -> Answer:
        """What a model says of the object, with the score of the box that says so."""
        names, at = self.names(truth.labels), self._overlap(one, truth)
        if self.seek == "create" and float(self._created(one, truth)) > 0.0:
            return self._named(one, self._sought(one), self._elsewhere(one, truth), f"{{}} {ELSEWHERE}")
        if at is None:
            return Answer("out of view")
        near, right = at >= self.iou, self._of(one, truth.labels)
        best = float(_best(right, near))
        if best >= self.confidence:
            return self._named(one, right, near)
        if float(_best(self._rivals(one, truth.labels), near)) >= self.confidence:
            return self._named(one, self._rivals(one, truth.labels), near)
        if float(_best(right)) >= self.confidence:
            return self._named(one, right, ~near, f"{{}} {ELSEWHERE}")
        return Answer(f"{NO}{names[0]}", None, best if math.isfinite(best) else None)

    def _named(self, one: Detections, scores: Tensor, among: Tensor, form: str = "{}") -> Answer:
        """The class of the best box among some."""
        place = int(torch.where(among, scores, -1.0).argmax())
        score = float(scores[place])
        label = int(one["labels"][place] if "labels" in one else (one["scores"][place] == score).nonzero()[0])
        return Answer(form.format(self.name_of(label)), label if form == "{}" else None, score)

    def _listed(self, one: Detections, count: int, least: float) -> list[tuple[Box, int, float]]:
        """The best boxes, of a class and a place one: shares of width and height, class, score."""
        boxes, scores = one["boxes"].detach(), one["scores"].detach()
        best, places = scores.flatten().topk(min(LOOKED_AT, scores.numel()))
        each = 1 if "labels" in one else scores.shape[1]
        rows = places // each
        classes = one["labels"][rows] if "labels" in one else places % each
        found: list[tuple[Box, int, float]] = []
        for label in classes[best >= least].unique().tolist():
            mine = ((classes == label) & (best >= least)).nonzero().flatten()
            for place in mine[strongest(boxes[rows[mine]], best[mine], count, self.suppression)].tolist():
                x0, y0, x1, y1 = boxes[rows[place]].tolist()
                found.append(((x0, y0, x1, y1), label, float(best[place])))
        return sorted(found, key=lambda row: -row[2])[:count]

    def _payload(self, one: Detections, truth: Place) -> Any:
        """The true box, and what the model found, in pixels of the picture."""
        height, width = truth.size
        found = [
            {
                "box": [round(share * side, 1) for share, side in zip(box, [width, height] * 2, strict=True)],
                "label": self.name_of(label),
                "score": round(score, 3),
            }
            for box, label, score in self._listed(one, MOST, self._least)
        ]
        return {"box": None if truth.box is None else list(truth.box), "found": found}

    def marks(self, output: Sequence[Detections], truth: Place) -> list[list[Mark]]:
        """See `Task.marks`: the true box, and every box with a score of `confidence`."""
        height, width = truth.size
        true = [] if truth.box is None else [Mark(" or ".join(self.names(truth.labels)), True, box=truth.box)]
        found = []
        for one in self._read(output):
            listed = [] if self._broken(one) else self._listed(one, MOST, self.confidence)
            found.append(true + [
                Mark(f"{self.name_of(label)} {score:.2f}", False, box=(a * width, b * height, c * width, d * height))
                for (a, b, c, d), label, score in listed
            ])  # fmt: skip
        return found


ELSEWHERE = "elsewhere"
"""How an answer says that a box is not where the object is."""


def log_odds(shares: Tensor) -> Tensor:
    """Return log(p / (1 - p)), with what lies outside [0, 1] taken for its end."""
    inside = shares.clamp(SMALLEST, 1.0 - SMALLEST)
    return inside.log() - torch.log1p(-inside)


def _best(values: Tensor, among: Tensor | None = None) -> Tensor:
    """The largest of values (D,), or of those where `among` is true; 0 where there are none."""
    chosen = values if among is None else torch.where(among, values, 0.0)
    return torch.cat([chosen, chosen.new_zeros(1)]).amax()
