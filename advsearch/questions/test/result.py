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
    ResultPart,
    RunResult,
    SceneConfig,
    ShownResult,
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
    """Why a claim is undecided other than by its pictures."""

    COUNTEREXAMPLE_FAILED = "counterexample failed"
    INTERRUPTED = "interrupted"
    NOT_REACHED = "not reached"
    OUT_OF_TIME = "out of time"


class ClaimResult(results.Fields):
    """The result of a claim or of a counterexample."""

    name: str = Field(description="in the suite; of a counterexample, its file's")
    kind: str = Field(
        description="`right`, `not_broken`, `no_worse`, `must_change`, "
        "`must_not_change` or `counterexample`"
    )
    statement: str = Field(description="what is claimed, in words")
    verdict: str = Field(description="`held`, `failed` or `undecided`")
    reason: str = Field(description="why, with the numbers")
    expected: str = Field(
        HELD, description="what it said when `update` was given last; absent for `held`"
    )
    pictures: int = Field(0, description="that it took; absent if none")
    rate: results.JsonFloat | None = results.optional_field(
        "share of right predictions, or of pictures as claimed; of two models the "
        "difference; absent of a search"
    )
    interval: results.Interval | None = results.optional_field(
        "of it: each end holds at all times together, at the suite's confidence; of a "
        "counterexample that "
        "of Clopper and Pearson, 95 %"
    )
    spp: int | None = results.optional_field(
        "samples a pixel of the pictures; absent of a search"
    )
    picture: str | None = results.optional_field(
        "a picture that the model gets wrong, in the run's folder"
    )
    part: str | None = results.optional_field(
        "the run in `parts` that has the search; absent without one"
    )
    repeat: str = Field(
        "", description="the command that repeats it; absent where there is none"
    )
    seconds: results.JsonFloat = Field(0.0, description="that it took")
    cause: Cause | None = results.optional_field(
        "`counterexample failed`, `interrupted`, `not reached` or `out of time`: why "
        "it is undecided; absent elsewhere"
    )

    @property
    def accepted(self) -> bool:
        """Whether the verdict is at least as good as expected."""
        return VERDICTS.index(self.verdict) <= VERDICTS.index(self.expected)


class SuiteResult(views.InNotebook, RunResult):
    """The results of the claims of a suite."""

    command: ClassVar[str] = "test"

    suite: str = Field(description="its file")
    title: str = Field(description="what it is about")
    object: str = Field(description="of all claims, with commas between them")
    model: str = Field(description="the model that the claims are about")
    verdict: str = Field(
        description="`failed` if a claim is that was not expected to be, else "
        "`undecided` likewise, else `held`"
    )
    confidence: float = Field(
        description="of each claim that is decided by drawn pictures"
    )
    claims: list[ClaimResult]
    added: str | None = results.optional_field(
        "the file of the counterexample that was added; only with `add`"
    )
    changes: list[str] = Field(
        [], description="what is expected from now on; only with `update`"
    )
    warnings: list[str] = Field(description="sentences that a reader has to know")

    @property
    def brief(self) -> str:
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
    "Held and failed are shown at the stated confidence, by one end of an interval, "
    "each of which holds however often "
    "it is looked at. A search that finds nothing is no proof."
)

OUT_OF_TIME_REASON = "the time of the suite was over"
INTERRUPTED_REASON = "it was interrupted"
NOT_TESTED = "not tried, since a counterexample failed"
NOT_TESTED_YET = "not tried yet"


