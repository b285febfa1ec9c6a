"""Tasks made of others: several models at once, each with a task of its own; every thing in a picture; and the pictures
of a rig of cameras."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, final

import torch
from torch import Tensor

from advsearch.described import OUT_OF_VIEW
from advsearch.errors import InputError
from advsearch.models import Model, Preprocessing
from advsearch.models.all_at_once import AllAtOnce
from advsearch.models.model import joined
from advsearch.options import FROM_RUN, JOINED
from advsearch.tasks.base import Facts, Judgement, Mark, Output, Prediction, Task, Truth, mean
from advsearch.tasks.command import Command

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


# ---------------------------------------------------------------------------------------------------------------------
# One task, asked of the object and of every thing beside it: a prediction is right where it is right about all of
# them.
#
# A search is after a wrong prediction about any of them: loss and score are the largest of the things' own.

TruthOfEach = Mapping[str, Truth]
"""What is true of each thing, by name."""


@dataclass(frozen=True, kw_only=True)
class EachThing(Task):
    """Made by `each_thing`.

    Args:
        part: the task, on its model.
    """

    name = "each thing"
    varies = True

    part: Task

    @property
    def calibrates(self) -> bool:
        return self.part.calibrates

    def after_calibration(self, output: Output, truth: TruthOfEach | None) -> EachThing:
        first = None if truth is None else next(iter(truth.values()))
        return replace(self, part=self.part.after_calibration(output, first))

    def check(self, facts: Facts) -> None:
        for one in facts.each.values():
            self.part.check(one)

    def truth(self, facts: Facts) -> TruthOfEach:
        return {name: self.part.truth(one) for name, one in facts.each.items()}

    def truth_names(self, truth: TruthOfEach) -> tuple[str, ...]:
        return tuple(dict.fromkeys(name for one in truth.values() for name in self.part.truth_names(one)))

    @property
    def target_names(self) -> tuple[str, ...]:
        return self.part.target_names

    def loss(self, output: Output, truth: TruthOfEach) -> Tensor:
        return self._largest(self.part.loss, output, truth)

    def score(self, output: Output, truth: TruthOfEach) -> Tensor:
        return -self.loss(output, truth) if self.minimise else self._largest(self.part.score, output, truth)

    def pixel_margin(self, output: Output, truth: TruthOfEach) -> Tensor:
        """Return that of the thing where it is largest, (N,); of segmentation."""
        return self._largest(self.part.pixel_margin, output, truth)  # type: ignore[attr-defined]

    @staticmethod
    def _largest(value: Callable[[Output, Truth], Tensor], output: Output, truth: TruthOfEach) -> Tensor:
        return torch.stack([value(output, one) for one in truth.values()]).amax(dim=0)

    def predictions(self, output: Output, count: int = 1) -> list[tuple[Prediction, ...]]:
        return self.part.predictions(output, count)

    def judge(self, output: Output, truth: TruthOfEach) -> list[Judgement]:
        """See `Task.judge`: the prediction about the thing that is worst, and in the payload what is said of each."""
        each = zip(*(self.part.judge(output, one) for one in truth.values()), strict=True)
        with torch.no_grad():
            scores, margins = self.score(output, truth).tolist(), (0.0 - self.loss(output, truth)).tolist()
        return [
            self._judged(dict(zip(truth, said, strict=True)), *at)
            for said, at in zip(each, zip(scores, margins, strict=True), strict=True)
        ]

    @staticmethod
    def _judged(said: Mapping[str, Judgement], score: float, margin: float) -> Judgement:
        if any(one.not_a_number for one in said.values()):
            return Judgement.of(score, math.nan, Prediction(""))
        seen = [name for name in said if said[name].prediction.label != OUT_OF_VIEW] or list(said)
        worst = min(seen, key=lambda name: said[name].margin)
        things = {
            name: {"right": one.right, "margin": one.margin, "answer": one.prediction.label}
            | ({"box": one.payload.get("box")} if isinstance(one.payload, dict) and "box" in one.payload else {})
            for name, one in said.items()
        }
        kept: Any = said[worst].payload if isinstance(said[worst].payload, dict) else {}
        average = mean([one.margin for one in said.values()])
        payload: Any = {**kept, "worst": worst, "mean_margin": average, "things": things}
        return Judgement.of(score, margin, said[worst].prediction, payload)

    def marks(self, output: Output, truth: TruthOfEach) -> list[list[Mark]]:
        """See `Task.marks`: what is true of each thing, and the prediction once."""
        found: list[list[Mark]] = []
        for marks in zip(*(self.part.marks(output, one) for one in truth.values()), strict=True):
            said = [mark for mark in marks[0] if not mark.true]
            found.append([mark for listed in marks for mark in listed if mark.true] + said)
        return found


def each_thing(task: Task) -> EachThing:
    """Return a task on its model as one that judges every thing.

    Raises:
        InputError: its models say one thing of a whole picture, or are several.
    """
    if isinstance(task, Together) or task.name not in JUDGES:
        raise InputError(
            f"judge: all is for {' and '.join(JUDGES)}, got task {task.name}; judge one thing, by its name"
        )
    kind: Any = type("EachThing", (EachThing,), {"name": task.name, "objective": task.objective})
    made: EachThing = kind(part=task, minimise=task.minimise, target=task.target)
    return made


JUDGES: Sequence[str] = ("detection", "segmentation", "depth")
"""Tasks whose prediction of a picture says something of each thing in it."""


# ---- A rig of cameras: a task for each picture, and a rule that makes one prediction of them ------------------------

RULES = ("any", "all", "mean", "vote")
"""When the rig is right: in any picture, in all, on average of the losses, or in more than half."""


@dataclass(frozen=True, kw_only=True)
class Rig(Task):
    """Several cameras take pictures of one configuration, and one prediction is made of what a model says of each.

    Each picture has a truth of its own, such as the box in it. The loss of the rig is the least, the largest or the
    mean of its pictures' losses, or for `vote` the one that more than half of them are at or below.

    Args:
        task: of each picture: a name, or a mapping with a `name` and options.
        rule: one of `RULES`.
        part: the task on the model, by `on`.
        cameras: how many there are, by `on`.

    Raises:
        InputError: no such rule.
    """

    name = "rig"
    varies = True

    task: Any = "classification"
    rule: str = RULES[0]
    part: Any = field(default=None, metadata=FROM_RUN)
    cameras: int = field(default=1, metadata=FROM_RUN)

    def __post_init__(self) -> None:
        if self.rule not in RULES:
            raise InputError(f"task rig: rule: expected one of {', '.join(RULES)}, got {self.rule!r}")
        if not isinstance(self.task, (str, Mapping, Task)):
            raise InputError(f"task rig: task: expected a name, or a mapping with a `name`, got {self.task!r:.80}")

    @property
    def title(self) -> str:
        return f"{self.name} of {self.part.title if self.part else self.task}"

    def on(self, model: Model, *, target: str | None = None, minimise: bool = False) -> Rig:
        """See `Task.on`. Raises InputError where the scene is seen by one camera."""
        if model.cameras < 2:
            raise InputError("task rig: expected a rig, got one camera; give it with `camera=rig.yaml`")
        part = self.part.on(replace(model, cameras=1), target=target, minimise=minimise)
        if isinstance(part, Command) and not isinstance(model.module, AllAtOnce):
            raise InputError(
                "task rig: task command is of one action for all pictures; give a policy that takes them at once, as "
                "advsearch.models.all_at_once.AllAtOnce"
            )
        return replace(self, part=part, cameras=model.cameras, target=part.target, minimise=minimise)

    def seeking(self, objective: str) -> Rig:
        return replace(self, part=self.part.seeking(objective))

    def check(self, facts: Facts) -> None:
        self.part.check(facts)

    def read(self, returned: Any, count: int) -> Any:
        return returned

    @property
    def calibrates(self) -> bool:
        return bool(self.part.calibrates)

    def after_calibration(self, output: Sequence[Outputs], truth: tuple[Truth, ...] | None) -> Rig:
        return replace(self, part=self.part.after_calibration(output[0][0], None if truth is None else truth[0]))

    @property
    def ambiguities(self) -> str:
        return str(self.part.ambiguities)

    @property
    def remarks(self) -> tuple[str, ...]:
        return tuple(self.part.remarks)

    def truth(self, facts: Facts) -> tuple[Truth, ...]:
        return tuple(self.part.truth(one) for one in facts.views or (facts,) * self.cameras)

    def truth_names(self, truth: tuple[Truth, ...]) -> tuple[str, ...]:
        return tuple(dict.fromkeys(name for one in truth for name in self.part.truth_names(one)))

    @property
    def target_names(self) -> tuple[str, ...]:
        return tuple(self.part.target_names)

    def loss(self, output: Sequence[Outputs], truth: tuple[Truth, ...]) -> Tensor:
        return self._ruled(self._each("loss", output, truth))

    def score(self, output: Sequence[Outputs], truth: tuple[Truth, ...]) -> Tensor:
        """See `Task.score`: a target is reached, and a right prediction made, by the rule."""
        scores = self._each("score", output, truth)
        return -self._ruled(-scores) if self.target is not None or self.minimise else self._ruled(scores)

    def _each(self, what: str, output: Sequence[Outputs], truth: tuple[Truth, ...]) -> Tensor:
        """A number of each picture, (N, K)."""
        each = [[getattr(self.part, what)(*pair) for pair in zip(one, truth, strict=True)] for one in output]
        return torch.stack([torch.cat(one) for one in each])

    def _ruled(self, wrong: Tensor) -> Tensor:
        """How wrong the rig is, (N,), from how wrong it is in each picture, (N, K)."""
        if self.rule == "mean":
            return wrong.mean(dim=1)
        place = {"any": 0, "all": wrong.shape[1] - 1, "vote": wrong.shape[1] // 2}[self.rule]
        return wrong.sort(dim=1).values[:, place]

    def predictions(self, output: Sequence[Outputs], count: int = 1) -> list[tuple[Prediction, ...]]:
        return [(all_said([self.part.predictions(one)[0][0] for one in each]),) for each in output]

    def judge(self, output: Sequence[Outputs], truth: tuple[Truth, ...]) -> list[Judgement]:
        found = []
        with torch.no_grad():
            margins, scores = (0.0 - self.loss(output, truth)).tolist(), self.score(output, truth).tolist()
        for each, margin, score in zip(output, margins, scores, strict=True):
            said = [self.part.judge(one, true)[0] for one, true in zip(each, truth, strict=True)]
            lost = any(one.not_a_number for one in said)
            payload: Any = {
                "pictures": [
                    {"prediction": one.prediction.label, "right": one.right, "payload": one.payload} for one in said
                ]
            }
            prediction = all_said([one.prediction for one in said])
            found.append(Judgement.of(score, math.nan if lost else margin, prediction, payload))
        return found

    def marks(self, output: Sequence[Outputs], truth: tuple[Truth, ...]) -> list[list[Mark]]:
        """See `Task.marks`: those of the first picture, which is at the left."""
        found = []
        for each in output:
            marks = self.part.marks(each[0], truth[0])[0]
            found.append([replace(one, mask=self._wide(one.mask)) for one in marks if one.map is None])
        return found

    def _wide(self, mask: Tensor | None) -> Tensor | None:
        return None if mask is None else torch.cat([mask, *[torch.zeros_like(mask)] * (self.cameras - 1)], dim=-1)
