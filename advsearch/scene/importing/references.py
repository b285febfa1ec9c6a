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
from advsearch.scene.importing.files import LARGEST_FILE, text_of

Named = dict[str | None, tuple[str, str]]
"""For each material that names a texture: the file that names it, and the texture's name."""

MISSING = "is missing"
OUTSIDE = "is outside its folder and is not read"

_NO_SUCH_NAME = (errno.ENOENT, errno.ENOTDIR, errno.ENAMETOOLONG, errno.EINVAL)


def plain_name(name: str) -> str:
    """Return a file name as it is written on this system: no quotes, no percent signs, forward slashes."""
    return unquote(name.strip().strip('"')).replace("\\", "/")


class References:
    """Finds the files that a mesh file names; trimesh asks it for each. It remembers what it could not get, and why.

    Attributes:
        file_name: of the mesh file, after which trimesh names what has no name.
        refused: for each name, as `plain_name` gives it, why it was not read: `MISSING`, `OUTSIDE` or another clause.
        materials: names of the materials in the .mtl files read.
        named: the textures that these name.
    """

    def __init__(self, path: Path) -> None:
        self.file_name = path.name
        self.refused: dict[str, str] = {}
        self.materials: set[str] = set()
        self.named: Named = {}
        self._folder = os.path.realpath(path.parent)
        self._contents: dict[str, bytes] = {}

    def get(self, name: str) -> bytes:
        """Return the content of a named file; after the name as it stands, its usual distortions are tried.

        Raises:
            FileNotFoundError: it is not there, or must not be read; `refused` says which.
        """
        plain = plain_name(name)
        reason = MISSING
        for candidate in _candidates(name, plain):
            try:
                data = self._content(candidate)
            except ValueError:  # a zero byte in the name
                continue
            except OSError as error:
                reason = reason if error.errno in _NO_SUCH_NAME else f"cannot be read ({error.strerror})"
            except FileFormatError as error:
                reason = str(error)
            else:
                return self._noted(candidate, data) if candidate.lower().endswith(".mtl") else data
        self.refused[plain] = reason
        raise FileNotFoundError(name)

    __getitem__ = get

    def _content(self, name: str) -> bytes:
        """Return the content of a file in the folder.

        Raises:
            FileFormatError: it must not be read; the message is the clause that says why.
            OSError, ValueError: there is none of that name, or no permission.
        """
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

    def _noted(self, name: str, data: bytes) -> bytes:
        """Note the materials of a material file and the textures they name; return it as UTF-8."""
        current = None
        for line in text_of(data).splitlines():
            key, _, rest = line.strip().partition(" ")
            if key.lower() == "newmtl":
                current = " ".join(rest.split())
                self.materials.add(current)
            elif key.lower() == "map_kd" and current is not None and rest.strip():
                self.named[current] = (Path(name).name, rest.strip())
        return text_of(data).encode()


def _candidates(name: str, plain: str) -> list[str]:
    """Return the names to try: as it stands, plain, without options (``map_Kd -s 1 1 1 wood.png``), without folders."""
    given = (name, plain, plain.split()[-1] if plain.split() else plain)
    tried = [
        form for text in given for form in (text.strip(), text.strip().lstrip("/"), os.path.basename(text.strip()))
    ]
    return [form for form in dict.fromkeys(tried) if form]
