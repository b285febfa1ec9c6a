"""Files that a work needs, by the digest of what is in them: sent once to a worker, and only where they are not.

A mesh may name other files beside it, so what goes along with one is its folder: the files in it and below of the kinds
that a scene consists of.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from advsearch.cluster.executor import Work
from advsearch.errors import InputError

WITH_OTHERS = {".obj": (".mtl",), ".gltf": (".bin",), ".xml": (".obj", ".ply", ".serialized", ".exr", ".hdr")}
"""Files that name others, and what these end in beside pictures."""

PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tga", ".tif", ".tiff")

LARGEST = 1 << 30
"""Most bytes of all files together."""


@dataclass(frozen=True)
class Files:
    """The files that a work's settings name.

    Attributes:
        named: of each path in the settings, the digest of its folder's part and its name in it.
        contents: of each digest, relative path to content; empty where they are not sent.
    """

    named: Mapping[str, tuple[str, str]]
    contents: Mapping[str, Mapping[str, bytes]]

    @property
    def bytes(self) -> int:
        """Of all contents."""
        return sum(len(data) for files in self.contents.values() for data in files.values())

    @property
    def named_only(self) -> Files:
        """The same without contents."""
        return Files(self.named, {})


class MissingError(Exception):
    """A file is neither where the settings say nor among those that were sent before."""


def read_files(work: Work) -> Files:
    """Read the files that the settings of a work name.

    Raises:
        InputError: together they are larger than can be sent.
    """
    named, contents = {}, {}
    for path in _paths(work):
        files = _contents(path)
        digest = _digest(files)
        named[str(path)], contents[digest] = (digest, path.name), files
    found = Files(named, contents)
    if found.bytes > LARGEST:
        raise InputError(
            f"cluster: the files of the scene and the model have {found.bytes >> 20} MiB, and {LARGEST >> 20} can be "
            "sent; put them in a folder that all workers see, each under the same path"
        )
    return found


def write_files(work: Work, files: Files, folder: Path) -> Work:
    """Write files that were sent into folders of their digests, and return the work with the paths that hold here.

    Raises:
        MissingError: a file was not sent, and is not here.
        OSError: they cannot be written.
    """
    for digest, contents in files.contents.items():
        for name, data in contents.items():
            path = folder / digest / name
            path.parent.mkdir(parents=True, exist_ok=True)
            part = path.with_name(f"{path.name}.part-{os.getpid()}")  # no kind of file that goes along with another
            part.write_bytes(data)
            part.replace(path)
    new = {path: _here(path, digest, folder / digest / name) for path, (digest, name) in files.named.items()}
    settings = dict(work.settings)
    for name in work.files:
        value = settings.get(name)
        if isinstance(value, str):
            settings[name] = ",".join(_moved(part, new) for part in value.split(","))
    return replace(work, settings=settings)


def _here(path: str, digest: str, sent: Path) -> str:
    """The path that has the file here: the same as there, or that of what was sent."""
    for one in (Path(path), sent):
        if one.is_file() and _digest(_contents(one)) == digest:
            return str(one)
    raise MissingError(path)


def _contents(path: Path) -> dict[str, bytes]:
    return {one.relative_to(path.parent).as_posix(): one.read_bytes() for one in _with_others(path)}


def _paths(work: Work) -> Iterable[Path]:
    for name in work.files:
        value = work.settings.get(name)
        for part in value.split(",") if isinstance(value, str) else ():
            path = Path(part.strip().partition("#")[0])
            if path.is_absolute() and path.is_file():
                yield path


def _moved(part: str, new: Mapping[str, str]) -> str:
    path, mark, inner = part.strip().partition("#")
    return new.get(path, path) + mark + inner


def _with_others(path: Path) -> Sequence[Path]:
    if path.suffix.lower() not in WITH_OTHERS:
        return [path]
    kinds = (*WITH_OTHERS[path.suffix.lower()], *PICTURES)
    beside = (one for one in sorted(path.parent.rglob("*")) if one.suffix.lower() in kinds and one.is_file())
    return list(dict.fromkeys([path, *beside]))


def _digest(files: Mapping[str, bytes]) -> str:
    digest = hashlib.sha256()
    for name, data in sorted(files.items()):
        digest.update(f"{name}\0{len(data)}\0".encode() + data)
    return digest.hexdigest()[:32]
