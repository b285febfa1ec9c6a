"""Error against run time: slopes, references and budgets on synthetic noise whose law is known, and one tiny scene."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from advsearch.cli.main import main
from advsearch.cli.output import format_result as precision_text
from advsearch.engine.gradients import make_smooth_loss
from advsearch.engine.loading import load_scene
from advsearch.errors import InputError
from advsearch.progress import NullProgress
from advsearch.questions.attack.carry_out import problem_from_config
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.precision import carry_out as measuring
from advsearch.questions.precision import precision
from advsearch.questions.precision.benches import (
    MAX_REFERENCE_PARTS,
    MIN_CALLS,
    SAMPLE_COUNTS,
    GradientBench,
    TimeBudget,
    list_gradient_parts,
    measure_in_rounds,
    take_reference_parts,
)
from advsearch.questions.precision.carry_out import QuantityMeasurer, recommend_settings
from advsearch.questions.precision.result import (
    SAMPLERS,
    WARM_UP_CALLS,
    PrecisionConfig,
    PrecisionPoint,
    PrecisionResult,
    Recommended,
    draw_figures,
    list_cautions,
    make_headline,
)
from advsearch.questions.precision.rule import (
    MAX_EXTRAPOLATION,
    ReferenceValue,
    SampleSetting,
    confirm_recommendation,
    describe_disagreement,
    estimate_reference,
    fit_line,
    has_leveled_off,
    is_heavy_tailed,
    median_time,
    recommend_count,
    round_up_exactly,
    summarize_samples,
)
from advsearch.runs.listing import is_finished
from advsearch.runs.summary import read_result
from advsearch.scene.formation import round_sample_count
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


def setting(count: int, estimator: str = "independent") -> SampleSetting:
    return SampleSetting("picture", estimator, count, float(count), family="none")


def measured(
    reference: ReferenceValue,
    *,
    bias: float = 0.0,
    power: float = -0.5,
    estimator: str = "independent",
) -> list[PrecisionPoint]:
    """Points of synthetic noise; a sample takes a millisecond."""
    points = []
    for count in COUNTS_TRIED:
        values = [noisy(count, 100 * count + k, bias, power) for k in range(8)]
        samples = [{**reference.compare(value), "seconds": 1e-3 * count} for value in values]
        points.append(summarize_samples(setting(count, estimator), samples, reference_error=reference.error))
    return points


def exact() -> ReferenceValue:
    """A reference whose own error is far below everything measured."""
    return estimate_reference([noisy(10**8, seed) for seed in (1, 2)])


def rough(samples: int) -> ReferenceValue:
    """A reference from four parts that are not much better than what is measured."""
    return estimate_reference([noisy(samples, seed) for seed in range(4)])


# ---- references -----------------------------------------------------------------------------------------------------


def test_the_error_of_a_reference_is_what_its_parts_scatter_by() -> None:
    found = rough(1000)
    true = float(np.linalg.norm(found.value - TRUTH) / np.linalg.norm(TRUTH))
    assert found.parts == 4
    assert found.error == pytest.approx(true, rel=0.15)


def test_two_halves_give_half_their_difference() -> None:
    one, other = np.array([1.0, 2.0]), np.array([1.4, 2.3])
    assert estimate_reference([one, other]).error * estimate_reference([one, other]).norm == pytest.approx(0.25)


def test_a_reference_through_a_bend_knows_of_scatter_and_bias() -> None:
    generator = np.random.default_rng(0)
    parts = [1.0 + 0.1 * generator.standard_normal(1) for _ in range(16)]
    found = estimate_reference(parts, np.exp)
    assert found.error * found.norm == pytest.approx(math.e * 0.1 / 4.0, rel=0.4)
    error = float(np.std(parts, ddof=1)) / 4.0
    assert estimate_reference(parts).error * estimate_reference(parts).norm == pytest.approx(error, rel=1e-9)
    assert estimate_reference(parts, bias=1.0).error > 1.0 / 1.2


def test_one_part_is_no_reference() -> None:
    with pytest.raises(ValueError, match="two independent parts, got 1"):
        estimate_reference([TRUTH])


def test_cosine_and_error_of_a_vector() -> None:
    one = estimate_reference([np.array([3.0, 4.0])] * 2)
    assert one.compare(np.array([3.0, 4.5]))["error"] == pytest.approx(0.1)
    assert one.compare(np.array([4.0, -3.0]))["cosine"] == pytest.approx(0.0)
    assert math.isnan(one.compare(np.zeros(2))["cosine"])
    assert estimate_reference([np.zeros(2)] * 2).compare(np.ones(2))["error"] == math.inf


# ---- points ---------------------------------------------------------------------------------------------------------


def test_the_reference_s_own_error_is_taken_off() -> None:
    reference = rough(256)
    point = next(one for one in measured(reference) if one.spp == 256)
    true = 256**-0.5 * math.sqrt(SIZE) / float(np.linalg.norm(TRUTH))
    assert point.is_known and point.rms == pytest.approx(true, rel=0.06)
    assert point.interval is not None and point.interval[0] < point.rms < point.interval[1]


def test_no_point_below_the_reference_is_called_known() -> None:
    reference = rough(100)  # 400 samples in all
    for point in measured(reference):
        true = point.spp**-0.5 * math.sqrt(SIZE) / float(np.linalg.norm(TRUTH))
        assert point.is_known == (point.spp < 256), point.spp
        if not point.is_known:
            assert point.rms > true and point.interval is None  # a limit is above the truth


def test_seconds_leave_the_warm_up_out() -> None:
    times = [9.0] * WARM_UP_CALLS + [1.0, 3.0, 2.0]
    assert median_time(times) == 2.0
    assert median_time([9.0, 4.0]) == 4.0


def tails(kind: str, seed: int, repeats: int = 8) -> tuple[list[dict[str, float]], float]:
    """Measurements of pictures of 4,096 pixels whose noise is normal, or has rare bright pixels that hold nearly all of
    the error, and the true root mean square."""
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(repeats, 4096))
    if kind == "fireflies":  # three a picture
        noise += (rng.random(noise.shape) < 3.0 / 4096) * rng.exponential(100.0, noise.shape)
    true = math.sqrt(4096 * (1.0 + (3.0 / 4096 * 2.0 * 100.0**2 if kind == "fireflies" else 0.0)))
    reference = ReferenceValue(np.zeros(4096), 0.0, 1.0, 2)
    return [{**reference.compare(one), "seconds": 1.0} for one in noise], true


def test_an_error_that_a_few_pixels_hold_has_no_interval_and_any_other_has_one_that_holds() -> None:
    covered = 0
    for seed in range(100):
        numbers, true = tails("normal", seed)
        point = summarize_samples(setting(4), numbers)
        assert not point.heavy_tailed and point.interval is not None
        covered += point.interval[0] <= true <= point.interval[1]
        numbers, _ = tails("fireflies", seed)
        point = summarize_samples(setting(4), numbers)
        assert point.heavy_tailed and point.interval is None
    assert covered >= 90
    assert not is_heavy_tailed([{"error": 1.0, "fourth": math.nan}]), "few numbers say nothing"


# ---- slopes ---------------------------------------------------------------------------------------------------------


def test_independent_noise_has_slope_minus_a_half() -> None:
    points = measured(exact())
    line = fit_line(points, or_steeper=False)
    assert line is not None and line.slope == pytest.approx(-0.5, abs=TOLERANCE)
    assert line.interval[0] < -0.5 < line.interval[1] or abs(line.slope + 0.5) < 0.02
    assert line.agrees is True and line.points == 5
    assert describe_disagreement(line, points) is None


def test_the_slope_survives_a_reference_that_is_hardly_better() -> None:
    line = fit_line(measured(rough(256)), or_steeper=False)
    assert line is not None and line.points == 4  # 1,024 samples are below the reference
    assert line.slope == pytest.approx(-0.5, abs=TOLERANCE)


def test_a_bias_levels_off_and_is_warned_of() -> None:
    points = measured(exact(), bias=0.1)
    line = fit_line(points, or_steeper=False)
    assert line is not None and line.slope > -0.35 and line.agrees is False
    assert has_leveled_off(points) and not has_leveled_off(measured(exact()))
    assert "levels off" in str(describe_disagreement(line, points))


def test_a_steeper_slope_agrees_only_where_theory_allows_it() -> None:
    points = measured(exact(), power=-0.75)
    strict, free = fit_line(points, or_steeper=False), fit_line(points, or_steeper=True)
    assert strict is not None and free is not None
    assert strict.slope == pytest.approx(-0.75, abs=TOLERANCE)
    assert strict.agrees is False and free.agrees is True


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
    found, spp, _ = reached(recommend_count(measured(exact()), goal))
    assert found.basis in ("interpolated", "fitted")
    assert error_at(spp) == pytest.approx(goal, rel=0.1)
    assert found.seconds == pytest.approx(1e-3 * spp, rel=0.01)


def point_at(spp: int, error: float, interval: tuple[float, float] | None = None, repeats: int = 6) -> PrecisionPoint:
    """A known point, of 1 millisecond a sample."""
    return PrecisionPoint(
        quantity="picture", estimator="independent", family="none", spp=spp, error=error, interval=interval,
        status="ok", seconds=1e-3 * spp, repeats=repeats,
    )  # fmt: skip


def test_a_line_that_explains_all_points_overrules_a_lucky_one() -> None:
    def point(spp: int, error: float) -> PrecisionPoint:
        return point_at(spp, error, (0.5 * error, 2.0 * error))

    true = [point(spp, spp**-0.5) for spp in (4, 16, 64, 256)]
    lucky = [point(8, 0.7 * 8**-0.5), *true]
    found = recommend_count(lucky, 0.1)
    assert found is not None and found.basis == "fitted" and found.spp == pytest.approx(100, rel=0.15)
    assert recommend_count([point_at(one.spp, max(one.rms, 0.2), (0.19, 0.21)) for one in true], 0.1) is None


@pytest.mark.parametrize(
    ("error", "times", "promised"), [(0.08, 1, 0.08), (0.2, 4, 0.1), (10.0, MAX_EXTRAPOLATION, 2.5)]
)
def test_new_measurements_of_a_recommended_setting_are_what_is_promised(
    error: float, times: int, promised: float
) -> None:
    one, spp, _ = reached(recommend_count(measured(exact()), 0.1))
    found = confirm_recommendation(one, point_at(spp, error, repeats=12).model_copy(update={"seconds": 0.5}))
    assert (found.basis, found.repeats, found.spp) == ("confirmed", 12, times * spp)
    assert found.error == pytest.approx(promised) and found.seconds == pytest.approx(0.5 * times)


@pytest.mark.medium
def test_what_is_chosen_among_noisy_points_looks_better_than_it_is_until_it_is_measured_again() -> None:
    """Three lines of the same true error, root mean squares of four: the promise of the cheapest is too good."""
    rng = np.random.default_rng(5)

    def point(estimator: str, spp: int, repeats: int) -> PrecisionPoint:
        squares = rng.normal(0.0, spp**-0.5, repeats) ** 2
        samples = [{"error": math.sqrt(square), "seconds": 1e-3 * spp} for square in squares]
        return summarize_samples(setting(spp, estimator), samples)

    before, after = [], []
    for _ in range(200):
        points = [point(name, spp, 4) for name in "abc" for spp in (4, 16, 64, 256)]
        one, spp, error = reached(recommend_settings(points, [], 0.1, round_up_exactly)[0])
        before.append(math.log(spp**-0.5 / error))
        _, spp, error = reached(confirm_recommendation(one, point(str(one.estimator), spp, 24)))
        after.append(math.log(spp**-0.5 / error))
    assert np.mean(before) > 0.2
    assert abs(np.mean(after)) < 0.05 and np.quantile(np.abs(after), 0.95) < math.log(1.5)


def test_where_points_are_too_few_for_a_line_theory_says_how_it_goes_on() -> None:
    point = measured(exact())[1]  # 16 samples
    assert recommend_count([point], 0.5 * point.rms) is None
    found, spp, _ = reached(recommend_count([point], 0.5 * point.rms, or_steeper=False))
    assert found.basis == "extrapolated" and spp == 64 and found.seconds == pytest.approx(0.064)
    assert recommend_count([point], point.rms / 5.0, or_steeper=False) is None, "too far"


def test_beyond_the_last_point_it_says_so_and_not_too_far() -> None:
    points = measured(exact())
    found, spp, _ = reached(recommend_count(points, 0.5 * points[-1].rms))
    assert found.basis == "extrapolated"
    assert error_at(spp) == pytest.approx(found.goal, rel=0.15)
    assert recommend_count(points, points[-1].rms / MAX_EXTRAPOLATION) is None


def test_what_levels_off_is_never_recommended_below_its_level() -> None:
    biased = measured(exact(), bias=0.1, estimator="biased")
    assert recommend_count(biased, 0.05) is None
    slow = [point.model_copy(update={"seconds": 1.0 + point.seconds}) for point in measured(exact())]
    (cheap,), (good,) = (recommend_settings([*biased, *slow], [], goal, round_up_exactly) for goal in (0.2, 0.05))
    assert (cheap.estimator, good.estimator) == ("biased", "independent")


def test_a_count_is_rounded_to_what_the_sampler_takes() -> None:
    _, spp, error = reached(
        recommend_count(measured(exact()), 0.1, lambda point, samples: round_sample_count("ldsampler", samples))
    )
    assert math.log(spp, 4) == pytest.approx(round(math.log(spp, 4)))
    assert error <= 0.1


def test_the_cheapest_that_is_good_enough_is_taken_as_it_is() -> None:
    found = recommend_count(measured(exact()), 10.0)
    assert found is not None and (found.spp, found.basis) == (4, "measured")


# ---- rounds and budgets ---------------------------------------------------------------------------------------------


def timed(clock: Clock, rate: float = 1e-3, cold: float = 0.0) -> Callable[[SampleSetting, int], tuple[int, float]]:
    """Takes `rate` seconds for each unit of cost, and `cold` more at the first call of a setting."""
    seen: set[SampleSetting] = set()

    def measure(one: SampleSetting, seed: int) -> tuple[int, float]:
        seconds = rate * one.cost + (0.0 if one in seen else cold)
        seen.add(one)
        clock.now += seconds
        return seed, seconds

    return measure


def test_rounds_are_interleaved_cheapest_first_with_a_seed_each() -> None:
    clock, order = Clock(), []
    settings = [setting(count, name) for name in ("a", "b") for count in (16, 4)]
    budget, note = TimeBudget(100.0, clock), lambda one: order.append(one.cost)
    measured = measure_in_rounds(settings, timed(clock), budget, rounds=3, seed=0, on_done=note)
    assert order == [4.0] * 4 + [16.0] * 4 + [4.0, 4.0, 16.0, 16.0] * 2
    given = [seed for taken in measured.results.values() for seed, _ in taken]
    assert len(set(given)) == len(given) == 16 and measured.skipped == []


@pytest.mark.parametrize("seconds", [0.5, 3.0, 20.0])
@pytest.mark.parametrize("cold", [0.0, 0.2])
def test_a_budget_is_kept_and_what_was_left_out_is_said(seconds: float, cold: float) -> None:
    clock = Clock()
    settings = [setting(count, name) for name in ("a", "b", "c") for count in COUNTS_TRIED]
    measured = measure_in_rounds(settings, timed(clock, cold=cold), TimeBudget(seconds, clock), rounds=50, seed=0)
    assert clock.now <= seconds + 3 * cold
    assert {*measured.skipped} | {*measured.results} == {*settings}
    if measured.skipped and cold == 0.0:
        assert max(one.cost for one in measured.results) <= min(one.cost for one in measured.skipped)
        assert min(len(taken) for taken in measured.results.values()) >= MIN_CALLS


def test_what_compiles_first_is_never_taken_for_the_time_of_a_setting() -> None:
    """On a busy machine the first call may use up all of the time; there is another one all the same."""
    clock = Clock()
    measured = measure_in_rounds(
        [setting(4), setting(16)], timed(clock, cold=40.0), TimeBudget(10.0, clock), rounds=8, seed=0
    )
    (taken,) = measured.results.values()
    assert median_time([seconds for _, seconds in taken]) == pytest.approx(0.004) and measured.skipped == [setting(16)]


def test_a_machine_that_is_busy_and_pixels_that_hold_the_error_are_said() -> None:
    def point(wall: float, heavy: bool = False) -> PrecisionPoint:
        return point_at(1000, 0.1).model_copy(update={"wall_seconds": wall, "heavy_tailed": heavy})

    assert list_cautions([point(0.6), point(1.0), point(9.0)]) == [] == list_cautions([])
    assert "busy" in list_cautions([point(0.6), point(2.5), point(9.0)])[0]
    assert "independent: a few pixels hold" in list_cautions([point(0.6, heavy=True)])[0]


def test_a_part_of_a_budget_is_a_budget() -> None:
    clock = Clock()
    whole = TimeBudget(10.0, clock)
    clock.now = 2.0
    part = whole.take_fraction(0.25)
    assert (whole.seconds_left, part.seconds_left) == (8.0, 2.0)
    clock.now = 50.0
    assert (whole.seconds_left, part.seconds_left) == (0.0, 0.0)


def test_a_reference_has_two_parts_whatever_they_take_and_stops_in_time() -> None:
    clock = Clock()

    def part(seed: int) -> np.ndarray:
        clock.now += 1.0
        return np.array([float(seed)])

    for seconds, count in ((0.1, 2), (0.0, 2), (5.5, 5), (1e9, MAX_REFERENCE_PARTS)):
        parts = take_reference_parts(part, TimeBudget(seconds, clock), lambda: None, seed=0)
        assert len(parts) == count == len({float(one[0]) for one in parts})


# ---- what is compared -----------------------------------------------------------------------------------------------


def test_every_count_that_is_measured_is_one_that_its_sampler_takes() -> None:
    from advsearch.scene.mitsuba_backend.variant import import_mitsuba

    mi = import_mitsuba()
    for name in SAMPLERS:
        sampler = mi.load_dict({"type": name})
        for count in SAMPLE_COUNTS.get(name, (4, 16, 64, 256)):
            sampler.set_sample_count(count)
            assert sampler.sample_count() == count, name
        for wanted in (1, 5, 24, 65, 130):
            count = round_sample_count(name, wanted)
            sampler.set_sample_count(count)
            assert count >= wanted and sampler.sample_count() == count, name


@pytest.mark.medium
def test_theory_and_counts_are_those_of_the_sampler() -> None:
    """A line of the picture is named after its sampler; a gradient is taken with that of the run."""

    def said(pixel_sampler: str, quantity: str, estimator: str, family: str, loss: str = "linear") -> tuple[Any, int]:
        config = PrecisionConfig(object="mug", pixel_sampler=pixel_sampler, loss=loss, controls="environment.exposure")
        job = QuantityMeasurer(config, problem_from_config(config)[0], NullProgress())
        point = point_at(4, 0.1).model_copy(
            update={"quantity": quantity, "estimator": estimator, "family": family, "control": "environment"}
        )
        return job.may_be_steeper(point), job.round_up(point, 39)

    assert said("multijitter", "picture", "independent", "none") == (False, 39)
    assert said("independent", "margin", "ldsampler", "none") == (True, 64)
    assert said("independent", "picture", "multijitter + oidn", "oidn") == (None, 42)
    assert said("multijitter", "gradient", "adjoint", "") == (True, 42)
    assert said("independent", "gradient", "adjoint", "") == (False, 39)
    assert said("independent", "gradient", "differences", "")[0] is None
    assert said("independent", "gradient", "adjoint", "", "model")[0] is None


def group(parameter: str, *valid: str) -> Group:
    return Group(parameter, 1, valid, control="light")


def test_parts_of_a_control_with_other_estimators_have_names_of_their_own() -> None:
    parts = list_gradient_parts(
        [group("x", "differences"), group("power", "adjoint", "differences"), group("kind")], linear=True
    )
    assert [part.name for part in parts] == ["light.x", "light.power"]
    assert [part.estimators for part in parts] == [("differences",), ("adjoint", "differences")]
    secant = [group("x", "secant", "differences")]
    assert list_gradient_parts(secant, linear=True)[0].estimators == ("differences",)
    assert "secant" in list_gradient_parts(secant, linear=False)[0].estimators


@pytest.mark.medium
def test_an_adjoint_is_compared_with_a_reference_by_an_adjoint_that_differences_confirm() -> None:
    renderer = load_scene("mug").renderer({"texture": {"resolution": 8}}, resolution=24, denoise="none")
    renderer = renderer.copy_with(transfer="linear")
    renderer.plan = renderer.plan.with_pixel_steps()
    (part,) = list_gradient_parts(renderer.plan.groups, linear=True)
    bench = GradientBench(renderer, make_smooth_loss((24, 24)), renderer.start, part)
    (row,) = bench.compute_references(TimeBudget(1.0), 0, lambda: None)
    assert (row.reference, row.control, row.quantity) == ("adjoint", "texture", "gradient") and row.error < 0.5
    numbers = bench.measure(next(one for one in bench.settings if one.spp == 256), 1)["gradient"]
    assert numbers["cosine"] > 0.9 and numbers["error"] < 0.5 and numbers["wall_seconds"] > 0.0
    assert bench.check_bias(0) is None


# ---- the command ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"samplers": "halton"}, "samplers: expected independent, stratified"),
        ({"quantities": "image,time"}, "quantities: expected image, gradient"),
        ({"seconds": 0.0}, "seconds: expected a number greater than 0"),
        ({"rounds": 2}, "rounds: expected a whole number from 3"),
    ],
)
def test_bad_settings_are_refused(given: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        PrecisionConfig(object="mug", **given)


def test_settings_go_through_yaml(tmp_path: Path) -> None:
    config = PrecisionConfig(object="mug", controls="pose", samplers=["independent", "stratified"])
    path = tmp_path / "run.yaml"
    path.write_text(config.to_yaml(), encoding="utf-8")
    assert PrecisionConfig.from_yaml(path) == config
    shared = AttackConfig.from_config(config, norm="l2")
    assert (shared.object, shared.controls, shared.objective, shared.norm) == ("mug", {"pose": {}}, None, "l2")
    assert (shared.steps, shared.seconds) == (None, None), "what only has the same name is not shared"


@pytest.mark.medium
def test_a_tiny_scene_from_end_to_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    words = "--object mug --control environment --resolution 32 --seconds 6 --samplers independent"
    words += " --threads 1 --json --quiet"
    before = time.process_time()
    assert main(["precision", *words.split()]) == 0
    assert time.process_time() - before < 40.0  # of one thread: what others do on the machine takes none of it
    report = json.loads(capsys.readouterr().out)
    assert (report["schema"], report["command"]) == (1, "precision")
    assert {one["quantity"] for one in report["points"]} == {"picture", "margin", "gradient"}
    for one in report["points"]:
        assert {"estimator", "spp", "error", "seconds"} <= set(one) and one["seconds"] > 0.0
    assert {"picture", "margin", "gradient"} == {one["quantity"] for one in report["references"]}
    assert report["machine"]["cpu"] and report["machine"]["threads"]["render"] >= 1
    assert report["seconds"]["total"] > 0.0
    slopes = {(one["quantity"], one["estimator"]): one for one in report["slopes"]}
    for one in report["recommendations"]:
        assert one.get("basis") != "confirmed" or one["repeats"] >= 4
    independent = slopes.get(("picture", "independent"))
    if independent is not None:  # a slow machine measures too few points
        assert independent["slope"] == pytest.approx(-0.5, abs=0.15)
    result = PrecisionResult.of(report)
    assert precision_text(result).count("images/precision.") == 2 and precision_text(result).startswith(
        make_headline(result)
    )
    for one in report["points"]:
        assert one["wall_seconds"] > 0.0
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


@pytest.mark.medium
def test_a_part_that_is_measured_is_kept_and_not_measured_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "run"
    config = PrecisionConfig(
        object="mug",
        controls={"environment.rotation": {}},
        samplers="independent",
        resolution=(8, 8),
        seconds=1.0,
        rounds=3,
        threads=1,
        run=str(folder),
    )
    stopped = precision.run(config, progress=Stop("gradient of environment: references"))
    assert stopped.ending == "interrupted" and {one.quantity for one in stopped.points} == {"picture", "margin"}
    kept = read_result(folder)
    assert kept.to_dict() == stopped.to_dict() and not is_finished(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(measuring, "PictureBench", lambda *_: pytest.fail("measured again"))
        assert main(["resume", str(folder), "--json", "--quiet"]) == 0
    report = PrecisionResult.of(json.loads(capsys.readouterr().out))
    assert report.ending == "done" and is_finished(folder) and len(report.figures) == 2
    pictures = [one.to_dict() for one in report.points if one.quantity != "gradient"]
    assert pictures == [one.to_dict() for one in stopped.points]
    assert {one.quantity for one in report.points} == {"picture", "margin", "gradient"}


def test_a_report_without_points_has_no_figure() -> None:
    nothing: dict[str, Any] = {"points": [], "slopes": []}
    assert draw_figures(PrecisionResult.model_construct(**nothing)) == {}
