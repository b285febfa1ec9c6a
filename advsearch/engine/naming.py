"""Load the scene, the models and the controls that a configuration names.

Also here: the settings that a configuration states for all of its controls, and the
lock that lets one experiment of the process run at a time.
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
from advsearch.controls import (
    CONTROLS,
    Choice,
    Control,
    merge_control_settings,
    parse_control_name,
)
from advsearch.engine.loading import (
    Controls,
    Scene,
    load_scene,
    make_controls,
    normalize_controls,
)
from advsearch.errors import InputError, UnknownNameError
from advsearch.models import Model, ModelWarning, load_model
from advsearch.models.all_at_once import AllAtOnce
from advsearch.models.loading import parse_code_reference
from advsearch.scene.rig import read_rig
from advsearch.scene.settings import Parameter, SettingValues
from advsearch.settings import split_names
from advsearch.tasks import Task
from advsearch.tasks.together import EnsembleTask, join_models
from advsearch.trust.foreign_code import use_default_torch_state

CONTROL = "control"
MODEL = "model"
SCENE = "scene"
"""Roles of objects that a Python caller may pass instead of a name."""


def load_configured_scene(
    config: SceneConfig, name: str | None = None, environment: str | None = None
) -> Scene:
    """Load the scene of a configuration.

    Args:
        config: the configuration.
        name: object of the scene; None for the object of the configuration. This may be
            a loaded scene that a Python caller passed, which is returned as it is.
        environment: environment for `name`. Without a name, the environment of the
            configuration is used.
    """
    if name is None:
        # None if the object was stated by its name
        scene: Scene | None = config.get_python_object(SCENE, config.object)
        if scene is not None:
            return scene
        name = config.object
        environment = config.environment
    return load_scene(name, environment, **make_scene_kwargs(config))


def make_scene_kwargs(config: SceneConfig) -> dict[str, Any]:
    """Return the keyword arguments of `load_scene` that a configuration states."""
    names = ("up", "facing", "size", "unit", "camera", "things", "backdrop", "occluder")
    return {
        **{name: getattr(config, name) for name in names},
        "settings": collect_scene_parameters(config),
    }


def collect_scene_parameters(config: SceneConfig) -> SettingValues:
    """Return the parameters that a scene is loaded with, by name.

    They are those of the setting `set`, and `exposure` as "camera.exposure".

    Raises:
        InputError: both state an exposure.
    """
    parameters: dict[str, Any] = dict(config.set_)
    # 0 stops of exposure is the default, and changes nothing
    if config.exposure:
        if "camera.exposure" in parameters:
            raise InputError(
                "`exposure` and `set` camera.exposure say the same thing; "
                "leave one of them out"
            )
        parameters["camera.exposure"] = config.exposure
    return parameters


def list_imported_code(
    models: Iterable[str], kinds: Iterable[str], metrics: Iterable[str] = ()
) -> tuple[str, ...]:
    """List the Python code, "package.module:attribute", that these names import."""
    code = [*(parse_code_reference(name) for name in models), *metrics]
    code += [name for name in kinds if CONTROLS.is_class_path(name)]
    return tuple(dict.fromkeys(name for name in code if name))


def load_models(
    models: Sequence[Any], task: Task, config: SceneConfig
) -> tuple[tuple[Model, ...], list[str]]:
    """Load the models of a configuration, and set its number of threads.

    Args:
        models: names, or models that a Python caller passed.
        task: task of the models. An `EnsembleTask` has a task for each model, and these
            models are joined into one.
        config: states labels, prompt, range of values, camera and number of threads.

    Returns:
        The models, and their warnings as sentences of the run.

    Raises:
        InputError: another number of models than tasks, a task that cannot judge a rig,
            or a model that takes another number of images than there are cameras.
    """
    threads.configure(config.n_used_threads)
    if isinstance(task, EnsembleTask):
        models = to_model_list(models)
    loaded, sentences = _load_with_warnings(models, task, config)
    loaded = _add_rig_cameras(loaded, task, config.camera)
    for model in loaded:
        _check_n_images(model)
    if isinstance(task, EnsembleTask):
        return (join_models(loaded, config.resolution),), sentences
    return loaded, sentences


def _load_with_warnings(
    models: Sequence[Any], task: Task, config: SceneConfig
) -> tuple[tuple[Model, ...], list[str]]:
    """Load models of a task, and return them and their warnings as sentences."""
    tasks = _list_tasks(task, len(models))
    with warnings.catch_warnings(record=True) as caught:
        # Python shows an equal warning only once, and "always" records every one
        warnings.simplefilter("always", ModelWarning)
        loaded = _load_each(models, tasks, task, config)
    return loaded, _take_model_warnings(caught)


def _list_tasks(task: Task, n_models: int) -> tuple[Task, ...]:
    """Return the task of each model, for an `EnsembleTask` its parts.

    Raises:
        InputError: there is another number of models than tasks.
    """
    if not isinstance(task, EnsembleTask):
        return (task,) * n_models
    tasks = task.parts
    if n_models != len(tasks):
        raise InputError(
            f"model: expected {len(tasks)}, one for each task, got {n_models}"
        )
    return tasks


def _load_each(
    models: Sequence[Any], tasks: Sequence[Task], task: Task, config: SceneConfig
) -> tuple[Model, ...]:
    """Load each model for its task, which is `task` or, of an ensemble, a part of it."""
    return tuple(
        _load_for_task(model, task_of_model, config, is_only_task=task_of_model is task)
        for model, task_of_model in zip(models, tasks, strict=True)
    )


def _add_rig_cameras(
    models: tuple[Model, ...], task: Task, camera: str | None
) -> tuple[Model, ...]:
    """Return the models with the number of cameras of a rig, if the camera is one."""
    if camera is None:
        return models
    n_cameras = len(read_rig(camera))  # 0 for a camera that is no rig
    if not n_cameras:
        return models
    _check_task_of_rig(task, camera, n_cameras)
    return tuple(replace(model, cameras=n_cameras) for model in models)


def _load_for_task(
    model: Any, task: Task, config: SceneConfig, *, is_only_task: bool
) -> Model:
    """Load one model for its task.

    Args:
        model: name of the model, or a loaded one.
        task: task of the model.
        config: states labels, prompt and range of values.
        is_only_task: whether all models have this task. If each model has its own task,
            the labels and the prompt of the configuration are only for those tasks that
            need names of classes from the user.
    """
    single_image_task = task.single_image_task
    labels = None
    prompt = None
    # A task with classes needs their names from the user, unless it takes them from
    # another source.
    needs_names = single_image_task.labelled and not single_image_task.names_source
    if is_only_task or needs_names:
        labels = config.labels
        prompt = config.prompt
    if isinstance(model, str):
        # The name may be that of an object that a Python caller passed.
        model = config.get_python_object(MODEL, model) or model
    return load_model(
        model,
        labels=labels,
        prompt=prompt,
        value_range=config.value_range,
        task=single_image_task,
        ask=config.ask,
    )


def _take_model_warnings(caught: Iterable[warnings.WarningMessage]) -> list[str]:
    """Return the warnings of models as sentences, and issue all others again."""
    sentences = []
    for warning in caught:
        if issubclass(warning.category, ModelWarning):
            sentences.append(str(warning.message))
        else:
            warnings.warn_explicit(
                warning.message, warning.category, warning.filename, warning.lineno
            )
    return sentences


def _check_task_of_rig(task: Task, camera: str, n_cameras: int) -> None:
    """Raise InputError if a task cannot judge the images of several cameras.

    Args:
        task: task of the run.
        camera: setting that names the cameras, for the message.
        n_cameras: their number.
    """
    if not task.judges_rig:
        raise InputError(
            f"camera: {camera} has {n_cameras} cameras, and task {task.name} "
            "is of one picture; say what is "
            f"made of several, as in `task='rig={{task: {task.name}, rule: any}}'`"
        )


def _check_n_images(model: Model) -> None:
    """Raise InputError if a model takes more or fewer images than there are cameras.

    Only a module that takes the images of all cameras at once has a fixed number.
    """
    module = model.module
    if isinstance(module, AllAtOnce) and module.cameras != model.cameras:
        verb = "is" if model.cameras == 1 else "are"
        raise InputError(
            f"model: {model.name} takes {module.cameras} pictures at once, and "
            f"{model.cameras} {verb} taken; give a `camera` that is a rig of as many"
        )


AnyModel = Model | nn.Module | str | Path


def to_model_list(models: AnyModel | Sequence[AnyModel]) -> list[AnyModel]:
    """Return one model or several as a list.

    One string may have several names, with commas between them.
    """
    items: Sequence[AnyModel] = [models]  # type: ignore[list-item]
    if isinstance(models, (list, tuple)):
        items = models
    model_list: list[AnyModel] = []
    for model in items:
        if isinstance(model, str):
            model_list += split_names(model)
        else:
            model_list.append(model)
    return model_list


def get_model_name(model: AnyModel) -> str:
    """Return the name by which a run knows a model, which may not be loaded yet."""
    if isinstance(model, (str, Path)):
        return str(model)
    if isinstance(model, Model) and model.spec:
        return model.spec
    return str(getattr(model, "name", None) or type(model).__name__)


def is_session_only(model: AnyModel) -> bool:
    """Return whether a model exists in this session only.

    Then it can't be named in a file or a command.
    """
    if isinstance(model, Model):
        # `spec` is the name or path from which it was loaded
        return model.spec is None
    return not isinstance(model, (str, Path))


def check_distinct(names: Sequence[str], setting: str) -> Sequence[str]:
    """Return the names if they are all different.

    Args:
        names: names, such as those of models.
        setting: setting that states them, for the message.

    Raises:
        InputError: there are none, or one comes twice.
    """
    if not names:
        raise InputError(f"{setting}: expected at least one name, got none")
    for name in names:
        if names.count(name) > 1:
            raise InputError(
                f"{setting}: expected different names, got {','.join(names)!r}; leave "
                f"{name} out"
            )
    return names


SCENE_SETTINGS = (
    "set",
    "environment",
    "up",
    "facing",
    "size",
    "unit",
    "camera",
    "things",
    "backdrop",
    "occluder",
    "exposure",
    "object",
)


def check_no_scene_settings(settings: Mapping[str, object]) -> None:
    """Raise InputError for settings of a scene that is loaded already."""
    rejected = [name for name in SCENE_SETTINGS if settings.get(name) is not None]
    if rejected:
        raise InputError(
            f"{', '.join(rejected)}: belongs to the scene, and a loaded "
            "scene was given; use load_scene"
        )


def check_no_worker_settings(settings: Mapping[str, object]) -> None:
    """Raise InputError if there are settings of workers; for a run with loaded objects.

    Workers are other processes, which can only load objects by name. The caller knows
    that some were passed as loaded objects.
    """
    for name in ("workers", "cluster"):
        if settings.get(name) is not None:
            raise InputError(
                f"{name}: other processes load objects, models, controls and the "
                "objective by name, and some were "
                "passed as loaded objects; pass their names or files"
            )


RUN_SETTINGS = ("epsilon", "norm", "texture_resolution", "path", "shutter", "rolling")
"""Settings that a configuration states for all of its controls.

