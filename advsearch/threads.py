"""How many threads torch and Dr.Jit use, and how torch's wait, so that the two pools do not fight.

A search step renders (Dr.Jit's pool), then runs the model (torch's OpenMP pool), then renders again. An idle Dr.Jit
worker polls for 20 ms before it sleeps. An idle OpenMP worker polls at its barriers, by default for about ten
milliseconds: as soon as anything else wants a core, the polling thread holds the one that the awaited thread needs, and
a network of a hundred short layers has hundreds of barriers. Sleeping at once costs more than it saves on a quiet
machine. About half a millisecond of polling is as fast as the default there and harmless elsewhere.

Measured (`benchmarks/threads.py`; two cores, 224 x 224, 16 samples, a network like MobileNetV2; medians of a step, 1.00
is the best): polling as chosen here 1.00 to 1.02, torch's default 1.01, torch on one thread 1.04, PASSIVE waiting 1.12,
ACTIVE waiting 1.5. With one core taken by another process 1.7, 1.8, 1.6; on a machine with five busy processes torch's
default made a step 6.5 times slower, short polling 1.05 times. At 64 x 64 torch is best on one thread, by 5 to 10 %.

OpenMP reads its environment once, when torch is imported, so this module sets it when it is imported itself and has to
come before torch. What the user has set already is left alone. Imports the standard library only.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

from advsearch.errors import InputError

OPENMP_DEFAULTS = {"GOMP_SPINCOUNT": "10000", "KMP_BLOCKTIME": "1"}
"""How long an idle worker polls: in rounds for GNU OpenMP (torch on Linux), in ms for LLVM's and Intel's (macOS)."""

_CPU_MAX = Path("/sys/fs/cgroup/cpu.max")
_USERS_COUNT = os.environ.get("OMP_NUM_THREADS", "")

if "OMP_WAIT_POLICY" not in os.environ:  # the user's wish, which the others would overrule
    for _name, _value in OPENMP_DEFAULTS.items():
        os.environ.setdefault(_name, _value)

_chosen: int | None = None


def cores(quota: Path = _CPU_MAX) -> int:
    """The number of cores this process may use: those it is pinned to, and no more than a container's quota allows.

    Args:
        quota: the file with the quota and its period in microseconds (control groups, version 2).
    """
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        limit, period = quota.read_text(encoding="ascii").split()
        allowed = min(allowed, max(1, round(int(limit) / int(period))))
    except (OSError, ValueError):  # no control groups, or "max": no quota
        pass
    return allowed


def configure(threads: int | None = None) -> int:
    """Give torch and Dr.Jit the same number of threads, now and (Dr.Jit) when Mitsuba is imported later.

    The pools take turns, so both get all of them: halving them makes each half as fast and wins nothing.

    Args:
        threads: how many, at least 1; None means what ``OMP_NUM_THREADS`` said when this module was imported, and
            without it every core that this process may use.

    Returns:
        The number that was set.

    Raises:
        InputError: fewer than one thread was asked for.
    """
    global _chosen
    if threads is not None and threads < 1:
        raise InputError(f"threads: expected a number of at least 1, got {threads}")
    _chosen = threads if threads is not None else _default()
    os.environ["OMP_NUM_THREADS"] = str(_chosen)  # for a torch that is imported later
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(_chosen)
    if "drjit" in sys.modules:
        apply_to_drjit()
    return _chosen


def apply_to_drjit() -> None:
    """Set the size of Dr.Jit's pool to what `configure` chose, or to every core. Called after Mitsuba was imported."""
    drjit = sys.modules["drjit"]
    wanted = _chosen if _chosen is not None else _default()
    if drjit.thread_count() != wanted:
        drjit.set_thread_count(wanted)


def _default() -> int:
    return int(_USERS_COUNT) if _USERS_COUNT.isdecimal() and int(_USERS_COUNT) > 0 else cores()
