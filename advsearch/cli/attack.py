"""`advsearch attack`: the worst configuration of a scene, searched for and verified."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from advsearch.cli import output

if TYPE_CHECKING:
    from pathlib import Path

    from advsearch.config import AttackConfig
    from advsearch.runs.results.attack import AttackSummary
    from advsearch.runs.results.gap import CurveResult

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
    from advsearch.config import AttackConfig

    return carry_out(config_from(args, AttackConfig), as_json=args.json, quiet=args.quiet)


def carry_out(config: AttackConfig, *, as_json: bool, quiet: bool, resumed: Path | None = None) -> int:
    """Run the attack that `config` describes, or go on with it; print its answer and return the exit status."""
    from advsearch.cli.progress import at_work

    with at_work(as_json=as_json, quiet=quiet) as progress:
        from advsearch.api.attack import attack_from_config, resume_attack
        from advsearch.api.gap import curve_from_config

        result: CurveResult | AttackSummary
        if config.is_study:
            result = curve_from_config(config, progress=progress, resumed=resumed)
        elif resumed is not None:
            result = resume_attack(resumed, progress=progress).summary
        else:
            result = attack_from_config(config, progress=progress).summary
    from advsearch.cli import studies, table

    return output.finish(result, (studies if config.is_study else table).answer, as_json=as_json)
