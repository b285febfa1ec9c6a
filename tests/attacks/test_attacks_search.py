"""The search loop: budgets, endings, what it does with noise, NaN and interrupts. Policies here are made to order."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar

import pytest
import torch
from torch import Tensor

from advsearch.attacks import (
    CMAES,
    NES,
    POLICIES,
    Block,
    Domain,
    Ending,
    Evaluate,
    Evaluated,
    Evaluation,
    Policy,
    Proposal,
    Query,
    Random,
    StepRecord,
    count_planned_renders,
    make_policy,
    search,
)
from advsearch.attacks.candidates import Candidate, add_candidate, select_contenders
from advsearch.interrupts import INTERRUPTS
from advsearch.seeds import derive_seed

DOMAIN = Domain(torch.full((3,), 0.5), (Block(3, "linf", 0.2),))


@dataclass(frozen=True)
class Script(Policy[int]):
    """Proposes what it was told to, in order, then nothing more."""

    us: tuple[Any, ...]
    gradient: bool = False
    at_once: int = 1
    name: ClassVar[str] = "script"
    uses_gradient: ClassVar[bool] = False

    def start(self, domain: Domain, generator: torch.Generator, steps: int) -> int:
        return 0

    def propose(self, state: int, n: int) -> tuple[tuple[Proposal, ...], int]:
        end = state + min(n, self.at_once)
        return tuple(Proposal(u, self.gradient) for u in self.us[state:end]), end

    def update(self, state: int, evaluated: Evaluated) -> int:
        for _, evaluation in evaluated:
            assert math.isfinite(evaluation.objective) or evaluation.objective == -math.inf
            assert evaluation.gradient is None or bool(torch.isfinite(evaluation.gradient).all())
        return state


def at(value: float) -> Tensor:
    return torch.full((3,), 0.5 + value)


INDEX = {derive_seed(0, "search", index): index for index in range(3000)}
"""Which of a search's seeds one is."""


def objective_is(value: Callable[[Tensor, int], float]) -> Evaluate:
    """An `evaluate` whose margin is a function of u and the index of the seed."""

    def evaluate(query: Query) -> Evaluation:
        v = value(query.u, INDEX[query.seed])
        return Evaluation(v, torch.ones_like(query.u) if query.gradient else None, v > 0)

    return partial(map, evaluate)


RISE = objective_is(lambda u, index: float(u[0] - 0.5))


def test_the_best_configuration_wins_and_the_budget_is_kept() -> None:
    result = search(RISE, DOMAIN, Script((at(-0.1), at(0.1), at(0.0))), steps=3, seed=0)
    assert torch.equal(result.best_u, at(0.1))
    assert result.best_objective == pytest.approx(0.1)
    assert result.ending is Ending.FOUND
    assert result.stopped is Ending.BUDGET_SPENT
    assert [r.phase for r in result.history] == ["search"] * 3
    assert len(result.ranking) == 6  # three candidates, twice each
    assert result.renders == len(result.history) + len(result.ranking) <= count_planned_renders(3)
    assert [r.best for r in result.history] == pytest.approx([-0.1, 0.1, 0.1])
    assert result.gradients == 0


def test_every_evaluation_has_its_own_seed_and_ranking_shares_new_ones() -> None:
    result = search(RISE, DOMAIN, Script((at(-0.1), at(0.1), at(0.0))), steps=3, seed=0, candidates=2, repeats=3)
    assert [INDEX[r.seed] for r in result.history] == [0, 1, 2]
    assert [INDEX[r.seed] for r in result.ranking] == [3, 4, 5, 3, 4, 5]
    other = search(
        sampled([]), DOMAIN, Script((at(0.0),)), steps=1, seed=0, candidates=0, kind="baseline", render_seed=7
    )
    assert [r.seed for r in other.history] == [derive_seed(7, "baseline", 0)]


def test_a_lucky_render_loses_to_a_candidate_that_keeps_its_promise() -> None:
    """Index 0 adds two logits of luck to a bad configuration; new seeds expose it."""
    lucky = objective_is(lambda u, index: float(u[0] - 0.5) + (2.0 if index == 0 else 0.0))
    script = Script((at(-0.15), at(0.1), at(0.0)))
    ranked = search(lucky, DOMAIN, script, steps=3, seed=0)
    assert torch.equal(ranked.best_u, at(0.1))
    assert ranked.best_objective == pytest.approx(0.1)
    raw = search(lucky, DOMAIN, script, steps=3, seed=0, candidates=0)
    assert torch.equal(raw.best_u, at(-0.15))
    assert raw.best_objective == raw.claimed_objective == pytest.approx(1.85)


