"""Tasks made of others: for several models, and for every thing in an image."""

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
from advsearch.models.model import join_outputs
from advsearch.options import (
    FROM_RUN,
    OUTCOME,
    TASK_SEPARATOR,
    get_outcome,
)
from advsearch.tasks.base import (
    Facts,
    Judgement,
    Mark,
    Output,
    Prediction,
    PredictionWithPayload,
    Task,
    Truth,
    mean,
)

# The outputs of several models for one image, or of one model for each image of a rig.
Outputs = tuple[Any, ...]


@final
class Ensemble:
    """Run several models, each with its own preprocessing.

    It is the network in the model from `join_models`.
    """

    def __init__(self, models: Sequence[Model]) -> None:
        self.models = tuple(models)

    def __call__(self, images: Tensor) -> list[Any]:
        """Return the output of each model for images (N, H, W, 3), sRGB in [0, 1]."""
        return [model(images) for model in self.models]


def join_models(models: Sequence[Model], size: tuple[int, int] | None = None) -> Model:
    """Combine several models into one.

    Args:
        models: at least one model. Each resizes the images to its own input size.
        size: size of the images, (height, width) in pixels; None for the largest height
            and the largest width among the models' inputs.

    Returns:
        A model whose output is a list with a tuple of the models' outputs for each
        image.
    """
    max_height = max(model.input_size[0] for model in models)
    max_width = max(model.input_size[1] for model in models)
    return Model(
        module=Ensemble(models),
        name=" and ".join(model.name for model in models),
        labels=(),
        preprocessing=Preprocessing(size or (max_height, max_width), layout="NHWC"),
        differentiable=all(model.differentiable for model in models),
        read=split_by_image,
    )


def split_by_image(returned: list[Any], count: int) -> list[Outputs]:
    """Regroup the outputs of `count` images from model by model to image by image."""
    return [
        tuple(output[index : index + 1] for output in returned)
        for index in range(count)
    ]


def regroup_by_model(outputs: Sequence[Outputs]) -> list[Any]:
    """Regroup the outputs of N images from image by image to model by model."""
    return [join_outputs(model_outputs) for model_outputs in zip(*outputs, strict=True)]


Truths = tuple[Truth, ...]


@dataclass(frozen=True, kw_only=True)
class JointTask(Task):
    """Base class for tasks that are made of other tasks, the `member_tasks`.

    There is a judge for each of its truths, in their order, or a single judge for all
    truths.
    """

    varies = True

    @property
    @abstractmethod
    def member_tasks(self) -> tuple[Any, ...]:
        """The tasks, on their models."""

    @property
    def calibrates(self) -> bool:
        return any(judge.calibrates for judge in self.member_tasks)

    @property
    def ambiguity_message(self) -> str:
        return "; ".join(
            judge.ambiguity_message
            for judge in self.member_tasks
            if judge.ambiguity_message
        )

    @property
    def output_remarks(self) -> tuple[str, ...]:
        return _distinct(judge.output_remarks for judge in self.member_tasks)

    @property
    def target_names(self) -> tuple[str, ...]:
        return _distinct(judge.target_names for judge in self.member_tasks)

    def truth_names(self, truth: Any) -> tuple[str, ...]:
        truths = truth.values() if isinstance(truth, Mapping) else truth
        # A single judge is repeated for all truths; otherwise each truth has its own.
        judged_truths = zip(cycle(self.member_tasks), truths, strict=False)
        return _distinct(judge.truth_names(value) for judge, value in judged_truths)


def _distinct(groups: Iterable[Iterable[str]]) -> tuple[str, ...]:
    """Return the strings of all groups in order, without duplicates."""
    return tuple(dict.fromkeys(chain.from_iterable(groups)))


def make_outcome_payload(judgement: Judgement) -> dict[str, JsonValue]:
    """Return the outcome of a judgement as a part of a payload; empty if it states
    none.
    """
    outcome = get_outcome(judgement.payload)
    return {} if outcome is None else {OUTCOME: outcome.value}


def join_predictions(predictions: Iterable[Prediction]) -> Prediction:
    """Join the labels of several predictions into one prediction."""
    return Prediction("; ".join(prediction.label for prediction in predictions))


