"""A deadline for programs of others: what a model file holds may never end.

Neither a signal nor an exception ends torch's own loops, so a call goes on in a thread of its own, which is left behind
when the time is up; what would also hold Python up is tried in a process of its own first.
"""

from __future__ import annotations

import io
import subprocess
import sys
import threading
from collections.abc import Callable
from typing import TypeVar

import torch

from advsearch import files

LONGEST = 120
"""Seconds that a file's first passes may take each, and its loading, where that runs a part of it."""

GRACE = 5
"""Seconds for a call to end that was asked to."""

_TRIAL = "import io, sys, torch; torch.jit.load(io.BytesIO(sys.stdin.buffer.read()), map_location='cpu')"

Result = TypeVar("Result")


class TookTooLong(Exception):
    """The time was up; the message says what the limit is and how it is raised."""

    def __init__(self) -> None:
        super().__init__(
            f"no answer within {files.scaled(LONGEST)} seconds; if you trust it, {files.FACTOR}=10 in the environment "
            "waits ten times as long"
        )


def within(call: Callable[[], Result], stop: Callable[[], None] | None = None) -> Result:
    """Return what `call` returns, or raise what it raises.

    Args:
        call: what may never end.
        stop: asks it to end when the time is up; None where nothing can.

    Raises:
        TookTooLong: it has not ended in `LONGEST` seconds (times `ADVSEARCH_LIMITS`); its thread may go on.
    """
    results: list[Result] = []
    errors: list[BaseException] = []
    gradients = torch.is_grad_enabled()  # a thread has its own

    def work() -> None:
        try:
            with torch.set_grad_enabled(gradients):
                results.append(call())
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=work, daemon=True)  # a daemon's: the process may end before it
    thread.start()
    thread.join(files.scaled(LONGEST))
    if thread.is_alive():
        if stop is not None:
            stop()
            thread.join(GRACE)
        raise TookTooLong
    if errors:
        raise errors[0]
    return results[0]


def try_torchscript(archive: io.BytesIO) -> str:
    """Load TorchScript in a process of its own, and return what is wrong, or nothing: torch keeps Python waiting
    meanwhile.

    An error that torch raises is not told: loading it here raises it again.

    Raises:
        TookTooLong: as for `within`.
    """
    command = [sys.executable, "-W", "ignore", "-c", _TRIAL]
    try:
        done = subprocess.run(command, input=archive.getbuffer(), capture_output=True, timeout=files.scaled(LONGEST))
    except subprocess.TimeoutExpired:
        raise TookTooLong from None
    return f"torch crashed while loading it (signal {-done.returncode})" if done.returncode < 0 else ""
