"""Blender and OpenUSD files through glTF.

A Blender file is written as glTF by Blender in a process of its own: an installed one, or the `bpy` package. Nothing in
the file is run: Blender starts with factory settings and a home that is empty, and scripts and drivers are
off when the file is opened. What glTF cannot hold (node materials, simulations, curves' bevels) Blender's exporter
leaves out or applies.
"""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import sys
import tempfile
from pathlib import Path

from advsearch.errors import FileFormatError
from advsearch.scene.importing.files import damaged, looks_like, read_bytes, shown
from advsearch.trust import stored_files
from advsearch.trust.code import OWN_FOLDER
from advsearch.trust.programs import run_converter, surroundings
from advsearch.trust.stored_files import LARGEST_FILE, scaled

# ---------------------------------------------------------------------------------------------------------------------
# OpenUSD files through glTF, which a process of its own makes of them with `usd-core`: readers of binary formats are
# written in C++, and a file may make them crash or take all memory.

PACKAGE = ".usdz"
LAYERS = (".usd", ".usda", ".usdc")
USD = (*LAYERS, PACKAGE)  # endings of OpenUSD files
GENERATOR = "advsearch, of OpenUSD"  # what the glTF is made by; what it leaves out is in the extras of its asset
USD_LONGEST = 120  # seconds that it may take, before `scaled`
MEMORY = 8 << 30  # bytes of memory that it may take, before `scaled`
USD_BEGINNINGS = (b"PXR-USDC", b"#usda", b"PK\x03\x04")
REFUSED = "refused: "
_LIMITED = f"""
import runpy, sys
try:
    import resource
    resource.setrlimit(resource.RLIMIT_AS, (int(sys.argv[1]),) * 2)
    resource.setrlimit(resource.RLIMIT_FSIZE, ({LARGEST_FILE} * 4,) * 2)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
except ImportError:
    pass
del sys.argv[1]
runpy.run_module("advsearch.scene.importing.usd_stage", run_name="__main__", alter_sys=True)
"""


def is_installed() -> bool:
    return importlib.util.find_spec("pxr") is not None


def converted(path: Path, data: bytes) -> bytes:
    """Return an OpenUSD file as binary glTF. Raises FileFormatError: it is none, names what lies outside its folder, is
    too large, or `usd-core` is missing."""
    if not data.startswith(USD_BEGINNINGS):
        raise damaged(path, "an OpenUSD file", looks_like(data))
    if not is_installed():
        raise FileFormatError(
            f"{path}: an OpenUSD file needs usd-core, which is not installed: pip install 'advsearch[usd]'; or export "
            "glTF (.glb) where it is from"
        )
    with tempfile.TemporaryDirectory(prefix="advsearch-usd-") as folder:
        target, inside = Path(folder) / "scene.glb", Path(folder) / "package"
        inside.mkdir()
        names = [str(scaled(MEMORY)), str(path.resolve()), str(target), str(inside)]
        program = [sys.executable, "-W", "ignore", "-c", _LIMITED, *names]
        done = run_converter(path, "usd-core", program, folder=OWN_FOLDER, seconds=USD_LONGEST, env=None)
        if done.returncode or not target.is_file():
            lines = [line for line in done.stderr.splitlines() if line.strip()] or ["without a word"]
            last = lines[-1]
            if last.startswith(REFUSED):
                text = last.removeprefix(REFUSED)
                raise FileFormatError(f"{path.parent / text}" if text.startswith(path.name) else f"{path}: {text}")
            crashed = f"signal {-done.returncode}" if done.returncode < 0 else shown(last.strip(), quoted=False)
            raise FileFormatError(f"{path}: usd-core could not read it ({crashed}); export or download it again")
        for name in json.loads(done.stdout.splitlines()[-1]):
            stored_files.note_opened(name)
        return stored_files.read_bytes(target, "a glTF file", 4 * LARGEST_FILE)


BLEND = ".blend"
PROGRAM = "ADVSEARCH_BLENDER"
"""Variable of the environment: a Blender, or a Python that has `bpy`, in the place of those that are looked for."""
LONGEST = 120  # seconds that Blender may take, before `scaled`
BEGINNINGS = (b"BLENDER", b"\x28\xb5\x2f\xfd", b"\x1f\x8b")
"""How a .blend file begins: as it is, compressed with zstd, or with gzip (before Blender 3.0)."""
EXPORT = """
import sys
source, target, most = sys.argv[-3:]
try:
    import resource
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(most), int(most)))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
except ImportError:
    pass
import bpy
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.context.preferences.filepaths.use_scripts_auto_execute = False
bpy.ops.wm.open_mainfile(filepath=source, load_ui=False, use_scripts=False)
bpy.ops.export_scene.gltf(
    filepath=target, export_format="GLB", export_apply=True, export_cameras=True, export_lights=True,
    export_animations=False,
)
"""


def read_mesh_bytes(path: Path, what: str, suffixes: tuple[str, ...]) -> bytes:
    """Return the content of a mesh or scene file, of a Blender or OpenUSD file as binary glTF; see `read_bytes`. Raises
    FileFormatError: as for `read_bytes`; there is no Blender, it can't read the file, or it takes too long."""
    data = read_bytes(path, what, suffixes)
    if path.suffix.lower() in USD:
        return converted(path, data)
    if path.suffix.lower() != BLEND:
        return data
    if not data.startswith(BEGINNINGS):
        raise damaged(path, "a Blender scene", looks_like(data))
    program = command(f"{path}: Blender has to read it", "export glTF (.glb) from Blender and name that")
    with tempfile.TemporaryDirectory(prefix="advsearch-blender-") as folder:
        script, target = Path(folder) / "export.py", Path(folder) / "scene.glb"
        script.write_text(EXPORT, "utf-8")
        names = [str(path.resolve()), str(target), str(scaled(LARGEST_FILE))]
        started = [*program, str(script), *([] if "-I" in program else ["--"]), *names]
        try:
            done = run_converter(path, "Blender", started, folder=folder, seconds=LONGEST, env=surroundings(folder))
        except OSError as error:
            raise FileFormatError(f"{path}: Blender can't be started ({error.strerror}); check {program[0]}") from error
        if done.returncode or not target.is_file():
            last = last_line(done.stdout + done.stderr)
            raise FileFormatError(f"{path}: Blender could not read it{last}; export glTF (.glb) from it yourself")
        return read_bytes(target, "object", (".glb",))


def command(who: str, otherwise: str) -> list[str]:
    """Return the program that is given a script behind it, with what makes it run that and nothing else. Raises
    FileFormatError, for which it is told who needs it, and what else can be done: there is none."""
    program = os.environ.get(PROGRAM) or shutil.which("blender")
    if program is None and importlib.util.find_spec("bpy") is not None:
        program = sys.executable
    runs = shutil.which(program or "")
    if runs is None:
        missing = "none is installed" if program is None else f"{PROGRAM} names {program}, which can't be run"
        raise FileFormatError(
            f"{who}, and {missing}; install Blender so that `blender` is found, or type "
            f"`python3.11 -m venv bpy && bpy/bin/pip install bpy` and set {PROGRAM}=bpy/bin/python; or {otherwise}"
        )
    program = os.path.abspath(runs)
    if Path(program).name.startswith("python"):
        return [program, "-I"]
    return [program, "--background", "--factory-startup", "--disable-autoexec", "--python-exit-code", "1", "--python"]


def last_line(said: str) -> str:
    """Return the last line of what Blender has said, for a message; empty if there is none."""
    lines = [line for line in said.splitlines() if line.strip()]
    return f": {shown(lines[-1].strip(), quoted=False)}" if lines else ""
