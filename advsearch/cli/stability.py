"""`advsearch stability`: extreme scenes, objectives and arithmetic, and whether each of them holds."""

from __future__ import annotations

import argparse
import math
import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from advsearch.cli import output
from advsearch.errors import InputError

if TYPE_CHECKING:
    from advsearch.evaluation.stability.case import Case
    from advsearch.runs.results.stability import StabilityResult

HELP = "check numerical stability on stiff and extreme cases"
EXIT_FELL_SHORT = 3

_EXAMPLES = """examples:
  advsearch stability
  advsearch stability --group objective --group stiff
  advsearch stability --case hdri-texel-100000 --json
  advsearch stability --list
"""


def add_parser(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "stability",
        help=HELP,
        description=f"{HELP[0].upper()}{HELP[1:]}. Exit status 3 if one falls short.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--case", action="append", default=[], metavar="NAME", help="run this case; may be repeated")
    parser.add_argument("--group", action="append", default=[], metavar="NAME", help="run this group; may be repeated")
    parser.add_argument(
        "--seconds", type=_seconds, metavar="SECONDS", help="time after which no case is begun any more (default: none)"
    )
    parser.add_argument("--list", action="store_true", help="list the cases and run none")
    output.add_flags(parser, quiet=True)


def run(args: argparse.Namespace) -> int:
    """Run the cases, print the table; 3 if one falls short."""
    from advsearch.cli.progress import at_work

    with at_work(as_json=args.json, quiet=args.quiet) as progress:
        from advsearch.api.stability import stability
        from advsearch.evaluation.stability.suite import OK, chosen

        cases = chosen(args.case, args.group)
        if not args.list:
            result = stability(cases, seconds=args.seconds, progress=progress)
    if args.list:
        return _print_cases(cases, as_json=args.json)
    status = output.finish(result, table, as_json=args.json)
    return status or (0 if all(row.status == OK for row in result.rows) else EXIT_FELL_SHORT)


def _print_cases(cases: Sequence[Case], *, as_json: bool) -> int:
    listed = [{"case": one.name, "group": one.group, "control": one.control, "holds": one.holds} for one in cases]
    if as_json:
        output.print_json({"schema": 1, "command": "stability", "cases": listed})
    else:
        rows = [[one.group, one.name, one.holds] for one in cases]
        print(output.columns([["group", "case", "what must hold"], *rows]))
    return 0


def _seconds(text: str) -> float:
    """A number of seconds greater than 0."""
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not 0.0 < seconds < math.inf:
        raise InputError(f"--seconds: expected a number greater than 0, got {text}")
    return seconds


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
        parts.append("not run: " + ", ".join(left) + "; --case NAME runs one")
    total = sum(row.seconds for row in rows)
    parts.append(f"{len(rows) - len(short)} of {len(rows)} cases hold, in {total:.0f} seconds")
    return "\n\n".join(parts)
