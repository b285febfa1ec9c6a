"""HTML that is escaped by construction: text becomes markup only through `element`.

And results as a notebook shows them (what is said, pictures or a figure, and tables, without styles), and charts that
stand inline in a page; their colours come from its style sheet, so that they follow its scheme.
"""

from __future__ import annotations

import base64
import re
from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from advsearch.errors import InputError
from advsearch.report.figures import BLUE, GREY, RED, Figures, drawn, figure_of, new_axes
from advsearch.report.shown import ResultPart, ShownResult, shown
from advsearch.runs.images import png_bytes
from advsearch.runs.results import Result

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_VOID = frozenset({"meta", "img", "br", "hr", "input", "link"})


class Html(str):
    """Markup that is safe to put into a page as it is."""

    __slots__ = ()


def element(tag: str, *children: str | None, **attributes: str | float) -> Html:
    """Return one element. Children that are not `Html` are escaped; None is left out. Of attributes ``class_`` is
    ``class``, and other underscores become hyphens."""
    names = {"class_": "class", "viewBox": "viewBox"}
    given = "".join(
        f' {names.get(name, name.replace("_", "-"))}="{escape(str(value), quote=True)}"'
        for name, value in attributes.items()
    )
    if tag in _VOID:
        return Html(f"<{tag}{given}>")
    return Html(f"<{tag}{given}>{join_html(*children)}</{tag}>")


def join_html(*parts: str | None) -> Html:
    """Return the parts one after the other, escaped where they are not `Html`."""
    return Html("".join(part if isinstance(part, Html) else escape(part) for part in parts if part is not None))


SHOWN = 224  # Width of a picture on the page, in pixels
GAP = 4  # White between pictures, in pixels
PIXELS = 94  # Of a chart's height, to an inch of the figure
WIDTH = 6.2  # Of a figure, in inches


class InNotebook:
    """What a notebook shows of a result: what its question says of it, as HTML and as a figure; and its table."""

    tabular: ClassVar[str] = "table"
    """The field that is its table."""

    def plot(self, axes: Any = None) -> Any:
        """Draw the figure of the result and return the matplotlib axes; nothing is drawn where it has none.

        Args:
            axes: to draw on; None makes new ones.
        """
        axes = new_axes() if axes is None else axes
        if part := drawn_part(_shown(self)):
            part.draw(axes)  # type: ignore[misc]
        return axes

    def to_pandas(self) -> Any:
        """Return the rows of its table as a `pandas.DataFrame`; columns are called as in `summary.json`.

        Raises:
            InputError: it has no table.
        """
        rows = getattr(self, self.tabular, None)
        if rows is None:
            raise InputError(f"to_pandas: the result of {getattr(self, 'command', '')} has no table")
        from pandas import json_normalize  # takes half a second

        return json_normalize([row.to_dict() for row in rows])

    def _repr_html_(self) -> str:
        return result_html(_shown(self))

    def _repr_png_(self) -> bytes | None:
        return result_figure(_shown(self)).get("png")


def _shown(result: object) -> ShownResult:
    assert isinstance(result, Result)
    return shown(result)


def result_html(given: ShownResult, pictures: Mapping[str, ArrayLike] | None = None) -> str:
    """Return a result as a cell of a notebook, with pictures (H, W, 3), sRGB in [0, 1]."""
    figures = []
    for name, image in (pictures or {}).items():
        inside = _picture(png_bytes(image), SHOWN, name), element("figcaption", name)
        figures.append(element("figure", *inside, style="display:inline-block"))
    figure = result_figure(given)
    chart = _picture(figure["png"], 2 * SHOWN, "the numbers of the table") if figure else None
    parts = [_part(part) for part in given.sections if part.only in ("", "notebook") and not part.empty]
    return element("div", element("p", given.said), *figures, chart, *parts)


def drawn_part(given: ShownResult) -> ResultPart | None:
    """Return the first part of a result that is drawn."""
    return next((part for part in given.sections if part.draw is not None), None)


def result_figure(given: ShownResult) -> Figures:
    """Return the figure of a result as files; none where nothing of it is drawn."""
    part = drawn_part(given)
    if part is None or part.draw is None:
        return {}
    return figure_of(part.draw, part.size or (WIDTH, part.height / PIXELS))


