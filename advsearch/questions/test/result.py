"""The result of `test`: verdicts with reasons, and formats for other programs."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, NamedTuple
from urllib.parse import quote
from xml.etree import ElementTree

from pydantic import Field

from advsearch.extend import (
    AttackConfig,
    RunResult,
    SceneConfig,
    SweepConfig,
    __version__,
    results,
    views,
    wording,
)
from advsearch.questions.test.settings import (
    AnyClaim,
    ChangeClaim,
    NoWorseClaim,
    RightClaim,
)

if TYPE_CHECKING:
    from advsearch.extend import workbench

HELD = "held"
UNDECIDED = "undecided"
FAILED = "failed"
VERDICTS = (HELD, UNDECIDED, FAILED)  # from the best to the worst
# exit status of the command by the verdict of the suite
EXIT_STATUS = {HELD: 0, FAILED: 1, UNDECIDED: 2}


class Cause(str, Enum):
    """Why a claim is undecided, unless its images are the reason."""

    COUNTEREXAMPLE_FAILED = "counterexample failed"
    INTERRUPTED = "interrupted"
    NOT_REACHED = "not reached"
    OUT_OF_TIME = "out of time"


class ClaimResult(results.Fields):
    """The result of a claim or of a counterexample."""

    name: str = Field(
        description="name of the claim in the suite, or of a counterexample's file"
    )
    kind: str = Field(
        description="`right`, `not_broken`, `no_worse`, `must_change`, "
        "`must_not_change` or `counterexample`"
    )
    statement: str = Field(description="what is claimed, in words")
    verdict: str = Field(description="`held`, `failed` or `undecided`")
    reason: str = Field(description="reason of the verdict, with numbers")
    expected: str = Field(
        HELD,
        description="expected verdict, stored by the last `update`; absent for `held`",
    )
    pictures: int = Field(
        0, description="number of images of the test; absent if there are none"
    )
    rate: results.JsonFloat | None = results.optional_field(
        "fraction of right predictions, or of images as claimed; for two models the "
        "difference of their fractions; absent for a search"
    )
    interval: results.Interval | None = results.optional_field(
        "interval of `rate`: each bound is valid at all sample sizes at once, at the "
        "suite's confidence; for a counterexample, the 95 % interval of Clopper and "
        "Pearson"
    )
    spp: int | None = results.optional_field(
        "samples per pixel of the images; absent for a search"
    )
    picture: str | None = results.optional_field(
        "an image that the model gets wrong: a file in the run's folder"
    )
    part: str | None = results.optional_field(
        "name of the search among the runs in `parts`; absent if there is no search"
    )
    repeat: str = Field(
        "", description="command that repeats the test; absent if there is none"
    )
    seconds: results.JsonFloat = Field(0.0, description="duration of the test")
    cause: Cause | None = results.optional_field(
        "why the claim is undecided: `counterexample failed`, `interrupted`, `not "
        "reached` or `out of time`; absent in all other cases"
    )

    @property
    def accepted(self) -> bool:
        """Whether the verdict is at least as good as expected."""
        return VERDICTS.index(self.verdict) <= VERDICTS.index(self.expected)


class SuiteResult(views.InNotebook, RunResult):
    """The results of the claims of a suite."""

    command: ClassVar[str] = "test"

    suite: str = Field(description="path of the suite's file")
    title: str = Field(description="title of the suite")
    object: str = Field(description="objects of all claims, separated by commas")
    model: str = Field(description="the model that the claims are about")
    verdict: str = Field(
        description="`failed` if a claim is unexpectedly failed, else `undecided` if a "
        "claim is unexpectedly undecided, else `held`"
    )
    confidence: float = Field(
        description="confidence of each claim that sampled images decide"
    )
    claims: list[ClaimResult]
    added: str | None = results.optional_field(
        "file of the counterexample that was added; only with `add`"
    )
    changes: list[str] = Field(
        [], description="changes of expected verdicts; only with `update`"
    )
    warnings: list[str] = Field(description="sentences that a reader has to know")

    @property
    def outcome_summary(self) -> str:
        """The number of claims by verdict: ``3 held, 1 failed``."""
        answers = [claim.verdict for claim in self.claims]
        texts = []
        for name in (HELD, FAILED, UNDECIDED):
            if name in answers:
                texts.append(f"{answers.count(name)} {name}")
        return ", ".join(texts)

    @property
    def status(self) -> int:
        """The exit status of the command."""
        return 0 if self.added is not None else EXIT_STATUS[self.verdict]


def combine_verdicts(claims: list[ClaimResult]) -> str:
    """Return the worst verdict among claims that are worse than expected, else HELD."""
    return max(
        (claim.verdict for claim in claims if not claim.accepted),
        key=VERDICTS.index,
        default=HELD,
    )


TABLE_HEADS = ("claim", "verdict", "pictures", "why")

READING_NOTE = (
    "The verdicts held and failed have the stated confidence. They are decided by one "
    "bound of an interval, which is valid at all sample sizes at once. A search that "
    "finds nothing is no proof."
)

OUT_OF_TIME_REASON = "the time of the suite was over"
INTERRUPTED_REASON = "it was interrupted"
NOT_TESTED = "not tested, since a counterexample failed"
NOT_TESTED_YET = "not tested yet"


def make_view(result: SuiteResult) -> views.ShownResult:
    """Lay out a result for the terminal and the page.

    First comes a table of all claims, then a section for each claim that is not held,
    with its picture and the command that repeats it.
    """
    sections = [_make_claims_part(result)]
    for claim in result.claims:
        # There is no section for a claim that is held, nor for one that was not tested.
        was_not_tested = claim.cause is Cause.COUNTEREXAMPLE_FAILED
        if claim.verdict != HELD and not was_not_tested:
            sections.append(_make_claim_section(claim))
    sections.append(views.ResultPart("Expected from now on", result.changes))
    subject = [Path(result.suite).name, result.object, result.model]
    summary = f"{result.title}. {describe_suite(result)}"
    return views.ShownResult(summary, sections, list_facts(result), subject)


def _make_claims_part(result: SuiteResult) -> views.ResultPart:
    """Make the table of all claims."""
    return views.ResultPart(
        "The claims",
        column_heads=TABLE_HEADS,
        rows=make_table_rows(result),
        note=READING_NOTE,
        parts=[claim.part for claim in result.claims],
    )


def _make_claim_section(claim: ClaimResult) -> views.ResultPart:
    """Make the section of a claim: its picture, and the command that repeats it."""
    pictures = []
    if claim.picture:
        caption = f"{claim.statement}: {claim.verdict}. {claim.reason}."
        pictures.append([views.Picture(claim.picture, caption)])
    rows = [["repeat", claim.repeat]]
    return views.ResultPart(claim.name, rows=rows, pictures=pictures)


def describe_claim(claim: AnyClaim, config: SceneConfig) -> str:
    """Describe what is claimed in a sentence.

    Args:
        claim: the claim.
        config: settings that it is tested with.
    """
    model = wording.shorten_name(config.model)
    subject = f"{wording.shorten_name(config.object)}, {', '.join(config.controls)}"
    if isinstance(claim, RightClaim):
        pictures = "the frames" if "path" in config.controls else "the pictures"
        return (
            f"{model} is right in at least {wording.percent(claim.at_least)} of "
            f"{pictures} that the ranges span: {subject}"
        )
    if isinstance(claim, ChangeClaim):
        return f"{model} says {_describe_expected_change(claim)}: {subject}"
    if isinstance(claim, NoWorseClaim):
        comparison = _describe_expected_difference(claim)
        return f"{model} is right {comparison} on the same pictures of {subject}"
    budget = _describe_epsilon(config)
    return f"no search finds a picture that {model} gets wrong: {subject}{budget}"


def _describe_expected_difference(claim: NoWorseClaim) -> str:
    """Describe by how much a model may be right less often than another one."""
    points = f"{wording.format_number(claim.points)} points"
    return f"at most {points} less often than {wording.shorten_name(claim.than)}"


def _describe_expected_change(claim: ChangeClaim) -> str:
    """Describe what a model has to say under a change, and in how many pictures."""
    answer = "the same"
    if claim.claim == "must_change":
        answer = "something else"
    changes = {**SweepConfig.blind_changes, **SweepConfig.harmless_changes}
    return (
        f"{answer} when {changes[claim.when]}, in at least "
        f"{wording.percent(claim.at_least)} of pictures"
    )


def _describe_epsilon(config: SceneConfig) -> str:
    """Return the budget of a search, to end a sentence; empty without one."""
    epsilon = getattr(config, "epsilon", None)
    if isinstance(epsilon, float):
        return f" within {wording.format_number(epsilon)}"
    # several budgets are a text with commas
    return "" if epsilon is None else f" within {epsilon}"


def describe_fraction(
    claimed: str,
    verdict: str,
    n_right: int,
    n_pictures: int,
    interval: tuple[float, float],
    worst: str,
    outcomes: str = "",
) -> str:
    """Describe why a claim about a fraction is held, failed or undecided.

    Args:
        claimed: what is claimed about a picture, "right" or "as claimed".
        verdict: HELD, FAILED or UNDECIDED.
        n_right: number of pictures for which it is true.
        n_pictures: number of all pictures.
        interval: bounds of the fraction, from a confidence sequence: they are valid at
            all sample sizes at once.
        worst: text about the image that contradicts the claim most; empty if none does.
        outcomes: the outcomes of a detector in the other images, or empty.
    """
    reason = "no picture"
    if n_pictures:
        interval_text = wording.format_interval(interval)
        reason = f"{claimed} in {n_right} of {n_pictures} (interval {interval_text})"
    if outcomes:
        reason += f"; {outcomes}"
    if verdict == UNDECIDED:
        reason += f"; not decided after {wording.format_count(n_pictures, 'picture')}"
    if worst:
        reason += f"; {worst}"
    return reason


def describe_difference(
    verdict: str,
    *,
    n_pictures: int,
    n_only_this: int,
    n_only_other: int,
    interval: tuple[float, float],
    other_model: str,
) -> str:
    """Describe the images that decide a claim about two models, or do not decide it.

    Args:
        verdict: HELD, FAILED or UNDECIDED.
        n_pictures: number of all pictures.
        n_only_this: pictures in which only the model under test is right.
        n_only_other: pictures in which only the other one is.
        interval: bounds of the difference (fraction right of the model under test minus
            that of the other), in [-1, 1].
        other_model: the other model.
    """
    if not n_pictures:
        return "no picture"
    pictures = wording.format_count(n_pictures, "picture")
    # percentage points, as the difference is
    bounds = " to ".join(f"{100.0 * bound:+.1f}" for bound in interval)
    points = 100.0 * (n_only_this - n_only_other) / n_pictures
    reason = (
        f"of {pictures} it alone is right in {n_only_this}, "
        f"{wording.shorten_name(other_model)} alone in {n_only_other} "
        f"(difference {points:+.1f} points, interval {bounds})"
    )
    if verdict == UNDECIDED:
        reason += f"; not decided after {pictures}"
    return reason


class SearchVerdict(NamedTuple):
    """What a search shows about the claim that no search breaks a model.

    Attributes:
        verdict: HELD, FAILED or UNDECIDED.
        reason: the reason in words.
        cause: why it is undecided, if the search is not finished.
    """

    verdict: str
    reason: str
    cause: Cause | None = None


def evaluate_search(
    summary: workbench.AttackSummary, config: AttackConfig
) -> SearchVerdict:
    """Return the verdict of a search on the claim that no search breaks a model.

    The claim is failed if the model is already wrong on the clean scene, or if a wrong
    prediction is verified. It is undecided if the scene that was found is wrong only in
    some trials, or if the search is not finished. Otherwise it is held.

    Args:
        summary: summary of the search.
        config: settings of the search; `steps` is the planned number of steps. If the
            time ended the search, fewer steps were made.
    """
    verified = summary.verified
    if summary.ending == "already wrong":
        return SearchVerdict(FAILED, _describe_wrong_clean(summary))
    # The status "found" means that the scene was verified.
    if summary.ending == "found" and verified is not None:
        return SearchVerdict(FAILED, _describe_verified(summary.task, verified))
    if summary.is_unfinished:
        return SearchVerdict(UNDECIDED, INTERRUPTED_REASON, Cause.INTERRUPTED)
    if verified is not None and verified.successes:
        reason = (
            f"the scene that it found is wrong in {verified.successes} of "
            f"{verified.trials} trials: it depends on the noise"
        )
        return SearchVerdict(UNDECIDED, reason)
    if _was_cut_short(summary, config):
        reason = f"{OUT_OF_TIME_REASON} after {summary.steps} of {config.steps} steps"
        return SearchVerdict(UNDECIDED, reason, Cause.OUT_OF_TIME)
    return SearchVerdict(HELD, _describe_unbroken(summary))


def _was_cut_short(summary: workbench.AttackSummary, config: AttackConfig) -> bool:
    """Return whether a time limit ended a search before it made all of its steps."""
    # Without a time limit, a search that makes fewer steps has ended by itself.
    if config.seconds is None or config.steps is None:
        return False
    return summary.steps < config.steps


def _describe_verified(task: str, verified: results.VerifiedRate) -> str:
    """Describe that a search has found a verified counterexample."""
    prediction = describe_wrong_prediction(task, verified)
    interval = wording.format_interval(verified.interval)
    return (
        f"a verified counterexample: wrong in {verified.successes} of "
        f"{verified.trials} trials (interval {interval}){prediction}"
    )


def _describe_unbroken(summary: workbench.AttackSummary) -> str:
    """Describe that a search has found nothing, and how long it was."""
    # The baseline is a random search with as many renders.
    baseline = "" if summary.baseline is None else ", nor by as many random renders"
    steps = wording.format_count(summary.steps, "step")
    return f"not broken by {steps} of {summary.policy}{baseline}; this is no proof"


def _describe_wrong_clean(summary: workbench.AttackSummary) -> str:
    """Describe that the model is already wrong on the clean scene."""
    reason = "wrong on the clean scene already"
    # Trials of the clean scene are the control group of the verification.
    clean_trials = summary.clean.control
    if clean_trials is None:
        return reason
    reason += f": right in {clean_trials.correct} of {clean_trials.trials} trials"
    if clean_trials.outcomes:
        outcomes = wording.format_outcomes(clean_trials.outcomes, summary.task)
        reason += f", {outcomes}"
    return reason


def describe_wrong_prediction(task: str, verified: results.VerifiedRate) -> str:
    """Return the most frequent wrong prediction, as the end of a sentence.

    For a detector, return the counts of its outcomes.
    """
    if verified.outcomes:  # only a detector has these
        return f": {wording.format_outcomes(verified.outcomes, task)}"
    # `labels` maps wrong predictions to their counts, the most frequent one first.
    label = next(iter(verified.labels), "")
    return f", most often {wording.add_article(label)}" if label else ""


def describe_unsuitable(error: str) -> str:
    """Describe that a counterexample's settings do not suit the model."""
    return f"its own settings do not suit this model: {error}"


