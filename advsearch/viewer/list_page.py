"""The page that lists the runs of a server."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from urllib.parse import quote

from advsearch.report.markup import element, join
from advsearch.runs import listing
from advsearch.viewer.document import document


def list_page(runs: Mapping[str, Path]) -> str:
    """Return the page that lists runs, by the name under which each is shown."""
    lines, sweeps = [], 0
    for name, path in runs.items():
        one = listing.described(path, counts=False)
        sweep = one.command == "sweep"
        sweeps += sweep
        what = ", ".join(filter(None, (one.command, one.object, " and ".join(one.controls), one.state, one.answer)))
        box = element("input", type="checkbox", name="run", value=name, aria_label=f"compare {name}") if sweep else None
        place = f"/runs/{quote(name, safe='')}/"
        link = element("a", name, href=place)
        photos = element("a", "photographs", href=f"{place}align/", aria_label=f"photographs of {name}")
        beside = join(" ", photos) if one.command in ("attack", "sweep") else None
        lines.append(element("li", box, " " if box else None, link, element("div", what, beside, class_="soft")))
    button = element("p", element("button", "Show the chosen sweeps side by side", type="submit"))
    form = element("form", element("ul", *lines, class_="runs"), button if sweeps > 1 else None, action="/compare/")
    none = element("p", "No runs here yet: advsearch sweep, or advsearch attack, makes one.")
    return document("Runs", element("header", element("h1", "Runs")), element("main", form if lines else none))
