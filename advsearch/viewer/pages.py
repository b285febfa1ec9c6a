"""Make `report.html` of a run: the page of its experiment, or a page from its result.

The object of an attack can be rotated there: `object.js` draws the run's binary glTF.
"""

from __future__ import annotations

import base64
import json
import shlex
import struct
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from advsearch import registry
from advsearch.errors import FileFormatError
from advsearch.report import views
from advsearch.report.views import (
    Html,
    Picture,
    ResultPart,
    ShownResult,
    join_html,
    make_element,
)
from advsearch.runs.directory import CONFIG, IMAGES, OBJECT_FILE, REPORT, RunDirectory
from advsearch.runs.files import shrink_png
from advsearch.runs.results import Result
from advsearch.runs.summary import read_result
from advsearch.settings import format_python_only
from advsearch.trust.named_files import is_inside
from advsearch.trust.stored_files import read_bytes
from advsearch.trust.writing import write_text
from advsearch.viewer import document

# maximum bytes of an image that is embedded
MAX_FIGURE_BYTES = 2_000_000
# maximum bytes of a PNG that is read to be scaled down
MAX_PNG_BYTES = 50_000_000
MAX_UNSCALED_BYTES = 1_000_000
"""Bytes above which a PNG is scaled down in the page; its file stays as it is."""
# longest side of a PNG that is scaled down, pixels
MAX_SCALED_SIZE = 640
# media types of images
MEDIA_TYPES = {".png": "image/png", ".jpg": "image/jpeg", ".jpeg": "image/jpeg"}


def find_image(
    run: Path, name: str | Path, max_bytes: int = MAX_FIGURE_BYTES
) -> Path | None:
    """Return the path of an image in a run; None if it cannot be embedded.

    It cannot if it is missing, too large, or outside of the run: the name comes from a
    summary that somebody else may have written, and could lead to any file.

    Args:
        run: directory of the run.
        name: path of the image, relative to the run.
        max_bytes: maximum size of the file.
    """
    file = run / name
    if not is_inside(file, run) or not file.is_file():
        return None
    return file if file.stat().st_size <= max_bytes else None


def make_part(run: Path, part: ResultPart, description: str) -> Html:
    """Return a part of a result as HTML.

    A part that a script fills (`live`) is hidden until the script runs. A folded part
    displays its title, and opens at a click.

    Args:
        run: directory of the run.
        part: part of its result.
        description: text that describes the chart if the part has no text.
    """
    content = _part_content(run, part, description)
    title = make_element("h2", part.title) if part.title else None
    if part.live:
        return make_element(
            "div",
            title,
            make_element("div", id=part.live),
            content,
            hidden="hidden",
            class_="screen",
        )
    if part.folded:
        return make_element("details", make_element("summary", part.title), content)
    return join_html(title, content)


def _part_content(run: Path, part: ResultPart, description: str) -> Html:
    """Return the content of a part: text, chart or figure, table, images and note.

    Args:
        run: directory of the run.
        part: part of its result.
        description: text that describes the chart to users who cannot see it, if the
            part has no text.
    """
    content = list[Html | None]()
    if part.draw is not None:
        content.append(_make_charts(part.draw, part, description))
    else:
        content += [make_element("p", text) for text in part.text if text]
        alt = " ".join(part.text) or part.title
        content.append(_embed_figure(run, part.figure, alt))
    content.append(_make_part_table(run, part))
    for group in part.pictures:
        content.append(_embed_images(run, group, part.layout))
    if part.note:
        content.append(make_element("p", part.note, class_="soft"))
    return join_html(*content)


def _make_part_table(run: Path, part: ResultPart) -> Html | None:
    """Return the table of a part; None if it has no rows."""
    if not part.rows:
        return None
    if not part.column_heads:  # the rows are pairs of a name and a value
        return document.facts_table({row[0]: row[1] for row in part.rows})
    links = document.link_parts(run, part.parts)
    return document.make_table(
        part.column_heads, part.rows, links, part.cell_fractions, part.bars
    )


def _make_charts(
    draw: Callable[[Any], object], part: ResultPart, description: str
) -> Html:
    """Return the chart of a part in two sizes.

    Args:
        draw: function that draws it on axes of matplotlib.
        part: the part.
        description: text for users who cannot see it, if the part has no text.
    """
    alt = " ".join([f"{part.title}.", *(part.text or [description])])
    # The page has a wide chart and a narrow one. Its style sheet displays the one that
    # fits the window.
    charts = [
        views.make_chart_svg(draw, alt, width, part.height)
        for width in (views.WIDE_WIDTH, views.NARROW_WIDTH)
    ]
    return make_element("div", *charts)


