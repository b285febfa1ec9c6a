"""`advsearch dashboard`: a small web server for the pages of runs, by default on this
machine only.

It responds to GET and HEAD requests for the list of runs, and for the page, the rows
and the images of a run; and to POST requests with a photograph. Of an address, only the
name of a run becomes part of a path. A request is rejected if its `Host` is not this
server (DNS rebinding), or if a page of another origin sends it. Other machines need a
token in every request, and HTTPS. `openssl` makes the certificate, which is valid as
long as the server runs.

The files of a run are not trusted: they are served with a policy that gives them an
origin of their own, and allows only the scripts of this package. A request with a
photograph needs a key that only the page for photographs of the run contains.
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
from advsearch.questions.sweep.page import (
    SweepSource,
    load_sweep_result,
    make_sweep_page,
)
from advsearch.report import wording
from advsearch.report.views import Html, join_html, make_element
from advsearch.runs import directory, listing, store
from advsearch.runs.directory import COLUMNS, HOME, PARTS, REPORT, check_links, is_run
from advsearch.runs.results import to_json_value
from advsearch.trust.network import is_local, make_https_context
from advsearch.trust.pages import (
    CLOSED,
    LOOPBACK,
    RequestRejected,
    check_request,
    make_token_cookie,
)
from advsearch.trust.stored_files import read_bytes
from advsearch.trust.writing import is_held
from advsearch.viewer import clients
from advsearch.viewer.clients import (
    CHECK_INTERVAL,
    MIN_BYTES_PER_SECOND,
    REQUEST_SECONDS,
    ConnectionPool,
    find_reachable_address,
)
from advsearch.viewer.columns import pack_columns, read_columns
from advsearch.viewer.document import (
    has_other_scripts,
    make_data_script,
    make_data_url,
    make_document,
    make_scrollable,
    make_security_policy,
    quote_name,
)
from advsearch.viewer.thumbnails import (
    find_thumbnails,
    make_cover,
    make_thumbnail,
    read_thumbnail,
)

# ---- Pages of the dashboard alone: the list of runs, and a run in progress or stopped


def make_list_page(runs: Mapping[str, Path]) -> str:
    """Return the page with the list of runs, the newest first.

    Args:
        runs: their directories by name.
    """
    listed = [
        (name, listing.read_listed_run(path, counts=False))
        for name, path in runs.items()
    ]
    # the newest first; runs with an unknown time of their start last
    listed.sort(key=lambda item: item[1].when or 0.0, reverse=True)
    if not listed:
        content = make_element(
            "p", "No runs here yet: advsearch sweep, or advsearch attack, makes one."
        )
    else:
        content = _make_runs_form(listed)
    title = make_element("header", make_element("h1", "Runs"))
    return make_document("Runs", title, make_element("main", content), connects=True)


def _make_runs_form(listed: Sequence[tuple[str, listing.ListedRun]]) -> Html:
    """Return the table of runs, in which sweeps can be chosen for a comparison.

    Args:
        listed: the runs with their names.
    """
    # a single sweep has nothing to be compared with
    can_compare = sum(run.command == "sweep" for _, run in listed) > 1
    button = None
    if can_compare:
        text = "Show the chosen sweeps side by side"
        button = make_element("p", make_element("button", text, type="submit"))
    table = make_scrollable(_runs_table(listed, can_compare))
    return make_element("form", table, button, action="compare/")


def _runs_table(
    listed: Sequence[tuple[str, listing.ListedRun]], can_compare: bool
) -> Html:
    """Return the table of runs.

    Args:
        listed: name and state of each run, in the order of the table.
        can_compare: whether the first column has boxes to choose sweeps for a
            comparison.
    """
    heads = ["picture", "run", "what came out", "begun"]
    if can_compare:
        heads.insert(0, "side by side")
    column_heads = (make_element("th", text, scope="col") for text in heads)
    head = make_element("thead", make_element("tr", *column_heads))
    rows = [_run_row(name, run, can_compare) for name, run in listed]
    return make_element("table", head, make_element("tbody", *rows), class_="runs")


def _run_row(name: str, run: listing.ListedRun, can_compare: bool) -> Html:
    """Return the row of a run in the list of runs.

    Args:
        name: name of the run.
        run: state of the run, such as its command and result.
        can_compare: whether the row begins with a cell to choose it for a comparison;
            the cell is empty if the run is no sweep.
    """
    address = f"runs/{quote_name(name)}/"
    cells = []
    if can_compare:
        checkbox = _comparison_checkbox(name) if run.command == "sweep" else None
        cells.append(make_element("td", checkbox))
    link = make_element("a", name, href=address)
    subject = _run_subject(name, run, address)
    outcome = join_html(run.state, f": {run.outcome}" if run.outcome else None)
    fault = make_element("div", run.fault, class_="remarks") if run.fault else None
    start = _format_start_time(run.when)
    cells += [
        make_element("td", _cover_link(run, address)),
        make_element("th", link, subject, scope="row"),
        make_element("td", outcome, fault),
        make_element("td", start, class_="number"),
    ]
    return make_element("tr", *cells)


def _comparison_checkbox(name: str) -> Html:
    """Return the check box that selects a sweep for comparison with others."""
    return make_element(
        "input",
        type="checkbox",
        name="run",
        value=name,
        aria_label=f"compare {name}",
    )


def _cover_link(run: listing.ListedRun, address: str) -> Html:
    """Return the small image of a run as a link to its page.

    The name beside it is a link too, so that keys and screen readers skip this one. A
    run that cannot be read has no image.
    """
    image = make_element(
        "img", src=f"{address}cover", alt="", loading="lazy", width="72", height="72"
    )
    return make_element(
        "a",
        None if run.fault else image,
        href=address,
        tabindex="-1",
        aria_hidden="true",
    )


def _run_subject(name: str, run: listing.ListedRun, address: str) -> Html:
    """Return the subjects of a run, with a link to its page for photographs."""
    facts = (run.command, wording.shorten_names(run.object), " and ".join(run.controls))
    photographs = None
    if run.command in ("attack", "sweep"):
        link = make_element(
            "a",
            "photographs",
            href=f"{address}align/",
            aria_label=f"photographs of {name}",
        )
        photographs = join_html(" ", link)
    subject = ", ".join(filter(None, facts))
    return make_element("div", subject, photographs, class_="soft")


# Maximum number of rows in one response. The page requests the rest later.
MAX_PROGRESS_ROWS = 2000
# Value of `after` for a page that has no rows yet; ids of rows begin at 1.
FIRST_ROW_ID = 0


def is_unfinished(run: Path) -> bool:
    """Return whether a run has no page of its result.

    It has none at all, or one of an attack that is being resumed.
    """
    return not (run / REPORT).is_file() or (is_held(run) and listing.can_resume(run))


def _format_start_time(when: float | None) -> str:
    """Return when a run was started, in local time; "" if that is unknown.

    Args:
        when: seconds since 1970.
    """
    if when is None:
        return ""
    return time.strftime("%Y-%m-%d %H:%M", time.localtime(when))


def make_progress_page(name: str, run: Path) -> str:
    """Return the page that follows the progress of a run.

    A script in the page requests new rows. Without scripts, the page displays the state
    at the time of its request.

    Args:
        name: name of the run in the dashboard.
        run: directory of the run.
    """
    listed = listing.read_listed_run(run)
    # The script requests rows after a row from this address, relative to the page.
    request = {"progress": "progress", "start": FIRST_ROW_ID}
    main = make_element(
        "main",
        make_element("p", _describe_state(name, listed), id="state"),
        make_element("div", id="follow"),  # filled by the script follow.js
        _attack_list_html(run),
    )
    return make_document(
        name,
        _make_progress_header(name, listed),
        main,
        data=[make_data_script(request, "run")],
        scripts=["make.js", "follow.js"],
        connects=True,
        footer=f"run {name}",
    )


def _describe_state(name: str, run: listing.ListedRun) -> str:
    """Return whether a run is running, and its evaluations so far, as sentences."""
    if run.state == "running":
        state = "A process is working on it."
    else:
        state = f"It was stopped: advsearch resume {name} goes on."
    counts = [f"{count} of {kind}" for kind, count in run.kinds.items()]
    return f"{state} Evaluations so far: {', '.join(counts) or 'none'}."


def _attack_list_html(run: Path) -> Html | None:
    """Return the list of a study's attacks with links to their pages; None without
    any.
    """
    attacks = []
    for path in sorted((run / PARTS).glob("*")):  # attacks of a study
        if path.is_dir():
            address = f"{PARTS}/{quote_name(path.name)}/{REPORT}"
            link = make_element("a", path.name, href=address)
            has_page = (path / REPORT).is_file()
            attacks.append(make_element("li", link if has_page else path.name))
    if not attacks:
        return None
    return make_element(
        "div", make_element("h2", "Its attacks"), make_element("ul", *attacks)
    )


def _make_progress_header(name: str, run: listing.ListedRun) -> Html:
    """Return the header of the page that follows the progress of a run.

    Args:
        name: name of the run in the dashboard.
        run: state of the run.
    """
    subjects = (run.command, run.object, " and ".join(run.controls))
    return make_element(
        "header",
        make_element("p", ", ".join(filter(None, subjects)), class_="eyebrow"),
        make_element("h1", f"{name} has not ended"),
    )


def make_progress_json(run: Path, after: int) -> bytes:
    """Return the progress of a run as JSON: new rows and images, and whether it runs.

    Args:
        run: directory of the run.
        after: "next" of the previous response, or `FIRST_ROW_ID`.

    Raises:
        FileFormatError: the stored results are corrupt.
    """
    # The state is read before the rows. If the run ends in between, it counts as
    # running, so that the page requests its last rows once more.
    running = is_held(run)  # a process works on it
    ended = not is_unfinished(run)  # it has its final page
    rows, pictures, last_id = _read_new_rows(run, after)
    progress = {
        "rows": rows,
        "pictures": pictures,
        "next": last_id,
        "running": running,
        "ended": ended,
    }
    return json.dumps(to_json_value(progress), allow_nan=False).encode()


def _read_new_rows(
    run: Path, after: int
) -> tuple[list[dict[str, object]], list[dict[str, object]], int]:
    """Return new rows of a run and new images of its search, and the id of the last row.

    Args:
        run: directory of the run.
        after: id of the row after which to begin.
    """
    if not (run / store.NAME).is_file():
        return [], [], after
    last_id = after
    rows = list[dict[str, object]]()
    with store.Store(run / store.NAME, read_only=True) as results:
        for row in islice(results.rows(after=after), MAX_PROGRESS_ROWS):
            rows.append(_row_json(row))
            last_id = row.id or after  # stored rows have an id
        pictures = _list_search_pictures(results, after, last_id)
    return rows, pictures, last_id


def _list_search_pictures(
    results: store.Store, after: int, last_id: int
) -> list[dict[str, object]]:
    """Return the step and the data URL of each image of a search.

    Args:
        results: stored results of the run.
        after: id of the row after which the images begin.
        last_id: id of the last row.
    """
    pictures = list[dict[str, object]]()
    # Only images of the search, since the page displays no others. The index of an
    # evaluation in its search is its step.
    for step, picture in results.iterate_images("search", after, last_id):
        jpeg = make_thumbnail(picture.astype("float32") / 255.0)
        pictures.append({"step": step, "picture": make_data_url(jpeg, "image/jpeg")})
    return pictures


def _row_json(row: store.Row) -> dict[str, object]:
    """Return the fields of a stored row that the page of a run in progress needs."""
    values = {
        name: [value["value"], value["unit"]] for name, value in row.values.items()
    }
    fields = {
        name: getattr(row, name)
        for name in ("kind", "step", "objective", "success", "label")
    }
    return {**fields, "values": values}


# Maximum number of rows of a sweep in one response. The first response of a page is
# shorter, since the user waits for it.
FIRST_ROWS = 4_000
MAX_ROWS = 50_000
# Maximum bytes of a sweep's columns, and of a run's page.
MAX_COLUMNS_BYTES = 1 << 30
MAX_PAGE_BYTES = 1 << 28
# Maximum seconds for receiving a photograph.
UPLOAD_SECONDS = 60.0
FAULT_MESSAGE = "this page could not be made, which is a fault of advsearch"
# Maximum number of connections that wait in the operating system.
BACKLOG = 4096
# Pattern of the directory and file of a thumbnail.
THUMBNAIL_PATH = re.compile(r"[0-9]+/[0-9]{1,12}\.jpg")


class PhotographServer(Protocol):
    """The interface of the object that serves the pages on which photographs are
    aligned with the renderings of a run.
    """

    def make_page(
        self, run: Path, name: str, key: str, other_device_url: str | None
    ) -> str:
        """Return the page as HTML.

        `other_device_url` is its address for another device, if one can open it.
        """

    def read_picture(self, kind: str, run: Path, name: str) -> tuple[str, bytes]:
        """Return media type and data of a "rendering" or a "photo" of a run.

        Raises:
            RequestRejected: there is none.
        """

    def store_photograph(
        self,
        run: Path,
        name: str,
        headers: Message,
        key: str,
        read_data: Callable[[], bytes],
    ) -> tuple[str, bytes]:
        """Store a photograph, and return media type and data of the response.

        Args:
            run: directory of the run.
            name: name of the rendering that it shows.
            headers: headers of the request.
            key: key that the page has and the request needs.
            read_data: reads the photograph's file from the request.

        Raises:
            RequestRejected: it is no photograph, or the request lacks the key.
        """


def _name_runs(paths: Sequence[Path]) -> dict[str, Path]:
    """Return the directories of runs by name.

    If several directories have the same name, the further ones get a number, as in "mug
    (2)".
    """
    path_of_name: dict[str, Path] = {}
    for path in paths:
        folder_name = path.resolve().name
        name = folder_name
        number = 2
        while name in path_of_name:
            name = f"{folder_name} ({number})"
            number += 1
        path_of_name[name] = path
    return path_of_name


class Dashboard(HTTPServer):
    """The server of the pages of runs. `serve_forever` responds until `shutdown`.

    Attributes:
        token: token that every request needs; None if only this machine can reach the
            server.
        fingerprint: SHA-256 of the certificate; None without HTTPS.
        photographs: object that serves the pages for photographs; None rejects them.
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
        """Start to listen at an address.

        If other machines can reach the server, pages are encrypted and need a token.

        Args:
            runs: directories of the runs to serve; empty for all runs in `HOME`.
            host: address at which to listen.
            port: port at which to listen; 0 for any free one.
            https: whether to encrypt pages on this machine, too.
            photographs: object that serves the pages for photographs; None for none.

        Raises:
            InputError: the address cannot be used.
        """
        self._explicit_runs = _name_runs(runs)
        self.token = None if is_local(host) else secrets.token_urlsafe(24)
        self._secret = secrets.token_bytes(32)  # from which `make_key` makes keys
        self.photographs = photographs
        # The lock is held while the list of runs is read, so that a request at the same
        # time waits, and finds cached entries.
        self._list_lock = threading.Lock()
        self.host_name = host
        self.fingerprint = None
        self._context: ssl.SSLContext | None = None
        if https or self.token:
            names = (find_reachable_address(host), "localhost", LOOPBACK)
            self._context, self.fingerprint = make_https_context(names)
        # The socket is bound below, where an error about the address is converted.
        super().__init__((host, port), _Handler, bind_and_activate=False)
        # `finish_request` is the method of `socketserver` that calls `_Handler`.
        self.clients = ConnectionPool(self.socket, self.finish_request, self._context)
        self._listen(host, port)

    def _listen(self, host: str, port: int) -> None:
        """Bind the socket to an address, and listen there.

        Raises:
            InputError: the address cannot be used.
        """
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
        return self.make_url("/")

    def make_url(self, path: str) -> str:
        """Return the URL of a page for a browser on this or another machine."""
        host = find_reachable_address(self.host_name)
        if ":" in host:  # IPv6
            host = f"[{host}]"
        url = f"{self.scheme}://{host}:{self.server_port}{path}"
        return f"{url}?token={self.token}" if self.token else url

    def list_runs(self) -> Mapping[str, Path]:
        """Return the directories of the runs by name."""
        if self._explicit_runs:
            return self._explicit_runs
        paths = (
            path for path in sorted(HOME.glob("*")) if path.is_dir() and is_run(path)
        )
        return {path.name: path for path in paths}

    def find_run(self, name: str) -> Path:
        """Return the directory of a run by its name in the dashboard.

        Raises:
            RequestRejected: there is no such run.
            FileFormatError: the run contains links, which may lead to any file.
        """
        path = self._explicit_runs.get(name)
        if not self._explicit_runs:
            # The name comes from a request, so it must not lead to another folder.
            is_name = name not in ("", ".", "..") and not set("/\0") & set(name)
            if is_name and is_run(HOME / name):
                path = HOME / name
        if path is None:
            raise RequestRejected(HTTPStatus.NOT_FOUND, "there is no such run")
        check_links(path)
        return path

    @property
    def photograph_pages(self) -> PhotographServer:
        """The object that serves the pages for photographs.

        Raises:
            RequestRejected: this server accepts no photographs.
        """
        if self.photographs is None:
            raise RequestRejected(
                HTTPStatus.NOT_FOUND,
                "this server takes no photographs; advsearch dashboard does",
            )
        return self.photographs

    def make_key(self, name: str) -> str:
        """Return the key that a photograph of a run needs, and only its page has."""
        return hmac.new(self._secret, os.fsencode(name), "sha256").hexdigest()

    def make_list_page(self) -> str:
        """Return the page that lists the runs."""
        with self._list_lock:
            return make_list_page(self.list_runs())

    def serve_forever(self, poll_interval: float = CHECK_INTERVAL) -> None:
        """Respond to requests until `shutdown`."""
        self.clients.serve()

    def shutdown(self) -> None:
        """Stop `serve_forever` and its workers."""
        self.clients.close()

    def server_close(self) -> None:
        self.clients.close()
        super().server_close()


