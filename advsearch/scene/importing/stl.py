"""STL files, in binary and as text."""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from advsearch.errors import FileFormatError
from advsearch.scene.assets import BoolArray, Float32Array, Float64Array
from advsearch.scene.color import srgb_to_linear
from advsearch.scene.importing.files import Notes, decode_text, detect_file_kind
from advsearch.scene.importing.parts import NEUTRAL_GREY, ImportedPart, ImportedSurface

Attributes = npt.NDArray[np.uint16]
_FACET_DTYPE = np.dtype(
    [("normal", "<f4", 3), ("vertices", "<f4", (3, 3)), ("attribute", "<u2")]
)
_VERTEX = re.compile(rb"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", re.IGNORECASE)
_NAME_LINE = re.compile(
    rb"^[ \t]*(?:end[ \t]?)?solid\b(?:(?!facet\s+normal)[^\n])*",
    re.IGNORECASE | re.MULTILINE,
)
_WORDS = frozenset("facet outer vertex endloop endfacet end".split())
_COLOR_FLAG = 0x8000  # the highest bit of a facet's attribute
# A binary file has a header, then the number of facets in 4 bytes, then the facets.
_HEADER_SIZE = 80
_FACETS_START = _HEADER_SIZE + 4


def read_stl(path: Path, data: bytes, notes: Notes) -> list[ImportedPart]:
    """Read an STL file as one part.

    A file is binary if its length fits its number of facets, even if it begins with
    "solid", as text does. The normals of facets are ignored and computed anew, as in
    other programs.

    Args:
        path: path of the file.
        data: its bytes.
        notes: notes about the file, to which sentences are added.

    Raises:
        FileFormatError: the file is corrupt, or has no facets.
    """
    n_facets = _read_n_facets(data)
    expected_size = _FACETS_START + _FACET_DTYPE.itemsize * n_facets
    corner_colors = None
    if len(data) == expected_size:
        notes.check_faces(n_facets)
        points, corner_colors = _read_facets(data, notes)
    elif data.lstrip()[:5].lower() == b"solid" and b"\x00" not in data:
        points = _parse_text(data, notes)
    else:
        raise _make_size_error(data, expected_size, notes)
    if not len(points):
        raise FileFormatError(
            f"{path}: expected a mesh with faces, got none; export triangles"
        )
    return [_make_facets_part(points, corner_colors)]


def _read_n_facets(data: bytes) -> int:
    """Return the number of facets that a binary file states; 0 for a shorter file."""
    if len(data) < _FACETS_START:
        return 0
    n_facets: int = struct.unpack_from("<I", data, _HEADER_SIZE)[0]
    return n_facets


def _make_size_error(data: bytes, expected_size: int, notes: Notes) -> FileFormatError:
    """Return the error for a file that is no text, and has no size of a binary file."""
    got = detect_file_kind(data)
    if got is None:
        got = f"{len(data)} bytes, which is neither ASCII nor that long"
    return notes.damaged(
        f"an STL file (in binary, {expected_size} bytes for its number of facets)",
        got,
    )


def _make_facets_part(
    points: Float64Array, corner_colors: Float64Array | None
) -> ImportedPart:
    """Return facets as a part.

    Args:
        points: (3 F, 3) their corners.
        corner_colors: (F, 3, 3) linear colors of the corners, or None.
    """
    surface = ImportedSurface()
    if corner_colors is not None:
        # white, which the colors of facets multiply
        surface = ImportedSurface(color=np.ones(3, np.float32))
    faces = np.arange(len(points)).reshape(-1, 3)
    return ImportedPart(
        vertices=points, faces=faces, colors=corner_colors, surface=surface
    )


def _read_facets(data: bytes, notes: Notes) -> tuple[Float64Array, Float64Array | None]:
    """Return the points (3 F, 3) and the linear colors (F, 3, 3) of a binary file.

    They are those of the corners of its facets; colors are None if it has none.
    """
    facets = np.frombuffer(data, _FACET_DTYPE, offset=_FACETS_START)
    points = facets["vertices"].astype(np.float64).reshape(-1, 3)
    colors = _read_colors(data[:_HEADER_SIZE], facets["attribute"], notes)
    if colors is None:
        return points, None
    return points, np.repeat(colors[:, None], 3, axis=1)


