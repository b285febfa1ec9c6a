"""From what a configuration names to things, as every command that loads a scene and a model does it."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from torch import nn

from advsearch import threads
from advsearch.config import SceneConfig
from advsearch.controls import CONTROLS
from advsearch.engine.loading import MODEL, Scene, lent, load_scene
from advsearch.errors import InputError
from advsearch.models import Model, ModelWarning, load_model
from advsearch.models.loading import named_code
from advsearch.scene.settings import Given
from advsearch.settings import split_names
from advsearch.tasks import Task
from advsearch.tasks.together import Together, together


def scene_of(config: SceneConfig, name: str | None = None, environment: str | None = None) -> Scene:
    """Load the scene that a configuration describes.

    Args:
        config: what.
        name: of one of its objects; None for the only one, in the configuration's environment.
        environment: of that object; None for the default.
    """
    if name is None:
        name, environment = config.object, config.environment
    return load_scene(name, environment, up=config.up, settings=scene_settings(config), camera=config.camera)


def scene_settings(config: SceneConfig) -> Given:
    """Return the parameters that a scene is loaded with: those of `set`, and the exposure.

    Raises:
        InputError: both say what the exposure is.
    """
    given: dict[str, Any] = dict(config.set_)
    if config.exposure:
        if "camera.exposure" in given:
            raise InputError("`exposure` and `set` camera.exposure say the same thing; leave one of them out")
        given["camera.exposure"] = config.exposure
    return given


def code_of(models: Iterable[str], kinds: Iterable[str], metrics: Iterable[str] = ()) -> tuple[str, ...]:
    """Return the Python code that is imported for what is named: "package.module:attribute".

    Args:
        models: as `load_model` takes them.
        kinds: of the controls.
        metrics: as settings name them.
    """
    code = [*(named_code(name) for name in models), *metrics]
    code += [name for name in kinds if CONTROLS.names_class(name)]
    return tuple(dict.fromkeys(name for name in code if name))


def load_models(models: Sequence[Any], task: Task, config: SceneConfig) -> tuple[tuple[Model, ...], list[str]]:
    """Load models; their warnings become sentences of the run.

    Args:
        models: as `load_model` takes them.
        task: what their outputs are for; several tasks are for one model each, which are put together as one.
        config: has the names of their classes, the texts that these are put into, and the processor threads that
            everything takes from here on.
    """
    threads.configure(config.used_threads)
    parts = task.parts if isinstance(task, Together) else (task,) * len(models)
    asked = several(models) if isinstance(task, Together) else models
    if len(asked) != len(parts):
        raise InputError(f"model: expected {len(parts)}, one for each task, got {len(asked)}")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", ModelWarning)
        given = [(lent(MODEL, one) if isinstance(one, str) else None) or one for one in asked]
        loaded = tuple(_load(one, own, config, alone=own is task) for one, own in zip(given, parts, strict=True))
    sentences = [str(one.message) for one in caught if issubclass(one.category, ModelWarning)]
    for one in caught:
        if not issubclass(one.category, ModelWarning):
            warnings.warn_explicit(one.message, one.category, one.filename, one.lineno)
    return (together(loaded, config.resolution),) if isinstance(task, Together) else loaded, sentences


def _load(model: Any, task: Task, config: SceneConfig, *, alone: bool) -> Model:
    """Load a model; of several tasks, those that take no label or have names of their own are given none."""
    if not alone and (task.names_from or not task.labelled):
        return load_model(model, task=task)
    return load_model(model, labels=config.labels, prompt=config.prompt, task=task)


AnyModel = Model | nn.Module | str | Path
"""What `load_model` takes."""


def several(models: AnyModel | Sequence[AnyModel]) -> list[AnyModel]:
    """Return one model or several in a list; names may stand in a text with commas between them."""
    listed: list[AnyModel] = list(models) if isinstance(models, (list, tuple)) else [models]  # type: ignore[list-item]
    return [one for given in listed for one in (split_names(given) if isinstance(given, str) else (given,))]


def model_name(model: AnyModel) -> str:
    """Return what a model is called in settings."""
    if isinstance(model, (str, Path)):
        return str(model)
    return str(getattr(model, "asked", None) or getattr(model, "name", None) or type(model).__name__)


def exists_here(model: AnyModel) -> bool:
    """Whether a model exists in this session only, so that no file and no command can name it."""
    return not isinstance(model, (str, Path)) and getattr(model, "asked", None) is None


def different(names: Sequence[str], setting: str) -> Sequence[str]:
    """Return the names.

    Raises:
        InputError: there are none, or one comes twice.
    """
    twice = [name for name in names if names.count(name) > 1]
    if twice or not names:
        raise InputError(
            f"{setting}: expected different names, got {','.join(names)!r}; leave {', '.join(twice[:1])} out"
        )
    return names


OF_SCENE = ("set", "environment", "up", "camera", "exposure", "object")
"""The settings that say what a scene is."""


def check_not_of_scene(settings: Mapping[str, object]) -> None:
    """Refuse settings of a scene that is loaded already.

    Raises:
        InputError: there are some.
    """
    clash = [name for name in OF_SCENE if settings.get(name) is not None]
    if clash:
        raise InputError(f"{', '.join(clash)}: belongs to the scene, which is given already; give it to load_scene")


def check_not_spread(settings: Mapping[str, object]) -> None:
    """Refuse to share work on what is loaded already.

    Raises:
        InputError: `workers` or `cluster` is among the settings.
    """
    for name in ("workers", "cluster"):
        if settings.get(name) is not None:
            raise InputError(
                f"{name}: expected names of objects, models, controls and an objective beside it, which other "
                "processes can load, got some that are loaded; give their names or files"
            )
