"""Turn the settings of each experiment into keyword arguments for Python callers.

A setting is declared once, with its default, range and description. A Python caller may
pass more types than a file can hold (`make_hint`). `with_settings_signature` makes the
signatures and docstrings of the functions from the declared settings. For type
checkers, the keywords of `attack` and `sweep` are also declared in `SceneKeywords` and
its subclasses.
"""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import wraps
from pathlib import Path
from typing import Any, Literal, TypedDict, TypeVar

import numpy as np
from torch import nn

from advsearch.calls import check_types, drop_unset, make_unexpected_error
from advsearch.config import LIST_SETTINGS
from advsearch.engine import loading
from advsearch.engine.naming import (
    CONTROL,
    MODEL,
    SCENE,
    check_no_scene_settings,
    check_no_worker_settings,
    get_model_name,
    hold_process_lock,
    is_session_only,
)
from advsearch.errors import InputError
from advsearch.models import Model
from advsearch.options import describe_value
from advsearch.progress import open_progress
from advsearch.settings import Config, PythonOnly, Setting, settings, to_python
from advsearch.trust.code import allow_code_in_settings
from advsearch.trust.stored_files import is_shallow

Names = str | Sequence[str]  # a list of names, or a string of names with commas


class SceneKeywords(TypedDict, total=False):
    """Settings that both `attack` and `sweep` take as keywords.

    They are described in the docstrings of these functions.
    """

    environment: Path | Names | None
    up: Literal["y", "z"] | None
    facing: Literal["+x", "-x", "+y", "-y", "+z", "-z"] | None
    size: float | None
    unit: Literal["mm", "cm", "m", "in"] | None
    camera: str | Path | None
    set: Mapping[str, float | str | Sequence[float]] | None
    things: str | Path | None
    backdrop: str | Path | None
    occluder: str | Path | None
    judge: str | Path
    exposure: float
    resolution: int | str | tuple[int, int] | None
    labels: Path | Names | None
    prompt: Path | Names | None
    value_range: str | Sequence[float] | None
    ask: Mapping[str, Any]
    label: int | np.integer[Any] | Names | None
    texture_resolution: int | None
    denoise: Literal["oidn", "none"]
    pixel_sampler: Literal["independent", "multijitter"]
    seed: int
    threads: int | None
    deterministic: bool
    overwrite: bool
    specialise: bool
    aov: str | Path | None
    log: Literal["mlflow", "tensorboard", "wandb"] | None
    path: str | Path | None
    shutter: float | None
    rolling: float | None
    verify_spp: int | None
    workers: int | None
    cluster: str | Path | None
    twins: str | Path | None


class _Signature(inspect.Signature):
    """The signature of a function with all settings, for editors.

    Attributes:
        short: the signature as the function declares it, with ``**settings``. `help`
            prints this one, since the docstring lists the settings.
    """

    __slots__ = ("short",)
    short: Any

    def __str__(self) -> str:
        return str(self.short) if hasattr(self, "short") else super().__str__()

    def format(self, **options: Any) -> str:
        """See `inspect.Signature.format`, of Python 3.13."""
        return str(self.short.format(**options))


KEYWORD_ONLY = inspect.Parameter.KEYWORD_ONLY
# The parameter `run` of the experiments' functions, to check its type.
RUN_PARAMETER = {
    "run": inspect.Parameter(
        "run", KEYWORD_ONLY, default=None, annotation="str | Path | None"
    )
}
# Sentences that the docstrings of many experiments share.
RUN_STORED = "The run is saved in `run`, or in a new folder under runs/."
SHARED_ARGUMENTS = {
    "object": "scene from `load_scene`, or the name or the file of an object.",
    "model": "model from `load_model`, or anything that `load_model` takes.",
    "progress": "True displays a progress bar, False none, and None one on a terminal; "
    "a `Progress` object gets the reports.",
}
SHARED_ERRORS = (
    "InputError: a setting is wrong, or a file is missing; then nothing is written."
)
Function = TypeVar("Function", bound=Callable[..., Any])
ConfigType = TypeVar("ConfigType", bound=Config)


