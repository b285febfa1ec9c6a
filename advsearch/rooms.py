"""Questions, found by the name of their command: `advsearch/questions/NAME.py`, or a folder `NAME/` where it is large.

What is below them (the list of settings, of results, of pages) asks here, by name, so that it imports none of them. A
question is an object of its own name, which `advsearch.question.question` has made; beside it may stand `shown`,
`claims` and `page`. An older form is a folder that is the command (`COMMAND`) and has `settings.CONFIG`,
`carry_out.NAME_from_config`, `result.RESULT` and the rest in modules. The tool works without those that are missing.
"""

from __future__ import annotations

import re
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


PARTS = {
    "config": ("settings", "CONFIG"), "result": ("result", "RESULT"), "others": ("result", "BY_FIELD"),
    "from_config": ("carry_out", "{}_from_config"), "shown": ("result", "shown"), "claims": ("result", "claims"),
    "page": ("page", "page"),
}  # fmt: skip
"""Where an older form has the parts of a `Room`: a module of its folder, and the name there."""


class Room:
    """What a question has; None for what it has not. Each is imported when it is asked for.

    Attributes:
        config, result: the classes of its settings and of its result.
        others: other classes of its result, by a field that they alone have.
        from_config: what carries it out.
        shown: what makes of its result what a person is shown of it.
        claims: what yields the sentences that its result stands for.
        page: what makes a page of its own kind.
    """

    def __init__(self, name: str) -> None:
        self.name = name

    def __getattr__(self, part: str) -> Any:
        """Return a part."""
        if part not in PARTS:
            raise AttributeError(part)
        made, (module, what) = made_question(self.name), PARTS[part]
        if made and hasattr(made, part):
            return getattr(made, part)
        place = f"advsearch.questions.{self.name}" + ("" if made else f".{module}")
        there = find_spec(place) is not None
        return getattr(import_module(place), what.format(self.name), None) if there else None


def room(name: str) -> Room | None:
    """Return the question of a name; None where there is none."""
    return Room(name) if name in rooms() else None


def made_question(name: str) -> Any:
    """Return the question of a name that `advsearch.question.question` has made; None of the older form."""
    return getattr(import_module(f"advsearch.questions.{name}"), name) if name in made_questions() else None
