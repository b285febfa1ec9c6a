"""Rates of a sweep over full drives, and the worst of them.

A drive is one combination of all that varies but the time: its frames are the images
along a path. Frames are not independent, so intervals are over drives. They hold for
any number of drives, since each value has bounds that are known from the plan
(`attacks.trials`). If nothing is sampled, the samples of a drive differ only in noise:
they count as one drive, whose values are their means.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from advsearch.controls import Control
from advsearch.engine.naming import make_configured_controls
from advsearch.options import OUT_OF_VIEW
from advsearch.questions.attack.result import save_drive, select_evenly
from advsearch.questions.sweep.axes import Axis, SceneConfigurations
from advsearch.questions.sweep.job import Job, SceneLoader
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.questions.sweep.summary import (
    DriveRates,
    DriveRecord,
    OverDrives,
    TrackRates,
)
from advsearch.questions.sweep.tracks import (
    DetectedFrame,
    Tracker,
    read_frame,
    track_drive,
)
from advsearch.report.figures import draw_marks
from advsearch.runs.directory import RunDirectory
from advsearch.runs.store import Row
from advsearch.runs.tables import Units
from advsearch.statistics.clustered import mean_interval, sum_per_unit
from advsearch.tasks import Detection
from advsearch.tasks.boxes import MIN_OVERLAP

MAX_ANIMATED_FRAMES = 60
MAX_LISTED_DRIVES = 1000  # drives of a model that a result lists
# values of a model's flag of a frame
WRONG = 0
RIGHT = 1
UNKNOWN = -1  # there is no row
HIDDEN = 2  # nothing of the object is in the image
Flags = npt.NDArray[np.int8]


def add_frame_axis(
    config: SweepConfig, sampled: tuple[Control, ...]
) -> tuple[tuple[Control, ...], dict[str, object]]:
    """Return the controls and the grid of a sweep over the frames of a path.

    A control that travels along the path is added if there is none. If there are
    several paths, they become the first axis of the grid, unless the path is in the
    grid, set or sampled. The times of the frames become the last axis, unless the grid
    has them already. They go from 0 to the end of the path, with `fps` frames a second
    and at least two frames.

    Args:
        config: settings with a `path`.
        sampled: the controls that are sampled.

    Returns:
        The controls that are sampled, with the added one, and the grid.
    """
    travelling: Any = next((control for control in sampled if control.travels), None)
    if travelling is None:
        # the control "path" with its defaults
        (travelling,) = make_configured_controls(config, {"path": {}})
        sampled = (*sampled, travelling)
    grid = config.grid
    time_name = f"{travelling.name}.time"
    if time_name not in grid:
        grid = {**grid, time_name: _make_frame_range(travelling.seconds, config.fps)}
    return sampled, {**_make_path_axis(config, travelling), **grid}


def _make_path_axis(config: SweepConfig, travelling: Any) -> dict[str, object]:
    """Return the axis of the paths among which a control can choose, by its name.

    There is none if the path is in the grid, set or sampled, or if there is one path.

    Args:
        config: the settings.
        travelling: the control that travels.
    """
    path_name = f"{travelling.name}.{Control.PATH_PARAMETER}"
    is_path_in_grid = path_name in config.grid
    is_path_set = Control.PATH_PARAMETER in travelling.specs
    is_sampled = config.samples is not None
    if is_path_in_grid or is_path_set or is_sampled:
        return {}
    paths = _list_paths(travelling)
    return {path_name: paths} if paths else {}


def _make_frame_range(seconds: float, fps: float) -> str:
    """Return the times of the frames of a path as a range FIRST:LAST:COUNT.

    Args:
        seconds: seconds from the first point of the path to its end.
        fps: frames a second.
    """
    n_frames = round(seconds * fps) + 1  # both ends have a frame
    n_frames = max(2, n_frames)
    return f"0:{seconds:g}:{n_frames}"


def _list_paths(travelling: Any) -> list[Any]:
    """Return the paths among which a control can choose; none if it has a single one."""
    for parameter in travelling.instance_parameters:
        if parameter.name == Control.PATH_PARAMETER:
            return list(parameter.options)
    return []


def find_time_axis(axes: Sequence[Axis]) -> int | None:
    """Return the index of the axis whose values are frames.

    None if there is none, or a single frame.
    """
    for index, axis in enumerate(axes):
        if axis.is_time and len(axis.values) > 1:
            return index
    return None


def compute_distance_bounds(job: Job, axis: Axis) -> tuple[float, float] | None:
    """Return the nearest and the farthest distance that a drive of a sweep can have.

    The bounds do not depend on which drives were sampled: they are over all possible
    paths, all times of the axis, and all scenes. The interval of the mean distance
    needs such bounds.

    Args:
        job: the sweep.
        axis: the time of the control that travels.

    Returns:
        The smallest and the largest distance in the unit of the rows; None if the
        control that travels does not state distances.
    """
    times = torch.tensor([float(value) for value in axis.values])
    lowest = math.inf
    highest = -math.inf
    for scene in range(len(job.scenes)):
        for configurations in job.load_configurations_by_size(scene).values():
            control = _find_travelling_control(configurations, axis)
            if control is None:
                return None
            # over all paths that the control can take
            distances = control.compute_distances(times)
            lowest = min(lowest, float(distances.min()))
            highest = max(highest, float(distances.max()))
    return lowest, highest


def _find_travelling_control(configurations: SceneConfigurations, axis: Axis) -> Any:
    """Return the control of an axis, bound to a scene; None if it does not travel."""
    controls = {control.name: control for control in configurations.space.controls}
    control = controls.get(axis.control_name)
    return control if control is not None and control.travels else None


class _CompleteDrives(NamedTuple):
    """The n drives whose frames are all known and that show the object in some frame.

    Attributes:
        outcomes: (n, frames) RIGHT, WRONG or HIDDEN.
        distance: (n, frames) distance of the object; NaN if unknown.
        row_numbers: (n, frames) numbers of the rows.
    """

    outcomes: Flags
    distance: npt.NDArray[np.float64]
    row_numbers: npt.NDArray[np.int64]


class Drives:
    """The frames of every drive of a sweep.

    The private arrays `_outcomes` (WRONG, RIGHT, ...) and `_row_numbers` (numbers of
    the rows) have the axes (scenes, axes of the grid without the time ..., samples,
    models, frames), with the frames in the order of their times. `_distance` has no axis for
    models, since all get the same images. `_path_of_step` has the name of the path of a
    row, and `_frame_of_step` its detected boxes; the keys are numbers of rows.

    Attributes:
        times: (frames,) times in seconds, ascending.
        seconds: seconds from the first frame to the last.
    """

    _units = Units()
    # Bounds come from the plan. The smallest and largest of the sampled distances do
    # not bound the others that could have been sampled.
    _distance_bounds: tuple[float, float] | None = None

    def __init__(self, job: Job, rows: Iterable[Row]) -> None:
        """Sort the rows of a sweep over frames into drives.

        Args:
            job: the sweep, with an axis of times.
            rows: its rows so far.
        """
        time_index = find_time_axis(job.axes)
        assert time_index is not None
        self._job = job
        time_axis = job.axes[time_index]
        self._units = _find_independent_units(job)
        self._distance_bounds = compute_distance_bounds(job, time_axis)
        shape = _find_shape_of_rows(job)
        flags: Flags = np.full(shape, UNKNOWN, np.int8)
        # All models get the same image, so there is no axis for models.
        distance = np.full(shape[:-1], np.nan)
        self._path_of_step: dict[int, str] = {}
        self._frame_of_step: dict[int, DetectedFrame] = {}
        self._distance_unit = "object sizes"
        # fills `flags` and `distance`, and the attributes above
        self._read_rows(rows, time_axis.control_name, flags, distance)
        self._set_frames_in_order(flags, distance, time_index)

    def _set_frames_in_order(
        self, flags: Flags, distance: npt.NDArray[np.float64], time_index: int
    ) -> None:
        """Set the times, and the arrays with the frames in the order of their times.

        Args:
            flags: (scenes, axes of the grid ..., samples, models) flags of the rows.
            distance: the same shape without models, distances of the images.
            time_index: index of the time among the axes of the grid.
        """
        time_values = self._job.axes[time_index].values
        times = np.array([float(value) for value in time_values])
        order = np.argsort(times)
        self.times = times[order]
        self.seconds = float(self.times[-1] - self.times[0])  # of one drive
        row_numbers = np.arange(flags.size).reshape(flags.shape)
        self._outcomes = _move_frames_last(flags, time_index, order)
        self._row_numbers = _move_frames_last(row_numbers, time_index, order)
        self._distance = _move_frames_last(distance, time_index, order)

    def _read_rows(
        self,
        rows: Iterable[Row],
        instance: str,
        flags: Flags,
        distance: npt.NDArray[np.float64],
    ) -> None:
        """Fill arrays with the flags and the distances of rows.

        Detected boxes, the names of paths and the unit of distances are stored in
        attributes.

        Args:
            rows: rows of the sweep.
            instance: name of the control that travels.
            flags: (scenes, ..., models) array to fill. A row's number is its index in
                the flat array.
            distance: (scenes, ...) array to fill. The number of an image is its index
                in the flat array.
        """
        job = self._job
        right_names = self._find_right_names()
        path_name = f"{instance}.{Control.PATH_PARAMETER}"
        distance_name = f"{instance}.distance"
        for row in rows:
            image, model = divmod(row.step, len(job.models))
            flags.flat[row.step] = _find_flag(row)
            if distance_name in row.values:
                distance.flat[image] = float(str(row.values[distance_name]["value"]))
                self._distance_unit = row.values[distance_name]["unit"]
            scene = image // job.images_per_scene
            self._store_boxes(row, right_names.get((scene, model)))
            if path_name in row.values:
                self._path_of_step[row.step] = str(row.values[path_name]["value"])

    def _store_boxes(self, row: Row, names: Collection[str] | None) -> None:
        """Store the detected boxes of a row, if it has any.

        Args:
            row: the row.
            names: names of the right classes; None if the model is no detector.
        """
        # A row of an older version may lack its boxes.
        if names is not None and isinstance(row.payload, dict):
            self._frame_of_step[row.step] = read_frame(row.payload, names)

    def _find_right_names(self) -> dict[tuple[int, int], Collection[str]]:
        """Return the names of the right classes by scene and model, of detectors."""
        job = self._job
        right_names: dict[tuple[int, int], Collection[str]] = {}
        for scene, named_scene in enumerate(job.scenes):
            for model, task in enumerate(job.tasks):
                if isinstance(task, Detection):
                    facts = job.make_ground_truth_facts(named_scene, {})
                    classes = task.find_right_classes(facts)
                    right_names[scene, model] = task.get_class_names(classes)
        return right_names

    def _select_complete(self, scenes: list[int], model: int) -> _CompleteDrives:
        """Select the drives of some scenes that have all their frames.

        Drives in which the object is hidden in every frame are left out.

        Args:
            scenes: indices of the scenes.
            model: index of the model whose predictions are selected.
        """
        n_frames = len(self.times)
        # The arrays of all models have the axes (scenes, ..., models, frames). From
        # here on a row is a drive.
        outcomes = self._outcomes[scenes][..., model, :].reshape(-1, n_frames)
        row_numbers = self._row_numbers[scenes][..., model, :].reshape(-1, n_frames)
        # Distances have no axis of models.
        distance = self._distance[scenes].reshape(-1, n_frames)
        is_complete = (outcomes != UNKNOWN).all(axis=1)
        is_visible = (outcomes != HIDDEN).any(axis=1)
        is_selected = is_complete & is_visible
        return _CompleteDrives(
            outcomes[is_selected], distance[is_selected], row_numbers[is_selected]
        )

    def compute_rates(self) -> list[DriveRates]:
        """Compute the rates over drives of each model, without and with the adversarial
        configuration.

        Frames without the object count neither as right nor as part of a gap. Models
        without a complete drive are left out.
        """
        rates = list[DriveRates]()
        for arm, scenes in self._list_scenes_by_arm().items():
            for model in range(len(self._job.models)):
                drives = self._select_complete(scenes, model)
                if len(drives.outcomes):
                    rates.append(self._compute_rates(drives, model, arm))
        return rates

    def _list_scenes_by_arm(self) -> dict[str, list[int]]:
        """Return the indices of the scenes of each arm, by its name.

        The arms of a comparison are the clean scenes and the adversarial ones. If
        nothing is compared, there is one arm, whose name is empty.
        """
        scenes_by_arm: dict[str, list[int]] = {}
        for scene, named_scene in enumerate(self._job.scenes):
            scenes_by_arm.setdefault(named_scene.arm, []).append(scene)
        return scenes_by_arm

    def _compute_rates(
        self, drives: _CompleteDrives, model: int, arm: str
    ) -> DriveRates:
        """Compute the rates of one model over drives.

        Args:
            drives: drives with all their frames.
            model: index of the model.
            arm: name of the scene that they have, clean or adversarial; empty if the
                sweep has no adversarial one.
        """
        outcomes = drives.outcomes
        n_frames = len(self.times)
        first_distance = _first_right_distance(drives)
        # Only drives with a right frame have a distance of first detection.
        has_right = np.asarray((outcomes == RIGHT).any(axis=1))
        draw_of_drive = self._find_draw_of_drives(drives)
        n_drives = len(np.unique(draw_of_drive))
        n_right_drives = len(np.unique(draw_of_drive[has_right]))
        summarize = partial(summarize_drives, drive_of_value=draw_of_drive)
        return DriveRates(
            model=self._job.models[model].name,
            adversarial_run=arm or None,  # the name is empty without a comparison
            drives=n_drives,
            repeats=math.ceil(len(outcomes) / n_drives),
            frames=n_frames,
            seconds=self.seconds,
            # `min` or `max` selects the worst drive: it has the fewest right frames,
            # the longest gap, the smallest distance of the first detection.
            right=summarize(_right_fraction(outcomes), min),
            longest_gap=summarize(
                self._longest_gaps(outcomes), max, bounds=(0.0, self._max_gap)
            ),
            first_right=self._first_detection(
                first_distance[has_right], draw_of_drive[has_right]
            ),
            unit=self._distance_unit,
            never_right=n_drives - n_right_drives,
            flicker=summarize(
                self._changes_per_second(outcomes), max, bounds=(0.0, self._max_flicker)
            ),
            tracks=self._compute_track_rates(model, drives.row_numbers, draw_of_drive),
            per_drive=self._describe_drives(drives, first_distance),
        )

    def _find_draw_of_drives(self, drives: _CompleteDrives) -> npt.NDArray[np.int64]:
        """Return the draw (n,) of each drive.

        Drives of one draw differ only in noise and count as one. All frames of a drive
        have the same draw, so that of the first frame is looked up.
        """
        first_images = drives.row_numbers[:, 0] // len(self._job.models)
        return np.asarray(self._units.find_draw(first_images))

    def _describe_drives(
        self, drives: _CompleteDrives, first_distance: npt.NDArray[np.float64]
    ) -> list[DriveRecord]:
        """Return the values of each of the first `MAX_LISTED_DRIVES` drives.

        Args:
            drives: n drives.
            first_distance: (n,) distance at the first right frame; NaN if there is
                none.
        """
        right_fraction = _right_fraction(drives.outcomes)
        longest_gap = self._longest_gaps(drives.outcomes)
        flicker = self._changes_per_second(drives.outcomes)
        # A drive is identified by the row of its first frame.
        first_frames = drives.row_numbers[:, 0]
        first_steps = first_frames[:MAX_LISTED_DRIVES].tolist()
        return [
            DriveRecord(
                row=step,
                path=self._path_of_step.get(step),
                right=float(right_fraction[index]),
                first_right=_finite_or_none(first_distance[index]),
                longest_gap=float(longest_gap[index]),
                flicker=float(flicker[index]),
            )
            for index, step in enumerate(first_steps)
        ]

    @property
    def _frame_interval(self) -> float:
        """Seconds from one frame to the next."""
        return self.seconds / (len(self.times) - 1)

    @property
    def _max_gap(self) -> float:
        """The longest possible gap in seconds: every frame is wrong."""
        return len(self.times) * self._frame_interval

    @property
    def _max_flicker(self) -> float:
        """The most changes a second that are possible: from each frame to the next."""
        return (len(self.times) - 1) / self.seconds

    def _longest_gaps(self, flags: Flags) -> npt.NDArray[np.float64]:
        """Return the seconds (n,) of the longest run of wrong frames of each drive."""
        runs = np.array([find_longest_run(is_wrong) for is_wrong in flags == WRONG])
        return runs * self._frame_interval

    def _changes_per_second(self, flags: Flags) -> npt.NDArray[np.float64]:
        """Return how often a second each drive (n,) changes between right and wrong.

        Args:
            flags: (n, frames) RIGHT, WRONG or HIDDEN.
        """
        is_right = flags == RIGHT
        is_visible = flags != HIDDEN
        # A change to or from a frame without the object does not count.
        both_visible = is_visible[:, 1:] & is_visible[:, :-1]
        is_change = (is_right[:, 1:] != is_right[:, :-1]) & both_visible
        return np.asarray(is_change.sum(axis=1) / self.seconds)

    def _first_detection(
        self, distance: npt.NDArray[np.float64], draw_of_drive: npt.NDArray[np.int64]
    ) -> OverDrives | None:
        """Return mean and worst distance at the first right frame of a drive.

        None if no drive has a right frame, or a distance is unknown.

        Args:
            distance: (n,) distance at the first right frame of each drive that has one.
            draw_of_drive: (n,) draw of each of these drives.
        """
        if not len(distance) or not np.isfinite(distance).all():
            return None
        # `min`: in the worst drive the object is nearest when it is first detected.
        return summarize_drives(
            distance, min, bounds=self._distance_bounds, drive_of_value=draw_of_drive
        )

    def _compute_track_rates(
        self, model: int, steps: npt.NDArray[np.int64], drive: npt.NDArray[np.int64]
    ) -> TrackRates | None:
        """Compute how well a tracker follows the object, from the boxes of a detector.

        A frame is lost if the object is visible and no track is on it. A lost frame
        counts as loose if some track overlaps the object, but too little.

        Args:
            model: index of the model.
            steps: (n, frames) numbers of the rows.
            drive: (n,) the draw of each drive; drives of one draw differ only in noise.

        Returns:
            The rates; None unless the model detects and every frame has its boxes.
        """
        task = self._job.tasks[model]
        tracker = self._job.tracker
        if not isinstance(task, Detection):
            return None
        frames = self._collect_frames(steps)
        if frames is None:
            return None
        tracked_drives = [
            track_drive(drive_frames, tracker, task.iou) for drive_frames in frames
        ]
        # fraction of frames that are lost even if a small overlap is enough
        lost_loosely = _compute_lost_loosely(task, tracker, frames)
        lost = np.array([tracked.lost for tracked in tracked_drives], dtype=float)
        switches = np.array(
            [tracked.switches for tracked in tracked_drives], dtype=float
        )
        max_switches = len(self.times) - 1.0  # one between any two frames
        gaps = np.array([tracked.gap for tracked in tracked_drives], dtype=float)
        summarize = partial(summarize_drives, drive_of_value=drive)
        # In the worst drive each of these rates is largest: therefore `max`.
        return TrackRates(
            tracker=str(getattr(tracker, "__name__", type(tracker).__name__)),
            lost=summarize(lost, max),
            # frames that are lost, but not if a small overlap is enough
            loose=summarize(lost - lost_loosely, max),
            switches=summarize(switches, max, bounds=(0.0, max_switches)),
            longest_gap=summarize(
                gaps * self._frame_interval, max, bounds=(0.0, self._max_gap)
            ),
        )

    def _collect_frames(
        self, steps: npt.NDArray[np.int64]
    ) -> list[list[DetectedFrame]] | None:
        """Return the frames of each drive; None unless every frame has its boxes.

        Args:
            steps: (n, frames) numbers of the rows.
        """
        if any(step not in self._frame_of_step for step in steps.flat):
            return None
        return [[self._frame_of_step[step] for step in row] for row in steps.tolist()]

    def save_worst(self, scenes: SceneLoader, run: RunDirectory) -> None:
        """Save a strip and an animation of the first model's worst drive.

        The worst drive has the smallest fraction of right frames. Its images have the
        marks of the task, such as boxes.

        Args:
            scenes: scenes of the sweep.
            run: run directory into which they are written.
        """
        all_scenes = [*range(len(self._job.scenes))]
        drives = self._select_complete(all_scenes, model=0)
        has_drives = len(drives.outcomes) > 0
        if not has_drives:
            return
        worst = _right_fraction(drives.outcomes).argmin()
        # rows are numbered by image, then model
        image_numbers = drives.row_numbers[worst] // len(self._job.models)
        selected = select_evenly(len(image_numbers), MAX_ANIMATED_FRAMES)
        animated_frames = [
            _render_marked(scenes, number)
            for number in image_numbers[selected].tolist()
        ]
        save_drive(run, "drive", animated_frames, self.seconds)


def _find_independent_units(job: Job) -> Units:
    """Return the independent units of the images of a sweep.

    They are the same in all scenes and for all sizes of images.
    """
    configurations_by_size = job.load_configurations_by_size(0)
    return next(iter(configurations_by_size.values())).independent_units


def _find_shape_of_rows(job: Job) -> tuple[int, ...]:
    """Return the shape of an array with an element for each row of a sweep.

    The number of a row is its index in the flat array.
    """
    return (
        len(job.scenes),
        *(len(axis.values) for axis in job.axes),
        job.samples_per_grid_point,
        len(job.models),
    )


def _move_frames_last(
    array: npt.NDArray[Any], time_index: int, order: npt.NDArray[np.intp]
) -> npt.NDArray[Any]:
    """Make the time the last axis of an array, in ascending order.

    Args:
        array: (scenes, axes of the grid ..., ...).
        time_index: index of the time among the axes of the grid.
        order: (frames,) indices of the times in ascending order.
    """
    # The axis of the scenes comes before those of the grid.
    return np.moveaxis(array, 1 + time_index, -1)[..., order]


def _find_flag(row: Row) -> int:
    """Return whether a row is HIDDEN, RIGHT or WRONG."""
    if row.label == OUT_OF_VIEW:
        return HIDDEN
    return RIGHT if row.correct else WRONG


def _render_marked(scenes: SceneLoader, number: int) -> npt.NDArray[np.float32]:
    """Render an image (H, W, 3) of the first model, with the marks of its task.

    Args:
        scenes: scenes of the sweep.
        number: number of the image.
    """
    scene, queries = scenes.make_queries(number)
    query = queries[0]  # of the first model
    image = scene.render_image(query)
    marks = scene.problems[0].find_marks(image, query.u)
    return np.asarray(draw_marks(image.numpy(), marks), dtype=np.float32)


def _compute_lost_loosely(
    task: Detection, tracker: Tracker, frames: Sequence[Sequence[DetectedFrame]]
) -> npt.NDArray[np.float64]:
    """Compute for each drive the fraction (n,) of frames without any track on the object.

    A frame is lost if no track overlaps the object enough. Here little overlap is
    enough: `MIN_OVERLAP`, or the `iou` of the task if that is less.

    Args:
        task: task of the model; a track is on the object if they overlap by its `iou`.
        tracker: makes the tracker.
        frames: frames of each of n drives.
    """
    loose_iou = min(MIN_OVERLAP, task.iou)
    return np.array(
        [track_drive(drive_frames, tracker, loose_iou).lost for drive_frames in frames],
        dtype=float,
    )


def find_longest_run(flags: npt.NDArray[np.bool_]) -> int:
    """Return the length of the longest run of true flags (n,); 0 if none is true."""
    # A 0 is added at both ends, since a run may begin with the first flag or end with
    # the last.
    changes = np.diff(np.concatenate([[0], flags.astype(np.int8), [0]]))
    bounds = np.flatnonzero(changes)  # begin and end of each run, alternating
    return int((bounds[1::2] - bounds[::2]).max(initial=0))


def _first_right_distance(drives: _CompleteDrives) -> npt.NDArray[np.float64]:
    """Return the distance (n,) at the first right frame; NaN if there is none."""
    is_right = drives.outcomes == RIGHT
    first_frame = is_right.argmax(axis=1)
    distance = drives.distance[np.arange(len(first_frame)), first_frame]
    return np.where(is_right.any(axis=1), distance, np.nan)


def _right_fraction(flags: Flags) -> npt.NDArray[np.float64]:
    """Return the fraction (n,) of the visible frames (n, frames) that are right."""
    n_right = (flags == RIGHT).sum(axis=1)
    n_visible = (flags != HIDDEN).sum(axis=1)
    return np.asarray(n_right / n_visible)


def _finite_or_none(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def summarize_drives(
    values: npt.NDArray[np.float64],
    worst: Callable[[list[float]], float],
    bounds: tuple[float, float] | None = (0.0, 1.0),
    drive_of_value: npt.NDArray[np.int64] | None = None,
) -> OverDrives:
    """Compute the mean of a value over drives, its 95 % interval, and the worst value.

    There is no interval if the bounds are unknown, or for a single drive.

    Args:
        values: (n,) a value for each evaluation of a drive.
        worst: selects the worst of the values: `min` or `max`.
        bounds: smallest and largest value that a drive of the sweep can have, whatever
            a model predicts; None if they are unknown.
        drive_of_value: (n,) the drive of each value. Values of one drive differ only
            in noise, and are averaged first. None: each value has its own drive.
    """
    means = values
    if drive_of_value is not None:
        means = _average_per_drive(values, drive_of_value)
    interval = None
    if bounds is not None and len(means) > 1:
        interval = mean_interval(means, *bounds)
    # The worst value is that of a single evaluation, with the noise that it had.
    worst_value = worst(values.tolist())
    return OverDrives(mean=float(means.mean()), interval=interval, worst=worst_value)


def _average_per_drive(
    values: npt.NDArray[np.float64], drive_of_value: npt.NDArray[np.int64]
) -> npt.NDArray[np.float64]:
    """Return the mean of the values (n,) of each drive.

    Args:
        values: (n,) the values.
        drive_of_value: (n,) the drive of each value.
    """
    n_values = sum_per_unit(np.ones(len(values)), drive_of_value)
    return np.asarray(sum_per_unit(values, drive_of_value) / n_values)
