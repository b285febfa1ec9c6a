"""Ctrl-C, counted: what a handler raises inside a destructor, a callback or native code
may come to nothing, and modules that are being imported make other errors of it. So all
that renders, asks a model, waits for workers or tells how far it is looks
(`INTERRUPTS.look`) whether there was one that nobody has handled.
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

# seconds within which a second signal is the same Ctrl-C: programs pass on what the
# terminal has sent to all
DUPLICATE_SECONDS = 0.5


class Interrupts:
    """A handler of Ctrl-C as Python's own, which counts signals; once it has `ended`,
    nothing is left to interrupt.
    """

    def __init__(self) -> None:
        self.count = self.handled = 0
        self.ended = False
        self._last = -DUPLICATE_SECONDS

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Handle a signal: count it, and raise KeyboardInterrupt unless all is over. A
        duplicate of the signal before is ignored.
        """
        before = self._last
        self._last = time.monotonic()
        if self._last - before < DUPLICATE_SECONDS:
            return
        self.count += 1
        if not self.ended:
            raise KeyboardInterrupt

    @property
    def waiting(self) -> bool:
        """Whether one has come that nobody has handled."""
        return self.count > self.handled

    def look(self) -> None:
        """Raise an interrupt that has come already and was not handled; in the main
        thread, where it belongs.
        """
        if self.waiting and threading.current_thread() is threading.main_thread():
            raise KeyboardInterrupt


INTERRUPTS = Interrupts()  # those of this process


@contextmanager
def interruptible() -> Iterator[None]:
    """Inside the block, make sure that an interrupt ends it, even if some code has
    swallowed it; the caller handles it.

    Raises:
        KeyboardInterrupt: one came inside the block, or waits at its end. It replaces
            any error, which may have come of it.
    """
    handler = signal.getsignal(signal.SIGINT)
    in_main = threading.current_thread() is threading.main_thread()
    # in a notebook Python's own handler is in place: ours takes over, to count
    counted = in_main and handler is signal.default_int_handler
    if counted:
        INTERRUPTS.handled = INTERRUPTS.count
        signal.signal(signal.SIGINT, INTERRUPTS)
    try:
        yield
        INTERRUPTS.look()
    except KeyboardInterrupt:
        INTERRUPTS.handled = INTERRUPTS.count
        raise
    except Exception as error:
        if INTERRUPTS.waiting:
            INTERRUPTS.handled = INTERRUPTS.count
            raise KeyboardInterrupt from error
        raise
    finally:
        if counted:
            signal.signal(signal.SIGINT, handler)


def end_at_the_second() -> None:
    """Let a second Ctrl-C end this process at once, wherever it is, also in native
    code.

    A thread hears of the signals. What is stored is kept, as when the process is
    killed. Call it in the main thread, once.
    """
    ours, theirs = socket.socketpair()
    theirs.setblocking(False)
    # Python's signal handler in C writes the number of each signal there at once
    signal.set_wakeup_fd(theirs.fileno(), warn_on_full_buffer=False)
    # `theirs` must live as long as the thread
    threading.Thread(
        target=_hear, args=(ours, theirs), name="interrupts", daemon=True
    ).start()


def _hear(ours: socket.socket, theirs: socket.socket) -> None:
    """End the process at the second Ctrl-C; the body of a thread that waits for
    signals.

    Args:
        ours: ours from which the numbers of signals are read.
        theirs: the other end, to which they are written; it is only kept open here.
    """
    first: float | None = None
    while True:
        if signal.SIGINT not in ours.recv(64):
            continue
        now = time.monotonic()
        if (
            # one Ctrl-C may come as two signals in a short time
            first is not None
            and now - first >= DUPLICATE_SECONDS
            and not INTERRUPTS.ended
        ):
            with suppress(OSError):
                # bars hide the cursor
                os.write(2, b"\x1b[?25h" * os.isatty(2) + b"advsearch: interrupted\n")
            os._exit(128 + signal.SIGINT)
        first = now if first is None else first


def unless_interrupted(unraisable: sys.UnraisableHookArgs) -> None:
    """Tell an exception that a destructor or a callback could not raise, but for an
    interrupt: interrupt that is counted.
    """
    if not issubclass(unraisable.exc_type, KeyboardInterrupt):
        sys.__unraisablehook__(unraisable)
