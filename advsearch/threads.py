"""Set the numbers of threads of torch and Dr.Jit, so that they do not compete for
cores.

By default, idle OpenMP threads of torch wait in a busy loop, and occupy the cores that
others need. Here they sleep instead. After a render Dr.Jit's workers are busy for a
while, too. So torch gets half of the cores, and all of them only if nothing is rendered
(training).

OpenMP reads its environment variables once, when torch is imported, so this module must
be imported before torch, and imports the standard library only. Variables that the user
has set are not changed.
"""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from advsearch.errors import InputError

OPENMP_DEFAULTS = {"OMP_WAIT_POLICY": "PASSIVE", "KMP_BLOCKTIME": "0"}
"""Environment variables with which idle threads sleep: the first one for GNU OpenMP
(torch on Linux), the second one for the OpenMP of LLVM and Intel (macOS).
"""
_CPU_MAX = Path("/sys/fs/cgroup/cpu.max")
_CPU_INFO = Path("/proc/cpuinfo")
# The number of threads that the user has set; empty if there is none. It is read here,
# since `configure` changes the variable later.
_USERS_COUNT = os.environ.get("OMP_NUM_THREADS", "")

# A user who has set this variable has chosen how threads wait.
if "GOMP_SPINCOUNT" not in os.environ:
    for _name, _value in OPENMP_DEFAULTS.items():
        os.environ.setdefault(_name, _value)

# The number of threads that `configure` has set; None before its first call.
_chosen: int | None = None


def count_cores(quota: Path = _CPU_MAX) -> int:
    """Return how many cores this process may use.

    They are the cores to which it is pinned, but no more than the quota of a container
    allows.

    Args:
        quota: file of Linux's control groups (version 2) with two numbers: the
            processor time that is allowed in each period, and the period, both in
            microseconds.
    """
    if hasattr(os, "sched_getaffinity"):
        allowed = len(os.sched_getaffinity(0))
    else:
        allowed = os.cpu_count() or 1
    try:
        limit, period = quota.read_text(encoding="ascii").split()
        allowed = min(allowed, max(1, round(int(limit) / int(period))))
    except (OSError, ValueError):  # no control groups, or "max": no quota
        pass
    return allowed


def read_processor_name(cpu_info: Path = _CPU_INFO) -> str:
    """Return the name of the processor; "unknown" if the system does not state it.

    Args:
        cpu_info: file in which Linux describes the processor. If it has no name, that
            of Python's `platform` is returned.
    """
    try:
        for line in cpu_info.read_text(encoding="utf-8", errors="replace").splitlines():
            key, _, value = line.partition(":")
            if key.strip().lower() == "model name" and value.strip():
                return " ".join(value.split())
    except OSError:
        pass
    return platform.processor() or platform.machine() or "unknown"


# A file of another person may request any number of threads. With more than a few per
# core they only wait for each other.
MAX_THREADS_PER_CORE = 4


def configure(threads: int | None = None, *, rendering: bool = True) -> int:
    """Set the threads of Dr.Jit and torch, and return how many Dr.Jit gets.

    Torch gets half as many, or as many if nothing is rendered. For a library that is
    not imported yet, the number takes effect when it is imported.

    Args:
        threads: number of threads for Dr.Jit, at most `MAX_THREADS_PER_CORE` for each
            core. None stands for the value of OMP_NUM_THREADS when this module was
            imported; if it was not set, for the number of cores.
        rendering: whether images are rendered.

    Raises:
        InputError: `threads` is less than 1.
    """
    global _chosen
    if threads is not None and threads < 1:
        raise InputError(f"threads: expected a number of at least 1, got {threads}")
    requested = threads if threads is not None else _get_default()
    _chosen = min(requested, MAX_THREADS_PER_CORE * count_cores())
    # Dr.Jit's workers still occupy their cores for a while after a render.
    for_torch = _chosen
    if rendering:
        for_torch = max(1, _chosen // 2)
    _set_torch_threads(for_torch)
    if "drjit" in sys.modules:
        apply_to_drjit()
    return _chosen


def _set_torch_threads(count: int) -> None:
    """Set the number of torch's threads, now or for when it is imported."""
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(count)
    else:
        # Torch reads the variable when it is imported. It is only set before that,
        # because child processes inherit it.
        os.environ["OMP_NUM_THREADS"] = str(count)


@contextmanager
def restore_threads() -> Iterator[None]:
    """Restore the numbers of threads of torch and Dr.Jit after the block.

    A library that was imported inside of the block gets the default number.
    """
    global _chosen
    chosen_before = _chosen
    # each is None if the library is not imported yet
    torch = sys.modules.get("torch")
    torch_threads = None if torch is None else torch.get_num_threads()
    drjit = sys.modules.get("drjit")
    drjit_threads = None if drjit is None else drjit.thread_count()
    try:
        yield
    finally:
        _chosen = chosen_before
        if "torch" in sys.modules:
            sys.modules["torch"].set_num_threads(torch_threads or _get_default())
        _restore_drjit_threads(drjit, drjit_threads)


def _restore_drjit_threads(drjit: Any, n_threads: int | None) -> None:
    """Give Dr.Jit the number of threads that it had.

    Args:
        drjit: the module; None if it was not imported then.
        n_threads: the number of threads; None if it was not imported.
    """
    if drjit is not None:
        if drjit.thread_count() != n_threads:
            drjit.set_thread_count(n_threads)
    elif "drjit" in sys.modules:  # imported meanwhile
        apply_to_drjit()


@contextmanager
def all_for_torch() -> Iterator[None]:
    """Give torch all threads inside of the block, in which nothing is rendered.

    Training then takes half the time.
    """
    configure(_chosen, rendering=False)
    try:
        yield
    finally:
        configure(_chosen)


def apply_to_drjit() -> None:
    """Set the number of threads of Dr.Jit, which must be imported.

    It is the number that `configure` has set, or else the default.
    """
    drjit = sys.modules["drjit"]
    n_threads = _chosen if _chosen is not None else _get_default()
    if drjit.thread_count() != n_threads:
        drjit.set_thread_count(n_threads)


def _get_default() -> int:
    """Return the number of threads that the user has set by OMP_NUM_THREADS, or else
    the number of cores that this process may use.
    """
    if _USERS_COUNT.isdecimal() and int(_USERS_COUNT) > 0:
        return int(_USERS_COUNT)
    return count_cores()
