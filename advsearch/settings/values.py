"""Values as users write them: names, assignments, numbers, YAML files; what is too
deep, too large or given twice.

A YAML file lies over the files that its `base` names.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationInfo, field_validator

from advsearch.distributions import OwnQuantiles
from advsearch.errors import FileFormatError, InputError
from advsearch.trust.stored_files import parsed, present_text
from advsearch.trust.yaml_text import LARGEST, parse_yaml

LARGEST_WHOLE = 2**63 - 1


def as_python(value: Any) -> Any:
    """Return numbers and arrays of numpy and torch in `value`, which `is_shallow`, as
    Python's.
    """
    if isinstance(value, OwnQuantiles):
        return value
    if isinstance(value, Mapping):
        return {as_python(name): as_python(inner) for name, inner in value.items()}
    if isinstance(value, (list, tuple)):
        inner = [as_python(part) for part in value]
        return inner if isinstance(value, list) else tuple(inner)
    return (
        value.tolist()
        if hasattr(value, "tolist") and hasattr(value, "dtype")
        else value
    )


def as_text(value: Any, *, several: bool = False) -> Any:
    """Return what names something as a text: a path, a number, or a list of such where
    there may be several. Raises ValueError where it can't be a name, or there are
    several where one is expected.
    """
    parts = value if isinstance(value, (list, tuple)) else [value]
    if not parts or not all(
        isinstance(part, (str, Path, int)) and not isinstance(part, bool)
        for part in parts
    ):
        return value
    if len(parts) > 1 and not several:
        raise ValueError("several")
    text = ",".join(map(str, parts))
    if not text.strip(" ,\t\n") or "\0" in text:
        raise ValueError("an empty name")
    return text


def texts(*names: str, several: Sequence[str] = ()) -> Any:
    """Return a validator that reads settings of these names, and those with several
    names in one, with `as_text`.
    """

    def read(value: Any, info: ValidationInfo) -> Any:
        return as_text(value, several=info.field_name in several)

    return field_validator(*names, *several, mode="before")(read)


def each_once(*names: str) -> Any:
    """Return a validator that refuses names that are given twice in settings of these
    names.
    """

    def check(value: str | None, info: ValidationInfo) -> str | None:
        check_once(split_names(value or ""), str(info.field_name))
        return value

    return field_validator(*names)(check)


def all_finite(value: Any) -> bool:
    """Return whether all numbers in `value`, which `is_shallow`, are finite; whole ones
    at most 2**63 - 1.
    """
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
    """Return the name and the value of ``NAME=VALUE``; the value is read as YAML, and
    as plain text where it is none. Raises InputError, which names `where` ("--set",
    say): there is no ``=``, or the name is empty.
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
    """Return name to value from ``NAME=VALUE`` each, as `parse_assignment`. Raises
    ValueError: a text is no assignment; InputError: a name comes twice.
    """
    texts = list(texts)
    if not all(
        name.strip() and sign
        for name, sign, _ in (text.partition("=") for text in texts)
    ):
        raise ValueError("not an assignment")
    pairs = [parse_assignment(text, setting) for text in texts]
    check_once((name for name, _ in pairs), setting)
    return dict(pairs)


FOR_ALL = "*"  # the name of a choice that is for everything that has none of its own


def parse_choices(texts: Iterable[str], setting: str) -> dict[str, object]:
    """Return what `parse_assignments` returns; a text without a name is the choice
    `FOR_ALL`, as it stands there.
    """
    pairs = [
        parse_assignment(text, setting) if "=" in text else (FOR_ALL, text)
        for text in texts
    ]
    check_once((name for name, _ in pairs), setting)
    return dict(pairs)


def read_controls(texts: Iterable[str], where: str) -> dict[str, object]:
    """Return control to settings from texts: ``texture,pose``, ``texture={resolution:
    64}``, ``pose={...},x={...}``.
    """
    controls: list[tuple[str, Any]] = []
    for part in (part for text in texts for part in _parts(text) if part.strip()):
        name, settings = (
            parse_assignment(part, where) if "=" in part else (part.strip(), {})
        )
        if isinstance(settings, str) and settings.startswith("{"):
            raise InputError(
                f"{where}: expected {{PARAMETER: VALUE or [LOW, HIGH], ...}} for "
                f"{name}, got {shown(settings)}; write "
                "a colon and a space behind each parameter, close every bracket, and "
                "put a comma before the next "
                "control"
            )
        controls.append((name, settings))
    check_once((name for name, _ in controls), where)
    return dict(controls)


