"""A run that goes on, or was stopped, in the dashboard: how far it is, its search as a curve and step by step."""

from __future__ import annotations

import json
from itertools import islice
from pathlib import Path
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from advsearch.report.markup import Html, element
from advsearch.runs import listing, lock, store
from advsearch.runs.directory import PARTS, REPORT
from advsearch.runs.results.base import plain
from advsearch.runs.store import Row
from advsearch.viewer.document import data_script, data_url, document
from advsearch.viewer.thumbnails import thumbnail

MOST_ROWS = 2000
"""Evaluations that are sent at once; the page asks for the rest."""

START = 0
"""Where a page begins: the last row that it has."""


def is_under_way(run: Path) -> bool:
    """Whether a run has no page that says what came out: none at all, or one of an attack that is being resumed."""
    return not (run / REPORT).is_file() or (lock.is_held(run) and listing.can_resume(run))


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
    """Return what is new in a run as JSON.

    Args:
        run: its folder.
        after: what `next` was in the answer before, or `START`.

    Raises:
        FileFormatError: what it keeps is damaged.
    """
    last = after
    running, ended = (
        lock.is_held(run),
        not is_under_way(run),
    )  # before what it has is read: what comes later is asked for
    rows: list[Row] = []
    pictures: list[dict[str, object]] = []
    if (run / store.NAME).is_file():
        with store.Store(run / store.NAME, read_only=True) as results:
            rows = list(islice(results.rows(after=after), MOST_ROWS))
            last = (rows[-1].id or after) if rows else after
            pictures = [_shown(*one) for one in results.pictures("search", after, last)]
    answer: dict[str, object] = {
        "rows": [_told(one) for one in rows],
        "pictures": pictures,
        "next": last,
        "running": running,
        "ended": ended,
    }
    return json.dumps(plain(answer), allow_nan=False).encode()


def _told(row: Row) -> dict[str, object]:
    values = {name: [value["value"], value["unit"]] for name, value in row.values.items()}
    found = {"kind": row.kind, "step": row.step, "objective": row.objective, "success": row.success, "label": row.label}
    return {**found, "values": values}


def _shown(number: int, picture: NDArray[np.uint8]) -> dict[str, object]:
    shown = thumbnail(picture.astype("float32") / 255.0)
    return {"step": number, "picture": data_url(shown, "image/jpeg")}


def _parts(run: Path) -> Html | None:
    """The attacks of a study that have ended, each with its page."""
    names = [path.name for path in sorted((run / PARTS).glob("*")) if path.is_dir() and not path.is_symlink()]
    if not names:
        return None
    lines = []
    for name in names:
        done = (run / PARTS / name / REPORT).is_file()
        lines.append(
            element("li", element("a", name, href=f"{PARTS}/{quote(name, safe='')}/{REPORT}") if done else name)
        )
    return element("div", element("h2", "Its attacks"), element("ul", *lines))
