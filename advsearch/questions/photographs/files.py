"""Photographs of the real thing beside the renderings that it was aligned with: ``images/photos/12-0003.jpg``.

A rendering is named as its file is: a sweep's by the number of its picture, an attack's ``adversarial``, ``clean`` or
``verification-00``. A photograph comes from a browser, so nothing in it is believed: it is measured before it is
decoded, cut to the rendering's shape, and written anew without what else its file said (places, names of cameras).
"""

from __future__ import annotations

import io
import re
from pathlib import Path

from PIL import Image, ImageOps

from advsearch.errors import InputError
from advsearch.runs.directory import IMAGES
from advsearch.viewer.thumbnails import kept_pictures, path_of

FOLDER = "photos"
"""In `images/` of the run."""

LARGEST = 16 << 20
"""Most bytes of a photograph's file."""

MOST_PIXELS = 50_000_000
"""Of a photograph before it is made smaller; the largest phones take 50 million."""

SIDE = 1024
"""Longest side of a photograph that is kept, pixels."""

QUALITY = 95
"""Of its JPEG file, from 1 to 95."""

_NUMBER = re.compile(r"[0-9]{1,12}")
_NAME = re.compile(r"clean|adversarial|verification-[0-9]{2}")
_PHOTO = re.compile(r"(?:[0-9]{1,12}|clean|adversarial|verification-[0-9]{2})-[0-9]{4,9}\.jpg")


def rendering_file(run: Path, name: str) -> Path:
    """Return the file of a rendering.

    Raises:
        InputError: the run has none of that name.
    """
    file = None
    if _NUMBER.fullmatch(name):
        file = path_of(run, int(name))
    elif _NAME.fullmatch(name):
        file = run / IMAGES / f"{name}.png"
    if file is None or file.is_symlink() or not file.is_file():
        raise InputError(f"rendering: {run.name} has none called {name[:40]!r}; open its page for those that it has")
    return file


def rendering_names(run: Path) -> tuple[str, ...]:
    """Return the names of a run's renderings; empty where it kept none."""
    kept = kept_pictures(run)
    if kept is not None:
        return tuple(map(str, kept.numbers))
    files = sorted((run / IMAGES).glob("*.png"))
    found = [file.stem for file in files if _NAME.fullmatch(file.stem) and not file.is_symlink()]
    return tuple(sorted(found, key=lambda name: (name != "adversarial", name)))


def photo_file(run: Path, name: str) -> Path:
    """Return the file of a photograph that was kept.

    Raises:
        InputError: there is none of that name.
    """
    file = run / IMAGES / FOLDER / name
    if not _PHOTO.fullmatch(name) or file.is_symlink() or not file.is_file():
        raise InputError("photo: there is none of that name")
    return file


def photo_name(rendering: str, number: int) -> str:
    """Return what the file of a run's photograph `number` is called."""
    return f"{rendering}-{number:04d}.jpg"


def sound_photo(data: bytes, shape: tuple[int, int]) -> bytes:
    """Return a photograph as a JPEG of at most `SIDE` pixels a side, its middle cut to a shape.

    Args:
        data: the file as it was sent: JPEG, PNG or WebP.
        shape: (width, height) of the rendering; their ratio counts.

    Raises:
        InputError: it is too large, or no such picture.
    """
    if len(data) > LARGEST:
        raise InputError(f"photo: expected at most {LARGEST >> 20} MB, got more; send a smaller one")
    bombs = (Image.DecompressionBombError, Image.DecompressionBombWarning)
    try:
        with Image.open(io.BytesIO(data), formats=("JPEG", "PNG", "WEBP")) as image:
            if image.width * image.height > MOST_PIXELS:
                raise InputError(f"photo: expected at most {MOST_PIXELS:,} pixels, got {image.width} x {image.height}")
            image.draft("RGB", (2 * SIDE, 2 * SIDE))  # a JPEG is decoded at about the size that is needed
            upright = ImageOps.exif_transpose(image).convert("RGB")
    except InputError:
        raise
    except bombs:
        raise InputError(f"photo: expected at most {MOST_PIXELS:,} pixels, got far more") from None
    except (OSError, SyntaxError, ValueError, EOFError, OverflowError, MemoryError):
        raise InputError("photo: expected a picture in JPEG, PNG or WebP, got something else or a part") from None
    width, height = shape
    shrunk = min(SIDE, max(upright.size)) / max(width, height)
    size = max(1, round(width * shrunk)), max(1, round(height * shrunk))
    buffer = io.BytesIO()
    ImageOps.fit(upright, size, Image.Resampling.LANCZOS).save(buffer, "JPEG", quality=QUALITY)
    return buffer.getvalue()
