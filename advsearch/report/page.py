"""`report.html`: one self-contained page about one run. No scripts, no links to elsewhere."""

from __future__ import annotations

import base64
import re
import shlex
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from advsearch import __version__
from advsearch.report import wording
from advsearch.report.charts import NARROW, WIDE, Curve, objective_chart
from advsearch.report.markup import Html, element, join
from advsearch.report.phrases import SUCCESS_ABOVE_ZERO, answer_text, marks_text
from advsearch.report.style import CSS
from advsearch.runs import directory, images, store
from advsearch.runs.files import write_text
from advsearch.runs.results.attack import AttackSummary, UsualAnswer
from advsearch.runs.summary import attack_of

LARGE_PICTURE = 1_000_000
"""Bytes above which a PNG is put into the page at a smaller size; the file itself stays as it is."""

SMALLER_SIDE = 640
"""Longest side in pixels of such a smaller picture."""

MOST_TRIALS = 24
"""Pictures of the verification that the page shows."""

_KINDS = {".png": "image/png", ".gif": "image/gif"}
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


@dataclass(frozen=True)
class RunData:
    """What a run left behind, as far as the page shows it.

    Attributes:
        path: the run directory.
        summary: of `summary.json`.
        recipe: the text of `run.yaml`; empty when there is none.
        pictures: path inside the run directory to a data URL, sorted.
        curves: kind of evaluation to its objectives in order.
    """

    path: Path
    summary: AttackSummary
    recipe: str
    pictures: Mapping[str, str]
    curves: Mapping[str, list[float | None]]


def write_report(run: str | Path) -> Path:
    """Write `report.html` into the directory of a run that has its summary, and return its path.

    Raises:
        FileFormatError: there is no summary, or the results are damaged.
        StorageError: the page cannot be written.
    """
    data = read_run(Path(run))
    return write_text(data.path / directory.REPORT, page(data), durable=False)


def read_run(path: Path) -> RunData:
    """Return what the run in `path` left behind; errors as for `write_report`."""
    recipe = path / directory.CONFIG
    return RunData(
        path=path,
        summary=attack_of(path),
        recipe=recipe.read_text(encoding="utf-8", errors="replace") if recipe.is_file() else "",
        pictures=_read_pictures(path),
        curves=_read_curves(path / store.NAME),
    )


def page(data: RunData) -> str:
    """Return the page as HTML."""
    summary = data.summary
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", http_equiv="Content-Security-Policy", content=_POLICY),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", name="color-scheme", content="light dark"),
        element("title", f"{wording.title(summary)} - advsearch"),
        element("style", Html(CSS)),
    )
    main = element(
        "main",
        _pictures(data),
        _textures(data),
        _rates(summary),
        _curve(data),
        _cost(summary),
        _repeat(data),
    )
    footer = element("footer", f"advsearch {__version__}, run {data.path.name}. This page needs no other file.")
    body = Html(re.sub(r"(\d) %", r"\1&nbsp;%", element("body", _header(summary), main, footer)))
    return "<!doctype html>\n" + element("html", head, body, lang="en") + "\n"


def _header(summary: AttackSummary) -> Html:
    remarks = [element("li", text) for text in wording.remarks(summary)]
    model, environment = (wording.short_name(name) for name in (summary.model, summary.environment))
    what = f"{wording.budget_text(summary)}; object {wording.noun(summary)}, environment {environment}, model {model}"
    return element(
        "header",
        element("p", what, class_="eyebrow"),
        element("h1", wording.verdict(summary)),
        element("ul", *remarks, class_="remarks") if remarks else None,
    )


