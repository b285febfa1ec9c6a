"""Measures gradient estimators on a scene as it is: error, noise and cost, along *probes*, directions in u, against
central differences with common random numbers at two step sizes (docs/gradients.md)."""

from __future__ import annotations

import base64
import math
import statistics
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.runs.results.base import GradientStatus
from advsearch.scene.gradients import STEP_RANGE, GradientPlan, Group
from advsearch.scene.renderer import Renderer

Loss = Callable[[Tensor], Tensor]
"""From a picture (H, W, 3) sRGB to a number, by differentiable torch operations."""

SMALL = 0.1
"""Share of a control's largest derivative that each of its derivatives counts as, at least."""
COORDINATEWISE = 8
"""Groups of at most this many coordinates are probed one by one."""
TOLERANCE = 0.05
"""Relative error that the mean of an estimator may have beyond the noise."""
LOUD = 0.2
"""Noise of one gradient, relative to its size, from which it is called noisy."""
CONFIDENCE = 2.5
"""Standard errors within which two means agree."""
TURNED = 0.0317
"""Share of a full turn by which periodic coordinates are off their start where gradients are measured."""
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


@dataclass(frozen=True)
class Reference:
    """A derivative by high-sample central differences: the mean over seeds, extrapolated from two `steps` to zero
    (Richardson). Its `noise` is the standard error together with a quarter of the steps' disagreement; `factor` is the
    larger step as a multiple of the probe's."""

    value: float
    noise: float
    steps: tuple[float, float]
    renders: int
    factor: float = 1.0


@dataclass(frozen=True)
class Estimate:
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
    do discrete choices.
    """
    u = renderer.start.clone()
    for group in renderer.plan.groups:
        if group.valid and group.size <= 64 and not group.periodic:
            u[group.coordinates] = u[group.coordinates].clamp(share, 1.0 - share)
        if group.periodic:
            u[group.coordinates] = (u[group.coordinates] + TURNED).remainder(1.0)
    return u


def probes(renderer: Renderer, loss: Loss, u: Tensor, seed: int, spp: int) -> list[Probe]:
    """Return what is worth measuring in a renderer's space: every continuous coordinate, or a direction in many."""
    found = []
    for group in renderer.plan.groups:
        if group.estimator == "none":
            continue
        if group.size <= COORDINATEWISE:
            for number in range(group.size):
                direction = torch.zeros_like(u)
                direction[group.begin + number] = 1.0
                name = group.name if group.size == 1 else f"{group.name}.{number}"
                found.append(Probe(group, name, direction, group.step))
        else:
            found.append(_steep_probe(renderer, loss, u, group, seed, spp))
    return found


def _steep_probe(renderer: Renderer, loss: Loss, u: Tensor, group: Group, seed: int, spp: int) -> Probe:
    """One direction in a large group: mostly the estimator's own gradient, so that there is something to see, and a
    share of random signs, so that what the estimator leaves out shows too."""
    gradient = estimated(renderer, loss, u, group.estimator, [group.name], seeds.stream(seed, "probe"), spp)
    generator = torch.Generator().manual_seed(seeds.stream(seed, "probe signs"))
    part = gradient[group.coordinates]
    signs = torch.randint(0, 2, part.shape, generator=generator).to(part.dtype) * 2.0 - 1.0
    direction = torch.zeros_like(u)
    mixed = part.sign() + 0.5 * signs
    direction[group.coordinates] = mixed / mixed.abs().max().clamp_min(1e-12)
    step = group.step if group.size <= 64 else 0.03
    return Probe(group, group.name, direction, step)


def only(plan: GradientPlan, names: Collection[str], estimator: str | None = None) -> GradientPlan:
    """Return the plan with the groups of these names differentiated, by an estimator or as planned, and no others."""
    groups = tuple(
        replace(one, estimator=(estimator or one.estimator) if one.name in names else "none") for one in plan.groups
    )
    return replace(plan, groups=groups)


def estimated(
    renderer: Renderer,
    loss: Loss,
    u: Tensor,
    estimator: str,
    names: Collection[str],
    seed: int,
    spp: int,
    factor: float = 1.0,
) -> Tensor:
    """Return one gradient (d,) of the groups of these names by one estimator, its differences `factor` times as wide
    as planned; zero elsewhere."""
    return _by(renderer, loss, u, only(renderer.plan.with_steps(factor), names, estimator), seed, spp)


