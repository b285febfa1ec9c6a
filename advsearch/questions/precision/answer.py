"""The result of `precision`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar

from pydantic import Field

from advsearch.report.shown import AnswerPart, Column, ShownAnswer
from advsearch.runs.results.base import Fields, Formation, Interval, JsonFloat, Measured, RunResult


class PrecisionPoint(Measured):
    """What repeated measurements of one setting say."""

    family: str = Field(
        default="",
        description="what it is recommended among: `raw`, `oidn`, `depth` or `predicted`; absent of gradients",
    )
    heavy_tailed: bool = Field(default=False, description="a few pixels hold the error, so that it has no interval")
    wall_seconds: JsonFloat | None = Field(default=None, description="by the clock; `seconds` are processor time")

    @property
    def known(self) -> bool:
        """Whether the error is well above the reference's own; else it is an upper limit."""
        return self.status == "ok"

    @property
    def rms(self) -> float:
        """The error as a number; NaN where there is none."""
        return math.nan if self.error is None else self.error


class PrecisionSlope(Fields):
    """A line through the points of one estimator: logarithm of the error against that of the samples."""

    quantity: str
    control: str
    estimator: str
    slope: float
    interval: Interval
    offset: float = Field(description="logarithm of the error at one sample")
    points: int
    theory: float | None = Field(description="what the slope should be")
    or_steeper: bool
    agrees: bool | None = Field(description="null where that can't be told")


class PrecisionReference(Fields):
    """What stands for the truth, and how far off it may be."""

    quantity: str
    control: str = ""
    reference: str
    error: JsonFloat
    parts: int
    spp: int = Field(description="samples a pixel of all parts together")


class Recommended(Fields):
    """The setting that reaches the goal soonest."""

    quantity: str
    control: str
    family: str = ""
    goal: float | None = None
    estimator: str | None = Field(default=None, description="null where nothing that was measured reaches it")
    spp: int | None = None
    seconds: JsonFloat | None = None
    error: JsonFloat | None = None
    basis: str | None = Field(default=None, description="measured, fitted, interpolated, extrapolated or confirmed")
    repeats: int | None = Field(default=None, description="measurements that confirm it")


class Sitting(Fields):
    """What was measured in one sitting: of the picture and the margin, or of the gradient of a control."""

    points: list[PrecisionPoint] = Field(default=[])
    references: list[PrecisionReference] = Field(default=[])
    again: list[PrecisionPoint] = Field(default=[], description="recommended settings, measured anew")
    warnings: list[str] = Field(default=[])
    left_out: list[str] = Field(default=[])
    took: float = Field(default=0.0, description="seconds by the clock")


class Machine(Fields):
    """What a time has to be read with."""

    cpu: str
    cores: int
    threads: dict[str, int]


class PrecisionResult(RunResult):
    """Error against run time, and what follows from it, as far as that is measured."""

    command: ClassVar[str] = "precision"

    object: str
    model: str
    image_formation: Formation
    depth: int = Field(description="longest light path in segments")
    loss: str
    spp: int
    machine: Machine
    goal: float = Field(description="relative error that is wanted")
    points: list[PrecisionPoint]
    slopes: list[PrecisionSlope]
    references: list[PrecisionReference]
    recommendations: list[Recommended]
    warnings: list[str] = Field(description="sentences that a reader has to know")
    left_out: list[str] = Field(description="settings for which there was no time")
    figures: list[str]


RESULT = PrecisionResult

WARM_UP = 3
"""Calls of a setting whose times don't count where there are more: the first compiles and records kernels, the second
may record them again, and so may the first one after other scenes were rendered."""
FAMILIES = {"none": " without denoiser", "oidn": " with denoiser"}
READING = (
    "Each row is a setting: its error beside a reference of far more samples, with the 95 % interval of that "
    "error, and the processor time, in seconds, that one picture or gradient takes. A margin is how far the wrong "
    "answer leads the right one, in logits; a cosine of 1 means that a gradient points the right way."
)


def named(quantity: str, control: str = "") -> str:
    """Return what is measured in words."""
    return f"the gradient of {control}" if quantity == "gradient" else f"the {quantity}"


