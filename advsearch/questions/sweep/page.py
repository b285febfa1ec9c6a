"""The page of sweeps: still images and tables that need no script, and the explorer.

The same page is a file that needs no other (`write_sweep_page`), a page of `advsearch
dashboard`, and a page of a directory that any web server can serve. These differ only
in where rows and images come from (`SweepSource`).
"""

from __future__ import annotations

import base64
import gzip
import shlex
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from advsearch.errors import AdvsearchError, InputError
from advsearch.files import JsonObject, JsonValue
from advsearch.questions.sweep.display import (
    describe_wrong_outcomes,
    format_accuracy,
    format_grid_caution,
)
from advsearch.questions.sweep.summary import SweepSummary
from advsearch.report import wording
from advsearch.report.views import Html, join_html, make_element
from advsearch.report.views import get_view as make_view
from advsearch.report.wording import format_paired_rates, format_prediction
from advsearch.runs import directory
from advsearch.runs.results import VerifiedRate
from advsearch.runs.summary import read_result
from advsearch.settings import read_yaml
from advsearch.trust.writing import (
    check_free_folder,
    name_setting_in_errors,
    write_bytes,
    write_text,
)
from advsearch.viewer.columns import pack_columns, read_columns
from advsearch.viewer.document import (
    make_data_script,
    make_data_url,
    make_document,
    make_subject_html,
    remarks_html,
)
from advsearch.viewer.pages import make_page_end, make_part, make_run_page
from advsearch.viewer.thumbnails import (
    Thumbnails,
    find_thumbnails,
    read_thumbnail,
    thumbnail_path,
)

if TYPE_CHECKING:
    import pandas as pd

MAX_EMBEDDED_BYTES = 3_000_000
"""Maximum number of bytes of thumbnails in a page that needs no other file. Those of
the worst predictions come first.
"""
# Maximum number of rows in such a page; `advsearch dashboard` shows more.
MAX_EMBEDDED_ROWS = 200_000


@dataclass(frozen=True)
class SweepSource:
    """Where the page of a sweep gets its rows and images.

    Attributes:
        name: name of the run.
        rows: the rows as columns, for a page that needs no other file; or the address
            from which they are fetched. None if they are too many for the page, which
            then has only tables.
        is_partial: whether the rows are fetched in parts (``?after=ID``), as those of a
            sweep that has not ended.
        thumbnails: the thumbnails of the images.
        thumbnail_address: address of the thumbnails; None embeds them in the page.
    """

    name: str
    rows: pd.DataFrame | str | None
    is_partial: bool = False
    thumbnails: Thumbnails | None = None
    thumbnail_address: str | None = None

    @property
    def is_embedded(self) -> bool:
        """Whether the rows are in the page itself, and not at an address."""
        return self.rows is not None and not isinstance(self.rows, str)


def write_sweep_page(run: Path, summary: SweepSummary) -> Path:
    """Write `report.html` of a finished sweep, and its rows as columns.

    Args:
        run: the run directory.
        summary: summary of the sweep.

    Returns:
        The page's path.

    Raises:
        FileFormatError: the results are corrupt.
        StorageError: the page cannot be written.
    """
    columns = read_columns(run)
    write_bytes(run / directory.COLUMNS, pack_columns(columns), durable=False)
    html = make_page(run, summary, columns)
    return write_text(run / directory.REPORT, html, durable=False)


def make_page(
    run: Path, summary: SweepSummary, columns: pd.DataFrame | None = None
) -> str:
    """Return the page of a sweep that needs no other file.

    Args:
        run: the run directory.
        summary: summary of the sweep.
        columns: its rows; None reads them. The page contains them unless they are too
            many.
    """
    columns = read_columns(run) if columns is None else columns
    rows = columns if len(columns) <= MAX_EMBEDDED_ROWS else None
    source = SweepSource(run.name, rows, thumbnails=find_thumbnails(run))
    return make_sweep_page([(run, summary)], [source])


def make_sweep_page(
    runs: Sequence[tuple[Path, SweepSummary | None]], sources: Sequence[SweepSource]
) -> str:
    """Return the page of sweeps.

    Args:
        runs: directory and summary of each run; the summary is None if there is none
            yet.
        sources: rows and thumbnails of each run, which the explorer reads.
    """
    # The explorer leaves out runs with too many rows.
    explored = [
        (source, path, summary)
        for source, (path, summary) in zip(sources, runs, strict=True)
        if source.rows is not None
    ]
    descriptions, embedded_rows, image_notes = _describe_runs(explored)
    explorer = make_element("div", id="explorer", hidden="hidden")
    if not explored:
        explorer = _too_many_rows_html(runs)
    title = ", ".join(path.name for path, _ in runs)
    return make_document(
        title,
        _header_html(runs),
        make_element("main", explorer, *image_notes, *_list_contents(runs)),
        data=[make_data_script(descriptions, "runs"), *embedded_rows],
        scripts=["sweep.js"],
        connects=_needs_connection(sources),
    )


