"""One scene of a sweep, ready to be rendered and shown to the models."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from advsearch.attacks import Trial, margin
from advsearch.controls.base import Value
from advsearch.engine.loading import framed, make_renderer
from advsearch.engine.sweeps.job import Job
from advsearch.engine.sweeps.points import Picks, Points
from advsearch.models import Model
from advsearch.scene.formation import to_8_bit
from advsearch.scene.renderer import Renderer

Values = dict[str, Value]


class View:
    """One scene, ready to be rendered and shown to the models.

    Args:
        job: what is swept.
        number: of the scene.

    Attributes:
        points: its configurations for each size of picture, on which what a control frames may depend.
        renderers: likewise.
        labels: indices of the right answers for each model.
        not_finite: whether a picture had values that are not finite, which were set to 0.
    """

    def __init__(self, job: Job, number: int) -> None:
        place, config = job.places[number], job.config
        self.number, self._job = number, job
        self.points: dict[tuple[int, int], Points] = {}
        self.renderers: dict[tuple[int, int], Renderer] = {}
        for size in dict.fromkeys(job.sizes):
            space = job.space(place, size)
            description = framed(place.scene.description, size)
            self.renderers[size] = make_renderer(
                description, space, size, config.denoise, config.seed, sampler=config.pixel_sampler
            )
            self.points[size] = job.points(space)
        self.labels = tuple(job.label_set(place, model).indices for model in job.models)

    @property
    def not_finite(self) -> bool:
        return any(renderer.non_finite for renderer in self.renderers.values())

    def look(self, picks: Picks, noise: Sequence[int], spp: int) -> tuple[list[list[Trial]], list[list[Values]]]:
        """Render configurations, round to 8 bits and classify.

        Args:
            picks: n of them.
            noise: a seed for each.
            spp: samples a pixel.

        Returns:
            For each model, what it says of each picture; and what is stored of each picture that it was shown.
        """
        pictures, values = {}, {}
        for size, renderer in self.renderers.items():
            u = self.points[size].configurations(picks)
            pictures[size] = self._pictures(renderer, u, noise, spp)
            values[size] = self.points[size].values(u, picks)
        models = zip(self._job.models, self._job.sizes, self.labels, strict=True)
        seen = [judge(model, labels, pictures[size]) for model, size, labels in models]
        return seen, [values[size] for size in self._job.sizes]

    def trial(self, number: int, u: Tensor, seed: int, spp: int) -> Trial:
        """What one model says of one configuration."""
        picture = self._pictures(self.renderers[self._job.sizes[number]], u[None], [seed], spp)
        return judge(self._job.models[number], self.labels[number], picture)[0]

    def picture(self, number: int, u: Tensor, seed: int, spp: int) -> Tensor:
        """The picture (H, W, 3) that one model sees of one configuration."""
        return self._pictures(self.renderers[self._job.sizes[number]], u[None], [seed], spp)[0]

    @staticmethod
    def _pictures(renderer: Renderer, u: Tensor, noise: Sequence[int], spp: int) -> Tensor:
        with torch.no_grad():
            return to_8_bit(
                torch.stack([renderer(one, seed=seed, spp=spp) for one, seed in zip(u, noise, strict=True)])
            )


def judge(model: Model, labels: tuple[int, ...], pictures: Tensor) -> list[Trial]:
    """Return what a model says of pictures (n, H, W, 3); a margin that is not finite becomes NaN."""
    with torch.no_grad():
        logits = model(pictures)
        probabilities = logits.softmax(dim=1)
        predicted = probabilities.argmax(dim=1)
        chosen = probabilities.gather(1, predicted[:, None])[:, 0]
        margins = margin(logits, pictures, labels)
    found = zip(margins.tolist(), predicted.tolist(), chosen.tolist(), strict=True)
    return [Trial(value if math.isfinite(value) else math.nan, index, share) for value, index, share in found]
