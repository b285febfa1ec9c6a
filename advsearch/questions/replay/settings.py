"""What `replay` needs to know."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from pydantic import field_validator

from advsearch.config.attack import FEWEST_TRIALS
from advsearch.config.scene import SceneConfig
from advsearch.settings import Clash, Config, each_once, setting, setting_as_in, split_names, texts

WAYS = ("samples", "resolution", "depth", "integrator", "sampler", "denoiser", "curve", "jpeg", "sensor", "blender")
"""What a replay may change beside the model."""

REPLAY_TRIALS = 10
"""Half of an attack's: there are many rows, to be compared. The 95 % interval of 10 of 10 begins at 69 %."""


class ReplayConfig(Config):
    """Everything that decides what `replay` does: which run's answer is rendered again, and under what conditions."""

    command: ClassVar[str] = "replay"
    clashes: ClassVar[tuple[Clash, ...]] = tuple(one for one in SceneConfig.clashes if one.setting == "overwrite")

    answer: str = setting(
        ..., "replay", "the run whose answer is rendered again", "the name or the folder of a run of attack"
    )
    ways: str | None = setting(
        None, "replay", "what is changed, separated by commas", f"some of {', '.join(WAYS)}", otherwise="all"
    )
    model: str | None = setting(
        None,
        "replay",
        "other models that the answer is tried on, separated by commas",
        "models as `attack` takes them",
        otherwise="none",
    )
    trials: int = setting(
        REPLAY_TRIALS, "replay", "fresh renders under each condition", unit="renders", ge=FEWEST_TRIALS, le=100_000
    )
    threads: int | None = setting_as_in(SceneConfig, "threads")
    run: str | None = setting_as_in(SceneConfig, "run", otherwise="runs/RUN-replay-NNN")
    overwrite: bool = setting_as_in(SceneConfig, "overwrite")

    _named = texts("answer", "run", several=["ways", "model"])
    _different = each_once("ways")

    @field_validator("ways")
    @classmethod
    def _known_ways(cls, value: str | None) -> str | None:
        if value is not None and set(split_names(value)) - set(WAYS):
            raise ValueError("an unknown way")
        return value

    @property
    def chosen(self) -> tuple[str, ...]:
        """What is changed."""
        return WAYS if self.ways is None else split_names(self.ways)

    @property
    def models(self) -> tuple[str, ...]:
        """The other models."""
        return () if self.model is None else split_names(self.model)

    @property
    def title(self) -> tuple[str, ...]:
        """The run, and what is asked of it."""
        return Path(self.answer).name, self.command


CONFIG = ReplayConfig
