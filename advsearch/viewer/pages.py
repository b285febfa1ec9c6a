"""`report.html` of any run: the page that its question has, or what it shows of its
result as a page.

The object of an attack may be turned there: `object.js` draws the run's binary glTF.
"""

from __future__ import annotations

import base64
import json
import shlex
import struct
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TypeVar

from advsearch import registry
from advsearch.errors import FileFormatError
from advsearch.report import views
from advsearch.report.views import (
    Html,
    Picture,
    ResultPart,
    ShownResult,
    element,
    join_html,
)
from advsearch.runs.directory import CONFIG, IMAGES, OBJECT_FILE, REPORT, RunDirectory
from advsearch.runs.files import smaller_png
from advsearch.runs.results import Result
from advsearch.runs.summary import read_result
from advsearch.settings import python_only_text
from advsearch.trust.named_files import is_inside
from advsearch.trust.stored_files import read_bytes
from advsearch.trust.writing import write_text
from advsearch.viewer import document

LARGEST_FIGURE = 2_000_000  # bytes of a figure or a picture that the page takes along
LARGEST_PNG = 50_000_000  # bytes of a picture that is read to be made smaller
LARGE_PICTURE = 1_000_000
"""Bytes above which a PNG is put into the page at a smaller size; the file itself stays
as it is.
"""
SMALLER_SIDE = 640  # longest side in pixels of such a smaller picture
# media types of pictures
KINDS = {".png": "image/png", ".jpg": "image/jpeg", ".jpeg": "image/jpeg"}


def kept(run: Path, name: str | Path, largest: int = LARGEST_FIGURE) -> Path | None:
    """Return the file of a picture in the folder of a run; None where it is missing,
    elsewhere or too large.
    """
    file = run / name
    inside = is_inside(file, run) and file.is_file()  # a summary may name any
    return file if inside and file.stat().st_size <= largest else None


def part_html(run: Path, one: ResultPart, said: str) -> Html:
    """A part of a result, which says `said`; a folded one has its title as the
    handle.
    """
    chart = None
    if one.draw is not None:
        words = " ".join([f"{one.title}.", *(one.text or [said])])
        chart = element(
            "div",
            *(
                views.study_chart(one.draw, words, width, one.height)
                for width in (views.WIDE, views.NARROW)
            ),
        )
    table = None
    if one.heads:
        table = document.study_table(
            one.heads,
            one.rows,
            document.part_links(run, one.parts),
            one.shares,
            one.bars,
        )
    inside = join_html(
        *(element("p", text) for text in one.text if text and one.draw is None),
        chart or _figure(run, one.figure, " ".join(one.text) or one.title),
        (table or document.facts_table({row[0]: row[1] for row in one.rows}))
        if one.rows
        else None,
        *(_pictures(run, group, one.layout) for group in one.pictures),
        element("p", one.note, class_="soft") if one.note else None,
    )
    if one.live:
        title = element("h2", one.title) if one.title else None
        return element(
            "div",
            title,
            element("div", id=one.live),
            inside,
            hidden="hidden",
            class_="screen",
        )
    if one.folded:
        return element("details", element("summary", one.title), inside)
    return join_html(element("h2", one.title) if one.title else None, inside)


def _pictures(run: Path, group: Iterable[Picture], layout: str) -> Html | None:
    figures = []
    for one in group:
        png = one.file.lower().endswith(".png")
        if (
            file := kept(run, one.file, LARGEST_PNG if png else LARGEST_FIGURE)
        ) is None:
            continue
        data = file.read_bytes()
        kind = KINDS[file.suffix.lower()]
        data = (
            smaller_png(data, SMALLER_SIDE)
            if png and len(data) > LARGE_PICTURE
            else data
        )
        alt = ": ".join(filter(None, (one.name, one.caption)))
        picture = element(
            "img", src=document.data_url(data, kind), alt=alt, data_picture=file.stem
        )
        name = [element("strong", one.name), ": "] if one.name else []
        figures.append(
            element("figure", picture, element("figcaption", *name, one.caption))
        )
    layout = layout or ("pair" if len(figures) < 3 else "")
    return (
        element("div", *figures, class_=f"pictures {layout}".strip())
        if figures
        else None
    )


def _figure(run: Path, name: str, alt: str) -> Html | None:
    file = kept(run, name) if name else None
    if file is None:
        return None
    picture = element(
        "img", src=document.data_url(file.read_bytes(), "image/png"), alt=alt
    )
    return element("figure", document.scrolled(picture, "wide"), class_="wide")


