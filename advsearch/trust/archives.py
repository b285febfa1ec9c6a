"""Check the archives of model files before torch, which trusts them, loads them.

The threat: a model file of somebody else runs code when it is unpickled or loaded,
unpacks to more than fits into the memory, or has members whose names lead out of the
archive. So members must have distinct, plain names in one folder, must not be
encrypted, and must unpack to no more than a limit. Nothing is unpickled. TorchScript is
rewritten: while torch loads it, torch runs a part of its code (`__setstate__`), which
can call operators that access files.

Used by `models/files.py` and `models/source.py`; `exported_programs.py` has further
checks of archives of `torch.export`.
"""

from __future__ import annotations

import contextlib
import io
import os
import pickle
import re
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO

import torch

from advsearch.errors import FileFormatError
from advsearch.trust.foreign_code import get_first_line
from advsearch.trust.stored_files import make_size_error, parse_json, scale_limit

MAX_ARCHIVE_BYTES = 16 << 30  # maximum bytes of a model file, packed and unpacked
# maximum bytes of a member that describes the network: JSON, source code or a pickle
LARGEST_TEXT = 64 << 20
# maximum ratio of unpacked to packed bytes; torch itself does not compress
LARGEST_RATIO = 20
SLACK = 4 << 20  # unpacked bytes that are allowed in addition, whatever the ratio
_NAME = re.compile(r"[\w.+ -]+(/[\w.+ -]+)*")
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


