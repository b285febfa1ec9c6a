"""Takes gradients of a loss by different estimators on one renderer, repeatably and
each stored where it is named.
"""

from __future__ import annotations

import base64
import statistics
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.scene.gradients import GradientPlan
from advsearch.scene.renderer import Renderer

Loss = Callable[[Tensor], Tensor]
"""From a picture (H, W, 3) sRGB to a number, by differentiable torch operations."""

# share of a full turn by which periodic coordinates are off their start where gradients
# are measured
TURNED = 0.0317


def interior_point(renderer: Renderer, share: float = 0.12) -> Tensor:
    """Return a point to measure at: the start, but continuous coordinates with a range
    at least `share` off its ends.

    Periodic ones are turned a little: starts are often symmetric. Groups with a norm
    ball stay at their start, and so do discrete choices. But what starts at the end of
    its range as a whole, as a projector's black picture does, is measured in the
    middle: at the end there is a bend, and no difference to either side.
    """
    u = renderer.start.clone()
    for group in renderer.plan.groups:
        if group.valid and group.size <= 64 and not group.periodic:
            u[group.coordinates] = u[group.coordinates].clamp(share, 1.0 - share)
        part = u[group.coordinates]
        if (
            group.valid
            and group.size > 64
            and bool(((part == 0.0) | (part == 1.0)).all())
        ):
            u[group.coordinates] = 0.5
        if group.periodic:
            u[group.coordinates] = (u[group.coordinates] + TURNED).remainder(1.0)
    return u


def restrict_plan(
    plan: GradientPlan, names: Collection[str], estimator: str | None = None
) -> GradientPlan:
    """Return the plan with the groups of these names differentiated, by an estimator or
    as planned, and no others.
    """
    chosen = {
        group.name: (estimator or group.estimator) if group.name in names else "none"
        for group in plan.groups
    }
    return replace(
        plan,
        groups=tuple(
            replace(group, estimator=chosen[group.name]) for group in plan.groups
        ),
    )


Keep = Callable[[str, Callable[[], Any]], Any]
"""From the name of a measurement, and what makes it, to a JSON value: one that is known
already, or what it makes.
"""


@dataclass(frozen=True, eq=False)
class Bench:
    """Where derivatives are measured: of a loss of the picture at u (d,), with `spp`
    samples a pixel and noise from a root `seed`. `keep` is asked for each measurement;
    `tick` is told the samples of each gradient that is done.
    """

    renderer: Renderer
    loss: Loss
    u: Tensor
    seed: int
    spp: int
    keep: Keep = lambda name, measure: measure()
    tick: Callable[[int], object] = lambda samples: None

    def gradient(self, plan: GradientPlan, seed: int) -> Tensor:
        """Return one gradient (d,) by a plan, under noise of its own."""
        before = self.renderer.plan
        self.renderer.plan = plan
        try:
            return self.renderer.gradient(self.loss, self.u, seed, self.spp)[1]
        finally:
            self.renderer.plan = before

    def gradients(
        self, plan: GradientPlan, stream: str, repeats: int, place: str | None = None
    ) -> tuple[Tensor, float]:
        """Return gradients (repeats, d) by a plan, zero where it takes no derivative,
        and the median seconds of one; the seed of each is its number in a stream. Each
        is kept where a `place` names them.
        """
        parts = [
            group.coordinates for group in plan.groups if group.estimator != "none"
        ]

        def timed(number: int) -> dict[str, Any]:
            begun = time.perf_counter()
            gradient = self.gradient(plan, seeds.stream(self.seed, stream, number))
            taken = torch.cat([gradient[part] for part in parts])
            numbers = base64.b64encode(
                taken.to(torch.float32).numpy().tobytes()
            ).decode("ascii")
            return {"seconds": time.perf_counter() - begun, "numbers": numbers}

        several = torch.zeros(repeats, len(self.u))
        times = []
        for number in range(repeats):
            measure = partial(timed, number)
            kept = (
                measure()
                if place is None
                else self.keep(f"{place} gradient {number}", measure)
            )
            numbers = torch.frombuffer(
                bytearray(base64.b64decode(kept["numbers"])), dtype=torch.float32
            )
            for part, values in zip(
                parts,
                numbers.split([part.stop - part.start for part in parts]),
                strict=True,
            ):
                several[number, part] = values
            times.append(kept["seconds"])
            if place is not None:
                self.tick(self.spp)
        return several, statistics.median(times)
