"""The process that loads cases: reads one JSON line a case on standard input, answers with one line, and so on.

It counts the CPU time and the growth of memory of each case, and watches what Python opens, runs and writes. What the
loader itself prints goes to a file, so that a leak is seen. A crash or a hang is for the parent to see.
"""

import contextlib
import ctypes
import gc
import json
import os
import resource
import sys
import time
import traceback
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

NET = 4 << 30
"""Address space beyond the libraries' after which memory is refused, so that a bomb cannot take the machine along."""

_CHANGES = ("os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.link", "os.symlink", "os.chmod", "os.truncate")
_PROCESSES = ("subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "os.fork", "pty.spawn", "socket.connect")


class Watch:
    """Notes what a case must not do: start programs, read what is outside its folder, write outside the run folder."""

    def __init__(self, outside: str, runs: str) -> None:
        self.outside, self.runs, self.active = outside, runs, False
        self.seen: list[str] = []
        sys.addaudithook(self.hook)

    def hook(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self.active:
            return
        if event in _PROCESSES:
            self.seen.append(f"{event} {arguments[0]!r}")
        elif event in _CHANGES or (event == "open" and self._writes(arguments)):
            self._note("writes", arguments[0], allowed=self.runs)
        elif event in ("open", "sqlite3.connect") and isinstance(arguments[0], (str, bytes)):
            path = os.path.realpath(os.fsdecode(arguments[0]).removeprefix("file://").partition("?")[0])
            if path.startswith(self.outside):
                self.seen.append(f"reads {path}")

    def _writes(self, arguments: tuple[Any, ...]) -> bool:
        _, mode, flags = arguments
        return bool(flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)) or any(c in (mode or "") for c in "wax+")

    def _note(self, verb: str, path: Any, allowed: str) -> None:
        if isinstance(path, (str, bytes)):
            whole = os.path.realpath(os.fsdecode(path))
            if whole != os.devnull and not whole.startswith(allowed):
                self.seen.append(f"{verb} {whole}")


def resident() -> tuple[int, int]:
    """Return the memory that the process has now and the most it had since it was last asked to forget, in bytes."""
    lines = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines() if ":" in line)
    return int(lines["VmRSS"].split()[0]) * 1024, int(lines["VmHWM"].split()[0]) * 1024


def forget_peak() -> None:
    """Give memory back and start the count of its peak anew."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    Path("/proc/self/clear_refs").write_text("5")


@contextlib.contextmanager
def captured(log: int) -> Iterator[None]:
    """Send what is printed, by Python or below it, to a file."""
    kept = os.dup(1), os.dup(2)
    os.ftruncate(log, 0)
    os.lseek(log, 0, os.SEEK_SET)
    os.dup2(log, 1)
    os.dup2(log, 2)
    try:
        yield
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        for number, copy in enumerate(kept, start=1):
            os.dup2(copy, number)
            os.close(copy)


def attempt(loader: Any, path: Path) -> dict[str, Any]:
    """Load one file; return how it ended."""
    from advsearch.errors import AdvsearchError

    try:
        loader(path)
    except AdvsearchError as error:
        return {"ending": "refused", "message": str(error)}
    except BaseException as error:
        return {"ending": "traceback", "message": f"{type(error).__name__}: {error}"[:300], "where": place(error)}
    return {"ending": "loaded", "message": ""}


def place(error: BaseException) -> str:
    """Return the last few lines of code on the way to an error."""
    frames = traceback.extract_tb(error.__traceback__)[-6:]
    return " > ".join(f"{Path(frame.filename).name}:{frame.lineno} {frame.name}" for frame in frames)


def main() -> None:
    """Serve until standard input ends."""
    folder = Path(sys.argv[1])
    from fuzz.loading import LOADERS, warm_up

    log = os.open(folder / "printed", os.O_RDWR | os.O_CREAT | os.O_TRUNC)
    answers = os.fdopen(os.dup(1), "w")
    with captured(log):
        warm_up(sys.argv[2].split(","))
    warnings.simplefilter("always")
    # Each further process of the fuzz gets its own log and its own hook.
    watch = Watch(str(folder / "outside"), str(folder / "runs"))
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + NET, size + NET))
    print(json.dumps({"ready": True}), file=answers, flush=True)
    for line in sys.stdin:
        case = json.loads(line)
        forget_peak()
        (before, _), started = resident(), time.process_time()
        watch.seen, watch.active = [], True
        with captured(log):
            result = attempt(LOADERS[case["loader"]], Path(case["path"]))
        watch.active = False
        result |= {"cpu": time.process_time() - started, "growth": resident()[1] - before, "seen": watch.seen[:5]}
        result["printed"] = os.pread(log, 300, 0).decode("utf-8", "replace")
        print(json.dumps(result), file=answers, flush=True)


if __name__ == "__main__":
    main()
