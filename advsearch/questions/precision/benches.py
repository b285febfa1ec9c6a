"""Measure images and gradients of several settings against references, in rounds.

In each round every setting is measured once. So if the machine slows down, it does so
for all settings.
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
    Float64Array,
    Numbers,
    ReferenceValue,
    SampleSetting,
    estimate_reference,
)

# number of calls of a setting that have to fit into the budget before it is started
MIN_CALLS = 5
# number of first calls of a setting, which take longer
COLD_CALLS = 2
# maximum fraction of the remaining time for one setting
MAX_SETTING_FRACTION = 0.25
# maximum length of a list of parameters in a name; a longer list is replaced by its
# first parameter
MAX_NAME_LETTERS = 28
# maximum number of independent parts of a reference
MAX_REFERENCE_PARTS = 64
Part = TypeVar("Part")


class TimeBudget:
    """Count down a number of seconds from now on.

    Args:
        seconds: the time.
        clock: returns the current time in seconds.
    """

    def __init__(
        self, seconds: float, clock: Callable[[], float] = time.perf_counter
    ) -> None:
        self.clock = clock
        self._end = clock() + seconds

    @property
    def seconds_left(self) -> float:
        """The remaining seconds, at least 0."""
        return max(0.0, self._end - self.clock())

    def take_fraction(self, fraction: float) -> TimeBudget:
        """Return a budget of a fraction of the remaining seconds."""
        return TimeBudget(fraction * self.seconds_left, self.clock)


@dataclass
class MeasuredRounds:
    """Measurements of settings.

    Attributes:
        results_by_setting: measurements of each setting.
        wall_seconds: seconds of each call of a setting.
        skipped: settings that did not fit into the time.
    """

    results_by_setting: dict[SampleSetting, list[Any]] = field(default_factory=dict)
    wall_seconds: dict[SampleSetting, list[float]] = field(default_factory=dict)
    skipped: list[SampleSetting] = field(default_factory=list)

    def estimate_call_seconds(self, setting: SampleSetting) -> float:
        """Estimate the seconds of a call other than the first ones.

        If the setting has been called, the estimate is the median of its last calls.
        Otherwise it is the cost of the setting times the seconds per unit of cost on
        its line. A line has the same estimator (`estimator_key`) with several sample
        counts; its most expensive setting that has been called decides. If none on the
        line has been called, the slowest line is used. The estimate is 0 if nothing has
        been called.
        """
        if setting in self.wall_seconds:
            return self._median_of_last_calls(setting)
        seconds_per_cost = self._estimate_seconds_per_cost()
        slowest_line = max(seconds_per_cost.values(), default=0.0)
        return setting.relative_cost * seconds_per_cost.get(
            setting.estimator_key, slowest_line
        )

    def _estimate_seconds_per_cost(self) -> dict[Any, float]:
        """Estimate the seconds per unit of cost on each line that has been called."""
        most_expensive_of_line: dict[Any, SampleSetting] = {}
        # Later settings replace earlier ones, so that the most expensive one is left.
        for known_setting in sorted(
            self.wall_seconds, key=lambda earlier_setting: earlier_setting.relative_cost
        ):
            most_expensive_of_line[known_setting.estimator_key] = known_setting
        return {
            line: self._median_of_last_calls(known_setting)
            / known_setting.relative_cost
            for line, known_setting in most_expensive_of_line.items()
        }

    def _median_of_last_calls(self, setting: SampleSetting) -> float:
        """Return the median of the seconds of the last three calls of a setting.

        The first calls (`COLD_CALLS`), which compile kernels, are left out if there are
        others; otherwise the last of them is used.
        """
        call_seconds = self.wall_seconds[setting]
        warm_calls = call_seconds[COLD_CALLS:] or call_seconds[-1:]
        return statistics.median(warm_calls[-3:])

    def fits_in_time(self, setting: SampleSetting, seconds_left: float) -> bool:
        """Return whether a new setting fits into the remaining time."""
        return self.estimate_needed_seconds(setting, seconds_left) <= seconds_left

    def estimate_needed_seconds(
        self, setting: SampleSetting, seconds_left: float
    ) -> float:
        """Estimate the seconds until new and earlier settings have enough calls.

        A setting needs `MIN_CALLS` calls. Its first calls take longer, as they compile
        kernels: the extra time of the new setting is estimated as the median of the
        extra times of earlier ones. An earlier setting whose missing calls need more
        than the fraction `MAX_SETTING_FRACTION` of the remaining time is not counted:
        it gets further calls only if time is left.

        Args:
            setting: the new setting, which has no calls yet.
            seconds_left: seconds left of the budget.
        """
        new_seconds = MIN_CALLS * self.estimate_call_seconds(setting)
        earlier_seconds = self._estimate_missing_seconds(seconds_left)
        return self._estimate_extra_seconds() + new_seconds + earlier_seconds

    def _estimate_extra_seconds(self) -> float:
        """Estimate how much longer the first calls of a setting take than later ones."""
        extras_of_settings = list[float]()
        for setting, call_seconds in self.wall_seconds.items():
            has_warm_calls = len(call_seconds) > COLD_CALLS
            if has_warm_calls:
                warm_seconds = self.estimate_call_seconds(setting)
                first_seconds = sum(call_seconds[:COLD_CALLS])
                extras_of_settings.append(first_seconds - COLD_CALLS * warm_seconds)
        if not extras_of_settings:
            return 0.0
        return max(0.0, statistics.median(extras_of_settings))

    def _estimate_missing_seconds(self, seconds_left: float) -> float:
        """Estimate the seconds until all settings have `MIN_CALLS` calls.

        A setting that needs too much of the remaining time is not counted.
        """
        total_seconds = 0.0
        for setting, call_seconds in self.wall_seconds.items():
            n_missing = max(0, MIN_CALLS - len(call_seconds))
            missing_seconds = n_missing * self.estimate_call_seconds(setting)
            if missing_seconds <= MAX_SETTING_FRACTION * seconds_left:
                total_seconds += missing_seconds
        return total_seconds


def measure_in_rounds(
    settings: Iterable[SampleSetting],
    measure: Callable[[SampleSetting, int], Any],
    budget: TimeBudget,
    *,
    rounds: int,
    seed: int,
    on_done: Callable[[SampleSetting], None] = lambda setting: None,
) -> MeasuredRounds:
    """Measure settings in rounds, cheapest first, until the budget is used up.

    In the first round a setting is started only if there is time for `MIN_CALLS` calls
    of it and of all settings before it. The first setting is always measured. A first
    call compiles kernels and takes longer. So each setting is called `COLD_CALLS` times
    in the first round, and its time is estimated from the last of these calls. A call
    that is not expected to fit is not started: only the first calls of a setting can
    exceed the budget. Each call has its own seed.

    Args:
        settings: the settings, in any order.
        measure: measures a setting with a seed.
        budget: the time of all rounds.
        rounds: number of rounds. A round calls each setting once, the first round
            `COLD_CALLS` times.
        seed: root of the seeds.
        on_done: called with the setting after each call.
    """
    measured = MeasuredRounds()
    timer = _SettingTimer(measured, measure, budget.clock, seed, on_done)
    _measure_first_round(settings, timer, budget)
    for _ in range(1, rounds):
        for setting in measured.results_by_setting:
            if measured.estimate_call_seconds(setting) <= budget.seconds_left:
                timer.measure_once(setting)
    return measured


def _measure_first_round(
    settings: Iterable[SampleSetting], timer: _SettingTimer, budget: TimeBudget
) -> None:
    """Measure each setting that fits into the time, and list the others as skipped."""
    measured = timer.measured
    for setting in sorted(settings, key=lambda setting: setting.relative_cost):
        is_first = not measured.results_by_setting
        if is_first or measured.fits_in_time(setting, budget.seconds_left):
            for _ in range(COLD_CALLS):
                timer.measure_once(setting)
        else:
            measured.skipped.append(setting)


@dataclass(frozen=True)
class _SettingTimer:
    """Measure settings one at a time, and store the results and their times.

    Attributes:
        measured: gets the results and times.
        measure: measures a setting with a seed.
        clock: returns the current time in seconds.
        seed: root of the seeds.
        on_done: called with the setting after each call.
    """

    measured: MeasuredRounds
    measure: Callable[[SampleSetting, int], Any]
    clock: Callable[[], float]
    seed: int
    on_done: Callable[[SampleSetting], None]

    def measure_once(self, setting: SampleSetting) -> None:
        """Measure a setting with its next seed."""
        measurements = self.measured.results_by_setting.setdefault(setting, [])
        wall_seconds = self.measured.wall_seconds
        start = self.clock()
        stream = f"precision {'/'.join(setting.estimator_key)}/{setting.spp}"
        call_seed = seeds.derive_seed(self.seed, stream, len(measurements))
        measurements.append(self.measure(setting, call_seed))
        wall_seconds.setdefault(setting, []).append(self.clock() - start)
        self.on_done(setting)


def take_reference_parts(
    take_part: Callable[[int], Part],
    budget: TimeBudget,
    on_done: Callable[[], None],
    seed: int,
) -> list[Part]:
    """Return as many independent parts of a reference as fit into a budget.

    Each part has its own seed. There are at least two parts, however long they take,
    because the error is estimated from the differences of parts. There are at most
    `MAX_REFERENCE_PARTS`.

    Args:
        take_part: computes a part with a seed.
        budget: time of all parts.
        on_done: called after each part.
        seed: root of the seeds.
    """
    parts: list[Part] = []
    expected_seconds = 0.0  # of the next part
    while len(parts) < MAX_REFERENCE_PARTS:
        if len(parts) >= 2 and expected_seconds >= budget.seconds_left:
            break
        start = budget.clock()
        parts.append(take_part(seeds.derive_seed(seed, "reference", len(parts))))
        # The next part may be as slow as the slowest so far. A slow part counts half
        # after each later part, since it may have been slow by chance.
        expected_seconds = max(budget.clock() - start, 0.5 * expected_seconds)
        on_done()
    return parts


def choose_part_samples(
    call: Callable[[int], object],
    seconds: float,
    *,
    parts: int = 4,
    counts: Sequence[int] = (16, 64, 256, 1024),
) -> int:
    """Return the largest sample count with which all parts fit into some seconds.

    `COLD_CALLS` calls compile kernels; the next call is timed. The time is assumed to
    be proportional to the number of samples.

    Args:
        call: computes a part with a number of samples per pixel.
        seconds: time of all parts together.
        parts: number of parts.
        counts: sample counts, ascending; the first is returned if none fits.
    """
    for _ in range(COLD_CALLS + 1):
        start = time.perf_counter()
        call(counts[0])
    # the time of the last call
    seconds_per_sample = (time.perf_counter() - start) / counts[0]
    fitting = [
        count for count in counts if parts * count * seconds_per_sample <= seconds
    ]
    return max(fitting, default=counts[0])


def run_timed(function: Callable[[], Part]) -> tuple[Part, dict[str, float]]:
    """Call a function; return its result and its times.

    `seconds` is the sum of the time of all processors, `wall_seconds` that of the
    clock.
    """
    process_start = time.process_time()
    wall_start = time.perf_counter()
    result = function()
    return result, {
        "seconds": time.process_time() - process_start,
        "wall_seconds": time.perf_counter() - wall_start,
    }


# ---- pictures

REFERENCE_SAMPLER = "multijitter"
"""Sampler of references. It is unbiased, as all samplers are, and reaches an error in
half of the time of others.
"""
OIDN = " + oidn"  # suffix of the name of a line with denoiser
SAMPLE_COUNTS = {
    "independent": (4, 8, 16, 32, 64, 128, 256),
    "orthogonal": (4, 25, 121, 289),
}
OTHER_SAMPLE_COUNTS = (4, 16, 64, 256)
"""Sample counts of some samplers, and those of all other samplers.

