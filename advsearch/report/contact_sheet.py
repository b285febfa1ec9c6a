"""Several pictures on one sheet, each with lines of text under it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from advsearch.runs.images import to_8bit

Floats = npt.NDArray[np.float32]

GAP, LINE = 8, 15
"""Pixels between tiles, and of a line of text."""
FONT = 12
NARROWEST = 160
"""Pixels that a tile is wide at least, so that its text can be read; smaller pictures are magnified."""


def contact_sheet(pictures: Sequence[Floats], captions: Sequence[Sequence[str]]) -> Floats:
    """Return pictures side by side on white.

    Args:
        pictures: (H, W, 3) display-referred sRGB in [0, 1], all of one size.
        captions: the lines of text under each; what is too long for the tile is cut.

    Returns:
        (h, w, 3) float32, display-referred sRGB in [0, 1].
    """
    columns = columns_for(len(pictures))
    rows = math.ceil(len(pictures) / columns)
    factor = math.ceil(NARROWEST / pictures[0].shape[1])
    height, width = (factor * side for side in pictures[0].shape[:2])
    cell = width + GAP, height + LINE * max(map(len, captions)) + GAP
    sheet = Image.new("RGB", (GAP + columns * cell[0], GAP + rows * cell[1]), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(FONT)
    for number, (picture, lines) in enumerate(zip(pictures, captions, strict=True)):
        left, top = GAP + number % columns * cell[0], GAP + number // columns * cell[1]
        tile = Image.fromarray(to_8bit(picture)).resize((width, height), Image.Resampling.NEAREST)
        sheet.paste(tile, (left, top))
        for place, line in enumerate(lines):
            text = _cut(line, width, draw, font)
            draw.text((left, top + height + LINE * place), text, fill="black", font=font)
    levels: Floats = np.asarray(sheet, dtype=np.float32)
    return np.asarray(levels / np.float32(255.0))


def columns_for(count: int) -> int:
    """Return how many of `count` tiles stand side by side: about the square root, and no holes where that can be."""
    least = math.ceil(math.sqrt(count))
    return next((columns for columns in range(least, 2 * least + 1) if count % columns == 0), least)


def _cut(line: str, width: int, draw: ImageDraw.ImageDraw, font: ImageFont.FreeTypeFont | ImageFont.ImageFont) -> str:
    """The line on one line of the tile, with dots where it does not fit."""
    text = " ".join(line[:200].split())
    if draw.textlength(text, font=font) <= width:
        return text
    while text and draw.textlength(text + "...", font=font) > width:
        text = text[:-1]
    return text + "..."
