"""The colour chart: what is printed of it comes back from a photograph."""

from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

import advsearch
from advsearch import losses
from advsearch.api.chart import CHART_COLORS, draw_chart_page
from advsearch.report.sheets import PAPERS

Levels = np.ndarray


def printed(levels: Levels) -> Levels:
    """What a printer makes of sRGB: no black, no white, and dull colours."""
    grey = levels.mean(axis=-1, keepdims=True)
    return np.asarray(0.2 + 0.7 * (0.25 * grey + 0.75 * levels))


def photographed(path: Path, *, lamp: tuple[float, float, float], slope: float, slant: float) -> Path:
    """The page, printed on paper that is white, under a lamp of some colour that is brighter on one side, seen aslant
    on a grey table."""
    canvas = FigureCanvasAgg(draw_chart_page("t", PAPERS["a4"], None))
    canvas.figure.set_dpi(110.0)
    canvas.draw()  # type: ignore[no-untyped-call]
    page = np.asarray(canvas.buffer_rgba())[..., :3] / 255.0  # type: ignore[no-untyped-call]
    white, black = (page > 0.99).all(axis=2, keepdims=True), (page < 0.01).all(axis=2, keepdims=True)
    page = np.where(white, 1.0, np.where(black, 0.12, printed(page)))
    height, width = page.shape[:2]
    shade = np.linspace(1.0 - slope, 1.0, width)[None, :, None] * np.array(lamp)
    light = np.where(page <= 0.04045, page / 12.92, ((page + 0.055) / 1.055) ** 2.4) * shade
    shown = np.where(light <= 0.0031308, light * 12.92, 1.055 * light ** (1.0 / 2.4) - 0.055)
    sheet = Image.fromarray(np.uint8(np.round(255.0 * shown)))
    # the output's corners (0, 0), (w, 0), (w, h), (0, h) show these places of the sheet
    wide, high, away = width + 200, height + 200, slant * width
    source = [
        (-100.0, -100.0),
        (width + 100.0, -100.0),
        (width + 100.0 + away, height + 100.0),
        (-100.0 - away, height + 100.0),
    ]
    rows = []
    for (x, y), (u, v) in zip([(0, 0), (wide, 0), (wide, high), (0, high)], source, strict=True):
        rows += [[x, y, 1, 0, 0, 0, -u * x, -u * y], [0, 0, 0, x, y, 1, -v * x, -v * y]]
    warp = np.linalg.solve(np.array(rows, dtype=float), np.array(source).ravel())
    sheet.transform((wide, high), Image.Transform.PERSPECTIVE, list(warp), Image.Resampling.BICUBIC,
                    fillcolor=(150, 150, 150)).save(path, quality=92)  # fmt: skip
    return path


@pytest.mark.medium
@pytest.mark.parametrize(
    ("lamp", "slope", "slant"), [((1.0, 1.0, 1.0), 0.0, 0.0), ((0.95, 0.8, 0.55), 0.3, 0.06)], ids=["even", "a lamp"]
)
def test_what_was_printed_comes_back(
    tmp_path: Path, lamp: tuple[float, float, float], slope: float, slant: float
) -> None:
    photograph = photographed(tmp_path / "chart.jpg", lamp=lamp, slope=slope, slant=slant)
    palette = advsearch.measured_palette(photograph)
    off = np.abs(palette.numpy() - printed(CHART_COLORS)).max(axis=1)
    assert palette.shape == (125, 3) and np.median(off) < 0.01 and off.max() < 0.04
    assert torch.allclose(losses.non_printability(palette.reshape(1, 25, 5, 3), palette), torch.zeros(1), atol=1e-6)
    assert float(losses.non_printability(torch.tensor(CHART_COLORS).float().reshape(1, 25, 5, 3), palette)[0]) > 0.05
