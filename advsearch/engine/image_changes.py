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


CHANGED: dict[str, Callable[[Tensor], Tensor]] = {
    "black": torch.zeros_like,
    "covered": _cover,
    "exposure": _brighten,
    "shift": _shift,
    "jpeg": _compress,
}
"""Functions from an image (H, W, 3), sRGB in [0, 1], to the changed image, by name."""
AWAY = "away"  # the change that renders the scene again, without the object
# largest change of a label's probability that counts as none
ALIKE = 0.1


def changed(picture: Tensor, when: str, cameras: int = 1) -> Tensor:
    """Return an image (H, W, 3) with a change of `CHANGED`.

    The images of several cameras stand side by side, and each is changed by itself.
    """
    change = CHANGED[when]
    images = picture.chunk(cameras, dim=1)
    return torch.cat([change(image) for image in images], dim=1)


def as_claimed(claim: str, before: Prediction, after: Prediction) -> bool:
    """Return whether a change of the image did what a claim states.

    The claim is that the prediction "must_change", or "must_not_change".
    """
    has_other_label = before.label != after.label
    if claim != "must_change":
        return not has_other_label
    difference = abs((before.probability or 0.0) - (after.probability or 0.0))
    return has_other_label or difference > ALIKE
