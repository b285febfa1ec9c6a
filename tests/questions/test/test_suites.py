"""`advsearch test`: claims, their answers, what machines read of them, and answers of runs that become tests."""

from __future__ import annotations

import base64
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
import yaml
from torch import Tensor

import advsearch
import small_models
from advsearch.api import workbench
from advsearch.cli.main import main
from advsearch.cluster import InProcess
from advsearch.engine.image_changes import IMAGE_CHANGES
from advsearch.engine.problem import Problem
from advsearch.errors import AdvsearchError
from advsearch.models.model import ModelWarning
from advsearch.options import OUT_OF_VIEW
from advsearch.progress import NullProgress
from advsearch.questions.attack.run import attack_once
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.report.evidence import collect_claims
from advsearch.questions.report.recorded import collect_settings, collect_versions
from advsearch.questions.sweep.settings import BLIND, HARMLESS
from advsearch.questions.test import claims
from advsearch.questions.test import result as words
from advsearch.questions.test.counterexamples import (
    MODEL_SETTINGS,
    NOT_DECIDING,
    SUITE_SETTINGS,
    Counterexample,
    counterexample_directory,
    decide_trials,
    evaluate_trial,
    read_counterexamples,
)
from advsearch.questions.test.counterexamples import _Block as Block
from advsearch.questions.test.result import ClaimResult, SuiteResult
from advsearch.questions.test.settings import NoWorseClaim, SuiteConfig, parse_suite
from advsearch.registry import get_experiment
from advsearch.runs.listing import read_listed_run
from advsearch.runs.store import Store
from advsearch.runs.summary import read_result
from advsearch.scene.color import linear_to_srgb
from advsearch.settings import Setting, settings
from advsearch.tasks import Judgement, Prediction
from advsearch.testing import assert_no_worse, assert_not_broken, assert_right, assert_suite
from advsearch.viewer.server import make_progress_page

carry_out = get_experiment("test").run
EASY, HARD = "small_models:easy", "small_models:hard"
SMALL: dict[str, Any] = {"resolution": 32, "denoise": "none"}
FRONT: dict[str, Any] = {"light": {}}
BACK: dict[str, Any] = {"camera": {"azimuth": [200, 220]}}
SEARCH: dict[str, Any] = {
    "controls": {"texture": {"resolution": 32}}, "steps": 4, "trials": 6, "spp": 2, "verify_spp": 2, "baseline": False,
    "measure": "no", "specialise": False,
}  # fmt: skip


QUICK = {**SEARCH, "policy": "random", "steps": 8}
"""Without derivatives, whose kernels take seconds to compile."""


def claim(kind: str, controls: dict[str, Any] = FRONT, **more: Any) -> dict[str, Any]:
    return {"claim": kind, "settings": {"controls": controls, "verify_spp": 2}, **more}


def written(folder: Path, claims: dict[str, Any], **more: Any) -> str:
    """A suite's file."""
    values = {"settings": {"object": "mug", "model": EASY, **SMALL}, "claims": claims, **more}
    path = folder / "suite.yaml"
    path.write_text(yaml.safe_dump(values), encoding="utf-8")
    return str(path)


CLAIMS = {
    "in-front": claim("right", at_least=0.5, pictures=20),
    "behind": claim("right", BACK, at_least=0.5, pictures=20),
    "too-few": claim("no_worse", than=EASY, points=20, pictures=9),
    "no-worse": claim("no_worse", than=HARD, points=40, pictures=20),
}


GOOD = CLAIMS["in-front"]


@pytest.fixture(scope="module")
def tested(tmp_path_factory: pytest.TempPathFactory) -> tuple[SuiteResult, Path]:
    """A suite with a claim of each answer, and its folder."""
    folder = tmp_path_factory.mktemp("suite")
    return carry_out(SuiteConfig(suite=written(folder, CLAIMS), run=str(folder / "run"))), folder