@dataclass(frozen=True, eq=False)
class Archive:
    """An open archive that has passed the checks; `open_archive` creates it.

    Attributes:
        path: path of the archive.
        zip: the open archive.
        members: members by name, without the root folder.
    """

    path: Path
    zip: zipfile.ZipFile
    members: Mapping[str, zipfile.ZipInfo]

    def __contains__(self, name: str) -> bool:
        return name in self.members

    def read_member(self, name: str, limit: int = MAX_ARCHIVE_BYTES) -> bytes:
        """Return the content of a member.

        Raises:
            FileFormatError: there is no member of that name, it is larger than `limit`
                bytes (before `scale_limit`), or it is corrupt.
        """
        self._check_member(name, limit)
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

    def _check_member(self, name: str, limit: int) -> None:
        """Check that there is a member of at most `limit` bytes, before `scale_limit`.

        Raises:
            FileFormatError: it is missing, or larger.
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

    def read_json(self, name: str) -> Any:
        """Return the value of a member that holds JSON.

        Raises:
            FileFormatError: the member is missing, too large, corrupt, or not JSON.
        """
        try:
            return parse_json(self.read_member(name, LARGEST_TEXT))
        except ValueError as error:
            raise make_archive_error(
                self.path, f"expected JSON in {name!r}, got {get_first_line(error)}"
            ) from None


def open_archive(path: Path, file: BinaryIO, size: int) -> Archive:
    """Check the table of contents of an archive of torch, and return the archive.

    Args:
        path: path of the archive, for errors.
        file: the open archive, which has to stay open as long as the result is used.
        size: size of the file in bytes.

    Raises:
        FileFormatError: the archive is corrupt, unpacks to too many bytes, or has
            members that torch's archives never have.
    """
    try:
        archive = zipfile.ZipFile(file)
        entries = archive.infolist()
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError) as error:
        raise make_truncation_error(path, error) from None
    _check_unpacked_size(path, sum(entry.file_size for entry in entries), size)
    members = _name_members(path, entries)
    for name, entry in members.items():
        _check_member_form(path, name, entry)
    return Archive(path, archive, members)


def _name_members(
    path: Path, entries: Sequence[zipfile.ZipInfo]
) -> dict[str, zipfile.ZipInfo]:
    """Return the members of an archive by name, without the root folder.

    torch puts all members into one folder of an arbitrary name. It is left out of the
    names, so that "resnet/data.pkl" becomes "data.pkl".

    Raises:
        FileFormatError: two members have one name.
    """
    roots = {
        entry.filename.partition("/")[0] if "/" in entry.filename else ""
        for entry in entries
    }
    root = f"{roots.pop()}/" if len(roots) == 1 and "" not in roots else ""
    members = {entry.filename.removeprefix(root): entry for entry in entries}
    if len(members) < len(entries):
        raise make_archive_error(path, "has two members of one name")
    return members


def _check_member_form(path: Path, name: str, entry: zipfile.ZipInfo) -> None:
    """Check that a member has a name and a packing that torch's archives have.

    Raises:
        FileFormatError: it has others.
    """
    if not _NAME.fullmatch(name) or ".." in name.split("/"):
        raise make_archive_error(path, f"has a member of the name {name[:80]!r}")
    is_encrypted = entry.flag_bits & 0x1
    if is_encrypted or entry.compress_type not in _METHODS:
        raise make_archive_error(
            path, f"has an encrypted or strangely packed member, {name[:80]!r}"
        )


def _check_unpacked_size(path: Path, unpacked: int, size: int) -> None:
    """Check that the members of an archive do not unpack to too many bytes.

    A small archive could otherwise fill the memory ("zip bomb").

    Args:
        path: path of the archive, for errors.
        unpacked: bytes of all members, unpacked.
        size: bytes of the archive itself.

    Raises:
        FileFormatError: they are more than the limit, or more than the largest ratio to
            the archive's size allows.
    """
    if unpacked > scale_limit(MAX_ARCHIVE_BYTES):
        raise make_size_error(
            path,
            f"a model of at most {scale_limit(MAX_ARCHIVE_BYTES):,} bytes unpacked",
            f"{unpacked:,}",
        )
    elif unpacked > scale_limit(LARGEST_RATIO) * size + SLACK:
        raise make_size_error(
            path,
            f"a model that unpacks to at most {scale_limit(LARGEST_RATIO)} times its "
            "size",
            f"{size:,} bytes that unpack to {unpacked:,}",
        )


def make_archive_error(path: Path, what: str) -> FileFormatError:
    """Return the error for an archive with a content that is never loaded."""
    return FileFormatError(
        f"model file {path}: {what}; export a plain network with torch.export.save"
    )


def make_truncation_error(path: Path, error: BaseException) -> FileFormatError:
    """Return the error for an archive that cannot be unpacked."""
    return FileFormatError(
        f"model file {path}: truncated or damaged archive ({get_first_line(error)})"
    )


LARGEST_PICKLE = 8 << 20  # maximum bytes of a pickle that describes the modules
LARGEST_CODE = 16 << 20  # maximum bytes of all source code
DEPTH = 200  # maximum nesting of modules and values
# folder of the tensors of each pickle that torch reads
FOLDER_OF_PICKLE = {"data.pkl": "data", "constants.pkl": "constants"}

_HARMFUL = re.compile(
    r"\b(save|load|from_file|load_tensor|read_file|write_file|set_data|print|debugprims|symm_mem|inductor|profiler"
    r"|c10d|_c10d_functional|dist_c10d|dist_rpc|static_runtime|_TorchScriptTesting)\b"
)
"""Pattern of the names of operators that access files, the terminal or other processes,
and of modules with such operators.
"""

# Escapes of a character by its number or name. Escapes such as "\n" do not match.
_ESCAPE = re.compile(r"\\(x[0-9a-fA-F]{1,2}|u|U|N|[0-7]{1,3})")
_NATIVE_CLASS = re.compile(r"torch\s*\.\s*classes\s*\.\s*(\w*)")
# Families of native classes ("torch.classes.FAMILY.NAME") that networks may use.
_HARMLESS_FAMILIES = frozenset(["quantized", "rnn", "mkldnn", "sparse"])
_WHITE_SPACE_CODES = frozenset((9, 10, 13))  # tab and line breaks

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
    """Copy the code, the pickles and the tensors of an archive into a new, safe one.

    `torch.jit.load` reads the new archive. Other members are left out.

    Returns:
        The new archive, and whether torch would run some of its code while loading.

    Raises:
        FileFormatError: the code calls functions that a network does not need, such as
            those for files, or the pickles name tensors whose data is missing.
    """
    code = _read_code(archive)
    # the two pickles that torch reads, and the folders of their tensors
    pickles = list(FOLDER_OF_PICKLE)
    tensor_folders = FOLDER_OF_PICKLE.values()
    for name in pickles:
        _check_pickle(archive, name)
    tensors = [
        name for name in archive.members if name.partition("/")[0] in tensor_folders
    ]
    buffer = _write_torchscript(archive, code, [*pickles, *tensors])
    # torch calls the method __setstate__ of a module while it loads it.
    runs_code = any(b"__setstate__" in content for content in code.values())
    return buffer, runs_code


def _write_torchscript(
    archive: Archive, code: Mapping[str, bytes], names: Sequence[str]
) -> io.BytesIO:
    """Return a new archive with some members of another one.

    Args:
        archive: archive to copy from.
        code: source code by member, which is written first.
        names: names of the other members.
    """
    version = _read_version(archive)
    buffer = io.BytesIO()
    writer = torch._C.PyTorchFileWriter(buffer)
    writer.set_min_version(version)
    for name in (*code, *names):
        content = code[name] if name in code else archive.read_member(name)
        writer.write_record(name, content, len(content))
    writer.write_end_of_file()
    buffer.seek(0)
    return buffer


def _read_code(archive: Archive) -> dict[str, bytes]:
    """Read and check the source code of a TorchScript archive; return it by member.

    Raises:
        FileFormatError: there is too much code, or it calls functions that a network
            does not need.
    """
    scripts = [
        name
        for name in archive.members
        if name.startswith("code/") and name.endswith(".py")
    ]
    code = {name: archive.read_member(name, LARGEST_CODE) for name in scripts}
    _check_code(archive.path, code)
    return code


def _check_code(path: Path, code: Mapping[str, bytes]) -> None:
    """Check the source code of a TorchScript archive.

    Args:
        path: path of the archive, for errors.
        code: content of the members with source code, by name.

    Raises:
        FileFormatError: there is too much code, or it calls functions that a network
            does not need.
    """
    if sum(map(len, code.values())) > LARGEST_CODE:
        raise make_archive_error(
            path, f"has more than {LARGEST_CODE:,} bytes of source code"
        )
    for name, content in code.items():
        if wrong := _find_code_problem(content):
            raise make_archive_error(
                path, f"{name!r} {wrong}, which no plain network does"
            )


def _read_version(archive: Archive) -> int:
    """Return the version of the format of a TorchScript archive.

    Raises:
        FileFormatError: the version is missing, or is not a number of 1 to 3 digits.
    """
    # torch writes the version under one of two names.
    name = "version" if "version" in archive else ".data/version"
    version = archive.read_member(name, 100).decode("ascii", "replace").strip()
    if not re.fullmatch("[0-9]{1,3}", version):
        raise make_archive_error(
            archive.path, f"expected a version number in {name!r}, got {version[:20]!r}"
        )
    return int(version)


def _find_code_problem(content: bytes) -> str:
    """Return what is wrong with source code of a TorchScript archive; "" for nothing.

    The result is a clause for a message, such as "is not text".
    """
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError:
        return "is not text"
    if found := _HARMFUL.search(text):
        return f"uses {found[0]!r}"
    # Group 1 of the pattern is the family of a native class.
    families = _NATIVE_CLASS.findall(text)
    if not _HARMLESS_FAMILIES.issuperset(families):
        return "uses native classes other than those of quantized networks"
    if _has_control_character(text) or any(
        map(_hides_character, _ESCAPE.findall(text))
    ):
        return "has text with hidden characters"
    return ""


def _has_control_character(text: str) -> bool:
    """Return whether a text has a control character other than white space."""
    return any(ord(char) < 32 and ord(char) not in _WHITE_SPACE_CODES for char in text)


def _hides_character(escape: str) -> bool:
    """Return whether an escape in source code may hide a character from a reader.

    Torch writes printable ASCII characters without escapes. So an escape of one was
    made to hide it. An escape of a control character could change the terminal. Allowed
    are octal escapes of white space, and of bytes over 127: these are parts of letters
    of other languages.

    Args:
        escape: text after the backslash as `_ESCAPE` finds it: octal digits, such as
            303, or the beginning of another escape by a number, such as x1b.
    """
    is_octal = escape.isdecimal()
    if not is_octal:
        return True
    code = int(escape, 8)
    is_ascii = code < 128
    return is_ascii and code not in _WHITE_SPACE_CODES


class _Inert:
    """A placeholder for any object that a pickle creates. It does nothing.

    With placeholders, the values in a pickle can be checked, while none of its classes
    is imported.
    """

    name = ""
    parts: list[Any]

    def __new__(cls, *parts: Any) -> _Inert:
        """Create a placeholder with the arguments of the object as its parts.

        A pickle creates objects by calling their class, or by ``cls.__new__``, which
        does not call `__init__`. Both call this method.
        """
        instance = super().__new__(cls)
        instance.parts = list(parts)
        return instance

    def __setstate__(self, state: Any) -> None:
        self.parts.append(state)


class _Unpickler(pickle._Unpickler):
    """Read a pickle without creating any object that it names.

    Every class and every function is replaced by an `_Inert`. The base class is the
    slow reader in Python, since the fast one in C allocates as much memory as a pickle
    states.

    Attributes:
        storages: references to the data of tensors.
        names: names of all classes and functions in the pickle.
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
    """Check a pickle of a TorchScript archive without importing or running anything.

    Args:
        archive: archive of the network.
        name: name of the member with the pickle.

    Raises:
        FileFormatError: the pickle is corrupt, nested too deeply, creates native
            objects, or names a tensor whose data is not complete.
    """
    reader = _Unpickler(archive.read_member(name, LARGEST_PICKLE))
    try:
        value = reader.load()
    except Exception as error:  # a corrupt pickle raises errors of many types
        raise make_archive_error(
            archive.path, f"{name!r} is damaged ({get_first_line(error)})"
        ) from None
    if any(map(_names_native_object, reader.names)):
        raise make_archive_error(
            archive.path, f"{name!r} holds native objects, which are never loaded"
        )
    _check_values(archive, name, value)
    tensor_folder = FOLDER_OF_PICKLE[name]
    for storage in reader.storages:
        _check_storage(archive, tensor_folder, storage)


