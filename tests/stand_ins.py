"""An attack without a scene, a model and a renderer: its problem is in closed form, all else of it is real."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from advsearch.attacks import Block, Domain, Evaluation, Policy, Query, make_policy
from advsearch.attacks.verification import WORST_CASE, VerificationRule
from advsearch.cluster import BatchResult, InProcess, WorkerStats, WorkerTask
from advsearch.engine.journal import Journal, ParallelEvaluator
from advsearch.engine.problem import Problem
from advsearch.engine.record import RunState
from advsearch.engine.verifier import choose_ladder
from advsearch.progress import NullProgress, Stages
from advsearch.questions.attack import carry_out as attacking
from advsearch.questions.attack.carry_out import attack_worker, choose_search_size
from advsearch.questions.attack.run import search_and_verify
from advsearch.questions.attack.settings import AttackConfig
from advsearch.runs.directory import RunDirectory
from advsearch.tasks import Classification, Judgement


@dataclass(frozen=True)
class StandInPlan:
    """A gradient plan with nothing in it."""

    renders: int = 0

    def to_dict(self) -> dict[str, Any]:
        return {"groups": []}

    def restore(self, stored: dict[str, Any]) -> StandInPlan:
        return self


def judged(logits: Tensor) -> Judgement:
    """What is said of two logits, of which the first is right."""
    return Classification(labels=("mug", "bowl")).judge(logits[None], (0,))[0]


@dataclass
class StandInProblem:
    """A noisy quadratic where a scene, a model and an objective would be; `pause` seconds an evaluation."""

    pause: float = 0.0
    on_evaluation: Callable[[], None] = lambda: None
    domain: Domain = field(default_factory=lambda: Domain(torch.full((6,), 0.5), (Block(4, "linf", 0.2), Block(2))))
    conditions: None = None
    searched_space: Any = field(default_factory=lambda: SimpleNamespace(controls=()))
    verification_rule: VerificationRule = WORST_CASE
    search_spp: int = 4
    search_depth: int | None = None
    seed: int = 3
    steps: int = 0
    conditions_per_evaluation: int = 1
    gradient_plan: StandInPlan = StandInPlan()

    def _logits(self, u: Tensor, seed: int) -> Tensor:
        noise = 0.02 * torch.randn(1, generator=torch.Generator().manual_seed(seed))
        value = 0.05 - (u - torch.linspace(0.3, 0.8, 6)).square().sum() + noise[0]
        return torch.stack([-value, value])

    def evaluate_all(self, queries: Sequence[Query], prepared: Any = None) -> Iterator[Evaluation]:
        return map(self.evaluate, queries)

    def evaluate(self, query: Query) -> Evaluation:
        time.sleep(self.pause)
        if query.phase is None:
            return Evaluation.from_judgement(judged(self._logits(query.u, query.seed)))
        self.on_evaluation()
        at = query.u.clone().requires_grad_()
        logits = self._logits(at, query.seed)
        value = logits[1] - logits[0]
        slope = torch.autograd.grad(value, at)[0] if query.gradient else None
        picture = torch.full((2, 2, 3), float(query.u.mean())) if query.includes_image else None
        said = judged(logits.detach())
        return Evaluation(
            float(value.detach()), slope, bool(value > 0), cost=query.samples, judgement=said, picture=picture
        )

    def describe(self, u: Tensor, draw: int | None = None) -> dict[str, Any]:
        return {f"u.{number}": {"value": float(value), "unit": "1"} for number, value in enumerate(u)}

    def describe_conditions(self, u: Tensor, seed: int) -> dict[str, Any]:
        return {}


def configuration(policy: str = "pgd", **more: Any) -> AttackConfig:
    return AttackConfig(
        object="mug", policy=policy, steps=25, trials=6, average=5, measure="no", verify_spp=8, specialise=False, **more
    )


def attack_on(
    problem: Any, config: AttackConfig, policy: Policy[Any], stages: Stages, run: RunDirectory | None = None
) -> RunState:
    """Attack a problem of one's own as a configuration describes it."""
    problem.steps, problem.conditions_per_evaluation = choose_search_size(config, problem)
    return search_and_verify(
        policy,
        Journal(run, ParallelEvaluator(problem)),
        stages,
        smallest=config.smallest,
        seconds=config.seconds,
        baseline=config.baseline,
        max_extra_repeats=config.max_extra_repeats,
        average=config.average,
        trials=config.trial_count if config.trials is not None or config.smallest else None,
        ladder=choose_ladder(config.verify_spp, config.pixel_sampler),
        specialise=config.specialise,
        measure=config.measure,
    )


