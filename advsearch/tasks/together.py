"""Several models at once, each with a task of its own: a prediction counts where it does for each of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, final

import torch
from torch import Tensor

from advsearch.errors import InputError
from advsearch.models import Model, Preprocessing
from advsearch.models.model import joined
from advsearch.options import FROM_RUN, JOINED
from advsearch.tasks.base import Facts, Judgement, Mark, Prediction, Task, Truth

Outputs = tuple[Any, ...]
"""What each of several models returns for one picture, or one model for each picture of a rig."""


@final
class Ensemble:
    """Asks several models, each of which resizes and normalises for itself; what `Model.module` is of `together`."""

    def __init__(self, models: Sequence[Model]) -> None:
        self.models = tuple(models)

    def __call__(self, images: Tensor) -> list[Any]:
        """Return the output of each model for pictures (N, H, W, 3) sRGB in [0, 1]."""
        return [model(images) for model in self.models]


def together(models: Sequence[Model], size: tuple[int, int] | None = None) -> Model:
    """Return several models as one, whose output is a list with a tuple of the models' outputs for each picture. The
    size of the pictures is (height, width) in pixels; None for the largest that a model takes."""
    high, wide = (max(model.input_size[side] for model in models) for side in (0, 1))
    return Model(
        module=Ensemble(models),
        name=" and ".join(model.name for model in models),
        labels=(),
        preprocessing=Preprocessing(size or (high, wide), layout="NHWC"),
        differentiable=all(model.differentiable for model in models),
        read=by_picture,
    )


def by_picture(returned: list[Any], count: int) -> list[Outputs]:
    """Return the outputs by picture of `count` pictures, from those by model."""
    return [tuple(output[k : k + 1] for output in returned) for k in range(count)]


def of_each(outputs: Sequence[Outputs]) -> list[Any]:
    """Return the output of each model for N pictures, from what each of them got."""
    return [joined(parts) for parts in zip(*outputs, strict=True)]


Truths = tuple[Truth, ...]


@dataclass(frozen=True, kw_only=True)
class Together(Task):
    """Several models, each of which judges by a task and labels of its own.

    A prediction is right where all models are right, and a success where it is one for every model. So the loss is
    the largest of the models' losses, and the score the least of their scores.

    Args:
        parts: the task of each model, in the order of the outputs of `advsearch.tasks.together.together`.
        models: that are asked.
        tasks: the parts on these, by `on`.
    """

    name = "ensemble"
    objective = "each"
    varies = True

    parts: tuple[Task, ...]
    models: tuple[Model, ...] = field(default=(), metadata=FROM_RUN)
    tasks: tuple[Task, ...] = field(default=(), metadata=FROM_RUN)

    @property
    def title(self) -> str:
        names = [one.title for one in self.parts]
        return JOINED.join(names) if len(set(names)) > 1 else self.name

    def read(self, returned: Any, count: int) -> list[Outputs]:
        return by_picture(returned, count)

    def on(self, model: Model, *, target: str | None = None, minimise: bool = False) -> Together:
        """See `Task.on`; a target is for the tasks that take a label, where some do and some do not. Raises InputError
        where it is no model of `together`, or one of fewer or more than there are tasks."""
        models = model.module.models if isinstance(model.module, Ensemble) else ()
        if len(models) != len(self.parts):
            raise InputError(f"model: expected {len(self.parts)}, one for each task, got {len(models) or 1}")
        pairs = list(zip(self.parts, models, strict=True))
        takes = [self._takes_label(part) for part in self.parts]
        tasks = tuple(
            part.on(one, target=target if label else None, minimise=minimise)
            for (part, one), label in zip(pairs, takes, strict=True)
        )
        wanted = None if target is None else tuple(one.target for one in tasks)
        return replace(self, models=models, tasks=tasks, target=wanted, minimise=minimise)

    def seeking(self, objective: str) -> Together:
        return replace(self, parts=tuple(one.seeking(objective) for one in self.parts))

    def told(self, one: Task, facts: Facts) -> Facts:
        """Return the facts for one of the tasks: without a label that is for others."""
        return facts if self._takes_label(one) else replace(facts, label=None)

    def _takes_label(self, one: Task) -> bool:
        return one.labelled or not any(part.labelled for part in self.parts)

    def check(self, facts: Facts) -> None:
        for one in self.tasks:
            one.check(self.told(one, facts))

    @property
    def calibrates(self) -> bool:
        return any(one.calibrates for one in self.tasks)

    def after_calibration(self, output: Sequence[Outputs], truth: Truths | None) -> Together:
        each = zip(self.tasks, of_each(output), truth or [None] * len(self.tasks), strict=True)
        return replace(self, tasks=tuple(one.after_calibration(own, true) for one, own, true in each))

    @property
    def ambiguities(self) -> str:
        pairs = zip(self.models, self.tasks, strict=True)
        return "; ".join(f"{model.name}: {one.ambiguities}" for model, one in pairs if one.ambiguities)

    @property
    def remarks(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(remark for one in self.tasks for remark in one.remarks))

    def truth(self, facts: Facts) -> Truths:
        return tuple(one.truth(facts) for one in self.tasks)

    def truth_names(self, truth: Truths) -> tuple[str, ...]:
        pairs = zip(self.tasks, truth, strict=True)
        return tuple(dict.fromkeys(name for one, own in pairs for name in one.truth_names(own)))

    @property
    def target_names(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(name for one in self.tasks for name in one.target_names))

    def loss(self, output: Sequence[Outputs], truth: Truths) -> Tensor:
        return torch.stack([one.loss(*own) for one, *own in self._each(output, truth)]).amax(dim=0)

    def score(self, output: Sequence[Outputs], truth: Truths) -> Tensor:
        return torch.stack([one.score(*own) for one, *own in self._each(output, truth)]).amin(dim=0)

    def predictions(self, output: Sequence[Outputs], count: int = 1) -> list[tuple[Prediction, ...]]:
        said = [one.predictions(own) for one, own in zip(self.tasks, of_each(output), strict=True)]
        return [(all_said([first for first, *_ in each]),) for each in zip(*said, strict=True)]

    def judge(self, output: Sequence[Outputs], truth: Truths) -> list[Judgement]:
        found = []
        for each in zip(*(one.judge(*own) for one, *own in self._each(output, truth)), strict=True):
            payloads = {model.name: one.payload for model, one in zip(self.models, each, strict=True)}
            payload = payloads if any(one is not None for one in payloads.values()) else None
            margin = math.nan if any(one.not_a_number for one in each) else min(one.margin for one in each)
            prediction = all_said([one.prediction for one in each])
            found.append(Judgement.of(min(one.score for one in each), margin, prediction, payload))
        return found

    def marks(self, output: Sequence[Outputs], truth: Truths) -> list[list[Mark]]:
        """See `Task.marks`: what is true of the first, maps of all, and what each model says under its name."""
        found: list[list[Mark]] = [[] for _ in output]
        for number, (one, *own) in enumerate(self._each(output, truth)):
            for listed, marks in zip(found, one.marks(*own), strict=True):
                listed += [mark for mark in marks if mark.true and (not number or mark.map is not None)]
                name = self.models[number].name
                listed += [replace(mark, text=f"{name}: {mark.text}") for mark in marks if not mark.true]
        return found

    def _each(self, output: Sequence[Outputs], truth: Truths) -> list[tuple[Any, Any, Any]]:
        return list(zip(self.tasks, of_each(output), truth, strict=True))


def all_said(predictions: Sequence[Prediction]) -> Prediction:
    """Return several predictions as one, in words."""
    return Prediction("; ".join(one.label for one in predictions))