def describe_trials(
    verdict: str,
    *,
    n_right: int,
    n_wrong: int,
    n_uncounted: int,
    label: str,
    interval: tuple[float, float] | None,
    has_conditions: bool,
    outcomes: str = "",
) -> str:
    """Describe why a counterexample is held, failed or undecided.

    Args:
        verdict: HELD, FAILED or UNDECIDED.
        n_right, n_wrong: trials in which the model is right, and in which it is wrong.
        n_uncounted: trials that do not count, because the object is not visible or, if
            conditions vary, the clean scene is predicted wrong.
        label: the first wrong prediction.
        interval: interval of the fraction of right trials; None if no trial counts.
        has_conditions: whether conditions vary.
        outcomes: the outcomes of a detector in the wrong trials, or empty.
    """
    if interval is None:
        return _describe_uncounted(n_uncounted, has_conditions=has_conditions)
    trials = (
        "conditions in which the clean scene is right" if has_conditions else "trials"
    )
    if not n_wrong:
        interval_text = wording.format_interval(interval)
        reason = f"right in {n_right} of {n_right} {trials} (interval {interval_text})"
    else:
        total = f"{n_right + n_wrong} {trials}"
        reason = _describe_wrong_trials(n_wrong, total, interval)
        reason += f": {outcomes}" if outcomes else f", {wording.add_article(label)}"
    if verdict == UNDECIDED and n_right and n_wrong:
        cause = "conditions" if has_conditions else "noise"
        reason += f": it depends on the {cause}"
    if n_uncounted:
        reason += _describe_further_uncounted(
            n_uncounted, has_conditions=has_conditions
        )
    return reason


