"""The one place that imports Mitsuba: a libLLVM that works, one variant, warnings only,
our thread counts; and which scenes live inside it.
"""

from __future__ import annotations

import gc
import sys
import threading
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any

from advsearch import threads
from advsearch.scene.mitsuba_backend.llvm import ensure_llvm

VARIANT = "llvm_ad_rgb"
Plugin = dict[str, Any]
"""A plugin, or a whole scene, as Mitsuba's loader takes it: its `type`, and by
Mitsuba's names for them numbers, texts, transforms, bitmaps, objects that are loaded
already, and further plugins.
"""
one_at_a_time = threading.RLock()
"""One thread renders, builds or denoises at a time: they share what Dr.Jit records, and
the denoiser's pictures.
"""


def mitsuba() -> ModuleType:
    """Mitsuba with the variant ``llvm_ad_rgb`` set. The first call imports it; later
    ones only look the variant up.

    Raises:
        EnvironmentSetupError: no libLLVM that Dr.Jit can use; the message holds the
            command that installs one.
    """
    first = "mitsuba" not in sys.modules
    if first:
        ensure_llvm()
    # not before libLLVM is chosen
    import mitsuba

    if mitsuba.variant() != VARIANT:
        mitsuba.set_variant(VARIANT)
        first = True
    if first:
        import drjit  # not before libLLVM is chosen

        mitsuba.set_log_level(mitsuba.LogLevel.Warn)
        drjit.set_log_level(drjit.LogLevel.Warn)
        threads.apply_to_drjit()
        # every change of the scenes calls the collector: what is imported by now would
        # take it 0.2 s
        gc.freeze()
    return mitsuba


class _Late:
    """A module that is imported once it is used, with our variant: Dr.Jit looks for
    libLLVM as it is imported.
    """

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, name: str) -> Any:
        mitsuba()
        return getattr(sys.modules[self._name], name)


mi: Any = _Late("mitsuba")
dr: Any = _Late("drjit")


@contextmanager
def fewer_warnings() -> Iterator[None]:
    """Keep Mitsuba from warning of what is told here."""
    before = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)
    try:
        yield
    finally:
        mi.set_log_level(before)


def recorded(render: Callable[..., Any], media: list[Any]) -> Callable[..., Any]:
    """Return a function that Dr.Jit records on first use and replays later; `media` are
    a part of what it is given.

    Nothing may be freed while it records: memory that torch shares and scenes end with
    a host function, which Dr.Jit
    1.5.0 cannot record, and the process ends. So Python's garbage collector waits until after.
    """
    frozen = dr.freeze(render, state_fn=(lambda *_, **__: media) if media else None)

    def function(*arguments: Any) -> Any:
        collects = gc.isenabled()
        gc.disable()
        try:
            return frozen(*arguments)
        finally:
            if collects:
                gc.enable()

    return function


class Recordings(dict[Any, Callable[..., Any]]):
    """What has been recorded, by what it is; all of it goes where the population, or
    Dr.Jit's pool of threads, has changed since: it would crash.
    """

    _made_at = (0, 0)

    def of(
        self, what: Any, render: Callable[..., Any], media: list[Any]
    ) -> Callable[..., Any]:
        """Return the recording of something, or the function that will make it;
        arguments as of `recorded`.
        """
        now = (population.changes, dr.thread_count())
        if self._made_at != now:
            self.clear()
            self._made_at = now
        if what not in self:
            self[what] = recorded(render, media)
        return self[what]


class Population:
    """The scenes inside Mitsuba that this process holds, and when they may go;
    `changes` counts how often it has changed, `unused` has the numbers of what has lost
    its owner.

    A recorded kernel refers to the objects of all scenes that lived when it was
    recorded, and Dr.Jit leaves undefined what happens when it is replayed after one was
    added or removed. So every change of the population makes every recording stale, and
    a scene that nobody uses any more is kept until no render is under way: Python's
    garbage collector may strike in the middle of one.
    """

    def __init__(self) -> None:
        self.changes = 0
        self._held: dict[int, tuple[tuple[Any, ...], tuple[Any, ...]]] = {}
        self.unused: list[int] = []

    def add(self, owner: object, *objects: Any, media: tuple[Any, ...] = ()) -> None:
        """Hold Mitsuba's objects, with the media among them, for as long as their owner
        lives, and a little longer.
        """
        self.changes += 1
        self._held[self.changes] = objects, media
        weakref.finalize(owner, self.unused.append, self.changes)

    def bury(self) -> None:
        """Let go of what has lost its owner, of which there is some. Call it between
        renders only.
        """
        while self.unused:
            self._held.pop(self.unused.pop(), None)
        # Mitsuba's Python objects form cycles; they have to go now, not during a later
        # render
        gc.collect()
        self.changes += 1

    def media(self) -> list[Any]:
        """Return the media of all scenes: what calls one of them is recorded with all
        that there are, and Dr.Jit 1.5.0 finds no others than those of the scene that is
        rendered.
        """
        return [medium for _, media in self._held.values() for medium in media]


population = Population()  # of this process
