"""Views of results: the sentences, tables and charts that a user sees of a result.

A view is made once, and then displayed as text in a terminal, as an HTML page, or in a
notebook. An experiment has a function `get_view(result)`; without it, the fields of the
result are displayed with their names and descriptions.

This module also words claims: sentences that the evidence of a run supports, without
exaggeration. There are four kinds:

- `found`: the search found an adversarial scene, and new renders confirm it. The claim
  is that such a configuration exists.
- `not found`: the search ran to its end, and its best configuration was rendered again.
  The claim is that a number of renders of a policy found none; this does not prove that
  there is none.
- `measured`: a fraction of a complete count, with its confidence interval.
- `nothing claimed`: everything else, such as a run that was interrupted or not
  verified, a clean scene about which the model is wrong already, an unknown status, or
  a run that does not measure how often a model is right.
"""

from __future__ import annotations

import base64
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from html import escape
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from advsearch import registry
from advsearch.errors import InputError
from advsearch.report import wording
from advsearch.report.figures import (
    BLUE,
    GREY,
    RED,
    Figures,
    new_axes,
    render_axes,
    render_figure,
)
from advsearch.report.wording import format_extent as format_extent
from advsearch.runs.files import encode_png
from advsearch.runs.results import (
    INTERRUPTED,
    RUNNING,
    AverageCase,
    Fields,
    Formation,
    Result,
    VerifiedRate,
)
from advsearch.runs.results import Extent as Extent
from advsearch.settings import settings

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_UNFOLDED_ROWS = 24  # maximum number of rows of a table that is not folded
_FIELDS_ELSEWHERE = (
    *(
        "run",
        "object",
        "objects",
        "controls",
        "environment",
        "ending",
        "warnings",
        "seconds",
    ),
    *("command_line", "python_only"),
    *("figures", "model", "renders", "seed"),
)
"""Fields that are displayed in the heading or at the end, or not at all."""
Column = str | Callable[[Any], str]
"""How a cell is made from a row: a format, in which the row is `0`, such as
``{0.seconds:.2f}``; or a function of the row.
"""


@dataclass(frozen=True)
class Picture:
    """A picture in the folder of the run, with a caption, after a name if it has one."""

    file: str
    caption: str
    name: str = ""


@dataclass(frozen=True)
class ResultPart:
    """A part of the view of a result. Empty attributes are not displayed.

    Attributes:
        title: title of the part.
        text: paragraphs.
        column_heads: heads of the columns.
        rows: rows of the table as texts, the first of which is the name of the row.
        note: explanation of the table, for a page.
        figure: file of a figure in the folder of the run, for a page.
        pictures: groups of pictures; those of a group are displayed side by side.
        draw: function that draws a chart on axes of matplotlib, for a page; `title` and
            `text` describe it.
        height: height of the chart in CSS pixels.
        size: (width, height) in inches of the figure file of the chart; None to use the
            height of the chart.
        parts: for each row, the name of its run among the parts of the run.
        cell_fractions: fractions in [0, 1], by row and column. The larger one is, the
            stronger is the color of the cell.
        bars: for each row a bar on a page, as (begin, end, mark) in [0, 1]; None for no
            bar.
        layout: layout of the pictures on a page: `pair`, `small`, `large` or `rows`;
            empty to choose it by their number.
        live: name of the part for the script of the page that fills it. Without the
            script the part is hidden.
        folded: whether a page displays it only on request.
        only_medium: `page`, `text` or `notebook` if only this one displays the part;
            empty for all three.
    """

    title: str = ""
    text: Sequence[str] = ()
    column_heads: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()
    note: str = ""
    figure: str = ""
    pictures: Sequence[Sequence[Picture]] = ()
    draw: Callable[[Any], object] | None = None
    height: int = 300
    size: tuple[float, float] | None = None
    parts: Sequence[str | None] = ()
    cell_fractions: Mapping[tuple[int, int], float] = field(default_factory=dict)
    bars: Sequence[tuple[float, float, float] | None] = ()
    layout: str = ""
    live: str = ""
    folded: bool = False
    only_medium: str = ""

    @classmethod
    def make_table(
        cls, rows: Iterable[Any], columns: Mapping[str, Column], **more: Any
    ) -> ResultPart:
        """Return a table with a row for each of some values.

        Args:
            rows: the values.
            columns: what makes a cell from a value, by the head of the column: a
                function, or a text for `str.format`.
            more: other attributes of the part.
        """
        cells = [
            [
                column(row) if callable(column) else column.format(row)
                for column in columns.values()
            ]
            for row in rows
        ]
        return cls(column_heads=tuple(columns), rows=cells, **more)

    @property
    def is_empty(self) -> bool:
        """Whether there is nothing to display."""
        return not (
            any(self.text) or self.rows or self.pictures or self.draw or self.live
        )

    def is_visible_in(self, medium: str) -> bool:
        """Return whether a `page`, `text` or `notebook` shows the part."""
        return self.only_medium in ("", medium) and not self.is_empty