def _describe_wrong_trials(
    n_wrong: int, total: str, interval: tuple[float, float]
) -> str:
    """Describe in how many trials the model is wrong.

    Args:
        n_wrong: number of these trials.
        total: number of all trials, with what they are.
        interval: interval of the fraction of right trials.
    """
    lower, upper = interval
    interval_text = wording.format_interval((1.0 - upper, 1.0 - lower))
    return f"wrong in {n_wrong} of {total} (interval {interval_text})"


def _describe_further_uncounted(n_uncounted: int, *, has_conditions: bool) -> str:
    """Describe how many trials do not count in addition to others, to end a sentence."""
    why = "the object is not to be seen"
    if has_conditions:
        why = "the clean scene is wrong, or the object not to be seen"
    return f"; {n_uncounted} more are not counted, as {why}"


def _describe_uncounted(n_uncounted: int, *, has_conditions: bool) -> str:
    """Describe why a counterexample is undecided if no trial counts.

    Args:
        n_uncounted: number of trials; if it is 0, the time was over before the first.
        has_conditions: whether conditions vary.
    """
    if not n_uncounted:
        return OUT_OF_TIME_REASON
    if not has_conditions:
        return "nothing of the object is to be seen"
    return (
        f"none of {n_uncounted} conditions counts: the clean scene is wrong, "
        "or the object not to be seen"
    )


