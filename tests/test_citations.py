"""What code, comments and pages cite is there: modules and what is in them, files, pages and their headings."""

from __future__ import annotations

import importlib
import importlib.util
import re
from pathlib import Path

import pytest

from advsearch.attacks import POLICIES
from advsearch.attacks.objectives import OBJECTIVE_KINDS
from advsearch.controls import CONTROLS
from advsearch.models.loading import SOURCES as SOURCES_OF_MODELS

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("advsearch", "benchmarks", "docs", "scenes", "tests", "tools")
SOURCES = [
    ROOT / "Makefile",
    *sorted(ROOT.glob("*.md")),
    *sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*") if path.suffix in (".md", ".py", ".sh")),
]
MADE_UP = {"tests/test_architecture.py", "tests/test_citations.py", "tests/test_registry.py"}
"""Tests of such rules, which name modules that are not there."""
NAME = re.compile(r"(?<![\w./-])`?(advsearch(?:\.[A-Za-z_]\w*)+)(?:\(\))?`?(?![\w/-])")
GROUPS = {one.group for one in (CONTROLS, OBJECTIVE_KINDS, POLICIES, SOURCES_OF_MODELS)}
"""Groups of entry points, which are names and no modules."""
PATH = re.compile(rf"(?<![\w./-])((?:{'|'.join(FOLDERS)})/[\w./-]*\w\.(?:py|md|sh|json|png))")
PLACEHOLDER = re.compile(r"\b[A-Z]{4,}\.")
HEADING = re.compile(r'(docs/[\w/-]+\.md),\s+"([^"]+)"')
ELSEWHERE = re.compile(r"\bDESIGN\b")
"""How a text outside the repository was cited."""


def name_of(path: Path) -> str:
    """Return a path from the repository's root."""
    return path.relative_to(ROOT).as_posix()


def lost_in(text: str) -> list[str]:
    """Return what a text cites and is not there."""
    lost = [name for name in NAME.findall(text) if name not in GROUPS and not is_there(name)]
    lost += [path for path in PATH.findall(text) if not PLACEHOLDER.search(path) and not (ROOT / path).exists()]
    for page, heading in HEADING.findall(" ".join(text.split())):
        titles = re.findall(r"^#+ (.*)$", (ROOT / page).read_text("utf-8"), re.M) if (ROOT / page).exists() else []
        lost += [f'{page}, "{heading}"'] * (heading not in titles)
    return lost + ELSEWHERE.findall(text)


def is_there(name: str) -> bool:
    """Whether a dotted name is a module, or something in one."""
    parts = name.split(".")
    found = importlib.import_module(parts[0])
    for number, part in enumerate(parts[1:], start=2):
        if not hasattr(found, part):
            if not hasattr(found, "__path__") or importlib.util.find_spec(".".join(parts[:number])) is None:
                return False
            importlib.import_module(".".join(parts[:number]))
        found = getattr(found, part)
    return True


@pytest.mark.parametrize("source", [path for path in map(name_of, SOURCES) if path not in MADE_UP])
def test_what_a_file_cites_is_there(source: str) -> None:
    assert not lost_in((ROOT / source).read_text("utf-8"))


@pytest.mark.parametrize(
    "text",
    [
        "see `advsearch.scene.nowhere`",
        "advsearch.errors.NoSuchError is raised",
        "as benchmarks/nothing.py measures",
        "the rule (docs/design.md, \"No such heading\")",
        "the rule (docs/nothing.md)",
        "as in DESIGN",
    ],
)  # fmt: skip
def test_what_is_not_there_is_seen(text: str) -> None:
    assert lost_in(text)


def test_what_is_there_is_not_called_lost() -> None:
    text = 'see `advsearch.errors.InputError`, advsearch.scene.renderer, docs/runs.md and docs/design.md, "The\nsearch"'
    assert not lost_in(text) and NAME.findall(text) and PATH.findall(text) and HEADING.findall(" ".join(text.split()))
