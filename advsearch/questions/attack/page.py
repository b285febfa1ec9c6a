"""The page of an attack: what is shown of its result, with pictures, the course of the
search and how it worked.

Without its script it lacks the slider and the animation.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image, ImageSequence

from advsearch.questions.attack import display, wording
from advsearch.questions.attack.summary import AttackSummary
from advsearch.report import wording as words
from advsearch.report.figures import search_axes
from advsearch.report.views import Column, Picture, ResultPart
from advsearch.report.wording import count, number_text
from advsearch.runs import directory, files, store
from advsearch.runs.results import GroupDerivative, PlannedGradient, Result
from advsearch.viewer.document import data_script, data_url
from advsearch.viewer.pages import object_data, object_part, read_object, shown_page

FRAME_QUALITY = 85  # Of the JPEG frames of the search, from 1 to 95
MOST_TRIALS = 24  # Pictures of the verification that the page shows
# Of a range: as near as that to one of its ends a value was stopped by it
AT_THE_END = 1e-6
MARKED = "-prediction.png"
"""How files with marks end, and how those of runs that were made before do."""


def page(run: Path, result: Result) -> str | None:
    """Return the page of an attack in the folder `run`; None of several, which are
    shown as all results are. Raises FileFormatError where the rows are damaged.
    """
    if not isinstance(result, AttackSummary):
        return None
    given = display.shown(result)
    thing = read_object(run)
    frames = _read_frames(run / directory.IMAGES / "search.gif")
    curves = {}
    if (run / store.NAME).is_file():
        with store.Store(run / store.NAME, read_only=True) as stored:
            curves = {
                kind: [row.objective for row in stored.rows(kind)]
                for kind in ("search", "baseline")
            }
    worked = [
        [name, text] for name, text in wording.method_facts(result).items() if text
    ]
    sections = [
        *_pictures(run, result, animated=bool(frames)),
        object_part(thing),
        _changes(result),
        _textures(run),
        *_failures(result),
        _rates(result, given.sections[0]),
        *display.ambient_part(result),
        _curve(result, curves),
        ResultPart("How the search worked", rows=worked, folded=True),
        _plan(result.gradient_plan),
    ]
    times = {
        name: words.seconds_text(seconds) for name, seconds in result.seconds.items()
    }
    total = times.pop("total")
    parts = ", ".join(map(" ".join, times.items()))
    facts = {
        **given.facts,
        "time": f"{total} ({parts})" if parts else total,
        "image formation": words.formation_text(result.image_formation),
        "environment": result.environment,
        "seed": str(result.seed),
    }
    about = [
        wording.budget_text(result),
        result.object,
        result.environment,
        result.model,
    ]
    data = object_data(thing)
    # with the steps that they are of, where each step has one; the last is the
    # adversarial one
    if frames:
        searched = curves.get("search", [])
        steps = [
            round(number)
            for number in np.linspace(0, max(len(searched) - 1, 0), len(frames) - 1)
        ]
        objectives = [
            searched[step] if step < len(searched) else None for step in steps
        ]
        data = [
            data_script(
                {"pictures": frames, "steps": steps, "objectives": objectives}, "frames"
            ),
            *data,
        ]
    scripts = ["make.js", "attack.js", *(["object.js"] if thing else [])]
    given = replace(given, sections=sections, facts=facts, about=about)
    return shown_page(run, result, given, data=data, scripts=scripts)


def _pictures(
    run: Path, summary: AttackSummary, *, animated: bool
) -> Iterator[ResultPart]:
    predictions = {
        name: "no prediction recorded"
        if predicted is None
        else words.prediction_text(summary.task, predicted)
        for name, predicted in (
            ("clean", summary.clean),
            ("adversarial", summary.adversarial),
        )
    }

    def pair(ending: str) -> list[Picture]:
        return [
            Picture(f"images/{name}{ending}", text, name.capitalize())
            for name, text in predictions.items()
        ]

    trial = summary.clean.trial
    where = " and ".join(summary.over)
    note = ""
    if where and trial is None:
        note = f"Both with the {where} that the scene comes with."
    elif where:
        others = "in other trials they, and what the model says, are others."
        note = f"Both of trial {trial}, with the same {where}; {others}"
    gain = f"{files.DIFFERENCE_GAIN:g} times magnified, grey where nothing changed"
    seen = [*pair(".png"), Picture("images/difference.png", gain, "Difference")]
    yield ResultPart("What the model sees", pictures=[seen], note=note)
    yield ResultPart(live="compare")
    kept = run / directory.IMAGES
    if (kept / f"clean{MARKED}").is_file():
        marks = words.marks_text(summary.task)
        yield ResultPart(
            "What it predicts", pictures=[pair(MARKED)], layout="large", note=marks
        )
    trials = sorted(file.name for file in kept.glob("verification*.png"))
    trials = ([name for name in trials if name.endswith(MARKED)] or trials)[
        :MOST_TRIALS
    ]
    if small := [
        Picture(f"images/{name}", f"trial {''.join(filter(str.isdigit, name))}")
        for name in trials
    ]:
        yield ResultPart(
            "Pictures of the verification",
            pictures=[small],
            layout="small",
            folded=True,
        )
    if animated:
        yield ResultPart("The search, step by step", live="search")
    if summary.drive is not None:
        pictures = {"drive-clean": "Clean", "drive": "Adversarial"}
        frames = "from the first frame to the last"
        strips = [
            Picture(f"images/{file}.png", frames, name)
            for file, name in pictures.items()
        ]
        note = f"The model is {wording.drive_text(summary)}."
        yield ResultPart("Along the drive", pictures=[strips], layout="rows", note=note)


def _changes(summary: AttackSummary) -> ResultPart:
    rows = []
    bars = []
    for name, changed in (summary.configuration or {}).items():
        clean = "" if changed.clean is None else number_text(changed.clean)
        values = changed.value if isinstance(changed.value, list) else [changed.value]
        unit = "" if changed.unit in ("", "1", "name") else f" {changed.unit}"
        low = changed.low
        high = changed.high
        value = changed.value
        within = ""
        bar = None
        if low is not None and high is not None and isinstance(value, (int, float)):
            stopped = min(value - low, high - value) <= AT_THE_END * (high - low)
            within = (
                f"{number_text(low)} to "
                f"{number_text(high)}{', at its end' if stopped else ''}"
            )
            begin = changed.clean if isinstance(changed.clean, (int, float)) else value
            ends = (min(begin, value), max(begin, value), value)
            bar = tuple(min(max((end - low) / (high - low), 0.0), 1.0) for end in ends)
        rows.append([name, clean, ", ".join(map(number_text, values)) + unit, within])
        bars.append(bar)
    heads = ("parameter", "clean", "adversarial", "in its range")
    kept = [at for at in range(len(heads)) if any(row[at] for row in rows)]
    return ResultPart(
        "What was changed" if rows else "",
        heads=[heads[at] for at in kept],
        rows=[[row[at] for at in kept] for row in rows],
        bars=bars if len(kept) == len(heads) else (),  # type: ignore[arg-type]
    )


def _textures(run: Path) -> ResultPart:
    files = sorted((run / directory.ARTIFACTS).glob("texture*-original.png"))
    before = [
        file.name
        for file in files
        if re.fullmatch(r"texture(@[\w-]+)?-original\.png", file.name)
    ]
    pictures = []
    for original in before:
        changed = f"artifacts/{original.removesuffix('-original.png')}.png"
        pictures.append(
            Picture(f"artifacts/{original}", "texture as it was", "Original")
        )
        pictures.append(
            Picture(changed, f"texture that was found; {changed}", "Adversarial")
        )
    title = "The textures" if len(before) > 1 else "The texture"
    return ResultPart(title, pictures=[pictures] if pictures else [], layout="pair")


def _failures(summary: AttackSummary) -> Iterator[ResultPart]:
    if (known := summary.failures) is None:
        return
    pictures = []
    for failure in known.listed:
        if failure.picture and failure.holds:
            says = (
                words.prediction_text(summary.task, failure.pictured)
                if failure.pictured
                else ""
            )
            name = says or display.most_predicted(failure)
            pictures.append(Picture(failure.picture, display.range_text(failure), name))
    text = [f"Failures are {display.failures_text(known)}."]
    groups = [pictures] if pictures else []
    yield replace(
        display.failures_part(known),
        title="Different failures",
        text=text,
        pictures=groups,
    )


def _rates(summary: AttackSummary, table: ResultPart) -> ResultPart:
    """The table of rates with bars, rates first, as a phone cuts what is on the right;
    empty if nothing was rated.
    """
    average = summary.average
    rated = [
        summary.clean.control,
        *([summary.verified] if summary.adversarial else []),
    ]
    rated += [summary.baseline.verified] if summary.baseline else []
    bars = [None if rate is None else (*rate.interval, rate.rate) for rate in rated]
    bars += [(*average.interval, average.accuracy)] if average else []
    if not any(bars):
        return ResultPart()
    spp = f", {summary.verified.spp} samples per pixel" if summary.verified else ""
    note = f"Fresh seeds, pictures rounded to 8 bits, Clopper-Pearson intervals{spp}."
    heads, *rows = ([row[0], *row[3:], *row[1:3]] for row in (table.heads, *table.rows))
    return replace(
        table, title="Verified rates", heads=heads, rows=rows, bars=bars, note=note
    )


def _curve(summary: AttackSummary, curves: dict[str, list[float | None]]) -> ResultPart:
    named = {
        summary.policy: curves.get("search", []),
        "random search": curves.get("baseline", []),
    }
    named = {
        name: values
        for name, values in named.items()
        if any(value is not None for value in values)
    }
    if not named:
        return ResultPart()
    ends = {
        name: [value for value in values if value is not None]
        for name, values in named.items()
    }
    above = "right" if summary.minimises else wording.success(summary)
    zero = f"above: {above}" if summary.objective in words.SUCCESS_ABOVE_ZERO else ""
    listed = "; ".join(
        f"{name}: from {values[0]:.3g} to {max(values):.3g}"
        for name, values in ends.items()
    )
    label = words.objective_label(summary.objective)
    return ResultPart(
        "The search",
        [f"{label} over evaluations. {listed}"],
        draw=partial(search_axes, named, label, zero_means=zero),
        note="Lines: the best so far. Dots: each evaluation. These are the search's "
        "claims; the table above is "
        "verified.",
    )


def _plan(plan: PlannedGradient) -> ResultPart:
    def step(group: GroupDerivative) -> str:
        unit = "" if group.unit in ("", "1") else f" {group.unit}"
        wide = (
            f"{group.step:.3g} of its range"
            if group.step_in_unit is None
            else f"{group.step_in_unit:.3g}{unit}"
        )
        return f"{wide}: {group.step_reason}" if group.step_reason else ""

    columns: Mapping[str, Column] = {
        "parameter": "{0.name}", "numbers": "{0.size}", "derivative": "{0.estimator}", "why": "{0.reason}",
        "step": step,
    }  # fmt: skip
    spp = "" if plan.spp is None else f", {count(plan.spp, 'sample')} a pixel"
    renders = (
        f"{count(plan.renders_per_gradient, 'render')} a gradient beside the "
        "picture itself"
    )
    title = f"Gradient plan: {count(len(plan.groups), 'parameter')}, {renders}{spp}"
    return ResultPart.table(plan.groups, columns, title=title, folded=True)


def _read_frames(file: Path) -> list[str]:
    frames = []
    try:
        with Image.open(file, formats=("GIF",)) as animation:
            for frame in ImageSequence.Iterator(animation):
                stream = io.BytesIO()
                frame.convert("RGB").save(stream, "JPEG", quality=FRAME_QUALITY)
                frames.append(data_url(stream.getvalue(), "image/jpeg"))
    except files.BAD_PICTURE:
        return []
    return frames if len(frames) > 1 else []