def make_table_rows(result: SuiteResult) -> list[list[str]]:
    """Return the rows of the table of claims."""
    rows = []
    for claim in result.claims:
        verdict = claim.verdict
        if claim.expected != HELD:
            if claim.verdict == claim.expected:
                verdict += " (as expected)"
            else:
                verdict += f" (expected: {claim.expected})"
        n_pictures = str(claim.pictures or "")  # an empty cell if there are none
        rows.append([claim.name, verdict, n_pictures, claim.reason])
    return rows


def describe_suite(result: SuiteResult) -> str:
    """Describe the result of a suite in a sentence."""
    if result.added is not None:
        # A counterexample was added, and nothing else was tested.
        return f"Stored as {result.added}."
    # A verdict that is not worse than the expected one is accepted.
    n_expected = sum(
        claim.verdict != HELD and claim.accepted for claim in result.claims
    )
    expected = f", {n_expected} of them as expected" if n_expected else ""
    beginnings = {
        results.RUNNING: "Running, so far",
        results.INTERRUPTED: "Stopped, so far",
    }
    beginning = beginnings.get(result.ending, result.verdict.capitalize())
    return f"{beginning}: {result.outcome_summary or 'no claims'}{expected}."


def list_facts(result: SuiteResult) -> dict[str, str]:
    """Return facts of a run of `test` by name."""
    return {
        "model": result.model,
        "confidence": f"{wording.percent(result.confidence)} for each claim that "
        "pictures decide",
        "pictures": str(sum(claim.pictures for claim in result.claims)),
        "seed": str(result.seed),
        "time": wording.format_seconds(result.seconds["total"]),
    }


