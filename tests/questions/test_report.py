"""What runs stand for: no ending, count or command makes a claim that says more than the run does."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from itertools import product
from typing import Any

import pytest

import samples
from advsearch.controls import CONTROLS
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.compare import CompareConfig
from advsearch.questions.explain import ExplainConfig
from advsearch.questions.explain.result import ExplainResult
from advsearch.questions.harden.result import HardenResult
from advsearch.questions.photographs.result import PhotoAgreement
from advsearch.questions.recipe.result import RecipeResult
from advsearch.questions.replay.result import ReplayResult
from advsearch.questions.report.evidence import (
    DOMAIN,
    OTHER,
    RULES,
    collect_claims,
    count_conditions,
    describe_criterion,
    describe_domain,
    describe_run,
    find_domain_part,
    find_selected_axes,
    list_photograph_claims,
    warn_of_different_models,
)
from advsearch.questions.report.recorded import RecordedSettings
from advsearch.questions.report.result import Evidence, format_markdown, make_evidence_page
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.questions.test.settings import SuiteConfig
from advsearch.report.views import FAILED_SEARCH_ENDINGS, NO_PROOF, NOTHING_CLAIMED, Claim
from advsearch.runs.results import Result
from advsearch.runs.summary import compute_bundled_digests, to_json
from advsearch.scene.settings import SETTINGS
from advsearch.settings import Config, settings

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
        yield ending, rate, ReplayResult.of({**samples.REPLAY, "table": [cell]})
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
        HardenResult.of({**samples.HARDEN, "ending": ending}), ExplainResult.of({**samples.EXPLAIN, "ending": ending}),
        ReplayResult.of({**samples.REPLAY, "ending": ending}),
    ]  # fmt: skip
    for result in stopped:
        (claim,) = collect_claims(result)
        assert nothing(claim) and "not finished" in claim.statement


def test_a_sweep_says_how_its_configurations_were_chosen() -> None:
    drawn = collect_claims(samples.sweep(sampler="random", samples=8))[0].statement
    sobol = collect_claims(samples.sweep(sampler="sobol", samples=8))[0].statement
    grid = collect_claims(samples.sweep(grid={"pose.yaw": 8}))[0].statement
    foreign = collect_claims(samples.sweep())[0].statement
    assert "drawn by chance" in drawn and not [text for text in (sobol, grid, foreign) if "by chance" in text]
    assert "which these are not" in sobol and "between or beside these points" in grid and "not known" in foreign
    assert nothing(collect_claims(samples.sweep(accuracy=None, interval=None, configurations=0, correct=0))[0])


def test_envelopes_regions_curves_and_hardening_are_claims_as_far_as_they_were_counted() -> None:
    (region,) = collect_claims(samples.region())
    assert "pose.yaw 10 to 55.5 degrees" in region.statement and "by sampling" in region.statement
    assert nothing(collect_claims(samples.region(samples=None, same=None))[0])
    rule, held = collect_claims(ExplainResult.of(samples.EXPLAIN))
    assert "rule 1" in rule.statement and "camera.elevation over 60 degrees" in held.statement and not nothing(held)
    for box in (None, {**samples.EXPLAIN["envelope"], "held": False}):
        alone = {**samples.EXPLAIN, "envelope": box}
        assert [one.kind for one in collect_claims(ExplainResult.of(alone))] == ["measured"], "of the rule"
        assert nothing(collect_claims(ExplainResult.of({**alone, "rules": []}))[0])
    assert [NO_PROOF in one.statement for one in collect_claims(samples.curve())] == [True]
    table = [{**row, "renders": {"search": 40, "baseline": 30}} for row in samples.CURVE["table"]]
    (counted,) = collect_claims(samples.curve(table=table))
    assert "no failure of" in counted.statement
    assert (
        f"together, {40 * len(table)} renders by the policy auto and {30 * len(table)} by random" in counted.statement
    )
    assert [NO_PROOF in one.statement for one in collect_claims(HardenResult.of(samples.HARDEN))] == [True, True]
    assert nothing(collect_claims(RecipeResult.of(samples.RECIPE))[0]), "its parts are runs of their own"


def test_photographs_say_how_far_they_agree() -> None:
    counted = {"photos": 4, "right_right": 3, "right_wrong": 1, "wrong_right": 0, "wrong_wrong": 0, "agreement": 0.75,
               "interval": (0.19, 0.99), "renderings": []}  # fmt: skip
    (claim,) = list_photograph_claims(PhotoAgreement.of(counted))
    assert "3 of 4 (75 %, 95 % interval 19-99 %)" in claim.statement
    assert not list_photograph_claims(PhotoAgreement.of({**counted, "photos": 0, "interval": None}))


def test_runs_of_other_models_or_of_a_file_that_changed_are_told() -> None:
    assert not warn_of_different_models(["reference", "reference"], ["", ""])
    assert "different models: a.pt2, reference" in warn_of_different_models(["reference", "a.pt2"], ["", "00"])[0]
    assert "not the same in all runs" in warn_of_different_models(["a.pt2", "a.pt2"], ["00", "11"])[0]


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


def test_a_run_without_what_it_was_made_with_says_so() -> None:
    result = samples.attack()
    assert "not noted" in str(describe_run("a", result, collect_claims(result), [], {}).made_with)


def test_evidence_says_what_varied_how_far_and_what_judged() -> None:
    drawn = {"camera.distance": {"unit": "object sizes", "low": 1.5, "high": 30.0}}
    counted = {"configurations": 60, "correct": 30, "accuracy": 0.5, "interval": (0.3, 0.6)}
    rows = [{**counted, "axis": "environment", "unit": "", "value": name} for name in ("cafe", "canteen")]
    part = {**counted, "axis": "camera.distance", "unit": "object sizes", "value": (1.5, 8.0)}
    swept = samples.sweep(axes=[*rows, part], drawn=drawn, controls=["camera"], sampler="random", grid={})
    given = {"trials": 20, "task": {"name": "detection", "confidence": 0.25}, "set": {"camera.ev": 11.0}}
    given["objective"] = "create"
    found = describe_run("a", swept, collect_claims(swept), own(given), {})
    assert "camera.distance: 1.5 to 30 object sizes, drawn by chance" in found.searched
    assert "environment: cafe, canteen" in found.searched and not any("by default" in line for line in found.searched)
    assert found.measured["Judged with"] == "detection (iou 0.5, confidence 0.25, suppression 0.5, seek create)"
    assert found.settings["task"] == found.measured["Judged with"], "also what is default"
    assert "camera.ev" in found.settings["set"] and "environment" not in found.settings
    assert found.measured["Trials of the worst configuration"] == "20" and "Trials" not in found.measured
    assert "as many in each of the 2 environments" in found.claims[0].statement
    azimuth = {"unit": "degrees", "low": 0.0, "high": 360.0}
    over = {"camera.azimuth": azimuth, "environment.which": {"unit": "name", "names": ["noon", "studio"]}}
    many = samples.attack(over=["camera", "environment"], conditions=over, verified=samples.rated(18, trials=18))
    found = describe_run("b", many, collect_claims(many), own({"labels": "mug,cup", "prompt": "a {}"}), {})
    assert (found.about["Names of its classes"], found.about["Prompt"]) == ("mug,cup", "a {}")
    assert "camera.azimuth: 0 to 360 degrees, by chance" in found.searched
    assert "environment.which: noon or studio, by chance" in found.searched
    assert found.about["Environment"] == "varied, see below; the clean scene has studio"
    assert found.measured["Verification"].startswith("18 renders with fresh seeds that count, those of 20 in which")
    assert found.excluded[0] == "Nothing varied but what stands under What varied, and the noise of the renders."


def test_predictions_of_several_models_to_the_same_pictures_are_not_counted_together() -> None:
    one = {"configurations": 20, "correct": 5, "accuracy": 0.25, "interval": (0.1, 0.5), "axis": "model", "unit": ""}
    rows = [{**one, "value": name} for name in ("first", "second")]
    counts = {"configurations": 40, "correct": 10, "accuracy": 0.25}
    swept = samples.sweep(**counts, model="first,second", axes=rows, ending="finished")
    said = [claim for claim in collect_claims(swept) if "is right in" in claim.statement]
    assert [claim.extent and claim.extent.total for claim in said] == [20, 20]
    assert [claim.statement.split()[2] for claim in said] == ["first", "second"]


def test_a_run_notes_what_is_bundled_and_used_and_nothing_else() -> None:
    def bundled(config: Config) -> set[str]:
        known = {one.name for one in settings(type(config))}
        return {*compute_bundled_digests({name: value for name, value in config.to_json().items() if name in known})}

    model = "bundled model reference"
    assert bundled(AttackConfig(object="mug")) == {"bundled object mug", "bundled environment studio", model}
    assert bundled(ExplainConfig(sweeps="mug-sweep-001")) == bundled(SuiteConfig(suite="suite.yaml")) == set()
    assert bundled(CompareConfig(compared="a,b")) == set(), "stored sweeps are read"
    controls = {"environment": {"which": ["loft", "noon"]}}
    searched = bundled(
        AttackConfig(object="my-mug.obj", model="mug.pt2", label="mug", controls=controls, things="car@4,2")
    )
    assert searched == {f"bundled {what}" for what in ("environment studio", "environment loft", "environment noon",
                                                       "object car")}  # fmt: skip


def test_settings_are_listed_as_far_as_they_were_used() -> None:
    config = AttackConfig(object="car", camera="dashcam", set_={"ground.kind": "table"})
    listed = RecordedSettings("", {**config.to_json(), "command": "attack"}).as_text()
    assert (listed["camera"], listed["set"]) == ("dashcam", '{"ground.kind": "table"}') and listed["seed"] == "0"
    assert not {"environment", "run", "overwrite", "minimise", "over", "target"} & listed.keys()
    swept = {**SweepConfig(object="mug").to_json(), "command": "sweep"}
    assert "fps" not in RecordedSettings("", swept).as_text(), "there is no path"
    assert RecordedSettings("", {**swept, "path": "approach"}).as_text()["fps"] == "2.0"
    compared = {**CompareConfig(compared="a,b").to_json(), "command": "compare"}
    assert RecordedSettings("b", compared).as_text() == {"b: compared": "a,b"}, "it renders nothing"


@pytest.mark.parametrize("name", [*SETTINGS, *CONTROLS])
def test_every_setting_of_a_scene_has_its_part_of_a_domain(name: str) -> None:
    assert find_domain_part(name) in (*DOMAIN, OTHER)
    result = samples.attack(controls=["geometry"], over=[])
    domain = describe_domain(result, own({"set": {name: 1.5}}), [])
    assert any(f"{name} 1.5" in part.text for part in domain.values()) or find_domain_part(name) == "surfaces"


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
    explained = collect_claims(ExplainResult.of(samples.EXPLAIN))
    assert (
        "that were chosen: others give another share" in describe_criterion(explained, [], 0.9, ["camera.distance"])[0]
    )
