"""The task of classification, and the base class of tasks with classes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeVar

import torch
from torch import Tensor

from advsearch.errors import InputError
from advsearch.models import Model, find_label_set
from advsearch.models.labels import LabelsOrigin, fit_labels, is_nothing_name
from advsearch.options import FROM_RUN, NOT_A_NUMBER
from advsearch.tasks.base import Facts, Judgement, Output, Prediction, Task

Labels = tuple[int, ...]
ClassTaskType = TypeVar("ClassTaskType", bound="ClassTask")

MISSED_PREFIX = "no "  # prefix of the label of an object that is not found


@dataclass(frozen=True, kw_only=True)
class ClassTask(Task):
    """Base class for tasks whose models predict classes by index.

    Attributes:
        labels: name of each class, or a placeholder such as "class 0".
        has_class_names: whether the labels are names, and no placeholders.
        target: indices of the classes that the search seeks. None for any wrong class.

    Raises:
        InputError: there are both a target and `minimise`.
    """

    labels: tuple[str, ...] = field(default=(), metadata=FROM_RUN)
    has_class_names: bool = field(default=True, metadata=FROM_RUN)
    target: Labels | None = field(default=None, metadata=FROM_RUN)

    def __post_init__(self) -> None:
        if self.target is not None and self.minimise:
            raise InputError("minimise: seeks the right answer; leave `target` out")

    def on(
        self: ClassTaskType,
        model: Model,
        *,
        target: str | None = None,
        minimise: bool = False,
    ) -> ClassTaskType:
        """Return the task for one model, with its labels.

        Args:
            model: model whose outputs the task will evaluate.
            target: one class of the model that it should predict, or several separated
                by commas; None for any wrong one.
            minimise: whether a right prediction is sought.

        Raises:
            InputError: there is no such class, or the model's outputs are not what the
                task reads.
        """
        self._check_output_kind(model)
        labels, named = self._choose_labels(model)
        target_classes = None
        if target is not None:
            target_classes = _find_target_classes(target, labels, named=named)
        return replace(
            self,
            labels=labels,
            has_class_names=named,
            target=target_classes,
            minimise=minimise,
        )

    def _choose_labels(self, model: Model) -> tuple[tuple[str, ...], bool]:
        """Return the labels of a model's classes, and whether they are names."""
        if self.reads_logits:  # a classifier, whose labels were checked when loaded
            return model.labels, model.named
        return self._get_model_labels(model)

    def _check_output_kind(self, model: Model) -> None:
        """Check that a model returns logits if this task reads them, and only then.

        Raises:
            InputError: it was loaded for a task of the other kind.
        """
        # Models that are loaded for other tasks have a function that reads their output.
        returns_logits = model.read is None
        if returns_logits == self.reads_logits:
            return
        if self.reads_logits:
            advice = (
                "it was loaded for another task than classification; set the same "
                "`task` here"
            )
        else:
            advice = f'it was loaded for its logits; load it with task="{self.name}"'
        raise InputError(f"model {model.name}: {advice}")

    def _get_model_labels(self, model: Model) -> tuple[tuple[str, ...], bool]:
        """Return the names of a model's classes, and whether they are real names.

        If the model has no labels, placeholders such as "class 0" are returned. To count
        its classes, the model is run on a gray image.

        Raises:
            InputError: the number of labels is not that of the classes; or there are no
                labels, and the output does not show the number of classes.
        """
        gray_image = torch.full((1, *model.input_size, 3), 0.5)
        with torch.no_grad():
            n_classes = self.count_classes(model(gray_image))
        # Boxes with labels, for example, do not show the number of classes.
        if n_classes is None:
            if not model.labels:
                raise InputError(
                    "labels: expected a file with the names of the classes "
                    f"of model {model.name}, got none"
                )
            return model.labels, True
        # raises if the numbers differ; returns placeholders for None
        labels = fit_labels(n_classes, model.labels or None, LabelsOrigin(), model.name)
        return labels, bool(model.labels)

    def count_classes(self, output: Output) -> int | None:
        """Return the number of classes of an output; None if it does not show it."""
        return None

    def find_right_classes(self, facts: Facts) -> Labels:
        """Return the indices of the right classes.

        They come from the setting `label`, or from the object's own label without it.

        Args:
            facts: ground truth of the object, such as its label.

        Raises:
            InputError: the model has no such class, the object has no label, or a
                target is right.
        """
        text = facts.object_label if facts.label is None else facts.label
        if text is None:
            raise InputError(
                f"label: expected the right labels for {facts.object}, got none"
            )
        right_classes = self._find_classes_of_label(text, facts)
        common_classes = sorted(set(right_classes) & set(self.target or ()))
        if common_classes:
            raise InputError(
                "target: expected classes that are not right labels, got "
                f"{common_classes}, which `label` has too"
            )
        return right_classes

    def _find_classes_of_label(self, text: str, facts: Facts) -> Labels:
        """Return the indices of the classes that a label names.

        Raises:
            InputError: the model has no such class; the message says where the label
                comes from.
        """
        try:
            label_set = find_label_set(text, self.labels, named=self.has_class_names)
        except InputError as error:
            if facts.label is not None:  # from the user
                raise InputError(f"label: {error}") from None
            raise InputError(
                f"label: the label in the file of {facts.object} does not fit "
                f"the model ({error})"
            ) from None
        return label_set.indices

    def check(self, facts: Facts) -> None:
        self.find_right_classes(facts)

    @cached_property
    def background_classes(self) -> Labels:
        """Indices of classes that stand for no object, such as "background".

        They do not count as predictions, unless they are targets.
        """
        if not self.has_class_names:
            return ()
        targets = self.target or ()
        return tuple(
            index
            for index, name in enumerate(self.labels)
            if index not in targets and is_nothing_name(name)
        )

    @property
    def target_names(self) -> tuple[str, ...]:
        return self.get_class_names(self.target or ())

    def get_class_names(self, indices: Sequence[int]) -> tuple[str, ...]:
        """Return the names of classes."""
        return tuple(map(self.get_class_name, indices))

    def get_class_name(self, index: int) -> str:
        """Return the name of a class."""
        return self.labels[index] if index < len(self.labels) else f"class {index}"