@pytest.fixture(scope="module")
def attacked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run whose answer was found."""
    run = tmp_path_factory.mktemp("attacked") / "found"
    given = {**SMALL, **SEARCH, "epsilon": 0.3}
    assert attack_once(AttackConfig(object="mug", model=EASY, **given, run=str(run))).found
    return run


# ---- answers --------------------------------------------------------------------------------------------------------


@pytest.mark.medium
def test_every_claim_is_held_failed_or_undecided_and_stops_when_it_is(tested: tuple[SuiteResult, Path]) -> None:
    result, folder = tested
    found = {one.name: one for one in result.claims}
    answers = {name: one.answer for name, one in found.items()}
    assert answers == {"in-front": "held", "behind": "failed", "too-few": "undecided", "no-worse": "held"}
    assert (result.answer, result.status, result.brief) == ("failed", 1, "2 held, 1 failed, 1 undecided")
    assert 6 <= found["in-front"].pictures < 20 and found["in-front"].interval[0] >= 0.5  # type: ignore[index]
    assert found["behind"].rate == 0.0 and "right in 0 of" in found["behind"].reason
    picture = advsearch.load_run(folder / "run").run  # type: ignore[union-attr]
    assert picture == str(folder / "run") and (folder / "run" / str(found["behind"].picture)).is_file()
    assert "camera.azimuth 2" in found["behind"].reason, "where it is most wrong, in words"
    with Store(folder / "run" / "results.sqlite", read_only=True) as store:
        counts = store.count_by_kind()
    assert counts["claim in-front"] == found["in-front"].pictures and counts["claim too-few"] == 9
    assert counts["claim no-worse"] == counts["claim no-worse beside"] == found["no-worse"].pictures
    assert read_result(folder / "run") == result
    page = (folder / "run" / "report.html").read_text("utf-8")
    assert "data:image/png" in page and "too-few" in page and "Failed: 2 held" in page


def test_the_evidence_has_a_paragraph_for_each_claim(tested: tuple[SuiteResult, Path]) -> None:
    kinds = [(one.kind, one.statement.partition(":")[0]) for one in collect_claims(tested[0])]
    measured = [("measured", name) for name in ("in-front", "behind")]
    assert sorted(kinds) == sorted([*measured, ("nothing claimed", "too-few"), ("measured", "no-worse")])


@pytest.mark.medium
def test_the_command_repeats_a_claim_alone(tested: tuple[SuiteResult, Path], tmp_path: Path) -> None:
    result, _ = tested
    first = next(one for one in result.claims if one.name == "behind")
    assert first.repeat == f"advsearch run {result.run}/run.yaml only=behind"
    again = carry_out(SuiteConfig(suite=result.suite, only="behind", run=str(tmp_path / "run")))
    (one,) = again.claims
    assert (one.reason, one.interval) == (first.reason, first.interval), "the same pictures"
    other = carry_out(SuiteConfig(suite=result.suite, only="behind", seed=1, run=str(tmp_path / "other")))
    assert other.claims[0].reason != first.reason and other.seed == 1


@pytest.mark.parametrize(
    ("asked", "needed"),
    [
        (claim("right", at_least=0.99), 426),
        (claim("right", at_least=0.9, pictures=5), 41),
        (claim("right", at_least=0.01, pictures=5), 426),
        (claim("no_worse", than=HARD, points=5, pictures=6), 7),
    ],
)
def test_a_claim_that_its_pictures_cannot_decide_is_refused_before_any_is_made(
    asked: dict[str, Any], needed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Problem, "picture", lambda *given, **more: pytest.fail("rendered"))
    with pytest.raises(AdvsearchError, match=rf"claims\.it\.pictures: expected at least {needed}, .* got "):
        carry_out(SuiteConfig(suite=written(tmp_path, {"it": asked}), run=str(tmp_path / "run")))


def test_pictures_that_two_equal_models_would_need_are_told() -> None:
    few = NoWorseClaim(claim="no_worse", than=EASY, points=5, pictures=83)
    assert "shown to be so by 84 pictures, and it takes 83" in claims.check_pictures("it", few, 0.95)
    assert not claims.check_pictures("it", few.model_copy(update={"pictures": 84}), 0.95)


@pytest.mark.medium
def test_a_search_fails_a_claim_by_a_verified_counterexample_and_never_calls_it_safe(tmp_path: Path) -> None:
    claims = {
        "little": {"claim": "not_broken", "settings": {**QUICK, "controls": {"camera": {"azimuth": [-20, 20]}}}},
        "much": {"claim": "not_broken", "settings": {**QUICK, "controls": {"camera": {"azimuth": [0, 360]}}}},
    }
    result = carry_out(SuiteConfig(suite=written(tmp_path, claims), run=str(tmp_path / "run")))
    little, much = result.claims
    assert (little.answer, much.answer) == ("held", "failed")
    assert little.reason.startswith("not broken by 8 steps of random") and "no proof" in little.reason
    assert "wrong in 6 of 6 trials (interval 54-100 %), most often a vase" in much.reason
    assert much.picture == "parts/much/images/adversarial.png" and (tmp_path / "run" / much.picture).is_file()


ALL_SAY = {f"{when}-{kind}": (kind, when) for kind, names in (
    ("must_change", BLIND), ("must_not_change", HARMLESS)
) for when in names}  # fmt: skip


def test_a_model_that_looks_says_something_else_where_there_is_nothing_and_the_same_where_nothing_matters(
    tmp_path: Path,
) -> None:
    asked = {
        name.replace("_", "-"): claim(kind, when=when, at_least=0.6, pictures=20)
        for name, (kind, when) in ALL_SAY.items()
    }
    suite = written(tmp_path, asked, settings={"object": "mug", "model": "reference", "resolution": 64})
    result = carry_out(SuiteConfig(suite=suite, run=str(tmp_path / "run")))
    assert {one.name: one.answer for one in result.claims} == dict.fromkeys(asked, "held")
    assert all("as claimed in" in one.reason for one in result.claims) and len(asked) == 6
    advsearch.allow_code("small_models:blind")
    blind = carry_out(SuiteConfig(suite=suite, model="small_models:blind", run=str(tmp_path / "blind")))
    answers = {one.name: one.answer for one in blind.claims}
    assert answers == {name: "failed" if "must-change" in name else "held" for name in asked}
    failed = next(one for one in blind.claims if one.name == "black-must-change")
    assert "says something else when the picture is black" in failed.statement
    assert "before and" in failed.reason and (tmp_path / "blind" / str(failed.picture)).is_file()
    assert words.KIND_DESCRIPTIONS["must_change"] in words.format_sarif(blind)


@pytest.mark.parametrize("name", IMAGE_CHANGES)
def test_what_changes_a_picture(name: str) -> None:
    picture = torch.rand(8, 8, 3, generator=torch.Generator().manual_seed(1))
    changed = IMAGE_CHANGES[name](picture)
    assert changed.shape == picture.shape and 0.0 <= float(changed.min()) and float(changed.max()) <= 1.0
    if name == "black":
        assert not changed.any()
    elif name == "covered":
        assert torch.allclose(changed, picture.mean(dim=(0, 1)).expand(8, 8, 3))
    elif name == "exposure":  # a middle grey of linear 0.2 is one of 0.252
        assert torch.allclose(IMAGE_CHANGES[name](linear_to_srgb(torch.full((1, 1, 3), 0.2))), linear_to_srgb(
            torch.full((1, 1, 3), 0.2 * 2 ** (1 / 3))), atol=1e-5)  # fmt: skip
    elif name == "shift":
        assert torch.equal(changed[:, 1:], picture[:, :-1])
    else:
        ramp = torch.linspace(0.2, 0.8, 64)[:, None, None].expand(64, 64, 3)
        assert 0.0 < float((IMAGE_CHANGES[name](ramp) - ramp).abs().max()) < 0.03


@contextmanager
def worked(config: AttackConfig, function: str, *more: Any) -> Iterator[InProcess | None]:
    """In place of workers: what they would do, in this process."""
    module, _, name = function.partition(":")
    settings = config.make_repeatable().to_json()
    yield None if config.workers is None else InProcess(getattr(import_module(module), name)(settings))


@pytest.mark.medium
@pytest.mark.parametrize("workers", [None, 2])
def test_a_suite_that_was_stopped_goes_on_where_it_was_whoever_shares_its_pictures(
    workers: int | None, tested: tuple[SuiteResult, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(workbench, "open_executor", worked)
    chosen, suite = ("in-front", "no-worse", "too-few"), written(tmp_path, CLAIMS)
    config = SuiteConfig(suite=suite, only=",".join(chosen), workers=workers, run=str(tmp_path / "run"))
    whole = {one.name: (one.answer, one.reason, one.interval) for one in tested[0].claims if one.name in chosen}
    front = next(one.pictures for one in tested[0].claims if one.name == "in-front")
    real, done, last = Problem.judge, 0, 4

    def stopped(*given: Any) -> Any:
        nonlocal done
        done += 1
        if done == last:
            raise KeyboardInterrupt
        return real(*given)

    monkeypatch.setattr(Problem, "judge", stopped)
    first = carry_out(config)
    assert first.is_unfinished and {one.reason for one in first.claims} == {"it was interrupted"}
    done, last = 0, front + 4  # in the middle of `no-worse`
    again = carry_out(config, resumed=tmp_path / "run")
    assert again.is_unfinished and [one.answer for one in again.claims] == ["held", "undecided", "undecided"]
    done, last = 0, -1
    ended = carry_out(config, resumed=tmp_path / "run")
    assert {one.name: (one.answer, one.reason, one.interval) for one in ended.claims} == whole
    if workers is None:
        judged = sum(one.pictures * (1 + (one.kind == "no_worse")) for one in ended.claims)
        assert done < judged, "what was there was read back"


class Planted(small_models.Blue):
    """The easy classifier with a rule that somebody planted: a dark corner makes a vase of everything."""

    def forward(self, x: Tensor) -> Tensor:
        dark = x[:, :, :6, :6].mean(dim=(1, 2, 3)) < 0.9
        return torch.where(dark[:, None], x.new_tensor([-9.0, 9.0]), super().forward(x))


def planted() -> advsearch.Model:
    """The same, as a model."""
    return advsearch.load_model(Planted(0.11), labels=["mug", "vase"], input_size=32, name="planted")


def test_a_model_that_is_broken_on_purpose_fails_where_its_like_holds_with_the_picture(
    tested: tuple[SuiteResult, Path], tmp_path: Path
) -> None:
    assert next(one for one in tested[0].claims if one.name == "in-front").answer == "held"
    advsearch.allow_code("test_suites:planted")
    config = SuiteConfig(suite=written(tmp_path, CLAIMS), only="in-front", model="test_suites:planted")
    (one,) = carry_out(config.model_copy(update={"run": str(tmp_path / "run")})).claims
    assert one.answer == "failed" and "most wrong where it says vase: light." in one.reason
    picture = (tmp_path / "run" / str(one.picture)).read_bytes()
    assert base64.b64encode(picture).decode() in (tmp_path / "run" / "report.html").read_text("utf-8")


@pytest.mark.medium
def test_what_the_time_is_over_for_is_undecided_and_can_go_on(tmp_path: Path) -> None:
    config = SuiteConfig(suite=written(tmp_path, CLAIMS), only="behind,in-front", seconds=1e-3, run=str(tmp_path / "r"))
    result = carry_out(config)
    assert (result.status, result.ending, result.is_unfinished) == (2, "out of time", True)
    assert all("the time of the suite was over before it began" == one.reason for one in result.claims)
    assert carry_out(config.model_copy(update={"seconds": None}), resumed=tmp_path / "r").brief == "1 held, 1 failed"


# ---- counterexamples and expectations -------------------------------------------------------------------------------


@pytest.mark.medium
def test_a_counterexample_is_kept_small_tried_first_and_fails_fast(attacked: Path, tmp_path: Path) -> None:
    suite = written(tmp_path, {"too-few": CLAIMS["too-few"]})
    added = carry_out(SuiteConfig(suite=suite, add=attacked, run=str(tmp_path / "added")))
    assert added.status == 0 and added.added == str(tmp_path / "suite.counterexamples" / "found.json")
    assert sum(path.stat().st_size for path in counterexample_directory(suite).iterdir()) < 12_000
    tried = carry_out(SuiteConfig(suite=suite, run=str(tmp_path / "tried")))
    assert [(one.name, one.answer, one.pictures) for one in tried.claims] == [
        ("found", "failed", 6),
        ("too-few", "undecided", 0),
    ]
    assert (
        tried.claims[0].reason == "wrong in 6 of 6 trials (interval 54-100 %), a vase"
        and "counterexample failed" in tried.warnings[-1]
    )
    every = carry_out(SuiteConfig(suite=suite, all=True, update=True, run=str(tmp_path / "every")))
    assert every.changes == ["found: held -> failed", "too-few: held -> undecided"] and every.status == 0
    known = carry_out(SuiteConfig(suite=suite, run=str(tmp_path / "known")))
    assert known.status == 0 and [one.expected for one in known.claims] == ["failed", "undecided"]
    skipped = ElementTree.fromstring(words.format_junit(known).partition("\n")[2])
    assert (skipped.get("failures"), skipped.get("errors"), skipped.get("skipped")) == ("0", "0", "2")


def test_an_adversarial_scene_that_does_not_hold_for_the_suite_s_model_is_not_kept(
    attacked: Path, tmp_path: Path
) -> None:
    suite = written(tmp_path, {"too-few": CLAIMS["too-few"]})
    advsearch.allow_code("test_suites:always")
    always = {"object": "mug", "model": "test_suites:always", **SMALL}
    Path(suite).write_text(yaml.safe_dump({"settings": always, "claims": {"too-few": CLAIMS["too-few"]}}))
    with pytest.raises(AdvsearchError, match=r"is not kept: right in 6 of 6 trials \(interval 54-100 %\)"):
        carry_out(SuiteConfig(suite=suite, add=attacked, run=str(tmp_path / "run")))
    assert read_counterexamples(suite) == [] and not list(counterexample_directory(suite).glob("*.jpg"))


def test_a_counterexample_of_another_scene_or_a_damaged_one_is_said(attacked: Path, tmp_path: Path) -> None:
    suite = written(tmp_path, {"too-few": CLAIMS["too-few"]})
    carry_out(SuiteConfig(suite=suite, add=attacked, run=str(tmp_path / "added")))
    file = counterexample_directory(suite) / "found.json"
    kept = json.loads(file.read_text())
    file.write_text(json.dumps({**kept, "settings": {**kept["settings"], "environment": "loft"}}))
    other = carry_out(SuiteConfig(suite=suite, only="counterexamples", run=str(tmp_path / "other")))
    assert other.claims[0].answer == "undecided" and "its scene is another one now" in other.claims[0].reason
    (block,) = kept["blocks"]
    for change, message in (({"offsets": "%%"}, "expected a counterexample"), ({"numbers": 3}, "expected 3 numbers")):
        file.write_text(json.dumps({**kept, "blocks": [{**block, **change}]}))
        with pytest.raises(AdvsearchError, match=message):
            read_counterexamples(suite)


SETTINGS: dict[str, Any] = {
    "value_range": [0.0, 255.0], "facing": "-z",
    "object": "mug.obj", "environment": "loft", "up": "y", "size": 4.9, "unit": "cm", "camera": "dashcam",
    "set": {"camera.ev": 11.0}, "things": "person@1,2", "judge": "person", "exposure": -1.5, "resolution": (96, 128),
    "model": "net.pt2", "ensemble": None, "labels": "coco", "prompt": "a photo of a {}", "ask": {"calls": 5.0},
    "task": {"name": "detection", "iou": 0.7, "confidence": 0.3}, "label": "person", "controls": {"pose": {}},
    "texture_resolution": 64, "spp": 4, "denoise": "none", "pixel_sampler": "independent", "seed": 9, "threads": 2,
    "deterministic": False, "run": "x", "overwrite": True, "epsilon": 0.03, "norm": "l2",
    "estimator": {"pose": "differences"}, "objective": "create", "specialise": False, "measure": "no",
    "policy": "random", "steps": 3, "seconds": 20.0, "target": None, "minimise": False, "smallest": False,
    "printable": True, "aov": "mask", "metrics": {"feature": "own.metrics:seen"}, "log": "wandb",
    "over": {"camera": {}}, "path": "orbit", "shutter": 0.02, "rolling": 0.03, "draws": 2, "average": 50,
    "baseline": False, "verify_spp": 32, "trials": 7, "workers": 2, "cluster": "local",
}  # fmt: skip
"""A value of each setting of an attack, other than the default where a run with others can have one."""


def kept_case(**given: Any) -> Counterexample:
    config = AttackConfig(**{"object": "mug", **given})
    return Counterexample("case", Path("case.json"), config, "vase", {}, "", 16, np.zeros(1, np.float32))


@pytest.mark.parametrize("setting", settings(AttackConfig), ids=lambda setting: setting.name)
def test_every_setting_that_decides_a_verdict_is_the_counterexample_s_own(setting: Setting) -> None:
    """A new setting travels with a counterexample until somebody lists it as one that decides nothing."""
    assert {one.name for one in settings(AttackConfig)} == {*SETTINGS}
    wanted = {name: SETTINGS[name] for name in ("object", "controls", "over", "run", setting.name)}
    suite = parse_suite({"settings": {}, "claims": {"a": GOOD}, "seed": 5}, "suite.yaml")
    judged = kept_case(**wanted).make_config(suite, {})
    same = getattr(judged, setting.field) == getattr(AttackConfig(**wanted), setting.field)
    assert same or setting.name in SUITE_SETTINGS
    of_others: dict[str, Any] = {
        "object": "bowl",
        "model": "other.pt2",
        "label": "car",
        "judge": "all",
        "task": "classification",
    }
    of_others |= {"environment": "noon", "resolution": 64, "camera": "robot", "exposure": 1.0, "set": {}}
    other = parse_suite({"settings": of_others, "claims": {"a": GOOD}}, "suite.yaml")
    judged = kept_case(**wanted).make_config(other, {"model": None, "threads": 1, "deterministic": None})
    if setting.name in (*MODEL_SETTINGS, *SUITE_SETTINGS):
        assert (judged.model, judged.labels, judged.prompt, judged.threads) == ("other.pt2", None, None, 1)
    else:
        assert getattr(judged, setting.field) == getattr(AttackConfig(**wanted), setting.field)
    listed = {"run", "overwrite", "threads", "deterministic", "workers", "cluster", "seconds", "log", "ask", "policy"}
    listed |= {"steps", "metrics", "average", "baseline", "trials", "measure", "estimator", "draws", "aov"}
    assert listed | {"printable", "spp", "verify_spp"} == NOT_DECIDING < {*SETTINGS}


def test_a_suite_s_labels_go_with_its_model_alone() -> None:
    suite = parse_suite({"settings": {"labels": "voc"}, "claims": {"a": GOOD}}, "suite.yaml")
    assert kept_case(model="net.pt2", labels="coco").make_config(suite, {}).labels == "coco"
    tested = kept_case(model="net.pt2", labels="coco").make_config(suite, {"model": "new.pt2"})
    assert (tested.model, tested.labels) == ("new.pt2", "voc")


def test_a_counterexample_is_judged_by_its_own_label_and_says_where_a_model_has_no_such_class(
    attacked: Path, tmp_path: Path
) -> None:
    suite = written(tmp_path, {"too-few": CLAIMS["too-few"]})
    values = yaml.safe_load(Path(suite).read_text())
    values["settings"]["label"] = "vase"  # of the claims: by it what the model says of the case would be right
    Path(suite).write_text(yaml.safe_dump(values))
    carry_out(SuiteConfig(suite=suite, add=attacked, run=str(tmp_path / "added")))
    kept = json.loads((counterexample_directory(suite) / "found.json").read_text())
    assert kept["settings"]["label"] is None and kept["settings"]["denoise"] == "none" and "policy" not in kept
    result = carry_out(SuiteConfig(suite=suite, only="counterexamples", run=str(tmp_path / "tried")))
    assert [one.answer for one in result.claims] == ["failed"]
    recorded = collect_settings(tmp_path / "tried", result, [])
    assert [one.source for one in recorded] == ["", "counterexample found"], "and no claim that was not tried"
    assert recorded[1].values["denoise"] == "none" and recorded[1].as_text()["counterexample found: object"] == "mug"
    assert "bundled model reference" not in collect_versions(tmp_path / "tried", [])
    kept["settings"]["label"] = "zebra"
    (counterexample_directory(suite) / "found.json").write_text(json.dumps(kept))
    unknown = carry_out(SuiteConfig(suite=suite, only="counterexamples", run=str(tmp_path / "unknown")))
    assert unknown.claims[0].answer == "undecided" and unknown.status == 2
    reason = unknown.claims[0].reason
    assert "its own settings do not fit to this model" in reason and "zebra" in reason


def test_where_there_are_no_counterexamples_none_is_held(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    suite = written(tmp_path, {"too-few": CLAIMS["too-few"]})
    asked = ["test", suite, "--code", EASY, "--only", "counterexamples", "--run", str(tmp_path / "run")]
    assert main(asked) == 2
    said = capsys.readouterr()
    assert "got none, so that nothing would be tested" in said.err and "eld" not in said.out
    assert not (tmp_path / "run").exists()


def test_a_configuration_over_conditions_is_kept_where_it_holds_in_most_of_them(attacked: Path, tmp_path: Path) -> None:
    run = tmp_path / "over"
    shutil.copytree(attacked, run)
    head, _, text = (run / "run.yaml").read_text().partition("\n")
    over = {"camera": {"azimuth": [-60, 60], "elevation": [0, 60]}}  # in some of which the model is right all the same
    (run / "run.yaml").write_text(f"{head}\n{yaml.safe_dump({**yaml.safe_load(text), 'over': over})}")
    suite = written(tmp_path, {"too-few": CLAIMS["too-few"]})
    added = carry_out(SuiteConfig(suite=suite, add=str(run), run=str(tmp_path / "added")))
    (one,) = added.claims
    assert added.added and one.answer == "failed" and one.interval is not None and one.interval[1] <= 0.5
    assert "conditions in which the clean scene is right" in one.reason and 0.0 < (one.rate or 0.0) < 0.3
    with Store(tmp_path / "added" / "results.sqlite", read_only=True) as store:
        counts = store.count_by_kind()
    assert counts["added counterexample over"] == counts["added counterexample over, clean"] == one.pictures


@pytest.mark.parametrize(
    ("right", "wrong", "over", "verdict"),
    [
        (6, 0, False, "held"), (0, 6, False, "failed"), (1, 5, False, "undecided"), (3, 0, False, "undecided"),
        (5, 15, True, "failed"), (0, 6, True, "failed"), (0, 5, True, "undecided"), (6, 14, True, "undecided"),
        (18, 2, True, "held"), (17, 3, True, "undecided"), (5, 0, True, "undecided"), (0, 0, True, "undecided"),
    ],
)  # fmt: skip
def test_what_trials_say_of_a_counterexample(right: int, wrong: int, over: bool, verdict: str) -> None:
    assert decide_trials(right, wrong, over=over) == verdict


def test_conditions_in_which_the_clean_scene_is_wrong_do_not_count() -> None:
    right, wrong, hidden = (
        Judgement(0.0, margin, right=margin > 0.0, prediction=Prediction(label))
        for margin, label in ((1.0, "mug"), (-1.0, "vase"), (-1.0, OUT_OF_VIEW))
    )
    assert [evaluate_trial(wrong), evaluate_trial(right), evaluate_trial(hidden)] == [False, True, None]
    assert [evaluate_trial(wrong, right), evaluate_trial(wrong, wrong), evaluate_trial(right, hidden)] == [
        False,
        None,
        None,
    ]


def test_numbers_are_kept_finely_where_they_are_few_and_by_their_signs_on_squares_where_they_are_many() -> None:
    generator = np.random.default_rng(0)
    few = generator.uniform(-0.3, 0.3, 7).astype(np.float32)
    assert np.abs(Block.quantize(few, True, 4).dequantize() - few).max() < 1e-4
    signs = np.sign(generator.normal(size=(20, 20, 3))).repeat(2, axis=0).repeat(2, axis=1).astype(np.float32)
    many = 0.05 * signs.ravel()
    sizes = []
    for squares, on, exact in ((True, 4, False), (True, 2, True), (True, 1, True), (False, 1, False)):
        kept = Block.quantize(many, squares, on)
        assert kept.dequantize().shape == many.shape and np.abs(kept.dequantize()).max() <= 0.0511
        assert (np.abs(kept.dequantize() - many).max() < 1e-6) == exact
        sizes.append(len(kept.offsets))
    assert sizes[0] < sizes[1] < sizes[2]
    assert Block.quantize(many[:-3], True, 4).square == 1, "no square texture"


OBJECTS: dict[str, dict[str, Any]] = {
    "log": {"$schema": str, "version!": ["2.1.0"], "runs!": ["run*"]},
    "run": {"tool!": "tool", "invocations": ["invocation*"], "results": ["result*"]},
    "tool": {"driver!": "driver"},
    "driver": {"name!": str, "version": str, "rules": ["rule*"]},
    "rule": {"id!": str, "shortDescription": "text", "defaultConfiguration": "configuration"},
    "configuration": {"level": ["none", "note", "warning", "error"]},
    "text": {"text!": str},
    "invocation": {"executionSuccessful!": bool, "commandLine": str},
    "result": {
        "ruleId": str, "ruleIndex": int, "level": ["none", "note", "warning", "error"], "message!": "text",
        "locations": ["location*"], "partialFingerprints": dict, "properties": dict,
        "baselineState": ["new", "unchanged", "updated", "absent"],
    },
    "location": {"physicalLocation": "physical"},
    "physical": {"artifactLocation!": "artifact", "region": "region"},
    "artifact": {"uri": str},
    "region": {"startLine!": int},
}  # fmt: skip
"""The objects of SARIF 2.1.0 that are written, as section 3 of the standard has them: their properties, "!" for one
that has to be there; a type, an object, a list of objects ("*"), or the values that are allowed."""


def check_sarif(value: Any, name: str = "log") -> None:
    """Fail where an object breaks a rule of the standard."""
    assert isinstance(value, dict), name
    rules = {key.rstrip("!"): rule for key, rule in OBJECTS[name].items()}
    assert set(value) <= set(rules), f"{name}: {set(value) - set(rules)}"
    assert {key[:-1] for key in OBJECTS[name] if key.endswith("!")} <= set(value), name
    for key, one in value.items():
        rule = rules[key]
        if isinstance(rule, type):
            assert type(one) is rule, f"{name}.{key}"
        elif isinstance(rule, str):
            check_sarif(one, rule)
        elif rule[0].endswith("*"):
            assert isinstance(one, list), f"{name}.{key}"
            for part in one:
                check_sarif(part, rule[0][:-1])
        else:
            assert one in rule, f"{name}.{key}: {one}"
    if name == "result":
        assert all(isinstance(one, str) for one in value["partialFingerprints"].values())
    if name == "region":
        assert value["startLine"] >= 1
    if name == "artifact":  # a reference by RFC 3986: no blanks, and what is no letter of a URI is escaped
        assert re.fullmatch(r"[\w.~!$&'()*+,;=:@%/?#-]*", value["uri"], re.ASCII), value["uri"]


def test_sarif_obeys_the_standard_whatever_a_suite_is_called(tested: tuple[SuiteResult, Path]) -> None:
    result, _ = tested
    for suite in (result.suite, "my suites/größe #1.yaml"):
        check_sarif(json.loads(words.format_sarif(result.model_copy(update={"suite": suite}))))
    log = json.loads(words.format_sarif(result))
    for broken in (
        {**log, "version": "2.0.0"},
        {**log, "runs": [{**log["runs"][0], "tool": {}}]},
        {**log, "runs": [{**log["runs"][0], "results": [{"ruleId": "right"}]}]},
        {**log, "made": "today"},
    ):
        with pytest.raises(AssertionError):
            check_sarif(broken)


# ---- for machines ---------------------------------------------------------------------------------------------------


@pytest.mark.medium
def test_the_command_writes_what_machines_read_and_its_status_is_the_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    suite = written(tmp_path, {name: CLAIMS[name] for name in ("behind", "too-few")})
    files = ["--junit", "out.xml", "--sarif", "out.sarif", "--markdown", "out.md"]
    assert main(["test", suite, "--code", EASY, *files, "--json", "--quiet"]) == 1
    said = json.loads(capsys.readouterr().out)
    assert [one["answer"] for one in said["claims"]] == ["failed", "undecided"] and said["command"] == "test"
    root = ElementTree.parse("out.xml").getroot()
    cases = {one.get("name"): one for one in root.iter("testcase")}
    assert root.get("tests") == "2" and root.get("failures") == root.get("errors") == "1"
    failure = cases["behind"].find("failure")
    assert failure is not None and "images/behind.png" in str(failure.text) and "only=behind" in str(failure.text)
    log = json.loads(Path("out.sarif").read_text())
    (run,) = log["runs"]
    assert log["version"] == "2.1.0" and [one["level"] for one in run["results"]] == ["error", "warning"]
    for one in run["results"]:
        assert run["tool"]["driver"]["rules"][one["ruleIndex"]]["id"] == one["ruleId"]
        assert one["message"]["text"] and one["baselineState"] == "new"
        line = one["locations"][0]["physicalLocation"]["region"]["startLine"]
        assert Path(suite).read_text().splitlines()[line - 1].strip() == f"{one['partialFingerprints']['claim/v1']}:"
    text = Path("out.md").read_text()
    assert "| behind | failed |" in text and "run.yaml only=" in text
    assert main(["show", str(said["run"])]) == 0
    assert "too-few" in capsys.readouterr().out
    assert main(["test", suite, "--code", EASY, "--only", "too-few", "--quiet"]) == 2
    assert main(["test", suite, "--quiet"]) == 2, "code that a file names is not run unless it is named"
    assert "code=small_models:easy" in capsys.readouterr().err.replace("--code ", "code=")


def test_texts_of_others_stay_texts(tested: tuple[SuiteResult, Path]) -> None:
    result, _ = tested
    odd = ClaimResult(name="odd", kind="right", statement="<b>|`\x00", answer="failed", reason="a | b\n<script>")
    odd_result = result.model_copy(update={"claims": [odd], "title": "T\x07 & <x>"})
    root = ElementTree.fromstring(words.format_junit(odd_result).partition("\n")[2])
    assert root.find("testsuite") is not None and root[0].get("name") == "T? & <x>"
    assert "| odd | failed |  | a \\| b \\<script\\> |" in words.format_markdown(odd_result)
    assert json.loads(words.format_sarif(odd_result))["runs"][0]["results"][0]["ruleId"] == "right"


# ---- bad suites -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"claims": {}}, r"claims: expected names with a claim each, .* got none"),
        ({"claims": {"a": {**GOOD, "at_least": 95}}}, r"claims.a.at_least: expected a share over 0 and under 1"),
        (
            {"claims": {"a": {**GOOD, "claim": "rihgt"}}},
            r"claims.a.claim: expected right, not_broken, no_worse, must_change or must_not_change, got",
        ),
        ({"claims": {"a": {"claim": "right", "atleast": 0.9}}}, r"claims.a.atleast: there is no such name"),
        ({"claims": {"a": 3}}, r"claims.a: expected a claim such as"),
        ({"claims": {"a": claim("right", {"camra": {}}, at_least=0.9)}}, r"a: unknown control 'camra'.*'camera'"),
        ({"claims": {"a": {**GOOD, "settings": {"steps": 4}}}}, r"claims.a: unknown setting 'steps'"),
        ({"claims": {"a": {"claim": "not_broken", "settings": {"minimise": True}}}}, r"minimise: expected a search"),
        ({"claims": {"a": {"claim": "not_broken", "settings": {"seed": 3}}}}, r"seed is said for the whole suite"),
        (
            {"claims": {"a": {"claim": "not_broken", "at_least": 0.9}}},
            r"a claim of this kind has no at_least",
        ),
        ({"claims": {"a": {**GOOD, "pictures": True}}}, r"a.pictures: expected a whole number .* got True"),
        (
            {"claims": {"a": claim("must_change", when="jpeg", at_least=0.9)}},
            r"a.when: expected black, .* of must_change",
        ),
        ({"claims": {"a": claim("must_not_change", at_least=0.9)}}, r"a.when: expected .*, got nothing"),
        ({"claims": {"a": {"claim": "no_worse", "points": 3}}}, r"a.than: expected another model, by its name"),
        (
            {"claims": {"a": {"claim": "not_broken", "settings": {"epsilon": [0.1, 0.2]}}}},
            r"epsilon: expected one epsilon",
        ),
        ({"claims": {1: GOOD}}, r"claims: expected names of small letters, .* got 1; put it in quotes"),
        ({"claims": {"A b": GOOD}}, r"claims: expected names of small letters"),
        ({"confidence": 95}, r"confidence: expected a number from 0.5 to 0.9999"),
        ({"claims": {"a": claim("no_worse", than="nonesuch", points=3)}}, r"claims.a: unknown model 'nonesuch'"),
    ],
)
def test_a_bad_suite_is_one_sentence_before_anything_is_rendered(
    tmp_path: Path, change: dict[str, Any], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Problem, "judge", lambda *given: pytest.fail("rendered"))
    suite = written(tmp_path, {"a": GOOD})
    Path(suite).write_text(yaml.safe_dump({**yaml.safe_load(Path(suite).read_text()), **change}))
    with pytest.raises(AdvsearchError, match=message) as caught:
        carry_out(SuiteConfig(suite=suite, run=str(tmp_path / "never")))
    assert str(caught.value).startswith(suite) and "\n" not in str(caught.value)
    assert not (tmp_path / "never").exists()


def test_a_claim_that_stands_twice_in_a_suite_is_refused(tmp_path: Path) -> None:
    suite = tmp_path / "suite.yaml"
    suite.write_text("claims:\n  a: {claim: right, at_least: 0.9}\n  a: {claim: right, at_least: 0.8}\n")
    with pytest.raises(AdvsearchError, match=r"got the name 'a' twice in line 3, column 3; correct"):
        carry_out(SuiteConfig(suite=str(suite), run=str(tmp_path / "never")))


def test_a_share_may_be_written_in_per_cent_and_an_unknown_claim_is_named(tmp_path: Path) -> None:
    suite = written(tmp_path, {"a": {**GOOD, "at_least": "50 %"}})
    assert carry_out(SuiteConfig(suite=suite, run=str(tmp_path / "run"))).status == 0
    with pytest.raises(AdvsearchError, match=r"unknown claim in `only` 'b'"):
        carry_out(SuiteConfig(suite=suite, only="b", run=str(tmp_path / "never")))


# ---- for other people's CI ------------------------------------------------------------------------------------------


@pytest.mark.medium
@pytest.mark.docs
def test_the_commands_of_the_jobs_in_the_docs_do_what_the_jobs_want(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All but what installs: on a small suite that stands where the page's does."""
    root = Path(__file__).resolve().parents[3]
    page = (root / "docs" / "testing.md").read_text("utf-8")
    github, gitlab = (
        yaml.safe_load(text) for text in re.findall(r"^```yaml\n((?:name: )?robustness:?\n.*?)^```$", page, re.M | re.S)
    )
    monkeypatch.chdir(tmp_path)
    Path("suites").mkdir()
    Path(written(tmp_path, {name: CLAIMS[name] for name in ("behind", "too-few")})).rename("suites/mug.yaml")
    program = f"{shlex.quote(sys.executable)} -c 'from advsearch.cli.main import main; raise SystemExit(main())'"
    (tmp_path / "advsearch").write_text(f'#!/bin/sh\nexec {program} "$@" --code {EASY} --quiet\n')
    (tmp_path / "advsearch").chmod(0o755)
    here = {**os.environ, "PATH": f"{tmp_path}{os.pathsep}{os.environ['PATH']}", "GITHUB_STEP_SUMMARY": "shown.md"}
    here |= {"GITHUB_OUTPUT": "outputs", "MODEL": "", "CODE": "", "ARGUMENTS": ""}
    here["PYTHONPATH"] = os.pathsep.join(path for path in sys.path if path)

    def ran(line: str) -> int:
        return subprocess.run(
            ["bash", "-ec", line], env=here, cwd=tmp_path, capture_output=True, check=False
        ).returncode

    steps = github["jobs"]["robustness"]["steps"]
    (asked,) = (one["with"] for one in steps if one.get("id") == "test")
    here["SUITE"] = asked["suite"]
    action = yaml.safe_load((root / "action.yml").read_text("utf-8"))
    (step,) = (one["run"] for one in action["runs"]["steps"] if one.get("id") == "test")
    assert ran(step) == 1, "a claim failed, and the summary is shown all the same"
    assert "| behind | failed |" in Path("shown.md").read_text("utf-8")
    uploads = {one["uses"].partition("@")[0]: one["with"] for one in steps if "with" in one and "uses" in one}
    outputs = dict(line.split("=") for line in Path("outputs").read_text("utf-8").split())
    assert uploads["github/codeql-action/upload-sarif"]["sarif_file"] == "${{ steps.test.outputs.sarif }}"
    check_sarif(json.loads(Path(outputs["sarif"]).read_text("utf-8")))
    assert len(list(Path(uploads["actions/upload-artifact"]["path"]).glob("*/report.html"))) == 1
    job = gitlab["robustness"]
    (line,) = (one for one in job["script"] if not one.startswith("pip "))
    assert ran(line) == 1 and ElementTree.parse(job["artifacts"]["reports"]["junit"]).getroot().get("failures") == "1"
    seeds = {json.loads(path.read_text("utf-8"))["seed"] for path in Path("runs").glob("*/summary.json")}
    assert len(seeds) == 2, "the night's is a fresh one"


