"""What runs on a worker: it loads a task with its first batch. Errors go back as
values, as they may not survive being pickled. Files that a task needs are sent to
workers that lack them; with a mesh goes its folder, files in it and below of the kinds
that a scene consists of.
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
from typing import Any

from advsearch import threads  # before torch: it sets how OpenMP waits
from advsearch.cluster import Call, WorkerTask
from advsearch.errors import (
    AdvsearchError,
    EnvironmentSetupError,
    InputError,
    StorageError,
)
from advsearch.files import split_paths
from advsearch.registry import imported
from advsearch.scene.mitsuba_backend.llvm import ensure_llvm
from advsearch.trust.code import allow_code
from advsearch.trust.named_files import is_inside

PACKAGES = ("mitsuba", "drjit", "torch", "numpy")  # whose versions decide last bits

MachineInfo = dict[str, str]


@cache
def this_machine() -> MachineInfo:
    llvm = ".".join(map(str, ensure_llvm().version))
    return {
        "processor": threads.read_processor_name(),
        "LLVM": llvm,
        **{name: _version(name) for name in PACKAGES},
    }


def machine_name(machine: MachineInfo) -> str:
    return hashlib.sha256(json.dumps(machine, sort_keys=True).encode()).hexdigest()[:8]


@cache
def version() -> str:
    """Return the version of advsearch, with a few digits of what its files say, which
    no version number tells.
    """
    digest = hashlib.sha256()
    folder = Path(__file__).resolve().parents[1]
    for path in sorted(folder.rglob("*.py")):
        digest.update(
            path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes()
        )
    return f"{_version('advsearch')}+{digest.hexdigest()[:8]}"


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "unknown"


WITH_OTHERS = {
    ".obj": (".mtl",),
    ".gltf": (".bin",),
    ".xml": (".obj", ".ply", ".serialized", ".exr", ".hdr"),
}
"""Files that name others, and what these end in beside pictures."""

OF_A_PLACE = (".glb", ".gltf", ".bin", ".exr", ".hdr")
"""What files end in that the YAML file of a place may name, beside pictures."""

PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tga", ".tif", ".tiff")

LARGEST = 1 << 30


class MissingFilesError(Exception):
    """A file is neither where the settings say nor among those that were sent
    before.
    """


def read_files(task: WorkerTask) -> dict[str, bytes]:
    """Read the files that a task's settings name, and those beside them, by their
    paths.
    """
    contents: dict[str, bytes] = {}
    for name in task.files:
        value = task.settings.get(name)
        for part in _split(value) if isinstance(value, str) else ():
            path = Path(part)
            if path.is_absolute() and path.is_file():
                is_place = name == "environment" and path.suffix.lower() in (
                    ".yaml",
                    ".yml",
                )
                kinds = (
                    OF_A_PLACE if is_place else WITH_OTHERS.get(path.suffix.lower(), ())
                )
                others = sorted(path.parent.rglob("*")) if kinds else []
                beside = [
                    file
                    for file in others
                    if file.suffix.lower() in (*kinds, *PICTURES) and file.is_file()
                ]
                # no link leads elsewhere
                inside = [file for file in beside if is_inside(file, path.parent)]
                contents |= {str(file): file.read_bytes() for file in (path, *inside)}
    size = sum(map(len, contents.values()))
    if size > LARGEST:
        raise InputError(
            f"cluster: the files of the scene and the model have {size >> 20} MiB, and "
            f"{LARGEST >> 20} can be "
            "sent; put them in a folder that all workers see, each under the same path"
        )
    return contents


def file_digests(contents: Mapping[str, bytes]) -> dict[str, str]:
    return {path: hashlib.sha256(data).hexdigest() for path, data in contents.items()}


def sent_paths(digests: Mapping[str, str], folder: Path) -> dict[str, Path]:
    """Return where files that are sent stand below a folder, by their paths; each set
    of files has its own.
    """
    name = hashlib.sha256(json.dumps(sorted(digests.items())).encode()).hexdigest()[:32]
    return {
        path: folder / name / Path(path).relative_to(Path(path).anchor)
        for path in digests
    }


def write_files(contents: Mapping[str, bytes], folder: Path) -> None:
    """Write files that were sent, each whole or not at all."""
    paths = sent_paths(file_digests(contents), folder)
    for name, data in contents.items():
        paths[name].parent.mkdir(parents=True, exist_ok=True)
        part = paths[name].with_name(f"{paths[name].name}.part-{os.getpid()}")
        part.write_bytes(data)
        part.replace(paths[name])


def find_files(task: WorkerTask, folder: Path) -> WorkerTask:
    """Return the task with paths that hold here: its own where all its files are here,
    or else those below a folder to which they were sent. Raises MissingFilesError.
    """
    if all(_is(Path(path), digest) for path, digest in task.digests.items()):
        return task
    here = sent_paths(task.digests, folder)
    for path, digest in task.digests.items():
        if not _is(here[path], digest):
            raise MissingFilesError(path)
    settings = dict(task.settings)
    for name in task.files:
        value = settings.get(name)
        if isinstance(value, str):
            settings[name] = "".join(
                str(here.get(part, part)) for part in _split(value)
            )
    return replace(task, settings=settings)


def _is(path: Path, digest: str) -> bool:
    return path.is_file() and hashlib.sha256(path.read_bytes()).hexdigest() == digest


def _split(value: str) -> Iterator[str]:
    """Take ``/a.glb#NODE,/b.obj`` or ``/camera.csv+/object.csv`` apart into paths and
    what stands between them.
    """
    for part in re.split("(,)", value):
        path, mark, inner = part.strip().partition("#")
        first, *second = split_paths(path)
        yield first
        yield from ("+", *second) if second else (mark + inner,)


# tasks that a worker keeps loaded; the one that was not used for longest goes
MAX_LOADED = 2
# seconds that loading may take, and a batch before there is a median
LOAD_DEADLINE = 900.0
# folders below the machine's own: Dr.Jit's kernels, and files that were sent
KERNELS = "kernels"
INPUTS = "inputs"

_loaded: OrderedDict[str, Call] = OrderedDict()
_one_at_a_time = threading.Lock()


class Failure(Enum):
    """Why a worker has no result."""

    UNFIT = auto()  # another worker may do it
    MISSING_FILES = auto()  # it has not got the files of the task
    INPUT = auto()  # a user can mend it
    BUG = auto()  # the error is a traceback


@dataclass(frozen=True)
class Reply:
    """What a worker says of a batch."""

    value: Any = None
    seconds: float = 0.0  # that the batch took, and that loading took before it
    loading: float = 0.0
    machine: MachineInfo = field(default_factory=dict)
    worker: str = ""
    failure: Failure | None = None
    error: str = ""


def run_batch(task: WorkerTask, items: Sequence[Any], deadline: float) -> Reply:
    """Do a batch of a task, which is loaded before unless it is already.

    After `deadline` seconds, or `LOAD_DEADLINE` of loading, the process ends, whatever
    native code it hangs in, and writes to its error output where that was.
    """
    worker = f"{platform.node()}, process {os.getpid()}"
    try:
        with _one_at_a_time:
            start = time.perf_counter()
            with ended_after(LOAD_DEADLINE):
                call = load_task(task)
            loading = time.perf_counter() - start
            with ended_after(deadline):
                value = call(items)
            seconds = time.perf_counter() - start - loading
        return Reply(value, seconds, loading, this_machine(), worker)
    except MissingFilesError as error:
        return Reply(
            worker=worker, failure=Failure.MISSING_FILES, error=f"it lacks {error}"
        )
    except (EnvironmentSetupError, StorageError) as error:
        return Reply(worker=worker, failure=Failure.UNFIT, error=str(error))
    except AdvsearchError as error:
        return Reply(worker=worker, failure=Failure.INPUT, error=str(error))
    except (OSError, ImportError) as error:
        return Reply(
            worker=worker,
            failure=Failure.UNFIT,
            error=f"{type(error).__name__}: {error}",
        )
    except Exception:
        return Reply(worker=worker, failure=Failure.BUG, error=traceback.format_exc())


@contextmanager
def ended_after(seconds: float) -> Iterator[None]:
    """End this process if the block takes longer."""
    faulthandler.dump_traceback_later(seconds, exit=True, file=2)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()


def load_task(task: WorkerTask) -> Call:
    """Return what does batches of a task. Raises MissingFilesError."""
    key = task_key(task)
    if key in _loaded:
        _loaded.move_to_end(key)
        return _loaded[key]
    folder = own_folder()
    if "DRJIT_CACHE_DIR" not in os.environ:
        (folder / KERNELS).mkdir(exist_ok=True)
        os.environ["DRJIT_CACHE_DIR"] = str(folder / KERNELS)
    this_machine()  # without libLLVM nothing is loaded
    allow_code(*task.code)
    task = find_files(task, folder / INPUTS)
    threads.configure(task.threads)
    make: Callable[[Any], Call] = imported(task.function)
    while len(_loaded) >= MAX_LOADED:
        _loaded.popitem(last=False)
    _loaded[key] = make(task.settings)
    return _loaded[key]


def task_key(task: WorkerTask) -> str:
    """Return what tells a task from others."""
    described = [
        task.function,
        task.settings,
        task.threads,
        task.code,
        sorted(task.digests.items()),
    ]
    return hashlib.sha256(json.dumps(described, sort_keys=True).encode()).hexdigest()


def own_folder() -> Path:
    """Return a folder on this machine's disk that only this user can write to; it
    outlives the worker.
    """
    folder = Path(tempfile.gettempdir()) / f"advsearch-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    facts = folder.lstat()
    mine = (
        stat.S_ISDIR(facts.st_mode)
        and facts.st_uid == os.getuid()
        and not facts.st_mode & 0o022
    )
    return folder if mine else Path(tempfile.mkdtemp(prefix="advsearch-"))


SERVING = "ADVSEARCH_WORKER"  # environment variable of a process that `serve`s


def serve() -> None:
    """Answer the calls that the process writes which has started this one, a pickled
    pair (function, arguments) each, until it goes.
    """
    calls = os.fdopen(os.dup(0), "rb")
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(2, 1)  # what code of others prints is no answer
    asked: SimpleQueue[tuple[Callable[..., Any], tuple[Any, ...]]] = SimpleQueue()

    def listen() -> None:
        try:
            while True:
                asked.put(pickle.load(calls))
        except (EOFError, OSError):
            os._exit(0)  # also in the middle of a batch: nobody waits for it any more

    threading.Thread(target=listen, name="calls", daemon=True).start()
    while True:
        function, args = asked.get()
        pickle.dump(function(*args), answers)
        answers.flush()
