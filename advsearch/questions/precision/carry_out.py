"""Measure how the error of images and gradients of a scene depends on run time."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, cast

import torch

from advsearch.extend import (
    InputError,
    Problem,
    Progress,
    RunContext,
    RunDirectory,
    gradients,
    results,
    seeds,
    workbench,
)
from advsearch.questions.precision.benches import (
    OIDN,
    GradientBench,
    GradientPart,
    MeasuredRounds,
    PictureBench,
    TimeBudget,
    list_gradient_parts,
    measure_in_rounds,
)
from advsearch.questions.precision.result import (
    Machine,
    PrecisionConfig,
    PrecisionPoint,
    PrecisionReference,
    PrecisionResult,
    PrecisionSlope,
    Recommended,
    Sitting,
    draw_figures,
    list_cautions,
)
from advsearch.questions.precision.rule import (
    RoundUp,
    SampleSetting,
    confirm_recommendation,
    describe_disagreement,
    fit_line,
    recommend_spp,
    summarize_samples,
)

# fraction of the time for each quantity; later quantities get unused time
TIME_FRACTIONS = {"image": 0.6, "gradient": 0.4}
# fraction of a quantity's time for its reference
REFERENCE_FRACTION = 0.35
# Fraction of a gradient's time, without that of its reference, in which the recommended
# setting is measured again.
CONFIRM_FRACTION = 0.4
# minimum number of these measurements that confirms the setting, and their maximum
# number
MIN_CONFIRMATIONS = 4
MAX_CONFIRMATIONS = 64


def measure_precision(context: RunContext[PrecisionConfig]) -> PrecisionResult:
    """Measure error against run time, and write figures and numbers.

    The image and the gradient of each control are measured one after the other. Each is
    measured in one sitting, without a break, so that its times are comparable. A
    finished sitting is stored at once, and a resumed run continues with the next one.
    """
    config = context.config
    start_time = time.perf_counter()
    problem = _load_measured_problem(context)
    measurer = QuantityMeasurer(config, problem, context.progress)
    # sittings that are stored in the run, such as those of a resumed run
    measurements = context.open_measurements()
    setup_seconds = time.perf_counter() - start_time

    def read_or_measure(name: str, measure: Callable[[], Sitting]) -> Sitting:
        """Return the stored sitting of a name, or measure a new one and store it."""
        return measurements.get_or_measure_row(name, Sitting, measure)

    def make_result(sittings: Sequence[Sitting]) -> PrecisionResult:
        """Make the result of the sittings so far; called after each of them."""
        return _make_result(context, measurer, sittings, setup_seconds)

    result = measurements.make_result_of_rows(
        measurer.measure_sittings(read_or_measure), make_result
    )
    paths = _write_figures(context.run, result)
    return result.model_copy(update={"figures": [str(path) for path in paths]})


def _load_measured_problem(context: RunContext[PrecisionConfig]) -> Problem:
    """Load the scene and the model, and show what is remarkable about them."""
    config = context.config
    hint = f"then {config.seconds:g} seconds of measurements; `seconds` sets them"
    context.progress.stage(workbench.LOADING, hint=hint)
    problem, remarks = workbench.problem_from_config(config)
    for remark in remarks:
        context.progress.message(remark)
    return problem


def _make_result(
    context: RunContext[PrecisionConfig],
    measurer: QuantityMeasurer,
    sittings: Sequence[Sitting],
    setup_seconds: float,
) -> PrecisionResult:
    """Return the result of the sittings that are finished, without figures yet.

    Args:
        context: the settings and the run.
        measurer: the measurer, which has the problem.
        sittings: the finished sittings, of the image and of gradients.
        setup_seconds: seconds of loading.
    """
    config = context.config
    problem = measurer.problem
    points = _join_lists(sittings, "points")
    # lines of log error against log samples, and a sentence for each line that
    # disagrees with theory
    slopes, disagreements = _fit_slopes(points, measurer.may_be_steeper)
    warnings = [*_join_lists(sittings, "warnings"), *disagreements]
    return context.result(
        PrecisionResult,
        model=problem.model.name,
        environment=problem.environment,
        depth=problem.renderer.scene.max_depth,
        loss=config.loss,
        spp=problem.search_spp,
        goal=config.error,
        image_formation=results.Formation.from_values(problem.renderer.formation),
        machine=Machine(**context.machine, threads=count_threads()),
        points=points,
        slopes=slopes,
        references=_join_lists(sittings, "references"),
        left_out=_join_lists(sittings, "left_out"),
        warnings=[*warnings, *list_cautions(points)],
        recommendations=measurer.recommend(
            points, _join_lists(sittings, "confirmations")
        ),
        figures=[],
        seconds={"budget": config.seconds, "setup": setup_seconds},
    )


def _join_lists(sittings: Sequence[Sitting], name: str) -> list[Any]:
    """Join the lists in the field of this name of all sittings."""
    return [row for sitting in sittings for row in getattr(sitting, name)]


def _fit_slopes(
    points: Sequence[PrecisionPoint],
    may_be_steeper: Callable[[PrecisionPoint], bool | None],
) -> tuple[list[PrecisionSlope], list[str]]:
    """Fit a line to the points of each estimator that has enough of them.

    Returns:
        The lines, and a sentence for each that disagrees with theory.
    """
    slopes = []
    disagreements = []
    for estimator_points in group_by_line(points).values():
        slope = fit_line(estimator_points, may_be_steeper(estimator_points[0]))
        if slope is None:
            continue
        slopes.append(slope)
        disagreement = describe_disagreement(slope, estimator_points)
        if disagreement:
            disagreements.append(disagreement)
    return slopes, disagreements


def _write_figures(run: RunDirectory, result: PrecisionResult) -> list[Path]:
    """Write the figures of a result, and return their paths."""
    return [
        run.write_file(f"images/precision.{suffix}", data)
        for suffix, data in draw_figures(result).items()
    ]


class PlannedSitting(NamedTuple):
    """A quantity that is to be measured without a break.

    Attributes:
        name: name under which its measurements are stored.
        fraction: fraction of the total time for the quantity.
        measure: measures the quantity within a budget.
    """

    name: str
    fraction: float
    measure: Callable[[TimeBudget], Sitting]


class QuantityMeasurer:
    """Measure the image of a scene and the gradients of its controls.

    With the setting `loss=linear`, gradients are those of a smooth linear loss of the
    raw image, without denoiser and tone curve: theory predicts how their error falls.

    Attributes:
        problem: the attack whose scene, controls and model are measured.
        planned_sittings: the quantities, in the order in which they are measured.
    """

    def __init__(
        self, config: PrecisionConfig, problem: Problem, progress: Progress
    ) -> None:
        """Choose renderer and loss, and plan what is measured.

        Args:
            config: the settings.
            problem: problem of an attack, whose scene, controls and model are measured.
            progress: the progress bar.
        """
        self._config = config
        self.problem = problem
        self._progress = progress
        self._seed = seeds.derive_seed(config.seed, "precision")
        self._is_linear = config.loss == "linear"
        self._renderer = problem.renderer
        self._loss = cast(gradients.Loss, problem.compute_loss)
        if self._is_linear:
            self._renderer = _make_linear_renderer(problem)
            self._loss = gradients.make_smooth_loss(
                self._renderer.formation.resolution, config.seed
            )
        self.planned_sittings = self._plan_sittings()

    def _plan_sittings(self) -> list[PlannedSitting]:
        """Plan the sittings: the image first, then the gradient of each control.

        Raises:
            InputError: the gradient is to be measured, but no control has a derivative.
        """
        quantities = self._config.measured_quantities
        sittings = []
        if "image" in quantities:
            fraction = TIME_FRACTIONS["image"]
            sittings.append(PlannedSitting("image", fraction, self._measure_image))
        if "gradient" in quantities:
            sittings += self._plan_gradients()
        return sittings

    def _plan_gradients(self) -> list[PlannedSitting]:
        """Plan a sitting for each part of the gradient; their time is divided evenly.

        Raises:
            InputError: no control has a derivative.
        """
        parts = list_gradient_parts(self._renderer.plan.groups, linear=self._is_linear)
        if not parts:
            names = ",".join(self._config.controls)
            raise InputError(
                f"`controls` {names}: has no derivative; leave "
                "gradient out of `quantities`"
            )
        fraction = TIME_FRACTIONS["gradient"] / len(parts)
        sittings = []
        for part in parts:
            name = f"gradient of {part.name}"
            measure_part = partial(self._measure_gradient, part)
            sittings.append(PlannedSitting(name, fraction, measure_part))
        return sittings

    def measure_sittings(
        self, read_or_measure: Callable[[str, Callable[[], Sitting]], Sitting]
    ) -> Iterator[Sitting]:
        """Yield the sitting of each quantity.

        A sitting measures one quantity without a break. Time that it does not use is
        divided among the later ones.

        Args:
            read_or_measure: returns the stored sitting of a name, or calls the function
                that measures it.
        """
        seconds_left = self._config.seconds
        for number, planned in enumerate(self.planned_sittings):
            fraction_left = math.fsum(
                later.fraction for later in self.planned_sittings[number:]
            )
            budget = TimeBudget(seconds_left * planned.fraction / fraction_left)
            sitting = read_or_measure(planned.name, partial(planned.measure, budget))
            seconds_left = max(0.0, seconds_left - sitting.seconds)
            yield sitting

    def round_up_samples(self, point: PrecisionPoint, samples: float) -> int:
        """Round up to a number of samples that the sampler of a point accepts.

        Args:
            point: point of the estimator.
            samples: number of samples per pixel.
        """
        sampler: str = self._config.pixel_sampler
        if point.quantity != "gradient":
            # For images, the estimator is the name of a sampler, perhaps with `OIDN`.
            sampler = point.estimator.removesuffix(OIDN)
        return self._renderer.scene.round_sample_count(samples, sampler)

    def may_be_steeper(self, point: PrecisionPoint) -> bool | None:
        """Return whether the error may fall faster than that of independent samples.

        It may with any sampler other than "independent", as its samples are stratified
        (Owen 1997). None if theory predicts nothing because the estimator has a bias:
        by the step (differences), by an approximation (`material`), by a loss that is
        not linear, or by the denoiser.
        """
        if point.quantity == "gradient":
            sampler: str = self._config.pixel_sampler
            is_unbiased = self._is_linear and point.estimator == "adjoint"
        else:
            # For images without denoiser, the estimator is the name of a sampler.
            sampler = point.estimator
            is_denoised = point.family != "none"
            is_unbiased = not is_denoised
        if not is_unbiased:
            return None
        return sampler != "independent"

    def recommend(
        self,
        points: Sequence[PrecisionPoint],
        confirmations: Sequence[PrecisionPoint],
    ) -> list[Recommended]:
        """Return the fastest settings that reach the goal; see `recommend_settings`.

        Args:
            points: measured settings.
            confirmations: gradient settings that were measured again.
        """
        return recommend_settings(
            points,
            confirmations=confirmations,
            goal=self._config.error,
            round_up=self.round_up_samples,
            or_steeper=self.may_be_steeper,
        )

    def _measure_image(self, budget: TimeBudget) -> Sitting:
        """Measure images and the model's margin on them."""
        problem = self.problem
        u = problem.make_full_configuration(problem.domain.start)

        def margin(image: torch.Tensor) -> float:
            """Return the model's margin on an image (H, W, 3)."""
            return -problem.judge(image, u).score  # a score is a negative margin

        bench = PictureBench(
            problem.renderer, u, margin, self._config.compared_samplers
        )
        return self._measure_settings("the picture", bench, budget)

    def _measure_gradient(self, part: GradientPart, budget: TimeBudget) -> Sitting:
        """Measure the gradient of a part, then its recommended setting again.

        The recommended setting was selected as the best of many noisy ones, so that its
        measured error is too small on average. New measurements do not have that bias.

        Args:
            part: the coordinates of the gradient, such as those of one control.
            budget: time of the reference and of all measurements.
        """
        title = f"gradient of {part.name}"
        start_time = time.perf_counter()
        # a configuration inside of the bounds, so that differences can be computed
        u = gradients.find_interior_point(self._renderer)
        bench = GradientBench(self._renderer, self._loss, u, part)
        # A part of the time without the reference is reserved for new measurements.
        confirm_fraction = CONFIRM_FRACTION * (1.0 - REFERENCE_FRACTION)
        sitting = self._measure_settings(
            title, bench, budget.take_fraction(1.0 - confirm_fraction)
        )
        # one recommendation, since the gradient of this part is the only quantity here
        (recommended,) = self.recommend(sitting.points, confirmations=[])
        warnings = self._list_bias_warnings(bench, budget)
        further_values = {
            "confirmations": self._measure_again(title, bench, recommended, budget),
            "warnings": warnings,
            "seconds": time.perf_counter() - start_time,
        }
        return sitting.model_copy(update=further_values)

    def _list_bias_warnings(
        self, bench: GradientBench, budget: TimeBudget
    ) -> list[str]:
        """Return a warning if the reference is biased; empty if no time is left."""
        if not budget.seconds_left > 0.0:
            return []
        bias_warning = bench.check_bias(self._seed)
        return [bias_warning] if bias_warning else []

    def _measure_again(
        self,
        title: str,
        bench: GradientBench,
        recommended: Recommended,
        budget: TimeBudget,
    ) -> list[PrecisionPoint]:
        """Measure the recommended setting of a gradient again.

        Args:
            title: title of the progress.
            bench: bench of the gradient.
            recommended: recommendation from the first measurements.
            budget: time of the new measurements.

        Returns:
            A list with the point of the setting. It is empty if there was no time for
            enough measurements, or if nothing is recommended.
        """
        if recommended.estimator is None or recommended.spp is None:
            return []
        setting = bench.make_setting(recommended.estimator, recommended.spp)
        advance = self._begin_stage(
            f"{title}: {recommended.estimator} with {recommended.spp} samples again",
            budget,
        )
        measured = measure_in_rounds(
            [setting],
            bench.measure,
            budget,
            rounds=MAX_CONFIRMATIONS,
            # seeds that the first measurements did not use
            seed=seeds.derive_seed(self._seed, "confirm"),
            on_done=lambda _: advance(),
        )
        return _summarize_confirmations(bench, setting, measured)

    def _measure_settings(
        self, title: str, bench: PictureBench | GradientBench, budget: TimeBudget
    ) -> Sitting:
        """Compute a bench's references, and measure all of its settings in rounds.

        Args:
            title: title of the progress.
            bench: bench of the image or of a gradient.
            budget: time of the references and the measurements.
        """
        start_time = time.perf_counter()
        references = self._compute_bench_references(title, bench, budget)
        advance = self._begin_stage(
            f"{title}: measuring every setting in rounds", budget
        )
        measured = measure_in_rounds(
            bench.settings,
            bench.measure,
            budget,
            rounds=self._config.rounds,
            seed=self._seed,
            on_done=lambda setting: advance(now=setting.estimator, samples=setting.spp),
        )
        return Sitting(
            points=_summarize_settings(bench, measured),
            references=references,
            left_out=_describe_skipped(title, measured),
            seconds=time.perf_counter() - start_time,
        )

    def _compute_bench_references(
        self, title: str, bench: PictureBench | GradientBench, budget: TimeBudget
    ) -> list[PrecisionReference]:
        """Compute the references of a bench within their fraction of a budget."""
        reference_budget = budget.take_fraction(REFERENCE_FRACTION)
        return bench.compute_references(
            reference_budget,
            self._seed,
            self._begin_stage(f"{title}: references", reference_budget),
        )

    def _begin_stage(self, name: str, budget: TimeBudget) -> Callable[..., None]:
        """Start a stage of the progress bar, and return a function to advance it.

        The bar counts seconds. That function moves the bar to the seconds that have
        passed. Its keywords are displayed next to the bar.
        """
        total = max(1, math.ceil(budget.seconds_left))
        done = 0
        self._progress.stage(
            name, total, hint="counted in seconds; `seconds` sets them", at_most=True
        )

        def advance(**info: float | str) -> None:
            """Move the bar to the seconds that have passed."""
            nonlocal done
            passed = min(total, total - math.ceil(budget.seconds_left))
            self._progress.advance(passed - done, **info)
            done = passed

        return advance


