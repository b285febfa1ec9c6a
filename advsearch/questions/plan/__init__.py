"""`advsearch plan`: how every derivative of a search would be obtained and what it would leave out, and why."""

from __future__ import annotations

from advsearch.cli.question import QuestionCommand

HELP = "show how a search gets its gradients and what it leaves out, measured on its scene"
EXAMPLES = (
    "plan --object mug --control pose,texture",
    "plan --object mug --control camera --seconds 60 --run derivatives",
    "resume derivatives",
)
COMMAND = QuestionCommand("plan")
