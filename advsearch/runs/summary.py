"""`summary.json`: the answer of a run as plain JSON (docs/design.md, "summary.json")."""

from __future__ import annotations

import json
from pathlib import Path

from pydantic import ValidationError

from advsearch.errors import FileFormatError
from advsearch.files import parse_json, read_text
from advsearch.runs.files import write_text
from advsearch.runs.results import kind_of
from advsearch.runs.results.attack import AttackSummary
from advsearch.runs.results.base import Result

NAME = "summary.json"

LARGEST = 64 << 20
"""Most bytes of a summary."""


def to_json(result: Result) -> str:
    """Return a result as text."""
    return json.dumps(result.to_dict(), indent=2, allow_nan=False, ensure_ascii=False)


def write_summary(folder: Path, result: Result) -> Path:
    """Write ``summary.json`` into the run directory, whole or not at all, and return its path.

    Raises:
        StorageError: it could not be written.
    """
    return write_text(folder / NAME, to_json(result) + "\n")


def read_result(folder: Path) -> Result:
    """Return the result of the run in `folder`.

    Raises:
        FileFormatError: there is none (the run did not end yet), it is not JSON, or not what this version writes.
    """
    path = folder / NAME
    try:
        values = parse_json(read_text(path, "the summary of a run", LARGEST))
    except FileNotFoundError:
        raise _other(path, "no such file; did the run end?") from None
    except (OSError, ValueError) as error:
        raise _other(path, str(error)) from None
    if not isinstance(values, dict):
        raise _other(path, type(values).__name__)
    kind = kind_of(values)
    if kind is None:
        raise _other(path, f"one of the command {str(values.get('command'))[:40]!r}")
    try:
        return kind.of(values)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        what = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"[:120]
        raise _other(path, f"one with a part that is missing or of another type ({what}); run it again") from None


def attack_of(folder: Path) -> AttackSummary:
    """Return the result of the attack in `folder`; errors as for `read_result`."""
    result = read_result(folder)
    if not isinstance(result, AttackSummary):
        raise _other(folder / NAME, f"that of {result.command}")
    return result


def _other(path: Path, got: str) -> FileFormatError:
    return FileFormatError(f"{path}: expected the summary of a run, got {got}")
