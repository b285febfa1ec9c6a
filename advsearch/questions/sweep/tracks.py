"""Tracks: what a tracker makes of a detector's boxes along a drive, judged by the true
box of each frame.

A frame is lost where the object is seen and no track of that frame overlaps its true
box; an identity switch is a frame whose track has another number than the one before
that had the object (as in MOTA, Bernardin and Stiefelhagen 2008).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from advsearch.tasks.boxes import overlap

Doubles = NDArray[np.float64]
Step = Callable[[Doubles, Doubles], Sequence[tuple[int, Any]]]
"""From the boxes (n, 4) of a frame, x0, y0, x1, y1 in pixels, and their scores (n,) to
the tracks that are in it: a number that stays the same, and a box.
"""
# makes a new one for each drive; frames come in their order
Tracker = Callable[[], Step]


class DetectedFrame(NamedTuple):
    """What a picture of a drive shows (its true box, None where nothing is seen), and
    what a detector says of it.
    """

    true: Doubles | None
    boxes: Doubles
    scores: Doubles


class Tracked(NamedTuple):
    """Of one drive: the share of frames that are lost, identity switches, and the most
    lost frames in a row.
    """

    lost: float
    switches: int
    gap: int


@dataclass(frozen=True, eq=False)
class _Track:
    number: int
    box: Doubles
    speed: Doubles
    missed: int = 0


class ConstantVelocity:
    """A tracker in which boxes go on as they went.

    Boxes are given to the tracks whose predicted boxes they overlap most, all together
    (Kuhn 1955): first those with a score of `sure`, then the others, which begin no
    track (Zhang et al. 2022, *ByteTrack*, section 3).

    Args:
        sure: score of a box that begins a track.
        overlap: least intersection over union of a box with the predicted one.
        patience: frames in which a track may be missed; after more it has ended.
    """

    def __init__(
        self, sure: float = 0.5, overlap: float = 0.3, patience: int = 3
    ) -> None:
        self.sure = sure
        self.overlap = overlap
        self.patience = patience
        self._tracks: list[_Track] = []
        self._numbers = itertools.count(1)

    def __call__(self, boxes: Doubles, scores: Doubles) -> list[tuple[int, Doubles]]:
        """Return the tracks that have a box in this frame."""
        waiting = [
            replace(one, box=one.box + one.speed, missed=one.missed + 1)
            for one in self._tracks
        ]
        seen = list[_Track]()
        new = list[Doubles]()
        for sure in (True, False):
            left = boxes[(scores >= self.sure) == sure]
            table = np.array([overlaps(left, one.box) for one in waiting]).reshape(
                len(waiting), len(left)
            )
            pairs = {
                a: b
                for a, b in zip(*linear_sum_assignment(-table), strict=True)
                if table[a, b] >= self.overlap
            }
            for a, b in pairs.items():
                before = waiting[a].box - waiting[a].speed * waiting[a].missed
                seen.append(
                    _Track(
                        waiting[a].number,
                        left[b],
                        (left[b] - before) / waiting[a].missed,
                    )
                )
            waiting = [
                track for number, track in enumerate(waiting) if number not in pairs
            ]
            new += [
                box
                for number, box in enumerate(left)
                if number not in pairs.values() and sure
            ]
        seen += [_Track(next(self._numbers), box, np.zeros(4)) for box in new]
        self._tracks = [*seen, *(one for one in waiting if one.missed <= self.patience)]
        return [(one.number, one.box) for one in seen]


def overlaps(boxes: Doubles, box: Doubles) -> Doubles:
    """Return intersection over union of boxes (n, 4) with one box (4,), (n,)."""
    return np.asarray(overlap(torch.from_numpy(boxes), torch.from_numpy(box)))


def frame_of(payload: Any, names: Collection[str]) -> DetectedFrame:
    found = [one for one in payload["found"] if one["label"] in names]
    boxes = np.array([one["box"] for one in found], dtype=float).reshape(-1, 4)
    true = None if payload["box"] is None else np.array(payload["box"], dtype=float)
    return DetectedFrame(true, boxes, np.array([one["score"] for one in found]))


def tracked(frames: Sequence[DetectedFrame], tracker: Tracker, iou: float) -> Tracked:
    """Return what a tracker makes of a drive; a track is on the object where it
    overlaps the true box by `iou`.
    """
    step = tracker()
    last = None
    lost = list[bool]()
    switches = 0
    for true, boxes, scores in frames:
        tracks = step(boxes, scores)
        places = np.array([box for _, box in tracks], dtype=float).reshape(-1, 4)
        shares = [] if true is None else overlaps(places, true).tolist()
        on = [
            (share, number)
            for share, (number, _) in zip(shares, tracks, strict=False)
            if share >= iou
        ]
        lost.append(true is not None and not on)
        if on:
            number = last if any(number == last for _, number in on) else max(on)[1]
            switches += last is not None and number != last
            last = number
    gaps = [sum(run) for is_lost, run in itertools.groupby(lost) if is_lost]
    seen = sum(true is not None for true, _, _ in frames)
    return Tracked(sum(lost) / max(1, seen), switches, max(gaps, default=0))
