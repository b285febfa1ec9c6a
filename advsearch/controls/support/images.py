"""Images that controls scale, save and read."""

from __future__ import annotations

import io

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

from advsearch.controls.corruption_filters import picture, planes, resized
from advsearch.scene.color import levels_of, linear_to_srgb, srgb_to_linear

PRINT_SIDE = 512  # least side of the picture that is kept for printing, in pixels


def resampled(image: Tensor, side: int) -> Tensor:
    """Resize an (h, w, 3) image to (side, side, 3) with an antialiased bilinear filter; values stay in [0, 1]."""
    return resized(image, side, side).contiguous().clamp(0.0, 1.0)


def enlarged(pixels: Tensor, factor: int) -> Tensor:
    """Return a picture (h, w, 3) sRGB at a whole multiple of its size, interpolated as the renderer does it."""
    larger = F.interpolate(planes(srgb_to_linear(pixels)), scale_factor=factor, mode="bilinear", align_corners=False)
    return linear_to_srgb(picture(larger))


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
    with Image.open(file, formats=("JPEG",)) as read:
        read_back = torch.from_numpy(np.asarray(read, dtype=np.float32) / 255.0)
    return image + (read_back.to(image.device) - image).detach()
