"""Error against run time: slopes, references and budgets on synthetic noise whose law is known, and one tiny scene."""

import json
import math
import time
from pathlib import Path

import numpy as np
import pytest

from advsearch.cli.main import main
from advsearch.engine.gradients import make_smooth_loss
from advsearch.engine.loading import load_scene
from advsearch.progress import NullProgress
from advsearch.questions.precision import carry_out as measuring
from advsearch.questions.precision import precision
from advsearch.questions.precision.benches import GradientBench, TimeBudget, list_gradient_parts
from advsearch.questions.precision.result import PrecisionConfig, PrecisionPoint, PrecisionResult, Recommended
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
    recommend_spp,
    summarize_samples,
)
from advsearch.runs.listing import is_finished
from advsearch.runs.summary import read_result

pytestmark = pytest.mark.island("advsearch.questions.precision")

SIZE = 400
"""Numbers in a synthetic picture."""
TRUTH = 1.0 + 0.5 * np.sin(np.arange(SIZE))
COUNTS_TRIED = (4, 16, 64, 256, 1024)
TOLERANCE = 0.05
"""Of a slope fitted to synthetic noise: eight repeats of 400 numbers scatter by half of that."""


def noisy(count: int, seed: int, bias: float = 0.0, power: float = -0.5) -> np.ndarray:
    """A picture with noise of standard deviation count^power, and a bias that no samples remove."""
    generator = np.random.default_rng(seed)
    found: np.ndarray = TRUTH * (1.0 + bias) + count**power * generator.standard_normal(SIZE)
    return found


def setting(count: int, estimator: str = "independent") -> SampleSetting:
    return SampleSetting("picture", estimator, count, float(count), family="none")


def measured(
    reference: ReferenceValue, *, bias: float = 0.0, power: float = -0.5, estimator: str = "independent"
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


def test_the_reference_s_own_error_is_taken_off() -> None:
    reference = rough(256)
    point = next(one for one in measured(reference) if one.spp == 256)
    true = 256**-0.5 * math.sqrt(SIZE) / float(np.linalg.norm(TRUTH))
    assert point.has_known_error and point.rms_error == pytest.approx(true, rel=0.06)
    assert point.interval is not None and point.interval[0] < point.rms_error < point.interval[1]


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


def test_independent_noise_has_slope_minus_a_half() -> None:
    points = measured(exact())
    line = fit_line(points, or_steeper=False)
    assert line is not None and line.slope == pytest.approx(-0.5, abs=TOLERANCE)
    assert line.interval[0] < -0.5 < line.interval[1] or abs(line.slope + 0.5) < 0.02
    assert line.agrees is True and line.points == 5
    assert describe_disagreement(line, points) is None


def test_a_bias_levels_off_and_is_warned_of() -> None:
    points = measured(exact(), bias=0.1)
    line = fit_line(points, or_steeper=False)
    assert line is not None and line.slope > -0.35 and line.agrees is False
    assert has_leveled_off(points) and not has_leveled_off(measured(exact()))
    assert "levels off" in str(describe_disagreement(line, points))


def error_at(samples: float) -> float:
    found: float = samples**-0.5 * math.sqrt(SIZE) / float(np.linalg.norm(TRUTH))
    return found


def reached(found: Recommended | None) -> tuple[Recommended, int, float]:
    """A recommendation with its sample count and its error, which are there."""
    assert found is not None and found.spp is not None and found.error is not None
    return found, found.spp, found.error


@pytest.mark.parametrize("goal", [0.3, 0.1, 0.05])
def test_a_recommended_count_reaches_its_goal(goal: float) -> None:
    found, spp, _ = reached(recommend_spp(measured(exact()), goal))
    assert found.basis in ("interpolated", "fitted")
    assert error_at(spp) == pytest.approx(goal, rel=0.1)
    assert found.seconds == pytest.approx(1e-3 * spp, rel=0.01)


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
    assert (report["schema"], report["command"]) == (2, "precision")
    assert {one["quantity"] for one in report["points"]} == {"picture", "margin", "gradient"}
    for one in report["points"]:
        assert {"estimator", "spp", "error", "seconds"} <= set(one) and one["seconds"] > 0.0
    assert {"picture", "margin", "gradient"} == {one["quantity"] for one in report["references"]}
    slopes = {(one["quantity"], one["estimator"]): one for one in report["slopes"]}
    for one in report["recommendations"]:
        assert one.get("basis") != "confirmed" or one["repeats"] >= 4
    independent = slopes.get(("picture", "independent"))
    if independent is not None:  # a slow machine measures too few points
        assert independent["slope"] == pytest.approx(-0.5, abs=0.15)
    for one in report["points"]:
        assert one["wall_seconds"] > 0.0
    run = Path(report["run"])
    assert run.parent == Path("runs") and (run / "run.yaml").is_file() and (run / "summary.json").is_file()


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
    report = PrecisionResult.from_values(json.loads(capsys.readouterr().out))
    assert report.ending == "done" and is_finished(folder) and len(report.figures) == 2
    pictures = [one.to_dict() for one in report.points if one.quantity != "gradient"]
    assert pictures == [one.to_dict() for one in stopped.points]
    assert {one.quantity for one in report.points} == {"picture", "margin", "gradient"}


def point_at(spp: int, error: float, interval: tuple[float, float] | None = None, repeats: int = 6) -> PrecisionPoint:
    """A known point, of 1 millisecond a sample."""
    return PrecisionPoint(
        quantity="picture", estimator="independent", family="none", spp=spp, error=error, interval=interval,
        status="ok", seconds=1e-3 * spp, repeats=repeats,
    )  # fmt: skip


def test_the_error_of_a_reference_is_what_its_parts_scatter_by() -> None:
    found = rough(1000)
    true = float(np.linalg.norm(found.value - TRUTH) / np.linalg.norm(TRUTH))
    assert found.n_parts == 4
    assert found.error == pytest.approx(true, rel=0.15)


@pytest.mark.parametrize(
    ("error", "times", "promised"), [(0.08, 1, 0.08), (0.2, 4, 0.1), (10.0, MAX_EXTRAPOLATION, 2.5)]
)
def test_new_measurements_of_a_recommended_setting_are_what_is_promised(
    error: float, times: int, promised: float
) -> None:
    one, spp, _ = reached(recommend_spp(measured(exact()), 0.1))
    found = confirm_recommendation(one, point_at(spp, error, repeats=12).model_copy(update={"seconds": 0.5}))
    assert (found.basis, found.repeats, found.spp) == ("confirmed", 12, times * spp)
    assert found.error == pytest.approx(promised) and found.seconds == pytest.approx(0.5 * times)
