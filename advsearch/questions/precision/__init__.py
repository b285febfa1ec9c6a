"""`advsearch precision`: error against run time, as a table, JSON and diagrams."""

from advsearch.cli.question import QuestionCommand

HELP = "measure error against run time, draw it, and recommend settings"
EXAMPLES = (
    "precision --object mug --control pose",
    "precision --object mug --control texture --seconds 300 --error 0.1 --run diagrams",
    "precision --object bowl --control camera --quantities gradient --loss model --json",
)
COMMAND = QuestionCommand("precision")
