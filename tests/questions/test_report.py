"""What runs stand for: no ending, count or command makes a claim that says more than the run does."""

import json
import re
from collections.abc import Iterator
from itertools import product
from typing import Any

import pytest

import samples
from advsearch.questions.explain.result import ExplainResult
from advsearch.questions.harden.result import HardenResult
from advsearch.questions.replay.result import ReplayResult
from advsearch.questions.report import evidence
from advsearch.questions.report.evidence import (
    RULES,
    collect_claims,
    count_conditions,
    describe_criterion,
    describe_run,
    find_selected_axes,
)
from advsearch.questions.report.recorded import RecordedSettings
from advsearch.questions.report.result import Evidence, format_markdown, make_evidence_page
from advsearch.report.views import FAILED_SEARCH_ENDINGS, NO_PROOF, NOTHING_CLAIMED, Claim
from advsearch.runs.results import Extent, Result
from advsearch.runs.summary import to_json

pytestmark = pytest.mark.island(
    "advsearch.questions.report",
    "advsearch.questions.explain",
    "advsearch.questions.harden",
    "advsearch.questions.replay",
)

ENDINGS = (
    *("found", "budget spent", "stalled", "not verified", "already wrong", "non-finite objective", "interrupted"),
    *("out of time", "done", "finished", "an ending of a later version"),
)
RATES: tuple[dict[str, Any] | None, ...] = (None, samples.rated(0, 0.0, 0.1684), samples.rated(20))
TOO_MUCH = re.compile(
    r"\brobust\b|\bsafe|guarantee|\bprove|\balways\b|\bnever\b|\bsecure|\bevery|\bno failures?\b(?! was)"
)
"""What no sample of anything shows."""


def everything() -> Iterator[tuple[str, dict[str, Any] | None, Result]]:
    """Results of every command that carries claims, with every ending and rate."""
    for ending, rate, baseline in product(ENDINGS, RATES, (True, False)):
        own = {} if baseline else {"baseline": None}
        for goal in ({}, samples.TARGET, samples.EASIER):
            yield ending, rate, samples.attack(ending=ending, verified=rate, **own, **goal)
    for ending, rate in product(ENDINGS, RATES):
        cell = {**samples.REPLAY["table"][0], "ending": ending, "verified": rate}
        yield ending, rate, ReplayResult.from_values({**samples.REPLAY, "table": [cell]})
        if rate is not None:
            tested = [{"model": "reference", "ending": ending, "verified": rate}]
            row = {**samples.MATRIX["table"][0], "tested": tested}
            yield ending, rate, samples.matrix(table=[row])


def own(values: dict[str, Any]) -> list[RecordedSettings]:
    """The settings that a run of a mug recorded."""
    return [RecordedSettings("", {"object": "mug", **values})]


def nothing(claim: Claim) -> bool:
    """Whether a claim is none, in its kind, its words and its numbers at once."""
    said = claim.kind == "nothing claimed"
    assert said == claim.statement.startswith(NOTHING_CLAIMED) and said == (claim.extent is None)
    return said


def test_no_ending_makes_a_claim_that_the_trials_do_not_carry() -> None:
    kinds = set()
    for ending, rate, result in everything():
        claims = collect_claims(result)
        assert claims, "a run that claims nothing says so"
        for claim in claims:
            kinds.add((claim.kind, ending))
            assert not TOO_MUCH.search(claim.statement), claim.statement
            if nothing(claim):
                continue
            assert claim.extent is not None and not result.is_unfinished
            if claim.kind == "found":
                assert ending == "found" and rate and rate["successes"] == claim.extent.count == 20
            if claim.kind == "not found":
                assert ending in FAILED_SEARCH_ENDINGS and rate is not None and NO_PROOF in claim.statement
                assert re.search(r"Searched were \d+ renders by the policy \w+", claim.statement)
            assert (
                f"{claim.extent.count} of {claim.extent.total}" in claim.statement
                and "95 % interval" in claim.statement
            )
    assert {("found", "found"), ("not found", "stalled"), ("nothing claimed", "already wrong")} <= kinds
    assert not [kind for kind in kinds if kind[0] == "not found" and kind[1] not in FAILED_SEARCH_ENDINGS]


