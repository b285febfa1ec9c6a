"""What is shown and claimed of the results of `attack`: of one, of several epsilons,
and of several models.
"""

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


def shown(result: AttackResults) -> ShownResult:
    """Return the verdict, the rates and the cost; of a curve or a matrix, its tables
    and its figure.
    """
    if isinstance(result, CurveResult):
        return _shown_curve(result)
    return (
        _shown_matrix(result)
        if isinstance(result, MatrixResult)
        else _shown_attack(result)
    )


def claims(result: AttackResults) -> Iterator[Claim]:
    if isinstance(result, CurveResult):
        yield from _claims_of_curve(result)
    elif isinstance(result, MatrixResult):
        for row in result.table:
            for cell in row.tested:
                at_home = cell.model == row.attacked
                spent = (
                    views.searches_text(row.renders, result.policy, False)
                    if at_home
                    else None
                )
                name = f"searched on {row.attacked}, tried on {cell.model}"
                yield views.case_claim(name, cell.ending, cell.verified, spent)
    else:
        rate = result.verified
        verdict = wording.attack_verdict(result)
        extent = views.extent_of("fresh renders that count as a success", rate)
        if result.ending == "found" and rate is not None and rate.successes:
            text = f"{verdict} How many such configurations there are is not known."
            yield views.claim("found", text, extent)
        elif result.ending in views.ENDED and rate is not None:
            spent = views.searches_text(
                result.renders, result.policy, result.baseline is not None
            )
            yield views.claim(
                "not found",
                f"{verdict} Searched were {spent}. {views.NO_PROOF}",
                extent,
            )
        else:
            unknown = (
                f"the search ended as {result.ending!r} without trials that "
                "carry a claim"
            )
            yield views.nothing_claimed(views.WHY.get(result.ending, unknown), verdict)
        if result.average is not None:
            yield views.average_claim(result.average, wording.budget_text(result))


def _shown_attack(summary: AttackSummary) -> ShownResult:
    sections = [_rates(summary)]
    if summary.failures and summary.failures.tried:
        sections.append(failures_part(summary.failures, tried=True))
    sections += ambient_part(summary)
    cautions = [
        text for text in wording.remarks(summary) if text not in summary.warnings
    ]
    facts = {
        "wanted": wording.goal_text(summary),
        "changed": wording.changed_text(summary),
        "objective": wording.objective_text(summary),
        "printable": wording.print_cost_text(summary),
        "over": f"{' and '.join(summary.over)}, drawn anew for every picture"
        if summary.over
        else "",
        "along the drive": wording.drive_text(summary),
        "smallest": wording.smallest_text(summary),
        "failures": failures_text(summary.failures) if summary.failures else "",
        "search": f"{summary.policy}, {words.count(summary.steps, 'step')}: "
        f"{summary.ending}",
        "renders": wording.renders_text(summary),
        "environment": "",  # the page has it, and the seed
        "seed": "",
    }
    return ShownResult(
        wording.attack_verdict(summary),
        sections,
        facts,
        cautions=cautions,
        says_interrupted=True,
    )


def _rates(summary: AttackSummary) -> ResultPart:
    def rate(what: str, rated: VerifiedRate | ControlGroup | None) -> Sequence[str]:
        if rated is None:
            return "not verified", ""
        number = rated.correct if isinstance(rated, ControlGroup) else rated.successes
        return words.tally(
            what, number, rated.trials, rated.not_a_number
        ), words.interval_text(rated.interval)

    clean = summary.clean
    baseline = summary.baseline
    average = summary.average
    success = wording.success(summary)
    rows = [
        [
            "clean",
            *words.prediction_cells(summary.task, clean),
            *rate("right", clean.control),
        ]
    ]
    if summary.adversarial:
        cells = words.prediction_cells(summary.task, summary.adversarial)
        rows.append(["adversarial", *cells, *rate(success, summary.verified)])
    if baseline:
        rows.append(
            [
                "random search",
                f"{baseline.renders} pictures",
                "",
                *rate(success, baseline.verified),
            ]
        )
    if average:
        right = words.tally("right", average.correct, average.configurations)
        drawn = words.count(average.configurations, "configuration")
        rows.append(
            ["average case", drawn, "", right, words.interval_text(average.interval)]
        )
    number = "action" if summary.task == words.COMMAND else "probability"
    return ResultPart(
        heads=("", "prediction", number, "rate", "95 % interval"), rows=rows
    )