A sampler renders exactly with these counts; others would be rounded up. The independent
sampler has more of them because it does not compile a kernel for each count.
"""
PREFERRED_LINES = ("independent", "multijitter", "independent" + OIDN)
OTHER_LINES_COST = 6.0
"""Lines that are measured first, and the factor on the cost of other lines, which come
later.
"""


class PictureBench:
    """Measure the errors of images of one configuration, and of the model's margin.

    Every sampler is measured, and some of them also with a denoiser. All images have
    the same reference; margins with and without denoiser have different ones. A *line*
    is a sampler with or without denoiser. It is denoted by the name of the sampler,
    followed by `OIDN` if there is a denoiser.

    Attributes:
        settings: all lines with all of their sample counts.
    """

    def __init__(
        self,
        renderer: gradients.Renderer,
        u: Tensor,
        margin: Callable[[Tensor], float],
        samplers: Sequence[str],
    ) -> None:
        """Make a renderer for each line, and list the settings to measure.

        Args:
            renderer: renderer of the scene; its sampler and denoiser are replaced.
            u: (d,) the configuration that is rendered.
            margin: the model's margin on an image (H, W, 3).
            samplers: names of the samplers that are measured.
        """
        self._u = u
        self._margin = margin
        self._space = renderer.space
        self._formation = renderer.formation
        self._estimators = _list_sampler_lines(samplers)
        # references, by quantity ("picture" or "margin") and denoiser ("none", "oidn")
        self._references: dict[tuple[str, str], ReferenceValue] = {}
        self._renderers = _make_renderers(renderer, samplers, self._estimators)
        self.settings = [
            setting
            for line in self._estimators
            for setting in list_image_settings(line)
        ]

    def compute_references(
        self, budget: TimeBudget, seed: int, on_done: Callable[[], None]
    ) -> list[PrecisionReference]:
        """Render the references, one for each denoiser, within a budget.

        A reference is the mean radiance of independent renders, converted to an image.
        Errors of images are measured against the image without denoiser. Errors of
        margins are measured against the margin of the image with the same denoiser.

        Args:
            budget: time of all references.
            seed: seed of the renders.
            on_done: called after each render.

        Returns:
            A row of the result for each reference.
        """
        # "none" comes first, since the estimators without denoiser do: the other
        # references need the reference without denoiser.
        denoisers = list(dict.fromkeys(map(get_denoiser, self._estimators)))
        rows = []
        for index, denoiser in enumerate(denoisers):
            # The remaining time is divided evenly: an earlier reference may have left
            # some of its time.
            n_left = len(denoisers) - index
            rows += self._compute_references_of(
                denoiser, budget.take_fraction(1.0 / n_left), seed, on_done
            )
        return rows

    def _compute_references_of(
        self,
        denoiser: str,
        budget: TimeBudget,
        seed: int,
        on_done: Callable[[], None],
    ) -> list[PrecisionReference]:
        """Render and store the references of lines with a denoiser, or with none.

        The references without denoiser have to be computed first.

        Args:
            denoiser: "none" or "oidn".
            budget: time of these references.
            seed: seed of the renders.
            on_done: called after each render.

        Returns:
            A row of the result for the image (without denoiser only) and one for the
            margin.
        """
        line = REFERENCE_SAMPLER if denoiser == "none" else REFERENCE_SAMPLER + OIDN
        parts, spp = self._render_reference_parts(line, budget, seed, on_done)
        rows = []
        if denoiser == "none":
            image = estimate_reference(parts, self._display_flat_mean)
            self._references["picture", "none"] = image
            rows.append(_make_row("picture", line, image, spp))
        # Denoised images are compared with the reference without denoiser, too.
        self._references["picture", denoiser] = self._references["picture", "none"]
        margin = estimate_reference(parts, self._compute_margin_of_mean)
        self._references["margin", denoiser] = margin
        rows.append(_make_row("margin", line, margin, spp))
        return rows

    def _display_flat_mean(self, mean: Float64Array) -> Float64Array:
        """Return the displayed image of a mean radiance as a vector (n,)."""
        return flatten(self._display_mean(mean))

    def _compute_margin_of_mean(self, mean: Float64Array) -> Float64Array:
        """Return the model's margin on the displayed image of a mean radiance, (1,)."""
        return np.array([self._margin(self._display_mean(mean))])

    def _render_reference_parts(
        self,
        line: str,
        budget: TimeBudget,
        seed: int,
        on_done: Callable[[], None],
    ) -> tuple[list[Float64Array], int]:
        """Render the independent parts of a reference as radiances (H * W * 3,).

        Args:
            line: sampler of the reference, with or without denoiser.
            budget: time of the parts.
            seed: seed of the renders.
            on_done: called after each render.

        Returns:
            The parts, and the samples per pixel of each of them.
        """
        # the largest sample count with which several parts fit into the budget; these
        # renders are only timed, so that any seed will do
        spp = choose_part_samples(
            lambda count: self._render_radiance(line, seed=0, spp=count),
            budget.seconds_left,
        )
        radiances = take_reference_parts(
            # a function of the seed
            partial(self._render_radiance, line, spp=spp),
            budget,
            on_done,
            seed,
        )
        return [flatten(radiance) for radiance in radiances], spp

    def _display_mean(self, mean: Float64Array) -> Tensor:
        """Return the image (H, W, 3) for a mean radiance (H * W * 3,)."""
        size = (*self._formation.resolution, 3)
        return self._display(torch.from_numpy(mean).to(torch.float32).reshape(size))

    def get_reference_error(self, setting: SampleSetting, quantity: str) -> float:
        """Return the relative error of the reference of a quantity."""
        return self._references[quantity, setting.family].error

    def measure(self, setting: SampleSetting, seed: int) -> dict[str, Numbers]:
        """Render an image; return the errors of the image and of the margin.

        Both errors come with the times of the render.
        """
        radiance, times = run_timed(
            lambda: self._render_radiance(setting.estimator, seed, setting.spp)
        )
        image = self._display(radiance)
        value_of_quantity = {
            "picture": flatten(image),
            "margin": np.array([self._margin(image)]),
        }
        numbers = dict[str, Numbers]()
        for quantity, value in value_of_quantity.items():
            reference = self._references[quantity, setting.family]
            numbers[quantity] = {**reference.compare(value), **times}
        return numbers

    def _render_radiance(self, estimator: str, seed: int, spp: int) -> Tensor:
        """Render the linear image (H, W, 3) of a line."""
        with torch.no_grad():
            return self._renderers[estimator].radiance(self._u, seed, spp)

    def _display(self, radiance: Tensor) -> Tensor:
        """Return the image (H, W, 3) in sRGB, as the model gets it."""
        with torch.no_grad():
            return self._space.apply_to_image(
                self._u, self._formation.map_to_display(radiance)
            )


