"""What claims change in a picture, to see whether the model says something else."""

from __future__ import annotations

import io
from collections.abc import Callable

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from advsearch.scene.color import linear_to_srgb, srgb_to_linear


def _brighter(picture: Tensor) -> Tensor:
    brighter: Tensor = linear_to_srgb(srgb_to_linear(picture) * 2.0 ** (1.0 / 3.0))
    return brighter


def _compressed(picture: Tensor) -> Tensor:
    file = io.BytesIO()
    Image.fromarray((picture * 255.0).round().byte().numpy()).save(file, "JPEG", quality=95)
    return torch.from_numpy(np.array(Image.open(file, formats=["JPEG"]))).to(picture) / 255.0


CHANGED: dict[str, Callable[[Tensor], Tensor]] = {
    "black": torch.zeros_like,
    "covered": lambda picture: picture.mean(dim=(0, 1)).expand_as(picture).contiguous(),
    "exposure": _brighter,
    "shift": lambda picture: torch.cat([picture[:, :1], picture[:, :-1]], dim=1),
    "jpeg": _compressed,
}
"""What makes the changed picture of one (H, W, 3), sRGB in [0, 1]."""

OTHER_SCENE = {"away": {"pose.y": 1000.0}}
"""Parameters of the scene that is rendered in its place. At 1,000 of its own sizes an object is under a pixel wide, and
its shadow is out of the picture."""

ALIKE = 0.1
"""How far the probability of one label may move, and nothing has changed for `must_change`."""
