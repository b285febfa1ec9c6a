"""What a sweep over the frames of a path found, in rows: for the terminal and the page."""

from __future__ import annotations

from typing import TYPE_CHECKING

from advsearch.report.wording import count

if TYPE_CHECKING:
    from advsearch.runs.results.sweep import DriveRates, OverDrives


HEADS = ("", "mean", "95 % interval", "worst drive")
"""What stands above the rows."""


def drive_title(one: DriveRates) -> str:
    """Return what drives they are, and of which model."""
    what = f"{count(one.drives, 'drive')} of {one.frames} frames in {one.seconds:g} s, {one.model}"
    return what if one.answer is None else f"{what}, with {one.answer}"


def drive_rows(one: DriveRates) -> list[tuple[str, str, str, str]]:
    """Return a row for each number, as `HEADS` says."""
    rows = [
        ("frames in which it is right", *_texts(one.right, 100.0, " %")),
        ("longest gap", *_texts(one.longest_gap, 1.0, " s")),
        ("changes a second", *_texts(one.flicker, 1.0, "")),
    ]
    if one.first_seen is not None:
        never = f", never in {one.never_seen}" if one.never_seen else ""
        mean, interval, worst = _texts(one.first_seen, 1.0, f" {one.unit}")
        rows.insert(1, ("first right at a distance of", mean + never, interval, worst))
    return rows


def _texts(number: OverDrives, factor: float, unit: str) -> tuple[str, str, str]:
    low, high = (None, None) if number.interval is None else number.interval
    interval = "-" if low is None or high is None else f"{low * factor:.3g} to {high * factor:.3g}{unit}"
    return f"{number.mean * factor:.3g}{unit}", interval, f"{number.worst * factor:.3g}{unit}"