def make_view(result: SuiteResult) -> ShownResult:
    """Lay out a result for the terminal and the page.

    First comes a table of all claims, then a section for each claim that is not held,
    with its picture and the command that repeats it.
    """
    sections = [
        ResultPart(
            "The claims",
            heads=TABLE_HEADS,
            rows=make_table_rows(result),
            note=READING_NOTE,
            parts=[claim.part for claim in result.claims],
        )
    ]
    for claim in result.claims:
        # These were not tested, so there is nothing to tell about them.
        if claim.verdict == HELD or claim.cause is Cause.COUNTEREXAMPLE_FAILED:
            continue
        pictures = []
        if claim.picture:
            caption = f"{claim.statement}: {claim.verdict}. {claim.reason}."
            pictures.append([views.Picture(claim.picture, caption)])
        rows = [["repeat", claim.repeat]]
        sections.append(ResultPart(claim.name, rows=rows, pictures=pictures))
    sections.append(ResultPart("Expected from now on", result.changes))
    subject = [Path(result.suite).name, result.object, result.model]
    summary = f"{result.title}. {describe_suite(result)}"
    return ShownResult(summary, sections, list_facts(result), subject)


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
        answer = "the same"
        if claim.claim == "must_change":
            answer = "something else"
        changes = {**SweepConfig.blind_changes, **SweepConfig.harmless_changes}
        return (
            f"{model} says {answer} when {changes[claim.when]}, in at least "
            f"{wording.percent(claim.at_least)} of pictures: {subject}"
        )
    if isinstance(claim, NoWorseClaim):
        points = f"{wording.format_number(claim.points)} points"
        other = wording.shorten_name(claim.than)
        return (
            f"{model} is right at most {points} less often than {other} "
            f"on the same pictures of {subject}"
        )
    epsilon = getattr(config, "epsilon", None)
    budget = ""
    if isinstance(epsilon, float):
        budget = f" within {wording.format_number(epsilon)}"
    elif epsilon is not None:  # several, as the text that was set
        budget = f" within {epsilon}"
    return f"no search finds a picture that {model} gets wrong: {subject}{budget}"


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
            all sample sizes together.
        worst: text about the picture that most contradicts the claim; empty if none
            does.
        outcomes: the outcomes of a detector in the other pictures, or empty.
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
    """Describe why a claim about two models is held, failed or undecided.

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
    # percentage points
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
    """What a search shows about a claim that nothing breaks a model.

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
    """Return the verdict of a search about a claim that nothing breaks a model.

    The claim fails if the clean scene is wrong already, or a wrong prediction is
    verified. It is undecided if what was found is wrong in some trials only, or the
    search is not finished; else it is held.

    Args:
        summary: summary of the search.
        config: settings of the search; `steps` is the number that was planned, which is
            more than were done if the time ended the search.
    """
    verified = summary.verified
    if summary.ending == "already wrong":
        return SearchVerdict(FAILED, _clean_reason(summary))
    if summary.ending == "found" and verified is not None:
        prediction = describe_wrong_prediction(summary.task, verified)
        interval = wording.format_interval(verified.interval)
        reason = (
            f"a verified counterexample: wrong in {verified.successes} of "
            f"{verified.trials} trials (interval {interval}){prediction}"
        )
        return SearchVerdict(FAILED, reason)
    if summary.is_unfinished:
        return SearchVerdict(UNDECIDED, INTERRUPTED_REASON, Cause.INTERRUPTED)
    if verified is not None and verified.successes:
        reason = (
            f"what it found is wrong in {verified.successes} of {verified.trials} "
            "trials, by noise"
        )
        return SearchVerdict(UNDECIDED, reason)
    max_steps = config.steps
    has_time_limit = config.seconds is not None
    if has_time_limit and max_steps is not None and summary.steps < max_steps:
        reason = f"{OUT_OF_TIME_REASON} after {summary.steps} of {max_steps} steps"
        return SearchVerdict(UNDECIDED, reason, Cause.OUT_OF_TIME)
    baseline = "" if summary.baseline is None else ", nor by as many random renders"
    steps = wording.format_count(summary.steps, "step")
    reason = f"not broken by {steps} of {summary.policy}{baseline}; this is no proof"
    return SearchVerdict(HELD, reason)


def _clean_reason(summary: workbench.AttackSummary) -> str:
    """Describe that the model is wrong on the clean scene."""
    reason = "wrong on the clean scene already"
    clean_trials = summary.clean.control
    if clean_trials is None:
        return reason
    reason += f": right in {clean_trials.correct} of {clean_trials.trials} trials"
    if clean_trials.outcomes:
        outcomes = wording.format_outcomes(clean_trials.outcomes, summary.task)
        reason += f", {outcomes}"
    return reason


