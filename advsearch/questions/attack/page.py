"""The page of an attack: what is shown of its result, with pictures, the course of the search and how it worked.

Without its script it lacks the slider and the animation.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image, ImageSequence

from advsearch.questions.attack import wording
from advsearch.questions.attack.display import (
    ambient_part,
    failures_part,
    failures_text,
    most_predicted,
    range_text,
    shown,
)
from advsearch.questions.attack.summary import AttackSummary, FoundValue
from advsearch.report.figures import search_axes
from advsearch.report.shown import Picture, ResultPart
from advsearch.report.wording import (
    SUCCESS_ABOVE_ZERO,
    formation_text,
    marks_text,
    number_text,
    objective_label,
    prediction_text,
    seconds_text,
)
from advsearch.runs import directory, files, store
from advsearch.runs.results import Result
from advsearch.viewer.document import data_script, data_url
from advsearch.viewer.pages import object_data, object_part, read_object, shown_page

FRAME_QUALITY = 85  # Of the JPEG frames of the search, from 1 to 95
MOST_TRIALS = 24  # Pictures of the verification that the page shows
AT_THE_END = 1e-6  # Of a range: as near as that to one of its ends a value was stopped by it
MARKED, FORMERLY_MARKED = "-prediction.png", "-answer.png"
"""How files with marks end, and how those of runs that were made before do."""


def page(run: Path, result: Result) -> str | None:
    """Return the page of an attack in the folder `run`; None of several, which are shown as all results are. Raises
    FileFormatError where the rows are damaged."""
    if not isinstance(result, AttackSummary):
        return None
    given, thing = shown(result), read_object(run)
    frames, curves = _read_frames(run / directory.IMAGES / "search.gif"), {}
    if (run / store.NAME).is_file():
        with store.Store(run / store.NAME, read_only=True) as stored:
            curves = {kind: [row.objective for row in stored.rows(kind)] for kind in ("search", "baseline")}
    worked = [[name, text] for name, text in wording.method_facts(result).items() if text]
    sections = [
        *_pictures(run, result, animated=bool(frames)),
        object_part(thing),
        _changes(result),
        _textures(run),
        *_failures(result),
        _rates(result, given.sections[0]),
        *ambient_part(result),
        _curve(result, curves),
        ResultPart("How the search worked", rows=worked, folded=True),
        ResultPart(wording.plan_text(result), heads=wording.PLAN_HEADS, rows=wording.plan_rows(result), folded=True),
    ]
    parts = ", ".join(f"{name} {seconds_text(value)}" for name, value in result.seconds.items() if name != "total")
    facts = {
        **given.facts,
        "time": seconds_text(result.seconds["total"]) + (f" ({parts})" if parts else ""),
        "image formation": formation_text(result.image_formation),
        "environment": result.environment,
        "seed": str(result.seed),
    }
    about = [wording.budget_text(result), result.object, result.environment, result.model]
    data = object_data(thing)
    if frames:  # with the steps that they are of, where each step has one; the last is the adversarial one
        searched = curves.get("search", [])
        steps = [round(number) for number in np.linspace(0, max(len(searched) - 1, 0), len(frames) - 1)]
        objectives = [searched[step] if step < len(searched) else None for step in steps]
        data = [data_script({"pictures": frames, "steps": steps, "objectives": objectives}, "frames"), *data]
    scripts = ["make.js", "attack.js", *(["object.js"] if thing else [])]
    return shown_page(
        run, result, replace(given, sections=sections, facts=facts, about=about), data=data, scripts=scripts
    )


def _pictures(run: Path, summary: AttackSummary, *, animated: bool) -> Iterator[ResultPart]:
    """What the model sees, and what it predicts; trials of the verification, the search, and frames along a drive."""
    predictions = {
        name: "no prediction recorded" if predicted is None else prediction_text(summary.task, predicted)
        for name, predicted in (("clean", summary.clean), ("adversarial", summary.adversarial))
    }

    def pair(ending: str) -> list[Picture]:
        return [Picture(f"images/{name}{ending}", text, name.capitalize()) for name, text in predictions.items()]

    trial, where, note = summary.clean.trial, " and ".join(summary.over), ""
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
    ends = MARKED if (kept / f"clean{MARKED}").is_file() else FORMERLY_MARKED
    if (kept / f"clean{ends}").is_file():
        yield ResultPart("What it predicts", pictures=[pair(ends)], layout="large", note=marks_text(summary.task))
    trials = sorted(file.name for file in kept.glob("verification*.png"))
    trials = ([name for name in trials if name.endswith(ends)] or trials)[:MOST_TRIALS]
    numbers = [name.removesuffix(ends).removeprefix("verification").removesuffix(".png").strip("-_") for name in trials]
    small = [Picture(f"images/{name}", f"trial {number}") for name, number in zip(trials, numbers, strict=True)]
    if small:
        yield ResultPart("Pictures of the verification", pictures=[small], layout="small", folded=True)
    if animated:
        yield ResultPart("The search, step by step", live="search")
    if summary.drive is not None:
        pictures, frames = {"drive-clean": "Clean", "drive": "Adversarial"}, "from the first frame to the last"
        strips = [Picture(f"images/{file}.png", frames, name) for file, name in pictures.items()]
        note = f"The model is {wording.drive_text(summary)}."
        yield ResultPart("Along the drive", pictures=[strips], layout="rows", note=note)


def _changes(summary: AttackSummary) -> ResultPart:
    """The adversarial configuration in a few values, each beside its range where it has one."""
    rows, bars = [], []
    for name, changed in (summary.configuration or {}).items():
        clean = "" if changed.clean is None else number_text(changed.clean)
        values = changed.value if isinstance(changed.value, list) else [changed.value]
        unit = "" if changed.unit in ("", "1", "name") else f" {changed.unit}"
        within, bar = _in_range(changed)
        rows.append([name, clean, ", ".join(map(number_text, values)) + unit, within])
        bars.append(bar)
    heads = ("parameter", "clean", "adversarial", "in its range")
    kept = [at for at in range(len(heads)) if any(row[at] for row in rows)]
    return ResultPart(
        "What was changed" if rows else "",
        heads=[heads[at] for at in kept],
        rows=[[row[at] for at in kept] for row in rows],
        bars=bars if len(kept) == len(heads) else (),
    )


def _in_range(changed: FoundValue) -> tuple[str, tuple[float, float, float] | None]:
    low, high, value = changed.low, changed.high, changed.value
    if low is None or high is None or not isinstance(value, (int, float)):
        return "", None
    stopped = min(value - low, high - value) <= AT_THE_END * (high - low)
    text = f"{number_text(low)} to {number_text(high)}{', at its end' if stopped else ''}"
    clean = changed.clean if isinstance(changed.clean, (int, float)) else value
    begin, end, mark = (
        min(max((at - low) / (high - low), 0.0), 1.0) for at in (min(clean, value), max(clean, value), value)
    )
    return text, (begin, end, mark)


def _textures(run: Path) -> ResultPart:
    """The texture of the object, and of every other mesh (`texture@NAME.png`), before and after."""
    names = sorted(file.name for file in (run / directory.ARTIFACTS).glob("texture*-original.png"))
    before = [name for name in names if re.fullmatch(r"texture(@[\w-]+)?-original\.png", name)]
    pictures = []
    for original in before:
        changed = f"artifacts/{original.removesuffix('-original.png')}.png"
        pictures.append(Picture(f"artifacts/{original}", "texture as it was", "Original"))
        pictures.append(Picture(changed, f"texture that was found; {changed}", "Adversarial"))
    title = "The textures" if len(before) > 1 else "The texture"
    return ResultPart(title, pictures=[pictures] if pictures else [], layout="pair")


def _failures(summary: AttackSummary) -> Iterator[ResultPart]:
    if (known := summary.failures) is None:
        return
    pictures = [
        Picture(
            failure.picture,
            range_text(failure),
            prediction_text(summary.task, failure.pictured) if failure.pictured else most_predicted(failure),
        )
        for failure in known.listed
        if failure.picture and failure.holds
    ]
    text = [f"Failures are {failures_text(known)}."]
    yield replace(failures_part(known), title="Different failures", text=text, pictures=[pictures] if pictures else [])


def _rates(summary: AttackSummary, table: ResultPart) -> ResultPart:
    """The table of rates with bars, rates first, as a phone cuts what is on the right; empty if nothing was rated."""
    baseline, average = summary.baseline, summary.average
    rated = [summary.clean.control, *([summary.verified] if summary.adversarial else [])]
    rated += [baseline.verified] if baseline else []
    bars = [None if rate is None else (*rate.interval, rate.rate) for rate in rated]
    bars += [(*average.interval, average.accuracy)] if average else []
    if not any(bars):
        return ResultPart()
    spp = f", {summary.verified.spp} samples per pixel" if summary.verified else ""
    note = f"Fresh seeds, pictures rounded to 8 bits, Clopper-Pearson intervals{spp}."
    heads, *rows = ([row[0], *row[3:], *row[1:3]] for row in (table.heads, *table.rows))
    return replace(table, title="Verified rates", heads=heads, rows=rows, bars=bars, note=note)


def _curve(summary: AttackSummary, curves: dict[str, list[float | None]]) -> ResultPart:
    named = {summary.policy: curves.get("search", []), "random search": curves.get("baseline", [])}
    numbers = {name: [value for value in values if value is not None] for name, values in named.items()}
    numbers = {name: values for name, values in numbers.items() if values}
    if not numbers:
        return ResultPart()
    above = "right" if summary.minimises else wording.success(summary)
    zero = f"above: {above}" if summary.objective in SUCCESS_ABOVE_ZERO else ""
    listed = "; ".join(f"{name}: from {values[0]:.3g} to {max(values):.3g}" for name, values in numbers.items())
    label = objective_label(summary.objective)
    return ResultPart(
        "The search",
        [f"{label} over evaluations. {listed}"],
        draw=partial(search_axes, {name: named[name] for name in numbers}, label, zero_means=zero),
        note="Lines: the best so far. Dots: each evaluation. These are the search's claims; the table above is "
        "verified.",
    )


def _read_frames(file: Path) -> list[str]:
    """Return the frames of an animation as data URLs; none where it is missing or damaged."""
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
