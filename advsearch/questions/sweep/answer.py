"""The result of `sweep`, which runs keep and the engine makes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

from advsearch.questions.sweep.figures import figure_size, sweep_axes
from advsearch.questions.sweep.summary import AxisRow, PairedRates, SweepSummary, WorstConfiguration
from advsearch.questions.sweep.wording import (
    DRIVE_HEADS,
    difference_text,
    distance_axes,
    distance_of,
    distance_sentence,
    drive_rows,
    drive_title,
    over_drives,
    surface_sentences,
    wrong_text,
)
from advsearch.report import wording
from advsearch.report.phrases import answer_text, beside_text, margin_text, percent
from advsearch.report.shown import AnswerPart, Claim, Column, Extent, ShownAnswer, claim, extent_of, share_text
from advsearch.runs.results.base import INTERRUPTED
from advsearch.settings import split_names

READING = "How often it is right at each value, over all others, with the 95 % interval:"

BAR = 20
"""Width of a bar in characters."""

MOST_ROWS = 24
"""Values of an axis that are all shown; of more, half as many: those where the model does worst."""


MOST_LISTED = 96
"""Values of an axis that a page lists as a table; of more, none."""

AXIS_COLUMNS: dict[str, Column] = {
    "value": lambda row: wording.value_text(row.value) + (f" {row.unit}" if row.unit not in ("", "name") else ""),
    "configurations": "{0.configurations}",
    "right": "{0.correct}",
    "accuracy": lambda row: percent(row.accuracy),
    "95 % interval": lambda row: wording.interval_text(row.interval),
}
SURFACE_COLUMNS: dict[str, Column] = {
    "middle (u, v)": "{0.u:.3f}, {0.v:.3f}",
    "place (x, y, z)": lambda one: ", ".join(f"{x:.3g}" for x in one.place),
    "face": "{0.face}",
    "wrong where seen": lambda one: wrong_text(one.seen),
    "wrong where not": lambda one: wrong_text(one.hidden),
    "difference": difference_text,
    "p": "{0.p:.2g}",
}


def shown(summary: SweepSummary) -> ShownAnswer:
    """Return accuracy in total and by axis, the worst configuration and the cost."""
    far = distance_of(summary)
    sections = [*_beside(summary), AnswerPart(text=[distance_sentence(far)]) if far else AnswerPart()]
    sections += [AnswerPart(drive_title(one), heads=DRIVE_HEADS, rows=drive_rows(one)) for one in summary.drives or ()]
    sections += _tables(summary)
    if summary.surface is not None:
        said = "\n".join(surface_sentences(summary.surface))
        sections.append(AnswerPart("What is seen of the surface when the model is wrong:", [said]))
    size = figure_size(summary)
    if size is not None:
        sections.append(AnswerPart(draw=lambda axes: sweep_axes(summary, axes), size=size, only="notebook"))
    sections += (replace(part, only="page") for part in _page_parts(summary))
    return ShownAnswer(_verdict(summary), sections, _facts(summary))


def _page_parts(summary: SweepSummary) -> Iterator[AnswerPart]:
    """What a page shows beside its explorer: from how far away, whole drives, the surface, and each axis in numbers."""
    if far := distance_of(summary):
        said = distance_sentence(far)
        yield AnswerPart("How far away it is seen", [said], draw=partial(distance_axes, far), note=said)
    for number, one in enumerate(summary.drives or ()):
        title, figure = ("Whole drives", "images/drive.png") if number == 0 else ("", "")
        yield AnswerPart(title, [drive_title(one)], heads=DRIVE_HEADS, rows=drive_rows(one), figure=figure)
    if summary.surface is not None:
        text = [" ".join(surface_sentences(summary.surface))]
        yield AnswerPart("The surface that was seen", text, figure="images/surface.png")
        for table in (one for one in summary.surface.tables if one.strongest):
            who = f"{wording.short_name(table.object)}, {wording.short_name(table.model)}"
            title = f"{who}: the {table.part}s that are told most clearly"
            yield AnswerPart.table(table.strongest, SURFACE_COLUMNS, title=title, folded=True)
    for name in dict.fromkeys(row.axis for row in summary.axes):
        rows = [row for row in summary.axes if row.axis == name]
        if len(rows) <= MOST_LISTED:
            yield AnswerPart.table(rows, AXIS_COLUMNS, title=f"Accuracy by {name}", folded=True)


def _verdict(summary: SweepSummary) -> str:
    seen, correct = summary.configurations, summary.correct
    if not seen:
        return "Interrupted before the first configuration."
    rate = f"{percent(summary.accuracy)}, 95 % interval {wording.interval_text(summary.interval)}{over_drives(summary)}"
    if summary.ending == INTERRUPTED and seen < summary.planned:
        return f"Interrupted after {seen} of {summary.planned} configurations: right in {correct} ({rate})."
    if summary.beside and summary.beside.pairs:
        return " ".join(beside_text(summary.beside.answer, pair) for pair in summary.beside.pairs)
    return f"The model is right in {correct} of {wording.count(seen, 'configuration')} ({rate})."


def _beside(summary: SweepSummary) -> list[AnswerPart]:
    if summary.beside is None or summary.ending == INTERRUPTED:
        return []
    return [AnswerPart(rows=_rates(pair, summary.beside.answer)) for pair in summary.beside.pairs]


def _rates(pair: PairedRates, answer: str) -> list[list[str]]:
    return [
        [
            name,
            f"right in {one.correct} of {one.configurations}",
            percent(one.accuracy),
            wording.interval_text(one.interval),
        ]
        for name, one in (("clean", pair.clean), (answer, pair.answer))
    ]


def _tables(summary: SweepSummary) -> list[AnswerPart]:
    by_axis: dict[str, list[AxisRow]] = {}
    for row in (one for one in summary.axes if one.axis != "answer"):
        by_axis.setdefault(row.axis, []).append(row)
    both = f"Of the clean scene and the answer together: {READING[0].lower()}{READING[1:]}"
    reading = AnswerPart(text=[both if summary.beside else READING])
    return [reading, *(_table(name, rows) for name, rows in by_axis.items())] if by_axis else []


def _table(name: str, rows: Sequence[AxisRow]) -> AnswerPart:
    listed, title = list(rows), name + (f", {rows[0].unit}" if rows[0].unit not in ("", "name", "1") else "")
    if len(rows) > MOST_ROWS:
        worst = sorted(range(len(rows)), key=lambda number: rows[number].accuracy or 0.0)[: MOST_ROWS // 2]
        listed = [rows[number] for number in sorted(worst)]
        title += f" (the {len(listed)} of {len(rows)} values where the model is right least often)"
    lines = [
        [
            wording.value_text(row.value),
            "#" * (filled := round((row.accuracy or 0.0) * BAR)) + "." * (BAR - filled),
            percent(row.accuracy),
            f"{row.correct} of {row.configurations}",
            wording.interval_text(row.interval),
        ]
        for row in listed
    ]
    return AnswerPart(title, rows=lines)


def _facts(summary: SweepSummary) -> dict[str, str]:
    worst = summary.worst
    return {
        "worst": _configuration(worst) if worst else "",
        "there": _said(worst, summary.task) if worst else "",
        "renders": str(summary.renders["sweep"]),
        "worst drive": f"{summary.run}/images/drive.webp" if summary.drives and summary.run else "",
        "map of the surface": f"{summary.run}/images/surface.png" if summary.surface else "",
    }


def _configuration(worst: WorstConfiguration) -> str:
    outer = ("object", "environment", "model")
    names = [f"{name} {wording.value_text(one.value)}" for name, one in worst.values.items() if name not in outer]
    return ", ".join(
        [*(wording.short_name(worst.values[name].value) for name in outer if name in worst.values), *names]
    )


def _said(worst: WorstConfiguration, task: str) -> str:
    claim, checked = worst.claimed, worst.verified
    text = f"answer {answer_text(task, claim)}"
    rate = f"wrong in {wording.rate_text(checked)}" if checked else "not verified"
    return f"{text}; margin ({margin_text(task)}) {claim.margin:.3g}; {rate}"


def claims(result: SweepSummary) -> Iterator[Claim]:
    """Yield the share of right answers, and how often the worst of the configurations is wrong."""
    if result.accuracy is None or result.interval is None or result.ending != "finished":
        return
    extent = Extent(
        what="configurations in which the model is right",
        count=result.correct,
        total=result.configurations,
        interval=result.interval,
    )
    thing = "configurations"
    if result.drives:
        thing = f"frames of {result.drives[0].drives} drives"
    how = f"{thing} drawn by chance from the ranges that are named"
    note = ""
    if result.sampler is None and not result.grid:
        how = thing
        note = " How these were chosen is not known; the interval takes them as a sample."
    elif result.sampler is None:
        how = "points of the grid" if not result.drives else f"{thing}, whose ways and moments are given"
        note = " Nothing is said of what lies between or beside these points; the interval takes them as a sample."
    elif result.drives:  # the frames are the grid, and what a drive has besides is drawn
        how = f"{thing}; what else differs between drives is drawn by the sampler {result.sampler}"
        note = " The interval is over drives, as if these were independent." * (result.sampler != "random")
    elif result.sampler != "random" or result.grid:
        how = f"configurations drawn by the sampler {result.sampler}" + (" at each point of a grid" * bool(result.grid))
        note = " The interval is that of independent draws, which these are not."
    models = [row for row in result.axes if row.axis == "model"]
    if len(split_names(result.model)) < 2 or not models:
        how += _in_each(result)
        yield claim("measured", f"The model is right in {share_text(extent)} {how}.{note}", extent)
    for row in models:  # they are shown the same pictures, so that answers of several are not independent
        own = Extent(what=extent.what, count=row.correct, total=row.configurations, interval=row.interval or (0.0, 1.0))
        yield claim(
            "measured", f"The model {row.value} is right in {share_text(own)} {how}{_in_each(result)}.{note}", own
        )
    worst = result.worst.verified if result.worst else None
    if worst is not None:
        text = f"In the worst of these configurations the model is wrong in {wording.rate_text(worst)}."
        yield claim("measured", f"{text} No search looked for a worse one.", extent_of("wrong", worst))


def _in_each(result: SweepSummary) -> str:
    """That there are as many in each of several objects and environments, which are not drawn."""
    several = {name: sum(row.axis == name for row in result.axes) for name in ("object", "environment")}
    each = [f"each of the {count} {name}s" for name, count in several.items() if count > 1]
    return f", as many in {' and '.join(each)}" if each else ""
