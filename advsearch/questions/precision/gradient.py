"""Error and direction of each control's gradient against run time, estimator by estimator."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from advsearch import seeds
from advsearch.engine.gradients import Estimate, Loss, Probe, agreement, estimated, reference
from advsearch.questions.precision.points import (
    INDEPENDENT,
    STRATIFIED,
    UNKNOWN,
    Array,
    MeasuredSetting,
    ReferenceValue,
    Theory,
    reference_of,
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
from advsearch.scene.gradients import BY_ADJOINT, Group, compared
from advsearch.scene.mitsuba_backend.surface import RAYS
from advsearch.scene.renderer import Renderer
from advsearch.scene.surface.renderer import SurfaceRenderer, why_not_kept
from advsearch.scene.transport.matrix import LinearRenderer, linear_inputs

COUNTS = (4, 8, 16, 32, 64, 128, 256)
BY_COORDINATE = 32
"""Sets of at most so many coordinates have a reference by differences, coordinate by coordinate."""
ADJOINT_COST = {"adjoint": 3.0, "material": 60.0}
"""An adjoint takes about as long as so many renders, the kernels that the material form compiles included; any other
as the dearest of these. It only decides what is measured first."""
MATRIX, SURFACE_LIGHT = "matrix", "surface light"
"""The series of what is predicted: by a matrix of light transport, from as many samples a pixel as its points have, and
by light on surfaces, whose pictures take so many rays a pixel."""
COUNTS_OF = {MATRIX: (16, 64, 256), SURFACE_LIGHT: (RAYS,)}
"""Samples of predicted pictures."""
COST_OF = {MATRIX: 3.0, SURFACE_LIGHT: 32.0}
"""To make one and use it takes about as long as so many renders of as many samples."""
CHECK_SPP = 64


@dataclass(frozen=True)
class GradientPart:
    """Coordinates of one control whose gradient one call of an estimator answers; named with parameters where a control
    has several."""

    name: str
    groups: tuple[Group, ...]
    estimators: tuple[str, ...]

    @property
    def names(self) -> set[str]:
        """Of the groups."""
        return {group.name for group in self.groups}

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return sum(group.size for group in self.groups)

    def of(self, gradient: Tensor) -> Array:
        """Return the part's entries (n,) of a whole gradient (d,)."""
        return flat(torch.cat([gradient[group.coordinates] for group in self.groups]))


def estimated_parts(
    groups: Sequence[Group], *, linear: bool, by_matrix: Collection[str] = (), ways: Sequence[str] = (MATRIX,)
) -> list[GradientPart]:
    """Return the parts of a space with the estimators that are valid for them, and the `ways` to predict groups in
    `by_matrix`.

    Of a linear loss, differences of the loss are those of the picture, and left out.
    """
    sets: dict[tuple[str, tuple[str, ...]], list[Group]] = {}
    for group in groups:
        if group.valid:
            sets.setdefault((group.control, group.valid), []).append(group)
    several = {control for control, _ in sets if sum(name == control for name, _ in sets) > 1}
    found = []
    for (control, valid), members in sets.items():
        names = ",".join(one.parameter for one in members)
        if len(names) > 28:
            names = f"{members[0].parameter},... ({len(members)})"
        worth = compared(valid, sum(one.size for one in members))
        usable = [one for one in worth if not (linear and one == "secant")]
        usable += ways if all(one.name in by_matrix for one in members) else []
        found.append(
            GradientPart(f"{control}.{names}" if control in several else control, tuple(members), tuple(usable))
        )
    return found


def matrix_groups(renderer: Renderer) -> frozenset[str]:
    """Return the names of the groups that change base colours only, so that a matrix gives their gradient."""
    linear = linear_inputs(renderer)
    routes = {group.name: renderer.routes.get(group.name, frozenset()) for group in renderer.plan.groups}
    return frozenset(name for name, inputs in routes.items() if inputs and inputs <= linear)


def ways_to_predict(renderer: Renderer) -> list[str]:
    """Return what predicts pictures of a renderer: a matrix where something changes base colours only, and light on
    surfaces where it may be kept there. How noise is taken out does not matter."""
    clean = renderer.like(denoiser="oidn")
    by_matrix = bool(matrix_groups(renderer)) and not renderer.scene.volumetric
    return [MATRIX] * by_matrix + [SURFACE_LIGHT] * (why_not_kept(clean) is None)


