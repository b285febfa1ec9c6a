"""Read and write thumbnails of a sweep's images: ``images/rows/0001/1234.jpg``, with
1000 images in each directory.
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
from typing import TYPE_CHECKING, Any

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


# Number of images in each directory.
IMAGES_PER_DIRECTORY = 1000
# Longest side of a thumbnail in pixels.
THUMBNAIL_SIZE = 128
# Quality of JPEG files, from 1 to 95.
JPEG_QUALITY = 85
# maximum pixels of an image that is scaled down for the list of runs
MAX_COVER_PIXELS = 50_000_000
# maximum bytes of the file of a thumbnail
MAX_THUMBNAIL_BYTES = 1 << 24
# Approximate size of a thumbnail in bytes, measured on images of the bundled objects.
TYPICAL_BYTES = 5000


def make_thumbnail(picture: object) -> bytes:
    """Encode a display-referred image (H, W, 3) in [0, 1] as a small JPEG.

    It has at most `THUMBNAIL_SIZE` pixels along either side.
    """
    values: Bytes = to_8bit(picture)
    return _encode_jpeg(Image.fromarray(values))


def make_cover(run: Path) -> bytes:
    """Return a small image of a run as a JPEG, for the list of runs.

    It is the adversarial image if there is one, otherwise another image of the run. If
    none can be read, it is gray.
    """
    preferred = ("adversarial", "clean", "worst")
    files = [run / IMAGES / f"{name}.png" for name in preferred]
    files += sorted((run / IMAGES).glob("*.png"))
    for file in files:
        if not file.is_file():
            continue
        # a file that cannot be read is passed over
        with suppress(*BAD_PICTURE), Image.open(file, formats=("PNG",)) as image:
            if image.width * image.height <= MAX_COVER_PIXELS:
                return _encode_jpeg(image.convert("RGB"))
    return _encode_jpeg(Image.new("RGB", (1, 1), (128, 128, 128)))


def _encode_jpeg(image: Image.Image) -> bytes:
    """Scale an image down to a thumbnail, and encode it as a JPEG."""
    buffer = io.BytesIO()
    image.thumbnail((THUMBNAIL_SIZE, THUMBNAIL_SIZE))
    image.save(buffer, "JPEG", quality=JPEG_QUALITY)
    return buffer.getvalue()


def thumbnail_path(run: Path, number: int) -> Path:
    """Return where the thumbnail of an image is stored."""
    directory = f"{number // IMAGES_PER_DIRECTORY:04d}"
    return run / SMALL_PICTURES / directory / f"{number}.jpg"


def find_thumbnail(run: Path, number: int) -> Path | None:
    """Return the file of a thumbnail, None if there is none.

    A link, which could lead out of the run, counts as none; `check_links`, which
    rejects links elsewhere in a run, does not look at thumbnails.
    """
    file = thumbnail_path(run, number)
    if not file.is_file() or file.is_symlink() or file.parent.is_symlink():
        return None
    return file


def read_thumbnail(run: Path, number: int) -> bytes:
    """Return the thumbnail of an image as a JPEG.

    Raises:
        FileNotFoundError: if there is none, or a link instead.
        FileFormatError: if it is too large.
    """
    file = find_thumbnail(run, number)
    if file is None:
        raise FileNotFoundError(f"{run}: has no picture {number}")
    return read_bytes(file, "a small picture", MAX_THUMBNAIL_BYTES)


def write_thumbnail(run: Path, number: int, data: bytes) -> None:
    """Store the thumbnail of an image.

    Raises:
        StorageError: if it cannot be written.
    """
    write_bytes(thumbnail_path(run, number), data, durable=False)


@dataclass(frozen=True)
class Thumbnails:
    """The thumbnails of a run.

    Attributes:
        run: directory of the run.
        rows_per_image: number of consecutive rows about the same image, one for each
            model.
        is_subset: whether only some of the images have thumbnails.
    """

    run: Path
    rows_per_image: int
    is_subset: bool

    @cached_property
    def numbers(self) -> tuple[int, ...]:
        """The numbers of the images that have thumbnails, sorted.

        Listing a million files takes seconds; it is done at first use.
        """
        return tuple(sorted(_list_numbers(self.run)))

    def read_png(self, step: int) -> bytes | None:
        """Return the thumbnail of a row's image as a PNG; None if it was not stored.

        Args:
            step: step of the row.

        Raises:
            FileFormatError: the file is no JPEG.
        """
        try:
            data = read_thumbnail(self.run, step // self.rows_per_image)
        except OSError:
            return None
        try:
            return _convert_to_png(data)
        except BAD_PICTURE:
            file = thumbnail_path(self.run, step // self.rows_per_image)
            raise FileFormatError(
                f"{file}: expected a small picture of the run, got something else"
            ) from None

    def list_data_urls(
        self, rows: pd.DataFrame, max_bytes: int
    ) -> Iterator[tuple[str, str]]:
        """Yield the number and the data URL of thumbnails, the worst margins first.

        Args:
            rows: table with the "step" and the "margin" of rows.
            max_bytes: maximum size of all URLs together.
        """
        remaining = set(self.numbers)
        n_bytes = 0
        for step in _sort_by_margin(rows):
            number = int(step) // self.rows_per_image
            if number not in remaining:
                continue
            remaining.discard(number)  # yielded once, for the worst of its rows
            data = read_thumbnail(self.run, number)
            # base64 encodes 3 bytes as 4 letters
            n_bytes += len(data) * 4 // 3
            if n_bytes > max_bytes:
                return
            text = base64.b64encode(data).decode("ascii")
            yield str(number), f"data:image/jpeg;base64,{text}"


def _sort_by_margin(rows: pd.DataFrame) -> Any:
    """Return the steps of rows, the worst margins first."""
    steps = rows["step"].to_numpy()
    margins = rows["margin"].to_numpy()
    # rows without a margin come last
    order = np.argsort(np.nan_to_num(margins, nan=np.inf), kind="stable")
    return steps[order]


def find_thumbnails(run: Path) -> Thumbnails | None:
    """Return the thumbnails of a sweep, None if it has none."""
    has_thumbnails = next(_list_numbers(run), None) is not None
    if not has_thumbnails:
        return None
    settings = read_yaml(run / CONFIG) if (run / CONFIG).is_file() else {}
    # Every model has a row for each image. Without the setting there is a single model.
    model_names = split_names(str(settings.get("model", "default")))
    is_subset = settings.get("keep_pictures") != "all"
    return Thumbnails(run, len(model_names), is_subset)


def _convert_to_png(jpeg: bytes) -> bytes:
    """Return a JPEG image as a PNG.

    Raises:
        Exception: one of `BAD_PICTURE` if it is no JPEG.
    """
    stream = io.BytesIO()
    with Image.open(io.BytesIO(jpeg), formats=("JPEG",)) as image:
        image.save(stream, "PNG")
    return stream.getvalue()


def _list_numbers(run: Path) -> Iterator[int]:
    """Yield the numbers of the images that have thumbnails, in any order; links are
    ignored.
    """
    root = run / SMALL_PICTURES
    if not root.is_dir():
        return
    with os.scandir(root) as directories:
        for directory in directories:
            if not directory.is_dir(follow_symlinks=False):
                continue
            with os.scandir(directory) as files:
                for file in files:
                    stem, _, suffix = file.name.rpartition(".")
                    is_image = suffix == "jpg" and stem.isdecimal()
                    if is_image and file.is_file(follow_symlinks=False):
                        yield int(stem)
