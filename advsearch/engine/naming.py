"""From what a configuration names to things, and what it says for all of its controls;
one question at a time.
"""

from __future__ import annotations

import threading
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from torch import nn

from advsearch import threads
from advsearch.config import SceneConfig
from advsearch.controls import CONTROLS, Choice, Control, gathered, names_of
from advsearch.engine.loading import (
    Controls,
    Scene,
    as_controls,
    controls_by_name,
    load_scene,
)
from advsearch.errors import InputError, UnknownNameError
from advsearch.models import Model, ModelWarning, load_model
from advsearch.models.all_at_once import AllAtOnce
from advsearch.models.loading import named_code
from advsearch.scene.rig import read_rig
from advsearch.scene.settings import Given, Parameter
from advsearch.settings import split_names
from advsearch.tasks import Task
from advsearch.tasks.together import Together, together
from advsearch.trust.foreign_code import plainly

CONTROL = "control"
MODEL = "model"
SCENE = "scene"
"""Roles of objects that a Python caller may pass in place of a name."""


def scene_of(
    config: SceneConfig, name: str | None = None, environment: str | None = None
) -> Scene:
    """Load the scene that a configuration describes: its only object in its
    environment, or a named one.

    A scene that a Python caller passed is returned as it is.
    """
    if name is None:
        scene: Scene | None = config.python_object(SCENE, config.object)
        if scene is not None:
            return scene
        name = config.object
        environment = config.environment
    return load_scene(name, environment, **told_of_scene(config))


def told_of_scene(config: SceneConfig) -> dict[str, Any]:
    names = ("up", "facing", "size", "unit", "camera", "things")
    return {
        **{name: getattr(config, name) for name in names},
        "settings": scene_settings(config),
    }


def scene_settings(config: SceneConfig) -> Given:
    """Return the parameters that a scene is loaded with: those of `set`, and the
    exposure.
    """
    given: dict[str, Any] = dict(config.set_)
    if config.exposure:
        if "camera.exposure" in given:
            raise InputError(
                "`exposure` and `set` camera.exposure say the same thing; "
                "leave one of them out"
            )
        given["camera.exposure"] = config.exposure
    return given


def code_of(
    models: Iterable[str], kinds: Iterable[str], metrics: Iterable[str] = ()
) -> tuple[str, ...]:
    """Return the Python code that is imported for what is named:
    "package.module:attribute".
    """
    code = [*(named_code(name) for name in models), *metrics]
    code += [name for name in kinds if CONTROLS.names_class(name)]
    return tuple(dict.fromkeys(name for name in code if name))


def load_models(
    models: Sequence[Any], task: Task, config: SceneConfig
) -> tuple[tuple[Model, ...], list[str]]:
    """Load models; their warnings become sentences of the run. Several tasks are for
    one model each, and these are put together as one. The configuration has the names
    of their classes, the texts that these are put into, and the processor threads that
    everything takes from here on.
    """
    threads.configure(config.used_threads)
    parts = task.parts if isinstance(task, Together) else (task,) * len(models)
    asked = several(models) if isinstance(task, Together) else models
    if len(asked) != len(parts):
        raise InputError(
            f"model: expected {len(parts)}, one for each task, got {len(asked)}"
        )

    def load(model: Any, of: Task) -> Model:
        """Of several tasks, those that take no label or have names of their own are
        given none.
        """
        part = of.of_one_image
        told = of is task or (part.labelled and not part.names_from)
        labels, prompt = (config.labels, config.prompt) if told else (None, None)
        if isinstance(model, str):
            model = config.python_object(MODEL, model) or model
        return load_model(
            model,
            labels=labels,
            prompt=prompt,
            value_range=config.value_range,
            task=part,
            ask=config.ask,
        )

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", ModelWarning)
        loaded = tuple(map(load, asked, parts))
        sentences = list[str]()
    for warning in caught:
        if issubclass(warning.category, ModelWarning):
            sentences.append(str(warning.message))
        else:
            warnings.warn_explicit(
                warning.message, warning.category, warning.filename, warning.lineno
            )
    if rig := () if config.camera is None else read_rig(config.camera):
        if not task.judges_rig:
            raise InputError(
                f"camera: {config.camera} has {len(rig)} cameras, and task {task.name} "
                "is of one picture; say what is "
                f"made of several, as in `task='rig={{task: {task.name}, rule: any}}'`"
            )
        loaded = tuple(replace(model, cameras=len(rig)) for model in loaded)
    for model in loaded:
        if (
            isinstance(model.module, AllAtOnce)
            and model.module.cameras != model.cameras
        ):
            raise InputError(
                f"model: {model.name} takes {model.module.cameras} pictures at once, "
                f"and {model.cameras} "
                f"{'is' if model.cameras == 1 else 'are'} taken; give a `camera` that "
                "is a rig of as many"
            )
    return (together(loaded, config.resolution),) if isinstance(
        task, Together
    ) else loaded, sentences


