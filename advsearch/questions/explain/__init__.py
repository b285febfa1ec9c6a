"""`advsearch explain`: where a model is wrong and why, in words, from the rows of sweeps."""

from __future__ import annotations

from advsearch.cli.question import Positional, QuestionCommand

HELP = "say in words where a model is wrong, from the rows of sweeps, and confirm it by fresh renders"
EXAMPLES = (
    "explain mug-sweep-001",
    "explain mug-sweep-001 mug-sweep-002 --confirm 200 --accuracy 0.9",
    "explain mug-sweep-001 --confirm 0 --pairs 0 --json",
)

COMMAND = QuestionCommand("explain", about="sweeps", place=Positional("RUN", "the run of a sweep", several=True))
