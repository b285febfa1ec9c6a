"""Grow a box around a configuration in which the model's verdict stays the same."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from advsearch.extend import AttackConfig, RunContext, experiment
from advsearch.questions.region.result import (
    RegionConfig,
    RegionResult,
    make_region_claims,
    make_region_view,
)


def read_shared_settings(file: Path, typed: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings that come from the run of `around`: scene, model,
    controls.
    """
    return RegionConfig.get_shared_settings(AttackConfig.from_yaml(file))


@experiment(
    "region --object mug --control pose.yaw,camera.elevation --map 24",
    "region --around mug-pose-001 --vary pose.yaw,pose.pitch",
    positional_args=("object", "model"),
    about="around",
    defaults_from_run=read_shared_settings,
    view=make_region_view,
    claims=make_region_claims,
)
def region(context: RunContext[RegionConfig]) -> RegionResult:
    """Grow the box around a configuration in which the verdict stays what it is
    (docs/questions.md).
    """
    from advsearch.questions.region.growing import find_region  # imports torch

    return find_region(context)
