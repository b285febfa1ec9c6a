"""The result of `plan`, and the gradient plan in other results."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from advsearch.runs.results.base import Fields, Formation, JsonFloat, RunResult
from advsearch.runs.results.check import GradientStatus


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


class DenoiserAdvice(Fields):
    """Which denoiser makes the better gradients."""

    asked: str
    advised: str
    reason: str


class GainRow(Fields):
    """What leaving one thing out saves, and the proof that it changes nothing."""

    item: str
    what: str
    gain: float = Field(description="a gradient's time x the picture's variance with it, over those without it")
    picture_difference: JsonFloat = Field(description="root mean square at one seed, over that of two seeds")
    gradient_difference: JsonFloat = Field(description="the same of gradients; 0 where there are none")
    safe: bool = Field(description="whether pictures and gradients agree to within their noise")
    seconds: float = Field(description="of a gradient with it")


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


class TexelRow(Fields):
    """How many texels of a searched texture a pixel shows."""

    control: str = Field(description="whose texture")
    side: int = Field(description="of the texture, in texels")
    seen: int = Field(description="texels that light reaches the camera from directly")
    pixels: int = Field(description="pixels that show the surface")
    enough: int = Field(description="side, `side` halved as often as the pixels still resolve as much")


class EstimatorLimit(Fields):
    """Something that an estimator does not cover."""

    what: str
    measured: str


class PlanResult(RunResult):
    """How a search gets its derivatives, what it leaves out, and why, as far as that is measured."""

    command: ClassVar[str] = "plan"

    object: str
    model: str
    not_measured: list[str] = Field(description="what the time did not suffice for")
    image_formation: Formation
    renders_per_gradient: int
    spp: int = Field(description="samples a pixel")
    groups: list[GroupDerivative]
    cosines: list[CosineRow]
    denoise: DenoiserAdvice
    left_out: list[str] = Field(description="what is not computed, in sentences")
    specialised: bool
    gains: list[GainRow] | None = None
    bounces: PathLength | None = None
    texels: list[TexelRow] | None = None
    limits: list[EstimatorLimit] = Field(description="of the material form, where it is used")

    @property
    def brief(self) -> str:
        """What it comes to."""
        return f"{self.renders_per_gradient} renders a gradient, {self.spp} samples"
