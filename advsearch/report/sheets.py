"""Write pictures to PDF sheets at their real size, to print, cut out and glue on.

The first page has instructions, and a square and a ruler to check the scale of the
printer. The pieces follow, with bleed around them and marks where to cut. A piece that
is larger than a page is cut into parts.
"""

from __future__ import annotations

import io
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from PIL import Image, ImageCms

from advsearch.errors import FileFormatError, InputError
from advsearch.trust.stored_files import read_bytes

Bytes = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]
INCH = 25.4
# Width and height in millimetres
PAPERS = {"a4": (210.0, 297.0), "a3": (297.0, 420.0), "letter": (215.9, 279.4)}
# All lengths are in millimetres.
MARGIN = 15.0  # width of the margins of a page
FOOT = 20.0  # additional margin at the bottom, for the ruler
SQUARE = 50.0  # side of the square that the user measures
RULER = 100.0  # length of the ruler
MARK_LENGTH = 5.0  # length of a mark where to cut
MARK_GAP = 1.0  # distance of a mark from the bleed
DEFAULT_MAX_SHEETS = 200  # default maximum number of sheets
MAX_SHEETS = 10_000
CHECKLIST = (
    "\u2610 Print all pages, and measure the square.",
    "\u2610 Photograph the colour chart on the last page: upright and whole, in even "
    "light, without gloss.",
    "\u2610 advsearch.measured_palette(PHOTOGRAPH) says what came out. Where that is "
    "far off, search within it.",
    "\u2610 Cut the pieces out, and stick them on.",
    "\u2610 Align the object with renderings by phone (advsearch dashboard), and "
    "photograph it.",
    "\u2610 Compare: advsearch show, and advsearch report, say how often photographs "
    "and renderings agree.",
)
"""A checklist for the user."""
MAX_PROFILE_BYTES = 16 << 20
MAX_LISTED_PIECES = 30  # maximum number of pieces in the list on the first page


@dataclass(frozen=True, eq=False)
class Piece:
    """A picture to print and cut out.

    Attributes:
        name: name that is printed next to it.
        picture: (h, w, 3) uint8 sRGB, with the bleed.
        pixel_size_mm: (width, height) of a pixel in millimetres.
        bleed: (columns, rows) of pixels beyond the line to cut, on each side.
        cut_mask: (h, w) bool, the part to cut out; None for the rectangle within the
            bleed.
    """

    name: str
    picture: Bytes
    pixel_size_mm: tuple[float, float]
    bleed: tuple[int, int] = (0, 0)
    cut_mask: Mask | None = None

    @property
    def size(self) -> tuple[float, float]:
        """Width and height without bleed, in millimetres."""
        height, width = self.picture.shape[:2]
        pixel_width, pixel_height = self.pixel_size_mm
        n_columns = width - 2 * self.bleed[0]
        n_rows = height - 2 * self.bleed[1]
        return n_columns * pixel_width, n_rows * pixel_height

    @property
    def frame_size_mm(self) -> tuple[float, float]:
        """Width of bleed and marks on each side, in millimetres: (x, y)."""
        pixel_width, pixel_height = self.pixel_size_mm
        bleed_x = self.bleed[0] * pixel_width
        bleed_y = self.bleed[1] * pixel_height
        return bleed_x + MARK_GAP + MARK_LENGTH, bleed_y + MARK_GAP + MARK_LENGTH


@dataclass(frozen=True, eq=False)
class PlacedPart:
    """A part of a piece on a page.

    Attributes:
        piece: the piece.
        name: name that is printed next to the part.
        pixel_bounds: columns and rows of the part in the picture of the piece: (x0, x1,
            y0, y1), of which x1 and y1 are excluded.
        x: position of its left edge on the page in millimetres.
        y: position of its upper edge.
    """

    piece: Piece
    name: str
    pixel_bounds: tuple[int, int, int, int]
    x: float = 0.0
    y: float = 0.0

    @property
    def outer_size_mm(self) -> tuple[float, float]:
        """Width and height with bleed and marks, in millimetres."""
        x0, x1, y0, y1 = self.pixel_bounds
        frame_x, frame_y = self.piece.frame_size_mm
        pixel_width, pixel_height = self.piece.pixel_size_mm
        return (
            (x1 - x0) * pixel_width + 2 * frame_x,
            (y1 - y0) * pixel_height + 2 * frame_y,
        )


