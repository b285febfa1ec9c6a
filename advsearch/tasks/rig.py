"""The task of a rig of cameras: a task for each picture, and a rule that makes one
prediction of them.
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
"""When the rig is right: in any picture, in all, on average of the losses, or in more
than half.
"""


@dataclass(frozen=True, kw_only=True)
class Rig(tasks.Joined):
    """Several cameras take pictures of one configuration, and one prediction is made of
    what a model says of each.

    Each picture has a truth of its own, such as the box in it. The loss of the rig is
    the least, the largest or the mean of its pictures' losses, or for `vote` the one
    that more than half of them are at or below.

    Args:
        task: of each picture: a name, or a mapping with a `name` and options.
        rule: one of `RULES`.

    Raises:
        InputError: no such rule.
    """

    name = "rig"
    judges_rig = True

    task: Any = "classification"
    rule: str = RULES[0]
    part: Any = field(default=None, metadata=tasks.FROM_RUN)  # the task on the model
    cameras: int = field(default=1, metadata=tasks.FROM_RUN)  # how many there are

    def __post_init__(self) -> None:
        if self.rule not in RULES:
            raise InputError(
                f"task rig: rule: expected one of {', '.join(RULES)}, got {self.rule!r}"
            )
        if not isinstance(self.task, (str, Mapping, Task)):
            raise InputError(
                "task rig: task: expected a name, or a mapping with a "
                f"`name`, got {self.task!r:.80}"
            )

    @property
    def judges(self) -> tuple[Any, ...]:
        return (self.part,)

    @property
    def of_one_image(self) -> Task:
        made: Task = self.part
        return made

    @property
    def title(self) -> str:
        return f"{self.name} of {self.part.title if self.part else self.task}"

    def on(
        self, model: Model, *, target: str | None = None, minimise: bool = False
    ) -> Rig:
        """See `Task.on`. Raises InputError where the scene is seen by one camera."""
        if model.cameras < 2:
            raise InputError(
                "task rig: expected a rig, got one camera; give it with "
                "`camera=rig.yaml`"
            )
        part = self.part.on(replace(model, cameras=1), target=target, minimise=minimise)
        if part.needs_all_images and not isinstance(model.module, models.AllAtOnce):
            raise InputError(
                "task rig: task command is of one action for all pictures; give a "
                "policy that takes them at once, as "
                "advsearch.models.all_at_once.AllAtOnce"
            )
        return replace(
            self,
            part=part,
            cameras=model.cameras,
            target=part.target,
            minimise=minimise,
        )

    def seeking(self, objective: str) -> Rig:
        return replace(self, part=self.part.seeking(objective))

    def check(self, facts: tasks.Facts) -> None:
        self.part.check(facts)

    def read(self, returned: Any, count: int) -> Any:
        return returned

    def after_calibration(
        self, output: Sequence[tasks.Outputs], truth: tasks.Truths | None
    ) -> Rig:
        return replace(
            self,
            part=self.part.after_calibration(
                output[0][0], None if truth is None else truth[0]
            ),
        )

    def truth(self, facts: tasks.Facts) -> tasks.Truths:
        return tuple(
            self.part.truth(view) for view in facts.views or (facts,) * self.cameras
        )

    def loss(self, output: Sequence[tasks.Outputs], truth: tasks.Truths) -> Tensor:
        return self._ruled(self._each("loss", output, truth))

    def score(self, output: Sequence[tasks.Outputs], truth: tasks.Truths) -> Tensor:
        """See `Task.score`: a target is reached, and a right prediction made, by the
        rule.
        """
        scores = self._each("score", output, truth)
        return (
            -self._ruled(-scores)
            if self.target is not None or self.minimise
            else self._ruled(scores)
        )

    def _each(
        self, value: str, output: Sequence[tasks.Outputs], truth: tasks.Truths
    ) -> Tensor:
        """A number of each picture, (N, K)."""
        of_picture: Callable[[Any, tasks.Truth], Tensor] = getattr(self.part, value)
        each = [
            [of_picture(*judged) for judged in zip(pictures, truth, strict=True)]
            for pictures in output
        ]
        return torch.stack([torch.cat(values) for values in each])

    def _ruled(self, wrong: Tensor) -> Tensor:
        """How wrong the rig is, (N,), from how wrong it is in each picture, (N, K)."""
        if self.rule == "mean":
            return wrong.mean(dim=1)
        place = {"any": 0, "all": wrong.shape[1] - 1, "vote": wrong.shape[1] // 2}[
            self.rule
        ]
        return wrong.sort(dim=1).values[:, place]

    def predictions(
        self, output: Sequence[tasks.Outputs], count: int = 1
    ) -> list[tuple[tasks.Prediction, ...]]:
        return [
            (tasks.all_said(self.part.predictions(picture)[0][0] for picture in each),)
            for each in output
        ]

    def judge(
        self, output: Sequence[tasks.Outputs], truth: tasks.Truths
    ) -> list[tasks.Judgement]:
        with torch.no_grad():
            margins = (0.0 - self.loss(output, truth)).tolist()
            scores = self.score(output, truth).tolist()
        judgements = []
        for pictures, margin, score in zip(output, margins, scores, strict=True):
            each = [
                self.part.judge(*judged)[0]
                for judged in zip(pictures, truth, strict=True)
            ]
            margin = math.nan if any(judged.not_a_number for judged in each) else margin
            kept: list[tasks.JsonValue] = [
                {
                    "prediction": judged.prediction.label,
                    "right": judged.right,
                    "payload": judged.payload,
                }
                for judged in each
            ]
            prediction = tasks.all_said(judged.prediction for judged in each)
            # the picture by which the rule decides; of the mean, the worst one
            deciding = min(
                each,
                key=lambda judged: (
                    judged.margin
                    if self.rule == "mean"
                    else abs(judged.margin - margin)
                ),
            )
            judgements.append(
                tasks.Judgement.of(
                    score,
                    margin,
                    prediction,
                    {"pictures": kept, **tasks.outcome_in(deciding)},
                )
            )
        return judgements

    def marks(
        self, output: Sequence[tasks.Outputs], truth: tasks.Truths
    ) -> list[list[tasks.Mark]]:
        """See `Task.marks`: those of the first picture, which is at the left."""

        def widened(mask: Tensor | None) -> Tensor | None:
            return (
                None
                if mask is None
                else torch.cat(
                    [mask, *[torch.zeros_like(mask)] * (self.cameras - 1)], dim=-1
                )
            )

        each = [self.part.marks(pictures[0], truth[0])[0] for pictures in output]
        return [
            [
                replace(mark, mask=widened(mark.mask))
                for mark in marks
                if mark.map is None
            ]
            for marks in each
        ]
