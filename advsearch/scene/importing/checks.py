"""Checks of mesh files before trimesh parses them.

trimesh reads several damaged files without a word (a face list cut short, an index of zero), counts the relative
indices of an OBJ from the end of the file instead of from the line, and wants an optional package to decode text that
is not UTF-8. The few lines that each format needs are here, where a message can still name the line or the count.
"""

from __future__ import annotations

import json
import re
import struct
from pathlib import Path
from typing import Any

from advsearch.errors import FileFormatError
from advsearch.scene.importing.files import damaged, looks_like, text_of

_OBJ = "a Wavefront OBJ file (text with 'v' and 'f' lines)"
_UNREADABLE = re.compile(r"compression|quantization|basisu")
_FLOAT = 5126  # glTF's code of a 32-bit float


def checked(path: Path, data: bytes) -> bytes:
    """Return the mesh file's bytes in the form that trimesh reads rightly.

    Args:
        path: the file, whose ending names the format.
        data: its content.

    Raises:
        FileFormatError: the content is another kind of file, is cut short, or refers to something that is not in it.
    """
    suffix = path.suffix.lower()
    if suffix == ".obj":
        return _checked_obj(path, data).encode()
    if suffix == ".ply":
        _check_ply(path, data)
    elif suffix == ".stl":
        _check_stl(path, data)
    else:
        _check_gltf(path, gltf_header(path, data))
    return data


# --- Wavefront OBJ ----------------------------------------


def _checked_obj(path: Path, data: bytes) -> str:
    """Return the text with positive indices, one statement a line, and one space after each keyword."""
    if b"\x00" in data:
        raise damaged(path, _OBJ, looks_like(data))
    counts = {"v": 0, "vt": 0, "vn": 0}
    largest = {"v": (0, 0), "vt": (0, 0), "vn": (0, 0)}
    lines = []
    for number, line in enumerate(re.sub(r"\\\r?\n", " ", text_of(data)).splitlines(), start=1):
        key, _, rest = line.replace("\t", " ").strip().partition(" ")
        if key in counts:
            counts[key] += 1
            if rest.count(" ") < 2 and len(rest.split()) < (1 if key == "vt" else 3):
                raise damaged(path, f"3 numbers after {key!r} on line {number}", f"{rest!r} (is the file cut short?)")
        elif key == "f":
            rest = " ".join(_corners(path, number, rest.split("#", 1)[0].split(), counts, largest))
        lines.append(f"{key} {rest.strip()}")
    if not counts["v"]:
        raise damaged(path, _OBJ, looks_like(data))
    for kind, (index, number) in largest.items():
        if index > counts[kind]:
            got = f"{counts[kind]}, and a face on line {number} that refers to number {index} (is the file cut short?)"
            raise damaged(path, f"at least {index} {kind!r} lines", got)
    return "\n".join(lines) + "\n"


def _corners(
    path: Path, number: int, tokens: list[str], counts: dict[str, int], largest: dict[str, tuple[int, int]]
) -> list[str]:
    """Return the corners of the face on line `number` with absolute indices; note the largest index of each kind."""
    if len(tokens) < 3:
        raise damaged(path, f"3 or more corners on line {number}", f"'f {' '.join(tokens)}' (is the file cut short?)")
    result = []
    for token in tokens:
        parts = token.split("/")
        for place, kind in enumerate(("v", "vt", "vn")[: len(parts)]):
            if not parts[place] and place:
                continue
            try:
                index = int(parts[place])
            except ValueError:
                raise damaged(path, f"whole numbers in the face on line {number}", repr(token)) from None
            absolute = index if index > 0 else counts[kind] + 1 + index
            if index == 0 or absolute < 1:
                raise damaged(path, f"indices that count from 1 in the face on line {number}", repr(token))
            parts[place] = str(absolute)
            if absolute > largest[kind][0]:
                largest[kind] = (absolute, number)
        result.append("/".join(parts))
    return result


# --- PLY and STL ----------------------------------------


def _check_ply(path: Path, data: bytes) -> None:
    """Check the header, and that an ASCII file has as many lines as its header promises."""
    head, found, body = data.partition(b"end_header")
    if not data.startswith(b"ply") or not found:
        got = "half of one" if data.startswith(b"ply") else looks_like(data)
        raise damaged(path, "a PLY file with a complete header", got)
    if b"format ascii" in head:
        promised = sum(int(count) for count in re.findall(rb"^element\s+\w+\s+(\d+)", head, re.MULTILINE))
        lines = sum(1 for line in body.splitlines() if line.strip())
        if lines < promised:
            raise damaged(path, f"{promised} lines after the PLY header", f"{lines}; the file is cut short")


def _check_stl(path: Path, data: bytes) -> None:
    """Check that a binary file is as long as its facet count says and that an ASCII one is closed."""
    promised = 84 + 50 * struct.unpack_from("<I", data, 80)[0] if len(data) >= 84 else 84
    if len(data) == promised:
        return
    if data.lstrip()[:5].lower() == b"solid" and b"\x00" not in data:
        if b"endsolid" not in data.lower():
            raise damaged(path, "an ASCII STL file that ends in 'endsolid'", "one that is cut short")
        return
    kind = looks_like(data)
    got = f"{len(data)} bytes, which is neither ASCII nor that long" if "another" in kind else kind
    raise damaged(path, f"an STL file (in binary, {promised} bytes for its number of facets)", got)


# --- glTF ----------------------------------------


def gltf_header(path: Path, data: bytes) -> dict[str, Any]:
    """Return the JSON part of a .gltf or .glb file.

    Raises:
        FileFormatError: the file is not glTF, or shorter than it says.
    """
    text = data
    if path.suffix.lower() == ".glb":
        if not data.startswith(b"glTF") or len(data) < 20:
            got = "the first few bytes of one" if data.startswith(b"glTF") else looks_like(data)
            raise damaged(path, "a binary glTF file", got)
        length, chunk = struct.unpack_from("<8xII", data)
        if length > len(data):
            raise damaged(path, f"{length} bytes, as its header says", f"{len(data)}; the file is cut short")
        text = data[20 : 20 + chunk]
    try:
        header = json.loads(text_of(text))
    except ValueError:
        kind = looks_like(data)
        raise damaged(path, "glTF with a JSON header", kind if "another" not in kind else "something else") from None
    if not isinstance(header, dict) or "asset" not in header:
        raise damaged(path, "glTF with an 'asset' entry", "other JSON")
    return header


def _check_gltf(path: Path, header: dict[str, Any]) -> None:
    """Refuse what would be read wrongly: compressed meshes, and integers where floats are meant."""
    needed = sorted(name for name in header.get("extensionsRequired", ()) if _UNREADABLE.search(str(name)))
    if needed:
        raise FileFormatError(
            f"{path}: needs {', '.join(needed)}, which is not supported; export it without that option"
        )
    accessors = header.get("accessors", [])
    for mesh in header.get("meshes", []):
        for primitive in mesh.get("primitives", []):
            for name, index in primitive.get("attributes", {}).items():
                whole = name in ("POSITION", "NORMAL", "TEXCOORD_0") and index < len(accessors)
                if whole and accessors[index].get("componentType") != _FLOAT:
                    got = f"{name} values that are not 32-bit floats"
                    raise FileFormatError(f"{path}: expected floats, got {got}; export it without quantization")
