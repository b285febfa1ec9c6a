"""The result of `plan`, and the gradient plan in other results."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from advsearch.report.markup import InNotebook
from advsearch.runs.results.base import CosineRow, Fields, Formation, GroupDerivative, JsonFloat, PathLength, RunResult


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


class PlanResult(InNotebook, RunResult):
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


RESULT = PlanResult
