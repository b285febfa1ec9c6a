"""Reader of Wavefront OBJ files.

Statements with numbers (``v``, ``vt``, ``vn``, ``f``) are parsed as arrays, since a
file may have millions of lines. All other statements are parsed line by line.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np
import numpy.typing as npt

from advsearch.errors import FileFormatError
from advsearch.scene.assets import (
    BoolArray,
    Float64Array,
    IntArray,
    compute_area_vectors,
)
from advsearch.scene.color import srgb_to_linear
from advsearch.scene.importing import mtl_surfaces
from advsearch.scene.importing.files import (
    MAX_CORNERS,
    Notes,
    decode_text,
    format_name,
    is_number,
    parse_number_array,
)
from advsearch.scene.importing.geometry import triangulate_and_note
from advsearch.scene.importing.mtl_surfaces import (
    MtlReader,
    MtlSurface,
    find_libraries,
    without_comment,
)
from advsearch.scene.importing.parts import (
    NEUTRAL_GREY,
    ImportedPart,
    ImportedSurface,
    IndexedValues,
    group_faces,
    make_part_from_corners,
)
from advsearch.trust.named_files import ReferencedFiles

# Statements that only name groups of faces; all groups are joined.
GROUPING = frozenset(("g", "o"))
FREE_FORM = (
    "bmat bsp bzp cdc cdp con cstype curv curv2 deg end hole mg parm res scrv "
    "sp step surf trim vp"
).split()
NON_FACE_STATEMENTS = {
    "p": "points",
    "l": "lines",
    **dict.fromkeys(FREE_FORM, "curves and curved surfaces"),
}
# Limit of the material files, and of the materials, that a file may name; before
# `scale_limit`.
MAX_MATERIALS = 10_000
# Texture coordinates may be outside [0, 1] by this much before the wrap mode matters.
WRAP_TOLERANCE = 0.01
# First words of a smoothing group (``s``) that turn smoothing off.
NOT_SMOOTH = ("off", "0", "")


def _triangulate_faces(
    tables: Mapping[str, Float64Array],
    corners: IntArray,
    corner_counts: IntArray,
    notes: Notes,
) -> tuple[IndexedValues, IndexedValues, IndexedValues, IntArray]:
    """Return points, UVs and normals of the triangles, and the polygon of each.

    Args:
        tables: points, UVs and normals of the file, by the keywords "v", "vt" and "vn".
        corners: (C, 3) rows in these three tables of the corners of all polygons.
        corner_counts: the number of corners of each polygon.
        notes: notes about the file.
    """
    points = tables["v"][:, :3]
    triangles, polygon = triangulate_and_note(
        points[corners[:, 0]], corner_counts, notes
    )
    position = IndexedValues(points, corners[triangles, 0])
    uv = IndexedValues(tables["vt"], corners[triangles, 1])
    normal = IndexedValues(tables["vn"], corners[triangles, 2])
    return position, uv, normal, polygon


def _transform_uvs(
    uv: IndexedValues, square: int, mtl_surface: MtlSurface
) -> IndexedValues:
    """Return texture coordinates after the transform of a material's textures.

    They are measured from the corner of their UDIM square, then scaled (``-s``) and
    shifted (``-o``).

    Args:
        uv: texture coordinates of the file.
        square: number of the UDIM square, such as 1001; 0 for none.
        mtl_surface: the material.
    """
    corner = mtl_surfaces.get_square_corner(square)
    uvs = (uv.values - corner) * mtl_surface.scale + mtl_surface.offset
    return IndexedValues(uvs, uv.row_of_corner)


def _note_repetition(uvs: Float64Array, notes: Notes) -> None:
    """Note that clamped textures repeat here, if UVs reach beyond their edges."""
    if _reaches_beyond(uvs):
        notes.warn_that_file(
            "has textures that must not repeat beyond their edges (-clamp); here they "
            "do"
        )


@dataclass(frozen=True, eq=False)
class _Triangles:
    """The T triangles of a file, with the material and smoothing in effect.

    Attributes:
        position: points of their corners.
        uv: texture coordinates of their corners.
        normal: normals of their corners.
        colors: (T, 3, 3) linear colors of their corners, None if the file has none.
        material_names: names of the materials.
        material_index: (T,) index of the material; -1 before the first ``usemtl``.
        udim_square: (T,) UDIM square; 0 if the material has one image for all squares.
        is_flat: (T,) whether smoothing is off.
        has_uvs: (T,) whether all corners have texture coordinates.
    """

    position: IndexedValues
    uv: IndexedValues
    normal: IndexedValues
    colors: Float64Array | None
    material_names: Sequence[str]
    material_index: IntArray
    udim_square: IntArray
    is_flat: BoolArray
    has_uvs: BoolArray

    def get_material_name(self, triangle: int) -> str:
        """Return the name of a triangle's material, "" if it has none."""
        index = self.material_index[triangle]
        return self.material_names[index] if index >= 0 else ""

    def measure_mapped_faces(
        self, material_name: str, square: int
    ) -> tuple[Float64Array, Float64Array]:
        """Return UVs (F, 3, 2) and doubled areas (F,) of the triangles with a material.

        Triangles of another UDIM square, and those without UVs, are left out.
        """
        material = self.material_names.index(material_name)
        is_selected = (self.material_index == material) & (self.udim_square == square)
        is_selected = is_selected & self.has_uvs
        uvs = self.uv.values[self.uv.row_of_corner[is_selected]]
        points = self.position.values[self.position.row_of_corner[is_selected]]
        return uvs, np.linalg.norm(compute_area_vectors(points), axis=1)


