"""A hardening in words and a table."""

from __future__ import annotations

from typing import Any

from advsearch.report import wording
from advsearch.report.drawing import BLUE, RED, Figures, drawn
from advsearch.report.phrases import percent
from advsearch.runs.results.harden import HardenResult, Share

HEADS = ("on held-out scenes", "before", "95 % interval", "after", "95 % interval")
"""Of the columns."""

LINES = (("before", RED), ("after", BLUE))
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
    """Return two rows for each control, one of each search; one for all of them where there are several; and one for
    plain pictures."""
    return [[name, *_cells(before), *_cells(after)] for name, before, after in _shares(result)]


def _shares(result: HardenResult) -> list[tuple[str, Share | None, Share | None]]:
    """What was measured, before and after."""
    found = list[tuple[str, Share | None, Share | None]]()
    for row in result.table:
        found.append((f"robust to {row.control}", row.before, row.after))
        found.append((f"robust to {row.control}, stronger search", row.stronger_before, row.stronger))
    if len(result.table) > 1:
        found.append(("robust to each", result.before, result.after))
    if result.clean_after is not None:
        found.append(("plain pictures right", result.clean_before, result.clean_after))
    return found


def hardened_figure(result: HardenResult) -> Figures:
    """Draw each share before and after with its interval; nothing where none is known."""
    shares = _shares(result)
    if not shares:
        return {}

    def draw(figure: Any) -> None:
        axes = figure.subplots()
        for place, (_, *of_each) in enumerate(shares):
            for (label, color), share, up in zip(LINES, of_each, (place - 0.14, place + 0.14), strict=True):
                if share is not None:
                    axes.plot(share.interval, [up, up], color=color, alpha=0.35, linewidth=5)
                    axes.plot(share.accuracy, up, "o", color=color, ms=4, label=label if place == 0 else None)
        axes.set_yticks(range(len(shares)), [name for name, *_ in shares])
        axes.invert_yaxis()
        axes.set(xlabel="share that is right, with 95 % interval", xlim=(-0.03, 1.03))
        axes.set_title(f"Held-out scenes: {wording.short_name(result.model)}")
        axes.grid(True, axis="x")
        figure.legend(loc="outside lower center", ncols=len(LINES))

    return drawn(draw, (6.4, 1.4 + 0.45 * len(shares)))


def _cells(share: Share | None) -> tuple[str, str]:
    return ("", "") if share is None else (percent(share.accuracy), wording.interval_text(share.interval))
