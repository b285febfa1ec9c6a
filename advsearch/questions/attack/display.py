"""The views and the claims of attacks, of curves over epsilon, and of matrices."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from advsearch.questions.attack import wording
from advsearch.questions.attack.summary import (
    AttackSummary,
    CurvePoint,
    CurveResult,
    DifferentFailure,
    DifferentFailures,
    EpsilonBudget,
    MatrixResult,
    ObjectRow,
)
from advsearch.report import views
from advsearch.report import wording as words
from advsearch.report.figures import BLUE
from advsearch.report.views import Claim, Column, ResultPart, ShownResult
from advsearch.runs.results import ControlGroup, VerifiedRate

AttackResults = AttackSummary | CurveResult | MatrixResult
# what is appended to the rate in a cell of a matrix, by the ending of its trials
ENDING_MARKS = {"found": " *", "already wrong": " (wrong already)"}


def make_attack_view(result: AttackResults) -> ShownResult:
    """Return the view of an attack, a curve or a matrix."""
    if isinstance(result, CurveResult):
        return _view_curve(result)
    if isinstance(result, MatrixResult):
        return _view_matrix(result)
    return _view_attack(result)


def make_attack_claims(result: AttackResults) -> Iterator[Claim]:
    """Yield what an attack, a curve or a matrix claims."""
    if isinstance(result, CurveResult):
        yield from _curve_claims(result)
    elif isinstance(result, MatrixResult):
        yield from _matrix_claims(result)
    else:
        yield _attack_claim(result)
        if result.average is not None:
            yield views.make_average_claim(result.average, wording.budget_text(result))


def _attack_claim(result: AttackSummary) -> Claim:
    """Return what an attack claims of the scene that it found."""
    rate = result.verified
    verdict = wording.attack_verdict(result)
    extent = views.make_rate_extent("fresh renders that count as a success", rate)
    if result.ending == "found" and rate is not None and rate.successes:
        text = f"{verdict} How many such configurations exist is not known."
        return views.make_claim("found", text, extent)
    if result.ending in views.FAILED_SEARCH_ENDINGS and rate is not None:
        searches = views.format_searches(
            result.renders, result.policy, random=result.baseline is not None
        )
        text = f"{verdict} Searched were {searches}. {views.NO_PROOF}"
        return views.make_claim("not found", text, extent)
    other_reason = (
        f"the search ended as {result.ending!r} without trials that support a claim"
    )
    reason = views.REASON_OF_ENDING.get(result.ending, other_reason)
    return views.make_no_claim(reason, verdict)


def _matrix_claims(result: MatrixResult) -> Iterator[Claim]:
    """Yield what each scene of a matrix does to each model."""
    for row in result.table:
        for cell in row.tested:
            # A claim that nothing was found states how much was searched. On models that
            # were not attacked, the scene was only tried.
            searches = None
            if cell.model == row.attacked:
                searches = views.format_searches(
                    row.renders, result.policy, random=False
                )
            name = f"searched on {row.attacked}, tried on {cell.model}"
            yield views.make_case_claim(name, cell.ending, cell.verified, searches)


def _view_attack(summary: AttackSummary) -> ShownResult:
    """Return the view of one attack: its verdict, tables, facts and cautions.

    Facts with an empty text are not displayed.
    """
    # `page.make_page` has sections of its own; only the first of these, the rates, is
    # used there, with bars.
    sections = [_rates_part(summary)]
    if summary.failures and summary.failures.tried:
        sections.append(make_failures_part(summary.failures, tried=True))
    sections += make_ambient_parts(summary)
    cautions = [
        text for text in wording.make_remarks(summary) if text not in summary.warnings
    ]
    over = ""
    if summary.over:
        over = f"{' and '.join(summary.over)}, drawn anew for every picture"
    steps = words.format_count(summary.steps, "step")
    facts = {
        "wanted": wording.goal_text(summary),
        "changed": wording.changed_text(summary),
        "objective": wording.objective_text(summary),
        "printable": wording.print_cost_text(summary),
        "over": over,
        "along the drive": wording.drive_text(summary),
        "smallest": wording.smallest_text(summary),
        "failures": failures_text(summary.failures) if summary.failures else "",
        "search": f"{summary.policy}, {steps}: {summary.ending}",
        "renders": wording.renders_text(summary),
        # Only a page displays these two, and sets their texts. Here they have a place in
        # the order.
        "environment": "",
        "seed": "",
    }
    return ShownResult(
        wording.attack_verdict(summary),
        sections,
        facts,
        cautions=cautions,
        says_interrupted=True,  # the verdict states that the attack was interrupted
    )


def _rates_part(summary: AttackSummary) -> ResultPart:
    """Return the table of predictions and rates."""
    clean = summary.clean
    baseline = summary.baseline
    average = summary.average
    success = wording.format_success_word(summary)
    prediction = words.format_prediction_cells(summary.task, clean)
    rows = [["clean", *prediction, *_rate_cells("right", clean.control)]]
    if summary.adversarial:
        prediction = words.format_prediction_cells(summary.task, summary.adversarial)
        rate = _rate_cells(success, summary.verified)
        rows.append(["adversarial", *prediction, *rate])
    if baseline:
        images = f"{baseline.renders} pictures"
        rate = _rate_cells(success, baseline.verified)
        rows.append(["random search", images, "", *rate])
    if average:
        right = words.format_tally("right", average.correct, average.configurations)
        configurations = words.format_count(average.configurations, "configuration")
        interval = words.format_interval(average.interval)
        rows.append(["average case", configurations, "", right, interval])
    number_head = "action" if summary.task == words.COMMAND else "probability"
    heads = ("", "prediction", number_head, "rate", "95 % interval")
    return ResultPart(column_heads=heads, rows=rows)


def _rate_cells(
    outcome: str, rate: VerifiedRate | ControlGroup | None
) -> tuple[str, str]:
    """Return a rate and its interval; `outcome` names what is counted, such as "right"."""
    if rate is None:
        return "not verified", ""
    n_counted = rate.correct if isinstance(rate, ControlGroup) else rate.successes
    text = words.format_tally(outcome, n_counted, rate.trials, rate.not_a_number)
    return text, words.format_interval(rate.interval)


def make_ambient_parts(summary: AttackSummary) -> list[ResultPart]:
    """Return the section about ambient light, if it was tried.

    The adversarial scene is lit by a projector. The section states up to which other
    light on the object the model is still wrong.
    """
    light = summary.ambient
    if light is None:
        return []
    limit = "also in direct sun"  # in every light that was tried
    if light.limit_lux is not None:
        limit = f"no longer at {light.limit_lux:.3g} lux"
    factor = light.holds_to / light.lux
    text = (
        f"Works up to {light.holds_to:.3g} lux, {factor:.3g} times the light of the "
        f"scene, and {limit}."
    )
    columns: Mapping[str, Column] = {
        "ambient light": "{0.lux:.3g} lux",
        "wrong": lambda point: words.format_tally(
            wording.format_success_word(summary),
            point.verified.successes,
            point.verified.trials,
        ),
        "95 % interval": lambda point: words.format_interval(point.verified.interval),
        "": lambda point: "holds" if point.holds else "ends",
    }
    note = (
        "Exposure follows the ambient light: in brighter light the projector's image is "
        "darker."
    )
    return [
        ResultPart.make_table(
            light.points, columns, title="Ambient light", text=[text], note=note
        )
    ]


def failures_text(failures: DifferentFailures) -> str:
    """Return where different failures were found, and how many hold.

    Some policies divide the space into cells, and failures are counted in cells. Other
    policies draw configurations, and failures are counted in draws.
    """
    where = f"{failures.found} of {words.format_count(failures.examined, 'draw')}"
    has_cells = failures.cells is not None
    if has_cells:
        where = (
            f"{failures.found} of {failures.cells} cells over "
            f"{' and '.join(failures.over)} ({failures.examined} were evaluated)"
        )
    if failures.share is not None:
        interval = words.format_interval(failures.share.interval)
        where += (
            f"; of all configurations {interval} fail in one render (95 % interval)"
        )
        if failures.share.estimate is not None:
            where += f", {words.percent(failures.share.estimate)} by the estimate"
    if not failures.tried:
        return f"claimed in {where}; none of these was tried with fresh renders"
    return (
        f"claimed in {where}; with fresh renders {failures.verified} of the "
        f"{failures.tried} that were tried hold"
    )


def make_failures_part(known: DifferentFailures, *, tried: bool = False) -> ResultPart:
    """Return the table of different failures; with `tried` only those with trials."""
    columns: Mapping[str, Column] = {
        "failures": range_text,
        "most often predicted": most_frequent_label,
        "holds in fresh renders": _holds_text,
        "objective": lambda failure: words.format_number(failure.objective),
    }
    failures = [
        failure for failure in known.listed if not tried or failure.verified is not None
    ]
    return ResultPart.make_table(failures, columns)


def _holds_text(failure: DifferentFailure) -> str:
    """Return whether a failure holds, and in how many fresh renders."""
    rate = failure.verified
    if rate is None:
        return "not tried"
    renders = words.format_count(rate.trials, "render")
    answer = "yes" if failure.holds else "no"
    return f"{answer}, {rate.successes} of {renders}"


def range_text(failure: DifferentFailure) -> str:
    """Return the ranges of a failure as text.

    ``pose.yaw 36 to 72 degrees, material.kind brass``.
    """
    texts = []
    for name, bounds in failure.ranges.items():
        if isinstance(bounds, str):  # the option of a discrete choice
            texts.append(f"{name} {bounds}")
            continue
        unit = ""
        value = failure.configuration.get(name)
        if value is not None and value.unit not in words.PLAIN_UNITS:
            unit = f" {value.unit}"
        low, high = map(words.format_number, bounds)
        texts.append(f"{name} {low} to {high}{unit}")
    return ", ".join(texts) or "anywhere"


def most_frequent_label(failure: DifferentFailure) -> str:
    """Return the most frequent label in the trials of a failure; empty without any."""
    return next(iter(failure.verified.labels), "") if failure.verified else ""


CURVE_TITLE = "Robust accuracy"
CURVE_NOTE = (
    "Robust: recognised as it is, and no configuration was verified within the "
    "epsilon. That is what these attacks "
    "found: a stronger one may find more. Clopper-Pearson intervals over objects."
)


def _view_curve(result: CurveResult) -> ShownResult:
    """Return the view of robust accuracy against epsilon.

    With several epsilons, a page has the chart and the table. With a single one, only a
    notebook has the chart.
    """
    known = [point for point in result.curve if point.accuracy is not None]
    # A point without an epsilon stands for attacks in which each control had its own. It
    # has no position on the axis of the chart, and "own" in the table.
    points = [point for point in known if point.epsilon is not None]
    has_chart = len(points) > 1
    points_text = "; ".join(
        f"{point.robust} of {point.objects} at {point.epsilon:g}" for point in points
    )
    chart = ResultPart(
        CURVE_TITLE,
        [f"Over epsilon with 95 % intervals: {points_text}."],
        draw=lambda axes: _draw_curve(result, points, axes),
        size=(5.6, 3.6),
        only_medium="page" if has_chart else "notebook",
    )
    point_columns: Mapping[str, Column] = {
        "epsilon": lambda point: epsilon_text(point.epsilon) or "own",
        "robust": "{0.robust}/{0.objects}",
        "accuracy": lambda point: words.percent(point.accuracy),
        "95 % interval": lambda point: words.format_interval(point.interval),
        "wrong already": "{0.already_wrong}",
    }
    curve = ResultPart.make_table(
        known, point_columns, title="" if has_chart else CURVE_TITLE, note=CURVE_NOTE
    )
    margin = words.get_margin_meaning(result.task)
    meaning = f"Margin: {margin}, in the trials of the worst case."
    sections = [
        *([chart] if points else []),
        *([curve] if known else []),
        _objects_part(result),
        ResultPart(text=[meaning]),
    ]
    return ShownResult(
        _curve_text(result, known),
        sections,
        {"model": result.model, "policy": result.policy},
    )


def _objects_part(result: CurveResult) -> ResultPart:
    """Return the table of the objects of a curve."""
    columns: dict[str, Column] = {
        "object": "{0.object}",
        "clean right": lambda row: (
            f"{row.clean.correct}/{row.clean.trials}" if row.clean else ""
        ),
        "ending": lambda row: row.ending or "not reached",
        "epsilon": lambda row: epsilon_text(row.epsilon),
        "wrong": lambda row: (
            f"{row.verified.successes}/{row.verified.trials}" if row.verified else ""
        ),
        "margin": lambda row: "" if row.margin is None else f"{row.margin:.2f}",
    }
    if any(row.average for row in result.table):
        columns["right on average"] = _average_text
        columns["95 % interval"] = _average_interval
    return ResultPart.make_table(
        result.table,
        columns,
        title="The objects, at the last epsilon tried",
        parts=[row.run for row in result.table],
    )


def _average_text(row: ObjectRow) -> str:
    """Return how many random configurations of an object are right; empty if none."""
    if row.average is None:
        return ""
    accuracy = words.percent(row.average.accuracy)
    return f"{row.average.correct}/{row.average.configurations} ({accuracy})"


def _average_interval(row: ObjectRow) -> str:
    return words.format_interval(row.average.interval) if row.average else ""


def _curve_text(result: CurveResult, known: Sequence[CurvePoint]) -> str:
    """Return the result of a curve in a sentence.

    Args:
        result: result of the curve.
        known: the points of the curve with a robust accuracy.
    """

    def format_at(epsilon: float | None) -> str:
        """Return " at epsilon 0.1"; empty if each control has an epsilon of its own."""
        return "" if epsilon is None else f" at epsilon {epsilon:g}"

    if not known or not result.table:
        return "No object was attacked to the end."
    if len(result.objects) > 1:
        first_and_last = [known[0]] if len(known) == 1 else [known[0], known[-1]]
        rates = [
            f"{point.robust} of {point.objects}{format_at(point.epsilon)}"
            for point in first_and_last
        ]
        return f"Still recognised: {' and '.join(rates)}."
    row = result.table[0]
    if row.ending == "already wrong":
        return f"The model is wrong about {row.object} as it is."
    if row.flips_at is None:
        return f"{row.object} is recognised{format_at(row.tried)}."
    return f"{row.object} is first got wrong at epsilon {epsilon_text(row.flips_at)}."


def epsilon_text(value: EpsilonBudget) -> str:
    """Return an epsilon, or those of several controls, as text; empty for None."""
    if isinstance(value, dict):
        return ",".join(
            f"{name}={epsilon_text(epsilon)}" for name, epsilon in value.items()
        )
    return "" if value is None else words.format_number(value)


def _draw_curve(result: CurveResult, points: Sequence[CurvePoint], axes: Any) -> None:
    """Draw the robust accuracy over epsilon on matplotlib axes.

    Args:
        result: result of the curve, for the title.
        points: the epsilons with a robust accuracy, ascending.
        axes: axes of matplotlib.
    """
    epsilon = [point.epsilon for point in points]
    accuracy = [point.accuracy for point in points]
    low = [point.interval[0] for point in points]
    high = [point.interval[1] for point in points]
    axes.fill_between(
        epsilon, low, high, color=BLUE, alpha=0.15, linewidth=0, label="95 % interval"
    )
    axes.plot(epsilon, accuracy, color=BLUE, marker="o", label="robust accuracy")
    axes.set(xlabel="epsilon", ylabel="robust accuracy", ylim=(-0.02, 1.02))
    axes.set_title(
        f"{', '.join(result.controls)}: {points[0].objects} objects, {result.model}"
    )
    axes.grid(True)
    axes.legend()


def _curve_claims(result: CurveResult) -> Iterator[Claim]:
    """Yield the robust accuracy at each epsilon, and each object's average-case accuracy."""
    renders: Counter[str] = Counter()
    for row in result.table:
        renders.update(row.renders or {})
    searches = ""
    if renders:
        has_random_search = bool(renders["baseline"])
        spent = views.format_searches(renders, result.policy, random=has_random_search)
        searches = f"Searched were, of all objects and epsilons together, {spent}. "
    for point in result.curve:
        if point.accuracy is None:
            continue
        extent = views.Extent.from_count(
            "objects without a failure", point.robust, point.objects, point.interval
        )
        budget = "the controls' own budget"  # if each has its own epsilon
        if point.epsilon is not None:
            budget = f"epsilon {point.epsilon:g}"
        text = (
            f"Within {budget} the policy {result.policy} found no failure of "
            f"{views.format_extent(extent)} objects; "
            f"{point.already_wrong} are wrong as they are. "
            f"{searches}{views.NO_PROOF}"
        )
        yield views.make_claim("measured", text, extent)
    for row in result.table:
        if row.average is not None:
            yield views.make_average_claim(row.average, row.object)


