"""Classification: which class of the model a picture is of. Softmax, argmax and the lead of an answer stand here."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from advsearch.described import NOT_A_NUMBER
from advsearch.errors import InputError
from advsearch.tasks.base import Answer, Facts, Judgement
from advsearch.tasks.classes import ClassTask, Labels


@dataclass(frozen=True, kw_only=True)
class Classification(ClassTask):
    """The model's largest logit names the class of the object.

    The truth is the indices of the right classes, of which there may be several ("coffee mug" and "cup").
    """

    name = "classification"
    objective = "margin"
    reads_logits = True

    def truth(self, facts: Facts) -> Labels:
        """See `ClassTask.right_classes`."""
        return self.right_classes(facts)

    def answerable(self, output: Tensor, truth: Labels) -> Tensor:
        """See `Task.answerable`: a class that stands for no thing has a logit of minus infinity, unless it is right or
        there is no other wrong one."""
        nothing = set(self.nothing) - set(truth)
        if not nothing or len(nothing) + max(1, len(truth)) >= output.shape[1]:
            return output
        return output.index_fill(1, torch.tensor(sorted(nothing), device=output.device), -math.inf)

    def margin(self, output: Tensor, truth: Labels) -> Tensor:
        """See `wrong_lead`."""
        return wrong_lead(self.answerable(output, truth), truth)

    def score(self, output: Tensor, truth: Labels) -> Tensor:
        """See `Task.score`."""
        if self.target is not None:
            return target_lead(self.answerable(output, truth), self.target)
        return super().score(output, truth)

    def answers(self, output: Tensor, count: int = 1) -> list[tuple[Answer, ...]]:
        """Return the likeliest classes of each picture; with a count of 1, the first of equal ones."""
        return self._likeliest(self.answerable(output, ()), count)

    def _likeliest(self, output: Tensor, count: int) -> list[tuple[Answer, ...]]:
        probabilities = output.detach().softmax(dim=1)
        if count == 1:
            indices = probabilities.argmax(dim=1, keepdim=True)
            values = probabilities.gather(1, indices)
        else:
            values, indices = probabilities.topk(min(count, output.shape[1]), dim=1)
        found = []
        for row in zip(indices.tolist(), values.tolist(), strict=True):
            listed = [Answer(self.name_of(i), i, p) for i, p in zip(*row, strict=True) if p > 0.0 or count == 1]
            found.append(tuple(listed) if math.isfinite(row[1][0]) else (Answer(NOT_A_NUMBER),))
        return found

    def judge(self, output: Tensor, truth: Labels) -> list[Judgement]:
        """See `Task.judge`."""
        scores, margins = self.score(output, truth).tolist(), self.margin(output, truth).tolist()
        answers = self._likeliest(self.answerable(output, truth), 1)
        rows = zip(scores, margins, answers, strict=True)
        return [Judgement.of(score, margin, first) for score, margin, (first,) in rows]

    def truth_names(self, truth: Sequence[int]) -> tuple[str, ...]:
        """Return the names of classes."""
        return self.names(truth)


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


def members(logits: Tensor, labels: Labels | Tensor, setting: str = "label") -> Tensor:
    """Return (C,) bool, true for the classes of a label set; checks the logits and the labels.

    Args:
        logits: (N, C).
        labels: class indices, which are right for all N.
        setting: what an error names.

    Raises:
        InputError: logits of another shape, no index, one out of range, or all classes.
    """
    if logits.ndim != 2:
        raise InputError(f"model output: expected logits of shape (N, classes), got {tuple(logits.shape)}")
    classes = logits.shape[1]
    labels = tuple(dict.fromkeys(labels.flatten().tolist())) if isinstance(labels, Tensor) else labels
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
