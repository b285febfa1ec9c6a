"""Whether accuracy falls with the distance of a parameter from a value, and whether it does so more for some."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from advsearch.explanations.observations import Answered
from advsearch.questions.recipe.answer import NamedCount
from advsearch.questions.recipe.figures.base import rate_with_interval
from advsearch.questions.recipe.table import count_of
from advsearch.runs.results.base import Interval


@dataclass(frozen=True)
class Fall:
    """By how much less often the model is right far from a value than near it.

    Attributes:
        near: answers no farther than halfway.
        far: the others.
        fall: share of right answers near less that far.
        interval: of it, 95 %.
    """

    near: NamedCount
    far: NamedCount
    fall: float
    interval: Interval


def fall_of(
    name: str, rows: Sequence[Answered], values: Sequence[float], middle: float, turn: float | None, halfway: float
) -> Fall | None:
    """Compare the answers near a value with those far from it; None where there are none of one kind.

    Args:
        name: of the line.
        rows: its answers.
        values: of the parameter, one for each row.
        middle: the value that others are near to or far from.
        turn: after how much values come round; None where they do not.
        halfway: the distance up to which a value is near.
    """
    counts = {True: [0, 0], False: [0, 0]}
    for row, value in zip(rows, values, strict=True):
        count = counts[distance(value, middle, turn) <= halfway]
        count[0] += row.correct
        count[1] += 1
    near, far = (count_of(name, *counts[one]) for one in (True, False))
    if near.accuracy is None or far.accuracy is None or near.interval is None or far.interval is None:
        return None
    interval = _apart(near.accuracy, near.interval, far.accuracy, far.interval)
    return Fall(near, far, near.accuracy - far.accuracy, interval)


def distance(value: float, middle: float, turn: float | None) -> float:
    """Return how far a value lies from another, the shorter way round where values come round."""
    away = abs(value - middle)
    return away if turn is None else min(away % turn, turn - away % turn)


def _apart(one: float, own: Interval, other: float, others: Interval) -> Interval:
    """The interval of a difference of independent estimates from their own intervals (Newcombe 1998, method 10)."""
    low = math.hypot(one - own[0], others[1] - other)
    high = math.hypot(own[1] - one, other - others[0])
    return one - other - low, one - other + high


def said(falls: Sequence[Fall], along: str, near: str) -> list[str]:
    """Say of each line whether accuracy falls, and of two lines whether it does so more for one.

    Args:
        falls: of the lines.
        along: the parameter.
        near: what near means: ``within 90 degrees of 0``.
    """
    told = [f"{one.near.name}: {_fall(one, along, near)}" for one in falls]
    if len(falls) == 2:
        more, less = sorted(falls, key=lambda one: -one.fall)
        low, high = _apart(more.fall, more.interval, less.fall, less.interval)
        ends = f"{100 * (more.fall - less.fall):.0f} points (95 % interval {100 * low:.0f} to {100 * high:.0f})"
        known = f"more for {more.near.name} than for {less.near.name}"
        verdict = "the difference is shown" if low > 0.0 else "no difference is shown"
        told.append(f"Accuracy falls by {ends} {known}: {verdict}.")
    return told


def _fall(one: Fall, along: str, near: str) -> str:
    low, high = one.interval
    verdict = "it falls" if low > 0.0 else "it rises" if high < 0.0 else "no fall is shown"
    return (
        f"{rate_with_interval(one.near)} where {along} is {near}, {rate_with_interval(one.far)} elsewhere; "
        f"accuracy falls by {100 * one.fall:.0f} points (95 % interval {100 * low:.0f} to {100 * high:.0f}): {verdict}."
    )