@dataclass(frozen=True)
class ShownResult:
    """The view of a result.

    Attributes:
        statement: the main result, in one or two sentences.
        sections: the other parts.
        facts: other properties of the run by name, in addition to those of all runs
            (environment, renders, time and seed).
        about: names of the subjects of the result; empty for the object, the controls
            and the model.
        cautions: sentences to know before the result is used, in addition to the
            warnings.
        says_interrupted: whether `statement` itself states that an interrupted run was
            interrupted.
    """

    statement: str
    sections: Sequence[ResultPart] = ()
    facts: Mapping[str, str] = field(default_factory=dict)
    about: Sequence[str] = ()
    cautions: Sequence[str] = ()
    says_interrupted: bool = False


def get_view(result: Result) -> ShownResult:
    make_view = registry.get_experiment(result.command).view or make_default_view
    view: ShownResult = make_view(result)
    return view


def has_twins_setting(command: str) -> bool:
    """Return whether a command has the setting `twins`."""
    declared = settings(registry.get_experiment(command).settings)
    return any(setting.field == "twins" for setting in declared)


def list_remarks(result: Result, view: ShownResult) -> list[str]:
    """Return sentences to know before a result is used.

    They are about its status (interrupted or running) and about how far results on
    renders hold for photographs (twins), followed by the cautions and warnings.

    Args:
        result: the result.
        view: its view, which has the cautions.
    """
    ending = getattr(result, "ending", "")
    remarks = []
    # Some views have a statement that says so already.
    if ending == INTERRUPTED and not view.says_interrupted:
        remarks.append("Not finished: these are the results so far.")
    if ending == RUNNING:
        remarks.append("It is running: this is what has come out so far.")
    twins = getattr(result, "twins", None)
    if twins is not None:
        remarks.append(wording.format_twin_evidence(twins))
    elif has_twins_setting(result.command):
        remarks.append(wording.NO_TWINS)
    return [*remarks, *view.cautions, *getattr(result, "warnings", ())]


def list_subjects(result: Result, view: ShownResult) -> list[str]:
    """Return the subjects of a result: its own names, or object, controls and model."""
    if view.about:
        return [*view.about]
    subjects = []
    for name in ("object", "objects", "controls", "model"):
        names = getattr(result, name, None)
        if names:
            subjects.append(names if isinstance(names, str) else ", ".join(names))
    return subjects


def collect_facts(result: Result, view: ShownResult) -> dict[str, str]:
    """Return properties of a run as texts by name, such as the seed.

    Facts of the view come first, and replace common facts of the same name. So a view
    leaves out a common fact by an empty text.

    Args:
        result: the result.
        view: its view, with facts of its own.
    """
    common_facts = {
        # The view lists several environments, and this one is among them.
        "environment": ""
        if "environments" in view.facts
        else getattr(result, "environment", ""),
        "renders": _format_render_count(result),
        "workers": wording.format_workers(getattr(result, "shared", None)),
        "time": _format_total_time(result),
        "seed": str(getattr(result, "seed", "")),
        **result.facts(),
    }
    # The first mapping determines the order, the last one the texts of facts that
    # several have: so facts of the view come first, and with its texts.
    facts = {**view.facts, **common_facts, **view.facts}
    return {name: text for name, text in facts.items() if text}


def _format_render_count(result: Result) -> str:
    """Return the number of renders of a run as text; "" if it is unknown."""
    renders = getattr(result, "renders", None)
    n_renders = sum(renders.values()) if isinstance(renders, Mapping) else renders
    return "" if n_renders is None else str(n_renders)


def _format_total_time(result: Result) -> str:
    """Return the time that a run took as text; "" if it is unknown."""
    seconds = getattr(result, "seconds", None)
    return wording.format_seconds(seconds["total"]) if seconds else ""


