"""The stability suite: its cases hold, the command reports honestly, and it goes on where it was stopped."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from advsearch.cli.main import main
from advsearch.questions.stability import scenes as suite
from advsearch.questions.stability.result import ALL_CASES, OK, Case, CaseOutcome, StabilityResult, check_range
from advsearch.questions.stability.scenes import select_cases
from advsearch.runs.directory import find_run
from advsearch.runs.summary import read_result
from covering import only

pytestmark = pytest.mark.island("advsearch.questions.stability")

GROUPS = tuple(dict.fromkeys(case.group for case in ALL_CASES))
CHEAP = [case for case in ALL_CASES if not case.slow]
FEW = [case for group in GROUPS for case in [case for case in CHEAP if case.group == group][::3]]
"""Of each group the first, and of every three more one; the others are among the slow tests."""


@pytest.mark.medium
@pytest.mark.parametrize("case", only(FEW, ALL_CASES), ids=lambda case: case.name)
def test_a_case_holds(case: Case) -> None:
    row = case.run()
    assert row.status == OK, row.decides


def made(outcome: CaseOutcome | Exception, name: str = "made") -> Case:
    def find() -> CaseOutcome:
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    return Case(name, "noise", "It holds.", False, find)


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where runs are kept."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def two_cases(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    good = made(CaseOutcome([check_range("a", 1.0, max_value=2.0)], relative_error=0.02, ending="found"), "good")
    bad = replace(made(CaseOutcome([check_range("a", 3.0, max_value=2.0)]), "bad"), group="stiff")
    monkeypatch.setattr(suite, "ALL_CASES", (good, bad))
    yield


def uncalled() -> CaseOutcome:
    pytest.fail("tried again")


@pytest.mark.usefixtures("two_cases")
def test_a_stopped_suite_goes_on_with_the_case_that_it_was_at(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """`show` and `runs` know it, and the rows end up those of a suite that nobody stopped."""
    good, bad = select_cases()
    assert main(["stability", "--quiet", "--json", "--run", "whole"]) == 3
    whole = json.loads(capsys.readouterr().out)["rows"]
    assert main(["stability", "--quiet", "--seconds", "1e-9", "--run", "short"]) == 0
    first = kept("short")
    assert (first.ending, [row.case for row in first.rows], first.not_run) == ("out of time", ["good"], ["bad"])
    monkeypatch.setattr(suite, "ALL_CASES", (replace(good, measure=uncalled), bad))
    assert main(["resume", "short", "--quiet"]) == 3
    last = kept("short")
    assert (last.ending, last.not_run) == ("done", [])
    again: Any = last.to_dict()
    assert [{**row, "seconds": 0.0} for row in again["rows"]] == [{**row, "seconds": 0.0} for row in whole]


def kept(name: str) -> StabilityResult:
    """What a run keeps."""
    result = read_result(find_run(name))
    assert isinstance(result, StabilityResult)
    return result
