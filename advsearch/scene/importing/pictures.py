"""The pictures that the materials of one file name: each decoded once, and within
limits in all.
"""

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

# longest side of an imported texture, in texels; larger ones are averaged down
TEXTURE_LIMIT = 1024
_BAND = 1 << 22  # pixels of a large picture that are averaged at a time


def read_picture(
    path: Path, limit: int | None = TEXTURE_LIMIT, *, raw: bool = False
) -> Floats:
    """Read a picture file; arguments and result as for `display_image`. Raises
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
    """Return an opened picture of any mode as (H, W, 3 or 4) float32 display-referred
    values in [0, 1], row 0 on top. Raises FileFormatError: too many pixels, or a format
    that is not one of `FORMATS`. Raises OSError, ValueError, SyntaxError: the file's
    pixels are truncated or damaged.

    Args:
        image: the picture.
        limit: longest side of the result; larger pictures are averaged down in linear
            light, and so that what is transparent does not count. None: no limit.
        path: where it is from, for messages.
        alpha: keep it as a fourth channel, 1 where the picture has none; otherwise it
            is dropped.
        raw: it holds numbers, as a normal map does, and no colours; larger ones are
            averaged down as they are.
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
            colors = linear[steps[:, :, :3]]
            share = display[steps[:, :, 3:]]
            return np.concatenate(
                [colors, share, colors * share] if weighted else [colors], axis=2
            )

        averaged = banded_average(band, (height, width), target)
        if raw:
            return averaged
        colors = averaged[:, :, :3]
        share = averaged[:, :, 3:4]
        if weighted:
            colors = np.where(
                share > 0.0, averaged[:, :, 4:] / np.maximum(share, 1e-9), colors
            )
        return np.concatenate(
            [linear_to_srgb(colors), share] if alpha else [linear_to_srgb(colors)],
            axis=2,
        )


