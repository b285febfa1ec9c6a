"""Measurement of the noise and the blur of a photograph, and their simulation.

Noise is measured by the median of the high-pass residual in each block of pixels, over
the blocks with the smallest medians. The residual is that of Immerkaer 1996, Fast noise
variance estimation; the median is that of Donoho and Johnstone 1994, Ideal spatial
adaptation by wavelet shrinkage.

Blur is measured by the ratio R of an edge's slopes in two copies of the image, blurred
by a and by b. For a step blurred by s, R^2 = (s^2 + b^2) / (s^2 + a^2) (Zhuo and Sim
2011, Defocus map estimation from a single image, section 3). A fraction of the edges,
`SHARP_FRACTION`, is sharper than the result. A rendered edge, which pixels average over
their area, has the blur 0.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt
import torch
from scipy import ndimage
from torch import Tensor

from advsearch.scene.assets import BoolArray, Float32Array, Float64Array

BLOCK = 16  # side of the blocks in which noise is measured, pixels
QUIET_FRACTION = 0.25  # fraction of the blocks with less noise than the result
MAX_CLIPPED = 0.1  # largest fraction of black or white pixels in a block that is used
# Standard deviation of a normal distribution over its median absolute deviation.
MEDIAN_TO_SIGMA = 1.4826
# High-pass filter of norm 1, so that white noise keeps its standard deviation.
RESIDUAL = np.array([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]]) / 6.0
ROUNDING_VARIANCE = 1.0 / 12.0  # variance that rounding to levels adds, squared levels

NARROW = 1.0  # blur of one copy of the image, pixels
WIDE = 2.0  # blur of the other copy, pixels
MIN_EDGES = 40  # smallest number of pixels of edges from which a blur is computed
MIN_SLOPE = 0.15  # smallest slope of an edge, as a fraction of the image's steepest
SHARP_FRACTION = 0.4  # fraction of the edges that is sharper than the result
MAX_BLUR = 4.0  # largest blur that can be measured, pixels
CALIBRATION_SIZE = 64  # width and height of images of edges with known blurs, pixels
CALIBRATION_ANGLES = (10.0, 35.0, 65.0, 80.0)  # angles of these edges, degrees


def measure_noise(levels: npt.NDArray[np.uint8]) -> Float64Array:
    """Return the standard deviation (3,) of the noise of an image, in levels.

    A high-pass filter removes smooth shading. Of the blocks of pixels, those with the
    smallest residuals are used, since the others have texture.

    Args:
        levels: (H, W, 3) 8-bit sRGB.
    """
    sigmas = []
    for channel in range(levels.shape[2]):
        sigma = _measure_channel_noise(levels[..., channel].astype(np.float64))
        # The variance that rounding to integer levels adds is subtracted.
        sigmas.append(np.sqrt(max(0.0, sigma**2 - ROUNDING_VARIANCE)))
    return np.array(sigmas)


def _measure_channel_noise(values: Float64Array) -> float:
    """Return the standard deviation of the noise of one channel (H, W), in levels.

    It contains the noise of rounding. It is 0 if too much of the image is clipped.
    """
    # The filter reaches beyond the image at its outermost pixels, which are left out.
    residual = np.abs(ndimage.convolve(values, RESIDUAL)[1:-1, 1:-1])
    is_clipped = ((values == 0.0) | (values == 255.0))[1:-1, 1:-1]
    block_residuals = _split_blocks(residual)  # (blocks, pixels)
    clipped_fraction = _split_blocks(is_clipped).mean(axis=1)
    usable_blocks = block_residuals[clipped_fraction <= MAX_CLIPPED]
    if not len(usable_blocks):
        return 0.0
    medians = np.median(usable_blocks, axis=1)
    return MEDIAN_TO_SIGMA * float(np.quantile(medians, QUIET_FRACTION))


def _split_blocks(image: npt.NDArray[np.generic]) -> npt.NDArray[np.generic]:
    """Return the blocks of an image (H, W) as rows (blocks, pixels).

    Blocks are squares of `BLOCK` pixels. Incomplete blocks at the right and the bottom
    are cut off. An image smaller than a block is one block.
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
    """Return the blur of an image in comparison with a rendered one, in pixels.

    It is the standard deviation of a Gaussian blur, 0 if there are too few edges. The
    measurement is looked up in a table of what edges with known blurs measure.

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
    are blurred, by `NARROW` and by `WIDE`. The sharper an edge is, the more the wide
    blur reduces its slope. So the blur of the edge follows from the ratio of the two
    slopes.
    """
    row_slope = np.abs(ndimage.gaussian_filter(image, NARROW, order=(1, 0)))
    column_slope = np.abs(ndimage.gaussian_filter(image, NARROW, order=(0, 1)))
    narrow_slope = np.hypot(row_slope, column_slope)
    wide_slope = ndimage.gaussian_gradient_magnitude(image, WIDE)
    is_edge = _find_steepest(narrow_slope, row_slope, column_slope)
    # Weak edges are left out. The quantile estimates the steepest slope of the image,
    # without outliers.
    is_edge &= narrow_slope > MIN_SLOPE * float(np.quantile(narrow_slope, 0.995))
    is_edge &= _find_interior(narrow_slope.shape)
    if is_edge.sum() < MIN_EDGES:
        return None
    ratio = (narrow_slope[is_edge] / np.maximum(wide_slope[is_edge], 1e-12)) ** 2
    return _compute_blur_of_edges(ratio)


