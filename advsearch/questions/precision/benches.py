"""Error of the picture and of the model's margin, and the best verified objective of each policy, against run time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from advsearch import seeds
from advsearch.attacks import Domain, Evaluate, Evaluation, Policy, StepRecord, search
from advsearch.questions.precision.gradient import COST_OF, COUNTS_OF, flat, predicting
from advsearch.questions.precision.points import (
    INDEPENDENT,
    STRATIFIED,
    UNKNOWN,
    Array,
    MeasuredSetting,
    ReferenceValue,
    Theory,
    quartiles,
    reference_through,
)
from advsearch.questions.precision.rounds import (
    Parts,
    Stopwatch,
    TimeBudget,
    gather,
    one_by_one,
    part_samples,
    seconds_a_sample,
)
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
        depth: longest light path in segments.
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
    what predicts pictures (see `ways_to_predict`).

    The deepest of the depths and `own` is the truth for all of these. A medium leaves no choice of integrator.
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
    """Renders one configuration (d,) in every variant and compares it with references, whose parts, of a family and
    samples, something else may carry out. Predictions are made `there`, at the configuration itself by default."""

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
        """Make one picture and return its errors, and the processor time that rendering and denoising took; of a
        predicted one that of the matrix or the light too, and beside that what another picture takes."""
        variant, watch = self.variants[setting.series], Stopwatch()
        if variant.family == PREDICTED:
            made = predicting(variant.series, self.renderers[setting.series], self._there, seed, setting.spp)
            radiance = self._radiance(made, seed, setting.spp)
            seconds, times, again = watch.processor, {"wall_seconds": watch.wall}, Stopwatch()
            radiance = self._radiance(made, seed, setting.spp)
            times["later_seconds"] = again.processor
        else:
            radiance = self._radiance(self.renderers[setting.series], seed, setting.spp)
            seconds, times = watch.processor, {"wall_seconds": watch.wall}
        picture = self._picture(radiance)
        error, fourth = self._reference(variant.family, "error").relative_errors(flat(picture))
        margin = self._reference(variant.family, "margin_error").relative_error(np.array([self._margin(picture)]))
        return {"error": error, "margin_error": margin, "fourth": fourth, **times}, seconds

    def floor(self, setting: MeasuredSetting, measure: str) -> float:
        """The reference's own relative error for a setting."""
        return self._reference(self.variants[setting.series].family, measure).error

    def _reference(self, family: str, measure: str) -> ReferenceValue:
        """What a family is compared with: its margins with its own, but pictures with and without denoiser alike."""
        if measure == "margin_error":
            return self.margins["raw" if family == PREDICTED else family]
        return self.pictures["depth" if family == "depth" else "raw"]

    def _truth(self, family: str) -> Renderer:
        depths = [one.depth for one in self.variants.values() if one.family == family]
        denoiser = "oidn" if family == "oidn" else "none"
        return self._as(Variant(family, family, REFERENCE_SAMPLER, denoiser, max(depths)))

    def part(self, family: str, spp: int, seed: int) -> Array:
        """Return a part of a family's reference: its radiance, flat."""
        return flat(self._radiance(self._truth(family), seed, spp))

    def _refer(self, family: str, budget: TimeBudget, seed: int, on_done: Callable[[], None]) -> None:
        renderer = self._truth(family)
        spp = part_samples(seconds_a_sample(partial(self._radiance, renderer, 0), calls=3), budget.left)
        parts = self.elsewhere(family, spp) or one_by_one(partial(self.part, family, spp))
        gathered = gather(parts, budget, seed=seed, name=f"precision reference {family}", on_done=on_done)
        self.part_spp[family] = spp
        self.pictures[family] = reference_through(lambda mean: flat(self._shown(mean)), gathered)
        self.margins[family] = reference_through(lambda mean: np.array([self._margin(self._shown(mean))]), gathered)

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


Verified = Callable[[Tensor], float]
"""From a configuration to its objective in fresh renders with enough samples."""


class SearchMark(NamedTuple):
    """How far one search had come: the renders that it could spend until then, the processor time that it had taken
    without verification, and the verified objective of the best configuration until then."""

    renders: int
    seconds: float
    objective: float


