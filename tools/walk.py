"""How far one question walks through the code: python tools/walk.py [CHECKOUT]

A walk is what runs between two pictures that are shown to the network, a third of the
way through a run: the rest of one evaluation and the beginning of the next. All calls
of the package's own functions count: the scene and its renderer, the bundled network,
the judgement, the policy that is told and asked, and whatever is logged and kept in
between. What torch, Mitsuba and other libraries call inside themselves does not. For
each walk it prints calls, functions, files, and changes from one file to another.

Then counts from the syntax trees: functions that a setting passes through, ways to
carry out (functions that ask for a judgement, and those of them that call the network
themselves), classes that declare a setting, and private functions that are called in
one place.
"""

from __future__ import annotations

import argparse
import ast
import os
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import redirect_stdout
from itertools import pairwise
from pathlib import Path
from types import FrameType
from typing import Any

SMALL = ["--object", "mug", "--resolution", "64", "--spp", "4", "--json", "--quiet"]
ATTACK = [
    "attack",
    *SMALL,
    "--verify-spp",
    "4",
    "--trials",
    "6",
    "--measure",
    "no",
    "--no-baseline",
]
TEXTURE = [*ATTACK, "--epsilon", "0.001", "--control", "texture", "--steps", "60"]
WALKS = {
    "an evaluation with its gradient, rendered": [*TEXTURE, "--denoise", "none"],
    "the same by the matrix of light transport": TEXTURE,
    "a pose without gradient, from u to the result": [
        *ATTACK,
        "--control",
        "pose",
        "--policy",
        "random",
        "--steps",
        "15",
    ],
    # a picture of its own for each row, and no trials, which would come after the rows
    "a row of a sweep": [
        "sweep",
        *SMALL,
        "--grid",
        "pose.yaw=0:330:30",
        "--batch",
        "1",
        "--trials",
        "0",
    ],
}
"""What is typed for each walk."""

AROUND = (
    "models/reference.py",
    "attacks/policies/",
    "attacks/search.py",
    "attacks/candidates.py",
    "attacks/domain.py",
    "questions/attack/stages.py",
    "engine/journal.py",
    "engine/record.py",
    "runs/",
    "cli/",
    "progress.py",
)
"""The network, the policy, the search loop and the log: what goes around the evaluation
itself.
"""

Step = tuple[str, str]
"""File and function."""


def _name(frame: FrameType) -> str:
    """The name of what a frame runs, with its class's (Python 3.11 and newer)."""
    return str(getattr(frame.f_code, "co_qualname", frame.f_code.co_name))


