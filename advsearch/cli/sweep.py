"""`advsearch sweep`: the average case, over a grid, over draws by chance, or both."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from advsearch.cli import output
from advsearch.errors import InputError

if TYPE_CHECKING:
    from advsearch.config import SweepConfig

HELP = "measure how often the model is right over a grid or a random sample of configurations"

_EXAMPLES = """examples:
  advsearch sweep --object mug --grid pose.yaw=0:360:24 --grid camera.elevation=5:60:8
  advsearch sweep --object mug,bowl --environment studio,noon --grid camera.azimuth=0,90,180,270
  advsearch sweep --object mug --control pose,camera --samples 1000
"""


def add_parser(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add the command."""
    from advsearch.cli.flags import add_settings
    from advsearch.config import SweepConfig

    parser = subparsers.add_parser(
        "sweep",
        help=HELP,
        description=f"{HELP[0].upper()}{HELP[1:]}.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    add_settings(parser, config=SweepConfig)
    output.add_flags(parser, quiet=True)


def run(args: argparse.Namespace) -> int:
    """Sweep and print the answer."""
    from advsearch.cli.flags import config_from
    from advsearch.config import SweepConfig

    if "grid" in args:
        args.grid = axes_as_text(args.grid)
    return carry_out(config_from(args, SweepConfig), as_json=args.json, quiet=args.quiet)


def carry_out(config: SweepConfig, *, as_json: bool, quiet: bool, resumed: Path | None = None) -> int:
    """Do the sweep that `config` describes, or go on with it; print its answer and return the exit status."""
    from advsearch.cli.progress import at_work

    with at_work(as_json=as_json, quiet=quiet) as progress:
        from advsearch.api.sweep import resume_sweep, sweep_from_config

        if resumed is not None:
            result = resume_sweep(resumed, progress=progress)
        else:
            result = sweep_from_config(config, progress=progress)
    from advsearch.cli.sweep_table import answer

    return output.finish(result.summary, answer, as_json=as_json)


def axes_as_text(given: Sequence[str]) -> list[str]:
    """Return ``PARAMETER=VALUES`` such that YAML takes 5:50:8 for text and not for a number to the base of 60.

    Raises:
        InputError: a parameter is given twice.
    """
    names = [text.partition("=")[0].strip() for text in given]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(f"--grid {twice[0]}: given twice; write all values in one, separated by commas")
    return [re.sub(r"=\s*([^\s\"'\[{].*)", lambda found: f'="{found[1]}"', text, count=1) for text in given]
