"""The functions that run on a worker: they load a task and compute its batches.

A task is loaded with its first batch. Errors are returned as values, since an exception
may not survive being pickled. Workers that lack the files of a task get them from the
main process. With a mesh they get the files of its directory, and of directories below,
that may be parts of a scene.
"""

from __future__ import annotations

import faulthandler
import hashlib
import json
import os
import pickle
import platform
import re
import stat
import tempfile
import threading
import time
import traceback
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from enum import Enum, auto
from functools import cache
from importlib import metadata
from pathlib import Path
from queue import SimpleQueue
from typing import IO, Any, TypeAlias

from advsearch import threads  # before torch: it sets how OpenMP waits
from advsearch.cluster import BatchFunction, WorkerTask
from advsearch.errors import (
    AdvsearchError,
    EnvironmentSetupError,
    InputError,
    StorageError,
)
from advsearch.files import split_paths
from advsearch.registry import load_attribute
from advsearch.scene.mitsuba_backend.llvm import ensure_llvm
from advsearch.trust.code import allow_code
from advsearch.trust.named_files import is_inside

# Packages whose versions may change the last bits of a result.
PACKAGES = ("mitsuba", "drjit", "torch", "numpy")

MachineInfo = dict[str, str]


@cache
def describe_machine() -> MachineInfo:
    """Return the properties of this machine on which last bits of results depend.

    Renders and predictions on two machines are equal in every bit only if the
    processor, LLVM and the versions of `PACKAGES` are the same.

    Raises:
        EnvironmentSetupError: there is no libLLVM.
    """
    llvm = ".".join(map(str, ensure_llvm().version))
    return {
        "processor": threads.read_processor_name(),
        "LLVM": llvm,
        **{name: _version(name) for name in PACKAGES},
    }


def digest_machine(machine: MachineInfo) -> str:
    """Return a short digest that names a machine."""
    return hashlib.sha256(json.dumps(machine, sort_keys=True).encode()).hexdigest()[:8]


@cache
def compute_version() -> str:
    """Return the version of advsearch with a digest of its source files.

    Workers compare it, since versions in development may differ under one number.
    """
    digest = hashlib.sha256()
    root = Path(__file__).resolve().parents[1]
    for path in sorted(root.rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode())
        digest.update(b"\0" + path.read_bytes())
    return f"{_version('advsearch')}+{digest.hexdigest()[:8]}"