def _list_contents(
    runs: Sequence[tuple[Path, SweepSummary | None]],
) -> list[Html | None]:
    """Return the still images of all runs, and then their parts."""
    stills = list[Html | None]()
    parts = list[Html | None]()
    for path, summary in runs:
        if summary is not None:
            stills.append(_still_html(path, summary))
            parts += _page_parts_html(path, summary)
    return [*stills, *parts]


def _needs_connection(sources: Sequence[SweepSource]) -> bool:
    """Return whether the script of a page fetches rows or images from an address.

    The security policy of the page has to allow that.
    """
    return any(
        isinstance(source.rows, str) or bool(source.thumbnail_address)
        for source in sources
    )


def _describe_runs(
    explored: Sequence[tuple[SweepSource, Path, SweepSummary | None]],
) -> tuple[list[JsonObject], list[Html], list[Html]]:
    """Return what the explorer reads of runs: descriptions, rows, and notes on images.

    A description has either "embedded", the id of the element with the rows, or "rows",
    their address. Its "parts" states whether rows are fetched in parts. Notes state
    which images the page leaves out.
    """
    descriptions = list[JsonObject]()
    embedded_rows = list[Html]()
    image_notes = list[Html]()
    for index, (source, path, summary) in enumerate(explored):
        description: JsonObject = {"name": source.name, "parts": source.is_partial}
        if source.is_embedded:
            row_id = f"rows-{index}"
            description["embedded"] = row_id
            embedded_rows.append(_embed_rows(source.rows, row_id))
        else:
            description["rows"] = source.rows
        if source.thumbnails is not None:
            images, note = _describe_images(source, source.thumbnails)
            description["pictures"] = images
            image_notes += [] if note is None else [note]
        descriptions.append(description | _describe_for_explorer(path, summary))
    return descriptions, embedded_rows, image_notes


def _embed_rows(rows: Any, element_id: str) -> Html:
    """Return a script element that holds rows, compressed."""
    zipped = gzip.compress(pack_columns(rows), 6, mtime=0)
    encoded = Html(base64.b64encode(zipped).decode())
    return make_element(
        "script", encoded, type="application/octet-stream", id=element_id
    )


def _describe_images(
    source: SweepSource, thumbnails: Thumbnails
) -> tuple[JsonObject, Html | None]:
    """Describe for the explorer where the thumbnails of a sweep are.

    They are in a folder next to the page, or embedded in it. A page embeds only as many
    as fit.

    Args:
        source: where the page gets its rows and images.
        thumbnails: the thumbnails of the sweep.

    Returns:
        The description; and a note if some are left out, else None.
    """
    # Several configurations share an image: one for each model.
    images: JsonObject = {"models": thumbnails.rows_per_image}
    if source.thumbnail_address is not None:
        images["folder"] = source.thumbnail_address
        images["suffix"] = "jpg"
        # the numbers of the stored images; None if all are stored
        images["kept"] = [*thumbnails.numbers] if thumbnails.is_subset else None
        return images, None
    if not source.is_embedded:
        return images, None  # without an address or rows no image can be found
    embedded: JsonObject = dict(
        thumbnails.list_data_urls(source.rows, MAX_EMBEDDED_BYTES)
    )
    images["embedded"] = embedded
    return images, _note_embedded(len(embedded), len(thumbnails.numbers))


def _note_embedded(n_embedded: int, n_thumbnails: int) -> Html | None:
    """Return a note that a page has only some of the thumbnails; None if it has all."""
    if n_embedded == n_thumbnails:
        return None
    note = (
        f"This file has {n_embedded:,} of the {n_thumbnails:,} pictures that were "
        "kept, those of the worst margins."
    )
    return make_element("p", note, class_="soft")


def _page_parts_html(path: Path, summary: SweepSummary) -> list[Html | None]:
    """Return the parts that only a page shows, and its end: how to repeat the run."""
    view = make_view(summary)
    page_parts = [
        part
        for part in view.sections
        if part.only_medium == "page" and not part.is_empty
    ]
    return [
        *(make_part(path, part, view.statement) for part in page_parts),
        make_page_end(path, summary, view),
    ]


def _describe_for_explorer(run: Path, summary: SweepSummary | None) -> JsonObject:
    """Return what the explorer of rows needs to know about a sweep.

    That is the task, the axes of the tables, and height and width of the evaluated
    images in pixels, which are the units of boxes. With several models there is no
    size, since it may differ between them. If there is no summary yet, only the task
    is returned, or nothing if the settings cannot be read.

    Args:
        run: the run directory.
        summary: summary of the sweep; None without one.
    """
    if summary is None:
        return _read_task(run)
    formation = summary.image_formation
    size = None
    has_single_model = "," not in summary.model
    if formation is not None and has_single_model:
        size = list[JsonValue](formation.resolution)
    axis_names = dict.fromkeys(row.axis for row in summary.axes)
    return {
        "task": summary.task,
        "size": size,
        "grid": list[JsonValue](axis_names),
        "drives": bool(summary.drives),
    }


