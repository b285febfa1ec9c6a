"""Compare the worst case with the average over the same space, for each object and each control."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, ClassVar

from pydantic import Field

from advsearch.config import SceneConfig
from advsearch.experiment import RunContext, experiment
from advsearch.questions.attack.settings import AttackConfig
from advsearch.report import wording
from advsearch.report.figures import BLUE, GREY, RED
from advsearch.report.shown import (
    Claim,
    Column,
    InNotebook,
    ResultPart,
    ShownResult,
    average_claim,
    case_claim,
    searches_text,
)
from advsearch.report.wording import margin_text, percent
from advsearch.runs.results import AverageCase, Fields, JsonFloat, StudyResult, VerifiedRate
from advsearch.settings import setting_as_in

NOTE = (
    "On average: configurations drawn at random from the whole space and budget. Worst: trials of the configuration "
    "that the search found, with fresh seeds. Clopper-Pearson intervals."
)


class GapConfig(AttackConfig):
    """Everything that decides what `gap` does: the worst case beside the average, for each object and each control."""

    command: ClassVar[str] = "gap"
    several: ClassVar[tuple[str, ...]] = ("object",)
    without: ClassVar[tuple[str, ...]] = ("smallest", "ensemble", "printable", "aov", "metrics", "log")

    model: str = setting_as_in(SceneConfig, "model")
    average: int = setting_as_in(AttackConfig, "average", default=200, ge=1)
    workers: int | None = setting_as_in(AttackConfig, "workers", description="worker processes that share the attacks")


class GapRow(Fields):
    """The worst case beside the average, of one object and one control."""

    object: str
    control: str
    average: AverageCase
    worst: VerifiedRate | None = Field(description="trials of the worst configuration")
    ending: str
    margin: JsonFloat | None = Field(description="mean of these trials, in logits")
    renders: dict[str, int]
    run: str | None

    @property
    def left(self) -> float:
        """Accuracy of the worst configuration: what is left of its trials."""
        return 0.0 if self.ending == "already wrong" else 1.0 - self.worst.rate if self.worst else 1.0


class GapResult(InNotebook, StudyResult):
    """The worst case beside the average, over the same space and budget, for each object and each control."""

    command: ClassVar[str] = "gap"

    table: list[GapRow]


def shown(result: GapResult) -> ShownResult:
    columns: dict[str, Column] = {
        "object": "{0.object}",
        "control": "{0.control}",
        "right on average": lambda row: (
            f"{row.average.correct}/{row.average.configurations} ({percent(row.average.accuracy)})"
        ),
        "95 % interval": lambda row: wording.interval_text(row.average.interval),
        "worst: wrong": lambda row: f"{row.worst.successes}/{row.worst.trials}" if row.worst else "",
        "margin": lambda row: "" if row.margin is None else f"{row.margin:.2f}",
        "ending": "{0.ending}",
    }
    rows, facts = result.table, {"model": result.model, "policy": result.policy}
    if not rows:
        return ShownResult("Nothing was compared to its end.", [], facts)
    chart = {"height": 110 + 34 * len(rows), "size": (6.4, 1.6 + 0.36 * len(rows)), "parts": [row.run for row in rows]}
    title = "The worst case beside the average"
    table = ResultPart.table(rows, columns, title=title, note=NOTE, draw=lambda axes: draw(result, axes), **chart)
    meaning = ResultPart(text=[f"Margin: {margin_text(result.task)}, in the trials of the worst case."])
    shares = [percent(share) for share in sorted(row.average.accuracy for row in rows)]
    said = f"The model is right in {' to '.join(dict.fromkeys((shares[0], shares[-1])))} of random configurations"
    found = sum(row.ending == "found" for row in rows)
    if len(rows) == 1:
        said += f", {'yet one' if found else 'and none'} is found that it gets wrong."
    else:
        said += f", yet in {found} of {len(rows)} cases one is found that it gets wrong."
    return ShownResult(said, [table, meaning], facts)


def draw(result: GapResult, axes: Any) -> None:
    """Draw, for each object and control, the accuracy on average and of the worst configuration, joined by a line."""
    rows = result.table[::-1]
    for place, row in enumerate(rows):
        mean, label = row.average.accuracy, "_" if place else ""  # one entry of the legend for all rows
        axes.plot(row.average.interval, [place, place], color=BLUE, alpha=0.35, linewidth=5)
        axes.plot([row.left, mean], [place, place], color=GREY, linewidth=1)
        axes.plot(mean, place, "o", color=BLUE, ms=4, zorder=4, label=label or "average, with 95 % interval")
        # an outline: where the two are equal, both are seen
        axes.plot(row.left, place, "D", color=RED, mfc="none", mew=1.5, ms=9, label=label or "worst found, verified")
    axes.set_yticks(range(len(rows)), [f"{row.object}, {row.control}" for row in rows])
    axes.set(xlabel="accuracy", xlim=(-0.03, 1.03), ylim=(-0.6, len(rows) - 0.4))
    axes.set_title(f"Average and worst case: {result.model}")
    axes.grid(True, axis="x")
    axes.figure.legend(loc="outside lower center", ncols=2)


def claims(result: GapResult) -> Iterator[Claim]:
    for row in result.table:
        name = f"{row.object}, {row.control}"
        yield average_claim(row.average, name)
        spent = searches_text(row.renders, result.policy, bool(row.renders.get("baseline")))
        yield case_claim(name, row.ending, row.worst, spent)


@experiment(
    "gap --object mug --control pose,camera,texture",
    "gap --object mug,bowl,bottle --control pose --average 500 --steps 80",
    positional_args=("object", "model"),
    view=shown,
    claims=claims,
)
def gap(asked: RunContext[GapConfig]) -> GapResult:
    """Compare the worst configuration with the average, for each object and each control (docs/questions.md)."""
    from advsearch.questions.attack.studies import StudyRun  # imports torch

    study, rows = StudyRun(asked), list[GapRow]()
    for (one,) in study.chains:
        summary = study.attack(one)
        if summary is not None and summary.average is not None:
            worst = summary.verified
            own = {"object": one.config.object, "control": one.of, "worst": worst, "margin": worst and worst.margin}
            rows.append(GapRow.of({**vars(summary), **own}))
    return study.result(GapResult, table=rows)
