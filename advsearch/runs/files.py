"""Read and write the files of a run: the database `results.sqlite`, and images."""

from __future__ import annotations

import errno
import io
import math
import os
import sqlite3
from collections.abc import Mapping, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from advsearch.errors import FileFormatError
from advsearch.pictures import encode_levels
from advsearch.trust.databases import (
    LARGEST,
    check_before_writing,
    read_version,
    set_defensive_options,
)
from advsearch.trust.stored_files import open_regular
from advsearch.trust.writing import replace_file, storage_errors, write_bytes

# The bytes "ADVS", which are in the header of every results.sqlite of advsearch.
APPLICATION_ID = 0x41445653
VERSION = 10
"""Version of the tables, which is in the header of the file. A file of another version
can only be read by the version of advsearch that wrote it.
"""

SCHEMA = f"""
    -- How this file came to be; times are UTC.
    CREATE TABLE meta (
        key   TEXT PRIMARY KEY,
        value TEXT NOT NULL
    ) WITHOUT ROWID;
    INSERT INTO meta VALUES ('created', strftime('%Y-%m-%dT%H:%M:%SZ', 'now'));

    -- One row for each evaluated configuration, in the order in which they were evaluated.
    CREATE TABLE evaluations (
        id           INTEGER PRIMARY KEY, -- grows by one
        kind         TEXT    NOT NULL,    -- what it was for: search, baseline, verification, control, ...
        step         INTEGER NOT NULL,    -- step or trial within its kind, from 0
        seed         INTEGER,             -- of the render
        spp          INTEGER,             -- samples per pixel of the render
        objective    REAL,                -- what was maximised; NULL when it was not a number, or nothing is maximised
        score        REAL,                -- what the task says of the prediction, over 0 where it is what is sought
        success      INTEGER,             -- 1 when the prediction is what is sought, 0 when not, NULL in a sweep
        correct      INTEGER,             -- 1 when the prediction was a right one, else 0
        margin       REAL,                -- largest logit of a right class minus largest of a wrong one
        label        TEXT,                -- the class that the model predicted
        label_index  INTEGER,             -- its number
        probability  REAL,                -- the model's probability for it, in [0, 1]
        payload_json TEXT,                -- what a task keeps of a prediction beside its words: boxes, masks
        values_json  TEXT    NOT NULL,    -- {{"camera.azimuth": {{"value": 130.0, "unit": "degrees"}}, ...}}
        seconds      REAL,                -- that the evaluation took
        renders      INTEGER,             -- pictures that it took; more than one where derivatives are differences
        phase        TEXT,                -- of a search: search, or ranking where a candidate was rendered again
        metrics_json TEXT,                -- {{"feature": 0.31, ...}}: numbers that the run's metrics say of the picture
        machine      TEXT,                -- by its name in the note "machines"; NULL for the one that wrote the row
        time         REAL    NOT NULL     -- when the row was written, seconds since 1970 (UTC)
    );
    CREATE UNIQUE INDEX evaluations_step ON evaluations (kind, step); -- whoever writes a step how often

    -- What an evaluation told its search beside its row: only until the run is done.
    CREATE TABLE told (
        row         INTEGER PRIMARY KEY REFERENCES evaluations (id),
        number      INTEGER NOT NULL, -- of its seed
        u           BLOB    NOT NULL, -- digest of the configuration
        non_finite  INTEGER NOT NULL, -- numbers of the gradient that were not
        cost        INTEGER NOT NULL, -- in evaluations
        gradient    BLOB,             -- float32, where one was wanted
        picture     BLOB,             -- levels of 8 bits, where it is kept for the animation
        height      INTEGER           -- of that, in pixels
    );
    PRAGMA user_version = {VERSION};
"""


def is_results_database(path: Path) -> bool:
    """Return whether a file, and no link, starts like a results.sqlite of advsearch."""
    if os.path.islink(path):
        return False
    try:
        with open_regular(path, "a results.sqlite", LARGEST) as file:
            header = file.read(72)
    except (OSError, FileFormatError):
        return False
    # SQLite keeps the number of the application in bytes 68 to 71
    is_sqlite = header[:15] == b"SQLite format 3"
    return is_sqlite and header[68:72] == APPLICATION_ID.to_bytes(4, "big")


