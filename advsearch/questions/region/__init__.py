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
    """Return the settings of the run of `around`: its scene, model and controls."""
    return RegionConfig.get_shared_settings(AttackConfig.from_yaml(file))


@experiment(
    "region --object mug --control pose.yaw,camera.elevation --map 24",
    "region --around mug-pose-001 --vary pose.yaw,pose.pitch",
    positional_args=("object", "model"),
    about="around",  # the setting that names the run which the experiment is about
    defaults_from_run=read_shared_settings,
    view=make_region_view,
    claims=make_region_claims,
)
def region(context: RunContext[RegionConfig]) -> RegionResult:
    """Grow a box around a configuration within which the verdict does not change
    (docs/questions.md).
    """
    from advsearch.questions.region.growing import find_region  # imports torch

    return find_region(context)
