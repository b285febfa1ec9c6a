"""`advsearch show RUN --picture`: drawn in a terminal that can, elsewhere named."""

from __future__ import annotations

import fcntl
import os
import pty
import select
import struct
import subprocess
import sys
import termios
import time
from pathlib import Path

import pytest

from advsearch.cli.main import main
from advsearch.cli.show import find_best_images
from samples import make_run
from stored_sweeps import make_sweep

SIXEL, KITTY = b"\x1bP", b"\x1b_G"


def in_terminal(run: Path, answers: dict[bytes, bytes], size: tuple[int, int] = (40, 100)) -> bytes:
    """What the command writes to a terminal of so many lines and columns that answers questions so."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", *size, 0, 0))
    command = [sys.executable, "-m", "advsearch", "show", str(run), "--picture"]
    process = subprocess.Popen(
        command, stdin=theirs, stdout=theirs, stderr=theirs, env={**os.environ, "TERM": "xterm-256color"}
    )
    os.close(theirs)
    written, answered, end = b"", 0, time.monotonic() + 600
    while time.monotonic() < end:
        if not select.select([ours], [], [], 0.2)[0]:
            continue
        try:
            part = os.read(ours, 65536)
        except OSError:  # the other end was closed
            break
        written += part
        for question, answer in answers.items():
            if question in written[answered:]:
                answered = written.index(question, answered) + len(question)
                os.write(ours, answer)
    os.close(ours)
    assert process.wait(timeout=600) == 0
    return written


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("runs") / "attack", rows=False)


@pytest.mark.medium
def test_a_terminal_with_sixel_draws(run: Path) -> None:
    written = in_terminal(run, {b"\x1b[c": b"\x1b[?62;4c", b"\x1b[16t": b"\x1b[6;20;10t"})
    assert written.count(SIXEL) == 2 and b"adversarial.png" in written


@pytest.mark.medium
def test_a_terminal_with_kittys_protocol_draws(run: Path) -> None:
    answers = {b"\x1b[c": b"\x1b[?62;22c", b"\x1b_G": b"\x1b_Gi=1;OK\x1b\\", b"\x1b[16t": b"\x1b[6;20;10t"}
    assert in_terminal(run, answers).count(KITTY) > 2


@pytest.mark.medium
def test_a_terminal_without_a_size_is_no_error(run: Path) -> None:
    written = in_terminal(run, {b"\x1b[c": b"\x1b[?62;4c"}, (0, 0))
    assert b"could not be drawn" in written and b"adversarial.png" in written


@pytest.mark.medium
def test_a_terminal_without_graphics_says_where_they_are(run: Path) -> None:
    written = in_terminal(run, {b"\x1b[c": b"\x1b[?62;22c"})
    assert SIXEL not in written and b"clean.png" in written and b"neither kitty's protocol nor Sixel" in written


def test_elsewhere_the_path_is_said(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["show", str(run), "--picture"]) == 0
    assert f"picture   {run / 'images' / 'adversarial.png'}" in capsys.readouterr().out
    bare = make_run(tmp_path / "bare", pictures=False, rows=False)
    assert main(["show", str(bare), "--picture"]) == 0
    assert "has no pictures" in capsys.readouterr().out
    assert main(["show", str(run), "--picture", "--json"]) == 2
    assert "--picture" in capsys.readouterr().err


def test_without_the_package_it_is_named(
    run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "textual_image", None)
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    assert main(["show", str(run), "--picture"]) == 0
    out = capsys.readouterr().out
    assert "pip install 'advsearch[terminal]'" in out and "clean.png" in out


def test_of_another_run_the_first_picture_is_shown(run: Path, tmp_path: Path) -> None:
    assert [one.name for one in find_best_images(run)] == ["clean.png", "adversarial.png"]
    swept = make_sweep(tmp_path / "swept")
    (swept / "images").mkdir(exist_ok=True)
    (swept / "images" / "sweep.png").write_bytes(b"")
    assert [one.name for one in find_best_images(swept)] == ["sweep.png"]
    (swept / "images" / "sweep.png").unlink()
    assert find_best_images(swept) == []
