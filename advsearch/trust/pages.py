"""Check requests to our server, and restrict what its pages may do in a browser.

The threat: another site in the same browser sends requests to this server, under a name
that resolves to this machine (DNS rebinding) or from its own pages; somebody else on
the network sends requests; or a page in the folder of a run of somebody else runs
scripts that read other runs or send them elsewhere. So a request must have the address
of this server, must come from no other origin, and must have the token if it comes from
another machine. A page runs only scripts of this package.

Used by the dashboard's server (`viewer/server.py`), by the frame of every page
(`viewer/document.py`) and for photographs (`questions/photographs/result.py`).
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import re
from collections.abc import Collection, Iterable
from email.message import Message
from http import HTTPStatus
from urllib.parse import parse_qs, urlsplit

from advsearch.trust.network import is_address

LOOPBACK = "127.0.0.1"
LONGEST = 4096  # maximum number of characters of an address
COOKIE = "advsearch"  # beginning of the name of the cookie with the token

CLOSED = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(self), microphone=(), geolocation=()",
}
"""Headers of every response, in addition to its `Content-Security-Policy`."""


class RequestRejected(Exception):
    """A request that is rejected.

    Args:
        status: HTTP status of the response.
        text: reason, for the response.
    """

    def __init__(self, status: HTTPStatus, text: str) -> None:
        super().__init__(text)
        self.status = status


def check_request(
    command: str,
    path: str,
    headers: Message,
    scheme: str,
    listen_host: str,
    port: int,
    token: str | None,
) -> None:
    """Check that a request may be answered.

    A web page of somebody else, open in the same browser, could send requests to this
    server. So the host, the origin and the site of the request are checked, and the
    token if the server can be reached from other machines.

    Args:
        command: HTTP method, such as "GET".
        path: requested path with its query.
        headers: headers of the request.
        scheme: scheme of the server, "http" or "https".
        listen_host: host at which the user made the server listen.
        port: port at which it listens.
        token: secret that the query or a cookie must contain; None for a server that
            only this machine can reach.

    Raises:
        RequestRejected: the request may not be answered.
    """
    if len(path) > LONGEST:
        raise RequestRejected(
            HTTPStatus.REQUEST_URI_TOO_LONG, "the address is too long"
        )
    host = headers.get("Host", "")
    if not _is_server_address(host, listen_host, port, token):
        raise RequestRejected(
            HTTPStatus.FORBIDDEN,
            "this is not the address of the server; open the address that it printed",
        )
    _check_origin(headers, f"{scheme}://{host}")
    _check_site(command, headers)
    if token is not None and not _has_token(path, headers, port, token):
        raise RequestRejected(
            HTTPStatus.UNAUTHORIZED,
            "the token is missing; open the address that was printed",
        )


def _check_origin(headers: Message, server_origin: str) -> None:
    """Check that a request is not from a page of another origin.

    Args:
        headers: headers of the request.
        server_origin: the origin of our pages, such as "http://localhost:8265".

    Raises:
        RequestRejected: it is from such a page.
    """
    origin = headers.get("Origin")
    if origin is not None and origin != server_origin:
        raise RequestRejected(
            HTTPStatus.FORBIDDEN,
            "the request is from a page of another origin; open the address that was "
            "printed",
        )


def _check_site(command: str, headers: Message) -> None:
    """Check that a request is not from another site, unless it follows a link.

    Args:
        command: HTTP method, such as "GET".
        headers: headers of the request.

    Raises:
        RequestRejected: it is from another site.
    """
    # "none" is a request of the user, such as an address that was typed. The header is
    # missing in requests of programs and old browsers.
    site = headers.get("Sec-Fetch-Site", "none")
    is_same_origin = site in ("none", "same-origin")
    # Another site may link to a page here, which the user then sees. It cannot read
    # that page, and a POST from it is rejected, since that could change something.
    follows_link = headers.get("Sec-Fetch-Mode") == "navigate" and command != "POST"
    if not is_same_origin and not follows_link:
        raise RequestRejected(
            HTTPStatus.FORBIDDEN, "the request is from a page of another site"
        )


def _has_token(path: str, headers: Message, port: int, token: str) -> bool:
    """Return whether a request has the server's token in its query or in a cookie.

    The name of the cookie contains the port, since browsers send cookies to all ports
    of a host.
    """
    tokens = parse_qs(urlsplit(path).query).get("token", [])
    for part in headers.get("Cookie", "").split(";"):
        name, _, value = part.strip().partition("=")
        if name == f"{COOKIE}-{port}":
            tokens.append(value)
    # `compare_digest` takes as long for a wrong token as for the right one, so that the
    # time does not reveal it. It accepts ASCII only.
    return any(
        hmac.compare_digest(token, candidate)
        for candidate in tokens
        if candidate.isascii()
    )


def _is_server_address(host: str, named: str, port: int, token: str | None) -> bool:
    """Return whether the Host of a request is an address of this server.

    Any other name is rejected, since a foreign site could make its own name resolve to
    this machine (DNS rebinding). A numeric address is accepted, since no name server
    can redirect it.

    Args:
        host: the header Host of the request, NAME:PORT.
        named: host at which the user made the server listen.
        port: port at which it listens.
        token: token of the server; None if only this machine can reach it.
    """
    name, _, port_text = host.rpartition(":")
    if not port_text.isdecimal() or int(port_text) != port:
        return False
    if token is None:
        return name in ("localhost", LOOPBACK, "[::1]")
    return name in ("localhost", named) or is_address(
        name.removeprefix("[").removesuffix("]")
    )


def make_token_cookie(port: int, token: str) -> str:
    """Return the cookie with the token, which a browser stores so that links need none.

    It is lax, because the page of a run has another origin, and links on it lead back
    to the list.
    """
    return f"{COOKIE}-{port}={token}; HttpOnly; Secure; SameSite=Lax; Path=/"


def compute_script_digest(code: bytes) -> str:
    """Return the SHA-256 of a script in base64, as in a Content-Security-Policy."""
    return base64.b64encode(hashlib.sha256(code).digest()).decode()


def make_page_policy(digests: Iterable[str], *, connects: bool) -> str:
    """Return the Content-Security-Policy of a page: what it may load and run.

    Args:
        digests: SHA-256 digests of the scripts that may run.
        connects: whether the page may load images from its server and send requests
            there. Other images are part of the page ("data:").
    """
    images = "data:"
    connections = ""
    if connects:
        images = "data: 'self'"
        connections = "; connect-src 'self'"
    hashes = "".join(f" 'sha256-{digest}'" for digest in sorted(digests))
    scripts = f"; script-src{hashes}" if hashes else ""
    return (
        f"default-src 'none'; img-src {images}; style-src "
        f"'unsafe-inline'{scripts}{connections}; base-uri 'none'"
    )


def make_served_policy(digests: Iterable[str], *, is_generated: bool) -> str:
    """Return the `Content-Security-Policy` that the server sends with a page.

    A page that the server made itself may send requests to it. Any other page is a file
    in the folder of a run, which may come from somebody else. It is sandboxed: it has
    an origin of its own, so that it can neither read from the server nor send anything,
    and it runs no scripts but ours.

    Args:
        digests: digests of all our scripts.
        is_generated: whether the server made the page itself.
    """
    if is_generated:
        limits = "form-action 'self'"
    else:
        limits = (
            "form-action 'none'; sandbox allow-scripts allow-popups "
            "allow-popups-to-escape-sandbox"
        )
    page_policy = make_page_policy(digests, connects=is_generated)
    return f"{page_policy}; frame-ancestors 'none'; {limits}"


def has_other_scripts(page: bytes, digests: Collection[str]) -> bool:
    """Return whether a page has a script whose digest is not in `digests`.

    Scripts that only hold data, such as JSON, do not count. The page may come from
    somebody else; the loop never goes back, so that even a long page takes little time.
    """
    end = 0  # position of the end of the previous script
    for opening in re.finditer(rb"<script", page, re.IGNORECASE):
        is_inside_script = opening.start() < end
        if is_inside_script:
            continue
        tag_end = page.find(b">", opening.end())
        if tag_end == -1:  # nothing after a tag without an end runs
            return False
        begin = tag_end + 1
        close = re.compile(rb"</script", re.IGNORECASE).search(page, begin)
        end = close.start() if close else len(page)
        # Our own pages write `type` as the first attribute of data.
        is_data = page.startswith(b' type="application/', opening.end())
        if not is_data and compute_script_digest(page[begin:end]) not in digests:
            return True
    return False