def _make_linear_renderer(problem: Problem) -> gradients.Renderer:
    """Make a renderer of raw images, of which a linear loss is computed.

    The loss is a linear function of the raw image, so that theory predicts the slope
    of the error.
    """
    renderer = problem.renderer.copy_with(denoiser="none", transfer="linear")
    # Finite differences use steps over which outlines move by one pixel: over
    # wider steps even this smooth loss is not linear.
    renderer.plan = renderer.plan.with_pixel_steps()
    return renderer


def _summarize_confirmations(
    bench: GradientBench, setting: SampleSetting, measured: MeasuredRounds
) -> list[PrecisionPoint]:
    """Return a list with the point of the setting; empty without enough measurements."""
    samples = [numbers["gradient"] for numbers in measured.results_by_setting[setting]]
    if len(samples) < MIN_CONFIRMATIONS:
        return []
    reference_error = bench.get_reference_error(setting, "gradient")
    return [summarize_samples(setting, samples, reference_error)]


def _summarize_settings(
    bench: PictureBench | GradientBench, measured: MeasuredRounds
) -> list[PrecisionPoint]:
    """Return a point for each measured setting and quantity.

    A measurement has numbers for each quantity: "picture" and "margin", or "gradient".
    All measurements of a setting have the same quantities.
    """
    points = []
    for setting, measurements in measured.results_by_setting.items():
        for quantity in measurements[0]:
            numbers = [measurement[quantity] for measurement in measurements]
            reference_error = bench.get_reference_error(setting, quantity)
            quantity_setting = replace(setting, quantity=quantity)
            points.append(summarize_samples(quantity_setting, numbers, reference_error))
    return points