def _version(package: str) -> str:
    """Return the version of an installed package; "unknown" if it is none."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "unknown"


REFERRED_SUFFIXES = {
    ".obj": (".mtl",),
    ".gltf": (".bin",),
    ".xml": (".obj", ".ply", ".serialized", ".exr", ".hdr"),
}
"""Suffixes of files that refer to other files, with the suffixes of the other files.
All of them may also refer to images.
"""

ENVIRONMENT_SUFFIXES = (".glb", ".gltf", ".bin", ".exr", ".hdr")
"""Suffixes of files that the YAML file of an environment may name, in addition to
images.
"""

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tga", ".tif", ".tiff")

MAX_SENT_BYTES = 1 << 30


class MissingFilesError(Exception):
    """Raised if a file exists neither at its path nor among those that were sent."""


def read_files(task: WorkerTask) -> dict[str, bytes]:
    """Read the files that a task needs, to send them to workers on other machines.

    These are the files that its settings name, and the files next to them to which they
    may refer, such as the textures of a mesh.

    Args:
        task: the task; `task.path_setting_names` are the settings that name files.

    Returns:
        Contents by absolute path.

    Raises:
        InputError: the files together are too large to be sent.
    """
    contents: dict[str, bytes] = {}
    for name in task.path_setting_names:
        value = task.settings.get(name)
        # paths, and the text between them, which is no absolute path of a file
        parts = _split_paths(value) if isinstance(value, str) else ()
        for part in parts:
            path = Path(part)
            if path.is_absolute() and path.is_file():
                contents |= _read_with_neighbors(name, path)
    _check_sent_size(contents)
    return contents


def _check_sent_size(contents: Mapping[str, bytes]) -> None:
    """Check that files, with their contents by path, are small enough to be sent.

    Raises:
        InputError: together they are too large.
    """
    size = sum(map(len, contents.values()))
    if size > MAX_SENT_BYTES:
        raise InputError(
            f"cluster: the files of the scene and the model have {size >> 20} MiB, and "
            f"{MAX_SENT_BYTES >> 20} can be sent; put them in a folder that all "
            "workers see, each under the same path"
        )


def _read_with_neighbors(setting: str, path: Path) -> dict[str, bytes]:
    """Read a file, and the files in its directory that it may refer to; by path.

    Args:
        setting: name of the setting that names the file.
        path: path of the file.
    """
    suffix = path.suffix.lower()
    suffixes: tuple[str, ...] = REFERRED_SUFFIXES.get(suffix, ())
    # A YAML file of an environment refers to other files; other YAML files do not.
    if setting == "environment" and suffix in (".yaml", ".yml"):
        suffixes = ENVIRONMENT_SUFFIXES
    contents = {str(path): path.read_bytes()}
    if not suffixes:
        return contents
    for file in sorted(path.parent.rglob("*")):
        may_be_named = file.suffix.lower() in (*suffixes, *PICTURE_SUFFIXES)
        # A link to a file outside of the directory is not followed.
        if may_be_named and file.is_file() and is_inside(file, path.parent):
            contents[str(file)] = file.read_bytes()
    return contents


def compute_digests(contents: Mapping[str, bytes]) -> dict[str, str]:
    """Return the SHA-256 of each file by path."""
    return {path: hashlib.sha256(data).hexdigest() for path, data in contents.items()}


def locate_sent_files(digests: Mapping[str, str], folder: Path) -> dict[str, Path]:
    """Return where files that were sent are stored on a worker, by original path.

    Each set of files has a separate directory below `INPUTS`, named by a digest of the
    set. The files have the same paths below it as on the sending machine, so that
    relative names in them stay valid.

    Args:
        digests: digests of the files by their original paths.
        folder: directory of the worker.
    """
    # 32 hexadecimal digits are 128 bits, enough for no two sets to have one name.
    name = hashlib.sha256(json.dumps(sorted(digests.items())).encode()).hexdigest()[:32]
    return {
        path: folder / INPUTS / name / Path(path).relative_to(Path(path).anchor)
        for path in digests
    }


def write_files(contents: Mapping[str, bytes], folder: Path) -> None:
    """Write files that were sent, each in one step, so that other workers on this
    machine never see half of one.

    Args:
        contents: contents of the files by their original paths.
        folder: directory of the worker.
    """
    paths = locate_sent_files(compute_digests(contents), folder)
    for name, data in contents.items():
        path = paths[name]
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f"{path.name}.part-{os.getpid()}")
        temporary.write_bytes(data)
        temporary.replace(path)


def resolve_files(task: WorkerTask, folder: Path) -> WorkerTask:
    """Return the task with paths that are valid on this machine.

    If all files of the task exist here under their original paths, the task is returned
    unchanged. Otherwise its paths become those of the files that were sent.

    Args:
        task: the task, with the digests of its files.
        folder: directory of the worker.

    Raises:
        MissingFilesError: a file is missing in both places, or has other content.
    """
    if all(_has_digest(Path(path), digest) for path, digest in task.digests.items()):
        return task
    local_paths = locate_sent_files(task.digests, folder)
    for path, digest in task.digests.items():
        if not _has_digest(local_paths[path], digest):
            raise MissingFilesError(path)
    return _replace_paths(task, local_paths)


def _replace_paths(task: WorkerTask, local_paths: Mapping[str, Path]) -> WorkerTask:
    """Return a task whose settings have the paths of files on this machine.

    Args:
        task: the task.
        local_paths: the local path of each file by its original path.
    """
    settings = dict(task.settings)
    for name in task.path_setting_names:
        value = settings.get(name)
        if isinstance(value, str):
            # A part that is no path, such as a comma, is not changed.
            parts = [str(local_paths.get(part, part)) for part in _split_paths(value)]
            settings[name] = "".join(parts)
    return replace(task, settings=settings)


def _has_digest(path: Path, digest: str) -> bool:
    """Return whether a file exists and has a SHA-256."""
    return path.is_file() and hashlib.sha256(path.read_bytes()).hexdigest() == digest


def _split_paths(value: str) -> Iterator[str]:
    """Split the value of a setting into paths and the text between them.

    ``/a.glb#NODE,/b.obj`` gives ``/a.glb``, ``#NODE``, ``,`` and ``/b.obj``. A pair of
    motion paths ``/camera.csv+/object.csv`` gives the two paths and ``+``. There may be
    empty parts. Joined, the parts are the value without spaces around its commas.
    """
    for entry_or_comma in re.split("(,)", value):
        entry, mark, node = entry_or_comma.strip().partition("#")
        first_path, *second_path = split_paths(entry)
        yield first_path
        if second_path:  # motion paths, which have no nodes
            yield "+"
            yield from second_path
        else:
            yield mark + node


# Maximum number of tasks that a worker caches. The least recently used one is dropped.
MAX_LOADED = 2
# Seconds that loading may take. A batch may take as long while too few have finished to
# know the median.
LOAD_DEADLINE = 900.0
# Directories of a worker: for Dr.Jit's compiled kernels, and for files that were sent.
KERNELS = "kernels"
INPUTS = "inputs"

_loaded: OrderedDict[str, BatchFunction] = OrderedDict()
_batch_lock = threading.Lock()


class Failure(Enum):
    """The reason why a worker returned no result."""

    # The worker cannot do the task, for instance without libLLVM or a package, or with
    # a full disk. Another worker may be able to.
    UNFIT = auto()
    MISSING_FILES = auto()  # the worker lacks files of the task
    INPUT = auto()  # an error that the user can correct
    BUG = auto()  # any other error; its text is a traceback


@dataclass(frozen=True)
class Reply:
    """The reply of a worker to a batch."""

    value: Any = None
    seconds: float = 0.0  # seconds that computing the batch took
    loading_seconds: float = 0.0  # seconds that loading the task took before
    machine: MachineInfo = field(default_factory=dict)
    worker: str = ""
    failure: Failure | None = None
    error: str = ""


def run_batch(task: WorkerTask, items: Sequence[Any], deadline: float) -> Reply:
    """Compute a batch of a task, and return the result with its times, or the failure.

    The task is loaded if it is not cached. If loading takes over `LOAD_DEADLINE`
    seconds, or computing over `deadline`, the process writes a traceback to its error
    output and ends itself, even if native code hangs.

    Args:
        task: function and settings.
        items: items of the batch, such as configurations to render.
        deadline: seconds that computing may take.
    """
    worker = f"{platform.node()}, process {os.getpid()}"
    try:
        # If this process has several threads, they compute one batch at a time.
        with _batch_lock:
            start = time.perf_counter()
            with kill_after(LOAD_DEADLINE):
                call = load_task(task)
            loading = time.perf_counter() - start
            with kill_after(deadline):
                value = call(items)
            seconds = time.perf_counter() - start - loading
        return Reply(value, seconds, loading, describe_machine(), worker)
    except Exception as error:
        failure, text = _describe_failure(error)
        return Reply(worker=worker, failure=failure, error=text)


def _describe_failure(error: Exception) -> tuple[Failure, str]:
    """Return the kind of a failure, and the text for the user.

    Call it in the `except` block of the error, since it may format the traceback.
    """
    if isinstance(error, MissingFilesError):
        return Failure.MISSING_FILES, f"it lacks {error}"
    # The machine lacks software such as LLVM, or its disk is full: another worker may
    # be able to do the task.
    if isinstance(error, (EnvironmentSetupError, StorageError)):
        return Failure.UNFIT, str(error)
    # Any other error of this kind is about the input of the user.
    if isinstance(error, AdvsearchError):
        return Failure.INPUT, str(error)
    # A file or a package is missing, for instance.
    if isinstance(error, (OSError, ImportError)):
        return Failure.UNFIT, f"{type(error).__name__}: {error}"
    return Failure.BUG, traceback.format_exc()


@contextmanager
def kill_after(seconds: float) -> Iterator[None]:
    """End this process, with a traceback, if the block takes longer."""
    faulthandler.dump_traceback_later(seconds, exit=True, file=2)  # the error output
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()


def load_task(task: WorkerTask) -> BatchFunction:
    """Return the function that computes batches of a task, from the cache if possible.

    Loading reads the scene and the model, and sets the number of threads.

    Raises:
        MissingFilesError: this machine lacks files of the task.
    """
    key = _make_task_key(task)
    if key in _loaded:
        _loaded.move_to_end(key)
        return _loaded[key]
    folder = make_private_directory()
    _set_kernel_cache(folder)
    # Called for its error only: without libLLVM it raises before anything is loaded.
    describe_machine()
    # The user allowed this code to run in the main process.
    allow_code(*task.allowed_modules)
    task = resolve_files(task, folder)
    threads.configure(task.threads)
    make_function: Callable[[Any], BatchFunction] = load_attribute(task.function_path)
    # The least recently used function is dropped before another is loaded, so that both
    # do not need memory at the same time.
    while len(_loaded) >= MAX_LOADED:
        _loaded.popitem(last=False)
    _loaded[key] = make_function(task.settings)
    return _loaded[key]


def _set_kernel_cache(folder: Path) -> None:
    """Set the directory of Dr.Jit's compiled kernels, unless the user chose it.

    All workers of a user share one.

    Args:
        folder: directory of the workers of this user.
    """
    if "DRJIT_CACHE_DIR" not in os.environ:
        (folder / KERNELS).mkdir(exist_ok=True)
        os.environ["DRJIT_CACHE_DIR"] = str(folder / KERNELS)


def _make_task_key(task: WorkerTask) -> str:
    """Return a digest of everything on which the results of a loaded task depend."""
    described = [
        task.function_path,
        task.settings,
        task.threads,
        task.allowed_modules,
        sorted(task.digests.items()),
    ]
    return hashlib.sha256(json.dumps(described, sort_keys=True).encode()).hexdigest()


def make_private_directory() -> Path:
    """Return a directory on this machine that only this user can write to.

    All workers of the user have the same one, and it stays after they end. If somebody
    else created it first, or can write to it, a new directory is created instead: files
    and kernels in it would not be safe.
    """
    folder = Path(tempfile.gettempdir()) / f"advsearch-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    status = folder.lstat()
    is_private = (
        stat.S_ISDIR(status.st_mode)
        and status.st_uid == os.getuid()
        and not status.st_mode & 0o022  # neither the group nor others may write
    )
    return folder if is_private else Path(tempfile.mkdtemp(prefix="advsearch-"))


# Environment variable that is set in a process that runs `serve`.
SERVE_VARIABLE = "ADVSEARCH_WORKER"
# Calls that were received: a function and its arguments.
CallQueue: TypeAlias = "SimpleQueue[tuple[Callable[..., Any], tuple[Any, ...]]]"


def serve() -> None:
    """Run the calls that the parent process sends, until the parent ends.

    This is the main function of a worker process. A call is a pickled pair (function,
    arguments) on standard input; its pickled result is written to standard output.
    """
    # The pipes of the calls get new descriptors. Then other code reads an empty input
    # (0), and its output (1) goes to the error output (2), so that it cannot disturb
    # the calls.
    calls = os.fdopen(os.dup(0), "rb")
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(2, 1)
    received: CallQueue = SimpleQueue()
    threading.Thread(
        target=_receive_calls, args=(calls, received), name="calls", daemon=True
    ).start()
    while True:
        function, args = received.get()
        pickle.dump(function(*args), answers)
        answers.flush()


def _receive_calls(calls: IO[bytes], received: CallQueue) -> None:
    """Receive calls, and end the process when the parent has ended.

    Args:
        calls: stream of pickled calls.
        received: queue to which they are added.
    """
    try:
        while True:
            received.put(pickle.load(calls))
    except (EOFError, OSError):  # the parent process has gone
        os._exit(0)  # also in the middle of a batch: its result has no reader
