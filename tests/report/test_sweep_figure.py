"""Figures of sweeps."""

from __future__ import annotations

import io

import imageio.v3 as iio

from advsearch.questions.sweep.display import draw_sweep
from samples import sweep


def test_the_names_of_files_fit_the_map_of_a_sweep() -> None:
    """matplotlib warns where a map has no room beside its names, which is an error here; folders are left out."""
    files = [f"/somewhere/far/away/in/a/folder/abandoned_factory_canteen_0{number}.hdr" for number in range(3)]
    models = ["reference", "reference@/somewhere/far/away/in/a/folder/hardened.safetensors"]
    axes = [{"axis": "model", "unit": "", "values": models}, {"axis": "environment", "unit": "", "values": files}]
    cells = {
        "axes": axes,
        "over": [],
        "configurations": [[4, 4]] * 3,
        "correct": [[4, 2]] * 3,
        "margin": [[-1.0, 0.0]] * 3,
    }
    drawn = draw_sweep(sweep(object="ball", model=",".join(models), cells=cells))
    text = drawn["svg"].decode("utf-8")
    assert "hardened.safetensors" in text and "somewhere" not in text
    assert iio.imread(io.BytesIO(drawn["png"])).shape[1] > 900
