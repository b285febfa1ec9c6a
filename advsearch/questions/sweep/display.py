"""What is shown and claimed of the result of `sweep`: shares, drives, the surface, and
from how far away it is seen.

How far away a detector sees an object is the distance at which half of a sweep's
pictures show it: where the falling line through the shares (isotonic regression, Ayer
et al. 1955, linear in the logarithm of the distance) crosses one half. Its interval is
exact: each of m shares is judged by the binomial test of one half at 0.025 / m on each
side.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from advsearch.errors import InputError
from advsearch.options import Outcome
from advsearch.questions.sweep.settings import BLIND, HARMLESS
from advsearch.questions.sweep.summary import (
    AxisRow,
    DriveRates,
    OverDrives,
    SurfaceMap,
    SurfacePart,
    SweepMap,
    SweepSummary,
)
from advsearch.report import wording
from advsearch.report.figures import (
    ACCURACY,
    BLUE,
    GREY,
    MARGIN,
    MOST_POINTS,
    Figures,
    axis_title,
    figure_of,
    heat,
)
from advsearch.report.views import (
    Claim,
    Column,
    Extent,
    ResultPart,
    ShownResult,
    claim,
    counted,
    extent_of,
    share_text,
)
from advsearch.report.wording import (
    beside_text,
    count,
    margin_text,
    percent,
    prediction_text,
    short_name,
)
from advsearch.runs.results import INTERRUPTED, CountedPredictions
from advsearch.settings import split_names
from advsearch.statistics.monotone import Dip, _fit_falling, find_dips

# ---- The figure of a sweep: a map over two axes, or the accuracy over the only one
# ----------------------------------

MOST_TICKS = 16  # values of an axis that are written


def figure_size(summary: SweepSummary) -> tuple[float, float] | None:
    """Return width and height of a sweep's figure in inches, with room for the names of
    a map's values, those below aslant where they are long; None where there is neither
    a map nor one axis.
    """
    if not summary.cells:
        return (5.6, 3.6) if _only_axis(summary) else None
    (wide, below), (high, beside) = (
        (min(len(axis.values), MOST_TICKS), max(map(len, _ticks(axis.values)[1])))
        for axis in summary.cells.axes
    )
    aslant = below if _long(summary.cells.axes[0].values) else 0
    return 3.2 + 0.34 * wide + 0.09 * max(
        beside - 8, aslant - 8, 0
    ), 1.8 + 0.3 * high + 0.065 * max(aslant - 8, 0)


def sweep_figure(summary: SweepSummary) -> Figures:
    """Draw a sweep: a map over two axes, or the accuracy over the only one; nothing
    where there is none.

    A cell shows the accuracy there; where no cell has more than one configuration, the
    margin.
    """
    size = figure_size(summary)
    return (
        {} if size is None else figure_of(lambda axes: sweep_axes(summary, axes), size)
    )


def sweep_axes(summary: SweepSummary, axes: Any) -> None:
    """Draw a sweep on matplotlib axes, as `sweep_figure` does; nothing where there is
    neither a map nor one axis.
    """
    if summary.cells:
        _cells(axes, summary, summary.cells)
    elif _only_axis(summary):
        _along(axes, summary, _only_axis(summary))


def _only_axis(summary: SweepSummary) -> Sequence[AxisRow]:
    """The values of the only axis of a sweep; none where there are more, or too many
    values.
    """
    rows = [
        row for row in summary.axes if not isinstance(row.value, (list, tuple))
    ] or summary.axes
    return (
        rows
        if len({row.axis for row in rows}) == 1 and len(rows) <= MOST_POINTS
        else ()
    )


def _cells(axes: Any, summary: SweepSummary, cells: SweepMap) -> None:
    first, second = cells.axes
    seen = cells.configurations
    correct = cells.correct
    margin = cells.margin
    extent = (-0.5, len(first.values) - 0.5, -0.5, len(second.values) - 0.5)
    labels = axis_title(first.axis, first.unit), axis_title(second.axis, second.unit)
    several = max(map(max, seen)) > 1
    counts = np.array(seen, dtype=float)
    values = np.array(margin, dtype=float)
    if several:
        values = np.divide(
            correct, counts, out=np.full(counts.shape, np.nan), where=counts > 0
        )
    heat(axes, values.tolist(), extent, ACCURACY if several else MARGIN, *labels)
    axes.set_xticks(*_ticks(first.values), rotation=45 if _long(first.values) else 0)
    axes.set_yticks(*_ticks(second.values))
    more = len(cells.over)
    over = f", over {more} more {'axes' if more > 1 else 'axis'}" if more else ""
    axes.set_title(f"{_who(summary)}{over}")


def _along(axes: Any, summary: SweepSummary, rows: Sequence[AxisRow]) -> None:
    at = range(len(rows))
    accuracy = [row.accuracy for row in rows]
    # of one draw there is none
    intervals = [
        (place, *row.interval) for place, row in enumerate(rows) if row.interval
    ]
    if intervals:
        axes.vlines(
            *zip(*intervals, strict=True),
            color=BLUE,
            alpha=0.35,
            linewidth=5,
            label="95 % interval",
        )
    axes.plot(at, accuracy, "o", color=BLUE, label="accuracy")
    axes.set_xticks(
        *_ticks([row.value for row in rows]),
        rotation=45 if _long([r.value for r in rows]) else 0,
    )
    axes.set(
        xlabel=axis_title(rows[0].axis, rows[0].unit),
        ylabel="accuracy",
        ylim=(-0.03, 1.03),
    )
    axes.margins(x=0.08)
    axes.set_title(_who(summary))
    axes.grid(True, axis="y")
    axes.figure.legend(loc="outside lower center", ncols=2)


def _ticks(values: Sequence[Any]) -> tuple[list[int], list[str]]:
    def name(value: Any) -> str:
        if isinstance(value, (list, tuple)):
            return " to ".join(f"{end:.3g}" for end in value)
        return short_name(value) if isinstance(value, str) else f"{value:.4g}"

    places = list(range(0, len(values), -(-len(values) // MOST_TICKS)))
    return places, [name(values[place]) for place in places]


def _who(summary: SweepSummary) -> str:
    return ", ".join(
        short_name(name)
        for name in (*split_names(summary.object), *split_names(summary.model))
    )


def _long(values: Sequence[Any]) -> bool:
    return sum(len(text) + 1 for text in _ticks(values)[1]) > 50


READING = (
    "How often it is right at each value, over all others, with the 95 % interval:"
)
BAR = 20  # width of a bar in characters
# values of an axis that are all shown; of more, half as many: those where the model
# does worst
MOST_ROWS = 24
MOST_LISTED = 96  # values of an axis that a page lists as a table; of more, none


def _difference(part: SurfacePart) -> str:
    low, high = part.interval
    # none where pictures share draws
    interval = f" ({low:+.0%} to {high:+.0%})" if low == low else ""
    return f"{part.difference:+.0%}{interval}".replace("%", " %")


AXIS_COLUMNS: dict[str, Column] = {
    "value": lambda row: (
        wording.value_text(row.value)
        + (f" {row.unit}" if row.unit not in ("", "name") else "")
    ),
    "configurations": "{0.configurations}",
    "right": "{0.correct}",
    "accuracy": lambda row: percent(row.accuracy),
    "95 % interval": lambda row: wording.interval_text(row.interval),
}
CHANGED = "Shown again, changed:"
CHANGE_COLUMNS: dict[str, Column] = {
    "model": "{0.model}",
    "what it says": lambda one: one.claim.replace("_", " "),
    "when": lambda one: (BLIND | HARMLESS)[one.when],
    "as claimed": "{0.correct} of {0.configurations}",
    "95 % interval": lambda one: wording.interval_text(one.interval),
}
SURFACE_COLUMNS: dict[str, Column] = {
    "middle (u, v)": "{0.u:.3f}, {0.v:.3f}",
    "place (x, y, z)": lambda one: ", ".join(f"{x:.3g}" for x in one.place),
    "face": "{0.face}",
    "wrong where seen": lambda one: wrong_text(one.seen),
    "wrong where not": lambda one: wrong_text(one.hidden),
    "difference": _difference,
    "p": "{0.p:.2g}",
}


def shown(summary: SweepSummary) -> ShownResult:
    sections = list[ResultPart]()
    if summary.beside is not None and summary.ending != INTERRUPTED:
        for pair in summary.beside.pairs:
            sides = (("clean", pair.clean), (summary.beside.answer, pair.answer))
            rows = [
                [
                    name,
                    f"right in {side.correct} of {side.configurations}",
                    *_share(side),
                ]
                for name, side in sides
            ]
            if any(side.outcomes for _, side in sides):
                outcomes = [
                    wording.outcomes_text(side.outcomes, summary.task)
                    for _, side in sides
                ]
                rows = [[*row, text] for row, text in zip(rows, outcomes, strict=True)]
            sections.append(ResultPart(rows=rows))
    if far := distance_of(summary):
        sections.append(ResultPart(text=[distance_sentence(far)]))
    sections += [
        ResultPart(drive_title(rates), heads=DRIVE_HEADS, rows=drive_rows(rates))
        for rates in summary.drives or ()
    ]
    sections.append(
        ResultPart.table(summary.changes or [], CHANGE_COLUMNS, title=CHANGED)
    )
    axes: dict[str, list[AxisRow]] = {}
    for row in summary.axes:
        axes.setdefault(row.axis, []).append(row)
    if axes.keys() - {"answer"}:
        both = (
            "Of the clean scene and the adversarial one together: "
            f"{READING[0].lower()}{READING[1:]}"
        )
        sections.append(ResultPart(text=[both if summary.beside else READING]))
        sections += [
            _table(name, rows, summary.task)
            for name, rows in axes.items()
            if name != "answer"
        ]
    if summary.surface is not None:
        said = "\n".join(surface_sentences(summary.surface))
        sections.append(
            ResultPart("What is seen of the surface when the model is wrong:", [said])
        )
    if (size := figure_size(summary)) is not None:
        sections.append(
            ResultPart(
                draw=lambda axes: sweep_axes(summary, axes), size=size, only="notebook"
            )
        )
    sections += (replace(part, only="page") for part in _page_parts(summary, axes))
    configuration = there = ""
    if (worst := summary.worst) is not None:
        outer = [
            name for name in ("object", "environment", "model") if name in worst.values
        ]
        named = [short_name(worst.values[name].value) for name in outer]
        values = {
            name: wording.value_text(one.value)
            for name, one in worst.values.items()
            if name not in outer
        }
        configuration = ", ".join(
            [*named, *(f"{name} {value}" for name, value in values.items())]
        )
        rate = (
            f"wrong in {wording.rate_text(worst.verified)}"
            if worst.verified
            else "not verified"
        )
        margin = f"margin ({margin_text(summary.task)}) {worst.claimed.margin:.3g}"
        there = (
            f"prediction {prediction_text(summary.task, worst.claimed)}; "
            f"{margin}; "
            f"{rate}"
        )
    facts = {
        "worst": configuration,
        "there": there,
        "renders": str(summary.renders["sweep"]),
        "worst drive": f"{summary.run}/images/drive.webp"
        if summary.drives and summary.run
        else "",
        "map of the surface": f"{summary.run}/images/surface.png"
        if summary.surface
        else "",
    }
    counted = summary.configurations > 0
    ended_early = (
        not summary.out_of_view if not counted else summary.looked_at < summary.planned
    )
    return ShownResult(_verdict(summary), sections, facts, says_interrupted=ended_early)


def _page_parts(
    summary: SweepSummary, axes: Mapping[str, Sequence[AxisRow]]
) -> Iterator[ResultPart]:
    """What a page shows beside its explorer: from how far away, whole drives, the
    surface, and each axis in numbers.
    """
    if far := distance_of(summary):
        said = distance_sentence(far)
        yield ResultPart(
            "How far away it is seen",
            [said],
            draw=partial(distance_axes, far),
            note=said,
        )
    for number, one in enumerate(summary.drives or ()):
        title, figure = (
            ("Whole drives", "images/drive.png") if number == 0 else ("", "")
        )
        yield ResultPart(
            title,
            [drive_title(one)],
            heads=DRIVE_HEADS,
            rows=drive_rows(one),
            figure=figure,
        )
    yield ResultPart.table(summary.changes or [], CHANGE_COLUMNS, title=CHANGED)
    if summary.surface is not None:
        text = [" ".join(surface_sentences(summary.surface))]
        yield ResultPart("The surface that was seen", text, figure="images/surface.png")
        for table in (one for one in summary.surface.tables if one.strongest):
            who = f"{short_name(table.object)}, {short_name(table.model)}"
            title = f"{who}: the {table.part}s that are told most clearly"
            yield ResultPart.table(
                table.strongest, SURFACE_COLUMNS, title=title, folded=True
            )
    for name, rows in axes.items():
        if len(rows) <= MOST_LISTED:
            columns = dict(AXIS_COLUMNS)
            if any(row.outcomes for row in rows):
                columns["the others"] = lambda row: wording.outcomes_text(
                    row.outcomes, summary.task
                )
            yield ResultPart.table(
                rows, columns, title=f"Accuracy by {name}", folded=True
            )


def _verdict(summary: SweepSummary) -> str:
    seen = summary.configurations
    correct = summary.correct
    if summary.out_of_view and not seen:
        return "The object is in no picture."
    if not seen:
        return "Interrupted before the first configuration."
    rate = rate_text(summary)
    if summary.ending == INTERRUPTED and summary.looked_at < summary.planned:
        looked_at = f"{summary.looked_at} of {summary.planned} configurations"
        return (
            f"Interrupted after {looked_at}: right in {correct} "
            f"({rate}){outcomes_clause(summary)}."
        )
    if summary.beside and summary.beside.pairs:
        return " ".join(
            beside_text(summary.beside.answer, pair) for pair in summary.beside.pairs
        )
    outcomes = outcomes_clause(summary)
    return (
        f"The model is right in {correct} of {count(seen, 'configuration')} "
        f"({rate}){of_grid(summary)}{outcomes}."
    )


def outcomes_clause(summary: SweepSummary) -> str:
    """Return what becomes of the object in the other configurations, as the end of a
    sentence; empty where only a prediction is known.
    """
    text = wording.outcomes_text(summary.outcomes, summary.task)
    return f"; of the others, {text}" if text else ""


def of_grid(summary: SweepSummary) -> str:
    """Return what has to be said of the share over a grid, where nothing is drawn."""
    return (
        ""
        if summary.sampler is not None or not summary.grid
        else " of this grid; another has another share"
    )


def _share(counts: CountedPredictions) -> tuple[str, str]:
    return percent(counts.accuracy), wording.interval_text(counts.interval)


def _table(name: str, rows: Sequence[AxisRow], task: str) -> ResultPart:
    listed = list(rows)
    title = name + (
        f", {rows[0].unit}" if rows[0].unit not in ("", "name", "1") else ""
    )
    if len(rows) > MOST_ROWS:
        worst = sorted(
            range(len(rows)), key=lambda number: rows[number].accuracy or 0.0
        )[: MOST_ROWS // 2]
        listed = [rows[number] for number in sorted(worst)]
        title += (
            f" (the {len(listed)} of {len(rows)} values where the model is right "
            "least often)"
        )
    has_outcomes = any(row.outcomes for row in rows)
    lines = []
    for row in listed:
        bar = ("#" * round((row.accuracy or 0.0) * BAR)).ljust(BAR, ".")
        share, interval = _share(row)
        cells = [
            wording.value_text(row.value),
            bar,
            share,
            f"{row.correct} of {row.configurations}",
            interval,
        ]
        lines.append(
            [*cells, wording.outcomes_text(row.outcomes, task)]
            if has_outcomes
            else cells
        )
    return ResultPart(title, rows=lines)


def claims(result: SweepSummary) -> Iterator[Claim]:
    """Yield the share of right predictions, and how often the worst of the
    configurations is wrong.
    """
    if result.accuracy is None or result.ending != "finished":
        return
    thing = (
        f"frames of {result.drives[0].drives} drives"
        if result.drives
        else "configurations"
    )
    how = f"{thing} drawn by chance from the ranges that are named"
    note = ""
    if result.sampler is None and not result.grid:
        how = thing
        note = (
            " How these were chosen is not known; the interval takes them as a sample."
        )
    elif result.sampler is None:
        how = (
            "points of the grid"
            if not result.drives
            else (f"{thing}, whose ways and moments are given")
        )
        note = (
            " Nothing is said of what lies between or beside these points, and another "
            "grid gives another share; the "
            "interval takes them as a sample."
        )
    elif (
        result.drives
    ):  # the frames are the grid, and what a drive has besides is drawn
        how = (
            f"{thing}; what else differs between drives is drawn at random "
            f"({result.sampler})"
        )
        note = " The interval is over drives, as if these were independent." * (
            result.sampler != "random"
        )
    elif result.sampler != "random" or result.grid:
        how = f"configurations drawn at random ({result.sampler})" + (
            " at each point of a grid" * bool(result.grid)
        )
        note = " The interval is that of independent draws, which these are not."
    if result.beside:
        for pair in result.beside.pairs:  # the share of both together is of neither
            adversarial = f"the adversarial scene of {result.beside.answer}"
            for what, counts in (
                ("the clean scene", pair.clean),
                (adversarial, pair.answer),
            ):
                own = _extent(
                    f"configurations of {what} in which {pair.model} is right", counts
                )
                yield claim(
                    "measured",
                    f"With {what} {pair.model} is right in "
                    f"{share_text(own)} {how}.{note}",
                    own,
                )
            yield claim("measured", beside_text(result.beside.answer, pair), None)
    if result.beside and result.beside.pairs:
        return
    several = {
        name: sum(row.axis == name for row in result.axes)
        for name in ("object", "environment")
    }
    # which are not drawn
    each = [
        f"each of the {count} {name}s" for name, count in several.items() if count > 1
    ]
    how += f", as many in {' and '.join(each)}" if each else ""
    # models are shown the same pictures, so that predictions of several are not
    # independent
    models: dict[str, CountedPredictions] = {
        f"The model {row.value}": row for row in result.axes if row.axis == "model"
    }
    for who, counts in (
        models
        if len(split_names(result.model)) > 1 and models
        else {"The model": result}
    ).items():
        extent = _extent("configurations in which the model is right", counts)
        outcomes = wording.outcomes_text(counts.outcomes, result.task)
        others = f" Of the others: {outcomes}." if outcomes else ""
        yield claim(
            "measured",
            f"{who} is right in {share_text(extent)} {how}.{others}{note}",
            extent,
        )
    if far := distance_of(result):
        yield claim("measured", distance_sentence(far), None)
    for drive in result.drives or ():
        told = [
            f"{name}: {mean}{'' if ends == '-' else f' (95 % interval {ends})'}, "
            f"{least}"
            for name, mean, ends, least in drive_rows(drive)
        ]
        heads = "mean, with its interval over drives, then the worst drive"
        yield claim(
            "measured", f"{drive_title(drive)} ({heads}): {'; '.join(told)}.", None
        )
    worst = result.worst.verified if result.worst else None
    if worst is not None:
        text = (
            "In the worst of these configurations the model is wrong in "
            f"{wording.rate_text(worst)}."
        )
        yield claim(
            "measured",
            f"{text} No search looked for a worse one.",
            extent_of("wrong", worst),
        )


def _extent(what: str, counts: CountedPredictions) -> Extent:
    return counted(
        what, counts.correct, counts.configurations, counts.interval, counts.accuracy
    )


DRIVE_HEADS = ("", "mean", "95 % interval", "worst drive")  # what stands above the rows


def rate_text(summary: SweepSummary) -> str:
    """Return the share of right predictions with its interval, and what that is over
    where there are drives.
    """
    over = ", over drives" if summary.drives else ""
    return (
        f"{percent(summary.accuracy)}, 95 % interval "
        f"{wording.interval_text(summary.interval)}{over}"
    )


def drive_title(one: DriveRates) -> str:
    repeats = f", {one.repeats} times each with other noise" if one.repeats > 1 else ""
    what = (
        f"{count(one.drives, 'drive')} of {one.frames} frames in {one.seconds:g} "
        f"s{repeats}, {one.model}"
    )
    return what if one.answer is None else f"{what}, with {one.answer}"


def drive_rows(one: DriveRates) -> list[tuple[str, str, str, str]]:
    tracks = one.tracks
    never = f", never in {one.never_seen}" if one.never_seen else ""
    told: list[tuple[str, OverDrives | None, str, str]] = [
        ("frames in which it is right", one.right, " %", ""),
        ("first right at a distance of", one.first_seen, f" {one.unit}", never),
        ("longest gap", one.longest_gap, " s", ""),
        ("changes a second", one.flicker, "", ""),
        ("frames without its track", tracks.lost if tracks else None, " %", ""),
        (
            "frames with a loose track instead",
            tracks.loose if tracks else None,
            " %",
            "",
        ),
        ("identity switches", tracks.switches if tracks else None, "", ""),
        ("longest gap of its track", tracks.longest_gap if tracks else None, " s", ""),
    ]
    rows = []
    for name, number, unit, more in told:
        if number is not None:
            factor = 100.0 if unit == " %" else 1.0
            (low, high) = number.interval or (0.0, 0.0)
            interval = (
                f"{low * factor:.3g} to {high * factor:.3g}{unit}"
                if number.interval
                else "-"
            )
            rows.append(
                (
                    name,
                    f"{number.mean * factor:.3g}{unit}{more}",
                    interval,
                    f"{number.worst * factor:.3g}{unit}",
                )
            )
    return rows


def surface_sentences(surface: SurfaceMap) -> list[str]:
    sentences = []
    for table in (table for table in surface.tables if table.part == "cell"):
        cells = count(table.compared, table.part)
        least = surface.least
        said = (
            f"of {cells} that were compared, {table.worse} go with wrong "
            f"predictions and {table.better} with right"
        )
        said += " ones."
        if not table.compared:
            said = (
                f"no {table.part} was seen in {least} pictures and hidden in as "
                "many, so nothing is compared."
            )
        elif not table.worse + table.better:
            said = f"none of {cells} that were compared is told from chance."
        elif table.strongest:
            first = table.strongest[0]
            said += (
                f" The clearest, at u {first.u:.2f} and v {first.v:.2f}: wrong in "
                f"{wrong_text(first.seen)} that see"
            )
            said += f" it, {wrong_text(first.hidden)} that do not."
        sentences.append(
            f"{short_name(table.object)}, {short_name(table.model)}: {said}"
        )
    return sentences


def wrong_text(counted: CountedPredictions) -> str:
    return f"{counted.configurations - counted.correct} of {counted.configurations}"


DISTANCE = "camera.distance"  # the axis
HALF = 0.5


@dataclass(frozen=True)
class SeenFrom:
    """The distance at which an object is first seen by somebody who comes nearer.

    Attributes:
        unit: "metres" or "object sizes".
        distances: (m,) at which there are pictures, the nearest first.
        shares: (m,) of the pictures that are right.
        intervals: (m,) theirs, 95 %.
        distance: the estimate; None where it is seen at all distances, or at none. Of a
            share that does not fall with the distance the last one: beyond the dips
            that are shown.
        low: lower end of its interval; None where pictures do not bound it.
        high: upper end, likewise.
        lacking: how many pictures at a distance any bound takes, where none has so
            many.
        loose: (m,) pictures in which a loose box is on it, which are not right, and no
            misses either; empty where nothing is known of them.
        counts: (m,) pictures.
        dips: distances at which it is seen less often than beyond them, the nearest
            first.
        everywhere: whether the falling line nowhere crosses one half, for it is seen in
            that much at all distances.
    """

    unit: str
    distances: tuple[float, ...]
    shares: tuple[float, ...]
    intervals: tuple[tuple[float, float], ...]
    distance: float | None
    low: float | None
    high: float | None
    lacking: int | None
    loose: tuple[int, ...] = ()
    counts: tuple[int, ...] = ()
    dips: tuple[Dip, ...] = ()
    everywhere: bool = False

    @property
    def is_monotone(self) -> bool:
        """Whether no dip is shown."""
        return not any(dip.is_shown for dip in self.dips)


def distance_of(summary: SweepSummary) -> SeenFrom | None:
    """Return how far away one model sees one object; None where the sweep does not
    tell.
    """
    rows = [row for row in summary.axes if row.axis == DISTANCE and row.configurations]
    several = (
        "," in summary.object or "," in summary.model or summary.beside is not None
    )
    # frames of a drive are not independent, nor are samples of a point where nothing is
    # drawn
    several = several or summary.drives is not None or summary.units is not None
    known = (
        summary.task.partition("=")[0] == "detection" and len(rows) > 1 and not several
    )
    return seen_from(rows) if known else None


def seen_from(rows: Sequence[AxisRow]) -> SeenFrom:
    """Return the distance at which an object is first seen, from the rows of one axis:
    a distance, or both ends of a range of it, and the counts there. Raises InputError
    where there are fewer than two distances.
    """
    from scipy.special import bdtr, bdtrc  # takes a tenth of a second

    if len(rows) < 2:
        raise InputError(
            "detection distance: expected at least two distances, got "
            f"{len(rows)}; sweep over more"
        )
    middles = [
        math.sqrt(math.prod(row.value))
        if isinstance(row.value, tuple)
        else float(row.value)
        for row in rows
    ]
    distances, rows = zip(
        *sorted(zip(middles, rows, strict=True), key=lambda pair: pair[0]), strict=True
    )
    at, k, n = (
        np.array(column)
        for column in (
            distances,
            [r.correct for r in rows],
            [r.configurations for r in rows],
        )
    )
    chance = 0.025 / len(rows)
    low = max(at[bdtrc(k - 1.0, n, HALF) < chance], default=None)
    high = min(
        at[(bdtr(k * 1.0, n, HALF) < chance) & (at > (low or 0.0))], default=None
    )
    dips = find_dips(distances, k, n)
    first = max(
        (distances.index(dip.distance) + 1 for dip in dips if dip.is_shown), default=0
    )
    least = math.floor(-math.log2(chance)) + 1
    outcomes = [getattr(row, "outcomes", None) or {} for row in rows]
    falling = _fit_falling(k[first:], n[first:])
    crosses = bool(falling[0] >= HALF > falling[-1])
    return SeenFrom(
        unit=rows[0].unit,
        distances=distances,
        shares=tuple((k / n).tolist()),
        intervals=tuple(row.interval or (0.0, 1.0) for row in rows),
        distance=float(np.exp(np.interp(-HALF, -falling, np.log(at[first:]))))
        if crosses
        else None,
        low=None if low is None else float(low),
        high=None if high is None else float(high),
        lacking=None if (n >= least).any() else least,
        loose=tuple(one.get(Outcome.LOOSE.value, 0) for one in outcomes)
        if any(outcomes)
        else (),
        counts=tuple(n.tolist()),
        dips=dips,
        everywhere=bool(falling[-1] >= HALF),
    )


def distance_sentence(found: SeenFrom) -> str:
    """Say it: "Seen from 38 m, 31 to 44 m ...", then what contradicts it, and the loose
    boxes.
    """
    unit = "m" if found.unit == "metres" else found.unit
    low, high, distance = (
        None if number is None else f"{number:.3g}"
        for number in (found.low, found.high, found.distance)
    )
    ends = "no bound"
    if low and high:
        ends = f"{low} to {high} {unit}"
    elif low or high:
        ends = f"at least {low} {unit}" if low else f"at most {high} {unit}"
    what = f"{ends} with 95 % confidence"
    what += (
        ""
        if found.lacking is None
        else (f" (that takes at least {found.lacking} pictures at each distance)")
    )
    dips = _dips_sentences(found, unit)
    loose = _loose_sentence(found, unit)
    if not found.is_monotone:
        beyond = "Beyond that it is right in less than half of the pictures"
        if distance is not None:
            beyond = f"Beyond that the share falls below a half at {distance} {unit}"
        elif found.everywhere:
            beyond = (
                "Beyond that it is right in at least half of the pictures, up to "
                f"{found.distances[-1]:.3g} {unit}"
            )
        return " ".join(filter(None, [*dips, f"{beyond}; {what}.", loose]))
    if distance is not None:
        said = f"Seen from {distance} {unit} in half of the pictures, {what}."
    elif found.everywhere:
        farthest = f"{found.distances[-1]:.3g} {unit}"
        said = (
            "Seen in at least half of the pictures up to the farthest distance, "
            f"{farthest}; {what}."
        )
    else:
        said = (
            f"Not seen in half of the pictures, even from {found.distances[0]:.3g} "
            f"{unit}; {what}."
        )
    return " ".join(filter(None, [said, *dips, loose]))


def _dips_sentences(found: SeenFrom, unit: str) -> list[str]:
    """Say where it is seen less often than beyond: what is shown, or else the deepest
    of what may be chance.
    """

    def text(dip: Dip) -> str:
        here = f"{dip.seen[0]} of {dip.seen[1]} at {dip.distance:.3g} {unit}"
        beyond = (
            f"{dip.beyond[0]} of {dip.beyond[1]} beyond it up to {dip.until:.3g} {unit}"
        )
        return f"{here}, {beyond} (p = {dip.p:.2g})"

    shown = [dip for dip in found.dips if dip.is_shown]
    if shown:
        return [
            "No one distance from which on it is seen: right in "
            f"{'; '.join(map(text, shown))}."
        ]
    until = found.distances[-1] if found.everywhere else found.distance or 0.0
    below_half = [
        dip
        for dip in found.dips
        if dip.seen[0] < HALF * dip.seen[1]
        # a rise beyond the estimate counts too
        and (dip.distance < until or dip.beyond[0] >= HALF * dip.beyond[1])
    ]
    if not below_half:
        return []
    deepest = min(below_half, key=lambda dip: dip.p)
    return [f"Nearer it is right less often: in {text(deepest)}, which may be chance."]


def _loose_sentence(found: SeenFrom, unit: str) -> str:
    """Say in how many pictures a loose box is on it, and at which distances; empty
    where nothing is known of it.
    """
    total = sum(found.loose)
    if not total:
        return ""
    each = zip(found.distances, found.loose, found.counts, strict=True)
    listed = [
        f"{loose} of {count} at {at:.3g} {unit}" for at, loose, count in each if loose
    ]
    return (
        "Not counted as seen, but not missed either, are loose boxes: "
        f"{', '.join(listed)}."
    )


def distance_axes(found: SeenFrom, axes: Any) -> None:
    """Draw the share of pictures in which it is seen over the distance on matplotlib
    axes, with intervals.
    """
    low, high = zip(*found.intervals, strict=True)
    axes.fill_between(
        found.distances,
        low,
        high,
        color=BLUE,
        alpha=0.15,
        linewidth=0,
        label="95 % interval",
    )
    axes.plot(found.distances, found.shares, color=BLUE, marker="o", label="seen in")
    if any(found.loose):
        or_loosely = [
            share + loose / count
            for share, loose, count in zip(
                found.shares, found.loose, found.counts, strict=True
            )
        ]
        axes.plot(
            found.distances,
            or_loosely,
            color=GREY,
            marker=".",
            linestyle=":",
            label="or in a loose box",
        )
    axes.axhline(HALF, color=GREY, linewidth=1, linestyle=(0.0, (5.0, 4.0)))
    if found.distance is not None:
        axes.axvline(found.distance, color=GREY, linewidth=1)
    axes.set(
        xlabel=f"distance ({found.unit})",
        ylabel="share of pictures",
        ylim=(-0.02, 1.02),
    )
    axes.set_title("How far away it is seen")
    axes.grid(True)
    axes.legend()
