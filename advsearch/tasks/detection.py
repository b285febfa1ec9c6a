"""Task for object detection: is there a box with a right class at the object?

If an output has a score of every class for each box, greedy non-maximum suppression is
applied to each class first. The object is found if a right box survives suppression. It
has vanished only if there is no right box before suppression either. A box that makes an
attack a success must survive too. Boxes with labels are not suppressed, as networks
return them after suppression. Scores p are compared as log-odds, log(p / (1 - p)).
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
from advsearch.models.labels import is_nothing_name
from advsearch.options import FROM_RUN, NOT_A_NUMBER, OUT_OF_VIEW, OUTCOME, Outcome
from advsearch.tasks import detector_outputs as outputs
from advsearch.tasks.base import Facts, Mark, Prediction, PredictionWithPayload
from advsearch.tasks.boxes import (
    DECLARED_FORMAT_ATTRIBUTE,
    FORMS,
    MIN_OVERLAP,
    MIN_PROBABILITY,
    UNITS,
    BoxFormat,
    Detections,
    DetectionTruth,
    compute_fraction_inside,
    compute_iou,
    compute_iou_with_truth,
    compute_log_odds,
    format_detection_option,
    get_possible_scores,
    infer_unit,
    list_boxes,
    max_or_zero,
    select_best_boxes,
    suppress_overlapping_boxes,
)
from advsearch.tasks.classification import MISSED_PREFIX, ClassTask, Labels
from advsearch.tasks.detector_outputs import (
    CHANNELS_FIRST,
    CLASS_COUNT_ORDERS,
    HEADS,
    ORDER_ADVICE,
    QUERIES,
    SOFTMAX_QUERIES,
)

GOALS = {
    "vanish": "no right box is found where the object is",
    "mislabel": "a box where the object is has a wrong name, and none the right one",
    "displace": "boxes with the right name are found, and none of them fits the "
    "object: they are loose or elsewhere",
    "create": "a box is found where nothing is",
}
"""Goals of an attack, by the name of the objective."""

MAX_STORED_BOXES = 8  # maximum number of boxes that are stored for each image
MIN_SCORE = 0.1  # minimum score of a box that is stored or takes part in suppression

# A box is on the object if this fraction of it lies inside of the true box, even if the
# intersection over union is small.
MIN_FRACTION_INSIDE = 0.5

LABELS = {
    Outcome.LOOSE: "{} in a loose box",
    Outcome.PHANTOM: "{} elsewhere",
    Outcome.MISSED: f"{MISSED_PREFIX}{{}}",
}
"""Label of a prediction by its outcome. For other outcomes the label is the class."""


@dataclass(frozen=True)
class ObjectMatch:
    """The outcome for the object in the detections of one image.

    Attributes:
        outcome: outcome, such as found or missed. None if the object is out of view and
            nothing is detected.
        class_index: class of the deciding box, or the first right class if there is none.
        score: score of the deciding box; None if it is not finite.
        iou: intersection over union of that box with the true one; None if there is
            no such box, or no true one.
    """

    outcome: Outcome | None
    class_index: int
    score: float | None = None
    iou: float | None = None


@dataclass(frozen=True, kw_only=True)
class Detection(ClassTask):
    """Judge whether a model detects the object.

    The object is detected if a box has a right class, a score of at least `confidence`,
    and an intersection over union of at least `iou` with the true box. If the object is
    out of view, there is nothing to detect, and every prediction is right.

    Args:
        iou: minimum intersection over union with the true box.
        confidence: minimum score of a box that counts.
        boxes: format of a box, one of `FORMS`; "" for xyxy, or for cxcywh if the output
            is that of a YOLO head or a DETR.
        suppression: intersection over union from which two boxes of a class are
            duplicates, of which only the better one is used; 1 disables suppression.
        unit: unit of box coordinates: "fractions" of the image's width and height, or
            "pixels" of the model's input; "" to infer it from the boxes in an image of
            noise, or in a clean image of the scene if none are found in noise.
        order: order of outputs without names, or of the columns of rows: "boxes labels
            scores", say, with "batch" for the index of the image; for YOLO heads "boxes
            scores" or "boxes objectness scores", optionally followed by "channels
            first" or "channels last"; for DETR "boxes logits", or "boxes logits
            nothing" if the last class means no object; "" to infer it from types and
            values.
        seek: goal of an attack, one of `GOALS`.

    Attributes:
        input_size: input size of the model, (height, width) in pixels.
        inferred_unit: unit that was inferred from the model's outputs; "" if they do
            not show it.
        inferred_order: order that was inferred from the model's outputs; "" if they do
            not show it.
        is_order_ambiguous: whether only the values of the outputs distinguish scores
            from classes.
        head_shape: (A, B) of an output that is read as a YOLO head; None for others.
        ignores_masks: whether the outputs have mask coefficients, which are not read.
        has_declared_format: whether the network declares the format of its boxes, see
            `DECLARED_FORMAT_ATTRIBUTE`.
        fills_with_nan: whether the model fills unused rows of its output with NaN. Then
            an output with nothing but such rows means that nothing is detected.
        format_doubts: reason why the boxes may be read wrongly, for a message; "" if there is
            none.

    Raises:
        InputError: an option has another value.
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
    inferred_unit: str = field(default="", metadata=FROM_RUN)
    inferred_order: str = field(default="", metadata=FROM_RUN)
    is_order_ambiguous: bool = field(default=False, metadata=FROM_RUN)
    head_shape: tuple[int, ...] | None = field(default=None, metadata=FROM_RUN)
    ignores_masks: bool = field(default=False, metadata=FROM_RUN)
    has_declared_format: bool = field(default=False, metadata=FROM_RUN)
    fills_with_nan: bool = field(default=False, metadata=FROM_RUN)
    format_doubts: str = field(default="", metadata=FROM_RUN)

    def __post_init__(self) -> None:
        """Check that all options are within their limits and fit each other."""
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
        self._check_stated_order()
        self._check_choice("boxes", ("", *FORMS))
        self._check_choice("unit", ("", *UNITS))
        self._check_choice("seek", tuple(GOALS))
        self._check_goal()

    def _check_stated_order(self) -> None:
        """Raise InputError if the order of an output's components is invalid."""
        if self.order:
            try:
                outputs.parse_order(self.order)
            except ValueError as error:
                raise InputError(f"task detection: order: {error}") from None

    def _check_goal(self) -> None:
        """Raise InputError if the target or `minimise` does not fit the goal.

        Users set the option `seek` by the setting `objective` of a run. So messages
        call it the objective.
        """
        if self.target is not None and self.seek not in ("mislabel", "create"):
            raise InputError(
                f"target: the objective {self.seek} has none; set `objective` to "
                "mislabel or create"
            )
        if self.minimise and self.seek != "vanish":
            raise InputError(
                f"minimise: expected the objective vanish, got {self.seek}; with vanish "
                "it seeks that the object is found"
            )

    def _check_choice(self, option: str, choices: Sequence[str]) -> None:
        """Raise InputError if the value of an option is none of its choices."""
        value = getattr(self, option)
        if value not in choices:
            expected = ", ".join(filter(None, choices))
            raise InputError(
                f"task detection: {option}: expected one of {expected}, got {value!r}"
            )

    def on(
        self, model: Model, *, target: str | None = None, minimise: bool = False
    ) -> Detection:
        """Return the task for a model whose output format is inferred.

        The model is run on one image of noise, since its output shows the format of
        boxes and scores.

        Args:
            model: the detector.
            target: name of the class that the attack seeks; None for any wrong one.
            minimise: whether a right prediction is sought.
        """
        task = super().on(model, target=target, minimise=minimise)
        generator = torch.Generator().manual_seed(0)
        with torch.no_grad():
            noise = torch.rand((1, *model.input_size, 3), generator=generator)
            output = model(noise)
        # Rows of NaN, which are counted as "n_nan_rows", are no error in the output for
        # noise: the model leaves them in unused rows.
        fills_with_nan = any("n_nan_rows" in detections for detections in output)
        task = replace(
            task,
            input_size=model.input_size,
            fills_with_nan=fills_with_nan,
            has_declared_format=self._is_format_declared(model),
        )
        return task._infer_format(output)

    def _is_format_declared(self, model: Model) -> bool:
        """Return whether the network declares the format of its boxes by an attribute.

        Options of the user take precedence.
        """
        if self.boxes or self.unit:
            return False
        is_declared: bool = getattr(model.module, DECLARED_FORMAT_ATTRIBUTE, False)
        return is_declared

    @property
    def calibrates(self) -> bool:
        knows_format = self.has_declared_format or bool(self.boxes and self.unit)
        needs_order = self.is_order_ambiguous and not self.order
        return not knows_format or needs_order

    def after_calibration(
        self, output: Sequence[Detections], truth: DetectionTruth | None
    ) -> Detection:
        """Infer the format of the boxes from the clean image, and store doubts about it.

        If there are boxes of right classes and a true box, the boxes should fit it in
        the inferred format: doubts name a format in which one fits much better.
        Otherwise doubts are about implausible boxes among those with the best scores.

        Args:
            output: output of the model for the clean image.
            truth: truth of that image; None if it is unknown.

        Returns:
            The task with its `format_doubts`: why its format may be wrong, "" if there is
            no reason.
        """
        task = self._infer_format(output)
        output = task._resolve_grids(output)
        if truth is not None and truth.box_fractions is not None:
            right_boxes = task._find_boxes_of_classes(output, truth.labels)
            if len(right_boxes):
                doubts = task._compare_with_truth(right_boxes, truth.box_fractions)
                return replace(task, format_doubts=doubts)
        boxes = select_best_boxes(output)
        box_format = task._box_format
        doubts = box_format.describe_fault(boxes)
        if doubts:
            doubts += box_format.suggest_plausible_formats(boxes)
        return replace(task, format_doubts=doubts)

    def _compare_with_truth(self, boxes: Tensor, true_box: Tensor) -> str:
        """Return doubts about the format of boxes of the right classes; "" if none.

        Args:
            boxes: (D, 4) boxes in the format of the output.
            true_box: (4,) true box, in fractions of width and height.
        """
        box_format = self._box_format
        better_format = box_format.suggest_better_format(boxes, true_box, self.iou)
        if better_format:
            return f"one of them is nearer to the object with {better_format}"
        return box_format.describe_fault(boxes)

    def _find_boxes_of_classes(
        self, output: Sequence[Detections], classes: Labels
    ) -> Tensor:
        """Return the boxes (D, 4) of all images that have one of the classes, in the
        format of the output.
        """
        selected = []
        for detections in self._resolve_labels(output):
            scores = self._find_best_scores(detections, classes)
            selected.append(detections["boxes"][scores >= MIN_SCORE])
        return torch.cat(selected)

    def _infer_format(self, output: Sequence[Detections]) -> Detection:
        """Return the task with the order and unit that an output of its model shows.

        An order or unit that this output does not show stays as it was inferred from an
        earlier output. The first output is for noise (see `on`), the next for the clean
        image (see `after_calibration`).
        """
        # The order is needed to read the boxes below.
        task_with_order = self._resolve_order(output)
        resolved = task_with_order._resolve_grids(output)
        unit = self._infer_unit_of_boxes(resolved)
        # An output with boxes and rows of NaN shows that the model fills unused rows with
        # NaN.
        has_nan_rows = any(
            "n_nan_rows" in detections and len(detections["boxes"])
            for detections in resolved
        )
        return replace(
            task_with_order,
            inferred_unit=unit,
            fills_with_nan=self.fills_with_nan or has_nan_rows,
        )

    def _infer_unit_of_boxes(self, resolved: Sequence[Detections]) -> str:
        """Return the unit of the boxes in an output; the one before if it shows none."""
        if self.has_declared_format:
            return "pixels"  # the meaning of `DECLARED_FORMAT_ATTRIBUTE`
        return infer_unit(select_best_boxes(resolved)) or self.inferred_unit

    def _resolve_order(self, output: Sequence[Detections]) -> Detection:
        """Return the task with the order that an output of its model shows."""
        order = self._infer_order(output)
        grids = [detections["grid"] for detections in output if "grid" in detections]
        has_pairs = any("score_or_label" in detections for detections in output)
        has_masks = self.ignores_masks or self._has_mask_coefficients(output, order)
        return replace(
            self,
            inferred_order=order or self.inferred_order,
            is_order_ambiguous=self.is_order_ambiguous or has_pairs,
            head_shape=tuple(grids[0].shape) if grids else self.head_shape,
            ignores_masks=has_masks,
        )

    def _infer_order(self, output: Sequence[Detections]) -> str:
        """Return the order of components that an output shows; "" if it shows none.

        The logits, grids or pairs of numbers in the output show its order. In a DETR
        output the last logit means "no object" if the user states no order and the name
        of the model's last class has that meaning.

        Raises:
            InputError: the output contradicts the options or the number of classes.
        """
        stated_order = self._stated_network_order
        has_logits = any("logits" in detections for detections in output)
        is_last_nothing = self.has_class_names and is_nothing_name(self.labels[-1])
        if not stated_order and has_logits and is_last_nothing:
            stated_order = SOFTMAX_QUERIES
        # Without names the number of classes is unknown. A last class for nothing counts.
        n_classes = len(self.labels) if self.has_class_names else None
        try:
            return outputs.infer_order(output, n_classes, stated_order)
        except ValueError as error:
            message = _explain_order_error(error, output)
            raise InputError(f"task detection: {message}") from None

    def _has_mask_coefficients(self, output: Sequence[Detections], order: str) -> bool:
        """Return whether an output has mask coefficients in addition to boxes and scores.

        It has them if the network returned feature maps together with rows of boxes, or
        if a YOLO grid has more channels than the box and the scores need.

        Args:
            output: output of N images.
            order: one of `HEADS` with a layout, if there are grids; "" if unknown,
                as without names of classes.
        """
        for detections in output:
            if "map_channels" in detections and "grid" not in detections:
                return True
        grids = [detections["grid"] for detections in output if "grid" in detections]
        if not grids or not order:
            return False
        channel_axis = 0 if order.endswith(CHANNELS_FIRST) else 1
        n_channels = grids[0].shape[channel_axis]
        # The channels of the box, and perhaps of objectness. `order` is a head and a
        # layout; it begins with one head only.
        n_channels_before_scores = next(
            first_score for head, first_score in HEADS.items() if order.startswith(head)
        )
        return n_channels > n_channels_before_scores + len(self.labels)

    def _resolve_grids(self, output: Sequence[Detections]) -> Sequence[Detections]:
        """Convert YOLO grids or DETR logits in an output to boxes and scores.

        Outputs without them are returned unchanged.
        """
        # All images of an output have the same form.
        if any("grid" in detections or "logits" in detections for detections in output):
            return self._resolve_labels(output)
        return output

    @property
    def ambiguity_message(self) -> str:
        """Return a message with the option that the user has to state; "" for none.

        An option has to be stated if no output of the model shows its value.
        """
        if self.is_order_ambiguous and not (self.order or self.inferred_order):
            return (
                "order: expected the order of scores and classes, which no output of "
                f"the model shows; {ORDER_ADVICE}"
            )
        if not (self.unit or self.inferred_unit):
            return (
                "unit: expected the unit of the model's boxes, and it finds no boxes in "
                "noise and in the clean scene that show it; set "
                f"{format_detection_option('unit: fractions')} or "
                f"{format_detection_option('unit: pixels')}, and `boxes` too unless they are x0, "
                "y0, x1, y1"
            )
        return ""

    @property
    def output_remarks(self) -> tuple[str, ...]:
        """Return sentences about how the model's output is read.

        They report the order that was inferred, if the user states none, masks that are
        not read, and doubts about the format of boxes.
        """
        remarks = self._remarks_on_order
        if self.ignores_masks:
            remarks.append(
                "The detector's masks are not used: only its boxes and scores are read."
            )
        is_order_inferred = not self.order and bool(self.inferred_order)
        if is_order_inferred and self.is_order_ambiguous:
            remarks.append(
                "Scores and classes of the detector's boxes are distinguished by their "
                f"values: they are read as {self._order_option}."
            )
        if self.format_doubts:
            remarks.append(
                f"The detector's boxes may be read wrongly: {self.format_doubts}."
            )
        return tuple(remarks)

    @property
    def _order_option(self) -> str:
        """The option that states the inferred order."""
        return format_detection_option(f"order: {self.inferred_order}")

    @property
    def _remarks_on_order(self) -> list[str]:
        """Sentences about the kind of network whose order was inferred."""
        if self.order:
            return []
        remarks = []
        if self.head_shape:
            remarks.append(
                f"The detector's output of {self.head_shape} is read as a YOLO's: "
                f"{self._order_option}."
            )
        if self.inferred_order in QUERIES:
            remarks.append(
                f"The detector's output is read as a DETR's: {self._order_option}."
            )
        return remarks

    @property
    def _box_format(self) -> BoxFormat:
        """The format of the model's boxes: that of the options, or the inferred one."""
        order = self._stated_network_order or self.inferred_order
        # YOLO heads and DETR networks have centers and sizes
        default_form = "cxcywh" if order in CLASS_COUNT_ORDERS else "xyxy"
        unit = self.unit or self.inferred_unit or "pixels"
        return BoxFormat(self.boxes or default_form, unit, self.input_size)

    @property
    def _stated_network_order(self) -> str:
        """The option `order`, if it states that the output is that of a YOLO or a DETR.

        It is one of `CLASS_COUNT_ORDERS`, or "". Other values of the option name the
        components or columns of an output.
        """
        if not self.order:
            return ""
        # The user may write commas or several blanks between the words.
        order = " ".join(outputs.parse_order(self.order))
        return order if order in CLASS_COUNT_ORDERS else ""

    def with_objective(self, objective: str) -> Detection:
        return replace(self, seek=objective) if objective in GOALS else self

    def read(self, prediction: Any, count: int) -> list[Detections]:
        return outputs.read_detections(prediction, count, self.order)

    def count_classes(self, output: Sequence[Detections]) -> int | None:
        scores = output[0].get("scores")
        return scores.shape[1] if scores is not None and scores.ndim == 2 else None

    def truth(self, facts: Facts) -> DetectionTruth:
        """Return the object's true box, and the boxes of other objects of its classes."""
        height, width = facts.mask.shape
        right_classes = self.find_right_classes(facts)
        other_boxes = []
        for other in facts.facts_of_others:
            if self._has_class(other, right_classes) and other.box is not None:
                other_boxes.append(other.box)
        return DetectionTruth(
            right_classes, facts.box, (height, width), tuple(other_boxes)
        )

    def _has_class(self, facts: Facts, classes: Labels) -> bool:
        """Return whether a thing's label is one of these classes of the model."""
        try:
            return not set(classes).isdisjoint(self.find_right_classes(facts))
        except InputError:  # it has no label, or none that the model knows
            return False

    def truth_names(self, truth: DetectionTruth) -> tuple[str, ...]:
        return self.get_class_names(truth.labels)

    # ---- loss and score ----

    def loss(self, output: Sequence[Detections], truth: DetectionTruth) -> Tensor:
        """Compute by how much the best right box is below `confidence`, in log-odds.

        Only boxes that survive suppression count.

        Returns:
            (N,), over 0 if the object is not found. If `seek` is "create", the loss is
            instead by how much the best phantom exceeds `confidence`; a phantom is a
            box at a spot without an object of its class.
        """
        # These scores are over 0 if the prediction is wrong, as a loss is.
        if self.seek == "create":
            loss_of_image = self._score_create
        else:
            loss_of_image = self._score_vanish
        return self._map_images(
            output,
            truth,
            lambda detections: loss_of_image(self._suppress(detections), truth),
        )

    def score(self, output: Sequence[Detections], truth: DetectionTruth) -> Tensor:
        """Compute how near each output is to what is sought, (N,), in log-odds.

        It is over 0 if the output is a success.

        Suppression is treated so that it does not make an attack succeed. A suppressed
        box of a right class at the object still counts: the object has not vanished. But
        a box that makes the attack succeed, with a wrong class or where nothing is, has
        to survive suppression. (The loss reads only boxes that survive.)
        """
        # `__post_init__` allows `minimise` for the goal "vanish" only.
        if self.minimise:
            return -self.loss(output, truth)
        score_by_goal: dict[str, Callable[[Detections, DetectionTruth], Tensor]] = {
            "vanish": self._score_vanish,
            "mislabel": self._score_mislabel,
            "displace": self._score_displace,
            "create": self._score_create,
        }
        score_of_image = score_by_goal[self.seek]
        return self._map_images(
            output, truth, lambda detections: score_of_image(detections, truth)
        )

    def _map_images(
        self,
        output: Sequence[Detections],
        truth: DetectionTruth,
        function: Callable[[Detections], Tensor],
    ) -> Tensor:
        """Apply a function to the detections of each image, (N,).

        The value is NaN if the detections cannot be judged, as with a box that is not
        finite (`_is_broken`). If the object is out of view, the value is -1: as a loss a
        right prediction, as a score no success. The goal "create" is an exception: it
        seeks boxes at positions without an object, so that the object need not be
        visible.

        Args:
            output: output of N images.
            truth: truth of the scene.
            function: function from the detections of an image to its value.
        """
        is_out_of_view = truth.box is None and self.seek != "create"
        values = []
        for detections in self._read_boxes(output):
            # Constants are computed from the scores, so that autograd can go through
            # them; their gradient is 0.
            if self._is_broken(detections):
                value = detections["scores"].sum() * math.nan
            elif is_out_of_view:
                value = detections["scores"].sum() * 0.0 - 1.0
            else:
                value = function(detections)
            values.append(value)
        return torch.stack(values)

    def _score_vanish(self, detections: Detections, truth: DetectionTruth) -> Tensor:
        """Compute by how much the best right box at the object is below
        `confidence`.
        """
        right_score = self._find_best_scores(detections, truth.labels)
        best_score = max_or_zero(right_score, self._is_at_object(detections, truth))
        return self._min_log_odds - compute_log_odds(best_score)

    def _score_mislabel(self, detections: Detections, truth: DetectionTruth) -> Tensor:
        """Compute how near the object is to being mislabeled.

        It is mislabeled if it has vanished, and a box at the object has a wrong class. So
        the score is the smaller of two numbers: that of the goal "vanish", and by how
        much the best wrong box at the object exceeds `confidence`. The wrong box has to
        survive suppression. Boxes of a right class count even if they are suppressed.
        """
        wrong_score = self._find_rival_scores(self._suppress(detections), truth.labels)
        # suppression changes scores only, so that boxes are the same
        best_score = max_or_zero(wrong_score, self._is_at_object(detections, truth))
        wrong_excess = compute_log_odds(best_score) - self._min_log_odds
        return torch.minimum(self._score_vanish(detections, truth), wrong_excess)

    def _score_displace(self, detections: Detections, truth: DetectionTruth) -> Tensor:
        """Compute how near the boxes of a right class are to being displaced.

        Boxes are displaced if some box of a right class counts, but none overlaps the
        object by `iou`. So the score is the smaller of two numbers. The first is by how
        much the best overlap of a box that counts falls short of `iou`. It is scaled
        like log-odds: near `iou`, both have the same derivative by the overlap. The
        second is by how much the best score of a right class exceeds `confidence`, in
        log-odds.
        """
        scores = self._find_best_scores(detections, truth.labels)
        score_excess = compute_log_odds(max_or_zero(scores)) - self._min_log_odds
        is_found = scores >= self.confidence
        overlaps = compute_iou_with_truth(detections, truth)
        best_overlap = max_or_zero(overlaps, is_found)
        # The derivative of log-odds at `iou` is 1 / (iou (1 - iou)).
        overlap_shortfall = (self.iou - best_overlap) / (self.iou * (1.0 - self.iou))
        return torch.minimum(overlap_shortfall, score_excess)

    def _score_create(self, detections: Detections, truth: DetectionTruth) -> Tensor:
        """Compute by how much the best phantom exceeds `confidence`, in log-odds.

        A phantom is a box at a position without an object of its class.
        """
        phantom_score = self._find_phantom_scores(self._suppress(detections), truth)
        return compute_log_odds(max_or_zero(phantom_score)) - self._min_log_odds

    def _is_at_object(self, detections: Detections, truth: DetectionTruth) -> Tensor:
        """Return which boxes fit the true box, (D,) bool."""
        return compute_iou_with_truth(detections, truth) >= self.iou

    @property
    def _min_log_odds(self) -> float:
        """The log-odds of `confidence`, from which a box counts."""
        return math.log(self.confidence / (1.0 - self.confidence))

    # ---- boxes and scores of one image ----

    def _resolve_labels(self, output: Sequence[Detections]) -> list[Detections]:
        """Identify the scores and the classes of an output.

        The boxes stay in the format of the network, such as x0, y0, x1, y1 in pixels.

        Raises:
            InputError: the values do not show which numbers are scores.
        """
        n_classes = len(self.labels) or None  # None: the number is unknown
        try:
            return [
                outputs.resolve_detections(detections, self.inferred_order, n_classes)
                for detections in output
            ]
        except ValueError as error:
            raise InputError(f"task detection: {error}") from None

    def _read_boxes(self, output: Sequence[Detections]) -> list[Detections]:
        """Return the detections of each image with boxes as fractions of the image.

        Classes such as "no object" get a score of 0. Boxes that are not finite are removed
        if all their scores are too low to be stored, since networks leave such boxes in
        unused rows. Other boxes that are not finite stay, and make the output broken
        (`_is_broken`).
        """
        images = list[Detections]()
        box_format = self._box_format
        for detections in self._resolve_labels(output):
            boxes = box_format.to_fractions(detections["boxes"])
            scores = self._clear_nothing_classes(detections)
            resolved = {**detections, "boxes": boxes, "scores": scores}
            is_finite = boxes.detach().isfinite().all(dim=1)
            # false for a score of NaN
            is_low = get_possible_scores(resolved) < self._min_score
            is_used = is_finite | ~is_low.all(dim=1)
            if bool(is_used.all()):
                images.append(resolved)
            else:
                images.append(_select_rows(resolved, is_used))
        return images

    def _clear_nothing_classes(self, detections: Detections) -> Tensor:
        """Return the scores of an image, with 0 for classes that stand for nothing."""
        scores = detections["scores"]
        classes = torch.tensor(self.background_classes, dtype=torch.long)
        classes = classes.to(scores.device)
        if "labels" in detections:
            is_nothing = torch.isin(detections["labels"], classes)
            return scores.masked_fill(is_nothing, 0.0)
        if len(classes):
            return scores.index_fill(1, classes, 0.0)
        return scores

    @property
    def _min_score(self) -> float:
        """The minimum score of a box that is stored or takes part in suppression."""
        return min(MIN_SCORE, self.confidence)

    def _is_broken(self, detections: Detections) -> bool:
        """Return whether the detections of an image cannot be judged.

        This is so if a score or a box is not finite, or if all rows of the output were
        NaN. An exception are models that fill unused rows with NaN: then rows of NaN mean
        that nothing is detected.
        """
        # Rows of NaN have been removed. If there were any, "n_nan_rows" is their count.
        has_only_nan_rows = "n_nan_rows" in detections and not len(detections["boxes"])
        if has_only_nan_rows and not self.fills_with_nan:
            return True
        return not all(
            bool(detections[name].detach().isfinite().all())
            for name in ("boxes", "scores")
        )

    def _suppress(self, detections: Detections) -> Detections:
        """Apply non-maximum suppression with the options of the task."""
        return suppress_overlapping_boxes(detections, self._min_score, self.suppression)

    def _is_elsewhere(self, detections: Detections, truth: DetectionTruth) -> Tensor:
        """Return which boxes are elsewhere than the object, (D,) bool.

        Such a box neither fits the object's box nor lies mostly inside of it. If the
        object is out of view, all boxes are elsewhere.
        """
        boxes = detections["boxes"]
        if truth.box_fractions is None:
            return torch.ones(len(boxes), dtype=torch.bool, device=boxes.device)
        is_mostly_outside = (
            compute_fraction_inside(boxes, truth.box_fractions.to(boxes))
            < MIN_FRACTION_INSIDE
        )
        return is_mostly_outside & ~self._is_at_object(detections, truth)

    @staticmethod
    def _are_on(boxes: Tensor, true_box: Tensor) -> Tensor:
        """Return which boxes (D, 4) are on a thing, however loosely, (D,) bool.

        They overlap its true box (4,) a little, or lie mostly inside of it.
        """
        overlaps = compute_iou(boxes, true_box) >= MIN_OVERLAP
        lies_inside = compute_fraction_inside(boxes, true_box) >= MIN_FRACTION_INSIDE
        return overlaps | lies_inside

    def _is_loosely_on_object(
        self, detections: Detections, truth: DetectionTruth
    ) -> Tensor:
        """Return which boxes are on the object, however loosely, (D,) bool.

        A box that overlaps another object of the right classes more belongs to that
        other object, and is not counted here.
        """
        boxes = detections["boxes"]
        true_box = truth.box_fractions
        assert true_box is not None
        is_on_object = self._are_on(boxes, true_box.to(boxes))
        object_overlap = compute_iou_with_truth(detections, truth)
        for other_box in truth.other_boxes:
            other_overlap = compute_iou(boxes, truth.to_fractions(other_box).to(boxes))
            is_on_object = is_on_object & (object_overlap >= other_overlap)
        return is_on_object

    def _is_on_nothing(self, detections: Detections, truth: DetectionTruth) -> Tensor:
        """Return which boxes are on no object of the right classes, (D,) bool.

        Objects of the right classes are the object itself, if it is in view, and other
        things in the image that have one of its classes. See `_are_on` for when a box is
        on an object.
        """
        boxes = detections["boxes"]
        true_boxes = list(truth.other_boxes)
        if truth.box is not None:
            true_boxes.insert(0, truth.box)
        is_on_nothing = torch.ones(len(boxes), dtype=torch.bool, device=boxes.device)
        for true_box in true_boxes:
            is_on_thing = self._are_on(boxes, truth.to_fractions(true_box).to(boxes))
            is_on_nothing = is_on_nothing & ~is_on_thing
        return is_on_nothing

    def _find_phantom_scores(
        self, detections: Detections, truth: DetectionTruth
    ) -> Tensor:
        """Return the score of each box as a phantom, (D,); 0 if the box is none.

        A phantom is a box at a position without an object of its class:

        - A box of a right class is a phantom if it is on no object of the right classes,
          not even loosely (`_is_on_nothing`).
        - The true boxes of other classes are unknown. A box of another class is a phantom
          if it is away from the object (`_is_elsewhere`): at the object, it would be a
          wrong class for the object.

        If there is a target, only the scores of target classes count; they may be right
        classes of the object, too.
        """
        right_score, wrong_score = self._find_sought_scores(detections, truth)
        is_on_nothing = self._is_on_nothing(detections, truth)
        is_elsewhere = self._is_elsewhere(detections, truth)
        return torch.maximum(
            torch.where(is_on_nothing, right_score, 0.0),
            torch.where(is_elsewhere, wrong_score, 0.0),
        )

    def _find_sought_scores(
        self, detections: Detections, truth: DetectionTruth
    ) -> tuple[Tensor, Tensor]:
        """Return each box's best score of a right class and of a wrong one, (D,) each.

        If there is a target, only the scores of target classes count.
        """
        if self.target is None:
            right_score = self._find_best_scores(detections, truth.labels)
            wrong_score = self._find_rival_scores(detections, truth.labels)
            return right_score, wrong_score
        right_classes = set(truth.labels)
        right_targets = tuple(sorted(set(self.target) & right_classes))
        wrong_targets = tuple(sorted(set(self.target) - right_classes))
        right_score = self._find_best_scores(detections, right_targets)
        wrong_score = self._find_best_scores(detections, wrong_targets)
        return right_score, wrong_score

    @staticmethod
    def _find_best_scores(detections: Detections, classes: Labels) -> Tensor:
        """Return the best score of each box for one of the classes, (D,).

        A box without a score for any of these classes gets 0.
        """
        scores = detections["scores"]
        if "labels" in detections:  # each box has the score of its own class only
            class_ids = torch.tensor(classes, device=scores.device)
            return scores * torch.isin(detections["labels"], class_ids)
        if len(scores) and classes:
            return scores[:, list(classes)].amax(dim=1)
        # The product keeps the zeros attached to the graph.
        return scores.sum(dim=1) * 0.0

    def _find_rival_scores(self, detections: Detections, classes: Labels) -> Tensor:
        """Return the best score of each box for a class that the attack seeks, (D,).

        These rivals of the right classes are the classes of the target; or without a
        target, all other classes.

        Args:
            detections: detections of an image.
            classes: the right classes.
        """
        if self.target is not None:
            return self._find_best_scores(detections, self.target)
        if "labels" in detections:
            # A box has one class and score. The second term is that score if the class is
            # one of `classes`, else 0. So rivals keep their score, and others get 0.
            return detections["scores"] - self._find_best_scores(detections, classes)
        n_classes = detections["scores"].shape[1]
        rivals = tuple(sorted(set(range(n_classes)) - set(classes)))
        return self._find_best_scores(detections, rivals)

    # ---- predictions ----

    def predictions(
        self, output: Sequence[Detections], count: int = 1
    ) -> list[tuple[Prediction, ...]]:
        """Return the `count` boxes with the best scores of each image, as predictions.

        An image without a box has the only prediction "nothing".
        """
        return [
            self._predict_boxes(detections, count)
            for detections in self._read_boxes(output)
        ]

    def _predict_boxes(
        self, detections: Detections, count: int
    ) -> tuple[Prediction, ...]:
        """Return the `count` boxes with the best scores of an image, as predictions."""
        if self._is_broken(detections):
            return (Prediction(NOT_A_NUMBER),)
        boxes = list_boxes(detections, count, MIN_PROBABILITY, self.suppression)
        predictions = [
            Prediction(self.get_class_name(label), label, score)
            for _, label, score in boxes
        ]
        return tuple(predictions) or (Prediction("nothing"),)

    def describe(
        self,
        output: Sequence[Detections],
        truth: DetectionTruth,
        margins: Sequence[float],
    ) -> list[PredictionWithPayload]:
        """Return the prediction about the object in each image, with its payload.

        The payload has the object's box and the best detected boxes, in pixels, and the
        outcome (such as "missed") with the class and the overlap of the deciding box.

        Args:
            output: detections of N images.
            truth: truth of the scene.
            margins: not used; other tasks read them.
        """
        return [
            self._describe_detections(detections, truth)
            for detections in self._read_boxes(output)
        ]

    def _describe_detections(
        self, detections: Detections, truth: DetectionTruth
    ) -> PredictionWithPayload:
        """Return the prediction about the object in one image, with its payload."""
        match = self._match_object(self._suppress(detections), truth)
        payload: dict[str, JsonValue] = {
            "box": None if truth.box is None else list(truth.box),
            "found": self._list_stored_boxes(detections, truth),
        }
        if match.outcome is not None:
            payload[OUTCOME] = match.outcome.value
            payload["class"] = self.get_class_name(match.class_index)
            payload["iou"] = None if match.iou is None else round(match.iou, 3)
        return self._describe_match(match, truth), payload

    def _list_stored_boxes(
        self, detections: Detections, truth: DetectionTruth
    ) -> list[JsonValue]:
        """Return the best boxes of an image in the form in which rows store them.

        Each has its corners in pixels, the name of its class, and its score.
        """
        height, width = truth.image_size
        scale = [width, height] * 2  # of x0, y0, x1, y1
        best_boxes = list_boxes(
            detections, MAX_STORED_BOXES, self._min_score, self.suppression
        )
        boxes: list[JsonValue] = []
        for box, label, score in best_boxes:
            corners = [x * size for x, size in zip(box, scale, strict=True)]
            pixels: list[JsonValue] = [round(corner, 1) for corner in corners]
            class_name = self.get_class_name(label)
            boxes.append({"box": pixels, "label": class_name, "score": round(score, 3)})
        return boxes

    def _match_object(
        self, detections: Detections, truth: DetectionTruth
    ) -> ObjectMatch:
        """Return the outcome for the object, from the boxes that survived suppression.

        If the goal is "create" and a phantom (a box at a position without an object of
        its class) reaches `confidence`, the best phantom decides.
        """
        if self.seek == "create" and float(self._score_create(detections, truth)) > 0.0:
            phantom_score = self._find_phantom_scores(detections, truth)
            # The best of these exceeds `confidence`, as the score is positive.
            is_phantom = phantom_score > 0.0
            return self._match_best_box(
                Outcome.PHANTOM, detections, phantom_score, is_phantom, truth
            )
        if truth.box is None:
            return self._match_phantom(detections, truth)
        return self._match_visible_object(detections, truth)

    def _match_phantom(
        self, detections: Detections, truth: DetectionTruth
    ) -> ObjectMatch:
        """Return the outcome for an image in which the object is out of view.

        It is a phantom if a box of a right class reaches `confidence` and is on no
        object of these classes. Otherwise there is no outcome. With the goal "create"
        there is none either, because `_match_object` has looked for phantoms before.
        """
        right_score = self._find_best_scores(detections, truth.labels)
        is_on_nothing = self._is_on_nothing(detections, truth)
        best_phantom = float(max_or_zero(right_score, is_on_nothing))
        if self.seek != "create" and best_phantom >= self.confidence:
            return self._match_best_box(
                Outcome.PHANTOM, detections, right_score, is_on_nothing, truth
            )
        return ObjectMatch(outcome=None, class_index=truth.labels[0])

    def _match_visible_object(
        self, detections: Detections, truth: DetectionTruth
    ) -> ObjectMatch:
        """Return the outcome for an object that is in view.

        The outcomes are tried in order, from a found object to worse ones. The first one
        whose best box reaches `confidence` is returned with that box. If there is none,
        the object is missed.
        """
        right_score = self._find_best_scores(detections, truth.labels)
        is_on_nothing = self._is_on_nothing(detections, truth)
        is_at_object = self._is_at_object(detections, truth)
        is_loose = self._is_loosely_on_object(detections, truth) & ~is_at_object
        # of target classes only, if there is a target
        wrong_score = self._find_rival_scores(detections, truth.labels)
        # outcome, scores that count for it, and boxes that count for it
        candidates = (
            (Outcome.FOUND, right_score, is_at_object),
            (Outcome.WRONG_CLASS, wrong_score, is_at_object),
            (Outcome.LOOSE, right_score, is_loose),
            (Outcome.PHANTOM, right_score, is_on_nothing),
        )
        for outcome, scores, is_candidate in candidates:
            if float(max_or_zero(scores, is_candidate)) >= self.confidence:
                return self._match_best_box(
                    outcome, detections, scores, is_candidate, truth
                )
        best_score = float(max_or_zero(right_score, is_at_object))
        return _make_missed_match(truth, best_score)

    @staticmethod
    def _match_best_box(
        outcome: Outcome,
        detections: Detections,
        scores: Tensor,
        is_candidate: Tensor,
        truth: DetectionTruth,
    ) -> ObjectMatch:
        """Return an outcome with the class, score and overlap of the best candidate.

        Args:
            outcome: the outcome, if the best candidate decides.
            detections: detections of the image.
            scores: (D,) score of each box for this outcome: one of the scores of the
                box in `detections`.
            is_candidate: (D,) bool, which boxes may decide.
            truth: truth of the scene.
        """
        # Scores are at least 0. So with -1, boxes that are no candidates come last.
        row = int(torch.where(is_candidate, scores, -1.0).argmax())
        score = float(scores[row])
        class_id = _find_class_of_row(detections, row, score)
        iou = None
        if truth.box is not None:
            iou = float(compute_iou_with_truth(detections, truth)[row])
        return ObjectMatch(outcome, class_id, score, iou)

    def _describe_match(self, match: ObjectMatch, truth: DetectionTruth) -> Prediction:
        """Return the prediction about the object, with the score of the deciding box.

        If the object is out of view, the prediction says only that, whatever is detected.
        An exception is a detected phantom with the goal "create".
        """
        class_name = self.get_class_name(match.class_index)
        is_out_of_view = truth.box is None and self.seek != "create"
        if match.outcome is None or is_out_of_view:
            return Prediction(OUT_OF_VIEW)
        if match.outcome in LABELS:
            label = LABELS[match.outcome].format(class_name)  # "mug elsewhere"
            # Such a label is no class, so that it has no index.
            return Prediction(label, None, match.score)
        return Prediction(class_name, match.class_index, match.score)

    def marks(
        self, output: Sequence[Detections], truth: DetectionTruth
    ) -> list[list[Mark]]:
        """Return the marks to draw on each image: the true box and the detected boxes.

        A detected box is drawn if its score is at least `confidence`.
        """
        true_marks = []
        if truth.box is not None:
            true_name = " or ".join(self.get_class_names(truth.labels))
            true_marks.append(Mark(true_name, True, box=truth.box))
        return [
            [*true_marks, *self._make_predicted_marks(detections, truth)]
            for detections in self._read_boxes(output)
        ]

    def _make_predicted_marks(
        self, detections: Detections, truth: DetectionTruth
    ) -> list[Mark]:
        """Return a mark for each box of an image with a score of at least `confidence`."""
        if self._is_broken(detections):
            return []
        height, width = truth.image_size
        best_boxes = list_boxes(
            detections, MAX_STORED_BOXES, self.confidence, self.suppression
        )
        marks = []
        for (x0, y0, x1, y1), label, score in best_boxes:
            box = (x0 * width, y0 * height, x1 * width, y1 * height)
            text = f"{self.get_class_name(label)} {score:.2f}"
            marks.append(Mark(text, true=False, box=box))
        return marks


