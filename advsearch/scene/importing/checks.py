"""Checks of mesh files before trimesh parses them.

trimesh reads several damaged files without a word (a face list cut short, an index of zero), counts the relative
indices of an OBJ from the end of the file instead of from the line, and wants an optional package to decode text that
is not UTF-8. The few lines that each format needs are here, where a message can still name the line or the count.
"""

from __future__ import annotations

import re
import struct
from pathlib import Path

from advsearch import files
from advsearch.scene.importing.files import damaged, looks_like, shown, text_of

LARGEST_FACES = 2_000_000
"""Triangles that a mesh may have, before `advsearch.files.scaled`; each takes over 1 KB of memory to import."""

MOST_CORNERS = 10_000
"""Corners that one face may have."""

_OBJ = "a Wavefront OBJ file (text with 'v' and 'f' lines)"


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
    return data


def check_faces(path: Path, count: int) -> None:
    """Refuse a mesh with too many triangles.

    Raises:
        FileFormatError: there are more than `LARGEST_FACES`, before `advsearch.files.scaled`.
    """
    if count > files.scaled(LARGEST_FACES):
        raise files.too_large(path, f"a mesh of at most {files.scaled(LARGEST_FACES):,} triangles", f"{count:,}")


# --- Wavefront OBJ ----------------------------------------


def _checked_obj(path: Path, data: bytes) -> str:
    """Return the text with positive indices, one statement a line, and one space after each keyword."""
    if b"\x00" in data:
        raise damaged(path, _OBJ, looks_like(data))
    counts = {"v": 0, "vt": 0, "vn": 0}
    largest = {"v": (0, 0), "vt": (0, 0), "vn": (0, 0)}
    lines, triangles = [], 0
    for number, line in enumerate(re.sub(r"\\\r?\n", " ", text_of(data)).splitlines(), start=1):
        key, _, rest = line.replace("\t", " ").strip().partition(" ")
        if key in counts:
            counts[key] += 1
            if rest.count(" ") < 2 and len(rest.split()) < (1 if key == "vt" else 3):
                raise damaged(
                    path, f"3 numbers after {key!r} on line {number}", f"{shown(rest)} (is the file cut short?)"
                )
        elif key == "f":
            tokens = rest.split("#", 1)[0].split()
            triangles += len(tokens) - 2
            rest = " ".join(_corners(path, number, tokens, counts, largest))
        lines.append(f"{key} {rest.strip()}")
    if not counts["v"]:
        raise damaged(path, _OBJ, looks_like(data))
    check_faces(path, triangles)
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
        raise damaged(
            path, f"3 or more corners on line {number}", f"{shown(' '.join(['f', *tokens]))} (is the file cut short?)"
        )
    if len(tokens) > files.scaled(MOST_CORNERS):
        expected = f"at most {files.scaled(MOST_CORNERS):,} corners in the face on line {number}"
        raise files.too_large(path, expected, f"{len(tokens):,}")
    result = []
    for token in tokens:
        parts = token.split("/")
        for place, kind in enumerate(("v", "vt", "vn")[: len(parts)]):
            if not parts[place] and place:
                continue
            try:
                index = int(parts[place])
            except ValueError:
                raise damaged(path, f"whole numbers in the face on line {number}", shown(token)) from None
            absolute = index if index > 0 else counts[kind] + 1 + index
            if index == 0 or absolute < 1:
                raise damaged(path, f"indices that count from 1 in the face on line {number}", shown(token))
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
    for count in re.findall(rb"^element\s+face\s+(\d+)", head, re.MULTILINE):
        check_faces(path, int(count[:20]))
    if b"format ascii" in head:
        promised = sum(int(count[:20]) for count in re.findall(rb"^element\s+\w+\s+(\d+)", head, re.MULTILINE))
        lines = sum(1 for line in body.splitlines() if line.strip())
        if lines < promised:
            raise damaged(path, f"{promised} lines after the PLY header", f"{lines}; the file is cut short")


def _check_stl(path: Path, data: bytes) -> None:
    """Check that a binary file is as long as its facet count says and that an ASCII one is closed."""
    promised = 84 + 50 * struct.unpack_from("<I", data, 80)[0] if len(data) >= 84 else 84
    if len(data) == promised:
        check_faces(path, (promised - 84) // 50)
        return
    if data.lstrip()[:5].lower() == b"solid" and b"\x00" not in data:
        if b"endsolid" not in data.lower():
            raise damaged(path, "an ASCII STL file that ends in 'endsolid'", "one that is cut short")
        return
    kind = looks_like(data)
    got = f"{len(data)} bytes, which is neither ASCII nor that long" if "another" in kind else kind
    raise damaged(path, f"an STL file (in binary, {promised} bytes for its number of facets)", got)
