"""The pictures that the materials of one file name: each decoded once, and within limits in all."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from PIL import Image
from scipy import sparse

from advsearch import files
from advsearch.errors import FileFormatError
from advsearch.pictures import FORMATS, LARGEST_PIXELS, check_decodable, check_pixels, opened, steps_of
from advsearch.scene.assets import Floats
from advsearch.scene.color import linear_to_srgb, srgb_to_linear
from advsearch.scene.importing.files import LARGEST_FILE, Notes, References, plain_name, shown

TEXTURE_LIMIT = 1024
"""Longest side of an imported texture, in texels; larger ones are averaged down."""

_BAND = 1 << 22  # pixels of a large picture that are averaged at a time


def read_picture(path: Path, limit: int | None = TEXTURE_LIMIT, *, raw: bool = False) -> Floats:
    """Read a picture file; arguments and result as for `display_image`.

    Raises:
        FileFormatError: it is missing, no ordinary file, no picture, too large or damaged.
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
    """Decode a picture.

    Args:
        image: an opened picture of any mode.
        limit: longest side of the result; larger pictures are averaged down in linear light, and so that what is
            transparent does not count. None: no limit.
        path: where it is from, for messages.
        alpha: keep it as a fourth channel, 1 where the picture has none; otherwise it is dropped.
        raw: it holds numbers, as a normal map does, and no colours; larger ones are averaged down as they are.

    Returns:
        (H, W, 3 or 4) float32 display-referred values in [0, 1], row 0 on top.

    Raises:
        FileFormatError: too many pixels, or a format that is not one of `FORMATS`.
        OSError, ValueError, SyntaxError: the file's pixels are truncated or damaged.
    """
    check_decodable(image, path)
    width, height = image.size
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of large pictures and odd metadata
        image.load()
        scale = 1.0 if limit is None else limit / max(height, width)
        display: Floats = np.arange(256, dtype=np.float32) / np.float32(255.0)
        if scale >= 1.0:
            return np.asarray(display[steps_of(image, alpha=alpha)])
        target = max(1, round(height * scale)), max(1, round(width * scale))
        linear = display if raw else srgb_to_linear(display)

        weighted = not raw and (alpha or image.has_transparency_data)

        def band(top: int, end: int) -> Floats:
            steps = steps_of(image.crop((0, top, width, end)), alpha=weighted)
            colors, share = linear[steps[:, :, :3]], display[steps[:, :, 3:]]
            return np.concatenate([colors, share, colors * share] if weighted else [colors], axis=2)

        averaged = banded_average(band, (height, width), target)
        if raw:
            return averaged
        colors, share = averaged[:, :, :3], averaged[:, :, 3:4]
        if weighted:
            colors = np.where(share > 0.0, averaged[:, :, 4:] / np.maximum(share, 1e-9), colors)
        return np.concatenate([linear_to_srgb(colors), share] if alpha else [linear_to_srgb(colors)], axis=2)