def ambient_part(summary: AttackSummary) -> list[ResultPart]:
    light = summary.ambient
    if light is None:
        return []
    ends = (
        "also in direct sun"
        if light.ends_at is None
        else f"no longer at {light.ends_at:.3g} lux"
    )
    more = light.holds_to / light.lux
    text = (
        f"Works up to {light.holds_to:.3g} lux, {more:.3g} times the light that is "
        f"there, and {ends}."
    )
    columns: Mapping[str, Column] = {
        "ambient light": "{0.lux:.3g} lux",
        "wrong": lambda point: words.tally(
            wording.success(summary), point.verified.successes, point.verified.trials
        ),
        "95 % interval": lambda point: words.interval_text(point.verified.interval),
        "": lambda point: "holds" if point.holds else "ends",
    }
    note = (
        "Exposure follows the ambient light: the projector alone is darker beside it."
    )
    return [
        ResultPart.table(
            light.points, columns, title="Ambient light", text=[text], note=note
        )
    ]


def failures_text(known: DifferentFailures) -> str:
    where = f"{known.found} of {words.count(known.seen, 'draw')}"
    if known.places is not None:
        where = (
            f"{known.found} of {known.places} cells over "
            f"{' and '.join(known.over)} ({known.seen} were seen)"
        )
    if (share := known.share) is not None:
        where += (
            f"; of all configurations {words.interval_text(share.interval)} fail "
            "in one render (95 % interval)"
        )
        where += (
            ""
            if share.estimate is None
            else (f", {words.percent(share.estimate)} by the estimate")
        )
    if not known.tried:
        return f"claimed in {where}; none of these was tried with fresh renders"
    return (
        f"claimed in {where}; with fresh renders {known.held} of the {known.tried} "
        "that were tried hold"
    )


def failures_part(known: DifferentFailures, *, tried: bool = False) -> ResultPart:
    def held(failure: DifferentFailure) -> str:
        if (rate := failure.verified) is None:
            return "not tried"
        return (
            f"{'yes' if failure.holds else 'no'}, {rate.successes} of "
            f"{words.count(rate.trials, 'render')}"
        )

    columns: Mapping[str, Column] = {
        "failures": range_text,
        "most often predicted": most_predicted,
        "holds in fresh renders": held,
        "objective": lambda failure: words.number_text(failure.objective),
    }
    return ResultPart.table(
        (
            failure
            for failure in known.listed
            if not tried or failure.verified is not None
        ),
        columns,
    )


def range_text(failure: DifferentFailure) -> str:
    """Return where a failure lies: ``pose.yaw 36 to 72 degrees, material.kind
    brass``.
    """
    texts = []
    for name, ends in failure.ranges.items():
        value = failure.configuration.get(name)
        unit = "" if value is None or value.unit in ("", "1") else f" {value.unit}"
        lies = (
            ends
            if isinstance(ends, str)
            else (f"{words.number_text(ends[0])} to {words.number_text(ends[1])}{unit}")
        )
        texts.append(f"{name} {lies}")
    return ", ".join(texts) or "anywhere"


def most_predicted(failure: DifferentFailure) -> str:
    return next(iter(failure.verified.labels), "") if failure.verified else ""


# ---- robust accuracy against epsilon
# --------------------------------------------------------------------------------

CURVE_NOTE = (
    "Robust: recognised as it is, and no configuration was verified within the "
    "epsilon. That is what these attacks "
    "found: a stronger one may find more. Clopper-Pearson intervals over objects."
)


