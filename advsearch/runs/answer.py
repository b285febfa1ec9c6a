"""`artifacts/answer.npy`: the configuration that a run answers with, so that it can be rendered again elsewhere."""

from __future__ import annotations

import io
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from advsearch.errors import FileFormatError
from advsearch.files import read_bytes
from advsearch.runs.files import write_bytes

NAME = "answer.npy"
FOLDER = "artifacts"

LARGEST = 1 << 30
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
    return write_bytes(run / FOLDER / NAME, buffer.getvalue())


def read_answer(run: Path) -> NDArray[np.float32]:
    """Return the configuration (d,) float32 in [0, 1] that a run answers with.

    Raises:
        FileFormatError: there is none (the run did not end, or is of an older version), or it is something else.
    """
    path = run / FOLDER / NAME
    try:
        data = read_bytes(path, "the answer of a run", LARGEST)
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
