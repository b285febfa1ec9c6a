"""Images that the materials of one file name: decoded once, within limits in total."""

from __future__ import annotations

import io
import warnings
from collections import Counter
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from PIL import Image
from scipy import sparse

from advsearch.errors import FileFormatError
from advsearch.pictures import (
    FORMATS,
    MAX_PIXELS,
    check_decodable,
    check_pixels,
    open_image,
    to_8bit_levels,
)
from advsearch.scene.assets import Float32Array
from advsearch.scene.color import linear_to_srgb, srgb_to_linear
from advsearch.scene.importing.files import Notes, format_name
from advsearch.trust.named_files import ReferencedFiles, normalize_name
from advsearch.trust.stored_files import LARGEST_FILE, check_most

# Limit of the sides of an imported texture, in texels; larger ones are averaged down.
TEXTURE_LIMIT = 1024
_BAND = 1 << 22  # pixels of a large picture that are averaged at a time


def read_image(
    path: Path, limit: int | None = TEXTURE_LIMIT, *, is_raw: bool = False
) -> Float32Array:
    """Read an image file as display-referred values (H, W, 3) in [0, 1].

    Args:
        path: the file.
        limit: longest side of the result; larger images are averaged down. None: no
            limit.
        is_raw: whether it holds numbers, as a normal map does, and no colors.

    Raises:
        FileFormatError: the file is missing, no ordinary file, no image, too large or
            corrupt.
    """
    with open_image(path, LARGEST_FILE) as image:
        return load_display_image(image, limit, path, is_raw=is_raw)


def read_image_size(path: Path) -> tuple[int, int]:
    """Return the height and width of an image file in pixels, without decoding it.

    Raises FileFormatError as `read_image`, except for errors that only decoding finds.
    """
    with open_image(path, LARGEST_FILE) as image:
        check_decodable(image, path)
        return image.height, image.width


