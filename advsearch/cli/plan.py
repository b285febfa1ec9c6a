"""`advsearch plan`: how every derivative of a search would be obtained, and why."""

from __future__ import annotations

import argparse
from typing import Any

from advsearch.cli import output
from advsearch.cli.check import FIELDS, GROUPS

HELP = "show how the derivatives of a search are obtained, measured on its scene, and why"


def add_parser(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add the command."""
    from advsearch.cli.flags import add_settings

    parser = subparsers.add_parser(
        "plan",
        help=HELP,
        description=HELP[0].upper() + HELP[1:] + ".",
        epilog="examples:\n  advsearch plan --object mug --control pose,texture\n",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    add_settings(parser, groups=GROUPS, fields=FIELDS)
    output.add_flags(parser, quiet=True)


def run(args: argparse.Namespace) -> int:
    """Measure and print the plan."""
    from advsearch.cli.flags import config_from
    from advsearch.cli.progress import at_work
    from advsearch.config import AttackConfig

    config = config_from(args, AttackConfig, object="mug")
    with at_work(as_json=args.json, quiet=args.quiet) as progress:
        from advsearch.api.checking import plan

        chosen = plan(config, progress=progress)
    return output.finish(chosen, text, as_json=args.json)


def text(chosen: dict[str, Any]) -> str:
    """Return a plan as text."""
    rows = [["parameter", "numbers", "estimator", "step", "why"]]
    for group in chosen["groups"]:
        step = f"{group['step']:.3g}" if group["estimator"] not in ("adjoint", "image", "none", "material") else ""
        rows.append(
            [f"{group['control']}.{group['parameter']}", str(group["size"]), group["estimator"], step, group["reason"]]
        )
    lines = [
        output.columns(rows),
        "",
        f"renders for one gradient beside the picture itself: {chosen['renders_per_gradient']}",
        f"samples a pixel: {chosen['spp']}",
        "left out:",
        *(f"  {sentence}" for sentence in chosen["left_out"]),
    ]
    if chosen["cosines"]:
        heads = [
            "control",
            "denoiser",
            "step",
            "samples",
            "cosine with the converged gradient",
            "of two converged",
            "seconds",
        ]
        body = [
            [
                row["control"],
                row["denoise"],
                f"x {row['factor']:g}",
                str(row["spp"]),
                f"{row['cosine']:.3f}",
                f"{row['converged']:.3f}",
                f"{row['seconds']:.2f}",
            ]
            for row in chosen["cosines"]
        ]
        lines += ["", output.columns([heads, *body])]
        denoise = chosen["denoise"]
        lines += [
            "",
            f"denoiser asked for: {denoise['asked']}; better gradients: {denoise['advised']} ({denoise['reason']})",
        ]
    if chosen["limits"]:
        lines += ["", "limits of the material form:", *(f"  {limit}" for limit in chosen["limits"])]
    return "\n".join(lines)