def read_obj(path: Path, data: bytes, notes: Notes) -> list[ImportedPart]:
    """Read an OBJ file and the material files that it names.

    Faces with the same material, smoothing and UDIM square become one part. Those
    without texture coordinates become a separate part.

    Args:
        path: path of the file.
        data: its bytes.
        notes: notes about the file, to which sentences are added.

    Raises:
        FileFormatError: the file is of another kind, is cut short, refers to geometry
            that it does not contain, or has no faces.
    """
    lines = ObjLines(data, notes)
    tables = _read_tables(lines, data)
    faces = lines.read_faces({kind: len(table) for kind, table in tables.items()})
    _, corner_counts, _ = faces
    _check_has_faces(path, corner_counts)
    statements = _parse_statements(lines, notes)

    def find_mapped_faces(name: str, square: int) -> tuple[Float64Array, Float64Array]:
        """Return UVs and areas of the triangles with a material.

        The reader calls this when it converts a material, after `triangles` is set.
        """
        return triangles.measure_mapped_faces(name, square)

    reader = MtlReader(ReferencedFiles(path), notes, find_mapped_faces)
    _read_libraries(reader, statements.library_lines, notes)
    triangles = _make_triangles(lines, tables, faces, statements, reader)
    names_libraries = bool(statements.library_lines)
    return [
        _make_part(triangles, group, reader, names_libraries)
        for group in _group_triangles(triangles)
    ]


def _read_tables(lines: ObjLines, data: bytes) -> dict[str, Float64Array]:
    """Return the points, UVs and normals of a file, by the keywords "v", "vt" and "vn".

    Raises:
        FileFormatError: a line is wrong, or there are no points, so that `data`, the
            content of the file, is of another kind.
    """
    tables = {kind: lines.read_table(kind) for kind in TABLES}
    if not len(tables["v"]):
        raise lines.notes.damaged(EXPECTED, got=data)
    return tables


def _check_has_faces(path: Path, corner_counts: IntArray) -> None:
    """Raise FileFormatError if all polygons have fewer than 3 corners."""
    if (corner_counts < 3).all():
        raise FileFormatError(
            f"{path}: expected a mesh with faces, got points or "
            "lines only; export triangles"
        )


def _group_triangles(triangles: _Triangles) -> list[IntArray]:
    """Return the triangles of each part; see `read_obj`."""
    return group_faces(
        triangles.material_index,
        triangles.has_uvs,
        triangles.is_flat,
        triangles.udim_square,
    )


def _make_triangles(
    lines: ObjLines,
    tables: Mapping[str, Float64Array],
    faces: tuple[IntArray, IntArray, IntArray],
    statements: _Statements,
    reader: MtlReader,
) -> _Triangles:
    """Return the triangles of a file's faces, with the statements in effect.

    Args:
        lines: lines of the file.
        tables: points, UVs and normals of the file, by the keywords "v", "vt" and "vn".
        faces: result of `ObjLines.read_faces`: corners, counts, rows of lines.
        statements: material and smoothing statements, with the rows of their lines.
        reader: reader of the materials.
    """
    notes = lines.notes
    corners, corner_counts, face_rows = faces
    position, uv, normal, polygon = _triangulate_faces(
        tables, corners, corner_counts, notes
    )
    rows = face_rows[polygon]  # of each triangle, the row of its face's line
    names, material = _find_values_in_effect(statements.material_changes, rows)
    notes.check_most(len(names), MAX_MATERIALS, "at most {} materials")
    is_flat = _find_flat_faces(statements.smoothing_changes, rows, normal, notes)
    vertex_colors = _read_colors(lines, tables["v"], notes)
    return _Triangles(
        position=position,
        uv=uv,
        normal=normal,
        colors=None if vertex_colors is None else vertex_colors[position.row_of_corner],
        material_names=names,
        material_index=material,
        udim_square=_find_squares(reader, names, material, uv),
        is_flat=is_flat,
        has_uvs=np.asarray((uv.row_of_corner >= 0).all(axis=1)),
    )


def _make_part(
    triangles: _Triangles, group: IntArray, reader: MtlReader, names_libraries: bool
) -> ImportedPart:
    """Return a group of triangles with the same material, UDIM square and smoothing.

    Args:
        triangles: all triangles of the file.
        group: indices of the triangles of the group. Either all or none have UVs.
        reader: reader of the materials.
        names_libraries: whether the file names material files; otherwise a missing
            material gets a note about that.
    """
    first = group[0]  # all triangles of the group have the same properties
    name = triangles.get_material_name(first)
    square = int(triangles.udim_square[first])
    has_colors = triangles.colors is not None
    mtl_surface = _find_material(reader, name, square, has_colors, names_libraries)
    surface, corner_colors = _combine_colors(
        mtl_surface.surface, triangles.colors, group, reader.notes
    )
    uv = _transform_uvs(triangles.uv, square, mtl_surface)
    if mtl_surface.is_clamped and triangles.has_uvs[first]:
        _note_repetition(uv.values[uv.row_of_corner[group]], reader.notes)
    return make_part_from_corners(
        group,
        points=triangles.position,
        normals=triangles.normal,
        uvs=uv,
        colors=corner_colors,
        surface=surface,
        flat=bool(triangles.is_flat[first]),
    )


