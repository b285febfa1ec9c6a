"""The page of `report --evidence`."""

from __future__ import annotations

from advsearch.questions.report.answer import Evidence, EvidenceRun
from advsearch.questions.report.runs import sections
from advsearch.report.markup import Html, element, join_html
from advsearch.report.wording import interval_text
from advsearch.viewer.document import again, document, facts_table, heading, study_table

CLAIM_HEADS = ("claim", "in words", "counted", "95 % interval")


def evidence_page(evidence: Evidence) -> str:
    """Return the page."""
    claims = [claim for one in evidence.runs for claim in one.claims]
    carried = sum(claim.kind != "nothing claimed" for claim in claims)
    runs = f"{len(evidence.runs)} run{'' if len(evidence.runs) == 1 else 's'}"
    said = f"What {runs} show{'s' if len(evidence.runs) == 1 else ''}, and no more than that."
    main = element(
        "main",
        *(_run(one) for one in evidence.runs),
        element("h2", "How to read this"),
        element("ul", *(element("li", text.replace("`", "")) for text in evidence.rules)),
    )
    header = heading(f"evidence; {carried} of {len(claims)} statements carry a claim", said, evidence.warnings)
    return document("evidence", header, main, footer="evidence. This page needs no other file.")


def _run(one: EvidenceRun) -> Html:
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
        again(one.command_line) if one.command_line else None,
    )
