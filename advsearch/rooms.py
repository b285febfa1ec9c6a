"""Questions that are rooms of their own: `advsearch/questions/NAME/`, found by the name of their command.

What is below them (the list of settings, of results, of pages) asks here, by name, so that it imports none of them. A
room is the command of the question (`COMMAND`), and has `settings.CONFIG`, `carry_out.NAME_from_config`,
`answer.RESULT`, `answer.shown` and `answer.claims`, and `page.page` where its page is of its own kind; a question that
needs less has less. The tool works without those whose folder is missing.
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent / "questions"


@cache
def rooms() -> tuple[str, ...]:
    """Return the names of the questions that are rooms."""
    return tuple(sorted(path.parent.name for path in FOLDER.glob("*/__init__.py")))


def there(module: str) -> bool:
    """Return whether a module is none of a question whose folder is missing."""
    parts = module.split(".")
    return parts[:2] != ["advsearch", "questions"] or parts[2] in rooms()


def in_room(name: str, module: str, what: str) -> Any:
    """Return what a question has in one of its modules, such as `CONFIG` in `settings`; None where it has no such, or
    is no room."""
    path = f"advsearch.questions.{name}.{module}"
    if name not in rooms() or find_spec(path) is None:
        return None
    return getattr(import_module(path), what, None)


def in_rooms(module: str, what: str) -> list[Any]:
    """Return what all questions that have it have in a module of this name."""
    return [found for name in rooms() if (found := in_room(name, module, what)) is not None]
