"""Measure the noise and the blur of a photograph, and make others of the same kind.

    noise  the median of the high-pass residual of a block, over the quieter blocks
    blur   the ratio of an edge's slopes in two blurred copies,
           R^2 = (s^2 + b^2) / (s^2 + a^2) for a step blurred by s; two fifths of the
           edges are sharper than what is returned

Noise: Immerkaer 1996, Fast noise variance estimation (the residual); Donoho and
Johnstone 1994, Ideal spatial adaptation by wavelet shrinkage (the median). Blur: Zhuo
and Sim 2011, Defocus map estimation from a single image, section 3. The blur of a
rendered edge, which pixels average over their area, counts as none.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt
import torch
from scipy import ndimage
from torch import Tensor

from advsearch.scene.assets import Float32Array, Float64Array

BLOCK = 16  # side of the blocks in which noise is measured, pixels
QUIET_FRACTION = 0.25  # of the blocks that has less noise than what is returned
MAX_CLIPPED = 0.1  # fraction of black or white pixels of a block that counts
MEDIAN_TO_SIGMA = 1.4826  # of a normal distribution
RESIDUAL = np.array([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]]) / 6.0
ROUNDING_VARIANCE = 1.0 / 12.0  # of levels

NARROW = 1.0  # blur of the two copies, pixels
WIDE = 2.0
MIN_EDGES = 40  # fewer pixels of edges say nothing about the blur
MIN_SLOPE = 0.15  # of an edge, as a fraction of the steepest of the image
SHARP_FRACTION = 0.4  # of the edges that is sharper than what is returned
MAX_BLUR = 4.0  # pixels
CALIBRATION_SIZE = 64  # pixels of the images of edges that are known
CALIBRATION_ANGLES = (10.0, 35.0, 65.0, 80.0)  # of these edges, degrees


def measure_noise(levels: npt.NDArray[np.uint8]) -> Float64Array:
    """Return the standard deviation (3,) of the noise of an image, in levels.

    A high-pass filter removes what is smooth. Blocks of pixels are compared, and those
    with the smallest residuals count, since the others have texture.

    Args:
        levels: (H, W, 3) 8-bit sRGB.
    """
    sigmas = []
    for channel in range(levels.shape[2]):
        values = levels[..., channel].astype(np.float64)
        # `RESIDUAL` has a norm of 1, so that it leaves the deviation of noise as it is
        residual = np.abs(ndimage.convolve(values, RESIDUAL)[1:-1, 1:-1])
        is_clipped = ((values == 0.0) | (values == 255.0))[1:-1, 1:-1]
        by_block = _split_blocks(residual)
        clipped = _split_blocks(is_clipped).mean(axis=1)
        usable = by_block[clipped <= MAX_CLIPPED]
        sigma = 0.0
        if len(usable):
            medians = np.median(usable, axis=1)
            sigma = MEDIAN_TO_SIGMA * float(np.quantile(medians, QUIET_FRACTION))
        # The rounding to whole levels adds a variance of its own, which is subtracted.
        sigmas.append(np.sqrt(max(0.0, sigma**2 - ROUNDING_VARIANCE)))
    return np.array(sigmas)


def _split_blocks(image: npt.NDArray[np.generic]) -> npt.NDArray[np.generic]:
    """Return the blocks of an image (H, W) as rows (blocks, pixels).

    Blocks are squares of `BLOCK` pixels; what is left at the right and the bottom is
    cut off. A smaller image is one block.
    """
    rows = image.shape[0] // BLOCK
    columns = image.shape[1] // BLOCK
    if rows == 0 or columns == 0:
        return image.reshape(1, -1)
    cut = image[: rows * BLOCK, : columns * BLOCK]
    blocks = cut.reshape(rows, BLOCK, columns, BLOCK).swapaxes(1, 2)
    return np.asarray(blocks.reshape(rows * columns, -1))


def make_noise(sigma: Float64Array, size: tuple[int, int], seed: int) -> Tensor:
    """Return normal noise (H, W, 3) float32 of a standard deviation (3,)."""
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(*size, 3, generator=generator)
    return noise * torch.from_numpy(np.asarray(sigma, np.float32))


def measure_blur(image: Float32Array) -> float:
    """Return by how much an image is blurred beyond a rendered one, in pixels.

    It is the standard deviation of a normal blur, 0 where there are too few edges. What
    is measured on edges is looked up among measurements of edges with known blurs.

    Args:
        image: (H, W) linear luminance.
    """
    measured_blur = _measure_edges(image.astype(np.float64))
    if measured_blur is None:
        return 0.0
    blurs, measured_blurs = _calibrate()
    return float(np.interp(measured_blur, measured_blurs, blurs))


def _measure_edges(image: Float64Array) -> float | None:
    """Return the blur of the sharper edges of an image (H, W); None if it has too few.

    The blur is the standard deviation of a Gaussian, in pixels. Two copies of the image
    are blurred, by `NARROW` and by `WIDE`. The sharper an edge is, the more of its
    slope the wide blur takes away: so the ratio of the two slopes tells the edge's own
    blur.
    """
    row_slope = np.abs(ndimage.gaussian_filter(image, NARROW, order=(1, 0)))
    column_slope = np.abs(ndimage.gaussian_filter(image, NARROW, order=(0, 1)))
    narrow = np.hypot(row_slope, column_slope)
    wide = ndimage.gaussian_gradient_magnitude(image, WIDE)
    # An edge counts at its steepest pixel, in the direction across it.
    is_steepest_row = narrow >= ndimage.maximum_filter(narrow, size=(3, 1))
    is_steepest_column = narrow >= ndimage.maximum_filter(narrow, size=(1, 3))
    is_edge = np.where(row_slope > column_slope, is_steepest_row, is_steepest_column)
    # Weak edges are left out. The quantile stands for the steepest slope of the image,
    # without outliers.
    is_edge &= narrow > MIN_SLOPE * float(np.quantile(narrow, 0.995))
    # So near to the border the filters reach beyond it.
    margin = int(3 * WIDE)
    is_edge[:margin] = is_edge[-margin:] = False
    is_edge[:, :margin] = is_edge[:, -margin:] = False
    if is_edge.sum() < MIN_EDGES:
        return None
    ratio = (narrow[is_edge] / np.maximum(wide[is_edge], 1e-12)) ** 2
    # The ratio of an edge without blur is the upper bound. That of a very blurred edge
    # goes to 1, where the solution below would be infinite: hence 1.01.
    ratio = np.clip(ratio, 1.01, (WIDE / NARROW) ** 2)
    # An edge blurred by s has the ratio (s^2 + WIDE^2) / (s^2 + NARROW^2): solved for
    # s^2.
    squared_blur = (WIDE**2 - ratio * NARROW**2) / (ratio - 1.0)
    return float(np.sqrt(np.quantile(squared_blur, SHARP_FRACTION)))


@lru_cache(maxsize=1)
def _calibrate() -> tuple[Float64Array, Float64Array]:
    """Return blurs (N,), and what `_measure_edges` gives for edges with these blurs.

    Both are in pixels. The edges are straight, at several angles, and averaged over
    pixels as a renderer does. That blurs an edge already, so that the measurement of an
    edge without further blur is not 0: a measurement is corrected by this table.
    """
    oversampling = 8
    size = CALIBRATION_SIZE
    grid = (np.arange(size * oversampling) + 0.5) / oversampling - size / 2.0
    blurs = np.arange(0.0, MAX_BLUR + 0.1, 0.25)  # up to `MAX_BLUR`, which counts
    measured_blurs = np.zeros(len(blurs))
    for angle in np.radians(CALIBRATION_ANGLES):
        is_bright = grid[None] * np.cos(angle) + grid[:, None] * np.sin(angle) > 0.0
        pixels = is_bright.reshape(size, oversampling, size, oversampling).mean(
            axis=(1, 3)
        )
        for index, blur in enumerate(blurs):
            image = ndimage.gaussian_filter(pixels, blur) if blur else pixels
            # never None: an edge across the image has enough pixels
            measured = _measure_edges(image) or 0.0
            measured_blurs[index] += measured / len(CALIBRATION_ANGLES)
    # Strictly rising, as an interpolation needs it.
    return blurs, np.maximum.accumulate(measured_blurs + 1e-9 * np.arange(len(blurs)))


def blur_image(image: Tensor, sigma: float) -> Tensor:
    """Return an image (H, W, C) blurred by a normal distribution; differentiable.

    `sigma` is its standard deviation in pixels. The image's edges are repeated beyond
    it. One pass along columns and one along rows are the blur in two dimensions.
    """
    radius = int(np.ceil(3.0 * sigma))
    offsets = torch.arange(-radius, radius + 1, dtype=torch.float32)
    kernel = torch.exp(-0.5 * (offsets / sigma) ** 2)
    kernel = (kernel / kernel.sum()).to(image)
    planes = image.permute(2, 0, 1)[:, None]
    padded = torch.nn.functional.pad(planes, [radius] * 4, mode="replicate")
    rows = torch.nn.functional.conv2d(padded, kernel.reshape(1, 1, -1, 1))
    blurred = torch.nn.functional.conv2d(rows, kernel.reshape(1, 1, 1, -1))
    return blurred[:, 0].permute(1, 2, 0)