def connect_to_write(path: Path) -> sqlite3.Connection:
    """Open a database for writing, and create it if it is missing.

    A new one is created under another name and then renamed, so that no process ever
    sees it without its tables.
    """
    check_before_writing(path)
    if not path.exists():
        with replace_file(path) as part, closing(sqlite3.connect(part)) as db:
            # Nothing in the new file can be lost, so that waiting for the disk is
            # not needed.
            db.execute("PRAGMA synchronous = OFF")
            # The id is set before WAL mode, in which changes are first written to
            # another file, so that it is in the header from the beginning.
            db.execute(f"PRAGMA application_id = {APPLICATION_ID}")
            db.execute("PRAGMA journal_mode = WAL")
            db.executescript(f"BEGIN; {SCHEMA} COMMIT;")
    with storage_errors(path):
        db = sqlite3.connect(path)
        set_defensive_options(db)
    return db


def check_version(db: sqlite3.Connection, path: Path) -> None:
    """Check that a database has the version that this advsearch reads.

    Args:
        db: the open database.
        path: its path, for the message.

    Raises:
        FileFormatError: it has another version. The database is then closed, and the
            message states which advsearch can read it.
    """
    version = read_version(db)
    if version == VERSION:
        return
    advice = f"read it with the advsearch that wrote it{_describe_creation(db)}"
    db.close()
    if version == 0:  # the default of SQLite, in a database whose tables are missing
        advice = "it is not a finished results.sqlite"
    raise FileFormatError(
        f"{path}: expected version {VERSION} of the results, got {version}; {advice}"
    )


def _describe_creation(db: sqlite3.Connection) -> str:
    """Return the day on which a database was created, as a clause; empty if unknown."""
    with suppress(sqlite3.Error):
        created = db.execute("SELECT value FROM meta WHERE key = 'created'").fetchone()
        if created:
            return f", that of {str(created[0])[:10]}"
    return ""


# --------------------------------------------------------------------------------
# Pictures of a run, (H, W, 3) or (H, W), of numpy or torch, as files: 8-bit PNG of sRGB
# values, rounded as verification rounds them, so that the file is exactly what was
# classified; EXR in float32; an animation of the search.

Bytes = npt.NDArray[np.uint8]
Floats = npt.NDArray[np.float32]

BAD_PICTURE = (OSError, SyntaxError, ValueError, Image.DecompressionBombError)
"""Exceptions of Pillow for a file that is no image, is corrupt, or is far too large."""

DIFFERENCE_GAIN = 5.0  # factor by which an image of differences is amplified
ANIMATION_BYTES = 3_000_000  # maximum size of an animation
# Maximum number of frames of an animation. Of more frames some are left out, but never
# the first and the last one.
ANIMATION_FRAMES = 60
# Longest side of an animation in pixels. Larger images are averaged down.
ANIMATION_SIDE = 320
# An animation that is too large gets fewer frames, until it has at most
# MIN_ANIMATION_FRAMES; then smaller frames, until a side is below MIN_ANIMATION_SIDE.
MIN_ANIMATION_FRAMES = 10
MIN_ANIMATION_SIDE = 16
_PALETTE_PIXELS = 200_000
FRAME_MS = 100
LAST_FRAME_MS = 2500


def to_8bit(image: Any) -> Bytes:
    """Return an image in [0, 1] as uint8.

    It is ``round(255 clip(image, 0, 1))`` in float32, where halves are rounded to the
    even neighbor. NaN becomes 0.
    """
    without_nan = np.nan_to_num(_to_float32(image), nan=0.0)
    scaled: Floats = np.clip(without_nan, 0.0, 1.0) * np.float32(255.0)
    return np.rint(scaled).astype(np.uint8)


