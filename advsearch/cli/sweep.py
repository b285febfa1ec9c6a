"""`advsearch sweep`: how often the model is right over a grid or draws, where it is not, and what it cost."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from advsearch.cli.output import aligned, as_notes
from advsearch.cli.question import QuestionCommand
from advsearch.report import wording
from advsearch.report.phrases import answer_text, beside_text, margin_text, percent
from advsearch.report.surface_words import surface_sentences

if TYPE_CHECKING:
    from advsearch.runs.results.sweep import AxisRow, PairedRates, SweepSummary, WorstConfiguration
    from advsearch.settings import Config

HELP = "measure how often the model is right over a grid or a random sample of configurations"
EXAMPLES = (
    "sweep --object mug --grid pose.yaw=0:360:24 --grid camera.elevation=5:60:8",
    "sweep --object mug,bowl --environment studio,noon --grid camera.azimuth=0,90,180,270",
    "sweep --object mug --control pose,camera --samples 1000",
    "sweep --object mug --control pose --samples 200 --surface",
    "sweep --answer-of mug-texture-001 --control camera,environment --samples 200",
)
READING = "How often it is right at each value, over all others, with the 95 % interval:"
"""What the tables show."""

BAR = 20
"""Width of a bar in characters."""

MOST_ROWS = 24
"""Values of an axis that are all shown; of more, half as many: those where the model does worst."""


class _Sweep(QuestionCommand):
    """The command, which may take scene and model from the run whose answer it sweeps."""

    def config(self, args: argparse.Namespace) -> Config:
        """Return what the flags describe, over what the run of an answer brings."""
        file = self.file(args)
        if file is None:
            return super().config(args)
        from advsearch.cli.flags import config_from
        from advsearch.config import AttackConfig, SweepConfig

        varies = "grid" in args or "controls" in args
        return config_from(args, SweepConfig, **SweepConfig.of_answer(AttackConfig.from_yaml(file), varies=varies))


def answer(summary: SweepSummary) -> str:
    """Return accuracy in total and by axis, the worst configuration and the cost."""
    from advsearch.report.distance import distance_of, distance_sentence

    facts = [[name, text] for name, text in _facts(summary).items() if text]
    far = distance_of(summary)
    distance = distance_sentence(far) if far else ""
    parts = [
        _verdict(summary),
        distance,
        *_drives(summary),
        *_tables(summary),
        "\n".join(_surface(summary)),
        aligned(facts),
    ]
    return "\n\n".join(part for part in parts if part) + as_notes(summary.warnings)


def _verdict(summary: SweepSummary) -> str:
    from advsearch.runs.results.base import INTERRUPTED

    seen, correct = summary.configurations, summary.correct
    if not seen:
        return "Interrupted before the first configuration."
    rate = f"{percent(summary.accuracy)}, 95 % interval {wording.interval_text(summary.interval)}"
    if summary.ending == INTERRUPTED and seen < summary.planned:
        return f"Interrupted after {seen} of {summary.planned} configurations: right in {correct} ({rate})."
    if summary.beside and summary.beside.pairs:
        return "\n\n".join(_beside(pair, summary.beside.answer) for pair in summary.beside.pairs)
    return f"The model is right in {correct} of {wording.count(seen, 'configuration')} ({rate})."


def _beside(pair: PairedRates, answer: str) -> str:
    """What the pairs of a model say, and both rates side by side."""
    rows = [
        [
            name,
            f"right in {one.correct} of {one.configurations}",
            percent(one.accuracy),
            wording.interval_text(one.interval),
        ]
        for name, one in (("clean", pair.clean), (answer, pair.answer))
    ]
    return f"{beside_text(answer, pair)}\n\n{aligned(rows)}"


def _tables(summary: SweepSummary) -> list[str]:
    by_axis: dict[str, list[AxisRow]] = {}
    for row in (one for one in summary.axes if one.axis != "answer"):
        by_axis.setdefault(row.axis, []).append(row)
    reading = (
        f"Of the clean scene and the answer together: {READING[0].lower()}{READING[1:]}" if summary.beside else READING
    )
    return [reading, *(_table(name, rows) for name, rows in by_axis.items())] if by_axis else []


def _table(name: str, rows: Sequence[AxisRow]) -> str:
    """One axis: a bar and a rate for each value."""
    shown, title = list(rows), name + (f", {rows[0].unit}" if rows[0].unit not in ("", "name", "1") else "")
    if len(rows) > MOST_ROWS:
        worst = sorted(range(len(rows)), key=lambda number: rows[number].accuracy or 0.0)[: MOST_ROWS // 2]
        shown = [rows[number] for number in sorted(worst)]
        title += f" (the {len(shown)} of {len(rows)} values where the model is right least often)"
    lines = [
        [
            _value(row.value),
            _bar(row.accuracy or 0.0),
            percent(row.accuracy),
            f"{row.correct} of {row.configurations}",
            wording.interval_text(row.interval),
        ]
        for row in shown
    ]
    return f"{title}\n{aligned(lines)}"


def _drives(summary: SweepSummary) -> list[str]:
    """What is said of whole drives, where frames of a path were swept."""
    from advsearch.report.drives import HEADS, drive_rows, drive_title

    return [f"{drive_title(one)}\n{aligned([HEADS, *drive_rows(one)])}" for one in summary.drives or ()]


def _surface(summary: SweepSummary) -> list[str]:
    """Which parts of the surface go with wrong answers, where that was asked for."""
    if summary.surface is None:
        return []
    return ["What is seen of the surface when the model is wrong:", *surface_sentences(summary.surface)]


def _bar(share: float) -> str:
    filled = round(share * BAR)
    return "#" * filled + "." * (BAR - filled)


def _value(value: Any) -> str:
    if isinstance(value, (list, tuple)):
        return " to ".join(_value(end) for end in value)
    return f"{value:.4g}" if isinstance(value, float) else wording.short_name(value)


def _facts(summary: SweepSummary) -> dict[str, str]:
    speed, worst = summary.renders_per_second, summary.worst
    return {
        "worst": _configuration(worst) if worst else "",
        "": _said(worst, summary.task) if worst else "",
        "renders": f"{summary.renders['sweep']}" + (f", {speed:.3g} a second" if speed else ""),
        "workers": wording.workers_text(summary.shared),
        "time": wording.seconds_text(summary.seconds["total"]),
        "worst drive": f"{summary.run}/images/drive.webp" if summary.drives and summary.run else "",
        "map of the surface": f"{summary.run}/images/surface.png" if summary.surface else "",
        "kept in": summary.run or "",
    }


def _configuration(worst: WorstConfiguration) -> str:
    outer = ("object", "environment", "model")
    names = [f"{name} {_value(one.value)}" for name, one in worst.values.items() if name not in outer]
    return ", ".join(
        [*(wording.short_name(worst.values[name].value) for name in outer if name in worst.values), *names]
    )


def _said(worst: WorstConfiguration, task: str) -> str:
    claim, checked = worst.claimed, worst.verified
    text = f"answer {answer_text(task, claim)}"
    rate = f"wrong in {wording.rate_text(checked)}" if checked else "not verified"
    return f"{text}; margin ({margin_text(task)}) {claim.margin:.3g}; {rate}"


COMMAND = _Sweep("sweep", answer, about="answer_of")
