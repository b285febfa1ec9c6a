"""STL files, in binary and as text."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import numpy as np
import numpy.typing as npt

from advsearch.errors import FileFormatError
from advsearch.scene.assets import (
    Doubles,
)
from advsearch.scene.color import srgb_to_linear
from advsearch.scene.importing.files import Notes, looks_like, text_of
from advsearch.scene.importing.parts import NEUTRAL, ImportedPart, ImportedSurface

Attributes = npt.NDArray[np.uint16]
_FACET = np.dtype(
    [("normal", "<f4", 3), ("vertices", "<f4", (3, 3)), ("attribute", "<u2")]
)
_VERTEX = re.compile(rb"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", re.IGNORECASE)
_NAMED = re.compile(
    rb"^[ \t]*(?:end[ \t]?)?solid\b(?:(?!facet\s+normal)[^\n])*",
    re.IGNORECASE | re.MULTILINE,
)
_WORDS = frozenset("facet outer vertex endloop endfacet end".split())
_OWN = 0x8000


def read_stl(path: Path, data: bytes, notes: Notes) -> list[ImportedPart]:
    """Read an STL file as one part; its facet normals are made anew, as every program
    does. Raises FileFormatError: it is damaged, or has no facets.
    """
    promised = (
        84 + 50 * struct.unpack_from("<I", data, 80)[0] if len(data) >= 84 else 84
    )
    corners = None
    surface = ImportedSurface()
    if len(data) == promised:
        notes.check_faces((promised - 84) // 50)
        facets = np.frombuffer(data, _FACET, offset=84)
        points = facets["vertices"].astype(np.float64).reshape(-1, 3)
        colors = _colors(data[:80], facets["attribute"], notes)
        if colors is not None:
            corners = np.repeat(colors[:, None], 3, axis=1)
            surface = ImportedSurface(color=np.ones(3, np.float32))
    elif data.lstrip()[:5].lower() == b"solid" and b"\x00" not in data:
        points = _of_text(data, notes)
    else:
        kind = looks_like(data)
        got = (
            f"{len(data)} bytes, which is neither ASCII nor that long"
            if "another" in kind
            else kind
        )
        raise notes.damaged(
            f"an STL file (in binary, {promised} bytes for its number of facets)", got
        )
    if not len(points):
        raise FileFormatError(
            f"{path}: expected a mesh with faces, got none; export triangles"
        )
    return [
        ImportedPart(
            points, np.arange(len(points)).reshape(-1, 3), None, None, corners, surface
        )
    ]


def _of_text(data: bytes, notes: Notes) -> Doubles:
    if not re.search(rb"\bend\s?solid", data, re.IGNORECASE):
        raise notes.damaged(
            "an ASCII STL file that ends in 'endsolid'", "one that is cut short"
        )
    data = _NAMED.sub(b"", data.replace(b"\r", b"\n"))
    found = _VERTEX.findall(data)
    notes.check_faces(len(found) // 3)
    if len(found) % 3 or len(found) != 3 * len(
        re.findall(rb"\bouter\s+loop\b", data, re.IGNORECASE)
    ):
        raise notes.damaged("facets with 3 vertices", f"{len(found):,} vertices in all")
    try:
        points = np.array(found).astype(np.float64)
    except ValueError:
        raise notes.damaged(
            "three numbers after each 'vertex'", "something else"
        ) from None
    for word in re.findall(rb"^[ \t]*([^\s\d]\S*)", data, re.MULTILINE):
        if text_of(word).lower() not in _WORDS:
            notes.has("statement", text_of(word))
    return points.reshape(-1, 3)


def _colors(head: bytes, attributes: Attributes, notes: Notes) -> Doubles | None:
    # Two programs have their own ways, with 5 bits a channel. Magics writes ``COLOR=``
    # and four bytes, the colour of all, into the header, and red in the lowest bits of
    # a facet whose highest bit is not set. VisCAM has blue in the lowest bits, and sets
    # the highest where a facet has a colour.
    magics = head.find(b"COLOR=")
    bits = np.stack(
        [(attributes >> shift) & 31 for shift in (10, 5, 0)], axis=1
    ).astype(np.float32) / np.float32(31.0)
    if 0 <= magics <= 70:
        if b"MATERIAL=" in head:
            notes.has("header entry", "MATERIAL")
        colored = (attributes & _OWN == 0) & bool(attributes.any())
        bits = bits[:, ::-1]
        plain = np.frombuffer(head, np.uint8, 3, magics + 6) / np.float32(255.0)
        if head[magics + 9] < 255 and head[magics + 9] > 0:
            notes.has("opacity of its header entry", "COLOR")
    else:
        colored = attributes & _OWN != 0
        plain = np.full(3, NEUTRAL, np.float32)
        if not colored.any():
            if attributes.any():
                notes.has(
                    "attribute bytes of its facets, which are no colours known here,",
                    f"{attributes.max():#06x}",
                )
            return None
    display = np.where(colored[:, None], bits, plain).astype(np.float32)
    return np.asarray(srgb_to_linear(display), dtype=np.float64)
