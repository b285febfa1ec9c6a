"""The page of an attack: one file that needs no other. Without its script it lacks the slider and the animation."""

from __future__ import annotations

import io
import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageSequence

from advsearch.files import JsonObject
from advsearch.questions.attack.answer import answered_text, failures_part, failures_text, range_text
from advsearch.questions.attack.method import PLAN_HEADS, method_facts, plan_rows, plan_text
from advsearch.report import wording
from advsearch.report.markup import NARROW, WIDE, Curve, Html, element, join_html, objective_chart
from advsearch.report.phrases import SUCCESS_ABOVE_ZERO, answer_text, is_command, marks_text, objective_label
from advsearch.runs import directory, images, store
from advsearch.runs.results.attack import AttackSummary, FoundValue, PicturedAnswer
from advsearch.runs.results.base import Result
from advsearch.runs.summary import attack_of
from advsearch.viewer.document import (
    data_script,
    data_url,
    document,
    facts_table,
    heading,
    scrolled,
    study_table,
    subject_html,
)
from advsearch.viewer.pages import object_data, object_section, read_object

LARGE_PICTURE = 1_000_000
"""Bytes above which a PNG is put into the page at a smaller size; the file itself stays as it is."""

SMALLER_SIDE = 640
"""Longest side in pixels of such a smaller picture."""

FRAME_QUALITY = 85
"""Of the JPEG frames of the search, from 1 to 95."""

MOST_TRIALS = 24
"""Pictures of the verification that the page shows."""

AT_THE_END = 1e-6
"""Of a range: as near as that to one of its ends a value was stopped by it."""


@dataclass(frozen=True)
class RunData:
    """What a run left behind, as far as the page shows it.

    Attributes:
        recipe: the text of `run.yaml`; empty when there is none.
        pictures: path inside the run directory to a data URL, sorted.
        curves: kind of evaluation to its objectives in order.
        frames: of the animation of the search, as data URLs.
        thing: the object to turn, binary glTF; empty where there is none.
    """

    path: Path
    summary: AttackSummary
    recipe: str
    pictures: Mapping[str, str]
    curves: Mapping[str, list[float | None]]
    frames: Sequence[str] = ()
    thing: bytes = b""


def page(run: Path, result: Result) -> str | None:
    """Return the page of an attack in the folder `run`; None of several, which are shown as all answers are.

    Raises:
        FileFormatError: the results are damaged.
    """
    if not isinstance(result, AttackSummary):
        return None
    recipe = run / directory.CONFIG
    text = recipe.read_text(encoding="utf-8", errors="replace") if recipe.is_file() else ""
    curves, frames = _read_curves(run / store.NAME), _read_frames(run / directory.IMAGES / "search.gif")
    return attack_page_html(RunData(run, attack_of(run), text, _read_pictures(run), curves, frames, read_object(run)))


def attack_page_html(data: RunData) -> str:
    """Return the page as HTML."""
    summary = data.summary
    main = element(
        "main",
        _pictures(data),
        object_section(data.thing),
        _along(data),
        _changes(summary),
        _textures(data),
        _failures(data),
        _rates(summary),
        _curve(data),
        _cost(summary),
        _repeat(data),
    )
    footer = f"run {data.path.name}. This page needs no other file."
    given = [data_script(_animation(data), "frames")] if data.frames else []
    given += object_data(data.thing)
    scripts = ["make.js", "attack.js", *(["object.js"] if data.thing else [])]
    about = subject_html(("object", summary.object), ("environment", summary.environment), ("model", summary.model))
    asked = join_html(f"{wording.budget_text(summary)}; ", about)
    header = heading(asked, wording.attack_verdict(summary), wording.remarks(summary))
    return document(wording.title(summary), header, main, data=given, scripts=scripts, footer=footer)


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
    numbers = {
        name: Path(name).stem.removeprefix("verification").removesuffix("-answer").strip("-_") for name in trials
    }
    small = _section("", [_figure(data, name, "", f"trial {one}") for name, one in numbers.items()], "small")
    compare = element("div", id="compare", hidden="hidden")
    steps = join_html(element("h2", "The search, step by step"), element("div", id="search"))
    search = element("div", steps, hidden="hidden", class_="screen")
    return join_html(
        element("h2", "What the model sees"),
        compare,
        _section("", shown, note=_same_conditions(summary)),
        _section("What it answers", answered, "large", marks_text(summary.task)),
        element("details", element("summary", "Pictures of the verification"), small) if trials else None,
        search if data.frames else None,
    )


def _along(data: RunData) -> Html:
    """Frames of the drive, of the clean scene and of the answer, one strip under the other."""
    frames = "from the first frame to the last"
    named = (("drive-clean", "Clean"), ("drive", "Adversarial"))
    strips = [_figure(data, f"images/{name}.png", heading, frames) for name, heading in named]
    return _section("Along the drive", strips, "rows", f"The model is {wording.drive_text(data.summary)}.")


