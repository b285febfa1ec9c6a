"""The frame of every page, and elements that pages share.

A page needs no other file. Its style sheet supports light and dark mode, small and wide
screens, and print.
"""

from __future__ import annotations

import base64
import json
import os
import re
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import resources
from pathlib import Path
from urllib.parse import quote

from advsearch.files import MESHES
from advsearch.report import wording
from advsearch.report.views import Html, join_html, make_element
from advsearch.runs.directory import PARTS, REPORT
from advsearch.trust import pages
from advsearch.version import __version__

# Maximum number of notes on files that are displayed without folding.
MAX_UNFOLDED_NOTES = 3

_SUFFIXES = "|".join(suffix[1:] for suffix in (*MESHES, ".hdr", ".exr", ".xml"))
_FILE_REMARK = re.compile(
    rf"[^:]{{1,200}}\.({_SUFFIXES})[: ]|The clean scene has ", re.IGNORECASE
)
"""The beginning of remarks on how a file was read, or on a value without a control."""
# Maximum length of a cell whose text is not broken into lines.
MAX_CELL_LENGTH = 32

SCRIPTS = (
    ("sweep.js",),
    ("make.js", "follow.js"),
    ("make.js", "align.js"),
    ("make.js", "attack.js"),
    ("make.js", "attack.js", "object.js"),
)
"""The combinations of scripts that pages contain. The server allows no other scripts.
"""


def make_document(
    title: str,
    *body: Html | None,
    data: Sequence[Html] = (),
    scripts: Sequence[str] = (),
    connects: bool = False,
    footer: str = "",
) -> str:
    """Return a page as HTML.

    Args:
        title: title of the window.
        *body: content of the page.
        data: scripts that hold data (`make_data_script`).
        scripts: names of files that run in the page, in order: one of `SCRIPTS`.
        connects: whether the page may request rows and images from its server;
            otherwise it cannot connect to anything.
        footer: a sentence at the end, by default the title.
    """
    code = _join_scripts(scripts)
    # By the policy of the page, only scripts with these digests run.
    digests = [pages.compute_script_digest(code.encode())] if code else []
    policy = pages.make_page_policy(digests, connects=connects)
    head = _make_head(title, f"{policy}; form-action 'self'")
    footer_html = make_element("footer", f"advsearch {__version__}, {footer or title}")
    # no line break between a number and its percent sign
    text = re.sub(r"(\d) %", r"\1&nbsp;%", join_html(*body, footer_html))
    content = Html(text + join_html(*data))
    script = make_element("script", Html(code)) if code else None
    page = make_element("html", head, make_element("body", content, script), lang="en")
    return f"<!doctype html>\n{page}\n"


def _make_head(title: str, policy: str) -> Html:
    """Return the head of a page: its policy, its title and its style."""
    style = f"\n{read_asset('document.css')}{read_asset('viewer.css')}"
    return make_element(
        "head",
        make_element("meta", charset="utf-8"),
        make_element("meta", http_equiv="Content-Security-Policy", content=policy),
        make_element(
            "meta", name="viewport", content="width=device-width, initial-scale=1"
        ),
        make_element("meta", name="color-scheme", content="light dark"),
        make_element("title", f"{title} - advsearch"),
        # an empty icon, or browsers would ask the server for one
        make_element("link", rel="icon", href="data:,"),
        make_element("style", Html(style)),
    )


def _join_scripts(scripts: Sequence[str]) -> str:
    """Join files of the viewer to one script."""
    if scripts and tuple(scripts) not in SCRIPTS:
        raise ValueError(
            f"scripts: expected one of SCRIPTS, got {tuple(scripts)}; name it there"
        )
    return "\n".join(map(read_asset, scripts))


@cache
def _script_digests() -> frozenset[str]:
    """Return the digests of all scripts that pages of this version have."""
    return frozenset(
        pages.compute_script_digest(_join_scripts(scripts).encode())
        for scripts in SCRIPTS
    )


def has_other_scripts(page: bytes) -> bool:
    """Return whether a page has a script that is none of `SCRIPTS`.

    Such a script, for example that of another version, does not run under the policy of
    `make_security_policy`. Scripts that only hold data do not count.
    """
    return pages.has_other_scripts(page, _script_digests())


def make_security_policy(*, is_trusted: bool) -> str:
    """Return the `Content-Security-Policy` that a server sends: only `SCRIPTS` run."""
    return pages.make_served_policy(_script_digests(), is_generated=is_trusted)


def quote_name(name: str) -> str:
    """Quote the name of a file, which may be no valid text, as a part of a URL."""
    return quote(os.fsencode(name), safe="")


def make_data_script(value: object, name: str) -> Html:
    """Return a value as JSON in a script element, which code finds by its `id`.

    The signs < > & are escaped, so that no text in it can end the element.
    """
    text = (
        json.dumps(value)
        .replace("<", "\\u003c")
        .replace(">", "\\u003e")
        .replace("&", "\\u0026")
    )
    return make_element("script", Html(text), type="application/json", id=name)


def make_data_url(data: bytes, media_type: str) -> str:
    """Return bytes as a data URL, of a media type such as ``image/png``."""
    return f"data:{media_type};base64,{base64.b64encode(data).decode('ascii')}"


def make_scrollable(inside: Html | None, css: str = "") -> Html:
    """Wrap an element so that it scrolls sideways if it is too wide, also by keys."""
    return make_element("div", inside, class_=f"scroll {css}".strip(), tabindex="0")


@cache
def read_asset(name: str) -> str:
    """Read a static file of the viewer."""
    return (resources.files("advsearch.viewer") / "static" / name).read_text(
        encoding="utf-8"
    )


