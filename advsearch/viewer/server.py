"""`advsearch dashboard`: the pages of runs from a small server, on this machine unless
asked otherwise.

It answers GET and HEAD of the list, of a run's page, rows and pictures, POST of a
photograph, and nothing else. No part of an address becomes a path but a name in
`runs/`. A request whose `Host` is not this server's is refused (DNS rebinding); so is
one that another origin's page sends. Beyond this machine every request needs the token,
and goes over HTTPS, with a certificate that `openssl` makes and that is good for as
long as the server runs.

What lies in a run's folder is taken for somebody else's: it is served with a policy
that gives it an origin of its own and lets no script run but those of this package. A
photograph needs the key that only the run's own page for it has.
"""

from __future__ import annotations

import hmac
import json
import os
import re
import secrets
import ssl
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from email.message import Message
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, HTTPServer
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple, Protocol
from urllib.parse import parse_qs, unquote, urlsplit

from advsearch.errors import AdvsearchError, InputError
from advsearch.questions.sweep.page import SweepSource, result_of, sweep_page_html
from advsearch.report import wording
from advsearch.report.views import Html, element, join_html
from advsearch.runs import directory, listing, store
from advsearch.runs.directory import COLUMNS, HOME, PARTS, REPORT, check_links, is_run
from advsearch.runs.results import plain
from advsearch.trust.network import https_context, is_local
from advsearch.trust.pages import CLOSED, LOOPBACK, Refused, check_request, token_cookie
from advsearch.trust.stored_files import read_bytes
from advsearch.trust.writing import is_held
from advsearch.viewer import clients
from advsearch.viewer.clients import PATIENCE, SLOWEST, TICK, Clients, reachable
from advsearch.viewer.columns import packed, read_columns
from advsearch.viewer.document import (
    data_script,
    data_url,
    document,
    has_other_scripts,
    in_address,
    scrolled,
    served_policy,
)
from advsearch.viewer.thumbnails import cover, kept_pictures, read_thumbnail, thumbnail

# ---------------------------------------------------------------------------------------------------------------------
# Pages that only the dashboard has: the list of its runs, and a run that goes on or was
# stopped.
#
# Of such a run: how far it is, its search as a curve and step by step.


def list_page(runs: Mapping[str, Path]) -> str:
    """Return the page that lists runs, by the name under which each is shown; the
    newest first.
    """
    listed = [
        (name, listing.listed_run(path, counts=False)) for name, path in runs.items()
    ]
    listed.sort(key=lambda named: named[1].when or 0.0, reverse=True)
    several = sum(run.command == "sweep" for _, run in listed) > 1
    heads = [
        *(["side by side"] if several else []),
        "picture",
        "run",
        "what came out",
        "begun",
    ]
    lines = list[Html]()
    for name, run in listed:
        place = f"runs/{in_address(name)}/"
        sweep = run.command == "sweep"
        box = (
            element(
                "input",
                type="checkbox",
                name="run",
                value=name,
                aria_label=f"compare {name}",
            )
            if sweep
            else None
        )
        picture = element(
            "img", src=f"{place}cover", alt="", loading="lazy", width="72", height="72"
        )
        linked = element(
            "a",
            None if run.fault else picture,
            href=place,
            tabindex="-1",
            aria_hidden="true",
        )
        about = ", ".join(
            filter(
                None,
                (
                    run.command,
                    wording.short_names(run.object),
                    " and ".join(run.controls),
                ),
            )
        )
        aligning = element(
            "a",
            "photographs",
            href=f"{place}align/",
            aria_label=f"photographs of {name}",
        )
        beside = (
            join_html(" ", aligning) if run.command in ("attack", "sweep") else None
        )
        came_out = join_html(run.state, f": {run.answer}" if run.answer else None)
        fault = element("div", run.fault, class_="remarks") if run.fault else None
        begun = (
            ""
            if run.when is None
            else time.strftime("%Y-%m-%d %H:%M", time.localtime(run.when))
        )
        cells = [element("td", box)] if several else []
        cells += [
            element("td", linked),
            element(
                "th",
                element("a", name, href=place),
                element("div", about, beside, class_="soft"),
                scope="row",
            ),
            element("td", came_out, fault),
            element("td", begun, class_="number"),
        ]
        lines.append(element("tr", *cells))
    head = element("tr", *(element("th", text, scope="col") for text in heads))
    made = element(
        "table", element("thead", head), element("tbody", *lines), class_="runs"
    )
    button = element(
        "p", element("button", "Show the chosen sweeps side by side", type="submit")
    )
    form = element(
        "form", scrolled(made), button if several else None, action="compare/"
    )
    none = element(
        "p", "No runs here yet: advsearch sweep, or advsearch attack, makes one."
    )
    title = element("header", element("h1", "Runs"))
    return document(
        "Runs", title, element("main", form if listed else none), connects=True
    )


