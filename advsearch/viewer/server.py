"""`advsearch dashboard`: the pages of runs from a small server, on this machine unless asked otherwise.

It answers GET and HEAD of the list, of a run's page, rows and pictures, POST of a photograph, and nothing else. No part
of an address becomes a path. A request whose `Host` is not this server's is refused (DNS rebinding); so is one that
another origin's page sends. Beyond this machine every request needs the token, and goes over HTTPS, with a certificate
that `openssl` makes and that is good for as long as the server runs. A photograph needs the key of this server's page.
"""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import re
import secrets
import socket
import ssl
import subprocess
import tempfile
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from queue import Queue
from typing import Any
from urllib.parse import parse_qs, quote, unquote, urlsplit

from advsearch import rooms
from advsearch.errors import AdvsearchError, InputError
from advsearch.files import open_regular
from advsearch.report.markup import element
from advsearch.runs import files, listing
from advsearch.runs.directory import COLUMNS, HOME, PARTS, REPORT, is_run
from advsearch.viewer.columns import read_columns
from advsearch.viewer.dashboard import START, following_page, is_under_way, list_page, progress_json
from advsearch.viewer.sweep_page import SweepSource, result_of, sweep_page_html
from advsearch.viewer.thumbnails import cover, kept_pictures, path_of

DAYS = 7
"""For which a certificate is good."""


def https_context(hosts: Sequence[str]) -> tuple[ssl.SSLContext, str]:
    """Return what speaks HTTPS under some names and addresses, and the SHA-256 fingerprint of its new certificate.
    Raises InputError where there is no `openssl`, or it makes none."""
    names = ",".join(f"IP:{host}" if is_address(host) else f"DNS:{host}" for host in dict.fromkeys(hosts))
    with tempfile.TemporaryDirectory(prefix="advsearch-") as folder:  # mode 0700
        key, certificate = Path(folder) / "key.pem", Path(folder) / "certificate.pem"
        key.touch(mode=0o600)
        command = ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes"]
        command += ["-keyout", str(key), "-out", str(certificate), "-days", str(DAYS), "-subj", "/CN=advsearch"]
        command += ["-addext", f"subjectAltName={names}", "-addext", "extendedKeyUsage=serverAuth"]
        try:
            subprocess.run(command, check=True, capture_output=True, timeout=30.0, stdin=subprocess.DEVNULL)
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


class Refused(Exception):
    """A request that is not answered as asked."""

    def __init__(self, status: HTTPStatus, text: str) -> None:
        super().__init__(text)
        self.status = status


LOOPBACK = "127.0.0.1"

FIRST_PART, PART = 4_000, 50_000
"""Rows of a sweep that goes on that are sent at once; reading more takes longer than somebody waits for the first."""

LARGEST = 1 << 30
"""Most bytes of a sweep's columns."""

WORKERS = 16
"""Requests that are answered at once; others wait."""

WAITING = 128
"""Connections that may wait for a worker; as many more as `BACKLOG` wait in the operating system, without a file open
here."""

BACKLOG = 4096

PATIENCE = 20.0
"""Seconds after which a connection that sends or takes nothing is closed."""

LONGEST = 4096
"""Characters of an address."""

COOKIE = "advsearch"


