"""Read the rows of a run as a pandas frame, and find out which rows are independent."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, replace
from itertools import islice
from math import prod
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
import numpy.typing as npt
import pandas as pd
from pydantic import Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from advsearch.errors import FileFormatError
from advsearch.options import NOT_A_NUMBER, get_outcome
from advsearch.runs.export import iterate_values, list_columns, make_record
from advsearch.runs.store import NAME, Row, Store

# --------------------------------------------------------------------------------
# Which rows of a sweep are independent: those of different *units*. A unit has the rows of
# one draw: those of a drive with all its frames, or of one picture, by all models and, if
# both are swept, without and with the adversarial scene of a run. If nothing is sampled,
# the samples of a point of the grid differ only in noise, and are one unit. With a folder
# of photographs, all pictures in one photograph are one unit.

UNITS_NOTE = "units"  # the note of a run with its `Units`
PICTURE = "picture"
CONFIGURATION = "configuration"
DRIVE = "drive"
PHOTOGRAPH = "photograph"

Number = TypeVar("Number", int, npt.NDArray[np.int64])

MAX_AXES = 1024
# Maximum number of rows of a sweep. Numbers of rows are int64.
MAX_ROWS = 1 << 62
Count = Annotated[int, Field(strict=True, ge=1, le=MAX_ROWS)]


@dataclass(frozen=True)
class Units:
    """Which rows of a sweep belong to one unit, that is, are not independent.

    A draw is a sampled configuration. The images of a draw form a unit: its frames, its
    repetitions with other noise, and its image with the adversarial scene. If scenes
    are rendered into the photographs of a folder, all images of a photograph form a
    unit.

    Attributes:
        sizes: number of values along each axis of the grid; the last one varies
            fastest.
        frames: index of the axis whose values are the frames of a drive; None without.
        samples: number of draws at each point of the grid.
        models: number of models, each of which has a row for every image.
        again: number of images after which the same draws are repeated with the
            adversarial scene; 0 if they are not.
        noise: number of images of each draw that differ only in noise.
        photographs: number of photographs of a folder, into which the scenes are
            rendered in turn; 1 without a folder.
        scene: number of images of each scene; only used with a folder.
    """

    sizes: Annotated[tuple[Count, ...], Field(max_length=MAX_AXES)] = ()
    frames: Annotated[int, Field(strict=True, ge=0)] | None = None
    samples: Count = 1
    models: Count = 1
    again: Annotated[int, Field(strict=True, ge=0, le=MAX_ROWS)] = 0
    noise: Count = 1
    photographs: Count = 1
    scene: Count = 1

    @property
    def size(self) -> int:
        """Number of rows of a unit; with a folder, of one scene in a photograph.

        Each image has a row for each model. With `again`, there are two images: without
        and with the adversarial scene.
        """
        n_arms = 2 if self.again else 1
        if self.photographs > 1:
            return self.models * n_arms * self.scene
        n_frames = 1 if self.frames is None else self.sizes[self.frames]
        return self.models * n_arms * n_frames * self.noise

    @property
    def name(self) -> str:
        """The name of a unit in texts."""
        if self.photographs > 1:
            return PHOTOGRAPH
        if self.frames is not None and self.sizes[self.frames] > 1:
            return DRIVE
        # With repetitions, a unit has several images of one configuration.
        return CONFIGURATION if self.noise > 1 else PICTURE

    def find_unit(self, step: Number) -> Number:
        """Return the number of the unit of a row, or of rows (n,), by their steps."""
        return self.find_cluster(step // self.models)

    def find_cluster(self, image_index: Number) -> Number:
        """Return the number of the unit (cluster) to which an image belongs.

        It is the number of its photograph or, without a folder of photographs, of its
        draw.

        Args:
            image_index: index of the image in the sweep, or an array of indices.
        """
        # Each scene has `scene` images, all in one photograph. The photographs are used
        # in turn.
        if self.photographs > 1:
            scene_index = image_index // self.scene
            return scene_index % self.photographs
        return self.find_draw(image_index)

    def find_draw(self, image_index: Number) -> Number:
        """Return the number of the draw that a picture comes from.

        All frames of a drive, all pictures that differ in noise alone, and the pictures
        with and without an adversarial scene are of one draw.

        Args:
            image_index: index of the image in the sweep, or an array of indices.
        """
        # The second half repeats the draws with the adversarial scene.
        if self.again:
            image_index = image_index % self.again
        draw = image_index // self.noise  # `noise` consecutive images have one draw
        if self.frames is None:
            return draw
        # Draws are numbered by point of the grid, then by sample.
        point = draw // self.samples
        sample = draw % self.samples
        return self._leave_out_frame(point, self.frames) * self.samples + sample

    def _leave_out_frame(self, point: Number, frame_axis: int) -> Number:
        """Return a number of a point of the grid that all frames of its drive share.

        A point has an index along each axis, the last one fastest, so its number is
        (index_before * n_frames + frame) * n_after + index_after.

        Args:
            point: number of the point in the sweep, or an array of numbers.
            frame_axis: index of the axis of the frames.
        """
        n_frames = self.sizes[frame_axis]
        n_after = prod(self.sizes[frame_axis + 1 :])  # points along the axes after
        # The index along the axes before also counts scenes, as an axis before all.
        index_before = point // (n_frames * n_after)
        index_after = point % n_after
        return index_before * n_after + index_after


def read_units(store: Store, *, is_sampled: bool = True) -> Units | None:
    """Return which rows of a run are not independent, as the run has noted it.

    Args:
        store: store of the run.
        is_sampled: whether something was sampled at random. If not, the samples in the
            note of an older version differ only in noise, and count as such.

    Returns:
        The units; None if the run has not noted any.

    Raises:
        FileFormatError: the note has impossible values.
    """
    noted = store.read_json_note(UNITS_NOTE)
    if noted is None:
        return None
    with suppress(ValidationError):
        units = TypeAdapter(Units).validate_python(noted)
        # Runs of older versions have no `noise`. If nothing is sampled, their samples
        # are repetitions with other noise.
        if not is_sampled and units.noise == 1:
            units = replace(units, samples=1, noise=units.samples)
        if _are_possible(units):
            return units
    raise FileFormatError(
        f"{store.path}: expected the units of a sweep, got {str(noted)[:80]}"
    )


def _are_possible(units: Units) -> bool:
    """Return whether the frames are an axis, and all numbers fit into int64."""
    is_frame_axis_valid = units.frames is None or units.frames < len(units.sizes)
    n_rows = prod(units.sizes) * units.samples * units.noise * units.models
    n_photograph_images = units.photographs * units.scene
    are_counts_valid = max(n_rows, n_photograph_images) <= MAX_ROWS
    return is_frame_axis_valid and are_counts_valid


KIND = "sweep"  # rows of the sweep itself
EDGES_NOTE = "parts of ranges"
"""The note of a run with the edges of the intervals into which the range of each
sampled parameter is divided, by name of the parameter.
"""

FIXED_COLUMNS = (
    "id",
    "step",
    "correct",
    "margin",
    "probability",
    "seconds",
    "label",
    "outcome",
)
"""Columns of a sweep's frame before those of its parameters. `unit` is the last one."""
# Number of rows that are converted at a time, so that a million rows fit into memory.
CHUNK_ROWS = 10_000
# names that a parameter cannot have in a frame
RESERVED_NAMES = {*(field.name for field in fields(Row)), "unit", "outcome"}


