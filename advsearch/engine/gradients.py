"""Measures gradient estimators on a scene as it is: error, noise and cost, along *probes*, directions in u, against
central differences with common random numbers at two step sizes (docs/gradients.md)."""

from __future__ import annotations

import base64
import math
import statistics
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from typing import Any, NamedTuple

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.runs.results import GradientStatus, Measured
from advsearch.scene.gradients import STEP_RANGE, GradientPlan, Group, compared
from advsearch.scene.renderer import Renderer

Loss = Callable[[Tensor], Tensor]
"""From a picture (H, W, 3) sRGB to a number, by differentiable torch operations."""

SMALL = 0.1  # share of a control's largest derivative that each of its derivatives counts as, at least
COORDINATEWISE = 8  # groups of at most this many coordinates are probed one by one
TOLERANCE = 0.05  # relative error that the mean of an estimator may have beyond the noise
LOUD = 0.2  # noise of one gradient, relative to its size, from which it is called noisy
SURE = 0.02  # standard error of a reference, relative to its size, from which on it gets no more seeds
CONFIDENCE = 2.5  # standard errors within which two means agree
TURNED = 0.0317  # share of a full turn by which periodic coordinates are off their start where gradients are measured
FACTORS = (1.0, 3.0, 9.0, 1.0 / 3.0)
"""Steps of differences that are tried in turn, as multiples of the plan's. A step that moves an outline by a pixel is
as wide as a classifier's loss allows; a smooth loss allows more, and noise falls with the step. What moves no outline
has a share of its range for a step, which may be too wide."""


@dataclass(frozen=True, eq=False)
class Probe:
    """A `direction` (d,) along which a derivative is measured, largest element 1, zero outside the group; a difference
    along it has the half-width `step`. The name is `control.parameter`, with the coordinate's number if a group has
    several and they are probed singly."""

    group: Group
    name: str
    direction: Tensor
    step: float


class Reference(NamedTuple):
    """A derivative by high-sample central differences: the mean over seeds, extrapolated from two `steps` to zero
    (Richardson). Its `noise` is the standard error together with a quarter of the steps' disagreement; `factor` is the
    larger step as a multiple of the probe's."""

    value: float
    noise: float
    steps: tuple[float, float]
    renders: int
    factor: float = 1.0


class Estimate(NamedTuple):
    """What one estimator says along a probe: the mean over seeds, the standard deviation (`noise`) and median seconds
    of one estimate. Differences are `factor` times as wide as planned."""

    estimator: str
    value: float
    noise: float
    repeats: int
    seconds: float
    factor: float = 1.0


def smooth_loss(resolution: tuple[int, int], seed: int = 0) -> Loss:
    """Return a linear loss with smooth weights: a sum of a few waves of the picture's size, other in each channel.

    They fall to zero at the picture's edge (a Hann window). With a hard edge the loss would be as rough as whatever
    moves across it, a photographed interior above all, and its differences would depend on the step.
    """
    generator = torch.Generator().manual_seed(seeds.stream(seed, "smooth loss"))
    height, width = resolution
    rows = torch.linspace(-1.0, 1.0, height)[:, None, None]
    columns = torch.linspace(-1.0, 1.0, width)[None, :, None]
    weights = torch.zeros(height, width, 3)
    for _ in range(6):
        across, down, phase, size = (torch.rand(3, generator=generator) * 2.0 - 1.0 for _ in range(4))
        weights += size * torch.cos(math.pi * (1.2 * across * columns + 1.2 * down * rows + phase))
    window = torch.cos(0.5 * math.pi * rows).square() * torch.cos(0.5 * math.pi * columns).square()
    weights *= window / (height * width)

    def loss(image: Tensor) -> Tensor:
        return (image * weights).sum()

    return loss


def inside(renderer: Renderer, share: float = 0.12) -> Tensor:
    """Return a point to measure at: the start, but continuous coordinates with a range at least `share` off its ends.

    Periodic ones are turned a little: starts are often symmetric. Groups with a norm ball stay at their start, and so
    do discrete choices. But what starts at the end of its range as a whole, as a projector's black picture does, is
    measured in the middle: at the end there is a bend, and no difference to either side.
    """
    u = renderer.start.clone()
    for group in renderer.plan.groups:
        if group.valid and group.size <= 64 and not group.periodic:
            u[group.coordinates] = u[group.coordinates].clamp(share, 1.0 - share)
        part = u[group.coordinates]
        if group.valid and group.size > 64 and bool(((part == 0.0) | (part == 1.0)).all()):
            u[group.coordinates] = 0.5
        if group.periodic:
            u[group.coordinates] = (u[group.coordinates] + TURNED).remainder(1.0)
    return u


