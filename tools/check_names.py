"""Check how the package's code reads: vague names, packed lines, long functions.

    python tools/check_names.py [--list] [PACKAGE]

`make lint` runs it. It reports, with file and line:

- names with a part that says nothing (`shown`, `given`, `one`, ...), where the package
  defines them: functions, classes, parameters, variables, attributes;
- `a, b = x, y`, which puts two thoughts on one line;
- a conditional expression inside another;
- functions with 15 local variables or more;
- functions whose body has more than 25 lines of code;
- descriptions of arguments and attributes that begin with "of": `seed: of the noise`
  has to be read twice, `seed: seed of the noise` once;
- functions of ten lines or more without a docstring are counted, not refused.

Names that users type or that files store stay as they are: `ALLOWED` in this file.
What was there before a rule may stand in tools/names_allowed.txt, a line each
(`path::function rule`). A line there that no longer holds is an error, too, so that
the list only gets shorter.
"""

from __future__ import annotations

import argparse
import ast
import io
import re
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
EXCEPTIONS = ROOT / "tools" / "names_allowed.txt"
VAGUE_PARTS = frozenset(
    "asked told said shown kept beside wholes own given seen place places one whole "
    "way ways away there here taken made begun came them mine brought called drawn"
    "".split()
)
ALLOWED = frozenset[str]()
"""Names with a vague part that users type, that files store, or that a library asks
for.
"""
MAX_LOCALS = 14
MAX_BODY_LINES = 25
"""Readers understand functions of up to 13 lines at once, and a third of those above 25."""
FRAGMENT = re.compile(r" +`*\**(\w+(?:, \**\w+)*)`*(?: \([^)]*\))?: of ")
WORDS = re.compile(r"(?<=[a-z0-9])(?=[A-Z])|_")
Function = ast.FunctionDef | ast.AsyncFunctionDef


class Finding(NamedTuple):
    """One place that a reader would stumble over."""

    path: str
    line: int
    scope: str
    rule: str
    text: str

    @property
    def key(self) -> str:
        """The line of tools/names_allowed.txt that allows it."""
        return f"{self.path}::{self.scope} {self.rule}"


def is_vague(name: str) -> bool:
    """Return whether a part of a name is one of the words that say nothing."""
    if name in ALLOWED:
        return False
    return any(part.lower() in VAGUE_PARTS for part in WORDS.split(name))


def iterate_own_nodes(function: Function) -> Iterator[ast.AST]:
    """Yield the nodes of a function without those of functions and classes in it."""
    stack: list[ast.AST] = list(ast.iter_child_nodes(function))
    while stack:
        node = stack.pop()
        yield node
        if not isinstance(node, Function | ast.Lambda | ast.ClassDef):
            stack.extend(ast.iter_child_nodes(node))


def count_locals(function: Function) -> int:
    """Count the names that a function assigns."""
    return len(
        {
            node.id
            for node in iterate_own_nodes(function)
            if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)
        }
    )


def find_defined_names(node: ast.AST) -> Iterator[str]:
    """Yield the names that a node defines."""
    if isinstance(node, Function | ast.ClassDef):
        yield node.name
    elif isinstance(node, ast.arg):
        yield node.arg
    elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
        yield node.id
    elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
        yield node.attr


def check_node(node: ast.AST, path: str, scope: str) -> Iterator[Finding]:
    """Yield what is wrong with a node alone, whatever is around it."""
    line = getattr(node, "lineno", 0)
    for name in find_defined_names(node):
        if is_vague(name):
            yield Finding(path, line, scope, f"name:{name}", f"vague name `{name}`")
    if isinstance(node, ast.Assign) and isinstance(node.value, ast.Tuple):
        if isinstance(node.targets[0], ast.Tuple):
            text = f"two assignments on one line: {ast.unparse(node)}"
            yield Finding(path, line, scope, "packed", text)
    if isinstance(node, ast.IfExp):
        inner = (node.body, node.test, node.orelse)
        if any(isinstance(part, ast.IfExp) for part in inner):
            text = "a conditional expression inside another"
            yield Finding(path, line, scope, "nested", text)
    if isinstance(node, Function):
        n_locals = count_locals(node)
        if n_locals > MAX_LOCALS:
            text = f"{n_locals} local variables; split it into steps that have names"
            yield Finding(path, line, scope, "locals", text)


