"""The answer of a run: `summary.json` as plain JSON (docs/answers.md), and `artifacts/answer.npy`.

The latter is the configuration that a run answers with, so that it can be rendered again elsewhere.
"""

from __future__ import annotations

import io
import json
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from advsearch.errors import FileFormatError
from advsearch.files import parse_json, read_bytes, read_text
from advsearch.runs.files import write_bytes, write_text
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


ANSWER = "answer.npy"
FOLDER = "artifacts"

LARGEST_ANSWER = 1 << 30
"""Most bytes of one."""

MAGIC = b"\x93NUMPY\x01\x00"
"""How a file of numpy's begins, of version 1.0."""
MOST = 1 << 10
"""Bytes within which a header ends."""
HEADER = re.compile(
    re.escape(MAGIC) + rb"..\{'descr': '<f4', 'fortran_order': False, 'shape': \((\d{1,12}),\), \} *\n", re.DOTALL
)
"""What is before the numbers. numpy's own reader makes room for whatever shape is named, and parses the header as
Python, which ends in errors of any kind."""


def write_answer(run: Path, u: NDArray[np.float32]) -> Path:
    """Keep a configuration (d,) of the unit box, whole or not at all, and return where.

    Raises:
        StorageError: it could not be written.
    """
    buffer = io.BytesIO()
    np.save(buffer, np.ascontiguousarray(u, dtype=np.float32), allow_pickle=False)
    return write_bytes(run / FOLDER / ANSWER, buffer.getvalue())


def read_answer(run: Path) -> NDArray[np.float32]:
    """Return the configuration (d,) float32 in [0, 1] that a run answers with.

    Raises:
        FileFormatError: there is none (the run did not end, or is of an older version), or it is something else.
    """
    path = run / FOLDER / ANSWER
    try:
        data = read_bytes(path, "the answer of a run", LARGEST_ANSWER)
    except FileNotFoundError:
        raise FileFormatError(
            f"{path}: expected the answer of a run, got no such file; did the run end? One of an older version has "
            "none: do it again with advsearch run"
        ) from None
    except OSError as error:
        raise FileFormatError(f"{path}: expected the answer of a run, got {str(error)[:120]}") from None
    if not data.startswith(MAGIC) or b"\n" not in data[: len(MAGIC) + MOST]:
        raise FileFormatError(f"{path}: expected the answer of a run, got something else, or the beginning of one")
    header = HEADER.match(data)
    count = -1 if header is None else int(header[1])
    if header is None or len(data) != header.end() + 4 * count:
        raise _no_point(path)
    found: NDArray[np.float32] = np.frombuffer(data, np.float32, count, header.end()).copy()
    if not bool(((found >= 0.0) & (found <= 1.0)).all()):
        raise _no_point(path)
    return found


def _no_point(path: Path) -> FileFormatError:
    return FileFormatError(f"{path}: expected numbers (d,) float32 in [0, 1], got something else")
