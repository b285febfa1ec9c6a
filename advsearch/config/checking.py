"""What `check` and `plan` need to know."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from advsearch.config.attack import AttackConfig
from advsearch.settings import Clash, setting

OF_ALL: dict[str, Any] = {"object": "mug", "environment": None, "controls": {"texture": {}}, "set_": {}}
"""What is as it is unless it is given, and has to be left so with `all`."""


class CheckConfig(AttackConfig):
    """Everything that decides what `check` does: gradients of a scene against differences."""

    command: ClassVar[str] = "check"
    several: ClassVar[tuple[str, ...]] = ()

    clashes: ClassVar[tuple[Clash, ...]] = (
        *AttackConfig.clashes,
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

    all: bool = setting(False, "check", "every control, on three bundled scenes; takes hours", "true or false")
    loss: Literal["linear", "model", "both"] = setting(
        "both",
        "check",
        "what is differentiated: a smooth linear loss of the raw picture, the model's own, or both in turn",
        "linear, model or both",
    )
    seconds: float | None = setting(
        None,
        "check",
        "time after which no measurement is begun any more; `advsearch resume` goes on for as long again",
        "a number greater than 0 and at most 1e9",
        otherwise="no limit",
        unit="seconds",
        gt=0.0,
        le=1e9,
    )

    @property
    def losses(self) -> tuple[str, ...]:
        """What is differentiated, in turn."""
        return ("linear", "model") if self.loss == "both" else (self.loss,)


class PlanConfig(AttackConfig):
    """Everything that decides what `plan` does: how a search gets its derivatives, and what it leaves out."""

    command: ClassVar[str] = "plan"

    seconds: float | None = setting(
        None,
        "check",
        "time after which no measurement is begun any more; the plan says what it did not measure",
        "a number greater than 0",
        otherwise="no limit",
        unit="seconds",
        gt=0.0,
    )
