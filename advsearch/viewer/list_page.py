"""The page that lists the runs of a server."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from urllib.parse import quote

from advsearch.report import wording
from advsearch.report.markup import Html, element, join_html
from advsearch.runs import listing
from advsearch.runs.listing import Listed
from advsearch.viewer.document import document, scrolled


def list_page(runs: Mapping[str, Path]) -> str:
    """Return the page that lists runs, by the name under which each is shown; the newest first."""
    found = [(name, listing.listed_run(path, counts=False)) for name, path in runs.items()]
    found.sort(key=lambda one: one[1].when or 0.0, reverse=True)
    sweeps = sum(one.command == "sweep" for _, one in found)
    heads = [*(["side by side"] if sweeps > 1 else []), "picture", "run", "what came out", "begun"]
    head = element("tr", *(element("th", text, scope="col") for text in heads))
    lines = (_line(name, one, comparable=sweeps > 1) for name, one in found)
    made = element("table", element("thead", head), element("tbody", *lines), class_="runs")
    button = element("p", element("button", "Show the chosen sweeps side by side", type="submit"))
    form = element("form", scrolled(made), button if sweeps > 1 else None, action="compare/")
    none = element("p", "No runs here yet: advsearch sweep, or advsearch attack, makes one.")
    title = element("header", element("h1", "Runs"))
    return document("Runs", title, element("main", form if found else none), connects=True)


def _line(name: str, one: Listed, *, comparable: bool) -> Html:
    place, sweep = f"runs/{quote(name, safe='')}/", one.command == "sweep"
    box = element("input", type="checkbox", name="run", value=name, aria_label=f"compare {name}") if sweep else None
    picture = element("img", src=f"{place}cover", alt="", loading="lazy", width="72", height="72")
    about = ", ".join(filter(None, (one.command, wording.short_names(one.object), " and ".join(one.controls))))
    photos = element("a", "photographs", href=f"{place}align/", aria_label=f"photographs of {name}")
    beside = join_html(" ", photos) if one.command in ("attack", "sweep") else None
    begun = "" if one.when is None else time.strftime("%Y-%m-%d %H:%M", time.localtime(one.when))
    return element(
        "tr",
        element("td", box) if comparable else None,
        element("td", element("a", picture, href=place, tabindex="-1", aria_hidden="true")),
        element("th", element("a", name, href=place), element("div", about, beside, class_="soft"), scope="row"),
        element("td", join_html(one.state, f": {one.answer}" if one.answer else None)),
        element("td", begun, class_="number"),
    )
