"""`advsearch compare`: two models, objects or answers beside each other, on the same pictures."""

from __future__ import annotations

import argparse
from pathlib import Path

from advsearch.cli.question import Positional, QuestionCommand

HELP = "compare models, objects or answers on the same pictures, pair by pair"
EXAMPLES = (
    "compare mug-sweep-001",
    "compare mug-sweep-001 mug-sweep-002 --json",
    "compare reference hardened.pt2 --object mug --control pose,camera --samples 200",
)


class _Compare(QuestionCommand):
    """The command, which is about stored sweeps unless it is said what models are shown."""

    def file(self, args: argparse.Namespace) -> Path | None:
        """Return the settings of the first sweep, if it is about stored ones."""
        return None if {"object", "scene"} & vars(args).keys() else super().file(args)


COMMAND = _Compare(
    "compare",
    about="compared",
    place=Positional("WHAT", "the run of a sweep, or models and what they are shown", several=True),
)