@dataclass(frozen=True, kw_only=True)
class EnsembleTask(JointTask):
    """Judge several models, each by its own task and labels.

    A prediction is right if all models are right, and a success if it is one for every
    model. So the loss is the largest of the models' losses, and the score the smallest
    of their scores.

    Attributes:
        parts: task for each model, in the order of the outputs of `join_models`.
        models: the models. Set by `on`.
        tasks: the `parts`, for these models. Set by `on`.
    """

    name = "ensemble"
    objective = "each"

    parts: tuple[Task, ...]
    models: tuple[Model, ...] = field(default=(), metadata=FROM_RUN)
    tasks: tuple[Task, ...] = field(default=(), metadata=FROM_RUN)

    @property
    def member_tasks(self) -> tuple[Task, ...]:
        return self.tasks

    @property
    def title(self) -> str:
        names = [part.title for part in self.parts]
        return TASK_SEPARATOR.join(names) if len(set(names)) > 1 else self.name

    def read(self, returned: Any, count: int) -> list[Outputs]:
        return split_by_image(returned, count)

    def on(
        self, model: Model, *, target: str | None = None, minimise: bool = False
    ) -> EnsembleTask:
        """Return the task for an ensemble of models, one for each of its tasks.

        Args:
            model: model from `join_models`.
            target: label that the attack seeks; None for any wrong one. It is passed
                only to the tasks that take a label, if any do.
            minimise: whether a right prediction is sought.

        Raises:
            InputError: the model is not from `join_models`, or has not one model per
                task.
        """
        network = model.module
        models = network.models if isinstance(network, Ensemble) else ()
        self._check_model_count(len(models))
        # `parts` are the tasks as the user set them, `tasks` those for their models.
        tasks = []
        for part, part_model in zip(self.parts, models, strict=True):
            part_target = target if self._takes_label(part) else None
            tasks.append(part.on(part_model, target=part_target, minimise=minimise))
        targets = None if target is None else tuple(task.target for task in tasks)
        return replace(
            self, models=models, tasks=tuple(tasks), target=targets, minimise=minimise
        )

    def _check_model_count(self, n_models: int) -> None:
        """Raise InputError if an ensemble has not one model for each task.

        Args:
            n_models: number of its models; 0 for a model that is no ensemble.
        """
        if n_models != len(self.parts):
            raise InputError(
                f"model: expected {len(self.parts)}, one for each task, got "
                f"{n_models or 1}"
            )

    def with_objective(self, objective: str) -> EnsembleTask:
        return replace(
            self, parts=tuple(part.with_objective(objective) for part in self.parts)
        )

    def select_facts(self, task: Task, facts: Facts) -> Facts:
        """Return the facts for one of the tasks, without a label for other tasks."""
        return facts if self._takes_label(task) else replace(facts, label=None)

    def _takes_label(self, task: Task) -> bool:
        """Return whether a label is passed to a task.

        It is passed to all tasks if none takes one, so that they report the error.
        """
        return task.labelled or not any(part.labelled for part in self.parts)

    def check(self, facts: Facts) -> None:
        for task in self.tasks:
            task.check(self.select_facts(task, facts))

    def after_calibration(
        self, output: Sequence[Outputs], truth: Truths | None
    ) -> EnsembleTask:
        """Calibrate each task with the output of its model for the clean image.

        Args:
            output: outputs of all models for each image.
            truth: truth for each task; None if it is unknown.
        """
        truths = truth or [None] * len(self.tasks)  # unknown for each task
        tasks = tuple(
            task.after_calibration(model_output, task_truth)
            for task, model_output, task_truth in zip(
                self.tasks, regroup_by_model(output), truths, strict=True
            )
        )
        return replace(self, tasks=tasks)

    @property
    def ambiguity_message(self) -> str:
        texts = []
        for model, task in zip(self.models, self.tasks, strict=True):
            if task.ambiguity_message:
                texts.append(f"{model.name}: {task.ambiguity_message}")
        return "; ".join(texts)

    def truth(self, facts: Facts) -> Truths:
        return tuple(task.truth(facts) for task in self.tasks)

    def loss(self, output: Sequence[Outputs], truth: Truths) -> Tensor:
        """Compute the largest of the models' losses, (N,)."""
        losses = [
            task.loss(model_output, task_truth)
            for task, model_output, task_truth in self._by_task(output, truth)
        ]
        return torch.stack(losses).amax(dim=0)

    def score(self, output: Sequence[Outputs], truth: Truths) -> Tensor:
        """Compute the smallest of the models' scores, (N,)."""
        scores = [
            task.score(model_output, task_truth)
            for task, model_output, task_truth in self._by_task(output, truth)
        ]
        return torch.stack(scores).amin(dim=0)

    def predictions(
        self, output: Sequence[Outputs], count: int = 1
    ) -> list[tuple[Prediction, ...]]:
        """Return a single prediction for each image, with the labels of all models."""
        predictions_of_models = [
            task.predictions(model_output)
            for task, model_output in zip(
                self.tasks, regroup_by_model(output), strict=True
            )
        ]
        return [
            (join_predictions(predictions[0] for predictions in image_predictions),)
            for image_predictions in zip(*predictions_of_models, strict=True)
        ]

    def judge(self, output: Sequence[Outputs], truth: Truths) -> list[Judgement]:
        """Judge each image; the payload has the payload of each model by name."""
        judgements_of_models = [
            task.judge(model_output, task_truth)
            for task, model_output, task_truth in self._by_task(output, truth)
        ]
        return [
            self._join_judgements(image_judgements)
            for image_judgements in zip(*judgements_of_models, strict=True)
        ]

    def _join_judgements(self, judgements: Sequence[Judgement]) -> Judgement:
        """Join the models' judgements of one image, in the order of the models.

        The margin and the outcome are those of the model with the smallest margin. The
        payload has the payloads of all models by name, and the outcome; it is None if no
        model has a payload. If a model returned NaN, the joint margin is NaN too, and
        there is no payload.
        """
        # Any judgement if a margin is NaN: then `from_margin` stores no payload below.
        worst = min(judgements, key=lambda judgement: judgement.margin)
        margin = worst.margin
        if any(judgement.is_non_finite for judgement in judgements):
            margin = math.nan
        payload = None
        if any(judgement.payload is not None for judgement in judgements):
            names = [model.name for model in self.models]
            payloads = [judgement.payload for judgement in judgements]
            payload = dict(zip(names, payloads, strict=True))
            payload |= make_outcome_payload(worst)
        prediction = join_predictions(judgement.prediction for judgement in judgements)
        score = min(judgement.score for judgement in judgements)
        return Judgement.from_margin(score, margin, prediction, payload)

    def marks(self, output: Sequence[Outputs], truth: Truths) -> list[list[Mark]]:
        """Return the marks to draw on each image.

        They are the boxes and masks of the truth, which are the same for all models; the
        true maps of each model; and the prediction of each model, with the name of the
        model before its text.
        """
        marks_of_images: list[list[Mark]] = [[] for _ in output]
        for index, (task, model_output, task_truth) in enumerate(
            self._by_task(output, truth)
        ):
            model_marks = task.marks(model_output, task_truth)
            for image_marks, marks in zip(marks_of_images, model_marks, strict=True):
                image_marks += self._select_marks(marks, index)
        return marks_of_images

    def _select_marks(self, marks: Sequence[Mark], index: int) -> list[Mark]:
        """Return those marks of a model on an image that are drawn, the truth first.

        Boxes and masks of the truth are those of the first model only.

        Args:
            marks: marks of the task of the model.
            index: index of the model.
        """
        is_first_model = index == 0
        true_marks = [
            mark
            for mark in marks
            if mark.true and (is_first_model or mark.map is not None)
        ]
        model_name = self.models[index].name
        predicted_marks = [
            replace(mark, text=f"{model_name}: {mark.text}")
            for mark in marks
            if not mark.true
        ]
        return true_marks + predicted_marks

    def _by_task(
        self, output: Sequence[Outputs], truth: Truths
    ) -> list[tuple[Any, Any, Any]]:
        """Return each task with the output of its model and its truth."""
        return list(zip(self.tasks, regroup_by_model(output), truth, strict=True))


