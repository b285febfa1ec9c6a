"""Results as a notebook shows them: a verdict, pictures or a map, and a table, as HTML without styles of its own."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from typing import Any

from advsearch.report import wording
from advsearch.report.markup import Html, element, join
from advsearch.report.studies import sweep_figure
from advsearch.runs.images import png_bytes

SHOWN = 224
"""Width of a picture on the page, in pixels."""

MOST_ROWS = 24
"""Values of an axis that are listed; of more, none."""


def attack_html(summary: Mapping[str, Any], pictures: Mapping[str, Any]) -> str:
    """Return an attack's verdict, its pictures and its rates.

    Args:
        summary: of the attack.
        pictures: name to (H, W, 3) sRGB in [0, 1].
    """
    shown = [
        element("figure", _picture(png_bytes(image), SHOWN), element("figcaption", name), style="display:inline-block")
        for name, image in pictures.items()
    ]
    clean, found = summary.get("clean") or {}, summary.get("adversarial") or {}
    random = summary.get("baseline") or {}
    rows = [["", "answer", "probability", "rate", "95 % interval"]]
    rows.append(["clean", *_answer(clean), *_rate("right", clean.get("control") or {}, "correct")])
    if found:
        rows.append(["adversarial", *_answer(found), *_rate(wording.success(summary), summary.get("verified") or {})])
    if random:
        rows.append(["random search", "", "", *_rate(wording.success(summary), random.get("verified") or {})])
    return element("div", element("p", wording.verdict(summary)), *shown, _table(rows))


def sweep_html(summary: Mapping[str, Any]) -> str:
    """Return a sweep's accuracy, its map, and the accuracy of every value of every axis."""
    if not summary["configurations"]:
        return element("p", "No configuration was looked at.")
    total = f"Right in {summary['correct']} of {summary['configurations']} configurations"
    rate = f"{wording.percent(summary['accuracy'])}, 95 % interval {wording.interval_text(summary)}"
    figure = sweep_figure(summary)
    rows = [["axis", "value", "configurations", "right", "accuracy", "95 % interval"]]
    for name in dict.fromkeys(row["axis"] for row in summary["axes"]):
        mine = [row for row in summary["axes"] if row["axis"] == name]
        rows += [_axis_row(row) for row in mine] if len(mine) <= MOST_ROWS else []
    drawn = _picture(figure["png"], 2 * SHOWN) if figure else None
    return element("div", element("p", f"{total} ({rate})."), drawn, _table(rows) if len(rows) > 1 else None)


def _axis_row(row: Mapping[str, Any]) -> list[str]:
    ends = row["value"] if isinstance(row["value"], (list, tuple)) else [row["value"]]
    value = " to ".join(f"{end:g}" if isinstance(end, float) else str(end) for end in ends)
    unit = f" {row['unit']}" if row["unit"] not in ("", "name") else ""
    counts = [str(row["configurations"]), str(row["correct"])]
    return [row["axis"], value + unit, *counts, wording.percent(row["accuracy"]), wording.interval_text(row)]


def _answer(answer: Mapping[str, Any]) -> list[str]:
    known = answer.get("probability") is not None
    return [str(answer.get("label") or ""), wording.percent(answer["probability"]) if known else ""]


def _rate(what: str, rated: Mapping[str, Any], key: str = "successes") -> list[str]:
    return [f"{what} in {wording.tally(rated, key)}", wording.interval_text(rated)] if rated.get("trials") else ["", ""]


def _picture(png: bytes, width: int) -> Html:
    return element("img", src=f"data:image/png;base64,{base64.b64encode(png).decode()}", width=width)


def _table(rows: Sequence[Sequence[str]]) -> Html:
    head, *body = rows
    return element(
        "table",
        element("thead", element("tr", *(element("th", cell) for cell in head))),
        element("tbody", join(*(element("tr", *(element("td", cell) for cell in row)) for row in body))),
    )
