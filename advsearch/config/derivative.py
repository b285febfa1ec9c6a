"""What every command that differentiates a scene needs to know."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from pydantic import field_validator

from advsearch.config.scene import SceneConfig
from advsearch.settings import Clash, check_once, parse_assignment, setting, setting_as_in
from advsearch.settings.configuration import Config

LARGEST_EPSILON = 1e6
"""No control has a distance of that size; far above it, its square is none in float32."""


class DerivativeConfig(SceneConfig):
    """What every command that differentiates a scene needs to know: budgets of the controls, and what is maximised."""

    # fmt: off
    clashes: ClassVar[tuple[Clash, ...]] = (
        *SceneConfig.clashes,
        Clash(
            "epsilon", lambda one: one.epsilons and "epsilon" not in one.several,
            "several make a curve, which only `advsearch attack` draws; give one",
        ),
    )

    object: str = setting_as_in(SceneConfig, "object", default="mug")
    epsilon: float | dict[str, float] | tuple[float, ...] | None = setting(
        None, "search",
        "how far a control may move from its start, in its own unit (for several controls CONTROL=NUMBER,...; in "
        "`attack` also NUMBER,NUMBER,... for a curve)",
        f"a number greater than 0 and at most {LARGEST_EPSILON:g}", otherwise="the control's own",
    )
    norm: Literal["linf", "l2"] | None = setting(
        None, "search", "norm in which epsilon is measured", otherwise="the control's own"
    )
    estimators: dict[str, str] = setting(
        dict, "search", "force a gradient estimator",
        "NAME for all controls, or CONTROL=NAME or CONTROL.PARAMETER=NAME; `advsearch plan` shows the names",
        alias="estimator", flag="--estimator", metavar="NAME", form="choices",
    )
    objective: str | None = setting(
        None, "search", "the objective that the search maximises", "the name of an objective",
        otherwise="the task's own: margin",
    )
    specialise: bool = setting(
        True, "search", "leave out what the scene and the search don't need", flag="--no-specialise",
        switched="compute everything, also what this search does not need; `advsearch plan` shows what is left out "
        "otherwise",
    )
    # fmt: on

    @field_validator("epsilon", mode="before")
    @classmethod
    def _epsilon_from_text(cls, value: Any) -> Any:
        """Accept ``0.05``, ``0.01,0.02`` and ``texture=0.05,geometry=0.01``; numbers in range, and none twice."""
        if isinstance(value, str):
            parts = [part.strip() for part in value.split(",")]
            if "=" in value:
                pairs = [parse_assignment(part, "epsilon") for part in parts]
                check_once((name for name, _ in pairs), "epsilon")
                value = dict(pairs)
            else:
                value = tuple(parts)
        if isinstance(value, (list, tuple)) and len(value) == 1:
            value = value[0]
        if isinstance(value, Mapping):
            numbers = [_positive(one) for one in value.values()]
        elif isinstance(value, (list, tuple)):
            numbers = [_positive(one) for one in value]
            check_once((f"{one:g}" for one in numbers), "epsilon")
        else:
            numbers = [1.0 if value is None else _positive(value)]
        if not numbers:
            raise ValueError("nothing is named")
        return value

    @property
    def epsilons(self) -> tuple[float, ...]:
        """The several epsilons of a curve; empty where there is one."""
        return self.epsilon if isinstance(self.epsilon, tuple) else ()


def _positive(value: Any) -> float:
    """A number of an epsilon."""
    try:
        number = float("nan") if isinstance(value, bool) else float(value)
    except (TypeError, OverflowError):
        raise ValueError("not a number") from None
    if not 1e-30 < number <= LARGEST_EPSILON:  # what is smaller has no square in float32
        raise ValueError("out of range")
    return number


class TimedConfig(Config):
    """A question that may run out of time."""

    # fmt: off
    seconds: float | None = setting(
        None, "check",
        "time after which no measurement is begun any more; `advsearch resume` goes on for as long again",
        otherwise="no limit", unit="seconds", gt=0.0, le=1e9,
    )
    # fmt: on
