"""The matrix of several models in words and tables."""

from __future__ import annotations

from advsearch.report import wording
from advsearch.runs.results.matrix import MatrixCell, MatrixResult


def matrix_text(result: MatrixResult) -> str:
    """Return what the matrix says, in a sentence."""
    pairs = [(row, cell) for row in result.table for cell in row.tested]
    if not pairs:
        return "No answer was tried on any model."
    if result.ensemble is not None:
        held = sum(cell.ending == "found" for _, cell in pairs)
        return f"One answer to all models together misleads {held} of {len(pairs)}."
    own = [cell for row, cell in pairs if cell.model == row.attacked]
    others = [cell for row, cell in pairs if cell.model != row.attacked]
    held, passed = (sum(cell.ending == "found" for cell in cells) for cells in (own, others))
    return (
        f"{held} of {len(own)} answers hold on the model that they were searched on; "
        f"{passed} of {len(others)} on another one."
    )


def matrix_heads(result: MatrixResult) -> list[str]:
    """Return the names of the columns."""
    return ["attacked on", "ending", *(f"tested on {wording.short_name(one.model)}" for one in result.tested)]


def matrix_rows(result: MatrixResult) -> list[list[str]]:
    """Return a row for the clean scene, and one for each answer: successes and their interval."""
    rows = []
    if result.tested:
        clean = [one.clean for one in result.tested]
        counts = [f"right {one.correct}/{one.trials}{wording.no_numbers(one.not_a_number)}" for one in clean]
        right = [f"{n}, {wording.interval_text(one.interval)}" for n, one in zip(counts, clean, strict=True)]
        rows.append(["clean scene", "", *right])
    for row in result.table:
        rows.append([wording.short_name(row.attacked), row.ending, *map(_cell, row.tested)])
    return rows


def _cell(cell: MatrixCell) -> str:
    rated = cell.verified
    mark = " *" if cell.ending == "found" else " (wrong already)" if cell.ending == "already wrong" else ""
    rate = f"{rated.successes}/{rated.trials}{wording.no_numbers(rated.not_a_number)}"
    return f"{rate}, {wording.interval_text(rated.interval)}{mark}"
