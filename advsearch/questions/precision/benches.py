"""Takes pictures and gradients in every way that is compared, beside references, in
interleaved rounds inside a time budget: every setting once, then every setting again,
so that a machine that slows down does so for all of them.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from advsearch.extend import gradients, seeds
from advsearch.questions.precision.result import PrecisionReference
from advsearch.questions.precision.rule import (
    Array,
    Numbers,
    ReferenceValue,
    SampleSetting,
    estimate_reference,
)

# calls of a setting that have to fit into the budget for it to be begun; the first ones
# take longer
LEAST = 5
COLD = 2
CLAIM = 0.25  # share of the time left that one setting may lay claim to
MOST_PARTS = 64  # independent parts of a reference, at most
Part = TypeVar("Part")


class TimeBudget:
    """Seconds from now on that may be spent, by a clock."""

    def __init__(
        self, seconds: float, clock: Callable[[], float] = time.perf_counter
    ) -> None:
        self.clock, self._end = clock, clock() + seconds

    @property
    def left(self) -> float:
        return max(0.0, self._end - self.clock())

    def share(self, part: float) -> TimeBudget:
        return TimeBudget(part * self.left, self.clock)


@dataclass
class MeasuredRounds:
    """What came out for each setting, the seconds of each call by the clock, and what
    did not fit at all.
    """

    results: dict[SampleSetting, list[Any]] = field(default_factory=dict)
    walls: dict[SampleSetting, list[float]] = field(default_factory=dict)
    left_out: list[SampleSetting] = field(default_factory=list)

    def estimate_call_seconds(self, setting: SampleSetting) -> float:
        """Seconds of a call but the first ones: as the setting's own, else in
        proportion to its line's dearest setting, else at the highest rate of any line;
        0 where nothing is known.
        """
        if setting in self.walls:
            return statistics.median(
                (self.walls[setting][COLD:] or self.walls[setting][-1:])[-3:]
            )
        dearest = {
            known.line: known
            for known in sorted(self.walls, key=lambda each: each.cost)
        }
        rates = {
            line: self.estimate_call_seconds(known) / known.cost
            for line, known in dearest.items()
        }
        return setting.cost * rates.get(setting.line, max(rates.values(), default=0.0))

    def estimate_needed_seconds(self, setting: SampleSetting, left: float) -> float:
        """Seconds that a new setting needs for its calls, with what those begun still
        need for as many. One of these that needs more than a share `CLAIM` of what is
        left turned out too dear, and waits until the end.
        """
        cold = [
            sum(taken[:COLD]) - COLD * self.estimate_call_seconds(at)
            for at, taken in self.walls.items()
            if len(taken) > COLD
        ]
        owed = [
            max(0, LEAST - len(taken)) * self.estimate_call_seconds(at)
            for at, taken in self.walls.items()
        ]
        first = max(0.0, statistics.median(cold)) if cold else 0.0
        return (
            first
            + LEAST * self.estimate_call_seconds(setting)
            + sum(need for need in owed if need <= CLAIM * left)
        )


def measure_in_rounds(
    settings: Iterable[SampleSetting], measure: Callable[[SampleSetting, int], Any], budget: TimeBudget, *,
    rounds: int, seed: int, on_done: Callable[[SampleSetting], None] = lambda setting: None,
) -> MeasuredRounds:  # fmt: skip
    """Measure settings, cheapest first, in rounds until these are done or the budget is
    used up; the first is always measured.

    In the first round a setting is begun only if `LEAST` calls of it, and those that
    the settings before it still need for as many, fit into what is left. The first call
    compiles and records kernels, so that every setting has two at once: without the
    second, nothing would be known of its time. A call that should not fit is not begun:
    a budget is kept to within a setting's first calls. Each call has a seed of its own.
    """
    measured = MeasuredRounds()

    def call(setting: SampleSetting) -> None:
        taken = measured.results.setdefault(setting, [])
        begun = budget.clock()
        stream = f"precision {'/'.join(setting.line)}/{setting.spp}"
        taken.append(measure(setting, seeds.stream(seed, stream, len(taken))))
        measured.walls.setdefault(setting, []).append(budget.clock() - begun)
        on_done(setting)

    for setting in sorted(settings, key=lambda each: each.cost):
        if (
            measured.results
            and measured.estimate_needed_seconds(setting, budget.left) > budget.left
        ):
            measured.left_out.append(setting)
        else:
            call(setting)
            call(setting)
    for _ in range(1, rounds):
        for setting in measured.results:
            if measured.estimate_call_seconds(setting) <= budget.left:
                call(setting)
    return measured


def take_reference_parts(
    part: Callable[[int], Part],
    budget: TimeBudget,
    on_done: Callable[[], None],
    seed: int,
) -> list[Part]:
    """Return independent parts of a reference, each from a seed of its own, as many as
    fit into a budget; at least two, whatever they take: without these, nothing is known
    about the error.
    """
    parts: list[Part] = []
    slowest = 0.0
    while len(parts) < 2 or (len(parts) < MOST_PARTS and slowest < budget.left):
        begun = budget.clock()
        parts.append(part(seeds.stream(seed, "reference", len(parts))))
        slowest = max(budget.clock() - begun, 0.5 * slowest)
        on_done()
    return parts


def choose_part_samples(
    call: Callable[[int], object],
    seconds: float,
    *,
    parts: int = 4,
    counts: Sequence[int] = (16, 64, 256, 1024),
) -> int:
    """Return the largest of some rising sample counts of which `parts` calls fit into
    some seconds; the least if none does. Three calls tell how long one takes, and the
    first ones compile.
    """
    for _ in range(3):
        begun = time.perf_counter()
        call(counts[0])
    rate = (time.perf_counter() - begun) / counts[0]
    return max(
        (count for count in counts if parts * count * rate <= seconds),
        default=counts[0],
    )


def measure_time(take: Callable[[], Part]) -> tuple[Part, dict[str, float]]:
    processor = time.process_time()
    wall = time.perf_counter()
    taken = take()
    return taken, {
        "seconds": time.process_time() - processor,
        "wall_seconds": time.perf_counter() - wall,
    }


# ---- pictures

REFERENCE_SAMPLER = "multijitter"
"""Unbiased as all of them, and a reference of a given error is reached in less than
half of the time.
"""
OIDN = " + oidn"
COUNTS = {"independent": (4, 8, 16, 32, 64, 128, 256), "orthogonal": (4, 25, 121, 289)}
"""Sample counts of a line, which its sampler takes as they are; (4, 16, 64, 256) of the
others. All but the independent sampler compile a kernel for each count.
"""
FIRST = ("independent", "multijitter", "independent" + OIDN)
LATER = 6.0
"""Lines that are measured first where time is short; the others count as so many times
as dear.
"""


class PictureBench:
    """Renders one configuration (d,) with every sampler, with some of them denoised
    too, and compares the pictures and the model's margin on them with references.
    Pictures with and without denoiser have the same, margins their own.
    """

    def __init__(
        self,
        renderer: gradients.Renderer,
        u: Tensor,
        margin: Callable[[Tensor], float],
        samplers: Sequence[str],
    ) -> None:
        self._u = u
        self._margin = margin
        self._space = renderer.space
        self._formation = renderer.formation
        self._lines = [
            *samplers,
            *(
                name + OIDN
                for name in ("independent", REFERENCE_SAMPLER)
                if name in samplers
            ),
        ]
        self._references: dict[tuple[str, str], ReferenceValue] = {}
        scenes = {
            name: renderer.scene.like(sampler=name)
            for name in {*samplers, REFERENCE_SAMPLER}
        }
        self._renderers = {
            line: renderer.like(
                scenes[line.removesuffix(OIDN)], denoiser=get_denoiser(line)
            )
            for line in {*self._lines, REFERENCE_SAMPLER, REFERENCE_SAMPLER + OIDN}
        }
        self.settings = [
            SampleSetting(
                "picture",
                line,
                count,
                count * (1.0 if line in FIRST else LATER),
                family=get_denoiser(line),
            )
            for line in self._lines
            for count in COUNTS.get(line, (4, 16, 64, 256))
        ]

    def refer(
        self, budget: TimeBudget, seed: int, on_done: Callable[[], None]
    ) -> list[PrecisionReference]:
        """Render the references, one for each family, in shares of a budget."""

        def shown(mean: Array) -> Tensor:
            size = (*self._formation.resolution, 3)
            return self._picture(torch.from_numpy(mean).to(torch.float32).reshape(size))

        families = list(dict.fromkeys(map(get_denoiser, self._lines)))
        rows = []
        for number, family in enumerate(families):
            share = budget.share(1.0 / (len(families) - number))
            name = REFERENCE_SAMPLER + OIDN * (family == "oidn")
            take = partial(self._radiance, name)
            spp = choose_part_samples(partial(take, 0), share.left)
            parts = [
                flatten(radiance)
                for radiance in take_reference_parts(
                    partial(take, spp=spp), share, on_done, seed
                )
            ]
            picture = estimate_reference(parts, lambda mean: flatten(shown(mean)))
            margin = estimate_reference(
                parts, lambda mean: np.array([self._margin(shown(mean))])
            )
            self._references["margin", family] = margin
            self._references["picture", family] = self._references.get(
                ("picture", "none"), picture
            )
            rows += [_row("picture", name, picture, spp)] if family == "none" else []
            rows.append(_row("margin", name, margin, spp))
        return rows

    def floor(self, setting: SampleSetting, quantity: str) -> float:
        return self._references[quantity, setting.family].error

    def measure(self, setting: SampleSetting, seed: int) -> dict[str, Numbers]:
        """Make one picture; return how it and the margin compare, and the times of
        rendering and denoising.
        """
        radiance, times = measure_time(
            partial(self._radiance, setting.estimator, seed, setting.spp)
        )
        picture = self._picture(radiance)
        values = {
            "picture": flatten(picture),
            "margin": np.array([self._margin(picture)]),
        }
        beside = {
            name: self._references[name, setting.family].compare(value)
            for name, value in values.items()
        }
        return {name: {**numbers, **times} for name, numbers in beside.items()}

    def _radiance(self, line: str, seed: int, spp: int) -> Tensor:
        with torch.no_grad():
            return self._renderers[line].radiance(self._u, seed, spp)

    def _picture(self, radiance: Tensor) -> Tensor:
        with torch.no_grad():
            return self._space.picture(self._u, self._formation.display(radiance))


def get_denoiser(line: str) -> str:
    return "oidn" if line.endswith(OIDN) else "none"


ADJOINT_COST = {"adjoint": 3.0, "material": 60.0}
"""An adjoint takes about as long as so many renders, the kernels that the material form
compiles included.
"""
# sets of at most so many coordinates have a reference by differences, coordinate by
# coordinate
BY_COORDINATE = 32


@dataclass(frozen=True)
class GradientPart:
    """Coordinates of one control whose gradient one call gives; named with parameters
    where a control has several.
    """

    name: str
    groups: tuple[gradients.Group, ...]
    estimators: tuple[str, ...]

    @property
    def size(self) -> int:
        return sum(group.size for group in self.groups)

    @property
    def group_names(self) -> set[str]:
        return {group.name for group in self.groups}

    def of(self, gradient: Tensor) -> Array:
        return flatten(
            torch.cat([gradient[group.coordinates] for group in self.groups])
        )

    def count_renders(self, estimator: str) -> int:
        """Return the primal renders that one gradient by an estimator takes, beside the
        image itself.
        """
        return sum(replace(group, estimator=estimator).renders for group in self.groups)


def list_gradient_parts(
    groups: Sequence[gradients.Group], *, linear: bool
) -> list[GradientPart]:
    """Return the parts of a space with the estimators that are valid for them. Of a
    linear loss, differences of the loss are those of the picture, and left out.
    """
    sets = gradients.planning.comparable_sets(group for group in groups if group.valid)
    controls = [members[0].control for members, _ in sets]
    parts = []
    for members, candidates in sets:
        name = members[0].control
        if controls.count(name) > 1:
            parameters = ",".join(group.parameter for group in members)
            if len(parameters) > 28:
                parameters = f"{members[0].parameter},... ({len(members)})"
            name = f"{name}.{parameters}"
        estimators = tuple(
            estimator
            for estimator in candidates
            if not (linear and estimator == "secant")
        )
        parts.append(GradientPart(name, members, estimators))
    return parts


class GradientBench:
    """Takes gradients (d,) of one part of a space at u by every estimator and compares
    them with a reference, which is taken with a better sampler: differences at two
    steps where the coordinates are few, else the mean of an adjoint.
    """

    def __init__(
        self,
        renderer: gradients.Renderer,
        loss: gradients.Loss,
        u: Tensor,
        part: GradientPart,
    ) -> None:
        self._renderer = renderer
        self._loss = loss
        self._u = u
        self.part = part
        self._exact = renderer.like(renderer.scene.like(sampler=REFERENCE_SAMPLER))
        self._by_differences = part.size <= BY_COORDINATE
        adjoints = [name for name in part.estimators if name in ADJOINT_COST]
        self._reference_estimator = (
            "differences" if self._by_differences else (*adjoints, *part.estimators)[0]
        )
        self.reference: ReferenceValue | None = None
        self.settings = list[SampleSetting]()
        for name in part.estimators:
            cost = 1.0 + ADJOINT_COST.get(name, part.count_renders(name))
            for count in COUNTS["independent"]:
                self.settings.append(
                    SampleSetting("gradient", name, count, count * cost, part.name)
                )

    def refer(
        self, budget: TimeBudget, seed: int, on_done: Callable[[], None]
    ) -> list[PrecisionReference]:
        """Take the reference within a budget."""
        if self._by_differences:
            take = partial(self._take_derivatives, self._list_probes())
            spp = choose_part_samples(
                partial(take, 0), budget.left, parts=3, counts=(16, 64, 256)
            )
            parts = take_reference_parts(partial(take, spp=spp), budget, on_done, seed)
            bias = (
                float(
                    np.linalg.norm(
                        np.mean([disagreement for _, disagreement in parts], axis=0)
                    )
                )
                / 4.0
            )
            self.reference = estimate_reference(
                [derivatives for derivatives, _ in parts], bias=bias
            )
        else:
            take_gradient = partial(
                self._take_gradient, self._exact, self._reference_estimator
            )
            spp = choose_part_samples(partial(take_gradient, 0), budget.left)
            self.reference = estimate_reference(
                take_reference_parts(
                    partial(take_gradient, spp=spp), budget, on_done, seed
                )
            )
        return [
            _row(
                "gradient",
                self._reference_estimator,
                self.reference,
                spp,
                self.part.name,
            )
        ]

    def _list_probes(self) -> list[gradients.Probe]:
        """Return a probe along each coordinate of the part."""
        probes = []
        for group in self.part.groups:
            for number in range(group.size):
                index = group.begin + number
                direction = torch.zeros_like(self._u)
                direction[index] = 1.0
                coordinate = replace(group, size=1, begin=index)
                probes.append(
                    gradients.Probe(
                        coordinate, f"{group.name}.{number}", direction, group.step
                    )
                )
        return probes

    def _take_derivatives(
        self, probes: Sequence[gradients.Probe], noise: int, spp: int
    ) -> Array:
        """Return, (2, n), the derivative along each probe, extrapolated to a step of
        zero, and how far two steps differ.
        """
        bench = gradients.Bench(self._exact, self._loss, self._u, noise, spp)
        references = [
            gradients.measure_reference(bench, probe, repeats=(1, 1))
            for probe in probes
        ]
        pairs = [
            (reference.value, reference.steps[0] - reference.steps[1])
            for reference in references
        ]
        table: Array = np.array(pairs, dtype=np.float64).T
        return table

    def floor(self, setting: SampleSetting, quantity: str) -> float:
        return self.reference.error if self.reference else 0.0

    def measure(self, setting: SampleSetting, seed: int) -> dict[str, Numbers]:
        """Take one gradient; return how it compares, and its times, the picture itself
        included.
        """
        assert self.reference is not None
        gradient, times = measure_time(
            partial(
                self._take_gradient,
                self._renderer,
                setting.estimator,
                seed,
                setting.spp,
            )
        )
        return {"gradient": {**self.reference.compare(gradient), **times}}

    def bias(self, seed: int) -> str | None:
        """Check a reference by an adjoint against differences along one direction; a
        sentence if it is biased.
        """
        if self._reference_estimator == "differences" or self.reference is None:
            return None
        exact = self._exact
        exact.plan = gradients.restrict_plan(
            exact.plan, self.part.group_names, self._reference_estimator
        )
        bench = gradients.Bench(exact, self._loss, self._u, seed, spp=64)
        probe = gradients.find_probes(bench)[0]
        differences = gradients.measure_reference(bench, probe, repeats=(2, 4))
        slope = float(self.reference.value @ self.part.of(probe.direction))
        noise = self.reference.error * abs(slope)
        estimate = gradients.Estimate(
            self._reference_estimator, slope, noise, repeats=1, seconds=0.0
        )
        if gradients.compare_with_reference(estimate, differences).status != "biased":
            return None
        return (
            f"{self.part.name}: the reference is the mean of "
            f"{self._reference_estimator}, and along one direction it "
            f"gives {slope:.3g}, differences {differences.value:.3g} +- "
            f"{differences.noise:.1g}: its errors leave out "
            "that bias"
        )

    def _take_gradient(
        self, renderer: gradients.Renderer, estimator: str, seed: int, spp: int
    ) -> Array:
        plan = gradients.restrict_plan(renderer.plan, self.part.group_names, estimator)
        return self.part.of(
            gradients.Bench(renderer, self._loss, self._u, seed, spp).gradient(
                plan, seed
            )
        )


def _row(
    quantity: str, name: str, value: ReferenceValue, spp: int, control: str = ""
) -> PrecisionReference:
    return PrecisionReference(
        quantity=quantity, control=control, reference=name, error=value.error, parts=value.parts, spp=spp * value.parts
    )  # fmt: skip


def flatten(values: Tensor) -> Array:
    numbers: Array = values.detach().to(torch.float64).reshape(-1).numpy().copy()
    return numbers
