"""Compares estimators of the gradient over six pose parameters at 224 x 224: squared
error x time, as ratios.

    python benchmarks/gradients.py [--size 224] [--repeats 6]
    python benchmarks/gradients.py --steps [--size 96] [--repeats 6]
    python benchmarks/gradients.py --denoised [--size 64] [--repeats 16]

The parameters are a rotation vector and a shift of the bundled mug, the loss is linear
and smooth. Each estimator gives several gradients with seeds of their own; its error is
measured against the mean of many central differences. Mitsuba's projective integrator
is taken with guiding off. A camera cannot be differentiated by Mitsuba at all, so that
there is nothing to compare the six camera parameters with: their differences are
measured alone.

With `--steps` it compares the widths of differences of the model's own loss over poses
and cameras, at equal renders: how often they have the sign of what the loss does over 2
to 5 % of the range, which is how far a search goes at a time, and their noise as a
multiple of that slope.

With `--denoised` it compares the adjoint of a texture, which takes the denoiser as the
identity, with central differences, which have it: of the model's loss, along several
directions, with as many samples, over common seeds.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from advsearch import threads

threads.configure()

from advsearch.engine.gradients import (
    Bench,
    Loss,
    find_interior_point,
    make_smooth_loss,
    restrict_plan,
)
from advsearch.engine.loading import load_scene
from advsearch.questions.attack.carry_out import problem_from_config
from advsearch.questions.attack.settings import AttackConfig
from advsearch.scene.formation import ALL_OMISSIONS
from advsearch.scene.gradients import Group
from advsearch.scene.renderer import Renderer

POSE = {
    "pose": {
        "on_ground": "no",
        "rotation": [-30, 30],
        "x": [-0.15, 0.15],
        "y": [-0.15, 0.15],
        "z": [0.05, 0.35],
    }
}
CAMERA = {
    "camera": {
        "azimuth": [0, 90],
        "elevation": [5, 60],
        "roll": [-15, 15],
        "distance": [1.5, 3.0],
        "fov": [25, 45],
        "shift_x": [-0.1, 0.1],
    }
}
SPP = 16
PROJECTIVE = "projective"


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--size", type=int, default=224, help="side of the picture (default 224)"
    )
    parser.add_argument(
        "--repeats", type=int, default=6, help="gradients of each estimator (default 6)"
    )
    parser.add_argument(
        "--steps",
        action="store_true",
        help="compare the widths of differences of the model's loss",
    )
    parser.add_argument(
        "--denoised",
        action="store_true",
        help="compare a texture's adjoint with differences",
    )
    args = parser.parse_args(argv)
    if args.denoised:
        return compare_denoised(args.size, args.repeats)
    if args.steps:
        return compare_steps(args.size, args.repeats)
    scene = load_scene("mug")
    for name, controls, estimators in (
        ("six pose parameters", POSE, ("differences", "material", PROJECTIVE)),
        ("six camera parameters", CAMERA, ("differences",)),
    ):
        renderer = scene.renderer(controls, resolution=args.size, denoise="none")
        print(f"{name}, {args.size} x {args.size}, {SPP} samples a pixel")
        print(
            f"{'estimator':14} {'seconds':>8} {'relative error':>15} "
            f"{'error^2 x time':>15}"
        )
        rows = []
        for estimator, seconds, error, product in measure(
            renderer, estimators, args.repeats
        ):
            print(
                f"{estimator:14} {seconds:8.2f} {error:15.3f} {product:15.3g}",
                flush=True,
            )
            rows.append((estimator, product))
        products = dict(rows)
        chosen = min(products["differences"], products.get("material", float("inf")))
        if PROJECTIVE in products:
            print(
                "  Mitsuba's projective integrator: "
                f"{products[PROJECTIVE] / chosen:.0f} times ours"
            )
        print()
    return 0


SCENES = (("mug", "studio"), ("teapot", "loft"))
FAR = (0.02, 0.03, 0.05)
"""Half-widths over which a search's slope is measured, in u."""
FAR_SEEDS = 3
FAR_SPP = 16
NEAR_SPP = 8


