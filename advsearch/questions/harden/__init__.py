"""Train a copy of a model on its worst cases, and measure it before and after on scenes that training never saw."""

from __future__ import annotations

from typing import Any

from advsearch.experiment import RunContext, experiment
from advsearch.questions.harden.result import HardenConfig, HardenResult, claims, shown


@experiment(
    "harden --model reference --control texture --epsilon 0.03 --quick",
    "harden --model mypackage:network@weights.safetensors --labels labels.json --control texture,pose,light",
    python_function="advsearch.questions.harden.carry_out:harden",
    view=shown,
    claims=claims,
)
def harden(asked: RunContext[HardenConfig], **given: Any) -> HardenResult:
    """Train a copy of a model on its worst cases, and prove what it is better at."""
    from advsearch.questions.harden.carry_out import hardened  # imports torch

    return hardened(asked, **given)
