"""Protect keys in connections to other machines, and restrict connections.

The threat: an address is stored with the run, displayed and shared. And whoever listens
to the connection, or is the target of a redirect, would get the key to a model. So the
key comes only from the environment, is sent only over HTTPS or to this machine, and is
not sent to the target of a redirect. Pages for other machines are served over HTTPS.

A library may not make connections for a model that only a file names.

Used by models behind addresses (`models/address.py`), libraries
(`models/zoo/library.py`) and the server of the dashboard (`viewer/server.py`).
"""

from __future__ import annotations

import contextlib
import hashlib
import ipaddress
import os
import re
import socket
import ssl
import subprocess
import tempfile
import threading
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import SplitResult, parse_qsl, urlsplit

from advsearch.errors import InputError

# the environment variable with the key that is sent as ``Authorization: Bearer``
KEY = "ADVSEARCH_MODEL_KEY"


def check_address(spec: str) -> SplitResult:
    """Check that a model's address is safe to use and to store, and return its parts.

    Raises:
        InputError: it has no host; it contains a secret, which would be stored with the
            run; or the key from the environment would be sent there unencrypted.
    """
    address = _parse_address(spec)
    host = address.hostname
    is_plain = spec.isascii() and spec.isprintable() and " " not in spec
    if not host or not is_plain:
        raise InputError(f"model {spec!r}: expected an address, http://HOST:PORT/PATH")
    _check_no_secret(address)
    if read_key() and address.scheme == "http" and not is_local(host):
        raise InputError(
            f"model {spec}: the key in {KEY} would go there unencrypted; "
            f"use https, or unset {KEY}"
        )
    return address


def _parse_address(spec: str) -> SplitResult:
    """Return the parts of a model's address, of which the host and the port are valid.

    Raises:
        InputError: it is no address.
    """
    try:
        address = urlsplit(spec)
        # Only for the check: an invalid host or port raises ValueError.
        _ = address.hostname, address.port
    except ValueError as error:
        raise InputError(
            f"model {spec!r}: expected an address, http://HOST:PORT/PATH ({error})"
        ) from None
    return address


def _check_no_secret(address: SplitResult) -> None:
    """Check that an address has neither a password nor a key in its query.

    A key is recognized by its name, as in "?api_key=...".

    Raises:
        InputError: the address contains one of them.
    """
    secret_names = [
        name
        for name, _ in parse_qsl(address.query)
        if re.search("key|token|secret|passw|sig|auth", name, re.I)
    ]
    if not secret_names and "@" not in address.netloc:
        return
    where = "the user and password in the address"
    if secret_names:
        where = f"`{secret_names[0]}` in the address"
    raise InputError(
        f"model: {where} would be stored with the run; put the key into {KEY} and "
        "leave it out there"
    )


