"""What an attack knows so far, and how long each stage took."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from advsearch.attacks import SampleCount, SearchResult, Verification
from advsearch.attacks.smallest import Bracket
from advsearch.engine.transport import Predictor
from advsearch.progress import Progress
from advsearch.tasks import Judgement

KEPT = 4
"""Pictures of each group of trials that are kept."""


@dataclass
class Findings:
    """What is known so far; whatever is still None or empty was not reached.

    Attributes:
        first_look: a few renders of the clean configuration at the search's sample count.
        search: what the policy claims.
        baseline: what the random search claims.
        sample_count: how the sample count of the verification was chosen.
        clean: the control group's trials.
        verification: of the policy's answer.
        baseline_verification: of the random search's.
        unprinted: what the policy claims without print terms, where the search has them.
        unprinted_verification: of that.
        beaten: verification of the policy's own answer, where the random search's turned out worse for the model and is
            the run's answer instead.
        failures: verification of the first of the different failures that the policy answers with.
        average: trials of configurations drawn from the whole space.
        smallest: the least epsilon, where it was asked for.
        pictures: of the first trials, (H, W, 3) with 8-bit values in [0, 1], by kind and number; of a run that goes on
            only those that it made itself.
        frames: some pictures of the search, (H, W, 3) 8-bit values in [0, 1], numpy, for the animation.
        interrupted: somebody pressed Ctrl-C.
        transport: what predicted the pictures of the searches, if anything did.
        rendered_because: why nothing did, in words.
        surface_refused: why matrices did and not light on surfaces, where that was tried.
        verification_renders: renders spent on choosing the sample count and on trials.
        predicted_trials: trials whose picture was predicted.
    """

    first_look: tuple[Judgement, ...] = ()
    search: SearchResult | None = None
    baseline: SearchResult | None = None
    sample_count: SampleCount | None = None
    clean: tuple[Judgement, ...] = ()
    verification: Verification | None = None
    baseline_verification: Verification | None = None
    unprinted: SearchResult | None = None
    unprinted_verification: Verification | None = None
    beaten: Verification | None = None
    failures: tuple[Verification, ...] = ()
    average: tuple[Judgement, ...] = ()
    smallest: Bracket | None = None
    pictures: dict[tuple[str, int], Tensor] = field(default_factory=dict)
    frames: list[Any] = field(default_factory=list)
    interrupted: bool = False
    transport: Predictor | None = None
    rendered_because: str = ""
    surface_refused: str = ""
    verification_renders: int = 0
    predicted_trials: int = 0

    @property
    def spp(self) -> int:
        """Samples a pixel of the verification.

        Raises:
            RuntimeError: it has not been chosen yet.
        """
        if self.sample_count is None:
            raise RuntimeError("the sample count of the verification has not been chosen yet")
        return self.sample_count.spp


class Stages:
    """Tells a watcher which stage runs, and keeps the time of each.

    Attributes:
        progress: the watcher.
        seconds: time of each stage by name, in seconds.
        started: when the first began, by `time.perf_counter`.
    """

    def __init__(self, progress: Progress, started: float | None = None) -> None:
        self.progress = progress
        self.started = time.perf_counter() if started is None else started
        self.seconds: dict[str, float] = {}
        self._name = ""
        self._begun = self.started

    def begin(self, name: str, title: str, total: int | None = None, *, hint: str = "", at_most: bool = False) -> None:
        """End the stage before and begin another; a `name` that comes twice adds up. The rest: `Progress.stage`."""
        self.end()
        self._name, self._begun = name, time.perf_counter()
        self.progress.stage(title, total, hint=hint, at_most=at_most)

    def end(self) -> None:
        """End the stage that runs, if one does."""
        if self._name:
            self.seconds[self._name] = self.seconds.get(self._name, 0.0) + time.perf_counter() - self._begun
            self._name = ""

    @property
    def total(self) -> float:
        """Seconds since the first stage began."""
        return time.perf_counter() - self.started
