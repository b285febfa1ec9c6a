"""Small pictures of a sweep's configurations: ``images/rows/0001/1234.jpg``, a thousand
to a folder.
"""

from __future__ import annotations

import base64
import io
import os
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from advsearch.errors import FileFormatError
from advsearch.runs.directory import CONFIG, IMAGES, SMALL_PICTURES
from advsearch.runs.files import BAD_PICTURE, Bytes, to_8bit
from advsearch.settings import read_yaml, split_names
from advsearch.trust.stored_files import read_bytes
from advsearch.trust.writing import write_bytes

if TYPE_CHECKING:
    import pandas as pd


A_FOLDER = 1000  # pictures in each folder
SIDE = 128  # longest side of a thumbnail, pixels
QUALITY = 85  # of the JPEG files, from 1 to 95
LARGEST_COVER = 50_000_000  # pixels of a picture that a list shows small
LARGEST = 1 << 24  # most bytes of the file of a thumbnail
# what a thumbnail of `SIDE` takes, about; measured on pictures of the bundled objects
BYTES = 5000


def thumbnail(picture: object) -> bytes:
    """Return a display-referred picture (H, W, 3) in [0, 1] as a JPEG of at most `SIDE`
    pixels a side.
    """
    values: Bytes = to_8bit(picture)
    return _jpeg(Image.fromarray(values))


def cover(run: Path) -> bytes:
    """Return a small picture of a run as a JPEG: its worst prediction, or else its
    first figure; grey where it has none.
    """
    first = [run / IMAGES / f"{name}.png" for name in ("adversarial", "clean", "worst")]
    for file in (*first, *sorted((run / IMAGES).glob("*.png"))):
        if not file.is_file():
            continue
        with suppress(*BAD_PICTURE), Image.open(file, formats=("PNG",)) as image:
            if image.width * image.height <= LARGEST_COVER:
                return _jpeg(image.convert("RGB"))
    return _jpeg(Image.new("RGB", (1, 1), (128, 128, 128)))


def _jpeg(image: Image.Image) -> bytes:
    buffer = io.BytesIO()
    image.thumbnail((SIDE, SIDE))
    image.save(buffer, "JPEG", quality=QUALITY)
    return buffer.getvalue()


def path_of(run: Path, number: int) -> Path:
    return run / SMALL_PICTURES / f"{number // A_FOLDER:04d}" / f"{number}.jpg"


def kept_file(run: Path, number: int) -> Path | None:
    """Return the file of the thumbnail of a picture; None where there is none. A link
    is none (`check_links` leaves these to this function).
    """
    file = path_of(run, number)
    return (
        file
        if file.is_file() and not (file.is_symlink() or file.parent.is_symlink())
        else None
    )


def read_thumbnail(run: Path, number: int) -> bytes:
    """Return the thumbnail of a picture. Raises FileNotFoundError where there is none,
    or a link in its place, and FileFormatError where it is too large.
    """
    file = kept_file(run, number)
    if file is None:
        raise FileNotFoundError(f"{run}: has no picture {number}")
    return read_bytes(file, "a small picture", LARGEST)


def keep(run: Path, number: int, data: bytes) -> None:
    """Keep the thumbnail of a picture. Raises StorageError where it cannot be
    written.
    """
    write_bytes(path_of(run, number), data, durable=False)


@dataclass(frozen=True)
class Kept:
    """The thumbnails that a run has, each of `models` configurations in a row; only of
    some of the pictures, if it says so.
    """

    run: Path
    models: int
    some: bool

    @cached_property
    def numbers(self) -> tuple[int, ...]:
        """Of the pictures, sorted. Listing the files of a million takes seconds, so
        only who needs them asks.
        """
        return tuple(sorted(_numbers(self.run)))

    def png_of(self, step: int) -> bytes | None:
        """Return the picture of a configuration as a PNG; None where it was not
        kept.
        """
        try:
            data = read_thumbnail(self.run, step // self.models)
        except OSError:
            return None
        stream = io.BytesIO()
        try:
            with Image.open(io.BytesIO(data), formats=("JPEG",)) as image:
                image.save(stream, "PNG")
        except BAD_PICTURE:
            file = path_of(self.run, step // self.models)
            raise FileFormatError(
                f"{file}: expected a small picture of the run, got something else"
            ) from None
        return stream.getvalue()

    def embedded(self, rows: pd.DataFrame, most: int) -> Iterator[tuple[str, str]]:
        """Yield number and data address of thumbnails, of the worst margins first, up
        to `most` bytes.
        """
        steps = rows["step"].to_numpy()
        margins = rows["margin"].to_numpy()
        order = np.argsort(np.nan_to_num(margins, nan=np.inf), kind="stable")
        there = set(self.numbers)
        spent = 0
        for step in steps[order]:
            number = int(step) // self.models
            if number not in there:
                continue
            there.discard(number)
            data = read_thumbnail(self.run, number)
            spent += len(data) * 4 // 3
            if spent > most:
                return
            yield (
                str(number),
                "data:image/jpeg;base64," + base64.b64encode(data).decode("ascii"),
            )


def kept_pictures(run: Path) -> Kept | None:
    """Return which thumbnails a sweep has; None where it has none."""
    if next(_numbers(run), None) is None:
        return None
    settings = read_yaml(run / CONFIG) if (run / CONFIG).is_file() else {}
    models = len(split_names(str(settings.get("model", "one"))))
    return Kept(run, models, settings.get("keep_pictures") != "all")


def _numbers(run: Path) -> Iterator[int]:
    """Yield the numbers of the pictures that are there; links are none."""
    top = run / SMALL_PICTURES
    if not top.is_dir():
        return
    with os.scandir(top) as folders:
        for folder in folders:
            if not folder.is_dir(follow_symlinks=False):
                continue
            with os.scandir(folder) as files:
                for file in files:
                    stem, _, suffix = file.name.rpartition(".")
                    if (
                        suffix == "jpg"
                        and stem.isdecimal()
                        and file.is_file(follow_symlinks=False)
                    ):
                        yield int(stem)
