"""The charts of the report as inline SVG; colours come from the page's style sheet, so that they follow its scheme."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

from advsearch.report.markup import Html, element, join

HEIGHT = 300
_LEFT, _BOTTOM = 56, 44


@dataclass(frozen=True)
class Paper:
    """What a chart is drawn on.

    Attributes:
        css: class of the style sheet.
        width: in units of the drawing, of which a letter is about 7 wide.
        right, top: margins. The curves' names stand beside their ends, or in a line above where `right` has no room.
    """

    css: str
    width: int
    right: int
    top: int

    @property
    def names_above(self) -> bool:
        """Whether the curves' names stand in a line above them."""
        return self.right < 100


WIDE, NARROW = Paper("wide", 720, 120, 16), Paper("narrow", 350, 12, 36)
"""For a screen, and for a phone, on which letters of the wide one would be too small to read."""

MOST_POINTS = 400
"""Points of a curve that are drawn; of more, evenly spread ones."""


@dataclass(frozen=True)
class Curve:
    """The objective of one policy, evaluation by evaluation.

    Attributes:
        name: what stands beside its end.
        css: class of the style sheet.
        values: objective of each evaluation in order; None where it was not a number.
    """

    name: str
    css: str
    values: Sequence[float | None]


def objective_chart(curves: Sequence[Curve], objective: str, zero_means: str = "", paper: Paper = WIDE) -> Html:
    """Return the best objective so far (lines) and each single one (dots) over the number of evaluations.

    Args:
        curves: at least one with a finite value.
        objective: label of the vertical axis.
        zero_means: what stands at the zero line; no line when it is empty.
        paper: how wide it is.
    """
    finite = [value for curve in curves for value in curve.values if value is not None]
    low, high = min(finite), max(finite)
    if zero_means:
        low, high = min(low, 0.0), max(high, 0.0)
    margin = 0.06 * ((high - low) or 1.0)
    ticks = nice_ticks(low - margin, high + margin)
    frame = _Frame(max(len(curve.values) for curve in curves), low - margin, high + margin, paper)
    drawn = [_axes(frame, ticks, objective), _zero(frame, zero_means)]
    drawn += [_line(frame, curve, *at) for curve, at in zip(curves, _label_places(frame, curves), strict=True)]
    said = "; ".join(
        f"{curve.name}: from {_first(curve.values):.3g} to {_best(curve.values)[-1]:.3g}" for curve in curves
    )
    return element(
        "svg",
        element("title", f"{objective} over evaluations. {said}"),
        *drawn,
        viewBox=f"0 0 {paper.width} {HEIGHT}",
        class_=f"chart {paper.css}",
        role="img",
        aria_label=f"{objective} over evaluations. {said}",
    )


def interval_bar(rate: float, interval: tuple[float, float]) -> Html:
    """Return a bar from 0 to 1 with the confidence interval and the rate on it; decoration beside the numbers."""
    low, high, at = (2 + 96 * share for share in (*interval, rate))
    return element(
        "svg",
        element("rect", x=0, y=5, width=100, height=2, class_="track"),
        element("rect", x=f"{low:.1f}", y=3, width=f"{max(high - low, 1):.1f}", height=6, rx=1, class_="range"),
        element("rect", x=f"{at - 1:.1f}", y=0, width=2, height=12, class_="mark"),
        viewBox="0 0 100 12",
        class_="interval",
        aria_hidden="true",
    )


def nice_ticks(low: float, high: float, about: int = 5) -> list[float]:
    """Return round numbers in [low, high], 1, 2 or 5 times a power of ten apart, some `about` of them."""
    raw = (high - low) / about
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(power * factor for factor in (1.0, 2.0, 5.0, 10.0) if power * factor >= raw * 0.999)
    first = math.ceil(low / step - 1e-9)
    return [step * number for number in range(first, math.floor(high / step + 1e-9) + 1)]


@dataclass(frozen=True)
class _Frame:
    """Where data lies on the paper."""

    count: int
    low: float
    high: float
    paper: Paper

    @property
    def right(self) -> int:
        return self.paper.width - self.paper.right

    def x(self, number: float) -> float:
        return _LEFT + (self.right - _LEFT) * (number - 1) / max(self.count - 1, 1)

    def y(self, value: float) -> float:
        return HEIGHT - _BOTTOM - (HEIGHT - self.paper.top - _BOTTOM) * (value - self.low) / (self.high - self.low)


