"""Converter of Blender files to glTF.

Blender itself exports the file in a separate process: an installed one, or the `bpy`
package. Nothing in the file is executed: Blender starts with factory settings and an
empty home directory, and scripts and drivers are disabled. Its exporter leaves out or
applies what glTF cannot represent (node materials, simulations, bevels of curves).
"""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

from advsearch.extend import errors, reading, stored_files

LONGEST = 120  # timeout of Blender in seconds, before `scale_limit`
MAGIC_BYTES = (b"BLENDER", b"\x28\xb5\x2f\xfd", b"\x1f\x8b")
"""First bytes of a .blend file: uncompressed, zstd, or gzip (before Blender 3.0)."""
EXPORT_SCRIPT = """
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
    filepath=target, export_format="GLB", export_apply=True, export_cameras=True,
    export_lights=True, export_animations=False,
)
"""


def convert_blend(path: Path, data: bytes) -> bytes:
    """Convert a Blender file to binary glTF.

    Args:
        path: the file, which Blender reads itself.
        data: its bytes, of which only the first are checked.

    Raises:
        FileFormatError: it is no Blender file, Blender is not installed, cannot read
            it, or takes too long.
    """
    if not data.startswith(MAGIC_BYTES):
        raise reading.damaged(path, "a Blender scene", reading.describe_content(data))
    program = reading.find_blender(
        who=f"{path}: Blender has to read it",
        otherwise="export glTF (.glb) from Blender and name that",
    )
    with tempfile.TemporaryDirectory(prefix="advsearch-blender-") as folder:
        target = Path(folder) / "scene.glb"
        process = _run_blender(program, path, target)
        _check_conversion(path, target, process)
        return reading.read_bytes(target, "object", (".glb",))


def _check_conversion(
    path: Path, target: Path, process: subprocess.CompletedProcess[str]
) -> None:
    """Raise FileFormatError if Blender failed, or did not write the target file.

    `path` is the .blend file, for the message.
    """
    if process.returncode or not target.is_file():
        # It begins with a colon, or is "" if Blender printed nothing.
        reason = reading.get_last_line(process.stdout + process.stderr)
        raise errors.FileFormatError(
            f"{path}: Blender could not read it{reason}; export glTF (.glb) from "
            "Blender yourself"
        )


def _run_blender(
    program: Sequence[str], path: Path, target: Path
) -> subprocess.CompletedProcess[str]:
    """Run Blender to convert a file, in the folder of the result.

    Args:
        program: Blender, with the arguments that it always has.
        path: the file.
        target: path of the result. Blender does not write it if it cannot read the
            file.

    Raises:
        FileFormatError: Blender cannot be started, or takes too long.
    """
    command = _make_conversion_command(program, path, target)
    folder = str(target.parent)
    try:
        return reading.run_converter(
            path,
            "Blender",
            command,
            folder=folder,
            seconds=LONGEST,
            env=reading.make_environment(folder),
        )
    except OSError as error:
        raise errors.FileFormatError(
            f"{path}: Blender can't be started ({error.strerror}); check {program[0]}"
        ) from error


def _make_conversion_command(
    program: Sequence[str], path: Path, target: Path
) -> list[str]:
    """Return the command that converts a file, and write the script that it runs.

    The script is written to the folder of `target`.
    """
    script = target.with_name("export.py")
    script.write_text(EXPORT_SCRIPT, "utf-8")
    arguments = [
        str(path.resolve()),
        str(target),
        str(stored_files.scale_limit(stored_files.LARGEST_FILE)),
    ]
    # The bpy package runs in Python (-I), which needs no separator.
    separator = [] if "-I" in program else ["--"]
    return [*program, str(script), *separator, *arguments]
