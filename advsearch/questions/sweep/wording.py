"""What a sweep found beside its shares, in rows and sentences: over drives, on the surface, and from how far away.

How far away a detector sees an object is the distance at which half of a sweep's pictures show it: where the falling
line through the shares (isotonic regression, Ayer et al. 1955, linear in the logarithm of the distance) crosses one
half. Its interval is exact: each of m shares is judged by the binomial test of one half at 0.025 / m on each side.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from advsearch.errors import InputError
from advsearch.questions.sweep.summary import AxisRow, SweepSummary
from advsearch.report.figures import BLUE, GREY
from advsearch.report.wording import count, short_name

if TYPE_CHECKING:
    from advsearch.questions.sweep.summary import (
        CountedAnswers,
        DriveRates,
        OverDrives,
        SurfaceMap,
        SurfacePart,
        SurfaceTable,
    )


DRIVE_HEADS = ("", "mean", "95 % interval", "worst drive")
"""What stands above the rows."""


def over_drives(summary: SweepSummary) -> str:
    """Return what the interval of a sweep over drives is over; nothing where there are none."""
    return ", over drives" if summary.drives else ""


def drive_title(one: DriveRates) -> str:
    """Return what drives they are, and of which model."""
    what = f"{count(one.drives, 'drive')} of {one.frames} frames in {one.seconds:g} s, {one.model}"
    return what if one.answer is None else f"{what}, with {one.answer}"


def drive_rows(one: DriveRates) -> list[tuple[str, str, str, str]]:
    """Return a row for each number, as `DRIVE_HEADS` says."""
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
    interval = f" ({low:+.0%} to {high:+.0%})" if low == low else ""  # none where pictures share draws
    return f"{part.difference:+.0%}{interval}".replace("%", " %")


DISTANCE = "camera.distance"
"""The axis."""
HALF = 0.5


@dataclass(frozen=True)
class SeenFrom:
    """The distance at which an object is first seen by somebody who comes nearer.

    Attributes:
        unit: of all distances: "metres", or "object sizes".
        distances: (m,) at which there are pictures, the nearest first.
        shares: (m,) of the pictures there in which it is seen.
        intervals: (m,) of these shares, 95 % each.
        distance: the estimate; None where it is seen at all distances, or at none.
        low, high: of the interval; None where the pictures do not bound it on that side.
        lacking: pictures at a distance that any bound takes, where no distance has so many; None where one has.
    """

    unit: str
    distances: tuple[float, ...]
    shares: tuple[float, ...]
    intervals: tuple[tuple[float, float], ...]
    distance: float | None
    low: float | None
    high: float | None
    lacking: int | None


def distance_of(summary: SweepSummary) -> SeenFrom | None:
    """Return how far away one model sees one object; None where the sweep does not tell."""
    rows = [row for row in summary.axes if row.axis == DISTANCE and row.configurations]
    several = "," in summary.object or "," in summary.model or summary.beside is not None
    several = several or summary.drives is not None  # frames of a drive are not independent
    known = summary.task.partition("=")[0] == "detection" and len(rows) > 1 and not several
    return seen_from(rows) if known else None


def seen_from(rows: Sequence[AxisRow]) -> SeenFrom:
    """Return the distance at which an object is first seen, from the rows of one axis: a distance, or both ends of a
    range of it, and the counts there. Raises InputError where there are fewer than two distances."""
    rows = sorted(rows, key=_middle)
    counted = [(_middle(row), row.correct, row.configurations) for row in rows]
    if len(counted) < 2:
        raise InputError(f"detection distance: expected at least two distances, got {len(counted)}; sweep over more")
    distances = tuple(at for at, _, _ in counted)
    chance = 0.025 / len(counted)
    least = math.floor(-math.log2(chance)) + 1
    low = max((at for at, k, n in counted if _at_least(k, n) < chance), default=None)
    below = [at for at, k, n in counted if _at_least(n - k, n) < chance and at > (low or 0.0)]
    return SeenFrom(
        unit=rows[0].unit,
        distances=distances,
        shares=tuple(k / n for _, k, n in counted),
        intervals=tuple(row.interval or (0.0, 1.0) for row in rows),
        distance=_crossing(distances, _falling([(float(k), float(n)) for _, k, n in counted])),
        low=low,
        high=min(below, default=None),
        lacking=None if any(n >= least for _, _, n in counted) else least,
    )


def distance_sentence(found: SeenFrom) -> str:
    """Say it: "Seen from 38 m, 31 to 44 m ..."."""
    unit = "m" if found.unit == "metres" else found.unit
    ends = f"{_text(found.low)} to {_text(found.high)}" if found.low is not None and found.high is not None else None
    if ends is None:
        ends = "no bound" if found.low is found.high else f"at least {_text(found.low)}"
        ends = f"at most {_text(found.high)}" if found.low is None and found.high is not None else ends
    what = f"{ends}{'' if ends == 'no bound' else f' {unit}'} with 95 % confidence"
    what += "" if found.lacking is None else f" (that takes at least {found.lacking} pictures at each distance)"
    if found.distance is not None:
        return f"Seen from {_text(found.distance)} {unit} in half of the pictures, {what}."
    if found.shares[0] >= HALF:
        farthest = f"{_text(found.distances[-1])} {unit}"
        return f"Seen in at least half of the pictures up to the farthest distance, {farthest}; {what}."
    return f"Not seen in half of the pictures, even from {_text(found.distances[0])} {unit}; {what}."


def distance_axes(found: SeenFrom, axes: Any) -> None:
    """Draw the share of pictures in which it is seen over the distance on matplotlib axes, with intervals."""
    low, high = zip(*found.intervals, strict=True)
    axes.fill_between(found.distances, low, high, color=BLUE, alpha=0.15, linewidth=0, label="95 % interval")
    axes.plot(found.distances, found.shares, color=BLUE, marker="o", label="seen in")
    axes.axhline(HALF, color=GREY, linewidth=1, linestyle=(0.0, (5.0, 4.0)))
    if found.distance is not None:
        axes.axvline(found.distance, color=GREY, linewidth=1)
    axes.set(xlabel=f"distance ({found.unit})", ylabel="share of pictures", ylim=(-0.02, 1.02))
    axes.set_title("How far away it is seen")
    axes.grid(True)
    axes.legend()


def _at_least(successes: int, trials: int) -> float:
    """The chance of so many successes or more, where each trial is one with a chance of a half."""
    ways: int = sum(math.comb(trials, k) for k in range(successes, trials + 1))
    return ways / (1 << trials)


def _middle(row: AxisRow) -> float:
    """A distance, or the middle of a range of it."""
    value = row.value
    return math.sqrt(value[0] * value[1]) if isinstance(value, tuple) else float(value)


def _falling(counts: Sequence[tuple[float, float]]) -> list[float]:
    """The shares (m,) of successes in trials, made to fall or stay from each to the next by pooling."""
    pools: list[list[float]] = []  # successes, trials, how many
    for successes, trials in counts:
        pools.append([successes, trials, 1.0])
        while len(pools) > 1 and pools[-1][0] / pools[-1][1] > pools[-2][0] / pools[-2][1]:
            last = pools.pop()
            pools[-1] = [a + b for a, b in zip(pools[-1], last, strict=True)]
    return [one[0] / one[1] for one in pools for _ in range(int(one[2]))]


def _crossing(distances: Sequence[float], shares: Sequence[float]) -> float | None:
    """Where a falling line through the shares passes one half; None where it does not."""
    for near, far, before, after in zip(distances, distances[1:], shares, shares[1:], strict=False):
        if before >= HALF > after:
            part = (before - HALF) / (before - after)
            return math.exp((1.0 - part) * math.log(near) + part * math.log(far))
    return None


def _text(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}"
