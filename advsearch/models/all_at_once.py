"""A network that takes the images of several cameras in one call."""

from __future__ import annotations

from typing import final

import torch
from torch import Tensor, nn

from advsearch.errors import InputError


@final
class AllAtOnce(nn.Module):
    """Call a network of all images of a rig at once as a network of single images.

    A rig is a set of K cameras. Each of its images gets the same output, so that all
    rules of the task `rig` give the same result.

    Args:
        network: network from (N, K, 3, H, W), or (N, K, H, W, 3), to an output with N
            rows.
        cameras: number of cameras K.
        layout: "NKCHW" or "NKHWC".

    Raises:
        InputError: the layout is another one.
    """

    def __init__(self, network: nn.Module, cameras: int, layout: str = "NKCHW") -> None:
        super().__init__()
        if layout not in ("NKCHW", "NKHWC"):
            raise InputError(f"layout: expected NKCHW or NKHWC, got {layout!r}")
        self.network = network
        self.cameras = cameras
        self.layout = layout

    def forward(self, images: Tensor) -> Tensor:
        """Return the output (N * K, ...) for the images of N configurations.

        All K images of a configuration get the same row of the output. A count of
        images that is no multiple of K is allowed, since a model is run on one or two
        images when it is loaded. Then copies of the last image are added, and their
        rows are cut off.

        Args:
            images: (N * K, 3, H, W); the K images of a configuration follow each other.
        """
        count = len(images)
        n_missing = -count % self.cameras
        padded = images
        if n_missing:
            copies = images[-1:].expand(n_missing, -1, -1, -1)
            padded = torch.cat([images, copies])
        rigs = padded.unflatten(0, (-1, self.cameras))  # (N, K, 3, H, W)
        if self.layout == "NKHWC":
            rigs = rigs.permute(0, 1, 3, 4, 2)
        output: Tensor = self.network(rigs)
        return output.repeat_interleave(self.cameras, dim=0)[:count]
