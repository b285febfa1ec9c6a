from __future__ import annotations

from typing import Any, ClassVar, Literal

from pydantic import model_validator

from advsearch.questions.attack.settings import STEPS, AttackConfig
from advsearch.settings import setting, setting_as_in

ALL = "all"
"""The objects of a command that takes all bundled ones."""

PLAIN_SCENES, RENDERED_SCENES = 6, 15
"""Scenes that come with each one of the training, of which nothing is drawn but one view: plain ones, where nothing is
rendered, or such as are rendered. What is learned is lost on other scenes where there are few, and so is clean
accuracy."""

TEXTURE_LOOKS = 6
"""How often an epoch looks at a scene with a texture, over its views: it is another one each time, while what was
rendered stays."""

QUICK: dict[str, int] = {"rounds": 1, "scenes": 14, "views": 2, "epochs": 6, "measured": 14, "steps": 20}
"""What `quick` takes where nothing else was said: minutes instead of an hour."""


class HardenConfig(AttackConfig):
    """Everything that decides what `harden` does: training on worst cases, and the measurement before and after."""

    # fmt: off
    command: ClassVar[str] = "harden"
    several: ClassVar[tuple[str, ...]] = ("object", "environment")
    without: ClassVar[tuple[str, ...]] = (
        "smallest", "ensemble", "printable", "aov", "metrics", "log", "target", "minimise", "over", "draws", "path",
        "average", "baseline", "seconds", "camera", "up", "size", "unit", "label", "task", "measure", "estimators",
        "things", "judge",
    )

    object: str = setting_as_in(
        AttackConfig, "object", default=ALL,
        description="objects to train on, separated by commas; all: every bundled one that the model has a class for; "
        "a file is called as its class: coffee-mug.glb",
    )
    environment: str | None = setting_as_in(
        AttackConfig, "environment",
        description="what lights the training; several, separated by commas, take turns",
        otherwise="the bundled environments that the reference model was trained in",
    )
    held_out: str | None = setting(
        None, "scene", "objects that training never sees, which are measured, separated by commas",
        "names of objects or files", otherwise="other instances of the bundled objects", min_length=1,
    )
    held_out_environment: str | None = setting(
        None, "scene", "what lights the measurement, and never the training",
        "names of environments or files, separated by commas",
        otherwise="the bundled environments that the reference model was not trained in", min_length=1,
    )
    layers: Literal["all", "last"] = setting("all", "training", "layers that are trained")
    rounds: int = setting(2, "training", "rounds of search and training", ge=1, le=1000)
    scenes: int = setting(
        336, "training",
        f"new scenes a round for each control; of what is rendered {RENDERED_SCENES + 1} times as many",
        ge=1, le=100_000,
    )
    views: int = setting(2, "training", "views of each scene, unless it is rendered", ge=1, le=1000)
    epochs: int = setting(
        3, "training",
        "how often a round looks at each view; where a texture is searched, as many times as often as makes "
        f"{TEXTURE_LOOKS} for a scene, at most, over its views",
        ge=1, le=10_000,
    )
    rate: float = setting(1e-3, "training", "the highest learning rate", gt=0.0, le=1.0)
    clean_loss: float = setting(
        0.02, "training", "clean accuracy that may be lost; weights that lose more are not kept", ge=0.0, le=1.0
    )
    measured: int = setting(28, "verification", "held-out scenes that are attacked, before and after", ge=1, le=100_000)
    steps: int = setting_as_in(AttackConfig, "steps", default=STEPS, otherwise="")
    trials: int | None = setting_as_in(AttackConfig, "trials", default=6)
    verify_spp: int | None = setting_as_in(AttackConfig, "verify_spp", default=32)
    workers: int | None = setting_as_in(
        AttackConfig, "workers", description="worker processes that share the scenes that are drawn and attacked"
    )
    quick: bool = setting(False, "training", "minutes instead of an hour: fewer rounds, scenes and steps")
    # fmt: on

    @model_validator(mode="before")
    @classmethod
    def _quickly(cls, data: Any) -> Any:
        """Let `quick` say what is not said otherwise."""
        return {**QUICK, **data} if data.get("quick") is True else data

    @property
    def texture_looks(self) -> int:
        """How often an epoch looks at each view with a texture."""
        return max(1, TEXTURE_LOOKS // self.views)

    @property
    def title(self) -> tuple[str, ...]:
        """The command and the controls."""
        return self.command, *self.controls


CONFIG = HardenConfig
