"""Photographs: what a browser may send, what is kept of it, how it is judged and counted, and over what it comes."""

import io
import json
import os
import ssl
import struct
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import closing
from http.client import HTTPConnection, HTTPResponse, HTTPSConnection
from pathlib import Path
from urllib.parse import unquote

import pytest
from PIL import Image

from advsearch.errors import InputError
from advsearch.questions.photographs.carry_out import Photographs, photo_agreement
from advsearch.questions.photographs.result import find_photo, find_rendering, sanitize_photo
from advsearch.runs.directory import RunDirectory
from advsearch.runs.store import Store
from advsearch.statistics.intervals import clopper_pearson
from advsearch.trust.network import make_https_context
from advsearch.viewer.clients import MAX_BODY_BYTES
from advsearch.viewer.server import Dashboard
from stored_sweeps import make_sweep, serving

pytestmark = pytest.mark.island("advsearch.questions.photographs")


def picture(size: tuple[int, int] = (64, 48), format: str = "JPEG", level: int = 128) -> bytes:
    """A grey picture as a file."""
    stream = io.BytesIO()
    Image.new("RGB", size, (level, level, level)).save(stream, format)
    return stream.getvalue()


def bomb(side: int) -> bytes:
    """A PNG of a few bytes that says that it is side x side pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(b"\0" * 1000)) + chunk(b"IEND", b"")


def post(
    server: Dashboard, path: str, data: bytes, secure: bool = False, **headers: str | None
) -> tuple[HTTPResponse, bytes]:
    """The answer to a photograph, sent as the page does; headers that are None are left out."""
    host, name = f"127.0.0.1:{server.server_port}", unquote([*path.split("/"), "", ""][2])
    given: dict[str, str | None] = {
        "Origin": f"{server.scheme}://{host}", "X-Advsearch-Key": server.make_key(name),
        "Content-Length": str(len(data)),
        **{name.replace("_", "-"): text for name, text in headers.items()},
    }  # fmt: skip
    context = ssl._create_unverified_context() if secure else None
    made = HTTPSConnection(host, timeout=600, context=context) if secure else HTTPConnection(host, timeout=600)
    with closing(made):
        made.putrequest("POST", path)
        for name, text in given.items():
            if text is not None:
                made.putheader(name, text)
        made.endheaders()
        made.send(data)
        answer = made.getresponse()
        return answer, answer.read()


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_sweep(tmp_path_factory.mktemp("runs") / "first", keep="all")


@pytest.fixture(scope="module")
def taker() -> Photographs:
    return Photographs()


@pytest.fixture(scope="module")
def server(run: Path, taker: Photographs) -> Iterator[Dashboard]:
    with serving(run, photographs=taker) as started:
        yield started


PATH = "/runs/first/align/renderings/3"


def kept(run: Path) -> int:
    """How many photographs a run has."""
    return len(list((run / "images/photos").glob("*"))) if (run / "images/photos").is_dir() else 0


@pytest.mark.medium
def test_a_photograph_is_cut_to_the_renderings_shape_and_says_nothing_else() -> None:
    stream = io.BytesIO()
    exif = Image.Exif()
    exif[0x010F], exif[0x0112] = "a phone", 6  # the maker; turned by a quarter
    Image.new("RGB", (300, 100), (200, 0, 0)).save(stream, "JPEG", exif=exif)
    with Image.open(io.BytesIO(sanitize_photo(stream.getvalue(), (40, 60)))) as image:
        assert image.format == "JPEG"
        assert image.size == (200, 300)
        assert not image.getexif()
        assert "exif" not in image.info
    with Image.open(io.BytesIO(sanitize_photo(picture((3000, 2000), "WEBP"), (16, 16)))) as image:
        assert image.size == (1024, 1024)


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (b"", "expected a picture"), (b"<svg/>", "expected a picture"), (picture(format="GIF"), "expected a picture"),
        (bomb(12_000), "at most 50,000,000 pixels"), (bomb(60_000), "at most 50,000,000 pixels"),
        (bytes(MAX_BODY_BYTES + 1), "at most 16 MB"),
    ],
)  # fmt: skip
def test_what_is_no_photograph_is_refused(data: bytes, text: str) -> None:
    with pytest.raises(InputError, match=text):
        sanitize_photo(data, (16, 16))


@pytest.mark.parametrize(
    "name", ["..", "../run", "3/../../run.yaml", "%2e%2e", "99", "-1", "difference", "\0", "3\n", "", "²"]
)
def test_a_rendering_is_found_by_its_own_name_only(run: Path, name: str) -> None:
    with pytest.raises(InputError):
        find_rendering(run, name)
    with pytest.raises(InputError):
        find_photo(run, name)


def test_photographs_are_judged_by_the_runs_model_and_counted(tmp_path: Path, taker: Photographs) -> None:
    run = make_sweep(tmp_path / "sweep", keep="all")
    for name in ("0", "2", "2"):  # 2 is wrong in the rendering; the model calls a grey picture something else as well
        table = taker.add(run, name, picture())
    grey = table.renderings[0].labels[0]
    assert grey != "mug"
    assert (table.right_right, table.right_wrong, table.wrong_right, table.wrong_wrong) == (0, 1, 0, 2)
    assert table.agreement == pytest.approx(2 / 3)
    assert table.interval == clopper_pearson(2, 3)
    one, two = table.renderings
    assert (one.rendering, one.label, one.rendering_right, one.agreeing) == ("0", "mug", True, 0)
    assert (two.rendering, two.label, two.rendering_right, two.photos, two.agreeing) == ("2", "cup", False, 2, 2)
    assert two.interval == clopper_pearson(2, 2)
    assert two.files == ["2-0001.jpg", "2-0002.jpg"]
    assert all(find_photo(run, name).read_bytes()[:2] == b"\xff\xd8" for name in (*one.files, *two.files))
    with Store(run / "results.sqlite", read_only=True) as store:
        row = store.read_row("photo", 1)
    assert row is not None
    assert row.values["camera.elevation"]["value"] == 40.0  # the configuration that it should show
    assert row.label == grey
    assert photo_agreement(run) == table


def test_a_run_at_work_takes_no_photographs(tmp_path: Path, taker: Photographs) -> None:
    run = make_sweep(tmp_path / "going", keep="all", ended=False)
    with RunDirectory.resume(run), pytest.raises(InputError, match="working on"):
        taker.add(run, "3", picture())
    assert kept(run) == 0


def test_a_page_takes_a_photograph(server: Dashboard, run: Path) -> None:
    before = kept(run)
    answer, data = post(server, PATH, picture())
    assert answer.status == 200
    assert "agree in" in json.loads(data)["table"]
    assert kept(run) == before + 1


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"X_Advsearch_Key": None}, 403), ({"X_Advsearch_Key": "wrong"}, 403), ({"X_Advsearch_Key": "\xe9"}, 403),
        ({"Sec_Fetch_Site": "cross-site", "Sec_Fetch_Mode": "cors"}, 403),
        ({"Sec_Fetch_Site": "cross-site", "Sec_Fetch_Mode": "navigate"}, 403),
        ({"Sec_Fetch_Site": "same-site", "Sec_Fetch_Mode": "cors"}, 403), ({"Origin": None}, 403),
        ({"Origin": "http://evil.example"}, 403), ({"Origin": "null"}, 403), ({"Host": "evil.example"}, 403),
        ({"Content_Length": None}, 411), ({"Content_Length": "-5"}, 411),
        ({"Content_Length": str(MAX_BODY_BYTES + 1)}, 413), ({"Content_Length": "9" * 15}, 413),
    ],
)  # fmt: skip
def test_others_send_no_photograph(server: Dashboard, run: Path, headers: dict[str, str | None], status: int) -> None:
    before = kept(run)
    if "Host" in headers:
        answer, data = ask_as(server, str(headers["Host"]))
    else:
        answer, data = post(server, PATH, b"" if status in (411, 413) else picture(), False, **headers)
    assert answer.status == status
    assert len(data) < 200
    assert kept(run) == before


def ask_as(server: Dashboard, host: str) -> tuple[HTTPResponse, bytes]:
    """The answer to a photograph for another host's name."""
    made = HTTPConnection("127.0.0.1", server.server_port, timeout=600)
    made.putrequest("POST", PATH, skip_host=True)
    for name, text in (("Host", host), ("Origin", f"http://{host}"), ("X-Advsearch-Key", server.make_key("first"))):
        made.putheader(name, text)
    made.endheaders()
    answer = made.getresponse()
    return answer, answer.read()


