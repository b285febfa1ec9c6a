"""Pages that only the dashboard has: the list of its runs, and a run that goes on or was stopped.

Of such a run: how far it is, its search as a curve and step by step.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from itertools import islice
from pathlib import Path

from advsearch.report import wording
from advsearch.report.markup import Html, element, join_html
from advsearch.runs import files, listing, store
from advsearch.runs.directory import PARTS, REPORT
from advsearch.runs.listing import Listed
from advsearch.runs.results import plain
from advsearch.runs.store import Row
from advsearch.viewer.document import data_script, data_url, document, in_address, scrolled
from advsearch.viewer.thumbnails import thumbnail


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
    place, sweep = f"runs/{in_address(name)}/", one.command == "sweep"
    box = element("input", type="checkbox", name="run", value=name, aria_label=f"compare {name}") if sweep else None
    picture = (
        element("img", src=f"{place}cover", alt="", loading="lazy", width="72", height="72") if not one.fault else None
    )
    about = ", ".join(filter(None, (one.command, wording.short_names(one.object), " and ".join(one.controls))))
    photos = element("a", "photographs", href=f"{place}align/", aria_label=f"photographs of {name}")
    beside = join_html(" ", photos) if one.command in ("attack", "sweep") else None
    begun = "" if one.when is None else time.strftime("%Y-%m-%d %H:%M", time.localtime(one.when))
    return element(
        "tr",
        element("td", box) if comparable else None,
        element("td", element("a", picture, href=place, tabindex="-1", aria_hidden="true")),
        element("th", element("a", name, href=place), element("div", about, beside, class_="soft"), scope="row"),
        element("td", join_html(one.state, f": {one.answer}" if one.answer else None), _fault(one)),
        element("td", begun, class_="number"),
    )


def _fault(one: Listed) -> Html | None:
    return element("div", one.fault, class_="remarks") if one.fault else None


MOST_ROWS = 2000
"""Evaluations that are sent at once; the page asks for the rest."""

START = 0
"""Where a page begins: the last row that it has."""


def is_under_way(run: Path) -> bool:
    """Whether a run has no page that says what came out: none at all, or one of an attack that is being resumed."""
    return not (run / REPORT).is_file() or (files.is_held(run) and listing.can_resume(run))


def following_page(name: str, run: Path) -> str:
    """Return the page that follows a run, by its name in the dashboard. Without its script it says how far it is."""
    one = listing.listed_run(run)
    what = ", ".join(filter(None, (one.command, one.object, " and ".join(one.controls))))
    state = (
        "A process is working on it." if one.state == "running" else f"It was stopped: advsearch resume {name} goes on."
    )
    kept = ", ".join(f"{count} of {kind}" for kind, count in one.kinds.items()) or "none"
    header = element("header", element("p", what, class_="eyebrow"), element("h1", f"{name} has not ended"))
    main = element(
        "main",
        element("p", f"{state} Evaluations so far: {kept}.", id="state"),
        element("div", id="follow"),
        _parts(run),
    )
    data = [data_script({"progress": "progress", "start": START}, "run")]
    return document(
        name, header, main, data=data, scripts=["make.js", "follow.js"], connects=True, footer=f"run {name}"
    )


def progress_json(run: Path, after: int) -> bytes:
    """Return what is new in a run as JSON, after what `next` was in the answer before, or `START`. Raises
    FileFormatError where what it keeps is damaged."""
    last = after
    running, ended = (
        files.is_held(run),
        not is_under_way(run),
    )  # before what it has is read: what comes later is asked for
    rows: list[Row] = []
    pictures: list[dict[str, object]] = []
    if (run / store.NAME).is_file():
        with store.Store(run / store.NAME, read_only=True) as results:
            rows = list(islice(results.rows(after=after), MOST_ROWS))
            last = (rows[-1].id or after) if rows else after
            for number, picture in results.pictures("search", after, last):
                small = data_url(thumbnail(picture.astype("float32") / 255.0), "image/jpeg")
                pictures.append({"step": number, "picture": small})
    news: dict[str, object] = {
        "rows": [_told(one) for one in rows],
        "pictures": pictures,
        "next": last,
        "running": running,
        "ended": ended,
    }
    return json.dumps(plain(news), allow_nan=False).encode()


def _told(row: Row) -> dict[str, object]:
    values = {name: [value["value"], value["unit"]] for name, value in row.values.items()}
    found = {"kind": row.kind, "step": row.step, "objective": row.objective, "success": row.success, "label": row.label}
    return {**found, "values": values}


def _parts(run: Path) -> Html | None:
    """The attacks of a study that have ended, each with its page."""
    names = [path.name for path in sorted((run / PARTS).glob("*")) if path.is_dir()]
    if not names:
        return None
    lines = []
    for name in names:
        done = (run / PARTS / name / REPORT).is_file()
        lines.append(element("li", element("a", name, href=f"{PARTS}/{in_address(name)}/{REPORT}") if done else name))
    return element("div", element("h2", "Its attacks"), element("ul", *lines))
