"""HTML that is escaped by construction: text becomes markup only through `element`.

And answers as a notebook shows them: what is said, pictures or a figure, and tables, without styles.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from advsearch.report.figures import Figures, drawn, new_axes
from advsearch.report.shown import AnswerPart, ShownAnswer, shown
from advsearch.runs.images import png_bytes
from advsearch.runs.results.base import Result

_VOID = frozenset({"meta", "img", "br", "hr", "input", "link"})


class Html(str):
    """Markup that is safe to put into a page as it is."""

    __slots__ = ()


def element(tag: str, *children: str | None, **attributes: str | float) -> Html:
    """Return one element. Children that are not `Html` are escaped; None is left out.

    Args:
        tag: the element's name.
        children: what stands in it.
        attributes: by name; ``class_`` is ``class``, and other underscores become hyphens.
    """
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


SHOWN = 224
"""Width of a picture on the page, in pixels."""

GAP = 4
"""White between pictures, in pixels."""

PIXELS = 94
"""Of a chart's height, to an inch of the figure."""

WIDTH = 6.2
"""Of a figure, in inches."""


class InNotebook:
    """What a notebook shows of a result: what its question says of it, as HTML and as a figure."""

    def plot(self, axes: Any = None) -> Any:
        """Draw the figure of the answer and return the matplotlib axes; nothing is drawn where it has none.

        Args:
            axes: to draw on; None makes new ones.
        """
        axes = new_axes() if axes is None else axes
        if part := drawn_part(_shown(self)):
            part.draw(axes)  # type: ignore[misc]
        return axes

    def _repr_html_(self) -> str:
        return answer_html(_shown(self))

    def _repr_png_(self) -> bytes | None:
        return figure_of_answer(_shown(self)).get("png")


def _shown(result: object) -> ShownAnswer:
    assert isinstance(result, Result)
    return shown(result)


def answer_html(given: ShownAnswer, pictures: Mapping[str, ArrayLike] | None = None) -> str:
    """Return an answer as a cell of a notebook.

    Args:
        given: what is shown of it.
        pictures: name to (H, W, 3) sRGB in [0, 1].
    """
    figures = [
        element(
            "figure", _picture(png_bytes(image), SHOWN, name), element("figcaption", name), style="display:inline-block"
        )
        for name, image in (pictures or {}).items()
    ]
    figure = figure_of_answer(given)
    chart = _picture(figure["png"], 2 * SHOWN, "the numbers of the table") if figure else None
    parts = [_part(one) for one in given.sections if one.only in ("", "notebook") and not one.empty]
    return element("div", element("p", given.said), *figures, chart, *parts)


def drawn_part(given: ShownAnswer) -> AnswerPart | None:
    """Return the first part of an answer that is drawn."""
    return next((one for one in given.sections if one.draw is not None), None)


def figure_of_answer(given: ShownAnswer) -> Figures:
    """Return the figure of an answer as files; none where nothing of it is drawn."""
    part = drawn_part(given)
    if part is None or part.draw is None:
        return {}
    draw = part.draw
    return drawn(lambda figure: draw(figure.subplots()), part.size or (WIDTH, part.height / PIXELS))


def side_by_side(pictures: Sequence[ArrayLike]) -> bytes:
    """Return pictures (H, W, 3) sRGB in [0, 1] beside each other as a PNG."""
    arrays = [np.asarray(one, dtype=np.float32) for one in pictures]
    gap = np.ones((len(arrays[0]), GAP, 3), np.float32)
    return png_bytes(np.concatenate([part for one in arrays for part in (one, gap)][:-1], axis=1))


def _part(one: AnswerPart) -> Html:
    """A part of an answer; a folded one has its title as the handle."""
    head = element("thead", element("tr", *(element("th", cell) for cell in one.heads))) if one.heads else None
    body = (element("tr", *(element("td", cell) for cell in row)) for row in one.rows)
    inside = [
        *(element("p", text) for text in one.text if text and one.draw is None),
        element("table", head, element("tbody", *body)) if one.rows else None,
    ]
    if one.folded:
        return element("details", element("summary", one.title), *inside)
    return element("div", element("p", element("b", one.title)) if one.title else None, *inside)


def _picture(png: bytes, width: int, alt: str) -> Html:
    return element("img", src=f"data:image/png;base64,{base64.b64encode(png).decode()}", width=width, alt=alt)
