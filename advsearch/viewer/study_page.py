"""`report.html` of a question that took several attacks: a figure, tables, the attacks, and how it came about."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from advsearch.files import MESHES
from advsearch.report import gaps, wording
from advsearch.report.charts import HEIGHT, NARROW, WIDE, study_chart
from advsearch.report.markup import Html, element, join_html
from advsearch.report.studies import curve_axes, gap_axes
from advsearch.report.transfer import matrix_heads, matrix_rows, matrix_text
from advsearch.runs.directory import PARTS, REPORT
from advsearch.runs.results.gap import CurveResult, GapResult, StudyResult
from advsearch.runs.results.matrix import MatrixResult
from advsearch.viewer.document import document, scrolled

ROW_HEIGHT = 34
"""Height of a row of the chart of a gap, in CSS pixels."""


def gap_page(run: Path, result: GapResult) -> str:
    """Return the page of a gap in the folder `run`."""
    links = part_links(run, [row.run for row in result.table])
    words = f"Accuracy on average and of the worst configuration. {gaps.gap_text(result)} The table has the numbers."
    high = 110 + ROW_HEIGHT * len(result.table)
    note = (
        "On average: configurations drawn at random from the whole space and budget. Worst: trials of the "
        f"configuration that the search found, with fresh seeds; {gaps.margin_meaning(result)}. Clopper-Pearson "
        "intervals."
    )
    body = [
        element("h2", "The worst case beside the average"),
        _charts(lambda axes: gap_axes(result, axes), words, high) if result.table else None,
        study_table(gaps.GAP_HEADS, gaps.gap_rows(result), links),
        element("p", note, class_="soft"),
    ]
    return _study_page(run, result, gaps.gap_text(result), body)


def curve_page(run: Path, result: CurveResult) -> str:
    """Return the page of robust accuracy against epsilon in the folder `run`."""
    links = part_links(run, [row.run for row in result.table])
    points = [one for one in result.curve if one.epsilon is not None and one.accuracy is not None]
    told = "; ".join(f"{one.robust} of {one.objects} at {one.epsilon:g}" for one in points)
    words = f"Robust accuracy over epsilon with 95 % intervals: {told}."
    rows = gaps.curve_rows(result)
    note = (
        "Robust: recognised as it is, and no answer was verified within the epsilon. That is what these attacks found: "
        "a stronger one may find more. Clopper-Pearson intervals over objects."
    )
    body = [
        element("h2", "Robust accuracy") if rows else None,
        _charts(lambda axes: curve_axes(result, axes), words, HEIGHT) if len(points) > 1 else None,
        study_table(gaps.CURVE_HEADS, rows) if rows else None,
        element("p", note, class_="soft") if rows else None,
        element("h2", "The objects, at the last epsilon tried"),
        study_table(gaps.OBJECT_HEADS, gaps.object_rows(result), links),
        element("p", f"{gaps.margin_meaning(result)}.".capitalize(), class_="soft"),
    ]
    return _study_page(run, result, gaps.curve_text(result), body)


def matrix_page(run: Path, result: MatrixResult) -> str:
    """Return the page of a matrix in the folder `run`."""
    spp = f", {result.tested[0].spp} samples per pixel" if result.tested else ""
    note = (
        "Successes of the trials, in which the model is wrong on the answer and right on the clean scene with the same "
        "seed, with 95 % Clopper-Pearson intervals; * where that is verified. All models are shown the scene with the "
        f"same seeds{spp}, rounded to 8 bits. The stronger a cell's colour, the more successes."
    )
    facts = {
        "Models": ", ".join(f"{one.model} ({' x '.join(map(str, one.input_size))})" for one in result.tested),
        "Ensemble": result.ensemble or "",
    }
    rows = matrix_rows(result)
    before = len(rows) - len(result.table)  # the row of the clean scene
    rates = {
        (before + up, 2 + across): cell.verified.rate
        for up, row in enumerate(result.table)
        for across, cell in enumerate(row.tested)
    }
    links = [""] * before + part_links(run, [row.run for row in result.table])
    body = [
        element("h2", "Attacked on, tested on"),
        study_table(matrix_heads(result), rows, links, rates),
        element("p", note, class_="soft"),
    ]
    return _study_page(run, result, matrix_text(result), body, facts)


def heading(eyebrow: Html | str, text: str, remarks: Sequence[str]) -> Html:
    """Return the header of a page: what was asked, the answer, and what has to be known beside it."""
    return element("header", element("p", eyebrow, class_="eyebrow"), element("h1", text), remarks_html(remarks))


def remarks_html(remarks: Sequence[str]) -> Html:
    """Return what has to be known beside an answer, and below it, folded where it is much, how files were read."""
    notes = [one for one in remarks if _OF_A_FILE.match(one)]
    listed, noted = (
        element("ul", *(element("li", one) for one in lines), class_=css) if lines else None
        for lines, css in (([one for one in remarks if one not in notes], "remarks"), (notes, "notes"))
    )
    if len(notes) > MOST_NOTES:
        noted = element("details", element("summary", f"{len(notes)} notes on how files were read"), noted)
    return join_html(listed, noted)


def subject_html(*parts: tuple[str, str]) -> Html:
    """Return what a run is about: kinds with their names, the paths among which are short, and whole on hover."""
    shown = (
        join_html(f"{kind} " if kind else "", element("span", wording.short_names(text), title=text))
        for kind, text in parts
    )
    return join_html(*(join_html(", " if number else "", one) for number, one in enumerate(shown)))


def facts_table(facts: Mapping[str, str]) -> Html:
    """Return names with their values; those that are empty are left out."""
    lines = [
        element("tr", element("th", name, scope="row"), element("td", value)) for name, value in facts.items() if value
    ]
    return element("table", element("tbody", *lines), class_="facts")


def study_table(
    heads: Sequence[str],
    rows: Sequence[Sequence[str]],
    links: Sequence[str] = (),
    shares: Mapping[tuple[int, int], float] | None = None,
) -> Html:
    """Return a table whose rows begin with their name.

    Args:
        heads: of the columns.
        rows: texts.
        links: of the rows' names; empty ones and those that are missing lead nowhere.
        shares: in [0, 1], by row and column: the larger, the stronger the colour of the cell.
    """
    lines = []
    for number, (first, *cells) in enumerate(rows):
        link = links[number] if number < len(links) else ""
        name = element("a", first, href=link) if link else first
        shown = [_cell(text, (shares or {}).get((number, at))) for at, text in enumerate(cells, 1)]
        lines.append(element("tr", element("th", name, scope="row"), *shown))
    head = element("tr", *(element("th", text, scope="col") for text in heads))
    made = element("table", element("thead", head), element("tbody", *lines))
    return scrolled(made)


MOST_NOTES = 3
"""Notes on files that are not folded."""

_OF_A_FILE = re.compile(
    rf"[^:]{{1,200}}\.({'|'.join(one[1:] for one in (*MESHES, '.hdr', '.exr', '.xml'))})[: ]|The clean scene has ",
    re.IGNORECASE,
)
"""How what is said of the reading of a file begins, and of a value that a control leaves out."""

LONG = 32
"""Letters of a cell above which its text is broken into lines."""


def _cell(text: str, share: float | None) -> Html:
    if share is None:
        return element("td", text, class_="number" if len(text) <= LONG else "long")
    return element("td", text, class_=f"number share share-{round(10 * share)}")


def _charts(draw: Callable[[Any], object], words: str, height: int) -> Html:
    """A chart for a screen, and one for a phone."""
    return element("div", *(study_chart(draw, words, width, height) for width in (WIDE, NARROW)))


def part_links(run: Path, parts: Sequence[str | None]) -> list[str]:
    """Return where the pages of a run's parts are, seen from its own; empty of those that have none."""
    found = []
    for part in parts:
        name = "" if part is None else Path(part).name
        there = name and (run / PARTS / name / REPORT).is_file()
        found.append(f"{PARTS}/{quote(name, safe='')}/{REPORT}" if there else "")
    return found


