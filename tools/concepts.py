"""Counts what a stranger has to learn: python tools/concepts.py [CHECKOUT] [--names]
[--inner]

Lines of the package and its modules; lines with an untyped result (`dict[str, Any]`,
`Mapping[str, Any]`); class names and file names that occur several times; imports that
go in a circle, those inside functions included; modules that take a run's settings (a
parameter or a field annotated with a `...Config`); and the classes of ours that a new
control has to import or subclass, from the worked example of docs/controls/writing.md.

`--names` prints the public names with several meanings: classes, functions and type
aliases that several modules define, and names of modules that are a class's, a
function's or an alias's elsewhere. One meaning are aliases of the same type, a
command's module in each room, a module and its function of the same name, and what
every module of a room has to define (`ENTRIES`). Methods, private names, imported names
and `main` do not count.

`--inner` prints the imports inside functions for which no comment, on their line or the
line above, gives a reason.
"""

from __future__ import annotations

import argparse
import ast
import re
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from scipy.sparse.csgraph import connected_components

UNTYPED = re.compile(r"(?:dict|Mapping)\[str, Any\]")
Modules = Mapping[str, Path]

ENTRIES = {"cli": {"add_arguments", "text", "run"}, "models": {"load", "source"}}
"""Functions that every module of a room defines so that it is found: commands, and
libraries of networks.
"""

OF_COMMANDS = tuple(f"advsearch.{room}." for room in ("api", "cli"))
"""Where a command has a module, or a folder, of its name."""


def modules_of(root: Path) -> Modules:
    """Return every module of the package by its dotted name."""
    found = {}
    for path in sorted((root / "advsearch").rglob("*.py")):
        parts = path.relative_to(root).with_suffix("").parts
        found[".".join(parts).removesuffix(".__init__")] = path
    return found


def imports_of(name: str, path: Path, modules: Modules) -> Iterator[str]:
    """Yield the modules of the package that one imports, late and for types too."""
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in modules)
        elif isinstance(node, ast.ImportFrom) and node.module in modules:
            inner = [f"{node.module}.{alias.name}" for alias in node.names]
            yield from (one if one in modules else str(node.module) for one in inner)


def inner_imports(text: str) -> dict[int, str]:
    """Return the imports inside the functions of a module, by line: each with its
    reason, or an empty text.

    A reason is a comment beside an import, or above it, or that of the import before
    it.
    """
    lines = text.splitlines()
    functions = (ast.FunctionDef, ast.AsyncFunctionDef)
    inside = [
        node
        for one in ast.walk(ast.parse(text))
        if isinstance(one, functions)
        for node in ast.walk(one)
    ]
    imports = {
        node.lineno: node
        for node in inside
        if isinstance(node, (ast.Import, ast.ImportFrom))
    }
    found = dict[int, str]()
    ended = 0
    reason = ""
    for line, node in sorted(imports.items()):
        above = lines[line - 2].strip()
        before = reason if ended == line - 1 else above if above.startswith("#") else ""
        found[line] = reason = lines[line - 1].partition("#")[2] or before
        ended = node.end_lineno or line
    return found


def circles(modules: Modules) -> list[list[str]]:
    """Return the groups of modules that import each other in a circle."""
    places = {name: place for place, name in enumerate(modules)}
    imports = np.zeros((len(modules), len(modules)), dtype=bool)
    for name, path in modules.items():
        imports[
            places[name], [places[other] for other in imports_of(name, path, modules)]
        ] = True
    _, groups = connected_components(imports, connection="strong")
    members = defaultdict[int, list[str]](list)
    for name, group in zip(modules, groups.tolist(), strict=True):
        members[group].append(name)
    return [sorted(names) for names in members.values() if len(names) > 1]


def takes_settings(tree: ast.Module) -> bool:
    """Whether a function of a module has a parameter, or a class a field, that is a
    command's configuration.
    """
    functions = (
        node
        for node in ast.walk(tree)
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))
    )
    notes = (
        arg.annotation
        for one in functions
        for arg in (*one.args.posonlyargs, *one.args.args, *one.args.kwonlyargs)
        if arg.annotation is not None
    )
    fields = (
        node.annotation
        for owner in ast.walk(tree)
        if isinstance(owner, ast.ClassDef)
        for node in owner.body
        if isinstance(node, ast.AnnAssign)
    )
    return any(
        re.search(r"\b[A-Z]\w*Config\b", ast.unparse(note))
        for note in (*notes, *fields)
    )


def classes_for_a_control(root: Path) -> list[str]:
    """Return the classes of ours that the worked example of a control names."""
    page = (root / "docs" / "controls" / "writing.md").read_text("utf-8")
    tree = ast.parse(re.findall(r"```python\n(.*?)```", page, re.S)[0])
    names = [
        alias.name
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom)
        and (node.module or "").startswith("advsearch")
        for alias in node.names
    ]
    return [name for name in names if name[0].isupper()]


