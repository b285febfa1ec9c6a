"""Recipes as their YAML files describe them, and the runs that they consist of."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
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
"""Class of the settings of a part, by the part's command."""
# name of the part that the rows of photographs have
PHOTOGRAPHS = "photographs"
COMMAND_SETTINGS = (*settings.RUN_LOCATION, "seed", "threads", "deterministic")
"""Settings that are given with the command and not in the file of a recipe."""
# settings of a recipe that those of the command replace
REPLACED_SETTINGS = (
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

MAX_PARTS = 64
MAX_FIGURES = 32
MAX_RUNS = 1000

BUNDLED = resources.files("advsearch.questions.recipe")

Settings = dict[str, object]


class _Described(BaseModel):
    """Base of what the file of a recipe contains; unknown names are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Part(_Described):
    """Runs of one command, one for each object.

    If `around` names an earlier part, whose runs are searches, each run samples around
    the distribution that a search found. If `drawn_as` names an earlier part with the
    same ranges, the runs sample the same configurations as that part.
    """

    command: Literal["attack", "sweep"]
    settings: Settings = Field(default_factory=dict)
    around: str | None = None
    drawn_as: str | None = None

    @field_validator("settings")
    @classmethod
    def _reject_per_run_settings(cls, value: Settings) -> Settings:
        """Reject settings that a recipe cannot set for single parts.

        These are the settings of the command, and those that every run gets from the
        command or the recipe: its object and the object's label.
        """
        for name in (*COMMAND_SETTINGS, "object", "label"):
            if name in value:
                raise ValueError(
                    f"{name!r} is the same for all parts; leave it out here"
                )
        return value


class Changes(_Described):
    """Changes for a quick run: to settings of all parts, to settings of single parts,
    and names of parts that are left out (`without`).
    """

    settings: Settings = Field(default_factory=dict)
    parts: dict[str, Settings] = Field(default_factory=dict)
    without: list[str] = Field(default_factory=list)


class Recipe(_Described):
    """An experiment as the file of a recipe describes it (docs/recipes.md).

    Attributes:
        title: the question that the recipe answers.
        about: how the result is obtained, and whose experiment it is.
        settings: settings of all parts.
        parts: parts by name, in the order in which they run.
        figures: for each figure its kind (`figure`) and options.
        groups: names of objects by group.
        quick: changes for a quick run.
    """

    title: Annotated[str, Field(min_length=1, max_length=200)]
    about: Annotated[str, Field(max_length=2000)] = ""
    settings: Settings = Field(default_factory=dict)
    parts: Annotated[dict[str, Part], Field(min_length=1, max_length=MAX_PARTS)]
    figures: Annotated[list[dict[str, Any]], Field(max_length=MAX_FIGURES)] = Field(
        default_factory=list
    )
    groups: dict[str, list[str]] = Field(default_factory=dict)
    quick: Changes = Field(default_factory=Changes)

    @field_validator("settings")
    @classmethod
    def _reject_command_settings(cls, value: Settings) -> Settings:
        """Reject settings that belong to the command line."""
        for name in COMMAND_SETTINGS:
            if name in value:
                raise ValueError(
                    f"{name!r} belongs to the command, not to its file; leave it out"
                )
        return value

    @field_validator("parts")
    @classmethod
    def _check_part_names(cls, value: dict[str, Part]) -> dict[str, Part]:
        """Check the names of parts, and that parts refer to earlier ones only."""
        earlier = list[str]()
        for name, part in value.items():
            _check_part_name(name)
            for key, other in (("around", part.around), ("drawn_as", part.drawn_as)):
                if other is not None and other not in earlier:
                    raise ValueError(
                        f"{name}: {key}: expected a part before it, got {other[:40]!r}"
                    )
            earlier.append(name)
        return value

    def apply_quick(self) -> Recipe:
        """Return the recipe with the changes of `quick`.

        Raises:
            UnknownNameError: if a change is to a part that does not exist.
        """
        for name in (*self.quick.parts, *self.quick.without):
            if name not in self.parts:
                raise errors.UnknownNameError(
                    "part", name, self.parts, "It stands under `quick` in the recipe."
                )
        parts = {
            name: self._change_part(name)
            for name in self.parts
            if name not in self.quick.without
        }
        quick_settings = settings.merge_mappings(self.settings, self.quick.settings)
        return self.model_copy(update={"settings": quick_settings, "parts": parts})

    def _change_part(self, name: str) -> Part:
        """Return a part with the changes that `quick` has for its settings."""
        part = self.parts[name]
        changes = self.quick.parts.get(name, {})
        part_settings = settings.merge_mappings(part.settings, changes)
        return part.model_copy(update={"settings": part_settings})


def _check_part_name(name: str) -> None:
    """Raise an error if a part cannot have this name."""
    if not re.fullmatch(r"[a-z0-9][a-z0-9-]{0,39}", name):
        raise ValueError(
            f"expected names of small letters, digits and hyphens, got {name[:40]!r}"
        )
    if name == PHOTOGRAPHS:
        raise ValueError(f"expected another name than {name!r}, which photographs have")


def list_recipes() -> tuple[str, ...]:
    """Return the names of the bundled recipes, sorted."""
    files = (path.name for path in BUNDLED.iterdir())
    return tuple(sorted(name[:-5] for name in files if name.endswith(".yaml")))


def titles() -> dict[str, str]:
    """Return the titles of the bundled recipes by name."""
    return {name: read_recipe(name).title for name in list_recipes()}


def read_recipe_text(name: str) -> str:
    """Return the text of a bundled recipe's file.

    Raises:
        UnknownNameError: if there is no such recipe.
    """
    if name not in list_recipes():
        raise errors.UnknownNameError(
            "recipe",
            name,
            list_recipes(),
            "A recipe of your own is a YAML file: give its path.",
        )
    return str((BUNDLED / f"{name}.yaml").read_text(encoding="utf-8"))


def describe(name: str) -> tuple[str, dict[str, Any]]:
    """Return the text of a bundled recipe, and its content as JSON values."""
    text = read_recipe_text(name).rstrip("\n")
    return text, read_recipe(name).model_dump(mode="json")


def read_recipe(name: str) -> Recipe:
    """Read a bundled recipe by its name, or a YAML file by its path.

    A path has a suffix or a directory.
    """
    if is_file_name(name):
        return parse_recipe(settings.read_yaml(name), name)
    read_recipe_text(name)  # only a check: raises if no recipe has this name
    with resources.as_file(BUNDLED / f"{name}.yaml") as path:
        return parse_recipe(settings.read_yaml(path), name)


def is_file_name(name: str) -> bool:
    """Return whether a recipe is named by the path of a file."""
    return "/" in name or Path(name).suffix != ""


def parse_recipe(data: Mapping[str, object], where: str) -> Recipe:
    """Parse the content of a recipe's file.

    Args:
        data: content of the file, as YAML states it.
        where: name of the file, for messages.

    Raises:
        FileFormatError: if it describes no recipe.
    """
    # These two entries are about the file, and no fields of a recipe.
    values = {
        name: value for name, value in data.items() if name not in ("schema", "command")
    }
    try:
        return Recipe(**values)
    except ValidationError as error:
        raise errors.FileFormatError(
            f"{where}: {format_first_error(error)}; advsearch show recipe backgrounds "
            "prints one"
        ) from None
    except (RecursionError, TypeError) as error:
        raise errors.FileFormatError(
            f"{where}: expected a recipe, got {type(error).__name__}"
        ) from None


def format_first_error(error: ValidationError) -> str:
    """Format the first problem: ``parts.a.shell: Extra inputs are not permitted``."""
    first = error.errors(include_url=False, include_input=False)[0]
    location = ".".join(map(str, first["loc"]))
    message = first["msg"].removeprefix("Value error, ")
    return f"{location[:80]}: {message[:200]}"


@dataclass(frozen=True)
class PlannedRun:
    """A run of a recipe.

    Attributes:
        name: name of the run's directory.
        part_name: name of the part that it belongs to.
        config: settings of the run.
        search_run_name: directory of the search that it samples around; None if it
            samples around none.
    """

    name: str
    part_name: str
    config: SceneConfig
    search_run_name: str | None


def plan_runs(recipe: Recipe, config: RecipeConfig) -> list[PlannedRun]:
    """Plan the runs of a recipe in the order in which they run.

    A part has a run for each object; a search has one for each combination of object,
    environment and model. The directory of a run is named after the part, the number of
    the run in it, the object, and the environment and model if they differ between
    runs: "search-00-mug". If a part samples around the searches of another part, each
    of its runs samples around the search with the same number and names.

    Args:
        recipe: the recipe.
        config: settings of the command, which replace those of the recipe.

    Raises:
        InputError: if a part has a setting that its command lacks, or there are too
            many runs.
    """
    recipe = apply_command_settings(recipe, config)
    runs = list[PlannedRun]()
    for name in recipe.parts:
        runs += _plan_runs_of_part(recipe, name, config)
    if len(runs) > MAX_RUNS:
        raise InputError(
            f"{config.recipe}: expected at most {MAX_RUNS} runs, got "
            f"{len(runs)}; name fewer objects"
        )
    return runs


def _plan_runs_of_part(
    recipe: Recipe, name: str, config: RecipeConfig
) -> list[PlannedRun]:
    """Plan the runs of one part, by its name."""
    part = recipe.parts[name]
    axes = _list_axes(recipe, part)
    runs = []
    for index, values in enumerate(product(*axes.values())):
        value_of_setting = dict(zip(axes, values, strict=True))
        run_config = _make_run_config(recipe, name, index, value_of_setting, config)
        suffix = f"{index:02d}-{_name_combination(axes, value_of_setting)}"
        # `around` of a part is the name of a part; that of a run is a directory.
        search_directory = None if part.around is None else f"{part.around}-{suffix}"
        runs.append(PlannedRun(f"{name}-{suffix}", name, run_config, search_directory))
    return runs


def _name_combination(
    axes: Mapping[str, Sequence[str]], value_of_setting: Mapping[str, str]
) -> str:
    """Name a run after its object, and what else differs between runs of its part.

    Args:
        axes: all values of each setting that is combined.
        value_of_setting: the values of the run.
    """
    words = [
        value
        for axis, value in value_of_setting.items()
        if axis == "object" or len(axes[axis]) > 1
    ]
    return make_directory_name(words)


def _list_axes(recipe: Recipe, part: Part) -> dict[str, list[str]]:
    """Return the settings whose values are combined to the runs of a part.

    These are the object, and for an attack also the environment and the model. A sweep
    takes several environments and models itself.
    """
    defaults = {"object": ""}
    if part.command == "attack":
        defaults["environment"] = SceneConfig.default_environment
        defaults["model"] = "reference"
    part_settings = {**recipe.settings, **part.settings}
    return {
        axis: split_name_list(part_settings.get(axis) or default)
        for axis, default in defaults.items()
    }


def _make_run_config(
    recipe: Recipe,
    name: str,
    index: int,
    value_of_setting: Mapping[str, str],
    config: RecipeConfig,
) -> SceneConfig:
    """Make the settings of one run of a part.

    Settings of the part replace those of the recipe. The seed follows from that of the
    recipe. A part that repeats another one (`drawn_as`) has the seeds of that part.

    Args:
        recipe: the recipe.
        name: name of the part.
        index: index of the run in the part.
        value_of_setting: object of the run; for a search also environment and model.
        config: settings of the command.

    Raises:
        SettingsError, InputError: the settings are wrong; the message names the part.
    """
    part = recipe.parts[name]
    # different in each run, so that no two runs draw the same samples
    seed_name = f"recipe {part.drawn_as or name} {index}"
    run_settings: Settings = {
        **recipe.settings,
        **part.settings,
        **value_of_setting,
        "seed": seeds.derive_seed(config.seed, seed_name),
    }
    _apply_common_settings(run_settings, config, value_of_setting["object"])
    return _make_part_config(part, run_settings, f"{config.recipe}: parts: {name}")


def _apply_common_settings(
    run_settings: Settings, config: RecipeConfig, object_name: str
) -> None:
    """Add the threads and the label of the command to the settings of a run."""
    if config.deterministic:
        run_settings["deterministic"] = True
    else:
        run_settings["threads"] = config.threads
    label = config.find_label(object_name)
    if label is not None:
        run_settings["label"] = label


def _make_part_config(part: Part, run_settings: Settings, where: str) -> SceneConfig:
    """Make the settings of a part's command; errors begin with `where`."""
    config_type = CONFIGS[part.command]
    try:
        return config_type(**run_settings)
    except settings.SettingsError as error:
        raise settings.SettingsError(error.problems, where) from None
    except errors.UnknownNameError:
        raise  # it is an InputError, too, but lists the known names: keep it
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def make_directory_name(words: Iterable[str]) -> str:
    """Join names, or the stems of files, to the name of a directory: ``mug-studio``."""
    first, *others = words
    names = [Path(first).stem, *(_safe_name(Path(other).stem) for other in others)]
    return _safe_name("-".join(names))


def _safe_name(text: str) -> str:
    """Reduce a text to lowercase letters, digits and hyphens."""
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")[:80] or "attack"


def check_powers(recipe: Recipe, runs: Iterable[PlannedRun], name: str) -> None:
    """Reject parts with effects outside of their run, unless the recipe is bundled.

    Such a part connects to other machines, or starts more processes than there are
    cores. A recipe in a file may come from anybody.

    Raises:
        InputError: for the first such part.
    """
    # The recipe may be one that a run has stored under the bundled name. That may have
    # been changed, so that the content is compared, too.
    is_bundled = not is_file_name(name) and recipe == read_recipe(name)
    if is_bundled:
        return
    for run in runs:
        run.config.check_no_effects(f"{name}: parts: {run.part_name}")


def apply_command_settings(recipe: Recipe, config: RecipeConfig) -> Recipe:
    """Return the recipe with the settings of the command, and of `quick` if it is set.

    Args:
        recipe: the recipe.
        config: settings of the command; those that are None stay as in the recipe.

    Raises:
        InputError: if neither names an object.
    """
    if config.quick:
        recipe = recipe.apply_quick()
    merged: Settings = dict(recipe.settings)
    for name in REPLACED_SETTINGS:
        value = getattr(config, name)
        if value is not None:
            merged[name] = value
    if "object" not in merged:
        raise InputError(f"object: expected one, since {config.recipe} names none")
    return recipe.model_copy(update={"settings": merged})


def split_name_list(value: object) -> list[str]:
    """Return the names of a list, or of a text in which commas separate them."""
    if isinstance(value, (list, tuple)):
        return [str(name) for name in value]
    return list(settings.split_names(str(value)))
