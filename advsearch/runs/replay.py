"""`replay.bin`: what a search was told, so that a run that was stopped can go on exactly where it was.

A policy's state follows from what it has been told, so a search is continued by telling it all of that again. The rows
of the store have the objectives; this log has the rest: gradients, logits and the pictures of the animation. It is
written before the row it belongs to, grows by four bytes a number, and is removed when the run is done.

One entry: magic, length of the head, length of the body, CRC-32 of both (four little-endian 32-bit numbers); the head
as JSON; the body, which the head cuts into arrays. An entry that a kill has cut short is dropped.
"""

from __future__ import annotations

import json
import os
import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, final

import numpy as np
from numpy.typing import NDArray

from advsearch.errors import FileFormatError
from advsearch.files import open_regular, parse_json
from advsearch.runs.files import storage_errors
from advsearch.runs.results.base import Fields, Payload
from advsearch.runs.results.render import ClassAnswer

NAME = "replay.bin"

LARGEST = 1 << 38
"""Most bytes of a log that is read by others."""

_START = struct.Struct("<4sIII")
_MAGIC = b"ADVr"

Array = NDArray[Any]


class LoggedJudgement(Fields):
    """What a task said; floats come back bit for bit."""

    score: float
    margin: float
    right: bool
    answer: ClassAnswer
    payload: Payload = None
    metrics: dict[str, float | None] | None = None


class LoggedEvaluation(Fields):
    """One evaluation without its arrays.

    Attributes:
        index: of its step.
        u: digest of the configuration.
        objective: in hexadecimal, or "nan" or "inf".
        success: whether the answer is what is sought.
        non_finite: numbers that were not.
        cost: in evaluations.
        seconds: that it took.
        judgement: None where there was none.
    """

    index: int
    u: str
    objective: str
    success: bool
    non_finite: int
    cost: int
    seconds: float
    judgement: LoggedJudgement | None = None


@dataclass(frozen=True, eq=False)
class Entry:
    """What one evaluation told.

    Attributes:
        kind: of search: ``"search"``, ``"baseline"``.
        number: of the evaluation within its kind, from 0.
        facts: what was told beside the arrays.
        arrays: by name.
    """

    kind: str
    number: int
    facts: LoggedEvaluation
    arrays: Mapping[str, Array] = field(default_factory=dict)


@final
class ReplayLog:
    """The open log. Whole entries that are in the file already can be read; new ones go behind them.

    Args:
        path: the file; made when it is not there.

    Raises:
        StorageError: it cannot be read or written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._places: dict[tuple[str, int], int] = {}
        with storage_errors(path):
            path.touch()
            self._file: BinaryIO = path.open("r+b", buffering=0)
            try:
                end = self._index()
                self._file.truncate(end)
                self._file.seek(end)
            except BaseException:
                self._file.close()
                raise

    def __contains__(self, key: tuple[str, int]) -> bool:
        """Whether there is an entry of (kind, number)."""
        return key in self._places

    def read(self, kind: str, number: int) -> Entry:
        """Return an entry.

        Raises:
            KeyError: there is none.
        """
        here = self._file.tell()
        try:
            entry = _read(self._file, self._places[kind, number])
        finally:
            self._file.seek(here)
        if entry is None:
            raise KeyError((kind, number))
        return entry

    def append(self, entry: Entry) -> None:
        """Add an entry; it survives a kill of the process when this returns.

        Raises:
            StorageError: the disk is full or cannot be written.
        """
        shapes = {name: (str(array.dtype), list(array.shape)) for name, array in entry.arrays.items()}
        facts = entry.facts.model_dump()
        head = json.dumps({"kind": entry.kind, "number": entry.number, "facts": facts, "arrays": shapes}).encode()
        body = b"".join(np.ascontiguousarray(array).tobytes() for array in entry.arrays.values())
        start = _START.pack(_MAGIC, len(head), len(body), zlib.crc32(body, zlib.crc32(head)))
        with storage_errors(self.path):
            place = self._file.tell()
            self._file.write(start + head + body)
        self._places[entry.kind, entry.number] = place

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        self._file.close()

    def remove(self) -> None:
        """Close the file and delete it: the run is done."""
        self.close()
        with storage_errors(self.path):
            self.path.unlink(missing_ok=True)

    def _index(self) -> int:
        """Find the whole entries and return where the last one ends."""
        place = 0
        while (entry := _read(self._file, place)) is not None:
            self._places[entry.kind, entry.number] = place
            place = self._file.tell()
        return place


def entries(path: Path, place: int = 0) -> Iterator[tuple[Entry, int]]:
    """Yield the whole entries of a log that somebody else may be writing, each with the place behind it.

    Args:
        path: the file; nothing is yielded where there is none.
        place: where to begin, in bytes.

    Raises:
        FileFormatError: it is no ordinary file, or holds something else.
    """
    try:
        file = open_regular(path, "what a search was told", LARGEST)
    except FileNotFoundError:
        return
    with file:
        while (entry := _read(file, place)) is not None:
            place = file.tell()
            yield entry, place


def _read(file: BinaryIO, place: int) -> Entry | None:
    """The entry that begins at `place`, or None if there is no whole one."""
    file.seek(place)
    start = file.read(_START.size)
    if len(start) < _START.size:
        return None
    magic, head_size, body_size, checksum = _START.unpack(start)
    there = os.fstat(file.fileno()).st_size - file.tell()
    data = file.read(head_size + body_size) if magic == _MAGIC and head_size + body_size <= there else b""
    if len(data) < head_size + body_size or zlib.crc32(data) != checksum or not data:
        return None
    try:
        return _entry(data, head_size)
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
        # Its checksum is right: not cut short, but written by somebody else.
        raise FileFormatError(f"{file.name}: expected what a search was told, got something else ({error})") from None


def _entry(data: bytes, head_size: int) -> Entry:
    """The entry in a head and the body behind it."""
    head, arrays, begin = parse_json(data[:head_size]), {}, head_size
    for name, (dtype, shape) in head["arrays"].items():
        count = int(np.prod(shape, dtype=np.int64))
        arrays[name] = np.frombuffer(data, dtype, count, begin).reshape(shape).copy()
        begin += arrays[name].nbytes
    kind, number = head["kind"], head["number"]
    if not (isinstance(kind, str) and isinstance(number, int)):
        raise TypeError("an entry of another type")
    return Entry(kind, number, LoggedEvaluation.of(head["facts"]), arrays)
