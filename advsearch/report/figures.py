"""Draw figures with matplotlib, in one style, as the contents of PNG and SVG files.

Figures of studies show robust accuracy against epsilon, the worst and the average case,
and maps of the margin and of a sweep. Figures of `sweep --surface` show the parts of an
object with which wrong predictions are correlated, on its texture and in views.
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

Figures = dict[str, bytes]  # contents of files by suffix, png or svg
BLUE = "#1d5fd0"
RED = "#b3261e"
GREY = "#5c606a"
STYLE: dict[Any, Any] = {
    "font.family": ["DejaVu Sans"],
    "font.size": 9.0,
    "legend.frameon": False,
    "legend.fontsize": 8.0,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": GREY,
    "axes.labelcolor": "#1c1d20",
    "axes.titlelocation": "left",
    "axes.titlesize": 10.0,
    "axes.titleweight": "bold",
    "grid.color": "#dfe0e3",
    "grid.linewidth": 0.7,
    "svg.hashsalt": "advsearch",
    "svg.fonttype": "none",
    # Names come from users: a dollar sign in one does not begin a formula.
    "text.parse_math": False,
}


def new_axes() -> Any:
    """Return the axes of a new matplotlib figure, opened with pyplot so that the
    calling program shows it like its own figures.
    """
    # late: matplotlib takes long to import
    import matplotlib.pyplot as plt

    return plt.subplots(layout="constrained")[1]


def render_figure(
    draw: Callable[[Figure], object],
    size: tuple[float, float],
    kinds: Sequence[str] = ("png", "svg"),
    style: dict[Any, Any] | None = None,
) -> Figures:
    """Draw a figure and return it as the contents of files.

    Args:
        draw: function that draws on the empty figure.
        size: (width, height) of the figure in inches.
        kinds: suffixes of the files to make, png or svg.
        style: matplotlib settings that replace those of `STYLE`.
    """
    # late: matplotlib takes long to import
    import matplotlib.figure

    with matplotlib.rc_context({**STYLE, **(style or {})}), warnings.catch_warnings():
        # matplotlib warns of letters that its font lacks. An SVG contains the text
        # itself, and a browser draws it with another font.
        warnings.filterwarnings("ignore", "Glyph .* missing from font")
        figure = matplotlib.figure.Figure(figsize=size, layout="constrained")
        draw(figure)
        return {kind: _encode_figure(figure, kind) for kind in kinds}


def _encode_figure(figure: Figure, kind: str) -> bytes:
    """Return a figure as the content of a file; `kind` is its suffix, png or svg."""
    stream = io.BytesIO()
    figure.savefig(
        stream,
        format=kind,
        dpi=150,
        # without a date, the same figure always gives the same file
        metadata={"Date": None} if kind == "svg" else None,
    )
    return stream.getvalue()


SERIES = (BLUE, RED, "#1f7a45", "#b4540a", "#6b3fa0", GREY)
MARKS = "os^DvP"  # markers of the series


def draw_fractions(
    axes: Any,
    rows: Mapping[str, Sequence[tuple[float, Sequence[float]] | None]],
    series: Sequence[str],
    colours: Sequence[str] = SERIES,
) -> None:
    """Draw the fractions of several series, with their intervals, as dots on rows.

    Args:
        axes: axes of matplotlib, on which it is drawn.
        rows: rows by their labels, from the top. A row has an entry for each series: a
            fraction in [0, 1] and the two bounds of its interval, or None to draw
            nothing.
        series: names of the series, for the legend.
        colours: colours of the series; they repeat.
    """
    # Rows are 1 apart. The dots of a row are spread over at most 0.8 of that, around its
    # center.
    spacing = min(0.22, 0.8 / len(series))
    for index, label in enumerate(series):
        colour = colours[index % len(colours)]
        mark = MARKS[index % len(MARKS)]
        offset = (index - (len(series) - 1) / 2) * spacing
        fractions = [
            (row + offset, row_fractions[index])
            for row, row_fractions in enumerate(rows.values())
        ]
        _draw_series(axes, fractions, label, colour, mark)
    _set_row_axes(axes, list(rows))


def _set_row_axes(axes: Any, labels: Sequence[str]) -> None:
    """Set axes for fractions in [0, 1] on rows that are 1 apart, from the top.

    Args:
        axes: axes of matplotlib.
        labels: label of each row.
    """
    axes.set_yticks(range(len(labels)), labels)
    # upside down: the first row is at the top
    axes.set(xlim=(-0.03, 1.03), ylim=(len(labels) - 0.4, -0.6))
    axes.grid(True, axis="x")


def _draw_series(
    axes: Any,
    fractions: Sequence[tuple[float, tuple[float, Sequence[float]] | None]],
    label: str,
    colour: str,
    mark: str,
) -> None:
    """Draw the fractions of one series, with their intervals.

    Args:
        axes: axes of matplotlib, on which it is drawn.
        fractions: the height y of each row, and its fraction with the two bounds of its
            interval, or None to draw nothing.
        label: name of the series, for the legend.
        colour: its color.
        mark: its marker.
    """
    for y, fraction_and_interval in fractions:
        if fraction_and_interval is None:
            continue
        fraction, interval = fraction_and_interval
        axes.plot(interval, [y] * 2, color=colour, alpha=0.45, linewidth=3)
        axes.plot(fraction, y, mark, color=colour, ms=5, label=label)
        # Only the first dot of a series has its label, so that the legend has it once;
        # matplotlib leaves out labels that begin with "_".
        label = "_"


def draw_searches(
    objectives: Mapping[str, Sequence[float | None]],
    meaning: str,
    axes: Any,
    zero_means: str = "",
) -> None:
    """Draw the objectives of searches over their evaluations.

    Each search has a line for the best objective so far, and a faint dot for each
    evaluation.

    Args:
        objectives: objectives of each evaluation of each search, by the search's name;
            None where it was not a number.
        meaning: the label of the vertical axis.
        axes: axes of matplotlib, on which it is drawn.
        zero_means: the text at the zero line, which is left out if this is empty.
    """
    styles = cycle(((BLUE, "-"), (RED, (0.0, (4.0, 1.5))), (GREY, "-")))
    # the styles repeat if there are more searches
    for (name, values), (colour, dashes) in zip(
        objectives.items(), styles, strict=False
    ):
        _draw_search(axes, name, values, colour, dashes)
    if zero_means:
        _draw_zero_line(axes, zero_means)
    # up to 2 at least: an axis for a single evaluation would have no width
    last_evaluation = max(2, *map(len, objectives.values()))
    axes.set(xlabel="evaluations", ylabel=meaning, xlim=(1, last_evaluation))
    axes.locator_params("x", integer=True)
    axes.grid(True, axis="y")
    axes.legend()


def _draw_zero_line(axes: Any, text: str) -> None:
    """Draw a dashed horizontal line at zero, with a text at its right end."""
    axes.axhline(0.0, color=GREY, linewidth=1, linestyle=(0.0, (5.0, 4.0)))
    # 4 points above the line
    axes.annotate(
        text,
        xy=(1.0, 0.0),
        xytext=(-4, 4),
        xycoords=axes.get_yaxis_transform(),
        textcoords="offset points",
        ha="right",
    )


def _draw_search(
    axes: Any, name: str, values: Sequence[float | None], colour: str, dashes: Any
) -> None:
    """Draw the evaluations of one search, and a line for the best so far.

    Args:
        axes: axes of matplotlib, on which it is drawn.
        name: name of the search, for the legend.
        values: objective of each evaluation; None where it was not a number.
        colour: colour of dots and line.
        dashes: matplotlib's style of the line.
    """
    objective = np.array(values, dtype=float)  # None becomes NaN
    best_so_far = objective
    if len(objective):
        best_so_far = np.fmax.accumulate(objective)  # `fmax` ignores NaN
    # of a long search only some points are drawn
    indices = _select_points(len(objective))
    _draw_evaluation_dots(axes, indices + 1.0, objective[indices], colour)
    axes.plot(
        indices + 1,
        best_so_far[indices],
        linestyle=dashes,
        linewidth=2,
        color=colour,
        label=name,
    )


def _select_points(count: int) -> npt.NDArray[np.int_]:
    """Return the indices of at most `MAX_POINTS` of the values, evenly spaced."""
    positions = np.linspace(0, count - 1, min(count, MAX_POINTS))
    return np.unique(positions.round().astype(int))


def _as_dots(values: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.float64]:
    """Return coordinates (3n,) with which a single line looks like n dots.

    Each value comes twice, which is a line of length 0, and a NaN interrupts the line.
    """
    return np.stack([values, values, values * np.nan], 1).ravel()


MARGIN = "margin [logits]; below 0: wrong"
ACCURACY = "accuracy"
"""The quantities of the colors of a map. In both, red means wrong."""
MAX_POINTS = 400  # maximum number of points that are drawn of a search


def _draw_evaluation_dots(
    axes: Any, numbers: Any, objectives: Any, colour: str
) -> None:
    """Draw a faint dot for each evaluation of a search.

    Each dot is drawn as a line of length 0 with round ends. So all dots are a single
    path in the SVG, which keeps the page small.

    Args:
        axes: axes of matplotlib, on which it is drawn.
        numbers: (n,) number of each evaluation, from 1.
        objectives: (n,) objective of each evaluation; NaN is not drawn.
        colour: colour of the dots.
    """
    axes.plot(
        _as_dots(numbers),
        _as_dots(objectives),
        solid_capstyle="round",
        linewidth=4,
        alpha=0.35,
        color=colour,
    )


def draw_heat_map(
    axes: Any,
    values: Sequence[Sequence[float]],
    extent: tuple[float, ...],
    meaning: str,
    x_label: str,
    y_label: str,
) -> None:
    """Draw a table of values as a map of colours, with a colour bar.

    Args:
        axes: axes of matplotlib, on which it is drawn.
        values: rows of the map, the lowest first.
        extent: (left, right, bottom, top) of the map on the axes.
        meaning: meaning of the colours, the label of their bar; `ACCURACY` has the
            range 0 to 1.
        x_label: the name of the horizontal axis.
        y_label: the name of the vertical axis.
    """
    lower, upper = _choose_map_limits(values, meaning)
    image = axes.imshow(
        values,
        origin="lower",
        extent=extent,
        aspect="auto",
        cmap="RdBu",
        vmin=lower,
        vmax=upper,
    )
    axes.set(xlabel=x_label, ylabel=y_label)
    axes.figure.colorbar(image, ax=axes, label=meaning)


def _choose_map_limits(
    values: Sequence[Sequence[float]], meaning: str
) -> tuple[float, float]:
    """Return the values of the first and the last color of a map.

    Args:
        values: values of the map.
        meaning: meaning of the colors; `ACCURACY` has the range 0 to 1.
    """
    if meaning == ACCURACY:
        return 0.0, 1.0
    magnitudes = [abs(value) for row in values for value in row if math.isfinite(value)]
    # The same limit on both sides, so that 0 has the middle colour. 1e-6: the range must
    # not be empty.
    upper = max([*magnitudes, 1e-6])
    return -upper, upper


def format_axis_title(name: str, unit: str) -> str:
    """Return the title of an axis: ``pose.yaw [degrees]``."""
    return f"{name} [{unit}]" if unit not in ("", "name") else name


def render_axes(draw: Callable[[Any], object], size: tuple[float, float]) -> Figures:
    return render_figure(lambda figure: draw(figure.subplots()), size)


# --------------------------------------------------------------------------------
# Images with boxes and masks of the ground truth and of predictions, and sheets of
# several images.

Floats = npt.NDArray[np.float32]
TRUE_COLOR = (0, 190, 255)
PREDICTED_COLOR = (255, 110, 0)
"""Colors of the ground truth and of predictions, which people with any type of color
blindness can distinguish.
"""
# Minimum length of the longest side in pixels. Smaller images are magnified, so that
# text is readable.
MIN_IMAGE_SIDE = 512
TINT = 0.45  # opacity of a mask over an image
LETTERS_PER_SIDE = 28  # the longest side divided by the height of a letter
Box = tuple[float, float, float, float]
Shape = Any  # a box or a mask to draw: `advsearch.tasks.Mark`


def draw_marks(picture: Any, shapes: Sequence[Shape]) -> Floats:
    """Return a picture with boxes, masks and maps drawn into it.

    Ground truth is blue, the model's predictions are orange. Boxes and the outline of a
    true mask are lines; a predicted mask is a tint. The text of a predicted box stands
    above its upper left corner, that of a true box below its lower left. Maps, such as
    depth, stand to the right of the picture, the true one first, in greys; black and
    white are the smallest and the largest value of the first map.

    Args:
        picture: (H, W, 3), display-referred sRGB in [0, 1]; a small one is magnified.
        shapes: shapes to draw, with coordinates in pixels of `picture`.

    Returns:
        The drawing (h, w, 3), float32 in [0, 1].
    """
    original = Image.fromarray(to_8bit(picture))
    # rounded up, so that the longest side has MIN_IMAGE_SIDE pixels at least
    factor = max(1, math.ceil(MIN_IMAGE_SIDE / max(original.size)))
    size = (original.width * factor, original.height * factor)
    image = original.resize(size, Image.Resampling.NEAREST)
    # True masks are drawn last, so that they stay visible (False sorts before True).
    for shape in sorted(shapes, key=lambda shape: shape.true):
        if shape.mask is not None:
            _draw_mask(image, shape)
    font = ImageFont.load_default(max(size) // LETTERS_PER_SIDE)
    _draw_boxes(image, shapes, factor, font)
    panels = [image, *_make_map_panels(shapes, size, font)]
    sheet_levels = np.hstack([np.asarray(panel, dtype=np.float32) for panel in panels])
    sheet: Floats = sheet_levels / np.float32(255.0)
    return sheet


def _draw_mask(image: Image.Image, shape: Shape) -> None:
    """Tint the pixels of a predicted mask, or draw only the outline of a true mask.

    Args:
        image: the image, which is drawn on.
        shape: the mark with the mask, which may be smaller than the image.
    """
    small_mask = Image.fromarray(np.asarray(shape.mask, dtype=bool))
    mask = np.asarray(small_mask.resize(image.size, Image.Resampling.NEAREST))
    # how much of the colour covers each pixel, in [0, 1]
    strength = mask * TINT
    if shape.true:
        strength = _find_outline(mask).astype(float)
    colour = Image.new("RGB", image.size, TRUE_COLOR if shape.true else PREDICTED_COLOR)
    opacity = Image.fromarray(np.rint(255.0 * strength).astype(np.uint8))
    image.paste(colour, (0, 0), opacity)


def _find_outline(mask: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Return which pixels of a mask (H, W) belong to its outline, two pixels wide.

    A pixel is inside where the pixels two steps above, below, left and right of it are
    in the mask too; the rest of the mask is outline.
    """
    padded = np.pad(mask, 2)
    inner = (
        mask
        & padded[4:, 2:-2]
        & padded[:-4, 2:-2]
        & padded[2:-2, 4:]
        & padded[2:-2, :-4]
    )
    outline: npt.NDArray[np.bool_] = mask & ~inner
    return outline


