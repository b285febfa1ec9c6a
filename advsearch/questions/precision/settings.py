"""What `precision` needs to know."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from pydantic import field_validator

from advsearch.config.scene import DerivativeConfig, SceneConfig
from advsearch.settings import Clash, check_once, setting, setting_as_in, split_names

QUANTITIES = ("image", "gradient")
SAMPLERS = ("independent", "stratified", "multijitter", "orthogonal", "ldsampler")
"""What `precision` measures, and the samplers that it knows."""


class PrecisionConfig(DerivativeConfig):
    """Everything that decides what `precision` does: error against run time, for a scene, its controls and a model."""

    command: ClassVar[str] = "precision"
    clashes: ClassVar[tuple[Clash, ...]] = (
        *DerivativeConfig.clashes,
        Clash(
            "samplers",
            lambda config: "image" not in split_names(config.quantities),
            "is of the image, which `quantities` leaves out; leave it out too",
        ),
        Clash(
            "loss",
            lambda config: "gradient" not in split_names(config.quantities),
            "is of the gradient, which `quantities` leaves out; leave it out too",
        ),
    )

    quantities: str = setting(
        "image,gradient", "search", "what is measured, separated by commas", ", ".join(QUANTITIES)
    )
    seconds: float = setting(120.0, "search", "time that all measurements may take", unit="seconds", gt=0.0, le=1e9)
    error: float = setting(0.05, "search", "relative error that the recommended settings should have", gt=0.0, le=1.0)
    rounds: int = setting(8, "search", "measurements of every setting, at most", ge=3, le=1000)
    samplers: str = setting(
        ",".join(SAMPLERS), "search", "samplers that are compared, separated by commas", ", ".join(SAMPLERS)
    )
    loss: Literal["linear", "model"] = setting(
        "linear",
        "search",
        "whose gradient is measured: a smooth linear loss of the raw picture, or the model's in its image formation",
    )
    run: str | None = setting_as_in(SceneConfig, "run", otherwise="runs/OBJECT-precision-NNN")

    @field_validator("quantities", "samplers", mode="before")
    @classmethod
    def _names_from_list(cls, value: Any) -> Any:
        """Accept a list of names for names separated by commas."""
        return ",".join(str(part) for part in value) if isinstance(value, (list, tuple)) else value

    @field_validator("quantities", "samplers")
    @classmethod
    def _several(cls, value: str, info: Any) -> str:
        """Refuse lists with nothing in them, with something twice, and with names that are not known."""
        names = split_names(value)
        if not "".join(names).strip() or not set(names) <= set(
            QUANTITIES if info.field_name == "quantities" else SAMPLERS
        ):
            raise ValueError("nothing, or unknown names")
        check_once(names, info.field_name)
        return value

    @property
    def title(self) -> tuple[str, ...]:
        """The object, and what is asked of it."""
        return self.object, self.command


CONFIG = PrecisionConfig
