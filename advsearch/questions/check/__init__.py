"""`advsearch check`: every derivative of a scene against differences, as a table."""

from __future__ import annotations

from typing import TYPE_CHECKING

from advsearch.cli.question import QuestionCommand

if TYPE_CHECKING:
    from advsearch.questions.check.answer import CheckResult

HELP = "check the gradient of every parameter of a scene against finite differences"
MORE = ". Exit status 3 if one is biased or noisy"
EXAMPLES = (
    "check --object mug --control pose",
    "check --object mug --control environment.rotation --loss linear --json",
    "check --all --resolution 128 --loss linear --seconds 600 --run gradients",
    "resume gradients",
)


def lacks_gradient(result: CheckResult) -> bool:
    """Whether a parameter has no good gradient by any estimator."""
    # late, so that --help answers at once
    from advsearch.questions.check.answer import short_names

    return bool(short_names(result.rows))


COMMAND = QuestionCommand("check", short=lacks_gradient)
