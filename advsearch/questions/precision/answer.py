"""The result of `precision`."""

from __future__ import annotations

import math
from typing import ClassVar, NamedTuple

from pydantic import Field

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
    seconds: float
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


class PrecisionSubject(RunResult):
    """What was asked for, and on what it was measured."""

    command: ClassVar[str] = "precision"

    object: str
    model: str
    image_formation: Formation
    depth: int = Field(description="longest light path in segments")
    loss: str
    objective: str
    spp: int
    machine: Machine


class PrecisionResult(PrecisionSubject):
    """Error against run time, and what follows from it, as far as that is measured."""

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