def _read_libraries(
    reader: MtlReader, library_lines: Sequence[str], notes: Notes
) -> None:
    """Read the material files that ``mtllib`` lines name."""
    unique_lines = list(dict.fromkeys(library_lines))
    notes.check_most(
        len(unique_lines),
        MAX_MATERIALS,
        "at most {} lines that name material files (mtllib)",
    )
    libraries = find_libraries(unique_lines, reader.references)
    notes.check_most(len(libraries), MAX_MATERIALS, "at most {} material files")
    for name in libraries:
        reader.read_library(name)


def _find_flat_faces(
    smoothing_changes: list[tuple[int, str]],
    rows: IntArray,
    normal: IndexedValues,
    notes: Notes,
) -> BoolArray:
    """Return for each triangle whether smoothing is off, (T,).

    Before the first ``s`` statement it is on. The numbers of smoothing groups are not
    read, which is noted if normals have to be computed.

    Args:
        smoothing_changes: rows of the ``s`` lines, and their words, such as "off".
        rows: (T,) row of each triangle's face line.
        normal: normals of the triangles' corners.
        notes: notes about the file.
    """
    values, group = _find_values_in_effect(smoothing_changes, rows)
    is_off_by_group = [value in NOT_SMOOTH for value in values]
    # The last entry is for triangles before the first statement, whose group is -1.
    is_off = np.array([*is_off_by_group, False])[group]
    lacks_normals = (normal.row_of_corner < 0).any(axis=1)
    if ((group >= 0) & ~is_off & lacks_normals).any():
        notes.warn(
            "smoothing groups are left out: its normals are computed, with creases at "
            "sharp edges"
        )
    return np.asarray(is_off)


def _find_squares(
    reader: MtlReader, names: Sequence[str], material: IntArray, uv: IndexedValues
) -> IntArray:
    """Return the UDIM square of each triangle, (T,); 0 for no UDIM texture.

    A UDIM texture has an image for each unit square of texture coordinates, numbered
    from 1001. Triangles in squares without an image get 0, too.

    Args:
        reader: reader of the materials.
        names: names of the materials.
        material: (T,) the material of each triangle; -1 for none.
        uv: the texture coordinates of the triangles.
    """
    square = np.zeros(len(material), np.int64)
    has_uvs = (uv.row_of_corner >= 0).all(axis=1)
    for material_index in np.unique(material[has_uvs & (material >= 0)]):
        faces = np.flatnonzero(has_uvs & (material == material_index))
        face_squares = mtl_surfaces.compute_squares(uv.values[uv.row_of_corner[faces]])
        candidates = np.unique(face_squares).tolist()
        squares_with_image = reader.find_squares(names[material_index], candidates)
        square[faces] = np.where(
            np.isin(face_squares, squares_with_image), face_squares, 0
        )
    return square


def _find_material(
    reader: MtlReader,
    name: str,
    square_number: int,
    has_colors: bool,
    names_libraries: bool,
) -> MtlSurface:
    """Return the material of a name, or a plain one with a note if there is none.

    Without a name the surface is plain, and nothing is noted.

    Args:
        reader: reader of the materials.
        name: name of the material, perhaps empty.
        square_number: the UDIM square, 0 for none.
        has_colors: whether vertices have colors.
        names_libraries: whether the file names material files. If it does and none
            could be read, `MtlReader.read_library` has noted that, and no note is added
            here.
    """
    if not name:
        return MtlSurface(ImportedSurface())
    mtl_surface = reader.get_surface(name, square_number)
    if mtl_surface is not None:
        return mtl_surface
    substitute = "the colour of its vertices" if has_colors else "neutral grey"
    _note_missing_material(reader, name, substitute, names_libraries)
    return MtlSurface(ImportedSurface(name=without_comment(name)))


def _note_missing_material(
    reader: MtlReader, name: str, substitute: str, names_libraries: bool
) -> None:
    """Note a material that no material file has, unless all of these are missing.

    Args:
        reader: reader of the materials.
        name: name of the material.
        substitute: what is used instead, such as "neutral grey".
        names_libraries: whether the file names material files.
    """
    substitute_text = f"{substitute} is used instead"
    if reader.n_libraries:
        is_single = reader.n_libraries == 1
        lacking_files = "its .mtl file lacks" if is_single else "its .mtl files lack"
        reader.notes.warn_that_file(
            f"uses the material {format_name(name)}, which {lacking_files}; "
            f"{substitute_text}"
        )
    elif not names_libraries:
        reader.notes.warn_that_file(
            f"uses materials and names no material file (mtllib); {substitute_text}"
        )


def _combine_colors(
    surface: ImportedSurface, colors: Float64Array | None, group: IntArray, notes: Notes
) -> tuple[ImportedSurface, Float64Array | None]:
    """Decide how vertex colors and the color of a material are combined.

    If the material has a texture, vertex colors are left out. If it has a color, vertex
    colors multiply it. If it has neither, it becomes white, so that vertex colors alone
    are visible.

    Args:
        surface: the material.
        colors: (T, 3, 3) linear vertex colors of the corners of all triangles of the
            file, or None.
        group: indices of the triangles that have the material.
        notes: notes about the file.

    Returns:
        The surface; and `colors` if they multiply its color, otherwise None.
    """
    if colors is None:
        return surface, None
    has_vertex_colors = colors[group].min() < 1.0  # white changes nothing
    if surface.texture is not None:
        if has_vertex_colors:
            notes.warn("colours of vertices are left out where there is a texture")
        return surface, None
    if surface.color is None:
        return replace(surface, color=np.ones(3, np.float32)), colors
    is_white = surface.color[:3].min() >= 0.999
    if has_vertex_colors and not is_white:
        notes.warn("colours of vertices are multiplied by the Kd of their material")
    return surface, colors


