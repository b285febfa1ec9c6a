"""A hardening in words and a table."""

from __future__ import annotations

from typing import Any

from advsearch.report import wording
from advsearch.report.drawing import BLUE, GREY, RED, Figures, drawn
from advsearch.report.phrases import percent
from advsearch.runs.results.harden import HardenResult, Share

HEADS = ("on held-out scenes", "before", "95 % interval", "after", "95 % interval", "stronger search", "95 % interval")
"""Of the columns."""

LINES = (("before", RED), ("after", BLUE), ("after, stronger search", GREY))
"""Names and colours of the figure."""


def hardened_text(result: HardenResult) -> str:
    """Return what came out, in a sentence."""
    before, after, clean, left = result.before, result.after, result.clean_before, result.clean_after
    if before is None or after is None or clean is None or left is None:
        return "Stopped before the hardened model was measured."
    return (
        f"Of {after.count} held-out scenes the searches leave {after.right} right, before {before.right}; "
        f"of {left.count} plain pictures {left.right} are right, before {clean.right}."
    )


def hardened_rows(result: HardenResult) -> list[list[str]]:
    """Return a row for each control, one for all of them where there are several, and one for plain pictures."""
    rows = [[f"robust to {row.control}", *_cells(row.before, row.after, row.stronger)] for row in result.table]
    if len(rows) > 1:
        rows.append(["robust to each", *_cells(result.before, result.after, None)])
    if result.clean_after is not None:
        rows.append(["plain pictures right", *_cells(result.clean_before, result.clean_after, None)])
    return rows


def hardened_figure(result: HardenResult) -> Figures:
    """Draw each share before, after and against the stronger search with its interval; nothing where none is known."""
    shares: list[tuple[str, tuple[Share, ...]]]
    shares = [(f"robust to {row.control}", (row.before, row.after, row.stronger)) for row in result.table]
    if result.clean_before is not None and result.clean_after is not None:
        shares.append(("plain pictures", (result.clean_before, result.clean_after)))
    if not shares:
        return {}

    def draw(figure: Any) -> None:
        axes = figure.subplots()
        for place, (_, of_each) in enumerate(shares):
            for number, share in enumerate(of_each):
                label, color = LINES[number]
                up = place + 0.22 * (number - 1)
                axes.plot(share.interval, [up, up], color=color, alpha=0.35, linewidth=5)
                axes.plot(share.accuracy, up, "o", color=color, ms=4, label=label if place == 0 else None)
        axes.set_yticks(range(len(shares)), [name for name, _ in shares])
        axes.invert_yaxis()
        axes.set(xlabel="share that is right, with 95 % interval", xlim=(-0.03, 1.03))
        axes.set_title(f"Held-out scenes: {wording.short_name(result.model)}")
        axes.grid(True, axis="x")
        figure.legend(loc="outside lower center", ncols=3)

    return drawn(draw, (6.4, 1.4 + 0.6 * len(shares)))


def _cells(*shares: Share | None) -> list[str]:
    found = []
    for one in shares:
        found += ["", ""] if one is None else [percent(one.accuracy), wording.interval_text(one.interval)]
    return found