def describe_wrong_prediction(task: str, verified: results.VerifiedRate) -> str:
    """Return the most frequent wrong prediction, as the end of a sentence."""
    label = next(iter(verified.labels), "")
    if verified.outcomes:
        return f": {wording.format_outcomes(verified.outcomes, task)}"
    return f", most often {wording.add_article(label)}" if label else ""


def describe_unsuitable(error: str) -> str:
    """Describe that a counterexample's settings do not suit the model."""
    return f"its own settings do not fit to this model: {error}"


def describe_trials(
    verdict: str,
    *,
    n_right: int,
    n_wrong: int,
    n_uncounted: int,
    label: str,
    interval: tuple[float, float] | None,
    over: bool,
    outcomes: str = "",
) -> str:
    """Describe why a counterexample is held, failed or undecided.

    Args:
        verdict: HELD, FAILED or UNDECIDED.
        n_right, n_wrong: trials in which the model is right, and in which it is wrong.
        n_uncounted: trials that do not count, as the object is not visible or, over
            conditions, the clean scene is predicted wrong.
        label: the first wrong prediction.
        interval: interval of the fraction of right trials; None if no trial counts.
        over: whether conditions vary.
        outcomes: the outcomes of a detector in the wrong trials, or empty.
    """
    if interval is None:
        return _describe_uncounted(n_uncounted, over=over)
    trials = "conditions in which the clean scene is right" if over else "trials"
    if not n_wrong:
        interval_text = wording.format_interval(interval)
        reason = f"right in {n_right} of {n_right} {trials} (interval {interval_text})"
    else:
        lower, upper = interval  # of right trials
        interval_text = wording.format_interval((1.0 - upper, 1.0 - lower))
        reason = (
            f"wrong in {n_wrong} of {n_right + n_wrong} {trials} "
            f"(interval {interval_text})"
        )
        reason += f": {outcomes}" if outcomes else f", {wording.add_article(label)}"
    if verdict == UNDECIDED and n_right and n_wrong:
        cause = "conditions" if over else "noise"
        reason += f": it depends on the {cause}"
    if n_uncounted:
        why = "the object is not to be seen"
        if over:
            why = "the clean scene is wrong, or the object not to be seen"
        reason += f"; {n_uncounted} more are not counted, as {why}"
    return reason


def _describe_uncounted(n_uncounted: int, *, over: bool) -> str:
    """Describe why a counterexample is undecided of which no trial counts.

    Args:
        n_uncounted: trials that do not count; without any, the time was over.
        over: whether conditions vary.
    """
    if not n_uncounted:
        return OUT_OF_TIME_REASON
    if not over:
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
        return f"Kept as {result.added}."
    n_expected = sum(
        claim.verdict != HELD and claim.accepted for claim in result.claims
    )
    expected = f", {n_expected} of them as expected" if n_expected else ""
    beginnings = {
        results.RUNNING: "Running, so far",
        results.INTERRUPTED: "Stopped, so far",
    }
    beginning = beginnings.get(result.ending, result.verdict.capitalize())
    return f"{beginning}: {result.brief or 'no claims'}{expected}."


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
    """Yield what the result of each claim says, for `advsearch report`."""
    for tested in result.claims:
        text = (
            f"{tested.name}: that {tested.statement} is {tested.verdict}: "
            f"{tested.reason}."
        )
        kind = "measured"
        if tested.verdict == UNDECIDED:
            kind = "nothing claimed"
        elif tested.kind in ("not_broken", "counterexample"):
            kind = "found" if tested.verdict == FAILED else "not found"
        else:
            confidence = wording.percent(result.confidence)
            text += (
                f" Each end of the interval is a confidence sequence at {confidence}, "
                "in place of Clopper-Pearson's."
            )
        yield views.Claim(kind=kind, statement=text, extent=None)


