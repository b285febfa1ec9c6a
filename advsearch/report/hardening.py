"""A hardening in words and a table."""

from __future__ import annotations

from advsearch.report import wording
from advsearch.report.phrases import percent
from advsearch.runs.results.harden import HardenResult, Share

HEADS = ("on held-out scenes", "before", "95 % interval", "after", "95 % interval", "stronger search", "95 % interval")
"""Of the columns."""


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


def _cells(*shares: Share | None) -> list[str]:
    found = []
    for one in shares:
        found += ["", ""] if one is None else [percent(one.accuracy), wording.interval_text(one.interval)]
    return found
