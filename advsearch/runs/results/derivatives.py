"""How derivatives are obtained, and how long light paths are, in the results of several questions."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from advsearch.runs.results.base import Fields, JsonFloat

GradientStatus = Literal["ok", "biased", "noisy", "reference unusable"]


class GroupDerivative(Fields):
    """How the derivative of one parameter is obtained."""

    control: str
    parameter: str
    size: int = Field(description="how many numbers it has")
    estimator: str
    valid: list[str] = Field(description="the estimators that are valid")
    step: float = Field(description="half-width of a difference in u")
    step_reason: str = Field(description="why it is as wide; empty where none is taken")
    reason: str = Field(description="why this estimator")
    variance_x_seconds: dict[str, JsonFloat] = Field(
        description="squared error x time of each estimator that was measured"
    )
    step_in_unit: float | None = Field(description="the step in `unit`; null where that is no single number")
    unit: str

    @property
    def name(self) -> str:
        """``control.parameter``."""
        return f"{self.control}.{self.parameter}"


class PlannedGradient(Fields):
    """How every derivative is obtained."""

    renders_per_gradient: int = Field(description="beside the picture itself; adjoints are not counted")
    spp: int | None = Field(description="samples a pixel of differences; null: that of the search")
    groups: list[GroupDerivative]


class PathCut(Fields):
    """What paths of at most so many segments leave out, the worst over the configurations looked at."""

    depth: int = Field(description="longest path in segments")
    light: float = Field(description="share of the radiance that is missing")
    levels: float = Field(description="root-mean-square bias of the displayed picture in 8-bit levels")


class PathLength(Fields):
    """The longest light path of the search, and why."""

    depth: int = Field(description="of the search, in segments")
    full: int = Field(description="of the verification")
    cuts: list[PathCut] = Field(description="what was measured, longest paths first")
    configurations: int = Field(description="how many the measurement looked at")
    reason: str


class CosineRow(Fields):
    """How well a working gradient of the model's loss points the way of the converged one."""

    denoise: str
    control: str
    factor: float = Field(description="step as a multiple of the plan's")
    spp: int = Field(description="samples a pixel")
    cosine: JsonFloat = Field(description="mean over seeds; null where the converged gradient is zero")
    converged: JsonFloat = Field(description="smallest cosine of two converged gradients")
    seconds: float = Field(description="of one working gradient, median")
    status: GradientStatus = Field(description="whether it is good enough to search by")
