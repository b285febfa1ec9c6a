"""What results show in a notebook, and the notebook of the documentation."""

import importlib.util
import json
from typing import Any

import matplotlib as mpl
import pytest

from conftest import ROOT

NOTEBOOK, LOSSES = ROOT / "docs" / "notebook.ipynb", ROOT / "docs" / "own-loss.ipynb"


def code() -> list[str]:
    """The cells with code."""
    cells = json.loads(NOTEBOOK.read_text("utf-8"))["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


@pytest.mark.medium
@pytest.mark.docs
def test_the_notebook_of_the_docs_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    from matplotlib import pyplot as plt

    mpl.use("Agg")
    plt.close("all")
    names: dict[str, Any] = {}
    for cell in code():
        exec(compile(cell, NOTEBOOK.name, "exec"), names)
    try:
        assert len(plt.get_fignums()) == 2
        for shown in ("table", "result"):
            assert "<img" in names[shown]._repr_html_()
            assert names[shown]._repr_png_().startswith(b"\x89PNG")
    finally:
        plt.close("all")


def test_the_notebook_about_losses_is_its_page() -> None:
    """Whose blocks run in tests/test_docs.py; run `python docs/make_notebook.py` after a change."""
    spec = importlib.util.spec_from_file_location("make_notebook", LOSSES.with_name("make_notebook.py"))
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    made = module.notebook()
    assert json.loads(LOSSES.read_text("utf-8")) == made
    code = ["".join(cell["source"]) for cell in made["cells"] if cell["cell_type"] == "code"]
    assert len(code) > 6 and sum(cell.endswith("\nresult") for cell in code) == 6
