"""A region in words, a table and a map."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from advsearch.questions.region.answer import BoxSide, MarginMap, RegionResult
from advsearch.report.figures import MARGIN, Figures, axis_title, figure_of, heat
from advsearch.report.phrases import percent
from advsearch.report.shown import AnswerPart, Claim, Column, Extent, ShownAnswer, claim, share_text


def shown(result: RegionResult) -> ShownAnswer:
    """Return the box and what is known of it."""
    if result.box is None or result.interval is None:
        return ShownAnswer("Stopped before the box was known.")
    box: Mapping[str, Column] = {
        "parameter": "{0.name}",
        "from": "{0.low:.4g}",
        "to": "{0.high:.4g}",
        "centre": "{0.centre:.4g}",
        "unit": "{0.unit}",
    }
    return ShownAnswer(
        f"The model is {result.verdict} in {result.same} of {result.samples} fresh samples of this box: with 95 % "
        f"confidence in at least {percent(result.interval[0])} of it.",
        [AnswerPart.table(result.box, box, title="The box")],
        {"share of the space": percent(result.volume), "samples a pixel": str(result.spp or "")},
    )


def claims(result: RegionResult) -> Iterator[Claim]:
    """Yield in how much of the box the verdict stays."""
    if not result.samples or result.same is None or result.interval is None or result.verdict is None:
        return
    extent = Extent(
        what=f"samples that are {result.verdict}", count=result.same, total=result.samples, interval=result.interval
    )
    box = ", ".join(f"{side.name} {side.low:.4g} to {side.high:.4g} {side.unit}".strip() for side in result.box or ())
    text = (
        f"Inside {box or 'the box'} the model is {result.verdict} in {share_text(extent)} samples drawn evenly from it."
    )
    yield claim("measured", f"{text} Certified by sampling: single points of it may differ.", extent)


def map_figure(drawn: MarginMap, box: Sequence[BoxSide]) -> Figures:
    """Draw a map of the margin over two parameters, with the line at which the verdict changes, and the box."""

    def draw(axes: Any) -> None:
        (first, second), margins = drawn.axes, drawn.margins
        extent = (first.low, first.high, second.low, second.high)
        heat(axes, margins, extent, MARGIN, axis_title(first.name, first.unit), axis_title(second.name, second.unit))
        if min(map(min, margins)) < 0.0 < max(map(max, margins)):
            axes.contour(margins, levels=[0.0], extent=extent, colors="black", linewidths=1.0)
        across, up = box
        corners_x = [across.low, across.high, across.high, across.low, across.low]
        corners_y = [up.low, up.low, up.high, up.high, up.low]
        axes.plot(corners_x, corners_y, color="black", linestyle="--", label="region")
        axes.plot(across.centre, up.centre, "k+", label="centre")
        axes.legend(loc="upper right", frameon=True)

    return figure_of(draw, (6.0, 4.6))
