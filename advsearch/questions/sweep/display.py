"""The view and the claims of the result of `sweep`.

The *detection distance* of an object is the distance at which half of a sweep's images
are detected: where a falling line through the fractions (isotonic regression, Ayer et
al. 1955, linear in the logarithm of the distance) crosses one half. Its interval is
exact: each of m fractions is compared with one half by the binomial test at 0.025 / m
on each side.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from advsearch.errors import InputError
from advsearch.options import Outcome
from advsearch.questions.sweep.settings import BLIND, HARMLESS
from advsearch.questions.sweep.summary import (
    ArmComparison,
    AxisRow,
    DriveRates,
    OverDrives,
    PairedRates,
    SurfaceMap,
    SurfacePart,
    SurfaceTable,
    SweepMap,
    SweepSummary,
)
from advsearch.report import wording
from advsearch.report.figures import (
    ACCURACY,
    BLUE,
    GREY,
    MARGIN,
    MAX_POINTS,
    Figures,
    draw_heat_map,
    format_axis_title,
    render_axes,
)
from advsearch.report.views import (
    Claim,
    Column,
    Extent,
    ResultPart,
    ShownResult,
    format_extent,
    make_claim,
    make_rate_extent,
)
from advsearch.report.wording import (
    format_count,
    format_paired_rates,
    format_prediction,
    get_margin_meaning,
    percent,
    shorten_name,
)
from advsearch.runs.results import INTERRUPTED, CountedPredictions, VerifiedRate
from advsearch.settings import split_names
from advsearch.statistics.monotone import Dip, _fit_falling, find_dips

MAX_TICKS = 16  # number of values of an axis that have a label
# number of characters of a label that fit into a figure of the usual size
USUAL_LABEL_LENGTH = 8
# total number of characters of the labels of an axis that fit side by side
MAX_LABELS_LENGTH = 50
SLANT_OF_LABELS = 45  # degrees by which long labels of an x axis are rotated
# Sizes of figures in inches. A map has the size of its frame plus that of each cell;
# labels longer than usual add the width or the height of each further character.
ACCURACY_FIGURE_SIZE = (5.6, 3.6)
MAP_FRAME_WIDTH = 3.2
MAP_FRAME_HEIGHT = 1.8
CELL_WIDTH = 0.34
CELL_HEIGHT = 0.3
CHARACTER_WIDTH = 0.09
ROTATED_CHARACTER_HEIGHT = 0.065


def figure_size(summary: SweepSummary) -> tuple[float, float] | None:
    """Return width and height of a sweep's figure in inches.

    A map is larger if the labels of its values are long; long labels below it are
    rotated. None if there is neither a map nor a single axis to draw.
    """
    if not summary.cells:
        return ACCURACY_FIGURE_SIZE if _list_single_axis(summary) else None
    x_axis, y_axis = summary.cells.axes
    extra_left, extra_below = _count_extra_characters(x_axis.values, y_axis.values)
    cells_width = CELL_WIDTH * min(len(x_axis.values), MAX_TICKS)
    cells_height = CELL_HEIGHT * min(len(y_axis.values), MAX_TICKS)
    width = MAP_FRAME_WIDTH + cells_width + CHARACTER_WIDTH * extra_left
    height = MAP_FRAME_HEIGHT + cells_height + ROTATED_CHARACTER_HEIGHT * extra_below
    return width, height


def _count_extra_characters(
    x_values: Sequence[Any], y_values: Sequence[Any]
) -> tuple[int, int]:
    """Return how many characters the labels of a map are longer than usual.

    Args:
        x_values: values of the x axis.
        y_values: values of the y axis.

    Returns:
        The characters for which room is needed at the left of the axes, and below them.
    """
    rotated_length = _find_longest_label(x_values) if _are_long(x_values) else 0
    left_length = _find_longest_label(y_values)
    # Labels of the x axis end below their tick: rotated ones begin to the left of it,
    # so that the first of them needs room at the left of the axes.
    extra_left = max(max(left_length, rotated_length) - USUAL_LABEL_LENGTH, 0)
    extra_below = max(rotated_length - USUAL_LABEL_LENGTH, 0)
    return extra_left, extra_below


def _find_longest_label(values: Sequence[Any]) -> int:
    return max(map(len, _select_ticks(values)[1]))


def draw_sweep(summary: SweepSummary) -> Figures:
    """Draw a sweep: a map over two axes, or the accuracy over the only one.

    A cell shows the accuracy there; if no cell has more than one configuration, the
    margin. Nothing is drawn if there is neither.
    """
    size = figure_size(summary)
    if size is None:
        return {}
    return render_axes(lambda axes: draw_sweep_on(summary, axes), size)


def draw_sweep_on(summary: SweepSummary, axes: Any) -> None:
    """Draw a sweep on matplotlib axes, as `draw_sweep` does."""
    if summary.cells:
        _draw_map(axes, summary, summary.cells)
    elif _list_single_axis(summary):
        _draw_accuracy(axes, summary, _list_single_axis(summary))


def _list_single_axis(summary: SweepSummary) -> Sequence[AxisRow]:
    """Return the rows of the axis of a sweep that has a single axis.

    The list is empty if there are more axes, or too many values. Ranges count as axes
    only if no axis has single values.
    """
    # The value of a part of a range is its two bounds.
    rows_of_values = [
        row for row in summary.axes if not isinstance(row.value, (list, tuple))
    ]
    rows = rows_of_values or summary.axes
    is_single_axis = len({row.axis for row in rows}) == 1
    return rows if is_single_axis and len(rows) <= MAX_POINTS else ()


def _draw_map(axes: Any, summary: SweepSummary, cells: SweepMap) -> None:
    """Draw the map of a sweep: accuracy or mean margin over two axes.

    Args:
        axes: axes of matplotlib.
        summary: summary of the sweep, for the title.
        cells: the map.
    """
    x_axis, y_axis = cells.axes
    # Cells are 1 wide and high, and centered at whole numbers.
    extent = (-0.5, len(x_axis.values) - 0.5, -0.5, len(y_axis.values) - 0.5)
    # The accuracy of a single prediction is only 0 or 1: its margin says more.
    counts = np.array(cells.configurations, dtype=float)
    has_accuracy = bool(counts.max() > 1)
    cell_values = _compute_accuracies(cells) if has_accuracy else _list_margins(cells)
    draw_heat_map(
        axes,
        cell_values,
        extent,
        ACCURACY if has_accuracy else MARGIN,
        format_axis_title(x_axis.axis, x_axis.unit),
        format_axis_title(y_axis.axis, y_axis.unit),
    )
    _label_x_values(axes, x_axis.values)
    axes.set_yticks(*_select_ticks(y_axis.values))
    axes.set_title(_make_map_title(summary, n_more_axes=len(cells.over)))


def _label_x_values(axes: Any, values: Sequence[Any]) -> None:
    """Label the values of an x axis, slanted if their labels are long."""
    indices, labels = _select_ticks(values)
    rotation = SLANT_OF_LABELS if _are_long(values) else 0
    axes.set_xticks(indices, labels, rotation=rotation)


def _compute_accuracies(cells: SweepMap) -> list[list[float]]:
    """Return the accuracy of each cell of a map; NaN without configurations."""
    counts = np.array(cells.configurations, dtype=float)
    no_values = np.full(counts.shape, np.nan)
    accuracies = np.divide(cells.correct, counts, out=no_values, where=counts > 0)
    rows: list[list[float]] = accuracies.tolist()
    return rows


def _list_margins(cells: SweepMap) -> list[list[float]]:
    """Return the margin of each cell of a map; NaN if it is unknown."""
    rows: list[list[float]] = np.array(cells.margin, dtype=float).tolist()
    return rows


def _make_map_title(summary: SweepSummary, n_more_axes: int) -> str:
    """Return the title of a map; it is over more axes than the two that are drawn."""
    title = _name_objects_and_models(summary)
    if n_more_axes:
        title += f", over {n_more_axes} more {'axes' if n_more_axes > 1 else 'axis'}"
    return title


def _draw_accuracy(axes: Any, summary: SweepSummary, rows: Sequence[AxisRow]) -> None:
    """Draw the accuracy at each value of an axis, with intervals.

    Args:
        axes: axes of matplotlib.
        summary: summary of the sweep, for the title.
        rows: values of the axis with their counts, at least one.
    """
    values = [row.value for row in rows]
    _draw_intervals(axes, rows)
    accuracy = [row.accuracy for row in rows]
    axes.plot(range(len(rows)), accuracy, "o", color=BLUE, label="accuracy")
    _label_x_values(axes, values)
    axes.set(
        xlabel=format_axis_title(rows[0].axis, rows[0].unit),
        ylabel="accuracy",
        ylim=(-0.03, 1.03),
    )
    axes.margins(x=0.08)
    axes.set_title(_name_objects_and_models(summary))
    axes.grid(True, axis="y")
    axes.figure.legend(loc="outside lower center", ncols=2)


def _draw_intervals(axes: Any, rows: Sequence[AxisRow]) -> None:
    """Draw the interval of the accuracy at each value; a single draw has none."""
    intervals = [
        (index, *row.interval) for index, row in enumerate(rows) if row.interval
    ]
    if not intervals:
        return
    x, lower, upper = zip(*intervals, strict=True)
    style = {"color": BLUE, "alpha": 0.35, "linewidth": 5}
    axes.vlines(x, lower, upper, **style, label="95 % interval")


def _select_ticks(values: Sequence[Any]) -> tuple[list[int], list[str]]:
    """Return the indices of the values of an axis that are labelled, and the labels."""
    step = math.ceil(len(values) / MAX_TICKS)
    indices = list(range(0, len(values), step))
    return indices, [_format_tick(values[index]) for index in indices]


def _format_tick(value: Any) -> str:
    """Return the label of a value at an axis; a part of a range has two bounds."""
    if isinstance(value, (list, tuple)):
        return " to ".join(f"{bound:.3g}" for bound in value)
    return shorten_name(value) if isinstance(value, str) else f"{value:.4g}"


def _name_objects_and_models(summary: SweepSummary) -> str:
    """Return the names of the objects and the models."""
    names = (*split_names(summary.object), *split_names(summary.model))
    return ", ".join(map(shorten_name, names))


def _are_long(values: Sequence[Any]) -> bool:
    """Return whether the labels of an axis are too long to stand side by side."""
    _, labels = _select_ticks(values)
    return sum(len(label) + 1 for label in labels) > MAX_LABELS_LENGTH


READING = (
    "How often it is right at each value, over all others, with the 95 % interval:"
)
BAR_LENGTH = 20  # number of characters
# A text lists all values of an axis up to this number. Of a longer axis it lists half
# this number: the values where the model is right least often.
MAX_TEXT_ROWS = 24
# number of values up to which a page lists an axis as a table
MAX_PAGE_ROWS = 96


def _difference_text(part: SurfacePart) -> str:
    """Return the difference of two rates in percent, with its interval if it has one."""
    low, high = part.interval
    difference = f"{part.difference:+.0%}"
    # The bounds are NaN if images share draws, and so are not independent.
    has_interval = not math.isnan(low)
    if has_interval:
        difference += f" ({low:+.0%} to {high:+.0%})"
    return difference.replace("%", " %")


AXIS_COLUMNS: dict[str, Column] = {
    "value": lambda row: (
        wording.format_parameter_value(row.value)
        + (f" {row.unit}" if row.unit not in ("", "name") else "")
    ),
    "configurations": "{0.configurations}",
    "right": "{0.correct}",
    "accuracy": lambda row: percent(row.accuracy),
    "95 % interval": lambda row: wording.format_interval(row.interval),
}
CHANGES_TITLE = "Predictions about changed pictures:"
CHANGE_COLUMNS: dict[str, Column] = {
    "model": "{0.model}",
    "what it says": lambda rates: rates.claim.replace("_", " "),
    "when": lambda rates: (BLIND | HARMLESS)[rates.when],
    "as claimed": "{0.correct} of {0.configurations}",
    "95 % interval": lambda rates: wording.format_interval(rates.interval),
}
SURFACE_COLUMNS: dict[str, Column] = {
    "middle (u, v)": "{0.u:.3f}, {0.v:.3f}",
    "place (x, y, z)": lambda part: ", ".join(f"{x:.3g}" for x in part.center),
    "face": "{0.face}",
    "wrong where seen": lambda part: format_error_rate(part.visible),
    "wrong where not": lambda part: format_error_rate(part.hidden),
    "difference": _difference_text,
    "p": "{0.p:.2g}",
}


def make_sweep_view(summary: SweepSummary) -> ShownResult:
    """Return the view of a sweep: what a text, a page and a notebook show of it."""
    axes = _group_axes(summary)
    parts_for_page = _make_page_parts(summary, axes)
    page_parts = (replace(part, only_medium="page") for part in parts_for_page)
    sections = [
        *_make_text_sections(summary, axes),
        *_make_figure_parts(summary),
        *page_parts,
    ]
    return ShownResult(
        _verdict(summary),
        sections,
        _make_sweep_facts(summary),
        says_interrupted=_has_ended_early(summary),
    )


def _make_figure_parts(summary: SweepSummary) -> Iterator[ResultPart]:
    """Yield the figure of a sweep for a notebook, if there is anything to draw."""
    size = figure_size(summary)
    if size is not None:
        yield ResultPart(
            draw=lambda figure_axes: draw_sweep_on(summary, figure_axes),
            size=size,
            only_medium="notebook",
        )


def _make_sweep_facts(summary: SweepSummary) -> dict[str, str]:
    """Return the facts of a sweep; those with an empty text are left out."""
    run_images = f"{summary.run}/images"
    has_drive_file = bool(summary.drives and summary.run)
    return {
        "worst": _describe_worst_configuration(summary),
        "there": _describe_worst_prediction(summary),  # the prediction in the worst one
        "renders": str(summary.renders["sweep"]),
        "worst drive": f"{run_images}/drive.webp" if has_drive_file else "",
        "map of the surface": f"{run_images}/surface.png" if summary.surface else "",
    }


def _has_ended_early(summary: SweepSummary) -> bool:
    """Return whether the verdict states that a sweep was cut off."""
    # The verdict says so itself if a sweep that was cut off has counted nothing.
    if summary.configurations > 0:
        return summary.looked_at < summary.planned
    # Nothing is counted: either no image shows the object, or none was evaluated.
    return not summary.out_of_view


def _group_axes(summary: SweepSummary) -> dict[str, list[AxisRow]]:
    """Return the rows of each axis by its name."""
    axes: dict[str, list[AxisRow]] = {}
    for row in summary.axes:
        axes.setdefault(row.axis, []).append(row)
    return axes


def _make_text_sections(
    summary: SweepSummary, axes: Mapping[str, Sequence[AxisRow]]
) -> Iterator[ResultPart]:
    """Yield the sections of text and tables.

    Args:
        summary: summary of the sweep.
        axes: rows of each axis by its name, from `_group_axes`.
    """
    if summary.arms is not None and summary.ending != INTERRUPTED:
        for pair in summary.arms.pairs:
            yield _make_arms_table(summary.arms.adversarial_run, pair, summary.task)
    distance = find_detection_distance(summary)
    if distance:
        yield ResultPart(text=[describe_detection_distance(distance)])
    for rates in summary.drives or ():
        title = drive_title(rates)
        rows = make_drive_rows(rates)
        yield ResultPart(title, column_heads=DRIVE_HEADS, rows=rows)
    yield _make_changes_table(summary)
    yield from _make_axis_sections(summary, axes)
    if summary.surface is not None:
        sentences = "\n".join(surface_sentences(summary.surface))
        title = "What is seen of the surface when the model is wrong:"
        yield ResultPart(title, [sentences])


def _make_changes_table(summary: SweepSummary) -> ResultPart:
    """Return the table of predictions about changed images; empty without any."""
    return ResultPart.make_table(
        summary.changes or [], CHANGE_COLUMNS, title=CHANGES_TITLE
    )


def _make_axis_sections(
    summary: SweepSummary, axes: Mapping[str, Sequence[AxisRow]]
) -> Iterator[ResultPart]:
    """Yield an introduction and a table for each axis; see `_make_text_sections`."""
    # The axis "answer" has the clean scene and the adversarial one: `_make_arms_table`
    # shows these.
    if not axes.keys() - {"answer"}:
        return
    introduction = READING
    if summary.arms:
        first_letter = READING[0].lower()
        introduction = (
            "Of the clean scene and the adversarial one together: "
            f"{first_letter}{READING[1:]}"
        )
    yield ResultPart(text=[introduction])
    for name, rows in axes.items():
        if name != "answer":
            yield _make_axis_table(name, rows, summary.task)


def _make_arms_table(adversarial_run: str, pair: PairedRates, task: str) -> ResultPart:
    """Return a table of one model without and with an adversarial configuration.

    Args:
        adversarial_run: name of the run that found the configuration.
        pair: counts of the model in both scenes.
        task: name of the task.
    """
    arms = (("clean", pair.clean), (adversarial_run, pair.adversarial))
    has_outcomes = any(counts.outcomes for _, counts in arms)
    rows = []
    for name, counts in arms:
        right = f"right in {counts.correct} of {counts.configurations}"
        row = [name, right, *_make_accuracy_cells(counts)]
        if has_outcomes:
            row.append(wording.format_outcomes(counts.outcomes, task))
        rows.append(row)
    return ResultPart(rows=rows)


def _describe_worst_configuration(summary: SweepSummary) -> str:
    """Return the names and values of the worst configuration; empty without one."""
    if summary.worst is None:
        return ""
    values = summary.worst.values
    # Values such as "mug, studio" explain themselves, and are listed without names.
    names = ("object", "environment", "backdrop", "model")
    self_explaining = [name for name in names if name in values]
    texts = [shorten_name(values[name].value) for name in self_explaining]
    for name, described in values.items():
        if name not in self_explaining:
            texts.append(f"{name} {wording.format_parameter_value(described.value)}")
    return ", ".join(texts)


def _describe_worst_prediction(summary: SweepSummary) -> str:
    """Return what the model predicts of the worst configuration; empty without one."""
    worst = summary.worst
    if worst is None:
        return ""
    verified = "not verified"
    if worst.verified:
        verified = f"wrong in {wording.format_rate(worst.verified)}"
    margin = f"margin ({get_margin_meaning(summary.task)}) {worst.claimed.margin:.3g}"
    prediction = format_prediction(summary.task, worst.claimed)
    return f"prediction {prediction}; {margin}; {verified}"


def _make_page_parts(
    summary: SweepSummary, axes: Mapping[str, Sequence[AxisRow]]
) -> Iterator[ResultPart]:
    """Yield what a page shows in addition to its explorer.

    These are the detection distance, full drives, the surface, and each axis in
    numbers.

    Args:
        summary: summary of the sweep.
        axes: rows of each axis by its name, from `_group_axes`.
    """
    distance = find_detection_distance(summary)
    if distance:
        yield _make_distance_part(distance)
    for index, rates in enumerate(summary.drives or ()):
        yield _make_drive_part(rates, is_first=index == 0)
    yield _make_changes_table(summary)
    if summary.surface is not None:
        yield from _make_surface_parts(summary.surface)
    for name, rows in axes.items():
        if len(rows) <= MAX_PAGE_ROWS:
            yield _make_folded_axis_table(name, rows, summary.task)


def _make_distance_part(distance: DetectionDistance) -> ResultPart:
    """Return the chart of the detection distance, with its sentence."""
    sentence = describe_detection_distance(distance)
    return ResultPart(
        "How far away it is seen",
        [sentence],
        draw=partial(draw_detection_distance, distance),
        note=sentence,
    )


def _make_drive_part(rates: DriveRates, *, is_first: bool) -> ResultPart:
    """Return the table of a model's rates over drives, for a page.

    The title stands once, above all tables. The only images are those of the worst
    drive of the first model.
    """
    return ResultPart(
        "Whole drives" if is_first else "",
        [drive_title(rates)],
        column_heads=DRIVE_HEADS,
        rows=make_drive_rows(rates),
        figure="images/drive.png" if is_first else "",
    )


def _make_folded_axis_table(
    name: str, rows: Sequence[AxisRow], task: str
) -> ResultPart:
    """Return a table of the accuracy by the values of an axis, folded on a page."""
    columns = dict(AXIS_COLUMNS)
    # Only detectors have outcomes of wrong predictions, such as "missed".
    if any(row.outcomes for row in rows):
        columns["the others"] = lambda row: wording.format_outcomes(row.outcomes, task)
    title = f"Accuracy by {name}"
    return ResultPart.make_table(rows, columns, title=title, folded=True)


def _make_surface_parts(surface: SurfaceMap) -> Iterator[ResultPart]:
    """Yield what a page shows of the surface."""
    text = " ".join(surface_sentences(surface))
    title = "The surface that was seen"
    yield ResultPart(title, [text], figure="images/surface.png")
    for table in surface.tables:
        if table.strongest:
            names = f"{shorten_name(table.object)}, {shorten_name(table.model)}"
            title = f"{names}: the {table.part}s with the clearest difference"
            yield ResultPart.make_table(
                table.strongest, SURFACE_COLUMNS, title=title, folded=True
            )


def _verdict(summary: SweepSummary) -> str:
    """Return the result of a sweep in one or two sentences."""
    if not summary.configurations and summary.out_of_view:
        return "The object is in no picture."
    if not summary.configurations:
        return "Interrupted before the first configuration."
    if summary.ending == INTERRUPTED and summary.looked_at < summary.planned:
        return _interrupted_verdict(summary)
    if summary.arms and summary.arms.pairs:
        return _verdict_of_arms(summary.arms)
    configurations = format_count(summary.configurations, "configuration")
    rate = f"({format_accuracy(summary)}){format_grid_caution(summary)}"
    outcomes = describe_wrong_outcomes(summary)
    return (
        f"The model is right in {summary.correct} of {configurations} {rate}{outcomes}."
    )


def _interrupted_verdict(summary: SweepSummary) -> str:
    """Return the result so far of a sweep that was interrupted."""
    rate = format_accuracy(summary)
    outcomes = describe_wrong_outcomes(summary)
    return (
        f"Interrupted after {summary.looked_at} of {summary.planned} "
        f"configurations: right in {summary.correct} ({rate}){outcomes}."
    )


def _verdict_of_arms(arms: ArmComparison) -> str:
    """Return how the adversarial scene compares with the clean one, for each model."""
    rates = [format_paired_rates(arms.adversarial_run, pair) for pair in arms.pairs]
    return " ".join(rates)


def describe_wrong_outcomes(summary: SweepSummary) -> str:
    """Return the outcomes of wrong predictions, as the end of a sentence.

    Empty for tasks without outcomes; only detection has them.
    """
    text = wording.format_outcomes(summary.outcomes, summary.task)
    return f"; of the others, {text}" if text else ""


def format_grid_caution(summary: SweepSummary) -> str:
    """Return a caution that an accuracy depends on the grid; empty if it does not."""
    if summary.sampler is not None or not summary.grid:
        return ""
    return " of this grid; another has another share"


def _make_accuracy_cells(counts: CountedPredictions) -> tuple[str, str]:
    """Return the accuracy and its interval, as cells of a table."""
    return percent(counts.accuracy), wording.format_interval(counts.interval)


def _make_axis_table(name: str, rows: Sequence[AxisRow], task: str) -> ResultPart:
    """Return a table of the accuracy by the values of an axis, with bars.

    Of more than `MAX_TEXT_ROWS` values only the worst are listed.

    Args:
        name: name of the axis.
        rows: its values.
        task: name of the task.
    """
    title = _make_axis_title(name, rows[0].unit)
    listed = list(rows)
    if len(rows) > MAX_TEXT_ROWS:
        listed = _select_worst(rows, MAX_TEXT_ROWS // 2)
        title += (
            f" (the {len(listed)} of {len(rows)} values where the model is right "
            "least often)"
        )
    has_outcomes = any(row.outcomes for row in rows)
    lines = [_make_value_row(row) for row in listed]
    if has_outcomes:
        for cells, row in zip(lines, listed, strict=True):
            cells.append(wording.format_outcomes(row.outcomes, task))
    return ResultPart(title, rows=lines)


def _make_axis_title(name: str, unit: str) -> str:
    """Return the name of an axis with its unit, if values are written without it."""
    # "name" is the unit of a discrete choice.
    has_unit = unit not in (*wording.PLAIN_UNITS, "name")
    return f"{name}, {unit}" if has_unit else name


def _make_value_row(row: AxisRow) -> list[str]:
    """Return a value of an axis, a bar of its accuracy, and the accuracy in numbers."""
    # An unknown accuracy has an empty bar, as 0 has.
    n_filled = round((row.accuracy or 0.0) * BAR_LENGTH)
    bar = "#" * n_filled
    accuracy, interval = _make_accuracy_cells(row)
    return [
        wording.format_parameter_value(row.value),
        bar.ljust(BAR_LENGTH, "."),
        accuracy,
        f"{row.correct} of {row.configurations}",
        interval,
    ]


def _select_worst(rows: Sequence[AxisRow], count: int) -> list[AxisRow]:
    """Return the rows with the smallest accuracies, in their original order."""
    by_accuracy = sorted(
        range(len(rows)), key=lambda index: rows[index].accuracy or 0.0
    )
    worst = sorted(by_accuracy[:count])
    return [rows[index] for index in worst]


def make_sweep_claims(result: SweepSummary) -> Iterator[Claim]:
    """Yield what a finished sweep measured.

    That is the fraction of right predictions, the detection distance, the rates over
    drives, and how often the worst of the configurations is wrong.
    """
    if result.accuracy is None or result.ending != "finished":
        return
    population, note = _describe_population(result)
    if result.arms:
        adversarial_run = result.arms.adversarial_run
        for pair in result.arms.pairs:
            yield from _make_arm_claims(adversarial_run, pair, population, note)
        if result.arms.pairs:
            return  # the other claims would mix the clean scene and the adversarial one
    yield from _make_accuracy_claims(result, population, note)
    distance = find_detection_distance(result)
    if distance:
        yield make_claim("measured", describe_detection_distance(distance), None)
    for rates in result.drives or ():
        yield _make_drive_claim(rates)
    if result.worst is not None and result.worst.verified is not None:
        yield _make_worst_claim(result.worst.verified)


def _make_worst_claim(verified: VerifiedRate) -> Claim:
    """Return how often the worst of the configurations is wrong, as a claim."""
    text = (
        "In the worst of these configurations the model is wrong in "
        f"{wording.format_rate(verified)}. No search looked for a worse one."
    )
    return make_claim("measured", text, make_rate_extent("wrong", verified))


def _make_drive_claim(rates: DriveRates) -> Claim:
    """Return the rates of a model over drives as a claim."""
    contents = "mean, with its interval over drives, then the worst drive"
    values = "; ".join(_format_drive_clause(*row) for row in make_drive_rows(rates))
    text = f"{drive_title(rates)} ({contents}): {values}."
    return make_claim("measured", text, None)


def _describe_population(result: SweepSummary) -> tuple[str, str]:
    """Return what the rates of a sweep are over, and a caution about the interval.

    A sweep has a grid, samples (then its `sampler` is not None), or both; imported rows
    have neither. The caution is empty if the interval is right: for independent random
    draws without a grid, and for random drives.
    """
    is_sampled = result.sampler is not None
    if not is_sampled and result.grid:
        return _describe_grid_population(result)
    if not is_sampled:
        return _describe_imported_population(result)
    if result.drives:
        return _describe_sampled_drives(result.drives, result.sampler)
    has_independent_draws = result.sampler == "random" and not result.grid
    if has_independent_draws:
        return "configurations drawn at random from the stated ranges", ""
    population = f"configurations drawn at random ({result.sampler})"
    if result.grid:
        population += " at each point of a grid"
    note = " The interval is that of independent draws, which these are not."
    return population, note


def _describe_sampled_drives(
    drives: Sequence[DriveRates], sampler: str | None
) -> tuple[str, str]:
    """Return what the rates of sampled drives are over, and a caution.

    The frames are the grid; what else differs between drives is sampled.
    """
    population = (
        f"{_name_frames(drives)}; what else differs between drives is drawn "
        f"at random ({sampler})"
    )
    note = " The interval is over drives, as if these were independent."
    return population, "" if sampler == "random" else note


def _describe_imported_population(result: SweepSummary) -> tuple[str, str]:
    """Return what the rates of imported rows are over, and a caution."""
    population = "configurations"
    if result.drives:
        population = _name_frames(result.drives)
    note = " How these were selected is unknown; the interval takes them as a sample."
    return population, note


def _describe_grid_population(result: SweepSummary) -> tuple[str, str]:
    """Return what the rates of a grid without samples are over, and a caution."""
    population = "points of the grid"
    if result.drives:
        frames = _name_frames(result.drives)
        population = f"{frames}, whose paths and times were selected"
    note = (
        " This states nothing about what lies between or outside of these points, "
        "and another grid gives another fraction; the interval takes the points as "
        "a sample."
    )
    return population, note


def _name_frames(drives: Sequence[DriveRates]) -> str:
    """Return what a sweep over drives counts: ``frames of 24 drives``."""
    return f"frames of {drives[0].drives} drives"


def _make_arm_claims(
    adversarial_run: str, pair: PairedRates, population: str, note: str
) -> Iterator[Claim]:
    """Yield the accuracy without and with an adversarial configuration.

    Args:
        adversarial_run: name of the run that found the configuration.
        pair: counts of one model in both scenes.
        population: description of what the rates are over, "points of the grid" say.
        note: a caution about the interval.
    """
    arms = {
        "the clean scene": pair.clean,
        f"the adversarial scene of {adversarial_run}": pair.adversarial,
    }
    for arm, counts in arms.items():
        contents = f"configurations of {arm} in which {pair.model} is right"
        extent = _make_accuracy_extent(contents, counts)
        accuracy = format_extent(extent)
        text = f"With {arm} {pair.model} is right in {accuracy} {population}.{note}"
        yield make_claim("measured", text, extent)
    yield make_claim("measured", format_paired_rates(adversarial_run, pair), None)


def _make_accuracy_claims(
    result: SweepSummary, population: str, note: str
) -> Iterator[Claim]:
    """Yield the accuracy of each model.

    Args:
        result: result of the sweep.
        population: description of what the rates are over, "points of the grid" say.
        note: a caution about the interval.
    """
    population += _describe_unsampled(result)
    contents = "configurations in which the model is right"
    for model, counts in _count_by_model(result).items():
        extent = _make_accuracy_extent(contents, counts)
        outcomes = wording.format_outcomes(counts.outcomes, result.task)
        others = f" Of the others: {outcomes}." if outcomes else ""
        text = (
            f"{model} is right in {format_extent(extent)} {population}.{others}{note}"
        )
        yield make_claim("measured", text, extent)


def _describe_unsampled(result: SweepSummary) -> str:
    """Return what is not sampled, objects and environments, as the end of a clause.

    Each of them has the same number of images.
    """
    fixed = list[str]()
    for name in ("object", "environment"):
        n_values = sum(row.axis == name for row in result.axes)
        if n_values > 1:
            fixed.append(f"each of the {n_values} {name}s")
    return f", as many in {' and '.join(fixed)}" if fixed else ""


def _count_by_model(result: SweepSummary) -> dict[str, CountedPredictions]:
    """Return the counts of each model by its name, as a sentence begins with it.

    Each model has a claim of its own: models get the same images, so that their
    predictions are not independent of each other.
    """
    counts_by_model = dict[str, CountedPredictions]()
    if len(split_names(result.model)) > 1:
        for row in result.axes:
            if row.axis == "model":
                counts_by_model[f"The model {row.value}"] = row
    if not counts_by_model:
        counts_by_model["The model"] = result
    return counts_by_model


def _format_drive_clause(name: str, mean: str, interval: str, worst: str) -> str:
    """Return a row of `make_drive_rows` as a clause."""
    interval_text = "" if interval == "-" else f" (95 % interval {interval})"
    return f"{name}: {mean}{interval_text}, {worst}"


def _make_accuracy_extent(description: str, counts: CountedPredictions) -> Extent:
    """Return the extent of the claim that predictions are right."""
    return Extent.from_count(
        description,
        counts.correct,
        counts.configurations,
        counts.interval,
        counts.accuracy,
        counts_right=True,
    )


DRIVE_HEADS = ("", "mean", "95 % interval", "worst drive")
PERCENT = " %"  # the unit of rates that are fractions, and written in percent


def format_accuracy(summary: SweepSummary) -> str:
    """Return the accuracy with its interval, and whether that is over drives."""
    over = ", over drives" if summary.drives else ""
    return (
        f"{percent(summary.accuracy)}, 95 % interval "
        f"{wording.format_interval(summary.interval)}{over}"
    )


def drive_title(rates: DriveRates) -> str:
    """Return the numbers of drives and frames, the seconds, and the model."""
    repeats = (
        f", {rates.repeats} times each with other noise" if rates.repeats > 1 else ""
    )
    title = (
        f"{format_count(rates.drives, 'drive')} of {rates.frames} frames in {rates.seconds:g} "
        f"s{repeats}, {rates.model}"
    )
    if rates.adversarial_run is not None:
        title += f", with {rates.adversarial_run}"
    return title


def make_drive_rows(drive_rates: DriveRates) -> list[tuple[str, str, str, str]]:
    """Return the rates over drives: name, mean, 95 % interval and worst drive.

    An unknown rate has no row; a missing interval is a dash.
    """
    never = f", never in {drive_rates.never_right}" if drive_rates.never_right else ""
    distance_unit = f" {drive_rates.unit}"
    first_right = drive_rates.first_right
    # tuples of a name, the values, their unit, and a remark after the mean
    rates: list[tuple[str, OverDrives | None, str, str]] = [
        ("frames in which it is right", drive_rates.right, PERCENT, ""),
        ("first right at a distance of", first_right, distance_unit, never),
        ("longest gap", drive_rates.longest_gap, " s", ""),
        ("changes a second", drive_rates.flicker, "", ""),
        *_list_track_rates(drive_rates),
    ]
    return [
        _format_drive_row(name, value, unit, remark)
        for name, value, unit, remark in rates
        if value is not None
    ]


def _list_track_rates(
    drive_rates: DriveRates,
) -> list[tuple[str, OverDrives | None, str, str]]:
    """Return name, values, unit and remark of each rate of tracks; none without tracks."""
    tracks = drive_rates.tracks
    if tracks is None:
        return []
    return [
        ("frames without its track", tracks.lost, PERCENT, ""),
        ("frames with a loose track instead", tracks.loose, PERCENT, ""),
        ("identity switches", tracks.switches, "", ""),
        ("longest gap of its track", tracks.longest_gap, " s", ""),
    ]


def _format_drive_row(
    name: str, value: OverDrives, unit: str, remark: str
) -> tuple[str, str, str, str]:
    """Return the texts of a rate over drives: name, mean, interval and worst drive.

    Args:
        name: name of the rate.
        value: the rate; a dash stands for an interval that it lacks.
        unit: unit with a space before it; of a fraction it is `PERCENT`.
        remark: remark on the mean, after it.
    """
    factor = 100.0 if unit == PERCENT else 1.0
    interval = "-"
    if value.interval:
        low, high = value.interval
        interval = f"{low * factor:.3g} to {high * factor:.3g}{unit}"
    mean = f"{value.mean * factor:.3g}{unit}{remark}"
    worst = f"{value.worst * factor:.3g}{unit}"
    return name, mean, interval, worst


def surface_sentences(surface: SurfaceMap) -> list[str]:
    """Return a sentence for each surface: which cells the predictions depend on.

    A cell "goes with wrong predictions" if the model is wrong significantly more often
    where the cell is visible than where it is hidden.
    """
    sentences = []
    for table in surface.tables:
        # The faces of a mesh may be counted, too; the sentence is about cells.
        if table.part == "cell":
            names = f"{shorten_name(table.object)}, {shorten_name(table.model)}"
            text = _compared_cells_text(table, surface.min_pictures)
            sentences.append(f"{names}: {text}")
    return sentences


def _compared_cells_text(table: SurfaceTable, min_images: int) -> str:
    """Return how many cells of a surface go with wrong predictions, as a sentence.

    Args:
        table: counts of the cells of one object and one model.
        min_images: images that a cell has to be seen in, and hidden in.
    """
    cells = format_count(table.compared, table.part)
    if not table.compared:
        return (
            f"no {table.part} was seen in {min_images} pictures and hidden in "
            "as many, so nothing is compared."
        )
    if not table.worse + table.better:
        return f"none of {cells} that were compared is told from chance."
    text = (
        f"of {cells} that were compared, {table.worse} go with wrong "
        f"predictions and {table.better} with right ones."
    )
    return (
        f"{text} {_clearest_cell_text(table.strongest[0])}" if table.strongest else text
    )


def _clearest_cell_text(part: SurfacePart) -> str:
    """Return how often the model is wrong with and without a cell, as a sentence."""
    return (
        f"The clearest, at u {part.u:.2f} and v {part.v:.2f}: wrong in "
        f"{format_error_rate(part.visible)} that see it, "
        f"{format_error_rate(part.hidden)} that do not."
    )


def format_error_rate(counts: CountedPredictions) -> str:
    n_wrong = counts.configurations - counts.correct
    return f"{n_wrong} of {counts.configurations}"


DISTANCE = "camera.distance"  # name of the axis
HALF = 0.5
# significance of all one-sided binomial tests of a bound together; both bounds together
# have 95 % confidence
BOUND_SIGNIFICANCE = 0.025


@dataclass(frozen=True)
class DetectionDistance:
    """The distance at which a camera that comes nearer first detects an object.

    Attributes:
        unit: "metres" or "object sizes".
        distances: (m,) distances with images, ascending.
        right_fractions: (m,) fraction of right images at each distance.
        intervals: (m,) 95 % intervals of the fractions.
        distance: the estimate. None if the object is detected at all distances, or at
            none. If the fraction does not fall with the distance, it is estimated from
            the distances beyond the last significant dip.
        lower: lower bound of the estimate; None if the images do not bound it.
        upper: upper bound; None if the images do not bound it.
        min_images: number of images at a distance that a bound needs, if no distance
            has as many; else None.
        loose_counts: (m,) number of images with a loose box on the object, which counts
            neither as right nor as missed; empty if unknown.
        image_counts: (m,) number of images.
        dips: distances at which the object is detected less often than farther away,
            ascending.
        is_above_half: whether the falling line stays at one half or above up to the
            farthest distance.
    """

    unit: str
    distances: tuple[float, ...]
    right_fractions: tuple[float, ...]
    intervals: tuple[tuple[float, float], ...]
    distance: float | None
    lower: float | None
    upper: float | None
    min_images: int | None
    loose_counts: tuple[int, ...] = ()
    image_counts: tuple[int, ...] = ()
    dips: tuple[Dip, ...] = ()
    is_above_half: bool = False

    @property
    def is_monotone(self) -> bool:
        """Whether no dip is significant."""
        return not any(dip.is_significant for dip in self.dips)


def find_detection_distance(summary: SweepSummary) -> DetectionDistance | None:
    """Return the detection distance of a sweep.

    None if the sweep does not measure it: one model, one object, several distances and
    independent images are needed.
    """
    rows = [row for row in summary.axes if row.axis == DISTANCE and row.configurations]
    has_distances = len(rows) > 1
    if not has_distances or not _can_measure_distance(summary):
        return None
    return compute_detection_distance(rows)


def _can_measure_distance(summary: SweepSummary) -> bool:
    """Return whether a sweep detects one object with one model in independent images."""
    # A task may have options, as in "detection=..."
    task_name = summary.task.partition("=")[0]
    is_detection = task_name == "detection"
    # names of several objects or models stand with commas
    is_single = "," not in summary.object and "," not in summary.model
    is_comparison = summary.arms is not None
    # Frames of a drive are not independent. Neither are images that share a draw; then
    # `units` is the number of draws.
    are_independent = summary.drives is None and summary.units is None
    return is_detection and is_single and are_independent and not is_comparison


def compute_detection_distance(rows: Sequence[AxisRow]) -> DetectionDistance:
    """Compute the distance at which an object is first detected.

    A line that falls with the distance is fitted to the fractions of right images. The
    estimate is where the line crosses one half. Its bounds come from binomial tests at
    each distance. A dip is a distance with fewer right images than farther away, which
    contradicts a falling line.

    Args:
        rows: counts by a distance, or by the bounds of a range of it.

    Raises:
        InputError: there are fewer than two distances.
    """
    _check_distance_count(len(rows))
    rows = sorted(rows, key=_center_distance)
    distances = tuple(_center_distance(row) for row in rows)
    k = np.array([row.correct for row in rows])  # right images at each distance
    n = np.array([row.configurations for row in rows])  # images
    # significance of the test at one of the distances (Bonferroni)
    significance = BOUND_SIGNIFICANCE / len(rows)
    low, high = _bound_distance(np.array(distances), k, n, significance)
    dips = find_dips(distances, k, n)
    beyond_dips = slice(_find_first_beyond_dips(distances, dips), None)
    fitted_fractions = _fit_falling(k[beyond_dips], n[beyond_dips])
    return DetectionDistance(
        unit=rows[0].unit,
        distances=distances,
        right_fractions=tuple((k / n).tolist()),
        intervals=tuple(row.interval or (0.0, 1.0) for row in rows),
        distance=_find_crossing(np.array(distances[beyond_dips]), fitted_fractions),
        lower=low,
        upper=high,
        min_images=_find_required_images(n, significance),
        loose_counts=_count_loose(rows),
        image_counts=tuple(n.tolist()),
        dips=dips,
        # The last one is the smallest.
        is_above_half=bool(fitted_fractions[-1] >= HALF),
    )


def _check_distance_count(n_distances: int) -> None:
    """Raise an error if there are fewer than two distances."""
    if n_distances < 2:
        raise InputError(
            "detection distance: expected at least two distances, got "
            f"{n_distances}; sweep over more"
        )


def _find_required_images(n: NDArray[np.int64], significance: float) -> int | None:
    """Return how many images a bound needs; None if some distance has as many.

    Args:
        n: (m,) number of images at each distance.
        significance: significance of a one-sided binomial test of one half.
    """
    # If each image is right with probability one half, n images are all right with
    # probability 2**-n. The smallest n for which that is below the significance:
    min_images = math.floor(-math.log2(significance)) + 1
    has_enough_images = bool((n >= min_images).any())
    return None if has_enough_images else min_images


def _find_first_beyond_dips(distances: Sequence[float], dips: Sequence[Dip]) -> int:
    """Return the index of the first distance beyond the last significant dip.

    The falling line is fitted from there on, since nearer distances contradict it. It
    is 0 without a significant dip.
    """
    indices_beyond_dips = [
        distances.index(dip.distance) + 1 for dip in dips if dip.is_significant
    ]
    return max(indices_beyond_dips, default=0)


def _bound_distance(
    distance: NDArray[np.float64],
    k: NDArray[np.int64],
    n: NDArray[np.int64],
    significance: float,
) -> tuple[float | None, float | None]:
    """Return the bounds of the detection distance; None if images do not bound it.

    The lower bound is the farthest distance at which significantly more than half of
    the images are right, whatever is nearer. The upper bound is the nearest distance
    beyond it at which significantly fewer than half are.

    Args:
        distance: (m,) ascending.
        k: (m,) number of images that are right.
        n: (m,) number of images.
        significance: significance of a one-sided binomial test of one half.
    """
    from scipy.special import bdtr, bdtrc  # takes a tenth of a second

    # Binomial tests: the probabilities of at least k and of at most k right images of n
    # if each is right with probability one half.
    p_at_least = bdtrc(k - 1.0, n, HALF)
    p_at_most = bdtr(k * 1.0, n, HALF)
    is_above_half = p_at_least < significance
    is_below_half = p_at_most < significance
    low = max(distance[is_above_half], default=None)
    is_beyond_low = distance > (0.0 if low is None else low)
    high = min(distance[is_below_half & is_beyond_low], default=None)
    return None if low is None else float(low), None if high is None else float(high)


def _find_crossing(
    distance: NDArray[np.float64], falling: NDArray[np.float64]
) -> float | None:
    """Return the distance where a falling line crosses one half; None if it does not.

    Args:
        distance: (m,) ascending; the line is linear in its logarithm.
        falling: (m,) the line, the fraction of right images at each distance.
    """
    crosses_half = falling[0] >= HALF > falling[-1]
    if not crosses_half:
        return None
    # Interpolate log(distance) as a function of the fraction. `interp` needs ascending
    # abscissae, so that the falling fractions are negated.
    return float(np.exp(np.interp(-HALF, -falling, np.log(distance))))


def _center_distance(row: AxisRow) -> float:
    """Return the distance of a row; of a range its center, in logarithms."""
    if isinstance(row.value, tuple):
        return math.sqrt(math.prod(row.value))
    return float(row.value)


def _count_loose(rows: Sequence[AxisRow]) -> tuple[int, ...]:
    """Return the loose boxes of each row; empty if no outcome is known."""
    outcomes = [getattr(row, "outcomes", None) or {} for row in rows]
    if not any(outcomes):
        return ()
    return tuple(counts.get(Outcome.LOOSE.value, 0) for counts in outcomes)


def describe_detection_distance(estimate: DetectionDistance) -> str:
    """Return the detection distance as text: "Seen from 38 m, 31 to 44 m ...".

    Sentences about dips (distances with fewer detections than farther away) and about
    loose boxes follow.
    """
    unit = "m" if estimate.unit == "metres" else estimate.unit
    interval = _interval_clause(estimate, unit)
    dips = _dips_sentences(estimate, unit)
    loose = _loose_sentence(estimate, unit)
    if not estimate.is_monotone:
        # The dips come first: the estimate is only about what is beyond them.
        beyond = _clause_beyond_dips(estimate, unit)
        return " ".join(filter(None, [*dips, f"{beyond}; {interval}.", loose]))
    sentence = _estimate_sentence(estimate, unit, interval)
    return " ".join(filter(None, [sentence, *dips, loose]))


def _estimate_sentence(estimate: DetectionDistance, unit: str, interval: str) -> str:
    """Return the estimate of a detection distance without dips, as a sentence.

    Args:
        estimate: the estimate.
        unit: unit of distances.
        interval: its interval as a clause.
    """
    if estimate.distance is not None:
        distance = f"{estimate.distance:.3g} {unit}"
        return f"Seen from {distance} in half of the pictures, {interval}."
    if estimate.is_above_half:
        farthest = f"{estimate.distances[-1]:.3g} {unit}"
        return (
            "Seen in at least half of the pictures up to the farthest distance, "
            f"{farthest}; {interval}."
        )
    return (
        f"Not seen in half of the pictures, even from {estimate.distances[0]:.3g} "
        f"{unit}; {interval}."
    )


def _clause_beyond_dips(estimate: DetectionDistance, unit: str) -> str:
    """Return how often the model is right beyond the last dip of its detections.

    A dip is a distance at which the object is detected less often than farther away.
    The clause follows the sentence about dips (`_dips_sentences`), to which its words
    "Beyond that" refer.

    Args:
        estimate: estimate of the detection distance.
        unit: unit of distances.
    """
    if estimate.distance is not None:
        distance = f"{estimate.distance:.3g} {unit}"
        return f"Beyond that the share falls below a half at {distance}"
    if estimate.is_above_half:
        return (
            "Beyond that it is right in at least half of the pictures, up to "
            f"{estimate.distances[-1]:.3g} {unit}"
        )
    return "Beyond that it is right in less than half of the pictures"


def _interval_clause(estimate: DetectionDistance, unit: str) -> str:
    """Return the interval of the detection distance as a clause.

    An interval may have only one bound, or none if there are too few images.

    Args:
        estimate: estimate of the detection distance.
        unit: unit of distances.
    """
    clause = f"{_format_bounds(estimate, unit)} with 95 % confidence"
    if estimate.min_images is not None:
        clause += (
            f" (that takes at least {estimate.min_images} pictures at each distance)"
        )
    return clause


def _format_bounds(estimate: DetectionDistance, unit: str) -> str:
    """Return the bounds of the detection distance: both, one, or "no bound"."""
    low = None if estimate.lower is None else f"{estimate.lower:.3g}"
    high = None if estimate.upper is None else f"{estimate.upper:.3g}"
    if low is not None and high is not None:
        return f"{low} to {high} {unit}"
    if low is not None:
        return f"at least {low} {unit}"
    if high is not None:
        return f"at most {high} {unit}"
    return "no bound"


def _dips_sentences(estimate: DetectionDistance, unit: str) -> list[str]:
    """Return a sentence about dips, distances with fewer detections than farther away.

    It lists all significant dips. If none is significant, it has the dip with the
    smallest p-value among those that contradict the estimate, if any.

    Args:
        estimate: estimate of the detection distance.
        unit: unit of distances.

    Returns:
        One sentence, or nothing.
    """
    significant = [dip for dip in estimate.dips if dip.is_significant]
    if significant:
        clauses = "; ".join(_dip_clause(dip, unit) for dip in significant)
        return [f"No one distance from which on it is seen: right in {clauses}."]
    contradicting = [dip for dip in estimate.dips if _contradicts(dip, estimate)]
    if not contradicting:
        return []
    most_significant = min(contradicting, key=lambda dip: dip.p_value)
    clause = _dip_clause(most_significant, unit)
    return [f"Nearer it is right less often: in {clause}, which may be chance."]


def _contradicts(dip: Dip, estimate: DetectionDistance) -> bool:
    """Return whether a dip contradicts an estimate of the detection distance.

    Fewer than half of its images are right, although it is nearer than the estimate, or
    although at least half of the images farther away are right.
    """
    # The estimate states that at least half of the images are right up to here.
    detected_until = estimate.distance or 0.0
    if estimate.is_above_half:
        detected_until = estimate.distances[-1]
    n_right, n_images = dip.counts
    n_right_beyond, n_images_beyond = dip.counts_beyond
    is_below_half = n_right < HALF * n_images
    is_above_half_beyond = n_right_beyond >= HALF * n_images_beyond
    is_nearer_than_estimate = dip.distance < detected_until
    return is_below_half and (is_nearer_than_estimate or is_above_half_beyond)


def _dip_clause(dip: Dip, unit: str) -> str:
    """Compare in words the images at a dip with those at larger distances."""
    n_right, n_images = dip.counts
    at_dip = f"{n_right} of {n_images} at {dip.distance:.3g} {unit}"
    n_right_beyond, n_images_beyond = dip.counts_beyond
    beyond = (
        f"{n_right_beyond} of {n_images_beyond} beyond it up to {dip.until:.3g} {unit}"
    )
    return f"{at_dip}, {beyond} (p = {dip.p_value:.2g})"


def _loose_sentence(estimate: DetectionDistance, unit: str) -> str:
    """Return in how many images only a loose box is on the object, by distance.

    A loose box overlaps the object, but too little to count as right. The text is empty
    if there is none.
    """
    if not sum(estimate.loose_counts):
        return ""
    counts = zip(
        estimate.distances, estimate.loose_counts, estimate.image_counts, strict=True
    )
    clauses = [
        f"{n_loose} of {n_images} at {distance:.3g} {unit}"
        for distance, n_loose, n_images in counts
        if n_loose
    ]
    return (
        "Not counted as seen, but not missed either, are loose boxes: "
        f"{', '.join(clauses)}."
    )


def _add_loose_fractions(estimate: DetectionDistance) -> list[float]:
    """Return at each distance the fraction of images with any box on the object.

    That is the fraction of right images plus that of images with only a loose box.
    """
    counts = zip(
        estimate.right_fractions,
        estimate.loose_counts,
        estimate.image_counts,
        strict=True,
    )
    return [fraction + n_loose / n_images for fraction, n_loose, n_images in counts]


def draw_detection_distance(estimate: DetectionDistance, axes: Any) -> None:
    """Draw the fraction of detections over the distance.

    A horizontal line marks one half, and a vertical one the detection distance.

    Args:
        estimate: estimate of the detection distance.
        axes: axes of matplotlib.
    """
    _draw_fractions(estimate, axes)
    axes.axhline(HALF, color=GREY, linewidth=1, linestyle=(0.0, (5.0, 4.0)))
    if estimate.distance is not None:
        axes.axvline(estimate.distance, color=GREY, linewidth=1)
    axes.set(
        xlabel=f"distance ({estimate.unit})",
        ylabel="share of pictures",
        ylim=(-0.02, 1.02),
    )
    axes.set_title("How far away it is seen")
    axes.grid(True)
    axes.legend()


def _draw_fractions(estimate: DetectionDistance, axes: Any) -> None:
    """Draw the fraction of detections at each distance, with its interval.

    Args:
        estimate: estimate of the detection distance.
        axes: axes of matplotlib.
    """
    distances = estimate.distances
    low, high = zip(*estimate.intervals, strict=True)
    band = {"color": BLUE, "alpha": 0.15, "linewidth": 0, "label": "95 % interval"}
    axes.fill_between(distances, low, high, **band)
    fractions = estimate.right_fractions
    axes.plot(distances, fractions, color=BLUE, marker="o", label="seen in")
    if any(estimate.loose_counts):
        loose_style = {"color": GREY, "marker": ".", "linestyle": ":"}
        any_box = _add_loose_fractions(estimate)
        axes.plot(distances, any_box, **loose_style, label="or in a loose box")