def make_default_view(result: Result) -> ShownResult:
    """Return the view of a result whose experiment does not define one.

    Lists of rows become tables, and other fields become facts. A last table explains
    the names of both.
    """
    values = {
        name: getattr(result, name) for name in type(result).get_described_fields()
    }
    row_lists = {name: value for name, value in values.items() if _is_table(value)}
    facts = _find_plain_facts(result, values, row_lists)
    tables = [_make_table(name, rows) for name, rows in row_lists.items()]
    names_of_facts = {name for name, text in facts.items() if text}
    # pairs of an object with fields, and the names of its fields that are on the page
    objects_with_words: list[tuple[Fields, set[str]]] = [(result, names_of_facts)]
    for rows, table in zip(row_lists.values(), tables, strict=True):
        objects_with_words.append((rows[0], set(table.column_heads)))
    sections = [*tables, _explain_words(objects_with_words)]
    # a result without a summary in words has its status as the statement
    brief = result.outcome_summary or str(values.get("ending", "done"))
    statement = f"{brief[:1].upper()}{brief[1:]}."
    return ShownResult(statement, sections, facts)


def _is_table(value: object) -> bool:
    """Return whether a value is a list of rows (`Fields`), and not empty."""
    if not isinstance(value, (list, tuple)) or not value:
        return False
    return all(isinstance(row, Fields) for row in value)


def _find_plain_facts(
    result: Result, values: Mapping[str, Any], tables: Iterable[str]
) -> dict[str, str]:
    """Return the fields of a result that nothing else on the page shows, as texts.

    Args:
        result: the result.
        values: values of its fields by name.
        tables: names of the fields that become tables.
    """
    # `facts` returns names with spaces: "renders per second" for `renders_per_second`
    fact_names = [name.replace(" ", "_") for name in result.facts()]
    excluded = {*_FIELDS_ELSEWHERE, *tables, *fact_names}
    return {
        _format_name(name): _format_value(value)
        for name, value in values.items()
        if name not in excluded
    }


def _make_table(name: str, rows: Sequence[Fields]) -> ResultPart:
    """Return rows as a table, without the columns that are empty in all of them.

    Args:
        name: name of the field that has the rows.
        rows: the rows, which may have different fields.
    """
    columns = _find_filled_columns(rows)
    cells = [
        [_format_value(getattr(row, column, None)) for column in columns]
        for row in rows
    ]
    return ResultPart(
        title=_format_name(name),
        column_heads=list(map(_format_name, columns)),
        rows=cells,
        folded=len(rows) > MAX_UNFOLDED_ROWS,
    )


def _find_filled_columns(rows: Sequence[Fields]) -> list[str]:
    """Return the names of the fields that some row has with a value that is not empty."""
    names = dict.fromkeys(name for row in rows for name in type(row).model_fields)
    return [
        column
        for column in names
        if any(_format_value(getattr(row, column, None)) for row in rows)
    ]


def _explain_words(
    objects_with_words: Iterable[tuple[Fields, set[str]]],
) -> ResultPart:
    """Return a table that explains the names on a page by the descriptions of fields.

    If several fields have the same name, the description of the first one is used.

    Args:
        objects_with_words: objects with fields, each with the names of its fields that
            are on the page.
    """
    meanings = dict[str, str]()
    for fields, words in objects_with_words:
        for name, about in type(fields).get_described_fields().items():
            word = _format_name(name)
            if about.description and word in words:
                meanings.setdefault(word, about.description.replace("`", ""))
    rows = [[word, meaning] for word, meaning in meanings.items()]
    return ResultPart(
        "What these words mean", rows=rows, folded=True, only_medium="page"
    )


def _format_value(value: object) -> str:
    """Return a value as text for a table; None and NaN are empty.

    A list of two floats is written as a range, "0.1 to 0.3". Items of other lists are
    separated by semicolons. Mappings and objects with fields become "name value" pairs.
    """
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return "" if math.isnan(value) else wording.format_number(value)
    if isinstance(value, Formation):
        return wording.format_formation(value)
    if isinstance(value, Fields):
        return _format_value(
            {name: getattr(value, name) for name in type(value).model_fields}
        )
    if isinstance(value, Mapping):
        return _format_mapping(value)
    if isinstance(value, (list, tuple)):
        return _format_items(value)
    return str(value)