def _draw_boxes(
    image: Image.Image, shapes: Sequence[Shape], factor: int, font: Any
) -> None:
    """Draw the boxes of shapes, and then their texts, so that no text covers another.

    Args:
        image: the magnified image, which is drawn on.
        shapes: marks, some of which have boxes in pixels of the original image.
        factor: factor by which the image was magnified.
        font: font of the texts.
    """
    draw = ImageDraw.Draw(image)
    boxes = [
        (shape, _to_pixel_corners(shape.box, factor, image.size))
        for shape in shapes
        if shape.box is not None
    ]
    for shape, corners in boxes:
        color = TRUE_COLOR if shape.true else PREDICTED_COLOR
        draw.rectangle(corners, outline=color, width=2)
    # Boxes of the texts that were written so far, which the next text must not cover.
    text_boxes: list[tuple[int, int, int, int]] = []
    for shape, corners in boxes:
        text_box = _write_label(draw, shape, corners, image.size, font, text_boxes)
        text_boxes.append(text_box)


def _make_map_panels(
    shapes: Sequence[Shape], size: tuple[int, int], font: Any
) -> list[Image.Image]:
    """Return the maps of shapes as grey images with their texts, the true one first.

    Black and white are the smallest and the largest value of the first map, so that all
    maps have the same scale.

    Args:
        shapes: marks, some of which have a map (h, w), such as depth.
        size: (width, height) of each returned image in pixels.
        font: font of the texts.
    """
    shapes_with_map = [shape for shape in shapes if shape.map is not None]
    # False, of the true map, sorts first
    shapes_with_map.sort(key=lambda shape: not shape.true)
    if not shapes_with_map:
        return []
    first_map = shapes_with_map[0].map
    limits = (float(first_map.min()), float(first_map.max()))
    return [_make_map_panel(shape, limits, size, font) for shape in shapes_with_map]


