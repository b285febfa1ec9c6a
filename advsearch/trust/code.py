"""Allow Python code, weights of a library or an address only if the user has named it.

The threat: a run, a suite, a recipe or a model file of somebody else names code, and
whoever opens it would run that code. So a name that is only in a file is rejected, and
the message explains how the user allows it (`allow_code`, the setting `code`). Modules
are searched in the current directory last, and Python processes that we start have our
own folder as theirs.

Used wherever a name becomes code: controls, objectives, models and metrics
(`registry.py`, `models/source.py`, `engine/judging.py`), models of libraries and
addresses (`models/zoo/library.py`, `models/address.py`), workers (`cluster/worker.py`),
and where people name things (`cli/`, `api/`, `testing.py`).
"""

from __future__ import annotations

import importlib
import inspect
import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import wraps
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any, TypeVar

from advsearch.errors import CodeNotAllowedError, InputError

Function = TypeVar("Function", bound=Callable[..., Any])
_ALLOWED: set[str] = set()
"""Python code, models of libraries and addresses that the user of this process has
named. The set belongs to the process, so that it is the same in every thread.
"""
_CODE = re.compile(r"[^\W\d][\w.]*:[^\W\d][\w.]*|(?:hf|timm|torchvision|https?):\S+")


def allow_code(*names: str) -> None:
    """Allow this process to import Python code that a file names.

    Such a file is the `run.yaml` of a run, which may come from somebody else. Read the
    code before you allow it.

    Args:
        names: names to allow, as in the file: code,
            "package.module:attribute", without weights after an @; a model of a
            library, "hf:OWNER/NAME", whose weights may then be downloaded; or the
            address of a model, "https://...", to which images may then be sent.

    Raises:
        InputError: a name has none of these forms.
    """
    for name in names:
        if not isinstance(name, str) or not _CODE.fullmatch(name):
            raise InputError(
                f"code: expected package.module:attribute, got {str(name)[:80]!r}"
            )
    _ALLOWED.update(names)


def allowed_code() -> tuple[str, ...]:
    """Return all names that are allowed, sorted."""
    return tuple(sorted(_ALLOWED))


def allow_code_in_settings(settings: Mapping[str, Any]) -> None:
    """Allow the code that the user names in settings, on the command line or in Python.

    Models, controls and metrics may name code. Settings from a file are never passed to
    this function, since somebody else may have written the file.

    Args:
        settings: values of settings by name.
    """
    names: list[object] = []
    for key in ("model", "compared", "than"):
        names += _list_model_names(settings.get(key))
    for key in ("controls", "over"):
        names += _list_control_names(settings.get(key))
    metrics = settings.get("metrics")
    if isinstance(metrics, Mapping):
        names += map(_name_metric, metrics.values())
    texts = [name.strip() for name in names if isinstance(name, str)]
    # Other names, such as those of bundled models, need no permission.
    _ALLOWED.update(filter(_CODE.fullmatch, texts))


def _list_model_names(value: Any) -> list[str]:
    """Return the names in a setting of models, without @WEIGHTS.

    Args:
        value: names separated by commas, or a list of these.
    """
    texts = [text for text in _to_list(value) if isinstance(text, str)]
    return [part.partition("@")[0] for text in texts for part in text.split(",")]


def _list_control_names(value: Any) -> list[object]:
    """Return what may name code in a setting of controls: their names and kinds.

    Args:
        value: names separated by commas; a list of names, mappings of settings, or
            instances of controls; or a mapping from names to mappings or instances.
    """
    # For a mapping, this is the list of its keys, the names of controls.
    controls = _to_list(value)
    if isinstance(value, Mapping):
        controls += value.values()
    names: list[object] = []
    for control in controls:
        if isinstance(control, str):
            names += control.split(",")
        elif isinstance(control, Mapping):
            # a mapping of settings, of which "kind" may name code
            names.append(control.get("kind"))
        else:
            names.append(getattr(control, "kind", None))
    return names


def _name_metric(metric: Any) -> Any:
    """Return the name of a metric's function; a metric that is no function as it is."""
    if callable(metric):
        return f"{metric.__module__}:{getattr(metric, '__qualname__', '')}"
    return metric


def allow_code_of_call(function: Function) -> Function:
    """Make a function allow the code that its caller names in the arguments.

    Decorate only functions that users call from Python: there the user names the code,
    and no file does. The parameters of the function have the names of settings, such as
    `model` and `controls`.
    """
    signature = inspect.signature(function)

    @wraps(function)
    def wrapper(*args: Any, **keywords: Any) -> Any:
        """Allow the code in the arguments, and call the function."""
        # Arguments that do not fit the signature raise TypeError here; the call below
        # raises a better one.
        with suppress(TypeError):
            allow_code_in_settings(signature.bind(*args, **keywords).arguments)
        return function(*args, **keywords)

    return wrapper  # type: ignore[return-value]


def _to_list(value: Any) -> list[Any]:
    """Return the items of a list, the keys of a mapping, or a list of another value."""
    return list(value) if isinstance(value, (list, tuple, Mapping)) else [value]


@contextmanager
def restrict_allowed_code() -> Iterator[None]:
    """Allow no code at the beginning of the block.

    After it, exactly the code is allowed that was allowed before.
    """
    before = allowed_code()
    _ALLOWED.clear()
    try:
        yield
    finally:
        _ALLOWED.clear()
        _ALLOWED.update(before)


def is_fetch_allowed(model: str) -> bool:
    """Return whether weights of a library's model may be fetched.

    They may if the user has named the model.
    """
    return model in _ALLOWED or model.partition("@")[0] in _ALLOWED


def explain_how_to_allow(name: str) -> str:
    """Return how the user allows a name that is only in a file, for messages."""
    return (
        "if you trust it, allow it yourself: in Python with "
        f"advsearch.allow_code({name!r}), or with `code={name}`"
    )


def check_import(name: str) -> None:
    """Check that "package.module:attribute" may be imported.

    Raises:
        CodeNotAllowedError: only a file names it. The message states the Python file
            that would be run, and how to allow it.
    """
    if name in _ALLOWED:
        return
    importlib.invalidate_caches()
    # Only the top package is searched. That runs no code, but searching a module inside
    # of it would import the package.
    top_package = name.partition(":")[0].partition(".")[0]
    spec = PathFinder.find_spec(top_package, [*sys.path, os.getcwd()])
    where = f" from {spec.origin}" if spec is not None and spec.origin else ""
    raise CodeNotAllowedError(
        f"a file names {name}, Python code{where} that would be imported and run; read "
        f"it, and {explain_how_to_allow(name)}"
    )


SUBPROCESS_DIRECTORY = Path(__file__).resolve().parents[2]
"""Working directory of Python processes that we start. Python searches it for modules
first, and the current directory of the user may have files of somebody else.
"""


@contextmanager
def current_directory_importable() -> Iterator[None]:
    """Search modules in the current directory, too, inside the block.

    It is searched after all other directories.
    """
    directory = os.getcwd()
    added = directory not in sys.path and "" not in sys.path
    if added:
        sys.path.append(directory)
        importlib.invalidate_caches()
    try:
        yield
    finally:
        if added and directory in sys.path:
            sys.path.remove(directory)
