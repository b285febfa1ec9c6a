"""The files of a run: written whole or not at all, also in a kill (a power cut may empty what can be made again), held
by one process through a lock that the kernel drops when it ends; and `results.sqlite`: its tables, and how it is
opened."""

from __future__ import annotations

import errno
import fcntl
import io
import os
import re
import sqlite3
import stat
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from advsearch.errors import FileFormatError, InputError, StorageError
from advsearch.files import open_regular
from advsearch.pictures import png_of

PART = ".part-"  # prefix of a file that is still being written; what a killed process may leave behind

_ADVICE = {
    errno.ENOSPC: "the disk is full; free some space or choose another place with `run`",
    errno.EDQUOT: "the disk quota is used up; free some space or choose another place with `run`",
    errno.EROFS: "the file system is read-only; choose another place with `run`",
    errno.EACCES: "there is no permission to write there; choose another place with `run`",
    errno.EPERM: "writing there is not permitted; choose another place with `run`",
    errno.ENOTDIR: "a part of the path is a file, not a folder; choose another place with `run`",
    errno.EEXIST: "a file of that name stands where a folder is needed; choose another place with `run`",
    errno.ENAMETOOLONG: "the name is too long; choose a shorter one with `run`",
}

_SQLITE_ADVICE = {
    "full": _ADVICE[errno.ENOSPC],
    "readonly": _ADVICE[errno.EROFS],
    "unable to open": _ADVICE[errno.EACCES],
    "locked": "another program holds it; close that and try again",
}


@contextmanager
def storage_errors(path: Path) -> Iterator[None]:
    """Turn errors of the operating system and of SQLite inside the block into a `StorageError` that names `path`."""
    try:
        yield
    except (OSError, sqlite3.OperationalError) as error:
        check_there(path)
        if isinstance(error, OSError):
            known, text = _ADVICE.get(error.errno or 0), str(error.strerror or error)
        else:
            known, text = next((how for words, how in _SQLITE_ADVICE.items() if words in str(error)), None), str(error)
        advice = known or f"{text}; choose another place with `run`"
        raise StorageError(f"cannot write {path}: {advice}") from error


@contextmanager
def placed_by(setting: str) -> Iterator[None]:
    """Let the advice of a `StorageError` inside the block name the setting that says where the file goes."""
    try:
        yield
    except StorageError as error:
        raise StorageError(str(error).replace("`run`", f"`{setting}`")) from error


@contextmanager
def replacing(path: Path, *, durable: bool = False) -> Iterator[Path]:
    """Yield a path to write to; when the block ends well its file takes the place of `path` in one step. When it
    raises, or the process is killed, `path` is as it was before. Missing folders are made. A `durable` file survives a
    power cut; that takes some 10 ms."""
    part = path.with_name(f"{PART}{os.getpid()}-{path.name}")
    check_there(path)  # or missing folders would be made
    try:
        with storage_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            part.unlink(missing_ok=True)  # what lies there may be somebody else's link
            yield part
            if durable:
                _flush(part)
            os.replace(part, path)
            if durable:
                _flush(path.parent)
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)


def check_free_folder(out: Path, setting: str) -> None:
    """Check that a folder that is to be written whole is not there, or is empty. Raises InputError, also of a link: a
    folder takes the place of no link, and what it leads to may be somebody else's."""
    if os.path.islink(out):
        raise InputError(f"{setting}: expected a new or an empty folder, got the link {out}; name the folder itself")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{setting}: {out} is there already and not empty; name another folder")


def write_bytes(path: Path, data: bytes, *, durable: bool = False) -> Path:
    """Write `data` to `path`, whole or not at all, and return the path; `durable` as for `replacing`."""
    with replacing(path, durable=durable) as part:
        part.write_bytes(data)
    return path


def write_text(path: Path, text: str, *, durable: bool = True) -> Path:
    """Write `text` in UTF-8 to `path`, whole or not at all, and return the path; `durable` as for `replacing`."""
    return write_bytes(path, text.encode("utf-8"), durable=durable)


