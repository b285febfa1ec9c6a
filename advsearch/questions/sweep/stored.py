"""Sweeps that have been run, for experiments about their rows and images."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import pandas as pd

from advsearch.errors import FileFormatError
from advsearch.questions.sweep.carry_out import load_scenes_of_sweep
from advsearch.questions.sweep.job import SceneLoader
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.questions.sweep.summary import SweepSummary
from advsearch.runs.directory import CONFIG
from advsearch.runs.summary import read_result
from advsearch.runs.tables import read_sweep
from advsearch.viewer import thumbnails


@dataclass(frozen=True, eq=False)
class StoredSweep:
    """A sweep that has been run.

    Attributes:
        folder: the run directory.
        config: the settings.
        summary: the result.
    """

    folder: Path
    config: SweepConfig
    summary: SweepSummary

    @classmethod
    def read(cls, folder: Path) -> StoredSweep:
        """Read settings and result of a sweep.

        Raises:
            FileFormatError: the run is one of another command.
        """
        summary = read_result(folder)
        if not isinstance(summary, SweepSummary):
            raise FileFormatError(
                f"{folder}: expected the run of a sweep, got one of "
                f"{summary.command}; sweep first"
            )
        return cls(folder, SweepConfig.from_yaml(folder / CONFIG), summary)

    def read_rows(self) -> pd.DataFrame:
        """Read the rows in ascending order of `step`.

        `runs.tables.read_sweep` describes the columns and the attributes of the frame.

        Raises:
            FileFormatError: the rows cannot be read.
        """
        rows = read_sweep(self.folder, is_sampled=self.summary.sampler is not None)
        return rows.sort_values("step", ignore_index=True)

    @cached_property
    def scenes(self) -> SceneLoader:
        """The scenes, loaded to render images of the sweep again.

        Raises:
            InputError, ModelError: a scene or a model is missing.
        """
        return load_scenes_of_sweep(self.config)

    def find_thumbnail(self, number: int) -> Path | None:
        """Return the file of an image's stored thumbnail; None if there is none."""
        return thumbnails.find_thumbnail(self.folder, number)
