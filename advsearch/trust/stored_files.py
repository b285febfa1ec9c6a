"""Read only ordinary files of limited size, and JSON of limited depth.

The threat: a file, or a file that it names, is a device or a pipe, which may never end
or block forever; or its content would fill the memory. A device, a pipe or a socket is
rejected before any of it is read. Each reader has a limit, which users raise by an
environment variable (`FACTOR`).

Used for every file that a user names, and for every file that such a file names, by
every reader of the package.
"""

from __future__ import annotations

import json
import math
import os
import stat
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any, BinaryIO

from advsearch.errors import FileFormatError, InputError

# environment variable with the factor on all limits on the size of input
FACTOR = "ADVSEARCH_LIMITS"
DEPTH = 100  # maximum number of nested levels of JSON, including that of the scalars
DEEPEST = 16  # maximum number of nested lists and mappings in a setting
# maximum digits of an integer; longer ones cannot be converted to floating-point
# numbers
DIGITS = 300
_KINDS = (
    (stat.S_ISDIR, "a directory; name a file inside it"),
    (stat.S_ISFIFO, "a pipe; write what it yields to a file and name that"),
    (stat.S_ISSOCK, "a socket; name an ordinary file"),
    (stat.S_ISCHR, "a device; name an ordinary file"),
    (stat.S_ISBLK, "a device; name an ordinary file"),
)
_ROOT: ContextVar[str | None] = ContextVar(
    "the file that others are read for", default=None
)
_OPENED: dict[str, dict[str, None]] = {}


@contextmanager
def track_opened_files(path: Path | str) -> Iterator[None]:
    """Record each file that is opened inside the block as a part of the file `path`.

    `record_opened` records them, and `list_opened_files` lists them. Inside another
    such block, they are recorded as parts of the file of the outer block.
    """
    outer_path = _ROOT.get()
    token = _ROOT.set(outer_path or os.path.abspath(path))
    try:
        yield
    finally:
        _ROOT.reset(token)


def record_opened(path: Path | str) -> None:
    """Record that a file was read; `open_regular` does so by itself."""
    absolute_path = os.path.abspath(path)
    _OPENED.setdefault(_ROOT.get() or absolute_path, {})[absolute_path] = None


def list_opened_files(path: Path | str) -> list[str]:
    """Return the paths of the files that this process has read for a file, in order.

    These are the file itself, and the files that it names.
    """
    return list(_OPENED.get(os.path.abspath(path), {}))


def scale_limit(limit: int) -> int:
    """Multiply a limit by the environment variable `ADVSEARCH_LIMITS`.

    The limits are on the size of input (bytes, pixels, faces) and on seconds. The
    variable is 1 by default. Users who trust their input may increase it.

    Raises:
        InputError: the variable is not a number greater than 0.
    """
    text = os.environ.get(FACTOR, "") or "1"
    try:
        factor = float(text)
    except ValueError:
        factor = math.nan  # rejected below
    if not 0 < factor < math.inf:
        raise InputError(
            f"{FACTOR}: expected a number greater than 0, by which limits "
            f"are multiplied, got {text!r}"
        )
    return int(limit * factor)


def make_size_error(path: Path | str, expected: str, size: str) -> FileFormatError:
    """Return the error for input that exceeds a limit, with advice to raise the limit.

    Args:
        path: path of the input.
        expected: such as "a mesh of at most 100 faces".
        size: what it has instead, such as "120".
    """
    return FileFormatError(
        f"{path}: expected {expected}, got {size}; if you trust it, {FACTOR}=10 in the "
        "environment makes all limits ten times as large"
    )


def open_regular(path: Path, expected: str, limit: int) -> BinaryIO:
    """Open an ordinary file for reading; the caller closes it. Links are followed.

    Args:
        path: path of the file.
        expected: what it should be, for errors, such as "a label file".
        limit: how many bytes it may have, before `scale_limit`.

    Raises:
        FileFormatError: it is a directory, a pipe, a socket or a device, none of which
            is read, or it is too large.
        OSError: as for `open`: it is not there, or there is no permission.
    """
    if "\0" in str(path):
        raise FileFormatError(
            f"{path}: expected the name of a file, got one with a zero byte in it"
        )
    # The check comes before opening, since opening a device or a pipe may change it. It
    # is repeated below, since another file may have taken its place meanwhile.
    _check(path, os.stat(path), expected, limit)
    # O_NONBLOCK: opening a pipe that has taken its place would wait for a writer.
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY)
    try:
        _check(path, os.fstat(descriptor), expected, limit)
        file = os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise
    record_opened(path)
    return file


def read_bytes(path: Path, expected: str, limit: int) -> bytes:
    """Return the content of an ordinary file.

    Args:
        path: path of the file.
        expected: what it should be, for errors, such as "a label file".
        limit: how many bytes it may have, before `scale_limit`.

    Raises:
        FileFormatError: it is a directory, a pipe or a device, or is too large.
        OSError: it is missing, or there is no permission.
    """
    max_bytes = scale_limit(limit)
    with open_regular(path, expected, limit) as file:
        # One byte more than allowed is read, to notice a file that is too large after
        # all: it may have grown, and files in /proc state no size.
        data = file.read(max_bytes + 1)
    if data is None:  # no data is available yet, as in the kernel's log
        raise FileFormatError(
            f"{path}: expected {expected}, got a file that waits for something; name "
            "an ordinary file"
        )
    if len(data) > max_bytes:
        raise make_size_error(
            path, f"{expected} of at most {max_bytes:,} bytes", "more"
        )
    return data


