"""`advsearch compare`: two models, objects or answers beside each other, on the same pictures."""

from advsearch.cli.question import Positional, QuestionCommand

HELP = "compare models, objects or answers on the same pictures, pair by pair"
EXAMPLES = (
    "compare mug-sweep-001",
    "compare mug-sweep-001 mug-sweep-002 --json",
    "compare reference hardened.pt2 --object mug --control pose,camera --samples 200",
)

COMMAND = QuestionCommand(
    "compare",
    about="compared",
    place=Positional("WHAT", "the run of a sweep, or models and what they are shown", several=True),
)
