"""Images that the materials of one file name: decoded once, within limits in total."""

from __future__ import annotations

import io
import warnings
from collections import Counter
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from PIL import Image
from scipy import sparse

from advsearch.errors import FileFormatError
from advsearch.pictures import (
    FORMATS,
    LARGEST_PIXELS,
    check_decodable,
    check_pixels,
    opened,
    steps_of,
)
from advsearch.scene.assets import Floats
from advsearch.scene.color import linear_to_srgb, srgb_to_linear
from advsearch.scene.importing.files import Notes, shown
from advsearch.trust.named_files import References, plain_name
from advsearch.trust.stored_files import LARGEST_FILE, check_most

# Limit of the sides of an imported texture, in texels; larger ones are averaged down.
TEXTURE_LIMIT = 1024
_BAND = 1 << 22  # pixels of a large picture that are averaged at a time


def read_picture(
    path: Path, limit: int | None = TEXTURE_LIMIT, *, raw: bool = False
) -> Floats:
    """Read an image file; arguments and result are those of `display_image`.

    Raises:
        FileFormatError: the file is missing, no ordinary file, no image, too large or
            corrupt.
    """
    with opened(path, LARGEST_FILE) as image:
        return display_image(image, limit, path, raw=raw)


def display_image(
    image: Image.Image,
    limit: int | None = TEXTURE_LIMIT,
    path: Path | str = "picture",
    *,
    alpha: bool = False,
    raw: bool = False,
) -> Floats:
    """Return an opened image of any mode as display-referred values.

    Args:
        image: the image.
        limit: longest side of the result; larger images are averaged down in linear
            light, weighted by opacity. None: no limit.
        path: where it is from, for messages.
        alpha: keep it as a fourth channel, 1 if the image has none; otherwise it is
            dropped.
        raw: it holds numbers, as a normal map does, and no colors; larger ones are
            averaged down as they are.

    Returns:
        (H, W, 3 or 4) float32 in [0, 1], row 0 on top.

    Raises:
        FileFormatError: it has too many pixels, or a format that is not in `FORMATS`.
        OSError, ValueError, SyntaxError: its pixels are truncated or corrupt.
    """
    check_decodable(image, path)
    width, height = image.size
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of large images and odd metadata
        image.load()
        scale = 1.0 if limit is None else limit / max(height, width)
        # Value of each of the 256 levels.
        display: Floats = np.arange(256, dtype=np.float32) / np.float32(255.0)
        if scale >= 1.0:
            return np.asarray(display[steps_of(image, alpha=alpha)])
        target = max(1, round(height * scale)), max(1, round(width * scale))
        linear = display if raw else srgb_to_linear(display)
        is_weighted = not raw and (alpha or image.has_transparency_data)

        def load_band(top: int, end: int) -> Floats:
            band_image = image.crop((0, top, width, end))
            levels = steps_of(band_image, alpha=is_weighted)
            colors = linear[levels[:, :, :3]]
            if not is_weighted:
                return colors
            opacity = display[levels[:, :, 3:]]
            return np.concatenate([colors, opacity, colors * opacity], axis=2)

        averaged = banded_average(load_band, (height, width), target)
        if raw:
            return averaged
        colors = averaged[:, :, :3]
        opacity = averaged[:, :, 3:4]
        if is_weighted:
            weighted_colors = averaged[:, :, 4:] / np.maximum(opacity, 1e-9)
            colors = np.where(opacity > 0.0, weighted_colors, colors)
        display_colors = linear_to_srgb(colors)
        if not alpha:
            return display_colors
        return np.concatenate([display_colors, opacity], axis=2)


