"""Reader of PLY files.

The format does not define the names of elements and properties; those of many programs
are known here.
"""

from __future__ import annotations

import re
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from advsearch.errors import FileFormatError
from advsearch.scene.assets import BoolArray, Float32Array, Float64Array, IntArray
from advsearch.scene.color import srgb_to_linear
from advsearch.scene.importing.files import (
    MAX_CORNERS,
    SPLATS_ADVICE,
    Notes,
    decode_text,
    format_name,
    is_number,
    parse_number_array,
)
from advsearch.scene.importing.geometry import triangulate_and_note
from advsearch.scene.importing.parts import (
    NEUTRAL_GREY,
    ImportedPart,
    ImportedSurface,
    IndexedValues,
    group_faces,
    make_part_from_corners,
)
from advsearch.scene.importing.pictures import FileImages
from advsearch.trust.named_files import ReferencedFiles

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
class ListValues:
    """The values of a list property, which has several values in each row."""

    counts: IntArray  # (N,) number of values in each row
    values: Numbers  # values of all rows, concatenated


@dataclass
class Element:
    """A table of a file: its properties, their types and their values."""

    name: str
    count: int  # number of its rows
    # Types of properties; for a list, the type of its values.
    type_by_property: dict[str, np.dtype[np.generic]] = field(default_factory=dict)
    # Types of the counts of lists.
    count_types: dict[str, np.dtype[np.generic]] = field(default_factory=dict)
    # Values (N,) of properties with one in each row.
    scalars: dict[str, Numbers] = field(default_factory=dict)
    # Values of list properties.
    lists: dict[str, ListValues] = field(default_factory=dict)


def read_elements(data: bytes, notes: Notes) -> tuple[dict[str, Element], list[str]]:
    """Return the elements of a PLY file by name, such as "vertex", and its comments.

    Args:
        data: the bytes of the file.
        notes: notes about the file.

    Raises:
        FileFormatError: the file is no PLY file, has an unknown header, or is shorter
            than its header states.
    """
    header_end = _find_header_end(data, notes)
    elements, comments, byte_order = _parse_header(
        decode_text(data[: header_end.start()]), notes
    )
    notes.check_faces(elements["face"].count if "face" in elements else 0)
    body = data[header_end.end() :]
    text = b"" if byte_order else body  # an ASCII file has no byte order
    cells = _read_cells(body, is_ascii=not byte_order)
    position = 0
    for element in elements.values():
        reader = _RowReader(notes, element, cells, text)
        # This fills in the element, and returns its end, where the next one begins.
        position = reader.read(position)
    return elements, comments


def _read_cells(body: bytes, *, is_ascii: bool) -> npt.NDArray[np.uint8]:
    """Return the bytes from which rows are read.

    The numbers of an ASCII file are first parsed to float64; then their bytes are read
    as those of a binary file.
    """
    if is_ascii:
        return parse_number_array(body, np.float64).view(np.uint8)
    return np.frombuffer(body, np.uint8)


def _find_header_end(data: bytes, notes: Notes) -> re.Match[bytes]:
    """Return the match of the last line of the header.

    Raises:
        FileFormatError: the file is no PLY file, or has no complete header.
    """
    has_magic = data.startswith(b"ply")
    # Some files end their lines in carriage returns alone. These are replaced only to
    # search for the end of the header, whose position stays the same.
    ends_in_returns = data.startswith(b"ply\r") and not data.startswith(b"ply\r\n")
    header_end = _END.search(data.replace(b"\r", b"\n") if ends_in_returns else data)
    if not has_magic or header_end is None:
        # If `got` is bytes, the message describes what kind of file they are.
        got = "half of one" if has_magic else data
        raise notes.damaged("a PLY file with a complete header", got)
    return header_end


def _parse_header(
    header: str, notes: Notes
) -> tuple[dict[str, Element], list[str], str]:
    """Parse the lines of a PLY header.

    A property belongs to the element above it. Its type has the byte order of the
    `format` line, which is above all elements.

    Raises:
        FileFormatError: a line is not understood, or there is no `format` line.

    Returns:
        The elements by name, with the types of their properties and no values yet; the
        comments; and the byte order, "<", ">" or empty for ASCII.
    """
    parsed_header = _Header()
    for line in header.splitlines()[1:]:  # the first line is "ply"
        if not parsed_header.add_line(line):
            raise notes.damaged(
                "a PLY header of elements and their properties",
                f"the line {format_name(line)}",
            )
    if parsed_header.byte_order is None:
        raise notes.damaged(
            f"a PLY header with a format of {', '.join(_FORMATS)}", "none of these"
        )
    return parsed_header.elements, parsed_header.comments, parsed_header.byte_order


