"""Converter of OpenUSD files to glTF, with `usd-core` in a separate process.

The process is separate because the readers of binary formats in `usd-core` are written
in C++: a corrupt file may make them crash or use all memory.
"""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
import tempfile
from pathlib import Path

from advsearch.extend import errors, reading, stored_files

PACKAGE_SUFFIX = ".usdz"
LAYER_SUFFIXES = (".usd", ".usda", ".usdc")
USD_TIMEOUT_S = 120  # timeout in seconds, before `scale_limit`
MAX_MEMORY = 8 << 30  # limit of the process's memory in bytes, before `scale_limit`
# Limit of the bytes of the glTF file, in which textures may be written anew.
MAX_RESULT_SIZE = 4 * stored_files.LARGEST_FILE
USD_MAGIC_BYTES = (b"PXR-USDC", b"#usda", b"PK\x03\x04")
REJECTED_PREFIX = "refused: "
_LIMITED_SCRIPT = f"""
import runpy, sys
try:
    import resource
    resource.setrlimit(resource.RLIMIT_AS, (int(sys.argv[1]),) * 2)
    resource.setrlimit(resource.RLIMIT_FSIZE, ({MAX_RESULT_SIZE},) * 2)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
except ImportError:
    pass
del sys.argv[1]
runpy.run_module("advsearch.scene.importing.usd.stage", run_name="__main__", alter_sys=True)
"""


def is_installed() -> bool:
    """Return whether usd-core is installed."""
    return importlib.util.find_spec("pxr") is not None


def convert_usd(path: Path, data: bytes) -> bytes:
    """Convert an OpenUSD file to binary glTF.

    A separate process reads the file, with limits on its time and memory. It prints the
    files that it has read, which are recorded as opened.

    Args:
        path: the file, which that process reads itself.
        data: its bytes, of which only the first are checked.

    Raises:
        FileFormatError: it is no OpenUSD file, names files outside its folder, is too
            large, or `usd-core` is not installed.
    """
    _check_convertible(path, data)
    with tempfile.TemporaryDirectory(prefix="advsearch-usd-") as folder:
        target = Path(folder) / "scene.glb"
        process = _run_conversion(path, target)
        if process.returncode or not target.is_file():
            raise _make_conversion_error(path, process.stderr, process.returncode)
        _record_files_read(process.stdout)
        return stored_files.read_bytes(target, "a glTF file", MAX_RESULT_SIZE)


def _check_convertible(path: Path, data: bytes) -> None:
    """Raise FileFormatError for a file of another kind, or if usd-core is missing."""
    if not data.startswith(USD_MAGIC_BYTES):
        raise reading.damaged(path, "an OpenUSD file", reading.describe_content(data))
    if not is_installed():
        raise errors.FileFormatError(
            f"{path}: an OpenUSD file needs usd-core, which is not installed: pip "
            "install 'advsearch[usd]'; or export glTF (.glb) from the program that "
            "made it"
        )


def _record_files_read(stdout: str) -> None:
    """Record the files in the output of a conversion as opened."""
    # The last line is the list of files; usd-core may print lines before it.
    files_read = json.loads(stdout.splitlines()[-1])
    for name in files_read:
        stored_files.record_opened(name)


def _run_conversion(path: Path, target: Path) -> subprocess.CompletedProcess[str]:
    """Convert a file in a separate process, with a limit on its memory.

    `target` is the path of the result. Packages are unpacked in the same folder.
    """
    package_folder = target.with_name("package")
    package_folder.mkdir()
    arguments = [
        str(stored_files.scale_limit(MAX_MEMORY)),
        str(path.resolve()),
        str(target),
        str(package_folder),
    ]
    return reading.run_converter(
        path,
        "usd-core",
        [sys.executable, "-W", "ignore", "-c", _LIMITED_SCRIPT, *arguments],
        folder=reading.SUBPROCESS_DIRECTORY,
        seconds=USD_TIMEOUT_S,
        env=None,
    )


def _make_conversion_error(
    path: Path, stderr: str, returncode: int
) -> errors.FileFormatError:
    """Return the error of a conversion that failed, by the last line of its output."""
    lines = [line for line in stderr.splitlines() if line.strip()]
    last_line = lines[-1] if lines else "no message"
    if last_line.startswith(REJECTED_PREFIX):
        message = last_line.removeprefix(REJECTED_PREFIX)
        if message.startswith(path.name):
            # The message begins with the file's name, to which its folder is added.
            return errors.FileFormatError(f"{path.parent / message}")
        return errors.FileFormatError(f"{path}: {message}")
    reason = f"signal {-returncode}"
    if returncode >= 0:
        reason = reading.format_name(last_line.strip(), quoted=False)
    return errors.FileFormatError(
        f"{path}: usd-core could not read it ({reason}); export or download it again"
    )
