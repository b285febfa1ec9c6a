"""Those who ask the dashboard's server: in what time each has to have asked and taken
the answer, and HTTPS.

A few workers answer. A client that has said nothing yet keeps none of them from others,
one that is slow does so until its time is up, or for `GRACE` only where others wait.
"""

from __future__ import annotations

import importlib
import io
import math
import selectors
import socket
import ssl
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from queue import Empty, LifoQueue
from typing import Any

WORKERS = 16  # requests that are answered at once; others wait
WAITING = 128
"""Connections that may be open beside those that are served. More wait in the operating
system, without a file open here.
"""
PATIENCE = 10.0  # seconds in which a client has to have said what it asks for
# bytes a second at which it has to take the answer at least, beyond as long as
# `PATIENCE`
SLOWEST = 50_000
GRACE = 1.0  # seconds that a slow client has where others wait
TICK = 0.05  # seconds between two looks at the clock


LARGEST_SENT = 16 << 20  # bytes of what is sent, at most
NO_QR = "pip install segno"  # what to type where there is nothing to draw a code with


def reachable(host: str) -> str:
    """Return the address under which others reach what listens at `host`: of any
    address, the one that leads out.
    """
    if host not in ("0.0.0.0", "::", ""):
        return host
    family, far = (
        (socket.AF_INET6, "2001:db8::1")
        if host == "::"
        else (socket.AF_INET, "192.0.2.1")
    )
    try:
        with socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.connect((far, 9))  # chooses an address; nothing is sent
            return str(probe.getsockname()[0])
    except OSError:
        return "::1" if host == "::" else "127.0.0.1"


@dataclass(eq=False)
class _Served:
    """One that a worker serves: its connection, since when the worker waits for it, and
    until when that may last; both are infinite while the worker itself is what takes
    time.
    """

    connection: socket.socket
    since: float = math.inf
    due: float = math.inf


class Clients:
    """Serves the connections that a socket accepts until `close`, with HTTPS if there
    is a context. `answer` is called with each, in a worker's thread, and says when it
    waits for the client (`wait_for`) or works.
    """

    def __init__(
        self,
        listening: socket.socket,
        answer: Callable[[socket.socket, Any], None],
        context: ssl.SSLContext | None,
    ) -> None:
        self._listening = listening
        self._answer = answer
        self._context = context
        # Who came last is served first: a crowd may be there to keep others out.
        self._ready: LifoQueue[tuple[socket.socket, Any] | None] = LifoQueue()
        self._served: dict[int, _Served] = {}
        self._closed, self._ended = threading.Event(), threading.Event()
        self._ended.set()

    def serve(self) -> None:
        self._ended.clear()

        def work() -> None:
            while (job := self._ready.get()) is not None:
                self.serve_one(*job)

        for _ in range(WORKERS):
            threading.Thread(target=work, daemon=True).start()
        try:
            with selectors.DefaultSelector() as selector:
                self._watch(selector)
        finally:
            self._ended.set()

    def close(self) -> None:
        self._closed.set()
        self._ended.wait()
        with suppress(Empty):
            # behind `None` no worker comes to them
            while (job := self._ready.get_nowait()) is not None:
                job[0].close()
        for _ in range(WORKERS):
            self._ready.put(None)

    def wait_for(self, seconds: float | None) -> None:
        """Say, in a worker's thread, that it waits for its client from now on, and for
        how long at most; None that it does not.
        """
        client = self._served[threading.get_ident()]
        now = time.monotonic()
        client.since, client.due = (
            (math.inf, math.inf) if seconds is None else (now, now + seconds)
        )

    def _watch(self, selector: selectors.BaseSelector) -> None:
        """Hand each connection that has said something to the workers, and end those
        whose time is up.
        """
        silent: dict[Any, tuple[Any, float]] = {}
        listens = False
        while not self._closed.is_set():
            room = len(silent) + self._ready.qsize() < WAITING
            if room and not listens:
                selector.register(self._listening, selectors.EVENT_READ)
            elif listens and not room:
                selector.unregister(self._listening)
            listens = room
            for key, _ in selector.select(TICK):
                connection: Any = key.fileobj
                if connection is self._listening:
                    with suppress(OSError):
                        connection, address = self._listening.accept()
                        silent[connection] = address, time.monotonic()
                        selector.register(connection, selectors.EVENT_READ)
                else:
                    selector.unregister(connection)
                    self._ready.put((connection, silent.pop(connection)[0]))
            now = time.monotonic()
            most = PATIENCE if room else min(PATIENCE, GRACE)
            for connection in [
                one for one, (_, since) in silent.items() if now - since > most
            ]:
                del silent[connection]
                selector.unregister(connection)
                connection.close()
            served = sorted(self._served.copy().values(), key=lambda one: one.since)
            others = self._ready.qsize() if len(served) == WORKERS else 0
            # where others wait, those end too that have had `GRACE`, the slowest first
            for one in served:
                pressed = others > 0 and now - one.since > GRACE
                if one.due < now or pressed:
                    others -= 1
                    one.since = one.due = math.inf
                    # not the method of an SSL socket, which would forget that it is one
                    with suppress(OSError):
                        socket.socket.shutdown(one.connection, socket.SHUT_RDWR)
        for connection in silent:
            connection.close()

    def serve_one(self, connection: socket.socket, address: Any) -> None:
        """Answer one client, in this thread; whatever it does, nothing is raised."""
        own = threading.get_ident()
        try:
            connection.setblocking(True)
            if self._context is not None:
                connection = self._context.wrap_socket(
                    connection, server_side=True, do_handshake_on_connect=False
                )
            self._served[own] = _Served(connection)
            self.wait_for(PATIENCE)
            if isinstance(connection, ssl.SSLSocket):
                connection.do_handshake()
            self._answer(connection, address)
        except Exception:
            return
        finally:
            self._served.pop(own, None)
            with suppress(OSError):
                socket.socket.shutdown(connection, socket.SHUT_WR)
            connection.close()


def qr_text(address: str) -> str | None:
    """Return an address as a QR code for a terminal; None where segno is not
    installed.
    """
    code = qr_code(address)
    text = io.StringIO()
    if code is not None:
        code.terminal(out=text, compact=True)
    return text.getvalue() or None


def qr_code(address: str) -> Any:
    """Return a QR code of an address; None where segno is not installed."""
    try:
        return importlib.import_module("segno").make(address, error="m", micro=False)
    except ImportError:
        return None