@dataclass
class _Header:
    """What the lines of a PLY header state, up to one of them."""

    elements: dict[str, Element] = field(default_factory=dict)
    comments: list[str] = field(default_factory=list)
    byte_order: str | None = None  # "<", ">", or "" for ASCII; None if not stated yet
    last_element: Element | None = None  # the one to which properties belong

    def add_line(self, line: str) -> bool:
        """Store what a line states, and return whether it is understood."""
        match line.split():
            # It has the byte order of all properties, so it stands above the elements.
            case ["format", kind, *_] if kind in _FORMATS and not self.elements:
                self.byte_order = _FORMATS[kind]
            case ["comment" | "obj_info" as keyword, *_]:
                self.comments.append(line.strip().removeprefix(keyword).strip())
            case ["element", name, count] if self._is_new_element(name, count):
                self.last_element = Element(name, int(count))
                self.elements[name] = self.last_element
            case ["property", "list", count_kind, kind, name]:
                return self._add_property(name, kind, count_kind)
            case ["property", kind, name]:
                return self._add_property(name, kind)
            case []:
                pass
            case _:
                return False
        return True

    def _is_new_element(self, name: str, count: str) -> bool:
        """Return whether an element has no name of an earlier one, and a valid count."""
        # no more digits than 64 bits have
        is_count = count.isdecimal() and len(count) < 20
        return is_count and name not in self.elements

    def _add_property(
        self, name: str, kind: str, count_kind: str | None = None
    ) -> bool:
        """Add a property to the last element, and return whether it is valid.

        Args:
            name: name of the property, which must be new.
            kind: type of its values, such as "float".
            count_kind: type of the counts of a list; None for a scalar.
        """
        element = self.last_element
        has_kinds = kind in _TYPES and (count_kind is None or count_kind in _TYPES)
        if element is None or not has_kinds or name in element.type_by_property:
            return False
        element.type_by_property[name] = _make_dtype(kind, self.byte_order)
        if count_kind is not None:
            element.count_types[name] = _make_dtype(count_kind, self.byte_order)
        return True


def _make_dtype(kind: str, byte_order: str | None) -> np.dtype[np.generic]:
    """Return the type of numbers of a kind, such as "float".

    The byte order is that of the machine if `byte_order` is "" (of an ASCII file) or
    None (there is no `format` line, so that the file is refused).
    """
    return np.dtype((byte_order or "") + _TYPES[kind])