Query = Mapping[str, list[str]]
UNTRUSTED_POLICY = make_security_policy(is_trusted=False)


class Response(NamedTuple):
    """A response: media type, data and policy.

    By default the policy is that of untrusted content, such as files of a run.
    """

    media_type: str
    data: bytes
    policy: str = UNTRUSTED_POLICY


class _Handler(BaseHTTPRequestHandler):
    """Responds to a request in a worker thread."""

    server: Dashboard
    protocol_version = "HTTP/1.0"
    server_version = "advsearch"
    sys_version = ""

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing."""

    def do_GET(self) -> None:
        """Respond to a GET, HEAD or POST request; any error becomes a response.

        While the worker waits for the client, this is reported to the pool, which
        disconnects slow clients.
        """
        headers: dict[str, str] = {}
        status = HTTPStatus.OK
        # From here until the response is sent, the worker does not wait for its client.
        self.server.clients.report_waiting(None)
        try:
            self._check_request()
            response, headers = self._respond()
        except Exception as error:  # an error of one page must not end the server
            status, text = _describe_error(error)
            data = f"{text}\n".encode("utf-8", "replace")
            response = Response("text/plain; charset=utf-8", data)
        self._send_reply(status, response, headers)

    def _send_reply(
        self, status: HTTPStatus, response: Response, headers: Mapping[str, str]
    ) -> None:
        """Send a response to the client; to a HEAD request without its content.

        Args:
            status: HTTP status.
            response: content of the response.
            headers: headers in addition to those of all responses.
        """
        self.send_response(status)
        for name, value in {**_make_common_headers(response), **headers}.items():
            self.send_header(name, value)
        seconds_to_send = len(response.data) / MIN_BYTES_PER_SECOND
        self.server.clients.report_waiting(REQUEST_SECONDS + seconds_to_send)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(response.data)

    do_HEAD = do_POST = do_GET

    def _check_request(self) -> None:
        """Check that the request may be answered: it needs the token, and must not come
        from another origin.
        """
        server = self.server
        check_request(
            self.command,
            self.path,
            self.headers,
            server.scheme,
            server.host_name,
            server.server_port,
            server.token,
        )

    def _respond(self) -> tuple[Response, dict[str, str]]:
        """Return the response to a request, and further headers to send with it.

        The caller has checked the request, including its token.
        """
        if not self.path.startswith("/"):
            raise RequestRejected(HTTPStatus.BAD_REQUEST, "this server is no proxy")
        address = urlsplit(self.path)
        query = parse_qs(address.query, errors="surrogateescape")
        headers = {}
        if self.server.token and "token" in query:
            # later requests of this browser have the token as a cookie
            headers["Set-Cookie"] = make_token_cookie(
                self.server.server_port, self.server.token
            )
        # surrogates stand for bytes of a file name that are not UTF-8
        encoded_parts = address.path.split("/")[1:]  # before the first slash is nothing
        parts = [unquote(part, errors="surrogateescape") for part in encoded_parts]
        if self.command == "POST":  # only photographs are posted
            return self._take_photograph(parts), headers
        return self._route(query, parts), headers

    def _take_photograph(self, parts: list[str]) -> Response:
        """Respond to a POST request by the parts of its path; only photographs are
        accepted.
        """
        match parts:
            case ["runs", name, "align", "renderings", file]:
                run = self.server.find_run(name)
                media_type, data = self.server.photograph_pages.store_photograph(
                    run, file, self.headers, self.server.make_key(name), self._read_body
                )
                return Response(media_type, data)
        raise RequestRejected(HTTPStatus.NOT_FOUND, "there is no such page")

    def _route(self, query: Query, parts: list[str]) -> Response:
        """Respond to a GET request.

        Args:
            query: values of the query by name.
            parts: names in the path, without slashes, such as ["runs", "mug", ""] for
                "/runs/mug/".

        Raises:
            RequestRejected: there is no such page.
        """
        server = self.server
        match parts:
            case [""]:
                return _serve_page(server.make_list_page())
            case ["compare", ""]:
                return self._serve_comparison(query)
            case ["runs", name, ""]:
                return self._serve_run(name)
            case ["runs", name, "cover"]:
                return Response("image/jpeg", make_cover(server.find_run(name)))
            case ["runs", name, "rows"]:
                return self._serve_rows(query, server.find_run(name))
            case ["runs", name, "progress"]:
                return self._serve_progress(query, server.find_run(name))
            # the page of a part of a study, to which the study's page links
            case ["runs", name, directory.PARTS, part, directory.REPORT]:
                return self._serve_part(name, part)
            # such as pictures/0001/1234.jpg; the number finds the file
            case ["runs", name, "pictures", folder, file] if THUMBNAIL_PATH.fullmatch(
                f"{folder}/{file}"
            ):
                return self._serve_thumbnail(name, file)
            case ["runs", name, "align", ""]:
                return self._serve_photograph_page(name)
            case ["runs", name, "align", ("renderings" | "photos") as folder, file]:
                return self._serve_photograph(name, folder.removesuffix("s"), file)
        raise RequestRejected(HTTPStatus.NOT_FOUND, "there is no such page")

    def _serve_progress(self, query: Query, run: Path) -> Response:
        """Serve the progress of a run since a row that the query names, as JSON."""
        progress = make_progress_json(run, _parse_after(query))
        return Response("application/json", progress)

    def _serve_thumbnail(self, name: str, file: str) -> Response:
        """Serve a small image of a run.

        Args:
            name: name of the run.
            file: name of the file, such as "1234.jpg", which has the image's number.
        """
        number = int(file.removesuffix(".jpg"))
        return Response(
            "image/jpeg", read_thumbnail(self.server.find_run(name), number)
        )

    def _serve_photograph(self, name: str, kind: str, file: str) -> Response:
        """Serve a picture for the page that aligns photographs.

        Args:
            name: name of the run.
            kind: "rendering" or "photo".
            file: name of the file.
        """
        server = self.server
        media_type, data = server.photograph_pages.read_picture(
            kind, server.find_run(name), file
        )
        return Response(media_type, data)

    def _serve_run(self, name: str) -> Response:
        """Return the page of a run by its name.

        For a sweep it is made anew. For another run in progress it is a page that
        follows the progress, and for a run that has ended the stored page.
        """
        run = self.server.find_run(name)
        home = "../../"  # from runs/NAME/
        if listing.read_listed_run(run, counts=False).command == "sweep":
            page = make_sweep_page(
                [(run, load_sweep_result(run))], [_make_source(name, run, base="")]
            )
            return _serve_page(page, home)
        if is_unfinished(run):
            return _serve_page(make_progress_page(name, run), home)
        return _serve_stored_page(run, home)

    def _serve_part(self, name: str, part: str) -> Response:
        """Return the stored page of a part of a run, such as an attack of a study."""
        # compared to names that exist, since the name comes from a request
        for path in (self.server.find_run(name) / PARTS).iterdir():
            if path.name == part and (path / REPORT).is_file():
                # from runs/NAME/parts/PART/
                return _serve_stored_page(
                    path, home="../../../../", above=("../../", name)
                )
        raise RequestRejected(HTTPStatus.NOT_FOUND, "there is no such attack")

    def _serve_photograph_page(self, name: str) -> Response:
        """Return the page on which photographs are aligned with a run's renderings."""
        run = self.server.find_run(name)
        other_device_url = None
        if self.server.token:  # other machines can reach this server
            other_device_url = self.server.make_url(f"/runs/{quote_name(name)}/align/")
        page = self.server.photograph_pages.make_page(
            run, name, self.server.make_key(name), other_device_url
        )
        # from runs/NAME/align/
        return _serve_page(page, home="../../../", above=("../", name))

    def _serve_comparison(self, query: Query) -> Response:
        """Return a page of several sweeps side by side."""
        names = dict.fromkeys(query.get("run", []))  # each name once
        runs = [(name, self.server.find_run(name)) for name in names]
        _check_comparable(runs)
        sources = [
            _make_source(name, run, f"../runs/{quote_name(name)}/")
            for name, run in runs
        ]
        results = [(run, load_sweep_result(run)) for _, run in runs]
        page = make_sweep_page(results, sources)
        return _serve_page(page, home="../")  # from compare/

    def _serve_rows(self, query: Query, run: Path) -> Response:
        """Return rows of a sweep as packed columns.

        The first response for a page is short, since the user waits for it. But all
        rows of a finished sweep may be stored in this form already; then they are
        returned.
        """
        media_type = "application/octet-stream"
        after = _parse_after(query)  # id of the last row that the page has; 0 for none
        if not after and (run / COLUMNS).is_file() and listing.is_finished(run):
            stored = read_bytes(run / COLUMNS, "columns of a sweep", MAX_COLUMNS_BYTES)
            return Response(media_type, stored)
        max_rows = MAX_ROWS if after else FIRST_ROWS
        # The state is read before the rows. If the run ends in between, it counts as
        # running, so that the page requests its last rows once more.
        is_running = is_held(run)  # locked by a process that works on it
        rows = read_columns(run, after, max_rows)
        has_more = len(rows) == max_rows
        return Response(
            media_type, pack_columns(rows, has_more=has_more, is_running=is_running)
        )

    def _read_body(self) -> bytes:
        """Return the body of a request.

        Raises:
            RequestRejected: its length is missing, wrong or more than
                `clients.MAX_BODY_BYTES`.
        """
        length = self.headers.get("Content-Length", "")
        if not re.fullmatch(r"[0-9]{1,15}", length):
            raise RequestRejected(HTTPStatus.LENGTH_REQUIRED, "its length is missing")
        if int(length) > clients.MAX_BODY_BYTES:
            raise RequestRejected(
                HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
                f"more than {clients.MAX_BODY_BYTES >> 20} MB",
            )
        self.server.clients.report_waiting(UPLOAD_SECONDS)
        data = self.rfile.read(int(length))
        self.server.clients.report_waiting(None)
        if len(data) < int(length):
            raise RequestRejected(HTTPStatus.BAD_REQUEST, "a part of it did not come")
        return data


