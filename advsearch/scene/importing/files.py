"""Checks of files before they are parsed, and notes and errors about them."""

from __future__ import annotations

import difflib
import json
import re
import shlex
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
import numpy.typing as npt

from advsearch.errors import FileFormatError
from advsearch.files import join_alternatives
from advsearch.trust import stored_files
from advsearch.trust.stored_files import LARGEST_FILE, check_most

# ---- Formats of objects and cameras that are not read, and how to convert them ----

BLENDER_IMPORTERS = {
    "an FBX model": ("bpy.ops.import_scene.fbx", (".fbx",)),
    "an Alembic scene": ("bpy.ops.wm.alembic_import", (".abc",)),
}
SPLATS_ADVICE = (
    "they have no surface; train a model that yields a mesh (2D Gaussian Splatting's "
    "render.py writes fuse_post.ply), and name that mesh"
)
POINT_CLOUD_ADVICE = (
    "it has no surface; make one (in Python "
    "open3d.geometry.TriangleMesh.create_from_point_cloud_poisson), and name its .ply"
)
UNPACK_ADVICE = "unpack it, and name the mesh in it"
EXPORT_ADVICE = "open it in that program and export glTF (.glb)"
ASSIMP_ADVICE = (
    "make an .obj of it, with assimp (Open Asset Import Library): assimp export "
    "{file} {obj}"
)
FORMAT_ADVICE = {
    "a COLLADA model": (ASSIMP_ADVICE, (".dae", ".zae")),
    "a 3MF model": (ASSIMP_ADVICE, (".3mf",)),
    "a 3D Studio model": (ASSIMP_ADVICE, (".3ds",)),
    "an OFF mesh": (ASSIMP_ADVICE, (".off",)),
    "an X3D or VRML scene": (ASSIMP_ADVICE, (".x3d", ".wrl")),
    "a LightWave model": (ASSIMP_ADVICE, (".lwo",)),
    "a CAD model without triangles": (
        "mesh it, with Gmsh: gmsh {file} -2 -o {stl}",
        (".step", ".stp", ".iges", ".igs", ".brep"),
    ),
    "a building (IFC)": ("make glTF of it: IfcConvert {file} {glb}", (".ifc",)),
    "a tile of 3D Tiles": (
        "take its glTF out: npx 3d-tiles-tools b3dmToGlb -i {file} -o {glb}",
        (".b3dm",),
    ),
    "Gaussian splats": (
        SPLATS_ADVICE,
        (".splat", ".ksplat", ".spz", ".sog"),
    ),
    "a cloud of points": (
        POINT_CLOUD_ADVICE,
        (".las", ".laz", ".pcd", ".e57", ".xyz", ".pts"),
    ),
    "an archive": (
        UNPACK_ADVICE,
        (".zip", ".gz", ".7z", ".rar", ".tar", ".tgz", ".gltfz"),
    ),
    "a file of Maya's": (EXPORT_ADVICE, (".ma", ".mb")),
    "a file of 3ds Max's": (EXPORT_ADVICE, (".max",)),
    "a file of Cinema 4D's": (EXPORT_ADVICE, (".c4d",)),
    "a file of SketchUp's": (EXPORT_ADVICE, (".skp",)),
    "NumPy's arrays": (
        "write the mesh, as in trimesh.Trimesh(vertices, faces).export('mesh.ply')",
        (".npz", ".npy"),
    ),
    "a picture": (
        "an object is a mesh; `environment` takes .hdr and .exr",
        (".png", ".jpg", ".jpeg", ".webp", ".hdr", ".exr"),
    ),
}
CAMERA_FORMAT_ADVICE = {
    ".bin": "COLMAP's binary cameras: write them as text, colmap model_converter "
    "--input_path FOLDER --output_path "
    "FOLDER --output_type TXT, and give cameras.txt",
    ".npz": "NumPy's arrays: write them as JSON, with image_width, image_height, "
    "camera_matrix and "
    "distortion_coefficients (numpy.ndarray.tolist)",
}
CAMERA_FORMAT_ADVICE |= {
    ".npy": CAMERA_FORMAT_ADVICE[".npz"],
    ".pkl": CAMERA_FORMAT_ADVICE[".npz"].replace(
        "NumPy's arrays", "a pickle, which may run code"
    ),
}
"""Advice on formats of cameras that are not read."""


def find_advice(path: Path) -> str | None:
    """Return what a file is by its suffix and how to convert it; None if unknown.

    It completes a sentence: ``"an FBX model: make glTF of it, with Blender: blender -b
    ..."``.
    """
    suffix = path.suffix.lower()
    for kind, (operator, blender_suffixes) in BLENDER_IMPORTERS.items():
        if suffix in blender_suffixes:
            return f"{kind}: {_make_blender_advice(path, operator)}"
    if suffix == ".bin":
        return _make_buffer_advice(path)
    return _fill_format_advice(path)