def _reaches_beyond(uvs: Float64Array) -> bool:
    """Return whether UVs reach beyond [0, 1], where a texture repeats, or are NaN."""
    is_inside = uvs.min() >= -WRAP_TOLERANCE and uvs.max() <= 1.0 + WRAP_TOLERANCE
    return not is_inside


class _Statements(NamedTuple):
    """The statements of a file that have no numbers.

    Attributes:
        library_lines: the texts after ``mtllib``, which are names of material files.
        material_changes: line index and material name of each ``usemtl``.
        smoothing_changes: line index and argument of each ``s``.
    """

    library_lines: list[str]
    material_changes: list[tuple[int, str]]
    smoothing_changes: list[tuple[int, str]]


def _parse_statements(lines: ObjLines, notes: Notes) -> _Statements:
    """Parse the statements that have no numbers, and note those that are left out.

    Statements that only name groups of faces, or switch something off, need no note.
    """
    library_lines = list[str]()
    material_changes = list[tuple[int, str]]()
    smoothing_changes = list[tuple[int, str]]()
    for row, keyword, rest in lines.iterate_others():
        key = keyword.lower()
        clean_argument = without_comment(rest).lower()
        if key == "mtllib":
            library_lines.append(rest)
        elif key == "usemtl":
            material_changes.append((row, " ".join(rest.split())))
        elif key == "s":
            smoothing_changes.append((row, clean_argument))
        elif key in NON_FACE_STATEMENTS:
            notes.record(f"{NON_FACE_STATEMENTS[key]}, statement", key)
        elif key not in GROUPING and clean_argument not in ("off", "0"):
            notes.record("statement", keyword)
    return _Statements(library_lines, material_changes, smoothing_changes)


def _find_values_in_effect(
    changes: list[tuple[int, str]], rows: IntArray
) -> tuple[list[str], IntArray]:
    """Find the value in effect on each row, given the rows at which it changes.

    Args:
        changes: rows and the values set there, in the order of rows.
        rows: the rows at which the value is looked up.

    Returns:
        The different values; and for each row the index of the last value set before
        it, -1 if none was.
    """
    values = list(dict.fromkeys(value for _, value in changes))
    index_of_value = {value: index for index, value in enumerate(values)}
    change_rows = np.array([row for row, _ in changes], dtype=np.int64)
    value_of_change = np.array([-1, *(index_of_value[value] for _, value in changes)])
    # The first entry, -1, is for rows without a change before them.
    n_changes_before = np.searchsorted(change_rows, rows)
    return values, value_of_change[n_changes_before]


def _read_colors(
    lines: ObjLines, table: Float64Array, notes: Notes
) -> Float64Array | None:
    """Return the linear color (V, 3) of every vertex, or None if the file has none.

    A ``v`` line has three coordinates, then perhaps a weight, or a color, or a color
    and its opacity; ZBrush writes colors into comments. Colors are sRGB, in [0, 1] or
    in [0, 255]. Vertices without a color are neutral grey in a file with colors.

    Args:
        lines: lines of the file.
        table: (V, 7) the numbers of ``v`` lines, NaN where there are none.
        notes: notes about the file; weights and opacities, which are not read, are
            recorded.
    """
    _record_unread_numbers(table, notes)
    stored_colors: Float64Array | None = table[:, 3:6]
    if np.isnan(table[:, 5]).all():
        stored_colors = lines.read_zbrush_colors(len(table))
    if stored_colors is None:
        return None
    has_color = np.asarray(np.isfinite(stored_colors).all(axis=1))
    scale = _find_color_scale(stored_colors[has_color])
    colors = np.where(has_color[:, None], stored_colors / scale, NEUTRAL_GREY)
    display = np.clip(colors, 0.0, 1.0).astype(np.float32)
    return np.asarray(srgb_to_linear(display), dtype=np.float64)


def _record_unread_numbers(table: Float64Array, notes: Notes) -> None:
    """Record weights and opacities in the numbers (V, 7) of ``v`` lines."""
    weight = table[:, 3]
    opacity = table[:, 6]
    # a fourth number without a fifth is a weight, not a color
    if (np.isfinite(weight) & np.isnan(table[:, 4]) & (weight != 1.0)).any():
        notes.record("weights of vertices, the fourth number of", "v")
    if np.isfinite(opacity).any() and not np.isin(opacity, (1.0, 255.0)).all():
        notes.record("opacities of vertices, the seventh number of", "v")


def _find_color_scale(colors: Float64Array) -> float:
    """Return the value of full brightness, 1 or 255, in colors (N, 3) of vertices.

    A color in [0, 1] may be a little over 1, but not over 2. In [0, 255] a file whose
    largest value is 2 would be black, which no one stores.
    """
    is_in_bytes = len(colors) and colors.max() > 2.0
    return 255.0 if is_in_bytes else 1.0