def compare_steps(size: int, repeats: int) -> int:
    """Print, for each parameter, how differences over a pixel and over the plan's step
    agree with a search's slope.
    """
    print(
        f"{size} x {size}, {NEAR_SPP} samples a pixel, {repeats} seeds: share with a "
        "search's sign, noise / its slope"
    )
    print(f"{'parameter':32} {'slope':>16} {'over a pixel':>16} {'plan':>16}")
    for name, environment in SCENES:
        config = AttackConfig(
            object=name,
            environment=environment,
            resolution=(size, size),
            controls={"camera": {}, "pose": {}},
        )
        problem, _ = problem_from_config(config)
        renderer = problem.renderer
        loss = problem.compute_loss
        for group in renderer.plan.groups:
            if group.step_reason and group.size == 1:
                cells = [f"{name}, {group.name}".ljust(32)]
                far = [
                    statistics.fmean(
                        difference(renderer, loss, group, half, 100 + seed, FAR_SPP)
                        for half in FAR
                    )
                    for seed in range(FAR_SEEDS)
                ]
                slope = statistics.fmean(far)
                cells.append(
                    f"{slope:8.2f} +- {statistics.stdev(far) / FAR_SEEDS**0.5:4.2f}"
                )
                for half in (group.pixel_step, group.step):
                    found = [
                        difference(renderer, loss, group, half, seed, NEAR_SPP)
                        for seed in range(repeats)
                    ]
                    same = sum((one > 0.0) == (slope > 0.0) for one in found)
                    cells.append(
                        f"{same} of {repeats}, {statistics.stdev(found) / abs(slope):6.2f}".rjust(
                            16
                        )
                    )
                print(" ".join(cells), flush=True)
    return 0


def difference(
    renderer: Renderer, loss: Loss, group: Group, half: float, seed: int, spp: int
) -> float:
    """Return a central difference of the loss over one coordinate, all others as in the
    scene.
    """
    values = []
    for side in (half, -half):
        u = renderer.start.clone()
        at = min(max(float(u[group.begin]), 0.1), 0.9) + side
        u[group.begin] = at % 1.0 if group.periodic else min(max(at, 0.0), 1.0)
        with torch.no_grad():
            values.append(float(loss(renderer(u, seed=seed, spp=spp))))
    return (values[0] - values[1]) / (2.0 * half)


TEXELS = 64
HALF = 0.02
BLOCKS = (1, 4, 16)
"""Side of the squares of texels that have one sign."""
ALONG = 4
FEWEST = 4
"""Directions of each kind, and seeds at least, where pictures have many samples."""


