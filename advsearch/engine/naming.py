"""From what a configuration names to things, as every command that loads a scene and a model does it."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from advsearch import threads
from advsearch.config import SceneConfig
from advsearch.controls import CONTROLS, Choice, Control, gathered, names_of
from advsearch.controls.values import is_number
from advsearch.engine.loading import Controls, as_controls, settings_of
from advsearch.errors import InputError, UnknownNameError
from advsearch.models import Model, ModelWarning, load_model
from advsearch.models.loading import named_code
from advsearch.settings import split_names
from advsearch.tasks import Task, make_task

Named = str | Sequence[str] | Mapping[str, Mapping[str, object] | None]
"""Controls by name; a mapping gives each name its settings."""


def scene_settings(fixed: Mapping[str, Any] | None, exposure: float | None) -> dict[str, Any]:
    """Return the parameters that a scene is loaded with: those of `set`, and the exposure.

    Raises:
        InputError: both say what the exposure is.
    """
    given = dict(fixed or {})
    if exposure:
        if "camera.exposure" in given:
            raise InputError("`exposure` and `set` camera.exposure say the same thing; leave one of them out")
        given["camera.exposure"] = exposure
    return given


def code_of(config: SceneConfig) -> tuple[str, ...]:
    """Return the Python code that settings name, and that is imported for them: "package.module:attribute"."""
    models = [named_code(name) for name in split_names(config.model)]
    controls = [name for name in config.kinds_of_controls if CONTROLS.names_class(name)]
    return tuple(dict.fromkeys(name for name in (*models, *controls) if name))


RUN_SETTINGS = ("epsilon", "norm", "texture_resolution")
"""Settings of a run that controls take; each control declares which (`Choice.run_setting`)."""


def controls_of(
    controls: Controls, config: SceneConfig, settings: Collection[str] = RUN_SETTINGS
) -> tuple[Control, ...]:
    """Return control instances, with the run's settings where they take them and say nothing else themselves.

    Args:
        controls: in any form; instances stay as they are.
        config: of the run.
        settings: those of the run's settings that count.

    Raises:
        InputError: an instance takes a setting that the run has.
    """
    if not isinstance(controls, (str, Mapping)):
        for one in (one for one in controls if isinstance(one, Control)):
            for choice in _counting(type(one), one.settings()):
                if choice.run_setting in settings and getattr(config, choice.run_setting, None) is not None:
                    raise InputError(
                        f"{choice.run_setting}: control {one.name} is an instance already; give it its own, as in "
                        f"{type(one).__name__}({choice.name}=...)"
                    )
        if all(isinstance(one, Control) for one in controls):
            return as_controls(controls)
    named = settings_of(controls)
    return as_controls({name: {**_from_run(name, given, config, settings), **given} for name, given in named.items()})


def _from_run(asked: str, given: Mapping[str, Any], config: SceneConfig, settings: Collection[str]) -> dict[str, Any]:
    """What the run's settings say for one control."""
    _, name = names_of(asked, given)
    choices = _choices(asked, given)
    said = {one.name: _value(config, one.run_setting, name) for one in choices if one.run_setting in settings}
    return {choice: value for choice, value in said.items() if value is not None}


def _value(config: SceneConfig, setting: str, name: str) -> Any:
    """The value of a run's setting for one control."""
    value = getattr(config, setting, None)
    return value.get(name) if isinstance(value, Mapping) else None if isinstance(value, tuple) else value


def takes(asked: str, given: Mapping[str, Any], setting: str) -> bool:
    """Whether a control takes one of the run's settings; one that is not known counts as one that does."""
    kind, _ = names_of(asked, given)
    return kind not in CONTROLS or setting in {choice.run_setting for choice in _choices(asked, given)}


def _choices(asked: str, given: Mapping[str, Any]) -> list[Choice]:
    """The choices of a control, as it is asked for, that count."""
    ((name, settings),) = gathered({asked: given}).items()
    kind, _ = names_of(name, settings)
    return _counting(CONTROLS[kind], settings) if kind in CONTROLS else []


def _counting(kind: type[Control], given: Mapping[str, object]) -> list[Choice]:
    """The choices that count beside the settings that are given: what they are about is searched."""
    return [choice for choice in kind.choices if not choice.bounds or _is_searched(kind, choice.bounds, given)]


