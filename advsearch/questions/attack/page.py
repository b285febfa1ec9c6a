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
from advsearch.questions.attack.summary import AttackSummary, FoundValue, PicturedPrediction
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
from advsearch.runs import directory, images, store
from advsearch.runs.results import Result
from advsearch.viewer.document import data_script, data_url
from advsearch.viewer.pages import object_data, object_part, read_object, shown_page

FRAME_QUALITY = 85
"""Of the JPEG frames of the search, from 1 to 95."""

MOST_TRIALS = 24
"""Pictures of the verification that the page shows."""

AT_THE_END = 1e-6
"""Of a range: as near as that to one of its ends a value was stopped by it."""


MARKED, FORMERLY_MARKED = "-prediction.png", "-answer.png"
"""How files with marks end, and how those of runs that were made before do."""


def page(run: Path, result: Result) -> str | None:
    """Return the page of an attack in the folder `run`; None of several, which are shown as all results are.

    Raises:
        FileFormatError: the results are damaged.
    """
    return attack_page(run, result) if isinstance(result, AttackSummary) else None


def attack_page(run: Path, result: AttackSummary) -> str:
    """See `page`."""
    given, thing = shown(result), read_object(run)
    frames, curves = _read_frames(run / directory.IMAGES / "search.gif"), _read_curves(run / store.NAME)
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
    seconds = result.seconds
    parts = ", ".join(f"{name} {seconds_text(value)}" for name, value in seconds.items() if name != "total")
    facts = {
        **given.facts,
        "time": seconds_text(seconds["total"]) + (f" ({parts})" if parts else ""),
        "image formation": formation_text(result.image_formation),
        "environment": result.environment,
        "seed": str(result.seed),
    }
    about = [wording.budget_text(result), result.object, result.environment, result.model]
    data = [data_script(_animation(frames, curves.get("search", [])), "frames")] if frames else []
    return shown_page(
        run,
        result,
        replace(given, sections=sections, facts=facts, about=about),
        data=[*data, *object_data(thing)],
        scripts=["make.js", "attack.js", *(["object.js"] if thing else [])],
    )


def _pictures(run: Path, summary: AttackSummary, *, animated: bool) -> Iterator[ResultPart]:
    """What the model sees, and what it predicts; trials of the verification, the search, and frames along a drive."""
    said = [("clean", "Clean", _prediction(summary, summary.clean))]
    said.append(("adversarial", "Adversarial", _prediction(summary, summary.adversarial)))
    seen = [Picture(f"images/{file}.png", text, name) for file, name, text in said]
    gain = f"{images.DIFFERENCE_GAIN:g} times magnified, grey where nothing changed"
    seen.append(Picture("images/difference.png", gain, "Difference"))
    yield ResultPart("What the model sees", pictures=[seen], note=_same_conditions(summary))
    yield ResultPart(live="compare")
    ends = MARKED if (run / directory.IMAGES / f"clean{MARKED}").is_file() else FORMERLY_MARKED
    marked = [Picture(f"images/{file}{ends}", text, name) for file, name, text in said]
    if (run / marked[0].file).is_file():
        marks = marks_text(summary.task)
        yield ResultPart("What it predicts", pictures=[marked], layout="large", note=marks)
    trials = sorted(file.name for file in (run / directory.IMAGES).glob("verification*.png"))
    trials = ([name for name in trials if name.endswith(ends)] or trials)[:MOST_TRIALS]
    numbers = [name.removesuffix(ends).removeprefix("verification").removesuffix(".png").strip("-_") for name in trials]
    small = [Picture(f"images/{name}", f"trial {one}") for name, one in zip(trials, numbers, strict=True)]
    if small:
        yield ResultPart("Pictures of the verification", pictures=[small], layout="small", folded=True)
    if animated:
        yield ResultPart("The search, step by step", live="search")
    if summary.drive is not None:
        files, frames = {"drive-clean": "Clean", "drive": "Adversarial"}, "from the first frame to the last"
        strips = [Picture(f"images/{file}.png", frames, name) for file, name in files.items()]
        note = f"The model is {wording.drive_text(summary)}."
        yield ResultPart("Along the drive", pictures=[strips], layout="rows", note=note)


