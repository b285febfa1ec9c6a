"""What `precision` needs to know."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, Literal

from pydantic import field_validator

from advsearch.config.attack import AttackConfig, DerivativeConfig
from advsearch.config.scene import SceneConfig
from advsearch.settings import Clash, check_once, power, setting, setting_as_in, split_names

QUANTITIES = ("image", "gradient", "objective")
SAMPLERS = ("independent", "stratified", "multijitter", "orthogonal", "ldsampler")
"""What `precision` measures, and the samplers that it knows."""


def _without(quantity: str) -> Callable[[Any], object]:
    return lambda one: quantity not in split_names(one.quantities)


class PrecisionConfig(DerivativeConfig):
    """Everything that decides what `precision` does: error against run time, for a scene, its controls and a model."""

    command: ClassVar[str] = "precision"
    free: ClassVar[tuple[str, ...]] = (*DerivativeConfig.free, "workers", "cluster")
    clashes: ClassVar[tuple[Clash, ...]] = (
        *DerivativeConfig.clashes,
        *(
            Clash(name, _without(quantity), f"is of the {quantity}, which `quantities` leaves out; leave it out too")
            for name, quantity in (
                ("samplers", "image"),
                ("depths", "image"),
                ("loss", "gradient"),
                ("policies", "objective"),
                ("steps", "objective"),
                ("repeats", "objective"),
            )
        ),
        Clash("out", lambda one: one.run is not None, "is instead of a run; leave one of `out` and `run` out"),
    )

    quantities: str = setting(
        "image,gradient,objective", "search", "what is measured, separated by commas", "image, gradient, objective"
    )
    seconds: float = setting(120.0, "search", "time that all measurements may take", unit="seconds", gt=0.0, le=1e9)
    error: float = setting(0.05, "search", "relative error that the recommended settings should have", gt=0.0, le=1.0)
    rounds: int = setting(8, "search", "measurements of every setting, at most", ge=3, le=1000)
    samplers: str = setting(
        "independent,stratified,multijitter,orthogonal,ldsampler",
        "search",
        "samplers that are compared, separated by commas",
        "independent, stratified, multijitter, orthogonal, ldsampler",
    )
    depths: str = setting(
        "2,3,4,12",
        "search",
        "longest light paths that are compared with the run's own, separated by commas",
        "whole numbers from 2 to 64",
        unit="segments",
    )
    loss: Literal["linear", "model"] = setting(
        "linear",
        "search",
        "whose gradient is measured: a smooth linear loss of the raw picture, or the model's in its image formation",
    )
    policies: str = setting(
        "auto,random", "search", "policies that are compared, separated by commas", "names of policies"
    )
    steps: int = setting(32, "search", "renders of each search of a policy", ge=2, le=100_000)
    repeats: int = setting(5, "search", "searches of each policy, with other seeds", ge=1, le=1000)
    workers: int | None = setting_as_in(
        AttackConfig,
        "workers",
        description="worker processes that share the references; what is timed stays in this process",
    )
    cluster: str | None = setting_as_in(AttackConfig, "cluster")
    run: str | None = setting_as_in(SceneConfig, "run", otherwise="runs/OBJECT-precision-NNN")
    out: str | None = setting(
        None,
        "run",
        "where the figures and the numbers go, instead of a run directory",
        "the path of a folder",
        otherwise="a run directory",
        power=power.file,
        min_length=1,
    )

    @field_validator("quantities", "samplers", "depths", "policies", mode="before")
    @classmethod
    def _names_from_list(cls, value: Any) -> Any:
        """Accept a list of names for names separated by commas."""
        return ",".join(str(part) for part in value) if isinstance(value, (list, tuple)) else value

    @field_validator("quantities", "samplers", "depths", "policies")
    @classmethod
    def _several(cls, value: str, info: Any) -> str:
        """Refuse lists with nothing in them, with something twice, and with names that are not known."""
        names = split_names(value)
        known = {"quantities": QUANTITIES, "samplers": SAMPLERS}.get(info.field_name, names)
        if not "".join(names).strip() or not set(names) <= set(known):
            raise ValueError("nothing, or unknown names")
        check_once(names, info.field_name)
        return value

    @field_validator("depths")
    @classmethod
    def _depths_in_range(cls, value: str) -> str:
        if not all(part.isdecimal() and 2 <= int(part[:9]) <= 64 for part in split_names(value)):
            raise ValueError("out of range")
        return value

    @property
    def title(self) -> tuple[str, ...]:
        """The object, and what is asked of it."""
        return self.object, self.command


CONFIG = PrecisionConfig
