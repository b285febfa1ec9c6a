"""The `texture` control: every texel of the object's base-colour map, inside a ball around the original.

    u = texel values, display-referred sRGB in [0, 1];   reflectance = linear(u);   ||u - original||_p <= epsilon

Values are display-referred because that is what a person sees and a printer prints: a step of 0.1 is as visible in a
dark texel as in a bright one. The threat model of a bounded change of texture is REVAMP's and Athalye et al.'s (2018,
arXiv 1707.07397, section 3); here the ball is around the texture, not around the picture.

The L2 radius is the plain Euclidean norm over all texel values. A search over many texels moves each by little: a
radius of `r * sqrt(3 h w)` lets the root-mean-square change reach r.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor

from advsearch.controls.base import BoundControl, Budget, Choice, Control, Parameter, Value
from advsearch.errors import InputError
from advsearch.scene.description import SceneDescription
from advsearch.scene.formation import srgb_to_linear
from advsearch.scene.mitsuba_scene import BASE_COLOR

RESOLUTIONS = (256, 512)
"""Smallest and largest side that is taken from the object's own texture when none is asked for."""
DEFAULT_EPSILON = 0.1
"""Default radius of the L-infinity ball; the default L2 ball has the same root-mean-square change at its edge."""
NORMS = ("linf", "l2")


@dataclass(frozen=True)
class TextureControl(Control):
    """Every texel of the object's base-colour map, inside a ball around the original.

    Attributes:
        epsilon: radius of the ball, display-referred; None takes the norm's default.
        norm: "linf" or "l2".
        resolution: side of the searched texture in texels, 2 to 4096; None takes the longer side of the object's own
            texture, but at least 256 and at most 512.
        name: the instance's name.
    """

    epsilon: float | None = None
    norm: str = "linf"
    resolution: int | None = None
    name: str = "texture"

    kind: ClassVar[str] = "texture"
    summary: ClassVar[str] = "Every texel of the object's base-colour map, inside a ball around the original."
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter(
            "texels", (None, None, 3), "sRGB", 0.0, 1.0, "the object's own texture", "Display-referred texel values."
        ),
    )
    choices: ClassVar[tuple[Choice, ...]] = (
        Choice("epsilon", DEFAULT_EPSILON, "Radius of the ball around the original texture, display-referred."),
        Choice("norm", "linf", "Norm of the ball: linf (per texel value) or l2 (Euclidean, over all texel values)."),
        Choice("resolution", None, "Side of the searched texture in texels; by default the object's own, 256 to 512."),
    )

    def __post_init__(self) -> None:
        if self.norm not in NORMS:
            raise InputError(f"--norm: expected one of {', '.join(NORMS)}, got {self.norm!r}")
        if self.epsilon is not None and not (math.isfinite(self.epsilon) and self.epsilon > 0.0):
            raise InputError(f"--epsilon: expected a finite number greater than 0, got {self.epsilon:g}")
        if self.resolution is not None and not 2 <= self.resolution <= 4096:
            raise InputError(f"--texture-resolution: expected 2 to 4096 texels, got {self.resolution}")

    def bind(self, scene: SceneDescription) -> BoundControl:
        own = torch.from_numpy(scene.object.base_color.copy())
        original = resampled(own, self.resolution or min(max(max(own.shape[:2]), RESOLUTIONS[0]), RESOLUTIONS[1]))
        epsilon = self.epsilon
        if epsilon is None:
            epsilon = DEFAULT_EPSILON * (math.sqrt(original.numel()) if self.norm == "l2" else 1.0)
        return BoundTexture(self.name, original, Budget(self.norm, epsilon))


class BoundTexture(BoundControl):
    """The texels of one object's base-colour map.

    Args:
        name: the instance's name.
        original: (h, w, 3) float32 display-referred sRGB in [0, 1].
        budget: ball around the original.
    """

    def __init__(self, name: str, original: Tensor, budget: Budget) -> None:
        self.name = name
        self.shape = tuple(original.shape)
        self.start = original.reshape(-1)
        self.budget = budget

    def inputs(self, u: Tensor) -> dict[str, Tensor]:
        return {BASE_COLOR: srgb_to_linear(u.reshape(self.shape))}

    def describe(self, u: Tensor) -> dict[str, Value]:
        change = (u - self.start).detach()
        return {
            f"{self.name}.linf": {"value": float(change.abs().max()), "unit": "sRGB"},
            f"{self.name}.rms": {"value": float(change.pow(2).mean().sqrt()), "unit": "sRGB"},
        }

    def artifacts(self, u: Tensor) -> dict[str, Tensor]:
        return {self.name: u.detach().reshape(self.shape), f"{self.name}-original": self.start.reshape(self.shape)}


def resampled(image: Tensor, side: int) -> Tensor:
    """Resize an (h, w, 3) image to (side, side, 3) with an antialiased bilinear filter; values stay in [0, 1]."""
    if image.shape[:2] == (side, side):
        return image.contiguous()
    channels_first = image.permute(2, 0, 1)[None]
    resized = F.interpolate(channels_first, size=(side, side), mode="bilinear", antialias=True, align_corners=False)
    return resized[0].permute(1, 2, 0).clamp(0.0, 1.0).contiguous()