def _is_searched(kind: type[Control], parameter: str, given: Mapping[str, object]) -> bool:
    """Whether a parameter of a control is searched beside the settings that are given."""
    if any(choice.fixes == parameter and given.get(choice.name) is not None for choice in kind.choices):
        return False
    if given.get(parameter) is not None:
        return not is_number(given[parameter])
    return any(one.name == parameter and one.search is not None for one in kind.parameters)


def run_settings_for(config: SceneConfig, asked: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the run's settings for a run over one of its controls: None where that does not take them."""
    _, name = names_of(asked, given)
    found: dict[str, Any] = {}
    for setting in RUN_SETTINGS:
        value = getattr(config, setting, None)
        if isinstance(value, Mapping):
            value = {own: number for own, number in value.items() if own == name} or None
        found[setting] = value if takes(asked, given, setting) else None
    return found


def check_run_settings(config: SceneConfig) -> None:
    """Refuse a setting of the run that none of its controls takes.

    Raises:
        UnknownNameError: an epsilon for a control that is not searched.
        InputError: no control takes it, or not the one that it names.
    """
    drawn: Mapping[str, Any] = getattr(config, "over", {})
    for setting in RUN_SETTINGS:
        value = getattr(config, setting, None)
        if value is None:
            continue
        asked = gathered(config.controls if setting == "epsilon" else {**config.controls, **drawn})
        if isinstance(value, Mapping):
            known = {names_of(one, given)[1]: one for one, given in asked.items()}
            for name in value:
                if name not in known:
                    raise UnknownNameError(f"control in `{setting}`", name, known)
                if not takes(known[name], asked[known[name]], setting):
                    raise _not_taken(setting, name, names_of(known[name], asked[known[name]])[0])
            continue
        without = [one for one, given in asked.items() if not takes(one, given, setting)]
        if without and (isinstance(value, tuple) or len(without) == len(asked)):
            raise _not_taken(setting, without[0], names_of(without[0], asked[without[0]])[0])


def _not_taken(setting: str, name: str, kind: str) -> InputError:
    if setting == "epsilon":
        return InputError(
            f"`epsilon` {name}: the control has ranges and no epsilon; give its ranges, as in "
            f"`controls` '{name}={{PARAMETER: [LOW, HIGH]}}'{_bounded(kind)}"
        )
    return InputError(f"{setting}: {name} has none, and no other control is there that has one; leave it out")


def _bounded(kind: str) -> str:
    """What a control would take an epsilon for, in words; nothing if there is no such thing."""
    choices = CONTROLS[kind].choices if kind in CONTROLS else ()
    bounded = [choice.bounds for choice in choices if choice.run_setting == "epsilon" and choice.bounds]
    return f", or search {bounded[0]} with it" if bounded else ""


def load_models(
    models: Sequence[Any], config: SceneConfig, task: Task | None = None
) -> tuple[tuple[Model, ...], list[str]]:
    """Load models in the threads that are asked for; their warnings become sentences of the run.

    Args:
        models: as `load_model` takes them.
        config: of the run.
        task: what their outputs are for; that of the configuration if None.
    """
    threads.configure(1 if config.deterministic else config.threads)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", ModelWarning)
        read = (task or make_task(config.task)).reader
        loaded = tuple(load_model(one, labels=config.labels, read=read) for one in models)
    said = [str(one.message) for one in caught if issubclass(one.category, ModelWarning)]
    for one in caught:
        if not issubclass(one.category, ModelWarning):
            warnings.warn_explicit(one.message, one.category, one.filename, one.lineno)
    return loaded, said


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


def options_of(arguments: Mapping[str, Any], config: type[SceneConfig], without: Collection[str]) -> dict[str, Any]:
    """Return the arguments of a Python call that are settings of a configuration; None is one that was not given.

    Args:
        arguments: by name.
        config: whose settings.
        without: names that mean something else in the call than in a file.
    """
    names = {"set", *config.model_fields}
    given = {name: value for name, value in arguments.items() if value is not None}
    return {name: value for name, value in given.items() if name in names and name not in without}
