"""Error against run time: slopes, references and budgets on synthetic noise whose law is known, and one tiny scene."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter

from advsearch.cli.main import main
from advsearch.cli.output import shown_text as precision_text
from advsearch.cluster import Done, InProcess, Workforce
from advsearch.config import AttackConfig
from advsearch.engine import attack_parts as attacking
from advsearch.engine.gradients import smooth_loss
from advsearch.engine.loading import load_scene
from advsearch.errors import ClusterError, InputError
from advsearch.progress import NullProgress
from advsearch.questions.precision import carry_out as measuring
from advsearch.questions.precision.answer import (
    WARM_UP,
    PrecisionPoint,
    PrecisionReference,
    PrecisionResult,
    Recommended,
    busy,
    headline,
)
from advsearch.questions.precision.benches import (
    COUNTS,
    PolicyCurve,
    SearchMark,
    curve_of,
    marks_at,
    missing,
    sooner,
    variants,
)
from advsearch.questions.precision.carry_out import precision_from_config, references_of
from advsearch.questions.precision.figures import precision_figures
from advsearch.questions.precision.gradient import MATRIX, GradientBench, estimated_parts, matrix_groups
from advsearch.questions.precision.points import (
    FURTHEST,
    INDEPENDENT,
    STRATIFIED,
    MeasuredSetting,
    Point,
    ReferenceValue,
    confirm_recommendation,
    fit_line,
    fixed_seconds,
    heavy_tailed,
    levels_off,
    point_of,
    quartiles,
    reaching,
    recommend,
    reference_of,
    reference_through,
    typical,
    warning_of,
)
from advsearch.questions.precision.recommended import MeasuredLine, Section, rounding
from advsearch.questions.precision.rounds import (
    LEAST,
    ReferencePart,
    Stopwatch,
    TimeBudget,
    gather,
    in_rounds,
    one_by_one,
    part_samples,
    timing_machine,
)
from advsearch.questions.precision.settings import PrecisionConfig
from advsearch.runs.listing import finished
from advsearch.runs.summary import read_result
from advsearch.scene.formation import next_count
from advsearch.scene.gradients import Group

SIZE = 400
"""Numbers in a synthetic picture."""
TRUTH = 1.0 + 0.5 * np.sin(np.arange(SIZE))
COUNTS_TRIED = (4, 16, 64, 256, 1024)
TOLERANCE = 0.05
"""Of a slope fitted to synthetic noise: eight repeats of 400 numbers scatter by half of that."""


class Clock:
    """A clock that only work moves."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def noisy(count: int, seed: int, bias: float = 0.0, power: float = -0.5) -> np.ndarray:
    """A picture with noise of standard deviation count^power, and a bias that no samples remove."""
    generator = np.random.default_rng(seed)
    found: np.ndarray = TRUTH * (1.0 + bias) + count**power * generator.standard_normal(SIZE)
    return found


def setting(count: int, series: str = "independent", cost: float | None = None) -> MeasuredSetting:
    return MeasuredSetting("image", series, count, float(count) if cost is None else cost)


def measured(
    reference: ReferenceValue,
    *,
    bias: float = 0.0,
    power: float = -0.5,
    fixed: float = 0.0,
    series: str = "independent",
) -> list[Point]:
    """Points of synthetic noise; a sample takes a millisecond."""
    points = []
    for count in COUNTS_TRIED:
        errors = [reference.relative_error(noisy(count, 100 * count + k, bias, power)) for k in range(8)]
        samples = [({"error": error}, fixed + 1e-3 * count) for error in errors]
        points.append(point_of(setting(count, series), samples, floor=reference.error))
    return points


def exact() -> ReferenceValue:
    """A reference whose own error is far below everything measured."""
    return reference_of([noisy(10**8, seed) for seed in (1, 2)])


def rough(samples: int) -> ReferenceValue:
    """A reference from four parts that are not much better than what is measured."""
    return reference_of([noisy(samples, seed) for seed in range(4)])


# ---- references -----------------------------------------------------------------------------------------------------


def test_the_error_of_a_reference_is_what_its_parts_scatter_by() -> None:
    found = rough(1000)
    true = float(np.linalg.norm(found.value - TRUTH) / np.linalg.norm(TRUTH))
    assert found.parts == 4
    assert found.error == pytest.approx(true, rel=0.15)


