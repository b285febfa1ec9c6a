"""Settings in YAML files, laid over the files that their `base` names."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from advsearch.errors import FileFormatError
from advsearch.files import read_text
from advsearch.settings.values import shown
from advsearch.yaml_text import LARGEST, parse_yaml

SCHEMA = 1
"""Version of the YAML form."""

HEADER = "# A run of advsearch. To repeat it: advsearch run FILE\n"
"""First line of every `run.yaml` that advsearch writes; a run directory is recognised by it."""

MOST_BASES = 4
"""Most files that a `base` names, and most that are one another's base."""

NAMED = ("policy", "task")
"""The settings that are a name, or a `name` with options."""


def read_yaml(path: str | Path, above: tuple[Path, ...] = ()) -> dict[str, object]:
    """Return the mapping in the YAML file at `path`, laid over the files that its `base` names.

    A base is a file, or a list of files of which a later one goes over an earlier one; mappings are merged.

    Args:
        path: the file.
        above: the files that have named this one as their base.

    Raises:
        FileFormatError: the file is missing, empty, not text, not YAML or not a mapping with names as keys.
    """
    try:
        data = parse_yaml(read_text(Path(path), "a YAML file", LARGEST))
    except OSError as error:
        raise FileFormatError(f"{path}: expected a YAML file, got {error.strerror}; check the path") from None
    except ValueError as error:
        raise FileFormatError(f"{path}: expected YAML, got {error}; correct the file") from None
    if not isinstance(data, dict) or not all(isinstance(name, str) for name in data):
        got = "an empty file" if data is None else type(data).__name__
        raise FileFormatError(f"{path}: expected settings and values such as 'object: mug', got {got}")
    if data.get("schema", SCHEMA) != SCHEMA:
        got = shown(data["schema"])
        raise FileFormatError(f"{path}: expected schema {SCHEMA}, got {got}; it is of another advsearch")
    return _with_base(data, Path(path), above)


def _with_base(data: dict[str, object], path: Path, above: tuple[Path, ...]) -> dict[str, object]:
    """Lay the settings over those of the files that their `base` names, relative to the file itself."""
    bases = data.pop("base", None) or []
    bases = [bases] if isinstance(bases, str) else bases
    if not isinstance(bases, list) or not all(isinstance(one, str) for one in bases):
        raise FileFormatError(f"{path}: base: expected a file or a list of files, got {shown(bases)}")
    here = path.resolve()
    if len(above) >= MOST_BASES or len(bases) > MOST_BASES:
        raise FileFormatError(f"{path}: base: expected at most {MOST_BASES} files, one over the other, got more")
    if bases and here in above:
        raise FileFormatError(f"{path}: base: the file is a base of itself; take it out of one of them")
    result: dict[str, object] = {}
    for base in bases:
        result = merged(result, read_yaml(path.parent / base, (*above, here)))
    return merged(result, data)


def merged(under: Mapping[str, object], over: Mapping[str, object]) -> dict[str, object]:
    """Return `over` laid over `under`: mappings are merged, and everything else is replaced."""
    result = dict(under)
    for name, value in over.items():
        inner = result.get(name)
        both = isinstance(inner, Mapping) and isinstance(value, Mapping)
        result[name] = merged(inner, value) if both else value  # type: ignore[arg-type]
    return result


def put(data: dict[str, object], name: str, value: object) -> None:
    """Set a dotted name in nested mappings. What follows ``set.`` is one name, since parameters have dots in theirs."""
    first, _, rest = name.partition(".")
    if not rest:
        data[first] = value
        return
    there, inner = data.get(first), dict[str, object]()
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
