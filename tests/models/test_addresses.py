"""Models that only answer, asked over the network: a real server on this machine, well behaved and otherwise."""

import base64
import io
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

import advsearch
from advsearch.cli.main import main
from advsearch.errors import InputError, ModelError
from advsearch.models import address
from advsearch.tasks import make_task
from advsearch.trust.code import restrict_allowed_code
from advsearch.trust.network import KEY, check_address

pytestmark = pytest.mark.island("advsearch.models.address", "advsearch.tasks.answers")

SECRET = "sk-very-secret"
SMALL = ["--object", "mug", "--resolution", "24", "--spp", "2", "--verify-spp", "4", "--trials", "6", "--quiet"]

Reply = tuple[int, dict[str, str], bytes]


class Server(ThreadingHTTPServer):
    """Says what `say` does of each request, and keeps what came: path, headers and JSON."""

    say: Callable[[dict[str, Any]], Reply | dict[str, Any]]

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.came: list[tuple[str, dict[str, str], dict[str, Any]]] = []

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"

    @property
    def chat(self) -> str:
        return f"{self.url}/v1/chat/completions#tiny"


class _Handler(BaseHTTPRequestHandler):
    server: Server

    def do_POST(self) -> None:
        asked = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        self.server.came.append((self.path, dict(self.headers), asked))
        said = self.server.say(asked)
        status, headers, body = said if isinstance(said, tuple) else (200, {}, json.dumps(said).encode())
        try:
            self.send_response(status)
            for name, value in headers.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(body)
        except OSError:  # nobody waits for it any more
            pass

    def log_message(self, *_: Any) -> None:
        pass


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    monkeypatch.setattr(address, "FIRST_DELAY", 0.01)
    monkeypatch.delenv(KEY, raising=False)
    with Server() as made, serving(made):
        yield made


@contextmanager
def serving(server: ThreadingHTTPServer) -> Iterator[None]:
    thread = threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True)
    thread.start()
    try:
        yield
    finally:
        server.shutdown()
        thread.join()


def shade(asked: dict[str, Any]) -> float:
    """How light the picture is that came."""
    picture = asked["image"]
    return float(np.asarray(Image.open(io.BytesIO(base64.b64decode(picture)))).mean()) / 255.0


def scores(asked: dict[str, Any]) -> dict[str, Any]:
    return {"scores": {"mug": shade(asked), "bowl": 1.0 - shade(asked)}}


def chat(text: str, **more: Any) -> Callable[[dict[str, Any]], dict[str, Any]]:
    usage = {"prompt_tokens": 100, "completion_tokens": 10}
    return lambda asked: {"choices": [{"message": {"content": text}}], "usage": usage, **more}


