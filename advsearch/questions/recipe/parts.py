"""The runs that a recipe comes to: each part once for each object, with the settings of its command."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

from advsearch import seeds
from advsearch.config import CONFIGS
from advsearch.config.scene import DEFAULT_ENVIRONMENT, SceneConfig
from advsearch.errors import InputError, UnknownNameError
from advsearch.questions.recipe.description import Part, Recipe, Settings
from advsearch.questions.recipe.settings import RecipeConfig
from advsearch.runs.directory import default_name
from advsearch.settings import split_names
from advsearch.settings.configuration import SettingsError

MOST_RUNS = 1000


@dataclass(frozen=True)
class Planned:
    """One run of a recipe.

    Attributes:
        name: of its folder.
        part: that it belongs to.
        config: what it does.
        around: the folder of the run whose answer says what is drawn; None where the settings say it.
    """

    name: str
    part: str
    config: SceneConfig
    around: str | None


def planned(recipe: Recipe, config: RecipeConfig) -> list[Planned]:
    """Return the runs of a recipe in the order in which they are carried out.

    A run is about one object. Where a part's command takes one environment or one model only, it has a run for each.

    Raises:
        InputError: a part has a setting that its command has not, or too many runs; the message names the part.
    """
    chosen = made_of(recipe, config)
    runs = [one for name in chosen.parts for one in _runs(chosen, name, config)]
    if len(runs) > MOST_RUNS:
        raise InputError(f"{config.recipe}: expected at most {MOST_RUNS} runs, got {len(runs)}; name fewer objects")
    return runs


def made_of(recipe: Recipe, config: RecipeConfig) -> Recipe:
    """Return the recipe as it was asked for: quick or not, with the objects, environments and models of `config`."""
    chosen = recipe.made_quick() if config.quick else recipe
    names = ("object", "environment", "model", "labels", "prompt", "task", "up", "resolution")
    given = {name: value for name in names if (value := getattr(config, name)) is not None}
    settings: Settings = {**chosen.settings, **given}
    if "object" not in settings:
        raise InputError(f"object: expected one, since {config.recipe} names none")
    return chosen.model_copy(update={"settings": settings})


def names_listed(value: object) -> list[str]:
    """Return names that stand in a list, or in a text with commas between them."""
    return [str(one) for one in value] if isinstance(value, (list, tuple)) else list(split_names(str(value)))


def _runs(recipe: Recipe, name: str, config: RecipeConfig) -> Iterator[Planned]:
    part, kind = recipe.parts[name], CONFIGS[recipe.parts[name].command]
    settings = {**recipe.settings, **part.settings}
    several = kind.several if issubclass(kind, SceneConfig) and part.command != "attack" else ()
    axes = {
        axis: names_listed(settings.get(axis) or default)
        for axis, default in (("object", ""), ("environment", DEFAULT_ENVIRONMENT), ("model", "reference"))
        if axis not in several or axis == "object"
    }
    for number, values in enumerate(product(*axes.values())):
        one = dict(zip(axes, values, strict=True))
        words = [value for axis, value in one.items() if axis == "object" or len(axes[axis]) > 1]
        where, stream = f"{config.recipe}: parts: {name}", f"{part.drawn_as or name} {number}"
        made = _config(part, {**settings, **one}, where, config, stream)
        yield Planned(_folder(name, number, words), name, made, part.around and _folder(part.around, number, words))


def _config(part: Part, settings: Settings, where: str, config: RecipeConfig, stream: str) -> SceneConfig:
    """The configuration of one run; its seed is its own, so that no two runs draw the same."""
    label = config.label_of(str(settings["object"]))
    own: Settings = {"seed": seeds.stream(config.seed, f"recipe {stream}")}
    own |= {"threads": config.threads} if not config.deterministic else {"deterministic": True}
    own |= {} if label is None else {"label": label}
    try:
        made = CONFIGS[part.command](**{**settings, **own})
    except SettingsError as error:
        raise SettingsError(error.problems, where) from None
    except UnknownNameError:
        raise
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    assert isinstance(made, SceneConfig)
    return made


def _folder(part: str, number: int, words: Sequence[str]) -> str:
    return f"{part}-{number:02d}-{default_name(words[0], [default_name(word, []) for word in words[1:]])}"
