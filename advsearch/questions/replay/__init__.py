"""Render the adversarial scene of a run again under other conditions."""

from __future__ import annotations

from typing import Any

from advsearch.extend import PositionalArgument, RunContext, experiment
from advsearch.questions.replay.result import (
    ReplayConfig,
    ReplayResult,
    make_replay_claims,
    make_replay_view,
)


@experiment(
    "replay mug-texture-001",
    "replay mug-texture-001 --ways jpeg,sensor --model torchvision:resnet18 --json",
    about="attack",
    positional=PositionalArgument("RUN", "a run"),
    python_function="advsearch.questions.replay.conditions:replay",
    view=make_replay_view,
    claims=make_replay_claims,
)
def replay(context: RunContext[ReplayConfig], parts: Any = None) -> ReplayResult:
    """Render the adversarial scene of a run under other conditions.

    The clean scene is rendered under each condition, too.
    """
    from advsearch.questions.replay.conditions import run_replay  # imports torch

    return run_replay(context, parts)
