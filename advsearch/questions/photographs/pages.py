"""The pages of the dashboard's server on which photographs are taken."""

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
    find_photo,
    find_rendering,
    list_renderings,
    make_agreement_table,
    make_align_page,
)

KEY = "X-Advsearch-Key"
"""Header with which this server's page sends the key; no other page knows the key."""


class PhotographPages:
    """Serve the pages on which photographs of a run are taken.

    See `advsearch.viewer.server.PhotographServer`.

    Args:
        photographs: evaluates and stores them; None for `Photographs`, which needs
            PyTorch, and is loaded when a page of photographs is first opened.
    """

    def __init__(self, photographs: Any = None) -> None:
        self._injected = photographs

    @cached_property
    def _photographs(self) -> Any:
        """What evaluates photographs: the injected object, or one of the package."""
        if self._injected is not None:
            return self._injected
        # The import takes seconds.
        from advsearch.questions.photographs.carry_out import Photographs

        return Photographs()

    def make_page(
        self, run: Path, name: str, key: str, other_device_url: str | None
    ) -> str:
        """Return the page on which photographs of a run are taken, as HTML.

        Args:
            run: the directory of the run.
            name: name of the run.
            key: key that the server expects with a photograph.
            other_device_url: address by which another device opens the page; None if
                none can.
        """
        return make_align_page(
            name,
            list_renderings(run),
            self._photographs.agreement(run),
            key,
            other_device_url,
        )

    def read_picture(self, kind: str, run: Path, name: str) -> tuple[str, bytes]:
        """Return the media type and the data of a stored image.

        Args:
            kind: "rendering" or "photo".
            run: the directory of the run.
            name: name of the image.

        Raises:
            RequestRejected: there is no such image.
        """
        with reject_invalid(HTTPStatus.NOT_FOUND):
            if kind == "rendering":
                file = find_rendering(run, name)
            else:
                file = find_photo(run, name)
        media_type = "image/png" if file.suffix == ".png" else "image/jpeg"
        return media_type, file.read_bytes()

    def store_photograph(
        self,
        run: Path,
        name: str,
        headers: Message,
        key: str,
        read_data: Callable[[], bytes],
    ) -> tuple[str, bytes]:
        """Store a photograph of a rendering, and return the table of agreement as JSON.

        The table counts the photographs in which the model is right if it is right
        about the rendering, and wrong if it is wrong. The request is checked first:
        another web page in the same browser must not be able to send photographs to
        this server.

        Args:
            run: the directory of the run.
            name: name of the rendering.
            headers: headers of the request.
            key: key that only this server's own page knows. A request without it, or
                without the header "Origin" that a browser adds, is rejected.
            read_data: reads the photograph, once the rendering is known to exist.

        Raises:
            RequestRejected: another page sent it, there is no such rendering, or the
                data is no photograph.
        """
        _check_sender(headers, key)
        with reject_invalid(HTTPStatus.NOT_FOUND):
            find_rendering(run, name)
        with reject_invalid(HTTPStatus.BAD_REQUEST):
            table = self._photographs.add(run, name, read_data())
        response = {"table": str(make_agreement_table(table))}
        return "application/json", json.dumps(response).encode()


def _check_sender(headers: Message, key: str) -> None:
    """Raise an error unless a request comes from this server's own page.

    Raises:
        RequestRejected: the request lacks the key, or the header "Origin".
    """
    sent_key = headers.get(KEY, "").encode("utf-8", "replace")
    # `compare_digest` takes equally long for all keys, so that its time reveals
    # nothing about the key.
    has_key = hmac.compare_digest(key.encode(), sent_key)
    if headers.get("Origin") is None or not has_key:
        raise markup.RequestRejected(
            HTTPStatus.FORBIDDEN,
            "a photograph is sent by the page that this server shows; open it anew",
        )


@contextmanager
def reject_invalid(status: HTTPStatus) -> Iterator[None]:
    """Turn an InputError into a response with a status."""
    try:
        yield
    except InputError as error:
        raise markup.RequestRejected(status, str(error)) from None
