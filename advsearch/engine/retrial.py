"""Answers of searches tried again: on other models, or in other pictures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from advsearch.attacks import Ending, Evaluation, Verification, run_trials, verify
from advsearch.attacks.evaluation import Query
from advsearch.cluster.executor import Executor
from advsearch.engine.journal import Journal
from advsearch.engine.problem import Problem
from advsearch.engine.sharing import Shared
from advsearch.errors import InputError
from advsearch.progress import Progress
from advsearch.runs.directory import RunDirectory
from advsearch.runs.summary import read_answer
from advsearch.scene.formation import to_8_bit
from advsearch.tasks import Judgement


def unchanged(picture: Tensor, seed: int) -> Tensor:
    """Return a picture as it is."""
    return picture


@dataclass(frozen=True, eq=False)
class RetrialCondition:
    """What an answer is tried under.

    Attributes:
        name: in tables and in the kinds of rows.
        problem: renders, asks and judges.
        spp: samples a pixel.
        source: conditions with equal sources are shown the same picture before it is changed.
        change: what happens to a picture (H, W, 3) sRGB in [0, 1] before the model sees it, by the seed of its trial.
        light: conditions with equal lights get their pictures from one linear radiance: their scenes are the same, only
            tone curves or models differ. None: this one renders by itself.
    """

    name: str
    problem: Problem
    spp: int
    source: Hashable
    change: Callable[[Tensor, int], Tensor] = unchanged
    light: Hashable = None


class Retrials:
    """Tries the clean scene and answers under conditions; what the run has stored already is read back.

    Trial k has the same seed for the clean scene, for every answer and under every condition.

    Args:
        conditions: at least one.
        run: keeps the rows.
        progress: told of every trial.
        trials: of each answer under each condition.
        seed: root of these trials, which nothing else uses.
        executor: of workers that hold the problems by the names of their conditions; None makes pictures here.
    """

    def __init__(
        self,
        conditions: Sequence[RetrialCondition],
        run: RunDirectory,
        progress: Progress,
        *,
        trials: int,
        seed: int,
        executor: Executor | None = None,
    ) -> None:
        self._conditions, self._progress, self._count, self._seed = conditions, progress, trials, seed
        first = Journal(run, Shared(conditions[0].problem))
        self._journals = {
            one.name: replace(first, traced=Shared(one.problem, executor, one.name)) for one in conditions
        }
        self._clean: dict[str, tuple[Judgement, ...]] = {}
        self._pictures: dict[tuple[Hashable, int, int], Tensor] = {}
        self._lights: dict[tuple[Hashable, int, int], Tensor] = {}
        self._sharing = Counter(one.light for one in conditions if one.light is not None)
        self._pictured = ""

    def clean(self, condition: RetrialCondition) -> tuple[Judgement, ...]:
        """Try the clean scene under one condition, once."""
        if condition.name not in self._clean:
            self._clean[condition.name] = run_trials(
                partial(self._answers, "clean", condition),
                condition.problem.domain.start,
                spp=condition.spp,
                seed=self._seed,
                trials=self._count,
                kind=f"clean under {condition.name}",
            )
        return self._clean[condition.name]

    def answer(self, kind: str, u: Tensor, condition: RetrialCondition) -> Verification:
        """Try an answer (d,) under one condition, beside the clean scene; a claim of nothing is never confirmed.

        Args:
            kind: what it is called among the rows; "KIND under CONDITION" is theirs.
            u: (d,) the configuration.
            condition: one of those.
        """
        return verify(
            partial(self._answers, kind, condition),
            condition.problem.domain,
            u,
            claim=Ending.NOT_VERIFIED,
            spp=condition.spp,
            seed=self._seed,
            trials=self._count,
            clean=self.clean(condition),
            rule=condition.problem.rule,
            kind=f"{kind} under {condition.name}",
        )

    def _answers(self, kind: str, condition: RetrialCondition, queries: Sequence[Query]) -> Iterator[Evaluation]:
        """Answer the trials of one configuration under one condition."""
        changed = partial(self._changed, kind, condition)
        for answer in self._journals[condition.name].answers(queries, changed):
            self._progress.advance(1)
            yield answer

    def _changed(self, kind: str, condition: RetrialCondition, queries: Sequence[Query]) -> Iterator[Evaluation]:
        """Judge pictures as the condition changes them; those of the configuration that is tried now are kept for other
        conditions."""
        if kind != self._pictured:
            self._pictures.clear()
            self._lights.clear()
            self._pictured = kind
        keys = [(condition.source, one.seed, condition.spp) for one in queries]
        new = [
            replace(one, wanted="picture") for one, key in zip(queries, keys, strict=True) if key not in self._pictures
        ]
        made = self._made(condition, new)
        for query, key in zip(queries, keys, strict=True):
            machine = None
            if key not in self._pictures:
                self._pictures[key], machine = next(made)
            picture = condition.change(self._pictures[key], query.seed)
            said = condition.problem.judge(to_8_bit(picture), condition.problem.whole(query.u, query.seed))
            yield Evaluation.of(said, machine=machine)

    def _made(self, condition: RetrialCondition, queries: Sequence[Query]) -> Iterator[tuple[Tensor, str | None]]:
        """Pictures of a condition's problem, by workers where there are some, and on which machine."""
        shared = self._journals[condition.name].traced
        if shared.executor is None or len(queries) < 2:
            for query in queries:
                yield self._rendered(condition, query.u, query.seed), None
            return
        for answer in shared(queries):
            assert answer.picture is not None
            yield answer.picture, answer.machine

    def _rendered(self, condition: RetrialCondition, u: Tensor, seed: int) -> Tensor:
        """As `Problem.picture`, from the radiance of other conditions with the same light where there are any."""
        problem, key = condition.problem, (condition.light, seed, condition.spp)
        if self._sharing[condition.light] < 2:
            return problem.picture(u, seed, condition.spp)
        renderer, whole = problem.renderer, problem.whole(u, seed)
        with torch.no_grad():
            if key not in self._lights:
                self._lights[key] = renderer.radiance(whole, seed, condition.spp)
            return to_8_bit(renderer.space.picture(whole, renderer.formation.display(self._lights[key])))


def kept_answer(folder: Path, problem: Problem) -> torch.Tensor:
    """Return the configuration (d,) that a run answers with, of its problem loaded again.

    Raises:
        InputError: the scene is another one now.
        FileFormatError: there is none.
    """
    u = torch.from_numpy(read_answer(folder))
    if u.shape != problem.domain.start.shape:
        raise InputError(
            f"{folder}: its answer has {len(u)} numbers, and its scene has {problem.domain.dim} now: the object or "
            "advsearch has changed since; do the run again"
        )
    return u
