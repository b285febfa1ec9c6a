"""Wavefront OBJ: statements as arrays, and the parts of geometry that they make up.

Statements of numbers are read as arrays, since a file may have millions of lines; the
others one after the other.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from advsearch.errors import FileFormatError
from advsearch.scene.assets import Doubles, Ints, face_vectors
from advsearch.scene.color import srgb_to_linear
from advsearch.scene.importing import mtl_surfaces
from advsearch.scene.importing.files import (
    MOST_CORNERS,
    Notes,
    is_number,
    numbers_in,
    shown,
    text_of,
)
from advsearch.scene.importing.geometry import cut_up
from advsearch.scene.importing.mtl_surfaces import (
    MtlReader,
    Painted,
    libraries_of,
    without_comment,
)
from advsearch.scene.importing.parts import (
    NEUTRAL,
    ImportedPart,
    ImportedSurface,
    Looked,
    alike,
    split_at_corners,
)
from advsearch.trust.named_files import References

# statements that only name parts; all parts are joined
GROUPING = frozenset(("g", "o"))
FREE_FORM = (
    "bmat bsp bzp cdc cdp con cstype curv curv2 deg end hole mg parm res scrv "
    "sp step surf trim vp"
).split()
WITHOUT_FACES = {
    "p": "points",
    "l": "lines",
    **dict.fromkeys(FREE_FORM, "curves and curved surfaces"),
}
# material files, and materials, that a file may name, before `scaled`
MOST_NAMED = 10_000
# how far texture coordinates may lie outside of a texture before it matters how that
# goes on
BEYOND = 0.01


def read_obj(path: Path, data: bytes, notes: Notes) -> list[ImportedPart]:
    """Read an OBJ file, and the material files that it names, as one part for each
    material, and another for its faces without texture coordinates. Raises
    FileFormatError: it is of another kind, is cut short, refers to what is not in it,
    or has no faces.
    """
    lines = Lines(data, notes)
    tables = {kind: lines.table(kind) for kind in TABLES}
    if not len(tables["v"]):
        raise notes.damaged(EXPECTED, data)
    corners, counts, rows = lines.faces(
        {kind: len(table) for kind, table in tables.items()}
    )
    if (counts < 3).all():
        raise FileFormatError(
            f"{path}: expected a mesh with faces, got points or "
            "lines only; export triangles"
        )
    references = References(path)

    def shown_on(name: str, number: int) -> tuple[Doubles, Doubles]:
        mine = (
            (material == names.index(name))
            & (square == number)
            & (mapped >= 0).all(axis=1)
        )
        return tables["vt"][mapped[mine]], np.linalg.norm(
            face_vectors(points[position[mine]]), axis=1
        )

    reader = MtlReader(references, notes, shown_on)
    named, materials, smoothing = _statements(lines, notes)
    named = list(dict.fromkeys(named))
    notes.check_most(
        len(named), MOST_NAMED, "at most {} lines that name material files (mtllib)"
    )
    libraries = libraries_of(named, references)
    notes.check_most(len(libraries), MOST_NAMED, "at most {} material files")
    for name in libraries:
        reader.read_library(name)
    points = tables["v"][:, :3]
    triangles, face = cut_up(points[corners[:, 0]], counts, notes)
    position, mapped, normal = (corners[triangles, place] for place in range(3))
    names, material = _in_effect(materials, rows[face])
    notes.check_most(len(names), MOST_NAMED, "at most {} materials")
    smoothness, smooth = _in_effect(smoothing, rows[face])
    off = np.array([*(word in ("off", "0", "") for word in smoothness), False])[smooth]
    if ((smooth >= 0) & ~off & (normal < 0).any(axis=1)).any():
        notes.say(
            "smoothing groups are left out: its normals are made, with creases "
            "at sharp edges"
        )
    colors = _colors(lines, tables["v"], notes)
    colors = None if colors is None else colors[position]
    parts = []
    square = np.zeros(len(mapped), np.int64)  # of UDIM; 0: one picture for all
    inside = (mapped >= 0).all(axis=1)
    for number in np.unique(material[inside & (material >= 0)]):
        mine = np.flatnonzero(inside & (material == number))
        squares = mtl_surfaces.squares(tables["vt"][mapped[mine]])
        several = reader.squares_of(names[number], np.unique(squares).tolist())
        square[mine] = np.where(np.isin(squares, several), squares, 0)
    for chosen in alike(material, inside, off, square):
        first = chosen[0]
        name = names[material[first]] if material[first] >= 0 else ""
        number = int(square[first])
        painted = reader.painted(name, number) if name else Painted(ImportedSurface())
        if painted is None:
            painted = Painted(ImportedSurface(name=without_comment(name)))
            instead = f"{'neutral grey' if colors is None else 'the colour of its vertices'} is used instead"
            if reader.libraries:
                lacks = (
                    "its .mtl file lacks"
                    if reader.libraries == 1
                    else "its .mtl files lack"
                )
                notes.say(f" uses the material {shown(name)}, which {lacks}; {instead}")
            elif not named:  # else it is said already that none could be read
                notes.say(
                    f" uses materials and names no material file (mtllib); {instead}"
                )
        surface = painted.surface
        tint = colors
        color = surface.color
        tinted = tint is not None and tint[chosen].min() < 1.0
        if surface.texture is not None:
            if tinted:
                notes.say("colours of vertices are left out where there is a texture")
            tint = None
        elif tint is not None and color is None:
            surface = replace(surface, color=np.ones(3, np.float32))
        elif tinted and color is not None and color[:3].min() < 0.999:
            notes.say("colours of vertices are multiplied by the Kd of their material")
        uvs = (
            tables["vt"] - mtl_surfaces.corner_of(number)
        ) * painted.scale + painted.offset
        used = uvs[mapped[chosen]] if inside[first] else np.zeros(0)
        if (
            painted.clamped
            and len(used)
            and not (used.min() >= -BEYOND and used.max() <= 1.0 + BEYOND)
        ):
            notes.say(
                " has textures that are not to repeat beyond their edges "
                "(-clamp); here they do"
            )
        looked_up = (
            Looked(points, position),
            Looked(tables["vn"], normal),
            Looked(uvs, mapped),
        )
        parts.append(
            split_at_corners(chosen, *looked_up, tint, surface, flat=bool(off[first]))
        )
    return parts


def _statements(
    lines: Lines, notes: Notes
) -> tuple[list[str], list[tuple[int, str]], list[tuple[int, str]]]:
    """Return what stands after ``mtllib``, names after ``usemtl`` and words after
    ``s``, with the rows that these are in; statements of which nothing becomes are
    noted.
    """
    libraries = list[str]()
    materials = list[tuple[int, str]]()
    smoothing = list[tuple[int, str]]()
    for row, word, rest in lines.others():
        key = word.lower()
        plain = without_comment(rest).lower()
        if key == "mtllib":
            libraries.append(rest)
        elif key == "usemtl":
            materials.append((row, " ".join(rest.split())))
        elif key == "s":
            smoothing.append((row, plain))
        elif key in WITHOUT_FACES:
            notes.has(f"{WITHOUT_FACES[key]}, statement", key)
        elif key not in GROUPING and plain not in ("off", "0"):
            notes.has("statement", word)
    return libraries, materials, smoothing


def _in_effect(changes: list[tuple[int, str]], rows: Ints) -> tuple[list[str], Ints]:
    """Return the values that are said, and for each row the number of the last before
    it; -1 where there is none.
    """
    numbers = {
        value: number
        for number, value in enumerate(dict.fromkeys(value for _, value in changes))
    }
    last = (
        np.searchsorted(np.array([row for row, _ in changes], dtype=np.int64), rows) - 1
    )
    return list(numbers), np.array([*(numbers[value] for _, value in changes), -1])[
        last
    ]


def _colors(lines: Lines, table: Doubles, notes: Notes) -> Doubles | None:
    """Return the linear colour (V, 3) of every vertex; neutral grey where a file with
    colours has none. A vertex is three coordinates, then perhaps a weight, or a colour,
    or a colour and its opacity; or ZBrush has put colours into comments.
    """
    if (np.isfinite(table[:, 3]) & np.isnan(table[:, 4]) & (table[:, 3] != 1.0)).any():
        notes.has("weights of vertices, the fourth number of", "v")
    given: Doubles | None = table[:, 3:6]
    if np.isfinite(table[:, 6]).any() and not np.isin(table[:, 6], (1.0, 255.0)).all():
        notes.has("opacities of vertices, the seventh number of", "v")
    if np.isnan(table[:, 5]).all():
        given = lines.zbrush_colors(len(table))
    if given is None:
        return None
    known = np.asarray(np.isfinite(given).all(axis=1))
    scale = 255.0 if known.any() and given[known].max() > 2.0 else 1.0
    colors = np.where(known[:, None], given / scale, NEUTRAL)
    return np.asarray(
        srgb_to_linear(np.clip(colors, 0.0, 1.0).astype(np.float32)), dtype=np.float64
    )


Bytes = npt.NDArray[np.uint8]
TABLES = {"v": (3, 7), "vt": (1, 2), "vn": (3, 3)}
"""Statements of numbers with the fewest that they have, and how many are read."""
KINDS = (*TABLES, "f")
EXPECTED = "a Wavefront OBJ file (text with 'v' and 'f' lines)"
_CONTINUED = re.compile(rb"\\[ \t]*\n")
_COMMENTED = re.compile(rb"^([ \t]*#[^\n]*?)\\[ \t]*\n", re.MULTILINE)
_CORNER = re.compile(r"[-+]?\d+(?:/(?:[-+]?\d+)?){0,2}")
_NEWLINE, _HASH, _SLASH = b"\n#/"
_BLANK, _IN_CORNERS = (
    np.isin(np.arange(256), np.frombuffer(some, np.uint8))
    for some in (b" \t\n\v\f", b"+-/0123456789 \t\n\v\f")
)


class Lines:
    """The lines of a file, each of its kind: ``v``, ``vt``, ``vn``, ``f``, or another.
    Raises FileFormatError: it is no text.
    """

    def __init__(self, data: bytes, notes: Notes) -> None:
        if b"\x00" in data:
            raise notes.damaged(EXPECTED, data)
        text = (
            data.removeprefix(b"\xef\xbb\xbf")
            .replace(b"\r\n", b"\n")
            .replace(b"\r", b"\n")
            + b"\n"
        )
        if _CONTINUED.search(text):  # which a comment is not
            text = _CONTINUED.sub(b" ", _COMMENTED.sub(rb"\1\n", text))
        if b"\n " in text or b"\n\t" in text or text[:1] in b" \t":
            text = re.sub(rb"\n[ \t]+", b"\n", text.lstrip(b" \t"))
        if b"\nfo" in text:  # the old word for a face
            text = re.sub(rb"\nfo(?=[ \t])", b"\nf", text)
        self.notes = notes
        self.text = text
        # as files are that were cut short
        self.unended = not data.endswith((b"\n", b"\r"))
        self.bytes = np.frombuffer(text, dtype=np.uint8)
        self.ends = np.flatnonzero(self.bytes == _NEWLINE)
        self.starts = np.concatenate([[0], self.ends[:-1] + 1])
        padded = np.concatenate([self.bytes, np.full(3, _NEWLINE, np.uint8)])
        first, second, third = (padded[self.starts + place] for place in range(3))
        self.kind = np.full(len(self.starts), len(KINDS), dtype=np.int8)
        for number, kind in enumerate(KINDS):
            longer = len(kind) == 2
            same = (first == ord(kind[0])) & (
                (second == ord(kind[1])) if longer else True
            )
            self.kind[same & _BLANK[third if longer else second]] = number

    def others(self) -> Iterator[tuple[int, str, str]]:
        other = (
            (self.kind == len(KINDS))
            & (self.bytes[self.starts] != _NEWLINE)
            & (self.bytes[self.starts] != _HASH)
        )
        for row in np.flatnonzero(other):
            line = (
                text_of(self.text[self.starts[row] : self.ends[row]])
                .strip()
                .replace("\t", " ")
            )
            key, _, rest = line.partition(" ")
            yield int(row), key, rest.strip()

    def table(self, kind: str) -> Doubles:
        """Return the numbers of all lines of a kind in a table; where one has fewer, 0
        for ``vt``, else NaN. Raises FileFormatError: a line has too few, or something
        else.
        """
        (fewest, most) = TABLES[kind]
        rest = 0.0 if kind == "vt" else np.nan
        rows, data = self._of(kind)
        if not len(rows):
            return np.zeros((0, most))
        blank = _BLANK[data]
        begins = ~blank
        begins[1:] &= blank[:-1]
        ends = np.flatnonzero(data == _NEWLINE)
        counts = np.add.reduceat(
            begins, np.concatenate([[0], ends[:-1] + 1]), dtype=np.int64
        )
        values: Doubles = numbers_in(data.tobytes(), np.float64).astype(
            np.float64, copy=False
        )
        if counts.min() < fewest or len(values) != counts.sum():
            for number, words in self._words(rows):
                where = f"after {kind!r} on line {number}"
                got = shown(" ".join(words))
                if len(words) < fewest:
                    what = "3 numbers" if fewest == 3 else "numbers"
                    raise self.notes.damaged(
                        f"{what} {where}", f"{got} (is the file cut short?)"
                    )
                if not all(map(is_number, words)):
                    raise self.notes.damaged(f"numbers {where}", got)
            raise self.notes.damaged(f"numbers after {kind!r}", "something else")
        if (counts == counts[0]).all():
            table = values.reshape(len(rows), -1)[:, :most]
            return np.pad(
                table, ((0, 0), (0, most - table.shape[1])), constant_values=rest
            )
        place = np.arange(len(values)) - np.repeat(np.cumsum(counts) - counts, counts)
        kept = place < most
        table = np.full((len(rows), most), rest)
        table[np.repeat(np.arange(len(rows)), counts)[kept], place[kept]] = values[kept]
        return table

    def faces(self, counts: dict[str, int]) -> tuple[Ints, Ints, Ints]:
        """Return the corners of all faces: (C, 3) rows of the tables of points, texture
        coordinates and normals, -1 where there is none; (P,) how many corners each face
        has; and (P,) the rows that they are in. Raises FileFormatError: a face is
        damaged, is too large, or refers to what is not there; or they are too many.
        """
        rows, data = self._of("f")
        if not len(rows):
            return np.zeros((0, 3), np.int64), rows, rows
        blank = _BLANK[data]
        slash = data == _SLASH
        number = ~(blank | slash)
        begins = np.flatnonzero(number[1:] & ~number[:-1]) + 1
        first = blank[begins - 1]
        step = np.where(first, 0, np.where(slash[begins - 2], 2, 1))
        place = step.copy()  # of a number in its corner; it has three at most
        place[1:] += np.where(first[1:], 0, step[:-1])
        place[2:] += np.where(first[2:] | first[1:-1], 0, step[:-2])
        longer = ~(first[3:] | first[2:-1] | first[1:-2])
        odd = (
            (slash[1:] & blank[:-1]).any()
            or not _IN_CORNERS[data].all()
            or longer.any()
            or (place > 2).any()
        )
        values = numbers_in(
            np.where(slash, np.uint8(ord(" ")), data).tobytes(), np.int64
        )
        if odd or len(values) != len(begins) or (values == 0).any():
            self._blame_faces(rows)
        at = np.flatnonzero(first)
        sizes = np.diff(
            np.searchsorted(begins[at], np.flatnonzero(data == _NEWLINE)), prepend=0
        )
        if sizes[-1] < 3 and self.unended and rows[-1] == len(self.starts) - 1:
            ((number, words),) = self._words(rows[-1:])
            got = f"{shown(' '.join(['f', *words]))} (is the file cut short?)"
            raise self.notes.damaged(f"3 or more corners on line {number}", got)
        where = f"in the face on line {rows[sizes.argmax()] + 1}"
        self.notes.check_most(
            int(sizes.max()), MOST_CORNERS, f"at most {{}} corners {where}"
        )
        self.notes.check_faces(int((sizes - 2).clip(0).sum()))
        corners = np.zeros((len(at), 3), dtype=np.int64)
        corners[np.cumsum(first) - 1, place] = values
        for column, kind in enumerate(TABLES):
            index = corners[:, column]
            if not len(index):
                continue
            if (index < 0).any():
                before = np.repeat(
                    np.cumsum(self.kind == KINDS.index(kind))[rows], sizes
                )
                if (index < -before).any():
                    self._blame_faces(rows)
                index[index < 0] += (before + 1)[index < 0]
            if index.max() > counts[kind]:
                row = rows[
                    np.searchsorted(np.cumsum(sizes), int(index.argmax()), side="right")
                ]
                got = (
                    f"{counts[kind]}, and a face on line {row + 1} that refers to "
                    f"number {index.max()}"
                )
                raise self.notes.damaged(
                    f"at least {index.max()} {kind!r} lines",
                    f"{got} (is the file cut short?)",
                )
        return corners - 1, sizes, rows

    def zbrush_colors(self, count: int) -> Doubles | None:
        """Return the colours (N, 3) in [0, 255] that ZBrush writes into comments
        (``#MRGB``), or None.
        """
        if b"#MRGB" not in self.text:
            return None
        digits = b"".join(
            re.findall(rb"^#MRGB[ \t]+([0-9a-fA-F]+)", self.text, re.MULTILINE)
        )
        if len(digits) != 8 * count:
            return None
        return (
            np.frombuffer(bytes.fromhex(digits.decode()), np.uint8)
            .reshape(-1, 4)[:, 1:]
            .astype(np.float64)
        )

    def _of(self, kind: str) -> tuple[Ints, Bytes]:
        mine = self.kind == KINDS.index(kind)
        lengths = self.ends - self.starts + 1
        rows = np.flatnonzero(mine)
        data = self.bytes[np.repeat(mine, lengths)]
        starts = np.cumsum(lengths[rows]) - lengths[rows]
        for place in range(len(kind)):
            data[starts + place] = ord(" ")
        if (data == _HASH).any():
            data = np.frombuffer(
                re.sub(rb"#[^\n]*", b"", data.tobytes()), dtype=np.uint8
            )
        return rows, data

    def _words(self, rows: Ints) -> Iterator[tuple[int, list[str]]]:
        for row in rows:
            line = text_of(self.text[self.starts[row] : self.ends[row]])
            yield int(row) + 1, line.partition("#")[0].split()[1:]

    def _blame_faces(self, rows: Ints) -> None:
        counts = np.stack(
            [np.cumsum(self.kind == KINDS.index(kind)) for kind in TABLES], axis=1
        )
        for number, words in self._words(rows):
            for word in words:
                if not _CORNER.fullmatch(word):
                    raise self.notes.damaged(
                        f"whole numbers in the face on line {number}", shown(word)
                    )
                indices = [int(part or "1") for part in word.split("/")]
                if any(
                    not index or index < -most
                    for index, most in zip(indices, counts[number - 1], strict=False)
                ):
                    raise self.notes.damaged(
                        f"indices that count from 1 in the face on line {number}",
                        shown(word),
                    )
        raise self.notes.damaged("whole numbers in faces", "something else")
