from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import JsonValue, field_validator

from advsearch.config import SceneConfig, read_joined
from advsearch.files import MESHES, either
from advsearch.settings import Clash, Config, setting, setting_as_in, split_names

ALL_OBJECTS = "*"
"""Under this a label stands that is right for every object without one of its own."""

NAMED = "what the recipe names"


class RecipeConfig(Config):
    """Everything that decides what `recipe` does: which recipe, and on what objects, environments and models."""

    command: ClassVar[str] = "recipe"
    free: ClassVar[tuple[str, ...]] = (*Config.free, "photographs")
    clashes: ClassVar[tuple[Clash, ...]] = SceneConfig.clashes

    # fmt: off
    recipe: str = setting(
        ..., "recipe", "the experiment to run",
        "the name of a recipe, which advsearch recipe list shows, or a YAML file",
    )
    quick: bool = setting(False, "recipe", "few and small pictures, for a first look")
    photographs: str | None = setting(
        None, "recipe", "photographs to compare with renderings, of each object in a folder of its name", "a folder",
        otherwise="those taken with advsearch dashboard",
    )
    object: str | None = setting_as_in(
        SceneConfig, "object", default=None, otherwise=NAMED,
        description="the object that the model should recognise; several, separated by commas",
        expects=f"names of objects or {either(MESHES)} files",
    )
    environment: str | None = setting_as_in(
        SceneConfig, "environment", otherwise=NAMED,
        description="the environment map that lights the scene; several, separated by commas",
        expects="names of environments or .hdr or .exr files",
    )
    up: Literal["y", "z"] | None = setting_as_in(SceneConfig, "up")
    size: float | None = setting_as_in(SceneConfig, "size")
    unit: Literal["mm", "cm", "m", "in"] | None = setting_as_in(SceneConfig, "unit")
    resolution: tuple[int, int] | None = setting_as_in(
        SceneConfig, "resolution", otherwise="what the recipe says, or what the model takes"
    )
    model: str | None = setting_as_in(
        SceneConfig, "model", default=None, otherwise=NAMED,
        description="the network under test; several separated by commas",
    )
    labels: str | None = setting_as_in(SceneConfig, "labels")
    prompt: str | None = setting_as_in(SceneConfig, "prompt")
    task: str | dict[str, JsonValue] | None = setting_as_in(
        SceneConfig, "task", default=None, otherwise="what the recipe says, or classification"
    )
    label: dict[str, str] = setting(
        dict, "model",
        "the right answers, separated by commas, for all objects or one (OBJECT=LABELS); may be repeated",
        'names of classes, such as "coffee mug,cup" or mug="coffee mug,cup"',
        form="choices", metavar="LABELS", otherwise="each object's own",
    )
    seed: int = setting_as_in(SceneConfig, "seed")
    threads: int | None = setting_as_in(SceneConfig, "threads")
    deterministic: bool = setting_as_in(SceneConfig, "deterministic")
    run: str | None = setting_as_in(SceneConfig, "run", otherwise="runs/RECIPE-NNN")
    overwrite: bool = setting_as_in(SceneConfig, "overwrite")
    # fmt: on

    _named = field_validator(
        "recipe", "photographs", "object", "environment", "model", "labels", "task", "run", mode="before"
    )(lambda value, info: SceneConfig._as_text(value, info))
    _prompts = field_validator("prompt", mode="before")(lambda value: SceneConfig._prompts_as_text(value))
    _sized = field_validator("resolution", mode="before")(lambda value: SceneConfig._resolution_from_text(value))
    _in_range = field_validator("resolution")(lambda value: SceneConfig._resolution_in_range(value))
    _task = field_validator("task", mode="before")(lambda value: read_joined(value, "task", "classification"))

    @field_validator("photographs")
    @classmethod
    def _folder_from_anywhere(cls, value: str | None) -> str | None:
        """A run is gone on with from any folder."""
        return None if value is None else str(Path(value).expanduser().resolve())

    @field_validator("label", mode="before")
    @classmethod
    def _label_for_all(cls, value: Any) -> Any:
        """Accept one text for all objects."""
        return {ALL_OBJECTS: value} if isinstance(value, str) else value

    @field_validator("label")
    @classmethod
    def _labels_with_names(cls, value: dict[str, str]) -> dict[str, str]:
        if any(not text.strip(" ,\t\n") or "\0" in name + text for name, text in value.items()):
            raise ValueError("an empty name")
        return value

    @property
    def title(self) -> tuple[str, ...]:
        """The recipe's name, and the first object if one was asked for."""
        return (Path(self.recipe).stem, *(Path(name).stem for name in split_names(self.object or "")[:1]))

    def label_of(self, name: str) -> str | None:
        """Return what was said to be the right answer for an object; None for its own."""
        return self.label.get(name) or self.label.get(Path(name).stem) or self.label.get(ALL_OBJECTS)


CONFIG = RecipeConfig