def _read_magics_color(head: bytes, notes: Notes) -> Float32Array | None:
    """Return the display color (3,) of the object that Magics writes into the header.

    The result is None if it has none. The header has ``COLOR=`` and four bytes: red,
    green, blue and opacity. An opacity and a ``MATERIAL=`` entry are not read, and are
    recorded as left out.
    """
    keyword_start = head.find(b"COLOR=")
    color_start = keyword_start + len(b"COLOR=")
    n_channels = 4  # red, green, blue and opacity, a byte each
    if keyword_start < 0 or color_start + n_channels > _HEADER_SIZE:
        return None
    if b"MATERIAL=" in head:
        notes.record("header entry", "MATERIAL")
    color = np.frombuffer(head, np.uint8, 3, color_start) / np.float32(255.0)
    opacity = head[color_start + 3]
    # 0, which would make the object invisible, means that no opacity is stated
    if 0 < opacity < 255:
        notes.record("opacity of its header entry", "COLOR")
    return np.asarray(color, np.float32)


def _parse_text(data: bytes, notes: Notes) -> Float64Array:
    """Return the points (3 F, 3) of an ASCII file.

    Words that the format does not have are recorded as left out.

    Raises:
        FileFormatError: the file is cut short, or a facet does not have three vertices
            of three numbers.
    """
    if not re.search(rb"\bend\s?solid", data, re.IGNORECASE):
        raise notes.damaged(
            "an ASCII STL file that ends in 'endsolid'", "one that is cut short"
        )
    # The lines with the name of the solid may have any words, and are removed.
    data = _NAME_LINE.sub(b"", data.replace(b"\r", b"\n"))
    vertices = _VERTEX.findall(data)
    notes.check_faces(len(vertices) // 3)
    n_loops = len(re.findall(rb"\bouter\s+loop\b", data, re.IGNORECASE))
    if len(vertices) % 3 or len(vertices) != 3 * n_loops:
        raise notes.damaged(
            "facets with 3 vertices", f"{len(vertices):,} vertices in all"
        )
    points = _parse_vertices(vertices, notes)
    _record_unknown_words(data, notes)
    return points.reshape(-1, 3)


def _parse_vertices(vertices: list[Any], notes: Notes) -> Float64Array:
    """Return the numbers of matches of `_VERTEX`; raise FileFormatError for other words."""
    try:
        points = np.array(vertices).astype(np.float64)
    except ValueError:
        raise notes.damaged(
            "three numbers after each 'vertex'", "something else"
        ) from None
    return points


def _record_unknown_words(data: bytes, notes: Notes) -> None:
    """Record the first words of lines that the format does not have."""
    for word in re.findall(rb"^[ \t]*([^\s\d]\S*)", data, re.MULTILINE):
        if decode_text(word).lower() not in _WORDS:
            notes.record("statement", decode_text(word))


def _read_colors(
    head: bytes, attributes: Attributes, notes: Notes
) -> Float64Array | None:
    """Return the linear color of each facet, (F, 3), or None if there are none.

    Two programs store colors in the 16 attribute bits of a facet, 5 bits a channel:

    - Magics writes the color of the object into the header, after ``COLOR=``. Red is in
      the lowest bits of a facet. The highest bit is not set if the facet has a color.
    - VisCAM has blue in the lowest bits, and sets the highest bit if the facet has a
      color.

    Args:
        head: the header of the file.
        attributes: (F,) attribute bytes of the facets.
        notes: notes about the file.
    """
    # (F, 3) the highest bits first, which are VisCAM's red and Magics' blue
    channels = [(attributes >> shift) & 31 for shift in (10, 5, 0)]
    colors = np.stack(channels, axis=1).astype(np.float32) / np.float32(31.0)
    is_flag_set = attributes & _COLOR_FLAG != 0
    object_color = _read_magics_color(head, notes)
    if object_color is not None:
        # If no facet has any bit set, colors were not stored, and all facets have the
        # object's.
        has_color = ~is_flag_set & bool(attributes.any())
        return _fill_colors(colors[:, ::-1], has_color, object_color)
    if is_flag_set.any():
        neutral_color = np.full(3, NEUTRAL_GREY, np.float32)
        return _fill_colors(colors, is_flag_set, neutral_color)
    _record_attributes(attributes, notes)
    return None


def _fill_colors(
    colors: Float32Array, has_color: BoolArray, default_color: Float32Array
) -> Float64Array:
    """Return linear colors (F, 3): display colors of facets that have one, or a default.

    Args:
        colors: (F, 3) display colors of facets.
        has_color: (F,) which facets have a color.
        default_color: (3,) display color of the others.
    """
    display = np.where(has_color[:, None], colors, default_color).astype(np.float32)
    return np.asarray(srgb_to_linear(display), dtype=np.float64)


def _record_attributes(attributes: Attributes, notes: Notes) -> None:
    """Record the largest of the attributes (F,) that are no colors, unless it is 0."""
    if attributes.any():
        # a kind and a name, as in "property 'confidence' is left out"
        notes.record(
            "attribute bytes of its facets, which are no colours of Magics or VisCAM,",
            f"{attributes.max():#06x}",
        )
