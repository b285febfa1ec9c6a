"""Intel Open Image Denoise on the CPU, guided by albedo and shading normals (package `mitsuba-oidn`).

Deterministic: the same input gives the same bytes. It needs pixels with independent noise, hence the box filter. A
search treats it as the identity when it differentiates; that is an approximation, and differences of pictures include
it exactly.
"""

from __future__ import annotations

import torch
from torch import Tensor

from advsearch.errors import EnvironmentSetupError


class Denoiser:
    """The denoiser for pictures of one size.

    It works in buffers of its own: the filter is set up anew, for longer than it takes to run, whenever it is given
    other memory.

    Args:
        resolution: (height, width) in pixels.
    """

    def __init__(self, resolution: tuple[int, int]) -> None:
        self._buffers = [torch.zeros(*resolution, 3) for _ in range(4)]

    def __call__(self, radiance: Tensor, albedo: Tensor, normal: Tensor) -> Tensor:
        """Return the denoised linear radiance.

        Args:
            radiance: (H, W, 3) float32 linear radiance, at least 0.
            albedo: (H, W, 3) float32 reflectance of the first hit in [0, 1].
            normal: (H, W, 3) float32 shading normal of the first hit in [-1, 1].

        Raises:
            EnvironmentSetupError: the package is not installed.
        """
        try:
            import mitsuba_oidn
        except ImportError as error:
            raise EnvironmentSetupError(
                f"the denoiser cannot be loaded ({error}): pip install mitsuba-oidn, or use `denoise=none`"
            ) from error
        color, guide, direction, output = self._buffers
        for buffer, image in ((color, radiance), (guide, albedo), (direction, normal)):
            buffer.copy_(image.detach())
        mitsuba_oidn.denoise(color, guide, direction, hdr=True, output=output)
        return output.to(radiance.device, copy=True)
