"""UDIM: one picture for each unit square of texture coordinates, with the square's number in its name.

The square from (0, 0) is 1001, those to its right count on to 1010, and each row above adds 10.
"""

from __future__ import annotations

import re

import numpy as np

from advsearch.scene.assets import Doubles, Ints

FIRST, ACROSS = 1001, 10
_NUMBER = re.compile(r"(?<!\d)1\d{3}(?=\.\w+$)")
_PLACE = re.compile(r"<UDIM>", re.IGNORECASE)


def number_in(name: str) -> int | None:
    """Return the number of the square that a picture's name has; 0 where it has ``<UDIM>`` in its place, else None."""
    if _PLACE.search(name):
        return 0
    found = _NUMBER.search(name)
    return int(found[0]) if found and int(found[0]) >= FIRST else None


def named(name: str, number: int) -> str:
    """Return the name of the picture of another square."""
    return _PLACE.sub(str(number), name) if _PLACE.search(name) else _NUMBER.sub(str(number), name)


def squares(uvs: Doubles) -> Ints:
    """Return the numbers (F,) of the squares that the middles of faces, with these UVs (F, 3, 2), lie in; 0 for
    none."""
    column, row = np.floor(uvs.mean(axis=1)).T
    known = (column >= 0) & (column < ACROSS) & (row >= 0) & (row < 100)
    return np.where(known, FIRST + column + ACROSS * row, 0).astype(np.int64)


def corner_of(square: int) -> tuple[int, int]:
    """Return the texture coordinates at which a square begins; (0, 0) for none."""
    return ((square - FIRST) % ACROSS, (square - FIRST) // ACROSS) if square else (0, 0)
