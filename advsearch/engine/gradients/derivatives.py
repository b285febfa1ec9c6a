"""Measure the error, noise and cost of gradient estimators on a scene.

Derivatives are measured along *probes*, which are directions in u. The reference are
central differences at two step sizes, with the same noise on both sides
(docs/gradients.md).
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

# Errors are relative to the size of a derivative, but at least to this fraction of the
# largest derivative of the same control.
MIN_SIZE_FRACTION = 0.1
# Groups of at most this many coordinates get a probe for each of them. Larger groups
# get a single "mixed" probe, along which all coordinates change.
MAX_SINGLE_PROBES = 8
# Up to this size of a group, the planned step for one coordinate is also that of the
# mixed probe. Larger groups have the step `MIXED_STEP` there.
MAX_SIZE_OF_PLANNED_STEP = 64
MIXED_STEP = 0.03
# allowed relative error of the mean of an estimator, besides that by noise
MAX_BIAS = 0.05
# allowed noise of one gradient, relative to its size; above it the status is "noisy"
MAX_NOISE = 0.2
# A reference gets more seeds until its standard error, relative to its size, is this.
MAX_REFERENCE_ERROR = 0.02
N_STANDARD_ERRORS = 2.5  # two means agree within this many standard errors
N_WAVES = 6  # number of waves of a smooth loss
MAX_FREQUENCY = 1.2  # largest number of periods of a wave in the image
FACTORS = (1.0, 3.0, 9.0, 1.0 / 3.0)
"""Steps of differences that are tried in turn, as multiples of the planned one. If an
outline moves, the planned step moves it by a pixel, which is the largest step that the
loss of a classifier allows. A smooth loss allows larger steps, and noise falls with the
step. If no outline moves, the planned step is a fraction of the range, which may be too
large.
"""


@dataclass(frozen=True, eq=False)
class Probe:
    """A direction along which a derivative is measured.

    Attributes:
        group: group of coordinates that change along it.
        name: name of the group, such as "pose.yaw". If a group has several coordinates
            with a probe for each, the index of the coordinate is added.
        direction: (d,) direction; its largest element is 1, and it is zero outside of
            the group.
        step: half of the width of a difference along it.
    """

    group: Group
    name: str
    direction: Tensor
    step: float


class Reference(NamedTuple):
    """A derivative by central differences with many samples.

    Attributes:
        value: mean over seeds, extrapolated from two steps to a step of 0 (Richardson).
        noise: standard error of the value, together with a quarter of the difference
            between both steps.
        steps: mean derivative at the larger and at the smaller step.
        factor: the larger step as a multiple of that of the probe.
    """

    value: float
    noise: float
    steps: tuple[float, float]
    factor: float = 1.0


class GradientEstimate(NamedTuple):
    """The derivative along a probe by one estimator.

    Attributes:
        estimator: name of the estimator.
        value: mean over seeds.
        noise: standard deviation of a single estimate.
        repeats: number of estimates, each with its own seed.
        seconds: median time of an estimate.
        factor: step of differences as a multiple of the planned one.
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
    window). With a hard edge, the loss would be as rough as the details of the image
    that move across it, such as those of a photographed interior. Then finite
    differences of the loss would depend on their step.
    """
    generator = torch.Generator().manual_seed(seeds.derive_seed(seed, "smooth loss"))
    height, width = resolution
    rows = torch.linspace(-1.0, 1.0, height)[:, None, None]
    columns = torch.linspace(-1.0, 1.0, width)[None, :, None]
    weights = torch.zeros(height, width, 3)
    for _ in range(N_WAVES):
        weights += _make_wave(rows, columns, generator)
    hann_window = (
        torch.cos(0.5 * math.pi * rows).square()
        * torch.cos(0.5 * math.pi * columns).square()
    )
    weights *= hann_window / (height * width)
    return partial(_sum_weighted, weights)


def _make_wave(rows: Tensor, columns: Tensor, generator: torch.Generator) -> Tensor:
    """Return a random wave (h, w, 3), another one in each channel.

    Args:
        rows: (h, 1, 1) vertical position, -1 to 1.
        columns: (1, w, 1) horizontal position, -1 to 1.
        generator: generator of random numbers; it advances.
    """
    # each has a number for every channel, uniform in [-1, 1]
    x_frequency, y_frequency, phase, amplitude = (
        torch.rand(3, generator=generator) * 2.0 - 1.0 for _ in range(4)
    )
    # rows and columns run from -1 to 1: a frequency of 1 is one wave over the image
    x_periods = MAX_FREQUENCY * x_frequency * columns
    y_periods = MAX_FREQUENCY * y_frequency * rows
    return amplitude * torch.cos(math.pi * (x_periods + y_periods + phase))


def _sum_weighted(weights: Tensor, image: Tensor) -> Tensor:
    """Return the sum of an image (h, w, 3) times weights of that shape."""
    return (image * weights).sum()


def _rate_estimate(
    estimate: GradientEstimate, reference: Reference, size: float, doubt: float
) -> GradientStatus:
    """Return the first status that holds for an estimate.

    The error is the difference of the estimate and the reference. A part of it, the
    doubt, may be due to the noise of both.

    - "reference unusable": the noise of the reference exceeds `MAX_NOISE`, and the
      error may be due to noise alone;
    - "biased": the error exceeds `MAX_BIAS` by more than the doubt;
    - "noisy": the noise of the estimate exceeds `MAX_NOISE`;
    - "ok".

    Args:
        estimate: estimate to rate.
        reference: reference of the same probe.
        size: size of the derivative; `MAX_NOISE` and `MAX_BIAS` are fractions of it.
        doubt: largest error that may be due to noise.
    """
    difference = abs(estimate.value - reference.value)
    # An error beyond the doubt shows a bias even with a noisy reference.
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
    """Return the errors of an estimate along a probe, and its status.

    Errors are relative to the size of the derivative. That is the reference, but at
    least `MIN_SIZE_FRACTION` of the largest of `others`: a derivative may happen to be
    near zero, and then its relative error does not matter. The doubt is the error that
    may be due to noise: `N_STANDARD_ERRORS` standard errors of both values together.

    Args:
        estimate: estimate to rate.
        reference: reference of the same probe.
        others: references of the other probes of its control.
        probe: the probe that names the row; None leaves its names empty.
        spp: samples per pixel of the estimate, for the row.
    """
    min_sizes = [MIN_SIZE_FRACTION * abs(other.value) for other in others]
    size = max([abs(reference.value), *min_sizes])
    is_zero = size <= 0.0  # all references of the control are 0
    difference = abs(estimate.value - reference.value)
    standard_error = estimate.noise / math.sqrt(max(1, estimate.repeats))
    doubt = N_STANDARD_ERRORS * math.hypot(standard_error, reference.noise)
    # error of a single estimate: that of the mean, and its noise
    single_error = math.hypot(difference, estimate.noise)
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
        error=_divide_by_size(single_error, size),
        bias=_divide_by_size(difference, size),
        # If all references are exactly zero, a relative error is infinite, and it is
        # not in doubt that the estimate is only noise.
        doubt=0.0 if is_zero else _divide_by_size(doubt, size),
        noise=math.inf if is_zero else _divide_by_size(estimate.noise, size),
        value=estimate.value,
        reference=reference.value,
        reference_error=_divide_by_size(reference.noise, size),
    )


def _divide_by_size(value: float, size: float) -> float:
    """Return a value divided by a size; if that is 0, infinity (but 0 for 0 / 0)."""
    if size > 0.0:
        return value / size
    return math.inf if value else 0.0


def list_planned(group: Group) -> list[tuple[str, float]]:
    """Return the planned estimator of a group, with the factor 1 on its step."""
    return [(group.estimator, 1.0)]


def list_attempts(group: Group) -> list[tuple[str, float]]:
    """Return the estimators to measure on a group, each with a factor on its step.

    First come the estimators that are worth comparing (`select_compared`), with the
    planned step; if the user has forced an estimator, only that one. Then an estimator
    that takes differences is tried with the other `FACTORS` on the step. There are two
    of these: differences of the loss ("differences") and of the image ("secant"). One
    is enough, as the loss is linear here (`make_smooth_loss`), so that both agree.
    """
    if group.is_forced:
        attempts = list_planned(group)
    else:
        names = select_compared(group.valid, group.size)
        attempts = [(name, 1.0) for name in names]
    difference_estimators = [
        name for name in ("differences", "secant") if (name, 1.0) in attempts
    ]
    if not difference_estimators:
        return attempts
    other_factors = _list_other_factors(group.step)
    return attempts + [(difference_estimators[0], factor) for factor in other_factors]


def _list_other_factors(planned_step: float) -> list[float]:
    """List the factors but 1 that give different steps, within the allowed range."""
    factors = []
    steps = {planned_step}
    _, max_step = STEP_RANGE
    for factor in FACTORS[1:]:  # the first factor is 1
        # several factors may give the largest step, which is tried once
        step = min(factor * planned_step, max_step)
        if step not in steps:
            steps.add(step)
            factors.append(factor)
    return factors


def find_probes(bench: Bench) -> list[Probe]:
    """Return the directions along which derivatives are measured, for all groups.

    A small group has one for each coordinate, with its planned step. A group of more
    than `MAX_SINGLE_PROBES` coordinates has a single direction, in which all of them
    change. Groups that are not differentiated have none.
    """
    probes = []
    for group in bench.renderer.plan.groups:
        is_differentiated = group.estimator != "none"
        if not is_differentiated:
            continue
        if group.size <= MAX_SINGLE_PROBES:
            probes += _make_single_probes(bench, group)
            continue
        # The planned step is for one coordinate. If very many change at once, it does
        # not fit, and `MIXED_STEP` is taken.
        step = group.step if group.size <= MAX_SIZE_OF_PLANNED_STEP else MIXED_STEP
        direction = _make_mixed_direction(bench, group)
        probes.append(Probe(group, group.name, direction, step))
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
    """Return a direction (d,) in which all coordinates of a group change.

    It is the sum of the signs of the estimator's gradient, along which the derivative
    is large, and half of random signs, so that a part of the gradient that the
    estimator misses counts too. Its largest element is 1.
    """
    # differentiates by this group alone
    plan = restrict_plan(bench.renderer.plan, [group.name])
    full_gradient = bench.compute_gradient(plan, seeds.derive_seed(bench.seed, "probe"))
    gradient = full_gradient[group.coordinates]
    generator = torch.Generator().manual_seed(
        seeds.derive_seed(bench.seed, "probe signs")
    )
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
    at a step of 0 is extrapolated. The reference is accurate enough if the standard
    error of the mean is at most `MAX_REFERENCE_ERROR` of its value.

    1. Each factor is tried with the smallest number of seeds. The first one that is
       accurate enough is taken.
    2. If there is none, seeds are added for the factor with the least noise, until it
       is accurate enough or has the largest number of seeds.

    Args:
        bench: bench of the renderer.
        probe: direction along which the derivative is taken.
        repeats: smallest and largest number of seeds.
        factors: factors on the step of the probe.
    """
    min_repeats, max_repeats = repeats
    pairs_of_factor: dict[float, list[DifferencePair]] = {}
    references: dict[float, Reference] = {}
    for factor in factors:
        pairs = [
            _measure_pair(bench, probe, factor, number) for number in range(min_repeats)
        ]
        reference = _extrapolate(pairs, factor)
        if _compute_standard_error(pairs) <= _find_max_error(reference):
            return reference
        pairs_of_factor[factor] = pairs
        references[factor] = reference
    best = min(references, key=lambda factor: references[factor].noise)
    return _add_seeds(
        bench, probe, references[best], pairs_of_factor[best], max_repeats
    )


