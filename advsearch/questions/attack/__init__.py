"""Find the configuration of a scene that the model gets wrong most badly."""

from __future__ import annotations

from advsearch.experiment import RunContext, experiment
from advsearch.questions.attack.display import make_attack_claims, make_attack_view
from advsearch.questions.attack.page import make_page
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.attack.summary import (
    BY_FIELD,
    AttackSummary,
    CurveResult,
    MatrixResult,
)


@experiment(
    "attack --object mug --control texture",
    "attack --object mug --control texture --epsilon 0.03 --set camera.azimuth=130 "
    "--seed 1",
    "attack --object mug --model reference,torchvision:resnet18 --label mug,cup",
    python_function="advsearch.questions.attack.python:attack",
    view=make_attack_view,
    claims=make_attack_claims,
    page=make_page,
    other_results=BY_FIELD,  # a curve and a matrix, instead of an `AttackSummary`
)
def attack(
    context: RunContext[AttackConfig],
) -> AttackSummary | CurveResult | MatrixResult:
    """Find the worst configuration of a scene, and verify it with fresh renders.

    Several objects or epsilons make a curve of robust accuracy, and several models a
    matrix of adversarial scenes and models.
    """
    # imported here because they import torch
    from advsearch.questions.attack.run import attack_once
    from advsearch.questions.attack.studies import curve, matrix

    if context.config.is_study:
        return matrix(context) if context.config.is_matrix else curve(context)
    return attack_once(
        context.config, progress=context.progress, resumed=context.resumed_directory
    ).summary