def _pictures(data: RunData) -> Html:
    summary = data.summary
    clean, adversarial = summary.clean, summary.adversarial
    gain = f"{images.DIFFERENCE_GAIN:g} times magnified, grey where nothing changed"
    shown = [
        _figure(data, "images/clean.png", "Clean", _answer(summary, clean)),
        _figure(data, "images/adversarial.png", "Adversarial", _answer(summary, adversarial)),
        _figure(data, "images/difference.png", "Difference", gain),
    ]
    answered = [
        _figure(data, "images/clean-answer.png", "Clean", _answer(summary, clean)),
        _figure(data, "images/adversarial-answer.png", "Adversarial", _answer(summary, adversarial)),
    ]
    trials = [name for name in data.pictures if name.startswith("images/verification")]
    trials = ([name for name in trials if name.endswith("-answer.png")] or trials)[:MOST_TRIALS]
    animation = _figure(data, "images/search.gif", "", "from the first step to the last")
    return join(
        _section("What the model sees", shown),
        _section("What it answers", answered, "large", marks_text(summary.task)),
        _details("Pictures of the verification", [_figure(data, name, "", _trial(name)) for name in trials], "small"),
        _details("The search as an animation", [animation], "single"),
    )


def _textures(data: RunData) -> Html:
    original = _figure(data, "artifacts/texture-original.png", "Original", "texture as it was")
    changed = _figure(data, "artifacts/texture.png", "Adversarial", "texture that was found; artifacts/texture.png")
    return _section("The texture", [original, changed], "pair")


def _rates(summary: AttackSummary) -> Html:
    control, average, baseline = summary.clean.control, summary.average, summary.baseline
    success, rows = wording.success(summary), []
    if control:
        rows.append(("Clean scene (control group)", "right", control.correct, control.trials, control.interval))
    random = f"{baseline.policy.capitalize()} search" if baseline else ""
    for name, rated in (("Adversarial", summary.verified), (random, baseline.verified if baseline else None)):
        if rated:
            rows.append((name, success, rated.successes, rated.trials, rated.interval))
    if average:
        average_case = "Average case (random configurations)"
        rows.append((average_case, "right", average.correct, average.configurations, average.interval))
    lines = [
        element(
            "tr",
            element("th", name, scope="row"),
            element("td", what),
            element("td", f"{number} of {trials}", class_="number"),
            element("td", wording.interval_text(interval), class_="number"),
            element("td", _bar(number / trials, interval), class_="hide-small"),
        )
        for name, what, number, trials, interval in rows
    ]
    if not lines:
        return Html("")
    heads = ("Configuration", "Model is", "Renders", "95 % interval")
    head = element("tr", *(element("th", text, scope="col") for text in heads), element("th", "", class_="hide-small"))
    spp = summary.verified.spp if summary.verified else None
    note = "Fresh seeds, pictures rounded to 8 bits, Clopper-Pearson intervals"
    return join(
        element("h2", "Verified rates"),
        element("div", element("table", element("thead", head), element("tbody", *lines)), class_="scroll"),
        element("p", note + (f", {spp} samples per pixel." if spp else "."), class_="soft"),
    )


def _bar(rate: float, interval: tuple[float, float]) -> Html:
    """A bar from 0 to 1 with the confidence interval and the rate on it; decoration beside the numbers."""
    low, high = interval
    return element(
        "div",
        element("span", style=f"left: {low:.1%}; width: {high - low:.1%}", class_="range"),
        element("span", style=f"left: {rate:.1%}", class_="mark"),
        class_="interval",
        aria_hidden="true",
    )


def _curve(data: RunData) -> Html:
    known = (("search", data.summary.policy), ("baseline", "random"))
    curves = [
        Curve(name, kind, data.curves[kind])
        for kind, name in known
        if any(value is not None for value in data.curves.get(kind, ()))
    ]
    if not curves:
        return Html("")
    objective = data.summary.objective
    above = "right" if data.summary.minimises else wording.success(data.summary)
    zero = f"above: {above}" if objective in SUCCESS_ABOVE_ZERO else ""
    charts = [objective_chart(curves, objective, zero, width) for width in (WIDE, NARROW)]
    note = "Lines: the best so far. Dots: each evaluation. These are the search's claims; the table above is verified."
    return join(
        element("h2", "The search"),
        element("div", *charts),
        element("p", note, class_="soft"),
    )


