"""PLY: what elements and properties mean. The format leaves their names open; those of many programs are known."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from advsearch import files
from advsearch.errors import FileFormatError
from advsearch.scene.color import srgb_to_linear
from advsearch.scene.importing.files import MOST_CORNERS, Inventory, References, check_faces, damaged, shown
from advsearch.scene.importing.imported_part import ImportedPart, Looked, split_at_corners
from advsearch.scene.importing.pictures import Pictures
from advsearch.scene.importing.ply_elements import Element, Lists, read_elements
from advsearch.scene.importing.polygons import triangulated
from advsearch.scene.importing.surfaces import NEUTRAL, ImportedSurface

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

COLORS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
ALPHAS = ("alpha", "a", "diffuse_alpha")
MAPPED = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"), ("texture_s", "texture_t"), ("tx", "ty"), ("uv1", "uv2"))
WEDGES = ("texcoord", "texcoords", "texture_coordinates")
CORNERS = ("vertex_indices", "vertex_index", "vertex_indexes")
"""Names of properties that mean the same, in the order in which they are looked for."""

_TEXTURE = re.compile(r"texture_?file\s*[:=]?\s+(.*)", re.IGNORECASE)


def read_ply(path: Path, data: bytes) -> tuple[list[ImportedPart], list[str]]:
    """Read a PLY file.

    Args:
        path: the file.
        data: its content.

    Returns:
        One part for each texture, and the warnings.

    Raises:
        FileFormatError: it is damaged, refers to vertices that are not there, or has no faces.
    """
    elements, comments = read_elements(path, data)
    reader = _Reader(path, elements, Inventory(), [])
    points = reader.columns("vertex", (("x", "y", "z"),))
    if points is None:
        raise damaged(path, "a PLY file with vertices that have x, y and z", "none")
    corner, counts = reader.polygons(len(points))
    triangles, face, wrong = triangulated(points[corner], counts)
    if wrong:
        reader.notes.append(f"{wrong:,} faces cross themselves, or are too much work, and may be cut up wrongly")
    at = corner[triangles]
    normals = reader.columns("vertex", (("nx", "ny", "nz"),))
    uvs = reader.mapped(corner, counts, triangles)
    names = [match[1].strip() for comment in comments if (match := _TEXTURE.match(comment)) and match[1].strip()]
    number = reader.texture_numbers(names, corner, counts)[face]
    tint = reader.colors(at, face)
    surfaces = [*reader.textures(names, plain=tint is None), ImportedSurface()]
    parts = []
    kinds = np.stack([number, np.zeros_like(number) if uvs is None else (uvs.index >= 0).all(axis=1)], axis=1)
    _, kind = np.unique(kinds, axis=0, return_inverse=True)
    for chosen in np.split(np.argsort(kind, kind="stable"), np.cumsum(np.bincount(kind.reshape(-1)))[:-1]):
        surface, colors = surfaces[kinds[chosen[0]][0]], None if tint is None else tint[chosen]
        if colors is not None and surface.texture is not None:
            if colors.min() < 1.0:
                reader.note("colours of vertices or faces are left out where there is a texture")
            colors = None
        if colors is not None:
            surface = ImportedSurface(color=np.ones(3, np.float32))
        part_normals = None if normals is None else Looked(normals, at[chosen])
        mapped = None if uvs is None else uvs.at(chosen)
        parts.append(split_at_corners(Looked(points, at[chosen]), part_normals, mapped, colors, surface))
    return parts, [f"{path.name}{note}" for note in reader.said()]


@dataclass
class _Reader:
    """Finds what is known among the properties of a file, and notes what is not.

    Attributes:
        path: the file.
        elements: of it.
        inventory: of their properties.
        notes: the warnings so far, without the file's name.
    """

    path: Path
    elements: dict[str, Element]
    inventory: Inventory
    notes: list[str]

    def __post_init__(self) -> None:
        for element in self.elements.values():
            if element.name not in ("vertex", "face", "tristrips"):
                if element.count:
                    self.inventory.has("element", element.name)
                continue
            for name in element.types:
                self.inventory.has(f"{element.name} property", name)

    def note(self, message: str) -> None:
        """Warn, once."""
        if message not in self.notes:
            self.notes.append(message)

    def said(self) -> list[str]:
        """Return the warnings, each as what follows the file's name."""
        return [note if note.startswith(" ") else f": {note}" for note in [*self.notes, *self.inventory.left()]]

    def columns(self, element: str, names: Sequence[tuple[str, ...]]) -> Array | None:
        """Return the values (N, C) of the first of several groups of properties that an element has; None for none."""
        table = self.elements.get(element)
        for group in names:
            if table is not None and all(name in table.scalars for name in group):
                for name in group:
                    self.inventory.take(f"{element} property", name)
                return np.stack([table.scalars[name].astype(np.float64) for name in group], axis=1)
        return None

    def _list(self, element: str, names: Sequence[str]) -> Lists | None:
        table = self.elements.get(element)
        for name in names:
            if table is not None and name in table.listed:
                self.inventory.take(f"{element} property", name)
                return table.listed[name]
        return None

    def polygons(self, points: int) -> tuple[Ints, Ints]:
        """Return the vertices (C,) of the corners of all polygons, and how many corners each has, (P,); those of faces
        come first, then the triangles of strips.

        Raises:
            FileFormatError: there are none, one has too many or too few corners, or refers to what is not there.
        """
        table = self.elements.get("face")
        names = CORNERS if table is None else (*CORNERS, *(name for name in table.listed if name not in WEDGES))
        faces, strips = self._list("face", names), self._list("tristrips", CORNERS)
        corner = [np.zeros(0, np.int64)] if faces is None else [_whole(faces.values)]
        counts = [np.zeros(0, np.int64)] if faces is None else [faces.counts]
        if strips is not None:
            corner.append(_of_strips(_whole(strips.values), strips.counts).reshape(-1))
            counts.append(np.full(len(corner[-1]) // 3, 3))
        all_corners, all_counts = np.concatenate(corner), np.concatenate(counts)
        if not len(all_counts):
            raise FileFormatError(
                f"{self.path}: expected a mesh with faces, got points or lines only; export triangles"
            )
        if all_counts.min() < 3:
            raise damaged(self.path, "faces with 3 or more corners", f"one with {all_counts.min()}")
        if all_counts.max() > files.scaled(MOST_CORNERS):
            most = f"faces with at most {files.scaled(MOST_CORNERS):,} corners"
            raise files.too_large(self.path, most, f"{all_counts.max():,}")
        check_faces(self.path, int(all_counts.sum()) - 2 * len(all_counts))
        if all_corners.min() < 0 or all_corners.max() >= points:
            raise damaged(self.path, "faces of its own vertices", "a face that refers to a vertex that is not there")
        return all_corners, all_counts

    def mapped(self, corner: Ints, counts: Ints, triangles: Ints) -> Looked | None:
        """Return the texture coordinates of triangles, kept with the corners of faces, or else with vertices."""
        wedges = self._list("face", WEDGES)
        if wedges is None or not wedges.counts.any():
            values = self.columns("vertex", MAPPED)
            return None if values is None else Looked(values, corner[triangles])
        padded = np.zeros(len(counts), np.int64)
        padded[: len(wedges.counts)] = wedges.counts
        whole = padded == 2 * counts
        if not whole[padded > 0].all():
            self.note("texture coordinates of faces that are not two for each corner are left out")
        used = wedges.values[np.repeat(whole[: len(wedges.counts)], wedges.counts)].astype(np.float64).reshape(-1, 2)
        values, same = np.unique(used.view(np.complex128), return_inverse=True)
        index = np.full(len(corner), -1)
        index[np.repeat(whole, counts)] = same.reshape(-1)
        return Looked(values.view(np.float64).reshape(-1, 2), index[triangles])

    def colors(self, at: Ints, face: Ints) -> Array | None:
        """Return the linear colours (T, 3, 3) of the corners of triangles, or None: those of vertices, unless these are
        all the same and those of faces are not."""
        found = {}
        for element, index in (("vertex", at), ("face", face)):
            values = self.columns(element, COLORS)
            if values is None:
                continue
            table = self.elements[element]
            kind = table.types[next(group[0] for group in COLORS if all(name in table.scalars for name in group))]
            self._alpha(table, kind)
            linear = srgb_to_linear(np.clip(np.nan_to_num(values / _scale(values, kind)), 0.0, 1.0).astype(np.float32))
            padded = np.concatenate([linear, srgb_to_linear(np.full((1, 3), NEUTRAL, np.float32))])  # of strips
            colors = padded[np.minimum(index, len(linear))].astype(np.float64)
            found[element] = colors if element == "vertex" else np.repeat(colors[:, None], 3, axis=1)
        if len(found) < 2:
            return next(iter(found.values()), None)
        better = "face" if np.ptp(found["vertex"]) == 0.0 else "vertex"
        other = "faces" if better == "vertex" else "vertices"
        self.note(
            f"colours of {other} are left out: its {'vertices' if better == 'vertex' else 'faces'} have some, too"
        )
        return found[better]

    def _alpha(self, table: Element, kind: np.dtype[np.generic]) -> None:
        for name in ALPHAS:
            if name in table.scalars:
                values = table.scalars[name].astype(np.float64)
                if not len(values) or values.min() >= _scale(values[:, None], kind):
                    self.inventory.take(f"{table.name} property", name)

    def texture_numbers(self, names: Sequence[str], corner: Ints, counts: Ints) -> Ints:
        """Return the number (P,) of each polygon's texture among several; -1 for none."""
        faces, vertices = (self.elements.get(name) for name in ("face", "vertex"))
        if not names:
            return np.full(len(counts), -1)
        if faces is not None and "texnumber" in faces.scalars:
            self.inventory.take("face property", "texnumber")
            number = np.full(len(counts), -1)
            number[: faces.count] = _whole(faces.scalars["texnumber"])
        elif vertices is not None and "texnumber" in vertices.scalars:
            self.inventory.take("vertex property", "texnumber")
            number = _whole(vertices.scalars["texnumber"])[corner[np.cumsum(counts) - counts]]
        else:
            if len(names) > 1:
                self.note(
                    f"of its {len(names)} textures only {shown(names[0])} is used, as its faces have no texnumber"
                )
            return np.zeros(len(counts), np.int64)
        wrong = int(((number < -1) | (number >= len(names))).sum())
        if wrong:
            self.note(f"{wrong:,} faces have a texnumber of a texture that it does not name; they have none")
        return np.where((number >= 0) & (number < len(names)), number, -1)

    def textures(self, names: Sequence[str], *, plain: bool) -> list[ImportedSurface]:
        """Return the surface of each texture; `plain` tells that there are no colours beside them."""
        references = References(self.path)
        pictures = Pictures(len(names), references.get, references.refused)
        surfaces = []
        instead = "neutral grey is" if plain else "the colours of its vertices or faces are"
        read = {name: pictures.of_file(name, "colours and alpha") for name in dict.fromkeys(names)}
        for note in pictures.notes:
            self.note(note)
        for name in names:
            found = read[name]
            if isinstance(found, str):
                self.note(f" names the texture {shown(name)}, which {found}; {instead} used instead")
                surfaces.append(ImportedSurface(name=name))
                continue
            if found[:, :, 3].min() < 1.0:
                self.note(f"the alpha of {shown(name)} is left out")
            surfaces.append(ImportedSurface(texture=np.ascontiguousarray(found[:, :, :3]), name=name))
        return surfaces


def _whole(values: npt.NDArray[np.generic]) -> Ints:
    """Return numbers as whole ones; -1 for what is none."""
    if values.dtype.kind == "f":
        values = np.where(np.abs(values.astype(np.float64)) < 2.0**53, values.astype(np.float64), -1.0)
    return values.astype(np.int64)


def _scale(values: Array, kind: np.dtype[np.generic]) -> float:
    """Return what full brightness is in colours of a type: 1 for floats, unless they are those of bytes."""
    most = float(np.nan_to_num(values).max(initial=0.0))
    if kind.kind == "f":
        return 1.0 if most <= 2.0 else 255.0
    if kind.itemsize == 1 or (kind.itemsize > 2 and most <= 255.0):
        return 255.0
    return 65535.0 if kind.itemsize == 2 or most <= 65535.0 else 2.0 ** (8 * kind.itemsize - (kind.kind == "i")) - 1.0


def _of_strips(vertices: Ints, counts: Ints) -> Ints:
    """Return the triangles (T, 3) of strips; -1 begins a strip anew, and every second triangle is wound backwards."""
    begins = np.zeros(len(vertices) + 1, dtype=np.bool_)
    begins[np.cumsum(counts) - counts] = True
    begins[1:][vertices < 0] = True
    place = np.arange(len(vertices)) - np.maximum.accumulate(np.where(begins[:-1], np.arange(len(vertices)), 0))
    last = np.flatnonzero((place >= 2) & (vertices >= 0))
    triangles: Ints = np.stack([vertices[last - 2], vertices[last - 1], vertices[last]], axis=1)
    odd = place[last] % 2 == 1
    triangles[odd] = triangles[odd][:, [1, 0, 2]]
    a, b, c = triangles.T
    return np.asarray(triangles[(a != b) & (b != c) & (a != c)])
