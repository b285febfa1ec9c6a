"""`report.html` of any run: the page that its question has, or what it shows of its answer as a page.

The object of an attack may be turned there: `object.js` draws the run's binary glTF.
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

from advsearch import rooms
from advsearch.errors import FileFormatError
from advsearch.files import read_bytes
from advsearch.report.markup import Html, element, join_html
from advsearch.report.shown import AnswerPart, ShownAnswer, remarks_of, shown, subject_of
from advsearch.runs.directory import OBJECT_FILE, REPORT, RunDirectory
from advsearch.runs.files import write_text
from advsearch.runs.results.base import Result
from advsearch.runs.summary import read_result
from advsearch.viewer import document
from advsearch.viewer.parts import end_html, figures_of, links_html, part_html

Answer = TypeVar("Answer", bound=Result)

LARGEST = 2_700_000
"""Bytes of an object that a page takes along."""

_WORDS = "Drag it, or choose it and press the arrow keys. It is lit evenly here, not by the scene's light."


def read_object(run: Path) -> bytes:
    """Return the object that a run has to turn; nothing where it has none, or one that is damaged or too large."""
    try:
        data = read_bytes(run / OBJECT_FILE, "an object to turn", LARGEST)
    except (OSError, FileFormatError):
        return b""
    return data if _header(data) else b""


def object_part(data: bytes) -> AnswerPart:
    """Return where the script puts the object; empty where there is none."""
    if not data:
        return AnswerPart()
    extras = _header(data).get("asset", {}).get("extras", {})
    note = str(extras.get("note", "")) if isinstance(extras, dict) else ""
    return AnswerPart("The object, to turn", note=" ".join(filter(None, (_WORDS, note))), live="object")


def object_data(data: bytes) -> list[Html]:
    """Return the script that holds the object, if there is one."""
    return [document.data_script(base64.b64encode(data).decode("ascii"), "object-file")] if data else []


def _header(data: bytes) -> dict[str, dict[str, object]]:
    """The header of a binary glTF file; empty where it is damaged."""
    try:
        magic, _, _, length, kind = struct.unpack_from("<4sII I4s", data)
        head = json.loads(data[20 : 20 + length]) if (magic, kind) == (b"glTF", b"JSON") else None
    except (struct.error, ValueError, RecursionError):
        return {}
    return head if isinstance(head, dict) and isinstance(head.get("asset"), dict) else {}


def write_page(run: Path, result: Result) -> Path:
    """Write `report.html` into the folder of a run and return its path. Raises FileFormatError where other results of
    the run are damaged, StorageError where the page cannot be written."""
    return write_text(run / REPORT, page_of(run, result), durable=False)


def page_of(run: Path, result: Result) -> str:
    """Return the page of a run, which needs no other file but those of its parts. Raises FileFormatError where other
    results of the run are damaged."""
    room = rooms.room(result.command)
    made: str | None = room.page(run, result) if room and room.page else None
    return made or shown_page(run, result, shown(result))


def keep_answer(run: RunDirectory, result: Answer) -> Answer:
    """Write the summary and the page of an answer into the open directory of its run, and return it."""
    run.write_summary(result)
    write_page(run.path, result)
    return result


def shown_page(
    run: Path, result: Result, given: ShownAnswer, *, data: Sequence[Html] = (), scripts: Sequence[str] = ()
) -> str:
    """Return what is shown of an answer as the page of the run in the folder `run`; data and scripts fill the parts
    that are `live`."""
    parts = list(getattr(result, "parts", ()))
    drawn = any(one.draw or one.figure or one.pictures for one in given.sections)
    main = element(
        "main",
        *([] if drawn else figures_of(run, given.said)),
        *(part_html(run, one, given.said) for one in given.sections if one.only in ("", "page") and not one.empty),
        links_html(run, parts) if parts and all(isinstance(one, str) for one in parts) else None,
        end_html(run, result, given),
    )
    subject = subject_of(result, given)
    what = join_html(result.command, "; " if subject else None, document.subject_html(*(("", one) for one in subject)))
    header = document.heading(what, given.said, remarks_of(result, given))
    footer = f"run {run.name}. This page needs no other file."
    title = f"{run.name}, {result.command}"
    return document.document(title, header, main, data=data, scripts=scripts, footer=footer)


def renewed(run: Path) -> Path:
    """Write the page of a run anew and return its path.

    Raises:
        FileFormatError: its results are damaged.
        StorageError: it cannot be written.
    """
    return write_page(run, read_result(run))
