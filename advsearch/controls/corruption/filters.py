"""Corruptions by noise, blur, shifted pixels and weather.

They follow Hendrycks & Dietterich 2019, arXiv 1903.12261, appendix A. Their frost is a
photograph; here it is drawn from noise. Images are (H, W, 3) float32 display-referred
sRGB in [0, 1]. Lengths in the tables are in pixels of a reference image, whose shorter
side has `REFERENCE_SIDE` pixels. The noise depends on the seed only, so that it is the
same at every severity.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image, ImageDraw
from scipy import ndimage
from torch import Tensor

from advsearch.extend import images, seeds

# shorter side in pixels of the images that the published tables were made for
REFERENCE_SIDE = 224
MAX_SEVERITY = 5  # severities go from 1 to this


def compute_pixel_scale(image: Tensor) -> float:
    """Return how many pixels of an image (H, W, 3) are one pixel of the reference."""
    return min(image.shape[0], image.shape[1]) / REFERENCE_SIDE


def compute_reference_size(height: int, width: int) -> tuple[int, int]:
    """Return the rows and columns of a reference image of the same shape.

    Its smaller side has `REFERENCE_SIDE` pixels.
    """
    side = min(height, width)
    return round(height * REFERENCE_SIDE / side), round(width * REFERENCE_SIDE / side)


def make_generator(seed: int, name: str) -> torch.Generator:
    """Return a random generator, which is different for each seed and corruption."""
    return torch.Generator().manual_seed(seeds.derive_seed(seed, f"corruption {name}"))


def interpolate_table(
    table: Sequence[Sequence[float]], severity: Tensor
) -> tuple[Tensor, ...]:
    """Interpolate a table linearly at a severity () in [1, 5].

    The table has a row for each integer severity.

    Returns:
        The value () of each column; differentiable in the severity.
    """
    rows = torch.tensor(table, dtype=torch.float32, device=severity.device)
    return interpolate_severity(severity, lambda integer: rows[integer - 1]).unbind()


def interpolate_severity(
    severity: Tensor, make_at_severity: Callable[[int], Tensor]
) -> Tensor:
    """Interpolate linearly between the results for the two nearest integer severities.

    Args:
        severity: () in [1, 5]; the result is differentiable in it, and on its device.
        make_at_severity: returns a tensor for an integer severity.
    """
    # The severity 5 is 4 plus a fraction of 1, since there is none above 5.
    below = min(int(severity.detach()), MAX_SEVERITY - 1)
    fraction = severity - below
    # At an integer severity the upper result has no weight; computing it takes time.
    if float(fraction.detach()) == 0.0 and not fraction.requires_grad:
        return make_at_severity(below).to(severity.device)
    lower = make_at_severity(below).to(severity.device)
    upper = make_at_severity(below + 1).to(severity.device)
    return lower + fraction * (upper - lower)


def blur_gaussian(image: Tensor, sigma: Tensor) -> Tensor:
    """Blur an image (H, W, C) with a Gaussian.

    Beyond the image, the pixels of its edges are repeated.

    Args:
        image: (H, W, C).
        sigma: () standard deviation in pixels; the result is differentiable in it.
    """
    # cut off at four standard deviations
    reach = max(1, math.ceil(4.0 * float(sigma.detach())))
    offsets = torch.arange(-reach, reach + 1, dtype=torch.float32, device=image.device)
    weights = torch.exp(-0.5 * (offsets / sigma) ** 2)
    weights = weights / weights.sum()
    channels = image.shape[2]
    padded = F.pad(images.to_planes(image), (reach,) * 4, mode="replicate")
    # A Gaussian is separable: first along columns, then along rows, each channel by
    # itself.
    vertical = weights.view(1, 1, -1, 1).expand(channels, 1, -1, 1)
    horizontal = weights.view(1, 1, 1, -1).expand(channels, 1, 1, -1)
    blurred_down = F.conv2d(padded, vertical, groups=channels)
    blurred = F.conv2d(blurred_down, horizontal, groups=channels)
    return images.to_image(blurred)


def blur_along_line(
    image: Tensor, radius: Tensor, sigma: Tensor, angle: float, step: float
) -> Tensor:
    """Blur an image along a line, as motion does.

    A pixel becomes the weighted mean of itself and the pixels on one side of it. Weights
    are a Gaussian of the distance, and 0 from the distance 2 radius + 1. Distances are
    rounded to whole pixels, but weights are continuous, so that the result is
    differentiable in radius and sigma.

    Args:
        image: (H, W, C).
        radius: () the kernel has 2 radius + 1 reference pixels, as many as a kernel that
            reaches as far to both sides.
        sigma: () standard deviation, reference pixels.
        angle: angle of the line, radians; 0 is to the right, and pi / 2 down.
        step: pixels of this image for a reference pixel.
    """
    count = math.ceil((2.0 * float(radius.detach()) + 1.0) * step)
    # (count,) distance of each weight from the pixel, in reference pixels
    distance = torch.arange(count, device=image.device) / step
    weights = _compute_line_weights(distance, radius, sigma)
    # enough on all four sides for lines in any direction
    padded = F.pad(images.to_planes(image), (count,) * 4, mode="replicate")
    total = torch.zeros_like(image)
    height, width = image.shape[:2]
    for index, weight in enumerate(weights):
        # the image as it is `index` pixels further along the line
        top = count + round(index * math.sin(angle))
        left = count + round(index * math.cos(angle))
        shifted = padded[:, :, top : top + height, left : left + width]
        total = total + weight * images.to_image(shifted)
    return total


def _compute_line_weights(distance: Tensor, radius: Tensor, sigma: Tensor) -> Tensor:
    """Return the weights (n,) of pixels at some distances (n,), which add up to 1.

    All lengths are in reference pixels, see `blur_along_line`.
    """
    kernel_length = 2.0 * radius + 1.0
    # falls from 1 to 0 over the last pixel: differentiable in the radius
    cut_off = (kernel_length - distance).clamp(0.0, 1.0)
    weights = torch.exp(-0.5 * (distance / sigma) ** 2) * cut_off
    return weights / weights.sum()


GAUSSIAN = ((0.08,), (0.12,), (0.18,), (0.26,), (0.38,))  # standard deviation, sRGB
SHOT = ((60.0,), (25.0,), (12.0,), (5.0,), (3.0,))  # photons in a white pixel
# fraction of the values that are replaced
IMPULSE = ((0.03,), (0.06,), (0.09,), (0.17,), (0.27,))
# standard deviation relative to the value
SPECKLE = ((0.15,), (0.2,), (0.35,), (0.45,), (0.6,))
_DARK = 1e-3  # keeps the slope of a square root finite in black


def _draw_noise(image: Tensor, seed: int, name: str, *, normal: bool = True) -> Tensor:
    """Return noise (H, W, 3) of an image's shape, different for each name.

    It is standard normal, or uniform in [0, 1).
    """
    return images.draw_noise(
        image.shape[0], image.shape[1], seed, f"corruption {name}", normal=normal
    ).to(image.device)


def gaussian_noise(image: Tensor, severity: Tensor, seed: int) -> Tensor:
    """Add normal noise, as of a sensor in the dark."""
    (sigma,) = interpolate_table(GAUSSIAN, severity)
    return image + sigma * _draw_noise(image, seed, "gaussian noise")


def speckle_noise(image: Tensor, severity: Tensor, seed: int) -> Tensor:
    """Add normal noise in proportion to the value."""
    (sigma,) = interpolate_table(SPECKLE, severity)
    return image + image * sigma * _draw_noise(image, seed, "speckle noise")


def shot_noise(image: Tensor, severity: Tensor, seed: int) -> Tensor:
    """Replace the image by photon counts: Poisson numbers with the image as their mean.

    Random counts have no derivative. So the noise is expressed as z standard deviations,
    where z is a constant for the derivative. The derivative is then that of the mean
    and of the standard deviation.

    Args:
        image: (H, W, 3) in [0, 1].
        severity: () in [1, 5]; larger ones have fewer photons.
        seed: chooses the noise.
    """
    (photons,) = interpolate_table(SHOT, severity)  # in a white pixel
    # (H, W, 3), uniform; `sample_poisson` returns these quantiles of the distributions
    quantile = _draw_noise(image, seed, "shot noise", normal=False)
    with torch.no_grad():
        noisy = sample_poisson(image * photons, quantile) / photons
        z = (noisy - image) / torch.sqrt(image / photons + _DARK)
    # the same value as `noisy`, with a derivative
    return image + z * torch.sqrt(image / photons + _DARK)


def sample_poisson(mean: Tensor, quantile: Tensor) -> Tensor:
    """Return Poisson counts by inverting the distribution function; no derivative.

    A count is the number of candidates 0, 1, 2, ... whose cumulative probability is
    below the quantile.

    Args:
        mean: mean of each count, 0 to about 80.
        quantile: quantile of each count in [0, 1), of the same shape.
    """
    probability = torch.exp(-mean.double())
    total = probability.clone()
    count = torch.zeros_like(probability)
    # 400 is far beyond any count with a mean of 80
    for candidate in range(1, 400):
        is_above = quantile > total
        if not bool(is_above.any()):
            break
        count += is_above
        # P(k) = P(k - 1) * mean / k, the Poisson probability of the next count
        probability *= mean / candidate
        total += probability
    return count.to(mean.dtype)


def impulse_noise(image: Tensor, severity: Tensor, seed: int) -> Tensor:
    """Replace a fraction of the values by 0 or 1 ("salt and pepper").

    A single value jumps from the image's to 0 or 1, so that it has no derivative in the
    fraction. The derivative of its expected value is used, which is linear in the
    fraction.

    Args:
        image: (H, W, 3) in [0, 1].
        severity: () in [1, 5]; larger ones replace more values.
        seed: chooses the values.
    """
    (lost_fraction,) = interpolate_table(IMPULSE, severity)
    uniform = _draw_noise(image, seed, "impulse noise", normal=False)
    extreme = (_draw_noise(image, seed, "impulse value", normal=False) < 0.5).float()
    noisy = torch.where(uniform < lost_fraction.detach(), extreme, image)
    slope = extreme - image.detach()
    # the added term is 0, but has the derivative
    return noisy + (lost_fraction - lost_fraction.detach()) * slope


# standard deviation, reference pixels
GAUSSIAN_BLUR = ((1.0,), (2.0,), (3.0,), (4.0,), (6.0,))
# radius of the disc, reference pixels
DEFOCUS = ((3.0,), (4.0,), (6.0,), (8.0,), (10.0,))
GLASS = ((0.7, 1, 2), (0.9, 2, 1), (1.0, 2, 3), (1.1, 3, 2), (1.5, 4, 2))
"""Standard deviation of the blur and largest distance of a neighbor, reference pixels;
and number of passes.
"""
MOTION = ((10.0, 3.0), (15.0, 5.0), (15.0, 8.0), (15.0, 12.0), (20.0, 15.0))
"""Radius and standard deviation, reference pixels."""
ZOOM = ((1.11,), (1.15,), (1.2,), (1.24,), (1.3,))  # largest magnification
# number of magnified images that are averaged; the published code takes 11 to 16
ZOOM_STEPS = 16
ELASTIC = (
    (488.0, 170.8, 24.4),
    (488.0, 19.52, 48.8),
    (12.2, 2.44, 4.88),
    (17.08, 2.44, 4.88),
    (29.28, 2.44, 4.88),
)
"""Height and width of the wrinkles, and largest shift of a corner of the shear; reference
pixels.
"""


def gaussian_blur(image: Tensor, severity: Tensor, seed: int) -> Tensor:
    """Blur with a Gaussian."""
    (sigma,) = interpolate_table(GAUSSIAN_BLUR, severity)
    return blur_gaussian(image, sigma * compute_pixel_scale(image))


def defocus_blur(image: Tensor, severity: Tensor, seed: int) -> Tensor:
    """Blur with a disc, which is how a lens shows a point that is out of focus.

    Args:
        image: (H, W, 3).
        severity: () in [1, 5]; larger ones have larger discs.
        seed: has no effect.
    """
    (radius,) = interpolate_table(DEFOCUS, severity)
    radius = radius * compute_pixel_scale(image)
    # half the width of the kernel, with the soft edge
    reach = math.ceil(float(radius.detach()) + 0.5)
    offsets = torch.arange(-reach, reach + 1, dtype=torch.float32, device=image.device)
    distance = torch.sqrt(offsets[:, None] ** 2 + offsets[None, :] ** 2)
    # 1 inside and 0 outside, soft over one pixel: differentiable in the radius
    disc = (radius + 0.5 - distance).clamp(0.0, 1.0)
    return _convolve(image, disc / disc.sum(), reach)


def _convolve(image: Tensor, kernel: Tensor, reach: int) -> Tensor:
    """Return an image (H, W, C) convolved with a square kernel.

    Beyond the image, the pixels of its edges are repeated. The convolution is computed
    by Fourier transforms, which are faster for large kernels.

    Args:
        image: (H, W, C).
        kernel: (2 reach + 1, 2 reach + 1).
        reach: pixels from the kernel's center to its edge.
    """
    height, width = image.shape[:2]
    padded = F.pad(images.to_planes(image), (reach,) * 4, mode="replicate")
    # The full convolution is larger than the padded image by `reach` on each side. A
    # transform of that size does not wrap around. The padded image is itself larger than
    # the image by `reach` on each side, so that the result begins at 2 * reach.
    size = (padded.shape[2] + 2 * reach, padded.shape[3] + 2 * reach)
    product = torch.fft.rfft2(padded, s=size) * torch.fft.rfft2(kernel, s=size)
    convolved = torch.fft.irfft2(product, s=size)
    first = 2 * reach
    return images.to_image(
        convolved[:, :, first : first + height, first : first + width]
    )


def motion_blur(image: Tensor, severity: Tensor, seed: int) -> Tensor:
    """Blur along a line within 45 degrees of the horizontal, like a moving camera."""
    radius, sigma = interpolate_table(MOTION, severity)
    turn = float(torch.rand((), generator=make_generator(seed, "motion blur")))
    return blur_along_line(
        image,
        radius,
        sigma,
        math.radians(90.0 * turn - 45.0),
        compute_pixel_scale(image),
    )


def zoom_blur(image: Tensor, severity: Tensor, seed: int) -> Tensor:
    """Average the image with magnified ones, like a camera that moves forwards.

    Args:
        image: (H, W, 3).
        severity: () in [1, 5]; larger ones magnify more.
        seed: has no effect.
    """
    (largest,) = interpolate_table(ZOOM, severity)
    steps = torch.linspace(0.0, 1.0, ZOOM_STEPS, device=severity.device)
    zooms = 1.0 + (largest - 1.0) * steps
    theta = _make_zoom_matrices(zooms).to(image.device)
    height, width = image.shape[:2]
    grid = F.affine_grid(theta, [ZOOM_STEPS, 3, height, width], align_corners=False)
    copies = images.to_planes(image).expand(ZOOM_STEPS, -1, -1, -1)
    zoomed = F.grid_sample(copies, grid, padding_mode="border", align_corners=False)
    # The image counts twice, as in the published code: the first zoom is 1.
    return (image + zoomed.sum(dim=0).permute(1, 2, 0)) / (ZOOM_STEPS + 1)


def _make_zoom_matrices(zooms: Tensor) -> Tensor:
    """Return the affine maps (n, 2, 3) by which an image is magnified n times.

    A magnified image is looked up 1 / zoom as far from its center: the maps scale x and
    y, without a shift.
    """
    scales = (1.0 / zooms)[:, None].expand(-1, 2)
    scale_matrices = torch.diag_embed(scales)
    no_shift = scale_matrices.new_zeros(len(zooms), 2, 1)
    return torch.cat([scale_matrices, no_shift], dim=2)


def glass_blur(image: Tensor, severity: Tensor, seed: int) -> Tensor:
    """Blur, show at each pixel what a neighbor shows, and blur again."""
    pixel_scale = compute_pixel_scale(image)
    # The distance of neighbors and the number of passes are used in `_make_glass_shift`.
    reference_sigma, _, _ = interpolate_table(GLASS, severity)
    sigma = reference_sigma * pixel_scale
    height, width = image.shape[:2]
    shift = interpolate_severity(
        severity,
        lambda integer: _make_glass_shift(height, width, seed, integer),
    )
    shifted = images.warp(blur_gaussian(image, sigma), shift * pixel_scale)
    return blur_gaussian(shifted, sigma)


def _compute_shifts(origin: Tensor, columns: int) -> Tensor:
    """Return how far the origin of each pixel is to the right and down, (2, N).

    Args:
        origin: (N,) index of the pixel that each pixel is taken from, row by row.
        columns: number of pixels in a row.
    """
    pixel = torch.arange(len(origin))
    right = origin % columns - pixel % columns
    down = origin // columns - pixel // columns
    return torch.stack([right, down])


@lru_cache(maxsize=8)
def _make_glass_shift(height: int, width: int, seed: int, severity: int) -> Tensor:
    """Make the shift from each pixel to the pixel that frosted glass shows there.

    One after the other, from the bottom right, each pixel takes over what a random
    neighbor shows. If the neighbor has itself taken over the content of a third pixel
    before, the pixel shows the third one. So shifts may be longer than `reach`.

    Args:
        height: height of the image.
        width: width of the image.
        seed: seed of the neighbors.
        severity: 1 to 5.

    Returns:
        (H, W, 2) to the right and down, in pixels of the reference image.
    """
    rows, columns = compute_reference_size(height, width)
    origins = _shuffle_pixels(rows, columns, seed, severity)
    shift = _compute_shifts(torch.tensor(origins), columns)
    shift = shift.view(1, 2, rows, columns).float()
    # Shifts are repeated, not interpolated, so that pixels stay scattered.
    return images.to_image(F.interpolate(shift, (height, width), mode="nearest-exact"))


def _shuffle_pixels(rows: int, columns: int, seed: int, severity: int) -> list[int]:
    """Return the index of the pixel that frosted glass shows at each pixel.

    Args:
        rows: height of the reference image.
        columns: its width; pixels are numbered row by row.
        seed: seed of the neighbors.
        severity: 1 to 5.
    """
    # The first number is the standard deviation of the blur, which `glass_blur` uses.
    reach = int(GLASS[severity - 1][1])
    n_passes = int(GLASS[severity - 1][2])
    source = make_generator(seed, "glass blur")
    # index of the pixel whose content each pixel has, changed in each pass
    origins = list(range(rows * columns))
    for _ in range(n_passes):
        # from -reach to reach - 1 down and to the right, as in the published code
        jumps = torch.randint(-reach, reach, (rows, columns, 2), generator=source)
        # as steps between indices of the flattened image
        to_neighbor = (jumps[..., 0] * columns + jumps[..., 1]).flatten().tolist()
        _take_over_origins(origins, to_neighbor, rows, columns, reach)
    return origins


def _take_over_origins(
    origins: list[int], to_neighbor: list[int], rows: int, columns: int, reach: int
) -> None:
    """Let each pixel take over the origin of its neighbor, from the bottom right.

    Pixels near the edges keep their origins, so that all neighbors are inside of the
    image. As in the published code, these are the first `reach` + 1 and the last
    `reach` - 1 rows and columns.

    Args:
        origins: index of the origin of each pixel; it is changed in place.
        to_neighbor: step from the index of each pixel to that of its neighbor.
        rows: rows of the image.
        columns: columns of the image.
        reach: largest distance of a neighbor, pixels.
    """
    first = reach + 1  # first row, and first column, that changes
    for row in reversed(range(first, rows - reach + 1)):
        for column in reversed(range(first, columns - reach + 1)):
            pixel = row * columns + column
            origins[pixel] = origins[pixel + to_neighbor[pixel]]


def elastic(image: Tensor, severity: Tensor, seed: int) -> Tensor:
    """Shear an image and wrinkle it; below severity 1 the shifts are scaled down."""
    height, width = image.shape[:2]
    if float(severity.detach()) < 1.0:
        shift = severity * _make_elastic_shift(height, width, seed, 1).to(
            severity.device
        )
    else:
        shift = interpolate_severity(
            severity,
            lambda integer: _make_elastic_shift(height, width, seed, integer),
        )
    return images.warp(image, compute_pixel_scale(image) * shift)


@lru_cache(maxsize=8)
def _make_elastic_shift(height: int, width: int, seed: int, severity: int) -> Tensor:
    """Make the shift from each pixel to its source: wrinkles and a shear.

    Args:
        height: height of the image.
        width: width of the image.
        seed: seed of the wrinkles and the shear.
        severity: 1 to 5.

    Returns:
        (H, W, 2) to the right and down, in pixels of the reference image.
    """
    rows, columns = compute_reference_size(height, width)
    wrinkle_height, wrinkle_width, corner_shift = ELASTIC[severity - 1]
    source = make_generator(seed, "elastic")
    # (3, 2) random shifts of three points, which determine an affine map
    corners = (torch.rand(3, 2, generator=source) * 2.0 - 1.0) * corner_shift
    noise = torch.rand(rows, columns, 2, generator=source) * 2.0 - 1.0
    widths = (wrinkle_width, wrinkle_width, 0.0)
    waves = ndimage.gaussian_filter(noise.numpy(), widths, mode="reflect", truncate=3.0)
    shear = _make_shear(rows, columns, corners)
    shift = torch.from_numpy(waves) * wrinkle_height + shear
    # `elastic` converts reference pixels to pixels of the image.
    return images.resized(shift, height, width)


def _make_shear(rows: int, columns: int, corners: Tensor) -> Tensor:
    """Make the affine shift (rows, columns, 2) that moves three points as requested.

    The points are corners of a square around the image's center, whose side is two
    thirds of the reference side.

    Args:
        rows: rows of the image.
        columns: columns of the image.
        corners: (3, 2) shifts of the lower right, upper right and upper left corner.
    """
    # An affine map is its value at the center, and its change per row and per column.
    lower_right, upper_right, upper_left = corners.unbind()
    side = 2 * (REFERENCE_SIDE // 3)
    by_row = (lower_right - upper_right) / side
    # From the upper left to the lower right corner, it changes by both.
    by_column = (lower_right - upper_left) / side - by_row
    row = torch.arange(rows)[:, None, None] - (rows - 1) / 2.0
    column = torch.arange(columns)[None, :, None] - (columns - 1) / 2.0
    # the center is halfway between the lower right and the upper left corner
    at_center = (lower_right + upper_left) / 2.0
    return at_center + row * by_row + column * by_column


FOG = ((1.5,), (2.0,), (2.5,), (2.5,), (3.0,))  # density of the fog
# `decay` of its noise, see `make_fractal_noise`; a smaller one is rougher
FOG_DECAY = (2.0, 2.0, 1.7, 1.5, 1.4)
# weights of the image and of the frost
FROST = ((1.0, 0.4), (0.8, 0.6), (0.7, 0.7), (0.65, 0.7), (0.6, 0.75))
# number of pixels for each feather of ice, in an image of twice the reference size
FEATHER_AREA = 260
ICE_COLOR = (0.86, 0.95, 1.0)  # color of the ice, sRGB
SNOW = (
    (0.1, 0.3, 3.0, 0.5, 10.0, 4.0),
    (0.2, 0.3, 2.0, 0.5, 12.0, 4.0),
    (0.55, 0.3, 4.0, 0.9, 12.0, 8.0),
    (0.55, 0.3, 4.5, 0.85, 12.0, 8.0),
    (0.55, 0.3, 2.5, 0.85, 12.0, 12.0),
)
"""Mean and standard deviation of the noise, size of a flake, noise above which there is a
flake, and radius and standard deviation of its streak.
"""
# weight of the image; the rest is a paler image
SNOW_IMAGE_WEIGHT = ((0.8,), (0.7,), (0.7,), (0.65,), (0.55,))
LUMA_WEIGHTS = (0.299, 0.587, 0.114)  # weights of red, green and blue in a gray


def fog(image: Tensor, severity: Tensor, seed: int) -> Tensor:
    """Add drifts of white, and scale the image so that its maximum stays the same."""
    height, width = image.shape[:2]
    (density,) = interpolate_table(FOG, severity)
    # The drifts of two integer severities are blended. Drifts for a `FOG_DECAY` in between
    # would have no derivative by the severity.
    drift = interpolate_severity(
        severity,
        lambda integer: _make_drift(height, width, seed, FOG_DECAY[integer - 1]),
    )
    foggy = image + density * drift.to(image.device)
    brightest = image.max()
    # the maximum of `foggy` if the drift is 1 where the image is brightest
    new_brightest = brightest + density
    return foggy * brightest / new_brightest


@lru_cache(maxsize=8)
def _make_drift(height: int, width: int, seed: int, decay: float) -> Tensor:
    """Make fog (H, W, 1) in [0, 1].

    Args:
        height, width: size of the image, pixels.
        seed: chooses the fog.
        decay: how fast the noise loses height on finer grids; the larger it is, the
            smoother is the fog.
    """
    rows, columns = compute_reference_size(height, width)
    noise = make_fractal_noise(max(rows, columns), decay, make_generator(seed, "fog"))
    return images.resized(noise[:rows, :columns, None], height, width)


def make_fractal_noise(side: int, decay: float, source: torch.Generator) -> Tensor:
    """Make fractal noise in [0, 1] by midpoint displacement on a torus.

    Each step doubles the grid: a new point is the mean of its four neighbors plus noise
    (Fournier, Fussell, Carpenter 1982, Computer rendering of stochastic models).

    Args:
        side: smallest side of the result; it is rounded up to a power of two.
        decay: the height of the noise is divided by the square of this number after each
            step. With more than 1, finer details are lower.
        source: generator of random numbers; it advances.
    """
    grid = torch.zeros(1, 1)
    height = 1.0
    while grid.shape[0] < side:
        size = grid.shape[0]
        noise = (torch.rand(3, size, size, generator=source) * 2.0 - 1.0) * height
        grid = _refine_grid(grid, noise)
        height = height / decay**2
    grid = grid - grid.min()
    return grid / grid.max()


def _refine_grid(grid: Tensor, noise: Tensor) -> Tensor:
    """Return a grid (n, n) on a torus with twice the points, by midpoint displacement.

    Args:
        grid: (n, n) heights.
        noise: (3, n, n) noise of the new points: those in the centers of cells, and
            those on their horizontal and vertical edges.
    """
    size = grid.shape[0]
    # neighbors of each point, which wrap around the edges of the torus
    right = grid.roll(-1, dims=1)
    below = grid.roll(-1, dims=0)
    lower_right = right.roll(-1, dims=0)
    # diamond step: the centers of the cells, from their four corners
    center = (grid + right + below + lower_right) / 4.0 + noise[0]
    center_above = center.roll(1, dims=0)
    center_left = center.roll(1, dims=1)
    finer = torch.empty(2 * size, 2 * size)
    finer[::2, ::2] = grid
    finer[1::2, 1::2] = center
    # square step: the centers of the edges, from two old points and two centers
    finer[::2, 1::2] = (grid + right + center + center_above) / 4.0 + noise[1]
    finer[1::2, ::2] = (grid + below + center + center_left) / 4.0 + noise[2]
    return finer


def frost(image: Tensor, severity: Tensor, seed: int) -> Tensor:
    """Lay ice crystals over an image."""
    image_weight, ice_weight = interpolate_table(FROST, severity)
    ice = _make_ice(image.shape[0], image.shape[1], seed).to(image.device)
    return image_weight * image + ice_weight * ice


@lru_cache(maxsize=4)
def _make_ice(height: int, width: int, seed: int) -> Tensor:
    """Make ice (H, W, 3) in [0, 1]: feathers of crystals over an uneven film.

    The constants of brightness and roughness are chosen by eye.
    """
    rows, columns = compute_reference_size(height, width)
    source = make_generator(seed, "frost")
    film = make_fractal_noise(max(rows, columns), 1.4, source)[:rows, :columns, None]
    # drawn at twice the size and reduced, so that lines are smooth
    feathers = images.resized(
        _draw_feathers(2 * rows, 2 * columns, source), rows, columns
    )
    ice = 0.2 + 0.3 * film + (0.45 + 0.75 * film) * feathers
    return images.resized(
        (ice * torch.tensor(ICE_COLOR)).clamp(0.0, 1.0), height, width
    )


def _draw_feathers(height: int, width: int, source: torch.Generator) -> Tensor:
    """Draw ice needles with barbs at 60 degrees, as ice grows on glass.

    Returns:
        (height, width, 1) in [0, 1].
    """
    canvas = Image.new("L", (width, height))
    pen = ImageDraw.Draw(canvas)
    n_needles = height * width // FEATHER_AREA
    # shine, x, y, turn and size of each needle, all in [0, 1]
    needles = torch.rand(n_needles, 5, generator=source).tolist()
    # The brightest needles are drawn last, over the others.
    for shine, x, y, turn, size in sorted(needles):
        start = complex(x * width, y * height)
        _draw_feather(pen, start, turn, size, shine)
    return torch.from_numpy(np.asarray(canvas, dtype=np.float32) / 255.0)[..., None]


def _draw_feather(
    pen: ImageDraw.ImageDraw, start: complex, turn: float, size: float, shine: float
) -> None:
    """Draw one ice needle with its barbs.

    Args:
        pen: pen to draw with.
        start: start of the needle; x is the real and y the imaginary part, in pixels.
        turn: direction of the needle in full turns.
        size: size in [0, 1].
        shine: brightness in [0, 1].
    """
    # Points and directions are complex numbers. Numbers are chosen by eye.
    direction = cmath.rect(1.0, 2.0 * math.pi * turn)
    # in pixels; the cube of a uniform number makes most needles short
    length = 12.0 + 110.0 * size**3
    _draw_line(pen, start, start + length * direction, shine)
    for step in range(4, int(length), 4):
        # Barbs get shorter towards the tip. They vary along the needle and, by the turn,
        # from needle to needle.
        unevenness = 0.5 + 0.5 * math.sin(step + 50.0 * turn)
        barb = (0.2 + 0.35 * unevenness) * (length - step) * direction
        root = start + step * direction
        for angle in (math.pi / 3.0, -math.pi / 3.0):
            _draw_line(pen, root, root + barb * cmath.rect(1.0, angle), 0.7 * shine)


def _draw_line(
    pen: ImageDraw.ImageDraw, begin: complex, end: complex, shine: float
) -> None:
    """Draw a line between points in pixels, with a brightness in [0, 1]."""
    pen.line((begin.real, begin.imag, end.real, end.imag), fill=int(255.0 * shine))


def snow(image: Tensor, severity: Tensor, seed: int) -> Tensor:
    """Make an image paler, and add streaks of falling snow."""
    (image_weight,) = interpolate_table(SNOW_IMAGE_WEIGHT, severity)
    layer = interpolate_severity(
        severity,
        lambda integer: _make_snowfall(image.shape[0], image.shape[1], seed, integer),
    ).to(image.device)
    grey = (image * image.new_tensor(LUMA_WEIGHTS)).sum(dim=-1, keepdim=True)
    # paler, but never darker
    pale = torch.maximum(image, 1.5 * grey + 0.5)
    mixed = image_weight * image + (1.0 - image_weight) * pale
    # once more turned by 180 degrees, for twice as many flakes
    return mixed + layer + layer.rot90(2)


@lru_cache(maxsize=8)
def _make_snowfall(height: int, width: int, seed: int, severity: int) -> Tensor:
    """Make falling snow (H, W, 1) in [0, 1] at an integer severity.

    Noise on a coarse grid is set to 0 below a threshold, which leaves flakes. They are
    blurred along the direction in which they fall.
    """
    rows, columns = compute_reference_size(height, width)
    # of the noise: mean, spread, flake size and threshold; of the blur: radius and sigma
    mean, spread, flake_size, threshold, radius, sigma = SNOW[severity - 1]
    source = make_generator(seed, "snow")
    # Each pixel is averaged with those in a direction from -135 to -45 degrees, where -90
    # is straight up. So flakes are smeared downwards, up to 45 degrees to either side.
    angle = math.radians(-135.0 + 90.0 * float(torch.rand((), generator=source)))
    grid_size = (math.ceil(rows / flake_size), math.ceil(columns / flake_size), 1)
    noise = mean + spread * torch.randn(grid_size, generator=source)
    flakes = images.resized(noise, rows, columns)
    flakes = torch.where(flakes < threshold, torch.zeros_like(flakes), flakes)
    streaks = blur_along_line(
        flakes, torch.tensor(radius), torch.tensor(sigma), angle, step=1.0
    )
    return images.resized(streaks.clamp(0.0, 1.0), height, width)