class Dashboard(HTTPServer):
    """The server. `serve_forever` answers until `shutdown`.

    Args:
        runs: folders of runs; empty for those in ``runs/``, looked up anew for each request.
        host: address to listen at.
        port: 0 takes a free one.
        https: speak HTTPS on this machine too; beyond it that is always so.
        photographs: takes photographs in; None refuses them.

    Attributes:
        token: what every request has to bring; None on this machine only.
        key: what a photograph has to bring besides.
        fingerprint: SHA-256 of the certificate; None without HTTPS.
        photographs: as given.

    Raises:
        InputError: the address can't be listened at, or there is nothing to make a certificate.
    """

    request_queue_size = BACKLOG
    allow_reuse_address = True

    def __init__(
        self,
        runs: Sequence[Path],
        host: str = LOOPBACK,
        port: int = 0,
        *,
        https: bool = False,
        photographs: object | None = None,
    ) -> None:
        self._given = tuple(runs)
        here = host == "localhost" or (is_address(host) and ipaddress.ip_address(host).is_loopback)
        self.token = None if here else secrets.token_urlsafe(24)
        self.key, self.photographs = secrets.token_urlsafe(24), photographs
        self._host, self.fingerprint = host, None
        self._context: ssl.SSLContext | None = None
        if https or self.token:
            names = (reachable(host), "localhost", LOOPBACK)
            self._context, self.fingerprint = https_context(names)
        self._waiting: Queue[tuple[socket.socket, Any] | None] = Queue(WAITING)
        try:
            super().__init__((host, port), _Handler)
        except (OSError, OverflowError) as error:
            raise InputError(f"host and port: cannot listen at {host}:{port}: {error}") from None
        for _ in range(WORKERS):
            threading.Thread(target=self._work, daemon=True).start()

    @property
    def scheme(self) -> str:
        """``"https"`` or ``"http"``."""
        return "http" if self._context is None else "https"

    @property
    def address(self) -> str:
        """What to open in a browser."""
        return self.address_of("/")

    def address_of(self, path: str) -> str:
        """What to open in a browser, here or elsewhere, to see a page."""
        host = reachable(self._host)
        host = f"[{host}]" if ":" in host else host
        return f"{self.scheme}://{host}:{self.server_port}{path}" + (f"?token={self.token}" if self.token else "")

    def runs(self) -> Mapping[str, Path]:
        """The runs that are shown, by the name under which they are."""
        folders = self._given or tuple(path for path in sorted(HOME.glob("*")) if path.is_dir() and is_run(path))
        names: dict[str, Path] = {}
        for path in folders:
            name, number = path.resolve().name, 2
            while name in names:
                name, number = f"{path.resolve().name} ({number})", number + 1
            names[name] = path
        return names

    def process_request(self, request: Any, client_address: Any) -> None:
        """Let a worker answer."""
        self._waiting.put((request, client_address))

    def _work(self) -> None:
        while (job := self._waiting.get()) is not None:
            request, client = job
            try:
                request.settimeout(PATIENCE)
                if self._context is not None:
                    request = self._context.wrap_socket(request, server_side=True)
                self.finish_request(request, client)
            except Exception:
                continue  # whatever one client does, the others are answered
            finally:
                self.shutdown_request(request)

    def server_close(self) -> None:
        """Stop listening and let the workers go."""
        super().server_close()
        for _ in range(WORKERS):
            self._waiting.put(None)


