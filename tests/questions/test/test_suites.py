"""`advsearch test`: claims, their answers, what machines read of them, and answers of runs that become tests."""

import base64
import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import torch
import yaml
from torch import Tensor

import advsearch
import small_models
from advsearch.api import workbench
from advsearch.cli.main import main
from advsearch.cluster import InProcess
from advsearch.engine.problem import Problem
from advsearch.errors import AdvsearchError
from advsearch.models.model import ModelWarning
from advsearch.questions.attack.run import attack_once
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.sweep.settings import BLIND, HARMLESS
from advsearch.questions.test import result as words
from advsearch.questions.test.counterexamples import counterexample_directory, decide_trials
from advsearch.questions.test.result import ClaimResult, SuiteResult
from advsearch.questions.test.settings import SuiteConfig
from advsearch.registry import get_experiment
from advsearch.runs.store import Store
from advsearch.runs.summary import read_result
from advsearch.testing import assert_no_worse, assert_right

pytestmark = pytest.mark.island("advsearch.questions.test")

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


@pytest.mark.medium
def test_every_claim_is_held_failed_or_undecided_and_stops_when_it_is(tested: tuple[SuiteResult, Path]) -> None:
    result, folder = tested
    found = {one.name: one for one in result.claims}
    answers = {name: one.verdict for name, one in found.items()}
    assert answers == {"in-front": "held", "behind": "failed", "too-few": "undecided", "no-worse": "held"}
    assert (result.verdict, result.status, result.outcome_summary) == ("failed", 1, "2 held, 1 failed, 1 undecided")
    assert 6 <= found["in-front"].pictures < 20 and found["in-front"].interval[0] >= 0.5  # type: ignore[index]
    assert found["behind"].rate == 0.0 and "right in 0 of" in found["behind"].reason
    picture = advsearch.load_run(folder / "run").run  # type: ignore[union-attr]
    assert picture == str(folder / "run") and (folder / "run" / str(found["behind"].picture)).is_file()
    with Store(folder / "run" / "results.sqlite", read_only=True) as store:
        counts = store.count_by_kind()
    assert counts["claim in-front"] == found["in-front"].pictures and counts["claim too-few"] == 9
    assert counts["claim no-worse"] == counts["claim no-worse beside"] == found["no-worse"].pictures
    assert read_result(folder / "run") == result


@pytest.mark.parametrize(
    ("asked", "needed"), [(claim("right", at_least=0.99), 426), (claim("no_worse", than=HARD, points=5, pictures=6), 7)]
)
def test_a_claim_that_its_pictures_cannot_decide_is_refused_before_any_is_made(
    asked: dict[str, Any], needed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Problem, "picture", lambda *given, **more: pytest.fail("rendered"))
    with pytest.raises(AdvsearchError, match=rf"claims\.it\.pictures: expected at least {needed}, .* got "):
        carry_out(SuiteConfig(suite=written(tmp_path, {"it": asked}), run=str(tmp_path / "run")))


@pytest.mark.medium
def test_a_search_fails_a_claim_by_a_verified_counterexample_and_never_calls_it_safe(tmp_path: Path) -> None:
    claims = {
        "little": {"claim": "not_broken", "settings": {**QUICK, "controls": {"camera": {"azimuth": [-20, 20]}}}},
        "much": {"claim": "not_broken", "settings": {**QUICK, "controls": {"camera": {"azimuth": [0, 360]}}}},
    }
    result = carry_out(SuiteConfig(suite=written(tmp_path, claims), run=str(tmp_path / "run")))
    little, much = result.claims
    assert (little.verdict, much.verdict) == ("held", "failed")
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
    assert {one.name: one.verdict for one in result.claims} == dict.fromkeys(asked, "held")
    assert all("as claimed in" in one.reason for one in result.claims) and len(asked) == 6
    advsearch.allow_code("small_models:blind")
    blind = carry_out(SuiteConfig(suite=suite, model="small_models:blind", run=str(tmp_path / "blind")))
    answers = {one.name: one.verdict for one in blind.claims}
    assert answers == {name: "failed" if "must-change" in name else "held" for name in asked}


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
    whole = {one.name: (one.verdict, one.reason, one.interval) for one in tested[0].claims if one.name in chosen}
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
    again = carry_out(config, resumed_directory=tmp_path / "run")
    assert again.is_unfinished and [one.verdict for one in again.claims] == ["held", "undecided", "undecided"]
    done, last = 0, -1
    ended = carry_out(config, resumed_directory=tmp_path / "run")
    assert {one.name: (one.verdict, one.reason, one.interval) for one in ended.claims} == whole
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
    assert next(one for one in tested[0].claims if one.name == "in-front").verdict == "held"
    advsearch.allow_code("test_suites:planted")
    config = SuiteConfig(suite=written(tmp_path, CLAIMS), only="in-front", model="test_suites:planted")
    (one,) = carry_out(config.model_copy(update={"run": str(tmp_path / "run")})).claims
    assert one.verdict == "failed" and "most wrong where it says vase: light." in one.reason
    picture = (tmp_path / "run" / str(one.picture)).read_bytes()
    assert base64.b64encode(picture).decode() in (tmp_path / "run" / "report.html").read_text("utf-8")


