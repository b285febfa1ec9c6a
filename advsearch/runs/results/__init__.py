"""What each command answers: one model a command, which table, page, JSON and docs read."""

from __future__ import annotations

from advsearch import rooms
from advsearch.files import JsonObject
from advsearch.runs.results.base import Result


def kind_of(values: JsonObject) -> type[Result] | None:
    """Return the result that the values of a `summary.json` are of; None if there is none of that command."""
    room = rooms.room(str(values.get("command")))
    if room is None:
        return None
    kind: type[Result] | None = next((kind for name, kind in room.others.items() if name in values), room.result)
    return kind
