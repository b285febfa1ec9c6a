"""The `sensor` control: effects of a camera's sensor and its processing on the image.

    vignetting  light / (1 + a r^2)^2, where r is the distance from the center of the
                image, 1 in its corners: cos^4 of the angle
    aberration  the red and the blue image are a little larger or smaller than the green
                one (lateral)
    noise       light + sqrt(shot^2 light + read^2) n, with n standard normal, one draw
                for each pixel and channel
    mosaic      of each pixel one channel is stored, in the pattern RGGB; the others are
                interpolated between neighbors
    balance     red and blue times 2^red, 2^blue
    file        the tone curve, then JPEG

Noise: Foi, Trimeche, Katkovnik and Egiazarian 2008, Practical Poissonian-Gaussian noise
modeling and fitting for single-image raw-data, section II. Pattern: Bayer 1976, US
patent 3971065. Aberration: Kang 2007, Automatic removal of chromatic aberration from a
single image, section 2. Vignetting: Kang and Weiss 2000, Can we calibrate a camera
using an image of a flat, textureless Lambertian surface, section 2.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor

from advsearch.extend import Choice, Control, Parameter, Values, color, images

_DARK = 1e-6  # keeps the derivative of a square root finite in black


_image = partial(Parameter.number, ("image",))


class SensorControl(Control):
    """Effects of a camera: noise, mosaic, white balance, chromatic aberration,
    vignetting and JPEG compression.
    """

    kind = "sensor"
    parameters = (
        _image(
            "vignetting",
            "1",
            0.0,
            0.95,
            0.0,
            "Fraction of the light that is missing in the corners.",
        ),
        _image(
            "aberration",
            "1",
            -0.02,
            0.02,
            0.0,
            "By which fraction the red picture is larger than the green one, and the "
            "blue one smaller.",
            (-0.005, 0.005),
        ),
        _image(
            "shot",
            "1",
            0.0,
            0.5,
            0.0,
            "Standard deviation, in white, of the noise that grows with the square root "
            "of the light.",
            (0.0, 0.1),
        ),
        _image(
            "read",
            "1",
            0.0,
            0.2,
            0.0,
            "Standard deviation of the noise that does not depend on the light.",
            (0.0, 0.02),
        ),
        _image(
            "mosaic",
            "1",
            0.0,
            1.0,
            0.0,
            "Weight of the picture after a Bayer mosaic; 1 is a real camera.",
            (0.0, 1.0),
        ),
        _image(
            "red",
            "stops",
            -1.0,
            1.0,
            0.0,
            "White balance: gain of red.",
            (-0.5, 0.5),
        ),
        _image(
            "blue",
            "stops",
            -1.0,
            1.0,
            0.0,
            "White balance: gain of blue.",
            (-0.5, 0.5),
        ),
        Parameter.number(
            (),
            "compression",
            "1",
            0.0,
            95.0,
            0.0,
            "0 is no compression; above 0, JPEG quality is 100 minus this.",
            (0.0, 60.0),
        ),
    )
    choices = (
        Choice(
            "seed",
            0,
            "Seed of the noise: a whole number from 0.",
            integer_bounds=(0, 2**32 - 1),
        ),
    )

    def on_picture(self, values: Values, image: Tensor) -> Tensor:
        return apply_sensor(image, values, int(self.choice_values["seed"]))


def apply_sensor(image: Tensor, values: Mapping[str, Tensor], seed: int = 0) -> Tensor:
    """Return an image as a camera would have taken it.

    Args:
        image: (H, W, 3) display-referred sRGB in [0, 1].
        values: value () of each parameter in `SensorControl.parameters`, by name.
        seed: seed of the noise.

    Returns:
        (H, W, 3) sRGB in [0, 1]; differentiable in the image and in every value but
        `compression`. The derivative of the JPEG compression is taken as the identity.
    """
    height, width = image.shape[:2]
    vignette = compute_vignette(height, width, values["vignetting"])
    light = color.srgb_to_linear(image) * vignette.to(image.device)
    light = apply_aberration(light, values["aberration"])
    std = _compute_noise_deviation(light, values)
    light = light + std * images.draw_noise(height, width, seed, "sensor").to(light)
    # `mosaic` is the weight of the image with a mosaic of color filters.
    light = light + values["mosaic"] * (apply_mosaic(light) - light)
    balanced = _balance_white(light, values)
    display = color.linear_to_srgb(balanced.clamp(0.0, 1.0))
    return _compress_as_jpeg(display, values["compression"])


def _compress_as_jpeg(image: Tensor, compression: Tensor) -> Tensor:
    """Return an image (H, W, 3) after JPEG compression, in [0, 1].

    Args:
        image: sRGB in [0, 1].
        compression: () from 0, for no compression, to 95; it is rounded.
    """
    rounded = round(float(compression.detach()))
    if rounded == 0:
        return image
    jpeg_quality = 100 - rounded  # 5 to 99, as the compression is 1 to 95 here
    return images.compress_jpeg(image, jpeg_quality).clamp(0.0, 1.0)


def _balance_white(light: Tensor, values: Mapping[str, Tensor]) -> Tensor:
    """Return light (H, W, 3) after the gains of red and blue, relative to green."""
    # both are in stops
    gains = torch.stack(
        [2.0 ** values["red"], torch.ones_like(values["red"]), 2.0 ** values["blue"]]
    )
    return light * gains.to(light.device)


def _compute_noise_deviation(light: Tensor, values: Mapping[str, Tensor]) -> Tensor:
    """Return the standard deviation (H, W, 3) of the noise of linear light."""
    variance = values["shot"] ** 2 * light + values["read"] ** 2
    # The square root of the variance, shifted by `_DARK` so that its derivative at 0 is
    # finite. It is 0 there.
    return torch.sqrt(variance + _DARK**2) - _DARK


def compute_vignette(height: int, width: int, amount: Tensor) -> Tensor:
    """Return the fraction of the light (H, W, 1) that passes through a lens.

    Args:
        height, width: size of the image, pixels.
        amount: () fraction of the light that is lost in the corners.
    """
    # Natural vignetting, (1 + k r^2)^-2 with r = 1 in the corners, where it is
    # 1 - amount.
    down, right = (torch.arange(side) + 0.5 - side / 2 for side in (height, width))
    squared_corner = (height**2 + width**2) / 4.0
    squared_radius = (down[:, None] ** 2 + right[None, :] ** 2) / squared_corner
    # from (1 + k)^-2 = 1 - amount
    k = (1.0 - amount) ** -0.5 - 1.0
    return ((1.0 + k * squared_radius.to(amount)) ** -2)[..., None]


def apply_aberration(image: Tensor, amount: Tensor) -> Tensor:
    """Return an image (H, W, 3) with lateral chromatic aberration.

    Red is magnified about the center by 1 + amount, blue by 1 - amount.
    """
    height, width = image.shape[:2]
    down, right = torch.meshgrid(
        torch.arange(height) + 0.5 - height / 2,
        torch.arange(width) + 0.5 - width / 2,
        indexing="ij",
    )
    outwards = torch.stack([right, down], dim=-1).to(image)  # (H, W, 2) from the center
    # A channel that is larger by a factor is looked up nearer to the center.
    red_offsets = outwards * (1.0 / (1.0 + amount) - 1.0)
    blue_offsets = outwards * (1.0 / (1.0 - amount) - 1.0)
    red = images.warp(image[..., 0:1], red_offsets)
    blue = images.warp(image[..., 2:3], blue_offsets)
    return torch.cat([red, image[..., 1:2], blue], dim=-1)


def apply_mosaic(light: Tensor) -> Tensor:
    """Return an image (H, W, 3) after a Bayer mosaic (RGGB).

    Each pixel measures one channel. The two others are interpolated bilinearly from its
    neighbors.
    """
    height, width = light.shape[:2]
    is_measured = _make_mosaic_mask(height, width).to(light)
    # Bilinear weights. A sum of neighbors is divided by the weight of those that have
    # the channel.
    weights = [[1.0, 2.0, 1.0], [2.0, 4.0, 2.0], [1.0, 2.0, 1.0]]
    kernel = light.new_tensor(weights).expand(3, 1, 3, 3)
    total = F.conv2d(images.to_planes(light * is_measured), kernel, padding=1, groups=3)
    weight = F.conv2d(images.to_planes(is_measured), kernel, padding=1, groups=3)
    interpolated = images.to_image(total / weight.clamp_min(1e-6))
    return torch.where(is_measured > 0.0, light, interpolated)


def _make_mosaic_mask(height: int, width: int) -> Tensor:
    """Return 1 where a pixel measures a channel, else 0, (height, width, 3) integers."""
    rows = torch.arange(height)[:, None] % 2
    columns = torch.arange(width)[None, :] % 2
    red = (1 - rows) * (1 - columns)
    blue = rows * columns
    return torch.stack([red, 1 - red - blue, blue], dim=-1)
