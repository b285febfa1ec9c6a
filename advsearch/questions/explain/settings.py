"""What `explain` needs to know."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from advsearch.config.scene import SceneConfig
from advsearch.settings import Clash, Config, each_once, setting, setting_as_in, split_names, texts


class ExplainConfig(Config):
    """Everything that decides what `explain` does: whose rows it reads, and what it renders to see whether it is so."""

    command: ClassVar[str] = "explain"
    clashes: ClassVar[tuple[Clash, ...]] = tuple(one for one in SceneConfig.clashes if one.setting == "overwrite")

    sweeps: str = setting(
        ...,
        "explain",
        "the sweeps whose rows are read together, separated by commas",
        "names or folders of runs of sweep, or of recipes with sweeps",
    )
    confirm: int = setting(
        100,
        "explain",
        "fresh configurations inside each rule that are rendered to confirm it; 0 for none",
        unit="renders",
        ge=0,
        le=100_000,
    )
    pairs: int = setting(
        12,
        "explain",
        "failures for which the nearest right configuration is looked for; 0 for none",
        unit="failures",
        ge=0,
        le=100,
    )
    clusters: int = setting(
        100,
        "explain",
        "failures that are rendered again and grouped by what the model decides by; 0 for none",
        unit="failures",
        ge=0,
        le=10_000,
    )
    accuracy: float = setting(
        0.95, "explain", "accuracy that the envelope promises, at 95 % confidence", gt=0.0, le=0.999
    )
    seed: int = setting_as_in(SceneConfig, "seed")
    threads: int | None = setting_as_in(SceneConfig, "threads")
    run: str | None = setting_as_in(SceneConfig, "run", otherwise="runs/RUN-explain-NNN")
    overwrite: bool = setting_as_in(SceneConfig, "overwrite")

    _named = texts("run", several=["sweeps"])
    _different = each_once("sweeps")

    @property
    def title(self) -> tuple[str, ...]:
        """The first run, and what is asked of it."""
        return Path(split_names(self.sweeps)[0]).name, self.command


CONFIG = ExplainConfig