def test_two_halves_give_half_their_difference() -> None:
    one, other = np.array([1.0, 2.0]), np.array([1.4, 2.3])
    assert reference_of([one, other]).error * reference_of([one, other]).size == pytest.approx(0.25)


def test_a_reference_through_a_bend_knows_of_scatter_and_bias() -> None:
    generator = np.random.default_rng(0)
    parts = [1.0 + 0.1 * generator.standard_normal(1) for _ in range(16)]
    found = reference_through(np.exp, parts)
    assert found.error * found.size == pytest.approx(math.e * 0.1 / 4.0, rel=0.4)
    assert reference_through(lambda x: x, parts).error == pytest.approx(reference_of(parts).error, rel=1e-9)


def test_one_part_is_no_reference() -> None:
    for make in (reference_of, lambda parts: reference_through(lambda x: x, parts)):
        with pytest.raises(ValueError, match="two independent parts, got 1"):
            make([TRUTH])


def test_cosine_and_error_of_a_vector() -> None:
    one = reference_of([np.array([3.0, 4.0])] * 2)
    assert one.relative_error(np.array([3.0, 4.5])) == pytest.approx(0.1)
    assert one.cosine(np.array([4.0, -3.0])) == pytest.approx(0.0)
    assert math.isnan(one.cosine(np.zeros(2)))
    assert reference_of([np.zeros(2)] * 2).relative_error(np.ones(2)) == math.inf


# ---- points ---------------------------------------------------------------------------------------------------------


def test_the_reference_s_own_error_is_taken_off() -> None:
    reference = rough(256)
    point = next(one for one in measured(reference) if one.setting.spp == 256)
    true = 256**-0.5 * math.sqrt(SIZE) / float(np.linalg.norm(TRUTH))
    assert point.known and point.error == pytest.approx(true, rel=0.06)
    assert point.interval[0] < point.error < point.interval[1]


def test_no_point_below_the_reference_is_called_known() -> None:
    reference = rough(100)  # 400 samples in all
    for point in measured(reference):
        true = point.setting.spp**-0.5 * math.sqrt(SIZE) / float(np.linalg.norm(TRUTH))
        assert point.known == (point.setting.spp < 256), point.setting
        if not point.known:
            assert point.error > true and point.interval[0] == 0.0  # a limit is above the truth


def test_seconds_leave_the_warm_up_out() -> None:
    times = [9.0] * WARM_UP + [1.0, 3.0, 2.0]
    assert typical(times) == 2.0
    assert typical([9.0, 4.0]) == 4.0


def test_quartiles() -> None:
    assert quartiles([1.0, 2.0, 3.0, 4.0, 5.0]) == (2.0, 3.0, 4.0)


def tails(kind: str, seed: int, repeats: int = 8) -> tuple[list[dict[str, float]], float]:
    """Measurements of pictures of 4,096 pixels whose noise is normal, or has rare bright pixels that hold nearly all of
    the error, and the true root mean square."""
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(repeats, 4096))
    if kind == "fireflies":  # three a picture
        noise += (rng.random(noise.shape) < 3.0 / 4096) * rng.exponential(100.0, noise.shape)
    true = math.sqrt(4096 * (1.0 + (3.0 / 4096 * 2.0 * 100.0**2 if kind == "fireflies" else 0.0)))
    reference = ReferenceValue(np.zeros(4096), 0.0, 1.0, 2)
    errors = [reference.relative_errors(one) for one in noise]
    return [{"error": error, "fourth": fourth} for error, fourth in errors], true


def test_an_error_that_a_few_pixels_hold_has_no_interval_and_any_other_has_one_that_holds() -> None:
    covered = 0
    for seed in range(100):
        numbers, true = tails("normal", seed)
        point = point_of(setting(4), [(one, 1.0) for one in numbers])
        assert not point.heavy
        covered += point.interval[0] <= true <= point.interval[1]
        numbers, _ = tails("fireflies", seed)
        point = point_of(setting(4), [(one, 1.0) for one in numbers])
        assert point.heavy and math.isnan(point.interval[0])
    assert covered >= 90
    assert not heavy_tailed([{"error": 1.0, "fourth": math.nan}]), "few numbers say nothing"


# ---- slopes ---------------------------------------------------------------------------------------------------------


def test_independent_noise_has_slope_minus_a_half() -> None:
    points = measured(exact())
    for against in ("samples", "seconds"):
        line = fit_line(points, against, INDEPENDENT)
        assert line is not None and line.slope == pytest.approx(-0.5, abs=TOLERANCE)
        assert line.interval[0] < -0.5 < line.interval[1] or abs(line.slope + 0.5) < 0.02
        assert line.agrees is True and line.points == 5
        assert warning_of(line, points) is None


