"""What results show in a notebook, and the notebook of the documentation."""

from __future__ import annotations

import json
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from conftest import ROOT
from matplotlib.figure import Figure
from samples import sweep

from advsearch.report.studies import search_axes, sweep_axes

NOTEBOOK = ROOT / "docs" / "notebook.ipynb"


def code() -> list[str]:
    """The cells with code."""
    cells = json.loads(NOTEBOOK.read_text("utf-8"))["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


def test_the_notebook_of_the_docs_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    from matplotlib import pyplot as plt

    mpl.use("Agg")
    names: dict[str, Any] = {}
    for cell in code():
        exec(compile(cell, NOTEBOOK.name, "exec"), names)
    try:
        assert len(plt.get_fignums()) == 2
        for shown in ("table", "result"):
            assert "<img" in names[shown]._repr_html_()
    finally:
        plt.close("all")


def test_the_notebook_is_kept_without_outputs() -> None:
    for cell in json.loads(NOTEBOOK.read_text("utf-8"))["cells"]:
        assert not cell.get("outputs") and cell.get("execution_count") is None


def test_a_search_is_drawn_with_its_best() -> None:
    axes = Figure().subplots()
    search_axes({"pgd": [None, -2.0, 1.0, 0.5], "random": [-3.0]}, "margin", axes)
    assert axes.get_ylabel() == "margin"
    assert axes.get_legend_handles_labels()[1] == ["pgd", "random"]
    best = np.asarray(axes.get_lines()[1].get_ydata(), dtype=float)
    assert best[1:].tolist() == [-2.0, 1.0, 1.0]


def test_a_sweep_without_axes_draws_nothing() -> None:
    axes = Figure().subplots()
    sweep_axes(sweep(axes=[], cells=None), axes)
    assert not axes.has_data()
