"""Grow a box around a configuration in which the model's verdict stays the same."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from advsearch.question import Asked, question
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.region.result import RegionConfig, RegionResult
from advsearch.questions.region.result import claims as claims
from advsearch.questions.region.result import shown as shown


def of_the_run(file: Path, typed: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the run around whose adversarial configuration a box grows brings: scene, model and controls."""
    return RegionConfig.shared(AttackConfig.from_yaml(file))


@question(
    "region --object mug --control pose.yaw,camera.elevation --map 24",
    "region --around mug-pose-001 --vary pose.yaw,pose.pitch",
    place=("object", "model"),
    about="around",
    brought=of_the_run,
)
def region(asked: Asked[RegionConfig]) -> RegionResult:
    """Grow the box around a configuration in which the verdict stays what it is (docs/questions.md)."""
    from advsearch.questions.region.growing import region_around  # imports torch

    return region_around(asked)
