"""Changes of an image after which a prediction must change, or must not.

Claims of a test name them.
"""

from __future__ import annotations

import io
from collections.abc import Callable

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from advsearch.scene.color import linear_to_srgb, srgb_to_linear
from advsearch.tasks import Prediction


def _brighten(image: Tensor) -> Tensor:
    """Return an image a third of a stop brighter."""
    brighter: Tensor = linear_to_srgb(srgb_to_linear(image) * 2.0 ** (1.0 / 3.0))
    return brighter


def _compress(image: Tensor) -> Tensor:
    """Return an image (H, W, 3) after JPEG compression of quality 95."""
    file = io.BytesIO()
    levels = (image * 255.0).round().byte().numpy()
    Image.fromarray(levels).save(file, "JPEG", quality=95)
    compressed_levels = np.array(Image.open(file, formats=["JPEG"]))
    return torch.from_numpy(compressed_levels).to(image) / 255.0


def _cover(image: Tensor) -> Tensor:
    """Return an image (H, W, 3) that has its mean color everywhere."""
    return image.mean(dim=(0, 1)).expand_as(image).contiguous()


def _shift(image: Tensor) -> Tensor:
    """Return an image (H, W, 3) moved one pixel to the right."""
    return torch.cat([image[:, :1], image[:, :-1]], dim=1)


IMAGE_CHANGES: dict[str, Callable[[Tensor], Tensor]] = {
    "black": torch.zeros_like,
    "covered": _cover,
    "exposure": _brighten,
    "shift": _shift,
    "jpeg": _compress,
}
"""Functions from an image (H, W, 3), sRGB in [0, 1], to the changed image, by name."""
WITHOUT_OBJECT = "away"  # the change that renders the scene again, without the object
# largest change of a label's probability that counts as none
MAX_UNCHANGED_DIFFERENCE = 0.1


def change_image(image: Tensor, change_name: str, n_cameras: int = 1) -> Tensor:
    """Return an image (H, W, 3) with a change of `IMAGE_CHANGES`.

    The images of several cameras stand side by side, and each is changed by itself.
    """
    change = IMAGE_CHANGES[change_name]
    images = image.chunk(n_cameras, dim=1)
    return torch.cat([change(image) for image in images], dim=1)


def meets_claim(claim: str, before: Prediction, after: Prediction) -> bool:
    """Return whether a prediction did what was claimed, when its image was changed.

    Args:
        claim: "must_not_change" claims that the label stays. "must_change" claims that
            the label changes, or the probability by more than
            `MAX_UNCHANGED_DIFFERENCE`.
        before: prediction on the original image.
        after: prediction on the changed image.
    """
    has_other_label = before.label != after.label
    if claim != "must_change":  # "must_not_change"
        return not has_other_label
    # a prediction without a probability counts as one of 0
    difference = abs((before.probability or 0.0) - (after.probability or 0.0))
    return has_other_label or difference > MAX_UNCHANGED_DIFFERENCE