def carry_out(folder: Path, config: AttackConfig, *, pause: float = 0.0, resume: bool = False) -> RunState:
    """Carry out the attack in a folder, from the beginning or from where it is."""
    problem: Any = StandInProblem(pause)
    with RunDirectory.resume(folder) if resume else RunDirectory.create(folder, config=config) as run:
        stages = Stages(NullProgress())
        findings = attack_on(problem, config, make_policy(config.policy_name), stages, run)
        if not findings.interrupted:
            run.store.delete_cached()
        return findings


def rows(folder: Path) -> list[tuple[Any, ...]]:
    """All that is stored, but for times."""
    with RunDirectory.resume(folder) as run:
        return [
            (
                r.id,
                r.kind,
                r.step,
                r.seed,
                r.spp,
                r.objective,
                r.success,
                r.label,
                r.probability,
                r.renders,
                str(r.values),
            )
            for r in run.store.rows()
        ]


class Impatient(NullProgress):
    """Presses Ctrl-C after so many evaluations of the search."""

    def __init__(self, after: int) -> None:
        self._left, self._searching = after, False

    def stage(self, name: str, total: int | None = None, *, hint: str = "", at_most: bool = False) -> None:
        self._searching = name.startswith("searching with")

    def advance(self, n: int = 1, **info: float | str) -> None:
        self._left -= self._searching
        if self._searching and self._left == 0:
            raise KeyboardInterrupt


def interrupted(patch: pytest.MonkeyPatch, after: int, phases: Sequence[str | None] = ("search",)) -> list[Query]:
    """Press Ctrl-C after so many queries of these phases; returns those that were asked."""
    original, asked = Problem.evaluate, list[Query]()

    def evaluate(self: Problem, query: Query) -> Evaluation:
        if query.phase in phases:
            if len(asked) == after:
                raise KeyboardInterrupt
            asked.append(query)
        return original(self, query)

    patch.setattr(Problem, "evaluate", evaluate)
    return asked


@dataclass
class StandInWorkers:
    """Carries everything out in another problem that it has made from the settings, as a worker does."""

    made: InProcess
    lost: tuple[int, ...] = ()
    given: list[int] = field(default_factory=list)
    stats: WorkerStats | None = field(
        default_factory=lambda: WorkerStats(workers=2, max_running=2, busy=1.0, alive=2.0)
    )

    def compute(self, batches: Iterable[Sequence[Any]]) -> Iterator[BatchResult]:
        """The latest comes first."""
        first, listed = len(self.given), list(batches)
        for place, done in enumerate(self.made.compute(reversed(listed))):
            self.given.append(len(listed) - 1 - place)
            away = "it died" if first + place in self.lost else ""
            yield BatchResult(done.items, None if away else done.value, "tcp://1", "ab12" if place else None, away)


def shared(
    monkeypatch: pytest.MonkeyPatch, settings: dict[str, Any], call: Callable[[Any], Any] = attack_worker, **more: Any
) -> StandInWorkers:
    """Let stand-ins carry out a call wherever it is asked for of these settings; all else is done in this process."""
    ready = StandInWorkers(InProcess(call(settings)), **more)

    def open_workers(work: WorkerTask, **_: Any) -> nullcontext[StandInWorkers | None]:
        return nullcontext(ready if work.function_path.endswith(f":{call.__name__}") else None)

    monkeypatch.setattr(attacking, "open_workers", open_workers)
    return ready