AnyModel = Model | nn.Module | str | Path


def several(models: AnyModel | Sequence[AnyModel]) -> list[AnyModel]:
    """Return one model or several in a list; names may stand in a text with commas
    between them.
    """
    listed: list[AnyModel] = (
        list(models) if isinstance(models, (list, tuple)) else [models]
    )  # type: ignore[list-item]
    return [
        name
        for model in listed
        for name in (split_names(model) if isinstance(model, str) else (model,))
    ]


def model_name(model: AnyModel) -> str:
    if isinstance(model, (str, Path)):
        return str(model)
    return str(
        getattr(model, "asked", None)
        or getattr(model, "name", None)
        or type(model).__name__
    )


def exists_here(model: AnyModel) -> bool:
    """Whether a model exists in this session only, so that no file and no command can
    name it.
    """
    return not isinstance(model, (str, Path)) and getattr(model, "asked", None) is None


def different(names: Sequence[str], setting: str) -> Sequence[str]:
    """Return the names; an InputError says if there are none, or one comes twice."""
    twice = [name for name in names if names.count(name) > 1]
    if twice or not names:
        raise InputError(
            f"{setting}: expected different names, got {','.join(names)!r}; leave "
            f"{', '.join(twice[:1])} out"
        )
    return names


OF_SCENE = (
    "set",
    "environment",
    "up",
    "facing",
    "size",
    "unit",
    "camera",
    "things",
    "exposure",
    "object",
)


def check_not_of_scene(settings: Mapping[str, object]) -> None:
    """Refuse settings of a scene that is loaded already."""
    clash = [name for name in OF_SCENE if settings.get(name) is not None]
    if clash:
        raise InputError(
            f"{', '.join(clash)}: belongs to the scene, and a loaded "
            "scene was given; use load_scene"
        )


def check_not_spread(settings: Mapping[str, object]) -> None:
    for name in ("workers", "cluster"):
        if settings.get(name) is not None:
            raise InputError(
                f"{name}: other processes load objects, models, controls and the "
                "objective by name, and some were "
                "given as loaded objects; give their names or files"
            )


RUN_SETTINGS = ("epsilon", "norm", "texture_resolution", "path", "shutter", "rolling")
"""What a configuration says for all of its controls; each control declares what it
takes of it (`Choice.run_setting`). A configuration without such a setting counts as one
that does not say it.
"""


def given_to(
    config: SceneConfig, controls: Controls, *, are_searched: bool = True
) -> tuple[Control, ...]:
    """Return control instances, with what they take of the configuration where they say
    nothing themselves.

    Controls that are not searched, but vary by chance, have no budget.
    """
    if not are_searched:
        config = config.model_copy(update={"epsilon": None})
    asked = {
        name: given
        if isinstance(given, Control)
        else config.python_object(CONTROL, name) or given
        for name, given in controls_by_name(controls).items()
    }
    as_controls(asked)  # refuses what is none
    ready: dict[str, Control | Mapping[str, object]] = {}
    for name, given in asked.items():
        ready[name] = given
        if isinstance(given, Control):
            for choice in _counting(type(given), given.settings()):
                if getattr(config, choice.run_setting, None) is not None:
                    raise InputError(
                        f"{choice.run_setting}: control {given.name} was given as an "
                        "instance; set it there, as in "
                        f"{type(given).__name__}({choice.name}=...)"
                    )
        else:
            taken = {}
            for choice in _choices(name, given) or ():
                value = getattr(config, choice.run_setting, None)
                value = (
                    value.get(names_of(name, given)[1])
                    if isinstance(value, Mapping)
                    else value
                )
                # each run of a curve has its own epsilon
                if value is not None and not isinstance(value, tuple):
                    taken[choice.name] = value
            ready[name] = {**taken, **given}
    return as_controls(ready)


