"""Which rows of a sweep are independent: those of different *units*, each of one draw. A unit is a drive with all its
frames, or a picture, with the predictions of all models and, where one was swept, without and with the adversarial
scene of a run."""

from __future__ import annotations

from dataclasses import dataclass
from math import prod
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from advsearch.errors import FileFormatError
from advsearch.runs.store import Store

NOTE = "units"
"""The note of a run that says it."""

Number = TypeVar("Number", int, npt.NDArray[np.int64])


@dataclass(frozen=True)
class Units:
    """How rows follow from draws.

    Attributes:
        sizes: of the axes of the grid, the last one fastest.
        frames: place of the axis whose values are frames; None where there is none.
        samples: draws at each point of the grid.
        models: that are shown the same pictures.
        again: pictures after which the draws come again; 0 for never.
    """

    sizes: tuple[int, ...] = ()
    frames: int | None = None
    samples: int = 1
    models: int = 1
    again: int = 0

    @property
    def size(self) -> int:
        """Rows of a whole unit."""
        return self.models * (2 if self.again else 1) * (1 if self.frames is None else self.sizes[self.frames])

    @property
    def name(self) -> str:
        """What one is called."""
        return "picture" if self.frames is None or self.sizes[self.frames] < 2 else "drive"

    def of(self, step: Number) -> Number:
        """Return the number of the unit of a row, or of rows (n,), by their steps."""
        return self.draw(step // self.models)

    def draw(self, picture: Number) -> Number:
        """Return the number of the draw of a picture, by its number in the whole sweep."""
        if self.again:
            picture = picture % self.again
        if self.frames is None:
            return picture
        place, sample = picture // self.samples, picture % self.samples
        after = prod(self.sizes[self.frames + 1 :])
        before = place // (self.sizes[self.frames] * after)  # scenes are like one more axis, the slowest
        return (before * after + place % after) * self.samples + sample

    @property
    def noted(self) -> dict[str, Any]:
        """What the note says."""
        return {**vars(self), "sizes": list(self.sizes)}


def units_of(store: Store) -> Units | None:
    """Return what a run notes of its units; None where it notes nothing."""
    noted = store.noted(NOTE)
    units = None if noted is None else _read(noted)
    if noted is not None and units is None:
        raise FileFormatError(f"{store.path}: expected what units of sampling are, got {str(noted)[:80]}")
    return units


def _read(noted: Any) -> Units | None:
    """What a note says; None where it is something else."""
    if not isinstance(noted, dict) or not isinstance(noted.get("sizes"), list):
        return None
    sizes, frames = noted["sizes"], noted.get("frames")
    counts = [*sizes, noted.get("samples"), noted.get("models")]
    known = all(type(one) is int and one >= 1 for one in counts) and type(noted.get("again")) is int
    if not known or noted["again"] < 0 or not (frames is None or (type(frames) is int and 0 <= frames < len(sizes))):
        return None
    return Units(tuple(sizes), frames, noted["samples"], noted["models"], noted["again"])
