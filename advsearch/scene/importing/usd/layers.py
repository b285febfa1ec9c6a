"""The layers and packages of OpenUSD that a file is made of, looked at before anything
is composed of them.

All that a layer names has to be a layer or a package (.usdz) in the folder of the first
one or below; all that a layer in a package names has to be in that package.
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
from advsearch.scene.importing.usd import LAYERS, PACKAGE

MOST_LAYERS = 1000
MOST_ENTRIES = 10_000
DEEPEST_PACKAGE = 4  # packages in one another


def unpacked(package: Path, folder: Path) -> Path:
    """Unpack a .usdz file into a folder, and return its first layer.

    Raises FileFormatError: as `open_package`.
    """
    with open_package(package.name, package.read_bytes()) as archive:
        for entry in archive.infolist():
            if not entry.is_dir():
                goal = folder / PurePosixPath(entry.filename)
                goal.parent.mkdir(parents=True, exist_ok=True)
                goal.write_bytes(archive.read(entry))
        return folder / first_layer(archive)


def open_package(name: str, content: bytes) -> zipfile.ZipFile:
    """Open the content of a .usdz file, whose entries lie in it as they are.

    Raises FileFormatError: it is damaged, too large, has packed entries or names that
    lie elsewhere, or begins with no layer.
    """
    try:
        archive = zipfile.ZipFile(io.BytesIO(content))
        entries = archive.infolist()
        size = sum(entry.file_size for entry in entries)
        got = f"{len(entries):,} of {size:,}"
        max_files, max_bytes = map(
            stored_files.scaled, (MOST_ENTRIES, stored_files.LARGEST_FILE)
        )
        most = f"at most {max_files:,} files of {max_bytes:,} bytes in all"
        stored_files.check_most(name, len(entries), MOST_ENTRIES, most, got)
        stored_files.check_most(name, size, stored_files.LARGEST_FILE, most, got)
        for entry in entries:
            place = PurePosixPath(entry.filename)
            odd = (
                place.is_absolute()
                or ".." in place.parts
                or re.search(r"[\\:\[\]]", entry.filename)
            )
            if odd or entry.compress_type != zipfile.ZIP_STORED or entry.flag_bits & 1:
                raise errors.FileFormatError(
                    f"{name}: expected files that lie in it as they are, got "
                    f"{entry.filename[:80]!r}, "
                    "which is packed or lies elsewhere; make it again with usdzip"
                )
        for entry in entries:
            archive.open(entry).close()  # local headers are there
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
    first = first_layer(archive)
    if Path(first).suffix.lower() not in LAYERS:
        raise errors.FileFormatError(
            f"{name}: expected a USD layer first in it, got {first[:80]!r}"
        )
    return archive


def _check_without_gaps(name: str, archive: zipfile.ZipFile, content: bytes) -> None:
    """Refuse a package with bytes between its files: USD reads those in a row, and not
    by the index.
    """
    position = 0
    for entry in sorted(archive.infolist(), key=lambda entry: entry.header_offset):
        lengths = content[entry.header_offset + 26 : entry.header_offset + 30]
        header_size = (
            30
            + int.from_bytes(lengths[:2], "little")
            + int.from_bytes(lengths[2:], "little")
        )
        if entry.header_offset != position:
            raise errors.FileFormatError(
                f"{name}: expected a .usdz archive with one file after the other, got "
                "bytes in between; "
                "make it again with usdzip"
            )
        position = entry.header_offset + header_size + entry.file_size


def first_layer(archive: zipfile.ZipFile) -> str:
    """Return the name of the first file in a package, which is its layer."""
    return next(
        (entry.filename for entry in archive.infolist() if not entry.is_dir()), ""
    )


def read_packaged(path: str) -> bytes:
    """Return a file by its path in packages, as in ``/folder/a.usdz[b.usdz[c.png]]``.

    Raises FileFormatError: as `open_package`. Raises KeyError: there is no such file.
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


def check_layers(file: Path) -> list[str]:
    """Return the files of all layers and packages that a file is made of, itself first.

    Raises FileFormatError: one of them is damaged, names what lies elsewhere, or is
    over a limit.
    """
    return [str(path) for path in _LayerCheck(file).run()]


