"""Intel Open Image Denoise on the CPU, guided by albedo and shading normals (package
`mitsuba-oidn`).

Deterministic: the same input gives the same bytes, at any number of threads. It needs
pixels with independent noise, hence the box filter. A search treats it as the identity
when it differentiates; that is an approximation, and differences of pictures include it
exactly.
"""

from __future__ import annotations

import threading
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from advsearch.errors import EnvironmentSetupError
from advsearch.scene.mitsuba_backend.variant import one_at_a_time

# mean logarithmic luminance of a picture as the network sees it (as in Open Image
# Denoise's `autoexposure`)
KEY = 0.18
# pixels along a side of the squares that are averaged, and the least luminance;
# likewise
BIN = 16
DARKEST = 1e-8
# of red, green and blue (ITU-R BT.709); likewise
LUMINANCE = np.array([0.212671, 0.715160, 0.072169])


def denoise(
    radiance: Tensor, albedo: Tensor, normal: Tensor, *, quick: bool = False
) -> Tensor:
    """Return the denoised linear radiance.

    Args:
        radiance: (H, W, 3) float32 linear radiance, at least 0.
        albedo, normal: (H, W, 3) float32 reflectance in [0, 1] and shading normal in
            [-1, 1] of the first hit.
        quick: take some 0.6 of the time, and leave a little more error.

    Raises:
        EnvironmentSetupError: the package is not installed.
    """
    with one_at_a_time:
        try:
            # not before `mitsuba()`, which sees to libLLVM
            import mitsuba_oidn
        except ImportError as error:
            raise EnvironmentSetupError(
                f"the denoiser cannot be loaded ({error}): pip install mitsuba-oidn, "
                "or use `denoise=none`"
            ) from error
        color, guide, direction, output = _buffers(
            (radiance.shape[0], radiance.shape[1]), threading.get_ident()
        )
        gain = _gain(radiance.detach())
        for buffer, image in (
            (color, radiance.detach() * gain),
            (guide, albedo),
            (direction, normal),
        ):
            buffer.copy_(image.detach())
        quality = mitsuba_oidn.Quality.Fast if quick else mitsuba_oidn.Quality.High
        mitsuba_oidn.denoise(
            color,
            guide,
            direction,
            hdr=True,
            quality=quality,
            input_scale=1.0,
            output=output,
        )
        return (output / gain).to(radiance.device)


@lru_cache(maxsize=8)
def _buffers(resolution: tuple[int, int], thread: int) -> list[Tensor]:
    """Return what pictures of a size are denoised in, in a thread: the filter is set up
    anew, for longer than it takes to run, whenever it is given other memory.
    """
    return [torch.zeros(*resolution, 3) for _ in range(4)]


def _gain(radiance: Tensor) -> float:
    """Return the factor that gives a picture (H, W, 3) the mean logarithmic luminance
    `KEY`.

    The denoiser would find it by itself, but adds up in an order that depends on the
    number of threads: by a few units in the last place.
    """
    luminance = (radiance.cpu().numpy() * LUMINANCE).sum(axis=-1)
    starts = [
        np.arange(-(-side // BIN)) * side // -(-side // BIN) for side in luminance.shape
    ]
    rows, columns = (
        np.diff(first, append=side)
        for first, side in zip(starts, luminance.shape, strict=True)
    )
    means = np.add.reduceat(
        np.add.reduceat(luminance, starts[0], axis=0), starts[1], axis=1
    ) / np.outer(rows, columns)
    means = means[means > DARKEST]
    return float(KEY / np.exp2(np.log2(means).mean())) if means.size else 1.0
