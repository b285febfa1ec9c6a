"""The dashboard's server: what it answers, and what it refuses."""

from __future__ import annotations

import os
import shutil
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from http.client import HTTPConnection, HTTPResponse, HTTPSConnection
from pathlib import Path
from ssl import _create_unverified_context
from typing import TYPE_CHECKING

import pytest

from advsearch.errors import InputError
from advsearch.viewer import clients
from advsearch.viewer.document import has_other_scripts
from advsearch.viewer.server import Dashboard
from samples import make_run, written_page
from stored_sweeps import make_sweep, serving

if TYPE_CHECKING:
    from advsearch.questions.photographs.result import PhotoAgreement


def ask(server: Dashboard, path: str, method: str = "GET", **headers: str) -> tuple[HTTPResponse, bytes]:
    """The answer to one request, whatever the path looks like."""
    made = HTTPConnection if server.scheme == "http" else partial(HTTPSConnection, context=_create_unverified_context())
    connection = made("127.0.0.1", server.server_port, timeout=600)
    given = {
        "Host": f"127.0.0.1:{server.server_port}",
        **{name.replace("_", "-"): text for name, text in headers.items()},
    }
    connection.putrequest(method, path, skip_host=True)
    for name, text in given.items():
        connection.putheader(name, text)
    connection.endheaders()
    answer = connection.getresponse()
    return answer, answer.read()


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_sweep(tmp_path_factory.mktemp("runs") / "first", keep="all")


@pytest.fixture(scope="module")
def server(run: Path) -> Iterator[Dashboard]:
    with serving(run, make_sweep(run.parent / "second, <b>")) as started:
        yield started


def test_it_lists_runs_and_shows_them(server: Dashboard) -> None:
    _, page = ask(server, "/")
    assert b'href="runs/first/"' in page
    assert f"{time.localtime().tm_year}-" in page.decode()  # when it was begun
    assert b"<b>" not in page
    answer, page = ask(server, "/runs/first/")
    assert answer.status == 200
    assert b'"rows": "rows"' in page
    assert b'<nav aria-label="back"><a href="../../">All runs</a></nav>' in page
    answer, page = ask(server, "/runs/second%2C%20%3Cb%3E/")
    assert answer.status == 200
    answer, page = ask(server, "/compare/?run=first&run=second%2C%20%3Cb%3E")
    assert answer.status == 200
    assert page.count(b'"rows": "../runs/') == 2
    assert b'<a href="../">All runs</a>' in page


def test_rows_and_pictures(server: Dashboard, run: Path) -> None:
    answer, data = ask(server, "/runs/first/rows?after=0")
    assert data == (run / "columns.bin").read_bytes()
    answer, data = ask(server, "/runs/first/pictures/0000/3.jpg")
    assert (answer.status, answer.headers["Content-Type"]) == (200, "image/jpeg")
    assert data == (run / "images/rows/0000/3.jpg").read_bytes()


@pytest.mark.parametrize(
    "path",
    [
        "/../../etc/passwd", "/runs/../first/run.yaml", "/runs/first/../../../etc/passwd", "/runs/..%2f..%2fetc/",
        "/runs/first/run.yaml", "/runs/first/results.sqlite", "/runs/first/pictures/0000/..%2f..%2frun.yaml",
        "/runs/first/pictures/../../run.yaml", "/runs/first/pictures/0000/99.jpg", "/runs/first/pictures/0000/-1.jpg",
        "/runs/%00/", "/runs//", "/runs/none/", "/compare/?run=none", "http://elsewhere/", "/" + "a" * 9000,
    ],
)  # fmt: skip
def test_nothing_else_is_answered(server: Dashboard, path: str) -> None:
    answer, data = ask(server, path)
    assert answer.status in (400, 404, 414)
    assert len(data) < 200
    assert b"root:" not in data


def test_a_picture_that_is_a_link_is_none(server: Dashboard, run: Path, tmp_path: Path) -> None:
    secret = tmp_path / "secret"
    secret.write_text("secret")
    (run / "images/rows/0000/77.jpg").symlink_to(secret)
    try:
        answer, data = ask(server, "/runs/first/pictures/0000/77.jpg")
    finally:
        (run / "images/rows/0000/77.jpg").unlink()
    assert answer.status == 404
    assert b"secret" not in data


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "evil.example"}, {"Host": ""}, {"Origin": "http://evil.example"},
        {"Sec_Fetch_Site": "cross-site", "Sec_Fetch_Mode": "no-cors"},
    ],
)  # fmt: skip
def test_another_sites_page_reads_nothing(server: Dashboard, headers: dict[str, str]) -> None:
    answer, data = ask(server, "/runs/first/rows", **headers)
    assert answer.status == 403
    assert len(data) < 200


