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

from advsearch.files import opened_for
from advsearch.settings.configuration import FILES

NOTE = "made with"
"""The note: a list, with an entry for each sitting."""

MOST = 20_000
"""Files of a folder that a digest is taken of, at most."""
FOLDERS = {"task": "*/*", "model": "*"}
"""Settings that may name a folder, and which files in it decide: a task's pictures, or what `hf:FOLDER` consists of."""

PACKAGES = ("advsearch", "mitsuba", "drjit", "torch", "numpy")

NOT_READ_AGAIN = ("recipe", "suite")
"""Settings whose file a run keeps in its store and goes on with, whatever became of the file."""


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


def changed_file(before: Sequence[Mapping[str, object]], settings: Mapping[str, object]) -> str | None:
    """Return the name of a file that is another one now than in every sitting before; None where all are the same.

    A file may have been moved, so that its name alone tells it.

    Args:
        before: what each sitting was `made_with`.
        settings: of the run, as in its run.yaml.
    """
    again = {name: value for name, value in settings.items() if name not in NOT_READ_AGAIN}
    for path, digest in file_digests(again).items():
        known = {one[old] for one in before for old in one if Path(old).name == Path(path).name}
        if known and digest not in known:
            return Path(path).name
    return None


def file_digests(settings: Mapping[str, object]) -> dict[str, str]:
    """Return the SHA-256 of each file that settings name, in hexadecimal, and of each that was read for it: materials,
    pictures and buffers that a mesh or a scene names. A folder has one for all. What is bundled or gone has none."""
    found: dict[str, str] = {}
    for name, value in settings.items():
        for path in _paths(value):
            with suppress(OSError, ValueError):
                own = os.path.abspath(path)
                parts = opened_for(own)
                folder = path if os.path.isabs(path) else path.removeprefix("hf:") if path.startswith("hf:") else ""
                if folder and name in FOLDERS and Path(folder).is_dir():
                    found[folder] = _digest_of_folder(Path(folder), FOLDERS[name])
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


def _digest_of_folder(folder: Path, which: str) -> str:
    """Return the SHA-256 of the names and contents of files in a folder that a pattern names."""
    digest = hashlib.sha256()
    for path in sorted(islice(folder.glob(which), MOST)):
        if path.is_file():
            digest.update(f"{path.relative_to(folder).as_posix()}\n{_digest(path)}".encode())
    return digest.hexdigest()


def _digest(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while part := file.read(1 << 20):
            digest.update(part)
    return digest.hexdigest()
