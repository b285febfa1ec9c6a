"""Render the adversarial scene of a run again under other conditions, beside the clean
scene.
"""

from __future__ import annotations

from typing import Any

from advsearch.extend import PositionalArgument, RunContext, experiment
from advsearch.questions.replay.result import ReplayConfig, ReplayResult, claims, shown


@experiment(
    "replay mug-texture-001",
    "replay mug-texture-001 --ways jpeg,sensor --model torchvision:resnet18 --json",
    about="attack",
    positional=PositionalArgument("RUN", "a run"),
    python_function="advsearch.questions.replay.conditions:replay",
    view=shown,
    claims=claims,
)
def replay(asked: RunContext[ReplayConfig], parts: Any = None) -> ReplayResult:
    """Render the adversarial scene of a run under other conditions, each beside the
    clean scene.
    """
    from advsearch.questions.replay.conditions import rendered_again  # imports torch

    return rendered_again(asked, parts)