def side_by_side(pictures: Sequence[ArrayLike]) -> bytes:
    """Return pictures (H, W, 3) sRGB in [0, 1] beside each other as a PNG."""
    arrays = [np.asarray(picture, dtype=np.float32) for picture in pictures]
    gap = np.ones((len(arrays[0]), GAP, 3), np.float32)
    return png_bytes(np.concatenate([part for array in arrays for part in (array, gap)][:-1], axis=1))


def _part(part: ResultPart) -> Html:
    head = element("thead", element("tr", *(element("th", cell) for cell in part.heads))) if part.heads else None
    body = (element("tr", *(element("td", cell) for cell in row)) for row in part.rows)
    texts = [element("p", text) for text in part.text if text and part.draw is None]
    table = element("table", head, element("tbody", *body)) if part.rows else None
    if part.folded:
        return element("details", element("summary", part.title), *texts, table)
    return element("div", element("p", element("b", part.title)) if part.title else None, *texts, table)


def _picture(png: bytes, width: int, alt: str) -> Html:
    return element("img", src=f"data:image/png;base64,{base64.b64encode(png).decode()}", width=width, alt=alt)


HEIGHT = 300
WIDE, NARROW = 720, 350
"""Height and widths of a chart in CSS pixels: for a screen, and for a phone, which would shrink the letters of the wide
one until nobody can read them. The style sheet shows one of them.
"""
COLORS = {"search": "#010101", "baseline": "#020202", "soft": "#030303", "line": "#040404"}
"""Variables of the style sheet, and what stands for them while matplotlib draws."""
OF_FIGURES = {"search": BLUE, "baseline": RED, "soft": GREY}  # The same of the colours that figures have
STYLE: dict[Any, Any] = {
    "font.size": 13.0, "path.simplify": False,
    "legend.fontsize": 13.0, "legend.labelcolor": "linecolor", "legend.borderpad": 0.0, "legend.handlelength": 1.6,
    "axes.spines.left": False, "axes.grid.axis": "y", "axes.grid": True,
    **dict.fromkeys(("axes.edgecolor", "grid.color", "xtick.color", "ytick.color"), COLORS["line"]),
    **dict.fromkeys(("axes.labelcolor", "text.color", "xtick.labelcolor", "ytick.labelcolor"), COLORS["soft"]),
    **dict.fromkeys(("xtick.major.size", "ytick.major.size"), 0.0),
    **dict.fromkeys(("figure.facecolor", "axes.facecolor", "savefig.facecolor"), "none"),
}  # fmt: skip


def study_chart(draw: Callable[[Axes], object], words: str, width: int = WIDE, height: int = HEIGHT) -> Html:
    """Return what `draw` draws on axes, without its title and with the page's legend. The words say what it shows to
    who does not see it; width and height are in CSS pixels."""

    def on_figure(figure: Figure) -> None:
        axes = figure.subplots()
        draw(axes)
        axes.set_title("")
        for legend in (*figure.legends, *filter(None, [axes.get_legend()])):
            legend.remove()
        columns = 1 if width == NARROW else 2
        figure.legend(loc="outside upper left", ncols=columns, labelcolor=COLORS["soft"])

    (file,) = drawn(on_figure, (width / 72, height / 72), ("svg",), STYLE).values()
    return element(
        "svg",
        element("title", words),
        _inline(file.decode("utf-8"), f"{width}-"),
        viewBox=f"0 0 {width} {height}",
        class_="chart wide" if width == WIDE else "chart narrow",
        role="img",
        aria_label=words,
    )


def _inline(file: str, prefix: str) -> Html:
    """Return what a file in SVG draws: without its head, hundredths of a pixel, names and frames to cut at.

    All that is drawn lies in the frame. Names that are pointed at, those of markers, stay, behind the prefix: a page of
    two charts would have them twice.
    """
    shapes = file[file.index("<g ") : file.rindex("</svg>")]
    needless = r'<clipPath.*?</clipPath>|<!--.*?-->| clip-path="[^"]*"|(?<=\d\.\d)\d+(?=[^<>]*>)'
    shapes = re.sub(needless, "", shapes, flags=re.DOTALL)
    pointed = set(re.findall(r'href="#([^"]+)"', shapes))
    shapes = re.sub(r' id="([^"]*)"', lambda one: f' id="{prefix}{one[1]}"' if one[1] in pointed else "", shapes)
    shapes = re.sub(r'href="#', f'href="#{prefix}', shapes)
    shapes = re.sub(r"<defs>\s*</defs>", "", shapes)
    for name, color in (*COLORS.items(), *OF_FIGURES.items()):
        shapes = shapes.replace(color, f"var(--{name})")
    return Html(shapes)
