"""The `corruption` control: one of the common image corruptions, by name and severity, on the finished picture.

    severity 0: the picture as it is;  0 to 1: mixed with that of severity 1;  1 to 5: the published severities, and
    between two of them their parameters interpolated

The corruptions and the numbers that a severity stands for are those of ImageNet-C (Hendrycks & Dietterich 2019,
Benchmarking neural network robustness to common corruptions and perturbations, arXiv 1903.12261, section 4 and
appendix A). They were made for a fixed list of pictures on disk; here they are functions of the picture in torch, so
that a search can follow them back into the scene.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import ClassVar

import torch
from torch import Tensor

from advsearch.controls.base import Choice, Parameter, Value
from advsearch.controls.corruption.blur import defocus_blur, elastic, gaussian_blur, glass_blur, motion_blur, zoom_blur
from advsearch.controls.corruption.digital import brightness, contrast, jpeg, pixelate, saturate
from advsearch.controls.corruption.noise import gaussian_noise, impulse_noise, shot_noise, speckle_noise
from advsearch.controls.corruption.tools import LEVELS
from advsearch.controls.corruption.weather import fog, frost, snow
from advsearch.controls.numbers import NumberControl, Values
from advsearch.controls.values import Fixed, OneOf
from advsearch.scene.description import SceneDescription

SMOOTH: Mapping[str, Callable[[Tensor, Tensor, int], Tensor]] = {
    one.__name__: one
    for one in (
        gaussian_noise,
        shot_noise,
        impulse_noise,
        speckle_noise,
        defocus_blur,
        glass_blur,
        motion_blur,
        zoom_blur,
        gaussian_blur,
        snow,
        frost,
        fog,
        brightness,
        contrast,
        saturate,
    )
}
"""Corruptions of every severity in [1, 5], mixed in below: of the picture, the severity and the seed."""
FROM_NOTHING: Mapping[str, Callable[[Tensor, Tensor, int], Tensor]] = {"elastic": elastic}
"""Corruptions of every severity in [0, 5]: a mix of a warped and an unwarped picture would show the object twice."""
STEPPED: Mapping[str, Callable[[Tensor, int], Tensor]] = {"pixelate": pixelate, "jpeg": jpeg}
"""Corruptions of whole severities only: of the picture and the severity."""
NAMES = (*SMOOTH, *FROM_NOTHING, *STEPPED)


class CorruptionControl(NumberControl):
    """One of the common image corruptions, by name and severity."""

    kind: ClassVar[str] = "corruption"
    amount: ClassVar[str | None] = "severity"
    summary: ClassVar[str] = "A common image corruption (noise, blur, weather, digital) by name and severity."
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter(
            "which",
            (),
            "name",
            0,
            len(NAMES) - 1,
            NAMES[0],
            "Which corruption.",
            search=(0, len(NAMES) - 1),
            options=NAMES,
            estimators=(),
        ),
        Parameter(
            "severity",
            (),
            "1",
            0.0,
            float(LEVELS),
            0.0,
            "How strong it is: 0 is none, 1 to 5 are the published severities.",
            search=(0.0, float(LEVELS)),
            estimators=("image",),
        ),
    )
    choices: ClassVar[tuple[Choice, ...]] = (
        Choice(
            "seed", 0, "Which draw of the noise, the snow, the wrinkles: a whole number from 0.", whole=(0, 2**32 - 1)
        ),
    )

    def __init__(self, name: str | None = None, **settings: object) -> None:
        super().__init__(name, **settings)
        # a name without a severity does nothing, and a severity needs a name: what is not given is searched
        self.asked = False

    def estimators(self, scene: SceneDescription, parameter: Parameter) -> tuple[str, ...]:
        if parameter.name == "severity" and self.possible() <= set(STEPPED):
            return ()
        return super().estimators(scene, parameter)

    def possible(self) -> set[str]:
        """Return the corruptions that a search may come to."""
        spec = self.specs.get("which")
        if isinstance(spec, Fixed):
            return {str(spec.value)}
        return {str(value) for value in spec.values} if isinstance(spec, OneOf) else set(NAMES)

    def on_picture(self, scene: SceneDescription, values: Values, image: Tensor) -> Tensor:
        seed = int(self.chosen["seed"])  # type: ignore[call-overload]
        return corrupted(image, NAMES[int(values["which"])], values["severity"], seed)

    def measured(self, scene: SceneDescription, values: Values, so_far: Mapping[str, Tensor]) -> dict[str, Value]:
        severity = values["severity"]
        applied = nearest(severity) if NAMES[int(values["which"])] in STEPPED else float(severity)
        return {"applied": {"value": float(applied), "unit": "1"}}


def corrupted(image: Tensor, which: str, severity: Tensor, seed: int = 0) -> Tensor:
    """Corrupt a picture.

    Args:
        image: (H, W, 3) display-referred sRGB in [0, 1].
        which: one of `NAMES`.
        severity: () in [0, 5]; 0 returns the picture.
        seed: chooses the noise.

    Returns:
        (H, W, 3) sRGB in [0, 1]; differentiable in the picture and the severity, as `docs/controls/corruption.md` says.
    """
    if which in STEPPED:
        return _stepped(image, STEPPED[which], severity).clamp(0.0, 1.0)
    if which in FROM_NOTHING:
        return FROM_NOTHING[which](image, severity, seed).clamp(0.0, 1.0)
    if float(severity.detach()) >= 1.0:
        return SMOOTH[which](image, severity, seed).clamp(0.0, 1.0)
    mildest = SMOOTH[which](image, torch.ones_like(severity), seed).clamp(0.0, 1.0)
    return (image + severity * (mildest - image)).clamp(0.0, 1.0)


def nearest(severity: Tensor) -> int:
    """Return the whole severity nearest to one, halves upwards."""
    return int(float(severity.detach()) + 0.5)


def _stepped(image: Tensor, at: Callable[[Tensor, int], Tensor], severity: Tensor) -> Tensor:
    """Corrupt by the nearest whole severity.

    A staircase has no slope. The derivative by the severity is that of the straight lines between the steps, which is
    the staircase's own when averaged over half a severity to either side.
    """
    whole = nearest(severity)
    out = at(image, whole) if whole else image
    if not severity.requires_grad:
        return out
    below = min(int(severity.detach()), LEVELS - 1)
    low, high = at(image, below).detach() if below else image.detach(), at(image, below + 1).detach()
    return out + (severity - severity.detach()) * (high - low)