def _check_comparable(runs: Sequence[tuple[str, Path]]) -> None:
    """Check that there are runs, and that all of them are sweeps.

    Args:
        runs: the runs with their names.

    Raises:
        RequestRejected: there is none, or one is no sweep.
    """
    if not runs:
        raise RequestRejected(HTTPStatus.BAD_REQUEST, "choose at least one sweep")
    other_commands = [
        name
        for name, run in runs
        if listing.read_listed_run(run, counts=False).command != "sweep"
    ]
    if other_commands:
        raise RequestRejected(
            HTTPStatus.BAD_REQUEST,
            "only sweeps can be shown side by side; "
            f"{', '.join(other_commands)} is none",
        )


def _make_common_headers(response: Response) -> dict[str, str]:
    """Return the headers that every response has."""
    return {
        "Content-Type": response.media_type,
        "Content-Length": str(len(response.data)),
        "Content-Security-Policy": response.policy,
        "Cache-Control": "no-store",
        **CLOSED,
    }


def _parse_after(query: Query) -> int:
    """Return the id of the row after which rows are requested."""
    after = query.get("after", [str(FIRST_ROW_ID)])[0]
    if not re.fullmatch(r"[0-9]{1,15}", after):
        raise RequestRejected(HTTPStatus.BAD_REQUEST, "after: expected the id of a row")
    return int(after)