def banded_average(band: Callable[[int, int], Floats], size: tuple[int, int], target: tuple[int, int]) -> Floats:
    """Average an image down that is too large to hold in floats; the same as `area_average` of the whole.

    Args:
        band: returns rows from the first to before the second of its arguments, (n, W, C) float32.
        size: rows and columns of the image.
        target: rows and columns of the result, at most those.

    Returns:
        (H, W, C) float32.
    """
    down, across = _overlaps(size[0], target[0]), _overlaps(size[1], target[1])
    count = max(1, _BAND * target[0] // (size[0] * size[1]))
    pieces = []
    for start in range(0, target[0], count):
        rows = down[start : start + count]
        top, end = int(rows.indices.min()), int(rows.indices.max()) + 1
        pieces.append(_averaged(band(top, end), rows[:, top:end], across))
    return np.concatenate(pieces)


def area_average(image: Floats, height: int, width: int) -> Floats:
    """Resample an image to a smaller size; each new pixel is the exact mean over the area that it covers.

    Args:
        image: (H, W, C) float32, any values.
        height: rows of the result, at most H.
        width: columns of the result, at most W.

    Returns:
        (height, width, C) float32 with the same mean as `image`.
    """
    return _averaged(image, _overlaps(image.shape[0], height), _overlaps(image.shape[1], width))


def _averaged(image: Floats, down: sparse.csr_array, across: sparse.csr_array) -> Floats:
    """Average rows, then columns, by matrices as `_overlaps` makes them."""
    rows, columns, channels = image.shape
    height, width = down.shape[0], across.shape[0]
    low = down @ image.reshape(rows, columns * channels)
    sideways = low.reshape(height, columns, channels).transpose(1, 0, 2).reshape(columns, height * channels)
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


Kind = Literal["colours", "colours and alpha", "numbers"]
"""What a picture holds."""

LARGEST_SUM = 2 * LARGEST_PIXELS
"""Pixels that the colour textures of a file may have in all, and those of numbers, before `advsearch.files.scaled`."""

MOST_TEXTURES = 16
"""Materials whose textures are kept at `TEXTURE_LIMIT`; more are baked into one map, for which less will do."""


@dataclass
class Pictures:
    """Decodes the pictures of one file.

    Attributes:
        materials: how many the file has.
        references: finds the files that it names.
        notes: about the file; which pictures were made smaller is said there.
    """

    materials: int
    references: References
    notes: Notes
    _known: dict[tuple[int, Kind], Floats | str] = field(default_factory=dict)
    _opened: list[Image.Image] = field(default_factory=list)
    _pixels: dict[bool, int] = field(default_factory=lambda: {False: 0, True: 0})

    @property
    def side(self) -> int:
        """The longest side of the textures of so many materials; all together they take a bounded memory."""
        side = TEXTURE_LIMIT
        while side > 64 and self.materials * side * side > MOST_TEXTURES * TEXTURE_LIMIT * TEXTURE_LIMIT:
            side //= 2
        return side

    def decoded(self, image: Image.Image | None, kind: Kind = "colours", name: str = "") -> Floats | str | None:
        """Return a picture's values, why there are none, or None where there is no picture.

        Args:
            image: as it was opened.
            kind: what it holds. Values are as in `display_image`.
            name: what the file calls it, for notes.
        """
        if image is None:
            return None
        if (id(image), kind) not in self._known:
            self._known[id(image), kind] = self._pixels_of(image, kind, name)
        return self._known[id(image), kind]

    def of_file(self, name: str, kind: Kind) -> Floats | str:
        """Return the values of a picture file that the file names, or why there are none."""
        try:
            image = Image.open(io.BytesIO(self.references.get(name)), formats=FORMATS)
            found = self.decoded(image, kind, name)
            self._opened.append(image)  # what is decoded is known by its identity
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
            found = None
        return self.why(name, found) if found is None or isinstance(found, str) else found

    def why(self, name: str, found: str | None) -> str:
        """Return why a named picture cannot be had, after what `decoded` said of it."""
        return self.references.refused.get(plain_name(name)) or found or "cannot be read as a picture"

    def _pixels_of(self, image: Image.Image, kind: Kind, name: str) -> Floats | str:
        """Decode a picture, or say why not."""
        (width, height), raw = image.size, kind == "numbers"
        pixels, most = self._pixels[raw] + width * height, files.scaled(LARGEST_SUM)
        try:
            check_pixels("", width, height)
            if pixels > most:
                raise files.too_large("", f"pictures of at most {most:,} pixels", f"{pixels:,} in all")
            texture = display_image(image, self.side, "", alpha=kind == "colours and alpha", raw=raw)
        except FileFormatError as error:
            return f"is not read ({str(error).removeprefix(': ')})"
        except (OSError, ValueError, SyntaxError, EOFError):
            return "cannot be read as a picture"
        self._pixels[raw] = pixels
        rows, columns = texture.shape[:2]
        if (columns, rows) != (width, height):
            called = f"the texture {shown(name)}" if name else "a texture"
            self.notes.say(f"{called} of {width:,} x {height:,} texels is averaged down to {columns:,} x {rows:,}")
        return texture