def _embed_images(run: Path, group: Iterable[Picture], layout: str) -> Html | None:
    """Return images side by side with captions, None if no file can be embedded.

    Args:
        run: directory of the run.
        group: its images.
        layout: CSS class of the layout; "" for the one that suits their number.
    """
    figures = []
    for picture in group:
        data = _read_image(run, picture)
        if data is not None:
            figures.append(_make_figure(picture, data))
    if not figures:
        return None
    is_pair = len(figures) <= 2
    if not layout and is_pair:
        layout = "pair"
    return make_element("div", *figures, class_=f"pictures {layout}".strip())


def _make_figure(picture: Picture, data: bytes) -> Html:
    """Return an image with its caption; `data` is the content of its file."""
    media_type = MEDIA_TYPES[Path(picture.file).suffix.lower()]
    image = make_element(
        "img",
        src=document.make_data_url(data, media_type),
        alt=": ".join(filter(None, (picture.name, picture.caption))),
        data_picture=Path(picture.file).stem,
    )
    name = [make_element("strong", picture.name), ": "] if picture.name else []
    caption = make_element("figcaption", *name, picture.caption)
    return make_element("figure", image, caption)


def _read_image(run: Path, picture: Picture) -> bytes | None:
    """Return the bytes of an image to embed; None if it cannot be embedded.

    A large PNG is scaled down. The result is None if the file is missing or too large.
    """
    is_png = picture.file.lower().endswith(".png")
    # a PNG is scaled down, so that it may be larger
    max_bytes = MAX_PNG_BYTES if is_png else MAX_FIGURE_BYTES
    file = find_image(run, picture.file, max_bytes)
    if file is None:
        return None
    data = file.read_bytes()
    if is_png and len(data) > MAX_UNSCALED_BYTES:
        return shrink_png(data, MAX_SCALED_SIZE)
    return data


def _embed_figure(run: Path, name: str, alt: str) -> Html | None:
    """Return a wide figure of a run as HTML; None if there is no such file that can be
    embedded.
    """
    file = find_image(run, name) if name else None
    if file is None:
        return None
    image = make_element(
        "img", src=document.make_data_url(file.read_bytes(), "image/png"), alt=alt
    )
    return make_element(
        "figure", document.make_scrollable(image, "wide"), class_="wide"
    )


def make_page_end(run: Path, result: Result, view: ShownResult) -> Html:
    """Return the end of a page: cost and conditions, commands, and all settings.

    The commands resume a run that was stopped, and repeat a run.
    """
    facts = views.collect_facts(result, view)
    facts_html = document.facts_table(
        {name[:1].upper() + name[1:]: text for name, text in facts.items()}
    )
    content = [make_element("h2", "Cost and conditions"), facts_html]
    if result.is_unfinished:
        resume = shlex.join(["advsearch", "resume", str(run)])
        content += _make_command("Go on", resume)
    config_file = run / CONFIG
    content += _explain_repeat(result, config_file)
    if config_file.is_file():
        content += _make_settings_html(config_file)
    return join_html(*content)


def _explain_repeat(result: Result, config_file: Path) -> list[Html]:
    """Return the command that repeats a run, or why there is none.

    Args:
        result: result of the run.
        config_file: file with its settings, which may be missing.
    """
    # parts that exist only in a Python session, so that no file can name them
    python_only = getattr(result, "python_only", [])
    if python_only:
        repeat = f"No command repeats this: {format_python_only(python_only)}"
        return _make_command("Do it again", repeat)
    if config_file.is_file():
        repeat = shlex.join(["advsearch", "run", str(config_file)])
        return _make_command("Do it again", repeat)
    return []


def _make_settings_html(config_file: Path) -> list[Html]:
    """Return the settings in a file, folded, in a list; an empty list if it is empty."""
    settings = config_file.read_text(encoding="utf-8", errors="replace")
    if not settings:
        return []
    settings_html = make_element("pre", settings, class_="wrap")
    summary = make_element("summary", "All settings")
    return [make_element("details", summary, settings_html)]


def _make_command(title: str, command: str) -> list[Html]:
    """Return a title and a command to type, or why there is none."""
    return [make_element("h2", title), make_element("pre", command, class_="wrap")]


AnyResult = TypeVar("AnyResult", bound=Result)
# maximum bytes of an object that is embedded
MAX_OBJECT_BYTES = 2_700_000
_HINT = (
    "Drag it, or choose it and press the arrow keys. It is lit evenly here, not "
    "by the scene's light."
)


def read_object(run: Path) -> bytes:
    """Read a run's object as binary glTF; empty if there is none that can be
    embedded.
    """
    try:
        data = read_bytes(run / OBJECT_FILE, "an object to turn", MAX_OBJECT_BYTES)
    except (OSError, FileFormatError):
        return b""
    return data if _read_header(data) else b""


def make_object_part(data: bytes) -> ResultPart:
    """Return the part in which a script draws the object; empty without an object."""
    if not data:
        return ResultPart()
    # the note about the object that `encode_glb` has written into the file
    extras = _read_header(data).get("asset", {}).get("extras", {})
    note = str(extras.get("note", "")) if isinstance(extras, dict) else ""
    return ResultPart(
        "The object, to turn",
        note=" ".join(filter(None, (_HINT, note))),
        live="object",
    )


