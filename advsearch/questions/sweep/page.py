"""The page of one or several sweeps: still pictures and tables that need no script, and
the explorer over them.

The same page is a file that needs no other (`write_sweep_page`), a page of `advsearch
dashboard`, and one of a folder that any web server serves: only where its rows and
pictures come from differs (`SweepSource`).
"""

from __future__ import annotations

import base64
import gzip
import shlex
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from advsearch.errors import AdvsearchError, InputError
from advsearch.files import JsonObject, JsonValue
from advsearch.questions.sweep import display as sweeps
from advsearch.questions.sweep.summary import SweepSummary
from advsearch.report import wording
from advsearch.report.views import Html, element, join_html
from advsearch.report.views import shown as shown_of
from advsearch.report.wording import beside_text, prediction_text
from advsearch.runs import directory
from advsearch.runs.summary import read_result
from advsearch.settings import read_yaml
from advsearch.trust.writing import (
    check_free_folder,
    placed_by,
    write_bytes,
    write_text,
)
from advsearch.viewer.columns import packed, read_columns
from advsearch.viewer.document import (
    data_script,
    data_url,
    document,
    remarks_html,
    subject_html,
)
from advsearch.viewer.pages import end_html, page_of, part_html
from advsearch.viewer.thumbnails import Kept, kept_pictures, path_of, read_thumbnail

if TYPE_CHECKING:
    import pandas as pd

MOST_EMBEDDED = 3_000_000
"""Bytes of pictures that a page which needs no other file takes along; the worst
predictions first.
"""
# rows that such a page takes along; more are for `advsearch dashboard`
MOST_ROWS = 200_000


@dataclass(frozen=True)
class SweepSource:
    """Where the page of a run, by its name, gets what it shows: rows as columns for a
    page that needs no other file, else the address they are fetched from, in `parts`
    (``?after=ID``) as those of a sweep that goes on; None where they are too many for
    such a page, which then has the tables only. And the thumbnails, and their address;
    None puts them into the page.
    """

    name: str
    rows: pd.DataFrame | str | None
    parts: bool = False
    pictures: Kept | None = None
    folder: str | None = None

    @property
    def embedded(self) -> bool:
        return self.rows is not None and not isinstance(self.rows, str)


def write_sweep_page(run: Path, summary: SweepSummary) -> Path:
    """Write `report.html` of a sweep that has ended, and its rows as columns, into its
    folder; return the page's path. Raises FileFormatError where results are damaged,
    StorageError where it cannot be written.
    """
    columns = read_columns(run)
    write_bytes(run / directory.COLUMNS, packed(columns), durable=False)
    return write_text(
        run / directory.REPORT, page(run, summary, columns), durable=False
    )


def page(run: Path, summary: SweepSummary, columns: pd.DataFrame | None = None) -> str:
    """Return the page of a sweep that needs no other file, with its rows unless they
    are too many.
    """
    columns = read_columns(run) if columns is None else columns
    rows = columns if len(columns) <= MOST_ROWS else None
    return sweep_page_html(
        [(run, summary)], [SweepSource(run.name, rows, pictures=kept_pictures(run))]
    )