def write_sheets(
    path: Path,
    pieces: Sequence[Piece],
    title: str,
    *,
    paper: str = "a4",
    profile: Path | None = None,
    max_sheets: int = DEFAULT_MAX_SHEETS,
    make_last_page: Callable[[str, tuple[float, float], Any], Figure] | None = None,
) -> int:
    """Write pieces at their real size to a PDF, and return its number of pages.

    The first page has the title and explains how to print. Sheets with the parts of the
    pieces follow.

    Args:
        path: path of the PDF.
        pieces: pieces to print, at least one.
        title: title of the document.
        paper: a name in `PAPERS`.
        profile: the ICC profile of an RGB printer, to which colours are converted; None
            leaves them sRGB.
        max_sheets: maximum number of sheets between the first and the last page, from 1
            to `MAX_SHEETS`.
        make_last_page: function that makes one more page from the title, the size of
            the paper in millimetres and the colour conversion (None without a profile).

    Raises:
        InputError: there is no such paper, or more sheets would be needed.
        FileFormatError: the profile is not that of an RGB printer.
    """
    _check_sheet_arguments(paper, max_sheets)
    convert = None if profile is None else _load_color_conversion(profile)
    pages = list(arrange_pages(pieces, PAPERS[paper]))
    _check_sheet_count(len(pages), max_sheets, paper)
    with PdfPages(path, metadata={"Title": title, "CreationDate": None}) as file:
        file.savefig(_make_cover(pieces, title, PAPERS[paper], len(pages), profile))
        for number, page in enumerate(pages, 1):
            heading = f"{title}: sheet {number} of {len(pages)}"
            file.savefig(_make_sheet(page, heading, PAPERS[paper], convert))
        if make_last_page is not None:
            file.savefig(make_last_page(title, PAPERS[paper], convert))
    n_cover_pages = 1
    n_last_pages = 0 if make_last_page is None else 1
    return n_cover_pages + len(pages) + n_last_pages


def _check_sheet_arguments(paper: str, max_sheets: int) -> None:
    """Check the name of the paper and the maximum number of sheets.

    Raises:
        InputError: there is no such paper, or the number is out of range.
    """
    if paper not in PAPERS:
        raise InputError(f"paper: expected one of {', '.join(PAPERS)}, got {paper!r}")
    if not 1 <= max_sheets <= MAX_SHEETS:
        raise InputError(
            f"sheets: expected a whole number from 1 to {MAX_SHEETS}, got {max_sheets}"
        )


def _check_sheet_count(n_sheets: int, max_sheets: int, paper: str) -> None:
    """Check that no more sheets are needed than may be written.

    Raises:
        InputError: more are; the message has the name of the paper.
    """
    if n_sheets > max_sheets:
        raise InputError(
            f"sheets: it takes {n_sheets} sheets of {paper}, but at most "
            f"{max_sheets} are written; raise the limit (`sheets={n_sheets}`), or "
            "use a larger `paper` or a smaller `size`"
        )


def _load_color_conversion(profile: Path) -> Any:
    """Return the conversion of Pillow from sRGB to the colours of a printer.

    Raises:
        FileFormatError: the file is not the ICC profile of an RGB printer.
    """
    data = read_bytes(profile, "an ICC profile", MAX_PROFILE_BYTES)
    try:
        printer = ImageCms.ImageCmsProfile(io.BytesIO(data))
        return ImageCms.buildTransform(
            ImageCms.createProfile("sRGB"), printer, "RGB", "RGB"
        )
    except (ImageCms.PyCMSError, OSError, ValueError) as error:
        raise FileFormatError(
            f"{profile}: expected the ICC profile of an RGB printer ({error})"
        ) from None


def _make_sheet(
    parts: Sequence[PlacedPart], heading: str, paper: tuple[float, float], convert: Any
) -> Figure:
    """Return a page with parts of pieces, a ruler, and a text at the lower right.

    Args:
        parts: parts with their positions on the page.
        heading: the text.
        paper: (width, height) in millimetres.
        convert: converts colours from sRGB to those of the printer; None leaves them.
    """
    figure, axes = make_blank_page(paper)
    for part in parts:
        _draw_part(axes, part, convert)
    right, bottom = (side - MARGIN for side in paper)
    axes.text(right, bottom, heading, fontsize=7, ha="right", va="bottom")
    _draw_ruler(axes, paper)
    return figure