def _make_map_panel(
    shape: Shape, limits: tuple[float, float], size: tuple[int, int], font: Any
) -> Image.Image:
    """Return the map of a shape as a grey image with its text.

    Args:
        shape: a mark with a map (h, w).
        limits: the values that are black and white.
        size: (width, height) of the image in pixels.
        font: font of the text.
    """
    lower, upper = limits
    grey_image = _make_grey_image(shape.map, lower, upper)
    panel = grey_image.resize(size, Image.Resampling.NEAREST).convert("RGB")
    frame = (0, 0, size[0] - 1, size[1] - 1)
    _write_label(ImageDraw.Draw(panel), shape, frame, size, font, text_boxes=[])
    return panel


def _make_grey_image(values: Any, lower: float, upper: float) -> Image.Image:
    """Return a map (h, w) as a gray image.

    Args:
        values: the map.
        lower: the value that is black.
        upper: the value that is white.
    """
    value_range = max(upper - lower, 1e-12)  # not 0, for a constant map
    greys = np.clip(
        (np.asarray(values, dtype=np.float64) - lower) / value_range, 0.0, 1.0
    )
    levels = np.rint(255.0 * np.nan_to_num(greys)).astype(np.uint8)
    return Image.fromarray(levels)


def _to_pixel_corners(
    box: Box, factor: int, size: tuple[int, int]
) -> tuple[int, int, int, int]:
    """Return (left, top, right, bottom) of a box in the magnified image, in whole
    pixels that all belong to the box and lie inside the image.

    Args:
        box: (x0, y0, x1, y1) in pixels of the image before it was magnified.
        factor: factor by which the image was magnified.
        size: (width, height) of the magnified image.
    """
    x0, y0, x1, y1 = (round(bound * factor) for bound in box)
    width, height = size
    left = min(max(x0, 0), width - 1)
    top = min(max(y0, 0), height - 1)
    # x1 and y1 are the ends, one past the last pixel
    right = min(x1, width) - 1
    bottom = min(y1, height) - 1
    # at least one pixel, also of a box outside of the image
    return left, top, max(left, right), max(top, bottom)


