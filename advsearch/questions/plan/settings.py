"""What `plan` needs to know."""

from __future__ import annotations

from typing import ClassVar

from advsearch.config.attack import DerivativeConfig, TimedConfig
from advsearch.config.scene import SceneConfig
from advsearch.settings import setting_as_in


class PlanConfig(DerivativeConfig):
    """Everything that decides what `plan` does: how a search gets its derivatives, and what it leaves out."""

    command: ClassVar[str] = "plan"
    free: ClassVar[tuple[str, ...]] = (*DerivativeConfig.free, "seconds")

    seconds: float | None = setting_as_in(TimedConfig, "seconds")
    run: str | None = setting_as_in(SceneConfig, "run", otherwise="runs/OBJECT-plan-NNN")

    @property
    def title(self) -> tuple[str, ...]:
        """The object, and what is asked of it."""
        return self.object, self.command


CONFIG = PlanConfig
