"""Archives of model files, checked before torch, which trusts them, makes anything of
them that could run or swell.

The threat: a model file of somebody else runs code as it is unpickled or loaded,
unpacks to more than the memory holds, or has members that lead elsewhere. So members
have distinct, plain names in one folder, are not encrypted, and unpack to no more than
a limit; nothing is unpickled. TorchScript is rewritten: torch runs a part of its code
(`__setstate__`) while it loads, which can call operators that touch files.

Used by `models/files.py` and `models/source.py`; `exported_programs.py` has what
archives of `torch.export` need more.
"""

from __future__ import annotations

import contextlib
import io
import os
import pickle
import re
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO

import torch

from advsearch.errors import FileFormatError
from advsearch.trust.foreign_code import get_first_line
from advsearch.trust.stored_files import make_size_error, parse_json, scale_limit

LARGEST = 16 << 30  # bytes of a model file, and of what it unpacks to
# bytes of a member that describes the network: JSON, source code, a pickle of names
LARGEST_TEXT = 64 << 20
# bytes that a byte of the file may unpack to; torch itself does not compress
LARGEST_RATIO = 20
SLACK = 4 << 20  # bytes that a small file may unpack to, whatever the ratio
_NAME = re.compile(r"[\w.+ -]+(/[\w.+ -]+)*")
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


@dataclass(frozen=True, eq=False)
class Archive:
    """An open archive that has passed the checks, with its members by name without the
    root folder. Made by `open_archive`.
    """

    path: Path
    zip: zipfile.ZipFile
    members: Mapping[str, zipfile.ZipInfo]

    def __contains__(self, name: str) -> bool:
        return name in self.members

    def read(self, name: str, limit: int = LARGEST) -> bytes:
        """Return the content of a member.

        Raises:
            FileFormatError: there is no member of that name, it is larger than `limit`
                bytes (before `scale_limit`), or it is damaged.
        """
        if name not in self.members:
            raise make_archive_error(
                self.path, f"has no {name!r}, so it is not complete"
            )
        size = self.members[name].file_size
        if size > scale_limit(limit):
            raise make_size_error(
                self.path,
                f"{name!r} of at most {scale_limit(limit):,} bytes in it",
                f"{size:,}",
            )
        try:
            return self.zip.read(self.members[name])
        except (
            zipfile.BadZipFile,
            zlib.error,
            EOFError,
            OSError,
            RuntimeError,
            NotImplementedError,
        ) as error:
            raise make_truncation_error(self.path, error) from None

    def read_json(self, name: str) -> Any:
        """Return the value of a member that holds JSON.

        Raises:
            FileFormatError: as for `read`, or it is not JSON.
        """
        try:
            return parse_json(self.read(name, LARGEST_TEXT))
        except ValueError as error:
            raise make_archive_error(
                self.path, f"expected JSON in {name!r}, got {get_first_line(error)}"
            ) from None


def open_archive(path: Path, file: BinaryIO, size: int) -> Archive:
    """Check the table of contents of an archive of torch, and return the archive.

    Args:
        path: named in errors.
        file: the open archive, which has to stay open as long as the result is used.
        size: size of the file in bytes.

    Raises:
        FileFormatError: it is damaged, unpacks to too much, or has members that torch's
            archives never have.
    """
    try:
        archive = zipfile.ZipFile(file)
        entries = archive.infolist()
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError) as error:
        raise make_truncation_error(path, error) from None
    unpacked = sum(entry.file_size for entry in entries)
    limit = ""
    if unpacked > scale_limit(LARGEST):
        limit = f"a model of at most {scale_limit(LARGEST):,} bytes unpacked"
        got = f"{unpacked:,}"
    elif unpacked > scale_limit(LARGEST_RATIO) * size + SLACK:
        limit = f"a model that unpacks to at most {scale_limit(LARGEST_RATIO)} times its size"
        got = f"{size:,} bytes that unpack to {unpacked:,}"
    if limit:
        raise make_size_error(path, limit, got)
    # torch puts all members into one folder, whose name means nothing: it is left out
    roots = {
        entry.filename.partition("/")[0] if "/" in entry.filename else ""
        for entry in entries
    }
    root = f"{roots.pop()}/" if len(roots) == 1 and "" not in roots else ""
    members = {entry.filename.removeprefix(root): entry for entry in entries}
    if len(members) < len(entries):
        raise make_archive_error(path, "has two members of one name")
    for name, entry in members.items():
        if not _NAME.fullmatch(name) or ".." in name.split("/"):
            raise make_archive_error(path, f"has a member of the name {name[:80]!r}")
        if entry.flag_bits & 0x1 or entry.compress_type not in _METHODS:
            raise make_archive_error(
                path, f"has an encrypted or strangely packed member, {name[:80]!r}"
            )
    return Archive(path, archive, members)