def _names_native_object(text: str) -> bool:
    """Return whether a text names a native class of torch that may do harm.

    Only some families of native classes, such as those of quantized networks, are
    harmless.
    """
    families = _NATIVE_CLASS.findall(text)
    return any(family not in _HARMLESS_FAMILIES for family in families)


def _check_storage(archive: Archive, folder: str, storage: Any) -> None:
    """Check that the data of a tensor is complete.

    torch reads as many numbers as the pickle states, even beyond the end of the data.

    Args:
        archive: archive of the network.
        folder: folder of the data in the archive.
        storage: reference to the data in the pickle. torch writes it as ("storage",
            type, member, device, count of numbers).

    Raises:
        FileFormatError: the reference has another form, or there is less data.
    """
    item_type: Any = None
    member: Any = None
    count: Any = None
    if isinstance(storage, tuple) and len(storage) == 5:
        _, item_type, member, _, count = storage
    kind = getattr(item_type, "name", "")
    key = f"{folder}/{member}"
    if kind not in _ITEM_BYTES or not isinstance(count, int) or count < 0:
        raise make_archive_error(
            archive.path, f"has a tensor of another kind in {key[:80]!r}"
        )
    size = archive.members[key].file_size if key in archive else 0
    if count * _ITEM_BYTES[kind] > size:
        got = f"{key[:80]!r} has {size:,} bytes, but should hold {count:,} numbers"
        raise make_archive_error(archive.path, f"is damaged: {got}")


