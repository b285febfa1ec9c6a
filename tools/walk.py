"""How far one question walks through the code: python tools/walk.py [CHECKOUT]

A walk is what runs between two pictures that are shown to the network, a third of the way through a run: the rest of
one evaluation and the beginning of the next, with whatever is logged and kept in between. For each it counts calls,
functions, files, and changes from one file to another, of the package's own code. Then counts from the syntax trees:
functions that a setting passes through, classes that declare it, functions that judge an answer, and private functions
that are called in one place.
"""

from __future__ import annotations

import ast
import os
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import redirect_stdout
from itertools import pairwise
from pathlib import Path
from types import FrameType
from typing import Any

ROOT = Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).resolve().parents[1]).resolve()
PACKAGE = str(ROOT / "advsearch") + os.sep
sys.path.insert(0, str(ROOT))

SMALL = [
    "--object",
    "mug",
    "--resolution",
    "64",
    "--spp",
    "4",
    "--verify-spp",
    "4",
    "--trials",
    "6",
    "--json",
    "--quiet",
]
ATTACK = ["attack", *SMALL, "--measure", "no", "--no-baseline", "--epsilon", "0.001"]
WALKS = {
    "an evaluation with its gradient, rendered": [
        *ATTACK,
        "--control",
        "texture",
        "--steps",
        "60",
        "--denoise",
        "none",
    ],
    "the same by the matrix of light transport": [*ATTACK, "--control", "texture", "--steps", "60"],
    "a pose without gradient, from u to the answer": [
        *ATTACK[:-2],
        "--control",
        "pose",
        "--policy",
        "random",
        "--steps",
        "15",
    ],
    "a row of a sweep": ["sweep", *SMALL, "--grid", "pose.yaw=0:330:30"],
}
"""What is typed for each walk."""

Step = tuple[str, str]
"""File and function."""


def _name(frame: FrameType) -> str:
    """The name of what a frame runs, with its class's (Python 3.11 and newer)."""
    return str(getattr(frame.f_code, "co_qualname", frame.f_code.co_name))


