"""`report.html` of any run: the page that its question has, or what it shows of its answer as a page.

The object of an attack may be turned there: `object.js` draws the run's binary glTF.
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar

from advsearch import rooms
from advsearch.errors import FileFormatError, InputError
from advsearch.files import read_bytes
from advsearch.report.markup import NARROW, WIDE, Html, element, join_html, study_chart
from advsearch.report.shown import AnswerPart, Picture, ShownAnswer, facts_of, remarks_of, shown, subject_of
from advsearch.runs.directory import IMAGES, OBJECT_FILE, PARTS, REPORT, RunDirectory
from advsearch.runs.files import placed_by, write_bytes, write_text
from advsearch.runs.results.base import Result
from advsearch.runs.results.sweep import SweepSummary
from advsearch.runs.summary import read_result
from advsearch.viewer import document
from advsearch.viewer.columns import read_columns
from advsearch.viewer.sweep_page import SweepSource, sweep_page_html, whole_page, write_sweep_page
from advsearch.viewer.thumbnails import kept_pictures, path_of, read_thumbnail

Answer = TypeVar("Answer", bound=Result)

LARGEST = 2_700_000
"""Bytes of an object that a page takes along."""

_WORDS = "Drag it, or choose it and press the arrow keys. It is lit evenly here, not by the scene's light."


def read_object(run: Path) -> bytes:
    """Return the object that a run has to turn; nothing where it has none, or one that is damaged or too large."""
    try:
        data = read_bytes(run / OBJECT_FILE, "an object to turn", LARGEST)
    except (OSError, FileFormatError):
        return b""
    return data if _header(data) else b""


def object_section(data: bytes) -> Html | None:
    """Return where the script puts the object; hidden until it does, so that without it the pictures stand alone."""
    if not data:
        return None
    extras = _header(data).get("asset", {}).get("extras", {})
    note = str(extras.get("note", "")) if isinstance(extras, dict) else ""
    words = element("p", " ".join(filter(None, (_WORDS, note))), class_="soft")
    return element("div", element("h2", "The object, to turn"), element("div", id="object"), words, hidden="hidden")


def object_data(data: bytes) -> list[Html]:
    """Return the script that holds the object, if there is one."""
    return [document.data_script(base64.b64encode(data).decode("ascii"), "object-file")] if data else []


def _header(data: bytes) -> dict[str, dict[str, object]]:
    """The header of a binary glTF file; empty where it is damaged."""
    try:
        magic, _, _, length, kind = struct.unpack_from("<4sII I4s", data)
        head = json.loads(data[20 : 20 + length]) if (magic, kind) == (b"glTF", b"JSON") else None
    except (struct.error, ValueError, RecursionError):
        return {}
    return head if isinstance(head, dict) and isinstance(head.get("asset"), dict) else {}


LARGEST_FIGURE = 2_000_000
"""Bytes of a figure or a picture that the page takes along."""

KINDS = {".png": "image/png", ".jpg": "image/jpeg", ".jpeg": "image/jpeg"}
"""Media types of pictures."""


def write_page(run: Path, result: Result) -> Path:
    """Write `report.html` into the folder of a run and return its path. Raises FileFormatError where other results of
    the run are damaged, StorageError where the page cannot be written."""
    if isinstance(result, SweepSummary):
        return write_sweep_page(run, result)
    return write_text(run / REPORT, page_of(run, result), durable=False)


def page_of(run: Path, result: Result) -> str:
    """Return the page of a run, which needs no other file but those of its parts. Raises FileFormatError where other
    results of the run are damaged."""
    if isinstance(result, SweepSummary):
        return whole_page(run, result, read_columns(run))
    room = rooms.room(result.command)
    made: str | None = room.page(run, result) if room and room.page else None
    return made or shown_page(run, result, shown(result))


def keep_answer(run: RunDirectory, result: Answer) -> Answer:
    """Write the summary and the page of an answer into the open directory of its run, and return it."""
    run.write_summary(result)
    write_page(run.path, result)
    return result


def shown_page(run: Path, result: Result, given: ShownAnswer) -> str:
    """Return what is shown of an answer as the page of the run in the folder `run`."""
    parts = list(getattr(result, "parts", ()))
    facts = {name[:1].upper() + name[1:]: text for name, text in facts_of(result, given).items()}
    drawn = any(one.draw or one.figure or one.pictures for one in given.sections)
    main = element(
        "main",
        *([] if drawn else _figures(run, given.said)),
        *(_section(run, one, given.said) for one in given.sections if one.only in ("", "page") and not one.empty),
        _links(run, parts) if parts and all(isinstance(one, str) for one in parts) else None,
        join_html(element("h2", "Cost and conditions"), document.facts_table(facts)),
        document.again(str(getattr(result, "command_line", None) or f"advsearch show {run.name}")),
    )
    subject = subject_of(result, given)
    what = join_html(result.command, "; " if subject else None, document.subject_html(*(("", one) for one in subject)))
    header = document.heading(what, given.said, remarks_of(result, given))
    return document.document(
        f"{run.name}, {result.command}", header, main, footer=f"run {run.name}. This page needs no other file."
    )


def kept(run: Path, name: str | Path) -> Path | None:
    """Return the file of a picture in the folder of a run; None where it is missing, elsewhere or too large."""
    file = run / name
    inside = file.resolve().is_relative_to(run.resolve()) and file.is_file()  # a summary may name any
    return file if inside and file.stat().st_size <= LARGEST_FIGURE else None


def _section(run: Path, one: AnswerPart, said: str) -> Html:
    """A part of an answer, which says `said`; a folded one has its title as the handle."""
    chart = None
    if one.draw is not None:
        words = " ".join([f"{one.title}.", *(one.text or [said])])
        chart = element("div", *(study_chart(one.draw, words, width, one.height) for width in (WIDE, NARROW)))
    table = (
        document.study_table(one.heads, one.rows, document.part_links(run, one.parts), one.shares)
        if one.heads
        else None
    )
    inside = join_html(
        *(element("p", text) for text in one.text if text and one.draw is None),
        chart or _figure(run, one.figure, " ".join(one.text) or one.title),
        (table or document.facts_table({row[0]: row[1] for row in one.rows})) if one.rows else None,
        *(_pictures(run, group) for group in one.pictures),
        element("p", one.note, class_="soft") if one.note else None,
    )
    if one.folded:
        return element("details", element("summary", one.title), inside)
    return join_html(element("h2", one.title) if one.title else None, inside)


def _pictures(run: Path, group: Iterable[Picture]) -> Html | None:
    """Pictures side by side, of those that are there."""
    figures = [
        element(
            "figure",
            element("img", src=document.data_url(file.read_bytes(), KINDS[file.suffix.lower()]), alt=one.caption),
            element("figcaption", one.caption),
        )
        for one in group
        if (file := kept(run, one.file)) is not None
    ]
    return element("div", *figures, class_="pictures pair" if len(figures) < 3 else "pictures") if figures else None


def _figures(run: Path, said: str) -> Iterator[Html]:
    """The figures among the images of a run whose question names none."""
    for file in sorted((run / IMAGES).glob("*.png")):
        name = file.stem.replace("-", " ").replace("_", " ").capitalize()
        yield _figure(run, f"{IMAGES}/{file.name}", f"{name}: {said}") or Html()


def _figure(run: Path, name: str, alt: str) -> Html | None:
    file = kept(run, name) if name else None
    if file is None:
        return None
    picture = element("img", src=document.data_url(file.read_bytes(), "image/png"), alt=alt)
    return element("figure", document.scrolled(picture, "wide"), class_="wide")


def _links(run: Path, parts: list[str]) -> Html:
    linked = zip(parts, document.part_links(run, parts), strict=True)
    lines = [element("li", element("a", name, href=link) if link else name) for name, link in linked]
    return element("details", element("summary", f"The runs ({len(parts)})"), element("ul", *lines))


INDEX = "index.html"


def renewed(run: Path) -> Path:
    """Write the page of a run anew and return its path.

    Raises:
        FileFormatError: its results are damaged.
        StorageError: it cannot be written.
    """
    return write_page(run, read_result(run))


def write_bundle(runs: Sequence[Path], folder: Path) -> Path:
    """Write a folder with a page, the rows and the thumbnails of sweeps, or the page of another run; return the page.

    Raises:
        InputError: the folder is there and not empty, or runs of these commands have no common page.
        FileFormatError: results are damaged.
        StorageError: the folder cannot be written.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"bundle: {folder} is there already and not empty; name another folder")
    results = [(run, read_result(run)) for run in runs]
    sweeps = [(run, result) for run, result in results if isinstance(result, SweepSummary)]
    with placed_by("bundle"):
        if len(results) == 1 and not sweeps:
            run, result = results[0]
            for page in sorted((run / PARTS).glob(f"*/{REPORT}")):  # made anew: what lies there may be anybody's
                write_text(folder / page.relative_to(run), page_of(page.parent, read_result(page.parent)))
            return write_text(folder / INDEX, page_of(run, result))
        if len(sweeps) < len(results):
            raise InputError("bundle: one run or several sweeps make a page; give one kind of them")
        sources = [_copied(run, folder, number) for number, (run, _) in enumerate(sweeps)]
        return write_text(folder / INDEX, sweep_page_html(sweeps, sources))


def _copied(run: Path, folder: Path, number: int) -> SweepSource:
    """Write rows and thumbnails of a sweep into the folder, and say where they are."""
    rows, pictures = f"rows-{number}.bin", f"pictures-{number}"
    write_bytes(folder / rows, read_columns(run).packed())
    kept = kept_pictures(run)
    for one in kept.numbers if kept else ():
        place = path_of(folder / pictures, one)
        write_bytes(folder / pictures / place.parent.name / place.name, read_thumbnail(run, one))
    return SweepSource(run.name, rows, pictures=kept, folder=pictures)
