"""Call code of others with a time limit, and isolate its switches and errors.

The threat: a network, its file, or a library that reads the file never ends, changes
how all later tensors are created, or raises any error with any text. So a call runs in
another thread, which is abandoned when the time is up, since nothing can end a loop
inside torch. A call that would block Python as well is tried in another process first.
Each network creates its tensors with the dtype and device that its code has chosen. An
error of foreign code is reported as one short line.

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

# maximum seconds of each of the first calls of a network from a file, and of loading it
# if that runs a part of it
LONGEST = 120
GRACE = 5  # seconds that a call has to end after `stop` was called
_CPU = torch.device("cpu")
_TRIAL = (
    "import io, sys, torch; torch.jit.load(io.BytesIO(sys.stdin.buffer.read()), "
    "map_location='cpu')"
)

Result = TypeVar("Result")


class ForeignCodeTimeoutError(Exception):
    """The time is up; the message states the limit and how to raise it."""

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
        ForeignCodeTimeoutError: it has not ended in `LONGEST` seconds, which a user may
            extend (`scale_limit`). Its thread may go on, since Python cannot end a
            thread.
    """
    outcome: Future[Result] = Future()
    # Torch has this switch for each thread, so it is copied to the new one.
    records_gradients = torch.is_grad_enabled()
    # A daemon, so that the process does not wait for the thread at its end.
    thread = threading.Thread(
        target=_call_to_outcome, args=(call, outcome, records_gradients), daemon=True
    )
    thread.start()
    thread.join(scale_limit(LONGEST))
    if thread.is_alive():
        if stop is not None:
            stop()
            # The thread gets some time to end; its result is not used.
            thread.join(GRACE)
        raise ForeignCodeTimeoutError
    return outcome.result()


def _call_to_outcome(
    call: Callable[[], Result], outcome: Future[Result], records_gradients: bool
) -> None:
    """Call foreign code, and store its result or its error.

    Args:
        call: function to call.
        outcome: gets the result.
        records_gradients: whether torch records gradients meanwhile.
    """
    try:
        with torch.set_grad_enabled(records_gradients):
            outcome.set_result(call())
    except BaseException as error:
        outcome.set_exception(error)


def try_torchscript(archive: io.BytesIO) -> str:
    """Load TorchScript in another process, and return what is wrong; "" for nothing.

    In this process loading could not be stopped, since torch blocks Python while it
    loads. Only a crash and a timeout are reported. An error that torch raises is not:
    the caller loads the archive in this process afterwards, which raises it again.

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
        return str(ForeignCodeTimeoutError())
    if process.returncode < 0:  # minus the number of the signal that ended it
        return f"torch crashed while loading it (signal {-process.returncode})"
    return ""


@dataclass(frozen=True)
class TorchState:
    """The state of torch's switches.

    Attributes:
        dtype: dtype of new tensors.
        device: device of new tensors.
        gradients: whether this thread records gradients.
        deterministic: whether operations that are not deterministic warn (1), raise an
            error (2), or neither (0).
        anomalies: whether NaN in a derivative raises an error.
    """

    dtype: torch.dtype = torch.float32
    device: torch.device = _CPU
    gradients: bool = True
    deterministic: int = 0
    anomalies: bool = False

    @classmethod
    def read_current(cls) -> TorchState:
        """Return the current state of torch's switches."""
        return cls(
            dtype=torch.get_default_dtype(),
            device=torch.get_default_device(),
            gradients=torch.is_grad_enabled(),
            deterministic=torch.get_deterministic_debug_mode(),
            anomalies=torch.is_anomaly_enabled(),
        )

    def apply(self) -> None:
        """Set all of torch's switches to this state."""
        self.apply_to_new_tensors()
        torch.set_grad_enabled(self.gradients)
        torch.set_deterministic_debug_mode(self.deterministic)
        torch.autograd.set_detect_anomaly(self.anomalies)

    def apply_to_new_tensors(self) -> None:
        """Set only the switches for new tensors, dtype and device."""
        torch.set_default_dtype(self.dtype)
        if torch.get_default_device() != self.device:
            torch.set_default_device(None if self.device.type == "cpu" else self.device)