class Tracer:
    """Keeps which functions of the package are called, in order, and where among these the network was shown a picture.

    `advsearch.models.model.Model.__call__` is where that is.
    """

    def __init__(self) -> None:
        self.steps: list[Step] = []
        self.pictures: list[int] = []

    def __call__(self, frame: FrameType, event: str, _: Any) -> None:
        """See `sys.setprofile`."""
        code = frame.f_code
        if event != "call" or not code.co_filename.startswith(PACKAGE) or code.co_name in ("<genexpr>", "<listcomp>"):
            return
        self.steps.append((code.co_filename.removeprefix(PACKAGE), _name(frame)))
        if self.steps[-1][1] == "Model.__call__":
            self.pictures.append(len(self.steps))

    def walk(self) -> list[Step]:
        """Return what was called from one picture to the next, a third of the way: of five, the median one."""
        begin = len(self.pictures) // 3
        shown = self.pictures[begin - 3 : begin + 3]
        walks = sorted((self.steps[begin:end] for begin, end in pairwise(shown)), key=len)
        return walks[len(walks) // 2]


def traced(command: list[str]) -> Tracer:
    """Carry out a command under a tracer, with what it prints left out."""
    from advsearch.cli.main import main

    tracer = Tracer()
    with tempfile.TemporaryDirectory() as folder, open(os.devnull, "w") as nowhere, redirect_stdout(nowhere):
        threading.setprofile(tracer)
        sys.setprofile(tracer)
        try:
            status = main([*command, "--run", f"{folder}/run"])
        finally:
            sys.setprofile(None)
            threading.setprofile(None)
    if status:
        raise SystemExit(f"{' '.join(command)} ended with status {status}")
    return tracer


def figures(steps: list[Step]) -> tuple[int, int, int, int]:
    """Return the numbers of calls, of functions, of files, and of changes from one file to another."""
    files = [file for file, _ in steps]
    return len(steps), len(set(steps)), len(set(files)), sum(a != b for a, b in pairwise(files))


# ---- from the syntax trees ------------------------------------------------------------------------------------------

Function = ast.FunctionDef | ast.AsyncFunctionDef


def trees() -> Iterator[tuple[str, ast.Module]]:
    """Yield every module of the package, with its file."""
    for path in sorted(Path(PACKAGE).rglob("*.py")):
        yield str(path.relative_to(PACKAGE)), ast.parse(path.read_text("utf-8"))


def functions(tree: ast.Module) -> Iterator[Function]:
    """Yield the functions and methods of a module."""
    yield from (node for node in ast.walk(tree) if isinstance(node, Function))


def names_in(node: ast.AST) -> Iterator[str]:
    """Yield every name, attribute and keyword in a piece of code."""
    for inner in ast.walk(node):
        if isinstance(inner, ast.Name):
            yield inner.id
        elif isinstance(inner, ast.Attribute):
            yield inner.attr
        elif isinstance(inner, (ast.arg, ast.keyword)) and inner.arg:
            yield inner.arg


def passing(setting: str, ran: set[Step]) -> list[Step]:
    """Return the functions that name a setting, of those that ran."""
    short = {(file, name.rpartition(".")[2]) for file, name in ran}
    return [
        (file, one.name)
        for file, tree in trees()
        for one in functions(tree)
        if (file, one.name) in short and setting in set(names_in(one))
    ]


def calling(name: str) -> list[Step]:
    """Return the functions that call a method of that name."""

    def calls(node: ast.AST) -> bool:
        return any(
            isinstance(one, ast.Call) and isinstance(one.func, ast.Attribute) and one.func.attr == name
            for one in ast.walk(node)
        )

    return [(file, one.name) for file, tree in trees() for one in functions(tree) if calls(one)]


def declared() -> Counter[str]:
    """Return how many classes have a field of a name, for every setting of a search."""
    from advsearch.config.attack import AttackConfig

    found: Counter[str] = Counter()
    for _, tree in trees():
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                fields = [
                    one.target.id
                    for one in node.body
                    if isinstance(one, ast.AnnAssign) and isinstance(one.target, ast.Name)
                ]
                found.update(set(fields) & set(AttackConfig.model_fields))
    return found


def called_once() -> tuple[int, int]:
    """Return how many private functions are named in one place only beside their own definition, and their lines."""
    count = lines = 0
    for _, tree in trees():
        named = Counter(names_in(tree))
        for one in functions(tree):
            if one.name.startswith("_") and not one.name.startswith("__") and named[one.name] == 1:
                count, lines = count + 1, lines + (one.end_lineno or one.lineno) - one.lineno + 1
    return count, lines


def table(walks: Callable[[list[str]], Tracer] = traced) -> Iterator[str]:
    """Yield the lines of the table."""
    yield f"{'walk':<50}{'calls':>7}{'functions':>11}{'files':>7}{'changes':>9}"
    tracers = {name: walks(command) for name, command in WALKS.items()}
    for name, tracer in tracers.items():
        calls, several, files, changes = figures(tracer.walk())
        yield f"{name:<50}{calls:>7}{several:>11}{files:>7}{changes:>9}"
    ran = set(next(iter(tracers.values())).steps)
    for name, steps in (
        ("--epsilon, from the command line to where it acts", passing("epsilon", ran)),
        ("functions that ask for a judgement", calling("judge")),
    ):
        yield f"{name:<50}{'':>7}{len(set(steps)):>11}{len({file for file, _ in steps}):>7}"
    (setting, most), *_ = declared().most_common(1)
    yield f"most classes that declare one setting: {most} ({setting})"
    count, lines = called_once()
    yield f"private functions that are called in one place: {count} ({lines} lines)"


if __name__ == "__main__":
    for line in table():
        print(line, flush=True)