@dataclass
class _LayerCheck:
    file: Path
    _size: int = 0
    _count: int = 0
    _folder: Path = field(init=False)

    def __post_init__(self) -> None:
        self._folder = self.file.parent.resolve()

    def run(self) -> list[Path]:
        waiting = [self.file.resolve()]
        known = dict[Path, None]()
        while waiting:
            path = waiting.pop()
            if path in known:
                continue
            known[path] = None
            self._take(path.stat().st_size)
            if path.suffix.lower() == PACKAGE:
                content = stored_files.read_bytes(
                    path, "a package", stored_files.LARGEST_FILE
                )
                self._check_package(path.name, str(path), content, depth=1)
                continue
            for name in self._named_in(str(path), path.name):
                waiting.append(self._find(path, name))
        return list(known)

    def _take(self, size: int) -> None:
        """Count a layer of a size in bytes against the limits."""
        self._count += 1
        self._size += size
        most = f"at most {stored_files.scaled(MOST_LAYERS):,} layers"
        stored_files.check_most(
            self.file.name, self._count, MOST_LAYERS, most, "more, or larger ones"
        )
        stored_files.check_most(
            self.file.name,
            self._size,
            stored_files.LARGEST_FILE,
            most,
            "more, or larger ones",
        )

    def _find(self, path: Path, name: str) -> Path:
        """Return the file that a layer names, of a file in a package the package."""
        outer, inner = Ar.SplitPackageRelativePathOuter(name)
        suffix = Path(outer).suffix.lower()
        is_plain = not any(sign in outer for sign in "`[]:\0") and suffix in (
            *LAYERS,
            PACKAGE,
        )
        is_plain = is_plain and (not inner or suffix == PACKAGE)
        target = (
            Path(os.path.realpath(path.parent / outer)) if is_plain else self._folder
        )
        if not is_plain or not reading.is_inside(target, self._folder):
            raise errors.FileFormatError(
                f"{self.file.name}: names the layer {name[:100]!r}, which is no USD "
                "file in its folder and is not "
                "read; put it there, or make one file of all with usdcat --flatten"
            )
        if not target.is_file():
            raise errors.FileFormatError(
                f"{self.file.name}: needs {name[:100]!r}, which is missing; put that "
                "file beside it"
            )
        if inner:
            try:
                read_packaged(Ar.JoinPackageRelativePath(str(target), inner))
            except KeyError:
                raise errors.FileFormatError(
                    f"{self.file.name}: needs {name[:100]!r}, which is not in "
                    f"{target.name}; make the package again"
                ) from None
        return target

    def _check_package(self, name: str, path: str, content: bytes, depth: int) -> None:
        """Check all layers in a package; `path` is what USD calls it."""
        stored_files.check_most(
            self.file.name,
            depth,
            DEEPEST_PACKAGE,
            "packages in at most {} others",
            "more",
        )
        with open_package(name, content) as archive:
            _check_without_gaps(name, archive, content)
            entries = {
                entry.filename for entry in archive.infolist() if not entry.is_dir()
            }
            for entry in sorted(entries):
                suffix = Path(entry).suffix.lower()
                inner_path = Ar.JoinPackageRelativePath(path, entry)
                if suffix == PACKAGE:
                    self._take(0)
                    self._check_package(
                        f"{name}[{entry}]", inner_path, archive.read(entry), depth + 1
                    )
                elif suffix in LAYERS:
                    self._take(0)  # its bytes are those of the package
                    for named in self._named_in(
                        inner_path, f"{name}[{reading.shown(entry, quoted=False)}]"
                    ):
                        self._check_packaged(name, entry, named, entries)

    def _check_packaged(
        self, package: str, entry: str, named: str, entries: set[str]
    ) -> None:
        """Refuse what a layer in a package names outside of it."""
        outer, _ = Ar.SplitPackageRelativePathOuter(named)
        near = os.path.normpath(PurePosixPath(entry).parent / outer)
        from_root = os.path.normpath(outer)  # not anchored: of the package's root
        is_inside = near in entries or (
            not outer.startswith(".") and from_root in entries
        )
        if not is_inside or Path(outer).suffix.lower() not in (*LAYERS, PACKAGE):
            raise errors.FileFormatError(
                f"{self.file.name}: {package} names the layer {named[:100]!r}, which "
                "is no USD file in that package "
                "and is not read; make the package again with usdzip, or one file of "
                "all with usdcat --flatten"
            )

    def _named_in(self, path: str, name: str) -> Iterator[str]:
        """Yield the layers that a layer names, and refuse value clips."""
        try:
            layer = Sdf.Layer.FindOrOpen(path)
        except Exception as error:  # Tf.ErrorException, of which there are many kinds
            raise errors.FileFormatError(
                f"{name}: expected a USD layer, got {shorten(error)}"
            ) from None
        if layer is None:
            raise errors.FileFormatError(
                f"{name}: expected a USD layer, got none that can be read"
            )
        yield from filter(None, layer.GetCompositionAssetDependencies())

        def check(at: Any) -> None:
            spec = layer.GetObjectAtPath(at) if at.IsPrimPath() else None
            if spec is not None and "clips" in spec.ListInfoKeys():
                what = f"has value clips ({at}), which are not read"
                raise errors.FileFormatError(
                    f"{self.file.name}: {what}; make one file "
                    "of all with usdcat --flatten"
                )

        layer.Traverse(Sdf.Path.absoluteRootPath, check)


def shorten(error: Exception) -> str:
    """Return what an error of usd-core says, in one line."""
    said = re.findall(r":(\d+:\d+: .+)", str(error)) or re.findall(
        r" : '(.+)", str(error)
    )
    lines = said or [
        line.strip() for line in str(error).splitlines() if len(line.strip()) > 3
    ]
    return (lines[-1] if lines else type(error).__name__)[:200]
