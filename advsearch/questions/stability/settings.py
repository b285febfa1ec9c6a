"""What `stability` needs to know."""

from __future__ import annotations

from typing import Any, ClassVar

from pydantic import field_validator

from advsearch.config.attack import TimedConfig
from advsearch.config.scene import SceneConfig
from advsearch.settings import Clash, Config, as_text, check_once, setting, setting_as_in, split_names


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

    @field_validator("case", "group", "run", mode="before")
    @classmethod
    def _as_text(cls, value: Any, info: Any) -> Any:
        return as_text(value, several=info.field_name != "run")

    @field_validator("case", "group")
    @classmethod
    def _each_once(cls, value: str | None, info: Any) -> str | None:
        """Refuse a name that is given twice."""
        check_once(split_names(value or ""), info.field_name)
        return value

    @property
    def cases(self) -> tuple[str, ...]:
        """Names of cases."""
        return () if self.case is None else split_names(self.case)

    @property
    def groups(self) -> tuple[str, ...]:
        """Names of groups."""
        return () if self.group is None else split_names(self.group)


CONFIG = StabilityConfig
