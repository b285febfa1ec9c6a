"""What leaving things out brings, at equal gradient error, over pairs of scene and
control; and that verdicts agree.

    python benchmarks/leaving_out.py [--size 128] [--spp 8] [--repeats 5] [--configurations
        200] [--json FILE]

The gain of a pair is (squared error x time) of a gradient with nothing left out over
that with everything left out, so that a smaller error counts as less time. Errors are
those of the linear loss of `advsearch check`, against the mean of gradients of both at
eight times the samples. Searches of 200 renders and more cut light paths too: the gain
with the cut is in the last column but one. Verdicts are those of the reference model on
random configurations of the first pair, each rendered at one seed with and without;
beside them, how often another seed changes the verdict.

The last row is a search over cameras, whose steps render nothing where light on
surfaces predicts them: milliseconds of a predicted picture, the gain over a rendered
one (squared error x time), and how far both are off, in levels of 255. With
`--predicted` it is all that is measured. Behind it stands a gradient of a texture in
the avenue of which only the part of the picture that can change is traced, alone with
`--window`; and a picture of another texture there of which only the light paths that
meet it are traced, alone with `--shared`.

First every number of every setting is fixed at both ends of its range, alone, and those
of one material in all combinations of ends: the picture with everything left out
against `--no-specialise`, and against a control that has the same values, each of the
same seed. With `--ends` that is all that is done.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import statistics
import sys
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from advsearch import seeds
from advsearch.controls import CONTROLS, make_space
from advsearch.controls.base import Parameter
from advsearch.engine.acceptance import CHECK_SPP, compute_level_errors
from advsearch.engine.gradients import find_interior_point, make_smooth_loss
from advsearch.engine.gradients.planning import measure_problem_bounces
from advsearch.engine.loading import (
    fit_camera,
    load_scene,
    make_controls,
    make_renderer,
)
from advsearch.engine.problem import Problem
from advsearch.engine.windows import MIN_STEPS, find_window
from advsearch.errors import InputError
from advsearch.predictors.surface_light.renderer import SurfaceRenderer
from advsearch.questions.attack.carry_out import problem_from_config
from advsearch.questions.attack.settings import AttackConfig
from advsearch.scene.formation import ALL_OMISSIONS, NO_OMISSIONS
from advsearch.scene.predictor import Refusal
from advsearch.scene.renderer import Renderer
from advsearch.scene.settings import FAMILIES, MATERIAL, SETTINGS

PAIRS = (
    ("mug", "studio", "texture"),
    ("bowl", "kitchen", "material"),
    ("bottle", "noon", "environment"),
    ("mug", "studio", "light"),
    ("mug", "studio", "projector"),
    ("mug", "low-sun", "shadow"),
    ("bowl", "noon", "camera"),
    ("bottle", "kitchen", "pose"),
)
SAME = 0.3
"""Levels of 255 by which pictures of one seed may differ: a metal of 0.999 for one of
1, and rounding.
"""
REFERENCES = 4
"""Gradients of each kind behind a reference."""


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print a table; 1 if a pair is slower, or the mean gain below 2."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--spp", type=int, default=8)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--configurations", type=int, default=200)
    parser.add_argument("--json", type=Path)
    parser.add_argument(
        "--predicted", action="store_true", help="the row of light on surfaces alone"
    )
    parser.add_argument(
        "--window", action="store_true", help="the row of the window alone"
    )
    parser.add_argument(
        "--shared", action="store_true", help="the row of common light paths alone"
    )
    parser.add_argument(
        "--ends",
        action="store_true",
        help="the pictures with numbers at the ends of their range alone",
    )
    args = parser.parse_args(argv)
    if args.ends:
        return battery()
    if args.predicted:
        print(predicted(args.size, args.spp, args.repeats))
        return 0
    if args.window:
        print(cropped(args.size, args.spp, args.repeats))
        return 0
    if args.shared:
        print(measure_shared_paths(args.size, args.spp, args.repeats))
        return 0
    rows = []
    print(
        "| scene and control | milliseconds | gain | error, of its size | with cut "
        "paths | segments |"
    )
    print("| --- | --- | --- | --- | --- | --- |")
    for pair in PAIRS:
        row = measured(pair, args.size, args.spp, args.repeats)
        rows.append(row)
        print(
            f"| {', '.join(pair)} | {1e3 * row['seconds']:.0f} | {row['gain']:.2f} | "
            f"{row['error']:.3f} "
            f"| {row['gain_cut']:.2f} | {row['depth']} |",
            flush=True,
        )
    mean = math.exp(statistics.fmean(math.log(row["gain"]) for row in rows))
    with_cut = math.exp(statistics.fmean(math.log(row["gain_cut"]) for row in rows))
    print(
        f"geometric mean {mean:.2f}, with cut paths {with_cut:.2f}; smallest "
        f"{min(row['gain'] for row in rows):.2f}"
    )
    print(predicted(args.size, args.spp, args.repeats))
    print(cropped(args.size, args.spp, args.repeats))
    print(measure_shared_paths(args.size, args.spp, args.repeats))
    verdicts = agreement(PAIRS[0], args.size, args.spp, args.configurations)
    print(
        f"verdicts of {verdicts['configurations']} configurations: {verdicts['agree']} "
        "agree at one seed, "
        f"{verdicts['other_seed']} agree between two seeds"
    )
    if args.json:
        args.json.write_text(
            json.dumps(
                {"rows": rows, "mean": mean, "mean_cut": with_cut, "verdicts": verdicts}
            )
        )
    wrong = battery()
    return int(wrong or mean < 2.0 or min(row["gain"] for row in rows) < 1.0)


def battery() -> int:
    """Compare pictures with numbers at the ends of their range; 1 if some are not the
    same.
    """
    cases: list[tuple[dict[str, Any], dict[str, Any]]] = []
    for family, some in FAMILIES.items():
        cases += [
            ({f"{family}.{one.name}": end}, {}) for one in some for end in ends(one)
        ]
    names = [f"material.{one.name}" for one in MATERIAL]
    cases += [
        (dict(zip(names, each, strict=True)), {})
        for each in itertools.product((0.0, 1.0), repeat=len(names))
    ]
    for kind in sorted(CONTROLS.built_ins):
        parameters = [
            one
            for one in CONTROLS[kind].parameters
            if f"{kind}.{one.name}" not in SETTINGS
        ]
        cases += [
            ({}, {kind: {one.name: end}})
            for one in parameters
            if not one.shape
            for end in ends(one)
        ]
    worst = 0.0
    asked = 0
    for fixed, controls in cases:
        try:
            found = ends_apart("ball", fixed, controls)
        except InputError as error:
            print(f"  {fixed or controls}: refused: {str(error).splitlines()[0][:90]}")
            continue
        asked = asked + 1
        worst = max(worst, found)
        if not found <= SAME:
            print(f"  {fixed or controls}: {found:.3f} levels apart", flush=True)
    print(
        f"{asked} of {len(cases)} cases of numbers at the ends of their range: at "
        f"most {worst:.4f} levels apart"
    )
    return int(not worst <= SAME)


def ends(one: Parameter) -> list[float | str]:
    """The ends of a setting's range, inside what can be rendered; every option of a
    choice.
    """
    if one.options:
        return list(one.options)
    return list(one.search or (one.low, one.high))


def ends_apart(
    thing: str, fixed: Mapping[str, Any], controls: Mapping[str, Any], size: int = 24
) -> float:
    """By how much the pictures of fixed numbers differ, in levels of 255: with
    everything left out and with nothing; where all are of a material, also where a
    control has the values.
    """
    ways = (ALL_OMISSIONS, NO_OMISSIONS)
    environment = "studio"
    still = {**controls, "lens": controls.get("lens", {})}
    found = [picture(thing, environment, fixed, still, leave, size) for leave in ways]
    if fixed and all(name.startswith("material.") for name in fixed):
        moved = {"material": {name.partition(".")[2]: [0.0, 1.0] for name in fixed}}
        found += [
            picture(thing, environment, fixed, moved, leave, size) for leave in ways
        ]
        # where the search starts, and goes away
        other = {name: 1.0 - float(value) for name, value in fixed.items()}
        found += [
            picture(thing, environment, other, moved, leave, size, fixed)
            for leave in ways
        ]
    return max(255.0 * float((one - found[0]).square().mean().sqrt()) for one in found)


def picture(
    thing: str,
    environment: str,
    settings: Mapping[str, Any],
    controls: Mapping[str, Any],
    leave_out: Collection[str],
    size: int,
    at: Mapping[str, Any] | None = None,
) -> torch.Tensor:
    """The picture (H, W, 3) of a scene with settings, as it is, or with a control `at`
    other values.
    """
    scene = fit_camera(
        load_scene(thing, environment, settings=dict(settings)).description, size
    )
    space = make_space(make_controls(dict(controls)), scene)
    renderer = make_renderer(scene, space, size, "none", 0, None, leave_out=leave_out)
    u = (
        renderer.start
        if at is None
        else torch.tensor([float(at[group.name]) for group in space.groups])
    )
    with torch.no_grad():
        return renderer(u, 3, 64)


def measured(
    pair: tuple[str, str, str], size: int, spp: int, repeats: int
) -> dict[str, Any]:
    """One pair: times, errors, gains."""
    problem = problem_of(pair, size, pair[2])
    lean = problem.renderer
    u = find_interior_point(problem.renderer)
    loss = make_smooth_loss((size, size))
    full = lean.copy_with(lean.scene.copy_with(leave_out=NO_OMISSIONS))
    depth = measure_problem_bounces(problem, 0).depth
    ways = [lean, full, lean.copy_with(lean.scene.copy_with(max_depth=depth))]
    truth = torch.stack(
        [
            one.gradient(loss, u, seeds.derive_seed(1, "truth", n), 8 * spp)[1]
            for n in range(REFERENCES)
            for one in (lean, full)
        ]
    ).mean(dim=0)
    times, errors = _time_gradients(ways, loss, u, truth, spp, repeats)
    return {
        "pair": list(pair),
        "seconds": times[0],
        "gain": times[1] * errors[1] / (times[0] * errors[0]),
        "gain_cut": times[1] * errors[1] / (times[2] * errors[2]),
        "time_ratio": times[1] / times[0],
        "error": math.sqrt(errors[0]) / float(truth.norm()),
        "errors": errors,
        "depth": depth,
    }


def _time_gradients(
    ways: Sequence[Renderer],
    loss: Callable[[torch.Tensor], torch.Tensor],
    u: torch.Tensor,
    truth: torch.Tensor,
    spp: int,
    repeats: int,
) -> tuple[list[float], list[float]]:
    """The median processor seconds of a gradient by each, and its squared error."""
    for way in ways:
        way.gradient(loss, u, 0, spp)
    found: list[list[tuple[float, float]]] = [[] for _ in ways]
    for number in range(repeats):
        for way, results in zip(ways, found, strict=True):
            begun = time.process_time()
            estimate = way.gradient(
                loss, u, seeds.derive_seed(2, "working", number), spp
            )[1]
            seconds = time.process_time() - begun
            results.append((seconds, float((estimate - truth).square().sum())))
    times = [statistics.median(one[0] for one in results) for results in found]
    errors = [statistics.fmean(one[1] for one in results) for results in found]
    return times, errors


def make_avenue_problem(size: int) -> Problem:
    """Return the problem of a car's texture in the avenue, from 15 metres."""
    config = AttackConfig(
        object="car",
        environment="avenue",
        controls={"texture": {}},
        resolution=(size, size),
        set_={"camera.azimuth": 0.0, "camera.elevation": 5.0, "camera.distance": 15.0},
        label="mug",
        minimise=True,
    )
    return problem_from_config(config)[0]