def _check_values(archive: Archive, name: str, value: Any) -> None:
    """Check the texts in a nested value of a pickle.

    The value is searched breadth first. Each object is checked once, however often the
    pickle refers to it, so that a small pickle cannot take long.

    Args:
        archive: archive of the pickle, for errors.
        name: name of the pickle, for errors.
        value: value of the pickle.

    Raises:
        FileFormatError: a text has hidden characters, or the nesting is deeper than
            `DEPTH`.
    """
    level = [value]  # the objects at one depth
    # All objects belong to `value`, so that none is freed and no id is used twice.
    checked_ids = {id(value)}
    for _ in range(DEPTH):
        if _has_hidden_character(level):
            raise make_archive_error(
                archive.path, f"{name!r} has text with hidden characters"
            )
        inner_values = chain.from_iterable(map(_list_inner_values, level))
        new_by_id = {
            id(inner): inner for inner in inner_values if id(inner) not in checked_ids
        }
        level = list(new_by_id.values())
        checked_ids.update(new_by_id)
        if not level:
            return
    raise make_archive_error(archive.path, f"{name!r} is nested deeper than {DEPTH}")


def _has_hidden_character(values: Iterable[object]) -> bool:
    """Return whether a text among values has a character that is not printed."""
    characters = set[str]()
    for value in values:
        if isinstance(value, str):
            characters.update(value)
    return any(
        ord(char) not in _WHITE_SPACE_CODES and not char.isprintable()
        for char in characters
    )


def _list_inner_values(value: Any) -> Iterable[Any]:
    """Return the values that are directly inside a value from a pickle."""
    if isinstance(value, dict):
        return chain(value, value.values())
    if isinstance(value, _Inert):
        return value.parts
    return value if isinstance(value, (list, tuple)) else ()


@contextlib.contextmanager
def without_unpickling() -> Iterator[None]:
    """Make `torch.load` load only tensors and plain containers inside the block.

    That holds for any caller and any arguments, since an environment variable of torch
    is set. Its old value is restored afterwards.
    """
    switch = "TORCH_FORCE_WEIGHTS_ONLY_LOAD"
    # torch loads nothing if both variables are set, so that both are removed first.
    switches = (switch, "TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD")
    before = {key: os.environ.pop(key) for key in switches if key in os.environ}
    os.environ[switch] = "1"
    try:
        yield
    finally:
        for key in switches:
            os.environ.pop(key, None)
        os.environ.update(before)
