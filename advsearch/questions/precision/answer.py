"""The result of `precision`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar, NamedTuple

from pydantic import Field

from advsearch.report.shown import AnswerPart, Column, ShownAnswer
from advsearch.runs.results.attack import SharedWork
from advsearch.runs.results.base import Fields, Formation, Interval, JsonFloat, RunResult


class MeasuredError(NamedTuple):
    """An error, its interval, and whether it is known or only a limit."""

    value: float
    interval: tuple[float, float]
    known: bool


class SettingPlace(Fields):
    """What a setting computes, and how."""

    quantity: str = Field(description="`image`, `gradient` or `objective`")
    estimator: str = Field(description="a sampler, an estimator or a policy")
    spp: int = Field(description="samples a pixel")
    control: str | None = Field(default=None, description="whose gradient")


class PrecisionPoint(SettingPlace):
    """What repeated measurements of a setting say. Errors are relative."""

    error: JsonFloat = Field(description="root mean square; where it is not known, an upper limit")
    interval: Interval | None = None
    known: bool | None = Field(default=None, description="well above the reference's own error")
    reference_error: JsonFloat | None = None
    margin_error: JsonFloat | None = Field(default=None, description="of the model's margin, with its own company")
    margin_interval: Interval | None = None
    margin_known: bool | None = None
    margin_reference_error: JsonFloat | None = None
    heavy_tailed: bool | None = Field(
        default=None, description="true where a few pixels hold the error, so that it has no interval"
    )
    seconds: float = Field(description="processor time, all threads together")
    wall_seconds: JsonFloat | None = Field(default=None, description="by the clock")
    repeats: int
    cosine: JsonFloat | None = Field(default=None, description="of a gradient with its reference")
    later_seconds: JsonFloat | None = Field(default=None, description="of another one from the same matrix or light")
    family: str | None = Field(default=None, description="what a line of the image is recommended among")
    objective: JsonFloat | None = Field(default=None, description="median over searches")
    quartiles: Interval | None = None
    renders: int | None = None

    def error_by(self, measure: str) -> MeasuredError:
        """Return `error` or `margin_error` with its interval; NaN where it was not measured."""
        nothing = (math.nan, math.nan)
        error, interval, known = (
            (self.error, self.interval, self.known)
            if measure == "error"
            else (self.margin_error, self.margin_interval, self.margin_known)
        )
        return MeasuredError(math.nan if error is None else error, interval or nothing, bool(known))


class PrecisionSlope(Fields):
    """A line through the points of one estimator, both axes logarithmic."""

    quantity: str
    control: str | None
    estimator: str
    measure: str = Field(description="`error` or `margin_error`")
    against: str = Field(description="`samples` or `seconds`")
    slope: float
    interval: Interval
    offset: float = Field(description="logarithm of the error at one sample or second")
    points: int
    fixed_seconds: JsonFloat = Field(description="of a call, that don't grow with the samples")
    theory: float | None = Field(description="what the slope should be")
    or_steeper: bool
    agrees: bool | None = Field(description="null where that can't be told")


class PrecisionReference(Fields):
    """What stands for the truth, and how far off it may be."""

    quantity: str
    reference: str
    error: JsonFloat
    parts: int
    spp: int
    control: str | None = None
    margin: JsonFloat | None = None
    margin_error: JsonFloat | None = None


class Recommended(Fields):
    """The setting that reaches the goal soonest."""

    quantity: str
    control: str | None
    measure: str
    among: str | None
    goal: float | None = None
    estimator: str | None = Field(description="null where nothing that was measured reaches it")
    spp: int | None = None
    renders: int | None = None
    seconds: JsonFloat | None = None
    error: JsonFloat | None = None
    basis: str | None = Field(default=None, description="measured, fitted, interpolated, extrapolated or confirmed")
    repeats: int | None = Field(default=None, description="measurements that confirm it")


class NotMeasured(SettingPlace):
    """A setting that was not measured, and why."""

    reason: str


class Machine(Fields):
    """What a time has to be read with."""

    cpu: str
    cores: int
    threads: dict[str, int]
    system: str
    python: str


class PrecisionResult(RunResult):
    """Error against run time, and what follows from it, as far as that is measured."""

    command: ClassVar[str] = "precision"

    object: str
    model: str
    image_formation: Formation
    depth: int = Field(description="longest light path in segments")
    loss: str
    objective: str
    spp: int
    machine: Machine
    goal: float = Field(description="relative error that is wanted")
    points: list[PrecisionPoint]
    slopes: list[PrecisionSlope]
    references: list[PrecisionReference]
    recommendations: list[Recommended]
    warnings: list[str] = Field(description="sentences that a reader has to know")
    left_out: list[NotMeasured]
    figures: list[str]
    shared: SharedWork | None = Field(
        default=None, description="how [workers](cluster.md) did that made parts of references; absent without"
    )


RESULT = PrecisionResult


WARM_UP = 3
"""Calls of a setting whose times don't count where there are more: the first compiles and records kernels, the second
may record them again, and so may the first one after other scenes were rendered."""

READING = (
    "Each row is a setting: its error beside a reference of far more samples, with the 95 % interval of that "
    "error, and the processor time, in seconds, that one picture or gradient takes. A margin is how far the wrong "
    "answer leads the right one, in logits; a cosine of 1 means that a gradient points the right way. With a matrix of "
    "light transport or light on surfaces, `again` is what another one takes once the first one is there."
)

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


def shown(result: PrecisionResult) -> ShownAnswer:
    """Return what was measured, what follows from it, and what was not measured."""
    by = {name: [one for one in result.points if one.quantity == name] for name in ("image", "gradient", "objective")}
    machine = result.machine
    threads = " and ".join(f"{count} of {name}" for name, count in machine.threads.items())
    said = [sentence(one, result.goal) for one in result.recommendations]
    stopped = ["It was stopped: only a part was measured."] if result.goes_on else []
    return ShownAnswer(
        " ".join([*stopped, headline(result)]),
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


def headline(result: PrecisionResult) -> str:
    """Return the answer in one line: what an error takes, of the first quantity that reaches it."""
    found = next((one for one in result.recommendations if one.estimator and one.quantity != "objective"), None)
    if found is None:
        return "Nothing that was measured is known to reach the error: give it more `seconds` or a larger `error`."
    what = "the picture" if found.quantity == "image" else f"the gradient of {found.control}"
    return (
        f"For {100 * result.goal:.3g} % error of {what}: {found.spp} samples ({found.estimator}), "
        f"{found.seconds:.2g} s of processor time, here."
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
        "95 %": lambda one: "heavy tails" if one.heavy_tailed else _between(one.error_by("error")),
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


def busy(points: Sequence[PrecisionPoint]) -> str | None:
    """Return a warning where most settings took over twice as long by the clock as in processor time; else None."""
    waited = [one.wall_seconds > 2.0 * one.seconds for one in points if one.wall_seconds is not None]
    if 2 * sum(waited) <= len(waited):
        return None
    return (
        "the machine was busy with something else: by the clock, most pictures and gradients took over twice their "
        "processor time; measure again when it is quiet"
    )


def _left_out(left_out: Sequence[NotMeasured]) -> list[str]:
    """One line for each estimator, with its sample counts."""
    counts: dict[str, list[str]] = {}
    for one in left_out:
        name = f"{one.control or one.quantity} by {one.estimator}"
        counts.setdefault(name, []).append(str(one.spp))
    return [f"{name}: {', '.join(samples)} samples" for name, samples in counts.items()]


def _percent(error: MeasuredError) -> str:
    return ("" if error.known else "< ") + f"{100 * error.value:.3g} %"
