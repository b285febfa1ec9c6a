"""Track the boxes of a detector along a drive, and compare with the true boxes.

A frame is lost if the object is visible and no track of that frame overlaps its true
box. An identity switch is a frame whose track has another number than the last one that
was on the object (as in MOTA, Bernardin and Stiefelhagen 2008).
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

from advsearch.tasks.boxes import compute_iou

Float64Array = NDArray[np.float64]
Step = Callable[[Float64Array, Float64Array], Sequence[tuple[int, Any]]]
"""Takes the boxes (n, 4) of a frame, x0, y0, x1, y1 in pixels, and their scores (n,).
Returns the tracks in the frame: for each its number, which stays the same, and its box.
"""
# Makes a step function for each drive, which is called with the frames in order.
Tracker = Callable[[], Step]


class DetectedFrame(NamedTuple):
    """The boxes in an image of a drive, x0, y0, x1, y1 in pixels.

    Attributes:
        true_box: (4,) box of the object; None if it is not visible.
        boxes: (n, 4) boxes that a detector predicts.
        scores: (n,) scores of these boxes.
    """

    true_box: Float64Array | None
    boxes: Float64Array
    scores: Float64Array


class DriveTracking(NamedTuple):
    """How well a tracker follows the object along one drive.

    Attributes:
        lost: fraction of the visible frames that are lost.
        switches: number of identity switches.
        gap: largest number of consecutive lost frames.
    """

    lost: float
    switches: int
    gap: int


@dataclass(frozen=True, eq=False)
class _Track:
    """A track of `ConstantVelocity`.

    Attributes:
        number: number of the track, which stays the same.
        box: (4,) box in the last frame: a detected one, or, if the track was missed,
            the last detected one moved by `missed` times its speed.
        speed: (4,) change of the box per frame.
        missed: number of frames since the last detected box; 0 if the last frame had
            one.
    """

    number: int
    box: Float64Array
    speed: Float64Array
    missed: int = 0


class ConstantVelocity:
    """A tracker that predicts boxes with constant velocity.

    Boxes are assigned to the tracks whose predicted boxes they overlap most, all
    jointly (Kuhn 1955): first those with a score of `sure`, then the others, which
    begin no track (Zhang et al. 2022, *ByteTrack*, section 3). A sure box without a
    track begins a new one, at speed 0.

    Args:
        sure: score of a box that begins a track.
        overlap: minimum intersection over union of a box with the predicted one.
        patience: number of frames in which a track may be missed before it ends.
    """

    def __init__(
        self, sure: float = 0.5, overlap: float = 0.3, patience: int = 3
    ) -> None:
        """Begin without tracks.

        Args:
            sure: score in [0, 1] from which on a box may begin a track.
            overlap: minimum intersection over union with the predicted box for a box
                to continue a track.
            patience: number of consecutive frames without a box after which a track
                still continues.
        """
        self.sure = sure
        self.overlap = overlap
        self.patience = patience
        self._tracks: list[_Track] = []
        self._numbers = itertools.count(1)

    def __call__(
        self, boxes: Float64Array, scores: Float64Array
    ) -> list[tuple[int, Float64Array]]:
        """Move all tracks on by one frame, and return those that have a box in it.

        Args:
            boxes: (n, 4) detected boxes of the frame.
            scores: (n,) scores of the boxes.

        Returns:
            Number and box of each track that was assigned a box, or began.
        """
        is_sure = scores >= self.sure
        # Every track moves by its speed, and counts as missed until it is assigned a
        # box.
        waiting = [
            replace(track, box=track.box + track.speed, missed=track.missed + 1)
            for track in self._tracks
        ]
        sure_tracks, waiting, new_boxes = self._assign(waiting, boxes[is_sure])
        # Unsure boxes continue tracks, but begin none (ByteTrack).
        unsure_tracks, waiting, _ = self._assign(waiting, boxes[~is_sure])
        new_tracks = [
            _Track(next(self._numbers), box, np.zeros(4)) for box in new_boxes
        ]
        visible = [*sure_tracks, *unsure_tracks, *new_tracks]
        still_waiting = [track for track in waiting if track.missed <= self.patience]
        self._tracks = [*visible, *still_waiting]
        return [(track.number, track.box) for track in visible]

    def _assign(
        self, tracks: Sequence[_Track], boxes: Float64Array
    ) -> tuple[list[_Track], list[_Track], list[Float64Array]]:
        """Assign boxes (n, 4) to tracks that have moved on to the frame of the boxes.

        Returns:
            The tracks with a box, those without, and the boxes without a track.
        """
        box_of_track = self._match(tracks, boxes)
        assigned = [
            _continue_track(tracks[track_index], boxes[box_index])
            for track_index, box_index in box_of_track.items()
        ]
        used_boxes = set(box_of_track.values())
        free_tracks = [
            track for index, track in enumerate(tracks) if index not in box_of_track
        ]
        free_boxes = [box for index, box in enumerate(boxes) if index not in used_boxes]
        return assigned, free_tracks, free_boxes

    def _match(self, tracks: Sequence[_Track], boxes: Float64Array) -> dict[int, int]:
        """Return the index of the box of each matched track, by the index of the track.

        The sum of the overlaps is the largest possible (Kuhn 1955). A pair that
        overlaps less than `overlap` is no match.
        """
        overlap_rows = [compute_overlaps(boxes, track.box) for track in tracks]
        overlap_table = np.array(overlap_rows).reshape(len(tracks), len(boxes))
        # The function minimizes the sum, so the overlaps are negated.
        pairs = zip(*linear_sum_assignment(-overlap_table), strict=True)
        return {
            track: box
            for track, box in pairs
            if overlap_table[track, box] >= self.overlap
        }


def _continue_track(track: _Track, box: Float64Array) -> _Track:
    """Return a track that has moved on to a frame, with the box (4,) in that frame."""
    # The track's box has moved on by its speed in each missed frame. `missed` is at
    # least 1, since this frame counts as missed, too.
    last_detected_box = track.box - track.speed * track.missed
    speed = (box - last_detected_box) / track.missed
    return _Track(track.number, box, speed, missed=0)


def compute_overlaps(boxes: Float64Array, box: Float64Array) -> Float64Array:
    """Compute the intersection over union (n,) of boxes (n, 4) with one box (4,)."""
    return np.asarray(compute_iou(torch.from_numpy(boxes), torch.from_numpy(box)))


def read_frame(payload: Any, names: Collection[str]) -> DetectedFrame:
    """Return the boxes that a row of a detector stores.

    Args:
        payload: payload of the row: "found" has the detected boxes with labels and
            scores, "box" the true one, None if the object is not visible.
        names: names of the classes whose boxes count.
    """
    detections = [
        detection for detection in payload["found"] if detection["label"] in names
    ]
    boxes = np.array([detection["box"] for detection in detections], dtype=float)
    boxes = boxes.reshape(-1, 4)  # also without any
    scores = np.array([detection["score"] for detection in detections])
    true_box = None
    if payload["box"] is not None:
        true_box = np.array(payload["box"], dtype=float)
    return DetectedFrame(true_box, boxes, scores)


def track_drive(
    frames: Sequence[DetectedFrame], tracker: Tracker, iou: float
) -> DriveTracking:
    """Track the boxes of a drive, and compare the tracks with the true boxes.

    A frame in which the object is visible is lost if no track is on it. One track
    follows the object: at first the track that overlaps it most. If in a later frame
    only other tracks are on the object, the one of these that overlaps most follows it
    from then on: this is an identity switch.

    Args:
        frames: frames of the drive, in their order.
        tracker: makes the tracker.
        iou: intersection over union with the true box from which on a track is on the
            object.
    """
    track_frame = tracker()  # a function that takes the boxes of the next frame
    last_number: int | None = None
    is_lost = list[bool]()
    n_switches = 0
    for frame in frames:
        tracks = track_frame(frame.boxes, frame.scores)
        is_visible = frame.true_box is not None
        on_object = _find_tracks_on(tracks, frame.true_box, iou)
        is_lost.append(is_visible and not on_object)
        number = _choose_track(on_object, last_number)
        if last_number is not None and number != last_number:
            n_switches += 1
        last_number = number
    n_visible = sum(frame.true_box is not None for frame in frames)
    return DriveTracking(
        lost=sum(is_lost) / max(1, n_visible),  # no division by 0
        switches=n_switches,
        gap=_find_longest_gap(is_lost),
    )


def _choose_track(
    on_object: Sequence[tuple[float, int]], last_number: int | None
) -> int | None:
    """Return the number of the track that follows the object from a frame on.

    Args:
        on_object: overlap and number of the tracks that are on the object.
        last_number: number of the track that followed it before; None if none did.
    """
    if not on_object or any(number == last_number for _, number in on_object):
        return last_number
    _, number = max(on_object)  # the track with the largest overlap
    return number


def _find_longest_gap(is_lost: Sequence[bool]) -> int:
    """Return the length of the longest run of lost frames; 0 if none is lost.

    A frame without the object is not lost, and ends a run.
    """
    # Each True counts as 1 in the sum.
    gaps = [sum(run) for lost, run in itertools.groupby(is_lost) if lost]
    return max(gaps, default=0)


def _find_tracks_on(
    tracks: Sequence[tuple[int, Any]], true_box: Float64Array | None, iou: float
) -> list[tuple[float, int]]:
    """Return overlap and number of the tracks that are on the true box.

    Args:
        tracks: number and box (4,) of each track.
        true_box: (4,) box of the object; None if it is not visible. Then no track is on
            it.
        iou: minimum overlap of a track that is on the object.
    """
    if true_box is None:
        return []
    boxes = np.array([box for _, box in tracks], dtype=float).reshape(-1, 4)
    track_overlaps = compute_overlaps(boxes, true_box).tolist()
    return [
        (track_overlap, number)
        for track_overlap, (number, _) in zip(track_overlaps, tracks, strict=True)
        if track_overlap >= iou
    ]