SARIF_SCHEMA = "https://docs.oasis-open.org/sarif/sarif/v2.1.0/errata01/os/schemas/sarif-schema-2.1.0.json"

KIND_DESCRIPTIONS = {
    "right": "The model is right in at least a share of the pictures that some "
    "controls span.",
    "not_broken": "No search finds a configuration within a budget that the model gets "
    "wrong.",
    "no_worse": "The model is right at most so many points less often than another "
    "one, on the same pictures.",
    "must_change": "The model says something else where there is nothing left to see.",
    "must_not_change": "The model says the same where a change means nothing.",
    "counterexample": "The model is right on the adversarial scene of an earlier "
    "search.",
}
"""What a claim of each kind states; the rules of SARIF."""


def format_junit(result: SuiteResult) -> str:
    """Return JUnit XML with a test case for each claim.

    Failed claims are failures, and undecided claims are errors. Claims that are failed
    or undecided as expected count as skipped, so that they do not break a build.
    """
    answers = [(claim.verdict, claim.accepted) for claim in result.claims]
    attributes = {
        "tests": str(len(answers)),
        "failures": str(answers.count((FAILED, False))),
        "errors": str(answers.count((UNDECIDED, False))),
        "skipped": str(
            sum(accepted and answer != HELD for answer, accepted in answers)
        ),
        "time": f"{result.seconds['total']:.3f}",
    }
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


def _add_test_case(
    suite: ElementTree.Element, result: SuiteResult, claim: ClaimResult
) -> None:
    """Add the test case of a claim to a test suite of JUnit.

    Args:
        suite: element of the test suite, which the test case is added to.
        result: result of the full suite.
        claim: result of the claim.
    """
    case = ElementTree.SubElement(
        suite,
        "testcase",
        {
            "name": claim.name,
            "classname": _escape_xml(f"{result.title}.{claim.kind}"),
            "time": f"{claim.seconds:.3f}",
        },
    )
    if claim.verdict == HELD:
        output = ElementTree.SubElement(case, "system-out")
        output.text = _escape_xml(f"{claim.statement}\n{claim.reason}")
        return
    # "error" of a claim without a verdict
    tag = "failure" if claim.verdict == FAILED else "error"
    if claim.accepted:  # as it was expected to be
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
    rules = [
        {
            "id": kind,
            "shortDescription": {"text": KIND_DESCRIPTIONS[kind]},
            "defaultConfiguration": {"level": "error"},
        }
        for kind in kinds
    ]
    suite_lines = list[str]()
    if Path(result.suite).is_file():
        suite_lines = Path(result.suite).read_text("utf-8").splitlines()
    sarif_results = [
        _sarif_result(result, claim, kinds.index(claim.kind), suite_lines)
        for claim in result.claims
        if claim.verdict != HELD
    ]
    driver = {"name": "advsearch", "version": __version__, "rules": rules}
    invocation = {
        "executionSuccessful": not result.is_unfinished,
        "commandLine": result.command_line or "",
    }
    run = {
        "tool": {"driver": driver},
        "invocations": [invocation],
        "results": sarif_results,
    }
    log = {"$schema": SARIF_SCHEMA, "version": "2.1.0", "runs": [run]}
    return json.dumps(log, indent=2, ensure_ascii=False) + "\n"


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
    """Return a Markdown table of the claims, and commands to repeat those not held."""
    fact_texts = [
        f"{name} {_escape_markdown(value)}"
        for name, value in list_facts(result).items()
    ]
    lines = [
        f"### {_escape_markdown(result.title)}",
        "",
        _escape_markdown(describe_suite(result)),
        "",
        _format_row(TABLE_HEADS),
        _format_row(["---"] * len(TABLE_HEADS)),
        *map(_format_row, make_table_rows(result)),
        "",
        ", ".join(fact_texts),
    ]
    commands = [
        claim.repeat
        for claim in result.claims
        if claim.verdict != HELD and claim.repeat
    ]
    if commands:
        lines += ["", "```sh", *commands, "```"]
    return "\n".join(lines) + "\n"


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
