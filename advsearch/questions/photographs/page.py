"""The page that lays a rendering over the camera's picture, takes a photograph, and counts how the two agree.

After the phone app of 3DB (Leclerc et al. 2021, appendix D): a translucent rendering, or its edges, over the camera.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import Any
from urllib.parse import quote

from advsearch.questions.photographs.answer import PhotoAgreement, PhotographedRendering
from advsearch.report import wording
from advsearch.report.markup import Html, element, join_html
from advsearch.report.phrases import percent
from advsearch.viewer.document import data_script, document

NO_QR = "pip install segno"
"""What to type where there is nothing to draw a code with."""


def align_page(run: str, renderings: Sequence[str], table: PhotoAgreement, key: str, elsewhere: str | None) -> str:
    """Return the page as HTML.

    Args:
        run: its name.
        renderings: names of the renderings that it kept; the first one is shown.
        table: of the photographs so far.
        key: what the server wants to see with a photograph.
        elsewhere: the address by which another device opens the page; None where none can.
    """
    facts = {"key": key, "names": list(renderings[:1])}
    align = element("div", _hint(renderings), id="align") if renderings else _without()
    main = element(
        "main",
        align,
        element("h2", "Renderings and reality"),
        element("div", table_html(table), id="agreement"),
        _code(elsewhere),
    )
    header = element("header", element("p", "Photographs", class_="eyebrow"), element("h1", f"{run}, photographed"))
    data = [data_script(facts, "photographing")] if renderings else []
    scripts = ("make.js", "align.js") if renderings else ()
    return document(f"{run}, photographs", header, main, data=data, scripts=scripts, connects=True)


def _hint(names: Sequence[str]) -> Html:
    shown = ", ".join(names[:8]) + (f", ... {names[-1]}" if len(names) > 8 else "")
    first = "Lay a rendering over what the camera sees, move the real object until both agree, and take a photograph."
    return join_html(
        element("p", first),
        element("p", f"Renderings of this run ({len(names)}): {shown}.", class_="soft", id="renderings"),
        element("noscript", element("p", "The camera needs JavaScript, which is switched off.")),
    )


def _without() -> Html:
    return element(
        "p",
        "This run kept no pictures to align with. An attack keeps them when it ends; a sweep with ",
        element("code", "keep_pictures=all"),
        ".",
    )


def _code(address: str | None) -> Html | None:
    if address is None:
        return None
    code = qr_svg(address)
    drawn = Html(code) if code else element("p", f"A code to point the phone at would stand here: {NO_QR}")
    return element(
        "details", element("summary", "Open this page on a phone"), element("div", drawn, class_="qr"),
        element("pre", address, class_="wrap", tabindex="0"),
    )  # fmt: skip


def qr_svg(address: str) -> str | None:
    """Return an address as a QR code, an SVG for a page; None where segno is not installed."""
    made = _made(address)
    return (
        None
        if made is None
        else str(made.svg_inline(omitsize=True, light="#fff", title="QR code of the address below"))
    )


def qr_text(address: str) -> str | None:
    """Return an address as a QR code for a terminal; None where segno is not installed."""
    import io

    made, text = _made(address), io.StringIO()
    if made is None:
        return None
    made.terminal(out=text, compact=True)
    return text.getvalue()


def _made(address: str) -> Any:
    try:
        return importlib.import_module("segno").make(address, error="m", micro=False)
    except ImportError:
        return None


# ---- the table ------------------------------------------------------------------------------------------------------


def table_html(table: PhotoAgreement) -> Html:
    """Return the counts of right and wrong answers in rendering and photograph, in all and by rendering."""
    if not table.photos or table.interval is None:
        return element("p", "No photographs yet.", class_="soft")
    heads = ("photographs", "right in the photograph", "wrong in the photograph")
    head = element("tr", *(element("th", text, scope="col") for text in heads))
    rows = [
        _row("right in the rendering", str(table.right_right), str(table.right_wrong)),
        _row("wrong in the rendering", str(table.wrong_right), str(table.wrong_wrong)),
    ]
    agreeing = table.right_right + table.wrong_wrong
    text = (
        f"They agree in {agreeing} of {wording.count(table.photos, 'photograph')}: {percent(table.agreement)}, 95 % "
        f"interval {wording.interval_text(table.interval)}."
    )
    several = len({one.model for one in table.renderings}) > 1
    names = ["rendering", *(["model"] if several else []), "in the rendering", "in photographs", "agree", "interval"]
    each = element(
        "table",
        element("thead", element("tr", *(element("th", text, scope="col") for text in names))),
        element("tbody", *(_rendering(one, several) for one in table.renderings)),
    )
    counts = element("table", element("thead", head), element("tbody", *rows), class_="agreement")
    return join_html(
        counts,
        element("p", text),
        element("div", each, class_="scroll", tabindex="0", role="region", aria_label="by rendering"),
    )


def _row(name: str, *cells: str) -> Html:
    return element("tr", element("th", name, scope="row"), *(element("td", one, class_="number") for one in cells))


def _rendering(one: PhotographedRendering, several: bool) -> Html:
    photos = [
        join_html(element("a", label or "nothing", href=f"photos/{quote(file, safe='')}"), " ")
        for label, file in zip(one.labels, one.files, strict=True)
    ]
    name = element("a", one.rendering, href=f"renderings/{quote(one.rendering, safe='')}")
    return element(
        "tr",
        element("th", name, scope="row"),
        element("td", one.model) if several else None,
        element("td", f"{'right' if one.rendering_right else 'wrong'}: {one.label}"),
        element("td", f"{one.photos_right} of {one.photos} right: ", *photos),
        element("td", f"{one.agreeing} of {one.photos}", class_="number"),
        element("td", wording.interval_text(one.interval), class_="number"),
    )
