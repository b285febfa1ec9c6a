"""A photograph, or a part of one, that a scene is rendered into."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from advsearch.scene.assets import Float32Array
from advsearch.scene.color import srgb_to_linear
from advsearch.scene.image_quality import make_noise, measure_noise
from advsearch.scene.importing.pictures import average_area

# points at which depth is looked up in a pixel, along each side
MIN_DEPTH_POINTS = 2
MAX_DEPTH_POINTS = 4


@dataclass(frozen=True, eq=False)
class BackdropPhotograph:
    """A photograph, or a part of one, that a scene is rendered into."""

    spec: str  # how it was asked for: a path, and perhaps the part
    levels: npt.NDArray[np.uint8]  # (H, W, 3) sRGB of the full photograph
    digest: str  # SHA-256 of the levels, in hexadecimal
    crop: tuple[int, int, int, int]  # left, top, width and height in pixels
    # (H, W) levels: 255 where the photograph shows what is before the object; None if
    # nothing is
    front: npt.NDArray[np.uint8] | None = None
    # (H, W) metres along the camera's axis, infinite where unknown; None if no depth is
    depth: Float32Array | None = None
    front_spec: str = ""  # how one of them was asked for

    @property
    def full_size(self) -> tuple[int, int]:
        """Height and width of the full photograph, pixels."""
        return self.levels.shape[0], self.levels.shape[1]

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the part that is used, pixels."""
        return self.crop[3], self.crop[2]

    @property
    def is_cropped(self) -> bool:
        """Whether only a part of the photograph is used."""
        return self.size != self.full_size

    def resample(self, resolution: tuple[int, int]) -> Tensor:
        """Return the part in display-linear values at (height, width) pixels.

        Each pixel is the mean over the area that it covers, in linear light. If the
        photograph has fewer pixels than that, it is interpolated.

        Returns:
            (H, W, 3) float32 in [0, 1].
        """
        value_of_level = decode_all_levels()  # for each of 256 levels
        linear_photograph = value_of_level[self.levels]
        return self._resample_part(linear_photograph, resolution)

    def resample_front(self, resolution: tuple[int, int]) -> Tensor | None:
        """Return what is before the object, (H, W, 1) float32 in [0, 1], or None."""
        if self.front is None:
            return None
        fractions = self.front[..., None].astype(np.float32) / np.float32(255.0)
        return self._resample_part(fractions, resolution)

    def resample_depth(self, resolution: tuple[int, int]) -> Tensor | None:
        """Return the depth (H S, W S) float32 in metres at S x S points of each pixel.

        So edges of the depth are followed inside a pixel. S is how many pixels of the
        depth there are along a side of a pixel of the image, but at least
        `MIN_DEPTH_POINTS` and at most `MAX_DEPTH_POINTS`. The result is None if the
        photograph has no depth.

        Args:
            resolution: height and width of the image in pixels.
        """
        if self.depth is None:
            return None
        # The depth has the pixels of the full photograph.
        left, top, width, height = self.crop
        part = self.depth[top : top + height, left : left + width]
        needed = math.ceil(max(height / resolution[0], width / resolution[1]))
        n_points = min(max(needed, MIN_DEPTH_POINTS), MAX_DEPTH_POINTS)
        # the row, or column, of the depth in which each point lies
        positions = [
            ((np.arange(n_points * n_pixels) + 0.5) * side / (n_points * n_pixels))
            for n_pixels, side in zip(resolution, part.shape, strict=True)
        ]
        rows, columns = (position.astype(np.intp) for position in positions)
        return torch.from_numpy(part[np.ix_(rows, columns)])

    def make_noise(self, resolution: tuple[int, int], sigma: float | None) -> Tensor:
        """Return noise (H, W, 3) float32, display-referred, like the photograph's.

        Without `sigma`, the noise of the photograph is measured. Noise of that strength
        is made in the pixels of the photograph and resampled as that is, so that it is
        as coarse. With `sigma`, it is independent in each pixel of the result. The same
        photograph gives the same noise.

        Args:
            resolution: height and width in pixels.
            sigma: standard deviation in levels at that resolution; None measures it.
        """
        left, top, width, height = self.crop
        part = self.levels[top : top + height, left : left + width]
        seed = int(self.digest[:8], 16)  # of the photograph's content
        if sigma is not None:
            return make_noise(np.full(3, sigma / 255.0), resolution, seed)
        # in the photograph's own pixels
        noise = make_noise(measure_noise(part) / 255.0, self.size, seed)
        return _resample_image(noise.numpy(), resolution)

    def _resample_part(
        self, image: Float32Array, resolution: tuple[int, int]
    ) -> Tensor:
        """Return the used part of an image (H, W, C) at (height, width) pixels."""
        left, top, width, height = self.crop
        part = image[top : top + height, left : left + width]
        return _resample_image(part, resolution)


def _resample_image(image: Float32Array, resolution: tuple[int, int]) -> Tensor:
    """Resample an image (H, W, C) to (height, width) pixels.

    Each axis is treated by itself: one with too many pixels is averaged down, and one
    with too few is interpolated.

    Args:
        image: (H, W, C).
        resolution: height and width of the result in pixels.
    """
    height, width = image.shape[:2]
    averaged = average_area(
        image, min(height, resolution[0]), min(width, resolution[1])
    )
    resampled = torch.from_numpy(averaged)
    if tuple(averaged.shape[:2]) == resolution:
        return resampled
    return _enlarge_image(resampled, resolution)


def _enlarge_image(image: Tensor, resolution: tuple[int, int]) -> Tensor:
    """Interpolate an image (H, W, C) bilinearly to (height, width) pixels."""
    enlarged = torch.nn.functional.interpolate(
        image.permute(2, 0, 1)[None],
        size=resolution,
        mode="bilinear",
        align_corners=False,
    )
    return enlarged[0].permute(1, 2, 0).contiguous()


def decode_all_levels() -> Float32Array:
    """Return the display-linear values (256,) of all levels of 8-bit sRGB."""
    return srgb_to_linear(np.arange(256, dtype=np.float32) / np.float32(255.0))
