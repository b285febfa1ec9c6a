"""The one place that imports Mitsuba: a libLLVM that works, one variant, warnings only, our thread counts; and which
scenes live inside it."""

from __future__ import annotations

import gc
import sys
import threading
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from advsearch import threads
from advsearch.errors import EnvironmentSetupError
from advsearch.scene.mitsuba_backend.llvm import ensure_llvm

VARIANT = "llvm_ad_rgb"
Plugin = dict[str, Any]
"""A plugin, or a whole scene, as Mitsuba's loader takes it: its `type`, and by Mitsuba's names for them numbers, texts,
transforms, bitmaps, objects that are loaded already, and further plugins."""
one_at_a_time = threading.RLock()
"""One thread renders, builds or denoises at a time: they share what Dr.Jit records, and the denoiser's pictures."""


def mitsuba() -> ModuleType:
    """Mitsuba with the variant ``llvm_ad_rgb`` set. The first call imports it; later ones only look the variant up.

    Raises:
        EnvironmentSetupError: no libLLVM that Dr.Jit can use; the message holds the command that installs one.
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
        gc.freeze()  # every change of the scenes calls the collector: what is imported by now would take it 0.2 s
    return mitsuba


class _Late:
    """A module that is imported once it is used, with our variant: Dr.Jit looks for libLLVM as it is imported."""

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
    """Return a function that Dr.Jit records on first use and replays later; `media` are a part of what it is given.

    Nothing may be freed while it records: memory that torch shares and scenes end with a host function, which Dr.Jit
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
    """What has been recorded, by what it is; all of it goes where the population, or Dr.Jit's pool of threads, has
    changed since: it would crash."""

    _made_at = (0, 0)

    def of(self, what: Any, render: Callable[..., Any], media: list[Any]) -> Callable[..., Any]:
        """Return the recording of something, or the function that will make it; arguments as of `recorded`."""
        now = (population.changes, dr.thread_count())
        if self._made_at != now:
            self.clear()
            self._made_at = now
        if what not in self:
            self[what] = recorded(render, media)
        return self[what]


class Population:
    """The scenes inside Mitsuba that this process holds, and when they may go; `changes` counts how often it has
    changed, `unused` has the numbers of what has lost its owner.

    A recorded kernel refers to the objects of all scenes that lived when it was recorded, and Dr.Jit leaves undefined
    what happens when it is replayed after one was added or removed. So every change of the population makes every
    recording stale, and a scene that nobody uses any more is kept until no render is under way: Python's garbage
    collector may strike in the middle of one.
    """

    def __init__(self) -> None:
        self.changes = 0
        self._held: dict[int, tuple[tuple[Any, ...], tuple[Any, ...]]] = {}
        self.unused: list[int] = []

    def add(self, owner: object, *objects: Any, media: tuple[Any, ...] = ()) -> None:
        """Hold Mitsuba's objects, with the media among them, for as long as their owner lives, and a little longer."""
        self.changes += 1
        self._held[self.changes] = objects, media
        weakref.finalize(owner, self.unused.append, self.changes)

    def bury(self) -> None:
        """Let go of what has lost its owner, of which there is some. Call it between renders only."""
        while self.unused:
            self._held.pop(self.unused.pop(), None)
        gc.collect()  # Mitsuba's Python objects form cycles; they have to go now, not during a later render
        self.changes += 1

    def media(self) -> list[Any]:
        """Return the media of all scenes: what calls one of them is recorded with all that there are, and Dr.Jit 1.5.0
        finds no others than those of the scene that is rendered."""
        return [medium for _, media in self._held.values() for medium in media]


population = Population()  # of this process


# ---------------------------------------------------------------------------------------------------------------------
# Intel Open Image Denoise on the CPU, guided by albedo and shading normals (package `mitsuba-oidn`).
#
# Deterministic: the same input gives the same bytes, at any number of threads. It needs pixels with independent noise,
# hence the box filter. A search treats it as the identity when it differentiates; that is an approximation, and
# differences of pictures include it exactly.

KEY = 0.18  # mean logarithmic luminance of a picture as the network sees it (as in Open Image Denoise's `autoexposure`)
BIN, DARKEST = 16, 1e-8  # pixels along a side of the squares that are averaged, and the least luminance; likewise
LUMINANCE = np.array([0.212671, 0.715160, 0.072169])  # of red, green and blue (ITU-R BT.709); likewise


def denoise(radiance: Tensor, albedo: Tensor, normal: Tensor, *, quick: bool = False) -> Tensor:
    """Return the denoised linear radiance.

    Args:
        radiance: (H, W, 3) float32 linear radiance, at least 0.
        albedo, normal: (H, W, 3) float32 reflectance in [0, 1] and shading normal in [-1, 1] of the first hit.
        quick: take some 0.6 of the time, and leave a little more error.

    Raises:
        EnvironmentSetupError: the package is not installed.
    """
    with one_at_a_time:
        try:
            # not before `mitsuba()`, which sees to libLLVM
            import mitsuba_oidn
        except ImportError as error:
            raise EnvironmentSetupError(
                f"the denoiser cannot be loaded ({error}): pip install mitsuba-oidn, or use `denoise=none`"
            ) from error
        color, guide, direction, output = _buffers((radiance.shape[0], radiance.shape[1]), threading.get_ident())
        gain = _gain(radiance.detach())
        for buffer, image in ((color, radiance.detach() * gain), (guide, albedo), (direction, normal)):
            buffer.copy_(image.detach())
        quality = mitsuba_oidn.Quality.Fast if quick else mitsuba_oidn.Quality.High
        mitsuba_oidn.denoise(color, guide, direction, hdr=True, quality=quality, input_scale=1.0, output=output)
        return (output / gain).to(radiance.device)


@lru_cache(maxsize=8)
def _buffers(resolution: tuple[int, int], thread: int) -> list[Tensor]:
    """Return what pictures of a size are denoised in, in a thread: the filter is set up anew, for longer than it takes
    to run, whenever it is given other memory."""
    return [torch.zeros(*resolution, 3) for _ in range(4)]


def _gain(radiance: Tensor) -> float:
    """Return the factor that gives a picture (H, W, 3) the mean logarithmic luminance `KEY`.

    The denoiser would find it by itself, but adds up in an order that depends on the number of threads: by a few units
    in the last place.
    """
    luminance = (radiance.cpu().numpy() * LUMINANCE).sum(axis=-1)
    starts = [np.arange(-(-side // BIN)) * side // -(-side // BIN) for side in luminance.shape]
    rows, columns = (np.diff(first, append=side) for first, side in zip(starts, luminance.shape, strict=True))
    means = np.add.reduceat(np.add.reduceat(luminance, starts[0], axis=0), starts[1], axis=1) / np.outer(rows, columns)
    means = means[means > DARKEST]
    return float(KEY / np.exp2(np.log2(means).mean())) if means.size else 1.0
