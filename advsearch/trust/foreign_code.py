"""What code of others must not do to us: never end, leave torch's global switches
turned, or say what it likes.

The threat: a network, a file of one or a library that reads it hangs, changes how all
later tensors are made, or raises any error with any text. A call goes on in a thread of
its own, left behind when the time is up, for nothing ends torch's loops; what would
hold Python up too is tried in a process of its own. A network has the type and device
for new tensors that its code chose. Of an error of others one short line is shown.

Used by all that loads and calls models (`models/`) and around what the engine does
(`engine/`).
"""

from __future__ import annotations

import io
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
from torch import nn

from advsearch.errors import AdvsearchError, ModelError
from advsearch.trust.code import SUBPROCESS_DIRECTORY
from advsearch.trust.stored_files import FACTOR, scale_limit

# seconds that a file's first passes may take each, and its loading, where that runs a
# part of it
LONGEST = 120
GRACE = 5  # seconds for a call to end that was asked to
_CPU = torch.device("cpu")
_TRIAL = (
    "import io, sys, torch; torch.jit.load(io.BytesIO(sys.stdin.buffer.read()), "
    "map_location='cpu')"
)

Result = TypeVar("Result")


class TimedOut(Exception):
    """The time was up; the message says what the limit is and how it is raised."""

    def __init__(self) -> None:
        super().__init__(
            f"no answer within {scale_limit(LONGEST)} seconds; if you trust it, "
            f"{FACTOR}=10 in the environment waits ten times as long"
        )


def run_within_limits(
    call: Callable[[], Result], stop: Callable[[], None] | None = None
) -> Result:
    """Call a function of others that may never end, and return its result or raise its
    error.

    Args:
        call: the function; it runs in a thread of its own.
        stop: asks it to end when the time is up.

    Raises:
        TimedOut: it has not ended in `LONGEST` seconds (times `ADVSEARCH_LIMITS`); its
            thread may go on.
    """
    outcome: Future[Result] = Future()
    # each thread has this switch for itself: the new one takes it over
    records_gradients = torch.is_grad_enabled()

    def work() -> None:
        try:
            with torch.set_grad_enabled(records_gradients):
                outcome.set_result(call())
        except BaseException as error:
            outcome.set_exception(error)

    # a daemon: the process does not wait for it at its end
    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    thread.join(scale_limit(LONGEST))
    if thread.is_alive():
        if stop is not None:
            stop()
            thread.join(GRACE)  # its result would be too late all the same
        raise TimedOut
    return outcome.result()


def try_torchscript(archive: io.BytesIO) -> str:
    """Load TorchScript in a process of its own, and return what is wrong, "" if nothing
    is.

    In this process it could not be stopped: torch keeps Python waiting while it loads.
    Only a crash and too long a time are reported. An error that torch raises is not,
    since loading it here raises it again.
    """
    command = [sys.executable, "-W", "ignore", "-c", _TRIAL]
    try:
        process = subprocess.run(
            command,
            input=archive.getbuffer(),
            capture_output=True,
            timeout=scale_limit(LONGEST),
            cwd=SUBPROCESS_DIRECTORY,
        )
    except subprocess.TimeoutExpired:
        return str(TimedOut())
    if process.returncode < 0:  # minus the number of the signal that ended it
        return f"torch crashed while loading it (signal {-process.returncode})"
    return ""


@dataclass(frozen=True)
class Switches:
    """The state of torch's switches: dtype and device of new tensors, whether this
    thread records gradients, whether operations that are not deterministic warn (1) or
    raise (2), and whether NaN in a derivative does.
    """

    dtype: torch.dtype = torch.float32
    device: torch.device = _CPU
    gradients: bool = True
    deterministic: int = 0
    anomalies: bool = False

    @classmethod
    def read_current(cls) -> Switches:
        """Return the switches as torch has them now."""
        return cls(
            dtype=torch.get_default_dtype(),
            device=torch.get_default_device(),
            gradients=torch.is_grad_enabled(),
            deterministic=torch.get_deterministic_debug_mode(),
            anomalies=torch.is_anomaly_enabled(),
        )

    def apply(self) -> None:
        """Turn all of them."""
        self.apply_to_new_tensors()
        torch.set_grad_enabled(self.gradients)
        torch.set_deterministic_debug_mode(self.deterministic)
        torch.autograd.set_detect_anomaly(self.anomalies)

    def apply_to_new_tensors(self) -> None:
        """Turn those for new tensors."""
        torch.set_default_dtype(self.dtype)
        if torch.get_default_device() != self.device:
            torch.set_default_device(None if self.device.type == "cpu" else self.device)


PLAIN = Switches()

_outside: list[Switches] = []  # as `use_plain_switches` found them, the outermost first


@contextmanager
def use_plain_switches() -> Iterator[None]:
    """Inside the block, set torch's global switches to their defaults (`PLAIN`), and
    leave `torch.inference_mode`; restore them afterwards.
    """
    leaves_inference_mode: AbstractContextManager[Any] = nullcontext()
    if torch.is_inference_mode_enabled():
        leaves_inference_mode = torch.inference_mode(False)
    with leaves_inference_mode:
        before = Switches.read_current()
        _outside.append(before)
        if before != PLAIN:
            PLAIN.apply()
        try:
            yield
        finally:
            _outside.pop()
            if Switches.read_current() != before:
                before.apply()


def find_code_switches() -> Switches:
    """Return the switches that the code of a network is to run with, and set `PLAIN`
    again.

    Call it inside `use_plain_switches`, after the code was loaded. The switches are
    those that loading it has set; if it has set none, those from before the outermost
    `use_plain_switches`.
    """
    current = Switches.read_current()
    if current == PLAIN:  # loading the code has set none
        return _outside[0] if _outside else PLAIN
    PLAIN.apply()
    return current


def call_with_switches(module: nn.Module, switches: Switches) -> None:
    """Make every call of a module use the dtype and device of `switches` for new
    tensors; after the call those of the caller are back.

    It adds hooks to the module, unless both are the defaults.
    """
    if (switches.dtype, switches.device) == (PLAIN.dtype, PLAIN.device):
        return
    # of the callers; a stack, since a module may call itself
    before: list[Switches] = []

    def enter(*_: Any) -> None:
        before.append(Switches.read_current())
        switches.apply_to_new_tensors()

    def leave(*_: Any) -> None:
        before.pop().apply_to_new_tensors()

    module.register_forward_pre_hook(enter)
    module.register_forward_hook(leave, always_call=True)


def get_first_line(error: BaseException) -> str:
    """Return an error of foreign code as one short line: its type, and the first line
    of its message with hidden characters escaped.
    """
    text = type(error).__name__
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    if lines:
        first_line = "".join(
            sign if sign.isprintable() else repr(sign)[1:-1] for sign in lines[0]
        )
        text = f"{text}: {first_line}"
    # 300 characters with the dots
    return text if len(text) <= 300 else text[:297] + "..."


@contextmanager
def translate_errors(
    what: str, kind: type[AdvsearchError] = ModelError
) -> Iterator[None]:
    """Turn whatever foreign code raises inside the block into one of our errors; our
    own errors pass unchanged.

    Args:
        what: beginning of the message, what failed; the foreign error follows in
            brackets.
        kind: class of the new error.
    """
    try:
        yield
    except AdvsearchError:
        raise
    except Exception as error:
        raise kind(f"{what} ({get_first_line(error)})") from error
