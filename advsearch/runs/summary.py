"""`summary.json`: the answer of a run as plain JSON (docs/design.md, "summary.json")."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from advsearch.errors import FileFormatError
from advsearch.files import parse_json, read_text
from advsearch.runs.files import write_text
from advsearch.runs.results import KEPT
from advsearch.runs.results.base import INTERRUPTED, OUT_OF_TIME, SCHEMA, Result, plain

NAME = "summary.json"

LARGEST = 64 << 20
"""Most bytes of a summary."""

_ORDER = (
    "schema",
    "command",
    "run",
    "object",
    "model",
    "environment",
    "controls",
    "policy",
    "ending",
    "image_formation",
    "clean",
    "adversarial",
    "verified",
    "baseline",
    "renders",
    "steps",
    "seconds",
    "seed",
)
"""The fields of docs/design.md, "summary.json" in their order; others follow in the order in which they were given."""


def goes_on(answer: Mapping[str, Any]) -> bool:
    """Whether a run with this summary was stopped before its end, so that it can be resumed."""
    return answer.get("ending") in (INTERRUPTED, OUT_OF_TIME)


def to_json(summary: Result | Mapping[str, Any]) -> str:
    """Return the summary as text: ``schema`` first, then the fields in the order above, then all others."""
    if not isinstance(summary, Mapping):
        return json.dumps(summary.to_dict(), indent=2, allow_nan=False, ensure_ascii=False)
    given = {"schema": SCHEMA, **summary}
    names = [name for name in _ORDER if name in given] + [name for name in given if name not in _ORDER]
    return json.dumps({name: plain(given[name]) for name in names}, indent=2, allow_nan=False, ensure_ascii=False)


def write_summary(folder: Path, summary: Result | Mapping[str, Any]) -> Path:
    """Write ``summary.json`` into the run directory, whole or not at all, and return its path.

    Raises:
        StorageError: it could not be written.
    """
    return write_text(folder / NAME, to_json(summary) + "\n")


def read_result(folder: Path) -> Result:
    """Return the result of the run in `folder`.

    Raises:
        FileFormatError: there is none (the run did not end yet), or it is not one of this version.
    """
    values = read_summary(folder)
    kind = KEPT.get(str(values.get("command")))
    if kind is None:
        raise _no_summary(folder, f"one of the command {values.get('command')!r}")
    try:
        return kind.of(values)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        what = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"[:120]
        raise _no_summary(folder, f"one with a part that is missing or of another type ({what})") from None


def _no_summary(folder: Path, got: str) -> FileFormatError:
    return FileFormatError(f"{folder / NAME}: expected the summary of a run, got {got}")


@contextmanager
def of_a_file(path: Path) -> Iterator[None]:
    """Turn what goes wrong inside the block with a summary that was read into an error that names its file.

    Summaries are plain JSON, of as many forms as there are commands; one that lacks a part shows where it is used.

    Args:
        path: of the summary, or of its folder.

    Raises:
        FileFormatError: something in the summary is missing or of another type.
    """
    try:
        yield
    except (LookupError, TypeError, AttributeError, ValueError, OverflowError) as error:
        raise FileFormatError(
            f"{path}: expected the summary of a run, got one with a part that is missing or of another type "
            f"({type(error).__name__}: {str(error)[:80]})"
        ) from error


def read_summary(folder: Path) -> dict[str, Any]:
    """Return the summary of the run in `folder`.

    Raises:
        FileFormatError: there is none (the run did not end yet), or it is not JSON.
    """
    path = folder / NAME
    try:
        summary = parse_json(read_text(path, "the summary of a run", LARGEST))
    except FileNotFoundError:
        raise FileFormatError(f"{path}: expected the summary of a run, got no such file; did the run end?") from None
    except (OSError, ValueError) as error:
        raise FileFormatError(f"{path}: expected the summary of a run, got {error}") from None
    if not isinstance(summary, dict):
        raise FileFormatError(f"{path}: expected the summary of a run, got {type(summary).__name__}")
    return summary