def _axes(frame: _Frame, ticks: Sequence[float], objective: str) -> Html:
    right, bottom, top = frame.right, HEIGHT - _BOTTOM, frame.paper.top
    parts = [
        join(
            element("line", x1=_LEFT, x2=right, y1=f"{frame.y(tick):.1f}", y2=f"{frame.y(tick):.1f}", class_="grid"),
            element("text", f"{tick:.4g}", x=_LEFT - 8, y=f"{frame.y(tick) + 4:.1f}", text_anchor="end"),
        )
        for tick in ticks
    ]
    numbers = [number for number in nice_ticks(1, max(frame.count, 2)) if number == int(number) and number >= 1]
    for number in sorted({1, *map(int, numbers)}):
        if number == 1 or frame.x(number) - frame.x(1) > 24:
            parts.append(element("text", str(number), x=f"{frame.x(number):.1f}", y=bottom + 18, text_anchor="middle"))
    parts.append(element("text", "evaluations", x=(_LEFT + right) / 2, y=HEIGHT - 6, text_anchor="middle"))
    turn = f"rotate(-90 14 {(top + bottom) / 2})"
    parts.append(element("text", objective, x=14, y=(top + bottom) / 2, text_anchor="middle", transform=turn))
    return join(*parts)


def _zero(frame: _Frame, meaning: str) -> Html:
    if not meaning:
        return Html("")
    y = frame.y(0.0)
    return join(
        element("line", x1=_LEFT, x2=frame.right, y1=f"{y:.1f}", y2=f"{y:.1f}", class_="zero"),
        element("text", meaning, x=frame.right - 4, y=f"{y - 5:.1f}", text_anchor="end", class_="note"),
    )


def _line(frame: _Frame, curve: Curve, label_x: float, label_y: float) -> Html:
    shown = _spread(len(curve.values))
    best = _best(curve.values)
    points = " ".join(f"{frame.x(i + 1):.1f},{frame.y(best[i]):.1f}" for i in shown)
    dots = [
        element("circle", cx=f"{frame.x(i + 1):.1f}", cy=f"{frame.y(value):.1f}", r=2)
        for i in shown
        if (value := curve.values[i]) is not None
    ]
    return element(
        "g",
        *dots,
        element("polyline", points=points),
        element("text", curve.name, x=f"{label_x:.1f}", y=f"{label_y + 4:.1f}"),
        class_=curve.css,
    )


def _best(values: Sequence[float | None]) -> list[float]:
    """Return the running maximum; before the first number, that number."""
    best, so_far = [], _first(values)
    for value in values:
        so_far = so_far if value is None else max(so_far, value)
        best.append(so_far)
    return best


def _first(values: Sequence[float | None]) -> float:
    return next(value for value in values if value is not None)


def _spread(count: int) -> list[int]:
    if count <= MOST_POINTS:
        return list(range(count))
    return sorted({round(i * (count - 1) / (MOST_POINTS - 1)) for i in range(MOST_POINTS)})


def _label_places(frame: _Frame, curves: Sequence[Curve]) -> list[tuple[float, float]]:
    """Return where the curves' names stand: beside their ends, or one after the other above them."""
    if frame.paper.names_above:
        widths = [0.0, *(8.0 * len(curve.name) + 16.0 for curve in curves[:-1])]
        return [(_LEFT + start, 14.0) for start in itertools.accumulate(widths)]
    ends = _apart([frame.y(_best(curve.values)[-1]) for curve in curves])
    return [(frame.x(len(curve.values)) + 8.0, end) for curve, end in zip(curves, ends, strict=True)]


def _apart(places: Sequence[float], least: float = 16.0) -> list[float]:
    """Return label positions moved so that no two are closer than `least`."""
    moved = list(places)
    order = sorted(range(len(moved)), key=lambda i: moved[i])
    for above, below in itertools.pairwise(order):
        moved[below] = max(moved[below], moved[above] + least)
    return moved
