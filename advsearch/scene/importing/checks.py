"""How large a mesh may be."""

from __future__ import annotations

from pathlib import Path

from advsearch import files

LARGEST_FACES = 2_000_000
"""Triangles that a mesh may have, before `advsearch.files.scaled`; each takes over 1 KB of memory to import."""

MOST_CORNERS = 10_000
"""Corners that one face may have."""


def check_faces(path: Path, count: int) -> None:
    """Refuse a mesh with too many triangles.

    Raises:
        FileFormatError: there are more than `LARGEST_FACES`, before `advsearch.files.scaled`.
    """
    if count > files.scaled(LARGEST_FACES):
        raise files.too_large(path, f"a mesh of at most {files.scaled(LARGEST_FACES):,} triangles", f"{count:,}")
