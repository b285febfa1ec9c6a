"""What `gap` needs to know."""

from __future__ import annotations

from typing import ClassVar

from advsearch.config.attack import AttackConfig
from advsearch.config.scene import SceneConfig
from advsearch.settings import setting_as_in


class GapConfig(AttackConfig):
    """Everything that decides what `gap` does: the worst case beside the average, for each object and each control."""

    command: ClassVar[str] = "gap"
    several: ClassVar[tuple[str, ...]] = ("object",)
    without: ClassVar[tuple[str, ...]] = ("smallest", "ensemble", "printable", "aov", "metrics", "log")

    model: str = setting_as_in(SceneConfig, "model")
    average: int = setting_as_in(AttackConfig, "average", default=200, ge=1)
    workers: int | None = setting_as_in(AttackConfig, "workers", description="worker processes that share the attacks")


CONFIG = GapConfig
