"""Hides islands from Python, as if their files had been deleted: `make test-core` runs the core's tests without them.

A test that needs an island says so by the marker `island` with the island's module, for itself, for a case or in
`pytestmark` for its file. It is left out where this island is hidden.
"""

from __future__ import annotations

import ast
import os
import runpy
import sys
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
VARIABLE = "ADVSEARCH_HIDDEN_MODULES"
"""Environment variable that tells child processes what to hide; `sitecustomize.py` reads it."""


class Hider:
    """Python's first finder of modules: of hidden ones, and of what is in them, it says that there are none."""

    def __init__(self) -> None:
        self.modules: frozenset[str] = frozenset()

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> None:
        """Leave a module to the other finders.

        Raises:
            ModuleNotFoundError: it is hidden.
        """
        if any(name == module or name.startswith(f"{module}.") for module in self.modules):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


HIDER = Hider()


def hide(modules: Iterable[str]) -> None:
    """Hide these modules, and only these, from this process. They must not be imported yet."""
    HIDER.modules = frozenset(modules)
    if HIDER not in sys.meta_path:
        sys.meta_path.insert(0, HIDER)


def hide_from_children(modules: Iterable[str]) -> None:
    """Hide modules from the processes that this one starts, but for those that get another `PYTHONPATH`."""
    os.environ[VARIABLE] = ",".join(modules)
    before = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT / "tests"), str(ROOT), *filter(None, before)])


@cache
def read_catalog() -> tuple[Any, ...]:
    """Return the built-in parts without an import of the package, which looks at once for those that are there."""
    parts: tuple[Any, ...] = runpy.run_path(str(ROOT / "advsearch" / "catalog.py"))["BUILT_INS"]
    return parts


def choose_islands(asked: str, islands: Iterable[str]) -> set[str]:
    """Return the islands that are asked for.

    Args:
        asked: modules or kinds of islands, with commas between them; `all` are all.
        islands: the module of each island.

    Raises:
        ValueError: one is neither an island nor a kind.
    """
    kinds: dict[str, set[str]] = {"all": set(islands)}
    for part in read_catalog():
        module = part.import_path.partition(":")[0]
        kinds.setdefault(part.kind, set()).update({module} & kinds["all"])
    chosen = set[str]()
    for name in asked.split(","):
        if name not in kinds and name not in islands:
            raise ValueError(
                f"expected an island ({', '.join(sorted(kinds['all']))}) or {', '.join(kinds)}, got {name}"
            )
        chosen |= kinds.get(name, {name})
    return chosen


def list_marks(tree: ast.AST) -> Iterator[str]:
    """Yield the modules that markers `island` name in a file of tests, or in a part of one."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "island":
            yield from (str(argument.value) for argument in node.args if isinstance(argument, ast.Constant))


def list_marks_of_file(tree: ast.Module) -> set[str]:
    """Return the islands that a file of tests needs as a whole, so that it is not even imported without them."""
    found = set[str]()
    for node in tree.body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "pytestmark":
            found.update(list_marks(node))
    return found
