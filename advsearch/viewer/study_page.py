"""`report.html` of a question that took several attacks: a table, and how it came about."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from advsearch.report import wording
from advsearch.report.markup import Html, element, join
from advsearch.report.replays import HEADS, replay_rows, replay_text
from advsearch.report.transfer import matrix_heads, matrix_rows, matrix_text
from advsearch.runs.directory import REPORT
from advsearch.runs.files import write_text
from advsearch.runs.results.matrix import MatrixResult
from advsearch.runs.results.replay import ReplayResult
from advsearch.viewer.document import document


def write_matrix_page(result: MatrixResult) -> Path:
    """Write `report.html` into the run of a matrix, and return its path.

    Raises:
        StorageError: it could not be written.
    """
    run = Path(str(result.run))
    what = f"{', '.join(result.objects)}; {', '.join(result.controls)}; environment {result.environment}"
    spp = f", {result.tested[0].spp} samples per pixel" if result.tested else ""
    note = (
        "Successes of the trials, in which the model is wrong on the answer and right on the clean scene with the same "
        "seed, with 95 % Clopper-Pearson intervals; * where that is verified. All models are shown the scene with the "
        f"same seeds{spp}, rounded to 8 bits."
    )
    facts = {
        "Models": ", ".join(f"{one.model} ({' x '.join(map(str, one.input_size))})" for one in result.tested),
        "Ensemble": result.ensemble or "",
        "Policy": result.policy,
        "Attacks": ", ".join(str(row.run) for row in result.table),
        "Time": wording.seconds_text(result.seconds["total"]),
        "Seed": str(result.seed),
    }
    main = element(
        "main",
        element("h2", "Attacked on, tested on"),
        table(matrix_heads(result), matrix_rows(result)),
        element("p", note, class_="soft"),
        join(element("h2", "Cost and conditions"), facts_table(facts)),
        again(result.command_line),
    )
    title = f"{', '.join(result.objects)}, {len(result.models)} models"
    header = heading(what, matrix_text(result), result.warnings)
    page = document(title, header, main, footer=f"run {run.name}. This page needs no other file.")
    return write_text(run / REPORT, page, durable=False)


def write_replay_page(result: ReplayResult) -> Path:
    """Write `report.html` into the run of a replay, and return its path.

    Raises:
        StorageError: it could not be written.
    """
    run = Path(str(result.run))
    what = f"answer of {Path(result.answer).name} ({result.answered}); {result.object}, {', '.join(result.controls)}"
    note = (
        "Trials with fresh seeds, the same under every condition, rounded to 8 bits, with 95 % Clopper-Pearson "
        "intervals. A success is what the search sought, where the clean scene is right with the same seed under the "
        "same condition."
    )
    facts = {
        "Answer": result.answer,
        "Model": result.model,
        "Environment": result.environment,
        "Renders": str(result.renders),
        "Time": wording.seconds_text(result.seconds["total"]),
        "Seed": str(result.seed),
    }
    main = element(
        "main",
        element("h2", "Under other conditions"),
        table(HEADS, replay_rows(result)),
        element("p", note, class_="soft"),
        join(element("h2", "Cost and conditions"), facts_table(facts)),
        again(result.command_line),
    )
    header = heading(what, replay_text(result), result.warnings)
    page = document(f"{run.name}, replay", header, main, footer=f"run {run.name}. This page needs no other file.")
    return write_text(run / REPORT, page, durable=False)


# ---- parts ----------------------------------------------------------------------------------------------------------


def heading(eyebrow: str, text: str, remarks: Sequence[str]) -> Html:
    """Return the header of a page: what was asked, the answer, and what has to be known beside it."""
    listed = element("ul", *(element("li", one) for one in remarks), class_="remarks") if remarks else None
    return element("header", element("p", eyebrow, class_="eyebrow"), element("h1", text), listed)


def facts_table(facts: Mapping[str, str]) -> Html:
    """Return names with their values; those that are empty are left out."""
    lines = [
        element("tr", element("th", name, scope="row"), element("td", value)) for name, value in facts.items() if value
    ]
    return element("table", element("tbody", *lines), class_="facts")


def table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> Html:
    """Return a table whose rows begin with their name."""
    head = element("tr", *(element("th", text, scope="col") for text in heads))
    lines = [
        element("tr", element("th", first, scope="row"), *(element("td", cell, class_="number") for cell in cells))
        for first, *cells in rows
    ]
    return element("div", element("table", element("thead", head), element("tbody", *lines)), class_="scroll")


def again(command_line: str) -> Html:
    """Return the command that asks the same again."""
    return join(element("h2", "Do it again"), element("pre", command_line, class_="wrap"))