def make_archive_error(path: Path, what: str) -> FileFormatError:
    """Return the error for an archive with something in it that is never loaded."""
    return FileFormatError(
        f"model file {path}: {what}; export a plain network with torch.export.save"
    )


def make_truncation_error(path: Path, error: BaseException) -> FileFormatError:
    """Return the error for an archive that cannot be unpacked."""
    return FileFormatError(
        f"model file {path}: truncated or damaged archive ({get_first_line(error)})"
    )


LARGEST_PICKLE = 8 << 20  # bytes of a pickle that describes the modules
LARGEST_CODE = 16 << 20  # bytes of source code, all files together
DEPTH = 200  # of modules and values in one another
# that torch reads, and the folder of their tensors
PICKLES = {"data.pkl": "data", "constants.pkl": "constants"}

_HARMFUL = re.compile(
    r"\b(save|load|from_file|load_tensor|read_file|write_file|set_data|print|debugprims|symm_mem|inductor|profiler"
    r"|c10d|_c10d_functional|dist_c10d|dist_rpc|static_runtime|_TorchScriptTesting)\b"
)
"""Operators that touch files, the terminal or other processes, and families of such; as
whole words anywhere.
"""

_ESCAPE = re.compile(r"\\(x[0-9a-fA-F]{1,2}|u|U|N|[0-7]{1,3})")
_CLASS = re.compile(r"torch\s*\.\s*classes\s*\.\s*(\w*)")
_CLASSES = frozenset(["quantized", "rnn", "mkldnn", "sparse"])
_WHITE = frozenset((9, 10, 13))

_ITEM_BYTES = {
    **dict.fromkeys(
        ("ByteStorage", "CharStorage", "BoolStorage", "QInt8Storage", "QUInt8Storage"),
        1,
    ),
    **dict.fromkeys(("HalfStorage", "BFloat16Storage", "ShortStorage"), 2),
    **dict.fromkeys(("FloatStorage", "IntStorage", "QInt32Storage"), 4),
    **dict.fromkeys(("DoubleStorage", "LongStorage", "ComplexFloatStorage"), 8),
    "ComplexDoubleStorage": 16,
}


def rewrite_torchscript(archive: Archive) -> tuple[io.BytesIO, bool]:
    """Copy the code, the pickles and the tensors of a checked archive into a new one
    for `torch.jit.load`.

    Returns:
        The new archive, and whether torch would run a part of its code while it loads
        it.

    Raises:
        FileFormatError: the code calls what a network has no use for, or the pickles
            state what is not there.
    """
    scripts = [
        name
        for name in archive.members
        if name.startswith("code/") and name.endswith(".py")
    ]
    code = {name: archive.read(name, LARGEST_CODE) for name in scripts}
    if sum(map(len, code.values())) > LARGEST_CODE:
        raise make_archive_error(
            archive.path, f"has more than {LARGEST_CODE:,} bytes of source code"
        )
    for name, content in code.items():
        if wrong := _find_code_problem(content):
            raise make_archive_error(
                archive.path, f"{name!r} {wrong}, which no plain network does"
            )
    for name in PICKLES:
        _check_pickle(archive, name)
    tensors = [
        name for name in archive.members if name.partition("/")[0] in PICKLES.values()
    ]
    # torch writes it under one of two names
    name = "version" if "version" in archive else ".data/version"
    version = archive.read(name, 100).decode("ascii", "replace").strip()
    if not re.fullmatch("[0-9]{1,3}", version):
        raise make_archive_error(
            archive.path, f"expected a version number in {name!r}, got {version[:20]!r}"
        )
    buffer = io.BytesIO()
    writer = torch._C.PyTorchFileWriter(buffer)
    writer.set_min_version(int(version))
    for name in (*code, *PICKLES, *tensors):
        content = code[name] if name in code else archive.read(name)
        writer.write_record(name, content, len(content))
    writer.write_end_of_file()
    buffer.seek(0)
    # torch calls a module's own __setstate__ on loading
    return buffer, any(b"__setstate__" in content for content in code.values())


def _find_code_problem(content: bytes) -> str:
    """Return what speaks against source code of a TorchScript archive, as a clause; ""
    if nothing does.
    """
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError:
        return "is not text"
    if found := _HARMFUL.search(text):
        return f"uses {found[0]!r}"
    if any(family not in _CLASSES for family in _CLASS.findall(text)):
        return "uses native classes other than those of quantized networks"
    # an escape in a text may stand for something that torch writes plainly, or that
    # steers a terminal
    escapes = _ESCAPE.findall(text)
    hidden = any(
        # digits are octal; codes below 128 are plain ASCII
        not e.isdigit() or (int(e, 8) < 128 and int(e, 8) not in _WHITE)
        for e in escapes
    )
    if hidden or any(ord(sign) < 32 and ord(sign) not in _WHITE for sign in text):
        return "has text with hidden characters"
    return ""


