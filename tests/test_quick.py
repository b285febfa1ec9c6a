"""`make test-quick` covers every room, and the list of what it leaves out names tests that there are."""

from __future__ import annotations

import ast

import pytest
from conftest import MEDIUM, ROOT, is_there, medium

WHOLE_RUNS = {"tests/test_real_data.py"}
"""Nothing in them is quick."""
FILES = [path.relative_to(ROOT).as_posix() for path in sorted(MEDIUM.parent.rglob("test_*.py"))]


def functions_of(file: str) -> dict[str, bool]:
    """Return the tests of a file by name, and whether each is slow whatever its parameters are."""
    tree = ast.parse((ROOT / file).read_text("utf-8"))
    functions = [node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")]
    return {one.name: "pytest.mark.slow" in map(ast.unparse, one.decorator_list) for one in functions}


@pytest.mark.parametrize("file", [file for file in FILES if file not in WHOLE_RUNS])
def test_every_file_has_quick_tests(file: str) -> None:
    """Of a test with parameters some are: `--measure` never takes the quickest of a file."""
    assert [name for name, slow in functions_of(file).items() if not slow and f"{file}::{name}" not in medium()]


def test_what_is_left_out_is_there() -> None:
    assert not [name for name in medium() if not is_there(name)], "pytest --measure tests/test_quick.py takes it out"


def test_what_is_left_out_is_marked(request: pytest.FixtureRequest) -> None:
    for item in request.session.items:
        assert (item.get_closest_marker("medium") is not None) == (item.nodeid in medium())