def amplify_difference(
    before: Any, after: Any, gain: float = DIFFERENCE_GAIN
) -> Floats:
    """Return an image of the difference between two images, mid gray for no change.

    It is ``0.5 + gain (after - before)``, clipped to [0, 1].

    Args:
        before: (H, W, 3) or (H, W), in [0, 1].
        after: the changed image, of the same shape.
        gain: factor by which differences are amplified.
    """
    difference = _to_float32(after) - _to_float32(before)
    amplified: Floats = np.float32(0.5) + np.float32(gain) * difference
    return np.clip(amplified, 0.0, 1.0)


def encode_png(image: Any) -> bytes:
    """Return the display-referred picture as an 8-bit PNG; equal pictures give equal
    bytes.
    """
    return encode_levels(_check_image_shape(to_8bit(image)))


def shrink_png(data: bytes, side: int) -> bytes:
    """Return the picture of a PNG as a PNG whose longest side is at most `side`
    pixels.
    """
    buffer = io.BytesIO()
    with Image.open(io.BytesIO(data), formats=("PNG",)) as image:
        image.thumbnail((side, side))
        image.save(buffer, "PNG")
    return buffer.getvalue()


def write_png(path: Path, image: Any) -> Path:
    """Write the display-referred picture as an 8-bit PNG, whole or not at all, and
    return the path.
    """
    return write_bytes(path, encode_png(image))


def read_png(path: Path) -> Floats:
    """Return the display-referred picture, (H, W, 3) in [0, 1], in a PNG."""
    try:
        with Image.open(path, formats=("PNG",)) as image:
            levels = np.asarray(image.convert("RGB"), dtype=np.float32)
            values: Floats = levels / np.float32(255.0)
            return values
    except BAD_PICTURE as error:
        raise FileFormatError(f"{path}: expected a PNG picture, got {error}") from None


def write_exr(path: Path, image: Any) -> Path:
    """Write float32 values as an EXR (scan lines, ZIP), whole or not at all, and return
    the path.
    """
    values = np.ascontiguousarray(_check_image_shape(_to_float32(image)))
    channel = "Y" if values.ndim == 2 else "RGB"  # OpenEXR's names
    return _write_exr(path, {channel: values}, notes={})


def write_layers(
    path: Path, layers: Mapping[str, Any], notes: Mapping[str, str]
) -> Path:
    """Write channels atomically into one EXR file, and return its path.

    Args:
        path: path of the file.
        layers: channels (H, W) by name, such as ``normal.X``. Integers are stored as
            uint32, other numbers as float32.
        notes: texts by name that describe the channels; they become attributes of the
            file.
    """
    channels = {}
    for name, layer in layers.items():
        values = layer.numpy() if hasattr(layer, "numpy") else np.asarray(layer)
        is_integer = values.dtype.kind in "iu"
        channels[name] = np.ascontiguousarray(
            values.astype(np.uint32 if is_integer else np.float32)
        )
    return _write_exr(path, channels, notes)


def _write_exr(
    path: Path, channels: Mapping[str, Any], notes: Mapping[str, str]
) -> Path:
    """Write channels atomically into an OpenEXR file, and return its path.

    Args:
        path: path of the file.
        channels: arrays by name, (H, W) or, as "RGB", (H, W, 3).
        notes: further attributes of the file.

    Raises:
        OSError: it cannot be written. OpenEXR itself raises RuntimeError.
    """
    # late: OpenEXR takes long to import
    import OpenEXR

    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        **notes,
    }
    with replace_file(path) as part:
        try:
            with OpenEXR.File(header, dict(channels)) as file:
                file.write(os.fspath(part))
        except RuntimeError as error:
            # the message is the only sign of a full disk
            number = errno.ENOSPC if "No space left" in str(error) else errno.EIO
            raise OSError(number, str(error)) from error
    return path


