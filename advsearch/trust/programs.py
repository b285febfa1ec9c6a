"""Run other programs: in a separate folder, with a time limit and without input.

The threat: a file makes a program hang or wait for input, or the program uses settings
and modules of the user.

Used for OpenUSD (`scene/importing/usd`) and Blender (`scene/importing/blender.py`).
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from advsearch.errors import FileFormatError
from advsearch.trust.stored_files import FACTOR, scale_limit


def run_converter(
    path: Path,
    program: str,
    command: Sequence[str],
    *,
    folder: str | Path,
    seconds: int,
    env: Mapping[str, str] | None,
) -> subprocess.CompletedProcess[str]:
    """Run a program that converts a file to glTF, and return what it printed.

    Args:
        path: path of the file, for errors.
        program: name of the program, for errors.
        command: the program with its arguments.
        folder: folder in which it runs.
        seconds: time limit, which the user may multiply by `ADVSEARCH_LIMITS`.
        env: environment of the program; None for that of this process.

    Raises:
        OSError: the program cannot be started.
        FileFormatError: the program takes too long.
    """
    longest = scale_limit(seconds)
    try:
        return subprocess.run(
            command,
            cwd=folder,
            env=env,
            stdin=subprocess.DEVNULL,  # a program that waits for input gets none
            capture_output=True,
            errors="replace",
            timeout=longest,
        )
    except subprocess.TimeoutExpired:
        raise _make_converter_timeout_error(path, program, longest) from None


def _make_converter_timeout_error(
    path: Path, program: str, seconds: int
) -> FileFormatError:
    """Return the error for a program that takes too long to read a file.

    Args:
        path: path of the file.
        program: name of the program.
        seconds: the time limit.
    """
    return FileFormatError(
        f"{path}: {program} had not read it after {seconds} seconds; export glTF "
        f"(.glb) from it yourself, or give it longer: {FACTOR}=10 in the environment "
        "makes all limits ten times as large"
    )


def make_environment(folder: str) -> dict[str, str]:
    """Return the environment variables of a process whose home directory is `folder`.

    Of the variables of this process, only those with search paths are passed on.
    """
    variables = {
        name: os.environ[name]
        for name in ("PATH", "LD_LIBRARY_PATH")
        if name in os.environ
    }
    return {**variables, "HOME": folder, "TMPDIR": folder}


BLENDER = "ADVSEARCH_BLENDER"
"""Environment variable with the program Blender, or a Python that has the package
`bpy`. Without it, both are searched.
"""


def find_blender(who: str, otherwise: str) -> list[str]:
    """Return the command that runs a script in Blender.

    The caller appends the path of the script. Blender may be a program, or a Python
    with the package `bpy`.

    Args:
        who: beginning of the error's message, which states what needs Blender.
        otherwise: end of the message, which states what else the user can do.

    Raises:
        FileFormatError: there is no Blender.
    """
    program = _find_blender_program()
    executable = shutil.which(program or "")
    if executable is None:
        raise _make_blender_error(program, who, otherwise)
    program = os.path.abspath(executable)
    is_python = Path(program).name.startswith("python")  # one with the package bpy
    if is_python:
        return [program, "-I"]  # isolated from modules of the user
    # Without a window, without settings of the user, and without scripts in the file.
    # If the script fails, the exit status is 1.
    return [
        program,
        *("--background", "--factory-startup", "--disable-autoexec"),
        *("--python-exit-code", "1", "--python"),
    ]


def _find_blender_program() -> str | None:
    """Return the name or path of Blender, or of a Python with the package `bpy`; None
    if there is neither.
    """
    program = os.environ.get(BLENDER) or shutil.which("blender")
    if program is None and importlib.util.find_spec("bpy") is not None:
        return sys.executable  # this Python has Blender as a package
    return program


def _make_blender_error(
    program: str | None, who: str, otherwise: str
) -> FileFormatError:
    """Return the error for a Blender that is missing or cannot be run.

    Args:
        program: the program that is no executable; None if none is installed.
        who: beginning of the message, which states what needs Blender.
        otherwise: end of the message, which states what else the user can do.
    """
    missing = "none is installed"
    if program is not None:
        missing = f"{BLENDER} names {program}, which can't be run"
    return FileFormatError(
        f"{who}, and {missing}; install Blender so that `blender` is found, or "
        "type `python3.11 -m venv bpy && bpy/bin/pip install bpy` and set "
        f"{BLENDER}=bpy/bin/python; or {otherwise}"
    )