def arrange_pages(
    pieces: Sequence[Piece], paper: tuple[float, float]
) -> Iterator[list[PlacedPart]]:
    """Yield the parts on each page, with their positions.

    Pieces are cut into parts that fit on a page. Parts are sorted by height, the
    highest first, so that the parts of a row have about the same height. They fill a
    page row by row from its upper left corner.

    Args:
        pieces: what is printed.
        paper: (width, height) in millimetres.

    Raises:
        InputError: a pixel is larger than a page, or a piece needs more than
            `MAX_SHEETS` pages.
    """
    width = paper[0] - 2 * MARGIN
    height = paper[1] - 2 * MARGIN - FOOT
    parts = [part for piece in pieces for part in _cut_piece(piece, width, height)]
    parts.sort(key=lambda part: -part.outer_size_mm[1])
    page: list[PlacedPart] = []
    # (x, y): upper left corner of the next part, inside the margins; and the height of
    # the current row of parts
    x = 0.0
    y = 0.0
    row_height = 0.0
    for part in parts:
        part_width, part_height = part.outer_size_mm
        if x + part_width > width and x > 0.0:  # the row is full
            x = 0.0
            y = y + row_height
            row_height = 0.0
        if y + part_height > height and page:  # the page is full
            yield page
            page = []
            x = 0.0
            y = 0.0
            row_height = 0.0
        page.append(_move_to(part, x, y))
        x = x + part_width
        row_height = max(row_height, part_height)
    if page:
        yield page


def _move_to(part: PlacedPart, x: float, y: float) -> PlacedPart:
    """Return a part with its upper left corner, marks included, at a position.

    Args:
        part: the part.
        x: position inside the margins of the page, in millimetres.
        y: position below the upper margin.
    """
    # The position of a part is that of its corner inside of bleed and marks.
    frame_width, frame_height = part.piece.frame_size_mm
    return replace(part, x=MARGIN + x + frame_width, y=MARGIN + y + frame_height)


def _cut_piece(piece: Piece, width: float, height: float) -> Iterator[PlacedPart]:
    """Cut a piece into equal parts that fit on a page together with bleed and marks.

    Cuts lie between pixels. The parts have no position on a page yet.

    Args:
        piece: piece to print.
        width: width of a page inside its margins, millimetres.
        height: height of a page inside its margins, millimetres.

    Raises:
        InputError: it would take more than `MAX_SHEETS` parts.
    """
    columns, rows = _find_cuts(piece, width, height)
    n_parts = len(columns) * len(rows)
    if n_parts > MAX_SHEETS:
        raise InputError(
            f"size: it would take more than {MAX_SHEETS} sheets; give a smaller one"
        )
    for row, (y0, y1) in enumerate(rows, 1):
        for column, (x0, x1) in enumerate(columns, 1):
            name = piece.name
            if n_parts > 1:
                name += f", row {row} of {len(rows)}, column {column} of {len(columns)}"
            yield PlacedPart(piece, name, pixel_bounds=(x0, x1, y0, y1))


Bounds = list[tuple[int, int]]  # (begin, end) of consecutive intervals


def _find_cuts(piece: Piece, width: float, height: float) -> tuple[Bounds, Bounds]:
    """Return where the picture of a piece is cut, without its bleed.

    Args:
        piece: piece to print.
        width: width of a page inside its margins, millimetres.
        height: height of a page inside its margins, millimetres.

    Returns:
        (begin, end) of each column of parts, and of each row of parts, in pixels of the
        picture.
    """
    bleed_x, bleed_y = piece.bleed
    n_rows, n_columns = piece.picture.shape[:2]
    frame_x, frame_y = piece.frame_size_mm  # bleed and marks on each side
    pixel_width, pixel_height = piece.pixel_size_mm
    # the largest part that fits on a page with its frame, in pixels
    max_columns = (width - 2 * frame_x) / pixel_width
    max_rows = (height - 2 * frame_y) / pixel_height
    columns = _cut_evenly(n_columns - 2 * bleed_x, max_columns)
    rows = _cut_evenly(n_rows - 2 * bleed_y, max_rows)
    # the picture begins with the bleed
    return (
        [(bleed_x + begin, bleed_x + end) for begin, end in columns],
        [(bleed_y + begin, bleed_y + end) for begin, end in rows],
    )


def _cut_evenly(length: int, max_length: float) -> list[tuple[int, int]]:
    """Cut a length into the fewest equal parts that fit.

    Parts differ by one pixel if the length is no multiple of their number.

    Args:
        length: length in pixels.
        max_length: largest length of a part in pixels, not rounded.

    Returns:
        (begin, end) of each part.

    Raises:
        InputError: not even one pixel fits.
    """
    if max_length < 1.0:
        raise InputError(
            "size: a pixel of it is larger than a sheet; give a "
            "smaller one, or a larger `paper`"
        )
    count = math.ceil(length / math.floor(max_length))
    bounds = [round(length * index / count) for index in range(count + 1)]
    return list(itertools.pairwise(bounds))