def with_settings_signature(config: type[Config]) -> Callable[[Function], Function]:
    """Return a decorator that documents the settings of a function with `**settings`.

    Every setting becomes a keyword in the signature, with its default, and a line among
    the arguments in the docstring. Two kinds of settings get neither: those that the
    function declares as parameters, and required ones, which must be declared.

    Args:
        config: class with the settings.
    """

    def decorate(function: Function) -> Function:
        return _document_settings(function, config)

    return decorate


def _document_settings(function: Function, config: type[Config]) -> Function:
    """Return a function with all settings in its signature and its docstring.

    Args:
        function: function that declares `**settings`.
        config: class with the settings.
    """
    declared_signature = inspect.signature(function)
    declared_parameters = _list_named_parameters(declared_signature)
    declared_names = [parameter.name for parameter in declared_parameters]
    further_settings = _list_further_settings(config, declared_signature)
    setting_parameters = [
        _make_parameter(config, setting, name) for name, setting in further_settings
    ]
    signature = _Signature(
        [*declared_parameters, *setting_parameters],
        return_annotation=declared_signature.return_annotation,
    )
    signature.short = declared_signature  # `help` displays this shorter one
    wrapper = _wrap_call(function, signature)
    wrapper.__doc__ = _make_docstring(
        function.__doc__ or "",
        declared_names,
        config.command,
        _format_setting_lines(further_settings),
    )
    wrapper.__signature__ = signature  # type: ignore[attr-defined]
    return wrapper


def _list_named_parameters(signature: inspect.Signature) -> list[inspect.Parameter]:
    """Return the parameters of a signature without `**settings`."""
    return [
        parameter
        for parameter in signature.parameters.values()
        if parameter.kind is not parameter.VAR_KEYWORD
    ]


def _format_setting_lines(named_settings: Sequence[tuple[str, Setting]]) -> list[str]:
    """Return an entry for each setting, "NAME: text", for a docstring."""
    return [
        textwrap.fill(f"{name}: {setting.text}", 110, subsequent_indent="    ")
        for name, setting in named_settings
    ]


def _list_further_settings(
    config: type[Config], declared_signature: inspect.Signature
) -> list[tuple[str, Setting]]:
    """Return the optional settings that a function does not declare, with their names.

    Args:
        config: class with the settings.
        declared_signature: the signature as the function declares it.
    """
    further_settings = []
    for setting in settings(config):
        name = setting.field.removesuffix("_")  # the field of `set` is `set_`
        is_declared = name in declared_signature.parameters
        if not is_declared and not setting.required:
            further_settings.append((name, setting))
    return further_settings


def _make_parameter(
    config: type[Config], setting: Setting, name: str
) -> inspect.Parameter:
    """Return the parameter of a setting for Python callers, with a name."""
    hint = make_hint(setting.field, config.model_fields[setting.field].annotation)
    return inspect.Parameter(
        name, KEYWORD_ONLY, default=setting.default, annotation=hint
    )


def _wrap_call(function: Function, signature: _Signature) -> Function:
    """Wrap a function of the Python interface.

    The wrapper checks the arguments, and converts numbers and arrays of numpy and torch
    to Python's. Then it calls the function with a display of its progress, and with a
    lock, so that two threads do not render at the same time.

    Args:
        function: function to call.
        signature: signature with all settings; `signature.short` is that of the
            function itself.
    """
    declared_parameters = signature.short.parameters

    @wraps(function)
    def wrapper(*args: Any, **keywords: Any) -> Any:
        _check_call(function.__name__, signature, args, keywords)
        plain_keywords = _convert_keywords(keywords)
        with ExitStack() as stack:
            stack.enter_context(hold_process_lock())
            if "progress" in declared_parameters:
                progress = open_progress(plain_keywords.get("progress"))
                plain_keywords["progress"] = stack.enter_context(progress)
            _check_named_objects(function.__name__, plain_keywords, declared_parameters)
            return function(*args, **plain_keywords)

    return wrapper  # type: ignore[return-value]


