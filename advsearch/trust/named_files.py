"""Read the files that a file names only if they are in its own folder or below.

This is checked after links are followed. The threat: a mesh, a scene, a layer or a
summary of somebody else may name any file on this machine, which would then be part of
an image, a page or an export. All files that a mesh names may have together no more
bytes than a single file.

Used by the importers of meshes and scenes (`scene/importing/`,
`scene/mitsuba_backend/xml_files.py`), for the mesh and the maps of a place
(`scene/places/place_file.py`) and for pictures that a result names (`viewer/pages.py`).
"""

from __future__ import annotations

import errno
import os
from pathlib import Path
from urllib.parse import unquote

from advsearch.errors import FileFormatError
from advsearch.trust import stored_files
from advsearch.trust.stored_files import LARGEST_FILE, check_most

MISSING = "is missing"
OUTSIDE = "is outside its folder and is not read"
_NO_SUCH_NAME = (errno.ENOENT, errno.ENOTDIR, errno.ENAMETOOLONG, errno.EINVAL)


def normalize_name(name: str) -> str:
    """Return a file name without quotes and percent encoding, with forward slashes."""
    return unquote(name.strip().strip('"')).replace("\\", "/")


def is_inside(path: Path | str, folder: Path | str) -> bool:
    """Return whether a path is in a folder or below, after links are followed."""
    return Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder))


def _list_spellings(name: str) -> list[str]:
    """Return the names under which a file that a mesh file names may be found.

    A mesh file may name its textures as another system or another folder did, such as
    "C:\\textures\\wood.png". The name is tried as written, then as this system writes it
    (`normalize_name`). Each of the two is tried unchanged, without a leading slash, and
    as a bare name in the folder of the mesh. The result is in the order of these six
    trials, without repeated and empty names.
    """
    spellings = [
        spelling
        for text in (name.strip(), normalize_name(name))
        for spelling in (text, text.lstrip("/"), os.path.basename(text))
    ]
    return [spelling for spelling in dict.fromkeys(spellings) if spelling]


class ReferencedFiles:
    """Read the files that a mesh file names.

    Attributes:
        refusal_by_name: why files were not read, by their normalized name
            (`normalize_name`): `MISSING`, `OUTSIDE` or another clause.
    """

    def __init__(self, path: Path) -> None:
        self.refusal_by_name: dict[str, str] = {}
        self._folder = os.path.realpath(path.parent)
        self._contents: dict[str, bytes] = {}
        self._size = 0

    def read_file(self, name: str) -> bytes:
        """Return the content of a file that a mesh file names.

        The name is tried as written, and then as other systems or folders may spell it
        (`_list_spellings`). If it is not read, `refusal_by_name` gets the reason.

        Raises:
            FileNotFoundError: the file is missing or must not be read.
        """
        content = self.read_or_explain(name)
        if isinstance(content, bytes):
            return content
        self.refusal_by_name[normalize_name(name)] = content
        raise FileNotFoundError(name)

    def read_or_explain(self, name: str) -> bytes | str:
        """Return the content of a file that a mesh file names, or why it is not read.

        All spellings of the name are tried.

        Returns:
            The content, or the reason as a text. The reason is that of the last
            spelling that was rejected; a spelling for which there is no file does not
            count. Unlike in `read_file`, it is not stored in `refusal_by_name`.
        """
        reason = MISSING
        for spelling in _list_spellings(name):
            try:
                return self._read_once(spelling)
            except ValueError:  # a zero byte in the name
                continue
            except OSError as error:
                # Other errors say more than that there is no such file.
                if error.errno not in _NO_SUCH_NAME:
                    reason = f"cannot be read ({error.strerror})"
            except FileFormatError as error:
                reason = str(error)
        return reason

    def _read_once(self, name: str) -> bytes:
        """Return the bytes of a file that another file names; each is read once.

        Raises:
            FileFormatError: it is outside of the folder, missing, no ordinary file,
                or all files together are too large.
            OSError: it cannot be read.
        """
        path = os.path.realpath(os.path.join(self._folder, name))
        if not is_inside(path, self._folder):
            raise FileFormatError(OUTSIDE if os.path.lexists(path) else MISSING)
        if path not in self._contents:
            try:
                data = self._read_within_limit(path)
            except FileFormatError as error:
                # the message becomes a clause about the name, without the path
                text = str(error).removeprefix(f"{path}: ")
                raise FileFormatError(f"is not read ({text})") from error
            self._contents[path] = data
            self._size += len(data)
        return self._contents[path]

    def _read_within_limit(self, path: str) -> bytes:
        """Return the bytes of a file.

        Raises:
            FileFormatError: it is missing, no ordinary file, or too large, alone or
                together with those that were read before.
        """
        data = stored_files.read_bytes(Path(path), "an ordinary file", LARGEST_FILE)
        total = self._size + len(data)
        check_most(path, total, LARGEST_FILE, "files of at most {} bytes in all")
        return data