def _cost(summary: AttackSummary) -> Html:
    seconds = summary.seconds
    parts = ", ".join(f"{name} {wording.seconds_text(value)}" for name, value in seconds.items() if name != "total")
    total = wording.seconds_text(seconds["total"])
    facts = {
        "Ending": summary.ending,
        "Policy": f"{summary.policy}, {wording.count(summary.steps, 'step')}",
        "Goal": wording.goal_text(summary),
        "Budget": wording.budget_text(summary),
        "Over": wording.over_text(summary),
        "Smallest epsilon": wording.smallest_text(summary),
        "Renders": wording.renders_text(summary),
        "Time": f"{total} ({parts})" if parts else total,
        "Image formation": wording.formation_text(summary.image_formation),
        "Object": summary.object,
        "Environment": summary.environment,
        "Model": summary.model,
        "Seed": str(summary.seed),
    }
    return join(element("h2", "Cost and conditions"), _table_of_facts(facts))


def _repeat(data: RunData) -> Html:
    commands = [shlex.join(["advsearch", "run", f"{data.summary.run or data.path}/{directory.CONFIG}"])]
    if data.summary.command_line:
        commands.append(data.summary.command_line)
    recipe = (
        element("details", element("summary", "All settings"), element("pre", data.recipe)) if data.recipe else None
    )
    return join(element("h2", "Do it again"), *(element("pre", text, class_="wrap") for text in commands), recipe)


def _section(heading: str, figures: Iterable[Html | None], css: str = "", note: str = "") -> Html:
    shown = [figure for figure in figures if figure is not None]
    if not shown:
        return Html("")
    remark = element("p", note, class_="soft") if note else None
    return join(element("h2", heading), element("div", *shown, class_=f"pictures {css}".strip()), remark)


def _details(heading: str, figures: Iterable[Html | None], css: str = "") -> Html:
    shown = [figure for figure in figures if figure is not None]
    if not shown:
        return Html("")
    pictures = element("div", *shown, class_=f"pictures {css}".strip())
    return element("details", element("summary", heading), pictures)


def _figure(data: RunData, name: str, heading: str, caption: str) -> Html | None:
    if name not in data.pictures:
        return None
    picture = element("img", src=data.pictures[name], alt=": ".join(filter(None, (heading, caption))))
    label = element("strong", heading) if heading else None
    return element("figure", picture, element("figcaption", label, ": " if heading else None, caption))


def _answer(summary: AttackSummary, answer: UsualAnswer | None) -> str:
    return "no answer recorded" if answer is None else answer_text(summary.task, answer)


def _trial(name: str) -> str:
    return "trial " + Path(name).stem.removeprefix("verification").removesuffix("-answer").strip("-_")


def _table_of_facts(facts: Mapping[str, str]) -> Html:
    lines = [
        element("tr", element("th", name, scope="row"), element("td", value)) for name, value in facts.items() if value
    ]
    return element("table", element("tbody", *lines), class_="facts")


def _read_pictures(path: Path) -> dict[str, str]:
    """Return a data URL for each picture of the run."""
    found = sorted(
        file for folder in (directory.IMAGES, directory.ARTIFACTS) for file in (path / folder).glob("*.*")
        if file.suffix in _KINDS and file.is_file()
    )  # fmt: skip
    return {file.relative_to(path).as_posix(): _data_url(file) for file in found}


def _data_url(file: Path) -> str:
    data = file.read_bytes()
    if len(data) > LARGE_PICTURE and file.suffix == ".png":
        data = images.smaller_png(data, SMALLER_SIDE)
    return f"data:{_KINDS[file.suffix]};base64,{base64.b64encode(data).decode('ascii')}"


def _read_curves(path: Path) -> dict[str, list[float | None]]:
    if not path.is_file():
        return {}
    with store.Store(path, read_only=True) as results:
        return {kind: [value for _, value in results.curve(kind)] for kind in ("search", "baseline")}
