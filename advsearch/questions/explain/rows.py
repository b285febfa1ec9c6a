"""Read the rows of several sweeps as one table."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from advsearch.extend import rules, wording, workbench

SCENE_SETTINGS = ("object", "environment", "model")
"""Settings of a sweep that its rows have as columns, whether they vary or not."""

EXTENT_SETTINGS = ("samples", "keep_pictures", "surface", "trials", "verify_spp")
"""Settings of a sweep that change neither the image with a number nor its
prediction.
"""


def read_predictions(sweeps: Sequence[workbench.StoredSweep]) -> pd.DataFrame:
    """Read the rows of several sweeps as one frame.

    The column `sweep` has the index of the sweep, and `unit` the index of the draw:
    rows of the same draw are not independent. A longer sweep with the same seed repeats
    the images of a shorter one; such repeats are left out. Object, environment and
    model are shortened to the names that figures show. Parameters that a sweep does not
    have are missing values (NaN).
    """
    frames = []
    for index, sweep in enumerate(sweeps):
        rows = sweep.read_rows()
        for name in SCENE_SETTINGS:
            if name in rows:
                full_names = rows[name].astype(object)
            else:  # the same in all rows
                full_names = pd.Series(getattr(sweep.summary, name), rows.index)
            rows[name] = full_names.map(wording.format_figure_value)
        rows["draw"] = name_draws(sweep, rows)
        rows["image"] = name_images(sweep, rows)
        frames.append(rows.assign(sweep=index))

    table = pd.concat(frames, ignore_index=True)
    is_repeated = table.duplicated("image")
    table = table[~is_repeated].reset_index(drop=True)
    units = _collect_units(frames)
    for name in units:
        if not pd.api.types.is_float_dtype(table[name]):
            table[name] = table[name].astype("category")
    # the number of each distinct draw
    table["unit"] = np.unique(table["draw"], return_inverse=True)[1]
    table = table.drop(columns=["draw", "image"])
    table["correct"] = (table["correct"] == 1) & rules.is_in_view(table)
    table.attrs["units"] = units
    return table


def _collect_units(frames: Sequence[pd.DataFrame]) -> dict[str, str]:
    """Return the unit of each parameter that any of the frames has.

    Object, environment and model are among them, without a unit.
    """
    units = dict[str, str]()
    for frame in frames:
        units |= frame.attrs["units"]
    return units | dict.fromkeys(SCENE_SETTINGS, "")


def name_draws(sweep: workbench.StoredSweep, rows: pd.DataFrame) -> list[str]:
    """Return a name of the draw of each row (n,): rows of the same draw are dependent.

    Draw k of a seed is the same in all sweeps and all scenes, so that it is named by
    seed and number. If nothing is drawn by chance, rows with the same values differ in
    noise alone, and share a name, which consists of these values. The rows of a drive
    are named by the values of its first frame.

    Args:
        sweep: the sweep.
        rows: its rows.
    """
    is_sampled = sweep.summary.sampler is not None
    if is_sampled:
        return [f"draw {sweep.config.seed} {unit}" for unit in rows["unit"]]
    # all that decides an image, but not what is predicted of it
    columns = [
        name
        for name in ("object", "environment", *rows.attrs["units"])
        if name not in ("model", "answer")
    ]
    # a drive is named by the values of its first frame
    first_rows = (
        rows.drop_duplicates("unit")
        .set_index("unit")[list(dict.fromkeys(columns))]
        .astype(str)
    )
    values_of_unit = first_rows.agg(" ".join, axis=1)
    return [f"values {values_of_unit[unit]}" for unit in rows["unit"]]


def name_images(sweep: workbench.StoredSweep, rows: pd.DataFrame) -> list[str]:
    """Return a name of each row (n,), equal for the same prediction of the same image.

    The name consists of the settings that decide the image, the number of the row, the
    values, and whether the prediction is right. `EXTENT_SETTINGS`, such as the number
    of samples, are left out: they do not change an image.

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
    """Return the values of the parameters that a row has, by name."""
    values = rows.loc[index, list(rows.attrs["units"])].dropna().items()
    return {
        name: value if isinstance(value, str) else float(value)
        for name, value in values
    }