def _read_task(run: Path) -> JsonObject:
    """Return the task in the settings of a run; empty if these cannot be read."""
    with suppress(AdvsearchError):
        task = read_yaml(run / directory.CONFIG).get("task")
        name = task.get("name") if isinstance(task, Mapping) else task
        # a text may have options, as in "detection=..."
        return {"task": str(name).partition("=")[0]}
    return {}


def _header_html(runs: Sequence[tuple[Path, SweepSummary | None]]) -> Html:
    """Return the header: of each sweep its subject, its result and its warnings."""
    lines: list[Html] = []
    heading = "h1" if len(runs) == 1 else "h2"
    for path, summary in runs:
        if summary is None:
            text = f"{path.name}: this sweep has not ended yet"
            lines.append(make_element(heading, text))
        else:
            lines += _list_header_lines(path, summary, heading)
    title = make_element("h1", "Sweeps side by side") if len(runs) > 1 else None
    return make_element("header", title, *lines)


def _list_header_lines(path: Path, summary: SweepSummary, heading: str) -> list[Html]:
    """Return the subject, the result and the warnings of a sweep for the header.

    Args:
        path: the run directory.
        summary: summary of the sweep.
        heading: the HTML tag of the result, "h1" or "h2".
    """
    subject = make_subject_html(
        ("object", summary.object),
        ("environment", summary.environment),
        ("model", summary.model),
    )
    return [
        make_element("p", f"sweep {path.name}; ", subject, class_="eyebrow"),
        make_element(heading, verdict_text(summary)),
        remarks_html(summary.warnings),
    ]


def _too_many_rows_html(runs: Sequence[tuple[Path, SweepSummary | None]]) -> Html:
    """Return a note in place of the explorer, for a page with too many rows."""
    names = [directory.format_run_name(path) for path, _ in runs]
    command = shlex.join(["advsearch", "dashboard", *names])
    summaries = [summary for _, summary in runs if summary is not None]
    counts = ", ".join(f"{summary.configurations:,}" for summary in summaries)
    return make_element(
        "p",
        f"This file leaves out the {counts} rows, and what pictures they have: it "
        f"takes {MAX_EMBEDDED_ROWS:,} along at most. ",
        make_element("code", command),
        " explores them all, and so does the folder that ",
        make_element("code", "advsearch view"),
        " makes with its option ",
        make_element("code", "bundle"),
        ".",
        class_="soft",
    )


def verdict_text(summary: SweepSummary) -> str:
    """Return the result of a sweep in a sentence, also of one that goes on."""
    if not summary.configurations:
        if summary.out_of_view:
            return "The object is in no picture."
        return "No configuration was looked at."
    if summary.arms and summary.arms.pairs:
        run = summary.arms.adversarial_run
        return " ".join(format_paired_rates(run, pair) for pair in summary.arms.pairs)
    so_far = ""
    if summary.looked_at != summary.planned:
        so_far = f" so far, of {summary.planned} planned"
    accuracy = f"({format_accuracy(summary)}){format_grid_caution(summary)}"
    return (
        f"Right in {summary.correct} of {summary.configurations} "
        f"configurations{so_far} {accuracy}{describe_wrong_outcomes(summary)}."
    )


def _still_html(path: Path, summary: SweepSummary) -> Html:
    """Return the images that stand in for the explorer if no script runs.

    These are the figure of the accuracy and the worst image, if the run has them. If no
    cell of the map has two configurations, the figure shows the margin instead.

    Args:
        path: the run directory.
        summary: summary of the sweep.
    """
    # The figure shows the first two axes.
    axis_names = list(dict.fromkeys(row.axis for row in summary.axes))
    axes = " and ".join(axis_names[:2]) or "all configurations"
    caption = f"{_find_measure(summary)} over {axes}."
    figure = _figure_html(path / "images" / "sweep.png", caption)
    worst = _figure_html(path / "images" / "worst.png", _worst_caption(summary))
    parts = list[Html | None]()
    if figure:
        # The page's script hides this element once the explorer replaces it. The worst
        # image stays.
        parts.append(make_element("div", figure, class_="pictures", data_still="true"))
    if worst:
        parts.append(make_element("h2", "The worst configuration"))
        parts.append(make_element("div", worst, class_="pictures pair"))
    return join_html(*parts)