def _describe_error(error: Exception) -> tuple[HTTPStatus, str]:
    """Return the status and the text of the response to an error.

    For an unexpected error, which is not one of advsearch's, the text has only its
    type.
    """
    if isinstance(error, RequestRejected):
        return error.status, str(error)
    if isinstance(error, AdvsearchError):
        return HTTPStatus.INTERNAL_SERVER_ERROR, str(error)
    if isinstance(error, OSError):  # such as a file that was removed meanwhile
        return HTTPStatus.NOT_FOUND, "it is not there any more"
    text = f"{FAULT_MESSAGE}: {type(error).__name__}"
    return HTTPStatus.INTERNAL_SERVER_ERROR, text


def _make_source(name: str, run: Path, base: str) -> SweepSource:
    """Return where the page of a sweep gets rows and images from.

    Args:
        name: name of the run.
        run: its directory.
        base: address of the run, relative to the page.
    """
    return SweepSource(
        name,
        f"{base}rows",
        # the page contains no rows, and requests them from the server
        is_partial=True,
        thumbnails=find_thumbnails(run),
        thumbnail_address=f"{base}pictures",
    )


HTML = "text/html; charset=utf-8"


def _serve_page(
    page: str, home: str | None = None, above: tuple[str, str] | None = None
) -> Response:
    """Return the response with a page that the server has made itself; for `home` and
    `above` see `_add_navigation`.
    """
    data = page.encode("utf-8", "replace")  # names of files may be no text
    if home:
        data = _add_navigation(data, home, above)
    return Response(HTML, data, make_security_policy(is_trusted=True))


