"""`advsearch stability`: extreme scenes, objectives and arithmetic, and whether each of them holds."""

from __future__ import annotations

import argparse
from typing import Any

from advsearch.cli import output
from advsearch.cli.output import at_work
from advsearch.cli.question import QuestionCommand

HELP = "run stiff and extreme cases, and check that each of them holds"
MORE = ". Exit status 3 if one falls short"
EXAMPLES = (
    "stability",
    "stability --group objective --group stiff",
    "stability --case hdri-texel-100000 --json",
    "stability --seconds 120 --run extremes",
    "resume extremes",
    "stability --list",
)


class _Stability(QuestionCommand):
    """The command, which can list its cases too."""

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Add the settings and the flag that lists."""
        super().add_arguments(parser)
        parser.add_argument("--list", action="store_true", help="list the cases and run none")

    def run(self, args: argparse.Namespace) -> int:
        """Run the cases, or list them."""
        if not args.list:
            return super().run(args)
        with at_work(as_json=args.json, quiet=args.quiet):
            # late, so that --help answers at once
            from advsearch.questions.stability.carry_out import chosen

            config: Any = self.config(args)
            cases = chosen(config.cases, config.groups)
        if args.json:
            listed = [{"case": case.name, "group": case.group, "holds": case.holds} for case in cases]
            output.print_json({"schema": 1, "command": "stability", "cases": listed})
        else:
            rows = [[case.group, case.name, case.holds] for case in cases]
            print(output.aligned([["group", "case", "what must hold"], *rows]))
        return 0


COMMAND = _Stability("stability", short=lambda result: any(row.status != "ok" for row in result.rows))
