"""The result of `test`."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar
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
# exit status of the command, by what the suite says as a whole
STATUS = {HELD: 0, FAILED: 1, UNDECIDED: 2}


class Cause(str, Enum):
    """Why a claim is undecided, where its pictures are not the reason."""

    COUNTEREXAMPLE_FAILED = "counterexample failed"
    INTERRUPTED = "interrupted"
    NOT_REACHED = "not reached"
    OUT_OF_TIME = "out of time"


class ClaimResult(results.Fields):
    """One claim, or one counterexample, and what came out."""

    name: str = Field(description="in the suite; of a counterexample, its file's")
    kind: str = Field(
        description="`right`, `not_broken`, `no_worse`, `must_change`, "
        "`must_not_change` or `counterexample`"
    )
    statement: str = Field(description="what is claimed, in words")
    answer: str = Field(description="`held`, `failed` or `undecided`")
    reason: str = Field(description="why, with the numbers")
    expected: str = Field(
        HELD, description="what it said when `update` was given last; absent for `held`"
    )
    pictures: int = Field(0, description="that it took; absent if none")
    rate: results.JsonFloat | None = results.optional(
        "share of right predictions, or of pictures as claimed; of two models the "
        "difference; absent of a search"
    )
    interval: results.Interval | None = results.optional(
        "of it: each end holds at all times together, at the suite's confidence; of a "
        "counterexample that "
        "of Clopper and Pearson, 95 %"
    )
    spp: int | None = results.optional(
        "samples a pixel of the pictures; absent of a search"
    )
    picture: str | None = results.optional(
        "a picture that the model gets wrong, in the run's folder"
    )
    part: str | None = results.optional(
        "the run in `parts` that has the search; absent without one"
    )
    repeat: str = Field(
        "", description="the command that repeats it; absent where there is none"
    )
    seconds: results.JsonFloat = Field(0.0, description="that it took")
    cause: Cause | None = results.optional(
        "`counterexample failed`, `interrupted`, `not reached` or `out of time`: why "
        "it is undecided; absent elsewhere"
    )

    @property
    def accepted(self) -> bool:
        return VERDICTS.index(self.answer) <= VERDICTS.index(self.expected)


class SuiteResult(views.InNotebook, RunResult):
    """What the claims of a suite came to."""

    command: ClassVar[str] = "test"

    suite: str = Field(description="its file")
    title: str = Field(description="what it is about")
    object: str = Field(description="of all claims, with commas between them")
    model: str = Field(description="the model that the claims are about")
    answer: str = Field(
        description="`failed` if a claim is that was not expected to be, else "
        "`undecided` likewise, else `held`"
    )
    confidence: float = Field(
        description="of each claim that is decided by drawn pictures"
    )
    claims: list[ClaimResult]
    added: str | None = results.optional(
        "the file of the counterexample that was added; only with `add`"
    )
    changes: list[str] = Field(
        [], description="what is expected from now on; only with `update`"
    )
    warnings: list[str] = Field(description="sentences that a reader has to know")

    @property
    def brief(self) -> str:
        answers = [claim.answer for claim in self.claims]
        counts = {
            verdict: answers.count(verdict) for verdict in (HELD, FAILED, UNDECIDED)
        }
        return ", ".join(
            f"{count} {verdict}" for verdict, count in counts.items() if count
        )

    @property
    def status(self) -> int:
        return 0 if self.added is not None else STATUS[self.answer]


def verdict(claims: list[ClaimResult]) -> str:
    return max(
        (claim.answer for claim in claims if not claim.accepted),
        key=VERDICTS.index,
        default=HELD,
    )


TABLE_HEADS = ("claim", "verdict", "pictures", "why")

NOTE = (
    "Held and failed are shown at the stated confidence, by one end of an interval, "
    "each of which holds however often "
    "it is looked at. A search that finds nothing is no proof."
)

TIME_OVER = "the time of the suite was over"
STOPPED = "it was interrupted"
NOT_TRIED = "not tried, since a counterexample failed"
NOT_YET = "not tried yet"


def shown(result: SuiteResult) -> ShownResult:
    runs = [claim.part for claim in result.claims]
    sections = [
        ResultPart(
            "The claims",
            heads=TABLE_HEADS,
            rows=table_rows(result),
            note=NOTE,
            parts=runs,
        )
    ]
    for claim in result.claims:
        if claim.answer != HELD and claim.cause is not Cause.COUNTEREXAMPLE_FAILED:
            caption = f"{claim.statement}: {claim.answer}. {claim.reason}."
            pictures = (
                [[views.Picture(claim.picture, caption)]] if claim.picture else []
            )
            sections.append(
                ResultPart(
                    claim.name, rows=[["repeat", claim.repeat]], pictures=pictures
                )
            )
    sections.append(ResultPart("Expected from now on", result.changes))
    about = [Path(result.suite).name, result.object, result.model]
    return ShownResult(
        f"{result.title}. {suite_text(result)}", sections, facts(result), about
    )


def statement(claim: AnyClaim, config: SceneConfig) -> str:
    what = f"{wording.short_name(config.object)}, {', '.join(config.controls)}"
    if isinstance(claim, RightClaim):
        spanned = "the frames" if "path" in config.controls else "the pictures"
        share = (
            f"at least {wording.percent(claim.at_least)} of {spanned} that the "
            "ranges span"
        )
        return f"{wording.short_name(config.model)} is right in {share}: {what}"
    if isinstance(claim, ChangeClaim):
        says = (
            "says something else" if claim.claim == "must_change" else "says the same"
        )
        changes = {**SweepConfig.blind_changes, **SweepConfig.harmless_changes}
        when = (
            f"{changes[claim.when]}, in at least {wording.percent(claim.at_least)} "
            "of pictures"
        )
        return f"{wording.short_name(config.model)} {says} when {when}: {what}"
    if isinstance(claim, NoWorseClaim):
        points = f"{wording.number_text(claim.points)} points"
        model = wording.short_name(config.model)
        other = wording.short_name(claim.than)
        models = f"{model} is right at most {points} less often than {other}"
        return f"{models} on the same pictures of {what}"
    epsilon = getattr(config, "epsilon", None)
    within = (
        ""
        if epsilon is None
        else f" within {wording.number_text(epsilon) if isinstance(epsilon, float) else epsilon}"
    )
    return (
        f"no search finds a picture that {wording.short_name(config.model)} gets "
        f"wrong: {what}{within}"
    )


def share_reason(
    what: str,
    verdict: str,
    right: int,
    pictures: int,
    interval: tuple[float, float],
    worst: str,
    outcomes: str = "",
) -> str:
    """Return why a claim about a share is held, failed or undecided, with the interval
    at all times together. `what` is so in `right` of the pictures; `worst` says where
    it was not, and is empty where it always was. `outcomes` says what became of the
    object in the other pictures where a detector is judged.
    """
    said = (
        (
            f"{what} in {right} of {pictures} (interval "
            f"{wording.interval_text(interval)})"
        )
        if pictures
        else "no picture"
    )
    said += f"; {outcomes}" if outcomes else ""
    more = (
        f"; not decided after {wording.count(pictures, 'picture')}"
        if verdict == UNDECIDED
        else ""
    )
    return said + more + (f"; {worst}" if worst else "")


def difference_reason(
    verdict: str, counts: tuple[int, int, int], interval: tuple[float, float], than: str
) -> str:
    """Return why a claim about two models is held, failed or undecided. The counts are
    pictures; those in which only the model is right, and those in which only the other
    one is.
    """
    pictures, ours, theirs = counts
    if not pictures:
        return "no picture"
    ends = " to ".join(f"{100.0 * end:+.1f}" for end in interval)
    said = (
        f"of {wording.count(pictures, 'picture')} it alone is right in {ours}, "
        f"{wording.short_name(than)} alone in {theirs} "
        f"(difference {100.0 * (ours - theirs) / pictures:+.1f} points, interval "
        f"{ends})"
    )
    return said + (
        f"; not decided after {wording.count(pictures, 'picture')}"
        if verdict == UNDECIDED
        else ""
    )


def search_verdict(
    summary: workbench.AttackSummary, config: AttackConfig
) -> tuple[str, str, Cause | None]:
    """Return the verdict of a search, its reason, and the cause where the search is not
    at its end.
    """
    verified = summary.verified
    clean = summary.clean.control
    if summary.ending == "already wrong":
        right = (
            ""
            if clean is None
            else (f": right in {clean.correct} of {clean.trials} trials")
        )
        if clean is not None and clean.outcomes:
            right += f", {wording.outcomes_text(clean.outcomes, summary.task)}"
        return FAILED, f"wrong on the clean scene already{right}", None
    if summary.ending == "found" and verified is not None:
        called = how_wrong(summary.task, verified)
        interval = wording.interval_text(verified.interval)
        wrong = (
            f"wrong in {verified.successes} of {verified.trials} trials (interval "
            f"{interval})"
        )
        return FAILED, f"a verified counterexample: {wrong}{called}", None
    if summary.goes_on:
        return UNDECIDED, STOPPED, Cause.INTERRUPTED
    if verified is not None and verified.successes:
        noisy = (
            f"what it found is wrong in {verified.successes} of {verified.trials} "
            "trials, by noise"
        )
        return UNDECIDED, noisy, None
    asked = config.steps
    if config.seconds is not None and asked is not None and summary.steps < asked:
        return (
            UNDECIDED,
            f"{TIME_OVER} after {summary.steps} of {asked} steps",
            Cause.OUT_OF_TIME,
        )
    beside = "" if summary.baseline is None else ", nor by as many random renders"
    steps = wording.count(summary.steps, "step")
    return (
        HELD,
        f"not broken by {steps} of {summary.policy}{beside}; this is no proof",
        None,
    )


def how_wrong(task: str, verified: results.VerifiedRate) -> str:
    """Return what the model most often says in trials that are successes, as the end of
    a sentence.
    """
    label = next(iter(verified.labels), "")
    if verified.outcomes:
        return f": {wording.outcomes_text(verified.outcomes, task)}"
    return f", most often {wording.with_article(label)}" if label else ""


def cannot_be_judged(error: str) -> str:
    return f"its own settings do not fit to this model: {error}"


def tried_reason(
    verdict: str,
    counts: tuple[int, int, int],
    label: str,
    interval: tuple[float, float] | None,
    *,
    over: bool,
    outcomes: str = "",
) -> str:
    """Return why a counterexample is held, failed or undecided.

    Args:
        verdict: HELD, FAILED or UNDECIDED.
        counts: trials in which the model is right, in which it is wrong, and which do
            not count.
        label: the first wrong prediction.
        interval: of the share of right trials; None where no trial counts.
        over: whether conditions vary.
        outcomes: what became of the object in the wrong trials, where a detector is
            judged; else empty.
    """
    right, wrong, uncounted = counts
    total = right + wrong
    what = "conditions in which the clean scene is right" if over else "trials"
    if interval is None:
        if over and uncounted:
            return (
                f"none of {uncounted} conditions counts: the clean scene is wrong, "
                "or the object not to be seen"
            )
        return "nothing of the object is to be seen" if uncounted else TIME_OVER
    if not wrong:
        text = (
            f"right in {right} of {right} {what} (interval "
            f"{wording.interval_text(interval)})"
        )
    else:
        low, high = interval
        ends = wording.interval_text((1.0 - high, 1.0 - low))
        text = f"wrong in {wrong} of {total} {what} (interval {ends})"
        text += f": {outcomes}" if outcomes else f", {wording.with_article(label)}"
    if verdict == UNDECIDED and right and wrong:
        text += (
            ": it depends on the conditions" if over else ": it depends on the noise"
        )
    why = (
        "the clean scene is wrong, or the object not to be seen"
        if over
        else "the object is not to be seen"
    )
    return text + (f"; {uncounted} more are not counted, as {why}" if uncounted else "")


def table_rows(result: SuiteResult) -> list[list[str]]:
    rows = []
    for claim in result.claims:
        text = claim.answer
        if claim.expected != HELD:
            text += (
                " (as expected)"
                if claim.answer == claim.expected
                else f" (expected: {claim.expected})"
            )
        rows.append([claim.name, text, str(claim.pictures or ""), claim.reason])
    return rows


def suite_text(result: SuiteResult) -> str:
    if result.added is not None:
        return f"Kept as {result.added}."
    known = sum(claim.answer != HELD and claim.accepted for claim in result.claims)
    beside = f", {known} of them as expected" if known else ""
    said = {
        results.RUNNING: "Running, so far",
        results.INTERRUPTED: "Stopped, so far",
    }.get(result.ending, result.answer.capitalize())
    return f"{said}: {result.brief or 'no claims'}{beside}."


def facts(result: SuiteResult) -> dict[str, str]:
    return {
        "model": result.model,
        "confidence": f"{wording.percent(result.confidence)} for each claim that "
        "pictures decide",
        "pictures": str(sum(claim.pictures for claim in result.claims)),
        "seed": str(result.seed),
        "time": wording.seconds_text(result.seconds["total"]),
    }


def claims(result: SuiteResult) -> Iterator[views.Claim]:
    for tried in result.claims:
        text = (
            f"{tried.name}: that {tried.statement} is {tried.answer}: {tried.reason}."
        )
        if tried.answer == UNDECIDED:
            yield views.Claim(kind="nothing claimed", statement=text, extent=None)
        elif tried.kind in ("not_broken", "counterexample"):
            yield views.Claim(
                kind="found" if tried.answer == FAILED else "not found",
                statement=text,
                extent=None,
            )
        else:
            sure = wording.percent(result.confidence)
            text += (
                f" Each end of the interval is a confidence sequence at {sure}, "
                "in "
                "place of Clopper-Pearson's."
            )
            yield views.Claim(kind="measured", statement=text, extent=None)


SARIF_SCHEMA = "https://docs.oasis-open.org/sarif/sarif/v2.1.0/errata01/os/schemas/sarif-schema-2.1.0.json"

MEANINGS = {
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
"""What a claim of each kind says; the rules of SARIF."""


def junit(result: SuiteResult) -> str:
    """Return JUnit XML: a test case for each claim. What failed is a failure, what is
    undecided an error, and what is so as expected is skipped.
    """
    answers = [(claim.answer, claim.accepted) for claim in result.claims]
    counts = {
        "tests": len(answers),
        "failures": answers.count((FAILED, False)),
        "errors": answers.count((UNDECIDED, False)),
        "skipped": sum(accepted and answer != HELD for answer, accepted in answers),
    }
    attributes = {name: str(count) for name, count in counts.items()} | {
        "time": f"{result.seconds['total']:.3f}"
    }
    root = ElementTree.Element("testsuites", {"name": "advsearch", **attributes})
    suite = ElementTree.SubElement(
        root, "testsuite", {"name": _xml(result.title), **attributes}
    )
    properties = ElementTree.SubElement(suite, "properties")
    for name, value in {**facts(result), "run": result.run or ""}.items():
        ElementTree.SubElement(
            properties, "property", {"name": name, "value": _xml(value)}
        )
    for claim in result.claims:
        named = {"name": claim.name, "classname": _xml(f"{result.title}.{claim.kind}")}
        case = ElementTree.SubElement(
            suite, "testcase", {**named, "time": f"{claim.seconds:.3f}"}
        )
        if claim.answer == HELD:
            ElementTree.SubElement(case, "system-out").text = _xml(
                f"{claim.statement}\n{claim.reason}"
            )
            continue
        tag = (
            "skipped"
            if claim.accepted
            else "failure"
            if claim.answer == FAILED
            else "error"
        )
        said = ElementTree.SubElement(
            case, tag, {"message": _xml(f"{claim.answer}: {claim.reason}")}
        )
        if tag != "skipped":
            said.set("type", claim.answer)
        said.text = _xml(
            "\n".join(
                filter(None, [claim.statement, _picture(result, claim), claim.repeat])
            )
        )
    ElementTree.indent(root)
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        + ElementTree.tostring(root, encoding="unicode")
        + "\n"
    )


def sarif(result: SuiteResult) -> str:
    """Return SARIF 2.1.0: a rule for each kind of claim, and a result for each claim
    that is not held, at the suite's file. What is so as expected is `unchanged`, all
    else `new`.
    """
    kinds = list(dict.fromkeys(claim.kind for claim in result.claims))
    rules = [
        {
            "id": kind,
            "shortDescription": {"text": MEANINGS[kind]},
            "defaultConfiguration": {"level": "error"},
        }
        for kind in kinds
    ]
    lines = (
        Path(result.suite).read_text("utf-8").splitlines()
        if Path(result.suite).is_file()
        else []
    )
    sarif_results = []
    for claim in result.claims:
        if claim.answer == HELD:
            continue
        # the line of the suite's file in which the claim begins; the first for what
        # stands elsewhere
        begins = re.compile(rf"\s+{re.escape(claim.name)}\s*:")
        line = next(
            (
                number
                for number, text in enumerate(lines, start=1)
                if begins.match(text)
            ),
            1,
        )
        place = {
            "artifactLocation": {"uri": quote(result.suite)},
            "region": {"startLine": line},
        }
        more = {
            "picture": _picture(result, claim),
            "repeat": claim.repeat,
            "pictures": claim.pictures,
        }
        sarif_results.append({
            "ruleId": claim.kind,
            "ruleIndex": kinds.index(claim.kind),
            "level": "error" if claim.answer == FAILED else "warning",
            "message": {"text": f"{claim.name}: {claim.answer}: {claim.reason}. "
                                f"Claimed: {claim.statement}."},
            "locations": [{"physicalLocation": place}],
            "partialFingerprints": {"claim/v1": claim.name},
            "baselineState": "unchanged" if claim.accepted else "new",
            "properties": {name: value for name, value in more.items() if value},
        })  # fmt: skip
    driver = {"name": "advsearch", "version": __version__, "rules": rules}
    invocation = {
        "executionSuccessful": not result.goes_on,
        "commandLine": result.command_line or "",
    }
    run = {
        "tool": {"driver": driver},
        "invocations": [invocation],
        "results": sarif_results,
    }
    return (
        json.dumps(
            {"$schema": SARIF_SCHEMA, "version": "2.1.0", "runs": [run]},
            indent=2,
            ensure_ascii=False,
        )
        + "\n"
    )


def markdown(result: SuiteResult) -> str:
    lines = [f"### {_plain(result.title)}", "", _plain(suite_text(result)), ""]
    lines += [
        _line(TABLE_HEADS),
        _line(["---"] * len(TABLE_HEADS)),
        *map(_line, table_rows(result)),
    ]
    lines += [
        "",
        ", ".join(f"{name} {_plain(value)}" for name, value in facts(result).items()),
    ]
    again = [
        claim.repeat for claim in result.claims if claim.answer != HELD and claim.repeat
    ]
    lines += ["", "```sh", *again, "```"] if again else []
    return "\n".join(lines) + "\n"


def _picture(result: SuiteResult, claim: ClaimResult) -> str:
    return f"{result.run}/{claim.picture}" if claim.picture else ""


def _xml(text: str) -> str:
    return re.sub(
        r"[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]", "?", text
    )


def _plain(text: str) -> str:
    return re.sub(r"([\\`*_{}\[\]<>#|])", r"\\\1", " ".join(text.split()))


def _line(cells: Sequence[str]) -> str:
    return (
        "| "
        + " | ".join(cell if cell == "---" else _plain(cell) for cell in cells)
        + " |"
    )