def load_display_image(
    image: Image.Image,
    limit: int | None = TEXTURE_LIMIT,
    path: Path | str = "picture",
    *,
    keep_alpha: bool = False,
    is_raw: bool = False,
) -> Float32Array:
    """Return an opened image of any mode as display-referred values.

    Args:
        image: the image.
        limit: longest side of the result; larger images are averaged down in linear
            light, weighted by opacity. None: no limit.
        path: path of the image's file, for messages.
        keep_alpha: whether alpha is returned as a fourth channel, 1 if the image has
            none; otherwise it is dropped.
        is_raw: whether the image holds numbers, as a normal map does, and no colors.
            Numbers are averaged down without a conversion to linear light.

    Returns:
        (H, W, 3 or 4) float32 in [0, 1], row 0 on top.

    Raises:
        FileFormatError: it has too many pixels, or a format that is not in `FORMATS`.
        OSError, ValueError, SyntaxError: its pixels are truncated or corrupt.
    """
    check_decodable(image, path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about large images and odd metadata
        image.load()
        target_shape = _compute_smaller_shape(image.size, limit)
        if target_shape is None:
            return np.asarray(_VALUE_OF_LEVEL[to_8bit_levels(image, alpha=keep_alpha)])
        if is_raw:
            return _average_numbers(image, target_shape)
        return _average_colors(image, target_shape, keep_alpha=keep_alpha)


def _compute_smaller_shape(
    size: tuple[int, int], limit: int | None
) -> tuple[int, int] | None:
    """Return the height and width of an image whose longest side becomes the limit.

    The result is None if the image, of a width and height, is not above the limit.
    """
    width, height = size
    shrink = 1.0 if limit is None else limit / max(height, width)
    if shrink >= 1.0:
        return None
    return max(1, round(height * shrink)), max(1, round(width * shrink))


# (256,) the values in [0, 1] of 8-bit levels: a table replaces a computation per pixel
_VALUE_OF_LEVEL: Float32Array = np.arange(256, dtype=np.float32) / np.float32(255.0)


def _average_numbers(image: Image.Image, target_shape: tuple[int, int]) -> Float32Array:
    """Average down an image of numbers, without a conversion: (height, width, 3)."""
    width, height = image.size

    def load_band(top: int, end: int) -> Float32Array:
        """Return rows of values."""
        levels = to_8bit_levels(image.crop((0, top, width, end)), alpha=False)
        return np.asarray(_VALUE_OF_LEVEL[levels[:, :, :3]])

    return average_in_bands(load_band, (height, width), target_shape)


def _average_colors(
    image: Image.Image, target_shape: tuple[int, int], *, keep_alpha: bool
) -> Float32Array:
    """Return an image of colors averaged down in linear light, display-referred.

    If the image has opacity, colors are weighted by it, so that transparent pixels have
    no weight. Where all pixels are transparent, weights are equal.

    Args:
        image: the image.
        target_shape: height and width of the result.
        keep_alpha: whether opacity is returned as a fourth channel.
    """
    width, height = image.size
    is_weighted = keep_alpha or image.has_transparency_data
    load_band = partial(_load_linear_band, image, is_weighted)
    averaged = average_in_bands(load_band, (height, width), target_shape)
    # the channels of `_load_linear_band`
    colors = averaged[:, :, :3]
    opacity = averaged[:, :, 3:4]
    if is_weighted:
        color_times_opacity = averaged[:, :, 4:]
        weighted_colors = color_times_opacity / np.maximum(opacity, 1e-9)
        colors = np.where(opacity > 0.0, weighted_colors, colors)
    display_colors = linear_to_srgb(colors)
    if not keep_alpha:
        return display_colors
    return np.concatenate([display_colors, opacity], axis=2)


def _load_linear_band(
    image: Image.Image, is_weighted: bool, top: int, end: int
) -> Float32Array:
    """Return rows of an image as linear colors, from `top` to before `end`.

    If colors are weighted, the channels are those of the color (3), the opacity (1),
    and the color times the opacity (3).
    """
    linear_of_level = srgb_to_linear(_VALUE_OF_LEVEL)
    band_image = image.crop((0, top, image.size[0], end))
    levels = to_8bit_levels(band_image, alpha=is_weighted)
    colors = linear_of_level[levels[:, :, :3]]
    if not is_weighted:
        return colors
    opacity = _VALUE_OF_LEVEL[levels[:, :, 3:]]
    return np.concatenate([colors, opacity, colors * opacity], axis=2)


def average_in_bands(
    load_band: Callable[[int, int], Float32Array],
    size: tuple[int, int],
    target: tuple[int, int],
) -> Float32Array:
    """Average down an image that is too large to hold in floats.

    The image is loaded and averaged band by band. The result is the same as that of
    `average_area` for the full image.

    Args:
        load_band: function of a start and an end; returns the rows from start to before
            end, (n, W, C) float32.
        size: rows and columns of the image.
        target: rows and columns of the result.

    Returns:
        (H, W, C) float32.
    """
    row_weights = _compute_overlaps(size[0], target[0])
    column_weights = _compute_overlaps(size[1], target[1])
    # rows of the result whose source rows have about `_BAND` pixels
    rows_per_band = max(1, _BAND * target[0] // (size[0] * size[1]))
    bands = []
    for start in range(0, target[0], rows_per_band):
        weights = row_weights[start : start + rows_per_band]
        # The indices of a sparse array are its columns with a weight: the source rows
        # that these rows of the result need.
        top = int(weights.indices.min())
        end = int(weights.indices.max()) + 1
        band = load_band(top, end)
        bands.append(_average(band, weights[:, top:end], column_weights))
    return np.concatenate(bands)


def average_area(image: Float32Array, height: int, width: int) -> Float32Array:
    """Resample an image (H, W, C) float32 to a smaller size (height, width, C).

    Each new pixel is the exact mean over the area that it covers.
    """
    return _average(
        image,
        _compute_overlaps(image.shape[0], height),
        _compute_overlaps(image.shape[1], width),
    )


def _average(
    image: Float32Array, row_weights: sparse.csr_array, column_weights: sparse.csr_array
) -> Float32Array:
    """Average an image (R, C, K) by weights of rows (H, R) and of columns (W, C).

    The weights of rows are applied first, then those of columns. Each time the other
    two axes are merged into one, since a sparse matrix can only multiply a matrix.

    Returns:
        The averaged image (H, W, K).
    """
    rows, columns, channels = image.shape
    height = row_weights.shape[0]
    width = column_weights.shape[0]
    # (H, C * K)
    by_rows = row_weights @ image.reshape(rows, columns * channels)
    # (C, H * K)
    transposed = (
        by_rows.reshape(height, columns, channels)
        .transpose(1, 0, 2)
        .reshape(columns, height * channels)
    )
    # (H, W, K)
    averaged = (
        (column_weights @ transposed)
        .reshape(width, height, channels)
        .transpose(1, 0, 2)
    )
    return np.ascontiguousarray(averaged, dtype=np.float32)


def _compute_overlaps(source: int, target: int) -> sparse.csr_array:
    """Return the weights (target, source) of source cells in target cells.

    The same length is divided into `source` equal cells, and into `target` equal cells.
    A weight is the length of the overlap of two cells, normalized so that each row sums
    to 1. To find overlaps, the length is cut into pieces at the edges of all cells.
    Each piece is in one source cell and in one target cell, and its length is their
    overlap.
    """
    # Lengths are in source cells.
    source_edges = np.arange(source + 1, dtype=np.float64)
    target_edges = np.arange(target + 1) * (source / target)
    piece_edges = np.unique(np.concatenate([target_edges, source_edges]))
    piece_lengths = np.diff(piece_edges)
    # The center of a piece is in the same cells as the piece. Rounding must not move it
    # beyond the last cell.
    centers = (piece_edges[1:] + piece_edges[:-1]) / 2
    source_cell = np.minimum(centers.astype(np.int64), source - 1)
    target_cell = np.minimum((centers * (target / source)).astype(np.int64), target - 1)
    overlaps = sparse.coo_array(
        (piece_lengths, (target_cell, source_cell)), shape=(target, source)
    ).tocsr()
    row_sums = np.asarray(overlaps.sum(axis=1)).ravel()
    return sparse.csr_array(sparse.diags_array(1.0 / row_sums) @ overlaps)


ImageKind = Literal["colours", "colours and alpha", "numbers"]  # what a picture holds
LARGEST_SUM = 2 * MAX_PIXELS
"""Limit of the pixels of all color textures of a file, and another one of all textures
of numbers; before `scale_limit`.
"""
UNREADABLE = "cannot be read as a picture"
NO_PATH = ": "  # beginning of the message of an error whose path is ""
_NO_NAME = ""  # path of an image in errors whose message is put after its name
MIN_TEXTURE_SIDE = 64  # smallest limit of the sides of textures, texels
MAX_FULL_TEXTURES = 16
"""Number of materials up to which textures may be as large as `TEXTURE_LIMIT`. More
materials are baked into one map, so that smaller textures suffice.
"""


@dataclass
class FileImages:
    """Decodes the images of one file, each once, within limits in total."""

    materials: int  # number of materials of the file
    references: ReferencedFiles  # finds the files that it names
    notes: Notes  # notes about the file: images made smaller, or missing
    # Longest side of a texture; None for a limit by the number of materials.
    limit: int | None = None
    # Values, or the reason why there are none, by image and kind.
    _cache: dict[tuple[Hashable, ImageKind], Float32Array | str] = field(
        default_factory=dict
    )
    # Pixels decoded so far, by "numbers" or "colours".
    _pixel_counts: Counter[str] = field(default_factory=Counter)

    @property
    def max_side(self) -> int:
        """Longest side of a texture.

        It is halved until the textures of all materials together have at most as many
        texels as `MAX_FULL_TEXTURES` of full size, so that memory is bounded.
        """
        if self.limit is not None:
            return self.limit
        side = TEXTURE_LIMIT
        max_texels = MAX_FULL_TEXTURES * TEXTURE_LIMIT * TEXTURE_LIMIT
        while side > MIN_TEXTURE_SIDE and self.materials * side * side > max_texels:
            side //= 2
        return side

    def load_file(
        self, name: str, kind: ImageKind, message: str
    ) -> Float32Array | None:
        """Return the values of an image that the file names; see `load_image`."""
        return self.load_image(
            name, lambda: self.references.read_file(name), kind, name, message
        )

    def load_image(
        self,
        key: Hashable,
        read_bytes: Callable[[], bytes],
        kind: ImageKind,
        name: str,
        message: str,
    ) -> Float32Array | None:
        """Return the values of an image, as `load_display_image` does.

        If this fails, a note is added and None is returned. An image is decoded only
        once for each kind. A failure is cached, too, but noted at each call.

        Args:
            key: identifies the image in the cache, such as its name.
            read_bytes: returns the content of its file; raises OSError or ValueError if
                there is none.
            kind: content of the image, such as "colours".
            name: its name in the file.
            message: the note, with {name} and {why}.
        """
        if (key, kind) not in self._cache:
            self._cache[key, kind] = self._decode(read_bytes, kind, name)
        image_or_reason = self._cache[key, kind]
        if isinstance(image_or_reason, str):
            self.note_missing(name, image_or_reason, message)
            return None
        return image_or_reason

    def note_missing(self, name: str, reason: str, message: str) -> None:
        """Note that an image is missing.

        Args:
            name: name of the image, which replaces {name} in the message.
            reason: predicate that replaces {why}, such as "is missing".
            message: the note.
        """
        self.notes.warn(
            message.replace("{name}", format_name(name)).replace("{why}", reason)
        )

    def _decode(
        self, read_bytes: Callable[[], bytes], kind: ImageKind, name: str
    ) -> Float32Array | str:
        """Return the values of an image, or the reason why there are none.

        A reason is a predicate, such as "is missing". A note is added if the image was
        made smaller.

        Args:
            read_bytes: returns the content of its file.
            kind: content of the image, such as "numbers".
            name: its name in the file, for notes.
        """
        try:
            image = Image.open(io.BytesIO(read_bytes()), formats=FORMATS)
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
            # A file that must not be read has a reason here.
            return self.references.refusal_by_name.get(normalize_name(name), UNREADABLE)
        try:
            texture = self._load_within_limits(image, kind)
        except FileFormatError as error:
            problem = str(error).removeprefix(NO_PATH)
            return f"is not read ({problem})"
        except (OSError, ValueError, SyntaxError, EOFError):
            return UNREADABLE
        self._note_smaller(name, image.size, (texture.shape[1], texture.shape[0]))
        return texture

    def _note_smaller(
        self, name: str, size: tuple[int, int], texture_size: tuple[int, int]
    ) -> None:
        """Note an image whose texture has another width and height than itself."""
        if texture_size != size:
            label = f"the texture {format_name(name)}" if name else "a texture"
            self.notes.warn(
                f"{label} of {size[0]:,} x {size[1]:,} texels is averaged "
                f"down to {texture_size[0]:,} x {texture_size[1]:,}"
            )

    def _load_within_limits(self, image: Image.Image, kind: ImageKind) -> Float32Array:
        """Return the values of an opened image, and count its pixels.

        The pixels of all images with numbers are limited in total, and so are those of
        all images with colors.

        Raises:
            FileFormatError: a limit is exceeded, or the format is not read.
            OSError, ValueError, SyntaxError: the pixels are truncated or corrupt.
        """
        is_raw = kind == "numbers"
        content = "numbers" if is_raw else "colours"
        width, height = image.size
        n_pixels = self._pixel_counts[content] + width * height
        self._check_pixel_counts(image.size, n_pixels)
        texture = load_display_image(
            image,
            self.max_side,
            _NO_NAME,
            keep_alpha=kind == "colours and alpha",
            is_raw=is_raw,
        )
        self._pixel_counts[content] = n_pixels
        return texture

    def _check_pixel_counts(self, size: tuple[int, int], n_pixels: int) -> None:
        """Raise FileFormatError for an image, or a sum of pixels, that is too large.

        `size` is the width and the height of the image.
        """
        check_pixels(_NO_NAME, *size)
        check_most(
            _NO_NAME,
            n_pixels,
            LARGEST_SUM,
            "pictures of at most {} pixels",
            f"{n_pixels:,} in all",
        )
