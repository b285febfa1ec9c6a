"""What the policies state about themselves is true: budgets to a known optimum, the page about them, its example."""

from __future__ import annotations

import importlib.util
import math
import re
import sys
from dataclasses import MISSING, fields
from functools import partial
from types import ModuleType
from typing import Any

import pytest
import torch

from advsearch.attacks import POLICIES, Block, Domain, Ending, Evaluation, Policy, Query, make_policy, search
from conftest import ROOT

PAGE = (ROOT / "docs" / "policies" / "README.md").read_text("utf-8")
EXTENDING = (ROOT / "docs" / "extending.md").read_text("utf-8")

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


def test_a_policy_that_states_budgets_states_them_for_every_objective() -> None:
    assert set(BUDGETS) <= set(POLICIES)
    for rows in BUDGETS.values():
        assert {name: len(row) for name, row in rows.items()} == {name: len(d) for name, d in DIMENSIONS.items()}
    assert set(closed_form.OBJECTIVES) == set(DIMENSIONS)


def test_a_gradient_pays_in_many_dimensions() -> None:
    """In a thousand dimensions it takes tens of renders with a gradient, and thousands without one at least."""
    for objective in ("linear, linf", "linear, l2", "quadratic, box"):
        for name, policy in ((name, make_policy(name)) for name in BUDGETS):
            renders = BUDGETS[name][objective][DIMENSIONS[objective].index(1000)]
            if policy.uses_gradient:
                assert renders is not None and renders <= 200, name
            else:
                assert renders is None or renders >= 5000, name


@pytest.mark.medium
@pytest.mark.parametrize("objective", DIMENSIONS)
def test_an_optimum_is_the_largest_value(objective: str) -> None:
    """Nothing that random search or a gradient finds is larger, and the start is far from it."""
    for d in (2, 3, 10):
        problem = closed_form.OBJECTIVES[objective](d, 5)
        assert problem.value(problem.domain.start) < 0.8 * problem.optimum
        for name in ("random", "pgd"):
            result = search(
                partial(map, problem.evaluate), problem.domain, make_policy(name), steps=200, seed=0, candidates=0
            )
            assert problem.value(result.best_u) <= problem.optimum * (1 + 1e-4)
        u = problem.domain.start.clone().requires_grad_(True)
        step = 1e-3 * torch.randn(d, generator=torch.Generator().manual_seed(1))
        change = problem.value(problem.domain.start + step) - problem.value(problem.domain.start - step)
        assert change == pytest.approx(2.0 * float(problem.gradient(u.detach()) @ step), rel=0.05, abs=1e-5)


# ---- the page


def test_the_page_shows_the_stated_budgets() -> None:
    assert PAGE == closed_form.with_table(PAGE), "run python benchmarks/closed_form.py --write"
    assert closed_form.table().count("\n") == 2 + len(BUDGETS)


@pytest.mark.parametrize("name", POLICIES)
def test_the_page_has_a_row_with_every_option_and_its_default(name: str) -> None:
    row = re.search(rf"^\| (?:`{name}`|\[`{name}`\]\({name}\.md\)) \|.*$", PAGE, re.M)
    assert row is not None
    for field in fields(POLICIES[name]):  # type: ignore[arg-type]
        stated = re.search(rf"`{field.name}` \((.*?)\)", row[0])
        assert stated is not None, field.name
        if field.default is not MISSING and isinstance(field.default, (int, float)):
            assert re.search(rf"; {re.escape(str(field.default).lower())}\b|^{str(field.default).lower()}$", stated[1])
    assert f"--policy {name}" in PAGE or (ROOT / "docs" / "policies" / f"{name}.md").exists()
    assert ("| yes |" in row[0]) <= make_policy(name).uses_gradient


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
    beside = make_policy("portfolio", policies=[own, "auto"])
    assert search(partial(map, problem.evaluate), problem.domain, beside, steps=40, seed=0).best_objective > 0.0


def test_the_policy_of_the_page_stays_in_a_ball_and_gets_choices_for_free() -> None:
    domain = Domain(torch.tensor([0.5, 0.5, 0.5, 0.1]), (Block(3, "l2", 0.1), Block(1, options=4)))

    def evaluate(query: Query) -> Evaluation:
        assert domain.contains(query.u)
        value = float(query.u[0] - query.u[1]) + (int(query.u[3] * 4) == 2) if query.number % 7 else math.nan
        return Evaluation(value, None, False)

    result = search(partial(map, evaluate), domain, users_class()(), steps=100, seed=0, candidates=0)
    assert int(result.best_u[3] * 4) == 2
    assert result.best_objective > 1.1
