"""Tracks along drives: numbers by hand, a detector that misses frames, and what a sweep says of it."""

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch
from torch import Tensor, nn

import advsearch
from advsearch.models import ModelWarning
from advsearch.questions.sweep.tracks import ConstantVelocity, DetectedFrame, compute_overlaps, track_drive
from small_models import SIDE, Finder

Doubles = npt.NDArray[np.float64]
NEAR: dict[str, Any] = {"path": "approach", "reach": 1.3}
DRIVE: dict[str, Any] = {"path": "pass", "fps": 1.5, "trials": 0, "resolution": 32, "spp": 1, "denoise": "none"}


def moving(frame: int, speed: float = 4.0) -> Doubles:
    return np.array([10.0, 10.0, 30.0, 40.0]) + speed * frame * np.array([1.0, 0.0, 1.0, 0.0])


def drive(scores: Sequence[float], others: Sequence[Doubles] = ()) -> list[DetectedFrame]:
    """The true box in each frame with a score; none where that is 0."""
    frames = []
    for number, score in enumerate(scores):
        boxes = [moving(number)] * (score > 0.0) + list(others)
        sure = [score] * (score > 0.0) + [0.9] * len(others)
        frames.append(DetectedFrame(moving(number), np.array(boxes).reshape(-1, 4), np.array(sure)))
    return frames


def test_a_track_goes_on_through_frames_that_a_detector_misses() -> None:
    """Lost frames are lost; but its number stays, as the boxes go on as they went, for three frames and no more."""
    assert track_drive(drive([0.9] * 10), ConstantVelocity, 0.5) == (0.0, 0, 0)
    assert track_drive(drive([0.9] * 4 + [0.0] * 3 + [0.9] * 3), ConstantVelocity, 0.5) == (0.3, 0, 3)
    assert track_drive(drive([0.9] * 4 + [0.0] * 4 + [0.9] * 2), ConstantVelocity, 0.5) == (0.4, 1, 4)
    assert track_drive(drive([0.0] * 5), ConstantVelocity, 0.5) == (1.0, 0, 5)


def test_two_that_pass_each_other_keep_their_numbers() -> None:
    tracker, numbers = ConstantVelocity(), []
    for frame in range(12):
        boxes = np.stack([moving(frame), moving(11 - frame) + np.array([0.0, 8.0, 0.0, 8.0])])
        order = [0, 1] if frame % 2 else [1, 0]
        seen = tracker(boxes[order], np.array([0.9, 0.8]))
        numbers.append(tuple(max(seen, key=lambda one: compute_overlaps(one[1][None], box)[0])[0] for box in boxes))
    assert len(numbers) == 12 and len(set(numbers)) == 1


class Replays(nn.Module):
    """A detector that says the boxes of a drive one after the other, and in some frames none that counts."""

    def __init__(self, boxes: Sequence[Sequence[float]], blind: Sequence[int]) -> None:
        super().__init__()
        self.boxes, self.blind = torch.tensor(boxes), set(blind)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        frames = len(images) == len(self.boxes)  # a whole drive, in one batch
        numbers = list(range(len(images))) if frames else [0] * len(images)
        seen = torch.tensor([0.02 if number in self.blind else 0.9 for number in numbers])
        mug = seen + 0.0 * images.mean(dim=(1, 2, 3))
        return self.boxes[numbers][:, None], torch.stack([mug, 0.0 * mug], dim=1)[:, None]


def detector(boxes: Sequence[Sequence[float]], blind: Sequence[int]) -> Any:
    task = {"name": "detection", "unit": "pixels", "boxes": "xyxy"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)  # no gradient
        model = advsearch.load_model(Replays(boxes, blind), labels=("mug", "dog"), input_size=32, task=task)
    return model


@pytest.mark.medium
def test_a_sweep_says_of_a_drive_whose_detector_is_blind_for_three_frames_what_becomes_of_the_track(
    tmp_path: Path,
) -> None:
    task = {"name": "detection", "unit": "pixels", "boxes": "xyxy"}
    whole = [[0.0, 0.0, 32.0, 32.0]]
    first = advsearch.sweep("mug", detector(whole, []), task=task, **DRIVE)
    payloads: list[Any] = [row.payload for row in first.rows()]
    boxes = [[float(side) for side in one["box"] or (0, 0, 1, 1)] for one in payloads]
    seen = sum(one["box"] is not None for one in payloads)
    assert len(boxes) == 16 and seen > 10
    (seeing,) = advsearch.sweep("mug", detector(boxes, []), task=task, **DRIVE).summary.drives or []
    assert seeing.tracks is not None and seeing.tracks.lost.mean == 0.0 == seeing.tracks.switches.mean
    result = advsearch.sweep("mug", detector(boxes, [4, 5, 6]), task=task, run=tmp_path / "run", **DRIVE)
    (blind,) = result.summary.drives or []
    assert blind.tracks is not None and blind.tracks.tracker == "ConstantVelocity"
    assert blind.tracks.lost.mean == pytest.approx(3 / seen)
    assert blind.tracks.longest_gap.mean == pytest.approx(3 * blind.seconds / 15)


@pytest.mark.medium
def test_paint_that_fools_a_detector_along_a_drive_breaks_the_track(tmp_path: Path) -> None:
    """The objective is of detections in single frames, the verdict of tracks: of the clean mug and the painted one."""
    model = advsearch.load_model(
        Finder(), labels=("mug", "bowl", "dog"), input_size=SIDE, task={"name": "detection", "unit": "fractions"}
    )
    asked: dict[str, Any] = {"task": {"name": "detection", "unit": "fractions", "iou": 0.3}, "denoise": "none"}
    found = advsearch.attack(
        "mug", model, controls={"texture": {"resolution": 32}}, over={"path": NEAR}, epsilon=0.5, steps=16,
        draws=2, trials=6, policy="pgd", baseline=False, spp=4, verify_spp=4, measure="no", run=tmp_path / "paint",
        **asked,
    )  # fmt: skip
    assert found.summary.ending == "found", found.summary
    swept = advsearch.sweep(
        None, model, adversarial_of=tmp_path / "paint", path="approach", fps=1.0, trials=0, spp=8, **asked
    )
    clean, painted = swept.summary.drives or []
    assert clean.tracks is not None and painted.tracks is not None
    assert clean.tracks.lost.mean == 0.0 and painted.tracks.lost.mean > 0.8
    assert painted.tracks.longest_gap.mean > 5.0 > clean.tracks.longest_gap.mean
