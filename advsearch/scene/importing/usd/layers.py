"""Checks of the layers and packages of an OpenUSD file, before they are composed.

A layer may only refer to layers and packages (.usdz) in or below the folder of the
first layer. A layer in a package may only refer to files in that package.
"""

from __future__ import annotations

import io
import os
import re
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from pxr import Ar, Sdf

from advsearch.extend import errors, reading, stored_files
from advsearch.scene.importing.usd import LAYER_SUFFIXES, PACKAGE_SUFFIX

MAX_LAYERS = 1000  # limit of the layers and packages of a file
MAX_ENTRIES = 10_000  # limit of the files in a package
MAX_PACKAGE_DEPTH = 4  # limit of the nesting of packages


def unpack_package(package: Path, folder: Path) -> Path:
    """Unpack a .usdz file into a folder, and return its first layer.

    Raises:
        FileFormatError: as `open_package`.
    """
    with open_package(package.name, package.read_bytes()) as archive:
        for entry in archive.infolist():
            if not entry.is_dir():
                target = folder / PurePosixPath(entry.filename)
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(archive.read(entry))
        return folder / find_first_layer(archive)


def open_package(name: str, content: bytes) -> zipfile.ZipFile:
    """Open the content of a .usdz file, whose entries are not compressed.

    Raises:
        FileFormatError: it is corrupt or too large, has compressed entries or names
            that lead outside, or its first entry is no layer.
    """
    archive = _open_archive(name, content)
    first_name = find_first_layer(archive)
    if Path(first_name).suffix.lower() not in LAYER_SUFFIXES:
        raise errors.FileFormatError(
            f"{name}: expected a USD layer first in it, got {first_name[:80]!r}"
        )
    return archive


def _open_archive(name: str, content: bytes) -> zipfile.ZipFile:
    """Open a package and check its entries, with one kind of error."""
    try:
        archive = zipfile.ZipFile(io.BytesIO(content))
        _check_entries(name, archive)
        return archive
    except (
        zipfile.BadZipFile,
        OSError,
        EOFError,
        ValueError,
        NotImplementedError,
    ) as error:
        raise errors.FileFormatError(
            f"{name}: expected a .usdz archive, got one that is damaged ({error})"
        ) from None


def _check_entries(name: str, archive: zipfile.ZipFile) -> None:
    """Check number, size, names and headers of the entries of a package.

    Names must stay inside the package, and have none of the characters with a meaning
    in USD's paths. Entries must be stored without compression.

    Args:
        name: name of the package, for messages.
        archive: the opened package.

    Raises:
        FileFormatError: one of these requirements is not met, or a limit is exceeded.
        BadZipFile: the header of an entry is corrupt.
    """
    entries = archive.infolist()
    _check_entry_totals(name, entries)
    for entry in entries:
        _check_entry(name, entry)
    for entry in entries:
        archive.open(entry).close()  # this checks local headers


def _check_entry_totals(name: str, entries: list[zipfile.ZipInfo]) -> None:
    """Raise FileFormatError if the entries of a package are too many or too large."""
    size = sum(entry.file_size for entry in entries)
    got = f"{len(entries):,} of {size:,}"
    # `check_most` scales a limit itself. It is scaled here only for the message, which
    # has both limits.
    max_files = stored_files.scale_limit(MAX_ENTRIES)
    max_bytes = stored_files.scale_limit(stored_files.LARGEST_FILE)
    expected = f"at most {max_files:,} files of {max_bytes:,} bytes in all"
    stored_files.check_most(name, len(entries), MAX_ENTRIES, expected, got)
    stored_files.check_most(name, size, stored_files.LARGEST_FILE, expected, got)


def _check_entry(name: str, entry: zipfile.ZipInfo) -> None:
    """Raise FileFormatError for an entry that `_check_entries` forbids."""
    path = PurePosixPath(entry.filename)
    is_outside = path.is_absolute() or ".." in path.parts
    has_special_characters = re.search(r"[\\:\[\]]", entry.filename)
    is_compressed = entry.compress_type != zipfile.ZIP_STORED
    is_encrypted = bool(entry.flag_bits & 1)
    if is_outside or has_special_characters or is_compressed or is_encrypted:
        raise errors.FileFormatError(
            f"{name}: expected uncompressed files inside of it, got "
            f"{entry.filename[:80]!r}, which is compressed, encrypted or outside; "
            "make it again with usdzip"
        )


