"""One batch of a sweep: rendered or predicted, shown to the models and judged. Nothing is stored here.

A batch is its numbers: what comes of it depends on them and on the job alone, so it may be carried out anywhere.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from torch import Tensor

from advsearch.attacks.draws import Seeds
from advsearch.described import Value
from advsearch.engine.rows import no_answer
from advsearch.engine.sweeps.job import Job
from advsearch.engine.sweeps.points import Picks
from advsearch.engine.sweeps.swept_scene import Seen, SweptScene
from advsearch.runs.results.attack import LinearTransport
from advsearch.scene.description import OBJECT
from advsearch.tasks import Judgement
from advsearch.viewer import thumbnails

KIND = "sweep"
"""Rows of the sweep, and the stream of their seeds."""


@dataclass(frozen=True, eq=False)
class Batch:
    """What was seen of neighbouring pictures of one scene.

    Attributes:
        judgements: for each model, of each picture.
        values: for each model, what is stored of each picture that it was shown.
        shown: for each model, of each picture, whether it was predicted, and how many were traced for it.
        seconds: that a configuration took.
        light: what was predicted of the scene so far by whoever made this, for each size of picture.
        not_finite: whether a picture had values that are not finite, which were set to 0.
        sizes: how many pictures of different size there are of each configuration.
        thumbnails: JPEG files by the number of the picture, where they are kept.
        layers: ground truth of each picture and notes on it, by the number of the picture, where it is kept.
    """

    judgements: list[list[Judgement]]
    values: list[list[dict[str, Value]]]
    shown: list[list[tuple[bool, int]]]
    seconds: float
    light: list[LinearTransport | None]
    not_finite: bool
    sizes: int
    thumbnails: Mapping[int, bytes] = field(default_factory=dict)
    layers: Mapping[int, tuple[Mapping[str, object], Mapping[str, str]]] = field(default_factory=dict)

    @classmethod
    def lost(cls, models: int, values: list[dict[str, Value]], why: str) -> Batch:
        """Return what stands for a picture that nobody could make: an answer that is not right, and why."""
        return cls(
            judgements=[[no_answer(why)]] * models,
            values=[values] * models,
            shown=[[(False, 0)]] * models,
            seconds=0.0,
            light=[],
            not_finite=False,
            sizes=0,
        )


class Batches:
    """Carries out batches of a sweep in this process, and holds the scene of the last one.

    Args:
        job: what is swept.
        per_scene: pictures of a scene; the first of the next scene has the next number.
    """

    def __init__(self, job: Job, per_scene: int) -> None:
        self._job, self._per_scene = job, per_scene
        self._seeds = Seeds(job.config.seed, KIND)
        self.view: SweptScene | None = None

    def open(self, scene: int) -> SweptScene:
        """The scene with this number; loading it lets the one before go."""
        if self.view is None or self.view.number != scene:
            self.view = None
            self.view = SweptScene(self._job, scene)
        return self.view

    def __call__(self, numbers: range) -> Batch:
        """Carry out the pictures with these numbers, all of one scene."""
        view = self.open(numbers.start // self._per_scene)
        begun = time.perf_counter()
        picks, seen = self._look(numbers)
        seconds = (time.perf_counter() - begun) / (len(numbers) * len(self._job.models))
        pictures, layers = {}, {}
        for k, number in enumerate(numbers):
            if self._is_kept(judged[k] for judged in seen.judgements):
                pictures[number] = thumbnails.thumbnail(seen.pictures[k])
        if self._job.aovs:
            for number, surfaces in zip(numbers, view.surfaces(picks), strict=True):
                channels = {name: one.numpy() for name, one in surfaces.layers(self._job.aovs, OBJECT).items()}
                layers[number] = channels, surfaces.notes(self._job.aovs)
        return Batch(
            judgements=seen.judgements,
            values=seen.values,
            shown=[[(one.predicted, one.traced) for one in shown] for shown in seen.shown],
            seconds=seconds,
            light=[one.summary() for one in view.light.values()],
            not_finite=view.not_finite,
            sizes=len(view.renderers),
            thumbnails=pictures,
            layers=layers,
        )

    def pictures(self, numbers: range) -> Tensor:
        """Return the pictures (n, H, W, 3) with these numbers, all of one scene, as the first model sees them."""
        return self._look(numbers)[1].pictures

    def _look(self, numbers: range) -> tuple[Picks, Seen]:
        scene = numbers.start // self._per_scene
        view, before = self.open(scene), scene * self._per_scene
        points = next(iter(view.points.values()))
        picks = points.picks(numbers.start - before, len(numbers), before)
        return picks, view.look(picks, [self._seeds(points.draw(number)) for number in numbers])

    def _is_kept(self, seen: Iterable[Judgement]) -> bool:
        """Whether the thumbnail of a picture of which the models say this is kept."""
        asked = self._job.config.keep_pictures
        return asked == "all" or (asked == "wrong" and not all(one.right for one in seen))
