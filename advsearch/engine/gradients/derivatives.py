"""Measures gradient estimators on a scene as it is: error, noise and cost, along
*probes*, directions in u, against central differences with common random numbers at two
step sizes (docs/gradients.md).
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from typing import Any, NamedTuple

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.engine.gradients.bench import Bench, Loss, restrict_plan
from advsearch.runs.results import GradientStatus, Measured
from advsearch.scene.gradients import STEP_RANGE, Group, select_compared

# size that a derivative has at least for the limits below, as a fraction of the largest
# derivative of its control
MIN_SIZE_FRACTION = 0.1
MAX_SINGLE_PROBES = 8  # groups of at most this many coordinates are probed one by one
MIXED_STEP = 0.03  # along a direction through more than 64 coordinates
# relative error that the mean of an estimator may have beyond the noise
MAX_BIAS = 0.05
# noise of one gradient, relative to its size, from which on it is called noisy
MAX_NOISE = 0.2
# standard error of a reference, relative to its size, from which on it gets no more
# seeds
MAX_REFERENCE_ERROR = 0.02
N_STANDARD_ERRORS = 2.5  # standard errors within which two means agree
# coordinates of a group up to which its planned step is also one along all of them at
# once
MAX_COMMON_STEP_SIZE = 64
# waves of a smooth loss, and how many of them fit into the image at most
N_WAVES = 6
MAX_FREQUENCY = 1.2
FACTORS = (1.0, 3.0, 9.0, 1.0 / 3.0)
"""Steps of differences that are tried in turn, as multiples of the plan's. A step that
moves an outline by a pixel is as wide as a classifier's loss allows; a smooth loss
allows more, and noise falls with the step. What moves no outline has a share of its
range for a step, which may be too wide.
"""


@dataclass(frozen=True, eq=False)
class Probe:
    """A `direction` (d,) along which a derivative is measured, largest element 1, zero
    outside the group; a difference along it has the half-width `step`. The name is
    `control.parameter`, with the coordinate's number if a group has several and they
    are probed singly.
    """

    group: Group
    name: str
    direction: Tensor
    step: float


class Reference(NamedTuple):
    """A derivative by high-sample central differences: the mean over seeds,
    extrapolated from two `steps` to zero (Richardson). Its `noise` is the standard
    error together with a quarter of the steps' disagreement; `factor` is the larger
    step as a multiple of the probe's.
    """

    value: float
    noise: float
    steps: tuple[float, float]
    factor: float = 1.0


class GradientEstimate(NamedTuple):
    """What one estimator says along a probe: the mean over seeds, the standard
    deviation (`noise`) and median seconds of one estimate. Differences are `factor`
    times as wide as planned.
    """

    estimator: str
    value: float
    noise: float
    repeats: int
    seconds: float
    factor: float = 1.0


def make_smooth_loss(resolution: tuple[int, int], seed: int = 0) -> Loss:
    """Return a linear loss with smooth weights, a few random waves in each channel.

    The waves are about as long as the image, and fall to zero at its edge (a Hann
    window). With a hard edge the loss would be as rough as whatever moves across it, a
    photographed interior above all, and its differences would depend on the step.
    """
    generator = torch.Generator().manual_seed(seeds.stream(seed, "smooth loss"))
    height, width = resolution
    rows = torch.linspace(-1.0, 1.0, height)[:, None, None]
    columns = torch.linspace(-1.0, 1.0, width)[None, :, None]
    weights = torch.zeros(height, width, 3)
    for _ in range(N_WAVES):
        # each has a number for every channel, uniform in [-1, 1]
        x_frequency, y_frequency, phase, amplitude = (
            torch.rand(3, generator=generator) * 2.0 - 1.0 for _ in range(4)
        )
        # rows and columns run from -1 to 1: a frequency of 1 is one wave over the image
        weights += amplitude * torch.cos(
            math.pi
            * (
                MAX_FREQUENCY * x_frequency * columns
                + MAX_FREQUENCY * y_frequency * rows
                + phase
            )
        )
    hann_window = (
        torch.cos(0.5 * math.pi * rows).square()
        * torch.cos(0.5 * math.pi * columns).square()
    )
    weights *= hann_window / (height * width)

    def loss(image: Tensor) -> Tensor:
        return (image * weights).sum()

    return loss


def _rate_estimate(
    estimate: GradientEstimate, reference: Reference, size: float, doubt: float
) -> GradientStatus:
    """Return the first status that holds for an estimate.

    - "reference unusable": the reference's noise exceeds `MAX_NOISE`, and the error of
      the mean is within doubt;
    - "biased": the error of the mean exceeds `MAX_BIAS` by more than doubt;
    - "noisy": the estimate's noise exceeds `MAX_NOISE`;
    - "ok".

    Args:
        estimate: estimate to rate.
        reference: reference of the same probe.
        size: size to which the limits are relative.
        doubt: difference of both values that may be due to their noise.
    """
    difference = abs(estimate.value - reference.value)
    # only where the reference's noise may be the reason of the difference
    if difference <= doubt and reference.noise > MAX_NOISE * size:
        return "reference unusable"
    if difference > MAX_BIAS * size + doubt:
        return "biased"
    if estimate.noise > MAX_NOISE * size:
        return "noisy"
    return "ok"


def compare_with_reference(
    estimate: GradientEstimate,
    reference: Reference,
    others: Sequence[Reference] = (),
    probe: Probe | None = None,
    spp: int = 0,
) -> Measured:
    """Return how good an estimate is along a probe, see `_rate_estimate`.

    Errors are relative to a size: that of the reference, but at least
    `MIN_SIZE_FRACTION` of the largest of `others`, since a derivative that happens to
    be near zero says nothing about the size of errors that matter. Doubt is
    `N_STANDARD_ERRORS` standard errors of both values together.

    Args:
        estimate: estimate to rate.
        reference: reference of the same probe.
        others: references of the other probes of its control.
        probe: the probe that names the row; None leaves its names empty.
        spp: samples per pixel of the estimate, for the row.
    """
    min_sizes = [MIN_SIZE_FRACTION * abs(other.value) for other in others]
    size = max([abs(reference.value), *min_sizes])
    difference = abs(estimate.value - reference.value)
    estimate_error = estimate.noise / math.sqrt(max(1, estimate.repeats))
    doubt = N_STANDARD_ERRORS * math.hypot(estimate_error, reference.noise)
    return Measured(
        quantity="derivative",
        control=probe.group.control if probe else "",
        parameter=probe.name.partition(".")[2] if probe else "",
        estimator=estimate.estimator,
        factor=estimate.factor,
        spp=spp,
        repeats=estimate.repeats,
        seconds=estimate.seconds,
        status=_rate_estimate(estimate, reference, size, doubt),
        error=_divide_by_size(math.hypot(difference, estimate.noise), size),
        bias=_divide_by_size(difference, size),
        # with nothing to measure, all is noise and nothing is in doubt
        doubt=_divide_by_size(doubt, size) if size > 0.0 else 0.0,
        noise=_divide_by_size(estimate.noise, size) if size > 0.0 else math.inf,
        value=estimate.value,
        reference=reference.value,
        reference_error=_divide_by_size(reference.noise, size),
    )


def _divide_by_size(value: float, size: float) -> float:
    """Return a value in units of a size; of size 0, any value but 0 is infinite."""
    if size > 0.0:
        return value / size
    return math.inf if value else 0.0


def list_planned(group: Group) -> list[tuple[str, float]]:
    """Return the planned estimator of a group, with the factor 1 on its step."""
    return [(group.estimator, 1.0)]


def list_attempts(group: Group) -> list[tuple[str, float]]:
    """Return the estimators to measure on a group, each with a factor on its step.

    First come all estimators with the planned step, or the only one if it is forced.
    Then one that takes differences, if there is any, with wider steps, as long as these
    differ. One is enough, since differences of the loss and of the image agree for a
    linear loss.
    """
    if group.is_forced:
        attempts = list_planned(group)
    else:
        names = select_compared(group.valid, group.size)
        attempts = [(name, 1.0) for name in names]
    # of those that are tried with the planned step
    difference_estimators = [
        name for name in ("differences", "secant") if (name, 1.0) in attempts
    ]
    steps = {group.step}
    _, max_step = STEP_RANGE
    for factor in FACTORS[1:]:  # the first factor is 1
        step = min(factor * group.step, max_step)
        # beyond the largest step, wider ones are all the same
        if step not in steps:
            steps.add(step)
            attempts += [(name, factor) for name in difference_estimators[:1]]
    return attempts


def find_probes(bench: Bench) -> list[Probe]:
    """Return the directions along which derivatives are measured, for all groups.

    A small group has one for each coordinate, with its planned step. A group of more
    than `MAX_SINGLE_PROBES` coordinates has a single direction through all of them.
    Groups that are not differentiated have none.
    """
    probes = []
    for group in bench.renderer.plan.groups:
        is_differentiated = group.estimator != "none"
        if is_differentiated and group.size > MAX_SINGLE_PROBES:
            # the planned step of a larger group is for one coordinate, not all at once
            step = group.step if group.size <= MAX_COMMON_STEP_SIZE else MIXED_STEP
            direction = _make_mixed_direction(bench, group)
            probes.append(Probe(group, group.name, direction, step))
        elif is_differentiated:
            probes += _make_single_probes(bench, group)
    return probes


def _make_single_probes(bench: Bench, group: Group) -> list[Probe]:
    """Return a probe for each coordinate of a group, with the planned step."""
    probes = []
    for position in range(group.size):
        direction = torch.zeros_like(bench.u)
        direction[group.begin + position] = 1.0
        name = group.name if group.size == 1 else f"{group.name}.{position}"
        probes.append(Probe(group, name, direction, group.step))
    return probes


def _make_mixed_direction(bench: Bench, group: Group) -> Tensor:
    """Return a direction (d,) through all coordinates of a group, whose largest element
    is 1.

    It is the signs of the estimator's own gradient, along which the derivative is
    large, plus half of random signs, so that what the estimator leaves out counts too.
    """
    # differentiates by this group alone
    plan = restrict_plan(bench.renderer.plan, [group.name])
    full_gradient = bench.compute_gradient(plan, seeds.stream(bench.seed, "probe"))
    gradient = full_gradient[group.coordinates]
    generator = torch.Generator().manual_seed(seeds.stream(bench.seed, "probe signs"))
    random_bits = torch.randint(0, 2, gradient.shape, generator=generator)
    random_signs = random_bits.to(gradient.dtype) * 2.0 - 1.0
    # where the gradient is 0, the random sign is left
    mixed = gradient.sign() + 0.5 * random_signs
    direction = torch.zeros_like(bench.u)
    direction[group.coordinates] = mixed / mixed.abs().max().clamp_min(1e-12)
    return direction


def measure_reference(
    bench: Bench,
    probe: Probe,
    *,
    repeats: tuple[int, int] = (3, 16),
    factors: Sequence[float] = (1.0,),
) -> Reference:
    """Return the derivative along a probe by central differences, and its noise.

    Each seed gives two differences, at a step and at half of it, from which the value
    at a step of 0 is extrapolated. Seeds are added until the standard error of the mean
    is below `MAX_REFERENCE_ERROR` of its value.

    Args:
        bench: bench of the renderer.
        probe: direction along which the derivative is taken.
        repeats: smallest and largest number of seeds.
        factors: factors on the probe's step, tried in turn with the smallest number of
            seeds, until the standard error of one is small enough. If none is, seeds
            are added for the factor with the least noise.
    """
    min_repeats, max_repeats = repeats
    pairs_of_factor: dict[float, list[DifferencePair]] = {}
    references: dict[float, Reference] = {}
    for factor in factors:
        pairs = [
            _measure_pair(bench, probe, factor, number) for number in range(min_repeats)
        ]
        reference = _extrapolate(pairs, factor)
        max_error = MAX_REFERENCE_ERROR * abs(reference.value)
        if _compute_standard_error(pairs) <= max_error:
            return reference
        pairs_of_factor[factor] = pairs
        references[factor] = reference
    best = min(references, key=lambda factor: references[factor].noise)
    reference = references[best]
    pairs = pairs_of_factor[best]
    while (
        _compute_standard_error(pairs) > MAX_REFERENCE_ERROR * abs(reference.value)
        and len(pairs) < max_repeats
    ):
        pairs.append(_measure_pair(bench, probe, best, len(pairs)))
        reference = _extrapolate(pairs, best)
    return reference


class DifferencePair(NamedTuple):
    """Central differences along a probe with one seed, at a step and at half of it."""

    coarse: float
    fine: float

    @property
    def extrapolated(self) -> float:
        """The value at a step of 0 (Richardson): the error of a central difference
        falls with the squared step.
        """
        return (4.0 * self.fine - self.coarse) / 3.0


def _measure_pair(
    bench: Bench, probe: Probe, factor: float, number: int
) -> DifferencePair:
    """Measure a pair of differences with a factor on the probe's step.

    `number` is the index of the pair, from which its seed follows.
    """
    # a wider step stays within the largest one; the planned step is taken as it is
    _, max_step = STEP_RANGE
    step = probe.step if factor == 1.0 else min(max_step, factor * probe.step)
    noise_seed = seeds.stream(bench.seed, "reference", number)
    return DifferencePair(
        coarse=_compute_difference(bench, probe, step, noise_seed),
        fine=_compute_difference(bench, probe, 0.5 * step, noise_seed),
    )


def _compute_standard_error(pairs: Sequence[DifferencePair]) -> float:
    """Return the standard error of the mean extrapolated value; infinite for one
    pair.
    """
    if len(pairs) < 2:
        return math.inf
    values = [pair.extrapolated for pair in pairs]
    return statistics.stdev(values) / math.sqrt(len(values))


def _extrapolate(pairs: Sequence[DifferencePair], factor: float) -> Reference:
    """Return the reference that is the mean of pairs, extrapolated to a step of 0.

    Its noise is the standard error of that mean, together with a quarter of the
    difference between both steps, for what the extrapolation leaves of their error.
    `factor` is that on the probe's step.
    """
    coarse_mean = statistics.fmean(pair.coarse for pair in pairs)
    fine_mean = statistics.fmean(pair.fine for pair in pairs)
    step_noise = 0.25 * (coarse_mean - fine_mean)
    return Reference(
        value=statistics.fmean(pair.extrapolated for pair in pairs),
        noise=math.hypot(_compute_standard_error(pairs), step_noise),
        steps=(coarse_mean, fine_mean),
        factor=factor,
    )


def _compute_difference(bench: Bench, probe: Probe, step: float, seed: int) -> float:
    """Return one central difference of the loss along a probe.

    Both sides have the noise of the same seed.
    """
    move = step * probe.direction
    width = 2.0 * step
    if probe.group.periodic:
        above = (bench.u + move).remainder(1.0)
        below = (bench.u - move).remainder(1.0)
    else:
        above = (bench.u + move).clamp(0.0, 1.0)
        below = (bench.u - move).clamp(0.0, 1.0)
        is_single = probe.group.size <= MAX_SINGLE_PROBES
        if is_single:
            # less than two steps if a bound of the range has cut one off
            width = float((above - below) @ probe.direction)
    with torch.no_grad():
        loss_above, loss_below = (
            float(bench.loss(bench.renderer(u, seed, bench.spp)))
            for u in (above, below)
        )
    return (loss_above - loss_below) / width


def measure_estimates(
    bench: Bench, estimator: str, probes: Sequence[Probe], repeats: int, factor: float
) -> list[GradientEstimate]:
    """Measure one estimator of one control's groups along some probes of them.

    Args:
        bench: bench of the renderer.
        estimator: estimator of the groups.
        probes: probes of these groups only.
        repeats: number of gradients, each with its own seed.
        factor: factor on the planned step of differences.
    """
    names = {probe.group.name for probe in probes}
    plan = restrict_plan(bench.renderer.plan.scale_steps(factor), names, estimator)
    stream = estimator if factor == 1.0 else f"{estimator} x {factor:g}"
    gradients, seconds = bench.compute_gradients(plan, stream, repeats)
    estimates = []
    for probe in probes:
        slopes = [float(gradient @ probe.direction) for gradient in gradients]
        mean = statistics.fmean(slopes)
        estimates.append(
            GradientEstimate(
                estimator, mean, statistics.stdev(slopes), repeats, seconds, factor
            )
        )
    return estimates


def measure_derivatives(
    bench: Bench,
    *,
    reference_spp: int,
    reference_repeats: tuple[int, int],
    reference_factors: Sequence[float] = (1.0,),
    list_tries: Callable[[Group], Sequence[tuple[str, float]]] = list_planned,
    repeats: tuple[int, int] = (6, 8),
    stage: Callable[[str, int], None] = lambda name, steps: None,
) -> Iterator[Measured]:
    """Measure the derivative by each parameter of a renderer's space.

    Each estimate is compared with its reference, a central difference of images with
    many samples. Parameters whose derivatives come from one gradient are measured
    together.

    Args:
        bench: bench of the renderer.
        reference_spp: samples per pixel of the references, if more than the bench's.
        reference_repeats: as `repeats` of `measure_reference`.
        reference_factors: as `factors` of `measure_reference`.
        list_tries: returns the estimators to try on a group with factors on its step,
            by default as planned; factors other than 1 are for probes that are not
            `ok` yet.
        repeats: number of gradients by an estimator with the planned step, and with
            another one, which has to be surer.
        stage: called with the name of what begins and its number of steps.
    """
    measure = partial(
        measure_reference, repeats=reference_repeats, factors=reference_factors
    )
    for control, control_probes in groupby(
        find_probes(bench), lambda probe: probe.group.control
    ):
        probes = list(control_probes)
        stage(f"references for {control}", len(probes))
        references = {
            probe.name: _load_reference(bench, probe, reference_spp, measure)
            for probe in probes
        }
        # One gradient gives the derivatives along all probes with equal estimators.
        probe_sets: dict[tuple[tuple[str, ...], str], list[Probe]] = {}
        for probe in probes:
            estimators = (probe.group.valid, probe.group.estimator)
            probe_sets.setdefault(estimators, []).append(probe)
        n_tries = sum(
            len(list_tries(members[0].group)) for members in probe_sets.values()
        )
        stage(f"gradients for {control}", n_tries)
        for members in probe_sets.values():
            # the groups of a set have the same estimators: any of them stands for all
            tries = list_tries(members[0].group)
            yield from _try_estimators(bench, members, references, tries, repeats)


def _load_reference(
    bench: Bench, probe: Probe, spp: int, measure: Callable[[Bench, Probe], Reference]
) -> Reference:
    """Return the reference along a probe, measured if it is not stored yet.

    Args:
        bench: bench of the renderer.
        probe: direction along which the derivative is taken.
        spp: samples per pixel, if more than the bench's.
        measure: measures a reference.
    """
    # What acts on the finished image clips values, so that the mean depends on the
    # noise: estimate and reference need the same sample count there.
    acts_on_image = probe.group.estimator == "image"
    reference_spp = bench.spp if acts_on_image else max(bench.spp, spp)
    reference_bench = replace(bench, spp=reference_spp)
    fields = bench.store(
        f"reference {probe.name}", lambda: measure(reference_bench, probe)._asdict()
    )
    bench.tick(bench.spp)  # for the progress
    return Reference(**fields)


def _try_estimators(
    bench: Bench,
    probes: Sequence[Probe],
    references: Mapping[str, Reference],
    tries: Sequence[tuple[str, float]],
    repeats: tuple[int, int],
) -> Iterator[Measured]:
    """Yield how estimators agree with references along probes.

    Args:
        bench: bench of the renderer.
        probes: probes of one control, which share their estimators.
        references: references by the names of all the control's probes.
        tries: estimators, each with a factor on the planned step. Those with the factor
            1 come first, for all probes; others are for probes that were not `ok`.
        repeats: number of gradients with the factor 1, and with any other factor.
    """
    ok_names: set[str] = set()
    all_references = list(references.values())
    planned_repeats, other_repeats = repeats
    for estimator, factor in tries:
        if factor == 1.0:
            tried_probes = list(probes)
            count = planned_repeats
        else:
            tried_probes = [probe for probe in probes if probe.name not in ok_names]
            count = other_repeats
        if not tried_probes:  # all are ok, and only other factors follow
            break
        probe_names = ",".join(probe.name for probe in tried_probes)
        stored = bench.store(
            f"{estimator} x {factor:g} {probe_names}",
            partial(_estimates_as_json, bench, estimator, tried_probes, count, factor),
        )
        for probe, estimate in zip(tried_probes, stored, strict=True):
            row = compare_with_reference(
                GradientEstimate(**estimate),
                references[probe.name],
                others=all_references,
                probe=probe,
                spp=bench.spp,
            )
            if row.status == "ok":
                ok_names.add(probe.name)
            yield row
        bench.tick(bench.spp)  # for the progress


def _estimates_as_json(
    bench: Bench, estimator: str, probes: Sequence[Probe], repeats: int, factor: float
) -> list[dict[str, Any]]:
    """Return the estimates of `measure_estimates` as JSON objects."""
    return [
        estimate._asdict()
        for estimate in measure_estimates(bench, estimator, probes, repeats, factor)
    ]