def test_ranking_takes_the_winners_curse_out() -> None:
    """Forty equal configurations with one logit of noise: the raw best is biased by two logits, the answer is not."""
    claimed, believed = [], []
    for seed in range(20):
        noise = torch.randn(200, generator=torch.Generator().manual_seed(seed)).tolist()

        def noisy(u: Tensor, index: int, noise: list[float] = noise) -> float:
            return noise[index] - 5.0

        result = search(objective_is(noisy), DOMAIN, Random(), steps=40, seed=seed)
        claimed.append(result.claimed_objective + 5.0)
        believed.append(result.best_objective + 5.0)
    assert sum(claimed) / 20 > 1.5
    assert abs(sum(believed) / 20) < 0.5


def priced(cost: int, log: list[tuple[int, bool | str]]) -> Evaluate:
    """RISE with gradients that cost so many renders more; notes what was asked for."""

    def evaluate(query: Query) -> Evaluation:
        log.append((INDEX[query.seed], query.gradient))
        derivative = torch.ones_like(query.u) if query.gradient else None
        extra = cost if query.gradient is True else 0
        return Evaluation(float(query.u[0] - 0.5), derivative, False, cost=1 + extra)

    return partial(map, evaluate)


@pytest.mark.parametrize(
    ("steps", "gradients", "evaluations"),
    [(1, 0, 1), (13, 0, 13), (14, 1, 2), (26, 1, 14), (27, 2, 3), (40, 3, 4), (100, 7, 16)],
)
def test_the_budget_is_in_renders(steps: int, gradients: int, evaluations: int) -> None:
    """Six numbers by central differences: 13 renders for each evaluation with a gradient. One after which no render
    would be left is not asked for."""
    domain = Domain(DOMAIN.start, DOMAIN.blocks, gradient_cost=12)
    asked: list[tuple[int, bool | str]] = []
    script = Script(tuple(at(0.0) for _ in range(100)), gradient=True)
    result = search(priced(12, asked), domain, script, steps=steps, seed=0, candidates=2, repeats=3)
    assert [g for _, g in asked[: len(result.history)]] == [True] * gradients + [False] * (evaluations - gradients)
    assert len(result.history) == evaluations
    assert result.gradients == gradients
    assert result.history[-1].renders == steps
    assert result.renders == result.ranking[-1].renders == steps + 3 == sum(1 + 12 * (g is True) for _, g in asked)
    assert result.renders <= count_planned_renders(steps, 2, 3)
    assert max(i for i, _ in asked[:evaluations]) < steps == min(i for i, _ in asked[evaluations:])


@dataclass(frozen=True)
class Samples(Script):
    """The script, with so many times the samples for each proposal."""

    samples: tuple[int, ...] = ()

    def propose(self, state: int, n: int) -> tuple[tuple[Proposal, ...], int]:
        if state >= len(self.us):
            return (), state
        return (Proposal(self.us[state], self.gradient, samples=self.samples[state]),), state + 1


def sampled(log: list[tuple[bool, int]], extra: int = 0) -> Evaluate:
    def evaluate(query: Query) -> Evaluation:
        log.append((bool(query.gradient), query.samples))
        slope = torch.ones_like(query.u) if query.gradient else None
        return Evaluation(float(query.u[0]), slope, False, cost=query.samples * (1 + extra * bool(query.gradient)))

    return partial(map, evaluate)


def test_samples_cost_as_many_renders_and_the_last_get_what_is_left() -> None:
    log: list[tuple[bool, int]] = []
    script = Samples((at(0.0), at(0.1), at(0.2), at(0.05)), samples=(1, 4, 2, 50))
    result = search(sampled(log), DOMAIN, script, steps=12, seed=0, candidates=1)
    assert log == [(False, n) for n in (1, 4, 2, 5, 1, 1)]
    assert [r.samples for r in (*result.history, *result.ranking)] == [1, 4, 2, 5, 1, 1]
    assert [r.renders for r in result.history] == [1, 5, 7, 12]
    assert torch.equal(result.best_u, at(0.2))


