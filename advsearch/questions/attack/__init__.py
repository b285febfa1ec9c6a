"""Find the configuration of a scene that the model gets wrong most badly."""

from __future__ import annotations

from advsearch.config import AttackConfig
from advsearch.question import Asked, question
from advsearch.questions.attack.answer import BY_FIELD as BY_FIELD
from advsearch.questions.attack.answer import CurveResult, MatrixResult
from advsearch.questions.attack.answer import claims as claims
from advsearch.questions.attack.answer import shown as shown
from advsearch.questions.attack.page import page as page
from advsearch.runs.results.attack import AttackSummary
from advsearch.runs.results.base import Result


@question(
    "attack --object mug --control texture",
    "attack --object mug --control texture --epsilon 0.03 --set camera.azimuth=130 --seed 1",
    "attack --object mug --model reference,torchvision:resnet18 --label mug,cup",
    called="advsearch.questions.attack.carry_out:attack",
)
def attack(asked: Asked[AttackConfig]) -> AttackSummary | CurveResult | MatrixResult:
    """Find the worst configuration of a scene, and verify it with fresh renders; or do so for several."""
    from advsearch.questions.attack.carry_out import attack_from_config  # imports torch

    answer = attack_from_config(asked.config, progress=asked.progress, resumed=asked.resumed)
    return answer if isinstance(answer, Result) else answer.summary