def _serve_stored_page(
    run: Path, home: str, above: tuple[str, str] | None = None
) -> Response:
    """Return the response with the stored page of a run.

    Somebody else may have made the run, so only our own scripts run in its page.

    Args:
        run: directory of the run.
        home: address of the list of runs, relative to the page.
        above: address and name of the run of which this run is a part; None for none.
    """
    page = read_bytes(run / REPORT, "a page", MAX_PAGE_BYTES)
    remark = None
    if has_other_scripts(page):
        remark = (
            "Its scripts are of another advsearch and do not run here; advsearch view "
            f"{run.name} makes the page anew."
        )
    return Response(HTML, _add_navigation(page, home, above, remark))


def _add_navigation(
    page: bytes, home: str, above: tuple[str, str] | None, remark: str | None = None
) -> bytes:
    """Insert links to the list of runs, and to the parent run, into a page.

    Args:
        page: the page as HTML.
        home: address of the list of runs, relative to the page.
        above: address and name of the run of which this run is a part; None for none.
        remark: sentence below the links; None for none.
    """
    links = [("All runs", home)]
    if above:
        parent_address, parent_name = above
        links.append((parent_name, parent_address))
    anchors = (make_element("a", text, href=address) for text, address in links)
    navigation = join_html(
        make_element("nav", *anchors, aria_label="back"),
        make_element("p", remark, class_="remarks") if remark else None,
    )
    # at the beginning of the body, or of a page without one
    start = 0
    if b"<body>" in page:
        start = page.find(b"<body>") + len(b"<body>")
    return page[:start] + navigation.encode("utf-8", "replace") + page[start:]
