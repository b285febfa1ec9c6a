"""The page of an attack: its result with images, and how the search went.

Where scripts are blocked, the page lacks the slider and the animation.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image, ImageSequence

from advsearch.questions.attack import display, wording
from advsearch.questions.attack.summary import (
    AttackSummary,
    DifferentFailure,
    FoundValue,
)
from advsearch.report import wording as words
from advsearch.report.figures import draw_searches
from advsearch.report.views import Column, Html, Picture, ResultPart
from advsearch.report.wording import format_count, format_number
from advsearch.runs import directory, files, store
from advsearch.runs.results import (
    ControlGroup,
    GroupDerivative,
    PlannedGradient,
    Result,
    VerifiedRate,
)
from advsearch.viewer.document import make_data_script, make_data_url
from advsearch.viewer.pages import (
    make_object_data,
    make_object_part,
    make_view_page,
    read_object,
)

FRAME_QUALITY = 85  # JPEG quality of the frames of the search, from 1 to 95
MAX_TRIAL_IMAGES = 24  # images of trials on a page
# A value that is this close to the end of its range, as a fraction of the range, is at
# the end.
END_TOLERANCE = 1e-6
MARKED = "-prediction.png"  # end of the names of images with marks


def make_page(run: Path, result: Result) -> str | None:
    """Return the page of an attack.

    The result of a study (a curve or a matrix) has the default page instead: then this
    is None.

    Args:
        run: the run directory.
        result: result of the attack.

    Raises:
        FileFormatError: the rows are corrupt.
    """
    if not isinstance(result, AttackSummary):
        return None
    view = display.make_attack_view(result)
    # file of the 3-D object that a script lets the reader turn; empty without one
    object_file = read_object(run)
    frames = _read_frames(run / directory.IMAGES / "search.gif")
    objectives = _read_objectives(run)
    rates_table = view.sections[0]  # the view of an attack begins with the rates
    sections = [
        *_image_parts(run, result, animated=bool(frames)),
        make_object_part(object_file),
        *_result_parts(run, result, rates_table),
        *_search_parts(result, objectives),
    ]
    facts = {**view.facts, **_make_page_facts(result)}
    about = _list_subjects(result)
    view = replace(view, sections=sections, facts=facts, about=about)
    # script elements with data, which the scripts of the page read
    data = make_object_data(object_file)
    if frames:
        search_objectives = objectives.get("search", [])
        data = [_frames_data(frames, search_objectives), *data]
    object_scripts = ["object.js"] if object_file else []
    scripts = ["make.js", "attack.js", *object_scripts]
    return make_view_page(run, result, view, data=data, scripts=scripts)


def _result_parts(
    run: Path, summary: AttackSummary, rates_table: ResultPart
) -> list[ResultPart]:
    """Return the sections about what was found: changes, textures, failures, rates.

    Args:
        run: the run directory.
        summary: summary of the attack.
        rates_table: table of the rates without bars.
    """
    return [
        _changes_part(summary),
        _textures_part(run),
        *_failures_parts(summary),
        _rates_part(summary, rates_table),
        *display.make_ambient_parts(summary),
    ]


def _search_parts(
    summary: AttackSummary, objectives: Mapping[str, list[float | None]]
) -> list[ResultPart]:
    """Return the sections about how the search went; see `_search_part`."""
    method_rows = [[name, text] for name, text in wording.method_texts(summary).items()]
    return [
        _search_part(summary, objectives),
        ResultPart("How the search worked", rows=method_rows, folded=True),
        _plan_part(summary.gradient_plan),
    ]


def _make_page_facts(summary: AttackSummary) -> dict[str, str]:
    """Return the facts that only a page displays, by name."""
    return {
        "time": _time_text(summary.seconds),
        "image formation": words.format_formation(summary.image_formation),
        "environment": summary.environment,
        "seed": str(summary.seed),
    }


def _list_subjects(summary: AttackSummary) -> list[str]:
    """Return the subject of the result in a few names."""
    return [
        wording.budget_text(summary),
        summary.object,
        summary.environment,
        summary.model,
    ]


def _read_objectives(run: Path) -> dict[str, list[float | None]]:
    """Read the objectives of the search and of the baseline, in order of evaluation."""
    if not (run / store.NAME).is_file():
        return {}
    with store.Store(run / store.NAME, read_only=True) as stored:
        return {
            kind: [row.objective for row in stored.rows(kind)]
            for kind in ("search", "baseline")
        }


def _time_text(seconds: Mapping[str, float]) -> str:
    """Return the total time, with that of each stage."""
    times = {name: words.format_seconds(value) for name, value in seconds.items()}
    total = times.pop("total")
    stages = ", ".join(f"{name} {text}" for name, text in times.items())
    return f"{total} ({stages})" if stages else total


def _frames_data(frames: list[str], objectives: Sequence[float | None]) -> Html:
    """Return the frames of the search for the page's script.

    The last frame is the adversarial scene. The others are evenly spaced over the
    evaluations, and each has its step and the objective of that step.

    Args:
        frames: images of the frames as data URLs, at least two.
        objectives: objectives of all evaluations of the search.
    """
    last_step = max(len(objectives) - 1, 0)
    n_search_frames = len(frames) - 1  # without the adversarial scene
    steps = [round(step) for step in np.linspace(0, last_step, n_search_frames)]
    # an interrupted search may have no objective yet
    frame_objectives = [
        objectives[step] if step < len(objectives) else None for step in steps
    ]
    data = {"pictures": frames, "steps": steps, "objectives": frame_objectives}
    return make_data_script(data, "frames")


def _image_parts(
    run: Path, summary: AttackSummary, *, animated: bool
) -> Iterator[ResultPart]:
    """Yield the sections with images.

    A section with `live` is filled by a script of the page, and is hidden without it.

    Args:
        run: the run directory.
        summary: summary of the attack.
        animated: whether there are frames of the search.
    """
    images = run / directory.IMAGES
    yield _model_input_part(summary)
    yield ResultPart(live="compare")
    if (images / f"clean{MARKED}").is_file():
        yield _marks_part(summary)
    trial_images = _find_trial_images(images)
    if trial_images:
        yield _trials_part(trial_images)
    if animated:
        yield ResultPart("The search, step by step", live="search")
    if summary.drive is not None:
        yield _drive_part(summary)


def _trials_part(trial_images: list[Picture]) -> ResultPart:
    """Return the section with the images of trials, which is folded."""
    return ResultPart(
        "Pictures of the verification",
        pictures=[trial_images],
        layout="small",
        folded=True,
    )


def _model_input_part(summary: AttackSummary) -> ResultPart:
    """Return the section with the images of both scenes and their difference."""
    caption = f"{files.DIFFERENCE_GAIN:g} times magnified, grey where nothing changed"
    difference = Picture("images/difference.png", caption, "Difference")
    return ResultPart(
        "What the model sees",
        pictures=[[*_clean_and_adversarial(summary, ".png"), difference]],
        note=_trial_note(summary),
    )


def _marks_part(summary: AttackSummary) -> ResultPart:
    """Return the section with both images and the marks of their predictions."""
    return ResultPart(
        "What it predicts",
        pictures=[_clean_and_adversarial(summary, MARKED)],
        layout="large",
        note=words.get_marks_legend(summary.task),
    )


def _drive_part(summary: AttackSummary) -> ResultPart:
    """Return the section with the frames of both scenes along a path."""
    caption = "from the first frame to the last"
    strips = [
        Picture("images/drive-clean.png", caption, "Clean"),
        Picture("images/drive.png", caption, "Adversarial"),
    ]
    note = f"The model is {wording.drive_text(summary)}."
    return ResultPart("Along the drive", pictures=[strips], layout="rows", note=note)


def _clean_and_adversarial(summary: AttackSummary, suffix: str) -> list[Picture]:
    """Return the images of both scenes; `suffix` is the end of their file names."""
    pictures = []
    predictions = {"clean": summary.clean, "adversarial": summary.adversarial}
    for name, prediction in predictions.items():
        caption = "no prediction recorded"
        if prediction is not None:
            caption = words.format_prediction(summary.task, prediction)
        pictures.append(Picture(f"images/{name}{suffix}", caption, name.capitalize()))
    return pictures


def _trial_note(summary: AttackSummary) -> str:
    """Return under which conditions both scenes were rendered for their images.

    Empty if no conditions vary by chance.
    """
    conditions = " and ".join(summary.over)
    trial = summary.clean.trial
    if not conditions:
        return ""
    if trial is None:
        return f"Both with the {conditions} of the original scene."
    return (
        f"Both from trial {trial}, with the same {conditions}. In other trials these "
        "differ, and so may the prediction."
    )


def _find_trial_images(images: Path) -> list[Picture]:
    """Return the images of the first trials, those with marks if there are any."""
    names = sorted(file.name for file in images.glob("verification*.png"))
    marked_names = [name for name in names if name.endswith(MARKED)]
    pictures = []
    for name in (marked_names or names)[:MAX_TRIAL_IMAGES]:
        trial = "".join(filter(str.isdigit, name))  # "verification-07.png" is trial 07
        pictures.append(Picture(f"images/{name}", f"trial {trial}"))
    return pictures


def _changes_part(summary: AttackSummary) -> ResultPart:
    """Return the table of the parameters that were changed.

    A column that is empty in all rows is left out. Bars of the ranges are drawn only if
    no column is left out.
    """
    changes = (summary.configuration or {}).items()
    rows = [_make_change_row(name, changed) for name, changed in changes]
    bars = [_range_bar(changed) for _, changed in changes]
    heads = ("parameter", "clean", "adversarial", "in its range")
    columns = _find_filled_columns(rows, len(heads))
    has_all_columns = len(columns) == len(heads)
    return ResultPart(
        "What was changed" if rows else "",
        column_heads=[heads[column] for column in columns],
        rows=[[row[column] for column in columns] for row in rows],
        bars=bars if has_all_columns else (),  # type: ignore[arg-type]
    )


def _find_filled_columns(rows: Sequence[Sequence[str]], n_columns: int) -> list[int]:
    """Return the indices of the columns of a table that have any text."""
    return [column for column in range(n_columns) if any(row[column] for row in rows)]


def _make_change_row(name: str, changed: FoundValue) -> list[str]:
    """Return the row of a parameter: its name, both values, and its range."""
    clean = "" if changed.clean is None else format_number(changed.clean)
    values = changed.value if isinstance(changed.value, list) else [changed.value]
    # the unit of a discrete choice is "name"
    has_unit = changed.unit not in (*words.PLAIN_UNITS, "name")
    unit = f" {changed.unit}" if has_unit else ""
    adversarial = ", ".join(map(format_number, values)) + unit
    return [name, clean, adversarial, _range_text(changed)]


def _range_text(changed: FoundValue) -> str:
    """Return the range of a number, and whether the number is at its end.

    Empty if it has no range, or if the value is not a single number.
    """
    low = changed.low
    high = changed.high
    if low is None or high is None or not isinstance(changed.value, (int, float)):
        return ""
    distance_to_end = min(changed.value - low, high - changed.value)
    is_at_end = distance_to_end <= END_TOLERANCE * (high - low)
    at_end = ", at its end" if is_at_end else ""
    return f"{format_number(low)} to {format_number(high)}{at_end}"


def _range_bar(changed: FoundValue) -> tuple[float, ...] | None:
    """Return the bar between the clean value and the adversarial one: begin, end, mark.

    These are fractions of the range, in [0, 1], and the mark is the adversarial value.
    Without a clean value, the bar has no length. None if the parameter has no range, or
    if its value is not a single number.
    """
    low = changed.low
    high = changed.high
    value = changed.value
    if low is None or high is None or not isinstance(value, (int, float)):
        return None
    clean = changed.clean if isinstance(changed.clean, (int, float)) else value
    points = (min(clean, value), max(clean, value), value)
    fractions = [(point - low) / (high - low) for point in points]
    return tuple(min(max(fraction, 0.0), 1.0) for fraction in fractions)


def _textures_part(run: Path) -> ResultPart:
    """Return the textures before and after, if the run has them."""
    originals = [
        file.name
        for file in sorted((run / directory.ARTIFACTS).glob("texture*-original.png"))
        if re.fullmatch(r"texture(@[\w-]+)?-original\.png", file.name)
    ]
    pictures = [picture for name in originals for picture in _texture_pair(name)]
    title = "The textures" if len(originals) > 1 else "The texture"
    picture_rows = [pictures] if pictures else []
    return ResultPart(title, pictures=picture_rows, layout="pair")


def _texture_pair(original: str) -> tuple[Picture, Picture]:
    """Return a texture before and after, by the name of the file before."""
    adversarial = f"artifacts/{original.removesuffix('-original.png')}.png"
    caption = f"adversarial texture; {adversarial}"
    return (
        Picture(f"artifacts/{original}", "original texture", "Original"),
        Picture(adversarial, caption, "Adversarial"),
    )


def _failures_parts(summary: AttackSummary) -> Iterator[ResultPart]:
    """Yield the section about different failures, if the policy looked for them."""
    known = summary.failures
    if known is None:
        return
    pictures = [
        _make_failure_picture(summary.task, failure, failure.picture)
        for failure in known.listed
        if failure.picture and failure.holds
    ]
    picture_rows = [pictures] if pictures else []
    yield replace(
        display.make_failures_part(known),
        title="Different failures",
        text=[f"Failures are {display.failures_text(known)}."],
        pictures=picture_rows,
    )


def _make_failure_picture(task: str, failure: DifferentFailure, file: str) -> Picture:
    """Return the image of a failure, named by its prediction, with its ranges."""
    prediction = ""
    if failure.pictured:  # the prediction of this image
        prediction = words.format_prediction(task, failure.pictured)
    name = prediction or display.most_frequent_label(failure)
    return Picture(file, display.range_text(failure), name)


def _rates_part(summary: AttackSummary, table: ResultPart) -> ResultPart:
    """Return the table of rates with bars; empty if there are no rates.

    Args:
        summary: summary of the attack.
        table: the same without bars, with the columns name, prediction, number, rate
            and interval.
    """
    bars = _list_rate_bars(summary)
    has_rates = any(bars)
    if not has_rates:
        return ResultPart()
    return replace(
        table,
        title="Verified rates",
        column_heads=_put_rate_first(table.column_heads),
        rows=[_put_rate_first(row) for row in table.rows],
        bars=bars,
        note=_rates_note(summary),
    )


def _rates_note(summary: AttackSummary) -> str:
    """Return how the images of the verification were rendered, and the intervals made."""
    spp = f", {summary.verified.spp} samples per pixel" if summary.verified else ""
    return f"Fresh seeds, pictures rounded to 8 bits, Clopper-Pearson intervals{spp}."


def _list_rate_bars(
    summary: AttackSummary,
) -> list[tuple[float, float, float] | None]:
    """Return the bar of each row of the rates: an interval with a mark at the rate.

    A bar is (begin, end, mark); None if the row has no rate.
    """
    # in the order of the table's rows, see `display._rates_part`
    rates: list[ControlGroup | VerifiedRate | None] = [summary.clean.control]
    if summary.adversarial:
        rates.append(summary.verified)
    if summary.baseline:
        rates.append(summary.baseline.verified)
    bars: list[tuple[float, float, float] | None] = [
        None if rate is None else (*rate.interval, rate.rate) for rate in rates
    ]
    if summary.average:
        bars.append((*summary.average.interval, summary.average.accuracy))
    return bars


def _put_rate_first(cells: Sequence[str]) -> list[str]:
    """Move rate and interval right after the name: a phone cuts off the rest."""
    name, prediction, number, rate, interval = cells
    return [name, rate, interval, prediction, number]


def _search_part(
    summary: AttackSummary, objectives: Mapping[str, list[float | None]]
) -> ResultPart:
    """Return the chart of the objective over evaluations; empty without any.

    Args:
        summary: summary of the attack.
        objectives: objectives of the "search" and of the "baseline", the random search,
            in order of evaluation; None if an objective was not a number.
    """
    curves = _select_curves(summary, objectives)
    if not curves:
        return ResultPart()
    ranges = [_curve_range_text(name, values) for name, values in curves.items()]
    label = words.format_objective(summary.objective)
    zero_means = _zero_line_text(summary)
    return ResultPart(
        "The search",
        [f"{label} over evaluations. {'; '.join(ranges)}"],
        draw=partial(draw_searches, curves, label, zero_means=zero_means),
        note="Lines: the best so far. Dots: each evaluation. These are claims of the "
        "search; the table above is verified.",
    )


def _select_curves(
    summary: AttackSummary, objectives: Mapping[str, list[float | None]]
) -> dict[str, list[float | None]]:
    """Return the objectives of the searches with any, by the name of the policy."""
    curves = dict[str, list[float | None]]()
    for kind, name in (("search", summary.policy), ("baseline", "random search")):
        values = objectives.get(kind, [])
        if any(value is not None for value in values):
            curves[name] = values
    return curves


def _curve_range_text(name: str, values: Sequence[float | None]) -> str:
    """Return the first and the largest objective of a search, with its name."""
    known = [value for value in values if value is not None]
    return f"{name}: from {known[0]:.3g} to {max(known):.3g}"


def _zero_line_text(summary: AttackSummary) -> str:
    """Return what a prediction is if the objective is above 0; empty if not known."""
    if summary.objective not in words.SUCCESS_ABOVE_ZERO:
        return ""
    # With the setting `minimise` the search seeks a right prediction.
    if summary.minimises:
        return "above: right"
    return f"above: {wording.format_success_word(summary)}"


def _plan_part(plan: PlannedGradient) -> ResultPart:
    """Return the table of gradient estimators."""
    columns: Mapping[str, Column] = {
        "parameter": "{0.name}",
        "numbers": "{0.size}",
        "derivative": "{0.estimator}",
        "why": "{0.reason}",
        "step": _step_text,
    }
    spp = "" if plan.spp is None else f", {format_count(plan.spp, 'sample')} a pixel"
    renders = format_count(plan.renders_per_gradient, "render")
    title = (
        f"Gradient plan: {format_count(len(plan.groups), 'parameter')}, {renders} per "
        f"gradient in addition to the picture itself{spp}"
    )
    return ResultPart.make_table(plan.groups, columns, title=title, folded=True)


def _step_text(group: GroupDerivative) -> str:
    """Return the step of finite differences, and why it was chosen; empty without one."""
    if not group.step_reason:  # the derivative takes no finite differences
        return ""
    step = f"{group.step:.3g} of its range"
    if group.step_in_unit is not None:
        unit = "" if group.unit in words.PLAIN_UNITS else f" {group.unit}"
        step = f"{group.step_in_unit:.3g}{unit}"
    return f"{step}: {group.step_reason}"


def _read_frames(file: Path) -> list[str]:
    """Return the frames of an animation as data URLs of JPEG files.

    There are none if the file is missing or corrupt, or has a single frame.
    """
    frames = []
    try:
        with Image.open(file, formats=("GIF",)) as animation:
            for frame in ImageSequence.Iterator(animation):
                stream = io.BytesIO()
                frame.convert("RGB").save(stream, "JPEG", quality=FRAME_QUALITY)
                frames.append(make_data_url(stream.getvalue(), "image/jpeg"))
    except files.BAD_PICTURE:
        return []
    return frames if len(frames) > 1 else []
