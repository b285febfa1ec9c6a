"""The frame of every page: head, policy, style and script, such that it needs nothing from elsewhere."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Sequence
from functools import cache
from importlib import resources

from advsearch import __version__
from advsearch.report.markup import Html, element, join_html
from advsearch.report.style import CSS


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
