"""HTTPS with a certificate of one's own: a browser opens a camera for nothing less on another machine.

The certificate is made by the `openssl` program, which about every machine has, rather than by a package that would
be installed for this alone. It is good for as long as the server runs: its key lies in a folder that only this user
can read, until it is loaded, and is deleted then. A browser can't know it, and asks; what it should show is printed.
"""

from __future__ import annotations

import hashlib
import ipaddress
import socket
import ssl
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

from advsearch.errors import InputError

DAYS = 7
"""For which a certificate is good."""

PATIENCE = 30.0
"""Seconds that making one may take."""


def https_context(hosts: Sequence[str]) -> tuple[ssl.SSLContext, str]:
    """Return what speaks HTTPS under some names and addresses, and the SHA-256 fingerprint of its new certificate.

    Raises:
        InputError: there is no `openssl`, or it makes none.
    """
    names = ",".join(f"IP:{host}" if is_address(host) else f"DNS:{host}" for host in dict.fromkeys(hosts))
    with tempfile.TemporaryDirectory(prefix="advsearch-") as folder:  # mode 0700
        key, certificate = Path(folder) / "key.pem", Path(folder) / "certificate.pem"
        key.touch(mode=0o600)
        command = ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes"]
        command += ["-keyout", str(key), "-out", str(certificate), "-days", str(DAYS), "-subj", "/CN=advsearch"]
        command += ["-addext", f"subjectAltName={names}", "-addext", "extendedKeyUsage=serverAuth"]
        try:
            subprocess.run(command, check=True, capture_output=True, timeout=PATIENCE, stdin=subprocess.DEVNULL)
        except FileNotFoundError:
            raise InputError(
                "https: needs the program openssl, which makes the certificate; apt-get install openssl, or leave "
                "`host` and `https` out"
            ) from None
        except (OSError, subprocess.SubprocessError) as error:
            text = (getattr(error, "stderr", None) or b"").decode(errors="replace")[-300:]
            raise InputError(f"https: openssl made no certificate: {text or error}") from None
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        context.load_cert_chain(certificate, key)
        data = ssl.PEM_cert_to_DER_cert(certificate.read_text(encoding="ascii"))
    digest = hashlib.sha256(data).hexdigest().upper()
    return context, ":".join(digest[place : place + 2] for place in range(0, len(digest), 2))


def reachable(host: str) -> str:
    """Return the address under which others reach what listens at `host`: of any address, the one that leads out."""
    if host not in ("0.0.0.0", "::", ""):
        return host
    family, far = (socket.AF_INET6, "2001:db8::1") if host == "::" else (socket.AF_INET, "192.0.2.1")
    try:
        with socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.connect((far, 9))  # chooses an address; nothing is sent
            return str(probe.getsockname()[0])
    except OSError:
        return "::1" if host == "::" else "127.0.0.1"


def is_address(host: str) -> bool:
    """Whether a host is a number and no name."""
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True
