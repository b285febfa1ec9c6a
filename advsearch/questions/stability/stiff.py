"""Cases of controls whose scales differ by a million, and of noise.

A search works in the unit box, so a control's unit cannot reach it. What can is how strongly the objective depends on
each number there: its curvatures, whose ratio (the condition number) is printed.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Sequence
from functools import partial

import torch
from torch import Tensor

from advsearch.attacks import PGD, search
from advsearch.engine.gradients import smooth_loss
from advsearch.questions.stability.result import Outcome, case, cases, check, holds
from advsearch.questions.stability.scene import SHARPNESS, ControlSettings, LossEval, search_domain, seen, shown, small

RATIO = 1e6


def hessian(value: Callable[[Tensor], float], u: Tensor, directions: Tensor, steps: Sequence[float]) -> Tensor:
    """Estimate the second derivatives (k, k), float64, of an objective at u (d,) along directions (k, d), by
    differences of k half-widths."""
    moves = [step * direction for step, direction in zip(steps, directions, strict=True)]
    here, second = value(u), torch.zeros(len(moves), len(moves), dtype=torch.float64)
    for i, move in enumerate(moves):
        second[i, i] = (value(u + move) - 2.0 * here + value(u - move)) / steps[i] ** 2
        for j, other in enumerate(moves[:i]):
            crossed = value(u + move + other) - value(u + move - other)
            crossed += value(u - move - other) - value(u - move + other)
            second[i, j] = second[j, i] = crossed / (4.0 * steps[i] * steps[j])
    return second


def condition_number(second: Tensor) -> float:
    """Return the largest over the smallest absolute eigenvalue of a symmetric matrix (k, k); infinite if that is 0."""
    sizes = torch.linalg.eigvalsh(second.double()).abs()
    return float(sizes.max() / sizes.min()) if float(sizes.min()) > 0.0 else math.inf


@case("stiff", "badly-scaled-range")
def wide_range() -> Outcome:
    """The derivative does not depend on how wide the searched range is."""
    wide, narrow = ({"pose": {"x": [-reach, reach]}} for reach in (1e4, 0.3))
    slopes = []
    for controls, width in ((wide, 2e4), (narrow, 0.6)):
        renderer = small(controls)
        loss = smooth_loss(renderer.formation.resolution)
        each = [float(renderer.gradient(loss, renderer.start, seed, 32)[1][0]) for seed in range(6)]
        slopes.append(statistics.fmean(each) / width)
    error = abs(slopes[0] / slopes[1] - 1.0)
    off = check("error of the derivative per object size", error, most=0.2)
    return seen(wide, compare=False).also(off, relative_error=error)


@case("stiff", "light-rotation-texel", slow=True)
def light_rotation_texel() -> Outcome:
    """All three move, the condition number is printed, and the objective's unit does not matter."""
    controls: ControlSettings = {
        "light": {"type": "point", "power": [0.0, 12.0], "x": 1.0, "y": -1.0, "z": 2.0},
        "pose": {"yaw": [0.0, 360.0]},
        "texture": {"resolution": 2},
    }
    renderer = small(controls)
    u, loss = renderer.start.clone(), smooth_loss(renderer.formation.resolution)
    u[0], u[1] = 0.5, 0.1
    directions = torch.zeros(3, len(u))
    directions[0, 0] = directions[1, 1] = 1.0
    directions[2, 2:] = 1.0
    steps = [0.2, renderer.plan.groups[1].step * 2.0, 0.08]
    second = hessian(lambda at: SHARPNESS * float(loss(shown(renderer, at, 0, 64))), u, directions, steps)
    units = torch.diag(torch.tensor([1.0 / 12.0, 1.0 / 360.0, 1.0]).double())
    domain = search_domain(renderer, u)
    paths: list[list[Tensor]] = []
    for scale in (1.0, RATIO):
        evaluate = LossEval(renderer, partial(lambda scale, image: scale * loss(image), scale), 8)
        paths.append([])
        note = lambda record, at, evaluation: paths[-1].append(at)  # noqa: E731
        result = search(partial(map, evaluate), domain, PGD(), steps=18, seed=0, candidates=0, on_step=note)
    path, again = map(torch.stack, paths)
    moved = (path - path[0]).abs().amax(dim=0)
    names = {"condition number in u": second, "condition number in watts, degrees and sRGB": units @ second @ units}
    return seen(controls, u={0: 0.5, 1: 0.1}, compare=False).also(
        *(
            check(f"how far {what} moved", float(distance), least=0.05)
            for what, distance in (("the power", moved[0]), ("the rotation", moved[1]), ("the texels", moved[2:].max()))
        ),
        check("distance from the path of the objective x 1e6", float((path - again).abs().max()), most=1e-3),
        ending=result.ending.value,
        measured={name: condition_number(matrix) for name, matrix in names.items()},
    )


MIXED = {"texture": {"resolution": 8}, "environment": {"exposure": [-1.0, 1.0]}, "pose": {"y": [-0.3, 0.3]}}
# fmt: off
cases("noise", seen, [
    ("one-sample-a-pixel", "Finite; the mean of 48 gradients is right.",
     {"controls": MIXED, "spp": 1, "repeats": 48, "slow": True}),
    ("one-sample-a-pixel-denoised", "Finite after the denoiser too.",
     {"controls": {"texture": {"resolution": 8}}, "spp": 1, "denoise": "oidn", "compare": False}),
])
# fmt: on


@case("noise", "heavy-tails-of-a-moving-mesh", slow=True)
def heavy_render(count: int = 24) -> Outcome:
    """The plan takes differences of the loss for what moves a mesh, which have no heavy tail.

    Of so many Gaussian numbers fewer than one lot in 1,000 has one farther from the median than 12 median distances.
    """
    controls = {"pose": {"x": [-0.3, 0.3]}}
    renderer = small(controls).like(transfer="linear")
    renderer.plan = renderer.plan.at_a_pixel()
    loss = smooth_loss(renderer.formation.resolution)
    slopes = torch.stack([renderer.gradient(loss, renderer.start, seed, 4)[1] for seed in range(count)]).double()
    away = (slopes - slopes.median()).abs()
    return seen(controls, compare=False, spp=4).also(
        check("farthest over the median distance", float(away.max() / away.median()), most=12.0),
        holds("the plan takes secant", renderer.plan.groups[0].estimator == "secant"),
    )
