"""Read the rows of several sweeps as one table.

A row is one rendered image with its prediction. A draw is one random sample of the
parameters; in a sweep of drives, all frames of a drive are rows of the same draw.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import pandas as pd

from advsearch.extend import rules, wording, workbench

SCENE_SETTINGS = ("object", "environment", "model")
"""Settings of a sweep that become columns of its rows, whether they vary or not."""

EXTENT_SETTINGS = ("samples", "keep_pictures", "surface", "trials", "verify_spp")
"""Settings of a sweep that change neither an image nor its prediction, but only how
many there are or what is stored.
"""


def read_predictions(sweeps: Sequence[workbench.StoredSweep]) -> pd.DataFrame:
    """Read the rows of several sweeps as one frame.

    A longer sweep with the same seed repeats the images of a shorter one; repeated
    images are left out. Names of objects, environments and models are shortened, as in
    figures.

    Returns:
        The rows. The column `sweep` has the index of the sweep. The column `unit` has
        the index of the draw: rows of the same draw, such as the frames of a drive, are
        not independent. The value of a parameter that a sweep does not have is NaN.
        `attrs["units"]` maps each parameter, or scene setting, to its unit of
        measurement.
    """
    frames = [_read_sweep_frame(index, sweep) for index, sweep in enumerate(sweeps)]
    table = pd.concat(frames, ignore_index=True)
    is_repeated = table.duplicated("image")
    table = table[~is_repeated].reset_index(drop=True)
    units = _collect_units(frames)
    _make_names_categories(table, units)
    _, draw_indices = np.unique(table["draw"], return_inverse=True)
    table["unit"] = draw_indices
    table = table.drop(columns=["draw", "image"])
    table["correct"] = (table["correct"] == 1) & rules.is_in_view(table)
    table.attrs["units"] = units
    return table


def _make_names_categories(table: pd.DataFrame, columns: Iterable[str]) -> None:
    """Convert the columns that have names, and not numbers, to categories, in place."""
    for name in columns:
        has_names = not pd.api.types.is_float_dtype(table[name])
        if has_names:
            table[name] = table[name].astype("category")


def _read_sweep_frame(index: int, sweep: workbench.StoredSweep) -> pd.DataFrame:
    """Read the rows of a sweep with columns for its scene.

    The columns "draw" and "image" have the names of the draw and of the image, and
    "sweep" the index of the sweep.

    Args:
        index: index of the sweep.
        sweep: the sweep.
    """
    rows = sweep.read_rows()
    for name in SCENE_SETTINGS:
        if name in rows:
            full_names = rows[name].astype(object)
        else:  # rows have no such column if the setting is the same in all of them
            full_names = pd.Series(getattr(sweep.summary, name), rows.index)
        rows[name] = full_names.map(wording.format_figure_value)
    rows["draw"] = name_draws(sweep, rows)
    rows["image"] = name_images(sweep, rows)
    return rows.assign(sweep=index)


def _collect_units(frames: Sequence[pd.DataFrame]) -> dict[str, str]:
    """Return the unit of each parameter that any of the frames has.

    Object, environment and model are included, with an empty unit.
    """
    units = dict[str, str]()
    for frame in frames:
        units |= frame.attrs["units"]
    return units | dict.fromkeys(SCENE_SETTINGS, "")


def name_draws(sweep: workbench.StoredSweep, rows: pd.DataFrame) -> list[str]:
    """Return a name of the draw of each row (n,): rows of the same draw are dependent.

    Draw k of a seed is the same in all sweeps and all scenes. So it is named by the
    seed and k. A sweep of a grid samples nothing: there, a draw is named by the values
    of its parameters, because rows with the same values differ only in noise. For a
    drive (frames along a path), these are the values of its first frame.

    Args:
        sweep: the sweep.
        rows: its rows; the column `unit` has the index of the draw within the sweep.
    """
    is_sampled = sweep.summary.sampler is not None
    if is_sampled:
        return [f"draw {sweep.config.seed} {draw}" for draw in rows["unit"]]
    # The parameters of rows may include the model and its answer, which do not change
    # the image.
    columns = [
        name
        for name in ("object", "environment", *rows.attrs["units"])
        if name not in ("model", "answer")
    ]
    distinct_columns = list(dict.fromkeys(columns))
    # the first row of each draw: for a drive, its first frame
    first_rows = (
        rows.drop_duplicates("unit").set_index("unit")[distinct_columns].astype(str)
    )
    values_of_draw = first_rows.agg(" ".join, axis=1)
    return [f"values {values_of_draw[draw]}" for draw in rows["unit"]]


def name_images(sweep: workbench.StoredSweep, rows: pd.DataFrame) -> list[str]:
    """Return a name of each row (n,), equal for the same prediction of the same image.

    The name consists of the settings that decide the image, the index of the image in
    its sweep (column `step`), the values, and whether the prediction is right.
    `EXTENT_SETTINGS`, such as the number of samples, are left out: they do not change
    an image.

    Args:
        sweep: the sweep.
        rows: its rows.
    """
    deciding_settings = {
        name: value
        for name, value in sweep.config.get_deciding_settings().items()
        if name not in EXTENT_SETTINGS
    }
    parameters = [name for name in rows.attrs["units"] if name not in SCENE_SETTINGS]
    values = rows[[*SCENE_SETTINGS, *parameters]].astype(str).agg(" ".join, axis=1)
    cells = zip(rows["step"], values, rows["correct"], strict=True)
    return [
        f"{deciding_settings} {step} {text} {correct}" for step, text, correct in cells
    ]


def read_values(rows: pd.DataFrame, index: int) -> dict[str, float | str]:
    """Return the values of the parameters of a row by name, without missing values.

    Args:
        rows: rows as `read_predictions` returns them.
        index: index of the row.
    """
    values = rows.loc[index, list(rows.attrs["units"])].dropna().items()
    return {
        name: value if isinstance(value, str) else float(value)
        for name, value in values
    }
