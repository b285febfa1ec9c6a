"""The zip archive of a model file, checked before anything that could run or swell is made of it.

torch's own readers trust an archive. So it is opened here first: its members have distinct, plain names in one folder,
are not encrypted, and unpack to no more than a limit; a member is unpacked to no more than its stated size.
"""

from __future__ import annotations

import re
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from advsearch import files
from advsearch.errors import FileFormatError
from advsearch.models.probe import first_line

LARGEST = 16 << 30
"""Most bytes of a model file, and of what it unpacks to."""

LARGEST_TEXT = 64 << 20
"""Most bytes of a member that describes the network: JSON, source code, a pickle of names."""

LARGEST_RATIO = 20
"""Most bytes that a byte of the file may unpack to. torch itself does not compress."""

SLACK = 4 << 20
"""Bytes that a small file may unpack to, whatever the ratio."""

_NAME = re.compile(r"[\w.+ -]+(/[\w.+ -]+)*")
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


@dataclass(frozen=True, eq=False)
class Archive:
    """An open archive that has passed the checks. Made by `open_archive`.

    Args:
        path: of the file, for messages.
        zip: the open zip file.
        members: each member by its name without the root folder.
    """

    path: Path
    zip: zipfile.ZipFile
    members: Mapping[str, zipfile.ZipInfo]

    def __contains__(self, name: str) -> bool:
        return name in self.members

    def read(self, name: str, limit: int = LARGEST) -> bytes:
        """Return the content of a member.

        Raises:
            FileFormatError: there is none of that name, it is larger than `limit`, or it is damaged.
        """
        if name not in self.members:
            raise refused(self.path, f"has no {name!r}, so it is not complete")
        size = self.members[name].file_size
        if size > files.scaled(limit):
            raise files.too_large(self.path, f"{name!r} of at most {files.scaled(limit):,} bytes in it", f"{size:,}")
        try:
            return self.zip.read(self.members[name])
        except (zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError, NotImplementedError) as error:
            raise truncated(self.path, error) from None

    def read_json(self, name: str) -> Any:
        """Return the value of a member that is JSON; errors as for `read`, and where it is not JSON."""
        try:
            return files.parse_json(self.read(name, LARGEST_TEXT))
        except ValueError as error:
            raise refused(self.path, f"expected JSON in {name!r}, got {first_line(error)}") from None


def open_archive(path: Path, file: BinaryIO, size: int) -> Archive:
    """Return the archive in an open file of `size` bytes.

    Args:
        path: for messages.
        file: the archive; it stays open as long as the answer is used.
        size: bytes of the file.

    Raises:
        FileFormatError: it is damaged, unpacks to too much, or has members that torch's archives never have.
    """
    try:
        archive = zipfile.ZipFile(file)
        entries = archive.infolist()
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError) as error:
        raise truncated(path, error) from None
    _check_size(path, entries, size)
    names = [entry.filename for entry in entries]
    roots = {name.partition("/")[0] if "/" in name else "" for name in names}
    root = f"{roots.pop()}/" if len(roots) == 1 and "" not in roots else ""
    members = {entry.filename.removeprefix(root): entry for entry in entries}
    if len(members) < len(entries):
        raise refused(path, "has two members of one name")
    for name, entry in members.items():
        if not _NAME.fullmatch(name) or ".." in name.split("/"):
            raise refused(path, f"has a member of the name {name[:80]!r}")
        if entry.flag_bits & 0x1 or entry.compress_type not in _METHODS:
            raise refused(path, f"has an encrypted or strangely packed member, {name[:80]!r}")
    return Archive(path, archive, members)


def refused(path: Path, what: str) -> FileFormatError:
    """Return the error for an archive with something in it that is never loaded."""
    return FileFormatError(f"model file {path}: {what}; export a plain network with torch.export.save")


def truncated(path: Path, error: BaseException) -> FileFormatError:
    """Return the error for an archive that cannot be unpacked."""
    return FileFormatError(f"model file {path}: truncated or damaged archive ({first_line(error)})")


def _check_size(path: Path, entries: list[zipfile.ZipInfo], size: int) -> None:
    unpacked = sum(entry.file_size for entry in entries)
    if unpacked > files.scaled(LARGEST):
        limit = f"a model of at most {files.scaled(LARGEST):,} bytes unpacked"
        raise files.too_large(path, limit, f"{unpacked:,}")
    if unpacked > files.scaled(LARGEST_RATIO) * size + SLACK:
        limit = f"a model that unpacks to at most {files.scaled(LARGEST_RATIO)} times its size"
        raise files.too_large(path, limit, f"{size:,} bytes that unpack to {unpacked:,}")