def _find_steepest(
    slope: Float64Array, row_slope: Float64Array, column_slope: Float64Array
) -> BoolArray:
    """Return the steepest pixels (H, W) across edges, by the slope of an image (H, W).

    The last two arguments are the components of the slope.
    """
    is_steepest_in_column = slope >= ndimage.maximum_filter(slope, size=(3, 1))
    is_steepest_in_row = slope >= ndimage.maximum_filter(slope, size=(1, 3))
    is_edge_along_row = row_slope > column_slope  # it changes from row to row
    steepest = np.where(is_edge_along_row, is_steepest_in_column, is_steepest_in_row)
    return np.asarray(steepest)


def _find_interior(shape: tuple[int, ...]) -> BoolArray:
    """Return the pixels (H, W) whose filters do not reach beyond an image's border."""
    margin = int(3 * WIDE)
    is_inside = np.zeros(shape, bool)
    is_inside[margin:-margin, margin:-margin] = True
    return is_inside


def _compute_blur_of_edges(ratio: Float64Array) -> float:
    """Return the blur of the sharper edges by squared ratios (N,) of slopes."""
    # An edge blurred by s has the ratio (s^2 + WIDE^2) / (s^2 + NARROW^2). It is at
    # most (WIDE / NARROW)^2, for s = 0. For a very blurred edge it goes to 1, where the
    # solution for s^2 would be infinite: hence 1.01.
    ratio = np.clip(ratio, 1.01, (WIDE / NARROW) ** 2)
    squared_blur = (WIDE**2 - ratio * NARROW**2) / (ratio - 1.0)
    return float(np.sqrt(np.quantile(squared_blur, SHARP_FRACTION)))


@lru_cache(maxsize=1)
def _calibrate() -> tuple[Float64Array, Float64Array]:
    """Return blurs (N,), and what `_measure_edges` returns for edges with these blurs.

    Both are in pixels. The edges are straight, at several angles, and averaged over
    pixels as a renderer does. This average blurs an edge, so that the measurement of an
    edge without any other blur is not 0.
    """
    oversampling = 8
    size = CALIBRATION_SIZE
    grid = (np.arange(size * oversampling) + 0.5) / oversampling - size / 2.0
    blurs = np.arange(0.0, MAX_BLUR + 0.1, 0.25)  # up to and including `MAX_BLUR`
    measured_blurs = np.zeros(len(blurs))
    for angle in np.radians(CALIBRATION_ANGLES):
        pixels = _render_edge(grid, angle, oversampling)
        for index, blur in enumerate(blurs):
            measured_blur = _measure_added_blur(pixels, blur)
            measured_blurs[index] += measured_blur / len(CALIBRATION_ANGLES)
    # An interpolation needs strictly rising values: equal ones get tiny differences.
    tiny_steps = 1e-9 * np.arange(len(blurs))
    return blurs, np.maximum.accumulate(measured_blurs + tiny_steps)


def _measure_added_blur(pixels: Float64Array, blur: float) -> float:
    """Return what `_measure_edges` returns for an edge (H, W) that is blurred."""
    image = ndimage.gaussian_filter(pixels, blur) if blur else pixels
    measured_blur = _measure_edges(image)
    assert measured_blur is not None  # an edge across the image has enough pixels
    return measured_blur


def _render_edge(grid: Float64Array, angle: float, oversampling: int) -> Float64Array:
    """Return an image of a straight edge, averaged over pixels.

    Args:
        grid: coordinates of the samples, along both axes.
        angle: angle of the edge, radians.
        oversampling: samples along each side of a pixel.
    """
    is_bright = grid[None] * np.cos(angle) + grid[:, None] * np.sin(angle) > 0.0
    size = len(grid) // oversampling
    samples = is_bright.reshape(size, oversampling, size, oversampling)
    return np.asarray(samples.mean(axis=(1, 3)))


def blur_image(image: Tensor, sigma: float) -> Tensor:
    """Return an image (H, W, C) blurred by a normal distribution; differentiable.

    `sigma` is the standard deviation in pixels. The image is padded with its edge
    pixels. The blur in two dimensions is one along columns, then one along rows.
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
