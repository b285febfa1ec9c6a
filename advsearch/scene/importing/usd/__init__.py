"""OpenUSD files through glTF, which a process of its own makes of them with `usd-core`.

Readers of binary formats are written in C++, and a file may make them crash or take all
memory.
"""

from __future__ import annotations

import importlib.util
import json
import sys
import tempfile
from pathlib import Path

from advsearch.extend import errors, reading, stored_files

PACKAGE = ".usdz"
LAYERS = (".usd", ".usda", ".usdc")
USD_LONGEST = 120  # seconds that it may take, before `scaled`
MEMORY = 8 << 30  # bytes of memory that it may take, before `scaled`
USD_BEGINNINGS = (b"PXR-USDC", b"#usda", b"PK\x03\x04")
REFUSED = "refused: "
_LIMITED = f"""
import runpy, sys
try:
    import resource
    resource.setrlimit(resource.RLIMIT_AS, (int(sys.argv[1]),) * 2)
    resource.setrlimit(resource.RLIMIT_FSIZE, ({stored_files.LARGEST_FILE} * 4,) * 2)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
except ImportError:
    pass
del sys.argv[1]
runpy.run_module("advsearch.scene.importing.usd.stage", run_name="__main__", alter_sys=True)
"""


def is_installed() -> bool:
    return importlib.util.find_spec("pxr") is not None


def convert_usd(path: Path, data: bytes) -> bytes:
    """Return an OpenUSD file as binary glTF. Raises FileFormatError: it is none, names
    what lies outside its folder, is too large, or `usd-core` is missing.
    """
    if not data.startswith(USD_BEGINNINGS):
        raise reading.damaged(path, "an OpenUSD file", reading.looks_like(data))
    if not is_installed():
        raise errors.FileFormatError(
            f"{path}: an OpenUSD file needs usd-core, which is not installed: pip "
            "install 'advsearch[usd]'; or export "
            "glTF (.glb) where it is from"
        )
    with tempfile.TemporaryDirectory(prefix="advsearch-usd-") as folder:
        target = Path(folder) / "scene.glb"
        inside = Path(folder) / "package"
        inside.mkdir()
        names = [
            str(stored_files.scaled(MEMORY)),
            str(path.resolve()),
            str(target),
            str(inside),
        ]
        program = [sys.executable, "-W", "ignore", "-c", _LIMITED, *names]
        done = reading.run_converter(
            path,
            "usd-core",
            program,
            folder=reading.OWN_FOLDER,
            seconds=USD_LONGEST,
            env=None,
        )
        if done.returncode or not target.is_file():
            lines = [line for line in done.stderr.splitlines() if line.strip()] or [
                "without a word"
            ]
            last = lines[-1]
            if last.startswith(REFUSED):
                text = last.removeprefix(REFUSED)
                raise errors.FileFormatError(
                    f"{path.parent / text}"
                    if text.startswith(path.name)
                    else f"{path}: {text}"
                )
            crashed = (
                f"signal {-done.returncode}"
                if done.returncode < 0
                else reading.shown(last.strip(), quoted=False)
            )
            raise errors.FileFormatError(
                f"{path}: usd-core could not read it "
                f"({crashed}); export or download it again"
            )
        for name in json.loads(done.stdout.splitlines()[-1]):
            stored_files.note_opened(name)
        return stored_files.read_bytes(
            target, "a glTF file", 4 * stored_files.LARGEST_FILE
        )