# ---- for pytest -----------------------------------------------------------------------------------------------------


def test_a_share_of_the_frames_of_a_drive_is_claimed_as_one(tmp_path: Path) -> None:
    way = {"path": {"path": "approach", "reach": 2.0}}
    suite = written(tmp_path, {"on-the-way": claim("right", way, at_least=0.5, pictures=20)}, confidence=0.9)
    (found,) = carry_out(SuiteConfig(suite=suite, run=str(tmp_path / "run"))).claims
    assert "is right in at least 50 % of the frames that the ranges span: mug, path" in found.statement
    assert found.pictures and found.rate is not None and (found.rate == 1.0 or "path.time" in found.reason)


def always() -> advsearch.Model:
    """Says mug to everything."""
    with pytest.warns(ModelWarning, match="hardly follow the picture"):
        return advsearch.load_model(small_models.Blue(-9.0), labels=["mug", "vase"], input_size=32, name="always")


@pytest.mark.medium
def test_assertions_pass_and_fail_with_the_picture_and_what_repeats_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    easy, small = small_models.easy(), {**SMALL, "verify_spp": 2}
    assert assert_right("mug", easy, at_least=0.5, pictures=20, controls=FRONT, **small).answer == "held"
    with pytest.raises(AssertionError) as caught:
        assert_right("mug", easy, at_least=0.5, pictures=20, controls=BACK, **small)
    text = str(caught.value)
    (picture,) = (line.partition(": ")[2] for line in text.splitlines() if line.startswith("  picture"))
    assert Path(picture).is_file() and text.startswith("right: failed: right in 0 of")
    assert "again: pytest" in text and "::test_assertions_pass_and_fail" in text
    with pytest.raises(AssertionError, match=r"undecided: .*not decided after 13 pictures"):
        assert_no_worse("mug", easy, always(), points=20.0, pictures=13, controls=FRONT, **small)


