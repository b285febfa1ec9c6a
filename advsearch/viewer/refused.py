"""Requests that the dashboard's server does not answer as asked."""

from __future__ import annotations

from http import HTTPStatus


class Refused(Exception):
    """A request that is not answered as asked."""

    def __init__(self, status: HTTPStatus, text: str) -> None:
        super().__init__(text)
        self.status = status