LABEL_MARGIN = 3  # pixels of background on each side of a text


def _write_label(
    draw: ImageDraw.ImageDraw,
    shape: Shape,
    corners: tuple[int, int, int, int],
    size: tuple[int, int],
    font: Any,
    text_boxes: Sequence[tuple[int, int, int, int]],
) -> tuple[int, int, int, int]:
    """Write the text of a shape at its box, and return the box of the text.

    The text of a prediction stands above its box, that of a true shape below. If it
    would cover another text, it moves to the nearest free height. All lengths are
    pixels; the returned box is (x0, y0, x1, y1).

    Args:
        draw: draws on the image.
        shape: has the text.
        corners: (left, top, right, bottom) of the shape.
        size: (width, height) of the image.
        font: font of the text.
        text_boxes: the boxes of texts written before.
    """
    text = f"true: {shape.text}" if shape.true else shape.text
    # (left, top, right, bottom) of the letters, if the text were drawn at (0, 0)
    letters = [round(side) for side in draw.textbbox((0, 0), text, font=font)]
    width = letters[2] - letters[0] + 2 * LABEL_MARGIN
    height = letters[3] - letters[1] + 2 * LABEL_MARGIN
    x, y = _choose_label_corner(shape, corners, (width, height), size, text_boxes)
    background = TRUE_COLOR if shape.true else PREDICTED_COLOR
    draw.rectangle((x, y, x + width, y + height), fill=background)
    # The letters begin a little to the right of and below the position of the text.
    position = (x + LABEL_MARGIN - letters[0], y + LABEL_MARGIN - letters[1])
    draw.text(position, text, fill=(0, 0, 0), font=font)
    return x, y, x + width, y + height