DEFAULT_TORCH_STATE = TorchState()

# states of the switches before each `use_default_torch_state` block, the outermost first
_outside: list[TorchState] = []


@contextmanager
def use_default_torch_state() -> Iterator[None]:
    """Set torch's global switches to `DEFAULT_TORCH_STATE` inside the block.

    `torch.inference_mode` is switched off, too. All are restored afterwards. So our own
    computations depend neither on the caller's switches nor on those that foreign code
    sets.
    """
    with _suspend_inference_mode():
        before = TorchState.read_current()
        # `find_expected_torch_state` reads the switches from before the outermost block.
        _outside.append(before)
        if before != DEFAULT_TORCH_STATE:
            DEFAULT_TORCH_STATE.apply()
        try:
            yield
        finally:
            _outside.pop()
            if TorchState.read_current() != before:
                before.apply()


def _suspend_inference_mode() -> AbstractContextManager[Any]:
    """Return a context in which `torch.inference_mode` is off."""
    if torch.is_inference_mode_enabled():
        return torch.inference_mode(False)
    return nullcontext()


def find_expected_torch_state() -> TorchState:
    """Return the switches of torch that the code of a network expects.

    Call it inside `use_default_torch_state`, after the code was loaded. If loading the
    code has set switches, such as the default dtype, the network expects these, and
    they are set back to `DEFAULT_TORCH_STATE`. Otherwise it expects those from before
    the outermost `use_default_torch_state`.
    """
    current = TorchState.read_current()
    has_set_switches = current != DEFAULT_TORCH_STATE
    if has_set_switches:
        DEFAULT_TORCH_STATE.apply()
        return current
    # `_outside` has the switches before each block, the outermost first.
    return _outside[0] if _outside else DEFAULT_TORCH_STATE


def use_torch_state_in_calls(module: nn.Module, torch_state: TorchState) -> None:
    """Make a module create its new tensors with the dtype and device of `torch_state`.

    Hooks set the two before each call of the module, and restore those of the caller
    after it. They stay on the module. No hooks are added if both are the defaults.
    """
    if (torch_state.dtype, torch_state.device) == (
        DEFAULT_TORCH_STATE.dtype,
        DEFAULT_TORCH_STATE.device,
    ):
        return
    # A stack of the callers' switches, since a module may call itself.
    before: list[TorchState] = []

    def enter(*_: Any) -> None:
        """Set the switches of the module before a call."""
        before.append(TorchState.read_current())
        torch_state.apply_to_new_tensors()

    def leave(*_: Any) -> None:
        """Restore the switches of the caller after a call."""
        before.pop().apply_to_new_tensors()

    module.register_forward_pre_hook(enter)
    module.register_forward_hook(leave, always_call=True)


def get_first_line(error: BaseException) -> str:
    """Return an error of foreign code as one short line.

    It has the type of the error, and the first line of its message with hidden
    characters escaped.
    """
    text = type(error).__name__
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    if lines:
        first_line = "".join(
            sign if sign.isprintable() else repr(sign)[1:-1] for sign in lines[0]
        )
        text = f"{text}: {first_line}"
    # at most 300 characters, including the dots
    return text if len(text) <= 300 else text[:297] + "..."


@contextmanager
def translate_errors(
    what: str, kind: type[AdvsearchError] = ModelError
) -> Iterator[None]:
    """Turn any error that foreign code raises inside the block into one of our errors.

    Errors of advsearch itself pass unchanged.

    Args:
        what: beginning of the message, which states what failed; the foreign error
            follows in parentheses.
        kind: class of the new error.
    """
    try:
        yield
    except AdvsearchError:
        raise
    except Exception as error:
        raise kind(f"{what} ({get_first_line(error)})") from error
