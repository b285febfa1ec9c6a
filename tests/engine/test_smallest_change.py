"""How many trials the way to the smallest change takes."""

from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from advsearch.attacks import Block, Domain, Ending, SearchResult
from advsearch.attacks.verification import WORST_CASE
from advsearch.questions.attack.stages import MIN_CONFIRMING_TRIALS, find_smallest

DOMAIN = Domain(torch.full((2,), 0.5), (Block(2, "linf", 0.4),))


def finding(trial: Callable[[str, int, Tensor], Any]) -> Any:
    """Look for the smallest change with these trials, of searches that answer with the largest; return the findings,
    also where one of the trials is interrupted."""

    def search(kind: str, policy: Any, steps: int, seed: int, *, domain: Domain, ranked: bool) -> SearchResult:
        assert ranked, "it was rendered"
        u = domain.project(torch.ones(2))
        return SearchResult(u, 1.0, 1.0, 1.0, Ending.FOUND, Ending.FOUND, (), (), 1, 0, 0, 0, 0.0)

    def said(*_: Any, **__: Any) -> None:
        pass

    def trials(kind: str, configurations: dict[int, Tensor]) -> list[Any]:
        return [trial(kind, number, u) for number, u in configurations.items()]

    problem = SimpleNamespace(domain=DOMAIN, seed=0, verification_rule=WORST_CASE, steps=1)
    findings = SimpleNamespace(predictor=None, smallest_change_bracket=None, search_result=None)
    searches: Any = SimpleNamespace(
        problem=problem, run_state=findings, policy=None, begin_stage=said, run_search=search
    )
    verifier: Any = SimpleNamespace(problem=problem, begin_stage=said, try_configurations=trials, n_trials=20)
    with suppress(KeyboardInterrupt):
        find_smallest(searches, searches.policy, verifier)
    return findings


def outcome(u: Tensor) -> Any:
    score = float(u[0]) - 0.6
    return SimpleNamespace(score=score, success=score > 0.0)


def test_on_the_way_a_few_trials_do_and_at_the_end_it_is_all() -> None:
    """What is wrong in every trial passes on 6, what is wrong in none fails on the second, and the end has 40."""
    tried = Counter[str]()

    def trial(kind: str, number: int, u: Tensor) -> Any:
        tried[kind] += 1
        return outcome(u)

    findings = finding(trial)
    assert findings.smallest_change_bracket.is_closed and findings.smallest_change_bracket.confirmed
    last = [f"check {findings.smallest_change_bracket.n_checks - one}" for one in (1, 2)]
    assert sum(tried[kind] for kind in last) == MIN_CONFIRMING_TRIALS
    assert {tried[kind] for kind in tried if kind not in last} == {6, 2}


@pytest.mark.parametrize("stop", [1, 7, 30])
def test_an_interrupt_on_the_way_keeps_the_smallest_configuration_so_far(stop: int) -> None:
    tried, passed = Counter[str](), [DOMAIN.project(torch.ones(2))]

    def trial(kind: str, number: int, u: Tensor) -> Any:
        if sum(tried.values()) == stop - 1:
            raise KeyboardInterrupt
        tried[kind] += 1
        if tried[kind] == 6 and outcome(u).success:
            passed.append(u)
        return outcome(u)

    findings = finding(trial)
    assert findings.smallest_change_bracket is None and torch.equal(findings.search_result.best_u, passed[-1])
    assert (len(passed) > 2) == (stop == 30)