def make_blank_page(paper: tuple[float, float]) -> tuple[Figure, Axes]:
    """Return an empty figure for a page, and axes that cover it.

    The coordinates of the axes are millimetres from the upper left corner.

    Args:
        paper: (width, height) of the page in millimetres.
    """
    figure = Figure(figsize=(paper[0] / INCH, paper[1] / INCH))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    axes.set_xlim(0.0, paper[0])
    axes.set_ylim(paper[1], 0.0)
    return figure, axes


def _draw_line(axes: Axes, xs: Sequence[float], ys: Sequence[float]) -> None:
    axes.plot(
        xs, ys, color="black", linewidth=0.4, solid_capstyle="butt", clip_on=False
    )


def _make_cover(
    pieces: Sequence[Piece],
    title: str,
    paper: tuple[float, float],
    sheets: int,
    profile: Path | None,
) -> Figure:
    """Return the first page: how to print, a square to measure, and the list of pieces.

    Args:
        pieces: what is printed.
        title: title of the page.
        paper: (width, height) in millimetres.
        sheets: number of sheets that follow.
        profile: the ICC profile to which colors were converted; None for sRGB.
    """
    figure, axes = make_blank_page(paper)
    x = MARGIN
    y = MARGIN + 5.0
    axes.text(x, y, title, fontsize=14, va="top")
    square_top = y + 15.0  # below the title
    square_bottom = y + 15.0 + SQUARE
    _draw_measured_square(axes, x, square_top, square_bottom)
    text = "\n".join(_list_cover_lines(pieces, sheets, profile))
    axes.text(x, square_bottom + 10.0, text, fontsize=9, va="top", linespacing=1.6)
    _draw_ruler(axes, paper)
    return figure


def _draw_measured_square(axes: Axes, left: float, top: float, bottom: float) -> None:
    """Draw the square that the user measures to check the scale of the printer.

    Args:
        axes: axes of the page, in millimetres.
        left, top, bottom: sides of the square, in millimetres.
    """
    right = left + SQUARE
    _draw_line(axes, [left, right, right, left, left], [top, top, bottom, bottom, top])


def _list_cover_lines(
    pieces: Sequence[Piece], sheets: int, profile: Path | None
) -> list[str]:
    """Return the lines that explain how to print, and the list of pieces.

    Args:
        pieces: what is printed.
        sheets: number of sheets that follow.
        profile: the ICC profile to which colors were converted; None for sRGB.
    """
    colours = "sRGB" if profile is None else f"converted from sRGB by {profile.name}"
    return [
        f'{sheets} sheets follow. Print all pages at 100 % ("actual size"), then '
        "measure this square: "
        f"{SQUARE:g} mm a side.",
        "Cut along the lines between the marks; the colour beyond them is bleed.",
        f"Colours: {colours}.",
        "",
        *CHECKLIST,
        "",
        *_list_piece_lines(pieces),
    ]


def _list_piece_lines(pieces: Sequence[Piece]) -> list[str]:
    """Return a line with name and size for each piece, up to `MAX_LISTED_PIECES`, and
    one with the number of further pieces.
    """
    lines = []
    for piece in pieces[:MAX_LISTED_PIECES]:
        width, height = piece.size
        lines.append(f"{piece.name}: {width:.1f} x {height:.1f} mm")
    n_unlisted = len(pieces) - MAX_LISTED_PIECES
    if n_unlisted > 0:
        lines.append(f"and {n_unlisted} more")
    return lines