def measure_shared_paths(size: int, spp: int, repeats: int) -> str:
    """Measure a picture that shares light paths with another of its seed; as a row.

    The gain is in processor time alone, as the noise is the same; without the denoiser.
    The last number is the largest difference from a picture that is traced in full, in
    levels of 255.
    """
    problem = make_avenue_problem(size)
    renderer = problem.renderer.copy_with(denoiser="none")
    u = find_interior_point(renderer)
    seconds: dict[bool, list[float]] = {True: [], False: []}
    largest = 0.0
    with torch.no_grad():
        for seed in range(repeats + 1):
            pictures = []
            for is_shared, times in seconds.items():
                with renderer.share_paths(problem.shared_paths if is_shared else None):
                    renderer(renderer.start, seed, spp)
                    begin = time.process_time()
                    pictures.append(renderer(u, seed, spp))
                    times.append(time.process_time() - begin)
            difference = (pictures[0] - pictures[1]).abs().max()
            largest = max(largest, 255.0 * float(difference))
    # the first ones compile kernels
    shared, full = (statistics.median(times[1:]) for times in seconds.values())
    return (
        f"| car, avenue, texture: common light paths | {1e3 * shared:.0f} | "
        f"{full / shared:.1f} | {largest:.2f} levels | | |"
    )


