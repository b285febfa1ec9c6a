"""What the policies state about themselves is true: budgets to a known optimum, and the example of their page."""

import importlib.util
import re
import sys
from functools import partial
from types import ModuleType
from typing import Any

import pytest

from advsearch.attacks import Ending, Policy, make_policy, search
from conftest import ROOT

CHEAP = {"auto": 200, "cmaes": 500, "portfolio": 200}
"""Budgets up to so many renders are played, with three seeds each; up to 2,000 of a policy that is not named here."""


def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("closed_form", ROOT / "benchmarks" / "closed_form.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


closed_form = script()
BUDGETS, DIMENSIONS = closed_form.BUDGETS, closed_form.DIMENSIONS


def stated() -> list[Any]:
    """Every stated budget that is cheap to play. All but two of each policy, its smallest and one of another objective
    for each policy, are among the slow tests."""
    cheap = [
        (name, objective, d, renders)
        for name in BUDGETS
        for objective, dimensions in DIMENSIONS.items()
        for d, renders in zip(dimensions, BUDGETS[name][objective], strict=True)
        if renders is not None and renders <= CHEAP.get(name, 2000)
    ]
    quick = set()
    for turn, name in enumerate(BUDGETS):
        own = sorted((one for one in cheap if one[0] == name), key=lambda one: (one[3], one[2]))
        quick |= {own[place] for place in (0, turn % len(own)) if own}
    marks = {one: () if one in quick else pytest.mark.slow for one in cheap}
    return [pytest.param(*one, id=f"{one[0]}-{one[1]}-{one[2]}", marks=mark) for one, mark in marks.items()]


@pytest.mark.medium
@pytest.mark.parametrize(("name", "objective", "d", "renders"), stated())
def test_a_policy_reaches_the_optimum_within_its_stated_budget(name: str, objective: str, d: int, renders: int) -> None:
    """`reached` also fails a policy that leaves the domain, or a wrong optimum."""
    assert all(closed_form.reached(make_policy(name), objective, d, renders, seed) for seed in range(3))


EXTENDING = (ROOT / "docs" / "extending.md").read_text("utf-8")


def users_class() -> Any:
    """The class of the example on the page about extending."""
    block = next(b for b in re.findall(r"^```python\n(.*?)^```$", EXTENDING, re.M | re.S) if "class Shrinking(" in b)
    module = ModuleType("policy_of_the_page")
    sys.modules[module.__name__] = module
    exec(compile(block, "extending.md", "exec"), module.__dict__)
    return module.__dict__["Shrinking"]


def test_the_policy_of_the_page_works() -> None:
    own: Policy[Any] = users_class()()
    problem = closed_form.OBJECTIVES["quadratic, box"](6, 0)
    result = search(partial(map, problem.evaluate), problem.domain, own, steps=400, seed=0, candidates=0)
    assert problem.value(result.best_u) > 0.9 * problem.optimum
    assert result.stopped is Ending.BUDGET_SPENT


@pytest.mark.island("advsearch.attacks.policies.portfolio")
def test_the_policy_of_the_page_is_one_of_a_portfolio() -> None:
    problem = closed_form.OBJECTIVES["quadratic, box"](6, 0)
    beside = make_policy("portfolio", policies=[users_class()(), "auto"])
    assert search(partial(map, problem.evaluate), problem.domain, beside, steps=40, seed=0).best_objective > 0.0