def _describe_skipped(title: str, measured: MeasuredRounds) -> list[str]:
    """Describe which settings were not measured: a line for each estimator."""
    counts_by_estimator: dict[str, list[str]] = {}
    for setting in measured.skipped:
        counts = counts_by_estimator.setdefault(setting.estimator, [])
        counts.append(str(setting.spp))
    return [
        f"{title} by {estimator}: {', '.join(counts)} samples"
        for estimator, counts in counts_by_estimator.items()
    ]


def group_by_line(
    points: Sequence[PrecisionPoint],
) -> dict[tuple[str, ...], list[PrecisionPoint]]:
    """Group points by quantity, control, family and estimator.

    The points of a group are in ascending order of samples.
    """
    groups: dict[tuple[str, ...], list[PrecisionPoint]] = {}
    for point in points:
        key = (point.quantity, point.control, point.family, point.estimator)
        groups.setdefault(key, []).append(point)
    for group in groups.values():
        group.sort(key=lambda point: point.spp)
    return groups


def recommend_settings(
    points: Sequence[PrecisionPoint],
    confirmations: Sequence[PrecisionPoint],
    goal: float,
    round_up: RoundUp,
    or_steeper: Callable[[PrecisionPoint], bool | None] = lambda point: None,
) -> list[Recommended]:
    """Return the fastest setting that reaches a goal, for each quantity.

    There is one recommendation for each quantity, control and family of samplers. If no
    setting reaches the goal, its estimator is None. If a gradient setting was measured
    again, the recommendation uses the new measurements.

    Args:
        points: measured settings.
        confirmations: gradient settings that were measured again.
        goal: relative error that has to be reached.
        round_up: rounds up to a sample count that a sampler accepts, such as a power of
            two.
        or_steeper: returns whether the error of a point may fall faster than that of
            independent samples; None if theory predicts nothing.
    """
    recommended = []
    candidates = _list_candidates(points, goal, round_up, or_steeper)
    for (quantity, control, family), comparable in candidates.items():
        best = min(
            comparable,
            # Every candidate has seconds; `or` is only for the type of the field.
            key=lambda candidate: candidate.seconds or 0.0,
            default=Recommended(quantity=quantity, control=control),
        )
        if quantity == "gradient":
            best = _confirm_gradient(best, confirmations, round_up)
        recommended.append(best.model_copy(update={"family": family}))
    return recommended


