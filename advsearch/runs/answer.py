"""`artifacts/answer.npy`: the configuration that a run answers with, so that it can be rendered again elsewhere."""

from __future__ import annotations

import io
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
        found = np.load(io.BytesIO(read_bytes(path, "the answer of a run", LARGEST)), allow_pickle=False)
    except FileNotFoundError:
        raise FileFormatError(
            f"{path}: expected the answer of a run, got no such file; did the run end? One of an older version has "
            "none: do it again with advsearch run"
        ) from None
    except (OSError, ValueError, EOFError, SyntaxError) as error:
        raise FileFormatError(f"{path}: expected the answer of a run, got {str(error)[:120]}") from None
    sound = isinstance(found, np.ndarray) and found.dtype == np.float32 and found.ndim == 1
    if not sound or not bool(((found >= 0.0) & (found <= 1.0)).all()):
        raise FileFormatError(f"{path}: expected numbers (d,) float32 in [0, 1], got something else")
    return np.asarray(found)
