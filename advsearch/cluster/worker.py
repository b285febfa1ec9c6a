"""What runs on a worker. It gets ready for a work once, then carries out batches of it; it never sees the store.

Errors go back as values: an exception of ours may not survive being pickled, and says more than its class.
"""

from __future__ import annotations

import importlib
import os
import stat
import tempfile
import threading
import time
import traceback
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from advsearch import threads  # before torch: it sets how OpenMP waits
from advsearch.cluster.executor import Call, Work
from advsearch.cluster.inputs import Files, MissingError, write_files
from advsearch.cluster.machine import MachineInfo, this_machine, version
from advsearch.errors import AdvsearchError, EnvironmentSetupError, StorageError

MOST_LOADED = 2
"""Works that a worker holds; the one that was not used for longest goes."""

KERNELS, INPUTS = "kernels", "inputs"
"""Folders below the machine's own: Dr.Jit's kernels, and files that were sent."""

_loaded: OrderedDict[str, Call] = OrderedDict()
_known: dict[str, Work] = {}
_one_at_a_time = threading.Lock()


@dataclass(frozen=True)
class Ready:
    """A worker is ready.

    Attributes:
        machine: what it runs on.
        seconds: that it took.
    """

    machine: MachineInfo
    seconds: float


@dataclass(frozen=True)
class Carried:
    """A batch was carried out.

    Attributes:
        value: what came of it.
        seconds: that it took.
    """

    value: Any
    seconds: float


@dataclass(frozen=True)
class Failure:
    """Something went wrong.

    Attributes:
        text: what, as a user reads it.
        unfit: whether the worker is at fault and another one may do it.
        forgotten: whether the worker has not got ready, or not any more.
        missing: whether it lacks files.
        trace: of what is a bug; empty for an error that a user can put right.
    """

    text: str
    unfit: bool = False
    forgotten: bool = False
    missing: bool = False
    trace: str = ""


def prepare(key: str, work: Work, files: Files, asked: str) -> Ready | Failure:
    """Get ready for a work.

    Args:
        key: of the work.
        work: what is to be done.
        files: that it needs.
        asked: the version of advsearch that asks.
    """
    begun = time.perf_counter()
    if version() != asked:
        return Failure(f"it has advsearch {version()}, and {asked} asks; install the same on both", unfit=True)
    try:
        with _one_at_a_time:
            if key not in _loaded:
                own = own_folder()
                if "DRJIT_CACHE_DIR" not in os.environ:
                    (own / KERNELS).mkdir(exist_ok=True)
                    os.environ["DRJIT_CACHE_DIR"] = str(own / KERNELS)
                this_machine()
                _load(key, write_files(work, files, own / INPUTS))
            machine = this_machine()
    except MissingError as error:
        return Failure(f"it lacks {error}", missing=True)
    except Exception as error:
        return _failure(error, unfit=isinstance(error, (EnvironmentSetupError, StorageError, OSError, ImportError)))
    return Ready(machine, time.perf_counter() - begun)


def carry_out_batch(key: str, items: Sequence[Any]) -> Carried | Failure:
    """Carry out a batch of a work that this worker is ready for."""
    begun = time.perf_counter()
    try:
        with _one_at_a_time:
            if key not in _known:
                return Failure("it is not ready", forgotten=True)
            value = _load(key, _known[key])(items)
    except Exception as error:
        return _failure(error, unfit=isinstance(error, (OSError, StorageError)))
    return Carried(value, time.perf_counter() - begun)


def own_folder() -> Path:
    """Return a folder on this machine's disk that only this user can write to; it outlives the worker."""
    folder = Path(tempfile.gettempdir()) / f"advsearch-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    found = folder.lstat()
    mine = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022
    return folder if mine else Path(tempfile.mkdtemp(prefix="advsearch-"))


def _load(key: str, work: Work) -> Call:
    """Return what carries out a work, loaded if it is not; where several runs share a worker, each has its turn."""
    if key not in _loaded:
        threads.configure(work.threads)
        module, _, name = work.function.partition(":")
        make: Callable[[Any], Call] = getattr(importlib.import_module(module), name)
        _loaded[key], _known[key] = make(work.settings), work
        while len(_loaded) > MOST_LOADED:
            _loaded.popitem(last=False)
    _loaded.move_to_end(key)
    return _loaded[key]


def _failure(error: Exception, *, unfit: bool) -> Failure:
    ours = isinstance(error, AdvsearchError) or unfit
    text = str(error) if isinstance(error, AdvsearchError) else f"{type(error).__name__}: {error}"
    return Failure(text, unfit, trace="" if ours else traceback.format_exc())
