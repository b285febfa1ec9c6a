"""Questions, found by the name of their command: `advsearch/questions/NAME.py`, or a folder `NAME/` where it is large.

What is below them (the list of settings, of results, of pages) asks here, by name, so that it imports none of them. A
question is an object of its own name, which `advsearch.question.question` has made; beside it may stand `shown`,
`claims` and `page`. An older form is a folder that is the command (`COMMAND`) and has `settings.CONFIG`,
`carry_out.NAME_from_config`, `result.RESULT` and the rest in modules. The tool works without those that are missing.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent / "questions"


@cache
def _texts() -> dict[str, str]:
    """The first file of each question, by its name: what is asked of all of them imports none."""
    files = {path.stem: path for path in FOLDER.glob("*.py") if path.stem != "__init__"}
    files |= {path.parent.name: path for path in FOLDER.glob("*/__init__.py")}
    return {name: files[name].read_text(encoding="utf-8") for name in sorted(files)}


def rooms() -> tuple[str, ...]:
    """Return the names of the questions."""
    return tuple(_texts())


def made_questions() -> tuple[str, ...]:
    """Return the names of those that `advsearch.question.question` makes."""
    return tuple(name for name, text in _texts().items() if "\n@question(" in text)


def help_of(name: str) -> str:
    """Return what a question does, in a line: the first of its file, or in the older form `HELP`."""
    text = _texts()[name]
    told = re.search(r'^HELP = "(.*)"$', text, re.MULTILINE)
    first = told[1] if told else text.partition("\n")[0].strip('" ').rstrip(".")
    return first[:1].lower() + first[1:]


def there(module: str) -> bool:
    """Return whether a module is none of a question that is missing."""
    parts = module.split(".")
    return parts[:2] != ["advsearch", "questions"] or parts[2] in rooms()


class Room:
    """What a question has; None for what it has not. Each is imported when it is asked for."""

    def __init__(self, name: str) -> None:
        self.name = name

    def _own(self, module: str, what: str) -> Any:
        package = import_module(f"advsearch.questions.{self.name}")
        return getattr(package, what, None) if made_question(self.name) else in_room(self.name, module, what)

    @property
    def config(self) -> Any:
        """The class of its settings."""
        made = made_question(self.name)
        return made.config if made else in_room(self.name, "settings", "CONFIG")

    @property
    def result(self) -> Any:
        """The class of its result."""
        made = made_question(self.name)
        return made.result if made else in_room(self.name, "result", "RESULT")

    @property
    def others(self) -> Mapping[str, Any]:
        """Other classes of its result, by a field that they alone have."""
        return self._own("result", "BY_FIELD") or {}

    @property
    def from_config(self) -> Any:
        """What carries it out."""
        made = made_question(self.name)
        return made.from_config if made else in_room(self.name, "carry_out", f"{self.name}_from_config")

    @property
    def shown(self) -> Any:
        """What makes of its result what a person is shown of it."""
        return self._own("result", "shown")

    @property
    def claims(self) -> Any:
        """What yields the sentences that its result stands for."""
        return self._own("result", "claims")

    @property
    def page(self) -> Any:
        """What makes a page of its own kind."""
        return self._own("page", "page")


def room(name: str) -> Room | None:
    """Return the question of a name; None where there is none."""
    return Room(name) if name in rooms() else None


def made_question(name: str) -> Any:
    """Return the question of a name that `advsearch.question.question` has made; None of the older form."""
    return getattr(import_module(f"advsearch.questions.{name}"), name) if name in made_questions() else None


def in_room(name: str, module: str, what: str) -> Any:
    """Return what a question has in one of the modules of its folder; None where it has no such."""
    path = f"advsearch.questions.{name}.{module}"
    if name not in rooms() or find_spec(path) is None:
        return None
    return getattr(import_module(path), what, None)
