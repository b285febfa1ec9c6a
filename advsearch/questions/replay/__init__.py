"""Render the adversarial scene of a run again under other conditions, beside the clean scene."""

from __future__ import annotations

from advsearch.question import Asked, question
from advsearch.questions.replay.result import ReplayConfig, ReplayResult
from advsearch.questions.replay.result import claims as claims
from advsearch.questions.replay.result import shown as shown


@question(
    "replay mug-texture-001",
    "replay mug-texture-001 --ways jpeg,sensor --model torchvision:resnet18 --json",
    about="attack",
    expected=("RUN", "a run"),
    called="advsearch.questions.replay.conditions:replay",
)
def replay(asked: Asked[ReplayConfig]) -> ReplayResult:
    """Render the adversarial scene of a run under other conditions, each beside the clean scene."""
    from advsearch.questions.replay.conditions import rendered_again  # imports torch

    return rendered_again(asked)
