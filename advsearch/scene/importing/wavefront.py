"""Wavefront OBJ: statements as arrays, and the parts of geometry that they make up.

Statements of numbers are read as arrays, since a file may have millions of lines; the others one after the other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from advsearch.errors import FileFormatError
from advsearch.scene.color import srgb_to_linear
from advsearch.scene.importing.corners import Looked, split_at_corners
from advsearch.scene.importing.files import damaged, looks_like, shown
from advsearch.scene.importing.imported_part import ImportedPart
from advsearch.scene.importing.left_out import Inventory
from advsearch.scene.importing.mtl import without_comment
from advsearch.scene.importing.mtl_surfaces import MtlReader, Painted, libraries_of
from advsearch.scene.importing.polygons import triangulated
from advsearch.scene.importing.references import References
from advsearch.scene.importing.surfaces import NEUTRAL, ImportedSurface
from advsearch.scene.importing.wavefront_lines import EXPECTED, TABLES, Lines

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

GROUPING = frozenset(("g", "o"))
"""Statements that only name parts; all parts are joined."""
FREE_FORM = frozenset(
    "bmat bsp bzp cdc cdp con cstype curv curv2 deg end hole mg parm res scrv sp step surf trim vp".split()
)
"""Statements of curves and curved surfaces."""
BEYOND = 0.01
"""How far texture coordinates may lie outside of a texture before it matters how that goes on."""


def read_obj(path: Path, data: bytes) -> tuple[list[ImportedPart], list[str]]:
    """Read an OBJ file and the material files that it names.

    Args:
        path: the file.
        data: its content.

    Returns:
        One part for each material, and for its faces without texture coordinates another; and the warnings.

    Raises:
        FileFormatError: it is of another kind, is cut short, refers to what is not in it, or has no faces.
    """
    lines = Lines(path, data)
    tables = {kind: lines.table(kind) for kind in TABLES}
    if not len(tables["v"]):
        raise damaged(path, EXPECTED, looks_like(data))
    corners, counts, rows = lines.faces({kind: len(table) for kind, table in tables.items()})
    if not len(counts):
        raise FileFormatError(f"{path}: expected a mesh with faces, got points or lines only; export triangles")
    inventory, references = Inventory(), References(path)
    reader = MtlReader(path.name, references, inventory)
    said = _statements(lines, inventory)
    for name in libraries_of(said.libraries, references):
        reader.read_library(name)
    points = tables["v"][:, :3]
    triangles, face, wrong = triangulated(points[corners[:, 0]], counts)
    if wrong:
        reader.note(f"{path.name}: {wrong:,} faces cross themselves, or are too much work, and may be cut up wrongly")
    position, mapped, normal = (corners[triangles, place] for place in range(3))
    names, material = _in_effect(said.materials, rows[face])
    smoothness, smooth = _in_effect(said.smoothing, rows[face])
    off = np.array([*(word in ("off", "0", "") for word in smoothness), False])[smooth]
    if ((smooth >= 0) & ~off & (normal < 0).any(axis=1)).any():
        reader.note(f"{path.name}: smoothing groups are left out: its normals are made, with creases at sharp edges")
    colors = _colors(lines, tables["v"], inventory)
    parts = []
    kinds = np.stack([material, (mapped >= 0).all(axis=1), off], axis=1)
    _, kind = np.unique(kinds, axis=0, return_inverse=True)
    for chosen in np.split(np.argsort(kind, kind="stable"), np.cumsum(np.bincount(kind.reshape(-1)))[:-1]):
        first = kinds[chosen[0]]
        painted = reader.painted(names[first[0]]) if first[0] >= 0 and names[first[0]] else Painted(ImportedSurface())
        tint = None if colors is None else colors[position[chosen]]
        if painted is None:
            painted = Painted(ImportedSurface(name=without_comment(names[first[0]])))
            instead = "neutral grey" if tint is None else "the colour of its vertices"
            _note_unknown(reader, said, names[first[0]], instead)
        surface, tint = _tinted(reader, painted.surface, tint)
        uvs = Looked(tables["vt"], mapped).at(chosen)
        if uvs is not None:
            uvs = replace(uvs, values=uvs.values * painted.scale + painted.offset)
            if painted.clamped and _beyond(uvs.values[uvs.index[(uvs.index >= 0).all(axis=1)]]):
                reader.note(
                    f"{path.name} has textures that are not to repeat beyond their edges (-clamp); here they do"
                )
        at = Looked(points, position[chosen])
        parts.append(
            split_at_corners(at, Looked(tables["vn"], normal).at(chosen), uvs, tint, surface, flat=bool(first[2]))
        )
    return parts, [*reader.notes, *(f"{path.name}: {clause}" for clause in inventory.left())]


# --- what the statements beside numbers say ----------------------------------------


@dataclass(frozen=True)
class _Said:
    """Statements with the rows that they are in.

    Attributes:
        libraries: what stands after ``mtllib``.
        materials: names after ``usemtl``.
        smoothing: words after ``s``.
    """

    libraries: list[str]
    materials: list[tuple[int, str]]
    smoothing: list[tuple[int, str]]


def _statements(lines: Lines, inventory: Inventory) -> _Said:
    """Read the statements that are no numbers; what nothing becomes of is put into the inventory."""
    said = _Said([], [], [])
    for row, word, rest in lines.others():
        key, plain = word.lower(), without_comment(rest).lower()
        if key == "mtllib":
            said.libraries.append(rest)
        elif key == "usemtl":
            said.materials.append((row, " ".join(rest.split())))
        elif key == "s":
            said.smoothing.append((row, plain))
        elif key in ("p", "l"):
            inventory.has("points, statement" if key == "p" else "lines, statement", key)
        elif key in FREE_FORM:
            inventory.has("curves and curved surfaces, statement", key)
        elif key not in GROUPING and plain not in ("off", "0"):
            inventory.has("statement", word)
    return said


def _in_effect(changes: list[tuple[int, str]], rows: Ints) -> tuple[list[str], Ints]:
    """Return the values that are said, and for each row the number of the last before it; -1 where there is none."""
    numbers = {value: number for number, value in enumerate(dict.fromkeys(value for _, value in changes))}
    last = np.searchsorted(np.array([row for row, _ in changes], dtype=np.int64), rows) - 1
    return list(numbers), np.array([*(numbers[value] for _, value in changes), -1])[last]


def _note_unknown(reader: MtlReader, said: _Said, name: str, instead: str) -> None:
    """Say that a material is nowhere; where no material file could be read, that is enough."""
    if reader.libraries:
        lacks = "its .mtl file lacks" if reader.libraries == 1 else "its .mtl files lack"
        reader.note(f"{reader.source} uses the material {shown(name)}, which {lacks}; {instead} is used instead")
    elif not said.libraries:
        reader.note(f"{reader.source} uses materials and names no material file (mtllib); {instead} is used instead")


# --- colours of vertices ----------------------------------------


def _colors(lines: Lines, table: Array, inventory: Inventory) -> Array | None:
    """Return the linear colour (V, 3) of every vertex; neutral grey where a file with colours has none.

    A vertex is three coordinates, then perhaps a weight, or a colour, or a colour and its opacity; or ZBrush has put
    colours into comments.
    """
    if (np.isfinite(table[:, 3]) & np.isnan(table[:, 4]) & (table[:, 3] != 1.0)).any():
        inventory.has("weights of vertices, the fourth number of", "v")
    given = table[:, 3:6]
    if np.isfinite(table[:, 6]).any() and not np.isin(table[:, 6], (1.0, 255.0)).all():
        inventory.has("opacities of vertices, the seventh number of", "v")
    if np.isnan(given[:, 2]).all():
        found = lines.zbrush_colors(len(table))
        if found is None:
            return None
        given = found
    known = np.asarray(np.isfinite(given).all(axis=1))
    scale = 255.0 if known.any() and given[known].max() > 2.0 else 1.0
    colors = np.where(known[:, None], given / scale, NEUTRAL)
    return np.asarray(srgb_to_linear(np.clip(colors, 0.0, 1.0).astype(np.float32)), dtype=np.float64)


def _tinted(reader: MtlReader, surface: ImportedSurface, tint: Array | None) -> tuple[ImportedSurface, Array | None]:
    """Return a surface and the colours (F, 3, 3) of its corners that multiply it: all but those of a texture."""
    if tint is None:
        return surface, None
    if surface.texture is not None:
        if tint.min() < 1.0:
            reader.note(f"{reader.source}: colours of vertices are left out where there is a texture")
        return surface, None
    if surface.color is None:
        return replace(surface, color=np.ones(3, np.float32)), tint
    if surface.color[:3].min() < 0.999 and tint.min() < 1.0:
        reader.note(f"{reader.source}: colours of vertices are multiplied by the Kd of their material")
    return surface, tint


def _beyond(uvs: Array) -> bool:
    """Whether texture coordinates (N, 2) leave the texture by more than `BEYOND`."""
    return bool(len(uvs)) and not (uvs.min() >= -BEYOND and uvs.max() <= 1.0 + BEYOND)
