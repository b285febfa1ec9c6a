"""What tasks have in common whose models know classes: their names, and which of them are right or sought."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeVar

import torch

from advsearch.errors import InputError
from advsearch.models import Model, find_label_set
from advsearch.models.labels import fitting_labels, names_nothing
from advsearch.options import FROM_RUN
from advsearch.tasks.base import Facts, Output, Task

Labels = tuple[int, ...]
Own = TypeVar("Own", bound="ClassTask")

NO = "no "
"""How an answer says that the object is not found."""


@dataclass(frozen=True, kw_only=True)
class ClassTask(Task):
    """A task whose model knows classes by number.

    Args:
        labels: one name per class; numbers stand in for names that are not there.
        named: False if `labels` are placeholders.
        target: indices of classes; where there are some, only these are a success.

    Raises:
        InputError: there is a target to minimise.
    """

    labels: tuple[str, ...] = field(default=(), metadata=FROM_RUN)
    named: bool = field(default=True, metadata=FROM_RUN)
    target: Labels | None = field(default=None, metadata=FROM_RUN)

    def __post_init__(self) -> None:
        if self.target is not None and self.minimise:
            raise InputError("minimise: makes the right answer easier to give; leave `target` out")

    def on(self: Own, model: Model, *, target: str | None = None, minimise: bool = False) -> Own:
        """See `Task.on`: the target is one of the model's classes, or several.

        Raises:
            InputError: there is no such class, or the model's answers are not what the task reads.
        """
        if self.reads_logits != (model.read is None):
            raise InputError(f"model {model.name}: {self._other_reader}")
        labels, named = (model.labels, model.named) if self.reads_logits else self._names(model)
        try:
            wanted = None if target is None else find_label_set(target, labels, named=named).indices
        except InputError as error:
            raise InputError(f"target: {error}") from None
        return replace(self, labels=labels, named=named, target=wanted, minimise=minimise)

    @property
    def _other_reader(self) -> str:
        if self.reads_logits:
            return "expected logits, and it was loaded for another task; leave `read` out"
        return f'it was loaded for its logits; load it with task="{self.name}"'

    def _names(self, model: Model) -> tuple[tuple[str, ...], bool]:
        """The names of the classes that a model answers with, and whether they are names."""
        with torch.no_grad():
            count = self.classes_in(model(torch.full((1, *model.input_size, 3), 0.5)))
        given = model.labels or None
        if count is None and given is None:
            raise InputError(f"labels: expected a file with the names of the classes of model {model.name}, got none")
        return (
            model.labels if count is None else fitting_labels(count, given, "labels", model.name)
        ), given is not None

    def classes_in(self, output: Output) -> int | None:
        """Return how many classes an output is of; None where it does not show that."""
        return None

    def right_classes(self, facts: Facts) -> Labels:
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

    @cached_property
    def nothing(self) -> Labels:
        """Indices of classes that stand for no thing, such as "background", but for what is sought: no answers."""
        if not self.named:
            return ()
        sought = self.target or ()
        return tuple(k for k, name in enumerate(self.labels) if k not in sought and names_nothing(name))

    @property
    def target_names(self) -> tuple[str, ...]:
        """See `Task.target_names`."""
        return self.names(self.target or ())

    def names(self, indices: Sequence[int]) -> tuple[str, ...]:
        """Return the names of classes."""
        return tuple(map(self.name_of, indices))

    def name_of(self, index: int) -> str:
        """Return the name of a class."""
        return self.labels[index] if index < len(self.labels) else f"class {index}"
