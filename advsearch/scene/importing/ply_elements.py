"""PLY: the elements that a file's header describes, as arrays. What they mean is read in `ply`."""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from advsearch.errors import FileFormatError
from advsearch.scene.importing.files import check_faces, damaged, looks_like, shown, text_of

Ints = npt.NDArray[np.int64]
Numbers = npt.NDArray[np.generic]

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"},
    **{"double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8"},
}
_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_END = re.compile(rb"^end_header[ \t]*(?:\r\n|\n|\r)", re.MULTILINE)


@dataclass(frozen=True, eq=False)
class Lists:
    """A property with several values in each row.

    Attributes:
        counts: (N,) how many.
        values: those of all rows, one after the other.
    """

    counts: Ints
    values: Numbers


@dataclass
class Element:
    """A table of a file.

    Attributes:
        name: in the file.
        count: of its rows.
        types: of its properties, as the header has them, in the order of the file; of a list, that of its values.
        lists: the types of the counts of those that are lists.
        scalars: the values (N,) of properties with one a row.
        listed: those with several.
    """

    name: str
    count: int
    types: dict[str, np.dtype[np.generic]] = field(default_factory=dict)
    lists: dict[str, np.dtype[np.generic]] = field(default_factory=dict)
    scalars: dict[str, Numbers] = field(default_factory=dict)
    listed: dict[str, Lists] = field(default_factory=dict)


def read_elements(path: Path, data: bytes) -> tuple[dict[str, Element], list[str]]:
    """Return the elements of a file by their names, and its comments.

    Raises:
        FileFormatError: it is no PLY file, its header is odd, or it is shorter than that says.
    """
    end = _END.search(
        data.replace(b"\r", b"\n") if data.startswith(b"ply\r") and not data.startswith(b"ply\r\n") else data
    )
    if not data.startswith(b"ply") or end is None:
        raise damaged(
            path, "a PLY file with a complete header", "half of one" if data.startswith(b"ply") else looks_like(data)
        )
    elements, comments, order = _header(path, text_of(data[: end.start()]))
    cells = _Words(data[end.end() :]) if order == "" else _Bytes(data[end.end() :])
    at = 0
    for element in elements.values():
        at = _fill(path, element, cells, at)
    return elements, comments


def _header(path: Path, text: str) -> tuple[dict[str, Element], list[str], str]:
    """Return the elements without values, the comments, and the order of bytes, empty for text."""
    elements: dict[str, Element] = {}
    comments, order = [], None
    current = None
    for line in text.splitlines()[1:]:
        match line.split():
            case ["format", kind, *_] if kind in _FORMATS:
                order = _FORMATS[kind]
            case ["comment" | "obj_info", *_]:
                comments.append(line.split(None, 1)[1].strip() if len(line.split(None, 1)) == 2 else "")
            case ["element", name, count] if count.isdecimal() and len(count) < 20 and name not in elements:
                current = elements[name] = Element(name, int(count))
            case ["property", "list", counts, kind, name] if current and {counts, kind} <= set(_TYPES):
                current.types[name] = np.dtype((order or "") + _TYPES[kind])
                current.lists[name] = np.dtype((order or "") + _TYPES[counts])
            case ["property", kind, name] if current and kind in _TYPES and name not in current.types:
                current.types[name] = np.dtype((order or "") + _TYPES[kind])
            case []:
                pass
            case _:
                raise damaged(path, "a PLY header of elements and their properties", f"the line {shown(line)}")
    if order is None:
        raise damaged(path, f"a PLY header with a format of {', '.join(_FORMATS)}", "none of these")
    check_faces(path, elements["face"].count if "face" in elements else 0)
    return elements, comments, order


class _Words:
    """The numbers of a text, one a cell."""

    def __init__(self, data: bytes) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                self.values = np.fromstring(data, dtype=np.float64, sep=" ")
            except ValueError:
                self.values = np.zeros(0)
        self.end, self.data = len(self.values), data

    def width(self, kind: np.dtype[np.generic]) -> int:
        return 1

    def taken(self, places: Ints, kind: np.dtype[np.generic]) -> Numbers:
        return self.values[places]

    def number(self, place: int, kind: np.dtype[np.generic]) -> float:
        return self.values.item(place)

    def odd(self) -> str | None:
        """The first word that is no number, if there is one."""
        return next((text_of(word) for word in self.data.split() if not _is_number(word)), None)


