"""The views and the claims of attacks, of curves over epsilon, and of matrices."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from advsearch.questions.attack import wording
from advsearch.questions.attack.summary import (
    AmbientLight,
    AttackSummary,
    BaselineSearch,
    CurvePoint,
    CurveResult,
    DifferentFailure,
    DifferentFailures,
    EpsilonBudget,
    FailingShare,
    MatrixResult,
    MatrixRow,
    ObjectRow,
)
from advsearch.report import views
from advsearch.report import wording as words
from advsearch.report.figures import BLUE
from advsearch.report.views import Claim, Column, ResultPart, ShownResult
from advsearch.runs.results import AverageCase, ControlGroup, VerifiedRate

AttackResults = AttackSummary | CurveResult | MatrixResult
# columns of the table of a matrix before those of the rates
N_LEADING_COLUMNS = 2
AMBIENT_NOTE = (
    "Exposure follows the ambient light: in brighter light the projector's image is "
    "darker."
)
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
        text = f"{verdict} {_searched_text(result)} {views.NO_PROOF}"
        return views.make_claim("not found", text, extent)
    other_reason = (
        f"the search ended as {result.ending!r} without trials that support a claim"
    )
    reason = views.REASON_OF_ENDING.get(result.ending, other_reason)
    return views.make_no_claim(reason, verdict)


def _searched_text(result: AttackSummary) -> str:
    """Return how much an attack searched, as a sentence."""
    searches = views.format_searches(
        result.renders, result.policy, random=result.baseline is not None
    )
    return f"Searched were {searches}."


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
    cautions = [
        text for text in wording.make_remarks(summary) if text not in summary.warnings
    ]
    return ShownResult(
        wording.attack_verdict(summary),
        _list_attack_sections(summary),
        _make_attack_facts(summary),
        cautions=cautions,
        says_interrupted=True,  # the verdict states that the attack was interrupted
    )


def _list_attack_sections(summary: AttackSummary) -> list[ResultPart]:
    """Return the tables of one attack: rates, tried failures and ambient light."""
    # `page.make_page` has sections of its own; only the first of these, the rates, is
    # used there, with bars.
    sections = [_rates_part(summary)]
    if summary.failures and summary.failures.tried:
        sections.append(make_failures_part(summary.failures, tried=True))
    sections += make_ambient_parts(summary)
    return sections


def _make_attack_facts(summary: AttackSummary) -> dict[str, str]:
    """Return the facts of one attack by name; some are empty."""
    over = ""
    if summary.over:
        over = f"{' and '.join(summary.over)}, drawn anew for every picture"
    steps = words.format_count(summary.steps, "step")
    return {
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


def _rates_part(summary: AttackSummary) -> ResultPart:
    """Return the table of predictions and rates."""
    number_head = "action" if summary.task == words.COMMAND else "probability"
    heads = ("", "prediction", number_head, "rate", "95 % interval")
    return ResultPart(column_heads=heads, rows=_list_rate_rows(summary))


def _list_rate_rows(summary: AttackSummary) -> list[list[str]]:
    """Return the rows of the rates: both scenes, the random search and the average."""
    clean = summary.clean
    success = wording.format_success_word(summary)
    prediction = words.format_prediction_cells(summary.task, clean)
    rows = [["clean", *prediction, *_rate_cells("right", clean.control)]]
    if summary.adversarial:
        prediction = words.format_prediction_cells(summary.task, summary.adversarial)
        rate = _rate_cells(success, summary.verified)
        rows.append(["adversarial", *prediction, *rate])
    if summary.baseline:
        rows.append(_make_baseline_row(summary.baseline, success))
    if summary.average:
        rows.append(_make_average_row(summary.average))
    return rows


def _make_baseline_row(baseline: BaselineSearch, success: str) -> list[str]:
    """Return the row of the random search; `success` is the word for a success."""
    images = f"{baseline.renders} pictures"
    return ["random search", images, "", *_rate_cells(success, baseline.verified)]


def _make_average_row(average: AverageCase) -> list[str]:
    """Return the row of the accuracy on random configurations."""
    right = words.format_tally("right", average.correct, average.configurations)
    configurations = words.format_count(average.configurations, "configuration")
    interval = words.format_interval(average.interval)
    return ["average case", configurations, "", right, interval]


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
    part = ResultPart.make_table(
        light.points,
        _make_ambient_columns(wording.format_success_word(summary)),
        title="Ambient light",
        text=[_ambient_text(light)],
        note=AMBIENT_NOTE,
    )
    return [part]


def _make_ambient_columns(success: str) -> dict[str, Column]:
    """Return the columns of the table of ambient light; `success` names a success."""
    return {
        "ambient light": "{0.lux:.3g} lux",
        "wrong": lambda point: words.format_tally(
            success, point.verified.successes, point.verified.trials
        ),
        "95 % interval": lambda point: words.format_interval(point.verified.interval),
        "": lambda point: "holds" if point.holds else "ends",
    }


def _ambient_text(light: AmbientLight) -> str:
    """Return up to which ambient light an adversarial scene works, as a sentence."""
    limit = "also in direct sun"  # in every light that was tried
    if light.limit_lux is not None:
        limit = f"no longer at {light.limit_lux:.3g} lux"
    factor = light.holds_to / light.lux
    return (
        f"Works up to {light.holds_to:.3g} lux, {factor:.3g} times the light of the "
        f"scene, and {limit}."
    )


def failures_text(failures: DifferentFailures) -> str:
    """Return where different failures were found, and how many hold.

    Some policies divide the space into cells, and failures are counted in cells. Other
    policies draw configurations, and failures are counted in draws.
    """
    where = _searched_space_text(failures)
    if failures.share is not None:
        where += _share_text(failures.share)
    if not failures.tried:
        return f"claimed in {where}; none of these was tried with fresh renders"
    return (
        f"claimed in {where}; with fresh renders {failures.verified} of the "
        f"{failures.tried} that were tried hold"
    )


def _searched_space_text(failures: DifferentFailures) -> str:
    """Return in how many cells, or draws, of all that there are a failure is claimed."""
    if failures.cells is None:
        return f"{failures.found} of {words.format_count(failures.examined, 'draw')}"
    return (
        f"{failures.found} of {failures.cells} cells over "
        f"{' and '.join(failures.over)} ({failures.examined} were evaluated)"
    )


def _share_text(share: FailingShare) -> str:
    """Return what share of all configurations fails, as a clause."""
    interval = words.format_interval(share.interval)
    text = f"; of all configurations {interval} fail in one render (95 % interval)"
    if share.estimate is not None:
        text += f", {words.percent(share.estimate)} by the estimate"
    return text


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
    texts = [_bounds_text(failure, name) for name in failure.ranges]
    return ", ".join(texts) or "anywhere"


def _bounds_text(failure: DifferentFailure, name: str) -> str:
    """Return the range of one parameter of a failure: ``pose.yaw 36 to 72 degrees``."""
    bounds = failure.ranges[name]
    if isinstance(bounds, str):  # the option of a discrete choice
        return f"{name} {bounds}"
    unit = ""
    value = failure.configuration.get(name)
    if value is not None and value.unit not in words.PLAIN_UNITS:
        unit = f" {value.unit}"
    low, high = map(words.format_number, bounds)
    return f"{name} {low} to {high}{unit}"


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
    margin = words.get_margin_meaning(result.task)
    meaning = f"Margin: {margin}, in the trials of the worst case."
    sections = [
        *([_curve_chart(result, points)] if points else []),
        *([_points_part(known, has_chart)] if known else []),
        _objects_part(result),
        ResultPart(text=[meaning]),
    ]
    facts = {"model": result.model, "policy": result.policy}
    return ShownResult(_curve_text(result, known), sections, facts)


def _curve_chart(result: CurveResult, points: Sequence[CurvePoint]) -> ResultPart:
    """Return the chart of robust accuracy; a page has it only with several points.

    Args:
        result: result of the curve.
        points: the points that have an epsilon and a robust accuracy.
    """
    rates = [
        f"{point.robust} of {point.objects} at {point.epsilon:g}" for point in points
    ]
    points_text = "; ".join(rates)
    return ResultPart(
        CURVE_TITLE,
        [f"Over epsilon with 95 % intervals: {points_text}."],
        draw=lambda axes: _draw_curve(result, points, axes),
        size=(5.6, 3.6),
        only_medium="page" if len(points) > 1 else "notebook",
    )


def _points_part(known: Sequence[CurvePoint], has_chart: bool) -> ResultPart:
    """Return the table of robust accuracy; the chart has the title if there is one."""
    point_columns: Mapping[str, Column] = {
        "epsilon": lambda point: epsilon_text(point.epsilon) or "own",
        "robust": "{0.robust}/{0.objects}",
        "accuracy": lambda point: words.percent(point.accuracy),
        "95 % interval": lambda point: words.format_interval(point.interval),
        "wrong already": "{0.already_wrong}",
    }
    return ResultPart.make_table(
        known, point_columns, title="" if has_chart else CURVE_TITLE, note=CURVE_NOTE
    )


def _objects_part(result: CurveResult) -> ResultPart:
    """Return the table of the objects of a curve."""
    columns: dict[str, Column] = {
        "object": "{0.object}",
        "clean right": _clean_tally,
        "ending": lambda row: row.ending or "not reached",
        "epsilon": lambda row: epsilon_text(row.epsilon),
        "wrong": _wrong_tally,
        "margin": lambda row: "" if row.margin is None else f"{row.margin:.2f}",
    }
    if any(row.average for row in result.table):
        columns["right on average"] = _average_text
        columns["95 % interval"] = _average_interval
    title = "The objects, at the last epsilon tried"
    runs = [row.run for row in result.table]
    return ResultPart.make_table(result.table, columns, title=title, parts=runs)


def _clean_tally(row: ObjectRow) -> str:
    """Return in how many renders the clean object is right; empty if not known."""
    return f"{row.clean.correct}/{row.clean.trials}" if row.clean else ""


def _wrong_tally(row: ObjectRow) -> str:
    """Return how many trials of the adversarial scene succeeded; empty if none."""
    return f"{row.verified.successes}/{row.verified.trials}" if row.verified else ""


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
    if not known or not result.table:
        return "No object was attacked to the end."
    if len(result.objects) > 1:
        return _several_objects_text(known)
    return _single_object_text(result.table[0])


def _several_objects_text(known: Sequence[CurvePoint]) -> str:
    """Return the robust accuracy at the first and the last epsilon in a sentence."""
    first_and_last = [known[0]] if len(known) == 1 else [known[0], known[-1]]
    rates = [
        f"{point.robust} of {point.objects}{_at_epsilon_text(point.epsilon)}"
        for point in first_and_last
    ]
    return f"Still recognised: {' and '.join(rates)}."


def _at_epsilon_text(epsilon: float | None) -> str:
    """Return " at epsilon 0.1"; empty if each control has an epsilon of its own."""
    return "" if epsilon is None else f" at epsilon {epsilon:g}"


def _single_object_text(row: ObjectRow) -> str:
    """Return the result of a curve with a single object in a sentence."""
    if row.ending == "already wrong":
        return f"The model is wrong about {row.object} as it is."
    if row.flips_at is None:
        return f"{row.object} is recognised{_at_epsilon_text(row.tried)}."
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
    searches = _curve_searches_text(result)
    for point in result.curve:
        if point.accuracy is not None:
            yield _point_claim(point, result.policy, searches)
    for row in result.table:
        if row.average is not None:
            yield views.make_average_claim(row.average, row.object)


def _curve_searches_text(result: CurveResult) -> str:
    """Return how much a curve searched, as a sentence; empty if that is not known."""
    renders: Counter[str] = Counter()
    for row in result.table:
        renders.update(row.renders or {})
    if not renders:
        return ""
    has_random_search = bool(renders["baseline"])
    spent = views.format_searches(renders, result.policy, random=has_random_search)
    return f"Searched were, of all objects and epsilons together, {spent}. "


def _point_claim(point: CurvePoint, policy: str, searches: str) -> Claim:
    """Return the claim of the robust accuracy at one epsilon.

    Args:
        point: point of the curve with a robust accuracy.
        policy: name of the policy.
        searches: how much was searched, as a sentence.
    """
    extent = views.Extent.from_count(
        "objects without a failure", point.robust, point.objects, point.interval
    )
    budget = "the controls' own budget"  # if each has its own epsilon
    if point.epsilon is not None:
        budget = f"epsilon {point.epsilon:g}"
    text = (
        f"Within {budget} the policy {policy} found no failure of "
        f"{views.format_extent(extent)} objects; "
        f"{point.already_wrong} are wrong as they are. "
        f"{searches}{views.NO_PROOF}"
    )
    return views.make_claim("measured", text, extent)


def _view_matrix(result: MatrixResult) -> ShownResult:
    """Return the view of a matrix."""
    # rows of scenes that were tried on models
    n_rows = sum(bool(row.tested) for row in result.table)
    sections = [_matrix_part(result)]
    if n_rows:
        sections.append(_matrix_figure(result, n_rows))
    facts = {
        "models": _tested_models_text(result),
        "ensemble": result.ensemble or "",
        "policy": result.policy,
    }
    return ShownResult(_matrix_text(result), sections, facts)


def _matrix_figure(result: MatrixResult, n_rows: int) -> ResultPart:
    """Return the figure of a matrix for a notebook; `n_rows` have rates."""
    return ResultPart(
        draw=lambda axes: _draw_matrix(result, axes),
        size=(2.6 + 1.3 * len(result.models), 1.8 + 0.5 * n_rows),
        only_medium="notebook",
    )


def _tested_models_text(result: MatrixResult) -> str:
    """Return the models of a matrix with the sizes of their images."""
    texts = []
    for tested in result.tested:
        size = " x ".join(map(str, tested.input_size))
        texts.append(f"{tested.model} ({size})")
    return ", ".join(texts)


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
    clean_rows: list[list[str]] = []
    if result.tested:
        clean_rows = [["clean scene", "", *_clean_rate_cells(result)]]
    rows = [*clean_rows, *map(_make_matrix_row, result.table)]
    clean_runs: list[str | None] = [None] * len(clean_rows)
    return ResultPart(
        "Attacked on, tested on",
        column_heads=_list_matrix_heads(result),
        rows=rows,
        note=_matrix_note(result),
        parts=[*clean_runs, *(row.run for row in result.table)],
        cell_fractions=_find_cell_rates(result, first_row=len(clean_rows)),
    )


def _list_matrix_heads(result: MatrixResult) -> list[str]:
    """Return the heads of the table of a matrix: scene, ending, and tested models."""
    tested_names = [words.shorten_name(tested.model) for tested in result.tested]
    return ["attacked on", "ending", *(f"tested on {name}" for name in tested_names)]


def _find_cell_rates(
    result: MatrixResult, first_row: int
) -> dict[tuple[int, int], float]:
    """Return the rate of each cell by its row and its column in the table.

    Args:
        result: the matrix.
        first_row: row of the first attack.
    """
    return {
        (row_index, column_index): cell.verified.rate
        for row_index, row in enumerate(result.table, start=first_row)
        for column_index, cell in enumerate(row.tested, start=N_LEADING_COLUMNS)
    }


def _make_matrix_row(row: MatrixRow) -> list[str]:
    """Return the cells of a scene: its model, its ending, its rate on each model."""
    cells = [words.shorten_name(row.attacked), row.ending]
    for cell in row.tested:
        rate = ", ".join(words.format_rate_cells(cell.verified))
        cells.append(rate + ENDING_MARKS.get(cell.ending, ""))
    return cells


def _matrix_note(result: MatrixResult) -> str:
    """Return what the rates of a matrix count."""
    spp = f", {result.tested[0].spp} samples per pixel" if result.tested else ""
    return (
        "Successes of the trials, in which the model is wrong on the adversarial scene "
        "and right on the clean scene "
        "with the same seed, with 95 % Clopper-Pearson intervals; * where that is "
        "verified. All models are shown the "
        f"scene with the same seeds{spp}, rounded to 8 bits. The stronger a cell's "
        "colour, the more successes."
    )


def _matrix_text(result: MatrixResult) -> str:
    """Return the result of a matrix in a sentence.

    An adversarial scene holds on a model if its trials there end as "found".
    """
    # how the trials ended, on the model that was attacked and on other models
    endings_on_same = _list_endings(result, on_same_model=True)
    endings_on_other = _list_endings(result, on_same_model=False)
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


def _list_endings(result: MatrixResult, *, on_same_model: bool) -> list[str]:
    """Return how the trials ended, on the attacked models or on the other ones."""
    return [
        cell.ending
        for row in result.table
        for cell in row.tested
        if (cell.model == row.attacked) == on_same_model
    ]


MAX_LEVEL_CHARACTERS = 12  # names under a matrix with more characters are slanted
SLANT_DEGREES = 20
DARK_RATE = 0.6  # cells with a larger rate are so dark that their text is white


def _draw_matrix(result: MatrixResult, axes: Any) -> None:
    """Draw the rates of a matrix on matplotlib axes.

    A row is a model that was attacked, and a column a model on which the scene was
    tried.
    """
    rows = [row for row in result.table if row.tested]
    _draw_matrix_cells(rows, axes)
    tested_names = [words.shorten_name(tested.model) for tested in result.tested]
    has_long_names = max(map(len, tested_names)) > MAX_LEVEL_CHARACTERS
    rotation = SLANT_DEGREES if has_long_names else 0
    axes.set_xticks(range(len(tested_names)), tested_names, rotation=rotation)
    attacked_names = [words.shorten_name(row.attacked) for row in rows]
    axes.set_yticks(range(len(rows)), attacked_names)
    axes.set(xlabel="tested on", ylabel="attacked on")
    axes.set_title(
        f"{', '.join(result.objects)}, {', '.join(result.controls)}: wrong in trials"
    )


def _draw_matrix_cells(rows: Sequence[MatrixRow], axes: Any) -> None:
    """Draw the rates of a matrix as colored cells, with their counts as texts."""
    rates = [[cell.verified.rate for cell in row.tested] for row in rows]
    axes.imshow(rates, cmap="Reds", vmin=0.0, vmax=1.0, aspect="auto")
    for y, row in enumerate(rows):
        for x, cell in enumerate(row.tested):
            text = f"{cell.verified.successes}/{cell.verified.trials}"
            color = "white" if rates[y][x] > DARK_RATE else "black"
            axes.text(x, y, text, ha="center", va="center", color=color)