def test_the_slope_survives_a_reference_that_is_hardly_better() -> None:
    line = fit_line(measured(rough(256)), theory=INDEPENDENT)
    assert line is not None and line.points == 4  # 1,024 samples are below the reference
    assert line.slope == pytest.approx(-0.5, abs=TOLERANCE)


def test_a_bias_levels_off_and_is_warned_of() -> None:
    points = measured(exact(), bias=0.1)
    line = fit_line(points, theory=INDEPENDENT)
    assert line is not None and line.slope > -0.35 and line.agrees is False
    assert levels_off(points) and not levels_off(measured(exact()))
    assert "levels off" in str(warning_of(line, points))


def test_a_steeper_slope_agrees_only_where_theory_allows_it() -> None:
    points = measured(exact(), power=-0.75)
    strict, free = fit_line(points, theory=INDEPENDENT), fit_line(points, theory=STRATIFIED)
    assert strict is not None and free is not None
    assert strict.slope == pytest.approx(-0.75, abs=TOLERANCE)
    assert strict.agrees is False and free.agrees is True


def test_a_fixed_cost_keeps_points_out_of_the_slope_against_seconds() -> None:
    points = measured(exact(), fixed=0.01)
    assert fixed_seconds(points) == pytest.approx(0.01, rel=1e-6)
    line = fit_line(points, "seconds", INDEPENDENT)
    assert line is not None and line.points == 3 and line.fixed_seconds == pytest.approx(0.01)
    assert line.agrees is True and line.slope == pytest.approx(-0.5, abs=0.1)
    slow = fit_line(measured(exact(), fixed=1.0), "seconds", INDEPENDENT)
    assert slow is not None and slow.points == 5 and slow.slope < -1.0 and slow.agrees is None


def test_a_line_needs_three_known_points() -> None:
    assert fit_line(measured(exact())[:2]) is None
    assert fit_line(measured(rough(4))) is None


# ---- what is recommended --------------------------------------------------------------------------------------------


def error_at(samples: float) -> float:
    found: float = samples**-0.5 * math.sqrt(SIZE) / float(np.linalg.norm(TRUTH))
    return found


def reached(found: Recommended | None) -> tuple[Recommended, int, float]:
    """A recommendation with its sample count and its error, which are there."""
    assert found is not None and found.spp is not None and found.error is not None
    return found, found.spp, found.error


@pytest.mark.parametrize("goal", [0.3, 0.1, 0.05])
def test_a_recommended_count_reaches_its_goal(goal: float) -> None:
    found, spp, _ = reached(reaching(measured(exact()), goal))
    assert found.basis in ("interpolated", "fitted")
    assert error_at(spp) == pytest.approx(goal, rel=0.1)
    assert found.seconds == pytest.approx(1e-3 * spp, rel=0.01)


def test_a_line_that_explains_all_points_overrules_a_lucky_one() -> None:
    def point(spp: int, error: float) -> Point:
        return Point(setting(spp), "error", error, (0.5 * error, 2.0 * error), True, 0.0, 1e-3 * spp, 6)

    true = [point(spp, spp**-0.5) for spp in (4, 16, 64, 256)]
    lucky = [point(8, 0.7 * 8**-0.5), *true]
    found = reaching(lucky, 0.1)
    assert found is not None and found.basis == "fitted" and found.spp == pytest.approx(100, rel=0.15)
    bent = [Point(one.setting, "error", max(one.error, 0.2), (0.19, 0.21), True, 0.0, 1.0, 6) for one in true]
    assert reaching(bent, 0.1) is None


def up(_: str, samples: float) -> int:
    return math.ceil(samples - 1e-9)


@pytest.mark.parametrize(("error", "times", "promised"), [(0.08, 1, 0.08), (0.2, 4, 0.1), (10.0, FURTHEST, 2.5)])
def test_new_measurements_of_a_recommended_setting_are_what_is_promised(
    error: float, times: int, promised: float
) -> None:
    one, spp, _ = reached(reaching(measured(exact()), 0.1))
    found = confirm_recommendation(one, Point(setting(spp), "error", error, (0.0, 1.0), True, 0.0, 0.5, 12), up)
    assert (found.basis, found.repeats, found.spp) == ("confirmed", 12, times * spp)
    assert found.error == pytest.approx(promised) and found.seconds == pytest.approx(0.5 * times)


