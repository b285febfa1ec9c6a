"""Print a color chart, and measure a photograph of it to find how printer and paper
change the colors.

Between the patches is bare paper. Each patch is measured relative to the paper at its
four corners, so that the color and the unevenness of the light cancel out. Four black
squares outside of all patches show where the chart is in the photograph.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from PIL import Image, ImageCms
from scipy import ndimage
from torch import Tensor

from advsearch.calls import with_checked_arguments
from advsearch.errors import InputError
from advsearch.pictures import load_upright
from advsearch.report.sheets import MARGIN, make_blank_page
from advsearch.scene.color import linear_to_srgb, srgb_to_linear

Floats = npt.NDArray[np.float64]
CHART_COLORS = np.array(list(itertools.product((0.1, 0.3, 0.5, 0.7, 0.9), repeat=3)))
"""(125, 3), sRGB: the printable colors of `--printable`."""
COLUMNS = 9  # number of patches in a row
# In millimetres: the distance between the centers of neighboring patches, and the
# widths of a patch and of a black square.
PITCH = 15.0
PATCH_SIZE = 12.0
CORNER_SIZE = 9.0
ROWS = -(-len(CHART_COLORS) // COLUMNS)
# Width and height of all patches with the paper around them, in millimetres.
CHART_SIZE = (COLUMNS * PITCH, ROWS * PITCH)
CORNER_CENTERS = np.array(
    [
        (x, y)
        for y in (-CORNER_SIZE, CHART_SIZE[1] + CORNER_SIZE)
        for x in (-CORNER_SIZE, CHART_SIZE[0] + CORNER_SIZE)
    ]
)
"""(4, 2) x and y of the centers of the black squares, in millimetres from the upper
left corner of the patches: upper left, upper right, lower left, lower right.
"""
MAX_IMAGE_SIZE = 8192  # maximum width and height of a photograph, in pixels
# (125, 2) x and y of the centers of the patches, in millimetres as above.
PATCH_CENTERS = (
    np.stack(np.divmod(np.arange(len(CHART_COLORS)), COLUMNS)[::-1], axis=1) + 0.5
) * PITCH
# Maximum brightness of a black square, relative to paper.
MAX_DARK_BRIGHTNESS = 0.35


def draw_chart_page(title: str, paper: tuple[float, float], convert: Any) -> Figure:
    """Draw the color chart on a page, centered horizontally.

    The chart has 125 patches of color, and a black square outside of each corner, by
    which a photograph of it is aligned.

    Args:
        title: title of the run.
        paper: (width, height) of the page in millimetres.
        convert: color transform of PIL to the printer's profile; None to leave the
            colors as they are.
    """
    figure, axes = make_blank_page(paper)
    # upper left corner of the patches, on the page
    left = (paper[0] - CHART_SIZE[0]) / 2.0
    top = MARGIN + 2.0 * CORNER_SIZE
    colors = _convert_chart_colors(convert)
    for (x, y), color in zip(PATCH_CENTERS, colors, strict=True):
        _draw_square(axes, (left + x, top + y), PATCH_SIZE, tuple(color))
    for x, y in CORNER_CENTERS:
        _draw_square(axes, (left + x, top + y), CORNER_SIZE, "black")
    right, bottom = (side - MARGIN for side in paper)
    heading = f"{title}: colour chart"
    axes.text(right, bottom, heading, fontsize=7, ha="right", va="bottom")
    return figure


def _convert_chart_colors(convert: Any) -> Floats:
    """Return the colors of the chart, (125, 3) in [0, 1], as the printer gets them.

    Args:
        convert: color transform of PIL to the printer's profile; None to leave the
            colors as they are.
    """
    # an image with one row of pixels, since PIL converts images only
    colors = Image.fromarray(np.round(255.0 * CHART_COLORS[None]).astype(np.uint8))
    printed = colors if convert is None else ImageCms.applyTransform(colors, convert)
    levels: Floats = np.asarray(printed)[0] / 255.0
    return levels


def _draw_square(
    axes: Axes, center: tuple[float, float], size: float, color: Any
) -> None:
    """Draw a square around a center (x, y), in millimetres on the page."""
    x, y = center
    corner = (x - size / 2, y - size / 2)
    axes.add_patch(
        Rectangle(corner, size, size, facecolor=color, linewidth=0.0, antialiased=False)
    )


@with_checked_arguments
def measured_palette(photograph: str | Path) -> Tensor:
    """Measure how a printer reproduces the 125 colors of `printable`.

    Args:
        photograph: file of a photograph of the printed chart, the last page of
            `advsearch export RUN --format print`. It has to be complete, upright, in
            even light and without gloss, in the camera's usual sRGB.

    Returns:
        (125, 3), sRGB in [0, 1] where bare paper is white, for
        `losses.non_printability` (docs/runs.md#printing).

    Raises:
        FileFormatError: the file is no image, or too large.
        InputError: it shows no such chart.
    """
    light = srgb_to_linear(load_upright(Path(photograph), MAX_IMAGE_SIZE)).astype(
        np.float64
    )
    corner_pixels = _find_corners(light, photograph)
    homography = _compute_homography(CORNER_CENTERS, corner_pixels)
    aligned = _AlignedPhotograph(light, homography)
    colors = [aligned.measure_patch(center) for center in PATCH_CENTERS]
    return torch.from_numpy(linear_to_srgb(np.array(colors, np.float32)))


@dataclass(frozen=True, eq=False)
class _AlignedPhotograph:
    """A photograph of the chart, in which points of the chart can be found.

    Attributes:
        light: (H, W, 3), linear.
        homography: (3, 3), from the chart in millimetres to pixels.
    """

    light: Floats
    homography: Floats

    def measure_patch(self, center: Floats) -> Floats:
        """Return the light (3,) of a patch, relative to the paper around it.

        Uneven light cancels out by that.

        Args:
            center: (2,), its center in millimetres.
        """
        # 7 x 7 points around the center of a patch, away from its edges
        patch_offsets = _make_grid(np.linspace(-0.25, 0.25, 7) * PATCH_SIZE)
        # The bare paper nearest to a patch is where the gaps between patches cross: at
        # its four corners. The light is measured at 3 x 3 points of each crossing.
        gap_crossings = _make_grid((-PITCH / 2.0, PITCH / 2.0))
        paper_offsets = _make_grid(np.linspace(-0.3, 0.3, 3) * (PITCH - PATCH_SIZE))
        patch_light = self._measure_light(center + patch_offsets)
        paper_light = [
            self._measure_light(center + crossing + paper_offsets)
            for crossing in gap_crossings
        ]
        # 1e-4 prevents a division by zero
        relative_light: Floats = patch_light / np.maximum(
            np.mean(paper_light, axis=0), 1e-4
        )
        return relative_light

    def _measure_light(self, points: Floats) -> Floats:
        """Return the median light (3,) at points (N, 2) in millimetres."""
        samples = _sample(self.light, self.homography, points)
        median: Floats = np.median(samples, axis=0)
        return median


def _make_grid(coordinates: Iterable[float]) -> Floats:
    """Return the points (n * n, 2) of a square grid with n coordinates along each
    axis.
    """
    return np.array(list(itertools.product(coordinates, repeat=2)))


def _find_corners(light: Floats, photograph: str | Path) -> Floats:
    """Find the centers of the four black squares at the corners of the chart.

    They are the outermost of all dark, filled squares, since other dark patches are
    inside of the chart.

    Args:
        light: light of the photograph, (H, W, 3), linear.
        photograph: file of the photograph, for messages.

    Returns:
        (4, 2) x and y in pixels, in reading order.

    Raises:
        InputError: the squares are not found.
    """
    squares = _find_dark_squares(light)
    if len(squares) < 4:
        raise _make_not_found_error(photograph)
    x, y, area = np.array(squares).T
    outermost = _find_outermost(x, y)
    are_four = len({*outermost}) == 4
    # The squares have the same size on paper. In perspective their areas may differ,
    # but by no more than a factor of 3.
    areas = area[outermost]
    are_similar = areas.max() <= 3.0 * areas.min()
    if not are_four or not are_similar:
        raise _make_not_found_error(photograph)
    return np.stack([x, y], axis=1)[outermost]


def _find_outermost(x: Floats, y: Floats) -> list[int]:
    """Return the indices of the points nearest to the corners of the image.

    Args:
        x: (N,), in pixels.
        y: (N,), in pixels.

    Returns:
        Four indices in reading order: the upper left point has the smallest x + y, the
        upper right one the smallest y - x.
    """
    return [
        int(np.argmin(x_sign * x + y_sign * y))
        for y_sign, x_sign in itertools.product((1, -1), repeat=2)
    ]


def _make_not_found_error(photograph: str | Path) -> InputError:
    """Return the error for a photograph in which the black squares are not found."""
    return InputError(
        f"{photograph}: expected a photograph of the whole colour chart, upright, with "
        "its four black squares, got one in which they are not found; leave nothing "
        "dark around the sheet"
    )


def _find_dark_squares(light: Floats) -> list[tuple[float, float, int]]:
    """Return center x, center y and area, in pixels, of all dark, filled squares.

    Args:
        light: (H, W, 3), linear.
    """
    brightness = light.mean(axis=2)
    # paper is nearly the brightest in the photograph
    paper_brightness = np.percentile(brightness, 95)
    # The limit is display-referred. The power of 2.2 converts it to linear light.
    is_dark = brightness < MAX_DARK_BRIGHTNESS**2.2 * paper_brightness
    # connected dark regions: the number of the region of each pixel, 0 for none
    labels, count = ndimage.label(is_dark)
    squares = []
    boxes = ndimage.find_objects(labels) if count else []
    for label, (rows, columns) in enumerate(boxes, 1):
        inside = labels[rows, columns] == label
        if _is_filled_square(inside):
            y, x = np.argwhere(inside).mean(axis=0)
            squares.append((x + columns.start, y + rows.start, inside.sum()))
    return squares


def _is_filled_square(inside: npt.NDArray[np.bool_]) -> bool:
    """Return whether a region (H, W) bool fills its box, which is about a square.

    In perspective a square is distorted, so that it fills only a part of its box.
    """
    height, width = inside.shape
    is_large_enough = min(height, width) >= 5  # in pixels
    is_square = 0.5 < width / height < 2.0
    is_filled = bool(inside.mean() > 0.7)
    return is_large_enough and is_square and is_filled


def _compute_homography(points: Floats, pixels: Floats) -> Floats:
    """Compute the (3, 3) homography that maps four points (4, 2) to pixels (4, 2).

    The last of its nine entries is 1. The others solve two linear equations for each
    point, one for u and one for v.
    """
    rows = []
    for (x, y), (u, v) in zip(points, pixels, strict=True):
        rows += [[x, y, 1, 0, 0, 0, -u * x, -u * y], [0, 0, 0, x, y, 1, -v * x, -v * y]]
    entries = np.linalg.solve(np.array(rows), pixels.ravel())
    return np.append(entries, 1.0).reshape(3, 3)


def _sample(light: Floats, homography: Floats, points: Floats) -> Floats:
    """Return the light (N, 3) of a photograph at points of the chart.

    Args:
        light: (H, W, 3), linear.
        homography: (3, 3), from the chart to pixels.
        points: (N, 2), x and y in millimetres.
    """
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    x, y, w = homography @ homogeneous.T
    coordinates = [y / w, x / w]  # row and column
    channels = [
        ndimage.map_coordinates(
            light[..., channel], coordinates, order=1, mode="nearest"
        )
        for channel in range(3)
    ]
    return np.stack(channels, axis=1)
