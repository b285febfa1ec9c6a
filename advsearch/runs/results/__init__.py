"""What each command answers: one model a command, which table, page, JSON and docs read."""

from __future__ import annotations

from advsearch import rooms
from advsearch.files import JsonObject
from advsearch.runs.results.base import Result


def kind_of(values: JsonObject) -> type[Result] | None:
    """Return the result that the values of a `summary.json` are of; None if there is none of that command."""
    command = str(values.get("command"))
    others: dict[str, type[Result]] = rooms.in_room(command, "answer", "BY_FIELD") or {}
    told = next((kind for name, kind in others.items() if name in values), None)
    return told or rooms.in_room(command, "answer", "RESULT")