def _find_measure(summary: SweepSummary) -> str:
    """Return what the figure of a sweep shows, as `display._draw_map` decides."""
    if summary.cells:
        max_configurations = max(map(max, summary.cells.configurations))
        if max_configurations <= 1:
            return "Margin"
    return "Accuracy"


def _worst_caption(summary: SweepSummary) -> str:
    """Return the caption of the worst image; empty without one."""
    worst = summary.worst
    if worst is None:
        return ""
    values = ", ".join(
        f"{name} {wording.format_number(described.value)}"
        for name, described in worst.values.items()
    )
    # the prediction about the saved image, or else the one of the sweep
    claim = worst.pictured or worst.claimed
    prediction = format_prediction(summary.task, claim)
    verified = _verified_clause(worst.verified)
    return f"{values}: the model predicts {prediction}{verified}."


def _verified_clause(rate: VerifiedRate | None) -> str:
    """Return in how many fresh renders the model is wrong; empty without any."""
    if rate is None:
        return ""
    wrong = wording.format_tally(
        "wrong", rate.successes, rate.trials, rate.not_a_number
    )
    return f"; {wrong} fresh renders"


def _figure_html(file: Path, caption: str) -> Html | None:
    """Return a PNG file as a figure; None if there is no such file."""
    if not file.is_file():
        return None
    image = make_element(
        "img", src=make_data_url(file.read_bytes(), "image/png"), alt=caption
    )
    return make_element("figure", image, make_element("figcaption", caption))


def load_sweep_result(run: Path) -> SweepSummary | None:
    """Read the result of a sweep.

    None if it has none yet, or is a run of another command.

    Args:
        run: the run directory.

    Raises:
        FileFormatError: the result is corrupt.
    """
    if not (run / "summary.json").is_file():
        return None
    result = read_result(run)
    return result if isinstance(result, SweepSummary) else None


INDEX = "index.html"


def write_bundle(runs: Sequence[Path], folder: Path) -> Path:
    """Write a directory with a page, the rows and the thumbnails of sweeps.

    A single run of another command may be in place of the sweeps: then the directory
    has its page, and those of its parts.

    Args:
        runs: run directories.
        folder: directory that is written.

    Returns:
        The page's path.

    Raises:
        InputError: the directory is there and not empty, these runs have no common
            page, or a run cannot be read.
    """
    check_free_folder(folder, "bundle")
    results = [(run, read_result(run)) for run in runs]
    sweeps = [
        (run, result) for run, result in results if isinstance(result, SweepSummary)
    ]
    with name_setting_in_errors("bundle"):
        if len(results) == 1 and not sweeps:
            run, result = results[0]
            _write_part_pages(run, folder)
            return write_text(folder / INDEX, make_run_page(run, result))
        if len(sweeps) < len(results):
            raise InputError(
                "bundle: one run or several sweeps make a page; give one kind of them"
            )
        sources = [
            _write_source(run, index, folder) for index, (run, _) in enumerate(sweeps)
        ]
        return write_text(folder / INDEX, make_sweep_page(sweeps, sources))


def _write_part_pages(run: Path, folder: Path) -> None:
    """Write the pages of the parts of a run, which its own page links to.

    Stored pages are not copied, as they could contain anything: they only show which
    parts there are. Each page is made again from the result of the part.

    Args:
        run: run directory, whose parts are runs with results of their own.
        folder: folder of the bundle.
    """
    for page in sorted((run / directory.PARTS).glob(f"*/{directory.REPORT}")):
        part = page.parent
        html = make_run_page(part, read_result(part))
        write_text(folder / page.relative_to(run), html)


def _write_source(run: Path, index: int, folder: Path) -> SweepSource:
    """Write thumbnails of a sweep, and rows if they are many, into a bundle.

    Args:
        run: the run directory.
        index: index of the sweep in the bundle.
        folder: directory of the bundle.
    """
    # A page that is opened as a file, without a server, may load images from other
    # files, but no rows. So rows are embedded in the page, unless they are too many:
    # then the page needs a server.
    columns = read_columns(run)
    rows: pd.DataFrame | str = columns
    if len(columns) > MAX_EMBEDDED_ROWS:
        rows = f"rows-{index}.bin"
        write_bytes(folder / rows, pack_columns(columns))
    image_folder = f"pictures-{index}"
    thumbnails = find_thumbnails(run)
    if thumbnails:
        _copy_thumbnails(run, thumbnails, folder / image_folder)
    return SweepSource(
        run.name, rows, thumbnails=thumbnails, thumbnail_address=image_folder
    )


def _copy_thumbnails(run: Path, thumbnails: Thumbnails, folder: Path) -> None:
    """Copy the thumbnails of a run into a folder of a bundle."""
    for number in thumbnails.numbers:
        # Only the numbered subfolder and the name are those of a run.
        file = thumbnail_path(folder, number)
        target = folder / file.parent.name / file.name
        write_bytes(target, read_thumbnail(run, number))
