"""What `stability` needs to know."""

from __future__ import annotations

from typing import ClassVar

from advsearch.config.scene import SceneConfig, TimedConfig
from advsearch.settings import Clash, Config, each_once, setting, setting_as_in, split_names, texts


class StabilityConfig(Config):
    """Everything that decides what `stability` does: which cases it tries, for how long, and where that is kept."""

    command: ClassVar[str] = "stability"
    free: ClassVar[tuple[str, ...]] = (*Config.free, "seconds")
    clashes: ClassVar[tuple[Clash, ...]] = tuple(one for one in SceneConfig.clashes if one.setting == "overwrite")

    case: str | None = setting(
        None, "check", "cases to try, separated by commas", "names of cases", otherwise="all", form="names"
    )
    group: str | None = setting(
        None, "check", "groups of cases to try, separated by commas", "names of groups", otherwise="all", form="names"
    )
    seconds: float | None = setting_as_in(TimedConfig, "seconds")
    run: str | None = setting_as_in(SceneConfig, "run", otherwise="runs/stability-NNN")
    overwrite: bool = setting_as_in(SceneConfig, "overwrite")

    _named = texts("run", several=["case", "group"])
    _different = each_once("case", "group")

    @property
    def cases(self) -> tuple[str, ...]:
        """Names of cases."""
        return () if self.case is None else split_names(self.case)

    @property
    def groups(self) -> tuple[str, ...]:
        """Names of groups."""
        return () if self.group is None else split_names(self.group)


CONFIG = StabilityConfig