def _parts(text: str) -> list[str]:
    parts = [""]
    depth = 0
    quote = ""
    for sign in text:
        if quote:
            quote = "" if sign == quote else quote
        elif depth and sign in "\"'":
            quote = sign
        else:
            depth += (sign in "{[") - (sign in "}]")
        if sign == "," and depth <= 0:
            parts.append("")
        else:
            parts[-1] += sign
    return parts


def split_names(text: str) -> tuple[str, ...]:
    """Return the parts of ``mug,bowl``; a file whose name has a comma is one part."""
    if "," not in text or os.path.isfile(text):
        return (text,)
    return tuple(part.strip() for part in text.split(",") if part.strip())


def names_together(texts: Iterable[str]) -> str:
    """Return the parts of several such texts as one, each once."""
    return ",".join(dict.fromkeys(name for text in texts for name in split_names(text)))


def check_once(names: Iterable[str], setting: str) -> None:
    """Check that nothing is given twice. Raises InputError where a name comes twice;
    the message names the setting.
    """
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise InputError(f"{setting}: {twice[0]} is given twice; leave one of them out")


def shown(value: Any) -> str:
    """Return `value` for an error message: plain, printable and not too long."""
    try:
        text = (
            value
            if isinstance(value, str) and value.strip() and value.isprintable()
            else repr(value)
        )
    except (
        RecursionError,
        ValueError,
    ):  # nested too deep, or a whole number of thousands of digits
        text = f"a {type(value).__name__} that is too long to show"
    return text if len(text) <= 80 else text[:77] + "..."


SCHEMA = 2  # version of the YAML form
CONFIG = "run.yaml"  # the file of a run that has its settings
HEADER = "# A run of advsearch. To repeat it: advsearch run FILE\n"
"""First line of every `run.yaml` that advsearch writes; a run directory is recognised
by it.
"""
MOST_BASES = 4  # most files that a `base` names, and most that are one another's base
NAMED = ("policy", "task")  # the settings that are a name, or a `name` with options


def read_yaml(path: str | Path, above: tuple[Path, ...] = ()) -> dict[str, object]:
    """Return the mapping in the YAML file at `path`, laid over the files that its
    `base` names; `above` are those that have named it as theirs. A base is a file,
    relative to this one, or a list of files of which a later one goes over an earlier
    one; mappings are merged. Raises FileFormatError: it is missing, not YAML or no
    mapping from names.
    """
    data = parsed(path, present_text(path, "a YAML file", LARGEST), "YAML", parse_yaml)
    if not isinstance(data, dict) or not all(isinstance(name, str) for name in data):
        got = "an empty file" if data is None else type(data).__name__
        raise FileFormatError(
            f"{path}: expected settings and values such as 'object: mug', got {got}"
        )
    if data.get("schema", SCHEMA) != SCHEMA:
        got = shown(data["schema"])
        raise FileFormatError(
            f"{path}: expected schema {SCHEMA}, got {got}; it is of another advsearch"
        )
    bases = data.pop("base", None) or []
    bases = [bases] if isinstance(bases, str) else bases
    if not isinstance(bases, list) or not all(isinstance(base, str) for base in bases):
        raise FileFormatError(
            f"{path}: base: expected a file or a list of files, got {shown(bases)}"
        )
    here = Path(path).resolve()
    if len(above) >= MOST_BASES or len(bases) > MOST_BASES:
        raise FileFormatError(
            f"{path}: base: expected at most {MOST_BASES} files, one "
            "over the other, got more"
        )
    if bases and here in above:
        raise FileFormatError(
            f"{path}: base: the file is a base of itself; take it out of one of them"
        )
    result: dict[str, object] = {}
    for base in bases:
        result = merged(result, read_yaml(Path(path).parent / base, (*above, here)))
    return merged(result, data)


def merged(
    under: Mapping[str, object], over: Mapping[str, object]
) -> dict[str, object]:
    """Return `over` laid over `under`: mappings are merged, and everything else is
    replaced.
    """
    result = dict(under)
    for name, value in over.items():
        inner = result.get(name)
        both = isinstance(inner, Mapping) and isinstance(value, Mapping)
        result[name] = merged(inner, value) if both else value  # type: ignore[arg-type]
    return result


def put(data: dict[str, object], name: str, value: object) -> None:
    """Set a dotted name in nested mappings. What follows ``set.`` is one name, since
    parameters have dots in theirs.
    """
    first, _, rest = name.partition(".")
    if not rest:
        data[first] = value
        return
    there = data.get(first)
    inner = dict[str, object]()
    if isinstance(there, str):
        inner = {"name": there} if first in NAMED else {there: None}
    elif isinstance(there, list):
        inner = {key: None for key in there}
    elif isinstance(there, dict):
        inner = dict(there)
    if first in ("set", "grid"):
        inner[rest] = value
    else:
        put(inner, rest, value)
    data[first] = inner