def only(plan: GradientPlan, names: Collection[str], estimator: str | None = None) -> GradientPlan:
    """Return the plan with the groups of these names differentiated, by an estimator or as planned, and no others."""
    chosen = {group.name: (estimator or group.estimator) if group.name in names else "none" for group in plan.groups}
    return replace(plan, groups=tuple(replace(group, estimator=chosen[group.name]) for group in plan.groups))


def agreement(
    estimate: Estimate, against: Reference, beside: Sequence[Reference] = (), probe: Probe | None = None, spp: int = 0
) -> Measured:
    """Say how good an estimate is along a probe, from so many samples a pixel: "reference unusable" where the
    reference's noise exceeds `LOUD` and doubt (`CONFIDENCE` standard errors of both) covers the error; "biased" where
    the error of the mean exceeds `TOLERANCE` beyond doubt; "noisy" where the noise exceeds `LOUD`; otherwise "ok".

    The size that this is relative to is the reference's, or `SMALL` of the largest of those `beside` it, the others of
    its control: a derivative that happens to be near zero has no size of its own to speak of.
    """
    size = max([abs(against.value), *(SMALL * abs(other.value) for other in beside)])
    difference = abs(estimate.value - against.value)
    doubt = CONFIDENCE * math.hypot(estimate.noise / math.sqrt(max(1, estimate.repeats)), against.noise)
    status: GradientStatus
    if difference <= doubt and against.noise > LOUD * size:
        status = "reference unusable"
    elif difference > TOLERANCE * size + doubt:
        status = "biased"
    else:
        status = "noisy" if estimate.noise > LOUD * size else "ok"

    def relative(value: float) -> float:
        return value / size if size > 0.0 else math.inf if value else 0.0

    return Measured(
        quantity="derivative", control=probe.group.control if probe else "",
        parameter=probe.name.partition(".")[2] if probe else "", estimator=estimate.estimator, factor=estimate.factor,
        spp=spp, repeats=estimate.repeats, seconds=estimate.seconds, status=status,
        error=relative(math.hypot(difference, estimate.noise)), bias=relative(difference),
        doubt=relative(doubt) if size > 0.0 else 0.0, noise=relative(estimate.noise) if size > 0.0 else math.inf,
        value=estimate.value, reference=against.value, reference_error=relative(against.noise),
    )  # fmt: skip


def as_planned(group: Group) -> list[tuple[str, float]]:
    return [(group.estimator, 1.0)]


def attempts(group: Group) -> list[tuple[str, float]]:
    """Return every estimator to measure on a group, with the multiple of the step; then other steps.

    Differences of the loss and of the picture are the same for a linear loss, so that wider steps are tried with one.
    """
    forced, steps = group.is_forced, {group.step}
    tries = as_planned(group) if forced else [(name, 1.0) for name in compared(group.valid, group.size)]
    wide = [name for name in ("differences", "secant") if (name, 1.0) in tries][:1]
    for factor in FACTORS[1:]:
        step = min(factor * group.step, STEP_RANGE[1])
        if step not in steps:
            steps.add(step)
            tries += [(name, factor) for name in wide]
    return tries


Keep = Callable[[str, Callable[[], Any]], Any]
"""From the name of a measurement, and what makes it, to a JSON value: one that is known already, or what it makes."""