def _list_sampler_lines(samplers: Sequence[str]) -> list[str]:
    """Return the lines: all samplers without denoiser, then two of them with one."""
    lines = list(samplers)
    for name in ("independent", REFERENCE_SAMPLER):
        if name in samplers:
            lines.append(name + OIDN)
    return lines


def _make_renderers(
    renderer: gradients.Renderer, samplers: Sequence[str], lines: Sequence[str]
) -> dict[str, gradients.Renderer]:
    """Make a renderer for each line, and for the references with and without denoiser.

    References are rendered by `REFERENCE_SAMPLER`, which has renderers even if it is
    not measured.

    Args:
        renderer: renderer of the scene; its sampler and denoiser are replaced.
        samplers: names of the samplers that are measured.
        lines: these samplers with and without denoiser.
    """
    scenes = {
        name: renderer.scene.copy_with(sampler=name)
        for name in {*samplers, REFERENCE_SAMPLER}
    }
    return {
        line: renderer.copy_with(
            scenes[line.removesuffix(OIDN)], denoiser=get_denoiser(line)
        )
        for line in {*lines, REFERENCE_SAMPLER, REFERENCE_SAMPLER + OIDN}
    }


def list_image_settings(estimator: str) -> list[SampleSetting]:
    """Return the settings of a line of images: one for each sample count.

    A line is a sampler, such as "independent", or a sampler with denoiser.
    """
    # The cost decides the order of measurements. Other lines have a higher cost so that
    # they come later.
    cost_factor = 1.0 if estimator in PREFERRED_LINES else OTHER_LINES_COST
    return [
        SampleSetting(
            quantity="picture",
            estimator=estimator,
            spp=count,
            relative_cost=count * cost_factor,
            # settings with the same denoiser are compared with each other
            family=get_denoiser(estimator),
        )
        for count in SAMPLE_COUNTS.get(estimator, OTHER_SAMPLE_COUNTS)
    ]


