"""Settings that are a name, or a name with options: a policy, a task."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from advsearch.options import JOINED
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


def read_joined(value: Any, setting: str, otherwise: str) -> Any:
    """Return what `read_named` returns, of one or of several joined with + or in a list: the names with + between them,
    and under each name its options: ``{"name": "detection+depth", "detection": {"iou": 0.7}}``."""
    parts = re.split(r"\+(?![^{]*\})", value) if isinstance(value, str) else value
    if not isinstance(parts, (list, tuple)) or len(parts) < 2:
        return read_named(value, setting, otherwise)
    read = [read_named(one.strip() if isinstance(one, str) else one, setting, otherwise) for one in parts]
    named = [one.get("name") if isinstance(one, Mapping) else one for one in read]
    names = [name for name in named if isinstance(name, str) and name]
    if len(names) < len(read):
        return value
    options = {one["name"]: {k: v for k, v in one.items() if k != "name"} for one in read if isinstance(one, Mapping)}
    last = options.get(names[-1], {})
    if last.keys() <= set(names):  # as a command is written back: detection+depth={depth: {seek: gone}}
        options = {**options, **last} if names[-1] in last else {**options, names[-1]: {}, **last}
    return read_named({**{k: v for k, v in options.items() if v}, "name": JOINED.join(names)}, setting, otherwise)


def name_in(named: str | Mapping[str, object]) -> str:
    """Return the name in what `read_named` returns."""
    return named if isinstance(named, str) else str(named["name"])
