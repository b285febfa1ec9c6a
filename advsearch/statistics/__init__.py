"""Statistics of counts and rates: intervals, sequential rules, paired and clustered
tests.

Pure functions of numbers and arrays, each with its source. They do not depend on the
rest of the package. A module is imported when it is first used, as scipy takes long.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from advsearch.statistics import agreement as agreement
    from advsearch.statistics import clustered as clustered
    from advsearch.statistics import intervals as intervals
    from advsearch.statistics import monotone as monotone
    from advsearch.statistics import paired as paired
    from advsearch.statistics import sequential as sequential

__all__ = ["agreement", "clustered", "intervals", "monotone", "paired", "sequential"]


def __getattr__(name: str) -> Any:
    """Import a module of this package on first use (PEP 562): some import scipy."""
    if name in __all__:
        return import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
