"""What runs on a worker: it gets ready for a work once, then carries out batches. Errors go back as values, as they may
not survive being pickled. Files that a work needs are sent to who has not got them; with a mesh goes its folder,
files in it and below of the kinds that a scene consists of."""

from __future__ import annotations

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
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from importlib import metadata
from pathlib import Path
from queue import SimpleQueue
from typing import Any, NamedTuple

from advsearch import threads  # before torch: it sets how OpenMP waits
from advsearch.cluster import Call, Work
from advsearch.errors import AdvsearchError, EnvironmentSetupError, InputError, StorageError
from advsearch.files import split_paths
from advsearch.registry import imported
from advsearch.scene.mitsuba_backend.llvm import ensure_llvm
from advsearch.trust.code import allow_code

_CPU_INFO = Path("/proc/cpuinfo")
PACKAGES = ("mitsuba", "drjit", "torch", "numpy")  # whose versions decide last bits

MachineInfo = dict[str, str]


@cache
def this_machine() -> MachineInfo:
    llvm = ".".join(map(str, ensure_llvm().version))
    return {"processor": processor(), "LLVM": llvm, **{name: _version(name) for name in PACKAGES}}


def machine_name(machine: MachineInfo) -> str:
    return hashlib.sha256(json.dumps(machine, sort_keys=True).encode()).hexdigest()[:8]


@cache
def version() -> str:
    """Return the version of advsearch, with a few digits of what its files say, which no version number tells."""
    digest = hashlib.sha256()
    folder = Path(__file__).resolve().parents[1]
    for path in sorted(folder.rglob("*.py")):
        digest.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes())
    return f"{_version('advsearch')}+{digest.hexdigest()[:8]}"


def processor(cpu_info: Path = _CPU_INFO) -> str:
    """Return the processor's name; what the system says where Linux's description has none."""
    try:
        for line in cpu_info.read_text(encoding="utf-8", errors="replace").splitlines():
            key, _, value = line.partition(":")
            if key.strip().lower() == "model name" and value.strip():
                return " ".join(value.split())
    except OSError:
        pass
    return platform.processor() or platform.machine() or "unknown"


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "unknown"


WITH_OTHERS = {".obj": (".mtl",), ".gltf": (".bin",), ".xml": (".obj", ".ply", ".serialized", ".exr", ".hdr")}
"""Files that name others, and what these end in beside pictures."""

PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tga", ".tif", ".tiff")

LARGEST = 1 << 30


@dataclass(frozen=True)
class Files:
    """The files that a work's settings name, and those beside them: digests by path, and what is in them, empty where
    they are not sent."""

    digests: Mapping[str, str]
    contents: Mapping[str, bytes]


class MissingError(Exception):
    """A file is neither where the settings say nor among those that were sent before."""


def read_files(work: Work) -> Files:
    contents: dict[str, bytes] = {}
    for value in map(work.settings.get, work.files):
        for part in _split(value) if isinstance(value, str) else ():
            path = Path(part)
            if path.is_absolute() and path.is_file():
                kinds = WITH_OTHERS.get(path.suffix.lower(), ())
                others = sorted(path.parent.rglob("*")) if kinds else []
                beside = [file for file in others if file.suffix.lower() in (*kinds, *PICTURES) and file.is_file()]
                contents |= {str(file): file.read_bytes() for file in (path, *beside)}
    size = sum(map(len, contents.values()))
    if size > LARGEST:
        raise InputError(
            f"cluster: the files of the scene and the model have {size >> 20} MiB, and {LARGEST >> 20} can be "
            "sent; put them in a folder that all workers see, each under the same path"
        )
    return Files({path: hashlib.sha256(data).hexdigest() for path, data in contents.items()}, contents)


