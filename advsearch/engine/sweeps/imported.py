"""Sweeps that another program made, read into a run: rows, thumbnails, result and page."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from advsearch.engine.sweeps.summary import FINISHED, Count, rate
from advsearch.errors import FileFormatError
from advsearch.runs.directory import RunDirectory, default_name
from advsearch.runs.results.sweep import SweepSummary
from advsearch.runs.store import Row
from advsearch.runs.threedb import read_threedb
from advsearch.viewer import thumbnails
from advsearch.viewer.sweep_page import write_sweep_page

MOST_PIXELS = 1 << 22
"""Of a picture that is read."""

MOST_VALUES = 96
"""Different values of a parameter that the result lists."""

AT_ONCE = 1000
"""Rows that are stored at once."""


def import_threedb(folder: Path, run: str | Path | None = None, *, overwrite: bool = False) -> Path:
    """Read a folder that 3DB wrote into a run, and return its folder.

    Args:
        folder: with `details.log`, `class_maps.json` and `images/`.
        run: the run's name or folder; None for ``runs/NAME-3db-NNN``.
        overwrite: replace the run that is there.

    Raises:
        FileFormatError: the folder lacks a file, or one is damaged.
        RunExistsError: there is a run already.
        StorageError: the run cannot be written.
    """
    counts = _Counts()
    with RunDirectory.create(run, overwrite=overwrite, default=default_name(folder.resolve().name, ["3db"])) as kept:
        rows: list[Row] = []
        for one in read_threedb(folder):
            if one.picture is not None:
                thumbnails.keep(kept.path, one.row.step, thumbnails.thumbnail(read_picture(one.picture)))
            counts.add(one.row)
            rows.append(one.row)
            if len(rows) == AT_ONCE:
                kept.record(*rows)
                rows.clear()
        kept.record(*rows)
        if not counts.seen:
            raise FileFormatError(f"{folder}: expected the log of 3DB with at least one line, got an empty one")
        summary = counts.summary(kept.path, folder)
        kept.write_summary(summary)
        write_sweep_page(kept.path, summary)
        return kept.path


class _Counts:
    """What the rows come to."""

    def __init__(self) -> None:
        self.seen = self.correct = 0
        self._names: dict[str, dict[str, None]] = {name: {} for name in ("object", "environment", "model")}
        self._values: dict[str, dict[float | str, tuple[int, int]] | None] = {}
        self._wrong: dict[str, int] = {}

    def add(self, row: Row) -> None:
        right = bool(row.correct)
        self.seen += 1
        self.correct += right
        if not right:
            self._wrong[row.label or ""] = self._wrong.get(row.label or "", 0) + 1
        for name, value in row.values.items():
            if name in self._names:
                self._names[name][str(value["value"])] = None
            table = self._values.setdefault(name, {})
            if table is None:
                continue
            seen, correct = table.get(value["value"], (0, 0))
            table[value["value"]] = (seen + 1, correct + right)
            if len(table) > MOST_VALUES:
                self._values[name] = None

    def summary(self, run: Path, folder: Path) -> SweepSummary:
        tables = []
        for name, table in self._values.items():
            if table is None or len(table) < 2:
                continue
            count = Count(name, "", sorted(table, key=lambda value: (isinstance(value, str), value)))
            count.seen, count.correct = ([table[value][place] for value in count.values] for place in (0, 1))
            tables += count.rows()
        called = {name: _listed(list(values)) for name, values in self._names.items()}
        most = sorted(self._wrong.items(), key=lambda pair: -pair[1])[:20]
        return SweepSummary(
            run=str(run),
            object=called["object"],
            model=called["model"],
            task="classification",
            environment=called["environment"],
            controls=[],
            ending=FINISHED,
            image_formation=None,
            planned=self.seen,
            **vars(rate(self.correct, self.seen)),
            not_finite=0,
            answers=dict(most),
            axes=tables,
            cells=None,
            worst=None,
            grid={},
            samples=1,
            sampler=None,
            spp=0,
            renders={"sweep": self.seen},
            renders_per_second=None,
            seconds={"total": 0.0},
            seed=0,
            warnings=[f"Read from {folder}, as 3DB wrote it; it was not rendered here."],
            command_line="",
        )


def _listed(names: Sequence[str]) -> str:
    return ",".join(names[:20]) + (f" and {len(names) - 20} more" if len(names) > 20 else "") or "unknown"


def read_picture(path: Path) -> object:
    """Return the picture (H, W, 3) in [0, 1] in a file.

    Raises:
        FileFormatError: it is none, or has more than `MOST_PIXELS`.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            opened = Image.open(path)
        with opened as image:
            if image.width * image.height > MOST_PIXELS:
                raise FileFormatError(
                    f"{path}: expected at most {MOST_PIXELS} pixels, got {image.width} x {image.height}"
                )
            return np.asarray(image.convert("RGB"), dtype=np.float32) / np.float32(255.0)
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise FileFormatError(f"{path}: expected a picture, got {str(error)[:100]}") from None