MOST_ROWS = 2000  # evaluations that are sent at once; the page asks for the rest
START = 0  # where a page begins: the last row that it has


def is_under_way(run: Path) -> bool:
    """Whether a run has no page that says what came out: none at all, or one of an
    attack that is being resumed.
    """
    return not (run / REPORT).is_file() or (is_held(run) and listing.can_resume(run))


def following_page(name: str, run: Path) -> str:
    """Return the page that follows a run, by its name in the dashboard. Without its
    script it says how far it is.
    """
    one = listing.listed_run(run)
    what = ", ".join(
        filter(None, (one.command, one.object, " and ".join(one.controls)))
    )
    state = (
        "A process is working on it."
        if one.state == "running"
        else f"It was stopped: advsearch resume {name} goes on."
    )
    kept = (
        ", ".join(f"{count} of {kind}" for kind, count in one.kinds.items()) or "none"
    )
    parts = []
    # attacks of a study
    for path in (path for path in sorted((run / PARTS).glob("*")) if path.is_dir()):
        page = element("a", path.name, href=f"{PARTS}/{in_address(path.name)}/{REPORT}")
        parts.append(element("li", page if (path / REPORT).is_file() else path.name))
    header = element(
        "header",
        element("p", what, class_="eyebrow"),
        element("h1", f"{name} has not ended"),
    )
    main = element(
        "main",
        element("p", f"{state} Evaluations so far: {kept}.", id="state"),
        element("div", id="follow"),
        element("div", element("h2", "Its attacks"), element("ul", *parts))
        if parts
        else None,
    )
    data = [data_script({"progress": "progress", "start": START}, "run")]
    scripts = ["make.js", "follow.js"]
    return document(
        name,
        header,
        main,
        data=data,
        scripts=scripts,
        connects=True,
        footer=f"run {name}",
    )


def progress_json(run: Path, after: int) -> bytes:
    """Return what is new in a run as JSON, after what `next` was in the answer before,
    or `START`. Raises FileFormatError where what it keeps is damaged.
    """
    running = is_held(run)  # before what it has: what comes later is asked for
    ended = not is_under_way(run)
    last = after
    rows = list[dict[str, object]]()
    pictures = list[dict[str, object]]()
    if (run / store.NAME).is_file():
        with store.Store(run / store.NAME, read_only=True) as results:
            for row in islice(results.rows(after=after), MOST_ROWS):
                values = {
                    name: [value["value"], value["unit"]]
                    for name, value in row.values.items()
                }
                told = {
                    name: getattr(row, name)
                    for name in ("kind", "step", "objective", "success", "label")
                }
                rows.append({**told, "values": values})
                last = row.id or after
            for number, picture in results.pictures("search", after, last):
                small = data_url(
                    thumbnail(picture.astype("float32") / 255.0), "image/jpeg"
                )
                pictures.append({"step": number, "picture": small})
    news = {
        "rows": rows,
        "pictures": pictures,
        "next": last,
        "running": running,
        "ended": ended,
    }
    return json.dumps(plain(news), allow_nan=False).encode()


FIRST_PART = 4_000
PART = 50_000
"""Rows of a sweep that goes on that are sent at once; reading more takes longer than
somebody waits for the first.
"""
LARGEST = 1 << 30  # most bytes of a sweep's columns, and of a page that lies in a run
LARGEST_PAGE = 1 << 28
SENDING = 60.0  # seconds in which a photograph has to have come
FAULT = "this page could not be made, which is a fault of advsearch"
BACKLOG = 4096  # connections that may wait in the operating system
NUMBERED = re.compile(r"[0-9]+/[0-9]{1,12}\.jpg")  # a thousand pictures have a folder


