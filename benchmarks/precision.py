"""Whether recommended settings keep their promise on scenes that nobody tuned them on.

    python benchmarks/precision.py [--error 0.1] [--seconds 120] [--resolution 128] [--scene
        bowl/kitchen ...]
    python benchmarks/precision.py --intervals      how often intervals of errors cover the
        truth; nothing is rendered

For each scene: the settings that `advsearch precision` recommends for the picture and
for the gradient, then the error that they really have, measured anew with other seeds
against a reference with other seeds. The ratio of that to the promised error should lie
between 1/1.5 and 1.5; the slope of independent sampling within 0.1 of -1/2. A ratio
that the new reference cannot tell is marked. Exit status 3 if one falls short.
"""

from __future__ import annotations

import argparse
import math
import statistics
import sys
import tempfile
from typing import Any

import numpy as np

from advsearch import threads

threads.configure()

from advsearch.engine.gradients import find_interior_point, make_smooth_loss
from advsearch.questions.attack.carry_out import problem_from_config
from advsearch.questions.precision import precision
from advsearch.questions.precision.benches import (
    GradientBench,
    PictureBench,
    TimeBudget,
    list_gradient_parts,
)
from advsearch.questions.precision.result import PrecisionConfig, Recommended
from advsearch.questions.precision.rule import (
    ReferenceValue,
    SampleSetting,
    summarize_samples,
)

SCENES = ("bowl/kitchen", "bottle/noon", "ball/studio")
CONTROL = "environment"
REPEATS = 64
FACTOR = 1.5
SLOPE = 0.1
SEED = 1_000_003
"""Of the new measurement; the recommendation was made with seed 0."""


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--error", type=float, default=0.1, help="promised relative error (default 0.1)"
    )
    parser.add_argument(
        "--seconds",
        type=float,
        default=120.0,
        help="for each scene's recommendation (default 120)",
    )
    parser.add_argument("--resolution", type=int, default=128)
    parser.add_argument("--control", default=CONTROL)
    parser.add_argument(
        "--scene", nargs="+", default=SCENES, metavar="OBJECT/ENVIRONMENT"
    )
    parser.add_argument(
        "--intervals",
        action="store_true",
        help="simulate the intervals of errors alone",
    )
    args = parser.parse_args()
    covered = intervals()
    if args.intervals:
        return covered
    print(
        "  scene           what       setting                    samples   promised  "
        " measured   ratio"
    )
    kept = [one(scene, args) for scene in args.scene]
    return covered if all(kept) else 3


NOISE = (
    "normal",
    "lognormal 1",
    "lognormal 2",
    "fireflies 0.1",
    "fireflies 1",
    "fireflies 10",
    "fireflies 100",
)
PIXELS = 64 * 64
TRIES = 400


def intervals() -> int:
    """Print, for noise of several tails, how often an error has an interval, and how
    often that covers the truth; fails if it covers less than 90 % where tails are
    light.
    """
    print(
        f"  noise of {PIXELS} pixels    repeats   has an interval   that covers   "
        "one for all would cover"
    )
    kept = True
    rng = np.random.default_rng(0)
    for noise in NOISE:
        for repeats in (4, 8):
            covered = []
            all_covered = []
            for _ in range(TRIES):
                samples, true = simulated(noise, repeats, rng)
                setting = SampleSetting("picture", noise, 4, 4.0)
                point = summarize_samples(setting, samples)
                bare = summarize_samples(
                    setting, [{**numbers, "fourth": math.nan} for numbers in samples]
                )
                assert bare.interval is not None
                all_covered.append(bare.interval[0] <= true <= bare.interval[1])
                if not point.heavy_tailed:
                    covered.append(all_covered[-1])
            share = f"{100 * statistics.fmean(covered):.0f} %" if covered else ""
            given = 100 * len(covered) / TRIES
            bare_share = 100 * statistics.fmean(all_covered)
            print(
                f"  {noise:22} {repeats:7} {given:14.0f} % {share:>13} "
                f"{bare_share:>20.0f} %"
            )
            kept = kept and (noise not in NOISE[:2] or statistics.fmean(covered) >= 0.9)
    return 0 if kept else 3