def _textures(data: RunData) -> Html:
    """The texture of the object, and of every other mesh (`texture@NAME.png`), before and after."""
    before = [name for name in data.pictures if re.fullmatch(r"artifacts/texture(@[\w-]+)?-original\.png", name)]
    figures = []
    for original in before:
        changed = original.removesuffix("-original.png") + ".png"
        figures.append(_figure(data, original, "Original", "texture as it was"))
        figures.append(_figure(data, changed, "Adversarial", f"texture that was found; {changed}"))
    return _section("The textures" if len(before) > 1 else "The texture", figures, "pair")


def _failures(data: RunData) -> Html:
    known = data.summary.failures
    if known is None:
        return Html("")
    task = data.summary.task
    shown = [
        _figure(
            data, one.picture, answer_text(task, one.pictured) if one.pictured else answered_text(one), range_text(one)
        )
        for one in known.listed
        if one.picture and one.holds
    ]
    table = failures_part(known)
    return join_html(
        element("h2", "Different failures"),
        element("p", f"Failures are {failures_text(known)}."),
        element("div", *shown, class_="pictures") if shown else None,
        study_table(table.heads, table.rows) if table.rows else None,
    )


def _rates(summary: AttackSummary) -> Html:
    control, average, baseline = summary.clean.control, summary.average, summary.baseline
    success, rows = wording.success(summary), []
    if control:
        clean = control.correct, control.trials, control.interval, control.not_a_number
        rows.append(("Clean scene (control group)", "right", *clean))
    random = f"{baseline.policy.capitalize()} search" if baseline else ""
    for name, rated in (("Adversarial", summary.verified), (random, baseline.verified if baseline else None)):
        if rated:
            rows.append((name, success, rated.successes, rated.trials, rated.interval, rated.not_a_number))
    if average:
        average_case = "Average case (random configurations)"
        rows.append((average_case, "right", average.correct, average.configurations, average.interval, 0))
    lines = [
        element(
            "tr",
            element("th", name, scope="row"),
            element("td", what),
            element("td", wording.tally("", number, trials, nothing).removeprefix(" in "), class_="number"),
            element("td", wording.interval_text(interval), class_="number"),
            element("td", _bar(number / trials, interval), class_="hide-small"),
        )
        for name, what, number, trials, interval, nothing in rows
    ]
    if not lines:
        return Html("")
    heads = ("Configuration", "Model is", "Renders", "95 % interval")
    head = element("tr", *(element("th", text, scope="col") for text in heads), element("td", class_="hide-small"))
    spp = summary.verified.spp if summary.verified else None
    note = "Fresh seeds, pictures rounded to 8 bits, Clopper-Pearson intervals"
    return join_html(
        element("h2", "Verified rates"),
        scrolled(element("table", element("thead", head), element("tbody", *lines))),
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
    charts = [objective_chart(curves, objective_label(objective), zero, width) for width in (WIDE, NARROW)]
    note = "Lines: the best so far. Dots: each evaluation. These are the search's claims; the table above is verified."
    return join_html(element("h2", "The search"), element("div", *charts), element("p", note, class_="soft"))


def _cost(summary: AttackSummary) -> Html:
    seconds = summary.seconds
    parts = ", ".join(f"{name} {wording.seconds_text(value)}" for name, value in seconds.items() if name != "total")
    total = wording.seconds_text(seconds["total"])
    facts = {
        "Ending": summary.ending,
        "Policy": f"{summary.policy}, {wording.count(summary.steps, 'step')}",
        "Goal": wording.goal_text(summary),
        "Budget": wording.budget_text(summary),
        "Objective": wording.objective_text(summary),
        "Over": wording.over_text(summary),
        "Smallest epsilon": wording.smallest_text(summary),
        "Renders": wording.renders_text(summary),
        "Time": f"{total} ({parts})" if parts else total,
        "Image formation": wording.formation_text(summary.image_formation),
        "Object": summary.object,
        "Environment": summary.environment,
        "Model": summary.model,
        "Seed": str(summary.seed),
        **{name.capitalize(): text for name, text in summary.facts().items()},
    }
    return join_html(element("h2", "Cost and conditions"), facts_table(facts), _method(summary))


def _method(summary: AttackSummary) -> Html:
    worked = element("details", element("summary", "How the search worked"), facts_table(method_facts(summary)))
    rows = plan_rows(summary)
    if not rows:
        return worked
    return join_html(worked, element("details", element("summary", plan_text(summary)), study_table(PLAN_HEADS, rows)))


def _repeat(data: RunData) -> Html:
    commands = [data.summary.command_line] if data.summary.command_line else []
    if is_command(data.summary.command_line):
        commands.insert(0, shlex.join(["advsearch", "run", f"{data.summary.run or data.path}/{directory.CONFIG}"]))
    recipe = None
    if data.recipe:
        recipe = element("details", element("summary", "All settings"), element("pre", data.recipe, class_="wrap"))
    on: list[Html] = []
    if data.summary.goes_on:
        resume = shlex.join(["advsearch", "resume", str(data.summary.run or data.path)])
        on = [element("h2", "Go on, and verify the answer"), element("pre", resume, class_="wrap")]
    return join_html(
        *on, element("h2", "Do it again"), *(element("pre", text, class_="wrap") for text in commands), recipe
    )


def _section(heading: str, figures: Iterable[Html | None], css: str = "", note: str = "") -> Html:
    shown = [figure for figure in figures if figure is not None]
    if not shown:
        return Html("")
    remark = element("p", note, class_="soft") if note else None
    title = element("h2", heading) if heading else None
    return join_html(title, element("div", *shown, class_=f"pictures {css}".strip()), remark)


def _figure(data: RunData, name: str, heading: str, caption: str) -> Html | None:
    if name not in data.pictures:
        return None
    alt = ": ".join(filter(None, (heading, caption)))
    picture = element("img", src=data.pictures[name], alt=alt, data_picture=Path(name).stem)
    label = element("strong", heading) if heading else None
    return element("figure", picture, element("figcaption", label, ": " if heading else None, caption))


def _same_conditions(summary: AttackSummary) -> str:
    """Which of many conditions the pictures show."""
    trial = summary.clean.trial
    if not summary.over:
        return ""
    where = " and ".join(summary.over)
    if trial is None:
        return f"Both with the {where} that the scene comes with."
    return f"Both of trial {trial}, with the same {where}; in other trials they, and what the model says, are others."


def _answer(summary: AttackSummary, answer: PicturedAnswer | None) -> str:
    return "no answer recorded" if answer is None else answer_text(summary.task, answer)


def _changes(summary: AttackSummary) -> Html:
    """The answer in a few values, each in its range where it has one."""
    found = summary.configuration or {}
    if not found:
        return Html("")
    columns: dict[str, list[str | None]] = {
        "clean": [None if one.clean is None else wording.number_text(one.clean) for one in found.values()],
        "adversarial": [_value_text(one) for one in found.values()],
        "in its range": [_place(one) for one in found.values()],
    }
    shown = {head: cells for head, cells in columns.items() if any(cells)}
    lines = [
        element("tr", element("th", name, scope="row"), *(element("td", cells[row]) for cells in shown.values()))
        for row, name in enumerate(found)
    ]
    head = element("thead", element("tr", *(element("th", text, scope="col") for text in ("parameter", *shown))))
    return join_html(element("h2", "What was changed"), scrolled(element("table", head, element("tbody", *lines))))


def _value_text(one: FoundValue) -> str:
    values = one.value if isinstance(one.value, list) else [one.value]
    unit = "" if one.unit in ("", "1", "name") else f" {one.unit}"
    return ", ".join(map(wording.number_text, values)) + unit


def _place(one: FoundValue) -> Html | None:
    """Where the clean and the found value lie between the ends of the range: a ring and a dot."""
    if one.low is None or one.high is None or not isinstance(one.value, (int, float)):
        return None
    low, width = one.low, one.high - one.low

    def at(value: float) -> str:
        return f"left: {min(max((value - low) / width, 0.0), 1.0):.1%}"

    marks = [element("span", style=at(one.clean), class_="from")] if isinstance(one.clean, (int, float)) else []
    words = f"from {wording.number_text(one.low)} to {wording.number_text(one.high)}"
    stopped = min(one.value - one.low, one.high - one.value) <= AT_THE_END * width
    dot = element("span", style=at(one.value), class_="to")
    drawn = element("div", *marks, dot, class_="place", role="img", aria_label=words, title=words)
    return join_html(drawn, element("span", "at its end", class_="soft") if stopped else None)


def _animation(data: RunData) -> JsonObject:
    """The frames of the search with the steps they are of, where each step has one; the last is the answer."""
    searched, count = data.curves.get("search", []), len(data.frames) - 1
    steps = [round(number) for number in np.linspace(0, max(len(searched) - 1, 0), count)]
    objectives = [searched[step] if step < len(searched) else None for step in steps]
    return {"pictures": list(data.frames), "steps": list(steps), "objectives": list(objectives)}


def _read_pictures(path: Path) -> dict[str, str]:
    found = sorted(
        file for folder in (directory.IMAGES, directory.ARTIFACTS) for file in (path / folder).glob("*.png")
        if file.is_file()
    )  # fmt: skip
    read = {file: file.read_bytes() for file in found}
    return {
        file.relative_to(path).as_posix(): data_url(
            images.smaller_png(data, SMALLER_SIDE) if len(data) > LARGE_PICTURE else data, "image/png"
        )
        for file, data in read.items()
    }


def _read_frames(file: Path) -> list[str]:
    """Return the frames of an animation as data URLs; none where it is missing or damaged."""
    frames = []
    try:
        with Image.open(file, formats=("GIF",)) as animation:
            for frame in ImageSequence.Iterator(animation):
                stream = io.BytesIO()
                frame.convert("RGB").save(stream, "JPEG", quality=FRAME_QUALITY)
                frames.append(data_url(stream.getvalue(), "image/jpeg"))
    except images.BAD_PICTURE:
        return []
    return frames if len(frames) > 1 else []


def _read_curves(path: Path) -> dict[str, list[float | None]]:
    if not path.is_file():
        return {}
    with store.Store(path, read_only=True) as results:
        return {kind: [value for _, value in results.curve(kind)] for kind in ("search", "baseline")}
