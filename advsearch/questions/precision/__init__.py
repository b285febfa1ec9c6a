"""Measure error against run time, draw it, and recommend settings."""

from __future__ import annotations

from advsearch.extend import RunContext, experiment
from advsearch.questions.precision.result import (
    PrecisionConfig,
    PrecisionResult,
    make_view,
)


@experiment(
    "precision --object mug --control pose",
    "precision --object mug --control texture --seconds 300 --error 0.1 --run diagrams",
    "precision --object bowl --control camera --quantities gradient --loss model --json",
    positional_args=("object", "model"),
    view=make_view,
)
def precision(context: RunContext[PrecisionConfig]) -> PrecisionResult:
    """Measure error against run time of a scene and its gradients
    (docs/precision.md).
    """
    # This import takes long, because it imports torch.
    from advsearch.questions.precision.carry_out import measure_precision

    return measure_precision(context)