Bytes = npt.NDArray[np.uint8]
TABLES = {"v": (3, 7), "vt": (1, 2), "vn": (3, 3)}
"""Statements with numbers: the smallest number of these, and how many are read."""
KINDS = (*TABLES, "f")
EXPECTED = "a Wavefront OBJ file (text with 'v' and 'f' lines)"
OTHER_KIND = len(KINDS)  # kind of all other lines
_CONTINUATION = re.compile(rb"\\[ \t]*\n")
# A comment that ends in a backslash. The group is the comment without the backslash.
_CONTINUED_COMMENT = re.compile(rb"^([ \t]*#[^\n]*?)\\[ \t]*\n", re.MULTILINE)
_CORNER = re.compile(r"[-+]?\d+(?:/(?:[-+]?\d+)?){0,2}")
_NEWLINE, _HASH, _SLASH = b"\n#/"
# (256,) bool tables over all bytes: whether a byte is blank, and whether it may occur
# in the corners of faces.
_IS_BLANK, _IS_IN_CORNERS = (
    np.isin(np.arange(256), np.frombuffer(characters, np.uint8))
    for characters in (b" \t\n\v\f", b"+-/0123456789 \t\n\v\f")
)


class ObjLines:
    """The lines of an OBJ file, sorted into ``v``, ``vt``, ``vn``, ``f`` and others.

    Attributes:
        text: the file, as `_normalize_lines` returns it.
        text_bytes: the same as an array.
        line_starts: (L,) index of the first byte of each line.
        line_ends: (L,) index of the line break of each line.
        kind_of_line: (L,) index into `KINDS` of each line, or `OTHER_KIND`.
        is_unended: whether the last line of the file has no line break.
    """

    def __init__(self, data: bytes, notes: Notes) -> None:
        """Find the lines of a file, and the kind of each by its first bytes.

        Args:
            data: the bytes of the file.
            notes: notes about the file.

        Raises:
            FileFormatError: the file is not text.
        """
        if b"\x00" in data:
            raise notes.damaged(EXPECTED, got=data)
        text = _normalize_lines(data)
        self.notes = notes
        self.text = text
        # The last line of a file without a last line break may be cut short.
        self.is_unended = not data.endswith((b"\n", b"\r"))
        self.text_bytes = np.frombuffer(text, dtype=np.uint8)
        # The normalized text ends in a line break, so that every line has an end.
        self.line_ends = np.flatnonzero(self.text_bytes == _NEWLINE)
        self.line_starts = np.concatenate([[0], self.line_ends[:-1] + 1])
        self.kind_of_line = self._find_kinds()

    def _find_kinds(self) -> npt.NDArray[np.int8]:
        """Return the kind (L,) of each line by its first bytes.

        All lines are compared at once: the arrays of their first, second and third
        bytes with those of the keywords.
        """
        # so that the third byte exists in a last line that is shorter
        padded = np.concatenate([self.text_bytes, np.full(3, _NEWLINE, np.uint8)])
        first_byte, second_byte, third_byte = (
            padded[self.line_starts + offset] for offset in range(3)
        )
        # A keyword has one or two letters, and then a blank or a line break.
        kind_of_line = np.full(len(self.line_starts), OTHER_KIND, dtype=np.int8)
        for index, kind in enumerate(KINDS):
            matches = first_byte == ord(kind[0])
            after_keyword = second_byte
            if len(kind) == 2:
                matches &= second_byte == ord(kind[1])
                after_keyword = third_byte
            kind_of_line[matches & _IS_BLANK[after_keyword]] = index
        return kind_of_line

    def iterate_others(self) -> Iterator[tuple[int, str, str]]:
        """Yield the row, keyword and argument of each line that is not in `KINDS`.

        Empty lines and comments are left out.
        """
        first_byte = self.text_bytes[self.line_starts]
        is_empty = first_byte == _NEWLINE
        is_comment = first_byte == _HASH
        is_other = (self.kind_of_line == OTHER_KIND) & ~is_empty & ~is_comment
        for row in np.flatnonzero(is_other):
            line = decode_text(self.text[self.line_starts[row] : self.line_ends[row]])
            keyword, _, rest = line.strip().replace("\t", " ").partition(" ")
            yield int(row), keyword, rest.strip()

    def read_table(self, kind: str) -> Float64Array:
        """Return the numbers of all lines of a kind, (N, columns) as in `TABLES`.

        Missing numbers of a line are 0 for ``vt`` and NaN for other kinds. Numbers
        beyond the last column are left out.

        Raises:
            FileFormatError: a line has too few numbers, or other words.
        """
        min_count, columns = TABLES[kind]
        fill = 0.0 if kind == "vt" else np.nan
        rows, line_bytes = self._select_lines(kind)
        if not len(rows):
            return np.zeros((0, columns))
        counts = _count_words(line_bytes)
        values: Float64Array = parse_number_array(
            line_bytes.tobytes(), np.float64
        ).astype(np.float64, copy=False)
        if counts.min() < min_count or len(values) != counts.sum():
            self._raise_for_numbers(kind, rows)
        return _make_number_table(values, counts, columns, fill)

    def _raise_for_numbers(self, kind: str, rows: IntArray) -> NoReturn:
        """Raise FileFormatError for the first line whose numbers are wrong."""
        min_count = TABLES[kind][0]
        for line_number, words in self._iterate_words(rows):
            where = f"after {kind!r} on line {line_number}"
            got = format_name(" ".join(words))
            if len(words) < min_count:
                expected = "3 numbers" if min_count == 3 else "numbers"
                raise self.notes.damaged(
                    f"{expected} {where}", f"{got} (is the file cut short?)"
                )
            if not all(map(is_number, words)):
                raise self.notes.damaged(f"numbers {where}", got)
        # No single line is wrong, but they could not be parsed together.
        raise self.notes.damaged(f"numbers after {kind!r}", "something else")

    def read_faces(self, counts: dict[str, int]) -> tuple[IntArray, IntArray, IntArray]:
        """Return the corners of all faces.

        Args:
            counts: number of rows of the tables of points, UVs and normals.

        Returns:
            (C, 3) for each corner the rows of the three tables, -1 for none; (P,) the
            number of corners of each face; and (P,) the row of each face's line.

        Raises:
            FileFormatError: a face is malformed, is too large, or refers to a missing
                row of a table; or there are too many faces.
        """
        rows, line_bytes = self._select_lines("f")
        if not len(rows):
            return np.zeros((0, 3), np.int64), rows, rows
        parsed = _parse_corners(line_bytes)
        if parsed is None:
            self._raise_for_faces(rows)
        corners, sizes = parsed
        self._check_sizes(rows, sizes)
        for column, kind in enumerate(TABLES):
            kind_indices = corners[:, column]
            if not len(kind_indices):
                continue
            # This changes `corners`, of which `kind_indices` is a view.
            self._resolve_relative(kind_indices, kind, rows, sizes)
            self._check_rows_exist(kind_indices, kind, counts[kind], rows, sizes)
        return corners - 1, sizes, rows  # the file counts from 1, and has 0 for none

    def _check_rows_exist(
        self, index: IntArray, kind: str, count: int, rows: IntArray, sizes: IntArray
    ) -> None:
        """Raise FileFormatError if a face refers to a missing row of a table.

        Args:
            index: (C,) indices of all corners, from 1.
            kind: keyword of the table.
            count: number of its rows.
            rows: (P,) the row of each face's line in the file.
            sizes: (P,) the number of corners of each face.
        """
        largest = index.max()
        if largest <= count:
            return
        corner = int(index.argmax())
        face = np.searchsorted(np.cumsum(sizes), corner, side="right")
        raise self.notes.damaged(
            f"at least {largest} {kind!r} lines",
            f"{count}, and a face on line {rows[face] + 1} that refers "
            f"to number {largest} (is the file cut short?)",
        )

    def _check_sizes(self, rows: IntArray, sizes: IntArray) -> None:
        """Raise FileFormatError for a last face cut short, or faces over a limit.

        A face of fewer than 3 corners is cut short only if its line is the last one of
        the file and has no line break.

        Args:
            rows: (P,) row of each face's line.
            sizes: (P,) number of corners of each face.
        """
        is_last_line = rows[-1] == len(self.line_starts) - 1
        if sizes[-1] < 3 and self.is_unended and is_last_line:
            ((line_number, words),) = self._iterate_words(rows[-1:])
            got = f"{format_name(' '.join(['f', *words]))} (is the file cut short?)"
            raise self.notes.damaged(f"3 or more corners on line {line_number}", got)
        # Rows count from 0, lines from 1.
        where = f"in the face on line {rows[sizes.argmax()] + 1}"
        # `check_most` writes the limit into the braces.
        self.notes.check_most(
            int(sizes.max()), MAX_CORNERS, "at most {} corners " + where
        )
        n_triangles = (sizes - 2).clip(0)  # lines of fewer than 3 corners have none
        self.notes.check_faces(int(n_triangles.sum()))

    def _resolve_relative(
        self, index: IntArray, kind: str, rows: IntArray, sizes: IntArray
    ) -> None:
        """Replace negative indices (C,) in place by indices that count from 1.

        A negative index counts back from the line of its face: -1 is the last row of
        the table above it.

        Args:
            index: (C,) indices of all corners.
            kind: keyword of the table, one of `TABLES`.
            rows: (P,) the row of each face's line in the file.
            sizes: (P,) the number of corners of each face.
        """
        is_relative = index < 0
        if not is_relative.any():
            return
        # For each corner, the number of rows of the table above its line. (The line
        # itself is a face, so that it does not count.)
        count_before_line = np.cumsum(self.kind_of_line == KINDS.index(kind))
        count_before = np.repeat(count_before_line[rows], sizes)
        is_before_first_row = index < -count_before
        if is_before_first_row.any():
            self._raise_for_faces(rows)
        # With n rows above the line, -1 is row n (from 1): the index grows by n + 1.
        index[is_relative] += (count_before + 1)[is_relative]

    def read_zbrush_colors(self, count: int) -> Float64Array | None:
        """Return the colors (N, 3) in [0, 255] of ZBrush's comments, or None.

        ZBrush writes them after ``#MRGB``, eight hexadecimal digits for each vertex.
        """
        if b"#MRGB" not in self.text:
            return None
        digits = b"".join(
            re.findall(rb"^#MRGB[ \t]+([0-9a-fA-F]+)", self.text, re.MULTILINE)
        )
        if len(digits) != 8 * count:  # not a color for each vertex
            return None
        # a byte for each two digits
        channels = np.frombuffer(bytes.fromhex(digits.decode()), np.uint8)
        mask_and_color = channels.reshape(-1, 4)
        return mask_and_color[:, 1:].astype(np.float64)

    def _select_lines(self, kind: str) -> tuple[IntArray, Bytes]:
        """Return the indices of the lines of a kind (N,), and their text as bytes.

        The bytes are those of all these lines, one line after the other. Keywords
        become blanks, and comments are removed. The arguments and the line breaks
        remain.

        Args:
            kind: keyword, one of `KINDS`.
        """
        is_selected = self.kind_of_line == KINDS.index(kind)
        rows = np.flatnonzero(is_selected)
        # Every line, also the last, ends in a line break of one byte.
        lengths = self.line_ends - self.line_starts + 1
        is_selected_byte = np.repeat(is_selected, lengths)
        line_bytes = self.text_bytes[is_selected_byte]
        # index of the first byte of each selected line in `line_bytes`
        selected_lengths = lengths[rows]
        starts = np.cumsum(selected_lengths) - selected_lengths
        # A line begins with its keyword, without blanks before it.
        for offset in range(len(kind)):
            line_bytes[starts + offset] = ord(" ")
        if (line_bytes == _HASH).any():
            without_comments = re.sub(rb"#[^\n]*", b"", line_bytes.tobytes())
            line_bytes = np.frombuffer(without_comments, dtype=np.uint8)
        return rows, line_bytes

    def _iterate_words(self, rows: IntArray) -> Iterator[tuple[int, list[str]]]:
        """Yield the number (from 1) and the arguments of the lines in these rows."""
        for row in rows:
            line = decode_text(self.text[self.line_starts[row] : self.line_ends[row]])
            yield int(row) + 1, line.partition("#")[0].split()[1:]

    def _raise_for_faces(self, rows: IntArray) -> NoReturn:
        """Raise FileFormatError for the first face that has a wrong index.

        An index must be an integer other than 0. A negative one must not go back
        further than the first row. Indices that are too large are found by
        `read_faces`.
        """
        counts_before_line = np.stack(
            [np.cumsum(self.kind_of_line == KINDS.index(kind)) for kind in TABLES],
            axis=1,
        )
        for line_number, words in self._iterate_words(rows):
            counts = counts_before_line[line_number - 1]
            for word in words:
                self._check_corner(word, line_number, counts)
        # No single face is wrong, but they could not be parsed together.
        raise self.notes.damaged("whole numbers in faces", "something else")

    def _check_corner(self, word: str, line_number: int, counts: IntArray) -> None:
        """Raise FileFormatError for a corner of a face that has a wrong index.

        Args:
            word: the corner, such as "1/2/3".
            line_number: its line, from 1.
            counts: (3,) number of rows above that line, of each table.
        """
        where = f"in the face on line {line_number}"
        if not _CORNER.fullmatch(word):
            raise self.notes.damaged(f"whole numbers {where}", format_name(word))
        # A missing index, as in 1//3, is valid. It is replaced by 1, which is
        # always valid, too.
        indices = [int(text or "1") for text in word.split("/")]
        # A corner may have fewer indices than there are tables.
        is_wrong = any(
            index == 0 or index < -count
            for index, count in zip(indices, counts, strict=False)
        )
        if is_wrong:
            expected = f"indices that count from 1 {where}"
            raise self.notes.damaged(expected, format_name(word))