def _convert_keywords(keywords: Mapping[str, Any]) -> dict[str, Any]:
    """Return keyword arguments with numbers and arrays as Python's."""
    # Values that are nested too deeply are not converted: the settings reject them.
    plain_keywords = {}
    for key, value in keywords.items():
        is_converted = key not in UNCONVERTED_ARGUMENTS and is_shallow(value)
        plain_keywords[key] = to_python(value) if is_converted else value
    return plain_keywords


def _check_named_objects(
    function_name: str,
    keywords: Mapping[str, Any],
    declared_parameters: Mapping[str, inspect.Parameter],
) -> None:
    """Check that a task, objective or policy is a name, where no object is accepted.

    Functions that accept an object for one of these declare it as a parameter. For all
    others it is a setting, which has to be a name.

    Args:
        function_name: name of the function.
        keywords: keywords of its call.
        declared_parameters: the parameters that it declares, by name.
    """
    for key in ("task", "objective", "policy"):
        takes_object = key in declared_parameters
        if key in keywords and not takes_object:
            _check_is_name(function_name, key, keywords[key])


UNCONVERTED_ARGUMENTS = ("scene", "model", "beside", "progress", "metrics", "tracker")
"""Arguments that are passed on unchanged; others become plain Python values."""


def _check_call(
    name: str,
    signature: _Signature,
    args: Sequence[Any],
    keywords: Mapping[str, Any],
) -> None:
    """Check the arguments of a call, and allow the code that they name.

    Args:
        name: name of the function.
        signature: signature with all settings.
        args: arguments by position.
        keywords: keywords by name.

    Raises:
        TypeError: there is no such argument, or one is missing.
        InputError: a value is of another type.
    """
    error = make_unexpected_error(name, keywords, list(signature.parameters))
    if error:
        raise error
    # Only parameters that the function itself declares are checked here, and `run`. The
    # configuration checks the values of settings.
    declared_parameters = signature.short.parameters
    positional = dict(zip(declared_parameters, args, strict=False))
    check_types({**declared_parameters, **RUN_PARAMETER}, {**positional, **keywords})
    arguments = _bind_arguments(name, signature, args, keywords)
    allow_code_in_settings({**arguments, **keywords})


