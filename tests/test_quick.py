"""Which slow tests are of the day, and how few cases cover all values."""

from __future__ import annotations

from itertools import product

import pytest

from conftest import of_the_day
from covering import covering


@pytest.mark.medium
def test_in_as_many_days_as_there_are_parts_each_slow_test_runs_once() -> None:
    names = [f"a_test[{number}]" for number in range(200)]
    days = [{name for name in names if of_the_day(name, day, 10)} for day in range(739000, 739010)]
    assert sum(map(len, days)) == 200 and set().union(*days) == set(names)
    assert all(5 < len(day) < 40 for day in days)


def test_few_cases_have_each_value() -> None:
    cases = covering([23, 4, 2, 2])
    assert len(cases) == 23
    assert [len({case[axis] for case in cases}) for axis in range(4)] == [23, 4, 2, 2]
    assert {case[1:3] for case in cases} == set(product(range(4), range(2)))
    assert covering([3]) == {(0,), (1,), (2,)}
