"""Functions of images, (H, W, C) tensors, and of meshes as texels of an image."""

from __future__ import annotations

import io
from functools import lru_cache

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

from advsearch import seeds
from advsearch.scene.color import linear_to_srgb, srgb_to_linear, to_uint8
from advsearch.scene.color import round_to_8_bit as round_to_8_bit
from advsearch.scene.raster import Charts as Charts
from advsearch.scene.raster import MeshSurface as MeshSurface
from advsearch.scene.raster import rasterize_charts as rasterize_charts
from advsearch.scene.raster import rasterize_triangles as rasterize_triangles

# smallest side in pixels of an image that is stored for printing
MIN_PRINT_SIDE = 512


def resize_to_square(image: Tensor, side: int) -> Tensor:
    """Resize an (h, w, 3) image to (side, side, 3) with an antialiased bilinear filter.

    Values stay in [0, 1].
    """
    return resized(image, side, side).contiguous().clamp(0.0, 1.0)


def enlarge(pixels: Tensor, factor: int) -> Tensor:
    """Enlarge an image (h, w, 3) sRGB by an integer factor.

    Linear light is interpolated, as the renderer interpolates textures.
    """
    larger = F.interpolate(
        to_planes(srgb_to_linear(pixels)),
        scale_factor=factor,
        mode="bilinear",
        align_corners=False,
    )
    return linear_to_srgb(to_image(larger))


def compress_jpeg(image: Tensor, quality: int) -> Tensor:
    """Compress an image as a JPEG file with subsampled chroma, and read it again.

    The derivative is that of the identity (a straight-through estimate). Its error is up
    to about a third for changes of the image that vary over three pixels or more
    (measured at qualities of 7 to 25). It is too large for finer changes, which the
    compression reduces.

    Args:
        image: (H, W, 3) display-referred sRGB in [0, 1].
        quality: quality of libjpeg, 1 to 100.
    """
    levels = to_uint8(image.clamp(0.0, 1.0)).cpu().numpy()
    file = io.BytesIO()
    Image.fromarray(levels).save(file, "JPEG", quality=quality)
    with Image.open(file, formats=("JPEG",)) as jpeg:
        compressed = torch.from_numpy(np.asarray(jpeg, dtype=np.float32) / 255.0)
    return image + (compressed.to(image.device) - image).detach()


def to_planes(image: Tensor) -> Tensor:
    """Reshape (H, W, C) to (1, C, H, W)."""
    return image.permute(2, 0, 1)[None]


def to_image(stack: Tensor) -> Tensor:
    """Reshape (1, C, H, W) to (H, W, C)."""
    return stack[0].permute(1, 2, 0)


def warp(image: Tensor, offsets: Tensor) -> Tensor:
    """Return an image whose pixels are looked up at other positions.

    Args:
        image: (H, W, C).
        offsets: (H, W, 2) from each pixel to that position, in pixels to the right and
            down. Positions outside of the image are mirrored inwards.
    """
    height, width = image.shape[:2]
    rows, columns = torch.meshgrid(
        torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij"
    )
    centers = torch.stack([columns, rows], dim=-1).to(image.device)
    positions = centers + offsets.to(image.device)
    # grid_sample wants positions in [-1, 1]
    scale = torch.tensor([2.0 / width, 2.0 / height], device=image.device)
    grid = (positions * scale - 1.0)[None]
    warped = F.grid_sample(
        to_planes(image), grid, padding_mode="reflection", align_corners=False
    )
    return to_image(warped)


def resized(
    field: Tensor, height: int, width: int, *, antialias: bool = True
) -> Tensor:
    """Resize an (h, w, C) field to (height, width, C), bilinearly; differentiable."""
    if field.shape[:2] == (height, width):
        return field
    planes = to_planes(field)
    stack = F.interpolate(
        planes,
        (height, width),
        mode="bilinear",
        antialias=antialias,
        align_corners=False,
    )
    return to_image(stack).contiguous()


@lru_cache(maxsize=8)
def draw_noise(
    height: int, width: int, seed: int, stream_name: str, *, normal: bool = True
) -> Tensor:
    """Return noise (height, width, 3) from a named stream of random numbers; cached.

    It is standard normal, or uniform in [0, 1).
    """
    generator = torch.Generator().manual_seed(seeds.derive_seed(seed, stream_name))
    sample = torch.randn if normal else torch.rand
    return sample(height, width, 3, generator=generator)


def rotate_map(radiance: Tensor, degrees: Tensor) -> Tensor:
    """Rotate a map (H, W, 3) about the vertical, as `environment.rotation` does.

    Columns wrap around, and are interpolated linearly. The result is differentiable in
    both arguments. A rotation by a full number of columns is exact.
    """
    columns = radiance.shape[1]
    shift = torch.remainder(degrees / 360.0, 1.0) * columns
    if not shift.requires_grad and float(shift) == 0.0:
        return radiance
    full_columns = int(shift.detach().floor())
    fraction = shift - full_columns
    lower = radiance.roll(-full_columns, dims=1)
    upper = radiance.roll(-full_columns - 1, dims=1)
    return lower + fraction * (upper - lower)