def test_a_name_that_leads_here_is_refused_with_the_right_port(server: Dashboard) -> None:
    assert ask(server, "/", Host=f"evil.example:{server.server_port}")[0].status == 403
    assert ask(server, "/", Host=f"localhost:{server.server_port}")[0].status == 200


def test_nothing_is_changed_and_only_photographs_are_sent(server: Dashboard) -> None:
    for method in ("PUT", "DELETE", "OPTIONS", "CONNECT"):
        assert ask(server, "/", method)[0].status == 501, method
    assert ask(server, "/", "POST")[0].status == ask(server, "/runs/first/rows", "POST")[0].status == 404


def test_beyond_this_machine_the_token_is_asked_for(run: Path) -> None:
    with serving(run, host="0.0.0.0") as server:
        assert server.token is not None
        assert server.token in server.address
        assert ask(server, "/")[0].status == 401
        assert ask(server, "/?token=wrong")[0].status == 401
        answer, _ = ask(server, f"/?token={server.token}")
        assert answer.status == 200
        cookie = answer.headers["Set-Cookie"]
        assert "HttpOnly" in cookie
        assert "SameSite=Lax" in cookie
        assert ask(server, "/runs/first/rows", Cookie=cookie.split(";")[0])[0].status == 200
        assert ask(server, "/runs/first/rows", Cookie="advsearch-1=x")[0].status == 401


@contextmanager
def slow_clients(server: Dashboard, count: int, begun: bytes) -> Iterator[list[socket.socket]]:
    """Clients that have begun to ask, and go on with a letter now and then."""
    with ExitStack() as stack:
        talks = [
            stack.enter_context(socket.create_connection(("127.0.0.1", server.server_port), 60)) for _ in range(count)
        ]
        for talk in talks:
            talk.sendall(begun)
        done = threading.Event()

        def dribble() -> None:
            while not done.wait(0.05):
                for talk in talks:
                    with suppress(OSError):
                        talk.sendall(b"a")

        thread = threading.Thread(target=dribble)
        thread.start()
        try:
            yield talks
        finally:
            done.set()
            thread.join()