def simulated(
    noise: str, repeats: int, rng: np.random.Generator
) -> tuple[list[dict[str, float]], float]:
    """Return measurements of pictures with a noise, and their true root mean square
    error. Of fireflies there are so many a picture, and they hold as much of the error
    as all else.
    """
    kind, _, given = noise.partition(" ")
    size = (repeats, PIXELS)
    if kind == "lognormal":
        spread = float(given)
        found = rng.lognormal(0.0, spread, size) - math.exp(spread**2 / 2)
        variance = (math.exp(spread**2) - 1.0) * math.exp(spread**2)
    else:
        found = rng.normal(size=size)
        variance = 1.0
    if kind == "fireflies":
        share = float(given) / PIXELS
        found = found + (rng.random(size) < share) * rng.exponential(
            1.0, size
        ) * math.sqrt(0.5 / share)
        variance = 2.0
    reference = ReferenceValue(np.zeros(PIXELS), 0.0, 1.0, 2)
    return [
        {**reference.compare(picture), "seconds": 1.0} for picture in found
    ], math.sqrt(PIXELS * variance)


def one(scene: str, args: argparse.Namespace) -> bool:
    """Measure one scene, print its rows, and say whether every promise was kept."""
    name, _, environment = scene.partition("/")
    with tempfile.TemporaryDirectory() as folder:
        config = PrecisionConfig(
            object=name,
            environment=environment or "studio",
            controls=args.control,
            resolution=args.resolution,
            seconds=args.seconds,
            error=args.error,
            run=f"{folder}/run",
        )
        report = precision.run(config)
    kept = True
    for found in report.recommendations:
        if found.estimator is None or found.quantity == "margin":
            continue
        assert found.error is not None
        error, known = measured(config, found)
        ratio = error / found.error
        good = not known or 1.0 / FACTOR <= ratio <= FACTOR
        kept = kept and good
        said = "" if good else "   FALLS SHORT"
        said += "" if known else "   (the reference cannot tell)"
        print(
            f"  {scene:14s}  {found.quantity:9s}  {found.estimator:25s}  "
            f"{found.spp:7d}   "
            f"{found.error:8.3f}   {error:8.3f}   {ratio:5.2f}{said}",
            flush=True,
        )
    for slope in report.slopes:
        if slope.estimator == "independent" and slope.quantity == "picture":
            good = abs(slope.slope + 0.5) <= SLOPE
            kept = kept and good
            print(
                f"  {scene:14s}  slope of independent sampling "
                f"{slope.slope:.2f}{'' if good else '   FALLS SHORT'}"
            )
    return kept


def measured(config: PrecisionConfig, found: Recommended) -> tuple[float, bool]:
    """The error of a recommended setting with other seeds, and whether the new
    reference can tell it.
    """
    problem, _ = problem_from_config(config)
    renderer = problem.renderer
    budget = TimeBudget(config.seconds / 3.0)
    assert found.estimator is not None and found.spp is not None
    setting = SampleSetting(
        found.quantity, found.estimator, found.spp, 1.0, found.control, found.family
    )
    bench: Any
    if found.quantity == "picture":
        samplers = dict.fromkeys(("multijitter", found.estimator.partition(" ")[0]))
        bench = PictureBench(
            renderer,
            problem.make_full_configuration(problem.domain.start),
            lambda picture: 1.0,
            list(samplers),
        )
    else:
        renderer = renderer.copy_with(denoiser="none", transfer="linear")
        renderer.plan = renderer.plan.with_pixel_steps()
        part = next(
            one
            for one in list_gradient_parts(renderer.plan.groups, linear=True)
            if one.name == found.control
        )
        loss = make_smooth_loss(renderer.formation.resolution, config.seed)
        bench = GradientBench(renderer, loss, find_interior_point(renderer), part)
    bench.compute_references(budget, SEED, lambda: None)
    samples = [
        bench.measure(setting, SEED + number)[found.quantity]
        for number in range(REPEATS)
    ]
    point = summarize_samples(
        setting,
        samples,
        reference_error=bench.get_reference_error(setting, found.quantity),
    )
    return point.rms_error, point.has_known_error


if __name__ == "__main__":
    sys.exit(main())
