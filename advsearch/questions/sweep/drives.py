"""Drives: what a sweep over the frames of a path says of whole drives, everything that
varies but the time, and the worst of them. Frames are not independent, so intervals are
over drives, and hold for any number of them: each number has ends that it cannot pass,
known from the plan (`attacks.trials`). Where nothing is drawn, samples of a drive
differ in noise alone: they are one drive, whose numbers are the means of theirs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from advsearch.controls import Control
from advsearch.engine.naming import given_to
from advsearch.options import OUT_OF_VIEW
from advsearch.questions.attack.result import evenly, write_drive
from advsearch.questions.sweep.axes import Axis
from advsearch.questions.sweep.job import Job, OpenScenes
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.questions.sweep.summary import (
    DriveRates,
    OneDrive,
    OverDrives,
    TrackRates,
)
from advsearch.questions.sweep.tracks import DetectedFrame, frame_of, tracked
from advsearch.report.figures import marked
from advsearch.runs.directory import RunDirectory
from advsearch.runs.store import Row
from advsearch.runs.tables import Units
from advsearch.statistics.clustered import mean_interval, per_unit
from advsearch.tasks import Detection
from advsearch.tasks.boxes import LEAST_OVERLAP

ANIMATED = 60
MOST_LISTED = 1000  # drives of a model whose own numbers are kept
UNKNOWN = -1
HIDDEN = 2
Flags = npt.NDArray[np.int8]


def with_frames(
    config: SweepConfig, drawn: tuple[Control, ...]
) -> tuple[tuple[Control, ...], dict[str, object]]:
    """Return the controls with what travels along the path of the configuration, and
    the grid with its frames last.
    """
    travelling: Any = next((one for one in drawn if one.travels), None)
    if travelling is None:
        (added,) = given_to(config, {"path": {}})
        drawn = (*drawn, added)
        travelling = added
    name = f"{travelling.name}.time"
    seconds = travelling.seconds
    frames = f"0:{seconds:g}:{max(2, round(seconds * config.fps) + 1)}"
    grid = config.grid if name in config.grid else {**config.grid, name: frames}
    which = f"{travelling.name}.{Control.WAY}"
    ways = next((one.options for one in travelling.own if one.name == Control.WAY), ())
    if (
        ways
        and config.samples is None
        and which not in grid
        and Control.WAY not in travelling.specs
    ):
        # nothing is drawn: each of them is looked at
        grid = {which: list(ways), **grid}
    return drawn, grid


def time_axis(axes: Sequence[Axis]) -> int | None:
    """Return the number of the axis whose values are frames; None where there is none,
    or one frame.
    """
    return next(
        (
            place
            for place, axis in enumerate(axes)
            if axis.is_time and len(axis.values) > 1
        ),
        None,
    )


def planned_distances(job: Job, axis: Axis) -> tuple[float, float] | None:
    """Return the nearest and the farthest distance, as rows say it, that any drive of a
    sweep can have at the times of an axis: on each of the paths, also one that was not
    drawn, and in each scene. None of a path that says none.
    """
    times = torch.tensor([float(value) for value in axis.values])
    lowest = math.inf
    highest = -math.inf
    for scene in range(len(job.places)):
        for points in job.bound(scene).values():
            control: Any = next(
                (one for one in points.space.controls if one.name == axis.instance),
                None,
            )
            if control is None or not control.travels:
                return None
            distances = control.distances(times)
            lowest = min(lowest, float(distances.min()))
            highest = max(highest, float(distances.max()))
    return lowest, highest


class Drives:
    """The frames of every drive of a sweep."""

    _units = Units()
    # from the plan: the ends of a sample are no ends of what it is from
    _distances: tuple[float, float] | None = None

    def __init__(self, job: Job, rows: Iterable[Row]) -> None:
        place = time_axis(job.axes)
        assert place is not None
        self._job = job
        axis = job.axes[place]
        self._units = next(iter(job.bound(0).values())).units
        self._distances = planned_distances(job, axis)
        shape = (
            len(job.places),
            *(len(one.values) for one in job.axes),
            job.samples,
            len(job.models),
        )
        right: Flags = np.full(shape, UNKNOWN, np.int8)
        away = np.full(shape[:-1], np.nan)
        self._ways: dict[int, str] = {}
        self._frames: dict[int, DetectedFrame] = {}
        right_names = {
            (number, model): task.names(task.right_classes(job.facts(place, {})))
            for number, place in enumerate(job.places)
            for model, task in enumerate(job.tasks)
            if isinstance(task, Detection)
        }
        which = f"{axis.instance}.{Control.WAY}"
        distance = f"{axis.instance}.distance"
        self._unit = "object sizes"
        for row in rows:
            picture, model = divmod(row.step, len(job.models))
            right.flat[row.step] = (
                HIDDEN if row.label == OUT_OF_VIEW else bool(row.correct)
            )
            if distance in row.values:
                away.flat[picture] = float(str(row.values[distance]["value"]))
                self._unit = row.values[distance]["unit"]
            names = right_names.get((picture // job.per_scene, model))
            if names is not None and isinstance(row.payload, dict):
                self._frames[row.step] = frame_of(row.payload, names)
            if which in row.values:
                self._ways[row.step] = str(row.values[which]["value"])
        times = np.array([float(value) for value in axis.values])
        order = np.argsort(times)
        self.times = times[order]
        self.seconds = float(self.times[-1] - self.times[0])
        self._right, self._numbers, self._away = (
            np.moveaxis(of, place + 1, -1)[..., order]
            for of in (right, np.arange(right.size).reshape(shape), away)
        )

    def _whole(
        self, places: list[int], model: int
    ) -> tuple[Flags, npt.NDArray[np.float64], npt.NDArray[np.int64]]:
        """Of the drives with all their frames (n, frames): whether a model is right,
        how far away it is, and rows.
        """
        right, numbers = (
            of[places][..., model, :].reshape(-1, len(self.times))
            for of in (self._right, self._numbers)
        )
        whole = (right != UNKNOWN).all(axis=1) & (right != HIDDEN).any(axis=1)
        return (
            right[whole],
            self._away[places].reshape(right.shape)[whole],
            numbers[whole],
        )

    def rates(self) -> list[DriveRates]:
        """Return what is said of the drives of each model, without and with an
        adversarial scene. Frames without the object are neither right nor a gap.
        """
        rates = list[DriveRates]()
        places = self._job.places
        seconds = self.seconds
        frames = len(self.times)
        step = seconds / (frames - 1)
        for beside_clean in dict.fromkeys(place.beside_clean for place in places):
            those = [
                number
                for number, place in enumerate(places)
                if place.beside_clean == beside_clean
            ]
            for model, network in enumerate(self._job.models):
                flags, away, numbers = self._whole(those, model)
                if not len(flags):
                    continue
                right = flags == 1
                shown = flags != HIDDEN
                share = right.sum(axis=1) / shown.sum(axis=1)
                seen: npt.NDArray[np.bool_] = np.asarray(right.any(axis=1))
                at_first = away[np.arange(len(right)), right.argmax(axis=1)]
                first = at_first[seen]
                gaps = np.array([longest(drive) for drive in flags == 0]) * step
                together = shown[:, 1:] & shown[:, :-1]
                changes = ((right[:, 1:] != right[:, :-1]) & together).sum(
                    axis=1
                ) / seconds
                drive = np.asarray(
                    self._units.draw(numbers[:, 0] // len(self._job.models))
                )
                n_drives = len(np.unique(drive))
                known = len(first) > 0 and bool(np.isfinite(first).all())
                drives = DriveRates(
                    model=network.name,
                    answer=beside_clean or None,
                    drives=n_drives,
                    repeats=-(-len(right) // n_drives),
                    frames=frames,
                    seconds=seconds,
                    right=over_drives(share, min, drive=drive),
                    longest_gap=over_drives(gaps, max, (0.0, frames * step), drive),
                    first_seen=over_drives(first, min, self._distances, drive[seen])
                    if known
                    else None,
                    unit=self._unit,
                    never_seen=n_drives - len(np.unique(drive[seen])),
                    flicker=over_drives(
                        changes, max, (0.0, (frames - 1) / seconds), drive
                    ),
                    tracks=self._tracks(model, numbers, drive),
                    each=[
                        OneDrive(
                            row=begin,
                            path=self._ways.get(begin),
                            right=float(share[k]),
                            first_seen=float(at_first[k])
                            if seen[k] and np.isfinite(at_first[k])
                            else None,
                            longest_gap=float(gaps[k]),
                            flicker=float(changes[k]),
                        )
                        for k, begin in enumerate(numbers[:MOST_LISTED, 0].tolist())
                    ],
                )
                rates.append(drives)
        return rates

    def _tracks(
        self, model: int, numbers: npt.NDArray[np.int64], drive: npt.NDArray[np.int64]
    ) -> TrackRates | None:
        """What a tracker makes of drives, by the numbers (n, frames) of their rows and
        of the `drive` (n,) that these are of; None without boxes in all.
        """
        task = self._job.tasks[model]
        frames = len(self.times)
        tracker = self._job.tracker
        if not isinstance(task, Detection) or not all(
            number in self._frames for number in numbers.flat
        ):
            return None
        seen = [[self._frames[number] for number in row] for row in numbers.tolist()]
        drives = [
            tracked(frames_of_drive, tracker, task.iou) for frames_of_drive in seen
        ]
        least = min(LEAST_OVERLAP, task.iou)
        loosely = [
            tracked(frames_of_drive, tracker, least).lost for frames_of_drive in seen
        ]
        step = self.seconds / (frames - 1)
        lost, switches, gaps = (
            np.array(values, dtype=float) for values in zip(*drives, strict=True)
        )
        return TrackRates(
            tracker=str(getattr(tracker, "__name__", type(tracker).__name__)),
            lost=over_drives(lost, max, drive=drive),
            loose=over_drives(lost - np.array(loosely), max, drive=drive),
            switches=over_drives(switches, max, (0.0, frames - 1.0), drive),
            longest_gap=over_drives(gaps * step, max, (0.0, frames * step), drive),
        )

    def keep_worst(self, scenes: OpenScenes, run: RunDirectory) -> None:
        """Write a strip and an animation of the drive in which the first model is right
        least often, with its marks.
        """
        flags, _, numbers = self._whole([*range(len(self._job.places))], 0)
        if len(flags):
            share = (flags == 1).sum(axis=1) / (flags != HIDDEN).sum(axis=1)
            worst = numbers[share.argmin()] // len(self._job.models)
            pictures = []
            for number in worst[evenly(len(worst), ANIMATED)].tolist():
                view, (query, *_) = scenes.asked(number)
                picture = view.picture(query)
                drawn = marked(
                    picture.numpy(), view.problems[0].marks(picture, query.u)
                )
                pictures.append(np.asarray(drawn, dtype=np.float32))
            write_drive(run, "drive", pictures, self.seconds)


def longest(flags: npt.NDArray[np.bool_]) -> int:
    ends = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    return int((ends[1::2] - ends[::2]).max(initial=0))


def over_drives(
    values: npt.NDArray[np.float64],
    worst: Callable[[list[float]], float],
    ends: tuple[float, float] | None = (0.0, 1.0),
    drive: npt.NDArray[np.int64] | None = None,
) -> OverDrives:
    """Return the mean over drives of a number (n,), its 95 % interval, and the worst
    number. The numbers of one `drive` (n,) differ in noise alone, so that their mean is
    the drive's; None: each number is of a drive of its own. `ends` are what a number is
    between whatever a model says, from the plan; where these are not known, and of one
    drive, there is no interval.
    """
    means = (
        values
        if drive is None
        else per_unit(values, drive) / per_unit(np.ones(len(values)), drive)
    )
    interval = (
        mean_interval(means, *ends) if ends is not None and len(means) > 1 else None
    )
    return OverDrives(
        mean=float(means.mean()), interval=interval, worst=worst(values.tolist())
    )