def test_what_is_chosen_among_noisy_points_looks_better_than_it_is_until_it_is_measured_again() -> None:
    """Three lines of the same true error, root mean squares of four: the promise of the cheapest is too good."""
    rng = np.random.default_rng(5)

    def point(series: str, spp: int, repeats: int) -> Point:
        squares = rng.normal(0.0, spp**-0.5, repeats) ** 2
        return point_of(setting(spp, series), [({"error": math.sqrt(one)}, 1e-3 * spp) for one in squares])

    before, after = [], []
    for _ in range(200):
        lines = {name: [point(name, spp, 4) for spp in (4, 16, 64, 256)] for name in "abc"}
        one, spp, error = reached(recommend({setting(4, name).line: points for name, points in lines.items()}, 0.1))
        before.append(math.log(spp**-0.5 / error))
        _, spp, error = reached(confirm_recommendation(one, point(str(one.estimator), spp, 24), up))
        after.append(math.log(spp**-0.5 / error))
    assert np.mean(before) > 0.2
    assert abs(np.mean(after)) < 0.05 and np.quantile(np.abs(after), 0.95) < math.log(1.5)


def test_where_points_are_too_few_for_a_line_theory_says_how_it_goes_on() -> None:
    point = measured(exact())[1]  # 16 samples
    line = {point.setting.line: [point]}
    assert recommend(line, 0.5 * point.error) is None
    found, spp, _ = reached(recommend(line, 0.5 * point.error, theories={point.setting.line: INDEPENDENT}))
    assert found.basis == "extrapolated" and spp == 64 and found.seconds == pytest.approx(0.064)
    assert recommend(line, point.error / 5.0, theories={point.setting.line: INDEPENDENT}) is None, "too far"


def test_beyond_the_last_point_it_says_so_and_not_too_far() -> None:
    points = measured(exact())
    found, spp, _ = reached(reaching(points, 0.5 * points[-1].error))
    assert found.basis == "extrapolated"
    assert error_at(spp) == pytest.approx(found.goal, rel=0.15)
    assert reaching(points, points[-1].error / FURTHEST) is None


def test_what_levels_off_is_never_recommended_below_its_level() -> None:
    biased = measured(exact(), bias=0.1, series="biased")
    assert reaching(biased, 0.05) is None
    plain = measured(exact(), fixed=1.0)
    both = {one[0].setting.line: one for one in (biased, plain)}
    cheap, good = recommend(both, 0.2), recommend(both, 0.05)
    assert cheap is not None and cheap.estimator == "biased"
    assert good is not None and good.estimator == "independent"


def test_a_count_is_rounded_to_what_the_sampler_takes() -> None:
    _, spp, error = reached(reaching(measured(exact()), 0.1, lambda series, samples: next_count("ldsampler", samples)))
    assert math.log(spp, 4) == pytest.approx(round(math.log(spp, 4)))
    assert error <= 0.1


def test_the_cheapest_that_is_good_enough_is_taken_as_it_is() -> None:
    found = reaching(measured(exact()), 10.0)
    assert found is not None and (found.spp, found.basis) == (4, "measured")


# ---- rounds and budgets ---------------------------------------------------------------------------------------------


def timed(clock: Clock, rate: float = 1e-3, cold: float = 0.0) -> Callable[[MeasuredSetting, int], tuple[int, float]]:
    """Takes `rate` seconds for each unit of cost, and `cold` more at the first call of a setting."""
    seen: set[MeasuredSetting] = set()

    def measure(one: MeasuredSetting, seed: int) -> tuple[int, float]:
        seconds = rate * one.cost + (0.0 if one in seen else cold)
        seen.add(one)
        clock.now += seconds
        return seed, seconds

    return measure


def test_rounds_are_interleaved_cheapest_first_with_a_seed_each() -> None:
    clock, order = Clock(), []
    settings = [setting(count, series) for series in ("a", "b") for count in (16, 4)]
    found = in_rounds(
        settings,
        timed(clock),
        TimeBudget(100.0, clock),
        rounds=3,
        seed=0,
        warm_up=0,
        on_done=lambda one: order.append(one.cost),
    )
    assert order == [4.0, 4.0, 16.0, 16.0] * 3
    given = [seed for taken in found.results.values() for seed, _ in taken]
    assert len(set(given)) == len(given) == 12
    assert found.complete and found.left_out == ()