def read_text(path: Path, expected: str, limit: int) -> str:
    """Return the text of an ordinary file in UTF-8, without a byte order mark.

    Args:
        path: path of the file.
        expected: what it should be, for errors, such as "a label file".
        limit: how many bytes it may have, before `scale_limit`.

    Raises:
        FileFormatError: it is not an ordinary file, is too large, or is not UTF-8.
        OSError: it is missing, or there is no permission.
    """
    try:
        return read_bytes(path, expected, limit).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise FileFormatError(
            f"{path}: expected {expected} in UTF-8, got bytes that are not text"
        ) from None


def read_existing_bytes(path: Path, expected: str, limit: int) -> bytes:
    """Return the content of an ordinary file, which has to exist.

    Args:
        path: path of the file.
        expected: what it should be, for errors, such as "a label file".
        limit: maximum number of bytes, before `scale_limit`.

    Raises:
        FileFormatError: it is missing, not an ordinary file, or too large.
    """
    try:
        return read_bytes(path, expected, limit)
    except OSError as error:
        raise FileFormatError(
            f"{path}: expected {expected}, got {error.strerror}; check the path"
        ) from None


def read_existing_text(path: Path | str, expected: str, limit: int) -> str:
    """Return the text of a file in UTF-8, which has to exist.

    Args:
        path: path of the file.
        expected: what it should be, for errors, such as "a label file".
        limit: how many bytes it may have, before `scale_limit`.

    Raises:
        FileFormatError: it is missing, not an ordinary file, too large, or not UTF-8.
    """
    try:
        return read_text(Path(path), expected, limit)
    except OSError as error:
        raise FileFormatError(
            f"{path}: expected {expected}, got {error.strerror}; check the path"
        ) from None


def parse_text(
    path: Path | str, text: str, kind: str, parse: Callable[[str], Any]
) -> Any:
    """Return the value that the text of a file describes.

    Args:
        path: path of the file, for errors.
        text: its content.
        kind: what it should be, for errors, such as "JSON".
        parse: returns the value of a text; raises ValueError or SyntaxError.

    Raises:
        FileFormatError: the text is not of its kind.
    """
    try:
        return parse(text)
    except (ValueError, SyntaxError) as error:  # errors of XML are SyntaxErrors
        raise FileFormatError(
            f"{path}: expected {kind}, got {error}; correct the file"
        ) from None


class JsonBoundsError(ValueError):
    """A JSON text is nested too deep, or has a number that is too long."""


def parse_json(text: str | bytes, *, finite: bool = False) -> Any:
    """Return the value of a JSON text.

    Raises:
        ValueError: it is not JSON, is nested deeper than `DEPTH`, or has a number of
            thousands of digits; with `finite` also if a number is NaN or infinite. The
            message is short.
    """
    parse_number = _parse_finite if finite else None  # None is Python's own `float`
    try:
        value = json.loads(
            text,
            parse_int=_parse_integer,
            parse_float=parse_number,
            parse_constant=parse_number,
        )
    except RecursionError:
        raise JsonBoundsError(f"lists or objects nested deeper than {DEPTH}") from None
    # Python's own recursion limit varies, so that the depth is checked as well. The
    # scalars are one of the `DEPTH` levels, so that one less is left for lists and
    # objects.
    if not is_shallow(value, DEPTH - 1):
        raise JsonBoundsError(f"lists or objects nested deeper than {DEPTH}")
    return value


def is_shallow(value: Any, levels: int = DEEPEST) -> bool:
    """Return whether lists and mappings in a value are nested at most `levels` deep.

    A value that is neither a list nor a mapping has 0 levels, a list of such values has
    1 level.
    """
    if levels < 0:
        return False
    children: Iterable[Any] = ()
    if isinstance(value, Mapping):
        children = value.values()
    elif isinstance(value, (list, tuple)):
        children = value
    return all(is_shallow(child, levels - 1) for child in children)


def _parse_integer(text: str) -> int:
    """Return an integer of JSON; raise JsonBoundsError if it has too many digits."""
    if len(text) > DIGITS:
        raise JsonBoundsError(f"a whole number of {len(text)} digits")
    return int(text)


def _parse_finite(text: str) -> float:
    """Return a number of JSON; raise ValueError if it is NaN or infinite."""
    if not math.isfinite(number := float(text)):
        raise ValueError(f"the number {text[:40]}")
    return number


def _check(path: Path, status: os.stat_result, expected: str, limit: int) -> None:
    """Check that a file is an ordinary one of at most `limit` bytes."""
    if not stat.S_ISREG(status.st_mode):
        got = next(
            (words for is_kind, words in _KINDS if is_kind(status.st_mode)),
            "something else",
        )
        raise FileFormatError(f"{path}: expected {expected}, got {got}")
    if status.st_size > scale_limit(limit):
        raise make_size_error(
            path,
            f"{expected} of at most {scale_limit(limit):,} bytes",
            f"{status.st_size:,}",
        )


# maximum bytes of a mesh, a texture or an environment, before `scale_limit`
LARGEST_FILE = 1 << 29


def check_most(
    path: Path | str, count: int, limit: int, expected: str, got: str | None = None
) -> None:
    """Check that a file does not have more of something than a limit.

    Args:
        path: path of the file.
        count: number of these things in the file.
        limit: maximum number, before `scale_limit`.
        expected: text for the error, with {} for the limit, such as "at most {} faces".
        got: text for the error about what it has instead; None for `count`.

    Raises:
        FileFormatError: the file has more than the limit.
    """
    max_count = scale_limit(limit)
    if count > max_count:
        text = f"{count:,}" if got is None else got
        raise make_size_error(path, expected.format(f"{max_count:,}"), text)
