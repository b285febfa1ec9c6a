"""Measure error against run time, draw it, and recommend settings."""

from __future__ import annotations

from advsearch.question import Asked, question
from advsearch.questions.precision.result import PrecisionConfig, PrecisionResult
from advsearch.questions.precision.result import shown as shown


@question(
    "precision --object mug --control pose",
    "precision --object mug --control texture --seconds 300 --error 0.1 --run diagrams",
    "precision --object bowl --control camera --quantities gradient --loss model --json",
    place=("object", "model"),
)
def precision(asked: Asked[PrecisionConfig]) -> PrecisionResult:
    """Measure error against run time of a scene and its gradients (docs/precision.md)."""
    from advsearch.questions.precision.carry_out import measured  # imports torch

    return measured(asked)
