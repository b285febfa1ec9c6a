"""Which scenes live inside Mitsuba, and when they may go."""

from __future__ import annotations

import gc
import weakref
from typing import Any


class Population:
    """The scenes inside Mitsuba that this process holds, and when they may go.

    A recorded kernel refers to the objects of all scenes that lived when it was recorded, and Dr.Jit leaves undefined
    what happens when it is replayed after one was added or removed. So every change of the population makes every
    recording stale, and a scene that nobody uses any more is kept until no render is under way: Python's garbage
    collector may strike in the middle of one.
    """

    def __init__(self) -> None:
        self.changes = 0
        self._media: dict[int, tuple[Any, ...]] = {}
        self._loose: list[Any] = []
        self._held: dict[int, tuple[Any, ...]] = {}
        self._unused: list[int] = []

    def add(self, owner: object, *objects: Any, media: tuple[Any, ...] = ()) -> None:
        """Hold Mitsuba's objects, with the media among them, for as long as their owner lives, and a little longer."""
        self.changes += 1
        self._held[self.changes], self._media[self.changes] = objects, media
        weakref.finalize(owner, self._unused.append, self.changes)

    def bury(self) -> None:
        """Let go of what has lost its owner. Call it between renders only."""
        if not self._unused:
            return
        while self._unused:
            number = self._unused.pop()
            self._held.pop(number, None), self._media.pop(number, None)
        gc.collect()  # Mitsuba's Python objects form cycles; they have to go now, not during a later render
        self.changes += 1

    def keep(self, medium: Any) -> None:
        """Hold a medium that no shape refers to for good: Mitsuba does not let go of it, and `media` has to have it."""
        self._loose.append(medium)

    def media(self) -> list[Any]:
        """Return the media of all scenes: what calls one of them is recorded with all that there are, and Dr.Jit 1.5.0
        finds no others than those of the scene that is rendered."""
        return [*self._loose, *(one for some in self._media.values() for one in some)]


def media_in(scene: Any) -> tuple[Any, ...]:
    """Return the media in the shapes of Mitsuba's scene."""
    both = ((shape.interior_medium(), shape.exterior_medium()) for shape in scene.shapes())
    return tuple(one for pair in both for one in pair if one is not None)


population = Population()
"""Of this process."""
