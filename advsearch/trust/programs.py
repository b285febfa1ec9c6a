"""Other programs that read files of others: each in a folder of its own, for a limited time, with nothing to ask.

The threat: a file makes a program hang, wait for somebody to type, or find settings and modules of the user's.

Used for OpenUSD (`scene/importing/usd.py`) and Blender (`scene/importing/blender.py`).
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path

from advsearch.errors import FileFormatError
from advsearch.trust.stored_files import FACTOR, scaled


def run_converter(
    path: Path, program: str, command: Sequence[str], *, folder: str | Path, seconds: int, env: Mapping[str, str] | None
) -> subprocess.CompletedProcess[str]:
    """Run a program that makes glTF of the file at `path`, in a folder, and return what it said. Raises OSError: it
    can't be started; FileFormatError: it takes longer than so many seconds, before `scaled`."""
    longest, unread = scaled(seconds), subprocess.DEVNULL
    try:
        return subprocess.run(
            command, cwd=folder, env=env, stdin=unread, capture_output=True, errors="replace", timeout=longest
        )
    except subprocess.TimeoutExpired:
        raise FileFormatError(
            f"{path}: {program} had not read it after {longest} seconds; export glTF (.glb) from it yourself, or give "
            f"it longer: {FACTOR}=10 in the environment makes all limits ten times as large"
        ) from None


def surroundings(folder: str) -> dict[str, str]:
    """Return the environment of a process that has a folder for its home, and nothing of ours but the path."""
    kept = {name: os.environ[name] for name in ("PATH", "LD_LIBRARY_PATH") if name in os.environ}
    return {**kept, "HOME": folder, "TMPDIR": folder}
