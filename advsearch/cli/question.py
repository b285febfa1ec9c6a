"""A command that asks a question: its flags are the settings of its configuration, and its answer is printed."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from advsearch.cli import output

if TYPE_CHECKING:
    from pathlib import Path

    from advsearch.settings import Config

FELL_SHORT = 3
"""Exit status of a check that fell short."""


@dataclass(frozen=True)
class QuestionCommand:
    """A command that asks a question.

    Attributes:
        name: of the command; `advsearch.config.CONFIGS` has its settings, and `advsearch.api.carry_out` answers them.
        help: what it does, in a line.
        answer: makes a text for a person of its result.
        more: what the description says after that.
        examples: lines of a shell.
        short: whether a result falls short of what was checked.
    """

    name: str
    help: str
    answer: Callable[[Any], str]
    examples: tuple[str, ...]
    more: str = ""
    short: Callable[[Any], bool] = lambda result: False

    def add_parser(self, subparsers: argparse._SubParsersAction[Any]) -> argparse.ArgumentParser:
        """Add the command, with a flag for each of its settings."""
        from advsearch.cli.flags import add_settings
        from advsearch.config import CONFIGS

        parser: argparse.ArgumentParser = subparsers.add_parser(
            self.name,
            help=self.help,
            description=f"{self.help[0].upper()}{self.help[1:]}{self.more}.",
            epilog="\n  advsearch ".join(("examples:", *self.examples)) + "\n",
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )
        add_settings(parser, CONFIGS[self.name])
        output.add_flags(parser, quiet=True)
        return parser

    def run(self, args: argparse.Namespace) -> int:
        """Ask what the flags say."""
        from advsearch.cli.flags import config_from
        from advsearch.config import CONFIGS

        return self.carry_out(config_from(args, CONFIGS[self.name]), as_json=args.json, quiet=args.quiet)

    def carry_out(self, config: Config, *, as_json: bool, quiet: bool, resumed: Path | None = None) -> int:
        """Ask what `config` describes, or go on with it; print the answer and return the exit status."""
        from advsearch.cli.progress import at_work

        with at_work(as_json=as_json, quiet=quiet) as progress:
            from advsearch.api import carry_out

            result = carry_out(config, progress=progress, resumed=resumed)
        status = output.finish(result, self.answer, as_json=as_json)
        return status or (FELL_SHORT if self.short(result) else 0)
