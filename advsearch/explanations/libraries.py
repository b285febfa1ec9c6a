"""Libraries that only `explain` needs, imported when it runs."""

from __future__ import annotations

import importlib
from typing import Any

from advsearch.errors import InputError

PACKAGES = {"sklearn": "scikit-learn"}
"""Names on the package index, by that of a module."""


def import_library(name: str) -> Any:
    """Return a module of such a library, such as ``sklearn.tree``.

    Raises:
        InputError: it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package, command = PACKAGES[name.partition(".")[0]], "pip install 'advsearch[explain]'"
        raise InputError(f"explain needs {package}, which cannot be imported: {command}") from error
