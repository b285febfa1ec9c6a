"""A picture with boxes and masks drawn into it: what is true of the scene, and what the model says."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from advsearch.runs.images import to_8bit

Floats = npt.NDArray[np.float32]

TRUE, SAID = (0, 190, 255), (255, 110, 0)
"""Colours of what is true and of what the model says; told apart in any kind of colour vision."""
SMALLEST = 512
"""Pixels of the longest side at least; smaller pictures are magnified, so that text can be read."""
TINT = 0.45


class Shape(Protocol):
    """What is drawn: a box, or the pixels of a mask; see `advsearch.tasks.Mark`."""

    @property
    def text(self) -> str:
        """What stands beside it."""

    @property
    def true(self) -> bool:
        """Whether it is true of the scene, and not what the model says."""

    @property
    def box(self) -> tuple[float, float, float, float] | None:
        """x0, y0, x1, y1 in pixels of the picture."""

    @property
    def mask(self) -> Any:
        """(h, w) bool over the whole picture, of any size; None for a box."""


def marked(picture: Any, shapes: Sequence[Shape]) -> Floats:
    """Return a picture with shapes drawn into it, magnified where it is small.

    The box or the outline of what is true is blue; a box of the model is orange, and its mask tinted so. Of boxes, the
    text stands at the upper left corner, or inside where there is no room above.

    Args:
        picture: (H, W, 3) display-referred sRGB in [0, 1].
        shapes: what to draw.

    Returns:
        (h, w, 3) float32, display-referred sRGB in [0, 1].
    """
    levels = to_8bit(picture)
    factor = max(1, -(-SMALLEST // max(levels.shape[:2])))
    size = levels.shape[1] * factor, levels.shape[0] * factor
    image = Image.fromarray(levels).resize(size, Image.Resampling.NEAREST)
    for shape in sorted(shapes, key=lambda one: one.true):
        if shape.mask is not None:
            _draw_mask(image, np.asarray(shape.mask, dtype=bool), shape.true)
    draw, font = ImageDraw.Draw(image), ImageFont.load_default(13)
    for shape in sorted((one for one in shapes if one.box is not None), key=lambda one: not one.true):
        _draw_box(draw, shape, factor, size, font)
    found: Floats = np.asarray(image, dtype=np.float32) / np.float32(255.0)
    return found


def _draw_mask(image: Image.Image, mask: npt.NDArray[np.bool_], true: bool) -> None:
    """Tint what the model says; outline what is true."""
    whole = np.asarray(Image.fromarray(mask).resize(image.size, Image.Resampling.NEAREST))
    colour, strength = Image.new("RGB", image.size, TRUE if true else SAID), whole * TINT
    if true:
        inner = np.pad(whole, 2)[2:-2, 2:-2]
        for axis in (0, 1):
            for step in (-2, 2):
                inner = inner & np.roll(np.pad(whole, 2), step, axis=axis)[2:-2, 2:-2]
        strength = (whole & ~inner).astype(float)
    image.paste(colour, (0, 0), Image.fromarray(np.rint(255.0 * strength).astype(np.uint8)))


def _draw_box(draw: ImageDraw.ImageDraw, shape: Shape, factor: int, size: tuple[int, int], font: Any) -> None:
    assert shape.box is not None
    most = [side - 1 for side in size] * 2
    x0, y0, x1, y1 = (
        min(max(round(end * factor) - (place > 1), 0), last)
        for place, (end, last) in enumerate(zip(shape.box, most, strict=True))
    )
    colour = TRUE if shape.true else SAID
    draw.rectangle((x0, y0, max(x0, x1), max(y0, y1)), outline=colour, width=2)
    text = f"true: {shape.text}" if shape.true else shape.text
    left, top, right, bottom = draw.textbbox((0, 0), text, font=font)
    wide, high = right - left + 6, bottom - top + 6
    at: tuple[float, float] = (x0, y0 - high if y0 >= high else y0)
    if shape.true:  # its text stands below, where that of the model's box does not cover it
        at = (x0, y1 if y1 + high < size[1] else y1 - high)
    at = min(at[0], max(size[0] - wide, 0)), at[1]
    draw.rectangle((at[0], at[1], at[0] + wide, at[1] + high), fill=colour)
    draw.text((at[0] + 3 - left, at[1] + 3 - top), text, fill=(0, 0, 0), font=font)
