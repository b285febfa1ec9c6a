"""How far away a detector first sees a car, from a dashcam that follows it: by day, in
the wet, at dusk, by night.

    python benchmarks/first_seen.py detector.pt2 [--labels coco90] [--label car] [--draws 8]
        [--distances 10,16,22]

A sweep over the distance for each light. What differs between the draws is where in the
lane the camera is, how high and how level it is, how much it sees and where in the
picture the car is. The exposure is absolute. The camera has a lens of F/2, exposes at
most 1/30 s, and has ISO 100 at least; its noise grows with its gain. The table has how
many pictures are right at each distance, and the distance at which half of them are: by
a logistic curve over the logarithm of the distance, and as `advsearch sweep` says it,
which supposes no curve and so has a wider interval. Then what the car looks like at the
distance `--look`: the mean of its 8-bit levels, that of what is around it, and the
spread within the car.

    python benchmarks/first_seen.py --simulated 600

draws so many tables from curves that are known, and counts how often the curve's
interval has the truth, and how often a table of a falling or level curve is said not to
fall. Nothing is rendered.

A cell with `3+4/8` has 3 right pictures of 8, and 4 with a loose box. Where the share
is shown not to fall with the distance, no curve is fitted.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch.nn.functional import max_pool2d

import advsearch
from advsearch.options import Outcome
from advsearch.questions.sweep.display import (
    describe_detection_distance,
    find_detection_distance,
)
from advsearch.questions.sweep.summary import AxisRow
from advsearch.statistics.monotone import find_dips

SECONDS_MOST = 1.0 / 30.0
F_NUMBER = 2.0
READ = 3.0
"""Of the camera: the longest exposure, the lens, and electrons of noise in the dark."""
JITTER: dict[str, Any] = {
    "camera": {
        "azimuth": [-0.8, 0.8],
        "height": [1.2, 1.45],
        "roll": [-1.5, 1.5],
        "fov": [72.0, 78.0],
        "shift_x": [-0.03, 0.03],
        "shift_y": [-0.03, 0.03],
    }
}
"""What differs between draws; azimuth 0 is behind the car. Nothing but the camera
moves, so that no scene is built anew.
"""


class Light(NamedTuple):
    """An environment, its exposure in EV at ISO 100, and the lamps that are lit."""

    environment: str
    ev: float
    lamps: dict[str, str]


LIGHTS = {
    "day": Light("avenue", 14.0, {}),
    "night, low beam of both": Light(
        "avenue-night", 3.0, {"object.lamps": "low", "camera.lamps": "low"}
    ),
    "night, low beam of the car ahead": Light(
        "avenue-night", 3.0, {"object.lamps": "low"}
    ),
    "dusk": Light("avenue-dusk", 4.5, {}),
    "wet": Light("avenue-wet", 11.5, {}),
    "night, no lamps of cars": Light("avenue-night", 3.0, {}),
}


def noise(ev: float, electrons: float) -> dict[str, float]:
    """Return the settings of `sensor`: shot noise in white, and read noise, both
    relative to white.

    What the lens and the longest exposure leave out is gain, which leaves fewer
    electrons for white.
    """
    gain = max(1.0, F_NUMBER**2 / SECONDS_MOST / 2.0**ev)
    return {"shot": (gain / electrons) ** 0.5, "read": READ * gain / electrons}


def levels(light: Light, distance: float, size: int) -> tuple[float, float, float]:
    """Return the mean level of the car's pixels, that of as wide a rim around it, and
    the spread within the car.
    """
    scene = advsearch.load_scene(
        "car", light.environment, camera="dashcam", settings=settings(light, distance)
    )
    render = scene.renderer({"camera": {"roll": [-1.0, 1.0]}}, resolution=size)
    with torch.no_grad():
        grey = render(render.start, 0, 16).mean(-1).reshape(size, size) * 255.0
        car = render.compute_object_mask(render.start).reshape(size, size) > 0.5
    width = max(1, int(car.any(0).sum()) // 4)
    rim = (max_pool2d(car[None].float(), 2 * width + 1, 1, width)[0] > 0.5) & ~car
    return float(grey[car].mean()), float(grey[rim].mean()), float(grey[car].std())


def half_right(
    distances: Sequence[float], right: Sequence[int], of: int
) -> tuple[float, float, float]:
    """Return where a logistic curve falls below a half, and the ends of the 95 %
    interval by its profile likelihood.

    The likelihood may fall by 2.5, not by the 1.92 of many pictures: see `simulated`.
    """
    at = np.linspace(np.log(3.0), np.log(300.0), 461)
    steep = np.geomspace(0.5, 30.0, 60)
    exponent = steep[:, None, None] * (np.log(distances) - at[:, None])
    share = np.clip(
        1.0 / (1.0 + np.exp(np.clip(exponent, -50.0, 50.0))), 1e-3, 1.0 - 1e-3
    )
    known = np.asarray(right)
    likely = (known * np.log(share) + (of - known) * np.log(1.0 - share)).sum(-1).max(0)
    inside = np.exp(at[likely > likely.max() - 2.5])
    return float(np.exp(at[likely.argmax()])), float(inside[0]), float(inside[-1])


def simulated(distances: Sequence[float], draws: int, tables: int) -> None:
    """Print how often the interval has the truth, for curves of several places and
    slopes.
    """
    rng = np.random.default_rng(0)
    for place, slope in (
        (30.0, 5.0),
        (20.0, 5.0),
        (20.0, 3.0),
        (30.0, 10.0),
        (14.0, 4.0),
    ):
        share = 1.0 / (1.0 + (np.asarray(distances) / place) ** slope)
        ends = [
            half_right(distances, rng.binomial(draws, share).tolist(), draws)[1:]
            for _ in range(tables)
        ]
        print(
            f"half at {place:g} m, slope {slope:g}: "
            f"{np.mean([low <= place <= high for low, high in ends]):.1%}"
        )
    falling = 1.0 / (1.0 + (np.asarray(distances) / 20.0) ** 4)
    curves = {
        "falling": falling,
        **{
            f"level at {share}": np.full(len(distances), share)
            for share in (0.1, 0.5, 0.9)
        },
    }
    for name, share in curves.items():
        alarms = 0
        for _ in range(tables):
            dips = find_dips(
                distances, rng.binomial(draws, share), np.full(len(distances), draws)
            )
            alarms += any(dip.is_significant for dip in dips)
        print(f"{name}: said not to fall in {alarms / tables:.1%}")


def count_cell(row: AxisRow) -> str:
    """Return how many pictures are right, and with a plus how many have a loose box:
    ``3+4/8``.
    """
    loose = (row.outcomes or {}).get(Outcome.LOOSE.value, 0)
    return f"{row.correct}{f'+{loose}' if loose else ''}/{row.configurations}"


def settings(light: Light, distance: float | None = None) -> dict[str, Any]:
    far = {} if distance is None else {"camera.distance": distance}
    return {"camera.ev": light.ev, **light.lamps, **far}


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("model", nargs="*", help="files with detectors")
    parser.add_argument(
        "--labels", default="coco90", help="names of its classes (default coco90)"
    )
    parser.add_argument(
        "--label", default="car", help="the names that are right (default car)"
    )
    parser.add_argument("--distances", default="10,16,22,30,42,100", help="metres")
    parser.add_argument(
        "--draws", type=int, default=8, help="at each distance (default 8)"
    )
    parser.add_argument(
        "--size", type=int, default=300, help="side of a picture, pixels (default 300)"
    )
    parser.add_argument(
        "--look",
        type=float,
        default=18.0,
        help="metres at which levels are measured (default 18)",
    )
    parser.add_argument(
        "--electrons",
        type=float,
        default=1e4,
        help="of white at ISO 100; 1e9 has no noise",
    )
    parser.add_argument(
        "--simulated",
        type=int,
        default=0,
        help="tables that are drawn, in place of renders",
    )
    parser.add_argument("--only", default="", help="lights whose names contain this")
    args = parser.parse_args(argv)
    distances = [float(one) for one in args.distances.split(",")]
    if args.simulated:
        simulated(distances, args.draws, args.simulated)
        return 0
    heads = [
        "light",
        "model",
        *(f"{one:g} m" for one in distances),
        "first seen",
        "as sweep says",
        "car, around, spread",
    ]
    print(f"| {' | '.join(heads)} |")
    print("| --- " * len(heads) + "|")
    for name, light in LIGHTS.items():
        if args.only not in name:
            continue
        begin = time.perf_counter()
        for model in args.model:
            scene = advsearch.load_scene(
                "car", light.environment, camera="dashcam", settings=settings(light)
            )
            summary = advsearch.sweep(
                scene,
                advsearch.load_model(model, labels=args.labels, task="detection"),
                {"camera.distance": distances},
                task="detection",
                controls=JITTER | {"sensor": noise(light.ev, args.electrons)},
                label=args.label,
                samples=args.draws,
                resolution=args.size,
                trials=0,
            ).summary
            rows = [row for row in summary.axes if row.axis == "camera.distance"]
            seen = find_detection_distance(summary)
            said = "-" if seen is None else describe_detection_distance(seen)
            look = ", ".join(
                f"{one:.0f}" for one in levels(light, args.look, args.size)
            )
            curve = "does not fall"
            if seen is None or seen.is_monotone:
                half, low, high = half_right(
                    distances, [row.correct for row in rows], args.draws
                )
                curve = f"{half:.0f} m, {low:.0f} to {high:.0f}"
            cells = [name, summary.model, *map(count_cell, rows)]
            print(f"| {' | '.join([*cells, curve, said, look])} |", flush=True)
        print(
            f"{name}: {time.perf_counter() - begin:.0f} s", file=sys.stderr, flush=True
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