def get_denoiser(estimator: str) -> str:
    """Return the denoiser of a line: "oidn" or "none"."""
    return "oidn" if estimator.endswith(OIDN) else "none"


ADJOINT_COST = {"adjoint": 3.0, "material": 60.0}
"""Cost of adjoint gradients, in renders. That of `material` includes the compilation of
kernels.
"""
# maximum number of coordinates for a reference by differences
MAX_DIFFERENCE_COORDINATES = 32
# maximum sample count of a reference by differences, and the lower counts to try
DIFFERENCE_SAMPLE_COUNTS = (16, 64, 256)
# number of parts of a reference by differences that have to fit into its time
DIFFERENCE_PARTS = 3
# samples per pixel, and (minimum, maximum) number of seeds, of the check of a reference
# by an adjoint
BIAS_CHECK_SPP = 64
BIAS_CHECK_REPEATS = (2, 4)


@dataclass(frozen=True)
class GradientPart:
    """Coordinates of a control whose gradient one call computes.

    Attributes:
        name: name of the control, with the parameters if a control has several parts.
        groups: groups of the coordinates.
        estimators: estimators that are valid for all of them.
    """

    name: str
    groups: tuple[gradients.Group, ...]
    estimators: tuple[str, ...]

    @property
    def size(self) -> int:
        """The number of coordinates."""
        return sum(group.size for group in self.groups)

    @property
    def group_names(self) -> set[str]:
        """The names of the groups, by which a gradient plan is restricted to them."""
        return {group.name for group in self.groups}

    def select(self, gradient: Tensor) -> Float64Array:
        """Return the part (n,) of a gradient (d,)."""
        return flatten(
            torch.cat([gradient[group.coordinates] for group in self.groups])
        )

    def count_renders(self, estimator: str) -> int:
        """Return the number of renders of a gradient, without that of the image."""
        return sum(replace(group, estimator=estimator).renders for group in self.groups)