def banded_average(
    band: Callable[[int, int], Floats], size: tuple[int, int], target: tuple[int, int]
) -> Floats:
    """Average down an image that is too large to hold in floats.

    The result is that of `area_average` for the full image.

    Args:
        band: returns rows from its first argument to before its second, (n, W, C)
            float32.
        size: rows and columns of the image.
        target: rows and columns of the result.

    Returns:
        (H, W, C) float32.
    """
    row_weights = _overlaps(size[0], target[0])
    column_weights = _overlaps(size[1], target[1])
    rows_per_band = max(1, _BAND * target[0] // (size[0] * size[1]))
    bands = []
    for start in range(0, target[0], rows_per_band):
        weights = row_weights[start : start + rows_per_band]
        top = int(weights.indices.min())
        end = int(weights.indices.max()) + 1
        bands.append(_averaged(band(top, end), weights[:, top:end], column_weights))
    return np.concatenate(bands)


def area_average(image: Floats, height: int, width: int) -> Floats:
    """Resample an image (H, W, C) float32 to a smaller size (height, width, C).

    Each new pixel is the exact mean over the area that it covers.
    """
    return _averaged(
        image, _overlaps(image.shape[0], height), _overlaps(image.shape[1], width)
    )


def _averaged(
    image: Floats, down: sparse.csr_array, across: sparse.csr_array
) -> Floats:
    """Average an image (R, C, K) by weights of rows (H, R) and of columns (W, C)."""
    rows, columns, channels = image.shape
    height = down.shape[0]
    width = across.shape[0]
    by_rows = down @ image.reshape(rows, columns * channels)
    transposed = (
        by_rows.reshape(height, columns, channels)
        .transpose(1, 0, 2)
        .reshape(columns, height * channels)
    )
    result = (across @ transposed).reshape(width, height, channels).transpose(1, 0, 2)
    return np.ascontiguousarray(result, dtype=np.float32)


def _overlaps(source: int, target: int) -> sparse.csr_array:
    """Return the weights (target, source) of source cells in target cells.

    They are the overlapping lengths, normalised so that rows sum to 1.
    """
    cells = np.arange(target + 1) * (source / target)
    edges = np.unique(np.concatenate([cells, np.arange(source + 1, dtype=np.float64)]))
    centers = (edges[1:] + edges[:-1]) / 2
    lengths = np.diff(edges)
    row = np.minimum((centers * (target / source)).astype(np.int64), target - 1)
    column = np.minimum(centers.astype(np.int64), source - 1)
    overlaps = sparse.coo_array((lengths, (row, column)), shape=(target, source))
    weights = overlaps.tocsr()
    normalization = sparse.diags_array(1.0 / np.asarray(weights.sum(axis=1)).ravel())
    return sparse.csr_array(normalization @ weights)


Kind = Literal["colours", "colours and alpha", "numbers"]  # what a picture holds
LARGEST_SUM = 2 * LARGEST_PIXELS
"""Limit of the pixels of all color textures of a file, and of those of numbers; before
`scaled`.
"""
UNREADABLE = "cannot be read as a picture"
MOST_TEXTURES = 16
"""Materials whose textures may be as large as `TEXTURE_LIMIT`; more are baked into one map,
so that smaller ones suffice.
"""


@dataclass
class FilePictures:
    """Decodes the images of one file, each once, within limits in total."""

    materials: int  # how many the file has
    references: References  # finds the files that it names
    notes: Notes  # about the file: images made smaller, or missing
    # Longest side of a texture; None: that of an object with so many materials.
    limit: int | None = None
    # Values, or the reason why there are none, by image and kind.
    _known: dict[tuple[Hashable, Kind], Floats | str] = field(default_factory=dict)
    # Pixels so far, by whether they are numbers.
    _pixels: Counter[bool] = field(default_factory=Counter)

    @property
    def side(self) -> int:
        """Longest side of a texture.

        The more materials there are the smaller, so that their memory is bounded.
        """
        if self.limit is not None:
            return self.limit
        side = TEXTURE_LIMIT
        max_texels = MOST_TEXTURES * TEXTURE_LIMIT * TEXTURE_LIMIT
        while side > 64 and self.materials * side * side > max_texels:
            side //= 2
        return side

    def of_file(self, name: str, kind: Kind, words: str) -> Floats | None:
        """Return the values of an image that the file names; see `read`."""
        return self.read(name, lambda: self.references.get(name), kind, name, words)

    def read(
        self,
        key: Hashable,
        content: Callable[[], bytes],
        kind: Kind,
        name: str,
        words: str,
    ) -> Floats | None:
        """Return an image's values, as `display_image`; None, and a note, if it fails.

        Args:
            key: the same for the same image.
            content: returns its file; raises OSError or ValueError if there is none.
            kind: what it holds.
            name: its name in the file.
            words: the note, with {name} and {why}.
        """
        if (key, kind) not in self._known:
            self._known[key, kind] = self._decoded(content, kind, name)
        values = self._known[key, kind]
        if not isinstance(values, str):
            return values
        self.lacks(name, values, words)
        return None

    def lacks(self, name: str, why: str, words: str) -> None:
        """Note that an image is missing, and what replaces it."""
        self.notes.say(words.replace("{name}", shown(name)).replace("{why}", why))

    def _decoded(
        self, content: Callable[[], bytes], kind: Kind, name: str
    ) -> Floats | str:
        """Return the values of an image, or the reason why there are none."""
        try:
            image = Image.open(io.BytesIO(content()), formats=FORMATS)
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
            return self.references.refused.get(plain_name(name), UNREADABLE)
        (width, height) = image.size
        is_raw = kind == "numbers"
        n_pixels = self._pixels[is_raw] + width * height
        try:
            check_pixels("", width, height)
            check_most(
                "",
                n_pixels,
                LARGEST_SUM,
                "pictures of at most {} pixels",
                f"{n_pixels:,} in all",
            )
            texture = display_image(
                image, self.side, "", alpha=kind == "colours and alpha", raw=is_raw
            )
        except FileFormatError as error:
            return f"is not read ({str(error).removeprefix(': ')})"
        except (OSError, ValueError, SyntaxError, EOFError):
            return UNREADABLE
        self._pixels[is_raw] = n_pixels
        rows, columns = texture.shape[:2]
        if (columns, rows) != (width, height):
            label = f"the texture {shown(name)}" if name else "a texture"
            self.notes.say(
                f"{label} of {width:,} x {height:,} texels is averaged "
                f"down to {columns:,} x {rows:,}"
            )
        return texture