@dataclass
class _RowReader:
    """Reads the rows of an element.

    Attributes:
        notes: notes about the file.
        element: the element, whose values are filled in.
        cells: the bytes of the file's body; of an ASCII file, those of its numbers as
            float64.
        text: the body of an ASCII file; empty for a binary file.
        values: for each property an array with an entry for each byte of `cells`: the
            number of the property's type that begins there.
        counts: for each property that is a list, such an array of its counts. A list is
            its count and then its values.
        widths: for each property the bytes of a scalar, or of the count of a list.
    """

    notes: Notes
    element: Element
    cells: npt.NDArray[np.uint8]
    text: bytes

    def __post_init__(self) -> None:
        """Make the views of the bytes, and find the sizes of scalars and counts."""
        self.values = self._view_all(self.element.type_by_property)
        self.counts = self._view_all(self.element.count_types)
        # A list begins with its count. A property without counts is a scalar.
        self.widths = {
            name: self.counts.get(name, values).itemsize
            for name, values in self.values.items()
        }

    def _view_all(
        self, types: Mapping[str, np.dtype[np.generic]]
    ) -> dict[str, Numbers]:
        """Return `_view_from_any_byte` for each property, by its type."""
        return {name: self._view_from_any_byte(kind) for name, kind in types.items()}

    def read(self, position: int) -> int:
        """Read all rows, and return the position of the byte after them.

        Args:
            position: the byte at which the element begins.

        Raises:
            FileFormatError: the file ends early, or has a list of an impossible length.
        """
        has_properties = bool(self.widths)
        if not self.element.count or not has_properties:
            return position
        # The header may state any number of rows. Before memory is allocated for them,
        # check that the file is long enough at least for their scalars and counts.
        self._check_end(position + self.element.count * sum(self.widths.values()))
        # Rows are first assumed to be as long as the first one, which is fast. If the
        # rows would end beyond the file, or the lists at these positions differ in
        # length, that is wrong, and rows are walked one by one.
        starts, end = self._find_even_rows(position)
        if end > len(self.cells) or self._has_uneven_lists(starts):
            starts, end = self._walk_rows(position, self.element.count)
        self._store_values(starts)
        return end

    def _has_uneven_lists(self, starts: Mapping[str, IntArray]) -> bool:
        """Return whether some property has lists of several lengths.

        `starts` are, by property, the bytes (rows,) at which it begins in each row.
        """
        return any(
            np.ptp(count_at_byte[starts[name]]) != 0
            for name, count_at_byte in self.counts.items()
        )

    def _view_from_any_byte(self, kind: np.dtype[np.generic]) -> Numbers:
        """View the bytes as numbers of a type, one for each byte.

        Number i is read from byte i and those after it. So successive numbers overlap,
        and any of them can be read, wherever it begins. No byte is copied.

        Args:
            kind: type of the numbers in a binary file. The numbers of an ASCII file are
                stored as float64, whatever their type is.
        """
        is_ascii = bool(self.text)
        if is_ascii:
            kind = np.dtype(np.float64)
        n_numbers = max(0, len(self.cells) - kind.itemsize + 1)
        numbers: Numbers = np.ndarray(
            (n_numbers,), kind, buffer=self.cells, offset=0, strides=(1,)
        )
        return numbers

    def _find_even_rows(self, position: int) -> tuple[dict[str, IntArray], int]:
        """Return what `_walk_rows` does if all rows are as long as the first."""
        first_starts, first_end = self._walk_rows(position, 1)
        row_size = first_end - position
        row_offsets = row_size * np.arange(self.element.count)
        starts = {name: start + row_offsets for name, start in first_starts.items()}
        return starts, position + row_size * self.element.count

    def _walk_rows(self, position: int, n_rows: int) -> tuple[dict[str, IntArray], int]:
        """Walk through rows one by one, from the byte at a position.

        A row is its properties in their order. A list is a count and then its values.

        Returns:
            For each property the bytes at which it begins, (n_rows,); and the byte
            after the last row.
        """
        starts = {name: list[int]() for name in self.widths}
        byte = position
        for _ in range(n_rows):
            for name in self.widths:
                starts[name].append(byte)
                byte = self._find_property_end(name, byte)
        self._check_end(byte)
        arrays = {
            name: np.array(positions, dtype=np.int64)
            for name, positions in starts.items()
        }
        return arrays, byte

    def _find_property_end(self, name: str, byte: int) -> int:
        """Return the byte after a property that begins at a byte.

        Raises:
            FileFormatError: the file ends within the scalar or the count of the list,
                or the list has an impossible length.
        """
        end = byte + self.widths[name]
        self._check_end(end)
        is_list = name in self.counts
        if is_list:  # its values follow its count
            end += self.values[name].itemsize * self._read_length(name, byte)
        return end

    def _read_length(self, name: str, byte: int) -> int:
        """Return the length of the list that begins at a byte."""
        length = self.counts[name].item(byte)
        # The full file could not hold a longer list. A value has at least one byte, and
        # in an ASCII file the 8 bytes of a float64.
        min_value_size = 8 if self.text else 1
        max_length = len(self.cells) // min_value_size
        if not 0 <= length <= max_length:
            expected = f"lists in the PLY element {format_name(self.element.name)}"
            raise self.notes.damaged(expected, f"one of {length:g} values")
        return int(length)

    def _check_end(self, end: int) -> None:
        """Raise FileFormatError if the file has fewer bytes than `end`."""
        if end > len(self.cells):
            raise _make_length_error(self.notes, self.element, self.text)

    def _store_values(self, starts: Mapping[str, IntArray]) -> None:
        """Fill in the values of the element.

        `starts` are, by property, the bytes (rows,) at which it begins in each row.
        """
        for name, property_starts in starts.items():
            value_at_byte = self.values[name]
            if name in self.counts:
                lengths = self.counts[name][property_starts].astype(np.int64)
                first_values = property_starts + self.counts[name].itemsize
                self.element.lists[name] = _gather_lists(
                    value_at_byte, first_values, lengths
                )
            else:
                self.element.scalars[name] = value_at_byte[property_starts]


def _gather_lists(
    value_at_byte: Numbers, first_values: IntArray, lengths: IntArray
) -> ListValues:
    """Return the values of N lists, one list after the other.

    Args:
        value_at_byte: the number that begins at each byte.
        first_values: (N,) the byte of each list's first value.
        lengths: (N,) number of values of each list.
    """
    list_starts = np.cumsum(lengths) - lengths
    # 0, 1, ... in each list
    index_in_list = np.arange(int(lengths.sum())) - np.repeat(list_starts, lengths)
    value_bytes = (
        np.repeat(first_values, lengths) + value_at_byte.itemsize * index_in_list
    )
    return ListValues(lengths, value_at_byte[value_bytes])


def _make_length_error(notes: Notes, element: Element, text: bytes) -> FileFormatError:
    """Return the error for a file that ends within an element.

    The numbers of an ASCII file are parsed up to the first word that is no number. If
    there is one, the error names it.

    Args:
        notes: notes about the file.
        element: the element.
        text: the body of an ASCII file; empty for a binary file.
    """
    words = map(decode_text, text.split())
    odd_word = next((word for word in words if not is_number(word)), None)
    got = "fewer; the file is cut short"
    if odd_word is not None:
        got = f"{format_name(odd_word)} among their numbers"
    return notes.damaged(
        f"{element.count:,} rows of {format_name(element.name)}, as the PLY header "
        "states",
        got,
    )


