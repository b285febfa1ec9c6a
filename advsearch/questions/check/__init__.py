"""`advsearch check`: gradients of a scene beside differences, the plan of a search over it, and what it leaves out."""

from advsearch.cli.question import QuestionCommand

HELP = "check every gradient against differences; show how a search gets them and what it leaves out"
MORE = ". Exit status 3 if a gradient is biased or noisy"
EXAMPLES = (
    "check --object mug --control pose",
    "check --object mug --control environment.rotation --loss linear --json",
    "check --object mug --control texture,camera --loss model --seconds 120 --run derivatives",
    "check --all --resolution 128 --loss linear --seconds 600 --run gradients",
    "resume gradients",
)


COMMAND = QuestionCommand("check", short=lambda result: bool(result.falls_short))
