"""`advsearch replay`: the answer of a run under other conditions, in one table."""

from __future__ import annotations

from advsearch.cli.question import Positional, QuestionCommand

HELP = "render the answer of a run again under other conditions, beside the clean scene"
EXAMPLES = ("replay mug-texture-001", "replay mug-texture-001 --ways jpeg,sensor --model torchvision:resnet18 --json")


COMMAND = QuestionCommand("replay", about="answer", place=Positional("RUN", "a run"))