# ---- a task for every thing in an image ----
#
# A prediction is right if it is right about all things. A search seeks a wrong prediction
# about any of them: loss and score are the largest over the things.

TruthByThing = Mapping[str, Truth]  # the truth of each thing, by name


@dataclass(frozen=True, kw_only=True)
class EachThingTask(JointTask):
    """Judge every thing in an image by one task; created by `make_each_thing_task`."""

    name = "each thing"

    thing_task: Task  # the task for a single thing, bound to its model

    @property
    def member_tasks(self) -> tuple[Task, ...]:
        return (self.thing_task,)

    def after_calibration(
        self, output: Output, truth: TruthByThing | None
    ) -> EachThingTask:
        """Calibrate the task with the truth of the first thing, which is the object."""
        first_truth = None if truth is None else next(iter(truth.values()))
        return replace(
            self, thing_task=self.thing_task.after_calibration(output, first_truth)
        )

    def check(self, facts: Facts) -> None:
        for thing in facts.facts_of_thing.values():
            self.thing_task.check(thing)

    def truth(self, facts: Facts) -> TruthByThing:
        return {
            name: self.thing_task.truth(thing)
            for name, thing in facts.facts_of_thing.items()
        }

    def loss(self, output: Output, truth: TruthByThing) -> Tensor:
        """Compute the largest loss over the things, (N,)."""
        return self._max_over_things("loss", output, truth)

    def score(self, output: Output, truth: TruthByThing) -> Tensor:
        """Compute the largest score over the things, (N,)."""
        if self.minimise:
            return -self.loss(output, truth)
        return self._max_over_things("score", output, truth)

    def pixel_margin(self, output: Output, truth: TruthByThing) -> Tensor:
        """Compute the largest pixel margin over the things, (N,); for segmentation."""
        return self._max_over_things("pixel_margin", output, truth)

    def _max_over_things(
        self, method: str, output: Output, truth: TruthByThing
    ) -> Tensor:
        """Compute the largest value of a method of the task over the things, (N,)."""
        function = getattr(self.thing_task, method)
        values = [function(output, thing_truth) for thing_truth in truth.values()]
        return torch.stack(values).amax(dim=0)

    def predictions(
        self, output: Output, count: int = 1
    ) -> list[tuple[Prediction, ...]]:
        return self.thing_task.predictions(output, count)

    def describe(
        self, output: Output, truth: TruthByThing, margins: Sequence[float]
    ) -> list[PredictionWithPayload]:
        """Return the prediction about the worst visible thing in each image.

        The payload is that of the worst thing. It also has the name of this thing
        ("worst"), the mean margin, and a summary of the judgement of each thing
        ("things").

        Args:
            output: output of N images.
            truth: truth of each thing, by its name.
            margins: not used; the margin of each thing is computed here.
        """
        judgements_of_things = [
            self.thing_task.judge(output, thing_truth) for thing_truth in truth.values()
        ]
        results: list[PredictionWithPayload] = []
        for image_judgements in zip(*judgements_of_things, strict=True):
            by_name: dict[str, Judgement] = dict(
                zip(truth, image_judgements, strict=True)
            )
            worst = _find_worst_thing(by_name)
            payload = _make_thing_payload(by_name, worst)
            results.append((by_name[worst].prediction, payload))
        return results

    def marks(self, output: Output, truth: TruthByThing) -> list[list[Mark]]:
        """Return the marks to draw on each image.

        They are the true marks of all things, and the predicted ones once.
        """
        marks_of_things = [
            self.thing_task.marks(output, thing_truth) for thing_truth in truth.values()
        ]
        marks_of_images = []
        for image_marks in zip(*marks_of_things, strict=True):
            # The predicted marks are the same for each thing.
            marks = [mark for thing in image_marks for mark in thing if mark.true]
            marks += [mark for mark in image_marks[0] if not mark.true]
            marks_of_images.append(marks)
        return marks_of_images


