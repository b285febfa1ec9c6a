"""Parse values as users write them: names, assignments, numbers and YAML files.

Values that are nested too deeply, too large or duplicate are rejected. A YAML file may
name other files in `base`, whose settings it overrides.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationInfo, field_validator

from advsearch.distributions import PythonQuantiles
from advsearch.errors import FileFormatError, InputError
from advsearch.trust.stored_files import parse_text, read_existing_text
from advsearch.trust.yaml_text import MAX_YAML_BYTES, parse_yaml

MAX_INTEGER = 2**63 - 1


def to_python(value: Any) -> Any:
    """Convert numbers and arrays of numpy and torch inside of a value to Python's.

    The value must not be nested too deeply (`is_shallow`), since this is recursive.
    """
    # The quantiles of a Python function: this mapping also has the function itself,
    # which a copy as a plain dict would lose.
    if isinstance(value, PythonQuantiles):
        return value
    if isinstance(value, Mapping):
        return {to_python(name): to_python(inner) for name, inner in value.items()}
    if isinstance(value, (list, tuple)):
        items = [to_python(item) for item in value]
        return items if isinstance(value, list) else tuple(items)
    is_array = hasattr(value, "tolist") and hasattr(value, "dtype")
    return value.tolist() if is_array else value


def to_text(value: Any, *, several: bool = False) -> Any:
    """Return a name, a path or a number as a text.

    With `several`, a list of these becomes a text with commas between them. Any other
    value is returned as it is, to be rejected later; so is an empty list.

    Raises:
        ValueError: the text is empty or contains a zero byte, or there are several
            names where one is expected.
    """
    items = value if isinstance(value, (list, tuple)) else [value]
    if not items or not all(map(_is_name_or_number, items)):
        return value
    if len(items) > 1 and not several:
        raise ValueError("several")
    text = ",".join(map(str, items))
    has_no_name = not text.strip(" ,\t\n")
    if has_no_name or "\0" in text:  # no name and no path contains a zero byte
        raise ValueError("an empty name")
    return text


def _is_name_or_number(item: object) -> bool:
    """Return whether a value is a name, a path or an integer."""
    return isinstance(item, (str, Path, int)) and not isinstance(item, bool)


def text_validator(*names: str, several: Sequence[str] = ()) -> Any:
    """Return a pydantic validator that reads settings by `to_text`.

    Args:
        names: fields with one name.
        several: fields that may have several.
    """

    def read(value: Any, info: ValidationInfo) -> Any:
        return to_text(value, several=info.field_name in several)

    return field_validator(*names, *several, mode="before")(read)


def unique_names_validator(*names: str) -> Any:
    """Return a pydantic validator that rejects settings with duplicate names.

    Args:
        names: fields of the settings, each of which may have several names.
    """

    def check(value: str | None, info: ValidationInfo) -> str | None:
        check_no_duplicates(split_names(value or ""), str(info.field_name))
        return value

    return field_validator(*names)(check)


def are_all_finite(value: Any) -> bool:
    """Return whether all numbers in a value are finite and not too large.

    Integers are at most `MAX_INTEGER` in size. The value must not be nested too deeply
    (`is_shallow`), since this is recursive.
    """
    if isinstance(value, Mapping):
        return all(are_all_finite(inner) for inner in value.values())
    if isinstance(value, (list, tuple)):
        return all(are_all_finite(inner) for inner in value)
    if isinstance(value, int):
        return abs(value) <= MAX_INTEGER
    if isinstance(value, float):
        return math.isfinite(value)
    return True  # no number


def parse_number_or_text(value: Any) -> Any:
    """Return a text that is a number as a float; any other value as it is."""
    if not isinstance(value, str):
        return value
    try:
        return float(value)
    except ValueError:
        return value


def parse_assignment(text: str, where: str) -> tuple[str, Any]:
    """Parse ``NAME=VALUE``, such as "camera.azimuth=130".

    The value is parsed as YAML; if that fails, it is plain text.

    Args:
        text: the text.
        where: setting or flag for the message, such as "--set".

    Raises:
        InputError: there is no ``=``, or the name is empty.
    """
    name, separator, value = text.partition("=")
    if not (separator and name.strip()):
        raise InputError(
            f"{where}: expected NAME=VALUE such as camera.azimuth=130, got {text!r}"
        )
    try:
        return name.strip(), parse_yaml(value) if value.strip() else ""
    except ValueError:
        return name.strip(), value.strip()


def parse_assignments(texts: Iterable[str], setting: str) -> dict[str, object]:
    """Parse texts ``NAME=VALUE`` into a mapping, as `parse_assignment`.

    Raises:
        ValueError: a text is no assignment.
        InputError: there are two values for one name; it names the setting.
    """
    texts = list(texts)
    # checked here for all of them, since `parse_assignment` raises another error
    for text in texts:
        name, equals, _ = text.partition("=")
        if not name.strip() or not equals:
            raise ValueError("not an assignment")
    pairs = [parse_assignment(text, setting) for text in texts]
    check_no_duplicates((name for name, _ in pairs), setting)
    return dict(pairs)


# The key of a choice that is for everything without a choice of its own.
FOR_ALL = "*"


def parse_choices(texts: Iterable[str], setting: str) -> dict[str, object]:
    """Parse texts ``NAME=VALUE`` into a mapping.

    A text without "=" is a value for all names, and is stored under `FOR_ALL`.

    Args:
        texts: the texts.
        setting: name of the setting, for messages.

    Raises:
        InputError: there are two values for one name.
    """
    pairs = [
        parse_assignment(text, setting) if "=" in text else (FOR_ALL, text)
        for text in texts
    ]
    check_no_duplicates((name for name, _ in pairs), setting)
    return dict(pairs)


def parse_controls(texts: Iterable[str], where: str) -> dict[str, object]:
    """Parse controls with their settings into a mapping.

    Texts are ``texture,pose``, ``texture={resolution: 64}`` or ``pose={...},x={...}``.

    Args:
        texts: texts, each with one control or with several between commas.
        where: setting or flag, for errors.

    Returns:
        Settings by control; {} for a control without settings.

    Raises:
        InputError: braces do not contain a mapping, or a control occurs twice.
    """
    controls: list[tuple[str, Any]] = []
    for text in texts:
        entries = filter(str.strip, _split_outside_brackets(text))
        controls += [_parse_control(entry, where) for entry in entries]
    check_no_duplicates((name for name, _ in controls), where)
    return dict(controls)


def _parse_control(entry: str, where: str) -> tuple[str, Any]:
    """Return the name and the settings of one control, ``NAME`` or ``NAME={...}``.

    Raises:
        InputError: braces do not contain a mapping; `where` names the setting.
    """
    if "=" not in entry:
        return entry.strip(), {}
    name, settings = parse_assignment(entry, where)
    # A value in braces that is not YAML remains a text.
    if isinstance(settings, str) and settings.startswith("{"):
        raise InputError(
            f"{where}: expected {{PARAMETER: VALUE or [LOW, HIGH], ...}} for "
            f"{name}, got {format_value(settings)}; write a colon and a space "
            "behind each parameter, close every bracket, and put a comma "
            "before the next control"
        )
    return name, settings


def _split_outside_brackets(text: str) -> list[str]:
    """Split a text at its commas, except those inside of brackets or braces.

    Brackets in quotes do not count, if the quotes are inside of brackets.
    """
    entries = [""]
    depth = 0  # how many brackets are open
    quote = ""  # the quote that is open, if any
    for char in text:
        if quote:
            if char == quote:
                quote = ""
        elif depth and char in "\"'":
            quote = char
        elif char in "{[":
            depth += 1
        elif char in "}]":
            depth -= 1
        # the depth is below 0 if there are too many closing brackets
        if char == "," and depth <= 0:
            entries.append("")
        else:
            entries[-1] += char
    return entries


def split_names(text: str) -> tuple[str, ...]:
    """Split ``mug,bowl`` into names, except for the name of a file with a comma."""
    if "," not in text or os.path.isfile(text):
        return (text,)
    return tuple(part.strip() for part in text.split(",") if part.strip())


def join_names(texts: Iterable[str]) -> str:
    """Join texts like ``mug,bowl`` into one, without duplicates of names."""
    return ",".join(dict.fromkeys(name for text in texts for name in split_names(text)))


def check_no_duplicates(names: Iterable[str], setting: str) -> None:
    """Raise InputError, which names the setting, if a name occurs twice."""
    duplicates = [name for name, count in Counter(names).items() if count > 1]
    if duplicates:
        raise InputError(
            f"{setting}: {duplicates[0]} is given twice; leave one of them out"
        )


def format_value(value: Any) -> str:
    """Format a value for an error message: plain, printable and not too long."""
    try:
        is_plain = isinstance(value, str) and value.strip() and value.isprintable()
        text = value if is_plain else repr(value)
    # nested too deeply, or an integer of thousands of digits
    except (RecursionError, ValueError):
        text = f"a {type(value).__name__} that is too long to show"
    if len(text) > 80:
        return f"{text[:77]}..."  # 80 characters with the dots
    return text


SCHEMA = 2  # version of the YAML form
CONFIG = "run.yaml"  # the file of a run that has its settings
HEADER = "# A run of advsearch. To repeat it: advsearch run FILE\n"
"""First line of every `run.yaml` that advsearch writes; a run directory is recognized
by it.
"""
MAX_BASES = 4  # maximum number of files that a `base` names, and of nested bases
# Settings that are a name, or a mapping with a `name` and options.
NAME_SETTINGS = ("policy", "task")


def read_yaml(path: str | Path, above: tuple[Path, ...] = ()) -> dict[str, object]:
    """Read the mapping in a YAML file, merged over the files that its `base` names.

    `base` is a file, relative to this one, or a list of files. A later file overrides
    the earlier ones, and this file overrides all of them.

    Args:
        path: path of the file.
        above: files that name this one as their base, directly or not. If this file is
            among them, it is a base of itself, which is an error.

    Raises:
        FileFormatError: the file is missing, not YAML, or not a mapping from names.
    """
    data = _read_settings_mapping(path)
    bases = _read_bases(path, data.pop("base", None), depth=len(above))
    resolved_path = Path(path).resolve()
    if bases and resolved_path in above:
        raise FileFormatError(
            f"{path}: base: the file is a base of itself; take it out of one of them"
        )
    result: dict[str, object] = {}
    for base in bases:
        base_path = Path(path).parent / base
        result = merge_mappings(result, read_yaml(base_path, (*above, resolved_path)))
    return merge_mappings(result, data)


def _read_settings_mapping(path: str | Path) -> dict[str, Any]:
    """Read the mapping in a YAML file, and check its schema.

    Raises:
        FileFormatError: the file is missing, not YAML, not a mapping from names, or of
            another version of advsearch.
    """
    text = read_existing_text(path, "a YAML file", MAX_YAML_BYTES)
    data = parse_text(path, text, "YAML", parse_yaml)
    if not isinstance(data, dict) or not all(isinstance(name, str) for name in data):
        got = "an empty file" if data is None else type(data).__name__
        raise FileFormatError(
            f"{path}: expected settings and values such as 'object: mug', got {got}"
        )
    if data.get("schema", SCHEMA) != SCHEMA:
        got = format_value(data["schema"])
        raise FileFormatError(
            f"{path}: expected schema {SCHEMA}, got {got}; it is of another advsearch"
        )
    return data


def _read_bases(path: str | Path, value: Any, depth: int) -> list[str]:
    """Return the files that the `base` of a file names.

    Args:
        path: path of the file, for errors.
        value: value of `base`: a file or a list of files; None or empty for no file.
        depth: number of files that name this one as their base, directly or not.

    Raises:
        FileFormatError: the value has another type, or there are too many files.
    """
    bases = value or []
    if isinstance(bases, str):
        bases = [bases]
    if not isinstance(bases, list) or not all(isinstance(base, str) for base in bases):
        raise FileFormatError(
            f"{path}: base: expected a file or a list of files, got "
            f"{format_value(bases)}"
        )
    if depth >= MAX_BASES or len(bases) > MAX_BASES:
        raise FileFormatError(
            f"{path}: base: expected at most {MAX_BASES} files, one over the other, "
            "got more"
        )
    return bases


def merge_mappings(
    base: Mapping[str, object], override: Mapping[str, object]
) -> dict[str, object]:
    """Return `base` overridden by `override`: mappings are merged, other values
    replaced.
    """
    result = dict(base)
    for name, value in override.items():
        previous = result.get(name)
        if isinstance(previous, Mapping) and isinstance(value, Mapping):
            result[name] = merge_mappings(previous, value)
        else:
            result[name] = value
    return result


def set_dotted(data: dict[str, object], name: str, value: object) -> None:
    """Set the value of a dotted name in nested mappings.

    ``controls.pose.yaw`` sets ``data["controls"]["pose"]["yaw"]``. A text or a list at
    one of these names becomes a mapping first. The text after ``set.`` or ``grid.`` is
    a single name, since names of parameters have dots themselves.

    Args:
        data: mapping of settings, which is changed in place.
        name: the dotted name.
        value: the new value.
    """
    first, _, rest = name.partition(".")
    if not rest:
        data[first] = value
        return
    inner = _to_inner_mapping(first, data.get(first))
    if first in ("set", "grid"):  # the rest is the name of a parameter
        inner[rest] = value
    else:
        set_dotted(inner, rest, value)
    data[first] = inner


def _to_inner_mapping(name: str, previous: object) -> dict[str, object]:
    """Return the value of a name as a new mapping, to which an entry can be added.

    Args:
        name: name of a setting, or of a part of it.
        previous: a text, a list or a mapping; any other value is dropped.
    """
    if isinstance(previous, str):
        # NAME is short for {name: NAME}, and CONTROL for {CONTROL: null}
        return {"name": previous} if name in NAME_SETTINGS else {previous: None}
    if isinstance(previous, list):
        return {key: None for key in previous}
    if isinstance(previous, dict):
        return dict(previous)
    return {}