@pytest.mark.parametrize("seconds", [0.5, 3.0, 20.0])
@pytest.mark.parametrize("cold", [0.0, 0.2])
def test_a_budget_is_kept_and_what_was_left_out_is_said(seconds: float, cold: float) -> None:
    clock = Clock()
    settings = [setting(count, series) for series in ("a", "b", "c") for count in COUNTS_TRIED]
    found = in_rounds(settings, timed(clock, cold=cold), TimeBudget(seconds, clock), rounds=50, seed=0)
    assert clock.now <= seconds + 3 * cold
    assert set(found.left_out) | set(found.results) == set(settings)
    assert not found.complete
    if found.left_out and cold == 0.0:
        assert max(one.cost for one in found.results) <= min(one.cost for one in found.left_out)
        assert min(len(taken) for taken in found.results.values()) >= LEAST


def test_what_compiles_first_is_never_taken_for_the_time_of_a_setting() -> None:
    """On a busy machine the first call may use up all of the time; there is another one all the same."""
    clock = Clock()
    found = in_rounds([setting(4), setting(16)], timed(clock, cold=40.0), TimeBudget(10.0, clock), rounds=8, seed=0)
    (taken,) = found.results.values()
    assert typical([seconds for _, seconds in taken]) == pytest.approx(0.004) and found.left_out == (setting(16),)


def test_waiting_for_other_processes_counts_by_the_clock_and_not_as_processor_time() -> None:
    watch = Stopwatch()
    time.sleep(0.3)
    assert watch.wall >= 0.3 and watch.processor < 0.2

    def point(wall: float) -> PrecisionPoint:
        return PrecisionPoint(
            quantity="image", estimator="a", spp=4, error=0.1, seconds=1.0, wall_seconds=wall, repeats=5
        )

    assert busy([point(0.6), point(1.0), point(9.0)]) is None and busy([]) is None
    assert "busy" in str(busy([point(0.6), point(2.5), point(9.0)]))


def test_a_part_of_a_budget_is_a_budget() -> None:
    clock = Clock()
    whole = TimeBudget(10.0, clock)
    clock.now = 2.0
    part = whole.share(0.25)
    assert (whole.left, part.left) == (8.0, 2.0)
    clock.now = 50.0
    assert (whole.left, part.left) == (0.0, 0.0)


def test_a_reference_has_two_parts_whatever_they_take_and_stops_in_time() -> None:
    clock = Clock()

    def part(seed: int) -> np.ndarray:
        clock.now += 1.0
        return np.array([float(seed)])

    parts = one_by_one(part)
    assert [len(gather(parts, TimeBudget(one, clock), seed=0)) for one in (0.1, 0.0)] == [2, 2]
    found = gather(parts, TimeBudget(5.5, clock), seed=0)
    assert len(found) == 5 and len({float(one[0]) for one in found}) == 5
    assert len(gather(parts, TimeBudget(1e9, clock), seed=0, most=7)) == 7


def test_parts_that_come_two_at_a_time_stop_in_time_too() -> None:
    """As two workers have them, the later one first: after five and a half seconds there are twice five."""
    clock = Clock()

    def parts(wanted: Iterator[int]) -> Iterator[tuple[int, np.ndarray]]:
        while both := list(islice(wanted, 2)):
            clock.now += 1.0
            yield from ((seed, np.array([float(seed)])) for seed in reversed(both))

    assert len(gather(parts, TimeBudget(5.5, clock), seed=0)) == 10
    assert len(gather(parts, TimeBudget(0.1, clock), seed=0)) == 2


def test_samples_of_a_part_fit_into_the_time() -> None:
    assert part_samples(1e-3, 10.0) == 1024
    assert part_samples(1e-2, 10.0) == 64  # 4 x 256 x 0.01 s is just over
    assert part_samples(1.0, 10.0) == 16


# ---- what is compared -----------------------------------------------------------------------------------------------


def test_variants_have_a_family_and_a_theory() -> None:
    found = {one.series: one for one in variants(("independent", "multijitter", "ldsampler"), (2, 12), 6)}
    assert [one for one in found if one.startswith("depth")] == ["depth 2", "depth 6", "depth 12"]
    assert found["independent"].theory == INDEPENDENT and found["ldsampler"].theory == STRATIFIED
    assert found["independent + oidn"].family == "oidn" and found["independent + oidn"].theory.slope is None
    assert "path integrator" not in {one.series for one in variants(("independent",), (), 6, volumetric=True)}