def _prediction(summary: AttackSummary, prediction: PicturedPrediction | None) -> str:
    return "no prediction recorded" if prediction is None else prediction_text(summary.task, prediction)


def _same_conditions(summary: AttackSummary) -> str:
    """Which of many conditions the pictures show."""
    trial, where = summary.clean.trial, " and ".join(summary.over)
    if not summary.over:
        return ""
    if trial is None:
        return f"Both with the {where} that the scene comes with."
    return f"Both of trial {trial}, with the same {where}; in other trials they, and what the model says, are others."


def _changes(summary: AttackSummary) -> ResultPart:
    """The adversarial configuration in a few values, each beside its range where it has one, from the clean value to
    the one found."""
    found = summary.configuration or {}
    rows = [
        [name, "" if value.clean is None else number_text(value.clean), _value_text(value), _range_text(value)]
        for name, value in found.items()
    ]
    heads = ("parameter", "clean", "adversarial", "in its range")
    kept = [at for at in range(len(heads)) if any(row[at] for row in rows)]
    return ResultPart(
        "What was changed" if rows else "",
        heads=[heads[at] for at in kept],
        rows=[[row[at] for at in kept] for row in rows],
        bars=[_place(value) for value in found.values()] if len(kept) == len(heads) else (),
    )


def _value_text(changed: FoundValue) -> str:
    values = changed.value if isinstance(changed.value, list) else [changed.value]
    unit = "" if changed.unit in ("", "1", "name") else f" {changed.unit}"
    return ", ".join(map(number_text, values)) + unit


def _range_text(changed: FoundValue) -> str:
    if changed.low is None or changed.high is None or not isinstance(changed.value, (int, float)):
        return ""
    stopped = min(changed.value - changed.low, changed.high - changed.value) <= AT_THE_END * (
        changed.high - changed.low
    )
    said = f"{number_text(changed.low)} to {number_text(changed.high)}"
    return f"{said}, at its end" if stopped else said


def _place(changed: FoundValue) -> tuple[float, float, float] | None:
    """Where the clean and the found value lie between the ends of the range."""
    if changed.low is None or changed.high is None or not isinstance(changed.value, (int, float)):
        return None
    begin = changed.clean if isinstance(changed.clean, (int, float)) else changed.value
    low, high, mark = (
        min(max((value - changed.low) / (changed.high - changed.low), 0.0), 1.0)
        for value in (min(begin, changed.value), max(begin, changed.value), changed.value)
    )
    return low, high, mark


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
    known = summary.failures
    if known is None:
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
    said = [f"Failures are {failures_text(known)}."]
    yield replace(failures_part(known), title="Different failures", text=said, pictures=[pictures] if pictures else [])


def _rates(summary: AttackSummary, table: ResultPart) -> ResultPart:
    """The table of rates, these first, for a phone cuts what is on the right, with a bar for each; empty where nothing
    was rated."""
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
    known = {name: values for name, values in named.items() if any(value is not None for value in values)}
    if not known:
        return ResultPart()
    above = "right" if summary.minimises else wording.success(summary)
    zero = f"above: {above}" if summary.objective in SUCCESS_ABOVE_ZERO else ""
    ends = {name: [one for one in values if one is not None] for name, values in known.items()}
    listed = "; ".join(f"{name}: from {one[0]:.3g} to {max(one):.3g}" for name, one in ends.items())
    label = objective_label(summary.objective)
    return ResultPart(
        "The search",
        [f"{label} over evaluations. {listed}"],
        draw=partial(search_axes, known, label, zero_means=zero),
        note="Lines: the best so far. Dots: each evaluation. These are the search's claims; the table above is "
        "verified.",
    )


def _animation(frames: list[str], searched: list[float | None]) -> dict[str, object]:
    """The frames of the search with the steps they are of, where each step has one; the last is the adversarial one."""
    steps = [round(number) for number in np.linspace(0, max(len(searched) - 1, 0), len(frames) - 1)]
    objectives = [searched[step] if step < len(searched) else None for step in steps]
    return {"pictures": frames, "steps": steps, "objectives": objectives}


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
