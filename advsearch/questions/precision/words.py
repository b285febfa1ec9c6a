"""Error against run time in words and tables."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from advsearch.questions.precision.answer import (
    MeasuredError,
    NotMeasured,
    PrecisionPoint,
    PrecisionResult,
    PrecisionSlope,
    Recommended,
)
from advsearch.report.shown import AnswerPart, Column, ShownAnswer

READING = (
    "Each row is a setting: its error beside a reference of far more samples, with the 95 % interval of that "
    "error, and the seconds that one picture or gradient takes. A margin is how far the wrong answer leads the "
    "right one, in logits; a cosine of 1 means that a gradient points the right way. With a matrix of light "
    "transport or light on surfaces, `again` is what another one takes once the first one is there."
)
"""What the tables show, and how to read them."""

OBJECTIVES: Mapping[str, Column] = {
    "policy": "{0.estimator}",
    "renders": "{0.renders}",
    "seconds": "{0.seconds:.3g}",
    "objective": "{0.objective:.3g}",
    "quartiles": lambda one: "" if one.quartiles is None else f"{one.quartiles[0]:.3g} to {one.quartiles[1]:.3g}",
    "searches": "{0.repeats}",
}
SLOPES: Mapping[str, Column] = {
    "what": lambda one: one.control or ("margin" if one.measure == "margin_error" else one.quantity),
    "estimator": "{0.estimator}",
    "against": "{0.against}",
    "slope": "{0.slope:.2f}",
    "95 %": "{0.interval[0]:.2f} to {0.interval[1]:.2f}",
    "theory": lambda one: _theory(one),
    "points": "{0.points}",
    "fixed s": lambda one: f"{one.fixed_seconds:.2g}" if one.against == "seconds" else "",
    "": lambda one: {True: "agrees", False: "DISAGREES", None: "can't be told" if _theory(one) else ""}[one.agrees],
}
REFERENCES: Mapping[str, Column] = {
    "what": lambda one: one.control or one.quantity,
    "reference": "{0.reference}",
    "samples": "{0.spp}",
    "parts": "{0.parts}",
    "error": lambda one: f"{100 * one.error:.2g} %",
    "margin": lambda one: (
        "" if one.margin is None or one.margin_error is None else f"{one.margin:.3g} +- {100 * one.margin_error:.2g} %"
    ),
}
"""Columns of the tables."""


def shown(result: PrecisionResult) -> ShownAnswer:
    """Return what was measured, what follows from it, and what was not measured."""
    by = {name: [one for one in result.points if one.quantity == name] for name in ("image", "gradient", "objective")}
    machine = result.machine
    threads = " and ".join(f"{count} of {name}" for name, count in machine.threads.items())
    said = [sentence(one, result.goal) for one in result.recommendations]
    stopped = ["It was stopped: only a part was measured."] if result.goes_on else []
    return ShownAnswer(
        " ".join(stopped) or "Error against run time, and the settings that reach the goal soonest.",
        [
            AnswerPart("Recommended", said),
            AnswerPart(text=[READING], only="text"),
            *(_errors(name, by[name]) for name in ("image", "gradient")),
            AnswerPart.table(by["objective"], OBJECTIVES, title="Objective"),
            AnswerPart.table(
                result.slopes, SLOPES, title="Slopes: logarithm of the error against that of samples or seconds"
            ),
            AnswerPart.table(result.references, REFERENCES, title="References, with their own errors", note=READING),
            AnswerPart("Not measured, the time was up", _left_out(result.left_out)),
        ],
        {
            "model": result.model,
            "machine": f"{machine.cpu}, {machine.cores} cores, threads: {threads}",
            "loss": result.loss,
            "figures": ", ".join(result.figures),
        },
    )


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
        return f"{asked}: not reached by anything that was measured; give it more `seconds` or a larger `error`"
    if one.quantity == "objective":
        return f"{asked}: policy {one.estimator}, {one.renders} renders, {one.seconds:.2g} s"
    basis = "" if one.basis in ("interpolated", "fitted") else f" ({one.basis})"
    return f"{asked}: {one.estimator}, {one.spp} samples, {one.seconds:.2g} s{basis}"


def _errors(name: str, points: Sequence[PrecisionPoint]) -> AnswerPart:
    """A row for each setting: of pictures with the error of the margin, of gradients with the cosine."""
    margin = any(one.margin_error is not None for one in points)
    columns: dict[str, Column] = {} if margin else {"control": lambda one: one.control or ""}
    columns |= {
        "estimator": "{0.estimator}",
        "samples": "{0.spp}",
        "error": lambda one: _percent(one.error_by("error")),
        "95 %": lambda one: _between(one.error_by("error")),
    }
    if margin:
        columns["margin"] = lambda one: _percent(one.error_by("margin_error"))
    else:
        columns["cosine"] = lambda one: f"{math.nan if one.cosine is None else one.cosine:.3f}"
    columns["seconds"] = "{0.seconds:.3g}"
    if any(one.later_seconds is not None for one in points):
        columns["again"] = lambda one: f"{one.seconds if one.later_seconds is None else one.later_seconds:.3g}"
    return AnswerPart.table(points, {**columns, "repeats": "{0.repeats}"}, title=name.capitalize())


def _theory(one: PrecisionSlope) -> str:
    return "" if one.theory is None else f"{one.theory:.3g}" + (" or steeper" if one.or_steeper else "")


def _between(error: MeasuredError) -> str:
    low, high = error.interval
    return f"{100 * low:.2g} to {100 * high:.2g}" if low == low and error.known else ""


def _left_out(left_out: Sequence[NotMeasured]) -> list[str]:
    """One line for each estimator, with its sample counts."""
    counts: dict[str, list[str]] = {}
    for one in left_out:
        name = f"{one.control or one.quantity} by {one.estimator}"
        counts.setdefault(name, []).append(str(one.spp))
    return [f"{name}: {', '.join(samples)} samples" for name, samples in counts.items()]


def _percent(error: MeasuredError) -> str:
    return ("" if error.known else "< ") + f"{100 * error.value:.3g} %"
