"""Denoise radiance with Intel Open Image Denoise on the CPU (package `mitsuba-oidn`).

It is guided by albedo and shading normals. It is deterministic: the same input gives
the same bytes, at any number of threads. It needs pixels with independent noise, hence
the box filter. A search treats it as the identity when it differentiates; that is an
approximation, and differences of images include it exactly.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from advsearch.errors import EnvironmentSetupError
from advsearch.scene import rendered_channels as channels
from advsearch.scene.assets import Float64Array, IntArray
from advsearch.scene.mitsuba_backend.variant import mitsuba_lock

# All four as in Open Image Denoise's `autoexposure`.
KEY_LUMINANCE = 0.18  # mean logarithmic luminance of the network's input
BIN_SIZE = 16  # width in pixels of the squares that are averaged
MIN_LUMINANCE = 1e-8  # luminance below which a square does not count
# luminance of red, green and blue (ITU-R BT.709)
LUMINANCE_WEIGHTS = np.array([0.212671, 0.715160, 0.072169])


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
    with mitsuba_lock:
        denoiser = _import_denoiser()
        resolution = (radiance.shape[0], radiance.shape[1])
        # images in memory that is used again by the next call in this thread
        buffers = _get_buffers(resolution, threading.get_ident())
        color_buffer, albedo_buffer, normal_buffer, output = buffers
        # The image gets the brightness for which the filter was trained; then back.
        gain = _compute_gain(radiance.detach())
        color_buffer.copy_(radiance.detach() * gain)
        albedo_buffer.copy_(albedo.detach())
        normal_buffer.copy_(normal.detach())
        _run_denoiser(denoiser, buffers, quick=quick)
        return (output / gain).to(radiance.device)


def _import_denoiser() -> Any:
    """Import Open Image Denoise, or raise an error that says how to install it."""
    try:
        # imported here, after Mitsuba, since Mitsuba has to choose libLLVM first
        import mitsuba_oidn
    except ImportError as error:
        raise EnvironmentSetupError(
            f"the denoiser cannot be loaded ({error}): pip install mitsuba-oidn, "
            "or use `denoise=none`"
        ) from error
    return mitsuba_oidn


def _run_denoiser(denoiser: Any, buffers: list[Tensor], *, quick: bool) -> None:
    """Denoise the color of the buffers of `_get_buffers` into the last of them."""
    color_buffer, albedo_buffer, normal_buffer, output = buffers
    quality = denoiser.Quality.Fast if quick else denoiser.Quality.High
    denoiser.denoise(
        color_buffer,
        albedo_buffer,
        normal_buffer,
        hdr=True,
        quality=quality,
        input_scale=1.0,  # the gain is applied already
        output=output,
    )


# The denoised change is faded out where the mean relative change within `FADE_RADIUS`
# pixels is less than `MIN_CHANGE`. In sRGB that is half of one of 255 levels.
FADE_RADIUS = 8
MIN_CHANGE = 0.004
FILL_RADIUS = 3  # pixels over which the plane is continued below the object
# weight of the mean nearby, relative to a pixel that the plane covers fully
FILL_WEIGHT = 0.05


def denoise_image(
    rendered: Tensor,
    albedo: Tensor,
    normal: Tensor,
    plane_radiance: Tensor | None,
    *,
    quick: bool = False,
) -> Tensor:
    """Denoise a rendered image (H, W, C).

    C is 3 or 4 without a photograph, 7 with one, and 13 if its plane has a coat. The
    plane is the ground of the photograph, on which the object's shadow falls. Each
    group of channels is denoised as an image of its own.

    Args:
        rendered: the image, with the channels of `advsearch.scene.rendered_channels`.
            Coverage is returned as it is.
        albedo, normal: (H, W, 3) float32 reflectance in [0, 1] and shading normal of
            the first hit.
        plane_radiance: (3,) radiance of the plane without the object; None if there is
            no plane.
        quick: whether to take less time, and leave a little more error.
    """
    remove_noise = partial(denoise, albedo=albedo, normal=normal, quick=quick)
    color = rendered[..., channels.RADIANCE].contiguous()
    coverage = rendered[..., channels.COVERAGE]
    denoised = [remove_noise(color), coverage]
    if plane_radiance is not None:
        denoised.append(_denoise_plane(rendered, normal, plane_radiance, remove_noise))
    has_coat = rendered.shape[-1] > channels.COAT_CHANGE.start
    if has_coat:
        assert plane_radiance is not None
        denoised += _denoise_coat(rendered, plane_radiance, remove_noise)
    return torch.cat(denoised, dim=-1)


def _denoise_plane(
    rendered: Tensor,
    normal: Tensor,
    plane_radiance: Tensor,
    remove_noise: Callable[[Tensor], Tensor],
) -> Tensor:
    """Return the denoised change (H, W, 3) of the plane's radiance, which is (3,).

    It is 0 where `normal` (H, W, 3) is 0. `rendered` has the channels of an image with
    a photograph.
    """
    coverage = rendered[..., channels.COVERAGE]
    relative_change = _denoise_shade(
        rendered[..., channels.PLANE_CHANGE] / plane_radiance,
        visible=(1.0 - coverage).clamp(0.0, 1.0),
        remove_noise=remove_noise,
    )
    # The plane is a surface: where the camera sees none, there is no normal.
    is_surface = (normal != 0.0).any(dim=-1, keepdim=True)
    return plane_radiance * is_surface * relative_change


def _denoise_coat(
    rendered: Tensor,
    plane_radiance: Tensor,
    remove_noise: Callable[[Tensor], Tensor],
) -> list[Tensor]:
    """Return the denoised change of what the plane's coat reflects, and what it
    reflects without the object.

    Both are radiance (H, W, 3). They are denoised as two images, without and with the
    object, which are then subtracted.
    """
    noisy_change = rendered[..., channels.COAT_CHANGE]
    noisy_before = rendered[..., channels.ENVIRONMENT_IN_COAT].contiguous()
    noisy_after = (noisy_before + noisy_change).clamp_min(0.0)
    before = remove_noise(noisy_before)
    after = remove_noise(noisy_after)
    fade = _compute_fade(noisy_change / plane_radiance)
    return [(after - before) * fade, before]


def _denoise_shade(
    change: Tensor, visible: Tensor, remove_noise: Callable[[Tensor], Tensor]
) -> Tensor:
    """Denoise the change (H, W, 3) of the plane, relative to its radiance.

    Before denoising, the change is continued below the object, so that the shadow at
    its contact does not get lighter. Afterwards it is faded to zero where nothing near
    it changes.

    Args:
        change: (H, W, 3) relative change, as rendered: in a pixel that the object
            covers in part, it is multiplied by the visible fraction of the plane.
        visible: (H, W, 1) fraction of a pixel in which the plane is visible.
        remove_noise: denoises an image (H, W, 3) of numbers of at least 0.
    """
    # Two box filters (`_average`) are about a Gaussian one. The quotient is the mean
    # change of the visible plane nearby.
    change_and_visible = torch.cat([change, visible], dim=-1)
    for _ in range(2):
        change_and_visible = _average(change_and_visible, FILL_RADIUS)
    mean_nearby = change_and_visible[..., :3] / change_and_visible[..., 3:].clamp_min(
        1e-4
    )
    # The change of a full pixel of the plane. `change` is multiplied by the visible
    # fraction, so that this is a mean: of the pixel's own change by the weight
    # `visible`, and of the mean nearby by a small weight. Where the plane is hidden,
    # the latter remains.
    full_change = (change + FILL_WEIGHT * mean_nearby) / (visible + FILL_WEIGHT)
    # The denoiser needs numbers of at least 0, and a change may be as low as -1.
    clean = remove_noise((1.0 + full_change).clamp_min(0.0).contiguous()) - 1.0
    return clean * visible * _compute_fade(change)


def _compute_fade(change: Tensor) -> Tensor:
    """Return a factor (H, W, 1) that falls to 0 where nothing nearby changes.

    Args:
        change: (H, W, 3) change relative to the radiance of the plane.
    """
    magnitude = _average(change.abs().mean(dim=-1, keepdim=True), FADE_RADIUS)
    return (magnitude / MIN_CHANGE).clamp_max(1.0)


def _average(image: Tensor, radius: int) -> Tensor:
    """Return the mean of an image (H, W, C) over squares, cut at its border."""
    planes = image.permute(2, 0, 1)[None]
    averaged = torch.nn.functional.avg_pool2d(
        planes, 2 * radius + 1, 1, radius, count_include_pad=False
    )
    return averaged[0].permute(1, 2, 0)


@lru_cache(maxsize=8)
def _get_buffers(resolution: tuple[int, int], thread: int) -> list[Tensor]:
    """Return four buffers (H, W, 3) for images of one size in one thread.

    They hold the color, the albedo, the normal and the result. They are cached, for
    each thread apart: with other memory the filter would be set up anew, which takes
    longer than to run it.
    """
    return [torch.zeros(*resolution, 3) for _ in range(4)]


def _compute_gain(radiance: Tensor) -> float:
    """Return the factor that gives an image the mean logarithmic luminance
    `KEY_LUMINANCE`.

    The mean is over bins of the image (H, W, 3), without black ones. The denoiser would
    compute the same factor, but the last bits of its sum depend on the number of
    threads.
    """
    luminance = (radiance.cpu().numpy() * LUMINANCE_WEIGHTS).sum(axis=-1)
    bin_means = _compute_bin_means(luminance)
    bin_means = bin_means[bin_means > MIN_LUMINANCE]
    if not bin_means.size:  # the image is black
        return 1.0
    return float(KEY_LUMINANCE / np.exp2(np.log2(bin_means).mean()))


def _compute_bin_means(luminance: Float64Array) -> Float64Array:
    """Return the means of luminance (H, W) over squares of about `BIN_SIZE` pixels."""
    height, width = luminance.shape
    row_starts = _find_bin_starts(height)
    column_starts = _find_bin_starts(width)
    row_counts = np.diff(row_starts, append=height)
    column_counts = np.diff(column_starts, append=width)
    row_sums = np.add.reduceat(luminance, row_starts, axis=0)
    bin_sums = np.add.reduceat(row_sums, column_starts, axis=1)
    means: Float64Array = bin_sums / np.outer(row_counts, column_counts)
    return means


def _find_bin_starts(size: int) -> IntArray:
    """Return where the squares of `BIN_SIZE` pixels begin along a side of an image."""
    n_bins = -(-size // BIN_SIZE)
    return np.arange(n_bins) * size // n_bins