class _Handler(BaseHTTPRequestHandler):
    server: Dashboard
    protocol_version = "HTTP/1.0"
    server_version, sys_version = "advsearch", ""

    def do_GET(self) -> None:
        self._answer(body=True)

    def do_HEAD(self) -> None:
        self._answer(body=False)

    def do_POST(self) -> None:
        self._answer(body=True)

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing."""

    def _answer(self, *, body: bool) -> None:
        headers: dict[str, str] = {}
        try:
            self._check()
            kind, data, headers = self._found(_POSTED if self.command == "POST" else _ROUTES)
            status = HTTPStatus.OK
        except Refused as refused:
            status, kind, data = refused.status, "text/plain; charset=utf-8", f"{refused}\n".encode()
        except AdvsearchError as error:
            status, kind, data = HTTPStatus.INTERNAL_SERVER_ERROR, "text/plain; charset=utf-8", f"{error}\n".encode()
        except OSError:
            status, kind, data = HTTPStatus.NOT_FOUND, "text/plain; charset=utf-8", b"it is not there any more\n"
        self.send_response(status)
        for name, value in {
            "Content-Type": kind,
            "Content-Length": str(len(data)),
            "Cache-Control": "no-store",
            "X-Content-Type-Options": "nosniff",
            "X-Frame-Options": "DENY",
            "Referrer-Policy": "no-referrer",
            "Cross-Origin-Resource-Policy": "same-origin",
            "Permissions-Policy": "camera=(self), microphone=(), geolocation=()",
            **headers,
        }.items():
            self.send_header(name, value)
        self.end_headers()
        if body:
            self.wfile.write(data)

    # ---- who may ask -------------------------------------------------------------------------------------------------

    def _check(self) -> None:
        if len(self.path) > LONGEST:
            raise Refused(HTTPStatus.REQUEST_URI_TOO_LONG, "the address is too long")
        host = self.headers.get("Host", "")
        if not self._is_own(host):
            raise Refused(HTTPStatus.FORBIDDEN, "this server is not called so; open the address that it printed")
        origin = self.headers.get("Origin")
        if origin is not None and origin != f"{self.server.scheme}://{host}":
            raise Refused(HTTPStatus.FORBIDDEN, "a page of another origin asks; open the address that was printed")
        if self.headers.get("Sec-Fetch-Site", "none") not in ("none", "same-origin"):
            if self.headers.get("Sec-Fetch-Mode") != "navigate":
                raise Refused(HTTPStatus.FORBIDDEN, "a page of another site asks")
        token = self.server.token
        if token is not None and not any(hmac.compare_digest(token, one) for one in self._tokens()):
            raise Refused(HTTPStatus.UNAUTHORIZED, "the token is missing; open the address that was printed")

    def _is_own(self, host: str) -> bool:
        """Whether a request's Host is an address of this server: a name would need a name server to lead here."""
        name, _, port = host.rpartition(":")
        if not port.isdecimal() or int(port) != self.server.server_port:
            return False
        if self.server.token is None:
            return name in ("localhost", LOOPBACK, "[::1]")
        return name in ("localhost", self.server._host) or is_address(name.removeprefix("[").removesuffix("]"))

    def _tokens(self) -> list[str]:
        given = parse_qs(urlsplit(self.path).query).get("token", [])
        for part in self.headers.get("Cookie", "").split(";"):
            name, _, value = part.strip().partition("=")
            if name == f"{COOKIE}-{self.server.server_port}":
                given.append(value)
        return [one for one in given if one.isascii()]

    # ---- what is answered --------------------------------------------------------------------------------------------

    def _found(self, routes: Routes) -> tuple[str, bytes, dict[str, str]]:
        if not self.path.startswith("/"):
            raise Refused(HTTPStatus.BAD_REQUEST, "this server is no proxy")
        address = urlsplit(self.path)
        query = parse_qs(address.query)
        headers = {}
        if self.server.token and "token" in query:
            cookie = f"{COOKIE}-{self.server.server_port}={self.server.token}"
            headers["Set-Cookie"] = f"{cookie}; HttpOnly; Secure; SameSite=Strict; Path=/"
        for pattern, answer in routes:
            match = re.fullmatch(pattern, address.path)
            if match:
                kind, data = answer(self, query, *map(unquote, match.groups()))
                return kind, data, headers
        raise Refused(HTTPStatus.NOT_FOUND, "there is no such page")

    def _run(self, name: str) -> Path:
        found = self.server.runs().get(name)
        if found is None:
            raise Refused(HTTPStatus.NOT_FOUND, "there is no such run")
        return found

    def _page(self, _query: Mapping[str, list[str]], name: str) -> tuple[str, bytes]:
        run = self._run(name)
        if listing.listed_run(run, counts=False).command == "sweep":
            return _html(sweep_page_html([(run, result_of(run))], [_source(name, run, "")]).encode(), "../../")
        report = run / REPORT
        if report.is_symlink():
            raise Refused(HTTPStatus.NOT_FOUND, f"{name} has no page; advsearch show {name} prints what it has")
        if is_under_way(run):
            return _html(following_page(name, run).encode(), "../../")
        return _html(report.read_bytes(), "../../")

    def _part(self, _query: Mapping[str, list[str]], name: str, part: str) -> tuple[str, bytes]:
        """The page of one of the attacks that a study consists of, where the study's page links to it."""
        found = next((one for one in (self._run(name) / PARTS).iterdir() if one.name == part), None)
        report = None if found is None or found.is_symlink() else found / REPORT
        if report is None or report.is_symlink() or not report.is_file():
            raise Refused(HTTPStatus.NOT_FOUND, "there is no such attack")
        return _html(report.read_bytes(), "../../../../", ("../../", name))

    def _compare(self, query: Mapping[str, list[str]]) -> tuple[str, bytes]:
        names = list(dict.fromkeys(query.get("run", [])))
        if not names:
            raise Refused(HTTPStatus.BAD_REQUEST, "choose at least one sweep")
        runs = [(name, self._run(name)) for name in names]
        other = [name for name, run in runs if listing.listed_run(run, counts=False).command != "sweep"]
        if other:
            raise Refused(HTTPStatus.BAD_REQUEST, f"only sweeps can be shown side by side; {', '.join(other)} is none")
        sources = [_source(name, run, f"../runs/{quote(name, safe='')}/") for name, run in runs]
        return _html(sweep_page_html([(run, result_of(run)) for _, run in runs], sources).encode(), "../")

    def _rows(self, query: Mapping[str, list[str]], name: str) -> tuple[str, bytes]:
        run = self._run(name)
        after = _after(query, 0)
        if not after and (run / COLUMNS).is_file() and listing.finished(run):
            with open_regular(run / COLUMNS, "columns of a sweep", LARGEST) as file:
                return "application/octet-stream", file.read()
        part = PART if after else FIRST_PART
        running = files.is_held(run)  # before the rows are read: what comes later is asked for again
        columns = read_columns(run, after, part)
        more = len(columns.step) == part
        return "application/octet-stream", replace(columns, more=more, running=running).packed()

    # ---- photographs -------------------------------------------------------------------------------------------------

    def _align(self, _query: Mapping[str, list[str]], name: str) -> tuple[str, bytes]:
        path = f"/runs/{quote(name, safe='')}/align/"
        elsewhere = self.server.address_of(path) if self.server.token else None
        _, made = _photographs("photographs_html")(
            self.server.photographs, self._run(name), name, self.server.key, elsewhere
        )
        return _html(made, "../../../", ("../", name))

    def _take(self, _query: Mapping[str, list[str]], name: str, rendering: str) -> tuple[str, bytes]:
        _photographs("check_sender")(self.headers, self.server.key)
        data = partial(_photographs("request_body"), self.headers, self.rfile)
        return _photographs("take")(self.server.photographs, self._run(name), rendering, data)

    def _picture(self, _query: Mapping[str, list[str]], name: str, number: str) -> tuple[str, bytes]:
        file = path_of(self._run(name), int(number))
        if file.is_symlink():
            raise Refused(HTTPStatus.NOT_FOUND, "there is no such picture")
        return "image/jpeg", file.read_bytes()


