"""What the libraries of networks have in common: they may be absent, and their weights may be out of reach."""

from __future__ import annotations

import contextlib
import importlib
import logging
import os
import warnings
from collections.abc import Iterator
from typing import Any

from advsearch.errors import ModelError
from advsearch.models.probe import first_line


def library(name: str, spec: str, extra: str) -> Any:
    """Return an optional library.

    Args:
        name: as it is imported.
        spec: the model that needs it, for the message.
        extra: the extra of advsearch that installs it.

    Raises:
        ModelError: it is not installed, or cannot be imported.
    """
    try:
        return importlib.import_module(name)
    except Exception as error:  # a build for another torch raises RuntimeError, among others
        command = f"pip install 'advsearch[{extra}]'"
        if isinstance(error, ModuleNotFoundError) and error.name == name:
            raise ModelError(f"model {spec}: needs {name}, which is not installed: {command}") from error
        raise ModelError(
            f"model {spec}: needs {name}, which cannot be imported here ({first_line(error)}). Install builds that fit "
            f"each other: {command}, torch's own index where that has them; or export the network with torch.export "
            f"where {name} works, and give the .pt2 file"
        ) from error


@contextlib.contextmanager
def without_unpickling() -> Iterator[None]:
    """Hold `torch.load` to tensors and plain containers, whoever calls it and whatever it asks for."""
    changed = {"TORCH_FORCE_WEIGHTS_ONLY_LOAD": "1", "TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD": None}
    before = {key: os.environ.get(key) for key in changed}
    _set_environment(changed)
    try:
        yield
    finally:
        _set_environment(before)


@contextlib.contextmanager
def reading(spec: str, advice: str) -> Iterator[None]:
    """Turn what a library raises while it fetches and reads weights into a ModelError; it never unpickles.

    Args:
        spec: the model.
        advice: what else its user may give.
    """
    disabled = logging.root.manager.disable
    logging.disable(logging.WARNING)  # of single tries to connect: an error is raised in the end
    try:
        with without_unpickling(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except ModelError:
        raise
    except Exception as error:  # a library raises nearly anything for what is not there or damaged
        raise ModelError(
            f"model {spec}: cannot be fetched or read ({first_line(error)}). Weights come from the library's cache on "
            f"this machine, else from where it publishes them; they are never unpickled. {advice}"
        ) from error
    finally:
        logging.disable(disabled)


def _set_environment(values: dict[str, str | None]) -> None:
    for key, value in values.items():
        if value is None:
            os.environ.pop(key, None)
        else:
            os.environ[key] = value
