"""`precision`: measure error against run time of a scene."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, cast

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
    PictureBench,
    TimeBudget,
    list_gradient_parts,
    measure_in_rounds,
)
from advsearch.questions.precision.result import (
    Machine,
    PrecisionConfig,
    PrecisionPoint,
    PrecisionResult,
    Recommended,
    Sitting,
    draw_figures,
    list_cautions,
)
from advsearch.questions.precision.rule import (
    RoundUp,
    confirm_recommendation,
    describe_disagreement,
    fit_line,
    recommend_count,
    summarize_samples,
)

# fractions of the time by quantity; unused time is that of later ones
TIME_FRACTIONS = {"image": 0.6, "gradient": 0.4}
# fraction of a quantity's time for its reference
REFERENCE_FRACTION = 0.35
CONFIRM_FRACTION = 0.4
MIN_CONFIRMATIONS = 4
MAX_CONFIRMATIONS = 64
"""Fraction of a gradient's time to measure the recommended setting again, and how
often.

It counts from `MIN_CONFIRMATIONS` measurements on.
"""


def measure_precision(context: RunContext[PrecisionConfig]) -> PrecisionResult:
    """Measure error against run time, and write figures and numbers.

    The image and the gradient of each control are measured one after the other, each
    without a break, so that their times are comparable. A finished one is stored at
    once; a resumed run continues with the next, in the remaining seconds.
    """
    config = context.config
    start_time = time.perf_counter()
    hint = f"then {config.seconds:g} seconds of measurements; `seconds` sets them"
    context.progress.stage(workbench.LOADING, hint=hint)
    run = context.run
    problem, remarks = workbench.problem_from_config(config)
    for remark in remarks:
        context.progress.message(remark)
    measurer = QuantityMeasurer(config, problem, context.progress)
    measurements = context.open_measurements()
    setup_seconds = time.perf_counter() - start_time

    def measure_sittings() -> Iterator[Sitting]:
        """Yield each sitting; time that one leaves is shared among those after it."""
        seconds_left = config.seconds
        fractions = [fraction for _, fraction, _ in measurer.sittings]
        for number, (name, fraction, measure) in enumerate(measurer.sittings):
            fraction_left = math.fsum(fractions[number:])
            budget = TimeBudget(seconds_left * fraction / fraction_left)
            # A stored sitting is read; `measure` is called only for others.
            sitting = measurements.get_row(name, Sitting, partial(measure, budget))
            seconds_left = max(0.0, seconds_left - sitting.took)
            yield sitting

    def make_result(sittings: list[Sitting]) -> PrecisionResult:
        """Return the result of the sittings that are finished."""

        def join(name: str) -> list[Any]:
            """Return the rows of this name of all sittings."""
            return [row for sitting in sittings for row in getattr(sitting, name)]

        points = join("points")
        warnings = join("warnings")
        slopes = []
        for line in group_by_line(points).values():
            slope = fit_line(line, measurer.may_be_steeper(line[0]))
            if slope is not None:
                slopes.append(slope)
                warnings += filter(None, [describe_disagreement(slope, line)])
        return context.result(
            PrecisionResult,
            model=problem.model.name,
            environment=problem.environment,
            depth=problem.renderer.scene.max_depth,
            loss=config.loss,
            spp=problem.spp,
            goal=config.error,
            image_formation=results.Formation.of(problem.renderer.formation),
            machine=Machine(**context.machine, threads=count_threads()),
            points=points,
            slopes=slopes,
            references=join("references"),
            left_out=join("left_out"),
            warnings=[*warnings, *list_cautions(points)],
            recommendations=recommend_settings(
                points,
                confirmations=join("again"),
                goal=config.error,
                round_up=measurer.round_up,
                or_steeper=measurer.may_be_steeper,
            ),
            figures=[],
            seconds={"budget": config.seconds, "setup": setup_seconds},
        )

    result = measurements.collect(measure_sittings(), make_result)
    written = _write_figures(run, result)
    return result.model_copy(update={"figures": [str(path) for path in written]})


def _write_figures(run: RunDirectory, result: PrecisionResult) -> list[Path]:
    """Write the figures of a result, and return their paths."""
    return [
        run.write_file(f"images/precision.{suffix}", data)
        for suffix, data in draw_figures(result).items()
    ]


class QuantityMeasurer:
    """The quantities that can be measured.

    With a linear loss, gradients are those of an undenoised linear image and of a
    smooth loss, so that theory knows how their error falls.

    Attributes:
        sittings: the name of each quantity, its fraction of the time, and the function
            that measures it within a budget.
    """

    def __init__(
        self, config: PrecisionConfig, problem: Problem, progress: Progress
    ) -> None:
        self._config = config
        self._problem = problem
        self._progress = progress
        self._seed = seeds.stream(config.seed, "precision")
        self._is_linear = config.loss == "linear"
        self._renderer = problem.renderer
        self._loss = cast(gradients.Loss, problem.compute_loss)
        if self._is_linear:
            # A smooth loss of the raw image: differences may be taken per pixel.
            self._renderer = problem.renderer.copy_with(
                denoiser="none", transfer="linear"
            )
            self._renderer.plan = self._renderer.plan.with_pixel_steps()
            self._loss = gradients.make_smooth_loss(
                self._renderer.formation.resolution, config.seed
            )

        # name, fraction of the time, and the function that measures it
        self.sittings: list[tuple[str, float, Callable[[TimeBudget], Sitting]]] = []
        if "image" in config.measured_quantities:
            self.sittings.append(
                ("image", TIME_FRACTIONS["image"], self._measure_image)
            )
        if "gradient" in config.measured_quantities:
            parts = list_gradient_parts(
                self._renderer.plan.groups, linear=self._is_linear
            )
            if not parts:
                names = ",".join(config.controls)
                raise InputError(
                    f"`controls` {names}: has no derivative; leave "
                    "gradient out of `quantities`"
                )
            fraction = TIME_FRACTIONS["gradient"] / len(parts)
            for part in parts:
                measure_part = partial(self._measure_gradient, part)
                self.sittings.append(
                    (f"gradient of {part.name}", fraction, measure_part)
                )

    def round_up(self, point: PrecisionPoint, samples: float) -> int:
        """Return the next number of samples that a setting accepts.

        A line of the image is named after its sampler; one of a gradient has that of
        the run.
        """
        sampler: str = self._config.pixel_sampler
        if point.quantity != "gradient":
            sampler = point.estimator.removesuffix(OIDN)
        return self._renderer.scene.round_sample_count(samples, sampler)

    def may_be_steeper(self, point: PrecisionPoint) -> bool | None:
        """Return whether the error may fall faster than that of independent samples.

        It may with a stratified sampler (Owen 1997). None if theory says nothing, as
        where the estimator has a bias: of a step (differences), of an approximation
        (`material`), or of the denoiser.
        """
        sampler: str = self._config.pixel_sampler
        if point.quantity == "gradient":
            is_unbiased = self._is_linear and point.estimator == "adjoint"
        else:
            sampler = point.estimator
            is_unbiased = point.family == "none"  # not denoised
        return sampler != "independent" if is_unbiased else None

    def _measure_image(self, budget: TimeBudget) -> Sitting:
        """Measure pictures and the model's margin on them."""
        problem = self._problem
        u = problem.add_conditions(problem.domain.start)

        def margin(image: torch.Tensor) -> float:
            return -problem.judge(image, u).score  # a score is a negative margin

        bench = PictureBench(
            problem.renderer, u, margin, self._config.compared_samplers
        )
        return self._measure_settings("the picture", bench, budget)

    def _measure_gradient(self, part: GradientPart, budget: TimeBudget) -> Sitting:
        """Measure the gradient of a part, then its recommended setting again."""
        renderer = self._renderer
        title = f"gradient of {part.name}"
        start_time = time.perf_counter()
        bench = GradientBench(
            renderer, self._loss, gradients.find_interior_point(renderer), part
        )
        # `CONFIRM_FRACTION` of what the reference leaves is for the confirmation.
        first_fraction = 1.0 - CONFIRM_FRACTION * (1.0 - REFERENCE_FRACTION)
        sitting = self._measure_settings(
            title, bench, budget.take_fraction(first_fraction)
        )
        recommended = recommend_settings(
            sitting.points,
            confirmations=[],
            goal=self._config.error,
            round_up=self.round_up,
            or_steeper=self.may_be_steeper,
        )[0]  # a gradient is one quantity
        remark = None
        if budget.seconds_left > 0.0:
            remark = bench.check_bias(self._seed)
        again = self._confirm(title, bench, recommended, budget)
        warnings = [remark] if remark else []
        took = time.perf_counter() - start_time
        return sitting.model_copy(
            update={"again": again, "warnings": warnings, "took": took}
        )

    def _confirm(
        self,
        title: str,
        bench: GradientBench,
        recommended: Recommended,
        budget: TimeBudget,
    ) -> list[PrecisionPoint]:
        """Measure the recommended setting of a gradient again.

        Return its point, or nothing if it was not measured often enough, or nothing is
        recommended.
        """
        if recommended.estimator is None or recommended.spp is None:
            return []
        # a measured setting, with another sample count
        similar = next(
            setting
            for setting in bench.settings
            if setting.estimator == recommended.estimator
        )
        cost_per_sample = similar.cost / similar.spp
        setting = replace(
            similar, spp=recommended.spp, cost=cost_per_sample * recommended.spp
        )
        advance = self._begin_stage(
            f"{title}: {recommended.estimator} with {recommended.spp} samples again",
            budget,
        )
        seed = seeds.stream(self._seed, "confirm")
        measured = measure_in_rounds(
            [setting],
            bench.measure,
            budget,
            rounds=MAX_CONFIRMATIONS,
            seed=seed,
            on_done=lambda _: advance(),
        )
        samples = [numbers["gradient"] for numbers in measured.results[setting]]
        if len(samples) < MIN_CONFIRMATIONS:
            return []
        return [
            summarize_samples(
                setting, samples, bench.reference_error(setting, "gradient")
            )
        ]

    def _measure_settings(
        self, title: str, bench: PictureBench | GradientBench, budget: TimeBudget
    ) -> Sitting:
        """Compute a bench's references, and measure all of its settings in rounds."""
        start_time = time.perf_counter()
        reference_budget = budget.take_fraction(REFERENCE_FRACTION)
        references = bench.compute_references(
            reference_budget,
            self._seed,
            self._begin_stage(f"{title}: references", reference_budget),
        )
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
        points = []
        for setting, samples in measured.results.items():
            # A sample has numbers for each quantity, such as "picture" and "margin".
            for quantity in samples[0]:
                numbers = [sample[quantity] for sample in samples]
                points.append(
                    summarize_samples(
                        replace(setting, quantity=quantity),
                        numbers,
                        bench.reference_error(setting, quantity),
                    )
                )
        left_out = _describe_skipped(title, measured)
        return Sitting(
            points=points,
            references=references,
            left_out=left_out,
            took=time.perf_counter() - start_time,
        )

    def _begin_stage(self, name: str, budget: TimeBudget) -> Callable[..., None]:
        """Start a stage of the progress bar in seconds, and return what advances it.

        The returned function moves the bar to the seconds that have passed; keywords
        are shown next to it.
        """
        total = max(1, math.ceil(budget.seconds_left))
        done = 0
        self._progress.stage(
            name, total, hint="counted in seconds; `seconds` sets them", at_most=True
        )

        def advance(**info: float | str) -> None:
            nonlocal done
            passed = min(total, total - math.ceil(budget.seconds_left))
            self._progress.advance(passed - done, **info)
            done = passed

        return advance


