"""What `report --evidence` writes: claims of runs with their context, as a page and
text.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import ClassVar

from pydantic import Field

from advsearch.extend import markup, results, views, wording


class ConditionShare(results.Fields):
    """Counts of right predictions under one condition."""

    condition: str = Field(description="the condition in words, with its unit")
    axis: str
    value: str
    right: int
    total: int = Field(alias="of", description="number of configurations")
    interval: results.Interval = Field(description="95 % interval of the fraction")


class EvidenceRun(results.Fields):
    """One run as evidence: its claims, its subject, and how it was measured."""

    run: str
    command: str
    ending: str
    claims: list[views.Claim]
    started: str = Field(
        "", description="when the run was started, in UTC; empty if unknown"
    )
    criterion: list[str] = Field(
        [], description="whether the criterion is met; absent without one"
    )
    triggering: list[str] = Field(
        [],
        description="rules under which the model is wrong more often; absent without "
        "any",
    )
    exposure: list[str] = Field(
        [],
        description="fractions weighted by how common conditions are; absent without "
        "weights",
    )
    conditions: list[ConditionShare] = Field(
        [],
        description="counts for each value of each axis; absent without axes",
    )
    photographs: list[ConditionShare] = Field(
        [],
        description="counts for each value of each axis, where `right` counts the "
        "photographs that agree with their rendering; absent without photographs",
    )
    twins: results.TwinEvidence | None = results.optional_field(
        "how far the verdict holds for photographs, from a run of twins; absent "
        "without one"
    )
    domain: dict[str, str] = Field(
        {}, description="the operational design domain in words, by its parts"
    )
    limitations: list[str] = Field(
        [], description="what a reader must not conclude from the run"
    )
    pictures: list[str] = Field(
        [], description="files of pictures, relative to this file"
    )
    about: dict[str, str] = Field(
        description="object, environment, model, task and what counts as right"
    )
    searched: list[str] = Field(description="what varied, and in which ranges")
    method: dict[str, str] = Field(
        description="policy, seed, samples and so on, by name"
    )
    settings: dict[str, str] = Field(
        {},
        description="every recorded setting that has an effect, by its name; those of "
        "claims, counterexamples and other runs have the name of these before theirs",
    )
    excluded: list[str] = Field(
        description="what was not searched, was rejected, or went wrong"
    )
    cost: dict[str, str] = Field(description="number of renders, and time")
    made_with: dict[str, str] = Field(
        description="versions and SHA-256 digests of files, as the run recorded them"
    )
    command_line: str = Field(description="command that repeats the run")


class Evidence(results.Result):
    """Runs as evidence, for a model card or a safety case."""

    command: ClassVar[str] = "report"

    runs: list[EvidenceRun]
    warnings: list[str] = Field(description="remarks about all runs together")
    rules: list[str] = Field(description="how to read the claims")
    version: str = Field(description="version of advsearch that wrote the evidence")
    written: str = Field("", description="when the evidence was written, in UTC")
    by: str = Field("", description="who is responsible; absent if not stated")
    criterion: float | None = results.optional_field(
        "required fraction of right predictions; absent without a criterion"
    )


def make_tables(
    run: EvidenceRun,
) -> Iterator[tuple[str, Sequence[str], list[list[str]]]]:
    """Yield title, heads and rows of the tables of a run; empty ones are left out."""
    tables = (
        ("Right", ("condition", "right"), run.conditions),
        ("Photographs that agree", ("photographs of", "agree"), run.photographs),
    )
    for title, first_heads, conditions in tables:
        rows = [_make_condition_cells(row) for row in conditions]
        if rows:
            yield title, (*first_heads, "of", "95 % interval"), rows


def _make_condition_cells(row: ConditionShare) -> list[str]:
    """Return the cells of a condition: its name, counts and interval."""
    interval = wording.format_interval(row.interval)
    return [row.condition, str(row.right), str(row.total), interval]


def format_markdown(evidence: Evidence) -> str:
    """Return evidence as Markdown."""
    lines = ["# Evidence", "", *(f"> {text}" for text in evidence.warnings)]
    if evidence.warnings:
        lines.append("")
    for run in evidence.runs:
        lines += _run_markdown(run)
    lines += ["## How to read this", "", *(f"- {text}" for text in evidence.rules), ""]
    return "\n".join([*lines, _describe_author(evidence)]) + "\n"


def _run_markdown(run: EvidenceRun) -> list[str]:
    """Return the lines of a run: claims, tables, pictures, and sections."""
    lines = [f"## {_plain(run.run)}", ""]
    lines += [f"- **{claim.kind}**: {_plain(claim.statement)}" for claim in run.claims]
    lines.append("")
    for _, heads, rows in make_tables(run):
        lines += [*_table_markdown(heads, rows), ""]
    if run.pictures:
        lines += [f"![{name}]({name})" for name in run.pictures]
        lines.append("")
    for title, texts in make_sections(run).items():
        lines += [f"{title}:", "", *(f"- {_plain(text)}" for text in texts), ""]
    if run.command_line:
        # Three backquotes would end the block of code.
        command = run.command_line.replace("```", "` ` `")
        lines += ["To repeat it:", "", "```sh", command, "```", ""]
    return lines


def _table_markdown(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table."""
    rule = ["---"] * len(heads)  # the line that Markdown has under heads
    return [f"| {' | '.join(map(_plain, cells))} |" for cells in (heads, rule, *rows)]


def _describe_author(evidence: Evidence) -> str:
    """State who wrote the evidence, when, and with which version."""
    by = f" by {_plain(evidence.by)}" if evidence.by else ""
    return (
        f"Written{by}, {evidence.written or 'at a time that is not noted'}, with "
        f"advsearch {evidence.version}."
    )


