"""Goes on with a run that was stopped: what it has evaluated already is read back, not rendered again."""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from advsearch.attacks import Evaluate, Evaluation
from advsearch.attacks.evaluation import Wanted
from advsearch.engine.going_on import same
from advsearch.engine.problem import OnImage
from advsearch.engine.rows import judgement_of
from advsearch.errors import InputError
from advsearch.runs.directory import RunDirectory
from advsearch.runs.store import Row, Told
from advsearch.scene.formation import levels_of, to_8_bit
from advsearch.tasks import Judgement

PLAN = "gradient plan"
"""The note under which the store keeps how derivatives are obtained."""

TRANSPORT = "transport"
"""That under which it keeps at which evaluations the matrix of light transport was made anew."""


class Frames:
    """Pictures of a search for its animation: at most some sixty of them.

    Args:
        steps: evaluations there will be at most.

    Attributes:
        pictures: (H, W, 3) 8-bit values in [0, 1], numpy.
    """

    def __init__(self, steps: int) -> None:
        self.pictures: list[Any] = []
        self._steps, self._every = steps, max(1, -(-steps // 60))

    def wants(self, index: int) -> bool:
        """Whether the picture of the evaluation with this index belongs to them."""
        return index < self._steps and index % self._every == 0

    def add(self, image: Tensor) -> Tensor:
        """Take a picture (H, W, 3) sRGB in [0, 1], and return it rounded to 8 bits."""
        rounded = to_8_bit(image)
        self.pictures.append(rounded.numpy())
        return rounded


class Memory:
    """What a run has stored so far. Without a run directory it remembers nothing.

    Args:
        run: the open run directory, or None.

    Attributes:
        counts: rows of each kind that were there when the run was opened.
    """

    def __init__(self, run: RunDirectory | None) -> None:
        self._run = run
        self.counts: dict[str, int] = {} if run is None else run.store.counts()
        self._trials: dict[tuple[str, int], Row] = {}
        self._pictures: dict[tuple[str, int], Tensor] = {}
        if run is not None and self.counts:
            for kind in self.counts:
                if is_search(kind):
                    continue
                self._trials |= {(kind, row.step): row for row in run.store.rows(kind)}

    def holds(self, kind: str, step: int) -> bool:
        """Whether the row of this step is in the store already."""
        return step < self.counts.get(kind, 0)

    def evaluation(self, kind: str, number: int) -> Evaluation | None:
        """Return an evaluation that is read back, or None."""
        stored = self._stored(kind, number)
        return None if stored is None else _evaluation(*stored)

    def _stored(self, kind: str, number: int) -> tuple[Row, Told] | None:
        """What the store has of an evaluation; None once the run is done."""
        return None if self._run is None or not self.holds(kind, number) else self._run.store.told(kind, number)

    def evaluator(
        self,
        kind: str,
        make: Callable[[OnImage | None], Evaluate],
        frames: Frames | None = None,
        on_read: Callable[[str, int, Tensor], None] = lambda kind, index, u: None,
    ) -> Evaluate:
        """Return the evaluation that reads back what the store has of this kind, and makes what it has not.

        Args:
            kind: of search.
            make: makes the real one, which tells its pictures.
            frames: what keeps pictures of the search.
            on_read: told of each evaluation that is read back: kind, index, configuration.

        Raises:
            InputError: when called, if another configuration is proposed than the one that was stored.
        """

        def keep(index: int, image: Tensor) -> None:
            if frames is not None:
                self._pictures[kind, index] = frames.add(image)

        evaluate, count = make(None if frames is None else OnImage(frames.wants, keep)), 0
        if self._run is None:
            return evaluate

        def remembered(u: Tensor, *, index: int, gradient: Wanted, samples: int = 1) -> Evaluation:
            nonlocal count
            number, count = count, count + 1
            stored = self._stored(kind, number)
            if stored is None:
                return evaluate(u, index=index, gradient=gradient, **({} if samples == 1 else {"samples": samples}))
            row, told = stored
            self._check(kind, number, told, u, index)
            on_read(kind, index, u)
            if frames is not None and told.picture is not None:
                frames.add(torch.from_numpy(told.picture.copy()).float() / 255.0)
            return _evaluation(row, told)

        return remembered

    def told(self, kind: str, index: int, u: Tensor, evaluation: Evaluation) -> Told:
        """Return what an evaluation told its search beside its row, with the picture that was kept of it."""
        picture, gradient = self._pictures.pop((kind, index), None), evaluation.gradient
        return Told(
            number=index,
            u=_digest(u),
            non_finite=evaluation.non_finite,
            cost=evaluation.cost,
            gradient=None if gradient is None else gradient.detach().numpy(),
            picture=None if picture is None else levels_of(picture).numpy(),
        )

    def clock(self, kind: str, steps: int, seconds: float | None) -> Callable[[int], bool] | None:
        """Return what says whether the time of a search is over, that of its earlier lives included.

        An evaluation that is read back never ends the search before the one after which it was ended; if the store has
        renders of the ranking, that is the last one before these.

        Args:
            kind: of search.
            steps: of it; the ranking's renders have indices from there on.
            seconds: allowed; None for no limit.
        """
        if seconds is None:
            return None
        stored = [one for number in range(self.counts.get(kind, 0)) if (one := self._stored(kind, number)) is not None]
        explored = [row for row, told in stored if told.number < steps]
        left = seconds - math.fsum(row.seconds or 0.0 for row in explored)
        ended, begun = len(stored) > len(explored), time.perf_counter()

        def late(count: int) -> bool:
            if count < len(explored):
                return False
            return ended or time.perf_counter() - begun >= left

        return late

    def trial(self, kind: str, number: int) -> Judgement | None:
        """Return a trial that was made already, or None; one of an older run that does not say what was right, too."""
        row = self._trials.get((kind, number))
        return None if row is None or row.correct is None else judgement_of(row)

    def note(self, key: str) -> Any:
        """Return the JSON value that was noted, or None."""
        return None if self._run is None else self._run.store.noted(key)

    def set_note(self, key: str, value: Any) -> None:
        """Keep a JSON value."""
        if self._run is not None:
            self._run.store.set_note(key, json.dumps(value))

    def other_answers(self, values: Mapping[str, tuple[float | None, float | None]]) -> InputError:
        """Return the error of a run that goes on with another model or objective, from what these said and say."""
        told = ", ".join(
            f"{name} was {before} and is {now}" for name, (before, now) in values.items() if not same([before], [now])
        )
        path, again = ("", "") if self._run is None else (self._run.path, self._run.again)
        return InputError(
            f"{path}: cannot go on: the same picture of the clean scene has other values now ({told}), so model, "
            f"objective or scene are not those that it began with; take these again, or {again}"
        )

    def _check(self, kind: str, number: int, told: Told, u: Tensor, index: int) -> None:
        if told.u != _digest(u) or told.number != index:
            path, again = ("", "") if self._run is None else (self._run.path, self._run.again)
            raise InputError(
                f"{path}: cannot go on: evaluation {number} of the {kind} is another one now than it was, "
                f"so advsearch, its packages or the number of threads have changed since; {again}"
            )


def is_search(kind: str) -> bool:
    """Whether rows of a kind are evaluations of a search; all others are trials."""
    return kind == "baseline" or kind.startswith("search")


def _evaluation(row: Row, told: Told) -> Evaluation:
    judgement = None if row.correct is None else judgement_of(row)
    return Evaluation(
        objective=math.nan if row.objective is None else row.objective,
        gradient=None if told.gradient is None else torch.from_numpy(told.gradient.copy()),
        success=bool(row.success),
        non_finite=told.non_finite,
        cost=told.cost,
        judgement=judgement,
    )


def _digest(u: Tensor) -> bytes:
    return hashlib.blake2b(np.ascontiguousarray(u.detach().numpy()).tobytes(), digest_size=16).digest()