@pytest.mark.island("all")
@pytest.mark.medium
def test_the_server_of_the_page_is_the_model_behind_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its logits are those of the model that it asks, of a picture of 8 bits, up to a constant of each picture."""
    from check_docs import DOCS, blocks

    (block,) = blocks(DOCS / "addresses.md", "python")
    names: dict[str, Any] = {"__name__": "page"}
    exec(compile(block, "addresses.md", "exec"), names)
    monkeypatch.setattr(names["Answers"], "log_message", lambda *_: None)
    with ThreadingHTTPServer(("127.0.0.1", 0), names["Answers"]) as made, serving(made):
        model = advsearch.load_model(f"http://127.0.0.1:{made.server_port}")
        images = torch.rand((2, 48, 48, 3), generator=torch.Generator().manual_seed(1))
        logits = model(images)
    own = names["model"]
    assert model.labels == own.labels and not model.differentiable
    expected = own((images * 255).round() / 255).softmax(dim=1)
    assert torch.allclose(logits.exp(), expected.clamp_min(address.MIN_SCORE), atol=1e-5)


def test_what_is_sent_is_the_picture_as_rendered_and_the_question(server: Server) -> None:
    server.say = lambda asked: {"text": "A Mug."}
    model = advsearch.load_model(server.url, task="answer", prompt="Is it a mug?")
    picture = torch.rand((20, 30, 3), generator=torch.Generator().manual_seed(2))
    task = make_task("answer").on(model)
    assert not server.came, "nothing is asked before there is a picture"
    (judged,) = task.judge(model(picture), ("mug",))
    assert judged.right and judged.margin == 1.0 and judged.prediction.label == "A Mug."
    ((path, headers, asked),) = server.came
    assert path == "/" and asked["prompt"] == "Is it a mug?" and "Authorization" not in headers
    levels = np.asarray(Image.open(io.BytesIO(base64.b64decode(asked["image"]))))
    assert np.array_equal(levels, (picture * 255).round().byte().numpy())
    model(picture)
    assert len(server.came) == 1, "the same picture is not sent twice"


def test_a_chat_is_asked_with_its_name_and_the_key(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(KEY, SECRET)
    server.say = chat("It is a bowl.")
    model = advsearch.load_model(server.chat, task={"name": "answer", "tokens": 7}, prompt="What?")
    model(torch.zeros((8, 8, 3)))
    ((path, headers, asked),) = server.came
    assert path == "/v1/chat/completions" and headers["Authorization"] == f"Bearer {SECRET}"
    assert (asked["model"], asked["max_tokens"]) == ("tiny", 7)
    text, picture = asked["messages"][0]["content"]
    assert text == {"type": "text", "text": "What?"}
    assert picture["image_url"]["url"].startswith("data:image/png;base64,")
    assert SECRET not in f"{model!r}{vars(model)}{vars(model.module)}"


def ask_of(server: Server, **ask: float) -> Any:
    return advsearch.load_model(server.url, task="answer", ask=ask)(torch.zeros((8, 8, 3)))


@pytest.mark.parametrize("status", [429, 500, 503])
def test_a_busy_server_is_asked_again(server: Server, status: int) -> None:
    said: list[Reply | dict[str, Any]] = [(status, {"Retry-After": "0"}, b"busy"), (status, {}, b""), {"text": "mug"}]
    server.say = lambda asked: said.pop(0)
    assert ask_of(server) == [{"texts": ["mug"]}] and not said


@pytest.mark.parametrize(
    ("reply", "expected", "calls"),
    [
        ((500, {}, b"out of order"), "status 500 .*out of order", 5),
        ((400, {}, b"no \x1b[2J such model"), r"status 400 .*no \[2J such model", 1),
        ((307, {"Location": "http://elsewhere.invalid/"}, b""), "redirects to http://elsewhere.invalid/", 1),
        ((200, {}, b"[" * 100_000), "expected JSON", 1),
        ((200, {}, b'{"scores": {"mug": NaN}}'), "expected JSON", 1),
        ((200, {}, b'{"text": "' + b"a" * (2 << 20)), "an answer of at most 1,048,576 bytes, got a longer one", 1),
    ],
)  # fmt: skip
def test_what_cannot_be_read_ends_in_a_sentence(server: Server, reply: Reply, expected: str, calls: int | None) -> None:
    server.say = lambda asked: reply
    with pytest.raises(ModelError, match=expected) as raised:
        ask_of(server)
    assert str(raised.value).isprintable() and (calls is None or len(server.came) == calls)


def test_nobody_there_a_slow_one_and_one_that_drips(server: Server) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        nobody = f"http://127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(ModelError, match="ConnectionRefusedError"):
            advsearch.load_model(nobody, task="answer")(torch.zeros((8, 8, 3)))

    def slow(asked: dict[str, Any]) -> dict[str, Any]:
        time.sleep(0.2)
        return {"text": "mug"}

    server.say = slow
    with pytest.raises(ModelError, match="timed out"):
        ask_of(server, seconds=0.05)
    assert len(server.came) == address.MAX_TRIES


DRIPS = {
    "a header": (b"HTTP/1.1 200 OK\r\nA: ", b"a"),
    "a body": (b"HTTP/1.1 200 OK\r\n\r\n{", b" "),
    "the length of a chunk": (b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n", b"0"),
}


@contextmanager
def dripping(begun: bytes, more: bytes) -> Iterator[int]:
    """A server that says a little now and then, for 20 seconds, and no end; its port."""
    done = threading.Event()

    def drip(connection: socket.socket) -> None:
        with connection, suppress(OSError):
            connection.sendall(begun)
            for _ in range(1000):
                connection.sendall(more)
                if done.wait(0.02):
                    break

    def accept(listening: socket.socket) -> None:
        with suppress(OSError):
            while True:
                threading.Thread(target=drip, args=listening.accept()[:1], daemon=True).start()

    with socket.create_server(("127.0.0.1", 0)) as listening:
        threading.Thread(target=accept, args=(listening,), daemon=True).start()
        try:
            yield listening.getsockname()[1]
        finally:
            done.set()
            listening.shutdown(socket.SHUT_RDWR)


@pytest.mark.parametrize("case", DRIPS)
def test_an_answer_has_its_time_in_all(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever drips, the model is given up after `seconds`, and no thread goes on waiting."""
    monkeypatch.setattr(address, "MAX_TRIES", 1)
    monkeypatch.delenv(KEY, raising=False)
    with dripping(*DRIPS[case]) as port:
        model = advsearch.load_model(f"http://127.0.0.1:{port}", task="answer", ask={"seconds": 0.3})
        began = time.monotonic()
        with pytest.raises(ModelError, match="timed out"):
            model(torch.zeros((8, 8, 3)))
        assert time.monotonic() - began < 5.0
        for _ in range(100):
            waiting = [one for one in threading.enumerate() if one.name.startswith("ThreadPoolExecutor")]
            if not waiting:
                break
            time.sleep(0.05)
        assert not waiting