def _shown_curve(result: CurveResult) -> ShownResult:
    by_epsilon: Mapping[str, Column] = {
        "epsilon": lambda point: plain_epsilon(point.epsilon) or "own",
        "robust": "{0.robust}/{0.objects}",
        "accuracy": lambda point: words.percent(point.accuracy),
        "95 % interval": lambda point: words.interval_text(point.interval),
        "wrong already": "{0.already_wrong}",
    }
    by_object: Mapping[str, Column] = {
        "object": "{0.object}",
        "clean right": lambda row: (
            f"{row.clean.correct}/{row.clean.trials}" if row.clean else ""
        ),
        "ending": lambda row: row.ending or "not reached",
        "epsilon": lambda row: plain_epsilon(row.epsilon),
        "wrong": lambda row: (
            f"{row.verified.successes}/{row.verified.trials}" if row.verified else ""
        ),
        "margin": lambda row: "" if row.margin is None else f"{row.margin:.2f}",
    }
    if any(row.average for row in result.table):
        by_object = {
            **by_object,
            "right on average": _average_text,
            "95 % interval": _average_interval,
        }
    known = [point for point in result.curve if point.accuracy is not None]
    points = [point for point in known if point.epsilon is not None]
    listed = "; ".join(
        f"{point.robust} of {point.objects} at {point.epsilon:g}" for point in points
    )
    chart = ResultPart(
        "Robust accuracy", [f"Over epsilon with 95 % intervals: {listed}."],
        draw=lambda axes: _draw_curve(result, points, axes), size=(5.6, 3.6),
        only="page" if len(points) > 1 else "notebook",
    )  # fmt: skip
    curve = ResultPart.table(
        known, by_epsilon, title="" if len(points) > 1 else chart.title, note=CURVE_NOTE
    )
    runs = [row.run for row in result.table]
    objects = ResultPart.table(
        result.table,
        by_object,
        title="The objects, at the last epsilon tried",
        parts=runs,
    )
    meaning = ResultPart(
        text=[
            f"Margin: {words.margin_text(result.task)}, in the "
            "trials of the worst case."
        ]
    )
    sections = [
        *([chart] if points else []),
        *([curve] if known else []),
        objects,
        meaning,
    ]
    return ShownResult(
        _curve_text(result, known),
        sections,
        {"model": result.model, "policy": result.policy},
    )


def _average_text(row: ObjectRow) -> str:
    """Return how many of the random configurations of an object are right; empty where
    none was drawn.
    """
    if row.average is None:
        return ""
    share = words.percent(row.average.accuracy)
    return f"{row.average.correct}/{row.average.configurations} ({share})"


def _average_interval(row: ObjectRow) -> str:
    return words.interval_text(row.average.interval) if row.average else ""


def _curve_text(result: CurveResult, known: Sequence[CurvePoint]) -> str:
    def at(epsilon: float | None) -> str:
        return "" if epsilon is None else f" at epsilon {epsilon:g}"

    row = result.table[0] if result.table else None
    if not known or row is None:
        return "No object was attacked to the end."
    if len(result.objects) > 1:
        ends = [
            f"{point.robust} of {point.objects}{at(point.epsilon)}"
            for point in (*known[:1], *known[1:][-1:])
        ]
        return f"Still recognised: {' and '.join(ends)}."
    if row.ending == "already wrong":
        return f"The model is wrong about {row.object} as it is."
    if row.flips_at is None:
        return f"{row.object} is recognised{at(row.tried)}."
    return f"{row.object} is first got wrong at epsilon {plain_epsilon(row.flips_at)}."


def plain_epsilon(value: EpsilonBudget) -> str:
    if isinstance(value, dict):
        return ",".join(
            f"{name}={plain_epsilon(epsilon)}" for name, epsilon in value.items()
        )
    return "" if value is None else words.number_text(value)


def _draw_curve(result: CurveResult, points: Sequence[CurvePoint], axes: Any) -> None:
    at = [point.epsilon for point in points]
    accuracy = [point.accuracy for point in points]
    low, high = ([point.interval[end] for point in points] for end in (0, 1))
    axes.fill_between(
        at, low, high, color=BLUE, alpha=0.15, linewidth=0, label="95 % interval"
    )
    axes.plot(at, accuracy, color=BLUE, marker="o", label="robust accuracy")
    axes.set(xlabel="epsilon", ylabel="robust accuracy", ylim=(-0.02, 1.02))
    axes.set_title(
        f"{', '.join(result.controls)}: {points[0].objects} objects, {result.model}"
    )
    axes.grid(True)
    axes.legend()


def _claims_of_curve(result: CurveResult) -> Iterator[Claim]:
    total: Counter[str] = Counter()
    for row in result.table:
        total.update(row.renders or {})
    searched = views.searches_text(total, result.policy, bool(total["baseline"]))
    spent = f"Searched were, of all objects and epsilons together, {searched}. "
    for point in result.curve:
        if point.accuracy is None:
            continue
        extent = views.counted(
            "objects without a failure", point.robust, point.objects, point.interval
        )
        where = (
            "the controls' own budget"
            if point.epsilon is None
            else f"epsilon {point.epsilon:g}"
        )
        text = (
            f"Within {where} the policy {result.policy} found no failure of "
            f"{views.share_text(extent)} objects; "
            f"{point.already_wrong} are wrong as they are. "
            f"{spent if total else ''}{views.NO_PROOF}"
        )
        yield views.claim("measured", text, extent)
    for row in result.table:
        if row.average is not None:
            yield views.average_claim(row.average, row.object)


