"""`advsearch gap`: the worst case beside the average."""

from __future__ import annotations

from advsearch.cli.question import QuestionCommand

HELP = "compare the worst case with the average over the same space, for each object and each control"
EXAMPLES = (
    "gap --object mug --control pose,camera,texture",
    "gap --object mug,bowl,bottle --control pose --average 500 --steps 80",
)

COMMAND = QuestionCommand("gap")
