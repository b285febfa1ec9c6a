"""What `check` needs to know."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

from advsearch.config.scene import DerivativeConfig, SceneConfig, TimedConfig
from advsearch.settings import Clash, setting, setting_as_in

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
    seconds: float | None = setting_as_in(TimedConfig, "seconds")
    run: str | None = setting_as_in(SceneConfig, "run", otherwise="runs/OBJECT-check-NNN")

    @property
    def title(self) -> tuple[str, ...]:
        """The object, or that it is of all, and what is asked of it."""
        return "all" if self.all else self.object, self.command

    @property
    def losses(self) -> tuple[str, ...]:
        """What is differentiated, in turn."""
        return ("linear", "model") if self.loss == "both" else (self.loss,)


CONFIG = CheckConfig
