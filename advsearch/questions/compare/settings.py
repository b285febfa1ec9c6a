"""What `compare` needs to know."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import ValidatorFunctionWrapHandler, field_validator, model_validator

from advsearch.config.scene import SceneConfig
from advsearch.config.sweep import SweepConfig
from advsearch.errors import InputError
from advsearch.settings import each_once, setting, setting_as_in, settings, split_names, texts

ALWAYS = ("compared", "pictures", "seed", "threads", "deterministic", "run", "overwrite")
"""The settings that mean something for stored sweeps, too."""


class CompareConfig(SweepConfig):
    """Everything that decides what `compare` does: which stored sweeps it reads, or the sweep that it makes first."""

    command: ClassVar[str] = "compare"
    without: ClassVar[tuple[str, ...]] = (
        *("model", "answer_of", "surface", "aov", "metrics", "log", "trials", "verify_spp", "path", "fps"),
    )

    compared: str = setting(
        ...,
        "compare",
        "what is compared, separated by commas: sweeps that are stored (one of several models, or several of the same "
        "draws), or models, where `object` says what they are shown",
        "names or folders of runs of sweep, or models",
    )
    pictures: int = setting(
        6,
        "compare",
        "pictures of what one side alone gets right that are shown, for each side; 0 for none",
        unit="pictures",
        ge=0,
        le=1000,
    )
    object: str = setting_as_in(
        SweepConfig,
        "object",
        default="",
        description="the object that models are shown, where models are compared; several, separated by commas",
    )
    keep_pictures: Literal["all", "wrong", "none"] = setting_as_in(SweepConfig, "keep_pictures", default="wrong")
    run: str | None = setting_as_in(SceneConfig, "run", otherwise="runs/WHAT-compare-NNN")

    _named = texts(several=["compared"])
    _different = each_once("compared")

    @field_validator("object", mode="wrap")
    @classmethod
    def _or_empty(cls, value: Any, read: ValidatorFunctionWrapHandler) -> Any:
        """Accept no object, which files have as an empty text."""
        return "" if value in ("", None) else read(value)

    @model_validator(mode="after")
    def _of_stored_or_made(self) -> CompareConfig:
        """Refuse what says how pictures are made where stored ones are compared, and a single model."""
        if not self.object:
            for one in settings(type(self)):
                if one.field not in ALWAYS and getattr(self, one.field) != one.default:
                    raise InputError(
                        f"{one.name}: says how models are shown pictures, and no `object` is named; add `object`, or "
                        "leave it out to compare stored sweeps"
                    )
        elif len(split_names(self.compared)) < 2:
            raise InputError(f"compared: expected at least two models, got {self.compared[:60]}; name another one")
        return self

    @property
    def title(self) -> tuple[str, ...]:
        """What is compared, and that it is."""
        return "-".join(Path(name).stem for name in split_names(self.object or self.compared)), self.command

    def sweep(self) -> SweepConfig:
        """Return the sweep of the models that has to be made first."""
        return SweepConfig.of(self, model=self.compared, trials=0)


CONFIG = CompareConfig
