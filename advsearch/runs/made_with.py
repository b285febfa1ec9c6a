"""What a run is made with: versions, and digests of the files that its settings name. Kept as a note in its store."""

from __future__ import annotations

import hashlib
import os
import platform
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from importlib import metadata
from itertools import islice
from pathlib import Path

from advsearch.errors import FileFormatError
from advsearch.files import opened_for, read_bytes

NOTE = "made with"
"""The note: a list, with an entry for each sitting."""

MOST, LARGEST = 20_000, 1 << 28
"""Files of a folder, and bytes of one, that a digest is taken of, at most."""

PACKAGES = ("advsearch", "mitsuba", "drjit", "torch", "numpy")


def made_with(settings: Mapping[str, object]) -> dict[str, str]:
    """Return versions by package, and the SHA-256 of each file that settings name, by its name in them.

    Args:
        settings: of a run, as in its run.yaml.
    """
    facts = {"python": platform.python_version()}
    for name in PACKAGES:
        with suppress(metadata.PackageNotFoundError):
            facts[name] = metadata.version(name)
    return {**facts, **file_digests(settings)}


def changed_file(before: Sequence[Mapping[str, object]], now: Mapping[str, str]) -> str | None:
    """Return the name of a file that is another one now than in every sitting before; None where all are the same.

    A file may have been moved, so that its name alone tells it. That of a recipe is not read again.
    """

    def files(facts: Mapping[str, object]) -> dict[str, set[object]]:
        found: dict[str, set[object]] = {}
        for path, digest in facts.items():
            if path not in ("python", *PACKAGES) and Path(path).suffix not in (".yaml", ".yml"):
                found.setdefault(Path(path).name, set()).add(digest)
        return found

    seen = [files(one) for one in before]
    for name, digests in files(now).items():
        known = set().union(*(one[name] for one in seen if name in one))
        if known and not digests <= known:
            return name
    return None


def file_digests(settings: Mapping[str, object]) -> dict[str, str]:
    """Return the SHA-256 of each file that settings name, in hexadecimal, and of each that was read for it: materials,
    pictures and buffers that a mesh or a scene names. A folder of a task's pictures has one for all. What is bundled
    or gone has none."""
    from advsearch.settings.configuration import FILES

    found: dict[str, str] = {}
    for name, value in settings.items():
        for path in _paths(value):
            with suppress(OSError, ValueError):
                own = os.path.abspath(path)
                parts = opened_for(own)
                if name == "task" and os.path.isabs(path) and Path(path).is_dir():
                    found[path] = _digest_of_folder(Path(path))
                if (parts or name in FILES) and Path(path).is_file():
                    found[path] = _digest(Path(path))
                for part in parts:
                    if part != own and Path(part).is_file():
                        found[os.path.join(os.path.dirname(path), os.path.relpath(part, os.path.dirname(own)))] = (
                            _digest(Path(part))
                        )
    return found


def _paths(value: object) -> Iterator[str]:
    """What may be a file in ``a.pt2,reference@weights.safetensors`` or ``scene.glb#NODE``, in lists and mappings."""
    if isinstance(value, Mapping):
        for one in value.values():
            yield from _paths(one)
    elif isinstance(value, (list, tuple)):
        for one in value:
            yield from _paths(one)
    elif isinstance(value, str):
        for name in value.split(","):
            yield from dict.fromkeys(
                one.strip() for one in (name, name.rpartition("@")[2], name.partition("#")[0]) if one.strip()
            )


def _digest_of_folder(folder: Path) -> str:
    """Return the SHA-256 of the names and contents of the files in the folders of a folder, as far as they are read."""
    digest = hashlib.sha256()
    for path in sorted(islice(folder.glob("*/*"), MOST)):
        digest.update(f"{path.relative_to(folder).as_posix()}\n".encode())
        with suppress(OSError, FileFormatError):
            digest.update(hashlib.sha256(read_bytes(path, "a picture", LARGEST)).digest())
    return digest.hexdigest()


def _digest(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while part := file.read(1 << 20):
            digest.update(part)
    return digest.hexdigest()
