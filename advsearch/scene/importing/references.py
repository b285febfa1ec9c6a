"""The files that a mesh file names: materials, textures, buffers.

A mesh may come from anywhere, so it may name anything. Only ordinary files in its own folder and below are read, after
links are followed, and not more of them in all than a mesh file itself may have.
"""

from __future__ import annotations

import errno
import os
from pathlib import Path
from urllib.parse import unquote

from advsearch import files
from advsearch.errors import FileFormatError
from advsearch.scene.importing.files import LARGEST_FILE

MISSING = "is missing"
OUTSIDE = "is outside its folder and is not read"

_NO_SUCH_NAME = (errno.ENOENT, errno.ENOTDIR, errno.ENAMETOOLONG, errno.EINVAL)


def plain_name(name: str) -> str:
    """Return a file name as it is written on this system: no quotes, no percent signs, forward slashes."""
    return unquote(name.strip().strip('"')).replace("\\", "/")


class References:
    """Finds the files that a mesh file names; it remembers what it could not get, and why.

    Attributes:
        refused: for each name, as `plain_name` gives it, why it was not read: `MISSING`, `OUTSIDE` or another clause.
    """

    def __init__(self, path: Path) -> None:
        self.refused: dict[str, str] = {}
        self._folder = os.path.realpath(path.parent)
        self._contents: dict[str, bytes] = {}

    def get(self, name: str) -> bytes:
        """Return the content of a named file; after the name as it stands, its usual distortions are tried.

        Raises:
            FileNotFoundError: it is not there, or must not be read; `refused` says which.
        """
        found = self.tried(name)
        if isinstance(found, bytes):
            return found
        self.refused[plain_name(name)] = found
        raise FileNotFoundError(name)

    def tried(self, name: str) -> bytes | str:
        """Return the content of a named file, or why it is not read, which is not remembered."""
        reason = MISSING
        plain = plain_name(name)
        tried = [form for text in (name.strip(), plain) for form in (text, text.lstrip("/"), os.path.basename(text))]
        for candidate in [form for form in dict.fromkeys(tried) if form]:
            try:
                return self._content(candidate)
            except ValueError:  # a zero byte in the name
                continue
            except OSError as error:
                reason = reason if error.errno in _NO_SUCH_NAME else f"cannot be read ({error.strerror})"
            except FileFormatError as error:
                reason = str(error)
        return reason

    def _content(self, name: str) -> bytes:
        """Return the content of a file in the folder."""
        path = os.path.realpath(os.path.join(self._folder, name))
        if os.path.commonpath((path, self._folder)) != self._folder:
            raise FileFormatError(OUTSIDE if os.path.lexists(path) else MISSING)
        if path not in self._contents:
            try:
                self._keep(path, files.read_bytes(Path(path), "an ordinary file", LARGEST_FILE))
            except FileFormatError as error:
                raise FileFormatError(f"is not read ({str(error).removeprefix(f'{path}: ')})") from error
        return self._contents[path]

    def _keep(self, path: str, data: bytes) -> None:
        most, size = files.scaled(LARGEST_FILE), len(data) + sum(map(len, self._contents.values()))
        if size > most:
            raise files.too_large(path, f"files of at most {most:,} bytes in all", f"{size:,}")
        self._contents[path] = data
