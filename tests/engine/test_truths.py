"""What is true of a configuration is found once where only base colours tell configurations apart."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace
from typing import Any, cast

import pytest
import torch

from advsearch.engine.problem import Problem
from advsearch.tasks import Facts


@pytest.mark.parametrize(
    ("route", "asks", "looked"),
    [("object.base_color", False, 2), ("object.vertices", False, 3), ("object.base_color", True, 4)],
)
def test_a_truth_is_remembered_where_only_base_colours_differ(route: str, asks: bool, looked: int) -> None:
    """Two of four configurations differ in the first number alone, one is there twice; the second is a camera's. A
    task that asks for numbers is asked each time."""
    groups = [
        SimpleNamespace(name="a.colour", coordinates=slice(0, 1)),
        SimpleNamespace(name="b.time", coordinates=slice(1, 2)),
    ]
    space = SimpleNamespace(groups=groups, start=torch.zeros(2), describe=lambda whole: {}, scene=None)
    routes = {"a.colour": frozenset({route}), "b.time": frozenset({"camera.to_world"})}
    renderer = SimpleNamespace(
        routes=routes,
        scene=SimpleNamespace(input_names=("object.base_color", "object.vertices")),
        surfaces=lambda whole: whole,
    )
    seen: list[float] = []

    def truth(facts: Facts) -> float:
        if asks:
            assert facts.numbers == {}
        seen.append(float(cast(Any, facts.sight)[1]))
        return seen[-1]

    task = SimpleNamespace(truth=truth, varies=True)
    problem = object.__new__(Problem)
    vars(problem).update(
        task=task, space=space, renderer=renderer, make_facts=partial(Facts, "x", None, None), _truths={}
    )
    asked = [(0.1, 0.5), (0.2, 0.5), (0.1, 0.7), (0.1, 0.7)]
    found = [problem.find_truth(torch.tensor(one)) for one in asked]
    assert found == pytest.approx([0.5, 0.5, 0.7, 0.7]) and len(seen) == looked
