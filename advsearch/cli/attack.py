"""`advsearch attack`: the worst configuration of a scene, searched for and verified."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from advsearch.cli import output

if TYPE_CHECKING:
    from advsearch.config import AttackConfig

HELP = "find the configuration of a scene that the model gets wrong most badly"

_EXAMPLES = """examples:
  advsearch attack --object mug --control texture
  advsearch attack --object mug --control texture --epsilon 0.03 --set camera.azimuth=130 --seed 1
"""


def add_parser(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add the command."""
    from advsearch.cli.flags import add_settings

    parser = subparsers.add_parser(
        "attack",
        help=HELP,
        description=f"{HELP[0].upper()}{HELP[1:]}, and verify it with fresh renders.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    add_settings(parser)
    output.add_flags(parser, quiet=True)


def run(args: argparse.Namespace) -> int:
    """Search, verify, print the answer; 0 also when nothing was found."""
    from advsearch.cli.flags import config_from

    return attack(config_from(args), as_json=args.json, quiet=args.quiet)


def attack(config: AttackConfig, *, as_json: bool, quiet: bool) -> int:
    """Run the attack that `config` describes, print its answer and return the exit status."""
    from contextlib import nullcontext

    from advsearch.cli.main import INTERRUPTED, OK
    from advsearch.cli.progress import watching

    with output.output_kept_clean() if as_json else nullcontext(), watching(quiet=quiet) as progress:
        from advsearch.api import attack_from_config

        result = attack_from_config(config, progress=progress)
    if as_json:
        output.print_json(result.summary)
    else:
        from advsearch.cli.table import answer

        print(answer(result.summary))
    return INTERRUPTED if result.summary.get("ending") == "interrupted" else OK
