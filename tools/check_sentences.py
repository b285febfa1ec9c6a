"""Find decisions that depend on what a sentence says: python tools/check_sentences.py

What a sentence says steers nothing: a reason is an enum or a field with a text, and
code asks that.

A sentence for people is worded anew at any time; what was decided by its words would
then be decided otherwise without a failing test.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent

SENTENCES = frozenset(
    "brief caution cautions command_line hint message note reason refusal remark remarks "
    "said sentence statement warning warnings what why".split()
)
"""Attributes that hold text for people."""

ERRORS = frozenset(
    {"e", "err", "error", "exc", "exception"}
)  # what a caught error is called

BEGINNINGS = ("startswith", "endswith")

WORDS = re.compile(r"[^\W\d_][,;:.]* [^\W\d_]")

LONGEST_VALUE = 3  # words of the value of a field such as `ending`: "already wrong"

EXCEPTIONS = {
    "advsearch/api/keywords.py": "a docstring, to which a paragraph is added if it has not got it",
    "advsearch/attacks/objectives.py": "messages of torch and Python, which have no other mark",
    "advsearch/questions/stability/scenes.py": "a case that checks the words of a message",
    "advsearch/questions/stability/result.py": "measurements are grouped by name",
    "advsearch/runs/files.py": "a message of OpenEXR, which has no other mark",
    "advsearch/tasks/detector_outputs.py": "the words name an output's columns",
    "advsearch/trust/writing.py": "messages of SQLite, which have no other mark",
}
"""Files that may look into a text, and why."""


def has_words(node: ast.expr, fewest: int = 2) -> bool:
    """Return whether a literal, or one of a collection, has so many words."""
    if isinstance(node, ast.Constant):
        return (
            isinstance(node.value, str)
            and bool(WORDS.search(node.value))
            and len(node.value.split()) >= fewest
        )
    if isinstance(node, ast.JoinedStr):
        return any(has_words(part, fewest) for part in node.values)
    if isinstance(node, (ast.Tuple, ast.List, ast.Set)):
        return any(has_words(element, fewest) for element in node.elts)
    return False


def is_sentence(node: ast.expr) -> bool:
    """Return whether it is an attribute of `SENTENCES`, or the text of an error."""
    if isinstance(node, ast.Attribute):
        return node.attr in SENTENCES
    if not isinstance(node, ast.Call):
        return False
    if isinstance(node.func, ast.Attribute):  # of `error.reason.lower()`
        return is_sentence(node.func.value)
    is_text = isinstance(node.func, ast.Name) and node.func.id == "str"
    errors = [
        one for one in node.args if isinstance(one, ast.Name) and one.id in ERRORS
    ]
    return is_text and bool(errors)


def is_fixed_text(node: ast.expr) -> bool:
    """Return whether it is a text that is not empty, or constants, also by name."""
    if isinstance(node, ast.Constant):
        return isinstance(node.value, str) and node.value != ""
    if isinstance(node, (ast.Tuple, ast.List, ast.Set)):
        return any(map(is_fixed_text, node.elts))
    name = (
        node.attr
        if isinstance(node, ast.Attribute)
        else node.id
        if isinstance(node, ast.Name)
        else ""
    )
    return name.isupper()


def is_decision(left: ast.expr, operator: ast.cmpop, right: ast.expr) -> bool:
    """Return whether a comparison depends on what a sentence says."""
    if isinstance(operator, (ast.In, ast.NotIn)):
        is_of_collection = isinstance(right, (ast.Tuple, ast.List, ast.Set))
        looks_for_words = has_words(left) and not is_of_collection
        looks_into = is_sentence(right) and (
            is_fixed_text(left) or isinstance(right, ast.Call)
        )
        is_one_of = is_sentence(left) and is_fixed_text(right)
        return looks_for_words or looks_into or is_one_of
    if isinstance(operator, (ast.Eq, ast.NotEq)):
        for side, other in ((left, right), (right, left)):
            if has_words(side, LONGEST_VALUE + 1) or (
                is_sentence(side) and is_fixed_text(other)
            ):
                return True
    return False


def find_decisions(source: str) -> Iterator[int]:
    """Yield the line of each decision in a module that depends on what a sentence says."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Compare):
            compared = [node.left, *node.comparators]
            for left, operator, right in zip(
                compared, node.ops, node.comparators, strict=False
            ):
                if is_decision(left, operator, right):
                    yield node.lineno
        elif (
            isinstance(node, ast.Call)
            and isinstance(node.func, ast.Attribute)
            and node.func.attr in BEGINNINGS
        ):
            if any(map(has_words, node.args)) or is_sentence(node.func.value):
                yield node.lineno


def main() -> int:
    """Print the place of each such decision; return 1 if there is one."""
    found = False
    for path in sorted((ROOT / "advsearch").rglob("*.py")):
        name = path.relative_to(ROOT).as_posix()
        if name in EXCEPTIONS:
            continue
        for line in find_decisions(path.read_text("utf-8")):
            found = True
            print(f"{name}:{line}: a decision that depends on the text of a sentence")
    return int(found)


if __name__ == "__main__":
    sys.exit(main())