@dataclass(frozen=True)
class PolicyCurve:
    """How a policy does, over seeds: at each mark renders, median seconds, and quartiles of the objective."""

    policy: str
    renders: tuple[int, ...]
    seconds: tuple[float, ...]
    objective: tuple[tuple[float, float, float], ...]
    repeats: int


def marks_at(steps: int) -> tuple[int, ...]:
    """Return the numbers of renders at which a search is looked at: powers of two, and all of them."""
    return (*(2**power for power in range(steps.bit_length()) if 2**power < steps), steps)


@dataclass(frozen=True)
class ObjectiveBench:
    """Runs searches and verifies what they held at each mark; `noise` is the root seed of their renders, and `budget`
    ends one that takes longer."""

    evaluate: Evaluate
    noise: int
    domain: Domain
    policies: Mapping[str, Policy[Any]]
    steps: int
    verified: Verified
    budget: TimeBudget

    def settings(self, spp: int) -> list[MeasuredSetting]:
        """One setting a policy."""
        return [MeasuredSetting("objective", name, spp, 1.0) for name in self.policies]

    def measure(self, setting: MeasuredSetting, seed: int) -> tuple[list[SearchMark], float]:
        """Run one search; its marks, verified, and the processor time of search and verification together."""
        watch = Stopwatch()
        held = self._search(setting.series, seed)
        objectives = {u.numpy().tobytes(): u for _, _, u in held}
        verified = {key: self.verified(u) for key, u in objectives.items()}
        marks = [SearchMark(renders, seconds, verified[u.numpy().tobytes()]) for renders, seconds, u in held]
        return marks, watch.processor

    def _search(self, policy: str, seed: int) -> list[tuple[int, float, Tensor]]:
        """The best configuration at each mark, with the seconds until then. Nothing is rendered again at the end."""
        held: list[tuple[int, float, Tensor]] = []
        best: tuple[float, Tensor] = (float("-inf"), self.domain.start)
        wanted = list(marks_at(self.steps))
        watch = Stopwatch()

        def on_step(record: StepRecord, u: Tensor, evaluation: Evaluation) -> None:
            nonlocal best
            seconds = watch.processor
            while wanted and record.renders > wanted[0]:  # what a mark holds was found before this step
                held.append((wanted.pop(0), seconds, best[1]))
            if evaluation.objective > best[0]:
                best = (evaluation.objective, u.detach().clone())
            if wanted and record.renders == wanted[0]:
                held.append((wanted.pop(0), seconds, best[1]))

        search(
            self.evaluate,
            self.domain,
            self.policies[policy],
            steps=self.steps,
            seed=seeds.stream(seed, "policy"),
            candidates=0,
            on_step=on_step,
            kind=f"precision {policy} {seed}",
            noise=self.noise,
            seconds=max(1e-9, self.budget.left),
        )
        if self.budget.left > 0.0:
            held += [(mark, watch.processor, best[1]) for mark in wanted]  # it stopped by itself
        return held


def curve_of(policy: str, searches: Sequence[Sequence[SearchMark]]) -> PolicyCurve:
    """Return medians and quartiles over searches, at the marks that all of them have reached."""
    common = min((len(marks) for marks in searches), default=0)
    columns = [[marks[number] for marks in searches] for number in range(common)]
    return PolicyCurve(
        policy,
        tuple(column[0].renders for column in columns),
        tuple(quartiles([mark.seconds for mark in column])[1] for column in columns),
        tuple(quartiles([mark.objective for mark in column]) for column in columns),
        len(searches),
    )


def missing(curve: PolicyCurve, best: float, start: float) -> tuple[float, ...]:
    """Return the share of the possible gain, from `start` to the best median of any policy, that a policy's median
    misses at each mark."""
    gain = best - start
    return tuple(0.0 if gain <= 0.0 else max(0.0, (best - middle) / gain) for _, middle, _ in curve.objective)


def sooner(curves: Sequence[PolicyCurve], goal: float, best: float, start: float) -> tuple[str, int, float] | None:
    """Return the policy whose median reaches a share of the possible gain in the least time: its name, renders and
    seconds; None where none does."""
    reached = [
        (seconds, renders, curve.policy)
        for curve in curves
        for share, renders, seconds in zip(missing(curve, best, start), curve.renders, curve.seconds, strict=True)
        if share <= goal
    ]
    if not reached or best <= start:
        return None
    seconds, renders, policy = min(reached)
    return policy, renders, seconds
