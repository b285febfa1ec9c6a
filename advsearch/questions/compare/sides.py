"""Read the sides of a comparison from stored sweeps.

Images of a sweep are numbered, and the draw of an image follows from its number. So
sweeps with the same seed, grid and controls have the same draws, and images with the
same number are a pair, whatever else differs.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pandas as pd

from advsearch.extend import InputError, errors, rules, wording, workbench

DRAW_SETTINGS = ("grid", "controls", "samples", "sampler", "seed")
"""Settings that decide which configurations are sampled."""
SIDE_COLUMNS = ("object", "model", "answer")
"""Columns of rows in which sides may differ; "answer" is the adversarial scene."""
SIDE_SETTINGS = ("object", "model")
"""Settings that sides may differ in and that `get_deciding_settings` leaves out."""
SECONDARY_SETTINGS = (
    *DRAW_SETTINGS,
    "label",
    "labels",
    "prompt",
    "up",
    "facing",
    "size",
    "unit",
    "batch",
    "keep_pictures",
    "trials",
    "verify_spp",
    "specialise",
    "value_range",
    "adversarial_of",
)
"""Settings that are not listed as differences: those of the draws, which are equal;
those that follow from the object or the model, such as its label; and those that
change no prediction.
"""

TOLERANCE = 1e-4
"""Largest difference of equal values, relative to the largest value of the column.
Values come from single precision.
"""


@dataclass(frozen=True, eq=False)
class Side:
    """One of the things that are compared.

    Attributes:
        name: what distinguishes it from the other sides.
        sweep: sweep that has its rows.
        name_by_column: its object, model and adversarial scene, by `SIDE_COLUMNS`.
        rows: one row for each image in order (`StoredSweep.read_rows`), with the
            `number` of the image.
    """

    name: str
    sweep: workbench.StoredSweep
    name_by_column: dict[str, str]
    rows: pd.DataFrame

    @property
    def is_right(self) -> npt.NDArray[np.bool_]:
        """Whether the model is right (n,)."""
        return np.asarray(self.rows["correct"])

    @property
    def varying_parameters(self) -> list[str]:
        """The parameters that have more than one value.

        The columns "model" and "answer", which name the side, are left out.
        """
        names = [
            name for name in self.rows.attrs["units"] if name not in ("model", "answer")
        ]
        return [name for name in names if self.rows[name].nunique() > 1]


def read_sides(paths: Sequence[Path]) -> list[Side]:
    """Read the sides that sweeps compare, each with a different name.

    A sweep has a side for each of its models. The sweep of an adversarial scene has two
    sides for each model: the clean scene and the adversarial one. If several sweeps are
    compared, the clean ones are left out. So is an image if the object is out of view
    in any side.

    Raises:
        FileFormatError: a folder has another run, or a sweep that has not ended.
        InputError: there is nothing to compare, or the sweeps sampled different scenes.
    """
    sides = [
        side
        for folder in paths
        for side in read_sweep_sides(folder, is_only_sweep=len(paths) == 1)
    ]
    _check_can_be_compared(sides, paths[0])
    for side in sides[1:]:
        check_same_draws(sides[0], side)
    return _select_in_view(sides, name_sides(sides), paths[0])


def _check_can_be_compared(sides: Sequence[Side], path: Path) -> None:
    """Check that there are at least two sides; `path` is the first sweep.

    Raises:
        InputError: there is only one.
    """
    if len(sides) < 2:
        raise InputError(
            "compared: expected a sweep of several models, or several sweeps, got "
            f"{path}, a sweep of one model; "
            "name another sweep of the same draws beside it, or give `model` two "
            "models when you sweep"
        )


def _select_in_view(
    sides: Sequence[Side], names: Sequence[str], path: Path
) -> list[Side]:
    """Return named sides without the images in which the object is out of view.

    An image is left out of all sides if the object is out of view in any of them.

    Args:
        sides: sides with the same images, in the same order.
        names: name of each side.
        path: run directory of the first sweep, for the message.

    Raises:
        InputError: no image has the object in all sides.
    """
    in_view = np.logical_and.reduce([rules.is_in_view(side.rows) for side in sides])
    if not in_view.any():
        raise InputError(
            f"compared: expected pictures with the object in them, got none in {path}"
        )
    return [
        replace(side, name=name, rows=side.rows[in_view].reset_index(drop=True))
        for side, name in zip(sides, names, strict=True)
    ]


def name_sides(sides: Sequence[Side]) -> list[str]:
    """Return a different name for each side.

    A name lists the values of the columns in which the sides differ, for example the
    model. If some names are still equal, the directory of the sweep precedes them, and
    if that is not enough, a number.
    """
    columns = _find_different_columns(sides)
    names = [_join_labels(side, columns) for side in sides]
    if len(set(names)) < len(names):
        # All names are empty if the sides differ in no column.
        folders = [side.sweep.folder.name for side in sides]
        names = [
            f"{folder}, {name}" if name else folder
            for folder, name in zip(folders, names, strict=True)
        ]
    if len(set(names)) < len(names):
        names = [f"{number}: {name}" for number, name in enumerate(names, start=1)]
    return names


def _join_labels(side: Side, columns: Sequence[str]) -> str:
    """Return the values of columns of a side, separated by commas."""
    # The label is empty for the clean scene, which has no adversarial run.
    labels = [
        wording.shorten_names(side.name_by_column[column]) or "as it is"
        for column in columns
    ]
    return ", ".join(labels)


def _find_different_columns(sides: Sequence[Side]) -> list[str]:
    """Return the names of `SIDE_COLUMNS` in which sides differ."""
    return [
        column
        for column in SIDE_COLUMNS
        if len({side.name_by_column[column] for side in sides}) > 1
    ]


def read_sweep_sides(path: Path, *, is_only_sweep: bool) -> Iterator[Side]:
    """Yield the sides of one sweep, which have no names yet.

    A side has the rows of one model and one scene. If the sweep has an adversarial
    scene and is the only one, its clean scene comes first and its adversarial scene
    second. If other sweeps are compared, too, only the adversarial scene is yielded.

    Args:
        path: the run directory of the sweep.
        is_only_sweep: whether no other sweep is compared.

    Raises:
        FileFormatError: the sweep has not ended, or lacks rows.
    """
    sweep, rows = _read_finished_sweep(path)
    models = sweep.config.models
    # Rows of one image follow each other, one for each model.
    model_index = rows["step"] % len(models)
    rows["number"] = rows["step"] // len(models)
    rows["correct"] = rows["correct"] == 1
    for is_of_scene in _make_scene_masks(sweep, rows, is_only_sweep):
        for index, model in enumerate(models):
            is_of_side = is_of_scene & (model_index == index)
            side_rows = rows[is_of_side].reset_index(drop=True)
            labels = _label_rows(side_rows, sweep.summary.object, model)
            yield Side(name="", sweep=sweep, name_by_column=labels, rows=side_rows)


def _make_scene_masks(
    sweep: workbench.StoredSweep, rows: pd.DataFrame, is_only_sweep: bool
) -> list[pd.Series]:
    """Return the masks of the rows of each scene: the clean one and the adversarial one.

    Without an adversarial scene there is one mask, which selects all rows.

    Args:
        sweep: the sweep.
        rows: its rows, with the `number` of each image.
        is_only_sweep: whether no other sweep is compared; else the clean scene is left
            out.
    """
    if not sweep.config.adversarial_of:
        return [rows["number"] >= 0]
    # The second half of the images are of the adversarial scene.
    n_images = sweep.summary.planned // len(sweep.config.models)
    is_adversarial = rows["number"] >= n_images // 2
    return [~is_adversarial, is_adversarial] if is_only_sweep else [is_adversarial]


def _label_rows(rows: pd.DataFrame, object_names: str, model: str) -> dict[str, str]:
    """Return the object, the model and the adversarial scene of rows, by column.

    Rows have one of these columns only if it has several values. The values are joined,
    since an object may vary within one side.

    Args:
        rows: the rows.
        object_names: object of the sweep.
        model: model of the rows.
    """
    labels = {"object": object_names, "model": model, "answer": ""}
    for column in SIDE_COLUMNS:
        if column in rows:
            labels[column] = ",".join(rows[column].unique())
    return labels


def _read_finished_sweep(path: Path) -> tuple[workbench.StoredSweep, pd.DataFrame]:
    """Read a sweep and its rows.

    Raises:
        FileFormatError: the sweep has not ended, or lacks rows.
    """
    sweep = workbench.StoredSweep.read(path)
    summary = sweep.summary
    if summary.is_unfinished or summary.looked_at != summary.planned:
        raise errors.FileFormatError(
            f"{path}: expected a sweep that has ended, got one with "
            f"{summary.looked_at} of {summary.planned} "
            f"predictions; go on with it: advsearch resume {path}"
        )
    rows = sweep.read_rows()
    _check_complete(path, rows, summary.planned)
    return sweep, rows


def _check_complete(path: Path, rows: pd.DataFrame, n_planned: int) -> None:
    """Check that a sweep has all of its rows, each once.

    Args:
        path: the run directory of the sweep, for the message.
        rows: its rows.
        n_planned: number of rows that its summary states.

    Raises:
        FileFormatError: it has more or fewer, or a row twice.
    """
    if len(rows) != n_planned or not rows["step"].is_unique:
        raise errors.FileFormatError(
            f"{path}: expected {n_planned} rows, as its summary says, got "
            f"{len(rows)}; sweep again"
        )


def check_same_draws(first: Side, second: Side) -> None:
    """Check that the sweeps of two sides sampled the same scenes.

    Settings of the sampling and the number of images have to be equal. If both have the
    same object, the values of all sampled parameters that both have are compared, too.

    Raises:
        InputError: they sampled different scenes.
    """
    if first.sweep.folder == second.sweep.folder:
        return
    where = f"{first.sweep.folder} and {second.sweep.folder}"
    _check_same_draw_settings(first, second, where)
    if len(first.rows) != len(second.rows):
        raise InputError(
            f"compared: expected sweeps with as many pictures, got {len(first.rows)} "
            f"and {len(second.rows)} in "
            f"{where}; sweep as many objects and environments in both"
        )
    if first.name_by_column["object"] != second.name_by_column["object"]:
        return  # the values may differ, as default ranges may follow from the object
    _check_same_sampled_values(first, second, where)


def _check_same_draw_settings(first: Side, second: Side, where: str) -> None:
    """Check that two sides have the same settings of the sampling.

    Args:
        first, second: the sides.
        where: the directories of their sweeps, for the message.

    Raises:
        InputError: a setting differs.
    """
    first_settings = first.sweep.config.get_deciding_settings()
    second_settings = second.sweep.config.get_deciding_settings()
    for name in DRAW_SETTINGS:
        if first_settings[name] != second_settings[name]:
            raise InputError(
                f"compared: expected sweeps of the same draws, got {where}, whose "
                f"`{name}` differ; sweep one of them "
                "again with the settings of the other"
            )


def _check_same_sampled_values(first: Side, second: Side, where: str) -> None:
    """Check that the sampled parameters that two sides both have are equal.

    Args:
        first, second: the sides.
        where: the directories of their sweeps, for the message.

    Raises:
        InputError: a parameter has other values.
    """
    # The keys of "units" are the names of the parameters.
    for name in first.rows.attrs["units"]:
        # names of what is compared, or of scenes, and no sampled values
        names_side_or_scene = name in (*SIDE_COLUMNS, "environment")
        is_shared = name in second.rows.attrs["units"]
        if names_side_or_scene or not is_shared:
            continue
        if not has_same_values(first.rows[name], second.rows[name]):
            raise InputError(
                f"compared: expected sweeps of the same draws, got {where} with other "
                f"values of {name}; sweep both again"
            )


def has_same_values(first: pd.Series, second: pd.Series) -> bool:
    """Return whether two columns (n,) are equal up to single precision."""
    if first.dtype == "category" or second.dtype == "category":
        return bool((first.astype(object) == second.astype(object)).all())
    scale = float(np.nanmax(np.abs(first), initial=0.0))
    return bool(
        np.allclose(first, second, rtol=0.0, atol=TOLERANCE * scale, equal_nan=True)
    )


def find_different_settings(sides: Sequence[Side]) -> list[str]:
    """Return the names of settings that decide predictions and differ between sides.

    Two sweeps differ in settings; two models of one sweep differ in a column of their
    rows. `SECONDARY_SETTINGS` are left out.
    """
    # All sweeps have the same names of settings.
    first, *others = (side.sweep.config.get_deciding_settings() for side in sides)
    differing_settings = {
        name for other in others for name in other if other[name] != first[name]
    }
    # These settings are not among those that `get_deciding_settings` returns.
    differing_settings |= {
        name
        for name in SIDE_SETTINGS
        if len({getattr(side.sweep.config, name) for side in sides}) > 1
    }
    names = differing_settings | set(_find_different_columns(sides))
    return sorted(names - set(SECONDARY_SETTINGS))