def _check_without_gaps(name: str, archive: zipfile.ZipFile, content: bytes) -> None:
    """Reject a package with bytes between its files.

    USD reads files one after the other, and ignores the index of the archive. Bytes in
    a gap could be a file that USD reads and the checks do not see.
    """
    position = 0
    for entry in sorted(archive.infolist(), key=lambda entry: entry.header_offset):
        if entry.header_offset != position:
            raise errors.FileFormatError(
                f"{name}: expected a .usdz archive with one file after the other, got "
                "bytes in between; make it again with usdzip"
            )
        # A local header has 30 bytes. Bytes 26 to 29 are the lengths of the name and of
        # the extra field, which follow the header.
        lengths = content[entry.header_offset + 26 : entry.header_offset + 30]
        name_size = int.from_bytes(lengths[:2], "little")
        extra_size = int.from_bytes(lengths[2:], "little")
        header_size = 30 + name_size + extra_size
        position = entry.header_offset + header_size + entry.file_size


def find_first_layer(archive: zipfile.ZipFile) -> str:
    """Return the name of the first file in a package, which is its layer, or ""."""
    for entry in archive.infolist():
        if not entry.is_dir():
            return entry.filename
    return ""


def read_packaged(path: str) -> bytes:
    """Return a file by its path in packages, as in ``/folder/a.usdz[b.usdz[c.png]]``.

    Raises:
        FileFormatError: as `open_package`.
        KeyError: there is no such file.
    """
    outer, inner = Ar.SplitPackageRelativePathOuter(path)
    content = stored_files.read_bytes(
        Path(outer), "a package", stored_files.LARGEST_FILE
    )
    while inner:
        name, inner = Ar.SplitPackageRelativePathOuter(inner)
        with open_package(Path(outer).name, content) as archive:
            content = archive.read(name)
        outer = name
    return content


def list_layer_files(file: Path) -> list[str]:
    """Return the files of all layers and packages that a file needs, itself first.

    Raises:
        FileFormatError: one of them is corrupt, refers to files outside of the folder,
            or is over a limit.
    """
    return [str(path) for path in _LayerCheck(file).run()]


