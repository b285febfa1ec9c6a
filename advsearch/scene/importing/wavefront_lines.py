"""The lines of a Wavefront OBJ file: those of numbers, of which there may be millions, as arrays, and the others."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from advsearch import files
from advsearch.scene.importing.checks import MOST_CORNERS, check_faces
from advsearch.scene.importing.files import damaged, looks_like, shown, text_of

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
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
    np.isin(np.arange(256), np.frombuffer(some, np.uint8)) for some in (b" \t\n\v\f", b"+-/0123456789 \t\n\v\f")
)


class Lines:
    """The lines of a file, each of its kind: ``v``, ``vt``, ``vn``, ``f``, or another.

    Raises:
        FileFormatError: it is no text.
    """

    def __init__(self, path: Path, data: bytes) -> None:
        if b"\x00" in data:
            raise damaged(path, EXPECTED, looks_like(data))
        text = data.removeprefix(b"\xef\xbb\xbf").replace(b"\r\n", b"\n").replace(b"\r", b"\n") + b"\n"
        if _CONTINUED.search(text):  # which a comment is not
            text = _CONTINUED.sub(b" ", _COMMENTED.sub(rb"\1\n", text))
        if b"\n " in text or b"\n\t" in text or text[:1] in b" \t":
            text = re.sub(rb"\n[ \t]+", b"\n", text.lstrip(b" \t"))
        if b"\nfo" in text:  # the old word for a face
            text = re.sub(rb"\nfo(?=[ \t])", b"\nf", text)
        self.path, self.text = path, text
        self.bytes = np.frombuffer(text, dtype=np.uint8)
        self.ends = np.flatnonzero(self.bytes == _NEWLINE)
        self.starts = np.concatenate([[0], self.ends[:-1] + 1])
        padded = np.concatenate([self.bytes, np.full(3, _NEWLINE, np.uint8)])
        first, second, third = (padded[self.starts + place] for place in range(3))
        self.kind = np.full(len(self.starts), len(KINDS), dtype=np.int8)
        for number, kind in enumerate(KINDS):
            longer = len(kind) == 2
            same = (first == ord(kind[0])) & ((second == ord(kind[1])) if longer else True)
            self.kind[same & _BLANK[third if longer else second]] = number

    def others(self) -> Iterator[tuple[int, str, str]]:
        """Yield the row, the keyword and the rest of each line of another kind."""
        other = (self.kind == len(KINDS)) & (self.bytes[self.starts] != _NEWLINE) & (self.bytes[self.starts] != _HASH)
        for row in np.flatnonzero(other):
            line = text_of(self.text[self.starts[row] : self.ends[row]]).strip().replace("\t", " ")
            key, _, rest = line.partition(" ")
            yield int(row), key, rest.strip()

    def table(self, kind: str) -> Array:
        """Return the numbers of all lines of a kind in a table; where one has fewer, 0 for ``vt``, else NaN.

        Raises:
            FileFormatError: a line has too few, or something else.
        """
        (fewest, most), rest = TABLES[kind], 0.0 if kind == "vt" else np.nan
        rows, data = self._of(kind)
        if not len(rows):
            return np.zeros((0, most))
        blank = _BLANK[data]
        begins = ~blank
        begins[1:] &= blank[:-1]
        ends = np.flatnonzero(data == _NEWLINE)
        counts = np.add.reduceat(begins, np.concatenate([[0], ends[:-1] + 1]), dtype=np.int64)
        values: Array = _parsed(data, np.float64).astype(np.float64, copy=False)
        if counts.min() < fewest or len(values) != counts.sum():
            self._blame_numbers(kind, fewest, rows)
        if (counts == counts[0]).all():
            table = values.reshape(len(rows), -1)[:, :most]
            return np.pad(table, ((0, 0), (0, most - table.shape[1])), constant_values=rest)
        place = np.arange(len(values)) - np.repeat(np.cumsum(counts) - counts, counts)
        kept = place < most
        table = np.full((len(rows), most), rest)
        table[np.repeat(np.arange(len(rows)), counts)[kept], place[kept]] = values[kept]
        return table

    def faces(self, counts: dict[str, int]) -> tuple[Ints, Ints, Ints]:
        """Return the corners of all faces: (C, 3) rows of the tables of points, texture coordinates and normals, -1
        where there is none; (P,) how many corners each face has; and (P,) the rows that they are in.

        Raises:
            FileFormatError: a face is damaged, is too large, or refers to what is not there; or they are too many.
        """
        rows, data = self._of("f")
        if not len(rows):
            return np.zeros((0, 3), np.int64), rows, rows
        blank, slash = _BLANK[data], data == _SLASH
        number = ~(blank | slash)
        begins = np.flatnonzero(number[1:] & ~number[:-1]) + 1
        first = blank[begins - 1]
        step = np.where(first, 0, np.where(slash[begins - 2], 2, 1))
        place = step.copy()  # of a number in its corner; it has three at most
        place[1:] += np.where(first[1:], 0, step[:-1])
        place[2:] += np.where(first[2:] | first[1:-1], 0, step[:-2])
        longer = ~(first[3:] | first[2:-1] | first[1:-2])
        odd = (slash[1:] & blank[:-1]).any() or not _IN_CORNERS[data].all() or longer.any() or (place > 2).any()
        values = _parsed(np.where(slash, np.uint8(ord(" ")), data), np.int64)
        if odd or len(values) != len(begins) or (values == 0).any():
            self._blame_faces(rows)
        at = np.flatnonzero(first)
        sizes = np.diff(np.searchsorted(begins[at], np.flatnonzero(data == _NEWLINE)), prepend=0)
        if sizes.min() < 3:
            self._blame_faces(rows)
        if sizes.max() > files.scaled(MOST_CORNERS):
            expected = f"at most {files.scaled(MOST_CORNERS):,} corners in the face on line {rows[sizes.argmax()] + 1}"
            raise files.too_large(self.path, expected, f"{sizes.max():,}")
        check_faces(self.path, int(sizes.sum()) - 2 * len(sizes))
        corners = np.zeros((len(at), 3), dtype=np.int64)
        corners[np.cumsum(first) - 1, place] = values
        for column, kind in enumerate(TABLES):
            index = corners[:, column]
            if (index < 0).any():
                before = np.repeat(np.cumsum(self.kind == KINDS.index(kind))[rows], sizes)
                if (index < -before).any():
                    self._blame_faces(rows, before=True)
                index[index < 0] += (before + 1)[index < 0]
            if index.max() > counts[kind]:
                row = rows[np.searchsorted(np.cumsum(sizes), int(index.argmax()), side="right")]
                got = f"{counts[kind]}, and a face on line {row + 1} that refers to number {index.max()}"
                raise damaged(self.path, f"at least {index.max()} {kind!r} lines", f"{got} (is the file cut short?)")
        return corners - 1, sizes, rows

    def zbrush_colors(self, count: int) -> Array | None:
        """Return the colours (N, 3) in [0, 255] that ZBrush writes into comments (``#MRGB``), or None."""
        if b"#MRGB" not in self.text:
            return None
        digits = b"".join(re.findall(rb"^#MRGB[ \t]+([0-9a-fA-F]+)", self.text, re.MULTILINE))
        if len(digits) != 8 * count:
            return None
        return np.frombuffer(bytes.fromhex(digits.decode()), np.uint8).reshape(-1, 4)[:, 1:].astype(np.float64)

    def _of(self, kind: str) -> tuple[Ints, Bytes]:
        """Return the rows of a kind, and their bytes without keywords and comments."""
        mine = self.kind == KINDS.index(kind)
        rows = np.flatnonzero(mine)
        data = self.bytes[np.repeat(mine, self.ends - self.starts + 1)]
        starts = np.cumsum((self.ends - self.starts + 1)[rows]) - (self.ends - self.starts + 1)[rows]
        for place in range(len(kind)):
            data[starts + place] = ord(" ")
        if (data == _HASH).any():
            data = np.frombuffer(re.sub(rb"#[^\n]*", b"", data.tobytes()), dtype=np.uint8)
        return rows, data

    def _words(self, rows: Ints) -> Iterator[tuple[int, list[str]]]:
        """Yield the number and the words of lines of numbers."""
        for row in rows:
            line = text_of(self.text[self.starts[row] : self.ends[row]])
            yield int(row) + 1, line.partition("#")[0].split()[1:]

    def _blame_numbers(self, kind: str, fewest: int, rows: Ints) -> None:
        for number, words in self._words(rows):
            rest = shown(" ".join(words))
            if len(words) < fewest:
                what = "3 numbers" if fewest == 3 else "numbers"
                raise damaged(self.path, f"{what} after {kind!r} on line {number}", f"{rest} (is the file cut short?)")
            if not all(map(_is_number, words)):
                raise damaged(self.path, f"numbers after {kind!r} on line {number}", rest)
        raise damaged(self.path, f"numbers after {kind!r}", "something else")

    def _blame_faces(self, rows: Ints, *, before: bool = False) -> None:
        counts = np.stack([np.cumsum(self.kind == KINDS.index(kind)) for kind in TABLES], axis=1)
        for number, words in self._words(rows):
            if len(words) < 3:
                got = f"{shown(' '.join(['f', *words]))} (is the file cut short?)"
                raise damaged(self.path, f"3 or more corners on line {number}", got)
            for word in words:
                if not _CORNER.fullmatch(word):
                    raise damaged(self.path, f"whole numbers in the face on line {number}", shown(word))
                indices = [int(part or "1") for part in word.split("/")]
                if any(not index or index < -most for index, most in zip(indices, counts[number - 1], strict=False)):
                    raise damaged(self.path, f"indices that count from 1 in the face on line {number}", shown(word))
        raise damaged(self.path, "whole numbers in faces", "something else")


def _parsed(data: Bytes, kind: type) -> npt.NDArray[np.generic]:
    """Return the numbers in a text, up to the first word that is none."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return np.fromstring(data.tobytes(), dtype=kind, sep=" ")
        except ValueError:
            return np.zeros(0, kind)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return "_" not in word
