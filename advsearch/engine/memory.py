"""Goes on with a run that was stopped: what it has evaluated already is read back, not rendered again."""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Callable, Iterator, Mapping
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
from advsearch.runs.replay import Entry, LoggedEvaluation, LoggedJudgement
from advsearch.runs.store import Row
from advsearch.scene.formation import levels_of, to_8_bit
from advsearch.tasks import Answer, Judgement

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
        log = None if self._run is None else self._run.replay
        return _evaluation(log.read(kind, number)) if log is not None and (kind, number) in log else None

    def evaluator(
        self,
        kind: str,
        make: Callable[[OnImage | None], Evaluate],
        frames: Frames | None = None,
        on_read: Callable[[str, int, Tensor], None] = lambda kind, index, u: None,
    ) -> Evaluate:
        """Return the evaluation that reads back what the log has of this kind, and adds to it what it has not.

        Args:
            kind: of search.
            make: makes the real one, which tells its pictures.
            frames: what keeps pictures of the search.
            on_read: told of each evaluation that is read back: kind, index, configuration.

        Raises:
            InputError: when called, if another configuration is proposed than the one that was stored.
        """
        kept: dict[int, Tensor] = {}

        def told(index: int, image: Tensor) -> None:
            if frames is not None:
                kept[index] = frames.add(image)

        evaluate = make(None if frames is None else OnImage(frames.wants, told))
        if self._run is None:
            return evaluate
        log, count = self._run.replay, 0

        def remembered(u: Tensor, *, index: int, gradient: Wanted, samples: int = 1) -> Evaluation:
            nonlocal count
            number, count = count, count + 1
            if (kind, number) in log:
                entry = log.read(kind, number)
                self._check(entry, u, index)
                on_read(kind, index, u)
                if frames is not None and "picture" in entry.arrays:
                    frames.add(torch.from_numpy(entry.arrays["picture"]).float() / 255.0)
                return _evaluation(entry)
            begun = time.perf_counter()
            found = evaluate(u, index=index, gradient=gradient, **({} if samples == 1 else {"samples": samples}))
            log.append(_entry(kind, number, index, u, found, kept.pop(index, None), time.perf_counter() - begun))
            return found

        return remembered

    def clock(self, kind: str, steps: int, seconds: float | None) -> Callable[[int], bool] | None:
        """Return what says whether the time of a search is over, that of its earlier lives included.

        An evaluation that is read back never ends the search before the one after which it was ended; if the log has
        renders of the ranking, that is the last one before these.

        Args:
            kind: of search.
            steps: of it; the ranking's renders have indices from there on.
            seconds: allowed; None for no limit.
        """
        if seconds is None:
            return None
        entries = list(self._entries(kind))
        explored = [entry for entry in entries if entry.facts.index < steps]
        left = seconds - math.fsum(entry.facts.seconds for entry in explored)
        ended, begun = len(entries) > len(explored), time.perf_counter()

        def late(count: int) -> bool:
            if count < len(explored):
                return False
            return ended or time.perf_counter() - begun >= left

        return late

    def _entries(self, kind: str) -> Iterator[Entry]:
        if self._run is None:
            return
        log, number = self._run.replay, 0
        while (kind, number) in log:
            yield log.read(kind, number)
            number += 1

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

    def _check(self, entry: Entry, u: Tensor, index: int) -> None:
        if entry.facts.u != _digest(u) or entry.facts.index != index:
            path, again = ("", "") if self._run is None else (self._run.path, self._run.again)
            raise InputError(
                f"{path}: cannot go on: evaluation {entry.number} of the {entry.kind} is another one now than it was, "
                f"so advsearch, its packages or the number of threads have changed since; {again}"
            )


def is_search(kind: str) -> bool:
    """Whether rows of a kind are evaluations of a search; all others are trials."""
    return kind == "baseline" or kind.startswith("search")


def _entry(
    kind: str, number: int, index: int, u: Tensor, found: Evaluation, picture: Tensor | None, seconds: float
) -> Entry:
    facts = LoggedEvaluation(
        index=index,
        u=_digest(u),
        objective=found.objective.hex() if found.finite else str(found.objective),
        success=found.success,
        non_finite=found.non_finite,
        cost=found.cost,
        seconds=seconds,
        judgement=None if found.judgement is None else LoggedJudgement.of(found.judgement),
    )
    arrays = {}
    if found.gradient is not None:
        arrays["gradient"] = found.gradient.detach().numpy()
    if picture is not None:
        arrays["picture"] = levels_of(picture).numpy()
    return Entry(kind, number, facts, arrays)


def _evaluation(entry: Entry) -> Evaluation:
    facts, gradient = entry.facts, entry.arrays.get("gradient")
    text, told = facts.objective, facts.judgement
    return Evaluation(
        objective=float.fromhex(text) if "x" in text else float(text),
        gradient=None if gradient is None else torch.from_numpy(gradient),
        success=facts.success,
        non_finite=facts.non_finite,
        cost=facts.cost,
        judgement=None
        if told is None
        else Judgement(
            told.score, told.margin, told.right, Answer(**vars(told.answer)), told.payload, metrics=told.metrics
        ),
    )


def _digest(u: Tensor) -> str:
    return hashlib.blake2b(np.ascontiguousarray(u.detach().numpy()).tobytes(), digest_size=16).hexdigest()