def _choose_label_corner(
    shape: Shape,
    corners: tuple[int, int, int, int],
    text_size: tuple[int, int],
    size: tuple[int, int],
    text_boxes: Sequence[tuple[int, int, int, int]],
) -> tuple[int, int]:
    """Return the upper left corner (x, y) of a text with its background.

    Args:
        shape: the shape that the text belongs to.
        corners: (left, top, right, bottom) of the shape.
        text_size: (width, height) of the text.
        size: (width, height) of the image.
        text_boxes: the boxes of texts written before.
    """
    width, height = text_size
    left, top, _, bottom = corners
    # the text begins at the left side of the shape, but stays inside of the image
    x = max(0, min(left, size[0] - width))
    max_y = max(0, size[1] - height)
    preferred_y = bottom if shape.true else top - height
    preferred_y = max(0, min(preferred_y, size[1] - height))
    return x, _find_free_height(x, preferred_y, max_y, text_size, text_boxes)


def _find_free_height(
    x: int,
    preferred_y: int,
    max_y: int,
    size: tuple[int, int],
    text_boxes: Sequence[tuple[int, int, int, int]],
) -> int:
    """Return the free height for a text that is nearest to a preferred one.

    At a free height the text covers no other text. If there is none, the preferred
    height is returned.

    Args:
        x: left side of the text.
        preferred_y: preferred upper side.
        max_y: largest upper side.
        size: (width, height) of the text.
        text_boxes: (x0, y0, x1, y1) of the other texts.
    """
    # by distance from the preferred height; of two at the same distance, the upper one
    nearest_first = sorted(range(max_y + 1), key=lambda y: (abs(y - preferred_y), y))
    for y in nearest_first:
        if _is_free_position((x, y), size, text_boxes):
            return y
    return preferred_y


