"""Blender files through glTF.

A Blender file is written as glTF by Blender in a process of its own: an installed one,
or the `bpy` package. Nothing in the file is run: Blender starts with factory settings
and a home that is empty, and scripts and drivers are off when the file is opened. What
glTF cannot hold (node materials, simulations, curves' bevels) Blender's exporter leaves
out or applies.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from advsearch.extend import errors, reading, stored_files

LONGEST = 120  # seconds that Blender may take, before `scaled`
BEGINNINGS = (b"BLENDER", b"\x28\xb5\x2f\xfd", b"\x1f\x8b")
"""How a .blend file begins: as it is, compressed with zstd, or with gzip (before
Blender 3.0).
"""
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


def convert_blend(path: Path, data: bytes) -> bytes:
    """Return a Blender file as binary glTF. Raises FileFormatError: it is none, there
    is no Blender, it can't read the file, or it takes too long.
    """
    if not data.startswith(BEGINNINGS):
        raise reading.damaged(path, "a Blender scene", reading.looks_like(data))
    program = reading.find_blender(
        f"{path}: Blender has to read it",
        "export glTF (.glb) from Blender and name that",
    )
    with tempfile.TemporaryDirectory(prefix="advsearch-blender-") as folder:
        script = Path(folder) / "export.py"
        target = Path(folder) / "scene.glb"
        script.write_text(EXPORT, "utf-8")
        names = [
            str(path.resolve()),
            str(target),
            str(stored_files.scaled(stored_files.LARGEST_FILE)),
        ]
        started = [*program, str(script), *([] if "-I" in program else ["--"]), *names]
        try:
            done = reading.run_converter(
                path,
                "Blender",
                started,
                folder=folder,
                seconds=LONGEST,
                env=reading.surroundings(folder),
            )
        except OSError as error:
            raise errors.FileFormatError(
                f"{path}: Blender can't be started ({error.strerror}); check "
                f"{program[0]}"
            ) from error
        if done.returncode or not target.is_file():
            last = reading.last_line(done.stdout + done.stderr)
            raise errors.FileFormatError(
                f"{path}: Blender could not read it{last}; export glTF (.glb) from it "
                "yourself"
            )
        return reading.read_bytes(target, "object", (".glb",))
