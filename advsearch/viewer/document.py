"""The frame of every page, such that it needs nothing from elsewhere, and what pages
have in common.

Its style sheet is light and dark, from a phone to a wide screen, and on paper.
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
from advsearch.report.views import Html, element, join_html
from advsearch.runs.directory import PARTS, REPORT
from advsearch.trust import pages
from advsearch.version import __version__

MOST_NOTES = 3  # notes on files that are not folded

_OF_A_FILE = re.compile(
    rf"[^:]{{1,200}}\.({'|'.join(one[1:] for one in (*MESHES, '.hdr', '.exr', '.xml'))})[: ]|The clean scene has ",
    re.IGNORECASE,
)
"""How what is said of the reading of a file begins, and of a value that a control
leaves out.
"""
LONG = 32  # letters of a cell above which its text is broken into lines

SCRIPTS = (
    ("sweep.js",),
    ("make.js", "follow.js"),
    ("make.js", "align.js"),
    ("make.js", "attack.js"),
    ("make.js", "attack.js", "object.js"),
)
"""Files of the viewer that run together in a page. There are no other scripts, and the
server allows none.
"""


def document(
    title: str,
    *body: Html | None,
    data: Sequence[Html] = (),
    scripts: Sequence[str] = (),
    connects: bool = False,
    footer: str = "",
) -> str:
    """Return a page as HTML, with a title of the window, what stands in it, before the
    footer, a sentence, scripts that hold `data`, and files of the viewer that run in
    it, one after the other: one of `SCRIPTS`. It `connects` if it asks its server for
    rows and pictures; else it cannot ask anybody.
    """
    code = _code(scripts)
    policy = pages.page_policy(
        [pages.script_digest(code.encode())] if code else [], connects=connects
    )
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element(
            "meta",
            http_equiv="Content-Security-Policy",
            content=f"{policy}; form-action 'self'",
        ),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", name="color-scheme", content="light dark"),
        element("title", f"{title} - advsearch"),
        element("link", rel="icon", href="data:,"),
        element("style", Html(f"\n{asset('document.css')}{asset('viewer.css')}")),
    )
    end = element("footer", f"advsearch {__version__}, {footer or title}")
    shown = Html(
        re.sub(r"(\d) %", r"\1&nbsp;%", join_html(*body, end)) + join_html(*data)
    )
    page = element(
        "html",
        head,
        element("body", shown, element("script", Html(code)) if code else None),
        lang="en",
    )
    return f"<!doctype html>\n{page}\n"


def _code(scripts: Sequence[str]) -> str:
    if scripts and tuple(scripts) not in SCRIPTS:
        raise ValueError(
            f"scripts: expected one of SCRIPTS, got {tuple(scripts)}; name it there"
        )
    return "\n".join(map(asset, scripts))


@cache
def _own_digests() -> frozenset[str]:
    return frozenset(
        pages.script_digest(_code(scripts).encode()) for scripts in SCRIPTS
    )


def has_other_scripts(page: bytes) -> bool:
    """Whether a page has a script that is none of `SCRIPTS`, such as that of another
    version, and so will not run where `served_policy` holds. Scripts that are data do
    not count.
    """
    return pages.has_other_scripts(page, _own_digests())


def served_policy(*, own: bool) -> str:
    """Return the `Content-Security-Policy` that a server sends, under which no script
    runs but those of `SCRIPTS`.
    """
    return pages.served_policy(_own_digests(), own=own)


def in_address(name: str) -> str:
    """Return a name of a file, which may be no text, as a part of an address."""
    return quote(os.fsencode(name), safe="")


def data_script(value: object, name: str) -> Html:
    """Return JSON that a script finds by its `id`, whatever its texts are."""
    text = (
        json.dumps(value)
        .replace("<", "\\u003c")
        .replace(">", "\\u003e")
        .replace("&", "\\u0026")
    )
    return element("script", Html(text), type="application/json", id=name)


def data_url(data: bytes, kind: str) -> str:
    """Return bytes as an address that needs no file; `kind` is a media type."""
    return f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"


def scrolled(inside: Html | None, css: str = "") -> Html:
    """Return what scrolls sideways where it is too wide, by keys too."""
    return element("div", inside, class_=f"scroll {css}".strip(), tabindex="0")


@cache
def asset(name: str) -> str:
    return (resources.files("advsearch.viewer") / "static" / name).read_text(
        encoding="utf-8"
    )


def heading(eyebrow: Html | str, text: str, remarks: Sequence[str]) -> Html:
    """Return the header of a page: what was asked, the result, and what has to be known
    beside it.
    """
    return element(
        "header",
        element("p", eyebrow, class_="eyebrow"),
        element("h1", text),
        remarks_html(remarks),
    )


def remarks_html(remarks: Sequence[str]) -> Html:
    """Return what has to be known beside a result, and below it, folded where it is
    much, how files were read.
    """
    notes = [one for one in remarks if _OF_A_FILE.match(one)]
    listed, noted = (
        element("ul", *(element("li", one) for one in lines), class_=css)
        if lines
        else None
        for lines, css in (
            ([one for one in remarks if one not in notes], "remarks"),
            (notes, "notes"),
        )
    )
    if len(notes) > MOST_NOTES:
        noted = element(
            "details",
            element("summary", f"{len(notes)} notes on how files were read"),
            noted,
        )
    return join_html(listed, noted)


def subject_html(*parts: tuple[str, str]) -> Html:
    """Return what a run is about: kinds with their names, the paths among which are
    short, and whole on hover.
    """
    shown = (
        join_html(
            f"{kind} " if kind else "",
            element("span", wording.short_names(text), title=text),
        )
        for kind, text in parts
    )
    return join_html(
        *(join_html(", " if number else "", one) for number, one in enumerate(shown))
    )


def facts_table(facts: Mapping[str, str]) -> Html:
    """Return names with their values; those that are empty are left out."""
    known = ((name, value) for name, value in facts.items() if value)
    lines = (
        element("tr", element("th", name, scope="row"), element("td", value))
        for name, value in known
    )
    return element("table", element("tbody", *lines), class_="facts")


def study_table(
    heads: Sequence[str],
    rows: Sequence[Sequence[str]],
    links: Sequence[str] = (),
    shares: Mapping[tuple[int, int], float] | None = None,
    bars: Sequence[tuple[float, float, float] | None] = (),
) -> Html:
    """Return a table whose rows begin with their name. Links, of the names, lead
    nowhere where they are empty or missing. Shares and bars as those of `ResultPart`.
    """
    lines = []
    for number, (first, *cells) in enumerate(rows):
        link = links[number] if number < len(links) else ""
        name = element("a", first, href=link) if link else first
        shown = []
        for at, text in enumerate(cells, 1):
            share = (shares or {}).get((number, at))
            css = "number" if len(text) <= LONG else "long"
            css = css if share is None else f"number share share-{round(10 * share)}"
            shown.append(element("td", text, class_=css))
        if bars:
            drawn = None
            if (bar := bars[number]) is not None:
                low, high, mark = bar
                reach = element(
                    "span",
                    style=f"left: {low:.1%}; width: {high - low:.1%}",
                    class_="range",
                )
                marked = element("span", style=f"left: {mark:.1%}", class_="mark")
                drawn = element(
                    "div", reach, marked, class_="interval", aria_hidden="true"
                )
            shown.append(element("td", drawn, class_="hide-small"))
        lines.append(element("tr", element("th", name, scope="row"), *shown))
    beside = element("td", class_="hide-small") if bars else None
    head = element("tr", *(element("th", text, scope="col") for text in heads), beside)
    return scrolled(element("table", element("thead", head), element("tbody", *lines)))


def part_links(run: Path, parts: Sequence[str | None]) -> list[str]:
    """Return where the pages of a run's parts are, seen from its own; empty of those
    that have none.
    """
    names = ["" if part is None else Path(part).name for part in parts]
    there = [name and (run / PARTS / name / REPORT).is_file() for name in names]
    return [
        f"{PARTS}/{in_address(name)}/{REPORT}" if has else ""
        for name, has in zip(names, there, strict=True)
    ]
