"""`advsearch stability`: extreme scenes, objectives and arithmetic, and whether each of them holds."""

from __future__ import annotations

import argparse
import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING

from advsearch.cli import output
from advsearch.cli.question import QuestionCommand

if TYPE_CHECKING:
    from advsearch.evaluation.stability.case import Case
    from advsearch.runs.results.stability import StabilityResult

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
        from advsearch.cli.flags import config_from
        from advsearch.cli.progress import at_work
        from advsearch.config import StabilityConfig

        config = config_from(args, StabilityConfig)
        with at_work(as_json=args.json, quiet=args.quiet):
            from advsearch.evaluation.stability.suite import chosen

            cases = chosen(config.cases, config.groups)
        return _print_cases(cases, as_json=args.json)


def _print_cases(cases: Sequence[Case], *, as_json: bool) -> int:
    listed = [{"case": one.name, "group": one.group, "control": one.control, "holds": one.holds} for one in cases]
    if as_json:
        output.print_json({"schema": 1, "command": "stability", "cases": listed})
    else:
        rows = [[one.group, one.name, one.holds] for one in cases]
        print(output.columns([["group", "case", "what must hold"], *rows]))
    return 0


def fell_short(result: StabilityResult) -> bool:
    """Whether a case does not hold."""
    from advsearch.evaluation.stability.suite import OK

    return any(row.status != OK for row in result.rows)


def answer(result: StabilityResult) -> str:
    """Return the table, and where the run is."""
    return "\n\n".join([table(result), output.columns([["run", result.run]])])


def table(result: StabilityResult) -> str:
    """Return the rows as text: a table, what was measured, the number that decides where a case fell short, and what
    was not run."""
    from advsearch.evaluation.stability.suite import OK

    rows, left = result.rows, result.not_run
    heads = ["group", "case", "finite", "error", "ending", "seconds", "status"]
    body = [
        [
            row.group,
            row.case,
            "yes" if row.finite else "NO",
            "" if row.relative_error is None else f"{100.0 * row.relative_error:.2g} %",
            textwrap.shorten(row.ending, 30, placeholder=" ..."),
            f"{row.seconds:.1f}",
            row.status,
        ]
        for row in rows
    ]
    parts = [output.columns([heads, *body])]
    conditions = [
        f"  {row.case}: {name} {value:.3g}"
        for row in rows
        for name, value in row.measured.items()
        if name.startswith("condition number")
    ]
    if conditions:
        parts.append("condition numbers:\n" + "\n".join(conditions))
    short = [row for row in rows if row.status != OK]
    parts += [f"{row.case} fell short: {row.decides}\n  expected: {row.holds}" for row in short]
    if left:
        parts.append("not run: " + ", ".join(left))
    total = sum(row.seconds for row in rows)
    parts.append(f"{len(rows) - len(short)} of {len(rows)} cases hold, in {total:.0f} seconds")
    return "\n\n".join(parts)


COMMAND = _Stability("stability", answer, short=fell_short)
