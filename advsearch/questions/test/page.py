"""`report.html` of a suite: the claims with their answers, and a picture of each that failed."""

from __future__ import annotations

from pathlib import Path

from advsearch.questions.test.answer import HELD, SuiteResult
from advsearch.questions.test.words import TABLE_HEADS, facts, suite_text, table_rows
from advsearch.report.markup import Html, element, join_html
from advsearch.viewer.document import (
    again,
    data_url,
    document,
    facts_table,
    heading,
    part_links,
    study_table,
    subject_html,
)

LARGEST = 2_000_000
"""Bytes of a picture that the page takes along."""


def page(run: Path, result: SuiteResult) -> str:
    """Return the page of a suite in the folder `run`."""
    links = part_links(run, [one.part for one in result.claims])
    note = (
        "Held and failed are shown at the stated confidence, by an interval that holds however often it is looked at. "
        "A search that finds nothing is no proof."
    )
    main = element(
        "main",
        element("h2", "The claims"),
        study_table(TABLE_HEADS, table_rows(result), links),
        element("p", note, class_="soft"),
        *_pictures(run, result),
        join_html(element("h2", "Cost and conditions"), facts_table(facts(result))),
        again(result.command_line),
    )
    what = join_html(f"test {Path(result.suite).name}; ", subject_html(("", result.object), ("", result.model)))
    header = heading(what, f"{result.title}. {suite_text(result)}", [*result.changes, *result.warnings])
    return document(f"{run.name}, test", header, main, footer=f"run {run.name}. This page needs no other file.")


def _pictures(run: Path, result: SuiteResult) -> list[Html]:
    found = []
    for one in result.claims:
        file = run / (one.picture or "")
        if one.answer == HELD or not one.picture or not file.is_file() or file.is_symlink():
            continue
        if file.stat().st_size > LARGEST:
            continue
        picture = element("img", src=data_url(file.read_bytes(), "image/png"), alt=f"{one.name}: {one.reason}")
        caption = element("figcaption", f"{one.statement}: {one.answer}. {one.reason}.")
        found.append(
            join_html(element("h2", one.name), element("figure", picture, caption), element("pre", one.repeat))
        )
    return found