def to_pandas(rows: Iterable[Row]) -> pd.DataFrame:
    """Return rows as a pandas frame with the columns of an export.

    Columns are named without units: a value is called ``pose.yaw``, and
    ``attrs["units"]["pose.yaw"]`` is "degrees".
    """
    row_list = list(rows)
    names = {column: column.partition(" [")[0] for column in list_columns(row_list)}
    records = [
        {names[name]: value for name, value in make_record(row).items()}
        for row in row_list
    ]
    frame = pd.DataFrame(records, columns=list(names.values()))
    # a column with a unit is called "NAME [UNIT]" in an export
    frame.attrs["units"] = {
        plain_name: column.removeprefix(f"{plain_name} [").removesuffix("]")
        for column, plain_name in names.items()
        if plain_name != column
    }
    return frame


def read_sweep(
    run: Path,
    after: int = 0,
    max_rows: int | None = None,
    extra_columns: Callable[[Row], Mapping[str, float]] | None = None,
    *,
    is_sampled: bool = True,
) -> pd.DataFrame:
    """Return the rows of a sweep as a pandas frame.

    The columns are those of `make_sweep_frame`. Rows with the same number in the column
    `unit` are not independent (`Units`). ``attrs["unit name"]`` states what a unit is,
    such as "drive", and ``attrs["edges"]`` where the range of each sampled parameter is
    divided.

    Args:
        run: folder of the run.
        after: only rows with a larger id.
        max_rows: maximum number of rows; None for all.
        extra_columns: function that returns more columns of a row.
        is_sampled: whether something was sampled at random, see `read_units`.

    Raises:
        FileFormatError: the results cannot be read.
    """
    with Store(run / NAME, read_only=True) as store:
        rows = islice(store.rows(KIND, after=after), max_rows)
        frame = make_sweep_frame(rows, extra_columns)
        noted = store.read_json_note(EDGES_NOTE)
        units = read_units(store, is_sampled=is_sampled)
    frame.attrs["unit name"] = PICTURE
    if units is not None:  # otherwise each row is a unit, as `make_sweep_frame` set it
        frame.attrs["unit name"] = units.name
        frame["unit"] = units.find_unit(frame["step"].to_numpy())
    # `make_sweep_frame` has set it to an empty mapping
    frame.attrs["edges"] |= _parse_edges(noted)
    return frame


def _parse_edges(noted: Any) -> dict[str, list[float]]:
    """Return where the range of each parameter is divided, as a run has noted it.

    Args:
        noted: the note, such as {"camera.azimuth": [0, 120, 240, 360]}. What has
            another form is left out, as the file may come from somebody else.
    """
    edges_by_name = {}
    for name, edges in noted.items() if isinstance(noted, dict) else ():
        is_list = isinstance(edges, list) and len(edges) > 1
        if is_list and all(isinstance(edge, (int, float)) for edge in edges):
            edges_by_name[name] = list(map(float, edges))
    return edges_by_name