def list_claims(result: SuiteResult) -> Iterator[views.Claim]:
    """Yield the result of each claim, for `advsearch report`."""
    for tested in result.claims:
        text = (
            f"{tested.name}: that {tested.statement} is {tested.verdict}: "
            f"{tested.reason}."
        )
        kind = _find_claim_kind(tested)
        if kind == "measured":
            confidence = wording.percent(result.confidence)
            text += (
                f" Each bound of the interval is a confidence sequence at {confidence} "
                "and not a bound of Clopper and Pearson."
            )
        yield views.Claim(kind=kind, statement=text, extent=None)


def _find_claim_kind(tested: ClaimResult) -> str:
    """Return what kind of claim a tested claim is in a report."""
    if tested.verdict == UNDECIDED:
        return "nothing claimed"
    if tested.kind in ("not_broken", "counterexample"):
        return "found" if tested.verdict == FAILED else "not found"
    return "measured"


SARIF_SCHEMA = "https://docs.oasis-open.org/sarif/sarif/v2.1.0/errata01/os/schemas/sarif-schema-2.1.0.json"

KIND_DESCRIPTIONS = {
    "right": "The model is right in at least a fraction of the images in the ranges of "
    "some controls.",
    "not_broken": "No search finds a configuration within a budget that the model gets "
    "wrong.",
    "no_worse": "The model is right less often than another one by at most some "
    "percentage points, on the same images.",
    "must_change": "The prediction changes if the object is not visible any more.",
    "must_not_change": "The prediction stays the same under a change that does not "
    "alter the object.",
    "counterexample": "The model is right on the adversarial scene of an earlier "
    "search.",
}
"""What a claim of each kind states. The kinds are the rules in SARIF."""


