"""STL: facets, and the colours that some programs keep in their two spare bytes."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import numpy as np
import numpy.typing as npt

from advsearch.errors import FileFormatError
from advsearch.scene.color import srgb_to_linear
from advsearch.scene.importing.files import Inventory, check_faces, damaged, looks_like, text_of
from advsearch.scene.importing.imported_part import ImportedPart
from advsearch.scene.importing.surfaces import NEUTRAL, ImportedSurface

Array = npt.NDArray[np.float64]
Attributes = npt.NDArray[np.uint16]

_FACET = np.dtype([("normal", "<f4", 3), ("vertices", "<f4", (3, 3)), ("attribute", "<u2")])
_VERTEX = re.compile(rb"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", re.IGNORECASE)
_NAMED = re.compile(rb"^[ \t]*(?:end[ \t]?)?solid\b(?:(?!facet\s+normal)[^\n])*", re.IGNORECASE | re.MULTILINE)
_WORDS = frozenset("facet outer vertex endloop endfacet end".split())
_OWN = 0x8000


def read_stl(path: Path, data: bytes) -> tuple[list[ImportedPart], list[str]]:
    """Read an STL file; its facet normals are made anew, as every program does.

    Args:
        path: the file.
        data: its content.

    Returns:
        One part, and the warnings.

    Raises:
        FileFormatError: it is damaged, or has no facets.
    """
    inventory = Inventory()
    promised = 84 + 50 * struct.unpack_from("<I", data, 80)[0] if len(data) >= 84 else 84
    colors = None
    if len(data) == promised:
        check_faces(path, (promised - 84) // 50)
        facets = np.frombuffer(data, _FACET, offset=84)
        points = facets["vertices"].astype(np.float64).reshape(-1, 3)
        colors = _colors(data[:80], facets["attribute"], inventory)
    elif data.lstrip()[:5].lower() == b"solid" and b"\x00" not in data:
        points = _of_text(path, data, inventory)
    else:
        kind = looks_like(data)
        got = f"{len(data)} bytes, which is neither ASCII nor that long" if "another" in kind else kind
        raise damaged(path, f"an STL file (in binary, {promised} bytes for its number of facets)", got)
    if not len(points):
        raise FileFormatError(f"{path}: expected a mesh with faces, got none; export triangles")
    faces = np.arange(len(points)).reshape(-1, 3)
    surface = ImportedSurface() if colors is None else ImportedSurface(color=np.ones(3, np.float32))
    corners = None if colors is None else np.repeat(colors[:, None], 3, axis=1)
    part = ImportedPart(points, faces, None, None, corners, surface)
    return [part], [f"{path.name}: {clause}" for clause in inventory.left()]


def _of_text(path: Path, data: bytes, inventory: Inventory) -> Array:
    """Return the corners (3 F, 3) of the facets of an ASCII file."""
    if not re.search(rb"\bend\s?solid", data, re.IGNORECASE):
        raise damaged(path, "an ASCII STL file that ends in 'endsolid'", "one that is cut short")
    data = _NAMED.sub(b"", data.replace(b"\r", b"\n"))
    found = _VERTEX.findall(data)
    check_faces(path, len(found) // 3)
    if len(found) % 3 or len(found) != 3 * len(re.findall(rb"\bouter\s+loop\b", data, re.IGNORECASE)):
        raise damaged(path, "facets with 3 vertices", f"{len(found):,} vertices in all")
    try:
        points = np.array(found).astype(np.float64)
    except ValueError:
        raise damaged(path, "three numbers after each 'vertex'", "something else") from None
    for word in re.findall(rb"^[ \t]*([^\s\d]\S*)", data, re.MULTILINE):
        if text_of(word).lower() not in _WORDS:
            inventory.has("statement", text_of(word))
    return points.reshape(-1, 3)


def _colors(head: bytes, attributes: Attributes, inventory: Inventory) -> Array | None:
    """Return the linear colours (F, 3) of facets, or None.

    Two programs have their own ways, with 5 bits a channel. Magics writes ``COLOR=`` and four bytes, the colour of all,
    into the header, and red in the lowest bits of a facet whose highest bit is not set. VisCAM has blue in the lowest
    bits, and sets the highest where a facet has a colour.
    """
    magics = head.find(b"COLOR=")
    bits = np.stack([(attributes >> shift) & 31 for shift in (10, 5, 0)], axis=1).astype(np.float32) / np.float32(31.0)
    if 0 <= magics <= 70:
        if b"MATERIAL=" in head:
            inventory.has("header entry", "MATERIAL")
        own = (attributes & _OWN == 0) & bool(attributes.any())
        bits, plain = bits[:, ::-1], np.frombuffer(head, np.uint8, 3, magics + 6) / np.float32(255.0)
        if head[magics + 9] < 255 and head[magics + 9] > 0:
            inventory.has("opacity of its header entry", "COLOR")
    else:
        own, plain = attributes & _OWN != 0, np.full(3, NEUTRAL, np.float32)
        if not own.any():
            if attributes.any():
                inventory.has(
                    "attribute bytes of its facets, which are no colours known here,", f"{attributes.max():#06x}"
                )
            return None
    found = np.where(own[:, None], bits, plain).astype(np.float32)
    return np.asarray(srgb_to_linear(found), dtype=np.float64)
