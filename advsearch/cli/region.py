"""`advsearch region`: how far one can go from a configuration before the model's verdict changes."""

from __future__ import annotations

import argparse
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from advsearch.cli import output
from advsearch.errors import InputError
from advsearch.files import Json

if TYPE_CHECKING:
    from advsearch.config import RegionConfig
    from advsearch.runs.results.region import RegionResult

HELP = "grow a box around a configuration in which the model's verdict stays the same"

_EXAMPLES = """examples:
  advsearch region --object mug --control pose.yaw,camera.elevation --map 24
  advsearch region --around mug-pose-001 --vary pose.yaw,pose.pitch
"""


def add_parser(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add the command."""
    from advsearch.cli.flags import add_settings
    from advsearch.config import RegionConfig

    parser = subparsers.add_parser(
        "region",
        help=HELP,
        description=f"{HELP[0].upper()}{HELP[1:]}.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    add_settings(parser, config=RegionConfig, without=("spp",))  # nothing is searched, so there is no such count
    output.add_code_flag(parser)
    output.add_flags(parser, quiet=True)


def run(args: argparse.Namespace) -> int:
    """Grow the region and print it."""
    from advsearch.cli.flags import config_from
    from advsearch.config import AttackConfig, RegionConfig, SceneConfig
    from advsearch.registry import only_named_code
    from advsearch.runs.directory import CONFIG, find_run

    otherwise: Json = {}
    guard: AbstractContextManager[None] = nullcontext()
    if "around" in args:
        file = find_run(args.around) / CONFIG
        theirs = AttackConfig.from_yaml(file)
        guard = only_named_code(file, [*args.code, getattr(args, "model", "").partition("@")[0]])
        otherwise = {
            name: getattr(theirs, name) for name in SceneConfig.model_fields if name not in ("run", "overwrite")
        }
    elif "object" not in args:
        raise InputError("advsearch region: expected --object NAME, or --around RUN; see advsearch region --help")
    with guard:
        return carry_out(config_from(args, RegionConfig, **otherwise), as_json=args.json, quiet=args.quiet)


def carry_out(config: RegionConfig, *, as_json: bool, quiet: bool, resumed: Path | None = None) -> int:
    """Do what `config` describes, or go on with it; print the region and return the exit status."""
    from advsearch.cli.progress import at_work

    with at_work(as_json=as_json, quiet=quiet) as progress:
        from advsearch.api.region import region_from_config

        result = region_from_config(config, progress=progress, resumed=resumed)
    return output.finish(result, answer, as_json=as_json)


def answer(result: RegionResult) -> str:
    """Return the box and what is known of it."""
    from advsearch.report import wording
    from advsearch.report.phrases import percent

    cost = [
        ["renders", str(result.renders["verification"])],
        ["time", wording.seconds_text(result.seconds["total"])],
        ["run", str(result.run)],
    ]
    if result.box is None or result.interval is None:
        return "Stopped before the box was known.\n\n" + output.columns(cost)
    said = (
        f"The model is {result.verdict} in {result.same} of {result.samples} fresh samples of this box: "
        f"with 95 % confidence in at least {100.0 * result.interval[0]:.1f} % of it."
    )
    rows = [["parameter", "from", "to", "centre", "unit"]]
    rows += [[one.name, f"{one.low:.4g}", f"{one.high:.4g}", f"{one.centre:.4g}", one.unit] for one in result.box]
    facts = [["share of the space", percent(result.volume)], *cost]
    return "\n\n".join([said, output.columns(rows), output.columns(facts)])
