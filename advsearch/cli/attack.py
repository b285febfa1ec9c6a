"""`advsearch attack`: the worst configuration of a scene, in a table that a person reads in five seconds."""

from __future__ import annotations

from typing import TYPE_CHECKING

from advsearch.cli.output import aligned, as_notes
from advsearch.cli.question import QuestionCommand
from advsearch.report import wording
from advsearch.report.failures import FAILURE_HEADS, failure_rows, failures_text
from advsearch.report.phrases import answer_cells

if TYPE_CHECKING:
    from advsearch.runs.results.attack import AttackSummary, VerifiedRate
    from advsearch.runs.results.base import Interval
    from advsearch.runs.results.gap import CurveResult
    from advsearch.runs.results.matrix import MatrixResult

HELP = "find the configuration of a scene that the model gets wrong most badly"
MORE = ", and verify it with fresh renders"
EXAMPLES = (
    "attack --object mug --control texture",
    "attack --object mug --control texture --epsilon 0.03 --set camera.azimuth=130 --seed 1",
    "attack --object mug --model reference,torchvision:resnet18 --label mug,cup",
)


def answer(summary: AttackSummary | CurveResult | MatrixResult) -> str:
    """Return the verdict, the rates, the cost and the place of the pictures; of a curve or a matrix, its tables."""
    from advsearch.runs.results.gap import CurveResult
    from advsearch.runs.results.matrix import MatrixResult

    if isinstance(summary, MatrixResult):
        return _matrix(summary)
    if isinstance(summary, CurveResult):
        from advsearch.cli import gap

        return gap.answer(summary)
    facts = [[name, text] for name, text in _facts(summary).items() if text]
    parts = [wording.attack_verdict(summary), aligned(_rates(summary)), aligned(facts)]
    if summary.failures and summary.failures.tried:
        parts.append(aligned([list(FAILURE_HEADS), *failure_rows(summary.failures, tried=True)]))
    return "\n\n".join(parts) + as_notes(wording.remarks(summary))


def _rates(summary: AttackSummary) -> list[list[str]]:
    clean, control, success = summary.clean, summary.clean.control, wording.success(summary)
    rated = (
        _rate("right", control.correct, control.trials, control.interval, control.not_a_number)
        if control
        else ["not verified"]
    )
    rows = [["clean", *answer_cells(summary.task, clean), *rated]]
    if summary.adversarial:
        rows.append(
            ["adversarial", *answer_cells(summary.task, summary.adversarial), *_verified(success, summary.verified)]
        )
    if summary.baseline:
        pictures = f"{summary.baseline.renders} pictures"
        rows.append(["random search", pictures, "", *_verified(success, summary.baseline.verified)])
    if summary.average:
        average = summary.average
        drawn = wording.count(average.configurations, "configuration")
        rows.append(
            ["average case", drawn, "", *_rate("right", average.correct, average.configurations, average.interval)]
        )
    return rows


def _verified(what: str, rated: VerifiedRate | None) -> list[str]:
    if rated is None:
        return ["not verified"]
    return _rate(what, rated.successes, rated.trials, rated.interval, rated.not_a_number)


def _rate(what: str, number: int, trials: int, interval: Interval, not_a_number: int = 0) -> list[str]:
    return [wording.tally(what, number, trials, not_a_number), wording.interval_text(interval)]


def _facts(summary: AttackSummary) -> dict[str, str]:
    return {
        "wanted": wording.goal_text(summary),
        "changed": wording.changed_text(summary),
        "objective": wording.objective_text(summary),
        "printable": wording.print_cost_text(summary),
        "over": wording.over_text(summary),
        "along the drive": wording.drive_text(summary),
        "smallest": wording.smallest_text(summary),
        "failures": failures_text(summary.failures) if summary.failures else "",
        "search": f"{summary.policy}, {wording.count(summary.steps, 'step')}: {summary.ending}",
        "renders": wording.renders_text(summary),
        "workers": wording.workers_text(summary.shared),
        "time": wording.seconds_text(summary.seconds["total"]),
        "pictures": summary.run or "",
    }


def _matrix(result: MatrixResult) -> str:
    from advsearch.report.transfer import matrix_heads, matrix_rows, matrix_text

    facts = [["time", wording.seconds_text(result.seconds["total"])], ["run", str(result.run)]]
    ending = "Interrupted." if result.ending == "interrupted" else ""
    parts = [matrix_text(result), aligned([matrix_heads(result), *matrix_rows(result)]), aligned(facts), ending]
    return "\n\n".join(filter(None, parts)) + as_notes(result.warnings)


COMMAND = QuestionCommand("attack", answer)