def cropped(size: int, spp: int, repeats: int) -> str:
    """What a gradient takes where only the part of the picture that can change is
    traced, and how far it is off; as a row.
    """
    problem = make_avenue_problem(size)
    problem.steps = MIN_STEPS
    found = find_window(problem)
    if isinstance(found, Refusal):
        return f"| car, avenue, texture: its window | refused: {found} |"
    whole = problem.renderer
    u = find_interior_point(whole)
    loss = make_smooth_loss((size, size))
    truth = torch.stack(
        [
            whole.gradient(loss, u, seeds.derive_seed(1, "truth", n), 4 * spp)[1]
            for n in range(REFERENCES)
        ]
    ).mean(dim=0)
    crop = whole.crop_to(found.window, u, 0, spp)
    times, errors = _time_gradients((crop, whole), loss, u, truth, spp, repeats)
    gain = times[1] * errors[1] / (times[0] * errors[0])
    return (
        f"| car, avenue, texture: its window | {1e3 * times[0]:.0f} | {gain:.1f} | "
        f"{math.sqrt(errors[0]) / float(truth.norm()):.3f} | | |"
    )


def predicted(size: int, spp: int, repeats: int) -> str:
    """What a picture takes, and how far it is off, where light on surfaces leaves the
    tracing out; as a row.
    """
    renderer = problem_of(PAIRS[0], size, "camera").renderer
    light = SurfaceRenderer(renderer, renderer.start, seed=0).renderer
    seconds: tuple[list[float], list[float]] = ([], [])
    squares: tuple[list[float], list[float]] = ([], [])
    with torch.no_grad():
        for number in range(repeats + 1):
            u = torch.rand(
                len(renderer.start), generator=torch.Generator().manual_seed(number)
            )
            pictures = []
            for kept, way in zip(seconds, (light, renderer), strict=True):
                begun = time.process_time()
                pictures.append(way(u, number, spp))
                kept.append(time.process_time() - begun)
            for kept, levels in zip(
                squares,
                compute_level_errors(renderer, pictures, u, number, 4 * CHECK_SPP),
                strict=True,
            ):
                kept.append(levels**2)
    times = [statistics.median(one[1:]) for one in seconds]
    errors = [statistics.fmean(one) for one in squares]
    gain = times[1] * errors[1] / (times[0] * errors[0])
    off = " and ".join(f"{math.sqrt(one):.1f}" for one in errors)
    return (
        f"| mug, studio, camera: light on surfaces | {1e3 * times[0]:.0f} | "
        f"{gain:.1f} | {off} levels | | |"
    )


