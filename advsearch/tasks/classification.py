"""Classification: which class of the model a picture is of. Softmax, argmax and the lead of an answer stand here."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from advsearch.errors import InputError
from advsearch.models import Model, find_label_set
from advsearch.options import FROM_RUN
from advsearch.tasks.base import Answer, Facts, Task

Labels = tuple[int, ...]


@dataclass(frozen=True, kw_only=True)
class Classification(Task):
    """The model's largest logit names the class of the object.

    The truth is the indices of the right classes, of which there may be several ("coffee mug" and "cup").

    Args:
        labels: one name per class; numbers stand in for names that are not there.
        named: False if `labels` are placeholders.
        target: indices of classes; where there are some, only these are a success.

    Raises:
        InputError: there is a target to minimise.
    """

    name = "classification"
    objective = "margin"
    reads_logits = True

    labels: tuple[str, ...] = field(default=(), metadata=FROM_RUN)
    named: bool = field(default=True, metadata=FROM_RUN)
    target: Labels | None = field(default=None, metadata=FROM_RUN)

    def __post_init__(self) -> None:
        if self.target is not None and self.minimise:
            raise InputError("minimise: makes the right answer easier to give; leave `target` out")

    def on(self, model: Model, *, target: str | None = None, minimise: bool = False) -> Classification:
        """See `Task.on`: the target is one of the model's classes, or several.

        Raises:
            InputError: there is no such class, or the model does not answer with logits.
        """
        if model.read is not None:
            raise InputError(
                f"model {model.name}: expected logits, and it was loaded for another task; leave `read` out"
            )
        try:
            wanted = None if target is None else model.label_set(target).indices
        except InputError as error:
            raise InputError(f"target: {error}") from None
        return replace(self, labels=model.labels, named=model.named, target=wanted, minimise=minimise)

    def truth(self, facts: Facts) -> Labels:
        """Return the indices of the right classes: what was said, or else the object's own label.

        Raises:
            InputError: the model has no such class, the object has no label, or a target is right.
        """
        text = facts.own_label if facts.label is None else facts.label
        if text is None:
            raise InputError(f"label: expected the right answers for {facts.object}, got none")
        try:
            right = find_label_set(text, self.labels, named=self.named).indices
        except InputError as error:
            if facts.label is not None:
                raise InputError(f"label: {error}") from None
            raise InputError(f"label: the label of {facts.object} itself does not fit the model ({error})") from None
        both = sorted(set(right) & set(self.target or ()))
        if both:
            raise InputError(f"target: expected classes that are not right answers, got {both}, which `label` has too")
        return right

    def margin(self, output: Tensor, truth: Labels) -> Tensor:
        """See `wrong_lead`."""
        return wrong_lead(output, truth)

    def answers(self, output: Tensor, count: int = 1) -> list[tuple[Answer, ...]]:
        """Return the likeliest classes of each picture; with a count of 1, the first of equal ones."""
        probabilities = output.detach().softmax(dim=1)
        if count == 1:
            indices = probabilities.argmax(dim=1, keepdim=True)
            values = probabilities.gather(1, indices)
        else:
            values, indices = probabilities.topk(min(count, output.shape[1]), dim=1)
        rows = zip(indices.tolist(), values.tolist(), strict=True)
        return [tuple(Answer(self._name(i), i, p) for i, p in zip(*row, strict=True)) for row in rows]

    def truth_names(self, truth: Sequence[int]) -> tuple[str, ...]:
        """Return the names of classes."""
        return tuple(map(self._name, truth))

    def _name(self, index: int) -> str:
        return self.labels[index] if self.labels else f"class {index}"


# ---- logits ---------------------------------------------------------------------------------------------------------


def wrong_lead(logits: Tensor, right: Labels) -> Tensor:
    """Return the largest wrong logit minus the largest right one, (N,): over 0 exactly where the answer is wrong.

    Raises:
        InputError: as for `members`.
    """
    inside = members(logits, right)
    return largest(logits, ~inside) - largest(logits, inside)


def target_lead(logits: Tensor, targets: Labels) -> Tensor:
    """Return the largest logit of the targets minus the largest other one, (N,): over 0 exactly where one is answered.

    Raises:
        InputError: as for `members`.
    """
    inside = members(logits, targets, "target")
    return largest(logits, inside) - largest(logits, ~inside)


def members(logits: Tensor, labels: Labels, setting: str = "label") -> Tensor:
    """Return (C,) bool, true for the classes of a label set; checks the logits and the labels.

    Args:
        logits: (N, C).
        labels: class indices.
        setting: what an error names.

    Raises:
        InputError: logits of another shape, no index, one out of range, or all classes.
    """
    if logits.ndim != 2:
        raise InputError(f"model output: expected logits of shape (N, classes), got {tuple(logits.shape)}")
    classes = logits.shape[1]
    if not labels or not all(0 <= label < classes for label in labels):
        raise InputError(f"{setting}: expected class indices from 0 to {classes - 1}, got {tuple(labels)}")
    found = torch.zeros(classes, dtype=torch.bool, device=logits.device)
    found[list(labels)] = True
    if bool(found.all()):
        outcome = "no answer could be wrong" if setting == "label" else "every answer would be a hit"
        raise InputError(f"{setting}: the label set holds all {classes} classes, so {outcome}")
    return found


def largest(logits: Tensor, among: Tensor) -> Tensor:
    """Return the largest logit (N,) of the classes (C,) that are true in `among`; ties share the gradient."""
    return logits.masked_fill(~among, -math.inf).amax(dim=1)