def _by(renderer: Renderer, loss: Loss, u: Tensor, plan: GradientPlan, seed: int, spp: int) -> Tensor:
    """One gradient (d,) by a plan of its own."""
    before, renderer.plan = renderer.plan, plan
    try:
        return renderer.gradient(loss, u, seed, spp)[1]
    finally:
        renderer.plan = before


Keep = Callable[[str, Callable[[], Any]], Any]
"""From the name of a measurement, and what makes it, to a JSON value: one that is known already, or what it makes."""


def measured_now(name: str, measure: Callable[[], Any]) -> Any:
    """Return what a measurement makes: the `Keep` that keeps nothing."""
    return measure()


def gradients(
    renderer: Renderer,
    loss: Loss,
    u: Tensor,
    plan: GradientPlan,
    stream: str,
    *,
    seed: int,
    spp: int,
    repeats: int,
    keep: Keep = measured_now,
    place: str = "",
    tick: Callable[[], None] = lambda: None,
) -> tuple[Tensor, float]:
    """Return gradients (repeats, d) at u by a plan, zero where it takes no derivative, and the median seconds of one.

    Each has a seed of its own: a number in the `stream` of the root `seed`. `keep` is asked for each, as `place` and
    its number; `tick` is called after each.
    """
    parts = [one.coordinates for one in plan.groups if one.estimator != "none"]

    def timed(number: int) -> dict[str, Any]:
        begun = time.perf_counter()
        gradient = _by(renderer, loss, u, plan, seeds.stream(seed, stream, number), spp)
        taken = torch.cat([gradient[part] for part in parts])
        numbers = base64.b64encode(taken.to(torch.float32).numpy().tobytes()).decode("ascii")
        return {"seconds": time.perf_counter() - begun, "numbers": numbers}

    found, times = torch.zeros(repeats, len(u)), []
    for number in range(repeats):
        one = keep(f"{place} gradient {number}", partial(timed, number))
        numbers = torch.frombuffer(bytearray(base64.b64decode(one["numbers"])), dtype=torch.float32)
        for part, values in zip(parts, numbers.split([part.stop - part.start for part in parts]), strict=True):
            found[number, part] = values
        times.append(one["seconds"])
        tick()
    return found, statistics.median(times)


def estimates(
    renderer: Renderer,
    loss: Loss,
    u: Tensor,
    estimator: str,
    along: Sequence[Probe],
    *,
    seed: int,
    spp: int,
    repeats: int = 6,
    factor: float = 1.0,
) -> list[Estimate]:
    """Measure one estimator of one control's groups along some probes of them; `factor` as in `estimated`."""
    plan = only(renderer.plan.with_steps(factor), {probe.group.name for probe in along}, estimator)
    stream = estimator if factor == 1.0 else f"{estimator} x {factor:g}"
    found, seconds = gradients(renderer, loss, u, plan, stream, seed=seed, spp=spp, repeats=repeats)
    values = [[float(one @ probe.direction) for one in found] for probe in along]
    return [
        Estimate(estimator, statistics.fmean(each), statistics.stdev(each), repeats, seconds, factor) for each in values
    ]


def reference(
    renderer: Renderer,
    loss: Loss,
    u: Tensor,
    probe: Probe,
    *,
    seed: int,
    spp: int,
    goal: float = 0.02,
    repeats: tuple[int, int] = (3, 16),
    factors: Sequence[float] = (1.0,),
) -> Reference:
    """Return the derivative along a probe by central differences at two steps, with its noise.

    Seeds are added until the standard error is below `goal` of the value, between the two numbers of `repeats`. With
    several `factors`, each gets the smaller number of seeds, both steps so many times wider, until one is sure enough;
    if none is, the one with the least noise goes on.
    """
    before = renderer.renders
    steps = {factor: probe.step if factor == 1.0 else min(STEP_RANGE[1], factor * probe.step) for factor in factors}
    pairs = {factor: _Pairs(replace(probe, step=step)) for factor, step in steps.items()}
    for factor, tried in pairs.items():
        tried.extend(renderer, loss, u, seed, spp, until=repeats[0])
        if tried.error <= goal * abs(tried.value):
            best = factor
            break
    else:
        best = min(pairs, key=lambda factor: pairs[factor].noise)
        while pairs[best].error > goal * abs(pairs[best].value) and len(pairs[best].wide) < repeats[1]:
            pairs[best].extend(renderer, loss, u, seed, spp, until=len(pairs[best].wide) + 1)
    found = pairs[best]
    return Reference(found.value, found.noise, found.both, renderer.renders - before, best)


