"""Figures: how they are drawn, those of studies, and of a surface. matplotlib with one
style, into the bytes of files.

Of studies: robust accuracy against epsilon, worst case and average, maps of the margin
and of a sweep. Of `sweep --surface`: which parts of an object go with wrong
predictions, on its map and from some sides.
"""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from advsearch.runs.files import to_8bit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Figures = dict[str, bytes]  # A suffix, png or svg, to the content of a file
BLUE = "#1d5fd0"
RED = "#b3261e"
GREY = "#5c606a"
STYLE: dict[Any, Any] = {
    "font.family": ["DejaVu Sans"], "font.size": 9.0, "legend.frameon": False, "legend.fontsize": 8.0,
    "axes.axisbelow": True, "axes.spines.top": False, "axes.spines.right": False, "axes.edgecolor": GREY,
    "axes.labelcolor": "#1c1d20", "axes.titlelocation": "left", "axes.titlesize": 10.0, "axes.titleweight": "bold",
    "grid.color": "#dfe0e3", "grid.linewidth": 0.7, "svg.hashsalt": "advsearch", "svg.fonttype": "none",
    # names come from users: a dollar sign in one is no formula
    "text.parse_math": False,
}  # fmt: skip


def new_axes() -> Any:
    """Return matplotlib axes of a new figure of the calling program, which shows it as
    it shows others.
    """
    # late: matplotlib takes long to import
    import matplotlib.pyplot as plt

    return plt.subplots(layout="constrained")[1]


def drawn(
    draw: Callable[[Figure], object],
    size: tuple[float, float],
    kinds: Sequence[str] = ("png", "svg"),
    style: dict[Any, Any] | None = None,
) -> Figures:
    """Return a figure of a size in inches (width, height) as files of some kinds; the
    style is what differs from `STYLE`.
    """
    # late: matplotlib takes long to import
    import matplotlib.figure

    files = {}
    with matplotlib.rc_context({**STYLE, **(style or {})}), warnings.catch_warnings():
        # a browser has the letter
        warnings.filterwarnings("ignore", "Glyph .* missing from font")
        figure = matplotlib.figure.Figure(figsize=size, layout="constrained")
        draw(figure)
        for kind in kinds:
            stream = io.BytesIO()
            figure.savefig(
                stream,
                format=kind,
                dpi=150,
                metadata={"Date": None} if kind == "svg" else None,
            )
            files[kind] = stream.getvalue()
    return files


SERIES = (BLUE, RED, "#1f7a45", "#b4540a", "#6b3fa0", GREY)
MARKS = "os^DvP"  # What tells series apart


def draw_shares(
    axes: Any,
    rows: Mapping[str, Sequence[tuple[float, Sequence[float]] | None]],
    series: Sequence[str],
    colours: Sequence[str] = SERIES,
) -> None:
    """Draw a row for each name, in which a dot with its interval is the share of each
    of the series; None is none.
    """
    for number, label in enumerate(series):
        colour = colours[number % len(colours)]
        mark = MARKS[number % len(MARKS)]
        for row, shares in enumerate(rows.values()):
            place = row + (number - (len(series) - 1) / 2) * min(
                0.22, 0.8 / len(series)
            )
            if (drawn := shares[number]) is not None:
                axes.plot(drawn[1], [place] * 2, color=colour, alpha=0.45, linewidth=3)
                axes.plot(drawn[0], place, mark, color=colour, ms=5, label=label)
                label = "_"  # a series has one line in the legend
    axes.set_yticks(range(len(rows)), list(rows))
    axes.set(xlim=(-0.03, 1.03), ylim=(len(rows) - 0.4, -0.6))
    axes.grid(True, axis="x")


def search_axes(
    objectives: Mapping[str, Sequence[float | None]],
    meaning: str,
    axes: Any,
    zero_means: str = "",
) -> None:
    """Draw searches on matplotlib axes, by their names: the best objective so far over
    the evaluations, and each single one, None where it was not a number. The meaning is
    the label of the vertical axis, and `zero_means` stands at the zero line, which is
    not drawn where that is empty.
    """
    styles = cycle(((BLUE, "-"), (RED, (0.0, (4.0, 1.5))), (GREY, "-")))
    for (name, values), (colour, dashes) in zip(
        objectives.items(), styles, strict=False
    ):
        each = np.array(values, dtype=float)  # None is NaN
        best = np.fmax.accumulate(each) if len(each) else each
        shown = np.unique(
            np.linspace(0, len(each) - 1, min(len(each), MOST_POINTS))
            .round()
            .astype(int)
        )
        # a dot is a line without a length: all of them are one path, and a page stays
        # small
        at, dots = (
            np.stack([ends, ends, ends * np.nan], 1).ravel()
            for ends in (shown + 1.0, each[shown])
        )
        axes.plot(
            at, dots, solid_capstyle="round", linewidth=4, alpha=0.35, color=colour
        )
        axes.plot(
            shown + 1,
            best[shown],
            linestyle=dashes,
            linewidth=2,
            color=colour,
            label=name,
        )
    if zero_means:
        axes.axhline(0.0, color=GREY, linewidth=1, linestyle=(0.0, (5.0, 4.0)))
        axes.annotate(
            zero_means,
            (1.0, 0.0),
            (-4, 4),
            axes.get_yaxis_transform(),
            "offset points",
            ha="right",
        )
    axes.set(
        xlabel="evaluations",
        ylabel=meaning,
        xlim=(1, max(2, *map(len, objectives.values()))),
    )
    axes.locator_params("x", integer=True)
    axes.grid(True, axis="y")
    axes.legend()


