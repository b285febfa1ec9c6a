"""Drives in pictures: frames as an animation and a strip, and those of an attack's answer along its path."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch
from PIL import Image
from torch import Tensor

from advsearch import seeds
from advsearch.controls.numbers import BoundNumbers
from advsearch.controls.path import PathControl
from advsearch.engine.problem import Problem
from advsearch.report.marks import marked
from advsearch.runs.directory import IMAGES, RunDirectory
from advsearch.runs.files import write_bytes
from advsearch.runs.results.attack import AnswerAlongDrive
from advsearch.scene.formation import to_8_bit

FRAMES = 24
"""Frames of the answer of an attack along its path."""

STRIP, SIDE = 8, 160
"""Pictures of a strip at most, and the height of each in pixels."""

FASTEST = 40
"""Milliseconds that a frame of an animation is shown at least."""

Frames = list[npt.NDArray[np.float32]]


def answer_along(problem: Problem, u: Tensor | None, spp: int, run: RunDirectory | None) -> AnswerAlongDrive | None:
    """Look at an answer, and at the clean scene, at evenly spaced times of the path that varies by chance.

    What varies beside it is as the scene comes.

    Args:
        problem: that was attacked.
        u: (d,) of the answer; None where nothing was searched.
        spp: samples a pixel.
        run: gets ``drive-clean`` and, of the answer, ``drive``, as `write_drive` writes them; None keeps no pictures.

    Returns:
        How many frames are right; None where no path varies.
    """
    found = _path_of(problem)
    if found is None:
        return None
    path, place = found
    start = problem.whole(problem.domain.start)
    times = start.repeat(FRAMES, 1)
    times[:, place] = torch.linspace(0.0, 1.0, FRAMES)
    first, last = (problem.space.describe(times[end], [path])[f"{path.name}.time"]["value"] for end in (0, -1))
    seconds = float(str(last)) - float(str(first))
    counts: dict[str, int] = {}
    for name, at in (("drive-clean", start[: len(problem.domain.start)]), ("drive", u)):
        if at is None:
            continue
        pictures, counts[name] = Frames(), 0
        for number, whole in enumerate(times):
            whole[: len(at)] = at
            with torch.no_grad():
                picture = to_8_bit(problem.renderer(whole, seed=seeds.stream(problem.seed, "drive", number), spp=spp))
            right, marks = problem.seen(picture, whole)
            counts[name] += right
            pictures.append(np.asarray(marked(picture.numpy(), marks), dtype=np.float32))
        if run is not None:
            write_drive(run, name, pictures, seconds)
    return AnswerAlongDrive(
        frames=FRAMES, seconds=seconds, clean=counts["drive-clean"], answer=counts.get("drive"), spp=spp
    )


def _path_of(problem: Problem) -> tuple[BoundNumbers, int] | None:
    """The path among what varies by chance, and the coordinate of the whole space that is its time."""
    begin = 0
    for number, bound in enumerate(problem.space.controls):
        chance = problem.searched is not None and number >= problem.searched
        if chance and isinstance(bound, BoundNumbers) and isinstance(bound.control, PathControl) and bound.groups:
            return bound, begin
        begin += len(bound.start)
    return None


def write_drive(run: RunDirectory, name: str, pictures: Sequence[npt.NDArray[np.float32]], seconds: float) -> None:
    """Write frames (h, w, 3) in sRGB as an animation, NAME.webp, and some side by side, NAME.png, into a run."""
    frames = [Image.fromarray((one * 255.0).round().clip(0, 255).astype(np.uint8)) for one in pictures]
    file = io.BytesIO()
    pause = max(FASTEST, round(1000.0 * seconds / len(frames)))
    frames[0].save(file, "WEBP", save_all=True, append_images=frames[1:], duration=pause, loop=0, quality=80)
    write_bytes(run.path / IMAGES / f"{name}.webp", file.getvalue())
    size = max(1, round(frames[0].width * SIDE / frames[0].height)), SIDE
    small = [frames[number].resize(size, Image.Resampling.LANCZOS) for number in evenly(len(frames), STRIP)]
    run.save_image(name, np.concatenate([np.asarray(one, dtype=np.float32) / 255.0 for one in small], axis=1))


def evenly(count: int, most: int) -> npt.NDArray[np.int64]:
    """Return the numbers of some of so many frames, evenly spaced, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))