def _normalize_lines(data: bytes) -> bytes:
    """Return text whose lines end in a line feed and begin with their keyword.

    Continued lines are joined, and the text ends in a line feed.
    """
    text = (
        data.removeprefix(b"\xef\xbb\xbf").replace(b"\r\n", b"\n").replace(b"\r", b"\n")
        + b"\n"
    )
    text = _join_continued_lines(text)
    # Leading blanks of lines are removed.
    has_leading_blanks = b"\n " in text or b"\n\t" in text or text[:1] in b" \t"
    if has_leading_blanks:
        text = re.sub(rb"\n[ \t]+", b"\n", text.lstrip(b" \t"))
    # Old files have ``fo`` for a face.
    if b"\nfo" in text:
        text = re.sub(rb"\nfo(?=[ \t])", b"\nf", text)
    return text


def _join_continued_lines(text: bytes) -> bytes:
    """Join lines that end in a backslash with the next one, except for comments."""
    if not _CONTINUATION.search(text):
        return text
    # Backslashes at the end of comments join nothing, and are removed first.
    without_continued_comments = _CONTINUED_COMMENT.sub(rb"\1\n", text)
    return _CONTINUATION.sub(b" ", without_continued_comments)


def _make_number_table(
    values: Float64Array, counts: IntArray, n_columns: int, fill: float
) -> Float64Array:
    """Return the numbers of lines as a table (N, columns); see `_fill_table`.

    Usually all lines have equally many numbers. Then the table is a reshape.
    """
    if (counts != counts[0]).any():
        return _fill_table(values, counts, n_columns, fill)
    table = values.reshape(len(counts), -1)[:, :n_columns]
    n_missing = n_columns - table.shape[1]
    return np.pad(table, ((0, 0), (0, n_missing)), constant_values=fill)