def list_gradient_parts(
    groups: Sequence[gradients.Group], *, linear: bool
) -> list[GradientPart]:
    """Return the parts of a space with the estimators that are valid for them.

    A part has the parameters of one control that can be differentiated by the same
    estimators, so that these can be compared.

    Args:
        groups: parameters of the search space, with the estimators that are valid for
            each.
        linear: whether the loss is a linear function of the image. Then the estimator
            "secant", by differences of the loss, equals the one by differences of the
            image, and is left out.
    """
    # `valid` lists the estimators of a group; without any it has no gradient.
    differentiable_groups = [group for group in groups if len(group.valid) > 0]
    # pairs of the groups of a part and their estimators
    comparable_sets = gradients.planning.list_comparable_sets(differentiable_groups)
    controls = [part_groups[0].control for part_groups, _ in comparable_sets]
    parts = []
    for part_groups, estimators in comparable_sets:
        name = part_groups[0].control
        if controls.count(name) > 1:  # a control of several parts
            name = f"{name}.{_join_parameters(part_groups)}"
        if linear:
            estimators = tuple(item for item in estimators if item != "secant")
        parts.append(GradientPart(name, part_groups, estimators))
    return parts


def _join_parameters(groups: Sequence[gradients.Group]) -> str:
    """Join the parameters of groups by commas; a long list has only the first one."""
    parameters = ",".join(group.parameter for group in groups)
    if len(parameters) > MAX_NAME_LETTERS:
        return f"{groups[0].parameter},... ({len(groups)})"
    return parameters


