"""Drives: what a sweep over the frames of a path says of whole drives, everything that varies but the time, and the
worst of them. Frames are not independent, so intervals are over drives, and hold for any number of them: each number
has ends that it cannot pass (`attacks.units`)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from advsearch.attacks.units import mean_interval
from advsearch.controls import Control
from advsearch.controls.path import WAY, PathControl
from advsearch.described import OUT_OF_VIEW
from advsearch.engine.naming import given_to
from advsearch.questions.attack.result import evenly, write_drive
from advsearch.questions.sweep.axes import Axis
from advsearch.questions.sweep.job import Job, OpenScenes
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.questions.sweep.summary import DriveRates, OneDrive, OverDrives, TrackRates
from advsearch.questions.sweep.tracks import DetectedFrame, frame_of, tracked
from advsearch.report.figures import marked
from advsearch.runs.directory import RunDirectory
from advsearch.runs.store import Row
from advsearch.tasks import Detection

ANIMATED = 60
MOST_LISTED = 1000  # drives of a model whose own numbers are kept

UNKNOWN, HIDDEN = -1, 2

Flags = npt.NDArray[np.int8]


def with_frames(config: SweepConfig, drawn: tuple[Control, ...]) -> tuple[tuple[Control, ...], dict[str, object]]:
    """Return the controls with what travels along the path of the configuration, and the grid with its frames last."""
    travelling = next((one for one in drawn if isinstance(one, PathControl)), None)
    if travelling is None:
        (added,) = given_to(config, {PathControl.kind: {}})
        assert isinstance(added, PathControl)
        drawn, travelling = (*drawn, added), added
    name, seconds = f"{travelling.name}.time", travelling.seconds
    frames = f"0:{seconds:g}:{max(2, round(seconds * config.fps) + 1)}"
    grid = config.grid if name in config.grid else {**config.grid, name: frames}
    which = f"{travelling.name}.{WAY}"
    ways = next((one.options for one in travelling.own if one.name == WAY), ())
    if ways and config.samples is None and which not in grid and WAY not in travelling.specs:
        grid = {which: list(ways), **grid}  # nothing is drawn: each of them is looked at
    return drawn, grid


def time_axis(axes: Sequence[Axis]) -> int | None:
    """Return the number of the axis whose values are frames; None where there is none, or one frame."""
    return next((place for place, axis in enumerate(axes) if axis.is_time and len(axis.values) > 1), None)


class Drives:
    """The frames of every drive of a sweep."""

    def __init__(self, job: Job, rows: Iterable[Row]) -> None:
        place = time_axis(job.axes)
        assert place is not None
        self._job, axis = job, job.axes[place]
        shape = (len(job.places), *(len(one.values) for one in job.axes), job.samples, len(job.models))
        right: Flags = np.full(shape, UNKNOWN, np.int8)
        away = np.full(shape[:-1], np.nan)
        self._ways: dict[int, str] = {}
        self._frames: dict[int, DetectedFrame] = {}
        names = [[job.right_names(place, model) for model in range(len(job.models))] for place in job.places]
        rows_of_a_place = right.size // len(job.places)
        which = f"{axis.instance}.{WAY}"
        name, self._unit = f"{axis.instance}.distance", "object sizes"
        for row in rows:
            right.flat[row.step] = HIDDEN if row.label == OUT_OF_VIEW else bool(row.correct)
            if (distance := row.values.get(name)) is not None:
                away.flat[row.step // len(job.models)] = float(str(distance["value"]))
                self._unit = distance["unit"]
            if isinstance(job.tasks[row.step % len(job.models)], Detection) and isinstance(row.payload, dict):
                right_names = names[row.step // rows_of_a_place][row.step % len(job.models)]
                self._frames[row.step] = frame_of(row.payload, right_names)
            if which in row.values:
                self._ways[row.step] = str(row.values[which]["value"])
        times = np.array([float(value) for value in axis.values])
        order = np.argsort(times)
        self.times = times[order]
        self._numbers = np.moveaxis(np.arange(right.size).reshape(shape), place + 1, -1)[..., order]
        self._right = np.moveaxis(right, place + 1, -1)[..., order]
        self._away = np.moveaxis(away, place + 1, -1)[..., order]

    def _whole(self, places: list[int], model: int) -> tuple[Flags, npt.NDArray[np.float64], npt.NDArray[np.int64]]:
        """Of the drives with all their frames (n, frames): whether a model is right, how far away it is, and rows."""
        right, numbers = (of[places][..., model, :].reshape(-1, len(self.times)) for of in (self._right, self._numbers))
        whole = (right != UNKNOWN).all(axis=1) & (right != HIDDEN).any(axis=1)
        return right[whole], self._away[places].reshape(right.shape)[whole], numbers[whole]

    def rates(self) -> list[DriveRates]:
        """Return what is said of the drives of each model, without and with an adversarial scene."""
        rates, places = list[DriveRates](), self._job.places
        for beside_clean in dict.fromkeys(place.beside_clean for place in places):
            those = [number for number, place in enumerate(places) if place.beside_clean == beside_clean]
            for model, network in enumerate(self._job.models):
                flags, away, numbers = self._whole(those, model)
                if len(flags):
                    told = self._rates(flags, away, numbers[:, 0].tolist())
                    tracks = self._tracks(model, numbers)
                    rates.append(DriveRates(model=network.name, answer=beside_clean or None, tracks=tracks, **told))
        return rates

    def _rates(self, flags: Flags, away: npt.NDArray[np.float64], begins: list[int]) -> dict[str, Any]:
        """What is said of drives, by their first rows (n,) too. Frames without the object are neither right nor a
        gap."""
        right, wrong, shown = flags == 1, flags == 0, flags != HIDDEN
        share = right.sum(axis=1) / shown.sum(axis=1)
        seconds, frames = float(self.times[-1] - self.times[0]), len(self.times)
        step = seconds / (frames - 1)
        seen: npt.NDArray[np.bool_] = np.asarray(right.any(axis=1))
        at_first = away[np.arange(len(right)), right.argmax(axis=1)]
        first, gaps = at_first[seen], np.array([longest(drive) for drive in wrong]) * step
        together = shown[:, 1:] & shown[:, :-1]
        changes = ((right[:, 1:] != right[:, :-1]) & together).sum(axis=1) / seconds
        ends = float(away.min()), float(away.max())
        return {
            "drives": len(right),
            "frames": frames,
            "seconds": seconds,
            "right": over_drives(share, worst=min),
            "longest_gap": over_drives(gaps, max, (0.0, frames * step)),
            "first_seen": over_drives(first, min, ends) if len(first) and np.isfinite(ends).all() else None,
            "unit": self._unit,
            "never_seen": int((~seen).sum()),
            "flicker": over_drives(changes, max, (0.0, (frames - 1) / seconds)),
            "each": [
                OneDrive(
                    row=begin,
                    path=self._ways.get(begin),
                    right=float(share[k]),
                    first_seen=float(at_first[k]) if seen[k] and np.isfinite(at_first[k]) else None,
                    longest_gap=float(gaps[k]),
                    flicker=float(changes[k]),
                )
                for k, begin in enumerate(begins[:MOST_LISTED])
            ],
        }

    def _tracks(self, model: int, numbers: npt.NDArray[np.int64]) -> TrackRates | None:
        """What a tracker makes of drives, by the numbers (n, frames) of their rows; None without boxes in all."""
        task, frames = self._job.tasks[model], len(self.times)
        if not isinstance(task, Detection) or not all(number in self._frames for number in numbers.flat):
            return None
        drives = [tracked([self._frames[k] for k in row], self._job.tracker, task.iou) for row in numbers.tolist()]
        step = float(self.times[-1] - self.times[0]) / (frames - 1)
        lost, switches, gaps = (np.array(values, dtype=float) for values in zip(*drives, strict=True))
        return TrackRates(
            tracker=str(getattr(self._job.tracker, "__name__", type(self._job.tracker).__name__)),
            lost=over_drives(lost, max),
            switches=over_drives(switches, max, (0.0, frames - 1.0)),
            longest_gap=over_drives(gaps * step, max, (0.0, frames * step)),
        )

    def keep_worst(self, scenes: OpenScenes, run: RunDirectory) -> None:
        """Write a strip and an animation of the drive in which the first model is right least often, with its marks."""
        flags, _, numbers = self._whole([*range(len(self._job.places))], 0)
        if len(flags):
            share = (flags == 1).sum(axis=1) / (flags != HIDDEN).sum(axis=1)
            worst = numbers[share.argmin()] // len(self._job.models)
            pictures = [picture_of(scenes, int(number)) for number in worst[evenly(len(worst), ANIMATED)]]
            write_drive(run, "drive", pictures, float(self.times[-1] - self.times[0]))


def picture_of(scenes: OpenScenes, number: int) -> npt.NDArray[np.float32]:
    """Return the picture (h, w, 3) with a number, with the marks of the first model's prediction."""
    view, (query, *_) = scenes.asked(number)
    picture = view.pictures([query])[0]
    return np.asarray(marked(picture.numpy(), view.problems[0].marks(picture, query.u)), dtype=np.float32)


def longest(flags: npt.NDArray[np.bool_]) -> int:
    """Return the length of the longest run of true values."""
    ends = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    return int((ends[1::2] - ends[::2]).max(initial=0))


def over_drives(
    values: npt.NDArray[np.float64], worst: Callable[[list[float]], float], ends: tuple[float, float] = (0.0, 1.0)
) -> OverDrives:
    """Return the mean of a number over drives, its 95 % interval, and that of the worst drive; `ends` are what it is
    between whatever a model says."""
    interval = mean_interval(values, *ends) if len(values) > 1 else None
    return OverDrives(mean=float(values.mean()), interval=interval, worst=worst(values.tolist()))