def encode_animation(frames: Sequence[Any]) -> bytes:
    """Return pictures as a GIF that repeats and shows its last frame longer.

    If the GIF is larger than `ANIMATION_BYTES`, it is made again with fewer frames, as
    long as there are more than `MIN_ANIMATION_FRAMES`, and then with smaller ones.

    Args:
        frames: (H, W, 3) or (H, W) display-referred pictures in [0, 1], of one size.
    """
    count = min(len(frames), ANIMATION_FRAMES)
    shrink = 1  # factor by which sides are smaller than ANIMATION_SIDE
    while True:
        pictures = _shrink_images(_select_frames(frames, count), shrink)
        data = _encode_gif(pictures)
        is_minimal = min(pictures[0].size) < MIN_ANIMATION_SIDE
        if len(data) <= ANIMATION_BYTES or is_minimal:
            return data
        if count > MIN_ANIMATION_FRAMES:
            # the number of frames that fit if all are equally large
            fitting_count = count * ANIMATION_BYTES // len(data)
            count = min(count * 9 // 10, fitting_count)  # at least a tenth less
        else:
            shrink *= 2


def _select_frames(frames: Sequence[Any], count: int) -> list[Image.Image]:
    """Return evenly spaced frames as 8-bit images, with the first and the last one."""
    indices = np.rint(np.linspace(0, len(frames) - 1, count)).astype(int)
    return [
        Image.fromarray(_check_image_shape(to_8bit(frames[index]))) for index in indices
    ]


def _shrink_images(images: Sequence[Image.Image], shrink: int) -> list[Image.Image]:
    """Return images whose longest side is at most ANIMATION_SIDE / `shrink` pixels.

    Each block of pixels is averaged to one pixel. Rows and columns that fill no block
    are cut off.

    Args:
        images: images of one size.
        shrink: factor by which they are smaller than `ANIMATION_SIDE`.
    """
    longest_side = max(images[0].size)
    # Side of a block in pixels, rounded up. It is at least `shrink`, so that small images
    # become smaller, too.
    block = max(shrink, math.ceil(longest_side * shrink / ANIMATION_SIDE))
    # full blocks only, but at least one pixel
    width, height = (
        side - side % block if side > block else side for side in images[0].size
    )
    return [image.reduce(block, (0, 0, width, height)) for image in images]


def _encode_gif(pictures: Sequence[Image.Image]) -> bytes:
    """Encode images of one size as a GIF that repeats, with a longer last frame.

    One palette of 256 colors serves all frames.
    """
    palette = _make_palette(pictures)
    frames = [
        picture.quantize(palette=palette, dither=Image.Dither.NONE)
        for picture in pictures
    ]
    buffer = io.BytesIO()
    frames[0].save(
        buffer,
        "GIF",
        loop=0,
        duration=_list_durations(len(frames)),
        save_all=len(frames) > 1,
        append_images=frames[1:],
    )
    return buffer.getvalue()


def _list_durations(n_frames: int) -> int | list[int]:
    """Return the milliseconds of each frame of an animation, or of a single image."""
    if n_frames == 1:
        return LAST_FRAME_MS
    return [FRAME_MS] * (n_frames - 1) + [LAST_FRAME_MS]


def _make_palette(pictures: Sequence[Image.Image]) -> Image.Image:
    """Return an image with the palette of 256 colors that fits all of the images."""
    pixels = np.concatenate([np.asarray(picture) for picture in pictures])
    # To be fast, the palette is made from every `stride`-th row of pixels, about
    # `_PALETTE_PIXELS` in all.
    stride = 1 + pixels.shape[0] * pixels.shape[1] // _PALETTE_PIXELS
    return Image.fromarray(np.ascontiguousarray(pixels[::stride])).quantize(256)


def _check_image_shape(array: Any) -> Any:
    """Return an image as (H, W, 3) or (H, W); a single channel loses its axis.

    Raises:
        ValueError: it has another shape.
    """
    has_single_channel = array.ndim == 3 and array.shape[2] == 1
    squeezed = array[..., 0] if has_single_channel else array
    if squeezed.ndim != 2 and not (squeezed.ndim == 3 and squeezed.shape[2] == 3):
        raise ValueError(
            f"expected a picture of shape (H, W, 3) or (H, W), got {tuple(array.shape)}"
        )
    return squeezed


def _to_float32(image: Any) -> Floats:
    if hasattr(image, "detach"):  # a tensor of torch
        image = image.detach().cpu()
    return np.asarray(image, dtype=np.float32)
