"""Answers of searches tried again: on other models, or in other pictures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from advsearch.attacks import Ending, Verification, run_trials, verify
from advsearch.engine.ahead import Ahead, PictureAhead, line_of
from advsearch.engine.memory import Memory
from advsearch.engine.problem import Problem
from advsearch.engine.record import Recorder
from advsearch.progress import Progress
from advsearch.runs.directory import RunDirectory
from advsearch.scene.formation import to_8_bit
from advsearch.seeds import stream
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
        ahead: workers make the pictures before their turn.
    """

    def __init__(
        self,
        conditions: Sequence[RetrialCondition],
        run: RunDirectory,
        progress: Progress,
        *,
        trials: int,
        seed: int,
        ahead: Ahead | None = None,
    ) -> None:
        self._conditions, self._progress, self._count, self._seed = conditions, progress, trials, seed
        memory = Memory(run)
        self._stored = memory.trial
        self._recorders = {one.name: Recorder(run, one.problem, memory) for one in conditions}
        self._clean: dict[str, tuple[Judgement, ...]] = {}
        self._pictures: dict[tuple[Hashable, int, int], Tensor] = {}
        self._lights: dict[tuple[Hashable, int, int], Tensor] = {}
        self._sharing = Counter(one.light for one in conditions if one.light is not None)
        self._pictured = ""
        self._ahead = ahead or Ahead()

    def clean(self, condition: RetrialCondition) -> tuple[Judgement, ...]:
        """Try the clean scene under one condition, once."""
        if condition.name not in self._clean:
            self._clean[condition.name] = run_trials(
                self._trial("clean", condition),
                condition.problem.domain.start,
                spp=condition.spp,
                seed=self._seed,
                trials=self._count,
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
            self._trial(kind, condition),
            condition.problem.domain,
            u,
            claim=Ending.NOT_VERIFIED,
            spp=condition.spp,
            seed=self._seed,
            trials=self._count,
            clean=self.clean(condition),
            rule=condition.problem.rule,
        )

    def _trial(self, kind: str, condition: RetrialCondition) -> Callable[[Tensor, int, int], Judgement]:
        """Trials of one configuration, one after the other."""
        problem, rows, count = condition.problem, f"{kind} under {condition.name}", 0

        def trial(u: Tensor, seed: int, spp: int) -> Judgement:
            nonlocal count
            number, count = count, count + 1
            judged = self._stored(rows, number)
            if judged is None:
                if not self._ahead.begun:
                    self._announce(kind, condition, u, range(number, self._count))
                picture = condition.change(self._picture(kind, condition, u, seed), seed)
                judged = problem.judge(to_8_bit(picture), problem.whole(u, seed))
            self._recorders[condition.name].trial(rows, number, spp, judged, seed, u)
            self._progress.advance(1)
            return judged

        return trial

    def _announce(self, kind: str, condition: RetrialCondition, u: Tensor, numbers: range) -> None:
        """Have the pictures of these trials made beforehand that are not there."""
        rows = f"{kind} under {condition.name}"
        new = [stream(self._seed, "verification", one) for one in numbers if self._stored(rows, one) is None]
        wanted = [one for one in new if kind != self._pictured or self._key(condition, one) not in self._pictures]
        pictures = (PictureAhead(u, one, condition.spp, condition.name) for one in wanted)
        self._ahead.begin([line_of(one) for one in pictures])

    @staticmethod
    def _key(condition: RetrialCondition, seed: int) -> tuple[Hashable, int, int]:
        return condition.source, seed, condition.spp

    def _picture(self, kind: str, condition: RetrialCondition, u: Tensor, seed: int) -> Tensor:
        """The picture of a trial; those of the configuration that is tried now are kept for other conditions."""
        if kind != self._pictured:
            self._pictures.clear()
            self._lights.clear()
            self._pictured = kind
        key = self._key(condition, seed)
        if key not in self._pictures:
            seen = self._ahead.take(PictureAhead(u, seed, condition.spp, condition.name))
            self._pictures[key] = self._rendered(condition, u, seed) if seen is None else seen.value
        return self._pictures[key]

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
