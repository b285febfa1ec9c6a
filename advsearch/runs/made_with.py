"""What a run is made with: versions, and digests of the files that its settings name. Kept as a note in its store."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from importlib import metadata
from pathlib import Path

NOTE = "made with"
"""The note: a list, with an entry for each sitting."""

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
    """Return the SHA-256 of each file that settings name, in hexadecimal; what is bundled or gone has none."""
    from advsearch.settings.configuration import FILES

    found = {}
    for name in FILES:
        for path in _paths(settings.get(name)):
            with suppress(OSError, ValueError):
                if Path(path).is_file():
                    found[path] = _digest(Path(path))
    return found


def _paths(value: object) -> Iterator[str]:
    """What may be a file in ``a.pt2,reference@weights.safetensors``, or in a list of such."""
    for one in value if isinstance(value, list) else [value]:
        if isinstance(one, str):
            for name in one.split(","):
                yield from dict.fromkeys([name.strip(), name.rpartition("@")[2].strip()])


def _digest(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while part := file.read(1 << 20):
            digest.update(part)
    return digest.hexdigest()