class PhotographServer(Protocol):
    """What answers for the page of a run on which photographs are aligned with its
    renderings.
    """

    def make_page(self, run: Path, name: str, key: str, elsewhere: str | None) -> str:
        """Return the page as HTML; `elsewhere` is its address for another device, if
        one can open it.
        """

    def read_picture(self, kind: str, run: Path, name: str) -> tuple[str, bytes]:
        """Return the type and the data of a "rendering" or of a "photo" of a run.
        Raises Refused: there is none.
        """

    def take(
        self,
        run: Path,
        name: str,
        headers: Message,
        key: str,
        read_data: Callable[[], bytes],
    ) -> tuple[str, bytes]:
        """Take a photograph in, and return the type and the data of the answer. Raises
        Refused: it is none, or it doesn't come from the page, which alone has the key.
        """


class Dashboard(HTTPServer):
    """The server, of folders of runs, or of those in ``runs/``, looked up anew for each
    request; `serve_forever` answers until `shutdown`. A `port` of 0 takes a free one;
    beyond this machine it always speaks HTTPS; without what takes `photographs` in,
    these are refused. Every request has to bring the `token`; None on this machine
    only. The `fingerprint` is SHA-256 of the certificate; None without HTTPS. Raises
    InputError where the address can't be listened at, or there is nothing to make a
    certificate.
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
        photographs: PhotographServer | None = None,
    ) -> None:
        self._given: dict[str, Path] = {}
        for path in runs:
            name = path.resolve().name
            number = 2
            while name in self._given:
                name = f"{path.resolve().name} ({number})"
                number = number + 1
            self._given[name] = path
        self.token = None if is_local(host) else secrets.token_urlsafe(24)
        self._secret = secrets.token_bytes(32)
        self.photographs = photographs
        self._listing = threading.Lock()
        self.named = host
        self.fingerprint = None
        self._context: ssl.SSLContext | None = None
        if https or self.token:
            self._context, self.fingerprint = https_context(
                (reachable(host), "localhost", LOOPBACK)
            )
        super().__init__((host, port), _Handler, bind_and_activate=False)
        self.clients = Clients(self.socket, self.finish_request, self._context)
        try:
            self.server_bind()
            self.server_activate()
        except (OSError, OverflowError) as error:
            self.server_close()
            raise InputError(
                f"host and port: cannot listen at {host}:{port}: {error}"
            ) from None

    @property
    def scheme(self) -> str:
        return "http" if self._context is None else "https"

    @property
    def address(self) -> str:
        return self.address_of("/")

    def address_of(self, path: str) -> str:
        """What to open in a browser, here or elsewhere, to see a page."""
        host = reachable(self.named)
        host = f"[{host}]" if ":" in host else host
        return f"{self.scheme}://{host}:{self.server_port}{path}" + (
            f"?token={self.token}" if self.token else ""
        )

    def runs(self) -> Mapping[str, Path]:
        found = (
            path for path in sorted(HOME.glob("*")) if path.is_dir() and is_run(path)
        )
        return self._given or {path.name: path for path in found}

    def run(self, name: str) -> Path:
        """Return the folder of one of them. Raises Refused where there is none,
        FileFormatError where it has links.
        """
        path = self._given.get(name)
        if (
            not self._given
            and name not in ("", ".", "..")
            and not set("/\0") & set(name)
            and is_run(HOME / name)
        ):
            path = HOME / name
        if path is None:
            raise Refused(HTTPStatus.NOT_FOUND, "there is no such run")
        check_links(path)
        return path

    @property
    def photograph_pages(self) -> PhotographServer:
        """What answers about photographs. Raises Refused: this server takes none."""
        if self.photographs is None:
            raise Refused(
                HTTPStatus.NOT_FOUND,
                "this server takes no photographs; advsearch dashboard does",
            )
        return self.photographs

    def key(self, name: str) -> str:
        """What a photograph of a run has to bring: its page has it, and no other."""
        return hmac.new(self._secret, os.fsencode(name), "sha256").hexdigest()

    def list_page(self) -> str:
        with self._listing:  # one reads, the others find what it has read
            return list_page(self.runs())

    def serve_forever(self, poll_interval: float = TICK) -> None:
        self.clients.serve()

    def shutdown(self) -> None:
        """Let `serve_forever` and its workers end."""
        self.clients.close()

    def server_close(self) -> None:
        self.clients.close()
        super().server_close()


Query = Mapping[str, list[str]]
OTHERS = served_policy(own=False)


class Served(NamedTuple):
    """What is answered: its media type and bytes, and under which policy. Whatever
    comes out of a run's folder may be somebody else's, so that policy is the usual one.
    """

    kind: str
    data: bytes
    policy: str = OTHERS


class _Handler(BaseHTTPRequestHandler):
    server: Dashboard
    protocol_version = "HTTP/1.0"
    server_version = "advsearch"
    sys_version = ""

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing."""

    def do_GET(self) -> None:
        headers: dict[str, str] = {}
        status = HTTPStatus.OK
        self.server.clients.wait_for(None)
        try:
            self._check()
            served, headers = self._served()
        except Exception as error:  # one page must not take others along
            status = HTTPStatus.INTERNAL_SERVER_ERROR
            text = f"{FAULT}: {type(error).__name__}"
            if isinstance(error, Refused):
                status = error.status
                text = str(error)
            elif isinstance(error, AdvsearchError):
                text = str(error)
            elif isinstance(error, OSError):
                status = HTTPStatus.NOT_FOUND
                text = "it is not there any more"
            served = Served(
                "text/plain; charset=utf-8", f"{text}\n".encode("utf-8", "replace")
            )
        self.send_response(status)
        for name, value in {
            "Content-Type": served.kind,
            "Content-Length": str(len(served.data)),
            "Content-Security-Policy": served.policy,
            "Cache-Control": "no-store",
            **CLOSED,
            **headers,
        }.items():
            self.send_header(name, value)
        self.server.clients.wait_for(PATIENCE + len(served.data) / SLOWEST)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(served.data)

    do_HEAD = do_POST = do_GET

    def _check(self) -> None:
        server = self.server
        check_request(
            self.command,
            self.path,
            self.headers,
            server.scheme,
            server.named,
            server.server_port,
            server.token,
        )

    def _served(self) -> tuple[Served, dict[str, str]]:
        if not self.path.startswith("/"):
            raise Refused(HTTPStatus.BAD_REQUEST, "this server is no proxy")
        address = urlsplit(self.path)
        query = parse_qs(address.query, errors="surrogateescape")
        headers = {}
        if self.server.token and "token" in query:
            headers["Set-Cookie"] = token_cookie(
                self.server.server_port, self.server.token
            )
        # names of files may be no text
        parts = [
            unquote(part, errors="surrogateescape")
            for part in address.path.split("/")[1:]
        ]
        return self._answer(query, parts), headers

    def _answer(self, query: Query, parts: list[str]) -> Served:
        """Return what is at an address, by its parts; nothing but a photograph is sent
        to any.
        """
        server = self.server
        if self.command == "POST":
            match parts:
                case ["runs", name, "align", "renderings", file]:
                    run = server.run(name)
                    key = server.key(name)
                    return Served(
                        *server.photograph_pages.take(
                            run, file, self.headers, key, self._body
                        )
                    )
            raise Refused(HTTPStatus.NOT_FOUND, "there is no such page")
        match parts:
            case [""]:
                return _own(server.list_page())
            case ["compare", ""]:
                return self._compare(query)
            case ["runs", name, ""]:
                run = server.run(name)
                if listing.listed_run(run, counts=False).command == "sweep":
                    return _own(
                        sweep_page_html(
                            [(run, result_of(run))], [_source(name, run, "")]
                        ),
                        "../../",
                    )
                return (
                    _own(following_page(name, run), "../../")
                    if is_under_way(run)
                    else _kept(run, "../../")
                )
            case ["runs", name, "cover"]:
                return Served("image/jpeg", cover(server.run(name)))
            case ["runs", name, "rows"]:
                return self._rows(query, server.run(name))
            case ["runs", name, "progress"]:
                return Served(
                    "application/json", progress_json(server.run(name), _after(query))
                )
            # of a study, whose page links to it
            case ["runs", name, directory.PARTS, part, directory.REPORT]:
                attack = next(
                    (
                        path
                        for path in (server.run(name) / PARTS).iterdir()
                        if path.name == part
                    ),
                    None,
                )
                if attack is None or not (attack / REPORT).is_file():
                    raise Refused(HTTPStatus.NOT_FOUND, "there is no such attack")
                return _kept(attack, "../../../../", ("../../", name))
            case ["runs", name, "pictures", folder, file] if NUMBERED.fullmatch(
                f"{folder}/{file}"
            ):
                return Served(
                    "image/jpeg",
                    read_thumbnail(server.run(name), int(file.removesuffix(".jpg"))),
                )
            case ["runs", name, "align", ""]:
                run = server.run(name)
                key = server.key(name)
                elsewhere = (
                    server.address_of(f"/runs/{in_address(name)}/align/")
                    if server.token
                    else None
                )
                page = server.photograph_pages.make_page(run, name, key, elsewhere)
                return _own(page, "../../../", ("../", name))
            case ["runs", name, "align", ("renderings" | "photos") as kind, file]:
                return Served(
                    *server.photograph_pages.read_picture(
                        kind.removesuffix("s"), server.run(name), file
                    )
                )
        raise Refused(HTTPStatus.NOT_FOUND, "there is no such page")

    def _compare(self, query: Query) -> Served:
        runs = [
            (name, self.server.run(name))
            for name in dict.fromkeys(query.get("run", []))
        ]
        if not runs:
            raise Refused(HTTPStatus.BAD_REQUEST, "choose at least one sweep")
        other = [
            name
            for name, run in runs
            if listing.listed_run(run, counts=False).command != "sweep"
        ]
        if other:
            raise Refused(
                HTTPStatus.BAD_REQUEST,
                f"only sweeps can be shown side by side; {', '.join(other)} is none",
            )
        sources = [
            _source(name, run, f"../runs/{in_address(name)}/") for name, run in runs
        ]
        return _own(
            sweep_page_html([(run, result_of(run)) for _, run in runs], sources), "../"
        )

    def _rows(self, query: Query, run: Path) -> Served:
        after = _after(query)
        if not after and (run / COLUMNS).is_file() and listing.finished(run):
            return Served(
                "application/octet-stream",
                read_bytes(run / COLUMNS, "columns of a sweep", LARGEST),
            )
        part = PART if after else FIRST_PART
        # before the rows are read: what comes later is asked for again
        running = is_held(run)
        columns = read_columns(run, after, part)
        return Served(
            "application/octet-stream",
            packed(columns, more=len(columns) == part, running=running),
        )

    def _body(self) -> bytes:
        """What was sent along; nothing is read of what says that it is larger than
        `clients.LARGEST_SENT`.
        """
        length = self.headers.get("Content-Length", "")
        if not re.fullmatch(r"[0-9]{1,15}", length):
            raise Refused(HTTPStatus.LENGTH_REQUIRED, "its length is missing")
        if int(length) > clients.LARGEST_SENT:
            raise Refused(
                HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
                f"more than {clients.LARGEST_SENT >> 20} MB",
            )
        self.server.clients.wait_for(SENDING)
        data = self.rfile.read(int(length))
        self.server.clients.wait_for(None)
        if len(data) < int(length):
            raise Refused(HTTPStatus.BAD_REQUEST, "a part of it did not come")
        return data