def _flush(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


_open: dict[Path, tuple[Path, tuple[int, int]]] = {}
"""Of the folders of runs that are written to here, the results and which file these are."""


def note_open(results: Path) -> Callable[[], None]:
    """Note that the results of a run are open for writing, for `check_there`; return what notes that they are not."""
    with storage_errors(results):
        found = results.stat()
    entry = _open[results.parent] = results, (found.st_dev, found.st_ino)

    def closed() -> None:
        if _open.get(results.parent) is entry:
            del _open[results.parent]

    return closed


def check_there(path: Path) -> None:
    """Check that a path does not lie in the folder of a run that is written to here and was removed or renamed since:
    what is open is still written then, but to nowhere. Raises StorageError."""
    for folder in (path, *path.parents):
        if folder not in _open:
            continue
        results, known = _open[folder]
        try:
            found = results.stat()
        except OSError:
            found = None
        if found is None or (found.st_dev, found.st_ino) != known:
            raise StorageError(
                f"{folder}: the folder of this run was removed or renamed while the run went on; start it again, or "
                "go on with what was renamed by advsearch resume"
            )


NAME = ".lock"


class RunLock:
    """The lock on a run directory, held until `release` or the end of the process; an InputError names who else works
    on it."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / NAME
        with storage_errors(self._path):
            self._descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK, 0o644)
        if not stat.S_ISREG(os.fstat(self._descriptor).st_mode):
            self.release()
            raise FileFormatError(f"{self._path}: expected an ordinary file, got a pipe or the like; remove it")
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            os.truncate(self._descriptor, 0)
            os.write(self._descriptor, str(os.getpid()).encode())
        except OSError as error:
            pid = os.pread(self._descriptor, 32, 0).decode(errors="replace")
            self.release()
            if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
                owner = f"process {pid}" if pid.isdigit() else "another process"
                raise InputError(
                    f"{folder}: {owner} is working on this run; wait for it or choose another name with `run`"
                ) from None
            if error.errno in (errno.ENOLCK, errno.EOPNOTSUPP):
                raise StorageError(f"{folder}: the file system has no locks; choose a local disk with `run`") from None
            raise StorageError(f"cannot lock {folder}: {error.strerror}; choose another place with `run`") from None

    def release(self) -> None:
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1


def is_held(folder: Path) -> bool:
    """Whether a process works on the run in `folder`; nothing is written."""
    try:
        descriptor = os.open(folder / NAME, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(descriptor)
    return False


DAMAGED = "it is damaged, or not made by advsearch: take it from a copy, or run again"
LARGEST = 64 << 30
MAX_SCHEMA_ENTRIES = 100  # of a results.sqlite that are looked at; ours has fewer than ten
APPLICATION_ID = 0x41445653  # in the header of every results.sqlite that is ours: "ADVS"
VERSION = 10
"""Of the tables; in the header of the file. Files of another version are read by the advsearch that wrote them."""

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

_JOURNAL = bytes.fromhex("d9d505f920a163d7")
"""The last bytes of a journal that names a file (https://www.sqlite.org/fileformat2.html)."""


def is_results_database(path: Path) -> bool:
    """Return whether the file at `path` starts like a results.sqlite of advsearch; a link does not."""
    if os.path.islink(path):
        return False
    try:
        with open_regular(path, "a results.sqlite", LARGEST) as file:
            header = file.read(72)
    except (OSError, FileFormatError):
        return False
    return header[:15] == b"SQLite format 3" and header[68:72] == APPLICATION_ID.to_bytes(4, "big")


def is_bare(path: Path) -> bool:
    """Return whether a file of ours has no tables yet: its process was killed as it made them."""
    with readable(path), closing(connect_to_read(path)) as db:
        return _version(db) == 0 and not _schema(db)


@contextmanager
def readable(path: Path) -> Iterator[None]:
    """Turn what SQLite says of a damaged file inside the block into an error that names it."""
    try:
        yield
    except (sqlite3.Error, UnicodeDecodeError) as error:
        text = repr(str(error))[1:-1][:200]  # it quotes what is in the file
        raise FileFormatError(f"{path}: expected a results.sqlite of advsearch, got {text}; {DAMAGED}") from error


def check_schema(db: sqlite3.Connection, path: Path) -> None:
    """Check that the file has what `SCHEMA` makes and no more: a view or a trigger is code, and may never end."""
    if _schema(db) != _own_schema():
        db.close()
        raise FileFormatError(f"{path}: expected the tables of a run, got others; {DAMAGED}")


@cache
def _own_schema() -> Counter[Any]:
    with closing(sqlite3.connect(":memory:")) as db:
        db.executescript(SCHEMA)
        return _schema(db)


def _schema(db: sqlite3.Connection) -> Counter[Any]:
    """Return every entry of the schema, whatever its name: type, name, table and statement.

    Statements are compared without comments and line breaks, which mean nothing to SQLite.
    """
    entries = db.execute("SELECT type, name, tbl_name, sql FROM sqlite_master").fetchmany(MAX_SCHEMA_ENTRIES)
    return Counter((*names, None if sql is None else _without_comments(str(sql))) for *names, sql in entries)


def _without_comments(statement: str) -> str:
    without_comments = "\n".join(line.partition("--")[0] for line in statement.split("\n"))
    return re.sub("[ \n]+", " ", without_comments).strip(" ")


def _protect(db: sqlite3.Connection) -> None:
    """Let a stranger's file call no function of its own choosing, and let SQLite look at each page that it reads.

    Nothing here needs the schema, so nothing of the file's own statements has run by then.
    """
    db.execute("PRAGMA trusted_schema = OFF")
    db.execute("PRAGMA writable_schema = OFF")
    db.execute("PRAGMA cell_size_check = ON")
    db.execute("PRAGMA mmap_size = 0")


def connect_to_write(path: Path) -> sqlite3.Connection:
    if os.path.islink(path):
        raise FileFormatError(f"{path}: expected a file of this run, got a link to another; {DAMAGED}")
    if path.exists():
        open_regular(path, "a results.sqlite", LARGEST).close()
    _check_journal(path.with_name(f"{path.name}-journal"))
    with storage_errors(path):
        db = sqlite3.connect(path)
        _protect(db)
        if _version(db) == 0 and not _schema(db):  # there is nothing in it to lose yet, so the disk isn't waited for
            db.execute("PRAGMA synchronous = OFF")
            db.execute(f"PRAGMA application_id = {APPLICATION_ID}")  # before the log, so that the file itself has it
            db.execute("PRAGMA journal_mode = WAL")
            db.executescript(f"BEGIN; {SCHEMA} COMMIT;")
    return db


def _check_journal(journal: Path) -> None:
    """Refuse a journal that ends with the name of a file: SQLite would delete that file. None of ours does."""
    if not os.path.lexists(journal):
        return
    with open_regular(journal, "a journal of SQLite", LARGEST) as file:
        file.seek(-min(len(_JOURNAL), os.fstat(file.fileno()).st_size), os.SEEK_END)
        if file.read() == _JOURNAL:
            raise FileFormatError(f"{journal}: expected the journal of one file, got one that names another; remove it")


def connect_to_read(path: Path) -> sqlite3.Connection:
    """Open the file for reading; where the log's index can't be made (a read-only disk), as one that never changes."""
    if not os.path.isfile(path):
        raise FileFormatError(f"{path}: expected the results of a run, got no such file; check the name of the run")
    address = path.resolve().as_uri()
    db = sqlite3.connect(f"{address}?mode=ro", uri=True)
    try:
        _version(db)
    except sqlite3.OperationalError:
        db.close()
        db = sqlite3.connect(f"{address}?immutable=1", uri=True)
    _protect(db)
    return db


def _version(db: sqlite3.Connection) -> int:
    return int(db.execute("PRAGMA user_version").fetchone()[0])


def check_version(db: sqlite3.Connection, path: Path) -> None:
    """Refuse, by a FileFormatError, a file of another version, and say which advsearch reads it."""
    version, day = _version(db), ""
    if version == VERSION:
        return
    with suppress(sqlite3.Error):
        created = db.execute("SELECT value FROM meta WHERE key = 'created'").fetchone()
        day = f", that of {str(created[0])[:10]}" if created else ""
    db.close()
    advice = f"read it with the advsearch that wrote it{day}" if version else "it is not a finished results.sqlite"
    raise FileFormatError(f"{path}: expected version {VERSION} of the results, got {version}; {advice}")


# ---------------------------------------------------------------------------------------------------------------------
# Pictures of a run, (H, W, 3) or (H, W), of numpy or torch, as files: 8-bit PNG of sRGB values, rounded as
# verification rounds them, so that the file is exactly what was classified; EXR in float32; an animation of the search.

Bytes = npt.NDArray[np.uint8]
Floats = npt.NDArray[np.float32]

BAD_PICTURE = (OSError, SyntaxError, ValueError, Image.DecompressionBombError)
"""What Pillow raises of a file that is no picture, a damaged one or one that is far too large."""

DIFFERENCE_GAIN = 5.0
ANIMATION_BYTES = 3_000_000
ANIMATION_FRAMES = 60  # most frames of an animation; of more, every second, third, ... is shown, and always the last
ANIMATION_SIDE = 320  # longest side of an animation in pixels; larger pictures are averaged down
_PALETTE_PIXELS = 200_000
FRAME_MS, LAST_FRAME_MS = 100, 2500


def to_8bit(image: Any) -> Bytes:
    """Return ``round(255 clip(image, 0, 1))`` in float32 with halves to even; NaN becomes 0."""
    scaled: Floats = np.clip(np.nan_to_num(_floats(image), nan=0.0), 0.0, 1.0) * np.float32(255.0)
    return np.rint(scaled).astype(np.uint8)


def difference(before: Any, after: Any, gain: float = DIFFERENCE_GAIN) -> Floats:
    """Return ``0.5 + gain (after - before)`` clipped to [0, 1]: mid grey where nothing changed."""
    moved: Floats = np.float32(0.5) + np.float32(gain) * (_floats(after) - _floats(before))
    return np.clip(moved, 0.0, 1.0)


def png_bytes(image: Any) -> bytes:
    """Return the display-referred picture as an 8-bit PNG; equal pictures give equal bytes."""
    return png_of(_picture(to_8bit(image)))


def smaller_png(data: bytes, side: int) -> bytes:
    """Return the picture of a PNG as a PNG whose longest side is at most `side` pixels."""
    buffer = io.BytesIO()
    with Image.open(io.BytesIO(data), formats=("PNG",)) as image:
        image.thumbnail((side, side))
        image.save(buffer, "PNG")
    return buffer.getvalue()


def write_png(path: Path, image: Any) -> Path:
    """Write the display-referred picture as an 8-bit PNG, whole or not at all, and return the path."""
    return write_bytes(path, png_bytes(image))


def read_png(path: Path) -> Floats:
    """Return the display-referred picture, (H, W, 3) in [0, 1], in a PNG."""
    try:
        with Image.open(path, formats=("PNG",)) as image:
            values: Floats = np.asarray(image.convert("RGB"), dtype=np.float32) / np.float32(255.0)
            return values
    except BAD_PICTURE as error:
        raise FileFormatError(f"{path}: expected a PNG picture, got {error}") from None


def write_exr(path: Path, image: Any) -> Path:
    """Write float32 values as an EXR (scan lines, ZIP), whole or not at all, and return the path."""
    values = np.ascontiguousarray(_picture(_floats(image)))
    return _write_exr(path, {"Y" if values.ndim == 2 else "RGB": values}, {})


def write_layers(path: Path, layers: Mapping[str, Any], notes: Mapping[str, str]) -> Path:
    """Write channels (H, W) by name, such as ``normal.X``, as one EXR, whole or not at all, and return the path:
    numbers in float32, whole numbers as 32 bits, and notes on what they mean as attributes of the file."""
    channels = {}
    for name, layer in layers.items():
        values = layer.numpy() if hasattr(layer, "numpy") else np.asarray(layer)
        whole = values.dtype.kind in "iu"
        channels[name] = np.ascontiguousarray(values.astype(np.uint32 if whole else np.float32))
    return _write_exr(path, channels, notes)


def _write_exr(path: Path, channels: Mapping[str, Any], notes: Mapping[str, str]) -> Path:
    # late: OpenEXR takes long to import
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **notes}
    with replacing(path) as part:
        try:
            with OpenEXR.File(header, dict(channels)) as file:
                file.write(os.fspath(part))
        except RuntimeError as error:
            number = errno.ENOSPC if "No space left" in str(error) else errno.EIO
            raise OSError(number, str(error)) from error
    return path


def animation_bytes(frames: Sequence[Any]) -> bytes:
    """Return the display-referred pictures as a GIF that repeats, holds its last frame and is at most 3 MB."""
    count, shrink = min(len(frames), ANIMATION_FRAMES), 1
    while True:
        chosen = np.rint(np.linspace(0, len(frames) - 1, count)).astype(int)  # the first and the last among them
        pictures = [Image.fromarray(_picture(to_8bit(frames[place]))) for place in chosen]
        block = max(shrink, -(-max(pictures[0].size) * shrink // ANIMATION_SIDE))
        width, height = (side - side % block if side > block else side for side in pictures[0].size)
        pictures = [picture.reduce(block, (0, 0, width, height)) for picture in pictures]
        data = _gif(pictures)
        if len(data) <= ANIMATION_BYTES or min(pictures[0].size) < 16:
            return data
        if count > 10:
            count = min(count * 9 // 10, count * ANIMATION_BYTES // len(data))
        else:
            shrink *= 2


def _gif(pictures: Sequence[Image.Image]) -> bytes:
    # one palette for all frames, by Pillow itself: 20 times as fast as through imageio
    pixels = np.concatenate([np.asarray(picture) for picture in pictures])
    stride = 1 + pixels.shape[0] * pixels.shape[1] // _PALETTE_PIXELS
    palette = Image.fromarray(np.ascontiguousarray(pixels[::stride])).quantize(256)
    frames = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    several, buffer = len(frames) > 1, io.BytesIO()
    durations = [FRAME_MS] * (len(frames) - 1) + [LAST_FRAME_MS] if several else LAST_FRAME_MS
    frames[0].save(buffer, "GIF", loop=0, duration=durations, save_all=several, append_images=frames[1:])
    return buffer.getvalue()


def _picture(array: Any) -> Any:
    """Return (H, W, 3) or (H, W); one channel loses its axis."""
    squeezed = array[..., 0] if array.ndim == 3 and array.shape[2] == 1 else array
    if squeezed.ndim != 2 and not (squeezed.ndim == 3 and squeezed.shape[2] == 3):
        raise ValueError(f"expected a picture of shape (H, W, 3) or (H, W), got {tuple(array.shape)}")
    return squeezed


def _floats(image: Any) -> Floats:
    return np.asarray(image.detach().cpu() if hasattr(image, "detach") else image, dtype=np.float32)