def make_sections(run: EvidenceRun) -> dict[str, list[str]]:
    """Return the lines of the sections of a run by title, without empty ones.

    Args:
        run: the run.
    """
    versions = _list_named(run.made_with)
    if run.started:
        versions.insert(0, f"begun: {run.started}")
    twins = [] if run.twins is None else [wording.format_twin_evidence(run.twins)]
    lines_of_title = {
        "Photographs": twins,
        "Criterion": run.criterion,
        "Triggering conditions": run.triggering,
        "Exposure": run.exposure,
        "Operational design domain": _list_named(run.domain),
        "Not shown": run.limitations,
        "On what": _list_named(run.about),
        "What varied": run.searched,
        "Measured how": _list_named({"ended as": run.ending, **run.method}),
        "Settings": _list_named(run.settings),
        "Excluded, and to be known": run.excluded,
        "Budget": _list_named(run.cost),
        "Made with": versions,
    }
    return {title: lines for title, lines in lines_of_title.items() if lines}


def _list_named(texts: Mapping[str, str]) -> list[str]:
    """Return a line for each text, with its name before it."""
    return [f"{name}: {text}" for name, text in texts.items()]


def _plain(text: str) -> str:
    """Escape Markdown, and join lines."""
    return re.sub(r"([\\<>*_\[\]`|])", r"\\\1", " ".join(text.split()))


CLAIM_HEADS = ("claim", "in words", "counted", "95 % interval")


def make_evidence_page(
    evidence: Evidence, pictures: Mapping[str, bytes] | None = None
) -> str:
    """Return evidence as an HTML page, which needs no other file.

    Args:
        evidence: the evidence.
        pictures: PNG files as bytes, by the names that the evidence has for them.
    """
    rules = [
        # Backquotes are Markdown's.
        markup.make_element("li", text.replace("`", ""))
        for text in evidence.rules
    ]
    main = markup.make_element(
        "main",
        *(_run_html(run, pictures or {}) for run in evidence.runs),
        markup.make_element("h2", "How to read this"),
        markup.make_element("ul", *rules),
        markup.make_element("p", _describe_author(evidence), class_="soft"),
    )
    return markup.make_document(
        "evidence",
        _make_page_header(evidence),
        main,
        footer="evidence. This page needs no other file.",
    )


def _make_page_header(evidence: Evidence) -> markup.Html:
    """Return the head of the page: how many claims it has, of how many runs."""
    n_runs = len(evidence.runs)
    show = "shows" if n_runs == 1 else "show"
    claims = [claim for run in evidence.runs for claim in run.claims]
    n_real_claims = sum(claim.kind != "nothing claimed" for claim in claims)
    return markup.make_header(
        f"evidence; {n_real_claims} of {len(claims)} statements carry a claim",
        f"What {wording.format_count(n_runs, 'run')} {show}, and no more than that.",
        evidence.warnings,
    )


def _run_html(run: EvidenceRun, pictures: Mapping[str, bytes]) -> markup.Html:
    """Return a run: claims, pictures, tables and sections."""
    parts = [
        markup.make_element("h2", f"{run.run} ({run.command})"),
        markup.make_table(CLAIM_HEADS, _list_claim_rows(run)),
        *_list_images(run, pictures),
        *_list_condition_tables(run),
        _make_section_table(run),
    ]
    if run.command_line:
        parts += [
            markup.make_element("h2", "Do it again"),
            markup.make_element("pre", run.command_line, class_="wrap"),
        ]
    return markup.join_html(*parts)


def _list_condition_tables(run: EvidenceRun) -> list[markup.Html]:
    """Return the tables by condition, each folded under its title."""
    tables = []
    for title, heads, rows in make_tables(run):
        summary = markup.make_element(
            "summary", f"{title} by condition, {len(rows)} rows"
        )
        table = markup.make_table(heads, rows)
        tables.append(markup.make_element("details", summary, table))
    return tables


def _make_section_table(run: EvidenceRun) -> markup.Html:
    """Return the sections of a run as a table that can be folded, a row for each."""
    rows = [
        _make_section_row(title, lines) for title, lines in make_sections(run).items()
    ]
    table = markup.make_element(
        "table", markup.make_element("tbody", *rows), class_="facts"
    )
    summary = markup.make_element("summary", "On what, how, and what is left out")
    # With the attribute `open` it is not folded at first.
    return markup.make_element("details", summary, table, open="")


def _make_section_row(title: str, lines: Sequence[str]) -> markup.Html:
    """Return the row of a section, with its title as the head."""
    divisions = [markup.make_element("div", line) for line in lines]
    return markup.make_element(
        "tr",
        markup.make_element("th", title, scope="row"),
        markup.make_element("td", *divisions),
    )


def _list_claim_rows(run: EvidenceRun) -> list[list[str]]:
    """Return the rows of the table of claims."""
    rows = []
    for claim in run.claims:
        count = ""
        interval = ""
        if claim.extent:
            count = f"{claim.extent.count} of {claim.extent.total}"
            interval = wording.format_interval(claim.extent.interval)
        rows.append([claim.kind, claim.statement, count, interval])
    return rows


def _list_images(run: EvidenceRun, pictures: Mapping[str, bytes]) -> list[markup.Html]:
    """Return the pictures of a run side by side; empty if it names none."""
    if not run.pictures:
        return []
    images = []
    for name in run.pictures:
        if name in pictures:
            url = markup.make_data_url(pictures[name], "image/png")
            image = markup.make_element("img", src=url, alt=name)
            images.append(markup.make_element("figure", image))
    return [markup.make_element("div", *images, class_="pictures")]
