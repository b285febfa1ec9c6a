"""When the rows of a picture are exposed: an open shutter (motion blur) and rows that are read one after the other.

A row r of H is exposed for `shutter` seconds, and rows are read within `rolling` seconds; the middle of the picture's
exposure is the time of the configuration. What a sensor counts is light, so a row is the mean of linear radiance over
its exposure, before the denoiser and the tone curve. The mean is over M moments, evenly spaced, of which each row takes
those in its own exposure.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

FEWEST, MOST = 8, 64
A_PIXEL = 2
"""Moments for each pixel that the fastest point of the picture moves while it is taken."""


class Later(Protocol):
    """Maps a configuration to scene inputs, as `InputSpace` does, at another time."""

    def inputs(self, u: Tensor) -> dict[str, Tensor]:
        """Map u (d,) to scene inputs by torch operations; differentiable."""


@dataclass(frozen=True, eq=False)
class Moment:
    """A part of an exposure: what the scene is then, its share (H,) of each row, which adds up to 1 over all moments,
    and its share of the samples a pixel."""

    space: Later
    rows: Tensor
    samples: float


def moments_of(shutter: float, rolling: float, height: int, count: int) -> tuple[Tensor, Tensor, float]:
    """Return when moments are, how much each counts, and the part of a pixel's samples that each takes.

    Args:
        shutter, rolling: seconds that each row is exposed, and from the first row to the end of the last, at least 0.
        height: rows of the picture.
        count: moments M. With as many as rows and no shutter, each row has the moment of its own.

    Returns:
        Seconds from the middle of the exposure (M,), and shares of the rows (M, H), whose columns add up to 1.
    """
    cell = (shutter + rolling) / count
    begins = torch.arange(count, dtype=torch.float64) * cell
    opens = rolling * (torch.arange(height, dtype=torch.float64) + 0.5) / height
    if shutter < cell:  # a row lies within one moment
        nearest = ((opens + shutter / 2.0) / cell).long().clamp_max(count - 1)
        shares = torch.nn.functional.one_hot(nearest, count).T.double()
    else:
        ends = torch.minimum(begins[:, None] + cell, opens + shutter)
        shares = (ends - torch.maximum(begins[:, None], opens)).clamp_min(0.0)
    shares = shares / shares.sum(dim=0)
    offsets = begins + cell / 2.0 - (shutter + rolling) / 2.0
    return offsets, shares.float(), min(1.0, cell / shutter if shutter else 1.0)