class GradientBench:
    """Measure the error of a gradient by every estimator.

    It is the gradient (n,) of one part of a space. The reference uses a better sampler.
    For few coordinates it is computed by finite differences with two steps, else as the
    mean of an adjoint.

    Attributes:
        part: the coordinates.
        reference: reference of the gradient; None before it is computed.
        settings: all estimators with all of their sample counts.
    """

    def __init__(
        self,
        renderer: gradients.Renderer,
        loss: gradients.Loss,
        u: Tensor,
        part: GradientPart,
    ) -> None:
        """Choose how the reference is computed, and list the settings to measure.

        Args:
            renderer: renderer of the scene.
            loss: loss that is differentiated.
            u: (d,) the configuration.
            part: the coordinates of the gradient, with their estimators.
        """
        self._renderer = renderer
        self._loss = loss
        self._u = u
        self.part = part
        # renderer of references: its sampler needs the least time for the same error
        self._exact = renderer.copy_with(
            renderer.scene.copy_with(sampler=REFERENCE_SAMPLER)
        )
        self._reference_estimator = _choose_reference_estimator(part)
        self.reference: ReferenceValue | None = None
        # the same sample counts as for images with the independent sampler
        self.settings = [
            self.make_setting(estimator, count)
            for estimator in part.estimators
            for count in SAMPLE_COUNTS["independent"]
        ]

    @property
    def _by_differences(self) -> bool:
        """Whether the reference is computed by finite differences with two steps."""
        return _suits_differences(self.part)

    def make_setting(self, estimator: str, spp: int) -> SampleSetting:
        """Return the setting of an estimator with a number of samples per pixel."""
        gradient_renders = ADJOINT_COST.get(
            estimator, self.part.count_renders(estimator)
        )
        renders = 1.0 + gradient_renders  # one render of the image itself
        return SampleSetting(
            quantity="gradient",
            estimator=estimator,
            spp=spp,
            relative_cost=spp * renders,
            control=self.part.name,
        )

    def compute_references(
        self, budget: TimeBudget, seed: int, on_done: Callable[[], None]
    ) -> list[PrecisionReference]:
        """Compute the reference within a budget.

        Args:
            budget: time of the reference.
            seed: seed of its parts.
            on_done: called after each part of the reference.

        Returns:
            A list with the row of the reference in the result.
        """
        if self._by_differences:
            compute = self._compute_reference_by_differences
        else:
            compute = self._compute_reference_by_estimator
        self.reference, spp = compute(budget, seed, on_done)
        row = _make_row(
            "gradient",
            self._reference_estimator,
            self.reference,
            spp=spp,
            control=self.part.name,
        )
        return [row]

    def _compute_reference_by_differences(
        self, budget: TimeBudget, seed: int, on_done: Callable[[], None]
    ) -> tuple[ReferenceValue, int]:
        """Compute the reference by differences at two steps along each coordinate.

        Args:
            budget: time of the reference.
            seed: seed of the renders.
            on_done: called after each part.

        Returns:
            The reference, and the samples per pixel of each of its parts.
        """
        probes = self._list_probes()
        # These renders are only timed, so that any seed will do.
        spp = choose_part_samples(
            lambda count: self._compute_derivatives(probes, seed=0, spp=count),
            budget.seconds_left,
            parts=DIFFERENCE_PARTS,
            counts=DIFFERENCE_SAMPLE_COUNTS,
        )
        parts = take_reference_parts(
            # a function of the seed, which returns derivatives and disagreements
            partial(self._compute_derivatives, probes, spp=spp),
            budget,
            on_done,
            seed,
        )
        return _estimate_from_differences(parts), spp

    def _compute_reference_by_estimator(
        self, budget: TimeBudget, seed: int, on_done: Callable[[], None]
    ) -> tuple[ReferenceValue, int]:
        """Compute the reference as the mean gradient by an estimator.

        Args:
            budget: time of the reference.
            seed: seed of the renders.
            on_done: called after each part.

        Returns:
            The reference, and the samples per pixel of each of its parts.
        """
        # a function of the seed and of the samples per pixel
        compute = partial(
            self._compute_gradient, self._exact, self._reference_estimator
        )
        # These renders are only timed, so that any seed will do.
        spp = choose_part_samples(
            lambda count: compute(seed=0, spp=count), budget.seconds_left
        )
        parts = take_reference_parts(partial(compute, spp=spp), budget, on_done, seed)
        return estimate_reference(parts), spp

    def _list_probes(self) -> list[gradients.Probe]:
        """Return a probe along each coordinate of the part."""
        probes = []
        for group in self.part.groups:
            for number in range(group.size):
                index = group.begin + number
                direction = torch.zeros_like(self._u)
                direction[index] = 1.0
                # a group of this coordinate alone
                coordinate = replace(group, size=1, begin=index)
                name = f"{group.name}.{number}"
                # the last argument is the step of differences
                probe = gradients.Probe(coordinate, name, direction, group.step)
                probes.append(probe)
        return probes

    def _compute_derivatives(
        self, probes: Sequence[gradients.Probe], seed: int, spp: int
    ) -> Float64Array:
        """Compute the derivatives along directions by finite differences.

        A derivative is computed with two steps and extrapolated to a step of zero.

        Args:
            probes: n directions.
            seed: seed of the renders' noise.
            spp: samples per pixel.

        Returns:
            (2, n): the derivatives; and the differences between the values with both
            steps, which show how accurate the derivatives are.
        """
        bench = gradients.Bench(self._exact, self._loss, self._u, seed, spp)
        derivatives = []
        disagreements = []
        for probe in probes:
            # one seed: `repeats` are the minimum and the maximum number of seeds
            reference = gradients.measure_reference(bench, probe, repeats=(1, 1))
            # the derivative by differences over a step, and over half of it
            value_at_step, value_at_half_step = reference.steps
            derivatives.append(reference.value)
            disagreements.append(value_at_step - value_at_half_step)
        table: Float64Array = np.array([derivatives, disagreements], dtype=np.float64)
        return table

    def get_reference_error(self, setting: SampleSetting, quantity: str) -> float:
        """Return the relative error of the reference; 0 before it is computed.

        All settings have the same reference.
        """
        return self.reference.error if self.reference else 0.0

    def measure(self, setting: SampleSetting, seed: int) -> dict[str, Numbers]:
        """Compute a gradient; return its errors and times, as `PictureBench.measure`.

        The times include the render of the image at which the gradient is taken.
        """
        assert self.reference is not None
        gradient, times = run_timed(
            lambda: self._compute_gradient(
                self._renderer, setting.estimator, seed, setting.spp
            )
        )
        errors = self.reference.compare(gradient)
        return {"gradient": {**errors, **times}}

    def check_bias(self, seed: int) -> str | None:
        """Check the reference against finite differences along one direction.

        An adjoint may be biased, because it ignores moving edges. The derivative along
        the direction by the reference is the dot product of the two.

        Args:
            seed: seed of the renders.

        Returns:
            A sentence if the reference is biased; None if it is not, or if it is
            computed by differences itself.
        """
        if self._reference_estimator == "differences" or self.reference is None:
            return None
        probe, differences = self._measure_differences(seed)
        slope = float(self.reference.value @ self.part.select(probe.direction))
        if not self._is_biased(slope, differences):
            return None
        return (
            f"{self.part.name}: the reference is the mean of "
            f"{self._reference_estimator}, and along one direction it "
            f"gives {slope:.3g}, differences {differences.value:.3g} +- "
            f"{differences.noise:.1g}: the reported errors do "
            "not include that bias"
        )

    def _measure_differences(
        self, seed: int
    ) -> tuple[gradients.Probe, gradients.Reference]:
        """Return the direction of the check of the bias, and differences along it."""
        exact = self._exact
        # The plan is not restored, since the renderer is not used after this check.
        exact.plan = gradients.restrict_plan(
            exact.plan, self.part.group_names, self._reference_estimator
        )
        bench = gradients.Bench(exact, self._loss, self._u, seed, BIAS_CHECK_SPP)
        probe = gradients.find_probes(bench)[0]  # the direction of the check
        return probe, gradients.measure_reference(
            bench, probe, repeats=BIAS_CHECK_REPEATS
        )

    def _is_biased(self, slope: float, differences: gradients.Reference) -> bool:
        """Return whether the reference differs from differences along one direction.

        Args:
            slope: derivative along the direction by the reference.
            differences: the same by finite differences.
        """
        assert self.reference is not None
        # The relative error of the reference is taken for that of the slope.
        noise = self.reference.error * abs(slope)
        # The comparison does not use the time, which is not known here.
        estimate = gradients.GradientEstimate(
            self._reference_estimator, slope, noise, repeats=1, seconds=0.0
        )
        comparison = gradients.compare_with_reference(estimate, differences)
        return comparison.status == "biased"

    def _compute_gradient(
        self, renderer: gradients.Renderer, estimator: str, seed: int, spp: int
    ) -> Float64Array:
        """Compute the gradient (n,) of the part by an estimator."""
        plan = gradients.restrict_plan(renderer.plan, self.part.group_names, estimator)
        bench = gradients.Bench(renderer, self._loss, self._u, seed, spp)
        return self.part.select(bench.compute_gradient(plan, seed))


