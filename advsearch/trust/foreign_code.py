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
    """Call foreign code with a time limit, and return its result or raise its error.

    The code runs in another thread, since it may never end.

    Args:
        call: function to call.
        stop: function that asks the code to end when the time is up.

    Raises:
        TimedOut: it has not ended in `LONGEST` seconds (times `ADVSEARCH_LIMITS`). Its
            thread may go on, since Python cannot end a thread.
    """
    outcome: Future[Result] = Future()
    # Torch has this switch for each thread, so it is copied to the new one.
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
            thread.join(
                GRACE
            )  # so that it ends before we go on; its result is not used
        raise TimedOut
    return outcome.result()


def try_torchscript(archive: io.BytesIO) -> str:
    """Load TorchScript in another process, and return what is wrong; "" for nothing.

    In this process loading could not be stopped, since torch does not let Python run
    meanwhile. Only a crash and a timeout are reported. An error that torch raises is
    not, since loading the archive in this process raises it again.

    Args:
        archive: the TorchScript file, in memory.
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
    """Set torch's global switches to their defaults (`PLAIN`) inside the block.

    `torch.inference_mode` is left too. All are restored afterwards. So neither the
    caller's switches nor those that foreign code sets change our own computations.
    """
    leaves_inference_mode: AbstractContextManager[Any] = nullcontext()
    if torch.is_inference_mode_enabled():
        leaves_inference_mode = torch.inference_mode(False)
    with leaves_inference_mode:
        before = Switches.read_current()
        # `find_code_switches` reads the switches from before the outermost block.
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
    """Return torch's switches that the code of a network expects, and set `PLAIN` again.

    Call it inside `use_plain_switches`, after the code was loaded. If loading the code
    has set switches, such as the default dtype, the network expects these. Otherwise it
    expects those from before the outermost `use_plain_switches`.
    """
    current = Switches.read_current()
    if current == PLAIN:  # loading the code has set none
        return _outside[0] if _outside else PLAIN
    PLAIN.apply()
    return current


def call_with_switches(module: nn.Module, switches: Switches) -> None:
    """Make a module create its new tensors with the dtype and device of `switches`.

    Hooks set the two before each call of the module, and restore those of the caller
    after it. No hooks are added if both are the defaults.
    """
    if (switches.dtype, switches.device) == (PLAIN.dtype, PLAIN.device):
        return
    # The switches of the callers. They are a stack, since a module may call itself.
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
    """Turn any error that foreign code raises inside the block into one of our errors.

    Errors of advsearch itself pass unchanged.

    Args:
        what: beginning of the message, which says what failed; the foreign error
            follows in brackets.
        kind: class of the new error.
    """
    try:
        yield
    except AdvsearchError:
        raise
    except Exception as error:
        raise kind(f"{what} ({get_first_line(error)})") from error