def make_object_data(data: bytes) -> list[Html]:
    """Return the object as data of a page, empty without an object."""
    if not data:
        return []
    text = base64.b64encode(data).decode("ascii")
    return [document.make_data_script(text, "object-file")]


def _read_header(data: bytes) -> dict[str, dict[str, object]]:
    """Return the JSON header of a binary glTF file; empty if the file is corrupt."""
    try:
        # magic, version and length of the file; then length and kind of its first chunk
        magic, _, _, length, kind = struct.unpack_from("<4sII I4s", data)
        if (magic, kind) != (b"glTF", b"JSON"):
            return {}
        begin = struct.calcsize("<4sII I4s")  # the JSON follows these fields
        header = json.loads(data[begin : begin + length])
    except (struct.error, ValueError, RecursionError):
        return {}
    if not isinstance(header, dict) or not isinstance(header.get("asset"), dict):
        return {}
    return header


def write_page(run: Path, result: Result | None = None) -> Path:
    """Write `report.html` of a result, by default of the run's, and return its path.

    Raises:
        FileFormatError: if results of the run are corrupt.
        StorageError: if the page cannot be written.
    """
    page = make_run_page(run, result or read_result(run))
    return write_text(run / REPORT, page, durable=False)


def make_run_page(run: Path, result: Result) -> str:
    """Return the page of a run, which needs no other files but those of its parts.

    Raises:
        FileFormatError: if other results of the run are corrupt.
    """
    make_page = registry.get_experiment(result.command).page
    page: str | None = make_page(run, result) if make_page else None
    return page or make_view_page(run, result, views.get_view(result))


def write_result(run: RunDirectory, result: AnyResult) -> AnyResult:
    """Write the page and the summary of a result into the directory of its run.

    The summary is the last file: a run whose disk was full before counts as unfinished,
    and can be resumed.
    """
    write_page(run.path, result)
    run.write_summary(result)
    return result


def make_view_page(
    run: Path,
    result: Result,
    view: ShownResult,
    *,
    data: Sequence[Html] = (),
    scripts: Sequence[str] = (),
) -> str:
    """Return the page of a run as HTML.

    Args:
        run: directory of the run.
        result: result of the run.
        view: the parts of the result that are displayed, and a statement about it.
        data: scripts that only hold data.
        scripts: names of files with scripts that fill the parts that are `live`.
    """
    content = _make_page_content(run, result, view)
    eyebrow = _make_eyebrow(result, view)
    return document.make_document(
        f"{run.name}, {result.command}",
        document.make_header(eyebrow, view.statement, views.list_remarks(result, view)),
        make_element("main", *content, make_page_end(run, result, view)),
        data=data,
        scripts=scripts,
        footer=f"run {run.name}. This page needs no other file.",
    )


def _make_page_content(
    run: Path, result: Result, view: ShownResult
) -> list[Html | None]:
    """Return the images and parts of a result, and the list of the run's parts.

    Args:
        run: directory of the run.
        result: result of the run.
        view: the parts of the result that are displayed.
    """
    content = list[Html | None]()
    has_chosen_images = any(
        part.draw or part.figure or part.pictures for part in view.sections
    )
    if not has_chosen_images:  # then all images of the run are displayed
        content += _embed_all_images(run, view)
    for part in view.sections:
        if part.is_visible_in("page"):
            content.append(make_part(run, part, view.statement))
    content.append(_list_parts(run, list(getattr(result, "parts", ()))))
    return content


def _make_eyebrow(result: Result, view: ShownResult) -> Html:
    """Return the line above the statement: the command and the subjects of a result."""
    subjects = views.list_subjects(result, view)
    # `make_subject_html` takes pairs of a prefix and a name; here there is no prefix
    return join_html(
        result.command,
        "; " if subjects else None,
        document.make_subject_html(*(("", name) for name in subjects)),
    )


def _embed_all_images(run: Path, view: ShownResult) -> list[Html | None]:
    """Return all images of a run as figures, for a result that names none."""
    figures = []
    for file in sorted((run / IMAGES).glob("*.png")):
        name = file.stem.replace("-", " ").replace("_", " ").capitalize()
        alt = f"{name}: {view.statement}"
        figures.append(_embed_figure(run, f"{IMAGES}/{file.name}", alt))
    return figures


def _list_parts(run: Path, parts: list[object]) -> Html | None:
    """Return a folded list of the runs that a run consists of, with links to their
    pages; None if there are none, or they are something else than names.
    """
    names = [part for part in parts if isinstance(part, str)]
    if not parts or len(names) < len(parts):
        return None
    items = []
    for name, link in zip(names, document.link_parts(run, names), strict=True):
        items.append(
            make_element("li", make_element("a", name, href=link) if link else name)
        )
    summary = make_element("summary", f"The runs ({len(names)})")
    return make_element("details", summary, make_element("ul", *items))