def _bind_arguments(
    name: str,
    signature: _Signature,
    args: Sequence[Any],
    keywords: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the arguments of a call by the names of their parameters.

    Args:
        name: name of the function.
        signature: its signature.
        args: arguments by position.
        keywords: keywords by name.

    Raises:
        TypeError: there is no such argument, or one is missing.
    """
    try:
        return signature.bind(*args, **keywords).arguments
    except TypeError as error:
        raise TypeError(f"{name}() {error}") from None


def _check_is_name(function_name: str, key: str, value: object) -> None:
    """Check that a setting has a name, or a mapping with one, and is no object.

    Most functions cannot pass objects on, such as a task of the user.

    Args:
        function_name: name of the function, for the message.
        key: name of the setting, such as "task".
        value: value of the setting.

    Raises:
        InputError: the value is an object.
    """
    if not isinstance(value, (str, Mapping, type(None))):
        raise InputError(
            f"{key}: expected a name for {function_name}, got {describe_value(value)}; "
            "`attack` takes your own, and `sweep` a task of your own"
        )


PYTHON_HINTS = {
    "controls": "Controls",
    "over": "Controls",
    "label": "int | np.integer[Any] | Names | None",
    "resolution": "int | str | tuple[int, int] | None",
    "set_": "Mapping[str, float | str | Sequence[float]] | None",
    "estimators": "str | Mapping[str, str]",
    "value_range": "str | Sequence[float] | None",
}
"""Annotations of settings that take other values in Python than they are stored as."""
PYTHON_LIST_SETTINGS = (
    *LIST_SETTINGS,
    "prompt",
    "vary",
    "ways",
    "quantities",
    "samplers",
    "case",
    "group",
)
"""Settings that Python callers may also pass as a list of names."""


def make_hint(field: str, kind: Any) -> str:
    """Return the annotation of a setting for Python callers.

    Args:
        field: name of the setting.
        kind: its declared type. Where this allows a text, Python callers may also pass
            a path, or a list of names if the setting takes several.

    Returns:
        Text such as "str | Path | None".
    """
    text = inspect.formatannotation(kind)
    text = text.replace("typing.", "").replace("NoneType", "None")
    # Leave out constraints: "Annotated[int, FieldInfo(..., metadata=[Ge(ge=1)])]"
    # becomes "int".
    text = re.sub(r"Annotated\[(\w+), .*?\]\)\]", r"\1", text)
    # In a recipe, the setting `label` may also be a mapping from objects to labels. The
    # hint in `PYTHON_HINTS` does not allow it.
    may_be_mapping = field == "label" and "dict" in text
    if field in PYTHON_HINTS and not may_be_mapping:
        return PYTHON_HINTS[field]
    string_hint = "Path | Names" if field in PYTHON_LIST_SETTINGS else "str | Path"
    hints = [_make_type_hint(name, string_hint) for name in _split_union(text)]
    return " | ".join(hints)


def _split_union(text: str) -> list[str]:
    """Return the types of an annotation: those of "A | B", or of "Optional[A]"."""
    optional = re.fullmatch(r"Optional\[(.*)\]", text)
    if optional:
        return [optional[1], "None"]
    # Split "A | B[C | D]" at each | outside of brackets: no "]" follows it before the
    # next "[".
    outer_bar = r" \| (?![^\[]*\])"
    return re.split(outer_bar, text)


def _make_type_hint(type_name: str, string_hint: str) -> str:
    """Return the annotation of a declared type for Python callers.

    Args:
        type_name: name of the type, such as "int".
        string_hint: the annotation where a text is declared.
    """
    if type_name == "str":
        return string_hint
    if type_name.startswith("dict["):
        return "Mapping[str, Any]"
    return type_name


def _make_docstring(
    text: str, names: Sequence[str], command: str, setting_lines: Sequence[str]
) -> str:
    """Complete the docstring of an experiment's function.

    Args:
        text: docstring of the function. It says what the function does, and describes
            arguments that are not in `SHARED_ARGUMENTS`.
        names: names of the function's arguments that are no settings.
        command: command of the experiment.
        setting_lines: a line for each setting.
    """
    summary, _, argument_text = inspect.cleandoc(text).partition("\n\nArgs:\n")
    entry_of_name = _split_argument_entries(argument_text)
    # A name without an entry of its own has one in `SHARED_ARGUMENTS`.
    argument_entries = [
        entry_of_name.get(name, f"{name}: {SHARED_ARGUMENTS.get(name)}")
        for name in names
    ]
    arguments = textwrap.indent("\n".join([*argument_entries, *setting_lines]), "    ")
    return (
        f"{_complete_summary(summary, command)}\n\nArgs:\n{arguments}\n\nRaises:\n"
        f"    {SHARED_ERRORS}"
    )


def _complete_summary(summary: str, command: str) -> str:
    """Return a docstring's beginning with a sentence about the settings of a command."""
    # Some docstrings have the sentence below already, with details of their own.
    summary_line = " ".join(summary.split())
    if "other arguments are the settings of" in summary_line:
        return summary
    return (
        f"{summary}\n\nAll other arguments are the settings of `advsearch "
        f"{command}`. {RUN_STORED}"
    )


def _split_argument_entries(argument_text: str) -> dict[str, str]:
    """Return the entries of a docstring's section of arguments by their names."""
    # An entry is "NAME: text", and the text may continue on indented lines. So a new
    # entry begins where a line begins with a name and a colon.
    entries = re.split(r"(?m)^(?=\w+: )", textwrap.dedent(argument_text))
    return {entry.partition(":")[0]: entry.rstrip() for entry in entries if entry}


def make_config(config: type[ConfigType], **keywords: Any) -> ConfigType:
    """Create a configuration from settings as Python callers pass them.

    A scene, a model and controls may be Python objects. Since a configuration is stored
    in a file, its settings have the names of these objects. The objects themselves are
    attached to it (`Config.get_python_object`), with a list of those that only this
    Python session has, and that no file can name.

    Args:
        config: class of the configuration.
        keywords: settings by name; None counts as not passed.

    Raises:
        InputError: a setting is wrong, or contradicts an object.
    """
    settings = drop_unset(keywords)
    _check_no_workers_for_objects(settings)
    replaced = _ReplacedObjects()
    replaced.replace_model(settings)
    replaced.replace_scene(settings)
    for name in ("controls", "over"):
        replaced.replace_controls(settings, name)
    return (
        config(**settings)
        .with_python_objects(replaced.objects)
        .with_python_only_parts(replaced.python_only)
    )


def _check_no_workers_for_objects(settings: Mapping[str, Any]) -> None:
    """Check that there are no settings of workers if the scene or the model is an
    object.

    Workers are other processes, to which these objects cannot be sent.

    Raises:
        InputError: there are such settings.
    """
    has_scene = isinstance(settings.get("object"), loading.Scene)
    if has_scene or isinstance(settings.get("model"), (Model, nn.Module)):
        check_no_worker_settings(settings)


@dataclass
class _ReplacedObjects:
    """Python objects that were settings, and were replaced by their names.

    Attributes:
        objects: the objects by kind, such as `MODEL`, and name.
        python_only: those that only this Python session has.
    """

    objects: dict[tuple[str, str], Any] = field(default_factory=dict)
    python_only: list[PythonOnly] = field(default_factory=list)

    def replace_model(self, settings: dict[str, Any]) -> None:
        """Replace a model that is an object by its name; settings change in place."""
        model = settings.get("model")
        if not isinstance(model, (Model, nn.Module)):
            return
        name = get_model_name(model)
        settings["model"] = name
        self.objects[MODEL, name] = model
        if is_session_only(model):
            self.python_only.append(PythonOnly("model", name))

    def replace_scene(self, settings: dict[str, Any]) -> None:
        """Replace a scene that is an object by its settings, which change in place.

        Raises:
            InputError: there are settings of loading, too, which come too late.
        """
        scene = settings.get("object")
        if not isinstance(scene, loading.Scene):
            return
        _replace_scene_object(settings, scene)
        self.objects[SCENE, settings["object"]] = scene
        if scene.is_session_only:
            self.python_only.append(PythonOnly("scene"))

    def replace_controls(self, settings: dict[str, Any], name: str) -> None:
        """Replace controls that are objects by their names and options.

        Args:
            settings: settings by name, which are changed in place.
            name: name of the setting, "controls" or "over".
        """
        instances = _replace_control_objects(settings, name)
        self.objects |= {(CONTROL, control.name): control for control in instances}
        self.python_only += _list_session_only_parts(instances)


def _replace_scene_object(settings: dict[str, Any], scene: loading.Scene) -> None:
    """Replace a scene that is an object by the settings with which it was loaded.

    Args:
        settings: settings by name, which are changed in place.
        scene: the scene.

    Raises:
        InputError: there are settings of loading, too, which come too late.
    """
    check_no_scene_settings(
        {name: value for name, value in settings.items() if name != "object"}
    )
    # the settings with which it was loaded, with the name of its object
    scene_settings = loading.scene_to_settings(scene)
    settings |= drop_unset(scene_settings)


def _list_session_only_parts(instances: Sequence[Any]) -> list[PythonOnly]:
    """Return those of some control objects that only this Python session has."""
    return [
        PythonOnly("control", kind)
        for kind in loading.list_session_only_controls(instances)
    ]


def _replace_control_objects(settings: dict[str, Any], name: str) -> Sequence[Any]:
    """Replace controls that are objects in a setting by their names and options.

    The other controls in the setting are brought into the same form.

    Args:
        settings: settings by name; the setting is changed in place.
        name: name of the setting: "controls" for those that are searched, or "over" for
            those that vary at random.

    Returns:
        The objects that were replaced.
    """
    controls: Any = settings.get(name)
    instances = loading.list_control_instances(controls)
    # Options in a mapping may hold Python functions, so a mapping is always converted.
    if not instances and not isinstance(controls, Mapping):
        return ()
    # Workers are other processes, which cannot load objects of this session.
    if loading.list_session_only_controls(controls):
        check_no_worker_settings(settings)
    settings[name] = loading.controls_to_settings(controls)
    return instances
