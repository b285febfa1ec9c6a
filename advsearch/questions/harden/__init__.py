"""`advsearch harden`: train a copy of a model on its worst cases, and measure what came of it."""

from advsearch.cli.commands import QuestionCommand

HELP = "train a copy of a model on its worst cases, and measure it before and after on scenes that training never saw"
EXAMPLES = (
    "harden --model reference --control texture --epsilon 0.03 --quick",
    "harden --model mypackage:network@weights.safetensors --labels labels.json --control texture,pose,light",
)


COMMAND = QuestionCommand("harden")
