"""Runs that are parts of another run: carried out in its folder, gone on with, or read where they are done."""

from __future__ import annotations

from pathlib import Path

from advsearch.api import carry_out
from advsearch.config import CONFIGS
from advsearch.progress import Progress
from advsearch.runs.directory import CONFIG, is_run
from advsearch.runs.listing import finished
from advsearch.runs.results.base import Result
from advsearch.runs.summary import read_result
from advsearch.settings import Config, read_yaml


def carry_out_part(path: Path, config: Config, progress: Progress) -> Result:
    """Return the result of a part; what is done of it is not done again.

    Args:
        path: of its folder.
        config: what it does, where it has not begun.
        progress: told how far it is.
    """
    if not is_run(path) or not (path / CONFIG).is_file():
        return carry_out(config.model_copy(update={"run": str(path), "overwrite": True}), progress=progress)
    if finished(path):
        return read_result(path)
    kind = CONFIGS[str(read_yaml(path / CONFIG)["command"])]
    return carry_out(kind.from_yaml(path / CONFIG), progress=progress, resumed=path)
