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

from samples import make_run

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
def test_a_terminal_without_graphics_says_where_they_are(run: Path) -> None:
    written = in_terminal(run, {b"\x1b[c": b"\x1b[?62;22c"})
    assert SIXEL not in written and b"clean.png" in written and b"neither kitty's protocol nor Sixel" in written
