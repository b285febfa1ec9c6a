"""What `report --evidence` writes: claims of runs with what a reader needs to judge them, as a page and Markdown."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from advsearch.report.markup import Html, element, join_html
from advsearch.report.shown import Claim
from advsearch.report.wording import interval_text
from advsearch.runs.results import Fields, Result
from advsearch.viewer.document import document, facts_table, heading, study_table


class EvidenceRun(Fields):
    """One run: what it was about, how it was measured and what it stands for."""

    run: str
    command: str
    ending: str
    claims: list[Claim]
    about: dict[str, str] = Field(description="object, environment, model, task and what counts as right")
    searched: list[str] = Field(description="what could change, and how far")
    measured: dict[str, str] = Field(description="policy, seed, samples and the like, by name")
    excluded: list[str] = Field(description="what was not searched, was rejected, or went wrong")
    cost: dict[str, str] = Field(description="renders and time")
    made_with: dict[str, str] = Field(description="versions, and SHA-256 of files; as the run noted them")
    command_line: str = Field(description="what repeats it")


class Evidence(Result):
    """Runs as evidence, for a model card or a safety case."""

    command: ClassVar[str] = "report"

    runs: list[EvidenceRun]
    warnings: list[str] = Field(description="what has to be known of all of them together")
    rules: list[str] = Field(description="how the claims are to be read")
    version: str = Field(description="of advsearch, that wrote this")


def markdown(evidence: Evidence) -> str:
    """Return the whole as Markdown, to be put into a model card."""
    lines = ["# Evidence", "", *(f"> {one}" for one in evidence.warnings), "" if evidence.warnings else None]
    for one in evidence.runs:
        lines += [
            f"## {_plain(one.run)}",
            "",
            *(f"- **{claim.kind}**: {_plain(claim.statement)}" for claim in one.claims),
            "",
        ]
        for title, facts in sections(one).items():
            lines += [f"{title}:", "", *(f"- {_plain(text)}" for text in facts), ""]
        lines += (
            ["To repeat it:", "", "```sh", one.command_line.replace("```", "` ` `"), "```", ""]
            if one.command_line
            else []
        )
    lines += ["## How to read this", "", *(f"- {text}" for text in evidence.rules), ""]
    lines.append(f"Written by advsearch {evidence.version}.")
    return "\n".join(line for line in lines if line is not None) + "\n"


def sections(one: EvidenceRun) -> dict[str, list[str]]:
    """Return what stands beside the claims of a run, in lines under their headings."""
    found = {
        "On what": [f"{name}: {text}" for name, text in one.about.items()],
        "What varied": one.searched,
        "Measured how": [f"ended as: {one.ending}", *(f"{name}: {text}" for name, text in one.measured.items())],
        "Excluded, and to be known": one.excluded,
        "Budget": [f"{name}: {text}" for name, text in one.cost.items()],
        "Made with": [f"{name}: {text}" for name, text in one.made_with.items()],
    }
    return {title: lines for title, lines in found.items() if lines}


def _plain(text: str) -> str:
    """Text that Markdown shows as it is."""
    one_line = " ".join(text.split())
    for sign in "\\<>*_[]`|":
        one_line = one_line.replace(sign, f"\\{sign}")
    return one_line


CLAIM_HEADS = ("claim", "in words", "counted", "95 % interval")


def evidence_page(evidence: Evidence) -> str:
    """Return the page."""
    claims = [claim for one in evidence.runs for claim in one.claims]
    carried = sum(claim.kind != "nothing claimed" for claim in claims)
    runs = f"{len(evidence.runs)} run{'' if len(evidence.runs) == 1 else 's'}"
    said = f"What {runs} show{'s' if len(evidence.runs) == 1 else ''}, and no more than that."
    main = element(
        "main",
        *(_run_html(one) for one in evidence.runs),
        element("h2", "How to read this"),
        element("ul", *(element("li", text.replace("`", "")) for text in evidence.rules)),
    )
    header = heading(f"evidence; {carried} of {len(claims)} statements carry a claim", said, evidence.warnings)
    return document("evidence", header, main, footer="evidence. This page needs no other file.")


def _run_html(one: EvidenceRun) -> Html:
    rows = [
        [
            claim.kind,
            claim.statement,
            f"{claim.extent.count} of {claim.extent.total}" if claim.extent else "",
            interval_text(claim.extent.interval) if claim.extent else "",
        ]
        for claim in one.claims
    ]
    facts = {name: "; ".join(lines) for name, lines in sections(one).items()}
    beside = element("details", element("summary", "On what, how, and what is left out"), facts_table(facts), open="")
    return join_html(
        element("h2", f"{one.run} ({one.command})"),
        study_table(CLAIM_HEADS, rows),
        beside,
        join_html(element("h2", "Do it again"), element("pre", one.command_line, class_="wrap"))
        if one.command_line
        else None,
    )