def _fill_format_advice(path: Path) -> str | None:
    """Return the advice of `FORMAT_ADVICE` on a file, with its names; None if unknown."""
    # values for the braces in `FORMAT_ADVICE`: the file, and names of converted files
    names = {"file": shlex.quote(path.name)} | {
        name: shlex.quote(f"{path.stem}.{name}") for name in ("obj", "stl", "glb")
    }
    suffix = path.suffix.lower()
    for kind, (instructions, suffixes) in FORMAT_ADVICE.items():
        if suffix in suffixes:
            return f"{kind}: {instructions.format(**names)}"
    return None


def _make_buffer_advice(path: Path) -> str:
    """Return advice on a buffer of glTF: the user should name its .gltf file instead."""
    example = ""
    if path.parent.is_dir():
        names = sorted(other.name for other in path.parent.glob("*.gltf"))
        if names:
            example = f", {names[0]}"
    return f"a buffer, as a .gltf file has beside it: name that file{example}"


def _make_blender_advice(path: Path, operator: str) -> str:
    """Return the command by which Blender converts a file to glTF.

    Args:
        path: the file.
        operator: Blender's importer, such as "bpy.ops.import_scene.fbx".
    """
    target = json.dumps(f"{path.stem}.glb")
    script = (
        "import bpy; bpy.ops.wm.read_factory_settings(use_empty=True); "
        f"{operator}(filepath={json.dumps(path.name)}); "
        f"bpy.ops.export_scene.gltf(filepath={target})"
    )
    return (
        f"make glTF of it, with Blender: blender -b --python-expr {shlex.quote(script)}"
    )


_MAX_NAME_LENGTH = 100
_MAGIC_BYTES = (
    (b"\x89PNG", "a PNG picture"),
    (b"\xff\xd8\xff", "a JPEG picture"),
    (b"GIF8", "a GIF picture"),
    (b"#?R", "a Radiance picture (.hdr)"),
    (b"\x76\x2f\x31\x01", "an OpenEXR picture (.exr)"),
    (b"glTF", "a binary glTF model (.glb)"),
    (b"ply\n", "a PLY mesh (.ply)"),
    (b"ply\r", "a PLY mesh (.ply)"),
    (b"Kaydara FBX", "an FBX model"),
    (b"PXR-USDC", "a USD scene"),
    (b"#usda", "a USD scene"),
    (b"# Blender", "a Wavefront OBJ file (.obj)"),
    (b"<?xml", "XML"),
    (b"\x93NUMPY", "NumPy's arrays"),
    (b"ISO-10303-21", "a CAD model (STEP)"),
    (b"BLENDER", "a Blender scene"),
    (b"PK\x03\x04", "a ZIP archive"),
    (b"\x1f\x8b", "a gzip archive"),
    (b"%PDF", "a PDF document"),
    (b"<!DOCTYPE", "a web page"),
    (b"<html", "a web page"),
    (b"version https://git-lfs", "a Git LFS pointer instead of the file itself"),
)


def read_bytes(path: Path, what: str, suffixes: Sequence[str]) -> bytes:
    """Return the content of a file.

    Args:
        path: the file.
        what: expected content, for messages: a word that follows "an", such as "object"
            or "environment".
        suffixes: suffixes that it may have, in lower case with the dot.

    Raises:
        FileFormatError: the file has another suffix, or is missing, not an ordinary
            file, unreadable, empty or larger than `LARGEST_FILE`.
    """
    data = _read_supported_file(path, what, suffixes)
    if not data:
        raise FileFormatError(
            f"{path}: the {what} file is empty; export or download it again"
        )
    return data


def _read_supported_file(path: Path, what: str, suffixes: Sequence[str]) -> bytes:
    """Return the content of a file, which may be empty; see `read_bytes`."""
    try:
        _check_suffix(path, what, suffixes)
        data = stored_files.read_bytes(path, f"an {what} file", LARGEST_FILE)
    except FileNotFoundError as error:
        hint = _make_missing_file_hint(path, suffixes)
        message = f"{path}: no such {what} file.{hint} Check the path"
        raise FileFormatError(message) from error
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise FileFormatError(
            f"{path}: the {what} file cannot be read ({reason}); check its permissions"
        ) from error
    return data