def end_html(run: Path, result: Result, given: ShownResult) -> Html:
    """Return what stands at the end of a page: how the result came about, the commands
    that go on with what was stopped and that ask the same again, and all settings.
    """
    facts = {
        name[:1].upper() + name[1:]: text
        for name, text in views.facts_of(result, given).items()
    }
    recipe = run / CONFIG
    parts = [element("h2", "Cost and conditions"), document.facts_table(facts)]
    if result.goes_on:
        resume = shlex.join(["advsearch", "resume", str(run)])
        parts += [element("h2", "Go on"), element("pre", resume, class_="wrap")]
    again = ""
    if python_only := getattr(result, "python_only", []):
        again = f"No command repeats this: {python_only_text(python_only)}"
    elif recipe.is_file():
        again = shlex.join(["advsearch", "run", str(recipe)])
    parts += (
        [element("h2", "Do it again"), element("pre", again, class_="wrap")]
        if again
        else []
    )
    settings = (
        recipe.read_text(encoding="utf-8", errors="replace") if recipe.is_file() else ""
    )
    if settings:
        whole = element("pre", settings, class_="wrap")
        parts.append(element("details", element("summary", "All settings"), whole))
    return join_html(*parts)


AnyResult = TypeVar("AnyResult", bound=Result)
LARGEST = 2_700_000  # bytes of an object that a page takes along
_WORDS = (
    "Drag it, or choose it and press the arrow keys. It is lit evenly here, not "
    "by the scene's light."
)


def read_object(run: Path) -> bytes:
    """Return the object that a run has to turn; nothing where it has none, or one that
    is damaged or too large.
    """
    try:
        data = read_bytes(run / OBJECT_FILE, "an object to turn", LARGEST)
    except (OSError, FileFormatError):
        return b""
    return data if _header(data) else b""


def object_part(data: bytes) -> ResultPart:
    """Return where the script puts the object; empty where there is none."""
    if not data:
        return ResultPart()
    extras = _header(data).get("asset", {}).get("extras", {})
    note = str(extras.get("note", "")) if isinstance(extras, dict) else ""
    return ResultPart(
        "The object, to turn",
        note=" ".join(filter(None, (_WORDS, note))),
        live="object",
    )


def object_data(data: bytes) -> list[Html]:
    return (
        [document.data_script(base64.b64encode(data).decode("ascii"), "object-file")]
        if data
        else []
    )


def _header(data: bytes) -> dict[str, dict[str, object]]:
    """The header of a binary glTF file; empty where it is damaged."""
    try:
        magic, _, _, length, kind = struct.unpack_from("<4sII I4s", data)
        head = (
            json.loads(data[20 : 20 + length])
            if (magic, kind) == (b"glTF", b"JSON")
            else None
        )
    except (struct.error, ValueError, RecursionError):
        return {}
    return (
        head if isinstance(head, dict) and isinstance(head.get("asset"), dict) else {}
    )


def write_page(run: Path, result: Result | None = None) -> Path:
    """Write `report.html` of a result, by default the one that is there, into the
    folder of a run and return its path. Raises FileFormatError where results of the run
    are damaged, StorageError where the page cannot be written.
    """
    return write_text(
        run / REPORT, page_of(run, result or read_result(run)), durable=False
    )


def page_of(run: Path, result: Result) -> str:
    """Return the page of a run, which needs no other file but those of its parts.
    Raises FileFormatError where other results of the run are damaged.
    """
    make_page = registry.get_experiment(result.command).page
    made: str | None = make_page(run, result) if make_page else None
    return made or shown_page(run, result, views.shown(result))


def keep_result(run: RunDirectory, result: AnyResult) -> AnyResult:
    """Write the page and the summary of a result into the open directory of its run,
    and return it.

    The summary is the last file: a run whose disk was full before is not done, and goes
    on.
    """
    write_page(run.path, result)
    run.write_summary(result)
    return result


def shown_page(
    run: Path,
    result: Result,
    given: ShownResult,
    *,
    data: Sequence[Html] = (),
    scripts: Sequence[str] = (),
) -> str:
    """Return what is shown of a result as the page of the run in the folder `run`; data
    and scripts fill the parts that are `live`.
    """
    inside = list[Html | None]()
    # its question names none
    if not any(part.draw or part.figure or part.pictures for part in given.sections):
        for file in sorted((run / IMAGES).glob("*.png")):
            name = file.stem.replace("-", " ").replace("_", " ").capitalize()
            inside.append(
                _figure(run, f"{IMAGES}/{file.name}", f"{name}: {given.said}")
            )
    inside += [
        part_html(run, part, given.said)
        for part in given.sections
        if part.only in ("", "page") and not part.empty
    ]
    parts = list(getattr(result, "parts", ()))
    if parts and all(isinstance(part, str) for part in parts):
        linked = zip(parts, document.part_links(run, parts), strict=True)
        lines = [
            element("li", element("a", name, href=link) if link else name)
            for name, link in linked
        ]
        inside.append(
            element(
                "details",
                element("summary", f"The runs ({len(parts)})"),
                element("ul", *lines),
            )
        )
    main = element("main", *inside, end_html(run, result, given))
    subject = views.subject_of(result, given)
    what = join_html(
        result.command,
        "; " if subject else None,
        document.subject_html(*(("", one) for one in subject)),
    )
    header = document.heading(what, given.said, views.remarks_of(result, given))
    footer = f"run {run.name}. This page needs no other file."
    title = f"{run.name}, {result.command}"
    return document.document(
        title, header, main, data=data, scripts=scripts, footer=footer
    )
