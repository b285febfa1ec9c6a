"""PLY: what elements and properties mean. The format leaves their names open; those of
many programs are known.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from advsearch.errors import FileFormatError
from advsearch.scene.assets import Doubles, Ints
from advsearch.scene.color import srgb_to_linear
from advsearch.scene.importing.files import (
    MOST_CORNERS,
    SPLATS,
    Notes,
    is_number,
    numbers_in,
    shown,
    text_of,
)
from advsearch.scene.importing.geometry import cut_up
from advsearch.scene.importing.parts import (
    NEUTRAL,
    ImportedPart,
    ImportedSurface,
    Looked,
    alike,
    split_at_corners,
)
from advsearch.scene.importing.pictures import FilePictures
from advsearch.trust.named_files import References

Numbers = npt.NDArray[np.generic]
_TYPES = {
    **{
        "char": "i1",
        "uchar": "u1",
        "short": "i2",
        "ushort": "u2",
        "int": "i4",
        "uint": "u4",
        "float": "f4",
    },
    **{
        "double": "f8",
        "int8": "i1",
        "uint8": "u1",
        "int16": "i2",
        "uint16": "u2",
        "int32": "i4",
        "uint32": "u4",
    },
    **{"int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8"},
}
_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_END = re.compile(rb"^end_header[ \t]*(?:\r\n|\n|\r)", re.MULTILINE)


@dataclass(frozen=True, eq=False)
class Lists:
    """A property with several values in each row."""

    counts: Ints  # (N,) how many
    values: Numbers  # those of all rows, one after the other


@dataclass
class Element:
    """A table of a file, with the types of its properties, and of the counts of those
    that are lists, as the header has them; and the values (N,) of properties with one a
    row, and those with several.
    """

    name: str
    count: int  # of its rows
    # of a list, that of its values
    types: dict[str, np.dtype[np.generic]] = field(default_factory=dict)
    lists: dict[str, np.dtype[np.generic]] = field(default_factory=dict)
    scalars: dict[str, Numbers] = field(default_factory=dict)
    listed: dict[str, Lists] = field(default_factory=dict)


def read_elements(data: bytes, notes: Notes) -> tuple[dict[str, Element], list[str]]:
    """Return the elements of a file by their names, and its comments. Raises
    FileFormatError: it is no PLY file, its header is odd, or it is shorter than that
    says.
    """
    # carriage returns end its lines
    lone = data.startswith(b"ply\r") and not data.startswith(b"ply\r\n")
    end = _END.search(data.replace(b"\r", b"\n") if lone else data)
    if not data.startswith(b"ply") or end is None:
        got = "half of one" if data.startswith(b"ply") else data
        raise notes.damaged("a PLY file with a complete header", got)
    elements: dict[str, Element] = {}
    comments = list[str]()
    order = None
    current = None
    for line in text_of(data[: end.start()]).splitlines()[1:]:
        match line.split():
            case ["format", kind, *_] if kind in _FORMATS:
                order = _FORMATS[kind]
            case ["comment" | "obj_info", *_]:
                comments.append(line.strip().partition(line.split()[0])[2].strip())
            case ["element", name, count] if (
                count.isdecimal() and len(count) < 20 and name not in elements
            ):
                current = elements[name] = Element(name, int(count))
            case ["property", "list", counts, kind, name] if current and {
                counts,
                kind,
            } <= set(_TYPES):
                current.types[name] = np.dtype((order or "") + _TYPES[kind])
                current.lists[name] = np.dtype((order or "") + _TYPES[counts])
            case ["property", kind, name] if (
                current and kind in _TYPES and name not in current.types
            ):
                current.types[name] = np.dtype((order or "") + _TYPES[kind])
            case []:
                pass
            case _:
                raise notes.damaged(
                    "a PLY header of elements and their properties",
                    f"the line {shown(line)}",
                )
    if order is None:
        raise notes.damaged(
            f"a PLY header with a format of {', '.join(_FORMATS)}", "none of these"
        )
    notes.check_faces(elements["face"].count if "face" in elements else 0)
    body = data[end.end() :]
    at = 0
    cells = (
        np.frombuffer(body, np.uint8)
        if order
        else numbers_in(body, np.float64).view(np.uint8)
    )
    for element in elements.values():
        at = _fill(notes, element, cells, at, b"" if order else body)
    return elements, comments


def _fill(
    notes: Notes, element: Element, cells: npt.NDArray[np.uint8], at: int, text: bytes
) -> int:
    """Read the rows of an element that begin at a byte; return the byte after them. The
    bytes of a file in ASCII, whose `text` is given, are those of its numbers, float64
    each.
    """

    def from_any_byte(kind: np.dtype[np.generic]) -> Numbers:
        kind = np.dtype(np.float64) if text else kind
        numbers: Numbers = np.ndarray(
            (max(0, len(cells) - kind.itemsize + 1),), kind, cells, 0, (1,)
        )
        return numbers

    values = {name: from_any_byte(kind) for name, kind in element.types.items()}
    counts = {name: from_any_byte(kind) for name, kind in element.lists.items()}
    widths = {
        name: counts.get(name, numbers).itemsize for name, numbers in values.items()
    }
    most = len(cells) // (8 if text else 1)  # values of a list

    def check(after: int) -> None:
        if after > len(cells):
            odd = next(
                (word for word in map(text_of, text.split()) if not is_number(word)),
                None,
            )
            got = (
                "fewer; the file is cut short"
                if odd is None
                else f"{shown(odd)} among their numbers"
            )
            raise notes.damaged(
                f"{element.count:,} rows of {shown(element.name)}, as "
                "the PLY header says",
                got,
            )

    def rows(count: int) -> tuple[dict[str, Ints], int]:
        """Go through rows one by one; return the bytes at which each property begins,
        and the byte after them.
        """
        places = {name: list[int]() for name in widths}
        place = at
        steps = [
            (places[name].append, widths[name], counts.get(name), values[name].itemsize)
            for name in widths
        ]
        for _ in range(count):
            for note, width, counted, size in steps:
                note(place)
                check(place + width)
                if counted is not None:
                    number = counted.item(place)
                    if not 0 <= number <= most:
                        what = f"lists in the PLY element {shown(element.name)}"
                        raise notes.damaged(what, f"one of {number:g} values")
                    place += size * int(number)
                place += width
        check(place)
        return {
            name: np.array(begins, dtype=np.int64) for name, begins in places.items()
        }, place

    if not element.count or not widths:
        return at
    check(at + element.count * sum(widths.values()))
    places, after = rows(1)
    end = at + (after - at) * element.count
    steps = (after - at) * np.arange(element.count)
    places = {name: first + steps for name, first in places.items()}
    if end > len(cells) or any(
        np.ptp(numbers[places[name]]) != 0 for name, numbers in counts.items()
    ):
        places, end = rows(element.count)  # the lists differ in length
    for name, begins in places.items():
        if name not in counts:
            element.scalars[name] = values[name][begins]
            continue
        sizes = counts[name][begins].astype(np.int64)
        skipped = np.arange(int(sizes.sum())) - np.repeat(
            np.cumsum(sizes) - sizes, sizes
        )
        inside = (
            np.repeat(begins + widths[name], sizes) + values[name].itemsize * skipped
        )
        element.listed[name] = Lists(sizes, values[name][inside])
    return end


COLORS = (
    ("red", "green", "blue"),
    ("r", "g", "b"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
)
ALPHAS = ("alpha", "a", "diffuse_alpha")
MAPPED = (
    ("s", "t"),
    ("u", "v"),
    ("texture_u", "texture_v"),
    ("texture_s", "texture_t"),
    ("tx", "ty"),
    ("uv1", "uv2"),
)
WEDGES = ("texcoord", "texcoords", "texture_coordinates")
CORNERS = ("vertex_indices", "vertex_index", "vertex_indexes")
"""Names of properties that mean the same, in the order in which they are looked for."""
_TEXTURE = re.compile(r"texture_?file\s*[:=]?\s+(.*)", re.IGNORECASE)


def read_ply(path: Path, data: bytes, notes: Notes) -> list[ImportedPart]:
    """Read a PLY file as one part for each texture. Raises FileFormatError: it is
    damaged, refers to vertices that are not there, or has no faces.
    """
    elements, comments = read_elements(data, notes)
    reader = _Properties(elements, notes)
    points = reader.columns("vertex", (("x", "y", "z"),))
    if reader.has_splats:
        notes.say(f" has Gaussian splats, which are left out: a model that {SPLATS}")
    if points is None:
        if reader.has_splats:
            raise FileFormatError(
                f"{path}: expected a mesh with faces, got Gaussian "
                f"splats, a model that {SPLATS}"
            )
        raise notes.damaged("a PLY file with vertices that have x, y and z", "none")
    corner, counts = reader.polygons(len(points))
    triangles, face = cut_up(points[corner], counts, notes)
    at = corner[triangles]
    normals = reader.columns("vertex", (("nx", "ny", "nz"),))
    uvs = reader.mapped(corner, counts, triangles)
    names = [
        match[1].strip()
        for comment in comments
        if (match := _TEXTURE.match(comment)) and match[1].strip()
    ]
    number = reader.texture_numbers(names, corner, counts)[face]
    tint = reader.colors(at, face)
    surfaces = [*reader.textures(names, plain=tint is None), ImportedSurface()]
    parts = list[ImportedPart]()
    mapped = np.full((len(at), 3), -1) if uvs is None else uvs.at
    for chosen in alike(number, np.asarray((mapped >= 0).all(axis=1))):
        surface = surfaces[number[chosen[0]]]
        colors = tint
        if tint is not None and surface.texture is not None:
            if tint[chosen].min() < 1.0:
                notes.say(
                    "colours of vertices or faces are left out where there is a texture"
                )
            colors = None
        elif tint is not None:
            surface = ImportedSurface(color=np.ones(3, np.float32))
        shading = None if normals is None else Looked(normals, at)
        parts.append(
            split_at_corners(chosen, Looked(points, at), shading, uvs, colors, surface)
        )
    return parts


@dataclass
class _Properties:
    elements: dict[str, Element]
    notes: Notes

    def __post_init__(self) -> None:
        for element in self.elements.values():
            if element.name in ("vertex", "face", "tristrips"):
                for name in element.types:
                    self.notes.has(f"{element.name} property", name)
            elif element.count:
                self.notes.has("element", element.name)

    @property
    def has_splats(self) -> bool:
        """Whether vertices are Gaussian splats: as 3D Gaussian Splatting writes them,
        or packed by PlayCanvas.
        """
        has = self.elements["vertex"].scalars if "vertex" in self.elements else {}
        return "f_dc_0" in has or "packed_position" in has

    def columns(self, element: str, names: Sequence[tuple[str, ...]]) -> Doubles | None:
        """Return the values (N, C) of the first of several groups of properties that an
        element has; None for none.
        """
        group = self._known(element, "scalars", *names)
        columns = [
            self.elements[element].scalars[name].astype(np.float64) for name in group
        ]
        return np.stack(columns, axis=1) if columns else None

    def _list(self, element: str, names: Sequence[str]) -> Lists | None:
        group = self._known(element, "listed", *((name,) for name in names))
        return self.elements[element].listed[group[0]] if group else None

    def _known(
        self, element: str, table: str, *groups: tuple[str, ...]
    ) -> tuple[str, ...]:
        """Take the first of several groups of properties that an element has, and
        return it; () for none.
        """
        has = getattr(self.elements.get(element), table, {})
        group = next(
            (group for group in groups if all(name in has for name in group)), ()
        )
        for name in group:
            self.notes.take(f"{element} property", name)
        return group

    def polygons(self, points: int) -> tuple[Ints, Ints]:
        """Return the vertices (C,) of the corners of all polygons, and how many corners
        each has, (P,); those of faces come first, then the triangles of strips. Raises
        FileFormatError: there are none, one has too many or too few corners, or refers
        to what is not there.
        """
        table = self.elements.get("face")
        names = (
            CORNERS
            if table is None
            else (*CORNERS, *(name for name in table.listed if name not in WEDGES))
        )
        faces = self._list("face", names)
        strips = self._list("tristrips", CORNERS)
        corners = np.zeros(0, np.int64)
        counts = np.zeros(0, np.int64)
        if faces is not None:
            corners = _whole(faces.values)
            counts = faces.counts
        if strips is not None:
            triangles = _of_strips(_whole(strips.values), strips.counts)
            corners = np.concatenate([corners, triangles.reshape(-1)])
            counts = np.concatenate([counts, np.full(len(triangles), 3)])
        if (counts < 3).all():
            what = "points or lines only; export triangles"
            if self.has_splats:
                what = f"Gaussian splats, a model that {SPLATS}"
            raise FileFormatError(
                f"{self.notes.path}: expected a mesh with faces, got {what}"
            )
        self.notes.check_most(
            int(counts.max()), MOST_CORNERS, "faces with at most {} corners"
        )
        self.notes.check_faces(int((counts - 2).clip(0).sum()))
        if corners.min() < 0 or corners.max() >= points:
            raise self.notes.damaged(
                "faces of its own vertices",
                "a face that refers to a vertex that is not there",
            )
        return corners, counts

    def mapped(self, corner: Ints, counts: Ints, triangles: Ints) -> Looked | None:
        """Return the texture coordinates of triangles, kept with the corners of faces,
        or else with vertices.
        """
        wedges = self._list("face", WEDGES)
        if wedges is None or not wedges.counts.any():
            values = self.columns("vertex", MAPPED)
            return None if values is None else Looked(values, corner[triangles])
        padded = np.zeros(len(counts), np.int64)
        padded[: len(wedges.counts)] = wedges.counts
        whole = padded == 2 * counts
        if not whole[padded > 0].all():
            self.notes.say(
                "texture coordinates of faces that are not two for each "
                "corner are left out"
            )
        used = (
            wedges.values[np.repeat(whole[: len(wedges.counts)], wedges.counts)]
            .astype(np.float64)
            .reshape(-1, 2)
        )
        values, same = np.unique(used.view(np.complex128), return_inverse=True)
        index = np.full(len(corner), -1)
        index[np.repeat(whole, counts)] = same.reshape(-1)
        return Looked(values.view(np.float64).reshape(-1, 2), index[triangles])

    def colors(self, at: Ints, face: Ints) -> Doubles | None:
        """Return the linear colours (T, 3, 3) of the corners of triangles, or None:
        those of vertices, unless these are all the same and those of faces are not.
        """
        channels = {}
        for element, index in (("vertex", at), ("face", face)):
            values = self.columns(element, COLORS)
            if values is None:
                continue
            table = self.elements[element]
            kind = table.types[self._known(element, "scalars", *COLORS)[0]]
            for name in set(ALPHAS) & set(table.scalars):
                alphas = table.scalars[name].astype(np.float64)
                if not len(alphas) or alphas.min() >= _scale(alphas[:, None], kind):
                    self.notes.take(f"{element} property", name)
            linear = srgb_to_linear(
                np.clip(np.nan_to_num(values / _scale(values, kind)), 0.0, 1.0).astype(
                    np.float32
                )
            )
            # of strips
            padded = np.concatenate(
                [linear, srgb_to_linear(np.full((1, 3), NEUTRAL, np.float32))]
            )
            colors = padded[np.minimum(index, len(linear))].astype(np.float64)
            channels[element] = (
                colors if element == "vertex" else np.repeat(colors[:, None], 3, axis=1)
            )
        if len(channels) < 2:
            return next(iter(channels.values()), None)
        better, other = (
            ("face", "vertices")
            if np.ptp(channels["vertex"]) == 0.0
            else ("vertex", "faces")
        )
        has = "faces" if better == "face" else "vertices"
        self.notes.say(f"colours of {other} are left out: its {has} have some, too")
        return channels[better]

    def texture_numbers(self, names: Sequence[str], corner: Ints, counts: Ints) -> Ints:
        """Return the number (P,) of each polygon's texture among several; -1 for
        none.
        """
        number = np.full(len(counts), -1)
        if not names:
            return number
        has = next(
            (
                kind
                for kind in ("face", "vertex")
                if self._known(kind, "scalars", ("texnumber",))
            ),
            None,
        )
        if has is None:
            if len(names) > 1:
                only = f"of its {len(names)} textures only {shown(names[0])} is used"
                self.notes.say(f"{only}, as its faces have no texnumber")
            return np.zeros(len(counts), np.int64)
        numbers = _whole(self.elements[has].scalars["texnumber"])
        if has == "face":
            number[: len(numbers)] = numbers
        else:
            number = numbers[
                corner[np.minimum(np.cumsum(counts) - counts, len(corner) - 1)]
            ]
        if wrong := int(((number < -1) | (number >= len(names))).sum()):
            self.notes.say(
                f"{wrong:,} faces have a texnumber of a texture that it "
                "does not name; they have none"
            )
        return np.where((number >= 0) & (number < len(names)), number, -1)

    def textures(self, names: Sequence[str], *, plain: bool) -> list[ImportedSurface]:
        """Return the surface of each texture; `plain` tells that there are no colours
        beside them.
        """
        pictures = FilePictures(
            len(names), References(Path(self.notes.path)), self.notes
        )
        surfaces = {}
        instead = (
            "neutral grey is" if plain else ("the colours of its vertices or faces are")
        )
        for name in dict.fromkeys(names):
            words = (
                f" names the texture {{name}}, which {{why}}; {instead} used instead"
            )
            picture = pictures.of_file(name, "colours and alpha", words)
            if picture is not None and picture[:, :, 3].min() < 1.0:
                self.notes.say(f"the alpha of {shown(name)} is left out")
            texture = (
                None if picture is None else np.ascontiguousarray(picture[:, :, :3])
            )
            surfaces[name] = ImportedSurface(texture=texture, name=name)
        return [surfaces[name] for name in names]


def _whole(values: npt.NDArray[np.generic]) -> Ints:
    if values.dtype.kind == "f":
        values = np.where(
            np.abs(values.astype(np.float64)) < 2.0**53, values.astype(np.float64), -1.0
        )
    return values.astype(np.int64)


def _scale(values: Doubles, kind: np.dtype[np.generic]) -> float:
    """Return what full brightness is in colours of a type: 1 for floats, unless they
    are those of bytes.
    """
    most = float(np.nan_to_num(values).max(initial=0.0))
    if kind.kind == "f":
        return 1.0 if most <= 2.0 else 255.0
    if kind.itemsize == 1 or (kind.itemsize > 2 and most <= 255.0):
        return 255.0
    return (
        65535.0
        if kind.itemsize == 2 or most <= 65535.0
        else 2.0 ** (8 * kind.itemsize - (kind.kind == "i")) - 1.0
    )


def _of_strips(vertices: Ints, counts: Ints) -> Ints:
    """Return the triangles (T, 3) of strips; -1 begins a strip anew, and every second
    triangle is wound backwards.
    """
    begins = np.zeros(len(vertices) + 1, dtype=np.bool_)
    begins[np.cumsum(counts) - counts] = True
    begins[1:][vertices < 0] = True
    place = np.arange(len(vertices)) - np.maximum.accumulate(
        np.where(begins[:-1], np.arange(len(vertices)), 0)
    )
    last = np.flatnonzero((place >= 2) & (vertices >= 0))
    triangles: Ints = np.stack(
        [vertices[last - 2], vertices[last - 1], vertices[last]], axis=1
    )
    odd = place[last] % 2 == 1
    triangles[odd] = triangles[odd][:, [1, 0, 2]]
    a, b, c = triangles.T
    return np.asarray(triangles[(a != b) & (b != c) & (a != c)])