Handler = Callable[..., tuple[str, bytes]]
Routes = tuple[tuple[str, Handler], ...]

_ROUTES: Routes = (
    ("/", lambda self, _: ("text/html; charset=utf-8", list_page(self.server.runs()).encode())),
    ("/compare/", _Handler._compare),
    ("/runs/([^/]+)/", _Handler._page),
    ("/runs/([^/]+)/cover", lambda self, _, name: ("image/jpeg", cover(self._run(name)))),
    ("/runs/([^/]+)/rows", _Handler._rows),
    (
        "/runs/([^/]+)/progress",
        lambda self, query, name: ("application/json", progress_json(self._run(name), _after(query, START))),
    ),
    (f"/runs/([^/]+)/{PARTS}/([^/]+)/{re.escape(REPORT)}", _Handler._part),
    (r"/runs/([^/]+)/pictures/[0-9]+/([0-9]{1,12})\.jpg", _Handler._picture),
    ("/runs/([^/]+)/align/", _Handler._align),
    (
        "/runs/([^/]+)/align/renderings/([^/]+)",
        lambda self, _, name, one: _photographs("rendering_picture")(self._run(name), one),
    ),
    ("/runs/([^/]+)/align/photos/([^/]+)", lambda self, _, name, one: _photographs("photo")(self._run(name), one)),
)

_POSTED: Routes = (("/runs/([^/]+)/align/renderings/([^/]+)", _Handler._take),)
"""What is sent, not asked for."""


def _after(query: Mapping[str, list[str]], otherwise: int) -> int:
    after = query.get("after", [str(otherwise)])[0]
    if not re.fullmatch(r"[0-9]{1,15}", after):
        raise Refused(HTTPStatus.BAD_REQUEST, "after: expected the id of a row")
    return int(after)


def _photographs(what: str) -> Callable[..., tuple[str, bytes]]:
    """A part of what takes photographs in, which the tool works without."""
    found: Callable[..., tuple[str, bytes]] | None = rooms.in_room("photographs", "answer", what)
    if found is None:
        raise Refused(HTTPStatus.NOT_FOUND, "there are no photographs")
    return found


def _source(name: str, run: Path, base: str) -> SweepSource:
    """Where a page gets a sweep's rows and pictures; `base` leads from the page to the run's own address."""
    return SweepSource(name, f"{base}rows", parts=True, pictures=kept_pictures(run), folder=f"{base}pictures")


def _html(page: bytes, home: str, above: tuple[str, str] | None = None) -> tuple[str, bytes]:
    """Return a page with the way back: to the list, and to what it is a part of (an address and its name)."""
    links = [("All runs", home), *([(above[1], above[0])] if above else [])]
    way = element("nav", *(element("a", text, href=address) for text, address in links), aria_label="back")
    return "text/html; charset=utf-8", page.replace(b"<body>", b"<body>" + way.encode(), 1)
