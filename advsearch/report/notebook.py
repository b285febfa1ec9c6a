"""Results as a notebook shows them: a verdict, pictures or a map, and a table, as HTML without styles of its own."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from advsearch.report import wording
from advsearch.report.drawing import Figures
from advsearch.report.markup import Html, element, join_html
from advsearch.report.phrases import answer_cells, beside_text, percent
from advsearch.report.studies import sweep_figure
from advsearch.runs.images import png_bytes
from advsearch.runs.results.attack import AttackSummary, VerifiedRate
from advsearch.runs.results.base import Interval
from advsearch.runs.results.sweep import AxisRow, SweepSummary

SHOWN = 224
"""Width of a picture on the page, in pixels."""

GAP = 4
"""White between pictures, in pixels."""

MOST_ROWS = 24
"""Values of an axis that are listed; of more, none."""


def attack_html(summary: AttackSummary, pictures: Mapping[str, ArrayLike]) -> str:
    """Return an attack's verdict, its pictures and its rates.

    Args:
        summary: of the attack.
        pictures: name to (H, W, 3) sRGB in [0, 1].
    """
    shown = [
        element(
            "figure", _picture(png_bytes(image), SHOWN, name), element("figcaption", name), style="display:inline-block"
        )
        for name, image in pictures.items()
    ]
    rows = [["", "answer", "probability", "rate", "95 % interval"]]
    success, control = wording.success(summary), summary.clean.control
    rate = (
        _rate("right", control.correct, control.trials, control.interval, control.not_a_number) if control else ["", ""]
    )
    rows.append(["clean", *answer_cells(summary.task, summary.clean), *rate])
    if summary.adversarial:
        rows.append(
            ["adversarial", *answer_cells(summary.task, summary.adversarial), *_verified(success, summary.verified)]
        )
    if summary.baseline:
        rows.append(["random search", "", "", *_verified(success, summary.baseline.verified)])
    return element("div", element("p", wording.attack_verdict(summary)), *shown, _table(rows))


def sweep_html(summary: SweepSummary) -> str:
    """Return a sweep's accuracy, its map, and the accuracy of every value of every axis."""
    if not summary.configurations:
        return element("p", "No configuration was looked at.")
    compared = [beside_text(summary.beside.answer, one) for one in summary.beside.pairs] if summary.beside else []
    total = f"Right in {summary.correct} of {summary.configurations} configurations"
    rate = f"{percent(summary.accuracy)}, 95 % interval {wording.interval_text(summary.interval)}"
    figure = sweep_figure(summary)
    rows = [["axis", "value", "configurations", "right", "accuracy", "95 % interval"]]
    for name in dict.fromkeys(row.axis for row in summary.axes):
        mine = [row for row in summary.axes if row.axis == name]
        rows += [axis_cells(row) for row in mine] if len(mine) <= MOST_ROWS else []
    drawn = _picture(figure["png"], 2 * SHOWN, "the numbers of the table") if figure else None
    return element(
        "div", element("p", " ".join(compared) or f"{total} ({rate})."), drawn, _table(rows) if len(rows) > 1 else None
    )


def study_html(said: str, figure: Figures, tables: Sequence[Sequence[Sequence[str]]]) -> str:
    """Return what a study says, its figure if it has one, and its tables, each of which begins with its heads."""
    drawn = _picture(figure["png"], 2 * SHOWN, "the numbers of the table") if figure else None
    return element("div", element("p", said), drawn, *map(_table, tables))


def side_by_side(pictures: Sequence[ArrayLike]) -> bytes:
    """Return pictures (H, W, 3) sRGB in [0, 1] beside each other as a PNG."""
    arrays = [np.asarray(one, dtype=np.float32) for one in pictures]
    gap = np.ones((len(arrays[0]), GAP, 3), np.float32)
    return png_bytes(np.concatenate([part for one in arrays for part in (one, gap)][:-1], axis=1))


def axis_cells(row: AxisRow) -> list[str]:
    """Return what a table says of a value of an axis: axis, value, configurations, right, accuracy, interval."""
    ends = row.value if isinstance(row.value, (list, tuple)) else [row.value]
    value = " to ".join(f"{end:g}" if isinstance(end, float) else str(end) for end in ends)
    unit = f" {row.unit}" if row.unit not in ("", "name") else ""
    counts = [str(row.configurations), str(row.correct)]
    return [row.axis, value + unit, *counts, percent(row.accuracy), wording.interval_text(row.interval)]


def _verified(what: str, rated: VerifiedRate | None) -> list[str]:
    return _rate(what, rated.successes, rated.trials, rated.interval, rated.not_a_number) if rated else ["", ""]


def _rate(what: str, number: int, trials: int, interval: Interval, not_a_number: int = 0) -> list[str]:
    return [wording.tally(what, number, trials, not_a_number), wording.interval_text(interval)]


def _picture(png: bytes, width: int, alt: str) -> Html:
    return element("img", src=f"data:image/png;base64,{base64.b64encode(png).decode()}", width=width, alt=alt)


def _table(rows: Sequence[Sequence[str]]) -> Html:
    head, *body = rows
    return element(
        "table",
        element("thead", element("tr", *(element("th", cell) for cell in head))),
        element("tbody", join_html(*(element("tr", *(element("td", cell) for cell in row)) for row in body))),
    )