def make_sweep_frame(
    rows: Iterable[Row],
    extra_columns: Callable[[Row], Mapping[str, float]] | None = None,
) -> pd.DataFrame:
    """Return rows of a sweep as a pandas frame.

    Its columns are `FIXED_COLUMNS`, one for each parameter, those of `extra_columns`,
    and `unit`. Rows with the same value of `unit` are not independent; here it is the
    step, so that all rows are. Numbers are float64, and NaN if a row has none.
    `correct` is 1 or 0, and NaN if the row was not judged. Columns with texts are
    categories, in the order in which these occur: `label`, `outcome` (of
    `options.Outcome`, or ""), and parameters of which any value is a text. A row
    without a value has the category "none". A parameter of several numbers has a
    column for each, such as ``camera.target[0]``. ``attrs["units"]`` has the units of
    measurement by column. ``attrs["edges"]`` is empty; `read_sweep` fills it.

    Args:
        rows: rows of the sweep.
        extra_columns: function that returns more columns of a row.
    """
    # units of measurement by column, which `_make_cells` fills while `cells` is
    # iterated
    units = dict[str, str]()
    get_extra_columns: Callable[[Row], Mapping[str, float]]
    get_extra_columns = extra_columns or (lambda row: {})
    cells = (
        {**_make_cells(row, number, units), **get_extra_columns(row)}
        for number, row in enumerate(rows, 1)
    )
    frame = _make_joined_frame(cells)
    for name in frame.select_dtypes("object"):
        frame[name] = _to_categories(frame[name])
    frame = frame.astype({"id": np.int64, "step": np.int64})
    frame["unit"] = frame["step"]
    frame.attrs |= {"units": units, "edges": {}}
    return frame


def _make_joined_frame(cells: Iterator[Mapping[str, Any]]) -> pd.DataFrame:
    """Return rows of cells as a frame, made in chunks of `CHUNK_ROWS` rows.

    A list of all cells would take far more memory than the frame.
    """
    frames = list[pd.DataFrame]()
    while chunk := list(islice(cells, CHUNK_ROWS)):
        frames.append(_make_chunk_frame(chunk))
    if frames:
        return pd.concat(frames, ignore_index=True)
    return pd.DataFrame(dict.fromkeys(FIXED_COLUMNS, np.zeros(0)))


def _make_chunk_frame(cells: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Return rows of cells as a frame whose columns without texts are float64.

    Columns with a text stay objects: they become categories when all rows are joined.
    """
    frame = pd.DataFrame(cells, dtype=object)
    number_columns = [name for name in frame if not frame[name].map(type).eq(str).any()]
    return frame.astype(dict.fromkeys(number_columns, float))


def _make_cells(row: Row, number: int, units: dict[str, str]) -> dict[str, Any]:
    """Return the values of a row by column.

    Args:
        row: the row.
        number: number of the row from 1, which is its id if it has none.
        units: units of measurement by column, to which those of the row's parameters
            are added.
    """
    outcome = get_outcome(row.payload)
    # in the order of `FIXED_COLUMNS`
    fixed_values = (
        row.id or number,
        row.step,
        row.correct,
        row.margin,
        row.probability,
        row.seconds,
        _find_row_label(row),
        "" if outcome is None else outcome.value,
    )
    fixed_cells = dict(zip(FIXED_COLUMNS, fixed_values, strict=True))
    return {**fixed_cells, **_make_parameter_cells(row, units)}


def _make_parameter_cells(row: Row, units: dict[str, str]) -> dict[str, Any]:
    """Return the values of the parameters of a row by column.

    Args:
        row: the row.
        units: units of measurement by column, to which those of the row are added.
    """
    cells: dict[str, Any] = {}
    for name, described in row.values.items():
        # The name of a parameter may be that of another column.
        parameter_name = f"parameter {name}" if name in RESERVED_NAMES else name
        for column, value, unit in iterate_values({parameter_name: described}):
            units.setdefault(column, unit)
            if isinstance(value, str):
                value = sys.intern(value)  # equal texts of many rows share their memory
            cells[column] = value
    return cells


def _find_row_label(row: Row) -> str:
    """Return the label of a row, or a text for one that has none."""
    if row.label:
        return row.label
    # If the prediction was evaluated, the output of the model was NaN or infinite.
    return "" if row.correct is None else NOT_A_NUMBER


def _to_categories(column: pd.Series) -> pd.Categorical:
    """Return a column with texts as a column of categories.

    Categories are the texts in the order in which they occur, followed by the numbers
    among them, as texts.
    """
    texts = list(map(_as_category, column))
    names = [value for value in column if isinstance(value, str)]
    return pd.Categorical(texts, categories=list(dict.fromkeys([*names, *texts])))


def _as_category(value: Any) -> str:
    """Return a name as it is, ``none`` for nothing, and a number as text."""
    if isinstance(value, str):
        return value
    return "none" if pd.isna(value) else f"{float(value):g}"