def test_every_count_that_is_measured_is_one_that_its_sampler_takes() -> None:
    from advsearch.scene.mitsuba_backend.variant import mitsuba

    mi = mitsuba()
    for one in variants((*COUNTS, "stratified", "multijitter", "ldsampler"), (2,), 6):
        sampler = mi.load_dict({"type": one.sampler})
        for count in one.counts:
            sampler.set_sample_count(count)
            assert sampler.sample_count() == count, one.series
        for wanted in (1, 5, 24, 65, 130):
            count = next_count(one.sampler, wanted)
            sampler.set_sample_count(count)
            assert count >= wanted and sampler.sample_count() == count, one.series


def test_a_gradient_is_recommended_in_counts_of_the_runs_sampler() -> None:
    section = Section("multijitter")
    assert rounding(section, "gradient")("adjoint", 39) == 42 and rounding(section, "image")("ldsampler", 39) == 64
    assert rounding(Section("independent"), "gradient")("adjoint", 39) == 39


def group(parameter: str, *valid: str) -> Group:
    return Group(parameter, 1, valid, control="light")


def test_parts_of_a_control_with_other_estimators_have_names_of_their_own() -> None:
    found = estimated_parts(
        [group("x", "differences"), group("power", "adjoint", "differences"), group("kind")], linear=True
    )
    assert [one.name for one in found] == ["light.x", "light.power"]
    assert found[0].estimators == ("differences",)
    assert found[1].estimators == ("adjoint", "differences")
    secant = [group("x", "secant", "differences")]
    assert estimated_parts(secant, linear=True)[0].estimators == ("differences",)
    assert "secant" in estimated_parts(secant, linear=False)[0].estimators


def test_a_part_has_a_matrix_where_all_of_its_groups_have_one() -> None:
    texels, frame = group("texels", "adjoint"), group("frame", "adjoint")
    assert estimated_parts([texels, frame], linear=True, by_matrix=[texels.name])[0].estimators == ("adjoint",)
    assert estimated_parts([texels], linear=True, by_matrix=[texels.name])[0].estimators == ("adjoint", MATRIX)


def test_a_matrix_gives_the_gradient_of_the_adjoint_and_the_next_one_sooner() -> None:
    renderer = load_scene("mug").renderer("texture", resolution=24, denoise="none")
    assert matrix_groups(renderer) == {"texture.texels"}
    assert not matrix_groups(load_scene("mug").renderer("pose", resolution=24))
    (part,) = estimated_parts(renderer.plan.groups, linear=True, by_matrix=matrix_groups(renderer))
    loss = smooth_loss((24, 24))
    bench = GradientBench(renderer, loss, renderer.start, part)
    bench.reference = reference_of([part.of(renderer.gradient(loss, renderer.start, seed, 1024)[1]) for seed in (1, 2)])
    matrix = next(one for one in bench.settings if (one.series, one.spp) == (MATRIX, 256))
    numbers, seconds = bench.measure(matrix, 1)
    assert numbers["cosine"] > 0.9 and numbers["later_seconds"] < seconds / 2


# ---- policies -------------------------------------------------------------------------------------------------------


def test_marks_are_powers_of_two_and_the_end() -> None:
    assert marks_at(32) == (1, 2, 4, 8, 16, 32)
    assert marks_at(20) == (1, 2, 4, 8, 16, 20)


def test_a_curve_is_medians_and_quartiles_at_common_marks() -> None:
    searches = [[SearchMark(1, 1.0 + k, float(k)), SearchMark(2, 2.0, 2.0 * k)] for k in range(5)]
    found = curve_of("random", [*searches, searches[0][:1]])
    assert found.renders == (1,) and found.repeats == 6
    found = curve_of("random", searches)
    assert found.objective == ((1.0, 2.0, 3.0), (2.0, 4.0, 6.0)) and found.seconds == (3.0, 2.0)


def test_the_policy_that_gets_there_sooner() -> None:
    quick = PolicyCurve("quick", (1, 2), (1.0, 2.0), ((0.0, 0.0, 0.0), (8.0, 9.0, 9.5)), 5)
    slow = PolicyCurve("slow", (1, 2), (1.0, 4.0), ((0.0, 0.0, 0.0), (9.0, 10.0, 10.0)), 5)
    assert missing(quick, best=10.0, start=0.0) == (1.0, 0.1)
    assert sooner([quick, slow], 0.2, best=10.0, start=0.0) == ("quick", 2, 2.0)
    assert sooner([quick, slow], 0.05, best=10.0, start=0.0) == ("slow", 2, 4.0)
    assert sooner([quick], 0.05, best=10.0, start=0.0) is None
    assert sooner([quick], 0.05, best=0.0, start=0.0) is None