class _Bytes:
    """The bytes of a binary file, one a cell."""

    def __init__(self, data: bytes) -> None:
        self.values, self.end, self.data = np.frombuffer(data, np.uint8), len(data), data

    def width(self, kind: np.dtype[np.generic]) -> int:
        return kind.itemsize

    def taken(self, places: Ints, kind: np.dtype[np.generic]) -> Numbers:
        found: Numbers = self.values[places[:, None] + np.arange(kind.itemsize)].reshape(-1).view(kind)
        return found

    def number(self, place: int, kind: np.dtype[np.generic]) -> float:
        if kind.kind == "f":
            return float(np.frombuffer(self.data, kind, 1, place)[0])
        part, signed = self.data[place : place + kind.itemsize], kind.kind == "i"
        return int.from_bytes(part, "big" if kind.str[0] == ">" else "little", signed=signed)

    def odd(self) -> str | None:
        return None


def _is_number(word: bytes) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _fill(path: Path, element: Element, cells: _Words | _Bytes, at: int) -> int:
    """Read the rows of an element that begin at a cell; return the cell after them."""
    widths = {name: cells.width(element.lists.get(name, kind)) for name, kind in element.types.items()}
    if not element.count or not widths:
        return at
    if element.count * sum(widths.values()) > cells.end - at:
        raise _cut(path, element, cells)
    places, after = _rows(path, element, cells, at, widths, 1)
    last = at + (after - at) * element.count
    steps = (after - at) * np.arange(element.count if last <= cells.end else 0)
    even = {name: one + steps for name, one in places.items()}
    counts = [cells.taken(even[name], kind) for name, kind in element.lists.items()]
    if last <= cells.end and all((some == some[0]).all() for some in counts):
        places, at = even, last
    else:  # the lists differ in length
        places, at = _rows(path, element, cells, at, widths, element.count)
    for name, kind in element.types.items():
        if name not in element.lists:
            element.scalars[name] = cells.taken(places[name], kind)
            continue
        sizes = cells.taken(places[name], element.lists[name]).astype(np.int64)
        width = cells.width(kind)
        skipped = np.arange(int(sizes.sum())) - np.repeat(np.cumsum(sizes) - sizes, sizes)
        inside = np.repeat(places[name] + widths[name], sizes) + width * skipped
        element.listed[name] = Lists(sizes, cells.taken(inside, kind))
    return at


def _rows(
    path: Path, element: Element, cells: _Words | _Bytes, at: int, widths: dict[str, int], count: int
) -> tuple[dict[str, Ints], int]:
    """Go through rows one by one; return the cells at which each property begins, and the cell after them."""
    places: dict[str, list[int]] = {name: [] for name in widths}
    steps = [
        (places[name].append, widths[name], element.lists.get(name), cells.width(kind))
        for name, kind in element.types.items()
    ]
    for _ in range(count):
        for note, width, counted, size in steps:
            note(at)
            if at + width > cells.end:
                raise _cut(path, element, cells)
            if counted is not None:
                number = cells.number(at, counted)
                if not 0 <= number <= cells.end:
                    raise damaged(path, f"lists in the PLY element {shown(element.name)}", f"one of {number:g} values")
                at += size * int(number)
            at += width
    if at > cells.end:
        raise _cut(path, element, cells)
    return {name: np.array(one, dtype=np.int64) for name, one in places.items()}, at


def _cut(path: Path, element: Element, cells: _Words | _Bytes) -> FileFormatError:
    expected = f"{element.count:,} rows of {shown(element.name)}, as the PLY header says"
    odd = cells.odd()
    return damaged(
        path, expected, "fewer; the file is cut short" if odd is None else f"{shown(odd)} among their numbers"
    )