def _find_worst_thing(judgements: Mapping[str, Judgement]) -> str:
    """Return the name of the thing with the smallest margin among the visible ones.

    If none is visible, it is that of all things.
    """
    visible = [
        name
        for name, judgement in judgements.items()
        if not judgement.prediction.is_out_of_view
    ]
    return min(visible or judgements, key=lambda name: judgements[name].margin)


def _make_thing_payload(
    judgements: Mapping[str, Judgement], worst: str
) -> dict[str, JsonValue]:
    """Return the payload of an image, from the judgement of each thing by name.

    Args:
        judgements: judgement of each thing.
        worst: name of the worst visible thing, whose payload is included.
    """
    worst_payload = judgements[worst].payload
    margins = [judgement.margin for judgement in judgements.values()]
    return {
        **(worst_payload if isinstance(worst_payload, dict) else {}),
        "worst": worst,
        "mean_margin": mean(margins),
        "things": {
            name: _summarize_thing(judgement) for name, judgement in judgements.items()
        },
    }


def _summarize_thing(judgement: Judgement) -> dict[str, JsonValue]:
    """Return the summary of a thing's judgement for a payload."""
    summary: dict[str, JsonValue] = {
        "right": judgement.right,
        "margin": judgement.margin,
        "answer": judgement.prediction.label,
        **make_outcome_payload(judgement),
    }
    if isinstance(judgement.payload, dict) and "box" in judgement.payload:
        summary["box"] = judgement.payload["box"]
    return summary


def make_each_thing_task(task: Task) -> EachThingTask:
    """Return a task that judges every thing in the scene by the given task.

    Args:
        task: task that judges one thing, already bound to its model.

    Raises:
        InputError: its models make one prediction about the full image, or there are
            several models.
    """
    if isinstance(task, EnsembleTask) or task.name not in PER_THING_TASKS:
        raise InputError(
            f"judge: all is for {' and '.join(PER_THING_TASKS)}, got task {task.name}; "
            "judge one thing, by its name"
        )
    # `name` and `objective` are attributes of a class, and differ from task to task. So a
    # subclass is made for this task.
    attributes = {"name": task.name, "objective": task.objective}
    task_class: Any = type("EachThing", (EachThingTask,), attributes)
    result: EachThingTask = task_class(
        thing_task=task, minimise=task.minimise, target=task.target
    )
    return result


PER_THING_TASKS: Sequence[str] = ("detection", "segmentation", "depth")
"""Tasks whose output for an image covers each thing in it."""
