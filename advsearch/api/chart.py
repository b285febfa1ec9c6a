"""A page of printable colours, and what a photograph of it says that printer and paper
make of them.

Between the patches is bare paper: a patch is measured by the light at its four corners,
so that neither the lamp's colour nor its unevenness counts. Four black squares, outside
of all patches, say where the chart is.
"""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from PIL import Image, ImageCms
from scipy import ndimage
from torch import Tensor

from advsearch.calls import helped
from advsearch.errors import InputError
from advsearch.pictures import upright
from advsearch.report.sheets import MARGIN, blank
from advsearch.scene.color import linear_to_srgb, srgb_to_linear

Floats = npt.NDArray[np.float64]
COLOURS = np.array(list(itertools.product((0.1, 0.3, 0.5, 0.7, 0.9), repeat=3)))
"""(125, 3) sRGB: the printable colours of `--printable`."""
COLUMNS = 9
PITCH = 15.0
PATCH = 12.0
CORNER = 9.0
"""Patches in a row; from one to the next, and the side of one and of a black square,
millimetres.
"""
ROWS = -(-len(COLOURS) // COLUMNS)
# width and height of all patches with the paper around them, millimetres
SIZE = (COLUMNS * PITCH, ROWS * PITCH)
CORNERS = np.array(
    [(x, y) for y in (-CORNER, SIZE[1] + CORNER) for x in (-CORNER, SIZE[0] + CORNER)]
)
"""(4, 2) middles of the black squares, from the upper left corner of the patches, in
the order of reading.
"""
LARGEST_SIDE = 8192
# (125, 2) of the patches
MIDDLES = (
    np.stack(np.divmod(np.arange(len(COLOURS)), COLUMNS)[::-1], axis=1) + 0.5
) * PITCH
# of the brightness of paper, under which a pixel may belong to a black square
DARK = 0.35


def chart_page(title: str, paper: tuple[float, float], convert: Any) -> Figure:
    """Return the chart in the middle of a page, for `write_sheets`."""
    figure, axes = blank(paper)
    left = (paper[0] - SIZE[0]) / 2.0
    top = MARGIN + 2.0 * CORNER

    def square(x: float, y: float, side: float, colour: object) -> None:
        at = (left + x - side / 2, top + y - side / 2)
        axes.add_patch(
            Rectangle(
                at, side, side, facecolor=colour, linewidth=0.0, antialiased=False
            )
        )

    sent = Image.fromarray(np.round(255.0 * COLOURS[None]).astype(np.uint8))
    levels = (
        np.asarray(sent if convert is None else ImageCms.applyTransform(sent, convert))[
            0
        ]
        / 255.0
    )
    for (x, y), colour in zip(MIDDLES, levels, strict=True):
        square(x, y, PATCH, tuple(colour))
    for x, y in CORNERS:
        square(x, y, CORNER, "black")
    axes.text(
        paper[0] - MARGIN,
        paper[1] - MARGIN,
        f"{title}: colour chart",
        fontsize=7,
        ha="right",
        va="bottom",
    )
    return figure


@helped
def measured_palette(photograph: str | Path) -> Tensor:
    """Return the colours that a printer makes of the 125 of `printable`, (125, 3) sRGB
    in [0, 1] where bare paper is white, for `losses.non_printability`
    (docs/runs.md#printing).

    Args:
        photograph: a file: the whole chart that `advsearch export RUN --format print`
            ends with, upright, in even light and without gloss, as the camera's usual
            sRGB.

    Raises:
        FileFormatError: the file is no picture, or too large.
        InputError: it shows no such chart.
    """
    light = srgb_to_linear(upright(Path(photograph), LARGEST_SIDE)).astype(np.float64)
    place = _homography(CORNERS, _found(light, photograph))
    offsets = np.array(
        list(itertools.product(np.linspace(-0.25, 0.25, 7) * PATCH, repeat=2))
    )
    crossings = np.array(list(itertools.product((-PITCH / 2.0, PITCH / 2.0), repeat=2)))
    close = np.array(
        list(itertools.product(np.linspace(-0.3, 0.3, 3) * (PITCH - PATCH), repeat=2))
    )
    measured = []
    for middle in MIDDLES:
        ink = np.median(_at(light, place, middle + offsets), axis=0)
        paper = [
            np.median(_at(light, place, middle + one + close), axis=0)
            for one in crossings
        ]
        measured.append(ink / np.maximum(np.mean(paper, axis=0), 1e-4))
    return torch.from_numpy(linear_to_srgb(np.array(measured, np.float32)))


def _found(light: Floats, photograph: str | Path) -> Floats:
    """The middles (4, 2) of the black squares, x and y in pixels, in the order of
    reading: of all dark, filled squares those that lie outermost.
    """
    brightness = light.mean(axis=2)
    labels, count = ndimage.label(
        brightness < DARK**2.2 * np.percentile(brightness, 95)
    )
    squares = []
    for number, (rows, columns) in (
        enumerate(ndimage.find_objects(labels), 1) if count else ()
    ):
        high = rows.stop - rows.start
        wide = columns.stop - columns.start
        inside = labels[rows, columns] == number
        if min(high, wide) >= 5 and 0.5 < wide / high < 2.0 and inside.mean() > 0.7:
            y, x = np.argwhere(inside).mean(axis=0)
            squares.append((x + columns.start, y + rows.start, inside.sum()))
    refused = InputError(
        f"{photograph}: expected a photograph of the whole colour chart, upright, with "
        "its four black squares, got one "
        "in which they are not found; leave nothing dark around the sheet"
    )
    if len(squares) < 4:
        raise refused
    x, y, area = np.array(squares).T
    outermost = [
        int(np.argmin(a * x + b * y)) for b, a in itertools.product((1, -1), repeat=2)
    ]
    if len({*outermost}) < 4 or area[outermost].max() > 3.0 * area[outermost].min():
        raise refused
    return np.stack([x, y], axis=1)[outermost]


def _homography(points: Floats, pixels: Floats) -> Floats:
    """The (3, 3) projection that takes four points (4, 2) to pixels (4, 2)."""
    rows = []
    for (x, y), (u, v) in zip(points, pixels, strict=True):
        rows += [[x, y, 1, 0, 0, 0, -u * x, -u * y], [0, 0, 0, x, y, 1, -v * x, -v * y]]
    return np.append(np.linalg.solve(np.array(rows), pixels.ravel()), 1.0).reshape(3, 3)


def _at(light: Floats, place: Floats, points: Floats) -> Floats:
    """The light (N, 3) at points (N, 2) of the chart."""
    x, y, w = place @ np.concatenate([points, np.ones((len(points), 1))], axis=1).T
    at = [y / w, x / w]
    return np.stack(
        [
            ndimage.map_coordinates(light[..., k], at, order=1, mode="nearest")
            for k in range(3)
        ],
        axis=1,
    )
