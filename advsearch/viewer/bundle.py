"""Pages of runs as files: `report.html` made anew, or a folder that any web server serves as it is."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

from advsearch.errors import InputError
from advsearch.runs.directory import PARTS, REPORT
from advsearch.runs.files import placed_by, write_bytes, write_text
from advsearch.runs.results.sweep import SweepSummary
from advsearch.runs.summary import read_result
from advsearch.viewer.columns import read_columns
from advsearch.viewer.pages import write_page
from advsearch.viewer.sweep_page import SweepSource, sweep_page_html
from advsearch.viewer.thumbnails import kept_pictures, path_of

INDEX = "index.html"


def renewed(run: Path) -> Path:
    """Write the page of a run anew and return its path.

    Raises:
        FileFormatError: its results are damaged.
        StorageError: it cannot be written.
    """
    return write_page(run, read_result(run))


def write_bundle(runs: Sequence[Path], folder: Path) -> Path:
    """Write a folder with a page, the rows and the thumbnails of sweeps, or the page of another run; return the page.

    Raises:
        InputError: the folder is there and not empty, or runs of these commands have no common page.
        FileFormatError: results are damaged.
        StorageError: the folder cannot be written.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"bundle: {folder} is there already and not empty; name another folder")
    results = [(run, read_result(run)) for run in runs]
    sweeps = [(run, result) for run, result in results if isinstance(result, SweepSummary)]
    with placed_by("bundle"):
        if len(results) == 1 and not sweeps:
            return _alone(runs[0], folder)
        if len(sweeps) < len(results):
            raise InputError("bundle: one run or several sweeps make a page; give one kind of them")
        sources = [_copied(run, folder, number) for number, (run, _) in enumerate(sweeps)]
        return write_text(folder / INDEX, sweep_page_html(sweeps, sources))


def _alone(run: Path, folder: Path) -> Path:
    """Write the page of a run, and those of the attacks that it consists of, which it links to."""
    for part in sorted((run / PARTS).glob(f"*/{REPORT}")):
        if part.is_symlink() or part.parent.is_symlink() or not part.is_file():
            continue
        write_bytes(folder / part.relative_to(run), part.read_bytes())
    return write_bytes(folder / INDEX, renewed(run).read_bytes())


def _copied(run: Path, folder: Path, number: int) -> SweepSource:
    """Write rows and thumbnails of a sweep into the folder, and say where they are."""
    rows, pictures = f"rows-{number}.bin", f"pictures-{number}"
    write_bytes(folder / rows, read_columns(run).packed())
    kept = kept_pictures(run)
    for one in kept.numbers if kept else ():
        source = path_of(run, one)
        target = folder / pictures / source.parent.name / source.name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, target)
    return SweepSource(run.name, rows, pictures=kept, folder=pictures)