def _check_suffix(path: Path, what: str, suffixes: Sequence[str]) -> None:
    """Raise FileFormatError for a directory, or a file with another suffix.

    The message advises to leave out a `#part` that this kind of file cannot have, or to
    convert the file.

    Args:
        path: the file, perhaps with a part of it behind a #.
        what: expected content, for messages: a word that follows "an", such as "object"
            or "environment".
        suffixes: suffixes that it may have, in lower case with the dot.
    """
    if path.is_dir():
        raise FileFormatError(
            f"{path}: expected a file with an {what}, got a "
            "directory; name a file inside it"
        )
    if path.suffix.lower() in suffixes:
        return
    file, part_name = _split_part_name(path)
    _check_part_name(file, part_name, suffixes)
    # The advice is about programs that export meshes.
    advice = None if what == "environment" else find_advice(Path(file))
    if advice is not None:
        raise FileFormatError(
            f"{path}: {advice} (supported are {join_alternatives(suffixes)})"
        )
    raise _make_suffix_error(path, what, suffixes)


def _check_part_name(file: str, part_name: str, suffixes: Sequence[str]) -> None:
    """Raise FileFormatError if a part is named of a supported file, which has none."""
    # With a suffix that is not supported, the suffix is the problem, and not the part.
    if part_name and Path(file).suffix.lower() in suffixes:
        raise FileFormatError(
            f"{file}: has no parts by name, got "
            f"#{format_name(part_name, quoted=False)}; leave it out"
        )


def _split_part_name(path: Path) -> tuple[str, str]:
    """Split a path at its last # into the file and a part's name, which may be ""."""
    file, _, part_name = str(path).rpartition("#")
    if not file:  # no part is named
        return str(path), ""
    return file, part_name


def _make_suffix_error(
    path: Path, what: str, suffixes: Sequence[str]
) -> FileFormatError:
    """Return the error for a file whose suffix is none of those supported."""
    got = f"got {path.suffix!r}" if path.suffix else "got a name without a suffix"
    return FileFormatError(
        f"{path}: expected an {what} file ending in {join_alternatives(suffixes)}, {got}; "
        "convert it to one of these"
    )


def _make_missing_file_hint(path: Path, suffixes: Sequence[str]) -> str:
    """Return a sentence that helps to find a missing file, with a blank before it.

    It names up to three files of the folder with similar names and one of the suffixes.
    """
    if not path.parent.is_dir():
        return f" The folder {path.parent} does not exist either."
    name_by_lower_case = _list_names_with_suffix(path.parent, suffixes)
    matches = difflib.get_close_matches(
        path.name.lower(), sorted(name_by_lower_case), n=3, cutoff=0.5
    )
    if not matches:
        return ""
    names = " or ".join(repr(name_by_lower_case[match]) for match in matches)
    return f" Did you mean {names}?"


def _list_names_with_suffix(folder: Path, suffixes: Sequence[str]) -> dict[str, str]:
    """Return the names of a folder's files with one of the suffixes, by lower case.

    The result is empty if the folder may not be read.
    """
    with suppress(OSError):
        return {
            file.name.lower(): file.name
            for file in folder.iterdir()
            if file.suffix.lower() in suffixes
        }
    return {}


def damaged(path: Path | str, expected: str, got: str) -> FileFormatError:
    """Return the error for a file whose content is not what its suffix promises."""
    return FileFormatError(
        f"{path}: expected {expected}, got {got}; export or download the file again"
    )


def detect_file_kind(data: bytes) -> str | None:
    """Return the kind of file that begins with these bytes, None if it is unknown.

    It follows "got" in a message: "a PNG picture".
    """
    for magic, kind in _MAGIC_BYTES:
        if data.startswith(magic):
            return kind
    return None


def describe_content(data: bytes) -> str:
    """Describe the content of a file, to follow "got" in a message."""
    kind = detect_file_kind(data)
    if kind is not None:
        return kind
    return "binary data of another kind" if b"\x00" in data else "text of another kind"