# ---- the command ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"samplers": "halton"}, "samplers: expected independent, stratified"),
        ({"quantities": "image,time"}, "quantities: expected image, gradient, objective"),
        ({"depths": "1,2"}, "depths: expected whole numbers from 2 to 64"),
        ({"depths": "deep"}, "depths: expected whole numbers"),
        ({"seconds": 0.0}, "seconds: expected a number greater than 0"),
        ({"rounds": 2}, "rounds: expected a whole number from 3"),
    ],
)
def test_bad_settings_are_refused(given: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        PrecisionConfig(object="mug", **given)


def test_settings_go_through_yaml_and_the_command_line(tmp_path: Path) -> None:
    config = PrecisionConfig(object="mug", controls="pose", depths=[3, 9], policies=["random"])
    path = tmp_path / "run.yaml"
    path.write_text(config.to_yaml(), encoding="utf-8")
    assert PrecisionConfig.from_yaml(path) == config
    assert config.command_line() == "advsearch precision --control pose --depths 3,9 --policies random"
    shared = AttackConfig.of(config, norm="l2")
    assert (shared.object, shared.controls, shared.objective, shared.norm) == ("mug", {"pose": {}}, None, "l2")
    assert (shared.steps, shared.seconds) == (None, None), "what only has the same name is not shared"


def test_the_machine_is_named(tmp_path: Path) -> None:
    info = tmp_path / "cpuinfo"
    info.write_text("processor : 0\nmodel name : An  Example CPU\n", encoding="utf-8")
    assert timing_machine(info).cpu == "An Example CPU"
    assert timing_machine(tmp_path / "none").cpu and timing_machine().cores >= 1


def test_a_tiny_scene_from_end_to_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    words = "--object mug --control environment --resolution 32 --seconds 6 --samplers independent --depths 2 --steps 4"
    words += " --repeats 1 --policies random --threads 1 --json --quiet"
    before = time.process_time()
    assert main(["precision", *words.split()]) == 0
    assert time.process_time() - before < 40.0  # of one thread: what others do on the machine takes none of it
    report = json.loads(capsys.readouterr().out)
    assert (report["schema"], report["command"]) == (1, "precision")
    assert {one["quantity"] for one in report["points"]} == {"image", "gradient", "objective"}
    for one in report["points"]:
        assert {"estimator", "spp", "error", "seconds"} <= set(one) and one["seconds"] > 0.0
    assert {"image", "gradient"} == {one["quantity"] for one in report["references"]}
    assert report["machine"]["cpu"] and report["machine"]["threads"]["render"] >= 1
    assert report["seconds"]["total"] > 0.0
    slopes = {(one["quantity"], one["estimator"], one["measure"], one["against"]): one for one in report["slopes"]}
    for one in report["recommendations"]:
        assert one.get("basis") != "confirmed" or one["repeats"] >= 4
    independent = slopes.get(("image", "independent", "error", "samples"))
    if independent is not None:  # a slow machine measures too few points
        assert independent["slope"] == pytest.approx(-0.5, abs=0.15)
    result = PrecisionResult.of(report)
    assert precision_text(result).count("images/precision.") == 2 and precision_text(result).startswith(
        headline(result)
    )
    for one in report["points"]:
        assert one["quantity"] == "objective" or one["wall_seconds"] > 0.0
    run = Path(report["run"])
    assert run.parent == Path("runs") and (run / "run.yaml").is_file() and (run / "summary.json").is_file()
    assert [Path(path).suffix for path in report["figures"]] == [".png", ".svg"]
    png, svg = (Path(path).read_bytes() for path in report["figures"])
    assert png.startswith(b"\x89PNG") and report["machine"]["cpu"].encode() in svg


class Stop(NullProgress):
    """A watcher that presses Ctrl-C at the stage with a name."""

    def __init__(self, at: str) -> None:
        self.at = at

    def stage(self, name: str, total: int | None = None, *, hint: str = "", at_most: bool = False) -> None:
        if self.at in name:
            raise KeyboardInterrupt


def test_a_part_that_is_measured_is_kept_and_not_measured_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "run"
    config = PrecisionConfig(
        object="mug",
        controls={"environment.rotation": {}},
        quantities="image,gradient",
        samplers="independent",
        depths="2",
        resolution=(8, 8),
        seconds=1.0,
        rounds=3,
        threads=1,
        run=str(folder),
    )
    stopped = precision_from_config(config, progress=Stop("gradient of environment: references"))
    assert stopped.ending == "interrupted" and {one.quantity for one in stopped.points} == {"image"}
    kept = read_result(folder)
    assert kept.to_dict() == stopped.to_dict() and not finished(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(measuring, "PictureBench", lambda *_: pytest.fail("measured again"))
        assert main(["resume", str(folder), "--json", "--quiet"]) == 0
    report = PrecisionResult.of(json.loads(capsys.readouterr().out))
    assert report.ending == "done" and finished(folder) and len(report.figures) == 2
    pictures = [one.to_dict() for one in report.points if one.quantity == "image"]
    assert pictures == [one.to_dict() for one in stopped.points]
    assert {one.quantity for one in report.points} == {"image", "gradient"}


@pytest.mark.slow
def test_workers_make_the_references_and_what_is_timed_stays_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By differences and by an adjoint; each part is the one that this process would have made."""
    settings: dict[str, Any] = {
        "object": "mug", "controls": {"pose.yaw": {}, "texture": {}}, "quantities": "image,gradient", "depths": "2",
        "samplers": "independent", "resolution": (8, 8), "seconds": 2.0, "rounds": 3, "threads": 1,
    }  # fmt: skip
    made = InProcess(references_of(PrecisionConfig(**settings).plain()))
    asked: dict[ReferencePart, np.ndarray] = {}
    died: list[str] = []

    class Watched:
        facts = Workforce(workers=2, most=2, busy=1.0, alive=2.0)

        def results(self, batches: Iterable[Sequence[Any]]) -> Iterator[Done]:
            for done in made.results(batches):
                (one,) = done.items
                asked.update({} if one is None else {one: done.value[0]})
                yield replace(done, lost="it died") if one is not None and died else done

    monkeypatch.setattr(attacking, "executor_of", lambda work, **_: nullcontext(Watched()))
    report = precision_from_config(PrecisionConfig(**settings, workers=2, run=str(tmp_path / "run")))
    assert sum(one.parts for one in report.references) == len(asked) >= 8
    assert {(one.name, one.by) for one in asked} == {
        ("image", "raw"), ("image", "oidn"), ("image", "depth"), ("gradient of pose", "differences"),
        ("gradient of texture", "adjoint"),
    }  # fmt: skip
    assert report.shared is not None and "workers       2 at most" in precision_text(report)
    again = references_of(PrecisionConfig(**settings).plain())
    for one in {each.name: each for each in asked}.values():
        assert np.array_equal(again([one])[0], asked[one]) and asked[one].dtype == np.float64
    died.append("now")
    with pytest.raises(ClusterError, match="image, a part of its reference: it died; leave `workers` out"):
        precision_from_config(PrecisionConfig(**settings, workers=2, run=str(tmp_path / "lost")))


def test_what_was_measured_is_the_same_after_json() -> None:
    setting = MeasuredSetting("image", "independent", 4, 4.0)
    point = point_of(setting, [({"error": 0.1}, 0.5)], "error", 0.01)
    line = MeasuredLine(setting.line, "error", [point], INDEPENDENT, "raw", point)
    reference = PrecisionReference(quantity="image", reference="raw", error=math.inf, parts=2, spp=64)
    curve = PolicyCurve("random", (1, 2), (0.5, 1.0), ((0.1, 0.2, 0.3), (0.2, 0.3, 0.4)), 3)
    section = Section("independent", [line], [reference], [(setting, curve)], 0.5, (setting,), ["a warning"])
    adapter = TypeAdapter(Section)
    again = adapter.validate_python(json.loads(json.dumps(adapter.dump_python(section, mode="json"))))
    assert repr(again).replace("nan", "inf") == repr(section).replace("nan", "inf")
    whole = Section("independent")
    whole.extend(again)
    whole.extend(Section("independent"))
    assert whole.start == 0.5 and whole.lines == again.lines


def test_a_report_without_points_has_no_figure() -> None:
    nothing: dict[str, Any] = {"points": [], "slopes": []}
    assert precision_figures(PrecisionResult.model_construct(**nothing)) == {}