MARGIN = "margin [logits]; below 0: wrong"
ACCURACY = "accuracy"
"""What the colours of a map may mean: red is wrong in both."""
MOST_POINTS = 400  # Values of an axis that are drawn


def heat(
    axes: Any,
    values: Sequence[Sequence[float]],
    extent: tuple[float, ...],
    meaning: str,
    across: str,
    up: str,
) -> None:
    """Draw values as colours, rows from the lowest, with what they mean and the names
    of both axes.
    """
    finite = [abs(value) for row in values for value in row if math.isfinite(value)]
    if meaning == ACCURACY:
        colours: dict[str, str | float] = {"cmap": "RdBu", "vmin": 0.0, "vmax": 1.0}
    else:
        largest = max([*finite, 1e-6])
        colours = {"cmap": "RdBu", "vmin": -largest, "vmax": largest}
    shown = axes.imshow(values, origin="lower", extent=extent, aspect="auto", **colours)
    axes.set(xlabel=across, ylabel=up)
    axes.figure.colorbar(shown, ax=axes, label=meaning)


def axis_title(name: str, unit: str) -> str:
    """Return what an axis is called: ``pose.yaw [degrees]``."""
    return f"{name} [{unit}]" if unit not in ("", "name") else name


def figure_of(draw: Callable[[Any], object], size: tuple[float, float]) -> Figures:
    return drawn(lambda figure: draw(figure.subplots()), size)


# ---------------------------------------------------------------------------------------------------------------------
# Pictures with something drawn into them, boxes and masks of what is true and what is
# said; or several on a sheet.

Floats = npt.NDArray[np.float32]
TRUE = (0, 190, 255)
SAID = (255, 110, 0)
"""Colours of what is true and of what the model says; told apart in any kind of colour
vision.
"""
# Pixels of the longest side at least; smaller pictures are magnified, so that text can
# be read
SMALLEST = 512
# How much of a tint covers a picture; how many letters are as high as its longest side
TINT = 0.45
LETTERS = 28
Box = tuple[float, float, float, float]
Shape = Any  # What is drawn, a box or the pixels of a mask: `advsearch.tasks.Mark`