def _after(query: Query) -> int:
    after = query.get("after", [str(START)])[0]
    if not re.fullmatch(r"[0-9]{1,15}", after):
        raise Refused(HTTPStatus.BAD_REQUEST, "after: expected the id of a row")
    return int(after)


def _source(name: str, run: Path, base: str) -> SweepSource:
    """Where a page gets a sweep's rows and pictures; `base` leads from the page to the
    run's own address.
    """
    return SweepSource(
        name,
        f"{base}rows",
        parts=True,
        pictures=kept_pictures(run),
        folder=f"{base}pictures",
    )


HTML = "text/html; charset=utf-8"


def _own(
    page: str, home: str | None = None, above: tuple[str, str] | None = None
) -> Served:
    """Return a page that the server has made, with the way back; arguments as for
    `_with_way`.
    """
    data = page.encode("utf-8", "replace")  # names of files may be no text
    return Served(
        HTML, _with_way(data, home, above) if home else data, served_policy(own=True)
    )


def _kept(run: Path, home: str, above: tuple[str, str] | None = None) -> Served:
    """Return the page that lies in the folder of a run, with the way back; arguments as
    for `_with_way`.
    """
    page = read_bytes(run / REPORT, "a page", LARGEST_PAGE)
    said = (
        "Its scripts are of another advsearch and do not run here; advsearch view "
        f"{run.name} makes the page anew."
    )
    return Served(
        HTML, _with_way(page, home, above, said if has_other_scripts(page) else None)
    )


def _with_way(
    page: bytes, home: str, above: tuple[str, str] | None, said: str | None = None
) -> bytes:
    """Return a page with the way back: to the list, and to what it is a part of (an
    address and its name).
    """
    links = [("All runs", home), *([(above[1], above[0])] if above else [])]
    way = element(
        "nav",
        *(element("a", text, href=address) for text, address in links),
        aria_label="back",
    )
    way = join_html(way, element("p", said, class_="remarks") if said else None)
    at = page.find(b"<body>") + len(b"<body>") if b"<body>" in page else 0
    return page[:at] + way.encode("utf-8", "replace") + page[at:]