def _draw_ruler(axes: Axes, paper: tuple[float, float]) -> None:
    """Draw a ruler at the foot of a page, with a mark at each centimetre, so that the
    scale of the print can be checked.
    """
    x = MARGIN
    y = paper[1] - MARGIN
    _draw_line(axes, [x, x + RULER], [y, y])
    for centimetre in range(int(RULER) // 10 + 1):
        mark_x = x + 10.0 * centimetre
        # each fifth mark is longer
        mark_length = 4.0 if centimetre % 5 == 0 else 2.5
        _draw_line(axes, [mark_x, mark_x], [y, y - mark_length])
    axes.text(x + RULER + 3.0, y, f"{RULER:g} mm", fontsize=7, va="bottom")


def _draw_part(axes: Axes, part: PlacedPart, convert: Any) -> None:
    """Draw a part on its page: picture with bleed, cut marks, outline and name.

    Args:
        axes: axes of the page, in millimetres.
        part: the part with its position.
        convert: converts colours from sRGB to those of the printer; None leaves them.
    """
    piece = part.piece
    # `trim` are the edges of the part without its bleed, `outer` those with it
    trim_x, trim_y = _find_trim_edges(part)
    outer_x = _add_bleed(trim_x, piece.bleed[0] * piece.pixel_size_mm[0])
    outer_y = _add_bleed(trim_y, piece.bleed[1] * piece.pixel_size_mm[1])
    axes.imshow(
        _cut_out_with_bleed(part, convert),
        # left, right, bottom, top: y grows downwards on the page
        extent=(outer_x[0], outer_x[1], outer_y[1], outer_y[0]),
        interpolation="none",
        aspect="auto",
    )
    _draw_cut_marks(axes, trim_x, trim_y, outer_x, outer_y)
    if piece.cut_mask is not None:
        x0, x1, y0, y1 = part.pixel_bounds
        _draw_cut_line(axes, part, piece.cut_mask[y0:y1, x0:x1])
    axes.text(part.x, outer_y[0] - MARK_GAP, part.name, fontsize=6, va="bottom")


Edges = tuple[float, float]  # left and right, or top and bottom, in millimetres


def _find_trim_edges(part: PlacedPart) -> tuple[Edges, Edges]:
    """Return left and right, and top and bottom edge of a part without its bleed."""
    x0, x1, y0, y1 = part.pixel_bounds
    pixel_width, pixel_height = part.piece.pixel_size_mm
    x_edges = (part.x, part.x + (x1 - x0) * pixel_width)
    y_edges = (part.y, part.y + (y1 - y0) * pixel_height)
    return x_edges, y_edges


def _add_bleed(edges: Edges, bleed: float) -> Edges:
    """Return two edges, each moved outwards by the width of the bleed."""
    first, last = edges
    return first - bleed, last + bleed


def _cut_out_with_bleed(part: PlacedPart, convert: Any) -> Bytes:
    """Return the picture of a part with the bleed around it, (h, w, 3) uint8.

    Args:
        part: the part.
        convert: converts colours from sRGB to those of the printer; None leaves them.
    """
    x0, x1, y0, y1 = part.pixel_bounds
    bleed_x, bleed_y = part.piece.bleed
    picture = part.piece.picture[
        y0 - bleed_y : y1 + bleed_y, x0 - bleed_x : x1 + bleed_x
    ]
    if convert is not None:
        return np.asarray(ImageCms.applyTransform(Image.fromarray(picture), convert))
    return picture


def _draw_cut_marks(
    axes: Axes,
    trim_x: tuple[float, float],
    trim_y: tuple[float, float],
    outer_x: tuple[float, float],
    outer_y: tuple[float, float],
) -> None:
    """Draw two short lines at each corner that show where to cut.

    They stand outside of the bleed, in line with the edges of the trimmed part. Each
    argument is a pair of edges in millimetres: left and right, or top and bottom.

    Args:
        axes: axes of the page.
        trim_x: left and right edge of the trimmed part.
        trim_y: its top and bottom edge.
        outer_x: left and right edge with bleed.
        outer_y: top and bottom edge with bleed.
    """
    outwards = (-1.0, 1.0)  # direction away from the part at its first and last edge
    for x, edge_x, sign_x in zip(trim_x, outer_x, outwards, strict=True):
        for y, edge_y, sign_y in zip(trim_y, outer_y, outwards, strict=True):
            _draw_line(axes, _find_mark_ends(edge_x, sign_x), [y, y])
            _draw_line(axes, [x, x], _find_mark_ends(edge_y, sign_y))


def _find_mark_ends(edge: float, sign: float) -> list[float]:
    """Return the begin and the end of a cut mark in millimetres, along one axis.

    Args:
        edge: the edge with bleed, from which it leads away.
        sign: its direction, 1 or -1.
    """
    return [edge + sign * MARK_GAP, edge + sign * (MARK_GAP + MARK_LENGTH)]


def _draw_cut_line(axes: Axes, part: PlacedPart, inside: Mask) -> None:
    """Draw the outline along which a part is cut out.

    Args:
        axes: axes of the page, in millimetres.
        part: the part with its position.
        inside: (rows, columns) of the part without bleed: whether each pixel belongs to
            what is cut out.
    """
    n_rows, n_columns = inside.shape
    pixel_width, pixel_height = part.piece.pixel_size_mm
    # A border of zeros, one pixel wide, closes the outline at the edges of the part.
    padded = np.pad(inside.astype(float), 1)
    # the centre of each pixel, in millimetres
    xs = part.x + (np.arange(-1, n_columns + 1) + 0.5) * pixel_width
    ys = part.y + (np.arange(-1, n_rows + 1) + 0.5) * pixel_height
    axes.contour(xs, ys, padded, levels=[0.5], colors="black", linewidths=0.3)
