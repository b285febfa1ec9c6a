"""The `corruption` control: a common image corruption on the finished image.

It has a name and a severity:

    severity 0   the image as it is
    0 to 1       mixed with that of severity 1
    1 to 5       the published severities; between two of them their parameters are
                 interpolated

The corruptions are those of ImageNet-C (Hendrycks & Dietterich 2019, arXiv 1903.12261,
section 4 and appendix A), as torch functions of an image (H, W, 3), display-referred
sRGB in [0, 1]. Noise, blur, shifted pixels and weather are in the module `filters`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor

from advsearch.controls.corruption import filters
from advsearch.extend import Choice, Control, Parameter, Value, Values, images

# added to the value of hue, saturation and value
BRIGHTNESS = ((0.1,), (0.2,), (0.3,), (0.4,), (0.5,))
# factor on the distance from the mean
CONTRAST = ((0.4,), (0.3,), (0.2,), (0.1,), (0.05,))
SATURATION = ((0.3, 0.0), (0.1, 0.0), (2.0, 0.0), (5.0, 0.1), (20.0, 0.2))
"""Factor on the saturation, and what is added to it."""
# number of cells along a side, as a fraction of the number of pixels
PIXELATE = (0.6, 0.5, 0.4, 0.3, 0.25)
JPEG = (25, 18, 15, 10, 7)  # quality
# keeps quotients finite; colors with a smaller value or saturation have no visible hue
_GREY = 1.0 / 512.0


def brightness(image: Tensor, level: Tensor, seed: int) -> Tensor:
    """Increase the value of each pixel, and keep hue and saturation."""
    (increase,) = filters.interpolate_table(BRIGHTNESS, level)
    value = image.amax(dim=-1, keepdim=True)
    return image + ((value + increase).clamp(max=1.0) - value) * (image + _GREY) / (
        value + _GREY
    )


def contrast(image: Tensor, level: Tensor, seed: int) -> Tensor:
    """Pull every value towards its channel's mean."""
    (factor,) = filters.interpolate_table(CONTRAST, level)
    mean = image.mean(dim=(0, 1))
    return mean + factor * (image - mean)


def saturate(image: Tensor, level: Tensor, seed: int) -> Tensor:
    """Scale the saturation, and keep hue and value; gray stays gray."""
    factor, increase = filters.interpolate_table(SATURATION, level)
    value = image.amax(dim=-1, keepdim=True)
    saturation = (value - image.amin(dim=-1, keepdim=True)) / (value + _GREY)
    new_saturation = (factor * saturation + increase).clamp(max=1.0)
    return value - (value - image) * new_saturation / (saturation + _GREY)


def pixelate(image: Tensor, severity: int) -> Tensor:
    """Average an image (H, W, 3) over square cells; linear in the image.

    At the reference size and below, a cell is 1.7 to 4 pixels wide, depending on the
    severity. In a larger image a cell is larger in proportion to the image.
    """
    height, width = image.shape[:2]
    enlargement = max(1.0, min(height, width) / filters.REFERENCE_SIDE)
    cells_per_pixel = PIXELATE[severity - 1] / enlargement
    n_rows = max(1, int(height * cells_per_pixel))
    n_columns = max(1, int(width * cells_per_pixel))
    cells = (n_rows, n_columns)
    averaged = F.interpolate(images.to_planes(image), cells, mode="area")
    return images.to_image(
        F.interpolate(averaged, (height, width), mode="nearest-exact")
    )


def jpeg(image: Tensor, severity: int) -> Tensor:
    """Save as a JPEG file of the severity's quality and read it again; see
    `compress_jpeg`.
    """
    return images.compress_jpeg(image, JPEG[severity - 1])


CONTINUOUS_CORRUPTIONS: Mapping[str, Callable[[Tensor, Tensor, int], Tensor]] = {
    corruption.__name__: corruption
    for corruption in (
        filters.gaussian_noise,
        filters.shot_noise,
        filters.impulse_noise,
        filters.speckle_noise,
        filters.defocus_blur,
        filters.glass_blur,
        filters.motion_blur,
        filters.zoom_blur,
        filters.gaussian_blur,
        filters.snow,
        filters.frost,
        filters.fog,
        brightness,
        contrast,
        saturate,
    )
}
"""Corruptions that are defined for severities in [1, 5], by name.

Below 1, the original image is blended with the result for severity 1. Arguments are the
image, the severity and the seed.
"""
CONTINUOUS_FROM_ZERO: Mapping[str, Callable[[Tensor, Tensor, int], Tensor]] = {
    "elastic": filters.elastic
}
"""Corruptions that are defined for severities in [0, 5], by name.

They are not blended: a blend of a warped image and the original would show the object
twice.
"""
STEPPED_CORRUPTIONS: Mapping[str, Callable[[Tensor, int], Tensor]] = {
    "pixelate": pixelate,
    "jpeg": jpeg,
}
"""Corruptions that are defined for integer severities only, by name.

Arguments are the image and the severity.
"""
CORRUPTION_NAMES = (
    *CONTINUOUS_CORRUPTIONS,
    *CONTINUOUS_FROM_ZERO,
    *STEPPED_CORRUPTIONS,
)