def _add_seeds(
    bench: Bench,
    probe: Probe,
    reference: Reference,
    pairs: list[DifferencePair],
    max_repeats: int,
) -> Reference:
    """Return a reference with more seeds, until it is accurate or has the most.

    Args:
        bench: bench of the renderer.
        probe: direction along which the derivative is taken.
        reference: the reference so far.
        pairs: its pairs of differences; new ones are added.
        max_repeats: largest number of seeds.
    """
    factor = reference.factor
    while (
        _compute_standard_error(pairs) > _find_max_error(reference)
        and len(pairs) < max_repeats
    ):
        pairs.append(_measure_pair(bench, probe, factor, len(pairs)))
        reference = _extrapolate(pairs, factor)
    return reference


def _find_max_error(reference: Reference) -> float:
    """Return the largest standard error at which a reference is accurate enough."""
    return MAX_REFERENCE_ERROR * abs(reference.value)


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
    # The planned step is never changed. With a factor, it is limited to the largest
    # one.
    _, max_step = STEP_RANGE
    step = probe.step if factor == 1.0 else min(max_step, factor * probe.step)
    # both differences have the same noise
    noise_seed = seeds.derive_seed(bench.seed, "reference", number)
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

    Its noise is the standard error of that mean, together with an estimate of the error
    that the extrapolation leaves: a quarter of the difference between the derivatives
    by the coarse and by the fine step.

    Args:
        pairs: pairs of differences with a coarse and a fine step.
        factor: factor by which the probe's step was multiplied.
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
    change = step * probe.direction
    width = 2.0 * step
    if probe.group.periodic:
        above = (bench.u + change).remainder(1.0)
        below = (bench.u - change).remainder(1.0)
    else:
        above = (bench.u + change).clamp(0.0, 1.0)
        below = (bench.u - change).clamp(0.0, 1.0)
        changes_single_coordinate = probe.group.size <= MAX_SINGLE_PROBES
        if changes_single_coordinate:
            # less than two steps if one of them was clipped at a bound of the range
            width = float((above - below) @ probe.direction)
    loss_above = _compute_loss_at(bench, above, seed)
    loss_below = _compute_loss_at(bench, below, seed)
    return (loss_above - loss_below) / width


