"""Changes of an image after which a prediction must change, or must not, as claims
state it.
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


def _brighter(picture: Tensor) -> Tensor:
    brighter: Tensor = linear_to_srgb(srgb_to_linear(picture) * 2.0 ** (1.0 / 3.0))
    return brighter


def _compressed(picture: Tensor) -> Tensor:
    file = io.BytesIO()
    Image.fromarray((picture * 255.0).round().byte().numpy()).save(
        file, "JPEG", quality=95
    )
    return (
        torch.from_numpy(np.array(Image.open(file, formats=["JPEG"]))).to(picture)
        / 255.0
    )


CHANGED: dict[str, Callable[[Tensor], Tensor]] = {
    "black": torch.zeros_like,
    "covered": lambda picture: picture.mean(dim=(0, 1)).expand_as(picture).contiguous(),
    "exposure": _brighter,
    "shift": lambda picture: torch.cat([picture[:, :1], picture[:, :-1]], dim=1),
    "jpeg": _compressed,
}
"""What makes the changed picture of one (H, W, 3), sRGB in [0, 1]."""
AWAY = "away"  # what is rendered again, see `Assembly.away`
# how far the probability of one label may move, and nothing has changed for
# `must_change`
ALIKE = 0.1


def changed(picture: Tensor, when: str, cameras: int = 1) -> Tensor:
    """Return a picture (H, W, 3) that is changed as a name of `CHANGED` says; of a rig
    those of all its cameras.
    """
    return torch.cat(
        [CHANGED[when](part) for part in picture.chunk(cameras, dim=1)], dim=1
    )


def as_claimed(claim: str, before: Prediction, after: Prediction) -> bool:
    """Return whether a change did what is claimed: that it `must_change` what the model
    says, or `must_not_change`.
    """
    moved = abs((before.probability or 0.0) - (after.probability or 0.0))
    another = before.label != after.label
    return another or moved > ALIKE if claim == "must_change" else not another