Each control declares which of them it takes (`Choice.run_setting`). Not every
configuration has all of these settings.
"""


SETTINGS_OF_SEARCHES = frozenset({"epsilon"})
"""Settings of these that only searched controls take, not those that vary by chance."""


def collect_run_settings(
    config: SceneConfig, *, are_searched: bool = True
) -> dict[str, Any]:
    """Return the settings that a configuration states for its controls, by name.

    Args:
        config: the configuration.
        are_searched: whether the controls are searched. If they vary by chance instead,
            settings of searches, such as `epsilon`, are left out.
    """
    values = {name: getattr(config, name, None) for name in RUN_SETTINGS}
    return {
        name: value
        for name, value in values.items()
        if value is not None and (are_searched or name not in SETTINGS_OF_SEARCHES)
    }


def make_configured_controls(
    config: SceneConfig, controls: Controls, *, are_searched: bool = True
) -> tuple[Control, ...]:
    """Return control instances, completed by the settings of the run.

    For example, `path` of the configuration is added to each control that takes a path
    and does not state one.

    Args:
        config: the configuration.
        controls: names, instances, or a mapping from names to settings.
        are_searched: whether the controls are searched, and do not vary by chance.

    Raises:
        InputError: a control that was passed as an instance would take a setting of the
            run, or a control is unknown.
    """
    run_settings = collect_run_settings(config, are_searched=are_searched)
    control_by_name = _find_passed_controls(config, controls)
    # Only to raise an error for an unknown control before settings are read. The
    # instances are made at the end, with all settings.
    make_controls(control_by_name)
    completed = {
        name: _complete_control(run_settings, name, control)
        for name, control in control_by_name.items()
    }
    return make_controls(completed)


def _find_passed_controls(config: SceneConfig, controls: Controls) -> dict[str, Any]:
    """Return instance or settings of each control by name.

    A name may be that of an instance that a Python caller passed.
    """
    control_by_name: dict[str, Any] = {}
    for name, control in normalize_controls(controls).items():
        if not isinstance(control, Control):
            control = config.get_python_object(CONTROL, name) or control
        control_by_name[name] = control
    return control_by_name


def _complete_control(
    run_settings: Mapping[str, Any],
    name: str,
    control: Control | Mapping[str, object],
) -> Control | Mapping[str, object]:
    """Return a control with the settings of the run that it takes; an instance stays.

    Raises:
        InputError: the instance would take a setting of the run.
    """
    if isinstance(control, Control):
        _check_takes_no_run_setting(run_settings, control)
        return control
    defaults_from_run = _select_settings(run_settings, name, control)
    # what the user stated for the control itself wins
    return {**defaults_from_run, **control}


def _check_takes_no_run_setting(
    run_settings: Mapping[str, Any], control: Control
) -> None:
    """Raise InputError if an instance would take a setting that the run states.

    An instance is complete: the setting could not be added to it.
    """
    for choice in _list_active_choices(type(control), control.to_settings()):
        if choice.run_setting in run_settings:
            raise InputError(
                f"{choice.run_setting}: control {control.name} was given as an "
                "instance; set it there, as in "
                f"{type(control).__name__}({choice.name}=...)"
            )


def _select_settings(
    run_settings: Mapping[str, Any],
    qualified_name: str,
    control_settings: Mapping[str, object],
) -> dict[str, object]:
    """Return the settings of the run that a control takes.

    Args:
        run_settings: settings by name, such as `epsilon`. A value may be a mapping with
            a value for each of some controls.
        qualified_name: kind and name of the control, such as "light:key".
        control_settings: settings that the user stated for the control.

    Returns:
        Values by the control's own name of the setting.
    """
    selected: dict[str, object] = {}
    choices = _list_choices(qualified_name, control_settings)
    for choice in choices or ():  # None for an unknown control
        value = run_settings.get(choice.run_setting)
        if isinstance(value, Mapping):
            _, instance_name = parse_control_name(qualified_name, control_settings)
            value = value.get(instance_name)
        # A tuple is a curve of epsilons: each of its runs has a single one.
        if value is not None and not isinstance(value, tuple):
            selected[choice.name] = value
    return selected


def select_run_settings(
    config: SceneConfig, qualified_name: str, control_settings: Mapping[str, object]
) -> dict[str, Any]:
    """Return the settings of a run, for another run over only one of its controls.

    Args:
        config: configuration of the run over all controls.
        qualified_name: kind and name of the control, such as "light:key".
        control_settings: settings of the control.

    Returns:
        A value for each of `RUN_SETTINGS`; None for those that the control does not
        take.
    """
    _, instance_name = parse_control_name(qualified_name, control_settings)
    run_settings = {}
    for setting in RUN_SETTINGS:
        value = getattr(config, setting, None)
        # a mapping has values for some controls by their names
        if isinstance(value, Mapping):
            is_named = instance_name in value
            value = {instance_name: value[instance_name]} if is_named else None
        # also if it is stated, since it may be for other controls of the run
        if not takes_setting(qualified_name, control_settings, setting):
            value = None
        run_settings[setting] = value
    return run_settings


def check_run_settings(config: SceneConfig) -> None:
    """Check that every setting of a run is taken by one of its controls.

    A setting of searches, such as `epsilon`, has to be taken by a searched control. Any
    other may also be taken by a control that varies by chance (`over`).

    Raises:
        InputError: no control takes a setting, or the one that it names does not.
        UnknownNameError: a setting names a control that is not there.
    """
    for setting, value in collect_run_settings(config).items():
        controls = _collect_setting_takers(config, setting)
        rejecting_kinds = _find_rejecting_kinds(controls, setting)
        # a mapping from names of controls to values, such as {"key": 0.1}
        if isinstance(value, Mapping):
            _check_named_controls(setting, value, controls, rejecting_kinds)
            continue
        # A tuple of values is a curve, with a run for each value: all controls have to
        # take the setting. For a single value it is enough if one of them does.
        is_curve = isinstance(value, tuple)
        is_rejected_by_all = len(rejecting_kinds) == len(controls)
        is_unsupported = is_rejected_by_all or is_curve
        if rejecting_kinds and is_unsupported:
            name, kind = next(iter(rejecting_kinds.items()))
            raise _make_unsupported_error(setting, name, kind)


def _collect_setting_takers(
    config: SceneConfig, setting: str
) -> dict[str, dict[str, object]]:
    """Return the controls that may take a setting of the run: their settings by name."""
    random_controls: Mapping[str, Any] = {}
    if setting not in SETTINGS_OF_SEARCHES:
        # `over` has the controls that vary by chance; only some commands have it
        random_controls = getattr(config, "over", {})
    # several names may state parameters of one control
    return merge_control_settings({**config.controls, **random_controls})


def _find_rejecting_kinds(
    controls: Mapping[str, Mapping[str, object]], setting: str
) -> dict[str, str]:
    """Return the kind of each control that does not take a setting, by its name."""
    rejecting_kinds = {}
    for name, control_settings in controls.items():
        if not takes_setting(name, control_settings, setting):
            kind, _ = parse_control_name(name, control_settings)
            rejecting_kinds[name] = kind
    return rejecting_kinds


def _check_named_controls(
    setting: str,
    names: Iterable[str],
    controls: Mapping[str, Mapping[str, object]],
    rejecting_kinds: Mapping[str, str],
) -> None:
    """Check that the controls which a setting names exist, and take it.

    Args:
        setting: name of the setting.
        names: names of controls, as the setting has them.
        controls: settings of all controls by qualified name, such as "light:key".
        rejecting_kinds: kinds of the controls that do not take the setting, by
            qualified name.

    Raises:
        UnknownNameError: there is no such control.
        InputError: a control does not take the setting.
    """
    # The setting names a control as "key", and `controls` as "light:key".
    qualified_names = {
        parse_control_name(qualified_name, control_settings)[1]: qualified_name
        for qualified_name, control_settings in controls.items()
    }
    for name in names:
        if name not in qualified_names:
            raise UnknownNameError(f"control in `{setting}`", name, qualified_names)
        kind = rejecting_kinds.get(qualified_names[name])
        if kind is not None:
            raise _make_unsupported_error(setting, name, kind)


def takes_setting(
    qualified_name: str, control_settings: Mapping[str, object], setting: str
) -> bool:
    """Return whether a control takes one of the run's settings.

    A control of unknown kind counts as one that does, as its error is reported
    elsewhere.

    Args:
        qualified_name: kind and name of the control, such as "light:key".
        control_settings: settings that the user stated for the control.
        setting: name of a setting of the run, such as "epsilon".
    """
    # settings of the control that are not searched; None for a control of unknown kind
    choices = _list_choices(qualified_name, control_settings)
    if choices is None:
        return True
    return setting in {choice.run_setting for choice in choices}


def _list_choices(
    qualified_name: str, control_settings: Mapping[str, object]
) -> list[Choice] | None:
    """List the choices of a control that have an effect; None for an unknown kind.

    A choice is an option of a control besides its parameters, such as `epsilon`.

    Args:
        qualified_name: kind and name, such as "light:key", perhaps with a parameter.
        control_settings: settings that the user stated for it.
    """
    # a name may have a parameter behind it ("camera.azimuth"), which becomes a setting
    merged = merge_control_settings({qualified_name: control_settings})
    ((name, settings),) = merged.items()
    kind, _ = parse_control_name(name, settings)
    if kind not in CONTROLS:
        return None
    return _list_active_choices(CONTROLS[kind], settings)


def _list_active_choices(
    kind: type[Control], settings: Mapping[str, object]
) -> list[Choice]:
    """List the choices of a control that have an effect with these settings.

    A choice is an option of a control besides its parameters. `Choice.bounds` names the
    parameter that a choice bounds, as `epsilon` does; the choice has no effect if that
    parameter is not searched. A parameter is not searched if it is set to a number, if
    another choice fixes it (`Choice.fixes`), or if it has no default range and none is
    set.

    Args:
        kind: class of the control.
        settings: settings that the user stated for it: values of parameters and of
            choices, by name.
    """
    # names of parameters that a choice fixes, or that are set to a number
    fixed = {
        choice.fixes for choice in kind.choices if settings.get(choice.name) is not None
    }
    fixed |= {name for name, value in settings.items() if Parameter.is_number(value)}
    searched = _find_searched_names(kind, settings) - fixed
    return [
        choice
        for choice in kind.choices
        if not choice.bounds or choice.bounds in searched
    ]


def _find_searched_names(
    kind: type[Control], settings: Mapping[str, object]
) -> set[str]:
    """Return the names of parameters with a default range, or with a range that is set.

    Names of choices that are set are among these as well. They do no harm, as
    `Choice.bounds` is never the name of a choice.
    """
    searched = {
        parameter.name for parameter in kind.parameters if parameter.search is not None
    }
    searched |= {name for name, value in settings.items() if value is not None}
    return searched


def _make_unsupported_error(setting: str, name: str, kind: str) -> InputError:
    """Return the error of a setting that a control does not take.

    Args:
        setting: name of the setting, such as "epsilon".
        name: name of the control.
        kind: kind of the control, on which the advice depends.
    """
    if setting == "epsilon":
        return _make_epsilon_error(name, kind)
    if setting in ("path", "shutter", "rolling"):
        return InputError(
            f"{setting}: the control {name} does not move on a path; add `over=path`, "
            "or use `controls=path`"
        )
    return InputError(
        f"{setting}: the control {name} does not take it, nor does "
        "another one here; leave it out"
    )


def _make_epsilon_error(name: str, kind: str) -> InputError:
    """Return the error of an epsilon that a control, of some kind, does not take."""
    choices = CONTROLS[kind].choices if kind in CONTROLS else ()
    # Some controls take an epsilon for one of their parameters, but only if it is
    # searched. `Choice.bounds` is the name of the parameter. The first is
    # suggested.
    bounded_parameters = [
        choice.bounds
        for choice in choices
        if choice.run_setting == "epsilon" and choice.bounds
    ]
    instead = ""
    if bounded_parameters:
        instead = f", or search {bounded_parameters[0]} with it"
    return InputError(
        f"`epsilon` {name}: the control has ranges and no epsilon; give its "
        f"ranges, as in `controls` '{name}={{PARAMETER: [LOW, HIGH]}}'{instead}"
    )


_PROCESS_LOCK = threading.RLock()
"""Lock that is held by the running experiment. The number of threads of torch and
Dr.Jit and the recording of warnings are shared by the process.
"""


@contextmanager
def hold_process_lock() -> Iterator[None]:
    """Run a block while no other thread of the process runs an experiment.

    Gradients are enabled in it, even if the caller has disabled them (`torch.no_grad`,
    `torch.inference_mode`). Afterwards torch and Dr.Jit have as many threads as before.
    """
    with _PROCESS_LOCK, threads.restore_threads(), use_default_torch_state():
        yield
