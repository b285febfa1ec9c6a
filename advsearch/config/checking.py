"""What `check`, `plan` and `stability` need to know."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from pydantic import field_validator

from advsearch.config.derivative import DerivativeConfig
from advsearch.config.scene import SceneConfig
from advsearch.settings import Clash, Config, as_text, check_once, setting, setting_as_in, split_names

OF_ALL: Mapping[str, object] = {"object": "mug", "environment": None, "controls": {"texture": {}}, "set_": {}}
"""What is as it is unless it is given, and has to be left so with `all`."""


class CheckConfig(DerivativeConfig):
    """Everything that decides what `check` does: gradients of a scene against differences."""

    command: ClassVar[str] = "check"
    free: ClassVar[tuple[str, ...]] = (*DerivativeConfig.free, "seconds")

    clashes: ClassVar[tuple[Clash, ...]] = (
        *DerivativeConfig.clashes,
        Clash(
            "all",
            lambda one: any(getattr(one, name) != value for name, value in OF_ALL.items()),
            "takes scenes and controls of its own; leave `object`, `environment`, `controls` and `set` out",
        ),
        Clash(
            "objective",
            lambda one: one.loss == "linear",
            "is of the model's loss, which `loss=linear` leaves out; leave one of the two out",
        ),
    )

    all: bool = setting(False, "check", "every control, on three bundled scenes; takes hours")
    loss: Literal["linear", "model", "both"] = setting(
        "both",
        "check",
        "what is differentiated: a smooth linear loss of the raw picture, the model's own, or both in turn",
    )
    seconds: float | None = setting(
        None,
        "check",
        "time after which no measurement is begun any more; `advsearch resume` goes on for as long again",
        otherwise="no limit",
        unit="seconds",
        gt=0.0,
        le=1e9,
    )
    run: str | None = setting_as_in(SceneConfig, "run", otherwise="runs/OBJECT-check-NNN")

    @property
    def title(self) -> tuple[str, ...]:
        """The object, or that it is of all, and what is asked of it."""
        return "all" if self.all else self.object, self.command

    @property
    def losses(self) -> tuple[str, ...]:
        """What is differentiated, in turn."""
        return ("linear", "model") if self.loss == "both" else (self.loss,)


class PlanConfig(DerivativeConfig):
    """Everything that decides what `plan` does: how a search gets its derivatives, and what it leaves out."""

    command: ClassVar[str] = "plan"
    free: ClassVar[tuple[str, ...]] = (*DerivativeConfig.free, "seconds")

    seconds: float | None = setting_as_in(CheckConfig, "seconds")
    run: str | None = setting_as_in(SceneConfig, "run", otherwise="runs/OBJECT-plan-NNN")

    @property
    def title(self) -> tuple[str, ...]:
        """The object, and what is asked of it."""
        return self.object, self.command


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
    seconds: float | None = setting_as_in(CheckConfig, "seconds")
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
