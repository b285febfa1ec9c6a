"""The connections of the dashboard's server: worker threads, time limits, and HTTPS.

A fixed number of worker threads serve the requests. A client that has sent nothing yet
occupies none of them. A slow client occupies one until its time is up; if other clients
wait, its time is `SLOW_CLIENT_SECONDS`.
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
from typing import Any, NamedTuple

N_WORKERS = 16  # number of requests that are served at the same time
MAX_WAITING = 128
"""Maximum number of open connections that wait for a worker or for their client.

More connections wait in the operating system, without an open file in this process.
"""
# Maximum seconds for a client to send its request.
REQUEST_SECONDS = 10.0
# Minimum bytes per second at which a client must read the response, after
# `REQUEST_SECONDS`.
MIN_BYTES_PER_SECOND = 50_000
# Maximum seconds for a slow client if others wait.
SLOW_CLIENT_SECONDS = 1.0
# seconds between two checks of the time limits
CHECK_INTERVAL = 0.05
# maximum bytes of a request's body
MAX_BODY_BYTES = 16 << 20
# The command that installs the package for QR codes.
NO_QR = "pip install segno"


def find_reachable_address(host: str) -> str:
    """Return the address under which other machines reach a server.

    Args:
        host: address at which the server listens. If it is that of all addresses
            ("0.0.0.0" or "::"), the result is the address that this machine uses for
            the internet; without a network it is the loopback address.
    """
    if host not in ("0.0.0.0", "::", ""):
        return host
    # The remote address is of a machine far away; these addresses are for
    # documentation, RFC 3849 and RFC 5737.
    try:
        if host == "::":
            return _find_sending_address(socket.AF_INET6, "2001:db8::1")
        return _find_sending_address(socket.AF_INET, "192.0.2.1")
    except OSError:
        return "::1" if host == "::" else "127.0.0.1"


def _find_sending_address(family: socket.AddressFamily, remote: str) -> str:
    """Return the address from which this machine would send to another one.

    Args:
        family: family of both addresses.
        remote: address of the other machine.

    Raises:
        OSError: there is no network.
    """
    with socket.socket(family, socket.SOCK_DGRAM) as probe:
        # nothing is sent: the system only chooses the address of this machine from
        # which it would send, whatever the port
        probe.connect((remote, 9))
        return str(probe.getsockname()[0])


@dataclass(eq=False)
class _Connection:
    """A connection that a worker serves.

    Attributes:
        connection: socket of the client.
        since: time at which the worker began to wait for the client; infinite if it
            does not wait, but computes the response.
        due: time until which the worker waits; infinite in the same case.
    """

    connection: socket.socket
    since: float = math.inf
    due: float = math.inf

    def disconnect(self) -> None:
        """End the connection, on which the worker's next read or write then fails."""
        # These values make it neither slow nor overdue, so that it is not disconnected
        # twice.
        self.since = math.inf
        self.due = math.inf
        # The plain method: that of an SSL socket would forget that it is one.
        with suppress(OSError):
            socket.socket.shutdown(self.connection, socket.SHUT_RDWR)


class _SilentClient(NamedTuple):
    """A client that has sent nothing yet: its address, and the time of its connection."""

    address: Any
    since: float


