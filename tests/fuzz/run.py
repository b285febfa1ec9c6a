"""Runs cases in processes of their own and says how each ended: loaded, refused, or what went wrong with it."""

import contextlib
import hashlib
import json
import os
import re
import select
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fuzz import run_folders
from fuzz.case import Case
from fuzz.pictures import plain_png

CPU_SECONDS = 10.0
MEMORY = 1 << 30
"""What one case may take, over what the process has with its libraries loaded."""

IDLE_SECONDS = 60.0
"""A case that has used no CPU time for so long waits for something."""

_TICKS, _PAGE = os.sysconf("SC_CLK_TCK"), os.sysconf("SC_PAGE_SIZE")
_POLL = 0.05
_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f]")


@dataclass(frozen=True)
class Outcome:
    """How one case ended.

    Attributes:
        number: the case's.
        what: the format and what was done to it.
        ending: "loaded", "refused" (an error with exit status 2), or "traceback", "crashed" or "killed".
        faults: what must not be; empty where all is well.
        cpu: seconds.
        growth: bytes of memory over those of the process before.
        message: the error's, or the traceback's last line.
    """

    number: int
    what: str
    ending: str
    faults: tuple[str, ...]
    cpu: float
    growth: int
    message: str = ""


def run(cases: Sequence[tuple[int, Case]], folder: Path) -> Iterator[Outcome]:
    """Run cases one after the other, in one process as long as that lives.

    Args:
        cases: with their numbers.
        folder: new or empty; each case gets a folder in it and stays there.

    Yields:
        An outcome for each case, in order.
    """
    outside, runs = folder / "outside", folder / "runs"
    _plant(outside)
    run_folders.plant(folder / "honest")
    runs.mkdir(parents=True, exist_ok=True)
    untouched = _digest(outside)
    worker = _Worker(folder, cases)
    try:
        for number, case in cases:
            home = folder / f"{number:05d}"
            home.mkdir()
            path = case.write(home, outside)
            before = _digest(home)
            outcome = worker.ask(number, case, path)
            faults = list(outcome.faults)
            if _digest(home) != before or _digest(outside) != untouched:
                faults.append("a file outside the run folder changed")
            yield Outcome(**{**outcome.__dict__, "faults": tuple(faults)})
    finally:
        worker.stop()


def _plant(outside: Path) -> None:
    """Write files that references lead to and that nothing may read."""
    outside.mkdir(parents=True, exist_ok=True)
    (outside / "secret.mtl").write_text("newmtl paint\nKd 1 0 0\n")
    (outside / "secret.bin").write_bytes(bytes(1 << 12))
    (outside / "secret.png").write_bytes(plain_png(8, 8))
    (outside / "secret.txt").write_text("mug\nbowl\n")
    run_folders.plant(outside)


def _digest(folder: Path) -> dict[str, tuple[int, str]]:
    """Return the type and content of everything in a folder."""
    result = {}
    for path in sorted(folder.rglob("*")):
        content = path.read_bytes() if path.is_file() and not path.is_symlink() else b""
        result[str(path)] = path.lstat().st_mode, hashlib.sha256(content).hexdigest()
    return result