@pytest.mark.parametrize(
    "begun", [b"", b"G", b"GET / HTTP/1.0\r\nA: ", b"POST /runs/first/align/renderings/3 HTTP/1.0\r\n"]
)
def test_slow_clients_keep_nobody_out(server: Dashboard, begun: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    """More of them than workers: each has a little while where others wait, in all and not for each letter."""
    monkeypatch.setattr("advsearch.viewer.clients.REQUEST_SECONDS", 1e6)
    monkeypatch.setattr("advsearch.viewer.clients.SLOW_CLIENT_SECONDS", 0.2)
    with slow_clients(server, 3 * clients.N_WORKERS, begun):
        for _ in range(3):
            assert ask(server, "/")[0].status == 200


def test_a_request_has_its_time_in_all(server: Dashboard, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("advsearch.viewer.clients.REQUEST_SECONDS", 0.2)
    with slow_clients(server, 2, b"GET / HTTP/1.0\r\nA: ") as talks:
        for talk in talks:
            with suppress(ConnectionResetError):
                assert talk.recv(1000) == b""  # ended by the server, although no letter was late


@pytest.mark.medium
def test_who_takes_no_answer_keeps_nobody_out(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("advsearch.viewer.clients.SLOW_CLIENT_SECONDS", 0.2)
    monkeypatch.setattr("advsearch.viewer.server.make_list_page", lambda _: "x" * (64 << 20))
    with serving(run) as server, ExitStack() as stack:
        for _ in range(clients.N_WORKERS):
            talk = stack.enter_context(socket.create_connection(("127.0.0.1", server.server_port), 60))
            talk.sendall(f"GET / HTTP/1.0\r\nHost: 127.0.0.1:{server.server_port}\r\n\r\n".encode())
        assert ask(server, "/runs/first/cover")[0].status == 200


@pytest.mark.island("advsearch.questions.photographs")
@pytest.mark.medium
@pytest.mark.parametrize(
    ("path", "kind", "own"),
    [
        ("/", "text/html; charset=utf-8", True), ("/compare/?run=first", "text/html; charset=utf-8", True),
        ("/runs/first/", "text/html; charset=utf-8", True), ("/runs/first/align/", "text/html; charset=utf-8", True),
        ("/runs/attack/", "text/html; charset=utf-8", False), ("/runs/attack/cover", "image/jpeg", False),
        ("/runs/attack/progress", "application/json", False),
        ("/runs/attack/align/renderings/clean", "image/png", False),
        ("/runs/first/rows", "application/octet-stream", False),
        ("/runs/first/pictures/0000/3.jpg", "image/jpeg", False),
        ("/runs/first/align/renderings/3", "image/jpeg", False), ("/runs/none/", "text/plain; charset=utf-8", False),
    ],
)  # fmt: skip
def test_every_result_has_a_kind_and_a_policy(run: Path, attack_run: Path, path: str, kind: str, own: bool) -> None:
    """A page of the server's own may ask it for more; all else has an origin of its own. Neither runs foreign code."""
    with serving(run, attack_run, photographs=NoPhotographs()) as server:
        answer, _ = ask(server, path)
    assert answer.headers["Content-Type"] == kind
    assert answer.headers["X-Content-Type-Options"] == "nosniff"
    rules = dict(one.strip().partition(" ")[::2] for one in answer.headers["Content-Security-Policy"].split(";"))
    assert rules["default-src"] == "'none'" and rules["frame-ancestors"] == "'none'" and rules["base-uri"] == "'none'"
    assert "sandbox" not in rules if own else "allow-same-origin" not in rules["sandbox"]
    assert rules.get("connect-src") == ("'self'" if own else None)
    assert rules["img-src"] == ("data: 'self'" if own else "data:")
    assert rules["form-action"] == ("'self'" if own else "'none'")
    assert all(one.startswith("'sha256-") for one in rules["script-src"].split())


class NoPhotographs:
    """Takes none."""

    def add(self, run: Path, rendering: str, data: bytes) -> PhotoAgreement:
        raise InputError("none")

    def agreement(self, run: Path) -> PhotoAgreement:
        from advsearch.questions.photographs.result import PhotoAgreement

        return PhotoAgreement.from_values(
            dict.fromkeys(("photos", "right_right", "right_wrong", "wrong_right", "wrong_wrong"), 0)
            | {"agreement": None, "interval": None, "renderings": []}
        )


@pytest.fixture(scope="module")
def attack_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = make_run(tmp_path_factory.mktemp("runs") / "attack")
    written_page(run)
    return run


def test_a_page_whose_scripts_are_others_says_so(attack_run: Path, tmp_path: Path) -> None:
    shutil.copytree(attack_run, tmp_path / "other")
    page = (attack_run / "report.html").read_text()
    (tmp_path / "other" / "report.html").write_text(page.replace("</body>", "<SCRIPT>alert(1)</SCRIPT></body>"))
    with serving(attack_run, tmp_path / "other") as server:
        said = b"Its scripts are of another advsearch and do not run here; advsearch view other"
        assert said in ask(server, "/runs/other/")[1]
        assert said[:20] not in ask(server, "/runs/attack/")[1]


@pytest.mark.parametrize("part", [b"<script", b"<script>", b'<script type="application/', b"</script>", b"<script>a"])
def test_a_page_of_many_scripts_is_looked_through_once(part: bytes) -> None:
    assert has_other_scripts(part * 100_000) == (part[:8] == b"<script>")


def test_a_photograph_of_one_run_needs_its_own_key(run: Path) -> None:
    with serving(run) as server:
        assert server.make_key("first") != server.make_key("second")
        assert server.make_key("first").encode() not in ask(server, "/")[1] + ask(server, "/runs/first/")[1]


def test_a_bad_run_does_not_take_the_list_along(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in (b"good", b"b\xffd", b"linked", b"broken", b"deep"):
        make_sweep(tmp_path / "runs" / "made").rename(tmp_path / "runs" / os.fsdecode(name))
    (tmp_path / "runs/linked/columns.bin").unlink()
    (tmp_path / "runs/linked/columns.bin").symlink_to("/etc/passwd")
    (tmp_path / "runs/broken/summary.json").write_text("NaN")
    (tmp_path / "runs/deep/summary.json").write_text("[" * 100_000)
    with serving() as server:
        page = ask(server, "/")[1].decode()
        assert page.count("<tr") == 6 and "b?d" in page
        assert page.count("runs/linked/columns.bin: expected a file or a folder of this run, got a link") == 1
        assert page.count("summary.json: expected the summary of a run") == 2
        assert ask(server, "/runs/b%FFd/")[0].status == ask(server, "/runs/b%FFd/rows")[0].status == 200
        assert ask(server, "/runs/b%FFd/align/")[0].status == 404  # no photographs here, and no fault
        for path in ("", "rows", "cover", "pictures/0000/3.jpg", "progress"):
            answer, said = ask(server, f"/runs/linked/{path}")
            assert answer.status == 500 and b"got a link" in said and b"root:" not in said


def test_a_client_that_goes_away_does_no_harm(server: Dashboard) -> None:
    for data in (b"", b"GET / HT", b"\x00" * 100 + b"\r\n\r\n", b"GET / HTTP/1.1\r\n" + b"A: b\r\n" * 200 + b"\r\n"):
        with socket.create_connection(("127.0.0.1", server.server_port)) as connection:
            connection.sendall(data)
    assert ask(server, "/")[0].status == 200


def test_a_port_that_is_taken_is_told(server: Dashboard) -> None:
    with pytest.raises(InputError, match="cannot listen"):
        Dashboard((), "127.0.0.1", server.server_port)


@pytest.mark.medium
def test_a_thousand_at_once_are_answered(server: Dashboard) -> None:
    """All are connected and have asked before the first answer is read; the server has no more threads than before."""
    asked = f"GET /runs/first/pictures/0000/1.jpg HTTP/1.0\r\nHost: 127.0.0.1:{server.server_port}\r\n\r\n".encode()
    assert ask(server, "/")[0].status == 200  # its threads have begun
    threads, counts = threading.active_count(), []
    with ExitStack() as stack:
        talks = [
            stack.enter_context(socket.create_connection(("127.0.0.1", server.server_port), 60)) for _ in range(1000)
        ]
        for talk in talks:
            talk.sendall(asked)
            counts.append(threading.active_count())
        answers = [talk.makefile("rb").read() for talk in talks]
    assert all(one.startswith(b"HTTP/1.0 200") for one in answers)
    assert len(set(map(len, answers))) == 1
    assert max(counts) <= threads  # fewer where those of another test's server have ended meanwhile
    assert ask(server, "/")[0].status == 200


def test_those_who_say_nothing_do_not_fill_the_server(server: Dashboard, monkeypatch: pytest.MonkeyPatch) -> None:
    """A thousand connections that never ask hold it up for as long as its patience lasts, no longer."""
    monkeypatch.setattr("advsearch.viewer.clients.REQUEST_SECONDS", 0.01)
    with ExitStack() as stack:
        for _ in range(1000):
            stack.enter_context(socket.create_connection(("127.0.0.1", server.server_port), 60))
        assert ask(server, "/")[0].status == 200


def test_who_waits_when_it_closes_is_hung_up_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """No worker is there to serve one that has asked."""
    monkeypatch.setattr("advsearch.viewer.clients.N_WORKERS", 0)
    with socket.create_server(("127.0.0.1", 0)) as listening:
        served = clients.ConnectionPool(listening, lambda connection, address: None, None)
        thread = threading.Thread(target=served.serve)
        thread.start()
        with socket.create_connection(listening.getsockname()) as asking:
            asking.sendall(b"GET / HTTP/1.0\r\n\r\n")
            while served._ready.empty():
                time.sleep(0.01)
            served.close()
            asking.settimeout(120.0)
            with suppress(ConnectionResetError):  # what it has said was never read
                assert asking.recv(1) == b""
            assert served._ready.empty()
        thread.join()


def test_a_damaged_or_missing_run_is_told(tmp_path: Path) -> None:
    damaged, gone = make_sweep(tmp_path / "damaged", ended=False), make_sweep(tmp_path / "gone", ended=False)
    with serving(damaged, gone) as server:
        (damaged / "results.sqlite").write_bytes(b"no database")
        (gone / "results.sqlite").unlink()
        for name in ("damaged", "gone"):
            answer, data = ask(server, f"/runs/{name}/rows")
            assert answer.status == 500
            assert b"expected" in data
        assert ask(server, "/")[0].status == 200
