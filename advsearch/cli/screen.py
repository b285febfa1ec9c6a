"""Standard output and standard error as a terminal may see them.

What is printed holds names that others chose: of files, labels, objects, runs. Here is the one place where the control
characters in them, which could steer a terminal or forge a line, become readable escapes; and where a full disk behind
standard output becomes a message.
"""

from __future__ import annotations

import os
import sys
import unicodedata
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from typing import IO, Any, TextIO, cast

from advsearch.errors import StorageError

LONGEST_WORD = 300
"""Most characters of a name in a message; of a longer one the ends are shown."""


def escaped(text: str, encoding: str = "utf-8") -> str:
    """Return `text` with everything but line ends and tabs that a terminal would not show written as an escape."""
    if not text.isascii() or not text.isprintable():
        text = "".join(sign if sign in "\n\t" or _is_shown(sign) else _escape(sign) for sign in text)
    return text.encode(encoding, "backslashreplace").decode(encoding)


def shortened(text: str) -> str:
    """Return a message with the middle of its overlong words left out."""
    return " ".join(
        word if len(word) <= LONGEST_WORD else f"{word[:100]}...{word[-40:]} ({len(word):,} characters)"
        for word in text.split(" ")
    )


def _is_shown(sign: str) -> bool:
    return sign.isprintable() or (sign >= "\xa0" and unicodedata.category(sign) == "Zs")


def _escape(sign: str) -> str:
    code = ord(sign)
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"


class Screen:
    """A text stream that prints text `escaped`. All but writing is the stream's own.

    Args:
        stream: where it goes.
        needed: whether a failure to write is an error; what goes to standard error is dropped then.
    """

    def __init__(self, stream: TextIO, *, needed: bool) -> None:
        self.stream = stream
        self._needed = needed

    def write(self, text: str) -> int:
        """Write a text; errors as for `output_errors`."""
        with self._errors():
            self.stream.write(escaped(text, self.stream.encoding or "utf-8"))
        return len(text)

    def flush(self) -> None:
        """Write out what is held back; errors as for `write`."""
        with self._errors():
            self.stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)

    def _errors(self) -> AbstractContextManager[None]:
        return output_errors() if self._needed else suppress(OSError)


@contextmanager
def output_errors() -> Iterator[None]:
    """Turn what goes wrong with standard output inside the block into a message.

    Raises:
        StorageError: it could not be written, for another reason than that nobody reads any more.
        BrokenPipeError: nobody reads any more.
    """
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        raise StorageError(f"cannot write to standard output: {error.strerror or error}") from None


@contextmanager
def screens() -> Iterator[None]:
    """Let everything that is printed inside the block go through a `Screen`."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = _screen(before[0], needed=True), _screen(before[1], needed=False)
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before


def raw(stream: IO[str]) -> IO[str]:
    """Return the stream behind a `Screen`, for what draws on a terminal and escapes names itself."""
    return stream.stream if isinstance(stream, Screen) else stream


def open_descriptors() -> None:
    """Point standard streams that were closed at nothing, or the next file that is opened would be one of them."""
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free


def end_output() -> None:
    """Write out what is left; where that fails, drop it, so that the interpreter's own end does not complain."""
    try:
        sys.stdout.flush()
    except (OSError, ValueError, StorageError):
        with suppress(OSError, ValueError, AttributeError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _screen(stream: Any, *, needed: bool) -> TextIO:
    if isinstance(stream, Screen):
        return cast(TextIO, stream)
    # Python has none where the descriptor was closed.
    there: TextIO = stream if stream is not None else open(os.devnull, "w", encoding="utf-8")
    return cast(TextIO, Screen(there, needed=needed))
