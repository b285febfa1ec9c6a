"""A recipe as its YAML file describes it, and the runs that it comes to: a part is
carried out once for each object.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib import resources
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from advsearch.extend import (
    AttackConfig,
    InputError,
    SceneConfig,
    SweepConfig,
    errors,
    seeds,
    settings,
)
from advsearch.questions.recipe.result import RecipeConfig

CONFIGS: Mapping[str, type[SceneConfig]] = {
    "attack": AttackConfig,
    "sweep": SweepConfig,
}
"""The settings of a part, by its command."""
PHOTOGRAPHS = "photographs"  # the part that photographs are of
OF_THE_COMMAND = (*settings.PLACE, "seed", "threads", "deterministic")
"""Settings that are said with the command and not in its file."""

MOST_PARTS = 64
MOST_FIGURES = 32
MOST_RUNS = 1000

BUNDLED = resources.files("advsearch.questions.recipe")

Settings = dict[str, object]


class _Described(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Part(_Described):
    """Runs of one command, one for each object. It draws from the distributions that
    the searches of the part `around` found, or the very configurations that the part
    `drawn_as` does, which has the same ranges.
    """

    command: Literal["attack", "sweep"]
    settings: Settings = Field(default_factory=dict)
    around: str | None = None
    drawn_as: str | None = None

    @field_validator("settings")
    @classmethod
    def _not_own(cls, value: Settings) -> Settings:
        for name in (*OF_THE_COMMAND, "object", "label"):
            if name in value:
                raise ValueError(
                    f"{name!r} is the same for all parts; leave it out here"
                )
        return value


class Changes(_Described):
    """What `quick` makes different: settings of all parts, settings of each, and parts
    that are left out.
    """

    settings: Settings = Field(default_factory=dict)
    parts: dict[str, Settings] = Field(default_factory=dict)
    without: list[str] = Field(default_factory=list)


class Recipe(_Described):
    """What a recipe's file says (docs/recipes.md): its question, what is done for a
    result and whose experiment it is, settings of all parts, parts in the order in
    which they are carried out, figures with a `figure`, their kind, and options, groups
    of objects by name, and what is different when it should be quick.
    """

    title: Annotated[str, Field(min_length=1, max_length=200)]
    about: Annotated[str, Field(max_length=2000)] = ""
    settings: Settings = Field(default_factory=dict)
    parts: Annotated[dict[str, Part], Field(min_length=1, max_length=MOST_PARTS)]
    figures: Annotated[list[dict[str, Any]], Field(max_length=MOST_FIGURES)] = Field(
        default_factory=list
    )
    groups: dict[str, list[str]] = Field(default_factory=dict)
    quick: Changes = Field(default_factory=Changes)

    @field_validator("settings")
    @classmethod
    def _no_place(cls, value: Settings) -> Settings:
        for name in OF_THE_COMMAND:
            if name in value:
                raise ValueError(
                    f"{name!r} is said with the command, not in its file; leave it out"
                )
        return value

    @field_validator("parts")
    @classmethod
    def _names(cls, value: dict[str, Part]) -> dict[str, Part]:
        for number, (name, part) in enumerate(value.items()):
            if not re.fullmatch(r"[a-z0-9][a-z0-9-]{0,39}", name):
                raise ValueError(
                    "expected names of small letters, digits and "
                    f"hyphens, got {name[:40]!r}"
                )
            if name == PHOTOGRAPHS:
                raise ValueError(
                    f"expected another name than {name!r}, which photographs have"
                )
            for key, other in (("around", part.around), ("drawn_as", part.drawn_as)):
                if other is not None and other not in list(value)[:number]:
                    raise ValueError(
                        f"{name}: {key}: expected a part before it, got {other[:40]!r}"
                    )
        return value

    def made_quick(self) -> Recipe:
        for name in (*self.quick.parts, *self.quick.without):
            if name not in self.parts:
                raise errors.UnknownNameError(
                    "part", name, self.parts, "It stands under `quick` in the recipe."
                )
        parts = {
            name: part.model_copy(
                update={
                    "settings": settings.merged(
                        part.settings, self.quick.parts.get(name, {})
                    )
                }
            )
            for name, part in self.parts.items()
            if name not in self.quick.without
        }
        return self.model_copy(
            update={
                "settings": settings.merged(self.settings, self.quick.settings),
                "parts": parts,
            }
        )


def recipe_names() -> tuple[str, ...]:
    return tuple(
        sorted(
            path.name[:-5] for path in BUNDLED.iterdir() if path.name.endswith(".yaml")
        )
    )


def titles() -> dict[str, str]:
    return {name: read_recipe(name).title for name in recipe_names()}


def recipe_yaml(name: str) -> str:
    if name not in recipe_names():
        raise errors.UnknownNameError(
            "recipe",
            name,
            recipe_names(),
            "A recipe of your own is a YAML file: give its path.",
        )
    return str((BUNDLED / f"{name}.yaml").read_text(encoding="utf-8"))


def describe(name: str) -> tuple[str, dict[str, Any]]:
    """Return the text of a bundled recipe, and what it says as JSON values."""
    text = recipe_yaml(name).rstrip("\n")
    return text, read_recipe(name).model_dump(mode="json")


def read_recipe(name: str) -> Recipe:
    """Return a bundled recipe by its name, or that of a YAML file: it has a suffix, or
    a folder before it.
    """
    if is_file_name(name):
        return recipe_of(settings.read_yaml(name), name)
    recipe_yaml(name)
    with resources.as_file(BUNDLED / f"{name}.yaml") as path:
        return recipe_of(settings.read_yaml(path), name)


def is_file_name(name: str) -> bool:
    return "/" in name or Path(name).suffix != ""


def recipe_of(data: Mapping[str, object], where: str) -> Recipe:
    """Return the recipe that a mapping in the file `where` describes; a FileFormatError
    where it describes none.
    """
    try:
        return Recipe(
            **{
                name: value
                for name, value in data.items()
                if name not in ("schema", "command")
            }
        )
    except ValidationError as error:
        raise errors.FileFormatError(
            f"{where}: {first_of(error)}; advsearch show recipe backgrounds prints one"
        ) from None
    except (RecursionError, TypeError) as error:
        raise errors.FileFormatError(
            f"{where}: expected a recipe, got {type(error).__name__}"
        ) from None


def first_of(error: ValidationError) -> str:
    """Return what is wrong first, and where: ``parts.a.shell: Extra inputs are not
    permitted``.
    """
    first = error.errors(include_url=False, include_input=False)[0]
    return (
        f"{'.'.join(map(str, first['loc']))[:80]}: "
        f"{first['msg'].removeprefix('Value error, ')[:200]}"
    )


@dataclass(frozen=True)
class PlannedRun:
    """One run of a recipe; `around` is the folder of the run whose result says what is
    drawn.
    """

    name: str
    part: str
    config: SceneConfig
    around: str | None


def planned(recipe: Recipe, config: RecipeConfig) -> list[PlannedRun]:
    """Return the runs of a recipe in the order in which they are carried out; an
    InputError names a part with a setting that its command has not. A run is about one
    object; a search, about one environment and one model, too.
    """
    chosen = made_of(recipe, config)
    runs = list[PlannedRun]()
    for name, part in chosen.parts.items():
        where = f"{config.recipe}: parts: {name}"
        kind = CONFIGS[part.command]
        part_settings = {**chosen.settings, **part.settings}
        usual = {}
        if part.command == "attack":
            usual = {
                "environment": SceneConfig.default_environment,
                "model": "reference",
            }
        axes = {
            axis: names_listed(part_settings.get(axis) or names)
            for axis, names in {"object": "", **usual}.items()
        }
        for number, values in enumerate(product(*axes.values())):
            own: Settings = dict(zip(axes, values, strict=True))
            words = [
                word
                for axis, word in zip(axes, values, strict=True)
                if axis == "object" or len(axes[axis]) > 1
            ]
            # a seed of its own, so that no two runs draw the same
            own["seed"] = seeds.stream(
                config.seed, f"recipe {part.drawn_as or name} {number}"
            )
            own |= (
                {"deterministic": True}
                if config.deterministic
                else {"threads": config.threads}
            )
            if (label := config.label_of(str(own["object"]))) is not None:
                own["label"] = label
            try:
                made = kind(**{**part_settings, **own})
            except settings.SettingsError as error:
                raise settings.SettingsError(error.problems, where) from None
            except errors.UnknownNameError:
                raise
            except InputError as error:
                raise InputError(f"{where}: {error}") from None
            folder = f"{number:02d}-{folder_name(words)}"
            runs.append(
                PlannedRun(
                    f"{name}-{folder}",
                    name,
                    made,
                    part.around and f"{part.around}-{folder}",
                )
            )
    if len(runs) > MOST_RUNS:
        raise InputError(
            f"{config.recipe}: expected at most {MOST_RUNS} runs, got "
            f"{len(runs)}; name fewer objects"
        )
    return runs


def folder_name(words: Iterable[str]) -> str:
    """Return a name for a folder of what files or names say, such as ``mug-studio``."""
    stem, *others = words
    return _safe_name(
        "-".join([Path(stem).stem, *(_safe_name(Path(word).stem) for word in others)])
    )


def _safe_name(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")[:80] or "attack"


def check_powers(recipe: Recipe, runs: Iterable[PlannedRun], name: str) -> None:
    """Refuse, by an InputError, a part that would do more than its run: connect, or
    start more processes than there are processors. A bundled recipe may.
    """
    if is_file_name(name) or recipe != read_recipe(name):
        for run in runs:
            run.config.check_powers(f"{name}: parts: {run.part}")


def made_of(recipe: Recipe, config: RecipeConfig) -> Recipe:
    """Return the recipe as it was asked for: quick or not, with the objects,
    environments and models of `config`.
    """
    chosen = recipe.made_quick() if config.quick else recipe
    names = (
        "object",
        "environment",
        "model",
        "labels",
        "prompt",
        "value_range",
        "task",
        "up",
        "facing",
        "size",
        "unit",
        "resolution",
    )
    asked = {
        name: value for name in names if (value := getattr(config, name)) is not None
    }
    all_settings: Settings = {**chosen.settings, **asked}
    if "object" not in all_settings:
        raise InputError(f"object: expected one, since {config.recipe} names none")
    return chosen.model_copy(update={"settings": all_settings})


def names_listed(value: object) -> list[str]:
    """Return names that stand in a list, or in a text with commas between them."""
    return (
        [str(name) for name in value]
        if isinstance(value, (list, tuple))
        else list(settings.split_names(str(value)))
    )
