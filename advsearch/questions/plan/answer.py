"""The result of `plan`, and the gradient plan in other results."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from pydantic import Field

from advsearch.report.markup import InNotebook
from advsearch.report.shown import AnswerPart, Column, ShownAnswer
from advsearch.runs.results.base import (
    OUT_OF_TIME,
    CosineRow,
    Fields,
    Formation,
    GroupDerivative,
    JsonFloat,
    PathLength,
    RunResult,
)


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


READING = (
    "How a search gets the derivative of each parameter, measured on this scene, and why. adjoint: a second render "
    "that carries all derivatives back at once; differences, secant: two renders with the parameter moved by a "
    "step (a share of its range). A cosine of 1 with the converged gradient means that a gradient points the right "
    "way."
)

COSINES: Mapping[str, Column] = {
    "control": "{0.control}",
    "denoiser": "{0.denoise}",
    "step": "x {0.factor:.3g}",
    "samples": "{0.spp}",
    "cosine with the converged gradient": "{0.cosine:.3f}",
    "of converged ones": "{0.converged:.3f}",
    "seconds": "{0.seconds:.2f}",
    "status": "{0.status}",
}
GAINS: Mapping[str, Column] = {
    "left out": "{0.what}",
    "a gradient with it takes": "x {0.gain:.2f}",
    "picture differs": lambda one: _agreement(one.picture_difference),
    "gradient differs": lambda one: _agreement(one.gradient_difference),
    "": lambda one: "" if one.safe else "MORE THAN ITS NOISE",
}


def shown(chosen: PlanResult) -> ShownAnswer:
    """Return how derivatives are obtained, what is left out, and why."""
    groups: Mapping[str, Column] = {
        "parameter": "{0.name}",
        "numbers": "{0.size}",
        "estimator": "{0.estimator}",
        "step": _step,
    }
    denoise, left_out = chosen.denoise, chosen.left_out if chosen.specialised else ["nothing (`specialise=false`)"]
    why = "the time was up" if chosen.ending == OUT_OF_TIME else "it was stopped"
    advice = f"denoiser asked for: {denoise.asked}; better gradients: {denoise.advised} ({denoise.reason})"
    return ShownAnswer(
        f"{chosen.brief[:1].upper()}{chosen.brief[1:]} a pixel.",
        [
            AnswerPart.table(chosen.groups, groups, title="Derivatives", text=[READING]),
            AnswerPart("Why", _why(chosen)),
            AnswerPart("Left out", [*left_out, *_measured(chosen)]),
            AnswerPart.table(chosen.gains or (), GAINS, title="What that saves"),
            AnswerPart.table(chosen.cosines, COSINES, title="Gradients of the model's loss", note=advice),
            AnswerPart(text=[advice] if chosen.cosines else [], only="text"),
            AnswerPart(f"Not measured, {why}", chosen.not_measured),
            AnswerPart("Limits of the material form", [limit.what for limit in chosen.limits]),
        ],
        {"renders a gradient": str(chosen.renders_per_gradient), "samples a pixel": str(chosen.spp)},
    )


def _step(group: GroupDerivative) -> str:
    """The step of a difference in u, and in the parameter's unit where it has one."""
    if not group.step_reason:
        return ""
    unit = "" if group.unit == "1" else f" {group.unit}"
    own = "" if group.step_in_unit is None else f" ({group.step_in_unit:.3g}{unit})"
    return f"{group.step:.3g}{own}"


def _why(chosen: PlanResult) -> list[str]:
    """Why the estimators and the steps are what they are, each reason once with its parameters."""
    reasons: dict[tuple[str, str], list[str]] = {}
    for group in chosen.groups:
        reasons.setdefault((group.estimator, group.reason), []).append(group.name)
    for group in chosen.groups:
        if group.step_reason:
            reasons.setdefault(("step", group.step_reason), []).append(group.name)
    return [f"{what} of {', '.join(names)}: {reason}" for (what, reason), names in reasons.items()]


def _measured(chosen: PlanResult) -> list[str]:
    """What was measured of light paths and of texels, in sentences."""
    lines = []
    if chosen.specialised and chosen.bounces is not None:
        depth, full = chosen.bounces.depth, chosen.bounces.full
        lines.append(f"longest light path of the search: {depth} segments of {full}: {chosen.bounces.reason}")
    for one in (chosen.texels or ()) if chosen.specialised else ():
        enough = (
            f"`texture_resolution={one.enough}` would resolve as much"
            if one.enough < one.side
            else f"{one.side} a side is what the pixels resolve"
        )
        lines.append(f"texels of {one.control}: {one.seen} are seen in {one.pixels} pixels; {enough}")
    return lines


def _agreement(share: float) -> str:
    """How a picture or gradient compares with another seed's."""
    return "not at all" if share == 0.0 else f"by {share:.2g} of its noise"