def sweep_page_html(
    runs: Sequence[tuple[Path, SweepSummary | None]], sources: Sequence[SweepSource]
) -> str:
    """Return the page of sweeps as HTML, of each its folder, its result (None where it
    has none yet) and what its explorer reads.
    """
    connects = any(isinstance(source.rows, str) or source.folder for source in sources)
    described = []
    data = list[Html]()
    left_out = list[Html]()
    stills = list[Html]()
    parts = list[Html | None]()
    explored = [
        (source, *run)
        for source, run in zip(sources, runs, strict=True)
        if source.rows is not None
    ]
    for number, (source, path, summary) in enumerate(explored):
        about: JsonObject = {"name": source.name, "parts": source.parts}
        about |= (
            {"embedded": f"rows-{number}"} if source.embedded else {"rows": source.rows}
        )
        if source.embedded:
            zipped = base64.b64encode(
                gzip.compress(packed(source.rows), 6, mtime=0)
            ).decode()
            data.append(
                element(
                    "script",
                    Html(zipped),
                    type="application/octet-stream",
                    id=f"rows-{number}",
                )
            )
        if (kept := source.pictures) is not None:
            pictures: JsonObject = {"models": kept.models}
            if source.folder is not None:
                pictures |= {
                    "folder": source.folder,
                    "suffix": "jpg",
                    "kept": [*kept.numbers] if kept.some else None,
                }
            elif source.embedded:
                taken: JsonObject = dict(kept.embedded(source.rows, MOST_EMBEDDED))
                pictures["embedded"] = taken
                if len(taken) < len(kept.numbers):
                    some = (
                        f"{len(taken):,} of the {len(kept.numbers):,} pictures "
                        "that "
                        "were kept"
                    )
                    left_out.append(
                        element(
                            "p",
                            f"This file has {some}, those of the worst margins.",
                            class_="soft",
                        )
                    )
            about["pictures"] = pictures
        described.append(about | _judged(path, summary))
    # what is shown of a sweep on a page alone, and how it came about
    for path, summary in runs:
        if summary is not None:
            stills.append(_still(path, summary))
            shown = shown_of(summary)
            of_a_page = [
                part
                for part in shown.sections
                if part.only == "page" and not part.empty
            ]
            parts += [
                *(part_html(path, part, shown.said) for part in of_a_page),
                end_html(path, summary, shown),
            ]
    explorer = (
        element("div", id="explorer", hidden="hidden") if explored else _too_many(runs)
    )
    main = element("main", explorer, *left_out, *stills, *parts)
    data = [data_script(described, "runs"), *data]
    title = ", ".join(path.name for path, _ in runs)
    return document(
        title, _header(runs), main, data=data, scripts=["sweep.js"], connects=connects
    )


def _judged(run: Path, summary: SweepSummary | None) -> JsonObject:
    """The task, as far as settings can be read where there is no result yet, the axes
    of the grid, and height and width in pixels of what was judged, where that is one
    size: boxes are told in them.
    """
    if summary is None:
        with suppress(AdvsearchError):
            given = read_yaml(run / directory.CONFIG).get("task")
            return {
                "task": str(
                    given.get("name") if isinstance(given, Mapping) else given
                ).partition("=")[0]
            }
        return {}
    formed = summary.image_formation
    size = (
        None
        if formed is None or "," in summary.model
        else list[JsonValue](formed.resolution)
    )
    grid = list[JsonValue](dict.fromkeys(row.axis for row in summary.axes))
    return {
        "task": summary.task,
        "size": size,
        "grid": grid,
        "drives": bool(summary.drives),
    }


def _header(runs: Sequence[tuple[Path, SweepSummary | None]]) -> Html:
    lines: list[Html] = []
    for path, summary in runs:
        title = "h1" if len(runs) == 1 else "h2"
        if summary is None:
            lines += [element(title, f"{path.name}: this sweep has not ended yet")]
            continue
        what = subject_html(
            ("object", summary.object),
            ("environment", summary.environment),
            ("model", summary.model),
        )
        lines += [
            element("p", f"sweep {path.name}; ", what, class_="eyebrow"),
            element(title, sweep_verdict(summary)),
        ]
        lines += [remarks_html(summary.warnings)]
    return element(
        "header",
        element("h1", "Sweeps side by side") if len(runs) > 1 else None,
        *lines,
    )


def _too_many(runs: Sequence[tuple[Path, SweepSummary | None]]) -> Html:
    """What stands in the explorer's place in a file that would take more rows along
    than it may.
    """
    served = shlex.join(
        ["advsearch", "dashboard", *(directory.typed_name(path) for path, _ in runs)]
    )
    counts = ", ".join(
        f"{summary.configurations:,}" for _, summary in runs if summary is not None
    )
    left = (
        f"This file leaves out the {counts} rows, and what pictures they have: it "
        f"takes {MOST_ROWS:,} along at most. "
    )
    explores = [
        element("code", served),
        " explores them all, and so does the folder that ",
    ]
    made = [
        element("code", "advsearch view"),
        " makes with its option ",
        element("code", "bundle"),
        ".",
    ]
    return element("p", left, *explores, *made, class_="soft")


