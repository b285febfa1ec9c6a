"""What results show in a notebook, and the notebook of the documentation."""

from __future__ import annotations

import importlib.util
import io
import json
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from advsearch.questions.attack.summary import CurveResult
from advsearch.questions.sweep.display import draw_sweep_on
from advsearch.report.figures import draw_searches
from advsearch.report.views import join_images
from conftest import ROOT
from samples import CURVE, sweep

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


@pytest.mark.parametrize("notebook", [NOTEBOOK, LOSSES], ids=lambda path: path.stem)
def test_the_notebook_is_kept_without_outputs(notebook: Path) -> None:
    for cell in json.loads(notebook.read_text("utf-8"))["cells"]:
        assert not cell.get("outputs") and cell.get("execution_count") is None


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


def test_a_search_is_drawn_with_its_best() -> None:
    axes = Figure().subplots()
    draw_searches({"pgd": [None, -2.0, 1.0, 0.5], "random": [-3.0]}, "margin", axes)
    assert axes.get_ylabel() == "margin"
    assert axes.get_legend_handles_labels()[1] == ["pgd", "random"]
    best = np.asarray(axes.get_lines()[1].get_ydata(), dtype=float)
    assert best[1:].tolist() == [-2.0, 1.0, 1.0]


def test_a_sweep_without_axes_draws_nothing() -> None:
    axes = Figure().subplots()
    draw_sweep_on(sweep(axes=[], cells=None), axes)
    assert not axes.has_data()


def test_a_study_is_shown() -> None:
    table, row = CurveResult.of(CURVE), {"epsilon": 0.01, "robust": 3, "accuracy": 0.75}
    assert row.items() <= table.to_pandas().to_dict("records")[0].items()
    page, drawn = table._repr_html_(), Figure().subplots()
    assert "Still recognised: 3 of 4" in page and "<td>mug</td>" in page and "<script" not in page
    table.plot(drawn)
    assert drawn.has_data()


@pytest.mark.medium
def test_a_figure_is_a_picture_and_what_has_none_says_so() -> None:
    points = [{**CURVE["curve"][0], "epsilon": epsilon} for epsilon in (0.01, 0.1)]
    several = CurveResult.of({**CURVE, "curve": points})
    png = several._repr_png_()
    assert png is not None and png.startswith(b"\x89PNG")
    assert "<img" in several._repr_html_()
    assert CurveResult.of({**CURVE, "curve": []})._repr_png_() is None


def test_pictures_stand_side_by_side() -> None:
    with Image.open(io.BytesIO(join_images([np.zeros((8, 8, 3)), np.full((8, 8, 3), 0.5)]))) as shown:
        values = np.asarray(shown)
    assert values.shape == (8, 20, 3)
    assert (values[:, :8] == 0).all() and (values[:, 8:12] == 255).all() and (values[:, 12:] == 128).all()
