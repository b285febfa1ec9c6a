"""`advsearch gap`: the worst case beside the average, for each object and each control."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from advsearch.cli import output

if TYPE_CHECKING:
    from advsearch.config import GapConfig

HELP = "compare the worst case with the average over the same space, for each object and each control"

_EXAMPLES = """examples:
  advsearch gap --object mug --control pose,camera,texture
  advsearch gap --object mug,bowl,bottle --control pose --average 500 --steps 80
"""


def add_parser(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add the command."""
    from advsearch.cli.flags import add_settings
    from advsearch.config import GapConfig

    parser = subparsers.add_parser(
        "gap",
        help=HELP,
        description=f"{HELP[0].upper()}{HELP[1:]}.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    add_settings(parser, config=GapConfig, without=("smallest",))
    output.add_flags(parser, quiet=True)


def run(args: argparse.Namespace) -> int:
    """Compare and print the table."""
    from advsearch.cli.flags import config_from
    from advsearch.config import GapConfig

    return carry_out(config_from(args, GapConfig), as_json=args.json, quiet=args.quiet)


def carry_out(config: GapConfig, *, as_json: bool, quiet: bool, resumed: Path | None = None) -> int:
    """Do what `config` describes, or go on with it; print the table and return the exit status."""
    from advsearch.cli.progress import at_work

    with at_work(as_json=as_json, quiet=quiet) as progress:
        from advsearch.api.gap import gap_from_config

        summary = gap_from_config(config, progress=progress, resumed=resumed)
    from advsearch.cli.studies import answer

    return output.finish(summary, answer, as_json=as_json)
