"""A configuration in words: named values with units, as controls say them and runs keep them."""

from __future__ import annotations

from typing import TypedDict


class Value(TypedDict):
    """One value of a configuration."""

    value: float | str
    unit: str


NOT_A_NUMBER = "not a number"  # what an output of a model is called that has NaN or infinity in it: it has said nothing
OUT_OF_VIEW = "out of view"
"""What a prediction is called where nothing of what is judged is in the picture. It is not a success of a search, and
no share of right predictions counts it."""


def rounded(number: float) -> str:
    """Return a number that was worked out as sentences have it: with three significant digits."""
    return f"{float(f'{number:.3g}'):g}"