@pytest.mark.parametrize("ending", ["interrupted", "out of time"])
def test_what_was_stopped_claims_nothing_whatever_it_has_counted(ending: str) -> None:
    stopped = [
        samples.attack(ending=ending), samples.sweep(ending=ending), samples.curve(ending=ending),
        samples.region(ending=ending), samples.matrix(ending=ending),
        HardenResult.from_values({**samples.HARDEN, "ending": ending}),
        ExplainResult.from_values({**samples.EXPLAIN, "ending": ending}),
        ReplayResult.from_values({**samples.REPLAY, "ending": ending}),
    ]  # fmt: skip
    for result in stopped:
        (claim,) = collect_claims(result)
        assert nothing(claim) and "not finished" in claim.statement


def test_page_and_markdown_have_every_claim_and_exclusion_and_no_markup_of_others() -> None:
    result = samples.attack(object="<b>mug</b>", warnings=["*loud* <script>"], ending="budget spent")
    run = describe_run("mug-001", result, collect_claims(result), own({"controls": {"texture": {}}}), {"torch": "2"})
    evidence = Evidence(runs=[run], warnings=["Two models."], rules=list(RULES), version="0")
    page, text = make_evidence_page(evidence), format_markdown(evidence)
    assert "<script>" not in page.replace("&lt;script&gt;", "") and "&lt;script&gt;" in page
    assert "\\*loud\\* \\<script\\>" in text and "<b>" not in text
    for one in ("not found", "Two models.", "torch: 2", "texture within 0.1", NO_PROOF):
        assert one in page and one in text
    assert json.loads(to_json(evidence))["runs"][0]["claims"][0]["extent"]["of"] == 20


def test_a_criterion_is_pooled_over_what_was_drawn_only() -> None:
    counted = {"configurations": 60, "correct": 60, "accuracy": 1.0, "interval": (0.94, 1.0)}
    bad = {"configurations": 60, "correct": 30, "accuracy": 0.5, "interval": (0.37, 0.63)}
    rows = [{**counted, "axis": "camera.distance", "unit": "m", "value": 5.0},
            {**bad, "axis": "camera.distance", "unit": "m", "value": 40.0}]  # fmt: skip
    chosen = samples.sweep(axes=rows, drawn={}, grid={"camera.distance": 2})
    assert find_selected_axes(chosen) == ["camera.distance"]
    lines = describe_criterion(collect_claims(chosen), count_conditions(chosen), 0.9, find_selected_axes(chosen))
    assert lines[0].startswith(
        "At least 90 %, each condition by its own 95 % interval: met in 1, not met in 1 and open"
    )
    assert lines[1] == "Not met where: camera.distance 40 m." and not any(": met by" in line for line in lines)
    drawn = samples.sweep(axes=rows, drawn={"camera.distance": {"unit": "m", "low": 5.0, "high": 40.0}}, grid={})
    assert find_selected_axes(drawn) == []
    assert "configurations in which the model is right" in describe_criterion(collect_claims(drawn), [], 0.9)[0]


def test_predictions_of_several_models_to_the_same_pictures_are_not_counted_together() -> None:
    one = {"configurations": 20, "correct": 5, "accuracy": 0.25, "interval": (0.1, 0.5), "axis": "model", "unit": ""}
    rows = [{**one, "value": name} for name in ("first", "second")]
    counts = {"configurations": 40, "correct": 10, "accuracy": 0.25}
    swept = samples.sweep(**counts, model="first,second", axes=rows, ending="finished")
    said = [claim for claim in collect_claims(swept) if "is right in" in claim.statement]
    assert [claim.extent and claim.extent.total for claim in said] == [20, 20]
    assert [claim.statement.split()[2] for claim in said] == ["first", "second"]


def test_a_criterion_is_that_of_right_predictions_whatever_the_words_are() -> None:
    counted = [Extent.from_count("right ones", 3, 4, (0.2, 0.9), counts_right=is_right) for is_right in (False, True)]
    claims = [Claim(kind="measured", statement="3 of 4", extent=extent) for extent in counted]
    assert len(evidence._describe_criterion_of_claims(claims, 0.5, [])) == 1
    assert "counts_right" not in counted[1].model_dump()
