"""A rig of cameras: a task for each picture, and a rule that makes one prediction of them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from advsearch.errors import InputError
from advsearch.models import Model
from advsearch.models.all_at_once import AllAtOnce
from advsearch.options import FROM_RUN
from advsearch.tasks.base import Facts, Judgement, Mark, Prediction, Task, Truth
from advsearch.tasks.command import Command
from advsearch.tasks.together import Outputs, all_said

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
