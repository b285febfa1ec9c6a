"""Error of the picture, and of the model's margin on it, against run time."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from advsearch.questions.precision.fits import INDEPENDENT, STRATIFIED, UNKNOWN, Theory
from advsearch.questions.precision.gradient import COST_OF, COUNTS_OF, predicting
from advsearch.questions.precision.points import Array, MeasuredSetting, ReferenceValue, reference_through
from advsearch.questions.precision.rounds import Parts, TimeBudget, gather, one_by_one, part_samples
from advsearch.scene.renderer import Renderer

Margin = Callable[[Tensor], float]
"""From a picture (H, W, 3) sRGB to the model's margin in logits."""

POWERS = (4, 16, 64, 256)
COUNTS = {"independent": (4, 8, 16, 32, 64, 128, 256), "orthogonal": (4, 25, 121, 289)}
"""Sample counts of a line, which its sampler takes as they are; `POWERS` for all others. All but the independent
sampler compile a kernel for each count."""
FIRST = frozenset({"independent", "multijitter", "independent + oidn"})
LATER = 6.0
"""Lines that are measured first where time is short; the others count as so many times as dear."""

REFERENCE_SAMPLER = "multijitter"
"""Unbiased as all of them, and a reference of a given error is reached in less than half of the time."""
DENOISED = ("independent", "multijitter")
"""Samplers that are measured with the denoiser too."""
OIDN = " + oidn"
PREDICTED = "predicted"
"""The family of pictures that a matrix of light transport or light on surfaces predicts. They stand beside the raw
reference."""
PATH = "path integrator"
"""Mitsuba's own path tracer, beside the path replay that the renderer uses for pictures too."""


@dataclass(frozen=True)
class Variant:
    """One way to render the picture.

    Attributes:
        series: its name in the diagram.
        family: what it is compared with and recommended among: "raw", "oidn", "depth" or `PREDICTED`.
        sampler: Mitsuba's name.
        denoiser: as of the image formation.
        depth: longest light path in segments.
        integrator: Mitsuba's name.
        theory: slope of its error against samples.
    """

    series: str
    family: str
    sampler: str
    denoiser: str
    depth: int
    integrator: str = "prb"
    theory: Theory = UNKNOWN

    @property
    def counts(self) -> tuple[int, ...]:
        """Sample counts to measure it at; fewer for path depths, which are about their bias."""
        if self.family == PREDICTED:
            return COUNTS_OF[self.series]
        return POWERS[:3] if self.family == "depth" else COUNTS.get(self.series, POWERS)

    @property
    def weight(self) -> float:
        """Cost of a sample, as far as the order of the measurements goes."""
        return (1.0 + 0.1 * self.depth) * (COST_OF.get(self.series) or (1.0 if self.series in FIRST else LATER))


def variants(
    samplers: Sequence[str], depths: Sequence[int], own: int, *, volumetric: bool = False, predicted: Sequence[str] = ()
) -> list[Variant]:
    """Return what is compared: samplers, some with the denoiser, path depths beside the run's own, an integrator, and
    what predicts pictures.

    Args:
        samplers: Mitsuba's names.
        depths: longest light paths; the deepest of them and `own` is the truth for all of these.
        own: the run's own depth.
        volumetric: whether there is a medium, which leaves no choice of integrator.
        predicted: what predicts pictures; see `ways_to_predict`.
    """
    theories = {"independent": INDEPENDENT}
    found = [Variant(one, "raw", one, "none", own, theory=theories.get(one, STRATIFIED)) for one in samplers]
    if not volumetric and "independent" in samplers:
        found.append(Variant(PATH, "raw", "independent", "none", own, "path", INDEPENDENT))
    found += [Variant(one + OIDN, "oidn", one, "oidn", own) for one in DENOISED if one in samplers]
    found += [Variant(one, PREDICTED, REFERENCE_SAMPLER, "oidn", own) for one in predicted]
    compared = sorted({*depths, own}) if depths else []
    return found + [Variant(f"depth {one}", "depth", "independent", "none", one) for one in compared]