def _explain_order_error(error: ValueError, output: Sequence[Detections]) -> str:
    """Return why an output shows no order, with its shape or advice.

    Args:
        error: error of `detector_outputs.infer_order`.
        output: detections of N images.
    """
    grids = [detections["grid"] for detections in output if "grid" in detections]
    shape = f"the model's output is {tuple(grids[0].shape)}: " if grids else ""
    has_pairs = any("score_or_label" in detections for detections in output)
    hint = f"; {ORDER_ADVICE}" if has_pairs else ""
    return f"{shape}{error}{hint}"


def _find_class_of_row(detections: Detections, row: int, score: float) -> int:
    """Return the class of a box for which it has a score.

    Args:
        detections: detections of an image.
        row: index of the box.
        score: one of its scores.
    """
    if "labels" in detections:
        return int(detections["labels"][row])
    # The first class with this score. It is equal exactly, since `score` is one of the
    # scores of the box.
    return int((detections["scores"][row] == score).nonzero()[0])


def _select_rows(detections: Detections, is_used: Tensor) -> Detections:
    """Return the detections of an image in some of its rows.

    Args:
        detections: D boxes with their scores.
        is_used: (D,) bool, which of them.
    """
    return {
        # "n_nan_rows" is a count; the others have a row for each box
        name: values if name == "n_nan_rows" else values[is_used]
        for name, values in detections.items()
    }


def _make_missed_match(truth: DetectionTruth, best_score: float) -> ObjectMatch:
    """Return the outcome for an object that no box of sufficient score is about.

    Args:
        truth: truth of the scene.
        best_score: largest score of a right class at the object.
    """
    stored_score = best_score if math.isfinite(best_score) else None  # no JSON NaN
    return ObjectMatch(Outcome.MISSED, truth.labels[0], stored_score)