def _is_free_position(
    corner: tuple[int, int],
    size: tuple[int, int],
    text_boxes: Sequence[tuple[int, int, int, int]],
) -> bool:
    """Return whether a text would cover no other one at a position.

    Args:
        corner: (left, top) of the text.
        size: (width, height) of the text.
        text_boxes: (x0, y0, x1, y1) of the other texts.
    """
    x, y = corner
    width, height = size
    # it lies to the right or left of each other text, or below or above it
    return all(
        x > x1 or x0 > x + width or y > y1 or y0 > y + height
        for x0, y0, x1, y1 in text_boxes
    )


# In pixels: the gap between tiles, and the heights of a line of text and of its font.
GAP = 8
LINE = 15
FONT = 12
# Minimum width of a tile in pixels, so that its text is readable. Smaller images are
# magnified.
MIN_TILE_WIDTH = 160


def make_contact_sheet(
    pictures: Sequence[Floats], captions: Sequence[Sequence[str]]
) -> Floats:
    """Return pictures in rows on a white sheet, each above its lines of text.

    Args:
        pictures: (H, W, 3), display-referred sRGB in [0, 1], all of one size; small
            ones are magnified.
        captions: the lines of each picture; what is too long for the tile is cut.

    Returns:
        The sheet (h, w, 3), float32 in [0, 1].
    """
    factor = math.ceil(MIN_TILE_WIDTH / pictures[0].shape[1])
    height, width = (factor * side for side in pictures[0].shape[:2])
    # A cell includes the gap to its right and below. All captions get the room of the
    # longest.
    cell_width = width + GAP
    cell_height = height + LINE * max(map(len, captions)) + GAP
    n_columns = choose_column_count(len(pictures))
    n_rows = math.ceil(len(pictures) / n_columns)
    # one more gap is at the left and above
    sheet = Image.new(
        "RGB", (GAP + n_columns * cell_width, GAP + n_rows * cell_height), "white"
    )
    for index, picture in enumerate(pictures):
        row, column = divmod(index, n_columns)
        corner = (GAP + column * cell_width, GAP + row * cell_height)
        _paste_tile(sheet, picture, captions[index], corner, (width, height))
    return np.asarray(np.asarray(sheet, dtype=np.float32) / np.float32(255.0))