def _format_mapping(mapping: Mapping[Any, object]) -> str:
    """Return a mapping as "name value" pairs, without those that are empty."""
    text_by_name = {
        _format_name(str(name)).lower(): _format_value(item)
        for name, item in mapping.items()
    }
    pairs = [f"{name} {text}" for name, text in text_by_name.items() if text]
    return ", ".join(pairs)


def _format_items(items: Sequence[object]) -> str:
    """Return two floats as a range, and items of other lists with semicolons."""
    is_range = len(items) == 2 and all(isinstance(item, float) for item in items)
    texts = [_format_value(item) for item in items]
    separator = " to " if is_range else "; "
    return separator.join(text for text in texts if text)


def _format_name(name: str) -> str:
    words = name.replace("_", " ").replace("-", " ")
    return words[:1].upper() + words[1:]


Kind = Literal["found", "not found", "measured", "nothing claimed"]


class Claim(Fields):
    """A sentence that is supported by the evidence of a run."""

    kind: Kind = Field(
        description="`found`, `not found`, `measured` or `nothing claimed`"
    )
    statement: str
    extent: Extent | None = Field(
        description="the count behind the claim; null if nothing was counted"
    )

    @classmethod
    def from_case(
        cls, name: str, ending: str, rate: VerifiedRate | None, spent: str | None = None
    ) -> Claim:
        """Return the claim about one adversarial scene of several (`make_case_claim`).

        Args:
            name: name of the scene in the claim.
            ending: status of its search, or of its trials.
            rate: rate of its trials.
            spent: the effort of the search as text; None for a known scene that was
                only rendered again.
        """
        return make_case_claim(name, ending, rate, spent)


NOTHING_CLAIMED = "Nothing is claimed"
NO_PROOF = "This does not show that there is none."
# Statuses of a search that ran to its end without finding anything.
FAILED_SEARCH_ENDINGS = ("budget spent", "stalled")


REASON_OF_ENDING = {
    "already wrong": "the model is wrong about the clean scene already",
    "interrupted": "it was interrupted",
    "out of time": "its time was up before its end",
    "not verified": "fresh renders did not confirm what the search found",
    "non-finite objective": "the search broke off, as its objective was not a number",
}


def make_case_claim(
    name: str, ending: str, rate: VerifiedRate | None, spent: str | None
) -> Claim:
    """Return the claim about one adversarial scene of many.

    A confirmed scene gives the claim `found`. If the search found none, the claim is
    `not found`; for a known scene that was only rendered again, and is not confirmed,
    it is `measured`. Otherwise nothing is claimed.

    Args:
        name: name of the scene in the claim.
        ending: status of its search, or of its trials (verification renders).
        rate: rate of its trials; None without trials.
        spent: the effort of the search as text; None for a known scene that was only
            rendered again.
    """
    reason = REASON_OF_ENDING.get(ending, f"it ended as {ending!r}")
    no_claim = make_no_claim(reason, f"This is about {name}.")
    # the count behind the claim
    extent = make_rate_extent("fresh renders that count as a success", rate)
    if rate is None:
        return no_claim
    rate_text = wording.format_rate(rate)
    if ending == "found" and rate.successes:
        statement = f"{name}: an adversarial scene holds in {rate_text}."
        return make_claim("found", statement, extent)
    found_nothing = ending in FAILED_SEARCH_ENDINGS
    if spent is None and (found_nothing or ending == "not verified"):
        # Nothing follows about other scenes, so only the rate of this one is claimed.
        statement = f"{name}: the adversarial scene is not confirmed, in {rate_text}."
        return make_claim("measured", statement, extent)
    if found_nothing:
        best = f"no failure was found; the best configuration counts in {rate_text}"
        statement = f"{name}: {best}. Searched were {spent}. {NO_PROOF}"
        return make_claim("not found", statement, extent)
    return no_claim


def make_average_claim(case: AverageCase, name: str) -> Claim:
    """Return the claim about the average case of an attack.

    It is the accuracy in configurations that are sampled at random from those that the
    search may reach, in contrast to the worst case.
    """
    what = "configurations in which the model is right"
    extent = Extent.from_count(
        what, case.correct, case.configurations, case.interval, counts_right=True
    )
    statement = (
        f"{name}: the model is right in {format_extent(extent)} configurations drawn "
        "by chance from the whole space and budget."
    )
    return make_claim("measured", statement, extent)


