"""Surfaces at the ends of their range."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from statistics import fmean

import numpy as np
import torch

from advsearch.engine.gradients import smooth_loss
from advsearch.questions.stability.case import CaseGroup, Check, Outcome, holds
from advsearch.questions.stability.scene import ERROR, REFERENCE_SPP, SPP, ControlSettings, examine_gradient, small
from advsearch.scene import library
from advsearch.scene.description import describe
from advsearch.scene.geometry import camera_to_world
from advsearch.scene.mitsuba_backend.parts import Translation, translation
from advsearch.scene.parts import ScenePart
from advsearch.scene.renderer import Renderer

GROUP = CaseGroup("materials")
_SCENE = "counted and set to zero where they arise (Renderer.non_finite); none is expected"
_MOVED = "values are rendered inside the range in which the adjoint is right (metallic at most 0.999)"


@dataclass(frozen=True, eq=False)
class GlassBall(ScenePart):
    """A ball of clear glass; nothing of it varies.

    Attributes:
        name: of the part.
        place: (3,) of its middle.
        radius: in object sizes.
    """

    place: tuple[float, float, float]
    radius: float


@translation.register
def _glass(part: GlassBall) -> Translation:
    surface = {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}
    ball = {"type": "sphere", "center": list(part.place), "radius": part.radius, "bsdf": surface}
    return Translation({part.name: ball})


def behind_glass(controls: ControlSettings) -> Renderer:
    """The mug behind a ball of clear glass, which covers part of it."""
    camera = camera_to_world(describe("mug"))
    x, y, z = (float(one) for one in camera[:3, 3] * 0.6 + np.array([0.0, 0.0, 0.2]))
    return small("mug", controls, parts=[GlassBall("glass", (x, y, z), 0.3)])


def extreme_surface(searched: dict[str, list[float]], **values: float) -> Outcome:
    """A surface with some numbers at the ends of their range, and the derivative by some of them there."""
    settings = {f"material.{name}": value for name, value in values.items()}
    return examine_gradient(small("mug", {"material": searched}, settings=settings)).findings()


GROUP.case(
    "roughness-0",
    "Finite, and the gradient by the roughness is right, at the polished end.",
    "Mitsuba's lobe is never narrower than a roughness of 0.03, so the derivative is finite",
    "material",
)(partial(extreme_surface, {"roughness": [0.0, 1.0]}, roughness=0.0))
GROUP.case(
    "roughness-1",
    "Finite, and the gradient by the roughness is right, at the matt end.",
    _SCENE,
    "material",
    cheap=False,
)(partial(extreme_surface, {"roughness": [0.0, 1.0]}, roughness=1.0, metallic=1.0))
GROUP.case(
    "metallic-1",
    "Finite, and the gradient has the right sign and size at a metallic of exactly 1.",
    _MOVED,
    "material",
    cheap=False,
)(partial(extreme_surface, {"metallic": [0.0, 1.0]}, metallic=1.0))
GROUP.case(
    "perfect-mirror", "A metal of roughness 0 is finite, and both gradients are right.", _MOVED, "material", cheap=False
)(partial(extreme_surface, {"roughness": [0.0, 1.0], "metallic": [0.0, 1.0]}, roughness=0.0, metallic=1.0))


@GROUP.case(
    "clear-glass",
    "A texel behind clear glass has the right gradient, and nothing is NaN.",
    _SCENE,
    "texture, environment",
    cheap=False,
)
def clear_glass() -> Outcome:
    """The object behind a ball of clear glass: light bends twice, and a texel still has its gradient."""
    controls: ControlSettings = {"texture": {"resolution": 8}, "environment": {"exposure": [-1.0, 1.0]}}
    glass = behind_glass(controls)
    without = small("mug", controls)
    with torch.no_grad():
        moved = float((glass(glass.start, 0, 8) - without(without.start, 0, 8)).abs().mean())
    return examine_gradient(glass).findings(Check("mean change of the picture by the glass", moved, least=0.01))


@GROUP.case(
    "texels-0-and-1",
    "Texels at the ends of the range have a gradient, and the search moves them inwards only.",
    "the straight piece of the sRGB curve at 0; projection onto the bounds",
    "texture",
)
def texels_at_the_ends() -> Outcome:
    """A texture of texels that are exactly 0 and exactly 1: the gradient is there, and the search moves inwards."""
    checks = np.indices((8, 8)).sum(axis=0) % 2
    texels = np.repeat(checks[:, :, None], 3, axis=2).astype(np.float32)
    mug = replace(library.load_object("mug"), name="checked", base_color=texels)
    renderer = small(mug, {"texture": {"resolution": 8, "epsilon": 0.2}})
    seen = examine_gradient(renderer, compare=False)
    best = seen.result.best_u
    error = _inward_error(renderer)
    findings = seen.findings(
        Check("gradient error along a direction that points inwards", error, most=ERROR),
        Check("smallest texel of the answer", float(best.min()), least=0.0),
        Check("largest texel of the answer", float(best.max()), most=1.0),
        Check("texels that the search moved", float((best != renderer.start).sum()), least=1.0),
        holds("the start has both 0 and 1", set(renderer.start.tolist()) == {0.0, 1.0}),
    )
    return replace(findings, relative_error=error)


def _inward_error(renderer: Renderer, repeats: int = 8, step: float = 0.04) -> float:
    """Compare the gradient with one-sided differences of second order, since there is no other side at a bound."""
    renderer.formation = replace(renderer.formation, transfer="linear")
    loss, u = smooth_loss(renderer.formation.resolution), renderer.start
    slope = renderer.gradient(loss, u, 0, SPP)[1]
    inwards = torch.where(u > 0.5, -1.0, 1.0) * (slope * (0.5 - u) > 0.0)
    found, wanted = [], []
    for seed in range(repeats):
        found.append(float(renderer.gradient(loss, u, seed, REFERENCE_SPP)[1] @ inwards))
        with torch.no_grad():
            here, near, far = (float(loss(renderer(u + k * step * inwards, seed, REFERENCE_SPP))) for k in range(3))
        wanted.append((4.0 * near - 3.0 * here - far) / (2.0 * step))
    return abs(fmean(found) / fmean(wanted) - 1.0)
