"""`advsearch precision`: error against run time, as a table, JSON and diagrams."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from advsearch.cli import output
from advsearch.cli.question import QuestionCommand
from advsearch.report.wording import workers_text

if TYPE_CHECKING:
    from advsearch.runs.results.precision import (
        MeasuredError,
        NotMeasured,
        PrecisionPoint,
        PrecisionReference,
        PrecisionResult,
        PrecisionSlope,
        Recommended,
    )

HELP = "measure error against run time, draw it, and recommend settings"
EXAMPLES = (
    "precision --object mug --control pose",
    "precision --object mug --control texture --seconds 300 --error 0.1 --out diagrams",
    "precision --object bowl --control camera --quantities gradient --loss model --json",
)
READING = (
    "Each row is a setting: its error beside a reference of far more samples, with the 95 % interval of that error,\n"
    "and the seconds that one picture or gradient takes. A margin is how far the wrong answer leads the right one, in\n"
    "logits; a cosine of 1 means that a gradient points the right way. With a matrix of light transport, `again` is\n"
    "what another gradient takes once the first one is there."
)
"""What the tables show, and how to read them."""


def answer(report: PrecisionResult) -> str:
    """Return the report as text."""
    machine = report.machine
    threads = " and ".join(f"{count} of {name}" for name, count in machine.threads.items())
    lines = [
        f"{report.object} in {report.environment}, {report.model}; {machine.cpu}, "
        f"{machine.cores} cores, threads: {threads}; {report.seconds['total']:.0f} s",
        READING,
    ]
    for quantity, table in (("image", _errors), ("gradient", _errors), ("objective", _objectives)):
        points = [one for one in report.points if one.quantity == quantity]
        if points:
            lines += ["", f"{quantity}:", table(points)]
    if report.slopes:
        lines += ["", "slopes (logarithm of the error against that of samples or seconds):", _slopes(report.slopes)]
    lines += ["", "references, with their own errors:", _references(report.references)] if report.references else []
    lines += ["", f"workers: {workers_text(report.shared)}"] if report.shared else []
    lines += ["", "recommended:", *(f"  {sentence(one, report.goal)}" for one in report.recommendations)]
    lines += ["", "warnings:", *(f"  {one}" for one in report.warnings)] if report.warnings else []
    lines += ["", "It was stopped: only a part was measured."] if report.goes_on else []
    lines += ["", "not measured, the time was up:", *_left_out(report.left_out)] if report.left_out else []
    lines += ["", *(f"figure: {path}" for path in report.figures)] if report.figures else []
    return "\n".join(lines)


def sentence(one: Recommended, goal: float) -> str:
    """Return a recommendation as a sentence."""
    what = {"image": "the picture", "objective": "the best verified objective"}.get(one.quantity)
    what = what or f"the gradient of {one.control}"
    if one.measure == "margin_error":
        what = "the margin"
    asked = f"{100 * goal:.3g} % error of {what}" + (f" {one.among}" if one.among else "")
    if one.quantity == "objective":
        asked = f"{100 * (1 - goal):.3g} % of the largest median gain in the verified objective"
    if one.estimator is None:
        return f"{asked}: not reached by anything that was measured; give it more --seconds or a larger --error"
    if one.quantity == "objective":
        return f"{asked}: policy {one.estimator}, {one.renders} renders, {one.seconds:.2g} s"
    basis = "" if one.basis in ("interpolated", "fitted") else f" ({one.basis})"
    return f"{asked}: {one.estimator}, {one.spp} samples, {one.seconds:.2g} s{basis}"


# ---- tables ---------------------------------------------------------------------------------------------------------


def _errors(points: Sequence[PrecisionPoint]) -> str:
    margin = any(one.margin_error is not None for one in points)
    again = any(one.later_seconds is not None for one in points)
    heads = ["control"] * (not margin) + ["estimator", "samples", "error", "95 %"]
    rows = [[*heads, "margin" if margin else "cosine", "seconds", *["again"] * again, "repeats"]]
    for one in points:
        cosine = math.nan if one.cosine is None else one.cosine
        beside = _percent(one.error_by("margin_error")) if margin else f"{cosine:.3f}"
        place = ([] if margin else [one.control or ""]) + [one.estimator, str(one.spp)]
        low, high = one.error_by("error").interval
        between = f"{100 * low:.2g} to {100 * high:.2g}" if low == low and one.known else ""
        later = [f"{one.seconds if one.later_seconds is None else one.later_seconds:.3g}"] * again
        seconds = [f"{one.seconds:.3g}", *later]
        rows.append([*place, _percent(one.error_by("error")), between, beside, *seconds, str(one.repeats)])
    return output.columns(rows)


def _objectives(points: Sequence[PrecisionPoint]) -> str:
    rows = [["policy", "renders", "seconds", "objective", "quartiles", "searches"]]
    for one in points:
        low, high = one.quartiles or (math.nan, math.nan)
        rows.append(
            [
                one.estimator,
                str(one.renders),
                f"{one.seconds:.3g}",
                f"{one.objective:.3g}",
                f"{low:.3g} to {high:.3g}",
                str(one.repeats),
            ]
        )
    return output.columns(rows)


def _slopes(slopes: Sequence[PrecisionSlope]) -> str:
    rows = [["what", "estimator", "against", "slope", "95 %", "theory", "points", "fixed s", ""]]
    for one in slopes:
        what = one.control or ("margin" if one.measure == "margin_error" else one.quantity)
        theory = "" if one.theory is None else f"{one.theory:.3g}" + (" or steeper" if one.or_steeper else "")
        low, high = one.interval
        verdict = {True: "agrees", False: "DISAGREES", None: "can't be told" if theory else ""}[one.agrees]
        rows.append(
            [
                what,
                one.estimator,
                one.against,
                f"{one.slope:.2f}",
                f"{low:.2f} to {high:.2f}",
                theory,
                str(one.points),
                f"{one.fixed_seconds:.2g}" if one.against == "seconds" else "",
                verdict,
            ]
        )
    return output.columns(rows)


def _references(references: Sequence[PrecisionReference]) -> str:
    rows = [["what", "reference", "samples", "parts", "error", "margin"]]
    for one in references:
        margin = (
            f"{one.margin:.3g} +- {100 * one.margin_error:.2g} %"
            if one.margin is not None and one.margin_error is not None
            else ""
        )
        what = one.control or one.quantity
        rows.append([what, one.reference, str(one.spp), str(one.parts), f"{100 * one.error:.2g} %", margin])
    return output.columns(rows)


def _left_out(left_out: Sequence[NotMeasured]) -> list[str]:
    """One line for each estimator, with its sample counts."""
    counts: dict[str, list[str]] = {}
    for one in left_out:
        name = f"{one.control or one.quantity} by {one.estimator}"
        counts.setdefault(name, []).append(str(one.spp))
    return [f"  {name}: {', '.join(samples)} samples" for name, samples in counts.items()]


def _percent(error: MeasuredError) -> str:
    return ("" if error.known else "< ") + f"{100 * error.value:.3g} %"


COMMAND = QuestionCommand("precision", answer)
