"""Lists the files of an attack whose functions name its epsilon, up to the search, or
its settings, up to the end.

    python tools/main_line.py

Only functions that run count, where they read, take or pass something called `epsilon`,
or `config`. The attack is that of the command line, on the bundled mug. The fewer the
files, the easier it is to follow the main line.
"""

from __future__ import annotations

import sys
import tempfile
from collections import defaultdict
from inspect import CO_OPTIMIZED
from pathlib import Path
from types import CodeType, FrameType

import advsearch
from advsearch.cli.main import main as run_command

PACKAGE = Path(advsearch.__file__).parent
COMMAND = (
    "attack --object mug --control texture --epsilon 0.1 --steps 4 --trials 6 "
    "--resolution 32 --spp 2 --quiet"
)


def names_in(code: CodeType) -> set[str]:
    """Return the names and texts in a function, and in the functions inside it."""
    names = {*code.co_names, *code.co_varnames, *code.co_freevars}
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            names |= names_in(constant)
        elif isinstance(constant, str):
            names.add(constant)
        elif isinstance(constant, tuple):
            names.update(entry for entry in constant if isinstance(entry, str))
    return names


def trace_attack(folder: Path) -> dict[str, dict[str, set[str]]]:
    """Run an attack; return for `epsilon` and for `config` the files and the functions
    in them.
    """
    found: dict[str, dict[str, set[str]]] = {
        "epsilon": defaultdict(set),
        "config": defaultdict(set),
    }
    names_of_code: dict[CodeType, set[str]] = {}
    is_searching = False

    def profile(frame: FrameType, event: str, _: object) -> None:
        nonlocal is_searching
        code = frame.f_code
        if (
            event != "call"
            or code in names_of_code
            or not code.co_filename.startswith(str(PACKAGE))
        ):
            return
        names_of_code[code] = names_in(code)
        file = Path(code.co_filename).relative_to(PACKAGE).as_posix()
        is_searching |= file == "attacks/search.py" and code.co_name == "search"
        if not code.co_flags & CO_OPTIMIZED:  # the body of a module or class
            return
        for name in ("config",) if is_searching else ("config", "epsilon"):
            if name in names_of_code[code]:
                found[name][file].add(code.co_name)

    sys.setprofile(profile)
    try:
        run_command([*COMMAND.split(), "--run", str(folder / "run")])
    finally:
        sys.setprofile(None)
    return found


def main() -> int:
    """Print both lists."""
    with tempfile.TemporaryDirectory() as folder:
        found = trace_attack(Path(folder))
    for name, files in found.items():
        print(f"{name}: {len(files)} files")
        for file, functions in sorted(files.items()):
            print(f"    {file}: {', '.join(sorted(functions))}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