def _describe_skipped(title: str, measured: Any) -> list[str]:
    """Describe which settings were not measured: a line for each estimator."""
    skipped_counts: dict[str, list[str]] = {}
    for setting in measured.skipped:
        skipped_counts.setdefault(f"{title} by {setting.estimator}", []).append(
            str(setting.spp)
        )
    return [
        f"{line}: {', '.join(counts)} samples"
        for line, counts in skipped_counts.items()
    ]


def group_by_line(
    points: Sequence[PrecisionPoint],
) -> dict[tuple[str, ...], list[PrecisionPoint]]:
    """Group points by quantity, control, family and estimator.

    The points of a group are in ascending order of samples.
    """
    lines: dict[tuple[str, ...], list[PrecisionPoint]] = {}
    for point in points:
        lines.setdefault(
            (point.quantity, point.control, point.family, point.estimator), []
        ).append(point)
    return {
        key: sorted(line, key=lambda point: point.spp) for key, line in lines.items()
    }


def recommend_settings(
    points: Sequence[PrecisionPoint],
    confirmations: Sequence[PrecisionPoint],
    goal: float,
    round_up: RoundUp,
    or_steeper: Callable[[PrecisionPoint], bool | None] = lambda point: None,
) -> list[Recommended]:
    """Return the fastest setting for a goal, of each quantity, control and family.

    A recommendation without an estimator says that none does. One of a gradient that
    was measured again rests on the new measurements.

    Args:
        points: measured settings.
        confirmations: gradient settings that were measured again.
        goal: the relative error.
        round_up: gives the next sample count that a setting takes.
        or_steeper: function of a point, whether its error may fall faster than that of
            independent samples; see `fit_line`.
    """
    candidates: dict[tuple[str, ...], list[Recommended]] = {}
    for (quantity, control, family, _), line in group_by_line(points).items():
        quantity_candidates = candidates.setdefault((quantity, control, family), [])
        candidate = recommend_count(line, goal, round_up, or_steeper(line[0]))
        if candidate:
            quantity_candidates.append(candidate)
    recommended = []
    for (quantity, control, family), quantity_candidates in candidates.items():
        best = min(
            quantity_candidates,
            key=lambda row: row.seconds or 0.0,
            default=Recommended(quantity=quantity, control=control),
        )
        for point in confirmations:
            is_same = (point.control, point.estimator) == (best.control, best.estimator)
            if is_same and quantity == "gradient":
                best = confirm_recommendation(best, point, round_up)
        recommended.append(best.model_copy(update={"family": family}))
    return recommended


def count_threads() -> dict[str, int]:
    """Return how many threads torch uses, and Dr.Jit if anything was rendered."""
    counts = {"torch": torch.get_num_threads()}
    if "drjit" in sys.modules:
        counts["render"] = int(sys.modules["drjit"].thread_count())
    return counts
