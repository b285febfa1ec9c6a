"""The object of an attack in its page, to turn: the run's binary glTF, which `object.js` draws."""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path

from advsearch.errors import FileFormatError
from advsearch.files import read_bytes
from advsearch.report.markup import Html, element
from advsearch.runs.directory import OBJECT_FILE
from advsearch.viewer.document import data_script

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


def object_section(data: bytes) -> Html | None:
    """Return where the script puts the object; hidden until it does, so that without it the pictures stand alone."""
    if not data:
        return None
    extras = _header(data).get("asset", {}).get("extras", {})
    note = str(extras.get("note", "")) if isinstance(extras, dict) else ""
    words = element("p", " ".join(filter(None, (_WORDS, note))), class_="soft")
    return element("div", element("h2", "The object, to turn"), element("div", id="object"), words, hidden="hidden")


def object_data(data: bytes) -> list[Html]:
    """Return the script that holds the object, if there is one."""
    return [data_script(base64.b64encode(data).decode("ascii"), "object-file")] if data else []


def _header(data: bytes) -> dict[str, dict[str, object]]:
    """The header of a binary glTF file; empty where it is damaged."""
    try:
        magic, _, _, length, kind = struct.unpack_from("<4sII I4s", data)
        head = json.loads(data[20 : 20 + length]) if (magic, kind) == (b"glTF", b"JSON") else None
    except (struct.error, ValueError, RecursionError):
        return {}
    return head if isinstance(head, dict) and isinstance(head.get("asset"), dict) else {}