def format_searches(renders: Mapping[str, int], policy: str, random: bool) -> str:
    """Return the effort of a search: ``24 renders by the policy auto and 24 by random
    search``.

    Args:
        renders: numbers of renders by purpose, such as "search" and "baseline".
            "products" is the number of images that were predicted by products with a
            matrix, and not rendered.
        policy: policy of the search.
        random: random search ran too, for comparison.
    """
    n_renders = renders.get("search", 0) + renders.get("gradient", 0)
    text = f"{wording.format_count(n_renders, 'render')} by the policy {policy}"
    if renders.get("products"):
        text += f", {renders['products']} more predicted,"
    if random:
        text += f" and {renders.get('baseline', 0)} by random search"
    return text


def make_rate_extent(what: str, rate: VerifiedRate | None) -> Extent | None:
    if rate is None:
        return None
    return Extent.from_count(what, rate.successes, rate.trials, rate.interval)


def make_no_claim(reason: str, more: str = "") -> Claim:
    statement = f"{NOTHING_CLAIMED}: {reason}."
    if more:
        statement += f" {more}"
    return make_claim("nothing claimed", statement, extent=None)


def make_claim(kind: Kind, text: str, extent: Extent | None) -> Claim:
    return Claim(kind=kind, statement=text, extent=extent)


# --------------------------------------------------------------------------------
# HTML that is escaped by construction: text becomes markup only through `make_element`.
#
# Also the display of results in a notebook (statement, pictures or a figure, and tables,
# without styles), and charts inside of a page. The colors of these charts come from the
# style sheet of the page, so that they follow its light or dark scheme.

_VOID = frozenset({"meta", "img", "br", "hr", "input", "link"})


class Html(str):
    """HTML that may be inserted into a page without escaping."""

    __slots__ = ()


def make_element(tag: str, *children: str | None, **attributes: str | float) -> Html:
    """Return an HTML element, in which all text is escaped.

    Args:
        tag: name of the element, such as "p".
        children: its content: markup (`Html`), or text that is escaped; None is left
            out.
        attributes: its attributes; ``class_`` stands for ``class``, and underscores in
            other names become hyphens.
    """
    names = {"class_": "class", "viewBox": "viewBox"}
    attribute_text = "".join(
        f' {names.get(name, name.replace("_", "-"))}="{escape(str(value), quote=True)}"'
        for name, value in attributes.items()
    )
    if tag in _VOID:
        return Html(f"<{tag}{attribute_text}>")
    return Html(f"<{tag}{attribute_text}>{join_html(*children)}</{tag}>")


def join_html(*parts: str | None) -> Html:
    """Return the parts one after the other, escaped where they are not `Html`."""
    return Html(
        "".join(
            part if isinstance(part, Html) else escape(part)
            for part in parts
            if part is not None
        )
    )


DISPLAY_WIDTH = 224  # width of a picture on the page in pixels
GAP = 4  # gap between pictures in pixels
PIXELS_PER_INCH = 94  # pixels of a chart's height for an inch of its figure file
FIGURE_WIDTH = 6.2  # width of a figure file in inches


class InNotebook:
    """The display of a result in a notebook: its view as HTML, a figure and a table."""

    tabular: ClassVar[str] = "table"
    """The name of the field with the table."""

    def plot(self, axes: Any = None) -> Any:
        """Draw the first chart of the result, and return the matplotlib axes.

        Nothing is drawn if the result has no chart.

        Args:
            axes: axes to draw on; None makes new ones.
        """
        if axes is None:
            axes = new_axes()
        view = get_view(self)  # type: ignore[arg-type]
        for part in view.sections:
            if part.draw is not None:
                part.draw(axes)
                break
        return axes

    def to_pandas(self) -> Any:
        """Return the rows of the result's table as a `pandas.DataFrame`.

        The columns have the names of fields in `summary.json`.

        Raises:
            InputError: it has no table.
        """
        rows = getattr(self, self.tabular, None)
        if rows is None:
            raise InputError(
                f"to_pandas: the result of {getattr(self, 'command', '')} has no table"
            )
        from pandas import json_normalize  # takes half a second

        return json_normalize([row.to_dict() for row in rows])

    def _repr_html_(self) -> str:
        return make_notebook_html(get_view(self))  # type: ignore[arg-type]

    def _repr_png_(self) -> bytes | None:
        return render_result_figure(get_view(self)).get("png")  # type: ignore[arg-type]