def predicting(way: str, renderer: Renderer, u: Tensor, seed: int, spp: int) -> Renderer:
    """Return a renderer of what is predicted in a way, made at u."""
    if way == SURFACE_LIGHT:
        return SurfaceRenderer(renderer, u, seed).renderer
    return LinearRenderer(renderer, u, seed, spp=spp).renderer


def theory_of(estimator: str, sampler: str) -> Theory:
    """Return the slope that theory gives the error of an estimator against samples: the interior adjoint is an unbiased
    mean of samples; differences have the bias of their step, and the material form has its limits."""
    if estimator != "adjoint":
        return UNKNOWN
    return INDEPENDENT if sampler == "independent" else STRATIFIED


class GradientBench:
    """Takes gradients (d,) of one part of a space at u by every estimator and compares them with a reference.

    References are taken with a renderer that does the same with a better sampler, and by what carries out parts of
    them, of a way to take it and samples, if not this process.
    """

    def __init__(
        self,
        renderer: Renderer,
        loss: Loss,
        u: Tensor,
        part: GradientPart,
        exact: Renderer | None = None,
        elsewhere: Callable[[str, int], Parts | None] = lambda by, spp: None,
    ) -> None:
        self._renderer, self._loss, self._u, self.part = renderer, loss, u, part
        self._exact, self.elsewhere = exact or renderer, elsewhere
        self.reference: ReferenceValue | None = None
        self.part_spp = 0
        self.by = ""

    @property
    def settings(self) -> list[MeasuredSetting]:
        """Everything to measure."""
        return [
            MeasuredSetting("gradient", one, count, count * self._cost(one), self.part.name)
            for one in self.part.estimators
            for count in COUNTS_OF.get(one, COUNTS)
        ]

    def refer(self, budget: TimeBudget, seed: int, on_done: Callable[[], None]) -> None:
        """Find the reference: differences at two steps where the coordinates are few, else the mean of an adjoint."""
        few = self.part.size <= BY_COORDINATE
        adjoints = [one for one in self.part.estimators if one in BY_ADJOINT]
        self.by = "differences" if few or not adjoints else adjoints[0]
        if few:
            self._by_differences(budget, seed, on_done)
        else:
            self._by_estimator(budget, seed, on_done)

    def measure(self, setting: MeasuredSetting, seed: int) -> tuple[dict[str, float], float]:
        """Take one gradient and return its error and cosine, and the processor time, the picture itself included; of a
        predicted one that of the matrix or the light too, and beside that what another gradient takes."""
        watch = Stopwatch()
        later: dict[str, float] = {}
        if setting.series in COUNTS_OF:
            made = predicting(setting.series, self._renderer, self._u, seed, setting.spp)
            again = Stopwatch()
            found = self.part.of(made.gradient(self._loss, self._u, seed, setting.spp)[1])
            later = {"later_seconds": again.processor}
        else:
            found = self._estimated(self._renderer, setting.series, seed, setting.spp)
        seconds, later["wall_seconds"] = watch.processor, watch.wall
        assert self.reference is not None
        error, fourth = self.reference.relative_errors(found)
        return {"error": error, "cosine": self.reference.cosine(found), "fourth": fourth, **later}, seconds

    def floor(self, setting: MeasuredSetting, measure: str) -> float:
        """The reference's own relative error."""
        return 0.0 if self.reference is None else self.reference.error

    def bias(self, budget: TimeBudget, seed: int) -> str | None:
        """Check a reference by an adjoint against differences along one direction; a sentence if it is biased."""
        if self.by == "differences" or self.reference is None or budget.left <= 0.0:
            return None
        value = torch.from_numpy(self.reference.value).to(torch.float32)
        probe = self._along(value, seed)
        against = reference(self._exact, self._loss, self._u, probe, seed=seed, spp=CHECK_SPP, repeats=(2, 4))
        own = float(value @ torch.cat([probe.direction[group.coordinates] for group in self.part.groups]))
        if agreement(Estimate(self.by, own, self.reference.error * abs(own), 1, 0.0), against).status != "biased":
            return None
        return (
            f"{self.part.name}: the reference is the mean of {self.by}, and along one direction it gives {own:.3g}, "
            f"differences {against.value:.3g} +- {against.noise:.1g}: its errors leave out that bias"
        )

    def _cost(self, estimator: str) -> float:
        if estimator in COST_OF:
            return COST_OF[estimator]
        renders = sum(replace(group, estimator=estimator).renders for group in self.part.groups)
        if estimator in BY_ADJOINT:
            return 1.0 + ADJOINT_COST[estimator]
        return 1.0 + renders

    def _estimated(self, renderer: Renderer, estimator: str, seed: int, spp: int) -> Array:
        gradient = estimated(renderer, self._loss, self._u, estimator, self.part.names, seed, spp)
        return self.part.of(gradient)

    def part_of(self, by: str, spp: int, seed: int) -> Array:
        """Return a part of the reference: (n,) of an estimator, or (2, n) by differences: the derivatives along each
        coordinate, and how far their two steps are apart."""
        if by != "differences":
            return self._estimated(self._exact, by, seed, spp)
        both = [self._difference(probe, seed, spp) for probe in self._coordinates]
        found: Array = np.array(both, dtype=np.float64).T
        return found

    @property
    def _coordinates(self) -> list[Probe]:
        return [_coordinate(self._u, group, number) for group in self.part.groups for number in range(group.size)]

    def _gathered(self, budget: TimeBudget, seed: int, on_done: Callable[[], None]) -> list[Array]:
        by, spp = self.by, self.part_spp
        parts = self.elsewhere(by, spp) or one_by_one(partial(self.part_of, by, spp))
        return gather(parts, budget, seed=seed, name=f"precision {self.part.name}", on_done=on_done)

    def _by_differences(self, budget: TimeBudget, seed: int, on_done: Callable[[], None]) -> None:
        along = self._coordinates
        rate = seconds_a_sample(lambda spp: self._difference(along[0], seed, spp)) * len(along)
        self.part_spp = part_samples(rate, budget.left, parts=3, counts=(16, 64, 256))
        found = self._gathered(budget, seed, on_done)
        left = float(np.linalg.norm(np.mean([apart for _, apart in found], axis=0))) / 4.0
        self.reference = reference_of([value for value, _ in found], bias=left)

    def _difference(self, probe: Probe, seed: int, spp: int) -> tuple[float, float]:
        """The derivative along a probe, extrapolated to a step of zero, and how far its two steps are apart."""
        one = reference(self._exact, self._loss, self._u, probe, seed=seed, spp=spp, repeats=(1, 1))
        return one.value, one.steps[0] - one.steps[1]

    def _by_estimator(self, budget: TimeBudget, seed: int, on_done: Callable[[], None]) -> None:
        self.by = by = self.by if self.by != "differences" else self.part.estimators[0]
        rate = seconds_a_sample(lambda spp: self._estimated(self._exact, by, seed, spp))
        self.part_spp = part_samples(rate, budget.left)
        self.reference = reference_of(self._gathered(budget, seed, on_done))

    def _along(self, value: Tensor, seed: int) -> Probe:
        """A direction in all coordinates: the signs of the gradient and half as many random ones."""
        generator = torch.Generator().manual_seed(seeds.stream(seed, "precision direction"))
        signs = torch.randint(0, 2, value.shape, generator=generator).to(value.dtype) * 2.0 - 1.0
        mixed = (value.sign() + 0.5 * signs) / 1.5
        direction, begin = torch.zeros_like(self._u), 0
        for group in self.part.groups:
            direction[group.coordinates] = mixed[begin : begin + group.size]
            begin += group.size
        group = self.part.groups[0]
        return Probe(group, group.name, direction, group.step if group.size <= 64 else 0.03)


def _coordinate(u: Tensor, group: Group, number: int) -> Probe:
    direction = torch.zeros_like(u)
    direction[group.begin + number] = 1.0
    return Probe(replace(group, size=1, begin=group.begin + number), f"{group.name}.{number}", direction, group.step)


def flat(values: Tensor) -> Array:
    """Return values of any shape as (n,) float64."""
    found: Array = values.detach().to(torch.float64).reshape(-1).numpy().copy()
    return found