def _fill_table(
    values: Float64Array, counts: IntArray, n_columns: int, fill: float
) -> Float64Array:
    """Return a table (N, columns) of lines with different counts of numbers.

    Args:
        values: the numbers of all lines, concatenated.
        counts: (N,) how many numbers each line has; those beyond the last column are
            left out.
        n_columns: number of columns.
        fill: value of missing numbers.
    """
    first_of_line = np.cumsum(counts) - counts
    column = np.arange(len(values)) - np.repeat(first_of_line, counts)
    row = np.repeat(np.arange(len(counts)), counts)
    is_in_table = column < n_columns
    table = np.full((len(counts), n_columns), fill)
    table[row[is_in_table], column[is_in_table]] = values[is_in_table]
    return table


def _count_words(data: Bytes) -> IntArray:
    """Return how many words each line of bytes has; the last byte is a line break."""
    is_blank = _IS_BLANK[data]
    is_word_start = ~is_blank
    is_word_start[1:] &= is_blank[:-1]
    ends = np.flatnonzero(data == _NEWLINE)
    line_starts = np.concatenate([[0], ends[:-1] + 1])
    return np.asarray(np.add.reduceat(is_word_start, line_starts, dtype=np.int64))


def _find_columns(is_first: BoolArray, is_after_two_slashes: BoolArray) -> IntArray:
    """Return the column of each number in its corner, by the slashes before it.

    The column is the number of slashes in the corner before the number: in ``7//5`` the
    7 is in column 0 and the 5 in column 2. A corner has at most three numbers, so at
    most two of them are before a number. The slashes right before the number, right
    before the previous number, and right before the one before that are added up, as
    far as these are in the same corner. (The sum is 3 or more for a fourth number.)

    Args:
        is_first: (N,) whether a number is the first of its corner.
        is_after_two_slashes: (N,) whether a number that is not the first has two
            slashes before it, and not one.
    """
    # slashes between a number and its predecessor in the same corner
    n_slashes_if_not_first = np.where(is_after_two_slashes, 2, 1)
    n_slashes = np.where(is_first, 0, n_slashes_if_not_first)
    column = n_slashes.copy()
    # slashes before the previous number, if it is in the same corner
    column[1:] += np.where(is_first[1:], 0, n_slashes[:-1])
    # slashes before the number before that, if it is in the same corner: a number is
    # the second of its corner if the previous one is the first
    is_second = is_first[1:-1]
    column[2:] += np.where(is_first[2:] | is_second, 0, n_slashes[:-2])
    return np.asarray(column)


