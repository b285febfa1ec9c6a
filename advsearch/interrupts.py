"""Ctrl-C, counted: modules that are being imported and native code make other errors of an interrupt, or lose it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class Interrupts:
    """A handler of Ctrl-C as Python's own, which counts signals. Once it has `ended` they are only counted, since
    nothing is left to interrupt."""

    def __init__(self) -> None:
        self.count = 0
        self.ended = False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        self.count += 1
        if not self.ended:
            raise KeyboardInterrupt

    def check(self) -> None:
        """Raise an interrupt that has come already."""
        if self.count:
            raise KeyboardInterrupt


INTERRUPTS = Interrupts()
"""Those of this process."""


@contextmanager
def interruptible() -> Iterator[None]:
    """Raise what an interrupt that comes inside the block was made into as the interrupt that it is. Raises
    KeyboardInterrupt where there was an error of any kind inside the block, and an interrupt before it."""
    before = INTERRUPTS.count
    try:
        yield
    except Exception as error:
        if INTERRUPTS.count > before:
            raise KeyboardInterrupt from error
        raise
