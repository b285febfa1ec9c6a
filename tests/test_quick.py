"""Which tests are left out of `make test-quick`, and which slow ones are of the day."""

from __future__ import annotations

import pytest
from conftest import medium, of_the_day


def test_what_is_left_out_is_marked(request: pytest.FixtureRequest) -> None:
    for item in request.session.items:
        assert (item.get_closest_marker("medium") is not None) == (item.nodeid in medium())


def test_in_as_many_days_as_there_are_parts_each_slow_test_runs_once() -> None:
    names = [f"tests/test_it.py::test_this[{number}]" for number in range(200)]
    days = [{name for name in names if of_the_day(name, day, 10)} for day in range(739000, 739010)]
    assert sum(map(len, days)) == 200 and set().union(*days) == set(names)
    assert all(5 < len(day) < 40 for day in days)