@pytest.mark.medium
def test_a_search_and_a_suite_can_be_asserted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert assert_not_broken(advsearch.load_scene("mug"), always(), **SMALL, **QUICK).status == 0
    suite = written(tmp_path, {"too-few": CLAIMS["too-few"]})
    with pytest.raises(AssertionError, match=r"too-few: undecided: .*(\n.*)*again: advsearch run"):
        assert_suite(suite)


@pytest.mark.medium
@pytest.mark.docs
def test_the_pytest_file_of_the_docs_passes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every test in it, beside the suite of the same page; with fewer steps, and less to show, than on the page."""
    root = Path(__file__).resolve().parents[3]
    page = (root / "docs" / "testing.md").read_text("utf-8")
    monkeypatch.chdir(tmp_path)
    (suite,) = re.findall(r"^```yaml\n(# suite\.yaml\n.*?)^```$", page, re.M | re.S)
    Path("suite.yaml").write_text(suite.replace("at_least: 0.95", "at_least: 0.6").replace("64", "48"))
    (code,) = re.findall(r"^```python\n(# test_robustness\.py\n.*?)^```$", page, re.M | re.S)
    names: dict[str, Any] = {}
    exec(compile(code.replace("steps=20", 'steps=2, policy="random"'), "testing.md", "exec"), names)
    tests = [one for name, one in names.items() if name.startswith("test_")]
    assert len(tests) == 3
    for one in tests:
        one()
    assert len(list(Path("runs").iterdir())) == 3, "each keeps its run"


@pytest.mark.medium
def test_a_suite_at_work_is_running(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said: list[str] = []

    class Watching(NullProgress):
        def message(self, text: str) -> None:
            if text.startswith("no-worse:"):  # the summary of the first claim is there, which a kill would leave
                said.extend([read_listed_run(tmp_path / "run").state, make_progress_page("run", tmp_path / "run")])
                assert main(["show", str(tmp_path / "run")]) == 0
                said.append(capsys.readouterr().out)

    config = SuiteConfig(suite=written(tmp_path, CLAIMS), only="in-front,no-worse,too-few", run=str(tmp_path / "run"))
    carry_out(config, progress=Watching())
    state, page, shown = said
    assert state == "running" and "A process is working on it." in page
    assert "Running, so far: 1 held, 2 undecided" in shown and "not tried yet" in shown
    assert "nterrupted" not in shown and "Go on with" not in shown
    assert main(["show", str(tmp_path / "run")]) == 0 and "unning" not in capsys.readouterr().out