class _Inert:
    """Stands for whatever a pickle makes. Does nothing."""

    name = ""
    parts: list[Any]

    def __new__(cls, *parts: Any) -> _Inert:
        """Make one as `__reduce__` or as ``cls.__new__`` would; there is no
        `__init__`.
        """
        instance = super().__new__(cls)
        instance.parts = list(parts)
        return instance

    def __setstate__(self, state: Any) -> None:
        self.parts.append(state)


class _Unpickler(pickle._Unpickler):
    """Reads a pickle without making anything that it names: every class and every
    function is an `_Inert`. It is Python's own slow reader, since the fast one makes
    room for any number that a pickle gives its memory.
    """

    def __init__(self, data: bytes) -> None:
        super().__init__(io.BytesIO(data))
        self.storages: list[Any] = []
        self.names: set[str] = set()

    def find_class(self, module: str, name: str) -> Any:
        self.names.add(f"{module}.{name}")
        return type("_Named", (_Inert,), {"name": name})

    def persistent_load(self, pid: Any) -> Any:
        self.storages.append(pid)
        return _Inert()


def _check_pickle(archive: Archive, name: str) -> None:
    """Check that a pickle is nested no deeper than a network, makes no native objects,
    and names only tensors whose data is there in full.

    Nothing that it names is imported or run.
    """
    reader = _Unpickler(archive.read(name, LARGEST_PICKLE))
    try:
        value = reader.load()
    except Exception as error:  # a damaged pickle raises nearly anything
        raise make_archive_error(
            archive.path, f"{name!r} is damaged ({get_first_line(error)})"
        ) from None
    if any(
        family not in _CLASSES
        for text in reader.names
        for family in _CLASS.findall(text)
    ):
        raise make_archive_error(
            archive.path, f"{name!r} holds native objects, which are never loaded"
        )
    _check_values(archive, name, value)
    # torch reads as many numbers as are stated, be they there or not
    for storage in reader.storages:
        # torch writes ("storage", type, member, device, count of numbers)
        parts = (
            storage if isinstance(storage, tuple) and len(storage) == 5 else (None,) * 5
        )
        kind = getattr(parts[1], "name", "")
        key = f"{PICKLES[name]}/{parts[2]}"
        count = parts[4]
        if kind not in _ITEM_BYTES or not isinstance(count, int) or count < 0:
            raise make_archive_error(
                archive.path, f"has a tensor of another kind in {key[:80]!r}"
            )
        size = archive.members[key].file_size if key in archive else 0
        if count * _ITEM_BYTES[kind] > size:
            got = f"{key[:80]!r} has {size:,} bytes, but should hold {count:,} numbers"
            raise make_archive_error(archive.path, f"is damaged: {got}")


def _check_values(archive: Archive, name: str, value: Any) -> None:
    """Check the texts in a nested value, one level of nesting after the other, each
    object once.

    Raises:
        FileFormatError: a text has hidden characters, or the nesting is deeper than
            `DEPTH`.
    """
    level = [value]
    checked_ids = {id(value)}
    for _ in range(DEPTH):
        signs = {sign for item in level if isinstance(item, str) for sign in item}
        if any(ord(sign) not in _WHITE and not sign.isprintable() for sign in signs):
            raise make_archive_error(
                archive.path, f"{name!r} has text with hidden characters"
            )
        # each once: a pickle may name one part any number of times
        new = dict[int, Any]()
        for outer in level:
            inside: Iterable[Any] = ()
            if isinstance(outer, dict):
                inside = chain(outer, outer.values())
            elif isinstance(outer, (list, tuple, _Inert)):
                inside = outer.parts if isinstance(outer, _Inert) else outer
            new |= {
                id(inner): inner for inner in inside if id(inner) not in checked_ids
            }
        level = list(new.values())
        checked_ids.update(new)
        if not level:
            return
    raise make_archive_error(archive.path, f"{name!r} is nested deeper than {DEPTH}")


@contextlib.contextmanager
def without_unpickling() -> Iterator[None]:
    """Make `torch.load` inside the block load tensors and plain containers only,
    whoever calls it and whatever arguments it gets.

    It sets an environment variable of torch, and restores the old value afterwards.
    """
    switches = ("TORCH_FORCE_WEIGHTS_ONLY_LOAD", "TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD")
    # torch refuses to load where both are set
    before = {key: os.environ.pop(key) for key in switches if key in os.environ}
    os.environ[switches[0]] = "1"
    try:
        yield
    finally:
        for key in switches:
            os.environ.pop(key, None)
        os.environ.update(before)
