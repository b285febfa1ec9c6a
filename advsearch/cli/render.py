"""`advsearch render`: a picture of a scene, or a sheet of views around it, with the model's answers."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from advsearch.cli import output

if TYPE_CHECKING:
    from advsearch.runs.results.render import ClassAnswer, RenderResult

HELP = "render a picture of a scene, and say what the model sees in it"
GROUPS = ("scene", "model", "picture")
FIELDS = ("denoise", "pixel_sampler", "seed", "threads", "deterministic")
"""The settings that matter here, beside those of the groups."""

_EXAMPLES = """examples:
  advsearch render --object mug --environment kitchen --out mug.png
  advsearch render --object mug.obj --environment room.hdr --out around.png --around 8
  advsearch render --object mug --control 'pose={yaw: 30}' --set camera.elevation=50 --out mug.exr
"""


def add_parser(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add the command."""
    from advsearch.cli.flags import add_settings
    from advsearch.config import RenderConfig

    parser = subparsers.add_parser(
        "render",
        help=HELP,
        description=f"{HELP[0].upper()}{HELP[1:]}.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    add_settings(parser, groups=GROUPS, fields=FIELDS, config=RenderConfig, without=("label",))
    output.add_flags(parser, quiet=True)


def run(args: argparse.Namespace) -> int:
    """Render, and print the model's answers."""
    from advsearch.cli.flags import config_from
    from advsearch.cli.progress import at_work
    from advsearch.config import RenderConfig

    config = config_from(args, RenderConfig)
    with at_work(as_json=args.json, quiet=args.quiet) as progress:
        from advsearch.api.render import render_from_config

        found = render_from_config(config, progress=progress)
    return output.finish(found, text, as_json=args.json)


def text(found: RenderResult) -> str:
    """Return what was written, and the model's answers view by view."""
    height, width = found.size
    lines = [f"{found.out}: {width} x {height} pixels", ""]
    if len(found.views) == 1:
        rows = [[one.label, _percent(one)] for one in found.views[0].answers]
        return "\n".join([*lines, f"Model {found.model} sees", output.columns(rows)])
    rows = [["azimuth", f"model {found.model} sees"]]
    for view in found.views:
        rows.append([f"{view.azimuth:g}", ", ".join(f"{one.label} {_percent(one)}".strip() for one in view.answers)])
    return "\n".join([*lines, output.columns(rows)])


def _percent(answer: ClassAnswer) -> str:
    return "" if answer.probability is None else f"{100 * answer.probability:.1f} %"
