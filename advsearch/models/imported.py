"""Models that Python code builds: ``package.module:callable``, with weights after an ``@``."""

from __future__ import annotations

import difflib
import importlib
import os
import traceback
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from torch import nn

from advsearch.errors import ModelError, UnknownNameError, resembling
from advsearch.models.model import Model
from advsearch.models.probe import first_line
from advsearch.models.source import Source, load_weights, source_of
from advsearch.registry import check_import, current_directory_importable

if TYPE_CHECKING:
    from collections.abc import Iterable


def split_weights(spec: str) -> tuple[str, Path | None]:
    """Return the part before the first ``@`` and the path after it, if there is one."""
    name, _, weights = spec.partition("@")
    return name.strip(), Path(weights.strip()) if weights.strip() else None


def load_callable(spec: str, libraries: Iterable[str] = ()) -> Source | Model:
    """Return the model behind ``package.module:callable[@weights.safetensors]``.

    The module is looked for on `sys.path` and in the current directory. The attribute is an `nn.Module`, a `Model`, or
    something that returns one when called without arguments (a function, or a class of modules).

    Args:
        spec: what is written above.
        libraries: what else may stand before the colon; a module that there is not may be one of them, misspelt.

    Raises:
        ModelError: it cannot be imported, raises, returns something else, or the weights do not fit.
        UnknownNameError: the module has no such attribute; near matches are named.
        InputError: it must not be imported (`registry.only_named_code`).
    """
    target, weights = split_weights(spec)
    check_import(target)
    module_name, _, attribute = target.partition(":")
    value: Any = _import_module(module_name, spec, libraries)
    for part in attribute.split("."):
        if not hasattr(value, part):
            known = [key for key in vars(value) if not key.startswith("_") and callable(getattr(value, key))]
            raise UnknownNameError(f"attribute of {module_name}", part, near_names(part, known))
        value = getattr(value, part)
    built = _build(value, spec)
    if isinstance(built, Model):
        if weights is not None:
            raise ModelError(
                f"model {spec}: {target} returns a ready Model, weights cannot be put into it; leave out '@...'"
            )
        return built
    if weights is not None:
        load_weights(built, weights, target)
    return source_of(built, spec)


def _import_module(name: str, spec: str, libraries: Iterable[str]) -> ModuleType:
    with current_directory_importable():
        try:
            return importlib.import_module(name)
        except ModuleNotFoundError as error:
            if error.name is not None and (name == error.name or name.startswith(error.name + ".")):
                near = resembling(name, libraries)
                meant = f"; did you mean '{near[0]}:{spec.partition(':')[2]}'?" if near else ""
                message = f"no module named {error.name!r} on the Python path or in {os.getcwd()}{meant}"
            else:
                message = f"module {name!r} needs {error.name!r}, which is not installed"
            raise ModelError(f"model {spec}: {message}") from error
        except Exception as error:  # the user's code may raise anything
            raise ModelError(f"model {spec}: importing {name!r} failed ({_where(error)})") from error


def _build(value: Any, spec: str) -> nn.Module | Model:
    made_here = not isinstance(value, (nn.Module, Model))
    if made_here:
        if not callable(value):
            raise ModelError(f"model {spec}: expected a callable or an nn.Module, got {type(value).__name__}")
        try:
            value = value()
        except Exception as error:  # the user's code may raise anything
            raise ModelError(f"model {spec}: calling it without arguments failed ({_where(error)})") from error
    if not isinstance(value, (nn.Module, Model)):
        raise ModelError(
            f"model {spec}: expected it to return an nn.Module or an advsearch Model, got {type(value).__name__}"
        )
    return value


def _where(error: BaseException) -> str:
    """Return a foreign error with the file and line that raised it."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f" at {frames[-1].filename}:{frames[-1].lineno}" if frames else ""
    return f"{first_line(error)}{place}"


def near_names(name: str, known: Iterable[str]) -> list[str]:
    """Return at most a dozen names to show, the nearest first."""
    names = sorted(known)
    return difflib.get_close_matches(name, names, n=12, cutoff=0.3) or names[:12]