def format_junit(result: SuiteResult) -> str:
    """Return JUnit XML with a test case for each claim.

    Failed claims are failures, and undecided claims are errors. Claims that are failed
    or undecided as expected count as skipped, so that they do not break a build.
    """
    attributes = _count_test_cases(result)
    root = ElementTree.Element("testsuites", {"name": "advsearch", **attributes})
    suite = ElementTree.SubElement(
        root, "testsuite", {"name": _escape_xml(result.title), **attributes}
    )
    properties = ElementTree.SubElement(suite, "properties")
    for name, value in {**list_facts(result), "run": result.run or ""}.items():
        ElementTree.SubElement(
            properties, "property", {"name": name, "value": _escape_xml(value)}
        )
    for claim in result.claims:
        _add_test_case(suite, result, claim)
    ElementTree.indent(root)
    xml = ElementTree.tostring(root, encoding="unicode")
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{xml}\n'


def _count_test_cases(result: SuiteResult) -> dict[str, str]:
    """Return the counts and the time of a suite, as attributes of JUnit."""
    verdicts = [(claim.verdict, claim.accepted) for claim in result.claims]
    n_skipped = sum(accepted and verdict != HELD for verdict, accepted in verdicts)
    return {
        "tests": str(len(verdicts)),
        "failures": str(verdicts.count((FAILED, False))),
        "errors": str(verdicts.count((UNDECIDED, False))),
        "skipped": str(n_skipped),
        "time": f"{result.seconds['total']:.3f}",
    }


def _add_test_case(
    suite: ElementTree.Element, result: SuiteResult, claim: ClaimResult
) -> None:
    """Add the test case of a claim to a test suite of JUnit.

    Args:
        suite: element of the test suite, to which the test case is added.
        result: result of the full suite.
        claim: result of the claim.
    """
    attributes = {
        "name": claim.name,
        "classname": _escape_xml(f"{result.title}.{claim.kind}"),
        "time": f"{claim.seconds:.3f}",
    }
    case = ElementTree.SubElement(suite, "testcase", attributes)
    if claim.verdict == HELD:
        output = ElementTree.SubElement(case, "system-out")
        output.text = _escape_xml(f"{claim.statement}\n{claim.reason}")
    else:
        _add_outcome(case, result, claim)


def _add_outcome(
    case: ElementTree.Element, result: SuiteResult, claim: ClaimResult
) -> None:
    """Add to a test case of JUnit that its claim is not held, and why.

    Args:
        case: element of the test case.
        result: result of the full suite.
        claim: result of the claim.
    """
    # An undecided claim is an "error".
    tag = "failure" if claim.verdict == FAILED else "error"
    if claim.accepted:  # its verdict is as expected
        tag = "skipped"
    message = _escape_xml(f"{claim.verdict}: {claim.reason}")
    outcome = ElementTree.SubElement(case, tag, {"message": message})
    if tag != "skipped":
        outcome.set("type", claim.verdict)
    lines = [claim.statement, _picture_path(result, claim), claim.repeat]
    outcome.text = _escape_xml("\n".join(filter(None, lines)))


def format_sarif(result: SuiteResult) -> str:
    """Return SARIF 2.1.0 with a result for each claim that is not held.

    SARIF (OASIS 2020) is a JSON format for findings of analyses, which code hosts
    display. Each kind of claims is a rule, and locations are lines of the suite's file.
    Results that are as expected have the state `unchanged`, all others `new`.
    """
    kinds = list(dict.fromkeys(claim.kind for claim in result.claims))
    suite_lines = _read_suite_lines(result)
    sarif_results = [
        _sarif_result(result, claim, kinds.index(claim.kind), suite_lines)
        for claim in result.claims
        if claim.verdict != HELD
    ]
    rules = [_make_sarif_rule(kind) for kind in kinds]
    driver = {"name": "advsearch", "version": __version__, "rules": rules}
    run = {
        "tool": {"driver": driver},
        "invocations": [_make_sarif_invocation(result)],
        "results": sarif_results,
    }
    log = {"$schema": SARIF_SCHEMA, "version": "2.1.0", "runs": [run]}
    return json.dumps(log, indent=2, ensure_ascii=False) + "\n"


