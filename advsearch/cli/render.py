"""`advsearch render`: a picture of a scene, or a sheet of views around it, with the model's answers."""

from __future__ import annotations

from typing import TYPE_CHECKING

from advsearch.cli import output
from advsearch.cli.question import QuestionCommand
from advsearch.report.phrases import seen_cells, seen_text

if TYPE_CHECKING:
    from advsearch.runs.results.base import RenderResult

HELP = "render a picture of a scene, and say what the model sees in it"
EXAMPLES = (
    "render --object mug --environment kitchen --out mug.png",
    "render --object mug.obj --environment room.hdr --out around.png --around 8",
    "render --object mug --control 'pose={yaw: 30}' --set camera.elevation=50 --out mug.exr",
)


def text(result: RenderResult) -> str:
    """Return what was written, and the model's answers view by view."""
    height, width = result.size
    lines = [f"{result.out}: {width} x {height} pixels"]
    lines += [f"{result.answered}: with the answers drawn in"] if result.answered else []
    lines += [""]
    if len(result.views) == 1:
        rows = [seen_cells(result.task, one) for one in result.views[0].answers]
        return "\n".join([*lines, f"Model {result.model} sees", output.aligned(rows)])
    rows = [["azimuth", f"model {result.model} sees"]]
    for view in result.views:
        rows.append([f"{view.azimuth:g}", "; ".join(seen_text(result.task, one) for one in view.answers)])
    return "\n".join([*lines, output.aligned(rows)])


COMMAND = QuestionCommand("render", text)
