"""The stability suite: every extreme has a case, the cheap ones hold, and the command reports honestly."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from advsearch.cli.main import main
from advsearch.errors import InputError, UnknownNameError
from advsearch.questions.stability import scenes as suite
from advsearch.questions.stability.result import (
    ALL_CASES,
    FELL_SHORT,
    OK,
    Case,
    Check,
    Outcome,
    StabilityConfig,
    StabilityResult,
    check_condition,
    check_range,
)
from advsearch.questions.stability.scenes import condition_number, estimate_hessian, select_cases
from advsearch.runs.directory import RunDirectory, find_run
from advsearch.runs.summary import read_result
from covering import only

WANTED = {
    "radiometric": "hdri black lamp negative infinite nan camera-exposure environment-exposure saturated",
    "materials": "roughness metallic perfect-mirror clear-glass texels",
    "geometry": "degenerate sliver coincident one-triangle million scale file translation grazing near-plane object "
    "gimbal full-turn",
    "stiff": "badly-scaled light-rotation-texel",
    "noise": "one-sample heavy-tails",
    "light": "projector-black projector-full projector-one-texel projector-grazing projector-behind projector-inside "
    "projector-into-a-mirror projector-through-glass projector-0-lumens projector-1e6-lumens spot",
}
"""How the names of the extremes begin that the suite has to have."""

GROUPS = tuple(dict.fromkeys(case.group for case in ALL_CASES))
CHEAP = [case for case in ALL_CASES if not case.slow]
FEW = [case for group in GROUPS for case in [case for case in CHEAP if case.group == group][::3]]
"""Of each group the first, and of every three more one; the other cheap ones are among the slow tests."""


# ---- the registry ---------------------------------------------------------------------------------------------------


def test_every_extreme_has_a_case() -> None:
    assert {*WANTED} == {*GROUPS}
    for group, beginnings in WANTED.items():
        names = [case.name for case in ALL_CASES if case.group == group]
        for one in beginnings.split():
            assert any(name.startswith(one) for name in names), f"{group}: {one}"


def test_cases_are_complete_and_have_names_of_their_own() -> None:
    assert len({case.name for case in ALL_CASES}) == len(ALL_CASES)
    for case in ALL_CASES:
        assert case.holds.endswith("."), case.name


def test_the_cheap_cases_cover_every_group() -> None:
    assert {case.group for case in CHEAP} == {*GROUPS}


# ---- the cases ------------------------------------------------------------------------------------------------------


@pytest.mark.medium
@pytest.mark.parametrize("case", only(FEW, CHEAP), ids=lambda case: case.name)
def test_a_cheap_case_holds(case: Case) -> None:
    row = case.run()
    assert row.status == OK, row.decides


@pytest.mark.slow
@pytest.mark.parametrize("case", [case for case in ALL_CASES if case.slow], ids=lambda case: case.name)
def test_a_case_holds(case: Case) -> None:
    row = case.run()
    assert row.status == OK, row.decides


# ---- rows -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("number", "ok", "text"),
    [
        (check_range("x", 1.0, most=2.0), True, "x: 1 (expected at most 2)"),
        (check_range("x", 3.0, most=2.0), False, "x: 3 (expected at most 2)"),
        (check_range("x", 3.0, 1.0, 2.0), False, "x: 3 (expected at least 1 and at most 2)"),
        (check_range("x", math.nan, most=2.0), False, "x: nan (expected at most 2)"),
        (check_range("x", math.nan), False, "x: nan"),
        (check_condition("x", False), False, "x: 0 (expected exactly 1)"),
    ],
)
def test_a_check_says_what_it_wanted(number: Check, ok: bool, text: str) -> None:
    assert number.ok is ok and str(number) == text


def made(outcome: Outcome | Exception, name: str = "made") -> Case:
    def find() -> Outcome:
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    return Case(name, "noise", "It holds.", False, find)


def test_a_row_has_what_the_design_lists() -> None:
    numbers = [check_range("a", 1.0, most=2.0), check_range("b", 5.0, most=2.0)]
    outcome = Outcome(numbers, relative_error=0.25, ending="stalled", measured={"c": 3.0})
    row: Any = made(outcome).run().to_dict()
    wanted = {"case": "made", "group": "noise", "finite": True, "relative_error": 0.25, "ending": "stalled"}
    assert {**row, **wanted} == row
    assert (row["status"], row["holds"], row["decides"]) == (FELL_SHORT, "It holds.", "b: 5 (expected at most 2)")
    assert row["seconds"] >= 0.0 and row["measured"] == {"c": 3.0}


def test_what_is_not_finite_falls_short_whatever_the_checks_say() -> None:
    row = made(Outcome([check_range("a", 1.0, most=2.0)], finite=False)).run()
    assert (row.status, row.decides) == (FELL_SHORT, "NaN or infinite values")


@pytest.mark.parametrize(
    ("error", "ending", "text"),
    [(InputError("no such light"), "refused", "no such light"), (ZeroDivisionError("by 0"), "raised", "by 0")],
)
def test_an_exception_is_a_finding(error: Exception, ending: str, text: str) -> None:
    row = made(error).run()
    assert row.status == FELL_SHORT and row.ending == ending and text in row.decides


# ---- the command ----------------------------------------------------------------------------------------------------


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where runs are kept."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def two_cases(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    good = made(Outcome([check_range("a", 1.0, most=2.0)], relative_error=0.02, ending="found"), "good")
    bad = replace(made(Outcome([check_range("a", 3.0, most=2.0)]), "bad"), group="stiff")
    monkeypatch.setattr(suite, "ALL_CASES", (good, bad))
    yield


@pytest.mark.usefixtures("two_cases")
def test_the_command_prints_a_table_and_the_number_that_decides(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["stability", "--quiet"]) == 3
    out = capsys.readouterr().out
    assert "bad fell short: a: 3 (expected at most 2)" in out and "1 of 2 cases hold" in out
    assert main(["stability", "--quiet", "--case", "good"]) == 0
    assert main(["stability", "--quiet", "--group", "stiff"]) == 3


@pytest.mark.usefixtures("two_cases")
def test_the_command_prints_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["stability", "--quiet", "--json"]) == 3
    said = json.loads(capsys.readouterr().out)
    assert (said["schema"], said["command"]) == (1, "stability")
    assert [(row["case"], row["status"]) for row in said["rows"]] == [("good", OK), ("bad", FELL_SHORT)]


def test_the_command_lists_its_cases_without_running_them(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", "cases", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["cases"] == [case.name for case in ALL_CASES]


def test_unknown_cases_and_groups_are_refused() -> None:
    with pytest.raises(UnknownNameError, match=r"unknown case 'gimbal-angle'\. Did you mean 'gimbal-angles'"):
        select_cases(["gimbal-angle"])
    with pytest.raises(UnknownNameError, match=r"unknown group 'stif'\. Did you mean 'stiff'"):
        select_cases([], ["stif"])
    assert {case.group for case in select_cases(["gimbal-angles"], ["stiff"])} == {"geometry", "stiff"}


def uncalled() -> Outcome:
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
    capsys.readouterr()
    assert main(["show", "short"]) == 0 and "Go on with: advsearch resume short" in capsys.readouterr().out
    monkeypatch.setattr(suite, "ALL_CASES", (replace(good, measure=uncalled), bad))
    assert main(["resume", "short", "--quiet"]) == 3
    last = kept("short")
    assert (last.ending, last.not_run) == ("done", [])
    again: Any = last.to_dict()
    assert [{**row, "seconds": 0.0} for row in again["rows"]] == [{**row, "seconds": 0.0} for row in whole]
    capsys.readouterr()
    assert main(["runs", "--json"]) == 0
    listed = {one["name"]: one for one in json.loads(capsys.readouterr().out)["runs"]}
    assert (listed["short"]["command"], listed["short"]["state"]) == ("stability", "done")
    assert (listed["short"]["object"], listed["short"]["answer"]) == ("", "1 of 2 hold")


def kept(name: str) -> StabilityResult:
    """What a run keeps."""
    result = read_result(find_run(name))
    assert isinstance(result, StabilityResult)
    return result


def test_a_suite_that_was_killed_in_its_first_case_says_what_it_is(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config = StabilityConfig(case="good")
    with RunDirectory.create("killed", config=config):
        pass
    assert main(["show", "killed"]) == 0
    said = capsys.readouterr().out
    assert said.startswith("killed: stability.\n") and "Go on with: advsearch resume killed" in said


@pytest.mark.usefixtures("two_cases")
def test_seconds_and_ctrl_c_end_the_suite_and_say_what_was_not_run(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["stability", "--seconds", "1e-9", "--quiet"]) == 0
    said = capsys.readouterr().out
    assert "Not run\nbad" in said and said.endswith("Go on with: advsearch resume stability-001\n")

    def interrupted() -> Outcome:
        raise KeyboardInterrupt

    good, bad = select_cases()
    monkeypatch.setattr(suite, "ALL_CASES", (good, replace(bad, measure=interrupted)))
    assert main(["stability", "--json"]) == 130
    told = capsys.readouterr()
    assert json.loads(told.out)["not_run"] == ["bad"] and len(json.loads(told.out)["rows"]) == 1
    assert "good: ok" in told.err
    assert main(["stability", "--seconds", "0"]) == 2
    assert "--seconds: expected a number greater than 0 and at most 1e9, got 0" in capsys.readouterr().err


# ---- the tools ------------------------------------------------------------------------------------------------------


def test_the_condition_number_of_a_quadratic_is_estimated() -> None:
    weights = torch.tensor([1e6, 1.0]).double()
    second = estimate_hessian(
        lambda u: -0.5 * float(weights @ (u - 0.5).square()),
        torch.full((2,), 0.3).double(),
        torch.eye(2).double(),
        [0.01, 0.01],
    )
    assert condition_number(second) == pytest.approx(1e6, rel=1e-3)
    assert condition_number(torch.diag(torch.tensor([1.0, 0.0]))) == math.inf


def test_mixed_second_derivatives_are_estimated() -> None:
    second = estimate_hessian(
        lambda u: float(u[0] * u[1]), torch.full((2,), 0.3).double(), torch.eye(2).double(), [0.1, 0.2]
    )
    assert torch.allclose(second, torch.tensor([[0.0, 1.0], [1.0, 0.0]]).double(), atol=1e-12)
