"""A network that takes the pictures of several cameras in one call."""

from __future__ import annotations

from typing import final

import torch
from torch import Tensor, nn

from advsearch.errors import InputError


@final
class AllAtOnce(nn.Module):
    """A network that takes all pictures of a rig in one call, as a model of single
    pictures.

    Its output counts for each of them, so that any rule of the task `rig` gives the
    same.

    Args:
        network: network from (N, K, 3, H, W), or (N, K, H, W, 3), to an output with N
            rows.
        cameras: K.
        layout: "NKCHW" or "NKHWC".

    Raises:
        InputError: another layout.
    """

    def __init__(self, network: nn.Module, cameras: int, layout: str = "NKCHW") -> None:
        super().__init__()
        if layout not in ("NKCHW", "NKHWC"):
            raise InputError(f"layout: expected NKCHW or NKHWC, got {layout!r}")
        self.network = network
        self.cameras = cameras
        self.layout = layout

    def forward(self, images: Tensor) -> Tensor:
        """Return the output (N * K, ...) for the pictures of N configurations.

        All K pictures of a configuration get the same row of the output. A count that
        is no multiple of K is allowed, since a model is run on one or two images when
        it is loaded. Then copies of the last picture fill it up, and get no row.

        Args:
            images: (N * K, 3, H, W), the K pictures of each configuration together.
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
