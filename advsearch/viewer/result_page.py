"""`report.html` of a run without a page of its own kind: its figures, a table for each list, and what it cost."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from advsearch.report import wording
from advsearch.report.markup import Html, element, join_html
from advsearch.runs.directory import IMAGES
from advsearch.runs.results.base import Fields, Formation, Result
from advsearch.viewer.document import data_url, document
from advsearch.viewer.study_page import again, facts_table, heading, study_table, subject_html

LONG = 24
"""Rows of a table above which it is folded."""

LARGEST_FIGURE = 2_000_000
"""Bytes of a figure that the page takes along."""

_ELSEWHERE = (
    *("run", "object", "objects", "controls", "environment", "ending", "warnings", "seconds", "command_line"),
    "figures",
)
"""Fields that stand in the heading or below, or nowhere."""


def result_page(run: Path, result: Result) -> str:
    """Return the page of what is in the folder `run`."""
    values = {name: getattr(result, name) for name in type(result).model_fields}
    about = [values.get("object"), *[", ".join(values.get(one) or ()) for one in ("objects", "controls")]]
    what = join_html(result.command, *(join_html("; ", subject_html(("", _text(one)))) for one in about if one))
    tables = [(name, rows) for name, value in values.items() if (rows := _rows(value))]
    rest = {name: value for name, value in values.items() if name not in _ELSEWHERE and not _rows(value)}
    plain = {_words(name): _text(value) for name, value in rest.items()}
    seconds = values.get("seconds")
    if isinstance(seconds, Mapping):
        plain["Time"] = wording.seconds_text(seconds.get("total"))
    main = element(
        "main",
        *_figures(run),
        *(join_html(element("h2", _words(name)), _folded(rows)) for name, rows in tables),
        join_html(element("h2", "Cost and conditions"), facts_table(plain)),
        _meanings(result, plain, [rows for _, rows in tables]),
        again(str(values.get("command_line") or f"advsearch show {run.name}")),
    )
    said = result.brief or str(values.get("ending", "done"))
    header = heading(what, said[:1].upper() + said[1:] + ".", values.get("warnings") or ())
    return document(
        f"{run.name}, {result.command}", header, main, footer=f"run {run.name}. This page needs no other file."
    )


def _figures(run: Path) -> Iterable[Html]:
    for file in sorted((run / IMAGES).glob("*.png")):
        if file.is_file() and not file.is_symlink() and file.stat().st_size <= LARGEST_FIGURE:
            alt = f"{_words(file.stem)}: a figure of the numbers in the tables below"
            picture = element("img", src=data_url(file.read_bytes(), "image/png"), alt=alt)
            yield element("figure", picture, class_="wide")


def _meanings(result: Result, plain: Mapping[str, str], tables: Sequence[Sequence[Fields]]) -> Html | None:
    """What the names on the page mean, as far as the fields say it; folded."""
    of_rows = [(rows[0], set(map(_words, _columns(rows)))) for rows in tables]
    described: list[tuple[Fields, set[str]]] = [(result, {name for name, text in plain.items() if text}), *of_rows]
    found: dict[str, str] = {}
    for one, words in described:
        for name, field in type(one).model_fields.items():
            if field.description and _words(name) in words:
                found.setdefault(_words(name), field.description.replace("`", ""))
    return element("details", element("summary", "What these words mean"), facts_table(found)) if found else None


def _rows(value: object) -> Sequence[Fields]:
    """The rows of a table, where a value is a list of fields."""
    if isinstance(value, (list, tuple)) and value and all(isinstance(one, Fields) for one in value):
        return [one for one in value if isinstance(one, Fields)]
    return ()


def _folded(rows: Sequence[Fields]) -> Html:
    """A table of what differs or is not empty; a long one is folded."""
    names = _columns(rows)
    made = study_table(
        [_words(name) for name in names], [[_text(getattr(row, name, None)) for name in names] for row in rows]
    )
    return made if len(rows) <= LONG else element("details", element("summary", f"{len(rows)} rows"), made)


def _columns(rows: Sequence[Fields]) -> list[str]:
    """The fields that are not empty in every row."""
    names = dict.fromkeys(name for row in rows for name in type(row).model_fields)
    return [name for name in names if any(_text(getattr(row, name, None)) for row in rows)]


def _text(value: object) -> str:
    """A value in a cell."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return "" if value != value else wording.number_text(value)
    if isinstance(value, Formation):
        return wording.formation_text(value)
    if isinstance(value, Fields):
        return _text({name: getattr(value, name) for name in type(value).model_fields})
    if isinstance(value, Mapping):
        return ", ".join(f"{_words(str(name)).lower()} {_text(one)}" for name, one in value.items() if _text(one))
    if isinstance(value, (list, tuple)):
        inner = " to " if len(value) == 2 and all(isinstance(one, float) for one in value) else "; "
        return inner.join(filter(None, map(_text, value)))
    return str(value)


def _words(name: str) -> str:
    """The name of a field as a heading."""
    words = name.replace("_", " ").replace("-", " ")
    return words[:1].upper() + words[1:]