def _study_page(
    run: Path, result: StudyResult, said: str, body: Sequence[Html | None], facts: Mapping[str, str] | None = None
) -> str:
    """The page of several attacks: what is said of them, the attacks and how they came about."""
    what = subject_html(
        ("", ",".join(result.objects)), ("", ", ".join(result.controls)), ("environment", result.environment)
    )
    conditions = {
        "Model": result.model,
        "Environment": result.environment,
        **(facts or {}),
        "Policy": result.policy,
        "Time": wording.seconds_text(result.seconds["total"]),
        "Seed": str(result.seed),
    }
    links = part_links(run, list(result.parts))
    linked = zip(result.parts, links, strict=True)
    parts = [element("li", element("a", name, href=link) if link else name) for name, link in linked]
    summary = element("summary", f"The attacks ({len(parts)})")
    main = element(
        "main",
        *body,
        element("details", summary, element("ul", *parts)) if parts else None,
        join_html(element("h2", "Cost and conditions"), facts_table(conditions)),
        again(result.command_line),
    )
    title = f"{', '.join(result.objects)}, {result.command}"
    return document(title, heading(what, said, result.warnings), main, footer=f"run {run.name}")


def again(command_line: str) -> Html:
    """Return the command that asks the same again."""
    return join_html(element("h2", "Do it again"), element("pre", command_line, class_="wrap"))
