"""Corruptions of brightness, contrast and colour, and by file formats: pixelate and JPEG.

Hendrycks & Dietterich 2019, arXiv 1903.12261, appendix A.
"""

from __future__ import annotations

import io

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

from advsearch.controls.corruption.tools import REFERENCE, at_level, picture, planes
from advsearch.scene.formation import levels_of

BRIGHTNESS = ((0.1,), (0.2,), (0.3,), (0.4,), (0.5,))
"""Added to the value of hue, saturation and value."""
CONTRAST = ((0.4,), (0.3,), (0.2,), (0.1,), (0.05,))
"""Factor on the distance from the mean."""
SATURATE = ((0.3, 0.0), (0.1, 0.0), (2.0, 0.0), (5.0, 0.1), (20.0, 0.2))
"""Factor on the saturation, and what is added to it."""
PIXELATE = (0.6, 0.5, 0.4, 0.3, 0.25)
"""Pixels left along a side, as a share."""
JPEG = (25, 18, 15, 10, 7)
"""Quality."""
_GREY = 1.0 / 512.0
"""Values and saturations this small have no hue to speak of; keeps quotients finite."""


def brightness(image: Tensor, level: Tensor, seed: int) -> Tensor:
    """Raise the value, keep hue and saturation."""
    (more,) = at_level(BRIGHTNESS, level)
    value = image.amax(dim=-1, keepdim=True)
    return image + ((value + more).clamp(max=1.0) - value) * (image + _GREY) / (value + _GREY)


def contrast(image: Tensor, level: Tensor, seed: int) -> Tensor:
    """Pull every value towards its channel's mean."""
    (factor,) = at_level(CONTRAST, level)
    mean = image.mean(dim=(0, 1))
    return mean + factor * (image - mean)


def saturate(image: Tensor, level: Tensor, seed: int) -> Tensor:
    """Scale the saturation, keep hue and value; grey stays grey."""
    factor, more = at_level(SATURATE, level)
    value = image.amax(dim=-1, keepdim=True)
    saturation = (value - image.amin(dim=-1, keepdim=True)) / (value + _GREY)
    wanted = (factor * saturation + more).clamp(max=1.0)
    return value - (value - image) * wanted / (saturation + _GREY)


def pixelate(image: Tensor, whole: int) -> Tensor:
    """Average the picture over square cells; linear in the picture.

    A cell has 1.7 to 4 pixels of a picture of the reference size, more in a larger one, and as many in a smaller one.
    """
    height, width = image.shape[:2]
    share = PIXELATE[whole - 1] / max(1.0, min(height, width) / REFERENCE)
    cells = (max(1, int(height * share)), max(1, int(width * share)))
    return picture(
        F.interpolate(F.interpolate(planes(image), cells, mode="area"), (height, width), mode="nearest-exact")
    )


def jpeg(image: Tensor, whole: int) -> Tensor:
    """Save as a JPEG file of the severity's quality and read it again; see `coded`."""
    return coded(image, JPEG[whole - 1])


def coded(image: Tensor, quality: int) -> Tensor:
    """Save as a JPEG file and read it again, chroma subsampled; the derivative is that of the unchanged picture.

    For changes that are smooth over three pixels or more this is within about a third of what the file does with
    them (measured at qualities of 7 to 25); of finer ones the file keeps less than it says.

    Args:
        image: (H, W, 3) display-referred sRGB in [0, 1].
        quality: 1 to 100, as of libjpeg.
    """
    levels = levels_of(image.clamp(0.0, 1.0)).cpu().numpy()
    file = io.BytesIO()
    Image.fromarray(levels).save(file, "JPEG", quality=quality)
    with Image.open(file) as read:
        read_back = torch.from_numpy(np.asarray(read, dtype=np.float32) / 255.0)
    return image + (read_back.to(image.device) - image).detach()
