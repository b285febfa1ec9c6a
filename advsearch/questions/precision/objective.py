"""The best verified objective against seconds and renders, for each policy."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from advsearch import seeds
from advsearch.attacks import Domain, Evaluate, Evaluation, Policy, StepRecord, search
from advsearch.questions.precision.points import MeasuredSetting, quartiles
from advsearch.questions.precision.rounds import TimeBudget

Verified = Callable[[Tensor], float]
"""From a configuration to its objective in fresh renders with enough samples."""


@dataclass(frozen=True)
class SearchMark:
    """How far one search had come.

    Attributes:
        renders: that it could spend until then.
        seconds: that it had taken, without verification.
        objective: verified, of the best configuration until then; the search's own value of it is biased upwards.
    """

    renders: int
    seconds: float
    objective: float


@dataclass(frozen=True)
class PolicyCurve:
    """How a policy does, over seeds.

    Attributes:
        policy: its name.
        renders: each mark's.
        seconds: median of each.
        objective: lower quartile, median and upper quartile of each.
        repeats: searches behind it.
    """

    policy: str
    renders: tuple[int, ...]
    seconds: tuple[float, ...]
    objective: tuple[tuple[float, float, float], ...]
    repeats: int


def marks_at(steps: int) -> tuple[int, ...]:
    """Return the numbers of renders at which a search is looked at: powers of two, and all of them."""
    return (*(2**power for power in range(steps.bit_length()) if 2**power < steps), steps)


class ObjectiveBench:
    """Runs searches and verifies what they held at each mark.

    Args:
        evaluate: answers the queries of the searches.
        noise: root seed of their renders.
        domain: where to search.
        policies: by name.
        steps: renders of each search.
        verified: see `Verified`.
        budget: ends a search that takes longer.
    """

    def __init__(
        self,
        evaluate: Evaluate,
        noise: int,
        domain: Domain,
        policies: Mapping[str, Policy[Any]],
        steps: int,
        verified: Verified,
        budget: TimeBudget,
    ) -> None:
        self._evaluate, self._noise, self._domain, self._policies = evaluate, noise, domain, policies
        self._steps, self._verified, self._budget = steps, verified, budget

    def settings(self, spp: int) -> list[MeasuredSetting]:
        """One setting a policy."""
        return [MeasuredSetting("objective", name, spp, 1.0) for name in self._policies]

    def measure(self, setting: MeasuredSetting, seed: int) -> tuple[list[SearchMark], float]:
        """Run one search; its marks, verified, and the seconds of search and verification together."""
        begun = time.perf_counter()
        held = self._search(setting.series, seed)
        objectives: dict[bytes, float] = {}
        marks = []
        for renders, seconds, u in held:
            key = u.numpy().tobytes()
            if key not in objectives:
                objectives[key] = self._verified(u)
            marks.append(SearchMark(renders, seconds, objectives[key]))
        return marks, time.perf_counter() - begun

    def _search(self, policy: str, seed: int) -> list[tuple[int, float, Tensor]]:
        """The best configuration at each mark, with the seconds until then. Nothing is rendered again at the end."""
        held: list[tuple[int, float, Tensor]] = []
        best: tuple[float, Tensor] = (float("-inf"), self._domain.start)
        wanted = list(marks_at(self._steps))
        begun = time.perf_counter()

        def on_step(record: StepRecord, u: Tensor, evaluation: Evaluation) -> None:
            nonlocal best
            seconds = time.perf_counter() - begun
            while wanted and record.renders > wanted[0]:  # what a mark holds was found before this step
                held.append((wanted.pop(0), seconds, best[1]))
            if evaluation.objective > best[0]:
                best = (evaluation.objective, u.detach().clone())
            if wanted and record.renders == wanted[0]:
                held.append((wanted.pop(0), seconds, best[1]))

        search(
            self._evaluate,
            self._domain,
            self._policies[policy],
            steps=self._steps,
            seed=seeds.stream(seed, "policy"),
            candidates=0,
            on_step=on_step,
            kind=f"precision {policy} {seed}",
            noise=self._noise,
            seconds=max(1e-9, self._budget.left),
        )
        if time.perf_counter() - begun < self._budget.left:
            held += [(mark, time.perf_counter() - begun, best[1]) for mark in wanted]  # it stopped by itself
        return held


def curve_of(policy: str, searches: Sequence[Sequence[SearchMark]]) -> PolicyCurve:
    """Return medians and quartiles over searches, at the marks that all of them have reached."""
    common = min((len(marks) for marks in searches), default=0)
    columns = [[marks[number] for marks in searches] for number in range(common)]
    return PolicyCurve(
        policy,
        tuple(column[0].renders for column in columns),
        tuple(quartiles([mark.seconds for mark in column])[1] for column in columns),
        tuple(quartiles([mark.objective for mark in column]) for column in columns),
        len(searches),
    )


def missing(curve: PolicyCurve, best: float, start: float) -> tuple[float, ...]:
    """Return the share of the possible gain that a policy's median misses at each mark.

    Args:
        curve: of the policy.
        best: the best median of any policy.
        start: the verified objective before any search.
    """
    gain = best - start
    return tuple(0.0 if gain <= 0.0 else max(0.0, (best - middle) / gain) for _, middle, _ in curve.objective)


def sooner(curves: Sequence[PolicyCurve], goal: float, best: float, start: float) -> tuple[str, int, float] | None:
    """Return the policy whose median reaches a share of the possible gain in the least time: its name, renders and
    seconds; None where none does."""
    reached = [
        (seconds, renders, curve.policy)
        for curve in curves
        for share, renders, seconds in zip(missing(curve, best, start), curve.renders, curve.seconds, strict=True)
        if share <= goal
    ]
    if not reached or best <= start:
        return None
    seconds, renders, policy = min(reached)
    return policy, renders, seconds