@pytest.mark.medium
def test_a_counterexample_is_kept_small_tried_first_and_fails_fast(attacked: Path, tmp_path: Path) -> None:
    suite = written(tmp_path, {"too-few": CLAIMS["too-few"]})
    added = carry_out(SuiteConfig(suite=suite, add=attacked, run=str(tmp_path / "added")))
    assert added.status == 0 and added.added == str(tmp_path / "suite.counterexamples" / "found.json")
    assert sum(path.stat().st_size for path in counterexample_directory(suite).iterdir()) < 12_000
    tried = carry_out(SuiteConfig(suite=suite, run=str(tmp_path / "tried")))
    assert [(one.name, one.verdict, one.pictures) for one in tried.claims] == [
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


@pytest.mark.parametrize(
    ("right", "wrong", "over", "verdict"),
    [
        (6, 0, False, "held"), (0, 6, False, "failed"), (1, 5, False, "undecided"), (5, 15, True, "failed"),
        (0, 5, True, "undecided"), (18, 2, True, "held"), (17, 3, True, "undecided"),
    ],
)  # fmt: skip
def test_what_trials_say_of_a_counterexample(right: int, wrong: int, over: bool, verdict: str) -> None:
    assert decide_trials(right, wrong, has_conditions=over) == verdict


@pytest.mark.medium
def test_the_command_writes_what_machines_read_and_its_status_is_the_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    suite = written(tmp_path, {name: CLAIMS[name] for name in ("behind", "too-few")})
    files = ["--junit", "out.xml", "--sarif", "out.sarif", "--markdown", "out.md"]
    assert main(["test", suite, "--code", EASY, *files, "--json", "--quiet"]) == 1
    said = json.loads(capsys.readouterr().out)
    assert [one["verdict"] for one in said["claims"]] == ["failed", "undecided"] and said["command"] == "test"
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
    assert main(["test", suite, "--code", EASY, "--only", "too-few", "--quiet"]) == 2
    assert main(["test", suite, "--quiet"]) == 2, "code that a file names is not run unless it is named"
    assert "code=small_models:easy" in capsys.readouterr().err.replace("--code ", "code=")


def test_texts_of_others_stay_texts(tested: tuple[SuiteResult, Path]) -> None:
    result, _ = tested
    odd = ClaimResult(name="odd", kind="right", statement="<b>|`\x00", verdict="failed", reason="a | b\n<script>")
    odd_result = result.model_copy(update={"claims": [odd], "title": "T\x07 & <x>"})
    root = ElementTree.fromstring(words.format_junit(odd_result).partition("\n")[2])
    assert root.find("testsuite") is not None and root[0].get("name") == "T? & <x>"
    assert "| odd | failed |  | a \\| b \\<script\\> |" in words.format_markdown(odd_result)
    assert json.loads(words.format_sarif(odd_result))["runs"][0]["results"][0]["ruleId"] == "right"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"claims": {"a": {**GOOD, "at_least": 95}}}, "claims.a.at_least"),
        ({"claims": {"a": {"claim": "right", "atleast": 0.9}}}, "claims.a.atleast"),
        ({"claims": {"a": claim("right", {"camra": {}}, at_least=0.9)}}, "camra"),
        ({"claims": {"a": {"claim": "not_broken", "at_least": 0.9}}}, r"a claim of this kind has no at_least"),
        ({"claims": {"a": {"claim": "no_worse", "points": 3}}}, "a.than"),
        ({"claims": {"A b": GOOD}}, "claims: expected names"),
        ({"claims": {"a": claim("no_worse", than="nonesuch", points=3)}}, "nonesuch"),
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
    assert assert_right("mug", easy, at_least=0.5, pictures=20, controls=FRONT, **small).verdict == "held"
    with pytest.raises(AssertionError) as caught:
        assert_right("mug", easy, at_least=0.5, pictures=20, controls=BACK, **small)
    text = str(caught.value)
    (picture,) = (line.partition(": ")[2] for line in text.splitlines() if line.startswith("  picture"))
    assert Path(picture).is_file() and text.startswith("right: failed: right in 0 of")
    assert "again: pytest" in text and "::test_assertions_pass_and_fail" in text
    with pytest.raises(AssertionError, match="undecided"):
        assert_no_worse("mug", easy, always(), points=20.0, pictures=13, controls=FRONT, **small)


@pytest.mark.island("advsearch.controls.path")
def test_a_share_of_the_frames_of_a_drive_is_claimed_as_one(tmp_path: Path) -> None:
    way = {"path": {"path": "approach", "reach": 2.0}}
    suite = written(tmp_path, {"on-the-way": claim("right", way, at_least=0.5, pictures=20)}, confidence=0.9)
    (found,) = carry_out(SuiteConfig(suite=suite, run=str(tmp_path / "run"))).claims
    assert "is right in at least 50 % of the frames that the ranges span: mug, path" in found.statement
    assert found.pictures and found.rate is not None and (found.rate == 1.0 or "path.time" in found.reason)


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