def marked(picture: Any, shapes: Sequence[Shape]) -> Floats:
    """Return a picture (H, W, 3), display-referred sRGB in [0, 1], with shapes drawn
    into it, magnified where it is small: (h, w, 3) float32.

    The box or the outline of what is true is blue; a box of the model is orange, and
    its mask tinted so. The text of a box stands at its upper left corner, that of the
    true one at the lower left. Maps stand to the right of the picture, what is true
    first, in greys of one range: that of what is true.
    """
    levels = to_8bit(picture)
    factor = max(1, -(-SMALLEST // max(levels.shape[:2])))
    size = levels.shape[1] * factor, levels.shape[0] * factor
    image = Image.fromarray(levels).resize(size, Image.Resampling.NEAREST)
    for shape in sorted(shapes, key=lambda shape: shape.true):
        if shape.mask is not None:
            mask = Image.fromarray(np.asarray(shape.mask, dtype=bool))
            whole = np.asarray(mask.resize(size, Image.Resampling.NEAREST))
            strength = whole * TINT
            if shape.true:  # the outline alone, two pixels wide
                far = np.pad(whole, 2)
                inner = (
                    whole
                    & far[4:, 2:-2]
                    & far[:-4, 2:-2]
                    & far[2:-2, 4:]
                    & far[2:-2, :-4]
                )
                strength = (whole & ~inner).astype(float)
            colour = Image.new("RGB", size, TRUE if shape.true else SAID)
            image.paste(
                colour,
                (0, 0),
                Image.fromarray(np.rint(255.0 * strength).astype(np.uint8)),
            )
    draw = ImageDraw.Draw(image)
    font = ImageFont.load_default(max(size) // LETTERS)
    boxes = [
        (shape, _corners(shape.box, factor, size))
        for shape in shapes
        if shape.box is not None
    ]
    for shape, ends in boxes:
        draw.rectangle(ends, outline=TRUE if shape.true else SAID, width=2)
    written: list[tuple[int, int, int, int]] = []
    for shape, ends in boxes:
        written.append(_write(draw, shape, ends, size, font, written))
    maps = sorted(
        (shape for shape in shapes if shape.map is not None),
        key=lambda shape: not shape.true,
    )
    panels = [image]
    for shape in maps:
        low = float(maps[0].map.min())
        high = float(maps[0].map.max())
        greys = np.clip(
            (np.asarray(shape.map, dtype=np.float64) - low) / max(high - low, 1e-12),
            0.0,
            1.0,
        )
        levels = np.rint(255.0 * np.nan_to_num(greys)).astype(np.uint8)
        panels.append(
            Image.fromarray(levels)
            .resize(size, Image.Resampling.NEAREST)
            .convert("RGB")
        )
        _write(
            ImageDraw.Draw(panels[-1]),
            shape,
            (0, 0, size[0] - 1, size[1] - 1),
            size,
            font,
            [],
        )
    sheet: Floats = np.hstack(
        [np.asarray(panel, dtype=np.float32) for panel in panels]
    ) / np.float32(255.0)
    return sheet


def _corners(box: Box, factor: int, size: tuple[int, int]) -> tuple[int, int, int, int]:
    x0, y0, x1, y1 = (round(end * factor) for end in box)
    left, top = (
        min(max(start, 0), side - 1) for start, side in zip((x0, y0), size, strict=True)
    )
    right, bottom = (
        min(end, side) - 1 for end, side in zip((x1, y1), size, strict=True)
    )
    return left, top, max(left, right), max(top, bottom)


def _write(
    draw: ImageDraw.ImageDraw, shape: Shape, ends: tuple[int, int, int, int], size: tuple[int, int], font: Any,
    others: Sequence[tuple[int, int, int, int]],
) -> tuple[int, int, int, int]:  # fmt: skip
    """Write beside a box, and return where: above it, or below where it is true, where
    no other text is.
    """
    text = f"true: {shape.text}" if shape.true else shape.text
    left, top, right, bottom = map(round, draw.textbbox((0, 0), text, font=font))
    wide = right - left + 6
    high = bottom - top + 6
    y = ends[3] if shape.true else ends[1] - high
    x = max(0, min(ends[0], size[0] - wide))
    y = max(0, min(y, size[1] - high))

    def free(row: int) -> bool:
        return all(
            x > x1 or x0 > x + wide or row > y1 or y0 > row + high
            for x0, y0, x1, y1 in others
        )

    rows = sorted(
        range(max(size[1] - high, 0) + 1), key=lambda row: (abs(row - y), row)
    )
    y = next(filter(free, rows), y)
    draw.rectangle((x, y, x + wide, y + high), fill=TRUE if shape.true else SAID)
    draw.text((x + 3 - left, y + 3 - top), text, fill=(0, 0, 0), font=font)
    return x, y, x + wide, y + high


GAP = 8  # Pixels between tiles, and of a line of text
LINE = 15
FONT = 12
# Pixels that a tile is wide at least, so that its text can be read; smaller pictures
# are magnified
NARROWEST = 160


def contact_sheet(
    pictures: Sequence[Floats], captions: Sequence[Sequence[str]]
) -> Floats:
    """Return pictures (H, W, 3), display-referred sRGB in [0, 1] and all of one size,
    side by side on white, each over lines of text; what is too long for the tile is
    cut. As the pictures, float32.
    """
    columns = columns_for(len(pictures))
    rows = math.ceil(len(pictures) / columns)
    factor = math.ceil(NARROWEST / pictures[0].shape[1])
    height, width = (factor * side for side in pictures[0].shape[:2])
    cell = width + GAP, height + LINE * max(map(len, captions)) + GAP
    sheet = Image.new("RGB", (GAP + columns * cell[0], GAP + rows * cell[1]), "white")
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(FONT)
    for number, (picture, lines) in enumerate(zip(pictures, captions, strict=True)):
        left = GAP + number % columns * cell[0]
        top = GAP + number // columns * cell[1]
        tile = Image.fromarray(to_8bit(picture)).resize(
            (width, height), Image.Resampling.NEAREST
        )
        sheet.paste(tile, (left, top))
        for place, line in enumerate(lines):
            text = short = " ".join(line[:200].split())
            while short and draw.textlength(text, font=font) > width:
                short = short[:-1]
                text = f"{short}..."
            draw.text(
                (left, top + height + LINE * place), text, fill="black", font=font
            )
    levels: Floats = np.asarray(sheet, dtype=np.float32)
    return np.asarray(levels / np.float32(255.0))


def columns_for(count: int) -> int:
    """Return how many of `count` tiles stand side by side: about the square root, and
    no holes where that can be.
    """
    least = math.ceil(math.sqrt(count))
    return next(
        (columns for columns in range(least, 2 * least + 1) if count % columns == 0),
        least,
    )