def _paste_tile(
    sheet: Image.Image,
    picture: Floats,
    lines: Sequence[str],
    corner: tuple[int, int],
    size: tuple[int, int],
) -> None:
    """Put a picture on a sheet, and its caption below it.

    Args:
        sheet: the sheet, which is drawn on.
        picture: (H, W, 3) in [0, 1].
        lines: lines of the caption.
        corner: (left, top) of the picture on the sheet, pixels.
        size: (width, height) to which the picture is scaled, pixels.
    """
    left, top = corner
    width, height = size
    tile = Image.fromarray(to_8bit(picture)).resize(size, Image.Resampling.NEAREST)
    sheet.paste(tile, corner)
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(FONT)
    _write_caption(draw, lines, (left, top + height), width, font)


def _write_caption(
    draw: ImageDraw.ImageDraw,
    lines: Sequence[str],
    corner: tuple[int, int],
    width: int,
    font: Any,
) -> None:
    """Write lines of text below each other, each cut to a width.

    Args:
        draw: draws on the sheet.
        lines: the lines.
        corner: (left, top) of the first line, pixels.
        width: width of a line, pixels.
        font: font of the text.
    """
    left, top = corner
    for index, line in enumerate(lines):
        # The loop below cuts one letter at a time, which is slow for a very long line.
        # No tile has room for 200 letters, so more are cut at once.
        text = " ".join(line[:200].split())
        start = text
        while start and draw.textlength(text, font=font) > width:
            start = start[:-1]
            text = f"{start}..."
        draw.text((left, top + LINE * index), text, fill="black", font=font)


def choose_column_count(count: int) -> int:
    """Return the number of columns for a sheet of `count` tiles.

    It is the smallest divisor of the count between the square root and twice that, so
    that the last row is full; without such a divisor, it is the square root, rounded
    up.
    """
    min_columns = math.ceil(math.sqrt(count))
    # with a divisor of the count, the last row is full
    for n_columns in range(min_columns, 2 * min_columns + 1):
        if count % n_columns == 0:
            return n_columns
    return min_columns