@dataclass
class _LayerCheck:
    """Checks the layers and packages that a file needs.

    Attributes:
        file: the first layer or package.
    """

    file: Path
    _size: int = 0  # bytes of the files checked so far
    _count: int = 0  # layers and packages checked so far
    _folder: Path = field(init=False)

    def __post_init__(self) -> None:
        self._folder = self.file.parent.resolve()

    def run(self) -> list[Path]:
        """Return the files of all layers and packages, the file itself first.

        The layers to which a layer refers are checked in turn. A package is checked
        with all layers and packages in it.

        Raises:
            FileFormatError: a file is corrupt, refers to files outside of the folder,
                or is over a limit.
        """
        pending = [self.file.resolve()]
        checked_files = dict[Path, None]()
        while pending:
            path = pending.pop()
            if path in checked_files:
                continue
            checked_files[path] = None
            pending.extend(self._check_file(path))
        return list(checked_files)

    def _check_file(self, path: Path) -> list[Path]:
        """Check a layer, or a package with all in it, and return what a layer refers to."""
        self._count_layer(path.stat().st_size)
        if path.suffix.lower() == PACKAGE_SUFFIX:
            content = stored_files.read_bytes(
                path, "a package", stored_files.LARGEST_FILE
            )
            self._check_package(path.name, str(path), content, depth=1)
            return []
        return [
            self._find_layer(path, name)
            for name in self._iterate_named_layers(str(path), path.name)
        ]

    def _count_layer(self, size: int) -> None:
        """Add a layer or package to the totals, and check their limits.

        Args:
            size: its bytes; 0 in a package, whose bytes are counted already.
        """
        self._count += 1
        self._size += size
        max_layers = stored_files.scale_limit(MAX_LAYERS)
        max_bytes = stored_files.scale_limit(stored_files.LARGEST_FILE)
        expected = f"at most {max_layers:,} layers of {max_bytes:,} bytes in all"
        got = "more"
        stored_files.check_most(self.file.name, self._count, MAX_LAYERS, expected, got)
        stored_files.check_most(
            self.file.name, self._size, stored_files.LARGEST_FILE, expected, got
        )

    def _find_layer(self, path: Path, name: str) -> Path:
        """Return the file to which a layer refers.

        For a file in a package that is the package, all of which is checked.

        Args:
            path: the layer, to which the name is relative.
            name: the name in the layer, such as "parts/wheel.usd" or
                "car.usdz[wheel.usd]".

        Raises:
            FileFormatError: it is missing, or not in the folder.
        """
        outer, inner = Ar.SplitPackageRelativePathOuter(name)
        layer_file = None
        if _is_layer_name(outer, inner):
            layer_file = Path(os.path.realpath(path.parent / outer))
        if layer_file is None or not reading.is_inside(layer_file, self._folder):
            raise self._make_unread_layer_error(name)
        if not layer_file.is_file():
            raise errors.FileFormatError(
                f"{self.file.name}: needs {name[:100]!r}, which is missing; put that "
                "file beside it"
            )
        if inner:
            self._check_packaged_file(layer_file, inner, name)
        return layer_file

    def _make_unread_layer_error(self, name: str) -> errors.FileFormatError:
        """Return the error for a named layer that is no USD file in the folder."""
        return errors.FileFormatError(
            f"{self.file.name}: names the layer {name[:100]!r}, which is no USD "
            "file in its folder and is not read; put it there, or make one file of "
            "all with usdcat --flatten"
        )

    def _check_packaged_file(self, package: Path, inner: str, name: str) -> None:
        """Raise FileFormatError if a package does not have the file `inner`.

        `name` is the name of both in the layer that refers to them.
        """
        try:
            read_packaged(Ar.JoinPackageRelativePath(str(package), inner))
        except KeyError:
            raise errors.FileFormatError(
                f"{self.file.name}: needs {name[:100]!r}, which is not in "
                f"{package.name}; make the package again"
            ) from None

    def _check_package(self, name: str, path: str, content: bytes, depth: int) -> None:
        """Check all layers in a package.

        Args:
            name: the package, for messages.
            path: its path as USD writes it.
            content: its bytes.
            depth: 1 for a package in a folder, 2 for a package in a package, and so on.
        """
        self._check_depth(depth)
        with open_package(name, content) as archive:
            _check_without_gaps(name, archive, content)
            entries = {
                entry.filename for entry in archive.infolist() if not entry.is_dir()
            }
            for entry in sorted(entries):
                suffix = Path(entry).suffix.lower()
                inner_path = Ar.JoinPackageRelativePath(path, entry)
                # The bytes of an entry were counted with the outermost package.
                if suffix == PACKAGE_SUFFIX:
                    self._count_layer(size=0)
                    label = f"{name}[{entry}]"
                    inner_content = archive.read(entry)
                    self._check_package(label, inner_path, inner_content, depth + 1)
                elif suffix in LAYER_SUFFIXES:
                    self._count_layer(size=0)
                    self._check_packaged_layer(name, inner_path, entry, entries)

    def _check_depth(self, depth: int) -> None:
        """Raise FileFormatError if packages are nested more than `MAX_PACKAGE_DEPTH`."""
        stored_files.check_most(
            self.file.name,
            depth,
            MAX_PACKAGE_DEPTH,
            "packages nested at most {} deep",
            "more",
        )

    def _check_packaged_layer(
        self, package: str, path: str, entry: str, entries: set[str]
    ) -> None:
        """Check a layer in a package, and the layers to which it refers.

        Args:
            package: name of the package, for messages.
            path: the layer as USD writes it, with the package.
            entry: path of the layer in the package.
            entries: all paths in the package.
        """
        label = f"{package}[{reading.format_name(entry, quoted=False)}]"
        for layer in self._iterate_named_layers(path, label):
            self._check_packaged(package, entry, layer, entries)

    def _check_packaged(
        self, package: str, entry: str, layer: str, entries: set[str]
    ) -> None:
        """Raise FileFormatError if a layer in a package refers to one outside of it.

        Args:
            package: name of the package, for messages.
            entry: path of the layer in the package.
            layer: path to which it refers.
            entries: all paths in the package.
        """
        outer, _ = Ar.SplitPackageRelativePathOuter(layer)
        from_entry = os.path.normpath(PurePosixPath(entry).parent / outer)
        # A path that does not begin with a dot may be relative to the package.
        from_root = os.path.normpath(outer)
        may_be_from_root = not outer.startswith(".")
        is_inside = from_entry in entries or (may_be_from_root and from_root in entries)
        suffix = Path(outer).suffix.lower()
        if not is_inside or suffix not in (*LAYER_SUFFIXES, PACKAGE_SUFFIX):
            raise errors.FileFormatError(
                f"{self.file.name}: {package} names the layer {layer[:100]!r}, which "
                "is no USD file in that package and is not read; make the package again "
                "with usdzip, or one file of all with usdcat --flatten"
            )

    def _iterate_named_layers(self, path: str, name: str) -> Iterator[str]:
        """Yield the layers to which a layer refers.

        After the last one, value clips (animation in other files, to which
        `GetCompositionAssetDependencies` does not refer) are rejected.
        """
        layer = _open_layer(path, name)
        yield from filter(None, layer.GetCompositionAssetDependencies())
        layer.Traverse(
            Sdf.Path.absoluteRootPath,
            lambda spec_path: self._check_clips(layer, spec_path),
        )

    def _check_clips(self, layer: Any, spec_path: Any) -> None:
        """Raise FileFormatError if a prim of a layer has value clips."""
        if not spec_path.IsPrimPath():
            return
        spec = layer.GetObjectAtPath(spec_path)
        if spec is not None and "clips" in spec.ListInfoKeys():
            raise errors.FileFormatError(
                f"{self.file.name}: has value clips ({spec_path}), which are not "
                "read; make one file of all with usdcat --flatten"
            )


