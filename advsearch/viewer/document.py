"""The frame of every page, such that it needs nothing from elsewhere, and what pages have in common.

Its style sheet is light and dark, from a phone to a wide screen, and on paper.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import resources
from pathlib import Path
from urllib.parse import quote

from advsearch import __version__
from advsearch.files import MESHES
from advsearch.report import wording
from advsearch.report.markup import Html, element, join_html
from advsearch.runs.directory import PARTS, REPORT

CSS = """
:root { color-scheme: light dark; --paper: #fcfcfb; --card: #ffffff; --ink: #1c1d20; --soft: #5c606a; --line: #dfe0e3;
  --search: #1d5fd0; --baseline: #b4540a; --clean: #1f7a45; --track: #e6e7ea; --warn: #8a5300; --warn-paper: #fdf4e3; }
@media screen and (prefers-color-scheme: dark) { :root { --paper: #15171b; --card: #1d2025; --ink: #e8e9ec;
  --soft: #a3a8b3; --line: #363a42; --search: #7aaaf8; --baseline: #f0a35e; --clean: #6cc792; --track: #353942;
  --warn: #f2c879; --warn-paper: #2e2718; } }
* { box-sizing: border-box; }
html { -webkit-text-size-adjust: 100%; }
body { margin: 0; background: var(--paper); color: var(--ink); 
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
header, main, footer { max-width: 62rem; margin: 0 auto; padding: 0 1.25rem; }
header { padding-top: 2.5rem; }
h1 { font-size: clamp(1.4rem, 1.05rem + 1.7vw, 2.1rem); line-height: 1.25; font-weight: 650; letter-spacing: -0.012em;
  margin: 0.3rem 0 0.9rem; max-width: 46rem; text-wrap: balance; }
h2 { font-size: 1.15rem; margin: 2.6rem 0 0.8rem; font-weight: 650; }
p { margin: 0.5rem 0; max-width: 46rem; }
.eyebrow, .soft, figcaption, .note { color: var(--soft); }
.eyebrow { font-size: 0.9rem; margin: 0; }
.remarks { list-style: none; margin: 1rem 0 0; padding: 0.6rem 0.9rem; border-left: 3px solid var(--warn);
  background: var(--warn-paper); max-width: 46rem; }
.remarks li + li, .notes li + li { margin-top: 0.35rem; }
.notes { list-style: none; margin: 0.8rem 0 0; padding: 0; max-width: 46rem; color: var(--soft); font-size: 0.92rem; }
header .remarks li, header .notes li, .eyebrow { overflow-wrap: anywhere; }
.pictures { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(14rem, 44%), 1fr)); gap: 1.25rem 1rem; }
.pictures.pair { max-width: 40rem; }
.pictures.rows { grid-template-columns: 1fr; }
.pictures.single { max-width: 24rem; }
.pictures.large { grid-template-columns: repeat(auto-fit, minmax(min(22rem, 100%), 1fr)); }
.pictures.small { grid-template-columns: repeat(auto-fill, minmax(7rem, 1fr)); gap: 0.6rem; }
figure { margin: 0; }
figure img { display: block; width: 100%; height: auto; border-radius: 4px; background: var(--track); }
figcaption { font-size: 0.92rem; margin-top: 0.45rem; overflow-wrap: anywhere; }
figcaption strong { color: var(--ink); font-weight: 600; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
th, td { text-align: left; padding: 0.5rem 1rem 0.5rem 0; border-bottom: 1px solid var(--line);
  vertical-align: middle; }
thead th { font-size: 0.85rem; font-weight: 500; color: var(--soft); white-space: nowrap; }
tbody th { font-weight: 500; }
td.number { white-space: nowrap; }
.facts { max-width: 46rem; }
.facts th { color: var(--soft); font-weight: 400; width: 11rem; vertical-align: top; }
.facts td { overflow-wrap: anywhere; }
.interval { position: relative; height: 12px; min-width: 7rem; max-width: 16rem;
  background: linear-gradient(var(--track), var(--track)) 0 50% / 100% 2px no-repeat; }
.interval span { position: absolute; } .interval .range { top: 3px; height: 6px; min-width: 1px; border-radius: 1px;
  background: var(--soft); opacity: 0.55; }
.interval .mark { top: 0; height: 12px; width: 2px; margin-left: -1px; background: var(--ink); }
svg.chart { display: block; width: 100%; height: auto; } svg.narrow { display: none; }
svg.chart text { font-family: inherit !important; }
details { margin-top: 1.2rem; }
summary { cursor: pointer; font-weight: 500; }
details > :not(summary) { margin-top: 0.8rem; }
pre { background: var(--card); border: 1px solid var(--line); border-radius: 4px; padding: 0.75rem 0.9rem;
  overflow-x: auto;
  font: 0.86rem/1.5 ui-monospace, SFMono-Regular, Menlo, Consolas, "DejaVu Sans Mono", monospace; margin: 0.5rem 0; }
pre.wrap { white-space: pre-wrap; overflow-wrap: anywhere; }
footer { margin-top: 3rem; padding-top: 1rem; padding-bottom: 2.5rem; font-size: 0.88rem; color: var(--soft); }
.scroll.wide img { min-width: 27rem; }
@media (max-width: 34rem) { .facts th { width: 7.5rem; } .hide-small, svg.wide { display: none; }
  svg.narrow { display: block; } .scroll th, .scroll td { padding-right: 0.5rem; font-size: 0.88rem; }
  .scroll thead th { white-space: normal; } }
@media print { :root { color-scheme: light; } body { background: none; } .scroll { overflow: visible; }
  h2 { break-after: avoid; } figure, table { break-inside: avoid; } }
"""


MOST_NOTES = 3
"""Notes on files that are not folded."""

_OF_A_FILE = re.compile(
    rf"[^:]{{1,200}}\.({'|'.join(one[1:] for one in (*MESHES, '.hdr', '.exr', '.xml'))})[: ]|The clean scene has ",
    re.IGNORECASE,
)
"""How what is said of the reading of a file begins, and of a value that a control leaves out."""

LONG = 32
"""Letters of a cell above which its text is broken into lines."""


def document(
    title: str,
    *body: Html | None,
    data: Sequence[Html] = (),
    scripts: Sequence[str] = (),
    connects: bool = False,
    footer: str = "",
) -> str:
    """Return a page as HTML.

    Args:
        title: of the window.
        body: what stands in it, before the footer.
        data: scripts that hold what the script reads.
        scripts: files of the viewer that run in it, one after the other.
        connects: whether it asks its server for rows and pictures; else it cannot ask anybody.
        footer: a sentence at its end.
    """
    code = "\n".join(map(asset, scripts))
    images, connect = ("data: 'self'", "; connect-src 'self'") if connects else ("data:", "")
    runs = f"; script-src '{_digest(code)}'" if code else ""
    policy = f"default-src 'none'; img-src {images}; style-src 'unsafe-inline'{runs}{connect}"
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", http_equiv="Content-Security-Policy", content=policy + "; base-uri 'none'; form-action 'self'"),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", name="color-scheme", content="light dark"),
        element("title", f"{title} - advsearch"),
        element("link", rel="icon", href="data:,"),
        element("style", Html(CSS + asset("viewer.css"))),
    )
    end = element("footer", f"advsearch {__version__}, {footer or title}")
    shown = Html(re.sub(r"(\d) %", r"\1&nbsp;%", join_html(*body, end)) + join_html(*data))
    page = element("html", head, element("body", shown, element("script", Html(code)) if code else None), lang="en")
    return f"<!doctype html>\n{page}\n"


def data_script(value: object, name: str) -> Html:
    """Return JSON that a script finds by its `id`, whatever its texts are."""
    text = json.dumps(value).replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
    return element("script", Html(text), type="application/json", id=name)


def data_url(data: bytes, kind: str) -> str:
    """Return bytes as an address that needs no file; `kind` is a media type."""
    return f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"


def scrolled(inside: Html | None, css: str = "") -> Html:
    """Return what scrolls sideways where it is too wide, by keys too."""
    return element("div", inside, class_=f"scroll {css}".strip(), tabindex="0")


@cache
def asset(name: str) -> str:
    """Return a file of the viewer."""
    return (resources.files("advsearch.viewer") / "static" / name).read_text(encoding="utf-8")


def _digest(script: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()


# ---- what pages have in common ---------------------------------------------------------------------------------------


def heading(eyebrow: Html | str, text: str, remarks: Sequence[str]) -> Html:
    """Return the header of a page: what was asked, the answer, and what has to be known beside it."""
    return element("header", element("p", eyebrow, class_="eyebrow"), element("h1", text), remarks_html(remarks))


def remarks_html(remarks: Sequence[str]) -> Html:
    """Return what has to be known beside an answer, and below it, folded where it is much, how files were read."""
    notes = [one for one in remarks if _OF_A_FILE.match(one)]
    listed, noted = (
        element("ul", *(element("li", one) for one in lines), class_=css) if lines else None
        for lines, css in (([one for one in remarks if one not in notes], "remarks"), (notes, "notes"))
    )
    if len(notes) > MOST_NOTES:
        noted = element("details", element("summary", f"{len(notes)} notes on how files were read"), noted)
    return join_html(listed, noted)


def subject_html(*parts: tuple[str, str]) -> Html:
    """Return what a run is about: kinds with their names, the paths among which are short, and whole on hover."""
    shown = (
        join_html(f"{kind} " if kind else "", element("span", wording.short_names(text), title=text))
        for kind, text in parts
    )
    return join_html(*(join_html(", " if number else "", one) for number, one in enumerate(shown)))


def facts_table(facts: Mapping[str, str]) -> Html:
    """Return names with their values; those that are empty are left out."""
    lines = [
        element("tr", element("th", name, scope="row"), element("td", value)) for name, value in facts.items() if value
    ]
    return element("table", element("tbody", *lines), class_="facts")


def study_table(
    heads: Sequence[str],
    rows: Sequence[Sequence[str]],
    links: Sequence[str] = (),
    shares: Mapping[tuple[int, int], float] | None = None,
) -> Html:
    """Return a table whose rows begin with their name.

    Args:
        heads: of the columns.
        rows: texts.
        links: of the rows' names; empty ones and those that are missing lead nowhere.
        shares: in [0, 1], by row and column: the larger, the stronger the colour of the cell.
    """
    lines = []
    for number, (first, *cells) in enumerate(rows):
        link = links[number] if number < len(links) else ""
        name = element("a", first, href=link) if link else first
        shown = [_cell(text, (shares or {}).get((number, at))) for at, text in enumerate(cells, 1)]
        lines.append(element("tr", element("th", name, scope="row"), *shown))
    head = element("tr", *(element("th", text, scope="col") for text in heads))
    made = element("table", element("thead", head), element("tbody", *lines))
    return scrolled(made)


def _cell(text: str, share: float | None) -> Html:
    if share is None:
        return element("td", text, class_="number" if len(text) <= LONG else "long")
    return element("td", text, class_=f"number share share-{round(10 * share)}")


def part_links(run: Path, parts: Sequence[str | None]) -> list[str]:
    """Return where the pages of a run's parts are, seen from its own; empty of those that have none."""
    found = []
    for part in parts:
        name = "" if part is None else Path(part).name
        there = name and (run / PARTS / name / REPORT).is_file()
        found.append(f"{PARTS}/{quote(name, safe='')}/{REPORT}" if there else "")
    return found


def again(command_line: str) -> Html:
    """Return the command that asks the same again."""
    return join_html(element("h2", "Do it again"), element("pre", command_line, class_="wrap"))
