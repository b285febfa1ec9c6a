"""Tasks whose models know classes by number, and the plainest of them: which class a
picture is of.

Names of classes, softmax, argmax and the lead of a prediction stand here.
"""

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
from advsearch.models.labels import LabelsOrigin, fitting_labels, names_nothing
from advsearch.options import FROM_RUN, NOT_A_NUMBER
from advsearch.tasks.base import Facts, Judgement, Output, Prediction, Task

Labels = tuple[int, ...]
Own = TypeVar("Own", bound="ClassTask")

NO = "no "  # how a prediction says that the object is not found


@dataclass(frozen=True, kw_only=True)
class ClassTask(Task):
    """A task whose model knows classes by number. Raises InputError: there is a target
    to minimise.
    """

    # one name per class, or a placeholder
    labels: tuple[str, ...] = field(default=(), metadata=FROM_RUN)
    named: bool = field(default=True, metadata=FROM_RUN)
    # where there are some, only these are a success
    target: Labels | None = field(default=None, metadata=FROM_RUN)

    def __post_init__(self) -> None:
        if self.target is not None and self.minimise:
            raise InputError(
                "minimise: makes the right answer easier to give; leave `target` out"
            )

    def on(
        self: Own, model: Model, *, target: str | None = None, minimise: bool = False
    ) -> Own:
        """See `Task.on`: the target is one of the model's classes, or several. Raises
        InputError where there is no such class, or the model's outputs are not what the
        task reads.
        """
        if self.reads_logits != (model.read is None):
            other = f'it was loaded for its logits; load it with task="{self.name}"'
            if self.reads_logits:
                other = (
                    "it was loaded for another task than classification; give the "
                    "same `task` here"
                )
            raise InputError(f"model {model.name}: {other}")
        labels, named = (
            (model.labels, model.named) if self.reads_logits else self._names(model)
        )
        try:
            wanted = (
                None
                if target is None
                else find_label_set(target, labels, named=named).indices
            )
        except InputError as error:
            raise InputError(f"target: {error}") from None
        return replace(
            self, labels=labels, named=named, target=wanted, minimise=minimise
        )

    def _names(self, model: Model) -> tuple[tuple[str, ...], bool]:
        """The names of the classes that a model predicts, and whether they are
        names.
        """
        with torch.no_grad():
            count = self.classes_in(model(torch.full((1, *model.input_size, 3), 0.5)))
        given = model.labels or None
        if count is None and given is None:
            raise InputError(
                "labels: expected a file with the names of the classes "
                f"of model {model.name}, got none"
            )
        return (
            model.labels
            if count is None
            else fitting_labels(count, given, LabelsOrigin(), model.name)
        ), given is not None

    def classes_in(self, output: Output) -> int | None:
        """Return how many classes an output is of; None where it does not show that."""
        return None

    def right_classes(self, facts: Facts) -> Labels:
        """Return the indices of the right classes: what was said, or else the object's
        own label. Raises InputError where the model has no such class, the object has
        no label, or a target is right.
        """
        text = facts.own_label if facts.label is None else facts.label
        if text is None:
            raise InputError(
                f"label: expected the right labels for {facts.object}, got none"
            )
        try:
            right = find_label_set(text, self.labels, named=self.named).indices
        except InputError as error:
            if facts.label is not None:
                raise InputError(f"label: {error}") from None
            raise InputError(
                f"label: the label of {facts.object} itself does not fit "
                f"the model ({error})"
            ) from None
        both = sorted(set(right) & set(self.target or ()))
        if both:
            raise InputError(
                "target: expected classes that are not right labels, got "
                f"{both}, which `label` has too"
            )
        return right

    def check(self, facts: Facts) -> None:
        self.right_classes(facts)

    @cached_property
    def nothing(self) -> Labels:
        """Indices of classes that stand for no thing, such as "background", but for
        what is sought: no predictions.
        """
        if not self.named:
            return ()
        sought = self.target or ()
        return tuple(
            k
            for k, name in enumerate(self.labels)
            if k not in sought and names_nothing(name)
        )

    @property
    def target_names(self) -> tuple[str, ...]:
        return self.names(self.target or ())

    def names(self, indices: Sequence[int]) -> tuple[str, ...]:
        """Return the names of classes."""
        return tuple(map(self.name_of, indices))

    def name_of(self, index: int) -> str:
        """Return the name of a class."""
        return self.labels[index] if index < len(self.labels) else f"class {index}"


