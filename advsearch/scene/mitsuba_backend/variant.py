"""Import Mitsuba: with a libLLVM that works, one variant, warnings only, our threads.

No other module imports it. `SceneRegistry` knows which scenes live inside it.
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
"""A plugin, or a full scene, as Mitsuba's loader takes it.

It has its `type`, and by Mitsuba's names numbers, strings, transforms, bitmaps, objects
that are loaded already, and further plugins.
"""
mitsuba_lock = threading.RLock()
"""Lock with which one thread at a time renders, builds or denoises.

They share what Dr.Jit records, and the denoiser's buffers.
"""


def import_mitsuba() -> ModuleType:
    """Import Mitsuba with the variant ``llvm_ad_rgb`` set.

    The first call imports it; later ones only look the variant up.

    Raises:
        EnvironmentSetupError: no libLLVM that Dr.Jit can use; the message holds the
            command that installs one.
    """
    is_new = "mitsuba" not in sys.modules
    if is_new:
        ensure_llvm()
    # not before libLLVM is chosen
    import mitsuba

    if mitsuba.variant() != VARIANT:
        mitsuba.set_variant(VARIANT)
        is_new = True
    if is_new:
        _set_up_libraries(mitsuba)
    return mitsuba


def _set_up_libraries(mitsuba: ModuleType) -> None:
    """Set log levels and threads, and exempt imported objects from garbage collection.

    Every change of the scenes calls the garbage collector. Without freezing, it would
    take 0.2 s each time for the objects of the imported modules.
    """
    import drjit  # not before libLLVM is chosen

    mitsuba.set_log_level(mitsuba.LogLevel.Warn)
    drjit.set_log_level(drjit.LogLevel.Warn)
    threads.apply_to_drjit()
    gc.freeze()


class _LazyModule:
    """A module that is imported on first use, with our variant.

    Dr.Jit looks for libLLVM when it is imported.
    """

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, name: str) -> Any:
        import_mitsuba()
        return getattr(sys.modules[self._name], name)


mi: Any = _LazyModule("mitsuba")
dr: Any = _LazyModule("drjit")


@contextmanager
def suppress_warnings() -> Iterator[None]:
    """Suppress Mitsuba's warnings inside the `with`, where advsearch reports itself."""
    level = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)
    try:
        yield
    finally:
        mi.set_log_level(level)


def record_on_first_use(
    render: Callable[..., Any], media: list[Any]
) -> Callable[..., Any]:
    """Return a function that Dr.Jit records on first use and replays later.

    Python's garbage collector is disabled while the function runs. It might free a
    scene, or memory that torch shares, which calls a function of Python. Dr.Jit 1.5.0
    cannot record such a call, and the process would end.

    Args:
        render: the function.
        media: Mitsuba's media that it uses besides its arguments.
    """
    # Dr.Jit calls `state_fn` with the arguments of the recorded function; it returns
    # what else the recording depends on.
    frozen = dr.freeze(render, state_fn=(lambda *_, **__: media) if media else None)

    def call(*arguments: Any) -> Any:
        """Record or replay, while nothing can be freed."""
        was_enabled = gc.isenabled()
        gc.disable()
        try:
            return frozen(*arguments)
        finally:
            if was_enabled:
                gc.enable()

    return call


class Recordings(dict[Any, Callable[..., Any]]):
    """Recorded functions by a key.

    All of them are discarded when the population or Dr.Jit's pool of threads has
    changed since: a replay would crash.
    """

    _recorded_at = (0, 0)

    def get_or_record(
        self, key: Any, render: Callable[..., Any], media: list[Any]
    ) -> Callable[..., Any]:
        """Return the recording for a key, or a function that records at its first call.

        All recordings are dropped if scenes or the number of threads have changed since
        they were made.

        Args:
            key: what tells recordings apart, such as method and samples per pixel.
            render: the function that is recorded.
            media: Mitsuba's media that it uses besides its arguments.
        """
        state = (scene_registry.n_changes, dr.thread_count())
        if self._recorded_at != state:
            self.clear()
            self._recorded_at = state
        if key not in self:
            self[key] = record_on_first_use(render, media)
        return self[key]


@contextmanager
def add_without_copies() -> Iterator[None]:
    """Let all threads add to the same sums inside the `with`.

    Otherwise Dr.Jit gives each thread a copy of small sums, and adds the copies at the
    end. Dr.Jit 1.5.0 then loses a part of the gradient of a lamp in a photograph: with
    two threads or more it was up to 30 % too small (`tests/test_threads.py`).
    """
    threshold = dr.expand_threshold()
    dr.set_expand_threshold(0)
    try:
        yield
    finally:
        dr.set_expand_threshold(threshold)


class SceneRegistry:
    """The scenes inside Mitsuba that this process holds, and when they may be freed.

    A recorded kernel refers to the objects of all scenes that lived when it was
    recorded, and Dr.Jit leaves undefined what happens when it is replayed after one was
    added or removed. So every change of the population makes every recording stale, and
    a scene that nobody uses any more is retained until no render is running: Python's
    garbage collector may start in the middle of one.

    Attributes:
        n_changes: number of changes of the population so far. A recording is valid only
            as long as it stays the same.
        unused_keys: keys, in `_held`, of the objects whose owner has been freed.
    """

    def __init__(self) -> None:
        self.n_changes = 0
        self._held: dict[int, tuple[tuple[Any, ...], tuple[Any, ...]]] = {}
        self.unused_keys: list[int] = []

    def hold_objects(
        self, owner: object, *objects: Any, media: tuple[Any, ...] = ()
    ) -> None:
        """Hold Mitsuba's objects until `free_unused` after their owner is freed.

        Args:
            owner: object that uses them, such as a `MitsubaScene`.
            *objects: objects of Mitsuba.
            media: further objects, which are Mitsuba's media; see `list_media`.
        """
        self.n_changes += 1
        # a unique key, since the count only grows
        key = self.n_changes
        self._held[key] = (objects, media)
        weakref.finalize(owner, self.unused_keys.append, key)

    def free_unused(self) -> None:
        """Free the objects whose owner has been freed; call it only between renders.

        It makes all recordings stale, even if nothing is freed. So callers test first
        that `unused_keys` is not empty.
        """
        while self.unused_keys:
            self._held.pop(self.unused_keys.pop(), None)
        # Mitsuba's Python objects form cycles; they have to be freed now, not during a
        # later render.
        gc.collect()
        self.n_changes += 1

    def list_media(self) -> list[Any]:
        """Return the media of all scenes.

        What calls one of them is recorded with all that there are, and Dr.Jit 1.5.0
        finds no others than those of the scene that is rendered.
        """
        return [medium for _, media in self._held.values() for medium in media]


scene_registry = SceneRegistry()  # of this process