class _Worker:
    """A process that loads cases, started again whenever it has died."""

    def __init__(self, folder: Path, cases: Sequence[tuple[int, Case]]) -> None:
        self._folder, self._loaders = folder, ",".join(sorted({case.loader for _, case in cases}))
        self._process: subprocess.Popen[bytes] | None = None

    def stop(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            for pipe in (self._process.stdin, self._process.stdout):
                with contextlib.suppress(OSError):
                    pipe.close()  # type: ignore[union-attr]
            self._process = None

    def ask(self, number: int, case: Case, path: Path) -> Outcome:
        """Load one case and judge how that ended."""
        process = self._started()
        resident = _usage(process.pid)[1]
        cpu = _usage(process.pid)[0]
        request = json.dumps({"loader": case.loader, "path": str(path)}) + "\n"
        process.stdin.write(request.encode())  # type: ignore[union-attr]
        process.stdin.flush()  # type: ignore[union-attr]
        answer, reason = self._answer(process, cpu, resident)
        if answer is None:
            spent = _usage(process.pid)
            code = process.poll()
            self.stop()
            ending = "killed" if code is None else "crashed"
            fault = reason or f"the process died with status {code}"
            return Outcome(number, case.what, ending, (fault,), spent[0] - cpu, max(0, spent[1] - resident))
        return Outcome(
            number,
            case.what,
            answer["ending"],
            tuple(_faults(answer, case, path)),
            answer["cpu"],
            answer["growth"],
            " ".join((answer["message"], answer.get("where", ""))).strip(),
        )

    def _started(self) -> subprocess.Popen[bytes]:
        if self._process is not None and self._process.poll() is None:
            return self._process
        home = self._folder / "home"
        home.mkdir(exist_ok=True)
        here = Path(__file__).resolve().parents[1]
        environment = {
            **os.environ,
            "HOME": str(home),
            "PYTHONPATH": f"{here}{os.pathsep}{here.parent}",
            "PYTHONDONTWRITEBYTECODE": "1",
        }
        self._process = subprocess.Popen(
            [sys.executable, "-m", "fuzz.worker", str(self._folder), self._loaders],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            cwd=self._folder / "runs",
            env=environment,
        )
        if not self._line(self._process, time.monotonic() + 300):
            raise RuntimeError("the process that loads the cases did not start")
        return self._process

    def _answer(self, process: subprocess.Popen[bytes], cpu: float, resident: int) -> tuple[dict[str, Any] | None, str]:
        """Wait for the answer; give up when the case takes more than it may."""
        active, deadline = cpu, time.monotonic() + IDLE_SECONDS
        while True:
            line = self._line(process, time.monotonic() + _POLL)
            if line:
                return json.loads(line), ""
            if line == b"":
                process.wait()
                return None, ""
            spent, memory = _usage(process.pid)
            if spent - cpu > CPU_SECONDS:
                return None, f"takes more than {CPU_SECONDS:g} CPU seconds"
            if memory - resident > MEMORY:
                return None, "takes more than 1 GiB of memory"
            if spent - active > 0.1:
                active, deadline = spent, time.monotonic() + IDLE_SECONDS
            if time.monotonic() > deadline:
                return None, f"has done nothing for {IDLE_SECONDS:g} seconds"

    @staticmethod
    def _line(process: subprocess.Popen[bytes], deadline: float) -> bytes | None:
        """Return a line of the answer, nothing where the process has ended, or None when it is late."""
        pipe = process.stdout
        assert pipe is not None
        ready, _, _ = select.select([pipe], [], [], max(0.0, deadline - time.monotonic()))
        return pipe.readline() if ready else None


def _usage(pid: int) -> tuple[float, int]:
    """Return the CPU seconds that a process has used and the memory that it has now; zeros if it is gone."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        pages = Path(f"/proc/{pid}/statm").read_text().split()[1]
    except (OSError, IndexError):
        return 0.0, 0
    return (int(fields[11]) + int(fields[12])) / _TICKS, int(pages) * _PAGE


def _faults(answer: dict[str, Any], case: Case, path: Path) -> Iterator[str]:
    """Yield what is wrong with the way a case ended."""
    if answer["ending"] == "traceback":
        yield "an error that is not for users"
    if answer["ending"] == "refused":
        named = case.loader == "settings"  # these name the setting
        if not named and path.name not in answer["message"] and str(path.parent) not in answer["message"]:
            yield "the message does not name the file"
        if _CONTROL.search(answer["message"]):
            yield "the message has control characters"
        if len(answer["message"]) > 1000 + len(str(path)):
            yield f"the message has {len(answer['message'])} characters"
    if answer["cpu"] > CPU_SECONDS:
        yield f"takes {answer['cpu']:.1f} CPU seconds"
    if answer["growth"] > MEMORY:
        yield f"takes more than 1 GiB of memory: {answer['growth'] >> 20} MiB"
    if answer["printed"]:
        yield f"prints {answer['printed'][:200]!r}"
    yield from answer["seen"]
