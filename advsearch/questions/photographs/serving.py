"""What the dashboard's server answers about photographs, and how one is taken in."""

from __future__ import annotations

import hmac
import json
import re
import time
from collections.abc import Callable
from email.message import Message
from http import HTTPStatus
from io import BufferedIOBase
from pathlib import Path
from typing import Protocol

from advsearch.errors import InputError
from advsearch.questions.photographs.answer import PhotoAgreement
from advsearch.questions.photographs.files import LARGEST, photo_file, rendering_file, rendering_names
from advsearch.questions.photographs.page import align_page, table_html
from advsearch.viewer.refused import Refused

SENDING = 60.0
"""Seconds in which a photograph has to have come."""

KEY = "X-Advsearch-Key"
"""The header with which this server's page sends a photograph; another page could not send it."""

Response = tuple[str, bytes]
"""A media type, and the data."""


class PhotoTaker(Protocol):
    """Takes photographs in; `Photographs` does."""

    def add(self, run: Path, rendering: str, data: bytes) -> PhotoAgreement:
        """Judge and keep a photograph, and return the run's table; InputError says why it can't."""

    def agreement(self, run: Path) -> PhotoAgreement:
        """Return the run's table."""


def photographs_html(taker: PhotoTaker | None, run: Path, name: str, key: str, elsewhere: str | None) -> bytes:
    """Return the page of a run's photographs; arguments as for `align_page`."""
    table = _there(taker).agreement(run)
    return align_page(name, rendering_names(run), table, key, elsewhere).encode()


def rendering_picture(run: Path, name: str) -> Response:
    """Return the picture of a rendering."""
    file = _found(rendering_file, run, name)
    return "image/png" if file.suffix == ".png" else "image/jpeg", file.read_bytes()


def photo(run: Path, name: str) -> Response:
    """Return a photograph that was kept."""
    return "image/jpeg", _found(photo_file, run, name).read_bytes()


def check_sender(headers: Message, key: str) -> None:
    """Refuse what this server's own page did not send.

    Raises:
        Refused: it has no origin, or not the key.
    """
    given = headers.get(KEY, "").encode("utf-8", "replace")
    if headers.get("Origin") is None or not hmac.compare_digest(key.encode(), given):
        raise Refused(HTTPStatus.FORBIDDEN, "a photograph is sent by the page that this server shows; open it anew")


def take(taker: PhotoTaker | None, run: Path, name: str, data: Callable[[], bytes]) -> Response:
    """Take a photograph in.

    Args:
        taker: what does; None where nothing does.
        run: its folder.
        name: of the rendering.
        data: reads what was sent, once there is something to compare it with.

    Raises:
        Refused: there is no such rendering, or it is no photograph.
    """
    _found(rendering_file, run, name)
    try:
        table = _there(taker).add(run, name, data())
    except InputError as error:
        raise Refused(HTTPStatus.BAD_REQUEST, str(error)) from None
    return "application/json", json.dumps({"table": str(table_html(table))}).encode()


def request_body(headers: Message, stream: BufferedIOBase) -> bytes:
    """Return what was sent along; nothing is read of what says that it is larger than `LARGEST`.

    Raises:
        Refused: it is too large, says no length, or does not come.
    """
    length = headers.get("Content-Length", "")
    if not re.fullmatch(r"[0-9]{1,15}", length):
        raise Refused(HTTPStatus.LENGTH_REQUIRED, "its length is missing")
    if int(length) > LARGEST:
        raise Refused(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"more than {LARGEST >> 20} MB")
    parts, left, end = [], int(length), time.monotonic() + SENDING
    while left:
        part = stream.read1(min(left, 1 << 16)) if time.monotonic() < end else b""
        if not part:
            raise Refused(HTTPStatus.BAD_REQUEST, "a part of it did not come")
        parts.append(part)
        left -= len(part)
    return b"".join(parts)


def _there(taker: PhotoTaker | None) -> PhotoTaker:
    if taker is None:
        raise Refused(HTTPStatus.NOT_FOUND, "this server takes no photographs; advsearch dashboard does")
    return taker


def _found(find: Callable[[Path, str], Path], run: Path, name: str) -> Path:
    """The file that `find` returns; what it says of one that is not there becomes the answer."""
    try:
        return find(run, name)
    except InputError as error:
        raise Refused(HTTPStatus.NOT_FOUND, str(error)) from None
