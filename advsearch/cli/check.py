"""`advsearch check`: every derivative of a scene against differences, as a table."""

from __future__ import annotations

import argparse
from typing import Any

from advsearch.cli import output

HELP = "check the gradient of every parameter of a scene against differences"
GROUPS = ("scene", "model")
FIELDS = (
    "controls",
    "estimators",
    "spp",
    "denoise",
    "pixel_sampler",
    "objective",
    "seed",
    "threads",
    "epsilon",
    "norm",
)
"""The settings of `attack` that matter here, beside those of scene and model."""
FELL_SHORT = 3
SINGLE = (
    "object",
    "parameter",
    "estimator",
    "step",
    "gradient",
    "reference",
    "error",
    "noise",
    "seconds",
    "status",
)
"""Heads of a table of single parameters."""

_EXAMPLES = """examples:
  advsearch check --object mug --control pose
  advsearch check --object mug --control environment.rotation --loss linear --json
  advsearch check --all --resolution 128 --loss linear
"""


def add_parser(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add the command."""
    from advsearch.cli.flags import add_settings

    parser = subparsers.add_parser(
        "check",
        help=HELP,
        description=f"{HELP[0].upper()}{HELP[1:]}. Exit status 3 if one is biased or noisy.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    add_settings(parser, groups=GROUPS, fields=FIELDS)
    parser.add_argument("--all", action="store_true", help="every control, on three bundled scenes")
    parser.add_argument(
        "--loss", choices=["linear", "model", "both"], default="both", help="what is differentiated (default: both)"
    )
    output.add_flags(parser, quiet=True)


def run(args: argparse.Namespace) -> int:
    """Check, print the table; 3 if a gradient falls short."""
    from advsearch.cli.flags import config_from
    from advsearch.cli.progress import at_work
    from advsearch.config import AttackConfig

    config = config_from(args, AttackConfig, object="mug")
    losses = ("linear", "model") if args.loss == "both" else (args.loss,)
    with at_work(as_json=args.json, quiet=args.quiet) as progress:
        from advsearch.api.checking import check

        rows = check(config, losses=losses, everything=args.all, progress=progress)
    if args.json:
        output.print_json({"schema": 1, "command": "check", "rows": rows})
    else:
        print(table(rows))
    return FELL_SHORT if any(row["status"] in ("biased", "noisy") for row in _best(rows)) else 0


def _best(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """For each parameter and loss the row with the best status: an estimator that no plan would take may fall short.

    Of the model's loss the rows of whole controls count: what matters is where their gradient points.
    """
    rows = [row for row in rows if row["loss"] == "linear" or "cosine" in row]
    order = ("ok", "reference unusable", "noisy", "biased")
    best: dict[tuple[str, ...], dict[str, Any]] = {}
    for row in rows:
        key = tuple(str(row[name]) for name in ("object", "environment", "loss", "control", "parameter"))
        if key not in best or order.index(row["status"]) < order.index(best[key]["status"]):
            best[key] = row
    return list(best.values())


def table(rows: list[dict[str, Any]]) -> str:
    """Return the rows as text: one table for each loss."""
    parts = []
    for loss, title in (
        ("linear", "smooth linear loss of the raw picture"),
        ("model", "the model's loss, each parameter in the setting that is taken"),
    ):
        single = [row for row in rows if row["loss"] == loss and "cosine" not in row]
        if single:
            parts.append(f"{title}:\n" + output.columns([SINGLE, *map(_single, single)]))
    cosine = [row for row in rows if "cosine" in row]
    if cosine:
        heads = ["object", "control", "estimator", "step", "samples", "cosine", "converged", "seconds", "status"]
        body = [
            [
                row["object"],
                row["control"],
                row["estimator"],
                f"x {row['factor']:g}",
                str(row["spp"]),
                f"{row['cosine']:.3f}",
                f"{row['converged']:.3f}",
                f"{row['seconds']:.2f}",
                row["status"],
            ]
            for row in cosine
        ]
        parts.append("the model's loss, cosine with the converged gradient:\n" + output.columns([heads, *body]))
    return "\n\n".join(parts)


def _single(row: dict[str, Any]) -> list[str]:
    return [
        row["object"],
        f"{row['control']}.{row['parameter']}",
        row["estimator"],
        f"x {row['factor']:.2g}",
        f"{row['gradient']:.3g}",
        f"{row['reference']:.3g} +- {row['reference_noise']:.1g}",
        f"{100 * row['relative_error']:.1f} %",
        f"{100 * row['noise']:.0f} %",
        f"{row['seconds']:.2f}",
        row["status"],
    ]