# ---- attacked on against tested on
# ----------------------------------------------------------------------------------


def _shown_matrix(result: MatrixResult) -> ShownResult:
    """The matrix, with a row for the clean scene; the stronger a cell's colour, the
    more successes.
    """
    marks = {"found": " *", "already wrong": " (wrong already)"}
    heads = [
        "attacked on",
        "ending",
        *(f"tested on {words.short_name(tried.model)}" for tried in result.tested),
    ]
    right = [
        f"right {', '.join(words.rated_cells(tried.clean))}" for tried in result.tested
    ]
    rows = [["clean scene", "", *right]] if right else []
    before = len(rows)
    shares = dict[tuple[int, int], float]()
    for up, row in enumerate(result.table, before):
        cells = [
            ", ".join(words.rated_cells(cell.verified)) + marks.get(cell.ending, "")
            for cell in row.tested
        ]
        rows.append([words.short_name(row.attacked), row.ending, *cells])
        shares |= {
            (up, across): cell.verified.rate
            for across, cell in enumerate(row.tested, 2)
        }
    spp = f", {result.tested[0].spp} samples per pixel" if result.tested else ""
    note = (
        "Successes of the trials, in which the model is wrong on the adversarial scene "
        "and right on the clean scene "
        "with the same seed, with 95 % Clopper-Pearson intervals; * where that is "
        "verified. All models are shown the "
        f"scene with the same seeds{spp}, rounded to 8 bits. The stronger a cell's "
        "colour, the more successes."
    )
    runs = [*[None] * before, *(row.run for row in result.table)]
    table = ResultPart(
        "Attacked on, tested on",
        heads=heads,
        rows=rows,
        note=note,
        parts=runs,
        shares=shares,
    )
    tried = sum(bool(row.tested) for row in result.table)
    size = (2.6 + 1.3 * len(result.models), 1.8 + 0.5 * tried)
    figure = ResultPart(
        draw=lambda axes: _draw_matrix(result, axes), size=size, only="notebook"
    )
    facts = {
        "models": ", ".join(
            f"{tried.model} ({' x '.join(map(str, tried.input_size))})"
            for tried in result.tested
        ),
        "ensemble": result.ensemble or "",
        "policy": result.policy,
    }
    at_home = [
        cell.ending
        for row in result.table
        for cell in row.tested
        if cell.model == row.attacked
    ]
    others = [
        cell.ending
        for row in result.table
        for cell in row.tested
        if cell.model != row.attacked
    ]
    held = at_home.count("found")
    passed = others.count("found")
    pairs = len(at_home) + len(others)
    text = (
        f"{held} of {len(at_home)} answers hold on the model that they were searched "
        "on; "
        f"{passed} of {len(others)} on another one."
    )
    if not pairs:
        text = "No adversarial scene was tried on any model."
    elif result.ensemble is not None:
        text = (
            f"One scene against all models together misleads {held + passed} of "
            f"{pairs}."
        )
    return ShownResult(text, [table, *([figure] if tried else [])], facts)


def _draw_matrix(result: MatrixResult, axes: Any) -> None:
    rows = [row for row in result.table if row.tested]
    rates = [[cell.verified.rate for cell in row.tested] for row in rows]
    axes.imshow(rates, cmap="Reds", vmin=0.0, vmax=1.0, aspect="auto")
    for up, row in enumerate(rows):
        for across, cell in enumerate(row.tested):
            text = f"{cell.verified.successes}/{cell.verified.trials}"
            colour = "white" if rates[up][across] > 0.6 else "black"
            axes.text(across, up, text, ha="center", va="center", color=colour)
    names = [words.short_name(tried.model) for tried in result.tested]
    axes.set_xticks(
        range(len(names)), names, rotation=20 if max(map(len, names)) > 12 else 0
    )
    axes.set_yticks(range(len(rows)), [words.short_name(row.attacked) for row in rows])
    axes.set(xlabel="tested on", ylabel="attacked on")
    axes.set_title(
        f"{', '.join(result.objects)}, {', '.join(result.controls)}: wrong in trials"
    )