def make_notebook_html(
    view: ShownResult, pictures: Mapping[str, ArrayLike] | None = None
) -> str:
    """Return a result as HTML for a notebook.

    Args:
        view: the view of the result, with its sentence, charts and tables.
        pictures: images (H, W, 3) by name, which come first; None for none.
    """
    figures = [
        _make_figure_html(name, image) for name, image in (pictures or {}).items()
    ]
    chart = _make_chart_image(view)
    sections = [
        _make_section_html(part)
        for part in view.sections
        if part.is_visible_in("notebook")
    ]
    return make_element(
        "div", make_element("p", view.statement), *figures, chart, *sections
    )


def _make_chart_image(view: ShownResult) -> Html | None:
    """Return the charts of a result as an image element; None if it has none."""
    figure = render_result_figure(view)
    if not figure:
        return None
    return _make_image(figure["png"], 2 * DISPLAY_WIDTH, "the numbers of the table")


def _make_figure_html(name: str, image: ArrayLike) -> Html:
    """Return an image (H, W, 3) as HTML, with its name as the caption."""
    picture = _make_image(encode_png(image), DISPLAY_WIDTH, name)
    caption = make_element("figcaption", name)
    return make_element("figure", picture, caption, style="display:inline-block")


def _make_section_html(part: ResultPart) -> Html:
    """Return the texts and the table of a part of a result as HTML."""
    # the texts of a chart describe it, and the chart itself is not displayed here
    texts = part.text if part.draw is None else ()
    children = [make_element("p", text) for text in texts if text]
    if part.rows:
        children.append(_make_table_html(part))
    if part.folded:
        return make_element("details", make_element("summary", part.title), *children)
    title = make_element("p", make_element("b", part.title)) if part.title else None
    return make_element("div", title, *children)


def _make_table_html(part: ResultPart) -> Html:
    """Return the table of a part of a result as HTML."""
    heads = make_element(
        "tr", *(make_element("th", cell) for cell in part.column_heads)
    )
    head = make_element("thead", heads) if part.column_heads else None
    rows = [
        make_element("tr", *(make_element("td", cell) for cell in row))
        for row in part.rows
    ]
    return make_element("table", head, make_element("tbody", *rows))


def render_result_figure(view: ShownResult) -> Figures:
    """Return the files of the first chart of a result; none if it has no chart."""
    for part in view.sections:
        if part.draw is not None:
            default_size = (FIGURE_WIDTH, part.height / PIXELS_PER_INCH)
            return render_axes(part.draw, part.size or default_size)
    return {}


def join_images(pictures: Sequence[ArrayLike]) -> bytes:
    """Return images (H, W, 3) of one height side by side as a PNG, with white gaps."""
    images = [np.asarray(picture, dtype=np.float32) for picture in pictures]
    gap = np.ones((len(images[0]), GAP, 3), np.float32)
    blocks = [images[0]]
    for image in images[1:]:
        blocks += [gap, image]
    return encode_png(np.concatenate(blocks, axis=1))


def _make_image(png: bytes, width: int, alt: str) -> Html:
    """Return a PNG as an image element that holds its bytes; `width` is in pixels."""
    return make_element(
        "img",
        src=f"data:image/png;base64,{base64.b64encode(png).decode()}",
        width=width,
        alt=alt,
    )


CHART_HEIGHT = 300
WIDE_WIDTH = 720
NARROW_WIDTH = 350
"""Height and widths of a chart in CSS pixels. A page has a wide chart for a screen and
a narrow one for a phone, on which the letters of the wide one would be too small. The
style sheet displays one of them.
"""
COLORS = {
    "search": "#010101",
    "baseline": "#020202",
    "soft": "#030303",
    "line": "#040404",
}
"""Variables of the style sheet for colors. While matplotlib draws, each is represented
by a color that does not occur otherwise; it is replaced in the SVG.
"""
# Variables that replace the usual colors of figures.
FIGURE_COLORS = {"search": BLUE, "baseline": RED, "soft": GREY}
STYLE: dict[Any, Any] = {
    "font.size": 13.0,
    "path.simplify": False,
    "legend.fontsize": 13.0,
    "legend.labelcolor": "linecolor",
    "legend.borderpad": 0.0,
    "legend.handlelength": 1.6,
    "axes.spines.left": False,
    "axes.grid.axis": "y",
    "axes.grid": True,
    **dict.fromkeys(
        ("axes.edgecolor", "grid.color", "xtick.color", "ytick.color"), COLORS["line"]
    ),
    **dict.fromkeys(
        ("axes.labelcolor", "text.color", "xtick.labelcolor", "ytick.labelcolor"),
        COLORS["soft"],
    ),
    **dict.fromkeys(("xtick.major.size", "ytick.major.size"), 0.0),
    **dict.fromkeys(
        ("figure.facecolor", "axes.facecolor", "savefig.facecolor"), "none"
    ),
}