def make_header(eyebrow: Html | str, text: str, remarks: Sequence[str]) -> Html:
    """Return the header of a page.

    Args:
        eyebrow: line above the title with the subject of the page, such as its run.
        text: the title, which states the result.
        remarks: sentences below the title.
    """
    return make_element(
        "header",
        make_element("p", eyebrow, class_="eyebrow"),
        make_element("h1", text),
        remarks_html(remarks),
    )


def remarks_html(remarks: Sequence[str]) -> Html:
    """Return the remarks on a result as two lists.

    The second list has the notes on how files were read. It is folded if it is long.
    """
    notes = [remark for remark in remarks if _FILE_REMARK.match(remark)]
    others = [remark for remark in remarks if remark not in notes]
    notes_html = _list_html(notes, "notes")
    if len(notes) > MAX_UNFOLDED_NOTES:
        summary = make_element("summary", f"{len(notes)} notes on how files were read")
        notes_html = make_element("details", summary, notes_html)
    return join_html(_list_html(others, "remarks"), notes_html)


def _list_html(lines: Sequence[str], css: str) -> Html | None:
    """Return a list, None without lines."""
    if not lines:
        return None
    return make_element("ul", *(make_element("li", line) for line in lines), class_=css)


def make_subject_html(*parts: tuple[str, str]) -> Html:
    """Return the subject of a run as HTML, such as "model resnet50, object mug".

    Args:
        parts: pairs of kind and name, such as ("model", "resnet50"); the kind may be
            "". A path is shortened, and displayed in full when the mouse is over it.
    """
    content = list[Html | str]()
    for index, (kind, text) in enumerate(parts):
        separator = ", " if index else ""
        name = make_element("span", wording.shorten_names(text), title=text)
        content += [separator, f"{kind} " if kind else "", name]
    return join_html(*content)


def facts_table(facts: Mapping[str, str]) -> Html:
    """Return a table of names and values, without those that are empty."""
    lines = [
        make_element(
            "tr", make_element("th", name, scope="row"), make_element("td", value)
        )
        for name, value in facts.items()
        if value
    ]
    return make_element("table", make_element("tbody", *lines), class_="facts")


def make_table(
    heads: Sequence[str],
    rows: Sequence[Sequence[str]],
    links: Sequence[str] = (),
    shares: Mapping[tuple[int, int], float] | None = None,
    bars: Sequence[tuple[float, float, float] | None] = (),
) -> Html:
    """Return a table whose rows begin with their name.

    Args:
        heads: heads of the columns.
        rows: texts of the cells of each row, the name first.
        links: address to which the name of each row links; "" or missing for none.
        shares: for cells that are colored, the fraction in [0, 1] that determines the
            color, by (row, column); the name is column 0.
        bars: interval of each row, drawn in an additional column: (lower end, upper
            end, mark) as fractions of its width; None for no interval.
    """
    lines = []
    for row, texts in enumerate(rows):
        link = links[row] if row < len(links) else ""
        cells = _make_body_cells(row, texts, link, shares or {})
        if bars:
            bar = _interval_bar(bars[row])
            cells.append(make_element("td", bar, class_="hide-small"))
        lines.append(make_element("tr", *cells))
    head = _make_table_head(heads, has_bars=bool(bars))
    return make_scrollable(make_element("table", head, make_element("tbody", *lines)))


def _make_body_cells(
    row: int, texts: Sequence[str], link: str, shares: Mapping[tuple[int, int], float]
) -> list[Html]:
    """Return the cells of a row that begins with its name.

    Args:
        row: index of the row.
        texts: texts of its cells, the name first.
        link: address to which the name links; "" for none.
        shares: fractions that determine the colors of cells, by (row, column).
    """
    name, *other_texts = texts
    linked_name = make_element("a", name, href=link) if link else name
    cells = [make_element("th", linked_name, scope="row")]
    for column, text in enumerate(other_texts, 1):  # the name is column 0
        share = shares.get((row, column))
        cells.append(make_element("td", text, class_=_cell_class(text, share)))
    return cells


def _make_table_head(heads: Sequence[str], *, has_bars: bool) -> Html:
    """Return the head of a table, with an empty cell for a column of bars."""
    bar_head = None
    if has_bars:
        bar_head = make_element("td", class_="hide-small")
    column_heads = (make_element("th", text, scope="col") for text in heads)
    return make_element("thead", make_element("tr", *column_heads, bar_head))


def _cell_class(text: str, share: float | None) -> str:
    """Return the CSS classes of a cell, which may have the color of a fraction."""
    if share is not None:
        # the style sheet has eleven colors, share-0 to share-10
        return f"number share share-{round(10 * share)}"
    return "number" if len(text) <= MAX_CELL_LENGTH else "long"


def _interval_bar(bar: tuple[float, float, float] | None) -> Html | None:
    """Return a bar for an interval in a table cell; None for None.

    Args:
        bar: (lower end, upper end, mark), as fractions of the width.
    """
    if bar is None:
        return None
    lower, upper, mark = bar
    range_html = make_element(
        "span", style=f"left: {lower:.1%}; width: {upper - lower:.1%}", class_="range"
    )
    mark_html = make_element("span", style=f"left: {mark:.1%}", class_="mark")
    return make_element(
        "div", range_html, mark_html, class_="interval", aria_hidden="true"
    )


def link_parts(run: Path, parts: Sequence[str | None]) -> list[str]:
    """Return the addresses of the pages of a run's parts, relative to the run's own
    page; "" for a part without a page.
    """
    links = []
    for part in parts:
        name = "" if part is None else Path(part).name
        has_page = bool(name) and (run / PARTS / name / REPORT).is_file()
        links.append(f"{PARTS}/{quote_name(name)}/{REPORT}" if has_page else "")
    return links