class CorruptionControl(Control):
    """A common image corruption (noise, blur, weather, digital) and its severity."""

    kind = "corruption"
    strength_parameter = "severity"
    parameters = (
        replace(
            Parameter.named(
                "which", CORRUPTION_NAMES, CORRUPTION_NAMES[0], "Which corruption."
            ),
            search=(0, len(CORRUPTION_NAMES) - 1),
        ),
        Parameter.number(
            ("image",),
            "severity",
            "1",
            0.0,
            float(filters.MAX_SEVERITY),
            0.0,
            "How strong it is: 0 is none, 1 to 5 are the published severities.",
            (0.0, float(filters.MAX_SEVERITY)),
        ),
    )
    choices = (
        Choice(
            "seed",
            0,
            "Which draw of the noise, the snow, the wrinkles: a whole number from 0.",
            integer_bounds=(0, 2**32 - 1),
        ),
    )

    def __init__(self, name: str | None = None, **settings: object) -> None:
        super().__init__(name, **settings)
        # A range of one parameter does not fix the other: a name without a severity has
        # no effect, and a severity needs a name.
        self.has_requested_range = False

    def resolve_parameter(self, parameter: Parameter) -> Parameter:
        """Return a parameter; the severity of stepped corruptions has no derivative."""
        allowed_names = {*self.list_allowed_values("which", *CORRUPTION_NAMES)}
        are_all_stepped = allowed_names <= {*STEPPED_CORRUPTIONS}
        if parameter.name == "severity" and are_all_stepped:
            return replace(parameter, estimators=())
        return parameter

    def on_picture(self, values: Values, image: Tensor) -> Tensor:
        return apply_corruption(
            image,
            CORRUPTION_NAMES[int(values["which"])],
            values["severity"],
            int(self.choice_values["seed"]),
        )

    def compute_measurements(
        self, values: Values, earlier_inputs: Mapping[str, Tensor]
    ) -> dict[str, Value]:
        """Return the applied severity: an integer for stepped corruptions."""
        severity = values["severity"]
        applied = float(severity)
        if CORRUPTION_NAMES[int(values["which"])] in STEPPED_CORRUPTIONS:
            applied = float(round_severity(severity))
        return {"applied": Value(value=applied, unit="1")}


def apply_corruption(
    image: Tensor, name: str, severity: Tensor, seed: int = 0
) -> Tensor:
    """Corrupt an image.

    Args:
        image: (H, W, 3) display-referred sRGB in [0, 1].
        name: one of `CORRUPTION_NAMES`.
        severity: () in [0, 5]; 0 returns the image.
        seed: seed of the noise.

    Returns:
        (H, W, 3) sRGB in [0, 1]; differentiable in the image and the severity, see
        `docs/controls/corruption.md`.
    """
    # Each corruption is in one of three tables: defined for integer severities only, for
    # all severities from 0, or for all from 1.
    if name in STEPPED_CORRUPTIONS:
        return _apply_stepped(image, STEPPED_CORRUPTIONS[name], severity)
    if name in CONTINUOUS_FROM_ZERO:
        return CONTINUOUS_FROM_ZERO[name](image, severity, seed).clamp(0.0, 1.0)
    # Below severity 1, the image is blended with the result for severity 1.
    if float(severity.detach()) >= 1.0:
        return CONTINUOUS_CORRUPTIONS[name](image, severity, seed).clamp(0.0, 1.0)
    mildest = CONTINUOUS_CORRUPTIONS[name](
        image, torch.ones_like(severity), seed
    ).clamp(0.0, 1.0)
    return (image + severity * (mildest - image)).clamp(0.0, 1.0)


def _apply_stepped(
    image: Tensor, apply_at: Callable[[Tensor, int], Tensor], severity: Tensor
) -> Tensor:
    """Corrupt an image at the integer severity nearest to a severity ().

    A rounded severity has no derivative. The gradient is that of a linear interpolation
    between the results at integer severities.

    Args:
        image: (H, W, 3) display-referred sRGB in [0, 1].
        apply_at: the corruption, for an integer severity from 1.
        severity: () in [0, 5]; at 0 the image is unchanged.
    """
    applied_severity = round_severity(severity)
    result = image
    if applied_severity > 0:
        result = apply_at(image, applied_severity)
    if severity.requires_grad:
        slope = _compute_severity_slope(image, apply_at, severity)
        # The added term is 0, but its derivative is not.
        result = result + (severity - severity.detach()) * slope
    return result.clamp(0.0, 1.0)


def _compute_severity_slope(
    image: Tensor, apply_at: Callable[[Tensor, int], Tensor], severity: Tensor
) -> Tensor:
    """Return the difference (H, W, 3) of the results at two integers around a severity."""
    # they are `below` and `below + 1`, which must exist
    below = min(int(severity.detach()), filters.MAX_SEVERITY - 1)
    low = image.detach()
    if below > 0:
        low = apply_at(image, below).detach()
    high = apply_at(image, below + 1).detach()
    return high - low


def round_severity(severity: Tensor) -> int:
    """Return the integer nearest to a severity (), where halves are rounded up."""
    return int(float(severity.detach()) + 0.5)
