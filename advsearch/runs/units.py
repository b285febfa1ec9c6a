"""Which rows of a sweep are independent: those of different *units*, each of one draw. A unit is a drive with all its
frames, or a picture, with the predictions of all models and, where one was swept, without and with the adversarial
scene of a run."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import asdict
from math import prod
from typing import Annotated, Any, TypeVar

import numpy as np
import numpy.typing as npt
from pydantic import Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from advsearch.errors import FileFormatError
from advsearch.runs.store import Store

NOTE = "units"  # the note of a run that says it

Number = TypeVar("Number", int, npt.NDArray[np.int64])

Count = Annotated[int, Field(strict=True, ge=1)]


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

    sizes: tuple[Count, ...] = ()
    frames: Annotated[int, Field(strict=True, ge=0)] | None = None
    samples: Count = 1
    models: Count = 1
    again: Annotated[int, Field(strict=True, ge=0)] = 0

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
        return asdict(self)


def units_of(store: Store) -> Units | None:
    """Return what a run notes of its units; None where it notes nothing."""
    noted = store.noted(NOTE)
    if noted is None:
        return None
    with suppress(ValidationError):
        units = TypeAdapter(Units).validate_python(noted)
        if units.frames is None or units.frames < len(units.sizes):
            return units
    raise FileFormatError(f"{store.path}: expected what units of sampling are, got {str(noted)[:80]}")