def write_files(work: Work, files: Files, folder: Path) -> Work:
    """Return the work with the paths that hold here: its own where all its files are here, or else those of copies in
    a folder of their digests, into which what was sent is written. Raises MissingError."""
    if all(_is(Path(path), digest) for path, digest in files.digests.items()):
        return work
    whole = hashlib.sha256(json.dumps(sorted(files.digests.items())).encode()).hexdigest()[:32]
    here = {path: folder / whole / Path(path).relative_to(Path(path).anchor) for path in files.digests}
    for name, data in files.contents.items():
        here[name].parent.mkdir(parents=True, exist_ok=True)
        part = here[name].with_name(f"{here[name].name}.part-{os.getpid()}")  # it is whole, or not there
        part.write_bytes(data)
        part.replace(here[name])
    for path, digest in files.digests.items():
        if not _is(here[path], digest):
            raise MissingError(path)
    settings = dict(work.settings)
    for name in work.files:
        value = settings.get(name)
        if isinstance(value, str):
            settings[name] = "".join(str(here.get(part, part)) for part in _split(value))
    return replace(work, settings=settings)


def _is(path: Path, digest: str) -> bool:
    return path.is_file() and hashlib.sha256(path.read_bytes()).hexdigest() == digest


def _split(value: str) -> Iterator[str]:
    """Take ``/a.glb#NODE,/b.obj`` or ``/camera.csv+/object.csv`` apart into paths and what stands between them."""
    for part in re.split("(,)", value):
        path, mark, inner = part.strip().partition("#")
        first, *second = split_paths(path)
        yield first
        yield from ("+", *second) if second else (mark + inner,)


MOST_LOADED = 2  # works that a worker holds; the one that was not used for longest goes
KERNELS, INPUTS = "kernels", "inputs"  # folders below the machine's own: Dr.Jit's kernels, and files that were sent

_known: dict[str, Work] = {}
_one_at_a_time = threading.Lock()


class Ready(NamedTuple):
    machine: MachineInfo
    seconds: float


class Carried(NamedTuple):
    value: Any
    seconds: float


class Failure(NamedTuple):
    """Something went wrong, as a user reads it: another worker may do it (`unfit`), the worker is not ready (any more),
    or it lacks files. What is a bug has a trace."""

    text: str
    unfit: bool = False
    forgotten: bool = False
    missing: bool = False
    trace: str = ""


def prepare(key: str, work: Work, files: Files, asked: str) -> Ready | Failure:
    """Get ready for a work that a version of advsearch asks for."""
    begun = time.perf_counter()
    if version() != asked:
        return Failure(f"it has advsearch {version()}, and {asked} asks; install the same on both", unfit=True)
    try:
        with _one_at_a_time:
            if key not in _known:
                own = own_folder()
                if "DRJIT_CACHE_DIR" not in os.environ:
                    (own / KERNELS).mkdir(exist_ok=True)
                    os.environ["DRJIT_CACHE_DIR"] = str(own / KERNELS)
                this_machine()
                allow_code(*work.code)
                _known[key] = write_files(work, files, own / INPUTS)
            _call_of(key)
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
            value = _call_of(key)(items)
    except Exception as error:
        return _failure(error, unfit=isinstance(error, (OSError, StorageError)))
    return Carried(value, time.perf_counter() - begun)


def own_folder() -> Path:
    """Return a folder on this machine's disk that only this user can write to; it outlives the worker."""
    folder = Path(tempfile.gettempdir()) / f"advsearch-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    facts = folder.lstat()
    mine = stat.S_ISDIR(facts.st_mode) and facts.st_uid == os.getuid() and not facts.st_mode & 0o022
    return folder if mine else Path(tempfile.mkdtemp(prefix="advsearch-"))


@lru_cache(MOST_LOADED)
def _call_of(key: str) -> Call:
    work = _known[key]
    threads.configure(work.threads)
    make: Callable[[Any], Call] = imported(work.function)
    return make(work.settings)


def _failure(error: Exception, *, unfit: bool) -> Failure:
    ours = isinstance(error, AdvsearchError) or unfit
    text = str(error) if isinstance(error, AdvsearchError) else f"{type(error).__name__}: {error}"
    return Failure(text, unfit, trace="" if ours else traceback.format_exc())


SERVING = "ADVSEARCH_WORKER"  # environment variable of a process that `serve`s


def serve() -> None:
    """Answer the calls that the process writes which has started this one, a pickled pair (function, arguments) each,
    until it goes."""
    calls, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
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
