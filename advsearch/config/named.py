"""Settings that are a name, or a name with options: a policy, a task."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from advsearch.settings import parse_assignment

FOLDERS = ("references",)
"""Options that are a folder. It is kept by its absolute path, so that a run may go on from anywhere."""


def read_named(value: Any, setting: str, otherwise: str) -> Any:
    """Return a name, or a mapping with a `name` and options, from ``NAME``, ``NAME={OPTION: VALUE}`` or such a mapping.

    Args:
        value: as it is given.
        setting: whose.
        otherwise: the name of a mapping without one.
    """
    if isinstance(value, str) and "=" in value:
        name, options = parse_assignment(value, setting)
        value = {"name": name, **(options if isinstance(options, Mapping) else {"": options})}
    if not isinstance(value, Mapping):
        return value
    options = {option: given for option, given in value.items() if option != "name"}
    for option in FOLDERS:
        given = options.get(option)
        if isinstance(given, (str, os.PathLike)) and given:
            options[option] = str(Path(given).expanduser().absolute())
    name = value.get("name", otherwise)
    return {"name": name, **options} if options else name


def name_in(named: str | Mapping[str, object]) -> str:
    """Return the name in what `read_named` returns."""
    return named if isinstance(named, str) else str(named["name"])