def _view_matrix(result: MatrixResult) -> ShownResult:
    """Return the view of a matrix."""
    # rows of scenes that were tried on models
    n_rows = sum(bool(row.tested) for row in result.table)
    figure = ResultPart(
        draw=lambda axes: _draw_matrix(result, axes),
        size=(2.6 + 1.3 * len(result.models), 1.8 + 0.5 * n_rows),
        only_medium="notebook",
    )
    models = ", ".join(
        f"{tested.model} ({' x '.join(map(str, tested.input_size))})"
        for tested in result.tested
    )
    facts = {
        "models": models,
        "ensemble": result.ensemble or "",
        "policy": result.policy,
    }
    sections = [_matrix_part(result), *([figure] if n_rows else [])]
    return ShownResult(_matrix_text(result), sections, facts)


def _clean_rate_cells(result: MatrixResult) -> list[str]:
    """Return how often each model of a matrix is right about the clean scene."""
    return [
        f"right {', '.join(words.format_rate_cells(tested.clean))}"
        for tested in result.tested
    ]


def _matrix_part(result: MatrixResult) -> ResultPart:
    """Return the table of a matrix, with a row for the clean scene.

    The stronger a cell's color, the more successes.
    """
    heads = ["attacked on", "ending"]
    heads += [
        f"tested on {words.shorten_name(tested.model)}" for tested in result.tested
    ]
    rows = list[list[str]]()
    runs = list[str | None]()  # run of each row
    if result.tested:
        rows.append(["clean scene", "", *_clean_rate_cells(result)])
        runs.append(None)
    rate_of_cell = dict[tuple[int, int], float]()
    for row in result.table:
        cells = [words.shorten_name(row.attacked), row.ending]
        for cell in row.tested:
            # the position that the cell gets below, in `rows` and in `cells`
            row_index = len(rows)
            column_index = len(cells)
            rate_of_cell[row_index, column_index] = cell.verified.rate
            rate = ", ".join(words.format_rate_cells(cell.verified))
            cells.append(rate + ENDING_MARKS.get(cell.ending, ""))
        rows.append(cells)
        runs.append(row.run)
    spp = f", {result.tested[0].spp} samples per pixel" if result.tested else ""
    note = (
        "Successes of the trials, in which the model is wrong on the adversarial scene "
        "and right on the clean scene "
        "with the same seed, with 95 % Clopper-Pearson intervals; * where that is "
        "verified. All models are shown the "
        f"scene with the same seeds{spp}, rounded to 8 bits. The stronger a cell's "
        "colour, the more successes."
    )
    return ResultPart(
        "Attacked on, tested on",
        column_heads=heads,
        rows=rows,
        note=note,
        parts=runs,
        cell_fractions=rate_of_cell,
    )