def decode_text(data: bytes) -> str:
    """Decode UTF-8 or, failing that, Latin-1; a byte order mark is dropped."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def parse_number_array(data: bytes, kind: type) -> npt.NDArray[np.generic]:
    """Parse numbers (N,) separated by blanks, up to the first word that is none."""
    with warnings.catch_warnings():
        # numpy warns if it stops at such a word
        warnings.simplefilter("ignore")
        try:
            return np.fromstring(data, dtype=kind, sep=" ")
        except ValueError:
            return np.zeros(0, kind)


def is_number(word: str) -> bool:
    """Return whether a word is a number, as files write them."""
    try:
        float(word)
    except ValueError:
        return False
    return "_" not in word  # Python's own notation


def format_name(
    name: str, *, quoted: bool = True, max_length: int = _MAX_NAME_LENGTH
) -> str:
    """Format a name out of a file for a message.

    Control characters are escaped. If a name is longer than `max_length`, its first
    `max_length // 2` characters and its length are returned.
    """
    is_too_long = len(name) > max_length
    start = name[: max_length // 2] if is_too_long else name
    text = repr(start) if quoted else repr(start)[1:-1]  # without quotation marks
    return f"{text}... ({len(name):,} characters)" if is_too_long else text


def make_safe_name(path: Path) -> str:
    """Return a file's name without suffix and without special characters.

    Everything but letters, digits, '.', '_' and '-' becomes a '-'.
    """
    return re.sub(r"[^A-Za-z0-9._-]", "-", path.stem).strip(".-") or "imported"


class UniqueNames:
    """Makes names unique, and valid in a setting; those in `reserved` are never used."""

    def __init__(self, reserved: Iterable[str] = ()) -> None:
        self._used = set(reserved)
        self._last: dict[str, int] = {}

    def make_unique(self, requested: str) -> str:
        """Return a name with a number added if it is used already: "wheel-2"."""
        base = sanitize_name(requested)
        name = base
        suffix_number = self._last.get(base, 1)
        while name in self._used:
            suffix_number += 1
            name = f"{base}-{suffix_number}"
        self._last[base] = suffix_number
        self._used.add(name)
        return name


def sanitize_name(name: str) -> str:
    """Return a name reduced to letters, digits, dashes and underscores, 60 at most."""
    return re.sub(r"[^\w-]+", "-", name).strip("-")[:60] or "part"


LARGEST_FACES = 2_000_000
"""Limit of the triangles of a mesh, before `scale_limit`; each takes over 1 KB of
memory.
"""
MAX_CORNERS = 10_000  # limit of the corners of a face


def check_faces(path: Path | str, count: int, got: str | None = None) -> None:
    """Raise FileFormatError for a mesh of more than `LARGEST_FACES` triangles."""
    check_most(path, count, LARGEST_FACES, "a mesh of at most {} triangles", got)


class Notes:
    """Warnings about one file, and a record of its entries that were not read.

        notes = Notes("chair.ply")
        notes.warn("the alpha of 'wood.png' is left out")
        notes.record("property", "confidence")
        notes.mark_read("property", "x")
        list(notes)   # [..., "chair.ply: property 'confidence' is left out"]

    An entry of a file has a kind (a word of the format: ``"property"``, ``"keyword"``)
    and a name. Equal warnings are listed once.

    Attributes:
        path: path of the file, for errors.
        source: name of the file in warnings, without the folder.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = path
        self.source = path.name if isinstance(path, Path) else path
        # A dict for speed, since a file may cause 100,000 warnings.
        self._warnings: dict[str, None] = {}
        self._recorded: Counter[tuple[str, str]] = Counter()
        self._read: set[tuple[str, str]] = set()

    def warn(self, clause: str) -> None:
        """Add a warning, if it is new.

        The name of the file precedes the clause, with a colon unless the clause begins
        with a blank.
        """
        separator = "" if clause.startswith(" ") else ": "
        self._warnings[f"{self.source}{separator}{clause}"] = None

    def warn_that_file(self, predicate: str) -> None:
        """Add a warning whose subject is the file, if it is new.

        The predicate follows the name of the file: "chair.ply has Gaussian splats".
        """
        self._warnings[f"{self.source} {predicate}"] = None

    def damaged(self, expected: str, got: str | bytes) -> FileFormatError:
        """Return the error of `damaged`; content, as bytes, is described."""
        text = got if isinstance(got, str) else describe_content(got)
        return damaged(self.path, expected, text)

    def check_most(self, count: int, limit: int, expected: str) -> None:
        """Check a limit of the file; see `check_most`."""
        check_most(self.path, count, limit, expected)

    def check_faces(self, count: int) -> None:
        """Check the number of triangles of the file; see `check_faces`."""
        check_faces(self.path, count)

    def record(self, kind: str, name: str) -> None:
        """Record that the file has an entry."""
        self._recorded[kind, name] += 1

    def mark_read(self, kind: str, name: str) -> None:
        """Record that an entry is read; the file need not have it."""
        self._read.add((kind, name))

    def __iter__(self) -> Iterator[str]:
        """Yield all warnings, then one about each entry that was not read."""
        yield from self._warnings
        for (kind, name), count in self._recorded.items():
            if (kind, name) not in self._read:
                times = "" if count == 1 else f" ({count:,} times)"
                yield f"{self.source}: {kind} {format_name(name)}{times} is left out"


def get_last_line(output: str) -> str:
    """Return a colon and the last line of a program's output, to end a message.

    The result is "" if there is no output.
    """
    lines = [line for line in output.splitlines() if line.strip()]
    return f": {format_name(lines[-1].strip(), quoted=False)}" if lines else ""