def _suits_differences(part: GradientPart) -> bool:
    """Return whether a reference by differences is affordable for a part.

    An adjoint may be biased, since it ignores moving edges. Differences are not, but
    need renders for each coordinate.
    """
    return part.size <= MAX_DIFFERENCE_COORDINATES


def _choose_reference_estimator(part: GradientPart) -> str:
    """Return the estimator that computes the reference of a part."""
    if _suits_differences(part):
        return "differences"
    adjoints = [name for name in part.estimators if name in ADJOINT_COST]
    # the first adjoint (`ADJOINT_COST` lists them); without any, the first
    # estimator
    return adjoints[0] if adjoints else part.estimators[0]


def _estimate_from_differences(parts: Sequence[Float64Array]) -> ReferenceValue:
    """Estimate a reference from derivatives by differences with two steps.

    Args:
        parts: for each part (2, n): the derivatives, and the differences between the
            values with both steps.
    """
    derivatives = [derivative for derivative, _ in parts]
    # The values with two steps differ. Extrapolation to a step of 0 removes most of
    # that difference: a quarter of it is assumed to be left as a bias.
    disagreements = [disagreement for _, disagreement in parts]
    mean_disagreement = float(np.linalg.norm(np.mean(disagreements, axis=0)))
    bias = mean_disagreement / 4.0
    return estimate_reference(derivatives, bias=bias)


def _make_row(
    quantity: str, name: str, value: ReferenceValue, spp: int, control: str = ""
) -> PrecisionReference:
    """Make the row of a reference in the result.

    Args:
        quantity: "picture", "margin" or "gradient".
        name: name of the sampler or the estimator.
        value: the reference and its error.
        spp: samples per pixel of each of the independent parts of the reference. The
            row has those of all parts together.
        control: name of the control; empty for images.
    """
    return PrecisionReference(
        quantity=quantity,
        control=control,
        reference=name,
        error=value.error,
        parts=value.n_parts,
        spp=spp * value.n_parts,
    )


def flatten(values: Tensor) -> Float64Array:
    """Return values as a flat float64 array."""
    numbers: Float64Array = values.detach().to(torch.float64).reshape(-1).numpy().copy()
    return numbers