def banded_average(
    band: Callable[[int, int], Floats], size: tuple[int, int], target: tuple[int, int]
) -> Floats:
    """Average an image of a size (rows, columns), too large to hold in floats, down to
    a target size (H, W): the same as `area_average` of the whole. `band` returns rows
    from the first to before the second of its arguments, (n, W, C) float32; so is the
    result, (H, W, C).
    """
    down = _overlaps(size[0], target[0])
    across = _overlaps(size[1], target[1])
    count = max(1, _BAND * target[0] // (size[0] * size[1]))
    pieces = []
    for start in range(0, target[0], count):
        rows = down[start : start + count]
        top = int(rows.indices.min())
        end = int(rows.indices.max()) + 1
        pieces.append(_averaged(band(top, end), rows[:, top:end], across))
    return np.concatenate(pieces)


def area_average(image: Floats, height: int, width: int) -> Floats:
    """Return an image (H, W, C) float32 resampled to a smaller size (height, width, C),
    with the same mean: each new pixel is the exact mean over the area that it covers.
    """
    return _averaged(
        image, _overlaps(image.shape[0], height), _overlaps(image.shape[1], width)
    )


def _averaged(
    image: Floats, down: sparse.csr_array, across: sparse.csr_array
) -> Floats:
    rows, columns, channels = image.shape
    height = down.shape[0]
    width = across.shape[0]
    low = down @ image.reshape(rows, columns * channels)
    sideways = (
        low.reshape(height, columns, channels)
        .transpose(1, 0, 2)
        .reshape(columns, height * channels)
    )
    result = (across @ sideways).reshape(width, height, channels).transpose(1, 0, 2)
    return np.ascontiguousarray(result, dtype=np.float32)


def _overlaps(source: int, target: int) -> sparse.csr_array:
    """Return the (target, source) matrix of the share of each source cell in each
    target cell; rows sum to 1.
    """
    cells = np.arange(target + 1) * (source / target)
    edges = np.unique(np.concatenate([cells, np.arange(source + 1, dtype=np.float64)]))
    middles = (edges[1:] + edges[:-1]) / 2
    lengths = np.diff(edges)
    row = np.minimum((middles * (target / source)).astype(np.int64), target - 1)
    column = np.minimum(middles.astype(np.int64), source - 1)
    weights = sparse.coo_array((lengths, (row, column)), shape=(target, source)).tocsr()
    share = sparse.diags_array(1.0 / np.asarray(weights.sum(axis=1)).ravel())
    return sparse.csr_array(share @ weights)


Kind = Literal["colours", "colours and alpha", "numbers"]  # what a picture holds
LARGEST_SUM = 2 * LARGEST_PIXELS
"""Pixels that the colour textures of a file may have in all, and those of numbers,
before `scaled`.
"""
UNREADABLE = "cannot be read as a picture"
MOST_TEXTURES = 16
"""Materials whose textures are kept at `TEXTURE_LIMIT`; more are baked into one map,
for which less will do.
"""


@dataclass
class FilePictures:
    """Decodes the pictures of one file, each once."""

    materials: int  # how many the file has
    references: References  # finds the files that it names
    # about the file: which pictures were made smaller, and which cannot be had, and why
    notes: Notes
    # longest side of a texture, whatever the number of materials; None for an object's
    limit: int | None = None
    _known: dict[tuple[Hashable, Kind], Floats | str] = field(default_factory=dict)
    _pixels: Counter[bool] = field(default_factory=Counter)

    @property
    def side(self) -> int:
        """The longest side of the textures of so many materials; all together they take
        a bounded memory.
        """
        if self.limit is not None:
            return self.limit
        side = TEXTURE_LIMIT
        while (
            side > 64
            and self.materials * side * side
            > MOST_TEXTURES * TEXTURE_LIMIT * TEXTURE_LIMIT
        ):
            side //= 2
        return side

    def of_file(self, name: str, kind: Kind, words: str) -> Floats | None:
        """Return the values of a picture that the file names; as `read`."""
        return self.read(name, lambda: self.references.get(name), kind, name, words)

    def read(
        self,
        key: Hashable,
        content: Callable[[], bytes],
        kind: Kind,
        name: str,
        words: str,
    ) -> Floats | None:
        """Return a picture's values, as `display_image` has them; None where it cannot
        be had, and a note.

        Args:
            key: the same for the same picture.
            content: returns its file; raises OSError or ValueError where it cannot be
                had.
            kind: what it holds.
            name: what the file calls it.
            words: of the note, with {name} and {why}.
        """
        if (key, kind) not in self._known:
            self._known[key, kind] = self._decoded(content, kind, name)
        values = self._known[key, kind]
        if not isinstance(values, str):
            return values
        self.lacks(name, values, words)
        return None

    def lacks(self, name: str, why: str, words: str) -> None:
        """Note that a picture cannot be had, and what takes its place."""
        self.notes.say(words.replace("{name}", shown(name)).replace("{why}", why))

    def _decoded(
        self, content: Callable[[], bytes], kind: Kind, name: str
    ) -> Floats | str:
        try:
            image = Image.open(io.BytesIO(content()), formats=FORMATS)
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
            return self.references.refused.get(plain_name(name), UNREADABLE)
        (width, height) = image.size
        raw = kind == "numbers"
        pixels = self._pixels[raw] + width * height
        try:
            check_pixels("", width, height)
            check_most(
                "",
                pixels,
                LARGEST_SUM,
                "pictures of at most {} pixels",
                f"{pixels:,} in all",
            )
            texture = display_image(
                image, self.side, "", alpha=kind == "colours and alpha", raw=raw
            )
        except FileFormatError as error:
            return f"is not read ({str(error).removeprefix(': ')})"
        except (OSError, ValueError, SyntaxError, EOFError):
            return UNREADABLE
        self._pixels[raw] = pixels
        rows, columns = texture.shape[:2]
        if (columns, rows) != (width, height):
            called = f"the texture {shown(name)}" if name else "a texture"
            self.notes.say(
                f"{called} of {width:,} x {height:,} texels is averaged "
                f"down to {columns:,} x {rows:,}"
            )
        return texture