def _parse_corners(data: Bytes) -> tuple[IntArray, IntArray] | None:
    """Parse the corners of face lines, such as ``1/2/3 4//5 6``.

    Corners are separated by blanks, and the numbers of a corner by slashes. All numbers
    are parsed at once; their columns follow from the bytes before them.

    Args:
        data: the lines without keywords; each ends in a line break.

    Returns:
        (C, 3) indices of points, UVs and normals as the file has them, 0 for none; and
        (P,) the number of corners of each face. None if the text is malformed.
    """
    is_slash = data == _SLASH
    number_starts, is_first = _find_numbers(data)
    # A number that is not the first of its corner has a slash before it. It has two if
    # the byte before that is one, too. `_find_columns` ignores this for first numbers,
    # where that byte is of another corner, or at the end of the text for the first one.
    is_after_two_slashes = is_slash[number_starts - 2]
    column = _find_columns(is_first, is_after_two_slashes)
    without_slashes = np.where(is_slash, np.uint8(ord(" ")), data)
    values = parse_number_array(without_slashes.tobytes(), np.int64)
    if (
        len(values) != len(number_starts)
        or (values == 0).any()  # the file counts from 1
        or _has_malformed_corner(data, column)
    ):
        return None
    corner_starts = number_starts[is_first]
    sizes = _count_corners(data, corner_starts)
    # (N,) the corner of each number: the number of corners that have begun, minus 1
    corner_of_number = np.cumsum(is_first) - 1
    corners = np.zeros((len(corner_starts), 3), dtype=np.int64)
    corners[corner_of_number, column] = values
    return corners, sizes


def _count_corners(data: Bytes, corner_starts: IntArray) -> IntArray:
    """Return the number of corners (P,) of each line, given the first byte of each."""
    line_ends = np.flatnonzero(data == _NEWLINE)
    n_corners_before_end = np.searchsorted(corner_starts, line_ends)
    return np.diff(n_corners_before_end, prepend=0)


def _find_numbers(data: Bytes) -> tuple[IntArray, BoolArray]:
    """Return the first byte of each number in face lines, and which begin a corner.

    Numbers are runs of bytes that are neither blank nor a slash. The lines have their
    keywords replaced by blanks, so that no number is at the first byte.
    """
    is_blank = _IS_BLANK[data]
    is_in_number = ~(is_blank | (data == _SLASH))
    number_starts = np.flatnonzero(is_in_number[1:] & ~is_in_number[:-1]) + 1
    is_first_of_corner = is_blank[number_starts - 1]
    return number_starts, is_first_of_corner


def _has_malformed_corner(data: Bytes, column: IntArray) -> bool:
    """Return whether face lines have other characters, or corners of a wrong form.

    Args:
        data: the lines without keywords.
        column: (N,) column of each number in its corner; more than 2 if the corner has
            too many slashes or numbers.
    """
    begins_with_slash = (data[1:] == _SLASH) & _IS_BLANK[data[:-1]]
    return bool(
        begins_with_slash.any() or not _IS_IN_CORNERS[data].all() or (column > 2).any()
    )