def test_the_key_is_in_no_message(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(KEY, SECRET)
    replies: list[Reply] = [(400, {}, f"bad key {SECRET}".encode()), (200, {}, SECRET.encode())]
    for reply in replies:
        server.say = lambda asked, reply=reply: reply  # type: ignore[misc]
        with pytest.raises(ModelError, match=r"\(key\)") as raised:
            ask_of(server)
        assert SECRET not in str(raised.value)
    monkeypatch.setenv(KEY, f"{SECRET}\r\nHost: other")
    with pytest.raises(InputError, match="printable ASCII") as refused:
        ask_of(server)
    assert SECRET not in str(refused.value)


@pytest.mark.parametrize(
    ("spec", "expected"),
    [
        ("http://host:port/", "expected an address"), ("https://user:pass@host/", "would be stored with the run"),
        ("https://host/?api_key=1", "`api_key` in the address"),
        ("http://localhost.example.org/", "would go there unencrypted"),
    ],
)  # fmt: skip
def test_addresses_that_are_refused(spec: str, expected: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(KEY, SECRET)
    with pytest.raises(InputError, match=expected):
        check_address(spec)


def test_an_address_that_only_a_file_names_is_asked_nothing(
    server: Server, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "run.yaml"
    file.write_text(f"object: mug\nmodel: {server.url}\n")
    with restrict_allowed_code():
        assert main(["run", str(file), "--quiet"]) == 2
    assert f"a file names the model {server.url}" in capsys.readouterr().err
    assert not server.came


@pytest.mark.parametrize(
    ("ask", "allowed", "expected"),
    [
        ({"calls": 3}, 3, "3 calls are spent, and `ask` allows 3; .*ask.calls=6"),
        ({"money": 0.02, "per_call": 0.01}, 2, "0.02 money"),
    ],
)
def test_a_limit_ends_it(server: Server, ask: dict[str, float], allowed: int, expected: str) -> None:
    server.say = chat("mug")
    model = advsearch.load_model(server.chat, task="answer", ask=ask)
    for number in range(allowed):
        model(torch.full((8, 8, 3), number / 10))
    with pytest.raises(ModelError, match=expected):
        model(torch.ones((8, 8, 3)))
    assert len(server.came) == allowed


GREYS = torch.linspace(0.1, 0.8, 8)[:, None, None, None].expand(8, 8, 8, 3).contiguous()


def test_no_call_too_many_goes_out_with_others(server: Server) -> None:
    server.say = scores
    model = advsearch.load_model(server.url, labels=["mug", "bowl"], ask={"calls": 6})
    with pytest.raises(ModelError, match="6 calls are spent"):
        model(GREYS)
    assert len(server.came) == 6
    with pytest.raises(ModelError, match="6 calls are spent"):
        model(GREYS)
    assert len(server.came) == 6 and model(GREYS[:6]).shape == (6, 2), "what was answered is kept"
    with pytest.raises(InputError, match="`ask` at_once"):
        advsearch.load_model(server.url, ask={"at_once": 0})


@pytest.mark.medium
@pytest.mark.parametrize("control", ["light", "texture={resolution: 4}", "light,texture={resolution: 4}"])
def test_an_attack_that_is_stopped_by_a_limit_goes_on_and_asks_nothing_twice(
    server: Server, control: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(KEY, SECRET)
    server.say = scores
    command = ["attack", *SMALL, "--control", control, "--steps", "4", "--measure", "no", "--denoise", "none"]
    command += ["--model", server.url, "--labels", "mug,bowl", "--label", "mug", "--json"]
    assert main([*command, "--run", "whole"]) == 0
    whole, asked = json.loads(capsys.readouterr().out), [one["image"] for *_, one in server.came]
    assert f"was called {len(asked)} times" in whole["warnings"][-1]
    server.came.clear()
    assert main([*command, "--run", "part", "--ask", "calls=7"]) == 2
    assert "7 calls are spent, and --ask allows 7" in capsys.readouterr().err and len(server.came) == 7
    with restrict_allowed_code():
        assert main(["resume", "part", "--quiet"]) == 2
        assert "--code" in capsys.readouterr().err
        assert main(["resume", "part", "ask.calls=99", "--code", server.url, "--quiet", "--json"]) == 0
    resumed = json.loads(capsys.readouterr().out)
    assert [one["image"] for *_, one in server.came] == asked, "in all as if it had never stopped"
    assert resumed["verified"] == whole["verified"] and resumed["warnings"][-1] == whole["warnings"][-1]
    for file in tmp_path.rglob("*"):
        assert not file.is_file() or SECRET.encode() not in file.read_bytes(), file
