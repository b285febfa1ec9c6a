"""Render a picture of a scene, and say what the model sees in it."""

from __future__ import annotations

from advsearch.config import RenderConfig
from advsearch.experiment import RunContext, experiment
from advsearch.report.views import ResultPart, ShownResult
from advsearch.report.wording import (
    VISIBLE_HEADS,
    format_image_prediction,
    format_image_prediction_cells,
    format_thing_rows,
)
from advsearch.runs.results import RenderResult


def make_view(result: RenderResult) -> ShownResult:
    """Return the view of a result: the files, and the predictions in each view."""
    height, width = result.size
    headline = f"{result.out}: {width} x {height} pixels"
    if result.answered:  # the name of a second file
        headline += f"\n{result.answered}: with the predictions drawn in"
    has_several_views = len(result.views) > 1
    if has_several_views:
        return ShownResult(headline, [_make_table_of_views(result)])
    return ShownResult(headline, _make_parts_of_view(result))


def _make_parts_of_view(result: RenderResult) -> list[ResultPart]:
    """Return what the model predicts in the only view, and the things that are in it."""
    view = result.views[0]
    predictions = [
        format_image_prediction_cells(result.task, answer) for answer in view.answers
    ]
    parts = [ResultPart(f"Model {result.model} sees", rows=predictions)]
    if view.things is not None:
        things = format_thing_rows(
            {name: vars(thing) for name, thing in view.things.items()}
        )
        # The first column has the names of the things, and no head.
        heads = ("", *VISIBLE_HEADS)
        parts.append(ResultPart("In the picture", column_heads=heads, rows=things))
    return parts


def _make_table_of_views(result: RenderResult) -> ResultPart:
    """Return a table of what the model predicts in each view, by its azimuth."""
    rows = []
    for view in result.views:
        predictions = [
            format_image_prediction(result.task, answer) for answer in view.answers
        ]
        rows.append([f"{view.azimuth:g}", "; ".join(predictions)])
    return ResultPart(column_heads=("azimuth", f"model {result.model} sees"), rows=rows)


@experiment(
    "render --object mug --environment kitchen --out mug.png",
    "render --object mug.obj --environment room.hdr --out around.png --around 8",
    "render --object mug --control 'pose={yaw: 30}' --set camera.elevation=50 --out "
    "mug.exr",
    python_function="advsearch.api.render:render",
    view=make_view,
)
def render(context: RunContext[RenderConfig]) -> RenderResult:
    """Render pictures of a scene, and say what the model sees in them."""
    from advsearch.api.render import render_picture_file  # imports torch

    return render_picture_file(context.config, progress=context.progress)