def compare_denoised(size: int, repeats: int) -> int:
    """Print, for each kind of direction, the adjoint's slopes along several of them
    over those of differences.
    """
    print(
        f"mug, studio, {size} x {size}, {TEXELS} x {TEXELS} texels: slopes by the "
        "adjoint / by differences"
    )
    print("(+- its deviation by noise), and the cosine of both over the directions")
    for denoise in ("oidn", "none"):
        config = AttackConfig(
            object="mug",
            resolution=(size, size),
            controls={"texture": {"resolution": TEXELS}},
            denoise=denoise,
        )
        problem, _ = problem_from_config(config)
        renderer = problem.renderer
        loss = problem.compute_loss
        start = renderer.start * (1.0 - 2.0 * HALF) + HALF
        adjoint = restrict_plan(renderer.plan, {"texture.texels"}, "adjoint")
        own = Bench(renderer, loss, start, seed=0, spp=256).compute_gradient(
            adjoint, 999
        )
        kinds = directions(own)
        for spp in (4, 16, 64, 256):
            seeds = max(FEWEST, min(repeats, 16 * repeats // spp))
            print(f"{denoise}, {spp} samples a pixel, {seeds} seeds")
            for kind, some in kinds.items():
                ratio, noise, cosine = slopes(renderer, loss, start, some, seeds, spp)
                print(
                    f"  {kind:12} {ratio:5.2f} +- {noise:4.2f}  {cosine:5.2f}",
                    flush=True,
                )
    return 0


def directions(own: Tensor) -> dict[str, Tensor]:
    """Directions (n, d) of each kind, up to 1: the gradient's own and its signs, waves,
    and random signs in squares.
    """
    generator = torch.Generator().manual_seed(0)
    side = torch.linspace(0.0, 2.0 * torch.pi, TEXELS)
    waves = []
    for _ in range(ALONG):
        across, down, phase = torch.randint(0, 3, (3, 3), generator=generator).float()
        waves.append(
            (across * side[None, :, None] + down * side[:, None, None] + phase)
            .cos()
            .flatten()
        )
    found = {
        "its own": own[None] / own.abs().max(),
        "its signs": own.sign()[None],
        "waves": torch.stack(waves),
    }
    for block in BLOCKS:
        cells = (
            torch.randint(
                0, 2, (ALONG, TEXELS // block, TEXELS // block, 3), generator=generator
            ).float()
            * 2
            - 1
        )
        signs = cells.repeat_interleave(block, dim=1).repeat_interleave(block, dim=2)
        found[f"signs of {block}"] = signs.flatten(1)
    return found


def slopes(
    renderer: Renderer, loss: Loss, start: Tensor, some: Tensor, repeats: int, spp: int
) -> tuple[float, float, float]:
    """Return the ratio of the slopes along directions (n, d) by the adjoint and by
    differences, its deviation by noise, and their cosine. Products are of different
    seeds, so that noise adds nothing to them.
    """
    adjoint = []
    differences = []
    for seed in range(repeats):
        adjoint.append(some @ renderer.gradient(loss, start, seed, spp)[1])
        with torch.no_grad():
            sides = [
                [
                    float(loss(renderer(start + s * HALF * one, seed, spp)))
                    for one in some
                ]
                for s in (1.0, -1.0)
            ]
        differences.append(
            (torch.tensor(sides[0]) - torch.tensor(sides[1])) / (2.0 * HALF)
        )
    mine = torch.stack(adjoint)
    theirs = torch.stack(differences)

    def product(a: Tensor, b: Tensor) -> float:
        return float(a.sum(0) @ b.sum(0) - (a * b).sum())

    parts = torch.tensor(
        [
            product(mine[k], theirs[k]) / product(theirs[k], theirs[k])
            for k in _others(repeats)
        ]
    )
    noise = float(((repeats - 1) * (parts - parts.mean()).square().mean()).sqrt())
    both = product(mine, theirs)
    squares = product(mine, mine) * product(theirs, theirs)
    return (
        both / product(theirs, theirs),
        noise,
        both / squares**0.5 if squares > 0.0 else float("nan"),
    )


def _others(count: int) -> list[Tensor]:
    """All but each one, for a jackknife."""
    return [torch.arange(count) != one for one in range(count)]


def measure(
    renderer: Renderer, estimators: Sequence[str], repeats: int
) -> Iterator[tuple[str, float, float, float]]:
    """Yield estimator, median seconds, root mean square relative error, and squared
    error x seconds.
    """
    bench = Bench(
        renderer,
        make_smooth_loss(renderer.formation.resolution),
        find_interior_point(renderer),
        seed=0,
        spp=64,
    )
    names = {group.name for group in renderer.plan.groups}
    differences = restrict_plan(renderer.plan, names, "differences")
    references = [
        bench.compute_gradient(differences, 1000 + number) for number in range(6)
    ]
    truth = torch.stack(references).mean(dim=0)
    for estimator in estimators:
        seconds = []
        errors = []
        taken = estimator
        if estimator == PROJECTIVE:
            take_projective(renderer.scene)
            taken = "material"
        for number in range(repeats):
            begun = time.perf_counter()
            gradient = replace(bench, spp=SPP).compute_gradient(
                restrict_plan(renderer.plan, names, taken), number
            )
            seconds.append(time.perf_counter() - begun)
            errors.append(_squared(gradient - truth) / _squared(truth))
        mean = statistics.fmean(errors)
        yield (
            estimator,
            statistics.median(seconds),
            mean**0.5,
            mean * statistics.median(seconds),
        )


def take_projective(scene: Any) -> None:
    """Let Mitsuba's projective integrator, with guiding off, take the place of the
    material form.
    """
    with_boundary = scene.copy_with(leave_out=ALL_OMISSIONS - {"boundary"})

    def adjoint(
        inputs: dict[str, Tensor], cotangent: Tensor, seed: int, spp: int, **_: object
    ) -> dict[str, Tensor]:
        moved = [name for name in inputs if name.startswith("object.")]
        found: dict[str, Tensor] = with_boundary.adjoint(
            inputs, cotangent, seed, spp, wrt=moved
        )
        return found

    scene.render_material_adjoint = adjoint


def _squared(value: Tensor) -> float:
    return float(value.square().sum())


if __name__ == "__main__":
    sys.exit(main())
