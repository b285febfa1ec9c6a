"""The figure of `sweep --surface`: which parts of an object go with wrong answers, on its map and from some sides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil
from typing import Any

import numpy as np
import numpy.typing as npt

from advsearch.report.drawing import Figures, drawn
from advsearch.report.wording import short_name

Doubles = npt.NDArray[np.float64]

MOST_PANELS = 12
"""Objects times models that are drawn; the file of the counts has all."""

LIGHT = (0.36, 0.48, 0.80)
"""The direction that the object is shaded from, world space; of length 1."""

COLOURS = "PuOr_r"
"""ColorBrewer's purple to orange, which people see apart who see no red or no green: orange is wrong more often."""

UNTOLD, UNCOMPARED, NOTHING = (0.78, 0.78, 0.78), (0.45, 0.45, 0.45), (1.0, 1.0, 1.0)
"""Grey where a part is not told from chance, darker where too few pictures show it or do not; white beside charts."""

ROWS = 2
"""Rows of the views of an object."""


@dataclass(frozen=True, eq=False)
class SurfaceView:
    """What a camera sees of an object.

    Attributes:
        title: where the camera stands.
        cells: (H, W) number of the cell in each pixel, row by row of the map; -1 beside the object.
        normal: (H, W, 3) unit normals, world space.
    """

    title: str
    cells: npt.NDArray[np.int64]
    normal: npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class SurfacePanel:
    """What is drawn of one object and one model; maps are (n, n) with row 0 at v = 1.

    Attributes:
        object: its name.
        model: likewise.
        surface: where there is a surface.
        compared: where enough pictures show it, and do not.
        difference: by how much answers are wrong more often where a cell is seen, in [-1, 1]; NaN where that is not
            told from chance.
        views: of the object.
    """

    object: str
    model: str
    surface: npt.NDArray[np.bool_]
    compared: npt.NDArray[np.bool_]
    difference: Doubles
    views: tuple[SurfaceView, ...]


def surface_figure(panels: Sequence[SurfacePanel]) -> Figures:
    """Draw a row for each panel: the map, and the object in its colours from some sides.

    Args:
        panels: the first `MOST_PANELS` are drawn, at one scale.
    """
    panels = panels[:MOST_PANELS]
    largest = max((float(np.nanmax(np.abs(one.difference), initial=0.0)) for one in panels), default=0.0)
    end = max(ceil(10.0 * largest - 1e-9) / 10.0, 0.1)

    def draw(figure: Any) -> None:
        import matplotlib as mpl

        scale = mpl.cm.ScalarMappable(mpl.colors.Normalize(-end, end), mpl.colormaps[COLOURS])
        axes = figure.subplots(len(panels), 2, squeeze=False, width_ratios=(1.0, 1.55))
        for (flat, solid), panel in zip(axes, panels, strict=True):
            colours = _coloured(panel, scale)
            flat.imshow(colours, extent=(0, 1, 0, 1), interpolation="nearest")
            flat.set(xlabel="u", ylabel="v")
            flat.set_title(f"{short_name(panel.object)}, {short_name(panel.model)}")
            solid.axis("off")
            across = ceil(len(panel.views) / ROWS)
            solid.imshow(_mosaic(panel.views, colours, across))
            for number, view in enumerate(panel.views):
                height, width = view.cells.shape
                row, column = divmod(number, across)
                solid.text((column + 0.5) * width, row * height + 4, view.title, ha="center", va="top", fontsize=7)
        bar = figure.colorbar(scale, ax=axes, shrink=0.8 if len(panels) == 1 else 0.4, format=_percent)
        bar.set_label("share of wrong answers where it is seen,\nless that where it is not")
        marks = [
            mpl.patches.Patch(facecolor=colour, label=text)
            for colour, text in ((UNTOLD, "not told from chance"), (UNCOMPARED, "too few pictures with or without it"))
        ]
        figure.legend(handles=marks, loc="outside lower center", ncols=2)

    return drawn(draw, (10.0, 0.5 + 3.6 * len(panels)), kinds=("png",))


def _percent(value: float, _: object) -> str:
    return f"{100.0 * value:+.3g} %" if value else "0 %"


def _coloured(panel: SurfacePanel, scale: Any) -> Doubles:
    """The map in colours, (n, n, 3)."""
    colours = np.where(panel.compared[..., None], UNTOLD, UNCOMPARED)
    told = np.isfinite(panel.difference)
    colours[told] = scale.to_rgba(panel.difference[told])[:, :3]
    return np.where(panel.surface[..., None], colours, NOTHING)


def _mosaic(views: Sequence[SurfaceView], colours: Doubles, across: int) -> Doubles:
    """The object in the colours (n, n, 3) of its cells, shaded a little, side after side; white beside it."""
    tiles = []
    for view in views:
        shade = 0.7 + 0.3 * np.clip(view.normal @ np.array(LIGHT), 0.0, 1.0)
        worn = colours.reshape(-1, 3)[np.maximum(view.cells, 0)] * shade[..., None]
        tiles.append(np.where(view.cells[..., None] >= 0, worn, 1.0))
    tiles += [np.ones_like(tiles[0])] * (-len(tiles) % across)
    rows = [np.concatenate(tiles[begin : begin + across], axis=1) for begin in range(0, len(tiles), across)]
    return np.concatenate(rows)