def _list_candidates(
    points: Sequence[PrecisionPoint],
    goal: float,
    round_up: RoundUp,
    or_steeper: Callable[[PrecisionPoint], bool | None],
) -> dict[tuple[str, str, str], list[Recommended]]:
    """Return a candidate for each estimator that reaches the goal.

    They are by quantity, control and family; arguments as for `recommend_settings`.
    """
    candidates: dict[tuple[str, str, str], list[Recommended]] = {}
    for line in group_by_line(points).values():
        first = line[0]
        key = (first.quantity, first.control, first.family)
        # Without any candidate the list stays empty.
        comparable = candidates.setdefault(key, [])
        candidate = recommend_spp(line, goal, round_up, or_steeper(first))
        if candidate:
            comparable.append(candidate)
    return candidates


def _confirm_gradient(
    best: Recommended, confirmations: Sequence[PrecisionPoint], round_up: RoundUp
) -> Recommended:
    """Return a recommendation for a gradient after its setting was measured again."""
    for point in confirmations:
        measured = (point.control, point.estimator)
        if measured == (best.control, best.estimator):
            best = confirm_recommendation(best, point, round_up)
    return best


def count_threads() -> dict[str, int]:
    """Return how many threads torch uses, and Dr.Jit if anything was rendered."""
    counts = {"torch": torch.get_num_threads()}
    if "drjit" in sys.modules:
        counts["render"] = int(sys.modules["drjit"].thread_count())
    return counts