def test_seconds_end_a_search_after_the_evaluation_that_exceeds_them(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 0.0
    monkeypatch.setattr("time.perf_counter", lambda: now)

    def slow(query: Query) -> Evaluation:
        nonlocal now
        now += 0.03
        return Evaluation(float(query.u[0]), None, False)

    result = search(partial(map, slow), DOMAIN, Random(), steps=100, seed=0, seconds=0.1, candidates=0)
    assert len(result.history) == 4
    assert result.stopped is Ending.BUDGET_SPENT
    assert len(search(partial(map, slow), DOMAIN, Random(), steps=9, seed=0, seconds=1e-9, candidates=0).history) == 1
    assert len(search(partial(map, slow), DOMAIN, Random(), steps=3, seed=0, seconds=60.0, candidates=0).history) == 3


RESTARTS = [make_policy("restarts", policy=NES())] if "restarts" in POLICIES else []  # it may be hidden
ALL_AT_ONCE = (Random(), CMAES(population=6), *RESTARTS)


@pytest.mark.parametrize("policy", ALL_AT_ONCE, ids=lambda policy: policy.name)
def test_rows_do_not_depend_on_when_answers_come(policy: Policy[Any]) -> None:
    """One by one, or a whole batch before the first of it is looked at; what `late` cuts off included."""

    def rows(evaluate: Evaluate, last: int) -> tuple[list[StepRecord], Tensor]:
        found = search(evaluate, DOMAIN, policy, steps=30, seed=0, is_out_of_time=lambda done: done >= last)
        return [replace(one, seconds=0.0) for one in (*found.history, *found.ranking)], found.best_u

    for last in (30, 8):
        lazy, eager = rows(RISE, last), rows(lambda queries: list(RISE(queries)), last)
        assert repr(lazy[0]) == repr(eager[0]) and torch.equal(lazy[1], eager[1])
        assert [one.step for one in lazy[0]] == list(range(last + 8))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_non_finite_objective_is_counted_and_never_best(bad: float) -> None:
    evaluate = objective_is(lambda u, index: bad if index == 1 else float(u[0] - 0.5))
    result = search(evaluate, DOMAIN, Script((at(0.05), at(0.2), at(0.1))), steps=3, seed=0)
    assert torch.equal(result.best_u, at(0.1))
    assert result.non_finite_objectives == 1
    assert math.isnan(result.history[1].objective)
    assert not result.history[1].success
    assert result.history[1].best == pytest.approx(0.05)


def test_non_finite_gradient_elements_become_zero_and_are_counted() -> None:
    gradients = []

    def evaluate(query: Query) -> Evaluation:
        value = torch.tensor([math.nan, 1.0, -math.inf]) if query.gradient else None
        return Evaluation(0.5, value, True, n_non_finite=1)

    result = search(
        partial(map, evaluate),
        DOMAIN,
        Script((at(0.0), at(0.1)), gradient=True),
        steps=2,
        seed=0,
        on_step=lambda record, u, evaluation: gradients.append(evaluation.gradient),
    )
    assert gradients[0] is not None and gradients[0].tolist() == [0.0, 1.0, 0.0]
    assert result.history[0].non_finite == 3  # two here and one that the renderer had found
    assert result.non_finite_elements == 3 + 1 + 4  # the last step and four ranking renders report one each
    assert result.history[0].gradient_norm == 1.0


@pytest.fixture(autouse=True)
def no_interrupts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of one test are not the next one's."""
    monkeypatch.setattr(INTERRUPTS, "n_received", 0)


def interrupt_at(number: int, error: type[BaseException] = KeyboardInterrupt) -> Evaluate:
    def value(u: Tensor, index: int) -> float:
        calls.append(index)
        if len(calls) == number:
            INTERRUPTS.n_received += 1
            raise error
        return float(u[0] - 0.5)

    calls: list[int] = []
    return objective_is(value)


@pytest.mark.parametrize(("number", "expected"), [(1, 0.0), (3, 0.1), (5, 0.15), (6, 0.15)])
def test_an_interrupt_keeps_the_best_so_far(number: int, expected: float) -> None:
    """In the first render, in the middle, and twice while candidates are ranked."""
    script = Script((at(-0.1), at(0.1), at(0.15)))
    result = search(interrupt_at(number), DOMAIN, script, steps=3, seed=0)
    assert result.ending is Ending.INTERRUPTED
    assert torch.equal(result.best_u, at(expected))
    assert result.renders == number - 1


def test_the_pool_holds_the_best_distinct_ones_and_puts_success_first() -> None:
    pool: tuple[Candidate, ...] = ()
    for value, objective, success in ((0.0, 3.0, False), (0.1, 1.0, True), (0.00001, 4.0, False), (0.2, 0.5, False)):
        pool = add_candidate(pool, Candidate(at(value), objective, success), 2)
    assert [(round(float(c.u[0]) - 0.5, 5), c.objective) for c in pool] == [(0.1, 1.0), (0.00001, 4.0)]
    assert add_candidate(pool, Candidate(at(0.00002), 3.9, False), 2) == pool
    again = add_candidate(pool, Candidate(at(0.00001), 9.0, True), 2)
    assert again[0] is pool[0]
    assert (again[1].objective, again[1].repeat_objectives, again[1].successes) == (4.0, (9.0,), 1)


def test_who_is_clearly_worse_is_out() -> None:
    leader = Candidate(at(0.3), 2.0, False, repeat_objectives=(1.0, 2.0, 3.0))
    close = Candidate(at(0.2), 1.0, False, repeat_objectives=(1.5, 1.0, 3.0))
    far = Candidate(at(0.1), 1.0, False, repeat_objectives=(0.0, 1.1, 2.0))
    lucky = Candidate(at(0.0), 1.0, False, repeat_objectives=(0.0, 1.1, 2.0), successes=3)
    broken = Candidate(at(0.4), 1.0, False, repeat_objectives=(9.0, -math.inf, 9.0))
    assert select_contenders((far, leader, close, broken), 3) == (leader, close)
    assert select_contenders((far, leader), 1) == (far, leader), "one difference says nothing of its noise"
    assert select_contenders((far, lucky), 3) == (far, lucky) and select_contenders((far,), 3) == (far,)
    assert (
        select_contenders((leader, replace(close, repeat_objectives=(9.0, *close.repeat_objectives))), 3)[
            1
        ].repeat_objectives[0]
        == 9.0
    ), "an older look"


def test_a_clear_decision_takes_no_look_more_and_a_close_one_is_settled() -> None:
    def noisy(seed: int) -> Evaluate:
        noise = 0.1 * torch.randn(4, 100, generator=torch.Generator().manual_seed(seed))
        return objective_is(lambda u, index: float(u[0]) + float(noise[round(float(u[0]) * 100) % 4, index]) - 9.0)

    clear = search(noisy(0), DOMAIN, Script((at(-0.2), at(0.2))), steps=2, seed=0, max_extra_repeats=20)
    assert torch.equal(clear.best_u, at(0.2)) and len(clear.ranking) < 2 * 8
    script = Script((at(0.0), at(0.05)))
    right = {
        close: sum(
            bool(search(noisy(seed), DOMAIN, script, steps=2, seed=0, max_extra_repeats=close).best_u[0] > 0.52)
            for seed in range(60)
        )
        for close in (0, 20)
    }
    assert right[20] > right[0] + 3 and right[20] >= 45
    found = search(noisy(3), DOMAIN, script, steps=2, seed=0, max_extra_repeats=20)
    assert found.renders <= count_planned_renders(2, max_extra_repeats=20) and len({r.seed for r in found.ranking}) >= 2


def test_three_in_a_row_end_the_search() -> None:
    bad = {1, 3, 4, 5}
    evaluate = objective_is(lambda u, index: math.nan if index in bad else -1.0)
    result = search(evaluate, DOMAIN, Script((at(0.0),) * 9), steps=9, seed=0)
    assert result.ending is Ending.NON_FINITE
    assert len(result.history) == 6
    assert result.non_finite_objectives == 4


def test_a_candidate_that_turns_nan_when_ranked_is_not_the_result() -> None:
    evaluate = objective_is(lambda u, index: math.nan if index >= 2 and float(u[0]) > 0.55 else float(u[0] - 0.5))
    result = search(evaluate, DOMAIN, Script((at(0.1), at(0.02))), steps=2, seed=0)
    assert torch.equal(result.best_u, at(0.02))
    assert result.non_finite_objectives == 2
