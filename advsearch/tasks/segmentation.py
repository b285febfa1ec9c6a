"""Task for semantic segmentation: do the object's pixels get a right class?"""

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
    "under 'out' or 'logits'"
)

# Minimum fraction of right pixels at which the object is segmented in part.
MIN_PARTIAL_ACCURACY = 0.1

# From logits (P, classes) and labels to the margin (P,) of these classes.
PixelMargin = Callable[[Tensor, tasks.Labels], Tensor]


@dataclass(frozen=True)
class SegmentationTruth:
    """The truth of segmentation: the object in an image.

    Attributes:
        labels: indices of the right classes.
        mask: (H, W) bool, the pixels in which the object is visible.
    """

    labels: tasks.Labels
    mask: Tensor

    def resize_mask(self, size: tuple[int, int]) -> Tensor:
        """Resize the mask to the size of an output, (h, w) bool.

        A pixel belongs to the object if the object covers at least half of it. A small
        object may cover no pixel by half; then all pixels that it touches belong to it.
        """
        if self.mask.shape == size:
            return self.mask
        mask = self.mask[None, None].float()
        fraction = F.interpolate(mask, size=size, mode="area")[0, 0]
        is_half_covered = fraction >= 0.5
        return is_half_covered if bool(is_half_covered.any()) else fraction > 0.0


