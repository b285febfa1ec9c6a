"""Statistics of counts and shares: intervals, sequential rules, paired and clustered tests.

Pure functions of numbers and arrays, each with its source. Nothing here knows a run, a trial or a drive. A module is
imported when it is first used, as in ``statistics.intervals.wilson(3, 10)``, since scipy takes a while.
"""

from __future__ import annotations

from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from advsearch.statistics import clustered as clustered
    from advsearch.statistics import intervals as intervals
    from advsearch.statistics import monotone as monotone
    from advsearch.statistics import paired as paired
    from advsearch.statistics import sequential as sequential

_MODULES = ("clustered", "intervals", "monotone", "paired", "sequential")


def __getattr__(name: str) -> ModuleType:
    """Import a module of the package on first use (PEP 562)."""
    if name in _MODULES:
        return import_module(f"advsearch.statistics.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
