"""`advsearch stability`: extreme scenes, objectives and arithmetic, and whether each of them holds."""

from __future__ import annotations

import argparse
import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from advsearch.cli import output

if TYPE_CHECKING:
    from advsearch.evaluation.stability.suite import Row

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
    parser.add_argument("--list", action="store_true", help="list the cases and run none")
    output.add_flags(parser, quiet=True)


def run(args: argparse.Namespace) -> int:
    """Run the cases, print the table; 3 if one falls short."""
    from advsearch.cli.progress import at_work

    with at_work(as_json=args.json, quiet=args.quiet) as progress:
        from advsearch.evaluation.stability.suite import OK, chosen, run_cases

        cases = chosen(args.case, args.group)
        rows = [] if args.list else list(run_cases(cases, progress))
    if args.list:
        listed = [{"case": one.name, "group": one.group, "control": one.control, "holds": one.holds} for one in cases]
        if args.json:
            output.print_json({"schema": 1, "command": "stability", "cases": listed})
        else:
            print(
                output.columns(
                    [["group", "case", "what must hold"]]
                    + [[one["group"], one["case"], one["holds"]] for one in listed]
                )
            )
        return 0
    if args.json:
        output.print_json({"schema": 1, "command": "stability", "rows": [row.to_dict() for row in rows]})
    else:
        print(table(rows))
    return 0 if all(row.status == OK for row in rows) else EXIT_FELL_SHORT


def table(rows: Sequence[Row]) -> str:
    """Return the rows as text: a table, what was measured, and the number that decides where a case fell short."""
    from advsearch.evaluation.stability.suite import OK

    heads = ["group", "case", "finite", "error", "ending", "seconds", "status"]
    body = [
        [
            row.case.group,
            row.case.name,
            "yes" if row.findings.finite else "NO",
            "" if row.findings.relative_error is None else f"{100.0 * row.findings.relative_error:.2g} %",
            textwrap.shorten(row.findings.ending, 30, placeholder=" ..."),
            f"{row.seconds:.1f}",
            row.status,
        ]
        for row in rows
    ]
    parts = [output.columns([heads, *body])]
    conditions = [
        f"  {row.case.name}: {name} {value:.3g}"
        for row in rows
        for name, value in row.findings.measured.items()
        if name.startswith("condition number")
    ]
    if conditions:
        parts.append("condition numbers:\n" + "\n".join(conditions))
    short = [row for row in rows if row.status != OK]
    parts += [f"{row.case.name} fell short: {row.decides}\n  expected: {row.case.holds}" for row in short]
    total = sum(row.seconds for row in rows)
    parts.append(f"{len(rows) - len(short)} of {len(rows)} cases hold, in {total:.0f} seconds")
    return "\n\n".join(parts)