@dataclass(frozen=True, eq=False)
class Bench:
    """Where derivatives are measured: of a loss of the picture at u (d,), with `spp` samples a pixel and noise from a
    root `seed`. `keep` is asked for each measurement; `tick` is told the samples of each gradient that is done."""

    renderer: Renderer
    loss: Loss
    u: Tensor
    seed: int
    spp: int
    keep: Keep = lambda name, measure: measure()
    tick: Callable[[int], object] = lambda samples: None

    def gradient(self, plan: GradientPlan, seed: int) -> Tensor:
        """Return one gradient (d,) by a plan, under noise of its own."""
        before, self.renderer.plan = self.renderer.plan, plan
        try:
            return self.renderer.gradient(self.loss, self.u, seed, self.spp)[1]
        finally:
            self.renderer.plan = before

    def gradients(
        self, plan: GradientPlan, stream: str, repeats: int, place: str | None = None
    ) -> tuple[Tensor, float]:
        """Return gradients (repeats, d) by a plan, zero where it takes no derivative, and the median seconds of one;
        the seed of each is its number in a stream. Each is kept where a `place` names them."""
        parts = [group.coordinates for group in plan.groups if group.estimator != "none"]

        def timed(number: int) -> dict[str, Any]:
            begun = time.perf_counter()
            gradient = self.gradient(plan, seeds.stream(self.seed, stream, number))
            taken = torch.cat([gradient[part] for part in parts])
            numbers = base64.b64encode(taken.to(torch.float32).numpy().tobytes()).decode("ascii")
            return {"seconds": time.perf_counter() - begun, "numbers": numbers}

        several, times = torch.zeros(repeats, len(self.u)), []
        for number in range(repeats):
            measure = partial(timed, number)
            kept = measure() if place is None else self.keep(f"{place} gradient {number}", measure)
            numbers = torch.frombuffer(bytearray(base64.b64decode(kept["numbers"])), dtype=torch.float32)
            for part, values in zip(parts, numbers.split([part.stop - part.start for part in parts]), strict=True):
                several[number, part] = values
            times.append(kept["seconds"])
            if place is not None:
                self.tick(self.spp)
        return several, statistics.median(times)

    def probes(self) -> list[Probe]:
        """Return what is worth measuring in a renderer's space: every continuous coordinate, or a direction in many."""
        along = []
        for group in self.renderer.plan.groups:
            if group.estimator == "none":
                continue
            for number in range(group.size) if group.size <= COORDINATEWISE else ():
                direction = torch.zeros_like(self.u)
                direction[group.begin + number] = 1.0
                name = group.name if group.size == 1 else f"{group.name}.{number}"
                along.append(Probe(group, name, direction, group.step))
            if group.size > COORDINATEWISE:
                # mostly the estimator's own gradient, so that there is something to see, and a share of random signs,
                # so that what the estimator leaves out shows too
                gradient = self.gradient(only(self.renderer.plan, [group.name]), seeds.stream(self.seed, "probe"))
                generator = torch.Generator().manual_seed(seeds.stream(self.seed, "probe signs"))
                part, direction = gradient[group.coordinates], torch.zeros_like(self.u)
                signs = torch.randint(0, 2, part.shape, generator=generator).to(part.dtype) * 2.0 - 1.0
                mixed = part.sign() + 0.5 * signs
                direction[group.coordinates] = mixed / mixed.abs().max().clamp_min(1e-12)
                along.append(Probe(group, group.name, direction, group.step if group.size <= 64 else 0.03))
        return along

    def reference(
        self, probe: Probe, *, repeats: tuple[int, int] = (3, 16), factors: Sequence[float] = (1.0,)
    ) -> Reference:
        """Return the derivative along a probe by central differences at two steps, with its noise.

        Seeds are added until the standard error is below `SURE` of the value, between the two numbers of `repeats`.
        With several `factors`, each gets the smaller number of seeds, both steps so many times wider, until one is sure
        enough; if none is, the one with the least noise goes on.
        """
        before, u = self.renderer.renders, self.u
        pairs: dict[float, list[tuple[float, float]]] = {factor: [] for factor in factors}

        def difference(step: float, seed: int) -> float:
            move, width = step * probe.direction, 2.0 * step
            if probe.group.periodic:
                above, below = (u + move).remainder(1.0), (u - move).remainder(1.0)
            else:
                above, below = (u + move).clamp(0.0, 1.0), (u - move).clamp(0.0, 1.0)
                if probe.group.size <= COORDINATEWISE:
                    width = float((above - below) @ probe.direction)
            with torch.no_grad():
                high, low = (float(self.loss(self.renderer(at, seed, self.spp))) for at in (above, below))
            return (high - low) / width

        def measure(factor: float, count: int) -> tuple[Reference, float]:
            """Take differences at a step and at half of it until there are so many pairs, of the same seeds each."""
            step = probe.step if factor == 1.0 else min(STEP_RANGE[1], factor * probe.step)
            for number in range(len(pairs[factor]), count):
                noise = seeds.stream(self.seed, "reference", number)
                pairs[factor].append((difference(step, noise), difference(0.5 * step, noise)))
            coarse, fine = zip(*pairs[factor], strict=True)
            values = [(4.0 * half - whole) / 3.0 for whole, half in pairs[factor]]
            both = statistics.fmean(coarse), statistics.fmean(fine)
            error = statistics.stdev(values) / math.sqrt(len(values)) if len(values) > 1 else math.inf
            noise_of_both = math.hypot(error, 0.25 * (both[0] - both[1]))
            return Reference(statistics.fmean(values), noise_of_both, both, 0, factor), error

        measured = dict[float, tuple[Reference, float]]()
        for factor in factors:
            taken, error = measured[factor] = measure(factor, repeats[0])
            if error <= SURE * abs(taken.value):
                break
        else:
            best = min(measured, key=lambda factor: measured[factor][0].noise)
            taken, error = measured[best]
            while error > SURE * abs(taken.value) and len(pairs[best]) < repeats[1]:
                taken, error = measure(best, len(pairs[best]) + 1)
        return taken._replace(renders=self.renderer.renders - before)

    def estimates(self, estimator: str, along: Sequence[Probe], repeats: int, factor: float) -> list[Estimate]:
        """Measure one estimator of one control's groups along some probes of them, its differences `factor` times as
        wide as planned."""
        plan = only(self.renderer.plan.with_steps(factor), {probe.group.name for probe in along}, estimator)
        stream = estimator if factor == 1.0 else f"{estimator} x {factor:g}"
        several, seconds = self.gradients(plan, stream, repeats)
        values = [[float(gradient @ probe.direction) for gradient in several] for probe in along]
        return [
            Estimate(estimator, statistics.fmean(each), statistics.stdev(each), repeats, seconds, factor)
            for each in values
        ]

    def derivatives(
        self, *, reference_spp: int, seeds_of_reference: tuple[int, int], reference_factors: Sequence[float] = (1.0,),
        tried: Callable[[Group], Sequence[tuple[str, float]]] = as_planned, repeats: tuple[int, int] = (6, 8),
        stage: Callable[[str, int], None] = lambda name, steps: None,
    ) -> Iterator[Measured]:  # fmt: skip
        """Measure the derivative by each parameter of a renderer's space beside differences of many samples.

        Args:
            reference_spp, seeds_of_reference, reference_factors: as of `reference`.
            tried: from a group the estimators to try, by default as planned, with multiples of the step; a wider one on
                what is not `ok` yet.
            repeats: gradients by an estimator at first, and by one with another step, which has to be surer.
            stage: is told what begins and of how many steps.
        """

        def referred(probe: Probe, spp: int) -> dict[str, Any]:
            bench = replace(self, spp=spp)
            return bench.reference(probe, repeats=seeds_of_reference, factors=reference_factors)._asdict()

        def estimated(estimator: str, along: Sequence[Probe], count: int, factor: float) -> list[dict[str, Any]]:
            return [estimate._asdict() for estimate in self.estimates(estimator, along, count, factor)]

        for control, probes in groupby(self.probes(), lambda probe: probe.group.control):
            mine = list(probes)
            stage(f"references for {control}", len(mine))
            references: dict[str, Reference] = {}
            for probe in mine:
                # what acts on the picture clips: its mean depends on the noise, so both get the same
                many = self.spp if probe.group.estimator == "image" else max(self.spp, reference_spp)
                kept = self.keep(f"reference {probe.name}", partial(referred, probe, many))
                references[probe.name] = Reference(**kept)
                self.tick(self.spp)
            sets: dict[tuple[tuple[str, ...], str], list[Probe]] = {}  # each comes from one gradient
            for probe in mine:
                sets.setdefault((probe.group.valid, probe.group.estimator), []).append(probe)
            stage(f"gradients for {control}", sum(len(tried(members[0].group)) for members in sets.values()))
            for members in sets.values():
                good: set[str] = set()
                for estimator, factor in tried(members[0].group):
                    wanted = members if factor == 1.0 else [probe for probe in members if probe.name not in good]
                    if not wanted:
                        break
                    count = repeats[0] if factor == 1.0 else repeats[1]
                    name = f"{estimator} x {factor:g} {','.join(probe.name for probe in wanted)}"
                    estimates = self.keep(name, partial(estimated, estimator, wanted, count, factor))
                    for probe, estimate in zip(wanted, estimates, strict=True):
                        others = list(references.values())
                        row = agreement(Estimate(**estimate), references[probe.name], others, probe, self.spp)
                        good |= {probe.name} if row.status == "ok" else set()
                        yield row
                    self.tick(self.spp)