def agreement(
    pair: tuple[str, str, str], size: int, spp: int, count: int
) -> dict[str, int]:
    """Verdicts with everything and with nothing left out, over textures, poses and
    cameras.
    """
    problem = problem_of(pair, size, "texture,pose,camera")
    lean = problem.renderer
    full = lean.copy_with(lean.scene.copy_with(leave_out=NO_OMISSIONS))
    depth = measure_problem_bounces(problem, 0).depth
    same = other = 0
    with torch.no_grad():
        for number in range(count):
            u = problem.domain.sample(torch.Generator().manual_seed(number))[0]
            with lean.scene.limit_depth(depth):
                verdicts = [
                    int(problem.model(lean(u, noise, spp))[0].argmax())
                    for noise in (number, count + number)
                ]
            whole = int(problem.model(full(u, number, spp))[0].argmax())
            same = same + (verdicts[0] == whole)
            other = other + (verdicts[0] == verdicts[1])
    return {"configurations": count, "agree": same, "other_seed": other, "depth": depth}


def problem_of(pair: tuple[str, str, str], size: int, controls: str) -> Problem:
    """The problem of a pair at a size."""
    named: dict[str, Any] = {name: {} for name in controls.split(",")}
    config = AttackConfig(
        object=pair[0], environment=pair[1], controls=named, resolution=(size, size)
    )
    return problem_from_config(config)[0]


if __name__ == "__main__":
    sys.exit(main())