def _is_layer_name(outer: str, inner: str) -> bool:
    """Return whether a layer may have a name: a file, and a path in it if a package.

    In USD's paths a backtick begins an expression, brackets enclose a path in a
    package, and a colon follows a scheme or precedes arguments.
    """
    suffix = Path(outer).suffix.lower()
    has_special_characters = any(character in outer for character in "`[]:\0")
    is_layer = suffix == PACKAGE_SUFFIX or (suffix in LAYER_SUFFIXES and not inner)
    return is_layer and not has_special_characters


def _open_layer(path: str, name: str) -> Any:
    """Return the `Sdf.Layer` of a path; raise FileFormatError, with a name, if none is.

    The path may be that of a file in a package.
    """
    try:
        layer = Sdf.Layer.FindOrOpen(path)
    except Exception as error:  # Tf.ErrorException, of which there are many kinds
        raise errors.FileFormatError(
            f"{name}: expected a USD layer, got {format_error(error)}"
        ) from None
    if layer is None:
        raise errors.FileFormatError(
            f"{name}: expected a USD layer, got none that can be read"
        )
    return layer


def format_error(error: Exception) -> str:
    """Return the message of an error of usd-core in one line.

    It is the last text with a position ("12:5: ..."), or else the last text after a
    colon and an opening quotation mark, or else the last line of more than three
    characters. All are cut to 200 characters.
    """
    text = str(error)
    texts_with_position = re.findall(r":(\d+:\d+: .+)", text)
    quoted_texts = re.findall(r" : '(.+)", text)
    # Shorter lines are separators.
    long_lines = [line.strip() for line in text.splitlines() if len(line.strip()) > 3]
    candidates = texts_with_position or quoted_texts or long_lines
    message: str = candidates[-1] if candidates else type(error).__name__
    return message[:200]