def check_docstring(node: ast.AST, path: str, scope: str) -> Iterator[Finding]:
    """Yield descriptions of arguments that have no noun of their own."""
    if not isinstance(node, Function | ast.ClassDef):
        return
    docstring = ast.get_docstring(node, clean=False) or ""
    for offset, text in enumerate(docstring.splitlines()):
        fragment = FRAGMENT.match(text)
        if fragment:
            line = node.body[0].lineno + offset
            rule = f"fragment:{fragment[1]}"
            yield Finding(path, line, scope, rule, f"what is `{text.strip()}`?")


def check_tree(node: ast.AST, path: str, scope: str = "") -> Iterator[Finding]:
    """Yield all findings in a syntax tree, with the function or class around each."""
    for child in ast.iter_child_nodes(node):
        inner = scope
        if isinstance(child, Function | ast.ClassDef):
            inner = f"{scope}.{child.name}".lstrip(".")
        yield from check_node(child, path, inner)
        yield from check_docstring(child, path, inner)
        yield from check_tree(child, path, inner)


def find_code_lines(source: str) -> set[int]:
    """Return the numbers of lines that have more than blanks and comments."""
    no_code = (tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT)
    lines = set[int]()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in no_code:
            lines.update(range(token.start[0], token.end[0] + 1))
    return lines


def check_lengths(tree: ast.AST, source: str, path: str) -> Iterator[Finding]:
    """Yield the functions that are too long, without signatures and docstrings."""
    code_lines = find_code_lines(source)
    for scope, function in iterate_functions(tree):
        body = function.body
        if ast.get_docstring(function, clean=False) is not None:
            body = body[1:]
        if not body:
            continue
        end = function.end_lineno or function.lineno
        n_lines = len(code_lines.intersection(range(body[0].lineno, end + 1)))
        if n_lines > MAX_BODY_LINES:
            text = f"{n_lines} lines of code; split it into steps that have names"
            yield Finding(path, function.lineno, scope, "length", text)


def iterate_functions(node: ast.AST, scope: str = "") -> Iterator[tuple[str, Function]]:
    """Yield the functions in a syntax tree, with their names as in `check_tree`."""
    for child in ast.iter_child_nodes(node):
        inner = scope
        if isinstance(child, Function | ast.ClassDef):
            inner = f"{scope}.{child.name}".lstrip(".")
        if isinstance(child, Function):
            yield inner, child
        yield from iterate_functions(child, inner)


def find_all(package: Path) -> list[Finding]:
    """Return the findings of all files of a package, in the order of files and
    lines.
    """
    findings: list[Finding] = []
    for path in sorted(package.rglob("*.py")):
        relative = path.relative_to(package.parent).as_posix()
        source = path.read_text("utf-8")
        tree = ast.parse(source, str(path))
        findings += check_tree(tree, relative)
        findings += check_lengths(tree, source, relative)
    return sorted(findings, key=lambda finding: (finding.path, finding.line))


def main() -> int:
    """Print what is new, and what the list of exceptions has too much."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("package", nargs="?", type=Path, default=ROOT / "advsearch")
    parser.add_argument(
        "--list", action="store_true", help="print keys of all findings"
    )
    arguments = parser.parse_args()
    findings = find_all(arguments.package.resolve())
    if arguments.list:
        print("\n".join(sorted({finding.key for finding in findings})))
        return 0

    exceptions = set[str]()
    if EXCEPTIONS.exists():
        exceptions.update(EXCEPTIONS.read_text("utf-8").splitlines())
    new = [finding for finding in findings if finding.key not in exceptions]
    for finding in new:
        print(f"{finding.path}:{finding.line}: {finding.scope}: {finding.text}")
    outdated = exceptions - {finding.key for finding in findings}
    for key in sorted(outdated):
        print(f"{EXCEPTIONS.name}: no longer needed: {key}")
    return 1 if new or outdated else 0


if __name__ == "__main__":
    sys.exit(main())