def _find_target_classes(
    target: str, labels: tuple[str, ...], *, named: bool
) -> Labels:
    """Return the indices of the classes that a target names.

    Args:
        target: one class, or several separated by commas.
        labels: labels of the model.
        named: whether these are names, and no placeholders.

    Raises:
        InputError: there is no such class.
    """
    try:
        return find_label_set(target, labels, named=named).indices
    except InputError as error:
        raise InputError(f"target: {error}") from None


@dataclass(frozen=True, kw_only=True)
class Classification(ClassTask):
    """Judge whether the largest logit is that of a right class.

    The truth is the indices of the right classes, of which there may be several
    ("coffee mug" and "cup").
    """

    name = "classification"
    objective = "margin"
    reads_logits = True

    def truth(self, facts: Facts) -> Labels:
        return self.find_right_classes(facts)

    def as_logits(self, output: Tensor, truth: Labels) -> Tensor:
        """Return logits in which classes such as "background" can't be predicted.

        Their logits become minus infinity. Such a class is not excluded if it is right,
        and none is if only classes like this could be wrong.

        Args:
            output: logits (N, classes).
            truth: indices of the right classes; empty if they are unknown.
        """
        excluded = set(self.background_classes) - set(truth)
        n_classes = output.shape[1]
        n_right = max(1, len(truth))  # if the truth is unknown, at least one is right
        n_other_wrong_classes = n_classes - n_right - len(excluded)
        if not excluded or n_other_wrong_classes <= 0:
            return output
        indices = torch.tensor(sorted(excluded), device=output.device)
        return output.index_fill(1, indices, -math.inf)

    def loss(self, output: Tensor, truth: Labels) -> Tensor:
        return compute_misclassification_margin(self.as_logits(output, truth), truth)

    def score(self, output: Tensor, truth: Labels) -> Tensor:
        if self.target is not None:
            return compute_target_margin(self.as_logits(output, truth), self.target)
        return super().score(output, truth)

    def predictions(
        self, output: Tensor, count: int = 1
    ) -> list[tuple[Prediction, ...]]:
        """Return the `count` most probable classes of each image.

        With a count of 1, of equally probable classes it is the one with the lowest
        index.
        """
        return self._rank_classes(self.as_logits(output, ()), count)

    def _rank_classes(self, logits: Tensor, count: int) -> list[tuple[Prediction, ...]]:
        """Return the `count` most probable classes of each row of logits (N, classes).

        A row with NaN has the only prediction `NOT_A_NUMBER`.
        """
        top_probabilities, top_classes = _select_top_classes(logits.detach(), count)
        predictions_of_images: list[tuple[Prediction, ...]] = []
        for classes, probabilities in zip(
            top_classes.tolist(), top_probabilities.tolist(), strict=True
        ):
            has_nan_logits = not math.isfinite(probabilities[0])
            if has_nan_logits:
                predictions_of_images.append((Prediction(NOT_A_NUMBER),))
            else:
                predictions = self._make_predictions(
                    classes, probabilities, is_single=count == 1
                )
                predictions_of_images.append(predictions)
        return predictions_of_images

    def _make_predictions(
        self, classes: Sequence[int], probabilities: Sequence[float], *, is_single: bool
    ) -> tuple[Prediction, ...]:
        """Return the predictions of the most probable classes of an image.

        Classes that `as_logits` excludes have a probability of 0, and are left out. But
        a single prediction is always returned.

        Args:
            classes: indices of the classes, the most probable first.
            probabilities: their probabilities.
            is_single: whether a single prediction is requested.
        """
        return tuple(
            Prediction(self.get_class_name(class_id), class_id, probability)
            for class_id, probability in zip(classes, probabilities, strict=True)
            if probability > 0.0 or is_single
        )

    def judge(self, output: Tensor, truth: Labels) -> list[Judgement]:
        """Judge each of N outputs.

        The result is that of `Task.judge`, but the logits are computed only once. If a
        subclass overrides `loss` or `score`, these methods are called.

        Args:
            output: logits (N, classes).
            truth: indices of the right classes.
        """
        logits = self.as_logits(output, truth)
        overrides_loss = type(self).loss is not Classification.loss  # in a subclass
        if overrides_loss:
            losses = self.loss(output, truth)
        else:
            # over 0 for a wrong prediction, as losses are
            losses = compute_misclassification_margin(logits, truth)
        scores = self._compute_scores_from(losses, output, truth)
        # A judgement's margin is over 0 for a right prediction. `-losses` would be -0.0
        # for 0.
        margins = 0.0 - losses
        # one prediction for each image
        predictions = [top for (top,) in self._rank_classes(logits, count=1)]
        rows = zip(scores.tolist(), margins.tolist(), predictions, strict=True)
        return [Judgement.from_margin(*row) for row in rows]

    def _compute_scores_from(
        self, losses: Tensor, output: Tensor, truth: Labels
    ) -> Tensor:
        """Return the scores (N,) of outputs whose losses (N,) are known.

        They follow from the losses, as in `Task.score`. But if there is a target, or a
        subclass overrides `score`, that method is called.
        """
        overrides_score = type(self).score is not Classification.score
        if overrides_score or self.target is not None:
            return self.score(output, truth)
        return -losses if self.minimise else losses

    def truth_names(self, truth: Sequence[int]) -> tuple[str, ...]:
        return self.get_class_names(truth)


