"""Networks that answer with how far each pixel is, as Depth Anything does."""

from __future__ import annotations

import math
from typing import Any

from torch import Tensor, nn
from torch.nn import functional

from advsearch.models.source import Source
from advsearch.models.zoo.loaded import Loaded

DISPARITY, METRIC = "relative disparity", "metric depth"
"""What their numbers are, by the words of `advsearch.tasks.depth.KINDS`."""

BY_FAMILY = {"dpt": DISPARITY, "depth_pro": DISPARITY, "zoedepth": METRIC, "glpn": METRIC}
"""Of a network whose ``config`` does not say it, by family: that of the weights that are published first."""


def source(loaded: Loaded) -> Source:
    """Return the source of a network that answers with how far each pixel is."""
    return loaded.source(_DepthMap(loaded.network, bool(getattr(loaded.processor, "do_pad", False))))


class _DepthMap(nn.Module):
    """A mapping with numbers (N, h, w) under what they are.

    ZoeDepth is shown pictures with a mirrored border, which its processor adds and its post-processing removes.

    Args:
        network: of transformers.
        padded: whether its processor adds a border.
    """

    def __init__(self, network: Any, padded: bool) -> None:
        super().__init__()
        said = {"relative": DISPARITY, "metric": METRIC}.get(getattr(network.config, "depth_estimation_type", ""), "")
        self.network, self.kind = network, (said or BY_FAMILY.get(network.config.model_type, "predicted_depth"))
        self.padded = padded and network.config.model_type == "zoedepth"

    def forward(self, images: Tensor) -> dict[str, Tensor]:
        if not self.padded:
            return {self.kind: self.network(pixel_values=images).predicted_depth}
        height, width = images.shape[2:]
        down, across = (int(math.sqrt(side / 2.0) * 3.0) for side in (height, width))
        framed = functional.pad(images, (across, across, down, down), mode="reflect")
        shown = functional.interpolate(framed, size=(height, width), mode="bilinear", align_corners=True)
        found = self.network(pixel_values=shown).predicted_depth[:, None]
        found = functional.interpolate(found, size=framed.shape[2:], mode="bicubic")
        return {self.kind: found[:, 0, down : down + height, across : across + width]}