@dataclass
class _Pairs:
    """Differences at a probe's step and at half of it, with the same seeds."""

    probe: Probe
    wide: list[float] = field(default_factory=list)
    narrow: list[float] = field(default_factory=list)

    def extend(self, renderer: Renderer, loss: Loss, u: Tensor, seed: int, spp: int, *, until: int) -> None:
        for number in range(len(self.wide), until):
            noise = seeds.stream(seed, "reference", number)
            self.wide.append(_difference(renderer, loss, u, self.probe, self.probe.step, noise, spp))
            self.narrow.append(_difference(renderer, loss, u, self.probe, 0.5 * self.probe.step, noise, spp))

    @property
    def both(self) -> tuple[float, float]:
        return statistics.fmean(self.wide), statistics.fmean(self.narrow)

    @property
    def _at_zero(self) -> list[float]:
        """Extrapolated to a step of zero (Richardson)."""
        return [(4.0 * fine - coarse) / 3.0 for coarse, fine in zip(self.wide, self.narrow, strict=True)]

    @property
    def value(self) -> float:
        return statistics.fmean(self._at_zero)

    @property
    def error(self) -> float:
        values = self._at_zero
        return statistics.stdev(values) / math.sqrt(len(values)) if len(values) > 1 else math.inf

    @property
    def noise(self) -> float:
        """Standard error together with a quarter of the steps' disagreement."""
        wide, narrow = self.both
        return math.hypot(self.error, 0.25 * (wide - narrow))


def _difference(renderer: Renderer, loss: Loss, u: Tensor, probe: Probe, step: float, seed: int, spp: int) -> float:
    """The central difference along a probe, one-sided as far as the box asks for it."""
    move = step * probe.direction
    if probe.group.periodic:
        above, below, width = (u + move).remainder(1.0), (u - move).remainder(1.0), 2.0 * step
    else:
        above, below = (u + move).clamp(0.0, 1.0), (u - move).clamp(0.0, 1.0)
        width = 2.0 * step
        if probe.group.size <= COORDINATEWISE:
            width = float((above - below) @ probe.direction)
    with torch.no_grad():
        return (float(loss(renderer(above, seed, spp))) - float(loss(renderer(below, seed, spp)))) / width


@dataclass(frozen=True)
class Agreement:
    """How good an estimate is beside a reference, see `agreement`, relative to the derivative's size: the `error` of
    the mean, how much of it noise explains (`doubt`: `CONFIDENCE` standard errors of both), and the `noise` of one
    estimate."""

    status: GradientStatus
    error: float
    doubt: float
    noise: float

    @property
    def excess(self) -> float:
        """What of the error noise does not explain."""
        return max(0.0, self.error - self.doubt)


def agreement(estimate: Estimate, against: Reference, beside: Sequence[Reference] = ()) -> Agreement:
    """Say how good an estimate is: "reference unusable" where the reference's noise exceeds `LOUD` and doubt covers
    the error; "biased" where the error exceeds `TOLERANCE` beyond doubt; "noisy" where the noise exceeds `LOUD`;
    otherwise "ok".

    The size that this is relative to is the reference's, or `SMALL` of the largest of those `beside` it, the others of
    its control: a derivative that happens to be near zero has no size of its own to speak of.
    """
    size = max([abs(against.value), *(SMALL * abs(one.value) for one in beside)])
    difference = abs(estimate.value - against.value)
    doubt = CONFIDENCE * math.hypot(estimate.noise / math.sqrt(max(1, estimate.repeats)), against.noise)
    status: GradientStatus
    if difference <= doubt and against.noise > LOUD * size:
        status = "reference unusable"
    elif difference > TOLERANCE * size + doubt:
        status = "biased"
    else:
        status = "noisy" if estimate.noise > LOUD * size else "ok"
    if size == 0.0:
        return Agreement(status, math.inf if difference else 0.0, 0.0, math.inf)
    return Agreement(status, difference / size, doubt / size, estimate.noise / size)
