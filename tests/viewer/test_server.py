"""The dashboard's server: what it answers, and what it refuses."""

from __future__ import annotations

import io
import re
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from functools import partial
from http.client import HTTPConnection, HTTPResponse, HTTPSConnection
from pathlib import Path
from ssl import _create_unverified_context

import numpy as np
import pytest
from PIL import Image
from stored_sweeps import make_sweep, serving

from advsearch.errors import InputError
from advsearch.runs.directory import RunDirectory
from advsearch.viewer.server import Dashboard
from advsearch.viewer.thumbnails import Kept


def ask(server: Dashboard, path: str, method: str = "GET", **headers: str) -> tuple[HTTPResponse, bytes]:
    """The answer to one request, whatever the path looks like."""
    made = HTTPConnection if server.scheme == "http" else partial(HTTPSConnection, context=_create_unverified_context())
    connection = made("127.0.0.1", server.server_port, timeout=120)
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


def test_a_list_has_pictures(server: Dashboard, run: Path) -> None:
    for name, colour in (("worst", (200, 40, 40)), ("adversarial", (40, 40, 200))):
        Image.new("RGB", (300, 200), colour).save(run / "images" / f"{name}.png")
        answer, data = ask(server, "/runs/first/cover")
        assert answer.headers["Content-Type"] == "image/jpeg"
        with Image.open(io.BytesIO(data)) as shown:
            assert shown.size == (128, 85)
            assert np.abs(np.asarray(shown)[40, 60].astype(int) - colour).max() < 12
        (run / "images" / f"{name}.png").unlink()
    assert ask(server, "/runs/first/cover")[0].status == 200  # grey


def test_pages_work_below_another_address(server: Dashboard) -> None:
    """As behind a proxy that takes a part of the address away: no link, and nothing that is fetched, begins at /."""
    for path in ("/", "/runs/first/", "/compare/?run=first", "/runs/first/align/"):
        _, page = ask(server, path)
        assert not re.findall(rb'(?:href|src|action)="/', page), path
        assert not re.findall(rb'"(?:rows|folder|path)": "/', page), path


def test_rows_and_pictures(server: Dashboard, run: Path) -> None:
    answer, data = ask(server, "/runs/first/rows?after=0")
    assert data == (run / "columns.bin").read_bytes()
    answer, data = ask(server, "/runs/first/pictures/0000/3.jpg")
    assert (answer.status, answer.headers["Content-Type"]) == (200, "image/jpeg")
    assert data == (run / "images/rows/0000/3.jpg").read_bytes()


def test_a_page_lists_no_pictures_where_all_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """There may be a million; where only some are kept, it says which."""
    every, wrong = (make_sweep(tmp_path / keep, keep=keep) for keep in ("all", "wrong"))
    listed: list[str] = []

    def numbers(kept: Kept) -> tuple[int, ...]:
        listed.append(kept.run.name)
        return 10, 11

    monkeypatch.setattr(Kept, "numbers", property(numbers))
    with serving(every, wrong) as server:
        assert b'"kept":null' in ask(server, "/runs/all/")[1].replace(b" ", b"")
        assert b'"kept":[10,11]' in ask(server, "/runs/wrong/")[1].replace(b" ", b"")
    assert listed == ["wrong"]


def test_a_sweep_that_goes_on_is_followed(tmp_path: Path) -> None:
    path = make_sweep(tmp_path / "going", ended=False)
    with serving(path) as server, RunDirectory.resume(path):
        _, data = ask(server, "/runs/going/rows?after=0")
        assert b'"running": true' in data
        assert b'"count": 24' in data
        _, data = ask(server, "/runs/going/rows?after=24")
        assert b'"count": 0' in data
        assert b"not ended yet" in ask(server, "/runs/going/")[1]


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
        {"Host": "evil.example"},
        {"Host": "evil.example:80"},
        {"Host": ""},
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Sec_Fetch_Site": "cross-site", "Sec_Fetch_Mode": "no-cors"},
    ],
)
def test_another_sites_page_reads_nothing(server: Dashboard, headers: dict[str, str]) -> None:
    answer, data = ask(server, "/runs/first/rows", **headers)
    assert answer.status == 403
    assert len(data) < 200


def test_a_name_that_leads_here_is_refused_with_the_right_port(server: Dashboard) -> None:
    assert ask(server, "/", Host=f"evil.example:{server.server_port}")[0].status == 403
    assert ask(server, "/", Host=f"localhost:{server.server_port}")[0].status == 200


@pytest.mark.parametrize("method", ["PUT", "DELETE", "OPTIONS", "CONNECT"])
def test_nothing_is_changed(server: Dashboard, method: str) -> None:
    assert ask(server, "/", method)[0].status == 501


def test_only_photographs_are_sent(server: Dashboard) -> None:
    assert ask(server, "/", "POST")[0].status == 404
    assert ask(server, "/runs/first/rows", "POST")[0].status == 404


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
        assert "SameSite=Strict" in cookie
        assert ask(server, "/runs/first/rows", Cookie=cookie.split(";")[0])[0].status == 200
        assert ask(server, "/runs/first/rows", Cookie="advsearch-1=x")[0].status == 401


def test_a_thousand_at_once_are_answered(server: Dashboard) -> None:
    """All are connected and have asked before the first answer is read; the server has no more threads than before."""
    asked = f"GET /runs/first/pictures/0000/1.jpg HTTP/1.0\r\nHost: 127.0.0.1:{server.server_port}\r\n\r\n".encode()
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
    monkeypatch.setattr("advsearch.viewer.server.PATIENCE", 0.01)
    with ExitStack() as stack:
        for _ in range(1000):
            stack.enter_context(socket.create_connection(("127.0.0.1", server.server_port), 60))
        assert ask(server, "/")[0].status == 200


def test_a_client_that_goes_away_does_no_harm(server: Dashboard) -> None:
    for data in (b"", b"GET / HT", b"\x00" * 100 + b"\r\n\r\n", b"GET / HTTP/1.1\r\n" + b"A: b\r\n" * 200 + b"\r\n"):
        with socket.create_connection(("127.0.0.1", server.server_port)) as connection:
            connection.sendall(data)
    assert ask(server, "/")[0].status == 200


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


def test_a_port_that_is_taken_is_told(server: Dashboard) -> None:
    with pytest.raises(InputError, match="cannot listen"):
        Dashboard((), "127.0.0.1", server.server_port)
