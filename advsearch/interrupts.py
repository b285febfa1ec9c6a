"""Handle Ctrl-C so that it is never lost.

The KeyboardInterrupt of a signal handler is lost inside a destructor, a callback or
native code, and a module that is being imported may turn it into another error. So the
handler counts the interrupts. Code that renders, calls a model, waits for workers or
reports progress calls `INTERRUPTS.raise_pending`, which raises an interrupt again that
was not handled.
"""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType

# A second signal within this many seconds belongs to the same Ctrl-C: the terminal
# sends it to all processes, and some programs also pass it on.
DUPLICATE_SECONDS = 0.5


class Interrupts:
    """A handler of Ctrl-C that raises KeyboardInterrupt, and counts the interrupts.

    Attributes:
        n_received: number of interrupts so far.
        n_handled: number of those that were handled, that is, that ended something.
        is_work_done: whether all work is done, so that nothing is left to interrupt.
    """

    def __init__(self) -> None:
        self.n_received = 0
        self.n_handled = 0
        self.is_work_done = False
        # time of the last signal; at first so early that no signal is a duplicate
        self._last_signal = -DUPLICATE_SECONDS

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Count an interrupt, and raise KeyboardInterrupt.

        Nothing is raised once all work is done (`is_work_done`). A signal soon after
        another one comes from the same Ctrl-C, and is ignored.

        Args:
            number: number of the signal.
            frame: frame that was interrupted; both are what Python passes to handlers.
        """
        previous_signal = self._last_signal
        self._last_signal = time.monotonic()
        if self._last_signal - previous_signal < DUPLICATE_SECONDS:
            return
        self.n_received += 1
        if not self.is_work_done:
            raise KeyboardInterrupt

    @property
    def has_pending(self) -> bool:
        """Whether an interrupt has come that was not handled yet."""
        return self.n_received > self.n_handled

    def mark_handled(self) -> None:
        """Count all interrupts so far as handled."""
        self.n_handled = self.n_received

    def raise_pending(self) -> None:
        """Raise an earlier interrupt again if it was not handled.

        As for Python's own handler, only the main thread is interrupted.

        Raises:
            KeyboardInterrupt: there is such an interrupt, and this is the main thread.
        """
        if self.has_pending and threading.current_thread() is threading.main_thread():
            raise KeyboardInterrupt


INTERRUPTS = Interrupts()  # the interrupts of this process


@contextmanager
def reraise_lost_interrupt() -> Iterator[None]:
    """Make sure that an interrupt ends the block, even if some code has caught it.

    The caller handles the KeyboardInterrupt.

    Raises:
        KeyboardInterrupt: an interrupt came inside the block. It replaces any other
            error, since the interrupt may have caused that error.
    """
    handler = signal.getsignal(signal.SIGINT)
    is_main_thread = threading.current_thread() is threading.main_thread()
    # In a notebook Python's own handler is installed. Ours replaces it inside the
    # block, since it counts interrupts.
    replaces_handler = is_main_thread and handler is signal.default_int_handler
    if replaces_handler:
        INTERRUPTS.mark_handled()  # earlier ones do not concern this block
        signal.signal(signal.SIGINT, INTERRUPTS)
    try:
        yield
        INTERRUPTS.raise_pending()  # raises an interrupt that was lost inside the block
    except KeyboardInterrupt:
        INTERRUPTS.mark_handled()
        raise
    except Exception as error:
        if INTERRUPTS.has_pending:
            INTERRUPTS.mark_handled()
            raise KeyboardInterrupt from error
        raise
    finally:
        if replaces_handler:
            signal.signal(signal.SIGINT, handler)


def end_process_at_second_interrupt() -> None:
    """Let a second Ctrl-C end this process at once, also inside native code.

    Python handles signals only between its own instructions, so that a thread waits for
    them instead. Stored results remain, as when the process is killed. Call this
    function once, in the main thread.
    """
    reading_end, writing_end = socket.socketpair()
    writing_end.setblocking(False)
    # Python's signal handler in C writes the number of each signal to this socket at
    # once, without waiting for Python code.
    signal.set_wakeup_fd(writing_end.fileno(), warn_on_full_buffer=False)
    threading.Thread(
        target=_wait_for_second,
        # the writing end, too: it must live as long as the thread
        args=(reading_end, writing_end),
        name="interrupts",
        daemon=True,
    ).start()


def _wait_for_second(reading_end: socket.socket, writing_end: socket.socket) -> None:
    """Wait for signals, and end the process at the second Ctrl-C.

    This is the main function of a thread.

    Args:
        reading_end: socket from which the numbers of signals are read.
        writing_end: the other end, to which they are written. This reference keeps it
            open as long as the thread runs.
    """
    first_time: float | None = None  # of the first Ctrl-C
    while True:
        if signal.SIGINT not in reading_end.recv(64):
            continue
        now = time.monotonic()
        if first_time is None:
            first_time = now
            continue
        # one Ctrl-C may come as two signals in a short time
        is_duplicate = now - first_time < DUPLICATE_SECONDS
        if not is_duplicate and not INTERRUPTS.is_work_done:
            _end_process()


def _end_process() -> None:
    """Print that there was an interrupt, and end the process at once."""
    # progress bars hide the cursor of the terminal
    show_cursor = b"\x1b[?25h" if os.isatty(2) else b""
    with suppress(OSError):
        os.write(2, show_cursor + b"advsearch: interrupted\n")
    os._exit(128 + signal.SIGINT)


def report_unraisable_error(unraisable: sys.UnraisableHookArgs) -> None:
    """Print an exception that a destructor or a callback could not raise.

    An interrupt is not printed: it was counted, and `INTERRUPTS.raise_pending` raises it
    again.
    """
    if not issubclass(unraisable.exc_type, KeyboardInterrupt):
        sys.__unraisablehook__(unraisable)