def _matrix_text(result: MatrixResult) -> str:
    """Return the result of a matrix in a sentence.

    An adversarial scene holds on a model if its trials there end as "found".
    """
    # how the trials ended, on the model that was attacked and on other models
    endings_on_same = list[str]()
    endings_on_other = list[str]()
    for row in result.table:
        for cell in row.tested:
            is_same = cell.model == row.attacked
            endings = endings_on_same if is_same else endings_on_other
            endings.append(cell.ending)
    n_held = endings_on_same.count("found")
    n_transferred = endings_on_other.count("found")
    n_pairs = len(endings_on_same) + len(endings_on_other)
    if not n_pairs:
        return "No adversarial scene was tried on any model."
    if result.ensemble is not None:
        return (
            "One scene against all models together misleads "
            f"{n_held + n_transferred} of {n_pairs}."
        )
    return (
        f"{n_held} of {len(endings_on_same)} answers hold on the model that they were "
        f"searched on; {n_transferred} of {len(endings_on_other)} on another one."
    )


def _draw_matrix(result: MatrixResult, axes: Any) -> None:
    """Draw the rates of a matrix on matplotlib axes.

    A row is a model that was attacked, and a column a model on which the scene was
    tried.
    """
    rows = [row for row in result.table if row.tested]
    rates = [[cell.verified.rate for cell in row.tested] for row in rows]
    axes.imshow(rates, cmap="Reds", vmin=0.0, vmax=1.0, aspect="auto")
    for y, row in enumerate(rows):
        for x, cell in enumerate(row.tested):
            text = f"{cell.verified.successes}/{cell.verified.trials}"
            # readable on the dark end of the color scale
            color = "white" if rates[y][x] > 0.6 else "black"
            axes.text(x, y, text, ha="center", va="center", color=color)
    tested_names = [words.shorten_name(tested.model) for tested in result.tested]
    has_long_names = max(map(len, tested_names)) > 12
    rotation = 20 if has_long_names else 0
    axes.set_xticks(range(len(tested_names)), tested_names, rotation=rotation)
    axes.set_yticks(
        range(len(rows)), [words.shorten_name(row.attacked) for row in rows]
    )
    axes.set(xlabel="tested on", ylabel="attacked on")
    axes.set_title(
        f"{', '.join(result.objects)}, {', '.join(result.controls)}: wrong in trials"
    )
