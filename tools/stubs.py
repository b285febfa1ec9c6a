"""Writes `advsearch/__init__.pyi`: the public names, for editors and type checkers, with every setting as a keyword.

    python tools/stubs.py [--check]

`--check` writes nothing, and exits 3 where the file is not what it would be.
"""

from __future__ import annotations

import builtins
import inspect
import re
import sys
from pathlib import Path
from typing import Any

import advsearch
from advsearch.api import keywords

FILE = Path(advsearch.__file__).with_name("__init__.pyi")

PLAIN = {
    "Any": "typing", "Literal": "typing", "Union": "typing", "Callable": "collections.abc",
    "Iterable": "collections.abc", "Mapping": "collections.abc", "Sequence": "collections.abc", "Path": "pathlib",
    "nn": "torch", "Tensor": "torch",
}  # fmt: skip


def home(name: str, known: dict[str, Any]) -> str:
    """Return the module that a name of an annotation is imported from: that of a class, or the one that assigns it."""
    if name in PLAIN:
        return PLAIN[name]
    value = known.get(name, vars(keywords).get(name))
    if inspect.isclass(value) and value.__module__.startswith("advsearch"):
        return value.__module__
    for module, loaded in sorted(sys.modules.items()):
        source = getattr(loaded, "__file__", None)
        if module.startswith("advsearch") and source and hasattr(loaded, name):
            if re.search(rf"^(class )?{name}\b( =|[:(])", Path(source).read_text("utf-8"), re.MULTILINE):
                return module
    raise LookupError(f"{name}: no module of advsearch makes it")


def text() -> str:
    """Return the file."""
    modules = ", ".join(f"{name} as {name}" for name in advsearch._MODULES)  # type: ignore[attr-defined]
    imports, functions = {"import numpy as np", f"from advsearch import {modules}"}, []
    for name in sorted({*advsearch.__all__} - {*advsearch._MODULES}):  # type: ignore[attr-defined]
        made = getattr(advsearch, name)
        if not isinstance(getattr(made, "__signature__", None), keywords._Signature):
            imports.add(f"from {made.__module__} import {name} as {name}")
            continue
        inner, lines, star = inspect.unwrap(made), list[str](), False
        signature = made.__signature__
        hints = [str(signature.return_annotation).replace("loading.", "")]
        for one in signature.parameters.values():
            if one.kind is one.KEYWORD_ONLY and not star:
                lines, star = [*lines, "*"], True
            hints.append(str(one.annotation).replace("loading.", ""))
            lines.append(f"{one.name}: {hints[-1]}{'' if one.default is one.empty else ' = ...'}")
        for hint in hints:
            for word in re.findall(r"(?<![\w.'\"])[A-Za-z_]\w*(?![\w.'\"])", hint):
                if not hasattr(builtins, word) and word not in advsearch.__all__:
                    imports.add(f"from {home(word, inner.__globals__)} import {word}")
        arguments = "".join(f"    {line},\n" for line in lines)
        functions.append(f"def {name}(\n{arguments}) -> {hints[0]}: ...\n")
    head = '"""Made by tools/stubs.py of the settings of each question."""\n\n'
    return head + "\n".join(sorted(imports)) + "\n\n__version__: str\n__all__: list[str]\n\n" + "\n".join(functions)


def main() -> int:
    """Write the file, or compare it."""
    made = text()
    if "--check" in sys.argv:
        return 0 if FILE.read_text("utf-8") == made else 3
    FILE.write_text(made, "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