@dataclass(frozen=True, kw_only=True)
class Segmentation(tasks.ClassTask):
    """Judge whether at least `accuracy` of the object's pixels get a right class.

    Other pixels do not count. If the object is out of view there is nothing to segment,
    and every prediction is right.

    Raises:
        InputError: `accuracy` is no fraction between 0 and 1.
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
        """Read the logits (N, classes, h, w) from what a network returned.

        They are the tensor itself, the first of a sequence, the attribute "logits" (as
        in Hugging Face's models), or the item "out" (as in torchvision's) or "logits".

        Raises:
            ValueError: there are no logits of `count` images.
        """
        logits = _find_pixel_logits(returned)
        if (
            not isinstance(logits, Tensor)
            or logits.ndim != 4
            or len(logits) != count
            or logits.shape[1] < 2  # with a single class nothing could be wrong
        ):
            raise ValueError(EXPECTED)
        return logits.float()

    def count_classes(self, output: Tensor) -> int:
        return output.shape[1]

    def truth(self, facts: tasks.Facts) -> SegmentationTruth:
        return SegmentationTruth(self.find_right_classes(facts), facts.mask)

    def truth_names(self, truth: SegmentationTruth) -> tuple[str, ...]:
        return self.get_class_names(truth.labels)

    def loss(self, output: Tensor, truth: SegmentationTruth) -> Tensor:
        """Compute the margin at the pixel that decides about the object, in logits, (N,).

        The margin of a pixel is its largest wrong logit minus its largest right one. The
        pixel is chosen so that the loss is over 0 if and only if fewer than `accuracy`
        of the object's pixels are right (`_compute_deciding_margin`).
        """
        return self._compute_deciding_margin(
            output, truth, tasks.compute_misclassification_margin, truth.labels
        )

    def score(self, output: Tensor, truth: SegmentationTruth) -> Tensor:
        """Compute how near each output is to what is sought, (N,), over 0 for a success.

        With a target, a success is that at least a fraction `accuracy` of the object's
        pixels gets a target class.
        """
        if self.target is None:
            return super().score(output, truth)
        # At most 0 if enough pixels get a target class, and over 0 otherwise: a loss, as if
        # the target were the truth.
        target_loss = self._compute_deciding_margin(
            output, truth, _compute_target_shortfall, self.target
        )
        return -target_loss

    def pixel_margin(self, output: Tensor, truth: SegmentationTruth) -> Tensor:
        """Compute the mean margin over the object's pixels, in logits, (N,).

        The margin is by how much the best wrong class (or the best class of the target)
        exceeds the best other class; with `minimise` the sign is reversed. All pixels
        have a gradient here, while `loss` has one at the deciding pixel only.
        """
        pixels = self._select_object_logits(output, truth)
        if pixels is None:
            return _make_hidden_value(output)
        if self.target is None:
            margin = tasks.compute_misclassification_margin(pixels, truth.labels)
        else:
            margin = tasks.compute_target_margin(pixels, self.target)
        mean_margin = margin.reshape(len(output), -1).mean(dim=1)
        return -mean_margin if self.minimise else mean_margin

    def _compute_deciding_margin(
        self,
        output: Tensor,
        truth: SegmentationTruth,
        compute_margin: PixelMargin,
        labels: tasks.Labels,
    ) -> Tensor:
        """Compute the margin (N,) at the deciding pixel of the object.

        The object's pixels are sorted by margin, in ascending order. The deciding pixel
        is the last one of the first fraction `accuracy` of them, such as pixel 80 of
        100 for 0.8. So its margin is at most 0 exactly if enough pixels have a margin
        of at most 0. Here margins are like losses: at most 0 for a right pixel. The
        result is NaN if a margin is not finite, and -1 (a right prediction) if the object
        is out of view.

        Args:
            output: logits (N, classes, h, w).
            truth: truth of the scene.
            compute_margin: returns the margins of pixels from their logits (N * P,
                classes) and the labels.
            labels: classes that the margin is about.
        """
        pixels = self._select_object_logits(output, truth)
        if pixels is None:
            return _make_hidden_value(output)
        margins = compute_margin(pixels, labels).reshape(len(output), -1)  # (N, P)
        rank = math.ceil(self.accuracy * margins.shape[1])
        deciding_margin = margins.kthvalue(rank, dim=1).values
        return torch.where(margins.isfinite().all(dim=1), deciding_margin, math.nan)

    @staticmethod
    def _select_object_logits(
        output: Tensor, truth: SegmentationTruth
    ) -> Tensor | None:
        """Select the logits of the object's pixels, image by image, (N * P, classes).

        None if the object is out of view.
        """
        mask = truth.resize_mask((output.shape[2], output.shape[3])).to(output.device)
        selected = output.permute(0, 2, 3, 1)[:, mask]
        is_out_of_view = selected.shape[1] == 0
        return None if is_out_of_view else selected.reshape(-1, output.shape[1])

    def predictions(
        self, output: Tensor, count: int = 1
    ) -> list[tuple[tasks.Prediction, ...]]:
        """Return the most frequent classes of the pixels of each image, with their
        fractions of the image.
        """
        return [self._rank_classes(logits, count) for logits in output.detach()]

    def _rank_classes(self, logits: Tensor, count: int) -> tuple[tasks.Prediction, ...]:
        """Return the `count` most frequent classes of the pixels of an image.

        Classes that stand for nothing, such as "background", are left out. If there are
        no others, the prediction is "nothing".

        Args:
            logits: (classes, h, w), without a graph.
            count: how many; there may be fewer.
        """
        # A network may exclude a class with a logit of minus infinity. Pixels with any
        # other logit that is not finite are left out.
        is_number = (logits.isfinite() | (logits == -math.inf)).all(dim=0)
        class_of_pixel = logits[:, is_number].argmax(dim=0)
        counts = class_of_pixel.bincount(minlength=len(logits))
        counts[list(self.background_classes)] = 0
        predictions = self._list_frequent_classes(counts, logits[0].numel(), count)
        if predictions:
            return predictions
        has_any_number = len(class_of_pixel) > 0
        label = "nothing" if has_any_number else tasks.NOT_A_NUMBER
        return (tasks.Prediction(label),)

    def _list_frequent_classes(
        self, counts: Tensor, n_pixels: int, count: int
    ) -> tuple[tasks.Prediction, ...]:
        """Return the `count` most frequent classes that have any pixel.

        Args:
            counts: number of pixels with each class, (classes,).
            n_pixels: number of all pixels, of which a class has a fraction.
            count: how many; there may be fewer.
        """
        top_counts, top_classes = counts.topk(min(count, len(counts)))
        ranked = zip(top_classes.tolist(), top_counts.tolist(), strict=True)
        return tuple(
            tasks.Prediction(
                self.get_class_name(class_id), class_id, n_class / n_pixels
            )
            for class_id, n_class in ranked
            if n_class
        )

    def describe(
        self, output: Tensor, truth: SegmentationTruth, margins: Sequence[float]
    ) -> list[tasks.PredictionWithPayload]:
        """Return the prediction about the object in each image, and a payload.

        Args:
            output: logits (N, classes, h, w).
            truth: truth of the scene.
            margins: margin of each image; at least 0 if it is right.
        """
        mask = truth.resize_mask((output.shape[2], output.shape[3])).to(output.device)
        return [
            self._describe_image(logits, truth, mask, is_right=margin >= 0.0)
            for logits, margin in zip(output, margins, strict=True)
        ]

    def _describe_image(
        self, logits: Tensor, truth: SegmentationTruth, mask: Tensor, *, is_right: bool
    ) -> tasks.PredictionWithPayload:
        """Return the prediction about the object in an image, and a payload.

        The prediction is the class of most of its pixels (`_describe_object`). The
        payload has the outcome, the fraction of the object's pixels that are right, the
        fraction of them with each class, and the intersection over union.

        Args:
            logits: (classes, h, w).
            truth: truth of the scene.
            mask: (h, w) bool, the object's pixels.
            is_right: whether enough of the object's pixels are right.
        """
        # (P, classes) of the object's pixels, from a batch with this image only
        pixels = self._select_object_logits(logits[None], truth)
        if pixels is None:
            return tasks.Prediction(tasks.OUT_OF_VIEW), None
        # (h, w) which pixels of the full image have a right class
        is_right_class = self._find_right_pixels(logits, truth)
        accuracy = float(is_right_class[mask].float().mean())
        iou = float((is_right_class & mask).sum() / (is_right_class | mask).sum())
        counts = pixels.argmax(dim=1).bincount(minlength=pixels.shape[1])
        prediction, outcome = self._describe_object(
            counts, truth, accuracy, is_right=is_right
        )
        return prediction, {
            tasks.OUTCOME: outcome.value,
            "accuracy": round(accuracy, 4),
            "iou": round(iou, 4),
            "pixels": self._compute_class_fractions(counts, len(pixels)),
        }

    def _compute_class_fractions(
        self, counts: Tensor, n_pixels: int
    ) -> dict[str, tasks.JsonValue]:
        """Return the fraction of the pixels by name of each class that has any.

        Args:
            counts: pixels by class, (classes,).
            n_pixels: number of pixels in all.
        """
        return {
            self.get_class_name(class_id): round(class_count / n_pixels, 4)
            for class_id, class_count in enumerate(counts.tolist())
            if class_count
        }

    def _describe_object(
        self,
        counts: Tensor,
        truth: SegmentationTruth,
        accuracy: float,
        *,
        is_right: bool,
    ) -> tuple[tasks.Prediction, tasks.Outcome]:
        """Return the prediction about the object, and its outcome.

        If enough pixels are right, the prediction is the most frequent right class.
        Otherwise it is the most frequent wrong class. But if that class stands for
        background, the prediction is the name of the object: "no bottle" (missed), or
        "bottle in part" (loose) if at least `MIN_PARTIAL_ACCURACY` of its pixels are
        right.

        Args:
            counts: number of the object's pixels with each class, (classes,).
            truth: truth of the image.
            accuracy: fraction of the object's pixels that are right. It is stored as
                the probability of the prediction.
            is_right: whether enough of them are right.
        """
        # right classes if the object is right, otherwise wrong classes
        top_class = _find_top_class(counts, truth.labels, is_right=is_right)
        if is_right or top_class not in self.background_classes:
            class_name = self.get_class_name(top_class)
            prediction = tasks.Prediction(class_name, top_class, accuracy)
            outcome = tasks.Outcome.FOUND if is_right else tasks.Outcome.WRONG_CLASS
            return prediction, outcome
        return self._describe_as_background(truth, accuracy)

    def _describe_as_background(
        self, truth: SegmentationTruth, accuracy: float
    ) -> tuple[tasks.Prediction, tasks.Outcome]:
        """Return the prediction and outcome for an object that is taken for background.

        Args:
            truth: truth of the image.
            accuracy: fraction of the object's pixels that are right.
        """
        name = self.get_class_name(truth.labels[0])
        if accuracy >= MIN_PARTIAL_ACCURACY:
            prediction = tasks.Prediction(f"{name} in part", None, accuracy)
            return prediction, tasks.Outcome.LOOSE
        prediction = tasks.Prediction(f"{tasks.MISSED_PREFIX}{name}", None, accuracy)
        return prediction, tasks.Outcome.MISSED

    @staticmethod
    def _find_right_pixels(logits: Tensor, truth: SegmentationTruth) -> Tensor:
        """Return which pixels of the full image get a right class, (h, w) bool.

        A tie with a wrong class is right, and NaN is not.

        Args:
            logits: (classes, h, w) logits of the image.
            truth: truth of the image.
        """
        n_classes = logits.shape[0]
        pixels = logits.permute(1, 2, 0).reshape(-1, n_classes)
        is_right = tasks.compute_misclassification_margin(pixels, truth.labels) <= 0.0
        return is_right.reshape(logits.shape[1:])

    def marks(self, output: Tensor, truth: SegmentationTruth) -> list[list[tasks.Mark]]:
        """Return what is drawn: the object, and the pixels that get a right class."""
        name = " or ".join(self.get_class_names(truth.labels))
        true_mark = tasks.Mark(name, True, mask=truth.mask)
        return [
            [
                true_mark,
                tasks.Mark(name, False, mask=self._find_right_pixels(logits, truth)),
            ]
            for logits in output.detach()
        ]


def _find_pixel_logits(returned: Any) -> Any:
    """Find the logits in what a network returned; anything else if there are none."""
    if isinstance(returned, Mapping):
        return returned.get("out", returned.get("logits"))
    if hasattr(returned, "logits"):
        return returned.logits
    if isinstance(returned, (list, tuple)) and returned:
        return returned[0]
    return returned


def _compute_target_shortfall(logits: Tensor, labels: tasks.Labels) -> Tensor:
    """Compute the largest other logit minus the largest one of the target, (P,).

    Like the margin of wrong classes, it is at most 0 at pixels that get the requested
    class.
    """
    return -tasks.compute_target_margin(logits, labels)


def _find_top_class(counts: Tensor, labels: tasks.Labels, *, is_right: bool) -> int:
    """Return the most frequent class of pixels, among the right ones or the wrong ones.

    Args:
        counts: number of pixels with each class, (classes,).
        labels: indices of the right classes.
        is_right: whether to look among the right classes.
    """
    is_right_class = torch.zeros_like(counts, dtype=torch.bool)
    is_right_class[list(labels)] = True
    is_candidate = is_right_class if is_right else ~is_right_class
    # Other classes come last with a count of -1, even after classes without pixels.
    return int(counts.masked_fill(~is_candidate, -1).argmax())


def _make_hidden_value(output: Tensor) -> Tensor:
    """Return -1, a right prediction, for each of N images without the object, (N,).

    The values are attached to the graph of the output.
    """
    return output.sum(dim=(1, 2, 3)) * 0.0 - 1.0