def _compute_loss_at(bench: Bench, u: Tensor, seed: int) -> float:
    """Return the loss of the rendered image of u (d,)."""
    with torch.no_grad():
        return float(bench.loss(bench.renderer(u, seed, bench.spp)))


def measure_estimates(
    bench: Bench, estimator: str, probes: Sequence[Probe], repeats: int, factor: float
) -> list[GradientEstimate]:
    """Measure the derivatives along probes by one estimator.

    All of them come from the same gradients, which contain the groups of the probes.

    Args:
        bench: bench of the renderer.
        estimator: estimator of the groups.
        probes: probes of groups of one control.
        repeats: number of gradients, each with its own seed.
        factor: factor on the planned step of differences.
    """
    group_names = {probe.group.name for probe in probes}
    scaled_plan = bench.renderer.plan.scale_steps(factor)
    plan = restrict_plan(scaled_plan, group_names, estimator)
    # name of the stream of seeds
    stream = estimator if factor == 1.0 else f"{estimator} x {factor:g}"
    gradients, seconds = bench.compute_gradients(plan, stream, repeats)
    return [
        _estimate_along_probe(gradients, probe, estimator, seconds, factor)
        for probe in probes
    ]


def _estimate_along_probe(
    gradients: Tensor, probe: Probe, estimator: str, seconds: float, factor: float
) -> GradientEstimate:
    """Return the estimate along a probe from gradients (repeats, d).

    Args:
        gradients: gradients by one estimator.
        probe: the probe.
        estimator: name of the estimator.
        seconds: median time of a gradient, which is shared by all probes.
        factor: factor on the planned step of differences.
    """
    derivatives = [float(gradient @ probe.direction) for gradient in gradients]
    return GradientEstimate(
        estimator,
        value=statistics.fmean(derivatives),
        noise=statistics.stdev(derivatives),  # of a single gradient
        repeats=len(gradients),
        seconds=seconds,
        factor=factor,
    )


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
        reference_spp: samples per pixel of the references; at least those of the bench
            are used.
        reference_repeats: as `repeats` of `measure_reference`.
        reference_factors: as `factors` of `measure_reference`.
        list_tries: returns the estimators to try on a group, each with a factor on the
            planned step (`list_planned` or `list_attempts`). Factors other than 1 are
            only tried on probes whose status is not "ok" yet.
        repeats: number of gradients by an estimator with the planned step, and number
            with another step, whose estimates have to be more accurate.
        stage: called at the beginning of a stage, with its name and number of steps.
    """
    measure = partial(
        measure_reference, repeats=reference_repeats, factors=reference_factors
    )
    # probes of one control follow one another
    probes_by_control = groupby(find_probes(bench), lambda probe: probe.group.control)
    for control, control_probes in probes_by_control:
        probes = list(control_probes)
        stage(f"references for {control}", len(probes))
        references = {
            probe.name: _load_reference(bench, probe, reference_spp, measure)
            for probe in probes
        }
        probe_sets = _group_by_estimators(probes)
        n_tries = sum(len(list_tries(members[0].group)) for members in probe_sets)
        stage(f"gradients for {control}", n_tries)
        for members in probe_sets:
            # all groups of a set have the same estimators, so the first one suffices
            tries = list_tries(members[0].group)
            yield from _try_estimators(bench, members, references, tries, repeats)


def _group_by_estimators(probes: Sequence[Probe]) -> list[list[Probe]]:
    """Return sets of probes with equal estimators, those that are valid and the planned.

    One gradient gives the derivatives along all probes of a set.
    """
    probe_sets: dict[tuple[tuple[str, ...], str], list[Probe]] = {}
    for probe in probes:
        estimators = (probe.group.valid, probe.group.estimator)
        probe_sets.setdefault(estimators, []).append(probe)
    return list(probe_sets.values())


def _load_reference(
    bench: Bench, probe: Probe, spp: int, measure: Callable[[Bench, Probe], Reference]
) -> Reference:
    """Return the reference along a probe, measured if it is not stored yet.

    Args:
        bench: bench of the renderer.
        probe: direction along which the derivative is taken.
        spp: samples per pixel; at least those of the bench are used.
        measure: measures a reference.
    """
    # The estimator "image" is for controls that change the finished image, such as a
    # blur. They clip the values of pixels. With more noise, more values are clipped, so
    # that the mean image depends on the noise. So estimate and reference need the same
    # sample count.
    acts_on_image = probe.group.estimator == "image"
    reference_spp = bench.spp if acts_on_image else max(bench.spp, spp)
    reference_bench = replace(bench, spp=reference_spp)
    # measured now, or by an earlier run; as JSON
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
    """Yield the errors of estimators along probes, compared with references.

    Args:
        bench: bench of the renderer.
        probes: probes of one control, which share their estimators.
        references: references of all probes of the control, by name.
        tries: estimators, each with a factor on the planned step. Those with the factor
            1 come first, for all probes; others are for probes that were not "ok".
        repeats: number of gradients with the factor 1, and with any other factor.
    """
    ok_names: set[str] = set()
    planned_repeats, other_repeats = repeats
    for estimator, factor in tries:
        is_planned = factor == 1.0
        tried_probes = [
            probe for probe in probes if is_planned or probe.name not in ok_names
        ]
        if not tried_probes:  # all are ok, and only other factors follow
            break
        count = planned_repeats if is_planned else other_repeats
        estimates = _load_estimates(bench, estimator, tried_probes, count, factor)
        rows = _rate_estimates(bench, tried_probes, estimates, references)
        for probe, row in zip(tried_probes, rows, strict=True):
            if row.status == "ok":
                ok_names.add(probe.name)
            yield row
        bench.tick(bench.spp)  # for the progress


def _rate_estimates(
    bench: Bench,
    probes: Sequence[Probe],
    estimates: Sequence[GradientEstimate],
    references: Mapping[str, Reference],
) -> Iterator[Measured]:
    """Yield the errors of one estimate along each probe; see `_try_estimators`."""
    all_references = list(references.values())
    for probe, estimate in zip(probes, estimates, strict=True):
        yield compare_with_reference(
            estimate,
            references[probe.name],
            others=all_references,
            probe=probe,
            spp=bench.spp,
        )


def _load_estimates(
    bench: Bench, estimator: str, probes: Sequence[Probe], repeats: int, factor: float
) -> list[GradientEstimate]:
    """Return the estimates of `measure_estimates`, measured now or by an earlier run."""
    probe_names = ",".join(probe.name for probe in probes)
    stored_estimates = bench.store(
        f"{estimator} x {factor:g} {probe_names}",
        partial(_estimates_as_json, bench, estimator, probes, repeats, factor),
    )
    return [GradientEstimate(**estimate) for estimate in stored_estimates]


def _estimates_as_json(
    bench: Bench, estimator: str, probes: Sequence[Probe], repeats: int, factor: float
) -> list[dict[str, Any]]:
    """Return the estimates of `measure_estimates` as JSON objects.

    See `measure_estimates` for the arguments.
    """
    return [
        estimate._asdict()
        for estimate in measure_estimates(bench, estimator, probes, repeats, factor)
    ]