SLOPES: Mapping[str, Column] = {
    "what": lambda slope: slope.control or slope.quantity,
    "estimator": "{0.estimator}",
    "slope": "{0.slope:.2f}",
    "95 %": "{0.interval[0]:.2f} to {0.interval[1]:.2f}",
    "theory": lambda slope: "" if slope.theory is None else f"{slope.theory:.3g}" + " or steeper" * slope.or_steeper,
    "points": "{0.points}",
    "": lambda slope: {True: "agrees", False: "DISAGREES", None: "" if slope.theory is None else "can't be told"}[
        slope.agrees
    ],
}
REFERENCES: Mapping[str, Column] = {
    "what": lambda reference: reference.control or reference.quantity,
    "reference": "{0.reference}",
    "samples": "{0.spp}",
    "parts": "{0.parts}",
    "error": lambda reference: f"{100 * reference.error:.2g} %",
}


def shown(result: PrecisionResult) -> ShownAnswer:
    """Return what was measured, what follows from it, and what was not measured."""
    machine = result.machine
    threads = " and ".join(f"{count} of {name}" for name, count in machine.threads.items())
    stopped = "It was stopped: only a part was measured. " if result.goes_on else ""
    return ShownAnswer(
        stopped + headline(result),
        [
            AnswerPart("Recommended", [sentence(found, result.goal) for found in result.recommendations]),
            AnswerPart(text=[READING], only="text"),
            *(_errors(quantity, result.points) for quantity in ("picture", "margin", "gradient")),
            AnswerPart.table(result.slopes, SLOPES, title="Slopes: logarithm of the error against that of samples"),
            AnswerPart.table(result.references, REFERENCES, title="References, with their own errors", note=READING),
            AnswerPart("Not measured, the time was up", result.left_out),
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
    found = next((one for one in result.recommendations if one.estimator), None)
    if found is None:
        return "Nothing that was measured is known to reach the error: give it more `seconds` or a larger `error`."
    return (
        f"For {100 * result.goal:.3g} % error of {named(found.quantity, found.control)}: {found.spp} samples "
        f"({found.estimator}), {found.seconds:.2g} s of processor time, here."
    )


def sentence(found: Recommended, goal: float) -> str:
    """Return a recommendation as a sentence."""
    asked = f"{100 * goal:.3g} % error of {named(found.quantity, found.control)}{FAMILIES.get(found.family, '')}"
    if found.estimator is None:
        return f"{asked}: not reached by anything that was measured; give it more `seconds` or a larger `error`"
    basis = "" if found.basis in ("interpolated", "fitted") else f" ({found.basis})"
    return f"{asked}: {found.estimator}, {found.spp} samples, {found.seconds:.2g} s{basis}"


def cautions(points: Sequence[PrecisionPoint]) -> list[str]:
    """Return what has to be known of points: errors of few pixels, and a machine that most of the time, by the clock,
    took over twice the processor time."""
    heavy = sorted({point.estimator for point in points if point.heavy_tailed})
    waited = [point.wall_seconds > 2.0 * point.seconds for point in points if point.wall_seconds is not None]
    warnings = []
    if heavy:
        warnings.append(
            f"{', '.join(heavy)}: a few pixels hold most of the error (fireflies), so that repeats say too little and "
            "it has no interval; a denoiser or more `rounds` help"
        )
    if 2 * sum(waited) > len(waited):
        warnings.append(
            "the machine was busy with something else: by the clock, most pictures and gradients took over twice their "
            "processor time; measure again when it is quiet"
        )
    return warnings


def _errors(quantity: str, points: Sequence[PrecisionPoint]) -> AnswerPart:
    """A row for each setting of a quantity."""
    rows = [point for point in points if point.quantity == quantity]
    columns: dict[str, Column] = {"control": "{0.control}"} if quantity == "gradient" else {}
    columns |= {
        "estimator": "{0.estimator}",
        "samples": "{0.spp}",
        "error": lambda point: f"{'' if point.known else '< '}{100 * point.rms:.3g} %",
        "95 %": lambda point: "heavy tails" if point.heavy_tailed else _between(point.interval),
    }
    if quantity == "gradient":
        columns["cosine"] = lambda point: f"{math.nan if point.cosine is None else point.cosine:.3f}"
    columns["seconds"] = "{0.seconds:.3g}"
    return AnswerPart.table(rows, {**columns, "repeats": "{0.repeats}"}, title=quantity.capitalize())


def _between(interval: Interval | None) -> str:
    return "" if interval is None else f"{100 * interval[0]:.2g} to {100 * interval[1]:.2g}"
