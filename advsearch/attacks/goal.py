"""What a search is for: which answers of the model count as success. Not what it maximises (docs/objectives.md)."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from advsearch.attacks.logit_objectives import Labels, margin, targeted_margin
from advsearch.errors import InputError


@dataclass(frozen=True)
class Goal:
    """Success in terms of the model's answer.

    Attributes:
        labels: the right answers.
        targets: where it is not empty, only these answers are a success.
        minimise: success is a right answer: the object is to be made easier to recognise.

    Raises:
        InputError: targets and right answers overlap, or there are targets to minimise.
    """

    labels: Labels
    targets: Labels = ()
    minimise: bool = False

    def __post_init__(self) -> None:
        both = sorted(set(self.labels) & set(self.targets))
        if both:
            raise InputError(f"target: expected classes that are not right answers, got {both}, which `label` has too")
        if self.targets and self.minimise:
            raise InputError("minimise: makes the right answer easier to give; leave `target` out")

    def score(self, logits: Tensor) -> Tensor:
        """Return (N,) in logits: over 0 exactly where the model's answer is a success. Ties and NaN are none."""
        if self.targets:
            return targeted_margin(logits, logits, self.targets)
        return -margin(logits, logits, self.labels) if self.minimise else margin(logits, logits, self.labels)

    def right(self, logits: Tensor) -> Tensor:
        """Return (N,) bool: the answer is right. A tie is right, NaN is not."""
        return margin(logits, logits, self.labels) <= 0.0

    @property
    def rule(self) -> str:
        """What counts, in words."""
        return "a target answer" if self.targets else "a right answer" if self.minimise else "a wrong answer"