COLOR_NAMES = (
    ("red", "green", "blue"),
    ("r", "g", "b"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
)
ALPHA_NAMES = ("alpha", "a", "diffuse_alpha")
UV_NAMES = (
    ("s", "t"),
    ("u", "v"),
    ("texture_u", "texture_v"),
    ("texture_s", "texture_t"),
    ("tx", "ty"),
    ("uv1", "uv2"),
)
WEDGE_UV_NAMES = ("texcoord", "texcoords", "texture_coordinates")
CORNER_NAMES = ("vertex_indices", "vertex_index", "vertex_indexes")
"""Names of properties with the same meaning, in the order in which they are tried."""
_TEXTURE = re.compile(r"texture_?file\s*[:=]?\s+(.*)", re.IGNORECASE)


def read_ply(path: Path, data: bytes, notes: Notes) -> list[ImportedPart]:
    """Read a PLY file as one part for each texture.

    Args:
        path: path of the file.
        data: its bytes.
        notes: notes about the file, to which sentences are added.

    Raises:
        FileFormatError: the file is corrupt, refers to missing vertices, or has no
            faces.
    """
    elements, comments = read_elements(data, notes)
    reader = _Properties(elements, notes)
    points = reader.read_columns("vertex", (("x", "y", "z"),))
    if reader.has_splats:
        notes.warn_that_file(
            f"has Gaussian splats, which are left out: {SPLATS_ADVICE}"
        )
    if points is None:
        raise _make_no_points_error(path, reader)
    return _make_parts(reader, points, _parse_texture_names(comments))


def _make_no_points_error(path: Path, reader: _Properties) -> FileFormatError:
    """Return the error for a file whose vertices have no x, y and z."""
    if reader.has_splats:
        return FileFormatError(
            f"{path}: expected a mesh with faces, got Gaussian splats: {SPLATS_ADVICE}"
        )
    return reader.notes.damaged("a PLY file with vertices that have x, y and z", "none")


def _combine_colors(
    surface: ImportedSurface,
    colors: Float64Array | None,
    group: IntArray,
    notes: Notes,
) -> tuple[ImportedSurface, Float64Array | None]:
    """Return the surface of a group of faces and the colors that multiply its color.

    A texture has precedence over the colors of vertices and faces.

    Args:
        surface: the surface of the faces.
        colors: (T, 3, 3) linear colors of the corners of all triangles, or None.
        group: indices of the triangles with the surface.
        notes: notes about the file.
    """
    if colors is None:
        return surface, None
    if surface.texture is None:
        # The file has no other material. White does not change the colors.
        return ImportedSurface(color=np.ones(3, np.float32)), colors
    if colors[group].min() < 1.0:
        notes.warn("colours of vertices or faces are left out where there is a texture")
    return surface, None


def _make_parts(
    reader: _Properties, points: Float64Array, texture_names: Sequence[str]
) -> list[ImportedPart]:
    """Return the faces of a file as parts.

    There is a part for each texture. Faces without texture coordinates are in separate
    parts.

    Args:
        reader: reads the properties of vertices and faces.
        points: (N, 3) positions of the vertices.
        texture_names: files of textures that the comments name.
    """
    notes = reader.notes
    corners, counts = reader.read_polygons(len(points))
    triangles, polygon = triangulate_and_note(points[corners], counts, notes)
    position = IndexedValues(points, corners[triangles])
    normal = reader.read_normals(position.row_of_corner)
    uvs = reader.read_uvs(corners, counts, triangles)
    polygon_textures = reader.read_texture_indices(texture_names, corners, counts)
    texture = polygon_textures[polygon]
    colors = reader.read_colors(position.row_of_corner, polygon)
    surfaces = reader.make_surfaces(texture_names, has_no_colors=colors is None)
    parts = list[ImportedPart]()
    for group in group_faces(texture, _find_mapped_triangles(uvs, len(triangles))):
        surface = surfaces[texture[group[0]]]
        surface, tint = _combine_colors(surface, colors, group, notes)
        parts.append(
            make_part_from_corners(group, position, normal, uvs, tint, surface)
        )
    return parts


def _find_mapped_triangles(uvs: IndexedValues | None, n_triangles: int) -> BoolArray:
    """Return which triangles (T,) have texture coordinates at all corners."""
    if uvs is None:
        return np.zeros(n_triangles, np.bool_)
    return np.asarray((uvs.row_of_corner >= 0).all(axis=1))


def _parse_texture_names(comments: Sequence[str]) -> list[str]:
    """Return the names of textures in comments, as MeshLab writes them."""
    names = []
    for comment in comments:
        match = _TEXTURE.match(comment)
        if match and match[1].strip():
            names.append(match[1].strip())
    return names


@dataclass
class _Properties:
    """Reads the properties of elements by the names that programs give them."""

    elements: dict[str, Element]
    notes: Notes

    def __post_init__(self) -> None:
        """Record all properties, so that those that are never read are noted."""
        for element in self.elements.values():
            if element.name in ("vertex", "face", "tristrips"):
                for name in element.type_by_property:
                    self.notes.record(f"{element.name} property", name)
            elif element.count:
                self.notes.record("element", element.name)

    @property
    def has_splats(self) -> bool:
        """Whether vertices are Gaussian splats, plain or packed by PlayCanvas."""
        properties: Mapping[str, Numbers] = {}
        if "vertex" in self.elements:
            properties = self.elements["vertex"].scalars
        return "f_dc_0" in properties or "packed_position" in properties

    def read_columns(
        self, element: str, groups: Sequence[tuple[str, ...]]
    ) -> Float64Array | None:
        """Return the values (N, C) of the first group of properties that exists.

        Args:
            element: name of the element.
            groups: groups of C properties each.

        Returns:
            The values as float64, or None if the element has none of the groups.
        """
        scalars = self._get_scalars(element)
        group = self._find_group(element, scalars, groups)
        if not group:
            return None
        return np.stack([scalars[name].astype(np.float64) for name in group], axis=1)

    def _find_list(self, element: str, names: Sequence[str]) -> ListValues | None:
        """Return the first of several list properties that an element has, or None."""
        if element not in self.elements:
            return None
        lists = self.elements[element].lists
        group = self._find_group(element, lists, [(name,) for name in names])
        return lists[group[0]] if group else None

    def _get_scalars(self, element: str) -> Mapping[str, Numbers]:
        """Return the scalar properties of an element; {} if it does not exist."""
        return self.elements[element].scalars if element in self.elements else {}

    def _find_group(
        self,
        element: str,
        properties: Container[str],
        groups: Iterable[tuple[str, ...]],
    ) -> tuple[str, ...]:
        """Return the first group of names that are all properties, () if none is.

        The properties of that group are marked as read.

        Args:
            element: name of the element.
            properties: names of the element's properties.
            groups: groups of names, such as ("red", "green", "blue").
        """
        for group in groups:
            if all(name in properties for name in group):
                for name in group:
                    self.notes.mark_read(f"{element} property", name)
                return group
        return ()

    def read_normals(self, row_of_corner: IntArray) -> IndexedValues | None:
        """Return the normals of vertices for the corners (T, 3) of triangles, or None."""
        normals = self.read_columns("vertex", (("nx", "ny", "nz"),))
        return None if normals is None else IndexedValues(normals, row_of_corner)

    def read_polygons(self, n_points: int) -> tuple[IntArray, IntArray]:
        """Return the polygons of the file: its faces, then the triangles of strips.

        Args:
            n_points: number of vertices.

        Returns:
            The vertices (C,) of the corners of all polygons, concatenated, and the
            number of corners of each, (P,).

        Raises:
            FileFormatError: there is no polygon with 3 corners, one has too many, or
                refers to a missing vertex.
        """
        faces = self._find_corner_lists()
        strips = self._find_list("tristrips", CORNER_NAMES)
        corners = np.zeros(0, np.int64)
        counts = np.zeros(0, np.int64)
        if faces is not None:
            corners = _to_integers(faces.values)
            counts = faces.counts
        if strips is not None:
            triangles = _split_strips(_to_integers(strips.values), strips.counts)
            corners = np.concatenate([corners, triangles.reshape(-1)])
            counts = np.concatenate([counts, np.full(len(triangles), 3)])
        self._check_polygons(corners, counts, n_points)
        return corners, counts

    def _find_corner_lists(self) -> ListValues | None:
        """Return the vertices of the corners of each face, or None.

        If no list of the faces has one of the known names, any other list is returned,
        except for texture coordinates.
        """
        names: tuple[str, ...] = CORNER_NAMES
        if "face" in self.elements:
            lists = self.elements["face"].lists
            names += tuple(name for name in lists if name not in WEDGE_UV_NAMES)
        return self._find_list("face", names)

    def _check_polygons(
        self, corners: IntArray, counts: IntArray, n_points: int
    ) -> None:
        """Check the polygons of the file.

        Args:
            corners: (C,) the vertex of each corner of the polygons.
            counts: (P,) number of corners of each polygon.
            n_points: number of vertices.

        Raises:
            FileFormatError: there is no polygon with 3 corners, one has too many, or
                refers to a missing vertex.
        """
        if (counts < 3).all():
            raise self._make_no_polygons_error()
        self.notes.check_most(
            int(counts.max()), MAX_CORNERS, "faces with at most {} corners"
        )
        self.notes.check_faces(int((counts - 2).clip(0).sum()))
        if corners.min() < 0 or corners.max() >= n_points:
            raise self.notes.damaged(
                "faces of its own vertices",
                "a face that refers to a vertex that does not exist",
            )

    def _make_no_polygons_error(self) -> FileFormatError:
        """Return the error for a file without a polygon of 3 or more corners."""
        got = "points or lines only; export triangles"
        if self.has_splats:
            got = f"Gaussian splats: {SPLATS_ADVICE}"
        return FileFormatError(
            f"{self.notes.path}: expected a mesh with faces, got {got}"
        )

    def read_uvs(
        self, corners: IntArray, counts: IntArray, triangles: IntArray
    ) -> IndexedValues | None:
        """Return the texture coordinates of triangles, or None if there are none.

        Files store them with the corners of faces (MeshLab calls these wedges), or else
        with vertices.

        Args:
            corners: (C,) the vertex of each corner of the polygons.
            counts: (P,) how many corners each polygon has.
            triangles: (T, 3) corners.
        """
        wedges = self._find_list("face", WEDGE_UV_NAMES)
        if wedges is not None and wedges.counts.any():  # not all lists are empty
            return self._read_wedge_uvs(wedges, counts, triangles)
        vertex_uvs = self.read_columns("vertex", UV_NAMES)
        if vertex_uvs is None:
            return None
        return IndexedValues(vertex_uvs, corners[triangles])

    def _read_wedge_uvs(
        self, wedges: ListValues, counts: IntArray, triangles: IntArray
    ) -> IndexedValues:
        """Return the texture coordinates of triangles from the lists of faces.

        A face must have two numbers for each of its corners. Others have no texture
        coordinates, which is noted.

        Args:
            wedges: the list of each face: u, v, u, v, ...
            counts: (P,) how many corners each polygon has.
            triangles: (T, 3) corners of the polygons.
        """
        # Faces are the first polygons. Triangles of strips, which follow, have no
        # wedges.
        n_faces = len(wedges.counts)
        is_mapped = self._find_mapped_polygons(wedges, counts)
        # (wedge values,) and (corners,): whether they are of a face with coordinates
        is_used_value = np.repeat(is_mapped[:n_faces], wedges.counts)
        is_mapped_corner = np.repeat(is_mapped, counts)
        corner_uvs = wedges.values[is_used_value].astype(np.float64).reshape(-1, 2)
        distinct_uvs, index_of_uv = _find_distinct_pairs(corner_uvs)
        uv_of_corner = np.full(int(counts.sum()), -1)  # -1 for none
        uv_of_corner[is_mapped_corner] = index_of_uv
        return IndexedValues(distinct_uvs, uv_of_corner[triangles])

    def _find_mapped_polygons(self, wedges: ListValues, counts: IntArray) -> BoolArray:
        """Return which polygons (P,) have two wedge values for each corner.

        Faces with values, but another number of them, are noted.
        """
        n_faces = len(wedges.counts)
        wedge_counts = np.zeros(len(counts), np.int64)
        wedge_counts[:n_faces] = wedges.counts
        is_mapped = wedge_counts == 2 * counts
        if not is_mapped[wedge_counts > 0].all():
            self.notes.warn(
                "texture coordinates of faces that are not two for each "
                "corner are left out"
            )
        return np.asarray(is_mapped)

    def read_colors(
        self, vertices: IntArray, polygons: IntArray
    ) -> Float64Array | None:
        """Return the linear colors (T, 3, 3) of the corners of triangles, or None.

        If both vertices and faces have colors, those of vertices are used, unless all
        vertices have the same one.

        Args:
            vertices: (T, 3) vertices of the triangles.
            polygons: (T,) polygon of each triangle.
        """
        vertex_colors = self._read_element_colors("vertex", vertices)
        face_colors = self._read_element_colors("face", polygons)
        if face_colors is not None:
            face_colors = np.repeat(face_colors[:, None], 3, axis=1)
        if vertex_colors is None or face_colors is None:
            return face_colors if vertex_colors is None else vertex_colors
        if (vertex_colors == vertex_colors[:1, :1]).all():
            self.notes.warn(
                "colours of vertices are left out: its faces have some, too"
            )
            return face_colors
        self.notes.warn("colours of faces are left out: its vertices have some, too")
        return vertex_colors

    def _read_element_colors(
        self, element: str, index: IntArray
    ) -> Float64Array | None:
        """Return the linear colors (..., 3) of rows of an element, or None.

        Triangles of strips have no row among the faces. Their index is beyond the last
        row, and their color is neutral grey.

        Args:
            element: name of the element, "vertex" or "face".
            index: (...) rows of the element.
        """
        values = self.read_columns(element, COLOR_NAMES)
        if values is None:
            return None
        full_brightness = _find_scale(values, self._find_color_type(element))
        display = np.clip(np.nan_to_num(values / full_brightness), 0.0, 1.0)
        linear = srgb_to_linear(display.astype(np.float32))
        neutral = srgb_to_linear(np.full((1, 3), NEUTRAL_GREY, np.float32))
        padded = np.concatenate([linear, neutral])
        neutral_row = len(linear)
        return padded[np.minimum(index, neutral_row)].astype(np.float64)

    def _find_color_type(self, element: str) -> np.dtype[np.generic]:
        """Return the type of the colors of an element, and mark opaque alphas as read.

        All three channels are assumed to have the type of red, which the file may name
        "red" or "diffuse_red". Alphas have the scale of the colors, so that it is known
        here whether they are opaque.
        """
        scalars = self.elements[element].scalars
        red_name, _, _ = self._find_group(element, scalars, COLOR_NAMES)
        color_type = self.elements[element].type_by_property[red_name]
        self._mark_opaque_alphas(element, color_type)
        return color_type

    def _mark_opaque_alphas(
        self, element: str, color_type: np.dtype[np.generic]
    ) -> None:
        """Mark alphas of an element as read if they are opaque everywhere.

        Then they are not noted. Other alphas are noted as all unread properties are.
        """
        scalars = self.elements[element].scalars
        for name in set(ALPHA_NAMES) & set(scalars):
            alphas = scalars[name].astype(np.float64)
            if not len(alphas):
                self.notes.mark_read(f"{element} property", name)
                continue
            opaque_alpha = _find_scale(alphas[:, None], color_type)  # such as 255
            if alphas.min() >= opaque_alpha:
                self.notes.mark_read(f"{element} property", name)

    def read_texture_indices(
        self, names: Sequence[str], corners: IntArray, counts: IntArray
    ) -> IntArray:
        """Return the index of each polygon's texture, (P,); -1 for none.

        It is the `texnumber` of faces, or that of a face's first vertex. Without
        either, all polygons have the first texture. A number without a texture of the
        file is noted.

        Args:
            names: the textures of the file.
            corners: (C,) the vertex of each corner of the polygons.
            counts: (P,) how many corners each polygon has.
        """
        if not names:
            return np.full(len(counts), -1)
        element = self._find_element_with_texture_number()
        if element is None:
            self._note_single_texture(names)
            return np.zeros(len(counts), np.int64)
        texture = self._read_texture_numbers(element, corners, counts)
        return self._remove_wrong_numbers(texture, len(names))

    def _remove_wrong_numbers(self, texture: IntArray, n_textures: int) -> IntArray:
        """Return indices of textures (P,), -1 for those that do not exist, with a note."""
        is_wrong = (texture < -1) | (texture >= n_textures)
        n_wrong = int(is_wrong.sum())
        if n_wrong:
            self.notes.warn(
                f"{n_wrong:,} faces have a texnumber for which the file names no "
                "texture; they have none"
            )
        return np.where(is_wrong, -1, texture)

    def _note_single_texture(self, names: Sequence[str]) -> None:
        """Note that only the first of several textures is used."""
        if len(names) > 1:
            self.notes.warn(
                f"of its {len(names)} textures only {format_name(names[0])} is "
                "used, as its faces have no texnumber"
            )

    def _read_texture_numbers(
        self, element: str, corners: IntArray, counts: IntArray
    ) -> IntArray:
        """Return the `texnumber` of each polygon, (P,), as the file states it.

        Args:
            element: the element that has them, "face" or "vertex".
            corners: (C,) the vertex of each corner of the polygons.
            counts: (P,) how many corners each polygon has.
        """
        numbers = _to_integers(self.elements[element].scalars["texnumber"])
        if element == "face":
            texture = np.full(len(counts), -1)
            texture[: len(numbers)] = numbers  # triangles of strips keep -1
            return texture
        first_corner = np.cumsum(counts) - counts
        # Polygons without corners at the end would begin past the last corner.
        first_corner = np.minimum(first_corner, len(corners) - 1)
        texture_numbers: IntArray = numbers[corners[first_corner]]
        return texture_numbers

    def _find_element_with_texture_number(self) -> str | None:
        """Return which element has a `texnumber`: faces, else vertices, or none."""
        for element in ("face", "vertex"):
            scalars = self._get_scalars(element)
            if self._find_group(element, scalars, [("texnumber",)]):
                return element
        return None

    def make_surfaces(
        self, names: Sequence[str], *, has_no_colors: bool
    ) -> list[ImportedSurface]:
        """Return the surface of each texture, and one without texture as the last.

        The last one is also found by the index -1 of faces without a texture. The alpha
        of textures is left out, with a note if it is not opaque.

        Args:
            names: names of the texture files.
            has_no_colors: whether the file has no colors that could replace a texture.
        """
        references = ReferencedFiles(Path(self.notes.path))
        # Each texture is the surface of one material.
        pictures = FileImages(
            materials=len(names), references=references, notes=self.notes
        )
        substitute = "the colours of its vertices or faces are"
        if has_no_colors:
            substitute = "neutral grey is"
        # The blank makes the file the subject: "chair.ply names the texture ...".
        note_template = (
            f" names the texture {{name}}, which {{why}}; {substitute} used instead"
        )
        surfaces = {}
        for name in dict.fromkeys(names):
            texture = self._load_opaque_texture(pictures, name, note_template)
            surfaces[name] = ImportedSurface(texture=texture, name=name)
        return [*(surfaces[name] for name in names), ImportedSurface()]

    def _load_opaque_texture(
        self, pictures: FileImages, name: str, note_template: str
    ) -> Float32Array | None:
        """Return the texture (H, W, 3) of a file without its alpha, or None with a note."""
        texture = pictures.load_file(name, "colours and alpha", note_template)
        if texture is None:
            return None
        if texture[:, :, 3].min() < 1.0:
            self.notes.warn(f"the alpha of {format_name(name)} is left out")
        return np.ascontiguousarray(texture[:, :, :3])


def _find_distinct_pairs(pairs: Float64Array) -> tuple[Float64Array, IntArray]:
    """Return the distinct pairs (D, 2) out of pairs (N, 2), and the index of each, (N,).

    As complex numbers, u + v i, pairs are compared as single values.
    """
    distinct_pairs, index_of_pair = np.unique(
        pairs.view(np.complex128), return_inverse=True
    )
    distinct = distinct_pairs.view(np.float64).reshape(-1, 2)
    return distinct, index_of_pair.reshape(-1)


def _to_integers(values: npt.NDArray[np.generic]) -> IntArray:
    """Return values as integers; -1 for NaN, and for floats too large to be exact.

    A float64 of 2^53 or more may be a rounded integer.
    """
    if values.dtype.kind == "f":
        numbers = values.astype(np.float64)
        values = np.where(np.abs(numbers) < 2.0**53, numbers, -1.0)
    return values.astype(np.int64)


def _find_scale(values: Float64Array, kind: np.dtype[np.generic]) -> float:
    """Return the value of full brightness in colors (N, C) of a type.

    For floats it is 1, or 255 if some are clearly over 1. For integers of 8 bits it is
    255, and for 16 bits 65535. Wider integers often hold values of a narrower type. For
    these it is the smallest of 255, 65535 and the type's largest value that no color
    exceeds.
    """
    largest = float(np.nan_to_num(values).max(initial=0.0))
    if kind.kind == "f":
        return 1.0 if largest <= 2.0 else 255.0  # some are a little over 1
    if kind.itemsize == 1 or (kind.itemsize > 2 and largest <= 255.0):
        return 255.0
    if kind.itemsize == 2 or largest <= 65535.0:
        return 65535.0
    n_bits = 8 * kind.itemsize
    if kind.kind == "i":
        n_bits -= 1  # the sign
    return 2.0**n_bits - 1.0


def _split_strips(vertices: IntArray, counts: IntArray) -> IntArray:
    """Return the triangles (T, 3) of triangle strips.

    Each three successive vertices of a strip are a triangle. Every second triangle is
    wound backwards, so two of its corners are swapped here. A vertex of -1 ends a
    strip; a new one begins after it. Triangles with a repeated vertex are left out.

    Args:
        vertices: the vertices of all strips, concatenated.
        counts: (S,) how many vertices each strip has.
    """
    is_end_mark = vertices < 0
    position = _find_positions_in_strips(is_end_mark, counts)
    # Every vertex of a strip, except the first two, is the last one of a triangle.
    last_corner = np.flatnonzero((position >= 2) & ~is_end_mark)
    triangles: IntArray = np.stack(
        [vertices[last_corner - 2], vertices[last_corner - 1], vertices[last_corner]],
        axis=1,
    )
    # The first triangle of a strip ends at position 2. Every second one is reversed:
    # its first two corners are swapped.
    is_reversed = position[last_corner] % 2 == 1
    triangles[is_reversed] = triangles[is_reversed][:, [1, 0, 2]]
    a, b, c = triangles.T
    is_degenerate = (a == b) | (b == c) | (a == c)
    return np.asarray(triangles[~is_degenerate])


def _find_positions_in_strips(is_end_mark: BoolArray, counts: IntArray) -> IntArray:
    """Return the position (N,) of each vertex in its strip, from 0.

    Strips start at the beginning of each list, and after each end mark.

    Args:
        is_end_mark: (N,) which vertices of all lists end a strip.
        counts: (S,) how many vertices each list has.
    """
    # An end mark may be the last vertex, and an empty list may be the last one: then
    # the start is beyond the last vertex, and there is one entry more for it.
    is_strip_start = np.zeros(len(is_end_mark) + 1, dtype=np.bool_)
    list_starts = np.cumsum(counts) - counts
    is_strip_start[list_starts] = True
    is_strip_start[np.flatnonzero(is_end_mark) + 1] = True
    # (N,) for each vertex its index, and the index of its strip's first vertex
    index = np.arange(len(is_end_mark))
    strip_start = np.maximum.accumulate(np.where(is_strip_start[:-1], index, 0))
    index_in_strip: IntArray = index - strip_start
    return index_in_strip