class ConnectionPool:
    """Accepts connections, and serves them in worker threads until `close`.

    Args:
        listening_socket: the socket that listens.
        handle: function that serves a connection in a worker thread. It calls
            `report_waiting` when it begins or ends to wait for the client.
        context: TLS context for HTTPS; None for HTTP.
    """

    def __init__(
        self,
        listening_socket: socket.socket,
        handle: Callable[[socket.socket, Any], None],
        context: ssl.SSLContext | None,
    ) -> None:
        """Make a pool of workers for connections.

        Args:
            listening_socket: socket of the server, which listens already.
            handle: function that serves a connection, given it and the client's
                address.
            context: TLS context for encrypted connections; None for plain ones.
        """
        self._listening = listening_socket
        self._handle = handle
        self._context = context
        # Connections that have sent something and wait for a worker, with the address of
        # the client; None ends a worker. The newest is served first: many old ones may be
        # an attack.
        self._ready: LifoQueue[tuple[socket.socket, Any] | None] = LifoQueue()
        self._connections: dict[int, _Connection] = {}  # by the thread of their worker
        self._closed = threading.Event()
        # set unless `serve` runs, so that `close` does not wait if it was never called
        self._ended = threading.Event()
        self._ended.set()

    def serve(self) -> None:
        """Serve connections until `close` is called.

        This thread accepts connections, and worker threads serve them.
        """
        self._ended.clear()
        for _ in range(N_WORKERS):
            threading.Thread(target=self._serve_ready, daemon=True).start()
        try:
            with selectors.DefaultSelector() as selector:
                self._watch(selector)
        finally:
            self._ended.set()

    def _serve_ready(self) -> None:
        """Serve the connections that are ready, until the pool is closed."""
        while True:
            job = self._ready.get()
            if job is None:  # put by `close`
                return
            connection, address = job
            self.serve_connection(connection, address)

    def close(self) -> None:
        """End `serve`, and close the connections that wait for a worker."""
        self._closed.set()
        self._ended.wait()  # `serve` checks `_closed` every CHECK_INTERVAL
        # Close the connections before any `None` is put into the queue. The last entry
        # is taken first, so workers would take the `None`, end, and leave them open.
        with suppress(Empty):
            while True:
                job = self._ready.get_nowait()
                if job is None:  # the pool was closed before
                    break
                connection, _address = job
                connection.close()
        for _ in range(N_WORKERS):
            self._ready.put(None)

    def report_waiting(self, seconds: float | None) -> None:
        """Report that the worker of this thread waits for its client, or no longer.

        A client that lets its worker wait too long is disconnected.

        Args:
            seconds: how long the worker will wait at most; None if it no longer waits.
        """
        client = self._connections[threading.get_ident()]
        if seconds is None:
            client.since = math.inf
            client.due = math.inf
            return
        now = time.monotonic()
        client.since = now
        client.due = now + seconds

    def _watch(self, selector: selectors.BaseSelector) -> None:
        """Accept connections and pass them to the workers until the pool is closed.

        A connection is passed on when its client has sent something, so that silent
        clients occupy no worker. Connections that remain silent too long are closed.

        Args:
            selector: selector that waits for all sockets.
        """
        # connections that have sent nothing yet
        silent: dict[Any, _SilentClient] = {}
        listens = False  # whether the selector waits for new connections at present
        while not self._closed.is_set():
            # with too many connections, new ones wait in the system's queue
            has_room = len(silent) + self._ready.qsize() < MAX_WAITING
            if has_room and not listens:
                selector.register(self._listening, selectors.EVENT_READ)
            elif listens and not has_room:
                selector.unregister(self._listening)
            listens = has_room
            for key, _ in selector.select(CHECK_INTERVAL):
                self._accept_or_pass_on(key.fileobj, silent, selector)
            now = time.monotonic()
            _close_silent(silent, selector, now, others_wait=not has_room)
            self._end_slow_clients(now)
        for connection in silent:
            connection.close()

    def _accept_or_pass_on(
        self,
        connection: Any,
        silent: dict[Any, _SilentClient],
        selector: selectors.BaseSelector,
    ) -> None:
        """Accept a new connection, or pass one that has sent something to the workers.

        Args:
            connection: the socket at which something has come: the one that listens, or
                that of a silent client.
            silent: silent clients by connection, which are changed.
            selector: selector that waits for all sockets.
        """
        if connection is self._listening:
            with suppress(OSError):  # the client may have gone
                connection, address = self._listening.accept()
                silent[connection] = _SilentClient(address, time.monotonic())
                selector.register(connection, selectors.EVENT_READ)
        else:  # a silent client has sent something
            selector.unregister(connection)
            client = silent.pop(connection)
            self._ready.put((connection, client.address))

    def _end_slow_clients(self, now: float) -> None:
        """Disconnect clients for which a worker has waited too long.

        If other connections wait because all workers are busy, clients for which a
        worker has waited over `SLOW_CLIENT_SECONDS` are disconnected too: the slowest
        first, and only as many as workers are needed.

        Args:
            now: the present time (`time.monotonic`).
        """
        clients = list(self._connections.copy().values())
        clients.sort(key=lambda client: client.since)  # the slowest first
        n_needed_workers = 0  # as long as a worker is free, none is needed
        if len(clients) == N_WORKERS:
            n_needed_workers = self._ready.qsize()
        for client in clients:
            is_overdue = client.due < now
            is_slow = now - client.since > SLOW_CLIENT_SECONDS
            must_make_room = n_needed_workers > 0 and is_slow
            if not is_overdue and not must_make_room:
                continue
            n_needed_workers -= 1  # its worker becomes free
            client.disconnect()

    def serve_connection(self, connection: socket.socket, address: Any) -> None:
        """Serve one client in this thread.

        Nothing is raised, whatever the client sends, since an error would end the
        worker.

        Args:
            connection: socket of the connection.
            address: address of the client.
        """
        thread = threading.get_ident()
        try:
            connection.setblocking(True)
            if self._context is not None:
                connection = _encrypt_without_handshake(connection, self._context)
            self._connections[thread] = _Connection(connection)
            self.report_waiting(REQUEST_SECONDS)
            if isinstance(connection, ssl.SSLSocket):
                connection.do_handshake()
            self._handle(connection, address)
        except Exception:
            return
        finally:
            self._connections.pop(thread, None)
            with suppress(OSError):
                # the plain method: that of an SSL socket would forget that it is one
                socket.socket.shutdown(connection, socket.SHUT_WR)
            connection.close()


def _encrypt_without_handshake(
    connection: socket.socket, context: ssl.SSLContext
) -> ssl.SSLSocket:
    """Return a connection that is encrypted after its handshake.

    The handshake waits for the client. So it is done later, where the waiting time is
    measured.

    Args:
        connection: socket of the plain connection, which is not used afterwards.
        context: TLS context of the server.
    """
    return context.wrap_socket(
        connection, server_side=True, do_handshake_on_connect=False
    )


def _close_silent(
    silent: dict[Any, _SilentClient],
    selector: selectors.BaseSelector,
    now: float,
    *,
    others_wait: bool,
) -> None:
    """Close connections that have been silent for too long.

    Args:
        silent: silent clients by connection; those that are closed are removed.
        selector: selector that waits for them.
        now: the present time (`time.monotonic`).
        others_wait: whether other connections wait, so that there is less time.
    """
    max_silence = REQUEST_SECONDS
    if others_wait:
        max_silence = min(REQUEST_SECONDS, SLOW_CLIENT_SECONDS)
    for connection, client in list(silent.items()):
        if now - client.since > max_silence:
            del silent[connection]
            selector.unregister(connection)
            connection.close()


def format_qr_code(address: str) -> str | None:
    """Return an address as a QR code for a terminal, None if segno is not installed."""
    code = make_qr_code(address)
    text = io.StringIO()
    if code is not None:
        code.terminal(out=text, compact=True)
    return text.getvalue() or None


def make_qr_code(address: str) -> Any:
    """Return the QR code of an address, None if segno is not installed."""
    try:
        return importlib.import_module("segno").make(address, error="m", micro=False)
    except ImportError:
        return None
