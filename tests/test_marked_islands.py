"""Tests that need an island say so, and name islands that there are: the marker `island` (tests/hidden_islands.py)."""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from hidden_islands import choose_islands, list_marks, list_marks_of_file
from test_islands import find_island, island_of_module

TESTS = Path(__file__).parent


@cache
def read_test_files() -> dict[str, ast.Module]:
    """Return the parsed files of tests by their path below this folder."""
    files = sorted(TESTS.rglob("test_*.py"))
    return {str(path.relative_to(TESTS)): ast.parse(path.read_text("utf-8")) for path in files}


def imported_islands(node: ast.AST) -> set[str]:
    """Return the islands that a part of a file imports."""
    names = list[str]()
    for one in ast.walk(node):
        if isinstance(one, ast.ImportFrom) and one.module:
            names += [f"{one.module}.{alias.name}" for alias in one.names]
        if isinstance(one, ast.Import):
            names += [alias.name for alias in one.names]
    return {island for name in names if (island := find_island(name)) is not None}


def missing_marks() -> Iterator[str]:
    """Yield each test, and each file, that imports an island that it is not marked with."""
    for name, tree in read_test_files().items():
        of_file = list_marks_of_file(tree)
        for node in tree.body:
            marks = set(of_file)
            if isinstance(node, ast.FunctionDef):
                marks.update(*map(list_marks, node.decorator_list))
            is_checked = isinstance(node, (ast.Import, ast.ImportFrom)) or getattr(node, "name", "").startswith("test_")
            if is_checked and "all" not in marks:
                yield from (f"{name}, line {node.lineno}: {island}" for island in imported_islands(node) - marks)


@pytest.mark.medium
def test_a_test_that_imports_an_island_is_marked_with_it() -> None:
    assert list(missing_marks()) == []


@pytest.mark.medium
def test_markers_name_islands_that_there_are() -> None:
    marks = {mark for tree in read_test_files().values() for mark in list_marks(tree)}
    assert marks - {"all", *island_of_module()} == set()


def test_islands_are_asked_for_by_module_or_kind() -> None:
    islands = island_of_module()
    assert choose_islands("all", islands) == set(islands)
    assert choose_islands("advsearch.controls.sky,converter", islands) == {
        "advsearch.controls.sky", "advsearch.scene.importing.blender", "advsearch.scene.importing.usd",
    }  # fmt: skip
    with pytest.raises(ValueError, match=r"got advsearch\.controls\.pose"):
        choose_islands("advsearch.controls.pose", islands)