class PictureBench:
    """Renders one configuration in every variant and compares it with references.

    Args:
        renderer: of the run.
        u: (d,) the configuration.
        margin: the model's.
        chosen: the variants.
        elsewhere: from a family and samples to what carries out parts of its reference, if not this process.
        there: (d,) where predictions are made, from which they predict the configuration; None for itself.
    """

    def __init__(
        self,
        renderer: Renderer,
        u: Tensor,
        margin: Margin,
        chosen: Sequence[Variant],
        elsewhere: Callable[[str, int], Parts | None] = lambda family, spp: None,
        there: Tensor | None = None,
    ) -> None:
        self._u, self._margin, self.elsewhere = u, margin, elsewhere
        self._there = u if there is None else there
        self.variants = {one.series: one for one in chosen}
        self._renderer = renderer
        self._scenes: dict[tuple[str, int, str], Any] = {}
        self.renderers = {one.series: self._as(one) for one in chosen}
        self._size = (*renderer.formation.resolution, 3)
        self.pictures: dict[str, ReferenceValue] = {}
        self.margins: dict[str, ReferenceValue] = {}
        self.part_spp: dict[str, int] = {}

    @property
    def settings(self) -> list[MeasuredSetting]:
        """Everything to measure."""
        return [
            MeasuredSetting("image", one.series, count, count * one.weight)
            for one in self.variants.values()
            for count in one.counts
        ]

    def refer(self, budget: TimeBudget, seed: int, on_done: Callable[[], None]) -> None:
        """Render the references, one for each family, in shares of a budget."""
        families = [one for one in ("raw", "depth", "oidn") if any(v.family == one for v in self.variants.values())]
        for number, family in enumerate(families):
            share = budget.share(1.0 / (len(families) - number))
            self._refer(family, share, seed, on_done)

    def measure(self, setting: MeasuredSetting, seed: int) -> tuple[dict[str, float], float]:
        """Make one picture and return its errors, and the seconds that rendering and denoising took; of a predicted one
        those of the matrix or the light too, and beside that what another picture takes."""
        variant, later = self.variants[setting.series], dict[str, float]()
        begun = time.perf_counter()
        if variant.family == PREDICTED:
            made = predicting(variant.series, self.renderers[setting.series], self._there, seed, setting.spp)
            radiance = self._radiance(made, seed, setting.spp)
            seconds, again = time.perf_counter() - begun, time.perf_counter()
            radiance = self._radiance(made, seed, setting.spp)
            later = {"later_seconds": time.perf_counter() - again}
        else:
            radiance = self._radiance(self.renderers[setting.series], seed, setting.spp)
            seconds = time.perf_counter() - begun
        picture = self._picture(radiance)
        error = self._reference(variant.family, "error").relative_error(_flat(picture))
        margin = self._reference(variant.family, "margin_error").relative_error(_one(self._margin(picture)))
        return {"error": error, "margin_error": margin, **later}, seconds

    def floor(self, setting: MeasuredSetting, measure: str) -> float:
        """The reference's own relative error for a setting."""
        return self._reference(self.variants[setting.series].family, measure).error

    # ---- inside -----------------------------------------------------------------------------------------------------

    def _reference(self, family: str, measure: str) -> ReferenceValue:
        """What a family is compared with: its margins with its own, but pictures with and without denoiser alike."""
        if measure == "margin_error":
            return self.margins["raw" if family == PREDICTED else family]
        return self.pictures["depth" if family == "depth" else "raw"]

    def _truth(self, family: str) -> Renderer:
        """The renderer of a family's reference."""
        depths = [one.depth for one in self.variants.values() if one.family == family]
        denoiser = "oidn" if family == "oidn" else "none"
        return self._as(Variant(family, family, REFERENCE_SAMPLER, denoiser, max(depths)))

    def part(self, family: str, spp: int, seed: int) -> Array:
        """Return a part of a family's reference: its radiance, flat."""
        return _flat(self._radiance(self._truth(family), seed, spp))

    def _refer(self, family: str, budget: TimeBudget, seed: int, on_done: Callable[[], None]) -> None:
        renderer, pilot = self._truth(family), 16
        for number in range(3):
            begun = time.perf_counter()
            self._radiance(renderer, number, pilot)
            rate = (time.perf_counter() - begun) / pilot
        spp = part_samples(rate, budget.left)

        parts = gather(
            self.elsewhere(family, spp) or one_by_one(partial(self.part, family, spp)),
            budget,
            seed=seed,
            name=f"precision reference {family}",
            on_done=on_done,
        )
        self.part_spp[family] = spp
        self.pictures[family] = reference_through(lambda mean: _flat(self._shown(mean)), parts)
        self.margins[family] = reference_through(lambda mean: _one(self._margin(self._shown(mean))), parts)

    def _as(self, variant: Variant) -> Renderer:
        key = (variant.sampler, variant.depth, variant.integrator)
        if key not in self._scenes:
            scene = self._renderer.scene
            sampler, depth, integrator = key
            self._scenes[key] = scene.like(sampler=sampler, max_depth=depth, integrator=integrator)
        return self._renderer.like(self._scenes[key], denoiser=variant.denoiser)

    def _radiance(self, renderer: Renderer, seed: int, spp: int) -> Tensor:
        with torch.no_grad():
            return renderer.radiance(self._u, seed, spp)

    def _picture(self, radiance: Tensor) -> Tensor:
        with torch.no_grad():
            return self._renderer.space.picture(self._u, self._renderer.formation.display(radiance))

    def _shown(self, mean: Array) -> Tensor:
        return self._picture(torch.from_numpy(mean).to(torch.float32).reshape(self._size))


def _flat(picture: Tensor) -> Array:
    found: Array = picture.detach().to(torch.float64).reshape(-1).numpy().copy()
    return found


def _one(value: float) -> Array:
    found: Array = torch.tensor([value], dtype=torch.float64).numpy()
    return found
