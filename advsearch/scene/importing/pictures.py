"""The pictures that the materials of one file name: each decoded once, and within limits in all."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt
from PIL import Image

from advsearch import files
from advsearch.errors import FileFormatError
from advsearch.pictures import FORMATS, LARGEST_PIXELS, check_pixels
from advsearch.scene.importing.files import plain_name, shown
from advsearch.scene.importing.images import TEXTURE_LIMIT, display_image

Floats = npt.NDArray[np.float32]
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
        read: returns the content of a file that it names; raises FileNotFoundError.
        refused: for names of files, as `plain_name` gives them, why they were not read.
        notes: clauses about the pictures that were made smaller.
    """

    materials: int
    read: Callable[[str], bytes]
    refused: Mapping[str, str]
    notes: list[str] = field(default_factory=list)
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
            image = Image.open(io.BytesIO(self.read(name)), formats=FORMATS)
            found = self.decoded(image, kind, name)
            self._opened.append(image)  # what is decoded is known by its identity
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
            found = None
        return self.why(name, found) if found is None or isinstance(found, str) else found

    def why(self, name: str, found: str | None) -> str:
        """Return why a named picture cannot be had, after what `decoded` said of it."""
        return self.refused.get(plain_name(name)) or found or "cannot be read as a picture"

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
            note = f"{called} of {width:,} x {height:,} texels is averaged down to {columns:,} x {rows:,}"
            self.notes += [] if note in self.notes else [note]
        return texture