def settings_alone(
    config: SceneConfig, asked: str, given: Mapping[str, object]
) -> dict[str, Any]:
    """Return what a run over one of the controls says: None for what that does not
    take.
    """
    _, name = names_of(asked, given)
    kept = {}
    for setting in RUN_SETTINGS:
        value = getattr(config, setting, None)
        if isinstance(value, Mapping):
            value = {name: value[name]} if name in value else None
        kept[setting] = value if takes(asked, given, setting) else None
    return kept


def check_run_settings(config: SceneConfig) -> None:
    """Refuse a setting that none of the controls takes; those that vary by chance have
    no epsilon.
    """
    for setting in RUN_SETTINGS:
        value = getattr(config, setting, None)
        if value is None:
            continue
        drawn = {} if setting == "epsilon" else getattr(config, "over", {})
        asked = gathered({**config.controls, **drawn})
        without = {
            name: names_of(name, given)[0]
            for name, given in asked.items()
            if not takes(name, given, setting)
        }
        if isinstance(value, Mapping):
            known = {names_of(name, given)[1]: name for name, given in asked.items()}
            for name in value:
                if name not in known:
                    raise UnknownNameError(f"control in `{setting}`", name, known)
                if known[name] in without:
                    raise _not_taken(setting, name, without[known[name]])
        elif without and (isinstance(value, tuple) or len(without) == len(asked)):
            raise _not_taken(setting, *next(iter(without.items())))


def takes(asked: str, given: Mapping[str, object], setting: str) -> bool:
    """Whether a control takes one of the run's settings; one that is not known counts
    as one that does.
    """
    choices = _choices(asked, given)
    return choices is None or setting in {choice.run_setting for choice in choices}


def _choices(asked: str, given: Mapping[str, object]) -> list[Choice] | None:
    """The choices of a control, as it is asked for, that count; None of one that is not
    known.
    """
    ((name, settings),) = gathered({asked: given}).items()
    kind, _ = names_of(name, settings)
    return _counting(CONTROLS[kind], settings) if kind in CONTROLS else None


def _counting(kind: type[Control], given: Mapping[str, object]) -> list[Choice]:
    """The choices that count beside the settings that are given: what they are about is
    searched.
    """
    fixed = {
        choice.fixes for choice in kind.choices if given.get(choice.name) is not None
    }
    searched = {
        parameter.name for parameter in kind.parameters if parameter.search is not None
    }
    searched |= {name for name, value in given.items() if value is not None}
    searched -= fixed | {
        name for name, value in given.items() if Parameter.is_number(value)
    }
    return [
        choice
        for choice in kind.choices
        if not choice.bounds or choice.bounds in searched
    ]


def _not_taken(setting: str, name: str, kind: str) -> InputError:
    if setting == "epsilon":
        choices = CONTROLS[kind].choices if kind in CONTROLS else ()
        bounded = [
            choice.bounds
            for choice in choices
            if choice.run_setting == "epsilon" and choice.bounds
        ]
        instead = f", or search {bounded[0]} with it" if bounded else ""
        return InputError(
            f"`epsilon` {name}: the control has ranges and no epsilon; give its "
            "ranges, as in "
            f"`controls` '{name}={{PARAMETER: [LOW, HIGH]}}'{instead}"
        )
    if setting in ("path", "shutter", "rolling"):
        return InputError(
            f"{setting}: the control {name} does not move on a path; add `over=path`, "
            "or use `controls=path`"
        )
    return InputError(
        f"{setting}: the control {name} does not take it, nor does "
        "another one here; leave it out"
    )


_TURN = threading.RLock()
"""Held by the question at work: the threads of torch and Dr.Jit, and warnings that are
caught, are the process's.
"""


@contextmanager
def in_turn() -> Iterator[None]:
    """Do what a question does inside the block, after those of other threads.

    Derivatives are on in it, whatever the caller has switched off (`torch.no_grad`,
    `torch.inference_mode`). torch and Dr.Jit have their threads again after it.
    """
    with _TURN, threads.given_back(), plainly():
        yield
