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
from advsearch.report.shown import Html, element, join_html
from advsearch.runs import files, listing, store
from advsearch.runs.directory import PARTS, REPORT
from advsearch.runs.results import plain
from advsearch.viewer.document import data_script, data_url, document, in_address, scrolled
from advsearch.viewer.thumbnails import thumbnail


def list_page(runs: Mapping[str, Path]) -> str:
    """Return the page that lists runs, by the name under which each is shown; the newest first."""
    listed = [(name, listing.listed_run(path, counts=False)) for name, path in runs.items()]
    listed.sort(key=lambda named: named[1].when or 0.0, reverse=True)
    several = sum(run.command == "sweep" for _, run in listed) > 1
    heads = [*(["side by side"] if several else []), "picture", "run", "what came out", "begun"]
    lines = list[Html]()
    for name, run in listed:
        place, sweep = f"runs/{in_address(name)}/", run.command == "sweep"
        box = element("input", type="checkbox", name="run", value=name, aria_label=f"compare {name}") if sweep else None
        picture = element("img", src=f"{place}cover", alt="", loading="lazy", width="72", height="72")
        linked = element("a", None if run.fault else picture, href=place, tabindex="-1", aria_hidden="true")
        about = ", ".join(filter(None, (run.command, wording.short_names(run.object), " and ".join(run.controls))))
        photos = element("a", "photographs", href=f"{place}align/", aria_label=f"photographs of {name}")
        beside = join_html(" ", photos) if run.command in ("attack", "sweep") else None
        came_out = join_html(run.state, f": {run.answer}" if run.answer else None)
        fault = element("div", run.fault, class_="remarks") if run.fault else None
        begun = "" if run.when is None else time.strftime("%Y-%m-%d %H:%M", time.localtime(run.when))
        cells = [element("td", box)] if several else []
        cells += [
            element("td", linked),
            element("th", element("a", name, href=place), element("div", about, beside, class_="soft"), scope="row"),
            element("td", came_out, fault),
            element("td", begun, class_="number"),
        ]
        lines.append(element("tr", *cells))
    head = element("tr", *(element("th", text, scope="col") for text in heads))
    made = element("table", element("thead", head), element("tbody", *lines), class_="runs")
    button = element("p", element("button", "Show the chosen sweeps side by side", type="submit"))
    form = element("form", scrolled(made), button if several else None, action="compare/")
    none = element("p", "No runs here yet: advsearch sweep, or advsearch attack, makes one.")
    title = element("header", element("h1", "Runs"))
    return document("Runs", title, element("main", form if listed else none), connects=True)


MOST_ROWS = 2000  # evaluations that are sent at once; the page asks for the rest
START = 0  # where a page begins: the last row that it has


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
    parts = []
    for path in (path for path in sorted((run / PARTS).glob("*")) if path.is_dir()):  # attacks of a study
        page = element("a", path.name, href=f"{PARTS}/{in_address(path.name)}/{REPORT}")
        parts.append(element("li", page if (path / REPORT).is_file() else path.name))
    header = element("header", element("p", what, class_="eyebrow"), element("h1", f"{name} has not ended"))
    main = element(
        "main",
        element("p", f"{state} Evaluations so far: {kept}.", id="state"),
        element("div", id="follow"),
        element("div", element("h2", "Its attacks"), element("ul", *parts)) if parts else None,
    )
    data, scripts = [data_script({"progress": "progress", "start": START}, "run")], ["make.js", "follow.js"]
    return document(name, header, main, data=data, scripts=scripts, connects=True, footer=f"run {name}")


def progress_json(run: Path, after: int) -> bytes:
    """Return what is new in a run as JSON, after what `next` was in the answer before, or `START`. Raises
    FileFormatError where what it keeps is damaged."""
    running, ended = files.is_held(run), not is_under_way(run)  # before what it has: what comes later is asked for
    last, rows, pictures = after, list[dict[str, object]](), list[dict[str, object]]()
    if (run / store.NAME).is_file():
        with store.Store(run / store.NAME, read_only=True) as results:
            for row in islice(results.rows(after=after), MOST_ROWS):
                values = {name: [value["value"], value["unit"]] for name, value in row.values.items()}
                told = {name: getattr(row, name) for name in ("kind", "step", "objective", "success", "label")}
                rows.append({**told, "values": values})
                last = row.id or after
            for number, picture in results.pictures("search", after, last):
                small = data_url(thumbnail(picture.astype("float32") / 255.0), "image/jpeg")
                pictures.append({"step": number, "picture": small})
    news = {"rows": rows, "pictures": pictures, "next": last, "running": running, "ended": ended}
    return json.dumps(plain(news), allow_nan=False).encode()