@dataclass(frozen=True, kw_only=True)
class Classification(ClassTask):
    """The model's largest logit names the class of the object.

    The truth is the indices of the right classes, of which there may be several
    ("coffee mug" and "cup").
    """

    name = "classification"
    objective = "margin"
    reads_logits = True

    def truth(self, facts: Facts) -> Labels:
        return self.right_classes(facts)

    def as_logits(self, output: Tensor, truth: Labels) -> Tensor:
        """See `Task.as_logits`: a class that stands for no thing has a logit of minus
        infinity, unless it is right or there is no other wrong one.
        """
        nothing = set(self.nothing) - set(truth)
        if not nothing or len(nothing) + max(1, len(truth)) >= output.shape[1]:
            return output
        return output.index_fill(
            1, torch.tensor(sorted(nothing), device=output.device), -math.inf
        )

    def loss(self, output: Tensor, truth: Labels) -> Tensor:
        return wrong_lead(self.as_logits(output, truth), truth)

    def score(self, output: Tensor, truth: Labels) -> Tensor:
        if self.target is not None:
            return target_lead(self.as_logits(output, truth), self.target)
        return super().score(output, truth)

    def predictions(
        self, output: Tensor, count: int = 1
    ) -> list[tuple[Prediction, ...]]:
        """Return the likeliest classes of each picture; with a count of 1, the first of
        equal ones.
        """
        return self._likeliest(self.as_logits(output, ()), count)

    def _likeliest(self, output: Tensor, count: int) -> list[tuple[Prediction, ...]]:
        probabilities = output.detach().softmax(dim=1)
        if count == 1:
            indices = probabilities.argmax(dim=1, keepdim=True)
            values = probabilities.gather(1, indices)
        else:
            values, indices = probabilities.topk(min(count, output.shape[1]), dim=1)
        found = []
        for row in zip(indices.tolist(), values.tolist(), strict=True):
            listed = [
                Prediction(self.name_of(i), i, p)
                for i, p in zip(*row, strict=True)
                if p > 0.0 or count == 1
            ]
            found.append(
                tuple(listed)
                if math.isfinite(row[1][0])
                else (Prediction(NOT_A_NUMBER),)
            )
        return found

    def judge(self, output: Tensor, truth: Labels) -> list[Judgement]:
        logits = self.as_logits(output, truth)
        own = type(self)
        losses = (
            wrong_lead(logits, truth)
            if own.loss is Classification.loss
            else self.loss(output, truth)
        )
        if own.score is not Classification.score or self.target is not None:
            scores = self.score(output, truth)
        else:
            scores = -losses if self.minimise else losses
        rows = zip(
            scores.tolist(),
            (0.0 - losses).tolist(),
            self._likeliest(logits, 1),
            strict=True,
        )
        return [Judgement.of(score, margin, first) for score, margin, (first,) in rows]

    def truth_names(self, truth: Sequence[int]) -> tuple[str, ...]:
        return self.names(truth)


# ---- logits
# ---------------------------------------------------------------------------------------------------------


def wrong_lead(logits: Tensor, right: Labels) -> Tensor:
    """Return the largest wrong logit minus the largest right one, (N,): over 0 exactly
    where the prediction is wrong. Raises InputError as for `members`.
    """
    inside = members(logits, right)
    return logits.masked_fill(inside, -math.inf).amax(dim=1) - logits.masked_fill(
        ~inside, -math.inf
    ).amax(dim=1)


def target_lead(logits: Tensor, targets: Labels) -> Tensor:
    """Return the largest logit of the targets minus the largest other one, (N,): over 0
    exactly where one is predicted. Raises InputError as for `members`.
    """
    inside = members(logits, targets, "target")
    return logits.masked_fill(~inside, -math.inf).amax(dim=1) - logits.masked_fill(
        inside, -math.inf
    ).amax(dim=1)


def members(logits: Tensor, labels: Labels | Tensor, setting: str = "label") -> Tensor:
    """Return (C,) bool, true for the classes of a label set; checks the logits (N, C)
    and the labels, which are right for all N. Raises InputError, which names the
    setting: logits of another shape, no index, one out of range, or all classes.
    """
    if logits.ndim != 2:
        raise InputError(
            "model output: expected logits of shape (N, classes), got "
            f"{tuple(logits.shape)}"
        )
    classes = logits.shape[1]
    labels = (
        tuple(dict.fromkeys(labels.flatten().tolist()))
        if isinstance(labels, Tensor)
        else labels
    )
    if not labels or not all(0 <= label < classes for label in labels):
        raise InputError(
            f"{setting}: expected class indices from 0 to {classes - 1}, "
            f"got {tuple(labels)}"
        )
    found = torch.zeros(classes, dtype=torch.bool, device=logits.device)
    found[list(labels)] = True
    if bool(found.all()):
        outcome = (
            "no prediction could be wrong"
            if setting == "label"
            else "every prediction would be a hit"
        )
        raise InputError(
            f"{setting}: the label set holds all {classes} classes, so {outcome}"
        )
    return found


def largest(logits: Tensor, among: Tensor) -> Tensor:
    """Return the largest logit (N,) of the classes (C,) that are true in `among`; ties
    share the gradient.
    """
    return logits.masked_fill(~among, -math.inf).amax(dim=1)