def _select_top_classes(logits: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return probabilities and indices of the most probable classes, (N, count) each.

    Args:
        logits: (N, classes).
        count: number of classes, if there are as many.
    """
    probabilities = logits.softmax(dim=1)
    # For a single class `argmax` is used: of several largest values it returns the
    # first, but `topk` any of them.
    if count == 1:
        top_classes = probabilities.argmax(dim=1, keepdim=True)
        return probabilities.gather(1, top_classes), top_classes
    top = probabilities.topk(min(count, logits.shape[1]), dim=1)
    return top.values, top.indices


# ---- logits ----


def compute_misclassification_margin(logits: Tensor, right: Labels) -> Tensor:
    """Compute the largest wrong logit minus the largest right one, (N,).

    It is over 0 if the prediction is wrong, and below 0 if it is right; 0 at a tie.

    Raises:
        InputError: as for `make_class_mask`.
    """
    is_right = make_class_mask(logits, right)
    return compute_largest_logit(logits, ~is_right) - compute_largest_logit(
        logits, is_right
    )


def compute_target_margin(logits: Tensor, targets: Labels) -> Tensor:
    """Compute the largest logit of the targets minus the largest other one, (N,).

    It is over 0 if a target is predicted, and below 0 if not; 0 at a tie.

    Raises:
        InputError: as for `make_class_mask`.
    """
    is_target = make_class_mask(logits, targets, "target")
    return compute_largest_logit(logits, is_target) - compute_largest_logit(
        logits, ~is_target
    )


def make_class_mask(
    logits: Tensor, labels: Labels | Tensor, setting: str = "label"
) -> Tensor:
    """Return which classes are in a label set, (C,) bool.

    Args:
        logits: (N, C), to which the mask belongs.
        labels: indices of the classes in the set, the same for all N rows.
        setting: name of the setting with the labels, for messages.

    Raises:
        InputError: the logits have another shape, an index is out of range, or the set
            has no class or all classes.
    """
    if logits.ndim != 2:
        raise InputError(
            "model output: expected logits of shape (N, classes), got "
            f"{tuple(logits.shape)}"
        )
    n_classes = logits.shape[1]
    if isinstance(labels, Tensor):
        labels = tuple(dict.fromkeys(labels.flatten().tolist()))
    _check_class_indices(labels, n_classes, setting)
    is_member = torch.zeros(n_classes, dtype=torch.bool, device=logits.device)
    is_member[list(labels)] = True
    if bool(is_member.all()):
        raise _make_all_classes_error(setting, n_classes)
    return is_member


def _check_class_indices(labels: Labels, n_classes: int, setting: str) -> None:
    """Raise InputError if a label set is empty, or an index is out of range."""
    if not labels or not all(0 <= label < n_classes for label in labels):
        raise InputError(
            f"{setting}: expected class indices from 0 to {n_classes - 1}, "
            f"got {tuple(labels)}"
        )


def _make_all_classes_error(setting: str, n_classes: int) -> InputError:
    """Return the error of a setting whose labels are all classes of the model."""
    if setting == "label":
        consequence = "no prediction could be wrong"
    else:
        consequence = "every prediction would be a success"
    return InputError(
        f"{setting}: the label set holds all {n_classes} classes, so {consequence}"
    )


def compute_largest_logit(logits: Tensor, class_mask: Tensor) -> Tensor:
    """Return the largest logit (N,) of the classes (C,) that are true in `class_mask`.

    Ties share the gradient.
    """
    return logits.masked_fill(~class_mask, -math.inf).amax(dim=1)