def _make_sarif_invocation(result: SuiteResult) -> dict[str, object]:
    """Return what SARIF states about the run: its command, and whether it has ended."""
    return {
        "executionSuccessful": not result.is_unfinished,
        "commandLine": result.command_line or "",
    }


def _read_suite_lines(result: SuiteResult) -> list[str]:
    """Return the lines of the suite's file; none if it does not exist any more."""
    path = Path(result.suite)
    return path.read_text("utf-8").splitlines() if path.is_file() else []


def _make_sarif_rule(kind: str) -> dict[str, object]:
    """Return the SARIF rule of a kind of claims."""
    return {
        "id": kind,
        "shortDescription": {"text": KIND_DESCRIPTIONS[kind]},
        "defaultConfiguration": {"level": "error"},
    }


def _sarif_result(
    result: SuiteResult, claim: ClaimResult, rule_index: int, suite_lines: Sequence[str]
) -> dict[str, object]:
    """Return the SARIF result of a claim.

    Args:
        result: result of the full suite.
        claim: result of the claim, which is not held.
        rule_index: index of the claim's kind in the list of rules.
        suite_lines: lines of the suite's file, for the location.
    """
    message = (
        f"{claim.name}: {claim.verdict}: {claim.reason}. Claimed: {claim.statement}."
    )
    location = {
        "artifactLocation": {"uri": quote(result.suite)},
        "region": {"startLine": _find_line(claim.name, suite_lines)},
    }
    properties = {
        "picture": _picture_path(result, claim),
        "repeat": claim.repeat,
        "pictures": claim.pictures,
    }
    return {
        "ruleId": claim.kind,
        "ruleIndex": rule_index,
        "level": "error" if claim.verdict == FAILED else "warning",
        "message": {"text": message},
        "locations": [{"physicalLocation": location}],
        # A fingerprint identifies the same finding in the next run.
        "partialFingerprints": {"claim/v1": claim.name},
        "baselineState": "unchanged" if claim.accepted else "new",
        "properties": {name: value for name, value in properties.items() if value},
    }


def _find_line(name: str, suite_lines: Sequence[str]) -> int:
    """Return the line of the suite's file in which a claim begins, else the first."""
    beginning = re.compile(rf"\s+{re.escape(name)}\s*:")
    for number, line in enumerate(suite_lines, start=1):
        if beginning.match(line):
            return number
    return 1


def format_markdown(result: SuiteResult) -> str:
    """Return a Markdown table of the claims.

    It is followed by the commands that repeat the claims that are not held.
    """
    fact_texts = [
        f"{name} {_escape_markdown(value)}"
        for name, value in list_facts(result).items()
    ]
    lines = [
        f"### {_escape_markdown(result.title)}",
        "",
        _escape_markdown(describe_suite(result)),
        "",
        *_format_claim_table(result),
        "",
        ", ".join(fact_texts),
    ]
    commands = _list_repeating_commands(result.claims)
    if commands:
        lines += ["", "```sh", *commands, "```"]
    return "\n".join(lines) + "\n"


def _list_repeating_commands(claims: Sequence[ClaimResult]) -> list[str]:
    """Return the commands that repeat the claims that are not held."""
    return [claim.repeat for claim in claims if claim.verdict != HELD and claim.repeat]


def _format_claim_table(result: SuiteResult) -> list[str]:
    """Return the lines of a Markdown table of the claims."""
    rule = ["---"] * len(TABLE_HEADS)  # the line that Markdown has under heads
    rows = (TABLE_HEADS, rule, *make_table_rows(result))
    return [_format_row(row) for row in rows]


def _picture_path(result: SuiteResult, claim: ClaimResult) -> str:
    """Return the path of a claim's picture; empty without one."""
    return f"{result.run}/{claim.picture}" if claim.picture else ""


def _escape_xml(text: str) -> str:
    """Replace characters that XML 1.0 does not allow."""
    return re.sub(
        r"[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]", "?", text
    )


def _escape_markdown(text: str) -> str:
    """Escape Markdown, and join lines."""
    return re.sub(r"([\\`*_{}\[\]<>#|])", r"\\\1", " ".join(text.split()))


def _format_row(cells: Sequence[str]) -> str:
    """Return a row of a Markdown table."""
    escaped = [cell if cell == "---" else _escape_markdown(cell) for cell in cells]
    return f"| {' | '.join(escaped)} |"
