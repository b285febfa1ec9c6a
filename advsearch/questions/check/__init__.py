"""Check every gradient against differences, and plan the gradients of a search.

The plan also states what a search does not render.
"""

from __future__ import annotations

from advsearch.extend import RunContext, errors, experiment
from advsearch.questions.check.result import CheckConfig, CheckResult, make_check_view


@experiment(
    "check --object mug --control pose",
    "check --object mug --control environment.rotation --loss linear --json",
    "check --object mug --control texture,camera --loss model --seconds 120 --run "
    "derivatives",
    "check --all --resolution 128 --loss linear --seconds 600 --run gradients",
    "resume gradients",
    positional_args=("object", "model"),
    help_suffix=". Exit status 3 if a gradient is biased or noisy",
    exit_status=lambda result: errors.FELL_SHORT if result.falls_short else 0,
    view=make_check_view,
)
def check(context: RunContext[CheckConfig]) -> CheckResult:
    """Compare every gradient of a scene with differences, and plan a search over it
    (docs/gradients.md).
    """
    from advsearch.questions.check.carry_out import GradientCheck  # imports torch

    return GradientCheck(context).run()