def repeated(names: Iterator[str]) -> list[str]:
    """Return the names that occur several times, with how often."""
    return [
        f"{name} {count}" for name, count in Counter(names).most_common() if count > 1
    ]


def defined_in(tree: ast.Module) -> Iterator[tuple[str, str]]:
    """Yield the public classes, functions and type aliases of a module: name, and what
    it is (of an alias, of what).
    """
    for node in tree.body:
        if isinstance(node, ast.ClassDef):
            yield node.name, "class"
        elif isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            yield node.name, "function"
        elif isinstance(node, (ast.Assign, ast.AnnAssign)) and node.value is not None:
            target = node.targets[0] if isinstance(node, ast.Assign) else node.target
            if isinstance(target, ast.Name) and re.fullmatch(
                r"[A-Z]\w*[a-z]\w*", target.id
            ):
                yield target.id, ast.unparse(node.value)


def several_meanings(trees: Mapping[str, ast.Module]) -> dict[str, list[str]]:
    """Return the public names with several meanings, each with the modules of each
    meaning.
    """
    found: dict[str, dict[str, list[str]]] = defaultdict(lambda: defaultdict(list))
    commands = {
        name
        for module, tree in trees.items()
        for name, _ in defined_in(tree)
        if module in (f"advsearch.api.{name}", f"advsearch.questions.{name}.carry_out")
    }
    for module, tree in trees.items():
        room = module.split(".")[1] if "." in module else ""
        for name, what in dict(defined_in(tree)).items():
            if name in ENTRIES.get(room, ()):
                what = f"entry of {room}"
            elif what in ("class", "function"):
                what = (
                    "command"
                    if name in commands and room == "api"
                    else f"{what} of {module}"
                )
            if not name.startswith("_") and name != "main":
                found[name][what].append(module)
    for module in trees:
        name = module.rpartition(".")[2]
        if name in commands and module.startswith(OF_COMMANDS):
            found[name]["command"].append(module)
        elif not any(
            module in modules for modules in found[name].values()
        ):  # else it is the module's one thing
            found[name]["module"].append(module)
    return {
        name: [" ".join(modules) for modules in meanings.values()]
        for name, meanings in sorted(found.items())
        if len(meanings) > 1
    }


def main() -> int:
    """Print the counts."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "checkout",
        nargs="?",
        type=Path,
        default=Path(),
        help="folder of advsearch (default: this one)",
    )
    parser.add_argument(
        "--names", action="store_true", help="list the names with several meanings"
    )
    parser.add_argument(
        "--inner",
        action="store_true",
        help="list the imports inside functions without a reason",
    )
    args = parser.parse_args()
    root = args.checkout.resolve()
    modules = modules_of(root)
    if not modules:
        parser.error(
            f"expected the folder of a checkout, got {root}, which has no advsearch"
        )
    texts = {name: path.read_text("utf-8") for name, path in modules.items()}
    trees = {name: ast.parse(text) for name, text in texts.items()}
    lines = sorted(text.count("\n") for text in texts.values())
    untyped = sum(
        bool(UNTYPED.search(line))
        for text in texts.values()
        for line in text.splitlines()
    )
    classes = repeated(
        node.name
        for tree in trees.values()
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef)
    )
    files = repeated(
        path.name for path in modules.values() if path.name != "__init__.py"
    )
    settings = [name for name, tree in trees.items() if takes_settings(tree)]
    control = classes_for_a_control(root)
    names = several_meanings(trees)
    if args.names:
        for name, where in names.items():
            print(f"{name:<24}{'; '.join(where).replace('advsearch.', '')}")
        return 0
    inner = {name: inner_imports(text) for name, text in texts.items()}
    bare = [
        (name, line)
        for name, found in inner.items()
        for line, reason in found.items()
        if not reason
    ]
    if args.inner:
        for name, line in bare:
            print(f"{modules[name].relative_to(root)}:{line}")
        return 0
    print(
        f"lines of the package          {sum(lines):6d}   in {len(lines)} modules, "
        f"median {lines[len(lines) // 2]}"
    )
    print(f"lines with an untyped result  {untyped:6d}")
    print(f"class names that come again   {len(classes):6d}   {', '.join(classes)}")
    print(f"file names that come again    {len(files):6d}   {', '.join(files)}")
    print(f"names with several meanings   {len(names):6d}   (--names lists them)")
    print(f"modules that take settings    {len(settings):6d}")
    print(f"classes to add a control      {len(control):6d}   {', '.join(control)}")
    print(
        f"imports inside functions      {sum(map(len, inner.values())):6d}   "
        f"{len(bare)} without a reason (--inner)"
    )
    found = circles(modules)
    print(
        f"circles of imports            {len(found):6d}   "
        f"{'; '.join(' '.join(group) for group in found)}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
