"""The one place that imports Mitsuba: a libLLVM that works, one variant, warnings only, our thread counts."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from types import ModuleType
from typing import Any, TypeVar

from advsearch import threads
from advsearch.scene.mitsuba_backend.llvm import ensure_llvm

VARIANT = "llvm_ad_rgb"

Plugin = dict[str, Any]
"""A plugin, or a whole scene, as Mitsuba's loader takes it: its `type`, and by Mitsuba's names for them numbers, texts,
transforms, bitmaps, objects that are loaded already, and further plugins."""

Function = TypeVar("Function", bound=Callable[..., Any])

_LOCK = threading.RLock()


def one_at_a_time(function: Function) -> Function:
    """Let one thread be in such functions at a time: they share what Dr.Jit records, and the denoiser's pictures."""

    @wraps(function)
    def locked(*args: Any, **named: Any) -> Any:
        with _LOCK:
            return function(*args, **named)

    return locked  # type: ignore[return-value]


def mitsuba() -> ModuleType:
    """Mitsuba with the variant ``llvm_ad_rgb`` set. The first call imports it; later ones only look the variant up.

    Raises:
        EnvironmentSetupError: no libLLVM that Dr.Jit can use; the message holds the command that installs one.
    """
    first = "mitsuba" not in sys.modules
    if first:
        ensure_llvm()
    import mitsuba as mi

    if mi.variant() != VARIANT:
        mi.set_variant(VARIANT)
        first = True
    if first:
        _settle(mi)
    module: ModuleType = mi
    return module


@contextmanager
def fewer_warnings() -> Iterator[None]:
    """Keep Mitsuba from warning: of a film that samples beyond its border, at every call, or of what is told here."""
    mi = mitsuba()
    before = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)
    try:
        yield
    finally:
        mi.set_log_level(before)


def _settle(mi: ModuleType) -> None:
    """Only warnings are logged, and Dr.Jit's pool gets the size that `advsearch.threads` chose."""
    import drjit as dr

    mi.set_log_level(mi.LogLevel.Warn)
    dr.set_log_level(dr.LogLevel.Warn)
    threads.apply_to_drjit()
