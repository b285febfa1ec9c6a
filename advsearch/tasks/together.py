"""Tasks made of others: several models at once, each with a task of its own; every
thing in a picture; and the pictures of a rig of cameras.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, cycle
from typing import Any, final

import torch
from torch import Tensor

from advsearch.errors import InputError
from advsearch.files import JsonValue
from advsearch.models import Model, Preprocessing
from advsearch.models.model import joined
from advsearch.options import FROM_RUN, JOINED, OUT_OF_VIEW, OUTCOME, get_outcome
from advsearch.tasks.base import (
    Facts,
    Judgement,
    Mark,
    Output,
    Prediction,
    Said,
    Task,
    Truth,
    mean,
)

# what each of several models returns for one picture, or one model for each picture of
# a rig
Outputs = tuple[Any, ...]


@final
class Ensemble:
    """Asks several models, each of which resizes and normalises for itself; what
    `Model.module` is of `together`.
    """

    def __init__(self, models: Sequence[Model]) -> None:
        self.models = tuple(models)

    def __call__(self, images: Tensor) -> list[Any]:
        """Return the output of each model for pictures (N, H, W, 3) sRGB in [0, 1]."""
        return [model(images) for model in self.models]


def together(models: Sequence[Model], size: tuple[int, int] | None = None) -> Model:
    """Return several models as one, whose output is a list with a tuple of the models'
    outputs for each picture. The size of the pictures is (height, width) in pixels;
    None for the largest that a model takes.
    """
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
class Joined(Task):
    """A task made of others, which are the `judges`: one for each of its truths in
    their order, or one for all.
    """

    varies = True

    @property
    @abstractmethod
    def judges(self) -> tuple[Any, ...]:
        """The tasks, on their models."""

    @property
    def calibrates(self) -> bool:
        return any(judge.calibrates for judge in self.judges)

    @property
    def ambiguities(self) -> str:
        return "; ".join(
            judge.ambiguities for judge in self.judges if judge.ambiguities
        )

    @property
    def remarks(self) -> tuple[str, ...]:
        return _distinct(judge.remarks for judge in self.judges)

    @property
    def target_names(self) -> tuple[str, ...]:
        return _distinct(judge.target_names for judge in self.judges)

    def truth_names(self, truth: Any) -> tuple[str, ...]:
        truths = truth.values() if isinstance(truth, Mapping) else truth
        each = zip(cycle(self.judges), truths, strict=False)
        return _distinct(judge.truth_names(true) for judge, true in each)


def _distinct(texts: Iterable[Iterable[str]]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(chain.from_iterable(texts)))


def outcome_in(judgement: Judgement) -> dict[str, JsonValue]:
    """Return the outcome that a judgement states, as a part of a payload; empty where
    it states none.
    """
    outcome = get_outcome(judgement.payload)
    return {} if outcome is None else {OUTCOME: outcome.value}


def all_said(predictions: Iterable[Prediction]) -> Prediction:
    """Return several predictions as one, in words."""
    return Prediction("; ".join(prediction.label for prediction in predictions))


@dataclass(frozen=True, kw_only=True)
class Together(Joined):
    """Several models, each of which judges by a task and labels of its own.

    A prediction is right where all models are right, and a success where it is one for
    every model. So the loss is the largest of the models' losses, and the score the
    least of their scores.
    """

    name = "ensemble"
    objective = "each"

    parts: tuple[Task, ...]  # of each model, in the order of the outputs of `together`
    models: tuple[Model, ...] = field(default=(), metadata=FROM_RUN)  # that are asked
    tasks: tuple[Task, ...] = field(default=(), metadata=FROM_RUN)  # the parts on these

    @property
    def judges(self) -> tuple[Task, ...]:
        return self.tasks

    @property
    def title(self) -> str:
        names = [part.title for part in self.parts]
        return JOINED.join(names) if len(set(names)) > 1 else self.name

    def read(self, returned: Any, count: int) -> list[Outputs]:
        return by_picture(returned, count)

    def on(
        self, model: Model, *, target: str | None = None, minimise: bool = False
    ) -> Together:
        """See `Task.on`; a target is for the tasks that take a label, where some do and
        some do not. Raises InputError where it is no model of `together`, or one of
        fewer or more than there are tasks.
        """
        models = model.module.models if isinstance(model.module, Ensemble) else ()
        if len(models) != len(self.parts):
            raise InputError(
                f"model: expected {len(self.parts)}, one for each task, "
                f"got {len(models) or 1}"
            )
        tasks = tuple(
            part.on(
                network,
                target=target if self._takes_label(part) else None,
                minimise=minimise,
            )
            for part, network in zip(self.parts, models, strict=True)
        )
        targets = None if target is None else tuple(task.target for task in tasks)
        return replace(
            self, models=models, tasks=tasks, target=targets, minimise=minimise
        )

    def seeking(self, objective: str) -> Together:
        return replace(
            self, parts=tuple(part.seeking(objective) for part in self.parts)
        )

    def told(self, one: Task, facts: Facts) -> Facts:
        """Return the facts for one of the tasks: without a label that is for others."""
        return facts if self._takes_label(one) else replace(facts, label=None)

    def _takes_label(self, one: Task) -> bool:
        return one.labelled or not any(part.labelled for part in self.parts)

    def check(self, facts: Facts) -> None:
        for task in self.tasks:
            task.check(self.told(task, facts))

    def after_calibration(
        self, output: Sequence[Outputs], truth: Truths | None
    ) -> Together:
        each = zip(
            self.tasks, of_each(output), truth or [None] * len(self.tasks), strict=True
        )
        return replace(
            self, tasks=tuple(task.after_calibration(*shown) for task, *shown in each)
        )

    @property
    def ambiguities(self) -> str:
        pairs = zip(self.models, self.tasks, strict=True)
        return "; ".join(
            f"{model.name}: {task.ambiguities}"
            for model, task in pairs
            if task.ambiguities
        )

    def truth(self, facts: Facts) -> Truths:
        return tuple(task.truth(facts) for task in self.tasks)

    def loss(self, output: Sequence[Outputs], truth: Truths) -> Tensor:
        return torch.stack(
            [task.loss(*judged) for task, *judged in self._each(output, truth)]
        ).amax(dim=0)

    def score(self, output: Sequence[Outputs], truth: Truths) -> Tensor:
        return torch.stack(
            [task.score(*judged) for task, *judged in self._each(output, truth)]
        ).amin(dim=0)

    def predictions(
        self, output: Sequence[Outputs], count: int = 1
    ) -> list[tuple[Prediction, ...]]:
        said = [
            task.predictions(shown)
            for task, shown in zip(self.tasks, of_each(output), strict=True)
        ]
        return [
            (all_said(first for first, *_ in each),) for each in zip(*said, strict=True)
        ]

    def judge(self, output: Sequence[Outputs], truth: Truths) -> list[Judgement]:
        judgements = []
        for each in zip(
            *(task.judge(*judged) for task, *judged in self._each(output, truth)),
            strict=True,
        ):
            payloads = {
                model.name: judged.payload
                for model, judged in zip(self.models, each, strict=True)
            }
            payload = (
                payloads
                if any(kept is not None for kept in payloads.values())
                else None
            )
            worst = min(each, key=lambda judged: judged.margin)
            payload = None if payload is None else {**payload, **outcome_in(worst)}
            margin = (
                math.nan
                if any(judged.not_a_number for judged in each)
                else min(judged.margin for judged in each)
            )
            prediction = all_said(judged.prediction for judged in each)
            judgements.append(
                Judgement.of(
                    min(judged.score for judged in each), margin, prediction, payload
                )
            )
        return judgements

    def marks(self, output: Sequence[Outputs], truth: Truths) -> list[list[Mark]]:
        """See `Task.marks`: what is true of the first, maps of all, and what each model
        says under its name.
        """
        pictures: list[list[Mark]] = [[] for _ in output]
        for number, (task, *judged) in enumerate(self._each(output, truth)):
            for picture, marks in zip(pictures, task.marks(*judged), strict=True):
                picture += [
                    mark
                    for mark in marks
                    if mark.true and (not number or mark.map is not None)
                ]
                name = self.models[number].name
                picture += [
                    replace(mark, text=f"{name}: {mark.text}")
                    for mark in marks
                    if not mark.true
                ]
        return pictures

    def _each(
        self, output: Sequence[Outputs], truth: Truths
    ) -> list[tuple[Any, Any, Any]]:
        return list(zip(self.tasks, of_each(output), truth, strict=True))


# ---------------------------------------------------------------------------------------------------------------------
# One task, asked of the object and of every thing beside it: a prediction is right
# where it is right about all of them.
#
# A search is after a wrong prediction about any of them: loss and score are the largest
# of the things' own.

TruthOfEach = Mapping[str, Truth]  # what is true of each thing, by name


@dataclass(frozen=True, kw_only=True)
class EachThing(Joined):
    """Made by `each_thing`."""

    name = "each thing"

    part: Task  # on its model

    @property
    def judges(self) -> tuple[Task, ...]:
        return (self.part,)

    def after_calibration(self, output: Output, truth: TruthOfEach | None) -> EachThing:
        first = None if truth is None else next(iter(truth.values()))
        return replace(self, part=self.part.after_calibration(output, first))

    def check(self, facts: Facts) -> None:
        for thing in facts.each.values():
            self.part.check(thing)

    def truth(self, facts: Facts) -> TruthOfEach:
        return {name: self.part.truth(thing) for name, thing in facts.each.items()}

    def loss(self, output: Output, truth: TruthOfEach) -> Tensor:
        return self._largest("loss", output, truth)

    def score(self, output: Output, truth: TruthOfEach) -> Tensor:
        return (
            -self.loss(output, truth)
            if self.minimise
            else self._largest("score", output, truth)
        )

    def pixel_margin(self, output: Output, truth: TruthOfEach) -> Tensor:
        """Return that of the thing where it is largest, (N,); of segmentation."""
        return self._largest("pixel_margin", output, truth)

    def _largest(self, value: str, output: Output, truth: TruthOfEach) -> Tensor:
        return torch.stack(
            [getattr(self.part, value)(output, true) for true in truth.values()]
        ).amax(dim=0)

    def predictions(
        self, output: Output, count: int = 1
    ) -> list[tuple[Prediction, ...]]:
        return self.part.predictions(output, count)

    def said(
        self, output: Output, truth: TruthOfEach, margins: Sequence[float]
    ) -> list[Said]:
        """See `Task.said`: the prediction about the thing that is worst, and in the
        payload what is said of each.
        """
        found: list[Said] = []
        for judged in zip(
            *(self.part.judge(output, true) for true in truth.values()), strict=True
        ):
            by_name = dict(zip(truth, judged, strict=True))
            seen = [
                name
                for name, thing in by_name.items()
                if thing.prediction.label != OUT_OF_VIEW
            ] or list(by_name)
            worst = min(seen, key=lambda name: by_name[name].margin)
            payloads: dict[str, Any] = {
                name: thing.payload if isinstance(thing.payload, dict) else {}
                for name, thing in by_name.items()
            }
            things = {
                name: {
                    "right": thing.right,
                    "margin": thing.margin,
                    "answer": thing.prediction.label,
                }
                | outcome_in(thing)
                | ({"box": payloads[name]["box"]} if "box" in payloads[name] else {})
                for name, thing in by_name.items()
            }
            average = mean([thing.margin for thing in judged])
            payload = {
                **payloads[worst],
                "worst": worst,
                "mean_margin": average,
                "things": things,
            }
            found.append((by_name[worst].prediction, payload))
        return found

    def marks(self, output: Output, truth: TruthOfEach) -> list[list[Mark]]:
        """See `Task.marks`: what is true of each thing, and the prediction once."""
        each = zip(
            *(self.part.marks(output, true) for true in truth.values()), strict=True
        )
        return [
            [mark for thing in things for mark in thing if mark.true]
            + [mark for mark in things[0] if not mark.true]
            for things in each
        ]


def each_thing(task: Task) -> EachThing:
    """Return a task on its model as one that judges every thing. Raises InputError: its
    models say one thing of a whole picture, or are several.
    """
    if isinstance(task, Together) or task.name not in JUDGES:
        raise InputError(
            f"judge: all is for {' and '.join(JUDGES)}, got task {task.name}; judge "
            "one thing, by its name"
        )
    kind: Any = type(
        "EachThing", (EachThing,), {"name": task.name, "objective": task.objective}
    )
    made: EachThing = kind(part=task, minimise=task.minimise, target=task.target)
    return made


JUDGES: Sequence[str] = ("detection", "segmentation", "depth")
"""Tasks whose prediction of a picture says something of each thing in it."""
