"""Values as users write them: names, assignments, numbers; what is too deep, too large or given twice."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from advsearch.errors import InputError
from advsearch.yaml_text import parse_yaml

DEEPEST = 16
"""Lists and mappings inside one another that a setting may have."""

LARGEST_WHOLE = 2**63 - 1


def is_shallow(value: Any, levels: int = DEEPEST) -> bool:
    """Return whether lists and mappings are nested at most so deep in `value`."""
    inner = value.values() if isinstance(value, Mapping) else value if isinstance(value, (list, tuple)) else ()
    return levels >= 0 and all(is_shallow(one, levels - 1) for one in inner)


def as_python(value: Any) -> Any:
    """Return numbers and arrays of numpy and torch in `value`, which `is_shallow`, as Python's."""
    if isinstance(value, Mapping):
        return {as_python(name): as_python(inner) for name, inner in value.items()}
    if isinstance(value, (list, tuple)):
        inner = [as_python(one) for one in value]
        return inner if isinstance(value, list) else tuple(inner)
    return value.tolist() if hasattr(value, "tolist") and hasattr(value, "dtype") else value


def as_text(value: Any, *, several: bool = False) -> Any:
    """Return what names something as a text: a path, a number, or a list of such where there may be several.

    Raises:
        ValueError: it can't be a name, or there are several where one is expected.
    """
    parts = value if isinstance(value, (list, tuple)) else [value]
    if not parts or not all(isinstance(one, (str, Path, int)) and not isinstance(one, bool) for one in parts):
        return value
    if len(parts) > 1 and not several:
        raise ValueError("several")
    text = ",".join(map(str, parts))
    if not text.strip(" ,\t\n") or "\0" in text:
        raise ValueError("an empty name")
    return text


def all_finite(value: Any) -> bool:
    """Return whether all numbers in `value`, which `is_shallow`, are finite; whole ones at most 2**63 - 1."""
    if isinstance(value, Mapping):
        return all(all_finite(inner) for inner in value.values())
    if isinstance(value, (list, tuple)):
        return all(all_finite(inner) for inner in value)
    if isinstance(value, int):
        return abs(value) <= LARGEST_WHOLE
    return not isinstance(value, float) or math.isfinite(value)


def number_or_text(value: Any) -> Any:
    if not isinstance(value, str):
        return value
    try:
        return float(value)
    except ValueError:
        return value


def parse_assignment(text: str, where: str) -> tuple[str, Any]:
    """Return the name and the value of ``NAME=VALUE``; the value is read as YAML, and as plain text where it is none.

    Args:
        text: the assignment.
        where: what the error names: ``"--set"``, say.

    Raises:
        InputError: there is no ``=``, or the name is empty.
    """
    name, separator, value = text.partition("=")
    if not (separator and name.strip()):
        raise InputError(f"{where}: expected NAME=VALUE such as camera.azimuth=130, got {text!r}")
    try:
        return name.strip(), parse_yaml(value) if value.strip() else ""
    except ValueError:
        return name.strip(), value.strip()


def split_names(text: str) -> tuple[str, ...]:
    """Return the parts of ``mug,bowl``; a file whose name has a comma is one part."""
    if "," not in text or is_file(text):
        return (text,)
    return tuple(part.strip() for part in text.split(",") if part.strip())


def is_file(name: str) -> bool:
    try:
        return Path(name).is_file()
    except OSError:  # longer than a file's name may be
        return False


def check_once(names: Iterable[str], setting: str) -> None:
    """Check that nothing is given twice.

    Raises:
        InputError: a name comes twice; the message names the setting.
    """
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise InputError(f"{setting}: {twice[0]} is given twice; leave one of them out")


def shown(value: Any) -> str:
    """Return `value` for an error message: plain, printable and not too long."""
    try:
        text = value if isinstance(value, str) and value.strip() and value.isprintable() else repr(value)
    except (RecursionError, ValueError):  # nested too deep, or a whole number of thousands of digits
        text = f"a {type(value).__name__} that is too long to show"
    return text if len(text) <= 80 else text[:77] + "..."