def is_local(host: str) -> bool:
    """Return whether a host is this machine."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def read_key() -> str:
    """Read the key for models behind an address from the environment; "" for none.

    Raises:
        InputError: the key is not printable ASCII.
    """
    key = os.environ.get(KEY, "").strip()
    # It is checked here because http.client would print the key in its error.
    if not (key.isascii() and key.isprintable()):
        raise InputError(
            f"{KEY}: expected a key of printable ASCII characters, got others"
        )
    return key


class NoRedirect(urllib.request.HTTPRedirectHandler):
    """Follow no redirect, since requests have a key."""

    def redirect_request(self, *_: Any) -> None:
        """Return None, so that urllib raises an HTTPError."""
        return None


DAYS = 7  # validity of a certificate


def make_https_context(hosts: Sequence[str]) -> tuple[ssl.SSLContext, str]:
    """Make a self-signed certificate for HTTPS.

    Args:
        hosts: names and addresses of the server that the certificate is valid for.

    Returns:
        The TLS context of a server that uses it, and the certificate's SHA-256
        fingerprint, pairs of hexadecimal digits between colons.

    Raises:
        InputError: the program `openssl` is missing, or it fails.
    """
    with tempfile.TemporaryDirectory(prefix="advsearch-") as folder:  # mode 0700
        key = Path(folder) / "key.pem"
        certificate = Path(folder) / "certificate.pem"
        # The file is created with its permissions before openssl writes the key, so
        # that nobody else can read it.
        key.touch(mode=0o600)
        _write_certificate(hosts, key, certificate)
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        context.load_cert_chain(certificate, key)
        data = ssl.PEM_cert_to_DER_cert(certificate.read_text(encoding="ascii"))
    digest = hashlib.sha256(data).hexdigest().upper()
    pairs = [digest[index : index + 2] for index in range(0, len(digest), 2)]
    return context, ":".join(pairs)


def _write_certificate(hosts: Sequence[str], key: Path, certificate: Path) -> None:
    """Make a key and a self-signed certificate with openssl, and write them to files.

    Raises:
        InputError: there is no such program, or it fails.
    """
    command = _make_openssl_command(hosts, key, certificate)
    try:
        subprocess.run(
            command,
            check=True,
            capture_output=True,
            timeout=30.0,
            stdin=subprocess.DEVNULL,
        )
    except FileNotFoundError:
        raise InputError(
            "https: needs the program openssl, which makes the certificate; apt-get "
            "install openssl, or leave `host` and `https` out"
        ) from None
    except (OSError, subprocess.SubprocessError) as error:
        raise _make_openssl_error(error) from None


def _make_openssl_error(error: OSError | subprocess.SubprocessError) -> InputError:
    """Return the error for a failure of openssl, with the end of what it printed."""
    output: bytes = getattr(error, "stderr", None) or b""
    text = output.decode(errors="replace")[-300:]  # the end has the reason
    return InputError(f"https: openssl made no certificate: {text or error}")


def _make_openssl_command(
    hosts: Sequence[str], key: Path, certificate: Path
) -> list[str]:
    """Return the command that writes a key and a self-signed certificate for hosts."""
    names = ",".join(
        f"IP:{host}" if is_address(host) else f"DNS:{host}"
        for host in dict.fromkeys(hosts)
    )
    return [
        *("openssl", "req", "-x509"),
        *("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes"),
        *("-keyout", str(key), "-out", str(certificate)),
        *("-days", str(DAYS), "-subj", "/CN=advsearch"),
        *("-addext", f"subjectAltName={names}"),
        *("-addext", "extendedKeyUsage=serverAuth"),
    ]


def is_address(host: str) -> bool:
    """Return whether a host is a numeric address and no name."""
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


@contextlib.contextmanager
def restrict_connections(allowed: bool, tries: list[object]) -> Iterator[None]:
    """Reject every connection that this thread makes inside the block.

    It is used while a model of a library is loaded that only a file names: a file of
    somebody else must not cause a download. Other threads connect as usual.

    Args:
        allowed: whether connections are allowed; then nothing changes.
        tries: list to which the address of each rejected connection is appended.
    """
    if allowed:
        yield
        return
    # Methods of sockets are replaced, since all libraries use them to connect.
    names = ("connect", "connect_ex")
    before = {name: getattr(socket.socket, name) for name in names}
    for name in names:
        rejecting = _make_rejecting(before[name], threading.get_ident(), tries)
        setattr(socket.socket, name, rejecting)
    try:
        yield
    finally:
        for name in names:
            setattr(socket.socket, name, before[name])


def _make_rejecting(
    connect_as_usual: Callable[[socket.socket, Any], Any],
    thread: int,
    tries: list[object],
) -> Callable[[socket.socket, Any], Any]:
    """Return a replacement of a method that rejects the connections of a thread.

    Args:
        connect_as_usual: the method, which other threads call.
        thread: identifier of the thread.
        tries: list to which the address of each rejected connection is appended.
    """

    def connect(self: socket.socket, address: Any) -> Any:
        """Connect as usual in other threads, and raise an error in this one."""
        if threading.get_ident() != thread:
            return connect_as_usual(self, address)
        tries.append(address)
        raise ConnectionRefusedError("only a file names this model")

    return connect
