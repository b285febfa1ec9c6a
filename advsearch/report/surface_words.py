"""What `sweep --surface` found, in sentences: for the table, the page, and those who cannot see the figure."""

from __future__ import annotations

from typing import TYPE_CHECKING

from advsearch.report.wording import count, short_name

if TYPE_CHECKING:
    from advsearch.runs.results.sweep import CountedAnswers, SurfaceMap, SurfacePart, SurfaceTable


def surface_sentences(surface: SurfaceMap) -> list[str]:
    """Return what the map of each object and model says, a sentence or two each."""
    return [_sentence(table, surface.least) for table in surface.tables if table.part == "cell"]


def _sentence(table: SurfaceTable, least: int) -> str:
    who, cells = f"{short_name(table.object)}, {short_name(table.model)}", count(table.compared, table.part)
    if not table.compared:
        return f"{who}: no {table.part} was seen in {least} pictures and hidden in as many, so nothing is compared."
    if not table.worse + table.better:
        return f"{who}: none of {cells} that were compared is told from chance."
    said = (
        f"{who}: of {cells} that were compared, {table.worse} go with wrong answers and {table.better} with right ones."
    )
    if not table.strongest:
        return said
    first = table.strongest[0]
    where = f"The clearest, at u {first.u:.2f} and v {first.v:.2f}"
    return f"{said} {where}: wrong in {wrong_text(first.seen)} that see it, {wrong_text(first.hidden)} that do not."


def wrong_text(counted: CountedAnswers) -> str:
    """Return ``35 of 40``: wrong answers among all."""
    return f"{counted.configurations - counted.correct} of {counted.configurations}"


def difference_text(part: SurfacePart) -> str:
    """Return ``+83 % (+66 % to +91 %)``."""
    low, high = part.interval
    return f"{part.difference:+.0%} ({low:+.0%} to {high:+.0%})".replace("%", " %")
