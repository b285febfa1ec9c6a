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
        self._held: dict[int, tuple[Any, ...]] = {}
        self._unused: list[int] = []

    def add(self, owner: object, *objects: Any) -> None:
        """Hold Mitsuba's objects for as long as their owner lives, and a little longer."""
        self.changes += 1
        self._held[self.changes] = objects
        weakref.finalize(owner, self._unused.append, self.changes)

    def bury(self) -> None:
        """Let go of what has lost its owner. Call it between renders only."""
        if not self._unused:
            return
        while self._unused:
            self._held.pop(self._unused.pop(), None)
        gc.collect()  # Mitsuba's Python objects form cycles; they have to go now, not during a later render
        self.changes += 1


population = Population()
"""Of this process."""
