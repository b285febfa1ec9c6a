"""Pictures for the importers: 8- and 16-bit image files as arrays, and exact area averaging."""

from __future__ import annotations

import warnings

import numpy as np
import numpy.typing as npt
from PIL import Image
from scipy import sparse

from advsearch.scene.color import linear_to_srgb, srgb_to_linear

Floats = npt.NDArray[np.float32]

TEXTURE_LIMIT = 1024
"""Longest side of an imported texture, in texels; larger ones are averaged down."""


def display_image(image: Image.Image, limit: int | None = TEXTURE_LIMIT) -> Floats:
    """Decode a picture; alpha is dropped.

    Args:
        image: an opened picture of any mode.
        limit: longest side of the result; larger pictures are averaged down in linear light. None: no limit.

    Returns:
        (H, W, 3) float32 display-referred values in [0, 1], row 0 on top.

    Raises:
        OSError, ValueError, SyntaxError, Image.DecompressionBombError: the file's pixels are truncated or damaged.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of large pictures and odd metadata
        image.load()
        if image.mode == "F" or image.mode.startswith("I"):  # grey in floats or 16 bits
            grey = np.nan_to_num(np.asarray(image, np.float32)) / np.float32(1.0 if image.mode == "F" else 65535.0)
            steps = np.round(np.clip(grey, 0.0, 1.0) * 255.0).astype(np.uint8)[:, :, None].repeat(3, axis=2)
        else:
            steps = np.asarray(image.convert("RGBA" if "transparency" in image.info else "RGB"))[:, :, :3]
    height, width = steps.shape[:2]
    scale = 1.0 if limit is None else limit / max(height, width)
    display: Floats = np.arange(256, dtype=np.float32) / np.float32(255.0)
    if scale >= 1.0:
        return np.asarray(display[steps])
    target = max(1, round(height * scale)), max(1, round(width * scale))
    return linear_to_srgb(area_average(srgb_to_linear(display)[steps], *target))


def area_average(image: Floats, height: int, width: int) -> Floats:
    """Resample an image to a smaller size; each new pixel is the exact mean over the area that it covers.

    Args:
        image: (H, W, C) float32, any values.
        height: rows of the result, at most H.
        width: columns of the result, at most W.

    Returns:
        (height, width, C) float32 with the same mean as `image`.
    """
    rows, columns, channels = image.shape
    down = _overlaps(rows, height) @ image.reshape(rows, columns * channels)
    across = _overlaps(columns, width)
    sideways = down.reshape(height, columns, channels).transpose(1, 0, 2).reshape(columns, height * channels)
    result = (across @ sideways).reshape(width, height, channels).transpose(1, 0, 2)
    return np.ascontiguousarray(result, dtype=np.float32)


def _overlaps(source: int, target: int) -> sparse.csr_array:
    """Return the (target, source) matrix of the share of each source cell in each target cell; rows sum to 1."""
    cells = np.arange(target + 1) * (source / target)
    edges = np.unique(np.concatenate([cells, np.arange(source + 1, dtype=np.float64)]))
    middles, lengths = (edges[1:] + edges[:-1]) / 2, np.diff(edges)
    row = np.minimum((middles * (target / source)).astype(np.int64), target - 1)
    column = np.minimum(middles.astype(np.int64), source - 1)
    weights = sparse.coo_array((lengths, (row, column)), shape=(target, source)).tocsr()
    share = sparse.diags_array(1.0 / np.asarray(weights.sum(axis=1)).ravel())
    return sparse.csr_array(share @ weights)