def sweep_verdict(summary: SweepSummary) -> str:
    if not summary.configurations:
        return (
            "The object is in no picture."
            if summary.out_of_view
            else "No configuration was looked at."
        )
    if summary.beside and summary.beside.pairs:
        return " ".join(
            beside_text(summary.beside.answer, one) for one in summary.beside.pairs
        )
    ended = (
        ""
        if summary.looked_at == summary.planned
        else f" so far, of {summary.planned} planned"
    )
    share = f"({sweeps.rate_text(summary)}){sweeps.of_grid(summary)}"
    outcomes = sweeps.outcomes_clause(summary)
    return (
        f"Right in {summary.correct} of {summary.configurations} "
        f"configurations{ended} {share}{outcomes}."
    )


def _still(path: Path, summary: SweepSummary) -> Html:
    """What a page without a script shows in the explorer's place."""
    single = (
        summary.cells is not None and max(map(max, summary.cells.configurations)) <= 1
    )
    axes = (
        " and ".join(list(dict.fromkeys(row.axis for row in summary.axes))[:2])
        or "all configurations"
    )
    figure = _figure(
        path / "images" / "sweep.png",
        f"{'Margin' if single else 'Accuracy'} over {axes}.",
    )
    text = ""
    if summary.worst is not None:
        values = ", ".join(
            f"{name} {wording.number_text(one.value)}"
            for name, one in summary.worst.values.items()
        )
        claim = summary.worst.pictured or summary.worst.claimed
        rate = summary.worst.verified
        text = f"{values}: the model predicts {prediction_text(summary.task, claim)}"
        if rate is not None:
            tally = wording.tally(
                "wrong", rate.successes, rate.trials, rate.not_a_number
            )
            text += f"; {tally} fresh renders"
    worst = _figure(path / "images" / "worst.png", f"{text}." if text else "")
    return join_html(
        element("div", figure, class_="pictures", data_still="true")
        if figure
        else None,
        element("h2", "The worst configuration") if worst else None,
        element("div", worst, class_="pictures pair") if worst else None,
    )


def _figure(file: Path, caption: str) -> Html | None:
    if not file.is_file():
        return None
    image = element("img", src=data_url(file.read_bytes(), "image/png"), alt=caption)
    return element("figure", image, element("figcaption", caption))


def result_of(run: Path) -> SweepSummary | None:
    """Return the result of the sweep in a folder; None where it has none yet. Raises
    FileFormatError where it is damaged, or that of another command.
    """
    result = read_result(run) if (run / "summary.json").is_file() else None
    return result if isinstance(result, SweepSummary) else None


INDEX = "index.html"


def write_bundle(runs: Sequence[Path], folder: Path) -> Path:
    """Write a folder with a page, the rows and the thumbnails of sweeps, or the page of
    another run; return the page. Raises InputError where the folder is there and not
    empty, or these runs have no common page, and otherwise as `write_sweep_page`.
    """
    check_free_folder(folder, "bundle")
    results = [(run, read_result(run)) for run in runs]
    sweeps = [
        (run, result) for run, result in results if isinstance(result, SweepSummary)
    ]
    with placed_by("bundle"):
        if len(results) == 1 and not sweeps:
            run, result = results[0]
            # made anew: what lies there may be anybody's
            for page in sorted((run / directory.PARTS).glob(f"*/{directory.REPORT}")):
                write_text(
                    folder / page.relative_to(run),
                    page_of(page.parent, read_result(page.parent)),
                )
            return write_text(folder / INDEX, page_of(run, result))
        if len(sweeps) < len(results):
            raise InputError(
                "bundle: one run or several sweeps make a page; give one kind of them"
            )
        sources = list[SweepSource]()
        for number, (run, _) in enumerate(sweeps):
            # a page that was opened by a double click may load pictures beside it, and
            # no rows
            columns = read_columns(run)
            pictures = f"pictures-{number}"
            rows = f"rows-{number}.bin"
            embedded = len(columns) <= MOST_ROWS
            if not embedded:
                write_bytes(folder / rows, packed(columns))
            kept = kept_pictures(run)
            for picture in kept.numbers if kept else ():
                place = path_of(folder / pictures, picture)
                write_bytes(
                    folder / pictures / place.parent.name / place.name,
                    read_thumbnail(run, picture),
                )
            sources.append(
                SweepSource(
                    run.name,
                    columns if embedded else rows,
                    pictures=kept,
                    folder=pictures,
                )
            )
        return write_text(folder / INDEX, sweep_page_html(sweeps, sources))