def make_chart_svg(
    draw: Callable[[Axes], object],
    description: str,
    width: int = WIDE_WIDTH,
    height: int = CHART_HEIGHT,
) -> Html:
    """Return a chart as an SVG element for a page.

    The title of the axes is left out, since the page has a heading. The legend stands
    above the chart, in the color of the page's text.

    Args:
        draw: function that draws on axes of matplotlib.
        description: the text for readers who cannot see the chart.
        width: width in CSS pixels.
        height: height in CSS pixels.
    """
    # matplotlib writes SVG files with 72 pixels for an inch
    size_in_inches = (width / 72, height / 72)
    draw_page_chart = partial(_draw_page_chart, draw, width)
    files = render_figure(draw_page_chart, size_in_inches, kinds=("svg",), style=STYLE)
    return make_element(
        "svg",
        make_element("title", description),
        # with the width, the ids of two charts on a page differ
        _make_inline_svg(files["svg"].decode("utf-8"), prefix=f"{width}-"),
        viewBox=f"0 0 {width} {height}",
        class_="chart wide" if width == WIDE_WIDTH else "chart narrow",
        role="img",
        aria_label=description,
    )


def _draw_page_chart(
    draw: Callable[[Axes], object], width: int, figure: Figure
) -> None:
    """Draw a chart, with a single legend above it and without a title.

    Args:
        draw: function that draws on axes of matplotlib.
        width: width in CSS pixels.
        figure: the empty figure.
    """
    axes = figure.subplots()
    draw(axes)
    axes.set_title("")
    # the figure gets a legend above the axes in place of all others
    axes_legend = axes.get_legend()
    if axes_legend is not None:
        axes_legend.remove()
    for legend in [*figure.legends]:
        legend.remove()
    columns = 1 if width == NARROW_WIDTH else 2
    figure.legend(loc="outside upper left", ncols=columns, labelcolor=COLORS["soft"])


_UNNEEDED_IN_SVG = (
    r"<clipPath.*?</clipPath>",
    r"<!--.*?-->",
    r' clip-path="[^"]*"',
    # Digits after the first decimal: they follow "1.2", and are inside of a tag, since
    # ">" is the next angle bracket.
    r"(?<=\d\.\d)\d+(?=[^<>]*>)",
)
"""Patterns of what is left out of an SVG file that is inserted into a page."""


def _make_inline_svg(svg: str, prefix: str) -> Html:
    """Return the shapes of an SVG file as small markup to insert into a page.

    Left out are the head of the file, clipping paths (everything is inside of them
    anyway), decimals of coordinates after the first one, and ids without references.
    All other ids get a prefix, so that two charts on one page have no id in common.
    Colors become variables of the page's style sheet.

    Args:
        svg: content of the file that matplotlib wrote.
        prefix: prefix of the ids.
    """
    # from the first group of shapes to the end of the file
    shapes = svg[svg.index("<g ") : svg.rindex("</svg>")]
    shapes = re.sub("|".join(_UNNEEDED_IN_SVG), "", shapes, flags=re.DOTALL)
    shapes = _prefix_ids(shapes, prefix)
    shapes = re.sub(r"<defs>\s*</defs>", "", shapes)
    for name, color in (*COLORS.items(), *FIGURE_COLORS.items()):
        shapes = shapes.replace(color, f"var(--{name})")
    return Html(shapes)


def _prefix_ids(shapes: str, prefix: str) -> str:
    """Return markup with a prefix before its ids, without ids that nothing refers to."""
    # Only `href` still refers to ids, since the clipping paths are gone.
    referenced_ids = set(re.findall(r'href="#([^"]+)"', shapes))
    # The ids first, then the references to them, get the prefix.
    shapes = re.sub(
        r' id="([^"]*)"',
        lambda match: f' id="{prefix}{match[1]}"' if match[1] in referenced_ids else "",
        shapes,
    )
    return re.sub(r'href="#', f'href="#{prefix}', shapes)
