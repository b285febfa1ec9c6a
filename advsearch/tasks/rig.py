"""Task for a rig: several cameras that take images of the same configuration.

Each image is judged by the same task, and a rule combines the judgements.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from advsearch.extend import InputError, Model, Task, models, tasks

RULES = ("any", "all", "mean", "vote")
"""Conditions for a right prediction of the rig: it is right in any image, in all images,
by the mean of the losses, or in more than half of the images.
"""


@dataclass(frozen=True, kw_only=True)
class Rig(tasks.JointTask):
    """Combine the predictions about the images of several cameras in one configuration.

    Each image has its own truth, such as the object's box in that image. The loss of the
    rig is the smallest ("any"), the largest ("all") or the mean ("mean") of the losses of
    its images, or the smallest number that more than half of the losses do not exceed
    ("vote").

    Args:
        task: task of each image: a name, or a mapping with a `name` and options.
        rule: one of `RULES`.

    Raises:
        InputError: no such rule.
    """

    name = "rig"
    judges_rig = True

    task: Any = "classification"
    rule: str = RULES[0]
    # task of each image, for the model
    image_task: Any = field(default=None, metadata=tasks.FROM_RUN)
    # number of cameras
    cameras: int = field(default=1, metadata=tasks.FROM_RUN)

    def __post_init__(self) -> None:
        """Check the rule, and that the task is a name, a mapping or a task."""
        if self.rule not in RULES:
            raise InputError(
                f"task rig: rule: expected one of {', '.join(RULES)}, got {self.rule!r}"
            )
        if not isinstance(self.task, (str, Mapping, Task)):
            raise InputError(
                "task rig: task: expected a name, or a mapping with a `name`, got "
                f"{self.task!r:.80}"
            )

    @property
    def member_tasks(self) -> tuple[Any, ...]:
        return (self.image_task,)

    @property
    def single_image_task(self) -> Task:
        task: Task = self.image_task
        return task

    @property
    def title(self) -> str:
        return (
            f"{self.name} of {self.image_task.title if self.image_task else self.task}"
        )

    def on(
        self, model: Model, *, target: str | None = None, minimise: bool = False
    ) -> Rig:
        """Return the task for a model that takes the images of several cameras.

        Args:
            model: the model, whose `cameras` is the number of images of a rig.
            target: name of the class that the attack seeks; None for any wrong one.
            minimise: whether a right prediction is sought.

        Raises:
            InputError: there is a single camera; or the task needs a single output for
                all images, and the model takes them one by one.
        """
        if model.cameras < 2:
            raise InputError(
                "task rig: expected a rig, got one camera; set `camera=rig.yaml`"
            )
        # The task of an image does not depend on the number of cameras.
        image_model = replace(model, cameras=1)
        part = self.image_task.on(image_model, target=target, minimise=minimise)
        _check_takes_all_images(model, part)
        return replace(
            self,
            image_task=part,
            cameras=model.cameras,
            target=part.target,
            minimise=minimise,
        )

    def with_objective(self, objective: str) -> Rig:
        return replace(self, image_task=self.image_task.with_objective(objective))

    def check(self, facts: tasks.Facts) -> None:
        self.image_task.check(facts)

    def read(self, returned: Any, count: int) -> Any:
        return returned

    def after_calibration(
        self, output: Sequence[tasks.Outputs], truth: tasks.Truths | None
    ) -> Rig:
        """Calibrate the task of the images on the clean image of the first camera."""
        first_rig = output[0]
        first_output = first_rig[0]
        first_truth = None if truth is None else truth[0]
        part = self.image_task.after_calibration(first_output, first_truth)
        return replace(self, image_task=part)

    def truth(self, facts: tasks.Facts) -> tasks.Truths:
        """Return the truth of each image."""
        # without views, all cameras have the same facts
        views = facts.facts_of_views or (facts,) * self.cameras
        return tuple(self.image_task.truth(view) for view in views)

    def loss(self, output: Sequence[tasks.Outputs], truth: tasks.Truths) -> Tensor:
        """Combine the losses of the images by the rule, (N,)."""
        return self._combine(self._map_images(self.image_task.loss, output, truth))

    def score(self, output: Sequence[tasks.Outputs], truth: tasks.Truths) -> Tensor:
        """Combine the scores of the images by the rule, (N,).

        With a target, the rig is a success if it reaches the target by the rule, e.g. in
        any of its images. With `minimise` it is a success if it is right by the rule.
        """
        scores = self._map_images(self.image_task.score, output, truth)
        if self.target is not None or self.minimise:
            # Such a score is minus a loss: that of the target, or that of the truth. The
            # rule combines losses, so the sign is changed before and after it.
            return -self._combine(-scores)
        # Otherwise the score is a loss itself: over 0 for a wrong prediction.
        return self._combine(scores)

    @staticmethod
    def _map_images(
        function: Callable[[Any, tasks.Truth], Tensor],
        output: Sequence[tasks.Outputs],
        truth: tasks.Truths,
    ) -> Tensor:
        """Apply a function to each of K images of each of N rigs, (N, K).

        Args:
            function: loss or score of the task of a single image.
            output: outputs of the images of each rig.
            truth: truth of each image of the rig.
        """
        rows = []
        for image_outputs in output:
            pairs = zip(image_outputs, truth, strict=True)
            values = [function(*pair) for pair in pairs]
            rows.append(torch.cat(values))
        return torch.stack(rows)

    def _combine(self, values: Tensor) -> Tensor:
        """Combine the losses of a rig's images (N, K) by the rule, (N,).

        A loss over 0 means a wrong prediction. Under the rules "any", "all" and "vote"
        the loss of one image, chosen by its rank, is the loss of the rig.
        """
        if self.rule == "mean":
            return values.mean(dim=1)
        n_images = values.shape[1]
        # index of the deciding loss, if losses are in ascending order
        rank_by_rule = {
            # The rig is right if any image is: the smallest loss decides.
            "any": 0,
            # It is right if all images are: the largest loss decides.
            "all": n_images - 1,
            # It is right if more than half of the images are. For four images the third
            # loss decides: if it is not over 0, three images are right.
            "vote": n_images // 2,
        }
        return values.sort(dim=1).values[:, rank_by_rule[self.rule]]

    def predictions(
        self, output: Sequence[tasks.Outputs], count: int = 1
    ) -> list[tuple[tasks.Prediction, ...]]:
        """Return a single prediction for each rig: those about its images, joined.

        Args:
            output: outputs of the images of each rig.
            count: not used; there is only one joined prediction.
        """
        predictions_of_rigs: list[tuple[tasks.Prediction, ...]] = []
        for image_outputs in output:
            predictions = []
            for image_output in image_outputs:
                (image_predictions,) = self.image_task.predictions(image_output)
                predictions.append(image_predictions[0])
            predictions_of_rigs.append((tasks.join_predictions(predictions),))
        return predictions_of_rigs

    def judge(
        self, output: Sequence[tasks.Outputs], truth: tasks.Truths
    ) -> list[tasks.Judgement]:
        """Judge the predictions of each rig; the payload has the judgement of each image.

        Args:
            output: outputs of the images of each rig.
            truth: truth of each image of the rig.
        """
        with torch.no_grad():
            # not `-loss`, which would be -0.0 for a loss of 0
            margins = (0.0 - self.loss(output, truth)).tolist()
            scores = self.score(output, truth).tolist()
        rig_judgements = []
        for image_outputs, margin, score in zip(output, margins, scores, strict=True):
            judgements = self._judge_images(image_outputs, truth)
            # The rule may ignore an image with NaN, but the rig's judgement is NaN then.
            if any(judgement.is_non_finite for judgement in judgements):
                margin = math.nan
            rig_judgements.append(self._join_judgements(judgements, margin, score))
        return rig_judgements

    def _judge_images(
        self, outputs: tasks.Outputs, truth: tasks.Truths
    ) -> list[tasks.Judgement]:
        """Return the judgement of each image of a single rig."""
        return [
            self.image_task.judge(image_output, image_truth)[0]
            for image_output, image_truth in zip(outputs, truth, strict=True)
        ]

    def _join_judgements(
        self, judgements: Sequence[tasks.Judgement], margin: float, score: float
    ) -> tasks.Judgement:
        """Return the judgement of a rig.

        Args:
            judgements: the judgements of its images.
            margin: joint margin by the rule; NaN if an image has none.
            score: joint score by the rule.
        """
        image_payloads: list[tasks.JsonValue] = [
            _make_image_payload(judgement) for judgement in judgements
        ]
        prediction = tasks.join_predictions(
            judgement.prediction for judgement in judgements
        )
        deciding = self._find_deciding_judgement(judgements, margin)
        outcome = tasks.make_outcome_payload(deciding)
        payload = {"pictures": image_payloads, **outcome}
        return tasks.Judgement.from_margin(score, margin, prediction, payload)

    def _find_deciding_judgement(
        self, judgements: Sequence[tasks.Judgement], margin: float
    ) -> tasks.Judgement:
        """Return the judgement of the image that decides about the rig.

        Under the rule "mean" all images contribute, and the worst one is returned.

        Args:
            judgements: judgements of the images.
            margin: margin of the rig.
        """
        if self.rule == "mean":
            return min(judgements, key=lambda judgement: judgement.margin)
        # Under other rules the rig's margin is the margin of one of its images: the image
        # with the smallest difference, which is 0. If the margin is NaN, this is any
        # image, and the outcome is not stored.
        return min(judgements, key=lambda judgement: abs(judgement.margin - margin))

    def marks(
        self, output: Sequence[tasks.Outputs], truth: tasks.Truths
    ) -> list[list[tasks.Mark]]:
        """Return the marks of each rig: those of its first image.

        The images of a rig are drawn side by side, and the first one is the leftmost,
        so that positions in it are positions in the joined image.
        """
        marks_of_rigs = []
        for image_outputs in output:
            marks = self.image_task.marks(image_outputs[0], truth[0])[0]
            # A map would be drawn next to the image, where the second image is.
            flat_marks = [mark for mark in marks if mark.map is None]
            marks_of_rigs.append(
                [replace(mark, mask=self._pad_to_rig(mark.mask)) for mark in flat_marks]
            )
        return marks_of_rigs

    def _pad_to_rig(self, mask: Tensor | None) -> Tensor | None:
        """Widen the mask of the first image to all images in a row."""
        if mask is None:
            return None
        other_images = [torch.zeros_like(mask)] * (self.cameras - 1)
        return torch.cat([mask, *other_images], dim=-1)


def _check_takes_all_images(model: Model, part: Task) -> None:
    """Raise InputError if a task needs one output for all images of a rig, and the
    model takes them one by one.
    """
    if part.needs_all_images and not isinstance(model.module, models.AllAtOnce):
        raise InputError(
            f"task rig: task {part.name} judges one output for all pictures; use a "
            "policy that takes all of them at once, as "
            "advsearch.models.all_at_once.AllAtOnce"
        )


def _make_image_payload(judgement: tasks.Judgement) -> tasks.JsonValue:
    """Return what is stored about one image of a rig, from its judgement."""
    return {
        "prediction": judgement.prediction.label,
        "right": judgement.right,
        "payload": judgement.payload,
    }
