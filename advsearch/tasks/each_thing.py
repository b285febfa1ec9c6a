"""One task, asked of the object and of every thing beside it: a prediction is right where it is right about all of
them.

A search is after a wrong prediction about any of them: loss and score are the largest of the things' own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from advsearch.described import OUT_OF_VIEW
from advsearch.errors import InputError
from advsearch.tasks.base import Facts, Judgement, Mark, Output, Prediction, Task, Truth, mean
from advsearch.tasks.together import Together

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
