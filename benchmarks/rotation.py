"""Measures the error of the derivative of an environment's rotation: its sign, its bias, and the noise of one gradient.

    python benchmarks/rotation.py [--environments studio kitchen noon FILE] [--size 96] [--seconds 600]

Mitsuba's own derivative of an environment's turn has the wrong sign (docs/gradients.md). The plan takes central
differences of 1.8 degrees, or the adjoint of texels that are resampled along the azimuth. Here the loss is linear and
smooth, the object is the mug. Both are held against differences at the step and at half of it, with the same seeds,
extrapolated to a step of zero. Seeds are added until the standard error of the bias of what the plan takes is under
1 %, or the time is over. The exit status is 3 if that bias is over 2 % (`ASKED`), or cannot be told.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Sequence
from dataclasses import replace

from advsearch import threads

threads.configure()


from advsearch.engine.gradients import Bench, inside, only, smooth_loss  # noqa: E402
from advsearch.engine.loading import load_scene  # noqa: E402
from advsearch.engine.planning import measured_plan  # noqa: E402

ASKED, SURE = 0.02, 0.01
"""Largest bias, and the standard error at which it counts as known."""
SPP, LEAST = 64, 32
"""Samples a pixel of what is averaged; seeds before the first look."""
STEPS = (1.0, 0.5)


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print one row for each environment and estimator; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--environments", nargs="+", default=["studio", "kitchen", "noon"])
    parser.add_argument("--size", type=int, default=96, help="side of the picture (default 96)")
    parser.add_argument("--seconds", type=float, default=600.0, help="most time for each (default 600)")
    args = parser.parse_args(argv)
    good = [measured(one, args.size, args.seconds) for one in args.environments]
    return 0 if all(good) else 3


def measured(environment: str, size: int, seconds: float) -> bool:
    """Measure one environment; whether the plan's estimator is right."""
    controls = {"environment": {"rotation": [0, 360]}}
    renderer = load_scene("mug", environment).renderer(controls, resolution=size, denoise="none")
    renderer.formation = replace(renderer.formation, transfer="linear")
    bench = Bench(renderer, smooth_loss((size, size)), inside(renderer), seed=1, spp=SPP)

    def one(estimator: str, factor: float, seed: int) -> float:
        plan = only(renderer.plan.with_steps(factor), ["environment.rotation"], estimator)
        return float(bench.gradient(plan, seed)[0])

    renderer.plan = measured_plan(bench, repeats=6)
    taken = renderer.plan.groups[0].estimator
    rows: list[tuple[float, ...]] = []
    begun = time.perf_counter()
    while True:
        at = [one("differences", step, len(rows)) for step in STEPS]
        rows.append((*at, one("adjoint", 1.0, len(rows)), (4.0 * at[1] - at[0]) / 3.0))
        if len(rows) < LEAST:
            continue
        truth = statistics.fmean(row[-1] for row in rows)
        biases = {
            "differences": [(row[0] - row[-1]) / truth for row in rows],
            "adjoint": [(row[2] - row[-1]) / truth for row in rows],
        }
        errors = {name: statistics.stdev(values) / len(rows) ** 0.5 for name, values in biases.items()}
        if errors[taken] < SURE or time.perf_counter() - begun > seconds:
            break
    for name, values in biases.items():
        bias = statistics.fmean(values)
        noise = statistics.stdev(row[0 if name == "differences" else 2] for row in rows) / abs(truth)
        print(
            f"{environment:10.30s} {name:12s} derivative {truth * (1.0 + bias):9.5f}  bias {100 * bias:5.1f} "
            f"+- {100 * errors[name]:.1f} %  noise of one with {SPP} samples {100 * noise:4.0f} %  "
            f"{len(rows)} seeds{'  (the plan takes it)' if name == taken else ''}",
            flush=True,
        )
    return abs(statistics.fmean(biases[taken])) <= ASKED and errors[taken] <= SURE


if __name__ == "__main__":
    sys.exit(main())
