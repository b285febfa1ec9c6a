"""Attacks each control alone and four mixtures on the bundled mug, beside a random search, from the command line.

    python benchmarks/every_control.py [--controls pose texture,pose] [--seed 0] [-- more flags of `advsearch attack`]

Every one has to end in a verified result, found or not, and never in one that is worse than the random search's with as
many renders: it fools the model in at least as many fresh renders, and its verified margin is as small, or larger by
less than noise and chance make of it (`TIE` logits). The exit status is 3 if one falls short.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from advsearch.attacks.verification import Ending
from advsearch.controls import CONTROLS

MIXTURES = ("pose,light", "camera,environment", "texture,pose", "geometry,material")
DECLARED = [kind for kind in CONTROLS if CONTROLS[kind].parameters]
"""Controls that search something when nothing is said."""
TIE = 0.3
"""Logits by which two verified margins of one configuration can differ."""
VERIFIED = frozenset(one.value for one in (Ending.FOUND, Ending.NOT_VERIFIED, Ending.BUDGET_SPENT, Ending.STALLED))
"""Endings with a verified result."""


def main(argv: Sequence[str] | None = None) -> int:
    """Attack, print one row each; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--controls", nargs="+", default=[*DECLARED, *MIXTURES])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("flags", nargs="*", help="more flags of the attack, after --")
    args = parser.parse_args(argv)
    print(f"{'controls':20s} {'ending':14s} {'wrong':>7s} {'random':>7s} {'margin':>8s} {'random':>8s} {'s':>6s}")
    short = []
    for controls in args.controls:
        summary = attacked(controls, args.seed, args.flags)
        good, row = judged(summary)
        print(f"{controls:20s} {row}{'' if good else '   WORSE'}", flush=True)
        short += [] if good else [controls]
    print(f"{len(args.controls)} attacks, {len(short)} fall short{': ' + ' '.join(short) if short else ''}")
    return 3 if short else 0


def attacked(controls: str, seed: int, flags: Sequence[str]) -> dict[str, Any]:
    """Return the summary of one attack."""
    with tempfile.TemporaryDirectory() as folder:
        words = ["--object", "mug", "--control", controls, "--seed", str(seed), "--run", str(Path(folder) / "run")]
        command = [sys.executable, "-m", "advsearch", "attack", *words, "--json", "--quiet", *flags]
        done = subprocess.run(command, stdout=subprocess.PIPE, check=True)
    summary: dict[str, Any] = json.loads(done.stdout)
    return summary


def judged(summary: dict[str, Any]) -> tuple[bool, str]:
    """Return whether a result is verified and not worse than random's, and its row."""
    ours, theirs = summary["verified"], summary["baseline"]["verified"]
    good = (
        summary["ending"] in VERIFIED
        and ours["trials"] == theirs["trials"] > 0
        and ours["successes"] >= theirs["successes"]
        and ours["margin"] <= theirs["margin"] + TIE
    )
    wrong = [f"{one['successes']}/{one['trials']}" for one in (ours, theirs)]
    row = f"{summary['ending']:14s} {wrong[0]:>7s} {wrong[1]:>7s} {ours['margin']:8.2f} {theirs['margin']:8.2f}"
    return good, f"{row} {summary['seconds']['total']:6.1f}"


if __name__ == "__main__":
    sys.exit(main())
