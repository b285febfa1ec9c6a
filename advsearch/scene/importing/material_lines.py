"""What the lines of a material file (.mtl) say, as trimesh splits them into words."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float32]


def color_of(given: Any) -> Floats | None:
    """Return a material file's colour as (3,) float32, clipped to [0, 1]; None unless it is one or three numbers."""
    values = np.atleast_1d(np.asarray(given if given is not None else [], dtype=np.float32))
    if values.shape not in ((1,), (3,)) or not np.isfinite(values).all():
        return None
    return np.clip(np.broadcast_to(values, (3,)), 0.0, 1.0).astype(np.float32)


def radiance_of(words: list[str]) -> npt.NDArray[np.float64] | None:
    """Return one or three numbers of at least 0 as a colour (3,), black where there are none; None for other words."""
    try:
        values = np.array([float(word) for word in words or ["0"]])
    except ValueError:
        return None
    good = values.shape in ((1,), (3,)) and np.isfinite(values).all() and values.min() >= 0.0
    return np.broadcast_to(values, (3,)) if good else None


def scale_and_name(words: list[str]) -> tuple[float, str]:
    """Return the factor (``-bm``) of a line of a material file that names a bump map, 1 by default, and the name."""
    if "-bm" not in words[:-2]:
        return 1.0, " ".join(words)
    at = words.index("-bm")
    try:
        scale = float(words[at + 1])
    except ValueError:
        scale = 1.0
    return scale if math.isfinite(scale) else 1.0, " ".join(words[:at] + words[at + 2 :])


def last_number(words: list[str] | None, otherwise: float) -> float:
    """Return the last word of a line as a number in [0, 1], or what holds otherwise."""
    try:
        number = float((words or [""])[-1])
    except ValueError:
        return otherwise
    return min(max(number, 0.0), 1.0) if math.isfinite(number) else otherwise
