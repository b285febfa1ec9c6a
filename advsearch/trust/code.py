"""What runs Python code, fetches weights of a library, or asks a model's address: only
what a person has named.

The threat: a run, a suite, a recipe or a model file of somebody else names code, and
whoever opens it would run that code. So a name that only a file has is refused, and the
message says how a person allows it (`allow_code`, the setting `code`). Modules of the
current directory come last, and processes of Python that we start begin in our own
folder.

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
"""The Python code, and the models of libraries, that whoever uses this process has
named. Of the process, so that it holds in every thread; empty at first, so that what
only a file names is refused, whoever reads that file.
"""
_CODE = re.compile(r"[^\W\d][\w.]*:[^\W\d][\w.]*|(?:hf|timm|torchvision|https?):\S+")


def allow_code(*names: str) -> None:
    """Allow this process to import Python code that a file names.

    Such a file is the `run.yaml` of a run, which may come from somebody else. Read the
    code before you allow it.

    Args:
        names: what is allowed, as the file names it: code,
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
    return tuple(sorted(_ALLOWED))


def allow_named(settings: Mapping[str, Any]) -> None:
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
    # plain names, such as those of bundled models, need no permission
    _ALLOWED.update(filter(_CODE.fullmatch, texts))


def _list_model_names(value: Any) -> list[str]:
    """Return the names in a setting of models: one, or several with commas between
    them or in a list, each perhaps with @WEIGHTS.
    """
    texts = [text for text in _to_list(value) if isinstance(text, str)]
    return [part.partition("@")[0] for text in texts for part in text.split(",")]


def _list_control_names(value: Any) -> list[object]:
    """Return what may name code in a setting of controls: their names and kinds.

    Args:
        value: a list of names, mappings or instances; or a mapping from names to
            mappings or instances.
    """
    controls = _to_list(value)
    if isinstance(value, Mapping):
        controls += value.values()
    names: list[object] = []
    for control in controls:
        if isinstance(control, str):
            names += control.split(",")
        elif isinstance(control, Mapping):
            names.append(control.get("kind"))
        else:
            names.append(getattr(control, "kind", None))
    return names


def _name_metric(metric: Any) -> Any:
    """Return the name of the code of a metric that is a function; any other as it is."""
    if callable(metric):
        return f"{metric.__module__}:{getattr(metric, '__qualname__', '')}"
    return metric


def allow_code_of_call(function: Function) -> Function:
    """Make a function allow the code that its caller names in the arguments.

    Decorate only functions that users call from Python: there the user names the code,
    and no file does.
    """
    signature = inspect.signature(function)

    @wraps(function)
    def wrapper(*args: Any, **keywords: Any) -> Any:
        # Arguments that do not fit the signature raise TypeError here; the call below
        # raises a better one.
        with suppress(TypeError):
            allow_named(signature.bind(*args, **keywords).arguments)
        return function(*args, **keywords)

    return wrapper  # type: ignore[return-value]


def _to_list(value: Any) -> list[Any]:
    """Return the items of a list, the names of a mapping, or any other value alone."""
    return list(value) if isinstance(value, (list, tuple, Mapping)) else [value]


@contextmanager
def restrict_allowed_code() -> Iterator[None]:
    """Begin the block with no code allowed; after it, only what was allowed before is."""
    before = allowed_code()
    _ALLOWED.clear()
    try:
        yield
    finally:
        _ALLOWED.clear()
        _ALLOWED.update(before)


def is_fetch_allowed(model: str) -> bool:
    """Return whether a person has named a model of a library, so that its weights may
    be fetched.
    """
    return model in _ALLOWED or model.partition("@")[0] in _ALLOWED


def explain_how_to_allow(name: str) -> str:
    """Return how a person allows what only a file names, for messages."""
    return (
        "if you trust it, allow it yourself: in Python with "
        f"advsearch.allow_code({name!r}), or with `code={name}`"
    )


def check_import(name: str) -> None:
    """Check that "package.module:attribute" may be imported.

    Raises:
        CodeNotAllowedError: only a file names it. The message says which file would be
            run, and how to allow it.
    """
    if name in _ALLOWED:
        return
    importlib.invalidate_caches()
    # Only the top package is searched for: that runs no code, while finding a module
    # inside of it would import the package.
    top_package = name.partition(":")[0].partition(".")[0]
    spec = PathFinder.find_spec(top_package, [*sys.path, os.getcwd()])
    where = f" from {spec.origin}" if spec is not None and spec.origin else ""
    raise CodeNotAllowedError(
        f"a file names {name}, Python code{where} that would be imported and run; read "
        f"it, and {explain_how_to_allow(name)}"
    )


SUBPROCESS_DIRECTORY = Path(__file__).resolve().parents[2]
"""Where processes of Python that we start begin: Python looks there for modules first,
and the folder that a user is in may be somebody else's.
"""


@contextmanager
def current_directory_importable() -> Iterator[None]:
    """Inside the block, look for modules in the current directory as well, after all
    other places.
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
