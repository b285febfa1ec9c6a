"""Make docs/own-loss.ipynb of docs/own-loss.md: its text as cells of Markdown, its
blocks of Python as cells of code.

    python docs/make_notebook.py

A cell that ends with a result shows it, with its pictures.
"""

from __future__ import annotations

import ast
import json
import re
from pathlib import Path
from typing import Any

DOCS = Path(__file__).resolve().parent
PAGE = DOCS / "own-loss.md"
NOTEBOOK = DOCS / "own-loss.ipynb"


def notebook() -> dict[str, Any]:
    """Return the notebook, without outputs."""
    cells: list[dict[str, Any]] = []
    for number, part in enumerate(
        re.split(r"^```python\n(.*?)^```$", PAGE.read_text("utf-8"), flags=re.M | re.S)
    ):
        text = part.strip()
        code = number % 2 == 1
        last = ast.parse(text).body[-1] if code else None
        if isinstance(last, ast.Assign) and ast.unparse(last.targets[0]) == "result":
            text += "\nresult"
        if text:
            kind: dict[str, Any] = {"cell_type": "markdown"}
            if code:
                kind = {"cell_type": "code", "execution_count": None, "outputs": []}
            source = text.splitlines(keepends=True)
            cells.append(
                {**kind, "id": f"cell-{len(cells)}", "metadata": {}, "source": source}
            )
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    metadata = {"kernelspec": kernel, "language_info": {"name": "python"}}
    return {"cells": cells, "metadata": metadata, "nbformat": 4, "nbformat_minor": 5}


if __name__ == "__main__":
    NOTEBOOK.write_text(json.dumps(notebook(), indent=1) + "\n", encoding="utf-8")