class Tracer:
    """Keeps which functions of the package are called, in order, and where among these
    the network was shown a picture.

    `advsearch.models.model.Model.__call__` is where that is.

    Args:
        package: the folder of the package.
    """

    def __init__(self, package: Path) -> None:
        self._package = str(package) + os.sep
        self.steps: list[Step] = []
        self.pictures: list[int] = []

    def __call__(self, frame: FrameType, event: str, _: Any) -> None:
        """See `sys.setprofile`."""
        code = frame.f_code
        if (
            event != "call"
            or not code.co_filename.startswith(self._package)
            or code.co_name in ("<genexpr>", "<listcomp>")
        ):
            return
        self.steps.append((code.co_filename.removeprefix(self._package), _name(frame)))
        if self.steps[-1][1] == "Model.__call__":
            self.pictures.append(len(self.steps))

    def walk(self) -> list[Step]:
        """Return what was called from one picture to the next, a third of the way: of
        five, the median one.
        """
        begin = len(self.pictures) // 3
        shown = self.pictures[begin - 3 : begin + 3]
        walks = sorted(
            (self.steps[begin:end] for begin, end in pairwise(shown)), key=len
        )
        return walks[len(walks) // 2]


def traced(command: Sequence[str], package: Path) -> Tracer:
    """Carry out a command under a tracer, with what it prints left out."""
    from advsearch.cli.main import main

    tracer = Tracer(package)
    with (
        tempfile.TemporaryDirectory() as folder,
        open(os.devnull, "w") as nowhere,
        redirect_stdout(nowhere),
    ):
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
    """Return the numbers of calls, of functions, of files, and of changes from one file
    to another.
    """
    files = [file for file, _ in steps]
    return (
        len(steps),
        len(set(steps)),
        len(set(files)),
        sum(a != b for a, b in pairwise(files)),
    )


# ---- from the syntax trees
# ---------------------------------------------------------------------------

Function = ast.FunctionDef | ast.AsyncFunctionDef
Trees = dict[str, ast.Module]


def trees_of(package: Path) -> Trees:
    """Return every module of the package, by its file."""
    return {
        str(path.relative_to(package)): ast.parse(path.read_text("utf-8"))
        for path in sorted(package.rglob("*.py"))
    }


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


def calls_in(node: ast.AST) -> Iterator[str]:
    """Yield the last name of whatever is called in a piece of code: `judge` for
    `self.task.judge(...)`.
    """
    for one in ast.walk(node):
        if isinstance(one, ast.Call):
            called = one.func.value if isinstance(one.func, ast.Subscript) else one.func
            if isinstance(called, (ast.Name, ast.Attribute)):
                yield called.id if isinstance(called, ast.Name) else called.attr


def passing(setting: str, trees: Trees, ran: set[Step]) -> list[Step]:
    """Return the functions that name a setting, of those that ran."""
    short = {(file, name.rpartition(".")[2]) for file, name in ran}
    return [
        (file, one.name)
        for file, tree in trees.items()
        for one in functions(tree)
        if (file, one.name) in short and setting in set(names_in(one))
    ]


def calling(trees: Trees, *names: str) -> list[Step]:
    """Return the functions that call something by one of the names."""
    return [
        (file, one.name)
        for file, tree in trees.items()
        for one in functions(tree)
        if not set(names).isdisjoint(calls_in(one))
    ]


def declared(trees: Trees) -> Counter[str]:
    """Return how many classes have a field of a name, for every setting of a search."""
    from advsearch.questions.attack.settings import AttackConfig

    found: Counter[str] = Counter()
    for tree in trees.values():
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                fields = [
                    one.target.id
                    for one in node.body
                    if isinstance(one, ast.AnnAssign)
                    and isinstance(one.target, ast.Name)
                ]
                found.update(set(fields) & set(AttackConfig.model_fields))
    return found


def called_once(trees: Trees) -> tuple[int, int]:
    """Return how many private functions are named in one place only beside their own
    definition, and their lines.
    """
    count = lines = 0
    for tree in trees.values():
        named = Counter(names_in(tree))
        for one in functions(tree):
            if (
                one.name.startswith("_")
                and not one.name.startswith("__")
                and named[one.name] == 1
            ):
                count = count + 1
                lines = lines + (one.end_lineno or one.lineno) - one.lineno + 1
    return count, lines


def table(package: Path) -> Iterator[str]:
    """Yield the lines of the table."""
    yield f"{'walk':<60}{'calls':>7}{'functions':>11}{'files':>7}{'changes':>9}"
    trees = trees_of(package)
    ran = set[Step]()
    for name, command in WALKS.items():
        tracer = traced(command, package)
        walked = tracer.walk()
        alone = [step for step in walked if not step[0].startswith(AROUND)]
        for said, steps in (
            (name, walked),
            ("  without network, policy, loop and log", alone),
        ):
            calls, several, files, changes = figures(steps)
            yield f"{said:<60}{calls:>7}{several:>11}{files:>7}{changes:>9}"
        ran = ran or set(tracer.steps)
    judging = calling(trees, "judge")
    asking = set(calling(trees, "model", "models", "network"))
    for name, steps in (
        (
            "--epsilon, from the command line to where it acts",
            passing("epsilon", trees, ran),
        ),
        ("ways to carry out: functions that call .judge", judging),
        (
            "of these, functions that call a model or network too",
            [one for one in judging if one in asking],
        ),
    ):
        yield f"{name:<60}{'':>7}{len(set(steps)):>11}{len({file for file, _ in steps}):>7}"
    (setting, most), *_ = declared(trees).most_common(1)
    yield f"most classes that declare one setting: {most} ({setting})"
    count, lines = called_once(trees)
    yield f"private functions that are called in one place: {count} ({lines} lines)"


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table; returns 0."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    here = Path(__file__).resolve().parents[1]
    parser.add_argument(
        "checkout",
        nargs="?",
        type=Path,
        default=here,
        help="folder of advsearch (default: this one)",
    )
    root = parser.parse_args(argv).checkout.resolve()
    if not (root / "advsearch" / "__init__.py").is_file():
        parser.error(
            f"expected the folder of a checkout, got {root}, which has no "
            "advsearch/__init__.py"
        )
    sys.path.insert(0, str(root))
    for line in table(root / "advsearch"):
        print(line, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