@pytest.mark.parametrize(
    "path",
    [
        "/", "/runs/first/rows", "/runs/none/align/renderings/3",
        "/runs/first/align/renderings/99", "/runs/first/align/renderings/..%2f..%2frun.yaml",
        "/runs/..%2f..%2fetc/align/renderings/3",
    ],
)  # fmt: skip
def test_a_photograph_goes_nowhere_else(server: Dashboard, run: Path, path: str) -> None:
    before = kept(run)
    answer, data = post(server, path, picture())
    assert answer.status == 404
    assert len(data) < 200
    assert kept(run) == before


def test_renderings_and_photographs_are_shown(server: Dashboard, run: Path) -> None:
    post(server, PATH, picture())
    name = sorted((run / "images/photos").glob("*"))[0].name
    for path, found in (("renderings/3", "images/rows/0000/3.jpg"), (f"photos/{name}", f"images/photos/{name}")):
        made = HTTPConnection("127.0.0.1", server.server_port, timeout=600)
        made.request("GET", f"/runs/first/align/{path}")
        assert made.getresponse().read() == (run / found).read_bytes()
    made.request("GET", "/runs/first/align/")
    page = made.getresponse().read().decode()
    assert server.make_key("first") in page
    assert "Renderings of this run (24): 0, 1" in page


def test_beyond_this_machine_it_is_https_with_a_token(run: Path, taker: Photographs) -> None:
    with serving(run, host="0.0.0.0", photographs=taker) as server:
        assert server.address.startswith("https://")
        assert server.fingerprint is not None
        assert post(server, PATH, picture(), secure=True)[0].status == 401
        answer, _ = post(server, f"{PATH}?token={server.token}", picture(), secure=True)
        assert answer.status == 200
        assert "Secure" in answer.headers["Set-Cookie"]
        with pytest.raises((ConnectionError, OSError, ssl.SSLError)):
            post(server, PATH, picture())  # no HTTP beside it
        assert post(server, f"{PATH}?token={server.token}", picture(), secure=True)[0].status == 200


def test_the_key_is_for_this_user_alone_and_does_not_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[tuple[int, int]] = []
    original = ssl.SSLContext.load_cert_chain

    def looked_at(self: ssl.SSLContext, certfile: Path, keyfile: Path) -> None:
        seen.append((os.stat(keyfile).st_mode & 0o777, os.stat(keyfile.parent).st_mode & 0o777))
        original(self, certfile, keyfile)

    monkeypatch.setattr(ssl.SSLContext, "load_cert_chain", looked_at)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    make_https_context(["127.0.0.1", "localhost"])
    assert seen == [(0o600, 0o700)]
    assert list(tmp_path.iterdir()) == []
