"""What the dashboard's server answers about the photographs of a run."""

from __future__ import annotations

import hmac
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from email.message import Message
from functools import cached_property
from http import HTTPStatus
from pathlib import Path
from typing import Any

from advsearch.extend import InputError, markup
from advsearch.questions.photographs.result import (
    align_page,
    photo_file,
    rendering_file,
    rendering_names,
    table_html,
)

# the header with which this server's page sends a photograph; another page could not
# send it
KEY = "X-Advsearch-Key"


class PhotographPages:
    """The pages on which photographs of a run are taken (see
    `advsearch.viewer.server.PhotographServer`).

    Args:
        photographs: judges and keeps them; None for `Photographs`, which needs PyTorch,
            and is loaded when a page of photographs is first opened.
    """

    def __init__(self, photographs: Any = None) -> None:
        self._given = photographs

    @cached_property
    def _photographs(self) -> Any:
        if self._given is not None:
            return self._given
        # takes seconds
        from advsearch.questions.photographs.carry_out import Photographs

        return Photographs()

    def make_page(self, run: Path, name: str, key: str, elsewhere: str | None) -> str:
        """Return the page of a run's photographs; arguments as for `align_page`."""
        return align_page(
            name, rendering_names(run), self._photographs.agreement(run), key, elsewhere
        )

    def read_picture(self, kind: str, run: Path, name: str) -> tuple[str, bytes]:
        """Return the type and the data of a "rendering", or of a "photo" that was
        kept.
        """
        with refused(HTTPStatus.NOT_FOUND):
            file = (
                rendering_file(run, name)
                if kind == "rendering"
                else photo_file(run, name)
            )
        return "image/png" if file.suffix == ".png" else "image/jpeg", file.read_bytes()

    def take(
        self,
        run: Path,
        name: str,
        headers: Message,
        key: str,
        read_data: Callable[[], bytes],
    ) -> tuple[str, bytes]:
        """Take a photograph of a rendering in, from this server's own page: another one
        has no origin, or not the key.

        `read_data` reads what was sent, once there is something to compare it with. It
        is refused where there is no such rendering, or it is no photograph.
        """
        sent = headers.get(KEY, "").encode("utf-8", "replace")
        if headers.get("Origin") is None or not hmac.compare_digest(key.encode(), sent):
            raise markup.Refused(
                HTTPStatus.FORBIDDEN,
                "a photograph is sent by the page that this server shows; open it anew",
            )
        with refused(HTTPStatus.NOT_FOUND):
            rendering_file(run, name)
        with refused(HTTPStatus.BAD_REQUEST):
            table = self._photographs.add(run, name, read_data())
        return "application/json", json.dumps(
            {"table": str(table_html(table))}
        ).encode()


@contextmanager
def refused(status: HTTPStatus) -> Iterator[None]:
    """Send what an InputError says, with a status."""
    try:
        yield
    except InputError as error:
        raise markup.Refused(status, str(error)) from None
